"""Evaluation of a trajectory against a reference: ATE and RPE (Sturm 2012) with 95 % intervals.

The absolute trajectory error (ATE) is the distance of each pose to the reference after alignment.
The relative pose error (RPE) compares motions over a fixed distance or time, so drift does not
accumulate in it.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.errors import TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.notebook_display import one_line_repr
from px4fuse.record import OrUnavailable, Record
from px4fuse.text import capitalise_first
from px4fuse.trajectory import scores
from px4fuse.trajectory.alignment import AlignmentKind, Transform, fit_alignment, umeyama
from px4fuse.trajectory.association import Association, Method, associate
from px4fuse.trajectory.model import Trajectory, cumulative_distance
from px4fuse.trajectory.scores import Delta, Interval, RelativeError, Statistics
from px4fuse.trajectory.time_offset import TimeOffset, clock_difference, estimate_time_offset

MAX_SCALE_ERROR = 0.1  # relative scale factor error that is accepted without a warning
MIN_COVERAGE = 0.5  # fraction of poses or time below which a warning is given
MIN_CLOCK_DOUBT_S = 0.1  # smallest time offset with a warning; a filter may lag by less
MAX_SPARSER = 5.0  # ratio of intervals above which estimate and reference seem interchanged

_DOWN, _UP = ("NED", "FRD"), ("ENU",)
_FREE_KINDS = ("slam", "unknown")  # kinds whose frame has no known vertical
_MONO = re.compile(r"(?<![a-z])mono(?![a-z])|monocular", re.IGNORECASE)


class AbsoluteError(Record, frozen=True):
    """ATE of position (m), with the 95 % interval of its RMSE, and of orientation (degrees)."""

    translation_m: Statistics
    interval_m: OrUnavailable[Interval]
    rotation_deg: OrUnavailable[Statistics]


class Score(Record, frozen=True, kw_only=True):
    """ATE and RPE of an estimate against a reference, with alignment and time offset.

    Attributes
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}
    alignment_reason : str
        Reason for this alignment, a sentence.
    transform : Transform
        From the frame of the estimate to that of the reference.
    association : Association
    time_offset : TimeOffset
        ``offset_s`` was added to the timestamps of the estimate.
    ate : AbsoluteError
    rpe : tuple of RelativeError
    notes, warnings : tuple of str
        Sentences.
    """

    alignment: AlignmentKind
    alignment_reason: str
    transform: Transform
    association: Association
    time_offset: TimeOffset
    ate: AbsoluteError
    rpe: tuple[RelativeError, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


class Evaluation(Score, frozen=True, kw_only=True, eq=False):
    """Scores of an estimate against a reference, with the error of each pose.

    Attributes
    ----------
    estimate, reference : Trajectory
        Trajectories as given.
    rpe : tuple of PairwiseError
    time_s : ndarray, shape (n,)
        Times of the compared poses, on the clock of the estimate.
    distance_m : ndarray, shape (n,)
        Distance along the reference, from the first compared pose.
    unaligned_m, estimate_m, reference_m : ndarray, shape (n, 3)
        Positions of the estimate before and after alignment, and of the reference.
    position_error_m : ndarray, shape (n,)
    rotation_error_deg : ndarray, shape (n,), or None
    body_rotation : Rotation or None
        Constant rotation from the body axes of the reference to those of the estimate, which
        rotation errors exclude; None if the body axes are the same.
    """

    schema_type = Score
    rpe: tuple[scores.PairwiseError, ...]
    estimate: Trajectory
    reference: Trajectory
    time_s: Array
    distance_m: Array
    unaligned_m: Array
    estimate_m: Array
    reference_m: Array
    position_error_m: Array
    rotation_error_deg: Array | None
    body_rotation: Rotation | None

    __repr__ = one_line_repr


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    alignment: AlignmentKind | None = None,
    association: Method = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float | Literal["auto"] | None = None,
    rpe_deltas: Sequence[Delta] | None = None,
    all_pairs: bool = True,
) -> Evaluation:
    """Compute ATE and RPE of an estimate against a reference.

    Parameters
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}, optional
        By default chosen by :func:`choose_alignment`.
    association : {"interpolate", "nearest"}
    max_gap_s : float, optional
        See :func:`~px4fuse.trajectory.association.associate`.
    time_offset_s : float, "auto" or None
        Added to the timestamps of the estimate. "auto" estimates the offset from the motion. None
        uses UNIX time if both contain it, else 0; if the two then do not overlap, it acts as
        "auto".
    rpe_deltas : sequence of Delta, optional
        By default distances and times that fit the flight.

    Raises
    ------
    TrajectoryError
        The two do not overlap in time, or the motion does not determine the alignment.
    SettingsError
        A delta is not positive, or not an integer for frames.
    """
    offset, offset_warnings = _time_offset(estimate, reference, time_offset_s)
    added_offset_s = offset.offset_s or 0.0
    x, y, association_found = associate(
        estimate, reference, method=association, max_gap_s=max_gap_s, time_offset_s=added_offset_s
    )
    reason = "Requested alignment."
    if alignment is None:
        alignment, reason = choose_alignment(x, y)
    transform = fit_alignment(x.position_m, y.position_m, alignment)
    aligned = x.moved(transform.apply(x.position_m), transform.rotation)
    body, notes = _body_rotation(aligned, y)
    if body is not None and aligned.rotation is not None:
        aligned = replace(aligned, rotation=aligned.rotation * body)
    distance = cumulative_distance(y.position_m)
    error = np.linalg.norm(aligned.position_m - y.position_m, axis=1)
    both = scores.rotations_of(aligned, y, "ATE of the rotation")
    rotation_error: Array | None = None
    rotation: OrUnavailable[Statistics]
    if isinstance(both, Unavailable):
        rotation = both
    else:
        rotation_error = np.degrees((both[0].inv() * both[1]).magnitude())
        rotation = scores.statistics(rotation_error)
    if rpe_deltas is None:
        rpe_deltas = scores.default_deltas(distance, x.time_s)
    return Evaluation(
        estimate=estimate,
        reference=reference,
        alignment=alignment,
        alignment_reason=reason,
        transform=transform,
        association=association_found,
        time_offset=offset,
        ate=AbsoluteError(scores.statistics(error), scores.rmse_interval(error, "ATE"), rotation),
        rpe=tuple(
            scores.relative_error(aligned, y, delta, all_pairs=all_pairs) for delta in rpe_deltas
        ),
        time_s=x.time_s,
        distance_m=distance,
        unaligned_m=x.position_m,
        estimate_m=aligned.position_m,
        reference_m=y.position_m,
        position_error_m=error,
        rotation_error_deg=rotation_error,
        body_rotation=body,
        notes=notes,
        warnings=(
            *_swap_warnings(estimate, reference),
            *offset_warnings,
            *_comparison_warnings(x, y, association_found, alignment),
        ),
    )


def choose_alignment(estimate: Trajectory, reference: Trajectory) -> tuple[AlignmentKind, str]:
    """Choose the alignment by the kinds of the trajectories; also return the reason, a sentence.

    Ground truth is not aligned. Estimators that use gravity are aligned in yaw and position. SLAM
    is aligned in rotation and position, and in scale if it is monocular or the scale factor error
    exceeds 10 %.

    Parameters
    ----------
    estimate, reference : Trajectory
        Associated: the same number of poses, at the same times.
    """
    same_frame = estimate.frame == reference.frame != "unknown"
    if estimate.kind == "truth" and (same_frame or reference.kind == "truth"):
        return "none", "No alignment: the estimate is ground truth."
    frames = f"{estimate.frame} and {reference.frame}"
    is_upright = any({estimate.frame, reference.frame} <= set(same) for same in (_DOWN, _UP))
    unaligned = [track for track in (estimate, reference) if track.kind in _FREE_KINDS]
    if is_upright and estimate.kind not in _FREE_KINDS:
        return "yaw", (
            f"Yaw and position (4 degrees of freedom): z is vertical in both frames ({frames}), "
            "so a tilt counts as error."
        )
    try:
        scale = fit_alignment(estimate.position_m, reference.position_m, "sim3").scale
    except TrajectoryError:
        if not is_upright:
            raise
        return "yaw", (
            "Yaw and position (4 degrees of freedom): the motion is along a line, and z is "
            f"vertical in both frames ({frames})."
        )
    frame_reason = f"the frames {frames} have no common vertical"
    if unaligned:
        is_slam = unaligned[0].kind == "slam"
        frame_reason = f"{unaligned[0].name} has no known vertical " + (
            "(SLAM: its frame is that of the first key frame)" if is_slam else "(unknown system)"
        )
    monocular = [track.name for track in (estimate, reference) if _MONO.search(track.name)]
    scale_reasons = [f"{name} is monocular by its name" for name in monocular]
    if abs(scale - 1.0) > MAX_SCALE_ERROR:
        scale_reasons.append(
            f"the scale factor {scale:.3g} differs from 1 by more than {MAX_SCALE_ERROR:.0%}"
        )
    if not unaligned or not scale_reasons:
        return "se3", f"Rotation and position (6 degrees of freedom): {frame_reason}."
    return "sim3", (
        f"Rotation, position and scale (7 degrees of freedom): {frame_reason}, and "
        f"{scale_reasons[0]}."
    )


def _time_offset(
    estimate: Trajectory, reference: Trajectory, given_s: float | Literal["auto"] | None
) -> tuple[TimeOffset, list[str]]:
    """Return the offset to add to the timestamps of the estimate, and warnings."""
    if isinstance(given_s, float | int):
        return TimeOffset(offset_s=given_s, is_determinable=True, reason="Requested offset."), []
    clock_offset_s = clock_difference(estimate, reference)
    by_clock = "UNIX time of both clocks" if clock_offset_s else "unchanged timestamps"
    clock_offset = TimeOffset(
        offset_s=clock_offset_s or 0.0,
        is_determinable=True,
        reason=f"{capitalise_first(by_clock)}.",
    )
    start, end = estimate.time_s[[0, -1]] + (clock_offset_s or 0.0)
    no_overlap = start > reference.time_s[-1] or end < reference.time_s[0]
    # the boot clock of a flight log and the clock of a file are unrelated
    unrelated_clocks = clock_offset_s is None and estimate.is_of_log != reference.is_of_log
    is_estimated = given_s == "auto" or no_overlap
    if not (is_estimated or unrelated_clocks):
        return clock_offset, []
    found = estimate_time_offset(estimate, reference)
    if is_estimated:
        if found.is_determinable:
            return found, []
        used = structs.replace(clock_offset, is_determinable=False, reason=found.reason)
        return used, [f"{found.reason} {capitalise_first(by_clock)} used instead."]
    offset, (low, high) = found.offset_s or 0.0, found.interval_s or (0.0, 0.0)
    is_doubtful = not low <= 0.0 <= high and abs(offset) >= MIN_CLOCK_DOUBT_S
    doubt = (
        f"The timestamps are used unchanged, but the motions match best with {offset:+.3f} s added "
        "to the estimate. If the clocks are unrelated, give --time-offset auto."
    )
    return clock_offset, [doubt] if is_doubtful else []


def _swap_warnings(estimate: Trajectory, reference: Trajectory) -> list[str]:
    """Return warnings if estimate and reference seem interchanged."""
    if reference.kind == "truth" != estimate.kind:
        return []
    step, other_step = (float(np.median(np.diff(track.time_s))) for track in (estimate, reference))
    signs = {
        f"{estimate.name} is ground truth and {reference.name} is not": (
            estimate.kind == "truth" != reference.kind
        ),
        f"The reference has a pose every {other_step:.3g} s, the estimate every {step:.3g} s": (
            other_step > MAX_SPARSER * step
        ),
    }
    swap = "Check the order of the arguments: the estimate is the first one."
    return [f"{sign}. {swap}" for sign, holds in signs.items() if holds]


def _comparison_warnings(
    estimate: Trajectory,
    reference: Trajectory,
    association_found: Association,
    alignment: AlignmentKind,
) -> list[str]:
    """Return warnings on low coverage and on a scale factor error."""
    x, y = estimate.position_m, reference.position_m
    # this scale does not depend on a rotation, which the motion may not determine
    scale = umeyama(x, y, with_scale=True).scale
    moves = min(float(np.ptp(position, axis=0).max()) for position in (x, y)) > 0.0
    warnings_by_text = {
        f"Only {association_found.coverage_estimate:.0%} of the poses of the estimate have a "
        f"reference ({association_found.outside} are outside of the time of the reference, "
        f"{association_found.in_gaps} in its gaps).": (
            association_found.coverage_estimate < MIN_COVERAGE
        ),
        f"The estimate covers only {association_found.coverage_reference:.0%} of the reference's "
        "time. Errors without estimate are not counted.": association_found.coverage_reference
        < MIN_COVERAGE,
        f"Scale factor error of the estimate: a factor of {scale:.3g} fits best. The alignment "
        f"({alignment}) does not correct it.": (
            alignment != "sim3" and moves and abs(scale - 1.0) > MAX_SCALE_ERROR
        ),
    }
    return [doubt for doubt, holds in warnings_by_text.items() if holds]


def _body_rotation(
    aligned: Trajectory, reference: Trajectory
) -> tuple[Rotation | None, tuple[str, ...]]:
    """Estimate the constant rotation between different body axes (camera and vehicle)."""
    if aligned.rotation is None or reference.rotation is None:
        return None, ()
    vehicles = (*_DOWN, *_UP)
    axes_differ = (aligned.frame == "camera") != (reference.frame == "camera") or any(
        one.kind == "slam" and other.frame in vehicles and one.frame not in vehicles
        for one, other in ((aligned, reference), (reference, aligned))
    )
    if not axes_differ:
        return None, ()
    # chordal mean (Hartley 2013, section 5.3)
    turn = (aligned.rotation.inv() * reference.rotation).mean()
    return turn, (
        "The body axes differ (camera and vehicle). Rotation errors exclude an estimated constant "
        f"rotation of {np.degrees(turn.magnitude()):.1f}°. The lever arm between camera and "
        "vehicle is part of the position errors.",
    )
