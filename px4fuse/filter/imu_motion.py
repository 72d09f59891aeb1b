"""Motion integrated from the IMU, and its derivatives with respect to constant errors.

A segment is a part of the flight, at most 30 s long, without a gap in IMU or attitude. The attitude
is integrated from the gyroscopes, starting at EKF2's attitude. EKF2's later attitude is not used,
because EKF2 corrected it with the positions to be tested.

The constant errors are those of initial attitude, gyros, accelerometers and position scale. For
small errors, the motion is linear in them.

The derivative with respect to the scale is a smooth path through the positions. Noise of the IMU
motion would bias the scale (errors in variables, Fuller 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.core.arrays import (
    Array,
    IntArray,
    compute_median_interval_s,
    integrate_cumulatively,
)
from px4fuse.core.record import Span
from px4fuse.filter.marginal_likelihood import (
    NoiseParameters,
    PositionFit,
    PositionsAndIncrements,
    fit_constant_errors,
    subtract_smooth_path,
)
from px4fuse.filter.model import compute_continuous_process_noise_per_density
from px4fuse.filter.signals import find_imu_gaps
from px4fuse.flight.model import Columns, Flight, Unavailable, rows_between
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_rotation_vector,
    interpolate,
    multiply,
    rotate,
    to_matrix,
    to_rotation_vector,
)

# Prior σ (rad) of the errors of tilt and heading at the start of a segment
HEADING_SIGMA_RAD = 0.05
# Index of the heading error in the constant errors of a segment
HEADING_ERROR_INDEX = 2
# Prior σ: initial attitude (rad), gyro bias (rad/s), accelerometer bias (m/s²), scale (1)
PRIOR_SIGMAS_OF_SEGMENT_CONSTANTS = np.repeat([HEADING_SIGMA_RAD, 0.004, 0.3, 0.1], [3, 3, 3, 1])
# A larger gyro bias (rad/s) is subtracted before the fit: 5 σ of its prior
MAX_PRIOR_GYRO_BIAS_RAD_S = 0.02
# Maximum gyro bias (rad/s) that EKF2 can remove from its attitude: the maximum of EKF2_GYR_B_LIM
MAX_REMOVED_GYRO_BIAS_RAD_S = 0.4
# Maximum length (s) of a segment: attitude errors must stay small for the linearisation
MAX_SEGMENT_DURATION_S = 30.0
# Maximum tested time offset (s) between position source and IMU
MAX_TESTED_TIME_OFFSET_S = 0.6
# Time offsets (s) in a coarse search
COARSE_TIME_OFFSETS_S = np.linspace(
    -MAX_TESTED_TIME_OFFSET_S, MAX_TESTED_TIME_OFFSET_S, 25
).tolist()
COARSE_MEASUREMENT_COUNT = 600
# Minimum number of position measurements in all segments together
MIN_TOTAL_MEASUREMENTS = 30
MIN_SEGMENT_MEASUREMENTS = 15
# Minimum number of position measurements in a segment after downsampling
MIN_KEPT_MEASUREMENTS = 5
# Interval (s) over which the IMU is averaged before integration
INTEGRATION_STEP_S = 0.02
# Small prior precision of initial position (1/m²) and velocity (s²/m²) against a singular matrix
INITIAL_STATE_PRIOR_PRECISIONS = 1e-6, 1e-4
# Maximum median interval (s) between IMU samples
MAX_IMU_INTERVAL_S = 0.025


@dataclass(frozen=True)
class SegmentMotion:
    """Motion of one segment from the IMU, and its derivatives with respect to IMU errors.

    ``motion_and_derivatives``, shape (times, 2, 3, 10), contains position and velocity along NED.
    The last dimension is the motion, then its derivatives with respect to initial attitude error,
    gyro bias and accelerometer bias.
    """

    time_s: Array
    motion_and_derivatives: Array

    def interpolate(self, time_s: Array) -> tuple[Array, Array]:
        """Return position and velocity at other times, each with the shape (..., 3, 10).

        The last dimension contains the motion, then its derivatives.
        """
        last_index = len(self.time_s) - 2
        row = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, last_index)
        elapsed_s = (time_s - self.time_s[row])[..., None, None]
        position, velocity = np.moveaxis(self.motion_and_derivatives[row], -3, 0)
        acceleration = (self.motion_and_derivatives[row + 1, 1] - velocity) / INTEGRATION_STEP_S
        position += elapsed_s * (velocity + (0.5 * elapsed_s) * acceleration)
        velocity += elapsed_s * acceleration
        return position, velocity


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
    directions : ndarray, shape (a, 3)
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
    directions: Array
    dt_s: float
    imu_interval_s: float
    heading_sigma_rad: float = HEADING_SIGMA_RAD

    def downsample(self, max_measurement_count: int) -> PositionsAndImuMotion:
        """Keep about ``max_measurement_count`` measurements; drop segments with too few of them."""
        is_kept = (
            np.arange(len(self.time_s)) % max(1, round(len(self.time_s) / max_measurement_count))
            == 0
        )
        kept_counts = np.add.reduceat(is_kept.astype(int), self.segment_edges[:-1])
        has_enough_measurements = kept_counts >= MIN_KEPT_MEASUREMENTS
        if not has_enough_measurements.any():
            return self
        is_kept &= np.repeat(has_enough_measurements, np.diff(self.segment_edges))
        return replace(
            self,
            time_s=self.time_s[is_kept],
            measurement_m=self.measurement_m[is_kept],
            measurement_weights=self.measurement_weights[is_kept],
            segment_edges=np.cumsum([0, *kept_counts[has_enough_measurements]]),
            segment_motions=tuple(
                self.segment_motions[index] for index in np.flatnonzero(has_enough_measurements)
            ),
        )

    def make_positions_at_offset(
        self, offset_s: float, *, estimates_scale: bool = True
    ) -> PositionsAndIncrements:
        """Return the positions, and the IMU increments Δp and Δv for one time offset.

        With ``estimates_scale``, the scale factor of the positions can be estimated.
        """
        interval_s = np.diff(self.time_s)
        process_noise_per_sigma_a_squared = self.dt_s * np.stack(
            compute_continuous_process_noise_per_density(interval_s)
        )
        constant_prior_sigmas = PRIOR_SIGMAS_OF_SEGMENT_CONSTANTS.copy()
        constant_prior_sigmas[HEADING_ERROR_INDEX] = self.heading_sigma_rad
        dp, dv = np.zeros(
            (2, len(self.directions), 1 + len(constant_prior_sigmas), len(interval_s))
        )
        for begin, end, segment_motion in zip(
            self.segment_edges, self.segment_edges[1:], self.segment_motions, strict=False
        ):
            measurement_time_s = self.time_s[begin:end]
            # Shape (axes, 1 + constants, times): the motion, then its derivatives
            position, velocity = (
                np.moveaxis(self.directions @ signal, 0, 2)
                for signal in segment_motion.interpolate(measurement_time_s + offset_s)
            )
            # The last constant is the scale factor
            interval_rows = np.s_[:, :-1, begin : end - 1]
            dv[interval_rows] = np.diff(velocity)
            dp[interval_rows] = np.diff(position) - velocity[..., :-1] * np.diff(measurement_time_s)
        positions = PositionsAndIncrements(
            measurement_m=self.measurement_m,
            segment_starts=self.segment_edges[:-1],
            interval_s=interval_s,
            process_noise_per_sigma_a_squared=process_noise_per_sigma_a_squared,
            process_noise_independent_of_sigma_a=np.zeros_like(process_noise_per_sigma_a_squared),
            initial_state_precision=INITIAL_STATE_PRIOR_PRECISIONS,
            is_initial_state_known=False,
            constant_prior_sigmas=constant_prior_sigmas,
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )
        return subtract_smooth_path(positions) if estimates_scale else positions

    def fit_at_offset(self, offset_s: float, noise_parameters: NoiseParameters) -> PositionFit:
        """Fit the constant errors with given time offset and noises."""
        return fit_constant_errors(
            self.make_positions_at_offset(offset_s), noise_parameters, self.measurement_weights
        )

    def search_grid(
        self,
        candidate_parameters: Sequence[NoiseParameters],
        time_offsets_s: Sequence[float] = COARSE_TIME_OFFSETS_S,
        sigma_factors: Sequence[float] = (1.0,),
        *,
        estimates_scale: bool = True,
    ) -> tuple[float, float, NoiseParameters]:
        """Return the lowest score (-ln p), and its time offset (s) and noises.

        ``sigma_factors`` are factors on all σ of the candidates.
        """
        scored_candidates = []
        for offset_s in time_offsets_s:
            positions = self.make_positions_at_offset(offset_s, estimates_scale=estimates_scale)
            for candidate in candidate_parameters:
                position_fit = fit_constant_errors(positions, candidate, self.measurement_weights)
                for factor in sigma_factors:
                    score = position_fit.compute_score(factor)
                    scored_candidates.append((score, offset_s, candidate.multiply_sigmas(factor)))
        return min(scored_candidates, key=lambda scored: scored[0])


def compute_imu_motion(
    flight: Flight,
    time_s: Array,
    measurement_m: Array,
    *,
    directions: Array,
    dt_s: float,
    measurement_weights: Array | None = None,
    heading_sigma_rad: float = HEADING_SIGMA_RAD,
    max_segment_duration_s: float = MAX_SEGMENT_DURATION_S,
) -> PositionsAndImuMotion | Unavailable:
    """Split positions into segments without an IMU gap, and integrate the IMU in each segment.

    Parameters
    ----------
    time_s, measurement_m : ndarray, shape (m,) and (m, a)
        Positions (m) and their times.
    directions, dt_s, measurement_weights, heading_sigma_rad
        See :class:`PositionsAndImuMotion`; weights are 1 by default.
    max_segment_duration_s : float
        Maximum length of a segment.
    """
    imu = flight.imu
    attitude = flight.attitude
    if isinstance(imu, Unavailable):
        return imu
    if isinstance(attitude, Unavailable):
        return attitude
    rows_by_segment: list[IntArray] = []
    imu_time_s, attitude_time_s = imu.index.to_numpy(), attitude.index.to_numpy()
    imu_interval_s = compute_median_interval_s(imu_time_s) if len(imu_time_s) > 1 else np.inf
    imu_parts_s = []
    if imu_interval_s <= MAX_IMU_INTERVAL_S:
        imu_parts_s = np.split(imu_time_s, np.flatnonzero(find_imu_gaps(imu_time_s)) + 1)
    for imu_part_s in imu_parts_s:
        begin_s = max(imu_part_s[0], attitude_time_s[0]) + MAX_TESTED_TIME_OFFSET_S
        end_s = min(imu_part_s[-1], attitude_time_s[-1]) - MAX_TESTED_TIME_OFFSET_S
        covered_rows = np.flatnonzero((time_s >= begin_s) & (time_s <= end_s))
        if not len(covered_rows):
            continue
        first_s, last_s = time_s[covered_rows[[0, -1]]]
        segment_count = max(1, int(np.ceil((last_s - first_s) / max_segment_duration_s)))
        cut_times_s = np.linspace(first_s, last_s, segment_count + 1)[1:-1]
        rows_by_segment += [
            rows
            for rows in np.split(covered_rows, np.searchsorted(time_s[covered_rows], cut_times_s))
            if len(rows) >= MIN_SEGMENT_MEASUREMENTS
        ]
    used_rows = np.concatenate([np.zeros(0, dtype=np.intp), *rows_by_segment])
    if len(used_rows) < MIN_TOTAL_MEASUREMENTS:
        return Unavailable(
            "time offset",
            f"only {len(used_rows)} positions have IMU and attitude data (at least "
            f"{MIN_TOTAL_MEASUREMENTS} are needed)",
            "Analyse a longer segment.",
        )
    segment_edges = np.cumsum([0, *map(len, rows_by_segment)])
    # Positions relative to the first one have smaller rounding errors
    measured_m = pd.DataFrame(measurement_m[used_rows])
    segment_index = np.repeat(np.arange(len(rows_by_segment)), np.diff(segment_edges))
    first_position_m = measured_m.groupby(segment_index).transform("first")
    return PositionsAndImuMotion(
        time_s[used_rows],
        (measured_m - first_position_m).to_numpy(),
        np.ones(len(used_rows)) if measurement_weights is None else measurement_weights[used_rows],
        segment_edges,
        tuple(
            make_segment_motion(
                imu,
                attitude,
                (
                    time_s[rows[0]] - MAX_TESTED_TIME_OFFSET_S,
                    time_s[rows[-1]] + MAX_TESTED_TIME_OFFSET_S,
                ),
            )
            for rows in rows_by_segment
        ),
        directions,
        dt_s,
        imu_interval_s,
        heading_sigma_rad,
    )


def make_segment_motion(
    imu: pd.DataFrame, attitude: pd.DataFrame, imu_span_s: Span
) -> SegmentMotion:
    """Compute the motion in NED from the IMU, and its derivatives with respect to IMU errors."""
    imu = rows_between(
        imu, imu_span_s[0] - 2 * INTEGRATION_STEP_S, imu_span_s[1] + 2 * INTEGRATION_STEP_S
    )
    imu_time_s = imu.index.to_numpy()
    step_times_s = np.arange(imu_time_s[0], imu_time_s[-1], INTEGRATION_STEP_S)
    specific_force_integral_m_s, gyro_integral_rad = (
        _interpolate_columns(
            step_times_s, imu_time_s, integrate_cumulatively(imu[columns].to_numpy(), imu_time_s)
        )
        for columns in (Columns.SPECIFIC_FORCE, Columns.ANGULAR_RATE)
    )
    gyro_bias_rad_s = _estimate_large_gyro_bias(step_times_s, gyro_integral_rad, attitude)
    rotation_rad = np.diff(gyro_integral_rad, axis=0) - INTEGRATION_STEP_S * gyro_bias_rad_s
    attitude_quaternion = _integrate_gyros(step_times_s[0], rotation_rad, attitude)
    # The mean specific force of each step is rotated by the attitude in the middle of the step
    mean_specific_force_m_s2 = np.diff(specific_force_integral_m_s, axis=0) / INTEGRATION_STEP_S
    body_to_ned = to_matrix(
        multiply(attitude_quaternion[:-1], from_rotation_vector(rotation_rad / 2.0))
    )
    specific_force_ned_m_s2 = rotate(body_to_ned, mean_specific_force_m_s2)[:, :, None]
    motion_and_derivatives = np.zeros(
        (len(body_to_ned), 2, 3, len(PRIOR_SIGMAS_OF_SEGMENT_CONSTANTS))
    )
    position, velocity = np.moveaxis(motion_and_derivatives, 1, 0)
    acceleration = np.zeros_like(velocity)
    acceleration[:, :, :1] = specific_force_ned_m_s2
    acceleration[:, 2, 0] += constants.g
    # An attitude error θ adds θ × f to the acceleration; a gyro bias b causes θ = -∫ R b dt
    attitude_error_by_unit_gyro_bias = -INTEGRATION_STEP_S * (
        np.cumsum(body_to_ned, axis=0) - body_to_ned / 2.0
    )
    acceleration[:, :, 1:4] = np.cross(np.eye(3)[None], specific_force_ned_m_s2, axis=1)
    acceleration[:, :, 4:7] = np.cross(
        attitude_error_by_unit_gyro_bias, specific_force_ned_m_s2, axis=1
    )
    acceleration[:, :, 7:10] = -body_to_ned
    increments = INTEGRATION_STEP_S * acceleration[:-1]
    velocity[1:] = np.cumsum(increments, axis=0)
    position[1:] = INTEGRATION_STEP_S * np.cumsum(velocity[:-1] + increments / 2.0, axis=0)
    return SegmentMotion(step_times_s[:-1], motion_and_derivatives)


def _interpolate_columns(times_s: Array, known_times_s: Array, columns: Array) -> Array:
    return np.column_stack([np.interp(times_s, known_times_s, column) for column in columns.T])


def _estimate_large_gyro_bias(
    step_times_s: Array, gyro_integral_rad: Array, attitude: pd.DataFrame
) -> Array:
    """Return a large gyro bias (rad/s), estimated from the logged attitude.

    A small bias gives zero, because a later fit estimates it. A bias above
    ``MAX_REMOVED_GYRO_BIAS_RAD_S`` gives zero, because the logged attitude is then wrong.
    """
    samples = rows_between(attitude, step_times_s[0], step_times_s[-1])[Columns.QUATERNION]
    if len(samples) < MIN_KEPT_MEASUREMENTS:
        return np.zeros(3)
    attitude_time_s, quaternions = samples.index.to_numpy(), samples.to_numpy()
    gyro_angle_rad = _interpolate_columns(attitude_time_s, step_times_s, gyro_integral_rad)
    rotation_difference_rad = np.diff(gyro_angle_rad, axis=0) - to_rotation_vector(
        multiply(conjugate(quaternions[:-1]), quaternions[1:])
    )
    bias_rad_s = np.asarray(
        np.median(rotation_difference_rad / np.diff(attitude_time_s)[:, None], axis=0)
    )
    is_bias_removed = (
        MAX_PRIOR_GYRO_BIAS_RAD_S < np.abs(bias_rad_s).max() <= MAX_REMOVED_GYRO_BIAS_RAD_S
    )
    return bias_rad_s if is_bias_removed else np.zeros(3)


def _integrate_gyros(start_s: float, rotation_rad: Array, attitude: pd.DataFrame) -> Array:
    """Integrate rotations from the gyroscopes to attitudes, starting at the logged attitude.

    The attitudes are quaternions from body to NED, w first.
    """
    row = int(np.searchsorted(attitude.index, start_s))
    nearby_samples = attitude.iloc[max(row - 2, 0) : row + 3]
    start_quaternion = interpolate(
        np.array([start_s]),
        nearby_samples.index.to_numpy(),
        nearby_samples[Columns.QUATERNION].to_numpy(),
    )
    rotation_since_start = cumulative_product(from_rotation_vector(rotation_rad))
    return np.vstack([start_quaternion, multiply(start_quaternion, rotation_since_start)])
