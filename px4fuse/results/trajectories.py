"""Loops and scores of trajectories as plain data, for the results contract."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from px4fuse.arrays import Array
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Correction, Judged, Loop
from px4fuse.loop.part import KnownEnd
from px4fuse.plain import present, unavailable
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SOLUTIONS, SolvedGraph
from px4fuse.trajectory.model import AXES_OF_FRAME, Trajectory
from px4fuse.trajectory.scores import Interval, RelativeError, Statistics


def loop_part(loop: Loop | Unavailable) -> dict[str, Any]:
    """A loop and its corrections.

    Returns
    -------
    dict
        Valid as ``loop`` under the results' schema.
    """
    if isinstance(loop, Unavailable):
        return unavailable(loop)
    path = loop.odometry.trajectory
    error = loop.closure_error_m
    misclosure, turned = loop.misclosure_m, loop.misclosure_heading_deg
    return present(
        {
            "track": path.name,
            "kind": path.kind,
            "frame": path.frame,
            "start_s": loop.segment.start_s,
            "end_s": loop.segment.end_s,
            "part_reason": loop.segment.reason,
            "poses": len(path),
            "key_frames": len(loop.nodes),
            "key_frame_spacing_m": loop.spacing_m,
            "path_length_m": loop.path_length_m,
            "end_from_start_m": _axes(path, loop.end_m),
            "heading_change_deg": loop.heading_change_deg,
            "known_end": _end(path, loop.known_end),
            "closure_error_m": error,
            "closure_percent": None if error is None else 100.0 * error / loop.path_length_m,
            "closure_error_axes_m": None
            if isinstance(misclosure, Unavailable)
            else _axes(path, misclosure),
            "heading_error_deg": unavailable(turned) if isinstance(turned, Unavailable) else turned,
            "absolute": loop.absolute,
            "odometry_noise": asdict(loop.noise),
            "closures": [_closure(judged) for judged in loop.closures],
            "corrections": {
                "uncorrected": _correction(loop.odometry),
                "by_distance": _correction(loop.by_distance),
                **{
                    f"pose_graph_{name}": _correction(loop.solved[name])
                    for name in SOLUTIONS
                    if name in loop.solved
                },
            },
            "notes": list(loop.notes),
        }
    )


def trajectory_part(trajectory: Trajectory) -> dict[str, Any]:
    """What a trajectory is."""
    return {
        "name": trajectory.name,
        "sha256": trajectory.sha256,
        "size_bytes": trajectory.size_bytes,
        "kind": trajectory.kind,
        "frame": trajectory.frame,
        "poses": len(trajectory),
        "start_s": float(trajectory.time_s[0]),
        "end_s": float(trajectory.time_s[-1]),
        "orientations": trajectory.rotation is not None,
        "notes": list(trajectory.notes),
    }


def evaluation_part(score: Evaluation | Unavailable) -> dict[str, Any]:
    """Scores of one trajectory against another."""
    if isinstance(score, Unavailable):
        return unavailable(score)
    transform, matched = score.transform, score.association
    return {
        "alignment": score.alignment,
        "alignment_reason": score.alignment_reason,
        "transform": {
            "quaternion_wxyz": transform.rotation.as_quat(scalar_first=True).tolist(),
            "translation_m": transform.translation_m.tolist(),
            "scale": transform.scale,
            "degrees_of_freedom": transform.degrees_of_freedom,
        },
        "association": {
            "method": matched.method,
            "poses": len(matched),
            "max_gap_s": matched.max_gap_s,
            "outside": matched.outside,
            "in_gaps": matched.in_gaps,
            "coverage_estimate": matched.coverage_estimate,
            "coverage_reference": matched.coverage_reference,
        },
        "time_offset": present(
            {
                "offset_s": score.time_offset.offset_s,
                "interval_s": None
                if score.time_offset.interval_s is None
                else list(score.time_offset.interval_s),
                "determinable": score.time_offset.determinable,
                "reason": score.time_offset.reason,
            }
        ),
        "ate": {
            "translation_m": _statistics(score.ate.translation),
            "interval_m": _interval(score.ate.interval),
            "rotation_deg": _statistics(score.ate.rotation),
        },
        "rpe": [_relative(one) for one in score.rpe],
        "notes": list(score.notes),
        "warnings": list(score.warnings),
    }


def graph_part(name: str, solved: SolvedGraph) -> dict[str, Any]:
    """A pose graph, its closures and its solutions; edges by the vertex numbers of the file."""
    graph, gates = solved.graph, solved.gates
    return {
        "name": name,
        "dimension": graph.dimension,
        "poses": len(graph),
        "edges": len(graph.first),
        "initialised": graph.initialised,
        "gates": unavailable(gates)
        if isinstance(gates, Unavailable)
        else [
            {
                "first": int(graph.ids[graph.first[gate.edge]]),
                "second": int(graph.ids[graph.second[gate.edge]]),
                "d2": gate.d2,
                "degrees_of_freedom": gate.degrees_of_freedom,
                "p": gate.p,
                "accepted": gate.accepted,
            }
            for gate in gates
        ],
        "solutions": {
            key: {
                "cost_initial": solution.initial_cost,
                "cost": solution.cost,
                "iterations": solution.iterations,
                "converged": solution.converged,
                "dropped": int(np.count_nonzero(solution.weights < 0.5)),
            }
            for key, solution in solved.solutions.items()
        },
    }


def _axes(path: Trajectory, vector: Array) -> dict[str, float]:
    names = AXES_OF_FRAME[path.frame]
    return {name: float(value) for name, value in zip(names, vector, strict=True)}


def _end(path: Trajectory, end: KnownEnd | Unavailable) -> dict[str, Any]:
    if isinstance(end, Unavailable):
        return unavailable(end)
    return present(
        {
            "displacement_m": _axes(path, np.array(end.displacement_m)),
            "heading_change_deg": end.heading_change_deg,
            "sigma_m": end.sigma_m,
            "sigma_heading_deg": None if end.heading_change_deg is None else end.sigma_heading_deg,
            "source": end.source,
            "assumed": end.assumed,
        }
    )


def _closure(judged: Judged) -> dict[str, Any]:
    closure, gate = judged.closure, judged.gate
    return present(
        {
            "time_1_s": closure.time_1_s,
            "time_2_s": closure.time_2_s,
            "sigma_m": closure.sigma_m,
            "source": closure.source,
            "distance_m": judged.distance_m,
            "d2": gate.d2,
            "degrees_of_freedom": gate.degrees_of_freedom,
            "p": gate.p,
            "accepted": gate.accepted,
            **{f"weight_{name}": weight for name, weight in judged.weights.items()},
        }
    )


def _correction(correction: Correction | Unavailable) -> dict[str, Any]:
    if isinstance(correction, Unavailable):
        return unavailable(correction)
    solution = correction.solution
    return present(
        {
            "moved_max_m": float(correction.moved_m.max()),
            "moved_rms_m": float(np.sqrt(np.mean(correction.moved_m**2))),
            "cost_initial": None if solution is None else solution.initial_cost,
            "cost": None if solution is None else solution.cost,
            "iterations": None if solution is None else solution.iterations,
            "converged": None if solution is None else solution.converged,
            "scores": {name: evaluation_part(s) for name, s in correction.scores.items()},
        }
    )


def _relative(error: RelativeError) -> dict[str, Any]:
    return {
        "delta": error.delta.value,
        "unit": error.delta.unit,
        "all_pairs": error.all_pairs,
        "pairs_from": error.pairs_from,
        "translation_m": _statistics(error.translation),
        "interval_m": _interval(error.interval),
        "rotation_deg": _statistics(error.rotation),
    }


def _statistics(values: Statistics | Unavailable) -> dict[str, Any]:
    return unavailable(values) if isinstance(values, Unavailable) else asdict(values)


def _interval(interval: Interval | Unavailable) -> dict[str, Any]:
    return unavailable(interval) if isinstance(interval, Unavailable) else asdict(interval)
