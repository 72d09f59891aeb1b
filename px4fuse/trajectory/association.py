"""Association of the poses of two trajectories by time."""

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Slerp

from px4fuse.core.arrays import (
    Array,
    BoolArray,
    IntArray,
    compute_median_interval_s,
    interpolate_columns,
)
from px4fuse.core.record import Count, NonNegativeFloat, Record
from px4fuse.errors import TrajectoryError

from .model import MIN_POSES, Trajectory

AssociationMethod = Literal["interpolate", "nearest"]

# Default maximum gap in the reference for interpolation, in median pose intervals
MAX_GAP_IN_MEDIAN_INTERVALS = 3.0
# A reference with a longer median pose interval (s) is not interpolated
MIN_POSE_INTERVAL_LIMIT_S = 2.0
# Lower limit (s) of the default maximum gap for interpolation
MIN_GAP_LIMIT_S = 0.1
# Default maximum time difference (s) of a pair of poses, as in the evo package
MAX_PAIR_TIME_DIFFERENCE_S = 0.01


class Association(Record):
    """Poses of two trajectories that match in time.

    Attributes
    ----------
    max_gap_s : float
        Maximum gap for interpolation, or maximum time difference of a pair.
    outside, in_gaps : int
        Numbers of unused poses: outside the reference's time span, and in its gaps.
    coverage_estimate : float
        Used fraction of the poses of the estimate.
    coverage_reference : float
        Fraction of the reference's time span with used poses.
    """

    method: AssociationMethod
    poses: Count
    max_gap_s: NonNegativeFloat
    outside: Count
    in_gaps: Count
    coverage_estimate: float
    coverage_reference: float


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    method: AssociationMethod = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float = 0.0,
) -> tuple[Trajectory, Trajectory, Association]:
    """Return the poses of two trajectories at the same times.

    Parameters
    ----------
    method : {"interpolate", "nearest"}
        Interpolate the reference, or pair the poses that are nearest in time.
    max_gap_s : float, optional
        Maximum gap for interpolation, or maximum time difference of a pair.
    time_offset_s : float
        Time offset added to the timestamps of the estimate.

    Raises
    ------
    TrajectoryError
        Fewer than three poses match.
    """
    estimate_interval_s = compute_median_interval_s(estimate.time_s)
    # Choose a maximum gap if the user gave none. If the reference is too sparse for interpolation,
    # pair the nearest poses instead
    if max_gap_s is None:
        max_interpolated_interval_s = max(MIN_POSE_INTERVAL_LIMIT_S, 2.0 * estimate_interval_s)
        if method == "nearest":
            max_gap_s = MAX_PAIR_TIME_DIFFERENCE_S
        elif compute_median_interval_s(reference.time_s) > max_interpolated_interval_s:
            # The path between two poses of a sparse reference is unknown
            method, max_gap_s = "nearest", estimate_interval_s
        else:
            max_gap_s = choose_gap_limit_s(reference.time_s)
    # Match the poses
    time_s = estimate.time_s + time_offset_s
    reference_start_s, reference_end_s = reference.time_s[[0, -1]]
    margin_s = 0.0
    if method == "nearest":
        # Poses just before the start or just after the end of the reference can be paired with its
        # first or last pose
        margin_s = max_gap_s
        pose_indices, reference_indices = _pair_nearest(
            estimate.time_s, reference.time_s, max_gap_s, time_offset_s
        )
        matched_reference = reference[reference_indices]
    else:
        pose_indices = np.flatnonzero(is_bracketed(time_s, reference.time_s, max_gap_s))
        matched_reference = _interpolate_poses(reference, time_s[pose_indices])
    if len(pose_indices) < MIN_POSES:
        raise TrajectoryError(
            f"{estimate.name}: {len(pose_indices)} poses match in time; {MIN_POSES} are needed. "
            f"Time offset {time_offset_s:.12g} s, estimate {time_s[0]:.3f} to {time_s[-1]:.3f} s, "
            f"reference {reference.name} {reference_start_s:.3f} to {reference_end_s:.3f} s.",
            "Check that both trajectories are of the same flight. If the clocks differ, "
            "set `time_offset_s` to auto.",
        )
    # Count the unused poses, and the fractions of both trajectories that are evaluated. In pairs of
    # nearest poses, an estimated pose can occur several times
    is_outside = (time_s < reference_start_s - margin_s) | (time_s > reference_end_s + margin_s)
    outside_count = int(is_outside.sum())
    used_pose_count, pose_count = len(np.unique(pose_indices)), len(estimate)
    # A longer interval (s) between two used poses is a gap, which does not count as covered
    max_covered_interval_s = max(5.0 * estimate_interval_s, 0.5)
    intervals_s = np.diff(time_s[pose_indices])
    covered_duration_s = intervals_s[intervals_s <= max_covered_interval_s].sum()
    association = Association(
        method=method,
        poses=len(pose_indices),
        max_gap_s=max_gap_s,
        outside=outside_count,
        in_gaps=pose_count - outside_count - used_pose_count,
        coverage_estimate=used_pose_count / pose_count,
        coverage_reference=min(
            float(covered_duration_s / (reference_end_s - reference_start_s)), 1.0
        ),
    )
    return estimate[pose_indices], matched_reference, association


def choose_gap_limit_s(time_s: Array, min_gap_limit_s: float = MIN_GAP_LIMIT_S) -> float:
    """Return the default maximum gap (s) for the interpolation of poses."""
    return max(MAX_GAP_IN_MEDIAN_INTERVALS * compute_median_interval_s(time_s), min_gap_limit_s)


def is_bracketed(time_s: Array, reference_time_s: Array, gap_limit_s: float) -> BoolArray:
    """Return a mask of times whose neighbouring reference times differ by at most a limit."""
    # Neighbours of each time. The limits also give two neighbours to times outside the reference
    next_indices = np.searchsorted(reference_time_s, time_s).clip(1, len(reference_time_s) - 1)
    previous_time_s = reference_time_s[next_indices - 1]
    next_time_s = reference_time_s[next_indices]
    is_between = (previous_time_s <= time_s) & (time_s <= next_time_s)
    is_near = next_time_s - previous_time_s <= gap_limit_s
    # A time at a reference pose needs no interpolation, so the gap beside it does not matter
    is_at_reference_pose = (previous_time_s == time_s) | (next_time_s == time_s)
    return np.asarray((is_between & is_near) | is_at_reference_pose)


def _interpolate_poses(trajectory: Trajectory, time_s: Array) -> Trajectory:
    """Interpolate the poses at times within the trajectory."""
    rotation = trajectory.rotation
    if rotation is not None and len(time_s):
        rotation = Slerp(trajectory.time_s, rotation)(time_s)
    position_m = interpolate_columns(time_s, trajectory.time_s, trajectory.position_m)
    poses = trajectory.replace_positions(position_m)
    return replace(poses, rotation=rotation, time_s=time_s)


def _pair_nearest(
    estimate_time_s: Array, reference_time_s: Array, max_difference_s: float, offset_s: float
) -> tuple[IntArray, IntArray]:
    """Pair the poses of two trajectories that are nearest in time, and return their indices."""
    # With this order of operations, rounding errors equal those of the evo package
    is_estimate_denser = len(estimate_time_s) > len(reference_time_s)
    sparse_time_s = reference_time_s if is_estimate_denser else estimate_time_s
    dense_time_s = estimate_time_s + offset_s if is_estimate_denser else reference_time_s - offset_s
    # Each pose of the sparse trajectory is paired with the previous or the next dense pose. The
    # limits also give two neighbours to times outside the dense trajectory
    next_indices = np.searchsorted(dense_time_s, sparse_time_s, side="right")
    next_indices = next_indices.clip(1, len(dense_time_s) - 1)
    time_to_previous_s = np.abs(sparse_time_s - dense_time_s[next_indices - 1])
    is_next_nearer = np.abs(dense_time_s[next_indices] - sparse_time_s) < time_to_previous_s
    nearest_indices = np.where(is_next_nearer, next_indices, next_indices - 1)
    is_paired = np.abs(dense_time_s[nearest_indices] - sparse_time_s) <= max_difference_s
    sparse_indices, dense_indices = np.flatnonzero(is_paired), nearest_indices[is_paired]
    if is_estimate_denser:
        return dense_indices, sparse_indices
    return sparse_indices, dense_indices
