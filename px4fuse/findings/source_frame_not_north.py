"""The source's x axis is not north."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.ekf2_not_fusing import FUSING_SHARE_ERROR
from px4fuse.findings.model import Detector, Finding, Found, Severity, step_share
from px4fuse.flight import Ekf2, Unavailable

FRAME = "The source's frame is FRD: its x axis is where the vehicle pointed at start, not north"
READ = "Read 'north' as the source's x axis"


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    if comparison.source.frame != "FRD":
        return
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    severity: Severity = "warning"
    words = ", while the IMU is turned into NED: north and east of the two may differ."
    remedy = "Send the position in NED, or let EKF2 fuse the yaw (EKF2_EV_CTRL bit 3)."
    if isinstance(ekf2, Ekf2):
        if isinstance(ekf2.fusing, Unavailable):
            severity = "info"
            words = (
                ". Whether EKF2 fused its yaw, so that the frames are the same, is not in this "
                "recording."
            )
            in_ulog = "; the ULog says whether EKF2's is the same"
            remedy = f"{READ}{in_ulog if comparison.flight.log.has_ulog else ''}."
        elif FUSING_SHARE_ERROR.value < step_share(
            ekf2.fusing["yaw"], segment.start_s, segment.end_s
        ):
            severity = "info"
            words = "; EKF2 fused its yaw, so that EKF2's frame is the same."
            remedy = f"{READ}."
    yield Finding("source_frame_not_north", severity, FRAME + words, remedy)


DETECTOR = Detector(
    _detect,
    names={"source_frame_not_north": "positions whose axes are not north and east"},
)
