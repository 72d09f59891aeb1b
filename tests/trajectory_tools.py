"""Trajectories with ground truth, public trajectories, and pose graphs in GTSAM."""

from functools import cache
from typing import Any

import numpy as np
from conftest import shared
from exchange import replace
from scipy.spatial.transform import Rotation

from px4fuse.readers.trajectory import read_trajectory
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Frame, Trajectory, TrajectoryKind

PUBLISHED = [
    ("evo_fr2_desk_ORB.txt", "evo_fr2_desk_groundtruth.txt"),
    ("evo_freiburg1_xyz-ORB_kf_mono.txt", "evo_freiburg1_xyz-groundtruth.txt"),
    ("evo_freiburg1_xyz-rgbdslam.txt", "evo_freiburg1_xyz-groundtruth.txt"),
    ("rpg_vislam_ba_MH_04_estimate0.txt", "rpg_vislam_MH_04_groundtruth.txt"),
    ("rpg_vislam_rp_MH_04_estimate0.txt", "rpg_vislam_MH_04_groundtruth.txt"),
    ("rpg_vislam_rp_MH_04_estimate1.txt", "rpg_vislam_MH_04_groundtruth.txt"),
]
NAMES = [estimate.removesuffix(".txt") for estimate, _ in PUBLISHED]


def flight(
    seconds: float = 60.0,
    rate_hz: float = 20.0,
    kind: TrajectoryKind = "truth",
    frame: Frame = "NED",
) -> Trajectory:
    """Return a smooth flight in three dimensions with varying speed."""
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    position = np.column_stack(
        [
            4.0 * np.sin(0.5 * time) + 1.5 * np.sin(1.3 * time),
            3.0 * np.cos(0.31 * time) + np.sin(0.9 * time + 1.0),
            -2.0 + 0.6 * np.sin(0.7 * time),
        ]
    )
    angles = np.column_stack(
        [0.4 * time + np.sin(0.4 * time), 0.2 * np.sin(1.1 * time), 0.2 * np.cos(0.8 * time)]
    )
    rotation = Rotation.from_euler("ZYX", angles)
    return Trajectory("flight.tum", kind, time, position, rotation, frame)


def transformed(
    one: Trajectory, turn: Rotation, shift: np.ndarray, scale: float = 1.0, **changes: Any
) -> Trajectory:
    """Rotate, scale and shift a trajectory."""
    position = scale * turn.apply(one.position_m) + shift
    return replace(one, position_m=position, rotation=turn * one.rotation, **changes)


def square(per_leg: int, side_m: float, laps: int = 1) -> tuple[np.ndarray, Rotation]:
    """Return positions and rotations around a square; the vehicle yaws in the corners."""
    count = np.arange(4 * laps * per_leg + 1)
    leg = np.minimum(count // per_leg, 4 * laps - 1)
    corners = side_m * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    along = (count / per_leg - leg)[:, None]
    position = (1.0 - along) * corners[leg % 4] + along * corners[(leg + 1) % 4] - [0.0, 0.0, 1.5]
    return position, Rotation.from_rotvec(np.outer(leg * np.pi / 2, [0.0, 0.0, 1.0]))


def noisy_odometry(poses: np.ndarray, sigma: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return poses (n, 7) of odometry with noise per step, sigma (6,) in m, then rad."""
    steps = lie.relative_pose(poses[:-1], poses[1:])
    noise = lie.exp(rng.normal(size=(len(steps), 6)) * sigma)
    return lie.compose(poses[:1], lie.accumulate_poses(lie.compose(steps, noise)))


SHIFT = np.array([100.0, -20.0, 3.0])
TURN = Rotation.from_euler("ZYX", [2.0, 0.4, -0.7])


@cache
def read_public(name: str) -> Trajectory:
    return read_trajectory(shared("trajectories") / name)


# GTSAM has rotation before translation
GTSAM_ORDER = [3, 4, 5, 0, 1, 2]


def gtsam_pose(gtsam: Any, pose: np.ndarray) -> Any:
    if len(pose) == 3:
        return gtsam.Pose2(*pose)
    return gtsam.Pose3(gtsam.Rot3.Quaternion(pose[6], *pose[3:6]), pose[:3])


def gtsam_problem(gtsam: Any, graph: PoseGraph) -> tuple[Any, Any]:
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    order = GTSAM_ORDER if graph.dimension == 3 else [0, 1, 2]
    between = gtsam.BetweenFactorPose2 if graph.dimension == 2 else gtsam.BetweenFactorPose3
    for k, pose in enumerate(graph.poses):
        values.insert(k, gtsam_pose(gtsam, pose))
    for i, j, z, omega in zip(
        graph.first_nodes.tolist(), graph.second_nodes.tolist(), graph.measurements,
        graph.information,
        strict=True,
    ):  # fmt: skip
        noise = gtsam.noiseModel.Gaussian.Information(omega[np.ix_(order, order)])
        factors.add(between(i, j, gtsam_pose(gtsam, z), noise))
    return factors, values


def gtsam_optimiser(gtsam: Any, graph: PoseGraph, iterations: int = 100) -> tuple[Any, Any]:
    """Return GTSAM's factors, and its optimiser with the same start and tolerances."""
    factors, values = gtsam_problem(gtsam, graph)
    kind = "Pose2" if graph.dimension == 2 else "Pose3"
    held = getattr(values, f"at{kind}")(0)
    whole = gtsam.NonlinearFactorGraph(factors)
    whole.add(getattr(gtsam, f"NonlinearEquality{kind}")(0, held))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    parameters.setMaxIterations(iterations)
    return factors, gtsam.LevenbergMarquardtOptimizer(whole, values, parameters)
