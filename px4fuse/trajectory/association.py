"""Two trajectories at the same times."""

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Slerp

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.errors import TrajectoryError
from px4fuse.record import Count, NotNegative, Record
from px4fuse.trajectory.model import MIN_POSES, Trajectory

Method = Literal["interpolate", "nearest"]

# Positions are not interpolated across longer intervals than so many median ones, or this
GAP_INTERVALS, GAP_S = 3.0, 0.1
NEAREST_S = 0.01  # the evo package's default too


class Association(Record, frozen=True):
    """How poses were paired by time, and how many were left out.

    Attributes
    ----------
    method : {"interpolate", "nearest"}
    poses : int
        Of each of the two, at the same times.
    max_gap_s : float
        Longest interval of the reference that is interpolated across; for "nearest" the largest
        difference in time.
    outside, in_gaps : int
        Poses of the estimate dropped as the reference has none at their time: before its start
        or after its end, and in its gaps.
    coverage_estimate : float
        Share of the estimate's poses that are used.
    coverage_reference : float
        Share of the reference's span in time that the used poses cover; intervals between them
        longer than five median ones and 0.5 s do not.
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
    """Poses of both at the same times: the estimate's on its own clock, and as many references.

    Parameters
    ----------
    method : {"interpolate", "nearest"}
        "interpolate" puts the reference at the estimate's times, position linearly and rotation by
        slerp. "nearest" pairs the poses of the one that has fewer with the nearest of the other,
        as the evo package does; a pose of the longer one may serve twice.
    max_gap_s : float, optional
        See :class:`Association`; by default three median intervals of the reference and at least
        0.1 s, and 0.01 s for "nearest".
    time_offset_s : float
        Added to the estimate's stamps.

    Raises
    ------
    TrajectoryError
        Fewer than three poses match; the text gives both spans.
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
        what = (
            f"only {len(pose_indices)} of its poses match"
            if len(pose_indices)
            else "no poses match"
        )
        added = f" (with the offset of {time_offset_s:.12g} s)" if time_offset_s else ""
        raise TrajectoryError(
            f"{estimate.name}: {what} in time: it spans {time[0]:.3f} to {time[-1]:.3f} s{added}, "
            f"the reference {reference.name} {first:.3f} to {last:.3f} s",
            "Check that both are of "
            "the same flight; if their clocks differ, give `time_offset_s` auto.",
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
    """Longest interval (s) between stamps across which positions are interpolated."""
    return max(GAP_INTERVALS * float(np.median(np.diff(time_s))), least_s)


def is_bracketed(time_s: Array, reference_s: Array, limit: float) -> BoolArray:
    """Whether each time is a reference's, or between two that are near enough to each other."""
    right = np.clip(np.searchsorted(reference_s, time_s), 1, len(reference_s) - 1)
    before, after = reference_s[right - 1], reference_s[right]
    between = (before <= time_s) & (time_s <= after) & (after - before <= limit)
    return np.asarray(between | (before == time_s) | (after == time_s))


def _interpolate_poses(trajectory: Trajectory, time_s: Array) -> Trajectory:
    """Poses at times within its span."""
    rotation = trajectory.rotation
    if rotation is not None and len(time_s):
        rotation = Slerp(trajectory.time_s, rotation)(time_s)
    interpolated = trajectory.moved(positions_at(trajectory, time_s))
    return replace(interpolated, rotation=rotation, time_s=time_s)


def positions_at(trajectory: Trajectory, time_s: Array) -> Array:
    """Positions at times within its span, shape (n, 3)."""
    columns = trajectory.position_m.T
    return np.stack([np.interp(time_s, trajectory.time_s, one) for one in columns], axis=-1)


def _pair_nearest(
    estimate_s: Array, reference_s: Array, limit: float, offset_s: float
) -> tuple[IntArray, IntArray]:
    """Indices of pairs: each stamp of the shorter with the nearest of the longer."""
    # the offset goes to the longer one's stamps, so that roundings are those of evo
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
