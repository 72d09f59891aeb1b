"""Simulated flights as PX4 topics, ULog or Flight, and their answer keys."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.core.text import to_json_types
from px4fuse.ekf2.inputs import SIMULATED_EKF2_NOTE
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import GNSS_POS
from px4fuse.flight.model import Flight
from px4fuse.readers.ulog import read_ulog
from px4fuse.readers.ulog_topics import ULOG_ASSIGNMENT_KEY, ULOG_NOTE_KEY

from . import ekf2, sensors
from .faults import FAULT_TYPES, FaultSizes, format_fault, injected_fault_names
from .motion import Motion, plan_flight
from .scenario import Scenario
from .ulog_writer import Topic, encode_ulog

NO_FAULTS = FaultSizes()
# PX4 v1.16.0, whose topics are simulated, as a version number
PX4_RELEASE = 1 << 24 | 16 << 16 | 255
SIMULATION_HARDWARE = "px4fuse simulation"
# Rate limit (Hz) at which PX4 logs vehicle_magnetometer on a vehicle (v1.16, logged_topics.cpp)
MAGNETOMETER_LOG_RATE_HZ = 2.0
ANSWER_SCHEMA = {"name": "px4fuse-answer", "version": 1}


@dataclass(frozen=True)
class Simulation:
    """Simulated flight: logged topics and parameters, injected faults and true motion."""

    scenario: Scenario
    faults: FaultSizes
    motion: Motion
    positions: sensors.SimulatedPositions
    topics: tuple[Topic, ...]
    parameters: Mapping[str, int | float]


def simulate(scenario: Scenario, faults: FaultSizes = NO_FAULTS) -> Simulation:
    """Simulate a flight with injected faults.

    Raises
    ------
    SettingsError
        An injected fault is not possible in this scenario.
    """
    _require_possible_faults(scenario, faults)
    motion = plan_flight(
        scenario,
        faults,
        sensors.make_random_generator(scenario, sensors.RandomStream.PATH_DEVIATION),
    )
    positions = sensors.simulate_positions(scenario, faults, motion)
    imu = sensors.simulate_imu(scenario, faults, motion)
    parameters = ekf2.make_parameters(scenario, faults)
    topics = [
        sensors.select_logged_imu(imu, faults, motion),
        sensors.simulate_logged_attitude(scenario, faults, motion),
        sensors.simulate_land_detector(motion),
    ]
    if not faults.no_vvo:
        topics.append(positions.topic)
    other_sensors: tuple[Topic, ...] = ()
    if scenario.aid == GNSS_POS:
        barometer = sensors.simulate_barometer(scenario, motion)
        magnetometer = sensors.simulate_magnetometer(scenario, faults, motion)
        other_sensors = magnetometer, barometer
        topics += [sensors.limit_rate(magnetometer, MAGNETOMETER_LOG_RATE_HZ), barometer]
    if scenario.truth:
        topics.append(sensors.simulate_ground_truth(scenario, motion))
    for topic in topics:
        if len(topic.fields["timestamp"]) < 2:
            raise SettingsError(
                f"With these injected faults, {topic.name} contains no messages. Inject fewer or "
                "smaller faults."
            )
    if scenario.ekf2:
        ekf2_topics = ekf2.simulate_ekf2(
            scenario, faults, motion, imu, positions, other_sensors, parameters
        )
        # outdoors, EKF2 also computes vehicle_attitude: it replaces the simulated topic
        ekf2_topic_names = {topic.name for topic in ekf2_topics}
        topics = [*(topic for topic in topics if topic.name not in ekf2_topic_names), *ekf2_topics]
    if scenario.truth:
        topics.append(sensors.simulate_true_attitude(scenario, motion))
    return Simulation(scenario, faults, motion, positions, tuple(topics), parameters)


def _require_possible_faults(scenario: Scenario, faults: FaultSizes) -> None:
    """Raise SettingsError if the scenario does not allow a fault, or a fault has no effect."""
    for name in injected_fault_names(faults):
        if scenario.kind not in (kinds := FAULT_TYPES[name].kinds):
            raise SettingsError(f"--mistake {name} requires --kind {' or '.join(kinds)}.")
        if name.startswith("ekf2-") and not scenario.ekf2:
            raise SettingsError(
                f"--mistake {name} changes EKF2, which --no-ekf2 does not simulate. Omit --no-ekf2."
            )
    reported_sigma_m = sensors.compute_reported_sigma_m(scenario, faults)
    if scenario.aid == GNSS_POS and 0.0 < faults.ekf2_noise_m < reported_sigma_m:
        raise SettingsError(
            f"--mistake ekf2-noise={faults.ekf2_noise_m:g} has no effect outdoors: "
            f"EKF2 uses the larger of {GNSS_POS.noise} and the accuracy that the receiver reports "
            f"({reported_sigma_m:g} m). Use a larger value."
        )


def simulate_flight(scenario: Scenario, faults: FaultSizes = NO_FAULTS) -> Flight:
    return to_flight(simulate(scenario, faults))


def to_ulog(simulation: Simulation, *, is_assessed: bool = False) -> bytes:
    """Encode the flight as a ULog file, without information about the injected faults.

    ``is_assessed`` marks the log as a student assignment.
    """
    info: dict[str, int | str] = {
        "sys_name": "PX4",
        "ver_hw": SIMULATION_HARDWARE,
        "ver_sw_release": PX4_RELEASE,
    }
    if simulation.scenario.ekf2:
        info[ULOG_NOTE_KEY] = SIMULATED_EKF2_NOTE
    if is_assessed:
        info[ULOG_ASSIGNMENT_KEY] = 1
    return encode_ulog(simulation.topics, simulation.parameters, info, sensors.FIRST_TIMESTAMP_US)


def to_flight(simulation: Simulation, name: str = "simulation.ulg") -> Flight:
    """Encode a simulated flight as ULog, and read it as :func:`px4fuse.read_log` does."""
    return read_ulog(name, to_ulog(simulation))


def make_answer_key(simulation: Simulation) -> dict[str, Any]:
    """Return injected faults and true values of a flight for the instructor, as JSON types."""
    faults = simulation.faults
    injected_faults = {}
    for name in injected_fault_names(faults):
        fault_type = FAULT_TYPES[name]
        injected_faults[name] = {
            "typed": format_fault(name, faults),
            "help": fault_type.help,
            "finding": fault_type.finding,
            **{field: getattr(faults, field) for field in fault_type.value_field_names},
        }
    answer_key: dict[str, Any] = to_json_types(
        {
            "schema": ANSWER_SCHEMA,
            "scenario": simulation.scenario,
            "mistakes": injected_faults,
            "truth": compute_true_values(simulation),
        }
    )
    return answer_key


def compute_true_values(simulation: Simulation) -> dict[str, float | list[float]]:
    """Return the true values of a simulated flight, such as noises, biases and outlier times.

    The log of the flight does not contain these values.
    """
    scenario, faults = simulation.scenario, simulation.faults
    motion, source = simulation.motion, simulation.positions
    accelerometer_bias_m_s2, gyro_bias_rad_s = sensors.draw_imu_biases(scenario, faults)
    first_position_m, last_position_m = motion.compute_true_state(
        np.array([0.0, motion.duration_s])
    ).position_m
    return {
        "duration_s": motion.duration_s,
        "airborne_s": [motion.take_off_s, motion.touch_down_s],
        "sigma_z_m": scenario.source_sigma_m,
        "sigma_a_m_s2": math.hypot(scenario.sigma_a_m_s2, faults.vibration_m_s2),
        "reported_sigma_m": sensors.compute_reported_sigma_m(scenario, faults),
        "accelerometer_bias_m_s2": accelerometer_bias_m_s2.tolist(),
        "gyro_bias_rad_s": gyro_bias_rad_s.tolist(),
        "clock_offset_to_add_s": 0.0 - faults.clock_offset_s,  # 0.0, not -0.0, without a fault
        "outlier_index": np.flatnonzero(source.is_outlier).tolist(),
        "outlier_time_s": source.outlier_times_s.tolist(),
        "path_length_m": source.distance_m,
        "closure_error_m": float(np.linalg.norm((last_position_m - first_position_m)[:2])),
        "source_drift_m": source.drift_m.tolist(),
    }
