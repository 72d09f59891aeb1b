"""Scores of a trajectory against a reference: ATE and RPE (Sturm 2012), with intervals.

The absolute trajectory error is the distance of each pose to the reference after alignment; the
relative pose error compares motions over a fixed distance or time, and so does not add up.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.display import one_line_repr
from px4fuse.errors import TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.record import OrUnavailable, Record
from px4fuse.trajectory import scores
from px4fuse.trajectory.alignment import AlignmentKind, Transform, fit_alignment, umeyama
from px4fuse.trajectory.association import Association, Method, associate
from px4fuse.trajectory.model import Trajectory, cumulative_distance
from px4fuse.trajectory.offset import TimeOffset, clock_difference, estimate_time_offset
from px4fuse.trajectory.scores import Delta, Interval, RelativeError, Statistics

MAX_SCALE_ERROR = 0.1
MIN_COVERAGE = 0.5
MIN_CLOCK_DOUBT_S = 0.1  # less than this may be the filter's own lag
MAX_SPARSER = 5.0  # a reference with so much longer intervals is hardly one

_DOWN, _UP = ("NED", "FRD"), ("ENU",)
_FREE_KINDS = ("slam", "unknown")  # whose world may be turned in any way
_MONO = re.compile(r"(?<![a-z])mono(?![a-z])|monocular", re.IGNORECASE)


class AbsoluteError(Record, frozen=True):
    """ATE: of position (m), with its RMSE's interval, and of orientation (degrees)."""

    translation_m: Statistics
    interval_m: OrUnavailable[Interval]
    rotation_deg: OrUnavailable[Statistics]


class Score(Record, frozen=True, kw_only=True):
    """ATE and RPE of an estimate against a reference, and how the two were made comparable.

    Attributes
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}
    alignment_reason : str
        Why this one, a sentence.
    transform : Transform
        From the estimate's world to the reference's.
    association : Association
    time_offset : TimeOffset
        ``offset_s`` is what was added to the estimate's stamps.
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
    """An estimate's scores against a reference, with the error of each pose.

    Attributes
    ----------
    estimate, reference : Trajectory
        As given.
    rpe : tuple of PairwiseError
    time_s : ndarray, shape (n,)
        Of the poses used, on the estimate's clock.
    distance_m : ndarray, shape (n,)
        Along the reference, from its first pose used.
    unaligned_m, estimate_m, reference_m : ndarray, shape (n, 3)
        Positions of the estimate before and after alignment, and of the reference.
    position_error_m : ndarray, shape (n,)
    rotation_error_deg : ndarray, shape (n,), or None
    body_rotation : Rotation or None
        Constant rotation from the reference's body to the estimate's that the rotations were
        freed of; None where both are of the same body.
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
    """Score an estimate against a reference.

    Parameters
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}, optional
        By default what the two are decides, see :func:`choose_alignment`.
    association : {"interpolate", "nearest"}
    max_gap_s : float, optional
        See :func:`~px4fuse.trajectory.association.associate`.
    time_offset_s : float, "auto" or None
        Added to the estimate's stamps, as they are. By default what UNIX time says where both know
        it, else nothing; "auto" finds it from the motion, and so does None where the two would not
        overlap.
    rpe_deltas : sequence of Delta, optional
        By default some distances and times that suit the flight.

    Raises
    ------
    TrajectoryError
        The two do not overlap in time, or the motion does not determine the alignment.
    SettingsError
        A delta is not above zero, or not whole for frames.
    """
    offset, offset_warnings = _time_offset(estimate, reference, time_offset_s)
    added_offset_s = offset.offset_s or 0.0
    x, y, association_found = associate(
        estimate, reference, method=association, max_gap_s=max_gap_s, time_offset_s=added_offset_s
    )
    reason = "As asked for."
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
    """Alignment that suits what the two are, and why, in one sentence.

    Ground truth is compared as it is; estimators that feel gravity may turn about the vertical;
    SLAM may turn in any way, and scale where it is monocular or its scale is more than 10 % off.

    Parameters
    ----------
    estimate, reference : Trajectory
        Associated: as many poses, at the same times.
    """
    same_frame = estimate.frame == reference.frame != "unknown"
    if estimate.kind == "truth" and (same_frame or reference.kind == "truth"):
        return "none", "No alignment, as ground truth is compared as it is."
    frames = f"{estimate.frame} and {reference.frame}"
    is_upright = any({estimate.frame, reference.frame} <= set(same) for same in (_DOWN, _UP))
    unaligned = [one for one in (estimate, reference) if one.kind in _FREE_KINDS]
    if is_upright and estimate.kind not in _FREE_KINDS:
        return "yaw", (
            f"Yaw and position (4 DoF), as z is vertical in both frames ({frames}): a tilt of the "
            "estimate is an error."
        )
    try:
        scale = fit_alignment(estimate.position_m, reference.position_m, "sim3").scale
    except TrajectoryError:
        if not is_upright:
            raise
        return "yaw", (
            f"Yaw and position (4 DoF), as the motion is along a line and z is vertical in "
            f"both frames ({frames})."
        )
    frame_reason = f"as the frames are {frames}, which do not share a vertical"
    if unaligned:
        slam_note = "comes from SLAM, whose world is its first key frame"
        frame_reason = f"as {unaligned[0].name} {slam_note if unaligned[0].kind == 'slam' else 'does not say what made it'}"
    monocular = [one.name for one in (estimate, reference) if _MONO.search(one.name)]
    scale_reasons = [f"{name} says that it is monocular" for name in monocular]
    if abs(scale - 1.0) > MAX_SCALE_ERROR:
        scale_reasons.append(f"the scale is {scale:.3g}, more than {MAX_SCALE_ERROR:.0%} off")
    if not unaligned or not scale_reasons:
        return "se3", f"Rotation and position (6 DoF), {frame_reason}."
    return "sim3", f"Rotation, position and scale (7 DoF), {frame_reason}, and {scale_reasons[0]}."


def _time_offset(
    estimate: Trajectory, reference: Trajectory, given_s: float | Literal["auto"] | None
) -> tuple[TimeOffset, list[str]]:
    """What to add to the estimate's stamps."""
    if isinstance(given_s, float | int):
        return TimeOffset(offset_s=given_s, determinable=True, reason="As asked for."), []
    clock_offset_s = clock_difference(estimate, reference)
    by_clock = "UNIX time of both clocks" if clock_offset_s else "the stamps as they are"
    clock_offset = TimeOffset(
        offset_s=clock_offset_s or 0.0, determinable=True, reason=f"By {by_clock}."
    )
    start, end = estimate.time_s[[0, -1]] + (clock_offset_s or 0.0)
    no_overlap = start > reference.time_s[-1] or end < reference.time_s[0]
    # a flight's boot clock and the clock of a file have nothing to do with each other
    unrelated_clocks = clock_offset_s is None and estimate.is_of_log != reference.is_of_log
    is_estimated = given_s == "auto" or no_overlap
    if not (is_estimated or unrelated_clocks):
        return clock_offset, []
    found = estimate_time_offset(estimate, reference)
    if is_estimated:
        if found.determinable:
            return found, []
        used = structs.replace(clock_offset, determinable=False, reason=found.reason)
        return used, [f"{found.reason} Used {by_clock} instead."]
    offset, (low, high) = found.offset_s or 0.0, found.interval_s or (0.0, 0.0)
    is_doubtful = not low <= 0.0 <= high and abs(offset) >= MIN_CLOCK_DOUBT_S
    doubt = (
        f"The stamps are used as they are, but the motions fit best with {offset:+.3f} s added to "
        "the estimate's: are the two clocks unrelated? Then give --time-offset auto."
    )
    return clock_offset, [doubt] if is_doubtful else []


def _swap_warnings(estimate: Trajectory, reference: Trajectory) -> list[str]:
    """Warnings where the two look interchanged."""
    if reference.kind == "truth" != estimate.kind:
        return []
    step, other_step = (float(np.median(np.diff(one.time_s))) for one in (estimate, reference))
    signs = {
        f"{estimate.name} is ground truth and {reference.name} is not": (
            estimate.kind == "truth" != reference.kind
        ),
        f"The reference has one pose in {other_step:.3g} s, the estimate one in {step:.3g} s": (
            other_step > MAX_SPARSER * step
        ),
    }
    swap = "Are the two interchanged? The estimate comes first."
    return [f"{sign}. {swap}" for sign, holds in signs.items() if holds]


def _comparison_warnings(
    estimate: Trajectory,
    reference: Trajectory,
    association_found: Association,
    alignment: AlignmentKind,
) -> list[str]:
    """Warnings on what was compared."""
    x, y = estimate.position_m, reference.position_m
    # of the spreads: it needs no turn that the motion would have to determine
    scale = umeyama(x, y, with_scale=True).scale
    moves = min(float(np.ptp(one, axis=0).max()) for one in (x, y)) > 0.0
    warnings_by_text = {
        f"Only {association_found.coverage_estimate:.0%} of the estimate's poses have a reference "
        f"({association_found.outside} lie outside its span, {association_found.in_gaps} in its gaps).": (
            association_found.coverage_estimate < MIN_COVERAGE
        ),
        f"The estimate covers only {association_found.coverage_reference:.0%} of the reference's time: "
        "errors where it has no poses do not count.": association_found.coverage_reference
        < MIN_COVERAGE,
        f"The estimate's scale is off: {scale:.3g} times it would fit best, and the alignment "
        f"({alignment}) leaves that in the errors.": (
            alignment != "sim3" and moves and abs(scale - 1.0) > MAX_SCALE_ERROR
        ),
    }
    return [doubt for doubt, holds in warnings_by_text.items() if holds]


def _body_rotation(
    aligned: Trajectory, reference: Trajectory
) -> tuple[Rotation | None, tuple[str, ...]]:
    """Constant rotation between two bodies whose axes differ, as a camera's and a vehicle's do."""
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
        "The axes of the two bodies differ (camera and vehicle): rotation errors are those around "
        f"a constant rotation of {np.degrees(turn.magnitude()):.1f}° between them, which was "
        "estimated; the distance between camera and vehicle is part of the position errors.",
    )
