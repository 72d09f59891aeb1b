"""Two recordings of one flight on one clock: what one lacks, the other gives."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.errors import MissingDataError
from px4fuse.flight import Columns, Ekf2, Flight, Unavailable, best_first
from px4fuse.readers.parts import missing_parts
from px4fuse.recording import InputFile

# Fields of records that are times
TIMES = ("time_s", "start_s", "end_s")
# Both recordings must hold this much of the same time
MIN_OVERLAP_S = 2.0
# EKF2's position is sent as it is logged: what is left is interpolation between samples
MAX_POSITION_DIFFERENCE_M = 0.5
MIN_COMMON_SAMPLES = 5


def join(flight: Flight, other: Flight) -> Flight:
    """Join two recordings of one flight on the autopilot's boot clock.

    Parameters
    ----------
    flight : Flight
        Keeps its time zero and everything that it has.
    other : Flight
        Gives what ``flight`` lacks, and all its position tracks.

    Raises
    ------
    MissingDataError
        The two do not overlap in time, or are not of the same flight.
    """
    if other.log.sha256 == flight.log.sha256:
        raise MissingDataError.of("recording_twice", other=other)
    shift_s = other.log.boot_time_s - flight.log.boot_time_s
    low, high = max(0.0, shift_s), min(flight.log.duration_s, shift_s + other.log.duration_s)
    if high - low < MIN_OVERLAP_S:
        raise MissingDataError.of(
            "no_common_time", flight=flight, other=other, one=_span(flight), two=_span(other)
        )
    moved = later(other, shift_s)
    agreement = _agreement(flight, moved)
    taken: dict[str, Any] = {}
    streams = dict(flight.streams)
    for part in ("imu", "attitude", "ekf2", "truth", "airborne", "modes"):
        mine, theirs = getattr(flight, part), getattr(moved, part)
        if isinstance(mine, Unavailable) and not isinstance(theirs, Unavailable):
            taken[part] = theirs
            streams |= {k: v for k, v in moved.streams.items() if k.startswith(part)}
    joined = replace(flight, **taken)
    lacking = missing_parts(joined.imu, joined.attitude, joined.ekf2, joined.truth)
    log, given = flight.log, other.log
    unix_s = log.start_unix_s
    if unix_s is None and given.start_unix_s is not None:
        unix_s = given.start_unix_s - shift_s
    how = f"joined with {given.name} on the boot clock, {high - low:.1f} s in common; {agreement}"
    return replace(
        joined,
        log=structs.replace(
            log,
            notes=(*log.notes, *(f"{given.name}: {note}" for note in given.notes), how),
            start_unix_s=unix_s,
            damage=(*log.damage, *(f"{given.name}: {said}" for said in given.damage)),
            senders=log.senders or given.senders,
            restarts=log.restarts or given.restarts,
            receipt_went_back=log.receipt_went_back or given.receipt_went_back,
            dropped={**{f"{given.name}: {k}": n for k, n in given.dropped.items()}, **log.dropped},
        ),
        positions=best_first((*flight.positions, *moved.positions)),
        missing=(*lacking, *(part for part in flight.missing if part.source)),
        streams=streams,
        clocks=(*flight.clocks, *other.clocks),
        unused=(*flight.unused, *other.unused),
        inputs=(*flight.inputs, InputFile(given.name, given.sha256, given.bytes, "mavlink")),
    )


def _span(flight: Flight) -> str:
    start = flight.log.boot_time_s
    return f"{start:.1f} s to {start + flight.log.duration_s:.1f} s"


def later(part: Any, shift_s: float) -> Any:
    """A flight, or a part, counted from another time zero: tables, and the times in its records.

    Parameters
    ----------
    part : DataFrame, Series, record of such, or a tuple or mapping of records
        Anything else stays as it is.
    """
    if isinstance(part, pd.DataFrame | pd.Series):
        return part.set_axis(pd.Index(part.index.to_numpy() + shift_s, name="time_s"))
    if isinstance(part, tuple):
        return tuple(later(one, shift_s) for one in part)
    if isinstance(part, Mapping):
        return {key: later(one, shift_s) for key, one in part.items()}
    if not is_dataclass(part) or isinstance(part, type):
        return part
    moved = {}
    for name in (each.name for each in fields(part)):
        value = getattr(part, name)
        moved[name] = value + shift_s if name in TIMES else later(value, shift_s)
    if isinstance(part, Ekf2):
        moved["instances"] = tuple((time + shift_s, number) for time, number in part.instances)
    if isinstance(part, Flight) and not isinstance(part.airborne, Unavailable):
        spans = part.airborne
        moved["airborne"] = tuple((start + shift_s, end + shift_s) for start, end in spans)
    return replace(part, **moved)


def _agreement(flight: Flight, other: Flight) -> str:
    """How well two recordings agree where both know the same thing.

    Two flights may both count from a boot of their own, so that overlap alone proves nothing.
    """
    if isinstance(flight.ekf2, Ekf2) and isinstance(other.ekf2, Ekf2):
        mine, theirs = flight.ekf2.state, other.ekf2.state
        at = theirs.index[(theirs.index >= mine.index[0]) & (theirs.index <= mine.index[-1])]
        if len(at) >= MIN_COMMON_SAMPLES:
            ours = np.column_stack([np.interp(at, mine.index, mine[c]) for c in Columns.POSITION])
            apart = np.linalg.norm(ours - theirs.loc[at, Columns.POSITION].to_numpy(), axis=1)
            median = float(np.median(apart))
            if median > MAX_POSITION_DIFFERENCE_M:
                raise MissingDataError.of("other_flight", flight=flight, other=other, median=median)
            return f"their EKF2 positions differ by {median:.3f} m (median)"
    return "that they are of the same flight could not be checked: no EKF2 in both"
