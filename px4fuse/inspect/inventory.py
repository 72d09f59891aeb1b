"""Contents of a log, possible analyses, and advice on logging for the next flight."""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.flight_events import max_interval_s
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.preparation import select_innovations
from px4fuse.ekf2.aids import evaluate_aids
from px4fuse.ekf2.inputs import prepare_inputs
from px4fuse.errors import MissingDataError, Px4FuseError
from px4fuse.filter.signals import IMU_GAP_INTERVALS, IMU_GAP_S, Segment, ned_acceleration, within
from px4fuse.findings import ekf2_not_fusing, finding_title, imu, missing, recording
from px4fuse.flight import Columns, Ekf2, Flight, PositionTrack, Truth, Unavailable, sample_rate
from px4fuse.inspect.tables import NO_POSITION, unavailable_parts
from px4fuse.log import Stream
from px4fuse.request import with_options
from px4fuse.text import capitalise_first, to_json_types, utc_time

SCHEMA_NAME = "px4fuse-info"
SCHEMA_VERSION = "1.0"
# Fields of Flight that are written without change
FLIGHT_FIELDS = ("log", "airborne", "clocks", "missing", "unused", "inputs")
# Displayed names of the parts of a flight, by their names in Flight.streams
PART_NAMES = {
    "imu": "IMU",
    "attitude": "attitude",
    "position": "position",
    "ekf2_state": "EKF2 state",
    "ekf2_variance": "EKF2 variance",
    "ekf2_innovations": "innovations",
    "ekf2_fusing": "fusion flags",
    "truth": "ground truth",
    "airborne": "land detector",
}
# Analyses of compare that need EKF2 or ground truth, with the part of the flight that they need
PARTS_OF_COMPARE = {
    "EKF2 states": "ekf2_state",
    "EKF2 variances": "ekf2_variance",
    "EKF2 consistency": "ekf2_innovations",
    "error": "truth",
}
NO_AXIS = Unavailable("comparison", "the log contains no position to compare with", "")
Spans = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class AnalysisOption:
    """Analysis of px4fuse, with the data that it uses or the reason why it is not possible."""

    name: str
    possible: bool
    reason: str


@dataclass(frozen=True)
class LoggingAdvice:
    """Action before the next flight, and the data that it improves."""

    remedy: str
    improves: tuple[str, ...]


@dataclass(frozen=True)
class Gaps:
    """Gaps: intervals between samples that are longer than ``limit_s``.

    Attributes
    ----------
    count : int
    total_s, longest_s : float
        Sum and maximum of the gaps; 0 without gaps.
    limit_s : float
        IMU: 0.1 s or five median intervals, whichever is longer (as in KF). Others: 1 s or five
        intervals, whichever is longer.
    """

    count: int
    total_s: float
    longest_s: float
    limit_s: float


@dataclass(frozen=True)
class Source:
    """Part of the flight with its topics, or the reason why it is missing.

    Attributes
    ----------
    part : str
        "IMU", "attitude", "position", "EKF2 state", ..., see :data:`PART_NAMES`.
    name : str
        Name of a position track, else the first topic; empty if unavailable.
    topics : tuple of str
    clock, log : str
        Clock of its timestamps, and name of the file.
    samples : int or None
        None if the reader keeps no samples of it (land detector).
    rate_hz : float or None
        Rate between gaps; None with less than two samples.
    gaps : Gaps or None
    start_s, end_s : float or None
        First and last sample, in seconds after the first data.
    chosen : bool
        True if ``px4fuse compare`` uses this position.
    description : str
        Description of a position track.
    unavailable : str
        Reason why the part is missing; empty if it is available.
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
    """Contents of a log, as ``px4fuse info`` shows them.

    Attributes
    ----------
    flight : Flight
        With the EKF2 innovations of the position that compare uses.
    start_utc : str or None
        UTC of the first data, ISO 8601.
    sources : tuple of Source
        All parts of the flight and all position tracks, most direct track first.
    source_reason : str
        Reason for the position source of compare, or for its absence.
    segment : Segment or None
        Segment that compare analyses.
    abilities : tuple of AnalysisOption
    advice : tuple of LoggingAdvice
        Most important first, each action once.
    notes : tuple of str
        Notes of the reader about damage, clocks and the estimator.
    """

    flight: Flight
    start_utc: str | None
    sources: tuple[Source, ...]
    source_reason: str
    segment: Segment | None
    abilities: tuple[AnalysisOption, ...]
    advice: tuple[LoggingAdvice, ...]
    notes: tuple[str, ...]


def take_inventory(flight: Flight) -> Inventory:
    """List the contents of a flight, the possible analyses and the advice on logging.

    Parameters
    ----------
    flight : Flight
        May lack any part.
    """
    compared, reason, remedy = None, "", ""
    try:
        compared = compare(flight)
        reason = compared.source_reason
    except Px4FuseError as error:
        reason = with_options(error.reason).removeprefix(f"{flight.log.name}: ")
        remedy = with_options(error.remedy)
        if not isinstance(error, MissingDataError):
            remedy = "Record the whole flight: set SDLOG_MODE to 0 (logging from arming)."
    if compared is not None:
        flight = select_innovations(flight, compared.source)
    log = flight.log
    is_cut = log.ends_in_flight and not log.damage
    return Inventory(
        flight=flight,
        start_utc=utc_time(log.start_unix_s),
        sources=tuple(_sources(flight, compared, reason)),
        source_reason=reason,
        segment=None if compared is None else compared.segment,
        abilities=tuple(_abilities(flight, compared, reason)),
        advice=_logging_advice(flight, compared, remedy),
        notes=(
            *log.damage,
            *(("the log ends in flight and does not contain the landing",) if is_cut else ()),
            *log.notes,
            *(() if compared is None else compared.source.notes),
            *(flight.ekf2.notes if isinstance(flight.ekf2, Ekf2) else ()),
        ),
    )


def to_plain(inventory: Inventory) -> dict[str, Any]:
    """Convert the inventory to JSON types; unknown values are absent."""
    inventory_fields = {field.name: getattr(inventory, field.name) for field in fields(inventory)}
    flight: Flight = inventory_fields.pop("flight")
    flight_fields = {name: getattr(flight, name) for name in FLIGHT_FIELDS}
    if isinstance(flight.airborne, Unavailable):
        del flight_fields["airborne"]
    data: dict[str, Any] = to_json_types(flight_fields | inventory_fields)
    return {"schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION}, **data}


def _data_by_part(flight: Flight) -> dict[str, pd.DataFrame | Spans | Unavailable]:
    """Return all parts except positions, by their names in Flight.streams.

    Without EKF2, its state stands for all of its parts. Innovations are of the axis with the most.
    """
    ekf2, truth = flight.ekf2, flight.truth
    data_by_part = {"imu": flight.imu, "attitude": flight.attitude}
    if isinstance(ekf2, Unavailable):
        data_by_part["ekf2_state"] = ekf2
    else:
        axes = ekf2.innovations.values()
        frames = [frame for frame in axes if isinstance(frame, pd.DataFrame)]
        longest_frame = max(frames, key=len) if frames else next(iter(axes))
        data_by_part |= {"ekf2_state": ekf2.state, "ekf2_variance": ekf2.variance}
        data_by_part |= {"ekf2_innovations": longest_frame, "ekf2_fusing": ekf2.fusing}
    samples = truth if isinstance(truth, Unavailable) else truth.samples
    return {**data_by_part, "truth": samples, "airborne": flight.airborne}


def _sources(flight: Flight, compared: Comparison | None, reason: str) -> Iterator[Source]:
    data_by_part = _data_by_part(flight)
    for key, name in PART_NAMES.items():
        if key in data_by_part:
            yield _source(name, data_by_part[key], flight.streams.get(key))
        for track in flight.positions if key == "position" else ():
            chosen = compared is not None and track.name == compared.source.name
            about = {"name": track.name, "description": track.description, "chosen": chosen}
            yield _source(name, track.samples, track, **about)
        if key == "position" and not flight.positions:
            yield Source(name, unavailable=reason)


def _source(
    part: str,
    data: pd.DataFrame | Spans | Unavailable,
    stream: Stream | PositionTrack | None,
    **about: Any,
) -> Source:
    """Describe a part of the flight: samples, rate, gaps, topics and clock."""
    if isinstance(data, Unavailable):
        return Source(part, unavailable=data.reason)
    if stream is not None:
        about = {"name": stream.topics[0] if stream.topics else "", **about}
        about |= {"topics": stream.topics, "clock": stream.clock, "log": stream.log}
    if isinstance(data, pd.DataFrame):
        about["samples"] = len(data)
        times_s = data.index.tolist()
    else:
        times_s = [time_s for span in data for time_s in span]
    if times_s:
        about |= {"start_s": times_s[0], "end_s": times_s[-1]}
    if isinstance(data, pd.DataFrame) and len(data) > 1:
        about |= {
            "rate_hz": sample_rate(data),
            "gaps": _gaps(data, of_imu=part == PART_NAMES["imu"]),
        }
    return Source(part, **about)


def _gaps(frame: pd.DataFrame, *, of_imu: bool) -> Gaps:
    intervals = np.diff(frame.index.to_numpy())
    limit_s = (
        max(IMU_GAP_S, IMU_GAP_INTERVALS * float(np.median(intervals)))
        if of_imu
        else float(max_interval_s(1.0 / sample_rate(frame)))
    )
    long_intervals = intervals[intervals > limit_s]
    return Gaps(
        len(long_intervals),
        float(long_intervals.sum()),
        float(long_intervals.max(initial=0.0)),
        limit_s,
    )


def _abilities(
    flight: Flight, compared: Comparison | None, reason: str
) -> Iterator[AnalysisOption]:
    """Yield the analyses of compare, aids and what-if, each with its data or reason."""
    acceleration: object = ned_acceleration(flight)
    rows_by_name: dict[str, tuple[object, str]] = {}
    if compared is None:
        yield AnalysisOption("compare", False, reason)
    else:
        source, segment = compared.source, compared.segment
        count, span = len(within(source.samples, segment)), (segment.start_s, segment.end_s)
        description = "KF with {}, {} samples, {:.1f} s to {:.1f} s"
        yield AnalysisOption("compare", True, description.format(source.name, count, *span))
        acceleration, rows_by_name = compared.lines[0].acceleration, _ekf2_and_truth_rows(compared)
    slow = " ".join(finding.message for finding in imu.detect_low_rates(flight))
    if isinstance(acceleration, Unavailable):
        slow = f"{acceleration.reason}; KF assumes constant velocity"
    acceleration_text = "IMU rotated into NED with the attitude, gravity removed"
    yield AnalysisOption("acceleration", not slow, slow or acceleration_text)
    data_by_part = _data_by_part(flight)
    for name, key in PARTS_OF_COMPARE.items():
        logged, (used_part, description) = (
            data_by_part.get(key, flight.ekf2),
            rows_by_name.get(name, (NO_AXIS, "")),
        )
        yield _ability(name, logged if isinstance(logged, Unavailable) else used_part, description)
    aids, ekf2 = evaluate_aids(flight), flight.ekf2
    if isinstance(aids, dict) and isinstance(ekf2, Ekf2):
        rates = (f"{a.label} {_rate_text(ekf2.aids[n].samples)}" for n, a in aids.items())
        description = ", ".join(rates)
    yield _ability("aids", aids, description)
    inputs = prepare_inputs(flight)
    if not isinstance(inputs, Unavailable):
        replayed_s = sum(float(np.ptp(segment.time_s)) for segment in inputs.segments)
        description = f"EKF2 replay with {inputs.aid.label}, {replayed_s:.0f} s"
    yield _ability("what-if", inputs, description)


def _rate_text(samples: pd.DataFrame) -> str:
    """Format the rate of samples (Hz); "1 sample" for a single one."""
    return f"{sample_rate(samples):.2g} Hz" if len(samples) > 1 else "1 sample"


def _ability(name: str, part: object, description: str) -> AnalysisOption:
    """Return an analysis with its description, or with the reason if the part is missing."""
    if isinstance(part, Unavailable):
        return AnalysisOption(name, False, part.reason)
    return AnalysisOption(name, True, description)


def _ekf2_and_truth_rows(compared: Comparison) -> dict[str, tuple[object, str]]:
    """Return result and description of each analysis with EKF2 or ground truth."""
    first, truth = next(iter(compared.axes.values())), compared.flight.truth
    innovations = {name: axis.ekf2_innovations for name, axis in compared.axes.items()}
    counts = [f"{n} {len(f)}" for n, f in innovations.items() if isinstance(f, pd.DataFrame)]
    summaries = [axis.filters["ekf2"] for axis in compared.axes.values()]
    quantities_text = "position only"
    if isinstance(truth, Truth) and truth.samples[Columns.VELOCITY].notna().any(axis=None):
        quantities_text = "position and velocity"
    return {
        "EKF2 states": (
            first.difference,
            f"{_count_text(first.ekf2_state)} of position and velocity",
        ),
        "EKF2 variances": (first.ekf2_variance, _count_text(first.ekf2_variance)),
        "EKF2 consistency": (
            next(
                (summary for summary in summaries if not isinstance(summary, Unavailable)),
                summaries[0],
            ),
            f"innovations: {', '.join(counts)}",
        ),
        "error": (
            first.truth,
            f"RMSE and NEES of {quantities_text} against {getattr(truth, 'name', '')}",
        ),
    }


def _count_text(part: pd.DataFrame | Unavailable) -> str:
    return "" if isinstance(part, Unavailable) else f"{len(part)} samples"


def _logging_advice(
    flight: Flight, compared: Comparison | None, remedy: str
) -> tuple[LoggingAdvice, ...]:
    """Collect the actions of findings about the recording and of missing data, each once."""
    findings = [*recording.detect_lost_data(flight), *recording.detect_clocks_set_back(flight)]
    needs = [(remedy, "position")] if remedy else []
    if compared is not None:
        findings += [*missing.detect_source_not_logged(compared), *ekf2_not_fusing.detect(compared)]
        findings += [
            *missing.detect_missing_innovations(compared),
            *recording.detect_dropouts(compared),
        ]
    findings += imu.detect_low_rates(flight)
    needs += [
        (finding.remedy, finding_title(finding.id))
        for finding in findings
        if not finding.remedy.startswith(missing.NOTHING_TO_SET)
    ]
    # advice about the estimator's log is for PX4 only
    main_parts = (flight.imu, flight.attitude, flight.ekf2, flight.airborne)
    needs += [
        (part.remedy, part.what)
        for part in unavailable_parts(flight)
        if part is not NO_POSITION
        and (flight.log.has_ulog or any(part is main_part for main_part in main_parts))
    ]
    improves: dict[str, dict[str, None]] = {}
    for action, what in needs:
        improves.setdefault(capitalise_first(action), {})[what] = None
    return tuple(LoggingAdvice(action, tuple(purposes)) for action, purposes in improves.items())
