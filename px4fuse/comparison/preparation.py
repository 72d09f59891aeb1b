"""Choice of position source, segment and axes of a comparison, before any filter runs."""

import math
from dataclasses import replace

import numpy as np
from msgspec import structs

from px4fuse.convention.check import determine_source_convention
from px4fuse.convention.correction import convert_to_px4_convention, find_convention_faults
from px4fuse.convention.model import Convention
from px4fuse.core.record import Span
from px4fuse.core.text import capitalise_first_letter
from px4fuse.ekf2.fusion_conditions import find_constant_coordinates
from px4fuse.errors import MissingDataError, SettingsError, suggest_name
from px4fuse.filter.settings import SETTING_RANGES, Settings, requested_settings
from px4fuse.filter.signals import (
    AISLE_AXIS,
    MIN_MEASUREMENTS,
    Segment,
    cut_to_segment,
    interpolate_attitude,
    make_axes,
)
from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_POS, MODEL_PARAMETERS
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    HEIGHT_ONLY_REASON,
    POSITION_FILE_ORIGIN,
    Columns,
    Ekf2,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
    join_flights,
)
from px4fuse.readers.mavlink_messages import POSITION_MESSAGE_TYPES
from px4fuse.readers.px4_innovations import (
    GNSS,
    GNSS_WITH_BAROMETER_HEIGHT,
    has_fused_aid,
    replace_vision_by_gnss_innovations,
)
from px4fuse.readers.px4_positions import NO_FIX_ACTION
from px4fuse.readers.px4_topics import SOURCE_TRACK_NAMES
from px4fuse.request import ComparisonRequest, HeightSensor
from px4fuse.trajectory.rotation import to_rotation_matrix

from .model import PreparedComparison
from .projection import find_observation_variance

NO_SEPARATE_TRUTH = Unavailable(
    "ground truth",
    "KF uses the only ground truth in the log as its position source",
    "Choose another position source for KF with --position-source.",
)
# Default axes if the height of the source is constant or too noisy (GNSS)
HORIZONTAL_AXES = (AISLE_AXIS, "north", "east")


def prepare_comparison_inputs(
    flight: Flight, request: ComparisonRequest, *, keep_positions_as_sent: bool = False
) -> PreparedComparison:
    """Choose position source, segment and axes of a flight for the comparison of KF with EKF2.

    With ``keep_positions_as_sent``, axes, unit and clock of the positions are neither checked nor
    corrected. This is used to list the contents of a log, and for exercises in which students must
    find such faults.

    Raises
    ------
    MissingDataError
        The flight has no position source, or the source lacks a requested axis.
    SettingsError
        A setting is out of range, the segment is empty, or required acceleration is missing.
    """
    # 1. Position source, with corrected timestamps, axes and unit
    for name in ("start_s", "end_s", "clock_offset_s"):
        value = getattr(request, name)
        if isinstance(value, float) and not math.isfinite(value):
            raise SettingsError(f"`{name}` {value:g} is not a finite number.")
    settings = requested_settings(request)
    source, source_reason = choose_source(flight, request.position_source)
    if source_kind := request.source_kind:
        source = replace(source, origin=structs.replace(source.origin, kind=source_kind))
    source = shift_timestamps(source, settings.clock_offset_s)
    flight, source, settings, convention = _correct_convention(
        flight, source, settings, is_checked=not (keep_positions_as_sent or flight.log.is_assessed)
    )
    # 2. Lever arm, origin and height of the positions. Lever arm and origin need the corrected axes
    # and timestamps of step 1. The choice of axes in step 3 needs the final heights
    source = _subtract_lever_arm(source, flight)
    source = _shift_vision_to_ekf2_origin(source, flight)
    source = _use_barometer_height(source, flight, request.height)
    flight = select_source_innovations(flight, source)
    # 3. Segment and axes
    segment = choose_segment(flight, source, request.start_s, request.end_s)
    # GNSS heights are noisy, so they are analysed only on request
    is_gnss = source.origin.is_fused_as_gnss
    has_no_height = is_gnss or "z" in find_constant_coordinates(source)
    axis_names = request.axes or (HORIZONTAL_AXES if has_no_height else None)
    axes = make_axes(flight, source, segment, names=axis_names, heading_deg=request.heading_deg)
    if isinstance(flight.truth, Truth) and flight.truth.name == source.name:
        flight = replace(flight, truth=NO_SEPARATE_TRUTH)
    # 4. Default settings of KF that depend on the log: SIGMA_Z for GNSS is √R of EKF2's fusion, and
    # without IMU data the acceleration is zero
    if is_gnss and request.sigma_z_m is None:
        default_noise_m = MODEL_PARAMETERS[GNSS_POS.noise].default
        sigma_z_m = (
            find_observation_variance(flight, source, axes[0], segment, default_noise_m) ** 0.5
        )
        if sigma_z_m >= SETTING_RANGES["sigma_z_m"].low:
            settings = replace(settings, sigma_z_m=float(f"{sigma_z_m:.3g}"))
    notes, missing_data = (*flight.log.notes, *source.notes), flight.missing
    acceleration = axes[0].acceleration
    if settings.input == "imu" and isinstance(acceleration, Unavailable):
        if request.input == "imu":
            raise SettingsError(
                f"{flight.log.name}: `input` imu needs acceleration, but the log contains none: "
                f"{acceleration}"
            )
        settings = replace(settings, input="zero")
        notes += (
            f"KF assumes constant velocity, because acceleration is missing: {acceleration.reason}",
        )
        missing_data += () if acceleration in missing_data else (acceleration,)
    return PreparedComparison(
        flight, source, source_reason, segment, settings, axes, notes, missing_data, convention
    )


def _correct_convention(
    flight: Flight, source: PositionTrack, settings: Settings, *, is_checked: bool
) -> tuple[Flight, PositionTrack, Settings, Convention | None]:
    """Check and correct axes, unit, clock and orientation of the positions.

    Positions that are already in NED are not checked: GNSS, and positions that EKF2 aligned with
    its own frame.
    """
    is_in_ned = source.origin.is_gnss or source.origin.route == ALIGNED_BY_EKF2_ORIGIN.route
    convention = (
        determine_source_convention(flight, source) if is_checked and not is_in_ned else None
    )
    # A time offset from the user replaces the detected one
    if convention is not None and settings.clock_offset_s:
        convention = structs.replace(convention, late_s=0.0)
    faults = find_convention_faults(convention, flight, source.frame)
    if convention is None or not faults:
        return flight, source, settings, convention
    # convert_to_px4_convention adds -late_s to the timestamps: report this as clock offset of KF
    offset_range = SETTING_RANGES["clock_offset_s"]
    clock_offset_s = np.clip(
        settings.clock_offset_s - faults.late_s, offset_range.low, offset_range.high
    )
    settings = replace(settings, clock_offset_s=float(clock_offset_s))
    return *convert_to_px4_convention(flight, source, convention, faults), settings, convention


def select_source_innovations(flight: Flight, track: PositionTrack) -> Flight:
    """Replace EKF2's vision innovations by GNSS innovations if GNSS is the position source.

    A flight with another position source is returned unchanged.
    """
    if isinstance(flight.ekf2, Unavailable) or not track.origin.is_fused_as_gnss:
        return flight
    ekf2 = replace_vision_by_gnss_innovations(
        flight.ekf2, GNSS if track.barometer is None else GNSS_WITH_BAROMETER_HEIGHT
    )
    # GNSS innovations replace vision innovations, so missing vision innovations are not reported.
    # Missing position sources (entries with the field source) are not reported either, because GNSS
    # is the position source
    missing_vision_innovations, missing_gnss_innovations = (
        [item for item in each.innovations.values() if isinstance(item, Unavailable)]
        for each in (flight.ekf2, ekf2)
    )
    other_missing_data = [
        item
        for item in flight.missing
        if not item.source and item not in missing_vision_innovations
    ]
    streams = dict(flight.streams)
    # The GNSS innovations are a separate stream with own topics. Its other fields are those of the
    # stream "ekf2_state"
    if "ekf2_state" in streams and ekf2.aids:
        streams["ekf2_innovations"] = replace(streams["ekf2_state"], topics=ekf2.innovation_topics)
    missing_data = (*other_missing_data, *missing_gnss_innovations)
    return replace(flight, ekf2=ekf2, streams=streams, missing=missing_data)


def choose_source(flight: Flight, name: str | None = None) -> tuple[PositionTrack, str]:
    """Choose a position source of the log, and return it with the reason.

    Positions as received are preferred to positions from EKF2's topics. GNSS is chosen only if EKF2
    fused it.

    Raises
    ------
    MissingDataError
        The log has no position source, or none of this name.
    """
    if name is None:
        for track in flight.positions:
            if track.origin.is_selectable_by_default:
                return track, _explain_choice(track)
        missing_source = explain_missing_source(flight)
        raise MissingDataError(f"{flight.log.name}: {missing_source.reason}", missing_source.remedy)
    for track in flight.positions:
        if track.name == name:
            return track, "chosen with --position-source"
    track_names = [track.name for track in flight.positions]
    reasons = {missing.source: missing.reason for missing in flight.missing}
    raise MissingDataError(
        f"{flight.log.name}: position source {name}: {reasons.get(name, 'no such source')}",
        f"{suggest_name(name, track_names)}Position sources in this log: "
        f"{', '.join(track_names) or 'none'}.",
    )


def _subtract_lever_arm(track: PositionTrack, flight: Flight) -> PositionTrack:
    """Subtract the sensor's lever arm (EKF2 parameters) from the positions."""
    attitude = flight.attitude
    if not any(track.lever_arm_m) or isinstance(attitude, Unavailable) or track.frame != "NED":
        return track
    quaternions = interpolate_attitude(attitude, track.samples.index.to_numpy())
    lever_arm_ned_m = to_rotation_matrix(quaternions) @ track.lever_arm_m
    samples = track.samples.copy()
    samples[Columns.POSITION] -= lever_arm_ned_m
    forward_m, right_m, down_m = track.lever_arm_m
    lever_arm_note = (
        "positions converted from the sensor to the vehicle's origin by the lever arm "
        f"{forward_m:g} m forward, {right_m:g} m right, {down_m:g} m down (from EKF2 parameters)"
    )
    return replace(track, samples=samples, notes=(*track.notes, lever_arm_note))


def _shift_vision_to_ekf2_origin(track: PositionTrack, flight: Flight) -> PositionTrack:
    """Shift vision positions to EKF2's origin if EKF2 also fused GNSS."""
    ekf2, samples = flight.ekf2, track.samples
    if (
        track.frame != "NED"
        or not track.origin.is_vision
        or isinstance(ekf2, Unavailable)
        or not has_fused_aid(ekf2)
    ):
        return track
    north_m, east_m, down_m = offset_m = [
        (samples[column] - np.interp(samples.index, ekf2.state.index, ekf2.state[column])).median()
        for column in Columns.POSITION
    ]
    if not np.isfinite(offset_m).all():
        return track
    samples = samples.copy()
    samples[Columns.POSITION] -= offset_m
    origin_note = (
        f"positions of {track.name} were shifted to EKF2's origin by their median offset "
        f"({north_m:.1f} m north, {east_m:.1f} m east, {down_m:.1f} m down)"
    )
    return replace(track, samples=samples, notes=(*track.notes, origin_note))


def _use_barometer_height(
    track: PositionTrack, flight: Flight, height_sensor: HeightSensor | None
) -> PositionTrack:
    """Replace GNSS height by barometer height, if requested or if EKF2 fused the barometer only."""
    ekf2, barometer_heights, log_name = flight.ekf2, flight.barometer, flight.log.name
    if height_sensor and not track.origin.is_fused_as_gnss:
        raise SettingsError(
            f"{log_name}: the option `height` needs GNSS as position source, not {track.name}."
        )
    if height_sensor == "barometer" and barometer_heights is None:
        raise MissingDataError(
            f"{log_name}: the log contains no barometer height.", GNSS["vertical"].logging_remedy
        )
    # Without a request, use the height sensor that EKF2 used
    has_ekf2_only_barometer = (
        track.origin.is_fused_as_gnss
        and has_fused_aid(ekf2, BAROMETER.name)
        and not has_fused_aid(ekf2, GNSS["vertical"].aid)
    )
    uses_barometer = height_sensor == "barometer" or (
        height_sensor is None and has_ekf2_only_barometer
    )
    if not uses_barometer or barometer_heights is None:
        return track
    # The reference of barometer heights is arbitrary: shift them to EKF2's height, if possible
    offset_m = barometer_heights["down_m"].iloc[0]
    height_note = "heights are barometer heights relative to the first barometer sample"
    if isinstance(ekf2, Ekf2):
        ekf2_down_m = np.interp(
            barometer_heights.index, ekf2.state.index, ekf2.state["down_m"], np.nan, np.nan
        )
        if np.isfinite(ekf2_down_m).any():
            offset_m = float(np.nanmedian(barometer_heights["down_m"] - ekf2_down_m))
            height_note = (
                "heights are barometer heights minus their median difference to EKF2's height"
            )
    return replace(
        track,
        barometer=barometer_heights - offset_m,
        description=f"{track.description}, barometer height",
        notes=(*track.notes, height_note),
    )


def explain_missing_source(flight: Flight) -> Unavailable:
    """Return the reason why the log has no position source, and the action for the user."""
    # 1. Possible position sources and remedy, for a ULog or for MAVLink telemetry
    topics = f"{', '.join(SOURCE_TRACK_NAMES)}, and EKF2 innovations of external vision"
    remedy = (
        "set SDLOG_PROFILE to 129 and send the UWB position to PX4 as VISION_POSITION_ESTIMATE, or "
        "give the position file with --position."
    )
    if flight.log.format.startswith("MAVLink"):
        topics = ", ".join(dict.fromkeys(source.message for source in POSITION_MESSAGE_TYPES))
        or_ulog = ", or analyse the ULog of this flight" if flight.log.writes_ulog else ""
        remedy = (
            f"give the position file of the positioning system as argument `position`{or_ulog}."
        )
    # 2. Sources in the log that are not used by default: EKF2 did not fuse them
    if flight.positions:
        track = flight.positions[0]
        remedy = (
            f"use {track.name}, which EKF2 did not fuse (--position-source {track.name}), "
            f"or {remedy}"
        )
    # 3. More precise reasons. A source with heights only replaces the general reason. GNSS without
    # position fix is added to it
    reason = f"no external position in this log (possible sources: {topics})"
    for item in flight.missing:
        if item.reason == HEIGHT_ONLY_REASON:
            reason = f"{item.source}: {HEIGHT_ONLY_REASON}"
    for item in flight.missing:
        if item.remedy == NO_FIX_ACTION:
            reason += f"; {item.source}: {item.reason}"
            remedy = f"{NO_FIX_ACTION} Or {remedy}"
    if flight.log.damage:
        reason = f"the file is damaged, and {reason}"
    if flight.log.autopilot != "PX4":
        reason += f"; the autopilot is {flight.log.autopilot}, so there is no EKF2"
    return Unavailable("position source", reason, capitalise_first_letter(remedy))


def _explain_choice(track: PositionTrack) -> str:
    if track.origin == POSITION_FILE_ORIGIN:
        return "the user gave this position file with --position"
    if track.origin.is_fused_as_gnss:
        return "the only position source in the log, fused by EKF2"
    return "source chosen automatically"


def shift_timestamps(track: PositionTrack, clock_offset_s: float) -> PositionTrack:
    """Add a time offset (s) to all timestamps of a position track."""
    if clock_offset_s == 0.0:
        return track
    shifted_tables = {
        name: table.set_axis(table.index + clock_offset_s)
        for name in ("samples", "orientation", "velocity", "invalid_reasons", "status")
        if (table := getattr(track, name)) is not None
    }
    return replace(track, **shifted_tables)


def choose_segment(
    flight: Flight, track: PositionTrack, start_s: float | None = None, end_s: float | None = None
) -> Segment:
    """Choose the time span to analyse: by default, the longest flight with positions.

    ``start_s`` and ``end_s`` are limits in seconds from the first sample.

    Raises
    ------
    SettingsError
        The segment is empty or contains fewer than three measurements.
    """
    if start_s is not None and end_s is not None and end_s <= start_s:
        raise SettingsError(
            f"The end ({end_s:.6g} s) is not after the start ({start_s:.6g} s).",
            "Change --start or --end.",
        )
    source_span_s, log = track.samples.index[[0, -1]].tolist(), flight.log
    available_span_s = max(source_span_s[0], 0.0), min(source_span_s[1], log.duration_s)
    (chosen_start_s, chosen_end_s), reason = _choose_default_span(flight, available_span_s)
    options = {"--start": start_s, "--end": end_s}
    if given_options := [name for name, time_s in options.items() if time_s is not None]:
        chosen_start_s = chosen_start_s if start_s is None else start_s
        chosen_end_s = chosen_end_s if end_s is None else end_s
        reason = f"chosen with {' and '.join(given_options)}"
        # If the chosen times are outside the log, do not clip them: the error message below then
        # states the times that the user chose
        clipped_span_s = max(chosen_start_s, 0.0), min(chosen_end_s, log.duration_s)
        is_inside_log = clipped_span_s[0] < clipped_span_s[1]
        if is_inside_log and clipped_span_s != (chosen_start_s, chosen_end_s):
            chosen_start_s, chosen_end_s = clipped_span_s
            reason += "; the log covers only part of the chosen time"
    segment = Segment(
        max(chosen_start_s, available_span_s[0]),
        min(chosen_end_s, available_span_s[1]),
        reason,
        (chosen_start_s, chosen_end_s),
    )
    position_count = len(cut_to_segment(track.samples, segment))
    if position_count < MIN_MEASUREMENTS:
        raise SettingsError(
            f"{log.name}: {track.name} has {position_count} positions between "
            f"{chosen_start_s:.6g} s and {chosen_end_s:.6g} s (at least {MIN_MEASUREMENTS} are "
            f"needed). The positions are from {source_span_s[0]:.2f} s to {source_span_s[1]:.2f} "
            "s.",
            "Change --start or --end.",
        )
    return segment


def _choose_default_span(flight: Flight, available_span_s: Span) -> tuple[Span, str]:
    """Return the span of the flight with the longest time of available positions, and the reason.

    Return the whole span if no flight has positions.
    """
    reason = "the whole time span with positions, because "
    if isinstance(flight.airborne, Unavailable):
        return available_span_s, f"{reason}the log contains no land detector"
    if not flight.airborne:
        return available_span_s, f"{reason}the vehicle stayed on the ground"
    available_start_s, available_end_s = available_span_s

    def compute_duration_with_positions_s(span_s: Span) -> float:
        return min(span_s[1], available_end_s) - max(span_s[0], available_start_s)

    flight_spans_s = join_flights(flight.airborne)
    longest_span_s = max(flight_spans_s, key=compute_duration_with_positions_s)
    if compute_duration_with_positions_s(longest_span_s) <= 0.0:
        start_s, end_s = longest_span_s
        whole_span_s = min(start_s, available_start_s), max(end_s, available_end_s)
        return whole_span_s, f"{reason}there are no positions in flight"
    reason = "positions available and vehicle airborne"
    other_flight_texts = [
        f"{start_s:.1f} to {end_s:.1f} s (--start {start_s:.1f} --end {end_s:.1f})"
        for start_s, end_s in flight_spans_s
        if start_s != longest_span_s[0]
    ]
    if other_flight_texts:
        reason += (
            f"; this is the longest of {len(flight_spans_s)} flights; the others: "
            f"{', '.join(other_flight_texts)}"
        )
    return longest_span_s, reason
