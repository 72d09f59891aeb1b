"""Joining of two recordings of one flight: the second recording supplies missing data."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.errors import MissingDataError
from px4fuse.flight.log import InputFile
from px4fuse.flight.model import Columns, Ekf2, Flight, Unavailable, sort_by_preference, time_index
from px4fuse.readers.common import collect_unavailable

# Names of the record fields that contain times (s)
TIME_FIELDS = ("time_s", "start_s", "end_s")
# Minimum overlap in time (s) of the two recordings
MIN_OVERLAP_S = 2.0
# Maximum difference (m) between the EKF2 positions of two recordings, due to interpolation: a
# larger difference shows that the recordings are of different flights
MAX_POSITION_DIFFERENCE_M = 0.5
# Minimum number of EKF2 positions in the common time to compare the recordings
MIN_COMMON_SAMPLES = 5


def join(flight: Flight, other: Flight) -> Flight:
    """Join two recordings of one flight on the boot clock of the autopilot.

    Parameters
    ----------
    flight : Flight
        Recording whose time zero and data are kept.
    other : Flight
        Recording from which missing data and all position tracks are added.

    Raises
    ------
    MissingDataError
        The recordings do not overlap in time, or are of different flights.
    """
    if other.log.sha256 == flight.log.sha256:
        raise MissingDataError(
            f"{other.log.name} is the same recording as LOG.",
            "Give the other recording of the flight.",
        )
    shift_s = other.log.boot_time_s - flight.log.boot_time_s
    common_start_s = max(0.0, shift_s)
    common_end_s = min(flight.log.duration_s, shift_s + other.log.duration_s)
    if common_end_s - common_start_s < MIN_OVERLAP_S:
        raise MissingDataError(
            f"{flight.log.name} and {other.log.name} do not overlap in time: "
            f"{_format_span(flight)} and {_format_span(other)} on the autopilot's boot clock.",
            "Give recordings of the same flight.",
        )
    shifted = shift_times(other, shift_s)
    comparison_note = _compare_ekf2_positions(flight, shifted)
    supplied_data: dict[str, Any] = {}
    streams = dict(flight.streams)
    for name in ("imu", "attitude", "ekf2", "truth", "airborne", "modes"):
        data = getattr(shifted, name)
        if isinstance(getattr(flight, name), Unavailable) and not isinstance(data, Unavailable):
            supplied_data[name] = data
            streams |= {k: v for k, v in shifted.streams.items() if k.startswith(name)}
    joined = replace(flight, **supplied_data)
    missing_data = collect_unavailable(joined.imu, joined.attitude, joined.ekf2, joined.truth)
    log = flight.log
    other_log = other.log
    unix_s = log.start_unix_s
    if unix_s is None and other_log.start_unix_s is not None:
        unix_s = other_log.start_unix_s - shift_s
    common_s = common_end_s - common_start_s
    join_note = (
        f"joined with {other_log.name} on the boot clock, {common_s:.1f} s in common; "
        f"{comparison_note}"
    )
    return replace(
        joined,
        log=structs.replace(
            log,
            notes=(
                *log.notes,
                *(f"{other_log.name}: {note}" for note in other_log.notes),
                join_note,
            ),
            start_unix_s=unix_s,
            damage=(
                *log.damage,
                *(f"{other_log.name}: {sentence}" for sentence in other_log.damage),
            ),
            senders=log.senders or other_log.senders,
            restarts=log.restarts or other_log.restarts,
            receive_time_reversals=log.receive_time_reversals or other_log.receive_time_reversals,
            dropped={
                **{f"{other_log.name}: {k}": n for k, n in other_log.dropped.items()},
                **log.dropped,
            },
        ),
        positions=sort_by_preference((*flight.positions, *shifted.positions)),
        missing=(*missing_data, *(source for source in flight.missing if source.source)),
        streams=streams,
        clocks=(*flight.clocks, *other.clocks),
        unused=(*flight.unused, *other.unused),
        inputs=(
            *flight.inputs,
            InputFile(other_log.name, other_log.sha256, other_log.bytes, "mavlink"),
        ),
    )


def _format_span(flight: Flight) -> str:
    start = flight.log.boot_time_s
    return f"{start:.1f} s to {start + flight.log.duration_s:.1f} s"


def shift_times(data: Any, shift_s: float) -> Any:
    """Shift all times of a flight or of flight data: table indices, and times in records.

    Parameters
    ----------
    data : DataFrame, Series, record, or a tuple or mapping of records
        Data of a flight. Values of other types are returned unchanged.
    """
    if isinstance(data, pd.DataFrame | pd.Series):
        return data.set_axis(time_index(data.index.to_numpy() + shift_s))
    if isinstance(data, tuple):
        return tuple(shift_times(entry, shift_s) for entry in data)
    if isinstance(data, Mapping):
        return {key: shift_times(entry, shift_s) for key, entry in data.items()}
    if not is_dataclass(data) or isinstance(data, type):
        return data
    shifted = {}
    for name in (field.name for field in fields(data)):
        value = getattr(data, name)
        shifted[name] = value + shift_s if name in TIME_FIELDS else shift_times(value, shift_s)
    if isinstance(data, Ekf2):
        shifted["instances"] = tuple((time + shift_s, number) for time, number in data.instances)
    if isinstance(data, Flight) and not isinstance(data.airborne, Unavailable):
        spans = data.airborne
        shifted["airborne"] = tuple((start + shift_s, end + shift_s) for start, end in spans)
    return replace(data, **shifted)


def _compare_ekf2_positions(flight: Flight, other: Flight) -> str:
    """Compare the EKF2 positions of two recordings; raise MissingDataError if they differ.

    An overlap in time does not prove that the flight is the same, because times count from boot.
    """
    if isinstance(flight.ekf2, Ekf2) and isinstance(other.ekf2, Ekf2):
        own_state = flight.ekf2.state
        other_state = other.ekf2.state
        common_s = other_state.index[
            (other_state.index >= own_state.index[0]) & (other_state.index <= own_state.index[-1])
        ]
        if len(common_s) >= MIN_COMMON_SAMPLES:
            position = np.column_stack(
                [np.interp(common_s, own_state.index, own_state[c]) for c in Columns.POSITION]
            )
            distance_m = np.linalg.norm(
                position - other_state.loc[common_s, Columns.POSITION].to_numpy(), axis=1
            )
            median_m = float(np.median(distance_m))
            if median_m > MAX_POSITION_DIFFERENCE_M:
                raise MissingDataError(
                    f"{flight.log.name} and {other.log.name} are different flights: their EKF2 "
                    f"positions differ by {median_m:.2f} m (median).",
                    "Give recordings of the same flight.",
                )
            return f"the EKF2 positions of both differ by {median_m:.3f} m (median)"
    return "without EKF2 data in both it is not verified that both are of the same flight"
