"""EKF2 topics of a simulated flight as PX4 v1.16 logs them, computed by :mod:`px4fuse.ekf2`.

The EKF2 model starts at rest and runs on the simulated IMU and positions. Its error states are
linearised about the true attitude.

Outdoors, EKF2 fuses magnetometer and barometer. Indoors, heading and height are the true values
plus a simulated slow error. KF uses the topic vehicle_attitude. Indoors, this topic is simulated
without the EKF2 model, so the results of KF do not depend on EKF2 parameters.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray, IntArray, cumulative_sums
from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.filter_recursion import (
    HEADING,
    HORIZONTAL_POSITION_COLUMNS,
    SegmentRun,
)
from px4fuse.ekf2.inputs import GNSS_RULES, VISION_RULES, ReceivedPositions, ReplayInputs
from px4fuse.ekf2.model import compute_delayed_states, run_configurations
from px4fuse.ekf2.output_predictor import (
    compute_published_state,
    delay_by,
    sum_attitude_corrections,
)
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    HORIZONTAL_POSITION,
    HORIZONTAL_VELOCITY,
    STATE_COUNT,
    THETA,
    VELOCITY,
    HeightSamples,
    ReplaySegment,
    add_magnetic_field_states,
    downsample_imu,
    find_sample_steps,
    find_step_ends,
    make_magnetic_field_samples,
)
from px4fuse.flight.ekf2_parameters import (
    BAROMETER,
    EV_POS,
    GNSS_POS,
    GNSS_VEL,
    MAG,
    Aid,
    fill_parameters_with_defaults,
)
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_rotation_vector,
    multiply,
    rotate,
    skew,
    to_rotation_vector,
)

from . import sensors
from .ekf2_topics import (
    VEHICLE_AID_SOURCE_LOG_RATE_HZ,
    Ekf2Output,
    compute_time_since_last_event_s,
    make_ekf2_topics,
)
from .faults import FaultSizes
from .motion import Motion
from .scenario import Scenario
from .ulog_writer import Topic

# PX4 parameter values with which EKF2 fuses positions (GNSS: positions and velocities)
FUSION_SWITCH_VALUES = {EV_POS.switch: 1, GNSS_POS.switch: 5}
# SDLOG_PROFILE that logs the topics of external vision
LOG_PROFILE_WITH_VISION = 129
# SDLOG_PROFILE that does not log the topics of external vision
LOG_PROFILE_WITHOUT_VISION = 1
# Length (µs) of EKF2's prediction step: parameter EKF2_PREDICT_US
PREDICTION_STEP_US = 10_000
# Initial σ (gauss) of earth field and magnetometer bias, on each axis
INITIAL_FIELD_SIGMA_GAUSS = 0.03
# Time (s) without fusion after which EKF2 holds the position: EKF2_NOAID_TOUT
# (fake_pos_control.cpp)
NO_AID_TIMEOUT_S = 5.0
# Initial σ of tilt, velocity, position, gyro bias and accelerometer bias: EKF2_ANGERR_INIT,
# EKF2_GPS_V_NOISE, EKF2_GPS_P_NOISE, EKF2_GBIAS_INIT and EKF2_ABIAS_INIT (covariance.cpp)
INITIAL_STATE_SIGMA = np.repeat([0.1, 0.3, 0.5, 0.1, 0.2], 3)
# Simulated time (s) at rest before the log starts
REST_BEFORE_LOG_S = 10.0
# σ of specific force (m/s²), angular rate (rad/s) and velocity (m/s) at rest, chosen to give the σ
# that EKF2 v1.16 reports on the ground
MEASUREMENT_SIGMA_AT_REST = np.repeat([0.05, 0.0005, 0.06], 3)
# σ of EKF2's heading (rad) as PX4 v1.16 logs it in flight
INDOOR_HEADING_SIGMA_RAD = 0.03
# σ of EKF2's height (m) as PX4 v1.16 logs it in flight
INDOOR_HEIGHT_SIGMA_M = 0.15
# Maximum interval (s) at which the simulated EKF2 fuses height and heading in a gap of the position
# source. The variances in estimator_states are those after these fusions
MAX_HEIGHT_FUSION_INTERVAL_IN_POSITION_GAP_S = 0.1


def _select_fused_aids(scenario: Scenario) -> tuple[Aid, ...]:
    """Return the aiding sources that EKF2 fuses: outdoors also magnetometer and barometer."""
    return (scenario.aid, MAG, BAROMETER) if scenario.aid == GNSS_POS else (scenario.aid,)


def make_parameters(scenario: Scenario, faults: FaultSizes) -> dict[str, int | float]:
    """Return the values of all PX4 parameters that the log contains, by PX4 name."""
    aid = scenario.aid
    defaults = fill_parameters_with_defaults({}, *_select_fused_aids(scenario))
    delay_ms = defaults[aid.delay] if faults.ekf2_delay_s is None else 1e3 * faults.ekf2_delay_s
    aid_parameters: dict[str, float] = {aid.noise_mode_parameter: 1}
    if aid == GNSS_POS:
        aid_parameters = {
            GNSS_VEL.noise: scenario.sigma_gnss_m_s,
            # EKF2_MAG_TYPE 1: EKF2 fuses the magnetic heading only; 0: all axes
            MAG.switch: int(bool(faults.heading_deg)),
            BAROMETER.noise: sensors.SIGMA_BAROMETER_M,
        }
    has_vision_topic = aid != GNSS_POS and not faults.no_vvo
    return {
        **defaults,
        **aid_parameters,
        aid.noise: faults.ekf2_noise_m or sensors.compute_reported_sigma_m(scenario, faults),
        aid.gate: faults.ekf2_gate,
        aid.delay: delay_ms,
        # EKF2 discards positions with a larger delay (ms), which the fault clock-jump may cause
        "EKF2_DELAY_MAX": max(defaults["EKF2_DELAY_MAX"], 100.0 + 1e3 * faults.clock_jump_s),
        "EKF2_PREDICT_US": PREDICTION_STEP_US,
        "EKF2_EN": int(scenario.ekf2),
        **dict.fromkeys(FUSION_SWITCH_VALUES, 0),
        aid.switch: 0 if faults.ekf2_off else FUSION_SWITCH_VALUES[aid.switch],
        "EKF2_HGT_REF": 0,
        "SDLOG_PROFILE": LOG_PROFILE_WITH_VISION
        if has_vision_topic
        else LOG_PROFILE_WITHOUT_VISION,
    }


def simulate_ekf2(
    scenario: Scenario,
    faults: FaultSizes,
    motion: Motion,
    imu: Topic,
    source: sensors.SimulatedPositions,
    other_sensors: tuple[Topic, ...],
    log_parameters: Mapping[str, int | float],
) -> tuple[Topic, ...]:
    """Simulate EKF2 and return its topics, without empty topics.

    ``imu``, ``source`` and ``other_sensors`` contain all samples, also those that are not logged.
    """
    aid = scenario.aid
    # 1. Inputs of the EKF2 model in each prediction step: IMU, magnetometer and barometer
    segment = _make_segment(scenario, faults, motion, imu)
    # The log contains float32 values
    logged_values = {name: float(np.float32(value)) for name, value in log_parameters.items()}
    step_s = float(np.median(segment.step_s))
    if other_sensors:
        magnetometer, barometer = other_sensors
        # EKF2 subtracts half a prediction step from sample times (estimator_interface.cpp)
        magnetometer_times_s, barometer_times_s = (
            sensors.to_seconds(sensors.get_time_us(topic)) - 0.5 * step_s for topic in other_sensors
        )
        segment = _add_barometer(segment, barometer, barometer_times_s)
        if not logged_values[MAG.switch]:  # EKF2 fuses all axes of the magnetic field
            segment = add_magnetic_field_states(
                segment,
                make_magnetic_field_samples(
                    segment,
                    magnetometer_times_s,
                    magnetometer.fields["magnetometer_ga"].astype(np.float64),
                    1.0,
                ),
                # EKF2 initialises earth field and magnetometer bias on the ground
                np.concatenate([sensors.EARTH_FIELD_GAUSS, np.zeros(3)]),
                np.full(6, INITIAL_FIELD_SIGMA_GAUSS**2),
            )
    # 2. Rules for the fusion of the positions, and the fusion horizon
    settings = fill_parameters_with_defaults(logged_values, *_select_fused_aids(scenario))
    rules = GNSS_RULES if aid == GNSS_POS else VISION_RULES
    if not int(log_parameters[aid.switch]) & 1:
        # Bit 0 of EKF2_EV_CTRL (outdoors: EKF2_GPS_CTRL) is not set. EKF2 then tests the positions,
        # but never fuses them (ev_pos_control.cpp). With a maximum sample interval of 0, fusion
        # never starts
        rules = replace(rules, max_sample_interval_to_start_s=0.0)
    # EKF2 delays the fusion by the length of its IMU buffer, in steps (estimator_interface.cpp)
    buffer_length = int(np.ceil(1e3 * settings["EKF2_DELAY_MAX"] / PREDICTION_STEP_US))
    # 3. Run of the EKF2 model, and its topics
    inputs = ReplayInputs(
        settings=settings,
        segments=(segment,),
        received_positions=_select_accepted_positions(source),
        rules=rules,
        mean_step_s=step_s,
        horizon_s=(buffer_length - 1) * step_s,
        configured_step_s=PREDICTION_STEP_US * 1e-6,
        fuses_vision_height=False,
        imu_offset_m=np.zeros(3),
        aid=aid,
        max_height_fusion_interval_in_position_gap_s=MAX_HEIGHT_FUSION_INTERVAL_IN_POSITION_GAP_S,
    )
    model_run = run_configurations(inputs, [FilterConfiguration(settings)])[0]
    return make_ekf2_topics(
        inputs,
        model_run,
        _compute_output(inputs, model_run),
        scenario.attitude_rate_hz,
        aid_source_log_rate_hz=VEHICLE_AID_SOURCE_LOG_RATE_HZ if faults.no_vvo else 0.0,
    )


def _add_barometer(
    segment: ReplaySegment, barometer: Topic, measurement_times_s: Array
) -> ReplaySegment:
    """Add the barometer samples, which are EKF2's only height source outdoors."""
    down_m = sensors.HOME_POSITION[2] - barometer.fields["baro_alt_meter"].astype(float)
    # Without ground effect, the dead zone of the innovation is 0. The table contains all samples,
    # so each of them has the weight 1
    samples = pd.DataFrame(
        {"down_m": down_m, "dead_zone_m": 0.0, "weight": 1.0}, measurement_times_s
    )
    step_indices, is_inside = find_sample_steps(segment, measurement_times_s)
    # The barometer is the only fused height sensor, and the reference, so no sensor has a bias
    name, bias_and_variance = BAROMETER.name, np.zeros(2)
    height_samples = HeightSamples(
        (name,), name, bias_and_variance, step_indices, samples[is_inside]
    )
    return replace(segment, height_samples=height_samples)


def _make_segment(
    scenario: Scenario, faults: FaultSizes, motion: Motion, imu: Topic
) -> ReplaySegment:
    """Return the input of the EKF2 model."""
    # 1. Sums of the IMU samples in each prediction step
    time_us = sensors.get_time_us(imu)
    interval_s = np.diff(time_us) * 1e-6
    step_end_indices = find_step_ends(
        interval_s, np.array([], dtype=np.intp), PREDICTION_STEP_US * 1e-6
    )
    rotation_rad, velocity_increment_m_s = downsample_imu(
        imu.fields["gyro_rad"][1:].astype(float) * interval_s[:, None],
        imu.fields["accelerometer_m_s2"][1:].astype(float) * interval_s[:, None],
        step_end_indices,
    )
    # 2. Attitude at the start and after each step
    time_s = time_us[np.concatenate([[0], step_end_indices])] * 1e-6
    body_to_ned = motion.compute_body_to_ned(time_s)
    true_quaternions = sensors.to_quaternions(body_to_ned)
    integrated_attitude = cumulative_product(
        np.concatenate([true_quaternions[:1], from_rotation_vector(rotation_rad)])
    )
    # rotation from the attitude integrated from the gyro to the true attitude. Its change in each
    # step is the attitude correction, which keeps the attitude of the EKF2 model at the true
    # attitude
    attitude_difference = multiply(true_quaternions, conjugate(integrated_attitude))
    attitude_error_rad = sensors.simulate_attitude_error(scenario, faults, time_s).as_rotvec()
    attitude_error_rad[:, :HEADING] = 0.0  # only the heading is measured
    # IMU measurements at rest, at time 0 before take-off
    specific_force_m_s2, rate_rad_s = sensors.simulate_imu_samples(
        scenario,
        faults,
        motion,
        np.zeros(1),
        sensors.RandomStream.IMU_NOISE_AT_REST,
        samples_per_average=REST_BEFORE_LOG_S * scenario.imu_rate_hz,
    )
    state, covariance = _compute_state_at_rest(
        body_to_ned[0], specific_force_m_s2[0], rate_rad_s[0], attitude_error_rad[0, HEADING]
    )
    variance = np.diagonal(covariance).copy()
    sigma = np.sqrt(variance)
    return ReplaySegment(
        time_s=time_s,
        step_s=np.diff(time_s),
        body_to_ned=body_to_ned,
        attitude_correction_rad=to_rotation_vector(
            multiply(attitude_difference[1:], conjugate(attitude_difference[:-1]))
        ),
        specific_force_m_s2=velocity_increment_m_s / np.diff(time_s)[:, None],
        accelerometer_bias_m_s2=np.zeros(3),
        state=state,
        variance=variance,
        down_m=motion.compute_true_state(time_s).position_m[:, 2]
        + sensors.simulate_height_error(scenario, time_s),
        # Infinite variance of the measured tilt: only positions correct EKF2's tilt
        attitude_variance_rad2=np.tile(
            [np.inf, np.inf, INDOOR_HEADING_SIGMA_RAD**2], (len(time_s), 1)
        ),
        down_variance_m2=np.full(len(time_s), INDOOR_HEIGHT_SIGMA_M**2),
        attitude_error_rad=attitude_error_rad,
        initial_state_correlation=covariance / sigma[:, None] / sigma,
        starts_while_fusing=False,
    )


def _compute_state_at_rest(
    rotation: Array, specific_force_m_s2: Array, rate_rad_s: Array, heading_error_rad: float
) -> tuple[Array, Array]:
    """Return EKF2's error state and covariance at the start of the log, after a time at rest.

    One Kalman update of PX4's initial covariance uses the known specific force, rate and velocity.
    """
    # rows of H: specific force in NED, angular rate and velocity
    H = np.zeros((9, STATE_COUNT))
    H[0:3, THETA] = -skew(rotation @ specific_force_m_s2)
    H[0:3, ACCELEROMETER_BIAS] = -rotation
    H[3:6, GYRO_BIAS] = np.eye(3)
    H[6:9, VELOCITY] = np.eye(3)
    # at rest, the true specific force is -gravity, and angular rate and velocity are zero
    z = np.concatenate([-GRAVITY_M_S2 - rotation @ specific_force_m_s2, rate_rad_s, np.zeros(3)])
    P = np.diag(INITIAL_STATE_SIGMA**2)
    x = np.zeros(STATE_COUNT)
    P[HEADING, HEADING], x[HEADING] = INDOOR_HEADING_SIGMA_RAD**2, heading_error_rad
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(MEASUREMENT_SIGMA_AT_REST**2))
    x += K @ (z - H @ x)
    x[HEADING] = heading_error_rad  # the update at rest does not measure the heading
    P -= K @ H @ P
    return x, 0.5 * (P + P.T)


def _select_accepted_positions(source: sensors.SimulatedPositions) -> ReceivedPositions:
    """List the positions that EKF2 accepts, in order of arrival.

    EKF2 ignores positions that are older than the previous one (estimator_interface.cpp).
    """
    timestamp_s, arrival_s = (
        sensors.to_seconds(sensors.get_time_us(source.topic, name))
        for name in ("timestamp_sample", "timestamp")
    )
    latest_timestamp_s = np.maximum.accumulate(np.concatenate([[-np.inf], timestamp_s[:-1]]))
    is_newer = timestamp_s > latest_timestamp_s
    fields = {name: values[is_newer] for name, values in source.topic.fields.items()}
    velocity_m_s = velocity_variance = None
    if source.velocity_m_s is None:
        position_variance = fields["position_variance"]
    else:
        velocity_m_s = source.velocity_m_s[is_newer]
        velocity_variance = np.repeat(fields["s_variance_m_s"][:, None] ** 2, 3, axis=1)
        position_variance = np.stack([fields[name] for name in ("eph", "eph", "epv")], axis=1) ** 2
    count = int(is_newer.sum())
    return ReceivedPositions(
        timestamp_s=timestamp_s[is_newer],
        arrival_s=arrival_s[is_newer],
        position_m=source.position_m[is_newer].astype(np.float32).astype(np.float64),
        variance_m2=position_variance.astype(np.float64),
        rejected_flags=np.full(count, np.nan),
        is_reset_to_sample=np.zeros(count, dtype=bool),
        source=source.topic.name,
        velocity_m_s=velocity_m_s,
        velocity_variance_m2_s2=velocity_variance,
    )


def _compute_output(inputs: ReplayInputs, model_run: SegmentRun) -> Ekf2Output:
    """Compute the states at the fusion horizon, and those that the output predictor publishes."""
    segment = model_run.segment
    true_quaternions = sensors.to_quaternions(segment.body_to_ned)
    lag_steps = round(inputs.horizon_s / inputs.mean_step_s)
    state = compute_delayed_states(model_run, 0)
    reset_steps, reset_sizes_m, has_recent_position_aiding = _hold_position_without_aiding(
        model_run, state
    )
    # The height is never reset
    reset_m = np.zeros((len(state), 3))
    reset_m[reset_steps, :2] = reset_sizes_m
    # Attitude error (NED) of the output predictor. It integrates the newest gyro samples, from
    # which it subtracts the older gyro bias of the fusion horizon
    gyro_bias_rad_s = rotate(segment.body_to_ned[1:], delay_by(state[:, GYRO_BIAS], lag_steps)[1:])
    attitude_error_increments_rad = (
        -segment.attitude_correction_rad - gyro_bias_rad_s * segment.step_s[:, None]
    )
    gyro_attitude_error_rad = state[0, THETA] + cumulative_sums(attitude_error_increments_rad)
    # The output predictor corrects its attitude by that at the fusion horizon. The correction is
    # lag_steps late, because the fusion horizon is lag_steps in the past
    attitude_error_rad = gyro_attitude_error_rad + sum_attitude_corrections(
        state[:, THETA] - gyro_attitude_error_rad, lag_steps, inputs.mean_step_s, inputs.horizon_s
    )
    velocity_m_s, position_m = compute_published_state(
        segment,
        state,
        np.cumsum(reset_m, axis=0),
        attitude_error_rad,
        lag_steps,
        inputs.settings,
    )
    return Ekf2Output(
        time_us=np.rint(segment.time_s * 1e6).astype(np.int64),
        lag_steps=lag_steps,
        attitude_at_fusion_horizon=multiply(
            from_rotation_vector(state[:, THETA]), true_quaternions
        ),
        states_at_fusion_horizon=state[:, 3:],
        velocity_m_s=velocity_m_s,
        position_m=position_m,
        attitude=multiply(from_rotation_vector(attitude_error_rad), true_quaternions),
        reset_steps=reset_steps + lag_steps,
        reset_sizes_m=reset_sizes_m,
        has_recent_position_aiding=has_recent_position_aiding,
    )


def _hold_position_without_aiding(
    model_run: SegmentRun, state: Array
) -> tuple[IntArray, Array, BoolArray]:
    """Hold the position in ``state`` during times without aiding (fake_pos_control.cpp).

    Return step and size (m) of the position resets, and a mask of the steps with recent aiding.
    """
    events, time_s = model_run.events[0], model_run.segment.time_s
    aiding_steps = events.end_step[model_run.fused[:, 0] | model_run.reset[:, 0]]
    has_recent_position_aiding = (
        compute_time_since_last_event_s(time_s, aiding_steps, 0.0) <= NO_AID_TIMEOUT_S
    )
    # Without recent aiding, hold the position of the last step with aiding, and set the velocity to
    # 0. The running maximum of the step numbers, with 0 for steps without aiding, is the last step
    # with aiding
    last_step_with_aiding = np.maximum.accumulate(
        np.arange(len(time_s)) * has_recent_position_aiding
    )
    state[:, HORIZONTAL_POSITION] = state[last_step_with_aiding, HORIZONTAL_POSITION]
    state[~has_recent_position_aiding, HORIZONTAL_VELOCITY] = 0.0
    reset_events = np.flatnonzero(model_run.reset[:, 0])
    reset_steps = events.end_step[reset_events]
    steps_before_reset = reset_steps - 1
    # A reset moves the position to the measured position. Its size is the innovation relative to
    # the estimated position, or, after a time without aiding, the difference from the held position
    reset_sizes_m = np.where(
        has_recent_position_aiding[steps_before_reset, None],
        model_run.innovation[reset_events, 0, HORIZONTAL_POSITION_COLUMNS],
        state[reset_steps, HORIZONTAL_POSITION] - state[steps_before_reset, HORIZONTAL_POSITION],
    )
    return reset_steps, reset_sizes_m, has_recent_position_aiding
