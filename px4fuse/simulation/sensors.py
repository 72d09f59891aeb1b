"""Simulated sensor topics as PX4 v1.16 logs them, with the injected faults of the flight."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray, integrate_cumulatively
from px4fuse.flight.ekf2_parameters import GNSS_POS, MODEL_PARAMETERS
from px4fuse.readers.px4_positions import unproject
from px4fuse.readers.px4_topics import GPS_POSITION_TOPIC

from .faults import FaultSizes
from .motion import Motion, Sines, compute_attitude_and_imu, compute_direction
from .scenario import DT_S, Scenario
from .ulog_writer import Topic, make_topic

# Time since boot (µs) of the first sample
FIRST_TIMESTAMP_US = 12_000_000
# Mean latency (s) of positions from measurement to arrival in PX4
POSITION_LATENCY_S = 0.030
# Standard deviation (s) of the latency of positions
POSITION_LATENCY_SIGMA_S = 0.003
# Minimum simulated latency (s) of positions
MIN_POSITION_LATENCY_S = 0.005
# Standard deviation of the times of position measurements, as fraction of their interval
INTERVAL_JITTER_FRACTION = 0.02
# Time (s) from the first sample to the first position
FIRST_POSITION_TIME_S = 0.1
# Time (s) until TIMESYNC converges: 500 replies at 10 Hz (Timesync.cpp). PX4 then uses the
# sender's timestamps
TIMESYNC_CONVERGENCE_TIME_S = 50.0
# Mean number of positions in a burst of outliers
MEAN_OUTLIER_BURST_POSITION_COUNT = 3
# Origin of the local frame outdoors: latitude, longitude (degrees) and altitude (m)
HOME_POSITION = (47.397742, 8.545594, 488.0)
# Time (s) from the measurement of a GNSS position to its timestamp
GNSS_DELAY_S = 1e-3 * MODEL_PARAMETERS[GNSS_POS.delay].default
# GNSS noise north, east and down, as multiples of the σ of the scenario
GNSS_SIGMA_FACTORS = np.array([1.0, 1.0, 1.5])
# Magnetic field (gauss, NED) at HOME_POSITION
EARTH_FIELD_GAUSS = np.array([0.217, 0.013, 0.430])
SIGMA_MAGNETOMETER_GAUSS = 0.02
MAGNETOMETER_RATE_HZ = 14.0
SIGMA_BAROMETER_M = 0.4
BAROMETER_RATE_HZ = 10.0
# RMS (m) of the slow height error that weather and wind cause
HEIGHT_ERROR_RMS_M = 0.03
# Time constant (s) with which EKF2's heading error grows after the start of a compass error
HEADING_TIME_CONSTANT_S = 3.0
# Range of the periods (s) of slow attitude and height errors
SLOW_ERROR_PERIOD_RANGE_S = (20.0, 60.0)
# Time (µs) from the measurement to the publication of vehicle_attitude
ATTITUDE_LATENCY_US = 200
LAND_DETECTOR_INTERVAL_US = 1_000_000


# One random number stream for each sensor and error: a fault does not change other noises
RandomStream = IntEnum(
    "RandomStream",
    "PATH_DEVIATION IMU_BIAS IMU_NOISE ATTITUDE_ERROR POSITION_TIMES POSITION_NOISE VIO_DRIFT "
    "NLOS_OUTLIERS VIBRATION HEIGHT_ERROR IMU_NOISE_AT_REST SLOW_POSITION_ERROR "
    "GNSS_VELOCITY_NOISE MAGNETOMETER_NOISE BAROMETER_NOISE",
    start=0,
)


def make_random_generator(scenario: Scenario, random_stream: RandomStream) -> np.random.Generator:
    return np.random.default_rng([scenario.seed, random_stream])


@dataclass(frozen=True)
class SimulatedPositions:
    """Simulated positions, without those that injected faults remove.

    Attributes
    ----------
    position_m : ndarray, shape (n, 3)
        Measured position, NED.
    velocity_m_s : ndarray, shape (n, 3), or None
        Velocity measured by GNSS, NED; None for UWB and VIO.
    measurement_times_s : ndarray, shape (n,)
        True times of measurement (s from the first sample).
    distance_m : float
        Horizontal distance flown.
    drift_m : ndarray, shape (3,)
        VIO drift at the end, NED.
    """

    topic: Topic
    is_outlier: BoolArray
    position_m: Array
    velocity_m_s: Array | None
    measurement_times_s: Array
    distance_m: float
    drift_m: Array

    @property
    def outlier_times_s(self) -> Array:
        """Timestamps (s from the first sample) of the positions that are outliers."""
        return to_seconds(get_time_us(self.topic, "timestamp_sample")[self.is_outlier])


def draw_imu_biases(scenario: Scenario, faults: FaultSizes) -> tuple[Array, Array]:
    """Return accelerometer (m/s²) and gyro (rad/s) biases, body FRD, each of shape (3,)."""
    rng = make_random_generator(scenario, RandomStream.IMU_BIAS)
    accelerometer_bias_m_s2 = rng.normal(0.0, scenario.accel_bias_sigma_m_s2, 3)
    accelerometer_bias_m_s2[0] += faults.accel_bias_m_s2
    return accelerometer_bias_m_s2, rng.normal(0.0, scenario.gyro_bias_sigma_rad_s, 3)


def simulate_imu(scenario: Scenario, faults: FaultSizes, motion: Motion) -> Topic:
    """Simulate sensor_combined (accelerometer and gyro) at the full rate, without gaps."""
    time_us = _make_sample_times_us(motion, scenario.imu_rate_hz)
    specific_force_m_s2, rate_rad_s = simulate_imu_samples(
        scenario, faults, motion, to_seconds(time_us), RandomStream.IMU_NOISE
    )
    vibration_sigma_m_s2 = faults.vibration_m_s2 * np.sqrt(DT_S * scenario.imu_rate_hz)
    specific_force_m_s2 += vibration_sigma_m_s2 * make_random_generator(
        scenario, RandomStream.VIBRATION
    ).standard_normal(specific_force_m_s2.shape)
    interval_us = round(1e6 / scenario.imu_rate_hz)
    sample_fields: dict[str, Any] = {
        "timestamp": _to_boot_time_us(time_us),
        "gyro_rad": rate_rad_s,
        "gyro_integral_dt": interval_us,
        "accelerometer_m_s2": specific_force_m_s2,
        "accelerometer_integral_dt": interval_us,
    }
    return make_topic("sensor_combined", sample_fields)


def simulate_magnetometer(scenario: Scenario, faults: FaultSizes, motion: Motion) -> Topic:
    """Simulate vehicle_magnetometer: the earth's field (gauss, body FRD) with white noise."""
    time_us = _make_sample_times_us(motion, MAGNETOMETER_RATE_HZ)
    time_s = to_seconds(time_us)
    body_to_ned = motion.compute_body_to_ned(time_s)
    # To simulate a heading error of EKF2, rotate the magnetic field that the magnetometer measures
    if faults.heading_deg:
        body_to_ned = simulate_attitude_error(scenario, faults, time_s).as_matrix() @ body_to_ned
    field_gauss = np.einsum("nji,j->ni", body_to_ned, EARTH_FIELD_GAUSS)
    field_gauss += SIGMA_MAGNETOMETER_GAUSS * make_random_generator(
        scenario, RandomStream.MAGNETOMETER_NOISE
    ).standard_normal(field_gauss.shape)
    disturbance_start_s = motion.duration_s / 2.0 if faults.mag_at_s is None else faults.mag_at_s
    field_gauss[time_s >= disturbance_start_s, 1] += faults.mag_gauss
    return make_topic(
        "vehicle_magnetometer", make_timestamps(time_us) | {"magnetometer_ga": field_gauss}
    )


def simulate_barometer(scenario: Scenario, motion: Motion) -> Topic:
    """Simulate vehicle_air_data: height above sea level (m) with slow error and white noise."""
    time_us = _make_sample_times_us(motion, BAROMETER_RATE_HZ)
    time_s = to_seconds(time_us)
    height_m = HOME_POSITION[2] - motion.compute_true_state(time_s).position_m[:, 2]
    height_m -= simulate_height_error(scenario, time_s)
    rng = make_random_generator(scenario, RandomStream.BAROMETER_NOISE)
    height_m += SIGMA_BAROMETER_M * rng.standard_normal(len(time_us))
    return make_topic("vehicle_air_data", make_timestamps(time_us) | {"baro_alt_meter": height_m})


def simulate_height_error(scenario: Scenario, time_s: Array) -> Array:
    """Simulate the slow error (m, positive downward) of the barometer and of EKF2's height."""
    rng = make_random_generator(scenario, RandomStream.HEIGHT_ERROR)
    height_error_rms_m = np.array([HEIGHT_ERROR_RMS_M])
    return Sines.draw(rng, height_error_rms_m, SLOW_ERROR_PERIOD_RANGE_S).compute_values(time_s)[0][
        :, 0
    ]


def limit_rate(full_rate_topic: Topic, rate_hz: float, is_kept: BoolArray | bool = True) -> Topic:
    """Return the messages that a logger with a rate limit (Hz) writes; 0 is no limit."""
    is_logged = is_kept_at_rate(to_seconds(get_time_us(full_rate_topic)), rate_hz) & is_kept
    logged_fields = {name: values[is_logged] for name, values in full_rate_topic.fields.items()}
    return Topic(full_rate_topic.name, logged_fields)


def select_logged_imu(full_rate_topic: Topic, faults: FaultSizes, motion: Motion) -> Topic:
    """Return sensor_combined as logged, with the gap and the reduced rate of ``faults``."""
    return limit_rate(
        full_rate_topic,
        faults.imu_rate_hz,
        _is_outside_gap(
            to_seconds(get_time_us(full_rate_topic)),
            faults.imu_dropout_s,
            faults.imu_dropout_at_s,
            motion.duration_s,
        ),
    )


def get_time_us(topic: Topic, field: str = "timestamp") -> IntArray:
    """Return the times of a topic in µs from the first sample."""
    return topic.fields[field].astype(np.int64) - FIRST_TIMESTAMP_US


def simulate_imu_samples(
    scenario: Scenario,
    faults: FaultSizes,
    motion: Motion,
    time_s: Array,
    random_stream: RandomStream,
    samples_per_average: float = 1.0,
) -> ArrayPair:
    """Simulate specific force (m/s²) and angular rate (rad/s), with bias and white noise.

    The noise is that of a mean over ``samples_per_average`` samples.
    """
    truth = compute_attitude_and_imu(motion.compute_true_state(time_s))
    rng = make_random_generator(scenario, random_stream)
    accelerometer_bias_m_s2, gyro_bias_rad_s = draw_imu_biases(scenario, faults)

    noise_factor = 1.0 / np.sqrt(samples_per_average)
    accelerometer_noise, gyro_noise = rng.standard_normal((2, len(time_s), 3))
    return (
        truth.specific_force_m_s2
        + accelerometer_bias_m_s2
        + noise_factor * scenario.accelerometer_noise_m_s2 * accelerometer_noise,
        truth.angular_rate_rad_s
        + gyro_bias_rad_s
        + noise_factor * scenario.gyro_noise_rad_s * gyro_noise,
    )


def simulate_logged_attitude(scenario: Scenario, faults: FaultSizes, motion: Motion) -> Topic:
    """Simulate vehicle_attitude without the EKF2 model: true attitude with a slow error."""
    time_us = _make_sample_times_us(motion, scenario.attitude_rate_hz)
    time_s = to_seconds(time_us)
    error_rotation = simulate_attitude_error(scenario, faults, time_s).as_matrix()
    logged_quaternions = to_quaternions(error_rotation @ motion.compute_body_to_ned(time_s))
    return make_attitude_topic("vehicle_attitude", time_us, ATTITUDE_LATENCY_US, logged_quaternions)


def simulate_true_attitude(scenario: Scenario, motion: Motion) -> Topic:
    time_us = _make_sample_times_us(motion, scenario.truth_rate_hz)
    truth = to_quaternions(motion.compute_body_to_ned(to_seconds(time_us)))
    return make_attitude_topic("vehicle_attitude_groundtruth", time_us, 0, truth)


def to_quaternions(body_to_ned: Array) -> Array:
    return Rotation.from_matrix(body_to_ned).as_quat(scalar_first=True)


def make_attitude_topic(name: str, time_us: IntArray, delay_us: int, quaternion: Array) -> Topic:
    """Make an attitude topic that is published ``delay_us`` (µs) after the measurement."""
    return make_topic(name, make_timestamps(time_us, delay_us) | {"q": quaternion})


def simulate_attitude_error(scenario: Scenario, faults: FaultSizes, time_s: Array) -> Rotation:
    """Simulate the error of the logged attitude, a rotation in NED."""
    tilt_rms_deg = scenario.tilt_error_deg
    rms_attitude_error_rad = np.radians([tilt_rms_deg, tilt_rms_deg, scenario.yaw_error_deg])
    rng = make_random_generator(scenario, RandomStream.ATTITUDE_ERROR)
    error_rad = Sines.draw(rng, rms_attitude_error_rad, SLOW_ERROR_PERIOD_RANGE_S).compute_values(
        time_s
    )[0]
    heading_error_rad = np.radians(faults.heading_deg)
    if faults.heading_at_s is not None:
        heading_error_rad *= -np.expm1(
            -np.maximum(time_s - faults.heading_at_s, 0.0) / HEADING_TIME_CONSTANT_S
        )
    error_rad[:, 2] += heading_error_rad
    return Rotation.from_rotvec(error_rad)


def simulate_land_detector(motion: Motion) -> Topic:
    """Simulate vehicle_land_detected, logged once a second and at take-off and landing."""
    take_off_us, touch_down_us = round(motion.take_off_s * 1e6), round(motion.touch_down_s * 1e6)
    time_us = np.union1d(
        np.arange(0, int(motion.duration_s * 1e6), LAND_DETECTOR_INTERVAL_US),
        [take_off_us, touch_down_us],
    )
    is_landed = (time_us < take_off_us) | (time_us >= touch_down_us)
    landed_flags = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), is_landed)
    return make_topic(
        "vehicle_land_detected", {"timestamp": _to_boot_time_us(time_us), **landed_flags}
    )


def simulate_ground_truth(scenario: Scenario, motion: Motion) -> Topic:
    """Simulate vehicle_local_position_groundtruth: true position, velocity, acceleration, yaw."""
    time_us = _make_sample_times_us(motion, scenario.truth_rate_hz)
    state = motion.compute_true_state(to_seconds(time_us))
    fields = make_timestamps(time_us) | split_vectors(
        {"": state.position_m, "v": state.velocity_m_s, "a": state.acceleration_m_s2}
    )
    fields["heading"] = np.angle(np.exp(1j * state.yaw_rad))
    return make_topic("vehicle_local_position_groundtruth", fields)


def simulate_positions(
    scenario: Scenario, faults: FaultSizes, motion: Motion
) -> SimulatedPositions:
    """Simulate positions with injected faults: UWB in an aisle, VIO in a loop, GNSS outdoors.

    The kind of the scenario ("aisle", "loop" or "outdoor") selects the sensor.
    """
    timing_rng = make_random_generator(scenario, RandomStream.POSITION_TIMES)
    interval_s = 1.0 / scenario.source_rate_hz
    position_count = int((motion.duration_s - FIRST_POSITION_TIME_S) / interval_s)
    nominal_times_s = FIRST_POSITION_TIME_S + interval_s * np.arange(position_count)
    # jitter below half an interval keeps the positions in order
    jitter_fraction = np.clip(
        timing_rng.normal(0.0, INTERVAL_JITTER_FRACTION, position_count), -0.4, 0.4
    )
    time_s = np.maximum(nominal_times_s + jitter_fraction * interval_s, 0.0)
    # 2. Measured positions: true position and errors
    state = motion.compute_true_state(time_s)
    speed_m_s = np.hypot(state.velocity_m_s[:, 0], state.velocity_m_s[:, 1])
    distance_m = integrate_cumulatively(speed_m_s, time_s)
    is_loop, is_outdoor = scenario.kind == "loop", scenario.kind == "outdoor"
    drift_m = simulate_vio_drift(scenario, distance_m) * is_loop  # only VIO drifts
    sigma_m = scenario.source_sigma_m * (GNSS_SIGMA_FACTORS if is_outdoor else 1.0)
    noise_m = sigma_m * make_random_generator(
        scenario, RandomStream.POSITION_NOISE
    ).standard_normal(drift_m.shape)
    is_airborne = (time_s > motion.take_off_s) & (time_s < motion.touch_down_s)
    outlier_offset_m, is_outlier = simulate_outliers(scenario, faults, is_airborne)
    position_m = state.position_m + drift_m + noise_m + outlier_offset_m
    position_m += simulate_correlated_noise(scenario, faults, len(time_s), interval_s)
    position_m = _apply_source_faults(position_m, time_s, scenario, faults, motion)
    # 3. Positions that the source sends, and their timestamps
    is_logged = _is_outside_gap(
        time_s, faults.dropout_s, faults.dropout_at_s, motion.duration_s
    ) & is_kept_at_rate(time_s, faults.decimate_hz)
    position_m = position_m[is_logged]
    arrival_times_us, timestamp_us = (
        times_us[is_logged] for times_us in _simulate_position_times_us(faults, time_s, timing_rng)
    )
    # 4. Topic
    reported_sigma_m = compute_reported_sigma_m(scenario, faults)
    velocity_m_s = None
    if is_outdoor:
        rng = make_random_generator(scenario, RandomStream.GNSS_VELOCITY_NOISE)
        velocity_sigma_m_s = scenario.sigma_gnss_m_s * GNSS_SIGMA_FACTORS
        velocity_m_s = (
            state.velocity_m_s + velocity_sigma_m_s * rng.standard_normal(state.velocity_m_s.shape)
        )[is_logged]
        north_m, east_m, down_m = position_m.T
        latitude_deg, longitude_deg = unproject(north_m, east_m, HOME_POSITION[:2])
        # The timestamp is GNSS_DELAY_S later than the measurement
        fields = make_timestamps(timestamp_us + round(1e6 * GNSS_DELAY_S)) | {
            "eph": reported_sigma_m,
            "epv": reported_sigma_m * GNSS_SIGMA_FACTORS[2],
            "s_variance_m_s": scenario.sigma_gnss_m_s,
            "latitude_deg": latitude_deg,
            "longitude_deg": longitude_deg,
            "altitude_msl_m": HOME_POSITION[2] - down_m,
        }
        fields |= {f"vel_{axis}_m_s": velocity_m_s[:, i] for i, axis in enumerate("ned")}
        topic = make_topic(GPS_POSITION_TOPIC, fields)
    else:
        fields = make_timestamps(timestamp_us, arrival_times_us - timestamp_us) | {
            "position": position_m,
            "position_variance": np.full(position_m.shape, reported_sigma_m**2),
        }
        if is_loop:
            fields["q"] = to_quaternions(compute_attitude_and_imu(state).body_to_ned[is_logged])
        topic = make_topic("vehicle_visual_odometry", fields)
    return SimulatedPositions(
        topic=topic,
        is_outlier=is_outlier[is_logged],
        position_m=position_m,
        velocity_m_s=velocity_m_s,
        measurement_times_s=time_s[is_logged],
        distance_m=float(distance_m[-1]),
        drift_m=drift_m[-1],
    )


def _apply_source_faults(
    position_m: Array, time_s: Array, scenario: Scenario, faults: FaultSizes, motion: Motion
) -> Array:
    """Apply the faults of the source in their order: low-pass filter, scale, yaw, and jump.

    The array ``position_m`` is changed. Use the returned array only.
    """
    if faults.smoothed_s:
        decay_factor = np.exp(-1.0 / scenario.source_rate_hz / faults.smoothed_s)
        # with this initial state, the filter starts at the first position
        position_m, _ = lfilter(
            [1.0 - decay_factor],
            [1.0, -decay_factor],
            position_m,
            axis=0,
            zi=decay_factor * position_m[:1],
        )
    position_m *= 1.0 + faults.scale_percent / 100.0
    if faults.yaw_deg:
        position_m = Rotation.from_euler("z", faults.yaw_deg, degrees=True).apply(position_m)
    # Without this fault, jump_m is 0. By default, the jump is after two thirds of the flight
    jump_start_s = motion.duration_s / 1.5 if faults.jump_at_s is None else faults.jump_at_s
    position_m[time_s >= jump_start_s] += faults.jump_m * compute_direction(scenario.heading_deg)
    return position_m


def compute_reported_sigma_m(scenario: Scenario, faults: FaultSizes) -> float:
    """Return the σ (m) that the source reports."""
    # EKF2.cpp limits the reported σ to at least 0.01 m
    return max(scenario.source_sigma_m, 0.01) * float(np.sqrt(faults.r_scale))


def simulate_correlated_noise(
    scenario: Scenario, faults: FaultSizes, sample_count: int, interval_s: float
) -> Array:
    """Simulate time-correlated noise (m), shape (n, 3): a first-order Gauss-Markov process."""
    rng = make_random_generator(scenario, RandomStream.SLOW_POSITION_ERROR)
    noise_m = rng.standard_normal((sample_count, 3)) * faults.slow_error_m
    decay_factor = np.exp(-interval_s / faults.slow_error_s)
    noise_m[1:] *= np.sqrt(1.0 - decay_factor**2)
    return lfilter([1.0], [1.0, -decay_factor], noise_m, axis=0)


def simulate_vio_drift(scenario: Scenario, distance_m: Array) -> Array:
    """Simulate the VIO drift (m, NED), shape (n, 3): proportional to distance, and random walk."""
    rng = make_random_generator(scenario, RandomStream.VIO_DRIFT)
    drift_per_metre = scenario.vio_drift * compute_direction(rng.uniform(0.0, 360.0))
    sqrt_step_lengths = np.sqrt(np.diff(distance_m, prepend=0.0))[:, None]
    unit_random_walk = np.cumsum(
        sqrt_step_lengths * rng.standard_normal((len(distance_m), 3)), axis=0
    )
    return distance_m[:, None] * drift_per_metre + scenario.vio_walk_m * unit_random_walk


def simulate_outliers(
    scenario: Scenario, faults: FaultSizes, is_airborne: BoolArray
) -> tuple[Array, BoolArray]:
    """Simulate outliers; return the errors (m, NED), shape (n, 3), and a mask of the outliers.

    Outliers occur in bursts in one horizontal direction, as without line of sight.
    """
    outlier_error_m = np.zeros((len(is_airborne), 3))
    is_outlier = np.zeros(len(is_airborne), np.bool_)
    airborne_indices = np.flatnonzero(is_airborne)
    outlier_count = round(len(airborne_indices) * faults.nlos_percent / 100.0)
    if outlier_count == 0:
        return outlier_error_m, is_outlier
    rng = make_random_generator(scenario, RandomStream.NLOS_OUTLIERS)
    burst_count = math.ceil(outlier_count / MEAN_OUTLIER_BURST_POSITION_COUNT)
    # numbers of successive positions: good positions, burst of outliers, good positions, ...,
    # burst, good positions. A burst has at least one outlier
    run_lengths = np.empty(2 * burst_count + 1, np.intp)
    run_lengths[1::2] = 1 + rng.multinomial(
        outlier_count - burst_count, np.full(burst_count, 1.0 / burst_count)
    )
    run_lengths[::2] = rng.multinomial(
        len(airborne_indices) - outlier_count, np.full(burst_count + 1, 1.0 / (burst_count + 1))
    )
    is_burst = np.arange(len(run_lengths)) % 2 == 1
    is_outlier[airborne_indices] = np.repeat(is_burst, run_lengths)
    angle_rad = np.repeat(rng.uniform(0.0, 2.0 * np.pi, burst_count), run_lengths[1::2])
    size_m = faults.nlos_size_m * rng.uniform(0.5, 1.5, outlier_count)
    outlier_error_m[is_outlier, 0] = size_m * np.cos(angle_rad)
    outlier_error_m[is_outlier, 1] = size_m * np.sin(angle_rad)
    return outlier_error_m, is_outlier


def is_kept_at_rate(time_s: Array, rate_hz: float) -> BoolArray:
    """Return a mask of samples that a logger with a rate limit (Hz) writes; 0: no limit."""
    if rate_hz <= 0.0:
        return np.ones(len(time_s), np.bool_)
    # 1e-6 prevents rounding errors at the edges of logging intervals
    return np.diff(np.floor(time_s * rate_hz + 1e-6), prepend=-1.0) > 0.0


def _simulate_position_times_us(
    faults: FaultSizes, time_s: Array, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return arrival time and timestamp of each position, both in µs from the first sample."""
    # Before TIMESYNC converges, PX4 uses the arrival time as timestamp. The timestamps jump by the
    # latency when it converges, so a long latency simulates a clock jump
    mean_latency_s = faults.clock_jump_s or POSITION_LATENCY_S
    latency_s = np.maximum(
        rng.normal(mean_latency_s, POSITION_LATENCY_SIGMA_S, len(time_s)), MIN_POSITION_LATENCY_S
    )
    arrival_times_us = np.maximum.accumulate(np.rint((time_s + latency_s) * 1e6).astype(np.int64))
    offset_s = faults.clock_offset_s + faults.clock_drift_ppm * 1e-6 * time_s
    timestamp_us = np.rint((time_s + offset_s) * 1e6).astype(np.int64)
    if faults.clock_jump_s:
        is_unsynchronised = time_s < TIMESYNC_CONVERGENCE_TIME_S
        timestamp_us[is_unsynchronised] = arrival_times_us[is_unsynchronised]
    return arrival_times_us, timestamp_us


def _is_outside_gap(
    time_s: Array, gap_s: float, gap_start_s: float | None, duration_s: float
) -> BoolArray:
    """Return a mask of times outside a gap; by default the gap is in the middle of the flight."""
    start_s = (duration_s - gap_s) / 2.0 if gap_start_s is None else gap_start_s
    return (time_s <= start_s) | (time_s >= start_s + gap_s)


def _make_sample_times_us(motion: Motion, rate_hz: float) -> IntArray:
    sample_count = int(motion.duration_s * rate_hz) + 1
    return np.asarray(np.rint(np.arange(sample_count) * (1e6 / rate_hz)), dtype=np.int64)


def to_seconds(time_us: IntArray) -> Array:
    return np.asarray(time_us * 1e-6, dtype=np.float64)


def make_timestamps(time_us: IntArray, delay_us: int | IntArray = 0) -> dict[str, Any]:
    """Return ``timestamp_sample``, and ``timestamp`` (``delay_us`` later)."""
    return {
        "timestamp": _to_boot_time_us(time_us + delay_us),
        "timestamp_sample": _to_boot_time_us(time_us),
    }


def split_vectors(values: Mapping[str, Array]) -> dict[str, Any]:
    """Split vectors into one PX4 field per axis: "v", shape (n, 3), becomes vx, vy and vz."""
    return {
        f"{name}{axis}": vector[:, i]
        for name, vector in values.items()
        for i, axis in enumerate("xyz")
    }


def _to_boot_time_us(time_us: IntArray) -> NDArray[np.uint64]:
    return (FIRST_TIMESTAMP_US + time_us).astype(np.uint64)
