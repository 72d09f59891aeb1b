"""Intervals between position samples: state transition and process noise, computed once.

The attitude and biases of a replay with changed parameters hardly differ from the logged ones. The
transition about the nominal attitude is therefore used for all settings. All intervals are
integrated together, one prediction step at a time.

Error state: attitude error δθ (earth frame, estimate = exp(δθ) · nominal), velocity, position,
errors of gyro bias b_g and accelerometer bias b_a. Equations as in PX4-Autopilot
``EKF/python/ekf_derivation/derivation.py`` (predict_covariance), ``EKF/covariance.cpp`` and
``EKF/ekf.cpp`` (predictState); Δt is the step, a = R f the specific force in NED:

    δθ ← δθ - R Δt δb_g            v ← v - [a]× Δt δθ - R Δt δb_a + (a + g) Δt
    p ← p + (v_before + v_after) Δt / 2
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.replay_segments import (
    BIASES,
    GRAVITY_M_S2,
    IMU_STATE_COUNT,
    POSITION,
    STATES,
    THETA,
    VELOCITY,
    Stretch,
)
from px4fuse.notebook_display import one_line_repr
from px4fuse.trajectory.rotation import skew

# s; EKF2 never fuses a sample that arrives this long behind the fusion horizon (RingBuffer.h,
# pop_first_older_than)
MAX_LATE_S = 0.1
# s; a sample this long behind the fusion horizon counts as late (3 cm at 1 m/s)
LATE_S = 0.03
# Action of a sample: none, update of the state, or start of fusion with a reset
IDLE, FUSE, START = 0, 1, 2
# Columns of the effects within an interval: initial attitude error, gyro bias, accelerometer bias,
# correction of the nominal attitude, and gravity plus specific force
EFFECT_COLUMNS = 11
TURN, INPUT = 9, 10

# Events at the ends of the intervals, in time order
Events = np.recarray[Any, Any]
EVENT = np.dtype(
    [
        ("end", np.intp),  # index of the prediction step after which the event occurs
        ("sample", np.intp),  # index of its position sample, -1 without a sample
        ("action", np.intp),
        ("usable", bool),  # sample received in time, fused or not
        ("startable", bool),  # fusion may start on it after a stop
        ("late", bool),  # arrived behind the fusion horizon, fused late
        ("lost", bool),  # too late, never fused
        ("time_s", float),  # s, measurement time in EKF2: timestamp - delay - half a step
    ]
)


@dataclass(frozen=True, eq=False)
class Intervals:
    """Intervals of one stretch, each ending in one of E events.

    Attributes
    ----------
    events : recarray, shape (E,)
        With the fields of :data:`EVENT`.
    transition : ndarray, shape (E, 15, 15)
    turn, drive : ndarray, shape (E, 15)
        Input to the state: by the correction of the nominal attitude, and by acceleration.
    gyro_noise, accelerometer_noise : ndarray, shape (E, 9, 9)
        Covariance of attitude, velocity and position added for unit noise.
    """

    events: Events
    transition: Array
    turn: Array
    drive: Array
    gyro_noise: Array
    accelerometer_noise: Array

    __repr__ = one_line_repr


@dataclass(frozen=True)
class Timing:
    """Age of a position at its timestamp, and fusion horizon (s)."""

    delay_s: float
    horizon_s: float


def make_intervals(inputs: Inputs, stretch: Stretch, timing: Timing) -> Intervals:
    """Compute the intervals of a stretch; number and order are equal for all delays."""
    events = _events(inputs, stretch, timing)
    start, end = np.concatenate([[0], events.end[:-1]]), events.end
    count, duration_s = len(end), stretch.time_s[end] - stretch.time_s[start]
    transition = np.tile(np.eye(STATES), (count, 1, 1))
    turn, drive = np.zeros((2, count, STATES))
    effects = _effects(stretch, start, end)
    transition[:, :IMU_STATE_COUNT, THETA], transition[:, :IMU_STATE_COUNT, BIASES] = (
        effects[..., :3],
        effects[..., 3:9],
    )
    turn[:, :IMU_STATE_COUNT], drive[:, :IMU_STATE_COUNT] = effects[..., TURN], effects[..., INPUT]
    transition[:, POSITION, VELOCITY] = duration_s[:, None, None] * np.eye(3)
    noises = _noises((end - start).astype(float), duration_s, transition[:, VELOCITY, THETA])
    return Intervals(events, transition, turn, drive, *noises)


def _events(inputs: Inputs, stretch: Stretch, timing: Timing) -> Events:
    received, time_s = inputs.received, stretch.time_s
    first, last_row = np.searchsorted(received.stamp_s, time_s[[0, -1]])
    stamp, last = received.stamp_s[first:last_row], len(time_s) - 1
    measured_s = stamp - timing.delay_s - 0.5 * inputs.step_s
    # samples that arrive behind the horizon are fused late, or never
    due_s = np.maximum(measured_s, received.arrival_s[first:last_row] - timing.horizon_s)
    end = np.searchsorted(time_s, due_s - 1e-9)
    is_inside = (end > 0) & (end <= last)
    end = np.maximum.accumulate(np.minimum(end, last))
    is_in_time = time_s[end] < measured_s + MAX_LATE_S
    usable = is_inside & is_in_time
    usable[:-1] &= end[1:] > end[:-1]  # EKF2 fuses the newer of two samples in one step
    action, startable = _actions(inputs, stretch, measured_s, end, usable)
    # additional events in gaps of the source, equally many for every delay
    gap_s = np.diff(np.concatenate([time_s[:1], stamp, time_s[-1:]]))
    extra_events = np.maximum(np.ceil(gap_s / inputs.max_interval_s).astype(int) - 1, 0)
    sample_places, total = (
        np.cumsum(extra_events[:-1] + 1) - 1,
        len(stamp) + int(extra_events.sum()),
    )
    known_places, ends = (
        np.concatenate([[-1], sample_places, [total]]),
        np.concatenate([[0], end, [last]]),
    )
    events = np.zeros(total, EVENT)
    events["end"] = np.rint(np.interp(np.arange(total), known_places, ends))
    events["sample"], events["time_s"] = -1, time_s[events["end"]]
    late, lost = is_inside & is_in_time & (due_s - measured_s > LATE_S), is_inside & ~is_in_time
    samples = np.arange(first, last_row)
    events[sample_places] = np.rec.fromarrays(
        [end, samples, action, usable, startable, late, lost, measured_s], dtype=EVENT
    )
    return events.view(np.recarray)


def _actions(
    inputs: Inputs, stretch: Stretch, taken_s: Array, end: IntArray, usable: BoolArray
) -> tuple[IntArray, BoolArray]:
    """Return the action of each sample, and True if fusion may start on it (ev_control.cpp)."""
    rules = inputs.rules
    action = np.full(len(taken_s), IDLE)
    startable = np.zeros(len(taken_s), dtype=bool)
    usable_rows = np.flatnonzero(usable)
    interval = np.diff(taken_s[usable_rows], prepend=-np.inf)
    startable[usable_rows] = interval < rules.start_interval_s
    # s, age of the previous sample in the last step before this fusion
    gaps_s = stretch.time_s[end[usable_rows] - 1] - np.concatenate(
        [[np.inf], taken_s[usable_rows[:-1]]]
    )
    is_fusing = stretch.fusing
    for row, (interval_s, gap_s) in enumerate(zip(interval.tolist(), gaps_s.tolist(), strict=True)):
        is_fusing = is_fusing and not gap_s > rules.stop_s
        if is_fusing:
            action[usable_rows[row]] = FUSE
        elif interval_s < rules.start_interval_s:
            action[usable_rows[row]] = START
            is_fusing = True
    return action, startable


def _effects(stretch: Stretch, start: IntArray, end: IntArray) -> Array:
    """Return the effects on attitude, velocity and position at the end of each interval.

    The shape is (E, 9, 11). All intervals advance together by one step.
    """
    length = end - start
    # process step 1 of all intervals, then step 2, ..., with longer intervals first
    longest_first = np.argsort(-length, kind="stable")
    first = start[longest_first]
    attitude, velocity, position = effects = np.zeros((3, len(end), 3, EFFECT_COLUMNS))
    attitude[:, :, 0:3] = np.eye(3)
    force_m_s2 = np.einsum("nij,nj->ni", stretch.rotation[1:], stretch.force_m_s2)
    steps = np.arange(int(length.max(initial=0)))
    for at, count in zip(steps, np.searchsorted(-length[longest_first], -steps), strict=True):
        step, rows = first[:count] + at, slice(count)
        dt, force = stretch.step_s[step][:, None, None], force_m_s2[step]
        rotation_step = -stretch.rotation[1:][step] * dt  # ∂δθ/∂b_g and ∂v/∂b_a of one step
        position[rows] += 0.5 * dt * velocity[rows]
        velocity[rows] += (-skew(force) * dt) @ attitude[rows]  # ∂v/∂δθ of one step
        velocity[rows, :, 6:9] += rotation_step
        velocity[rows, :, INPUT] += (force + GRAVITY_M_S2) * dt[:, :, 0]
        position[rows] += 0.5 * dt * velocity[rows]
        attitude[rows, :, 3:6] += rotation_step
        attitude[rows, :, TURN] -= stretch.correction_rad[step]
    effects[:, longest_first] = effects.copy()
    return np.concatenate(effects, axis=1)


def _noises(steps: Array, duration_s: Array, tilt: Array) -> tuple[Array, Array]:
    """Return covariances at the end of each interval for unit gyro and accelerometer noise.

    Closed form for n equal steps with the mean specific force of the interval. Unit noise adds dt²
    to the variance of attitude or velocity in each step. The effect of gyro noise on velocity and
    position is small, so only leading terms are used.
    """
    n = np.maximum(steps, 1.0)[:, None, None]
    d = duration_s[:, None, None] / n
    m = tilt / n  # mean ∂v/∂δθ of one step
    mm = m @ m.transpose(0, 2, 1)
    eye = np.eye(3)
    gyro, accelerometer = np.zeros((2, len(steps), IMU_STATE_COUNT, IMU_STATE_COUNT))
    for matrix, rows, columns, block in (
        (gyro, THETA, THETA, n * d**2 * eye),
        (gyro, VELOCITY, THETA, m * d**2 * n * (n - 1) / 2),
        (gyro, POSITION, THETA, m * d**3 * n * (n - 1) * (n - 2) / 6),
        (gyro, VELOCITY, VELOCITY, mm * d**2 * n * (n - 1) * (2 * n - 1) / 6),
        (gyro, POSITION, VELOCITY, mm * d**3 * n**4 / 8),
        (gyro, POSITION, POSITION, mm * d**4 * n**5 / 20),
        (accelerometer, VELOCITY, VELOCITY, n * d**2 * eye),
        (accelerometer, POSITION, VELOCITY, d**3 * n * (n - 1) / 2 * eye),
        (accelerometer, POSITION, POSITION, d**4 * n * (n - 1) * (2 * n - 1) / 6 * eye),
    ):
        matrix[:, rows, columns] = block
        if rows != columns:
            matrix[:, columns, rows] = block.transpose(0, 2, 1)
    return gyro, accelerometer
