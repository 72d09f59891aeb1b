"""Contents of a log, possible analyses, and logging advice for the next flight."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.comparison.comparison import project_tracks
from px4fuse.comparison.flight_events import compute_max_interval_s
from px4fuse.comparison.model import FilterTracks, PreparedComparison
from px4fuse.comparison.preparation import prepare_comparison_inputs, select_source_innovations
from px4fuse.core.text import capitalise_first_letter, format_utc_time, to_json_types
from px4fuse.ekf2.aids import evaluate_aids
from px4fuse.ekf2.inputs import prepare_inputs
from px4fuse.errors import MissingDataError, Px4FuseError
from px4fuse.filter.signals import (
    MIN_IMU_GAP_INTERVALS,
    MIN_IMU_GAP_S,
    Segment,
    cut_to_segment,
    imu_and_attitude,
)
from px4fuse.findings import ekf2_fusion, imu, recording
from px4fuse.findings.model import finding_title
from px4fuse.flight.model import (
    DIAGNOSIS_WITHHELD,
    DataSource,
    Ekf2,
    Flight,
    PositionTrack,
    Spans,
    Unavailable,
    compute_sample_rate_hz,
)
from px4fuse.request import ComparisonRequest, replace_argument_names

from .tables import list_missing_data

SCHEMA_NAME = "px4fuse-info"
SCHEMA_VERSION = "1.0"
# Fields of the class Flight that px4fuse info writes to JSON
FLIGHT_FIELDS_IN_JSON = ("log", "airborne", "clocks", "missing", "unused", "inputs")
# Label of each type of data in a log, except positions
STREAM_LABELS = {
    "imu": "IMU",
    "attitude": "attitude",
    "ekf2_state": "EKF2 state",
    "ekf2_variance": "EKF2 variance",
    "ekf2_innovations": "innovations",
    "ekf2_fusing": "fusion flags",
    "truth": "ground truth",
    "airborne": "land detector",
}


@dataclass(frozen=True)
class AnalysisOption:
    """Analysis, with the data that it uses or the reason why it is not possible."""

    name: str
    possible: bool
    reason: str


@dataclass(frozen=True)
class LoggingAdvice:
    """Logging advice for the next flight, and the data or analyses that it improves."""

    remedy: str
    improves: tuple[str, ...]


@dataclass(frozen=True)
class GapStatistics:
    """Gaps longer than ``limit_s`` between samples: number, total and longest duration (s)."""

    count: int
    total_s: float
    longest_s: float
    limit_s: float


@dataclass(frozen=True)
class LoggedData:
    """Logged data of one type: topics, rate and gaps, or the reason why they are missing.

    Attributes
    ----------
    part : str
        Type of data, for example "IMU".
    name : str
        Name of the position source, or of the first topic.
    log : str
        Name of the file that contains the data.
    samples : int or None
        Number of samples; None for the land detector.
    start_s, end_s : float or None
        Times (s) of the first and last sample.
    chosen : bool
        True for the position source that ``px4fuse compare`` uses by default.
    unavailable : str
        Reason why the data are missing, otherwise "".
    """

    part: str
    name: str = ""
    topics: tuple[str, ...] = ()
    clock: str = ""
    log: str = ""
    samples: int | None = None
    rate_hz: float | None = None
    gaps: GapStatistics | None = None
    start_s: float | None = None
    end_s: float | None = None
    chosen: bool = False
    description: str = ""
    unavailable: str = ""


@dataclass(frozen=True)
class Inventory:
    """Contents of a log, as shown by ``px4fuse info``.

    Attributes
    ----------
    start_utc : str or None
        Time of the first sample (UTC, ISO 8601).
    sources : tuple of LoggedData
        Logged data by type.
    source_reason : str
        Reason for the choice of the position source.
    segment : Segment or None
        Time span that ``px4fuse compare`` analyses by default.
    abilities : tuple of AnalysisOption
        Analyses that are possible or not possible with the log.
    advice : tuple of LoggingAdvice
        Logging advice for the next flight.
    """

    flight: Flight
    start_utc: str | None
    sources: tuple[LoggedData, ...]
    source_reason: str
    segment: Segment | None
    abilities: tuple[AnalysisOption, ...]
    advice: tuple[LoggingAdvice, ...]
    notes: tuple[str, ...]


def list_log_contents(flight: Flight) -> Inventory:
    """List the data in a log, the possible analyses and the logging advice."""
    log = flight.log
    notes = [*log.damage]
    if log.ends_in_flight and not log.damage:
        notes.append("the log ends in flight and does not contain the landing")
    notes += log.notes
    comparison, segment, missing_position_remedy = None, None, ""
    # `reason` states why the position source was chosen or, after an error, why KF cannot run
    try:
        comparison = prepare_comparison_inputs(
            flight, ComparisonRequest(log=log.name), keep_positions_as_sent=True
        )
    except Px4FuseError as error:
        # The error names arguments of the Python API and the log file. Name the options of the
        # command line instead, and omit the log file
        reason = replace_argument_names(error.reason).removeprefix(f"{log.name}: ")
        missing_position_remedy = replace_argument_names(error.remedy)
        if not isinstance(error, MissingDataError):
            # The log has too few positions. The error advises other settings of the analysis, which
            # do not help for the next flight
            missing_position_remedy = (
                "Set SDLOG_MODE to 0 (logging from arming) to record the whole flight."
            )
    else:
        reason, segment = comparison.source_reason, comparison.segment
        notes += comparison.source.notes
        flight = select_source_innovations(flight, comparison.source)
    if isinstance(flight.ekf2, Ekf2):
        notes += flight.ekf2.notes
    return Inventory(
        flight=flight,
        start_utc=format_utc_time(log.start_unix_s),
        sources=tuple(_list_logged_data(flight, comparison, reason)),
        source_reason=reason,
        segment=segment,
        abilities=tuple(_list_analyses(flight, comparison, reason)),
        advice=_collect_logging_advice(flight, comparison, missing_position_remedy),
        notes=tuple(notes),
    )


def to_json_dict(inventory: Inventory) -> dict[str, Any]:
    """Convert the contents of a log to JSON types; None and NaN are omitted."""
    inventory_fields = {**vars(inventory)}
    flight: Flight = inventory_fields.pop("flight")
    flight_fields = {name: getattr(flight, name) for name in FLIGHT_FIELDS_IN_JSON}
    if isinstance(flight.airborne, Unavailable):
        del flight_fields["airborne"]
    return {
        "schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION},
        **to_json_types(flight_fields | inventory_fields),
    }


def _list_logged_data(
    flight: Flight, comparison: PreparedComparison | None, reason: str
) -> Iterator[LoggedData]:
    """Yield one entry for each type of data in a log, and for each position source."""

    def describe_stream(name: str, data: pd.DataFrame | Spans | Unavailable) -> LoggedData:
        """Return the entry of a type of data, by its key in STREAM_LABELS."""
        return _make_logged_data(STREAM_LABELS[name], data, flight.streams.get(name))

    ekf2, truth = flight.ekf2, flight.truth
    yield describe_stream("imu", flight.imu)
    yield describe_stream("attitude", flight.attitude)
    for track in flight.positions:
        yield _make_logged_data(
            "position",
            track.samples,
            track,
            name=track.name,
            description=track.description,
            chosen=comparison is not None and track.name == comparison.source.name,
        )
    if not flight.positions:
        yield LoggedData("position", unavailable=reason)
    if isinstance(ekf2, Unavailable):
        yield describe_stream("ekf2_state", ekf2)
    else:
        yield describe_stream("ekf2_state", ekf2.state)
        yield describe_stream("ekf2_variance", ekf2.variance)
        # use the axis with most innovations, because some axes may not be logged
        innovations = max(
            ekf2.innovations.values(),
            key=lambda samples: len(samples) if isinstance(samples, pd.DataFrame) else -1,
        )
        yield describe_stream("ekf2_innovations", innovations)
        yield describe_stream("ekf2_fusing", ekf2.fusion_flags)
    yield describe_stream("truth", truth if isinstance(truth, Unavailable) else truth.samples)
    yield describe_stream("airborne", flight.airborne)


def _make_logged_data(
    data_label: str,
    data: pd.DataFrame | Spans | Unavailable,
    stream: DataSource | PositionTrack | None,
    **data_fields: Any,
) -> LoggedData:
    if isinstance(data, Unavailable):
        return LoggedData(data_label, unavailable=data.reason)
    if stream is not None:
        data_fields = {"name": stream.topics[0] if stream.topics else "", **data_fields}
        data_fields |= {"topics": stream.topics, "clock": stream.clock, "log": stream.log}
    if isinstance(data, pd.DataFrame):
        data_fields["samples"] = len(data)
        times_s = data.index.tolist()
        if len(data) > 1:
            data_fields["rate_hz"] = compute_sample_rate_hz(data)
            data_fields["gaps"] = _measure_gaps(data, is_imu=data_label == STREAM_LABELS["imu"])
    else:
        times_s = [time_s for span in data for time_s in span]
    if times_s:
        data_fields |= {"start_s": times_s[0], "end_s": times_s[-1]}
    return LoggedData(data_label, **data_fields)


def _measure_gaps(samples: pd.DataFrame, *, is_imu: bool) -> GapStatistics:
    """Return number and duration of the gaps between samples."""
    intervals_s = np.diff(samples.index.to_numpy())
    limit_s = (
        max(MIN_IMU_GAP_S, MIN_IMU_GAP_INTERVALS * float(np.median(intervals_s)))
        if is_imu
        else float(compute_max_interval_s(1.0 / compute_sample_rate_hz(samples)))
    )
    long_intervals_s = intervals_s[intervals_s > limit_s]
    return GapStatistics(
        len(long_intervals_s),
        float(long_intervals_s.sum()),
        float(long_intervals_s.max(initial=0.0)),
        limit_s,
    )


def _list_analyses(
    flight: Flight, comparison: PreparedComparison | None, reason: str
) -> Iterator[AnalysisOption]:
    """Yield each analysis, with the data that it uses or the reason why it is not possible."""
    if comparison is None:
        yield AnalysisOption("compare", False, reason)
    else:
        source, segment = comparison.source, comparison.segment
        sample_count = len(cut_to_segment(source.samples, segment))
        yield AnalysisOption(
            "compare",
            True,
            f"KF from {sample_count} samples of position source {source.name}, "
            f"{segment.start_s:.1f} s to {segment.end_s:.1f} s",
        )
    low_rate_findings = () if flight.log.is_assessed else imu.detect_low_rates(flight)
    imu_fault_text = " ".join(finding.message for finding in low_rate_findings)
    if isinstance(missing_data := imu_and_attitude(flight), Unavailable):
        imu_fault_text = f"{missing_data.reason}; KF assumes constant velocity"
    acceleration_text = "IMU acceleration as input of KF, in NED and without gravity"
    yield AnalysisOption("acceleration", not imu_fault_text, imu_fault_text or acceleration_text)
    yield from _list_ekf2_and_truth_analyses(flight, comparison)
    results_by_aid, ekf2 = evaluate_aids(flight), flight.ekf2
    if isinstance(results_by_aid, Unavailable):
        yield AnalysisOption("aiding sources of EKF2", False, results_by_aid.reason)
    elif isinstance(ekf2, Ekf2):
        rate_texts = (
            f"{aid.label}: {compute_sample_rate_hz(samples):.2g} Hz"
            if len(samples := ekf2.aids[name].samples) > 1
            else f"{aid.label}: 1 sample"
            for name, aid in results_by_aid.items()
        )
        rates_text = f"innovations of {'; '.join(rate_texts)}"
        yield AnalysisOption("aiding sources of EKF2", True, rates_text)
    replay_inputs = prepare_inputs(flight)
    if isinstance(replay_inputs, Unavailable):
        yield AnalysisOption("what-if", False, replay_inputs.reason)
    else:
        duration_s = sum(np.ptp(segment.time_s) for segment in replay_inputs.segments)
        replay_text = f"EKF2 replay of {duration_s:.0f} s with {replay_inputs.aid.label}"
        yield AnalysisOption("what-if", True, replay_text)


def _list_ekf2_and_truth_analyses(
    flight: Flight, comparison: PreparedComparison | None
) -> Iterator[AnalysisOption]:
    """Yield the analyses that need EKF2 data or ground truth."""
    if comparison is not None:
        main_axis, segment = comparison.input_axes[0], comparison.segment
        tracks, truth = project_tracks(comparison, flight.ekf2, main_axis, segment)
    else:
        no_source = Unavailable("KF", "the log contains no position source for KF", "")
        ekf2, truth = (
            data if isinstance(data, Unavailable) else no_source
            for data in (flight.ekf2, flight.truth)
        )
        tracks = FilterTracks(ekf2, ekf2, ekf2)
    for name, data, sample_text in (
        ("EKF2 states", tracks.state, "samples of EKF2's position and velocity"),
        ("EKF2 variances", tracks.variance, "samples of EKF2's position and velocity variances"),
        ("EKF2 consistency", tracks.innovations, "EKF2 innovations"),
        ("error against ground truth", truth, "samples of ground truth"),
    ):
        if isinstance(data, Unavailable):
            yield AnalysisOption(name, False, data.reason)
        else:
            yield AnalysisOption(name, True, f"from {len(data)} {sample_text}")


def _collect_logging_advice(
    flight: Flight, comparison: PreparedComparison | None, missing_position_remedy: str
) -> tuple[LoggingAdvice, ...]:
    """Collect logging advice for the next flight: from errors, findings and missing data.

    ``missing_position_remedy`` is the advice for a log without positions.
    """
    if flight.log.is_assessed:
        return (LoggingAdvice("None", (DIAGNOSIS_WITHHELD.reason,)),)
    findings = [*recording.detect_lost_data(flight), *recording.detect_backward_clock_jumps(flight)]
    if comparison is not None:
        findings += recording.detect_source_not_logged(comparison)
        findings += ekf2_fusion.detect_unfused_positions(comparison)
        findings += recording.detect_dropouts(comparison)
    findings += imu.detect_low_rates(flight)
    needed_data: tuple[object, ...] = list_missing_data(flight)
    if not flight.log.writes_ulog:
        # A MAVLink recording can contain only these data
        needed_data = (flight.imu, flight.attitude, flight.ekf2, flight.airborne)
    actions_and_purposes = [
        (missing_position_remedy, "position"),
        *((finding.remedy, finding_title(finding.id)) for finding in findings),
        *((data.remedy, data.what) for data in needed_data if isinstance(data, Unavailable)),
    ]
    # Dictionaries without values instead of sets, to keep the order
    purposes_by_action: dict[str, dict[str, None]] = {}
    for action, purpose in actions_and_purposes:
        if action:
            purposes_by_action.setdefault(capitalise_first_letter(action), {})[purpose] = None
    return tuple(
        LoggingAdvice(action, tuple(purposes)) for action, purposes in purposes_by_action.items()
    )
