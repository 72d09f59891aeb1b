"""Quaternion rotations against closed forms and SciPy."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from px4fuse.trajectory.rotation import (
    cumulative_product,
    from_rotation_vector,
    interpolate,
    multiply,
    skew,
    to_rotation_matrix,
    to_rotation_vector,
)


def test_rotation_vector_of_tiny_rotation_keeps_the_angle() -> None:
    tiny = np.array([1.0, 2e-14, -4e-14, 6e-14])
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(to_rotation_vector(sign * tiny), [4e-14, -8e-14, 12e-14])


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 10, 50])
def test_cumulative_quaternion_product_equals_stepwise_product(count: int) -> None:
    turns = from_rotation_vector(np.random.default_rng(count).normal(0.0, 1.0, (count, 3)))
    product, one = cumulative_product(turns), np.array([1.0, 0.0, 0.0, 0.0])
    for row, turn in zip(product, turns, strict=True):
        one = multiply(one, turn)
        np.testing.assert_allclose(row, one, atol=1e-12)


def test_interpolated_quaternion_at_midpoint_has_half_the_angle() -> None:
    known = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [-1.0, 0.0, 0.0, 0.0]])
    middle = interpolate(np.array([0.5, 1.5]), np.arange(3.0), known)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(np.abs(middle), [[half, 0.0, 0.0, half]] * 2)
    assert np.linalg.norm(middle, axis=1) == pytest.approx(1.0)


def test_quaternion_functions_equal_scipy() -> None:
    rng = np.random.default_rng(1)
    turns = rng.normal(0.0, 0.7, (50, 3))
    q = from_rotation_vector(turns)
    theirs = Rotation.from_rotvec(turns)
    assert to_rotation_matrix(q) == pytest.approx(theirs.as_matrix(), abs=1e-12)
    assert to_rotation_vector(q) == pytest.approx(turns, abs=1e-12)
    assert to_rotation_vector(-q) == pytest.approx(turns, abs=1e-12)
    assert to_rotation_vector(from_rotation_vector(np.zeros((1, 3)))) == pytest.approx(
        np.zeros((1, 3))
    )
    both = multiply(q[:25], q[25:])
    assert to_rotation_matrix(both) == pytest.approx(
        (theirs[:25] * theirs[25:]).as_matrix(), abs=1e-12
    )
    v, u = rng.normal(size=(2, 3))
    assert skew(v) @ u == pytest.approx(np.cross(v, u))
