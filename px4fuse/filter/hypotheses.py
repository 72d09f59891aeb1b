"""Biases, scale factor error and jumps that explain the innovations better than noise.

The filter is linear: a known signal added to the measurements or to the acceleration adds the
filter's response to the innovations. Each hypothesis is therefore a column, the response of the
innovations to its unit. Generalised least squares (whitened by √S) gives its size,
its standard deviation and its likelihood (generalised likelihood ratio, Willsky and Jones 1976).
Effects that could be confused with it are fitted too: constant accelerometer biases, a rotation of
the frame, and a slow acceleration error as caused by tilt.

A scale factor also multiplies the noise of the acceleration, which would bias its regression
(errors in variables). So the residuals are weighted with their variance at each scale (Deming
1943).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from px4fuse.arrays import Array, BoolArray, IntArray, cumulative_integral
from px4fuse.filter.likelihood import (
    Preintegrated,
    innovations,
    integrate_acceleration,
    parabola_vertex,
    preintegrate,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, ned_acceleration, too_few_measurements
from px4fuse.filter.steps import Timeline, make_timeline
from px4fuse.flight import Columns, Flight, Unavailable
from px4fuse.notebook_display import one_line_repr

ANALYSIS_NAME = "causes beyond noise"
MIN_MEASUREMENTS = 50
# rad RMS, and s: slow error of the logged attitude, and spacing of its independent values
TILT_SIGMA_RAD = 0.002
KNOT_SPACING_S = 15.0
MAX_KNOTS = 40
FORWARD, RIGHT, ROTATION = range(3)
CONSTANT_COUNT = 3
# Factors on KF's SIGMA_A: without biases and tilt, less acceleration noise remains
SIGMA_A_FACTORS = np.geomspace(0.2, 2.0, 7)
SCALE_GRID = np.linspace(0.7, 1.3, 7)
# Limit of the number of times at which a step is tested
MAX_STEP_TIMES = 800
# Step times per batch; limits the memory of the responses
STEP_BATCH_SIZE = 200
# s; measurements in this time after a step are ignored, so that a burst of outliers is not a step
OUTLIER_BURST_S = 1.0
# s; outliers in this time after a step are tested again as measurements after the step
OUTLIERS_AFTER_STEP_S = 6.0
# Probability of a detected step in a flight without one
STEP_FALSE_ALARM_P = 1e-3
# Probability that a good measurement near a step is taken for an outlier; tested step times
FALSE_OUTLIER_P, MAX_TRIED_TIMES = 1e-3, 6
MAX_JUMPS = 3
MIN_BIAS_M_S2 = 0.2  # half of EKF2's own limit, EKF2_ABL_LIM
MIN_BIAS_SIGMAS = 4.0  # false alarm probability 6e-5
# Measurements required on each side of a step
MIN_SIDE_MEASUREMENTS = 8


@dataclass(frozen=True)
class Estimate:
    """Value with its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Jump:
    """Lasting step of the source: time (s), size along each axis (m), and its χ²."""

    time_s: float
    step_m: tuple[Estimate, ...]
    chi_square: float

    @property
    def size_m(self) -> float:
        """Length of the step (m)."""
        return float(np.hypot.reduce([step.value for step in self.step_m]))


@dataclass(frozen=True)
class BiasScaleJumpFit:
    """Biases, scale factor error and jumps, fitted to the innovations of horizontal axes.

    Attributes
    ----------
    forward_bias, right_bias : Estimate
        Accelerometer bias (m/s²), body axes. At constant heading a constant tilt is equivalent.
    rotation : Estimate
        Rotation of the source's frame relative to the attitude (rad, clockwise from above),
        fitted together with the biases.
    scale : Estimate
        Ratio of the source's distances to the IMU's distances, minus 1.
    jumps : tuple of Jump
    sigma_a_m_s2 : float
        Remaining white noise of the acceleration.
    """

    forward_bias: Estimate
    right_bias: Estimate
    rotation: Estimate
    scale: Estimate
    jumps: tuple[Jump, ...]
    sigma_a_m_s2: float

    __repr__ = one_line_repr

    @property
    def bias(self) -> Estimate:
        """Magnitude of both biases together (m/s²)."""
        forward, right = self.forward_bias, self.right_bias
        return Estimate(
            math.hypot(forward.value, right.value), math.hypot(forward.sigma, right.sigma)
        )

    @property
    def has_bias(self) -> bool:
        """True if the bias exceeds 0.2 m/s² and 4 σ."""
        return self.bias.value >= max(MIN_BIAS_M_S2, MIN_BIAS_SIGMAS * self.bias.sigma)


def bias_scale_jump_fit(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    clock_offset_s: float,
) -> BiasScaleJumpFit | Unavailable:
    """Estimate accelerometer biases and scale factor error, and detect jumps of the source.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    settings : Settings
        Its ``dt_s`` defines the unit of SIGMA_A.
    sigma_a_m_s2, sigma_z_m : float
        KF's maximum-likelihood noises.
    outlier_time_s : ndarray
        Timestamps of measurements to exclude.
    clock_offset_s : float
        Time offset added to the timestamps.

    Returns
    -------
    BiasScaleJumpFit, or Unavailable without acceleration or with too few measurements.
    """
    model = make_design_matrix(flight, axes, settings, sigma_z_m, clock_offset_s)
    if isinstance(model, Unavailable):
        return model
    skip = np.isin(axes[0].measurement_time_s[-len(model.time_s) :], outlier_time_s)
    if (count := int(np.count_nonzero(~skip))) < MIN_MEASUREMENTS:
        return too_few_measurements(ANALYSIS_NAME, count, MIN_MEASUREMENTS)
    sigma_a_grid = sigma_a_m_s2 * SIGMA_A_FACTORS
    sigma_a, fit = _fit_sigma_a(model, sigma_a_grid, skip)
    jumps, skip = _find_jumps(model, sigma_a, skip)
    if jumps:
        model = replace(
            model, step_columns=unit_steps(model.time_s, [jump.time_s for jump in jumps])
        )
        sigma_a, fit = _fit_sigma_a(model, sigma_a_grid, skip)
    forward, right, turn = map(fit.estimate, (FORWARD, RIGHT, ROTATION))
    return BiasScaleJumpFit(forward, right, turn, _fit_scale(model, sigma_a, skip), jumps, sigma_a)


def _fit_sigma_a(
    model: DesignMatrix, sigma_a_grid: Array, skip: BoolArray
) -> tuple[float, DesignFit]:
    """Return the maximum-likelihood SIGMA_A of a grid, and the fit with it."""
    fit_at = cache(lambda index: model.fit(float(sigma_a_grid[index]), skip))
    best_index = _index_of_minimum(lambda index: fit_at(index).score, len(sigma_a_grid))
    return float(sigma_a_grid[best_index]), fit_at(best_index)


def _index_of_minimum(score: Callable[[int], float], count: int) -> int:
    """Return the index of the minimum of a unimodal sequence, searched from its middle."""
    index = count // 2
    step = 1 if index + 1 < count and score(index + 1) < score(index) else -1
    while 0 <= index + step < count and score(index + step) < score(index):
        index += step
    return index


def _fit_scale(model: DesignMatrix, sigma_a: float, skip: BoolArray) -> Estimate:
    """Estimate the scale factor error from the likelihood on a grid, corrected for rotation."""
    fit_at = cache(lambda at: model.fit(sigma_a, skip, float(SCALE_GRID[at])))
    # without ln S: it grows with the scale and would bias the estimate towards zero
    lowest_index = _index_of_minimum(lambda at: fit_at(at).square_sum, len(SCALE_GRID))
    at = int(np.clip(lowest_index, 1, len(SCALE_GRID) - 2))
    scores = np.array([fit_at(neighbour).square_sum / 2.0 for neighbour in (at - 1, at, at + 1)])
    shift, curvature = parabola_vertex(scores, 1)
    step = float(SCALE_GRID[1] - SCALE_GRID[0])
    if curvature <= 0.0:
        return Estimate(0.0, float("inf"))
    scale = SCALE_GRID[at] + float(np.clip(shift, -1.5, 1.5)) * step
    sigma = step / np.sqrt(curvature) * max(fit_at(at).residual_rms, 1.0)
    rotation_factor = np.hypot(1.0, fit_at(at).coefficients[ROTATION])
    return Estimate(float(scale * rotation_factor - 1.0), float(sigma))


def _find_jumps(
    model: DesignMatrix, sigma_a: float, skip: BoolArray
) -> tuple[tuple[Jump, ...], BoolArray]:
    """Detect lasting jumps of the source; return them in time order, and the outliers.

    Candidate times are from a scan over all times and from the starts of outlier runs, since a jump
    begins with one. Each is tested without the measurements of the next second, so that a burst of
    outliers is not a jump. The exact time, on which the size depends, is found last.
    """
    jumps: list[Jump] = []
    for _ in range(MAX_JUMPS):
        model = replace(
            model, step_columns=unit_steps(model.time_s, [jump.time_s for jump in jumps])
        )
        outlier_run_starts = model.time_s[
            np.flatnonzero(skip & ~np.concatenate([[False], skip[:-1]]))
        ]
        candidate_times = [
            *_significant_step_times(model, sigma_a, skip, outlier_run_starts),
            *_significant_step_times(model, sigma_a, skip)[:1],
        ]
        chance = STEP_FALSE_ALARM_P / max(len(outlier_run_starts), 1)
        candidates = [
            _test_step(model, sigma_a, skip, time_s, chance) for time_s in candidate_times
        ]
        significant = [jump for jump in candidates if jump is not None]
        if not significant:
            break
        best_jump, skip = _locate_jump(
            model, sigma_a, skip, max(significant, key=lambda jump: jump.chi_square)
        )
        jumps.append(best_jump)
    return tuple(sorted(jumps, key=lambda jump: jump.time_s)), skip


def _is_in_window(time_s: Array, start_s: float, length_s: float) -> BoolArray:
    return np.asarray((time_s >= start_s) & (time_s < start_s + length_s))


def _significant_step_times(
    model: DesignMatrix, sigma_a: float, skip: BoolArray, times: Array | None = None
) -> list[float]:
    """Return the times of significant steps, largest χ² first; default: all times."""
    if times is None:
        times = model.time_s[MIN_SIDE_MEASUREMENTS:-MIN_SIDE_MEASUREMENTS]
        times = times[:: max(1, -(-len(times) // MAX_STEP_TIMES))]
    if not len(times):
        return []
    chi_square = _step_chi_squares(model, sigma_a, skip, times)
    threshold = chdtri(len(model.intervals), STEP_FALSE_ALARM_P / len(model.time_s))
    order = np.argsort(-chi_square)
    return [float(times[index]) for index in order if chi_square[index] >= threshold]


def _step_chi_squares(model: DesignMatrix, sigma_a: float, skip: BoolArray, times: Array) -> Array:
    """Compute χ² of a step at each time: the reduction of the squares, summed over axes."""
    data, columns, log_s = model.whitened_design(sigma_a, skip)
    base_fit = model.regress(data, columns, log_s, skip)
    chi_square = np.zeros(len(times))
    for batch in np.array_split(np.arange(len(times)), -(-len(times) // STEP_BATCH_SIZE)):
        step_signals = unit_steps(model.time_s, times[batch])
        for axis, intervals in enumerate(model.intervals):
            if axis in (axis_group[0] for axis_group in model.axis_groups):
                zero_signal = np.broadcast_to(0.0, step_signals.shape)
                step_interval = _replace_signals(intervals, zero_signal, zero_signal, step_signals)
                response = model.whitened(step_interval, sigma_a, skip)[0][~skip]
            residual, cross_product = (
                base_fit.residual[base_fit.axis == axis],
                columns[axis][~skip].T @ response,
            )
            information = np.sum(response**2, axis=0) - np.sum(
                cross_product * (base_fit.covariance @ cross_product), axis=0
            )
            chi_square[batch] += (residual @ response / base_fit.axis_rms[axis]) ** 2 / np.maximum(
                information, 1e-9
            )
    return chi_square


def _locate_jump(
    model: DesignMatrix, sigma_a: float, skip: BoolArray, jump: Jump
) -> tuple[Jump, BoolArray]:
    """Find the exact time of a jump near its candidate; return it with size and outliers."""
    is_near = np.abs(model.time_s - jump.time_s) <= OUTLIER_BURST_S
    # without the uncertain interval, later measurements that agree with the step are not outliers
    chi_square = model.with_step(jump.time_s)[0].residual_squares(sigma_a, skip | is_near)
    is_after = is_near | _is_in_window(model.time_s, jump.time_s, OUTLIERS_AFTER_STEP_S)
    skip = np.where(
        is_after & ~is_near, chi_square > chdtri(len(model.intervals), FALSE_OUTLIER_P), skip
    )
    times = model.time_s[is_near]
    best_indices = np.argsort(-_step_chi_squares(model, sigma_a, skip & ~is_near, times))[
        :MAX_TRIED_TIMES
    ]
    placements = []
    for candidate_s in times[best_indices].tolist():
        chi_square = model.with_step(candidate_s)[0].residual_squares(sigma_a, skip | is_near)
        placements.append(
            (
                candidate_s,
                np.where(is_near, chi_square > chdtri(len(model.intervals), FALSE_OUTLIER_P), skip),
            )
        )
    # an outlier near a step looks like a step; the true time leaves the fewest outliers
    time_s, skip = min(placements, key=lambda placement: np.count_nonzero(placement[1]))
    stepped_model, columns = model.with_step(time_s)
    design_fit = stepped_model.fit(sigma_a, skip)
    step_m = tuple(design_fit.estimate(int(column)) for column in columns)
    return replace(jump, time_s=time_s, step_m=step_m), skip


def _test_step(
    model: DesignMatrix, sigma_a: float, skip: BoolArray, time_s: float, chance: float
) -> Jump | None:
    """Return the jump at a time if it is significant without the next second, else None."""
    skip_with_burst = skip | _is_in_window(model.time_s, time_s, OUTLIER_BURST_S)
    model, columns = model.with_step(time_s)
    count_before = np.count_nonzero(~skip_with_burst & (model.time_s < time_s))
    if (
        min(count_before, np.count_nonzero(~skip_with_burst & (model.time_s >= time_s)))
        < MIN_SIDE_MEASUREMENTS
    ):
        return None
    design_fit = model.fit(sigma_a, skip_with_burst)
    size, covariance = (
        design_fit.coefficients[columns],
        design_fit.covariance[np.ix_(columns, columns)],
    )
    size = size / design_fit.axis_rms
    chi_square = float(size @ np.linalg.solve(covariance, size))
    if chi_square < chdtri(len(columns), chance):
        return None
    return Jump(time_s, tuple(design_fit.estimate(int(column)) for column in columns), chi_square)


@dataclass(frozen=True)
class DesignFit:
    """Generalised least squares of whitened innovations on the columns of a design matrix.

    Attributes
    ----------
    axis : ndarray of int, shape (n,)
        Axis of each row, sorted by axis.
    residual : ndarray, shape (n,)
        Residual of the whitened innovations.
    coefficients, covariance : ndarray, shape (k,) and (k, k)
    square_sum : float
        Residual sum of squares, including the prior's term.
    score : float
        Restricted negative log-likelihood.
    residual_rms : float
        Root mean square of the residual; 1 for correct noises.
    """

    axis: IntArray
    residual: Array
    coefficients: Array
    covariance: Array
    square_sum: float
    score: float
    residual_rms: float

    @property
    def axis_rms(self) -> Array:
        """Root mean square of the residual along each axis, at least 1."""
        mean_square = np.bincount(self.axis, self.residual**2) / np.bincount(self.axis)
        return np.sqrt(np.maximum(mean_square, 1.0))

    def estimate(self, column: int) -> Estimate:
        """Return one coefficient; its σ is widened if the residual exceeds the assumed noise."""
        sigma = float(np.sqrt(self.covariance[column, column])) * max(self.residual_rms, 1.0)
        return Estimate(float(self.coefficients[column]), sigma)


@dataclass(frozen=True)
class DesignMatrix:
    """Innovations of all axes and the columns that are common to all hypotheses.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Timestamps of the measurements.
    intervals : tuple of Preintegrated
        Signals of each axis: the measurements, then the effect of each constant.
    hat_signals : (ndarray, ndarray), shape (m, h)
        Position and velocity due to slow accelerations, with separate coefficients per axis.
    prior_sigma : ndarray, shape (k,)
        Prior standard deviations of the coefficients, without the steps.
    sigma_z_m : float
    step_columns : ndarray, shape (m, j)
        Unit steps added to the measurements: j more columns per axis.
    """

    time_s: Array
    intervals: tuple[Preintegrated, ...]
    hat_signals: tuple[Array, Array]
    prior_sigma: Array
    sigma_z_m: float
    step_columns: Array

    def with_step(self, time_s: float) -> tuple[DesignMatrix, IntArray]:
        """Return the design matrix with one more step, and the step's column of each axis."""
        model = replace(
            self, step_columns=np.hstack([self.step_columns, unit_steps(self.time_s, [time_s])])
        )
        first_step_column, count = len(self.prior_sigma), model.step_columns.shape[1]
        return model, first_step_column + count * (1 + np.arange(len(self.intervals))) - 1

    @cached_property
    def axis_groups(self) -> list[list[int]]:
        """Axes that share a filter: all, unless gaps in the IMU affect them differently."""
        has_same_filter = all(
            np.array_equal(intervals.noise_fixed, self.intervals[0].noise_fixed)
            for intervals in self.intervals
        )
        all_axes = list(range(len(self.intervals)))
        return [all_axes] if has_same_filter else [[axis] for axis in all_axes]

    def whitened(
        self, intervals: Preintegrated, sigma_a: float, skip: BoolArray
    ) -> tuple[Array, float]:
        """Return innovations divided by √S for k signals, (m, k), and Σ ln S of those used."""
        nu, s = innovations(intervals, sigma_a, self.sigma_z_m, skip)
        nu /= np.sqrt(s)[:, None]
        return nu, float(np.sum(np.log(s[~skip])))

    def fit(self, sigma_a: float, skip: BoolArray, scale: float = 1.0) -> DesignFit:
        """Fit all columns with a scale factor on the acceleration and its noise.

        Parameters
        ----------
        sigma_a : float
        skip : ndarray of bool, shape (m,)
            Measurements to exclude from filter and fit.
        scale : float
        """
        return self.regress(*self.whitened_design(sigma_a, skip, scale), skip)

    def regress(self, data: Array, columns: Array, log_s: float, skip: BoolArray) -> DesignFit:
        """Fit the output of :meth:`whitened_design` without the skipped measurements."""
        axis = np.repeat(np.arange(len(data)), np.count_nonzero(~skip))
        data, columns = data[:, ~skip].ravel(), columns[:, ~skip].reshape(len(axis), -1)
        count = columns.shape[1]
        prior_sigma = np.append(self.prior_sigma, np.full(count - len(self.prior_sigma), np.inf))
        information = np.diag(prior_sigma**-2.0) + columns.T @ columns
        # a column without excitation (rotation in hover) must not make the matrix singular
        information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(count)
        moment, factor = columns.T @ data, cho_factor(information)
        covariance = cho_solve(factor, np.eye(count))
        coefficients = covariance @ moment
        square_sum = float(data @ data - coefficients @ moment)
        score = 0.5 * (square_sum + log_s) + float(np.sum(np.log(np.diag(factor[0]))))
        residual_rms = float(np.sqrt(max(square_sum, 0.0) / max(len(data) - CONSTANT_COUNT, 1)))
        residual = data - columns @ coefficients
        return DesignFit(axis, residual, coefficients, covariance, square_sum, score, residual_rms)

    def residual_squares(self, sigma_a: float, skip: BoolArray) -> Array:
        """Return the squared residual of every measurement over its variance, axes summed."""
        data, columns, log_s = self.whitened_design(sigma_a, skip)
        fit = self.regress(data, columns, log_s, skip)
        residual = data - columns @ fit.coefficients
        return np.asarray(np.sum(residual**2, axis=0)) / max(fit.residual_rms, 1.0) ** 2

    def whitened_design(
        self, sigma_a: float, skip: BoolArray, scale: float = 1.0
    ) -> tuple[Array, Array, float]:
        """Return whitened innovations (a, m) and columns (a, m, k) of all axes, and Σ ln S."""
        hat_count, step_count, axes = (
            self.hat_signals[0].shape[1],
            self.step_columns.shape[1],
            len(self.intervals),
        )
        width = len(self.prior_sigma)
        data = np.empty((axes, len(skip)))
        columns = np.zeros((axes, len(skip), width + axes * step_count))
        # scale the measured and the rotated acceleration to the source's unit of length
        factor = np.ones(1 + CONSTANT_COUNT)
        factor[[0, 1 + ROTATION]] = scale
        zero_signal, log_s = np.zeros_like(self.hat_signals[0]), 0.0
        for axis_group in self.axis_groups:
            intervals = [self.intervals[axis] for axis in axis_group]
            dp = [*(factor * array.delta_position_m for array in intervals), self.hat_signals[0]]
            dv = [*(factor * array.delta_velocity_m_s for array in intervals), self.hat_signals[1]]
            measurements = [
                *(array.measurement_m for array in intervals),
                zero_signal,
                self.step_columns,
            ]
            dp, dv = ([*array, 0.0 * self.step_columns] for array in (dp, dv))
            group_signals = _replace_signals(intervals[0], *map(np.hstack, (dp, dv, measurements)))
            normalised, group_log_s = self.whitened(group_signals, scale * sigma_a, skip)
            log_s += len(axis_group) * group_log_s
            *axis_signals, common = np.split(
                normalised, len(factor) * np.arange(1, 1 + len(intervals)), 1
            )
            for axis, signals in zip(axis_group, axis_signals, strict=True):
                data[axis] = signals[:, 0]
                first_hat, first_step = CONSTANT_COUNT + hat_count * axis, width + step_count * axis
                columns[axis][:, :CONSTANT_COUNT] = signals[:, 1:]
                common_columns = np.r_[
                    first_hat : first_hat + hat_count, first_step : first_step + step_count
                ]
                columns[axis][:, common_columns] = common
        return data, columns, log_s


def _replace_signals(
    intervals: Preintegrated, dp: Array, dv: Array, measured_m: Array
) -> Preintegrated:
    return replace(intervals, delta_position_m=dp, delta_velocity_m_s=dv, measurement_m=measured_m)


def make_design_matrix(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    sigma_z: float,
    clock_offset_s: float,
) -> DesignMatrix | Unavailable:
    """Build the design matrix of the columns that all hypotheses share.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    settings : Settings
        Its ``dt_s`` defines the unit of SIGMA_A.
    sigma_z : float
        Measurement noise (m).
    clock_offset_s : float
        Time offset added to the timestamps.
    """
    acceleration, attitude = ned_acceleration(flight), flight.attitude
    for input_data in (acceleration, axes[0].acceleration, attitude):
        if isinstance(input_data, Unavailable):
            return input_data
    assert isinstance(acceleration, pd.DataFrame)
    assert isinstance(attitude, pd.DataFrame)
    if len(axes[0].measurement_time_s) <= MIN_MEASUREMENTS:
        return too_few_measurements(
            ANALYSIS_NAME, len(axes[0].measurement_time_s), MIN_MEASUREMENTS
        )
    time_s = axes[0].measurement_time_s + clock_offset_s
    shifted = [replace(axis, measurement_time_s=time_s) for axis in axes]
    settings = replace(settings, input="imu")
    line = make_timeline(shifted[0], settings)
    common = _common_accelerations(attitude, acceleration)
    intervals = []
    for axis in shifted:
        interval_input = preintegrate(axis, settings)
        columns = [(interval_input.delta_position_m, interval_input.delta_velocity_m_s)]
        columns += [
            _integrate_signal(value @ axis.direction, input_time_s, line)
            for input_time_s, value in common
        ]
        dp, dv = (np.stack(arrays, axis=1) for arrays in zip(*columns, strict=True))
        measured = np.zeros_like(dp)
        # KF starts at the first measurement
        measured[:, 0] = interval_input.measurement_m - interval_input.initial.position_m
        start = replace(interval_input.initial, position_m=0.0)
        intervals.append(replace(_replace_signals(interval_input, dp, dv, measured), initial=start))
    time_s = axes[0].measurement_time_s[-len(measured) :]
    hat_time_s, hat_functions = _hat_functions(
        time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s
    )
    hat_responses = [_integrate_signal(hat, hat_time_s, line) for hat in hat_functions]
    position, velocity = (np.stack(arrays, axis=1) for arrays in zip(*hat_responses, strict=True))
    tilt = np.full(len(axes) * len(hat_functions), TILT_SIGMA_RAD * constants.g)
    prior_sigma = np.append(np.full(CONSTANT_COUNT, np.inf), tilt)
    return DesignMatrix(
        time_s, tuple(intervals), (position, velocity), prior_sigma, sigma_z, unit_steps(time_s, [])
    )


def _integrate_signal(
    acceleration_m_s2: Array, time_s: ArrayLike, line: Timeline
) -> tuple[Array, Array]:
    """Integrate an acceleration to Δp (m) and Δv (m/s) between the measurements."""
    time = np.asarray(time_s, dtype=np.float64)
    velocity = np.interp(line.time_s, time, cumulative_integral(acceleration_m_s2, time))
    return integrate_acceleration(line, np.diff(velocity) / np.diff(line.time_s))


def _common_accelerations(
    attitude: pd.DataFrame, acceleration: pd.DataFrame
) -> list[tuple[pd.Index, Array]]:
    """Return NED accelerations, with times: minus unit biases forward and right, and rotation."""
    quaternions = attitude[Columns.QUATERNION].to_numpy(copy=True)
    body_to_ned = Rotation.from_quat(quaternions, scalar_first=True)
    biases = [(attitude.index, body_to_ned.apply(np.eye(3)[axis])) for axis in (FORWARD, RIGHT)]
    north, east, _ = acceleration.to_numpy().T
    return [*biases, (acceleration.index, np.column_stack([-east, north, 0.0 * north]))]


def _hat_functions(start_s: float, end_s: float) -> tuple[Array, Array]:
    """Return times (s) and hat functions (h, n) between knots, which model a slow signal."""
    count = int(np.clip(np.ceil((end_s - start_s) / KNOT_SPACING_S), 1, MAX_KNOTS)) + 1
    time = np.linspace(start_s, end_s, 20 * (count - 1) + 1)
    knots = np.linspace(start_s, end_s, count)
    return time, np.array([np.interp(time, knots, weights) for weights in np.eye(count)])


def unit_steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Return unit steps at ``starts_s``, sampled at ``time_s``: shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
