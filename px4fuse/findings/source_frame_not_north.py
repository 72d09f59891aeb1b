"""The source's x axis is not north."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.ekf2_not_fusing import FUSING_SHARE_ERROR
from px4fuse.findings.model import Detector, Finding, Found, step_share
from px4fuse.flight import Ekf2, Unavailable


def _detect(analysis: Analysis) -> Found:
    comparison = analysis.comparison
    ekf2 = comparison.flight.ekf2
    if comparison.source.frame != "FRD":
        return
    aligned = False
    if isinstance(ekf2, Ekf2) and isinstance(ekf2.fusing, Unavailable):
        yield Finding(
            "source_frame_not_north",
            "info",
            "The source's frame is FRD: its x axis is where the vehicle pointed at start, not "
            "north. Whether EKF2 fused its yaw, so that the frames are the same, is not in this "
            "recording.",
            "Read 'north' as the source's x axis"
            + (
                "; the ULog says whether EKF2's is the same."
                if comparison.flight.log.has_ulog
                else "."
            ),
        )
        return
    if isinstance(ekf2, Ekf2) and isinstance(ekf2.fusing, pd.DataFrame):
        segment = comparison.segment
        share = step_share(ekf2.fusing["yaw"], segment.start_s, segment.end_s)
        aligned = share > FUSING_SHARE_ERROR.value
    yield Finding(
        "source_frame_not_north",
        "info" if aligned else "warning",
        "The source's frame is FRD: its x axis is where the vehicle pointed at start, not north"
        + (
            "; EKF2 fused its yaw, so that EKF2's frame is the same."
            if aligned
            else ", while the IMU is turned into NED: north and east of the two may differ."
        ),
        "Read 'north' as the source's x axis."
        if aligned
        else "Send the position in NED, or let EKF2 fuse the yaw (EKF2_EV_CTRL bit 3).",
    )


DETECTOR = Detector(
    _detect,
    {"source_frame_not_north": "not north, frd, frame north"},
    names={"source_frame_not_north": "positions whose axes are not north and east"},
)
