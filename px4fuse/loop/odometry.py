"""Odometry drift, and the pose graph of a path with its closures."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import DOWN, heading_change_rad
from px4fuse.loop.model import OdometryNoise, TrueEnd
from px4fuse.request import GivenClosure
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Trajectory, cumulative_distance

# ratio of late to early reported variances above which they are used as drift
MIN_VARIANCE_GROWTH = 2.0
# lower limit of reported variances, as fraction of the default drift: edges need a variance
FLOOR_SHARE = 1e-2
END_SHARE = 0.1  # fraction of the path whose variances count as early, and as late
# closure, and its landing place if it is that of the landing
ClosureClaim = tuple[GivenClosure, TrueEnd | None]


def odometry_variances(
    path: Trajectory, nodes: IntArray, noise: OdometryNoise
) -> tuple[Array, Array, str]:
    """Compute the variances of the steps between nodes of a path.

    Parameters
    ----------
    nodes : ndarray of int, shape (k,)
        Poses that are nodes of the graph.
    noise : OdometryNoise
        Used if the reported variances of the trajectory do not grow.

    Returns
    -------
    translation : ndarray, shape (k - 1,)
        m², each axis.
    rotation : ndarray, shape (k - 1, 3)
        rad², about the body axes.
    statement : str
        Origin of the variances.
    """
    length = np.diff(cumulative_distance(path.position_m[nodes]))
    duration = np.diff(path.time_s[nodes])
    translation = noise.position_m**2 / 100.0 * length + noise.position_m_per_root_s**2 * duration
    heading = np.radians(noise.heading_deg) ** 2 / 100.0 * length
    heading = heading + np.radians(noise.heading_deg_per_root_s) ** 2 * duration
    tilt = noise.tilt_share**2 * heading
    rotation = np.column_stack([tilt, tilt, heading])
    noise_origin = "default" if noise == OdometryNoise() else "as given"
    noise_text = f"position {noise.position_m:g} m and heading {noise.heading_deg:g}° after 100 m"
    statements = [f"odometry drift: {noise_text} (1 σ, {noise_origin})"]
    reported = _variance_growth(path.position_variance_m2, nodes)
    if reported is not None:
        translation = np.maximum(reported.mean(axis=1), FLOOR_SHARE * translation)
        statements.append("translation: growth of the logged position variances")
    elif path.position_variance_m2 is not None:
        statements.append("the logged position variances do not grow and are not used as drift")
    rotation_growth = _variance_growth(path.rotation_variance_rad2, nodes)
    if rotation_growth is not None:
        rotation = np.maximum(rotation_growth, FLOOR_SHARE * rotation)
        statements.append("rotation: growth of the logged orientation variances")
    return translation, rotation, "; ".join(statements)


def _variance_growth(variance: Array | None, nodes: IntArray) -> Array | None:
    """Return the growth of variances between nodes, shape (k - 1, 3); None if small."""
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
    """Build the pose graph of a path: edges between successive nodes, and per closure.

    Parameters
    ----------
    path : Trajectory
        In a frame with z down; with orientations.
    frames : ndarray of int, shape (f,)
        Key frames, as indices of poses.
    claims : sequence of ClosureClaim
        Closures, with the landing place for that of the landing.

    Returns
    -------
    graph : PoseGraph or Unavailable
        Odometry edges first, then closures in order.
    nodes : ndarray of int, shape (k,)
        Poses that are nodes: key frames, and those nearest to the times of closures.
    statement : str
        Origin of the variances.
    """
    if path.rotation is None:
        reason = "the trajectory has no orientations"
        remedy = "Use a trajectory with orientations."
        return Unavailable("pose graph", reason, remedy), frames, ""
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
