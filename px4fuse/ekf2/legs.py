"""The legs between vision samples: how state and variance go from one to the next, made once.

Attitude and biases of what-if replays hardly differ from those of the log, so that transition and
noise of a leg, taken about the nominal attitude, serve every setting. All legs are made together,
step by step from their beginnings.

Error state: attitude error δθ (earth frame, estimate = exp(δθ) · nominal), velocity, position,
errors of gyro bias b_g and accelerometer bias b_a. Equations as in PX4-Autopilot
``EKF/python/ekf_derivation/derivation.py`` (predict_covariance), ``EKF/covariance.cpp`` and
``EKF/ekf.cpp`` (predictState); Δt the step, a = R f the specific force in NED:

    δθ ← δθ - R Δt δb_g            v ← v - [a]× Δt δθ - R Δt δb_a + (a + g) Δt
    p ← p + (v_before + v_after) Δt / 2
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from px4fuse.display import brief
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.stretches import Stretch
from px4fuse.trajectory.rotation import skew

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])  # CONSTANTS_ONE_G
STATES = 15
MOVED = 9  # of them, those that the IMU moves: all but the biases
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS = slice(9, 12), slice(12, 15)
# A sample that is this much older than the horizon when it arrives is never fused
# (RingBuffer.h, pop_first_older_than)
MAX_LATE_S = 0.1
# From this on a sample is called late: 3 cm at 1 m/s
LATE_S = 0.03
# What a sample does when it is fused: nothing, correct the state, or start with a reset
IDLE, FUSE, START = 0, 1, 2


# Columns of what acts within a leg: attitude error, gyro bias and accelerometer bias at its
# beginning, the correction of the nominal attitude, and gravity with the specific force
CAUSES = 11
TURN, INPUT = 9, 10


@dataclass(frozen=True)
class FusionEvents:
    """The events of one stretch, E of them.

    Attributes
    ----------
    end : ndarray of int, shape (E,)
        Step after which the event is.
    sample : ndarray of int, shape (E,)
        Vision sample of the event; -1 where there is none.
    action : ndarray of int, shape (E,)
        IDLE, FUSE or START.
    usable : ndarray of bool, shape (E,)
        Whether the event has a sample that is on time, whatever EKF2 does with it.
    startable : ndarray of bool, shape (E,)
        Whether fusion may start on it, had it stopped.
    late, lost : ndarray of bool, shape (E,)
        Whether the sample arrived after the horizon had passed it: fused late, or never.
    time_s : ndarray, shape (E,)
        Of measurement as EKF2 takes it: stamp - delay - half a step; else of the event.
    """

    end: Indices
    sample: Indices
    action: Indices
    usable: Flags
    startable: Flags
    late: Flags
    lost: Flags
    time_s: Array


@dataclass(frozen=True)
class Legs(FusionEvents):
    """Legs of one stretch, each ending in an event.

    Attributes
    ----------
    transition : ndarray, shape (E, 15, 15)
    turn, drive : ndarray, shape (E, 15)
        What is added to the state.
    gyro_noise, accelerometer_noise : ndarray, shape (E, 9, 9)
        Covariance of attitude, velocity and position added for unit noise.
    steps : ndarray, shape (E,)
    """

    transition: Array
    turn: Array
    drive: Array
    gyro_noise: Array
    accelerometer_noise: Array
    steps: Array

    __repr__ = brief

    @property
    def events(self) -> FusionEvents:
        """Without the legs, which are large."""
        return FusionEvents(*(getattr(self, each.name) for each in fields(FusionEvents)))


@dataclass(frozen=True)
class Timing:
    """What of the parameters decides the legs: age of vision at its stamp, and the horizon (s)."""

    delay_s: float
    horizon_s: float


def make_legs(inputs: Inputs, stretch: Stretch, timing: Timing) -> Legs:
    """Legs of a stretch.

    The events of two delays are the same in number and order.
    """
    events = _events(inputs, stretch, timing)
    end = events.end
    start = np.concatenate([[0], end[:-1]])
    count = len(end)
    transition = np.tile(np.eye(STATES), (count, 1, 1))
    turn, drive = np.zeros((count, STATES)), np.zeros((count, STATES))
    for rows, part in zip(
        (THETA, VELOCITY, POSITION), _transitions(stretch, start, end), strict=True
    ):
        transition[:, rows, THETA] = part[:, :, 0:3]
        transition[:, rows, GYRO_BIAS] = part[:, :, 3:6]
        transition[:, rows, ACCELEROMETER_BIAS] = part[:, :, 6:9]
        turn[:, rows] = part[:, :, TURN]
        drive[:, rows] = part[:, :, INPUT]
    elapsed = np.concatenate([[0.0], np.cumsum(stretch.step_s)])
    transition[:, POSITION, VELOCITY] = (elapsed[end] - elapsed[start])[:, None, None] * np.eye(3)
    gyro, accelerometer = _noises(
        (end - start).astype(np.float64),
        stretch.time_s[end] - stretch.time_s[start],
        transition[:, VELOCITY, THETA],
    )
    return Legs(
        **vars(events),
        transition=transition,
        turn=turn,
        drive=drive,
        gyro_noise=gyro,
        accelerometer_noise=accelerometer,
        steps=(end - start).astype(np.float64),
    )


def _events(inputs: Inputs, stretch: Stretch, timing: Timing) -> FusionEvents:
    vision = inputs.vision
    first = int(np.searchsorted(vision.stamp_s, stretch.time_s[0]))
    beyond = int(np.searchsorted(vision.stamp_s, stretch.time_s[-1]))
    chosen = np.arange(first, beyond)
    stamp = vision.stamp_s[chosen]
    taken = stamp - timing.delay_s - 0.5 * inputs.step_s
    # what arrives after the horizon has passed it is fused late, or not at all
    due = np.maximum(taken, vision.arrival_s[chosen] - timing.horizon_s)
    end = np.searchsorted(stretch.time_s, due - 1e-9)
    usable = (end > 0) & (end < len(stretch.time_s))
    end = np.minimum(end, len(stretch.time_s) - 1)
    end = np.maximum.accumulate(end)
    in_time = stretch.time_s[end] < taken + MAX_LATE_S
    late = usable & in_time & (due - taken > LATE_S)
    lost = usable & ~in_time
    usable &= in_time
    usable[:-1] &= end[1:] > end[:-1]  # of two samples in one step the newer one is fused
    action, startable = _actions(inputs, stretch, taken, end, usable)
    # further events where vision is silent, as many for every delay
    before = np.concatenate([[stretch.time_s[0]], stamp])
    after = np.concatenate([stamp, [stretch.time_s[-1]]])
    more = np.maximum(np.ceil((after - before) / inputs.max_leg_s).astype(int) - 1, 0)
    total = len(chosen) + int(more.sum())
    place = np.cumsum(more[:-1] + 1) - 1
    ends = np.full(total, -1, dtype=np.intp)
    ends[place] = end
    known = np.concatenate([[-1], place, [total]])
    value = np.concatenate([[0], end, [len(stretch.time_s) - 1]])
    ends = np.rint(np.interp(np.arange(total), known, value)).astype(np.intp)
    samples = np.full(total, -1, dtype=np.intp)
    samples[place] = chosen
    actions = np.full(total, IDLE, dtype=np.intp)
    actions[place] = action
    usables, startables, lates, losts = np.zeros((4, total), dtype=bool)
    for spread, part in (
        (usables, usable), (startables, startable), (lates, late), (losts, lost)
    ):  # fmt: skip
        spread[place] = part
    time = stretch.time_s[ends].copy()
    time[place] = taken
    return FusionEvents(ends, samples, actions, usables, startables, lates, losts, time)


def _actions(
    inputs: Inputs,
    stretch: Stretch,
    taken_s: Array,
    end: Indices,
    usable: Flags,
) -> tuple[Indices, Flags]:
    """What each sample does, and whether fusion may start on it (ev_control.cpp)."""
    rules = inputs.rules
    action = np.full(len(taken_s), IDLE, dtype=np.intp)
    startable = np.zeros(len(taken_s), dtype=bool)
    popped = np.flatnonzero(usable)
    if not len(popped):
        return action, startable
    interval = np.diff(taken_s[popped], prepend=-np.inf)
    startable[popped] = interval < rules.start_interval_s
    # the last step before this sample was fused, and how old the sample before was then
    silence = stretch.time_s[end[popped] - 1] - np.concatenate([[np.inf], taken_s[popped[:-1]]])
    running = stretch.fusing
    for at, (gap, silent) in enumerate(zip(interval.tolist(), silence.tolist(), strict=True)):
        running = running and not silent > rules.stop_s
        if running:
            action[popped[at]] = FUSE
        elif gap < rules.start_interval_s:
            action[popped[at]] = START
            running = True
    return action, startable


def _transitions(stretch: Stretch, start: Indices, end: Indices) -> tuple[Array, Array, Array]:
    """What the causes have done to attitude, velocity and position at the end of each leg.

    Each of shape (E, 3, 11). One step of every leg at a time, from its first on.
    """
    length = end - start
    # the first steps of all legs, then their second ones and so on, longer legs before shorter ones
    longest_first = np.argsort(-length, kind="stable")
    first = start[longest_first]
    attitude, velocity, position = made = np.zeros((3, len(end), 3, CAUSES))
    attitude[:, :, 0:3] = np.eye(3)
    force_m_s2 = np.einsum("nij,nj->ni", stretch.rotation[1:], stretch.force_m_s2)
    steps = np.arange(int(length.max(initial=0)))
    for at, count in zip(steps, np.searchsorted(-length[longest_first], -steps), strict=True):
        step, some = first[:count] + at, slice(count)
        dt, force = stretch.step_s[step][:, None, None], force_m_s2[step]
        turned = -stretch.rotation[1:][step] * dt  # ∂δθ/∂b_g and ∂v/∂b_a of a step
        position[some] += 0.5 * dt * velocity[some]
        velocity[some] += (-skew(force) * dt) @ attitude[some]  # by ∂v/∂δθ of the step
        velocity[some, :, 6:9] += turned
        velocity[some, :, INPUT] += (force + GRAVITY_M_S2) * dt[:, :, 0]
        position[some] += 0.5 * dt * velocity[some]
        attitude[some, :, 3:6] += turned
        attitude[some, :, TURN] -= stretch.correction_rad[step]
    made[:, longest_first] = made.copy()
    return attitude, velocity, position


def _noises(steps: Array, duration_s: Array, tilt: Array) -> tuple[Array, Array]:
    """Covariance at the end of each leg for unit noise of gyro and of accelerometer.

    In closed form, for n equal steps under the leg's mean specific force; unit noise adds dt² to
    the variance of attitude or velocity in each step. What gyro noise does to velocity and
    position within a leg is small, so that leading terms do.
    """
    n = np.maximum(steps, 1.0)[:, None, None]
    d = duration_s[:, None, None] / n
    m = tilt / n  # mean ∂v/∂δθ of a step
    mm = m @ m.transpose(0, 2, 1)
    eye = np.eye(3)
    gyro, accelerometer = np.zeros((2, len(steps), MOVED, MOVED))
    for matrix, rows, columns, part in (
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
        matrix[:, rows, columns] = part
        if rows != columns:
            matrix[:, columns, rows] = part.transpose(0, 2, 1)
    return gyro, accelerometer
