"""Reader of external positions, GNSS positions and ground truth in a MAVLink recording."""

from __future__ import annotations

import numpy as np
import pandas as pd
from msgspec import structs
from scipy import constants

from px4fuse.flight.model import (
    GNSS_ORIGIN,
    Columns,
    PositionTrack,
    Truth,
    Unavailable,
    find_source_origin,
)

from .common import (
    MessageLayout,
    join_nearest_samples,
    read_attitude,
    read_orientation,
)
from .mavlink_frames import MavlinkAddress
from .mavlink_messages import (
    CONVERSION_BY_MAV_FRAME,
    GNSS_LAYOUTS,
    LOCAL_POSITION_LAYOUT,
    MESSAGE_LAYOUTS,
    POSITION_MESSAGE_TYPES,
    TRUTH_LAYOUTS,
    FrameConversion,
    PositionMessageType,
)
from .mavlink_recording import BOOT_CLOCK_TEXT, RECEIPT_CLOCK_TEXT, Recording
from .mavlink_senders import SenderClockConversion, find_senders
from .px4_positions import (
    FIX_TYPE_3D,
    MIN_TRACK_SAMPLES,
    NO_FIX_ACTION,
    GeodeticPosition,
    TracksAndMissingSources,
    convert_gnss_fixes,
    find_motion_capture_truth,
    make_track,
    project_to_ned,
    separate_unavailable_tracks,
    unavailable_source,
    unproject,
)

# GNSS timestamps count as times since boot if their median difference (s) from the receive times is
# at most this value
MAX_BOOT_TIME_DIFFERENCE_S = 5.0
# Computation of the local NED origin from global and local position: maximum time (s) between both
# messages; it causes an error of 5 cm at 1 m/s
MAX_ORIGIN_TIME_DIFFERENCE_S = 0.05


def read_positions(
    recording: Recording, clocks: dict[MavlinkAddress, SenderClockConversion], delay_s: float
) -> TracksAndMissingSources:
    """Read the external positions sent to the autopilot, and the GNSS positions.

    Parameters
    ----------
    clocks : mapping from address to SenderClockConversion
        Conversion of each sender's clock to the autopilot's boot clock.
    delay_s : float
        Delay (s) from GNSS measurement to timestamp that the autopilot assumes.
    """
    tracks_or_unavailable: list[PositionTrack | Unavailable] = []
    for message in dict.fromkeys(source.message for source in POSITION_MESSAGE_TYPES):
        senders = find_senders(recording, message)
        tracks = [
            track
            for sender in senders
            for source in POSITION_MESSAGE_TYPES
            if source.message == message
            if (track := _read_track(recording, source, sender, clocks[sender], senders))
        ]
        tracks_or_unavailable += tracks or [
            unavailable_source(
                message,
                f"the recording contains no {message} sent to the autopilot",
                recording.remedies["position"],
            )
        ]
    gnss_tracks = (_read_gnss(recording, layout, delay_s) for layout in GNSS_LAYOUTS)
    tracks_or_unavailable += [track for track in gnss_tracks if track]
    return separate_unavailable_tracks(tracks_or_unavailable)


def _read_track(
    recording: Recording,
    source: PositionMessageType,
    sender: MavlinkAddress,
    clock: SenderClockConversion,
    senders: list[MavlinkAddress],
) -> PositionTrack | Unavailable | None:
    """Read the positions from one sender and message type; None without messages."""
    rows = recording.rows(source.message, sender)
    table = recording.frames.table(source.message, rows)
    # ODOMETRY may be from several estimators: each of them is one track
    if source.estimator_type is not None:
        has_estimator_type = table["estimator_type"] == source.estimator_type
        rows, table = rows[has_estimator_type], table[has_estimator_type]
    if not len(rows):
        return None
    track_name = source.track_name
    if len(senders) > 1:
        track_name += f"_{sender[0]}_{sender[1]}"
    # Use the receive times if the sender's clock is unknown
    boot_times_s = recording.compute_receipt_boot_times_s(rows)
    if clock.sender_to_boot_fit is not None:
        timestamps_s = table[source.timestamp_field] * 1e-6
        boot_times_s = np.where(
            timestamps_s > 0.0, clock.sender_to_boot_fit.at(timestamps_s), np.nan
        )
    samples = recording.read(source.layout, rows, boot_times_s, track_name)
    frame = source.frame
    if "frame_id" in samples and len(samples):
        # The coordinate frame of the last sample applies to all samples, as in PX4
        frame_number = int(samples["frame_id"].iloc[-1])
        frame = CONVERSION_BY_MAV_FRAME.get(frame_number, FrameConversion("unknown")).name
    if source.drops_covariance:
        samples[Columns.POSITION_VARIANCE + Columns.ROTATION_VARIANCE] = np.nan
    orientation = read_orientation(samples)
    # Describe the clock for the report
    clock_map = clock.description
    clock_text = clock_map.clock
    if clock_map.method != "boot clock":
        clock_text = f"autopilot boot clock, converted from {clock_text} by {clock_map.method}"
    return make_track(
        track_name,
        samples,
        find_source_origin(source.kind, "as received"),
        remedy=recording.remedies["position"],
        is_odometry=orientation is not None,
        description=source.description,
        frame=frame,
        clock=clock_text,
        topics=(source.message,),
        log=recording.frames.name,
        clock_map=clock_map,
        orientation=orientation,
    )


def _read_gnss(
    recording: Recording, layout: MessageLayout, delay_s: float
) -> PositionTrack | Unavailable | None:
    """Read GNSS fixes as NED positions relative to the local origin; None without messages.

    Repeated fixes are dropped.
    """
    rows = recording.rows(layout.topic)
    if not len(rows):
        return None
    message_count = len(rows)
    time_us = recording.frames.table(layout.topic, rows)["time_usec"]
    is_new = np.diff(time_us, prepend=0) > 0
    rows, gnss_boot_clock_s = rows[is_new], time_us[is_new] * 1e-6
    receipt_boot_times_s = recording.compute_receipt_boot_times_s(rows)
    if (
        len(rows)
        and np.median(np.abs(receipt_boot_times_s - gnss_boot_clock_s)) > MAX_BOOT_TIME_DIFFERENCE_S
    ):
        # Use the receive times, because the timestamps are not boot times
        gnss_boot_clock_s = receipt_boot_times_s
    fixes = recording.read(layout, rows, gnss_boot_clock_s - delay_s)
    fixes = fixes[fixes["fix_type"] >= FIX_TYPE_3D]
    if len(fixes) < MIN_TRACK_SAMPLES:
        return unavailable_source(
            layout.topic,
            f"the recording has {message_count} {layout.topic}, {len(fixes)} with a 3D fix",
            NO_FIX_ACTION,
        )
    is_selectable_by_default = bool(
        recording.read(MESSAGE_LAYOUTS["GLOBAL_POSITION_INT"])["latitude_deg"].any()
    )
    return make_track(
        layout.topic,
        convert_gnss_fixes(fixes, find_local_origin(recording)),
        structs.replace(GNSS_ORIGIN, is_selectable_by_default=is_selectable_by_default),
        description="GNSS position",
        frame="NED",
        clock=f"{BOOT_CLOCK_TEXT}: timestamp minus {1e3 * delay_s:g} ms",
        topics=(layout.topic,),
        log=recording.frames.name,
        assumed_delay_s=delay_s,
    )


def compute_pressure_altitude_m(pressure_hpa: pd.Series[float]) -> pd.Series[float]:
    """Convert pressure (hPa) to altitude (m) in the standard troposphere (ISO 2533:1975)."""
    exponent = constants.R * 0.0065 / (constants.g * 0.0289644)
    return 288.15 / 0.0065 * (1.0 - (pressure_hpa / 1013.25) ** exponent)


def find_local_origin(recording: Recording) -> GeodeticPosition | None:
    """Return latitude, longitude (degrees) and altitude (m) of the local NED origin.

    It is read from GPS_GLOBAL_ORIGIN, or computed from global and local positions.
    """
    sent_origins = recording.read(MESSAGE_LAYOUTS["GPS_GLOBAL_ORIGIN"]).dropna()
    if len(sent_origins):
        return tuple(sent_origins.iloc[-1].tolist())
    joined_positions = join_nearest_samples(
        recording.read(MESSAGE_LAYOUTS["GLOBAL_POSITION_INT"]),
        recording.read(LOCAL_POSITION_LAYOUT)[Columns.POSITION],
        MAX_ORIGIN_TIME_DIFFERENCE_S,
    ).dropna()
    joined_positions = joined_positions[joined_positions["latitude_deg"] != 0.0]
    if joined_positions.empty:
        return None
    latitude_deg, longitude_deg, altitude_m = joined_positions[Columns.GEODETIC].to_numpy().T
    north_m, east_m, down_m = joined_positions[Columns.POSITION].to_numpy().T
    origin_latitude_deg, origin_longitude_deg = unproject(
        -north_m, -east_m, (latitude_deg, longitude_deg)
    )
    origins = origin_latitude_deg, origin_longitude_deg, altitude_m + down_m
    return tuple(np.median(origins, axis=1).tolist())


def read_truth(recording: Recording, positions: tuple[PositionTrack, ...]) -> Truth | Unavailable:
    """Read ground truth from simulation or motion capture.

    Simulation ground truth has receive times, because PX4 sends no timestamp in
    ``HIL_STATE_QUATERNION``.
    """
    for layout in TRUTH_LAYOUTS:
        rows = recording.rows(layout.topic)
        if len(rows) < MIN_TRACK_SAMPLES:
            continue
        samples = recording.read(layout, rows, recording.compute_receipt_boot_times_s(rows))
        samples = samples.dropna(subset=Columns.GEODETIC[:2])
        if not samples["latitude_deg"].any():
            continue
        samples = samples.reindex(columns=Columns.GEODETIC + Columns.VELOCITY + Columns.QUATERNION)
        if not samples[Columns.VELOCITY].to_numpy().any():
            # If all velocities are zero, they were not sent
            samples[Columns.VELOCITY] = np.nan
        recording.record_data_source("truth", layout.topic, clock=RECEIPT_CLOCK_TEXT)
        origin = find_local_origin(recording) if positions and positions[0].origin.is_gnss else None
        state = project_to_ned(samples, origin).join(samples[Columns.VELOCITY])
        return Truth(layout.topic, state[Columns.STATE], read_attitude(samples))
    mocap_truth = find_motion_capture_truth(positions)
    # List the messages of this track as the source of ground truth, for px4fuse info
    for track in positions:
        if mocap_truth and track.name == mocap_truth.name:
            recording.record_data_source("truth", *track.topics, clock=track.clock)
    return mocap_truth or Unavailable(
        "ground truth",
        "the recording has neither simulation ground truth nor motion capture",
        recording.remedies["truth"],
    )
