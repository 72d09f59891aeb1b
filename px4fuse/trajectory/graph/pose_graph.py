"""Pose graphs: optimisation in the plane and in space, and closures that may be false.

What is written here is enough for callers; the modules beside it hold the parts.
"""

from px4fuse.trajectory.graph.covariance import GateResult, gate
from px4fuse.trajectory.graph.initialisation import initialise
from px4fuse.trajectory.graph.model import (
    FROM_CHORDAL,
    FROM_FILE,
    FROM_ODOMETRY,
    PoseGraph,
    chi_square,
    composed,
    cost,
    residuals,
)
from px4fuse.trajectory.graph.solver import Robust, Solution, solve

__all__ = [
    "FROM_CHORDAL",
    "FROM_FILE",
    "FROM_ODOMETRY",
    "GateResult",
    "PoseGraph",
    "Robust",
    "Solution",
    "chi_square",
    "composed",
    "cost",
    "gate",
    "initialise",
    "residuals",
    "solve",
]
