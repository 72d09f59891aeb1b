"""What a command found → results, as the contract has them."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import msgspec

from px4fuse.analysis import AidsAlone, Analysis, Counterfactual
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings import find, find_aids, find_loop
from px4fuse.findings.story import story
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.record import written
from px4fuse.request import (
    ComparisonRequest,
    EvaluationRequest,
    LoopRequest,
    WhatIfRequest,
    command_line,
)
from px4fuse.results import contract
from px4fuse.results.bounds import within_bounds
from px4fuse.results.contract import AvailableTrack, ChosenSettings, Log, PositionSource
from px4fuse.results.model import NOBODY, Student, provenance, schema_of
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SolvedGraph

# Parts of an analysis that are written as they are
_AS_FOUND = (
    "axes",
    "horizontal",
    "tuning",
    "clock",
    "heading",
    "ekf2_replay",
    "why",
    "causes",
    "loop",
    "notes",
    "missing",
)


def results(
    request: ComparisonRequest, analysis: Analysis, student: Student = NOBODY
) -> contract.ComparisonResults:
    """Everything that the report says."""
    findings = find(analysis)
    return within_bounds(
        contract.ComparisonResults(
            **_of_flight(contract.COMPARISON, request, analysis),
            **{name: written(getattr(analysis, name)) for name in _AS_FOUND},
            aids={} if isinstance(analysis.aids, Unavailable) else dict(analysis.aids),
            story=story(analysis, findings),
            findings=findings,
            student=student,
        )
    )


def judged_results(
    request: ComparisonRequest, found: Analysis | AidsAlone, student: Student = NOBODY
) -> contract.ComparisonResults | contract.AidsResults:
    """What ``px4fuse compare`` found; of a flight without a position source EKF2's aids alone."""
    if isinstance(found, Analysis):
        return results(request, found, student)
    return within_bounds(
        contract.AidsResults(
            **_begun(contract.AIDS, request, found.flight),
            aids=dict(found.aids),
            findings=find_aids(found.aids),
            missing=(found.lacking, *found.flight.missing),
            student=student,
        )
    )


def tuning_results(
    request: ComparisonRequest,
    comparison: Comparison,
    tuned: Mapping[str, AxisTuning | Unavailable],
) -> contract.TuningResults:
    """What ``px4fuse tune`` found."""
    begun = _of_flight("px4fuse-tuning", request, comparison, "tune")
    return within_bounds(contract.TuningResults(**begun, tuning=written(tuned)))


def sync_results(
    request: ComparisonRequest, comparison: Comparison, clock: ClockOffset | Unavailable
) -> contract.SyncResults:
    """What ``px4fuse sync`` found."""
    begun = _of_flight("px4fuse-sync", request, comparison, "sync")
    return within_bounds(contract.SyncResults(**begun, clock=written(clock)))


def whatif_results(request: WhatIfRequest, made_of: Counterfactual) -> contract.WhatIfResults:
    """What ``px4fuse whatif`` found."""
    found, first = made_of.whatif, made_of.first
    return within_bounds(
        contract.WhatIfResults(
            **_begun(contract.WHATIF, request, made_of.flight),
            agreement=found.agreement,
            judged_s=found.judged,
            asked=made_of.asked,
            logged=found.logged,
            replayed=found.replayed,
            whatif=found.whatif[0] if first else None,
            sweep=found.whatif[first:],
            notes=found.notes,
        )
    )


def loop_results(
    request: LoopRequest, loop: Loop, student: Student = NOBODY
) -> contract.LoopResults:
    """What ``px4fuse loop`` found."""
    return within_bounds(
        contract.LoopResults(
            schema=schema_of(contract.LOOP),
            request=request.recorded(),
            track=loop.odometry.trajectory.track(),
            references=tuple(reference.track() for reference in loop.references),
            loop=written(loop),
            findings=find_loop(loop),
            student=student,
            provenance=provenance(command_line(request)),
        )
    )


def evaluation_results(request: EvaluationRequest, score: Evaluation) -> contract.EvaluationResults:
    """What ``px4fuse evaluate`` found."""
    return within_bounds(
        contract.EvaluationResults(
            schema=schema_of("px4fuse-evaluation"),
            estimate=score.estimate.track(),
            reference=score.reference.track(),
            provenance=provenance(command_line(request)),
            **msgspec.structs.asdict(written(score)),
        )
    )


def graph_results(solved: SolvedGraph, command: str) -> contract.GraphResults:
    """What ``px4fuse loop`` found about a pose graph; edges by the vertex numbers of the file."""
    return within_bounds(
        contract.GraphResults(schema_of("px4fuse-graph"), written(solved), provenance(command))
    )


def log_part(flight: Flight) -> Log:
    """The log of a flight and what was joined with it."""
    return Log(**msgspec.structs.asdict(flight.log), joined=flight.inputs, clocks=flight.clocks)


def _begun(
    name: str,
    request: ComparisonRequest | WhatIfRequest,
    flight: Flight,
    command: str | None = None,
) -> dict[str, Any]:
    """What all results of a flight have: which they are, what was asked of which log, versions."""
    return {
        "schema": schema_of(name),
        "request": request.recorded(),
        "log": log_part(flight),
        "provenance": provenance(command_line(request, command)),
    }


def _of_flight(
    name: str, request: ComparisonRequest, comparison: Comparison, command: str | None = None
) -> dict[str, Any]:
    """What the results of every command on one flight's comparison have in common."""
    track, segment, settings = comparison.source, comparison.segment, comparison.settings
    origin, parameters = track.origin, comparison.flight.log.parameters
    placed_s = 0.0 if track.alignment is None else track.alignment.clock_offset_s
    source = PositionSource(
        **track.about(),
        ekf2_parameters={} if origin.aid is None else origin.aid.in_log(parameters),
        reason=comparison.source_reason,
        rate_hz=track.rate_hz,
        available=tuple(
            AvailableTrack(
                one.name, one.origin.kind, one.origin.passage, len(one.samples), one.rate_hz
            )
            for one in comparison.flight.positions
        ),
        not_in_log=tuple(part for part in comparison.missing if part.source),
    )
    used: dict[str, Any] = asdict(settings) | {"clock_offset_s": settings.clock_offset_s + placed_s}
    return _begun(name, request, comparison.flight, command) | {
        "source": source,
        "settings": ChosenSettings(
            **used,
            start_s=segment.start_s,
            end_s=segment.end_s,
            segment_reason=segment.reason,
        ),
    }
