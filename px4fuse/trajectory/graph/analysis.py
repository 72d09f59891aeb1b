"""A pose graph from a file: its closures judged, and the graph solved with and without doubt."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from px4fuse.errors import TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.record import Count, Record
from px4fuse.trajectory.graph.covariance import GateResult, gate
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import GraphSolution, Robust, Solution, solve

MAX_ROBUST_CLOSURES = 1000
# What the solutions of the pose graph are called
SOLUTIONS: Mapping[str, str] = {
    "all": "pose graph, all closures",
    "gated": "pose graph, gated",
    "dcs": "pose graph, DCS",
    "gnc": "pose graph, GNC",
}
# and those of them that doubt closures
ROBUST: Mapping[str, Robust] = {"dcs": "dcs", "gnc": "gnc"}


class Graph(Record, frozen=True, kw_only=True):
    """A pose graph from a file, its closures and its solutions.

    Attributes
    ----------
    name : str
    dimension, poses, edges : int
    initialised : str
        Where the poses come from.
    gates : tuple of GateResult, or Unavailable
        Of every edge that is no odometry.
    solutions : mapping from name, as in :data:`SOLUTIONS`
    """

    name: str
    dimension: Count
    poses: Count
    edges: Count
    initialised: str
    gates: tuple[GateResult, ...] | Unavailable
    solutions: Mapping[str, GraphSolution]


class SolvedGraph(Graph, frozen=True, kw_only=True, eq=False):
    """A pose graph with its solutions.

    Attributes
    ----------
    graph : PoseGraph
        With the poses of the plain solution.
    """

    schema_type = Graph
    solutions: Mapping[str, Solution]
    graph: PoseGraph


def analyse_graph(
    name: str,
    graph: PoseGraph,
    progress: Callable[[str], None] = lambda _: None,
    *,
    robust: bool | None = None,
) -> SolvedGraph:
    """Judge the closures of a graph and solve it, plainly and robustly.

    Edges between successive vertices are odometry, the others closures.

    Parameters
    ----------
    name : str
        What the graph is called.
    robust : bool, optional
        Whether to solve it robustly too; by default up to 1000 closures, since it takes minutes
        for more.

    Raises
    ------
    TrajectoryError
        The graph is not connected.
    """
    closures = ~graph.successive
    progress(f"solving: {SOLUTIONS['all']}")
    solutions = {"all": solve(graph)}
    gates: tuple[GateResult, ...] | Unavailable
    try:
        gates = tuple(gate(graph, np.flatnonzero(closures)))
    except TrajectoryError as error:
        gates = Unavailable("gate", str(error), "It needs an odometry edge between all successors.")
    count = int(np.count_nonzero(closures))
    if count > 1 and (count <= MAX_ROBUST_CLOSURES if robust is None else robust):
        for key, method in ROBUST.items():
            progress(f"solving: {SOLUTIONS[key]}")
            solutions[key] = solve(graph, robust=method, loops=closures)
    return SolvedGraph(
        name=name,
        dimension=graph.dimension,
        poses=len(graph),
        edges=len(graph.first),
        initialised=graph.initialised,
        gates=gates,
        solutions=solutions,
        graph=replace(graph, poses=solutions["all"].poses),
    )
