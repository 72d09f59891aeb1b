"""Second differences of the position, from the IMU and from a position source.

A second difference is a double integral of the acceleration a(t), without the unknown initial
position and velocity:

p(t + T) - 2 p(t) + p(t - T) = ∫ (T - |s|) a(t + s) ds, s from -T to T

Subtraction of the running mean removes constant acceleration errors (tilt, bias).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import constants

from px4fuse.core.arrays import (
    Array,
    BoolArray,
    cumulative_sums,
    integrate_cumulatively,
    interpolate_columns,
)
from px4fuse.ekf2.replay import is_inside_spans
from px4fuse.filter.signals import Segment, find_gap_free_spans, interpolate_attitude
from px4fuse.flight.model import Columns, Flight, Spans, Unavailable
from px4fuse.trajectory.association import choose_gap_limit_s, is_bracketed
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_rotation_vector,
    heading,
    multiply,
    rotate,
    to_rotation_matrix,
    to_rotation_vector,
)

from .model import HeadingSource

# Interval T (s) of a second difference p(t + T) - 2 p(t) + p(t - T)
SECOND_DIFFERENCE_WINDOW_S = 2.0
# Interval (s) between successive second differences of the position
GRID_INTERVAL_S = 0.1
# Integration step (s) of accelerometer and gyroscopes
INTEGRATION_STEP_S = 0.02
# High-pass filter of the second differences of the position: length (s) of the running mean that is
# subtracted
HIGH_PASS_WINDOW_S = 12.0
# Length (s) of the centred running mean of the specific force that defines the vertical
GRAVITY_AVERAGING_WINDOW_S = 40.0
# Length (s) of the windows for the estimate of the gyro bias
GYRO_BIAS_WINDOW_S = 1.0
# Minimum interval (s) between two positions that counts as a gap
MIN_POSITION_GAP_S = 0.35


@dataclass(frozen=True)
class InertialData:
    """Specific force and attitude at a constant interval ``INTEGRATION_STEP_S``.

    Attributes
    ----------
    time_s : ndarray, shape (n + 1,)
    specific_force_m_s2 : ndarray, shape (n, 3)
        Mean specific force in the body frame (FRD) between successive times.
    logged_attitude : ndarray, shape (n + 1, 4)
        EKF2's attitude as quaternion (w, x, y, z; FRD to NED).
    gyro_attitude : ndarray, shape (n + 1, 4)
        Attitude integrated from the gyroscopes, with the tilt corrected by gravity.
    valid_spans_s : tuple of (float, float)
        Time spans in flight without a gap in the IMU data.
    """

    time_s: Array
    specific_force_m_s2: Array
    logged_attitude: Array
    gyro_attitude: Array
    valid_spans_s: Spans

    def compute_attitudes(self) -> dict[HeadingSource, Array]:
        """Return the attitude quaternions at ``time_s`` by the source of their heading."""
        return {
            "EKF2": replace_heading(self.gyro_attitude, heading(self.logged_attitude)),
            "gyroscopes": self.gyro_attitude,
        }


@dataclass(frozen=True)
class SourceSecondDifferences:
    """Second differences of a source's positions, in the axes and unit of the source.

    Their interval is constant.
    """

    time_s: Array
    second_differences: Array
    is_valid: BoolArray

    @classmethod
    def from_positions(
        cls, time_s: Array, position: Array, grid_s: Array
    ) -> "SourceSecondDifferences":
        """Compute second differences of positions at the times ``grid_s`` (s)."""
        window_steps = round(SECOND_DIFFERENCE_WINDOW_S / GRID_INTERVAL_S)
        position_times_s = grid_s[0] + GRID_INTERVAL_S * np.arange(
            -window_steps, len(grid_s) + window_steps
        )
        has_near_samples = is_bracketed(
            position_times_s, time_s, choose_gap_limit_s(time_s, MIN_POSITION_GAP_S)
        )
        interpolated_positions = interpolate_columns(position_times_s, time_s, position)
        is_valid = (
            has_near_samples[2 * window_steps :]
            & has_near_samples[window_steps:-window_steps]
            & has_near_samples[: -2 * window_steps]
        )
        return cls(
            grid_s,
            high_pass(compute_second_differences(interpolated_positions, window_steps), is_valid),
            is_valid,
        )


@dataclass(frozen=True)
class ImuSecondDifferences:
    """Second differences of the vehicle's position (m, NED), integrated from the IMU.

    A second difference is p(t + T) - 2 p(t) + p(t - T), with T = SECOND_DIFFERENCE_WINDOW_S.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    is_valid : ndarray of bool, shape (n,)
    table : ndarray, shape (n, 3, 4)
        Second difference, and its derivatives with respect to the accelerometer bias (FRD, m/s²).
    """

    time_s: Array
    is_valid: BoolArray
    table: Array

    @cached_property
    def second_difference_derivative_m_s(self) -> Array:
        """Time derivative (m/s) of the second difference of the position, shape (n, 3)."""
        return np.gradient(self.table[..., 0], GRID_INTERVAL_S, axis=0)


def integrate_inertial_data(flight: Flight) -> InertialData | None:
    """Integrate the gyroscopes of a flight to an attitude without EKF2's corrections."""
    imu, attitude = flight.imu, flight.attitude
    if isinstance(imu, Unavailable) or isinstance(attitude, Unavailable):
        return None
    imu_times_s, attitude_times_s = imu.index.to_numpy(), attitude.index.to_numpy()
    time_s = np.arange(
        max(imu_times_s[0], attitude_times_s[0]),
        min(imu_times_s[-1], attitude_times_s[-1]),
        INTEGRATION_STEP_S,
    )
    if len(time_s) < 4 * SECOND_DIFFERENCE_WINDOW_S / INTEGRATION_STEP_S:
        return None
    # Mean specific force and rotation in each step: differences of their integrals over time
    imu_integrals = [
        np.interp(time_s, imu_times_s, integrate_cumulatively(imu[name].to_numpy(), imu_times_s))
        for name in Columns.SPECIFIC_FORCE + Columns.ANGULAR_RATE
    ]
    imu_increments = np.diff(imu_integrals).T
    specific_force_m_s2 = imu_increments[:, :3] / INTEGRATION_STEP_S
    logged_attitude = interpolate_attitude(attitude, time_s)
    gyro_attitude = _level_attitude(
        _integrate_gyros(imu_increments[:, 3:], logged_attitude), specific_force_m_s2
    )
    airborne_spans_s = flight.airborne
    if isinstance(airborne_spans_s, Unavailable):
        airborne_spans_s = ((time_s[0], time_s[-1]),)
    gap_free_spans_s = find_gap_free_spans(imu_times_s)
    return InertialData(
        time_s,
        specific_force_m_s2,
        logged_attitude,
        gyro_attitude,
        tuple(
            valid_span_s
            for start_s, end_s in airborne_spans_s
            for valid_span_s in Segment(start_s, end_s, reason="").clip_spans(gap_free_spans_s)
        ),
    )


def _integrate_gyros(rotation_rad: Array, logged_attitude: Array) -> Array:
    """Subtract the bias of the gyroscopes and integrate them from the first logged attitude.

    The bias is estimated from the difference between gyroscopes and logged attitude, as the median
    over time windows. The median limits the effect of heading resets in the logged attitude.
    """
    gyro_error_rad = rotation_rad - to_rotation_vector(
        multiply(conjugate(logged_attitude[:-1]), logged_attitude[1:])
    )
    gyro_error_sum_rad = np.cumsum(gyro_error_rad, axis=0)
    window_steps = round(GYRO_BIAS_WINDOW_S / INTEGRATION_STEP_S)
    gyro_bias_rad_per_step = (
        np.median(gyro_error_sum_rad[window_steps:] - gyro_error_sum_rad[:-window_steps], axis=0)
        / window_steps
    )
    return cumulative_product(
        np.concatenate(
            [logged_attitude[:1], from_rotation_vector(rotation_rad - gyro_bias_rad_per_step)]
        )
    )


def _level_attitude(attitude: Array, specific_force_m_s2: Array) -> Array:
    """Correct the tilt of an attitude, so that the mean specific force is vertical."""
    # Over GRAVITY_AVERAGING_WINDOW_S, the mean acceleration of the vehicle is small, so the mean
    # specific force is the reaction to gravity (up). Two passes of the mean make a triangular
    # window, which smooths better than a rectangular one
    mean_specific_force_m_s2 = rotate(to_rotation_matrix(attitude[:-1]), specific_force_m_s2)
    for _ in range(2):
        mean_specific_force_m_s2 = running_mean(
            mean_specific_force_m_s2,
            np.ones(len(mean_specific_force_m_s2), dtype=bool),
            round(GRAVITY_AVERAGING_WINDOW_S / INTEGRATION_STEP_S),
        )
    # The lower limit (m/s²) prevents a division by zero
    vertical = mean_specific_force_m_s2 / np.maximum(
        np.linalg.norm(mean_specific_force_m_s2, axis=1, keepdims=True), 1.0
    )
    # For small tilt errors, the cross product is the rotation vector from the measured vertical to
    # true up (0, 0, -1)
    levelling_rotation = from_rotation_vector(np.cross(vertical, [0.0, 0.0, -1.0]))
    return multiply(np.concatenate([levelling_rotation, levelling_rotation[-1:]]), attitude)


def running_mean(values: Array, is_valid: BoolArray, width: int) -> Array:
    """Return the centred running mean over ``width`` rows, without invalid rows."""
    rows = np.arange(len(values))
    first_rows = np.clip(rows - width // 2, 0, None)
    end_rows = np.clip(rows + width // 2 + 1, None, len(rows))
    valid_values = np.where(is_valid[:, None], values.reshape(len(rows), -1), 0.0)
    sums = cumulative_sums(np.column_stack([valid_values, is_valid]))
    window_sums = sums[end_rows] - sums[first_rows]
    means: Array = window_sums[:, :-1] / np.maximum(window_sums[:, -1:], 1.0)
    return means.reshape(values.shape)


def high_pass(values: Array, is_valid: BoolArray) -> Array:
    high_pass_filtered_values = values - running_mean(
        values, is_valid, round(HIGH_PASS_WINDOW_S / GRID_INTERVAL_S)
    )
    high_pass_filtered_values[~is_valid] = 0.0
    return high_pass_filtered_values


def compute_second_differences(position: Array, window: int) -> Array:
    """Return p(t + T) - 2 p(t) + p(t - T), with T of ``window`` rows; 2 · window rows are lost."""
    return position[2 * window :] - 2.0 * position[window:-window] + position[: -2 * window]


def integrate_imu_motion(inertial_data: InertialData, attitude: Array) -> ImuSecondDifferences:
    """Compute second differences of the position (NED) from specific force and gravity.

    ``attitude``, shape (n + 1, 4), is a quaternion (w, x, y, z; FRD to NED).
    """
    quaternion_sums = attitude[1:] + attitude[:-1]
    body_to_ned = to_rotation_matrix(
        quaternion_sums / np.linalg.norm(quaternion_sums, axis=1, keepdims=True)
    )
    acceleration = body_to_ned @ inertial_data.specific_force_m_s2[..., None] + [
        [0.0],
        [0.0],
        [constants.g],
    ]
    # Four columns: acceleration, and its derivatives with respect to the accelerometer bias (FRD).
    # All four are integrated twice
    table = np.concatenate([acceleration, body_to_ned], axis=2)
    position_m = np.zeros((len(attitude), 3, 4))
    # The displacement in step k is (a_0 + … + a_k - a_k/2)·Δt² with the mean acceleration a_k of
    # each step, from rest. The arrays are changed in place to limit memory
    displacement_m = np.cumsum(table, axis=0)
    table /= 2.0
    displacement_m -= table
    displacement_m *= INTEGRATION_STEP_S**2
    np.cumsum(displacement_m, axis=0, out=position_m[1:])
    # Reduce the rate: keep one value per GRID_INTERVAL_S of the second differences
    window_steps = round(SECOND_DIFFERENCE_WINDOW_S / INTEGRATION_STEP_S)
    stride = round(GRID_INTERVAL_S / INTEGRATION_STEP_S)
    second_differences = compute_second_differences(position_m, window_steps)[::stride]
    time_s = inertial_data.time_s[window_steps:-window_steps][::stride]
    # A second difference needs valid data during SECOND_DIFFERENCE_WINDOW_S before and after its
    # time, without the end of a valid span or the start of the next one
    is_valid = is_inside_spans(time_s, inertial_data.valid_spans_s)
    for (_, end), (start, _) in pairwise(inertial_data.valid_spans_s):
        is_valid &= (time_s < end - SECOND_DIFFERENCE_WINDOW_S) | (
            time_s > start + SECOND_DIFFERENCE_WINDOW_S
        )
    return ImuSecondDifferences(time_s, is_valid, high_pass(second_differences, is_valid))


def filter_imu_motion(
    imu_motion: ImuSecondDifferences, time_constant_s: float
) -> ImuSecondDifferences:
    """Apply a first-order low-pass filter to the second differences from the IMU.

    The derivatives with respect to the accelerometer bias are filtered, too.
    """
    previous_output_weight = np.exp(-GRID_INTERVAL_S / time_constant_s)
    table = imu_motion.table.copy()
    for row in range(1, len(table)):
        table[row] += previous_output_weight * (table[row - 1] - table[row])
    return replace(imu_motion, table=table)


def replace_heading(attitude: Array, heading_rad: Array) -> Array:
    """Rotate an attitude about the vertical to another heading."""
    rotation_rad = np.outer(np.unwrap(heading_rad - heading(attitude)), [0.0, 0.0, 1.0])
    return multiply(from_rotation_vector(rotation_rad), attitude)
