"""What the scores of a trajectory are made of: statistics, pairs of poses, RPE, intervals.

Errors are correlated from pose to pose, so intervals are by a bootstrap over blocks.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, stdtrit

from px4fuse.arrays import Array, IntArray
from px4fuse.display import one_line_repr
from px4fuse.errors import SettingsError
from px4fuse.flight import Unavailable
from px4fuse.record import Count, NotNegative, OrUnavailable, Record, missing_data
from px4fuse.trajectory.correlation import autocovariance
from px4fuse.trajectory.model import Trajectory, cumulative_distance

Unit = Literal["frames", "m", "s"]

RELATIVE_TOLERANCE = 0.1  # of a delta where all pairs are used; evo's default too
# RPE over these, where they are between these shares of the path or of the time
DISTANCES_M = (0.1, 0.5, 1.0, 5.0, 10.0, 50.0, 100.0, 500.0, 1000.0)
TIMES_S = (1.0, 10.0, 60.0)
MAX_DISTANCES, MAX_TIMES = 3, 2
MIN_DELTA_SHARE, MAX_DELTA_SHARE = 1 / 200, 1 / 5
RESAMPLES, SEED, LEVEL = 2000, 20120101, 0.95
BLOCK_TIMES = 3.0  # autocorrelation times in a block
WINDOW_TIMES = 5.0  # and in the window that they are summed over (Sokal 1997)
MIN_BLOCKS = 5.0


@dataclass(frozen=True)
class Delta:
    """Distance between the poses of a pair of the RPE: a value and its unit."""

    value: float
    unit: Unit

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


class Statistics(Record, frozen=True):
    """Of ``count`` errors, all in their unit; ``std`` without Bessel's correction, as evo's."""

    count: Count
    rmse: NotNegative
    mean: float
    median: float
    std: NotNegative
    min: float
    max: float


class Interval(Record, frozen=True):
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
    block_length: Count
    blocks: float


class RelativeError(Record, frozen=True):
    """RPE over pairs that are ``delta`` apart.

    Attributes
    ----------
    delta : float
        In ``unit``.
    all_pairs : bool
        Pairs start at every pose, else each where the one before ends.
    pairs_from : str
        Whose path a distance is measured along: always the reference's, whose length is no error.
    translation_m, rotation_deg : Statistics or Unavailable
    interval_m : Interval or Unavailable
        Of the translation's RMSE.
    """

    delta: float
    unit: Unit
    all_pairs: bool
    pairs_from: Literal["reference"]
    translation_m: OrUnavailable[Statistics]
    interval_m: OrUnavailable[Interval]
    rotation_deg: OrUnavailable[Statistics]

    @property
    def delta_words(self) -> str:
        """How far the poses of a pair are apart."""
        return str(Delta(self.delta, self.unit))


class PairwiseError(RelativeError, frozen=True, kw_only=True, eq=False):
    """RPE over one delta, with its pairs.

    Attributes
    ----------
    start, end : ndarray of int, shape (k,)
        Poses of each pair, as indices into the evaluation's arrays.
    translation_error_m, rotation_error_deg : ndarray, shape (k,)
        Empty where unavailable.
    """

    schema_type = RelativeError
    start: IntArray
    end: IntArray
    translation_error_m: Array
    rotation_error_deg: Array

    __repr__ = one_line_repr


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
) -> tuple[IntArray, IntArray]:
    """Pairs of poses that are a delta apart.

    Parameters
    ----------
    position_m : ndarray, shape (n, 3)
    time_s : ndarray, shape (n,)
    delta : Delta
        A distance is one along the path.
    all_pairs : bool
        From every pose to the one whose distance from it is nearest to the delta, if within a tenth
        of it; else from the end of each pair to the first pose that is at least a delta on.

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
    path_position = cumulative_distance(position_m) if delta.unit == "m" else time_s - time_s[0]
    if not all_pairs:
        return _consecutive_pairs(np.diff(path_position), delta.value)
    start = np.arange(n - 1)
    # roundings may put the sum on the other side of one sample
    nearest_guess = np.searchsorted(path_position, path_position + delta.value)[:-1]
    candidates = np.clip(nearest_guess[:, None] + np.arange(-2, 2), start[:, None] + 1, n - 1)
    distance_error = np.abs(path_position[candidates] - path_position[start, None] - delta.value)
    best = np.argmin(distance_error, axis=1)
    # of poses at rest, all equally far, the first
    first = np.searchsorted(path_position, path_position[candidates[start, best]])
    is_near = distance_error[start, best] <= RELATIVE_TOLERANCE * delta.value
    return start[is_near], np.maximum(first, start + 1)[is_near]


def _consecutive_pairs(steps: Array, delta: float) -> tuple[IntArray, IntArray]:
    """Pairs end to end, each the shortest of at least a delta."""
    # each pair's sum starts at zero: differences of one running sum would round otherwise
    ends, travelled = [0], 0.0
    for index, step in enumerate(steps.tolist(), 1):
        travelled += step
        if travelled >= delta:
            ends.append(index)
            travelled = 0.0
    end_indices = np.array(ends, dtype=np.intp)
    return end_indices[:-1], end_indices[1:]


def relative_error(
    aligned: Trajectory,
    reference: Trajectory,
    delta: Delta,
    *,
    all_pairs: bool = True,
) -> PairwiseError:
    """RPE over one delta: E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j), Sturm (2012), eq. 1.

    Parameters
    ----------
    aligned, reference : Trajectory
        P and Q, as many poses at the same times. A similarity other than its scale leaves the
        error as it is.
    delta, all_pairs
        See :func:`pairs`; measured along the reference.
    """
    start, end = pairs(reference.position_m, reference.time_s, delta, all_pairs=all_pairs)
    what = f"RPE over {delta}"
    rotations = rotations_of(aligned, reference, what)
    if not isinstance(rotations, Unavailable) and not len(start):
        rotations = Unavailable(what, f"no two poses are {delta} apart", "Ask for another delta.")
    scores: tuple[OrUnavailable[Statistics], OrUnavailable[Interval], OrUnavailable[Statistics]]
    if isinstance(rotations, Unavailable):
        start = end = np.empty(0, dtype=np.intp)
        translation = rotation = np.empty(0)
        scores = rotations, rotations, rotations
    else:
        p, q = (one[start].inv() for one in rotations)
        p_move = p.apply(aligned.position_m[end] - aligned.position_m[start])
        q_move = q.apply(reference.position_m[end] - reference.position_m[start])
        # the outer rotation of E turns its translation but does not change its length
        translation = np.linalg.norm(p_move - q_move, axis=1)
        p_turn, q_turn = p * rotations[0][end], q * rotations[1][end]
        rotation = np.degrees((q_turn.inv() * p_turn).magnitude())
        overlap = int(np.median(end - start)) if all_pairs else 1
        interval = rmse_interval(translation, what, min_block=overlap)
        scores = statistics(translation), interval, statistics(rotation)
    return PairwiseError(
        delta.value,
        delta.unit,
        all_pairs,
        "reference",
        *scores,
        start=start,
        end=end,
        translation_error_m=translation,
        rotation_error_deg=rotation,
    )


def rotations_of(
    aligned: Trajectory, reference: Trajectory, what: str
) -> tuple[Rotation, Rotation] | Unavailable:
    """Rotations of both, or the reason why what was asked for is not possible."""
    if aligned.rotation is not None and reference.rotation is not None:
        return aligned.rotation, reference.rotation
    reason = f"the {'estimate' if aligned.rotation is None else 'reference'} has no orientation"
    return Unavailable(what, reason, "Give a trajectory with orientation.")


def rmse_interval(
    errors: Array, what: str, *, min_block: int = 1, resamples: int = RESAMPLES
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

    Returns
    -------
    Interval or Unavailable
        Unavailable with fewer than five blocks.
    """
    squares = errors**2
    n = len(squares)
    length = max(int(np.ceil(BLOCK_TIMES * autocorrelation_time(squares))), min_block, 1)
    if n < MIN_BLOCKS * length:
        return missing_data("rmse_correlated", what=what, length=length, n=n, min_blocks=MIN_BLOCKS)
    sums = np.concatenate(([0.0], np.cumsum(np.concatenate((squares, squares[: length - 1])))))
    block_means = (sums[length:] - sums[:-length]) / length  # one for each start, round the end
    blocks = n / length
    block_starts = np.random.default_rng(SEED).integers(0, n, (resamples, round(blocks)))
    means = block_means[block_starts].mean(axis=1)
    quantile = float(stdtrit(blocks - 1.0, 0.5 + LEVEL / 2.0))
    tail = float(ndtr(-quantile * np.sqrt(blocks / (blocks - 1.0))))
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
