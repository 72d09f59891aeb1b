"""SE(2) and SE(3) operations against matrix exponentials and finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from px4fuse.trajectory.graph import lie

ANGLES = (0.0, 1e-12, 1e-6, 0.01, 0.2999, 0.3001, 1.0, 2.5, np.pi - 1e-6, np.pi - 1e-12)
SIZES = {2: (3, 3), 3: (6, 7)}  # tangent, pose


def tangents(dimension: int, angle: float, count: int = 20) -> np.ndarray:
    rng = np.random.default_rng(round(1e6 * angle) + dimension)
    made = rng.normal(size=(count, SIZES[dimension][0])) * 3.0
    turn = made[:, dimension:]
    made[:, dimension:] = angle * turn / np.linalg.norm(turn, axis=1)[:, None]
    return made


def generator(tangent: np.ndarray) -> np.ndarray:
    """Return the matrix whose exponential is the homogeneous matrix of the pose."""
    if len(tangent) == 3:
        x, y, theta = tangent
        return np.array([[0.0, -theta, x], [theta, 0.0, y], [0.0, 0.0, 0.0]])
    made = np.zeros((4, 4))
    made[:3, :3], made[:3, 3] = lie.skew(tangent[3:]), tangent[:3]
    return made


def homogeneous(pose: np.ndarray) -> np.ndarray:
    d = 2 if len(pose) == 3 else 3
    made = np.eye(d + 1)
    made[:d, :d], made[:d, d] = lie.rotation_matrix(pose), pose[:d]
    return made


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dimension", [2, 3])
class TestTangents:
    def test_lie_group_exp_equals_matrix_exponential(self, dimension: int, angle: float) -> None:
        for xi in tangents(dimension, angle, 5):
            found = homogeneous(lie.exp(xi))
            np.testing.assert_allclose(found, expm(generator(xi)), atol=1e-13, rtol=0)

    def test_lie_group_log_inverts_exp(self, dimension: int, angle: float) -> None:
        xi = tangents(dimension, angle)
        np.testing.assert_allclose(lie.log(lie.exp(xi)), xi, atol=3e-11, rtol=0)

    def test_inverse_right_jacobian_equals_finite_difference(self, dimension, angle) -> None:
        xi, step = tangents(dimension, min(angle, 3.0)), 1e-5  # log is discontinuous at π
        jacobian, pose = lie.right_jacobian_inverse(xi), lie.exp(xi)
        for k, axis in enumerate(np.eye(SIZES[dimension][0])):
            up, down = (lie.log(lie.compose(pose, lie.exp(s * step * axis))) for s in (1.0, -1.0))
            quotient = (up - down) / (2.0 * step)
            np.testing.assert_allclose(jacobian[:, :, k], quotient, atol=1e-7, rtol=0)

    def test_lie_adjoint_maps_right_to_equal_left_perturbation(
        self, dimension: int, angle: float
    ) -> None:
        x, xi = lie.exp(tangents(dimension, angle)), tangents(dimension, 0.7)
        moved = (lie.adjoint(x) @ xi[..., None])[..., 0]
        left, right = lie.compose(x, lie.exp(xi)), lie.compose(lie.exp(moved), x)
        np.testing.assert_allclose(lie.log(lie.relative_pose(left, right)), 0.0, atol=1e-12)


def test_lie_group_log_of_half_turn_has_angle_pi() -> None:
    for axis in np.eye(3):
        half = np.concatenate([np.zeros(3), axis, [0.0]])
        assert np.linalg.norm(lie.log(half)[3:]) == pytest.approx(np.pi, abs=1e-15)
        assert np.linalg.norm(lie.log(-half)[3:]) == pytest.approx(np.pi, abs=1e-15)
    assert lie.wrap(np.array([np.pi, -np.pi, 3 * np.pi, 0.0])).tolist() == [np.pi] * 3 + [0.0]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 64, 65])
def test_chained_poses_equal_running_matrix_product(dimension: int, count: int) -> None:
    steps = lie.exp(tangents(dimension, 0.4, count))
    made = lie.accumulate_poses(steps)
    expected = np.eye(dimension + 1)
    assert len(made) == count + 1
    np.testing.assert_array_equal(homogeneous(made[0]), expected)
    for step, pose in zip(steps, made[1:], strict=True):
        expected = expected @ homogeneous(step)
        np.testing.assert_allclose(homogeneous(pose), expected, atol=1e-12)


numbers = st.floats(-50.0, 50.0)


@given(st.lists(numbers, min_size=18, max_size=18), st.sampled_from([2, 3]))
def test_pose_composition_and_inverse_satisfy_group_axioms(
    values: list[float], dimension: int
) -> None:
    size = SIZES[dimension][0]
    xi = np.array(values[: 3 * size]).reshape(3, size)
    xi[:, dimension:] /= 50.0
    a, b, c = lie.exp(xi)
    left, right = lie.compose(lie.compose(a, b), c), lie.compose(a, lie.compose(b, c))
    np.testing.assert_allclose(homogeneous(left), homogeneous(right), atol=1e-11)
    none = homogeneous(lie.compose(a, lie.inverse(a)))
    np.testing.assert_allclose(none, np.eye(dimension + 1), atol=1e-11)
    between, composed = lie.relative_pose(a, b), lie.compose(lie.inverse(a), b)
    np.testing.assert_allclose(homogeneous(between), homogeneous(composed), atol=1e-11)
