"""Loop, evaluation and pose graph → results: what ``loop`` and ``evaluate`` found."""

from __future__ import annotations

from msgspec import structs

from px4fuse.findings import Finding
from px4fuse.loop.loop import Loop
from px4fuse.record import written
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LOOP, EvaluationResults, GraphResults, LoopResults
from px4fuse.results.model import Student, provenance, schema_of
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SolvedGraph


def loop_results(
    request: LoopRequest, loop: Loop, findings: tuple[Finding, ...], student: Student, command: str
) -> LoopResults:
    """What ``px4fuse loop`` found."""
    return LoopResults(
        schema=schema_of(LOOP),
        request=request.recorded(),
        track=loop.odometry.trajectory.track(),
        references=tuple(reference.track() for reference in loop.references),
        loop=written(loop),
        findings=findings,
        student=student,
        provenance=provenance(command),
    )


def evaluation_results(score: Evaluation, command: str) -> EvaluationResults:
    """What ``px4fuse evaluate`` found."""
    return EvaluationResults(
        schema=schema_of("px4fuse-evaluation"),
        estimate=score.estimate.track(),
        reference=score.reference.track(),
        provenance=provenance(command),
        **structs.asdict(written(score)),
    )


def graph_results(solved: SolvedGraph, command: str) -> GraphResults:
    """What ``px4fuse loop`` found about a pose graph; edges by the vertex numbers of the file."""
    return GraphResults(schema_of("px4fuse-graph"), written(solved), provenance(command))
