"""How well odometry alone knows one pose from another, and whether a closure agrees with it."""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import TrajectoryError
from px4fuse.record import Count, NotNegative, Record, Share
from px4fuse.trajectory.graph import lie, model

# Chance that the gate rejects a closure that is true
GATE_ALPHA = 0.001
# Smallest eigenvalue of a correlation matrix below which rounding is larger than what it says
_SINGULAR = 1e-13


class GateResult(Record, frozen=True):
    """What odometry alone says to a closure.

    Attributes
    ----------
    first, second : int
        Its ends, by the vertex numbers of the file.
    d2 : float
        Squared Mahalanobis distance of the closure from the relative pose by odometry.
    degrees_of_freedom : int
        Directions that the closure observes.
    p : float
        Probability of such a distance, or a larger one, if the closure is true.
    accepted : bool
        Whether p is at least :data:`GATE_ALPHA`.
    """

    first: int
    second: int
    d2: NotNegative
    degrees_of_freedom: Count
    p: Share
    accepted: bool


def gate(graph: model.PoseGraph, edge_indices: Sequence[int] | IntArray) -> list[GateResult]:
    """Test closures against odometry alone, before they have pulled at anything.

    ``d2 = r' (J Sigma J' + Omega^-1)^-1 r`` with r the log of the closure's inverse times the
    relative pose by odometry, J the inverse right Jacobian at r and Sigma the covariance of that
    pose: each step's error is carried to the end by the adjoint (Barfoot 2017, 8.96 and the first
    order of 8.108, with right perturbations). Only directions that the closure's information
    observes take part.

    Parameters
    ----------
    graph : PoseGraph
        Its edges between successive poses are the odometry, except those under test.
    edge_indices : sequence of int
        Edges to test.

    Returns
    -------
    list of GateResult
        In the order of ``edge_indices``.

    Raises
    ------
    TrajectoryError
        If odometry does not lead from one end of a closure to the other, or has a direction without
        information, or a closure tells nothing.
    """
    tested = np.asarray(edge_indices, dtype=np.intp)
    if not len(tested):
        return []
    chain = model.odometry_chain(graph, tested)
    a, b = graph.first[tested], graph.second[tested]
    low, high = int(min(a.min(), b.min())), int(max(a.max(), b.max()))
    chain_edges = chain[low:high]
    gap = np.flatnonzero(chain_edges < 0)
    if len(gap):
        at = low + int(gap[0])
        raise TrajectoryError.of("odometry_gap", one=graph.ids[at], two=graph.ids[at + 1])
    poses = lie.chain(model.odometry_steps(graph, chain_edges))
    step_adjoints = lie.adjoint(poses[1:])
    step_covariances = (
        step_adjoints @ _covariances(graph, chain_edges) @ step_adjoints.transpose(0, 2, 1)
    )  # in the axes of low
    cumulative_covariance = np.concatenate(
        [np.zeros((1, *step_covariances.shape[1:])), np.cumsum(step_covariances, axis=0)]
    )
    chain_covariance = (
        cumulative_covariance[np.maximum(a, b) - low]
        - cumulative_covariance[np.minimum(a, b) - low]
    )
    to_end = lie.adjoint(lie.inverse(poses[b - low]))
    covariance = to_end @ chain_covariance @ to_end.transpose(0, 2, 1)
    relative = lie.between(poses[a - low], poses[b - low])
    residual = lie.log(lie.between(graph.measurements[tested], relative))
    jacobian = lie.right_jacobian_inverse(residual)
    covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    edge_residuals = zip(tested.tolist(), residual, covariance, strict=True)
    return [_test_edge(graph, edge, r, sigma) for edge, r, sigma in edge_residuals]


def _test_edge(graph: model.PoseGraph, edge: int, residual: Array, covariance: Array) -> GateResult:
    ends = int(graph.ids[graph.first[edge]]), int(graph.ids[graph.second[edge]])
    directions, variance = model.information_eigenvectors(graph.information[edge])
    freedom = len(variance)
    observed_residual = directions.T @ residual
    spread = directions.T @ covariance @ directions + np.diag(variance)
    is_testable = freedom and np.isfinite(spread).all()
    if (
        not is_testable
        or np.linalg.eigvalsh(model.scale_to_unit_diagonal(spread)[1])[0] <= _SINGULAR
    ):
        raise TrajectoryError.of("closure_untestable", one=ends[0], two=ends[1])
    d2 = float(observed_residual @ np.linalg.solve(spread, observed_residual))
    p = float(chdtrc(freedom, d2))
    return GateResult(*ends, d2, freedom, p, p >= GATE_ALPHA)


def _covariances(graph: model.PoseGraph, chain_edges: IntArray) -> Array:
    """Covariances of odometry edges in the axes of the later pose."""
    scale, scaled = model.scale_to_unit_diagonal(graph.information[chain_edges])
    is_full_rank = np.linalg.eigvalsh(scaled)[:, 0] > 1e-12
    if not np.all(is_full_rank):
        edge = chain_edges[int(np.argmin(is_full_rank))]
        raise TrajectoryError.of(
            "edge_unbound", one=graph.ids[graph.first[edge]], two=graph.ids[graph.second[edge]]
        )
    covariance = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    is_backward = graph.first[chain_edges] > graph.second[chain_edges]
    # (Z exp(r))^-1 = Z^-1 exp(-Ad(Z) r)
    measured_adjoint = lie.adjoint(graph.measurements[chain_edges[is_backward]])
    covariance[is_backward] = (
        measured_adjoint @ covariance[is_backward] @ measured_adjoint.transpose(0, 2, 1)
    )
    return covariance
