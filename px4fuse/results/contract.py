"""Contract of the results: one JSON object per command, its schema, and how it is written.

px4fuse reads all results with its own major version of the schema; fields of a newer minor version
are ignored.
"""

import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from px4fuse.card.model import Card
from px4fuse.comparison.causal_replays import Intervention
from px4fuse.comparison.model import AxisResult, FilterName
from px4fuse.comparison.trials import Trial
from px4fuse.convention.model import Convention
from px4fuse.ekf2.aids import AidResult
from px4fuse.ekf2.replay import Agreement, Replayed
from px4fuse.ekf2.steps import DifferenceSteps
from px4fuse.ekf2.whatif import Summary
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.time_offset import Clock
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.findings import Finding
from px4fuse.flight import Alignment
from px4fuse.log import ClockMap, InputFile, LogInfo
from px4fuse.loop.model import LoopResult
from px4fuse.position_source import DataPath, PositionKind
from px4fuse.record import Count, OrUnavailable, Positive, Record, Sha256, Span, Unavailable
from px4fuse.request import AxisName, ComparisonRequest, InputName, LoopRequest, WhatIfRequest
from px4fuse.results.model import VERSION, Provenance, Schema, Student, Version
from px4fuse.trajectory.evaluation import Score
from px4fuse.trajectory.graph.analysis import Graph
from px4fuse.trajectory.model import Track

COMPARISON = "px4fuse-results"
LOOP = "px4fuse-loop"
WHATIF = "px4fuse-whatif"
AIDS = "px4fuse-aids"
CHANGES = "px4fuse-changes"
# Significant digits of written numbers
SIGNIFICANT_DIGITS = 10


class Log(LogInfo, frozen=True, kw_only=True):
    """Log, the files that were joined with it, and the clocks that were mapped."""

    joined: tuple[InputFile, ...]
    clocks: tuple[ClockMap, ...]


class AvailableTrack(Record, frozen=True):
    """Position track of the flight."""

    name: str
    kind: PositionKind
    path: DataPath
    samples: Count
    rate_hz: Positive | None = None


class PositionSource(Record, frozen=True, kw_only=True):
    """Position source with which KF and EKF2 are compared.

    ``kind`` is the type of sensor, ``path`` the path of the data into the log.
    ``ekf2_parameters`` are the logged EKF2 parameters of the source, by PX4 name and in PX4's
    units. ``log`` is the file with the data.
    """

    name: str
    kind: PositionKind
    path: DataPath
    ekf2_parameters: Mapping[str, float]
    description: str
    reason: str
    rate_hz: Positive
    frame: Literal["NED", "FRD", "unknown"]
    clock: str
    reconstructed: bool
    topics: tuple[str, ...]
    available: tuple[AvailableTrack, ...]
    missing: tuple[Unavailable, ...]
    log: str
    alignment: Alignment | None = None


class ChosenSettings(Record, frozen=True, kw_only=True):
    """Settings of KF; ``clock_offset_s`` was added to the timestamps of the source."""

    sigma_a_m_s2: Positive
    sigma_z_m: Positive
    dt_s: Positive
    input: InputName
    start_s: float
    end_s: float
    segment_reason: str
    clock_offset_s: float


# Field of NoiseEstimate with the maximum-likelihood estimate of each KF setting
TUNED_FIELDS = {"sigma_a_m_s2": "sigma_a_two_state_m_s2", "sigma_z_m": "sigma_z_m"}


DiffSide = Literal["A", "B"]
# 95 % interval; the upper end is None if there is no upper bound
Interval = tuple[float, float | None]


class DiffInput(Record, frozen=True, kw_only=True):
    """One of the two inputs of ``px4fuse diff``: the given file, and the log it belongs to."""

    given: str
    kind: Literal["log", "report", "results"]
    log: str
    log_sha256: Sha256
    px4fuse: Version


class NumberChange(Record, frozen=True, kw_only=True):
    """Numeric result that differs between the inputs A and B.

    Attributes
    ----------
    path : str
        Path in the results: ``axes.aisle.filters.ekf2.nis_mean``.
    label, unit : str
        Name for the user, and unit; "share" is a fraction of 0 to 1.
    a, b : float
        Values; one is absent if only the other input has the number.
    a_interval, b_interval : (float, float or None)
        95 % intervals; absent if the results contain none.
    """

    path: str
    label: str
    unit: str
    a: float | None = None
    b: float | None = None
    a_interval: Interval | None = None
    b_interval: Interval | None = None


class SettingChange(Record, frozen=True):
    """Setting, PX4 parameter or property of the flight that differs; absent values are unknown."""

    name: str
    a: float | str | None = None
    b: float | str | None = None


class FindingChange(Record, frozen=True):
    """Finding that only one of the inputs A and B has."""

    id: str
    severity: Literal["error", "warning", "note"]
    message: str
    only_in: DiffSide


class _FlightResults(Record, frozen=True):
    """Base class of the results of a comparison."""

    schema: Schema
    request: ComparisonRequest
    log: Log
    source: PositionSource
    settings: ChosenSettings


class ComparisonResults(_FlightResults, frozen=True):
    """Results of ``px4fuse compare``, attached to its report.

    Attributes
    ----------
    schema : Schema
    request : ComparisonRequest
        Files and settings of the analysis.
    log : Log
    source : PositionSource
    settings : ChosenSettings
    axes : mapping of axis name to AxisResult
    horizontal : mapping of "kf" and "ekf2" to HorizontalNis
    tuning : mapping of axis name, or "horizontal" for north and east together, to NoiseEstimate
    clock : Clock
    heading : HeadingError
        Yaw misalignment between the position frame and the heading of the vehicle.
    ekf2_replay : Replayed
        Replay of EKF2 from the log, and its agreement with the logged EKF2.
    difference_steps : mapping of axis name to DifferenceSteps
        Differences between EKF2 and KF, by filter step.
    trials : tuple of Trial
        Re-runs along the main axis, with all statistics before and after.
    causes : tuple of Intervention
        Re-runs with one change each, and how much of an inconsistency each change explains.
    aids : mapping of PX4's name to AidResult
        Sensors that EKF2 fused, each with statistics of its innovations; empty without innovations.
    loop : LoopResult
    card : Card
        Diagnosis at a glance: what cover, terminal, web page and batch table show.
    findings : tuple of Finding
        Most severe first; of the same severity, missing data before noises.
    notes : tuple of str
        Choices of the analysis.
    missing : tuple of Unavailable
        Missing data, with reasons and actions.
    student : Student
    provenance : Provenance
    convention : Convention
        Axes, unit, clock and orientation of the source as sent. Absent for GNSS, and without IMU or
        attitude.
    """

    axes: Annotated[dict[AxisName, AxisResult], Meta(min_length=1)]
    horizontal: dict[FilterName, HorizontalNis]
    tuning: dict[str, OrUnavailable[NoiseEstimate]]
    clock: OrUnavailable[Clock]
    heading: OrUnavailable[HeadingError]
    ekf2_replay: OrUnavailable[Replayed]
    difference_steps: dict[str, OrUnavailable[DifferenceSteps]]
    trials: tuple[Trial, ...]
    causes: tuple[Intervention, ...]
    aids: dict[str, AidResult]
    loop: OrUnavailable[LoopResult]
    card: Card
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance
    convention: Convention | None = None


class AidsResults(Record, frozen=True):
    """Results of ``px4fuse compare`` on a flight without position source: EKF2's aids only."""

    schema: Schema
    request: ComparisonRequest
    log: Log
    aids: Annotated[dict[str, AidResult], Meta(min_length=1)]
    card: Card
    findings: tuple[Finding, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance


class TuningResults(_FlightResults, frozen=True):
    """Results of ``px4fuse tune``: maximum-likelihood noises by axis."""

    tuning: dict[str, OrUnavailable[NoiseEstimate]]
    provenance: Provenance


class SyncResults(_FlightResults, frozen=True):
    """Results of ``px4fuse sync``: time offset of the position source."""

    clock: OrUnavailable[Clock]
    provenance: Provenance


class LoopResults(Record, frozen=True):
    """Results of ``px4fuse loop`` on a flight or a trajectory, attached to its report."""

    schema: Schema
    request: LoopRequest
    track: Track
    references: tuple[Track, ...]
    loop: LoopResult
    findings: tuple[Finding, ...]
    student: Student
    provenance: Provenance


class GraphResults(Record, frozen=True):
    """Results of ``px4fuse loop`` on a pose graph."""

    schema: Schema
    graph: Graph
    provenance: Provenance


class EvaluationResults(Score, frozen=True, kw_only=True):
    """Results of ``px4fuse evaluate``: errors of the estimate against the reference."""

    schema: Schema
    estimate: Track
    reference: Track
    provenance: Provenance


class WhatIfResults(Record, frozen=True, kw_only=True):
    """Results of ``px4fuse whatif``: EKF2 as logged, as replayed, and with other parameters.

    All statistics are over the spans ``evaluated_s``. ``asked`` is True if the changes of
    ``whatif`` are the maximum-likelihood estimates; ``sweep`` contains one summary per value.
    """

    schema: Schema
    request: WhatIfRequest
    log: Log
    agreement: Agreement
    evaluated_s: tuple[Span, ...]
    asked: bool
    logged: Summary
    replayed: Summary
    whatif: Summary | None = None
    sweep: tuple[Summary, ...] = ()
    notes: tuple[str, ...]
    provenance: Provenance


class ChangeResults(Record, frozen=True, kw_only=True):
    """Results of ``px4fuse diff``: differences from A to B.

    Attributes
    ----------
    schema : Schema
    a, b : DiffInput
    settings : tuple of SettingChange
    numbers : tuple of NumberChange
    findings : tuple of FindingChange
    worse : tuple of str
        Verdicts that are worse in B, one sentence each; if there are any, the exit code is 1.
    provenance : Provenance
    """

    schema: Schema
    a: DiffInput
    b: DiffInput
    settings: tuple[SettingChange, ...]
    numbers: tuple[NumberChange, ...]
    findings: tuple[FindingChange, ...]
    worse: tuple[str, ...]
    provenance: Provenance


ReportedResults = ComparisonResults | LoopResults
Results = (
    ReportedResults
    | AidsResults
    | TuningResults
    | SyncResults
    | GraphResults
    | EvaluationResults
    | WhatIfResults
    | ChangeResults
)
# Types of results by the name in their schema
KINDS: dict[str, type[Results]] = {
    COMPARISON: ComparisonResults,
    LOOP: LoopResults,
    AIDS: AidsResults,
    "px4fuse-tuning": TuningResults,
    "px4fuse-sync": SyncResults,
    "px4fuse-graph": GraphResults,
    "px4fuse-evaluation": EvaluationResults,
    WHATIF: WhatIfResults,
    CHANGES: ChangeResults,
}


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of all results."""
    kinds: dict[type, None] = dict.fromkeys(KINDS.values())
    components: dict[str, Any] = {}

    def describe_union(kind: Any) -> dict[str, Any]:
        kinds.update(dict.fromkeys(kind.union_members))
        return {"anyOf": [{"$ref": f"#/$defs/{member.__name__}"} for member in kind.union_members]}

    count = 0
    # each pass adds the types inside RecordOrUnavailable, which msgspec does not resolve
    while count < len(kinds):
        count = len(kinds)
        _, components = msgspec.json.schema_components(
            list(kinds), schema_hook=describe_union, ref_template="#/$defs/{name}"
        )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"px4fuse-results-{VERSION}",
        "title": "Results of px4fuse",
        "description": f"Numbers have at most {SIGNIFICANT_DIGITS} significant digits, or six "
        "decimals if that is more precise.",
        "oneOf": [
            {
                "$ref": f"#/$defs/{kind.__name__}",
                "properties": {"schema": {"properties": {"name": {"const": name}}}},
            }
            for name, kind in KINDS.items()
        ],
        "$defs": components,
    }


def to_plain(results: msgspec.Struct) -> dict[str, Any]:
    """Convert results to dicts, lists and numbers, by their JSON names."""
    plain_results: dict[str, Any] = msgspec.to_builtins(results, enc_hook=_plain)
    return plain_results


def round_number(value: float) -> float:
    """Round to ten significant digits, or to six decimals if that is more precise.

    UNIX times need the six decimals. Further digits depend on the processor, as linear algebra
    libraries add in different orders.

    >>> round_number(0.1 + 0.2), round_number(1795251250.2020123)
    (0.3, 1795251250.202012)
    """
    return round(value, 6) if abs(value) >= 1e4 else float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def _round_numbers(value: Any) -> Any:
    """Round all floats by :func:`round_number`."""
    if isinstance(value, dict):
        return {name: _round_numbers(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_round_numbers(part) for part in value]
    return round_number(value) if isinstance(value, float) else value


def _plain(value: Any) -> float | dict[str, Any]:
    """Convert a numpy number to a float, and a mapping to a dict.

    Raises
    ------
    NotImplementedError
        The value is neither.
    """
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, float):
        return float(value)
    raise NotImplementedError(f"results cannot contain a {type(value).__name__}")


def to_json(results: msgspec.Struct | dict[str, Any]) -> str:
    """Write results as JSON: stable order, rounded numbers, one trailing newline.

    Raises
    ------
    ValueError
        A number is not finite.
    """
    plain_results = to_plain(results) if isinstance(results, msgspec.Struct) else results
    plain = _round_numbers(plain_results)
    return json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def file_hashes_in(text: str) -> list[str]:
    """Return the SHA-256 of all input files named in results (JSON text), in order."""
    return re.findall(r'"([0-9a-f]{64})"', text)
