"""Patterns in the errors of a position source: jitter, noise that increases with speed, and others.

White noise and timestamp jitter are found without ground truth: each position is compared with a
cubic polynomial through its four neighbours, which removes the motion. Slow errors are the
differences from ground truth, without constant, scale factor, rotation and time offset.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter, uniform_filter1d

from px4fuse.comparison.model import Comparison
from px4fuse.core.arrays import Array, cumulative_integral, rank_correlation
from px4fuse.filter.signals import cut_to_segment
from px4fuse.flight.model import Columns, Ekf2, Unavailable, rows_between
from px4fuse.trajectory.rotation import conjugate, interpolate, multiply, to_vector
from px4fuse.trajectory.scores import autocorrelation_time

# Minimum number of positions for a search of error patterns
MIN_POSITIONS = 100
# Rows of the neighbours of a position, relative to its row
NEIGHBOURS = np.array([-2, -1, 1, 2])
# Maximum time from the first to the last neighbour of a position, in median intervals: cubic
# interpolation across a gap is inaccurate
MAX_NEIGHBOUR_SPAN = 8.0
# Maximum ratio of the σ of a residual to the σ of a position; a larger residual σ is due to the
# interpolation
MAX_RESIDUAL_NOISE_GAIN = 4.0
# Number of timestamps in a running median that follows missing positions, but not jitter
MEDIAN_TIMESTAMP_COUNT = 9
# Half of the time (s) over which the velocity is averaged
HALF_VELOCITY_S = 0.3
# Ratio of all residuals to independent residuals: successive residuals have common neighbours
SHARED_RESIDUALS = 3
# Minimum timestamp jitter (s, 1 σ): an error of 1 cm at 1 m/s
MIN_JITTER_S = 0.008
# Jitter is confirmed if position residual / (timestamp residual · velocity) is in this range
JITTER_RATIOS = 0.6, 1.5
# Minimum ratio of the errors due to jitter to all white errors (RMS) to report jitter
MIN_JITTER_FRACTION = 0.4
# Minimum significance (σ) of jitter, and of noise that increases with speed
MIN_PATTERN_SIGMAS = 6.0
# The increase of noise with speed is tested in PART_COUNT flight parts. MIN_PART_SIGMAS is the
# minimum median of its significance (σ)
PART_COUNT, MIN_PART_SIGMAS = 5, 1.2
# Quantiles of the speed: below the first, the vehicle is slow; above the second, it is fast
SLOW_FRACTION, FAST_FRACTION = 0.3, 0.7
# Minimum ratio of the noise at high speed to the noise at low speed, both along and across the
# motion, to report noise that increases with speed
MIN_SPEED_NOISE_RATIO = 1.6
# Minimum extent (m, RMS) of a path whose errors are fitted to ground truth
MIN_PATH_RMS_M = 0.5
# Length (s) of the running mean that is removed from the errors of odometry, which drifts
DRIFT_WINDOW_S = 12.0
# Length (s) of the flight parts with separate time offsets
OFFSET_PART_S = 4.0
# Minimum RMS speed (m/s) of a flight part whose time offset is estimated
MIN_OFFSET_SPEED_M_S = 0.3
# Minimum range (s) of a varying time offset to report it: a position error of 8 cm at 1 m/s
MIN_OFFSET_RANGE_S = 0.08
# Minimum ratio of the mean square error beyond white noise to the variance of white noise: with
# less, the time offsets of many flight parts would only fit noise
MIN_SLOW_RATIO = 0.25
# Varying time offsets explain the error beyond white noise if at most this fraction of its mean
# square remains
MAX_REMAINING_FRACTION = 0.2
# A sinusoidal error is reported if it explains at least this fraction of the mean square error
# beyond white noise
MIN_PERIODIC_FRACTION = 0.88
# Minimum ratio of the amplitude of a sinusoidal error to the σ of white noise
MIN_AMPLITUDE_SIGMAS = 1.0
# Minimum number of periods of a sinusoidal error in the flight
MIN_PERIODS = 5.0
# Maximum tested frequency (Hz) of a sinusoidal error
MAX_FREQUENCY_HZ = 2.0
# Distance of the tested frequencies, in periods in the flight
FREQUENCY_STEP_PERIODS = 0.2
# Minimum number of bins per period of the highest frequency: an amplitude is wrong by 0.2 %
MIN_BINS_PER_PERIOD = 30
# Maximum fraction of the mean square motion at the frequency of a sinusoidal error
MAX_MOTION_FRACTION = 0.1
# Tested delays of the logged attitude: distance of successive delays, and largest delay (s)
DELAY_STEP_S, MAX_ATTITUDE_DELAY_S = 0.01, 0.5
# Minimum delay (s) of the logged attitude that is reported
MIN_ATTITUDE_DELAY_S = 0.04
# Maximum number of rotations from attitude and gyroscopes that are compared, to limit the computing
# time
MAX_ROTATIONS = 20_000
# Time (s) over which a rotation from attitude is compared with the rotation from gyroscopes
ROTATION_STEP_S = 0.1
# Maximum difference (rad) of both rotations; larger ones are due to resets of the attitude
MAX_ROTATION_RAD = 0.2
# A delay of the attitude is reported if its correction reduces the mean square rotation difference
# to less than this fraction
MAX_DELAYED_RATIO = 0.5
# Minimum speed (m/s) of the fast part of a flight, and minimum noise (m) at this speed, to report
# noise that increases with speed
MIN_FAST_M_S, MIN_FAST_NOISE_M = 0.3, 0.02
# Ratio of the standard deviation to the median absolute value of normal noise
SIGMA_PER_MEDIAN = 1.4826


class SpeedNoise(NamedTuple):
    """Position noise (1 σ, m) at low and at high speed (m/s)."""

    slow_m: float
    fast_m: float
    slow_m_s: float
    fast_m_s: float


class WhiteErrors(NamedTuple):
    """Residuals of positions and timestamps against a cubic polynomial through their neighbours.

    ``residual_m``, shape (n, 2), contains the residuals of the positions, and ``late_s`` those of
    the timestamps' deviation (s) from a constant rate. Both are scaled so that their σ is that of a
    single position or timestamp. ``ekf2_speed_m_s`` is EKF2's horizontal speed.
    """

    residual_m: Array
    velocity_m_s: Array
    late_s: Array
    ekf2_speed_m_s: Array | None


class ErrorFit(NamedTuple):
    """Fit of a constant, scale factor, rotation and time offset to the errors of a source.

    ``remaining_m``, shape (n, 2), is the error against ground truth that the fit does not explain.
    ``columns``, shape (n, 2, 5), contains the effects of the fitted parameters.
    """

    time_s: Array
    velocity_m_s: Array
    path_m: Array
    columns: Array
    remaining_m: Array
    white_m: float
    scale: float
    scale_sigma: float

    def compute_slow_square_m2(self) -> float:
        """Return the mean square (m²) of the remaining error of both axes, without white noise."""
        return float(np.mean(self.remaining_m**2, axis=0).sum()) - 2.0 * self.white_m**2


class PeriodicError(NamedTuple):
    """Sinusoidal position error; ``fraction``: part of the mean square error beyond white noise."""

    period_s: float
    amplitude_m: float
    fraction: float


class OffsetVariation(NamedTuple):
    """Smallest and largest time offset (s) in flight, with their times (s)."""

    least_s: float
    most_s: float
    least_at_s: float
    most_at_s: float


def _rotate_90(vectors: Array) -> Array:
    return vectors[:, ::-1] * [-1.0, 1.0]


def _positions(comparison: Comparison) -> tuple[Array, Array]:
    samples = cut_to_segment(comparison.source.samples, comparison.segment)
    samples = samples[Columns.POSITION[:2]].dropna()
    samples = samples[~(samples.diff() == 0.0).all(axis=1)]  # without repeated positions
    return samples.index.to_numpy(), samples.to_numpy()


def white_errors(comparison: Comparison) -> WhiteErrors | None:
    """Compare each position with a cubic polynomial through its neighbours.

    Return None with too few positions.
    """
    time_s, position_m = _positions(comparison)
    if len(time_s) < MIN_POSITIONS:
        return None
    rows = np.arange(2, len(time_s) - 2)
    neighbour_rows = rows[:, None] + NEIGHBOURS
    elapsed_s = time_s[neighbour_rows] - time_s[rows, None]
    interval_s = float(np.median(np.diff(time_s)))
    is_complete = np.ptp(elapsed_s, axis=1) < MAX_NEIGHBOUR_SPAN * interval_s
    rows, neighbour_rows, elapsed_s = (
        array[is_complete] for array in (rows, neighbour_rows, elapsed_s)
    )
    weights = np.ones_like(elapsed_s)  # of Lagrange's interpolation at the time of the position
    for neighbour in range(len(NEIGHBOURS)):
        for other_neighbour in set(range(len(NEIGHBOURS))) - {neighbour}:
            other_s = elapsed_s[:, other_neighbour]
            weights[:, neighbour] *= other_s / (other_s - elapsed_s[:, neighbour])
    noise_gain = np.sqrt(1.0 + np.sum(weights**2, axis=1))
    phase_s = time_s - interval_s * np.arange(len(time_s))
    late_s = phase_s - median_filter(phase_s, MEDIAN_TIMESTAMP_COUNT, mode="nearest")
    half_window_rows = max(2, round(HALF_VELOCITY_S / interval_s))
    first_row, last_row = (
        np.clip(rows - half_window_rows, 0, None),
        np.clip(rows + half_window_rows, None, len(time_s) - 1),
    )
    travelled_m = position_m[last_row] - position_m[first_row]
    velocity_m_s = travelled_m / (time_s[last_row] - time_s[first_row])[:, None]
    is_accurate = noise_gain < MAX_RESIDUAL_NOISE_GAIN

    def residual(values: Array) -> Array:
        interpolated = np.einsum("nk,nk...->n...", weights, values[neighbour_rows])
        scaled = ((values[rows] - interpolated).T / noise_gain).T
        return np.asarray(scaled[is_accurate])

    ekf2 = comparison.flight.ekf2
    ekf2_speed_m_s = None
    if isinstance(ekf2, Ekf2):
        logged_speed_m_s = np.linalg.norm(ekf2.state[Columns.VELOCITY[:2]].to_numpy(), axis=1)
        ekf2_speed_m_s = np.interp(
            time_s[rows[is_accurate]], ekf2.state.index.to_numpy(), logged_speed_m_s
        )
    return WhiteErrors(
        residual(position_m), velocity_m_s[is_accurate], residual(late_s), ekf2_speed_m_s
    )


def find_timestamp_jitter(errors: WhiteErrors) -> float | None:
    """Return the jitter (s, 1 σ) of the timestamps if the position errors confirm it.

    If a position has a late timestamp, it is behind the interpolated position by delay · velocity.
    """
    expected_m = -errors.velocity_m_s * errors.late_s[:, None]
    expected_square_m2 = float(np.sum(expected_m**2))
    jitter_s = float(np.std(errors.late_s))
    if jitter_s < MIN_JITTER_S or not expected_square_m2:
        return None
    ratio = float(np.sum(errors.residual_m * expected_m)) / expected_square_m2
    unexplained_m = errors.residual_m - ratio * expected_m
    sigma = np.sqrt(SHARED_RESIDUALS * np.mean(unexplained_m**2) / expected_square_m2)
    fraction = np.sqrt(expected_square_m2 / np.sum(errors.residual_m**2))
    is_jitter = (
        JITTER_RATIOS[0] < ratio < JITTER_RATIOS[1]
        and ratio > MIN_PATTERN_SIGMAS * sigma
        and fraction > MIN_JITTER_FRACTION
    )
    return jitter_s if is_jitter else None


def find_speed_noise(errors: WhiteErrors) -> SpeedNoise | None:
    """Return the noise at low and high speed if it increases with speed in all directions."""
    # The speed is from EKF2, because a speed from the positions would contain their noise
    speed_m_s = errors.ekf2_speed_m_s
    if speed_m_s is None:
        return None
    residual_norms_m = np.linalg.norm(errors.residual_m, axis=1)
    # If the noise is only larger in one part of the flight, few parts show a correlation with speed
    significances = [
        rank_correlation(residual_norms_m[part], speed_m_s[part])
        * np.sqrt(len(part) / SHARED_RESIDUALS)
        for part in (
            np.arange(len(residual_norms_m)),
            *np.array_split(np.arange(len(residual_norms_m)), PART_COUNT),
        )
        if np.ptp(residual_norms_m[part]) and np.ptp(speed_m_s[part])
    ]
    if (
        len(significances) <= PART_COUNT
        or significances[0] < MIN_PATTERN_SIGMAS
        or np.median(significances[1:]) < MIN_PART_SIGMAS
    ):
        return None
    limits_m_s = np.quantile(speed_m_s, [SLOW_FRACTION, FAST_FRACTION])
    is_slow, is_fast = speed_m_s <= limits_m_s[0], speed_m_s >= limits_m_s[1]
    source_speed_m_s = np.linalg.norm(errors.velocity_m_s, axis=1, keepdims=True)
    direction = errors.velocity_m_s / np.maximum(source_speed_m_s, 1e-6)
    along_m = np.abs(np.sum(errors.residual_m * direction, axis=1))
    across_m = np.abs(np.sum(errors.residual_m * _rotate_90(direction), axis=1))
    # Jitter of the timestamps causes errors along the motion only
    if any(
        np.median(part_m[is_fast]) < MIN_SPEED_NOISE_RATIO * np.median(part_m[is_slow])
        for part_m in (along_m, across_m)
    ):
        return None
    slow_and_fast_m = (
        SIGMA_PER_MEDIAN * float(np.median(np.abs(errors.residual_m[rows])))
        for rows in (is_slow, is_fast)
    )
    slow_and_fast_m_s = (float(np.median(speed_m_s[rows])) for rows in (is_slow, is_fast))
    noise = SpeedNoise(*slow_and_fast_m, *slow_and_fast_m_s)
    is_relevant = noise.fast_m_s >= MIN_FAST_M_S and noise.fast_m >= MIN_FAST_NOISE_M
    return noise if is_relevant else None


def fit_errors(comparison: Comparison, white: WhiteErrors) -> ErrorFit | None:
    """Fit a constant, scale factor, rotation and time offset to the errors against ground truth."""
    truth = comparison.flight.truth
    if isinstance(truth, Unavailable):
        return None
    time_s, position_m = _positions(comparison)
    true_m = truth.samples[Columns.POSITION[:2]].dropna()
    is_inside = (time_s > true_m.index[0]) & (time_s < true_m.index[-1])
    time_s, position_m = time_s[is_inside], position_m[is_inside]
    if len(time_s) < MIN_POSITIONS:
        return None
    true_spline = CubicSpline(true_m.index, true_m)
    path_m, velocity_m_s = true_spline(time_s), true_spline(time_s, 1)
    path_m = path_m - path_m.mean(axis=0)
    path_square_m2 = float(np.mean(np.sum(path_m**2, axis=1)))
    if path_square_m2 < MIN_PATH_RMS_M**2:
        return None
    columns = np.stack(
        [
            *np.broadcast_to(np.eye(2)[:, None], (2, len(time_s), 2)),
            path_m,
            _rotate_90(path_m),
            -velocity_m_s,
        ],
        axis=-1,
    )
    error_m = position_m - true_spline(time_s)
    parameters, remaining_m = _least_squares(columns, error_m)
    # Successive errors are correlated, so fewer errors are independent
    interval_s = float(np.median(np.diff(time_s)))
    independent_count = len(time_s) / max(*map(autocorrelation_time, remaining_m.T), 1.0)
    sigma = np.sqrt(np.mean(remaining_m**2) / (path_square_m2 * independent_count))
    if comparison.source.origin.may_drift:
        window_rows = max(1, round(DRIFT_WINDOW_S / interval_s))

        def high_pass(values: Array) -> Array:
            return values - uniform_filter1d(values, window_rows, axis=0)

        _, remaining_m = _least_squares(high_pass(columns)[..., 2:], high_pass(error_m))
    white_m = SIGMA_PER_MEDIAN * float(np.median(np.abs(white.residual_m)))
    return ErrorFit(
        time_s,
        velocity_m_s,
        path_m,
        columns,
        remaining_m,
        white_m,
        float(parameters[2]),
        float(sigma),
    )


def _least_squares(columns: Array, values: Array) -> tuple[Array, Array]:
    """Fit ``columns``, shape (n, 2, k), to values; return the k parameters and the residuals."""
    rows = columns.reshape(-1, columns.shape[-1])
    parameters = np.asarray(np.linalg.lstsq(rows, values.ravel(), rcond=None)[0], dtype=np.float64)
    return parameters, values - columns @ parameters


def find_periodic_error(fit: ErrorFit) -> PeriodicError | None:
    """Find a sinusoidal error that explains most of the error beyond white noise.

    Return None without such an error, or if the motion contains its frequency.
    """
    duration_s = fit.time_s[-1] - fit.time_s[0]
    highest_hz = min(MAX_FREQUENCY_HZ, 0.25 / float(np.median(np.diff(fit.time_s))))
    step_hz = FREQUENCY_STEP_PERIODS / duration_s
    rows = slice(round(MIN_PERIODS / FREQUENCY_STEP_PERIODS), int(np.ceil(highest_hz / step_hz)))
    if rows.stop <= rows.start or fit.compute_slow_square_m2() <= 0.0:
        return None
    # errors in bins of equal length have the spectrum of all frequencies in one FFT
    bin_count = 2 ** int(np.ceil(np.log2(MIN_BINS_PER_PERIOD * highest_hz / step_hz)))
    bin_indices = np.rint((fit.time_s - fit.time_s[0]) * step_hz * bin_count).astype(int)
    spectrum = np.fft.rfft(
        [np.bincount(bin_indices, error, bin_count) for error in fit.remaining_m.T]
    )
    powers = np.sum(np.abs(spectrum[:, rows]) ** 2, axis=0)
    frequency_hz = float(step_hz * (rows.start + np.argmax(powers)))

    def mean_squares(values: Array, frequency_hz: float) -> float:
        wave = np.exp(-2j * np.pi * frequency_hz * fit.time_s)
        return 2.0 * float(np.sum(np.abs(wave @ values / len(values)) ** 2))

    square_m2 = mean_squares(fit.remaining_m, frequency_hz)
    motion_fraction = mean_squares(fit.path_m, frequency_hz) / np.mean(
        np.sum(fit.path_m**2, axis=1)
    )
    amplitude_m, fraction = (
        float(np.sqrt(2.0 * square_m2)),
        square_m2 / fit.compute_slow_square_m2(),
    )
    if (
        fraction < MIN_PERIODIC_FRACTION
        or amplitude_m < MIN_AMPLITUDE_SIGMAS * fit.white_m
        or motion_fraction > MAX_MOTION_FRACTION
    ):
        return None
    return PeriodicError(1.0 / frequency_hz, amplitude_m, fraction)


def find_offset_variation(fit: ErrorFit) -> OffsetVariation | None:
    """Return the range of the time offset in flight if it explains the error beyond white noise.

    The time offsets of all flight parts and the parameters of :class:`ErrorFit` are fitted
    together. A time offset causes no error at rest, so it does not explain a jump or drift.
    """
    part_indices = np.floor((fit.time_s - fit.time_s[0]) / OFFSET_PART_S).astype(int)
    square_sums = np.bincount(part_indices, np.sum(fit.velocity_m_s**2, axis=1))
    square_speeds = square_sums / np.maximum(np.bincount(part_indices), 1)
    moving_parts = np.flatnonzero(square_speeds > MIN_OFFSET_SPEED_M_S**2)
    if len(moving_parts) < 2:
        return None
    # a time offset has an effect in its part only: it is eliminated there, before the constants
    effect = -fit.velocity_m_s
    inverse_squares = np.zeros_like(square_sums)
    inverse_squares[moving_parts] = 1.0 / square_sums[moving_parts]

    def fit_offsets(values: Array) -> Array:
        sums = np.zeros((len(inverse_squares), values.shape[-1]))
        np.add.at(sums, part_indices, np.einsum("na,nak->nk", effect, values))
        return sums * inverse_squares[:, None]

    # the constants without the constant time offset, and the error
    columns = np.concatenate([fit.columns[..., :-1], fit.remaining_m[..., None]], axis=-1)
    offsets_by_column_s = fit_offsets(columns)
    columns -= effect[:, :, None] * offsets_by_column_s[part_indices, None]
    parameters, remaining_m = _least_squares(columns[..., :-1], columns[..., -1])
    offsets_s = (offsets_by_column_s @ np.append(-parameters, 1.0))[moving_parts]
    remaining_square_m2 = float(np.mean(remaining_m**2, axis=0).sum()) - 2.0 * fit.white_m**2
    if (
        np.ptp(offsets_s) < MIN_OFFSET_RANGE_S
        or fit.compute_slow_square_m2() < MIN_SLOW_RATIO * 2.0 * fit.white_m**2
        or remaining_square_m2 > MAX_REMAINING_FRACTION * fit.compute_slow_square_m2()
    ):
        return None
    times_s = fit.time_s[0] + OFFSET_PART_S * (moving_parts + 0.5)
    extreme_indices = [int(np.argmin(offsets_s)), int(np.argmax(offsets_s))]
    return OffsetVariation(*offsets_s[extreme_indices].tolist(), *times_s[extreme_indices].tolist())


def find_attitude_delay(imu: pd.DataFrame, attitude: pd.DataFrame) -> float | None:
    """Return the time (s) by which the logged attitude is late, if it is not zero."""
    imu_time_s, attitude_time_s = imu.index.to_numpy(), attitude.index.to_numpy()
    start_s, end_s = (
        max(imu_time_s[0], attitude_time_s[0]),
        min(imu_time_s[-1], attitude_time_s[-1]),
    )
    time_s = np.arange(start_s + MAX_ATTITUDE_DELAY_S, end_s - MAX_ATTITUDE_DELAY_S, DELAY_STEP_S)
    time_s = time_s[:MAX_ROTATIONS]
    step_rows = round(ROTATION_STEP_S / DELAY_STEP_S)
    if len(time_s) < MIN_POSITIONS:
        return None
    imu = rows_between(
        imu, time_s[0] - 2.0 * MAX_ATTITUDE_DELAY_S, time_s[-1] + 2.0 * MAX_ATTITUDE_DELAY_S
    )
    imu_time_s = imu.index.to_numpy()
    quaternions = interpolate(time_s, attitude_time_s, attitude[Columns.QUATERNION].to_numpy())
    rotation_rad = to_vector(multiply(conjugate(quaternions[:-step_rows]), quaternions[step_rows:]))
    angle_rad = cumulative_integral(imu[Columns.ANGULAR_RATE].to_numpy(), imu_time_s)

    def difference(delay_s: float) -> float:
        angles = [np.interp(time_s - delay_s, imu_time_s, column) for column in angle_rad.T]
        differences_rad = (
            rotation_rad - (np.array(angles)[:, step_rows:] - np.array(angles)[:, :-step_rows]).T
        )
        differences_rad -= np.median(differences_rad, axis=0)  # the gyroscope bias
        # Each difference is limited, because resets of the attitude cause large differences
        difference_norms_rad = np.minimum(np.linalg.norm(differences_rad, axis=1), MAX_ROTATION_RAD)
        return float(np.mean(difference_norms_rad**2))

    delays_s = np.arange(-MAX_ATTITUDE_DELAY_S, MAX_ATTITUDE_DELAY_S, 2.0 * DELAY_STEP_S)
    delay_s = float(min(delays_s, key=difference))
    is_late = abs(delay_s) >= MIN_ATTITUDE_DELAY_S and difference(
        delay_s
    ) < MAX_DELAYED_RATIO * difference(0.0)
    return delay_s if is_late else None
