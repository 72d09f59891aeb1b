"""Normal equations of a pose graph, solved by multifrontal Cholesky factorisation.

Successive poses in the order of elimination form groups (supernodes). Each group is eliminated
with a dense matrix. Its Schur complement is added to the matrix of its parent, the next group that
depends on it. Source: Liu 1992, The multifrontal method for sparse matrix solution, sections 3
to 5.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array, ArrayPair, IntArray

# Maximum number of unknowns of a group without a child in the elimination tree. Larger groups need
# fewer calls of LAPACK, but more arithmetic with zeros
_MAX_LEAF_UNKNOWNS = 96
# Information that is added to fix the first pose: far above that of all edges, but its square does
# not overflow
_FIXED_POSE_INFORMATION = 1e100


class _EliminationGroup(NamedTuple):
    """Poses that are eliminated together, with their places in the vectors of all groups.

    The equations of a group are a dense matrix in Fortran order with a row for each unknown of the
    group. The columns are the unknowns of the group, the unknowns of later groups that depend on
    them, and the right-hand sides. ``values`` is the slice of this matrix in the flat array of
    :meth:`NormalEquations.assemble`; ``unknown_slice`` and ``dependent_unknowns`` are indices into
    the solution.
    """

    unknown_count: int
    values: slice
    unknown_slice: slice
    dependent_unknowns: IntArray
    parent: int
    # Columns of the parent's matrix to which the Schur complement of this group is added
    parent_columns: IntArray


class NormalEquations:
    """Normal equations of ``A x_i + B x_j = c`` over all edges (i, j), with x_0 = 0.

    Each edge has A and B, shape (d, d), and c, shape (d, k). The order of elimination and all
    indices are computed once, from the edges.

    Parameters
    ----------
    edges : ndarray of int, shape (2, m)
        Indices i and j of the n poses. The edges must connect all poses.
    unknowns_per_pose : int
        Number d of unknowns per pose.
    rhs_count : int
        Number k of right-hand sides (columns of c).
    """

    def __init__(self, edges: IntArray, unknowns_per_pose: int, rhs_count: int = 1) -> None:
        position, group_starts, dependents_by_group = _find_elimination_order(
            edges, _MAX_LEAF_UNKNOWNS // unknowns_per_pose
        )
        poses, unknown_offsets = np.arange(len(position)), np.arange(unknowns_per_pose)
        pose_counts = np.diff(group_starts)
        group_indices = np.repeat(np.arange(len(dependents_by_group)), pose_counts)
        dependent_counts = np.array([len(dependents) for dependents in dependents_by_group])
        dependent_starts = np.append(0, np.cumsum(dependent_counts))
        all_dependents = np.concatenate(dependents_by_group)
        group_and_pose_keys = (
            np.repeat(np.arange(len(dependents_by_group)), dependent_counts) * len(poses)
            + all_dependents
        )
        row_counts = pose_counts * unknowns_per_pose
        column_counts = row_counts + dependent_counts * unknowns_per_pose + rhs_count
        value_starts = np.append(0, np.cumsum(row_counts * column_counts))

        def find_columns(group: IntArray, pose: IntArray) -> IntArray:
            """Return the d column indices of each pose in the matrix of its group, (poses, d)."""
            index = (
                np.searchsorted(group_and_pose_keys, group * len(poses) + pose)
                - dependent_starts[group]
            )
            column = pose - group_starts[group]
            is_later_pose = column >= pose_counts[group]
            column = np.where(is_later_pose, pose_counts[group] + index, column)
            return np.asarray(column[:, None] * unknowns_per_pose + unknown_offsets)

        def find_value_indices(pose: IntArray, columns: IntArray) -> IntArray:
            """Return the flat indices of d matrix rows per pose and column, (poses, columns, d)."""
            group = group_indices[pose]
            column_start = value_starts[group][:, None] + columns * row_counts[group][:, None]
            rows = (pose - group_starts[group])[:, None] * unknowns_per_pose + unknown_offsets
            return np.asarray(column_start[:, :, None] + rows[:, None])

        edge_ends = np.sort(position[edges], axis=0)
        diagonal_indices = find_value_indices(poses, find_columns(group_indices, poses))
        off_diagonal_indices = find_value_indices(
            edge_ends[0], find_columns(group_indices[edge_ends[0]], edge_ends[1])
        )
        rhs_columns = np.arange(-rhs_count, 0) + column_counts[:, None]
        rhs_indices = find_value_indices(poses, rhs_columns[group_indices])
        self._indices = np.concatenate(
            [
                value_indices.ravel()
                for value_indices in (
                    diagonal_indices[edge_ends],
                    off_diagonal_indices,
                    rhs_indices[edge_ends],
                )
            ]
        )
        self._is_swapped = (position[edges[0]] > position[edges[1]])[:, None, None]
        self._position = position
        self._diagonal = np.diagonal(diagonal_indices, axis1=1, axis2=2)
        self._rhs_indices = rhs_indices[position].swapaxes(1, 2)
        parents = group_indices[
            [dependents[0] if len(dependents) else -1 for dependents in dependents_by_group]
        ]
        all_parent_columns = find_columns(np.repeat(parents, dependent_counts), all_dependents)
        self._groups = [
            _EliminationGroup(
                int(row_counts[group]),
                slice(*value_starts[group : group + 2]),
                slice(*group_starts[group : group + 2] * unknowns_per_pose),
                (dependents[:, None] * unknowns_per_pose + unknown_offsets).ravel(),
                int(parents[group]),
                np.append(
                    all_parent_columns[slice(*dependent_starts[group : group + 2])],
                    rhs_columns[parents[group]],
                ),
            )
            for group, dependents in enumerate(dependents_by_group)
        ]

    def assemble(
        self,
        first_pose_coefficient: Array,
        second_pose_coefficient: Array,
        information: Array,
        edge_rhs: Array,
    ) -> ArrayPair:
        """Sum the normal equations over all edges.

        Return the matrices of all elimination groups (one flat array), and the right-hand sides,
        shape (n, d, k).

        Parameters
        ----------
        first_pose_coefficient, second_pose_coefficient, information : ndarray, shape (m, d, d)
            A, B, and the information matrix (weight) of each edge.
        edge_rhs : ndarray, shape (m, d, k)
            Right-hand side c of each edge.
        """
        coefficients = np.where(
            self._is_swapped,
            (second_pose_coefficient, first_pose_coefficient),
            (first_pose_coefficient, second_pose_coefficient),
        )
        weighted_coefficients = coefficients.swapaxes(2, 3) @ information
        rhs_products = (weighted_coefficients @ edge_rhs).swapaxes(2, 3)
        edge_products = (
            weighted_coefficients @ coefficients,
            weighted_coefficients[1] @ coefficients[0],
            rhs_products,
        )
        summed_terms = np.concatenate([product.ravel() for product in edge_products])
        matrix_values = np.asarray(np.bincount(self._indices, summed_terms), dtype=float)
        right_hand_sides = matrix_values[self._rhs_indices]
        matrix_values[self._diagonal[self._position[0]]] = _FIXED_POSE_INFORMATION
        return matrix_values, right_hand_sides

    def solve(self, matrix_values: Array, damping: float = 0.0) -> Array | None:
        """Solve the equations with damping on the diagonal; the result has the shape (n, d, k).

        Return None if the matrix is not positive definite.
        """
        matrix_values = matrix_values.copy()
        matrix_values[self._diagonal] += damping
        rhs_count = self._rhs_indices.shape[2]
        schur_complements: dict[int, Array] = {}
        group_factors = []
        for index, group in enumerate(self._groups):
            group_matrix = matrix_values[group.values].reshape(-1, group.unknown_count).T
            cholesky_factor, failed_row = lapack.dpotrf(
                group_matrix[:, : group.unknown_count], overwrite_a=1
            )
            if failed_row:
                return None
            eliminated_rows = blas.dtrsm(
                1.0,
                cholesky_factor,
                group_matrix[:, group.unknown_count :],
                trans_a=1,
                overwrite_b=1,
            )
            group_factors.append((group, cholesky_factor, eliminated_rows))
            if group is self._groups[-1]:
                break
            column_count = eliminated_rows.shape[1]
            schur_complement = (
                schur_complements.pop(index, np.zeros(column_count**2))
                .reshape(column_count, column_count)
                .T
            )
            schur_complement = blas.dsyrk(
                -1.0, eliminated_rows, 1.0, schur_complement, trans=1, overwrite_c=1
            ).T
            # only the lower triangle (row >= column) of the symmetric matrix is computed
            parent = self._groups[group.parent]
            columns = group.parent_columns
            own_column_count = np.searchsorted(columns, parent.unknown_count)
            parent_values = matrix_values[parent.values]
            parent_value_indices = (
                columns[:, None] * parent.unknown_count + columns[:own_column_count]
            )
            parent_values[parent_value_indices] += schur_complement[:, :own_column_count]
            columns = columns[own_column_count:] - parent.unknown_count
            column_count = len(parent.dependent_unknowns) + rhs_count
            parent_complement = schur_complements.setdefault(
                group.parent, np.zeros(column_count**2)
            )
            parent_complement[columns[:, None] * column_count + columns] += schur_complement[
                own_column_count:, own_column_count:
            ]
        solution = np.empty((self._diagonal.size, rhs_count))
        for group, cholesky_factor, eliminated_rows in reversed(group_factors):
            solved_terms = eliminated_rows[:, :-rhs_count] @ solution[group.dependent_unknowns]
            solution[group.unknown_slice] = blas.dtrsm(
                1.0, cholesky_factor, eliminated_rows[:, -rhs_count:] - solved_terms
            )
        solution = solution.reshape(self._rhs_indices.shape)[self._position]
        solution[0] = 0.0
        return solution if np.all(np.isfinite(solution)) else None


def _find_elimination_order(
    edges: IntArray, max_leaf_poses: int
) -> tuple[IntArray, IntArray, list[IntArray]]:
    """Return the order of elimination of n poses, divided into g groups.

    Returns
    -------
    position : ndarray of int, shape (n,)
        Index of each pose in the order of elimination.
    group_starts : ndarray of int, shape (g + 1,)
        First index of each group in this order, and n.
    dependents_by_group : list of ndarray of int
        Indices, in this order, of the later poses that depend on each group.
    """
    rows = np.tile(np.arange(edges.shape[1]), 2)
    incidence = sparse.csc_array((np.repeat([1.0, -1.0], edges.shape[1]), (rows, edges.ravel())))
    pose_count = incidence.shape[1]
    first_pose_constraint = sparse.csc_array(([1.0], ([0], [0])), shape=(pose_count, pose_count))
    lu_factors = splu(
        (incidence.T @ incidence + first_pose_constraint).tocsc(),
        # order with 1.1 to 1.9 times less fill-in (nonzeros of the factor) than the default COLAMD,
        # on public benchmark graphs
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        # SuperLU does not merge columns, because the merged columns would store zeros
        relax=1,
        options={"SymmetricMode": True},
    )
    pattern = lu_factors.L.sorted_indices()
    dependent_counts = np.diff(pattern.indptr)
    # elimination tree: the parent of a pose is the first later pose with a nonzero in its column
    parent = pattern.indices[pattern.indptr[:-2] + 1]
    last_pose = pose_count - 1
    tree_entries = (dependent_counts[:-1], (last_pose - parent, last_pose - np.arange(last_pose)))
    tree = sparse.csr_array(tree_entries, shape=first_pose_constraint.shape)
    order = last_pose - depth_first_order(tree, 0, return_predecessors=False)[::-1]
    position = np.argsort(order)
    dependent_counts = dependent_counts[order]
    parent = np.append(position[parent[order[:-1]]], pose_count)
    subtree_size = np.ones(pose_count + 1, dtype=np.intp)
    for pose, pose_parent in enumerate(parent.tolist()):
        subtree_size[pose_parent] += subtree_size[pose]
    is_large_subtree = subtree_size > max_leaf_poses
    is_large_subtree[pose_count] = True
    roots = np.flatnonzero(~is_large_subtree[:-1] & is_large_subtree[parent])
    is_child = parent[:-1] == np.arange(1, pose_count)
    # a pose joins the group of its child in the tree if the columns of both have the same nonzero
    # rows, so that the dense matrix of the group contains no additional zeros
    joins_child_group = is_large_subtree[:-2] & is_child & (np.diff(dependent_counts) == -1)
    chain_starts = np.flatnonzero(is_large_subtree[:-1] & ~np.append(False, joins_child_group))
    group_starts = np.sort(
        np.concatenate([roots - subtree_size[roots] + 1, chain_starts, [pose_count]])
    )
    dependents_by_group = [
        np.sort(position[pattern.indices[slice(*pattern.indptr[pose : pose + 2])]])[1:]
        for pose in order[group_starts[1:] - 1]
    ]
    return position[lu_factors.perm_c], group_starts, dependents_by_group
