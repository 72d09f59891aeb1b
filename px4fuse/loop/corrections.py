"""Correction of odometry by loop closures: χ² test, corrected paths, ATE and RPE."""

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.comparison.estimates import Progress
from px4fuse.core.arrays import Array, IntArray, rms
from px4fuse.errors import Px4FuseError
from px4fuse.flight.model import Unavailable
from px4fuse.request import GivenClosure
from px4fuse.trajectory.evaluation import Evaluation, evaluate
from px4fuse.trajectory.graph.covariance import gate_edges
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import ROBUST_SOLUTION_LABEL, Solution, solve
from px4fuse.trajectory.model import Trajectory, cumulative_distance

from .closure import (
    DOWN_DIRECTION,
    compute_heading_change_rad,
    distribute_by_distance,
    remove_closure_error_by_distance,
)
from .model import (
    LANDING_CLOSURE_SOURCE,
    CorrectionName,
    LoopClosure,
    OdometryNoise,
    PathResult,
    TrueFinalPose,
)

# Reported position or orientation variances of odometry are used only if they grow along the path:
# minimum ratio of their median at the end to their median at the start
MIN_VARIANCE_GROWTH_RATIO = 2.0
# The reported variances give the variance of each odometry edge, which is at least this fraction of
# its default variance. This prevents a division by 0
MIN_REPORTED_TO_DEFAULT_VARIANCE_RATIO = 1e-2
# Fraction of the poses at each end of the path from which the median of the reported variances is
# computed
FRACTION_OF_POSES_AT_EACH_END = 0.1


def compute_odometry_variances(
    path: Trajectory, node_indices: IntArray, noise: OdometryNoise
) -> tuple[Array, Array, str]:
    """Compute the variances of odometry between successive nodes of a pose graph.

    Parameters
    ----------
    node_indices : ndarray of int, shape (k,)
        Indices of the poses that are nodes.
    noise : OdometryNoise
        Default drift, used if the reported variances do not grow.

    Returns
    -------
    translation_variance_m2 : ndarray, shape (k - 1,)
        Variance per axis.
    rotation_variance_rad2 : ndarray, shape (k - 1, 3)
        Variances about the body axes.
    variance_note : str
        Source of the variances, for the user.
    """
    step_length_m = np.diff(cumulative_distance(path.position_m[node_indices]))
    step_duration_s = np.diff(path.time_s[node_indices])
    translation_variance_m2 = (
        noise.position_m**2 / 100.0 * step_length_m
        + noise.position_m_per_root_s**2 * step_duration_s
    )
    heading_variance_rad2 = (
        np.radians(noise.heading_deg) ** 2 / 100.0 * step_length_m
        + np.radians(noise.heading_deg_per_root_s) ** 2 * step_duration_s
    )
    tilt_variance_rad2 = noise.tilt_share**2 * heading_variance_rad2
    rotation_variance_rad2 = np.column_stack(
        [tilt_variance_rad2, tilt_variance_rad2, heading_variance_rad2]
    )
    drift_origin_text = "default" if noise == OdometryNoise() else "from options"
    variance_texts = [
        f"the odometry drift after 100 m is {noise.position_m:g} m in position and "
        f"{noise.heading_deg:g}° in heading (1 σ, {drift_origin_text})"
    ]
    used_variance_text = (
        "the {0} variance of an odometry edge is the increase of the logged {0} variance along it"
    )
    position_variance_increments_m2 = _compute_variance_increments(
        path.position_variance_m2, node_indices
    )
    if position_variance_increments_m2 is not None:
        translation_variance_m2 = np.maximum(
            position_variance_increments_m2.mean(axis=1),
            MIN_REPORTED_TO_DEFAULT_VARIANCE_RATIO * translation_variance_m2,
        )
        variance_texts.append(used_variance_text.format("position"))
    elif path.position_variance_m2 is not None:
        variance_texts.append(
            "the logged position variances are not used: they do not increase along the path"
        )
    rotation_variance_increments_rad2 = _compute_variance_increments(
        path.rotation_variance_rad2, node_indices
    )
    if rotation_variance_increments_rad2 is not None:
        rotation_variance_rad2 = np.maximum(
            rotation_variance_increments_rad2,
            MIN_REPORTED_TO_DEFAULT_VARIANCE_RATIO * rotation_variance_rad2,
        )
        variance_texts.append(used_variance_text.format("orientation"))
    return translation_variance_m2, rotation_variance_rad2, "; ".join(variance_texts)


def _compute_variance_increments(variance: Array | None, node_indices: IntArray) -> Array | None:
    """Return the increases of reported variances between nodes, shape (k - 1, 3).

    ``variance`` has shape (n, 3), ``node_indices`` the shape (k,). A decrease counts as 0. Return
    None if the variances are not reported, or do not grow along the path.
    """
    if variance is None:
        return None
    end_sample_count = max(1, int(FRACTION_OF_POSES_AT_EACH_END * len(variance)))
    total_variance_at_start = float(np.median(variance[:end_sample_count].sum(axis=1)))
    total_variance_at_end = float(np.median(variance[-end_sample_count:].sum(axis=1)))
    if not total_variance_at_end > MIN_VARIANCE_GROWTH_RATIO * total_variance_at_start:
        return None
    return np.maximum(np.diff(variance[node_indices], axis=0), 0.0)


def build_pose_graph(
    path: Trajectory,
    key_frame_indices: IntArray,
    closures: Sequence[GivenClosure],
    true_end: TrueFinalPose | Unavailable,
    noise: OdometryNoise,
) -> tuple[PoseGraph | Unavailable, IntArray, str]:
    """Build the pose graph of a path. Its last edges are the loop closures.

    If ``true_end`` is known, the first closure is between take-off and landing.

    Returns
    -------
    graph : PoseGraph or Unavailable
    node_indices : ndarray of int, shape (k,)
        Indices of the poses that are nodes.
    variance_note : str
        Source of the variances of odometry, for the user.
    """
    if path.rotation is None:
        return (
            Unavailable(
                "pose graph",
                "the trajectory has no orientations",
                "Use a trajectory with orientations.",
            ),
            key_frame_indices,
            "",
        )
    # Nodes of the pose graph: key frames, and the poses at both ends of each loop closure
    closure_times_s = np.array(
        [(closure.time_1_s, closure.time_2_s) for closure in closures]
    ).reshape(-1, 2)
    pose_indices = np.abs(path.time_s - closure_times_s[..., None]).argmin(axis=-1)
    node_indices = np.union1d(key_frame_indices, pose_indices).astype(np.intp)
    closure_nodes = np.searchsorted(node_indices, pose_indices)
    node_position_m = path.position_m[node_indices]
    node_rotation = path.rotation[node_indices]
    translation_variance_m2, rotation_variance_rad2, variance_note = compute_odometry_variances(
        path, node_indices, noise
    )
    # Edges of the pose graph: odometry between successive nodes, then loop closures
    step_count = len(node_indices) - 1
    first_nodes = np.append(np.arange(step_count), closure_nodes[:, 0])
    second_nodes = np.append(np.arange(step_count) + 1, closure_nodes[:, 1])
    # Each edge measures the pose of its second node in the axes of its first node
    first_rotation_inverse = node_rotation[first_nodes].inv()
    measured_translation_m = first_rotation_inverse.apply(
        node_position_m[second_nodes] - node_position_m[first_nodes]
    )
    measured_rotation = first_rotation_inverse * node_rotation[second_nodes]
    information_diagonal = np.column_stack(
        [np.repeat(1.0 / translation_variance_m2[:, None], 3, axis=1), 1.0 / rotation_variance_rad2]
    )
    information = np.zeros((len(first_nodes), 6, 6))
    information[:step_count] = np.eye(6) * information_diagonal[:, None]
    # A loop closure states that its two poses have the same position; it gives no information on
    # their orientations
    landing_edge = step_count
    for edge_index, closure in enumerate(closures, start=landing_edge):
        measured_translation_m[edge_index] = 0.0
        information[edge_index, :3, :3] = np.eye(3) * closure.sigma_m**-2
    if not isinstance(true_end, Unavailable):
        measured_translation_m[landing_edge] = first_rotation_inverse[landing_edge].apply(
            true_end.displacement_vector_m
        )
        if true_end.heading_change_deg is not None:
            final_rotation = _set_heading_change(
                node_rotation[first_nodes[landing_edge]],
                node_rotation[second_nodes[landing_edge]],
                true_end.heading_change_deg,
            )
            measured_rotation[landing_edge] = first_rotation_inverse[landing_edge] * final_rotation
            # Only the rotation about the vertical v (in the axes of the final pose) is known, with
            # its σ. The information matrix is v vᵀ / σ²
            vertical_direction = final_rotation.inv().apply(DOWN_DIRECTION)
            heading_sigma_rad = np.radians(true_end.sigma_heading_deg or 0.0)
            information[landing_edge, 3:, 3:] = (
                np.outer(vertical_direction, vertical_direction) / heading_sigma_rad**2
            )
    graph = PoseGraph(
        dimension=3,
        ids=np.arange(len(node_indices)),
        poses=np.column_stack([node_position_m, node_rotation.as_quat()]),
        first_nodes=first_nodes,
        second_nodes=second_nodes,
        measurements=np.column_stack([measured_translation_m, measured_rotation.as_quat()]),
        information=information,
        initial_pose_origin="odometry",
    )
    return graph, node_indices, variance_note


def _set_heading_change(
    initial_rotation: Rotation, final_rotation: Rotation, heading_change_deg: float
) -> Rotation:
    """Rotate the final orientation about the vertical to a given heading change."""
    odometry_heading_change_rad = compute_heading_change_rad(
        final_rotation * initial_rotation.inv()
    )
    correction_rad = np.radians(heading_change_deg) - odometry_heading_change_rad
    return Rotation.from_rotvec(correction_rad * DOWN_DIRECTION) * final_rotation


# Labels of the corrected paths, by their key in results.json
CORRECTION_LABELS: Mapping[CorrectionName, str] = {
    "uncorrected": "uncorrected path",
    "by_distance_plain": "closure error distributed along the path (positions)",
    "by_distance": "closure error distributed along the path (positions, headings)",
    "pose_graph_gated": "pose graph with accepted loop closures",
    "pose_graph_gnc": ROBUST_SOLUTION_LABEL,
}
# Corrected path, and its pose graph solution (None without a pose graph). If there is no corrected
# path: the reason
CorrectionOutcome = tuple[Trajectory, Solution | None] | Unavailable


def distribute_closure_error_by_distance(
    path: Trajectory,
    distance_m: Array,
    closure_error_vector_m: Array | Unavailable,
    heading_error_deg: float | Unavailable,
    closures: tuple[LoopClosure, ...],
) -> dict[CorrectionName, CorrectionOutcome]:
    """Distribute the loop closure error along the path, in proportion to path length.

    Return a path with corrected positions, and a path with corrected positions and headings.
    """
    # The closure between take-off and landing, if any, is the first
    if closures and closures[0].source == LANDING_CLOSURE_SOURCE and not closures[0].accepted:
        closure_error_vector_m = _explain_gate_rejection(
            "distribution of the closure error along the path", closures[0]
        )
    if isinstance(closure_error_vector_m, Unavailable):
        return {"by_distance_plain": closure_error_vector_m, "by_distance": closure_error_vector_m}
    position_m = distribute_by_distance(path.position_m, closure_error_vector_m, distance_m)
    heading_error_rad = (
        0.0 if isinstance(heading_error_deg, Unavailable) else float(np.radians(heading_error_deg))
    )
    corrected_path = remove_closure_error_by_distance(
        path, distance_m, closure_error_vector_m, heading_error_rad
    )
    return {
        "by_distance_plain": (path.replace_positions(position_m), None),
        "by_distance": (corrected_path, None),
    }


def _explain_gate_rejection(correction_name: str, closure: LoopClosure) -> Unavailable:
    """Return the reason why a correction does not exist: the χ² test rejects the loop closure."""
    return Unavailable(
        correction_name,
        f"the χ² gate rejects {closure} (squared Mahalanobis distance {closure.d2:.1f}, "
        f"p {closure.p:.1g})",
        "Measure the landing place (px4fuse loop --landed-at), assume a larger odometry drift "
        "(--drift), or give --open if the path does not return to its start.",
    )


def _gate_closures(
    graph: PoseGraph, closures: Sequence[GivenClosure], true_end: TrueFinalPose | Unavailable
) -> tuple[LoopClosure, ...]:
    """Test the loop closures against odometry with a χ² test.

    If ``true_end`` is known, the first closure is between take-off and landing.
    """
    edge_count = len(graph.first_nodes)
    gate_results = gate_edges(graph, np.arange(edge_count - len(closures), edge_count))
    tested_closures: list[LoopClosure] = []
    for closure, gate_result in zip(closures, gate_results, strict=True):
        error_m = graph.poses[gate_result.second, :3] - graph.poses[gate_result.first, :3]
        source = "given"
        is_first = not tested_closures
        if is_first and not isinstance(true_end, Unavailable):
            error_m = error_m - true_end.displacement_vector_m
            source = LANDING_CLOSURE_SOURCE
        tested_closures.append(
            LoopClosure(
                **structs.asdict(closure),
                source=source,
                distance_m=float(np.linalg.norm(error_m)),
                d2=gate_result.d2,
                degrees_of_freedom=gate_result.degrees_of_freedom,
                p=gate_result.p,
                accepted=gate_result.accepted,
            )
        )
    return tuple(tested_closures)


def solve_pose_graphs(
    path: Trajectory,
    node_indices: IntArray,
    graph: PoseGraph | Unavailable,
    given_closures: Sequence[GivenClosure],
    true_end: TrueFinalPose | Unavailable,
    progress: Progress,
) -> tuple[dict[CorrectionName, CorrectionOutcome], tuple[LoopClosure, ...]]:
    """Test the loop closures, and optimise the pose graph.

    One optimisation uses the accepted closures. The other one is robust and uses all closures.
    Return the corrected paths, and the closures with the results of their tests.
    """
    if not given_closures and not isinstance(graph, Unavailable):
        graph = Unavailable(
            "pose graph",
            "the path has no loop closure",
            "Give a loop closure with --closure.",
        )
    if isinstance(graph, Unavailable):
        return {"pose_graph_gated": graph, "pose_graph_gnc": graph}, ()
    closures = _gate_closures(graph, given_closures, true_end)
    is_closure = np.arange(len(graph.first_nodes)) >= len(graph.first_nodes) - len(closures)
    is_used = ~is_closure
    is_used[is_closure] = [closure.accepted for closure in closures]
    corrections: dict[CorrectionName, CorrectionOutcome] = {}
    if not is_used[is_closure].any():
        corrections["pose_graph_gated"] = _explain_gate_rejection("pose graph", closures[0])
    else:
        progress(f"optimising: {CORRECTION_LABELS['pose_graph_gated']}")
        solution = solve(graph.select_edges(is_used))
        corrected_path = _correct_path(path, node_indices, graph.poses, solution.poses)
        corrections["pose_graph_gated"] = corrected_path, solution
    if len(closures) < 2:
        corrections["pose_graph_gnc"] = Unavailable(
            ROBUST_SOLUTION_LABEL,
            "the path has only one loop closure, which only the χ² gate can test",
            "Give more loop closures with --closure.",
        )
    else:
        progress(f"optimising: {ROBUST_SOLUTION_LABEL}")
        solution = solve(graph, robust=True, is_closure=is_closure)
        corrected_path = _correct_path(path, node_indices, graph.poses, solution.poses)
        corrections["pose_graph_gnc"] = corrected_path, solution
        closures = tuple(
            structs.replace(closure, weight_gnc=weight)
            for closure, weight in zip(closures, solution.weights[is_closure].tolist(), strict=True)
        )
    return corrections, closures


def _correct_path(
    path: Trajectory, node_indices: IntArray, graph_poses: Array, solved_poses: Array
) -> Trajectory:
    """Correct each pose of a path by interpolation of the corrections of the graph nodes.

    ``graph_poses`` are the node poses before, ``solved_poses`` those after optimisation.
    """
    node_corrections = (
        Rotation.from_quat(solved_poses[:, 3:]) * Rotation.from_quat(graph_poses[:, 3:]).inv()
    )
    time_s, node_time_s = path.time_s, path.time_s[node_indices]
    # Number of the node before each pose. The first and the last pose of the path are nodes. The
    # last pose gets the last node but one, so that each pose also has a next node
    previous_nodes = np.searchsorted(node_time_s[1:-1], time_s, side="right")
    node_number = np.interp(time_s, node_time_s, np.arange(len(node_time_s)))
    next_node_weight = node_number - previous_nodes
    position_corrected_by_previous_node_m, position_corrected_by_next_node_m = (
        solved_poses[node, :3]
        + node_corrections[node].apply(path.position_m - graph_poses[node, :3])
        for node in (previous_nodes, previous_nodes + 1)
    )
    position_m = (1.0 - next_node_weight[:, None]) * position_corrected_by_previous_node_m
    position_m += next_node_weight[:, None] * position_corrected_by_next_node_m
    rotation = Slerp(node_time_s, node_corrections)(time_s)
    return path.replace_positions(position_m, rotation)


def score_paths(
    odometry: Trajectory,
    corrected_paths: Mapping[CorrectionName, CorrectionOutcome],
    references: tuple[Trajectory, ...],
) -> dict[CorrectionName, PathResult | Unavailable]:
    """Compute ATE and RPE of the uncorrected path and of all corrected paths."""
    # Time offsets of the references. None: the evaluation chooses the offset. Tracks of the same
    # log have the same clock
    time_offsets_s = {
        reference.name: 0.0 if reference.sha256 == odometry.sha256 else None
        for reference in references
    }
    outcomes: dict[CorrectionName, CorrectionOutcome] = {
        "uncorrected": (odometry, None),
        **corrected_paths,
    }
    scored_paths: dict[CorrectionName, PathResult | Unavailable] = {}
    for name, outcome in outcomes.items():
        if isinstance(outcome, Unavailable):
            scored_paths[name] = outcome
            continue
        path, solution = outcome
        scores = {
            reference.name: _evaluate_path(path, reference, time_offsets_s[reference.name])
            for reference in references
        }
        if path is odometry:
            # Corrected paths have the timestamps of the odometry, so they use its time offsets
            for reference_name, score in scores.items():
                if isinstance(score, Evaluation) and score.time_offset.offset_s is not None:
                    time_offsets_s[reference_name] = score.time_offset.offset_s
        correction_m: Array = np.linalg.norm(path.position_m - odometry.position_m, axis=1)
        result = PathResult(
            name=CORRECTION_LABELS[name],
            trajectory=path,
            correction_max_m=float(correction_m.max()),
            correction_rms_m=rms(correction_m),
            scores=scores,
            solution=solution,
        )
        if solution is not None:
            result = structs.replace(
                result,
                cost_initial=solution.cost_initial,
                cost=solution.cost,
                iterations=solution.iterations,
                converged=solution.converged,
            )
        scored_paths[name] = result
    return scored_paths


def _evaluate_path(
    path: Trajectory, reference: Trajectory, time_offset_s: float | None
) -> Evaluation | Unavailable:
    """Return ATE and RPE of a path; Unavailable if the paths cannot be compared."""
    try:
        return evaluate(path, reference, time_offset_s=time_offset_s)
    except Px4FuseError as error:
        return Unavailable(
            f"ATE and RPE against {reference.name}",
            str(error),
            "Give another reference trajectory with --reference.",
        )
