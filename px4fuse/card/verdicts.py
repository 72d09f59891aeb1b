"""Consistency of the σ that KF and EKF2 report.

The ratio of actual to reported σ is √(mean NIS) against the position source, and √(mean NEES)
against ground truth.
"""

import numpy as np

from px4fuse.comparison.comparison import compute_normalised_errors
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison, FilterName, FilterSummary
from px4fuse.core.arrays import Array, rms
from px4fuse.filter.consistency import Reference, classify_sigma_ratio, compute_sigma_ratio_interval
from px4fuse.flight.model import Unavailable

from .model import Verdict

# Length (s) of the bootstrap blocks: longer than the usual correlation time of position errors
BOOTSTRAP_BLOCK_DURATION_S = 10.0
BOOTSTRAP_RESAMPLES = 2000
# Minimum number of bootstrap blocks: with fewer the 95 % interval is far too narrow
MIN_BOOTSTRAP_BLOCKS = 4


def make_sigma_verdicts(result: AxisComparison) -> tuple[Verdict, ...]:
    """Evaluate the consistency of KF and EKF2 along one axis, from innovations and from errors."""
    return tuple(
        assess(result, filter_name)
        for filter_name in FILTER_NAMES
        for assess in (_assess_against_source, _assess_against_truth)
    )


def _assess_against_source(result: AxisComparison, filter_name: FilterName) -> Verdict:
    """Return the verdict from innovations; "not evaluated" if they are not available."""
    summary = result.filters[filter_name]
    if not isinstance(summary, FilterSummary):
        return _make_unevaluated_verdict(filter_name, "source", summary)
    return Verdict(
        filter=filter_name,
        against="source",
        ratio=summary.sigma_ratio,
        interval=compute_sigma_ratio_interval(summary.nis_mean, summary.nis_band),
        word=summary.verdict,
        samples=summary.count,
    )


def _assess_against_truth(result: AxisComparison, filter_name: FilterName) -> Verdict:
    """Return the verdict from errors against ground truth; "not evaluated" if none is available."""
    truth = result.filters[filter_name].truth
    errors = (
        truth if isinstance(truth, Unavailable) else compute_normalised_errors(result, filter_name)
    )
    if isinstance(errors, Unavailable):
        return _make_unevaluated_verdict(filter_name, "truth", errors)
    time_s, normalised_errors = errors
    ratio = rms(normalised_errors)
    interval = block_bootstrap_rms(time_s, normalised_errors)
    return Verdict(
        filter=filter_name,
        against="truth",
        ratio=ratio,
        interval=interval,
        word=classify_sigma_ratio(ratio, "truth", interval),
        samples=len(normalised_errors),
    )


def _make_unevaluated_verdict(
    filter_name: FilterName, reference: Reference, unavailable: Unavailable
) -> Verdict:
    return Verdict(
        filter=filter_name, against=reference, word="not evaluated", reason=unavailable.reason
    )


def block_bootstrap_rms(time_s: Array, values: Array) -> tuple[float, float] | None:
    """Return the 95 % interval of the RMS of correlated values, or None for a short flight.

    Block bootstrap: Künsch (1989), Annals of Statistics 17(3).
    """
    block_count = (
        int((time_s[-1] - time_s[0]) / BOOTSTRAP_BLOCK_DURATION_S) if len(time_s) > 1 else 0
    )
    if block_count < MIN_BOOTSTRAP_BLOCKS:
        return None
    start_indices = np.arange(
        np.searchsorted(time_s, time_s[-1] - BOOTSTRAP_BLOCK_DURATION_S, side="right")
    )
    end_indices = np.searchsorted(time_s, time_s[start_indices] + BOOTSTRAP_BLOCK_DURATION_S)
    cumulative_squares = np.concatenate(([0.0], np.cumsum(np.square(values))))
    block_square_sums = cumulative_squares[end_indices] - cumulative_squares[start_indices]
    drawn_block_indices = np.random.default_rng(0).integers(
        len(start_indices), size=(BOOTSTRAP_RESAMPLES, block_count)
    )
    sample_counts = (end_indices - start_indices)[drawn_block_indices].sum(axis=1)
    mean_squares = block_square_sums[drawn_block_indices].sum(axis=1) / sample_counts
    rms_low, rms_high = np.percentile(np.sqrt(mean_squares), (2.5, 97.5))
    return float(rms_low), float(rms_high)
