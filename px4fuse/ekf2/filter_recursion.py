"""Main loop of the EKF2 model: prediction and fusion in one part of a flight.

Several filter configurations are computed at once. Each event fuses a position. In a gap of the
position source, an event fuses only height and heading.

Symbols: x, P: state and covariance; R: measurement noise; S: innovation variance.

Sources: PX4-Autopilot ``EKF/covariance.cpp`` (limits of the biases), ``EKF/position_fusion.cpp``
and ``EKF/vel_pos_fusion.cpp`` (gate, fusion), ``ev_pos_control.cpp`` (noise, resets).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from px4fuse.core.arrays import Array, Array32, ArrayPair, BoolArray, IntArray
from px4fuse.ekf2.heights import (
    GNSS_HEIGHT_NOISE_FACTOR,
    MIN_INNOVATION_GATE,
    MIN_MEASUREMENT_NOISE_SIGMA,
    BadAccelerationFlag,
    HeightFilter,
)
from px4fuse.ekf2.inputs import FusionRules, ReplayInputs
from px4fuse.ekf2.intervals import (
    FUSE,
    NO_ACTION,
    START_FUSION,
    EventIntervals,
    FusionDelays,
    StepEvents,
    make_event_intervals,
)
from px4fuse.ekf2.magnetometer import (
    MIN_MAGNETOMETER_SIGMA_GAUSS,
    EventSamples,
    average_by_event,
    fuse_mean_sample,
)
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    BIASES,
    EARTH_MAGNETIC_FIELD,
    GRAVITY_M_S2,
    GYRO_BIAS,
    MOTION_STATE_COUNT,
    STATE_COUNT,
    THETA,
    VELOCITY,
    ReplaySegment,
)
from px4fuse.ekf2.vision import VisionFilter, group_vision_by_event, set_states
from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, FLOW, GNSS_POS, GNSS_VEL, MAG

# Minimum state variance; prevents a division by zero
MIN_STATE_VARIANCE = 1e-30
# Number of events whose transition matrices are copied at once; limits the memory
EVENT_BATCH_SIZE = 64
# Measurement variance (m² or rad²) so large that the measurement has no effect
VARIANCE_WITHOUT_EFFECT = 1e9
# Acceleration noise (m/s²) while EKF2 reports a bad or clipped acceleration (BADACC_BIAS_PNOISE,
# common.h; covariance.cpp)
BAD_ACCELERATION_NOISE_M_S2 = 4.9
# EKF2 parameters with these prefixes do not change the vertical innovations
PARAMETER_PREFIXES_WITHOUT_HEIGHT_EFFECT = (
    "EKF2_EV",
    "EKF2_MAG",
    "EKF2_OF",
    "EKF2_TAU",
    "EKF2_GPS_P_GATE",
    "EKF2_GPS_DELAY",
)
# Initial σ (m/s²) of the accelerometer bias, which EKF2 has estimated on the ground
INITIAL_BIAS_SIGMA_M_S2 = 0.01
# Factors on the GNSS velocity variance (NED): EKF2 multiplies the vertical σ by 1.5
# (gps_control.cpp)
GNSS_VELOCITY_VARIANCE_FACTORS = np.array([1.0, 1.0, 2.25])
GRAVITY_MAGNITUDE_M_S2 = float(GRAVITY_M_S2[2])
# Maximum σ (m/s²) of EKF2's accelerometer bias: 0.1 g (covariance.cpp)
MAX_BIAS_SIGMA_M_S2 = 0.1 * GRAVITY_MAGNITUDE_M_S2
# Minimum variance of an accelerometer bias ÷ largest bias variance of the three axes
# (covariance.cpp)
MIN_RATIO_TO_LARGEST_BIAS_VARIANCE = 0.01
# State indices of heading error and position
HEADING, POSITION_NORTH, POSITION_EAST, POSITION_DOWN = 2, 6, 7, 8
# State indices of the accelerometer bias
ACCELEROMETER_BIAS_NORTH, ACCELEROMETER_BIAS_EAST, ACCELEROMETER_BIAS_DOWN = 12, 13, 14
# States that are measured in one joint update, in the order of the measurements
STATES_FUSED_IN_ONE_UPDATE = np.array([HEADING, POSITION_DOWN, POSITION_NORTH, POSITION_EAST])
# State indices of heading error and height, as a slice to avoid copies
HEADING_AND_DOWN = slice(HEADING, POSITION_DOWN + 1, POSITION_DOWN - HEADING)
HORIZONTAL_POSITION = slice(POSITION_NORTH, POSITION_EAST + 1)
# State indices of velocity and position
VELOCITY_AND_POSITION = slice(3, 9)
# Columns in measurements of velocity (0 to 2) and position (3 to 5), NED
VELOCITY_COLUMNS, VELOCITY_DOWN_COLUMN = slice(0, 3), 2
HORIZONTAL_POSITION_COLUMNS = slice(3, 5)
# First column of velocity, of horizontal position and of height in the same measurements
FIRST_COLUMNS = [0, 3, 5]


@dataclass(frozen=True)
class FilterConfiguration:
    """Configuration of the EKF2 model: parameters, estimated states and fused sources.

    Attributes
    ----------
    settings : dict
        Values of all EKF2 parameters, by PX4 name.
    estimates_biases : bool
        True if the accelerometer bias is a state.
    estimates_attitude : bool
        True if attitude and gyro bias are states.
    fuses_velocity : bool
        False to ignore the velocity of the position source.
    uses_reported_noise : bool
        False to ignore the variance that the position source reports.
    has_gate : bool
        False to fuse every sample.
    uses_logged_decisions : bool
        True to use EKF2's logged rejections and resets.
    disable_time_s_by_aid : mapping from PX4's name of an aiding source to float
        Time (s) from which the source is not fused.
    timestamp_offset_s : float or None
        Time that is added to position timestamps, instead of EKF2's delay parameter.
    """

    settings: dict[str, float]
    estimates_biases: bool = True
    estimates_attitude: bool = True
    fuses_velocity: bool = True
    uses_reported_noise: bool = True
    has_gate: bool = True
    uses_logged_decisions: bool = False
    disable_time_s_by_aid: Mapping[str, float] = field(default_factory=dict)
    timestamp_offset_s: float | None = None

    def can_use_logged_bad_acceleration_flag(self, inputs: ReplayInputs) -> bool:
        """Return True if EKF2's logged bad-acceleration flag is valid for this configuration.

        The flag depends on the height parameters.
        """
        has_logged_height_parameters = not self.disable_time_s_by_aid and all(
            value == inputs.settings[name]
            or name.startswith(PARAMETER_PREFIXES_WITHOUT_HEIGHT_EFFECT)
            for name, value in self.settings.items()
        )
        return self.uses_logged_decisions or has_logged_height_parameters

    def compute_delays(self, inputs: ReplayInputs) -> FusionDelays:
        """Return the delay of the position source, and the delay of the fusion horizon."""
        if self.timestamp_offset_s is not None:
            return FusionDelays(-self.timestamp_offset_s - 0.5 * inputs.mean_step_s, np.inf)
        delay_s = self.settings[inputs.aid.delay] * 1e-3
        max_delay_ms = max(self.settings.get(aid.delay, 0.0) for aid in (GNSS_POS, EV_POS))
        min_horizon_s = inputs.horizon_s
        if not inputs.rules.is_horizon_set_by_largest_delay:
            # EKF2 raises EKF2_DELAY_MAX to the largest delay parameter (EKF2.cpp)
            max_delay_ms = max(max_delay_ms, self.settings["EKF2_DELAY_MAX"])
            if max_delay_ms == inputs.settings["EKF2_DELAY_MAX"]:
                return FusionDelays(delay_s, inputs.horizon_s)
            min_horizon_s = inputs.mean_step_s
        # Number of samples in the IMU buffer (initialise_interface, estimator_interface.cpp)
        buffer_length = math.ceil(max_delay_ms * 1e-3 / inputs.configured_step_s)
        return FusionDelays(delay_s, max((buffer_length - 1) * inputs.mean_step_s, min_horizon_s))


@dataclass(frozen=True)
class SegmentRun:
    """Results of several filter configurations in one part of a flight.

    Attributes
    ----------
    events : tuple of recarray
        Fusions of each configuration, see :data:`~px4fuse.ekf2.intervals.EVENT_DTYPE`.
    innovation, innovation_variance, noise : ndarray, shape (events, filters, 6)
        ν (measurement minus state), S and R of velocity (m/s) and position (m), NED.
    rejected, fused, reset : ndarray of bool, shape (events, filters)
        True if the position was rejected, fused, or used for a reset.
    position_reset_m : ndarray, shape (events, filters, 2)
        Change of the position by resets, north and east.
    state, variance : ndarray, shape (events + 1, filters, states)
        State and its variance at the start and after each event.
    covariance : ndarray, shape (filters, states, states)
        Covariance at the end.
    magnetometer_updates : ndarray, shape (events, 3, filters, 3)
        Innovation (gauss, body FRD), its variance, and 1 if fused.
    height_filter : HeightFilter or None
        Height fusion; None if EKF2's logged height is used.
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
    """Run several filter configurations through one part of a flight.

    ``intervals`` contains the intervals between fusions, one item per configuration.
    """
    configuration_count = len(configurations)
    event_count = len(intervals[0].events)
    parameters = {
        name: np.array([configuration.settings[name] for configuration in configurations])
        for name in inputs.settings
    }
    # A parameter change in flight applies only to configurations with the logged parameter value
    for name in segment.changed_parameters.keys() & parameters.keys():
        value = segment.changed_parameters[name]
        parameters[name][parameters[name] == inputs.settings[name]] = value
    (
        estimates_biases,
        estimates_attitude,
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
    # The arrays of events have the shape (events, configurations, ...)
    events = np.stack([interval_arrays.events for interval_arrays in intervals], axis=1)
    event_steps = events["end_step"]
    event_time_s = segment.time_s[event_steps]
    action = np.where(has_gate, events["action"], FUSE * events["usable"])
    has_action = action > NO_ACTION
    has_sample = np.any(has_action, axis=1).tolist()
    is_enabled_by_aid = {
        name: event_time_s
        < np.array([one.disable_time_s_by_aid.get(name, np.inf) for one in configurations])
        for name in AIDS
    }
    can_fuse_velocity = (action == FUSE) & is_enabled_by_aid[GNSS_VEL.name] & fuses_velocity
    sample_indices = np.maximum(intervals[0].events.sample, 0)
    measured_values, measurement_variance = _collect_measurements(
        inputs, segment, sample_indices, event_steps, parameters, uses_reported_noise
    )
    has_velocity = inputs.received_positions.velocity_m_s is not None
    position_gate = parameters[inputs.aid.gate]
    gates = parameters.get(GNSS_VEL.gate, position_gate), position_gate
    gate_squared = np.maximum(np.repeat(gates, 3, axis=0).T, MIN_INNOVATION_GATE) ** 2
    # Logged height and heading, for replays without height sensor or magnetometer
    logged_heading_and_down = np.stack(
        [segment.attitude_error_rad[event_steps, HEADING], segment.down_m[event_steps]], axis=-1
    )
    attitude_variance = segment.attitude_variance_rad2[event_steps]
    heading_and_down_variance = np.stack(
        [attitude_variance[:, :, HEADING], segment.down_variance_m2[event_steps]], axis=-1
    )
    has_magnetometer = segment.magnetic_field is not None
    sensor_means = []
    for aid, samples in ((MAG, segment.magnetic_field), (FLOW, segment.flow)):
        if samples is not None:
            mean_samples = EventSamples(
                *_stack_by_filter(
                    [average_by_event(segment, samples, end_steps) for end_steps in event_steps.T]
                )
            )
            mean_samples.sample_count[:] *= is_enabled_by_aid[aid.name]
            if aid == MAG:
                R = np.maximum(parameters[MAG.noise], MIN_MAGNETOMETER_SIGMA_GAUSS) ** 2
                mean_samples.noise[:] = R
            gate = parameters.get(aid.gate, np.full(configuration_count, samples.gate))
            sensor_means.append((mean_samples, gate, samples.state_slices))
    uses_logged_flag = np.array(
        [
            segment.height_samples is None
            or segment.is_acceleration_bad is None
            or configuration.can_use_logged_bad_acceleration_flag(inputs)
            for configuration in configurations
        ]
    )
    bad_acceleration_flag = BadAccelerationFlag(
        uses_logged_flag, inputs.rules.bad_acceleration_flag_duration_s, segment
    )
    height_filter = vision_filter = None
    if segment.height_samples is not None:
        height_filter = HeightFilter(
            segment,
            event_steps,
            events["time_s"],
            has_action,
            is_enabled_by_aid,
            parameters,
            has_gate,
            bad_acceleration_flag,
        )
    if inputs.vision_positions is not None:
        vision_samples = [
            group_vision_by_event(
                inputs,
                segment,
                end_steps,
                configuration.settings,
                configuration.compute_delays(inputs).horizon_s,
            )
            for end_steps, configuration in zip(event_steps.T, configurations, strict=True)
        ]
        vision_filter = VisionFilter(
            segment, vision_samples, is_enabled_by_aid, parameters, has_gate, uses_reported_noise
        )
    gyro_variance = (estimates_attitude * parameters["EKF2_GYR_NOISE"] ** 2)[:, None, None]
    variance_growth_per_step, max_variance_with_process_noise = _compute_variance_growth(
        inputs, segment, parameters, estimates_biases, estimates_attitude
    )
    step_counts = np.diff(event_steps, axis=0, prepend=0)
    acceleration_variance = np.tile(parameters["EKF2_ACC_NOISE"] ** 2, (event_count, 1))
    if (clipped_fraction := segment.clipped_fraction) is not None:
        # While an accelerometer clips, EKF2 uses BAD_ACCELERATION_NOISE_M_S2
        clipped_fraction_sum_by_event = np.diff(
            np.cumsum(clipped_fraction)[event_steps], axis=0, prepend=clipped_fraction[0]
        )
        acceleration_variance += (
            clipped_fraction_sum_by_event
            / np.maximum(step_counts, 1)
            * (BAD_ACCELERATION_NOISE_M_S2**2 - acceleration_variance)
        )
    x, P = _make_start_state(segment, estimates_biases, estimates_attitude)
    if bad_acceleration_flag.until_s[0] > segment.time_s[0]:
        # While EKF2 flags a bad acceleration, the log contains no accelerometer bias. Start with
        # the mean vertical bias of the segment
        set_states(
            x,
            P,
            ~uses_logged_flag & estimates_biases,
            slice(ACCELEROMETER_BIAS_DOWN, ACCELEROMETER_BIAS_DOWN + 1),
            np.full((configuration_count, 1), segment.mean_bias_down_m_s2),
            np.full((configuration_count, 1), INITIAL_BIAS_SIGMA_M_S2**2),
        )
    is_aid_enabled = is_enabled_by_aid[inputs.aid.name]
    fusion_decisions = _FusionDecisions(
        inputs.rules,
        segment.time_s[0],
        np.where(is_aid_enabled, action, NO_ACTION),
        events["can_start_fusion"] & is_aid_enabled,
        event_time_s,
        has_gate,
        uses_logged_decisions,
        inputs.received_positions.rejected_flags[sample_indices],
        inputs.received_positions.is_reset_to_sample[sample_indices],
        inputs.received_positions.is_every_reset_logged,
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
    is_component_fused = np.zeros((configuration_count, HORIZONTAL_POSITION_COLUMNS.stop), bool)
    start_s = np.full(configuration_count, segment.time_s[0])
    reset_rules = [
        (HORIZONTAL_POSITION, HORIZONTAL_POSITION_COLUMNS, inputs.rules.reset_variance_factor)
    ]
    if has_velocity and inputs.rules.resets_velocity:
        reset_rules.append((VELOCITY, VELOCITY_COLUMNS, 1.0))
    for event in range(event_count):
        index_in_batch = event % EVENT_BATCH_SIZE
        if not index_in_batch:
            event_batch = slice(event, event + EVENT_BATCH_SIZE)
            transitions = {one: one.compute_transitions(event_batch) for one in set(intervals)}
            (
                transition,
                state_change_by_attitude_correction,
                state_change_by_acceleration,
                gyro_noise_covariance,
                accelerometer_noise_covariance,
            ) = _stack_by_filter([transitions[one] for one in intervals])
            state_change = (
                state_change_by_acceleration
                + estimates_attitude[:, None] * state_change_by_attitude_correction
            )
            process_noise = (
                gyro_variance * gyro_noise_covariance
                + acceleration_variance[event_batch, :, None, None] * accelerometer_noise_covariance
            )
        phi = transition[index_in_batch]
        bad_acceleration_fraction = bad_acceleration_flag.compute_bad_acceleration_fraction(
            event_time_s[event - 1] if event else start_s, event_time_s[event]
        )
        # Prediction: x = Φx + u, P = ΦPΦ' + Q
        x[:, :STATE_COUNT] = (phi @ x[:, :STATE_COUNT, None])[:, :, 0]
        x[:, :STATE_COUNT] += state_change[index_in_batch]
        P[:, :STATE_COUNT] = phi @ P[:, :STATE_COUNT]
        P[:, :, :STATE_COUNT] = P[:, :, :STATE_COUNT] @ np.swapaxes(phi, 1, 2)
        motion_covariance = P[:, :MOTION_STATE_COUNT, :MOTION_STATE_COUNT]
        motion_covariance += process_noise[index_in_batch]
        if bad_acceleration_fraction.any():
            variance_increase = bad_acceleration_fraction * (
                BAD_ACCELERATION_NOISE_M_S2**2 - acceleration_variance[event]
            )
            motion_covariance += (
                variance_increase[:, None, None] * accelerometer_noise_covariance[index_in_batch]
            )
        is_bias_constant = bad_acceleration_flag.until_s > event_time_s[event]
        bias_before_fusion = x[:, ACCELEROMETER_BIAS].copy()
        bias_covariance = P[:, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS].copy()
        bias_variance = _get_state_variances(P)[:, BIASES.start :]
        bias_variance += (bias_variance < max_variance_with_process_noise) * (
            variance_growth_per_step * step_counts[event, :, None]
        )
        if min_bias_variance := inputs.rules.min_accelerometer_bias_variance_m2_s4:
            _limit_bias_variance(P, min_bias_variance, estimates_biases)
        innovation[:, 2:] = 0.0
        R[:, 2:] = VARIANCE_WITHOUT_EFFECT
        for mean_samples, gate, state_slices in sensor_means:
            if mean_samples.sample_count[event].any():
                mean_sample = EventSamples(*(quantity[event] for quantity in mean_samples))
                x, P, update = fuse_mean_sample(x, P, mean_sample, gate, *state_slices)
                if EARTH_MAGNETIC_FIELD in state_slices:
                    magnetometer_updates[event] = update
        if vision_filter is not None:
            x, P = vision_filter.fuse(event, x, P, False, fusion_decisions.last_position_s)
        if height_filter is not None:
            x, P = height_filter.fuse_barometer(event, x, P)
        if has_sample[event]:
            nu = measured_values[event] - x[:, VELOCITY_AND_POSITION]
            S = _get_state_variances(P)[:, VELOCITY_AND_POSITION] + measurement_variance[event]
            is_outside_gate = nu * nu > gate_squared * S
            if is_outside_gate[:, VELOCITY_DOWN_COLUMN].any():
                # With a bad vertical acceleration, EKF2 clips the vertical innovation to the gate
                is_clipped = has_gate & (bad_acceleration_flag.until_s > event_time_s[event])
                is_clipped &= ~is_outside_gate[:, :VELOCITY_DOWN_COLUMN].any(axis=1)
                limit = np.sqrt(gate_squared * S)
                nu[is_clipped, VELOCITY_DOWN_COLUMN] = np.clip(nu, -limit, limit)[
                    is_clipped, VELOCITY_DOWN_COLUMN
                ]
                is_outside_gate[is_clipped, VELOCITY_DOWN_COLUMN] = False
            innovations[event] = nu
            variances[event] = S
            is_velocity_outside, is_position_outside, _ = np.logical_or.reduceat(
                is_outside_gate, FIRST_COLUMNS, axis=1
            ).T
            is_rejected[event], is_fused[event], is_reset[event], is_velocity_fused = (
                fusion_decisions.decide_fusion(
                    event,
                    is_position_outside,
                    can_fuse_velocity[event] & ~(is_velocity_outside & has_gate),
                )
            )
            if inputs.aid == GNSS_POS:
                if not has_magnetometer:
                    # Without a magnetometer, the tilt variance is set to its logged value
                    for tilt_row in range(HEADING):
                        _, P = _update_to_variance(
                            P, tilt_row, attitude_variance[event, :, tilt_row]
                        )
                is_component_fused[:, VELOCITY_COLUMNS] = (is_velocity_fused & has_velocity)[
                    :, None
                ]
                is_component_fused[:, HORIZONTAL_POSITION_COLUMNS] = is_fused[event, :, None]
                x, P = _update_sequentially(
                    x, P, nu, S, measurement_variance[event], is_component_fused
                )
            else:
                innovation[:, 2:] = nu[:, HORIZONTAL_POSITION_COLUMNS]
                R[is_fused[event], 2:] = measurement_variance[
                    event, is_fused[event], HORIZONTAL_POSITION_COLUMNS
                ]
        if height_filter is not None:
            x, P = height_filter.fuse_gnss(
                event, x, P, measured_values[event, :, 5], measurement_variance[event, :, 5]
            )
        # With a magnetometer, the filter estimates the heading, and only the height is set to its
        # logged value
        elif has_magnetometer:
            K, P = _update_to_variance(P, POSITION_DOWN, heading_and_down_variance[event, :, 1])
            x = x + K * (logged_heading_and_down[event, :, 1] - x[:, POSITION_DOWN])[:, None]
            x[:, POSITION_DOWN] = logged_heading_and_down[event, :, 1]
        if not has_magnetometer:
            innovation[:, :2] = logged_heading_and_down[event] - x[:, HEADING_AND_DOWN]
            R[:, :2] = _compute_noise_for_target_variance(
                _get_state_variances(P)[:, HEADING_AND_DOWN], heading_and_down_variance[event]
            )
            heading_error_rad = np.where(estimates_attitude, x[:, HEADING] + innovation[:, 0], 0.0)
            if inputs.fuses_vision_height or height_filter is not None:
                R[:, 1] = VARIANCE_WITHOUT_EFFECT
            if inputs.fuses_vision_height and has_sample[event]:
                innovation[:, 1] = nu[:, 5]
                R[has_action[event], 1] = measurement_variance[event, has_action[event], 5]
            x, P = _update_jointly(x, P, innovation, R)
            x[:, HEADING] = heading_error_rad
        if has_sample[event] and is_reset[event].any():
            for rows, columns, variance_factor in reset_rules:
                reset_variance = variance_factor * measurement_variance[event, :, columns]
                set_states(
                    x, P, is_reset[event], rows, measured_values[event, :, columns], reset_variance
                )
            position_reset_m[event] = is_reset[event, :, None] * nu[:, HORIZONTAL_POSITION_COLUMNS]
        if vision_filter is not None:
            vision_filter.bias.bias_m = vision_filter.bias.bias_m + position_reset_m[event]
            x, P = vision_filter.fuse(event, x, P, True, fusion_decisions.last_position_s)
            # EKF2's timeout for a position reset also starts again when EKF2 fuses vision
            if inputs.rules.resets_velocity:
                fusion_decisions.last_position_s = np.maximum(
                    fusion_decisions.last_position_s, vision_filter.last_fusion_s
                )
        if height_filter is not None and not uses_logged_flag.all():
            if has_sample[event] and has_velocity:
                height_filter.update_records[event, -1, 0] = np.where(
                    can_fuse_velocity[event], nu[:, VELOCITY_DOWN_COLUMN], np.nan
                )
                height_filter.update_records[event, -1, 1] = S[:, VELOCITY_DOWN_COLUMN]
            height_filter.update_bad_acceleration_flag(event, event_time_s[event])
        if is_bias_constant.any():
            x[is_bias_constant, ACCELEROMETER_BIAS] = bias_before_fusion[is_bias_constant]
            P[is_bias_constant, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = bias_covariance[
                is_bias_constant
            ]
        states[event + 1] = x
        state_variances[event + 1] = _get_state_variances(P)
    innovations[~has_action] = np.nan
    variances[~has_action] = np.nan
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


def _stack_by_filter(tuples_by_filter: Sequence[tuple[Array, ...]]) -> list[Array]:
    """Stack the arrays of all filters along axis 1."""
    return [np.stack(arrays, axis=1) for arrays in zip(*tuples_by_filter, strict=True)]


def _update_jointly(x: Array, P: Array, innovation: Array, R: Array) -> ArrayPair:
    """Fuse all measurements together: K = PH'(HPH' + R)⁻¹, x = x + Kν, P = P - KHP."""
    HP = P.take(STATES_FUSED_IN_ONE_UPDATE, axis=1)
    S = HP.take(STATES_FUSED_IN_ONE_UPDATE, axis=2)
    S_diagonal = _get_state_variances(S)
    S_diagonal += R
    K = np.swapaxes(HP, 1, 2) @ np.linalg.inv(S)
    x = x + (K @ innovation[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + np.swapaxes(P, 1, 2))


def _update_to_variance(P: Array, state_index: int, target_variance: Array) -> ArrayPair:
    """Return gain and covariance of an update after which a state has ``target_variance``."""
    state_variance = P[:, state_index, state_index]
    R = _compute_noise_for_target_variance(state_variance, target_variance)
    K = P[:, :, state_index] / (state_variance + R)[:, None]
    return K, P - K[:, :, None] * P[:, None, state_index]


def _update_sequentially(
    x: Array, P: Array, nu: Array, S: Array, R: Array, is_fused: BoolArray
) -> ArrayPair:
    """Fuse velocity and horizontal position, one component after the other; return x and P.

    All innovations ν and variances S are from before the first update (fuseDirectStateMeasurement,
    ``ekf_helper.cpp``). P is updated in Joseph form.
    """
    component_count = is_fused.shape[1]
    # Components that are not fused may be NaN: replace them by 1
    nu, S, R = np.where(is_fused, np.array([nu, S, R])[:, :, :component_count], 1.0)
    fused_inverse_variance = is_fused / S
    inverse_variance_squared = fused_inverse_variance * fused_inverse_variance
    b = 2.0 * fused_inverse_variance - inverse_variance_squared * R
    rows = slice(VELOCITY.start, VELOCITY.start + component_count)
    columns = P[:, rows].copy()
    for j in range(component_count):
        column = columns[:, j : j + 1]
        measurement_covariance = columns[:, j, rows]
        b[:, j] -= inverse_variance_squared[:, j] * measurement_covariance[:, j]
        factor = b[:, j, None] * measurement_covariance[:, j + 1 :]
        columns[:, j + 1 :] -= factor[:, :, None] * column
    x = x + ((fused_inverse_variance * nu)[:, None] @ columns)[:, 0]
    covariance_reduction_factor = np.sqrt(b)[:, :, None] * columns
    return x, P - np.swapaxes(covariance_reduction_factor, 1, 2) @ covariance_reduction_factor


@dataclass
class _FusionDecisions:
    """Decisions on each position sample: reject it, fuse it, or reset the position to it.

    EKF2 resets the position after a time without fusion. After several resets, EKF2 stops fusion.

    Source: updateEvPosFusion, startEvPosFusion (``ev_pos_control.cpp``).
    """

    fusion_rules: FusionRules
    start_s: float
    sample_actions: IntArray
    can_start_fusion: BoolArray
    time_s: Array
    has_gate: BoolArray
    uses_logged_decisions: BoolArray
    logged_rejected_flags: Array
    logged_resets: BoolArray
    is_every_reset_logged: bool

    def __post_init__(self) -> None:
        configuration_count = len(self.has_gate)
        self.last_position_s, self.last_velocity_s = np.full((2, configuration_count), self.start_s)
        self.is_stopped = np.zeros(configuration_count, bool)
        self.remaining_resets = np.full(configuration_count, self.fusion_rules.max_resets)
        # Without a logged start of fusion, reset or rejection, only the gate decides on a sample
        self.only_gate_decides = (
            (self.sample_actions == FUSE).all(axis=1)
            & ~self.logged_resets
            & ~(self.logged_rejected_flags > 0.0)
        )

    def decide_fusion(
        self, event: int, is_outside_gate: BoolArray, is_velocity_fused: BoolArray
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Decide for each filter if a position sample is rejected, fused, or used for a reset.

        Return four masks: position rejected, position fused, position reset, velocity fused.
        """
        fusion_rules, uses_logged_decisions = self.fusion_rules, self.uses_logged_decisions
        now_s, action, is_reset_logged = (
            values[event] for values in (self.time_s, self.sample_actions, self.logged_resets)
        )
        may_fuse = action == FUSE
        is_decision_logged = math.isfinite(self.logged_rejected_flags[event])
        self.last_velocity_s = np.where(is_velocity_fused, now_s, self.last_velocity_s)
        if self.only_gate_decides[event] and not (is_outside_gate.any() or self.is_stopped.any()):
            self.last_position_s = now_s
            return is_outside_gate, may_fuse, is_outside_gate, is_velocity_fused
        is_rejected = np.where(
            uses_logged_decisions & is_decision_logged,
            self.logged_rejected_flags[event] > 0.0,
            is_outside_gate,
        )
        is_rejected &= self.has_gate & may_fuse
        if self.is_every_reset_logged and not is_decision_logged:
            # If EKF2 had rejected this sample, its timeout would end before the next sample and
            # reset the position. Without a logged reset at the next sample, EKF2 has fused this
            # sample
            next_event = min(event + 1, len(self.time_s) - 1)
            is_rejected &= ~(
                uses_logged_decisions
                & (self.time_s[next_event] - self.last_position_s > fusion_rules.reset_timeout_s)
                & ~self.logged_resets[next_event]
            )
        is_fusion_starting = self.has_gate & (
            (action == START_FUSION) | (self.is_stopped & self.can_start_fusion[event])
        )
        time_since_fusion_s = now_s - self.last_position_s
        is_rejection_timed_out = (
            is_rejected & ~self.is_stopped & (time_since_fusion_s > fusion_rules.reset_timeout_s)
        )
        if fusion_rules.resets_velocity:
            is_velocity_timed_out = now_s - self.last_velocity_s > fusion_rules.reset_timeout_s
            is_rejection_timed_out &= is_velocity_timed_out | (
                time_since_fusion_s > 2.0 * fusion_rules.reset_timeout_s
            )
        uses_logged_resets = uses_logged_decisions & (
            is_decision_logged or is_reset_logged or self.is_every_reset_logged
        )
        is_rejection_timed_out &= ~uses_logged_resets
        is_reset_after_timeout = is_rejection_timed_out & (self.remaining_resets > 0)
        is_reset = np.where(
            uses_logged_resets,
            self.has_gate & (is_reset_logged | (action == START_FUSION)),
            is_fusion_starting | is_reset_after_timeout,
        )
        is_fused = may_fuse & ~(is_rejected | self.is_stopped | is_reset)
        self.last_position_s = np.where(is_fused | is_reset, now_s, self.last_position_s)
        self.last_velocity_s = np.where(is_reset, now_s, self.last_velocity_s)
        self.is_stopped = (self.is_stopped & ~is_fusion_starting) | (
            is_rejection_timed_out & ~is_reset_after_timeout
        )
        self.remaining_resets = np.where(
            is_fusion_starting,
            fusion_rules.max_resets,
            self.remaining_resets - is_reset_after_timeout,
        )
        return is_rejected, is_fused, is_reset, is_velocity_fused & ~is_reset


def _compute_variance_growth(
    inputs: ReplayInputs,
    segment: ReplaySegment,
    parameters: dict[str, Array],
    estimates_biases: BoolArray,
    estimates_attitude: BoolArray,
) -> ArrayPair:
    """Return process noise per prediction step, and maximum variance, of biases and fields.

    The states are IMU biases and magnetic fields. EKF2 adds no process noise to a state whose
    variance exceeds the maximum.
    """
    vector_count = 2 if segment.magnetic_field is None else 4
    noise_density, max_sigma_with_process_noise = (
        np.repeat([parameters[f"EKF2_{name}_NOISE"] for name in names[:vector_count]], 3, axis=0).T
        for names in (("GYR_B", "ACC_B", "MAG_E", "MAG_B"), ("GYR", "ACC", "MAG", "MAG"))
    )
    noise_density[:, :3] *= estimates_attitude[:, None]
    noise_density[:, 3:6] *= estimates_biases[:, None]
    return (noise_density * inputs.mean_step_s) ** 2, max_sigma_with_process_noise**2


def estimate_state_correlation(inputs: ReplayInputs, segment: ReplaySegment) -> ReplaySegment:
    """Estimate the correlations of the initial state by a replay of the preceding seconds.

    The log contains only the variances.
    """
    initial_state_correlation = _compute_steady_state_correlation(segment)
    if preceding_segment := segment.preceding_segment:
        inputs = replace(inputs, vision_positions=None)
        configuration = FilterConfiguration(inputs.settings)
        preceding_segment = replace(
            preceding_segment,
            initial_state_correlation=_compute_steady_state_correlation(preceding_segment),
        )
        intervals = make_event_intervals(
            inputs, preceding_segment, configuration.compute_delays(inputs)
        )
        initial_state_correlation = _compute_correlation(
            run_segment(inputs, preceding_segment, [configuration], [intervals]).covariance[0]
        )
    if segment.magnetic_field is not None:
        # EKF2 has just reset heading and magnetic fields, so they are uncorrelated
        initial_state_correlation = block_diag(
            initial_state_correlation[:STATE_COUNT, :STATE_COUNT],
            np.eye(len(segment.state) - STATE_COUNT),
        )
        initial_state_correlation[HEADING] = 0.0
        initial_state_correlation[:, HEADING] = 0.0
        initial_state_correlation[HEADING, HEADING] = 1.0
    return replace(segment, initial_state_correlation=initial_state_correlation)


def _compute_correlation(P: Array) -> Array:
    # The lower limit prevents a division by zero if a bias is not estimated
    sigma = np.sqrt(np.maximum(np.diagonal(P), MIN_STATE_VARIANCE))
    return P / sigma[:, None] / sigma


def _compute_steady_state_correlation(segment: ReplaySegment) -> Array:
    """Return the correlation matrix of the states after EKF2 has fused velocity for a long time.

    Velocity measurements determine only the sum of two acceleration errors: the error due to tilt
    and the error due to accelerometer bias. The two state errors are correlated, so that their
    effects on the acceleration cancel.
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
    """Return the state variances (a view of P)."""
    return P.reshape(len(P), -1)[:, :: P.shape[1] + 1]


def _make_start_state(
    segment: ReplaySegment, estimates_biases: BoolArray, estimates_attitude: BoolArray
) -> ArrayPair:
    x = np.tile(segment.state, (len(estimates_biases), 1))
    sigma = np.sqrt(segment.variance)
    P = np.tile(
        sigma[:, None] * segment.initial_state_correlation * sigma, (len(estimates_biases), 1, 1)
    )
    for rows, is_estimated in (
        (THETA, estimates_attitude),
        (GYRO_BIAS, estimates_attitude),
        (ACCELEROMETER_BIAS, estimates_biases),
    ):
        set_states(x, P, ~is_estimated, rows, *np.zeros((2, len(x), 3)))
    x[~estimates_biases, ACCELEROMETER_BIAS] = -segment.accelerometer_bias_m_s2
    return x, P


def _compute_noise_for_target_variance(variance: Array, target_variance: Array) -> Array:
    """Return the R of an update that changes ``variance`` to ``target_variance``.

    1/R = 1/target_variance - 1/variance.
    """
    excess_variance = variance - target_variance
    required_noise_variance = np.full(excess_variance.shape, VARIANCE_WITHOUT_EFFECT)
    np.divide(
        variance * target_variance,
        excess_variance,
        out=required_noise_variance,
        where=excess_variance > 0.0,
    )
    return required_noise_variance


def _limit_bias_variance(P: Array, lower_limit_m2_s4: float, estimates_biases: BoolArray) -> None:
    """Limit the accelerometer bias variance like PX4 up to v1.14 (fixCovarianceErrors)."""
    accelerometer_bias_variance = _get_state_variances(P)[:, ACCELEROMETER_BIAS]
    min_variance = np.maximum(
        MIN_RATIO_TO_LARGEST_BIAS_VARIANCE * accelerometer_bias_variance.max(axis=1, keepdims=True),
        lower_limit_m2_s4,
    )
    accelerometer_bias_variance[estimates_biases] = np.clip(
        accelerometer_bias_variance, min_variance, MAX_BIAS_SIGMA_M_S2**2
    )[estimates_biases]


def _collect_measurements(
    inputs: ReplayInputs,
    segment: ReplaySegment,
    sample_indices: IntArray,
    event_steps: IntArray,
    parameters: dict[str, Array],
    uses_reported_noise: BoolArray,
) -> ArrayPair:
    """Return measurements and variances, shape (events, filters, 6): velocity, position (NED)."""
    received_positions, aid = inputs.received_positions, inputs.aid
    sensor_offset_m = (
        np.stack([parameters[name] for name in aid.lever_arm], -1) - inputs.imu_offset_m
    )[:, :, None]
    measured_values, measurement_variance = np.full(
        (2, len(event_steps), len(sensor_offset_m), 6), np.nan
    )

    def limit_variance(reported_variance: Array, noise_parameter: str) -> Array:
        min_sigma = np.maximum(parameters[noise_parameter], MIN_MEASUREMENT_NOISE_SIGMA)
        return np.asarray(np.maximum(reported_variance, min_sigma[:, None] ** 2))

    body_to_ned = segment.body_to_ned[event_steps]
    measured_values[..., 3:] = (
        received_positions.position_m[sample_indices][:, None]
        - (body_to_ned @ sensor_offset_m)[..., 0]
    )
    if aid.noise_mode_parameter:
        uses_reported_noise = uses_reported_noise & (parameters[aid.noise_mode_parameter] != 1.0)
    measurement_variance[..., 3:] = limit_variance(
        received_positions.variance_m2[sample_indices][:, None] * uses_reported_noise[:, None],
        aid.noise,
    )
    if (
        received_positions.velocity_m_s is not None
        and received_positions.velocity_variance_m2_s2 is not None
    ):
        # Velocity of the antenna relative to the rotating IMU: dR/dt · lever arm
        rotation_matrix_derivative_per_s = (
            body_to_ned - segment.body_to_ned[event_steps - 1]
        ) / segment.step_s[event_steps - 1, None, None]
        measured_values[..., :3] = (
            received_positions.velocity_m_s[sample_indices][:, None]
            - (rotation_matrix_derivative_per_s @ sensor_offset_m)[..., 0]
        )
        measurement_variance[..., :3] = GNSS_VELOCITY_VARIANCE_FACTORS * limit_variance(
            received_positions.velocity_variance_m2_s2[sample_indices][:, None], GNSS_VEL.noise
        )
    if aid == GNSS_POS:
        measurement_variance[..., 5] = np.maximum(
            measurement_variance[..., 5], (GNSS_HEIGHT_NOISE_FACTOR * parameters[aid.noise]) ** 2
        )
    return measured_values, measurement_variance
