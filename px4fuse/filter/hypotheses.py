"""Estimate of biases, scale factor error and jumps from KF's innovations.

KF is linear: an error of the positions or of the acceleration adds its response to the innovations.
The response to an error of size 1 (1 m/s², 1 rad or 1 m) is a column of a design matrix. Least
squares, weighted by S, estimates all errors together (generalised likelihood ratio, Willsky and
Jones 1976): accelerometer biases, a rotation of the frame, a slow tilt error and jumps of the
positions.

A scale factor also multiplies the acceleration noise, which would bias the regression (errors in
variables). The scale factor is therefore found by fits with several scale factors (Deming 1943).
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
from px4fuse.filter.steps import Timeline, make_timeline
from px4fuse.flight.model import Columns, Flight, Unavailable

ANALYSIS_NAME = "biases, scale factor error and jumps"
MIN_MEASUREMENTS = 50
# Prior σ (rad) of the slow tilt error of the logged attitude
TILT_SIGMA_RAD = 0.002
# Interval (s) between the knots of the slow acceleration error, which is piecewise linear
KNOT_SPACING_S = 15.0
MAX_KNOTS = 40
# Columns of the design matrix: accelerometer bias forward (body axis x) and right (y), and rotation
# of the position source's frame about the vertical
FORWARD_COLUMN, RIGHT_COLUMN, ROTATION_COLUMN = range(3)
CONSTANT_ERROR_COUNT = 3
# Tested multiples of KF's SIGMA_A. Most are below 1, because KF's SIGMA_A also covers biases and
# tilt, which are estimated here
TESTED_SIGMA_A_FACTORS = np.geomspace(0.2, 2.0, 7)
# Tested scale factors of the position source
TESTED_SCALE_FACTORS = np.linspace(0.7, 1.3, 7)
# Maximum number of times at which a jump of the positions is tested
MAX_TESTED_JUMP_TIMES = 800
# Number of jump times that are tested at once, to limit the memory
JUMP_BATCH_SIZE = 80
# Positions within this time (s) after a tested jump are ignored: a burst of outliers is no jump
OUTLIER_BURST_DURATION_S = 1.0
# Outliers within this time (s) after a jump are tested again: positions after a jump look like
# outliers
OUTLIER_RETEST_DURATION_S = 6.0
# Maximum false alarm probability of a jump, per flight
MAX_JUMP_FALSE_ALARM_P = 1e-3
# Probability that a good measurement near a jump is classified as an outlier
MAX_FALSE_OUTLIER_P = 1e-3
# Maximum number of times that are tested to find the exact time of a detected jump
MAX_CANDIDATE_JUMP_TIMES = 6
MAX_JUMPS = 3
# Minimum accelerometer bias (m/s²) that is reported: half of EKF2_ABL_LIM
MIN_BIAS_M_S2 = 0.2
# Minimum ratio of an accelerometer bias to its σ to report it: false alarm rate 6e-5
MIN_BIAS_TO_SIGMA_RATIO = 4.0
# Minimum number of measurements before a jump, and also after it
MIN_MEASUREMENTS_PER_JUMP_SIDE = 8


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
        Accelerometer bias. At constant heading, a tilt error has an equal effect.
    rotation_rad : Estimate
        Yaw of the position source's frame relative to the attitude (clockwise from above).
    scale : Estimate
        Scale factor error: distances from positions over distances from the IMU, minus 1.
    sigma_a_m_s2 : float
        White noise of the acceleration that remains after the fit.
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

    Start position, start velocity and the error are fitted to the measurements minus the doubly
    integrated acceleration. None without IMU, with a gap in the IMU, or with few measurements.
    """
    acceleration, time_s = axis.acceleration, axis.measurement_time_s
    if (
        isinstance(acceleration, Unavailable)
        or acceleration.cumulative_gap_s[-1] > 0.0
        or len(time_s) < MIN_MEASUREMENTS
    ):
        return None
    velocity_m_s = acceleration.compute_integral_m_s()
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
    flight : Flight
    axes : tuple of Axis
        Horizontal axes with the same measurement times.
    settings : Settings
    sigma_a_m_s2, sigma_z_m : float
        KF's maximum-likelihood noises.
    outlier_time_s : ndarray
        Timestamps of measurements to exclude.
    clock_offset_s : float
        Time offset added to the timestamps.
    source_resets_s : sequence of float
        Timestamps at which the position source reports a reset (``reset_counter``).
    """
    design = make_design_matrix(flight, axes, settings, sigma_z_m, clock_offset_s)
    if isinstance(design, Unavailable):
        return design
    is_skipped = np.isin(axes[0].measurement_time_s[-len(design.time_s) :], outlier_time_s)
    if (used_count := int(np.count_nonzero(~is_skipped))) < MIN_MEASUREMENTS:
        return report_too_few_measurements(ANALYSIS_NAME, used_count, MIN_MEASUREMENTS)
    sigma_a_grid = sigma_a_m_s2 * TESTED_SIGMA_A_FACTORS
    sigma_a, design_fit = _fit_sigma_a(design, sigma_a_grid, is_skipped)
    jumps, is_skipped = _find_jumps(
        design, sigma_a, is_skipped, [time_s + clock_offset_s for time_s in source_resets_s]
    )
    if jumps:
        design = replace(
            design, jump_columns=make_unit_steps(design.time_s, [jump.time_s for jump in jumps])
        )
        sigma_a, design_fit = _fit_sigma_a(design, sigma_a_grid, is_skipped)
    forward_bias_m_s2, right_bias_m_s2, frame_rotation_rad = map(
        design_fit.estimate, (FORWARD_COLUMN, RIGHT_COLUMN, ROTATION_COLUMN)
    )
    return SystematicErrors(
        forward_bias_m_s2,
        right_bias_m_s2,
        frame_rotation_rad,
        _fit_scale(design, sigma_a, is_skipped),
        jumps,
        sigma_a,
    )


def _fit_sigma_a(
    design: DesignMatrix, sigma_a_grid: Array, is_skipped: BoolArray
) -> tuple[float, DesignFit]:
    """Return the maximum-likelihood SIGMA_A on a grid, and the least squares fit with it."""
    fit_sigma_a = cache(lambda index: design.fit(float(sigma_a_grid[index]), is_skipped))
    best_index = _index_of_minimum(lambda index: fit_sigma_a(index).score, len(sigma_a_grid))
    return float(sigma_a_grid[best_index]), fit_sigma_a(best_index)


def _index_of_minimum(score: Callable[[int], float], count: int) -> int:
    """Return the index of the only minimum of ``score(0)`` to ``score(count - 1)``.

    The search starts in the middle, to compute few scores.
    """
    index = count // 2
    direction = 1 if index + 1 < count and score(index + 1) < score(index) else -1
    while 0 <= index + direction < count and score(index + direction) < score(index):
        index += direction
    return index


def _fit_scale(design: DesignMatrix, sigma_a: float, is_skipped: BoolArray) -> Estimate:
    """Estimate the scale factor error of the positions from fits with several scale factors."""
    fit_scale = cache(
        lambda grid_index: design.fit(sigma_a, is_skipped, float(TESTED_SCALE_FACTORS[grid_index]))
    )
    # A larger tested scale factor of the positions increases S. ln S is omitted from the score,
    # because it would bias the estimated scale factor to zero
    best_scale_index = _index_of_minimum(
        lambda grid_index: fit_scale(grid_index).square_sum, len(TESTED_SCALE_FACTORS)
    )
    grid_index = int(np.clip(best_scale_index, 1, len(TESTED_SCALE_FACTORS) - 2))
    scores_around_minimum = [
        fit_scale(grid_index + grid_shift).square_sum / 2.0 for grid_shift in (-1, 0, 1)
    ]
    vertex_shift, curvature = fit_parabola_vertex(np.array(scores_around_minimum), 1)
    grid_step = float(TESTED_SCALE_FACTORS[1] - TESTED_SCALE_FACTORS[0])
    if curvature <= 0.0:
        return Estimate(0.0, float("inf"))
    best_scale = (
        TESTED_SCALE_FACTORS[grid_index] + float(np.clip(vertex_shift, -1.5, 1.5)) * grid_step
    )
    scale_sigma = grid_step / np.sqrt(curvature) * max(fit_scale(grid_index).residual_rms, 1.0)
    scale_correction_for_rotation = np.hypot(
        1.0, fit_scale(grid_index).coefficients[ROTATION_COLUMN]
    )
    return Estimate(float(best_scale * scale_correction_for_rotation - 1.0), float(scale_sigma))


def _find_jumps(
    design: DesignMatrix, sigma_a: float, is_skipped: BoolArray, source_resets_s: Sequence[float]
) -> tuple[tuple[Jump, ...], BoolArray]:
    """Detect lasting jumps of the positions; return them in time order, and a mask of outliers.

    A jump is tested at each reset that the source reports, at the first of successive outliers
    (positions after a jump look like outliers), and at the most likely time of the flight.
    """
    jumps: list[Jump] = []

    def make_skip_mask(jump_time_s: float) -> BoolArray:
        # A jump at a reset of the source is no burst of outliers: use the positions after it
        if jump_time_s in source_resets_s:
            return is_skipped & ~_is_in_window(
                design.time_s, jump_time_s, OUTLIER_RETEST_DURATION_S
            )
        return is_skipped | _is_in_window(design.time_s, jump_time_s, OUTLIER_BURST_DURATION_S)

    for _ in range(MAX_JUMPS):
        design = replace(
            design, jump_columns=make_unit_steps(design.time_s, [jump.time_s for jump in jumps])
        )
        outlier_run_starts_s = design.time_s[
            np.flatnonzero(is_skipped & ~np.append(False, is_skipped[:-1]))
        ]
        jump_times = [
            *source_resets_s,
            *_find_significant_jump_times(design, sigma_a, is_skipped, outlier_run_starts_s),
            *_find_significant_jump_times(design, sigma_a, is_skipped)[:1],
        ]
        max_false_alarm_p = MAX_JUMP_FALSE_ALARM_P / max(len(outlier_run_starts_s), 1)
        significant_jumps = [
            jump
            for time_s in jump_times
            if (
                jump := _test_jump(
                    design, sigma_a, make_skip_mask(time_s), time_s, max_false_alarm_p
                )
            )
        ]
        if not significant_jumps:
            break
        best_jump = max(significant_jumps, key=lambda jump: jump.chi_square)
        best_jump, is_skipped = _locate_jump(design, sigma_a, is_skipped, best_jump)
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
    design: DesignMatrix,
    sigma_a: float,
    is_skipped: BoolArray,
    candidate_times_s: Array | None = None,
) -> list[float]:
    """Return the times at which a jump is significant, largest χ² first.

    By default, all measurement times are tested.
    """
    if candidate_times_s is None:
        candidate_times_s = design.time_s[
            MIN_MEASUREMENTS_PER_JUMP_SIDE:-MIN_MEASUREMENTS_PER_JUMP_SIDE
        ]
        candidate_times_s = candidate_times_s[
            :: max(1, -(-len(candidate_times_s) // MAX_TESTED_JUMP_TIMES))
        ]
    if not len(candidate_times_s):
        return []
    chi_square = _compute_jump_chi_squares(design, sigma_a, is_skipped, candidate_times_s)
    min_chi_square = chdtri(design.axis_count, MAX_JUMP_FALSE_ALARM_P / len(design.time_s))
    descending_order = np.argsort(-chi_square)
    return [
        float(candidate_times_s[index])
        for index in descending_order
        if chi_square[index] >= min_chi_square
    ]


def _compute_jump_chi_squares(
    design: DesignMatrix, sigma_a: float, is_skipped: BoolArray, candidate_times_s: Array
) -> Array:
    """Return χ² of a jump at each time: the decrease of the sum of squared residuals."""
    whitened_innovations, columns, log_variance_sum = design.whiten_design(sigma_a, is_skipped)
    fit_without_jump = design.regress(whitened_innovations, columns, log_variance_sum, is_skipped)
    columns = columns[:, ~is_skipped]
    chi_squares = np.zeros(len(candidate_times_s))
    for batch in np.array_split(
        np.arange(len(candidate_times_s)), -(-len(candidate_times_s) // JUMP_BATCH_SIZE)
    ):
        jump_steps = make_unit_steps(design.time_s, candidate_times_s[batch])
        zero_increments = np.broadcast_to(0.0, jump_steps.shape)
        jump_response = design.whiten_inputs(
            zero_increments, zero_increments, jump_steps, sigma_a, is_skipped
        )[0][~is_skipped]
        for axis_index in range(design.axis_count):
            axis_residual = fit_without_jump.residual[fit_without_jump.axis == axis_index]
            columns_times_jump_response = columns[axis_index].T @ jump_response
            jump_information = np.sum(jump_response**2, axis=0) - np.sum(
                columns_times_jump_response
                * (fit_without_jump.covariance @ columns_times_jump_response),
                axis=0,
            )
            chi_squares[batch] += (
                axis_residual @ jump_response / fit_without_jump.compute_axis_rms()[axis_index]
            ) ** 2 / np.maximum(jump_information, 1e-9)
    return chi_squares


def _locate_jump(
    design: DesignMatrix, sigma_a: float, is_skipped: BoolArray, jump: Jump
) -> tuple[Jump, BoolArray]:
    """Return a detected jump with its exact time and change (m), and a mask of outliers to skip."""
    is_near = np.abs(design.time_s - jump.time_s) <= OUTLIER_BURST_DURATION_S
    # Fit with the jump, but without the measurements near it. Outliers after the jump are used
    # again if their residual is now small
    residual_squares = design.add_jump(jump.time_s)[0].compute_residual_squares(
        sigma_a, is_skipped | is_near
    )
    is_near_or_after_jump = is_near | _is_in_window(
        design.time_s, jump.time_s, OUTLIER_RETEST_DURATION_S
    )
    max_residual_square = chdtri(design.axis_count, MAX_FALSE_OUTLIER_P)
    is_skipped = np.where(
        is_near_or_after_jump & ~is_near, residual_squares > max_residual_square, is_skipped
    )
    candidate_times_s = design.time_s[is_near]
    best_indices = np.argsort(
        -_compute_jump_chi_squares(design, sigma_a, is_skipped & ~is_near, candidate_times_s)
    )[:MAX_CANDIDATE_JUMP_TIMES]
    outlier_mask_by_jump_time = {}
    for jump_time_s in candidate_times_s[best_indices].tolist():
        residual_squares = design.add_jump(jump_time_s)[0].compute_residual_squares(
            sigma_a, is_skipped | is_near
        )
        outlier_mask_by_jump_time[jump_time_s] = np.where(
            is_near, residual_squares > max_residual_square, is_skipped
        )
    # With a wrong jump time, good measurements look like outliers: use the time with the fewest
    # outliers
    best_jump_time_s = min(
        outlier_mask_by_jump_time,
        key=lambda jump_time_s: np.count_nonzero(outlier_mask_by_jump_time[jump_time_s]),
    )
    is_skipped = outlier_mask_by_jump_time[best_jump_time_s]
    jump_design, jump_column_indices = design.add_jump(best_jump_time_s)
    design_fit = jump_design.fit(sigma_a, is_skipped)
    step_m = tuple(design_fit.estimate(int(column)) for column in jump_column_indices)
    return replace(jump, time_s=best_jump_time_s, step_m=step_m), is_skipped


def _test_jump(
    design: DesignMatrix,
    sigma_a: float,
    is_skipped: BoolArray,
    time_s: float,
    max_false_alarm_p: float,
) -> Jump | None:
    """Test for a jump at ``time_s``, and return it if it is significant."""
    design, jump_column_indices = design.add_jump(time_s)
    count_before_jump = np.count_nonzero(~is_skipped & (design.time_s < time_s))
    if (
        min(count_before_jump, np.count_nonzero(~is_skipped & (design.time_s >= time_s)))
        < MIN_MEASUREMENTS_PER_JUMP_SIDE
    ):
        return None
    design_fit = design.fit(sigma_a, is_skipped)
    normalised_jump = design_fit.coefficients[jump_column_indices]
    jump_covariance = design_fit.covariance[np.ix_(jump_column_indices, jump_column_indices)]
    normalised_jump = normalised_jump / design_fit.compute_axis_rms()
    chi_square = float(normalised_jump @ np.linalg.solve(jump_covariance, normalised_jump))
    if chi_square < chdtri(len(jump_column_indices), max_false_alarm_p):
        return None
    return Jump(
        time_s,
        tuple(design_fit.estimate(int(column)) for column in jump_column_indices),
        chi_square,
    )


@dataclass(frozen=True)
class DesignFit:
    """Least squares fit of normalised innovations by the columns of a design matrix.

    Attributes
    ----------
    axis : ndarray of int, shape (n,)
        Axis index of each row; rows are sorted by axis.
    residual : ndarray, shape (n,)
        Normalised innovations minus the fit.
    coefficients, covariance : ndarray, shape (k,) and (k, k)
    square_sum : float
        Sum of the squared residuals and of the squared prior deviations.
    score : float
        Restricted negative log-likelihood.
    residual_rms : float
        RMS of the residual; 1 for correct noises.
    """

    axis: IntArray
    residual: Array
    coefficients: Array
    covariance: Array
    square_sum: float
    score: float
    residual_rms: float

    def compute_axis_rms(self) -> Array:
        """Return the RMS residual (in √S) along each axis; 1 if it is smaller."""
        mean_square = np.bincount(self.axis, self.residual**2) / np.bincount(self.axis)
        return np.sqrt(np.maximum(mean_square, 1.0))

    def estimate(self, column: int) -> Estimate:
        """Return the coefficient of a column and its σ.

        If ``residual_rms`` is above 1, σ is multiplied by it.
        """
        coefficient_sigma = float(np.sqrt(self.covariance[column, column])) * max(
            self.residual_rms, 1.0
        )
        return Estimate(float(self.coefficients[column]), coefficient_sigma)


@dataclass(frozen=True)
class DesignMatrix:
    """Inputs of KF along several axes: the data, and each systematic error with size 1.

    KF's innovations for the data are fitted by its innovations for the errors, which are the
    columns of the design matrix. The slow acceleration error is linear between knots.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Timestamps of the measurements.
    preintegrated_columns : PreintegratedMotion
        Four columns for each axis: data, 1 m/s² forward bias, 1 m/s² right bias and 1 rad rotation.
        Last columns, shared by the axes: slow acceleration error of 1 m/s² at each knot.
    prior_sigma : ndarray, shape (k,)
        Prior σ of the coefficients, except those of jumps.
    jump_columns : ndarray, shape (m, j)
        Unit steps at the times of j jumps.
    """

    time_s: Array
    axis_count: int
    preintegrated_columns: PreintegratedMotion
    prior_sigma: Array
    sigma_z_m: float
    jump_columns: Array

    def add_jump(self, time_s: float) -> tuple[DesignMatrix, IntArray]:
        """Add a jump; return the design matrix, and the column of the jump for each axis."""
        design = replace(
            self,
            jump_columns=np.hstack([self.jump_columns, make_unit_steps(self.time_s, [time_s])]),
        )
        first_jump_column = len(self.prior_sigma)
        jump_count = design.jump_columns.shape[1]
        return design, first_jump_column + jump_count * (1 + np.arange(self.axis_count)) - 1

    def whiten_inputs(
        self, dp: Array, dv: Array, measured_m: Array, sigma_a: float, is_skipped: BoolArray
    ) -> tuple[Array, float]:
        """Return normalised innovations ν/√S of KF, shape (m, k), and Σ ln S.

        ``dp``, ``dv`` and ``measured_m`` have one column for each of k inputs, which KF filters at
        once. The sum is over the fused measurements.
        """
        preintegrated_columns = replace(
            self.preintegrated_columns,
            delta_position_m=dp,
            delta_velocity_m_s=dv,
            measurement_m=measured_m,
        )
        nu, s = innovations(preintegrated_columns, sigma_a, self.sigma_z_m, is_skipped)
        nu /= np.sqrt(s)[:, None]
        return nu, float(np.sum(np.log(s[~is_skipped])))

    def fit(self, sigma_a: float, is_skipped: BoolArray, scale: float = 1.0) -> DesignFit:
        """Fit biases, rotation, slow error and jumps to KF's innovations by least squares.

        ``scale`` is a trial scale factor of the positions. Instead of dividing the positions by it,
        the acceleration and its noise are multiplied by it. ``is_skipped``, shape (m,), is True for
        measurements that are not used.
        """
        return self.regress(*self.whiten_design(sigma_a, is_skipped, scale), is_skipped)

    def regress(
        self,
        innovations_by_axis: Array,
        columns: Array,
        log_variance_sum: float,
        is_skipped: BoolArray,
    ) -> DesignFit:
        """Fit the columns of the design matrix to the normalised innovations by least squares.

        The arguments are results of :meth:`whiten_design`.
        """
        axis_indices = np.repeat(np.arange(len(innovations_by_axis)), np.count_nonzero(~is_skipped))
        innovations_by_axis = innovations_by_axis[:, ~is_skipped].ravel()
        columns = columns[:, ~is_skipped].reshape(len(axis_indices), -1)
        column_count = columns.shape[1]
        prior_sigma = np.append(
            self.prior_sigma, np.full(column_count - len(self.prior_sigma), np.inf)
        )
        information = np.diag(prior_sigma**-2.0) + columns.T @ columns
        # A small diagonal prevents a singular matrix: in hover, the column of the rotation is zero
        information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(column_count)
        right_hand_side = columns.T @ innovations_by_axis
        information_factor = cho_factor(information)
        covariance = cho_solve(information_factor, np.eye(column_count))
        coefficients = covariance @ right_hand_side
        square_sum = float(
            innovations_by_axis @ innovations_by_axis - coefficients @ right_hand_side
        )
        score = 0.5 * (square_sum + log_variance_sum) + float(
            np.sum(np.log(np.diag(information_factor[0])))
        )
        residual_rms = float(
            np.sqrt(max(square_sum, 0.0) / max(len(innovations_by_axis) - CONSTANT_ERROR_COUNT, 1))
        )
        residual = innovations_by_axis - columns @ coefficients
        return DesignFit(
            axis_indices, residual, coefficients, covariance, square_sum, score, residual_rms
        )

    def compute_residual_squares(self, sigma_a: float, is_skipped: BoolArray) -> Array:
        """Return the squared residual of each measurement over S, summed over axes.

        Measurements in ``is_skipped`` have residuals, but are not used in the fit.
        """
        whitened_innovations, columns, log_variance_sum = self.whiten_design(sigma_a, is_skipped)
        design_fit = self.regress(whitened_innovations, columns, log_variance_sum, is_skipped)
        residual = whitened_innovations - columns @ design_fit.coefficients
        return np.asarray(np.sum(residual**2, axis=0)) / max(design_fit.residual_rms, 1.0) ** 2

    def whiten_design(
        self, sigma_a: float, is_skipped: BoolArray, scale: float = 1.0
    ) -> tuple[Array, Array, float]:
        """Return KF's normalised innovations, the design matrix, and Σ ln S.

        Innovations ν/√S have the shape (axes, measurements). The design matrix, shape (axes,
        measurements, columns), contains the innovations due to each error of size 1.
        """
        preintegrated_columns, axis_count, jump_count = (
            self.preintegrated_columns,
            self.axis_count,
            self.jump_columns.shape[1],
        )
        column_count = len(self.prior_sigma)
        whitened_innovations = np.empty((axis_count, len(is_skipped)))
        columns = np.zeros((axis_count, len(is_skipped), column_count + axis_count * jump_count))
        # The scale factor multiplies the columns that are computed from measured acceleration: data
        # and rotation. The columns of the biases are 1 m/s²
        data_column_indices = (1 + CONSTANT_ERROR_COUNT) * np.arange(axis_count)
        column_factors = np.ones(preintegrated_columns.measurement_m.shape[1])
        column_factors[
            np.append(data_column_indices, data_column_indices + 1 + ROTATION_COLUMN)
        ] = scale
        zero_increments = 0.0 * self.jump_columns
        whitened_columns, log_variance_sum = self.whiten_inputs(
            np.hstack([column_factors * preintegrated_columns.delta_position_m, zero_increments]),
            np.hstack([column_factors * preintegrated_columns.delta_velocity_m_s, zero_increments]),
            np.hstack([preintegrated_columns.measurement_m, self.jump_columns]),
            scale * sigma_a,
            is_skipped,
        )
        *columns_by_axis, knot_and_jump_columns = np.split(
            whitened_columns, (1 + CONSTANT_ERROR_COUNT) * np.arange(1, 1 + axis_count), 1
        )
        knot_count = knot_and_jump_columns.shape[1] - jump_count
        for axis, axis_columns in enumerate(columns_by_axis):
            whitened_innovations[axis] = axis_columns[:, 0]
            first_knot_column = CONSTANT_ERROR_COUNT + knot_count * axis
            first_jump_column = column_count + jump_count * axis
            columns[axis][:, :CONSTANT_ERROR_COUNT] = axis_columns[:, 1:]
            knot_and_jump_indices = np.r_[
                first_knot_column : first_knot_column + knot_count,
                first_jump_column : first_jump_column + jump_count,
            ]
            columns[axis][:, knot_and_jump_indices] = knot_and_jump_columns
        return whitened_innovations, columns, axis_count * log_variance_sum


def make_design_matrix(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    sigma_z_m: float,
    clock_offset_s: float,
) -> DesignMatrix | Unavailable:
    """Make the design matrix with columns for biases, rotation and slow error, but not for jumps.

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
    shifted_axes = [replace(axis, measurement_time_s=time_s) for axis in axes]
    settings = replace(settings, input="imu")
    timeline = make_timeline(shifted_axes[0], settings)
    error_integrals = _integrate_unit_errors(attitude, acceleration)
    preintegrated_motions = [preintegrate(axis, settings) for axis in shifted_axes]
    increment_pairs: list[ArrayPair] = []
    for axis, preintegrated_motion in zip(axes, preintegrated_motions, strict=True):
        increment_pairs.append(
            (preintegrated_motion.delta_position_m, preintegrated_motion.delta_velocity_m_s)
        )
        increment_pairs += [
            _integrate_between_measurements(integral @ axis.direction, input_time_s, timeline)
            for input_time_s, integral in error_integrals
        ]
    time_s = axes[0].measurement_time_s[-len(preintegrated_motions[0].measurement_m) :]
    weight_time_s, knot_weights = _make_knot_weights(
        time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s
    )
    increment_pairs += [
        _integrate_between_measurements(
            integrate_cumulatively(weights, weight_time_s), weight_time_s, timeline
        )
        for weights in knot_weights
    ]
    dp, dv = (np.stack(arrays, axis=1) for arrays in zip(*increment_pairs, strict=True))
    measured_m = np.zeros_like(dp)
    for index, preintegrated_motion in enumerate(preintegrated_motions):
        # Positions are relative to the first measurement, which is KF's initial position
        measured_m[:, index * (1 + CONSTANT_ERROR_COUNT)] = (
            preintegrated_motion.measurement_m - preintegrated_motion.initial_state.position_m
        )
    preintegrated_columns = replace(
        preintegrated_motions[0],
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        measurement_m=measured_m,
        # All axes share one process noise, including the additional noise in IMU gaps
        added_process_noise=np.mean(
            [
                preintegrated_motion.added_process_noise
                for preintegrated_motion in preintegrated_motions
            ],
            axis=0,
        ),
        initial_state=replace(preintegrated_motions[0].initial_state, position_m=0.0),
    )
    tilt_sigma_m_s2 = np.full(len(axes) * len(knot_weights), TILT_SIGMA_RAD * constants.g)
    prior_sigma = np.append(np.full(CONSTANT_ERROR_COUNT, np.inf), tilt_sigma_m_s2)
    return DesignMatrix(
        time_s,
        len(axes),
        preintegrated_columns,
        prior_sigma,
        sigma_z_m,
        make_unit_steps(time_s, []),
    )


def _integrate_between_measurements(
    integral_m_s: Array, time_s: Array, timeline: Timeline
) -> ArrayPair:
    """Return Δp (m) and Δv (m/s) between the measurements, from an integrated acceleration."""
    velocity_m_s = np.interp(timeline.time_s, time_s, integral_m_s)
    return integrate_acceleration(timeline, np.diff(velocity_m_s) / np.diff(timeline.time_s))


def _integrate_unit_errors(attitude: pd.DataFrame, acceleration: Acceleration) -> list[ArrayPair]:
    """Return the NED velocity errors due to 1 m/s² forward bias, 1 m/s² right bias and 1 rad yaw.

    Each of the three items is (times in s, velocity error in m/s since the start).
    """
    quaternions = attitude[Columns.QUATERNION].to_numpy(copy=True)
    body_to_ned = Rotation.from_quat(quaternions, scalar_first=True)
    attitude_time_s = attitude.index.to_numpy()
    bias_integrals = [
        (
            attitude_time_s,
            integrate_cumulatively(body_to_ned.apply(np.eye(3)[axis]), attitude_time_s),
        )
        for axis in (FORWARD_COLUMN, RIGHT_COLUMN)
    ]
    north, east, _ = acceleration.acceleration_integral_m_s
    return [*bias_integrals, (acceleration.time_s, np.stack([-east, north, 0.0 * north]).T)]


def _make_knot_weights(start_s: float, end_s: float) -> ArrayPair:
    """Return times (s) from start to end, and the weight of each knot at these times.

    The slow acceleration error is interpolated linearly between knots, which have intervals of
    :data:`KNOT_SPACING_S`. The weights have the shape (knots, times).
    """
    knot_count = int(np.clip(np.ceil((end_s - start_s) / KNOT_SPACING_S), 1, MAX_KNOTS)) + 1
    weight_time_s = np.linspace(start_s, end_s, 20 * (knot_count - 1) + 1)
    knot_times_s = np.linspace(start_s, end_s, knot_count)
    return weight_time_s, np.array(
        [np.interp(weight_time_s, knot_times_s, weights) for weights in np.eye(knot_count)]
    )


def make_unit_steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Return step functions from 0 to 1 at the times ``starts_s``, shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
