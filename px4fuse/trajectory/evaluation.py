"""Scores of a trajectory against a reference: ATE and RPE (Sturm 2012), with intervals.

The absolute trajectory error is the distance of each pose to the reference after alignment; the
relative pose error compares motions over a fixed distance or time, and so does not add up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.display import Shown
from px4fuse.errors import TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.record import Maybe, Record
from px4fuse.trajectory.alignment import AlignmentKind, Transform, fit, umeyama
from px4fuse.trajectory.association import Association, Method, associate
from px4fuse.trajectory.model import Trajectory, cumulative_distance
from px4fuse.trajectory.offset import TimeOffset, clock_difference, estimate_time_offset
from px4fuse.trajectory.scores import (
    Delta,
    Interval,
    PairwiseError,
    Side,
    Statistics,
    default_deltas,
    relative_error,
    rmse_interval,
    rotations_of,
    statistics,
)

MAX_SCALE_ERROR = 0.1
MIN_COVERAGE = 0.5
MIN_CLOCK_DOUBT_S = 0.1  # less than this may be the filter's own lag
MAX_SPARSER = 5.0  # a reference with so much longer intervals is hardly one

_DOWN, _UP = ("NED", "FRD"), ("ENU",)
_MONO = re.compile(r"(?<![a-z])mono(?![a-z])|monocular", re.IGNORECASE)


class AbsoluteError(Record, frozen=True):
    """ATE: of position (m), with its RMSE's interval, and of orientation (degrees)."""

    translation_m: Statistics
    interval_m: Maybe[Interval]
    rotation_deg: Maybe[Statistics]


@dataclass(frozen=True, repr=False)
class Evaluation(Shown):
    """An estimate's scores against a reference.

    Attributes
    ----------
    estimate, reference : Trajectory
        As given.
    alignment : {"none", "yaw", "se3", "sim3"}
    alignment_reason : str
        Why this one, a sentence.
    transform : Transform
        From the estimate's world to the reference's.
    association : Association
    time_offset : TimeOffset
        ``offset_s`` is what was added to the estimate's stamps.
    ate : AbsoluteError
    rpe : tuple of PairwiseError
    time_s : ndarray, shape (n,)
        Of the poses used, on the estimate's clock.
    distance_m : ndarray, shape (n,)
        Along the reference, from its first pose used.
    estimate_m, reference_m : ndarray, shape (n, 3)
        Positions of the aligned estimate, and of the reference.
    position_error_m : ndarray, shape (n,)
    rotation_error_deg : ndarray, shape (n,), or None
    body_rotation : Rotation or None
        Constant rotation from the reference's body to the estimate's that the rotations were
        freed of; None where both are of the same body.
    notes, warnings : tuple of str
        Sentences.
    """

    estimate: Trajectory
    reference: Trajectory
    alignment: AlignmentKind
    alignment_reason: str
    transform: Transform
    association: Association
    time_offset: TimeOffset
    ate: AbsoluteError
    rpe: tuple[PairwiseError, ...]
    time_s: Array
    distance_m: Array
    estimate_m: Array
    reference_m: Array
    position_error_m: Array
    rotation_error_deg: Array | None
    body_rotation: Rotation | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


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
    pairs_from: Side = "reference",
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
    pairs_from : {"estimate", "reference"}

    Raises
    ------
    TrajectoryError
        The two do not overlap in time, or the motion does not determine the alignment.
    SettingsError
        A delta is not above zero, or not whole for frames.
    """
    warnings = _swapped(estimate, reference)
    offset, offset_warnings = _time_offset(estimate, reference, time_offset_s)
    matched = associate(
        estimate,
        reference,
        method=association,
        max_gap_s=max_gap_s,
        time_offset_s=offset.offset_s or 0.0,
    )
    x, y = matched.estimate, matched.reference
    if alignment is None:
        alignment, reason = choose_alignment(x, y)
    else:
        reason = "As asked for."
    transform = fit(x.position_m, y.position_m, alignment)
    aligned = replace(
        x,
        position_m=transform.apply(x.position_m),
        rotation=None if x.rotation is None else transform.rotation * x.rotation,
    )
    body, notes = _body_rotation(aligned, y)
    if body is not None and aligned.rotation is not None:
        aligned = replace(aligned, rotation=aligned.rotation * body)
    distance = cumulative_distance(y.position_m)
    error = np.linalg.norm(aligned.position_m - y.position_m, axis=1)
    both = rotations_of(aligned, y, "ATE of the rotation")
    rotation_error: Array | None = None
    rotation_statistics: Statistics | Unavailable
    if isinstance(both, Unavailable):
        rotation_statistics = both
    else:
        rotation_error = np.degrees((both[0].inv() * both[1]).magnitude())
        rotation_statistics = statistics(rotation_error)
    ate = AbsoluteError(statistics(error), rmse_interval(error, "ATE"), rotation_statistics)
    if rpe_deltas is None:
        rpe_deltas = default_deltas(distance, x.time_s)
    rpe = tuple(
        relative_error(aligned, y, delta, all_pairs=all_pairs, pairs_from=pairs_from)
        for delta in rpe_deltas
    )
    return Evaluation(
        estimate=estimate,
        reference=reference,
        alignment=alignment,
        alignment_reason=reason,
        transform=transform,
        association=matched,
        time_offset=offset,
        ate=ate,
        rpe=rpe,
        time_s=x.time_s,
        distance_m=distance,
        estimate_m=aligned.position_m,
        reference_m=y.position_m,
        position_error_m=error,
        rotation_error_deg=rotation_error,
        body_rotation=body,
        notes=notes,
        warnings=(*warnings, *offset_warnings, *_doubts(matched, alignment)),
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
    both = (estimate.kind, reference.kind)
    is_same = estimate.frame == reference.frame != "unknown" or reference.kind == "truth"
    if estimate.kind == "truth" and is_same:
        return "none", "No alignment, as ground truth is compared as it is."
    frames = f"{estimate.frame} and {reference.frame}"
    is_upright = any({estimate.frame, reference.frame} <= set(same) for same in (_DOWN, _UP))
    if is_upright and not {"slam", "unknown"} & {estimate.kind}:
        return "yaw", (
            f"Yaw and position (4 DoF), as z is vertical in both frames ({frames}): a tilt of the "
            "estimate is an error."
        )
    is_metric = not {"slam", "unknown"} & set(both)
    name = next((one.name for one in (estimate, reference) if _MONO.search(one.name)), "")
    why = f"as the frames are {frames}, which do not share a vertical"
    if not is_metric:
        who = estimate if estimate.kind in ("slam", "unknown") else reference
        what = "comes from SLAM, whose world is its first key frame"
        why = f"as {who.name} {what if who.kind == 'slam' else 'does not say what made it'}"
    try:
        scale = fit(estimate.position_m, reference.position_m, "sim3").scale
    except TrajectoryError:
        if is_upright:
            return "yaw", (
                f"Yaw and position (4 DoF), as the motion is along a line and z is vertical in "
                f"both frames ({frames})."
            )
        raise
    if is_metric or (not name and abs(scale - 1.0) <= MAX_SCALE_ERROR):
        return "se3", f"Rotation and position (6 DoF), {why}."
    because = (
        f"{name} says that it is monocular"
        if name
        else f"the scale is {scale:.3g}, more than {MAX_SCALE_ERROR:.0%} off"
    )
    return "sim3", f"Rotation, position and scale (7 DoF), {why}, and {because}."


def _time_offset(
    estimate: Trajectory, reference: Trajectory, given_s: float | Literal["auto"] | None
) -> tuple[TimeOffset, list[str]]:
    """What to add to the estimate's stamps."""
    clocks = clock_difference(estimate, reference)
    by_clock = "the stamps as they are" if clocks in (None, 0.0) else "UNIX time of both clocks"
    start, end = estimate.time_s[[0, -1]] + (clocks or 0.0)
    apart = start > reference.time_s[-1] or end < reference.time_s[0]
    # a flight's boot clock and the clock of a file have nothing to do with each other
    unrelated = clocks is None and estimate.of_log != reference.of_log
    if given_s == "auto" or (given_s is None and apart):
        found = estimate_time_offset(estimate, reference)
        if found.determinable:
            return found, []
        used = TimeOffset(offset_s=clocks or 0.0, determinable=False, reason=found.reason)
        return used, [f"{found.reason} Used {by_clock} instead."]
    if given_s is None:
        used = TimeOffset(offset_s=clocks or 0.0, determinable=True, reason=f"By {by_clock}.")
        return used, _clock_doubts(estimate, reference) if unrelated else []
    return TimeOffset(offset_s=given_s, determinable=True, reason="As asked for."), []


def _clock_doubts(estimate: Trajectory, reference: Trajectory) -> list[str]:
    """A warning where two clocks that may be unrelated agree with other stamps than given."""
    found = estimate_time_offset(estimate, reference)
    if found.interval_s is None or found.offset_s is None:
        return []
    low, high = found.interval_s
    if low <= 0.0 <= high or abs(found.offset_s) < MIN_CLOCK_DOUBT_S:
        return []
    return [
        f"The stamps are used as they are, but the motions fit best with {found.offset_s:+.3f} s "
        "added to the estimate's: are the two clocks unrelated? Then give --time-offset auto."
    ]


def _swapped(estimate: Trajectory, reference: Trajectory) -> list[str]:
    """Warnings where the two look interchanged."""
    swap = "Are the two interchanged? The estimate comes first."
    warnings: list[str] = []
    if reference.kind == "truth" and estimate.kind != "truth":
        return warnings
    if estimate.kind == "truth" and reference.kind != "truth":
        warnings.append(f"{estimate.name} is ground truth and {reference.name} is not. {swap}")
    steps = [float(np.median(np.diff(one.time_s))) for one in (estimate, reference)]
    spans = [float(one.time_s[-1] - one.time_s[0]) for one in (estimate, reference)]
    if steps[1] > MAX_SPARSER * steps[0]:
        warnings.append(
            f"The reference has one pose in {steps[1]:.3g} s, the estimate one in {steps[0]:.3g} "
            f"s. {swap}"
        )
    if spans[1] < MIN_COVERAGE * spans[0]:
        warnings.append(
            f"The reference lasts {spans[1]:.1f} s, the estimate {spans[0]:.1f} s. {swap}"
        )
    return warnings


def _doubts(matched: Association, alignment: AlignmentKind) -> list[str]:
    """Warnings on what was compared."""
    warnings = []
    if matched.coverage_estimate < MIN_COVERAGE:
        warnings.append(
            f"Only {matched.coverage_estimate:.0%} of the estimate's poses have a reference "
            f"({matched.outside} lie outside its span, {matched.in_gaps} in its gaps)."
        )
    if matched.coverage_reference < MIN_COVERAGE:
        warnings.append(
            f"The estimate covers only {matched.coverage_reference:.0%} of the reference's time: "
            "errors where it has no poses do not count."
        )
    x, y = matched.estimate.position_m, matched.reference.position_m
    if alignment != "sim3":
        # of the spreads: it needs no turn that the motion would have to determine
        spreads = [float(np.sqrt(one.var(axis=0).sum())) for one in (x, y)]
        scale = umeyama(x, y, with_scale=True).scale
        if min(spreads) > 0.0 and abs(scale - 1.0) > MAX_SCALE_ERROR:
            warnings.append(
                f"The estimate's scale is off: {scale:.3g} times it would fit best, and the "
                f"alignment ({alignment}) leaves that in the errors."
            )
    return warnings


def _body_rotation(
    aligned: Trajectory, reference: Trajectory
) -> tuple[Rotation | None, tuple[str, ...]]:
    """Constant rotation between two bodies whose axes differ, as a camera's and a vehicle's do."""
    if aligned.rotation is None or reference.rotation is None:
        return None, ()
    is_camera = [one.frame == "camera" for one in (aligned, reference)]
    is_vehicle = [one.frame in (*_DOWN, *_UP) for one in (aligned, reference)]
    is_slam = [one.kind == "slam" for one in (aligned, reference)]
    differ = is_camera[0] != is_camera[1] or any(
        is_slam[i] and is_vehicle[1 - i] and not is_vehicle[i] for i in (0, 1)
    )
    if not differ:
        return None, ()
    # chordal mean (Hartley 2013, section 5.3)
    turn = (aligned.rotation.inv() * reference.rotation).mean()
    return turn, (
        "The axes of the two bodies differ (camera and vehicle): rotation errors are those around "
        f"a constant rotation of {np.degrees(turn.magnitude()):.1f}° between them, which was "
        "estimated; the distance between camera and vehicle is part of the position errors.",
    )
