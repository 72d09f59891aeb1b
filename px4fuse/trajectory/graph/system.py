"""The sparse normal equations of a pose graph: pattern once, numbers many times."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from px4fuse.arrays import Array, IntArray

# scipy's SuperLU writes past its work space where these exceed its own defaults (10 and 20, found
# with valgrind on scipy 1.17); single columns as relaxed supernodes also fill in least
_RELAX, _PANEL = 1, 4


class BlockSystem:
    """Normal equations with a block of d × d for each pose but the first, which is held.

    Parameters
    ----------
    first, second : ndarray of int, shape (m,)
        Poses that each edge joins.
    poses : int
        How many there are.
    """

    def __init__(self, first: IntArray, second: IntArray, poses: int) -> None:
        self._first, self._second, self._poses = first, second, poses
        # blocks H_ii, H_jj, H_ij, H_ji of all edges; the pose that is held has none
        ends = np.concatenate([first, second]), np.concatenate([second, first])
        row, column = np.append([first, second], ends[0]), np.append([first, second], ends[1])
        inside = np.flatnonzero((row > 0) & (column > 0))
        self._source = inside[np.argsort(row[inside], kind="stable")]
        self._columns = column[self._source] - 1
        self._starts = np.searchsorted(row[self._source], np.arange(1, poses + 1))

    def matrix(self, ii: Array, jj: Array, ij: Array) -> sparse.csc_array[np.float64]:
        """Sum the blocks of all edges.

        Parameters
        ----------
        ii, jj, ij : ndarray, shape (m, d, d)
            Second derivatives by first and first pose, second and second, first and second.
        """
        blocks = np.concatenate([ii, jj, ij, ij.transpose(0, 2, 1)])[self._source]
        made = sparse.bsr_array((blocks, self._columns, self._starts)).tocsr()
        made.sum_duplicates()
        return made.T

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
        made = np.zeros((self._poses, *i.shape[1:]))
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
        try:
            factors = splu(
                damped,
                # on the graphs of the benchmark it fills in 1.1 to 1.9 times less than COLAMD
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                relax=_RELAX,
                panel_size=_PANEL,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # exactly singular
            return None
        made = np.zeros(right.shape)
        made[1:] = factors.solve(right[1:].reshape(-1, *right.shape[2:])).reshape(right[1:].shape)
        return made if np.all(np.isfinite(made)) else None
