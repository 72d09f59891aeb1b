"""A pose graph from a file: its closures judged, and the graph solved with and without doubt."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from px4fuse.errors import TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.record import Count, Record
from px4fuse.trajectory.graph.covariance import GateResult, gate
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import GraphSolution, Solution, solve

MANY_CLOSURES = 1000
# Chance that the gate rejects a closure that is true
GATE_ALPHA = 0.001
# What the solutions of the pose graph are called
SOLUTIONS: Mapping[str, str] = {
    "all": "pose graph, all closures",
    "gated": "pose graph, gated",
    "dcs": "pose graph, DCS",
    "gnc": "pose graph, GNC",
}


class Graph(Record, frozen=True):
    """A pose graph from a file, its closures and its solutions, as results have them."""

    name: str
    dimension: Count
    poses: Count
    edges: Count
    initialised: str
    gates: tuple[GateResult, ...] | Unavailable
    solutions: dict[str, GraphSolution]


@dataclass(frozen=True)
class SolvedGraph:
    """A pose graph and its solutions.

    Attributes
    ----------
    graph : PoseGraph
        With the poses of the plain solution.
    gates : tuple of GateResult, or Unavailable
        Of every edge that is no odometry.
    solutions : mapping from name, as in :data:`SOLUTIONS`, to Solution
    """

    graph: PoseGraph
    gates: tuple[GateResult, ...] | Unavailable
    solutions: Mapping[str, Solution]


def analyse_graph(
    graph: PoseGraph,
    progress: Callable[[str], None] = lambda _: None,
    *,
    robust: bool | None = None,
) -> SolvedGraph:
    """Judge the closures of a graph and solve it, plainly and robustly.

    Edges between successive vertices are odometry, the others closures.

    Parameters
    ----------
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
        gates = tuple(gate(graph, np.flatnonzero(closures), alpha=GATE_ALPHA))
    except TrajectoryError as error:
        gates = Unavailable("gate", str(error), "It needs an odometry edge between all successors.")
    count = np.count_nonzero(closures)
    if robust is None:
        robust = bool(count <= MANY_CLOSURES)
    if robust and count > 1:
        for name in ("dcs", "gnc"):
            progress(f"solving: {SOLUTIONS[name]}")
            solutions[name] = solve(graph, robust="dcs" if name == "dcs" else "gnc", loops=closures)
    return SolvedGraph(replace(graph, poses=solutions["all"].poses), gates, solutions)
