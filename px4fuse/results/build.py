"""Analysis → results: what ``compare``, ``tune`` and ``sync`` found, as the contract has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

import msgspec

from px4fuse.analysis import AidsAlone, Analysis, Counterfactual
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings import find, find_aids
from px4fuse.findings.story import story
from px4fuse.flight import Flight, Unavailable
from px4fuse.record import written
from px4fuse.request import AxisName, ComparisonRequest, WhatIfRequest, command_line
from px4fuse.results.comparison import AvailableTrack, ChosenSettings, Log, PositionSource
from px4fuse.results.contract import (
    AIDS,
    COMPARISON,
    WHATIF,
    AidsResults,
    ComparisonResults,
    SyncResults,
    TuningResults,
    WhatIfResults,
)
from px4fuse.results.model import NOBODY, Student, provenance, schema_of


def results(
    request: ComparisonRequest, analysis: Analysis, student: Student = NOBODY
) -> ComparisonResults:
    """Everything that the report says."""
    findings = find(analysis)
    return ComparisonResults(
        **_of_flight(COMPARISON, request, analysis),
        axes={cast(AxisName, name): written(axis) for name, axis in analysis.axes.items()},
        horizontal=dict(analysis.horizontal),
        tuning=written(analysis.tuning),
        clock=written(analysis.clock),
        heading=analysis.heading,
        ekf2_replay=written(analysis.ekf2_replay),
        why=written(analysis.why),
        causes=analysis.causes,
        aids={} if isinstance(analysis.aids, Unavailable) else dict(analysis.aids),
        loop=written(analysis.loop),
        story=story(analysis, findings),
        findings=findings,
        notes=analysis.notes,
        missing=analysis.missing,
        student=student,
    )


def aids_results(
    request: ComparisonRequest, alone: AidsAlone, student: Student = NOBODY
) -> AidsResults:
    """What ``px4fuse compare`` found on a flight without a position source."""
    return AidsResults(
        schema=schema_of(AIDS),
        request=request.recorded(),
        log=log_part(alone.flight),
        aids=dict(alone.aids),
        findings=find_aids(alone.aids),
        missing=(alone.lacking, *alone.flight.missing),
        student=student,
        provenance=provenance(command_line(request)),
    )


def tuning_results(
    request: ComparisonRequest,
    comparison: Comparison,
    tuned: Mapping[str, AxisTuning | Unavailable],
) -> TuningResults:
    """What ``px4fuse tune`` found."""
    begun = _of_flight("px4fuse-tuning", request, comparison, "tune")
    return TuningResults(**begun, tuning=written(tuned))


def sync_results(
    request: ComparisonRequest, comparison: Comparison, clock: ClockOffset | Unavailable
) -> SyncResults:
    """What ``px4fuse sync`` found."""
    begun = _of_flight("px4fuse-sync", request, comparison, "sync")
    return SyncResults(**begun, clock=written(clock))


def whatif_results(request: WhatIfRequest, made_of: Counterfactual) -> WhatIfResults:
    """What ``px4fuse whatif`` found."""
    found = made_of.whatif
    first = made_of.first
    return WhatIfResults(
        schema=schema_of(WHATIF),
        request=request.recorded(),
        log=log_part(made_of.flight),
        agreement=found.agreement,
        judged_s=found.judged,
        asked=made_of.asked,
        logged=found.logged,
        replayed=found.replayed,
        whatif=found.whatif[0] if first else None,
        sweep=found.whatif[first:],
        notes=found.notes,
        provenance=provenance(command_line(request)),
    )


def log_part(flight: Flight) -> Log:
    """The log of a flight and what was joined with it."""
    return Log(**msgspec.structs.asdict(flight.log), joined=flight.inputs, clocks=flight.clocks)


def _of_flight(
    name: str, request: ComparisonRequest, comparison: Comparison, command: str | None = None
) -> dict[str, Any]:
    """What the results of every command on one flight's comparison have in common."""
    track, segment, settings = comparison.source, comparison.segment, comparison.settings
    origin, parameters = track.origin, comparison.flight.log.parameters
    placed_s = 0.0 if track.alignment is None else track.alignment.clock_offset_s
    source = PositionSource(
        name=track.name,
        kind=origin.kind,
        passage=origin.passage,
        ekf2_parameters={} if origin.aid is None else origin.aid.in_log(parameters),
        description=track.description,
        reason=comparison.source_reason,
        rate_hz=track.rate_hz,
        frame=cast(Any, track.frame),
        clock=track.clock,
        reconstructed=origin.reconstructed,
        topics=track.topics,
        available=tuple(
            AvailableTrack(
                one.name, one.origin.kind, one.origin.passage, len(one.samples), one.rate_hz
            )
            for one in comparison.flight.positions
        ),
        not_in_log=tuple(part for part in comparison.missing if part.source),
        log=track.log,
        alignment=track.alignment,
    )
    used: dict[str, Any] = asdict(settings) | {"clock_offset_s": settings.clock_offset_s + placed_s}
    return {
        "schema": schema_of(name),
        "request": request.recorded(),
        "log": log_part(comparison.flight),
        "source": source,
        "settings": ChosenSettings(
            **used,
            start_s=segment.start_s,
            end_s=segment.end_s,
            segment_reason=segment.reason,
        ),
        "provenance": provenance(command_line(request, command)),
    }
