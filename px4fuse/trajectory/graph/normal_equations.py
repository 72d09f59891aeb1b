"""Normal equations of a pose graph, solved by multifrontal Cholesky factorisation.

Source: Liu 1992, The multifrontal method for sparse matrix solution, sections 3 to 5.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array, ArrayPair, IntArray

# Maximum number of unknowns of a leaf group; larger groups store more zeros
_MAX_LEAF_UNKNOWNS = 96
# Large information that fixes the first pose; its square must not overflow
_FIXED_POSE_INFORMATION = 1e100


class _EliminationGroup(NamedTuple):
    """Supernode: poses that are eliminated together, with one dense matrix."""

    unknown_count: int
    # Position of the matrix of this group in the flat array of all matrices
    matrix_slice: slice
    # Indices of the unknowns of this group, and of the later unknowns in its equations
    solution_slice: slice
    later_unknowns: IntArray
    # Index of the parent group in the elimination tree
    parent_index: int
    # Columns of the parent's matrix to which the Schur complement is added
    columns_in_parent: IntArray


class NormalEquations:
    """Normal equations of the least-squares problem ``A x_i + B x_j = c``, with x_0 = 0.

    Each edge (i, j) of the pose graph gives one equation.

    Parameters
    ----------
    edges : ndarray of int, shape (2, m)
        Pose indices i and j. The edges must connect all poses.
    unknowns_per_pose : int
    right_hand_side_count : int
        Number of columns of c.
    """

    def __init__(
        self, edges: IntArray, unknowns_per_pose: int, right_hand_side_count: int = 1
    ) -> None:
        position, group_starts, later_poses_by_group = _find_elimination_order(
            edges, _MAX_LEAF_UNKNOWNS // unknowns_per_pose
        )
        poses, offsets_in_pose = np.arange(len(position)), np.arange(unknowns_per_pose)
        pose_counts = np.diff(group_starts)
        group_by_pose = np.repeat(np.arange(len(later_poses_by_group)), pose_counts)
        later_pose_counts = np.array([len(later_poses) for later_poses in later_poses_by_group])
        later_pose_starts = np.append(0, np.cumsum(later_pose_counts))
        later_poses_of_all_groups = np.concatenate(later_poses_by_group)
        keys_of_group_and_later_pose = (
            np.repeat(np.arange(len(later_poses_by_group)), later_pose_counts) * len(poses)
            + later_poses_of_all_groups
        )
        row_counts = pose_counts * unknowns_per_pose
        column_counts = row_counts + later_pose_counts * unknowns_per_pose + right_hand_side_count
        matrix_starts = np.append(0, np.cumsum(row_counts * column_counts))

        def find_columns(group: IntArray, pose: IntArray) -> IntArray:
            """Return the matrix columns of each pose in the matrix of ``group``."""
            index = (
                np.searchsorted(keys_of_group_and_later_pose, group * len(poses) + pose)
                - later_pose_starts[group]
            )
            column = pose - group_starts[group]
            is_in_later_group = column >= pose_counts[group]
            column = np.where(is_in_later_group, pose_counts[group] + index, column)
            return np.asarray(column[:, None] * unknowns_per_pose + offsets_in_pose)

        def find_element_indices(pose: IntArray, columns: IntArray) -> IntArray:
            """Return flat indices of the matrix elements of each pose in the given columns."""
            group = group_by_pose[pose]
            column_start = matrix_starts[group][:, None] + columns * row_counts[group][:, None]
            rows = (pose - group_starts[group])[:, None] * unknowns_per_pose + offsets_in_pose
            return np.asarray(column_start[:, :, None] + rows[:, None])

        edge_positions = np.sort(position[edges], axis=0)
        pose_block_indices = find_element_indices(poses, find_columns(group_by_pose, poses))
        edge_block_indices = find_element_indices(
            edge_positions[0], find_columns(group_by_pose[edge_positions[0]], edge_positions[1])
        )
        right_hand_side_columns = np.arange(-right_hand_side_count, 0) + column_counts[:, None]
        right_hand_side_indices = find_element_indices(
            poses, right_hand_side_columns[group_by_pose]
        )
        self._indices = np.concatenate(
            [
                element_indices.ravel()
                for element_indices in (
                    pose_block_indices[edge_positions],
                    edge_block_indices,
                    right_hand_side_indices[edge_positions],
                )
            ]
        )
        self._is_swapped = (position[edges[0]] > position[edges[1]])[:, None, None]
        self._position = position
        self._diagonal = np.diagonal(pose_block_indices, axis1=1, axis2=2)
        self._right_hand_side_indices = right_hand_side_indices[position].swapaxes(1, 2)
        parent_by_group = group_by_pose[
            [later_poses[0] if len(later_poses) else -1 for later_poses in later_poses_by_group]
        ]
        parent_columns_of_later_poses = find_columns(
            np.repeat(parent_by_group, later_pose_counts), later_poses_of_all_groups
        )
        self._groups = [
            _EliminationGroup(
                int(row_counts[group]),
                slice(*matrix_starts[group : group + 2]),
                slice(*group_starts[group : group + 2] * unknowns_per_pose),
                (later_poses[:, None] * unknowns_per_pose + offsets_in_pose).ravel(),
                int(parent_by_group[group]),
                np.append(
                    parent_columns_of_later_poses[slice(*later_pose_starts[group : group + 2])],
                    right_hand_side_columns[parent_by_group[group]],
                ),
            )
            for group, later_poses in enumerate(later_poses_by_group)
        ]

    def assemble(
        self,
        first_pose_matrix: Array,
        second_pose_matrix: Array,
        information: Array,
        right_hand_side: Array,
    ) -> ArrayPair:
        """Assemble the normal equations of ``A x_i + B x_j = c`` over all edges (i, j).

        Return the matrix elements (a flat array), and the right-hand sides, shape (n, d, k).

        Parameters
        ----------
        first_pose_matrix, second_pose_matrix, information, right_hand_side : ndarray
            A, B and weight, shape (m, d, d), and c, shape (m, d, k), of each of the m edges.
        """
        pose_matrices = np.where(
            self._is_swapped,
            (second_pose_matrix, first_pose_matrix),
            (first_pose_matrix, second_pose_matrix),
        )
        weighted_matrices = pose_matrices.swapaxes(2, 3) @ information
        weighted_right_hand_sides = (weighted_matrices @ right_hand_side).swapaxes(2, 3)
        blocks_by_edge = (
            weighted_matrices @ pose_matrices,
            weighted_matrices[1] @ pose_matrices[0],
            weighted_right_hand_sides,
        )
        edge_terms = np.concatenate([product.ravel() for product in blocks_by_edge])
        matrix_values = np.asarray(np.bincount(self._indices, edge_terms), dtype=float)
        right_hand_sides = matrix_values[self._right_hand_side_indices]
        matrix_values[self._diagonal[self._position[0]]] = _FIXED_POSE_INFORMATION
        return matrix_values, right_hand_sides

    def solve(self, matrix_values: Array, damping: float = 0.0) -> Array | None:
        """Solve the equations, with damping added to the diagonal.

        Return None if the matrix is not positive definite.
        """
        matrix_values = matrix_values.copy()
        matrix_values[self._diagonal] += damping
        right_hand_side_count = self._right_hand_side_indices.shape[2]
        schur_complements: dict[int, Array] = {}
        group_factors = []
        for index, group in enumerate(self._groups):
            group_matrix = matrix_values[group.matrix_slice].reshape(-1, group.unknown_count).T
            cholesky_factor, failed_row = lapack.dpotrf(
                group_matrix[:, : group.unknown_count], overwrite_a=1
            )
            if failed_row:
                return None
            off_diagonal_factor = blas.dtrsm(
                1.0,
                cholesky_factor,
                group_matrix[:, group.unknown_count :],
                trans_a=1,
                overwrite_b=1,
            )
            group_factors.append((group, cholesky_factor, off_diagonal_factor))
            if group is self._groups[-1]:
                break
            complement_size = off_diagonal_factor.shape[1]
            schur_complement = (
                schur_complements.pop(index, np.zeros(complement_size**2))
                .reshape(complement_size, complement_size)
                .T
            )
            schur_complement = blas.dsyrk(
                -1.0, off_diagonal_factor, 1.0, schur_complement, trans=1, overwrite_c=1
            ).T
            # only the lower triangle of the symmetric matrix is computed
            parent = self._groups[group.parent_index]
            columns = group.columns_in_parent
            column_count_in_parent = np.searchsorted(columns, parent.unknown_count)
            parent_values = matrix_values[parent.matrix_slice]
            parent_value_indices = (
                columns[:, None] * parent.unknown_count + columns[:column_count_in_parent]
            )
            parent_values[parent_value_indices] += schur_complement[:, :column_count_in_parent]
            columns = columns[column_count_in_parent:] - parent.unknown_count
            parent_complement_size = len(parent.later_unknowns) + right_hand_side_count
            parent_schur_complement = schur_complements.setdefault(
                group.parent_index, np.zeros(parent_complement_size**2)
            )
            parent_schur_complement[columns[:, None] * parent_complement_size + columns] += (
                schur_complement[column_count_in_parent:, column_count_in_parent:]
            )
        solution = np.empty((self._diagonal.size, right_hand_side_count))
        for group, cholesky_factor, off_diagonal_factor in reversed(group_factors):
            terms_of_solved_unknowns = (
                off_diagonal_factor[:, :-right_hand_side_count] @ solution[group.later_unknowns]
            )
            solution[group.solution_slice] = blas.dtrsm(
                1.0,
                cholesky_factor,
                off_diagonal_factor[:, -right_hand_side_count:] - terms_of_solved_unknowns,
            )
        solution = solution.reshape(self._right_hand_side_indices.shape)[self._position]
        solution[0] = 0.0
        return solution if np.all(np.isfinite(solution)) else None


def _find_elimination_order(
    edges: IntArray, max_poses_per_leaf_group: int
) -> tuple[IntArray, IntArray, list[IntArray]]:
    """Return the order of elimination of n poses in g groups.

    Returns
    -------
    position : ndarray of int, shape (n,)
        Index of each pose in the order of elimination.
    group_starts : ndarray of int, shape (g + 1,)
        Index of the first pose of each group, and n.
    later_poses_by_group : list of ndarray of int
        Later poses in the equations of each group.
    """
    rows = np.tile(np.arange(edges.shape[1]), 2)
    incidence_matrix = sparse.csc_array(
        (np.repeat([1.0, -1.0], edges.shape[1]), (rows, edges.ravel()))
    )
    pose_count = incidence_matrix.shape[1]
    first_pose_anchor_matrix = sparse.csc_array(([1.0], ([0], [0])), shape=(pose_count, pose_count))
    lu_factors = splu(
        (incidence_matrix.T @ incidence_matrix + first_pose_anchor_matrix).tocsc(),
        # This order gives fewer nonzeros than the default COLAMD
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        # Merged columns would store zeros
        relax=1,
        options={"SymmetricMode": True},
    )
    sparsity_pattern = lu_factors.L.sorted_indices()
    nonzero_counts = np.diff(sparsity_pattern.indptr)
    # The parent of a pose in the elimination tree is the row of the first nonzero below the
    # diagonal
    parent = sparsity_pattern.indices[sparsity_pattern.indptr[:-2] + 1]
    last_pose = pose_count - 1
    tree = sparse.csr_array(
        (nonzero_counts[:-1], (last_pose - parent, last_pose - np.arange(last_pose))),
        shape=first_pose_anchor_matrix.shape,
    )
    elimination_order = last_pose - depth_first_order(tree, 0, return_predecessors=False)[::-1]
    position = np.argsort(elimination_order)
    nonzero_counts = nonzero_counts[elimination_order]
    parent = np.append(position[parent[elimination_order[:-1]]], pose_count)
    subtree_size = np.ones(pose_count + 1, dtype=np.intp)
    for pose, pose_parent in enumerate(parent.tolist()):
        subtree_size[pose_parent] += subtree_size[pose]
    is_large_subtree = subtree_size > max_poses_per_leaf_group
    is_large_subtree[pose_count] = True
    leaf_group_ends = np.flatnonzero(~is_large_subtree[:-1] & is_large_subtree[parent])
    is_parent_next = parent[:-1] == np.arange(1, pose_count)
    # Poses are merged if their columns have the same nonzero rows, because no zeros are added then
    is_merged_with_child = is_large_subtree[:-2] & is_parent_next & (np.diff(nonzero_counts) == -1)
    merged_group_starts = np.flatnonzero(
        is_large_subtree[:-1] & ~np.append(False, is_merged_with_child)
    )
    group_starts = np.sort(
        np.concatenate(
            [leaf_group_ends - subtree_size[leaf_group_ends] + 1, merged_group_starts, [pose_count]]
        )
    )
    later_poses_by_group = [
        np.sort(
            position[sparsity_pattern.indices[slice(*sparsity_pattern.indptr[pose : pose + 2])]]
        )[1:]
        for pose in elimination_order[group_starts[1:] - 1]
    ]
    return position[lu_factors.perm_c], group_starts, later_poses_by_group
