"""Analysis → results: what ``compare``, ``tune`` and ``sync`` found, as the contract has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import AgainstTruth, AxisComparison, FilterSummary
from px4fuse.comparison.preparation import Prepared
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.tuning import AxisTuning, Noise
from px4fuse.findings import Finding
from px4fuse.findings.story import story
from px4fuse.flight import Unavailable, sample_rate
from px4fuse.request import AxisName, ComparisonRequest
from px4fuse.results import comparison as made
from px4fuse.results.build_ekf2 import replay_part, why_part
from px4fuse.results.build_trajectories import loop_part
from px4fuse.results.contract import (
    COMPARISON,
    ComparisonResults,
    SyncResults,
    TuningResults,
)
from px4fuse.results.model import Absent, Missing, Student
from px4fuse.results.parts import (
    absent,
    copied,
    copied_or_absent,
    found_mistakes,
    log_part,
    provenance,
    schema_of,
)


def results(
    request: ComparisonRequest,
    analysis: Analysis,
    findings: tuple[Finding, ...],
    student: Student,
    command: str,
) -> ComparisonResults:
    """Everything that the report says."""
    comparison = analysis.comparison
    return ComparisonResults(
        schema=schema_of(COMPARISON),
        request=request.recorded(),
        log=log_part(comparison.flight),
        position_source=_source(comparison),
        settings=_settings(comparison),
        axes={cast(AxisName, axis.axis.name): _axis(axis) for axis in comparison.axes},
        horizontal=made.Horizontal(
            *(
                None if joint is None else copied(made.HorizontalNis, joint)
                for joint in (comparison.horizontal_kf, comparison.horizontal_ekf2)
            )
        ),
        tuning={name: _tuned(found) for name, found in analysis.tuning.items()},
        clock=_clock(analysis.clock, comparison.settings.clock_offset_s),
        heading=_heading(analysis.heading),
        ekf2_replay=replay_part(analysis.ekf2_replay),
        why={name: why_part(found) for name, found in analysis.why.items()},
        loop=loop_part(analysis.loop),
        story=story(analysis, findings),
        findings=found_mistakes(findings),
        notes=comparison.notes,
        missing=tuple(copied(Missing, part) for part in comparison.missing),
        student=student,
        provenance=provenance(command),
    )


def tuning_results(
    request: ComparisonRequest,
    comparison: Prepared,
    tuned: Mapping[str, AxisTuning | Unavailable],
    command: str,
) -> TuningResults:
    """What ``px4fuse tune`` found."""
    return TuningResults(
        schema=schema_of("px4fuse-tuning"),
        request=request.recorded(),
        log=log_part(comparison.flight),
        position_source=_source(comparison),
        settings=_settings(comparison),
        tuning={name: _tuned(axis) for name, axis in tuned.items()},
        provenance=provenance(command),
    )


def sync_results(
    request: ComparisonRequest,
    comparison: Prepared,
    clock: ClockOffset | Unavailable,
    command: str,
) -> SyncResults:
    """What ``px4fuse sync`` found."""
    return SyncResults(
        schema=schema_of("px4fuse-sync"),
        request=request.recorded(),
        log=log_part(comparison.flight),
        position_source=_source(comparison),
        settings=_settings(comparison),
        clock=_clock(clock, comparison.settings.clock_offset_s),
        provenance=provenance(command),
    )


def _source(comparison: Prepared) -> made.PositionSource:
    source = comparison.source
    looked_for = [m for m in comparison.missing if m.what.startswith("position source ")]
    return copied(
        made.PositionSource,
        source,
        reason=comparison.source_reason,
        available=tuple(
            copied(made.AvailableTrack, track, samples=len(track.samples))
            for track in comparison.flight.positions
        ),
        not_in_log=tuple(copied(Missing, part) for part in looked_for),
        alignment=None if source.alignment is None else copied(made.Alignment, source.alignment),
    )


def _settings(comparison: Prepared) -> made.ChosenSettings:
    settings = comparison.settings
    alignment = comparison.source.alignment
    placed_s = 0.0 if alignment is None else alignment.clock_offset_s
    return copied(
        made.ChosenSettings,
        settings,
        start_s=comparison.segment.start_s,
        end_s=comparison.segment.end_s,
        segment_reason=comparison.segment.reason,
        clock_offset_s=settings.clock_offset_s + placed_s,
    )


def _axis(result: AxisComparison) -> made.Axis:
    updates = result.replay.updates
    north, east, down = result.axis.direction
    return made.Axis(
        heading_deg=result.axis.heading_deg,
        direction=(float(north), float(east), float(down)),
        note=result.axis.note,
        updates=made.Updates(
            count=len(updates),
            first_s=float(updates.index[0]),
            last_s=float(updates.index[-1]),
            rate_hz=sample_rate(updates) if len(updates) > 1 else None,
            input_gap_s=result.replay.input_gap_s,
        ),
        kf=_filter(result.kf),
        ekf2=made.UnjudgedFilter(copied(Missing, result.ekf2))
        if isinstance(result.ekf2, Unavailable)
        else _filter(result.ekf2),
        difference=copied_or_absent(made.Difference, result.difference),
        truth=_truth(result),
        rejected_share=_rejected_share(result.ekf2_innovations),
    )


def _rejected_share(innovations: pd.DataFrame | Unavailable) -> float | None:
    if isinstance(innovations, Unavailable):
        return None
    known = innovations["rejected"].dropna()
    return float(known.mean()) if len(known) else None


def _filter(summary: FilterSummary) -> made.Filter | made.UnjudgedFilter:
    consistency = summary.consistency
    if isinstance(consistency, Unavailable):
        return copied(made.UnjudgedFilter, summary, unavailable=copied(Missing, consistency))
    return copied(made.Filter, summary, **vars(consistency))


def _truth(result: AxisComparison) -> made.AgainstTruth | Absent:
    if isinstance(result.truth, Unavailable):
        return absent(result.truth)
    values: dict[str, Any] = {}
    for name, part in (("kf", result.kf_truth), ("ekf2", result.ekf2_truth)):
        if isinstance(part, AgainstTruth):
            values |= {f"{name}_{key}": value for key, value in vars(part).items()}
    return made.AgainstTruth(**values)


def _tuned(found: AxisTuning | Unavailable) -> made.Tuned | Absent:
    if isinstance(found, Unavailable):
        return absent(found)
    return copied(
        made.Tuned,
        found,
        outliers=len(found.outlier_time_s),
        before=copied_or_absent(made.Consistency, found.before),
        after=copied_or_absent(made.Consistency, found.after),
        held_out=copied_or_absent(made.HeldOut, found.held_out),
        **_noise("sigma_a_m_s2", found.sigma_a),
        **_noise("filter_sigma_a_m_s2", found.filter_sigma_a),
        **_noise("sigma_z_m", found.sigma_z),
    )


def _noise(name: str, noise: Noise) -> dict[str, Any]:
    """Value and interval, or a bound where there is only that; an open lower end is 0."""
    if noise.value is None:
        return {f"{name}_upper_bound": noise.high, f"{name}_lower_bound": noise.low}
    if noise.high is None:
        return {name: noise.value}
    return {name: noise.value, f"{name}_interval": (noise.low or 0.0, noise.high)}


def _heading(found: HeadingError | Unavailable) -> made.Heading | Absent:
    if isinstance(found, Unavailable):
        return absent(found)
    parts = tuple(copied(made.HeadingPart, part) for part in found.parts)
    return copied(made.Heading, found, parts=parts)


def _clock(clock: ClockOffset | Unavailable, applied_s: float) -> made.Clock | Absent:
    """Offsets count from the source's own stamps, what was applied already included."""
    if isinstance(clock, Unavailable):
        return absent(clock)
    low, high = clock.interval_s
    return copied(
        made.Clock,
        clock,
        offset_s=applied_s + clock.offset_s,
        interval_s=(applied_s + low, applied_s + high),
        reason=clock.reason or None,
        applied_s=applied_s,
        parts=tuple(
            copied(made.PartOffset, replace(part, offset_s=applied_s + part.offset_s))
            for part in clock.parts
        ),
    )
