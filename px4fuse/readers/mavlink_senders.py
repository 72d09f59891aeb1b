"""Autopilot and position senders in a MAVLink recording, and their clocks.

Source for TIMESYNC messages: MAVLink "Time Synchronization Protocol v2".
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.errors import SettingsError
from px4fuse.flight.model import ClockConversion, Sender

from .mavlink_frames import VEHICLE_TYPES, MavlinkAddress, MavlinkFrames
from .mavlink_messages import (
    AUTOPILOT_COMPONENT_ID,
    AUTOPILOT_MESSAGES,
    AUTOPILOT_NAME_BY_ID,
    GROUND_STATION_TYPE,
    NO_AUTOPILOT,
    POSITION_MESSAGE_TYPES,
)
from .mavlink_recording import (
    MAX_RELATIVE_CLOCK_RATE_DIFFERENCE,
    MIN_BACKWARD_STEP_AT_RESTART_S,
    MIN_UNIX_TIME_S,
    ClockLine,
    Recording,
    fit_clock_line,
    is_running_clock,
    map_boot_to_unix,
)

# Maximum number of senders that are read
MAX_SENDERS = 32
# Maximum fraction of lost messages; with more, the sequence numbers are not usable
MAX_LOST_MESSAGE_FRACTION = 0.9
# A message is late, not lost, if at most this number of later messages arrives first
MAX_LATE_MESSAGES = 16
# Maximum difference (s) between TIMESYNC and position timestamps of the same clock
MAX_TIMESYNC_TO_POSITION_TIME_DIFFERENCE_S = 1e5
# Timestamps are boot times of the autopilot if their median difference (s) from the receive times
# (boot clock) is at most this limit
MAX_BOOT_TIME_DIFFERENCE_S = 10.0
# Timestamps are not boot times if a conversion by TIMESYNC reduces their median difference from the
# receive times by at least this value (s)
MIN_CLOCK_DIFFERENCE_REDUCTION_BY_TIMESYNC_S = 0.1
MIN_TIMESYNC_REPLIES = 3
# Maximum interval (s) between positions; a longer interval is a gap
MIN_SAMPLE_GAP_S = 1.0


@dataclass(frozen=True)
class SenderClockConversion:
    """Conversion of a sender's timestamps to the autopilot's boot clock, with a description.

    ``sender_to_boot_fit`` is None if receive times replace the timestamps.
    """

    sender_to_boot_fit: ClockLine | None
    description: ClockConversion


def _read_vehicle_types(frames: MavlinkFrames) -> dict[MavlinkAddress, tuple[int, int]]:
    """Return MAV_TYPE and MAV_AUTOPILOT in the first HEARTBEAT of each sender."""
    # In reverse order, so that the first message of a sender overwrites its later messages
    rows = frames.rows("HEARTBEAT")[::-1]
    types = frames.table("HEARTBEAT", rows)[["type", "autopilot"]].tolist()
    return dict(zip(_read_addresses(frames, rows), types, strict=True))


def _read_addresses(frames: MavlinkFrames, rows: IntArray | slice) -> Iterator[MavlinkAddress]:
    return zip(frames.system_ids[rows].tolist(), frames.component_ids[rows].tolist(), strict=True)


def _count_frames(
    frames: MavlinkFrames, rows: IntArray | slice = slice(None)
) -> dict[MavlinkAddress, int]:
    """Count the frames of each sender, most frames first."""
    counts = Counter(_read_addresses(frames, rows))
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _is_vehicle(vehicle_type: int, autopilot: int) -> bool:
    return autopilot != NO_AUTOPILOT and vehicle_type != GROUND_STATION_TYPE


def choose_autopilot(frames: MavlinkFrames, system_id: int | None) -> tuple[MavlinkAddress, str]:
    """Return the address of the autopilot, and its type, such as "PX4".

    ``system_id`` None selects the autopilot with the most messages.

    Raises
    ------
    SettingsError
        No autopilot has the given system id.
    """
    frame_counts = _count_frames(frames)
    vehicle_types = _read_vehicle_types(frames)
    vehicle_addresses = [
        address
        for address in frame_counts
        if address in vehicle_types and _is_vehicle(*vehicle_types[address])
    ]
    rows = np.concatenate([frames.rows(message) for message in AUTOPILOT_MESSAGES])
    addresses_with_autopilot_message = _count_frames(frames, rows)
    candidates = (
        # Vehicles that also sent another autopilot message: a heartbeat alone does not identify an
        # autopilot, because companion computers may send heartbeats of an autopilot
        [address for address in vehicle_addresses if address in addresses_with_autopilot_message]
        # Autopilots whose heartbeats are not in the recording
        or [address for address in addresses_with_autopilot_message if address not in vehicle_types]
        # Autopilots of which the recording contains only heartbeats
        or vehicle_addresses
        # If no message is from an autopilot, assume one in each system
        or [(system, AUTOPILOT_COMPONENT_ID) for system, _ in frame_counts]
    )
    if system_id is not None:
        # A system id from the user also selects a vehicle that sends only heartbeats
        candidates = [
            address for address in (*vehicle_addresses, *candidates) if address[0] == system_id
        ]
        if not candidates:
            system_ids = sorted({address[0] for address in vehicle_addresses})
            raise SettingsError(
                f"{frames.name}: no autopilot has MAVLink system id {system_id}. System ids of "
                f"autopilots in this file: {', '.join(map(str, system_ids)) or 'none'}."
            )
    best_address = max(candidates, key=lambda address: frame_counts.get(address, 0))
    _, autopilot_type = vehicle_types.get(best_address, (-1, -1))
    return best_address, AUTOPILOT_NAME_BY_ID.get(autopilot_type, "unknown autopilot")


def find_senders(recording: Recording, message: str) -> list[MavlinkAddress]:
    """Return the senders of a message, such as companion computers, without autopilots."""
    frames = recording.frames
    autopilot_address = recording.address
    other_vehicle_ids = {
        address[0]
        for address, vehicle_type in _read_vehicle_types(frames).items()
        if _is_vehicle(*vehicle_type)
    } - {autopilot_address[0]}
    return [
        address
        for address in _count_frames(frames, recording.rows_of_all_senders(message))
        if address != autopilot_address and address[0] not in other_vehicle_ids
    ][:MAX_SENDERS]


def map_sender_clocks(recording: Recording) -> dict[MavlinkAddress, SenderClockConversion]:
    """Return the conversion of each position sender's clock to the autopilot's boot clock."""
    message_names = {source.message for source in POSITION_MESSAGE_TYPES}
    senders = {address for message in message_names for address in find_senders(recording, message)}
    boot_to_unix_fit = map_boot_to_unix(recording)
    return {
        sender: _map_sender_clock(recording, sender, boot_to_unix_fit) for sender in sorted(senders)
    }


def _map_sender_clock(
    recording: Recording, sender: MavlinkAddress, boot_to_unix_fit: ClockLine | None
) -> SenderClockConversion:
    """Find the conversion of a sender's clock from its positions and TIMESYNC messages.

    In TIMESYNC, ts1 is the time of the request (clock of the requester). tc1 is the time of the
    reply (clock of the replier), and 0 in requests.
    """
    frames = recording.frames
    # Frames from which the clock is estimated, and their timestamps
    rows, timestamps_s = [], []
    for source in POSITION_MESSAGE_TYPES:
        source_rows = recording.rows(source.message, sender)
        rows.append(source_rows)
        messages = frames.table(source.message, source_rows)
        timestamps_s.append(messages[source.timestamp_field] * 1e-6)
    position_times_s = np.concatenate(timestamps_s)
    median_time_s = np.median(position_times_s)

    def is_sender_time(time_s: Array) -> BoolArray:
        """Return True for times in the clock of the position timestamps."""
        return np.abs(time_s - median_time_s) < MAX_TIMESYNC_TO_POSITION_TIME_DIFFERENCE_S

    # TIMESYNC messages of the sender: its requests, and its replies to the autopilot
    timesync_rows = recording.rows("TIMESYNC", sender)
    timesync = frames.table("TIMESYNC", timesync_rows)
    request_times_s, reply_times_s = timesync["ts1"] * 1e-9, timesync["tc1"] * 1e-9
    # In replies to the autopilot, the time of the request is near the boot time of the reply
    is_reply = (timesync["tc1"] != 0) & (
        np.abs(request_times_s - recording.compute_receipt_boot_times_s(timesync_rows))
        <= MIN_BACKWARD_STEP_AT_RESTART_S
    )
    if is_running_clock(position_times_s):
        # The clock fit also uses TIMESYNC requests of the sender: their delay is small, because the
        # sender reads its clock just before sending
        is_request = (timesync["tc1"] == 0) & is_sender_time(request_times_s)
        rows.append(timesync_rows[is_request])
        timestamps_s.append(request_times_s[is_request])
    # Replies of the autopilot to this sender: no other sender sent the request to which they reply
    all_rows = frames.rows("TIMESYNC")
    other_timesync = frames.table("TIMESYNC", all_rows[~frames.is_sent_by(sender, all_rows)])
    other_requests = other_timesync["ts1"][other_timesync["tc1"] == 0]
    replies = recording.table("TIMESYNC")
    replies = replies[(replies["tc1"] != 0) & ~np.isin(replies["ts1"], other_requests)]
    replies = replies[is_sender_time(replies["ts1"] * 1e-9)]
    return map_clock_to_boot(
        f"system {sender[0]}, component {sender[1]}",
        np.concatenate(timestamps_s),
        recording.receive_times_s[np.concatenate(rows)],
        recording.receive_to_boot_time_fit,
        (request_times_s[is_reply], reply_times_s[is_reply]),
        (replies["ts1"] * 1e-9, replies["tc1"] * 1e-9),
        boot_to_unix_fit,
        has_receive_times=frames.receive_times_us is not None,
    )


def map_clock_to_boot(
    name: str,
    timestamps_s: Array,
    receive_times_s: Array,
    receive_to_boot_time_fit: ClockLine,
    sender_timesync_replies: ArrayPair,
    autopilot_timesync_replies: ArrayPair,
    boot_to_unix_fit: ClockLine | None,
    *,
    has_receive_times: bool,
) -> SenderClockConversion:
    """Find the conversion of a sender's clock to the autopilot's boot clock.

    The first conversion that applies is used:

    1. None if too few timestamps are distinct: the receive times are the sample times.
    2. The timestamps are already boot times: they agree with the receive times, and TIMESYNC does
       not improve the agreement.
    3. TIMESYNC, then SYSTEM_TIME, if the converted timestamps agree with the receive times.
    4. Line through the timestamps and receive times.

    Parameters
    ----------
    name : str
        Name of the sender.
    timestamps_s, receive_times_s : ndarray, shape (n,)
        Timestamp (sender's clock) and receive time of each message.
    receive_to_boot_time_fit : ClockLine
        Conversion of receive times to the boot clock.
    sender_timesync_replies : tuple of ndarray
        TIMESYNC request times (s, boot clock) and reply times (s, sender's clock).
    autopilot_timesync_replies : tuple of ndarray
        TIMESYNC request times (s, sender's clock) and reply times (s, boot clock).
    boot_to_unix_fit : ClockLine or None
        Conversion of the boot clock to UNIX time.
    has_receive_times : bool
        True if the recording contains receive times.
    """
    time_source = "receive time" if has_receive_times else "message order"
    boot_time_at_receipt_s = receive_to_boot_time_fit.at(receive_times_s)
    if not is_running_clock(timestamps_s):
        return _describe_stopped_clock(name, time_source, timestamps_s, receive_times_s)

    def compute_difference_from_receipt_s(line: ClockLine) -> float:
        """Return |median difference| (s) of converted timestamps from the times of receipt."""
        return abs(float(np.median(boot_time_at_receipt_s - line.at(timestamps_s))))

    def agrees_with_receipt(line: ClockLine) -> bool:
        """Return True if the converted timestamps are near the times of receipt (boot clock)."""
        return compute_difference_from_receipt_s(line) <= MAX_BOOT_TIME_DIFFERENCE_S

    clock_kind = "UNIX time" if np.median(timestamps_s) > MIN_UNIX_TIME_S else "clock"
    clock_name = f"{clock_kind} of {name}"
    timesync_fit = _fit_timesync(sender_timesync_replies, autopilot_timesync_replies)
    identity = ClockLine(0.0, 0.0, 1.0, 0.0, len(timestamps_s))
    # A sender clock that started only seconds after the autopilot resembles the boot clock. If
    # TIMESYNC is available, it shows the difference
    is_boot_clock = timesync_fit is None or (
        compute_difference_from_receipt_s(identity)
        - compute_difference_from_receipt_s(timesync_fit)
        < MIN_CLOCK_DIFFERENCE_REDUCTION_BY_TIMESYNC_S
    )
    if is_boot_clock and agrees_with_receipt(identity):
        note = "the timestamps of the sender are times since the autopilot's boot"
        return _make_clock_mapping(name, "boot clock", identity, timestamps_s, note)
    if timesync_fit is not None and agrees_with_receipt(timesync_fit):
        return _make_clock_mapping(clock_name, "TIMESYNC", timesync_fit, timestamps_s, "")
    if clock_kind == "UNIX time" and boot_to_unix_fit is not None:
        unix_to_boot_fit = boot_to_unix_fit.inverse()
        if agrees_with_receipt(unix_to_boot_fit):
            note = "assumption: the UNIX clocks of sender and autopilot are synchronised"
            return _make_clock_mapping(
                clock_name, "SYSTEM_TIME", unix_to_boot_fit, timestamps_s, note
            )
    # Chain of two lines: sender's clock to receive time, and receive time to boot clock
    sender_to_receive_fit = fit_clock_line(timestamps_s, receive_times_s)
    sender_to_boot_fit = replace(
        sender_to_receive_fit,
        y0=float(receive_to_boot_time_fit.at(sender_to_receive_fit.y0)),
        slope=sender_to_receive_fit.slope * receive_to_boot_time_fit.slope,
    )
    note = (
        "the recording has no usable TIMESYNC or SYSTEM_TIME. All sample times are late by the "
        "minimum delay of the link, which is unknown"
    )
    return _make_clock_mapping(clock_name, time_source, sender_to_boot_fit, timestamps_s, note)


def _describe_stopped_clock(
    name: str, time_source: str, timestamps_s: Array, receive_times_s: Array
) -> SenderClockConversion:
    """Describe a clock with too few distinct timestamps, which the receive times replace."""
    distinct_count = len(np.unique(timestamps_s))
    note = (
        f"the {len(timestamps_s)} timestamps have only {distinct_count} distinct values, so "
        f"px4fuse uses the {time_source}"
    )
    # Jitter of the receive time, if the sender sends at regular intervals: an interval is the
    # difference of two receive times, so its standard deviation is √2 times the jitter
    intervals_s = np.diff(receive_times_s)
    intervals_s = intervals_s[intervals_s < MIN_SAMPLE_GAP_S]
    jitter_s = float(np.std(intervals_s) / np.sqrt(2.0)) if len(intervals_s) else 0.0
    return SenderClockConversion(
        None,
        ClockConversion(
            name, time_source, len(timestamps_s), 0.0, 0.0, jitter_s, note, distinct_count
        ),
    )


def _fit_timesync(
    sender_timesync_replies: ArrayPair, autopilot_timesync_replies: ArrayPair
) -> ClockLine | None:
    """Fit the conversion of sender clock to boot clock by TIMESYNC, as mean of both directions."""
    clock_fits = []
    if len(sender_timesync_replies[0]) >= MIN_TIMESYNC_REPLIES:
        # fit_clock_line requires the clock that is read first as its first argument: here the boot
        # clock, whose time is in the request. The inverse line converts sender time to boot time
        clock_fits.append(fit_clock_line(*sender_timesync_replies).inverse())
    if len(autopilot_timesync_replies[0]) >= MIN_TIMESYNC_REPLIES:
        clock_fits.append(fit_clock_line(*autopilot_timesync_replies))
    if not clock_fits:
        return None
    x0 = clock_fits[0].x0
    line_parameters = [(float(line.at(x0)), line.slope, line.jitter_s) for line in clock_fits]
    y0, slope, jitter_s = np.mean(line_parameters, axis=0).tolist()
    return ClockLine(x0, y0, slope, jitter_s, sum(line.reading_pair_count for line in clock_fits))


def _make_clock_mapping(
    clock: str, method: str, line: ClockLine, timestamps_s: Array, note: str
) -> SenderClockConversion:
    """Return a conversion with its description: offset (s), drift (ppm) and jitter (s)."""
    middle_timestamp_s = 0.5 * float(timestamps_s.min() + timestamps_s.max())
    offset_s = float(line.at(middle_timestamp_s)) - middle_timestamp_s
    drift_ppm = (line.slope - 1.0) * 1e6
    description = ClockConversion(
        clock, method, line.reading_pair_count, offset_s, drift_ppm, line.jitter_s, note
    )
    return SenderClockConversion(line, description)


def describe_clock_conversions(
    recording: Recording, clock_conversions: dict[MavlinkAddress, SenderClockConversion]
) -> tuple[ClockConversion, ...]:
    """Describe the conversions of sender clocks and receive times to the boot clock."""
    clock_descriptions = [mapping.description for mapping in clock_conversions.values()]
    receive_times_us = recording.frames.receive_times_us
    receive_to_boot_time_fit = recording.receive_to_boot_time_fit
    if receive_times_us is not None and receive_to_boot_time_fit.reading_pair_count:
        note = "the messages were recorded during a replay that was faster or slower than real time"
        if abs(receive_to_boot_time_fit.slope - 1.0) < MAX_RELATIVE_CLOCK_RATE_DIFFERENCE:
            note = (
                "receive times are converted to boot time with a line fitted to the least delayed "
                "messages"
            )
        clock_descriptions.append(
            ClockConversion(
                clock="receive time (UNIX time of the recording computer)",
                method="receive time",
                pairs=receive_to_boot_time_fit.reading_pair_count,
                offset_s=receive_to_boot_time_fit.y0
                - receive_to_boot_time_fit.x0
                - float(receive_times_us[0]) * 1e-6,
                drift_ppm=(receive_to_boot_time_fit.slope - 1.0) * 1e6,
                jitter_s=receive_to_boot_time_fit.jitter_s,
                note=note,
            )
        )
    return tuple(clock_descriptions)


def describe_senders(recording: Recording) -> tuple[Sender, ...]:
    """Describe the senders in the recording, most messages first."""
    frames = recording.frames
    vehicle_types = _read_vehicle_types(frames)
    senders = []
    for address, count in [*_count_frames(frames).items()][:MAX_SENDERS]:
        description = "component that sent no HEARTBEAT"
        if address in vehicle_types:
            vehicle_type, autopilot = vehicle_types[address]
            description = VEHICLE_TYPES.get(vehicle_type, f"vehicle of MAV_TYPE {vehicle_type}")
            if autopilot != NO_AUTOPILOT:
                name = AUTOPILOT_NAME_BY_ID.get(autopilot, "autopilot")
                description = f"{name} {description}"
        lost_fraction = _estimate_lost_fraction(frames, address)
        senders.append(
            Sender(*address, description, count, lost_fraction, address == recording.address)
        )
    return tuple(senders)


def _estimate_lost_fraction(frames: MavlinkFrames, address: MavlinkAddress) -> float | None:
    """Return the fraction of lost messages of a sender, from gaps in the sequence numbers.

    Return None if the sequence numbers are not usable.
    """
    sequence_numbers = frames.sequence_numbers[frames.is_sent_by(address)].astype(np.int64)
    # The numbers restart after 255. Steps are between -16 (a late message) and 239
    sequence_steps = (np.diff(sequence_numbers) + MAX_LATE_MESSAGES) % 256 - MAX_LATE_MESSAGES
    if len(sequence_steps) and not sequence_steps.any():  # the sender does not count its messages
        return None
    unwrapped_sequence_numbers = np.append(0, np.cumsum(sequence_steps))
    sent_count = np.ptp(unwrapped_sequence_numbers) + 1
    lost_fraction = float(1.0 - len(np.unique(unwrapped_sequence_numbers)) / sent_count)
    return lost_fraction if lost_fraction < MAX_LOST_MESSAGE_FRACTION else None
