"""Patterns in the errors of a position source, such as timestamp jitter.

White noise is measured as the deviation of each position from a cubic polynomial through its four
neighbours. Slowly varying (time-correlated) errors are found only with ground truth.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from px4fuse.core.arrays import (
    Array,
    compute_median_interval_s,
    integrate_cumulatively,
    interpolate_columns,
    rank_correlation,
)
from px4fuse.filter.signals import interpolate_attitude
from px4fuse.flight.model import Columns, Ekf2, Unavailable, rows_between
from px4fuse.trajectory.rotation import conjugate, multiply, to_rotation_vector
from px4fuse.trajectory.scores import compute_autocorrelation_time

from .model import Comparison

MIN_POSITIONS = 100
# Rows of the four neighbours of a position, relative to the row of the position
NEIGHBOUR_ROW_OFFSETS = np.array([-2, -1, 1, 2])
# Maximum time span of the four neighbours of a position ÷ median interval, to exclude gaps
MAX_NEIGHBOUR_SPAN_IN_MEDIAN_INTERVALS = 8.0
# Maximum σ of a residual (position - interpolation) ÷ σ of a position: above this ratio, the
# interpolation is inaccurate
MAX_RESIDUAL_TO_POSITION_SIGMA_RATIO = 4.0
# Number of timestamps in the running median that gives the timestamps without jitter
TIMESTAMP_MEDIAN_FILTER_LENGTH = 9
VELOCITY_HALF_WINDOW_S = 0.3
# Neighbouring residuals are correlated: this number of residuals counts as one independent residual
RESIDUAL_CORRELATION_LENGTH = 3
# Minimum reported timestamp jitter (s, 1 σ): a position error of 8 mm at 1 m/s
MIN_JITTER_S = 0.008
# Detection of timestamp jitter: a timestamp error causes a position residual of -timestamp error ·
# velocity. The ratio of measured to expected position residuals must be between these limits
RESIDUAL_TO_JITTER_ERROR_RATIO_LIMITS = 0.6, 1.5
# Detection of timestamp jitter: minimum RMS of the position residuals that the jitter causes ÷ RMS
# of all position residuals
MIN_JITTER_FRACTION_OF_RESIDUAL = 0.4
# Timestamp jitter, and position noise that increases with speed, are reported only above this
# multiple of their σ
MIN_SIGNIFICANCE_SIGMAS = 6.0
# Number of flight parts in which the correlation of position noise with speed is tested
FLIGHT_PART_COUNT = 5
# Minimum correlation of position noise and speed ÷ σ of the correlation (median over the flight
# parts)
MIN_NOISE_SPEED_CORRELATION_SIGMAS = 1.2
# Slow flight is below the first of these quantiles of the speed, fast flight above the second
SLOW_SPEED_QUANTILE, FAST_SPEED_QUANTILE = 0.3, 0.7
MIN_FAST_TO_SLOW_NOISE_RATIO = 1.6
# Minimum extent of a path to fit scale factor and rotation: RMS distance (m) from the mean position
MIN_RMS_DISTANCE_FROM_PATH_MEAN_M = 0.5
# Length (s) of the running mean that removes drift from the errors of odometry
DRIFT_WINDOW_S = 12.0
# Duration (s) of the flight parts whose time offsets are estimated separately
FLIGHT_PART_DURATION_FOR_OFFSET_S = 4.0
# Minimum RMS speed (m/s) of a flight part to estimate its time offset
MIN_SPEED_FOR_OFFSET_M_S = 0.3
# Minimum reported variation (s) of the time offset: a position error of 8 cm at 1 m/s
MIN_OFFSET_RANGE_S = 0.08
# Minimum mean square of the slow (time-correlated) position errors ÷ variance of the white position
# noise: smaller slow errors may be noise
MIN_SLOW_TO_WHITE_NOISE_RATIO = 0.25
# A time offset that varies in flight is reported only if its removal reduces the mean square of the
# slow position errors to this fraction or less
MAX_REMAINING_SLOW_ERROR_FRACTION = 0.2
# A sinusoidal position error is reported only if it explains at least this fraction of the mean
# square of the slow position errors
MIN_PERIODIC_ERROR_FRACTION = 0.88
# Minimum amplitude of a reported sinusoidal position error ÷ σ of the white position noise
MIN_AMPLITUDE_TO_WHITE_NOISE_RATIO = 1.0
MIN_PERIOD_COUNT = 5.0
# Maximum tested frequency (Hz) of a sinusoidal position error
MAX_FREQUENCY_HZ = 2.0
FREQUENCY_STEP_IN_PERIODS_PER_FLIGHT = 0.2
MIN_BINS_PER_PERIOD = 30
# A sinusoidal position error is reported only if at most this fraction of the vehicle's mean square
# motion is at the frequency of the error. With more motion at this frequency, the motion may cause
# the error
MAX_FRACTION_OF_MOTION_AT_ERROR_FREQUENCY = 0.1
# Delay of the logged attitude: vehicle rotations from the attitude are compared with rotations
# integrated from the gyroscopes. Interval (s) between the starts of successive rotations
ROTATION_INTERVAL_S = 0.01
# Maximum tested delay (s) of the logged attitude
MAX_ATTITUDE_DELAY_S = 0.5
# Minimum reported delay (s) of the logged attitude
MIN_ATTITUDE_DELAY_S = 0.04
MAX_ROTATION_COUNT = 20_000
# Duration (s) of each rotation that is computed from the attitude, and compared with that from the
# gyroscopes, to find the delay of the logged attitude
ROTATION_COMPARISON_TIME_S = 0.1
# Differences (rad) between attitude and gyroscope rotations are limited to this value, because
# attitude resets cause larger ones
MAX_ROTATION_DIFFERENCE_RAD = 0.2
# A delay of the logged attitude is reported only if its removal reduces the mean square rotation
# difference between attitude and gyroscopes to less than this fraction
MAX_ROTATION_DIFFERENCE_RATIO_WITHOUT_DELAY = 0.5
# Minimum speed (m/s) and position noise (m) in fast flight, to report noise that increases with
# speed
MIN_HIGH_SPEED_M_S, MIN_NOISE_AT_HIGH_SPEED_M = 0.3, 0.02
# σ of normal noise ÷ median of its absolute values
SIGMA_PER_MEDIAN_ABSOLUTE_VALUE = 1.4826


class SpeedDependentNoise(NamedTuple):
    """Position noise at low and at high speed.

    Attributes
    ----------
    slow_m, fast_m : float
        Position noise (m, 1 σ) at low and at high speed.
    slow_m_s, fast_m_s : float
        Low and high speed (m/s).
    """

    slow_m: float
    fast_m: float
    slow_m_s: float
    fast_m_s: float


class LocalResiduals(NamedTuple):
    """Deviations of positions and timestamps from the interpolation of their neighbours.

    Attributes
    ----------
    residual_m : ndarray, shape (n, 2)
        Deviation of the horizontal position. The noise of the neighbours increases the deviation.
        It is therefore scaled, so that its σ equals the σ of white position noise.
    timestamp_jitter_s : ndarray, shape (n,)
        Deviation of the timestamp, scaled in the same way to the σ of white timestamp jitter.
    ekf2_speed_m_s : ndarray, shape (n,), or None
        EKF2's horizontal speed.
    """

    residual_m: Array
    velocity_m_s: Array
    timestamp_jitter_s: Array
    ekf2_speed_m_s: Array | None


class ErrorFit(NamedTuple):
    """Fit of constant offset, scale factor, rotation and time offset to position errors.

    Attributes
    ----------
    residual_m : ndarray, shape (n, 2)
        Remaining error against ground truth.
    columns : ndarray, shape (n, 2, 5)
        Derivatives of the position error with respect to the five fitted parameters: offset along
        each axis, scale factor error, rotation, and time offset.
    """

    time_s: Array
    velocity_m_s: Array
    path_m: Array
    columns: Array
    residual_m: Array
    white_noise_sigma_m: float
    scale: float
    scale_error_sigma: float

    def compute_slow_error_mean_square_m2(self) -> float:
        """Return the mean square (m²) of the time-correlated position errors.

        It is the mean square of the residuals of the fit, minus the variance of the white noise.
        Both are sums over the two horizontal axes.
        """
        return float(np.mean(self.residual_m**2, axis=0).sum()) - 2.0 * self.white_noise_sigma_m**2


class PeriodicError(NamedTuple):
    """Sinusoidal position error.

    ``fraction`` is the mean square of the sinusoidal error divided by the mean square of all slow
    (time-correlated) position errors.
    """

    period_s: float
    amplitude_m: float
    fraction: float


class TimeOffsetVariation(NamedTuple):
    """Range of the time offset of the positions in flight.

    Attributes
    ----------
    least_s, most_s : float
        Smallest and largest time offset (s), relative to the mean time offset.
    least_at_s, most_at_s : float
        Flight times (s) of the smallest and of the largest time offset.
    """

    least_s: float
    most_s: float
    least_at_s: float
    most_at_s: float


def _rotate_clockwise_90_deg(vectors: Array) -> Array:
    return vectors[:, ::-1] * [-1.0, 1.0]


def _select_distinct_positions(comparison: Comparison) -> tuple[Array, Array]:
    samples = comparison.source_samples[Columns.POSITION[:2]].dropna()
    samples = samples[~(samples.diff() == 0.0).all(axis=1)]  # without repeated positions
    return samples.index.to_numpy(), samples.to_numpy()


def compute_local_residuals(comparison: Comparison) -> LocalResiduals | None:
    """Return each position and timestamp minus the interpolation of its neighbours."""
    time_s, position_m = _select_distinct_positions(comparison)
    if len(time_s) < MIN_POSITIONS:
        return None
    interval_s = compute_median_interval_s(time_s)
    rows, weights = _compute_interpolation_weights(time_s, interval_s)
    # σ of the residual (value - Σ weight · neighbour) ÷ σ of the values. A large ratio means that
    # the interpolation amplifies noise: such positions are omitted
    sigma_ratio = np.sqrt(1.0 + np.sum(weights**2, axis=1))
    is_accurate = sigma_ratio < MAX_RESIDUAL_TO_POSITION_SIGMA_RATIO
    rows, weights, sigma_ratio = rows[is_accurate], weights[is_accurate], sigma_ratio[is_accurate]

    def compute_residual(values: Array) -> Array:
        """Return value minus interpolation at ``rows``, scaled to the σ of the values."""
        neighbours = values[rows[:, None] + NEIGHBOUR_ROW_OFFSETS]
        residuals = values[rows] - np.einsum("nk,nk...->n...", weights, neighbours)
        return np.asarray((residuals.T / sigma_ratio).T)

    # Timestamps minus times at equal intervals. The running median follows drift and gaps, but not
    # jitter
    timestamp_deviation_s = time_s - interval_s * np.arange(len(time_s))
    padded_deviation_s = np.pad(
        timestamp_deviation_s, TIMESTAMP_MEDIAN_FILTER_LENGTH // 2, mode="edge"
    )
    timestamp_delay_s = timestamp_deviation_s - np.median(
        sliding_window_view(padded_deviation_s, TIMESTAMP_MEDIAN_FILTER_LENGTH), axis=1
    )
    # Velocity: displacement over ± 0.3 s, at least ± 2 rows
    half_window_rows = max(2, round(VELOCITY_HALF_WINDOW_S / interval_s))
    first_rows = np.maximum(rows - half_window_rows, 0)
    last_rows = np.minimum(rows + half_window_rows, len(time_s) - 1)
    displacement_m = position_m[last_rows] - position_m[first_rows]
    velocity_m_s = displacement_m / (time_s[last_rows] - time_s[first_rows])[:, None]
    ekf2 = comparison.flight.ekf2
    ekf2_speed_m_s = None
    if isinstance(ekf2, Ekf2):
        speed_m_s = np.linalg.norm(ekf2.state[Columns.VELOCITY[:2]].to_numpy(), axis=1)
        ekf2_speed_m_s = np.interp(time_s[rows], ekf2.state.index.to_numpy(), speed_m_s)
    return LocalResiduals(
        compute_residual(position_m),
        velocity_m_s,
        compute_residual(timestamp_delay_s),
        ekf2_speed_m_s,
    )


def _compute_interpolation_weights(time_s: Array, interval_s: float) -> tuple[Array, Array]:
    """Return the rows to interpolate, and the weights of their neighbours: shapes (m,) and (m, 4).

    Row i is interpolated from the rows i - 2, i - 1, i + 1 and i + 2. Rows near gaps are omitted.
    Neighbours have the time differences t to row i. Their weights w interpolate cubic polynomials
    exactly: Σ w = 1, and Σ w tᵏ = 0 for k = 1, 2, 3.
    """
    rows = np.arange(2, len(time_s) - 2)
    neighbour_rows = rows[:, None] + NEIGHBOUR_ROW_OFFSETS
    elapsed_intervals = (time_s[neighbour_rows] - time_s[rows, None]) / interval_s
    is_without_gap = np.ptp(elapsed_intervals, axis=1) < MAX_NEIGHBOUR_SPAN_IN_MEDIAN_INTERVALS
    # The conditions on the weights w are the linear equations powers @ w = (1, 0, 0, 0), with
    # powers[row, k, neighbour] = tᵏ. Their solution is column 0 of the inverse matrix
    powers = elapsed_intervals[is_without_gap, None] ** np.arange(4)[:, None]
    return rows[is_without_gap], np.linalg.inv(powers)[:, :, 0]


def find_timestamp_jitter(errors: LocalResiduals) -> float | None:
    """Return the timestamp jitter (s, 1 σ), if position errors confirm it, else None.

    A timestamp that is late by Δt causes the position residual -velocity · Δt. This expected
    residual must agree with the measured residual.
    """
    expected_residual_m = -errors.velocity_m_s * errors.timestamp_jitter_s[:, None]
    expected_square_sum_m2 = float(np.sum(expected_residual_m**2))
    jitter_s = float(np.std(errors.timestamp_jitter_s))
    if jitter_s < MIN_JITTER_S or not expected_square_sum_m2:
        return None
    # Linear regression (without a constant) of the measured position residuals on the residuals
    # expected from the timestamp jitter
    residual_ratio = float(np.sum(errors.residual_m * expected_residual_m)) / expected_square_sum_m2
    unexplained_residual_m = errors.residual_m - residual_ratio * expected_residual_m
    residual_ratio_sigma = np.sqrt(
        RESIDUAL_CORRELATION_LENGTH * np.mean(unexplained_residual_m**2) / expected_square_sum_m2
    )
    # RMS of the expected residuals ÷ RMS of the measured residuals
    jitter_fraction = np.sqrt(expected_square_sum_m2 / np.sum(errors.residual_m**2))
    is_jitter = (
        RESIDUAL_TO_JITTER_ERROR_RATIO_LIMITS[0]
        < residual_ratio
        < RESIDUAL_TO_JITTER_ERROR_RATIO_LIMITS[1]
        and residual_ratio > MIN_SIGNIFICANCE_SIGMAS * residual_ratio_sigma
        and jitter_fraction > MIN_JITTER_FRACTION_OF_RESIDUAL
    )
    return jitter_s if is_jitter else None


def find_speed_dependent_noise(errors: LocalResiduals) -> SpeedDependentNoise | None:
    """Return the position noise at low and at high speed, if it increases with speed."""
    # Use EKF2's speed: a speed computed from the positions contains the noise of the positions
    speed_m_s = errors.ekf2_speed_m_s
    if speed_m_s is None:
        return None
    # 1. Noise and speed must be correlated in the whole flight and in most flight parts: noise that
    # is larger in one fast part may be unrelated to speed
    norms_and_speeds = np.column_stack([np.linalg.norm(errors.residual_m, axis=1), speed_m_s])
    flight_parts = np.array_split(norms_and_speeds, FLIGHT_PART_COUNT)
    # Constant values have no rank correlation
    if not np.all([np.ptp(part, axis=0) for part in flight_parts]):
        return None
    # Correlations as z-scores: divided by their σ, which is 1 / √n for n independent samples
    # without correlation
    flight_z_score, *part_z_scores = (
        rank_correlation(*part.T) * np.sqrt(len(part) / RESIDUAL_CORRELATION_LENGTH)
        for part in (norms_and_speeds, *flight_parts)
    )
    if (
        flight_z_score < MIN_SIGNIFICANCE_SIGMAS
        or np.median(part_z_scores) < MIN_NOISE_SPEED_CORRELATION_SIGMAS
    ):
        return None
    # 2. The noise must be larger in fast than in slow flight, along and across the track. Jitter of
    # the timestamps increases the noise only along the track
    max_slow_m_s, min_fast_m_s = np.quantile(speed_m_s, [SLOW_SPEED_QUANTILE, FAST_SPEED_QUANTILE])
    is_slow, is_fast = speed_m_s <= max_slow_m_s, speed_m_s >= min_fast_m_s
    source_speed_m_s = np.linalg.norm(errors.velocity_m_s, axis=1, keepdims=True)
    direction = errors.velocity_m_s / np.maximum(source_speed_m_s, 1e-6)
    along_track_residual_m = np.abs(np.sum(errors.residual_m * direction, axis=1))
    cross_track_residual_m = np.abs(
        np.sum(errors.residual_m * _rotate_clockwise_90_deg(direction), axis=1)
    )
    # If the position noise increases only along the track, timestamp jitter may be the cause:
    # report only noise that increases along and across the track
    if any(
        np.median(noise_m[is_fast]) < MIN_FAST_TO_SLOW_NOISE_RATIO * np.median(noise_m[is_slow])
        for noise_m in (along_track_residual_m, cross_track_residual_m)
    ):
        return None
    # 3. Speed and noise of fast flight must be large enough to matter
    speed_dependent_noise = SpeedDependentNoise(
        slow_m=_estimate_sigma(errors.residual_m[is_slow]),
        fast_m=_estimate_sigma(errors.residual_m[is_fast]),
        slow_m_s=float(np.median(speed_m_s[is_slow])),
        fast_m_s=float(np.median(speed_m_s[is_fast])),
    )
    is_relevant = (
        speed_dependent_noise.fast_m_s >= MIN_HIGH_SPEED_M_S
        and speed_dependent_noise.fast_m >= MIN_NOISE_AT_HIGH_SPEED_M
    )
    return speed_dependent_noise if is_relevant else None


def fit_errors_against_truth(
    comparison: Comparison, local_residuals: LocalResiduals
) -> ErrorFit | None:
    """Fit constant offset, scale, rotation and time offset to the errors against ground truth.

    Model for small errors: error = offset + scale · path + rotation · (path rotated by 90°) -
    velocity · time offset; path is the true position minus its mean.
    """
    truth = comparison.flight.truth
    if isinstance(truth, Unavailable):
        return None
    time_s, position_m = _select_distinct_positions(comparison)
    true_positions_m = truth.samples[Columns.POSITION[:2]].dropna()
    is_inside = (time_s > true_positions_m.index[0]) & (time_s < true_positions_m.index[-1])
    time_s, position_m = time_s[is_inside], position_m[is_inside]
    if len(time_s) < MIN_POSITIONS:
        return None
    truth_spline = CubicSpline(true_positions_m.index, true_positions_m)
    true_m, velocity_m_s = truth_spline(time_s), truth_spline(time_s, 1)
    path_m = true_m - true_m.mean(axis=0)
    path_mean_square_m2 = float(np.mean(np.sum(path_m**2, axis=1)))
    if path_mean_square_m2 < MIN_RMS_DISTANCE_FROM_PATH_MEAN_M**2:
        return None
    # Derivatives of the error with respect to the parameters: offset north and east, scale, ...
    offset_columns = [np.tile(axis, (len(time_s), 1)) for axis in np.eye(2)]
    columns = np.stack(
        [*offset_columns, path_m, _rotate_clockwise_90_deg(path_m), -velocity_m_s], axis=-1
    )
    error_m = position_m - true_m
    (_, _, scale, _, _), residual_m = _fit_least_squares(columns, error_m)
    # The σ of the scale factor depends on the number of independent errors, not of all errors
    interval_s = compute_median_interval_s(time_s)
    independent_error_count = len(time_s) / max(
        *map(compute_autocorrelation_time, residual_m.T), 1.0
    )
    scale_error_sigma = np.sqrt(
        np.mean(residual_m**2) / (path_mean_square_m2 * independent_error_count)
    )
    # The drift of odometry is no fault. Subtract running means from errors and derivatives, so that
    # drift hardly affects the residuals. The derivatives for constant offsets become zero and are
    # omitted
    if comparison.source.origin.may_drift:
        from scipy.ndimage import uniform_filter1d  # noqa: PLC0415 - slow import

        window_length = max(1, round(DRIFT_WINDOW_S / interval_s))

        def remove_running_mean(values: Array) -> Array:
            return values - uniform_filter1d(values, window_length, axis=0)

        _, residual_m = _fit_least_squares(
            remove_running_mean(columns)[..., 2:], remove_running_mean(error_m)
        )
    return ErrorFit(
        time_s,
        velocity_m_s,
        path_m,
        columns,
        residual_m,
        white_noise_sigma_m=_estimate_sigma(local_residuals.residual_m),
        scale=float(scale),
        scale_error_sigma=float(scale_error_sigma),
    )


def _estimate_sigma(residuals: Array) -> float:
    """Return σ, estimated from the median so that outliers have little effect."""
    return SIGMA_PER_MEDIAN_ABSOLUTE_VALUE * float(np.median(np.abs(residuals)))


def _fit_least_squares(columns: Array, values: Array) -> tuple[Array, Array]:
    """Solve a linear least-squares fit; return the parameters and the residuals."""
    rows = columns.reshape(-1, columns.shape[-1])
    parameters = np.asarray(np.linalg.lstsq(rows, values.ravel(), rcond=None)[0], dtype=np.float64)
    return parameters, values - columns @ parameters


def find_periodic_error(fit: ErrorFit) -> PeriodicError | None:
    """Return a sinusoidal error that explains most of the slow errors, if any."""
    elapsed_s = fit.time_s - fit.time_s[0]
    # Tested frequencies: k · frequency_step_hz, from 5 periods per flight to 4 samples per period
    max_frequency_hz = min(MAX_FREQUENCY_HZ, 0.25 / compute_median_interval_s(fit.time_s))
    frequency_step_hz = FREQUENCY_STEP_IN_PERIODS_PER_FLIGHT / elapsed_s[-1]
    first_k = round(MIN_PERIOD_COUNT / FREQUENCY_STEP_IN_PERIODS_PER_FLIGHT)
    end_k = int(np.ceil(max_frequency_hz / frequency_step_hz))
    slow_error_mean_square_m2 = fit.compute_slow_error_mean_square_m2()
    if end_k <= first_k or slow_error_mean_square_m2 <= 0.0:
        return None
    # One FFT computes all frequencies: sum the errors in time bins of equal length. The bins cover
    # the time 1 / frequency_step_hz, several flights long; bins after the flight remain zero
    min_bin_count = MIN_BINS_PER_PERIOD * max_frequency_hz / frequency_step_hz
    bin_count = 2 ** int(np.ceil(np.log2(min_bin_count)))
    bin_indices = np.rint(elapsed_s * frequency_step_hz * bin_count).astype(int)
    spectrum = np.fft.rfft(
        [np.bincount(bin_indices, error, bin_count) for error in fit.residual_m.T]
    )
    powers = np.sum(np.abs(spectrum[:, first_k:end_k]) ** 2, axis=0)
    frequency_hz = float(frequency_step_hz * (first_k + np.argmax(powers)))

    def compute_mean_square_m2(values: Array) -> float:
        """Return the mean square (m²) of the sinusoid at ``frequency_hz`` in ``values`` (n, 2)."""
        # Mean square of a sinusoid ½ a², with amplitude a = 2 |mean of the values · exp(-iωt)|
        complex_sinusoid = np.exp(-2j * np.pi * frequency_hz * fit.time_s)
        return 2.0 * float(np.sum(np.abs(complex_sinusoid @ values / len(values)) ** 2))

    periodic_mean_square_m2 = compute_mean_square_m2(fit.residual_m)
    fraction_of_motion_at_error_frequency = compute_mean_square_m2(fit.path_m) / np.mean(
        np.sum(fit.path_m**2, axis=1)
    )
    amplitude_m = float(np.sqrt(2.0 * periodic_mean_square_m2))
    explained_fraction = periodic_mean_square_m2 / slow_error_mean_square_m2
    if (
        explained_fraction < MIN_PERIODIC_ERROR_FRACTION
        or amplitude_m < MIN_AMPLITUDE_TO_WHITE_NOISE_RATIO * fit.white_noise_sigma_m
        or fraction_of_motion_at_error_frequency > MAX_FRACTION_OF_MOTION_AT_ERROR_FREQUENCY
    ):
        return None
    return PeriodicError(1.0 / frequency_hz, amplitude_m, explained_fraction)


def find_time_offset_variation(fit: ErrorFit) -> TimeOffsetVariation | None:
    """Return the range of the time offset in flight if it explains time-correlated errors.

    The errors are those of the positions against ground truth, after the fit of constant
    parameters.
    """
    flight_part_indices = np.floor(
        (fit.time_s - fit.time_s[0]) / FLIGHT_PART_DURATION_FOR_OFFSET_S
    ).astype(int)
    square_speed_sums = np.bincount(flight_part_indices, np.sum(fit.velocity_m_s**2, axis=1))
    mean_square_speeds = square_speed_sums / np.maximum(np.bincount(flight_part_indices), 1)
    moving_part_indices = np.flatnonzero(mean_square_speeds > MIN_SPEED_FOR_OFFSET_M_S**2)
    if len(moving_part_indices) < 2:
        return None
    # Fit one time offset τ per flight part together with parameters p that are constant in flight:
    # error = columns · p - velocity · τ[part]. Solve this fit in two steps (variable projection):
    # first subtract from the errors, and from each column, the best time offsets of the flight
    # parts. Then fit the constant parameters to the remainders
    error_per_time_offset_m_s = -fit.velocity_m_s
    inverse_square_speed_sums = np.zeros_like(square_speed_sums)
    inverse_square_speed_sums[moving_part_indices] = 1.0 / square_speed_sums[moving_part_indices]

    def fit_time_offsets_by_part(values: Array) -> Array:
        # Least squares for one parameter in each flight part: Σ derivative · value / Σ derivative²
        velocity_weighted_sums = np.zeros((len(inverse_square_speed_sums), values.shape[-1]))
        np.add.at(
            velocity_weighted_sums,
            flight_part_indices,
            np.einsum("na,nak->nk", error_per_time_offset_m_s, values),
        )
        return velocity_weighted_sums * inverse_square_speed_sums[:, None]

    # Jacobian columns of offset, scale factor and rotation. The last column contains the position
    # errors to which they are fitted
    columns = np.concatenate([fit.columns[..., :-1], fit.residual_m[..., None]], axis=-1)
    time_offsets_by_column_s = fit_time_offsets_by_part(columns)
    columns -= (
        error_per_time_offset_m_s[:, :, None] * time_offsets_by_column_s[flight_part_indices, None]
    )
    parameters, residual_m = _fit_least_squares(columns[..., :-1], columns[..., -1])
    # Fit one time offset per flight part to the errors that the constant parameters p do not
    # explain: errors - columns · p. The fit is linear, so the offsets fitted to each column are
    # combined
    offsets_s = (time_offsets_by_column_s @ np.append(-parameters, 1.0))[moving_part_indices]
    white_noise_mean_square_m2 = 2.0 * fit.white_noise_sigma_m**2  # of two axes
    slow_error_m2 = fit.compute_slow_error_mean_square_m2()
    unexplained_m2 = float(np.mean(residual_m**2, axis=0).sum()) - white_noise_mean_square_m2
    if (
        np.ptp(offsets_s) < MIN_OFFSET_RANGE_S
        or slow_error_m2 < MIN_SLOW_TO_WHITE_NOISE_RATIO * white_noise_mean_square_m2
        or unexplained_m2 > MAX_REMAINING_SLOW_ERROR_FRACTION * slow_error_m2
    ):
        return None
    times_s = fit.time_s[0] + FLIGHT_PART_DURATION_FOR_OFFSET_S * (moving_part_indices + 0.5)
    least, most = np.argmin(offsets_s), np.argmax(offsets_s)
    return TimeOffsetVariation(*offsets_s[[least, most]].tolist(), *times_s[[least, most]].tolist())


def find_attitude_delay(imu: pd.DataFrame, attitude: pd.DataFrame) -> float | None:
    """Return the delay (s) of the logged attitude relative to the gyroscopes, if any.

    Rotations over 0.1 s, sampled every 0.01 s, are compared: those between two attitudes, and those
    from the integrated angular rates. The delay with the smallest mean square difference is chosen.
    """
    imu_time_s, attitude_time_s = imu.index.to_numpy(), attitude.index.to_numpy()
    start_s = max(imu_time_s[0], attitude_time_s[0])
    end_s = min(imu_time_s[-1], attitude_time_s[-1])
    time_s = np.arange(
        start_s + MAX_ATTITUDE_DELAY_S, end_s - MAX_ATTITUDE_DELAY_S, ROTATION_INTERVAL_S
    )[:MAX_ROTATION_COUNT]
    if len(time_s) < MIN_POSITIONS:
        return None
    samples_per_rotation = round(ROTATION_COMPARISON_TIME_S / ROTATION_INTERVAL_S)
    imu = rows_between(
        imu, time_s[0] - 2.0 * MAX_ATTITUDE_DELAY_S, time_s[-1] + 2.0 * MAX_ATTITUDE_DELAY_S
    )
    imu_time_s = imu.index.to_numpy()
    quaternions = interpolate_attitude(attitude, time_s)
    rotation_rad = to_rotation_vector(
        multiply(conjugate(quaternions[:-samples_per_rotation]), quaternions[samples_per_rotation:])
    )
    angle_rad = integrate_cumulatively(imu[Columns.ANGULAR_RATE].to_numpy(), imu_time_s)

    # Rotations from the gyroscopes start MAX_ATTITUDE_DELAY_S before those from the attitude and
    # end later, so that each tested delay only shifts the compared rows. Without a delay, row i of
    # the attitude corresponds to row i + max_delay_in_rows of the gyroscopes
    max_delay_in_rows = round(MAX_ATTITUDE_DELAY_S / ROTATION_INTERVAL_S)
    gyro_time_s = time_s[0] + ROTATION_INTERVAL_S * np.arange(
        -max_delay_in_rows, len(time_s) + max_delay_in_rows
    )
    angle_rad = interpolate_columns(gyro_time_s, imu_time_s, angle_rad)
    gyro_rotation_rad = angle_rad[samples_per_rotation:] - angle_rad[:-samples_per_rotation]

    def compute_mean_square_rad2(delay_in_rows: int) -> float:
        """Return the mean square rotation difference for an attitude that is late by this delay."""
        # The attitude in row i shows the rotation of the gyroscopes delay_in_rows earlier
        first_row = max_delay_in_rows - delay_in_rows
        rotation_differences_rad = (
            rotation_rad - gyro_rotation_rad[first_row : first_row + len(rotation_rad)]
        )
        # Remove the median difference between attitude and gyroscope rotations, which is due to the
        # gyroscope bias
        rotation_differences_rad -= np.median(rotation_differences_rad, axis=0)
        # An attitude reset causes a large difference: limit its effect on the mean square
        limited_angles_rad = np.minimum(
            np.linalg.norm(rotation_differences_rad, axis=1), MAX_ROTATION_DIFFERENCE_RAD
        )
        return float(np.mean(limited_angles_rad**2))

    # Test delays in steps of 6 rows, then in steps of 2 rows near the best of them
    coarse_delays = range(-max_delay_in_rows, max_delay_in_rows + 1, 6)
    coarse_delay = min(coarse_delays, key=compute_mean_square_rad2)
    fine_delays = range(
        max(coarse_delay - 4, -max_delay_in_rows), min(coarse_delay + 4, max_delay_in_rows) + 1, 2
    )
    delay_in_rows = min(fine_delays, key=compute_mean_square_rad2)
    delay_s = ROTATION_INTERVAL_S * delay_in_rows
    if abs(delay_s) < MIN_ATTITUDE_DELAY_S:
        return None
    max_rad2 = MAX_ROTATION_DIFFERENCE_RATIO_WITHOUT_DELAY * compute_mean_square_rad2(0)
    return delay_s if compute_mean_square_rad2(delay_in_rows) < max_rad2 else None
