"""The IMU stopped for a while."""

from __future__ import annotations

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.filter.signals import Segment, imu_gaps
from px4fuse.findings.model import MOMENT_S, Detector, Finding, Found, Threshold
from px4fuse.flight import sample_rate

IMU_GAP_TOTAL = Threshold(0.2, "s", "two prediction steps")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    gap_s = next(iter(comparison.axes.values())).replay.input_gap_s
    imu = comparison.flight.imu
    interval_s = 1.0 / sample_rate(imu) if isinstance(imu, pd.DataFrame) else 0.0
    remedy = (
        "Record where the link loses no messages"
        if comparison.flight.log.format.startswith("MAVLink")
        else "Use a faster SD card"
    )
    if gap_s > max(IMU_GAP_TOTAL.value, 2.0 * interval_s):
        yield Finding(
            "imu_gap",
            "warning",
            f"The IMU is missing for {gap_s:.2f} s of the segment; the process noise was raised "
            "there to the size of the motion.",
            f"{remedy}, or choose a segment without the gap (--start, --end).",
            {"total_s": gap_s},
            spans_s=_spans(imu.index.to_numpy(), comparison.segment)
            if isinstance(imu, pd.DataFrame)
            else (),
        )


def _spans(time_s: Array, segment: Segment) -> tuple[tuple[float, float], ...]:
    """From when to when the IMU is missing, at the ends of the segment too."""
    gap = imu_gaps(time_s)
    spans = np.column_stack([time_s[:-1][gap], time_s[1:][gap]])
    outside = [(segment.start_s, time_s[0]), (time_s[-1], segment.end_s)]
    missing = [*spans.tolist(), *(pair for pair in outside if pair[1] - pair[0] > MOMENT_S)]
    return tuple(
        sorted(
            (float(start), float(end))
            for start, end in missing
            if end > segment.start_s and start < segment.end_s
        )
    )


DETECTOR = Detector(
    _detect,
    {"imu_gap": ("--mistake imu-dropout=1s",)},
    names={"imu_gap": "a gap in the IMU's samples"},
)
