"""The recursion of the model: several settings of EKF2 through one stretch at once.

Sources: PX4-Autopilot ``EKF/covariance.cpp`` (limits of the biases), ``EKF/position_fusion.cpp``
and ``EKF/vel_pos_fusion.cpp`` (gate, fusion), ``ev_pos_control.cpp`` (noise, resets).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.ekf2.flow import fuse_flow
from px4fuse.ekf2.heights import MIN_GATE, MIN_SD, SENSORS, HeightFilter, barometer_samples
from px4fuse.ekf2.inputs import FusionRules, Inputs
from px4fuse.ekf2.intervals import FUSE, IDLE, START, Events, Intervals, Timing, make_intervals
from px4fuse.ekf2.magnetometer import EventSamples, fuse_field, mean_by_event
from px4fuse.ekf2.stretches import (
    ACCELEROMETER_BIAS,
    BIASES,
    GRAVITY_M_S2,
    GYRO_BIAS,
    IMU_STATE_COUNT,
    STATES,
    THETA,
    VELOCITY,
    Stretch,
)
from px4fuse.ekf2.vision import VisionFilter, set_states, vision_samples
from px4fuse.ekf2_parameters import EV_POS, FLOW, GNSS_POS, GNSS_VEL, MAG, Aid

# How long the first pass runs that gives the correlations at the start
CORRELATION_PASS_S = 8.0
MIN_VARIANCE = 1e-30
# Of an innovation's square over that of its gate, either way: within, what is published after it
# tells whether it was rejected, where the log does not
GATE_EDGE_RATIO = 2.0
# Events whose intervals are stacked at once
EVENT_BATCH_SIZE = 64
# Variance by which a sample is not taken at all
IGNORED_VARIANCE = 1e9
# Of an acceleration (m/s²) that EKF2 takes to be wrong, or that was clipped (BADACC_BIAS_PNOISE,
# common.h; covariance.cpp)
BAD_ACCELERATION_NOISE = 4.9
# EKF2 takes the vertical velocity of GNSS for half as exact again (gps_control.cpp)
VERTICAL_SCALE = np.array([1.0, 1.0, 2.25])
HEIGHT_SCALE = 1.5  # of EKF2_GPS_P_NOISE (gnss_height_control.cpp)
# covariance.cpp: at most 0.1 g of bias, at most a ratio of 100 between the axes
MAX_BIAS_SD = 0.1 * 9.80665
BIAS_RATIO = 0.01
HEADING, NORTH, EAST, DOWN = 2, 6, 7, 8
BIAS_NORTH, BIAS_EAST = 12, 13  # of the accelerometer, turned to the earth
GRAVITY = float(GRAVITY_M_S2[2])
MEASURED = np.array([HEADING, DOWN, NORTH, EAST])
# Slices are views, where indices would be copies
OWN_STATES = slice(HEADING, DOWN + 1, DOWN - HEADING)
HORIZONTAL = slice(NORTH, EAST + 1)
# What a sample tells of: velocity and position. Among these, velocity, and north and east
MEASURED_STATES, VELOCITY_COLUMNS, POSITION_COLUMNS = slice(3, 9), slice(0, 3), slice(3, 5)


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
    velocity : bool
        Whether velocity is fused too, where EKF2 does.
    reported : bool
        Whether what the sender states of its noise is used, where EKF2 uses it.
    gated : bool
        Whether samples are rejected and positions reset.
    as_logged : bool
        Whether samples are rejected and the position is reset where EKF2 itself did, as far as the
        log shows.
    without : mapping from PX4's name of an aid to float
        From when on (s) it is not fused.
    stamp_offset_s : float or None
        What is added to the stamps; None: samples count when EKF2 takes them to have been measured.
    """

    settings: dict[str, float]
    biases: bool = True
    attitude: bool = True
    velocity: bool = True
    reported: bool = True
    gated: bool = True
    as_logged: bool = False
    without: Mapping[str, float] = field(default_factory=dict)
    stamp_offset_s: float | None = None

    def timing(self, inputs: Inputs) -> Timing:
        """What is taken off the stamps, half a step besides, and how far fusion runs behind."""
        if self.stamp_offset_s is not None:
            return Timing(-self.stamp_offset_s - 0.5 * inputs.step_s, np.inf)
        delay_s = self.settings[inputs.aid.delay] * 1e-3
        known = self.settings.keys() & {GNSS_POS.delay, EV_POS.delay}
        most_ms = max(self.settings[name] for name in known)
        if inputs.rules.horizon_by_delay:  # the longest of the delays makes the buffer
            length = math.ceil(most_ms * 1e-3 / inputs.predict_s)
            return Timing(delay_s, max(inputs.horizon_s, (length - 1) * inputs.step_s))
        # EKF2 raises it to the longest delay when it starts (EKF2.cpp)
        longest_ms = max(self.settings["EKF2_DELAY_MAX"], most_ms)
        if longest_ms == inputs.settings["EKF2_DELAY_MAX"]:
            return Timing(delay_s, inputs.horizon_s)
        # initialise_interface, estimator_interface.cpp: the length of the IMU buffer
        length = max(math.ceil(longest_ms * 1e-3 / inputs.predict_s), 2)
        return Timing(delay_s, (length - 1) * inputs.step_s)


@dataclass(frozen=True)
class StretchRun:
    """What S variants did in one stretch of E events.

    Attributes
    ----------
    stretch : Stretch
    variants : tuple of Variant
    events : tuple of recarray
        Of each variant.
    innovation : ndarray, shape (E, S, 6)
        Measurement minus state of velocity (m/s) and position (m), NED; NaN where the event has no
        sample, or EKF2 fuses no velocity.
    innovation_variance : ndarray, shape (E, S, 6)
        S = P + R.
    noise : ndarray, shape (E, S, 6)
        R.
    rejected, fused, reset : ndarray of bool, shape (E, S)
    moved_m : ndarray, shape (E, S, 2)
        By how much the position, north and east, was reset.
    state, variance : ndarray, shape (E + 1, S, n)
        At the start and after each event; n is 15, or 21 where the magnetic fields are states.
    covariance : ndarray, shape (S, n, n)
        At the end.
    field : ndarray, shape (E, 3, S, 3)
        Of the magnetometer (body FRD): innovation (gauss), its variance for one sample, and whether
        it was fused; NaN where there was none. Without rows where the fields are no states.
    heights : HeightFilter or None
        Where heights are fused, and are not EKF2's own.
    vision : VisionFilter or None
        Where vision is fused besides GNSS.
    """

    stretch: Stretch
    variants: tuple[Variant, ...]
    events: tuple[Events, ...]
    innovation: Array
    innovation_variance: Array
    noise: Array
    rejected: BoolArray
    fused: BoolArray
    reset: BoolArray
    moved_m: Array
    state: Array
    variance: Array
    covariance: Array
    field: Array
    heights: HeightFilter | None = None
    vision: VisionFilter | None = None

    __repr__ = one_line_repr


def run_stretch(  # noqa: PLR0912, PLR0915 (one recursion, read from top to bottom)
    inputs: Inputs, stretch: Stretch, variants: Sequence[Variant], intervals: Sequence[Intervals]
) -> StretchRun:
    """Run the variants through one stretch, each with its intervals."""
    size, events = len(variants), len(intervals[0].events)
    parameters = {
        name: np.array([v.settings[name] for v in variants]) for name in variants[0].settings
    }
    biases, attitude, gated, as_logged, reported, fuses_velocity = (
        np.array([getattr(variant, name) for variant in variants])
        for name in ("biases", "attitude", "gated", "as_logged", "reported", "velocity")
    )
    distinct = list(dict.fromkeys(intervals))
    variant_intervals = (
        [distinct.index(each) for each in intervals] if len(distinct) > 1 else slice(None)
    )

    def stacked(name: str, rows: slice = slice(None)) -> Any:
        """A part of the intervals, shape (E, S, ...): what all variants share is there once."""
        return np.stack([getattr(one_interval, name)[rows] for one_interval in distinct], axis=1)[
            :, variant_intervals
        ]

    event = stacked("events")
    action = np.where(gated, event["action"], np.where(event["usable"], FUSE, IDLE))
    end, active = event["end"], action > IDLE
    event_s, sampled = stretch.time_s[end], np.any(active, axis=1).tolist()
    on = {
        aid.name: event_s < np.array([v.without.get(aid.name, np.inf) for v in variants])
        for aid in (inputs.aid, GNSS_VEL, MAG, FLOW, EV_POS, *SENSORS)
    }
    with_velocity = (action == FUSE) & on[GNSS_VEL.name] & fuses_velocity
    sample = np.maximum(intervals[0].events.sample, 0)
    measured, noise = _measurements(inputs, stretch, sample, end, parameters, reported)
    is_sequential, has_speed = inputs.aid == GNSS_POS, inputs.received.velocity_m_s is not None
    gates = [parameters.get(GNSS_VEL.gate, np.ones(size)), parameters[inputs.aid.gate]]
    gate2 = np.maximum(np.repeat(np.stack(gates, axis=1), 3, axis=1), MIN_GATE) ** 2
    # height, and without a magnetometer the heading, are measured by EKF2's own
    logged_own = np.stack([stretch.attitude_error_rad[end, HEADING], stretch.down_m[end]], axis=-1)
    own_attitude = stretch.attitude_variance_rad2[end]
    own_variance = np.stack([own_attitude[:, :, HEADING], stretch.down_variance_m2[end]], axis=-1)
    field_samples = heights = flow_samples = vision = None
    has_field, has_flow = np.zeros((2, events), bool)

    def means(source_aid: Aid, samples_per_interval: Sequence[EventSamples]) -> EventSamples:
        """What all variants were sent of an aid, while it is there."""
        stacked_fields = (
            np.stack(part, axis=1)[:, variant_intervals]
            for part in zip(*samples_per_interval, strict=True)
        )
        mean_samples = EventSamples(*stacked_fields)
        return mean_samples._replace(number=np.where(on[source_aid.name], mean_samples.number, 0.0))

    ends = [one.events.end for one in distinct]
    if (field := stretch.field) is not None:
        field_samples = means(MAG, [mean_by_event(field, one) for one in ends])
        has_field = np.asarray(field_samples.number.any(axis=1))
    if (flow := stretch.flow) is not None:
        flow_samples = means(FLOW, [mean_by_event(flow, one, stretch.gained_m_s) for one in ends])
        has_flow = np.asarray(flow_samples.number.any(axis=1))
    if stretch.heights is not None:
        samples = barometer_samples(stretch, ends)
        barometer_arrays = np.stack(samples, axis=-1)[..., variant_intervals]
        heights = HeightFilter(
            stretch, barometer_arrays, event["time_s"], active, on, parameters, gated
        )
    if inputs.vision is not None:
        timings = [variant.timing(inputs) for variant in variants]
        vision_by_variant = [
            vision_samples(inputs, stretch, each.events.end, variant.settings, at.horizon_s)
            for each, variant, at in zip(intervals, variants, timings, strict=True)
        ]
        vision = VisionFilter(stretch, vision_by_variant, on, parameters, gated, reported)
    gyro2 = np.where(attitude, parameters["EKF2_GYR_NOISE"] ** 2, 0.0)[:, None, None]
    drift, drift_limit = _variance_growth(inputs, stretch, parameters, biases, attitude)
    steps = np.diff(end, axis=0, prepend=0)[:, :, None]
    force2 = np.broadcast_to(parameters["EKF2_ACC_NOISE"] ** 2, active.shape)[:, :, None, None]
    if stretch.distrusted_share is not None:  # in how much of each interval
        sums = np.diff(
            np.cumsum(stretch.distrusted_share)[end], axis=0, prepend=stretch.distrusted_share[0]
        )
        share = (sums[:, :, None] / np.maximum(steps, 1))[..., None]
        force2 = (1.0 - share) * force2 + share * BAD_ACCELERATION_NOISE**2
    floor = inputs.rules.bias_floor
    x, P = _start_state(stretch, biases, attitude)
    logged = inputs.received.rejected[sample], inputs.received.reset[sample]
    used = on[inputs.aid.name]
    moved = inputs.received.moved_m if as_logged.any() else None
    usable = np.where(used, action, IDLE), event["startable"] & used, event_s, gated, as_logged
    fusion = _Fusion(inputs.rules, stretch.time_s[0], *usable, *logged)
    innovations, variances = np.full((2, events, size, 6), np.nan)
    field_record = np.full((0 if field_samples is None else events, 3, size, 3), np.nan)
    rejected, fused, reset = np.zeros((3, events, size), bool)
    moved_m = np.zeros((events, size, 2))
    states, spreads = np.empty((2, events + 1, size, x.shape[1]))
    states[0], spreads[0] = x, _diagonal(P)
    innovation, R = np.empty((2, size, 4))
    measured_slice = slice(0 if has_speed else POSITION_COLUMNS.start, POSITION_COLUMNS.stop)
    taken = np.zeros((size, POSITION_COLUMNS.stop), bool)
    for e in range(events):
        block_index = e % EVENT_BATCH_SIZE
        if not block_index:  # intervals are long: a few at a time
            block = slice(e, e + EVENT_BATCH_SIZE)
            transition = stacked("transition", block)
            inputs_moved = stacked("drive", block) + attitude[:, None] * stacked("turn", block)
            added = gyro2 * stacked("gyro_noise", block)
            added = added + force2[block] * stacked("accelerometer_noise", block)
            variance_growth = drift * steps[block]
        phi = transition[block_index]
        # x = Φx + u, P = ΦPΦ' + Q
        x[:, :STATES] = (phi @ x[:, :STATES, None])[:, :, 0] + inputs_moved[block_index]
        P[:, :STATES] = phi @ P[:, :STATES]
        P[:, :, :STATES] = P[:, :, :STATES] @ np.swapaxes(phi, 1, 2)
        P[:, :IMU_STATE_COUNT, :IMU_STATE_COUNT] += added[block_index]
        bias_variance = _diagonal(P)[:, BIASES.start :]
        bias_variance += (bias_variance < drift_limit) * variance_growth[block_index]
        if floor is not None:
            _limit_bias(P, floor, biases)
        innovation[:, 2:], R[:, 2:] = 0.0, IGNORED_VARIANCE
        if field_samples is not None and has_field[e]:
            field_now = EventSamples(*(part[e] for part in field_samples))
            x, P, field_record[e] = fuse_field(
                x, P, field_now, parameters[MAG.noise], parameters[MAG.gate]
            )
        if flow_samples is not None and flow is not None and has_flow[e]:
            x, P = fuse_flow(x, P, EventSamples(*(part[e] for part in flow_samples)), flow.gate)
        if vision is not None:
            x, P = vision.fuse(e, x, P, False, fusion.last_s)
        if sampled[e]:
            nu = measured[e] - x[:, MEASURED_STATES]
            S = _diagonal(P)[:, MEASURED_STATES] + noise[e]
            innovations[e], variances[e] = nu, S
            outside = nu * nu > gate2 * S
            is_velocity_fused = with_velocity[e] & ~(
                outside[:, VELOCITY_COLUMNS].any(axis=1) & gated
            )
            outside = outside[:, POSITION_COLUMNS].any(axis=1)
            if moved is not None:
                is_on_edge, was_rejected = _rejection_by_output(
                    moved[sample[e]],
                    *(each[:, POSITION_COLUMNS] for each in (nu, S, noise[e], gate2)),
                )
                outside = np.where(as_logged & is_on_edge, was_rejected, outside)
            rejected[e], fused[e], reset[e], is_velocity_fused = fusion.decide(
                e, outside, is_velocity_fused
            )
            if is_sequential:
                if field_samples is None:
                    for row in range(HEADING):
                        _, P = _reduce_variance_to(P, row, own_attitude[e, :, row])
                taken[:, VELOCITY_COLUMNS], taken[:, POSITION_COLUMNS] = (
                    is_velocity_fused[:, None],
                    fused[e, :, None],
                )
                x, P = _sequential_update(
                    x, P, nu, S, noise[e], measured_slice, taken[:, measured_slice]
                )
            else:
                innovation[:, 2:] = nu[:, POSITION_COLUMNS]
                R[fused[e], 2:] = noise[e, fused[e], POSITION_COLUMNS]
        if heights is not None:
            x, P = heights.fuse(e, x, P, measured[e, :, 5], noise[e, :, 5])
        elif field_samples is not None:  # only the height is EKF2's own, and held
            K, P = _reduce_variance_to(P, DOWN, own_variance[e, :, 1])
            x = x + K * (logged_own[e, :, 1] - x[:, DOWN])[:, None]
            x[:, DOWN] = logged_own[e, :, 1]
        if field_samples is None:
            np.subtract(logged_own[e], x[:, OWN_STATES], out=innovation[:, :2])
            R[:, :2] = _noise_to_reach(_diagonal(P)[:, OWN_STATES], own_variance[e])
            heading = np.where(attitude, x[:, HEADING] + innovation[:, 0], 0.0)
            if inputs.vision_height or heights is not None:
                R[:, 1] = IGNORED_VARIANCE
                if sampled[e] and heights is None:
                    innovation[:, 1] = nu[:, 5]
                    R[:, 1] = np.where(active[e], noise[e, :, 5], IGNORED_VARIANCE)
            x, P = _joint_update(x, P, innovation, R)
            x[:, HEADING] = heading
        if sampled[e] and reset[e].any():
            after = inputs.rules.reset_scale * noise[e, :, POSITION_COLUMNS]
            set_states(x, P, reset[e], HORIZONTAL, measured[e, :, POSITION_COLUMNS], after)
            if has_speed and inputs.rules.with_velocity:
                set_states(
                    x,
                    P,
                    reset[e],
                    VELOCITY,
                    measured[e, :, VELOCITY_COLUMNS],
                    noise[e, :, VELOCITY_COLUMNS],
                )
            # measured position minus the state before
            moved_m[e, reset[e]] = nu[reset[e], POSITION_COLUMNS]
        if vision is not None:
            vision.bias.value_m = vision.bias.value_m + moved_m[e]
            x, P = vision.fuse(e, x, P, True, fusion.last_s)
            if inputs.rules.with_velocity:  # either of them is a position that is fused
                fusion.last_s = np.maximum(fusion.last_s, vision.fused_s)
        states[e + 1], spreads[e + 1] = x, _diagonal(P)
    innovations[~active], variances[~active] = np.nan, np.nan
    return StretchRun(
        stretch,
        tuple(variants),
        tuple(each.events for each in intervals),
        innovations,
        variances,
        noise,
        rejected,
        fused,
        reset,
        moved_m if vision is None else moved_m + vision.moved_m,
        states,
        spreads,
        P,
        field_record,
        heights,
        vision,
    )


def _joint_update(x: Array, P: Array, innovation: Array, R: Array) -> tuple[Array, Array]:
    """Fuse what is measured all at once: K = PH'(HPH' + R)⁻¹, x = x + Kν, P = P - KHP."""
    HP = np.take(P, MEASURED, axis=1)
    HPH = np.take(HP, MEASURED, axis=2)
    HPH.reshape(len(x), -1)[:, :: len(MEASURED) + 1] += R
    K = np.swapaxes(HP, 1, 2) @ np.linalg.inv(HPH)
    x = x + (K @ innovation[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + np.swapaxes(P, 1, 2))


def _reduce_variance_to(P: Array, row: int, target: Array) -> tuple[Array, Array]:
    """Bring one variance down to the logged one, and with it all that it bears on; and the gain.

    The magnetometer tells EKF2 of the tilt too. What it tells is not always in the log, so that the
    tilt itself stays as it is.
    """
    variance = P[:, row, row]
    R = _noise_to_reach(variance, target)
    K = P[:, :, row] / (variance + R)[:, None]
    return K, P - K[:, :, None] * P[:, None, row]


def _sequential_update(
    x: Array, P: Array, nu: Array, S: Array, R: Array, part: slice, is_fused: BoolArray
) -> tuple[Array, Array]:
    """Fuse a part of a sample one after the other, by innovations and S of before the first.

    As fuseDirectStateMeasurement (``ekf_helper.cpp``), in Joseph's form, which bears a gain that is
    not the optimal one: with c = PH' and K = wc it is P - KHP - (KHP)' + K(HPH' + R)K' = P - bcc',
    b = w(2 - w(HPH' + R)). ``is_fused`` is of shape (S, k) or (S, 1).
    """
    nu, S, R = (each[:, part] for each in (nu, S, R))
    weight = is_fused / S
    square = weight * weight
    b, rows = (
        2.0 * weight - square * R,
        slice(MEASURED_STATES.start + part.start, MEASURED_STATES.start + part.stop),
    )
    columns = P[:, rows].copy()
    for j in range(nu.shape[1]):
        column = columns[:, j]
        cross_covariance = column[:, rows]
        b[:, j] -= square[:, j] * cross_covariance[:, j]
        if j < nu.shape[1] - 1:
            columns[:, j + 1 :] -= (b[:, j, None] * cross_covariance[:, j + 1 :])[
                :, :, None
            ] * column[:, None]
    x = x + ((weight * nu)[:, None] @ columns)[:, 0]
    root = np.sqrt(b)[:, :, None] * columns
    return x, P - np.swapaxes(root, 1, 2) @ root


def _rejection_by_output(
    moved_m: Array, nu: Array, S: Array, R: Array, gate2: Array
) -> tuple[BoolArray, BoolArray]:
    """Whether a sample lies on the edge of the gate, and then whether it was rejected.

    As what was published after it moved, of shape (k,), to less than half of what its fusion does,
    (1 - R/S)ν; the others are of shape (S, k).
    """
    ratio = (nu * nu / (gate2 * S)).max(axis=1)
    edge = (ratio > 1.0 / GATE_EDGE_RATIO) & (ratio < GATE_EDGE_RATIO) & np.isfinite(moved_m).all()
    fusion = (1.0 - R / S) * nu
    return edge, fusion @ moved_m < 0.5 * (fusion * fusion).sum(axis=1)


@dataclass
class _Fusion:
    """Which variants reject a sample, fuse it or are reset to it, one event after the other.

    As updateEvPosFusion and startEvPosFusion (``ev_pos_control.cpp``): after a time without fusion
    a reset, some of them in a row, then a stop until a sample on which fusion may start. Arrays are
    of shape (E, S), (S,) or (E,); ``rejected`` and ``reset`` are what the log tells of EKF2.
    """

    rules: FusionRules
    began_s: float
    action: IntArray
    startable: BoolArray
    time_s: Array
    gated: BoolArray
    as_logged: BoolArray
    rejected: Array
    reset: BoolArray

    def __post_init__(self) -> None:
        size = len(self.gated)
        # last fusion of position and of velocity, whether stopped, resets left
        self.last_s, self.velocity_s = np.full((2, size), self.began_s)
        self.stopped, self.left = np.zeros(size, bool), np.full(size, self.rules.resets)
        # every variant fuses, unless its gate says otherwise
        self.usual = (self.action == FUSE).all(axis=1) & ~self.reset & ~(self.rejected > 0.0)

    def decide(
        self, e: int, outside: BoolArray, is_velocity_fused: BoolArray
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Whose sample is rejected, fused, reset to, and whose velocity is fused.

        ``outside`` is outside the gate, ``is_velocity_fused`` has a velocity that is fused, within its own.
        """
        rules, now_s, action = self.rules, self.time_s[e], self.action[e]
        gated, follows_log = self.gated, self.as_logged
        fusing, is_decision_logged = action == FUSE, math.isfinite(self.rejected[e])
        self.velocity_s = np.where(is_velocity_fused, now_s, self.velocity_s)
        if self.usual[e] and not (outside.any() or self.stopped.any()):
            self.last_s = now_s
            return outside, fusing, outside, is_velocity_fused
        is_rejected = (
            np.where(follows_log & is_decision_logged, self.rejected[e] > 0.0, outside)
            & gated
            & fusing
        )
        is_fused = fusing & ~is_rejected & ~self.stopped
        is_starting = gated & ((action == START) | (self.stopped & self.startable[e]))
        silent_s = now_s - self.last_s
        is_failing = is_rejected & ~self.stopped & (silent_s > rules.reset_s)
        if rules.with_velocity:
            both = now_s - self.velocity_s > rules.reset_s
            is_failing &= both | (silent_s > 2.0 * rules.reset_s)
        is_restarted = is_starting | (is_failing & (self.left > 0))
        if is_decision_logged or self.reset[e]:
            is_restarted = np.where(follows_log, gated & self.reset[e], is_restarted)
            is_fused &= ~is_restarted
            is_failing &= ~follows_log
        self.last_s = np.where(is_fused | is_restarted, now_s, self.last_s)
        self.velocity_s = np.where(is_restarted, now_s, self.velocity_s)
        self.stopped = (self.stopped & ~is_starting) | (is_failing & (self.left == 0))
        left = self.left - (is_failing & (self.left > 0))
        self.left = np.where(is_starting, rules.resets, left)
        return is_rejected, is_fused, is_restarted, is_velocity_fused & ~is_restarted


def _variance_growth(
    inputs: Inputs,
    stretch: Stretch,
    parameters: dict[str, Array],
    biases: BoolArray,
    attitude: BoolArray,
) -> tuple[Array, Array]:
    """Variance that biases and fields gain per step, and at which variance they stop gaining."""
    field_parameters = ("MAG_E", "MAG_B") if stretch.field is not None else ()
    noise_density = np.stack(
        [parameters[f"EKF2_{of}_NOISE"] for of in ("GYR_B", "ACC_B", *field_parameters)], axis=-1
    )
    noise_density[:, :2] *= np.stack([attitude, biases], axis=-1)
    limit = np.stack(
        [parameters[f"EKF2_{of}_NOISE"] for of in ("GYR", "ACC", *["MAG"] * len(field_parameters))],
        axis=-1,
    )
    return np.repeat((noise_density * inputs.step_s) ** 2, 3, axis=-1), np.repeat(
        limit**2, 3, axis=-1
    )


def with_correlation(inputs: Inputs, stretch: Stretch, intervals: Intervals) -> Stretch:
    """The same stretch with the correlations at its start; the log holds variances only.

    Without them the first samples would share out anew between tilt and accelerometer bias what
    EKF2 had long settled. They come of what was before; where the log has nothing of it, of the
    first seconds.
    """
    flown_variant, inputs = Variant(inputs.settings), replace(inputs, vision=None)
    if (earlier := stretch.history) is not None:
        earlier = replace(earlier, correlation=_settled_correlation(earlier))
        history_intervals = make_intervals(inputs, earlier, flown_variant.timing(inputs))
        correlation = _correlation(
            run_stretch(inputs, earlier, [flown_variant], [history_intervals]).covariance[0]
        )
    else:
        ends_s = stretch.time_s[intervals.events.end]
        count = int(np.searchsorted(ends_s, stretch.time_s[0] + CORRELATION_PASS_S))
        first_intervals = Intervals(
            *(getattr(intervals, field.name)[:count] for field in fields(intervals))
        )
        correlation = _correlation(
            run_stretch(inputs, stretch, [flown_variant], [first_intervals]).covariance[0]
        )
    if stretch.field is not None:
        # EKF2 has just reset heading and fields, which parts them from all other states
        correlation = block_diag(correlation[:STATES, :STATES], np.eye(len(stretch.state) - STATES))
        correlation[HEADING], correlation[:, HEADING] = 0.0, 0.0
        correlation[HEADING, HEADING] = 1.0
    return replace(stretch, correlation=correlation)


def _correlation(P: Array) -> Array:
    # a bias that EKF2 does not learn has no variance
    deviation = np.sqrt(np.maximum(np.diagonal(P), MIN_VARIANCE))
    return np.asarray(P / deviation[:, None] / deviation)


def _settled_correlation(stretch: Stretch) -> Array:
    """Correlations of a state whose velocity was measured for long.

    Errors of the tilt and of the accelerometer's bias are known together: what they do to the
    acceleration cancels, θ x f = Rb, as far as both are as large.
    """
    to_earth = np.eye(STATES)
    to_earth[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = stretch.rotation[0]
    P = np.diag(np.diagonal(to_earth @ np.diag(stretch.variance) @ to_earth.T))
    for tilt, bias, effect in ((1, BIAS_NORTH, -GRAVITY), (0, BIAS_EAST, GRAVITY)):
        P[tilt, bias] = P[bias, tilt] = min(P[tilt, tilt] * effect**2, P[bias, bias]) / effect
    return _correlation(to_earth.T @ P @ to_earth)


def _diagonal(P: Array) -> Array:
    """Its variances: a view, not a copy."""
    return P.reshape(len(P), -1)[:, :: P.shape[1] + 1]


def _start_state(stretch: Stretch, biases: BoolArray, attitude: BoolArray) -> tuple[Array, Array]:
    """State and covariance at the start, without what a variant does not estimate."""
    x = np.tile(stretch.state, (len(biases), 1))
    deviation = np.sqrt(stretch.variance)
    P = np.tile(deviation[:, None] * stretch.correlation * deviation, (len(biases), 1, 1))
    for rows, is_estimated in (
        (THETA, attitude),
        (GYRO_BIAS, attitude),
        (ACCELEROMETER_BIAS, biases),
    ):
        P[~is_estimated, :, rows] = 0.0
        P[~is_estimated, rows, :] = 0.0
        x[~is_estimated, rows] = 0.0
    x[~biases, ACCELEROMETER_BIAS] = -stretch.accelerometer_bias_m_s2
    return x, P


def _noise_to_reach(variance: Array, target: Array) -> Array:
    """Noise of the measurement that brings a variance down to a target: 1/target - 1/variance.

    Height and heading come from sensors that logs hold thinly. EKF2's own ones stand in for them as
    measurements, so that their variances become the logged ones.
    """
    surplus = variance - target
    noise = np.full(surplus.shape, IGNORED_VARIANCE)
    np.divide(variance * target, surplus, out=noise, where=surplus > 0.0)
    return noise


def _limit_bias(P: Array, floor: float, biases: BoolArray) -> None:
    """Keep the bias variance within PX4's limits (fixCovarianceErrors, up to v1.14)."""
    variance = _diagonal(P)[:, ACCELEROMETER_BIAS]
    min_variance = np.maximum(BIAS_RATIO * variance.max(axis=1, keepdims=True), floor)
    variance[biases] = np.clip(variance, min_variance, MAX_BIAS_SD**2)[biases]


def _measurements(
    inputs: Inputs,
    stretch: Stretch,
    sample: IntArray,
    end: IntArray,
    parameters: dict[str, Array],
    reported: BoolArray,
) -> tuple[Array, Array]:
    """Measured velocity and position and their variances, both of shape (E, S, 6)."""
    received, aid = inputs.received, inputs.aid
    offset_m = (np.stack([parameters[name] for name in aid.place], -1) - inputs.imu_offset_m)[
        :, :, None
    ]
    measured, noise = np.full((2, len(end), len(offset_m), 6), np.nan)
    lever = (stretch.rotation[end] @ offset_m)[..., 0]
    measured[..., 3:] = received.position_m[sample][:, None] - lever
    if aid.noise_mode:
        reported = reported & (parameters[aid.noise_mode] != 1.0)
    reported_variance = np.where(reported[:, None], received.variance_m2[sample][:, None], 0.0)
    noise[..., 3:] = np.maximum(
        reported_variance, np.maximum(parameters[aid.noise], MIN_SD)[:, None] ** 2
    )
    if received.velocity_m_s is not None and received.velocity_variance_m2_s2 is not None:
        # the antenna's own, as the vehicle turns
        rotation_rate = (
            np.diff(stretch.rotation, axis=0)[end - 1] / stretch.step_s[end - 1, None, None]
        )
        lever = (rotation_rate @ offset_m)[..., 0]
        measured[..., :3] = received.velocity_m_s[sample][:, None] - lever
        reported_variance = received.velocity_variance_m2_s2[sample][:, None]
        min_variance = np.maximum(parameters[GNSS_VEL.noise], MIN_SD)[:, None] ** 2
        noise[..., :3] = np.maximum(reported_variance, min_variance) * VERTICAL_SCALE
    if aid == GNSS_POS:
        noise[..., 5] = np.maximum(noise[..., 5], (HEIGHT_SCALE * parameters[aid.noise]) ** 2)
    return measured, noise
