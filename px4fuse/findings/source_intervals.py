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
from px4fuse.findings.model import Found, finding, info, times, warning
from px4fuse.origin import ALIGNED

LOST_SHARE = 0.02  # of the source's samples; seen: 0 to 0.3 %, and 8 to 9 % in v1.13
MIN_INTERVALS = 50
THINNED_SHARE = 0.25  # of the source's samples: more than a link loses
# What is thinned to a rate alternates between two neighbouring multiples; bursts have multiples
# far apart
NEIGHBOURS = 0.85  # of the intervals
LEAST = 0.1  # of the intervals; single losses pass
# Root mean square distance from whole multiples, of the shorter interval: random ones have 0.29, a
# source's own jitter is 0.03
WHOLE = 0.06
MOST_PARTS = 4


def detect(analysis: Analysis) -> Found:
    """All three."""
    yield from gaps(analysis)
    yield from losses(analysis)
    yield from thinning(analysis)


def gaps(analysis: Analysis) -> Found:
    """The source stopped for a while."""
    rate_hz, sight = analysis.source.rate_hz, "line of sight to the anchors and the link"
    if analysis.source.origin.is_gnss:
        sight = "the antenna's view of the sky, its cable, and what radiates on board"
    silent = source_gaps(analysis.lines[0].measurement_time_s, rate_hz)
    if silent:
        at, until = max(silent, key=lambda gap: gap[1] - gap[0])
        yield warning(
            "source_gap",
            f"The source was silent {times(len(silent))} for more than "
            f"{longest_s(1.0 / rate_hz):.1f} s, the longest time {until - at:.1f} s at {at:.1f} s",
            ": only the IMU carries the position there.",
            f"Check {sight}; analyse one side with --start, --end.",
            {"count": len(silent), "longest_s": until - at, "at_s": at},
            silent,
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
        in_ulog = "; the ULog has what arrived (SDLOG_PROFILE 129)"
        yield info(
            "source_samples_lost",
            f"About {lost / sent:.0%} of {source.name} is not in the recording",
            f" ({lost} samples of {sent} at one per {typical:.2f} s); EKF2 may have received them.",
            "Record on the companion, or on a link that does not lose messages"
            f"{in_ulog if analysis.flight.log.has_ulog else ''}.",
            {"lost": lost, "lost_share": lost / sent},
        )


def thinning(analysis: Analysis) -> Found:
    """Intervals are whole multiples of a shorter one: the source is faster than what arrived."""
    source = analysis.source
    # stamps that were made, or a rate that is the logger's (source_not_logged says so)
    if source.clock_map is not None or source.origin.preference >= ALIGNED.preference:
        return
    intervals, _ = _intervals(analysis)
    found = _base(intervals) if len(intervals) >= MIN_INTERVALS else None
    if found is None:
        return
    base, multiples = found
    lost = 1.0 - 1.0 / float(np.mean(multiples))
    shares = np.bincount(multiples.astype(np.intp)) / len(multiples)
    pairs = shares[:-1] + shares[1:]
    at = int(np.argmax(pairs))
    alternating = pairs[at] >= NEIGHBOURS and shares[at : at + 2].min() >= LEAST
    if lost < THINNED_SHARE or not alternating:
        return
    interval_s = float(np.mean(intervals))
    slow = interval_s > EV_START_INTERVAL_S
    starts = f" EKF2 (v1.14 and later) starts only below {EV_START_INTERVAL_S:g} s apart."
    yield finding(
        "error" if slow else "warning",
        "source_thinned",
        f"{source.name} comes at {1.0 / interval_s:.2g} Hz, at whole multiples of {base:.3g} s",
        f": of a source of {1.0 / base:.2g} Hz {lost:.0%} is missing, thinned on its way or lost."
        f"{starts if slow else ''}",
        "Send every position: raise the rate of the stream at the sender (MAVROS, the bridge, "
        "the link), and do not limit it.",
        {"rate_hz": 1.0 / interval_s, "source_rate_hz": 1.0 / base, "lost_share": lost},
    )


def _intervals(analysis: Analysis) -> tuple[Array, float]:
    """Intervals (s) between positions in the segment but for silences, and their median."""
    intervals = np.diff(within(analysis.source.samples, analysis.segment).index.to_numpy())
    typical = float(np.median(intervals)) if len(intervals) else np.nan
    return intervals[intervals <= longest_s(typical)], typical


def _base(intervals: Array) -> tuple[float, Array] | None:
    """Longest interval of which all are whole multiples, and these; None where there is none."""
    typical = float(np.sort(intervals)[len(intervals) // 2])  # one of them, no mean of two
    for parts in range(1, MOST_PARTS + 1):
        multiples = np.rint(intervals * parts / typical)
        if np.any(multiples < 1.0):
            continue
        base = float(np.sum(intervals) / np.sum(multiples))
        # the first that fits is the longest: a single multiple says that nothing is missing
        if float(np.sqrt(np.mean((intervals / base - multiples) ** 2))) <= WHOLE:
            return base, multiples
    return None
