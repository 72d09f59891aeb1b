"""The source stopped for a while."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, Threshold, times

GAP = Threshold(1.0, "s", "ten prediction steps without a measurement")
GAP_INTERVALS = Threshold(5.0, "median intervals", "jitter and single losses pass")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis.comparison
    measured_s = comparison.axes[0].axis.measurement_time_s
    intervals = np.diff(measured_s)
    limit = max(GAP.value, GAP_INTERVALS.value / comparison.source.rate_hz)
    long = intervals[intervals > limit]
    if len(long):
        starts = measured_s[:-1][intervals > limit]
        at = float(starts[np.argmax(long)])
        yield Finding(
            "source_gap",
            "warning",
            f"The source was silent {times(len(long))} for more than {limit:.1f} s, the longest "
            f"time {long.max():.1f} s at {at:.1f} s: only the IMU carries the position there.",
            "Check line of sight to the anchors and the link; analyse one side with --start, "
            "--end.",
            {"count": float(len(long)), "longest_s": float(long.max()), "at_s": at},
            spans_s=tuple(zip(starts.tolist(), (starts + long).tolist(), strict=True)),
        )


DETECTOR = Detector(
    _detect,
    {
        "source_gap": "gap, position dropout, source dropout, uwb dropout, measurement dropout, "
        "uwb silent, source silent, position silent, uwb missing, position missing, "
        "measurements missing, uwb lost, position lost, uwb stop, no position for, no uwb for",
    },
    {"source_gap": ("--mistake dropout=2s", "--mistake dropout=8s")},
)
