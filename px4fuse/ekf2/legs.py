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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from px4fuse.ekf2.inputs import Inputs, Stretch
from px4fuse.ekf2.rotation import skew

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])  # CONSTANTS_ONE_G
STATES = 15
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS = slice(9, 12), slice(12, 15)
# Height and heading are measured at least this often where vision is silent
MAX_LEG_S = 0.25
# A sample that is this much older than the horizon when it arrives is never fused
# (RingBuffer.h, pop_first_older_than)
MAX_LATE_S = 0.1
# What a sample does when it is fused: nothing, correct the state, or start with a reset
IDLE, FUSE, START = 0, 1, 2


@dataclass(frozen=True)
class Transitions:
    """From the beginning of its leg to each step's end; all of shape (n, 3, 3) or (n, 3).

    ``v_theta`` is ∂v/∂δθ and so on; ``*_turn`` is what the correction of the nominal attitude
    does, ``*_input`` what gravity and specific force do.
    """

    elapsed_s: Array
    theta_gyro: Array
    v_theta: Array
    v_gyro: Array
    p_theta: Array
    p_gyro: Array
    p_accelerometer: Array
    theta_turn: Array
    v_turn: Array
    p_turn: Array
    v_input: Array
    p_input: Array


@dataclass(frozen=True)
class _Events:
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
class Legs(_Events):
    """Legs of one stretch, each ending in an event.

    Attributes
    ----------
    transition : ndarray, shape (E, 15, 15)
    turn, drive : ndarray, shape (E, 15)
        What is added to the state.
    gyro_noise, accelerometer_noise : ndarray, shape (E, 15, 15)
        Covariance added for unit noise.
    steps : ndarray, shape (E,)
    within : Transitions
    """

    transition: Array
    turn: Array
    drive: Array
    gyro_noise: Array
    accelerometer_noise: Array
    steps: Array
    within: Transitions


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
    within = _transitions(stretch, start, end)
    gyro, accelerometer = _noises(stretch, start, end)
    last = np.maximum(end - 1, 0)
    count = len(end)
    transition = np.tile(np.eye(STATES), (count, 1, 1))
    turn, drive = np.zeros((count, STATES)), np.zeros((count, STATES))
    moved = end > start
    at = last[moved]
    for rows, columns, part in (
        (THETA, GYRO_BIAS, within.theta_gyro),
        (VELOCITY, THETA, within.v_theta),
        (VELOCITY, GYRO_BIAS, within.v_gyro),
        (VELOCITY, ACCELEROMETER_BIAS, within.theta_gyro),
        (POSITION, THETA, within.p_theta),
        (POSITION, GYRO_BIAS, within.p_gyro),
        (POSITION, ACCELEROMETER_BIAS, within.p_accelerometer),
    ):
        transition[moved, rows, columns] = part[at]
    transition[moved, POSITION, VELOCITY] = within.elapsed_s[at, None, None] * np.eye(3)
    turn[moved, THETA] = within.theta_turn[at]
    turn[moved, VELOCITY] = within.v_turn[at]
    turn[moved, POSITION] = within.p_turn[at]
    drive[moved, VELOCITY] = within.v_input[at]
    drive[moved, POSITION] = within.p_input[at]
    return Legs(
        **vars(events),
        transition=transition,
        turn=turn,
        drive=drive,
        gyro_noise=gyro,
        accelerometer_noise=accelerometer,
        steps=(end - start).astype(np.float64),
        within=within,
    )


def _events(
    inputs: Inputs, stretch: Stretch, timing: Timing
) -> _Events:
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
    late = usable & in_time & (due - taken > inputs.step_s)
    lost = usable & ~in_time
    usable &= in_time
    usable[:-1] &= end[1:] > end[:-1]  # of two samples in one step the newer one is fused
    action, startable = _actions(inputs, stretch, taken, end, usable)
    # further events where vision is silent, as many for every delay
    before = np.concatenate([[stretch.time_s[0]], stamp])
    after = np.concatenate([stamp, [stretch.time_s[-1]]])
    more = np.maximum(np.ceil((after - before) / MAX_LEG_S).astype(int) - 1, 0)
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
    return _Events(ends, samples, actions, usables, startables, lates, losts, time)


def _actions(
    inputs: Inputs,
    stretch: Stretch,
    taken_s: Array,
    end: Indices,
    usable: Flags,
) -> tuple[Indices, Flags]:
    """What each sample does, and whether fusion may start on it, by the rules that start and stop fusion (ev_control.cpp)."""
    rules = inputs.rules
    action = np.full(len(taken_s), IDLE, dtype=np.intp)
    startable = np.zeros(len(taken_s), dtype=bool)
    popped = np.flatnonzero(usable)
    if not len(popped):
        return action, startable
    interval = np.diff(taken_s[popped], prepend=taken_s[popped[0]])
    startable[popped] = interval < rules.start_interval_s
    # the last step before this sample was fused, and how old the sample before was then
    silence = stretch.time_s[end[popped] - 1] - np.concatenate(
        [[np.inf], taken_s[popped[:-1]]]
    )
    running = True  # a stretch begins while EKF2 fuses
    for at, (gap, silent) in enumerate(zip(interval.tolist(), silence.tolist(), strict=True)):
        running = running and not silent > rules.stop_s
        if running:
            action[popped[at]] = FUSE
        elif gap < rules.start_interval_s:
            action[popped[at]] = START
            running = True
    return action, startable


def _transitions(stretch: Stretch, start: Indices, end: Indices) -> Transitions:
    """One step of every leg at a time, from its first on."""
    n = len(stretch.step_s)
    dt = stretch.step_s
    force = np.einsum("nij,nj->ni", stretch.rotation[1:], stretch.force_m_s2)
    tilt = -skew(force) * dt[:, None, None]  # ∂v/∂δθ of a step
    turned = -stretch.rotation[1:] * dt[:, None, None]  # ∂δθ/∂b_g and ∂v/∂b_a of a step
    gain = (force + GRAVITY_M_S2) * dt[:, None]
    leg = np.full(n, -1, dtype=np.intp)
    length = end - start
    covered = int(end[-1]) if len(end) else 0
    leg[:covered] = np.repeat(np.arange(len(end)), length)
    # steps after the last event are a leg of their own
    first = np.append(start, covered)
    leg[covered:] = len(end)
    place = np.arange(n) - first[leg]
    order = np.argsort(place, kind="stable")
    rank_ends = np.cumsum(np.bincount(place, minlength=1))
    made = {
        name: np.zeros((n, 3, 3))
        for name in ("theta_gyro", "v_theta", "v_gyro", "p_theta", "p_gyro", "p_accelerometer")
    } | {name: np.zeros((n, 3)) for name in ("theta_turn", "v_turn", "p_turn", "v_input", "p_input")}
    elapsed = np.zeros(n)
    low = 0
    for rank, high in enumerate(rank_ends.tolist()):
        k = order[low:high]
        low = high
        m, t = tilt[k], dt[k, None]
        h = 0.5 * dt[k, None, None]
        if rank == 0:
            elapsed[k] = dt[k]
            made["theta_gyro"][k] = turned[k]
            made["v_theta"][k] = m
            made["p_theta"][k] = h * m
            made["p_accelerometer"][k] = h * turned[k]
            made["theta_turn"][k] = -stretch.correction_rad[k]
            made["v_input"][k] = gain[k]
            made["p_input"][k] = 0.5 * t * gain[k]
            continue
        was = {name: values[k - 1] for name, values in made.items()}
        elapsed[k] = elapsed[k - 1] + dt[k]
        now = {
            "theta_gyro": was["theta_gyro"] + turned[k],
            "v_theta": was["v_theta"] + m,
            "v_gyro": was["v_gyro"] + m @ was["theta_gyro"],
            "theta_turn": was["theta_turn"] - stretch.correction_rad[k],
            "v_turn": was["v_turn"] + np.einsum("nij,nj->ni", m, was["theta_turn"]),
            "v_input": was["v_input"] + gain[k],
        }
        now["p_theta"] = was["p_theta"] + h * (was["v_theta"] + now["v_theta"])
        now["p_gyro"] = was["p_gyro"] + h * (was["v_gyro"] + now["v_gyro"])
        # ∂v/∂b_a is the same as ∂δθ/∂b_g
        now["p_accelerometer"] = was["p_accelerometer"] + h * (
            was["theta_gyro"] + now["theta_gyro"]
        )
        now["p_turn"] = was["p_turn"] + 0.5 * t * (was["v_turn"] + now["v_turn"])
        now["p_input"] = was["p_input"] + 0.5 * t * (was["v_input"] + now["v_input"])
        for name, values in now.items():
            made[name][k] = values
    return Transitions(elapsed_s=elapsed, **made)


def _noises(stretch: Stretch, start: Indices, end: Indices) -> tuple[Array, Array]:
    """Covariance at the end of each leg for unit noise of gyro and of accelerometer."""
    dt = stretch.step_s
    force = np.einsum("nij,nj->ni", stretch.rotation[:-1], stretch.force_m_s2)
    tilt = -skew(force) * dt[:, None, None]
    count = len(end)
    length = end - start
    theta = np.zeros((count, 1, 1))
    vt, vv, pt, pv, pp = (np.zeros((count, 3, 3)) for _ in range(5))
    a_vv, a_pv, a_pp = (np.zeros(count) for _ in range(3))
    for rank in range(int(length.max(initial=0))):
        active = np.flatnonzero(length > rank)
        k = start[active] + rank
        d, m = dt[k, None, None], tilt[k]
        m_t = m.transpose(0, 2, 1)
        s, v_t, v_v, p_t, p_v = theta[active], vt[active], vv[active], pt[active], pv[active]
        moved_v_t = v_t + s * m
        moved_p_t = p_t + d * v_t
        pp[active] += d * (p_v + p_v.transpose(0, 2, 1)) + d**2 * v_v
        pv[active] = p_v + d * v_v + moved_p_t @ m_t
        cross = m @ v_t.transpose(0, 2, 1)
        vv[active] = v_v + cross + cross.transpose(0, 2, 1) + s * (m @ m_t)
        vt[active], pt[active], theta[active] = moved_v_t, moved_p_t, s + d**2
        step = dt[k]
        a_pp[active] += 2.0 * step * a_pv[active] + step**2 * a_vv[active]
        a_pv[active] += step * a_vv[active]
        a_vv[active] += step**2
    gyro, accelerometer = np.zeros((2, count, STATES, STATES))
    eye = np.eye(3)
    gyro[:, THETA, THETA] = theta * eye
    for rows, columns, part in (
        (VELOCITY, THETA, vt),
        (POSITION, THETA, pt),
        (POSITION, VELOCITY, pv),
    ):
        gyro[:, rows, columns] = part
        gyro[:, columns, rows] = part.transpose(0, 2, 1)
    gyro[:, VELOCITY, VELOCITY], gyro[:, POSITION, POSITION] = vv, pp
    accelerometer[:, VELOCITY, VELOCITY] = a_vv[:, None, None] * eye
    accelerometer[:, POSITION, VELOCITY] = a_pv[:, None, None] * eye
    accelerometer[:, VELOCITY, POSITION] = a_pv[:, None, None] * eye
    accelerometer[:, POSITION, POSITION] = a_pp[:, None, None] * eye
    return gyro, accelerometer
