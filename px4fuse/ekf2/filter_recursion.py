"""Filter recursion of the EKF2 replay: several settings run through one stretch together.

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
from px4fuse.ekf2.flow import fuse_flow
from px4fuse.ekf2.heights import MIN_GATE, MIN_SD, SENSORS, HeightFilter, barometer_samples
from px4fuse.ekf2.inputs import FusionRules, Inputs
from px4fuse.ekf2.intervals import FUSE, IDLE, START, Events, Intervals, Timing, make_intervals
from px4fuse.ekf2.magnetometer import EventSamples, fuse_field, mean_by_event
from px4fuse.ekf2.replay_segments import (
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
from px4fuse.notebook_display import one_line_repr

# s; length of the first pass, which estimates the initial correlations
CORRELATION_PASS_S = 8.0
MIN_VARIANCE = 1e-30  # lower limit of a variance before division
# Range of NIS / gate² (1/2 to 2) in which an unlogged rejection is inferred from the published
# position
GATE_EDGE_RATIO = 2.0
# number of events whose intervals are stacked together, to limit memory
EVENT_BATCH_SIZE = 64
# m², variance of a measurement without effect
IGNORED_VARIANCE = 1e9
# m/s², acceleration noise while EKF2 reports a bad or clipped acceleration (BADACC_BIAS_PNOISE,
# common.h; covariance.cpp)
BAD_ACCELERATION_NOISE = 4.9
# Variance factors of GNSS velocity: EKF2 multiplies the vertical σ by 1.5 (gps_control.cpp)
VERTICAL_SCALE = np.array([1.0, 1.0, 2.25])
HEIGHT_SCALE = 1.5  # factor on EKF2_GPS_P_NOISE for GNSS height (gnss_height_control.cpp)
# Bias limits in covariance.cpp: σ at most 0.1 g, variance ratio between axes at most 100
MAX_BIAS_SD = 0.1 * 9.80665
BIAS_RATIO = 0.01
HEADING, NORTH, EAST, DOWN = 2, 6, 7, 8
BIAS_NORTH, BIAS_EAST = 12, 13  # accelerometer bias rotated to NED
GRAVITY = float(GRAVITY_M_S2[2])
MEASURED = np.array([HEADING, DOWN, NORTH, EAST])
# Slices, because they are views; index arrays would copy
OWN_STATES = slice(HEADING, DOWN + 1, DOWN - HEADING)
HORIZONTAL = slice(NORTH, EAST + 1)
# Rows of velocity and position, which a sample can measure; columns of velocity and of horizontal
# position among these
MEASURED_STATES, VELOCITY_COLUMNS, POSITION_COLUMNS = slice(3, 9), slice(0, 3), slice(3, 5)


@dataclass(frozen=True)
class Variant:
    """One filter configuration to run.

    Attributes
    ----------
    settings : dict
        All parameters of the model, by PX4 name.
    biases : bool
        True if the accelerometer bias is a state; else it is 0.
    attitude : bool
        True if attitude and gyro bias are states; else the published attitude is used.
    velocity : bool
        True if velocity is fused when EKF2 fuses it.
    reported : bool
        True if the noise reported by the sender is used when EKF2 uses it.
    gated : bool
        True if samples are rejected and positions reset.
    as_logged : bool
        True if logged rejections and resets replace the gate.
    without : mapping from PX4's name of an aid to float
        Time (s) from which the aid is not fused.
    timestamp_offset_s : float or None
        Added to the timestamps; None: EKF2's delay parameter is used.
    """

    settings: dict[str, float]
    biases: bool = True
    attitude: bool = True
    velocity: bool = True
    reported: bool = True
    gated: bool = True
    as_logged: bool = False
    without: Mapping[str, float] = field(default_factory=dict)
    timestamp_offset_s: float | None = None

    def timing(self, inputs: Inputs) -> Timing:
        """Return the total age of a position at its timestamp, and the fusion horizon (s)."""
        if self.timestamp_offset_s is not None:
            return Timing(-self.timestamp_offset_s - 0.5 * inputs.step_s, np.inf)
        delay_s = self.settings[inputs.aid.delay] * 1e-3
        known = self.settings.keys() & {GNSS_POS.delay, EV_POS.delay}
        most_ms = max(self.settings[name] for name in known)
        if inputs.rules.horizon_by_delay:  # the IMU buffer covers the largest delay
            length = math.ceil(most_ms * 1e-3 / inputs.predict_s)
            return Timing(delay_s, max(inputs.horizon_s, (length - 1) * inputs.step_s))
        # at start EKF2 raises EKF2_DELAY_MAX to the largest delay (EKF2.cpp)
        longest_ms = max(self.settings["EKF2_DELAY_MAX"], most_ms)
        if longest_ms == inputs.settings["EKF2_DELAY_MAX"]:
            return Timing(delay_s, inputs.horizon_s)
        # length of the IMU buffer (initialise_interface, estimator_interface.cpp)
        length = max(math.ceil(longest_ms * 1e-3 / inputs.predict_s), 2)
        return Timing(delay_s, (length - 1) * inputs.step_s)


@dataclass(frozen=True)
class StretchRun:
    """Results of S variants in one stretch with E events.

    Attributes
    ----------
    stretch : Stretch
    variants : tuple of Variant
    events : tuple of recarray
        Events of each variant.
    innovation : ndarray, shape (E, S, 6)
        Measurement minus state of velocity (m/s) and position (m), NED; NaN without a sample or
        without velocity fusion.
    innovation_variance : ndarray, shape (E, S, 6)
        S = P + R.
    noise : ndarray, shape (E, S, 6)
        R.
    rejected, fused, reset : ndarray of bool, shape (E, S)
    moved_m : ndarray, shape (E, S, 2)
        Position reset, north and east.
    state, variance : ndarray, shape (E + 1, S, n)
        At the start and after each event; n is 15, or 21 with magnetic fields as states.
    covariance : ndarray, shape (S, n, n)
        At the end.
    field : ndarray, shape (E, 3, S, 3)
        Magnetometer (body FRD): innovation (gauss), its variance for one sample, and 1 if fused;
        NaN without a sample. No rows if the fields are not states.
    heights : HeightFilter or None
        None if the logged EKF2 height is used.
    vision : VisionFilter or None
        Set if vision is fused besides GNSS.
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
        """Stack a field of the distinct intervals per variant, shape (E, S, ...)."""
        return np.stack([getattr(one_interval, name)[rows] for one_interval in distinct], axis=1)[
            :, variant_intervals
        ]

    event = stacked("events")
    action = np.where(gated, event["action"], np.where(event["usable"], FUSE, IDLE))
    end, active = event["end"], action > IDLE
    event_s, sampled = stretch.time_s[end], np.any(active, axis=1).tolist()
    enabled = {
        aid.name: event_s < np.array([v.without.get(aid.name, np.inf) for v in variants])
        for aid in (inputs.aid, GNSS_VEL, MAG, FLOW, EV_POS, *SENSORS)
    }
    with_velocity = (action == FUSE) & enabled[GNSS_VEL.name] & fuses_velocity
    sample = np.maximum(intervals[0].events.sample, 0)
    measured, noise = _measurements(inputs, stretch, sample, end, parameters, reported)
    is_sequential, has_speed = inputs.aid == GNSS_POS, inputs.received.velocity_m_s is not None
    gates = [parameters.get(GNSS_VEL.gate, np.ones(size)), parameters[inputs.aid.gate]]
    gate2 = np.maximum(np.repeat(np.stack(gates, axis=1), 3, axis=1), MIN_GATE) ** 2
    # logged EKF2 values serve as measurements of height and, without a magnetometer, of heading
    logged_own = np.stack([stretch.attitude_error_rad[end, HEADING], stretch.down_m[end]], axis=-1)
    own_attitude = stretch.attitude_variance_rad2[end]
    own_variance = np.stack([own_attitude[:, :, HEADING], stretch.down_variance_m2[end]], axis=-1)
    field_samples = heights = flow_samples = vision = None
    has_field, has_flow = np.zeros((2, events), bool)

    def means(source_aid: Aid, samples_per_interval: Sequence[EventSamples]) -> EventSamples:
        """Return the samples of an aid for all variants, without those after it was disabled."""
        stacked_fields = (
            np.stack(part, axis=1)[:, variant_intervals]
            for part in zip(*samples_per_interval, strict=True)
        )
        mean_samples = EventSamples(*stacked_fields)
        return mean_samples._replace(
            number=np.where(enabled[source_aid.name], mean_samples.number, 0.0)
        )

    ends = [one.events.end for one in distinct]
    if (field := stretch.field) is not None:
        field_samples = means(MAG, [mean_by_event(field, one) for one in ends])
        has_field = np.asarray(field_samples.number.any(axis=1))
    if (flow := stretch.flow) is not None:
        flow_samples = means(
            FLOW, [mean_by_event(flow, one, stretch.imu_velocity_m_s) for one in ends]
        )
        has_flow = np.asarray(flow_samples.number.any(axis=1))
    if stretch.heights is not None:
        samples = barometer_samples(stretch, ends)
        barometer_arrays = np.stack(samples, axis=-1)[..., variant_intervals]
        heights = HeightFilter(
            stretch, barometer_arrays, event["time_s"], active, enabled, parameters, gated
        )
    if inputs.vision is not None:
        timings = [variant.timing(inputs) for variant in variants]
        vision_by_variant = [
            vision_samples(inputs, stretch, each.events.end, variant.settings, at.horizon_s)
            for each, variant, at in zip(intervals, variants, timings, strict=True)
        ]
        vision = VisionFilter(stretch, vision_by_variant, enabled, parameters, gated, reported)
    gyro2 = np.where(attitude, parameters["EKF2_GYR_NOISE"] ** 2, 0.0)[:, None, None]
    drift, drift_limit = _variance_growth(inputs, stretch, parameters, biases, attitude)
    steps = np.diff(end, axis=0, prepend=0)[:, :, None]
    force2 = np.broadcast_to(parameters["EKF2_ACC_NOISE"] ** 2, active.shape)[:, :, None, None]
    if stretch.bad_acceleration_share is not None:  # share of each interval with a bad acceleration
        sums = np.diff(
            np.cumsum(stretch.bad_acceleration_share)[end],
            axis=0,
            prepend=stretch.bad_acceleration_share[0],
        )
        share = (sums[:, :, None] / np.maximum(steps, 1))[..., None]
        force2 = (1.0 - share) * force2 + share * BAD_ACCELERATION_NOISE**2
    floor = inputs.rules.bias_floor
    x, P = _start_state(stretch, biases, attitude)
    logged = inputs.received.rejected[sample], inputs.received.reset[sample]
    used = enabled[inputs.aid.name]
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
        if not block_index:  # intervals are long: stack a few at a time
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
        # with magnetic fields only the height is set to the logged one
        elif field_samples is not None:
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
            moved_m[e, reset[e]] = nu[reset[e], POSITION_COLUMNS]
        if vision is not None:
            vision.bias.value_m = vision.bias.value_m + moved_m[e]
            x, P = vision.fuse(e, x, P, True, fusion.last_s)
            if inputs.rules.with_velocity:  # GNSS or vision counts as a fused position
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
    """Fuse all measurements together: K = PH'(HPH' + R)⁻¹, x = x + Kν, P = P - KHP."""
    HP = np.take(P, MEASURED, axis=1)
    HPH = np.take(HP, MEASURED, axis=2)
    HPH.reshape(len(x), -1)[:, :: len(MEASURED) + 1] += R
    K = np.swapaxes(HP, 1, 2) @ np.linalg.inv(HPH)
    x = x + (K @ innovation[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + np.swapaxes(P, 1, 2))


def _reduce_variance_to(P: Array, row: int, target: Array) -> tuple[Array, Array]:
    """Apply a scalar update that reduces P[row, row] to ``target``; return gain and P.

    The magnetometer also corrects the tilt in EKF2. It is not always logged, so the tilt itself is
    not changed.
    """
    variance = P[:, row, row]
    R = _noise_to_reach(variance, target)
    K = P[:, :, row] / (variance + R)[:, None]
    return K, P - K[:, :, None] * P[:, None, row]


def _sequential_update(
    x: Array, P: Array, nu: Array, S: Array, R: Array, part: slice, is_fused: BoolArray
) -> tuple[Array, Array]:
    """Fuse the components of a sample one after the other, with the initial innovations and S.

    As fuseDirectStateMeasurement (``ekf_helper.cpp``), in Joseph form, which is valid for any gain.
    With c = PH' and K = wc: P - KHP - (KHP)' + K(HPH' + R)K' = P - bcc', b = w(2 - w(HPH' + R)).
    ``is_fused`` has shape (S, k) or (S, 1).
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
    """Return two flags: sample near the gate limit, and then rejected by EKF2.

    Rejected if the published position moved (``moved_m``, shape (k,)) by less than half of the
    correction (1 - R/S)ν. The other arrays have shape (S, k).
    """
    ratio = (nu * nu / (gate2 * S)).max(axis=1)
    edge = (ratio > 1.0 / GATE_EDGE_RATIO) & (ratio < GATE_EDGE_RATIO) & np.isfinite(moved_m).all()
    fusion = (1.0 - R / S) * nu
    return edge, fusion @ moved_m < 0.5 * (fusion * fusion).sum(axis=1)


@dataclass
class _Fusion:
    """State machine for rejection, fusion and reset of each variant, event by event.

    As updateEvPosFusion and startEvPosFusion (``ev_pos_control.cpp``): after a time without fusion
    the position is reset; after several resets in a row fusion stops until a sample on which it may
    start. Arrays have shape (E, S), (S,) or (E,); ``rejected`` and ``reset`` are the logged
    decisions.
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
        # time of the last fusion of position and of velocity; stopped; remaining resets
        self.last_s, self.velocity_s = np.full((2, size), self.began_s)
        self.stopped, self.left = np.zeros(size, bool), np.full(size, self.rules.resets)
        # shortcut if all variants fuse unless their gate rejects the sample
        self.all_fuse = (self.action == FUSE).all(axis=1) & ~self.reset & ~(self.rejected > 0.0)

    def decide(
        self, e: int, outside: BoolArray, is_velocity_fused: BoolArray
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Return for each variant: rejected, fused, reset, and velocity fused.

        ``outside``: position innovation outside the gate. ``is_velocity_fused``: velocity
        innovation inside its gate.
        """
        rules, now_s, action = self.rules, self.time_s[e], self.action[e]
        gated, follows_log = self.gated, self.as_logged
        fusing, is_decision_logged = action == FUSE, math.isfinite(self.rejected[e])
        self.velocity_s = np.where(is_velocity_fused, now_s, self.velocity_s)
        if self.all_fuse[e] and not (outside.any() or self.stopped.any()):
            self.last_s = now_s
            return outside, fusing, outside, is_velocity_fused
        is_rejected = (
            np.where(follows_log & is_decision_logged, self.rejected[e] > 0.0, outside)
            & gated
            & fusing
        )
        is_fused = fusing & ~is_rejected & ~self.stopped
        is_starting = gated & ((action == START) | (self.stopped & self.startable[e]))
        gap_s = now_s - self.last_s
        is_failing = is_rejected & ~self.stopped & (gap_s > rules.reset_s)
        if rules.with_velocity:
            both = now_s - self.velocity_s > rules.reset_s
            is_failing &= both | (gap_s > 2.0 * rules.reset_s)
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
    """Return the variance growth of biases and fields per step, and its upper limit."""
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
    """Return the stretch with correlations of the initial state; the log has variances only.

    Without correlations the first samples would divide the error between tilt and accelerometer
    bias differently than EKF2. They are estimated from the flight before the stretch, or else from
    its first seconds.
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
        # EKF2 has just reset heading and fields, which makes them uncorrelated with all other
        # states
        correlation = block_diag(correlation[:STATES, :STATES], np.eye(len(stretch.state) - STATES))
        correlation[HEADING], correlation[:, HEADING] = 0.0, 0.0
        correlation[HEADING, HEADING] = 1.0
    return replace(stretch, correlation=correlation)


def _correlation(P: Array) -> Array:
    # a bias that EKF2 does not estimate has no variance
    deviation = np.sqrt(np.maximum(np.diagonal(P), MIN_VARIANCE))
    return np.asarray(P / deviation[:, None] / deviation)


def _settled_correlation(stretch: Stretch) -> Array:
    """Return the correlations of a state after a long time of velocity fusion.

    Errors of tilt and accelerometer bias become correlated, because their effects on the
    acceleration cancel: θ × f = Rb.
    """
    to_earth = np.eye(STATES)
    to_earth[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = stretch.rotation[0]
    P = np.diag(np.diagonal(to_earth @ np.diag(stretch.variance) @ to_earth.T))
    for tilt, bias, effect in ((1, BIAS_NORTH, -GRAVITY), (0, BIAS_EAST, GRAVITY)):
        P[tilt, bias] = P[bias, tilt] = min(P[tilt, tilt] * effect**2, P[bias, bias]) / effect
    return _correlation(to_earth.T @ P @ to_earth)


def _diagonal(P: Array) -> Array:
    """Return the variances as a view, not a copy."""
    return P.reshape(len(P), -1)[:, :: P.shape[1] + 1]


def _start_state(stretch: Stretch, biases: BoolArray, attitude: BoolArray) -> tuple[Array, Array]:
    """Return initial state and covariance, without the states that a variant does not estimate."""
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
    """Return the measurement noise that reduces a variance to a target: 1/target - 1/variance.

    Height and heading sensors are logged at a reduced rate. EKF2's published values are fused
    instead, with a noise that reproduces the logged variances.
    """
    surplus = variance - target
    noise = np.full(surplus.shape, IGNORED_VARIANCE)
    np.divide(variance * target, surplus, out=noise, where=surplus > 0.0)
    return noise


def _limit_bias(P: Array, floor: float, biases: BoolArray) -> None:
    """Limit the bias variance as PX4 up to v1.14 (fixCovarianceErrors)."""
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
    """Return measured velocity and position and their variances, both of shape (E, S, 6)."""
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
        # velocity of the antenna relative to the IMU during rotation
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
