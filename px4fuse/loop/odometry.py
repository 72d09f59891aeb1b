"""How odometry drifts, and the pose graph that follows from it."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import DOWN, heading_change_rad
from px4fuse.loop.model import KnownEnd, OdometryNoise
from px4fuse.request import GivenClosure
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Trajectory, cumulative_distance

# The reported variances of an odometry tell its drift only where they grow along the path
MIN_VARIANCE_GROWTH = 2.0
# Stated variances are floored at this share of the default drift: an edge must have a variance
FLOOR_SHARE = 1e-2
END_SHARE = 0.1
# A closure that was given, or that of the landing and where that was
ClosureClaim = tuple[GivenClosure, KnownEnd | None]


def odometry_variances(
    path: Trajectory, nodes: IntArray, noise: OdometryNoise
) -> tuple[Array, Array, str]:
    """Variances of the steps between nodes of a path.

    Parameters
    ----------
    nodes : ndarray of int, shape (k,)
        Poses that become nodes of the graph.
    noise : OdometryNoise
        Taken where the trajectory does not report variances that grow.

    Returns
    -------
    translation : ndarray, shape (k - 1,)
        m², each axis.
    rotation : ndarray, shape (k - 1, 3)
        rad², about the body's axes.
    statement : str
        Where they are from.
    """
    length = np.diff(cumulative_distance(path.position_m[nodes]))
    duration = np.diff(path.time_s[nodes])
    translation = noise.position_m**2 / 100.0 * length + noise.position_m_per_root_s**2 * duration
    heading = np.radians(noise.heading_deg) ** 2 / 100.0 * length
    heading = heading + np.radians(noise.heading_deg_per_root_s) ** 2 * duration
    tilt = noise.tilt_share**2 * heading
    rotation = np.column_stack([tilt, tilt, heading])
    noise_origin = "the defaults" if noise == OdometryNoise() else "as set"
    format_noise = f"position {noise.position_m:g} m and heading {noise.heading_deg:g}° after 100 m"
    statements = [f"drift of the odometry: {format_noise} (one standard deviation, {noise_origin})"]
    reported = _variance_growth(path.position_variance_m2, nodes)
    if reported is not None:
        translation = np.maximum(reported.mean(axis=1), FLOOR_SHARE * translation)
        statements.append("translation as the log's own position variances grow")
    elif path.position_variance_m2 is not None:
        statements.append("the log's own position variances do not grow, so they tell no drift")
    rotation_growth = _variance_growth(path.rotation_variance_rad2, nodes)
    if rotation_growth is not None:
        rotation = np.maximum(rotation_growth, FLOOR_SHARE * rotation)
        statements.append("rotation as the log's own orientation variances grow")
    return translation, rotation, "; ".join(statements)


def _variance_growth(variance: Array | None, nodes: IntArray) -> Array | None:
    """Growth of reported variances from node to node, shape (k - 1, 3); None without any."""
    if variance is None:
        return None
    tenth = max(1, int(END_SHARE * len(variance)))
    early = float(np.median(variance[:tenth].sum(axis=1)))
    late = float(np.median(variance[-tenth:].sum(axis=1)))
    if not late > MIN_VARIANCE_GROWTH * early:
        return None
    return np.maximum(np.diff(variance[nodes], axis=0), 0.0)


def pose_graph(
    path: Trajectory, frames: IntArray, claims: Sequence[ClosureClaim], noise: OdometryNoise
) -> tuple[PoseGraph | Unavailable, IntArray, str]:
    """Pose graph of a path: an edge from node to node by odometry, and one per closure.

    Parameters
    ----------
    path : Trajectory
        In a frame with z down; there is no graph of one without orientations.
    frames : ndarray of int, shape (f,)
        Key frames, as indices of poses.
    claims : sequence of closure and, where it is that of the landing, where that was

    Returns
    -------
    graph : PoseGraph or Unavailable
        Odometry edges first, closures after them in order.
    nodes : ndarray of int, shape (k,)
        Poses that are its nodes: the key frames, and those nearest to the times of the closures.
    statement : str
        Where the variances are from.
    """
    if path.rotation is None:
        what = "the trajectory has no orientations"
        return Unavailable("pose graph", what, "Give one that has."), frames, ""
    times = np.array([(closure.time_1_s, closure.time_2_s) for closure, _ in claims]).reshape(-1, 2)
    at = np.abs(path.time_s - times[..., None]).argmin(axis=-1)
    nodes = np.union1d(frames, at).astype(np.intp)
    ends = np.searchsorted(nodes, at)
    position, rotation = path.position_m[nodes], path.rotation[nodes]
    translation, turn, statement = odometry_variances(path, nodes, noise)
    steps = np.arange(len(nodes) - 1)
    first, second = np.append(steps, ends[:, 0]), np.append(steps + 1, ends[:, 1])
    information = np.zeros((len(first), 6, 6))
    diagonal = np.column_stack([np.repeat(1.0 / translation[:, None], 3, axis=1), 1.0 / turn])
    information[steps[:, None], range(6), range(6)] = diagonal
    first_inverse, second_rotation = rotation[first].inv(), rotation[second]
    translation_measured = first_inverse.apply(position[second] - position[first])
    for row, (closure, end) in enumerate(claims, start=len(steps)):
        translation_measured[row] = (
            0.0 if end is None else first_inverse[row].apply(end.displacement)
        )
        information[row, range(3), range(3)] = closure.sigma_m**-2
        if end is not None and end.heading_change_deg is not None:
            by_odometry = heading_change_rad(second_rotation[row] * rotation[first[row]].inv())
            error = float(lie.wrap(np.radians(end.heading_change_deg) - by_odometry))
            second_rotation[row] = Rotation.from_rotvec(error * DOWN) * second_rotation[row]
            vertical = second_rotation[row].inv().apply(DOWN)
            sigma = np.radians(end.sigma_heading_deg or 0.0)
            information[row, 3:, 3:] = np.outer(vertical, vertical) / sigma**2
    graph = PoseGraph(
        dimension=3,
        ids=np.arange(len(nodes)),
        poses=np.column_stack([position, rotation.as_quat()]),
        first=first,
        second=second,
        measurements=np.column_stack(
            [translation_measured, (first_inverse * second_rotation).as_quat()]
        ),
        information=information,
        initialised="odometry",
    )
    return graph, nodes, statement
