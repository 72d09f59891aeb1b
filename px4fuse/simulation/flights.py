"""Simulated flights as topics, ULog and Flight, and the answer key for the instructor."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from px4fuse.ekf2.inputs import MODEL_NOTE
from px4fuse.ekf2_parameters import EV_POS, GNSS_POS
from px4fuse.errors import SettingsError
from px4fuse.flight import Flight
from px4fuse.readers.ulog import read_ulog
from px4fuse.readers.ulog_topics import NOTE_KEY
from px4fuse.simulation import ekf2, sensors
from px4fuse.simulation.ekf2_topics import MAGNETOMETER_HZ
from px4fuse.simulation.mistakes import MISTAKES, Mistakes, active_mistakes, format_mistake
from px4fuse.simulation.motion import Motion, plan
from px4fuse.simulation.scenario import Scenario
from px4fuse.simulation.ulog_writer import Topic, encode
from px4fuse.text import to_json_types

NO_MISTAKES = Mistakes()
# Parameter values that fuse horizontal positions; for GNSS also velocity (bit 2)
SWITCHED_ON = {EV_POS.switch: 1, GNSS_POS.switch: 5}
PROFILE_WITH_VISION, PROFILE_DEFAULT = 129, 1
RELEASE = 1 << 24 | 16 << 16 | 255  # v1.16.0, the release of the simulated topics
HARDWARE = "px4fuse simulation"
ANSWER_SCHEMA = {"name": "px4fuse-answer", "version": 1}


@dataclass(frozen=True)
class Simulation:
    """Simulated flight: logged topics, and truth for the instructor.

    Attributes
    ----------
    scenario : Scenario
    mistakes : Mistakes
    motion : Motion
        True motion at any time.
    positions : SensedPositions
        Position source with its outliers and errors.
    topics : tuple of Topic
        All logged topics.
    parameters : mapping
    """

    scenario: Scenario
    mistakes: Mistakes
    motion: Motion
    positions: sensors.SensedPositions
    topics: tuple[Topic, ...]
    parameters: Mapping[str, int | float]


def simulate(scenario: Scenario, mistakes: Mistakes = NO_MISTAKES) -> Simulation:
    """Simulate a flight.

    Raises
    ------
    SettingsError
        A mistake does not fit the scenario.
    """
    for name in active_mistakes(mistakes):
        if scenario.kind not in (kinds := MISTAKES[name].kinds):
            raise SettingsError(f"--mistake {name} requires --kind {' or '.join(kinds)}.")
        if MISTAKES[name].of_ekf2 and not scenario.ekf2:
            raise SettingsError(f"--mistake {name} changes EKF2: omit --no-ekf2.")
    if scenario.aid == GNSS_POS and 0.0 < mistakes.ekf2_noise_m < (
        stated_m := sensors.reported_sigma_m(scenario, mistakes)
    ):
        raise SettingsError(
            f"--mistake ekf2-noise={mistakes.ekf2_noise_m:g} has no effect outdoors: "
            f"EKF2 uses the larger of {GNSS_POS.noise} and the receiver's accuracy ({stated_m:g} "
            "m). Use a larger value."
        )
    motion = plan(scenario, mistakes, sensors.random_stream(scenario, sensors.Stream.WANDER))
    positions = sensors.positions(scenario, mistakes, motion)
    imu = sensors.imu(scenario, mistakes, motion)
    parameters = _parameters(scenario, mistakes)
    topics = [
        sensors.logged_imu(imu, mistakes, motion),
        sensors.logged_attitude(scenario, mistakes, motion),
        sensors.land_detector(motion),
    ]
    if not mistakes.no_vvo:
        topics.append(positions.topic)
    others: tuple[Topic, ...] = ()
    if scenario.aid == GNSS_POS:
        barometer = sensors.barometer(scenario, motion)
        others = (sensors.magnetometer(scenario, mistakes, motion), barometer)
        topics += [sensors.limit_rate(others[0], MAGNETOMETER_HZ), barometer]
    if scenario.truth:
        topics.append(sensors.ground_truth(scenario, motion))
    for topic in topics:
        if len(topic.fields["timestamp"]) < 2:
            raise SettingsError(f"These mistakes leave no data in {topic.name}. Reduce them.")
    if scenario.ekf2:
        own = ekf2.simulate_ekf2(scenario, mistakes, motion, imu, positions, others, parameters)
        names = {topic.name for topic in own}
        topics = [*(topic for topic in topics if topic.name not in names), *own]
    if scenario.truth:
        topics.append(sensors.true_attitude(scenario, motion))
    return Simulation(scenario, mistakes, motion, positions, tuple(topics), parameters)


def simulate_flight(scenario: Scenario, mistakes: Mistakes = NO_MISTAKES) -> Flight:
    """Simulate a flight and return it as read from its ULog by :func:`px4fuse.read_log`."""
    return to_flight(simulate(scenario, mistakes))


def to_ulog(simulation: Simulation) -> bytes:
    """Return the flight as a ULog file, without information about the mistakes."""
    info: dict[str, int | str] = {
        "sys_name": "PX4",
        "ver_hw": HARDWARE,
        "ver_sw_release": RELEASE,
        **({NOTE_KEY: MODEL_NOTE} if simulation.scenario.ekf2 else {}),
    }
    return encode(simulation.topics, simulation.parameters, info, sensors.START_US)


def to_flight(simulation: Simulation, name: str = "simulation.ulg") -> Flight:
    """Return the flight as :func:`px4fuse.read_log` reads it from its ULog."""
    return read_ulog(name, to_ulog(simulation))


def _parameters(scenario: Scenario, mistakes: Mistakes) -> dict[str, int | float]:
    used = 0 if mistakes.ekf2_off else SWITCHED_ON[scenario.aid.switch]
    return {
        **ekf2.parameters(scenario, mistakes),
        "EKF2_EN": int(scenario.ekf2),
        **dict.fromkeys(SWITCHED_ON, 0),
        scenario.aid.switch: used,
        "EKF2_HGT_REF": 0,
        "SDLOG_PROFILE": PROFILE_DEFAULT
        if mistakes.no_vvo or scenario.aid == GNSS_POS
        else PROFILE_WITH_VISION,
    }


def answer(simulation: Simulation) -> dict[str, Any]:
    """Return the answer key of the instructor, which the log does not contain, as plain data.

    Keys
    ----
    mistakes
        Name to help and expected finding.
    truth
        Biases, noises, time offset to *add* to the timestamps of the source, outliers by index and
        time in the logged topic, and loop closure error.
    """
    scenario, mistakes = simulation.scenario, simulation.mistakes
    motion, source = simulation.motion, simulation.positions
    accelerometer, gyro = sensors.biases(scenario, mistakes)
    first, last = motion.at(np.array([0.0, motion.duration_s])).position_m
    stamps = source.topic.fields["timestamp_sample"].astype(np.int64) - sensors.START_US
    outlier = np.flatnonzero(source.outlier)
    found: dict[str, Any] = to_json_types(
        {
            "schema": ANSWER_SCHEMA,
            "scenario": asdict(scenario),
            "mistakes": {
                name: {
                    "typed": format_mistake(name, mistakes),
                    "help": MISTAKES[name].help,
                    "finding": MISTAKES[name].finding,
                    **{field: getattr(mistakes, field) for field in MISTAKES[name].sizes},
                }
                for name in active_mistakes(mistakes)
            },
            "truth": {
                "duration_s": motion.duration_s,
                "airborne_s": [motion.take_off_s, motion.touch_down_s],
                "sigma_z_m": scenario.source_sigma_m,
                "sigma_a_m_s2": float(np.hypot(scenario.sigma_a_m_s2, mistakes.vibration_m_s2)),
                "reported_sigma_m": sensors.reported_sigma_m(scenario, mistakes),
                "accelerometer_bias_m_s2": accelerometer.tolist(),
                "gyro_bias_rad_s": gyro.tolist(),
                "clock_offset_to_add_s": 0.0 - mistakes.clock_offset_s,
                "outlier_index": outlier.tolist(),
                "outlier_time_s": (stamps[outlier] * 1e-6).tolist(),
                "path_length_m": source.distance_m,
                "closure_error_m": float(np.linalg.norm((last - first)[:2])),
                "source_drift_m": source.drift_m.tolist(),
            },
        }
    )
    return found
