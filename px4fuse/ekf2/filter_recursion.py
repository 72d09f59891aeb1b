"""Recursion of the EKF2 model: several filter configurations run through one flight segment.

The segment is divided into intervals. At the end of an interval (an "event"), the filter fuses a
position or, in a gap of the position source, only height and heading.

Symbols: x, P: state and covariance; R: measurement noise; S: innovation variance.

Sources: PX4-Autopilot ``EKF/covariance.cpp`` (limits of the biases), ``EKF/position_fusion.cpp``
and ``EKF/vel_pos_fusion.cpp`` (gate, fusion), ``ev_pos_control.cpp`` (noise, resets).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from px4fuse.core.arrays import Array, Array32, ArrayPair, BoolArray, IntArray
from px4fuse.ekf2.bad_acceleration import BadAccelerationFlag
from px4fuse.ekf2.heights import (
    GNSS_HEIGHT_NOISE_FACTOR,
    HEIGHT_SENSORS,
    MIN_INNOVATION_GATE,
    MIN_NOISE_SIGMA,
    HeightFilter,
    group_barometer_by_event,
)
from px4fuse.ekf2.inputs import FusionRules, ReplayInputs
from px4fuse.ekf2.intervals import (
    FUSE,
    NO_ACTION,
    START_FUSION,
    EventIntervals,
    FusionDelays,
    StepEvents,
    make_intervals,
)
from px4fuse.ekf2.magnetometer import (
    MIN_MAGNETOMETER_SIGMA_GAUSS,
    EventSamples,
    average_by_event,
    fuse_mean,
)
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    BIASES,
    EARTH_FIELD,
    GRAVITY_M_S2,
    GYRO_BIAS,
    IMU_STATE_COUNT,
    STATE_COUNT,
    THETA,
    VELOCITY,
    ReplaySegment,
)
from px4fuse.ekf2.vision import VisionFilter, group_vision_by_event, set_states
from px4fuse.flight.ekf2_parameters import EV_POS, FLOW, GNSS_POS, GNSS_VEL, MAG

# Minimum state variance, to avoid a division by zero
MIN_STATE_VARIANCE = 1e-30
# Number of events whose transition matrices are copied at once, to limit the memory
EVENT_BATCH_SIZE = 64
# Measurement variance (m² or rad²) so large that the measurement has no effect
VARIANCE_WITHOUT_EFFECT = 1e9
# Acceleration noise (m/s²) while EKF2 reports a bad or clipped acceleration (BADACC_BIAS_PNOISE,
# common.h; covariance.cpp)
BAD_ACCELERATION_NOISE_M_S2 = 4.9
# EKF2 parameters with these prefixes do not change the vertical innovations
HEIGHT_NEUTRAL_PREFIXES = (
    "EKF2_EV",
    "EKF2_MAG",
    "EKF2_OF",
    "EKF2_TAU",
    "EKF2_GPS_P_GATE",
    "EKF2_GPS_DELAY",
)
# Initial σ (m/s²) of the accelerometer bias: small, because EKF2 estimated the bias on the ground
INITIAL_BIAS_SIGMA_M_S2 = 0.01
# Factors on the GNSS velocity variance, NED: EKF2 multiplies the vertical σ by 1.5
# (gps_control.cpp)
VELOCITY_VARIANCE_FACTORS = np.array([1.0, 1.0, 2.25])
GRAVITY_MAGNITUDE_M_S2 = float(GRAVITY_M_S2[2])
# Maximum σ (m/s²) of EKF2's accelerometer bias: 0.1 g (covariance.cpp)
MAX_BIAS_SIGMA_M_S2 = 0.1 * GRAVITY_MAGNITUDE_M_S2
# Minimum accelerometer bias variance of an axis / largest variance of the three axes
# (covariance.cpp)
MIN_BIAS_VARIANCE_RATIO = 0.01
# State indices of heading error and position
HEADING, POSITION_NORTH, POSITION_EAST, POSITION_DOWN = 2, 6, 7, 8
# State indices of the accelerometer bias, rotated to NED
ACCELEROMETER_BIAS_NORTH, ACCELEROMETER_BIAS_EAST, ACCELEROMETER_BIAS_DOWN = 12, 13, 14
# State indices of the measurements that are fused together, in this order
JOINTLY_MEASURED_STATES = np.array([HEADING, POSITION_DOWN, POSITION_NORTH, POSITION_EAST])
# State indices of heading error and height (a slice, which does not copy the states)
HEADING_AND_DOWN = slice(HEADING, POSITION_DOWN + 1, POSITION_DOWN - HEADING)
HORIZONTAL_POSITION = slice(POSITION_NORTH, POSITION_EAST + 1)
# State indices of velocity and position, which a GNSS sample measures
MEASURED_STATES = slice(3, 9)
# Columns of velocity, vertical velocity and horizontal position within MEASURED_STATES
VELOCITY_COLUMNS, DOWN_COLUMN = slice(0, 3), 2
POSITION_COLUMNS = slice(3, 5)


@dataclass(frozen=True)
class FilterConfiguration:
    """Configuration of the EKF2 model: parameters, estimated states and fused aiding sources.

    Attributes
    ----------
    settings : dict
        Values of all EKF2 parameters in the model, by PX4 name.
    estimates_biases : bool
        True if the accelerometer bias is a state.
    estimates_attitude : bool
        True if attitude and gyro bias are states; False to use the published attitude.
    fuses_velocity : bool
        False to ignore the velocity of the position source.
    uses_reported_noise : bool
        False to ignore the variance that the position source reports.
    has_gate : bool
        False to fuse every sample.
    uses_logged_decisions : bool
        True to use EKF2's logged rejections and resets instead of the gate.
    without : mapping from PX4's name of an aiding source to float
        Time (s) from which the source is not fused.
    timestamp_offset_s : float or None
        Time (s) to add to the timestamps of positions instead of EKF2's delay parameter.
    """

    settings: dict[str, float]
    estimates_biases: bool = True
    estimates_attitude: bool = True
    fuses_velocity: bool = True
    uses_reported_noise: bool = True
    has_gate: bool = True
    uses_logged_decisions: bool = False
    without: Mapping[str, float] = field(default_factory=dict)
    timestamp_offset_s: float | None = None

    def keeps_logged_bad_acceleration(self, inputs: ReplayInputs) -> bool:
        """Return True if EKF2's logged bad-acceleration flag is valid for the configuration."""
        has_same_height_parameters = not self.without and all(
            value == inputs.settings[name] or name.startswith(HEIGHT_NEUTRAL_PREFIXES)
            for name, value in self.settings.items()
        )
        return self.uses_logged_decisions or has_same_height_parameters

    def compute_delays(self, inputs: ReplayInputs) -> FusionDelays:
        """Return the delay of the position source, and the delay of the fusion horizon."""
        if self.timestamp_offset_s is not None:
            return FusionDelays(-self.timestamp_offset_s - 0.5 * inputs.mean_step_s, np.inf)
        delay_s = self.settings[inputs.aid.delay] * 1e-3
        max_delay_ms = max(self.settings.get(aid.delay, 0.0) for aid in (GNSS_POS, EV_POS))
        if inputs.rules.uses_delay_as_horizon:  # IMU buffer length = largest delay parameter
            buffer_length = math.ceil(max_delay_ms * 1e-3 / inputs.configured_step_s)
            return FusionDelays(
                delay_s, max(inputs.horizon_s, (buffer_length - 1) * inputs.mean_step_s)
            )
        # EKF2 raises EKF2_DELAY_MAX to the largest delay parameter (EKF2.cpp), so a larger delay
        # also delays the fusion horizon
        longest_delay_ms = max(self.settings["EKF2_DELAY_MAX"], max_delay_ms)
        if longest_delay_ms == inputs.settings["EKF2_DELAY_MAX"]:
            return FusionDelays(delay_s, inputs.horizon_s)
        # Number of samples in the IMU buffer (initialise_interface, estimator_interface.cpp)
        buffer_length = max(math.ceil(longest_delay_ms * 1e-3 / inputs.configured_step_s), 2)
        return FusionDelays(delay_s, (buffer_length - 1) * inputs.mean_step_s)


@dataclass(frozen=True)
class SegmentRun:
    """Results of several filter configurations in one flight segment.

    Attributes
    ----------
    events : tuple of recarray
        Events of each configuration, see :data:`~px4fuse.ekf2.intervals.EVENT_DTYPE`.
    innovation, innovation_variance, noise : ndarray, shape (events, filters, 6)
        ν (measurement minus state), S and R of velocity (m/s) and position (m), NED.
    rejected, fused, reset : ndarray of bool, shape (events, filters)
        True if the position sample of each event was rejected, fused, or used for a reset.
    position_reset_m : ndarray, shape (events, filters, 2)
        Change of the position by resets, north and east.
    state, variance : ndarray, shape (events + 1, filters, states)
        State and its variance at the start and after each event.
    covariance : ndarray, shape (filters, states, states)
        Covariance at the end.
    magnetometer_updates : ndarray, shape (events, 3, filters, 3)
        Innovation (gauss, body FRD), its variance, and 1 if fused.
    height_filter : HeightFilter or None
        None if the logged EKF2 height is used.
    vision_filter : VisionFilter or None
        Vision fusion in addition to GNSS.
    """

    segment: ReplaySegment
    configurations: tuple[FilterConfiguration, ...]
    events: tuple[StepEvents, ...]
    innovation: Array
    innovation_variance: Array32
    noise: Array32
    rejected: BoolArray
    fused: BoolArray
    reset: BoolArray
    position_reset_m: Array
    state: Array
    variance: Array32
    covariance: Array
    magnetometer_updates: Array
    height_filter: HeightFilter | None = None
    vision_filter: VisionFilter | None = None


def run_segment(  # noqa: PLR0912, PLR0915 (one recursion, read from top to bottom)
    inputs: ReplayInputs,
    segment: ReplaySegment,
    configurations: Sequence[FilterConfiguration],
    intervals: Sequence[EventIntervals],
) -> SegmentRun:
    """Run several filter configurations through one flight segment.

    ``intervals`` contains, for each configuration, the intervals between events.
    """
    configuration_count = len(configurations)
    event_count = len(intervals[0].events)
    parameters = {
        name: np.array([configuration.settings[name] for configuration in configurations])
        for name in configurations[0].settings
    }
    # Changes in flight apply where the configuration has the logged value
    for name, value in segment.changed_parameters.items():
        is_unchanged = parameters[name] == inputs.settings[name]
        parameters[name] = np.where(is_unchanged, value, parameters[name])
    (
        has_biases,
        has_attitude,
        has_gate,
        uses_logged_decisions,
        uses_reported_noise,
        fuses_velocity,
    ) = np.array(
        [
            (
                configuration.estimates_biases,
                configuration.estimates_attitude,
                configuration.has_gate,
                configuration.uses_logged_decisions,
                configuration.uses_reported_noise,
                configuration.fuses_velocity,
            )
            for configuration in configurations
        ]
    ).T
    distinct_intervals = list(dict.fromkeys(intervals))
    interval_index_by_filter = (
        list(map(distinct_intervals.index, intervals))
        if len(distinct_intervals) > 1
        else slice(None)
    )

    def stack_configurations(interval_set_arrays: Sequence[Any]) -> Any:
        return np.stack(interval_set_arrays, axis=1)[:, interval_index_by_filter]

    event_table = stack_configurations(
        [interval_arrays.events for interval_arrays in distinct_intervals]
    )
    action = np.where(has_gate, event_table["action"], FUSE * event_table["usable"])
    event_steps = event_table["end_step"]
    is_active = action > NO_ACTION
    event_time_s = segment.time_s[event_steps]
    has_sample = np.any(is_active, axis=1).tolist()
    is_enabled_by_aid = {
        aid.name: event_time_s
        < np.array(
            [configuration.without.get(aid.name, np.inf) for configuration in configurations]
        )
        for aid in (inputs.aid, GNSS_VEL, MAG, FLOW, EV_POS, *HEIGHT_SENSORS)
    }
    can_fuse_velocity = (action == FUSE) & is_enabled_by_aid[GNSS_VEL.name] & fuses_velocity
    sample_indices = np.maximum(intervals[0].events.sample, 0)
    measured_values, measurement_variance = _collect_measurements(
        inputs, segment, sample_indices, event_steps, parameters, uses_reported_noise
    )
    has_velocity = inputs.received.velocity_m_s is not None
    gates = [
        parameters.get(GNSS_VEL.gate, np.ones(configuration_count)),
        parameters[inputs.aid.gate],
    ]
    gate_squared = (
        np.maximum(np.repeat(np.stack(gates, axis=1), 3, axis=1), MIN_INNOVATION_GATE) ** 2
    )
    # EKF2's logged height and heading replace height sensors and magnetometer if the replay does
    # not contain them
    logged_heading_and_down = np.stack(
        [segment.attitude_error_rad[event_steps, HEADING], segment.down_m[event_steps]], axis=-1
    )
    attitude_variance = segment.attitude_variance_rad2[event_steps]
    heading_and_down_variance = np.stack(
        [attitude_variance[:, :, HEADING], segment.down_variance_m2[event_steps]], axis=-1
    )
    height_filter = vision_filter = None
    has_magnetometer = segment.field is not None
    event_step_arrays = [interval_arrays.events.end_step for interval_arrays in distinct_intervals]
    sensor_means = []
    for aid, samples in ((MAG, segment.field), (FLOW, segment.flow)):
        if samples is not None:
            sample_means_by_interval = [
                average_by_event(segment, samples, end_steps) for end_steps in event_step_arrays
            ]
            event_means = EventSamples(
                *map(stack_configurations, zip(*sample_means_by_interval, strict=True))
            )
            if aid == MAG:
                R = np.maximum(parameters[MAG.noise], MIN_MAGNETOMETER_SIGMA_GAUSS) ** 2
                event_means = event_means._replace(noise=event_means.noise + R)
            sample_count = event_means.sample_count * is_enabled_by_aid[aid.name]
            gate = parameters.get(aid.gate, np.full(configuration_count, samples.gate))
            event_means = event_means._replace(sample_count=sample_count)
            sensor_means.append((event_means, gate, samples.state_rows))
    uses_logged_flag = [
        segment.height_samples is None
        or segment.is_acceleration_bad is None
        or configuration.keeps_logged_bad_acceleration(inputs)
        for configuration in configurations
    ]
    bad_acceleration_flag = BadAccelerationFlag(
        np.array(uses_logged_flag), inputs.rules.bad_acceleration_duration_s, segment
    )
    if segment.height_samples is not None:
        barometer_by_event = np.stack(group_barometer_by_event(segment, event_step_arrays), axis=-1)
        height_filter = HeightFilter(
            segment,
            barometer_by_event[..., interval_index_by_filter],
            event_table["time_s"],
            is_active,
            is_enabled_by_aid,
            parameters,
            has_gate,
            bad_acceleration_flag,
        )
    if inputs.vision is not None:
        grouped_vision_samples = [
            group_vision_by_event(
                inputs,
                segment,
                interval_arrays.events.end_step,
                configuration.settings,
                configuration.compute_delays(inputs).horizon_s,
            )
            for interval_arrays, configuration in zip(intervals, configurations, strict=True)
        ]
        vision_filter = VisionFilter(
            segment,
            grouped_vision_samples,
            is_enabled_by_aid,
            parameters,
            has_gate,
            uses_reported_noise,
        )
    gyro_variance = np.where(has_attitude, parameters["EKF2_GYR_NOISE"] ** 2, 0.0)[:, None, None]
    variance_increment, variance_limit = _compute_variance_growth(
        inputs, segment, parameters, has_biases, has_attitude
    )
    step_counts = np.diff(event_steps, axis=0, prepend=0)[:, :, None]
    acceleration_variance = np.tile(
        parameters["EKF2_ACC_NOISE"][:, None, None] ** 2, (event_count, 1, 1, 1)
    )
    if (clipped_fraction := segment.clipped_fraction) is not None:
        # In prediction steps with clipping, EKF2 uses BAD_ACCELERATION_NOISE_M_S2. The variance is
        # the mean over the steps of an interval
        clipped_fraction_sums = np.diff(
            np.cumsum(clipped_fraction)[event_steps], axis=0, prepend=clipped_fraction[0]
        )
        acceleration_variance += (
            clipped_fraction_sums[:, :, None, None]
            / np.maximum(step_counts, 1)[..., None]
            * (BAD_ACCELERATION_NOISE_M_S2**2 - acceleration_variance)
        )
    x, P = _make_start_state(segment, has_biases, has_attitude)
    if bad_acceleration_flag.until_s[0] > segment.time_s[0]:
        # The log contains no accelerometer bias while the bad-acceleration flag is set. The replay
        # starts with the segment's mean bias, computed from the change of the published velocity
        set_states(
            x,
            P,
            ~bad_acceleration_flag.uses_logged_flag & has_biases,
            slice(ACCELEROMETER_BIAS_DOWN, ACCELEROMETER_BIAS_DOWN + 1),
            np.full((configuration_count, 1), segment.mean_bias_down_m_s2),
            np.full((configuration_count, 1), INITIAL_BIAS_SIGMA_M_S2**2),
        )
    is_aid_enabled = is_enabled_by_aid[inputs.aid.name]
    decisions = _FusionDecisions(
        inputs.rules,
        segment.time_s[0],
        np.where(is_aid_enabled, action, NO_ACTION),
        event_table["can_start"] & is_aid_enabled,
        event_time_s,
        has_gate,
        uses_logged_decisions,
        inputs.received.rejected[sample_indices],
        inputs.received.reset[sample_indices],
        inputs.received.has_all_resets,
    )
    innovations = np.full((event_count, configuration_count, 6), np.nan)
    variances = innovations.astype(np.float32)
    magnetometer_updates = np.full(
        (event_count * has_magnetometer, 3, configuration_count, 3), np.nan
    )
    is_rejected, is_fused, is_reset = np.zeros((3, event_count, configuration_count), bool)
    position_reset_m = np.zeros((event_count, configuration_count, 2))
    states = np.empty((event_count + 1, configuration_count, x.shape[1]))
    state_variances = np.empty(states.shape, np.float32)
    states[0] = x
    state_variances[0] = _get_state_variances(P)
    innovation, R = np.empty((2, configuration_count, 4))
    measured_columns = slice(0 if has_velocity else POSITION_COLUMNS.start, POSITION_COLUMNS.stop)
    is_component_fused = np.zeros((configuration_count, POSITION_COLUMNS.stop), bool)
    start_s = np.full(configuration_count, segment.time_s[0])
    state_resets = [(HORIZONTAL_POSITION, POSITION_COLUMNS, inputs.rules.reset_variance_factor)]
    if has_velocity and inputs.rules.resets_velocity:
        state_resets.append((VELOCITY, VELOCITY_COLUMNS, 1.0))
    for event in range(event_count):
        batch_index = event % EVENT_BATCH_SIZE
        if not batch_index:
            event_batch = slice(event, event + EVENT_BATCH_SIZE)
            transition_batches = [
                interval_arrays.compute_transitions(event_batch)
                for interval_arrays in distinct_intervals
            ]
            (transition, correction_input, acceleration_input, gyro_noise, accelerometer_noise) = (
                map(stack_configurations, zip(*transition_batches, strict=True))
            )
            state_input = acceleration_input + has_attitude[:, None] * correction_input
            process_noise = (
                gyro_variance * gyro_noise
                + acceleration_variance[event_batch] * accelerometer_noise
            )
            variance_growth = variance_increment * step_counts[event_batch]
        phi = transition[batch_index]
        # x = Φx + u, P = ΦPΦ' + Q
        x[:, :STATE_COUNT] = (phi @ x[:, :STATE_COUNT, None])[:, :, 0] + state_input[batch_index]
        P[:, :STATE_COUNT] = phi @ P[:, :STATE_COUNT]
        P[:, :, :STATE_COUNT] = P[:, :, :STATE_COUNT] @ np.swapaxes(phi, 1, 2)
        P[:, :IMU_STATE_COUNT, :IMU_STATE_COUNT] += process_noise[batch_index]
        is_bias_constant = None
        flagged_fraction = bad_acceleration_flag.compute_flagged_fraction(
            event_time_s[event - 1] if event else start_s, event_time_s[event]
        )
        if flagged_fraction is not None:
            variance_increase = flagged_fraction * (
                BAD_ACCELERATION_NOISE_M_S2**2 - acceleration_variance[event, :, 0, 0]
            )
            P[:, :IMU_STATE_COUNT, :IMU_STATE_COUNT] += (
                variance_increase[:, None, None] * accelerometer_noise[batch_index]
            )
            is_bias_constant = bad_acceleration_flag.until_s > event_time_s[event]
            bias_before_fusion = x[:, ACCELEROMETER_BIAS].copy()
            bias_covariance = P[:, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS].copy()
        bias_variance = _get_state_variances(P)[:, BIASES.start :]
        bias_variance += (bias_variance < variance_limit) * variance_growth[batch_index]
        if inputs.rules.min_bias_variance_m2_s4 is not None:
            _limit_bias_variance(P, inputs.rules.min_bias_variance_m2_s4, has_biases)
        innovation[:, 2:] = 0.0
        R[:, 2:] = VARIANCE_WITHOUT_EFFECT
        for event_means, gate, state_rows in sensor_means:
            if event_means.sample_count[event].any():
                event_mean = EventSamples(*(quantity[event] for quantity in event_means))
                x, P, innovation_record = fuse_mean(x, P, event_mean, gate, *state_rows)
                if EARTH_FIELD in state_rows:
                    magnetometer_updates[event] = innovation_record
        if vision_filter is not None:
            x, P = vision_filter.fuse(event, x, P, False, decisions.last_position_s)
        if height_filter is not None:
            x, P = height_filter.fuse_barometer(event, x, P)
        if has_sample[event]:
            nu = measured_values[event] - x[:, MEASURED_STATES]
            S = _get_state_variances(P)[:, MEASURED_STATES] + measurement_variance[event]
            is_outside_gate = nu * nu > gate_squared * S
            if is_outside_gate[:, DOWN_COLUMN].any():
                # With a bad vertical acceleration, EKF2 clips the vertical innovation to the gate
                # if the horizontal velocity is inside the gate
                is_clipped = has_gate & (bad_acceleration_flag.until_s > event_time_s[event])
                is_clipped &= ~is_outside_gate[:, :DOWN_COLUMN].any(axis=1)
                innovation_limit = np.sqrt(gate_squared * S)[is_clipped, DOWN_COLUMN]
                nu[is_clipped, DOWN_COLUMN] = np.clip(
                    nu[is_clipped, DOWN_COLUMN], -innovation_limit, innovation_limit
                )
                is_outside_gate[:, DOWN_COLUMN] &= ~is_clipped
            innovations[event] = nu
            variances[event] = S
            is_velocity_fused = can_fuse_velocity[event] & ~(
                is_outside_gate[:, VELOCITY_COLUMNS].any(axis=1) & has_gate
            )
            is_outside_gate = is_outside_gate[:, POSITION_COLUMNS].any(axis=1)
            is_rejected[event], is_fused[event], is_reset[event], is_velocity_fused = (
                decisions.decide_fusion(event, is_outside_gate, is_velocity_fused)
            )
            if inputs.aid == GNSS_POS:
                if not has_magnetometer:
                    # Without logged magnetometer samples, the correction of the tilt is unknown.
                    # Only the tilt variance is set to its logged value
                    for tilt_row in range(HEADING):
                        _, P = _reduce_variance_to(
                            P, tilt_row, attitude_variance[event, :, tilt_row]
                        )
                is_component_fused[:, VELOCITY_COLUMNS] = is_velocity_fused[:, None]
                is_component_fused[:, POSITION_COLUMNS] = is_fused[event, :, None]
                x, P = _update_sequentially(
                    x,
                    P,
                    nu,
                    S,
                    measurement_variance[event],
                    measured_columns,
                    is_component_fused[:, measured_columns],
                )
            else:
                innovation[:, 2:] = nu[:, POSITION_COLUMNS]
                R[is_fused[event], 2:] = measurement_variance[
                    event, is_fused[event], POSITION_COLUMNS
                ]
        if height_filter is not None:
            x, P = height_filter.fuse_gnss(
                event, x, P, measured_values[event, :, 5], measurement_variance[event, :, 5]
            )
        # With a magnetometer, heading is estimated, so only height is set to its logged value
        elif has_magnetometer:
            K, P = _reduce_variance_to(P, POSITION_DOWN, heading_and_down_variance[event, :, 1])
            x = x + K * (logged_heading_and_down[event, :, 1] - x[:, POSITION_DOWN])[:, None]
            x[:, POSITION_DOWN] = logged_heading_and_down[event, :, 1]
        if not has_magnetometer:
            np.subtract(
                logged_heading_and_down[event], x[:, HEADING_AND_DOWN], out=innovation[:, :2]
            )
            R[:, :2] = _compute_noise_for_variance(
                _get_state_variances(P)[:, HEADING_AND_DOWN], heading_and_down_variance[event]
            )
            heading_error_rad = np.where(has_attitude, x[:, HEADING] + innovation[:, 0], 0.0)
            if inputs.fuses_vision_height or height_filter is not None:
                R[:, 1] = VARIANCE_WITHOUT_EFFECT
                if has_sample[event] and height_filter is None:
                    innovation[:, 1] = nu[:, 5]
                    R[:, 1] = np.where(
                        is_active[event], measurement_variance[event, :, 5], VARIANCE_WITHOUT_EFFECT
                    )
            x, P = _update_jointly(x, P, innovation, R)
            x[:, HEADING] = heading_error_rad
        if has_sample[event] and is_reset[event].any():
            for rows, columns, variance_factor in state_resets:
                reset_variance = variance_factor * measurement_variance[event, :, columns]
                set_states(
                    x, P, is_reset[event], rows, measured_values[event, :, columns], reset_variance
                )
            position_reset_m[event, is_reset[event]] = nu[is_reset[event], POSITION_COLUMNS]
        if vision_filter is not None:
            vision_filter.bias.bias_m = vision_filter.bias.bias_m + position_reset_m[event]
            x, P = vision_filter.fuse(event, x, P, True, decisions.last_position_s)
            # A fusion of vision also postpones the position reset after a time without GNSS fusion
            if inputs.rules.resets_velocity:
                decisions.last_position_s = np.maximum(
                    decisions.last_position_s, vision_filter.last_fusion_s
                )
        if height_filter is not None and bad_acceleration_flag.models_flag:
            if has_sample[event] and has_velocity:
                height_filter.update_records[event, -1, 0] = np.where(
                    can_fuse_velocity[event], nu[:, DOWN_COLUMN], np.nan
                )
                height_filter.update_records[event, -1, 1] = S[:, DOWN_COLUMN]
            height_filter.update_bad_acceleration(event, event_time_s[event])
        if is_bias_constant is not None:
            x[is_bias_constant, ACCELEROMETER_BIAS] = bias_before_fusion[is_bias_constant]
            P[is_bias_constant, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = bias_covariance[
                is_bias_constant
            ]
        states[event + 1] = x
        state_variances[event + 1] = _get_state_variances(P)
    innovations[~is_active] = np.nan
    variances[~is_active] = np.nan
    return SegmentRun(
        segment,
        tuple(configurations),
        tuple(interval_arrays.events for interval_arrays in intervals),
        innovations,
        variances,
        measurement_variance.astype(np.float32),
        is_rejected,
        is_fused,
        is_reset,
        position_reset_m
        if vision_filter is None
        else position_reset_m + vision_filter.position_reset_m,
        states,
        state_variances,
        P,
        magnetometer_updates,
        height_filter,
        vision_filter,
    )


def _update_jointly(x: Array, P: Array, innovation: Array, R: Array) -> ArrayPair:
    """Fuse all measurements together: K = PH'(HPH' + R)⁻¹, x = x + Kν, P = P - KHP."""
    HP = np.take(P, JOINTLY_MEASURED_STATES, axis=1)
    S = np.take(HP, JOINTLY_MEASURED_STATES, axis=2)
    S.reshape(len(x), -1)[:, :: len(JOINTLY_MEASURED_STATES) + 1] += R
    K = np.swapaxes(HP, 1, 2) @ np.linalg.inv(S)
    x = x + (K @ innovation[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + np.swapaxes(P, 1, 2))


def _reduce_variance_to(P: Array, state_index: int, target_variance: Array) -> ArrayPair:
    """Return gain and covariance of an update that reduces a state's variance to a target."""
    state_variance = P[:, state_index, state_index]
    R = _compute_noise_for_variance(state_variance, target_variance)
    K = P[:, :, state_index] / (state_variance + R)[:, None]
    return K, P - K[:, :, None] * P[:, None, state_index]


def _update_sequentially(
    x: Array, P: Array, nu: Array, S: Array, R: Array, components: slice, is_fused: BoolArray
) -> ArrayPair:
    """Fuse the components of a measurement one after the other, as EKF2 does; return x and P.

    Innovations and innovation variances S of all components are computed before the first update
    (fuseDirectStateMeasurement, ``ekf_helper.cpp``). With w = 1/S, c = PH' and K = wc, the Joseph
    form is P - KHP - (KHP)' + K(HPH' + R)K' = P - bcc', b = w(2 - w(HPH' + R)).
    """
    nu, S, R = (array[:, components] for array in (nu, S, R))
    inverse_variance = is_fused / S
    weight_squared = inverse_variance * inverse_variance
    b = 2.0 * inverse_variance - weight_squared * R
    rows = slice(MEASURED_STATES.start + components.start, MEASURED_STATES.start + components.stop)
    columns = P[:, rows].copy()
    for j in range(nu.shape[1]):
        column = columns[:, j : j + 1]
        cross_covariance = columns[:, j, rows]
        b[:, j] -= weight_squared[:, j] * cross_covariance[:, j]
        if j + 1 < nu.shape[1]:
            factor = b[:, j, None] * cross_covariance[:, j + 1 :]
            columns[:, j + 1 :] -= factor[:, :, None] * column
    x = x + ((inverse_variance * nu)[:, None] @ columns)[:, 0]
    covariance_reduction_sqrt = np.sqrt(b)[:, :, None] * columns
    return x, P - np.swapaxes(covariance_reduction_sqrt, 1, 2) @ covariance_reduction_sqrt


@dataclass
class _FusionDecisions:
    """Decisions on each position sample: rejected, fused, or used to reset the position.

    After a time without fusion, the position is reset. After several successive resets, fusion
    stops until EKF2 may start it with a sample (``can_start``). ``logged_rejections`` and
    ``logged_resets`` are EKF2's logged decisions.

    Source: updateEvPosFusion, startEvPosFusion (``ev_pos_control.cpp``).
    """

    rules: FusionRules
    start_s: float
    action: IntArray
    can_start: BoolArray
    time_s: Array
    has_gate: BoolArray
    uses_logged_decisions: BoolArray
    logged_rejections: Array
    logged_resets: BoolArray
    has_all_resets: bool

    def __post_init__(self) -> None:
        configuration_count = len(self.has_gate)

        self.last_position_s, self.last_velocity_s = np.full((2, configuration_count), self.start_s)
        self.is_stopped = np.zeros(configuration_count, bool)
        self.remaining_resets = np.full(configuration_count, self.rules.max_resets)
        # True for events without a logged reset, start or rejection
        self.only_gate_decides = (
            (self.action == FUSE).all(axis=1)
            & ~self.logged_resets
            & ~(self.logged_rejections > 0.0)
        )

    def decide_fusion(
        self, event: int, is_outside_gate: BoolArray, is_velocity_fused: BoolArray
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Decide if filters reject the sample of an event, fuse it, or reset the position to it.

        Return four masks: position rejected, position fused, position reset, velocity fused.
        ``is_velocity_fused``: velocity inside its gate; it is not fused with a position reset.
        """
        fusion_rules = self.rules
        now_s = self.time_s[event]
        action = self.action[event]
        has_gate = self.has_gate
        uses_logged_decisions = self.uses_logged_decisions
        may_fuse = action == FUSE
        is_decision_logged = math.isfinite(self.logged_rejections[event])
        self.last_velocity_s = np.where(is_velocity_fused, now_s, self.last_velocity_s)
        if self.only_gate_decides[event] and not (is_outside_gate.any() or self.is_stopped.any()):
            self.last_position_s = now_s
            return is_outside_gate, may_fuse, is_outside_gate, is_velocity_fused
        is_rejected = (
            np.where(
                uses_logged_decisions & is_decision_logged,
                self.logged_rejections[event] > 0.0,
                is_outside_gate,
            )
            & has_gate
            & may_fuse
        )
        time_since_fusion_s = now_s - self.last_position_s
        if self.has_all_resets and not is_decision_logged:
            # EKF2 resets its position after reset_timeout_s without fusion. If it logs no reset at
            # the next event, which is after the timeout, it has fused this sample
            next_event = min(event + 1, len(self.time_s) - 1)
            is_last_before_timeout = (
                self.time_s[next_event] - self.last_position_s > fusion_rules.reset_timeout_s
            )
            is_rejected &= ~(
                uses_logged_decisions & is_last_before_timeout & ~self.logged_resets[next_event]
            )
        is_fused = may_fuse & ~is_rejected & ~self.is_stopped
        is_starting = has_gate & (
            (action == START_FUSION) | (self.is_stopped & self.can_start[event])
        )
        is_failing = (
            is_rejected & ~self.is_stopped & (time_since_fusion_s > fusion_rules.reset_timeout_s)
        )
        if fusion_rules.resets_velocity:
            is_velocity_timed_out = now_s - self.last_velocity_s > fusion_rules.reset_timeout_s
            is_failing &= is_velocity_timed_out | (
                time_since_fusion_s > 2.0 * fusion_rules.reset_timeout_s
            )
        is_restarted = is_starting | (is_failing & (self.remaining_resets > 0))
        if is_decision_logged or self.logged_resets[event] or self.has_all_resets:
            is_restart_logged = has_gate & (self.logged_resets[event] | (action == START_FUSION))
            is_restarted = np.where(uses_logged_decisions, is_restart_logged, is_restarted)
            is_fused &= ~is_restarted
            is_failing &= ~uses_logged_decisions
        self.last_position_s = np.where(is_fused | is_restarted, now_s, self.last_position_s)
        self.last_velocity_s = np.where(is_restarted, now_s, self.last_velocity_s)
        self.is_stopped = (self.is_stopped & ~is_starting) | (
            is_failing & (self.remaining_resets == 0)
        )
        remaining_resets = self.remaining_resets - (is_failing & (self.remaining_resets > 0))
        self.remaining_resets = np.where(is_starting, fusion_rules.max_resets, remaining_resets)
        return is_rejected, is_fused, is_restarted, is_velocity_fused & ~is_restarted


def _compute_variance_growth(
    inputs: ReplayInputs,
    segment: ReplaySegment,
    parameters: dict[str, Array],
    has_biases: BoolArray,
    has_attitude: BoolArray,
) -> ArrayPair:
    """Return process noise per prediction step, and maximum variance, of biases and fields.

    EKF2 adds no process noise to a state with a larger variance.
    """
    limit_name_by_noise_name = {"GYR_B": "GYR", "ACC_B": "ACC"}
    if segment.field is not None:
        limit_name_by_noise_name |= {"MAG_E": "MAG", "MAG_B": "MAG"}
    noise_density, variance_limit = (
        np.stack([parameters[f"EKF2_{name}_NOISE"] for name in parameter_names], axis=-1)
        for parameter_names in (limit_name_by_noise_name, limit_name_by_noise_name.values())
    )
    noise_density[:, :2] *= np.stack([has_attitude, has_biases], axis=-1)
    return np.repeat((noise_density * inputs.mean_step_s) ** 2, 3, axis=-1), np.repeat(
        variance_limit**2, 3, axis=-1
    )


def estimate_state_correlation(inputs: ReplayInputs, segment: ReplaySegment) -> ReplaySegment:
    """Estimate the correlations of the initial state of a segment by a replay of the time before.

    The log contains only the variances. Without correlations, the first updates would distribute
    corrections wrongly between tilt and accelerometer bias.
    """
    state_correlation = _compute_settled_correlation(segment)
    if preceding_segment := segment.preceding_segment:
        inputs = replace(inputs, vision=None)
        configuration = FilterConfiguration(inputs.settings)
        preceding_segment = replace(
            preceding_segment, state_correlation=_compute_settled_correlation(preceding_segment)
        )
        intervals = make_intervals(inputs, preceding_segment, configuration.compute_delays(inputs))
        state_correlation = _compute_correlation(
            run_segment(inputs, preceding_segment, [configuration], [intervals]).covariance[0]
        )
    if segment.field is not None:
        # EKF2 has just reset heading and magnetic fields, so they are uncorrelated with all states
        state_correlation = block_diag(
            state_correlation[:STATE_COUNT, :STATE_COUNT], np.eye(len(segment.state) - STATE_COUNT)
        )
        state_correlation[HEADING] = 0.0
        state_correlation[:, HEADING] = 0.0
        state_correlation[HEADING, HEADING] = 1.0
    return replace(segment, state_correlation=state_correlation)


def _compute_correlation(P: Array) -> Array:
    # The lower limit prevents a division by zero: a bias that is not estimated has variance 0
    sigma = np.sqrt(np.maximum(np.diagonal(P), MIN_STATE_VARIANCE))
    return np.asarray(P / sigma[:, None] / sigma)


def _compute_settled_correlation(segment: ReplaySegment) -> Array:
    """Return the steady-state correlation matrix of the states; tilt and bias are correlated.

    After long fusion of velocity, the acceleration errors of tilt error θ and accelerometer bias b
    cancel each other: θ × f = R b, with specific force f and rotation R from body to NED.
    """
    state_rotation_to_ned = np.eye(STATE_COUNT)
    state_rotation_to_ned[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = segment.body_to_ned[0]
    P = np.diag(
        np.diagonal(
            state_rotation_to_ned
            @ np.diag(segment.variance[:STATE_COUNT])
            @ state_rotation_to_ned.T
        )
    )
    for tilt_state, bias_state, acceleration_per_rad in (
        (1, ACCELEROMETER_BIAS_NORTH, -GRAVITY_MAGNITUDE_M_S2),
        (0, ACCELEROMETER_BIAS_EAST, GRAVITY_MAGNITUDE_M_S2),
    ):
        P[tilt_state, bias_state] = P[bias_state, tilt_state] = (
            min(P[tilt_state, tilt_state] * acceleration_per_rad**2, P[bias_state, bias_state])
            / acceleration_per_rad
        )
    return _compute_correlation(state_rotation_to_ned.T @ P @ state_rotation_to_ned)


def _get_state_variances(P: Array) -> Array:
    """Return the state variances of all filter configurations, as a view of P."""
    return P.reshape(len(P), -1)[:, :: P.shape[1] + 1]


def _make_start_state(
    segment: ReplaySegment, has_biases: BoolArray, has_attitude: BoolArray
) -> ArrayPair:
    x = np.tile(segment.state, (len(has_biases), 1))
    sigma = np.sqrt(segment.variance)
    P = np.tile(sigma[:, None] * segment.state_correlation * sigma, (len(has_biases), 1, 1))
    for rows, is_estimated in (
        (THETA, has_attitude),
        (GYRO_BIAS, has_attitude),
        (ACCELEROMETER_BIAS, has_biases),
    ):
        set_states(x, P, ~is_estimated, rows, *np.zeros((2, len(x), 3)))
    x[~has_biases, ACCELEROMETER_BIAS] = -segment.accelerometer_bias_m_s2
    return x, P


def _compute_noise_for_variance(variance: Array, target_variance: Array) -> Array:
    """Return R for an update from ``variance`` to ``target_variance``: 1/R = 1/target - 1/variance.

    With this R, updates with EKF2's published height and heading give the logged variances.
    """
    excess_variance = variance - target_variance
    noise_variance = np.full(excess_variance.shape, VARIANCE_WITHOUT_EFFECT)
    np.divide(
        variance * target_variance, excess_variance, out=noise_variance, where=excess_variance > 0.0
    )
    return noise_variance


def _limit_bias_variance(P: Array, lower_limit_m2_s4: float, has_biases: BoolArray) -> None:
    """Limit the accelerometer bias variance like PX4 up to v1.14 (fixCovarianceErrors)."""
    bias_variance = _get_state_variances(P)[:, ACCELEROMETER_BIAS]
    min_variance = np.maximum(
        MIN_BIAS_VARIANCE_RATIO * bias_variance.max(axis=1, keepdims=True), lower_limit_m2_s4
    )
    bias_variance[has_biases] = np.clip(bias_variance, min_variance, MAX_BIAS_SIGMA_M_S2**2)[
        has_biases
    ]


def _collect_measurements(
    inputs: ReplayInputs,
    segment: ReplaySegment,
    sample_indices: IntArray,
    event_steps: IntArray,
    parameters: dict[str, Array],
    uses_reported_noise: BoolArray,
) -> ArrayPair:
    """Return measurements and variances, shape (events, filters, 6): velocity, position (NED)."""
    received_positions = inputs.received
    aid = inputs.aid
    sensor_offset_m = (
        np.stack([parameters[name] for name in aid.lever_arm], -1) - inputs.imu_offset_m
    )[:, :, None]
    measured_values, measurement_variance = np.full(
        (2, len(event_steps), len(sensor_offset_m), 6), np.nan
    )
    lever_arm_ned_m = (segment.body_to_ned[event_steps] @ sensor_offset_m)[..., 0]
    measured_values[..., 3:] = (
        received_positions.position_m[sample_indices][:, None] - lever_arm_ned_m
    )
    if aid.noise_mode_parameter:
        uses_reported_noise = uses_reported_noise & (parameters[aid.noise_mode_parameter] != 1.0)
    reported_variance = np.where(
        uses_reported_noise[:, None], received_positions.variance_m2[sample_indices][:, None], 0.0
    )
    measurement_variance[..., 3:] = np.maximum(
        reported_variance, np.maximum(parameters[aid.noise], MIN_NOISE_SIGMA)[:, None] ** 2
    )
    if (
        received_positions.velocity_m_s is not None
        and received_positions.velocity_variance_m2_s2 is not None
    ):
        # Velocity of the antenna relative to the IMU while the vehicle rotates
        rotation_matrix_rate_per_s = (
            np.diff(segment.body_to_ned, axis=0)[event_steps - 1]
            / segment.step_s[event_steps - 1, None, None]
        )
        lever_arm_velocity_m_s = (rotation_matrix_rate_per_s @ sensor_offset_m)[..., 0]
        measured_values[..., :3] = (
            received_positions.velocity_m_s[sample_indices][:, None] - lever_arm_velocity_m_s
        )
        reported_variance = received_positions.velocity_variance_m2_s2[sample_indices][:, None]
        min_variance = np.maximum(parameters[GNSS_VEL.noise], MIN_NOISE_SIGMA)[:, None] ** 2
        measurement_variance[..., :3] = (
            np.maximum(reported_variance, min_variance) * VELOCITY_VARIANCE_FACTORS
        )
    if aid == GNSS_POS:
        measurement_variance[..., 5] = np.maximum(
            measurement_variance[..., 5], (GNSS_HEIGHT_NOISE_FACTOR * parameters[aid.noise]) ** 2
        )
    return measured_values, measurement_variance
