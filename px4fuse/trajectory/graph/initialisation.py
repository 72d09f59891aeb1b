"""Initial poses of a pose graph from its edges."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.graph import lie, model
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.normal_equations import NormalEquations


def compute_initial_poses(graph: PoseGraph) -> PoseGraph:
    """Compute initial poses of a pose graph from its edges.

    Method: chordal initialisation (Carlone et al. 2015, Initialization techniques for 3D SLAM,
    section IV-C), or odometry if its poses have a lower cost.

    Raises
    ------
    TrajectoryError
        The graph is not connected, or its edges do not determine its poses.
    """
    if np.any(model.find_odometry_edges(graph) < 0):
        return _compute_chordal_poses(graph)
    composed_graph = model.compose_odometry(graph)
    try:
        return min(composed_graph, _compute_chordal_poses(graph), key=model.cost)
    except TrajectoryError:  # chordal initialisation needs edges with rotation
        return composed_graph


def _compute_chordal_poses(graph: PoseGraph) -> PoseGraph:
    """Compute initial rotations, then initial positions, by linear least squares."""
    dimension = graph.dimension
    rotation_information = np.trace(graph.information[:, dimension:, dimension:], axis1=1, axis2=2)
    model.require_connected(graph, rotation_information > 0.0, "edges that measure a rotation")
    measured_rotation = lie.rotation_matrix(graph.measurements)
    eye = np.broadcast_to(np.eye(dimension), measured_rotation.shape)
    # Linear least squares for matrices R_i: minimise the weighted sum of |Zᵀ R_iᵀ - R_jᵀ|²
    unconstrained_matrices = _solve_positions(
        graph,
        measured_rotation.transpose(0, 2, 1),
        -eye,
        rotation_information[:, None, None] * eye,
        0.0 * measured_rotation,
        lie.rotation_matrix(graph.poses[0]).T,
    )
    rotation = _find_nearest_rotations(unconstrained_matrices.transpose(0, 2, 1))
    # Residual of an edge with rotation Z and translation z: (R_i Z)ᵀ (t_j - t_i - R_i z)
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
    return replace(graph, poses=poses, initial_pose_origin=model.INITIAL_POSES_FROM_CHORDAL)


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
    left_vectors, _, right_vectors = np.linalg.svd(matrices)
    left_vectors[:, :, -1] *= np.sign(np.linalg.det(left_vectors @ right_vectors))[:, None]
    return np.asarray(left_vectors @ right_vectors)
