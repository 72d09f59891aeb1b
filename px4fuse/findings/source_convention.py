"""Detect positions that do not follow PX4's convention: wrong axes, unit, clock or orientation.

Sources: MAVROS ``vision_pose`` (``transform_frame_enu_ned``), PX4 ``VehicleOdometry.msg``, REP 103.
"""

from collections.abc import Sequence

from msgspec.structs import replace

from px4fuse.comparison.model import Comparison
from px4fuse.convention.axes import METRES_PER_UNIT
from px4fuse.convention.check import determine_source_convention
from px4fuse.convention.correction import (
    MIN_RESIDUAL_ROTATION_DEG,
    ConventionFaults,
    find_convention_faults,
)
from px4fuse.convention.model import Convention
from px4fuse.convention.texts import (
    FRAME_AXES,
    describe_axes,
    describe_quaternion_conversion,
    describe_wrong_unit,
    find_axes_in_file,
    format_axes,
    format_delay,
)
from px4fuse.finding import Finding
from px4fuse.flight.model import Flight, PositionTrack

from .model import (
    FINDING_CATALOGUE,
    NO_ESTIMATES_SENTENCE,
    RESET_TIME_KEY,
    WRONG_CONVENTION_KEY,
    Findings,
    make_error,
    make_warning,
)

# Groups of findings that are valid even if all positions are wrong
POSITION_INDEPENDENT_FINDING_GROUPS = ("logging", "IMU")


def detect(analysis: Comparison) -> Findings:
    convention, faults = analysis.convention, analysis.convention_faults
    if convention is not None:
        yield from _detect_orientation_faults(convention, faults, analysis.source)
        yield from _detect_position_faults(convention, faults, analysis.source)


def detect_wrong_orientation(flight: Flight, source: PositionTrack) -> Findings:
    """Detect a wrong convention of the orientations from a source, such as the quaternion order.

    Unlike :func:`detect`, it needs no comparison of KF and EKF2, and does not check positions.
    """
    convention = determine_source_convention(flight, source)
    if convention is not None:
        faults = find_convention_faults(convention, flight, source.frame)
        yield from _detect_orientation_faults(convention, faults, source)


def _make_evidence(convention: Convention, fault: str) -> dict[str, float | str]:
    return {
        WRONG_CONVENTION_KEY: fault,
        "log_likelihood": round(convention.log_likelihood_gain, 1),
    }


def remove_convention_effects(analysis: Comparison, findings: Sequence[Finding]) -> list[Finding]:
    """Remove findings that are only effects of positions in a wrong convention.

    The convention comprises axes, unit, clock and orientation. Findings on EKF2 are kept and marked
    as effects.
    """
    # 1. Causes: findings of faults that make other findings wrong
    faults = analysis.convention_faults
    causes = [item for item in findings if WRONG_CONVENTION_KEY in item.evidence]
    unusable_positions = [
        item for item in findings if FINDING_CATALOGUE[item.id].report_class == "unusable"
    ]
    if unusable_positions:
        # Findings on axes, unit and clock are not valid if the positions are unusable. With a wrong
        # lever arm as only fault, the finding on the orientation remains valid
        is_only_lever_arm = {item.id for item in unusable_positions} == {"source_lever_arm"}
        causes = [
            item for item in causes if is_only_lever_arm and item.id == "source_orientation_wrong"
        ] + unusable_positions
    else:
        # If the only fault is that the orientation is a copy of EKF2's attitude, no other finding
        # is affected
        if faults.orientation == "copied" and not faults.has_position_fault:
            causes = []
        causes += [
            item
            for item in findings
            if FINDING_CATALOGUE[item.id].report_class == "misleading"
            or RESET_TIME_KEY in item.evidence
        ]
    if not causes:
        return [*findings]
    # 2. Effects of the causes, and findings that are valid in spite of the causes
    effects, valid_findings = list[Finding](), list[Finding]()
    for item in findings:
        entry = FINDING_CATALOGUE[item.id]
        # A drifting clock has no constant time offset
        has_no_offset = faults.clock_drift and item.id == "source_time_offset"
        if item in causes or has_no_offset or entry.status_if_convention_wrong == "withdrawn":
            continue
        if entry.status_if_convention_wrong == "effect":
            effects.append(item)
        elif unusable_positions:  # findings from positions are not valid
            if (
                entry.group in POSITION_INDEPENDENT_FINDING_GROUPS
                and item.id != "accelerometer_bias"
            ):
                valid_findings.append(item)
        # With unknown axes, warnings and errors may be due to wrong axes
        elif not faults.is_ambiguous or item.severity == "note":
            valid_findings.append(item)
    # With unknown axes, it is not known which findings are effects: mark none of them
    if faults.is_ambiguous and not unusable_positions:
        return causes + [item for item in findings if item in effects or item in valid_findings]
    first_cause, *other_causes = causes
    return [
        first_cause,
        # The wrong convention may cause the findings on EKF2, so they become its effects. Findings
        # with another known cause are omitted: with the right convention, that cause may not exist
        *(
            replace(item, message=f"{item.title}.", caused_by=first_cause.id)
            for item in effects
            if item.caused_by is None
        ),
        *other_causes,
        *valid_findings,
    ]


def _detect_position_faults(
    convention: Convention, faults: ConventionFaults, source: PositionTrack
) -> Findings:
    """Yield the findings on wrong axes, rotation, unit or timestamps of the positions."""
    positions_text = source.positions_text
    is_position_file = source.alignment is not None
    log_odds = 99.0 if convention.log_odds is None else min(convention.log_odds, 99.0)
    evidence_sentence = (
        "With corrected axes, unit and time offset, the positions fit the IMU better than with "
        "other tested combinations (log likelihood ratio to the second best: "
        f"{'above ' if log_odds == 99.0 else ''}{log_odds:.0f} nats)."
    )
    yield from _detect_wrong_axes_or_rotation(convention, faults, source, evidence_sentence)
    if faults.has_wrong_unit:
        fault_text, action = describe_wrong_unit(
            convention.unit, positions_text, is_file=is_position_file
        )
        distance_ratio = convention.scale / METRES_PER_UNIT[convention.unit]
        yield make_error(
            "source_unit_wrong",
            f"{fault_text}. Distances between positions are {distance_ratio:.3g} times those "
            f"computed from the IMU. {evidence_sentence} The analysis uses positions in metres.",
            action,
            _make_evidence(convention, "unit"),
        )
    if faults.clock_drift:
        yield make_error(
            "source_time_offset_changes",
            f"The clock of the position timestamps is {100.0 * abs(faults.clock_drift):.1f} % too "
            f"{'fast' if faults.clock_drift > 0 else 'slow'}. In the middle of the flight the "
            f"timestamps are {format_delay(convention.late_s, 2) or 'correct'}. "
            f"{evidence_sentence} The analysis uses corrected timestamps.",
            "Take timestamps from a clock, not from frame number ÷ nominal rate.",
            _make_evidence(convention, "clock drift"),
        )
    elif faults.late_s:
        action = (
            "Synchronise the clocks (TIMESYNC; uXRCE-DDS: UXRCE_DDS_SYNCT 1), and send the time of "
            "measurement."
        )
        if is_position_file:
            action = "Run again with --clock-offset auto."
        yield make_error(
            "source_time_offset",
            f"Position timestamps are {format_delay(convention.late_s, 2)}. "
            f"{evidence_sentence} The analysis uses corrected timestamps.",
            action,
            _make_evidence(convention, "time offset"),
        )
    if faults.is_ambiguous:
        axes_text = format_axes(convention.axes, convention.unit)
        yield make_warning(
            "source_convention_ambiguous",
            f"The axes of the {positions_text} are not NED. Several combinations of axes and unit "
            f"fit the motion: {'; or '.join((axes_text, *convention.alternatives[:3]))}. "
            f"{NO_ESTIMATES_SENTENCE}",
            "Fly a square with climb and descent, or state the frame (--position-frame).",
            _make_evidence(convention, "ambiguous"),
        )


def _detect_wrong_axes_or_rotation(
    convention: Convention, faults: ConventionFaults, source: PositionTrack, evidence_sentence: str
) -> Findings:
    """Yield the finding on wrong axes, or on axes that are only rotated about the vertical."""
    is_position_file, rotation_deg = source.alignment is not None, faults.rotation_deg
    stated_frame = source.alignment.frame.upper() if source.alignment else "NED"
    axes = find_axes_in_file(convention.axes, stated_frame)
    # A rotated file whose axes are a usual frame, such as ENU, only needs another --position-frame
    is_file_in_other_frame = (
        rotation_deg
        and is_position_file
        and abs(convention.rotation_deg) <= MIN_RESIDUAL_ROTATION_DEG
        and axes in FRAME_AXES.values()
    )
    if faults.has_wrong_axes or is_file_in_other_frame:
        orientation = convention.orientation
        frame_sentence = "The analysis uses the positions converted to NED."
        # Without north, the axes are known only up to a rotation. The best guess for the frame of
        # the positions is then the frame of the orientations ("FLU to ENU": ENU)
        if faults.is_north_unknown and orientation and axes not in FRAME_AXES.values():
            axes = FRAME_AXES.get(orientation.frames[-3:], axes)
            frame_sentence = (
                "EKF2 took its heading from the position source, so the direction of north is "
                "unknown."
            )
        fault_text, action = describe_axes(
            axes, stated_frame, is_mirrored=convention.is_mirrored, is_file=is_position_file
        )
        if faults.has_wrong_axes and rotation_deg:
            fault_text += f". The frame is also rotated clockwise by {rotation_deg:+.0f}°"
        if orientation and orientation.frames.startswith("FLU"):
            action += f" {describe_quaternion_conversion(orientation.frames)}"
        yield make_error(
            "source_axes_wrong",
            f"{fault_text}. {evidence_sentence} {frame_sentence}",
            action,
            _make_evidence(convention, "axes"),
        )
    elif rotation_deg:
        reference_text = {
            "EKF2": "EKF2's heading",
            "gyroscopes": "the heading at take-off",
            "GNSS": "the GNSS positions",
        }[convention.heading_from]
        other_cause_text = (
            "" if convention.heading_from == "GNSS" else f", or {reference_text} is wrong"
        )
        action = (
            "Align the frame of the source with north, or rotate positions and orientation by "
            f"{-rotation_deg:+.0f}° before sending."
        )
        if is_position_file:
            action = "Run again with --position-yaw auto."
        yield make_error(
            "source_frame_misaligned",
            f"{source.positions_text} are rotated by {rotation_deg:+.0f}° (clockwise from above) "
            f"relative to {reference_text}. The x axis of the source does not point north"
            f"{other_cause_text}. {evidence_sentence} The analysis rotates the positions to NED.",
            action,
            _make_evidence(convention, "rotation") | {"misalignment_deg": rotation_deg},
        )


def _detect_orientation_faults(
    convention: Convention, faults: ConventionFaults, source: PositionTrack
) -> Findings:
    """Yield the finding on the orientation of the source, if it is wrong."""
    orientation = convention.orientation
    if orientation is None or not faults.orientation:
        return
    sensor_name, evidence = source.kind_name, _make_evidence(convention, faults.orientation)
    if faults.orientation == "copied":
        yield make_warning(
            "source_orientation_copied",
            "The orientation of the source is the autopilot's own attitude, sent back (median "
            "difference below 0.15°). px4fuse ignores this orientation.",
            "Send no orientation (quaternion of NaN), and do not fuse the yaw (EKF2_EV_CTRL "
            "without bit 3).",
            evidence,
        )
        return
    agreement_text = (
        "With the corrected orientation, roll and pitch agree with the autopilot (median "
        f"difference {orientation.tilt_difference_deg:.1f}°)"
    )
    fault_text, action = {
        "order": (
            f"The quaternion of {sensor_name} is sent in the order x, y, z, w, but PX4 reads w, x, "
            f"y, z. {agreement_text}",
            "Write w first (px4_msgs: q[0] is w). Eigen coeffs(), SciPy as_quat() and "
            "geometry_msgs have w last.",
        ),
        "frames": (
            f"The orientation of {sensor_name} rotates {orientation.frames}, but PX4 expects "
            f"FRD to NED. {agreement_text}",
            describe_quaternion_conversion(orientation.frames),
        ),
        "heading": (
            f"The heading that {sensor_name} sends differs by "
            f"{orientation.heading_error_deg or 0.0:+.0f}° (clockwise from above) from the heading "
            "estimated from positions and IMU",
            "Define the rigid body with x forward. An error of 90° is often an unconverted ENU "
            "heading.",
        ),
    }[faults.orientation]
    yield make_error(
        "source_orientation_wrong",
        f"{fault_text}. If EKF2 fuses the yaw of the source, EKF2's heading becomes wrong.",
        f"{action} Until the orientation is correct, do not fuse the yaw (EKF2_EV_CTRL bit 3).",
        evidence,
    )
