"""The sparse normal equations of a pose graph: pattern and order once, numbers many times."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from px4fuse.arrays import Array, IntArray

# scipy's SuperLU writes past its work space where these exceed its own defaults (10 and 20, found
# with valgrind on scipy 1.17); single columns as relaxed supernodes also fill in least
_RELAX, _PANEL = 1, 4

Order = Literal["NATURAL", "MMD_AT_PLUS_A"]


class BlockSystem:
    """Normal equations with a block of d × d for each pose but the first, which is held.

    The fill-reducing order is found on the small matrix with one number per block, by SuperLU's
    minimum degree on A' + A: on the graphs of the benchmark it fills in 1.1 to 1.9 times less than
    its column order (COLAMD) and 2 to 6 times less than reverse Cuthill-McKee.

    Parameters
    ----------
    first, second : ndarray of int, shape (m,)
        Poses that each edge joins.
    poses : int
        How many there are.
    size : int
        d.
    """

    def __init__(self, first: IntArray, second: IntArray, poses: int, size: int) -> None:
        self._first, self._second, self._size = first, second, size
        slot = np.full(poses, -1, dtype=np.intp)
        slot[1:] = self._slot = _order(first, second, poses)
        a, b = slot[first], slot[second]
        # blocks H_ii, H_jj, H_ij, H_ji of all edges, then empty ones on the diagonal
        row, column = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
        source = np.flatnonzero((row >= 0) & (column >= 0))  # the pose that is held has none
        every = np.arange(poses - 1)
        place = np.append(column[source], every) * (poses - 1) + np.append(row[source], every)
        key, block = np.unique(place, return_inverse=True)
        self._gather = sparse.csr_array(
            (np.ones(len(source)), (block[: len(source)], source)), shape=(len(key), len(row))
        )
        columns, self._rows = np.divmod(key, poses - 1)
        self._starts = np.searchsorted(columns, np.arange(poses))

    def matrix(self, ii: Array, jj: Array, ij: Array) -> sparse.csc_array[np.float64]:
        """Sum the blocks of all edges.

        Parameters
        ----------
        ii, jj, ij : ndarray, shape (m, d, d)
            Second derivatives by first and first pose, second and second, first and second.
        """
        d = self._size
        blocks = np.concatenate([ii, jj, ij, ij.transpose(0, 2, 1)]).reshape(-1, d * d)
        summed = (self._gather @ blocks).reshape(-1, d, d).transpose(0, 2, 1)
        # by columns, which are the rows of the transposed matrix
        return sparse.bsr_array((summed, self._rows, self._starts)).tocsr().T

    def vector(self, i: Array, j: Array) -> Array:
        """Sum the gradients of all edges.

        Parameters
        ----------
        i, j : ndarray, shape (m, d, ...)
            By the first pose and by the second.

        Returns
        -------
        ndarray, shape (n, d, ...)
            Zero for the pose that is held.
        """
        made = np.zeros((len(self._slot) + 1, *i.shape[1:]))
        np.add.at(made, self._first, i)
        np.add.at(made, self._second, j)
        made[0] = 0.0
        return made

    def solve(
        self, matrix: sparse.csc_array[np.float64], right: Array, damping: float = 0.0
    ) -> Array | None:
        """Solve with the damped matrix; the first pose stays.

        Parameters
        ----------
        matrix : csc_array
            From :meth:`matrix`.
        right : ndarray, shape (n, d, ...)
            From :meth:`vector`.
        damping : float
            Added to the diagonal.

        Returns
        -------
        ndarray, shape (n, d, ...), or None
            None where the matrix is singular.
        """
        damped = matrix.copy()
        damped.setdiag(matrix.diagonal() + damping)
        ordered = np.empty(right[1:].shape)
        ordered[self._slot] = right[1:]
        try:
            solved = factorise(damped, "NATURAL").solve(ordered.reshape(-1, *right.shape[2:]))
        except RuntimeError:
            return None
        made = np.zeros(right.shape)
        made[1:] = solved.reshape(ordered.shape)[self._slot]
        return made if np.all(np.isfinite(made)) else None


def factorise(matrix: sparse.csc_array[np.float64], order: Order) -> SuperLU:
    """Factors of a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : csc_array
    order : {"NATURAL", "MMD_AT_PLUS_A"}

    Raises
    ------
    RuntimeError
        From SuperLU, if the matrix is exactly singular.
    """
    return splu(
        matrix,
        permc_spec=order,
        diag_pivot_thresh=0.0,
        relax=_RELAX,
        panel_size=_PANEL,
        options={"SymmetricMode": True},
    )


def _order(first: IntArray, second: IntArray, poses: int) -> IntArray:
    """Place of each pose but the first in a fill-reducing order, shape (n - 1,)."""
    count = poses - 1
    inside = (first > 0) & (second > 0)
    i, j = first[inside] - 1, second[inside] - 1
    links = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count)).tocsr()
    links = links + links.T
    # Diagonally dominant, so that elimination is along the diagonal in any order
    degree: Array = np.asarray(links.sum(axis=1)).ravel()
    dominant = sparse.csc_array(sparse.diags_array(degree + 1.0) - links)
    return factorise(dominant, "MMD_AT_PLUS_A").perm_c.astype(np.intp)
