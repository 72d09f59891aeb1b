"""The paths of a loop: its closures judged, the path corrected in several ways, each scored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import brief
from px4fuse.errors import Px4FuseError
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import correct_by_distance, distribute_by_distance
from px4fuse.loop.odometry import Closure, OdometryNoise, pose_graph
from px4fuse.trajectory.evaluation import Evaluation, evaluate
from px4fuse.trajectory.graph.analysis import GATE_ALPHA, SOLUTIONS
from px4fuse.trajectory.graph.covariance import GateResult, gate
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import Solution, solve
from px4fuse.trajectory.model import Trajectory

UNCORRECTED = "uncorrected"
PLAIN = "by distance, positions only"
BY_DISTANCE = "by distance, headings too"
SINGLE_LOOP = (
    "A single loop has no redundancy: nothing else in the graph can contradict it, so that robust "
    "solving can reject nothing and only the gate can."
)


@dataclass(frozen=True)
class Judged:
    """One closure and what was found about it.

    Attributes
    ----------
    closure : Closure
    distance_m : float
        By which the odometry misses it.
    gate : GateResult
    weights : mapping from "dcs" and "gnc" to float
        What robust solving gives it, 0 to 1; empty where there is no redundancy.
    """

    closure: Closure
    distance_m: float
    gate: GateResult
    weights: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Correction:
    """A corrected path, or the odometry itself.

    Attributes
    ----------
    name : str
    trajectory : Trajectory
        All poses of the part, corrected.
    moved_m : ndarray, shape (n,)
        How far each pose moved.
    scores : mapping from the reference's name to Evaluation or Unavailable
    solution : Solution or None
        Of a pose graph.
    """

    name: str
    trajectory: Trajectory
    moved_m: Array
    scores: Mapping[str, Evaluation | Unavailable] = field(default_factory=dict)
    solution: Solution | None = None

    __repr__ = brief


def by_distance(
    path: Trajectory,
    distance: Array,
    misclosure_m: Array | Unavailable,
    heading: float | Unavailable,
    judged: tuple[Judged, ...],
) -> tuple[Correction | Unavailable, Correction | Unavailable]:
    """Positions alone (the lesson's Example 2), and headings too."""
    if isinstance(misclosure_m, Unavailable):
        return misclosure_m, misclosure_m
    if judged and not judged[0].gate.accepted:
        refused = _refused("correction by distance", judged[0])
        return refused, refused
    plain = path.moved(
        distribute_by_distance(path.position_m, misclosure_m, distance), path.rotation
    )
    turned = 0.0 if isinstance(heading, Unavailable) else float(np.radians(heading))
    corrected = correct_by_distance(path, distance, misclosure_m, turned)
    return _correction(PLAIN, path, plain), _correction(BY_DISTANCE, path, corrected)


def _refused(what: str, judged: Judged) -> Unavailable:
    return Unavailable(
        what,
        f"the gate rejects {judged.closure} (d² {judged.gate.d2:.1f}, p {judged.gate.p:.1g}): "
        "forcing it would warp the whole path",
        "Measure where the vehicle landed (--landed-at), leave the landing out (--open), or say "
        "with --drift that this odometry drifts more.",
    )


def _correction(
    name: str, path: Trajectory, corrected: Trajectory, solution: Solution | None = None
) -> Correction:
    moved: Array = np.linalg.norm(corrected.position_m - path.position_m, axis=1)
    return Correction(name, corrected, moved, solution=solution)


def solve_all(
    path: Trajectory,
    frames: IntArray,
    closures: tuple[Closure, ...],
    noise: OdometryNoise,
    references: tuple[Trajectory, ...],
    offsets: Mapping[str, float],
    progress: Callable[[str], None],
) -> tuple[tuple[Judged, ...], PoseGraph | Unavailable, dict[str, Correction | Unavailable], str]:
    """Judge the closures and solve the graph with all, with the good ones, and robustly."""
    if path.rotation is None:
        lacking = Unavailable(
            "pose graph", "the trajectory has no orientations", "Give one that has."
        )
        return (), lacking, dict.fromkeys(SOLUTIONS, lacking), ""
    at = [time for closure in closures for time in (closure.time_1_s, closure.time_2_s)]
    nearest = [int(np.argmin(np.abs(path.time_s - time))) for time in at]
    nodes = np.unique([*frames, *nearest]).astype(np.intp)
    graph, statement = pose_graph(path, nodes, closures, noise)
    if not closures:
        nothing = Unavailable("pose graph", "there is no closure", "Give one with --closure.")
        return (), graph, dict.fromkeys(SOLUTIONS, nothing), statement
    edges = np.arange(len(graph.first) - len(closures), len(graph.first))
    gates = gate(graph, edges, alpha=GATE_ALPHA)
    judged = []
    for closure, result in zip(closures, gates, strict=True):
        i, j = graph.first[result.edge], graph.second[result.edge]
        missed = graph.poses[j, :3] - graph.poses[i, :3] - np.array(closure.displacement_m)
        judged.append(Judged(closure, float(np.linalg.norm(missed)), result))
    loops = np.zeros(len(graph.first), dtype=np.bool_)
    loops[edges] = True
    accepted = np.ones(len(graph.first), dtype=np.bool_)
    accepted[edges] = [result.accepted for result in gates]
    solved: dict[str, Correction | Unavailable] = {}
    for name, label in SOLUTIONS.items():
        progress(f"solving: {label}")
        if name in ("dcs", "gnc") and len(closures) < 2:
            solved[name] = Unavailable(label, SINGLE_LOOP, "Give further closures with --closure.")
            continue
        if name == "gated" and not accepted[edges].any():
            solved[name] = _refused("pose graph", judged[0])
            continue
        if name == "gated" and accepted.all():  # the same graph as with all of them
            same = solved["all"]
            solved[name] = replace(same, name=label) if isinstance(same, Correction) else same
            continue
        if name == "gated":
            solution = solve(without(graph, ~accepted))
        elif name == "all":
            solution = solve(graph)
        else:
            solution = solve(graph, robust="dcs" if name == "dcs" else "gnc", loops=loops)
            judged = [
                replace(one, weights={**one.weights, name: float(solution.weights[edge])})
                for one, edge in zip(judged, edges, strict=True)
            ]
        corrected = _carried(path, nodes, graph.poses, solution.poses)
        solved[name] = scored(_correction(label, path, corrected, solution), references, offsets)
    return tuple(judged), graph, solved, statement


def without(graph: PoseGraph, dropped: BoolArray) -> PoseGraph:
    """A graph without some of its edges."""
    return replace(
        graph,
        first=graph.first[~dropped],
        second=graph.second[~dropped],
        measurements=graph.measurements[~dropped],
        information=graph.information[~dropped],
    )


def _carried(path: Trajectory, nodes: IntArray, before: Array, after: Array) -> Trajectory:
    """All poses of a path, each moved as the nodes before and after it were."""
    if path.rotation is None:
        raise ValueError("a pose graph needs orientations")
    old, new = Rotation.from_quat(before[:, 3:]), Rotation.from_quat(after[:, 3:])
    turn = new * old.inv()
    left = np.clip(np.searchsorted(nodes, np.arange(len(path)), side="right") - 1, 0, None)
    left = np.minimum(left, len(nodes) - 2)
    time = path.time_s
    share = (time - time[nodes[left]]) / (time[nodes[left + 1]] - time[nodes[left]])
    moved = [
        after[node, :3] + turn[node].apply(path.position_m - before[node, :3])
        for node in (left, left + 1)
    ]
    weight = np.clip(share, 0.0, 1.0)[:, np.newaxis]
    return path.moved(
        (1.0 - weight) * moved[0] + weight * moved[1],
        Slerp(time[nodes], turn)(time) * path.rotation,
    )


def scored(
    correction: Correction,
    references: tuple[Trajectory, ...],
    offsets: Mapping[str, float] | None = None,
) -> Correction:
    """Score a path against every reference; the clocks are matched once, on the odometry."""
    scores: dict[str, Evaluation | Unavailable] = {}
    for reference in references:
        same_clock = reference.sha256 == correction.trajectory.sha256
        known = 0.0 if same_clock else None
        if offsets is not None:
            known = offsets.get(reference.name, known)
        try:
            scores[reference.name] = evaluate(correction.trajectory, reference, time_offset_s=known)
        except Px4FuseError as error:
            scores[reference.name] = Unavailable(
                f"score against {reference.name}", str(error), "Give another --reference."
            )
    return replace(correction, scores=scores)


def offsets_of(odometry: Correction) -> dict[str, float]:
    """Clock offsets to each reference, as found on the odometry."""
    return {
        name: score.time_offset.offset_s
        for name, score in odometry.scores.items()
        if isinstance(score, Evaluation) and score.time_offset.offset_s is not None
    }
