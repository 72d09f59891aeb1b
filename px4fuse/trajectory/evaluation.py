"""Scores of a trajectory against a reference: ATE and RPE (Sturm 2012), with intervals.

The absolute trajectory error is the distance of each pose to the reference after alignment; the
relative pose error compares motions over a fixed distance or time, and so does not add up. Both
are correlated from pose to pose, hence intervals by a bootstrap over blocks.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from scipy.stats import t as student_t

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.flight import Unavailable
from px4fuse.trajectory.alignment import AlignmentKind, Transform, fit, umeyama
from px4fuse.trajectory.association import Association, Method, associate
from px4fuse.trajectory.correlation import autocovariance
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.offset import TimeOffset, clock_difference, estimate_time_offset

Unit = Literal["frames", "m", "s"]
Side = Literal["estimate", "reference"]

RELATIVE_TOLERANCE = 0.1  # of a delta where all pairs are used; evo's default too
# RPE over these, where they are between these shares of the path or of the time
DISTANCES_M = (0.1, 0.5, 1.0, 5.0, 10.0, 50.0, 100.0, 500.0, 1000.0)
TIMES_S = (1.0, 10.0, 60.0)
MAX_DISTANCES, MAX_TIMES = 3, 2
MIN_DELTA_SHARE, MAX_DELTA_SHARE = 1 / 200, 1 / 5
MAX_SCALE_ERROR = 0.1
MIN_COVERAGE = 0.5
MIN_CLOCK_DOUBT_S = 0.1  # less than this may be the filter's own lag
MAX_SPARSER = 5.0  # a reference with so much longer intervals is hardly one

RESAMPLES, SEED, LEVEL = 2000, 20120101, 0.95
BLOCK_TIMES = 3.0  # autocorrelation times in a block
WINDOW_TIMES = 5.0  # and in the window that they are summed over (Sokal 1997)
MIN_BLOCKS = 5.0

_DOWN, _UP = ("NED", "FRD"), ("ENU",)
_MONO = re.compile(r"(?<![a-z])mono(?![a-z])|monocular", re.IGNORECASE)


@dataclass(frozen=True)
class Delta:
    """Distance between the poses of a pair of the RPE: a value and its unit."""

    value: float
    unit: Unit

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


@dataclass(frozen=True)
class Statistics:
    """Of ``count`` errors, all in their unit; ``std`` without Bessel's correction, as evo's."""

    count: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True)
class Interval:
    """95 % interval of an RMSE, by block bootstrap.

    Attributes
    ----------
    low, high : float
    block_length : int
        In errors.
    blocks : float
        Errors over block length: how many independent errors there are, roughly.
    """

    low: float
    high: float
    block_length: int
    blocks: float


@dataclass(frozen=True)
class AbsoluteError:
    """ATE: translation in m, its RMSE's interval, and rotation in degrees."""

    translation: Statistics
    interval: Interval | Unavailable
    rotation: Statistics | Unavailable


@dataclass(frozen=True)
class RelativeError:
    """RPE over one delta.

    Attributes
    ----------
    delta : Delta
    all_pairs : bool
        Pairs start at every pose, else each where the one before ends.
    pairs_from : {"estimate", "reference"}
        Whose path a distance is measured along.
    translation : Statistics or Unavailable
        m.
    interval : Interval or Unavailable
        Of the translation's RMSE.
    rotation : Statistics or Unavailable
        Degrees.
    start, end : ndarray of int, shape (k,)
        Poses of each pair, as indices into the evaluation's arrays.
    translation_error_m, rotation_error_deg : ndarray, shape (k,)
        Empty where unavailable.
    """

    delta: Delta
    all_pairs: bool
    pairs_from: Side
    translation: Statistics | Unavailable
    interval: Interval | Unavailable
    rotation: Statistics | Unavailable
    start: IntArray
    end: IntArray
    translation_error_m: Array
    rotation_error_deg: Array


@dataclass(frozen=True)
class Evaluation:
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
    rpe : tuple of RelativeError
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
    rpe: tuple[RelativeError, ...]
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
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> Evaluation:
    """Score an estimate against a reference.

    Parameters
    ----------
    estimate, reference : Trajectory
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
    all_pairs : bool
    pairs_from : {"estimate", "reference"}
    relative_tolerance : float
        By which a pair may be longer or shorter than its delta, where all pairs are used.

    Returns
    -------
    Evaluation

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
    distance = path_m(y.position_m)
    error = np.linalg.norm(aligned.position_m - y.position_m, axis=1)
    both = _rotations(aligned, y, "ATE of the rotation")
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
        relative_error(
            aligned,
            y,
            delta,
            all_pairs=all_pairs,
            pairs_from=pairs_from,
            relative_tolerance=relative_tolerance,
        )
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


# -- before the scores -----------------------------------------------------------------------------


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
        used = TimeOffset(clocks or 0.0, None, False, found.reason)
        return used, [f"{found.reason} Used {by_clock} instead."]
    if given_s is None:
        used = TimeOffset(clocks or 0.0, None, True, f"By {by_clock}.")
        return used, _clock_doubts(estimate, reference) if unrelated else []
    return TimeOffset(given_s, None, True, "As asked for."), []


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


# -- scores ----------------------------------------------------------------------------------------


def statistics(errors: Array) -> Statistics:
    """Statistics of at least one error.

    Parameters
    ----------
    errors : ndarray, shape (n,)
    """
    return Statistics(
        count=len(errors),
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        std=float(np.std(errors)),
        min=float(np.min(errors)),
        max=float(np.max(errors)),
    )


def path_m(position_m: Array) -> Array:
    """Distance travelled up to each position, shape (n,)."""
    steps = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def default_deltas(distance_m: Array, time_s: Array) -> tuple[Delta, ...]:
    """Distances and times of the RPE that suit a flight.

    Parameters
    ----------
    distance_m, time_s : ndarray, shape (n,)
    """
    length, span = float(distance_m[-1]), float(time_s[-1] - time_s[0])
    # a delta takes more than one pose
    step, interval = float(np.median(np.diff(distance_m))), float(np.median(np.diff(time_s)))
    low, high = max(MIN_DELTA_SHARE * length, 2.0 * step), MAX_DELTA_SHARE * length
    distances = [value for value in DISTANCES_M if low <= value <= high][-MAX_DISTANCES:]
    times = [t for t in TIMES_S if 2.0 * interval <= t <= MAX_DELTA_SHARE * span][-MAX_TIMES:]
    return (*(Delta(value, "m") for value in distances), *(Delta(value, "s") for value in times))


def pairs(
    position_m: Array,
    time_s: Array,
    delta: Delta,
    *,
    all_pairs: bool = True,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> tuple[IntArray, IntArray]:
    """Pairs of poses that are a delta apart.

    Parameters
    ----------
    position_m : ndarray, shape (n, 3)
    time_s : ndarray, shape (n,)
    delta : Delta
        A distance is one along the path.
    all_pairs : bool
        From every pose to the one whose distance from it is nearest to the delta, if within the
        tolerance; else from the end of each pair to the first pose that is at least a delta on.
    relative_tolerance : float
        Of the delta.

    Returns
    -------
    start, end : ndarray of int, shape (k,)

    Raises
    ------
    SettingsError
        The delta is not above zero, or not whole for frames.
    """
    if not (np.isfinite(delta.value) and delta.value > 0.0):
        raise SettingsError(f"RPE delta {delta}: it must be above zero.")
    n = len(time_s)
    if delta.unit == "frames":
        step = int(delta.value)
        if step != delta.value:
            raise SettingsError(f"RPE delta {delta}: frames come whole.")
        start = np.arange(0, max(n - step, 0), 1 if all_pairs else step)
        return start, start + step
    along = path_m(position_m) if delta.unit == "m" else time_s - time_s[0]
    if not all_pairs:
        return _consecutive(np.diff(along), delta.value)
    start = np.arange(n - 1)
    # roundings may put the sum on the other side of one sample
    guess = np.searchsorted(along, along + delta.value)[:-1]
    near = np.clip(guess[:, None] + np.arange(-2, 2), start[:, None] + 1, n - 1)
    miss = np.abs(along[near] - along[start, None] - delta.value)
    best = np.argmin(miss, axis=1)
    # of poses at rest, all equally far, the first
    first = np.searchsorted(along, along[near[start, best]])
    kept = miss[start, best] <= relative_tolerance * delta.value
    return start[kept], np.maximum(first, start + 1)[kept]


def _consecutive(steps: Array, delta: float) -> tuple[IntArray, IntArray]:
    """Pairs end to end, each the shortest of at least a delta."""
    # each pair's sum starts at zero: differences of one running sum would round otherwise
    ends, travelled = [0], 0.0
    for index, step in enumerate(steps.tolist(), 1):
        travelled += step
        if travelled >= delta:
            ends.append(index)
            travelled = 0.0
    every = np.array(ends, dtype=np.intp)
    return every[:-1], every[1:]


def relative_error(
    aligned: Trajectory,
    reference: Trajectory,
    delta: Delta,
    *,
    all_pairs: bool = True,
    pairs_from: Side = "reference",
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> RelativeError:
    """RPE over one delta: E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j), Sturm (2012), eq. 1.

    Parameters
    ----------
    aligned, reference : Trajectory
        P and Q, as many poses at the same times. A similarity other than its scale leaves the
        error as it is.
    delta, all_pairs, relative_tolerance
        See :func:`pairs`.
    pairs_from : {"estimate", "reference"}
        Whose path and times the delta is measured in.
    """
    source = reference if pairs_from == "reference" else aligned
    start, end = pairs(
        source.position_m,
        source.time_s,
        delta,
        all_pairs=all_pairs,
        relative_tolerance=relative_tolerance,
    )
    what = f"RPE over {delta}"
    both = _rotations(aligned, reference, what)
    if not isinstance(both, Unavailable) and not len(start):
        reason = f"no two poses are {delta} apart"
        both = Unavailable(what, reason, "Ask for another delta.")
    if isinstance(both, Unavailable):
        none, empty = np.empty(0, dtype=np.intp), np.empty(0)
        return RelativeError(
            delta, all_pairs, pairs_from, both, both, both, none, none, empty, empty
        )
    p, q = (rotation[start].inv() for rotation in both)
    p_move = p.apply(aligned.position_m[end] - aligned.position_m[start])
    q_move = q.apply(reference.position_m[end] - reference.position_m[start])
    # the outer rotation of E turns its translation but does not change its length
    translation = np.linalg.norm(p_move - q_move, axis=1)
    p_turn, q_turn = p * both[0][end], q * both[1][end]
    rotation = np.degrees((q_turn.inv() * p_turn).magnitude())
    overlap = int(np.median(end - start)) if all_pairs else 1
    return RelativeError(
        delta=delta,
        all_pairs=all_pairs,
        pairs_from=pairs_from,
        translation=statistics(translation),
        interval=rmse_interval(translation, what, min_block=overlap),
        rotation=statistics(rotation),
        start=start,
        end=end,
        translation_error_m=translation,
        rotation_error_deg=rotation,
    )


def _rotations(
    aligned: Trajectory, reference: Trajectory, what: str
) -> tuple[Rotation, Rotation] | Unavailable:
    """Rotations of both, or the reason why what was asked for cannot be had."""
    if aligned.rotation is not None and reference.rotation is not None:
        return aligned.rotation, reference.rotation
    side = "estimate" if aligned.rotation is None else "reference"
    return Unavailable(
        what, f"the {side} has no orientation", "Give a trajectory with orientation."
    )


# -- intervals -------------------------------------------------------------------------------------


def rmse_interval(
    errors: Array, what: str, *, min_block: int = 1, seed: int = SEED, resamples: int = RESAMPLES
) -> Interval | Unavailable:
    """95 % interval of the RMSE of correlated errors: circular block bootstrap.

    Politis & Romano (1992), blocks of three integrated autocorrelation times of the squared errors.
    Percentiles are moved outwards as Student's t would with so many blocks (Hesterberg 2015,
    section 5.3).

    Parameters
    ----------
    errors : ndarray, shape (n,)
        In order of time.
    what : str
        Of which score, for the reason where there is none.
    min_block : int
        Errors of pairs that overlap are correlated over so many.
    seed, resamples : int

    Returns
    -------
    Interval or Unavailable
        Unavailable with fewer than five blocks.
    """
    squares = errors**2
    n = len(squares)
    length = max(int(np.ceil(BLOCK_TIMES * autocorrelation_time(squares))), min_block, 1)
    if n < MIN_BLOCKS * length:
        return Unavailable(
            f"interval of the {what} RMSE",
            f"errors are correlated over {length} of {n}, which leaves fewer than the "
            f"{MIN_BLOCKS:.0f} independent blocks that it takes",
            "A longer flight would give one.",
        )
    sums = np.concatenate(([0.0], np.cumsum(np.concatenate((squares, squares[: length - 1])))))
    block_means = (sums[length:] - sums[:-length]) / length  # one for each start, round the end
    blocks = n / length
    drawn = np.random.default_rng(seed).integers(0, n, (resamples, round(blocks)))
    means = block_means[drawn].mean(axis=1)
    quantile = float(student_t.ppf(0.5 + LEVEL / 2.0, blocks - 1.0))
    tail = float(norm.cdf(-quantile * np.sqrt(blocks / (blocks - 1.0))))
    low, high = np.sqrt(np.maximum(np.quantile(means, [tail, 1.0 - tail]), 0.0))
    return Interval(float(low), float(high), length, blocks)


def autocorrelation_time(values: Array) -> float:
    """Integrated autocorrelation time in samples: 1 + 2 Σ ρ, at least 1.

    The sum ends at five times itself (Sokal 1997, section 3).

    Parameters
    ----------
    values : ndarray, shape (n,)
    """
    centred = values - values.mean()
    if not centred.any():
        return 1.0
    n = len(centred)
    covariance = autocovariance(centred)
    times = 2.0 * np.cumsum(covariance / covariance[0]) - 1.0
    enough = np.flatnonzero(np.arange(n) >= WINDOW_TIMES * times)
    return max(1.0, float(times[enough[0]] if len(enough) else n))
