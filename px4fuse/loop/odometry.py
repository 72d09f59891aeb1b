"""Variances of odometry drift, and the pose graph of a path with its loop closures."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, IntArray
from px4fuse.flight.model import Unavailable
from px4fuse.loop.closure import DOWN_DIRECTION, heading_change_rad
from px4fuse.loop.model import OdometryNoise, TrueEnd
from px4fuse.request import GivenClosure
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Trajectory, cumulative_distance

# Minimum ratio of final to initial reported position variance for using the reported variances
# instead of the default drift
MIN_VARIANCE_GROWTH = 2.0
# Minimum variance of an odometry edge, as fraction of the default variance: avoids a division by 0
MIN_VARIANCE_FRACTION = 1e-2
# Fraction of the poses at each end of the path over which the reported variance is averaged
END_FRACTION = 0.1
# Loop closure, with the landing place if the closure connects landing and take-off
ClosureAndLanding = tuple[GivenClosure, TrueEnd | None]


def odometry_variances(
    path: Trajectory, nodes: IntArray, noise: OdometryNoise
) -> tuple[Array, Array, str]:
    """Compute the variances of the odometry between successive nodes of the pose graph.

    Parameters
    ----------
    nodes : ndarray of int, shape (k,)
        Indices of the poses that are nodes of the graph.
    noise : OdometryNoise
        Drift that is used if the reported variances of the trajectory do not grow.

    Returns
    -------
    translation_m2 : ndarray, shape (k - 1,)
        Variance per axis.
    rotation_rad2 : ndarray, shape (k - 1, 3)
        Variances about the body axes.
    statement : str
        Sentence on the origin of the variances.
    """
    length_m = np.diff(cumulative_distance(path.position_m[nodes]))
    duration_s = np.diff(path.time_s[nodes])
    translation_m2 = (
        noise.position_m**2 / 100.0 * length_m + noise.position_m_per_root_s**2 * duration_s
    )
    heading_rad2 = np.radians(noise.heading_deg) ** 2 / 100.0 * length_m
    heading_rad2 = heading_rad2 + np.radians(noise.heading_deg_per_root_s) ** 2 * duration_s
    tilt_rad2 = noise.tilt_share**2 * heading_rad2
    rotation_rad2 = np.column_stack([tilt_rad2, tilt_rad2, heading_rad2])
    drift_origin = "default" if noise == OdometryNoise() else "from options"
    origin_texts = [
        f"the odometry drift after 100 m is {noise.position_m:g} m in position and "
        f"{noise.heading_deg:g}° in heading (1 σ, {drift_origin})"
    ]
    position_growth = _variance_growth(path.position_variance_m2, nodes)
    if position_growth is not None:
        translation_m2 = np.maximum(
            position_growth.mean(axis=1), MIN_VARIANCE_FRACTION * translation_m2
        )
        origin_texts.append(
            "the translation variances of the odometry are computed from the increase of the "
            "logged position variances"
        )
    elif path.position_variance_m2 is not None:
        origin_texts.append("the logged position variances do not grow, so they are not used")
    rotation_growth = _variance_growth(path.rotation_variance_rad2, nodes)
    if rotation_growth is not None:
        rotation_rad2 = np.maximum(rotation_growth, MIN_VARIANCE_FRACTION * rotation_rad2)
        origin_texts.append(
            "the rotation variances of the odometry are computed from the increase of the logged "
            "orientation variances"
        )
    return translation_m2, rotation_rad2, "; ".join(origin_texts)


def _variance_growth(variance: Array | None, nodes: IntArray) -> Array | None:
    """Compute the growth of reported variances between graph nodes, shape (k - 1, 3).

    Return None if the variances do not grow by MIN_VARIANCE_GROWTH along the path.
    """
    if variance is None:
        return None
    averaged_count = max(1, int(END_FRACTION * len(variance)))
    start_variance_sum = float(np.median(variance[:averaged_count].sum(axis=1)))
    end_variance_sum = float(np.median(variance[-averaged_count:].sum(axis=1)))
    if not end_variance_sum > MIN_VARIANCE_GROWTH * start_variance_sum:
        return None
    return np.maximum(np.diff(variance[nodes], axis=0), 0.0)


def build_pose_graph(
    path: Trajectory,
    key_frame_indices: IntArray,
    closures_and_landings: Sequence[ClosureAndLanding],
    noise: OdometryNoise,
) -> tuple[PoseGraph | Unavailable, IntArray, str]:
    """Build the pose graph of a path (z down): odometry edges between nodes, then closures.

    ``key_frame_indices`` are the indices of the key frames.

    Returns
    -------
    graph : PoseGraph or Unavailable
    nodes : ndarray of int, shape (k,)
        Indices of the nodes: key frames, and the poses nearest to the times of closures.
    variance_note : str
        Sentence on the origin of the variances.
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
    closure_times_s = np.array(
        [(closure.time_1_s, closure.time_2_s) for closure, _ in closures_and_landings]
    ).reshape(-1, 2)
    pose_indices = np.abs(path.time_s - closure_times_s[..., None]).argmin(axis=-1)
    nodes = np.union1d(key_frame_indices, pose_indices).astype(np.intp)
    end_nodes = np.searchsorted(nodes, pose_indices)
    node_position_m = path.position_m[nodes]
    node_rotation = path.rotation[nodes]
    translation_m2, rotation_rad2, variance_note = odometry_variances(path, nodes, noise)
    steps = np.arange(len(nodes) - 1)
    first_nodes = np.append(steps, end_nodes[:, 0])
    second_nodes = np.append(steps + 1, end_nodes[:, 1])
    information = np.zeros((len(first_nodes), 6, 6))
    diagonal = np.column_stack(
        [np.repeat(1.0 / translation_m2[:, None], 3, axis=1), 1.0 / rotation_rad2]
    )
    information[steps[:, None], range(6), range(6)] = diagonal
    first_inverse = node_rotation[first_nodes].inv()
    second_rotation = node_rotation[second_nodes]
    translation_measured = first_inverse.apply(
        node_position_m[second_nodes] - node_position_m[first_nodes]
    )
    for edge_index, (closure, true_end) in enumerate(closures_and_landings, start=len(steps)):
        translation_measured[edge_index] = (
            0.0 if true_end is None else first_inverse[edge_index].apply(true_end.displacement)
        )
        information[edge_index, range(3), range(3)] = closure.sigma_m**-2
        if true_end is not None and true_end.heading_change_deg is not None:
            odometry_change_rad = heading_change_rad(
                second_rotation[edge_index] * node_rotation[first_nodes[edge_index]].inv()
            )
            error_rad = float(
                lie.wrap(np.radians(true_end.heading_change_deg) - odometry_change_rad)
            )
            second_rotation[edge_index] = (
                Rotation.from_rotvec(error_rad * DOWN_DIRECTION) * second_rotation[edge_index]
            )
            vertical_direction = second_rotation[edge_index].inv().apply(DOWN_DIRECTION)
            heading_sigma_rad = np.radians(true_end.sigma_heading_deg or 0.0)
            information[edge_index, 3:, 3:] = (
                np.outer(vertical_direction, vertical_direction) / heading_sigma_rad**2
            )
    graph = PoseGraph(
        dimension=3,
        ids=np.arange(len(nodes)),
        poses=np.column_stack([node_position_m, node_rotation.as_quat()]),
        first=first_nodes,
        second=second_nodes,
        measurements=np.column_stack(
            [translation_measured, (first_inverse * second_rotation).as_quat()]
        ),
        information=information,
        initialised="odometry",
    )
    return graph, nodes, variance_note
