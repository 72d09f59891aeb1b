"""Conversion of the analyses of all commands to JSON results."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, TypeVar

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
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.solver import Graph

from . import contract
from .answer_form import EMPTY_CELL, Answers, form_rows
from .bounds import drop_invalid_numbers
from .model import NO_STUDENT, SCHEMA_VERSION, Schema, Student, provenance

ResultsT = TypeVar("ResultsT", bound=contract.Results)


def make_results(results_type: type[ResultsT], command: str, **fields: Any) -> ResultsT:
    """Create results with their schema and provenance, and without invalid numbers.

    Parameters
    ----------
    command : str
        Command line that produces the results.
    **fields
        All other fields of the results.

    Raises
    ------
    ResultsError
        A required number is not valid.
    """
    schema_name = next(
        name for name, kind in contract.RESULTS_BY_SCHEMA.items() if kind is results_type
    )
    return drop_invalid_numbers(
        results_type(
            schema=Schema(schema_name, SCHEMA_VERSION),
            provenance=provenance(command),
            **fields,
        )
    )


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
    fields = _make_flight_fields(request, analysis) | {
        "aids": {} if isinstance(analysis.aids, Unavailable) else dict(analysis.aids),
        "card": card,
        "clock": analysis.time_offset,
        "student": student,
        "trials": analysis.reruns,
    }
    copied_names = (
        {*contract.ComparisonResults.__struct_fields__} - fields.keys() - {"schema", "provenance"}
    )
    fields |= {name: getattr(analysis, name) for name in copied_names}
    return make_results(contract.ComparisonResults, command_line(request), **fields)


def make_comparison_or_aids_results(
    request: ComparisonRequest,
    outcome: Analysis | AidingSourceAnalysis,
    student: Student = NO_STUDENT,
) -> contract.ComparisonResults | contract.AidsResults:
    """Return the results of ``px4fuse compare`` for a flight with or without positions."""
    if isinstance(outcome, Analysis):
        return make_comparison_results(request, outcome, student)
    return make_results(
        contract.AidsResults,
        command_line(request),
        request=request.with_file_names(),
        log=make_log_record(outcome.flight),
        aids=dict(outcome.aids),
        card=build_aids_card(outcome, request.with_file_names(), (student.name, student.id)),
        findings=outcome.findings,
        missing=(outcome.missing_data, *outcome.flight.missing),
        student=student,
    )


def make_tuning_results(
    request: ComparisonRequest,
    comparison: PreparedComparison,
    tuning_by_axis: Mapping[str, AxisTuning | Unavailable],
) -> contract.TuningResults:
    """Make the JSON results of ``px4fuse tune``."""
    return make_results(
        contract.TuningResults,
        command_line(request, "tune"),
        tuning=dict(tuning_by_axis),
        **_make_flight_fields(request, comparison),
    )


def make_sync_results(
    request: ComparisonRequest,
    comparison: PreparedComparison,
    time_offset: SourceTimeOffset | Unavailable,
) -> contract.SyncResults:
    """Make the JSON results of ``px4fuse sync``."""
    return make_results(
        contract.SyncResults,
        command_line(request, "sync"),
        clock=time_offset,
        **_make_flight_fields(request, comparison),
    )


def make_whatif_results(request: WhatIfRequest, analysis: WhatIfAnalysis) -> contract.WhatIfResults:
    """Make the JSON results of ``px4fuse whatif``."""
    sweep_start_index = analysis.sweep_start_index
    fields = dict(vars(analysis.statistics))
    replays = fields.pop("whatif")
    return make_results(
        contract.WhatIfResults,
        command_line(request),
        request=request.with_file_names(),
        log=make_log_record(analysis.flight),
        uses_estimates=analysis.uses_estimates,
        whatif=replays[0] if sweep_start_index else None,
        sweep=replays[sweep_start_index:],
        **fields,
    )


def make_loop_results(request: LoopRequest, loop: Loop, student: Student) -> contract.LoopResults:
    """Make the JSON results of ``px4fuse loop``: loop closures, corrected paths, and findings."""
    return make_results(
        contract.LoopResults,
        command_line(request),
        request=request.with_file_names(),
        track=loop.odometry.trajectory.describe_track(),
        references=tuple(reference.describe_track() for reference in loop.references),
        loop=loop,
        findings=find_loop_findings(loop),
        student=student,
    )


def make_evaluation_results(
    request: EvaluationRequest, evaluation: Evaluation
) -> contract.EvaluationResults:
    """Make the JSON results of ``px4fuse evaluate``."""
    return make_results(
        contract.EvaluationResults,
        command_line(request),
        estimate=evaluation.estimate_track.describe_track(),
        reference=evaluation.reference_track.describe_track(),
        **msgspec.structs.asdict(evaluation),
    )


def make_graph_results(solved_graph: Graph, command: str) -> contract.GraphResults:
    return make_results(contract.GraphResults, command, graph=solved_graph)


def make_log_record(flight: Flight) -> contract.Log:
    return contract.Log(
        **msgspec.structs.asdict(flight.log), joined=flight.inputs, clocks=flight.clocks
    )


def _make_flight_fields(
    request: ComparisonRequest, comparison: PreparedComparison
) -> dict[str, Any]:
    """Return the fields that the results of all commands on one flight have in common."""
    track, segment, settings = comparison.source, comparison.segment, comparison.settings
    origin, flight = track.origin, comparison.flight
    available_tracks = (
        contract.AvailableTrack(
            each.name,
            each.origin.kind,
            each.origin.route,
            len(each.samples),
            each.compute_rate_hz(),
        )
        for each in flight.positions
    )
    kf_settings: dict[str, Any] = asdict(settings)
    kf_settings["clock_offset_s"] += (
        0.0 if track.alignment is None else track.alignment.clock_offset_s
    )
    return {
        "request": request.with_file_names(),
        "log": make_log_record(flight),
        "source": contract.PositionSource(
            **track.description_fields(),
            ekf2_parameters={}
            if origin.aid is None
            else origin.aid.logged_parameters(flight.log.parameters),
            reason=comparison.source_reason,
            rate_hz=track.compute_rate_hz(),
            available=tuple(available_tracks),
            missing=tuple(part for part in comparison.missing if part.source),
        ),
        "settings": contract.ChosenSettings(
            **kf_settings,
            start_s=segment.start_s,
            end_s=segment.end_s,
            segment_reason=segment.reason,
        ),
    }
