"""The source's frame is turned against the vehicle's heading, or EKF2's heading drifts."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.heading import DRIFT_P, HeadingError
from px4fuse.findings.model import Detector, Finding, Found, Severity, Threshold
from px4fuse.flight import Unavailable

HEADING_SIGMAS = Threshold(4.0, "standard deviations", "clean flights were seen up to 3.2")
HEADING_ERROR = Threshold(5.0, "°", "EKF2's magnetic heading was off by 3 to 4° in flights seen")
HEADING_ERROR_LARGE = Threshold(15.0, "°", "a quarter of each axis goes to the other")
# Published in EKF2's own frame, after it turned what was sent (EKF2.cpp)
IN_EKF2_FRAME = "estimator_visual_odometry_aligned"
CALIBRATE = "calibrate the magnetometer away from metal and motors, or let "
FUSE_YAW = "EKF2 fuse the source's yaw (EKF2_EV_CTRL bit 3; EKF2_AID_MASK bit 4 before v1.14)."


def _detect(analysis: Analysis) -> Found:
    source, heading = analysis.source, analysis.heading
    if isinstance(heading, Unavailable) or source.origin.reconstructed:
        return
    is_px4 = analysis.flight.log.has_ulog
    remedy = CALIBRATE + (FUSE_YAW if is_px4 else "the autopilot fuse the source's yaw.")
    if heading.drifts:
        yield _drifting(source.name, heading, remedy)
        return
    turn, sigma = heading.turn_deg, heading.sigma_deg
    if abs(turn) < max(HEADING_SIGMAS.value * sigma, HEADING_ERROR.value):
        return
    severity: Severity = "error" if abs(turn) >= HEADING_ERROR_LARGE.value else "warning"
    evidence: dict[str, float | str] = {"turn_deg": turn, "sigma_deg": sigma}
    stated = f"{turn:+.0f}° ± {1.96 * sigma:.0f}° (clockwise seen from above)"
    if source.name == IN_EKF2_FRAME:
        yield Finding(
            "ekf2_heading_wrong",
            severity,
            f"The positions that EKF2 fused ({source.name}) lie turned by {stated} against EKF2's "
            "heading, the same throughout: what the IMU measures as north, they show in another "
            "direction.",
            f"Align the positioning system's frame with north, or {remedy}",
            evidence,
        )
        return
    yield Finding(
        "source_frame_turned",
        severity,
        f"The frame of {source.name} is turned by {stated} against the vehicle's heading: what the "
        "IMU measures as north, the positions show in another direction. Either the positioning "
        "frame is not aligned with north, or the heading is wrong (magnetometer).",
        f"Turn the positions by {-turn:+.0f}° before they are sent (a file: --position-yaw), or "
        "calibrate the magnetometer.",
        evidence,
    )


def _drifting(source: str, heading: HeadingError, remedy: str) -> Finding:
    first, last = heading.ends
    change = last.heading_error_deg - first.heading_error_deg
    how = (
        "by the source's own orientation"
        if heading.by == "orientation"
        else "by the positions and the IMU"
    )
    return Finding(
        "ekf2_heading_wrong",
        "error" if abs(change) >= HEADING_ERROR_LARGE.value else "warning",
        f"EKF2's heading drifts against {source}, whose frame lies at "
        f"{first.heading_error_deg:+.0f}° from {first.start_s:.0f} to {first.end_s:.0f} s and at "
        f"{last.heading_error_deg:+.0f}° from {last.start_s:.0f} to {last.end_s:.0f} s (clockwise "
        f"seen from above, {how}): no constant turn of the positions fixes that. A magnetometer "
        "indoors does this, or odometry whose own heading drifts.",
        f"{remedy[0].upper()}{remedy[1:]}",
        {
            "from_deg": first.heading_error_deg,
            "to_deg": last.heading_error_deg,
            "from_s": first.start_s,
            "to_s": last.end_s,
            "p": max(heading.drift_p, 1e-300),
            "p_limit": DRIFT_P,
        },
    )


DETECTOR = Detector(
    _detect,
    {"source_frame_turned": tuple(f"--mistake yaw={degrees}" for degrees in (10, 15, 20, 30))},
    names={
        "source_frame_turned": "positions that are turned against north",
        "ekf2_heading_wrong": "a heading of EKF2 that is wrong or drifts",
    },
)
