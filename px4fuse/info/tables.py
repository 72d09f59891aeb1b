"""Tables of a flight for ``px4fuse extract``, with descriptions of all columns."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.comparison.preparation import choose_source, select_source_innovations
from px4fuse.core.text import to_json_types
from px4fuse.errors import MissingDataError
from px4fuse.filter.signals import compute_ned_acceleration, imu_and_attitude
from px4fuse.flight.model import (
    AXIS_NAMES,
    BODY_AXES,
    Columns,
    DataSource,
    Ekf2,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
)

SCHEMA_NAME = "px4fuse-flight"
SCHEMA_VERSION = "1.0"
# Placeholders in columns.csv, and the names that replace them
NAMES_BY_PLACEHOLDER = {
    "{axis}": AXIS_NAMES,
    "{body_axis}": BODY_AXES,
    "{element}": Columns.QUATERNION,
}
COLUMN_DESCRIPTION_FIELDS = ["table", "column", "unit", "frame", "meaning", "source_topic", "clock"]
# Characters that some systems do not allow in file names
_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9_-]+")
# Maximum length (characters) of a table name
MAX_TABLE_NAME_LENGTH = 80
NO_POSITION = Unavailable(
    "external position",
    "the log contains no position track. px4fuse info LOG lists the settings to log positions",
    "",
)


@dataclass(frozen=True)
class ExportedTable:
    """Table with its name, and the topics and clock of its data (``stream``).

    ``kind`` is the name of the table in columns.csv; by default ``name``.
    """

    name: str
    data: pd.DataFrame
    stream: DataSource | PositionTrack | None = None
    kind: str = ""

    def describe_columns(self) -> pd.DataFrame:
        """Return unit, frame, meaning, topic and clock of each column."""
        # Tables without time have the default index
        kinds = [] if isinstance(self.data.index, pd.RangeIndex) else ["any table"]
        descriptions = _read_column_descriptions().loc[[*kinds, self.kind or self.name]]
        return descriptions.map(lambda cell: cell.format(track=self.stream)).assign(
            table=self.name,
            source_topic=" ".join(self.stream.topics) if self.stream else "",
            clock=self.stream.clock if self.stream else "",
        )

    def select_described_columns(self) -> pd.DataFrame:
        """Return the described columns of the table, with the time (s) in the first column."""
        rows = self.data.rename_axis("time_s").reset_index()
        return rows.reindex(columns=[*self.describe_columns()["column"]])


def add_source_innovations(flight: Flight) -> Flight:
    """Add EKF2's innovations of the default position source to a flight."""
    try:
        return select_source_innovations(flight, choose_source(flight)[0])
    except MissingDataError:
        return flight


def tables(flight: Flight) -> Mapping[str, pd.DataFrame]:
    """Return the tables of a flight by name, with one row per sample.

    Missing data have no table.
    """
    return {table.name: table.select_described_columns() for table in _make_tables(flight)}


def data_dictionary(flight: Flight) -> pd.DataFrame:
    """Describe each column of all tables: unit, frame, meaning, topic and clock."""
    descriptions = [table.describe_columns() for table in _make_tables(flight)]
    return pd.concat([*descriptions, pd.DataFrame()], ignore_index=True).reindex(
        columns=COLUMN_DESCRIPTION_FIELDS
    )


def to_bytes(table: pd.DataFrame, file_format: str) -> bytes:
    """Encode a table as Parquet or CSV, without rounding of numbers."""
    if file_format == "parquet":
        return table.to_parquet(engine="pyarrow", index=False)
    return table.to_csv(index=False, lineterminator="\n").encode()


def list_missing_data(flight: Flight) -> tuple[Unavailable, ...]:
    """List the data that are missing in a log, with the reasons."""
    ekf2 = flight.ekf2
    flight_data: list[object] = [flight.imu, flight.attitude, ekf2]
    if isinstance(ekf2, Ekf2):
        flight_data += [*ekf2.innovations.values(), ekf2.variance, ekf2.fusion_flags]
    flight_data += [imu_and_attitude(flight), flight.airborne, flight.truth]
    missing_data = [data for data in flight_data if isinstance(data, Unavailable)]
    if not flight.positions:
        missing_data.append(NO_POSITION)
    return tuple(dict.fromkeys(missing_data))


def describe_flight(flight: Flight) -> dict[str, Any]:
    """Describe log, topics, clocks and missing data of a flight (flight.json)."""
    ekf2 = flight.ekf2
    description_fields = {
        "schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION},
        "log": flight.log,
        "streams": flight.streams,
        "positions": [
            {"table": table, **track.description_fields()}
            for table, track in _list_tracks_with_table_names(flight)
        ],
        "ekf2": {"gate": ekf2.gate, "notes": ekf2.notes} if isinstance(ekf2, Ekf2) else None,
        "clocks": flight.clocks,
        "missing": tuple(dict.fromkeys((*list_missing_data(flight), *flight.missing))),
        "unused": flight.unused,
        "inputs": flight.inputs,
    }
    return {**to_json_types(description_fields)}


@cache
def _read_column_descriptions() -> pd.DataFrame:
    """Read the descriptions of all columns (columns.csv), indexed by table name."""
    csv_lines = Path(__file__).with_name("columns.csv").read_text("utf-8").splitlines()
    for placeholder, names in NAMES_BY_PLACEHOLDER.items():
        csv_lines = [
            line.replace(placeholder, name)
            for line in csv_lines
            for name in (names if placeholder in line else [placeholder])
        ]
    return pd.read_csv(StringIO("\n".join(csv_lines)), index_col="table", keep_default_na=False)


def _make_stream_tables(
    flight: Flight, data_by_stream: Mapping[str, pd.DataFrame | Unavailable]
) -> Iterator[ExportedTable]:
    """Yield a table for each stream of a flight; missing data have no table."""
    for name, data in data_by_stream.items():
        if isinstance(data, pd.DataFrame):
            yield ExportedTable(name, data, flight.streams.get(name))


def _make_time_table(columns: list[str], rows: Iterable[tuple[float, ...]]) -> pd.DataFrame:
    """Return a table with times (s) as index, which are the first value of each row."""
    return pd.DataFrame(list(rows), columns=["time_s", *columns], dtype=float).set_index("time_s")


def _make_tables(flight: Flight) -> Iterator[ExportedTable]:
    imu = flight.imu
    imu = imu if isinstance(imu, Unavailable) else imu.astype(np.float64)
    yield from _make_stream_tables(flight, {"imu": imu, "attitude": flight.attitude})
    acceleration = compute_ned_acceleration(flight)
    if isinstance(acceleration, pd.DataFrame):
        acceleration = acceleration.set_axis(["north_m_s2", "east_m_s2", "down_m_s2"], axis=1)
        no_source = DataSource((), "", "")
        imu_source, attitude_source = (
            flight.streams.get(name, no_source) for name in ("imu", "attitude")
        )
        topics = (*imu_source.topics, *attitude_source.topics)
        yield ExportedTable(
            "acceleration_ned", acceleration, DataSource(topics, imu_source.clock, "")
        )
    for name, track in _list_tracks_with_table_names(flight):
        yield ExportedTable(name, track.samples, track, "position")
        if track.orientation is not None:
            orientation_name = name.replace("position_", "orientation_", 1)
            yield ExportedTable(orientation_name, track.orientation, track, "orientation")
    if isinstance(flight.ekf2, Ekf2):
        yield from _make_ekf2_tables(flight, flight.ekf2)
    if isinstance(flight.truth, Truth):
        yield from _make_stream_tables(flight, {"truth": flight.truth.samples})
    if not isinstance(flight.airborne, Unavailable):
        airborne = _make_time_table(["end_s"], flight.airborne)
        yield from _make_stream_tables(flight, {"airborne": airborne})
    if flight.log.dropouts:
        rows = ((dropout.start_s, dropout.duration_s) for dropout in flight.log.dropouts)
        yield ExportedTable("dropouts", _make_time_table(["duration_s"], rows))
    ekf2_parameters = flight.ekf2.parameters if isinstance(flight.ekf2, Ekf2) else {}
    if parameters := {**flight.log.parameters, **ekf2_parameters}:
        parameter_table = pd.DataFrame(parameters.items(), columns=["name", "value"])
        yield ExportedTable("parameters", parameter_table)
    if flight.clocks:
        clock_table = pd.DataFrame([structs.asdict(clock) for clock in flight.clocks])
        # float, because the number of distinct timestamps may be NaN
        yield ExportedTable("clocks", clock_table.astype({"distinct_stamps": np.float64}))


def _make_ekf2_tables(flight: Flight, ekf2: Ekf2) -> Iterator[ExportedTable]:
    axis_tables = [
        axis_innovations.assign(axis=axis)
        for axis, axis_innovations in ekf2.innovations.items()
        if isinstance(axis_innovations, pd.DataFrame)
    ]
    data_by_stream = {"ekf2_state": ekf2.state, "ekf2_variance": ekf2.variance}
    if axis_tables:
        data_by_stream["ekf2_innovations"] = pd.concat(axis_tables).sort_index(kind="stable")
    data_by_stream["ekf2_fusing"] = ekf2.fusion_flags
    yield from _make_stream_tables(flight, data_by_stream)
    state_source = flight.streams.get("ekf2_state")
    resets = _make_time_table(
        ["delta_north", "delta_east", "delta_down"],
        ((reset.time_s, *reset.delta) for reset in ekf2.resets),
    )
    resets["quantity"] = np.array([reset.quantity for reset in ekf2.resets], object)
    yield ExportedTable("resets", resets, state_source)
    # the first instance starts at minus infinity, but the table needs a finite time
    first_time_s = min(float(ekf2.state.index[0]), 0.0)
    instances = _make_time_table(
        ["instance"],
        ((max(time_s, first_time_s), instance) for time_s, instance in ekf2.primary_instances),
    )
    yield ExportedTable("instances", instances.astype(np.int64), state_source)


def _list_tracks_with_table_names(flight: Flight) -> Iterator[tuple[str, PositionTrack]]:
    """Yield each position track with a unique table name."""
    used_names: set[str] = set()
    for track in flight.positions:
        # the prefix avoids names that Windows reserves (con, aux, ...)
        stem = _UNSAFE_CHARACTERS.sub("_", f"position_{track.name}")[:MAX_TABLE_NAME_LENGTH].rstrip(
            "_"
        )
        name, number = stem, 1
        while name.lower() in used_names:
            number += 1
            name = f"{stem}_{number}"
        used_names.add(name.lower())
        yield name, track
