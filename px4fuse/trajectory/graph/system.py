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
        self._size, self._count = size, poses - 1
        self._slot = np.full(poses, -1, dtype=np.intp)
        self._slot[1:] = _order(first, second, poses)
        a, b = self._slot[first], self._slot[second]
        edges = np.arange(len(a))
        free_a, free_b = a >= 0, b >= 0
        free = free_a & free_b & (a != b)
        # Contributions in the order H_ii, H_jj, H_ij, H_ji of all edges, then empty diagonals
        m = len(a)
        row = np.concatenate([a[free_a], b[free_b], a[free], b[free], np.arange(self._count)])
        column = np.concatenate([a[free_a], b[free_b], b[free], a[free], np.arange(self._count)])
        source = np.concatenate(
            [edges[free_a], m + edges[free_b], 2 * m + edges[free], 3 * m + edges[free]]
        )
        key, block = np.unique(column * self._count + row, return_inverse=True)
        self._gather = sparse.csr_array(
            (np.ones(len(source)), (block[: len(source)], source)), shape=(len(key), 4 * m)
        )
        self._incidence = sparse.csr_array(
            (
                np.ones(free_a.sum() + free_b.sum()),
                (
                    np.concatenate([a[free_a], b[free_b]]),
                    np.concatenate([edges[free_a], m + edges[free_b]]),
                ),
            ),
            shape=(self._count, 2 * m),
        )
        self._place(key)

    def _place(self, key: IntArray) -> None:
        """Where each number of each block stands in the compressed columns."""
        d = self._size
        column, row = np.divmod(key, self._count)
        blocks = np.bincount(column, minlength=self._count)
        start = np.concatenate([[0], np.cumsum(blocks)])
        within = np.arange(len(key)) - start[column]
        p, q = np.arange(d)[None, :, None], np.arange(d)[None, None, :]
        height = (blocks[column] * d)[:, None, None]
        position = (start[column] * d * d + within * d)[:, None, None] + q * height + p
        self._order = np.empty(position.size, dtype=np.intp)
        self._order[position.ravel()] = np.arange(position.size)
        rows = np.broadcast_to(row[:, None, None] * d + p, position.shape).reshape(-1)
        self._rows = rows[self._order].astype(np.int32)
        columns = np.repeat(blocks * d, d)
        self._starts = np.concatenate([[0], np.cumsum(columns)]).astype(np.int32)
        diagonal = np.flatnonzero(column == row)
        here = np.arange(d)
        self._diagonal = position[diagonal][:, here, here].ravel()

    def matrix(self, ii: Array, jj: Array, ij: Array) -> sparse.csc_array[np.float64]:
        """Sum the blocks of all edges.

        Parameters
        ----------
        ii, jj, ij : ndarray, shape (m, d, d)
            Second derivatives by first and first pose, second and second, first and second.
        """
        d = self._size
        blocks = np.concatenate([ii, jj, ij, ij.transpose(0, 2, 1)]).reshape(-1, d * d)
        data = (self._gather @ blocks).ravel()[self._order]
        shape = (self._count * d, self._count * d)
        return sparse.csc_array((data, self._rows, self._starts), shape=shape)

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
        both = np.concatenate([i, j])
        made: Array = self._incidence @ both.reshape(len(both), -1)
        return self._unordered(made.reshape(self._count, *i.shape[1:]))

    def _unordered(self, blocks: Array) -> Array:
        """From the order of elimination to the order of the poses."""
        made = np.zeros((self._count + 1, *blocks.shape[1:]))
        made[1:] = blocks[self._slot[1:]]
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
        data = matrix.data.copy()
        data[self._diagonal] += damping
        damped = sparse.csc_array((data, self._rows, self._starts), shape=matrix.shape)
        ordered = np.empty((self._count, *right.shape[1:]))
        ordered[self._slot[1:]] = right[1:]
        try:
            solved = factorise(damped, "NATURAL").solve(ordered.reshape(-1, *right.shape[2:]))
        except RuntimeError:
            return None
        made = self._unordered(solved.reshape(ordered.shape))
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
    place: IntArray = factorise(dominant, "MMD_AT_PLUS_A").perm_c.astype(np.intp)
    return place
