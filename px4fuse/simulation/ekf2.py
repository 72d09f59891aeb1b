"""EKF2 topics of a simulated flight, computed with px4fuse's model of EKF2, as PX4 v1.16 logs them.

The model :mod:`px4fuse.ekf2` starts with PX4's initial variances and levelling at rest, then runs
on the simulated IMU and positions. It is linear about the true attitude: a gyro rotation that
differs from it enters as a rotation, so the estimate does not depend on the true attitude.

Outdoors EKF2 fuses magnetometer and barometer, and vehicle_attitude is estimated by EKF2. Indoors a
slow error replaces both sensors, and vehicle_attitude is simulated without the model, so that KF's
input does not depend on EKF2 parameters; the estimated attitude is in estimator_states.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.filter_recursion import (
    EAST,
    HEADING,
    NORTH,
    POSITION_COLUMNS,
    SegmentRun,
    Variant,
)
from px4fuse.ekf2.heights import barometer_samples_inside
from px4fuse.ekf2.inputs import UNLIMITED_RESETS, FusionRules, Inputs, ReceivedPositions
from px4fuse.ekf2.model import delayed_states, run_variants
from px4fuse.ekf2.output_predictor import delay_by, follow_attitude, publish
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    STATES,
    THETA,
    VELOCITY,
    HeightSamples,
    ReplaySegment,
    add_field_states,
    downsample_imu,
    step_ends,
)
from px4fuse.ekf2_parameters import BAROMETER, GNSS_POS, GNSS_VEL, MAG, Aid, effective_settings
from px4fuse.simulation import sensors
from px4fuse.simulation.ekf2_topics import VEHICLE_AID_SOURCE_HZ, TopicTrack, ekf2_topics
from px4fuse.simulation.mistakes import Mistakes
from px4fuse.simulation.motion import Motion, attitude
from px4fuse.simulation.scenario import Scenario
from px4fuse.simulation.ulog_writer import Topic
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_vector,
    multiply,
    skew,
    to_vector,
)

PREDICT_US = 10_000  # µs, EKF2_PREDICT_US
# gauss, initial σ of each axis of both fields after alignment on the ground
FIELD_SD_GAUSS = 0.03
# Rules of v1.14 to main: EV_MAX_INTERVAL (ev_control.cpp), reset_timeout_max (common.h)
RULES = FusionRules(0.2, 0.4, 1.0, 5, None, horizon_by_delay=False)
# Rules of v1.16: gps_control.cpp, and no_aid_timeout_max (common.h)
GNSS_RULES = FusionRules(
    np.inf, np.inf, 7.0, UNLIMITED_RESETS, None, False, reset_scale=2.0, with_velocity=True
)
# s, EKF2_NOAID_TOUT; without an aid for longer EKF2 holds its position (fake_pos_control.cpp)
NO_AIDING_S = 5.0
# σ from EKF2_ANGERR_INIT, _GPS_V_NOISE, _GPS_P_NOISE, _GBIAS_INIT and _ABIAS_INIT (covariance.cpp)
INITIAL_SD = np.repeat([0.1, 0.3, 0.5, 0.1, 0.2], 3)
# Time (s) at rest before the log begins, and σ of the zero-motion measurements. They reproduce the
# values of v1.16 on the ground: 0.0005 rad/s, 0.06 m/s and 0.17 m/s² (horizontal)
REST_S = 10.0
REST_SD = np.repeat([0.05, 0.0005, 0.06], 3)
# rad and m; σ of heading and height as logged by v1.16 in flight
HEADING_SD_RAD, HEIGHT_SD_M = 0.03, 0.15
# s; small enough that variances between UWB samples are logged
MAX_INTERVAL_S = 0.1


def _fused_aids(scenario: Scenario) -> tuple[Aid, ...]:
    """Return the fused aids that have parameters in the model."""
    return (scenario.aid, MAG, BAROMETER) if scenario.aid == GNSS_POS else (scenario.aid,)


def parameters(scenario: Scenario, mistakes: Mistakes) -> dict[str, int | float]:
    """Return the flown value of all EKF2 parameters in the model, by PX4 name."""
    aid = scenario.aid
    gnss = aid == GNSS_POS
    known = effective_settings({}, *_fused_aids(scenario))
    delay_ms = known[aid.delay] if mistakes.ekf2_delay_s is None else 1e3 * mistakes.ekf2_delay_s
    of_aid: dict[str, float] = {aid.noise_mode: 1}
    if gnss:
        # EKF2_MAG_TYPE 1 fuses the magnetic heading only, 0 all axes
        only_heading = int(bool(mistakes.heading_deg))
        of_aid = {GNSS_VEL.noise: scenario.sigma_gnss_m_s, MAG.switch: only_heading}
        of_aid |= {BAROMETER.noise: sensors.SIGMA_BAROMETER_M}
    return (
        known
        | of_aid
        | {
            aid.noise: mistakes.ekf2_noise_m or sensors.reported_sigma_m(scenario, mistakes),
            aid.gate: mistakes.ekf2_gate,
            aid.delay: delay_ms,
            # EKF2_DELAY_MAX is set for a source that arrives late
            "EKF2_DELAY_MAX": max(known["EKF2_DELAY_MAX"], 100.0 + 1e3 * mistakes.clock_jump_s),
            "EKF2_PREDICT_US": PREDICT_US,
        }
    )


def simulate_ekf2(
    scenario: Scenario,
    mistakes: Mistakes,
    motion: Motion,
    imu: Topic,
    source: sensors.SensedPositions,
    others: tuple[Topic, ...],
    log_parameters: Mapping[str, int | float],
) -> tuple[Topic, ...]:
    """Return the EKF2 topics of a flight, without empty ones.

    Parameters
    ----------
    imu, source, others : Topic, SensedPositions, tuple of Topic
        As EKF2 received them, before logging; outdoors ``others`` are magnetometer and barometer.
    log_parameters : mapping
        Parameters of the log.
    """
    aid, aids = scenario.aid, _fused_aids(scenario)
    segment, time_us, nominal = _make_segment(scenario, mistakes, motion, imu)
    known = {name: float(np.float32(v)) for name, v in log_parameters.items()}
    if others:
        magnetometer, barometer = others
        segment = replace(segment, heights=_barometer_heights(segment, barometer))
        if not known[MAG.switch]:
            segment = _with_field(segment, magnetometer)
    settings = effective_settings(known, *aids)
    rules = GNSS_RULES if aid == GNSS_POS else RULES
    step_s = float(np.median(segment.step_s))
    length = int(np.ceil(settings["EKF2_DELAY_MAX"] * 1e3 / PREDICT_US))
    inputs = Inputs(
        settings=settings,
        segments=(segment,),
        received=_arrived_samples(source),
        # ev_pos_control.cpp: without bit 0 samples are evaluated but not fused
        rules=rules
        if int(log_parameters[aid.switch]) & 1
        else replace(rules, start_interval_s=0.0),
        step_s=step_s,
        horizon_s=(length - 1) * step_s,
        predict_s=PREDICT_US * 1e-6,
        vision_height=False,
        imu_offset_m=np.zeros(3),
        aid=aid,
        max_interval_s=MAX_INTERVAL_S,
    )
    model_run = run_variants(inputs, [Variant(settings)], {})[0]
    track = _topic_track(inputs, model_run, time_us, nominal)
    aid_source_hz = VEHICLE_AID_SOURCE_HZ if mistakes.no_vvo else 0.0
    return ekf2_topics(inputs, model_run, track, scenario.attitude_rate_hz, aid_source_hz)


def _make_segment(
    scenario: Scenario, mistakes: Mistakes, motion: Motion, imu: Topic
) -> tuple[ReplaySegment, IntArray, Array]:
    """Return the flight in prediction steps about the true attitude, step times (µs), attitude."""
    time_us = imu.fields["timestamp"].astype(np.int64) - sensors.START_US
    interval = np.diff(time_us) * 1e-6
    ends = step_ends(interval, np.array([], dtype=np.intp), PREDICT_US * 1e-6)
    rate, force = (
        imu.fields[name][1:].astype(np.float64) * interval[:, None]
        for name in ("gyro_rad", "accelerometer_m_s2")
    )
    rotation_vectors, velocity_increments = downsample_imu(rate, force, ends)
    step_us = time_us[np.concatenate([[0], ends])]
    time = step_us * 1e-6
    rotation = attitude(motion.at(time)).body_to_ned
    nominal = sensors.quaternions(rotation)
    gyro = cumulative_product(np.concatenate([nominal[:1], from_vector(rotation_vectors)]))
    attitude_difference = multiply(nominal, conjugate(gyro))
    error = np.zeros((len(time), 3))
    error[:, HEADING] = sensors.attitude_error(scenario, mistakes, time).as_rotvec()[:, HEADING]
    mean_imu_at_rest = sensors.mean_imu_at_rest(scenario, mistakes, motion, REST_S)
    state, covariance = _initial_state_at_rest(
        rotation[0], *mean_imu_at_rest, float(error[0, HEADING])
    )
    variance = np.diagonal(covariance).copy()
    deviation = np.sqrt(variance)
    return (
        ReplaySegment(
            time_s=time,
            step_s=np.diff(time),
            rotation=rotation,
            correction_rad=to_vector(
                multiply(attitude_difference[1:], conjugate(attitude_difference[:-1]))
            ),
            force_m_s2=velocity_increments / np.diff(time)[:, None],
            accelerometer_bias_m_s2=np.zeros(3),
            state=state,
            variance=variance,
            down_m=motion.at(time).position_m[:, 2] + sensors.height_error(scenario, time),
            # only the positions correct the tilt
            attitude_variance_rad2=np.tile([np.inf, np.inf, HEADING_SD_RAD**2], (len(time), 1)),
            down_variance_m2=np.full(len(time), HEIGHT_SD_M**2),
            attitude_error_rad=error,
            correlation=covariance / deviation[:, None] / deviation,
            fusing=False,
        ),
        step_us,
        nominal,
    )


def _with_field(segment: ReplaySegment, magnetometer: Topic) -> ReplaySegment:
    """Add the magnetic fields to the states, aligned on the ground."""
    measured_at_s = sensors.time_s(magnetometer) - 0.5 * float(np.median(segment.step_s))
    gauss = magnetometer.fields["magnetometer_ga"].astype(np.float64)
    fields = np.concatenate([sensors.EARTH_FIELD_GAUSS, np.zeros(3)])
    return add_field_states(
        segment, measured_at_s, gauss, 1.0, fields, np.full(6, FIELD_SD_GAUSS**2)
    )


def _barometer_heights(segment: ReplaySegment, barometer: Topic) -> HeightSamples:
    """Return the barometer heights; the barometer is EKF2's only height sensor here."""
    measured_at_s = sensors.time_s(barometer) - 0.5 * float(np.median(segment.step_s))
    down_m = sensors.HOME[2] - barometer.fields["baro_alt_meter"].astype(np.float64)
    samples = barometer_samples_inside(segment, measured_at_s, down_m, np.zeros(len(down_m)))
    return HeightSamples((BAROMETER.name,), BAROMETER.name, (0.0, 0.0), *samples, 1.0)


def _initial_state_at_rest(
    rotation: Array, force_m_s2: Array, rate_rad_s: Array, heading_error_rad: float
) -> tuple[Array, Array]:
    """Return state and covariance at the start, after zero-motion updates of PX4's initial state.

    At rest specific force is -g and angular rate 0, except for the biases. Levelling correlates
    tilt with the accelerometer bias.
    """
    H = np.zeros((9, STATES))
    H[0:3, THETA] = -skew(rotation @ force_m_s2)
    H[0:3, ACCELEROMETER_BIAS] = -rotation
    H[3:6, GYRO_BIAS] = np.eye(3)
    H[6:9, VELOCITY] = np.eye(3)
    measured = np.concatenate([-GRAVITY_M_S2 - rotation @ force_m_s2, rate_rad_s, np.zeros(3)])
    P = np.diag(INITIAL_SD**2)
    x = np.zeros(STATES)
    P[HEADING, HEADING], x[HEADING] = HEADING_SD_RAD**2, heading_error_rad
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(REST_SD**2))
    x += K @ (measured - H @ x)
    x[HEADING] = heading_error_rad
    P -= K @ H @ P
    return x, 0.5 * (P + P.T)


def _arrived_samples(source: sensors.SensedPositions) -> ReceivedPositions:
    """Return the samples in order of arrival, without those older than an earlier one.

    EKF2 ignores samples older than the last (estimator_interface.cpp).
    """
    fields = source.topic.fields
    stamp, arrival = (
        sensors.seconds(fields[name].astype(np.int64) - sensors.START_US)
        for name in ("timestamp_sample", "timestamp")
    )
    newest = np.maximum.accumulate(np.concatenate([[-np.inf], stamp[:-1]]))
    is_newer = stamp > newest
    velocity = source.velocity_m_s
    if velocity is not None:
        accuracy = np.stack([fields["eph"], fields["eph"], fields["epv"]], axis=1)[is_newer] ** 2
        speed = np.repeat(fields["s_variance_m_s"][is_newer, None] ** 2, 3, axis=1)
    else:
        accuracy, speed = fields["position_variance"][is_newer], None
    return ReceivedPositions(
        stamp_s=stamp[is_newer],
        arrival_s=arrival[is_newer],
        position_m=source.position_m[is_newer].astype(np.float32).astype(np.float64),
        variance_m2=accuracy.astype(np.float64),
        rejected=np.full(int(is_newer.sum()), np.nan),
        reset=np.zeros(int(is_newer.sum()), dtype=bool),
        source=source.topic.name,
        velocity_m_s=None if velocity is None else velocity[is_newer],
        velocity_variance_m2_s2=speed,
    )


def _topic_track(
    inputs: Inputs, model_run: SegmentRun, time_us: IntArray, nominal: Array
) -> TopicTrack:
    segment = model_run.segment
    lag = round(inputs.horizon_s / inputs.step_s)
    state, _ = delayed_states(model_run, 0)
    resets, aided = _hold_without_aiding(model_run, state)
    reset_sum_m = np.zeros((len(state), 3))
    for step, jump in resets:
        reset_sum_m[step:, :2] += jump
    # EKF2 corrects the newest IMU samples with the bias at the fusion horizon
    gyro = np.einsum("nij,nj->ni", segment.rotation[1:], delay_by(state[:, GYRO_BIAS], lag)[1:])
    attitude_steps = -segment.correction_rad - gyro * segment.step_s[:, None]
    gyro_attitude_error = state[0, THETA] + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(attitude_steps, axis=0)]
    )
    attitude_error = gyro_attitude_error + follow_attitude(
        state[:, THETA] - gyro_attitude_error, lag, inputs.step_s, inputs.horizon_s
    )
    velocity, position = publish(segment, state, reset_sum_m, attitude_error, lag, inputs.settings)
    return TopicTrack(
        time_us=time_us,
        lag=lag,
        delayed_attitude=multiply(from_vector(state[:, THETA]), nominal),
        delayed=state[:, 3:],
        velocity_m_s=velocity,
        position_m=position,
        attitude=multiply(from_vector(attitude_error), nominal),
        resets=tuple((step + lag, jump) for step, jump in resets),
        aided=aided,
    )


def _hold_without_aiding(
    model_run: SegmentRun, state: Array
) -> tuple[list[tuple[int, Array]], BoolArray]:
    """Return resets by step and times with an aid; without one hold the position of ``state``.

    EKF2 then fuses a fake position, which the model does not contain.
    """
    events, run, time = model_run.events[0], model_run, model_run.segment.time_s
    horizontal = slice(NORTH, EAST + 1)
    used = np.flatnonzero(run.fused[:, 0] | run.reset[:, 0])
    last = np.zeros(len(time))
    last[events.end_step[used]] = time[events.end_step[used]]
    aided = time - np.maximum.accumulate(last) <= NO_AIDING_S
    aiding_ends = np.flatnonzero(np.diff(aided.astype(int)) == -1) + 1
    aiding_starts = np.flatnonzero(np.diff(aided.astype(int)) == 1) + 1
    for start, end in zip(
        aiding_ends, [*aiding_starts, len(time)][: len(aiding_ends)], strict=True
    ):
        state[start:end, horizontal] = state[start - 1, horizontal]
        state[start:end, VELOCITY.start : VELOCITY.start + 2] = 0.0
    resets = []
    for event in np.flatnonzero(run.reset[:, 0]):
        step = int(events.end_step[event])
        jump = run.innovation[event, 0, POSITION_COLUMNS]
        if not aided[step - 1]:
            jump = state[step, horizontal] - state[step - 1, horizontal]
        resets.append((step, jump))
    return resets, aided
