"""Gaps between positions, lost samples, and a downsampled source.

If exactly every second or third sample is kept, the intervals equal those of a slower source; no
log can distinguish the two.
"""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.flight_events import longest_s, source_gaps
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.ekf2_not_fusing import EV_START_INTERVAL_S
from px4fuse.findings.model import Found, finding, format_percent, note, warning
from px4fuse.position_source import ALIGNED

MIN_LOST_SHARE = 0.02  # of the source's samples; seen: 0 to 0.3 %, and 8 to 9 % in v1.13
MIN_INTERVALS = 50
MIN_DOWNSAMPLED_SHARE = 0.25  # of the source's samples; more than a link loses
# Downsampling to a rate alternates between two neighbouring multiples; bursts of a link do not
MIN_PAIR_SHARE = 0.85  # of the intervals
MIN_MULTIPLE_SHARE = 0.1  # of the intervals; lost samples alone stay below
# RMS distance from whole multiples, in intervals: random ones have 0.29, jitter of a source 0.03
MAX_MULTIPLE_RMS = 0.06
MAX_DIVISOR = 4


def detect(analysis: Analysis) -> Found:
    """Detect gaps, lost samples and downsampling."""
    yield from gaps(analysis)
    yield from losses(analysis)
    yield from downsampling(analysis)


def gaps(analysis: Analysis) -> Found:
    """Detect gaps in the position source."""
    rate_hz = analysis.source.rate_hz
    found = source_gaps(analysis.lines[0].measurement_time_s, rate_hz)
    if found:
        at, until = max(found, key=lambda gap: gap[1] - gap[0])
        check = "line of sight to the anchors and the link"
        if analysis.source.origin.is_gnss:
            check = "the antenna's view of the sky, its cable and radio interference"
        limit_s, count = longest_s(1.0 / rate_hz), len(found)
        number = "one gap" if count == 1 else f"{count} gaps"
        longest = "" if count == 1 else "the longest "
        yield warning(
            "source_gap",
            f"The position source has {number} of more than {limit_s:.1f} s: {longest}"
            f"{until - at:.1f} s from {at:.1f} s. In a gap KF uses the IMU only, and its error "
            "grows.",
            f"Check {check}. Analyse one side of the gap (--start, --end).",
            {"count": count, "longest_s": until - at, "at_s": at},
            found,
        )


def losses(analysis: Analysis) -> Found:
    """Detect single samples of a regular source that the recording lacks."""
    source, clock = analysis.source, analysis.source.clock_map
    if clock is None or clock.method == "arrival time" or clock.distinct_stamps is not None:
        return
    intervals, typical = _intervals(analysis)
    lost = int(np.sum(np.rint(intervals / typical) - 1.0))
    sent = lost + len(intervals)
    if len(intervals) > 1 and lost / sent > MIN_LOST_SHARE:
        action = "Record on the companion computer or on a link without message loss."
        if analysis.flight.log.has_ulog:
            action += " The ULog contains the samples that PX4 received (SDLOG_PROFILE 129)."
        yield note(
            "source_samples_lost",
            f"About {format_percent(lost / sent)} of {source.name} is missing from the recording "
            f"({lost} of {sent} samples, one per {typical:.2f} s). EKF2 may have received them.",
            action,
            {"lost": lost, "lost_fraction": lost / sent},
        )


def downsampling(analysis: Analysis) -> Found:
    """Detect intervals that are whole multiples of a shorter one: PX4 did not get all samples."""
    source = analysis.source
    # mapped timestamps, or the rate of the logger (see source_not_logged), show nothing
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
    alternating = pairs[at] >= MIN_PAIR_SHARE and shares[at : at + 2].min() >= MIN_MULTIPLE_SHARE
    if lost < MIN_DOWNSAMPLED_SHARE or not alternating:
        return
    interval_s = float(np.mean(intervals))
    slow = interval_s > EV_START_INTERVAL_S
    message = (
        f"{source.name} arrives at {1.0 / interval_s:.2g} Hz, at whole multiples of {base:.3g} s. "
        f"Of a {1.0 / base:.2g} Hz source {format_percent(lost)} is missing."
    )
    if slow:
        message += (
            " EKF2 (v1.14 and later) starts fusion only below "
            f"{EV_START_INTERVAL_S:g} s between samples."
        )
    yield finding(
        "error" if slow else "warning",
        "source_downsampled",
        message,
        "Increase the rate of the stream at the sender (MAVROS, bridge, link) and remove any rate "
        "limit.",
        {"rate_hz": 1.0 / interval_s, "source_rate_hz": 1.0 / base, "lost_fraction": lost},
    )


def _intervals(analysis: Analysis) -> tuple[Array, float]:
    """Intervals (s) between positions in the segment without gaps, and their median (s)."""
    intervals = np.diff(cut_to_segment(analysis.source.samples, analysis.segment).index.to_numpy())
    typical = float(np.median(intervals)) if len(intervals) else np.nan
    return intervals[intervals <= longest_s(typical)], typical


def _base_interval(intervals: Array) -> tuple[float, Array] | None:
    """Longest interval (s) of which all are whole multiples, and these; None if there is none."""
    # an actual interval, not the mean of two
    typical = float(np.sort(intervals)[len(intervals) // 2])
    for divisor in range(1, MAX_DIVISOR + 1):
        multiples = np.rint(intervals * divisor / typical)
        if np.any(multiples < 1.0):
            continue
        base = float(np.sum(intervals) / np.sum(multiples))
        # divisors increase, so the first match is the longest interval
        if float(np.sqrt(np.mean((intervals / base - multiples) ** 2))) <= MAX_MULTIPLE_RMS:
            return base, multiples
    return None
