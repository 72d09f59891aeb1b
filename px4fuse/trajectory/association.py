"""Two trajectories at the same times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Slerp

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import brief
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.model import MIN_POSES, Trajectory

Method = Literal["interpolate", "nearest"]

# Positions are not interpolated across longer intervals than so many median ones, or this
GAP_INTERVALS, GAP_S = 3.0, 0.1
NEAREST_S = 0.01  # the evo package's default too


@dataclass(frozen=True)
class Association:
    """Poses of both at the same times.

    Attributes
    ----------
    estimate : Trajectory
        The poses used, on its own clock.
    reference : Trajectory
        As many, on the reference's clock: interpolated, or the nearest ones.
    method : {"interpolate", "nearest"}
    max_gap_s : float
        Longest interval of the reference that is interpolated across; for "nearest" the largest
        difference in time.
    time_offset_s : float
        What was added to the estimate's stamps.
    outside, in_gaps : int
        Poses of the estimate dropped as the reference has none at their time: before its start
        or after its end, and in its gaps.
    coverage_estimate : float
        Share of the estimate's poses that are used.
    coverage_reference : float
        Share of the reference's span in time that the used poses cover; intervals between them
        longer than five median ones and 0.5 s do not.
    """

    estimate: Trajectory
    reference: Trajectory
    method: Method
    max_gap_s: float
    time_offset_s: float
    outside: int
    in_gaps: int
    coverage_estimate: float
    coverage_reference: float

    __repr__ = brief

    def __len__(self) -> int:
        return len(self.estimate)


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    method: Method = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float = 0.0,
) -> Association:
    """Poses of both at the same times.

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
    if method == "nearest":
        limit = NEAREST_S if max_gap_s is None else max_gap_s
        chosen, other = _nearest(estimate.time_s, reference.time_s, limit, time_offset_s)
        matched = None if len(chosen) < MIN_POSES else reference[other]
    else:
        limit = gap_limit(reference.time_s) if max_gap_s is None else max_gap_s
        time = estimate.time_s + time_offset_s
        chosen = np.flatnonzero(bracketed(time, reference.time_s, limit))
        matched = None if len(chosen) < MIN_POSES else _at(reference, time[chosen])
    time = estimate.time_s + time_offset_s
    if matched is None:
        raise TrajectoryError(_no_overlap(estimate, reference, time, len(chosen), time_offset_s))
    slack = limit if method == "nearest" else 0.0
    inside = (time >= reference.time_s[0] - slack) & (time <= reference.time_s[-1] + slack)
    steps = np.diff(time[chosen])
    longest = max(5.0 * float(np.median(np.diff(estimate.time_s))), 0.5)
    span = float(reference.time_s[-1] - reference.time_s[0])
    covered = float(steps[steps <= longest].sum()) / span
    outside = int(len(estimate) - inside.sum())
    return Association(
        estimate=estimate[chosen],
        reference=matched,
        method=method,
        max_gap_s=limit,
        time_offset_s=time_offset_s,
        outside=outside,
        in_gaps=len(estimate) - outside - len(np.unique(chosen)),
        coverage_estimate=len(np.unique(chosen)) / len(estimate),
        coverage_reference=min(covered, 1.0),
    )


def gap_limit(time_s: Array) -> float:
    """Longest interval (s) between stamps across which positions are interpolated."""
    return max(GAP_INTERVALS * float(np.median(np.diff(time_s))), GAP_S)


def bracketed(time_s: Array, reference_s: Array, limit: float) -> BoolArray:
    """Whether each time is a reference's, or between two that are near enough to each other."""
    right = np.clip(np.searchsorted(reference_s, time_s), 1, len(reference_s) - 1)
    exact = (reference_s[right] == time_s) | (reference_s[right - 1] == time_s)
    between = (reference_s[right - 1] <= time_s) & (time_s <= reference_s[right])
    near = reference_s[right] - reference_s[right - 1] <= limit
    bracketed: BoolArray = exact | (between & near)
    return bracketed


def _at(trajectory: Trajectory, time_s: Array) -> Trajectory:
    """Poses at times within its span."""
    rotation = trajectory.rotation
    if rotation is not None:
        rotation = Slerp(trajectory.time_s, rotation)(time_s)
    return replace(trajectory.moved(positions_at(trajectory, time_s), rotation), time_s=time_s)


def positions_at(trajectory: Trajectory, time_s: Array) -> Array:
    """Positions at times within its span, shape (n, 3)."""
    known = trajectory.time_s
    right = np.clip(np.searchsorted(known, time_s), 1, len(known) - 1)
    share = (time_s - known[right - 1]) / (known[right] - known[right - 1])
    before, after = trajectory.position_m[right - 1], trajectory.position_m[right]
    between: Array = before + share[:, None] * (after - before)
    return between


def _nearest(
    estimate_s: Array, reference_s: Array, limit: float, offset_s: float
) -> tuple[IntArray, IntArray]:
    """Indices of pairs: each stamp of the shorter with the nearest of the longer."""
    # the offset goes to the longer one's stamps, so that roundings are those of evo
    is_longer = len(estimate_s) > len(reference_s)
    short = reference_s if is_longer else estimate_s
    long = estimate_s + offset_s if is_longer else reference_s - offset_s
    right = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    left = np.maximum(right - 1, 0)
    after, before = long[right] - short, np.where(right > 0, short - long[left], np.inf)
    nearest = np.where(after < before, right, left)
    inside = (short >= long[0] - limit) & (short <= long[-1] + limit)
    kept = np.flatnonzero(inside & (np.minimum(after, before) <= limit))
    return (nearest[kept], kept) if is_longer else (kept, nearest[kept])


def _no_overlap(
    estimate: Trajectory, reference: Trajectory, time_s: Array, count: int, offset_s: float
) -> str:
    what = "no poses match" if not count else f"only {count} of its poses match"
    added = f" (with the offset of {offset_s:.12g} s)" if offset_s else ""
    return (
        f"{estimate.name}: {what} in time: it spans {time_s[0]:.3f} to {time_s[-1]:.3f} s{added}, "
        f"the reference {reference.name} {reference.time_s[0]:.3f} to {reference.time_s[-1]:.3f} "
        "s. Check that both are of the same flight; if their clocks differ, give "
        "`time_offset_s` auto."
    )
