"""What is in a log, what can be done with it, and what to change before the next flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.comparison.preparation import choose_segment, choose_source
from px4fuse.errors import MissingDataError, Px4FuseError
from px4fuse.filter.signals import IMU_GAP_INTERVALS, IMU_GAP_S, Segment, make_axes
from px4fuse.findings.source_intervals import longest_s
from px4fuse.flight import Ekf2, Flight, Unavailable, sample_rate
from px4fuse.inspect.outlook import (
    PART_NAMES,
    Ability,
    Advice,
    Plan,
    abilities,
    advice,
    most_innovations,
)
from px4fuse.plain import plain
from px4fuse.recording import ClockMap, InputFile, LogInfo, Unused
from px4fuse.request import with_options

SCHEMA_NAME = "px4fuse-info"
SCHEMA_VERSION = "1.0"


@dataclass(frozen=True)
class Gaps:
    """Intervals between samples that are longer than ``limit_s``.

    Attributes
    ----------
    count : int
    total_s, longest_s : float
        Of those intervals; 0 where there is none.
    limit_s : float
        Of the IMU as the filter takes it (0.1 s, five intervals), else one second or five
        intervals, whichever is longer.
    """

    count: int
    total_s: float
    longest_s: float
    limit_s: float


@dataclass(frozen=True)
class Source:
    """One part of the flight and where it was read from, or why it is not there.

    Attributes
    ----------
    part : str
        "IMU", "attitude", "position", "EKF2 state", ..., see :data:`PART_NAMES`.
    name : str
        The name of a position track, else the first topic; empty where unavailable.
    topics : tuple of str
    clock, log : str
        Which clock its time stamps were given on, and the file's name.
    samples : int or None
        None where the reader keeps no samples of it (land detector).
    rate_hz : float or None
        Between gaps; None below two samples.
    gaps : Gaps or None
    start_s, end_s : float or None
        First and last sample, seconds from the first data.
    chosen : bool
        Whether ``px4fuse compare`` takes this position.
    description : str
        Of a position: what it is.
    unavailable : str
        Why the part is not there; empty where it is.
    """

    part: str
    name: str = ""
    topics: tuple[str, ...] = ()
    clock: str = ""
    log: str = ""
    samples: int | None = None
    rate_hz: float | None = None
    gaps: Gaps | None = None
    start_s: float | None = None
    end_s: float | None = None
    chosen: bool = False
    description: str = ""
    unavailable: str = ""


@dataclass(frozen=True)
class Inventory:
    """What ``px4fuse info`` says.

    Attributes
    ----------
    log : LogInfo
    start_utc : str or None
        ISO 8601, of time zero.
    airborne : tuple of (float, float), or None
        Stretches of flight (s); None where the log has no land detector.
    sources : tuple of Source
        Every part of the flight, every position track, best first.
    source_reason : str
        Why compare takes its position source, or why it finds none.
    segment : Segment or None
        What compare would analyse.
    clocks : tuple of ClockMap
    abilities : tuple of Ability
    advice : tuple of Advice
        Most important first, each remedy once.
    missing : tuple of Unavailable
        What was looked for and not found.
    unused : tuple of Unused
    inputs : tuple of InputFile
    notes : tuple of str
        What the reader had to do, and what EKF2 means here.
    """

    log: LogInfo
    start_utc: str | None
    airborne: tuple[tuple[float, float], ...] | None
    sources: tuple[Source, ...]
    source_reason: str
    segment: Segment | None
    clocks: tuple[ClockMap, ...]
    abilities: tuple[Ability, ...]
    advice: tuple[Advice, ...]
    missing: tuple[Unavailable, ...]
    unused: tuple[Unused, ...]
    inputs: tuple[InputFile, ...]
    notes: tuple[str, ...]


def take_inventory(flight: Flight) -> Inventory:
    """Take stock of a flight.

    Parameters
    ----------
    flight : Flight
        Any: also one of which every part is unavailable.
    """
    plan = _plan(flight)
    return Inventory(
        log=flight.log,
        start_utc=_utc(flight.log.start_unix_s),
        airborne=None if isinstance(flight.airborne, Unavailable) else flight.airborne,
        sources=tuple(_sources(flight, plan)),
        source_reason=plan.reason,
        segment=plan.segment,
        clocks=flight.clocks,
        abilities=tuple(abilities(flight, plan)),
        advice=advice(flight, plan),
        missing=flight.missing,
        unused=flight.unused,
        inputs=flight.inputs,
        notes=(
            *flight.log.damage,
            *_end(flight.log),
            *flight.log.notes,
            *(plan.track.notes if plan.track is not None else ()),
            *(flight.ekf2.notes if isinstance(flight.ekf2, Ekf2) else ()),
        ),
    )


def to_plain(inventory: Inventory) -> dict[str, Any]:
    """The inventory for JSON: what is not known is absent."""
    data: dict[str, Any] = plain(inventory)
    return {"schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION}, **data}


def _end(log: LogInfo) -> tuple[str, ...]:
    flying = log.ends_in_flight and not log.damage
    return ("the log ends in flight: the landing is not in it",) if flying else ()


def _utc(unix_s: float | None) -> str | None:
    if unix_s is None:
        return None
    try:
        return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):  # a clock beyond the calendar
        return None


def _plan(flight: Flight) -> Plan:
    track = segment = None
    reason = remedy = ""
    try:
        track, reason = choose_source(flight)
        segment = choose_segment(flight, track)
        return Plan(track, segment, make_axes(flight, track, segment), reason, "")
    except Px4FuseError as error:
        text = with_options(str(error)).removeprefix(f"{flight.log.name}: ")
        reason, _, remedy = text.partition(". ")
        if not isinstance(error, MissingDataError):
            remedy = "Record more of the flight: the logger from arming on (SDLOG_MODE 0)."
    return Plan(track, None, (), reason.removesuffix("."), remedy)


def _sources(flight: Flight, plan: Plan) -> Iterator[Source]:
    ekf2 = flight.ekf2
    yield _part(flight, "imu", flight.imu)
    yield _part(flight, "attitude", flight.attitude)
    for track in flight.positions:
        yield Source(
            part="position",
            name=track.name,
            topics=track.topics,
            clock=track.clock,
            log=track.log,
            chosen=plan.track is not None and track.name == plan.track.name,
            description=track.description,
            **_counted(track.samples, _gap_limit(track.samples)),
        )
    if not flight.positions:
        yield Source("position", unavailable=plan.reason)
    yield _part(flight, "ekf2_state", ekf2 if isinstance(ekf2, Unavailable) else ekf2.state)
    if isinstance(ekf2, Ekf2):
        yield _part(flight, "ekf2_variance", ekf2.variance)
        yield _part(flight, "ekf2_innovations", most_innovations(ekf2))
        yield _part(flight, "ekf2_fusing", ekf2.fusing)
    truth = flight.truth
    yield _part(flight, "truth", truth if isinstance(truth, Unavailable) else truth.samples)
    yield _part(flight, "airborne", flight.airborne)


def _part(
    flight: Flight, key: str, data: pd.DataFrame | tuple[tuple[float, float], ...] | Unavailable
) -> Source:
    if isinstance(data, Unavailable):
        return Source(PART_NAMES[key], unavailable=data.reason)
    stream = flight.streams.get(key)
    topics = () if stream is None else stream.topics
    if isinstance(data, pd.DataFrame):
        counted = _counted(data, _gap_limit(data, of_imu=key == "imu"))
    else:
        counted = {"start_s": data[0][0], "end_s": data[-1][1]} if data else {}
    return Source(
        part=PART_NAMES[key],
        name=topics[0] if topics else "",
        topics=topics,
        clock="" if stream is None else stream.clock,
        log="" if stream is None else stream.log,
        **counted,
    )


def _counted(frame: pd.DataFrame, limit_s: float | None) -> dict[str, Any]:
    if frame.empty:
        return {"samples": 0}
    counted: dict[str, Any] = {
        "samples": len(frame),
        "start_s": float(frame.index[0]),
        "end_s": float(frame.index[-1]),
    }
    if limit_s is not None:
        intervals = np.diff(frame.index.to_numpy())
        long = intervals[intervals > limit_s]
        counted["rate_hz"] = sample_rate(frame)
        counted["gaps"] = Gaps(
            len(long), float(long.sum()), float(long.max(initial=0.0)), float(limit_s)
        )
    return counted


def _gap_limit(frame: pd.DataFrame, *, of_imu: bool = False) -> float | None:
    if len(frame) < 2:
        return None
    if of_imu:
        return max(IMU_GAP_S, IMU_GAP_INTERVALS * float(np.median(np.diff(frame.index.to_numpy()))))
    return longest_s(1.0 / sample_rate(frame))
