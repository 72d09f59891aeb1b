"""Normal equations of a pose graph, solved by multifrontal Cholesky factorisation.

Successive poses in the order of elimination form groups. Each group is eliminated with dense
matrices. Its Schur complement is added to the equations of its parent, the next group that depends
on it. Source: Liu 1992, The multifrontal method for sparse matrix solution, sections 3 to 5.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from px4fuse.core.arrays import Array, ArrayPair, IntArray

# Maximum number of unknowns of a group that depends on no other group. Larger groups need fewer
# calls of LAPACK, but more arithmetic with zeros
_MAX_LEAF_UNKNOWNS = 96
# Added to the diagonal to fix the first pose: far above all information, with a finite square
_FIXED_POSE_INFORMATION = 1e100


class _Group(NamedTuple):
    """Poses that are eliminated together.

    Their equations are a matrix in Fortran order with a row for each unknown of the group. The
    columns are the unknowns of the group, the later unknowns that depend on them, and the right
    sides.
    """

    unknown_count: int
    values: slice
    unknowns: slice
    dependent_unknowns: IntArray
    parent: int
    # Columns of ``dependent_unknowns`` and of the right sides in the equations of the parent
    parent_columns: IntArray


class NormalEquations:
    """Normal equations of ``A x_i + B x_j = c`` over all edges (i, j), with x_0 = 0.

    The order of elimination and all indices are computed once, from the edges.

    Parameters
    ----------
    edges : ndarray of int, shape (2, m)
        Indices i and j of the n poses. The edges must connect all poses.
    unknowns_per_pose : int
        Number d of unknowns per pose.
    side_count : int
        Number k of right sides.
    """

    def __init__(self, edges: IntArray, unknowns_per_pose: int, side_count: int = 1) -> None:
        position, group_starts, later_positions = _order_of_elimination(
            edges, _MAX_LEAF_UNKNOWNS // unknowns_per_pose
        )
        poses, unknowns = np.arange(len(position)), np.arange(unknowns_per_pose)
        pose_counts = np.diff(group_starts)
        group_of = np.repeat(np.arange(len(later_positions)), pose_counts)
        dependent_counts = np.array([len(later) for later in later_positions])
        dependent_start = np.append(0, np.cumsum(dependent_counts))
        all_dependent = np.concatenate(later_positions)
        keys = (
            np.repeat(np.arange(len(later_positions)), dependent_counts) * len(poses)
            + all_dependent
        )
        row_counts = pose_counts * unknowns_per_pose
        column_counts = row_counts + dependent_counts * unknowns_per_pose + side_count
        value_start = np.append(0, np.cumsum(row_counts * column_counts))

        def columns_of(group: IntArray, pose: IntArray) -> IntArray:
            """Return the columns of each pose in the equations of a group."""
            later = np.searchsorted(keys, group * len(poses) + pose) - dependent_start[group]
            column = pose - group_starts[group]
            is_later = column >= pose_counts[group]
            column = np.where(is_later, pose_counts[group] + later, column)
            return np.asarray(column[:, None] * unknowns_per_pose + unknowns)

        def indices_of(pose: IntArray, columns: IntArray) -> IntArray:
            """Return the indices of each pose's equations in the values, columns first."""
            group = group_of[pose]
            column_start = value_start[group][:, None] + columns * row_counts[group][:, None]
            rows = (pose - group_starts[group])[:, None] * unknowns_per_pose + unknowns
            return np.asarray(column_start[:, :, None] + rows[:, None])

        edge_ends = np.sort(position[edges], axis=0)
        diagonal = indices_of(poses, columns_of(group_of, poses))
        cross = indices_of(edge_ends[0], columns_of(group_of[edge_ends[0]], edge_ends[1]))
        side_columns = np.arange(-side_count, 0) + column_counts[:, None]
        sides = indices_of(poses, side_columns[group_of])
        self._indices = np.concatenate(
            [part.ravel() for part in (diagonal[edge_ends], cross, sides[edge_ends])]
        )
        self._is_swapped = (position[edges[0]] > position[edges[1]])[:, None, None]
        self._position = position
        self._diagonal = np.diagonal(diagonal, axis1=1, axis2=2)
        self._sides = sides[position].swapaxes(1, 2)
        parents = group_of[[later[0] if len(later) else -1 for later in later_positions]]
        in_parents = columns_of(np.repeat(parents, dependent_counts), all_dependent)
        self._groups = [
            _Group(
                int(row_counts[group]),
                slice(*value_start[group : group + 2]),
                slice(*group_starts[group : group + 2] * unknowns_per_pose),
                (later[:, None] * unknowns_per_pose + unknowns).ravel(),
                int(parents[group]),
                np.append(
                    in_parents[slice(*dependent_start[group : group + 2])],
                    side_columns[parents[group]],
                ),
            )
            for group, later in enumerate(later_positions)
        ]

    def assemble(
        self,
        first_coefficient: Array,
        second_coefficient: Array,
        information: Array,
        edge_value: Array,
    ) -> ArrayPair:
        """Return the values of the equations, and the right sides, shape (n, d, k).

        Parameters
        ----------
        first_coefficient, second_coefficient, information : ndarray, shape (m, d, d)
            A, B, and the weight matrix of each edge.
        edge_value : ndarray, shape (m, d, k)
            Right sides c.
        """
        coefficients = np.where(
            self._is_swapped,
            (second_coefficient, first_coefficient),
            (first_coefficient, second_coefficient),
        )
        weighted = coefficients.swapaxes(2, 3) @ information
        sides = (weighted @ edge_value).swapaxes(2, 3)
        parts = (weighted @ coefficients, weighted[1] @ coefficients[0], sides)
        products = np.concatenate([part.ravel() for part in parts])
        values = np.asarray(np.bincount(self._indices, products), dtype=float)
        right_sides = values[self._sides]
        values[self._diagonal[self._position[0]]] = _FIXED_POSE_INFORMATION
        return values, right_sides

    def solve(self, values: Array, damping: float = 0.0) -> Array | None:
        """Solve the equations with damping on the diagonal; the result has the shape (n, d, k).

        Return None if the matrix is not positive definite.
        """
        values = values.copy()
        values[self._diagonal] += damping
        side_count = self._sides.shape[2]
        complements: dict[int, Array] = {}
        factors = []
        for index, group in enumerate(self._groups):
            equations = values[group.values].reshape(-1, group.unknown_count).T
            root, failed_row = lapack.dpotrf(equations[:, : group.unknown_count], overwrite_a=1)
            if failed_row:
                return None
            rows = blas.dtrsm(
                1.0, root, equations[:, group.unknown_count :], trans_a=1, overwrite_b=1
            )
            factors.append((group, root, rows))
            if group is self._groups[-1]:
                break
            column_count = rows.shape[1]
            complement = (
                complements.pop(index, np.zeros(column_count**2))
                .reshape(column_count, column_count)
                .T
            )
            complement = blas.dsyrk(-1.0, rows, 1.0, complement, trans=1, overwrite_c=1).T
            # only the part with row >= column is computed
            parent = self._groups[group.parent]
            columns = group.parent_columns
            inside = np.searchsorted(columns, parent.unknown_count)
            parent_values = values[parent.values]
            indices = columns[:, None] * parent.unknown_count + columns[:inside]
            parent_values[indices] += complement[:, :inside]
            columns = columns[inside:] - parent.unknown_count
            column_count = len(parent.dependent_unknowns) + side_count
            parent_complement = complements.setdefault(group.parent, np.zeros(column_count**2))
            parent_complement[columns[:, None] * column_count + columns] += complement[
                inside:, inside:
            ]
        solution = np.empty((self._diagonal.size, side_count))
        for group, root, rows in reversed(factors):
            known_part = rows[:, :-side_count] @ solution[group.dependent_unknowns]
            solution[group.unknowns] = blas.dtrsm(1.0, root, rows[:, -side_count:] - known_part)
        solution = solution.reshape(self._sides.shape)[self._position]
        solution[0] = 0.0
        return solution if np.all(np.isfinite(solution)) else None


def _order_of_elimination(
    edges: IntArray, max_leaf_poses: int
) -> tuple[IntArray, IntArray, list[IntArray]]:
    """Return the order of elimination of n poses, and its groups.

    Returns
    -------
    position : ndarray of int, shape (n,)
        Position of each pose in the order of elimination.
    group_starts : ndarray of int, shape (g + 1,)
        First position of each group, and n.
    later_positions : list of ndarray of int
        Later positions that depend on each group.
    """
    rows = np.tile(np.arange(edges.shape[1]), 2)
    incidence = sparse.csc_array((np.repeat([1.0, -1.0], edges.shape[1]), (rows, edges.ravel())))
    pose_count = incidence.shape[1]
    fixed = sparse.csc_array(([1.0], ([0], [0])), shape=(pose_count, pose_count))
    factors = splu(
        (incidence.T @ incidence + fixed).tocsc(),
        # MMD_AT_PLUS_A has 1.1 to 1.9 times less fill-in than COLAMD on public benchmark graphs
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        # without supernodes, which contain additional zeros
        relax=1,
        options={"SymmetricMode": True},
    )
    pattern = factors.L.sorted_indices()
    dependent_count = np.diff(pattern.indptr)
    # elimination tree: the parent of a pose is the first later pose that depends on it
    parent = pattern.indices[pattern.indptr[:-2] + 1]
    last_pose = pose_count - 1
    links = (dependent_count[:-1], (last_pose - parent, last_pose - np.arange(last_pose)))
    tree = sparse.csr_array(links, shape=fixed.shape)
    order = last_pose - depth_first_order(tree, 0, return_predecessors=False)[::-1]
    position = np.argsort(order)
    dependent_count = dependent_count[order]
    parent = np.append(position[parent[order[:-1]]], pose_count)
    subtree_size = np.ones(pose_count + 1, dtype=np.intp)
    for pose, pose_parent in enumerate(parent.tolist()):
        subtree_size[pose_parent] += subtree_size[pose]
    is_large = subtree_size > max_leaf_poses
    is_large[pose_count] = True
    roots = np.flatnonzero(~is_large[:-1] & is_large[parent])
    is_child = parent[:-1] == np.arange(1, pose_count)
    # a pose joins the group of its only child if this adds no zeros to the equations
    is_joined = is_large[:-2] & is_child & (np.diff(dependent_count) == -1)
    starts = np.flatnonzero(is_large[:-1] & ~np.append(False, is_joined))
    group_starts = np.sort(np.concatenate([roots - subtree_size[roots] + 1, starts, [pose_count]]))
    later_positions = [
        np.sort(position[pattern.indices[slice(*pattern.indptr[pose : pose + 2])]])[1:]
        for pose in order[group_starts[1:] - 1]
    ]
    return position[factors.perm_c], group_starts, later_positions
