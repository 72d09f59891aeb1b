"""Normal equations of a pose graph, solved by multifrontal Cholesky factorisation.

Source: Liu 1992, The multifrontal method for sparse matrix solution, sections 3 to 5.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array, ArrayPair, IntArray

# The poses of a small subtree of the elimination tree are eliminated together, in one dense matrix.
# Maximum number of unknowns in this matrix: a larger matrix would contain more zeros
_MAX_LEAF_UNKNOWNS = 96
# Diagonal matrix elements of the first pose: so large that they fix the pose, but their squares do
# not overflow
_FIXED_POSE_INFORMATION = 1e100


class _FrontalMatrix(NamedTuple):
    """Dense matrix in which a group of poses is eliminated together (supernode)."""

    # Range of the unknowns that are eliminated in this front, and indices of the other unknowns in
    # their equations, which are eliminated later
    unknowns: slice
    remaining_unknowns: IntArray
    # Range of this front's matrix elements in the flat array of all fronts
    slice_of_matrix_elements: slice
    # Index of the parent front in the elimination tree, and rows of ``remaining_unknowns`` in the
    # matrix of the parent front
    parent_index: int
    rows_in_parent: IntArray


class NormalEquations:
    """Normal equations of the least-squares problem ``A x_i + B x_j = c``, with x_0 = 0.

    Each edge (i, j) of the pose graph gives one equation.

    Parameters
    ----------
    edges : ndarray of int, shape (2, m)
        Pose indices i and j. The edges must connect all poses.
    unknowns_per_pose : int
    """

    def __init__(self, edges: IntArray, unknowns_per_pose: int) -> None:
        position, group_starts, remaining_poses_by_group = _find_elimination_order(
            edges, _MAX_LEAF_UNKNOWNS // unknowns_per_pose
        )
        poses, offsets_in_pose = np.arange(len(position)), np.arange(unknowns_per_pose)
        groups, pose_counts = np.arange(len(remaining_poses_by_group)), np.diff(group_starts)
        group_by_pose = np.repeat(groups, pose_counts)
        rows_by_group = [
            np.append(
                poses[slice(*group_starts[group : group + 2])], remaining_poses_by_group[group]
            )
            for group in groups
        ]
        row_counts = np.array([len(rows) for rows in rows_by_group])
        row_starts = np.append(0, np.cumsum(row_counts))
        keys_of_group_and_row = np.repeat(groups, row_counts) * len(poses) + np.concatenate(
            rows_by_group
        )
        column_counts = pose_counts * unknowns_per_pose
        element_starts = np.append(0, np.cumsum(row_counts * unknowns_per_pose * column_counts))

        def find_rows(group: IntArray, pose_index: IntArray) -> IntArray:
            """Return the rows of each pose in the frontal matrix of its group.

            The shape is (n, d) for n poses with d unknowns each.
            """
            row = np.searchsorted(keys_of_group_and_row, group * len(poses) + pose_index)
            return np.asarray(
                (row - row_starts[group])[:, None] * unknowns_per_pose + offsets_in_pose
            )

        def find_elements(row_pose: IntArray, column_pose: IntArray) -> IntArray:
            """Return the flat indices of the matrix block of two poses, shape (n, d, d)."""
            group = group_by_pose[column_pose]
            columns = (column_pose - group_starts[group])[:, None] * unknowns_per_pose
            row_offsets = find_rows(group, row_pose) * column_counts[group][:, None]
            first_elements = element_starts[group][:, None] + columns + offsets_in_pose
            return np.asarray(row_offsets[:, :, None] + first_elements[:, None])

        edge_positions = position[edges]
        diagonal_blocks = find_elements(poses, poses)
        off_diagonal_blocks = find_elements(edge_positions.max(axis=0), edge_positions.min(axis=0))
        self._element_indices = np.concatenate(
            [diagonal_blocks[edge_positions].ravel(), off_diagonal_blocks.ravel()]
        )
        self._edges = edges
        self._position = position
        self._diagonal = np.diagonal(diagonal_blocks, axis1=1, axis2=2)
        self._fronts = []
        for group, remaining_poses in enumerate(remaining_poses_by_group):
            parent_index = int(group_by_pose[remaining_poses[0]]) if len(remaining_poses) else group
            self._fronts.append(
                _FrontalMatrix(
                    slice(*group_starts[group : group + 2] * unknowns_per_pose),
                    (remaining_poses[:, None] * unknowns_per_pose + offsets_in_pose).ravel(),
                    slice(*element_starts[group : group + 2]),
                    parent_index,
                    find_rows(np.full(len(remaining_poses), parent_index), remaining_poses).ravel(),
                )
            )

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
        pose_matrices = np.stack([first_pose_matrix, second_pose_matrix])
        weighted_matrices = pose_matrices.swapaxes(2, 3) @ information
        off_diagonal_blocks = weighted_matrices[0] @ second_pose_matrix
        is_first_earlier = np.less(*self._position[self._edges])
        off_diagonal_blocks[is_first_earlier] = off_diagonal_blocks[is_first_earlier].swapaxes(1, 2)
        blocks = np.concatenate(
            [(weighted_matrices @ pose_matrices).ravel(), off_diagonal_blocks.ravel()]
        )
        matrix_elements = np.asarray(np.bincount(self._element_indices, blocks), dtype=float)
        matrix_elements[self._diagonal[self._position[0]]] = _FIXED_POSE_INFORMATION
        right_hand_sides = np.zeros((len(self._position), *right_hand_side.shape[1:]))
        np.add.at(right_hand_sides, self._edges, weighted_matrices @ right_hand_side)
        return matrix_elements, right_hand_sides

    def solve(
        self, matrix_elements: Array, right_hand_sides: Array, damping: float = 0.0
    ) -> Array | None:
        """Solve the equations, with damping added to the diagonal.

        Return None if the matrix is not positive definite.
        """
        matrix_elements = matrix_elements.copy()
        matrix_elements[self._diagonal] += damping
        solution = np.empty_like(right_hand_sides)
        solution[self._position] = right_hand_sides
        solution = solution.reshape(self._diagonal.size, -1)
        schur_complements = defaultdict[int, list[tuple[IntArray, Array]]](list)
        factors = []
        for index, front in enumerate(self._fronts):
            unknowns, remaining_unknowns = front.unknowns, front.remaining_unknowns
            size = unknowns.stop - unknowns.start
            matrix = np.zeros((size + len(remaining_unknowns),) * 2)
            matrix[:, :size] = matrix_elements[front.slice_of_matrix_elements].reshape(-1, size)
            for rows, schur_complement in schur_complements.pop(index, ()):
                matrix[rows[:, None], rows] += schur_complement
            cholesky_factor, failed_row = lapack.dpotrf(matrix[:size, :size].T)
            if failed_row:
                return None
            solution[unknowns] = blas.dtrsm(1.0, cholesky_factor, solution[unknowns], trans_a=1)
            off_diagonal_factor = matrix[size:, :size].T
            if len(remaining_unknowns):
                off_diagonal_factor = blas.dtrsm(
                    1.0, cholesky_factor, off_diagonal_factor, trans_a=1
                )
                # Only the lower triangle of the symmetric matrix is computed
                schur_complement = blas.dsyrk(
                    -1.0, off_diagonal_factor, 1.0, matrix[size:, size:].T, trans=1
                ).T
                schur_complements[front.parent_index].append(
                    (front.rows_in_parent, schur_complement)
                )
                solution[remaining_unknowns] -= off_diagonal_factor.T @ solution[unknowns]
            factors.append((unknowns, remaining_unknowns, cholesky_factor, off_diagonal_factor))
        for unknowns, remaining_unknowns, cholesky_factor, off_diagonal_factor in reversed(factors):
            terms_of_solved_unknowns = off_diagonal_factor @ solution[remaining_unknowns]
            solution[unknowns] = blas.dtrsm(
                1.0, cholesky_factor, solution[unknowns] - terms_of_solved_unknowns
            )
        solution = solution.reshape(right_hand_sides.shape)[self._position]
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
    remaining_poses_by_group : list of ndarray of int
        Poses in the equations of each group that are eliminated later.
    """
    rows = np.tile(np.arange(edges.shape[1]), 2)
    incidence_matrix = sparse.csc_array(
        (np.repeat([1.0, -1.0], edges.shape[1]), (rows, edges.ravel()))
    )
    pose_count = incidence_matrix.shape[1]
    first_pose_anchor_matrix = sparse.csc_array(([1.0], ([0], [0])), shape=(pose_count, pose_count))
    lu_factors = splu(
        (incidence_matrix.T @ incidence_matrix + first_pose_anchor_matrix).tocsc(),
        # This elimination order gives fewer nonzeros than the default COLAMD
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        # By default, SuperLU merges columns with different nonzeros (relaxed supernodes), and then
        # stores zeros. This is switched off, because the code below counts the stored elements
        relax=1,
        options={"SymmetricMode": True},
    )
    factor = lu_factors.L.sorted_indices()
    nonzero_counts = np.diff(factor.indptr)
    # The parent of a pose in the elimination tree is the first nonzero row below the diagonal
    parent = factor.indices[factor.indptr[:-2] + 1]
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
    for pose_index, pose_parent in enumerate(parent.tolist()):
        subtree_size[pose_parent] += subtree_size[pose_index]
    is_large_subtree = subtree_size > max_poses_per_leaf_group
    is_large_subtree[pose_count] = True
    leaf_subtree_ends = np.flatnonzero(~is_large_subtree[:-1] & is_large_subtree[parent])
    # A pose is merged with its child in the elimination tree if their columns of the Cholesky
    # factor have the same nonzero rows
    is_parent_next = parent[:-1] == np.arange(1, pose_count)
    is_merged_with_child = is_large_subtree[:-2] & is_parent_next & (np.diff(nonzero_counts) == -1)
    is_group_start = is_large_subtree[:-1] & ~np.append(False, is_merged_with_child)
    is_group_start[leaf_subtree_ends - subtree_size[leaf_subtree_ends] + 1] = True
    group_starts = np.append(np.flatnonzero(is_group_start), pose_count)
    remaining_poses_by_group = [
        np.sort(position[factor.indices[slice(*factor.indptr[pose_index : pose_index + 2])]])[1:]
        for pose_index in elimination_order[group_starts[1:] - 1]
    ]
    return position[lu_factors.perm_c], group_starts, remaining_poses_by_group
