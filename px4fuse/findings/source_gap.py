"""The source stopped for a while."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.comparison import events
from px4fuse.findings.model import Detector, Finding, Found, Threshold, times

GAP = Threshold(events.GAP_S, "s", "ten prediction steps without a measurement")
GAP_INTERVALS = Threshold(events.GAP_INTERVALS, "median intervals", "jitter and single losses pass")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    rate_hz = comparison.source.rate_hz
    gaps = events.source_gaps(comparison.lines[0].measurement_time_s, rate_hz)
    if gaps:
        at, until = max(gaps, key=lambda gap: gap[1] - gap[0])
        yield Finding(
            "source_gap",
            "warning",
            f"The source was silent {times(len(gaps))} for more than "
            f"{max(GAP.value, GAP_INTERVALS.value / rate_hz):.1f} s, the longest time "
            f"{until - at:.1f} s at {at:.1f} s: only the IMU carries the position there.",
            "Check line of sight to the anchors and the link; analyse one side with --start, "
            "--end.",
            {"count": float(len(gaps)), "longest_s": until - at, "at_s": at},
            spans_s=gaps,
        )


DETECTOR = Detector(
    _detect,
    {"source_gap": ("--mistake dropout=2s", "--mistake dropout=8s")},
    names={"source_gap": "a time without positions"},
)
