"""Analysis of a pose graph: tests of its loop closures, least squares and robust optimisation."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from px4fuse.core.record import Count, Record
from px4fuse.errors import TrajectoryError
from px4fuse.flight.model import Unavailable
from px4fuse.trajectory.graph.covariance import GateResult, gate_edges
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import Solution, solve

# Maximum number of closures for robust optimisation by default: with more closures the optimisation
# takes minutes
MAX_ROBUST_CLOSURES = 1000
# Key of the solution by robust optimisation (graduated non-convexity)
ROBUST = "gnc"
# Labels of the pose graph solutions, by the key in results.json
SOLUTIONS: Mapping[str, str] = {
    "all": "pose graph, all closures",
    "gated": "pose graph, gated closures",
    ROBUST: "pose graph, robust (GNC)",
}


class Graph(Record, kw_only=True):
    """Pose graph for results.json: size, tests of the closures, and solutions.

    Attributes
    ----------
    name : str
    dimension, poses, edges : int
    initialised : str
        Source of the initial poses.
    gates : tuple of GateResult, or Unavailable
        Tests of all edges that are not odometry.
    solutions : mapping from key of :data:`SOLUTIONS` to Solution
    """

    name: str
    dimension: Count
    poses: Count
    edges: Count
    initialised: str
    gates: tuple[GateResult, ...] | Unavailable
    solutions: Mapping[str, Solution]


def analyse_graph(
    name: str,
    graph: PoseGraph,
    progress: Callable[[str], None] = lambda _: None,
    *,
    run_robust: bool | None = None,
) -> tuple[Graph, PoseGraph]:
    """Test the loop closures of a pose graph, and optimise the graph by least squares and robustly.

    Edges between successive vertices are odometry, all other edges are closures. ``run_robust``
    is by default True with up to 1000 closures. Return also the pose graph with the poses of the
    least-squares solution.

    Raises
    ------
    TrajectoryError
        The graph is not connected.
    """
    is_closure = ~graph.is_successive
    progress(f"optimising: {SOLUTIONS['all']}")
    solutions = {"all": solve(graph)}
    gates: tuple[GateResult, ...] | Unavailable
    try:
        gates = tuple(gate_edges(graph, np.flatnonzero(is_closure)))
    except TrajectoryError as error:
        gates = Unavailable(
            "gate", str(error), "Give an odometry edge between all successive vertices."
        )
    closure_count = int(np.count_nonzero(is_closure))
    if closure_count > 1 and (
        closure_count <= MAX_ROBUST_CLOSURES if run_robust is None else run_robust
    ):
        progress(f"optimising: {SOLUTIONS[ROBUST]}")
        solutions[ROBUST] = solve(graph, robust=True, is_closure=is_closure)
    results = Graph(
        name=name,
        dimension=graph.dimension,
        poses=len(graph),
        edges=len(graph.first),
        initialised=graph.initialised,
        gates=gates,
        solutions=solutions,
    )
    return results, replace(graph, poses=solutions["all"].poses)
