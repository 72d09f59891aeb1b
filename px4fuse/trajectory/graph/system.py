"""Sparse normal equations of linear least squares over the poses of a graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array
from px4fuse.trajectory.graph.model import PoseGraph

# Option relax of SuperLU: 1 gives the least fill-in. With a value above the default of 10, SuperLU
# writes outside its workspace (scipy 1.17, shown by valgrind)
_SUPERLU_RELAX = 1
# Option panel_size of SuperLU. With a value above the default of 20, SuperLU also writes outside
# its workspace
_SUPERLU_PANEL_SIZE = 4
if TYPE_CHECKING:  # scipy before 1.16 has no generic arrays
    Matrix = sparse.csc_array[np.float64]


def normal_equations(
    graph: PoseGraph,
    first_coefficient: Array,
    second_coefficient: Array,
    information: Array,
    value: Array,
    first_value: Array | float = 0.0,
) -> tuple[Matrix, Array]:
    """Return the normal equations of ``A x_i + B x_j = value`` over all edges, with x_0 fixed.

    Parameters
    ----------
    graph : PoseGraph
    first_coefficient, second_coefficient, information : ndarray, shape (m, d, d)
        A, B, and the weight matrix of each equation.
    value : ndarray, shape (m, d, k)
    first_value : ndarray, shape (d, k), or 0
        Value of x_0.

    Returns
    -------
    matrix : csc_array, shape ((n - 1) d, (n - 1) d)
    right_side : ndarray, shape ((n - 1) d, k)
    """
    edge_indices = np.arange(len(graph.first) + 1)
    d = value.shape[1]
    edge_nodes = np.column_stack([graph.first, graph.second]).ravel()
    blocks = np.stack([first_coefficient, second_coefficient], axis=1).reshape(-1, d, d)
    rows = sparse.bsr_array(
        (blocks, edge_nodes, 2 * edge_indices), shape=(d * edge_indices[-1], d * len(graph))
    )
    weights = sparse.bsr_array((information, edge_indices[:-1], edge_indices))
    columns = rows.tocsc()
    first_columns = columns[:, :d]
    free_columns = columns[:, d:]
    weighted = free_columns.T @ weights
    right_side = value.reshape(-1, value.shape[-1]) - first_columns @ np.broadcast_to(
        first_value, value.shape[1:]
    )
    return (weighted @ free_columns).tocsc(), weighted @ right_side


def solve_normal_equations(matrix: Matrix, right_side: Array, damping: float = 0.0) -> Array | None:
    """Solve normal equations with damping on the diagonal.

    Return None if the matrix is singular.
    """
    try:
        factors = splu(
            matrix + damping * sparse.eye_array(matrix.shape[0], format="csc"),
            # MMD_AT_PLUS_A has 1.1 to 1.9 times less fill-in than COLAMD on public benchmark graphs
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            relax=_SUPERLU_RELAX,
            panel_size=_SUPERLU_PANEL_SIZE,
            options={"SymmetricMode": True},
        )
    except RuntimeError:  # exactly singular
        return None
    solution: Array = factors.solve(right_side)
    return solution if np.all(np.isfinite(solution)) else None
