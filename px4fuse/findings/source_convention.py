"""Convention of the source: axes, unit, clock and orientation differ from what PX4 expects.

Sources: MAVROS ``vision_pose`` (``transform_frame_enu_ned``), PX4 ``VehicleOdometry.msg``, REP 103.
"""

from collections.abc import Sequence

from msgspec.structs import replace

from px4fuse.comparison.model import Comparison
from px4fuse.convention.axes import UNITS, Axes
from px4fuse.convention.correction import MIN_REMAINDER_DEG, Faults, find_faults
from px4fuse.convention.model import Convention
from px4fuse.convention.texts import (
    FRAME_AXES,
    axes_as_sent,
    describe_axes,
    describe_conversion,
    describe_unit,
)
from px4fuse.finding import Finding, Severity
from px4fuse.findings.cause_grouping import ANNOUNCED, CONVENTION, MISLEADING, UNUSABLE
from px4fuse.findings.model import CATALOGUE, Findings, finding
from px4fuse.flight import PositionTrack, positions_of, source_name
from px4fuse.text import capitalise_first

CORRECT_FIRST = "Correct the position source first."
# Findings about EKF2's parameters or the alignment, which a wrong source makes false
FALSE_AFTER = (
    "ekf2_noise_too_small",
    "ekf2_noise_too_large",
    "ekf2_gate_too_small",
    "ekf2_ev_delay_wrong",
    "ekf2_heading_error",
    "ekf2_underconfident",
    "position_file_alignment",
    "source_drift",
    "error_exceeds_reported_sigma",
)
# Findings that remain true, with another action
EFFECTS = (
    "ekf2_overconfident",
    "ekf2_rejects_positions",
    "ekf2_resets",
    "ekf2_fusion_interrupted",
    "ekf2_not_fusing",
    "ekf2_position_invalid",
    "aid_not_fused",
    "aid_overconfident",
)
# Groups of findings that do not depend on the positions
UNAFFECTED_GROUPS = ("logging", "IMU")


def detect(analysis: Comparison) -> Findings:
    """Detect faults of the convention, the cause of others first."""
    convention, faults = (
        analysis.convention,
        find_faults(analysis.convention, analysis.flight, analysis.source.frame),
    )
    if convention is None or not faults:
        return
    if faults.orientation:
        yield _orientation_finding(analysis, convention, faults)
    if faults.axes or (faults.rotation_deg and _axes_of_file(analysis.source, convention)):
        yield _axes_finding(analysis, convention, faults)
    elif faults.rotation_deg:
        yield _rotation_finding(analysis, convention, faults)
    if faults.unit:
        yield _unit_finding(analysis.source, convention)
    if faults.clock_drift:
        yield _clock_drift_finding(convention)
    elif faults.late_s:
        yield _time_offset_finding(analysis.source, convention)
    if faults.is_ambiguous:
        yield _ambiguity_finding(analysis.source, convention)


def apply_convention(analysis: Comparison, findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings without those that a wrong convention makes false.

    Findings about EKF2, which fused what was sent, follow the fault as its effects.
    """
    faults = _faults(analysis)
    roots = [one for one in findings if CONVENTION in one.evidence]
    unusable = [one for one in findings if one.id in UNUSABLE]
    if unusable:
        roots = unusable
        findings = [
            one
            for one in findings
            if one in unusable or one.id in EFFECTS or CATALOGUE[one.id].group in UNAFFECTED_GROUPS
        ]
    elif faults.orientation == "copied" and not faults.of_positions:
        roots = []
    roots += [one for one in findings if one.id in MISLEADING or ANNOUNCED in one.evidence]
    if not roots:
        return [*findings]
    others = [one for one in findings if one not in roots and one.id not in FALSE_AFTER]
    if faults.is_ambiguous and not unusable:
        return [*roots, *(one for one in others if one.id in EFFECTS or one.severity == "note")]
    effects = [
        replace(one, message=f"{one.title}.", remedy=CORRECT_FIRST, caused_by=roots[0].id)
        for one in others
        if one.id in EFFECTS and one.caused_by is None
    ]
    return [roots[0], *effects, *roots[1:], *(one for one in others if one.id not in EFFECTS)]


def _faults(analysis: Comparison) -> Faults:
    return find_faults(analysis.convention, analysis.flight, analysis.source.frame)


def _fault(
    severity: Severity, name: str, kind: str, message: str, remedy: str, convention: Convention
) -> Finding:
    gain = round(convention.log_likelihood_gain, 1)
    return finding(severity, name, message, remedy, {CONVENTION: kind, "log_likelihood": gain})


def _basis(convention: Convention) -> str:
    """State the evidence for axes, unit or clock."""
    odds = 99.0 if convention.log_odds is None else min(convention.log_odds, 99.0)
    more = "above " if odds == 99.0 else ""
    return (
        "The motion measured by the IMU fits this better than any other convention (log likelihood "
        f"ratio {more}{odds:.0f})."
    )


def _axes_of_file(source: PositionTrack, convention: Convention) -> Axes | None:
    """Return the axes of a position file if they are NED, ENU or NWU, and not as stated."""
    if source.alignment is None or abs(convention.rotation_deg) > MIN_REMAINDER_DEG:
        return None
    axes = axes_as_sent((convention.x, convention.y, convention.z), source.alignment.frame.upper())
    return axes if axes in FRAME_AXES.values() else None


def _axes_finding(analysis: Comparison, convention: Convention, faults: Faults) -> Finding:
    """Make the finding of axes that are not those of NED."""
    alignment, orientation = analysis.source.alignment, convention.orientation
    stated = "NED" if alignment is None else alignment.frame.upper()
    axes = axes_as_sent((convention.x, convention.y, convention.z), stated)
    limit = " The analysis uses the positions converted to NED."
    if faults.is_north_unknown and orientation is not None and axes not in FRAME_AXES.values():
        axes = FRAME_AXES.get(orientation.frames[-3:], axes)
        limit = " EKF2's heading came from this source, so the direction of north is unknown."
    fault, action = describe_axes(
        axes, stated, is_mirrored=convention.is_mirrored, is_file=alignment is not None
    )
    if faults.axes and faults.rotation_deg:
        fault += f", rotated by {faults.rotation_deg:+.0f}° (clockwise from above)"
    if orientation is not None and orientation.frames.startswith("FLU"):
        action += f" {describe_conversion(orientation.frames)}"
    message = f"{fault}. {_basis(convention)}{limit}"
    return _fault("error", "source_axes_wrong", "axes", message, action, convention)


def _rotation_finding(analysis: Comparison, convention: Convention, faults: Faults) -> Finding:
    """Make the finding of a frame that is rotated about the vertical."""
    positions, turn_deg = positions_of(analysis.source), faults.rotation_deg
    reference = "EKF2's heading" if convention.heading_from == "EKF2" else "the heading at take-off"
    message = (
        f"{capitalise_first(positions)} are rotated by {turn_deg:+.0f}° relative to {reference}. "
        "The rotation is clockwise from above and constant. The x axis of the source is not north, "
        f"unless this heading is wrong. {_basis(convention)} The analysis uses the positions "
        "rotated to NED."
    )
    action = (
        "Align the frame of the positioning system with north, or rotate positions and "
        f"orientation by {-turn_deg:+.0f}° before they are sent."
    )
    if analysis.source.alignment is not None:
        action = "Run again with --position-yaw auto."
    found = _fault("error", "source_frame_misaligned", "rotation", message, action, convention)
    return replace(found, evidence={**found.evidence, "misalignment_deg": turn_deg})


def _unit_finding(source: PositionTrack, convention: Convention) -> Finding:
    """Make the finding of positions that are not in metres."""
    positions = capitalise_first(positions_of(source))
    fault, action = describe_unit(convention.unit, positions, is_file=source.alignment is not None)
    factor = convention.scale / UNITS[convention.unit]
    message = (
        f"{fault}. Distances are {factor:.3g} times those that the IMU measures. "
        f"{_basis(convention)} The analysis uses the positions in metres."
    )
    return _fault("error", "source_unit_wrong", "unit", message, action, convention)


def _time_offset_finding(source: PositionTrack, convention: Convention) -> Finding:
    """Make the finding of a time offset beyond the reach of the usual estimate."""
    size_s, is_late = abs(convention.late_s), convention.late_s > 0.0
    message = (
        f"Position timestamps are {size_s:.2f} s {'late' if is_late else 'early'}. "
        f"{_basis(convention)} The analysis uses corrected timestamps."
    )
    action = "Run again with --clock-offset auto."
    if source.alignment is None:
        action = (
            "Synchronise the clocks (TIMESYNC; uXRCE-DDS: UXRCE_DDS_SYNCT 1) and set the timestamp "
            "at the time of measurement."
        )
    return _fault("error", "source_time_offset", "time offset", message, action, convention)


def _clock_drift_finding(convention: Convention) -> Finding:
    """Make the finding of a clock that runs too fast or too slowly."""
    percent, late_s = 100.0 * convention.clock_drift, convention.late_s
    message = (
        f"The clock of the position timestamps is {abs(percent):.1f} % "
        f"{'fast' if percent > 0 else 'slow'}, and {late_s:+.2f} s late in the middle. "
        f"{_basis(convention)} The analysis uses corrected timestamps."
    )
    action = (
        "Take the timestamps from a clock. Timestamps that are counted (frame number over nominal "
        "rate) drift."
    )
    name = "source_time_offset_changes"
    return _fault("error", name, "clock drift", message, action, convention)


def _ambiguity_finding(source: PositionTrack, convention: Convention) -> Finding:
    """Make the finding of axes, unit or clock that the motion does not determine."""
    best = f"x {convention.x}, y {convention.y}, z {convention.z}, {convention.unit}"
    others = "; ".join(convention.alternatives[:3])
    message = (
        f"The axes of the {positions_of(source)} are not NED, and ambiguous: {best}; or {others}. "
        "The motion of this flight fits each of them. Estimates from the positions are left out."
    )
    action = "Fly a square with climb and descent, or state the frame (--position-frame)."
    name = "source_convention_ambiguous"
    return _fault("warning", name, "ambiguous", message, action, convention)


def _orientation_finding(analysis: Comparison, convention: Convention, faults: Faults) -> Finding:
    """Make the finding of a wrong orientation."""
    orientation, name = convention.orientation, source_name(analysis.source)
    assert orientation is not None
    kind: str = faults.orientation
    if kind == "copied":
        return _fault(
            "warning",
            "source_orientation_copied",
            kind,
            "The orientation of the source is the autopilot's own attitude, sent back. The median "
            "difference is below 0.15°. It contains no measurement, so the source is analysed as a "
            "positioning system without orientation.",
            "Send no orientation (q NaN), and fuse the position only (EKF2_EV_CTRL without bit 3).",
            convention,
        )
    error_deg = orientation.heading_error_deg or 0.0
    fault, action = {
        "order": (
            f"The quaternion of {name} is sent in the order x, y, z, w; PX4 reads w, x, y, z. In "
            "the order x, y, z, w roll and pitch agree with the vehicle (median difference "
            f"{orientation.tilt_difference_deg:.1f}°)",
            "Write w first (px4_msgs: q[0] is w). Eigen coeffs(), SciPy as_quat() and "
            "geometry_msgs have the order x, y, z, w.",
        ),
        "frames": (
            f"The orientation of {name} is {orientation.frames}; PX4 reads FRD to NED, as the "
            "positions are. In that frame roll and pitch agree with the vehicle (median difference "
            f"{orientation.tilt_difference_deg:.1f}°)",
            describe_conversion(orientation.frames),
        ),
        "heading": (
            f"The heading of the orientation of {name} differs by {error_deg:+.0f}° from its own "
            "positions (clockwise from above). The positions move in another direction than the "
            "orientation and the IMU say",
            "Define the rigid body with x forward. An error of 90° is often an ENU heading, which "
            "counts from east, that was not converted.",
        ),
    }[kind]
    message = f"{fault}. A filter that fuses this yaw gets a wrong heading."
    action += " Do not fuse the yaw (EKF2_EV_CTRL bit 3) before."
    return _fault("error", "source_orientation_wrong", kind, message, action, convention)
