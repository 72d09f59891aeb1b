"""Initial poses of a pose graph from its edges."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.graph import lie, model
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.normal_equations import NormalEquations


def initialise(graph: PoseGraph) -> PoseGraph:
    """Compute initial poses from the edges; the first pose is unchanged.

    The method is chordal initialisation (Carlone et al. 2015, Initialization techniques for 3D
    SLAM, section IV-C), or the composition of the odometry edges if its cost is lower.

    Raises
    ------
    TrajectoryError
        The graph is not connected, or its edges do not determine its poses.
    """
    if np.any(model.find_odometry_edges(graph) < 0):
        return _initialise_chordal(graph)
    composed_graph = model.compose_odometry(graph)
    try:
        return min(composed_graph, _initialise_chordal(graph), key=model.cost)
    except TrajectoryError:  # some edges have no rotation, so only the composed poses are possible
        return composed_graph


def _initialise_chordal(graph: PoseGraph) -> PoseGraph:
    """Fit rotation matrices and then translations, both by linear least squares."""
    dimension = graph.dimension
    rotation_information = np.trace(graph.information[:, dimension:, dimension:], axis1=1, axis2=2)
    model.require_connected(graph, rotation_information > 0.0, "edges with rotation information")
    measured_rotation = lie.rotation_matrix(graph.measurements)
    eye = np.broadcast_to(np.eye(dimension), measured_rotation.shape)
    # Minimise the sum of weight |Z' R_i' - R_j'|^2 (': transpose) over all matrices R, a linear
    # problem; the nearest rotations follow below. Z: measured rotation from pose i to pose j
    relaxed_rotation = _solve_positions(
        graph,
        measured_rotation.transpose(0, 2, 1),
        -eye,
        rotation_information[:, None, None] * eye,
        0.0 * measured_rotation,
        lie.rotation_matrix(graph.poses[0]).T,
    )
    rotation = _find_nearest_rotations(relaxed_rotation.transpose(0, 2, 1))
    # An edge measures rotation Z and translation z. Its residual translation in the measured axes
    # of pose j is (R_i Z)' (t_j - t_i - R_i z), for poses with rotation R and position t
    first_rotation = rotation[graph.first_nodes]
    measured_pose_rotation = first_rotation @ measured_rotation
    information = (
        measured_pose_rotation
        @ graph.information[:, :dimension, :dimension]
        @ measured_pose_rotation.transpose(0, 2, 1)
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
    return replace(graph, poses=poses, initialised=model.INITIAL_POSES_FROM_CHORDAL)


def _solve_positions(
    graph: PoseGraph,
    first_pose_coefficient: Array,
    second_pose_coefficient: Array,
    information: Array,
    edge_rhs: Array,
    first_pose: Array,
) -> Array:
    """Solve the :class:`NormalEquations` with the first pose, shape (d, k), fixed.

    Arguments are those of :meth:`NormalEquations.assemble`; the result has shape (n, d, k).
    """
    edges = np.stack([graph.first_nodes, graph.second_nodes])
    equations = NormalEquations(edges, *first_pose.shape)
    known_poses = np.zeros((len(graph), *first_pose.shape))
    known_poses[0] = first_pose
    for coefficient, nodes in zip(
        (first_pose_coefficient, second_pose_coefficient), edges, strict=True
    ):
        edge_rhs = edge_rhs - coefficient @ known_poses[nodes]
    equation_values, _ = equations.assemble(
        first_pose_coefficient, second_pose_coefficient, information, edge_rhs
    )
    solution = equations.solve(equation_values)
    if solution is None:
        raise TrajectoryError(
            "The edges do not determine the initial poses", "Give VERTEX lines with initial poses."
        )
    return known_poses + solution


def _find_nearest_rotations(matrices: Array) -> Array:
    """Return the nearest rotations to matrices, shape (n, d, d), in the Frobenius norm."""
    left_vectors, _, right_vectors = np.linalg.svd(matrices)
    left_vectors[:, :, -1] *= np.sign(np.linalg.det(left_vectors @ right_vectors))[:, None]
    return np.asarray(left_vectors @ right_vectors)
