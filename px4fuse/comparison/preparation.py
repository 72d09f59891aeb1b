"""What a comparison begins with: the source, the segment and the axes, before any filter runs."""

from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from msgspec import structs

from px4fuse.comparison import say
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.projection import observation_variance
from px4fuse.ekf2_parameters import BAROMETER, GNSS_POS, PARAMETERS
from px4fuse.errors import MissingDataError, SettingsError, suggest_name
from px4fuse.filter.settings import SIGMA_Z_RANGE_M, Settings
from px4fuse.filter.signals import AISLE, MIN_MEASUREMENTS, Segment, make_axes, within
from px4fuse.flight import Columns, Ekf2, Flight, PositionTrack, Truth, Unavailable
from px4fuse.origin import POSITION_FILE, PositionKind
from px4fuse.plain import capitalise_first
from px4fuse.readers.mavlink_messages import POSITION_INPUTS
from px4fuse.readers.px4_innovations import (
    GNSS,
    GNSS_AND_BAROMETER,
    fused_aid,
    with_gnss_innovations,
)
from px4fuse.readers.px4_topics import TOPIC_ORIGINS
from px4fuse.record import missing_data
from px4fuse.request import HeightName
from px4fuse.trajectory.rotation import interpolate, matrix

# Of the names under which logs have external positions, PX4's topics and MAVLink's messages
LOGGED_ORIGINS = TOPIC_ORIGINS | {source.name: source.origin for source in POSITION_INPUTS}
NOT_ITS_OWN_TRUTH = missing_data("own_truth")


# A receiver's height is much noisier than its position, and SIGMA_Z is one number
GNSS_AXES = (AISLE, "north", "east")


class Choices(TypedDict, total=False):
    """What of a flight is compared.

    Attributes
    ----------
    axes : tuple of str
        From "north", "east", "down", "aisle"; by default all that the source supports, of GNSS
        the horizontal ones.
    heading_deg : float
        Of the aisle.
    position_source : str
        Name of a track of the flight.
    source_kind : {"uwb", "vio", "mocap", "gnss"}
        What it is; by default what its messages make of it.
    height : {"gnss", "barometer"}
        What "down" is from where the source is GNSS; by default the one that EKF2 fused, GNSS
        first.
    start_s, end_s : float
        Segment, seconds from the first data.
    input_required : bool
        Raise instead of falling back to ``input="zero"`` where the log has no acceleration.
    sigma_z_given : bool
        By default. Otherwise SIGMA_Z of GNSS is what EKF2 takes, its median √R, where that is
        known.
    """

    axes: tuple[str, ...] | None
    heading_deg: float | None
    position_source: str | None
    source_kind: PositionKind | None
    height: HeightName | None
    start_s: float | None
    end_s: float | None
    input_required: bool
    sigma_z_given: bool


def prepare(
    flight: Flight,
    settings: Settings | None = None,
    **choices: Unpack[Choices],
) -> Comparison:
    """Choose the source, the segment and the axes.

    Parameters
    ----------
    flight : Flight
    settings : Settings, optional
    **choices
        As :class:`Choices` has them.

    Raises
    ------
    MissingDataError
        No position source, or no such axis.
    SettingsError
        An empty segment; no acceleration while that is required.
    """
    settings = settings or Settings()
    track, reason = choose_source(flight, choices.get("position_source"))
    if kind := choices.get("source_kind"):
        track = replace(track, origin=structs.replace(track.origin, kind=kind))
    track = _move_to_vehicle(shift_clock(track, settings.clock_offset_s), flight)
    track = _use_barometer_height(track, flight, choices.get("height"))
    flight = flight_for_source(flight, track)
    missing = flight.missing
    segment = choose_segment(flight, track, choices.get("start_s"), choices.get("end_s"))
    names, heading_deg = choices.get("axes"), choices.get("heading_deg")
    if names is None and track.origin.fused_as_gnss:
        names = GNSS_AXES
    lines = make_axes(flight, track, segment, names=names, heading_deg=heading_deg)
    if isinstance(flight.truth, Truth) and flight.truth.name == track.name:
        flight = replace(flight, truth=NOT_ITS_OWN_TRUTH)
    notes = (*flight.log.notes, *track.notes)
    if track.origin.fused_as_gnss and not choices.get("sigma_z_given", True):
        usual_m = PARAMETERS[GNSS_POS.noise].default
        sigma_z_m = observation_variance(flight, track, lines[0], segment, usual_m) ** 0.5
        if sigma_z_m >= SIGMA_Z_RANGE_M[0]:
            settings = replace(settings, sigma_z_m=float(f"{sigma_z_m:.3g}"))
    acceleration = lines[0].acceleration
    if settings.input == "imu" and isinstance(acceleration, Unavailable):
        if choices.get("input_required"):
            raise SettingsError(f"{flight.log.name}: `input` imu: {acceleration}")
        settings = replace(settings, input="zero")
        notes += (f"no acceleration input ({acceleration.reason}): constant velocity was used",)
        missing += () if acceleration in missing else (acceleration,)
    return Comparison(flight, track, reason, segment, settings, lines, notes, missing)


def flight_for_source(flight: Flight, track: PositionTrack) -> Flight:
    """The flight with EKF2's innovations of GNSS where that is the source, else as it is."""
    if isinstance(flight.ekf2, Unavailable) or not track.origin.fused_as_gnss:
        return flight
    # what the log lacks of another source is no lack here
    missing_of_vision, streams = _missing_of_vision(flight.ekf2), dict(flight.streams)
    ekf2 = with_gnss_innovations(
        flight.ekf2, GNSS if track.barometer is None else GNSS_AND_BAROMETER
    )
    missing = tuple(
        part for part in flight.missing if not part.source and part not in missing_of_vision
    )
    if "ekf2_state" in streams and ekf2.aids:
        streams["ekf2_innovations"] = replace(streams["ekf2_state"], topics=ekf2.innovation_topics)
    return replace(flight, ekf2=ekf2, streams=streams, missing=missing + _missing_of_vision(ekf2))


def _missing_of_vision(ekf2: Ekf2) -> tuple[Unavailable, ...]:
    """Innovations that are not there, each with the reason."""
    return tuple(part for part in ekf2.innovations.values() if isinstance(part, Unavailable))


def choose_source(flight: Flight, name: str | None = None) -> tuple[PositionTrack, str]:
    """Choose the position source by preference, or by name.

    Parameters
    ----------
    flight : Flight
    name : str, optional
        One of the track names; by default the best one; GNSS only where EKF2 fused it.

    Returns
    -------
    track : PositionTrack
    reason : str
        One sentence: why this one.

    Raises
    ------
    MissingDataError
        The log holds no (such) track; the text says what was looked for and what would log it.
    """
    if name is None:
        for track in flight.positions:
            if track.origin.is_automatic:
                return track, _reason_for_choice(flight, track)
        no_track = explain_missing_source(flight)
        raise MissingDataError(f"{flight.log.name}: {no_track.reason}", no_track.remedy)
    for track in flight.positions:
        if track.name == name:
            return track, "chosen with --position-source"
    names = [track.name for track in flight.positions]
    reasons = {missing.source: missing.reason for missing in flight.missing}
    raise MissingDataError(
        f"{flight.log.name}: position source {name}: {reasons.get(name, 'no such source')}",
        f"{suggest_name(name, names)}This log has: {', '.join(names) or 'none'}.",
    )


def _move_to_vehicle(track: PositionTrack, flight: Flight) -> PositionTrack:
    """The positions of the vehicle, where EKF2 is told that the sensor is not at its origin."""
    attitude = flight.attitude
    if not any(track.lever_arm_m) or isinstance(attitude, Unavailable) or track.frame != "NED":
        return track
    attitude_samples = attitude.index.to_numpy(), attitude[Columns.QUATERNION].to_numpy()
    lever_arm_ned = matrix(
        interpolate(track.samples.index.to_numpy(), *attitude_samples)
    ) @ np.asarray(track.lever_arm_m)
    samples = track.samples.copy()
    samples[Columns.POSITION] -= lever_arm_ned
    forward, right, down = track.lever_arm_m
    note = say("of_vehicle", forward=forward, right=right, down=down)
    return replace(track, samples=samples, notes=(*track.notes, note))


def _use_barometer_height(
    track: PositionTrack, flight: Flight, height_name: HeightName | None
) -> PositionTrack:
    """The track with the barometer for its height, where that is asked for or what EKF2 fused.

    A barometer has no zero: it is put where EKF2's is.
    """
    ekf2, heights, name = flight.ekf2, flight.barometer, flight.log.name
    if height_name and not track.origin.fused_as_gnss:
        raise SettingsError(f"{name}: `height` is for GNSS, and the position is {track.name}.")
    is_fused_by_ekf2 = fused_aid(ekf2, BAROMETER.name) and not fused_aid(ekf2, GNSS.vertical)
    uses_barometer = height_name == "barometer" or (
        height_name is None and track.origin.fused_as_gnss and is_fused_by_ekf2
    )
    if not uses_barometer or heights is None:
        if height_name == "barometer":
            raise MissingDataError(f"{name}: no height by a barometer.", GNSS.to_log)
        return track
    zero_m, zero_text = heights["down_m"].iloc[0], "its first height"
    if isinstance(ekf2, Ekf2):
        down = np.interp(heights.index, ekf2.state.index, ekf2.state["down_m"], np.nan, np.nan)
        offset_m = (
            float(np.nanmedian(heights["down_m"] - down)) if np.isfinite(down).any() else zero_m
        )
        zero_m, zero_text = offset_m, "where it is EKF2's in the median"
    note = f"down is by the barometer, from {zero_text}"
    description = f"{track.description}, height by the barometer"
    notes = (*track.notes, note)
    return replace(track, barometer=heights - zero_m, description=description, notes=notes)


def explain_missing_source(flight: Flight) -> Unavailable:
    """Why no track of a flight is a position source by itself, and what would be one."""
    damaged = "the file is damaged, and " if flight.log.damage else ""
    unused = next((track.name for track in flight.positions if not track.origin.is_automatic), "")
    looked_for = "no vehicle_visual_odometry, motion capture or EKF2 innovations of external vision"
    remedy = say("send_positions")
    if flight.log.format.startswith("MAVLink"):
        looked_for = "no VISION_POSITION_ESTIMATE, ODOMETRY or ATT_POS_MOCAP"
        ulog = ", or the ULog" if flight.log.has_ulog else ""
        remedy = f"give the positioning system's own file with `position`{ulog}."
    if unused:
        remedy = say("gps_alone", unused=unused, remedy=remedy)
    reason = f"{damaged}no external position in this log ({looked_for})"
    return Unavailable("position source", reason, capitalise_first(remedy))


def _reason_for_choice(flight: Flight, track: PositionTrack) -> str:
    if track.origin == POSITION_FILE:
        return "given with --position"
    if track.origin.fused_as_gnss:
        return "what EKF2 fused; no other position is in the log"
    origin_text = f" (from {track.log})" if track.log and track.log != flight.log.name else ""
    better_sources = [
        part.source
        for part in flight.missing
        if part.source in LOGGED_ORIGINS
        and LOGGED_ORIGINS[part.source].preference < track.origin.preference
    ]
    if not better_sources:
        return f"the best source: logged as it arrived{origin_text}"
    return f"the best that this log has{origin_text}; no usable {', '.join(better_sources)}"


def shift_clock(track: PositionTrack, clock_offset_s: float) -> PositionTrack:
    """The same track with ``clock_offset_s`` added to its time stamps."""
    if clock_offset_s == 0.0:
        return track
    shifted_frames = {
        name: frame.set_axis(frame.index + clock_offset_s)
        for name in ("samples", "orientation", "velocity")
        if (frame := getattr(track, name)) is not None
    }
    return replace(track, **shifted_frames)


def choose_segment(
    flight: Flight, track: PositionTrack, start_s: float | None = None, end_s: float | None = None
) -> Segment:
    """Choose the part of the log to analyse: where the source runs and the vehicle flies.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
    start_s, end_s : float, optional
        Override either end (seconds from the first data).

    Raises
    ------
    SettingsError
        The chosen part is empty or holds fewer than three measurements.
    """
    runs_s = track.samples.index[[0, -1]].tolist()
    low, high = max(runs_s[0], 0.0), min(runs_s[1], flight.log.duration_s)
    if isinstance(flight.airborne, Unavailable):
        reason = "the whole span of the source: the log has no land detector"
    elif not flight.airborne:
        reason = "the whole span of the source: the vehicle never took off"
    else:
        reason = "the whole span of the source: it does not run in flight"
        flying = max(low, flight.airborne[0][0]), min(high, flight.airborne[-1][1])
        if flying[0] < flying[1]:
            (low, high), reason = flying, "where the source runs and the vehicle flies"
    if start_s is not None or end_s is not None:
        low, high = low if start_s is None else start_s, high if end_s is None else end_s
        ends = {"--start": start_s, "--end": end_s}
        option_names = [text for text, value in ends.items() if value is not None]
        reason = f"chosen with {' and '.join(option_names)}"
        clipped = max(low, 0.0), min(high, flight.log.duration_s)
        if clipped != (low, high) and clipped[0] < clipped[1]:
            low, high = clipped
            reason += ", cut at the ends of the data"
    if not low < high:
        raise SettingsError.of(
            "segment_empty", log=flight.log.name, low=low, high=high, runs_s=runs_s
        )
    segment = Segment(low, high, reason)
    count = len(within(track.samples, segment))
    if count < MIN_MEASUREMENTS:
        raise SettingsError.of(
            "segment_short",
            log=flight.log.name,
            count=count,
            track=track,
            segment=segment,
            least=MIN_MEASUREMENTS,
        )
    return segment
