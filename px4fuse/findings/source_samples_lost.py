"""The recording lacks single samples of a regular source."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import within
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_gap import GAP, GAP_INTERVALS

LOST_SHARE = Threshold(0.02, "of the source's samples", "seen: 0 to 0.3 %, and 8 to 9 % in v1.13")


def _detect(analysis: Analysis) -> Found:
    source = analysis.source
    if source.clock_map is None or source.clock_map.method == "arrival time":
        return
    intervals = np.diff(within(source.samples, analysis.segment).index.to_numpy())
    if len(intervals) < 2 or source.clock_map.distinct_stamps is not None:
        return
    typical = float(np.median(intervals))
    short = intervals[intervals <= max(GAP.value, GAP_INTERVALS.value * typical)]
    lost = int(np.sum(np.rint(short / typical) - 1.0))
    share = lost / (lost + len(short))
    if share > LOST_SHARE.value:
        yield Finding(
            "source_samples_lost",
            "info",
            f"About {share:.0%} of {source.name} is not in the recording ({lost} samples of "
            f"{lost + len(short)} at one per {typical:.2f} s); EKF2 may have received them.",
            "Record on the companion, or on a link that does not lose messages"
            + (
                "; the ULog has what arrived (SDLOG_PROFILE 129)."
                if analysis.flight.log.has_ulog
                else "."
            ),
            {"lost": float(lost), "lost_share": share},
        )


DETECTOR = Detector(
    _detect,
    names={"source_samples_lost": "positions lost on the way"},
)
