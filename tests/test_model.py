"""The filter's formulas element by element, against the matrices that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from px4fuse.filter import model

P = (0.5, -0.2, 0.7)


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.7])
def test_elements_are_those_of_the_matrices(dt: float) -> None:
    f, b = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2.0], [dt]])
    np.testing.assert_allclose(
        model.matrix(model.spread(P, dt)), f @ model.matrix(P) @ f.T, rtol=1e-14
    )
    x = np.array([[1.5], [-2.0]])
    moved = f @ x + b * 3.0
    np.testing.assert_allclose(model.move(1.5, -2.0, 3.0, dt), moved[:, 0], rtol=1e-14)
    # Q = B Bᵀ / dt: the acceleration is constant over the step
    np.testing.assert_allclose(model.matrix(model.noise(dt)), b @ b.T / dt, rtol=1e-14)


def test_arrays_are_many_steps_at_once() -> None:
    dt = np.array([0.01, 0.1, 0.7])
    together = np.array(model.spread(model.noise(dt), dt))
    for at, each in enumerate(dt.tolist()):
        np.testing.assert_array_equal(together[:, at], model.spread(model.noise(each), each))


def test_many_short_steps_add_the_limit() -> None:
    count, total = 10_000, 0.7
    dt = total / count
    covariance = (0.0, 0.0, 0.0)
    for _ in range(count):
        spread, added = model.spread(covariance, dt), model.noise(dt)
        covariance = tuple(a + b for a, b in zip(spread, added, strict=True))
    np.testing.assert_allclose(covariance, model.noise_of_many_steps(total), rtol=1e-7)


def test_the_start_is_the_lessons() -> None:
    np.testing.assert_array_equal(model.matrix(model.INITIAL_COVARIANCE), np.diag([0.5**2, 1.0**2]))
    np.testing.assert_array_equal(model.H, [[1.0, 0.0]])
