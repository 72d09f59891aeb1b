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
from scipy.special import chdtri

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, integrate_cumulatively
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.trajectory.rotation import to_rotation_matrix

from .likelihood import (
    PreintegratedMotion,
    compute_gains,
    compute_innovations_with_gains,
    fit_parabola_vertex,
    integrate_acceleration,
    preintegrate,
)
from .settings import Settings
from .signals import Acceleration, Axis, interpolate_attitude, report_too_few_measurements
from .steps import make_prediction_steps

ANALYSIS_NAME = "accelerometer bias, scale factor error and position jumps"
MIN_MEASUREMENTS = 50
# Prior σ (rad) of the slow tilt error of the logged attitude
TILT_PRIOR_SIGMA_RAD = 0.002
# Interval (s) between the knots of the slow acceleration error, which is piecewise linear
SLOW_ERROR_KNOT_SPACING_S = 15.0
MAX_SLOW_ERROR_KNOTS = 40
# Columns of the design matrix: forward and right accelerometer bias (body frame), and yaw of the
# source frame relative to the attitude
FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN, FRAME_ROTATION_COLUMN = range(3)
CONSTANT_ERROR_COLUMN_COUNT = 3
# KF is run on several inputs for each axis: the flight data, and the effects of the three constant
# errors (1 m/s² forward bias, 1 m/s² right bias, 1 rad yaw). Number of inputs for each axis
INPUTS_PER_AXIS = 1 + CONSTANT_ERROR_COLUMN_COUNT
# Tested values of SIGMA_A ÷ KF's SIGMA_A. Most are below 1, because KF's SIGMA_A includes biases
# and tilt errors, which this regression estimates separately
TESTED_SIGMA_A_FACTORS = np.geomspace(0.2, 2.0, 7)
# Tested scale factors of the position source
TESTED_SCALE_FACTORS = np.linspace(0.7, 1.3, 7)
MAX_TESTED_JUMP_TIMES = 800
# Number of jump times that are tested at once, to limit the memory
JUMP_BATCH_SIZE = 80
# In a test for a jump, positions within this time (s) after the jump are omitted, because they may
# be outliers
OUTLIER_BURST_DURATION_S = 1.0
# Positions that seem to be outliers within this time (s) after a detected jump are tested again:
# they may be correct
OUTLIER_RETEST_DURATION_AFTER_JUMP_S = 6.0
# Maximum false alarm probability of a jump of the positions, per flight
MAX_JUMP_FALSE_ALARM_P = 1e-3
# Probability that a good measurement near a jump is classified as an outlier
MAX_FALSE_OUTLIER_PROBABILITY = 1e-3
# Maximum number of measurement times at which a detected jump is tested, to locate the jump
MAX_CANDIDATE_JUMP_TIMES = 6
MAX_JUMPS = 3
# Minimum accelerometer bias (m/s²) that is reported: half of EKF2_ABL_LIM
MIN_REPORTED_ACCELEROMETER_BIAS_M_S2 = 0.2
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
        SIGMA_A, estimated together with these errors.
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
        return bias.value >= max(
            MIN_REPORTED_ACCELEROMETER_BIAS_M_S2, MIN_BIAS_TO_SIGMA_RATIO * bias.sigma
        )


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
    velocity_m_s = acceleration.compute_velocity_change_m_s(axis.direction)
    path_m = integrate_cumulatively(velocity_m_s, acceleration.time_s)
    residuals_m = axis.measurement_m - np.interp(time_s, acceleration.time_s, path_m)
    # A constant acceleration error changes the doubly integrated acceleration by error · t² / 2, so
    # the residuals contain -error · t² / 2
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
    source_reset_times_s: Sequence[float] = (),
) -> SystematicErrors | Unavailable:
    """Estimate biases, frame rotation and scale factor error, and detect jumps of the positions.

    Parameters
    ----------
    axes : tuple of Axis
        Horizontal axes with the same measurement times.
    settings : Settings
        Only the prediction interval DT is used.
    sigma_a_m_s2, sigma_z_m : float
        KF's maximum-likelihood noises. SIGMA_A is fitted again.
    outlier_time_s : ndarray
        Timestamps of measurements to exclude.
    clock_offset_s : float
        Time offset added to the timestamps.
    source_reset_times_s : sequence of float
        Timestamps of resets that the position source reports.
    """
    initial_design = make_design_matrix(
        flight, axes, settings, sigma_a_m_s2, sigma_z_m, clock_offset_s
    )
    if isinstance(initial_design, Unavailable):
        return initial_design
    is_outlier = np.isin(initial_design.time_s, outlier_time_s)
    if (used_count := int(np.count_nonzero(~is_outlier))) < MIN_MEASUREMENTS:
        return report_too_few_measurements(ANALYSIS_NAME, used_count, MIN_MEASUREMENTS)
    tested_sigmas_a = (sigma_a_m_s2 * TESTED_SIGMA_A_FACTORS).tolist()
    design_matrix, regression = _fit_sigma_a(initial_design, tested_sigmas_a, is_outlier)
    # The mask of outliers is corrected: it can contain correct positions after a jump, and can lack
    # outliers near a jump
    jumps, is_skipped = _find_jumps(design_matrix, regression, is_outlier, source_reset_times_s)
    # SIGMA_A is fitted again, because jumps that are not modelled enlarge its estimate
    if jumps:
        design_matrix = replace(design_matrix, jump_times_s=[jump.time_s for jump in jumps])
        design_matrix, regression = _fit_sigma_a(design_matrix, tested_sigmas_a, is_skipped)
    forward_bias_m_s2, right_bias_m_s2, frame_rotation_rad = map(
        regression.estimate, (FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN, FRAME_ROTATION_COLUMN)
    )
    return SystematicErrors(
        forward_bias_m_s2,
        right_bias_m_s2,
        frame_rotation_rad,
        _fit_scale(design_matrix, is_skipped),
        jumps,
        design_matrix.sigma_a_m_s2,
    )


def _fit_sigma_a(
    design_matrix: DesignMatrix, tested_sigmas_a: list[float], is_skipped: BoolArray
) -> tuple[DesignMatrix, InnovationRegression]:
    """Fit the regression of KF's innovations with each tested SIGMA_A.

    Return the design matrix for the most likely SIGMA_A, and the least squares fit with it.
    """
    candidates = [replace(design_matrix, sigma_a_m_s2=sigma_a) for sigma_a in tested_sigmas_a]
    fit_candidate = cache(lambda index: candidates[index].fit(is_skipped))
    best_index = _find_minimum(lambda index: fit_candidate(index).score, len(candidates))
    return candidates[best_index], fit_candidate(best_index)


def _find_minimum(compute_score: Callable[[int], float], count: int) -> int:
    """Return the grid index of the lowest score, found by descent from the middle of the grid."""
    index, best_index = -1, count // 2
    while index != best_index:
        index = best_index
        neighbours = range(max(index - 1, 0), min(index + 2, count))
        best_index = min(neighbours, key=compute_score)
    return best_index


def _fit_scale(design_matrix: DesignMatrix, is_skipped: BoolArray) -> Estimate:
    """Estimate the scale factor error of the positions.

    The regression of KF's innovations is repeated with several scale factors of the positions. The
    best one has the smallest squared residuals.
    """
    tested_scales = TESTED_SCALE_FACTORS.tolist()
    fit_scale = cache(lambda index: design_matrix.fit(is_skipped, tested_scales[index]))

    def compute_score(index: int) -> float:
        # The term ln S of the likelihood is omitted, because it would bias the scale factor to zero
        return fit_scale(index).residual_and_prior_square_sum / 2.0

    centre_index = _find_minimum(compute_score, len(tested_scales))
    centre_index = min(max(centre_index, 1), len(tested_scales) - 2)
    # Minimum of the parabola through the lowest score and its neighbours
    nearby_scores = np.array([compute_score(centre_index + shift) for shift in (-1, 0, 1)])
    vertex_shift, curvature = fit_parabola_vertex(nearby_scores, 1)
    if curvature <= 0.0:
        return Estimate(0.0, math.inf)
    grid_step = tested_scales[1] - tested_scales[0]
    # At the ends of the tested range, do not extrapolate by more than half a grid step. The centre
    # is then one step from the end, so the limit is 1.5 steps
    best_scale = tested_scales[centre_index] + float(np.clip(vertex_shift, -1.5, 1.5)) * grid_step
    centre_fit = fit_scale(centre_index)
    # The linearised rotation by θ (x - θ y, y + θ x) lengthens the acceleration by √(1 + θ²)
    rotation_scale = math.hypot(1.0, centre_fit.coefficients[FRAME_ROTATION_COLUMN])
    # σ from the curvature of -ln p, increased if the residuals are larger than expected
    return Estimate(
        float(best_scale * rotation_scale - 1.0),
        grid_step / math.sqrt(curvature) * max(centre_fit.residual_rms, 1.0),
    )


def _find_jumps(
    design_matrix: DesignMatrix,
    fit: InnovationRegression,
    is_skipped: BoolArray,
    source_reset_times_s: Sequence[float],
) -> tuple[tuple[Jump, ...], BoolArray]:
    """Detect lasting jumps of the positions; return them in time order, and a mask of outliers.

    Tested times: resets of the source, first outliers of a burst, and the most likely time.
    ``fit`` is the fit without jumps.
    """
    jumps: list[Jump] = []
    time_s = design_matrix.time_s
    measurement_times_s = time_s[
        MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP:-MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP
    ]
    measurement_times_s = measurement_times_s[
        :: max(1, -(-len(measurement_times_s) // MAX_TESTED_JUMP_TIMES))
    ]

    def mask_outliers_near_jump(jump_time_s: float) -> BoolArray:
        """Return the mask of measurements to omit in the test for a jump at ``jump_time_s``."""
        if jump_time_s in source_reset_times_s:
            return is_skipped & ~_is_in_window(
                time_s, jump_time_s, OUTLIER_RETEST_DURATION_AFTER_JUMP_S
            )
        return is_skipped | _is_in_window(time_s, jump_time_s, OUTLIER_BURST_DURATION_S)

    for _ in range(MAX_JUMPS):
        # An outlier starts a run of outliers if the measurement before it is not an outlier
        outlier_run_starts_s = time_s[
            np.flatnonzero(is_skipped & ~np.append(False, is_skipped[:-1]))
        ]
        # After a jump, all positions may seem to be outliers. Candidates are therefore the starts
        # of runs of outliers, and the most significant of all measurement times
        candidate_times_s = [
            *source_reset_times_s,
            *_find_significant_jump_times(design_matrix, fit, is_skipped, outlier_run_starts_s),
            *_find_significant_jump_times(design_matrix, fit, is_skipped, measurement_times_s)[:1],
        ]
        # Test a jump at each time, with a smaller false alarm probability, because several times
        # are tested (Bonferroni)
        max_false_alarm_p = MAX_JUMP_FALSE_ALARM_P / max(len(outlier_run_starts_s), 1)
        tested_jumps = [
            _test_jump(
                design_matrix, mask_outliers_near_jump(jump_time_s), jump_time_s, max_false_alarm_p
            )
            for jump_time_s in candidate_times_s
        ]
        significant_jumps = [jump for jump in tested_jumps if jump]
        if not significant_jumps:
            break
        # Find the exact time of the most significant jump, and correct the mask of outliers
        best_jump, is_skipped = _locate_jump(
            design_matrix, is_skipped, max(significant_jumps, key=lambda jump: jump.chi_square)
        )
        # Search the next jump with this one in the fit
        jumps.append(best_jump)
        design_matrix = replace(design_matrix, jump_times_s=[jump.time_s for jump in jumps])
        fit = design_matrix.fit(is_skipped)
        source_reset_times_s = [
            reset_time_s
            for reset_time_s in source_reset_times_s
            if abs(reset_time_s - best_jump.time_s) > OUTLIER_BURST_DURATION_S
        ]
    return tuple(sorted(jumps, key=lambda jump: jump.time_s)), is_skipped


def _is_in_window(time_s: Array, start_s: float, duration_s: float) -> BoolArray:
    return (time_s >= start_s) & (time_s < start_s + duration_s)


def _find_significant_jump_times(
    design_matrix: DesignMatrix,
    fit: InnovationRegression,
    is_skipped: BoolArray,
    candidate_times_s: Array,
) -> list[float]:
    """Return the times at which a jump of the positions is significant, largest χ² first."""
    chi_square = _compute_jump_chi_squares(design_matrix, fit, is_skipped, candidate_times_s)
    min_chi_square = chdtri(
        design_matrix.axis_count, MAX_JUMP_FALSE_ALARM_P / len(design_matrix.time_s)
    )
    # Jump times with only skipped measurements between them have the same χ² except for rounding.
    # The earliest of these times comes first
    return [
        float(candidate_times_s[index])
        for index in np.argsort(-chi_square.round(6), kind="stable")
        if chi_square[index] >= min_chi_square
    ]


def _compute_jump_chi_squares(
    design_matrix: DesignMatrix,
    fit_without_jump: InnovationRegression,
    is_skipped: BoolArray,
    candidate_times_s: Array,
) -> Array:
    """Return χ² of a jump of the positions at each candidate time.

    χ² is the decrease of the sum of squared residuals when the jump is added to the regression of
    KF's innovations. ``is_skipped`` is True for measurements that the regression omits.
    """
    # Score test: a jump is not fitted. The innovations due to a jump of 1 m (jump_response) are
    # compared with the residuals of the fit without the jump
    _, columns = design_matrix.compute_innovations_and_design_matrix(fit_without_jump.gains)
    columns_by_axis = np.split(columns, design_matrix.axis_count)
    chi_squares = np.zeros(len(candidate_times_s))
    for first in range(0, len(candidate_times_s), JUMP_BATCH_SIZE):
        batch = slice(first, first + JUMP_BATCH_SIZE)
        # Jumps have no effect on earlier innovations, so the rows begin at the first jump
        rows = slice(np.searchsorted(design_matrix.time_s, candidate_times_s[first]), None)
        is_used = ~is_skipped[rows]
        unit_steps = make_unit_steps(design_matrix.time_s[rows], candidate_times_s[batch])
        zero_increments = np.zeros_like(unit_steps)
        jump_response = design_matrix.compute_normalised_innovations(
            zero_increments, zero_increments, unit_steps, fit_without_jump.gains[:, rows]
        )[is_used]
        for axis_columns, residual, residual_rms in zip(
            columns_by_axis,
            fit_without_jump.residual,
            fit_without_jump.residual_rms_by_axis,
            strict=True,
        ):
            # Information on the jump that the other columns cannot explain (Schur complement)
            response_along_columns = axis_columns[rows][is_used].T @ jump_response
            jump_size_information = np.sum(jump_response**2, axis=0) - np.sum(
                response_along_columns * (fit_without_jump.covariance @ response_along_columns),
                axis=0,
            )
            # Estimated jump, squared, over its variance
            chi_squares[batch] += (
                residual[rows][is_used] @ jump_response / residual_rms
            ) ** 2 / np.maximum(jump_size_information, 1e-9)
    return chi_squares


def _locate_jump(
    design_matrix: DesignMatrix, is_skipped: BoolArray, jump: Jump
) -> tuple[Jump, BoolArray]:
    """Return a detected jump of the positions with its exact time and size (m).

    Return also the measurements that the regression omits, with outliers near the jump tested
    again.
    """
    time_s = design_matrix.time_s
    is_near_jump = np.abs(time_s - jump.time_s) <= OUTLIER_BURST_DURATION_S
    is_after_jump = ~is_near_jump & _is_in_window(
        time_s, jump.time_s, OUTLIER_RETEST_DURATION_AFTER_JUMP_S
    )
    max_residual_square = chdtri(design_matrix.axis_count, MAX_FALSE_OUTLIER_PROBABILITY)

    def test_for_outliers(jump_time_s: float) -> BoolArray:
        """Return True for measurements that are outliers if the jump is at ``jump_time_s``."""
        fit, _ = design_matrix.fit_with_jump(jump_time_s, is_skipped | is_near_jump)
        return fit.compute_residual_squares() > max_residual_square

    # In the fit without the jump, correct measurements after the jump seemed to be outliers. They
    # are tested again with the jump in the fit
    is_skipped = np.where(is_after_jump, test_for_outliers(jump.time_s), is_skipped)
    # Of the times near the detected jump, keep those at which a jump has the largest χ². The fit
    # includes all measurements near the jump, because the outliers there are not known yet
    candidate_times_s = time_s[is_near_jump]
    is_skipped_away_from_jump = is_skipped & ~is_near_jump
    best_indices = np.argsort(
        -_compute_jump_chi_squares(
            design_matrix,
            design_matrix.fit(is_skipped_away_from_jump),
            is_skipped_away_from_jump,
            candidate_times_s,
        )
    )[:MAX_CANDIDATE_JUMP_TIMES]
    # With a jump at each of these times, test the measurements near the jump for outliers
    masks_and_jump_times = [
        (np.where(is_near_jump, test_for_outliers(jump_time_s), is_skipped), jump_time_s)
        for jump_time_s in candidate_times_s[best_indices].tolist()
    ]
    # With a wrong jump time, correct measurements seem to be outliers. The best jump time has the
    # fewest outliers
    is_skipped, best_jump_time_s = min(
        masks_and_jump_times, key=lambda mask_and_time: np.count_nonzero(mask_and_time[0])
    )
    regression, jump_columns = design_matrix.fit_with_jump(best_jump_time_s, is_skipped)
    step_m = tuple(map(regression.estimate, jump_columns))
    return replace(jump, time_s=best_jump_time_s, step_m=step_m), is_skipped


def _test_jump(
    design_matrix: DesignMatrix,
    is_skipped: BoolArray,
    jump_time_s: float,
    max_false_alarm_p: float,
) -> Jump | None:
    """Return a jump of the positions at a given time, or None if it is not significant.

    The false alarm probability of the χ² test is ``max_false_alarm_p``.
    """
    is_after_jump = design_matrix.time_s[~is_skipped] >= jump_time_s
    if (
        min(np.count_nonzero(is_after_jump), np.count_nonzero(~is_after_jump))
        < MIN_MEASUREMENTS_BEFORE_AND_AFTER_JUMP
    ):
        return None
    regression, jump_columns = design_matrix.fit_with_jump(jump_time_s, is_skipped)
    normalised_jump_size = regression.coefficients[jump_columns] / regression.residual_rms_by_axis
    chi_square = float(
        normalised_jump_size
        @ np.linalg.solve(
            regression.covariance[np.ix_(jump_columns, jump_columns)], normalised_jump_size
        )
    )
    if chi_square < chdtri(len(jump_columns), max_false_alarm_p):
        return None
    return Jump(jump_time_s, tuple(map(regression.estimate, jump_columns)), chi_square)


@dataclass(frozen=True)
class InnovationRegression:
    """Least squares fit of normalised innovations by the columns of a design matrix.

    Attributes
    ----------
    residual : ndarray, shape (axes, m)
        Normalised innovations minus the fit, also of measurements that are not used.
    coefficients, covariance : ndarray, shape (k,) and (k, k)
        Estimated errors, and their covariance.
    residual_and_prior_square_sum : float
        Sum of squared residuals, and of squared coefficients over prior variances.
    score : float
        Restricted negative log-likelihood of the innovations.
    residual_rms : float
        RMS of the residual; 1 if SIGMA_A and SIGMA_Z are correct.
    residual_rms_by_axis : ndarray, shape (axes,)
        RMS of the residual along each axis, but at least 1.
    gains : ndarray, shape (3, m)
        Innovation variance S (m²), position gain and velocity gain of KF.
    """

    residual: Array
    coefficients: Array
    covariance: Array
    residual_and_prior_square_sum: float
    score: float
    residual_rms: float
    residual_rms_by_axis: Array
    gains: Array

    def compute_residual_squares(self) -> Array:
        """Return the squared normalised residual of each measurement, summed over the axes.

        The expected RMS of the normalised residuals is 1. If the actual RMS is larger, they are
        divided by it.
        """
        return np.asarray(np.sum(self.residual**2, axis=0)) / max(self.residual_rms, 1.0) ** 2

    def estimate(self, column: int) -> Estimate:
        """Return the estimated error (such as a bias) of a design matrix column, and its σ.

        The expected RMS of the normalised residuals is 1. If the actual RMS is larger, σ is
        multiplied by it.
        """
        sigma = math.sqrt(self.covariance[column, column]) * max(self.residual_rms, 1.0)
        return Estimate(float(self.coefficients[column]), sigma)


@dataclass(frozen=True)
class DesignMatrix:
    """Regression of KF's innovations on systematic errors, such as biases and jumps.

    A column of the design matrix contains the innovations due to one error of size 1.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Timestamps of the measurements.
    preintegrated_inputs : PreintegratedMotion
        Inputs for which KF's innovations are computed; each column is one input. For each axis:
        flight data, then the effects of 1 m/s² forward accelerometer bias, 1 m/s² right
        accelerometer bias and 1 rad yaw of the position frame. Last columns, equal for all axes:
        slow acceleration errors, which are linear between knots in time. Each of these errors is 1
        m/s² at one knot and 0 at the others.
    prior_sigma : ndarray, shape (k,)
        Prior σ of the estimated errors, except jumps.
    """

    time_s: Array
    axis_count: int
    preintegrated_inputs: PreintegratedMotion
    prior_sigma: Array
    sigma_z_m: float
    sigma_a_m_s2: float
    jump_times_s: Sequence[float] = ()

    def fit_with_jump(
        self, jump_time_s: float, is_skipped: BoolArray
    ) -> tuple[InnovationRegression, list[int]]:
        """Fit KF's innovations with one more jump of the positions.

        Return also the column index of this jump in the design matrix, for each axis.
        """
        jump_times_s = [*self.jump_times_s, jump_time_s]
        # The jumps are the last columns: all jumps along the first axis, then along the next
        last_column = len(self.prior_sigma) - 1
        jump_columns = [
            last_column + len(jump_times_s) * (1 + axis) for axis in range(self.axis_count)
        ]
        return replace(self, jump_times_s=jump_times_s).fit(is_skipped), jump_columns

    def compute_normalised_innovations(
        self, dp: Array, dv: Array, measured_m: Array, gains: Array
    ) -> Array:
        """Run KF on several inputs; return normalised innovations ν/√S, one column per input.

        ``dp`` (m), ``dv`` (m/s) and ``measured_m`` have one row for each measurement and one column
        for each input. They may omit the first measurements. ``gains`` has the rows S (m²),
        position gain and velocity gain, with one column for each measurement.
        """
        preintegrated_inputs = replace(
            self.preintegrated_inputs,
            interval_s=self.preintegrated_inputs.interval_s[-len(dp) :],
            delta_position_m=dp,
            delta_velocity_m_s=dv,
            measurement_m=measured_m,
        )
        s, *state_gains = gains
        nu = compute_innovations_with_gains(preintegrated_inputs, *state_gains)
        return np.asarray(nu / np.sqrt(s)[:, None])

    def fit(self, is_skipped: BoolArray, scale: float = 1.0) -> InnovationRegression:
        """Fit the errors of IMU and positions to KF's innovations by least squares.

        The errors are accelerometer biases, yaw of the position frame, slow acceleration error and
        jumps of the positions. ``scale`` is a trial scale factor of the positions. The acceleration
        and SIGMA_A are multiplied by it, so that they match the positions. ``is_skipped`` is True
        for measurements that are not used; their residuals are also returned.
        """
        gains = compute_gains(
            self.preintegrated_inputs, scale * self.sigma_a_m_s2, self.sigma_z_m, is_skipped
        )
        normalised_innovations, columns = self.compute_innovations_and_design_matrix(gains, scale)
        sum_of_log_variances = self.axis_count * float(np.sum(np.log(gains[0, ~is_skipped])))
        is_used = np.tile(~is_skipped, self.axis_count)
        used_innovations, used_columns = normalised_innovations[is_used], columns[is_used]
        # Ridge regression: only the coefficients of the slowly varying acceleration error have a
        # prior. Constant errors and jumps have none
        prior_precision = np.zeros(columns.shape[1])
        prior_precision[: len(self.prior_sigma)] = self.prior_sigma**-2.0
        information = np.diag(prior_precision) + used_columns.T @ used_columns
        # A small diagonal prevents a singular matrix: in hover, a rotation of the source frame has
        # no effect on the innovations
        information += 1e-12 * np.diag(np.diag(information) + 1.0)
        right_hand_side = used_columns.T @ used_innovations
        information_factor = cho_factor(information)
        covariance = cho_solve(information_factor, np.eye(len(information)))
        coefficients = covariance @ right_hand_side
        # The regression minimises the sum of squared residuals and of squared coefficients over
        # prior variances. With the model y = A x, the minimum is yᵀy - xᵀAᵀy
        square_sum = float(used_innovations @ used_innovations - coefficients @ right_hand_side)
        log_determinant = 2.0 * float(np.sum(np.log(np.diag(information_factor[0]))))
        degrees_of_freedom = max(len(used_innovations) - CONSTANT_ERROR_COLUMN_COUNT, 1)
        residual = (normalised_innovations - columns @ coefficients).reshape(self.axis_count, -1)
        mean_squares = np.mean(residual[:, ~is_skipped] ** 2, axis=1)
        return InnovationRegression(
            residual,
            coefficients,
            covariance,
            residual_and_prior_square_sum=square_sum,
            score=0.5 * (square_sum + sum_of_log_variances + log_determinant),
            residual_rms=math.sqrt(max(square_sum, 0.0) / degrees_of_freedom),
            residual_rms_by_axis=np.sqrt(np.maximum(mean_squares, 1.0)),
            gains=gains,
        )

    def compute_innovations_and_design_matrix(self, gains: Array, scale: float = 1.0) -> ArrayPair:
        """Return KF's normalised innovations ν/√S, and the design matrix of their regression.

        Each column of the design matrix contains the normalised innovations due to one error of
        size 1. Its shape is (axes · m, k): measurements along the first axis, then those along the
        next axis.
        """
        inputs, axis_count = self.preintegrated_inputs, self.axis_count
        axis_input_count = INPUTS_PER_AXIS * axis_count
        # The scale factor multiplies the inputs that are computed from measured acceleration. For
        # each axis, these are the flight data (column 0 of the axis) and the effect of a yaw error
        input_scale_factors = np.ones(inputs.measurement_m.shape[1])
        factors_by_axis = input_scale_factors[:axis_input_count].reshape(axis_count, -1)  # a view
        factors_by_axis[:, [0, 1 + FRAME_ROTATION_COLUMN]] = scale
        unit_steps = make_unit_steps(self.time_s, self.jump_times_s)
        zero_increments = np.zeros_like(unit_steps)
        responses = self.compute_normalised_innovations(
            np.hstack([input_scale_factors * inputs.delta_position_m, zero_increments]),
            np.hstack([input_scale_factors * inputs.delta_velocity_m_s, zero_increments]),
            np.hstack([inputs.measurement_m, unit_steps]),
            gains,
        )
        # Each column of the responses contains the innovations due to one input: flight data and
        # constant errors of each axis, then slow acceleration errors, then jumps
        axis_responses, slow_error_responses, jump_responses = np.split(
            responses, [axis_input_count, len(input_scale_factors)], axis=1
        )
        # All axes have the same constant errors, so their responses are stacked: the rows of each
        # axis follow those of the previous axis. Column 0 is the flight data, the others are the
        # constant errors
        stacked_responses = np.vstack(np.split(axis_responses, axis_count, axis=1))
        # Slow errors and jumps of an axis have no effect on the other axis
        columns = [
            stacked_responses[:, 1:],
            np.kron(np.eye(axis_count), slow_error_responses),
            np.kron(np.eye(axis_count), jump_responses),
        ]
        return stacked_responses[:, 0], np.hstack(columns)


def make_design_matrix(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    clock_offset_s: float,
) -> DesignMatrix | Unavailable:
    """Make the design matrix for the regression of KF's innovations on systematic errors.

    The errors are accelerometer biases, yaw of the position frame, and a slow acceleration error
    along each axis. Jumps of the positions are added later. ``clock_offset_s`` is added to the
    timestamps of the positions.
    """
    acceleration, attitude = axes[0].acceleration, flight.attitude
    if isinstance(acceleration, Unavailable):
        return acceleration
    if isinstance(attitude, Unavailable):
        return attitude
    if (count := len(axes[0].measurement_time_s)) <= MIN_MEASUREMENTS:
        return report_too_few_measurements(ANALYSIS_NAME, count, MIN_MEASUREMENTS)
    settings = replace(settings, input="imu")
    time_shifted_axes = [
        replace(axis, measurement_time_s=axis.measurement_time_s + clock_offset_s) for axis in axes
    ]
    prediction_steps = make_prediction_steps(time_shifted_axes[0], settings)
    preintegrated_motions = [preintegrate(axis, settings) for axis in time_shifted_axes]
    time_s = axes[0].measurement_time_s[-len(preintegrated_motions[0].measurement_m) :]

    def integrate_between_measurements(velocity_error_m_s: Array, error_time_s: Array) -> ArrayPair:
        velocity_m_s = np.interp(prediction_steps.time_s, error_time_s, velocity_error_m_s)
        return integrate_acceleration(
            prediction_steps, np.diff(velocity_m_s) / np.diff(prediction_steps.time_s)
        )

    velocity_errors_per_unit_bias_and_yaw = _integrate_unit_errors(attitude, acceleration)
    # Inputs of KF in the order of DesignMatrix.preintegrated_inputs: Δp (m) and Δv (m/s) between
    # the measurements, and positions (m). Only the flight data contain positions
    zeros = np.zeros(len(time_s))
    inputs: list[tuple[Array, Array, Array]] = []
    for axis, motion in zip(axes, preintegrated_motions, strict=True):
        inputs.append((motion.delta_position_m, motion.delta_velocity_m_s, motion.measurement_m))
        inputs += [
            (*integrate_between_measurements(velocity_m_s @ axis.direction, error_time_s), zeros)
            for error_time_s, velocity_m_s in velocity_errors_per_unit_bias_and_yaw
        ]
    # The slow acceleration error is piecewise linear. Its basis functions are triangles: 1 m/s² at
    # one knot, 0 at the others. They are sampled 20 times per interval between knots
    slow_error_knot_interval_count = int(
        np.clip(
            np.ceil((time_s[-1] - time_s[0]) / SLOW_ERROR_KNOT_SPACING_S), 1, MAX_SLOW_ERROR_KNOTS
        )
    )
    slow_error_time_s = np.linspace(time_s[0], time_s[-1], 20 * slow_error_knot_interval_count + 1)
    slow_error_time_s += clock_offset_s
    for knot_values in np.eye(slow_error_knot_interval_count + 1):
        slow_error = np.interp(slow_error_time_s, slow_error_time_s[::20], knot_values)
        velocity_m_s = integrate_cumulatively(slow_error, slow_error_time_s)
        inputs.append((*integrate_between_measurements(velocity_m_s, slow_error_time_s), zeros))
    # Shape (measurements, inputs)
    dp, dv, measured_m = np.transpose(inputs, (1, 2, 0))
    preintegrated_inputs = replace(
        preintegrated_motions[0],
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        measurement_m=measured_m,
        # One process noise for all axes: the mean
        process_noise_independent_of_sigma_a=np.mean(
            [motion.process_noise_independent_of_sigma_a for motion in preintegrated_motions],
            axis=0,
        ),
    )
    prior_sigma = np.full(
        CONSTANT_ERROR_COLUMN_COUNT + len(axes) * (slow_error_knot_interval_count + 1),
        TILT_PRIOR_SIGMA_RAD * constants.g,
    )
    prior_sigma[:CONSTANT_ERROR_COLUMN_COUNT] = np.inf
    return DesignMatrix(
        time_s, len(axes), preintegrated_inputs, prior_sigma, sigma_z_m, sigma_a_m_s2
    )


def _integrate_unit_errors(attitude: pd.DataFrame, acceleration: Acceleration) -> list[ArrayPair]:
    """Return velocity errors (NED) due to 1 m/s² forward bias, 1 m/s² right bias and 1 rad yaw.

    Each of the three errors is a pair: times (s), and velocity errors (m/s) at these times.
    """
    attitude_time_s = attitude.index.to_numpy()
    body_to_ned = to_rotation_matrix(interpolate_attitude(attitude, attitude_time_s))
    north, east, _ = acceleration.acceleration_integral_m_s
    return [
        *(
            (attitude_time_s, integrate_cumulatively(body_to_ned[:, :, column], attitude_time_s))
            for column in (FORWARD_BIAS_COLUMN, RIGHT_BIAS_COLUMN)
        ),
        (acceleration.time_s, np.stack([-east, north, 0.0 * north]).T),
    ]


def make_unit_steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Return steps from 0 to 1 at the times ``starts_s``, shape (times, steps)."""
    return (time_s[:, None] >= [*starts_s]).astype(np.float64)
