"""Normal equations of a pose graph, solved by multifrontal Cholesky factorisation.

Source: Liu 1992, The multifrontal method for sparse matrix solution, sections 3 to 5.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array, ArrayPair, IntArray

# The poses of a small subtree of the elimination tree are eliminated together, in one dense matrix.
# Maximum number of unknowns in this matrix: a larger matrix would contain more zeros
_MAX_LEAF_UNKNOWNS = 96
# Diagonal matrix elements of the first pose: so large that they fix the pose, but their squares do
# not overflow
_FIXED_POSE_INFORMATION = 1e100


class _FrontalMatrix(NamedTuple):
    """Front of a multifrontal Cholesky factorisation.

    It is a dense matrix in which a group of poses is eliminated together. Later fronts eliminate
    the remaining poses in the equations of this group.
    """

    # Range of the unknowns that are eliminated in this front, and indices of the remaining unknowns
    unknowns: slice
    remaining_unknowns: IntArray
    # Range of the matrix blocks (one for each pair of poses) in the columns of the eliminated
    # poses, and row and column of each block in the frontal matrix, counted in blocks
    blocks: slice
    block_rows: IntArray
    block_columns: IntArray
    # Index of the parent frontal matrix, which eliminates the first of the remaining unknowns, and
    # rows of the remaining unknowns in the parent frontal matrix
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
        """Plan the multifrontal solution: order of elimination, blocks and frontal matrices."""
        # Poses are numbered by their position in the order of elimination
        position, eliminated_counts, poses_by_front = _find_elimination_order(
            edges, _MAX_LEAF_UNKNOWNS // unknowns_per_pose
        )
        edge_positions = position[edges]
        # Each edge adds to the two diagonal blocks of its poses, and to the off-diagonal blocks
        # that connect them. Only the off-diagonal block below the diagonal is stored. It is in the
        # column of the pose that is eliminated first
        columns = np.concatenate([*edge_positions, edge_positions.min(axis=0)])
        rows = np.concatenate([*edge_positions, edge_positions.max(axis=0)])
        # Number the blocks column by column. Several edges can add to the same block
        blocks, block_indices = np.unique(columns * len(position) + rows, return_inverse=True)
        block_columns, block_rows = np.divmod(blocks, len(position))

        def enumerate_elements(indices: IntArray, count: int) -> IntArray:
            """Return the indices of the elements of each block."""
            return np.asarray((indices[:, None] * count + np.arange(count)).ravel())

        self._edges = edges
        self._position = position
        # Index of each matrix element to which the edges add, in the list of all blocks
        self._element_indices = enumerate_elements(block_indices, unknowns_per_pose**2)
        self._diagonal_blocks = np.flatnonzero(block_columns == block_rows)
        self._fronts = []
        front_by_pose = np.repeat(np.arange(len(poses_by_front)), eliminated_counts)
        for poses, eliminated_count in zip(poses_by_front, eliminated_counts, strict=True):
            first_pose, remaining_poses = poses[0], poses[eliminated_count:]
            eliminated_range = np.array([first_pose, first_pose + eliminated_count])
            front_blocks = slice(*np.searchsorted(block_columns, eliminated_range))
            # The parent of a front is the front that eliminates the first of its remaining poses.
            # The last front has no remaining poses and no parent: its index 0 is not used
            parent_index = int(front_by_pose[remaining_poses[0]]) if len(remaining_poses) else 0
            parent_rows = np.searchsorted(poses_by_front[parent_index], remaining_poses)
            self._fronts.append(
                _FrontalMatrix(
                    unknowns=slice(*eliminated_range * unknowns_per_pose),
                    remaining_unknowns=enumerate_elements(remaining_poses, unknowns_per_pose),
                    blocks=front_blocks,
                    block_rows=np.searchsorted(poses, block_rows[front_blocks]),
                    block_columns=block_columns[front_blocks] - first_pose,
                    parent_index=parent_index,
                    rows_in_parent=enumerate_elements(parent_rows, unknowns_per_pose),
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

        Return the blocks of the matrix, and the right-hand sides, shape (n, d, k).

        Parameters
        ----------
        first_pose_matrix, second_pose_matrix, information, right_hand_side : ndarray
            A, B and weight, shape (m, d, d), and c, shape (m, d, k), of each of the m edges.
        """
        # An edge A x_i + B x_j = c with weight W adds AᵀWA and BᵀWB to the diagonal blocks of its
        # poses, AᵀWB to the off-diagonal block that connects them, and AᵀWc and BᵀWc to the
        # right-hand sides
        pose_matrices = np.stack([first_pose_matrix, second_pose_matrix])
        weighted_matrices = pose_matrices.swapaxes(2, 3) @ information
        # Off-diagonal block of each edge: rows of the first pose, columns of the second pose.
        # Transpose it if the first pose is eliminated first, because only blocks below the diagonal
        # are stored
        off_diagonal_blocks = weighted_matrices[0] @ second_pose_matrix
        is_first_earlier = np.less(*self._position[self._edges])
        off_diagonal_blocks[is_first_earlier] = off_diagonal_blocks[is_first_earlier].swapaxes(1, 2)
        # List the blocks of all edges in the order of __init__: diagonal blocks of the poses i,
        # diagonal blocks of the poses j, off-diagonal blocks. Contributions to the same block are
        # added by bincount
        edge_blocks = [*(weighted_matrices @ pose_matrices), off_diagonal_blocks]
        elements = np.asarray(np.bincount(self._element_indices, np.ravel(edge_blocks)), float)
        matrix_blocks = elements.reshape(-1, *information.shape[1:])
        first_pose_block = self._diagonal_blocks[self._position[0]]
        matrix_blocks[first_pose_block] += _FIXED_POSE_INFORMATION * np.eye(information.shape[1])
        right_hand_sides = np.zeros((len(self._position), *right_hand_side.shape[1:]))
        np.add.at(right_hand_sides, self._edges, weighted_matrices @ right_hand_side)
        return matrix_blocks, right_hand_sides

    def solve(
        self, matrix_blocks: Array, right_hand_sides: Array, damping: float = 0.0
    ) -> Array | None:
        """Solve the normal equations of :meth:`assemble`.

        ``damping`` (Levenberg-Marquardt) is added to the diagonal. Return None if the matrix is not
        positive definite.
        """
        _, unknowns_per_pose, right_hand_side_count = right_hand_sides.shape
        matrix_blocks = matrix_blocks.copy()
        matrix_blocks[self._diagonal_blocks] += damping * np.eye(unknowns_per_pose)
        # Right-hand sides in the order of elimination, which become the solution
        solution = np.empty_like(right_hand_sides)
        solution[self._position] = right_hand_sides
        solution = solution.reshape(-1, right_hand_side_count)
        # Schur complements with their rows, by the index of the frontal matrix to which they are
        # added
        schur_complements = defaultdict[int, list[tuple[IntArray, Array]]](list)
        factors = []
        for index, front in enumerate(self._fronts):
            unknowns, remaining_unknowns = front.unknowns, front.remaining_unknowns
            size = unknowns.stop - unknowns.start
            row_count = size + len(remaining_unknowns)
            # Matrix [[D, Bᵀ], [B, C]] with the eliminated unknowns first. Only the triangle below
            # the diagonal is used
            matrix = np.zeros((row_count, row_count))
            # View of the matrix with the axes block row, row, block column, column
            matrix.reshape(
                row_count // unknowns_per_pose, unknowns_per_pose, -1, unknowns_per_pose
            )[front.block_rows, :, front.block_columns] = matrix_blocks[front.blocks]
            for rows, schur_complement in schur_complements.pop(index, ()):
                matrix[rows[:, None], rows] += schur_complement
            # Compute the Cholesky factor U of D = UᵀU. LAPACK and BLAS expect columns in sequence
            # (Fortran order). In this order, the array is the transposed matrix, so its lower
            # triangle becomes the upper triangle that they use
            cholesky_factor, failed_row = lapack.dpotrf(matrix[:size, :size].T)
            if failed_row:
                return None
            # Forward substitution: solve Uᵀ y = right-hand side
            solution[unknowns] = blas.dtrsm(1.0, cholesky_factor, solution[unknowns], trans_a=1)
            off_diagonal_factor = matrix[size:, :size].T
            if len(remaining_unknowns):
                # F = U⁻ᵀ Bᵀ, and Schur complement C - FᵀF
                off_diagonal_factor = blas.dtrsm(
                    1.0, cholesky_factor, off_diagonal_factor, trans_a=1
                )
                schur_complement = blas.dsyrk(
                    -1.0, off_diagonal_factor, 1.0, matrix[size:, size:].T, trans=1
                ).T
                schur_complements[front.parent_index].append(
                    (front.rows_in_parent, schur_complement)
                )
                solution[remaining_unknowns] -= off_diagonal_factor.T @ solution[unknowns]
            factors.append((unknowns, remaining_unknowns, cholesky_factor, off_diagonal_factor))
        # Back substitution, from the last to the first eliminated unknowns: U x = y - F x_later
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
    """Return the order in which n poses are eliminated, in g frontal matrices (fronts).

    Returns
    -------
    position : ndarray of int, shape (n,)
        Index of each pose in the order of elimination.
    eliminated_counts : ndarray of int, shape (g,)
        Number of poses that are eliminated in each front.
    poses_by_front : list of ndarray of int
        Poses of each front, as indices in the order of elimination: first the eliminated poses,
        then the remaining poses. Both parts are in ascending order.
    """
    # Poses are numbered by their index in the sparse order. remaining_poses: see
    # _build_elimination_tree
    sparse_order = _find_sparse_order(edges)
    remaining_poses, subtree_sizes = _build_elimination_tree(sparse_order[edges])
    # last_poses[k] is the last pose in the frontal matrix of pose k. A pose shares the frontal
    # matrix of its parent in the elimination tree if both are in a small subtree, or if their
    # columns of the Cholesky factor have equal nonzero rows. The rows of the parent include those
    # of the pose, so it is sufficient to compare the numbers of rows. Parents have larger indices,
    # so the loop starts with the last pose
    last_poses = np.arange(len(sparse_order))
    for pose in reversed(range(len(sparse_order) - 1)):
        parent = min(remaining_poses[pose])
        is_in_small_subtree = subtree_sizes[parent] <= max_poses_per_leaf_group
        is_above_small_subtrees = subtree_sizes[pose] > max_poses_per_leaf_group
        has_rows_of_parent = len(remaining_poses[pose]) == len(remaining_poses[parent]) + 1
        if is_in_small_subtree or (is_above_small_subtrees and has_rows_of_parent):
            last_poses[pose] = last_poses[parent]
    # Sort the poses by the last pose of their front, so that each front is eliminated before its
    # parent. The second argsort converts the sorted list to the position of each pose in it
    position = np.argsort(np.argsort(last_poses, kind="stable"))
    last_poses, eliminated_counts = np.unique(last_poses, return_counts=True)
    poses_by_front = [
        np.append(np.arange(end - count, end), np.sort(position[list(remaining_poses[pose])]))
        for pose, count, end in zip(
            last_poses.tolist(), eliminated_counts, np.cumsum(eliminated_counts), strict=True
        )
    ]
    return position[sparse_order], eliminated_counts, poses_by_front


def _find_sparse_order(edges: IntArray) -> IntArray:
    """Return the index of each pose in an order of elimination with few nonzeros.

    The order is computed for a matrix with one unknown per pose.
    """
    edge_count, pose_count = edges.shape[1], int(edges.max()) + 1
    adjacency = sparse.csc_array((np.ones(edge_count), edges), shape=(pose_count, pose_count))
    # The diagonal makes the matrix positive definite
    matrix = adjacency + adjacency.T + (edge_count + 1.0) * sparse.eye_array(pose_count)
    # The minimum degree order gives fewer nonzeros than the default COLAMD
    order = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).perm_c
    return np.asarray(order, dtype=np.intp)


def _build_elimination_tree(edges: IntArray) -> tuple[list[set[int]], list[int]]:
    """Return the remaining poses of each pose in the elimination tree, and its subtree size.

    Pose k is eliminated in step k. Its remaining poses are the nonzero rows below the diagonal in
    column k of the Cholesky factor: later poses that are connected to it by an edge or by the
    elimination of its children. The parent of a pose is the first of its remaining poses. The last
    pose has no parent. ``edges`` has shape (2, m) and contains the elimination steps of both poses.
    """
    remaining_poses: list[set[int]] = [set() for _ in range(int(edges.max()) + 1)]
    for first, second in np.sort(edges, axis=0).T.tolist():
        remaining_poses[first].add(second)
    subtree_sizes = [1] * len(remaining_poses)
    # In the elimination tree, a child has a smaller index than its parent. When the loop reaches a
    # pose, all its children have added the poses that remain after their elimination
    for pose in range(len(remaining_poses) - 1):
        parent = min(remaining_poses[pose])
        remaining_poses[parent] |= remaining_poses[pose] - {parent}
        subtree_sizes[parent] += subtree_sizes[pose]
    return remaining_poses, subtree_sizes
