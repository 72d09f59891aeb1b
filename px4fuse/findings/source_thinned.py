"""The source is faster than what arrived: intervals are whole multiples of a shorter one.

Where exactly every second or third sample was kept, the intervals are as regular as those of a
slower source, and no log can tell the two apart.
"""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.filter.signals import within
from px4fuse.findings.ekf2_not_fusing import EV_START_INTERVAL
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_gap import GAP, GAP_INTERVALS
from px4fuse.origin import ALIGNED

MIN_INTERVALS = 50
THINNED_SHARE = Threshold(0.25, "of the source's samples", "more than a link loses")
# What is thinned to a rate alternates between two neighbouring multiples
NEIGHBOURS = Threshold(0.85, "of the intervals", "bursts have multiples far apart")
LEAST = Threshold(0.1, "of the intervals", "single losses pass")
# Of an interval from a whole multiple, root mean square: random ones have 0.29
WHOLE = Threshold(0.06, "of the shorter interval", "a source's own jitter is 0.03")
MOST_PARTS = 4
STARTS_ONLY = f"EKF2 (v1.14 and later) starts only below {EV_START_INTERVAL.value:g} s apart."


def _base(intervals: Array) -> tuple[float, Array] | None:
    """Longest interval of which all are whole multiples, and these; None where there is none."""
    typical = float(np.sort(intervals)[len(intervals) // 2])  # one of them, no mean of two
    for parts in range(1, MOST_PARTS + 1):
        multiples = np.rint(intervals * parts / typical)
        if np.any(multiples < 1.0):
            continue
        base = float(np.sum(intervals) / np.sum(multiples))
        rest = intervals / base - multiples
        if float(np.sqrt(np.mean(rest**2))) > WHOLE.value:
            continue
        # the first that fits is the longest: a single multiple says that nothing is missing
        return base, multiples
    return None


def _detect(analysis: Analysis) -> Found:
    source = analysis.source
    # stamps that were made, or a rate that is the logger's (source_not_logged says so)
    if source.clock_map is not None or source.origin.preference >= ALIGNED.preference:
        return
    intervals = np.diff(within(source.samples, analysis.segment).index.to_numpy())
    if len(intervals) < MIN_INTERVALS:
        return
    typical = float(np.median(intervals))
    intervals = intervals[intervals <= max(GAP.value, GAP_INTERVALS.value * typical)]
    found = _base(intervals)
    if found is None:
        return
    base, multiples = found
    lost = 1.0 - 1.0 / float(np.mean(multiples))
    shares = np.bincount(multiples.astype(np.intp)) / len(multiples)
    pairs = shares[:-1] + shares[1:]
    at = int(np.argmax(pairs))
    alternating = pairs[at] >= NEIGHBOURS.value and shares[at : at + 2].min() >= LEAST.value
    if lost < THINNED_SHARE.value or not alternating:
        return
    rate = 1.0 / float(np.mean(intervals))
    slow = 1.0 / rate > EV_START_INTERVAL.value
    yield Finding(
        "source_thinned",
        "error" if slow else "warning",
        f"{source.name} comes at {rate:.2g} Hz, at whole multiples of {base:.3g} s: of a source of "
        f"{1.0 / base:.2g} Hz {lost:.0%} is missing, thinned on its way or lost."
        + (f" {STARTS_ONLY}" if slow else ""),
        "Send every position: raise the rate of the stream at the sender (MAVROS, the bridge, "
        "the link), and do not limit it.",
        {"rate_hz": rate, "source_rate_hz": 1.0 / base, "lost_share": lost},
    )


DETECTOR = Detector(
    _detect,
    {"source_thinned": tuple(f"--mistake decimate={rate}" for rate in ("2Hz", "3Hz", "2.5Hz"))},
    names={"source_thinned": "positions that were thinned before they were sent"},
)
