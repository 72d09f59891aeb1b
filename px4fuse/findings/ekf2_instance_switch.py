"""Another EKF2 instance took over."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, moments, times
from px4fuse.flight import Unavailable


def _detect(analysis: Analysis) -> Found:
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    if isinstance(ekf2, Unavailable):
        return
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        yield Finding(
            "ekf2_instance_switch",
            "warning",
            f"The primary EKF2 instance changed {times(len(switches))}, first at "
            f"{switches[0]:.1f} s; each part of the comparison uses the one in charge.",
            "Compare the IMUs (vehicle_imu_status); set EKF2_MULTI_IMU to 1 for a lab flight.",
            {"count": float(len(switches)), "at_s": switches[0]},
            spans_s=moments(switches),
        )


DETECTOR = Detector(
    _detect,
    names={"ekf2_instance_switch": "a change of the EKF2 instance"},
)
