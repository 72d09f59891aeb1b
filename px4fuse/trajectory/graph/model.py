"""Pose graph: poses, measurements of relative poses, and initial poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, BoolArray, IntArray
from px4fuse.core.record import one_line_repr
from px4fuse.errors import TrajectoryError

from . import lie
from .normal_equations import NormalEquations

# Directions with smaller eigenvalues of the information matrix (unit diagonal) are not measured
MIN_EIGENVALUE_OF_OBSERVED_DIRECTION = 1e-9
INITIAL_POSES_FROM_FILE = "vertices in the g2o file"
INITIAL_POSES_FROM_ODOMETRY = "chained odometry edges"
INITIAL_POSES_FROM_CHORDAL_INITIALISATION = "chordal initialisation"


@dataclass(frozen=True)
class PoseGraph:
    """Poses (vertices) and measurements of relative poses (edges), in m and rad."""

    dimension: int
    # Vertex numbers, in ascending order
    ids: IntArray
    # Poses: x, y, heading or x, y, z, qx, qy, qz, qw
    poses: Array
    # Indices of the two poses of each edge
    first_nodes: IntArray
    second_nodes: IntArray
    # Measured pose of the second node relative to the first node
    measurements: Array
    # Inverse covariance of each measurement, translation before rotation
    information: Array
    # Source of the initial poses, for example "chained odometry edges"
    initial_pose_origin: str = INITIAL_POSES_FROM_FILE

    __repr__ = one_line_repr

    def __len__(self) -> int:
        return len(self.ids)

    def select_edges(self, is_selected: BoolArray) -> PoseGraph:
        """Return the graph with a selection of its edges."""
        edge_fields = ("first_nodes", "second_nodes", "measurements", "information")
        return replace(self, **{name: getattr(self, name)[is_selected] for name in edge_fields})

    @cached_property
    def normal_equations(self) -> NormalEquations:
        """Normal equations of the poses, with the first pose fixed."""
        edges = np.stack([self.first_nodes, self.second_nodes])
        return NormalEquations(edges, self.information.shape[-1])

    def find_successive_edges(self) -> BoolArray:
        """Return a mask of the edges between successive poses."""
        return np.asarray(np.abs(self.first_nodes - self.second_nodes) == 1)


@dataclass(frozen=True)
class Residuals:
    """Residuals of the measurements of a pose graph.

    Attributes
    ----------
    poses : ndarray, shape (n, 3) or (n, 7)
    relative_poses : ndarray, shape (m, 3) or (m, 7)
        Second pose of each edge relative to the first pose.
    residual : ndarray, shape (m, d)
        ``r = log(Z^-1 X_i^-1 X_j)`` with measurement Z and poses X_i, X_j.
    chi2 : ndarray, shape (m,)
        Squared Mahalanobis distance of each residual.
    """

    poses: Array
    relative_poses: Array
    residual: Array
    chi2: Array


def residuals(graph: PoseGraph, poses: Array) -> Residuals:
    """Compute the residuals of all edges of a pose graph at given poses."""
    relative_poses = lie.relative_pose(poses[graph.first_nodes], poses[graph.second_nodes])
    residual = lie.log(lie.relative_pose(graph.measurements, relative_poses))
    weighted_residual = (graph.information @ residual[..., None])[..., 0]
    return Residuals(poses, relative_poses, residual, np.sum(residual * weighted_residual, axis=-1))


def cost(graph: PoseGraph) -> float:
    """Return half of the sum of the squared Mahalanobis distances of all edges."""
    return 0.5 * float(np.sum(residuals(graph, graph.poses).chi2))


def compute_observed_directions(information: Array) -> tuple[Array, Array]:
    """Return the directions (columns) in which an edge has information, and their variances.

    ``information == directions @ diag(1 / variance) @ directions.T``
    """
    scale, scaled_information = scale_to_unit_diagonal(information)
    eigenvalues, eigenvectors = np.linalg.eigh(scaled_information)
    is_observed = eigenvalues > MIN_EIGENVALUE_OF_OBSERVED_DIRECTION
    return scale[:, None] * eigenvectors[:, is_observed], 1.0 / eigenvalues[is_observed]


def count_observed_directions(information: Array) -> IntArray:
    """Return the rank of each information matrix: the number of measured directions."""
    _, scaled_information = scale_to_unit_diagonal(information)
    eigenvalues = np.linalg.eigvalsh(scaled_information)
    counts: IntArray = np.count_nonzero(eigenvalues > MIN_EIGENVALUE_OF_OBSERVED_DIRECTION, axis=1)
    return counts


def scale_to_unit_diagonal(matrices: Array) -> tuple[Array, Array]:
    """Return the square roots of the diagonals, and the matrices scaled to unit diagonal."""
    scale = np.sqrt(np.clip(np.diagonal(matrices, axis1=-2, axis2=-1), 0.0, None))
    inverse_scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    return scale, matrices * (inverse_scale[..., :, None] * inverse_scale[..., None, :])


def require_connected(graph: PoseGraph, is_used: BoolArray, edges_name: str) -> None:
    """Raise TrajectoryError if the used edges do not connect all poses of the graph."""
    is_informative = is_used & (np.trace(graph.information, axis1=1, axis2=2) > 0.0)
    edge_nodes = (graph.first_nodes[is_informative], graph.second_nodes[is_informative])
    node_count = len(graph)
    adjacency = sparse.coo_array(
        (np.ones(len(edge_nodes[0])), edge_nodes), shape=(node_count, node_count)
    )
    component_count, component_by_node = connected_components(adjacency, directed=False)
    if component_count > 1:
        disconnected_vertex_id = graph.ids[
            np.flatnonzero(component_by_node != component_by_node[0])[0]
        ]
        raise TrajectoryError(
            f"The pose graph has {component_count} disconnected parts: vertex "
            f"{disconnected_vertex_id} is not connected to vertex {graph.ids[0]} by {edges_name}.",
            "Connect the parts of the graph, or optimise each part separately.",
        )


def set_poses_from_odometry(graph: PoseGraph) -> PoseGraph:
    """Return the pose graph with poses from odometry."""
    poses = lie.compose(
        graph.poses[:1], lie.accumulate_poses(get_odometry_steps(graph, find_odometry_edges(graph)))
    )
    return replace(graph, poses=poses, initial_pose_origin=INITIAL_POSES_FROM_ODOMETRY)


def find_odometry_edges(graph: PoseGraph, excluded_edges: IntArray | None = None) -> IntArray:
    """Return the index of the odometry edge from each pose to the next, or -1, shape (n - 1,)."""
    odometry_edges = np.flatnonzero(graph.find_successive_edges())
    if excluded_edges is not None:
        odometry_edges = np.setdiff1d(odometry_edges, excluded_edges)
    edge_indices_to_next_pose = np.full(len(graph) - 1, -1, dtype=np.intp)
    # NumPy keeps the last assignment to an index, so this order keeps the first edge
    odometry_edges = odometry_edges[::-1]
    edge_indices_to_next_pose[
        np.minimum(graph.first_nodes[odometry_edges], graph.second_nodes[odometry_edges])
    ] = odometry_edges
    return edge_indices_to_next_pose


def get_odometry_steps(graph: PoseGraph, edge_indices: IntArray) -> Array:
    """Return measured motions between successive poses, from the earlier to the later pose."""
    relative_poses = graph.measurements[edge_indices].copy()
    is_backward = graph.first_nodes[edge_indices] > graph.second_nodes[edge_indices]
    relative_poses[is_backward] = lie.inverse(relative_poses[is_backward])
    return relative_poses


def compute_initial_poses(graph: PoseGraph) -> PoseGraph:
    """Compute initial poses of a pose graph from its edges.

    Method: chordal initialisation (Carlone et al. 2015, Initialization techniques for 3D SLAM,
    section IV-C), or odometry if its poses have a lower cost.

    Raises
    ------
    TrajectoryError
        The graph is not connected, or its edges do not determine its poses.
    """
    if np.any(find_odometry_edges(graph) < 0):
        return _compute_chordal_poses(graph)
    graph_with_odometry_poses = set_poses_from_odometry(graph)
    try:
        return min(graph_with_odometry_poses, _compute_chordal_poses(graph), key=cost)
    except TrajectoryError:  # chordal initialisation needs edges with rotation
        return graph_with_odometry_poses


def _compute_chordal_poses(graph: PoseGraph) -> PoseGraph:
    """Compute initial rotations, then initial positions, by linear least squares."""
    dimension = graph.dimension
    rotation_information = np.trace(graph.information[:, dimension:, dimension:], axis1=1, axis2=2)
    require_connected(graph, rotation_information > 0.0, "edges that measure a rotation")
    measured_rotation = lie.rotation_matrix(graph.measurements)
    eye = np.broadcast_to(np.eye(dimension), measured_rotation.shape)
    # 1. Rotations. An edge (i, j) with measured rotation Z states R_j = R_i Z. Without the
    # condition that R_i is a rotation, this is linear in R_i: minimise the sum of |Zᵀ R_iᵀ -
    # R_jᵀ|², weighted by the trace of the rotation information. Then replace each matrix by the
    # nearest rotation
    transposed_matrices = _solve_positions(
        graph,
        first_pose_matrix=measured_rotation.transpose(0, 2, 1),
        second_pose_matrix=-eye,
        information=rotation_information[:, None, None] * eye,
        right_hand_side=0.0 * measured_rotation,
        first_pose=lie.rotation_matrix(graph.poses[0]).T,
    )
    rotation = _find_nearest_rotations(transposed_matrices.transpose(0, 2, 1))
    # 2. Positions, with these rotations fixed. An edge with rotation Z, translation z and
    # information W has the residual (R_i Z)ᵀ (t_j - t_i - R_i z), so t_j - t_i - R_i z has the
    # information (R_i Z) W (R_i Z)ᵀ
    first_rotation = rotation[graph.first_nodes]
    predicted_second_rotation = first_rotation @ measured_rotation
    information = (
        predicted_second_rotation
        @ graph.information[:, :dimension, :dimension]
        @ predicted_second_rotation.transpose(0, 2, 1)
    )
    translation = first_rotation @ graph.measurements[:, :dimension, None]
    position = _solve_positions(
        graph, -eye, eye, information, translation, graph.poses[0, :dimension, None]
    )[..., 0]
    if dimension == 2:
        poses = np.column_stack([position, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])])
    else:
        poses = np.column_stack([position, Rotation.from_matrix(rotation).as_quat()])
    poses[0] = graph.poses[0]
    return replace(
        graph, poses=poses, initial_pose_origin=INITIAL_POSES_FROM_CHORDAL_INITIALISATION
    )


def _solve_positions(
    graph: PoseGraph,
    first_pose_matrix: Array,
    second_pose_matrix: Array,
    information: Array,
    right_hand_side: Array,
    first_pose: Array,
) -> Array:
    """Solve ``A x_i + B x_j = c`` by least squares over all edges (i, j), with given x_0.

    Parameters
    ----------
    first_pose_matrix, second_pose_matrix, information : ndarray, shape (m, d, d)
        A, B and weight of each of the m edges.
    right_hand_side : ndarray, shape (m, d, k)
        c of each edge.
    first_pose : ndarray, shape (d, k)
        Given value x_0 for the first pose.
    """
    edges = np.stack([graph.first_nodes, graph.second_nodes])
    equations = NormalEquations(edges, len(first_pose))
    fixed_first_pose = np.zeros((len(graph), *first_pose.shape))
    fixed_first_pose[0] = first_pose
    for pose_matrix, nodes in zip((first_pose_matrix, second_pose_matrix), edges, strict=True):
        right_hand_side = right_hand_side - pose_matrix @ fixed_first_pose[nodes]
    solution = equations.solve(
        *equations.assemble(first_pose_matrix, second_pose_matrix, information, right_hand_side)
    )
    if solution is None:
        raise TrajectoryError(
            "The edges do not determine all initial poses", "Give VERTEX lines with initial poses."
        )
    return fixed_first_pose + solution


def _find_nearest_rotations(matrices: Array) -> Array:
    """Return the nearest rotations to matrices, shape (n, d, d), in the Frobenius norm."""
    left_singular_vectors, _, right_singular_vectors = np.linalg.svd(matrices)
    left_singular_vectors[:, :, -1] *= np.sign(
        np.linalg.det(left_singular_vectors @ right_singular_vectors)
    )[:, None]
    return np.asarray(left_singular_vectors @ right_singular_vectors)
