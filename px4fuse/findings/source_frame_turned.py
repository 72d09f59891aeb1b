"""The source's frame is turned against the vehicle's heading."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.clock import ClockOffset
from px4fuse.findings.model import Detector, Finding, Found, Threshold

HEADING_SIGMAS = Threshold(3.0, "standard deviations", "0.3 % of clean flights lie beyond")
HEADING_ERROR = Threshold(5.0, "°", "EKF2's magnetic heading was off by 3 to 4° in flights seen")
HEADING_ERROR_LARGE = Threshold(15.0, "°", "a quarter of each axis goes to the other")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis.comparison
    clock = analysis.clock
    if not isinstance(clock, ClockOffset) or comparison.source.reconstructed:
        return
    turn, sigma = clock.heading_error_deg, clock.heading_sigma_deg
    if abs(turn) < max(HEADING_SIGMAS.value * sigma, HEADING_ERROR.value):
        return
    yield Finding(
        "source_frame_turned",
        "error" if abs(turn) >= HEADING_ERROR_LARGE.value else "warning",
        f"The frame of {comparison.source.name} is turned by {turn:+.0f}° ± {1.96 * sigma:.0f}° "
        "(clockwise seen from above) against the vehicle's heading: what the IMU measures as "
        "north, the positions show in another direction. Either the positioning frame is not "
        "aligned with north, or the heading is wrong (magnetometer).",
        f"Turn the positions by {-turn:+.0f}° before they are sent (a file: --position-yaw), or "
        "calibrate the magnetometer.",
        {"turn_deg": turn, "sigma_deg": sigma},
    )


DETECTOR = Detector(
    _detect,
    {
        "source_frame_turned": "frame turn, frame rotat, frame align, frame misalign, frame yaw, "
        "frame heading, positions turned, position rotat, uwb rotat, anchors rotat, yaw error, "
        "yaw offset, yaw wrong, heading error, heading offset, heading wrong, not align north, "
        "misalign",
    },
    {"source_frame_turned": tuple(f"--mistake yaw={degrees}" for degrees in (10, 20, 30))},
)
