"""Loop, evaluation and pose graph → results: what ``loop`` and ``evaluate`` found."""

from __future__ import annotations

from msgspec import structs

from px4fuse.findings import find_loop
from px4fuse.loop.loop import Loop
from px4fuse.record import written
from px4fuse.request import EvaluationRequest, LoopRequest, command_line
from px4fuse.results.contract import LOOP, EvaluationResults, GraphResults, LoopResults
from px4fuse.results.model import NOBODY, Student, provenance, schema_of
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SolvedGraph


def loop_results(request: LoopRequest, loop: Loop, student: Student = NOBODY) -> LoopResults:
    """What ``px4fuse loop`` found."""
    return LoopResults(
        schema=schema_of(LOOP),
        request=request.recorded(),
        track=loop.odometry.trajectory.track(),
        references=tuple(reference.track() for reference in loop.references),
        loop=written(loop),
        findings=find_loop(loop),
        student=student,
        provenance=provenance(command_line(request)),
    )


def evaluation_results(request: EvaluationRequest, score: Evaluation) -> EvaluationResults:
    """What ``px4fuse evaluate`` found."""
    return EvaluationResults(
        schema=schema_of("px4fuse-evaluation"),
        estimate=score.estimate.track(),
        reference=score.reference.track(),
        provenance=provenance(command_line(request)),
        **structs.asdict(written(score)),
    )


def graph_results(solved: SolvedGraph, command: str) -> GraphResults:
    """What ``px4fuse loop`` found about a pose graph; edges by the vertex numbers of the file."""
    return GraphResults(schema_of("px4fuse-graph"), written(solved), provenance(command))
