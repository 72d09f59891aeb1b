"""χ² test (gate) of loop closures against odometry."""

import numpy as np
from scipy.special import chdtrc

from px4fuse.core.arrays import Array, IntArray
from px4fuse.core.record import Count, NonNegativeFloat, Record, Share
from px4fuse.errors import TrajectoryError

from . import lie, model

# Probability that the gate rejects a true closure
GATE_ALPHA = 0.001
# Smaller eigenvalues of a covariance matrix (scaled to unit diagonal) are rounding errors
_MIN_COVARIANCE_EIGENVALUE = 1e-13


class GateResult(Record):
    """Result of the χ² test of a loop closure against odometry.

    Attributes
    ----------
    first, second : int
        Vertex numbers of the two poses of the closure.
    d2 : float
        Squared Mahalanobis distance between closure and odometry.
    degrees_of_freedom : int
        Number of directions that the closure measures.
    p : float
        Probability of a larger ``d2`` for a true closure.
    accepted : bool
        True if p is at least :data:`GATE_ALPHA`.
    """

    first: int
    second: int
    d2: NonNegativeFloat
    degrees_of_freedom: Count
    p: Share
    accepted: bool


def gate_edges(graph: model.PoseGraph, tested_edge_indices: IntArray) -> list[GateResult]:
    """Test loop closures against odometry with a χ² test of the squared Mahalanobis distance.

    Source of the covariance propagation: Barfoot 2017, eqs. 8.96 and 8.108.

    Raises
    ------
    TrajectoryError
        Odometry does not connect the poses of a closure, or has a singular information matrix.
    """
    if not len(tested_edge_indices):
        return []
    odometry_edges = model.find_odometry_edges(graph, tested_edge_indices)
    nodes = np.stack(
        [graph.first_nodes[tested_edge_indices], graph.second_nodes[tested_edge_indices]]
    )
    first_pose_index = int(nodes.min())
    connecting_edges = odometry_edges[first_pose_index : int(nodes.max())]
    missing_edge_indices = np.flatnonzero(connecting_edges < 0)
    if len(missing_edge_indices):
        pose_index = first_pose_index + int(missing_edge_indices[0])
        raise TrajectoryError(
            f"The closures cannot be tested: no odometry edge connects vertices "
            f"{graph.ids[pose_index]} and {graph.ids[pose_index + 1]}",
            "Add an odometry edge between these vertices.",
        )
    poses = lie.accumulate_poses(model.get_odometry_steps(graph, connecting_edges))
    # Covariances of successive odometry steps can be added after conversion to the axes of the
    # first pose
    odometry_step_covariances = _propagate_covariances(
        lie.adjoint(poses[1:]), _compute_covariances(graph, connecting_edges)
    )
    cumulative_covariance = np.insert(np.cumsum(odometry_step_covariances, axis=0), 0, 0.0, axis=0)
    # The covariance of the motion between both poses of a closure is the difference of two sums
    nodes -= first_pose_index
    odometry_chain_covariance = (
        cumulative_covariance[nodes.max(axis=0)] - cumulative_covariance[nodes.min(axis=0)]
    )
    # Convert the covariance of the odometry chain to the axes of the second pose, then to the
    # closure residual (odometry relative to the measured relative pose)
    first_poses, second_poses = poses[nodes]
    covariance = _propagate_covariances(
        lie.adjoint(lie.inverse(second_poses)), odometry_chain_covariance
    )
    relative_poses = lie.relative_pose(first_poses, second_poses)
    residuals = lie.log(lie.relative_pose(graph.measurements[tested_edge_indices], relative_poses))
    covariance = _propagate_covariances(lie.right_jacobian_inverse(residuals), covariance)
    return [
        _test_edge(graph, *edge_test)
        for edge_test in zip(tested_edge_indices.tolist(), residuals, covariance, strict=True)
    ]


def _propagate_covariances(matrices: Array, covariances: Array) -> Array:
    """Return A P Aᵀ for each matrix A and covariance P, shape (n, d, d)."""
    return matrices @ covariances @ matrices.transpose(0, 2, 1)


def _test_edge(
    graph: model.PoseGraph, edge_index: int, residual: Array, covariance: Array
) -> GateResult:
    """Test a loop closure against the odometry with the χ² test."""
    vertices = (
        int(graph.ids[graph.first_nodes[edge_index]]),
        int(graph.ids[graph.second_nodes[edge_index]]),
    )
    # A closure may measure only some directions of the relative pose, for example no rotation.
    # Project the residual and its odometry covariance on these directions
    directions, closure_variance = model.compute_observed_directions(graph.information[edge_index])
    degrees_of_freedom = len(closure_variance)
    projected_residual = directions.T @ residual
    residual_covariance = directions.T @ covariance @ directions + np.diag(closure_variance)
    is_testable = degrees_of_freedom > 0 and np.isfinite(residual_covariance).all()
    if is_testable:
        # The covariance must not be singular within rounding errors
        _, scaled_covariance = model.scale_to_unit_diagonal(residual_covariance)
        min_eigenvalue = np.linalg.eigvalsh(scaled_covariance)[0]
        is_testable = min_eigenvalue > _MIN_COVARIANCE_EIGENVALUE
    if not is_testable:
        raise TrajectoryError(
            f"The closure from vertex {vertices[0]} to {vertices[1]} cannot be tested: its "
            "information matrix is zero, or differs by many orders of magnitude from the odometry",
            "Give information matrices of similar magnitude.",
        )
    d2 = float(projected_residual @ np.linalg.solve(residual_covariance, projected_residual))
    p_value = float(chdtrc(degrees_of_freedom, d2))
    return GateResult(*vertices, d2, degrees_of_freedom, p_value, p_value >= GATE_ALPHA)


def _compute_covariances(graph: model.PoseGraph, odometry_edges: IntArray) -> Array:
    """Compute the covariance of each odometry edge, in the axes of the later pose."""
    scale, scaled_information = model.scale_to_unit_diagonal(graph.information[odometry_edges])
    is_full_rank = np.linalg.eigvalsh(scaled_information)[:, 0] > 1e-12
    if not np.all(is_full_rank):
        edge_index = odometry_edges[int(np.argmin(is_full_rank))]
        raise TrajectoryError(
            "The information matrix of the odometry edge from vertex "
            f"{graph.ids[graph.first_nodes[edge_index]]} to "
            f"{graph.ids[graph.second_nodes[edge_index]]} is singular",
            "Give each edge an information matrix of full rank.",
        )
    covariance = np.linalg.inv(scaled_information) / (scale[:, :, None] * scale[:, None, :])
    is_backward = graph.first_nodes[odometry_edges] > graph.second_nodes[odometry_edges]
    # Inverse of a measurement Z with residual r: (Z exp(r))^-1 = Z^-1 exp(-Ad(Z) r)
    adjoint_of_measurement = lie.adjoint(graph.measurements[odometry_edges[is_backward]])
    covariance[is_backward] = _propagate_covariances(
        adjoint_of_measurement, covariance[is_backward]
    )
    return covariance
