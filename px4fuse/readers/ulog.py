"""Reader of a flight from a PX4 ULog file of PX4 v1.9 or newer."""

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.flight.ekf2_parameters import BAROMETER
from px4fuse.flight.model import (
    Columns,
    Flight,
    Spans,
    TableOrUnavailable,
    Truth,
    Unavailable,
    UnusedData,
    time_index,
)

from . import common
from .px4_ekf2 import read_ekf2
from .px4_positions import FIX_TYPE_3D, barometer, read_positions, read_truth
from .px4_topics import (
    DEFAULT_PROFILE_REMEDY,
    GPS_POSITION_TOPIC,
    IMU_LAYOUT,
    TOPIC_LAYOUTS,
    UNUSED_TOPICS,
    find_track_layouts,
)
from .ulog_topics import (
    Topics,
    describe_dropped_samples,
    find_longest_increasing_subsequence,
    read_topics,
)

INVALID_ACCELEROMETER_OFFSET_US = 0x7FFFFFFF
# Minimum duration (s) of a gap in the IMU data
MIN_IMU_GAP_S = 0.2
# Valid UNIX times (s) of GNSS: from PX4's GPS_EPOCH_SECS (gps_helper.h) to 2100
VALID_UNIX_TIME_RANGE_S = (1_234_567_890.0, 4_102_444_800.0)


def read_ulog(name: str, content: bytes) -> Flight:
    """Read the content of a PX4 ULog file.

    Raises
    ------
    LogError
        The content is not a ULog, or contains no usable data.
    """
    topics = read_topics(name, content)
    imu = _require_samples(
        topics,
        _read_imu(topics),
        "IMU",
        IMU_LAYOUT,
        "Check that the accelerometer and gyroscope were running during logging.",
    )
    attitude_layout = TOPIC_LAYOUTS["vehicle_attitude"]
    attitude = _require_samples(
        topics,
        common.select_rows_with_attitude(topics.read(attitude_layout)),
        "attitude",
        attitude_layout,
        "Check that EKF2 was running during logging (EKF2_EN is 1).",
    )
    ekf2 = read_ekf2(topics)
    positions, unavailable_positions = read_positions(topics, ekf2)
    truth = read_truth(topics, positions, ekf2)
    if isinstance(truth, Truth):
        topics.record_data_source("truth", truth.name)
    airborne_spans_s = _read_airborne_spans(topics)
    altitude_m = topics.read(TOPIC_LAYOUTS["vehicle_air_data"])["altitude_m"]
    barometer_delay_s = topics.ekf2_parameters.get(BAROMETER.delay, 0.0) * 1e-3
    ends_in_flight = common.ends_in_flight(airborne_spans_s, topics.log.duration_s)
    dropped_counts = dict(sorted(topics.dropped.items()))
    # Flags of the failure detector for roll and pitch
    has_excessive_tilt = topics.read(TOPIC_LAYOUTS["failure_detector_status"]).any(axis=1)
    return Flight(
        log=structs.replace(
            topics.log,
            notes=(*topics.log.notes, *describe_dropped_samples(dropped_counts)),
            dropped=dropped_counts,
            start_unix_s=_estimate_start_unix_s(topics),
            damage=_describe_damage(topics, imu, ends_in_flight),
            ends_in_flight=ends_in_flight,
        ),
        imu=imu,
        attitude=attitude,
        positions=positions,
        ekf2=ekf2,
        truth=truth,
        airborne=airborne_spans_s,
        excessive_tilt_spans_s=common.find_spans(has_excessive_tilt, topics.log.duration_s),
        barometer=barometer(altitude_m, barometer_delay_s),
        missing=(*common.collect_unavailable(imu, attitude, ekf2, truth), *unavailable_positions),
        streams=topics.data_source_by_data_kind,
        unused=tuple(
            UnusedData(name, len(table["timestamp"]), reason)
            for name, reason in UNUSED_TOPICS.items()
            if (table := topics.first_table(name))
        ),
    )


def _describe_damage(
    topics: Topics, imu: TableOrUnavailable, ends_in_flight: bool
) -> tuple[str, ...]:
    """Return sentences about damage: the file ends within a message, or has invalid bytes."""
    duration_s = topics.log.duration_s
    damage_sentences = []
    if topics.is_truncated:
        damage_sentences.append(common.format_truncation("message", duration_s, ends_in_flight))
    if topics.is_damaged:
        missing_imu_duration_s = duration_s
        if not isinstance(imu, Unavailable):
            imu_intervals_s = np.diff(imu.index.to_numpy())
            missing_imu_duration_s = float(imu_intervals_s[imu_intervals_s > MIN_IMU_GAP_S].sum())
        damage_sentences.append(
            f"the file is damaged: {missing_imu_duration_s:.1f} s of {duration_s:.1f} s of IMU "
            "data are missing"
        )
    return tuple(damage_sentences)


def _estimate_start_unix_s(topics: Topics) -> float | None:
    """Return the UNIX time (s) at flight time zero, from GNSS; None if not logged."""
    fixes = topics.read(*find_track_layouts(GPS_POSITION_TOPIC))
    fixes = fixes.reindex(columns=["utc_us", "fix_type"])
    unix_time_s = fixes["utc_us"] * 1e-6
    is_valid = unix_time_s.between(*VALID_UNIX_TIME_RANGE_S) & ~(fixes["fix_type"] < FIX_TYPE_3D)
    return float((unix_time_s - fixes.index)[is_valid].median()) if is_valid.any() else None


def _require_samples(
    topics: Topics, samples: pd.DataFrame, data_kind: str, layout: common.MessageLayout, remedy: str
) -> TableOrUnavailable:
    """Return the samples of a topic, or the reason if there are fewer than two."""
    topic = layout.topic
    if topics.find_layout(layout) is None:
        return Unavailable(data_kind, f"{topic} is not logged", DEFAULT_PROFILE_REMEDY)
    if len(samples) < 2:
        return Unavailable(
            data_kind, f"{topic} contains only {len(samples)} usable samples", remedy
        )
    topics.record_data_source(data_kind.lower(), topic)
    return samples


def _read_imu(topics: Topics) -> pd.DataFrame:
    """Read the valid IMU samples, with the measurement times of the accelerometer."""
    imu = topics.read(IMU_LAYOUT)
    # single arrays, because a copy of the whole table needs much memory
    columns = {name: values.to_numpy() for name, values in imu.items()}
    offset_us = columns.pop("accelerometer_offset_us", np.zeros(len(imu)))
    is_valid = offset_us != INVALID_ACCELEROMETER_OFFSET_US
    for name in Columns.SPECIFIC_FORCE + Columns.ANGULAR_RATE:
        is_valid &= np.abs(columns[name]) < common.MAX_IMU_READING
    rows = np.flatnonzero(is_valid)
    # Boot times, because find_longest_increasing_subsequence needs positive times
    boot_clock_us = np.rint(
        imu.index.to_numpy()[rows] * 1e6 + offset_us[rows] + topics.time_origin_us
    )
    kept_rows = find_longest_increasing_subsequence(boot_clock_us.astype(np.int64))
    time_s = (boot_clock_us[kept_rows] - topics.time_origin_us) * 1e-6
    rows = rows[kept_rows]
    samples = np.empty((len(columns), len(rows)), np.float32)  # as in the log, to save memory
    for row, values in zip(samples, columns.values(), strict=True):
        row[:] = values[rows]
    return pd.DataFrame(samples.T, time_index(time_s), list(columns), copy=False)


def _read_airborne_spans(topics: Topics) -> Spans | Unavailable:
    """Return the time spans of flight, from PX4's land detector; Unavailable if not logged."""
    land_detected = topics.read(TOPIC_LAYOUTS["vehicle_land_detected"])
    if land_detected.empty:
        return Unavailable(
            "land detector",
            "vehicle_land_detected is not logged or not usable",
            f"{DEFAULT_PROFILE_REMEDY} Or give the start and end of the flight (--start, --end).",
        )
    topics.record_data_source("airborne", "vehicle_land_detected")
    return common.find_spans(land_detected["landed"] == 0.0, topics.log.duration_s)
