"""Findings on the rotation of the position frame from north, and on EKF2's heading.

A position file with an uncertain alignment also gives a finding.
"""

import math

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import find_aid, format_changes
from px4fuse.core.text import lowercase_first_letter
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.finding import Finding
from px4fuse.flight.ekf2_parameters import EV_CTRL_YAW_MASK, EV_POS
from px4fuse.flight.model import Columns, Ekf2, Flight, Unavailable, rows_between
from px4fuse.trajectory.rotation import heading as heading_of
from px4fuse.trajectory.rotation import interpolate

from .ekf2_fusion import MAX_FUSED_FRACTION_FOR_SEVERITY_ERROR
from .ekf2_settings import find_confirmed_noise_rerun
from .model import (
    Findings,
    compute_flag_fraction,
    error_if,
    finding,
    magnetometer_advice,
    make_error,
    make_note,
    make_warning,
)

# Minimum |yaw misalignment| / σ of its estimate, for a finding: flights without a fault reach 3.2
MIN_MISALIGNMENT_SIGMAS = 4.0
# Minimum yaw misalignment (°) for a finding: magnetic headings of real flights are wrong by 3 to 4°
MIN_HEADING_ERROR_DEG = 5.0
# Minimum yaw misalignment (°), for severity "error": 26 % of the motion appears on the other axis
MIN_SEVERE_HEADING_ERROR_DEG = 15.0
# Minimum ratio for a finding on heading drift: drift of EKF2's heading against ground truth ÷ drift
# estimated from the position source
MIN_TRUE_TO_ESTIMATED_HEADING_DRIFT_RATIO = 0.5
# Topic of the positions that EKF2 rotated into the frame of its state (EKF2.cpp)
ALIGNED_VISION_TOPIC = "estimator_visual_odometry_aligned"
CHECK_GNSS_DELAY_ACTION = "Check EKF2_GPS_DELAY: a wrong delay also causes a heading error."


def detect(analysis: Analysis) -> Findings:
    if analysis.source.frame == "FRD":
        yield make_frd_positions_finding(analysis)
    heading_error = analysis.heading
    if isinstance(heading_error, HeadingError) and not analysis.source.origin.reconstructed:
        yield from detect_misalignment(analysis, heading_error)
    yield from detect_uncertain_alignment(analysis)


def make_frd_positions_finding(analysis: Analysis) -> Finding:
    """Make the finding that positions are in FRD, so that their x axis is not north."""
    ekf2, sensor_name = analysis.flight.ekf2, analysis.source.kind_name
    fault = (
        f"{analysis.source.positions_text} are in FRD: their x axis points "
        "along the heading at the start, not north."
    )
    note_action = f"In this report, north is the x axis of {sensor_name}."
    if isinstance(ekf2, Ekf2):
        if isinstance(ekf2.fusion_flags, Unavailable):
            message = f"{fault} The log does not show whether EKF2 fused the yaw of {sensor_name}."
            note_action += " Give the ULog of this flight, too: it shows EKF2's frame."
            return make_note("source_frame_frd", message, note_action)
        fused_fraction = compute_flag_fraction(ekf2.fusion_flags["yaw"], analysis.segment)
        if fused_fraction > MAX_FUSED_FRACTION_FOR_SEVERITY_ERROR:
            message = f"{fault} EKF2 fused the yaw of {sensor_name}, so EKF2's axes are also FRD."
            return make_note("source_frame_frd", message, note_action)
    action = "Send the position in NED."
    if analysis.source.orientation is not None:
        action += " Alternatively, let EKF2 fuse the yaw of the source (EKF2_EV_CTRL bit 3)."
    return make_warning(
        "source_frame_frd",
        f"{fault} EKF2 did not fuse the yaw of {sensor_name}, so EKF2's axes are NED.",
        action,
    )


def detect_misalignment(analysis: Analysis, heading_error: HeadingError) -> Findings:
    """Detect a yaw misalignment between positions and IMU."""
    source, systematic_errors = analysis.source, analysis.systematic_errors
    if heading_error.drifts:
        if not _truth_contradicts_heading_drift(analysis.flight, heading_error):
            yield _make_heading_drift_finding(analysis, heading_error)
        return
    # An accelerometer bias resembles a rotation of the positions. If the joint estimate of bias and
    # rotation gives no significant rotation, the bias explains the deviation
    is_explained_by_bias = (
        not isinstance(systematic_errors, Unavailable)
        and source.orientation is None
        and abs(systematic_errors.rotation_rad.value)
        < MIN_MISALIGNMENT_SIGMAS * systematic_errors.rotation_rad.sigma
    )
    rotation_deg = math.remainder(heading_error.misalignment_deg, 360.0)
    sigma_deg = heading_error.sigma_deg
    if is_explained_by_bias or abs(rotation_deg) < max(
        MIN_MISALIGNMENT_SIGMAS * sigma_deg, MIN_HEADING_ERROR_DEG
    ):
        return
    finding_id, reference = "ekf2_heading_error", "EKF2's heading"
    advice = magnetometer_advice(analysis.flight)
    if source.origin.is_gnss:
        reason = "GNSS positions refer to true north, so EKF2's heading is wrong by this rotation."
        _, action = _explain_gnss_heading_error(analysis)
        advice = ""  # the action already contains the advice on the magnetometer
    elif source.name == ALIGNED_VISION_TOPIC:
        reason = "The positions that EKF2 rotated into its own frame do not fit the IMU."
        action = "Align the positioning frame with north."
    else:
        finding_id, reference = "source_frame_misaligned", "the IMU"
        reason = (
            "The positioning frame is not aligned with north, or the magnetic heading is wrong."
        )
        action = f"Rotate the positions by {-rotation_deg:+.0f}° before they are sent."
        if source.alignment is not None:
            action = "Run again with --position-yaw auto."
    if advice:
        action += f" Alternatively: {lowercase_first_letter(advice)}"
    yield finding(
        error_if(abs(rotation_deg) >= MIN_SEVERE_HEADING_ERROR_DEG),
        finding_id,
        f"{source.positions_text} are rotated by {rotation_deg:+.0f}° relative to "
        f"{reference}. The rotation (± {1.96 * sigma_deg:.0f}°, 95 %) is clockwise from above and "
        f"constant over the flight. {reason}",
        action,
        {"misalignment_deg": rotation_deg, "sigma_deg": sigma_deg},
    )


def _explain_gnss_heading_error(analysis: Analysis) -> tuple[str, str]:
    """Return the possible cause of a wrong heading in a flight with GNSS, and the action."""
    if (rerun := find_confirmed_noise_rerun(analysis)) is not None:
        cause = f"a wrong {find_aid(analysis).noise}, which also changes EKF2's heading"
        return cause, f"Set {format_changes(rerun.change)}. Then check the heading again."
    advice = magnetometer_advice(analysis.flight)
    cause = (
        "a magnetometer near currents or steel" if advice else "an error of EKF2's heading source"
    )
    return cause, f"{advice} {CHECK_GNSS_DELAY_ACTION}".lstrip()


def _truth_contradicts_heading_drift(flight: Flight, heading_error: HeadingError) -> bool:
    """Return True if EKF2's heading drifts much less against ground truth than estimated."""
    truth, attitude = flight.truth, flight.attitude
    if (
        isinstance(truth, Unavailable)
        or truth.attitude is None
        or isinstance(attitude, Unavailable)
    ):
        return False
    errors_rad, flight_parts = [], heading_error.find_extreme_parts()
    for part in flight_parts:
        samples = rows_between(attitude, part.start_s, part.end_s)[Columns.QUATERNION]
        true_attitude = interpolate(
            samples.index.to_numpy(), truth.attitude.index.to_numpy(), truth.attitude.to_numpy()
        )
        error_rad = heading_of(samples.to_numpy()) - heading_of(true_attitude)
        errors_rad.append(np.median(np.arctan2(np.sin(error_rad), np.cos(error_rad))))
    true_drift_deg = np.degrees(np.ptp(errors_rad))
    estimated_drift_deg = np.ptp([part.heading_error_deg for part in flight_parts])
    return bool(true_drift_deg < MIN_TRUE_TO_ESTIMATED_HEADING_DRIFT_RATIO * estimated_drift_deg)


def _make_heading_drift_finding(analysis: Analysis, heading_error: HeadingError) -> Finding:
    """Make the finding that EKF2's heading drifts relative to the positions."""
    source = analysis.source
    first_part, last_part = heading_error.find_extreme_parts()
    error_texts = (
        f"{math.remainder(part.heading_error_deg, 360.0):+.0f}° from {part.start_s:.0f} to "
        f"{part.end_s:.0f} s"
        for part in (first_part, last_part)
    )
    heading_change_deg = last_part.heading_error_deg - first_part.heading_error_deg
    estimation_data_text = "positions and IMU"
    if heading_error.by == "orientation":
        estimation_data_text = f"the orientation of {source.kind_name}"
    if source.origin.is_gnss:
        possible_cause, action = _explain_gnss_heading_error(analysis)
        actions = [action]
    else:
        actions = [magnetometer_advice(analysis.flight)]
        possible_cause = "a magnetometer indoors" if actions[0] else "a gyroscope bias"
        if source.orientation is not None:
            possible_cause += ", or heading drift of the odometry"
            ev_ctrl = int(analysis.flight.log.parameters.get(EV_POS.switch, 0.0))
            if not ev_ctrl & EV_CTRL_YAW_MASK:
                actions.append("Let EKF2 fuse the yaw of the source (EKF2_EV_CTRL bit 3).")
    return finding(
        error_if(abs(heading_change_deg) >= MIN_SEVERE_HEADING_ERROR_DEG),
        "ekf2_heading_error",
        f"EKF2's heading drifts by {heading_change_deg:+.0f}° relative to the "
        f"{source.positions_text}. The heading error is {' and '.join(error_texts)} "
        f"(clockwise from above, estimated from {estimation_data_text}). A constant rotation of "
        f"the positions cannot correct the drift. Possible cause: {possible_cause}.",
        " Alternatively: ".join(filter(None, actions)) or "Check the heading source of EKF2.",
        {
            "from_deg": first_part.heading_error_deg,
            "to_deg": last_part.heading_error_deg,
            "from_s": first_part.start_s,
            "to_s": last_part.end_s,
            "p": max(heading_error.drift_p, 1e-300),  # not 0 after an underflow
        },
    )


def detect_uncertain_alignment(analysis: Analysis) -> Findings:
    """Detect a position file whose frame, yaw or time offset is uncertain."""
    alignment = analysis.source.alignment
    if alignment is None:
        return
    for make_finding, sentences in (
        (make_error, alignment.misplaced),
        (make_warning, alignment.warnings),
    ):
        for sentence in sentences:
            yield make_finding(
                "position_file_alignment",
                f"{sentence.rstrip('.')}.",
                "If time offset, frame and yaw of the file are known, run again with "
                "--clock-offset, --position-frame and --position-yaw.",
            )
