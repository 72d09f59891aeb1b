"""Rotations as quaternions, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from px4fuse.trajectory.rotation import (
    from_vector,
    interpolate,
    multiply,
    running_product,
    to_vector,
)


def test_a_rotation_that_hardly_turns_keeps_its_size() -> None:
    tiny = np.array([1.0, 2e-14, -4e-14, 6e-14])
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(to_vector(sign * tiny), [4e-14, -8e-14, 12e-14])
    vectors = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    np.testing.assert_allclose(to_vector(from_vector(vectors)), vectors, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 10])
def test_a_running_product_is_the_product(count: int) -> None:
    turns = from_vector(np.random.default_rng(count).normal(0.0, 1.0, (count, 3)))
    product, one = running_product(turns), np.array([1.0, 0.0, 0.0, 0.0])
    for row, turn in zip(product, turns, strict=True):
        one = multiply(one, turn)
        np.testing.assert_allclose(row, one, atol=1e-12)


def test_between_two_quaternions_lies_their_middle() -> None:
    known = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [-1.0, 0.0, 0.0, 0.0]])
    middle = interpolate(np.array([0.5, 1.5]), np.arange(3.0), known)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(np.abs(middle), [[half, 0.0, 0.0, half]] * 2)
    assert np.linalg.norm(middle, axis=1) == pytest.approx(1.0)
