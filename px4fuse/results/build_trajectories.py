"""Loop, evaluation and pose graph → results: what ``loop`` and ``evaluate`` found."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from px4fuse.arrays import Array
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.loop.corrections import Correction, Judged
from px4fuse.loop.loop import Loop
from px4fuse.loop.part import KnownEnd
from px4fuse.record import written
from px4fuse.request import LoopRequest
from px4fuse.results import trajectories as made
from px4fuse.results.contract import LOOP, EvaluationResults, GraphResults, LoopResults
from px4fuse.results.model import Student
from px4fuse.results.parts import (
    copied,
    provenance,
    schema_of,
)
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SOLUTIONS, SolvedGraph
from px4fuse.trajectory.model import AXES_OF_FRAME, Trajectory


def loop_results(
    request: LoopRequest, loop: Loop, findings: tuple[Finding, ...], student: Student, command: str
) -> LoopResults:
    """What ``px4fuse loop`` found."""
    return LoopResults(
        schema=schema_of(LOOP),
        request=request.recorded(),
        track=_track(loop.odometry.trajectory),
        references=tuple(_track(reference) for reference in loop.references),
        loop=_loop(loop),
        findings=findings,
        student=student,
        provenance=provenance(command),
    )


def evaluation_results(score: Evaluation, command: str) -> EvaluationResults:
    """What ``px4fuse evaluate`` found."""
    return EvaluationResults(
        schema=schema_of("px4fuse-evaluation"),
        estimate=_track(score.estimate),
        reference=_track(score.reference),
        provenance=provenance(command),
        **msgspec.structs.asdict(_score(score)),
    )


def graph_results(name: str, solved: SolvedGraph, command: str) -> GraphResults:
    """What ``px4fuse loop`` found about a pose graph; edges by the vertex numbers of the file."""
    graph, gates = solved.graph, solved.gates
    return GraphResults(
        schema=schema_of("px4fuse-graph"),
        graph=made.Graph(
            name=name,
            dimension=graph.dimension,
            poses=len(graph),
            edges=len(graph.first),
            initialised=graph.initialised,
            gates=gates
            if isinstance(gates, Unavailable)
            else tuple(
                copied(
                    made.GraphGate,
                    gate,
                    first=int(graph.ids[graph.first[gate.edge]]),
                    second=int(graph.ids[graph.second[gate.edge]]),
                )
                for gate in gates
            ),
            solutions={
                key: copied(
                    made.GraphSolution,
                    solution,
                    cost_initial=solution.initial_cost,
                    dropped=int(np.count_nonzero(solution.weights < 0.5)),
                )
                for key, solution in solved.solutions.items()
            },
        ),
        provenance=provenance(command),
    )


def loop_part(loop: Loop | Unavailable) -> made.LoopPart | Unavailable:
    """A loop and its corrections, or why there is none."""
    return loop if isinstance(loop, Unavailable) else _loop(loop)


def _loop(loop: Loop) -> made.LoopPart:
    path = loop.odometry.trajectory
    error = loop.closure_error_m
    misclosure, turned = loop.misclosure_m, loop.misclosure_heading_deg
    return copied(
        made.LoopPart,
        loop,
        track=path.name,
        kind=path.kind,
        frame=path.frame,
        start_s=loop.segment.start_s,
        end_s=loop.segment.end_s,
        part_reason=loop.segment.reason,
        poses=len(path),
        key_frames=len(loop.nodes),
        key_frame_spacing_m=loop.spacing_m,
        end_from_start_m=_axes(path, loop.end_m),
        known_end=_end(path, loop.known_end),
        closure_percent=None if error is None else 100.0 * error / loop.path_length_m,
        closure_error_axes_m=None
        if isinstance(misclosure, Unavailable)
        else _axes(path, misclosure),
        heading_error_deg=turned,
        odometry_noise=copied(made.OdometryNoise, loop.noise),
        closures=tuple(_closure(judged) for judged in loop.closures),
        corrections=made.Corrections(
            uncorrected=_correction(loop.odometry),
            by_distance_plain=_correction(loop.plain),
            by_distance=_correction(loop.by_distance),
            **{f"pose_graph_{name}": _correction(loop.solved[name]) for name in SOLUTIONS},
        ),
    )


def _track(trajectory: Trajectory) -> made.Track:
    return copied(
        made.Track,
        trajectory,
        poses=len(trajectory),
        start_s=float(trajectory.time_s[0]),
        end_s=float(trajectory.time_s[-1]),
        orientations=trajectory.rotation is not None,
    )


def _score(score: Evaluation) -> made.Score:
    transform, matched = score.transform, score.association
    return copied(
        made.Score,
        score,
        transform=copied(
            made.Transform,
            transform,
            quaternion_wxyz=tuple(transform.rotation.as_quat(scalar_first=True).tolist()),
            translation_m=tuple(transform.translation_m.tolist()),
        ),
        association=copied(made.Association, matched, poses=len(matched)),
        rpe=tuple(written(one) for one in score.rpe),
    )


def _axes(path: Trajectory, vector: Array) -> dict[str, float]:
    names = AXES_OF_FRAME[path.frame]
    return {name: float(value) for name, value in zip(names, vector, strict=True)}


def _end(path: Trajectory, end: KnownEnd | Unavailable) -> made.KnownEnd | Unavailable:
    if isinstance(end, Unavailable):
        return end
    return copied(
        made.KnownEnd,
        end,
        displacement_m=_axes(path, np.array(end.displacement_m)),
        sigma_heading_deg=None if end.heading_change_deg is None else end.sigma_heading_deg,
    )


def _closure(judged: Judged) -> made.Closure:
    more: dict[str, Any] = {f"weight_{name}": weight for name, weight in judged.weights.items()}
    gate = {name: getattr(judged.gate, name) for name in ("d2", "degrees_of_freedom", "p",
                                                          "accepted")}  # fmt: skip
    return copied(made.Closure, judged.closure, distance_m=judged.distance_m, **gate, **more)


def _correction(correction: Correction | Unavailable) -> made.Correction | Unavailable:
    if isinstance(correction, Unavailable):
        return correction
    solution = correction.solution
    return copied(
        made.Correction,
        solution,
        moved_max_m=float(correction.moved_m.max()),
        moved_rms_m=float(np.sqrt(np.mean(correction.moved_m**2))),
        cost_initial=None if solution is None else solution.initial_cost,
        scores={
            name: one if isinstance(one, Unavailable) else _score(one)
            for name, one in correction.scores.items()
        },
    )
