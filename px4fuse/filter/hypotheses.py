"""Estimate of biases, scale factor error and jumps from KF's innovations.

KF is linear: each input error changes the innovations in proportion to its size. Weighted least
squares estimates the sizes of all errors (generalised likelihood ratio, Willsky and Jones 1976).

In this regression, acceleration noise would bias the scale factor (errors in variables). The fit
is therefore repeated with several scale factors (Deming 1943).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray, integrate_cumulatively
from px4fuse.filter.likelihood import (
    PreintegratedMotion,
    fit_parabola_vertex,
    innovations,
    integrate_acceleration,
    preintegrate,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Acceleration, Axis, report_too_few_measurements
from px4fuse.filter.steps import PredictionSteps, make_prediction_steps
from px4fuse.flight.model import Columns, Flight, Unavailable

ANALYSIS_NAME = "biases, scale factor error and jumps"
MIN_MEASUREMENTS = 50
# Prior σ (rad) of the slow tilt error of the logged attitude
TILT_PRIOR_SIGMA_RAD = 0.002
# Interval (s) between the knots of the slow acceleration error, which is piecewise linear
SLOW_ERROR_KNOT_SPACING_S = 15.0
MAX_SLOW_ERROR_KNOTS = 40
# Columns of the design matrix: forward and right bias (body frame), yaw of the source frame
FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN, FRAME_ROTATION_COLUMN = range(3)
CONSTANT_ERROR_COLUMN_COUNT = 3
# Tested multiples of KF's SIGMA_A, mostly below 1: KF's SIGMA_A includes biases and tilt
TESTED_SIGMA_A_FACTORS = np.geomspace(0.2, 2.0, 7)
# Tested scale factors of the position source
TESTED_SCALE_FACTORS = np.linspace(0.7, 1.3, 7)
MAX_TESTED_JUMP_TIMES = 800
# Number of jump times that are tested at once, to limit the memory
JUMP_BATCH_SIZE = 80
# Positions within this time (s) after a tested jump are ignored, because they may be outliers
OUTLIER_BURST_DURATION_S = 1.0
# Outliers within this time (s) after a jump are tested again
OUTLIER_RETEST_DURATION_AFTER_JUMP_S = 6.0
# Maximum false alarm probability of a jump, per flight
MAX_JUMP_FALSE_ALARM_P = 1e-3
# Probability that a good measurement near a jump is classified as an outlier
MAX_FALSE_OUTLIER_P = 1e-3
# Maximum number of times that are tested to locate a detected jump
MAX_CANDIDATE_JUMP_TIMES = 6
MAX_JUMPS = 3
# Minimum accelerometer bias (m/s²) that is reported: half of EKF2_ABL_LIM
MIN_BIAS_M_S2 = 0.2
# Minimum ratio of a reported accelerometer bias to its σ
MIN_BIAS_TO_SIGMA_RATIO = 4.0
MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP = 8


@dataclass(frozen=True)
class Estimate:
    """Estimated value with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Jump:
    """Lasting jump of the positions: time, change along each axis (m), and test statistic χ²."""

    time_s: float
    step_m: tuple[Estimate, ...]
    chi_square: float

    @property
    def size_m(self) -> float:
        return float(np.hypot.reduce([step.value for step in self.step_m]))


@dataclass(frozen=True)
class SystematicErrors:
    """Biases, scale factor error and jumps, estimated from the innovations of horizontal axes.

    Attributes
    ----------
    forward_bias_m_s2, right_bias_m_s2 : Estimate
        Accelerometer bias in the body frame.
    rotation_rad : Estimate
        Yaw of the position source's frame relative to the attitude.
    scale : Estimate
        Scale factor error of the positions relative to the IMU.
    sigma_a_m_s2 : float
        White noise of the acceleration after the fit.
    """

    forward_bias_m_s2: Estimate
    right_bias_m_s2: Estimate
    rotation_rad: Estimate
    scale: Estimate
    jumps: tuple[Jump, ...]
    sigma_a_m_s2: float

    def compute_horizontal_bias(self) -> Estimate:
        """Return the magnitude of the horizontal accelerometer bias (m/s²)."""
        forward_bias, right_bias = self.forward_bias_m_s2, self.right_bias_m_s2
        return Estimate(
            math.hypot(forward_bias.value, right_bias.value),
            math.hypot(forward_bias.sigma, right_bias.sigma),
        )

    def has_significant_bias(self) -> bool:
        bias = self.compute_horizontal_bias()
        return bias.value >= max(MIN_BIAS_M_S2, MIN_BIAS_TO_SIGMA_RATIO * bias.sigma)


def estimate_mean_acceleration_error(axis: Axis) -> float | None:
    """Fit a constant error of the acceleration (m/s²) along an axis to its positions.

    None without complete IMU data, or with few measurements.
    """
    acceleration, time_s = axis.acceleration, axis.measurement_time_s
    if (
        isinstance(acceleration, Unavailable)
        or acceleration.cumulative_gap_s[-1] > 0.0
        or len(time_s) < MIN_MEASUREMENTS
    ):
        return None
    velocity_m_s = acceleration.compute_velocity_change_m_s()
    path_m = integrate_cumulatively(velocity_m_s, acceleration.time_s)
    residuals_m = axis.measurement_m - np.interp(time_s, acceleration.time_s, path_m)
    # the doubly integrated acceleration is too large by error · t² / 2
    return -2.0 * float(np.polynomial.Polynomial.fit(time_s, residuals_m, 2).convert().coef[2])


def fit_systematic_errors(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    clock_offset_s: float,
    source_resets_s: Sequence[float] = (),
) -> SystematicErrors | Unavailable:
    """Estimate accelerometer biases and scale factor error, and detect jumps of the positions.

    Parameters
    ----------
    axes : tuple of Axis
        Horizontal axes with the same measurement times.
    sigma_a_m_s2, sigma_z_m : float
        KF's maximum-likelihood noises.
    outlier_time_s : ndarray
        Timestamps of measurements to exclude.
    clock_offset_s : float
        Time offset added to the timestamps.
    source_resets_s : sequence of float
        Timestamps of resets that the position source reports.
    """
    design_matrix = make_design_matrix(flight, axes, settings, sigma_z_m, clock_offset_s)
    if isinstance(design_matrix, Unavailable):
        return design_matrix
    is_skipped = np.isin(axes[0].measurement_time_s[-len(design_matrix.time_s) :], outlier_time_s)
    if (used_count := int(np.count_nonzero(~is_skipped))) < MIN_MEASUREMENTS:
        return report_too_few_measurements(ANALYSIS_NAME, used_count, MIN_MEASUREMENTS)
    sigma_a_grid = sigma_a_m_s2 * TESTED_SIGMA_A_FACTORS
    sigma_a, regression = _fit_sigma_a(design_matrix, sigma_a_grid, is_skipped)
    jumps, is_skipped = _find_jumps(
        design_matrix, sigma_a, is_skipped, [time_s + clock_offset_s for time_s in source_resets_s]
    )
    if jumps:
        design_matrix = replace(
            design_matrix,
            jump_columns=make_unit_steps(design_matrix.time_s, [jump.time_s for jump in jumps]),
        )
        sigma_a, regression = _fit_sigma_a(design_matrix, sigma_a_grid, is_skipped)
    forward_bias_m_s2, right_bias_m_s2, frame_rotation_rad = map(
        regression.estimate, (FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN, FRAME_ROTATION_COLUMN)
    )
    return SystematicErrors(
        forward_bias_m_s2,
        right_bias_m_s2,
        frame_rotation_rad,
        _fit_scale(design_matrix, sigma_a, is_skipped),
        jumps,
        sigma_a,
    )


def _fit_sigma_a(
    design_matrix: DesignMatrix, sigma_a_grid: Array, is_skipped: BoolArray
) -> tuple[float, InnovationRegression]:
    """Return the maximum-likelihood SIGMA_A on a grid, and the least squares fit with it."""
    fit_with_sigma_a = cache(
        lambda index: design_matrix.fit(float(sigma_a_grid[index]), is_skipped)
    )
    best_index = _index_of_minimum(lambda index: fit_with_sigma_a(index).score, len(sigma_a_grid))
    return float(sigma_a_grid[best_index]), fit_with_sigma_a(best_index)


def _index_of_minimum(score: Callable[[int], float], count: int) -> int:
    """Return the index of the only minimum of ``score(0)`` to ``score(count - 1)``."""
    index = count // 2
    direction = 1 if index + 1 < count and score(index + 1) < score(index) else -1
    while 0 <= index + direction < count and score(index + direction) < score(index):
        index += direction
    return index


def _fit_scale(design_matrix: DesignMatrix, sigma_a: float, is_skipped: BoolArray) -> Estimate:
    """Estimate the scale factor error of the positions from fits with several scale factors."""
    fit_with_scale = cache(
        lambda scale_index: design_matrix.fit(
            sigma_a, is_skipped, float(TESTED_SCALE_FACTORS[scale_index])
        )
    )
    # ln S is omitted from the score, because it would bias the scale factor to zero
    best_scale_index = _index_of_minimum(
        lambda scale_index: fit_with_scale(scale_index).residual_and_prior_square_sum,
        len(TESTED_SCALE_FACTORS),
    )
    centre_index = int(np.clip(best_scale_index, 1, len(TESTED_SCALE_FACTORS) - 2))
    scores_around_minimum = [
        fit_with_scale(centre_index + grid_shift).residual_and_prior_square_sum / 2.0
        for grid_shift in (-1, 0, 1)
    ]
    vertex_shift, curvature = fit_parabola_vertex(np.array(scores_around_minimum), 1)
    grid_step = float(TESTED_SCALE_FACTORS[1] - TESTED_SCALE_FACTORS[0])
    if curvature <= 0.0:
        return Estimate(0.0, float("inf"))
    best_scale = (
        TESTED_SCALE_FACTORS[centre_index] + float(np.clip(vertex_shift, -1.5, 1.5)) * grid_step
    )
    scale_sigma = (
        grid_step / np.sqrt(curvature) * max(fit_with_scale(centre_index).residual_rms, 1.0)
    )
    length_factor_of_linear_rotation = np.hypot(
        1.0, fit_with_scale(centre_index).coefficients[FRAME_ROTATION_COLUMN]
    )
    return Estimate(float(best_scale * length_factor_of_linear_rotation - 1.0), float(scale_sigma))


def _find_jumps(
    design_matrix: DesignMatrix,
    sigma_a: float,
    is_skipped: BoolArray,
    source_resets_s: Sequence[float],
) -> tuple[tuple[Jump, ...], BoolArray]:
    """Detect lasting jumps of the positions; return them in time order, and a mask of outliers.

    Tested times: resets of the source, first outliers of a burst, and the most likely time.
    """
    jumps: list[Jump] = []

    def mask_outliers_near_jump(jump_time_s: float) -> BoolArray:
        # After a reset that the source reports, its positions are valid
        if jump_time_s in source_resets_s:
            return is_skipped & ~_is_in_window(
                design_matrix.time_s, jump_time_s, OUTLIER_RETEST_DURATION_AFTER_JUMP_S
            )
        return is_skipped | _is_in_window(
            design_matrix.time_s, jump_time_s, OUTLIER_BURST_DURATION_S
        )

    for _ in range(MAX_JUMPS):
        design_matrix = replace(
            design_matrix,
            jump_columns=make_unit_steps(design_matrix.time_s, [jump.time_s for jump in jumps]),
        )
        outlier_run_starts_s = design_matrix.time_s[
            np.flatnonzero(is_skipped & ~np.append(False, is_skipped[:-1]))
        ]
        jump_times = [
            *source_resets_s,
            *_find_significant_jump_times(design_matrix, sigma_a, is_skipped, outlier_run_starts_s),
            *_find_significant_jump_times(design_matrix, sigma_a, is_skipped)[:1],
        ]
        max_false_alarm_p = MAX_JUMP_FALSE_ALARM_P / max(len(outlier_run_starts_s), 1)
        significant_jumps = [
            jump
            for time_s in jump_times
            if (
                jump := _test_jump(
                    design_matrix,
                    sigma_a,
                    mask_outliers_near_jump(time_s),
                    time_s,
                    max_false_alarm_p,
                )
            )
        ]
        if not significant_jumps:
            break
        best_jump = max(significant_jumps, key=lambda jump: jump.chi_square)
        best_jump, is_skipped = _locate_jump(design_matrix, sigma_a, is_skipped, best_jump)
        jumps.append(best_jump)
        source_resets_s = [
            reset_time_s
            for reset_time_s in source_resets_s
            if abs(reset_time_s - best_jump.time_s) > OUTLIER_BURST_DURATION_S
        ]
    return tuple(sorted(jumps, key=lambda jump: jump.time_s)), is_skipped


def _is_in_window(time_s: Array, start_s: float, duration_s: float) -> BoolArray:
    return np.asarray((time_s >= start_s) & (time_s < start_s + duration_s))


def _find_significant_jump_times(
    design_matrix: DesignMatrix,
    sigma_a: float,
    is_skipped: BoolArray,
    candidate_times_s: Array | None = None,
) -> list[float]:
    """Return the times of significant jumps, largest χ² first.

    By default, all measurement times are tested.
    """
    if candidate_times_s is None:
        candidate_times_s = design_matrix.time_s[
            MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP:-MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP
        ]
        candidate_times_s = candidate_times_s[
            :: max(1, -(-len(candidate_times_s) // MAX_TESTED_JUMP_TIMES))
        ]
    if not len(candidate_times_s):
        return []
    chi_square = _compute_jump_chi_squares(design_matrix, sigma_a, is_skipped, candidate_times_s)
    min_chi_square = chdtri(
        design_matrix.axis_count, MAX_JUMP_FALSE_ALARM_P / len(design_matrix.time_s)
    )
    return [
        float(candidate_times_s[index])
        for index in np.argsort(-chi_square)
        if chi_square[index] >= min_chi_square
    ]


def _compute_jump_chi_squares(
    design_matrix: DesignMatrix, sigma_a: float, is_skipped: BoolArray, candidate_times_s: Array
) -> Array:
    """Return χ² of a jump at each time: the decrease of the sum of squared residuals."""
    normalised_innovations, columns, sum_of_log_variances = (
        design_matrix.compute_innovations_and_design_matrix(sigma_a, is_skipped)
    )
    fit_without_jump = design_matrix.fit_columns_to_innovations(
        normalised_innovations, columns, sum_of_log_variances, is_skipped
    )
    columns = columns[:, ~is_skipped]
    chi_squares = np.zeros(len(candidate_times_s))
    for batch in np.array_split(
        np.arange(len(candidate_times_s)), -(-len(candidate_times_s) // JUMP_BATCH_SIZE)
    ):
        jump_step_functions = make_unit_steps(design_matrix.time_s, candidate_times_s[batch])
        zero_increments = np.broadcast_to(0.0, jump_step_functions.shape)
        normalised_jump_response = design_matrix.compute_normalised_innovations(
            zero_increments, zero_increments, jump_step_functions, sigma_a, is_skipped
        )[0][~is_skipped]
        for axis_index in range(design_matrix.axis_count):
            axis_residual = fit_without_jump.residual[fit_without_jump.axis == axis_index]
            jump_response_along_columns = columns[axis_index].T @ normalised_jump_response
            jump_size_information = np.sum(normalised_jump_response**2, axis=0) - np.sum(
                jump_response_along_columns
                * (fit_without_jump.covariance @ jump_response_along_columns),
                axis=0,
            )
            chi_squares[batch] += (
                axis_residual
                @ normalised_jump_response
                / fit_without_jump.compute_residual_rms_by_axis()[axis_index]
            ) ** 2 / np.maximum(jump_size_information, 1e-9)
    return chi_squares


def _locate_jump(
    design_matrix: DesignMatrix, sigma_a: float, is_skipped: BoolArray, jump: Jump
) -> tuple[Jump, BoolArray]:
    """Return a detected jump with its exact time and size (m), and a mask of outliers."""
    is_near_jump = np.abs(design_matrix.time_s - jump.time_s) <= OUTLIER_BURST_DURATION_S
    # Measurements near the jump may be outliers, so the first fit omits them
    residual_squares = design_matrix.add_jump(jump.time_s)[0].compute_residual_squares(
        sigma_a, is_skipped | is_near_jump
    )
    is_near_or_just_after_jump = is_near_jump | _is_in_window(
        design_matrix.time_s, jump.time_s, OUTLIER_RETEST_DURATION_AFTER_JUMP_S
    )
    max_residual_square = chdtri(design_matrix.axis_count, MAX_FALSE_OUTLIER_P)
    is_skipped = np.where(
        is_near_or_just_after_jump & ~is_near_jump,
        residual_squares > max_residual_square,
        is_skipped,
    )
    candidate_times_s = design_matrix.time_s[is_near_jump]
    best_indices = np.argsort(
        -_compute_jump_chi_squares(
            design_matrix, sigma_a, is_skipped & ~is_near_jump, candidate_times_s
        )
    )[:MAX_CANDIDATE_JUMP_TIMES]
    outlier_mask_by_jump_time = {}
    for jump_time_s in candidate_times_s[best_indices].tolist():
        residual_squares = design_matrix.add_jump(jump_time_s)[0].compute_residual_squares(
            sigma_a, is_skipped | is_near_jump
        )
        outlier_mask_by_jump_time[jump_time_s] = np.where(
            is_near_jump, residual_squares > max_residual_square, is_skipped
        )
    # With a wrong jump time, good measurements look like outliers
    best_jump_time_s = min(
        outlier_mask_by_jump_time,
        key=lambda jump_time_s: np.count_nonzero(outlier_mask_by_jump_time[jump_time_s]),
    )
    is_skipped = outlier_mask_by_jump_time[best_jump_time_s]
    design_matrix_with_jump, jump_column_indices = design_matrix.add_jump(best_jump_time_s)
    regression = design_matrix_with_jump.fit(sigma_a, is_skipped)
    return replace(
        jump,
        time_s=best_jump_time_s,
        step_m=tuple(regression.estimate(int(column)) for column in jump_column_indices),
    ), is_skipped


def _test_jump(
    design_matrix: DesignMatrix,
    sigma_a: float,
    is_skipped: BoolArray,
    time_s: float,
    max_false_alarm_p: float,
) -> Jump | None:
    """Test for a jump at ``time_s``, and return it if it is significant."""
    design_matrix, jump_column_indices = design_matrix.add_jump(time_s)
    count_before_jump = np.count_nonzero(~is_skipped & (design_matrix.time_s < time_s))
    if (
        min(count_before_jump, np.count_nonzero(~is_skipped & (design_matrix.time_s >= time_s)))
        < MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP
    ):
        return None
    regression = design_matrix.fit(sigma_a, is_skipped)
    normalised_jump_size_covariance = regression.covariance[
        np.ix_(jump_column_indices, jump_column_indices)
    ]
    normalised_jump_size = (
        regression.coefficients[jump_column_indices] / regression.compute_residual_rms_by_axis()
    )
    chi_square = float(
        normalised_jump_size
        @ np.linalg.solve(normalised_jump_size_covariance, normalised_jump_size)
    )
    if chi_square < chdtri(len(jump_column_indices), max_false_alarm_p):
        return None
    return Jump(
        time_s,
        tuple(regression.estimate(int(column)) for column in jump_column_indices),
        chi_square,
    )


@dataclass(frozen=True)
class InnovationRegression:
    """Least squares fit of normalised innovations by the columns of a design matrix.

    Attributes
    ----------
    axis : ndarray of int, shape (n,)
        Axis index of each row.
    residual : ndarray, shape (n,)
        Normalised innovations minus the fit.
    coefficients, covariance : ndarray, shape (k,) and (k, k)
        Estimated errors, and their covariance.
    residual_and_prior_square_sum : float
        Sum of squared residuals, and of squared coefficients over prior variances.
    score : float
        Restricted negative log-likelihood of the innovations.
    residual_rms : float
        RMS of the residual; 1 if SIGMA_A and SIGMA_Z are correct.
    """

    axis: IntArray
    residual: Array
    coefficients: Array
    covariance: Array
    residual_and_prior_square_sum: float
    score: float
    residual_rms: float

    def compute_residual_rms_by_axis(self) -> Array:
        """Return the RMS of the normalised residual along each axis, but at least 1."""
        mean_square = np.bincount(self.axis, self.residual**2) / np.bincount(self.axis)
        return np.sqrt(np.maximum(mean_square, 1.0))

    def estimate(self, column: int) -> Estimate:
        """Return the estimated error of one column of the design matrix, and its σ.

        σ is increased if the residuals are larger than expected.
        """
        coefficient_sigma = float(np.sqrt(self.covariance[column, column])) * max(
            self.residual_rms, 1.0
        )
        return Estimate(float(self.coefficients[column]), coefficient_sigma)


@dataclass(frozen=True)
class DesignMatrix:
    """Regression of KF's innovations on systematic errors, such as biases and jumps.

    A column of the design matrix contains the innovations due to one error of size 1.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Timestamps of the measurements.
    preintegrated_inputs : PreintegratedMotion
        Inputs of KF, one in each column. Columns of each axis: data, forward bias, right bias,
        rotation. Last columns: slow acceleration error.
    prior_sigma : ndarray, shape (k,)
        Prior σ of the coefficients, except those of jumps.
    jump_columns : ndarray, shape (m, j)
        Unit steps at the times of the jumps.
    """

    time_s: Array
    axis_count: int
    preintegrated_inputs: PreintegratedMotion
    prior_sigma: Array
    sigma_z_m: float
    jump_columns: Array

    def add_jump(self, time_s: float) -> tuple[DesignMatrix, IntArray]:
        """Return a design matrix with one more jump, and the jump's column index for each axis."""
        design_matrix = replace(
            self,
            jump_columns=np.hstack([self.jump_columns, make_unit_steps(self.time_s, [time_s])]),
        )
        first_jump_column = len(self.prior_sigma)
        jump_count = design_matrix.jump_columns.shape[1]
        return design_matrix, first_jump_column + jump_count * (1 + np.arange(self.axis_count)) - 1

    def compute_normalised_innovations(
        self, dp: Array, dv: Array, measured_m: Array, sigma_a: float, is_skipped: BoolArray
    ) -> tuple[Array, float]:
        """Run KF on several inputs; return normalised innovations ν/√S, one column per input.

        The second result is Σ ln S over the fused measurements.
        """
        preintegrated_inputs = replace(
            self.preintegrated_inputs,
            delta_position_m=dp,
            delta_velocity_m_s=dv,
            measurement_m=measured_m,
        )
        nu, s = innovations(preintegrated_inputs, sigma_a, self.sigma_z_m, is_skipped)
        nu /= np.sqrt(s)[:, None]
        return nu, float(np.sum(np.log(s[~is_skipped])))

    def fit(
        self, sigma_a: float, is_skipped: BoolArray, scale: float = 1.0
    ) -> InnovationRegression:
        """Fit biases, rotation, slow error and jumps to KF's innovations by least squares.

        ``scale`` is a trial scale factor of the positions; the acceleration is multiplied by it.
        ``is_skipped`` is True for measurements that are not used.
        """
        return self.fit_columns_to_innovations(
            *self.compute_innovations_and_design_matrix(sigma_a, is_skipped, scale), is_skipped
        )

    def fit_columns_to_innovations(
        self,
        innovations_by_axis: Array,
        design_columns: Array,
        sum_of_log_variances: float,
        is_skipped: BoolArray,
    ) -> InnovationRegression:
        """Fit the columns of the design matrix to the normalised innovations by least squares.

        The arguments are results of :meth:`compute_innovations_and_design_matrix`.
        """
        axis_indices = np.repeat(np.arange(len(innovations_by_axis)), np.count_nonzero(~is_skipped))
        innovations_by_axis = innovations_by_axis[:, ~is_skipped].ravel()
        design_columns = design_columns[:, ~is_skipped].reshape(len(axis_indices), -1)
        column_count = design_columns.shape[1]
        prior_sigma = np.append(
            self.prior_sigma, np.full(column_count - len(self.prior_sigma), np.inf)
        )
        information = np.diag(prior_sigma**-2.0) + design_columns.T @ design_columns
        # A small diagonal prevents a singular matrix: in hover, the rotation has no effect
        information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(column_count)
        right_hand_side = design_columns.T @ innovations_by_axis
        information_factor = cho_factor(information)
        covariance = cho_solve(information_factor, np.eye(column_count))
        coefficients = covariance @ right_hand_side
        residual_and_prior_square_sum = float(
            innovations_by_axis @ innovations_by_axis - coefficients @ right_hand_side
        )
        score = 0.5 * (residual_and_prior_square_sum + sum_of_log_variances) + float(
            np.sum(np.log(np.diag(information_factor[0])))
        )
        residual_rms = float(
            np.sqrt(
                max(residual_and_prior_square_sum, 0.0)
                / max(len(innovations_by_axis) - CONSTANT_ERROR_COLUMN_COUNT, 1)
            )
        )
        residual = innovations_by_axis - design_columns @ coefficients
        return InnovationRegression(
            axis_indices,
            residual,
            coefficients,
            covariance,
            residual_and_prior_square_sum,
            score,
            residual_rms,
        )

    def compute_residual_squares(self, sigma_a: float, is_skipped: BoolArray) -> Array:
        """Return the squared normalised residual of each measurement, summed over axes.

        Measurements in ``is_skipped`` are not used in the fit.
        """
        normalised_innovations, columns, sum_of_log_variances = (
            self.compute_innovations_and_design_matrix(sigma_a, is_skipped)
        )
        regression = self.fit_columns_to_innovations(
            normalised_innovations, columns, sum_of_log_variances, is_skipped
        )
        residual = normalised_innovations - columns @ regression.coefficients
        return np.asarray(np.sum(residual**2, axis=0)) / max(regression.residual_rms, 1.0) ** 2

    def compute_innovations_and_design_matrix(
        self, sigma_a: float, is_skipped: BoolArray, scale: float = 1.0
    ) -> tuple[Array, Array, float]:
        """Return KF's normalised innovations ν/√S, the design matrix, and Σ ln S.

        Shapes: (axes, measurements) and (axes, measurements, columns).
        """
        preintegrated_inputs, axis_count = self.preintegrated_inputs, self.axis_count
        jump_count = self.jump_columns.shape[1]
        column_count = len(self.prior_sigma)
        normalised_innovations = np.empty((axis_count, len(is_skipped)))
        columns = np.zeros((axis_count, len(is_skipped), column_count + axis_count * jump_count))
        # Only inputs with measured acceleration are multiplied by the scale factor
        data_input_indices = (1 + CONSTANT_ERROR_COLUMN_COUNT) * np.arange(axis_count)
        input_scale_factors = np.ones(preintegrated_inputs.measurement_m.shape[1])
        input_scale_factors[
            np.append(data_input_indices, data_input_indices + 1 + FRAME_ROTATION_COLUMN)
        ] = scale
        zero_increments = 0.0 * self.jump_columns
        normalised_innovations_by_input, sum_of_log_variances = self.compute_normalised_innovations(
            np.hstack(
                [input_scale_factors * preintegrated_inputs.delta_position_m, zero_increments]
            ),
            np.hstack(
                [input_scale_factors * preintegrated_inputs.delta_velocity_m_s, zero_increments]
            ),
            np.hstack([preintegrated_inputs.measurement_m, self.jump_columns]),
            scale * sigma_a,
            is_skipped,
        )
        *responses_by_axis, slow_error_and_jump_responses = np.split(
            normalised_innovations_by_input,
            (1 + CONSTANT_ERROR_COLUMN_COUNT) * np.arange(1, 1 + axis_count),
            1,
        )
        slow_error_knot_count = slow_error_and_jump_responses.shape[1] - jump_count
        for axis, axis_responses in enumerate(responses_by_axis):
            normalised_innovations[axis] = axis_responses[:, 0]
            first_slow_error_column = CONSTANT_ERROR_COLUMN_COUNT + slow_error_knot_count * axis
            first_jump_column = column_count + jump_count * axis
            columns[axis][:, :CONSTANT_ERROR_COLUMN_COUNT] = axis_responses[:, 1:]
            slow_error_and_jump_columns = np.r_[
                first_slow_error_column : first_slow_error_column + slow_error_knot_count,
                first_jump_column : first_jump_column + jump_count,
            ]
            columns[axis][:, slow_error_and_jump_columns] = slow_error_and_jump_responses
        return normalised_innovations, columns, axis_count * sum_of_log_variances


def make_design_matrix(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    sigma_z_m: float,
    clock_offset_s: float,
) -> DesignMatrix | Unavailable:
    """Make the design matrix of biases, rotation and slow acceleration error, without jumps.

    ``clock_offset_s`` is added to the timestamps of the positions.
    """
    acceleration, attitude = axes[0].acceleration, flight.attitude
    if isinstance(acceleration, Unavailable):
        return acceleration
    if isinstance(attitude, Unavailable):
        return attitude
    if len(axes[0].measurement_time_s) <= MIN_MEASUREMENTS:
        return report_too_few_measurements(
            ANALYSIS_NAME, len(axes[0].measurement_time_s), MIN_MEASUREMENTS
        )
    time_s = axes[0].measurement_time_s + clock_offset_s
    time_shifted_axes = [replace(axis, measurement_time_s=time_s) for axis in axes]
    settings = replace(settings, input="imu")
    prediction_steps = make_prediction_steps(time_shifted_axes[0], settings)
    velocity_errors_by_unit_error = _integrate_unit_errors(attitude, acceleration)
    preintegrated_motions = [preintegrate(axis, settings) for axis in time_shifted_axes]
    position_and_velocity_increments: list[ArrayPair] = []
    for axis, preintegrated_motion in zip(axes, preintegrated_motions, strict=True):
        position_and_velocity_increments.append(
            (preintegrated_motion.delta_position_m, preintegrated_motion.delta_velocity_m_s)
        )
        position_and_velocity_increments += [
            _integrate_between_measurements(
                integral @ axis.direction, input_time_s, prediction_steps
            )
            for input_time_s, integral in velocity_errors_by_unit_error
        ]
    time_s = axes[0].measurement_time_s[-len(preintegrated_motions[0].measurement_m) :]
    interpolation_time_s, interpolation_weights = _make_interpolation_weights(
        time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s
    )
    position_and_velocity_increments += [
        _integrate_between_measurements(
            integrate_cumulatively(weights, interpolation_time_s),
            interpolation_time_s,
            prediction_steps,
        )
        for weights in interpolation_weights
    ]
    dp, dv = (
        np.stack(arrays, axis=1) for arrays in zip(*position_and_velocity_increments, strict=True)
    )
    measured_m = np.zeros_like(dp)
    for index, preintegrated_motion in enumerate(preintegrated_motions):
        # Positions are relative to the first measurement, which is KF's initial position
        measured_m[:, index * (1 + CONSTANT_ERROR_COLUMN_COUNT)] = (
            preintegrated_motion.measurement_m - preintegrated_motion.initial_state.position_m
        )
    preintegrated_inputs = replace(
        preintegrated_motions[0],
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        measurement_m=measured_m,
        # One process noise for all axes: the mean
        process_noise_independent_of_sigma_a=np.mean(
            [
                preintegrated_motion.process_noise_independent_of_sigma_a
                for preintegrated_motion in preintegrated_motions
            ],
            axis=0,
        ),
        initial_state=replace(preintegrated_motions[0].initial_state, position_m=0.0),
    )
    tilt_acceleration_sigma_m_s2 = np.full(
        len(axes) * len(interpolation_weights), TILT_PRIOR_SIGMA_RAD * constants.g
    )
    prior_sigma = np.append(
        np.full(CONSTANT_ERROR_COLUMN_COUNT, np.inf), tilt_acceleration_sigma_m_s2
    )
    return DesignMatrix(
        time_s,
        len(axes),
        preintegrated_inputs,
        prior_sigma,
        sigma_z_m,
        make_unit_steps(time_s, []),
    )


def _integrate_between_measurements(
    acceleration_integral_m_s: Array, time_s: Array, prediction_steps: PredictionSteps
) -> ArrayPair:
    """Return Δp (m) and Δv (m/s) between the measurements, from an integrated acceleration."""
    velocity_m_s = np.interp(prediction_steps.time_s, time_s, acceleration_integral_m_s)
    return integrate_acceleration(
        prediction_steps, np.diff(velocity_m_s) / np.diff(prediction_steps.time_s)
    )


def _integrate_unit_errors(attitude: pd.DataFrame, acceleration: Acceleration) -> list[ArrayPair]:
    """Return velocity errors (NED) due to 1 m/s² forward bias, 1 m/s² right bias and 1 rad yaw.

    Each of the three errors is a pair: times (s), and velocity errors (m/s) at these times.
    """
    body_to_ned = Rotation.from_quat(
        attitude[Columns.QUATERNION].to_numpy(copy=True), scalar_first=True
    )
    attitude_time_s = attitude.index.to_numpy()
    velocity_errors_by_unit_bias = [
        (
            attitude_time_s,
            integrate_cumulatively(body_to_ned.apply(np.eye(3)[axis]), attitude_time_s),
        )
        for axis in (FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN)
    ]
    north, east, _ = acceleration.acceleration_integral_m_s
    return [
        *velocity_errors_by_unit_bias,
        (acceleration.time_s, np.stack([-east, north, 0.0 * north]).T),
    ]


def _make_interpolation_weights(start_s: float, end_s: float) -> ArrayPair:
    """Return times (s), and the weight of each knot at these times, shape (knots, times).

    The slow acceleration error is linear between the knots.
    """
    knot_count = (
        int(
            np.clip(np.ceil((end_s - start_s) / SLOW_ERROR_KNOT_SPACING_S), 1, MAX_SLOW_ERROR_KNOTS)
        )
        + 1
    )
    interpolation_time_s = np.linspace(start_s, end_s, 20 * (knot_count - 1) + 1)
    return interpolation_time_s, np.array(
        [
            np.interp(interpolation_time_s, np.linspace(start_s, end_s, knot_count), weights)
            for weights in np.eye(knot_count)
        ]
    )


def make_unit_steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Return steps from 0 to 1 at the times ``starts_s``, shape (times, steps)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
