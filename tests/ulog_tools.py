"""Write small ULog files with chosen topics, in the formats of several PX4 releases.

The flight is straight, level and at constant speed, so all values have a closed form:
:func:`position` is EKF2's state and :func:`ev_error` is external vision minus that state.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from exchange import replace
from numpy.typing import ArrayLike, NDArray
from pyulog import ULog

from px4fuse.core.arrays import Array
from px4fuse.simulation.ulog_writer import Topic, encode_ulog

START_US = 5_000_000
PUBLICATION_LAG_US = 60_000
GRAVITY = 9.80665
GENERATIONS = ("v1.9", "v1.11", "v1.12", "v1.14", "v1.15", "v1.16")
# (states, covariances): lengths of the arrays of EKF2 states by release
LENGTHS = {"v1.15": (24, 23), "v1.16": (25, 24)}
INNOVATION_VARIANCE = np.array([0.05, 0.06, 0.07])
EV_VARIANCE = np.array([0.01, 0.02, 0.03])
VELOCITY = np.array([0.5, -0.25, 0.0])
AXES = ("north", "east", "down")


@dataclass
class Log:
    """Content of a ULog file."""

    topics: list[Topic]
    parameters: dict[str, int | float] = field(default_factory=dict)
    info: dict[str, int | str] = field(default_factory=dict)
    dropouts_ms: tuple[int, ...] = ()

    def __getitem__(self, name: str) -> dict[str, NDArray]:
        """Return the fields of the first topic with this name."""
        return next(topic.fields for topic in self.topics if topic.name == name)

    def names(self) -> set[str]:
        return {topic.name for topic in self.topics}

    def drop(self, *names: str) -> Log:
        """Remove topics; the names must exist."""
        assert set(names) <= self.names()
        self.topics = [topic for topic in self.topics if topic.name not in names]
        return self

    def add(self, *topics: Topic) -> Log:
        self.topics.extend(topics)
        return self

    def rename(self, old: str, new: str) -> Log:
        self.topics = [replace(t, name=new) if t.name == old else t for t in self.topics]
        return self

    def write(self, path: Path) -> Path:
        path.write_bytes(self.encode())
        return path

    def encode(self) -> bytes:
        """Return the file content; a repeated topic gets two subscriptions."""
        dropouts = (struct.pack("<HcH", 2, b"O", length) for length in self.dropouts_ms)
        return encode_ulog(self.topics, self.parameters, self.info, START_US) + b"".join(dropouts)


def load(path: Path) -> Log:
    """Read a ULog file as topics that can be edited, without nested and padding fields."""
    ulog = ULog(str(path))
    topics = []
    for data in ulog.data_list:
        fields: dict[str, list[NDArray] | NDArray] = {}
        for name, values in data.data.items():
            match = re.fullmatch(r"(\w+)\[(\d+)\]", name)
            if match:
                fields.setdefault(match[1], []).append(values)
            elif re.fullmatch(r"\w+", name):
                fields[name] = values
        arrays = {
            name: np.stack(values, axis=1) if isinstance(values, list) else values
            for name, values in fields.items()
        }
        topics.append(Topic(data.name, arrays, data.multi_id))
    parameters = dict(ulog.initial_parameters)
    info = {
        name: value
        for name, value in ulog.msg_info_dict.items()
        if name in ("sys_name", "ver_hw", "ver_sw", "ver_sw_release")
    }
    return Log(topics, parameters, info)


def position(time_s: ArrayLike) -> Array:
    """Return EKF2's position (north, east, down, m); ``time_s`` is since the first sample."""
    return np.array([1.0, 2.0, -1.5]) + np.outer(time_s, VELOCITY)


def ev_error(time_s: ArrayLike) -> Array:
    """Return external vision minus EKF2's position (m), which is the innovation."""
    t = np.asarray(time_s, dtype=np.float64)
    return np.stack([0.1 * np.sin(1.3 * t), 0.08 * np.cos(0.7 * t), 0.05 * np.sin(2 * t)], axis=1)


def stamps(seconds: float, rate_hz: float, first_s: float = 0.0) -> NDArray[np.uint64]:
    """Return boot times (µs) at a fixed rate."""
    count = round((seconds - first_s) * rate_hz)
    return (START_US + np.round((first_s + np.arange(count) / rate_hz) * 1e6)).astype(np.uint64)


def seconds_of(stamps_us: NDArray[np.uint64]) -> Array:
    return (stamps_us.astype(np.float64) - START_US) * 1e-6


def topic(
    name: str,
    measured_us: NDArray[np.uint64],
    fields: Mapping[str, ArrayLike],
    *,
    sampled: bool = False,
    instance: int = 0,
) -> Topic:
    """Make a topic; float64 values become float32 fields.

    ``sampled`` topics have the measurement time in ``timestamp_sample`` and are published
    :data:`PUBLICATION_LAG_US` later.
    """
    lag = np.uint64(PUBLICATION_LAG_US if sampled else 0)
    arrays: dict[str, NDArray] = {"timestamp": measured_us + lag}
    if sampled:
        arrays["timestamp_sample"] = measured_us.copy()
    for key, values in fields.items():  # copies: a test may change one topic alone
        array = np.array(values)
        arrays[key] = array.astype(np.float32) if array.dtype == np.float64 else array
    return Topic(name, arrays, instance)


def make_log(generation: str = "v1.16", seconds: float = 10.0, imu_hz: float = 100.0) -> Log:
    """Make the log of the flight by a PX4 release, with external vision fused at 5 Hz."""
    assert generation in GENERATIONS
    number = int(generation.removeprefix("v1."))
    imu = stamps(seconds, imu_hz)
    attitude = stamps(seconds, 20.0)
    log = Log(
        [
            topic("sensor_combined", imu, {
                "gyro_rad": np.zeros((len(imu), 3)),
                "accelerometer_timestamp_relative": np.zeros(len(imu), np.int32),
                "accelerometer_m_s2": np.tile([0.0, 0.0, -GRAVITY], (len(imu), 1)),
            }),
            topic("vehicle_attitude", attitude, {
                "q": np.tile([1.0, 0.0, 0.0, 0.0], (len(attitude), 1)),
            }),
            local_position(seconds, sampled=number >= 12),
            topic("vehicle_land_detected", stamps(seconds, 1.0), {
                "landed": np.isin(
                    np.arange(round(seconds)), (0, round(seconds) - 1)
                ).astype(np.uint8),
            }),
            odometry("vehicle_visual_odometry", seconds, number),
            *states(seconds, generation),
            *innovations(seconds, number),
        ],
        {"EKF2_EN": 1, "EKF2_EVP_GATE": 5.0, "EKF2_EV_DELAY": 0.0, "SDLOG_PROFILE": 129},
        {
            "sys_name": "PX4",
            "ver_hw": "TEST",
            "ver_sw": "0123456789abcdef",
            "ver_sw_release": 1 << 24 | number << 16 | 255,
        },
    )  # fmt: skip
    if number == 12:
        log.add(odometry("estimator_visual_odometry_aligned", seconds, number))
    return log


def gnss_log(generation: str) -> Log:
    """Make a log in which EKF2 fuses GNSS position at 5 Hz and no external vision."""
    log, number = make_log(generation, seconds=20.0), int(generation.removeprefix("v1."))
    vision = ("visual", "aid_src_ev", "innovation", "status_flags")
    log.drop(*(name for name in log.names() if any(part in name for part in vision)))
    at = stamps(20.0, 5.0)
    logged = 0.3 * np.random.default_rng(3).normal(size=(len(at), 2))
    second = stamps(20.0, 1.0)
    if number >= 14:
        log.add(
            topic("estimator_aid_src_gnss_pos", at, {
                "innovation": logged, "innovation_variance": np.full((len(at), 2), 0.25),
                "observation_variance": np.full((len(at), 2), 0.16),
                "test_ratio": logged**2 / (25.0 * 0.25), "fused": np.ones(len(at), np.bool_),
                "innovation_rejected": np.zeros(len(at), np.bool_),
            }, sampled=True),
            topic("estimator_status_flags", second, {
                "cs_gps" if number < 16 else "cs_gnss_pos": np.ones(len(second), np.bool_),
                "cs_ev_pos": np.zeros(len(second), np.bool_),
                "cs_ev_hgt": np.zeros(len(second), np.bool_),
                "cs_ev_yaw": np.zeros(len(second), np.bool_),
            }),
        )  # fmt: skip
        return log
    if "estimator_status" not in log.names():
        log.add(topic("estimator_status", second, {}))
    status = log["estimator_status"]
    status["control_mode_flags"] = np.full(len(status["timestamp"]), 1 << 2, np.uint64)
    if number <= 10:
        rest = np.zeros((len(at), 3))
        log.add(topic("ekf2_innovations", at, {
            "vel_pos_innov": np.hstack([rest, logged, rest[:, :1]]),
            "vel_pos_innov_var": np.full((len(at), 6), 0.25),
        }))  # fmt: skip
        return log
    twice = np.repeat(np.arange(len(at)), 2)
    late = np.tile(np.array([0, 100_000], np.uint64), len(at))
    for name, values in (("s", logged), ("_variances", np.full((len(at), 2), 0.25))):
        log.add(topic(f"estimator_innovation{name}", at[twice] + late, {
            "gps_hpos": values[twice], "ev_hpos": np.zeros((2 * len(at), 2)),
            "baro_vpos": np.ones(2 * len(at)),
        }, sampled=number >= 12))  # fmt: skip
    return log


def local_position(seconds: float, *, sampled: bool) -> Topic:
    measured = stamps(seconds, 10.0)
    here = position(seconds_of(measured))
    count = len(measured)
    fields: dict[str, ArrayLike] = dict(zip("xyz", here.T, strict=True))
    fields |= {
        name: np.full(count, v) for name, v in zip(("vx", "vy", "vz"), VELOCITY, strict=True)
    }
    for counter in ("xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter"):
        fields[counter] = np.zeros(count, np.uint8)
    fields |= {"delta_xy": np.zeros((count, 2)), "delta_vxy": np.zeros((count, 2))}
    fields |= {"delta_z": np.zeros(count), "delta_vz": np.zeros(count)}
    return topic("vehicle_local_position", measured, fields, sampled=sampled)


def ev_stamps(seconds: float) -> NDArray[np.uint64]:
    """Return the times (µs) of external vision: 5 Hz from 0.1 s."""
    return stamps(seconds, 5.0, 0.1)


def odometry(name: str, seconds: float, number: int) -> Topic:
    """Make an external vision topic in the format before v1.14 (x, y, z) or since (arrays)."""
    measured = ev_stamps(seconds)
    time = seconds_of(measured)
    measurement = position(time) + ev_error(time)
    if number >= 14:
        fields = {
            "position": measurement,
            "position_variance": np.tile(EV_VARIANCE, (len(time), 1)),
            "pose_frame": np.ones(len(time), np.uint8),
        }
    else:
        covariance = np.full((len(time), 21), 99.0)  # off-diagonal values must not be read
        covariance[:, [0, 6, 11]] = EV_VARIANCE
        fields = dict(zip("xyz", measurement.T, strict=True)) | {"pose_covariance": covariance}
        if number >= 11:
            fields["local_frame"] = np.zeros(len(time), np.uint8)
    return topic(name, measured, fields, sampled=number >= 11)


def covariances(count: int) -> Array:
    """Return distinct variances: element i is (i + 1) / 100."""
    return 0.01 * (1 + np.arange(count))


def states(seconds: float, generation: str, instance: int = 0, scale: float = 1.0) -> list[Topic]:
    """Make topics with EKF2's state vector and fusion flags."""
    number = int(generation.removeprefix("v1."))
    measured = stamps(seconds, 2.0)
    count = len(measured)
    state_count, covariance_count = LENGTHS.get(generation, (24, 24))
    fields: dict[str, ArrayLike] = {
        "states": np.zeros((count, state_count)),
        "covariances": np.tile(covariances(covariance_count) * scale, (count, 1)),
    }
    if number < 12:
        fields["control_mode_flags"] = np.full(count, 1 << 12 | 1 << 14, np.uint32)
        return [topic("estimator_status", measured, fields, instance=instance)]
    one, zero = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    flags = {"cs_ev_pos": one, "cs_ev_yaw": zero, "cs_ev_hgt": one}
    return [
        topic("estimator_states", measured, fields, sampled=True, instance=instance),
        topic("estimator_status_flags", measured, flags, sampled=True, instance=instance),
    ]


def innovations(seconds: float, number: int, instance: int = 0, scale: float = 1.0) -> list[Topic]:
    """Make EKF2's external vision innovations with PX4's sign: state minus measurement."""
    measured = ev_stamps(seconds)
    time = seconds_of(measured)
    logged = -ev_error(time) * scale
    variance = np.tile(INNOVATION_VARIANCE, (len(time), 1))
    ratio = logged**2 / (25.0 * variance)
    if number >= 14:
        return _aid_sources(measured, logged, variance, ratio, number, instance)
    if number <= 10:
        empty = np.zeros((len(time), 3))
        fields = {
            "vel_pos_innov": np.hstack([empty, logged]),
            "vel_pos_innov_var": np.hstack([empty, variance]),
        }
        return [topic("ekf2_innovations", measured, fields, instance=instance)]
    # logged at twice the fusion rate, so each value is repeated
    twice = np.repeat(np.arange(len(time)), 2)
    measured = np.repeat(measured, 2) + np.tile(np.array([0, 100_000], np.uint64), len(time))
    largest = np.stack([ratio[:, :2].max(axis=1), np.zeros(len(time)), ratio[:, 2]], axis=1)
    return [
        topic(
            name,
            measured + np.uint64(late_us),
            {"ev_hpos": values[twice, :2], "ev_vpos": values[twice, 2]},
            sampled=number >= 12,
            instance=instance,
        )
        for name, values, late_us in (
            ("estimator_innovations", logged, 0),
            ("estimator_innovation_variances", variance, 2_000),
            ("estimator_innovation_test_ratios", largest, 4_000),
        )
    ]


def _aid_sources(
    measured: NDArray[np.uint64],
    logged: Array,
    variance: Array,
    ratio: Array,
    number: int,
    instance: int,
) -> list[Topic]:
    time = seconds_of(measured)
    observation = position(time) + ev_error(time)
    wide = np.dtype(np.float64) if number >= 16 else np.dtype(np.float32)
    topics = []
    for name, axes in (("estimator_aid_src_ev_pos", slice(0, 2)), ("estimator_aid_src_ev_hgt", 2)):
        made = topic(name, measured, {
            "observation_variance": np.tile(EV_VARIANCE, (len(time), 1))[:, axes],
            "innovation": logged[:, axes],
            "innovation_variance": variance[:, axes],
            "test_ratio": ratio[:, axes],
            "innovation_rejected": np.zeros(len(time), np.bool_),
            "fused": np.ones(len(time), np.bool_),
        }, sampled=True, instance=instance)  # fmt: skip
        made.fields["observation"] = observation[:, axes].astype(wide)
        if number == 14:
            made.fields["fusion_enabled"] = np.ones(len(time), np.bool_)
        topics.append(made)
    return topics


def selector(switches: Sequence[tuple[float, int]]) -> Topic:
    """Make estimator_selector_status from (start time in s, primary instance) pairs."""
    at = np.array([START_US + round(time * 1e6) for time, _ in switches], np.uint64)
    numbers = np.array([number for _, number in switches], np.uint8)
    return topic("estimator_selector_status", at, {"primary_instance": numbers})


def take(topic: Topic, rows: Iterable[int]) -> Topic:
    """Return the topic with only these rows, in this order."""
    rows = np.asarray(list(rows), dtype=np.intp)
    return replace(topic, fields={name: values[rows] for name, values in topic.fields.items()})
