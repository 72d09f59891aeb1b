"""Alignment of a position file with a flight: time offset, frame, yaw and origin.

The positions are matched with EKF2's position or with integrated acceleration. Horizontal positions
are complex numbers, north + i·east, so a rotation by yaw is a factor e^{i·yaw}.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.convention.axes import MAX_TIME_OFFSET_S, METRES_PER_UNIT
from px4fuse.convention.check import determine_source_convention
from px4fuse.convention.correction import MIN_FRAME_ROTATION_DEG
from px4fuse.convention.texts import FRAME_AXES, UNIT_NAMES, describe_axes, describe_wrong_unit
from px4fuse.core.arrays import Array
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight.model import (
    POSITION_FILE_ORIGIN,
    Alignment,
    Columns,
    Flight,
    InputFile,
    PositionTrack,
    Unavailable,
    describe_repeated_timestamps,
    time_index,
)
from px4fuse.readers.common import select_valid_rows
from px4fuse.readers.position_file import PositionRecording
from px4fuse.trajectory.model import NED_COMPONENTS_BY_FRAME

from .matching import (
    MIN_CONCORDANCE_CORRELATION_WITHOUT_WARNING,
    AlignmentProblem,
    TrackMatch,
    find_match,
    is_reliable_fit,
    needs_rotation,
)
from .time_and_pose_fit import (
    MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH,
    compute_clipped_rms_m,
)
from .tracks import (
    EKF2_REFERENCE,
    IMU_REFERENCE,
    MIN_MATCHED_SAMPLES,
    MIN_MOTION_M,
    NoMatchError,
    align_samples,
    make_continuous_ekf2_track,
)

# Maximum duration (s) of the data for a comparison with the IMU, to limit the computing time
MAX_CONVENTION_CHECK_SPAN_S = 7200.0


def _explain_mismatch(
    flight: Flight, problem: AlignmentProblem, metres_per_unit: float
) -> tuple[str, str] | None:
    """Return error message and advice if the IMU shows wrong axes or a wrong unit of the file."""
    samples = problem.samples
    # Position file and log may overlap only partly, so time offsets up to the longer of the two
    # durations are tested
    span_s = max(samples.index[-1] - samples.index[0], flight.log.duration_s)
    if span_s > MAX_CONVENTION_CHECK_SPAN_S:
        return None
    time_s = samples.index - samples.index[0] + (problem.lag_s or 0.0)
    positions = samples[["x_m", "y_m", "z_m"]].to_numpy() / metres_per_unit
    position_samples = pd.DataFrame(positions, time_index(time_s.to_numpy()), Columns.POSITION)
    # determine_source_convention uses only the positions of a track; the other fields are empty
    track = PositionTrack("", POSITION_FILE_ORIGIN, "", position_samples, "unknown", "", ())
    max_time_offset_s = span_s if problem.lag_s is None else MAX_TIME_OFFSET_S
    convention = determine_source_convention(flight, track, max_time_offset_s)
    if convention is None or convention.verdict != "determined":
        return None
    faults = []
    if METRES_PER_UNIT[convention.unit] != metres_per_unit:
        unit_names = {METRES_PER_UNIT[unit]: name for unit, name in UNIT_NAMES.items()}
        faults.append(
            describe_wrong_unit(
                convention.unit, "the positions", unit_names[metres_per_unit], is_file=True
            )
        )
    stated_frame = problem.frames[0].upper() if len(problem.frames) == 1 else ""
    # convention.axes are the axes of the file, rounded to multiples of 90°. If the file's frame has
    # an additional rotation, rounded axes do not contradict the frame that the user stated
    is_rotated = abs(convention.rotation_deg) > MIN_FRAME_ROTATION_DEG
    if stated_frame and convention.axes != FRAME_AXES[stated_frame] and not is_rotated:
        faults.append(
            describe_axes(
                convention.axes,
                stated_frame,
                is_mirrored=convention.is_mirrored,
                is_file=True,
            )
        )
    if not faults:
        return None
    fault_texts, actions = zip(*faults, strict=True)
    return "; ".join(fault_texts), " ".join(actions)


# Minimum ratio of the residuals at second best and best time offset, without a warning
MIN_RESIDUAL_RATIO_WITHOUT_WARNING = {EKF2_REFERENCE: 2.0, IMU_REFERENCE: 1.4}
# Maximum difference (s) between the UNIX times of position file and log of one flight
MAX_UNIX_CLOCK_DIFFERENCE_S = 60.0
# Minimum yaw (°) for a message about a misaligned frame
MIN_REPORTED_YAW_DEG = 1.0
# Minimum distance (m) between the origins of the file's frame and of EKF2's frame, for a message
# about a misaligned frame
MIN_REPORTED_SHIFT_M = 1.0


def align_position_file(
    flight: Flight,
    recording: PositionRecording,
    *,
    frame: str | None = None,
    yaw_deg: float | Literal["auto"] | None = None,
    clock_offset_s: float | None = None,
) -> Flight:
    """Convert a position file to the frame and clock of a flight, and add it to the flight.

    Parameters
    ----------
    frame : {"ned", "enu", "nwu", "eus", "edn"}, optional
        Directions of x, y and z in the file.
    yaw_deg : float or "auto", optional
        Yaw of the file's frame relative to EKF2's frame, clockwise from above; default 0.
    clock_offset_s : float, optional
        Boot clock of the autopilot minus clock of the file.

    Raises
    ------
    SettingsError
        An option is invalid.
    MissingDataError
        An omitted option cannot be estimated, or file and log do not overlap in time.
    """
    _check_options(frame, yaw_deg, clock_offset_s)
    samples, name = select_valid_rows(recording.samples, ["x_m", "y_m"]), recording.name
    if len(samples) < MIN_MATCHED_SAMPLES:
        raise MissingDataError(
            f"{name} contains {len(samples)} positions; {MIN_MATCHED_SAMPLES} are needed",
            "Check that the position file contains the whole flight.",
        )
    start_s, end_s = samples.index[[0, -1]].tolist()
    boot_time_s, duration_s = flight.log.boot_time_s, flight.log.duration_s
    spans_text = (
        f"the log is from {boot_time_s:.2f} s to {boot_time_s + duration_s:.2f} s on the boot "
        f"clock, the position file from {start_s:.2f} s to {end_s:.2f} s on a "
        f"{recording.clock_kind} clock"
    )
    # Time (s) from the start of the log to the first position of the file
    file_lag_s = None if clock_offset_s is None else start_s + clock_offset_s - boot_time_s
    if file_lag_s is not None and not start_s - end_s <= file_lag_s <= duration_s:
        raise MissingDataError(
            f"{name}: with --clock-offset {clock_offset_s:.3f} the file does not "
            f"overlap the log ({spans_text})",
            "Correct or omit --clock-offset.",
        )
    yaw_rad = None if yaw_deg == "auto" else float(np.radians(yaw_deg or 0.0))
    problem = AlignmentProblem(
        samples, (frame,) if frame else recording.frames, yaw_rad, file_lag_s
    )
    try:
        match = find_match(flight, problem)
    except NoMatchError as error:
        if fault := _explain_mismatch(flight, problem, recording.metres_per_unit):
            raise MissingDataError(f"{name}: {fault[0]}.", fault[1]) from None
        raise MissingDataError(
            f"{name}: {error.reason}; {spans_text}", f"{error.remedy}."
        ) from None
    frame_reason = _explain_frame(frame, recording, problem, match)
    if yaw_deg is None:
        yaw_reason = "without --position-yaw, px4fuse does not rotate the positions"
    elif match and yaw_rad is None:
        yaw_reason = f"the yaw was estimated with the {match.reference.name}"
    else:
        yaw_reason = "the yaw was given with --position-yaw"
    alignment, aligned_samples = _apply_alignment(
        flight, recording, problem, match, frame_reason, yaw_reason, clock_offset_s
    )
    offset_method = f"matched with {alignment.reference}" if clock_offset_s is None else "as given"
    return _add_track(
        flight,
        recording,
        alignment,
        aligned_samples,
        aligned_samples.index[0] - start_s,
        offset_method,
    )


def _add_track(
    flight: Flight,
    recording: PositionRecording,
    alignment: Alignment,
    aligned_samples: pd.DataFrame,
    time_shift_s: float,
    offset_method: str,
) -> Flight:
    """Add the aligned positions of a file to the flight, as its first position source.

    ``time_shift_s`` is flight time minus time of the file.
    """
    name, log = recording.name, flight.log
    rotation_text = f", rotated by {alignment.yaw_deg:.1f}°" if alignment.yaw_deg else ""
    invalid_reasons, sample_count = recording.reason_by_invalid_row, len(recording.samples)
    # If most timestamps are repeated, the number of dropped rows is stated in clock_map
    clock_map = describe_repeated_timestamps(
        recording.clock_kind, sample_count + recording.dropped_row_count, sample_count
    )
    track = PositionTrack(
        name=name,
        origin=POSITION_FILE_ORIGIN,
        description=f"position file with {len(aligned_samples)} samples in the frame "
        f"{alignment.frame}{rotation_text}",
        samples=aligned_samples,
        frame="NED",
        clock=f"{recording.clock_kind} clock of the position file; boot clock minus this clock: "
        f"{alignment.clock_offset_s:+.3f} s ({offset_method})",
        topics=(name,),
        log=name,
        alignment=alignment,
        clock_map=clock_map,
        invalid_reasons=invalid_reasons.set_axis(invalid_reasons.index + time_shift_s),
        quantisation_step_m=recording.quantisation_step_m,
    )
    notes = [f"{name}: {text}" for text in (*recording.format_detection_notes, *recording.notes)]
    dropped_counts = dict(log.dropped)
    if recording.dropped_row_count and not clock_map:
        dropped_counts[name] = recording.dropped_row_count
    return replace(
        flight,
        log=structs.replace(log, notes=(*log.notes, *notes), dropped=dropped_counts),
        positions=(track, *flight.positions),
        inputs=(InputFile(name, recording.sha256, recording.size_bytes, "position"),),
    )


def _check_options(
    frame: str | None, yaw_deg: float | str | None, clock_offset_s: float | None
) -> None:
    """Raise SettingsError if an option of :func:`align_position_file` is invalid."""
    if frame not in (None, *NED_COMPONENTS_BY_FRAME):
        raise SettingsError(
            f"`frame` {frame} is not a known coordinate frame.",
            f"Use one of {', '.join(NED_COMPONENTS_BY_FRAME)}.",
        )
    if isinstance(yaw_deg, str) and yaw_deg != "auto":
        raise SettingsError(f"`yaw_deg` {yaw_deg} is neither a number (degrees) nor auto.")
    for name, value in (("yaw_deg", yaw_deg), ("clock_offset_s", clock_offset_s)):
        if isinstance(value, float) and not np.isfinite(value):
            raise SettingsError(f"`{name}` {value:g} is not a finite number.")


def _explain_frame(
    given_frame: str | None,
    recording: PositionRecording,
    problem: AlignmentProblem,
    match: TrackMatch | None,
) -> str:
    """Explain in a text for the report how the frame of the file was found."""
    if given_frame:
        return "the frame was given with --position-frame"
    if match and len(problem.frames) != 1:
        reason = (
            f"{match.frame} is the tested frame with the smallest residual against the "
            f"{match.reference.name} ({match.residuals_text})"
        )
        if problem.yaw_rad is None and match.frame == "enu":
            reason += "; nwu was not tested, because it is enu with another yaw"
        return reason
    if recording.format:
        return f"the format {recording.format} defines the frame"
    return "the column names of the position file contain the axis directions"


def _apply_alignment(
    flight: Flight,
    recording: PositionRecording,
    problem: AlignmentProblem,
    match: TrackMatch | None,
    frame_reason: str,
    yaw_reason: str,
    clock_offset_s: float | None,
) -> tuple[Alignment, pd.DataFrame]:
    """Convert the positions of the file, and compare them with EKF2's position.

    Yaw and time offset are those of the user or, if the user gave none, those of the match. Without
    a match, the user gave all parameters.
    """
    boot_time_s, is_yaw_estimated = flight.log.boot_time_s, problem.yaw_rad is None
    frame = match.frame if match else problem.frames[0]
    reference_name = match.reference.name if match else ""
    # Start with the known values, or 0 for values to be estimated. The match replaces the latter
    # below
    yaw_rad, lag_s, origin_m = problem.yaw_rad or 0.0, problem.lag_s or 0.0, np.zeros(3)
    yaw_sigma_deg = time_offset_sigma_s = correlation_with_reference = residual_rms_m = None
    if match and is_yaw_estimated:
        yaw_rad = match.fit.yaw_rad
        yaw_sigma_deg = float(np.degrees(match.fit.yaw_sigma_rad or 0.0))
        if reference_name == EKF2_REFERENCE:  # the IMU cannot determine the frame's origin
            origin_m = match.fit.origin_m
    # lag_s is the time of the file's first position, in seconds from the start of the log.
    # clock_offset_s is the boot clock minus the clock of the file
    time_offset_reason = "the offset was given with --clock-offset"
    if match and clock_offset_s is None:
        lag_s = match.time_offset_fit.lag_s
        time_offset_sigma_s = match.time_offset_fit.lag_sigma_s
        clock_offset_s = lag_s + (boot_time_s - problem.samples.index[0])
        time_offset_reason = (
            f"the position file was matched in time with the {reference_name}; the time offset "
            f"includes any delay of the {reference_name}"
        )
    if match:
        correlation_with_reference = float(
            (np.exp(-1j * yaw_rad) * match.time_offset_fit.coherence).real
        )
    aligned_samples = align_samples(problem.samples, frame, yaw_rad, origin_m, lag_s)
    distance_to_ekf2_m = None
    # Compare the positions of the file with EKF2's position, also if the user gave all parameters
    # and no match was necessary. The match with the IMU is used only if the match with EKF2 failed,
    # so this comparison is then omitted
    if reference_name != IMU_REFERENCE and (
        ekf2_comparison := _compare_with_ekf2(flight, aligned_samples)
    ):
        reference_name = EKF2_REFERENCE
        distance_to_ekf2_m, correlation_with_reference = ekf2_comparison
        residual_rms_m = float(np.sqrt(np.mean(distance_to_ekf2_m**2) / 2.0))
    frame_conflicts, warnings = list[str](), list[str]()
    if match:
        warnings += _find_match_warnings(match, is_yaw_estimated)
        if not is_yaw_estimated:
            frame_conflicts += _find_frame_conflict(match, distance_to_ekf2_m, yaw_rad)
    # A wrong frame also makes the correlation low. Its warning (in frame_conflicts) is more
    # precise, so it replaces the warning about the correlation
    if (
        distance_to_ekf2_m is not None
        and not (is_yaw_estimated or frame_conflicts)
        and correlation_with_reference is not None
        and correlation_with_reference < MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH[EKF2_REFERENCE]
    ):
        warnings.append(
            "The position file does not match the EKF2 position (correlation "
            f"{correlation_with_reference:.2f}). Check time offset, frame and yaw."
        )
    unix_start_s = flight.log.start_unix_s
    if recording.clock_kind == "UNIX" and unix_start_s is not None and clock_offset_s is not None:
        unix_time_difference_s = abs(boot_time_s - clock_offset_s - unix_start_s)
        if unix_time_difference_s >= MAX_UNIX_CLOCK_DIFFERENCE_S:
            warnings.append(
                f"The UNIX times of position file and log differ by {unix_time_difference_s:.0f} "
                "s. Check that both are of the same flight."
            )
    north_m, east_m, down_m = origin_m.tolist()
    alignment = Alignment(
        frame=frame,
        frame_reason=frame_reason,
        yaw_deg=float(np.degrees(yaw_rad)),
        yaw_sigma_deg=yaw_sigma_deg,
        yaw_reason=yaw_reason,
        origin_m=(north_m, east_m, down_m),
        clock_offset_s=float(clock_offset_s or 0.0),
        clock_offset_sigma_s=time_offset_sigma_s,
        clock_reason=time_offset_reason,
        reference=reference_name,
        correlation=correlation_with_reference,
        residual_rms_m=residual_rms_m,
        misplaced=tuple(frame_conflicts),
        warnings=tuple(warnings),
    )
    return alignment, aligned_samples


def _compare_with_ekf2(
    flight: Flight, aligned_samples: pd.DataFrame
) -> tuple[Array, float | None] | None:
    """Return horizontal distances (m) and correlation between file and EKF2 positions."""
    if isinstance(flight.ekf2, Unavailable):
        return None
    try:
        ekf2_track = make_continuous_ekf2_track(flight.ekf2, aligned_samples)
    except NoMatchError:
        return None
    ekf2_position_m, is_known = ekf2_track.at(aligned_samples.index.to_numpy())
    if np.count_nonzero(is_known) < MIN_MATCHED_SAMPLES:
        return None
    file_position_m = aligned_samples[Columns.POSITION[:2]].to_numpy()[is_known]
    ekf2_position_m = ekf2_position_m[is_known, :2]
    distance_to_ekf2_m = np.linalg.norm(file_position_m - ekf2_position_m, axis=1)
    file_position_m -= file_position_m.mean(axis=0)
    ekf2_position_m -= ekf2_position_m.mean(axis=0)
    norm_product = np.linalg.norm(file_position_m) * np.linalg.norm(ekf2_position_m)
    if norm_product == 0.0 or np.ptp(ekf2_position_m, axis=0).max() < MIN_MOTION_M:
        return distance_to_ekf2_m, None
    return distance_to_ekf2_m, float(np.sum(file_position_m * ekf2_position_m) / norm_product)


def _find_frame_conflict(
    match: TrackMatch, distance_to_ekf2_m: Array | None, yaw_rad: float
) -> Iterator[str]:
    """Describe a rotation of the file's frame relative to the reference; nothing without one.

    With ``distance_to_ekf2_m``, the origin of the frame is compared with EKF2's origin, too. A
    match with the IMU gives only the rotation.
    """
    reference_name, fit = match.reference.name, match.fit_with_estimated_yaw
    yaw_deg = np.degrees(np.angle(np.exp(1j * (fit.yaw_rad - yaw_rad))))
    if distance_to_ekf2_m is None:
        # Without a comparison with EKF2, only a rotation can be detected: the origin of the file's
        # frame is estimated in each fit, so a shift does not increase the residuals
        has_conflict, shift_text = match.is_given_yaw_wrong, ""
    else:
        # A rotation and a shift of the file's frame both increase its distance to EKF2. Division by
        # √2 converts the RMS distance to the RMS residual per horizontal axis
        residual_m = compute_clipped_rms_m(distance_to_ekf2_m) / np.sqrt(2.0)
        shift_m = np.hypot(*fit.origin_m[:2])
        has_conflict = (
            is_reliable_fit(fit, reference_name)
            and needs_rotation(residual_m, fit, reference_name)
            # GNSS determines EKF2's origin only to about 1 m
            and (abs(yaw_deg) >= MIN_REPORTED_YAW_DEG or shift_m >= MIN_REPORTED_SHIFT_M)
        )
        shift_text = f"The position file has its origin {shift_m:.1f} m from EKF2's origin. "
    if has_conflict:
        yield (
            f"The frame of the position file is rotated by {yaw_deg:.1f}° relative to the "
            f"{reference_name}. {shift_text}Give --position-yaw auto to estimate yaw and origin."
        )


def _find_match_warnings(match: TrackMatch, is_yaw_estimated: bool) -> Iterator[str]:
    """Yield warnings about an uncertain match of the position file."""
    reference_name = match.reference.name
    fit = match.time_offset_fit
    if fit.concordance_correlation < MIN_CONCORDANCE_CORRELATION_WITHOUT_WARNING[reference_name]:
        yield (
            f"The position file matches the {reference_name} poorly: Lin's concordance correlation "
            f"coefficient is {fit.concordance_correlation:.2f}."
        )
    if fit.second_to_best_residual_ratio < MIN_RESIDUAL_RATIO_WITHOUT_WARNING[reference_name]:
        yield (
            "A time offset that differs from the estimate by "
            f"{fit.second_peak_lag_difference_s:+.1f} s fits nearly as well (residual "
            f"{fit.second_to_best_residual_ratio:.1f} times larger). "
            "Check the time offset, or set --clock-offset."
        )
    if is_yaw_estimated and reference_name == IMU_REFERENCE:
        yield (
            "The yaw was estimated with the IMU, with an error of 1° to 6°. The origin of the "
            "file's frame is unknown and set to 0."
        )
