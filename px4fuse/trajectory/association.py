"""Association of the poses of two trajectories by time."""

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Slerp

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.errors import TrajectoryError
from px4fuse.record import Count, NotNegative, Record
from px4fuse.trajectory.model import MIN_POSES, Trajectory

Method = Literal["interpolate", "nearest"]

# longest interpolated interval: multiple of the median interval, and at least this (s)
GAP_INTERVALS, GAP_S = 3.0, 0.1
NEAREST_S = 0.01  # largest time difference; same default as the evo package


class Association(Record, frozen=True):
    """Pairing of poses by time, with the numbers of unused poses.

    Attributes
    ----------
    method : {"interpolate", "nearest"}
    poses : int
        Number of pairs.
    max_gap_s : float
        Longest interval of the reference that is interpolated; for "nearest" the largest time
        difference.
    outside, in_gaps : int
        Poses of the estimate without a reference: before its start or after its end, and in its
        gaps.
    coverage_estimate : float
        Fraction of the poses of the estimate that are used.
    coverage_reference : float
        Fraction of the time of the reference that the used poses cover. Intervals between them are
        not counted if they are longer than five median intervals and 0.5 s.
    """

    method: Method
    poses: Count
    max_gap_s: NotNegative
    outside: Count
    in_gaps: Count
    coverage_estimate: float
    coverage_reference: float


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    method: Method = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float = 0.0,
) -> tuple[Trajectory, Trajectory, Association]:
    """Return the poses of both trajectories at the same times, on the clock of the estimate.

    Parameters
    ----------
    method : {"interpolate", "nearest"}
        "interpolate": interpolate the reference at the times of the estimate, positions linearly
        and rotations by slerp. "nearest": pair each pose of the trajectory with fewer poses with
        the nearest of the other, as the evo package does; a pose of the longer one may be used
        twice.
    max_gap_s : float, optional
        See :class:`Association`; by default three median intervals of the reference and at least
        0.1 s, and 0.01 s for "nearest".
    time_offset_s : float
        Added to the timestamps of the estimate.

    Raises
    ------
    TrajectoryError
        Fewer than three poses match; the message contains both time spans.
    """
    time, (first, last) = estimate.time_s + time_offset_s, reference.time_s[[0, -1]]
    if method == "nearest":
        limit = end_tolerance_s = NEAREST_S if max_gap_s is None else max_gap_s
        pose_indices, other = _pair_nearest(estimate.time_s, reference.time_s, limit, time_offset_s)
        matched_reference = reference[other]
    else:
        limit, end_tolerance_s = (
            gap_limit(reference.time_s) if max_gap_s is None else max_gap_s,
            0.0,
        )
        pose_indices = np.flatnonzero(is_bracketed(time, reference.time_s, limit))
        matched_reference = _interpolate_poses(reference, time[pose_indices])
    if len(pose_indices) < MIN_POSES:
        count = f"only {len(pose_indices)}" if len(pose_indices) else "no"
        added = f" (with the time offset {time_offset_s:.12g} s)" if time_offset_s else ""
        raise TrajectoryError(
            f"{estimate.name}: {count} poses match in time. The estimate is from {time[0]:.3f} to "
            f"{time[-1]:.3f} s{added}, the reference {reference.name} from {first:.3f} to "
            f"{last:.3f} s.",
            "Check that both are of the same flight. If their clocks differ, give "
            "`time_offset_s` auto.",
        )
    outside = int(((time < first - end_tolerance_s) | (time > last + end_tolerance_s)).sum())
    steps = np.diff(time[pose_indices])
    longest = max(5.0 * float(np.median(np.diff(estimate.time_s))), 0.5)
    covered_share = float(steps[steps <= longest].sum() / (last - first))
    used_count, all_poses = len(np.unique(pose_indices)), len(estimate)
    found = Association(
        method=method,
        poses=len(pose_indices),
        max_gap_s=limit,
        outside=outside,
        in_gaps=all_poses - outside - used_count,
        coverage_estimate=used_count / all_poses,
        coverage_reference=min(covered_share, 1.0),
    )
    return estimate[pose_indices], matched_reference, found


def gap_limit(time_s: Array, least_s: float = GAP_S) -> float:
    """Return the longest interval (s) between timestamps that is interpolated."""
    return max(GAP_INTERVALS * float(np.median(np.diff(time_s))), least_s)


def is_bracketed(time_s: Array, reference_s: Array, limit: float) -> BoolArray:
    """Return True for times at a reference time, or between two within ``limit`` (s)."""
    right = np.clip(np.searchsorted(reference_s, time_s), 1, len(reference_s) - 1)
    before, after = reference_s[right - 1], reference_s[right]
    between = (before <= time_s) & (time_s <= after) & (after - before <= limit)
    return np.asarray(between | (before == time_s) | (after == time_s))


def _interpolate_poses(trajectory: Trajectory, time_s: Array) -> Trajectory:
    """Interpolate the poses at times within the trajectory."""
    rotation = trajectory.rotation
    if rotation is not None and len(time_s):
        rotation = Slerp(trajectory.time_s, rotation)(time_s)
    interpolated = trajectory.moved(positions_at(trajectory, time_s))
    return replace(interpolated, rotation=rotation, time_s=time_s)


def positions_at(trajectory: Trajectory, time_s: Array) -> Array:
    """Interpolate the positions at times within the trajectory, shape (n, 3)."""
    columns = trajectory.position_m.T
    return np.stack([np.interp(time_s, trajectory.time_s, column) for column in columns], axis=-1)


def _pair_nearest(
    estimate_s: Array, reference_s: Array, limit: float, offset_s: float
) -> tuple[IntArray, IntArray]:
    """Return indices of pairs: each time of the shorter with the nearest of the longer one."""
    # add the offset to the longer one, so that rounding is the same as in evo
    is_longer = len(estimate_s) > len(reference_s)
    short = reference_s if is_longer else estimate_s
    long = estimate_s + offset_s if is_longer else reference_s - offset_s
    right = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(long[right] - short) < np.abs(short - long[left]), right, left)
    within_limit = np.flatnonzero(np.abs(long[nearest] - short) <= limit)
    return (
        (nearest[within_limit], within_limit)
        if is_longer
        else (within_limit, nearest[within_limit])
    )
