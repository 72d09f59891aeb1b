"""PX4 ULog to :class:`~px4fuse.flight.Flight`, for PX4 v1.9 to today."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    Flight,
    Unavailable,
    finite_rows,
)
from px4fuse.readers.px4_ekf2 import read_ekf2
from px4fuse.readers.px4_positions import read_positions, read_truth
from px4fuse.readers.px4_topics import ATTITUDE, IMU, LAND_DETECTED
from px4fuse.readers.ulog_topics import (
    ACCELEROMETER_OFFSET_INVALID_US,
    Topics,
    increasing,
    read_topics,
)

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"


def read_ulog(path: Path) -> Flight:
    """Read a PX4 ULog.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Flight

    Raises
    ------
    LogError
        The file cannot be read, is no ULog, or holds no usable data.
    """
    topics = read_topics(path)
    imu = _read_imu(topics)
    attitude = _read_attitude(topics)
    ekf2 = read_ekf2(topics)
    positions, missing_positions = read_positions(topics, ekf2)
    truth = read_truth(topics, positions)
    airborne = _read_airborne(topics)
    missing = [part for part in (imu, attitude, ekf2, truth) if isinstance(part, Unavailable)]
    if not isinstance(ekf2, Unavailable):
        parts = (ekf2.variance, *ekf2.innovations.values(), ekf2.fusing)
        missing += [part for part in parts if isinstance(part, Unavailable)]
    dropped = tuple(
        f"{count} samples of {topic} were dropped: their time stamps are zero or go back"
        for (topic, _), count in sorted(topics.dropped.items())
    )
    return Flight(
        log=dataclasses.replace(topics.log, notes=topics.log.notes + dropped),
        imu=imu,
        attitude=attitude,
        positions=positions,
        ekf2=ekf2,
        truth=truth,
        airborne=airborne,
        missing=(*missing, *missing_positions),
    )


def _read_imu(topics: Topics) -> pd.DataFrame | Unavailable:
    layout = topics.find(IMU)
    if layout is None:
        return Unavailable(
            "IMU", "no topic sensor_combined", "Record with SDLOG_PROFILE bit 0 (default)."
        )
    imu = topics.frame(layout)
    if "accelerometer_offset_us" in imu:
        offset_us = imu.pop("accelerometer_offset_us")
        imu = imu[offset_us != ACCELEROMETER_OFFSET_INVALID_US]
        time_us = np.rint(imu.index.to_numpy() * 1e6 + offset_us[imu.index].to_numpy())
        keep = increasing(time_us.astype(np.int64) + topics.zero_us)
        imu = imu.iloc[keep].set_axis(pd.Index(time_us[keep] * 1e-6, name="time_s"))
    columns = SPECIFIC_FORCE_COLUMNS + ANGULAR_RATE_COLUMNS
    imu = finite_rows(imu[columns], columns)
    if len(imu) < 2:
        return Unavailable(
            "IMU",
            f"sensor_combined holds {len(imu)} usable samples",
            "Check that the logger ran while the sensors did.",
        )
    return imu


def _read_attitude(topics: Topics) -> pd.DataFrame | Unavailable:
    layout = topics.find(ATTITUDE)
    if layout is None:
        return Unavailable(
            "attitude", "no topic vehicle_attitude", "Record with SDLOG_PROFILE bit 0 (default)."
        )
    attitude = topics.frame(layout)[QUATERNION_COLUMNS]
    norm: NDArray[np.float64] = np.linalg.norm(attitude.to_numpy(), axis=1)
    attitude = attitude[np.isfinite(norm) & (norm > 0.5)]  # a zero quaternion is no attitude
    if len(attitude) < 2:
        return Unavailable(
            "attitude",
            f"vehicle_attitude holds {len(attitude)} usable samples",
            "Check that the estimator ran while the logger did.",
        )
    return attitude


def _read_airborne(topics: Topics) -> tuple[tuple[float, float], ...] | Unavailable:
    """Stretches of flight by the land detector, each from take-off to touch-down."""
    layout = topics.find(LAND_DETECTED)
    landed = None if layout is None else topics.frame(layout, step=True)["landed"]
    if landed is None or landed.empty:
        return Unavailable(
            "land detector",
            "no usable topic vehicle_land_detected",
            "Record with SDLOG_PROFILE bit 0 (default), or give --start and --end.",
        )
    changes = landed[landed.ne(landed.shift())]
    ends = [*changes.index[1:], topics.log.duration_s]
    return tuple(
        (max(float(start), 0.0), float(end))
        for start, end, value in zip(changes.index, ends, changes, strict=True)
        if value == 0 and end > max(start, 0.0)
    )
