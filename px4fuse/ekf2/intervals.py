"""Intervals between position samples: how state and variance go from one to the next, made once.

Attitude and biases of what-if replays hardly differ from those of the log, so that transition and
noise of an interval, taken about the nominal attitude, serve every setting. All intervals are made
together, step by step from their beginnings.

Error state: attitude error δθ (earth frame, estimate = exp(δθ) · nominal), velocity, position,
errors of gyro bias b_g and accelerometer bias b_a. Equations as in PX4-Autopilot
``EKF/python/ekf_derivation/derivation.py`` (predict_covariance), ``EKF/covariance.cpp`` and
``EKF/ekf.cpp`` (predictState); Δt the step, a = R f the specific force in NED:

    δθ ← δθ - R Δt δb_g            v ← v - [a]× Δt δθ - R Δt δb_a + (a + g) Δt
    p ← p + (v_before + v_after) Δt / 2
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.stretches import (
    BIASES,
    GRAVITY_M_S2,
    IMU_STATE_COUNT,
    POSITION,
    STATES,
    THETA,
    VELOCITY,
    Stretch,
)
from px4fuse.trajectory.rotation import skew

# A sample that is this much older than the horizon when it arrives is never fused
# (RingBuffer.h, pop_first_older_than)
MAX_LATE_S = 0.1
# From this on a sample is called late: 3 cm at 1 m/s
LATE_S = 0.03
# What a sample does when it is fused: nothing, correct the state, or start with a reset
IDLE, FUSE, START = 0, 1, 2
# Columns of what acts within an interval: attitude error, gyro bias and accelerometer bias at its
# beginning, the correction of the nominal attitude, and gravity with the specific force
EFFECT_COLUMNS = 11
TURN, INPUT = 9, 10

# What happens at the end of each interval, in order of time
Events = np.recarray[Any, Any]
EVENT = np.dtype(
    [
        ("end", np.intp),  # step after which it is
        ("sample", np.intp),  # its position sample, -1 where there is none
        ("action", np.intp),  # IDLE, FUSE or START
        ("usable", bool),  # has a sample that is on time, whatever EKF2 does with it
        ("startable", bool),  # fusion may start on it, had it stopped
        ("late", bool),  # arrived after the horizon had passed it, and is fused late
        ("lost", bool),  # and is never fused
        ("time_s", float),  # of measurement as EKF2 takes it: stamp - delay - half a step
    ]
)


@dataclass(frozen=True, eq=False)
class Intervals:
    """The intervals of one stretch, each ending in one of E events.

    Attributes
    ----------
    events : recarray, shape (E,)
        With the fields of :data:`EVENT`.
    transition : ndarray, shape (E, 15, 15)
    turn, drive : ndarray, shape (E, 15)
        What is added to the state.
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
    """What the events depend on: age of a position at its stamp, and horizon (s)."""

    delay_s: float
    horizon_s: float


def make_intervals(inputs: Inputs, stretch: Stretch, timing: Timing) -> Intervals:
    """Intervals of a stretch; those of two delays are the same in number and order."""
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
    # what arrives after the horizon has passed it is fused late, or not at all
    due_s = np.maximum(measured_s, received.arrival_s[first:last_row] - timing.horizon_s)
    end = np.searchsorted(time_s, due_s - 1e-9)
    is_inside = (end > 0) & (end <= last)
    end = np.maximum.accumulate(np.minimum(end, last))
    is_in_time = time_s[end] < measured_s + MAX_LATE_S
    usable = is_inside & is_in_time
    usable[:-1] &= end[1:] > end[:-1]  # of two samples in one step the newer one is fused
    action, startable = _actions(inputs, stretch, measured_s, end, usable)
    # further events where the source is silent, as many for every delay
    silence = np.diff(np.concatenate([time_s[:1], stamp, time_s[-1:]]))
    extra_events = np.maximum(np.ceil(silence / inputs.max_interval_s).astype(int) - 1, 0)
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
    """What each sample does, and whether fusion may start on it (ev_control.cpp)."""
    rules = inputs.rules
    action = np.full(len(taken_s), IDLE)
    startable = np.zeros(len(taken_s), dtype=bool)
    usable_rows = np.flatnonzero(usable)
    interval = np.diff(taken_s[usable_rows], prepend=-np.inf)
    startable[usable_rows] = interval < rules.start_interval_s
    # the last step before this sample was fused, and how old the sample before was then
    silence = stretch.time_s[end[usable_rows] - 1] - np.concatenate(
        [[np.inf], taken_s[usable_rows[:-1]]]
    )
    is_fusing = stretch.fusing
    for row, (interval_s, silence_s) in enumerate(
        zip(interval.tolist(), silence.tolist(), strict=True)
    ):
        is_fusing = is_fusing and not silence_s > rules.stop_s
        if is_fusing:
            action[usable_rows[row]] = FUSE
        elif interval_s < rules.start_interval_s:
            action[usable_rows[row]] = START
            is_fusing = True
    return action, startable


def _effects(stretch: Stretch, start: IntArray, end: IntArray) -> Array:
    """What the causes have done to attitude, velocity and position at the end of each interval.

    Of shape (E, 9, 11). One step of every interval at a time, from its first on.
    """
    length = end - start
    # the first steps of all intervals, then their second ones and so on, longer before shorter
    longest_first = np.argsort(-length, kind="stable")
    first = start[longest_first]
    attitude, velocity, position = effects = np.zeros((3, len(end), 3, EFFECT_COLUMNS))
    attitude[:, :, 0:3] = np.eye(3)
    force_m_s2 = np.einsum("nij,nj->ni", stretch.rotation[1:], stretch.force_m_s2)
    steps = np.arange(int(length.max(initial=0)))
    for at, count in zip(steps, np.searchsorted(-length[longest_first], -steps), strict=True):
        step, rows = first[:count] + at, slice(count)
        dt, force = stretch.step_s[step][:, None, None], force_m_s2[step]
        rotation_step = -stretch.rotation[1:][step] * dt  # ∂δθ/∂b_g and ∂v/∂b_a of a step
        position[rows] += 0.5 * dt * velocity[rows]
        velocity[rows] += (-skew(force) * dt) @ attitude[rows]  # by ∂v/∂δθ of the step
        velocity[rows, :, 6:9] += rotation_step
        velocity[rows, :, INPUT] += (force + GRAVITY_M_S2) * dt[:, :, 0]
        position[rows] += 0.5 * dt * velocity[rows]
        attitude[rows, :, 3:6] += rotation_step
        attitude[rows, :, TURN] -= stretch.correction_rad[step]
    effects[:, longest_first] = effects.copy()
    return np.concatenate(effects, axis=1)


def _noises(steps: Array, duration_s: Array, tilt: Array) -> tuple[Array, Array]:
    """Covariance at the end of each interval for unit noise of gyro and of accelerometer.

    In closed form, for n equal steps under the interval's mean specific force; unit noise adds dt²
    to the variance of attitude or velocity in each step. What gyro noise does to velocity and
    position within an interval is small, so that leading terms do.
    """
    n = np.maximum(steps, 1.0)[:, None, None]
    d = duration_s[:, None, None] / n
    m = tilt / n  # mean ∂v/∂δθ of a step
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
