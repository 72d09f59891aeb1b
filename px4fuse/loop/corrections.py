"""Corrections of a loop: test of its closures, corrected paths, and scores of each path."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import Px4FuseError
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import correct_by_distance, distribute_by_distance
from px4fuse.loop.model import LANDING, Closure, CorrectedPath, Way
from px4fuse.loop.odometry import ClosureClaim
from px4fuse.record import to_serializable
from px4fuse.trajectory.evaluation import Evaluation, evaluate
from px4fuse.trajectory.graph.analysis import ROBUST, SOLUTIONS
from px4fuse.trajectory.graph.covariance import gate
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import Solution, solve
from px4fuse.trajectory.model import Trajectory

UNCORRECTED = "uncorrected"
POSITIONS_ONLY = "by distance, positions only"
BY_DISTANCE = "by distance, headings too"
# names of the corrections
NAMES: Mapping[str, str] = {
    "uncorrected": UNCORRECTED,
    "by_distance_plain": POSITIONS_ONLY,
    "by_distance": BY_DISTANCE,
    **{f"pose_graph_{name}": label for name, label in SOLUTIONS.items()},
}
SINGLE_LOOP = (
    "A single loop has no redundancy: only the gate can reject it, robust optimisation cannot."
)
# corrected path with the solution of the pose graph, if it is of one; or the reason why it is
# missing
Corrected = tuple[Trajectory, Solution | None] | Unavailable


def correct_paths_by_distance(
    path: Trajectory,
    distance: Array,
    misclosure_m: Array | Unavailable,
    heading: float | Unavailable,
    landing: Closure | None,
) -> dict[Way, Corrected]:
    """Correct the path by distance: positions only (as in the lesson), and with headings."""
    if landing is not None and not landing.accepted:
        misclosure_m = _rejected_closure("correction by distance", landing)
    if isinstance(misclosure_m, Unavailable):
        return {"by_distance_plain": misclosure_m, "by_distance": misclosure_m}
    positions_only = distribute_by_distance(path.position_m, misclosure_m, distance)
    heading_rad = 0.0 if isinstance(heading, Unavailable) else float(np.radians(heading))
    with_headings = correct_by_distance(path, distance, misclosure_m, heading_rad)
    return {
        "by_distance_plain": (path.moved(positions_only), None),
        "by_distance": (with_headings, None),
    }


def _rejected_closure(what: str, closure: Closure) -> Unavailable:
    return Unavailable(
        what,
        f"the gate rejects {closure} (d² {closure.d2:.1f}, p {closure.p:.1g}); "
        "enforcing it would deform the whole path",
        "Measure the landing place (--landed-at), leave the landing out (--open), "
        "or increase --drift if this odometry drifts more.",
    )


def gate_closures(
    graph: PoseGraph | Unavailable, claims: Sequence[ClosureClaim]
) -> tuple[Closure, ...]:
    """Test each closure (last edges of the graph) against odometry; empty without graph."""
    if isinstance(graph, Unavailable):
        return ()
    edges = np.arange(len(graph.first) - len(claims), len(graph.first))
    closures = []
    for result, (closure, end) in zip(gate(graph, edges), claims, strict=True):
        odometry_m = graph.poses[result.second, :3] - graph.poses[result.first, :3]
        facts = structs.asdict(closure) | structs.asdict(result)
        del facts["first"], facts["second"]
        facts["source"] = "given" if end is None else LANDING
        true_m = np.zeros(3) if end is None else end.displacement
        closures.append(Closure(distance_m=float(np.linalg.norm(odometry_m - true_m)), **facts))
    return tuple(closures)


def solve_all(
    path: Trajectory,
    nodes: IntArray,
    graph: PoseGraph | Unavailable,
    closures: tuple[Closure, ...],
    progress: Callable[[str], None],
) -> tuple[dict[Way, Corrected], tuple[Closure, ...]]:
    """Optimise the graph with all closures, with the accepted ones, and robustly."""
    found: dict[Any, Corrected] = {}
    if isinstance(graph, Unavailable) or not closures:
        none = Unavailable("pose graph", "no loop closure", "Give one with --closure.")
        why = graph if isinstance(graph, Unavailable) else none
        found |= {f"pose_graph_{name}": why for name in SOLUTIONS}
        return found, ()
    edges = np.arange(len(graph.first))
    loops = edges >= len(edges) - len(closures)
    rejected = np.zeros(len(edges), dtype=np.bool_)
    rejected[loops] = [not closure.accepted for closure in closures]
    for name, label in SOLUTIONS.items():
        way, robust = f"pose_graph_{name}", ROBUST.get(name, "none")
        progress(f"optimising: {label}")
        if robust != "none" and len(closures) < 2:
            more = "Give further closures with --closure."
            found[way] = Unavailable(label, SINGLE_LOOP, more)
        elif name == "gated" and rejected[loops].all():
            found[way] = _rejected_closure("pose graph", closures[0])
        elif name == "gated" and not rejected.any():
            found[way] = found["pose_graph_all"]
        else:
            used = ~rejected if name == "gated" else np.ones_like(rejected)
            solution = solve(graph.select_edges(used), robust=robust, loops=loops[used])
            found[way] = (
                _interpolate_corrections(path, nodes, graph.poses, solution.poses),
                solution,
            )
            if robust != "none":
                each = zip(closures, solution.weights[loops].tolist(), strict=True)
                closures = tuple(structs.replace(one, **{f"weight_{name}": w}) for one, w in each)
    return found, closures


def _interpolate_corrections(
    path: Trajectory, nodes: IntArray, before: Array, after: Array
) -> Trajectory:
    """Correct all poses by interpolating the corrections of the neighbouring nodes."""
    turn = Rotation.from_quat(after[:, 3:]) * Rotation.from_quat(before[:, 3:]).inv()
    left = np.searchsorted(nodes, np.arange(len(path)), side="right") - 1
    left = np.clip(left, 0, len(nodes) - 2)
    time = path.time_s
    share = (time - time[nodes[left]]) / (time[nodes[left + 1]] - time[nodes[left]])
    moved = [
        after[node, :3] + turn[node].apply(path.position_m - before[node, :3])
        for node in (left, left + 1)
    ]
    weight = np.clip(share, 0.0, 1.0)[:, np.newaxis]
    position = (1.0 - weight) * moved[0] + weight * moved[1]
    return path.moved(position, Slerp(time[nodes], turn)(time))


def score_all(
    odometry: Trajectory,
    corrected_paths: Mapping[Way, Corrected],
    references: tuple[Trajectory, ...],
) -> dict[Way, CorrectedPath | Unavailable]:
    """Score odometry and corrected paths; time offsets are estimated once, on the odometry."""
    offsets: dict[str, float] = {}

    def score(path: Trajectory, reference: Trajectory) -> Evaluation | Unavailable:
        same_clock = 0.0 if reference.sha256 == path.sha256 else None
        known = offsets.get(reference.name, same_clock)
        try:
            return evaluate(path, reference, time_offset_s=known)
        except Px4FuseError as error:
            what = f"score against {reference.name}"
            return Unavailable(what, str(error), "Give another --reference.")

    def scored(way: Way, path: Trajectory, solution: Solution | None) -> CorrectedPath:
        displacement_m: Array = np.linalg.norm(path.position_m - odometry.position_m, axis=1)
        costs: dict[str, Any] = (
            {} if solution is None else structs.asdict(to_serializable(solution))
        )
        costs.pop("dropped", None)
        return CorrectedPath(
            name=NAMES[way],
            trajectory=path,
            moved_m=displacement_m,
            correction_max_m=float(displacement_m.max()),
            correction_rms_m=float(np.sqrt(np.mean(displacement_m**2))),
            scores={reference.name: score(path, reference) for reference in references},
            solution=solution,
            **costs,
        )

    raw = scored("uncorrected", odometry, None)
    for name, path_scored in raw.scores.items():
        if isinstance(path_scored, Evaluation) and path_scored.time_offset.offset_s is not None:
            offsets[name] = path_scored.time_offset.offset_s
    found: dict[Way, CorrectedPath | Unavailable] = {"uncorrected": raw}
    for way, corrected in corrected_paths.items():
        same = found.get("pose_graph_all")
        if isinstance(corrected, Unavailable):
            found[way] = corrected
        elif isinstance(same, CorrectedPath) and corrected[1] is same.solution:
            found[way] = structs.replace(same, name=NAMES[way])
        else:
            found[way] = scored(way, *corrected)
    return found
