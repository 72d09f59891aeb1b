"""Gaps between positions, lost samples, and a downsampled source.

If exactly every second or third sample is kept, the intervals equal those of a slower source; no
log can distinguish the two.
"""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.flight_events import max_interval_s, source_gaps
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.ekf2_not_fusing import EV_START_INTERVAL_S
from px4fuse.findings.model import Findings, finding, format_percent, note, warning
from px4fuse.position_source import ALIGNED

MIN_LOST_SHARE = 0.02  # of the source's samples; flights have 0 to 0.3 %, v1.13 has 8 to 9 %
MIN_INTERVALS = 50
MIN_DOWNSAMPLED_SHARE = 0.25  # of the source's samples; a radio link loses less
# Downsampling to a rate alternates between two neighbouring multiples; lost messages do not
MIN_NEIGHBOURS_SHARE = 0.85  # of the intervals
MIN_MULTIPLE_SHARE = 0.1  # of the intervals; lost samples alone cause a smaller share
# RMS distance from whole multiples, in intervals: 0.29 if random, 0.03 by jitter of a source
MAX_MULTIPLE_RMS = 0.06
MAX_DIVISOR = 4


def detect(analysis: Analysis) -> Findings:
    """Detect gaps, lost samples and downsampling."""
    yield from detect_source_gaps(analysis)
    yield from detect_lost_samples(analysis)
    yield from detect_downsampling(analysis)


def detect_source_gaps(analysis: Analysis) -> Findings:
    """Detect gaps in the position source."""
    rate_hz = analysis.source.rate_hz
    spans = source_gaps(analysis.lines[0].measurement_time_s, rate_hz)
    if spans:
        start_s, end_s = max(spans, key=lambda gap: gap[1] - gap[0])
        check = "line of sight to the anchors and the link"
        if analysis.source.origin.is_gnss:
            check = "the antenna's view of the sky, its cable and radio interference"
        limit_s, count = max_interval_s(1.0 / rate_hz), len(spans)
        number = "one gap" if count == 1 else f"{count} gaps"
        longest = "" if count == 1 else "the longest "
        yield warning(
            "source_gap",
            f"The position source has {number} of more than {limit_s:.1f} s: "
            f"{longest}{end_s - start_s:.1f} s from {start_s:.1f} s. In a gap KF uses the IMU "
            "only, and its error grows.",
            f"Check {check}. Analyse one side of the gap (--start, --end).",
            {"count": count, "longest_s": end_s - start_s, "at_s": start_s},
            spans,
        )


def detect_lost_samples(analysis: Analysis) -> Findings:
    """Detect single samples of a regular source that the recording lacks."""
    source, clock = analysis.source, analysis.source.clock_map
    if clock is None or clock.method == "arrival time" or clock.distinct_stamps is not None:
        return
    intervals, typical_s = _intervals(analysis)
    lost_count = int(np.sum(np.rint(intervals / typical_s) - 1.0))
    sent_count = lost_count + len(intervals)
    if len(intervals) > 1 and lost_count / sent_count > MIN_LOST_SHARE:
        action = "Record on the companion computer or on a link without message loss."
        if analysis.flight.log.has_ulog:
            action += " The ULog contains the samples that PX4 received (SDLOG_PROFILE 129)."
        yield note(
            "source_samples_lost",
            f"About {format_percent(lost_count / sent_count)} of {source.name} is missing from the "
            f"recording ({lost_count} of {sent_count} samples, one per {typical_s:.2f} s). EKF2 "
            "may have received them.",
            action,
            {"lost": lost_count, "lost_fraction": lost_count / sent_count},
        )


def detect_downsampling(analysis: Analysis) -> Findings:
    """Detect intervals that are whole multiples of a shorter one: PX4 did not get all samples."""
    source = analysis.source
    # neither mapped timestamps nor the rate of the logger show the intervals at the receiver
    if source.clock_map is not None or source.origin.preference >= ALIGNED.preference:
        return
    intervals, _ = _intervals(analysis)
    base_and_multiples = _base_interval(intervals) if len(intervals) >= MIN_INTERVALS else None
    if base_and_multiples is None:
        return
    base_s, multiples = base_and_multiples
    lost_share = 1.0 - 1.0 / float(np.mean(multiples))
    shares = np.bincount(multiples.astype(np.intp)) / len(multiples)
    pair_shares = shares[:-1] + shares[1:]
    multiple = int(np.argmax(pair_shares))
    is_alternating = (
        pair_shares[multiple] >= MIN_NEIGHBOURS_SHARE
        and shares[multiple : multiple + 2].min() >= MIN_MULTIPLE_SHARE
    )
    if lost_share < MIN_DOWNSAMPLED_SHARE or not is_alternating:
        return
    interval_s = float(np.mean(intervals))
    is_too_slow = interval_s > EV_START_INTERVAL_S
    message = (
        f"{source.name} arrives at {1.0 / interval_s:.2g} Hz, at whole multiples of {base_s:.3g} "
        f"s. Of a {1.0 / base_s:.2g} Hz source {format_percent(lost_share)} is missing."
    )
    if is_too_slow:
        message += (
            " EKF2 (v1.14 and later) starts fusion only below "
            f"{EV_START_INTERVAL_S:g} s between samples."
        )
    yield finding(
        "error" if is_too_slow else "warning",
        "source_downsampled",
        message,
        "Increase the rate of the stream at the sender (MAVROS, bridge, link) and remove any rate "
        "limit.",
        {"rate_hz": 1.0 / interval_s, "source_rate_hz": 1.0 / base_s, "lost_fraction": lost_share},
    )


def _intervals(analysis: Analysis) -> tuple[Array, float]:
    """Return the intervals (s) between positions in the segment without gaps, and the median."""
    intervals = np.diff(cut_to_segment(analysis.source.samples, analysis.segment).index.to_numpy())
    typical = float(np.median(intervals)) if len(intervals) else np.nan
    return intervals[intervals <= max_interval_s(typical)], typical


def _base_interval(intervals: Array) -> tuple[float, Array] | None:
    """Return the longest base interval (s) and the multiples that the intervals are of it.

    None if the intervals are not whole multiples of one base interval.
    """
    # the upper median is an actual interval, not the mean of two
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
