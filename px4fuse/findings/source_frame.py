"""The source's frame is not north, or is turned against the vehicle's heading, or EKF2's drifts."""

from px4fuse.analysis import Analysis
from px4fuse.ekf2_parameters import GNSS_POS
from px4fuse.filter.heading import DRIFT_P, HeadingError
from px4fuse.findings.ekf2_not_fusing import FUSING_SHARE_ERROR
from px4fuse.findings.model import Finding, Found, Severity, finding, share_on
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.plain import capital

HEADING_SIGMAS = 4.0  # standard deviations; clean flights were seen up to 3.2
HEADING_ERROR_DEG = 5.0  # EKF2's magnetic heading was off by 3 to 4° in flights seen
HEADING_ERROR_LARGE_DEG = 15.0  # a quarter of each axis goes to the other
# Published in EKF2's own frame, after it turned what was sent (EKF2.cpp)
IN_EKF2_FRAME = "estimator_visual_odometry_aligned"
READ = "Read 'north' as the source's x axis"
FUSE_YAW = "EKF2 fuse the source's yaw (EKF2_EV_CTRL bit 3; EKF2_AID_MASK bit 4 before v1.14)."

OUTDOORS = (
    "Calibrate the magnetometer away from metal and motors, and look at the age of a fix "
    f"({GNSS_POS.delay}): a wrong one turns the heading."
)


CAUSES_OF_DRIFT = (
    "A magnetometer indoors does this, or odometry whose own heading drifts.",
    "A magnetometer near currents or steel does this.",
)


def detect(analysis: Analysis) -> Found:
    """What its frame is called, and what the IMU makes of it."""
    if analysis.source.frame == "FRD":
        yield not_north(analysis)
    heading = analysis.heading
    if isinstance(heading, HeadingError) and not analysis.source.origin.reconstructed:
        yield from turned(analysis, heading)
    yield from placement(analysis)


def not_north(analysis: Analysis) -> Finding:
    """The source's x axis is not north, and EKF2 may or may not have taken it so."""
    ekf2, log = analysis.flight.ekf2, analysis.flight.log
    severity: Severity = "warning"
    words = ", while the IMU is turned into NED: north and east of the two may differ."
    remedy = "Send the position in NED, or let EKF2 fuse the yaw (EKF2_EV_CTRL bit 3)."
    fusing = ekf2.fusing if isinstance(ekf2, Ekf2) else None
    if isinstance(fusing, Unavailable):
        severity, in_ulog = "info", "; the ULog says whether EKF2's is the same"
        words = (
            ". Whether EKF2 fused its yaw, so that the frames are the same, is not in this "
            "recording."
        )
        remedy = f"{READ}{in_ulog if log.has_ulog else ''}."
    elif fusing is not None and share_on(fusing["yaw"], analysis.segment) > FUSING_SHARE_ERROR:
        severity, remedy = "info", f"{READ}."
        words = "; EKF2 fused its yaw, so that EKF2's frame is the same."
    return finding(
        severity,
        "source_frame_not_north",
        "The source's frame is FRD: its x axis is where the vehicle pointed at start, not north",
        words,
        remedy,
    )


def turned(analysis: Analysis, heading: HeadingError) -> Found:
    """The IMU measures as north what the positions show in another direction."""
    name, turn, sigma = analysis.source.name, heading.turn_deg, heading.sigma_deg
    is_px4 = analysis.flight.log.has_ulog
    remedy = "calibrate the magnetometer away from metal and motors, or let "
    remedy += FUSE_YAW if is_px4 else "the autopilot fuse the source's yaw."
    if analysis.source.origin.is_gnss:
        remedy = OUTDOORS
    if heading.drifts:
        yield _drifting(name, heading, remedy, gnss=analysis.source.origin.is_gnss)
        return
    if abs(turn) < max(HEADING_SIGMAS * sigma, HEADING_ERROR_DEG) or _is_a_bias(analysis):
        return
    severity: Severity = "error" if abs(turn) >= HEADING_ERROR_LARGE_DEG else "warning"
    stated = f"turned by {turn:+.0f}° ± {1.96 * sigma:.0f}° (clockwise seen from above) against"
    found = (
        "source_frame_turned",
        f"The frame of {name} is {stated} the vehicle's heading",
        ": what the IMU measures as north, the positions show in another direction. Either the "
        "positioning frame is not aligned with north, or the heading is wrong (magnetometer).",
        f"Turn the positions by {-turn:+.0f}° before they are sent (a file: --position-yaw), or "
        "calibrate the magnetometer.",
    )
    if analysis.source.origin.is_gnss:
        found = (
            "ekf2_heading_wrong",
            f"The positions of GNSS lie {stated} EKF2's heading, the same throughout",
            ": what the IMU measures as north, they show in another direction. GNSS knows north.",
            OUTDOORS,
        )
    elif name == IN_EKF2_FRAME:
        found = (
            "ekf2_heading_wrong",
            f"The positions that EKF2 fused ({name}) lie {stated} EKF2's heading, the same "
            "throughout",
            ": what the IMU measures as north, they show in another direction.",
            f"Align the positioning system's frame with north, or {remedy}",
        )
    yield finding(severity, *found, {"turn_deg": turn, "sigma_deg": sigma})


def _is_a_bias(analysis: Analysis) -> bool:
    """Whether a bias of the accelerometer, which turns with the nose, explains it as well."""
    found = analysis.explained
    if isinstance(found, Unavailable) or analysis.source.orientation is not None:
        return False
    return abs(found.turn.value) < HEADING_SIGMAS * found.turn.sigma


def _drifting(source: str, heading: HeadingError, remedy: str, *, gnss: bool) -> Finding:
    first, last = heading.ends
    change = last.heading_error_deg - first.heading_error_deg
    by = {"orientation": "the source's own orientation", "positions": "the positions and the IMU"}
    return finding(
        "error" if abs(change) >= HEADING_ERROR_LARGE_DEG else "warning",
        "ekf2_heading_wrong",
        f"EKF2's heading drifts against {source}, whose frame lies at "
        f"{first.heading_error_deg:+.0f}° from {first.start_s:.0f} to {first.end_s:.0f} s and at "
        f"{last.heading_error_deg:+.0f}° from {last.start_s:.0f} to {last.end_s:.0f} s",
        f" (clockwise seen from above, by {by[heading.by]}): no constant turn of the positions "
        f"fixes that. {CAUSES_OF_DRIFT[gnss]}",
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


def placement(analysis: Analysis) -> Found:
    """What is poorly determined about where a position file lies in the flight."""
    found = analysis.source.alignment
    doubts: dict[Severity, tuple[str, ...]] = {}
    if found is not None:
        doubts = {"error": found.misplaced, "warning": found.warnings}
    for severity, sentences in doubts.items():
        for sentence in sentences:
            yield finding(
                severity,
                "position_file_placement",
                f"{analysis.source.name}: {capital(sentence.rstrip('.'))}",
                ".",
                "Give --clock-offset, --position-frame and --position-yaw where you know them.",
            )
