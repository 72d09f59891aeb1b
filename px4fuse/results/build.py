"""Conversion of the analyses of all commands to JSON results."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import msgspec

from px4fuse.analysis import AidingSourceAnalysis, Analysis, WhatIfAnalysis
from px4fuse.card.build import build_aids_card, build_card
from px4fuse.comparison.model import PreparedComparison
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings import find_loop_findings
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.request import (
    ComparisonRequest,
    EvaluationRequest,
    LoopRequest,
    WhatIfRequest,
    command_line,
)
from px4fuse.results import contract
from px4fuse.results.answer_form import EMPTY_CELL, Answers, form_rows
from px4fuse.results.bounds import drop_invalid_numbers
from px4fuse.results.contract import AvailableTrack, ChosenSettings, Log, PositionSource
from px4fuse.results.model import NO_STUDENT, Student, provenance, schema_of
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.solver import Graph


def make_comparison_results(
    request: ComparisonRequest, analysis: Analysis, student: Student = NO_STUDENT
) -> contract.ComparisonResults:
    """Convert an analysis by KF and EKF2 to the results of ``px4fuse compare``.

    If a student must find the faults of the flight, the student's answers replace the diagnosis.
    """
    card = build_card(analysis, request.with_file_names(), (student.name, student.id))
    if analysis.flight.log.is_assessed and isinstance(student.answers, Answers):
        answer_texts = (
            f"{question}: {answer_text}"
            for question, answer_text in form_rows(student.answers)
            if answer_text != EMPTY_CELL
        )
        card = msgspec.structs.replace(card, facts={"Answers": "; ".join(answer_texts)})
    fields = _make_flight_fields(contract.COMPARISON_SCHEMA_NAME, request, analysis) | {
        "aids": {} if isinstance(analysis.aids, Unavailable) else dict(analysis.aids),
        "card": card,
        "clock": analysis.time_offset,
        "student": student,
        "trials": analysis.reruns,
    }
    # the other fields of the results are copied from the analysis
    for name in contract.ComparisonResults.__struct_fields__:
        if name not in fields:
            fields[name] = getattr(analysis, name)
    return drop_invalid_numbers(contract.ComparisonResults(**fields))


def make_comparison_or_aids_results(
    request: ComparisonRequest,
    outcome: Analysis | AidingSourceAnalysis,
    student: Student = NO_STUDENT,
) -> contract.ComparisonResults | contract.AidsResults:
    """Return the results of ``px4fuse compare`` for a flight with or without positions."""
    if isinstance(outcome, Analysis):
        return make_comparison_results(request, outcome, student)
    return drop_invalid_numbers(
        contract.AidsResults(
            **_make_common_fields(contract.AIDING_SOURCES_SCHEMA_NAME, request, outcome.flight),
            aids=dict(outcome.aids),
            card=build_aids_card(outcome, request.with_file_names(), (student.name, student.id)),
            findings=outcome.findings,
            missing=(outcome.missing_data, *outcome.flight.missing),
            student=student,
        )
    )


def make_tuning_results(
    request: ComparisonRequest,
    comparison: PreparedComparison,
    tuning_by_axis: Mapping[str, AxisTuning | Unavailable],
) -> contract.TuningResults:
    return drop_invalid_numbers(
        contract.TuningResults(
            **_make_flight_fields("px4fuse-tuning", request, comparison, "tune"),
            tuning=dict(tuning_by_axis),
        )
    )


def make_sync_results(
    request: ComparisonRequest,
    comparison: PreparedComparison,
    time_offset: SourceTimeOffset | Unavailable,
) -> contract.SyncResults:
    return drop_invalid_numbers(
        contract.SyncResults(
            **_make_flight_fields("px4fuse-sync", request, comparison, "sync"), clock=time_offset
        )
    )


def make_whatif_results(request: WhatIfRequest, analysis: WhatIfAnalysis) -> contract.WhatIfResults:
    summaries, sweep_start_index = analysis.whatif, analysis.sweep_start_index
    return drop_invalid_numbers(
        contract.WhatIfResults(
            **_make_common_fields(contract.WHATIF_SCHEMA_NAME, request, analysis.flight),
            agreement=summaries.agreement,
            evaluated_s=summaries.evaluated_s,
            uses_estimates=analysis.uses_estimates,
            logged=summaries.logged,
            replayed=summaries.replayed,
            whatif=summaries.whatif[0] if sweep_start_index else None,
            sweep=summaries.whatif[sweep_start_index:],
            notes=summaries.notes,
        )
    )


def make_loop_results(request: LoopRequest, loop: Loop, student: Student) -> contract.LoopResults:
    return drop_invalid_numbers(
        contract.LoopResults(
            schema=schema_of(contract.LOOP_SCHEMA_NAME),
            request=request.with_file_names(),
            track=loop.odometry.trajectory.describe_track(),
            references=tuple(reference.describe_track() for reference in loop.references),
            loop=loop,
            findings=find_loop_findings(loop),
            student=student,
            provenance=provenance(command_line(request)),
        )
    )


def make_evaluation_results(
    request: EvaluationRequest, evaluation: Evaluation
) -> contract.EvaluationResults:
    return drop_invalid_numbers(
        contract.EvaluationResults(
            schema=schema_of("px4fuse-evaluation"),
            estimate=evaluation.estimate_track.describe_track(),
            reference=evaluation.reference_track.describe_track(),
            provenance=provenance(command_line(request)),
            **msgspec.structs.asdict(evaluation),
        )
    )


def make_graph_results(solved_graph: Graph, command: str) -> contract.GraphResults:
    return drop_invalid_numbers(
        contract.GraphResults(schema_of("px4fuse-graph"), solved_graph, provenance(command))
    )


def make_log_record(flight: Flight) -> Log:
    return Log(**msgspec.structs.asdict(flight.log), joined=flight.inputs, clocks=flight.clocks)


def _make_common_fields(
    name: str,
    request: ComparisonRequest | WhatIfRequest,
    flight: Flight,
    command: str | None = None,
) -> dict[str, Any]:
    return {
        "schema": schema_of(name),
        "request": request.with_file_names(),
        "log": make_log_record(flight),
        "provenance": provenance(command_line(request, command)),
    }


def _make_flight_fields(
    name: str,
    request: ComparisonRequest,
    comparison: PreparedComparison,
    command: str | None = None,
) -> dict[str, Any]:
    track, segment, settings = comparison.source, comparison.segment, comparison.settings
    origin, parameters = track.origin, comparison.flight.log.parameters
    file_clock_offset_s = 0.0 if track.alignment is None else track.alignment.clock_offset_s
    source = PositionSource(
        **track.description_fields(),
        ekf2_parameters={} if origin.aid is None else origin.aid.logged_parameters(parameters),
        reason=comparison.source_reason,
        rate_hz=track.compute_rate_hz(),
        available=tuple(
            AvailableTrack(
                each.name,
                each.origin.kind,
                each.origin.route,
                len(each.samples),
                each.compute_rate_hz(),
            )
            for each in comparison.flight.positions
        ),
        missing=tuple(part for part in comparison.missing if part.source),
    )
    kf_settings: dict[str, Any] = asdict(settings) | {
        "clock_offset_s": settings.clock_offset_s + file_clock_offset_s
    }
    return _make_common_fields(name, request, comparison.flight, command) | {
        "source": source,
        "settings": ChosenSettings(
            **kf_settings,
            start_s=segment.start_s,
            end_s=segment.end_s,
            segment_reason=segment.reason,
        ),
    }
