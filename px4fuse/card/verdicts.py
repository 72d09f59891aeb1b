"""Ratios of actual to reported uncertainty, and the verdicts on them.

Against the source the ratio is √(mean NIS) over the innovations of the segment. Against ground
truth it is √(mean NEES) at the times of EKF2's published position.
"""

import numpy as np

from px4fuse.arrays import Array
from px4fuse.card.model import FilterName, Verdict
from px4fuse.comparison.comparison import normalised_position_errors
from px4fuse.comparison.model import AxisComparison, FilterSummary
from px4fuse.filter.consistency import (
    Reference,
    classify_ratio,
    ratio_interval,
)
from px4fuse.flight import Unavailable

# Length (s) of the blocks of the bootstrap: position errors are correlated over seconds
BLOCK_S = 10.0
DRAWS = 2000
# Minimum number of blocks for an interval of the RMS; with fewer it is far too narrow
MIN_BLOCKS = 4


def verdicts(result: AxisComparison) -> tuple[Verdict, ...]:
    """Return the verdicts along one axis: KF and EKF2, each against source and ground truth."""
    return tuple(
        verdict
        for owner in ("kf", "ekf2")
        for verdict in (_against_source(result, owner), _against_truth(result, owner))
    )


def _against_source(result: AxisComparison, owner: FilterName) -> Verdict:
    statement = result.filters[owner]
    if not isinstance(statement, FilterSummary):
        return _not_evaluated(owner, "source", statement)
    ratio = statement.sigma_ratio
    interval = ratio_interval(statement.nis_mean, statement.nis_band)
    return Verdict(
        filter=owner,
        against="source",
        ratio=ratio,
        interval=interval,
        word=statement.verdict,
        samples=statement.count,
    )


def _against_truth(result: AxisComparison, owner: FilterName) -> Verdict:
    truth = result.filters[owner].truth
    if isinstance(truth, Unavailable):
        return _not_evaluated(owner, "truth", truth)
    errors = normalised_position_errors(result, owner)
    if isinstance(errors, Unavailable):
        return _not_evaluated(owner, "truth", errors)
    time_s, normalised = errors
    ratio = float(np.sqrt(np.mean(np.square(normalised))))
    interval = block_bootstrap_rms(time_s, normalised)
    return Verdict(
        filter=owner,
        against="truth",
        ratio=ratio,
        interval=interval,
        word=classify_ratio(ratio, "truth", interval),
        samples=len(normalised),
    )


def _not_evaluated(owner: FilterName, against: Reference, missing: Unavailable) -> Verdict:
    return Verdict(filter=owner, against=against, word="not evaluated", reason=missing.reason)


def block_bootstrap_rms(time_s: Array, values: Array) -> tuple[float, float] | None:
    """Return the 95 % interval of an RMS by the moving-block bootstrap, or None if too short.

    Künsch (1989), Annals of Statistics 17(3). Blocks have :data:`BLOCK_S` seconds; the seed is
    fixed, so that a report can be made again.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Increasing.
    values : ndarray, shape (n,)
    """
    blocks = int((time_s[-1] - time_s[0]) / BLOCK_S) if len(time_s) > 1 else 0
    if blocks < MIN_BLOCKS:
        return None
    starts = np.arange(np.searchsorted(time_s, time_s[-1] - BLOCK_S, side="right"))
    ends = np.searchsorted(time_s, time_s[starts] + BLOCK_S)
    sums = np.concatenate(([0.0], np.cumsum(np.square(values))))
    drawn = np.random.default_rng(0).integers(len(starts), size=(DRAWS, blocks))
    total = (sums[ends] - sums[starts])[drawn].sum(axis=1)
    count = (ends - starts)[drawn].sum(axis=1)
    low, high = np.percentile(np.sqrt(total / count), (2.5, 97.5))
    return float(low), float(high)
