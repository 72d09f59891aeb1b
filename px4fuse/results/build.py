"""Analysis → results: what ``compare``, ``tune`` and ``sync`` found, as the contract has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from px4fuse.analysis import Analysis, Counterfactual
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings import Finding
from px4fuse.findings.story import story
from px4fuse.flight import Unavailable
from px4fuse.record import written
from px4fuse.request import AxisName, ComparisonRequest, WhatIfRequest
from px4fuse.results.comparison import AvailableTrack, ChosenSettings, PositionSource
from px4fuse.results.contract import (
    COMPARISON,
    WHATIF,
    ComparisonResults,
    SyncResults,
    TuningResults,
    WhatIfResults,
)
from px4fuse.results.model import Student
from px4fuse.results.parts import copied, log_part, provenance, schema_of


def results(
    request: ComparisonRequest,
    analysis: Analysis,
    findings: tuple[Finding, ...],
    student: Student,
    command: str,
) -> ComparisonResults:
    """Everything that the report says."""
    return ComparisonResults(
        schema=schema_of(COMPARISON),
        request=request.recorded(),
        log=log_part(analysis.flight),
        source=_source(analysis),
        settings=_settings(analysis),
        axes={cast(AxisName, name): written(axis) for name, axis in analysis.axes.items()},
        horizontal=dict(analysis.horizontal),
        tuning=written(analysis.tuning),
        clock=written(analysis.clock),
        heading=analysis.heading,
        ekf2_replay=written(analysis.ekf2_replay),
        why=written(analysis.why),
        loop=written(analysis.loop),
        story=story(analysis, findings),
        findings=findings,
        notes=analysis.notes,
        missing=analysis.missing,
        student=student,
        provenance=provenance(command),
    )


def tuning_results(
    request: ComparisonRequest,
    comparison: Comparison,
    tuned: Mapping[str, AxisTuning | Unavailable],
    command: str,
) -> TuningResults:
    """What ``px4fuse tune`` found."""
    return TuningResults(
        schema=schema_of("px4fuse-tuning"),
        request=request.recorded(),
        log=log_part(comparison.flight),
        source=_source(comparison),
        settings=_settings(comparison),
        tuning=written(tuned),
        provenance=provenance(command),
    )


def sync_results(
    request: ComparisonRequest,
    comparison: Comparison,
    clock: ClockOffset | Unavailable,
    command: str,
) -> SyncResults:
    """What ``px4fuse sync`` found."""
    return SyncResults(
        schema=schema_of("px4fuse-sync"),
        request=request.recorded(),
        log=log_part(comparison.flight),
        source=_source(comparison),
        settings=_settings(comparison),
        clock=written(clock),
        provenance=provenance(command),
    )


def whatif_results(request: WhatIfRequest, made_of: Counterfactual, command: str) -> WhatIfResults:
    """What ``px4fuse whatif`` found."""
    found = made_of.whatif
    first = 1 if made_of.changes else 0
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
        provenance=provenance(command),
    )


def _source(comparison: Comparison) -> PositionSource:
    track = comparison.source
    origin, parameters = track.origin, comparison.flight.log.parameters
    return copied(
        PositionSource,
        track,
        kind=origin.kind,
        passage=origin.passage,
        reconstructed=origin.reconstructed,
        ekf2_parameters={} if origin.aid is None else origin.aid.in_log(parameters),
        reason=comparison.source_reason,
        available=tuple(
            copied(
                AvailableTrack,
                known,
                kind=known.origin.kind,
                passage=known.origin.passage,
                samples=len(known.samples),
            )
            for known in comparison.flight.positions
        ),
        not_in_log=tuple(part for part in comparison.missing if part.source),
    )


def _settings(comparison: Comparison) -> ChosenSettings:
    settings = comparison.settings
    alignment = comparison.source.alignment
    placed_s = 0.0 if alignment is None else alignment.clock_offset_s
    return copied(
        ChosenSettings,
        settings,
        start_s=comparison.segment.start_s,
        end_s=comparison.segment.end_s,
        segment_reason=comparison.segment.reason,
        clock_offset_s=settings.clock_offset_s + placed_s,
    )
