"""The IMU stopped for a while."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import Segment, imu_gaps
from px4fuse.findings.model import MOMENT_S, Found, warning
from px4fuse.flight import sample_rate
from px4fuse.record import Span

IMU_GAP_TOTAL_S = 0.2  # two prediction steps


def detect(analysis: Analysis) -> Found:
    """Missing for longer than two steps of prediction and of the IMU."""
    gap_s = next(iter(analysis.axes.values())).replay.input_gap_s
    imu = analysis.flight.imu
    interval_s = 1.0 / sample_rate(imu) if isinstance(imu, pd.DataFrame) else 0.0
    recorded = analysis.flight.log.format.startswith("MAVLink")
    remedy = "Record where the link loses no messages" if recorded else "Use a faster SD card"
    if gap_s > max(IMU_GAP_TOTAL_S, 2.0 * interval_s):
        yield warning(
            "imu_gap",
            f"The IMU is missing for {gap_s:.2f} s of the segment",
            "; the process noise was raised there to the size of the motion.",
            f"{remedy}, or choose a segment without the gap (--start, --end).",
            {"total_s": gap_s},
            _spans(imu, analysis.segment) if isinstance(imu, pd.DataFrame) else (),
        )


def _spans(imu: pd.DataFrame, segment: Segment) -> tuple[Span, ...]:
    """From when to when the IMU is missing, at the ends of the segment too."""
    time_s = imu.index.to_numpy()
    gap = imu_gaps(time_s)
    missing = list(zip(time_s[:-1][gap].tolist(), time_s[1:][gap].tolist(), strict=True))
    for start, end in ((segment.start_s, float(time_s[0])), (float(time_s[-1]), segment.end_s)):
        if end - start > MOMENT_S:
            missing.append((start, end))
    return tuple(
        sorted(
            (start, end)
            for start, end in missing
            if end > segment.start_s and start < segment.end_s
        )
    )
