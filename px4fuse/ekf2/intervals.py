"""State transition and process noise between the fusions of the EKF2 replay.

The transition is linearised about EKF2's published (nominal) attitude.

The states are attitude error δθ (NED), velocity v, position p, gyro bias error δb_g and
accelerometer bias error δb_a. The estimated attitude is exp(δθ) · nominal attitude. R is the
rotation from body to NED, a the specific force (NED), g gravity. A prediction step of length Δt:

    δθ ← δθ - R Δt δb_g
    v ← v - [a]× Δt δθ - R Δt δb_a + (a + g) Δt
    p ← p + (v_before + v_after) Δt / 2

Sources: PX4-Autopilot ``EKF/python/ekf_derivation/derivation.py`` (predict_covariance),
``EKF/covariance.cpp`` and ``EKF/ekf.cpp`` (predictState).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.trajectory.rotation import rotate, skew

from .inputs import ReplayInputs
from .replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    MOTION_STATE_COUNT,
    POSITION,
    STATE_COUNT,
    THETA,
    VELOCITY,
    ReplaySegment,
)

# EKF2 discards a sample measured more than this time (s) before the fusion horizon
# (pop_first_older_than, RingBuffer.h)
MAX_DELAY_BEHIND_HORIZON_S = 0.1
# Minimum delay (s) of the fusion of a late sample: a position error of 3 cm at 1 m/s
MIN_DELAY_OF_LATE_SAMPLE_S = 0.03
# Actions of EKF2 on a position sample; START_FUSION resets the position to the sample
NO_ACTION, FUSE, START_FUSION = 0, 1, 2
# Columns of the derivatives of attitude, velocity and position at the end of an interval between
# two events. They are with respect to initial attitude error (0 to 2), gyro bias (3 to 5) and
# accelerometer bias (6 to 8). The last two columns are state changes by EKF2's attitude correction
# (9) and by the measured acceleration (10)
DERIVATIVE_COLUMN_COUNT = 11
BY_ATTITUDE, BY_GYRO_BIAS, BY_ACCELEROMETER_BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
BY_ATTITUDE_CORRECTION, BY_ACCELERATION = 9, 10

# One row per event: fusion of a position or, in a gap, of height and heading only
FusionEvents = np.recarray[Any, Any]
EVENT_DTYPE = np.dtype(
    [
        ("end_step", np.intp),  # number of prediction steps from the start to the event
        ("sample", np.intp),  # index of the position sample, -1 without a sample
        ("action", np.intp),
        ("usable", bool),  # True if the sample arrived in time
        ("can_start_fusion", bool),  # True if EKF2 may start fusion with this sample
        ("late", bool),  # True if the sample was fused late
        ("lost", bool),  # True if the sample arrived too late to be fused
        ("time_s", float),  # measurement time: timestamp - delay - half a prediction step
    ]
)


@dataclass(frozen=True, eq=False)
class EventIntervals:
    """Intervals between successive fusions in one part of a flight.

    Attributes
    ----------
    events : recarray, shape (E,)
        Fusion at the end of each interval, see :data:`EVENT_DTYPE`.
    prediction_step_counts, duration_s : ndarray, shape (E,)
        Number of prediction steps, and length of each interval.
    state_derivatives : ndarray, shape (E, 9, DERIVATIVE_COLUMN_COUNT)
        Derivatives of attitude error, velocity and position at the end of each interval, with
        respect to initial attitude error, gyro bias and accelerometer bias. The last two columns
        are the state changes by EKF2's attitude correction and by the measured acceleration.
    """

    events: FusionEvents
    prediction_step_counts: Array
    duration_s: Array
    state_derivatives: Array

    def compute_transitions(self, rows: slice) -> tuple[Array, ...]:
        """Return transition and process noise of the motion state in E intervals between fusions.

        The other states are constant. ``rows`` selects the intervals.

        Returns
        -------
        transition : ndarray, shape (E, 9, 15)
            Derivatives of the motion state with respect to all states except magnetic fields.
        state_change_by_attitude_correction, state_change_by_acceleration : ndarray, shape (E, 9)
            Change of the motion state in an interval by EKF2's attitude correction, and by
            acceleration.
        gyro_noise_covariance, accelerometer_noise_covariance : ndarray, shape (E, 9, 9)
            Process noise per prediction step, for 1 rad/s (gyroscope) or 1 m/s² (accelerometer).
        """
        state_derivatives, duration_s = self.state_derivatives[rows], self.duration_s[rows]
        transition = np.tile(np.eye(MOTION_STATE_COUNT, STATE_COUNT), (len(duration_s), 1, 1))
        transition[:, :, THETA] = state_derivatives[..., BY_ATTITUDE]
        transition[:, :, GYRO_BIAS] = state_derivatives[..., BY_GYRO_BIAS]
        transition[:, :, ACCELEROMETER_BIAS] = state_derivatives[..., BY_ACCELEROMETER_BIAS]
        # Position changes by velocity · duration
        transition[:, POSITION, VELOCITY] = duration_s[:, None, None] * np.eye(3)
        return (
            transition,
            state_derivatives[..., BY_ATTITUDE_CORRECTION],
            state_derivatives[..., BY_ACCELERATION],
            *_compute_imu_process_noise(
                self.prediction_step_counts[rows], duration_s, transition[:, VELOCITY, THETA]
            ),
        )


@dataclass(frozen=True)
class FusionDelays:
    """Delays (s) that determine when EKF2 fuses a position sample.

    Attributes
    ----------
    delay_s : float
        Timestamp of a position minus its time of measurement.
    horizon_s : float
        Delay of EKF2's fusion horizon.
    """

    delay_s: float
    horizon_s: float


def make_event_intervals(
    inputs: ReplayInputs, segment: ReplaySegment, delays: FusionDelays
) -> EventIntervals:
    """Compute state transition and process noise between successive fusions.

    The number of intervals does not depend on ``delays``.
    """
    events = _make_fusion_events(inputs, segment, delays)
    start_steps = np.append(0, events.end_step[:-1])
    step_counts = events.end_step - start_steps
    return EventIntervals(
        events,
        step_counts.astype(float),
        segment.time_s[events.end_step] - segment.time_s[start_steps],
        _integrate_state_jacobian(segment, start_steps, step_counts),
    )


def _make_fusion_events(
    inputs: ReplayInputs, segment: ReplaySegment, delays: FusionDelays
) -> FusionEvents:
    """Return the fusion events of a segment in time order, see EVENT_DTYPE."""
    received_positions = inputs.received_positions
    time_s = segment.time_s
    # Find the prediction step in which EKF2 fuses each sample
    first_row, end_row = np.searchsorted(received_positions.timestamp_s, time_s[[0, -1]])
    timestamp_s = received_positions.timestamp_s[first_row:end_row]
    last_step = len(time_s) - 1
    # EKF2 also subtracts half a prediction step (estimator_interface.cpp)
    measurement_times_s = timestamp_s - delays.delay_s - 0.5 * inputs.mean_step_s
    # EKF2 fuses a late sample when it arrives
    earliest_fusion_times_s = np.maximum(
        measurement_times_s, received_positions.arrival_s[first_row:end_row] - delays.horizon_s
    )
    # 1e-9 s: rounding errors
    fusion_step_by_sample = np.searchsorted(time_s, earliest_fusion_times_s - 1e-9)
    is_inside = (fusion_step_by_sample > 0) & (fusion_step_by_sample <= last_step)
    # A sample is not fused before the earlier samples
    fusion_step_by_sample = np.maximum.accumulate(np.minimum(fusion_step_by_sample, last_step))
    # EKF2 discards a sample that is too old when it is fused
    is_in_time = time_s[fusion_step_by_sample] < measurement_times_s + MAX_DELAY_BEHIND_HORIZON_S
    is_usable = is_inside & is_in_time
    # EKF2 fuses only the newer of two samples in one prediction step
    is_usable[:-1] &= fusion_step_by_sample[1:] > fusion_step_by_sample[:-1]
    action, can_start_fusion = _find_fusion_actions(
        inputs, segment, measurement_times_s, fusion_step_by_sample, is_usable
    )
    # The sender requested a reset
    action[np.isin(timestamp_s, received_positions.reset_times_s) & (action == FUSE)] = START_FUSION
    # Add events in long gaps between samples, before the first sample and after the last. There,
    # height and heading are fused at regular intervals
    gap_s = np.diff(np.r_[time_s[0], timestamp_s, time_s[-1]])
    event_counts_in_gaps = np.maximum(
        np.ceil(gap_s / inputs.max_height_fusion_interval_in_position_gap_s).astype(int) - 1, 0
    )
    # The events of a gap come before the event of the sample that ends the gap
    event_row_by_sample = np.cumsum(event_counts_in_gaps[:-1] + 1) - 1
    event_count = len(timestamp_s) + int(event_counts_in_gaps.sum())
    events = np.zeros(event_count, EVENT_DTYPE).view(np.recarray)
    # The events in a gap are evenly spaced: interpolate their prediction steps between those of the
    # samples before and after the gap. Row -1 is the start of the segment, row event_count is its
    # end
    events.end_step = np.rint(
        np.interp(
            np.arange(event_count),
            np.r_[-1, event_row_by_sample, event_count],
            np.r_[0, fusion_step_by_sample, last_step],
        )
    )
    # Set the fields of all events, then those of the events with a sample
    events.sample, events.time_s = -1, time_s[events.end_step]
    delay_of_fusion_s = earliest_fusion_times_s - measurement_times_s
    for name, values in (
        ("sample", np.arange(first_row, end_row)),
        ("action", action),
        ("usable", is_usable),
        ("can_start_fusion", can_start_fusion),
        ("late", is_inside & is_in_time & (delay_of_fusion_s > MIN_DELAY_OF_LATE_SAMPLE_S)),
        ("lost", is_inside & ~is_in_time),
        ("time_s", measurement_times_s),
    ):
        events[name][event_row_by_sample] = values
    return events


def _find_fusion_actions(
    inputs: ReplayInputs,
    segment: ReplaySegment,
    measurement_times_s: Array,
    end_steps: IntArray,
    is_usable: BoolArray,
) -> tuple[IntArray, BoolArray]:
    """Return EKF2's action on each position sample, and True for samples that may start fusion.

    The actions are FUSE, START_FUSION (reset the position to the sample) and NO_ACTION.
    Source: PX4-Autopilot ``ev_control.cpp``.
    """
    fusion_rules = inputs.rules
    action = np.full(len(measurement_times_s), NO_ACTION)
    can_start_fusion = np.zeros(len(measurement_times_s), dtype=bool)
    usable_rows = np.flatnonzero(is_usable)
    usable_times_s = measurement_times_s[usable_rows]
    can_start_fusion[usable_rows] = (
        np.diff(usable_times_s, prepend=-np.inf) < fusion_rules.max_sample_interval_to_start_s
    )
    # In each prediction step, EKF2 stops fusion if the time since the latest sample exceeds a
    # timeout. A gap is longest in the step before the fusion of the next sample. There is no gap
    # before the first sample
    sample_gaps_s = segment.time_s[end_steps[usable_rows[1:]] - 1] - usable_times_s[:-1]
    is_fusing = segment.starts_while_fusing
    for row, gap_s in zip(usable_rows.tolist(), [0.0, *sample_gaps_s.tolist()], strict=False):
        is_fusing = is_fusing and gap_s <= fusion_rules.stop_timeout_s
        if is_fusing:
            action[row] = FUSE
        elif can_start_fusion[row]:
            action[row] = START_FUSION
            is_fusing = True
    return action, can_start_fusion


def _integrate_state_jacobian(
    segment: ReplaySegment, start_steps: IntArray, prediction_step_counts: IntArray
) -> Array:
    """Return the derivatives of the motion state at the end of each interval.

    The shape is (intervals, 9, DERIVATIVE_COLUMN_COUNT). Rows: attitude error, velocity and
    position. Columns: attitude error, gyro bias and accelerometer bias at the start of the
    interval; change of the state by EKF2's attitude correction; change by the measured
    acceleration.

    Intervals are given by their first prediction step and their number of steps. The derivatives
    follow the prediction step at the top of this module.
    """
    # All intervals are integrated together, step by step. Sorted by length, longest first, the
    # intervals that have not ended are always the first rows
    longest_first_indices = np.argsort(-prediction_step_counts, kind="stable")
    start_steps_longest_first = start_steps[longest_first_indices]
    attitude_derivatives, velocity_derivatives, position_derivatives = state_derivatives = np.zeros(
        (3, len(start_steps), 3, DERIVATIVE_COLUMN_COUNT)
    )
    attitude_derivatives[:, :, BY_ATTITUDE] = np.eye(3)
    specific_force_ned_m_s2 = rotate(segment.body_to_ned[1:], segment.specific_force_m_s2)
    step_numbers = np.arange(int(prediction_step_counts.max(initial=0)))
    # Number of intervals with more than 0, 1, 2, ... steps
    active_counts = np.searchsorted(-prediction_step_counts[longest_first_indices], -step_numbers)
    for step_number, active_count in zip(step_numbers, active_counts, strict=True):
        rows = slice(active_count)
        step = start_steps_longest_first[rows] + step_number
        dt = segment.step_s[step][:, None, None]
        force_m_s2 = specific_force_ned_m_s2[step]
        # -R Δt: change of attitude per gyro bias, and of velocity per accelerometer bias
        change_by_bias = -segment.body_to_ned[1:][step] * dt
        # Half of the position change depends on the velocity before the step
        position_derivatives[rows] += 0.5 * dt * velocity_derivatives[rows]
        # The velocity changes by -[a]× Δt δθ, so the derivatives of δθ add to those of the
        # velocity. The accelerometer bias and the acceleration of this step also change the
        # velocity
        velocity_derivatives[rows] += (-skew(force_m_s2) * dt) @ attitude_derivatives[rows]
        velocity_derivatives[rows, :, BY_ACCELEROMETER_BIAS] += change_by_bias
        velocity_derivatives[rows, :, BY_ACCELERATION] += (force_m_s2 + GRAVITY_M_S2) * dt[:, :, 0]
        # The other half of the position change depends on the velocity after the step
        position_derivatives[rows] += 0.5 * dt * velocity_derivatives[rows]
        # The attitude is updated after the velocity, because the velocity change depends on the
        # attitude before the step
        attitude_derivatives[rows, :, BY_GYRO_BIAS] += change_by_bias
        attitude_derivatives[rows, :, BY_ATTITUDE_CORRECTION] -= segment.attitude_correction_rad[
            step
        ]
    # Restore the order of the intervals
    state_derivatives[:, longest_first_indices] = state_derivatives.copy()
    return np.concatenate(state_derivatives, axis=1)


def _compute_imu_process_noise(
    prediction_step_counts: Array, duration_s: Array, velocity_derivative_by_attitude: Array
) -> ArrayPair:
    """Return the process noise for unit gyro noise, and for unit accelerometer noise.

    An interval between two fusions has n prediction steps of length d. The specific force is
    assumed to be constant, so an attitude error of 1 rad changes the velocity by m in each step. A
    noise value of 1 in a step that is followed by k steps changes the state at the end of the
    interval:

    - gyro: attitude by d, velocity by k m d, position by k (k - 1) m d² / 2
    - accelerometer: velocity by d, position by k d²

    The process noise is the sum of the products of these changes over k = 0 to n - 1. Two
    sums of gyro noise are replaced by their leading terms, which dominate for large n:
    Σ k² (k - 1) / 2 by n⁴ / 8, and Σ k² (k - 1)² / 4 by n⁵ / 20.
    """
    n = np.maximum(prediction_step_counts, 1.0)[:, None, None]
    d = duration_s[:, None, None] / n
    # Velocity change per attitude error in one prediction step (m/s per rad)
    m = velocity_derivative_by_attitude / n
    mm = m @ m.transpose(0, 2, 1)
    eye = np.eye(3)
    # Sums of k and of k² for k = 0 to n - 1
    sum_k, sum_k_squared = n * (n - 1) / 2, n * (n - 1) * (2 * n - 1) / 6
    gyro_noise_covariance, accelerometer_noise_covariance = np.zeros(
        (2, len(prediction_step_counts), MOTION_STATE_COUNT, MOTION_STATE_COUNT)
    )
    for matrix, rows, columns, block in (
        (gyro_noise_covariance, THETA, THETA, n * d**2 * eye),
        (gyro_noise_covariance, VELOCITY, THETA, m * d**2 * sum_k),
        # Σ k (k - 1) / 2 = n (n - 1) (n - 2) / 6
        (gyro_noise_covariance, POSITION, THETA, m * d**3 * n * (n - 1) * (n - 2) / 6),
        (gyro_noise_covariance, VELOCITY, VELOCITY, mm * d**2 * sum_k_squared),
        (gyro_noise_covariance, POSITION, VELOCITY, mm * d**3 * n**4 / 8),
        (gyro_noise_covariance, POSITION, POSITION, mm * d**4 * n**5 / 20),
        (accelerometer_noise_covariance, VELOCITY, VELOCITY, n * d**2 * eye),
        (accelerometer_noise_covariance, POSITION, VELOCITY, d**3 * sum_k * eye),
        (accelerometer_noise_covariance, POSITION, POSITION, d**4 * sum_k_squared * eye),
    ):
        matrix[:, rows, columns] = block
        if rows != columns:
            matrix[:, columns, rows] = block.transpose(0, 2, 1)
    return gyro_noise_covariance, accelerometer_noise_covariance
