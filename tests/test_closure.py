"""Loop closure by distance against closed forms and the code of the lesson."""

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from trajectory_tools import square

from px4fuse.loop import closure
from px4fuse.trajectory.model import Trajectory, cumulative_distance

COORDINATE = st.floats(-50.0, 50.0)


@given(st.lists(st.tuples(COORDINATE, COORDINATE), min_size=3, max_size=30, unique=True))
def test_loop_correction_is_closure_error_times_path_fraction(
    odom: list[tuple[float, float]],
) -> None:
    err = (odom[-1][0] - odom[0][0], odom[-1][1] - odom[0][1])
    seg = [math.dist(a, b) for a, b in itertools.pairwise(odom)]
    cum = [0.0]
    for s in seg:
        cum.append(cum[-1] + s)
    expected = [
        (x - s / cum[-1] * err[0], y - s / cum[-1] * err[1])
        for (x, y), s in zip(odom, cum, strict=True)
    ]
    found = closure.distribute_by_distance(np.array(odom), np.array(err), np.array(cum))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def trajectory(position: np.ndarray, rotation: Rotation | None) -> Trajectory:
    time = np.arange(len(position)) * 0.1
    return Trajectory("flight", "vio", time, position, rotation, "FRD")


def test_loop_correction_removes_linear_heading_drift() -> None:
    position, rotation = square(100, 20.0)
    distance = cumulative_distance(position)
    share = distance / distance[-1]
    drift = math.radians(8.0)
    between = (share[1:] + share[:-1]) / 2.0
    turns = Rotation.from_rotvec(np.outer(between * drift, [0, 0, 1]))
    steps = turns.apply(np.diff(position, axis=0))
    drifted = position[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    turned = Rotation.from_rotvec(np.outer(share * drift, [0, 0, 1])) * rotation
    misclosure = drifted[-1] - position[-1]
    assert np.linalg.norm(misclosure) > 1.0
    found = closure.remove_closure_error_by_distance(
        trajectory(drifted, turned), distance, misclosure, drift
    )
    np.testing.assert_allclose(found.position_m, position, atol=1e-9)
    assert np.max((found.rotation * rotation.inv()).magnitude()) < 1e-9
    # distributing only the position leaves the shape sheared
    sheared = closure.distribute_by_distance(drifted, misclosure, distance)
    assert np.max(np.linalg.norm(sheared - position, axis=1)) > 0.3


def test_key_frame_path_length_excludes_position_noise() -> None:
    position, _ = square(600, 20.0)  # 80 m, 3.3 cm a step
    noisy = position + np.random.default_rng(1).normal(0.0, 0.02, position.shape)
    frames = closure.choose_key_frames(noisy, closure.compute_default_key_frame_spacing_m(noisy))
    assert cumulative_distance(noisy)[-1] > 95.0
    assert abs(cumulative_distance(noisy[frames])[-1] - 80.0) < 0.8
    assert frames[0] == 0
    assert frames[-1] == len(noisy) - 1


@given(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_heading_change_equals_rotation_about_vertical(yaw: float, x: float, y: float) -> None:
    tilt = Rotation.from_rotvec([x, y, 0.0])
    turn = Rotation.from_rotvec([0.0, 0.0, yaw])
    assert abs(closure.compute_heading_change_rad(turn * tilt) - yaw) < 1e-9


def test_camera_frame_positions_are_converted_to_frd() -> None:
    # one metre ahead, two to the right, three up of the first camera, looking right
    position = np.array([[0.0, 0.0, 0.0], [2.0, -3.0, 1.0], [2.0, -3.0, 1.5]])
    looking_right = Rotation.from_rotvec([0.0, np.pi / 2, 0.0])  # about the camera's y, down
    rotation = Rotation.concatenate([Rotation.identity(), looking_right, looking_right])
    camera = Trajectory("c", "slam", np.arange(3.0), position, rotation, "camera")
    found = closure.to_z_down(camera)
    assert found.frame == "FRD"
    np.testing.assert_allclose(found.position_m[1], [1.0, 2.0, -3.0])
    nose = found.rotation[1].apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(nose, [0.0, 1.0, 0.0], atol=1e-12)


def test_loop_trajectory_in_enu_is_converted_to_ned() -> None:
    position = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [1.0, 2.0, 4.0]])
    given = Trajectory("m", "truth", np.arange(3.0), position, None, "ENU")
    found = closure.to_z_down(given)
    np.testing.assert_allclose(found.position_m[1], [2.0, 1.0, -3.0])
    assert found.frame == "NED"
    np.testing.assert_allclose(closure.from_z_down(found, "ENU").position_m, position)
