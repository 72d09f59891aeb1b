"""The recursion of the model: several settings of EKF2 through one stretch at once.

Sources: PX4-Autopilot ``EKF/covariance.cpp`` (limits of the biases), ``EKF/position_fusion.cpp``
and ``EKF/vel_pos_fusion.cpp`` (gate, fusion), ``ev_pos_control.cpp`` (noise, resets).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from px4fuse.ekf2.inputs import Inputs, Rules
from px4fuse.ekf2.legs import (
    ACCELEROMETER_BIAS,
    FUSE,
    GYRO_BIAS,
    IDLE,
    MOVED,
    START,
    STATES,
    THETA,
    Legs,
    Timing,
)
from px4fuse.ekf2.stretches import Stretch

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# How long the first pass runs that gives the correlations at the start
CORRELATING_S = 8.0
LEAST_VARIANCE = 1e-30
# Events whose legs are stacked at once
TOGETHER = 64
# Variance by which a sample is not taken at all
NOT_TAKEN = 1e9
MIN_POSITION_SD_M = 0.01  # ev_pos_control.cpp
MIN_GATE = 1.0
# covariance.cpp: at most 0.1 g of bias, at most a ratio of 100 between the axes
MAX_BIAS_SD = 0.1 * 9.80665
BIAS_RATIO = 0.01
HEADING, NORTH, EAST, DOWN = 2, 6, 7, 8
MEASURED = np.array([HEADING, DOWN, NORTH, EAST])
# Slices are views, where indices would be copies
OWN = slice(HEADING, DOWN + 1, DOWN - HEADING)
HORIZONTAL = slice(NORTH, EAST + 1)
BIASES = slice(9, 15)
FORCE_BIAS = np.arange(12, 15)


@dataclass(frozen=True)
class Variant:
    """One filter to run.

    Attributes
    ----------
    settings : dict
        All of the model's parameters, by PX4 name.
    biases : bool
        Whether the accelerometer's bias is a state; else there is none.
    attitude : bool
        Whether attitude and gyro bias are states; else the published attitude holds.
    gated : bool
        Whether samples are rejected and positions reset.
    as_logged : bool
        Whether samples are rejected and the position is reset where EKF2 itself did, as far as the
        log tells.
    stamp_offset_s : float or None
        What is added to the stamps; None: samples count when EKF2 takes them to have been measured.
    """

    settings: dict[str, float]
    biases: bool = True
    attitude: bool = True
    gated: bool = True
    as_logged: bool = False
    stamp_offset_s: float | None = None

    def timing(self, inputs: Inputs) -> Timing:
        """What is taken off the stamps, half a step besides, and how far fusion runs behind."""
        if self.stamp_offset_s is not None:
            return Timing(-self.stamp_offset_s - 0.5 * inputs.step_s, np.inf)
        delay_s = self.settings["EKF2_EV_DELAY"] * 1e-3
        if inputs.rules.horizon_by_delay:  # the longest of the delays makes the buffer
            length = math.ceil(delay_s / inputs.predict_s)
            return Timing(delay_s, max(inputs.horizon_s, (length - 1) * inputs.step_s))
        longest_ms = self.settings["EKF2_DELAY_MAX"]
        if longest_ms == inputs.settings["EKF2_DELAY_MAX"]:
            return Timing(delay_s, inputs.horizon_s)
        # initialise_interface, estimator_interface.cpp: the length of the IMU buffer
        length = max(math.ceil(longest_ms * 1e-3 / inputs.predict_s), 2)
        return Timing(delay_s, (length - 1) * inputs.step_s)


@dataclass(frozen=True)
class Run:
    """What S variants did in one stretch of E events.

    Attributes
    ----------
    innovation_m : ndarray, shape (E, S, 2)
        Measurement minus state, north and east; NaN where the event has no sample.
    variance_m2 : ndarray, shape (E, S, 2)
        S = P + R.
    noise_m2 : ndarray, shape (E, S, 2)
        R.
    rejected, fused, reset : ndarray of bool, shape (E, S)
    state : ndarray, shape (E + 1, S, 15)
        At the start and after each event.
    variance : ndarray, shape (E + 1, S, 15)
        Likewise.
    covariance : ndarray, shape (S, 15, 15)
        At the end.
    """

    innovation_m: Array
    variance_m2: Array
    noise_m2: Array
    rejected: Flags
    fused: Flags
    reset: Flags
    state: Array
    variance: Array
    covariance: Array


def run(  # noqa: PLR0915 (one recursion, read from top to bottom)
    inputs: Inputs,
    stretch: Stretch,
    legs: Sequence[Legs],
    which: NDArray[np.intp],
    variants: Sequence[Variant],
) -> Run:
    """Run the variants through one stretch.

    Parameters
    ----------
    inputs : Inputs
    stretch : Stretch
    legs : sequence of Legs
        One for each delay.
    which : ndarray of int, shape (S,)
        The legs of each variant.
    variants : sequence of Variant, S of them
    """
    size, events = len(variants), len(legs[0].end)
    knob = {name: np.array([v.settings[name] for v in variants]) for name in variants[0].settings}
    biases = np.array([v.biases for v in variants])
    attitude = np.array([v.attitude for v in variants])
    pick = which if len(legs) > 1 else slice(None)
    steps = np.stack([leg.steps for leg in legs], axis=1)[:, :, None]
    own, own_variance = (
        np.stack([part[leg.end] for leg in legs], axis=1)
        for part in (
            np.column_stack([stretch.attitude_error_rad[:, HEADING], stretch.down_m]),
            np.column_stack([stretch.heading_variance_rad2, stretch.down_variance_m2]),
        )
    )
    measured, noise = _measurements(inputs, stretch, legs, which, knob)
    schedule = _schedule(inputs, stretch, legs, which, variants)
    sampled: Flags = np.any(schedule.action > IDLE, axis=1)
    quiet = schedule.quiet()
    gate2 = (np.maximum(knob["EKF2_EVP_GATE"], MIN_GATE) ** 2)[:, None]
    gyro2 = np.where(attitude, knob["EKF2_GYR_NOISE"] ** 2, 0.0)[:, None, None]
    force2 = (knob["EKF2_ACC_NOISE"] ** 2)[:, None, None]
    drift, drift_limit = _drift(inputs, knob, biases, attitude)
    floor = inputs.rules.bias_floor
    x, P = _start(stretch, biases, attitude)
    turns = attitude[:, None].astype(np.float64)
    fusion = _Fusion(
        np.full(size, stretch.time_s[0]), np.zeros(size, bool), np.full(size, inputs.rules.resets)
    )
    last_s = fusion.last_s
    out = Run(
        np.full((events, size, 2), np.nan),
        np.full((events, size, 2), np.nan),
        np.broadcast_to(noise[:, :, :2], (events, size, 2)),
        np.zeros((events, size), bool),
        np.zeros((events, size), bool),
        np.zeros((events, size), bool),
        np.empty((events + 1, size, STATES)),
        np.empty((events + 1, size, STATES)),
        np.empty((size, STATES, STATES)),
    )
    innovation, R = np.empty((size, 4)), np.empty((size, 4))
    stopped = False  # the fusion of any
    _keep(out, 0, x, P)
    for e in range(events):
        within = e % TOGETHER
        if not within:  # legs are long: a few at a time
            some = slice(e, e + TOGETHER)
            transition, turn, drive, gyro_noise, force_noise = _stacked(legs, e, pick)
            pushed = drive + turns * turn
            added = gyro2 * gyro_noise + force2 * force_noise
            drifted = drift * steps[some][:, pick]
            own_now, own_spread = own[some][:, pick], own_variance[some][:, pick]
            heading = np.where(attitude, own_now[:, :, 0], 0.0)
        phi = transition[within]
        # x = Φx + u, P = ΦPΦ' + Q
        x = (phi @ x[:, :, None])[:, :, 0] + pushed[within]
        P = phi @ P @ np.swapaxes(phi, 1, 2)
        P[:, :MOVED, :MOVED] += added[within]
        spread = P.reshape(size, -1)[:, :: STATES + 1]  # its diagonal, not a copy
        biased = spread[:, BIASES]
        biased += (biased < drift_limit) * drifted[within]
        if floor is not None:
            _limit_bias(P, floor, biases)
        np.subtract(own_now[within], x[:, OWN], out=innovation[:, :2])
        R[:, :2] = _down_to(spread[:, OWN], own_spread[within])
        innovation[:, 2:] = 0.0
        R[:, 2:] = NOT_TAKEN
        restart = None
        if inputs.vision_height:
            R[:, 1] = NOT_TAKEN
        if sampled[e]:
            active = schedule.action[e] > IDLE
            nu = measured[e, :, :2] - x[:, HORIZONTAL]
            S = spread[:, HORIZONTAL] + noise[e, :, :2]
            outside = (nu * nu > gate2 * S).any(axis=1)
            out.innovation_m[e] = np.where(active[:, None], nu, np.nan)
            out.variance_m2[e] = np.where(active[:, None], S, np.nan)
            innovation[:, 2:] = nu
            if quiet[e] and not (stopped or outside.any()):
                last_s, out.fused[e], R[:, 2:] = schedule.time_s[e], True, noise[e, :, :2]
            else:
                fusion = replace(fusion, last_s=last_s)
                beyond, taken, restart, fusion = _decide(inputs.rules, schedule, e, outside, fusion)
                last_s = fusion.last_s
                out.rejected[e], out.fused[e], out.reset[e] = beyond, taken, restart
                R[taken, 2:] = noise[e, taken, :2]
                stopped = bool(fusion.stopped.any())
            if inputs.vision_height:
                innovation[:, 1] = measured[e, :, 2] - x[:, DOWN]
                R[:, 1] = np.where(active, noise[e, :, 2], NOT_TAKEN)
        # K = PH'(HPH' + R)⁻¹, x = x + Kν, P = P - KHP
        HP = np.take(P, MEASURED, axis=1)
        HPH = np.take(HP, MEASURED, axis=2)
        HPH.reshape(size, -1)[:, :: len(MEASURED) + 1] += R
        K = np.swapaxes(HP, 1, 2) @ np.linalg.inv(HPH)
        x = x + (K @ innovation[:, :, None])[:, :, 0]
        x[:, HEADING] = heading[within]
        P = P - K @ HP
        P = 0.5 * (P + np.swapaxes(P, 1, 2))
        if restart is not None and restart.any():
            x[restart, NORTH : EAST + 1] = measured[e, restart, :2]
            P[restart, :, NORTH : EAST + 1] = 0.0
            P[restart, NORTH : EAST + 1, :] = 0.0
            P[restart, NORTH, NORTH] = noise[e, restart, 0]
            P[restart, EAST, EAST] = noise[e, restart, 1]
        _keep(out, e + 1, x, P)
    out.covariance[:] = P
    return out


@dataclass(frozen=True)
class _Schedule:
    """What the clock and the variants decide beforehand, by event and variant."""

    action: NDArray[np.intp]
    startable: Flags
    time_s: Array
    gated: Flags
    obeys: Flags
    told: Array
    told_reset: Flags

    def quiet(self) -> Flags:
        """Events on which every variant fuses unless its gate says otherwise, shape (E,)."""
        return np.asarray(
            np.all(self.action == FUSE, axis=1) & ~self.told_reset & ~(self.told > 0.0)
        )


@dataclass(frozen=True)
class _Fusion:
    """Of each variant: time of the last fusion, whether fusion has stopped, resets left."""

    last_s: Array
    stopped: Flags
    left: NDArray[np.intp]


def _stacked(legs: Sequence[Legs], first: int, pick: NDArray[np.intp] | slice) -> Iterator[Array]:
    """What each of some events does to state and covariance, shape (events, S, ...)."""
    some = slice(first, first + TOGETHER)
    for name in ("transition", "turn", "drive", "gyro_noise", "accelerometer_noise"):
        yield np.stack([getattr(leg, name)[some] for leg in legs], axis=1)[:, pick]


def _schedule(
    inputs: Inputs,
    stretch: Stretch,
    legs: Sequence[Legs],
    which: NDArray[np.intp],
    variants: Sequence[Variant],
) -> _Schedule:
    def stacked(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.stack(parts, axis=1)[:, which]

    gated = np.array([v.gated for v in variants])
    usable = np.where(stacked([leg.usable for leg in legs]), FUSE, IDLE)
    sample = np.maximum(legs[0].sample, 0)
    return _Schedule(
        action=np.where(gated, stacked([leg.action for leg in legs]), usable),
        startable=stacked([leg.startable for leg in legs]),
        time_s=stacked([stretch.time_s[leg.end] for leg in legs]),
        gated=gated,
        obeys=np.array([v.as_logged for v in variants]),
        told=inputs.vision.rejected[sample],
        told_reset=inputs.vision.reset[sample],
    )


def _decide(
    rules: Rules, schedule: _Schedule, e: int, outside: Flags, fusion: _Fusion
) -> tuple[Flags, Flags, Flags, _Fusion]:
    """Which variants reject a sample, fuse it, or reset their position to it.

    As updateEvPosFusion and startEvPosFusion (``ev_pos_control.cpp``): after a time without fusion
    a reset, some of them in a row, then a stop until a sample on which fusion may start.
    """
    action, gated, obeys = schedule.action[e], schedule.gated, schedule.obeys
    now, told, told_reset = schedule.time_s[e], schedule.told[e], schedule.told_reset[e]
    known = bool(np.isfinite(told))
    beyond = np.where(obeys & known, told > 0.0, outside) & gated & (action == FUSE)
    taken = (action == FUSE) & ~beyond & ~fusion.stopped
    starting = gated & ((action == START) | (fusion.stopped & schedule.startable[e]))
    failing = beyond & ~fusion.stopped & (now - fusion.last_s > rules.reset_s)
    restart = starting | (failing & (fusion.left > 0))
    if known or told_reset:
        restart = np.where(obeys, gated & told_reset, restart)
        taken &= ~restart
        failing &= ~obeys
    return (
        beyond,
        taken,
        restart,
        _Fusion(
            np.where(taken | restart, now, fusion.last_s),
            (fusion.stopped & ~starting) | (failing & (fusion.left == 0)),
            np.where(starting, rules.resets, fusion.left - (failing & (fusion.left > 0))),
        ),
    )


def _drift(
    inputs: Inputs, knob: dict[str, Array], biases: Flags, attitude: Flags
) -> tuple[Array, Array]:
    """Variance that the biases gain per step, and the variance at which they stop gaining."""
    gyro = attitude * (knob["EKF2_GYR_B_NOISE"] * inputs.step_s) ** 2
    force = biases * (knob["EKF2_ACC_B_NOISE"] * inputs.step_s) ** 2
    limit = np.stack([knob["EKF2_GYR_NOISE"] ** 2, knob["EKF2_ACC_NOISE"] ** 2], axis=-1)
    return np.repeat(np.stack([gyro, force], axis=-1), 3, axis=-1), np.repeat(limit, 3, axis=-1)


def with_correlation(inputs: Inputs, stretch: Stretch, legs: Legs) -> Stretch:
    """The same stretch with the correlations that its first seconds bring about.

    The log holds variances only. Without correlations the first samples would share out anew
    between tilt and accelerometer bias what EKF2 had long settled.
    """
    count = int(np.searchsorted(stretch.time_s[legs.end], stretch.time_s[0] + CORRELATING_S))
    first = replace(
        legs,
        **{field.name: getattr(legs, field.name)[:count] for field in fields(legs)},
    )
    done = run(inputs, stretch, [first], np.zeros(1, np.intp), [Variant(inputs.settings)])
    # a bias that EKF2 does not learn has no variance
    deviation = np.sqrt(np.maximum(np.diagonal(done.covariance[0]), LEAST_VARIANCE))
    return replace(stretch, correlation=done.covariance[0] / deviation[:, None] / deviation)


def _keep(out: Run, at: int, x: Array, P: Array) -> None:
    out.state[at] = x
    out.variance[at] = P.reshape(len(P), -1)[:, :: STATES + 1]


def _start(stretch: Stretch, biases: Flags, attitude: Flags) -> tuple[Array, Array]:
    """State and covariance at the start, without what a variant does not estimate."""
    x = np.tile(stretch.state, (len(biases), 1))
    deviation = np.sqrt(stretch.variance)
    covariance = deviation[:, None] * stretch.correlation * deviation
    P = np.tile(covariance, (len(biases), 1, 1))
    for part, kept in ((THETA, attitude), (GYRO_BIAS, attitude), (ACCELEROMETER_BIAS, biases)):
        P[~kept, :, part] = 0.0
        P[~kept, part, :] = 0.0
        x[~kept, part] = 0.0
    x[~biases, ACCELEROMETER_BIAS] = -stretch.accelerometer_bias_m_s2
    return x, P


def _down_to(variance: Array, target: Array) -> Array:
    """Noise of the measurement that brings a variance down to a target: 1/target - 1/variance.

    Height and heading come from sensors that logs hold thinly. EKF2's own ones stand in for them as
    measurements, so that their variances become the logged ones.
    """
    surplus = variance - target
    noise = np.full(surplus.shape, NOT_TAKEN)
    np.divide(variance * target, surplus, out=noise, where=surplus > 0.0)
    return noise


def _limit_bias(P: Array, floor: float, biases: Flags) -> None:
    """Keep the bias variance within PX4's limits (fixCovarianceErrors, up to v1.14)."""
    spread = P[:, FORCE_BIAS, FORCE_BIAS]
    least = np.maximum(BIAS_RATIO * spread.max(axis=1, keepdims=True), floor)
    limited = np.clip(spread, least, MAX_BIAS_SD**2)
    P[:, FORCE_BIAS, FORCE_BIAS] = np.where(biases[:, None], limited, spread)


def _measurements(
    inputs: Inputs,
    stretch: Stretch,
    legs: Sequence[Legs],
    which: NDArray[np.intp],
    knob: dict[str, Array],
) -> tuple[Array, Array]:
    """Measured position and its variance, both of shape (E, S, 3)."""
    vision = inputs.vision
    sample = np.maximum(legs[0].sample, 0)
    offset = np.stack([knob[f"EKF2_EV_POS_{axis}"] for axis in "XYZ"], -1) - inputs.imu_offset_m
    position = np.repeat(vision.position_m[sample][:, None], len(which), axis=1)
    if offset.any():
        rotation = np.stack([stretch.rotation[leg.end] for leg in legs], axis=1)[:, which]
        position = position - np.einsum("esij,sj->esi", rotation, offset)
    least = np.maximum(knob["EKF2_EVP_NOISE"], MIN_POSITION_SD_M)[:, None] ** 2
    reported = np.where(
        knob["EKF2_EV_NOISE_MD"][:, None] == 1.0, 0.0, vision.variance_m2[sample][:, None]
    )
    return position, np.maximum(reported, least)
