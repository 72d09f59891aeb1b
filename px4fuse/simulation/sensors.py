"""Sensor messages of a simulated flight as PX4 v1.16 logs them, including the mistakes."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray
from px4fuse.ekf2_parameters import GNSS_POS, PARAMETERS
from px4fuse.readers.px4_positions import unproject
from px4fuse.readers.px4_topics import GPS_POSITION
from px4fuse.simulation.mistakes import Mistakes
from px4fuse.simulation.motion import Motion, Sines, attitude, direction
from px4fuse.simulation.scenario import DT_S, Scenario
from px4fuse.simulation.ulog_writer import Topic, topic

# µs since boot of the first data
START_US = 12_000_000
# s, latency from measurement to arrival in PX4: mean, standard deviation, minimum
LATENCY_S, LATENCY_SIGMA_S, LEAST_LATENCY_S = 0.030, 0.003, 0.005
# standard deviation of the source intervals, as a fraction of the interval
INTERVAL_SCATTER = 0.02
FIRST_POSITION_S = 0.1
# s; PX4 uses arrival times until 500 TIMESYNC replies at 10 Hz (Timesync.cpp)
TIMESYNC_CONVERGED_S = 50.0
NLOS_BURST = 3  # mean number of samples per outlier burst
# Origin of the local frame outdoors: latitude, longitude (degrees) and altitude (m)
HOME = (47.397742, 8.545594, 488.0)
# s, age of a GNSS fix at its timestamp; noise factors north, east and down
FIX_AGE_S = 1e-3 * PARAMETERS[GNSS_POS.delay].default
GNSS_SIGMA_FACTORS = np.array([1.0, 1.0, 1.5])
# gauss, magnetic field at HOME (NED); gauss and m, noise of magnetometer and barometer
EARTH_FIELD_GAUSS = np.array([0.217, 0.013, 0.430])
SIGMA_FIELD_GAUSS, SIGMA_BAROMETER_M = 0.02, 0.4
FIELD_RATE_HZ, BAROMETER_RATE_HZ = 14.0, 10.0
# m, RMS of the slow height error caused by weather and wind
HEIGHT_ERROR_M = 0.03
# s, time constant with which EKF2's heading follows a compass that is disturbed in flight
HEADING_FOLLOWS_S = 3.0
ATTITUDE_PERIODS_S = (20.0, 60.0)
ATTITUDE_SINES = 4
ATTITUDE_LATENCY_US = 200
LANDED_INTERVAL_US = 1_000_000


# Random number streams; separate ones keep the noise of the other sensors unchanged by a mistake
Stream = IntEnum(
    "Stream",
    "WANDER BIAS IMU ATTITUDE TIMING SOURCE DRIFT NLOS VIBRATION HEIGHT REST SLOW FIX_VELOCITY "
    "FIELD BAROMETER",
    start=0,
)


def random_stream(scenario: Scenario, name: Stream) -> np.random.Generator:
    """Return the generator of one random number stream."""
    return np.random.default_rng([scenario.seed, name])


@dataclass(frozen=True)
class SensedPositions:
    """Simulated position source.

    Attributes
    ----------
    topic : Topic
    outlier : ndarray of bool, shape (n,)
        True for logged samples that are simulated outliers.
    error_m : ndarray, shape (n, 3)
        Measured minus true position, NED, including mistakes of frame and scale.
    position_m : ndarray, shape (n, 3)
        Measured position, NED.
    velocity_m_s : ndarray, shape (n, 3), or None
        Measured velocity of GNSS; UWB and VIO send none.
    measured_s : ndarray, shape (n,)
        True time of measurement, seconds from the first data.
    distance_m, drift_m : float, ndarray of shape (3,)
        Horizontal distance flown, and VIO drift at the end (NED).
    """

    topic: Topic
    outlier: BoolArray
    error_m: Array
    position_m: Array
    velocity_m_s: Array | None
    measured_s: Array
    distance_m: float
    drift_m: Array


def biases(scenario: Scenario, mistakes: Mistakes) -> tuple[Array, Array]:
    """Return accelerometer (m/s²) and gyro (rad/s) biases, body FRD, each of shape (3,)."""
    rng = random_stream(scenario, Stream.BIAS)
    accelerometer = rng.normal(0.0, scenario.accel_bias_sigma_m_s2, 3)
    accelerometer[0] += mistakes.accel_bias_m_s2
    return accelerometer, rng.normal(0.0, scenario.gyro_bias_sigma_rad_s, 3)


def imu(scenario: Scenario, mistakes: Mistakes, motion: Motion) -> Topic:
    """Return sensor_combined with all samples of accelerometer and gyro."""
    time_us = _grid_us(motion.duration_s, scenario.imu_rate_hz)
    truth = attitude(motion.at(seconds(time_us)))
    bias_a, bias_g = biases(scenario, mistakes)
    rng = random_stream(scenario, Stream.IMU)
    shape = (len(time_us), 3)
    force = truth.specific_force_m_s2 + bias_a
    force += scenario.accelerometer_noise_m_s2 * rng.standard_normal(shape)
    rate = truth.angular_rate_rad_s + bias_g
    rate += scenario.gyro_noise_rad_s * rng.standard_normal(shape)
    if mistakes.vibration_m_s2:
        sigma = mistakes.vibration_m_s2 * np.sqrt(DT_S * scenario.imu_rate_hz)
        force += sigma * random_stream(scenario, Stream.VIBRATION).standard_normal(shape)
    interval_us = round(1e6 / scenario.imu_rate_hz)
    integral_fields = dict.fromkeys(("gyro_integral_dt", "accelerometer_integral_dt"), interval_us)
    sample_fields: dict[str, Any] = {
        "timestamp": _boot_stamps(time_us),
        "gyro_rad": rate,
        "accelerometer_m_s2": force,
    }
    return topic("sensor_combined", sample_fields | integral_fields)


def magnetometer(scenario: Scenario, mistakes: Mistakes, motion: Motion) -> Topic:
    """Return vehicle_magnetometer with all samples."""
    time_us = _grid_us(motion.duration_s, FIELD_RATE_HZ)
    rotation = attitude(motion.at(seconds(time_us))).body_to_ned
    if mistakes.heading_deg:  # EKF2's heading error is caused by this rotation
        rotation = attitude_error(scenario, mistakes, seconds(time_us)).as_matrix() @ rotation
    field = np.einsum("nji,j->ni", rotation, EARTH_FIELD_GAUSS)
    field += SIGMA_FIELD_GAUSS * random_stream(scenario, Stream.FIELD).standard_normal(field.shape)
    at_s = motion.duration_s / 2.0 if mistakes.mag_at_s is None else mistakes.mag_at_s
    field[seconds(time_us) >= at_s, 1] += mistakes.mag_gauss
    return topic("vehicle_magnetometer", timestamps(time_us) | {"magnetometer_ga": field})


def barometer(scenario: Scenario, motion: Motion) -> Topic:
    """Return vehicle_air_data with all samples."""
    time_us = _grid_us(motion.duration_s, BAROMETER_RATE_HZ)
    height_m = HOME[2] - motion.at(seconds(time_us)).position_m[:, 2]
    height_m -= height_error(scenario, seconds(time_us))
    noise = random_stream(scenario, Stream.BAROMETER).standard_normal(len(time_us))
    height_m += SIGMA_BAROMETER_M * noise
    return topic("vehicle_air_data", timestamps(time_us) | {"baro_alt_meter": height_m})


def height_error(scenario: Scenario, time_s: Array) -> Array:
    """Return the slow height error, positive downward (m)."""
    rng, rms = random_stream(scenario, Stream.HEIGHT), np.array([HEIGHT_ERROR_M])
    return Sines.draw(rng, rms, ATTITUDE_PERIODS_S, ATTITUDE_SINES).at(time_s)[0][:, 0]


def limit_rate(complete: Topic, rate_hz: float) -> Topic:
    """Limit a topic to a logging rate (Hz); 0 keeps all messages."""
    return _select_messages(complete, keep_at_rate(time_s(complete), rate_hz))


def logged_imu(complete: Topic, mistakes: Mistakes, motion: Motion) -> Topic:
    """Return sensor_combined as logged: without the gap, and at the reduced rate."""
    stamps_s = time_s(complete)
    keep = _is_outside_gap(
        stamps_s, mistakes.imu_dropout_s, mistakes.imu_dropout_at_s, motion.duration_s
    )
    return _select_messages(complete, keep & keep_at_rate(stamps_s, mistakes.imu_rate_hz))


def time_s(topic: Topic) -> Array:
    """Return the publication time of each message, seconds from the first data."""
    return seconds(topic.fields["timestamp"].astype(np.int64) - START_US)


def _select_messages(topic: Topic, keep: BoolArray) -> Topic:
    return Topic(topic.name, {name: values[keep] for name, values in topic.fields.items()})


def mean_imu_at_rest(
    scenario: Scenario, mistakes: Mistakes, motion: Motion, time_s: float
) -> tuple[Array, Array]:
    """Return mean accelerometer (m/s²) and gyro (rad/s) at rest before the log."""
    truth = attitude(motion.at(np.zeros(1)))
    bias_a, bias_g = biases(scenario, mistakes)
    rng = random_stream(scenario, Stream.REST)
    share = 1.0 / np.sqrt(time_s * scenario.imu_rate_hz)
    force = truth.specific_force_m_s2[0] + bias_a
    force += share * scenario.accelerometer_noise_m_s2 * rng.standard_normal(3)
    rate = truth.angular_rate_rad_s[0] + bias_g
    return force, rate + share * scenario.gyro_noise_rad_s * rng.standard_normal(3)


def logged_attitude(scenario: Scenario, mistakes: Mistakes, motion: Motion) -> Topic:
    """Return vehicle_attitude: the true attitude with a small slow error, independent of EKF2."""
    time_us = _grid_us(motion.duration_s, scenario.attitude_rate_hz)
    truth = attitude(motion.at(seconds(time_us))).body_to_ned
    error = attitude_error(scenario, mistakes, seconds(time_us)).as_matrix()
    turned_attitude = quaternions(error @ truth)
    return attitude_topic("vehicle_attitude", time_us, ATTITUDE_LATENCY_US, turned_attitude)


def true_attitude(scenario: Scenario, motion: Motion) -> Topic:
    """Return vehicle_attitude_groundtruth."""
    time_us = _grid_us(motion.duration_s, scenario.truth_rate_hz)
    truth = attitude(motion.at(seconds(time_us))).body_to_ned
    return attitude_topic("vehicle_attitude_groundtruth", time_us, 0, quaternions(truth))


def quaternions(body_to_ned: Array) -> Array:
    """Convert rotation matrices to quaternions (w, x, y, z)."""
    return np.asarray(Rotation.from_matrix(body_to_ned).as_quat(scalar_first=True))


def attitude_topic(name: str, time_us: NDArray[np.int64], late_us: int, quaternion: Array) -> Topic:
    """Return an attitude topic, published ``late_us`` after the measurement."""
    return topic(name, timestamps(time_us, late_us) | {"q": quaternion})


def attitude_error(scenario: Scenario, mistakes: Mistakes, time_s: Array) -> Rotation:
    """Return the error of the logged attitude, a rotation about north, east and down."""
    tilt, yaw = np.radians([scenario.tilt_error_deg, scenario.yaw_error_deg])
    rng = random_stream(scenario, Stream.ATTITUDE)
    rms = np.array([tilt, tilt, yaw])
    sines = Sines.draw(rng, rms, ATTITUDE_PERIODS_S, ATTITUDE_SINES)
    error = sines.at(time_s)[0]
    if mistakes.heading_deg:
        size = np.radians(mistakes.heading_deg)
        if mistakes.heading_at_s is not None:
            size *= -np.expm1(-np.maximum(time_s - mistakes.heading_at_s, 0.0) / HEADING_FOLLOWS_S)
        error[:, 2] += size
    return Rotation.from_rotvec(error)


def land_detector(motion: Motion) -> Topic:
    """Return vehicle_land_detected: once a second, and at each change."""
    changes_us = np.rint(np.array([motion.take_off_s, motion.touch_down_s]) * 1e6).astype(np.int64)
    time_us = np.union1d(np.arange(0, int(motion.duration_s * 1e6), LANDED_INTERVAL_US), changes_us)
    landed = (time_us < changes_us[0]) | (time_us >= changes_us[1])
    landed_flags = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), landed)
    return topic("vehicle_land_detected", {"timestamp": _boot_stamps(time_us), **landed_flags})


def ground_truth(scenario: Scenario, motion: Motion) -> Topic:
    """Return vehicle_local_position_groundtruth."""
    time_us = _grid_us(motion.duration_s, scenario.truth_rate_hz)
    state = motion.at(seconds(time_us))
    fields = timestamps(time_us) | vectors(
        {"": state.position_m, "v": state.velocity_m_s, "a": state.acceleration_m_s2}
    )
    fields["heading"] = np.angle(np.exp(1j * state.yaw_rad))
    return topic("vehicle_local_position_groundtruth", fields)


def positions(scenario: Scenario, mistakes: Mistakes, motion: Motion) -> SensedPositions:
    """Return vehicle_visual_odometry (UWB in the aisle, VIO on the loop), or GNSS outdoors."""
    timing = random_stream(scenario, Stream.TIMING)
    interval_s = 1.0 / scenario.source_rate_hz
    count = int((motion.duration_s - FIRST_POSITION_S) / interval_s)
    nominal_s = FIRST_POSITION_S + interval_s * np.arange(count)
    # below half an interval, so that the order is kept
    scatter = np.clip(timing.normal(0.0, INTERVAL_SCATTER, count), -0.4, 0.4)
    time_s = np.maximum(nominal_s + scatter * interval_s, 0.0)
    state = motion.at(time_s)
    position = state.position_m.copy()
    speed = np.hypot(state.velocity_m_s[:, 0], state.velocity_m_s[:, 1])
    distance = cumulative_trapezoid(speed, time_s, initial=0)
    drift = np.zeros_like(position)
    if scenario.kind == "loop":
        drift = vio_drift(scenario, distance)
    position += drift
    outdoor = scenario.kind == "outdoor"
    sigma = scenario.source_sigma_m * (GNSS_SIGMA_FACTORS if outdoor else 1.0)
    position += sigma * random_stream(scenario, Stream.SOURCE).standard_normal(position.shape)
    airborne = (time_s > motion.take_off_s) & (time_s < motion.touch_down_s)
    shift, outlier = outliers(scenario, mistakes, airborne)
    position += shift
    if mistakes.slow_error_m:
        position += slow_error(scenario, mistakes, len(time_s), interval_s)
    if mistakes.smoothed_s:
        position = _low_pass(position, interval_s, mistakes.smoothed_s)
    position *= 1.0 + mistakes.scale_percent / 100.0
    if mistakes.yaw_deg:
        position = Rotation.from_euler("z", mistakes.yaw_deg, degrees=True).apply(position)
    if mistakes.jump_m:
        at_s = motion.duration_s / 1.5 if mistakes.jump_at_s is None else mistakes.jump_at_s
        position[time_s >= at_s] += mistakes.jump_m * direction(scenario.heading_deg)
    keep = _is_outside_gap(
        time_s, mistakes.dropout_s, mistakes.dropout_at_s, motion.duration_s
    ) & keep_at_rate(time_s, mistakes.decimate_hz)
    arrival_us, stamp_us = _source_times_us(mistakes, time_s, timing)
    reported_m = reported_sigma_m(scenario, mistakes)
    velocity = None
    if outdoor:
        noise = random_stream(scenario, Stream.FIX_VELOCITY).standard_normal(position.shape)
        velocity = (state.velocity_m_s + scenario.sigma_gnss_m_s * GNSS_SIGMA_FACTORS * noise)[keep]
        fix_us = stamp_us + round(1e6 * FIX_AGE_S)
        topic = _gnss_topic(fix_us[keep], position[keep], velocity, reported_m, scenario)
    else:
        rotation = attitude(state).body_to_ned[keep] if scenario.kind == "loop" else None
        topic = _odometry_topic(
            arrival_us[keep], stamp_us[keep], position[keep], reported_m, rotation
        )
    return SensedPositions(
        topic=topic,
        outlier=outlier[keep],
        error_m=(position - state.position_m)[keep],
        position_m=position[keep],
        velocity_m_s=velocity,
        measured_s=time_s[keep],
        distance_m=float(distance[-1]),
        drift_m=drift[-1],
    )


def reported_sigma_m(scenario: Scenario, mistakes: Mistakes) -> float:
    """Return the reported standard deviation (m); EKF2 uses at least 0.01 m (EKF2.cpp)."""
    return max(scenario.source_sigma_m, 0.01) * float(np.sqrt(mistakes.r_scale))


def slow_error(scenario: Scenario, mistakes: Mistakes, count: int, interval_s: float) -> Array:
    """Return a first-order Gauss-Markov process on each axis, shape (n, 3)."""
    noise = random_stream(scenario, Stream.SLOW).standard_normal((count, 3)) * mistakes.slow_error_m
    keep = np.exp(-interval_s / mistakes.slow_error_s)
    noise[1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], noise, axis=0))


def vio_drift(scenario: Scenario, distance_m: Array) -> Array:
    """Return the VIO drift (m, NED), shape (n, 3): proportional to distance, plus a random walk."""
    rng = random_stream(scenario, Stream.DRIFT)
    straight = scenario.vio_drift * direction(rng.uniform(0.0, 360.0))
    steps = np.sqrt(np.diff(distance_m, prepend=0.0))[:, None]
    walk = np.cumsum(steps * rng.standard_normal((len(distance_m), 3)), axis=0)
    return np.asarray(distance_m[:, None] * straight + scenario.vio_walk_m * walk)


def outliers(
    scenario: Scenario, mistakes: Mistakes, airborne: BoolArray
) -> tuple[Array, BoolArray]:
    """Return the outlier offset of each sample, shape (n, 3), and True for outliers.

    Outliers come in bursts while airborne, as from a hidden anchor. A burst has one horizontal
    direction, and sizes from 0.5 to 1.5 times the mean.
    """
    shift = np.zeros((len(airborne), 3))
    chosen = np.zeros(len(airborne), np.bool_)
    flying = np.flatnonzero(airborne)
    count = round(len(flying) * mistakes.nlos_percent / 100.0)
    if count == 0:
        return shift, chosen
    rng = random_stream(scenario, Stream.NLOS)
    bursts = -(-count // NLOS_BURST)
    lengths = 1 + rng.multinomial(count - bursts, np.full(bursts, 1.0 / bursts))
    gaps = rng.multinomial(len(flying) - count, np.full(bursts + 1, 1.0 / (bursts + 1)))
    starts = np.cumsum(gaps[:-1]) + np.cumsum(lengths) - lengths
    burst = np.repeat(np.arange(bursts), lengths)
    within = np.arange(count) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    at = flying[starts[burst] + within]
    angle = rng.uniform(0.0, 2.0 * np.pi, bursts)[burst]
    size = mistakes.nlos_size_m * rng.uniform(0.5, 1.5, count)
    shift[at, 0], shift[at, 1] = size * np.cos(angle), size * np.sin(angle)
    chosen[at] = True
    return shift, chosen


def keep_at_rate(time_s: Array, rate_hz: float) -> BoolArray:
    """Return True for the samples that a logger with this maximum rate (Hz) keeps; 0 keeps all."""
    if rate_hz <= 0.0:
        return np.ones(len(time_s), np.bool_)
    # the margin prevents rounding from moving a sample to the wrong interval
    return np.asarray(np.diff(np.floor(time_s * rate_hz + 1e-6), prepend=-1.0) > 0.0)


def _source_times_us(
    mistakes: Mistakes, time_s: Array, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return arrival times and measurement timestamps, µs from the first data."""
    latency = mistakes.clock_jump_s or LATENCY_S
    latency_s = np.maximum(rng.normal(latency, LATENCY_SIGMA_S, len(time_s)), LEAST_LATENCY_S)
    arrival_us = np.maximum.accumulate(np.rint((time_s + latency_s) * 1e6).astype(np.int64))
    shift_s = mistakes.clock_offset_s + mistakes.clock_drift_ppm * 1e-6 * time_s
    stamp_us = np.rint((time_s + shift_s) * 1e6).astype(np.int64)
    if mistakes.clock_jump_s:
        stamp_us = np.where(time_s < TIMESYNC_CONVERGED_S, arrival_us, stamp_us)
    return arrival_us, stamp_us


def _odometry_topic(
    arrival_us: NDArray[np.int64],
    stamp_us: NDArray[np.int64],
    position_m: Array,
    sigma_m: float,
    body_to_ned: Array | None,
) -> Topic:
    variance = np.full(position_m.shape, sigma_m**2)
    fields = timestamps(stamp_us, arrival_us - stamp_us)
    fields |= {"position": position_m, "position_variance": variance}
    if body_to_ned is not None:
        fields["q"] = quaternions(body_to_ned)
    return topic("vehicle_visual_odometry", fields)


def _gnss_topic(
    stamp_us: NDArray[np.int64],
    position_m: Array,
    velocity_m_s: Array,
    sigma_m: float,
    scenario: Scenario,
) -> Topic:
    """Return vehicle_gps_position (msg/SensorGps.msg), about the origin of EKF2."""
    latitude, longitude = unproject(position_m[:, 0], position_m[:, 1], HOME[:2])
    accuracies = {
        "eph": sigma_m,
        "epv": sigma_m * GNSS_SIGMA_FACTORS[2],
        "s_variance_m_s": scenario.sigma_gnss_m_s,
    }
    place = {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_msl_m": HOME[2] - position_m[:, 2],
    }
    velocity = {f"vel_{axis}_m_s": velocity_m_s[:, i] for i, axis in enumerate("ned")}
    return topic(GPS_POSITION, timestamps(stamp_us) | place | accuracies | velocity)


def _low_pass(position_m: Array, interval_s: float, constant_s: float) -> Array:
    """Apply a first-order low-pass filter, started at rest at the first sample."""
    keep = np.exp(-interval_s / constant_s)
    smooth, _ = lfilter([1.0 - keep], [1.0, -keep], position_m, axis=0, zi=keep * position_m[:1])
    return np.asarray(smooth)


def _is_outside_gap(
    time_s: Array, length_s: float, at_s: float | None, duration_s: float
) -> BoolArray:
    """Return True for samples outside a gap, by default in the middle of the flight."""
    start_s = (duration_s - length_s) / 2.0 if at_s is None else at_s
    return np.asarray((time_s <= start_s) | (time_s >= start_s + length_s))


def _grid_us(duration_s: float, rate_hz: float) -> NDArray[np.int64]:
    time_us = np.rint(np.arange(int(duration_s * rate_hz) + 1) * (1e6 / rate_hz))
    return np.asarray(time_us, dtype=np.int64)


def seconds(time_us: NDArray[np.int64]) -> Array:
    """Convert microseconds to seconds."""
    return np.asarray(time_us * 1e-6, dtype=np.float64)


def timestamps(time_us: NDArray[np.int64], later_us: int | NDArray[np.int64] = 0) -> dict[str, Any]:
    """Return ``timestamp`` and ``timestamp_sample``, published ``later_us`` after measurement."""
    return {
        "timestamp": _boot_stamps(time_us + later_us),
        "timestamp_sample": _boot_stamps(time_us),
    }


def vectors(values: Mapping[str, Array]) -> dict[str, Any]:
    """Return vectors, shape (n, 3), as PX4 components: ``vx``, ``vy``, ``vz`` for "v"."""
    return {
        f"{name}{axis}": vector[:, i]
        for name, vector in values.items()
        for i, axis in enumerate("xyz")
    }


def _boot_stamps(time_us: NDArray[np.int64]) -> NDArray[np.uint64]:
    return (START_US + time_us).astype(np.uint64)
