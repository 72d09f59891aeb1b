"""What the intervals between positions show: silence, single losses, and a thinned source.

Where exactly every second or third sample was kept, the intervals are as regular as those of a
slower source, and no log can tell the two apart.
"""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.events import longest_s, source_gaps
from px4fuse.filter.signals import within
from px4fuse.findings.ekf2_not_fusing import EV_START_INTERVAL_S
from px4fuse.findings.model import Found, finding, format_count, info, warning
from px4fuse.origin import ALIGNED

LOST_SHARE = 0.02  # of the source's samples; seen: 0 to 0.3 %, and 8 to 9 % in v1.13
MIN_INTERVALS = 50
THINNED_SHARE = 0.25  # of the source's samples: more than a link loses
# What is thinned to a rate alternates between two neighbouring multiples; bursts have multiples
# far apart
MIN_PAIR_SHARE = 0.85  # of the intervals
MIN_SHARE = 0.1  # of the intervals; single losses pass
# Root mean square distance from whole multiples, of the shorter interval: random ones have 0.29, a
# source's own jitter is 0.03
MAX_MULTIPLE_RMS = 0.06
MAX_DIVISOR = 4


def detect(analysis: Analysis) -> Found:
    """All three."""
    yield from gaps(analysis)
    yield from losses(analysis)
    yield from downsampling(analysis)


def gaps(analysis: Analysis) -> Found:
    """The source stopped for a while."""
    rate_hz = analysis.source.rate_hz
    silent = source_gaps(analysis.lines[0].measurement_time_s, rate_hz)
    if silent:
        at, until = max(silent, key=lambda gap: gap[1] - gap[0])
        yield warning(
            "source_gap",
            {"count": len(silent), "longest_s": until - at, "at_s": at},
            silent,
            often=format_count(len(silent)),
            usual_s=longest_s(1.0 / rate_hz),
            gnss=analysis.source.origin.is_gnss,
        )


def losses(analysis: Analysis) -> Found:
    """The recording lacks single samples of a regular source."""
    source, clock = analysis.source, analysis.source.clock_map
    if clock is None or clock.method == "arrival time" or clock.distinct_stamps is not None:
        return
    intervals, typical = _intervals(analysis)
    lost = int(np.sum(np.rint(intervals / typical) - 1.0))
    sent = lost + len(intervals)
    if len(intervals) > 1 and lost / sent > LOST_SHARE:
        yield info(
            "source_samples_lost",
            {"lost": lost, "lost_share": lost / sent},
            source=source.name,
            sent=sent,
            typical_s=typical,
            in_ulog=analysis.flight.log.has_ulog,
        )


def downsampling(analysis: Analysis) -> Found:
    """Intervals are whole multiples of a shorter one: the source is faster than what arrived."""
    source = analysis.source
    # stamps that were made, or a rate that is the logger's (source_not_logged says so)
    if source.clock_map is not None or source.origin.preference >= ALIGNED.preference:
        return
    intervals, _ = _intervals(analysis)
    found = _base_interval(intervals) if len(intervals) >= MIN_INTERVALS else None
    if found is None:
        return
    base, multiples = found
    lost = 1.0 - 1.0 / float(np.mean(multiples))
    shares = np.bincount(multiples.astype(np.intp)) / len(multiples)
    pairs = shares[:-1] + shares[1:]
    at = int(np.argmax(pairs))
    alternating = pairs[at] >= MIN_PAIR_SHARE and shares[at : at + 2].min() >= MIN_SHARE
    if lost < THINNED_SHARE or not alternating:
        return
    interval_s = float(np.mean(intervals))
    slow = interval_s > EV_START_INTERVAL_S
    yield finding(
        "error" if slow else "warning",
        "source_thinned",
        {"rate_hz": 1.0 / interval_s, "source_rate_hz": 1.0 / base, "lost_share": lost},
        source=source.name,
        base_s=base,
        starts=slow,
        least_s=EV_START_INTERVAL_S,
    )


def _intervals(analysis: Analysis) -> tuple[Array, float]:
    """Intervals (s) between positions in the segment but for silences, and their median."""
    intervals = np.diff(within(analysis.source.samples, analysis.segment).index.to_numpy())
    typical = float(np.median(intervals)) if len(intervals) else np.nan
    return intervals[intervals <= longest_s(typical)], typical


def _base_interval(intervals: Array) -> tuple[float, Array] | None:
    """Longest interval of which all are whole multiples, and these; None where there is none."""
    typical = float(np.sort(intervals)[len(intervals) // 2])  # one of them, no mean of two
    for divisor in range(1, MAX_DIVISOR + 1):
        multiples = np.rint(intervals * divisor / typical)
        if np.any(multiples < 1.0):
            continue
        base = float(np.sum(intervals) / np.sum(multiples))
        # the first that fits is the longest: a single multiple says that nothing is missing
        if float(np.sqrt(np.mean((intervals / base - multiples) ** 2))) <= MAX_MULTIPLE_RMS:
            return base, multiples
    return None
