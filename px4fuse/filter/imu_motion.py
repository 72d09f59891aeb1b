"""Motion integrated from the IMU, and its derivatives with respect to constant errors.

A segment is a part of the flight, at most 30 s long, without a gap in IMU or attitude. The attitude
is integrated from the gyroscopes, starting at EKF2's attitude. EKF2's later attitude is not used,
because EKF2 corrected it with the positions to be tested.

The constant errors are those of initial attitude, gyros, accelerometers and position scale. For
small errors, the motion is linear in them.

The derivative of the positions with respect to their scale factor is the path itself. For this
path, a smooth curve through the measured positions is used. The path from the IMU alone is not
used, because its noise would bias the estimated scale (errors in variables, Fuller 1987).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.core.arrays import (
    Array,
    IntArray,
    compute_median_interval_s,
    integrate_cumulatively,
    interpolate_columns,
)
from px4fuse.core.record import Span
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_rotation_vector,
    interpolate,
    multiply,
    rotate,
    skew,
    to_rotation_matrix,
    to_rotation_vector,
)

from .fitting import (
    NoiseFit,
    NoiseParameters,
    fit_constant_errors,
    maximise_likelihood,
)
from .marginal_likelihood import (
    PositionFit,
    PositionsAndIncrements,
    subtract_smooth_path,
)
from .model import compute_continuous_unit_density_process_noise
from .signals import Segment, find_gap_free_spans

# Prior σ (rad) of the errors of tilt and heading at the start of a segment
HEADING_SIGMA_RAD = 0.05
# Prior σ of the constant errors of a segment: initial attitude (rad), gyro bias (rad/s) and
# accelerometer bias (m/s²) along three axes, and position scale (1)
PRIOR_SIGMAS_OF_CONSTANT_ERRORS = np.repeat([HEADING_SIGMA_RAD, 0.004, 0.3, 0.1], [3, 3, 3, 1])
# Index of the heading error in the array of constant errors. In arrays of motion and its
# derivatives with respect to these errors, the index is larger by 1, because index 0 is the motion
HEADING_INDEX_IN_CONSTANT_ERRORS = 2
# A gyro bias above this limit (rad/s; 5 σ of the prior) is subtracted from the gyro data before the
# constant errors are fitted to the positions
MAX_UNCORRECTED_GYRO_BIAS_RAD_S = 0.02
# Maximum gyro bias (rad/s) that EKF2 can remove from its attitude: the maximum of EKF2_GYR_B_LIM
MAX_REMOVED_GYRO_BIAS_RAD_S = 0.4
# Maximum length (s) of a segment: attitude errors must stay small for the linearisation
MAX_SEGMENT_DURATION_S = 30.0
# Maximum tested time offset (s) between position source and IMU
MAX_TESTED_TIME_OFFSET_S = 0.6
COARSE_OFFSET_COUNT = 25
COARSE_SEARCH_MEASUREMENT_COUNT = 600
# Minimum number of position measurements in all segments together
MIN_TOTAL_MEASUREMENTS = 30
MIN_SEGMENT_MEASUREMENTS = 15
# Minimum number of position measurements in a segment after downsampling
MIN_KEPT_MEASUREMENTS = 5
# Interval (s) over which the IMU is averaged before integration
INTEGRATION_STEP_S = 0.02
# Prior precision of the initial position (1/m²) and velocity (s²/m²) of a segment: small, but not
# zero, so that the matrix of the normal equations is not singular
INITIAL_STATE_PRIOR_PRECISIONS = 1e-6, 1e-4
# Maximum number of array elements at once, to limit the memory
MAX_BATCH_ELEMENTS = 2**16
# Maximum median interval (s) between IMU samples
MAX_IMU_INTERVAL_S = 0.025


@dataclass(frozen=True)
class SegmentMotion:
    """Motion of one segment from the IMU, and its derivatives with respect to IMU errors.

    ``motion_and_imu_error_derivatives``, shape (2, 3, 10, times), contains position and velocity
    along NED. The third dimension is the motion, then its nine derivatives: with respect to initial
    attitude error, gyro bias and accelerometer bias, along three axes each.
    """

    time_s: Array
    motion_and_imu_error_derivatives: Array

    def interpolate(self, time_s: Array) -> tuple[Array, Array]:
        """Return position and velocity at other times, each with the shape (3, 10, ...).

        The second dimension contains the motion from the IMU, then its nine derivatives: with
        respect to initial attitude error, gyro bias and accelerometer bias, along three axes each.
        """
        last_index = len(self.time_s) - 2
        row = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, last_index)
        elapsed_s = time_s - self.time_s[row]
        position, velocity = self.motion_and_imu_error_derivatives.take(row, axis=-1)
        next_velocity = self.motion_and_imu_error_derivatives[1].take(row + 1, axis=-1)
        acceleration = (next_velocity - velocity) / INTEGRATION_STEP_S
        position += elapsed_s * (velocity + (0.5 * elapsed_s) * acceleration)
        velocity += elapsed_s * acceleration
        return position, velocity


# Motion that is already computed for segments of a flight, by start and end time (s)
MotionCache = dict[Span, SegmentMotion]


@dataclass(frozen=True)
class PositionsAndImuMotion:
    """Position measurements, and the IMU motion at their times.

    Symbols in shapes: s segments, m measurements, a axes.

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        Positions relative to the segment's first position; NaN if missing.
    measurement_weights : ndarray, shape (m,)
        The variance of a measurement is SIGMA_Z² / weight.
    segment_edges : ndarray of int, shape (s + 1,)
        Index of the first measurement of each segment, then m.
    axis_directions : ndarray, shape (a, 3)
        Unit vectors of the axes in NED.
    dt_s : float
        DT, the interval for which SIGMA_A is defined.
    heading_sigma_rad : float
        Prior σ of the heading at the start of a segment.
    """

    time_s: Array
    measurement_m: Array
    measurement_weights: Array
    segment_edges: IntArray
    segment_motions: tuple[SegmentMotion, ...]
    axis_directions: Array
    dt_s: float
    imu_interval_s: float
    heading_sigma_rad: float = HEADING_SIGMA_RAD

    def downsample(self, max_measurement_count: int) -> PositionsAndImuMotion:
        """Keep about ``max_measurement_count`` measurements; drop segments with too few of them."""
        is_kept = (
            np.arange(len(self.time_s)) % max(1, round(len(self.time_s) / max_measurement_count))
            == 0
        )
        kept_measurement_counts = np.add.reduceat(is_kept.astype(int), self.segment_edges[:-1])
        has_enough_measurements = kept_measurement_counts >= MIN_KEPT_MEASUREMENTS
        if not has_enough_measurements.any():
            return self
        is_kept &= np.repeat(has_enough_measurements, np.diff(self.segment_edges))
        return replace(
            self,
            time_s=self.time_s[is_kept],
            measurement_m=self.measurement_m[is_kept],
            measurement_weights=self.measurement_weights[is_kept],
            segment_edges=np.cumsum([0, *kept_measurement_counts[has_enough_measurements]]),
            segment_motions=tuple(compress(self.segment_motions, has_enough_measurements)),
        )

    def make_positions_and_increments(self, time_offsets_s: Array) -> PositionsAndIncrements:
        """Return the positions, and the IMU increments Δp and Δv between them.

        The increments have one row for each time offset. Their derivatives with respect to the
        scale factor of the positions are zero. A fit to the result therefore assumes a scale factor
        of 1.
        """
        interval_s = np.diff(self.time_s)
        process_noise_per_sigma_a_squared = self.dt_s * np.stack(
            compute_continuous_unit_density_process_noise(interval_s)
        )
        prior_precision = np.zeros((len(self.time_s), 2))
        prior_precision[self.segment_edges[:-1]] = INITIAL_STATE_PRIOR_PRECISIONS
        # Columns: increment of the motion from the IMU, its derivatives with respect to nine
        # constant errors of attitude and IMU, and its derivative with respect to the scale factor
        # error
        column_count = 1 + len(PRIOR_SIGMAS_OF_CONSTANT_ERRORS)
        dp, dv = np.zeros(
            (2, len(self.axis_directions), len(time_offsets_s), column_count, len(interval_s))
        )
        for begin, end, segment_motion in zip(
            self.segment_edges, self.segment_edges[1:], self.segment_motions, strict=False
        ):
            measurement_time_s = self.time_s[begin:end]
            # Shape (axes, time offsets, 10, times). The third dimension is the motion from the IMU,
            # then its derivatives with respect to the nine constant errors of attitude and IMU.
            # tensordot projects NED onto the axes, and swapaxes puts the time offsets second
            position, velocity = (
                np.swapaxes(np.tensordot(self.axis_directions, signal, 1), 1, 2)
                for signal in segment_motion.interpolate(
                    measurement_time_s + time_offsets_s[:, None]
                )
            )
            # All columns except that of the scale factor error, in the intervals of this segment
            interval_rows = np.s_[:, :, :-1, begin : end - 1]
            dv[interval_rows] = np.diff(velocity)
            dp[interval_rows] = np.diff(position) - velocity[..., :-1] * np.diff(measurement_time_s)
        prior_sigmas = PRIOR_SIGMAS_OF_CONSTANT_ERRORS.copy()
        prior_sigmas[HEADING_INDEX_IN_CONSTANT_ERRORS] = self.heading_sigma_rad
        return PositionsAndIncrements(
            measurement_m=self.measurement_m,
            segment_start_indices=self.segment_edges[:-1],
            interval_s=interval_s,
            process_noise_per_sigma_a_squared=process_noise_per_sigma_a_squared,
            process_noise_independent_of_sigma_a=np.zeros_like(process_noise_per_sigma_a_squared),
            prior_precision=prior_precision,
            prior_sigmas_of_constant_errors=prior_sigmas,
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )

    def make_positions_at_offset(self, offset_s: float) -> PositionsAndIncrements:
        """Return the positions, and the IMU increments Δp and Δv for one time offset.

        The scale factor of the positions can be estimated from the result.
        """
        positions = self.make_positions_and_increments(np.array([offset_s]))
        return subtract_smooth_path(positions, estimates_scale=True)

    def make_position_batches(
        self, time_offsets_s: Array, *, estimates_scale: bool = True
    ) -> Iterator[PositionsAndIncrements]:
        """Yield positions and IMU increments of a few flight segments at once.

        The increments have one row for each time offset. With ``estimates_scale``, they contain the
        derivative with respect to the scale factor error of the positions, so a fit estimates this
        error. Otherwise a fit assumes the scale factor 1. Small batches limit the memory.
        """
        element_count = (
            len(time_offsets_s) * self.measurement_m.size * len(PRIOR_SIGMAS_OF_CONSTANT_ERRORS)
        )
        segment_count = len(self.segment_motions)
        batch_count = min(-(-element_count // MAX_BATCH_ELEMENTS), segment_count)
        for batch in np.array_split(np.arange(segment_count), batch_count):
            # Starts of the segments of the batch, and end of the last segment
            edges = self.segment_edges[batch[0] : batch[-1] + 2]
            rows = slice(edges[0], edges[-1])
            batch_motion = replace(
                self,
                time_s=self.time_s[rows],
                measurement_m=self.measurement_m[rows],
                segment_edges=edges - edges[0],
                segment_motions=self.segment_motions[batch[0] : batch[-1] + 1],
            )
            positions = batch_motion.make_positions_and_increments(time_offsets_s)
            yield (
                subtract_smooth_path(positions, estimates_scale=True)
                if estimates_scale
                else positions
            )

    def fit_at_offsets(
        self, time_offsets_s: Array, noise_parameters: NoiseParameters
    ) -> PositionFit:
        """Fit the constant errors of attitude and IMU (such as biases) for each time offset.

        The reference are the positions, shifted by the time offset.
        """
        return fit_constant_errors(
            self.make_position_batches(time_offsets_s), noise_parameters, self.measurement_weights
        )

    def fit_noises(
        self, offset_s: float, start_parameters: NoiseParameters, *, fits_outliers: bool = False
    ) -> NoiseFit:
        """Estimate the noises of IMU and positions for a given time offset of the positions.

        With ``fits_outliers``, the fraction and σ of outliers are estimated, too.
        """
        return maximise_likelihood(
            [self.make_positions_at_offset(offset_s)],
            start_parameters,
            self.measurement_weights,
            fits_outliers,
        )

    def search_time_offset(
        self,
        noise_parameters: NoiseParameters,
        sigma_a_factors: Sequence[float] = (1.0,),
        *,
        estimates_scale: bool = True,
    ) -> tuple[float, NoiseParameters]:
        """Return the most likely time offset (s), and the noises with the most likely SIGMA_A.

        Each time offset of a coarse grid is tested with several values of SIGMA_A: the value in
        ``noise_parameters``, multiplied by each of ``sigma_a_factors``. The other noises are not
        changed. With ``estimates_scale``, the scale factor of the positions is estimated; otherwise
        it is 1.
        """
        tested_offsets_s = np.linspace(
            -MAX_TESTED_TIME_OFFSET_S, MAX_TESTED_TIME_OFFSET_S, COARSE_OFFSET_COUNT
        )
        downsampled_motion = self.downsample(COARSE_SEARCH_MEASUREMENT_COUNT)
        position_batches = [
            *downsampled_motion.make_position_batches(
                tested_offsets_s, estimates_scale=estimates_scale
            )
        ]
        candidates = [
            replace(noise_parameters, sigma_a_m_s2=factor * noise_parameters.sigma_a_m_s2)
            for factor in sigma_a_factors
        ]
        # Rows: SIGMA_A; columns: time offsets
        minus_log_likelihood = np.concatenate(
            [
                fit_constant_errors(
                    position_batches, candidate, downsampled_motion.measurement_weights
                ).compute_scores()
                for candidate in candidates
            ]
        )
        best_row, best_column = divmod(int(np.argmin(minus_log_likelihood)), COARSE_OFFSET_COUNT)
        return float(tested_offsets_s[best_column]), candidates[best_row]


def compute_imu_motion(
    flight: Flight,
    time_s: Array,
    measurement_m: Array,
    *,
    axis_directions: Array,
    dt_s: float,
    measurement_weights: Array | None = None,
    motion_cache: MotionCache | None = None,
    heading_sigma_rad: float = HEADING_SIGMA_RAD,
    max_segment_duration_s: float = MAX_SEGMENT_DURATION_S,
) -> PositionsAndImuMotion | Unavailable:
    """Split positions into segments without an IMU gap, and integrate the IMU in each segment.

    Parameters
    ----------
    time_s, measurement_m : ndarray, shape (m,) and (m, a)
        Positions (m) and their times.
    axis_directions, dt_s, measurement_weights, heading_sigma_rad
        See :class:`PositionsAndImuMotion`; weights are 1 by default.
    motion_cache : dict, optional
        IMU motion that is already computed; new motion is added.
    max_segment_duration_s : float
        Maximum length of a segment.
    """
    imu = flight.imu
    attitude = flight.attitude
    if isinstance(imu, Unavailable):
        return imu
    if isinstance(attitude, Unavailable):
        return attitude
    motion_cache = {} if motion_cache is None else motion_cache
    imu_time_s = imu.index.to_numpy()
    covered_spans_s = _find_covered_spans(imu_time_s, attitude.index.to_numpy())
    rows_by_segment = _split_into_segments(time_s, covered_spans_s, max_segment_duration_s)
    segment_motions = []
    for rows in rows_by_segment:
        imu_span_s = (
            time_s[rows[0]] - MAX_TESTED_TIME_OFFSET_S,
            time_s[rows[-1]] + MAX_TESTED_TIME_OFFSET_S,
        )
        if imu_span_s not in motion_cache:
            motion_cache[imu_span_s] = make_segment_motion(imu, attitude, imu_span_s)
        segment_motions.append(motion_cache[imu_span_s])
    used_rows = np.concatenate([np.zeros(0, dtype=np.intp), *rows_by_segment])
    if len(used_rows) < MIN_TOTAL_MEASUREMENTS:
        return Unavailable(
            "time offset",
            f"only {len(used_rows)} positions have IMU and attitude data (at least "
            f"{MIN_TOTAL_MEASUREMENTS} are needed)",
            "Analyse a longer segment.",
        )
    segment_edges = np.cumsum([0, *map(len, rows_by_segment)])
    # Positions relative to the first position of a segment have smaller rounding errors. "first" is
    # the first position of each axis that is not missing
    measured_m = pd.DataFrame(measurement_m[used_rows])
    segment_index = np.repeat(np.arange(len(rows_by_segment)), np.diff(segment_edges))
    first_position_m = measured_m.groupby(segment_index).transform("first")
    return PositionsAndImuMotion(
        time_s[used_rows],
        (measured_m - first_position_m).to_numpy(),
        np.ones(len(used_rows)) if measurement_weights is None else measurement_weights[used_rows],
        segment_edges,
        tuple(segment_motions),
        axis_directions,
        dt_s,
        compute_median_interval_s(imu_time_s),
        heading_sigma_rad,
    )


def _split_into_segments(
    time_s: Array, covered_spans_s: tuple[Span, ...], max_segment_duration_s: float
) -> list[IntArray]:
    """Return the rows of the positions in each segment.

    A segment is inside a span with IMU data, with a margin for the tested time offsets.
    """
    rows_by_segment = []
    for begin_s, end_s in covered_spans_s:
        rows = np.flatnonzero(
            (time_s >= begin_s + MAX_TESTED_TIME_OFFSET_S)
            & (time_s <= end_s - MAX_TESTED_TIME_OFFSET_S)
        )
        if not len(rows):
            continue
        first_s, last_s = time_s[rows[[0, -1]]]
        segment_count = max(1, int(np.ceil((last_s - first_s) / max_segment_duration_s)))
        cut_times_s = np.linspace(first_s, last_s, segment_count + 1)[1:-1]
        rows_by_segment += np.split(rows, np.searchsorted(time_s[rows], cut_times_s))
    return [rows for rows in rows_by_segment if len(rows) >= MIN_SEGMENT_MEASUREMENTS]


def _find_covered_spans(imu_time_s: Array, attitude_time_s: Array) -> tuple[Span, ...]:
    """Find time spans (s) without a gap in IMU or attitude; none if the IMU rate is too low."""
    if len(imu_time_s) < 2 or compute_median_interval_s(imu_time_s) > MAX_IMU_INTERVAL_S:
        return ()
    start_s = max(imu_time_s[0], attitude_time_s[0])
    end_s = min(imu_time_s[-1], attitude_time_s[-1])
    return Segment(start_s, end_s, reason="").clip_spans(find_gap_free_spans(imu_time_s))


def make_segment_motion(
    imu: pd.DataFrame, attitude: pd.DataFrame, imu_span_s: Span
) -> SegmentMotion:
    """Compute the motion in NED from the IMU, and its derivatives with respect to IMU errors."""
    margin_s = 2 * INTEGRATION_STEP_S
    first_row, end_row = np.searchsorted(
        imu.index.to_numpy(), [imu_span_s[0] - margin_s, imu_span_s[1] + margin_s]
    )
    # Compute the integrals of specific force and angular rate at the ends of equal steps
    imu = imu.iloc[first_row:end_row]
    imu_time_s = imu.index.to_numpy()
    step_times_s = np.arange(imu_time_s[0], imu_time_s[-1], INTEGRATION_STEP_S)
    specific_force_integral_m_s, gyro_integral_rad = (
        interpolate_columns(
            step_times_s, imu_time_s, integrate_cumulatively(imu[names].to_numpy(), imu_time_s)
        )
        for names in (Columns.SPECIFIC_FORCE, Columns.ANGULAR_RATE)
    )
    # The attitude starts at the logged attitude and follows the gyro, without a large gyro bias.
    # The first selected attitude sample is before the first step, for interpolation at this step
    attitude_time_s = attitude.index.to_numpy()
    first_row, end_row = np.searchsorted(attitude_time_s, step_times_s[[0, -1]], side="right")
    attitude_samples = attitude.iloc[max(first_row - 1, 0) : end_row][Columns.QUATERNION]
    attitude_time_s, quaternions = attitude_samples.index.to_numpy(), attitude_samples.to_numpy()
    gyro_integral_rad -= np.outer(
        step_times_s,
        _estimate_large_gyro_bias(step_times_s, gyro_integral_rad, attitude_time_s, quaternions),
    )
    step_rotations_rad = np.diff(gyro_integral_rad, axis=0)
    initial_attitude = interpolate(step_times_s[:1], attitude_time_s, quaternions)
    attitude_quaternion = cumulative_product(
        np.concatenate([initial_attitude, from_rotation_vector(step_rotations_rad)])
    )
    # Compute the acceleration and its derivatives, with one row for each step. The mean specific
    # force f of a step is rotated by the attitude in the middle of the step
    mean_specific_force_m_s2 = np.diff(specific_force_integral_m_s, axis=0) / INTEGRATION_STEP_S
    body_to_ned = to_rotation_matrix(
        multiply(attitude_quaternion[:-1], from_rotation_vector(step_rotations_rad / 2.0))
    )
    specific_force_ned_m_s2 = rotate(body_to_ned, mean_specific_force_m_s2)
    acceleration_ned_m_s2 = specific_force_ned_m_s2 + np.array([0.0, 0.0, constants.g])
    # An attitude error θ adds θ × f = -[f]× θ to the acceleration; a gyro bias b causes
    # θ = -∫ R b dt; an accelerometer bias b adds -R b
    acceleration_by_attitude_error = -skew(specific_force_ned_m_s2)
    attitude_error_by_gyro_bias = -INTEGRATION_STEP_S * (
        np.cumsum(body_to_ned, axis=0) - body_to_ned / 2.0
    )
    acceleration_and_derivatives = np.concatenate(
        [
            acceleration_ned_m_s2[:, :, None],
            acceleration_by_attitude_error,
            acceleration_by_attitude_error @ attitude_error_by_gyro_bias,
            -body_to_ned,
        ],
        axis=2,
    )
    # Integrate the acceleration and its nine derivatives twice, shape (3, 10, steps). np.cumsum
    # writes into position and velocity, which are views of the returned array
    acceleration = np.ascontiguousarray(np.moveaxis(acceleration_and_derivatives, 0, -1))
    motion_and_imu_error_derivatives = np.zeros((2, *acceleration.shape))
    position, velocity = motion_and_imu_error_derivatives
    velocity_increments = acceleration[..., :-1] * INTEGRATION_STEP_S
    np.cumsum(velocity_increments, axis=-1, out=velocity[..., 1:])
    mean_velocity = velocity[..., :-1] + velocity_increments / 2.0
    np.cumsum(mean_velocity * INTEGRATION_STEP_S, axis=-1, out=position[..., 1:])
    return SegmentMotion(step_times_s[:-1], motion_and_imu_error_derivatives)


def _estimate_large_gyro_bias(
    step_times_s: Array, gyro_integral_rad: Array, attitude_time_s: Array, quaternions: Array
) -> Array:
    """Return a large gyro bias (rad/s), estimated from the logged attitude.

    A small bias gives zero, because a later fit estimates it. A bias above
    ``MAX_REMOVED_GYRO_BIAS_RAD_S`` gives zero, because the logged attitude is then wrong.
    """
    if len(quaternions) < MIN_KEPT_MEASUREMENTS:
        return np.zeros(3)
    gyro_angle_rad = interpolate_columns(attitude_time_s, step_times_s, gyro_integral_rad)
    rotation_difference_rad = np.diff(gyro_angle_rad, axis=0) - to_rotation_vector(
        multiply(conjugate(quaternions[:-1]), quaternions[1:])
    )
    bias_rad_s = np.median(rotation_difference_rad / np.diff(attitude_time_s)[:, None], axis=0)
    is_bias_removed = (
        MAX_UNCORRECTED_GYRO_BIAS_RAD_S < np.abs(bias_rad_s).max() <= MAX_REMOVED_GYRO_BIAS_RAD_S
    )
    return bias_rad_s if is_bias_removed else np.zeros(3)
