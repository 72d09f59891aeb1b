"""Types of the JSON results of all commands, their JSON Schema, and writing.

px4fuse reads results with the same major version of the schema.
"""

import json
import re
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from px4fuse.card.model import DiagnosisCard
from px4fuse.comparison.model import AxisComparison, FilterName
from px4fuse.comparison.rerun_effects import Rerun
from px4fuse.convention.model import Convention
from px4fuse.core.record import (
    Count,
    OrUnavailable,
    PositiveFloat,
    Record,
    Sha256,
    Span,
    Unavailable,
)
from px4fuse.core.text import convert_nested
from px4fuse.ekf2.aids import AidResult
from px4fuse.ekf2.replay import Ekf2Replay, ReplayAgreement
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2.whatif import Ekf2Statistics
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.finding import Finding
from px4fuse.flight.model import (
    Alignment,
    ClockConversion,
    InputFile,
    LogInfo,
    PositionKind,
    PositionRoute,
)
from px4fuse.loop.model import Loop
from px4fuse.request import AxisName, ComparisonRequest, KfInputName, LoopRequest, WhatIfRequest
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.solver import Graph
from px4fuse.trajectory.model import TrajectorySummary

from .model import SCHEMA_VERSION, Provenance, Schema, Student, Version

# Maximum number of significant digits of a number in the results
SIGNIFICANT_DIGITS = 10


class Log(LogInfo, kw_only=True):
    """Log, additional input files (``joined``), and clocks converted to boot time."""

    joined: tuple[InputFile, ...]
    clocks: tuple[ClockConversion, ...]


class AvailableTrack(Record):
    name: str
    kind: PositionKind
    path: PositionRoute
    samples: Count
    rate_hz: PositiveFloat | None = None


class PositionSource(Record, kw_only=True):
    """Source (UWB, vision, GNSS, ...) of the positions that KF fuses.

    Attributes
    ----------
    kind : str
        Type of sensor.
    path : str
        Origin of the positions, for example "as received" by PX4, or "rebuilt from innovations".
    ekf2_parameters : mapping
        Logged EKF2 parameters for this source, in units of PX4.
    reason : str
        Reason for the choice of this source.
    reconstructed : bool
        True if the positions were computed from other data in the log.
    available : tuple of AvailableTrack
        All position sources in the log.
    log : str
        Name of the file that contains the positions.
    """

    name: str
    kind: PositionKind
    path: PositionRoute
    ekf2_parameters: Mapping[str, float]
    description: str
    reason: str
    rate_hz: PositiveFloat
    frame: Literal["NED", "FRD", "unknown"]
    clock: str
    reconstructed: bool
    topics: tuple[str, ...]
    available: tuple[AvailableTrack, ...]
    missing: tuple[Unavailable, ...]
    log: str
    alignment: Alignment | None = None


class ChosenSettings(Record, kw_only=True):
    """Settings of KF, analysed time span, and time offset added to the position timestamps."""

    sigma_a_m_s2: PositiveFloat
    sigma_z_m: PositiveFloat
    dt_s: PositiveFloat
    input: KfInputName
    start_s: float
    end_s: float
    segment_reason: str
    clock_offset_s: float


DiffInputName = Literal["A", "B"]
# 95 % interval; the upper bound is None if the data do not limit it
ConfidenceInterval = tuple[float, float | None]


class DiffInput(Record, kw_only=True):
    """Input A or B of ``px4fuse diff``: file name as given by the user, and its log."""

    given: str
    kind: Literal["log", "report", "results"]
    log: str
    log_sha256: Sha256
    px4fuse: Version


class NumberChange(Record, kw_only=True):
    """Number that differs between the inputs A and B of ``px4fuse diff``.

    Attributes
    ----------
    path : str
        Field of the results, for example ``axes.aisle.filters.ekf2.nis_mean``.
    unit : str
        Unit of both values; "share" for fractions from 0 to 1.
    a, b : float or None
        Values in A and B; None for a missing number.
    a_interval, b_interval : (float, float or None), or None
        95 % intervals of the values.
    """

    path: str
    label: str
    unit: str
    a: float | None = None
    b: float | None = None
    a_interval: ConfidenceInterval | None = None
    b_interval: ConfidenceInterval | None = None


class SettingChange(Record):
    """Setting, PX4 parameter or property of a flight that differs between the inputs A and B."""

    name: str
    a: float | str | None = None
    b: float | str | None = None


class UnsharedFinding(Record):
    """Finding in the results of only one of two compared inputs, A or B."""

    id: str
    severity: Literal["error", "warning", "note"]
    message: str
    only_in: DiffInputName


class _FlightResults(Record):
    """Base class of the results for a flight with positions, on which KF can run."""

    schema: Schema
    request: ComparisonRequest
    log: Log
    source: PositionSource
    settings: ChosenSettings


class ComparisonResults(_FlightResults):
    """Results of ``px4fuse compare``.

    Attributes
    ----------
    tuning : mapping of axis name to AxisTuning
        Estimated noises; "horizontal" is one estimate for north and east together.
    heading : HeadingError
        Yaw misalignment between the position frame and the heading of the vehicle.
    ekf2_replay : Ekf2Replay
        Replay of EKF2, and its agreement with the logged EKF2.
    difference_steps : mapping of axis name to DifferenceExplanation
        Re-runs of KF that explain the difference KF - EKF2.
    trials : tuple of Rerun
        Re-runs of KF and EKF2, each with one change of a setting or of the data.
    card : DiagnosisCard
        Summary of the diagnosis.
    convention : Convention
        Detected axes, unit, clock and orientation of the positions.
    """

    axes: Annotated[dict[AxisName, AxisComparison], Meta(min_length=1)]
    horizontal: dict[FilterName, HorizontalNis]
    tuning: dict[str, OrUnavailable[AxisTuning]]
    clock: OrUnavailable[SourceTimeOffset]
    heading: OrUnavailable[HeadingError]
    ekf2_replay: OrUnavailable[Ekf2Replay]
    difference_steps: dict[str, OrUnavailable[DifferenceExplanation]]
    trials: tuple[Rerun, ...]
    aids: dict[str, AidResult]
    loop: OrUnavailable[Loop]
    card: DiagnosisCard
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance
    convention: Convention | None = None


class AidsResults(Record):
    """Results of ``px4fuse compare`` for a log without positions: EKF2's aiding sources only."""

    schema: Schema
    request: ComparisonRequest
    log: Log
    aids: Annotated[dict[str, AidResult], Meta(min_length=1)]
    card: DiagnosisCard
    findings: tuple[Finding, ...]
    missing: tuple[Unavailable, ...]
    student: Student
    provenance: Provenance


class TuningResults(_FlightResults):
    """Results of ``px4fuse tune``: maximum-likelihood estimates of the noises, by axis."""

    tuning: dict[str, OrUnavailable[AxisTuning]]
    provenance: Provenance


class SyncResults(_FlightResults):
    """Results of ``px4fuse sync``: time offset of the position source."""

    clock: OrUnavailable[SourceTimeOffset]
    provenance: Provenance


class LoopResults(Record):
    """Results of ``px4fuse loop`` on a flight or a trajectory."""

    schema: Schema
    request: LoopRequest
    track: TrajectorySummary
    references: tuple[TrajectorySummary, ...]
    loop: Loop
    findings: tuple[Finding, ...]
    student: Student
    provenance: Provenance


class GraphResults(Record):
    """Results of ``px4fuse loop`` on a pose graph file."""

    schema: Schema
    graph: Graph
    provenance: Provenance


class EvaluationResults(Evaluation, kw_only=True):
    """Results of ``px4fuse evaluate``: errors of a trajectory against a reference trajectory."""

    schema: Schema
    estimate: TrajectorySummary
    reference: TrajectorySummary
    provenance: Provenance


class WhatIfResults(Record, kw_only=True, rename={"uses_estimates": "asked"}):
    """Results of ``px4fuse whatif``: statistics of EKF2 with logged and with changed parameters.

    Attributes
    ----------
    agreement : ReplayAgreement
        Agreement of the EKF2 replay with the logged EKF2.
    evaluated_s : tuple of (float, float)
        Time spans (s) of all statistics.
    uses_estimates : bool
        True if the parameters are maximum-likelihood estimates.
    logged, replayed, whatif : Ekf2Statistics
        EKF2 as logged, replay with logged parameters, replay with changed parameters.
    sweep : tuple of Ekf2Statistics
        Replays with several values of one parameter.
    """

    schema: Schema
    request: WhatIfRequest
    log: Log
    agreement: ReplayAgreement
    evaluated_s: tuple[Span, ...]
    uses_estimates: bool
    logged: Ekf2Statistics
    replayed: Ekf2Statistics
    whatif: Ekf2Statistics | None = None
    sweep: tuple[Ekf2Statistics, ...] = ()
    notes: tuple[str, ...]
    provenance: Provenance


class DiffResults(Record, kw_only=True):
    """Results of ``px4fuse diff``: differences between the inputs A and B.

    ``worse`` contains a sentence for each filter that is consistent only in A, and each new error.
    """

    schema: Schema
    a: DiffInput
    b: DiffInput
    settings: tuple[SettingChange, ...]
    numbers: tuple[NumberChange, ...]
    findings: tuple[UnsharedFinding, ...]
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
    | DiffResults
)
# Type of the results, by name of the JSON schema
RESULTS_BY_SCHEMA: dict[str, type[Results]] = {
    "px4fuse-results": ComparisonResults,
    "px4fuse-loop": LoopResults,
    "px4fuse-aids": AidsResults,
    "px4fuse-tuning": TuningResults,
    "px4fuse-sync": SyncResults,
    "px4fuse-graph": GraphResults,
    "px4fuse-evaluation": EvaluationResults,
    "px4fuse-whatif": WhatIfResults,
    "px4fuse-changes": DiffResults,
}


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the results of all commands."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"px4fuse-results-{SCHEMA_VERSION}",
        "title": "Results of px4fuse",
        "description": f"Numbers have at most {SIGNIFICANT_DIGITS} significant digits, or six "
        "decimals if that is more precise.",
        "oneOf": [
            {
                "$ref": f"#/$defs/{kind.__name__}",
                "properties": {"schema": {"properties": {"name": {"const": name}}}},
            }
            for name, kind in RESULTS_BY_SCHEMA.items()
        ],
        "$defs": make_schemas_of_types(RESULTS_BY_SCHEMA.values())[1],
    }


def make_schemas_of_types(types: Collection[type]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the JSON Schema of each type, and the definitions (``$defs``) that they use."""
    # all types with a definition: ``types``, and the members of unions in their fields
    record_types = dict.fromkeys(types)
    schemas: tuple[dict[str, Any], ...] = ()
    components: dict[str, Any] = {}

    def describe_union(union_type: Any) -> dict[str, Any]:
        """Return the JSON Schema of a union, and add its members to ``record_types``."""
        # msgspec does not write an unset field, so the schema of this field allows no value
        if union_type is msgspec.UnsetType:
            return {"not": {}}
        record_types.update(dict.fromkeys(union_type.union_members))
        return {
            "anyOf": [{"$ref": f"#/$defs/{member.__name__}"} for member in union_type.union_members]
        }

    count = 0
    # repeat until `describe_union`, which msgspec calls for each union, finds no new types
    while count < len(record_types):
        count = len(record_types)
        schemas, components = msgspec.json.schema_components(
            list(record_types), schema_hook=describe_union, ref_template="#/$defs/{name}"
        )
    return list(schemas[: len(types)]), components


def to_json_dict(results: msgspec.Struct) -> dict[str, Any]:
    """Convert results to dicts, lists and numbers, as in the JSON file."""
    plain_results: dict[str, Any] = msgspec.to_builtins(results, enc_hook=_to_builtin)
    return plain_results


def round_number(value: float) -> float:
    """Round a number to ten significant digits; large numbers to six decimals.

    UNIX times (s) need the six decimals. Further digits differ between processors.

    >>> round_number(0.1 + 0.2), round_number(1795251250.2020123)
    (0.3, 1795251250.202012)
    """
    return round(value, 6) if abs(value) >= 1e4 else float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def _to_builtin(value: Any) -> float | dict[str, Any]:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, float):
        return float(value)
    raise NotImplementedError(f"results cannot contain a {type(value).__name__}")


def to_json(results: msgspec.Struct | dict[str, Any]) -> str:
    """Format results as JSON, with rounded numbers and a trailing newline.

    Raises
    ------
    ValueError
        The results contain a number that is not finite.
    """
    plain_results = to_json_dict(results) if isinstance(results, msgspec.Struct) else results
    rounded_results = convert_nested(
        plain_results, lambda value: round_number(value) if isinstance(value, float) else value
    )
    return json.dumps(rounded_results, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def find_file_hashes(text: str) -> list[str]:
    """Return the SHA-256 of all input files in results (JSON text), in order of appearance."""
    return re.findall(r'"([0-9a-f]{64})"', text)
