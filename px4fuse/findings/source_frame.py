"""The source's frame is not north, or is turned against the vehicle's heading, or EKF2's drifts."""

from collections.abc import Mapping
from typing import Any

from px4fuse.analysis import Analysis
from px4fuse.filter.heading import MAX_DRIFT_P, HeadingError
from px4fuse.findings.ekf2_not_fusing import FUSING_SHARE_ERROR
from px4fuse.findings.model import Finding, Found, Severity, finding, fraction_on, info, warning
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.plain import capitalise_first

HEADING_SIGMAS = 4.0  # standard deviations; clean flights were seen up to 3.2
HEADING_ERROR_DEG = 5.0  # EKF2's magnetic heading was off by 3 to 4° in flights seen
HEADING_ERROR_LARGE_DEG = 15.0  # a quarter of each axis goes to the other
# Published in EKF2's own frame, after it turned what was sent (EKF2.cpp)
IN_EKF2_FRAME = "estimator_visual_odometry_aligned"


def detect(analysis: Analysis) -> Found:
    """What its frame is called, and what the IMU makes of it."""
    if analysis.source.frame == "FRD":
        yield frame_not_north(analysis)
    heading = analysis.heading
    if isinstance(heading, HeadingError) and not analysis.source.origin.reconstructed:
        yield from detect_misalignment(analysis, heading)
    yield from placement(analysis)


def frame_not_north(analysis: Analysis) -> Finding:
    """The source's x axis is not north, and EKF2 may or may not have taken it so."""
    ekf2, log = analysis.flight.ekf2, analysis.flight.log
    case, fusing = "apart", ekf2.fusing if isinstance(ekf2, Ekf2) else None
    if isinstance(fusing, Unavailable):
        case = "unknown"
    elif fusing is not None and fraction_on(fusing["yaw"], analysis.segment) > FUSING_SHARE_ERROR:
        case = "fused"
    make_finding = warning if case == "apart" else info
    return make_finding("source_frame_not_north", case=case, in_ulog=log.has_ulog)


def detect_misalignment(analysis: Analysis, heading: HeadingError) -> Found:
    """The IMU measures as north what the positions show in another direction."""
    name, turn, sigma = analysis.source.name, heading.turn_deg, heading.sigma_deg
    gnss = analysis.source.origin.is_gnss
    facts: dict[str, Any] = {"source": name, "gnss": gnss, "yaw": analysis.flight.log.has_ulog}
    if heading.drifts:
        yield _drift_finding(heading, facts)
    elif abs(turn) >= max(HEADING_SIGMAS * sigma, HEADING_ERROR_DEG) and not _is_a_bias(analysis):
        of_ekf2 = gnss or name == IN_EKF2_FRAME
        yield finding(
            "error" if abs(turn) >= HEADING_ERROR_LARGE_DEG else "warning",
            "ekf2_heading_wrong" if of_ekf2 else "source_frame_turned",
            {"turn_deg": turn, "sigma_deg": sigma},
            within_deg=1.96 * sigma,
            back_deg=-turn,
            case="gnss" if gnss else "fused",
            **facts,
        )


def _is_a_bias(analysis: Analysis) -> bool:
    """Whether a bias of the accelerometer, which turns with the nose, explains it as well."""
    found = analysis.bias_scale_jump_fit
    if isinstance(found, Unavailable) or analysis.source.orientation is not None:
        return False
    return abs(found.rotation.value) < HEADING_SIGMAS * found.rotation.sigma


def _drift_finding(heading: HeadingError, facts: Mapping[str, Any]) -> Finding:
    first, last = heading.ends
    change = last.heading_error_deg - first.heading_error_deg
    return finding(
        "error" if abs(change) >= HEADING_ERROR_LARGE_DEG else "warning",
        "ekf2_heading_wrong",
        {
            "from_deg": first.heading_error_deg,
            "to_deg": last.heading_error_deg,
            "from_s": first.start_s,
            "to_s": last.end_s,
            "p": max(heading.drift_p, 1e-300),
            "p_limit": MAX_DRIFT_P,
        },
        headline="drifts",
        more=heading.by,
        remedy="gnss" if facts["gnss"] else "drifts",
        first=first,
        last=last,
        **facts,
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
                source=analysis.source.name,
                doubt=capitalise_first(sentence.rstrip(".")),
            )
