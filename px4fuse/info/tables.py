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
from px4fuse.flight.model import Ekf2, Flight, PositionTrack, Truth, Unavailable

SCHEMA_NAME = "px4fuse-flight"
SCHEMA_VERSION = "1.0"
# Placeholders in columns.csv, and the names that replace them
NAMES_BY_PLACEHOLDER = {
    "{axis}": ("north", "east", "down"),
    "{body_axis}": ("forward", "right", "down"),
    "{element}": ("w", "x", "y", "z"),
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
class DescribedTable:
    """Exported table with a description of its columns."""

    name: str
    data: pd.DataFrame
    column_descriptions: pd.DataFrame


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
    return {table.name: table.data for table in _make_described_tables(flight)}


def data_dictionary(flight: Flight) -> pd.DataFrame:
    """Describe each column of all tables: unit, frame, meaning, topic and clock."""
    descriptions = [table.column_descriptions for table in _make_described_tables(flight)]
    if not descriptions:
        return pd.DataFrame(columns=COLUMN_DESCRIPTION_FIELDS)
    return pd.concat(descriptions, ignore_index=True)[COLUMN_DESCRIPTION_FIELDS]


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
    description_fields: dict[str, Any] = {
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
    json_description: dict[str, Any] = to_json_types(description_fields)
    return json_description


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


def _describe_table(
    name: str,
    data: pd.DataFrame,
    topics_and_clock: tuple[tuple[str, ...], str] = ((), ""),
    name_in_columns_csv: str = "",
    **placeholder_values: str,
) -> DescribedTable:
    """Add column descriptions from columns.csv to a table, and remove other columns.

    Parameters
    ----------
    name_in_columns_csv : str
        Name of the table in columns.csv; by default ``name``.
    placeholder_values : str
        Texts that replace names in braces in columns.csv.
    """
    csv_table_names = ["any table"] * ("time_s" in data) + [name_in_columns_csv or name]
    column_descriptions = (
        _read_column_descriptions()
        .loc[csv_table_names]
        .map(lambda cell: cell.format(**placeholder_values))
    )
    topics, clock_name = topics_and_clock
    column_descriptions = column_descriptions.assign(
        table=name, source_topic=" ".join(topics), clock=clock_name
    )
    described_data = data.reindex(columns=[*column_descriptions["column"]])
    return DescribedTable(name, described_data, column_descriptions)


def _make_stream_table(
    flight: Flight, name: str, data: pd.DataFrame | Unavailable
) -> Iterator[DescribedTable]:
    if isinstance(data, pd.DataFrame):
        yield _describe_table(name, _with_time_column(data), _find_topics_and_clock(flight, name))


def _with_time_column(data: pd.DataFrame) -> pd.DataFrame:
    return data.rename_axis("time_s").reset_index()


def _make_described_tables(flight: Flight) -> Iterator[DescribedTable]:
    imu = flight.imu
    yield from _make_stream_table(
        flight, "imu", imu if isinstance(imu, Unavailable) else imu.astype(np.float64)
    )
    yield from _make_stream_table(flight, "attitude", flight.attitude)
    acceleration = compute_ned_acceleration(flight)
    if isinstance(acceleration, pd.DataFrame):
        acceleration = acceleration.set_axis(["north_m_s2", "east_m_s2", "down_m_s2"], axis=1)
        imu_topics, imu_clock_name = _find_topics_and_clock(flight, "imu")
        attitude_topics, _ = _find_topics_and_clock(flight, "attitude")
        yield _describe_table(
            "acceleration_ned",
            _with_time_column(acceleration),
            ((*imu_topics, *attitude_topics), imu_clock_name),
        )
    for name, track in _list_tracks_with_table_names(flight):
        placeholder_values = {"frame": track.frame, "description": track.description}
        topics_and_clock = (track.topics, track.clock)
        position_table = _with_time_column(track.samples)
        yield _describe_table(
            name, position_table, topics_and_clock, "position", **placeholder_values
        )
        if track.orientation is not None:
            yield _describe_table(
                name.replace("position_", "orientation_", 1),
                _with_time_column(track.orientation),
                topics_and_clock,
                "orientation",
                **placeholder_values,
            )
    if isinstance(flight.ekf2, Ekf2):
        yield from _make_ekf2_tables(flight, flight.ekf2)
    if isinstance(flight.truth, Truth):
        yield from _make_stream_table(flight, "truth", flight.truth.samples)
    log = flight.log
    if not isinstance(flight.airborne, Unavailable):
        airborne_table = _make_numeric_table(["time_s", "end_s"], flight.airborne)
        yield _describe_table(
            "airborne", airborne_table, _find_topics_and_clock(flight, "airborne")
        )
    if log.dropouts:
        rows = [(dropout.start_s, dropout.duration_s) for dropout in log.dropouts]
        yield _describe_table("dropouts", _make_numeric_table(["time_s", "duration_s"], rows))
    if parameters := _collect_logged_parameters(flight):
        yield _describe_table(
            "parameters", pd.DataFrame(parameters.items(), columns=["name", "value"])
        )
    if flight.clocks:
        clock_table = pd.DataFrame([structs.asdict(clock) for clock in flight.clocks])
        # float, because the number of distinct timestamps may be NaN
        yield _describe_table("clocks", clock_table.astype({"distinct_stamps": np.float64}))


def _collect_logged_parameters(flight: Flight) -> dict[str, float]:
    logged_values = dict(flight.log.parameters)
    if isinstance(flight.ekf2, Ekf2):
        for record_or_aid in (flight.ekf2.record, *flight.ekf2.aids.values()):
            logged_values |= (
                {} if isinstance(record_or_aid, Unavailable) else record_or_aid.parameters
            )
    return logged_values


def _make_numeric_table(columns: list[str], rows: Iterable[tuple[float, ...]]) -> pd.DataFrame:
    return pd.DataFrame(list(rows), columns=columns, dtype=np.float64)


def _make_ekf2_tables(flight: Flight, ekf2: Ekf2) -> Iterator[DescribedTable]:
    yield from _make_stream_table(flight, "ekf2_state", ekf2.state)
    yield from _make_stream_table(flight, "ekf2_variance", ekf2.variance)
    axis_tables = [
        axis_innovations.assign(axis=axis)
        for axis, axis_innovations in ekf2.innovations.items()
        if isinstance(axis_innovations, pd.DataFrame)
    ]
    if axis_tables:
        innovation_table = pd.concat(axis_tables).sort_index(kind="stable")
        yield from _make_stream_table(flight, "ekf2_innovations", innovation_table)
    yield from _make_stream_table(flight, "ekf2_fusing", ekf2.fusion_flags)
    topics_and_clock = _find_topics_and_clock(flight, "ekf2_state")
    delta_rows = [reset.delta for reset in ekf2.resets]
    reset_table = _make_numeric_table(["delta_north", "delta_east", "delta_down"], delta_rows)
    reset_table["time_s"] = np.array([reset.time_s for reset in ekf2.resets], np.float64)
    reset_table["quantity"] = np.array([reset.quantity for reset in ekf2.resets], object)
    yield _describe_table("resets", reset_table, topics_and_clock)
    # the first instance starts at minus infinity, but the table needs a finite time
    first_time_s = min(float(ekf2.state.index[0]), 0.0)
    instance_rows = [
        (max(time_s, first_time_s), instance) for time_s, instance in ekf2.primary_instances
    ]
    instance_table = _make_numeric_table(["time_s", "instance"], instance_rows).astype(
        {"instance": np.int64}
    )
    yield _describe_table("instances", instance_table, topics_and_clock)


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


def _find_topics_and_clock(flight: Flight, stream_name: str) -> tuple[tuple[str, ...], str]:
    stream = flight.streams.get(stream_name)
    return ((), "") if stream is None else (stream.topics, stream.clock)
