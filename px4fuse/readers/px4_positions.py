"""Reader of positions and ground truth in a ULog."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.core.arrays import Array, ArrayPair, IntArray
from px4fuse.flight.ekf2_parameters import (
    EV_POS,
    GNSS_MODE_PARAMETER,
    GNSS_POS,
    fill_parameters_with_defaults,
)
from px4fuse.flight.model import (
    HEIGHT_ONLY_REASON,
    SENDER_CLOCK,
    ClockConversion,
    Columns,
    Ekf2,
    PositionTrack,
    SourceOrigin,
    Truth,
    Unavailable,
    compute_sample_rate_hz,
    describe_repeated_timestamps,
    infer_position_kind,
    time_index,
)

from .common import (
    classify_invalid_positions,
    estimate_quantisation_step,
    interpolate_inside_time_span,
    join_nearest_samples,
    read_attitude,
    read_orientation,
    select_valid_rows,
)
from .px4_ekf2 import configured_step_s
from .px4_fixes import read_unlogged_fixes, reconstruct_fixes
from .px4_innovations import has_fused_aid
from .px4_topics import (
    FRAME_BY_FIELD_VALUE,
    FUSED_OBSERVATION_TRACK_NAME,
    GPS_POSITION_TOPIC,
    LOCAL_POSITION_LAYOUT,
    RECONSTRUCTED_TRACK_NAME,
    SOURCE_TRACK_NAMES,
    TOPIC_LAYOUTS,
    TRACK_SOURCES,
    find_track_layouts,
)
from .recording_table import MAX_VALID_UNIX_TIME_S, MIN_VALID_UNIX_TIME_S
from .ulog_topics import MAX_PUBLICATION_LAG_S, Topics

MIN_TRACK_SAMPLES = 3
EARTH_RADIUS_M = 6_371_000.0  # PX4's CONSTANTS_RADIUS_OF_EARTH, src/lib/geo/geo.h
FIX_TYPE_3D = 3
NO_FIX_ACTION = "Give the antenna a free view of the sky and wait for a fix."
# Maximum delay (µs) from timestamp to publication, if the timestamp is the arrival time
MAX_ARRIVAL_TO_PUBLICATION_DELAY_US = 100
# A log has no measurement times if at least this fraction of the timestamps are arrival times
MIN_ARRIVAL_TIMESTAMP_FRACTION = 0.9
# Maximum time (s) between a height and the horizontal position with which it is combined: an error
# of 2.5 cm at 0.5 m/s
MAX_TIME_FROM_POSITION_TO_HEIGHT_S = 0.05
# At a lower rate (Hz), the logger dropped GNSS fixes; receivers send 5 to 20 Hz
MAX_DOWNSAMPLED_HZ = 4.0
POSITION_STATUS_COLUMNS = ["reset_counter", "quality", "age_s"]
# Duration (µs) of possible time units
MICROSECONDS_BY_UNIT = {
    "microseconds": 1.0,
    "milliseconds": 1e3,
    "seconds": 1e6,
    "nanoseconds": 1e-3,
}
# Maximum relative difference between the rates of a clock and the boot clock
MAX_CLOCK_RATE_ERROR_FRACTION = 0.05
AUTOPILOT_CLOCK_TEXT = "autopilot boot clock (PX4 converted the sender's timestamps)"
# Latitude and longitude (degrees), optionally altitude (m)
GeodeticPosition = tuple[float, ...]
# Position tracks, best first, and missing position sources
TracksAndMissingSources = tuple[tuple[PositionTrack, ...], tuple[Unavailable, ...]]


def read_positions(topics: Topics, ekf2: Ekf2 | Unavailable) -> TracksAndMissingSources:
    """Read the positions of all sources in a log, best source first, and the missing sources."""
    fusion_flags = ekf2.fusion_flags if isinstance(ekf2, Ekf2) else ekf2
    # If EKF2 fused the yaw of the source, the source is odometry
    is_odometry = isinstance(fusion_flags, pd.DataFrame) and bool((fusion_flags["yaw"] > 0).any())
    return separate_unavailable_tracks(
        [
            *(_read_logged_track(topics, name) for name in SOURCE_TRACK_NAMES),
            _read_fused_observation(topics, is_odometry),
            _reconstruct_track(topics, ekf2, is_odometry),
            _read_gnss_track(topics, ekf2),
        ]
    )


def separate_unavailable_tracks(
    tracks: list[PositionTrack | Unavailable],
) -> TracksAndMissingSources:
    """Separate available positions, best source first, from missing position sources."""
    available_tracks = sorted(
        (track for track in tracks if isinstance(track, PositionTrack)),
        key=lambda track: track.origin.find_preference_rank(),
    )
    missing_tracks = (track for track in tracks if isinstance(track, Unavailable))
    return tuple(available_tracks), tuple(missing_tracks)


def unavailable_source(name: str, reason: str = "", remedy: str = "") -> Unavailable:
    """Describe a missing position source. The default reason: its topic is not logged."""
    return Unavailable(
        f"position source {name}",
        reason or f"{name} is not logged",
        remedy or TRACK_SOURCES[name].remedy,
        name,
    )


def make_track(
    name: str,
    samples: pd.DataFrame,
    origin: SourceOrigin,
    *,
    needed_columns: list[str] = Columns.POSITION,
    remedy: str = "",
    is_odometry: bool = False,
    **track_fields: Any,
) -> PositionTrack | Unavailable:
    """Make a position track from valid samples, or return the reason if they are too few.

    Parameters
    ----------
    samples : DataFrame
        Positions (m) and variances (m²). A variance of 0 means "not sent" (``EKF2.cpp``).
    origin : SourceOrigin
        Origin of the positions. The kind "uwb" means that the kind is inferred from the samples.
    needed_columns : list of str
        Columns that must be finite: north and east, with or without down.
    is_odometry : bool
        True if the source also measures its orientation: it is then visual odometry, not UWB.
    track_fields
        Other fields of :class:`~px4fuse.flight.model.PositionTrack`.
    """
    status_samples = samples.filter(POSITION_STATUS_COLUMNS)
    samples = samples.reindex(columns=Columns.POSITION + Columns.POSITION_VARIANCE)
    quantisation_step_m = max(
        estimate_quantisation_step(samples[name].to_numpy()) for name in Columns.POSITION[:2]
    )
    # True for each axis that the source measures
    is_measured = samples[Columns.POSITION].notna().any()
    # Select the valid samples
    if origin.is_gnss:  # a receiver at rest may repeat its position
        samples = select_valid_rows(samples, needed_columns)
    else:
        invalid_reasons = classify_invalid_positions(samples, needed_columns)
        samples = samples[invalid_reasons == ""]
        track_fields["invalid_reasons"] = invalid_reasons[invalid_reasons != ""]
    if len(samples) < MIN_TRACK_SAMPLES:
        fault = f"the track has only {len(samples)} finite samples, fewer than {MIN_TRACK_SAMPLES}"
        if is_measured["down_m"] and not is_measured[["north_m", "east_m"]].any():
            fault = HEIGHT_ONLY_REASON
        return unavailable_source(name, fault, remedy)
    if origin.kind == "uwb":
        kind = "vio" if is_odometry else infer_position_kind(samples)
        origin = structs.replace(origin, kind=kind)
    variance = samples[Columns.POSITION_VARIANCE]
    return PositionTrack(
        name=name,
        samples=samples.assign(**variance.where(variance > 0)),
        origin=origin,
        status=status_samples,
        quantisation_step_m=quantisation_step_m,
        **track_fields,
    )


def _make_ulog_track(
    topics: Topics,
    name: str,
    samples: pd.DataFrame,
    topic_names: tuple[str, ...],
    *,
    is_selectable_by_default: bool = True,
    **track_fields: Any,
) -> PositionTrack | Unavailable:
    """Make a position track of a source that is defined in ``px4_topics.toml``."""
    source = TRACK_SOURCES[name]
    origin = structs.replace(source.origin, is_selectable_by_default=is_selectable_by_default)
    default_fields: dict[str, Any] = {"frame": "NED", "clock": AUTOPILOT_CLOCK_TEXT}
    if origin.aid is not None:
        default_fields["lever_arm_m"] = tuple(
            topics.ekf2_parameters.get(parameter, 0.0) for parameter in origin.aid.lever_arm
        )
    return make_track(
        name,
        samples,
        origin,
        description=source.description,
        topics=topic_names,
        log=topics.log.name,
        **default_fields | track_fields,
    )


def _describe_unusual_clock(topics: Topics, topic: str) -> ClockConversion | None:
    """Describe the timestamps of a topic if they are not measurement times, or often repeated.

    PX4 logs arrival times until it has received 500 TIMESYNC replies (``Timesync.cpp``).
    """
    table = topics.first_table(topic)
    if "timestamp_sample" not in table or len(table["timestamp"]) < MIN_TRACK_SAMPLES:
        return None
    published_us = table["timestamp"].astype(np.int64)
    sample_timestamps_us = table["timestamp_sample"].astype(np.int64)
    age_us = published_us - sample_timestamps_us
    if (
        np.mean(np.abs(age_us) <= MAX_ARRIVAL_TO_PUBLICATION_DELAY_US)
        >= MIN_ARRIVAL_TIMESTAMP_FRACTION
    ):
        clock_name = SENDER_CLOCK
        note = "PX4 replaced timestamps by arrival times, because the clocks were not synchronised"
    elif abs(np.median(age_us)) > MAX_PUBLICATION_LAG_S * 1e6:
        clock_name = _describe_timestamp_clock(published_us, sample_timestamps_us)
        note = "timestamp_sample is not boot time in µs, so px4fuse uses arrival times"
    else:  # measurement times
        return describe_repeated_timestamps(
            SENDER_CLOCK, len(sample_timestamps_us), len(np.unique(sample_timestamps_us))
        )
    # Offset, drift and jitter are zero, because no clock is converted
    return ClockConversion(clock_name, "arrival time", len(age_us), 0.0, 0.0, 0.0, note)


def _read_logged_track(topics: Topics, name: str) -> PositionTrack | Unavailable:
    """Read the track of a position source that has its own topic."""
    layout = topics.find_layout(*find_track_layouts(name))
    if layout is None:
        return unavailable_source(name)
    # EKF2's topics have one instance for each EKF2 instance
    is_ekf2_topic = layout.topic.startswith("estimator_")
    samples = topics.primary_samples(layout) if is_ekf2_topic else topics.read_instance(layout)
    frame = TRACK_SOURCES[name].frame
    for frame_field, frame_names in FRAME_BY_FIELD_VALUE.items():
        if frame == "unknown" and frame_field in samples and len(samples):
            frame = frame_names.get(int(samples[frame_field].iloc[-1]), "unknown")
    if "published_us" in samples:
        samples["age_s"] = 1e-6 * (samples["published_us"] - topics.time_origin_us) - samples.index
    orientation = read_orientation(samples)
    instance_count = len(topics.instances(layout.topic))
    note = (
        f"{instance_count} programs publish {layout.topic}. px4fuse and EKF2 use only instance 0."
    )
    return _make_ulog_track(
        topics,
        name,
        samples,
        (layout.topic,),
        notes=(note,) if instance_count > 1 and not is_ekf2_topic else (),
        is_odometry=orientation is not None,
        frame=frame,
        clock_map=_describe_unusual_clock(topics, layout.topic),
        orientation=orientation,
    )


def _describe_timestamp_clock(published_us: IntArray, sample_timestamps_us: IntArray) -> str:
    """Return the clock or the unit of timestamps that are not boot times in µs.

    The unit follows from the rate of the timestamps relative to the publication times.
    """
    if not sample_timestamps_us.any():
        return "0"  # all timestamps are 0
    # Duration (µs) of one unit of the timestamps
    measured_unit_us = np.ptp(published_us) / np.maximum(np.ptp(sample_timestamps_us), 1)
    for unit, unit_us in MICROSECONDS_BY_UNIT.items():
        if abs(measured_unit_us / unit_us - 1.0) >= MAX_CLOCK_RATE_ERROR_FRACTION:
            continue
        median_s = np.median(sample_timestamps_us) * unit_us * 1e-6
        if MIN_VALID_UNIX_TIME_S <= median_s < MAX_VALID_UNIX_TIME_S:
            return f"UNIX time in {unit}"
        # The unit of boot times is µs. Other timestamps in µs are from another clock
        return "another clock" if unit == "microseconds" else unit
    return "an unknown clock"


def _read_fused_observation(topics: Topics, is_odometry: bool) -> PositionTrack | Unavailable:
    """Read the positions of external vision as EKF2 used them, from estimator_aid_src_ev_pos."""
    horizontal = TOPIC_LAYOUTS["estimator_aid_src_ev_pos"]
    vertical = TOPIC_LAYOUTS["estimator_aid_src_ev_hgt"]
    topic_names = tuple(
        layout.topic for layout in (horizontal, vertical) if topics.find_layout(layout)
    )
    if horizontal.topic not in topic_names:
        return unavailable_source(FUSED_OBSERVATION_TRACK_NAME)
    return _make_track_from_ekf2_topics(
        topics,
        FUSED_OBSERVATION_TRACK_NAME,
        topics.primary_samples(horizontal),
        topics.primary_samples(vertical),
        topic_names,
        # EKF2 subtracts half a prediction interval from times (estimator_interface.cpp)
        shift_s=0.5 * configured_step_s(topics),
        is_odometry=is_odometry,
    )


def _make_track_from_ekf2_topics(
    topics: Topics,
    name: str,
    samples: pd.DataFrame,
    height_samples: pd.DataFrame,
    topic_names: tuple[str, ...],
    *,
    shift_s: float = 0.0,
    **track_fields: Any,
) -> PositionTrack | Unavailable:
    """Make a position track from horizontal positions and heights in EKF2's topics.

    EKF2 subtracted EKF2_EV_DELAY from the timestamps. The delay is added again, and ``shift_s``.
    """
    notes: tuple[str, ...] = ()
    if len(height_samples):
        # The column _found marks positions with a height within the tolerance. Heights before the
        # first EKF2 state are NaN, but count as found
        samples = join_nearest_samples(
            samples, height_samples.assign(_found=True), MAX_TIME_FROM_POSITION_TO_HEIGHT_S
        )
        if missing_count := samples.pop("_found").isna().sum():
            notes = (
                f"{missing_count} of {len(samples)} external vision positions have no height "
                f"within {1e3 * MAX_TIME_FROM_POSITION_TO_HEIGHT_S:.0f} ms and are used without "
                "height",
            )
    delay_s = topics.log.parameters.get(EV_POS.delay, 0.0) * 1e-3
    return _make_ulog_track(
        topics,
        name,
        _shift_times(samples, shift_s + delay_s),
        topic_names,
        needed_columns=Columns.POSITION[:2],
        notes=notes,
        **track_fields,
    )


def _shift_times(samples: pd.DataFrame, shift_s: float) -> pd.DataFrame:
    return samples.set_axis(time_index(samples.index.to_numpy() + shift_s))


def _reconstruct_track(
    topics: Topics, ekf2: Ekf2 | Unavailable, is_odometry: bool
) -> PositionTrack | Unavailable:
    """Reconstruct external vision positions that are not logged: EKF2 position plus innovation.

    The times may be late by up to one interval of the position source.
    """
    if isinstance(ekf2, Unavailable):
        return unavailable_source(RECONSTRUCTED_TRACK_NAME, "the log contains no EKF2 state")
    positions = {
        column: innovations["innovation_m"]
        + interpolate_inside_time_span(innovations.index, ekf2.state[column])
        for column, innovations in zip(Columns.POSITION, ekf2.innovations.values(), strict=True)
        if isinstance(innovations, pd.DataFrame)
    }
    if not {"north_m", "east_m"} <= positions.keys():
        return unavailable_source(
            RECONSTRUCTED_TRACK_NAME, "EKF2 fused no horizontal external vision position"
        )
    heights = positions.pop("down_m", pd.Series(dtype=np.float64)).to_frame("down_m")
    return _make_track_from_ekf2_topics(
        topics,
        RECONSTRUCTED_TRACK_NAME,
        pd.DataFrame(positions),
        heights,
        ("vehicle_local_position", *ekf2.innovation_topics),
        is_odometry=is_odometry,
        clock=(
            f"autopilot boot clock: timestamps are fusion times plus {EV_POS.delay}; the "
            "timestamps may be late by up to one sample interval"
        ),
    )


def project(latitude_deg: Array, longitude_deg: Array, origin: GeodeticPosition) -> ArrayPair:
    """Convert latitude and longitude (degrees) to north and east (m) from the origin.

    Source: PX4 ``MapProjection::project``, src/lib/geo/geo.cpp (Snyder 1987, equation 25-2).
    """
    origin_latitude_rad, origin_longitude_rad = np.radians(origin[:2])
    latitude_rad = np.radians(latitude_deg)
    longitude_difference_rad = np.radians(longitude_deg) - origin_longitude_rad
    sin_latitude, cos_latitude = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_origin, cos_origin = np.sin(origin_latitude_rad), np.cos(origin_latitude_rad)
    cos_longitude_difference = np.cos(longitude_difference_rad)
    arc_rad = np.arccos(
        np.clip(
            sin_origin * sin_latitude + cos_origin * cos_latitude * cos_longitude_difference,
            -1.0,
            1.0,
        )
    )
    # arc/sin(arc) · radius, equal to the radius at the origin
    scale_m = EARTH_RADIUS_M / np.sinc(arc_rad / np.pi)
    north_m = scale_m * (
        cos_origin * sin_latitude - sin_origin * cos_latitude * cos_longitude_difference
    )
    return north_m, scale_m * cos_latitude * np.sin(longitude_difference_rad)


def unproject(north_m: Array, east_m: Array, origin: GeodeticPosition | ArrayPair) -> ArrayPair:
    """Convert north and east (m) from the origin to latitude and longitude (degrees).

    Source: PX4 ``MapProjection::reproject``, src/lib/geo/geo.cpp (Snyder 1987, equation 20-14).
    """
    north_arc_rad, east_arc_rad = north_m / EARTH_RADIUS_M, east_m / EARTH_RADIUS_M
    origin_latitude_rad, origin_longitude_rad = np.radians(origin[:2])
    sin_origin, cos_origin = np.sin(origin_latitude_rad), np.cos(origin_latitude_rad)
    arc_rad = np.hypot(north_arc_rad, east_arc_rad)
    # sin(arc)/arc, 1 at the origin
    sinc_arc = np.sinc(arc_rad / np.pi)
    latitude_rad = np.arcsin(np.cos(arc_rad) * sin_origin + north_arc_rad * sinc_arc * cos_origin)
    longitude_rad = origin_longitude_rad + np.arctan2(
        east_arc_rad * sinc_arc,
        cos_origin * np.cos(arc_rad) - north_arc_rad * sin_origin * sinc_arc,
    )
    return np.degrees(latitude_rad), np.degrees(longitude_rad)


def _find_local_origin(topics: Topics) -> GeodeticPosition | None:
    """Return latitude, longitude (degrees) and altitude (m) of EKF2's origin, if logged."""
    columns = ["ref_lat", "ref_lon", "ref_alt"]
    origin = select_valid_rows(topics.read(LOCAL_POSITION_LAYOUT).reindex(columns=columns), columns)
    origin = origin[origin["ref_lat"] != 0]
    return tuple(origin.iloc[-1].tolist()) if len(origin) else None


def project_to_ned(global_positions: pd.DataFrame, origin: GeodeticPosition | None) -> pd.DataFrame:
    """Convert latitude, longitude and altitude to north, east and down (m) from the origin.

    The default origin is the first sample. Latitude and longitude 0 mean "no fix" and become NaN.
    """
    global_positions = global_positions[Columns.GEODETIC]
    is_missing = (global_positions.iloc[:, :2] == 0.0).all(axis=1)
    global_positions = global_positions.mask(is_missing)
    latitude_deg, longitude_deg, altitude_m = global_positions.to_numpy().T
    origin = origin or (latitude_deg[0], longitude_deg[0], altitude_m[0])
    north_m, east_m = project(latitude_deg, longitude_deg, origin)
    position_m = np.column_stack([north_m, east_m, origin[2] - altitude_m])
    return pd.DataFrame(position_m, global_positions.index, Columns.POSITION)


def _read_gnss_track(topics: Topics, ekf2: Ekf2 | Unavailable) -> PositionTrack | Unavailable:
    """Read GNSS positions with the measurement times that EKF2 assumes.

    EKF2 subtracts EKF2_GPS_DELAY from the timestamps. Since 2026, it may use the measurement times
    of the GNSS driver instead (EKF2.cpp UpdateGpsSample, estimator_interface.cpp).
    """
    layout = topics.find_layout(*find_track_layouts(GPS_POSITION_TOPIC))
    if layout is None:
        return unavailable_source(GPS_POSITION_TOPIC)
    messages = topics.read_instance(layout)
    messages["published_s"] = (messages.pop("published_us") - topics.time_origin_us) * 1e-6
    has_fix = messages.get("fix_type", pd.Series(FIX_TYPE_3D, messages.index)) >= FIX_TYPE_3D
    fixes = messages[has_fix]
    if fixes.empty:
        return unavailable_source(
            GPS_POSITION_TOPIC,
            f"the log has {len(messages)} {GPS_POSITION_TOPIC}, none with a 3D fix",
            NO_FIX_ACTION,
        )
    # 1. Times of measurement
    parameters = topics.ekf2_parameters
    age_s = fixes["published_s"] - fixes.index
    has_logged_measurement_times = age_s.max() > MAX_ARRIVAL_TO_PUBLICATION_DELAY_US * 1e-6
    if GNSS_MODE_PARAMETER in parameters and has_logged_measurement_times:
        delay_s = 0.0
        clock = "autopilot boot clock: measurement times from the GNSS driver"
    else:
        delay_s = fill_parameters_with_defaults(parameters, GNSS_POS)[GNSS_POS.delay] * 1e-3
        fixes = fixes.set_axis(time_index(fixes["published_s"].to_numpy() - delay_s))
        clock = f"autopilot boot clock: timestamp minus {GNSS_POS.delay} ({1e3 * delay_s:g} ms)"
    # 2. Add the fixes that the GNSS topic lacks, from EKF2's topics
    unlogged_fixes = read_unlogged_fixes(topics, fixes, ekf2)
    if len(unlogged_fixes):
        fixes = pd.concat([fixes, unlogged_fixes]).sort_index()
        interpolated_altitude_count = fixes["altitude_m"].isna().sum()
        # EKF2's topics lack some fields of a fix: copy these fields from the previous fix
        fixes = fixes.assign(altitude_m=fixes["altitude_m"].interpolate("index")).ffill()
    samples = convert_gnss_fixes(fixes, _find_local_origin(topics))
    # If the logger dropped fixes that EKF2's topics do not contain, compute them from EKF2's
    # innovations
    rate_hz = compute_sample_rate_hz(samples)
    notes, is_downsampled = list[str](), rate_hz < MAX_DOWNSAMPLED_HZ
    if is_downsampled:
        notes.append(
            f"the logger dropped GNSS fixes (logged rate {rate_hz:.1f} Hz). Set SDLOG_PROFILE bit "
            "1 to log all fixes"
        )
    if len(unlogged_fixes):
        notes.append(
            f"{len(unlogged_fixes)} GNSS fixes missing in the GNSS topic are read from "
            f"estimator_aid_src_gnss_pos ({interpolated_altitude_count} with interpolated height)"
        )
    elif is_downsampled:
        reconstructed_fixes, note = reconstruct_fixes(samples, ekf2, delay_s)
        if note:
            samples = pd.concat([samples, reconstructed_fixes]).sort_index()
            notes.append(note)
    track_fields: dict[str, Any] = {}
    # The lever arm of the receiver is logged since v1.17
    if {*Columns.ANTENNA_POSITION} <= {*fixes}:
        track_fields["lever_arm_m"] = tuple(fixes[Columns.ANTENNA_POSITION].iloc[-1].tolist())
    times_without_fix_s = messages["published_s"].to_numpy()[~has_fix] - delay_s
    return _make_ulog_track(
        topics,
        GPS_POSITION_TOPIC,
        samples,
        (layout.topic,),
        clock=clock,
        notes=tuple(notes),
        velocity=samples[Columns.VELOCITY + Columns.VELOCITY_VARIANCE],
        assumed_delay_s=delay_s,
        is_selectable_by_default=has_fused_aid(ekf2),
        invalid_reasons=pd.Series("no fix", time_index(times_without_fix_s), dtype=object),
        **track_fields,
    )


def convert_gnss_fixes(fixes: pd.DataFrame, origin: GeodeticPosition | None) -> pd.DataFrame:
    """Convert GNSS fixes to positions and velocities in NED with their variances."""
    fixes = fixes.reindex(
        columns=[*Columns.GEODETIC, *Columns.VELOCITY, "eph_m", "epv_m", "speed_accuracy_m_s"]
    )
    samples = project_to_ned(fixes, origin)
    # EKF2 uses the horizontal accuracy as σ of each horizontal axis (gps_control.cpp)
    samples[Columns.POSITION_VARIANCE] = fixes[["eph_m", "eph_m", "epv_m"]].to_numpy() ** 2
    # Add the velocity here, so that it is dropped together with a damaged position
    samples[Columns.VELOCITY] = fixes[Columns.VELOCITY].to_numpy()
    samples[Columns.VELOCITY_VARIANCE] = fixes[["speed_accuracy_m_s"] * 3].to_numpy() ** 2
    return select_valid_rows(samples, Columns.POSITION)


def barometer(altitude_m: pd.Series[float], delay_s: float = 0.0) -> pd.DataFrame | None:
    """Convert barometer altitude (m) to ``down_m``, positive down, corrected for a delay (s).

    Return None with fewer than three samples.
    """
    finite_altitude_m = altitude_m[np.isfinite(altitude_m)]
    if len(finite_altitude_m) < MIN_TRACK_SAMPLES:
        return None
    return _shift_times(-finite_altitude_m.to_frame("down_m"), -delay_s)


def read_truth(
    topics: Topics, positions: tuple[PositionTrack, ...], ekf2: Ekf2 | Unavailable
) -> Truth | Unavailable:
    """Read ground truth from simulation (local, or else global position), or motion capture.

    If EKF2 fused GNSS, ground truth is shifted from the simulation's origin to EKF2's origin.
    """
    attitude = read_attitude(topics.read(TOPIC_LAYOUTS["vehicle_attitude_groundtruth"]))
    local_layout = TOPIC_LAYOUTS["vehicle_local_position_groundtruth"]
    global_layout = TOPIC_LAYOUTS["vehicle_global_position_groundtruth"]
    logged_local_samples = topics.read(local_layout)
    local_truth_samples = select_valid_rows(
        logged_local_samples, logged_local_samples.columns.tolist()
    )
    global_positions = select_valid_rows(topics.read(global_layout), Columns.GEODETIC[:2])
    if len(global_positions):
        projected_positions = project_to_ned(global_positions, _find_local_origin(topics))
        if local_truth_samples.empty:
            velocity = global_positions.reindex(columns=Columns.VELOCITY)
            return Truth(global_layout.topic, projected_positions.join(velocity), attitude)
        if has_fused_aid(ekf2):
            local_truth_samples = local_truth_samples.copy()
            # The frames differ by a constant on each axis; NaN if the topics have no common times
            for column in Columns.POSITION:
                shift_m = projected_positions[column] - interpolate_inside_time_span(
                    projected_positions.index, local_truth_samples[column]
                )
                local_truth_samples[column] += np.nan_to_num(shift_m.median())
    if len(local_truth_samples):
        return Truth(local_layout.topic, local_truth_samples, attitude)
    if mocap_truth := find_motion_capture_truth(positions):
        return mocap_truth
    reason = "the log has neither simulation ground truth nor motion capture"
    remedy = TRACK_SOURCES["vehicle_mocap_odometry"].remedy
    if len(logged_local_samples):
        reason = f"{local_layout.topic} has no finite sample"
        remedy = "Check the simulation that writes the ground truth."
    return Unavailable("ground truth", reason, remedy)


def find_motion_capture_truth(positions: tuple[PositionTrack, ...]) -> Truth | None:
    """Return motion capture as ground truth, unless it is the only position source for KF.

    Motion capture in FRD is not used, because its north direction is unknown.
    """
    if not any(track.origin.is_vision for track in positions):
        return None
    for track in positions:
        if track.origin.kind == "mocap" and track.frame != "FRD":
            samples = track.samples.reindex(columns=Columns.STATE)
            return Truth(track.name, samples, read_attitude(track.orientation))
    return None
