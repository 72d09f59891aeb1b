"""The logger stopped for a while."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, times


def _detect(analysis: Analysis) -> Found:
    segment = analysis.segment
    lost = [
        d for d in analysis.flight.log.dropouts
        if d.start_s <= segment.end_s and d.start_s + d.duration_s >= segment.start_s
    ]  # fmt: skip
    if lost:
        total = sum(d.duration_s for d in lost)
        yield Finding(
            "logger_dropouts",
            "warning",
            f"The logger lost data {times(len(lost))}, {total:.2f} s in all, the longest "
            f"{max(d.duration_s for d in lost):.2f} s.",
            "Use a faster SD card, or log less (SDLOG_PROFILE).",
            {"count": float(len(lost)), "total_s": total},
            spans_s=tuple((d.start_s, d.start_s + d.duration_s) for d in lost),
        )


DETECTOR = Detector(
    _detect,
    names={"logger_dropouts": "dropouts of the logger"},
)
