"""The results contract: one JSON object per command, its schema, and how it is written.

Everything that px4fuse writes with a major version is read by the same major version; a new field
raises the minor one.
"""

import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from px4fuse.comparison.interventions import Intervention
from px4fuse.comparison.model import AxisResult, FilterName
from px4fuse.ekf2.aids import AidResult
from px4fuse.ekf2.replay import Agreement, Replayed
from px4fuse.ekf2.walk import WhySteps
from px4fuse.ekf2.whatif import Summary
from px4fuse.filter.clock import Clock
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.findings import Finding
from px4fuse.flight import Alignment
from px4fuse.loop.model import LoopResult
from px4fuse.origin import Passage, PositionKind
from px4fuse.record import Count, OrUnavailable, Positive, Record, Sha256, Span, Unavailable
from px4fuse.recording import ClockMap, InputFile, LogInfo
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
# Of the numbers that are written
SIGNIFICANT_DIGITS = 10


class Log(LogInfo, frozen=True, kw_only=True):
    """The recording, the files that were read beside it, and the clocks that were mapped."""

    joined: tuple[InputFile, ...]
    clocks: tuple[ClockMap, ...]


class AvailableTrack(Record, frozen=True):
    """A position track of the flight."""

    name: str
    kind: PositionKind
    passage: Passage
    samples: Count
    rate_hz: Positive | None = None


class PositionSource(Record, frozen=True, kw_only=True):
    """The position that both filters are judged by.

    ``kind`` and ``passage`` say where it comes from and how it got into the flight,
    ``ekf2_parameters`` what the log has of EKF2's parameters for it, by PX4 name and in PX4's
    units; ``log`` is the file that it was read from.
    """

    name: str
    kind: PositionKind
    passage: Passage
    ekf2_parameters: Mapping[str, float]
    description: str
    reason: str
    rate_hz: Positive
    frame: Literal["NED", "FRD", "unknown"]
    clock: str
    reconstructed: bool
    topics: tuple[str, ...]
    available: tuple[AvailableTrack, ...]
    not_in_log: tuple[Unavailable, ...]
    log: str
    alignment: Alignment | None = None


class ChosenSettings(Record, frozen=True, kw_only=True):
    """Settings of the filter; ``clock_offset_s`` was added to the source's time stamps."""

    sigma_a_m_s2: Positive
    sigma_z_m: Positive
    dt_s: Positive
    input: InputName
    start_s: float
    end_s: float
    segment_reason: str
    clock_offset_s: float


# Field of Tuned that says what each setting of the filter should be
TUNED_FIELDS = {"sigma_a_m_s2": "filter_sigma_a_m_s2", "sigma_z_m": "sigma_z_m"}


Which = Literal["A", "B"]
# 95 %; the upper end is None if nothing bounds it
Interval = tuple[float, float | None]


class Compared(Record, frozen=True, kw_only=True):
    """One of the two: what was given, and the flight that it is of."""

    given: str
    kind: Literal["log", "report", "results"]
    log: str
    log_sha256: Sha256
    px4fuse: Version


class NumberChange(Record, frozen=True, kw_only=True):
    """One number that differs.

    Attributes
    ----------
    path : str
        Path in the results of both: ``axes.aisle.filters.ekf2.nis_mean``.
    label, unit : str
        The unit "share" is for 0 to 1.
    a, b : float
        Absent if only the other one has it.
    a_interval, b_interval : (float, float or None)
        95 %; absent if none is recorded.
    """

    path: str
    label: str
    unit: str
    a: float | None = None
    b: float | None = None
    a_interval: Interval | None = None
    b_interval: Interval | None = None


class SettingChange(Record, frozen=True):
    """A setting, a parameter of PX4 or a fact about the flight that differs; absent if unknown."""

    name: str
    a: float | str | None = None
    b: float | str | None = None


class FindingChange(Record, frozen=True):
    """A finding that only one of the two has."""

    id: str
    severity: Literal["error", "warning", "info"]
    message: str
    only_in: Which


class _FlightResults(Record, frozen=True):
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
        What was analysed and how.
    log : Log
    source : PositionSource
    settings : ChosenSettings
    axes : mapping of axis name to AxisResult
    horizontal : mapping of "kf" and "ekf2" to HorizontalNis
    tuning : mapping of axis name, or "horizontal" for north and east together, to Tuned
    clock : Clock
    heading : HeadingError
        How the source's frame is turned against the vehicle's heading.
    ekf2_replay : Replayed
        EKF2 replayed from the log, and how well that agrees with what was logged.
    why : mapping of axis name to WhySteps
        Why EKF2 differs.
    causes : tuple of Intervention
        What was changed, each by a replay, and what that explains of what is not consistent.
    aids : mapping of PX4's name to AidResult
        What EKF2 fused in flight, each judged by its own innovations; empty where none can be.
    loop : LoopPart
    story : tuple of str
        What happened, in up to three sentences.
    findings : tuple of Finding
        One per cause, most severe first, what the recording lacks before noises.
    notes : tuple of str
        Choices made on the way.
    missing : tuple of Unavailable
        What was looked for and not found.
    student : Student
    provenance : Provenance
    """

    axes: Annotated[dict[AxisName, AxisResult], Meta(min_length=1)]
    horizontal: dict[FilterName, HorizontalNis]
    tuning: dict[str, OrUnavailable[NoiseEstimate]]
    clock: OrUnavailable[Clock]
    heading: OrUnavailable[HeadingError]
    ekf2_replay: OrUnavailable[Replayed]
    why: dict[str, OrUnavailable[WhySteps]]
    causes: tuple[Intervention, ...]
    aids: dict[str, AidResult]
    loop: OrUnavailable[LoopResult]
    story: tuple[str, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance


class AidsResults(Record, frozen=True):
    """Results of ``px4fuse compare`` on a flight without a position source: EKF2's aids alone."""

    schema: Schema
    request: ComparisonRequest
    log: Log
    aids: Annotated[dict[str, AidResult], Meta(min_length=1)]
    findings: tuple[Finding, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance


class TuningResults(_FlightResults, frozen=True):
    """Results of ``px4fuse tune``: the noises that the data ask for, by axis."""

    tuning: dict[str, OrUnavailable[NoiseEstimate]]
    provenance: Provenance


class SyncResults(_FlightResults, frozen=True):
    """Results of ``px4fuse sync``: the clock offset of the position source."""

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
    """Results of ``px4fuse evaluate``: the score, and what was scored against what."""

    schema: Schema
    estimate: Track
    reference: Track
    provenance: Provenance


class WhatIfResults(Record, frozen=True, kw_only=True):
    """Results of ``px4fuse whatif``: EKF2 as logged, as replayed, and with other parameters.

    All are judged over the times ``judged_s``. ``asked`` says that the changes of ``whatif`` are
    what the data ask for; ``sweep`` has an outcome per value.
    """

    schema: Schema
    request: WhatIfRequest
    log: Log
    agreement: Agreement
    judged_s: tuple[Span, ...]
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
    a, b : Compared
    settings : tuple of SettingChange
    numbers : tuple of NumberChange
    findings : tuple of FindingChange
    worse : tuple of str
        Verdicts that are worse in B, a sentence each; the exit code is 1 if there are any.
    provenance : Provenance
    """

    schema: Schema
    a: Compared
    b: Compared
    settings: tuple[SettingChange, ...]
    numbers: tuple[NumberChange, ...]
    findings: tuple[FindingChange, ...]
    worse: tuple[str, ...]
    provenance: Provenance


Reported = ComparisonResults | LoopResults
Results = (
    Reported
    | AidsResults
    | TuningResults
    | SyncResults
    | GraphResults
    | EvaluationResults
    | WhatIfResults
    | ChangeResults
)
# By the name in their schema
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
    """JSON Schema (draft 2020-12) of everything that is written as results."""
    kinds: dict[type, None] = dict.fromkeys(KINDS.values())
    components: dict[str, Any] = {}

    def either(kind: Any) -> dict[str, Any]:
        kinds.update(dict.fromkeys(kind.kinds))
        return {"anyOf": [{"$ref": f"#/$defs/{one.__name__}"} for one in kind.kinds]}

    known = 0
    while known < len(kinds):  # msgspec does not look into an Either by itself
        known = len(kinds)
        _, components = msgspec.json.schema_components(
            list(kinds), schema_hook=either, ref_template="#/$defs/{name}"
        )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"px4fuse-results-{VERSION}",
        "title": "Results of px4fuse",
        "description": f"Numbers have {SIGNIFICANT_DIGITS} significant digits at most, or six "
        "decimals where that is finer.",
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
    """Results as dicts, lists and numbers, by the names that they have in JSON."""
    plain_results: dict[str, Any] = msgspec.to_builtins(results, enc_hook=_plain)
    return plain_results


def round_number(value: float) -> float:
    """Round to ten significant digits, or to 1e-6 where that is finer (times of the UNIX clock).

    Digits beyond those depend on the processor: linear algebra libraries add in another order.

    >>> round_number(0.1 + 0.2), round_number(1795251250.2020123)
    (0.3, 1795251250.202012)
    """
    return round(value, 6) if abs(value) >= 1e4 else float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def _round_numbers(value: Any) -> Any:
    """Return plain results with every float rounded by :func:`round_number`."""
    if isinstance(value, dict):
        return {name: _round_numbers(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_round_numbers(part) for part in value]
    return round_number(value) if isinstance(value, float) else value


def _plain(value: Any) -> float | dict[str, Any]:
    """A number of numpy's as Python's own, any mapping as a dict.

    Raises
    ------
    NotImplementedError
        It is neither.
    """
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, float):
        return float(value)
    raise NotImplementedError(f"results cannot hold a {type(value).__name__}")


def to_json(results: msgspec.Struct | dict[str, Any]) -> str:
    """Text of results: stable order, numbers as :func:`round_number`, one trailing newline.

    Raises
    ------
    ValueError
        A number in them is not finite.
    """
    plain_results = to_plain(results) if isinstance(results, msgspec.Struct) else results
    plain = _round_numbers(plain_results)
    return json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def file_hashes_in(text: str) -> list[str]:
    """SHA-256 of every file that results as JSON rest on, as they stand there."""
    return re.findall(r'"([0-9a-f]{64})"', text)
