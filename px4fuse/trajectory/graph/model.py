"""What a pose graph is, what it costs, and what holds it together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.graph import lie

# An information matrix, scaled to a unit diagonal, sees the directions whose eigenvalue is above
MIN_OBSERVED_EIGENVALUE = 1e-9
FROM_FILE = "the file's vertices"
FROM_ODOMETRY = "odometry edges composed"
FROM_CHORDAL = "chordal initialisation"


@dataclass(frozen=True)
class PoseGraph:
    """Poses, and measurements of one pose as seen from another.

    Attributes
    ----------
    dimension : int
        2 or 3.
    ids : ndarray of int, shape (n,)
        Vertex numbers as in the file, in ascending order where a file gave them.
    poses : ndarray, shape (n, 3) or (n, 7)
        x, y, heading in the plane; x, y, z, qx, qy, qz, qw in space; m and rad, in the world's
        frame. Quaternions are normalised.
    first, second : ndarray of int, shape (m,)
        Indices into ``poses``, not vertex numbers: the measurement is of ``second`` as seen from
        ``first``.
    measurements : ndarray, shape (m, 3) or (m, 7)
        As ``poses``, in the axes of ``first``.
    information : ndarray, shape (m, 3, 3) or (m, 6, 6)
        Inverse covariance of the measurement's error in the axes of the measured pose, translation
        before rotation, in 1/m² and 1/rad². Positive semidefinite: zero along what the measurement
        does not tell.
    initialised : str
        Where the poses come from.
    """

    dimension: int
    ids: IntArray
    poses: Array
    first: IntArray
    second: IntArray
    measurements: Array
    information: Array
    initialised: str = FROM_FILE

    __repr__ = one_line_repr

    def __len__(self) -> int:
        return len(self.ids)

    def select_edges(self, chosen: BoolArray) -> PoseGraph:
        """The graph with some of its edges, shape (m,)."""
        edges = ("first", "second", "measurements", "information")
        return replace(self, **{name: getattr(self, name)[chosen] for name in edges})

    @property
    def freedom(self) -> int:
        """Numbers of a tangent: 3 in the plane, 6 in space."""
        return 3 if self.dimension == 2 else 6

    @property
    def successive(self) -> BoolArray:
        """Which edges join two successive poses: odometry, unless the caller knows better."""
        return np.asarray(np.abs(self.first - self.second) == 1)


@dataclass(frozen=True)
class Residuals:
    """By how much some poses miss the measurements of a graph.

    Attributes
    ----------
    poses : ndarray, shape (n, 3) or (n, 7)
    relative : ndarray, shape (m, 3) or (m, 7)
        Second pose of each edge as seen from the first.
    residual : ndarray, shape (m, d)
        ``r = log(Z^-1 X_i^-1 X_j)``, as GTSAM's BetweenFactor has it.
    weighted : ndarray, shape (m, d)
        ``Omega r``.
    chi2 : ndarray, shape (m,)
        ``r' Omega r``: squared, in units of the measurements' own covariance.
    """

    poses: Array
    relative: Array
    residual: Array
    weighted: Array
    chi2: Array


def residuals(graph: PoseGraph, poses: Array) -> Residuals:
    """Residuals of all edges at given poses, shape (n, 3) or (n, 7)."""
    relative = lie.between(poses[graph.first], poses[graph.second])
    residual = lie.log(lie.between(graph.measurements, relative))
    weighted = (graph.information @ residual[..., None])[..., 0]
    return Residuals(poses, relative, residual, weighted, np.sum(residual * weighted, axis=-1))


def cost(graph: PoseGraph) -> float:
    """Half the sum of the squared residuals, as GTSAM's ``graph.error`` has it."""
    return 0.5 * float(np.sum(residuals(graph, graph.poses).chi2))


def information_eigenvectors(information: Array) -> tuple[Array, Array]:
    """Functionals of the residual that an information matrix tells about, and their variances.

    Translation and rotation have different units, so the matrix is scaled to a unit diagonal
    before eigenvalues are called zero.

    Parameters
    ----------
    information : ndarray, shape (d, d)

    Returns
    -------
    directions : ndarray, shape (d, k)
        ``directions' r`` is observed; k is the rank.
    variance : ndarray, shape (k,)
        ``information == directions @ diag(1 / variance) @ directions.T``.
    """
    scale, scaled = scale_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    is_observed = values > MIN_OBSERVED_EIGENVALUE
    return scale[:, None] * vectors[:, is_observed], 1.0 / values[is_observed]


def scale_to_unit_diagonal(matrices: Array) -> tuple[Array, Array]:
    """Roots of the diagonals of matrices, and the matrices divided by them; what is 0 stays 0."""
    scale = np.sqrt(np.clip(np.diagonal(matrices, axis1=-2, axis2=-1), 0.0, None))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    return scale, matrices * (inverse[..., :, None] * inverse[..., None, :])


def require_connected(graph: PoseGraph, used: BoolArray, what: str) -> None:
    """Refuse a graph that falls into parts.

    Parameters
    ----------
    used : ndarray of bool, shape (m,)
        The edges that may hold it together, where they tell anything at all.
    what : str
        Their name, for the message: "the edges".

    Raises
    ------
    TrajectoryError
        Says how many parts there are and which vertex is apart.
    """
    if not len(graph.first):
        raise TrajectoryError("The pose graph has no edges", "Give a file with EDGE lines.")
    is_informative = used & (np.trace(graph.information, axis1=1, axis2=2) > 0.0)
    ends, n = (graph.first[is_informative], graph.second[is_informative]), len(graph)
    links = sparse.coo_array((np.ones(len(ends[0])), ends), shape=(n, n))
    component_count, component = connected_components(links, directed=False)
    if component_count > 1:
        other_vertex = graph.ids[np.flatnonzero(component != component[0])[0]]
        raise TrajectoryError.of(
            "graph_in_parts",
            component_count=component_count,
            other_vertex=other_vertex,
            first=graph.ids[0],
            what=what,
        )


def compose_odometry(graph: PoseGraph) -> PoseGraph:
    """The same graph with poses along its odometry, which has no gap, from the first pose on."""
    steps = odometry_steps(graph, odometry_chain(graph))
    poses = lie.compose(graph.poses[:1], lie.chain(steps))
    return replace(graph, poses=poses, initialised=FROM_ODOMETRY)


def odometry_chain(graph: PoseGraph, without: IntArray | None = None) -> IntArray:
    """The edge that leads from each pose to the next, -1 where there is none.

    Parameters
    ----------
    without : ndarray of int, optional
        Edges that may not be used. The first one between two poses is taken.

    Returns
    -------
    ndarray of int, shape (n - 1,)
    """
    odometry_edges = np.flatnonzero(graph.successive)
    if without is not None:
        odometry_edges = np.setdiff1d(odometry_edges, without)
    next_edge = np.full(len(graph) - 1, -1, dtype=np.intp)
    # Backwards, so that of several edges the first one is what stays
    odometry_edges = odometry_edges[::-1]
    next_edge[np.minimum(graph.first[odometry_edges], graph.second[odometry_edges])] = (
        odometry_edges
    )
    return next_edge


def odometry_steps(graph: PoseGraph, chain: IntArray) -> Array:
    """Each next pose as seen from the one before, along a chain of edges.

    Parameters
    ----------
    chain : ndarray of int, shape (k,)
        Edges between successive poses, in order.

    Returns
    -------
    ndarray, shape (k, 3) or (k, 7)
    """
    steps = graph.measurements[chain].copy()
    is_backward = graph.first[chain] > graph.second[chain]
    steps[is_backward] = lie.inverse(steps[is_backward])
    return steps
