"""How odometry drifts, and the pose graph that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import SettingsError
from px4fuse.loop.closure import DOWN, heading_change_rad
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Trajectory, cumulative_distance

# The reported variances of an odometry tell its drift only where they grow along the path
GROWTH = 2.0
# Stated variances are floored at this share of the default drift: an edge must have a variance
FLOOR_SHARE = 1e-2
TENTH = 0.1


@dataclass(frozen=True)
class OdometryNoise:
    """Drift of an odometry as random walks over distance and over time.

    Attributes
    ----------
    position_m : float
        Standard deviation of position, each axis, after 100 m by steps of translation alone.
    heading_deg : float
        Standard deviation of heading after 100 m.
    position_m_per_root_s, heading_deg_per_root_s : float
        The same for the time that passes, hovering included (m/√s, °/√s).
    tilt_share : float
        Drift of roll and pitch against that of heading: gravity holds them.

    Notes
    -----
    The defaults are what indoor visual-inertial odometry reaches: about 1 % of the distance
    (Delmerico and Scaramuzza 2018; Intel's data sheet of the T265 states the same).
    """

    position_m: float = 1.0
    heading_deg: float = 3.0
    position_m_per_root_s: float = 0.01
    heading_deg_per_root_s: float = 0.03
    tilt_share: float = 0.1

    def __post_init__(self) -> None:
        for name, value in (
            ("position_drift_m", self.position_m),
            ("heading_drift_deg", self.heading_deg),
        ):
            if not 1e-4 <= value <= 100.0:
                raise SettingsError(f"`{name}` {value:g} is outside 0.0001 to 100.")


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
    stated = "the defaults" if noise == OdometryNoise() else "as set"
    said = [
        f"drift of the odometry: position {noise.position_m:g} m and heading "
        f"{noise.heading_deg:g}° after 100 m (one standard deviation, {stated})"
    ]
    reported = _growth(path.position_variance_m2, nodes)
    if reported is not None:
        translation = np.maximum(reported.mean(axis=1), FLOOR_SHARE * translation)
        said.append("translation as the log's own position variances grow")
    elif path.position_variance_m2 is not None:
        said.append("the log's own position variances do not grow, so they tell no drift")
    turned = _growth(path.rotation_variance_rad2, nodes)
    if turned is not None:
        rotation = np.maximum(turned, FLOOR_SHARE * rotation)
        said.append("rotation as the log's own orientation variances grow")
    return translation, rotation, "; ".join(said)


def _growth(variance: Array | None, nodes: IntArray) -> Array | None:
    """Growth of reported variances from node to node, shape (k - 1, 3); None without any."""
    if variance is None:
        return None
    tenth = max(1, int(TENTH * len(variance)))
    early = float(np.median(variance[:tenth].sum(axis=1)))
    late = float(np.median(variance[-tenth:].sum(axis=1)))
    if not late > GROWTH * early:
        return None
    return np.maximum(np.diff(variance[nodes], axis=0), 0.0)


@dataclass(frozen=True)
class Closure:
    """Two times at which the vehicle was at known places relative to each other.

    Attributes
    ----------
    time_1_s, time_2_s : float
        In the trajectory's own time.
    sigma_m : float
        Standard deviation of the displacement, each axis.
    displacement_m : tuple of float
        From the first place to the second, in the frame of the trajectory; 0 where they are the
        same.
    heading_change_deg : float or None
        From the first to the second, clockwise; None where it is not known.
    sigma_heading_deg : float
    source : str
        Who says so.
    """

    time_1_s: float
    time_2_s: float
    sigma_m: float = 0.10
    displacement_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heading_change_deg: float | None = None
    sigma_heading_deg: float = 2.0
    source: str = "given"

    def __str__(self) -> str:
        if self.source != "given":
            return f"the closure of take-off and {self.source}"
        return f"the closure of {self.time_1_s:.12g} s and {self.time_2_s:.12g} s"


def pose_graph(
    path: Trajectory, nodes: IntArray, closures: tuple[Closure, ...], noise: OdometryNoise
) -> tuple[PoseGraph, str]:
    """Pose graph of a path: an edge from node to node by odometry, and one per closure.

    Parameters
    ----------
    path : Trajectory
        With orientations, in a frame with z down.
    nodes : ndarray of int, shape (k,)
        Must hold the poses nearest to the times of the closures.
    closures : tuple of Closure

    Returns
    -------
    graph : PoseGraph
        Odometry edges first, closures after them in order.
    statement : str
        Where the variances are from.
    """
    if path.rotation is None:
        raise ValueError("a pose graph needs orientations")
    position, rotation = path.position_m[nodes], path.rotation[nodes]
    count = len(nodes)
    translation, turn, statement = odometry_variances(path, nodes, noise)
    first = np.arange(count - 1)
    information = np.zeros((count - 1 + len(closures), 6, 6))
    diagonal = np.column_stack([np.repeat(1.0 / translation[:, None], 3, axis=1), 1.0 / turn])
    information[: count - 1, range(6), range(6)] = diagonal
    measurements = np.empty((len(information), 7))
    measurements[: count - 1, :3] = rotation[:-1].inv().apply(np.diff(position, axis=0))
    measurements[: count - 1, 3:] = (rotation[:-1].inv() * rotation[1:]).as_quat()
    ends = []
    for row, closure in enumerate(closures, start=count - 1):
        i, j = (int(np.argmin(np.abs(path.time_s[nodes] - t)))
                for t in (closure.time_1_s, closure.time_2_s))  # fmt: skip
        ends.append((i, j))
        there = rotation[j]
        information[row, range(3), range(3)] = closure.sigma_m**-2
        if closure.heading_change_deg is not None:
            by_odometry = heading_change_rad(rotation[j] * rotation[i].inv())
            error = float(lie.wrap(np.radians(closure.heading_change_deg) - by_odometry))
            there = Rotation.from_rotvec(error * DOWN) * there
            vertical = there.inv().apply(DOWN)
            information[row, 3:, 3:] = (
                np.outer(vertical, vertical) / np.radians(closure.sigma_heading_deg) ** 2
            )
        measurements[row, :3] = rotation[i].inv().apply(closure.displacement_m)
        measurements[row, 3:] = (rotation[i].inv() * there).as_quat()
    graph = PoseGraph(
        dimension=3,
        ids=np.arange(count),
        poses=np.column_stack([position, rotation.as_quat()]),
        first=np.concatenate([first, [i for i, _ in ends]]).astype(np.intp),
        second=np.concatenate([first + 1, [j for _, j in ends]]).astype(np.intp),
        measurements=measurements,
        information=information,
        initialised="odometry",
    )
    return graph, statement
