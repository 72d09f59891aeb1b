"""Pose graph optimisation by Levenberg-Marquardt, with robust rejection of false loop closures."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, gammaincinv

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.record import NOT_IN_JSON, Count, NonNegativeFloat, NotInJson, Record
from px4fuse.errors import TrajectoryError
from px4fuse.flight.model import Unavailable

from . import lie, model
from .covariance import GateResult, gate_edges
from .model import PoseGraph, Residuals

# Maximum number of closures for robust optimisation by default: more closures take minutes
MAX_GNC_CLOSURES = 1000
# Label of the solution by graduated non-convexity (GNC)
ROBUST_SOLUTION_LABEL = "pose graph, robust (GNC)"
# Labels of the pose graph solutions, by their key in results.json
SOLUTION_LABELS: Mapping[str, str] = {
    "all": "pose graph with all loop closures",
    "gnc": ROBUST_SOLUTION_LABEL,
}


MAX_ITERATIONS = 100
# Initial damping of Levenberg-Marquardt, as in GTSAM
_INITIAL_DAMPING = 1e-5
# Factor on the damping after a rejected step, as in GTSAM
_DAMPING_CHANGE_FACTOR = 10.0
# Maximum damping of Levenberg-Marquardt, as in GTSAM
_MAX_DAMPING = 1e5
# Minimum ratio of actual to predicted cost decrease of an accepted step, as in GTSAM
_MIN_COST_DECREASE_RATIO = 1e-3
# Relative and absolute tolerance of the cost of a pose graph
_COST_TOLERANCE = 1e-10
# Relative tolerance of the cost in intermediate stages of graduated non-convexity
_GNC_STAGE_TOLERANCE = 1e-6
_MAX_GNC_STAGE_ITERATIONS = 20

# In graduated non-convexity, a loop closure keeps full weight if its χ² is below the quantile at
# this probability
GNC_INLIER_PROBABILITY = 0.99
# In the cost, the χ² of a dropped loop closure is replaced by the quantile of χ² at this
# probability
KEPT_CLOSURE_PROBABILITY = 0.999
# Factor by which the control parameter of graduated non-convexity grows in each stage (Yang 2020,
# section V)
_GNC_CONTROL_FACTOR = 1.4
_MAX_GNC_STAGES = 100
# Maximum number of loop closures that are tested again after graduated non-convexity rejected them
_MAX_TRIALS_TO_RESTORE_CLOSURES = 20
_MAX_REWEIGHTING_ROUNDS = 20
# Too large information matrices of the edges would reject right loop closures. They are divided by
# an estimated factor of at least this value. Smaller factors may be an effect of false loop
# closures alone, so they are ignored
MIN_INFORMATION_SCALE_FACTOR = 2.5
# Minimum number of loop closures for an estimate of the factor by which the information matrices
# are too large
MIN_CLOSURES_FOR_SCALE_FACTOR = 10


class Solution(Record, kw_only=True):
    """Optimised poses of a pose graph, with cost and convergence."""

    # Half of the sum of the squared Mahalanobis distances before the optimisation
    cost_initial: NonNegativeFloat
    # Half of the weighted sum of the squared Mahalanobis distances after the optimisation
    cost: NonNegativeFloat
    # Number of accepted Levenberg-Marquardt steps
    iterations: Count
    # True if the optimisation reached the cost tolerance
    converged: bool
    # Number of edges with a weight below 0.5
    dropped: Count
    # Optimised poses; the first pose is fixed
    poses: NotInJson[Array] = NOT_IN_JSON
    # Weight of each edge, from 0 (ignored) to 1
    weights: NotInJson[Array] = NOT_IN_JSON


@dataclass(frozen=True)
class _Optimum:
    """Result of Levenberg-Marquardt: residuals with the poses, and number of accepted steps."""

    residuals: Residuals
    iterations: int
    converged: bool


def solve(
    graph: PoseGraph, *, robust: bool = False, is_closure: BoolArray | None = None
) -> Solution:
    """Optimise a pose graph by Levenberg-Marquardt, with the first pose fixed.

    Steps and damping are those of GTSAM's LevenbergMarquardtOptimizer.

    Parameters
    ----------
    robust : bool
        True to reject false closures by graduated non-convexity.
    is_closure : ndarray of bool, shape (m,), optional
        Mask of the loop closures. Default: all edges between poses that are not successive.

    Raises
    ------
    TrajectoryError
        The edges do not connect all poses, or the graph contains a number that is not finite.
    """
    model.require_connected(graph, np.ones(len(graph.first_nodes), bool), "the edges")
    can_be_false_closure = ~graph.find_successive_edges() if is_closure is None else is_closure
    start_residuals = model.residuals(graph, graph.poses)
    cost_initial = 0.5 * float(np.sum(start_residuals.chi2))
    if not np.isfinite(cost_initial):
        raise TrajectoryError(
            "The cost of the pose graph is not finite: a pose or measurement is too large",
            "Correct the pose or measurement, or remove its line.",
        )
    weights = np.ones(len(can_be_false_closure))
    optimum = _minimise(graph, start_residuals, weights)
    if robust and np.any(can_be_false_closure):
        optimum, weights = _solve_gnc(graph, start_residuals, optimum, can_be_false_closure)
    return Solution(
        poses=optimum.residuals.poses,
        cost=0.5 * float(np.sum(weights * optimum.residuals.chi2)),
        cost_initial=cost_initial,
        iterations=optimum.iterations,
        converged=optimum.converged,
        dropped=int(np.count_nonzero(weights < 0.5)),
        weights=weights,
    )


def _minimise(
    graph: PoseGraph,
    residuals: Residuals,
    weights: Array,
    relative_cost_tolerance: float = _COST_TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> _Optimum:
    """Minimise the cost by Levenberg-Marquardt, like GTSAM's LevenbergMarquardtOptimizer."""
    damping = _INITIAL_DAMPING
    iterations = 0
    cost = float(np.sum(0.5 * weights * residuals.chi2))
    while iterations < max_iterations and cost > _COST_TOLERANCE:
        # Linearise the residual r of each edge for small changes x_i and x_j of its two poses:
        # r + J x_j - J Ad(X_j^-1 X_i) x_i, with the inverse right Jacobian J. ``gradient``, the
        # right-hand side of the normal equations, is the negative gradient of the cost
        second_pose_jacobian = lie.right_jacobian_inverse(residuals.residual)
        first_pose_jacobian = second_pose_jacobian @ lie.adjoint(
            lie.inverse(residuals.relative_poses)
        )
        matrix_blocks, gradient = graph.normal_equations.assemble(
            -first_pose_jacobian,
            second_pose_jacobian,
            weights[:, None, None] * graph.information,
            -residuals.residual[..., None],
        )
        # Increase the damping until a step decreases the cost (accepted), or hardly changes it
        # (converged). A step is None if the damped matrix is not positive definite
        while True:
            step = graph.normal_equations.solve(matrix_blocks, gradient, damping)
            if step is not None:
                predicted_decrease = 0.5 * float(np.sum(step * (damping * step + gradient)))
                trial_residuals = model.residuals(
                    graph, lie.compose(residuals.poses, lie.exp(step[..., 0]))
                )
                cost_decrease = cost - float(np.sum(0.5 * weights * trial_residuals.chi2))
                is_converged = abs(cost_decrease) < relative_cost_tolerance * cost
                is_accepted = (
                    predicted_decrease > sys.float_info.epsilon * cost
                    and cost_decrease > _MIN_COST_DECREASE_RATIO * predicted_decrease
                )
                if is_accepted or is_converged:
                    break
            if damping >= _MAX_DAMPING:
                return _Optimum(residuals, iterations, False)
            damping *= _DAMPING_CHANGE_FACTOR
        if not is_accepted:  # the cost is at its minimum, so keep the poses before the step
            return _Optimum(residuals, iterations, True)
        residuals = trial_residuals
        cost -= cost_decrease
        iterations += 1
        damping /= _DAMPING_CHANGE_FACTOR
        if is_converged or cost_decrease <= _COST_TOLERANCE:
            return _Optimum(residuals, iterations, True)
    return _Optimum(residuals, iterations, cost <= _COST_TOLERANCE)


def _solve_gnc(
    graph: PoseGraph,
    start_residuals: Residuals,
    unweighted_optimum: _Optimum,
    can_be_false_closure: BoolArray,
) -> tuple[_Optimum, Array]:
    """Reject false closures by graduated non-convexity; return the optimum and the edge weights."""
    # A closure with χ² below chi2_bound keeps its full weight 1. To compare solutions, each dropped
    # closure adds cost_if_dropped to the cost instead of its χ². This is a larger quantile of the
    # χ² distribution, so that only closures with a clearly too large χ² are dropped. Odometry edges
    # are never dropped
    half_degrees_of_freedom = model.count_observed_directions(graph.information) / 2.0
    chi2_bound = np.where(
        can_be_false_closure & (half_degrees_of_freedom > 0.0),
        2.0 * gammaincinv(half_degrees_of_freedom, GNC_INLIER_PROBABILITY),
        np.inf,
    )
    cost_if_dropped = 2.0 * gammaincinv(half_degrees_of_freedom, KEPT_CLOSURE_PROBABILITY)

    def compute_truncated_cost(residuals: Residuals, edge_weights: Array) -> float:
        """Return the cost of the kept edges, plus the fixed cost of each dropped closure."""
        return 0.5 * float(np.sum(np.where(edge_weights > 0.0, residuals.chi2, cost_if_dropped)))

    # The result depends on the start: try the least-squares optimum and the initial poses
    iteration_count = unweighted_optimum.iterations
    solutions = []
    for initial_residuals in (unweighted_optimum.residuals, start_residuals):
        optimum, weights = _run_gnc(graph, initial_residuals, chi2_bound)
        iteration_count += optimum.iterations
        solutions.append((compute_truncated_cost(optimum.residuals, weights), optimum, weights))
    lowest_cost, optimum, weights = min(solutions, key=lambda solution: solution[0])
    # Restore each dropped closure, smallest χ² first, if this decreases the cost
    dropped_edges = np.flatnonzero(weights == 0.0)
    for edge_index in dropped_edges[np.argsort(optimum.residuals.chi2[dropped_edges])][
        :_MAX_TRIALS_TO_RESTORE_CLOSURES
    ]:
        trial_weights = weights.copy()
        trial_weights[edge_index] = 1.0
        optimum_with_closure = _minimise(graph, optimum.residuals, trial_weights)
        iteration_count += optimum_with_closure.iterations
        cost = compute_truncated_cost(optimum_with_closure.residuals, trial_weights)
        if cost < lowest_cost:
            lowest_cost, optimum, weights = cost, optimum_with_closure, trial_weights
    model.require_connected(graph, weights > 0.0, "the edges that remain after robust optimisation")
    return _Optimum(optimum.residuals, iteration_count, optimum.converged), weights


def _run_gnc(
    graph: PoseGraph, start_residuals: Residuals, chi2_bound: Array
) -> tuple[_Optimum, Array]:
    """Run graduated non-convexity from one start (Yang 2020, algorithm 1, eq. 13 and 14)."""
    residuals = start_residuals
    iteration_count = 0
    # Minimise a cost that is nearly convex at first, and truncated at chi2_bound at last. The
    # control parameter increases in each stage, until all weights are 0 or 1. It starts at 1 ÷
    # maximum of 2 χ² / chi2_bound - 1 over all edges (Yang 2020, section V)
    inverse_control_parameter = float(np.max(2.0 * residuals.chi2 / chi2_bound - 1.0))
    if inverse_control_parameter > 0.0:
        control_parameter = 1.0 / inverse_control_parameter
        for _ in range(_MAX_GNC_STAGES):
            # Weights (Yang 2020, eq. 14): 1 for small χ², 0 for large χ², and between them
            # √(μ (μ + 1) bound / χ²) - μ, with the control parameter μ. The lower limit avoids a
            # division by zero
            chi2_ratio = np.maximum(residuals.chi2 / chi2_bound, 1e-200)
            weights = np.clip(
                np.sqrt(control_parameter * (control_parameter + 1.0) / chi2_ratio)
                - control_parameter,
                0.0,
                1.0,
            )
            stage_optimum = _minimise(
                graph, residuals, weights, _GNC_STAGE_TOLERANCE, _MAX_GNC_STAGE_ITERATIONS
            )
            residuals = stage_optimum.residuals
            iteration_count += stage_optimum.iterations
            if np.all((weights < 1e-6) | (weights > 1.0 - 1e-6)):  # all are 0 or 1
                break
            control_parameter *= _GNC_CONTROL_FACTOR
    # 2. Use the edges below the bound with full weight, and repeat until the selection is final
    weights = (residuals.chi2 <= chi2_bound).astype(float)
    for _ in range(_MAX_REWEIGHTING_ROUNDS):
        reweighted_optimum = _minimise(graph, residuals, weights)
        residuals = reweighted_optimum.residuals
        iteration_count += reweighted_optimum.iterations
        # each round decreases the truncated cost, so the loop ends
        new_weights = (residuals.chi2 <= chi2_bound).astype(float)
        if np.array_equal(new_weights, weights):
            break
        weights = new_weights
    return _Optimum(residuals, iteration_count, reweighted_optimum.converged), weights


class Graph(Record, kw_only=True):
    """Results of a pose graph: size, χ² tests of the loop closures, and solutions.

    Attributes
    ----------
    name : str
    dimension, poses, edges : int
    initialised : str
        Origin of the initial poses.
    reduced_chi2 : float
        χ² of the least-squares solution divided by the degrees of freedom.
    reduced_chi2_interval : tuple of float
        Expected 95 % interval of ``reduced_chi2``.
    information_factor : float
        Estimated factor by which the information matrices are too large.
    gates : tuple of GateResult, or Unavailable
        χ² tests of the loop closures.
    solutions : mapping from key of :data:`SOLUTION_LABELS` to Solution
    """

    name: str
    dimension: Count
    poses: Count
    edges: Count
    initialised: str
    reduced_chi2: NonNegativeFloat
    reduced_chi2_interval: tuple[NonNegativeFloat, NonNegativeFloat]
    information_factor: NonNegativeFloat
    gates: tuple[GateResult, ...] | Unavailable
    solutions: Mapping[str, Solution]


def analyse_graph(
    name: str,
    graph: PoseGraph,
    progress: Callable[[str], None] = lambda _: None,
    *,
    use_robust_optimisation: bool | None = None,
) -> tuple[Graph, PoseGraph]:
    """Test the loop closures of a pose graph, and optimise the graph.

    Edges between successive vertices are odometry, all other edges are loop closures. Also return
    the graph with the least-squares poses.

    Raises
    ------
    TrajectoryError
        The graph is not connected.
    """
    closure_edges = np.flatnonzero(~graph.find_successive_edges())
    # Solve with all closures, and test the fit: reduced χ² with its expected 95 % interval
    progress(f"optimising: {SOLUTION_LABELS['all']}")
    solutions = {"all": solve(graph)}
    degrees_of_freedom = int(model.count_observed_directions(graph.information).sum())
    degrees_of_freedom -= (len(graph) - 1) * graph.information.shape[-1]
    reduced_chi2, reduced_chi2_interval = 0.0, (0.0, 0.0)
    if degrees_of_freedom > 0:
        reduced_chi2 = 2.0 * solutions["all"].cost / degrees_of_freedom
        reduced_chi2_interval = tuple(
            (chdtri(degrees_of_freedom, [0.975, 0.025]) / degrees_of_freedom).tolist()
        )
    # Test if each closure agrees with odometry
    scaled_graph, information_factor = graph, 1.0
    closure_tests: tuple[GateResult, ...] | Unavailable
    try:
        closure_tests = tuple(gate_edges(graph, closure_edges))
        # If the information matrices seem too large, divide them by the factor and test again. The
        # factor has two estimates: the reduced χ², and the median ratio of d² of the closures to
        # its expected median. False closures enlarge the reduced χ² only, so the smaller estimate
        # is used
        if (
            reduced_chi2 > reduced_chi2_interval[1]
            and len(closure_tests) >= MIN_CLOSURES_FOR_SCALE_FACTOR
        ):
            factor = min(reduced_chi2, _estimate_information_factor(closure_tests))
            if factor >= MIN_INFORMATION_SCALE_FACTOR:
                information_factor = factor
                scaled_graph = replace(graph, information=graph.information / factor)
                closure_tests = tuple(gate_edges(scaled_graph, closure_edges))
    except TrajectoryError as error:
        closure_tests = Unavailable(
            "gate", str(error), "Give an odometry edge between all successive vertices."
        )
    # Solve again without false closures
    if use_robust_optimisation is None:
        use_robust_optimisation = len(closure_edges) <= MAX_GNC_CLOSURES
    if use_robust_optimisation and len(closure_edges) > 1:
        progress(f"optimising: {ROBUST_SOLUTION_LABEL}")
        solutions["gnc"] = solve(scaled_graph, robust=True)
    results = Graph(
        name=name,
        dimension=graph.dimension,
        poses=len(graph),
        edges=len(graph.first_nodes),
        initialised=graph.initial_pose_origin,
        reduced_chi2=reduced_chi2,
        reduced_chi2_interval=reduced_chi2_interval,
        information_factor=information_factor,
        gates=closure_tests,
        solutions=solutions,
    )
    return results, replace(graph, poses=solutions["all"].poses)


def _estimate_information_factor(closure_tests: tuple[GateResult, ...]) -> float:
    """Estimate the factor by which all information matrices are too large.

    The median over the closures is robust against false closures.
    """
    expected_d2_medians = chdtri([gate.degrees_of_freedom for gate in closure_tests], 0.5)
    return float(np.median(np.divide([gate.d2 for gate in closure_tests], expected_d2_medians)))
