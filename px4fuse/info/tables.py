"""Tables and description of a flight for ``px4fuse extract``."""

import re
from collections.abc import Iterator
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
# Characters that some systems do not allow in file names
_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9_-]+")
# Maximum length (characters) of a table name
MAX_TABLE_NAME_LENGTH = 80
NO_POSITION = Unavailable(
    "external position",
    "the log contains no position track. px4fuse info LOG lists the settings to log positions",
    "",
)


def add_source_innovations(flight: Flight) -> Flight:
    """Add EKF2's innovations of the default position source to a flight."""
    try:
        return select_source_innovations(flight, choose_source(flight)[0])
    except MissingDataError:
        return flight


def tables(flight: Flight) -> dict[str, pd.DataFrame]:
    """Return the tables of a flight by name, with one row per sample.

    Missing data have no table.
    """
    streams: dict[str, object] = {"imu": flight.imu, "attitude": flight.attitude}
    acceleration = compute_ned_acceleration(flight)
    if isinstance(acceleration, pd.DataFrame):
        streams["acceleration_ned"] = acceleration.add_suffix("_m_s2")
    for name, track in _list_tracks_with_table_names(flight):
        streams[name] = track.samples
        streams[name.replace("position_", "orientation_", 1)] = track.orientation
    ekf2, truth, parameters = flight.ekf2, flight.truth, {**flight.log.parameters}
    if isinstance(ekf2, Ekf2):
        parameters |= ekf2.parameters
        streams["ekf2_state"] = ekf2.state
        streams["ekf2_variance"] = ekf2.variance
        streams["ekf2_fusing"] = ekf2.fusion_flags
    if isinstance(truth, Truth):
        streams["truth"] = truth.samples
    tables = {
        name: samples.astype(np.float64).rename_axis("time_s").reset_index()
        for name, samples in streams.items()
        if isinstance(samples, pd.DataFrame)
    }
    if "imu" in tables:  # NaN if not logged
        tables["imu"] = tables["imu"].assign(clipped=lambda imu: imu.get("clipped", np.nan))
    if isinstance(ekf2, Ekf2):
        tables |= _make_ekf2_tables(ekf2)
    if not isinstance(flight.airborne, Unavailable):
        tables["airborne"] = pd.DataFrame(flight.airborne, columns=["time_s", "end_s"])
    if flight.log.dropouts:
        dropout_rows = map(structs.astuple, flight.log.dropouts)
        tables["dropouts"] = pd.DataFrame(dropout_rows, columns=["time_s", "duration_s"])
    if parameters:
        tables["parameters"] = pd.DataFrame(parameters.items(), columns=["name", "value"])
    if flight.clocks:
        clock_table = pd.DataFrame([structs.asdict(clock) for clock in flight.clocks])
        # float, because the number of distinct timestamps may be NaN
        tables["clocks"] = clock_table.astype({"distinct_stamps": np.float64})
    return tables


def _make_ekf2_tables(ekf2: Ekf2) -> dict[str, pd.DataFrame]:
    """Return EKF2's innovations of all axes, resets and primary instances."""
    innovations_by_axis = {
        axis: innovations
        for axis, innovations in ekf2.innovations.items()
        if isinstance(innovations, pd.DataFrame)
    }
    resets = [(reset.time_s, reset.quantity, *reset.delta) for reset in ekf2.resets]
    instances = pd.DataFrame(ekf2.primary_instances, columns=["time_s", "instance"])
    # The first primary EKF2 instance starts at time minus infinity, but a table needs a finite time
    first_time_s = min(ekf2.state.index[0], 0.0)
    ekf2_tables = {
        "resets": pd.DataFrame(
            resets, columns=["time_s", "quantity", "delta_north", "delta_east", "delta_down"]
        ),
        "instances": instances.assign(time_s=instances["time_s"].clip(lower=first_time_s)),
    }
    if innovations_by_axis:
        innovations = pd.concat(innovations_by_axis, names=["axis", "time_s"]).reset_index("axis")
        ekf2_tables["ekf2_innovations"] = innovations.sort_index(kind="stable").reset_index()
    return ekf2_tables


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


def _list_tracks_with_table_names(flight: Flight) -> Iterator[tuple[str, PositionTrack]]:
    """Yield each position track with a unique name for its exported table."""
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
