"""Normal equations of pose graphs, compared with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from px4fuse.trajectory.graph.normal_equations import NormalEquations


def random_equations(poses: int, size: int, sides: int, closures: int) -> tuple:
    """Return edges, coefficients A, B, weights and right sides of a chain with closures."""
    rng = np.random.default_rng(poses + size)
    chain = np.stack([np.arange(poses - 1), np.arange(1, poses)])
    far = np.sort(rng.permuted(np.tile(np.arange(poses), (closures, 1)), axis=1)[:, :2].T, axis=0)
    edges = rng.permuted(np.concatenate([chain, far], axis=1), axis=0)  # both directions
    count = edges.shape[1]
    root = rng.normal(size=(count, size, size)) + 3.0 * np.eye(size)
    signs = np.array([-1.0, 1.0])[:, None, None, None]
    coefficients = signs * np.eye(size) + 0.05 * rng.normal(size=(2, count, size, size))
    return edges, *coefficients, root @ root.swapaxes(1, 2), rng.normal(size=(count, size, sides))


@pytest.mark.parametrize("closures", [0, 5, 300])
@pytest.mark.parametrize(("size", "sides"), [(2, 2), (3, 1), (6, 1)])
@pytest.mark.parametrize("poses", [2, 3, 30, 200])
def test_sparse_solution_equals_solution_with_dense_matrices(
    poses: int, size: int, sides: int, closures: int
) -> None:
    edges, first, second, weights, values = random_equations(poses, size, sides, closures)
    dense = np.zeros((len(values), size, poses, size))
    rows = np.arange(len(values))
    dense[rows, :, edges[0]] += first
    dense[rows, :, edges[1]] += second
    dense = dense.reshape(len(values) * size, -1)[:, size:]
    weighted = (weights @ dense.reshape(len(values), size, -1)).reshape(dense.shape)
    right = weighted.T @ values.reshape(-1, sides)
    for damping in (0.0, 10.0):
        expected = np.linalg.solve(weighted.T @ dense + damping * np.eye(len(right)), right)
        equations = NormalEquations(edges, size)
        assembled, right_sides = equations.assemble(first, second, weights, values)
        solution = equations.solve(assembled, right_sides, damping)
        assert not solution[0].any()
        np.testing.assert_allclose(
            solution[1:].reshape(-1, sides), expected, rtol=1e-7, atol=1e-9 * abs(expected).max()
        )
        np.testing.assert_allclose(right_sides[1:].reshape(-1, sides), right, rtol=1e-9, atol=1e-9)


def test_solution_of_singular_matrix_is_none() -> None:
    edges, first, second, weights, values = random_equations(100, 3, 1, 5)
    weights[:] = 0.0
    equations = NormalEquations(edges, 3)
    assert equations.solve(*equations.assemble(first, second, weights, values)) is None
