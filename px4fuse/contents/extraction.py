"""A flight as tidy tables, each column described in a data dictionary."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.filter.signals import ned_acceleration
from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    VELOCITY_COLUMNS,
    VELOCITY_VARIANCE_COLUMNS,
    Ekf2,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
)
from px4fuse.plain import plain

SCHEMA_NAME = "px4fuse-flight"
SCHEMA_VERSION = "1.0"
DICTIONARY_COLUMNS = ["table", "column", "unit", "frame", "meaning", "source_topic", "clock"]
ACCELERATION_COLUMNS = ["north_m_s2", "east_m_s2", "down_m_s2"]
# What a file name may not hold on some system, or what is awkward in a shell
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
MAX_NAME = 80
NO_POSITION = Unavailable(
    "external position", "the log holds no track", "px4fuse info says what would log one."
)


@dataclass(frozen=True)
class _Column:
    """Name, unit (ASCII, so that every spreadsheet reads it), frame and meaning of a column."""

    name: str
    unit: str
    frame: str
    meaning: str


@dataclass(frozen=True)
class _Table:
    """One table: its columns in order, its data, and where that came from."""

    name: str
    columns: tuple[_Column, ...]
    data: pd.DataFrame
    topics: tuple[str, ...] = ()
    clock: str = ""


def _vector(names: list[str], unit: str, frame: str, meaning: str) -> tuple[_Column, ...]:
    """Columns of one vector, whose directions are the first words of their names."""
    return tuple(
        _Column(name, unit, frame, f"{name.split('_')[0]} component of {meaning}") for name in names
    )


_TIME = _Column("time_s", "s", "", "time since the first sample of data; boot_time_s in "
                "flight.json is that sample's boot time")  # fmt: skip
_IMU = (
    *_vector(SPECIFIC_FORCE_COLUMNS, "m/s^2", "body FRD", "the specific force, not bias corrected"),
    *_vector(ANGULAR_RATE_COLUMNS, "rad/s", "body FRD", "the angular rate, not bias corrected"),
)
_ATTITUDE = tuple(
    _Column(name, "1", "body FRD to NED", f"{name} of the attitude quaternion")
    for name in QUATERNION_COLUMNS
)
_ACCELERATION = _vector(
    ACCELERATION_COLUMNS,
    "m/s^2",
    "NED",
    "the acceleration, gravity removed, at the IMU's own times",
)
_STATE = (
    *_vector(POSITION_COLUMNS, "m", "NED", "EKF2's position as published, resets included"),
    *_vector(VELOCITY_COLUMNS, "m/s", "NED", "EKF2's velocity as published, resets included"),
)
_VARIANCE = (
    *_vector(POSITION_VARIANCE_COLUMNS, "m^2", "NED", "EKF2's position variance"),
    *_vector(VELOCITY_VARIANCE_COLUMNS, "m^2/s^2", "NED", "EKF2's velocity variance"),
)
_INNOVATIONS = (
    _Column("axis", "", "NED", "north, east or down"),
    _Column("innovation_m", "m", "NED", "measurement minus prediction (PX4 logs the opposite)"),
    _Column("innovation_variance_m2", "m^2", "NED", "variance that EKF2 expects of it (S)"),
    _Column("observation_variance_m2", "m^2", "NED", "measurement variance that EKF2 used (R)"),
    _Column("test_ratio", "1", "", "innovation^2 / (gate^2 S); above 1 EKF2 rejects"),
    _Column("fused", "1", "", "1 if EKF2 fused the measurement, else 0"),
    _Column("rejected", "1", "", "1 if EKF2 rejected the measurement, else 0"),
)
_FUSING = (
    _Column("horizontal", "1", "", "1 while EKF2 fuses external vision for horizontal position"),
    _Column("vertical", "1", "", "1 while EKF2 fuses external vision for height"),
    _Column("yaw", "1", "", "1 while EKF2 fuses external vision for yaw"),
)
_RESETS = (
    _Column("quantity", "", "", "position or velocity"),
    *(
        _Column(f"delta_{axis}", "m or m/s", "NED", f"new minus old state, {axis}; 0 if not reset")
        for axis in ("north", "east", "down")
    ),
)
_INSTANCES = (_Column("instance", "1", "", "primary EKF2 instance from this time on"),)
_TRUTH = (
    *_vector(POSITION_COLUMNS, "m", "NED", "the true position"),
    *_vector(VELOCITY_COLUMNS, "m/s", "NED", "the true velocity, empty where not logged"),
)
_AIRBORNE = (_Column("end_s", "s", "", "touch-down; time_s is the take-off"),)
_DROPOUTS = (_Column("duration_s", "s", "", "how long the logger lost data from time_s on"),)
_PARAMETERS = (
    _Column("name", "", "", "PX4 parameter that bears on fusion or logging"),
    _Column("value", "as PX4 says", "", "its value at the log's start"),
)
_CLOCKS = (
    _Column("clock", "", "", "clock that was mapped to the autopilot's boot clock"),
    _Column("method", "", "", "what it was mapped by"),
    _Column("pairs", "1", "", "pairs of readings that the map rests on"),
    _Column("offset_s", "s", "", "boot clock minus this clock, at the middle of the pairs"),
    _Column("drift_ppm", "ppm", "", "how much faster the boot clock runs"),
    _Column("jitter_s", "s", "", "standard deviation of the pairs about the line"),
    _Column("note", "", "", "what to keep in mind"),
    _Column("distinct_stamps", "1", "", "values that stamps take which do not tell the time"),
)


def tables(flight: Flight) -> Mapping[str, pd.DataFrame]:
    """Everything in a flight as tidy tables: one row per sample, one documented unit per column.

    Returns
    -------
    mapping from table name to DataFrame
        The first column of a time series is ``time_s``. Names are safe as file names. Parts that
        are unavailable have no table; see :func:`absent`.
    """
    return {
        table.name: table.data[[column.name for column in table.columns]]
        for table in _tables(flight)
    }


def data_dictionary(flight: Flight) -> pd.DataFrame:
    """One row per column of every table, in order.

    Returns
    -------
    DataFrame
        Columns table, column, unit, frame, meaning, source_topic, clock.
    """
    return pd.DataFrame(
        [
            (
                table.name, column.name, column.unit, column.frame, column.meaning,
                " ".join(table.topics), table.clock,
            )
            for table in _tables(flight)
            for column in table.columns
        ],
        columns=DICTIONARY_COLUMNS,
    )  # fmt: skip


def absent(flight: Flight) -> tuple[Unavailable, ...]:
    """Parts of the flight that have no table, and why."""
    ekf2 = flight.ekf2
    parts: list[object] = [flight.imu, flight.attitude, ekf2, flight.truth, flight.airborne]
    if isinstance(ekf2, Ekf2):
        parts += [ekf2.variance, *ekf2.innovations.values(), ekf2.fusing]
    if not any(isinstance(part, Unavailable) for part in (flight.imu, flight.attitude)):
        parts.append(ned_acceleration(flight))
    found = [part for part in parts if isinstance(part, Unavailable)]
    if not flight.positions:
        found.append(NO_POSITION)
    return tuple(dict.fromkeys(found))


def description(flight: Flight) -> dict[str, Any]:
    """What the log is and what is missing from it, for JSON: what is not known is absent."""
    ekf2 = flight.ekf2
    about: dict[str, Any] = {
        "schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION},
        "log": flight.log,
        "streams": flight.streams,
        "positions": [
            {
                "table": table,
                "name": track.name,
                "kind": track.origin.kind,
                "passage": track.origin.passage,
                "description": track.description,
                "frame": track.frame,
                "clock": track.clock,
                "reconstructed": track.origin.reconstructed,
                "topics": track.topics,
                "log": track.log,
                "alignment": track.alignment,
            }
            for table, track in _named_tracks(flight)
        ],
        "ekf2": {"gate": ekf2.gate, "notes": ekf2.notes} if isinstance(ekf2, Ekf2) else None,
        "clocks": flight.clocks,
        "missing": tuple(dict.fromkeys((*absent(flight), *flight.missing))),
        "unused": flight.unused,
        "inputs": flight.inputs,
    }
    data: dict[str, Any] = plain(about)
    return data


def _tables(flight: Flight) -> Iterator[_Table]:
    yield from _series(flight, "imu", flight.imu, _IMU)
    yield from _series(flight, "attitude", flight.attitude, _ATTITUDE)
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, pd.DataFrame):
        data = acceleration.set_axis(ACCELERATION_COLUMNS, axis=1)
        (imu, clock), (attitude, _) = _origin(flight, "imu"), _origin(flight, "attitude")
        yield _timed("acceleration_ned", _ACCELERATION, data, (*imu, *attitude), clock)
    for name, track in _named_tracks(flight):
        yield _position(name, track)
    if isinstance(flight.ekf2, Ekf2):
        yield from _ekf2(flight, flight.ekf2)
    if isinstance(flight.truth, Truth):
        yield from _series(flight, "truth", flight.truth.samples, _TRUTH)
    if not isinstance(flight.airborne, Unavailable):
        spans = pd.DataFrame(list(flight.airborne), columns=["time_s", "end_s"], dtype=np.float64)
        yield _Table("airborne", (_TIME, *_AIRBORNE), spans,
                     *_origin(flight, "airborne"))  # fmt: skip
    if flight.log.dropouts:
        rows = [(dropout.start_s, dropout.duration_s) for dropout in flight.log.dropouts]
        lost = pd.DataFrame(rows, columns=["time_s", "duration_s"], dtype=np.float64)
        yield _Table("dropouts", (_TIME, *_DROPOUTS), lost)
    if flight.log.parameters:
        values = pd.DataFrame(list(flight.log.parameters.items()), columns=["name", "value"])
        yield _Table("parameters", _PARAMETERS, values)
    if flight.clocks:
        mapped = pd.DataFrame([structs.asdict(clock) for clock in flight.clocks])
        mapped = mapped.astype({"distinct_stamps": np.float64})  # NaN where they do tell it
        yield _Table("clocks", _CLOCKS, mapped)


def _ekf2(flight: Flight, ekf2: Ekf2) -> Iterator[_Table]:
    yield from _series(flight, "ekf2_state", ekf2.state, _STATE)
    yield from _series(flight, "ekf2_variance", ekf2.variance, _VARIANCE)
    frames = [
        frame.assign(axis=axis)
        for axis, frame in ekf2.innovations.items()
        if isinstance(frame, pd.DataFrame)
    ]
    if frames:
        tidy = pd.concat(frames).sort_index(kind="stable")
        yield from _series(flight, "ekf2_innovations", tidy, _INNOVATIONS)
    yield from _series(flight, "ekf2_fusing", ekf2.fusing, _FUSING)
    topics, clock = _origin(flight, "ekf2_state")
    resets = pd.DataFrame(
        [(reset.time_s, reset.quantity, *reset.delta) for reset in ekf2.resets],
        columns=["time_s", *(column.name for column in _RESETS)],
    ).astype(dict.fromkeys(("time_s", "delta_north", "delta_east", "delta_down"), np.float64))
    yield _Table("resets", (_TIME, *_RESETS), resets, topics, clock)
    # the first instance holds from the beginning, which a reader stamps minus infinity
    begin = min(float(ekf2.state.index[0]), 0.0)
    instances = pd.DataFrame(
        [(max(time, begin), number) for time, number in ekf2.instances],
        columns=["time_s", "instance"],
    ).astype({"time_s": np.float64, "instance": np.int64})
    yield _Table("instances", (_TIME, *_INSTANCES), instances, topics, clock)


def _series(
    flight: Flight, name: str, data: pd.DataFrame | Unavailable, columns: tuple[_Column, ...]
) -> Iterator[_Table]:
    """A time series that is named as its stream; nothing where it is unavailable."""
    if isinstance(data, pd.DataFrame):
        yield _timed(name, columns, data, *_origin(flight, name))


def _timed(
    name: str, columns: tuple[_Column, ...], data: pd.DataFrame, topics: tuple[str, ...], clock: str
) -> _Table:
    """Table of a frame that is indexed by time."""
    wanted = data.reindex(columns=[column.name for column in columns])
    series = wanted.rename_axis("time_s").reset_index()
    return _Table(name, (_TIME, *columns), series, topics, clock)


def _named_tracks(flight: Flight) -> Iterator[tuple[str, PositionTrack]]:
    """Every position track with the name of its table, each name once whatever its case."""
    taken: set[str] = set()
    for track in flight.positions:
        # the first word is ours, so that none of the names that Windows reserves can result
        stem = _UNSAFE.sub("_", f"position_{track.name}")[:MAX_NAME].rstrip("_")
        name, number = stem, 1
        while name.lower() in taken:
            number += 1
            name = f"{stem}_{number}"
        taken.add(name.lower())
        yield name, track


def _position(name: str, track: PositionTrack) -> _Table:
    columns = (
        *_vector(POSITION_COLUMNS, "m", track.frame, f"the position: {track.description}"),
        *_vector(
            POSITION_VARIANCE_COLUMNS, "m^2", track.frame, "its variance as reported, empty if none"
        ),
    )
    return _timed(name, columns, track.samples, track.topics, track.clock)


def _origin(flight: Flight, part: str) -> tuple[tuple[str, ...], str]:
    """Topics and clock that a part was read from."""
    stream = flight.streams.get(part)
    return ((), "") if stream is None else (stream.topics, stream.clock)
