"""Main loop of the EKF2 model: prediction and fusion in one part of a flight.

Several filter configurations are computed at once; in shapes, "filters" is their number. Each
fusion event fuses a position. In a gap of the position source, an event fuses only height and
heading.

Symbols: x, P: state and covariance; ν: innovation; R: measurement noise; S: innovation variance.

Sources: PX4-Autopilot ``EKF/covariance.cpp`` (limits of the biases), ``EKF/position_fusion.cpp``
and ``EKF/vel_pos_fusion.cpp`` (gate, fusion), ``ev_pos_control.cpp`` (noise, resets).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from px4fuse.core.arrays import Array, Array32, ArrayPair, BoolArray, IntArray
from px4fuse.flight.ekf2_parameters import FLOW, GNSS_POS, GNSS_VEL, MAG, Aid

from .filter_batch import FilterBatch, FilterConfiguration
from .height_samples import POSITION_DOWN
from .heights import (
    GNSS_HEIGHT_NOISE_FACTOR,
    MIN_INNOVATION_GATE,
    MIN_MEASUREMENT_NOISE_SIGMA,
    BadAccelerationFlag,
    HeightFilter,
)
from .inputs import ReplayInputs
from .intervals import (
    FUSE,
    NO_ACTION,
    START_FUSION,
    EventIntervals,
    FusionEvents,
    make_event_intervals,
)
from .magnetometer import (
    MIN_MAGNETOMETER_SIGMA_GAUSS,
    EventSamples,
    average_by_event,
    fuse_mean_sample,
)
from .replay_segments import (
    ACCELEROMETER_BIAS,
    BODY_MAGNETIC_FIELD,
    EARTH_MAGNETIC_FIELD,
    GRAVITY_M_S2,
    GYRO_BIAS,
    HORIZONTAL_POSITION,
    MOTION_STATE_COUNT,
    STATE_COUNT,
    THETA,
    VELOCITY,
    ReplaySegment,
    SensorSamples,
)
from .vision import VisionFilter, set_states

# Minimum state variance; prevents a division by zero
MIN_STATE_VARIANCE = 1e-30
# Number of events whose transition matrices are copied at once; limits the memory
EVENT_BATCH_SIZE = 128
# Acceleration noise (m/s²) while EKF2 reports a bad or clipped acceleration (BADACC_BIAS_PNOISE,
# common.h; covariance.cpp)
BAD_ACCELERATION_NOISE_M_S2 = 4.9
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
# State indices of the attitude error
TILT_ABOUT_NORTH, TILT_ABOUT_EAST, HEADING = 0, 1, 2
# State indices of the horizontal position
POSITION_NORTH, POSITION_EAST = 6, 7
# State indices of the accelerometer bias
ACCELEROMETER_BIAS_NORTH, ACCELEROMETER_BIAS_EAST, ACCELEROMETER_BIAS_DOWN = 12, 13, 14
# State indices of velocity and position
VELOCITY_AND_POSITION = slice(3, 9)
# Columns in measurements of velocity (0 to 2) and position (3 to 5), NED
VELOCITY_COLUMNS, VELOCITY_DOWN_COLUMN = slice(0, 3), 2
HORIZONTAL_POSITION_COLUMNS, DOWN_COLUMN = slice(3, 5), 5


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
    events: tuple[FusionEvents, ...]
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


def run_segment(  # noqa: PLR0912 (the order of EKF2's fusions in one place)
    inputs: ReplayInputs,
    segment: ReplaySegment,
    configurations: Sequence[FilterConfiguration],
    intervals: Sequence[EventIntervals],
) -> SegmentRun:
    """Run several filter configurations through one part of a flight.

    The loop runs over the fusion events. A fusion event is a time at which the replay fuses sensor
    samples; each configuration has the same number of events. The loop predicts state x and
    covariance P to the event, and then fuses the samples of the event in the order of EKF2. x and P
    are changed in place (prediction, resets) or replaced (fusions).

    ``intervals`` contains the intervals between successive fusion events, one item per
    configuration.
    """
    batch = FilterBatch(inputs, segment, configurations, intervals)
    bad_acceleration_flag = _make_bad_acceleration_flag(batch)
    prediction = _Prediction(batch, bad_acceleration_flag)
    positions = _PositionFusion(batch, bad_acceleration_flag)
    mean_sensors = [
        (
            aid,
            _average_samples(batch, aid, samples),
            batch.parameters.get(aid.gate, np.full(len(configurations), samples.gate)),
            samples.state_slices,
        )
        for aid, samples in ((MAG, segment.magnetic_field), (FLOW, segment.flow))
        if samples is not None
    ]
    height_filter = vision_filter = None
    if segment.height_samples is not None:
        height_filter = HeightFilter(
            batch,
            positions.has_action,
            positions.measured_values[..., DOWN_COLUMN],
            bad_acceleration_flag,
        )
    if inputs.vision_positions is not None:
        vision_filter = VisionFilter(batch)
    x, P = _make_start_state(batch, bad_acceleration_flag)
    event_count, configuration_count = batch.events.shape
    magnetometer_updates = np.full(
        (event_count if segment.magnetic_field else 0, 3, configuration_count, 3), np.nan
    )
    states = np.empty((event_count + 1, *x.shape))
    state_variances = np.empty(states.shape, np.float32)
    states[0], state_variances[0] = x, _get_state_variances(P)
    for event in range(event_count):
        prediction.predict(event, x, P)
        # EKF2 fuses magnetometer and optical flow first
        for aid, mean_samples, gate, state_slices in mean_sensors:
            if mean_samples.sample_count[event].any():
                mean_sample = EventSamples(*(quantity[event] for quantity in mean_samples))
                x, P, update = fuse_mean_sample(x, P, mean_sample, gate, *state_slices)
                if aid == MAG:
                    magnetometer_updates[event] = update
        # EKF2 fuses the vision samples of earlier prediction steps before the GNSS sample
        if vision_filter is not None:
            x, P = vision_filter.fuse(event, x, P, False, positions.decisions.last_position_s)
        # EKF2 fuses barometer, GNSS velocity and position, and GNSS height in this order
        if height_filter is not None:
            x, P = height_filter.fuse_barometer(event, x, P)
        if positions.has_sample[event]:
            x, P = positions.test_and_fuse_gnss(event, x, P)
        if height_filter is not None:
            gnss_variance_m2 = positions.measurement_variance[event, :, DOWN_COLUMN]
            x, P = height_filter.fuse_gnss(event, x, P, gnss_variance_m2)
        # Vision is fused here if it is the position source. Without measurements of heading or
        # height, the replay uses EKF2's logged values
        x, P = positions.fuse_vision_and_logged_states(event, x, P)
        # Some filters do not fuse the sample, but reset their position to it
        if positions.reset[event].any():
            positions.reset_states(event, x, P)
        # EKF2 fuses the vision samples of the same prediction step after the GNSS sample
        if vision_filter is not None:
            # The vision bias is state minus measurement, so a reset changes it like the state
            vision_filter.bias.bias_m = vision_filter.bias.bias_m + positions.reset_m[event]
            x, P = vision_filter.fuse(event, x, P, True, positions.decisions.last_position_s)
            # EKF2's timeout for a position reset also starts again when EKF2 fuses vision
            if inputs.rules.resets_velocity:
                positions.decisions.last_position_s = np.maximum(
                    positions.decisions.last_position_s, vision_filter.last_fusion_s
                )
        # Large height innovations set the bad-acceleration flag for the next events. While it is
        # set, EKF2 holds the accelerometer bias constant
        if height_filter is not None and not bad_acceleration_flag.uses_logged_flag.all():
            height_filter.update_bad_acceleration_flag(
                event, batch.event_time_s[event], positions.get_velocity_down_update(event)
            )
        prediction.restore_constant_bias(x, P)
        states[event + 1], state_variances[event + 1] = x, _get_state_variances(P)
    positions.innovation[~positions.has_action] = np.nan
    positions.innovation_variance[~positions.has_action] = np.nan
    if vision_filter is not None:
        positions.reset_m += vision_filter.position_reset_m
    return SegmentRun(
        segment=segment,
        configurations=tuple(configurations),
        events=tuple(arrays.events for arrays in intervals),
        innovation=positions.innovation,
        innovation_variance=positions.innovation_variance,
        noise=positions.measurement_variance.astype(np.float32),
        rejected=positions.rejected,
        fused=positions.fused,
        reset=positions.reset,
        position_reset_m=positions.reset_m,
        state=states,
        variance=state_variances,
        covariance=P,
        magnetometer_updates=magnetometer_updates,
        height_filter=height_filter,
        vision_filter=vision_filter,
    )


class _Prediction:
    """Prediction of state and covariance from one fusion event to the next.

    x = Φx + u and P = ΦPΦ' + Q. The vector u is the state change by acceleration and attitude
    correction.
    """

    def __init__(self, batch: FilterBatch, bad_acceleration_flag: BadAccelerationFlag) -> None:
        """Compute acceleration noise and bias noise for all fusion events."""
        self.batch, self.bad_acceleration_flag = batch, bad_acceleration_flag
        self.step_counts = np.diff(batch.event_steps, axis=0, prepend=0)
        self.acceleration_variance = np.tile(
            batch.parameters["EKF2_ACC_NOISE"] ** 2, (len(self.step_counts), 1)
        )
        if (clipped_fraction := batch.segment.clipped_fraction) is not None:
            # While an accelerometer clips, EKF2 uses BAD_ACCELERATION_NOISE_M_S2. The acceleration
            # variance between two events is the mean over the prediction steps between these events
            clipped_fraction_sums = np.cumsum(clipped_fraction)
            previous_event_steps = batch.event_steps - self.step_counts
            mean_clipped_fraction = (
                clipped_fraction_sums[batch.event_steps]
                - clipped_fraction_sums[previous_event_steps]
            ) / np.maximum(self.step_counts, 1)
            self.acceleration_variance += mean_clipped_fraction * (
                BAD_ACCELERATION_NOISE_M_S2**2 - self.acceleration_variance
            )
        self.bias_noise_per_step, self.max_variance_with_noise = _compute_bias_noise(batch)

    def _prepare_transitions(self, events: slice) -> None:
        """Compute Φ, u and Q of the predictions to several fusion events at once."""
        batch = self.batch
        # Configurations with the same intervals share their transitions
        transitions = {
            intervals: intervals.compute_transitions(events) for intervals in set(batch.intervals)
        }
        (
            self.transition,
            state_change_by_attitude_correction,
            state_change_by_acceleration,
            gyro_noise_covariance,
            self.accelerometer_noise_covariance,
        ) = _stack_by_filter([transitions[intervals] for intervals in batch.intervals])
        # A configuration without attitude states uses EKF2's published attitude: it needs no
        # attitude correction, and has no gyro noise
        self.state_change = (
            state_change_by_acceleration
            + batch.estimates_attitude[:, None] * state_change_by_attitude_correction
        )
        gyro_noise_variance = batch.estimates_attitude * batch.parameters["EKF2_GYR_NOISE"] ** 2
        self.process_noise = (
            gyro_noise_variance[:, None, None] * gyro_noise_covariance
            + self.acceleration_variance[events, :, None, None]
            * self.accelerometer_noise_covariance
        )

    def predict(self, event: int, x: Array, P: Array) -> None:
        """Predict x and P from the previous fusion event to this one, in place.

        Call this method in the order of the events.
        """
        batch, flag = self.batch, self.bad_acceleration_flag
        self.bias_at_previous_event = x[:, ACCELEROMETER_BIAS].copy()
        self.bias_covariance_at_previous_event = P[:, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS].copy()
        row = event % EVENT_BATCH_SIZE
        if row == 0:
            self._prepare_transitions(slice(event, event + EVENT_BATCH_SIZE))
        # Φ has the rows of the motion states, which are the first states. The others are constant
        phi = self.transition[row]
        x[:, :MOTION_STATE_COUNT] = (phi @ x[:, :STATE_COUNT, None])[:, :, 0]
        x[:, :MOTION_STATE_COUNT] += self.state_change[row]
        P[:, :MOTION_STATE_COUNT] = phi @ P[:, :STATE_COUNT]
        P[:, :, :MOTION_STATE_COUNT] = P[:, :, :STATE_COUNT] @ np.swapaxes(phi, 1, 2)
        # motion_covariance and variances are views: adding to them changes P
        motion_covariance = P[:, :MOTION_STATE_COUNT, :MOTION_STATE_COUNT]
        motion_covariance += self.process_noise[row]
        end_s = batch.event_time_s[event]
        begin_s = batch.event_time_s[event - 1] if event else batch.segment.time_s[:1]
        flag.apply_logged_flag(end_s)
        bad_acceleration_fraction = flag.compute_bad_acceleration_fraction(begin_s, end_s)
        if bad_acceleration_fraction.any():
            variance_increase = bad_acceleration_fraction * (
                BAD_ACCELERATION_NOISE_M_S2**2 - self.acceleration_variance[event]
            )
            motion_covariance += (
                variance_increase[:, None, None] * self.accelerometer_noise_covariance[row]
            )
        self.is_bias_constant = flag.until_s > end_s
        variances = _get_state_variances(P)
        variances += (variances < self.max_variance_with_noise) * (
            self.bias_noise_per_step * self.step_counts[event, :, None]
        )
        if min_bias_variance := batch.inputs.rules.min_accelerometer_bias_variance_m2_s4:
            _limit_bias_variance(P, min_bias_variance, batch.estimates_biases)

    def restore_constant_bias(self, x: Array, P: Array) -> None:
        """Restore an accelerometer bias that EKF2 holds constant, after the fusions of an event.

        EKF2 holds the bias while it flags a bad acceleration. Prediction and fusions have changed
        bias and bias covariance: both get their values at the previous event again. x and P are
        changed in place.
        """
        selected = self.is_bias_constant
        if selected.any():
            x[selected, ACCELEROMETER_BIAS] = self.bias_at_previous_event[selected]
            P[selected, ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = (
                self.bias_covariance_at_previous_event[selected]
            )


def _compute_bias_noise(batch: FilterBatch) -> ArrayPair:
    """Return process noise per prediction step, and maximum variance, of biases and fields.

    The states are IMU biases and magnetic fields; the process noise of other states is zero. EKF2
    adds no process noise to a state whose variance exceeds the maximum.
    """
    process_noise, max_variance = np.zeros((2, len(batch.configurations), len(batch.segment.state)))
    sensors_and_states = [
        ("GYR_B", "GYR", GYRO_BIAS, batch.estimates_attitude),
        ("ACC_B", "ACC", ACCELEROMETER_BIAS, batch.estimates_biases),
    ]
    if batch.segment.magnetic_field is not None:
        sensors_and_states += [
            ("MAG_E", "MAG", EARTH_MAGNETIC_FIELD, True),
            ("MAG_B", "MAG", BODY_MAGNETIC_FIELD, True),
        ]
    for bias_name, sensor_name, states, is_estimated in sensors_and_states:
        noise_density = is_estimated * batch.parameters[f"EKF2_{bias_name}_NOISE"]
        process_noise[:, states] = (noise_density * batch.inputs.mean_step_s)[:, None] ** 2
        max_variance[:, states] = batch.parameters[f"EKF2_{sensor_name}_NOISE"][:, None] ** 2
    return process_noise, max_variance


class _PositionFusion:
    """Fusion of the position source (velocity and position), and of logged height and heading.

    Attributes
    ----------
    decisions : _FusionDecisions
        State of the decisions on position samples.
    measured_values, measurement_variance, innovation, innovation_variance : ndarray
        z, R, ν and S of velocity and position (NED), shape (events, filters, 6).
    rejected, fused, reset : ndarray of bool, shape (events, filters)
        EKF2's decision on the position.
    reset_m : ndarray, shape (events, filters, 2)
        Change of the position by resets, north and east.
    """

    def __init__(self, batch: FilterBatch, bad_acceleration_flag: BadAccelerationFlag) -> None:
        """Collect the position measurements of all fusion events, and allocate the results."""
        inputs, parameters, events = batch.inputs, batch.parameters, batch.events
        self.has_velocity = inputs.received_positions.velocity_m_s is not None
        self.batch, self.bad_acceleration_flag = batch, bad_acceleration_flag
        # Filters without gate fuse every usable sample
        action = np.where(batch.has_gate, events["action"], FUSE * events["usable"])
        self.has_action = action > NO_ACTION
        self.has_sample = np.any(self.has_action, axis=1).tolist()
        self.can_fuse_velocity = (
            (action == FUSE) & batch.is_enabled_by_aid[GNSS_VEL.name] & batch.fuses_velocity
        )
        # Squared gate of each component, shape (filters, 6): velocity three times, position three
        # times. Without a velocity, its columns are not used
        position_gate = parameters[inputs.aid.gate]
        velocity_gate = parameters.get(GNSS_VEL.gate, position_gate)
        gates = np.column_stack([*[velocity_gate] * 3, *[position_gate] * 3])
        self.gate_squared = np.maximum(gates, MIN_INNOVATION_GATE) ** 2
        self.measured_values, self.measurement_variance = _collect_measurements(batch)
        self.decisions = _FusionDecisions(batch, action)
        self.innovation = np.full((*events.shape, 6), np.nan)
        # float32 saves memory
        self.innovation_variance = self.innovation.astype(np.float32)
        self.rejected, self.fused, self.reset = np.zeros((3, *events.shape), bool)
        self.reset_m = np.zeros((*events.shape, 2))

    def test_and_fuse_gnss(self, event: int, x: Array, P: Array) -> ArrayPair:
        """Test the sample of a fusion event with the gate, and fuse it if it is from GNSS.

        A sample consists of position and, from GNSS, velocity.
        """
        batch, R = self.batch, self.measurement_variance[event]
        # 1. Innovation and gate of each component
        nu = self.measured_values[event] - x[:, VELOCITY_AND_POSITION]
        S = _get_state_variances(P)[:, VELOCITY_AND_POSITION] + R
        is_outside_gate = nu * nu > self.gate_squared * S
        if is_outside_gate[:, VELOCITY_DOWN_COLUMN].any():
            # With a bad vertical acceleration, EKF2 clips the vertical innovation to the gate
            # instead of rejecting the velocity, if the horizontal velocity is inside its gate
            is_horizontal_inside = ~is_outside_gate[:, :VELOCITY_DOWN_COLUMN].any(axis=1)
            is_acceleration_bad = self.bad_acceleration_flag.until_s > batch.event_time_s[event]
            is_clipped = batch.has_gate & is_horizontal_inside & is_acceleration_bad
            limit = np.sqrt(self.gate_squared * S)[:, VELOCITY_DOWN_COLUMN]
            velocity_down_innovation = nu[:, VELOCITY_DOWN_COLUMN]
            np.clip(
                velocity_down_innovation, -limit, limit, velocity_down_innovation, where=is_clipped
            )
            is_outside_gate[is_clipped, VELOCITY_DOWN_COLUMN] = False
        self.innovation[event], self.innovation_variance[event] = nu, S
        # 2. Decision
        is_velocity_outside = is_outside_gate[:, VELOCITY_COLUMNS].any(axis=1)
        self.rejected[event], self.fused[event], self.reset[event], is_velocity_fused = (
            self.decisions.decide_fusion(
                event,
                is_outside_gate[:, HORIZONTAL_POSITION_COLUMNS].any(axis=1),
                self.can_fuse_velocity[event] & ~(is_velocity_outside & batch.has_gate),
            )
        )
        # 3. Update
        if batch.inputs.aid != GNSS_POS:
            return x, P
        if batch.segment.magnetic_field is None:
            # Without a magnetometer, the replay uses EKF2's logged tilt variances: reduce the tilt
            # variances of P to them, without a change of the tilt
            logged_variance = batch.segment.attitude_variance_rad2[batch.event_steps[event]]
            for tilt_row in range(HEADING):
                noise = _compute_noise_for_target_variance(
                    P, tilt_row, logged_variance[:, tilt_row]
                )
                # The innovation is 0: the fusion changes only P
                x, P = _fuse_states(x, P, [(tilt_row, x[:, tilt_row], noise)])
        is_velocity_fused &= self.has_velocity
        is_component_fused = np.column_stack([*[is_velocity_fused] * 3, *[self.fused[event]] * 2])
        return _update_sequentially(x, P, nu, S, R, is_component_fused)

    def fuse_vision_and_logged_states(self, event: int, x: Array, P: Array) -> ArrayPair:
        """Fuse vision positions, and use logged values of states that the model does not estimate.

        Vision is fused here only if it is the position source. Without a magnetometer, the heading
        becomes EKF2's logged heading. Without height measurements, EKF2's logged height is fused.
        The variances of both are reduced to the logged variances. Return x and P.
        """
        batch, segment = self.batch, self.batch.segment
        steps = batch.event_steps[event]
        # Collect the logged states as tuples (state index, value, R), with the R that changes the
        # variance of the state to the logged variance
        measurements = []
        is_heading_logged = segment.magnetic_field is None
        heading_error_rad = batch.estimates_attitude * segment.attitude_error_rad[steps, HEADING]
        if is_heading_logged:
            logged_variance = segment.attitude_variance_rad2[steps, HEADING]
            R = _compute_noise_for_target_variance(P, HEADING, logged_variance)
            measurements.append((HEADING, heading_error_rad, R))
        if segment.height_samples is None and not batch.inputs.fuses_vision_height:
            logged_variance = segment.down_variance_m2[steps]
            R = _compute_noise_for_target_variance(P, POSITION_DOWN, logged_variance)
            measurements.append((POSITION_DOWN, segment.down_m[steps], R))
        # Add external vision if it is the position source
        if batch.inputs.aid != GNSS_POS and self.has_sample[event]:
            fused_states = [(POSITION_NORTH, self.fused), (POSITION_EAST, self.fused)]
            if batch.inputs.fuses_vision_height:
                # The gate tests only the horizontal position
                fused_states.append((POSITION_DOWN, self.has_action))
            for row, is_fused in fused_states:
                column = row - VELOCITY_AND_POSITION.start
                R = np.where(is_fused[event], self.measurement_variance[event, :, column], np.inf)
                measurements.append((row, self.measured_values[event, :, column], R))
        x, P = _fuse_states(x, P, measurements)
        # If the variance of a state is already below its logged variance, R is infinite and the
        # fusion has no effect. Heading or height are therefore set to the logged value
        if is_heading_logged:
            x[:, HEADING] = heading_error_rad
            P = 0.5 * (P + np.swapaxes(P, 1, 2))
        elif segment.height_samples is None:
            x[:, POSITION_DOWN] = segment.down_m[steps]
        return x, P

    def reset_states(self, event: int, x: Array, P: Array) -> None:
        """Set the states to the measurement, in place.

        Only filter configurations that reset their states in this fusion event are changed.
        """
        rules, is_reset = self.batch.inputs.rules, self.reset[event]
        resets = [(HORIZONTAL_POSITION, HORIZONTAL_POSITION_COLUMNS, rules.reset_variance_factor)]
        if self.has_velocity and rules.resets_velocity:
            resets.append((VELOCITY, VELOCITY_COLUMNS, 1.0))
        for rows, columns, variance_factor in resets:
            variance = variance_factor * self.measurement_variance[event, :, columns]
            set_states(x, P, is_reset, rows, self.measured_values[event, :, columns], variance)
        self.reset_m[event] = (
            is_reset[:, None] * self.innovation[event, :, HORIZONTAL_POSITION_COLUMNS]
        )

    def get_velocity_down_update(self, event: int) -> Array:
        """Return ν and S of the vertical GNSS velocity in a fusion event.

        The shape is (2, filters), with one column for each filter configuration. The values are NaN
        for configurations without a GNSS velocity in this event. A rejected velocity is included.
        """
        update = [
            values[event, :, VELOCITY_DOWN_COLUMN]
            for values in (self.innovation, self.innovation_variance)
        ]
        return np.where(self.can_fuse_velocity[event], update, np.nan)


def _average_samples(batch: FilterBatch, aid: Aid, samples: SensorSamples) -> EventSamples:
    """Return the mean magnetometer or optical flow samples of each fusion event.

    The shape is (events, filters). The events of each filter configuration are a column of
    ``batch.event_steps``.
    """
    mean_samples = EventSamples(
        *_stack_by_filter(
            [average_by_event(batch.segment, samples, steps) for steps in batch.event_steps.T]
        )
    )
    # An event with sample count 0 is not fused, so the count is set to 0 where the source is
    # disabled
    mean_samples.sample_count[:] *= batch.is_enabled_by_aid[aid.name]
    if aid == MAG:
        # R of the magnetometer is determined by the noise parameter of each filter configuration. R
        # of optical flow is read from the log
        sigma_gauss = np.maximum(batch.parameters[MAG.noise], MIN_MAGNETOMETER_SIGMA_GAUSS)
        mean_samples.noise[:] = sigma_gauss**2
    return mean_samples


def _make_bad_acceleration_flag(batch: FilterBatch) -> BadAccelerationFlag:
    """Make the bad-acceleration flag of the filter configurations in a segment."""
    segment = batch.segment
    uses_logged_flag = [
        segment.height_samples is None
        or segment.is_acceleration_bad is None
        or configuration.can_use_logged_bad_acceleration_flag(batch.inputs)
        for configuration in batch.configurations
    ]
    return BadAccelerationFlag(
        np.array(uses_logged_flag), batch.inputs.rules.bad_acceleration_flag_duration_s, segment
    )


def _stack_by_filter(tuples_by_filter: Sequence[tuple[Array, ...]]) -> list[Array]:
    """Stack the arrays of all filter configurations along axis 1; axis 0: fusion events."""
    return [np.stack(arrays, axis=1) for arrays in zip(*tuples_by_filter, strict=True)]


def _fuse_states(x: Array, P: Array, measurements: Sequence[tuple[int, Array, Array]]) -> ArrayPair:
    """Fuse measurements of single states: K = PH'/(HPH' + R), x = x + Kν, P = P - KHP.

    Each measurement consists of state index, value and R. With infinite R, it has no effect.
    """
    for row, value, R in measurements:
        HP = P[:, row]
        K = HP / (HP[:, row] + R)[:, None]
        x = x + K * (value - x[:, row])[:, None]
        P = P - K[:, :, None] * HP[:, None]
    return x, P


def _update_sequentially(
    x: Array, P: Array, nu: Array, S: Array, R: Array, is_fused: BoolArray
) -> ArrayPair:
    """Fuse velocity and horizontal position, one component after the other; return x and P.

    All innovations ν and variances S are from before the first update (fuseDirectStateMeasurement,
    ``ekf_helper.cpp``), so the gain K = c/S is not optimal. With the column c = PH' of P and
    h = HPH', the Joseph form of an update is

        P - cK' - Kc' + K (h + R) K' = P - b cc',  b = (2 - (h + R)/S) / S
    """
    component_count = is_fused.shape[1]
    # Components that are not fused may be NaN: replace them by 1
    nu, S, R = np.where(is_fused, np.array([nu, S, R])[:, :, :component_count], 1.0)
    inverse_S = is_fused / S
    for column in range(component_count):
        row = VELOCITY.start + column
        c, gain = P[:, row], inverse_S[:, column]
        b = gain * (2.0 - gain * (c[:, row] + R[:, column]))
        x = x + c * (gain * nu[:, column])[:, None]
        P = P - (b[:, None] * c)[:, :, None] * c[:, None]
    return x, P


class _FusionDecisions:
    """Decisions on each position sample: reject it, fuse it, or reset the position to it.

    Several filter configurations are computed at once. Each fusion event has at most one position
    sample. EKF2 resets the position after a time without fusion. After several resets, EKF2 stops
    fusion.

    Source: updateEvPosFusion, startEvPosFusion (``ev_pos_control.cpp``).

    Parameters
    ----------
    action : ndarray of int, shape (events, filters)
        Action of each filter configuration on the sample if it is inside the gate.

    Attributes
    ----------
    logged_rejected_flags, logged_resets : ndarray, shape (events,)
        Rejections and resets in the log; NaN for an unknown rejection.
    last_position_s, last_velocity_s : ndarray, shape (filters,)
        Time of the last fusion or reset.
    """

    def __init__(self, batch: FilterBatch, action: IntArray) -> None:
        """Collect the possible actions on each sample, and the logged rejections and resets."""
        received_positions, events = batch.inputs.received_positions, batch.events
        is_aid_enabled = batch.is_enabled_by_aid[batch.inputs.aid.name]
        self.fusion_rules, self.time_s = batch.inputs.rules, batch.event_time_s
        self.sample_actions = np.where(is_aid_enabled, action, NO_ACTION)
        self.can_start_fusion = events["can_start_fusion"] & is_aid_enabled
        self.has_gate, self.uses_logged_decisions = batch.has_gate, batch.uses_logged_decisions
        # All filters receive the same samples
        samples = np.maximum(events["sample"][:, 0], 0)
        self.logged_rejected_flags = received_positions.rejected_flags[samples]
        self.logged_resets = received_positions.is_reset_to_sample[samples]
        self.is_every_reset_logged = received_positions.is_every_reset_logged
        self.last_position_s, self.last_velocity_s = np.full(
            (2, events.shape[1]), batch.segment.time_s[0]
        )
        self.is_stopped = np.zeros(events.shape[1], bool)
        self.remaining_resets = np.full(events.shape[1], self.fusion_rules.max_resets)

    def decide_fusion(
        self, event: int, is_outside_gate: BoolArray, is_velocity_fused: BoolArray
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Decide if the position sample of an event is rejected, fused, or used for a reset.

        Return four masks, with one value for each filter configuration: position rejected, position
        fused, position reset, velocity fused.
        """
        now_s, action = self.time_s[event], self.sample_actions[event]
        is_reset_logged = self.logged_resets[event]
        self.last_velocity_s = np.where(is_velocity_fused, now_s, self.last_velocity_s)
        # Decide if each filter rejects the sample, or starts fusion with it
        may_fuse = action == FUSE
        is_rejected = self.has_gate & may_fuse & self._find_rejected(event, is_outside_gate)
        is_fusion_starting = self.has_gate & (
            (action == START_FUSION) | (self.is_stopped & self.can_start_fusion[event])
        )
        if not (is_reset_logged or (is_rejected | self.is_stopped | is_fusion_starting).any()):
            # All filters fuse the sample, which is the usual case. The steps below would give the
            # same result, but take longer
            self.last_position_s = np.where(may_fuse, now_s, self.last_position_s)
            return is_rejected, may_fuse, np.zeros_like(may_fuse), is_velocity_fused
        # A filter that uses logged decisions resets its position as in the log. Other filters reset
        # it at the start of fusion, and after too long a time without fusion
        uses_logged_resets = self.uses_logged_decisions & (
            self.is_every_reset_logged
            or is_reset_logged
            or not math.isnan(self.logged_rejected_flags[event])
        )
        is_rejection_timed_out = (
            is_rejected & ~self.is_stopped & ~uses_logged_resets & self._is_timed_out(now_s)
        )
        is_reset_after_timeout = is_rejection_timed_out & (self.remaining_resets > 0)
        is_reset = np.where(
            uses_logged_resets,
            self.has_gate & (is_reset_logged | (action == START_FUSION)),
            is_fusion_starting | is_reset_after_timeout,
        )
        is_fused = may_fuse & ~(is_rejected | self.is_stopped | is_reset)
        # The timeouts for later samples start at the last fusion or reset
        self.last_position_s = np.where(is_fused | is_reset, now_s, self.last_position_s)
        self.last_velocity_s = np.where(is_reset, now_s, self.last_velocity_s)
        # EKF2 stops fusion if the rejections time out after the last allowed reset
        self.is_stopped = (self.is_stopped & ~is_fusion_starting) | (
            is_rejection_timed_out & ~is_reset_after_timeout
        )
        self.remaining_resets = np.where(
            is_fusion_starting,
            self.fusion_rules.max_resets,
            self.remaining_resets - is_reset_after_timeout,
        )
        return is_rejected, is_fused, is_reset, is_velocity_fused & ~is_reset

    def _find_rejected(self, event: int, is_outside_gate: BoolArray) -> BoolArray:
        """Return True for each filter configuration that rejects the sample of a fusion event.

        A configuration that uses logged decisions rejects the sample if EKF2 rejected it in the
        log. If the rejection is not logged, the logged resets may show that EKF2 fused the sample.
        Without such information, and for all other configurations, the gate decides.
        """
        logged_flag = self.logged_rejected_flags[event]
        if not math.isnan(logged_flag):
            return np.asarray(
                np.where(self.uses_logged_decisions, logged_flag > 0.0, is_outside_gate)
            )
        if not self.is_every_reset_logged:
            return is_outside_gate
        # If EKF2 had rejected this sample, it would have reset the position to the next sample
        # after its timeout. Without a logged reset at the next sample, EKF2 has fused this sample
        next_event = min(event + 1, len(self.time_s) - 1)
        is_timed_out_at_next_sample = (
            self.time_s[next_event] - self.last_position_s > self.fusion_rules.reset_timeout_s
        )
        was_fused_in_log = is_timed_out_at_next_sample & ~self.logged_resets[next_event]
        return np.asarray(is_outside_gate & ~(self.uses_logged_decisions & was_fused_in_log))

    def _is_timed_out(self, now_s: Array) -> BoolArray:
        """Return True for each filter configuration whose last fusion is too long ago.

        Such a configuration resets the position at the next rejection.
        """
        fusion_rules = self.fusion_rules
        # PX4 releases that reset velocity and position together use twice the timeout while
        # velocity is fused
        is_velocity_fused = now_s - self.last_velocity_s <= fusion_rules.reset_timeout_s
        factor = np.where(fusion_rules.resets_velocity & is_velocity_fused, 2.0, 1.0)
        return np.asarray(now_s - self.last_position_s > factor * fusion_rules.reset_timeout_s)


def estimate_state_correlation(inputs: ReplayInputs, segment: ReplaySegment) -> ReplaySegment:
    """Estimate the correlations of the initial state by a replay of the preceding seconds.

    The log contains only the variances. Without preceding seconds, the correlations are those of
    the steady state.
    """
    if (preceding_segment := segment.preceding_segment) is None:
        correlation = _compute_steady_state_correlation(segment)
    else:
        # This replay omits external vision in addition to GNSS, which adds no states
        inputs = replace(inputs, vision_positions=None)
        configuration = FilterConfiguration(inputs.settings)
        preceding_segment = replace(
            preceding_segment,
            initial_state_correlation=_compute_steady_state_correlation(preceding_segment),
        )
        intervals = make_event_intervals(
            inputs, preceding_segment, configuration.compute_delays(inputs)
        )
        run = run_segment(inputs, preceding_segment, [configuration], [intervals])
        correlation = _compute_correlation(run.covariance[0])
    if segment.magnetic_field is not None:
        # EKF2 has just reset heading and magnetic fields, so they are uncorrelated. The magnetic
        # fields are states only from the start of this segment on
        correlation[HEADING] = correlation[:, HEADING] = 0.0
        correlation[HEADING, HEADING] = 1.0
        correlation = block_diag(correlation, np.eye(len(segment.state) - STATE_COUNT))
    return replace(segment, initial_state_correlation=correlation)


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
    # The bias states are in the body frame: rotate them to NED. The variance of a sum of
    # independent errors, Σ r e, is Σ r² σ²
    state_rotation_to_ned = np.eye(STATE_COUNT)
    state_rotation_to_ned[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] = segment.body_to_ned[0]
    P = np.diag(state_rotation_to_ned**2 @ segment.variance[:STATE_COUNT])
    # A tilt error θ about north gives an acceleration error of g θ to the east, a tilt error about
    # east -g θ to the north. A bias error b gives -b
    for tilt, bias, acceleration_per_rad in (
        (TILT_ABOUT_EAST, ACCELEROMETER_BIAS_NORTH, -GRAVITY_MAGNITUDE_M_S2),
        (TILT_ABOUT_NORTH, ACCELEROMETER_BIAS_EAST, GRAVITY_MAGNITUDE_M_S2),
    ):
        # The accelerations by tilt error θ and bias error b cancel if acceleration_per_rad · θ = b.
        # In the steady state, the two accelerations therefore contain a common part. Its variance
        # is their covariance, and is assumed to be the smaller of their variances
        common_variance = min(P[tilt, tilt] * acceleration_per_rad**2, P[bias, bias])
        P[tilt, bias] = P[bias, tilt] = common_variance / acceleration_per_rad
    return _compute_correlation(state_rotation_to_ned.T @ P @ state_rotation_to_ned)


def _get_state_variances(P: Array) -> Array:
    """Return the state variances (a view of P)."""
    return P.reshape(len(P), -1)[:, :: P.shape[1] + 1]


def _make_start_state(batch: FilterBatch, bad_acceleration_flag: BadAccelerationFlag) -> ArrayPair:
    """Return x, shape (filters, states), and P at the start of a segment, from the logged state."""
    segment, filter_count = batch.segment, len(batch.configurations)
    x = np.tile(segment.state, (filter_count, 1))
    sigma = np.sqrt(segment.variance)
    P = np.tile(sigma[:, None] * segment.initial_state_correlation * sigma, (filter_count, 1, 1))
    # States that a filter does not estimate: constant, with variance 0. The attitude is then the
    # nominal attitude. The accelerometer bias is zero, so the bias error is -nominal bias
    zeros = np.zeros((filter_count, 3))
    bias_error_m_s2 = zeros - segment.accelerometer_bias_m_s2
    for rows, is_estimated, value in (
        (THETA, batch.estimates_attitude, zeros),
        (GYRO_BIAS, batch.estimates_attitude, zeros),
        (ACCELEROMETER_BIAS, batch.estimates_biases, bias_error_m_s2),
    ):
        set_states(x, P, ~is_estimated, rows, value, zeros)
    # While EKF2 flags a bad acceleration, the log contains no accelerometer bias. The replay then
    # starts with the mean vertical bias of the segment, from IMU and logged velocity
    is_bias_unknown = (
        (bad_acceleration_flag.until_s > segment.time_s[0])
        & ~bad_acceleration_flag.uses_logged_flag
        & batch.estimates_biases
    )
    set_states(
        x,
        P,
        is_bias_unknown,
        slice(ACCELEROMETER_BIAS_DOWN, ACCELEROMETER_BIAS_DOWN + 1),
        np.full((filter_count, 1), segment.mean_bias_down_m_s2),
        np.full((filter_count, 1), INITIAL_BIAS_SIGMA_M_S2**2),
    )
    return x, P


def _compute_noise_for_target_variance(P: Array, row: int, target_variance: Array) -> Array:
    """Return the R of an update that changes the variance of a state to ``target_variance``.

    1/R = 1/target_variance - 1/variance. R is infinite if the variance is already smaller.
    """
    variance = P[:, row, row]
    excess_variance = variance - target_variance
    noise = np.full(len(P), np.inf)
    np.divide(variance * target_variance, excess_variance, noise, where=excess_variance > 0.0)
    return noise


def _limit_bias_variance(P: Array, lower_limit_m2_s4: float, estimates_biases: BoolArray) -> None:
    """Limit the accelerometer bias variance like PX4 up to v1.14 (fixCovarianceErrors)."""
    # A view of P: the assignment at the end changes P
    accelerometer_bias_variance = _get_state_variances(P)[:, ACCELEROMETER_BIAS]
    min_variance = np.maximum(
        MIN_RATIO_TO_LARGEST_BIAS_VARIANCE * accelerometer_bias_variance.max(axis=1, keepdims=True),
        lower_limit_m2_s4,
    )
    accelerometer_bias_variance[estimates_biases] = np.clip(
        accelerometer_bias_variance, min_variance, MAX_BIAS_SIGMA_M_S2**2
    )[estimates_biases]


def _collect_measurements(batch: FilterBatch) -> ArrayPair:
    """Return the measurements of the position source in each fusion event, with variances.

    The shape is (events, filters, 6), with one column for each filter configuration. The last axis
    is velocity (m/s), then position (m), both in NED.
    """
    inputs, segment, parameters = batch.inputs, batch.segment, batch.parameters
    received_positions, aid, event_steps = inputs.received_positions, inputs.aid, batch.event_steps
    samples = np.maximum(batch.events["sample"], 0)
    sensor_offset_m = (
        np.stack([parameters[name] for name in aid.lever_arm], axis=-1) - inputs.imu_offset_m
    )
    measured_values, measurement_variance = np.full((2, *event_steps.shape, 6), np.nan)

    def rotate_offset(body_to_ned: Array) -> Array:
        """Rotate the lever arm of each filter with the matrices of all events."""
        return np.asarray((body_to_ned @ sensor_offset_m[:, :, None])[..., 0])

    def limit_variance(reported_variance: Array, noise_parameter: str) -> Array:
        """Return R: EKF2 uses the noise parameter as the minimum σ."""
        min_sigma = np.maximum(parameters[noise_parameter], MIN_MEASUREMENT_NOISE_SIGMA)
        return np.asarray(np.maximum(reported_variance, min_sigma[:, None] ** 2))

    # 1. Position of the IMU: measured position of the sensor minus lever arm
    body_to_ned = segment.body_to_ned[event_steps]
    measured_values[..., 3:] = received_positions.position_m[samples] - rotate_offset(body_to_ned)
    uses_reported_noise = batch.uses_reported_noise
    if aid.noise_mode_parameter:
        uses_reported_noise = uses_reported_noise & (parameters[aid.noise_mode_parameter] != 1.0)
    # An unused reported variance counts as 0, so R is determined by the parameter
    measurement_variance[..., 3:] = limit_variance(
        received_positions.variance_m2[samples] * uses_reported_noise[:, None], aid.noise
    )
    # 2. Velocity, if the source measures it
    if (
        received_positions.velocity_m_s is not None
        and received_positions.velocity_variance_m2_s2 is not None
    ):
        # Velocity of the antenna relative to the rotating IMU: dR/dt · lever arm
        previous_steps = event_steps - 1
        rotation_matrix_derivative_per_s = (
            body_to_ned - segment.body_to_ned[previous_steps]
        ) / segment.step_s[previous_steps, None, None]
        measured_values[..., :3] = received_positions.velocity_m_s[samples] - rotate_offset(
            rotation_matrix_derivative_per_s
        )
        measurement_variance[..., :3] = GNSS_VELOCITY_VARIANCE_FACTORS * limit_variance(
            received_positions.velocity_variance_m2_s2[samples], GNSS_VEL.noise
        )
    # 3. GNSS heights have a larger minimum σ
    if aid == GNSS_POS:
        measurement_variance[..., DOWN_COLUMN] = np.maximum(
            measurement_variance[..., DOWN_COLUMN],
            (GNSS_HEIGHT_NOISE_FACTOR * parameters[aid.noise]) ** 2,
        )
    return measured_values, measurement_variance
