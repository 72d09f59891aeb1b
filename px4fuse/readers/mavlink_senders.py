"""Senders of a MAVLink recording: the autopilot, position senders, and their clocks."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from px4fuse.arrays import IntArray
from px4fuse.errors import SettingsError
from px4fuse.log import ClockMap, Sender
from px4fuse.readers import mavlink_messages as messages
from px4fuse.readers.mavlink_clocks import (
    MAX_SPEED_DIFFERENCE,
    ClockMapping,
    Line,
    is_running_clock,
    map_clock,
)
from px4fuse.readers.mavlink_frames import Address, Frames
from px4fuse.readers.mavlink_recording import RESTART_S, Recording, unix_of_boot

# Only the senders with most messages are read and described
MAX_SENDERS = 32
# Lost fraction above which the sequence numbers are not counted by the sender and are ignored
MAX_LOST_SHARE = 0.9
# Sequence numbers; a message this much late was received over a slower link, not lost
MAX_LATE_MESSAGES = 16
# s; timestamps of one sender that differ by more are from two clocks
OTHER_CLOCK_S = 1e5


def _vehicle_types(frames: Frames) -> dict[Address, tuple[int, int]]:
    """Return MAV_TYPE and MAV_AUTOPILOT from each sender's first heartbeat."""
    rows = frames.rows("HEARTBEAT")
    beats = frames.table("HEARTBEAT", rows)
    types = zip(beats["type"].tolist(), beats["autopilot"].tolist(), strict=True)
    types_by_sender = [*zip(_addresses(frames, rows), types, strict=True)]
    return dict(types_by_sender[::-1])


def _addresses(frames: Frames, rows: IntArray | slice) -> Iterator[Address]:
    """Return the sender address of each frame."""
    return zip(frames.system[rows].tolist(), frames.component[rows].tolist(), strict=True)


def _count_frames(
    frames: Frames, rows: IntArray | slice = slice(None)
) -> list[tuple[Address, int]]:
    """Count frames by sender, most frames first."""
    counts = Counter(_addresses(frames, rows))
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def _is_vehicle(kind: int, autopilot: int) -> bool:
    return autopilot != messages.NO_AUTOPILOT and kind != messages.GROUND_STATION


def choose_autopilot(frames: Frames, system: int | None) -> tuple[Address, str]:
    """Return address and name of the autopilot with most messages, or of a given system id.

    Raises
    ------
    SettingsError
        No autopilot has the given system id.
    """
    counts = dict(_count_frames(frames))
    vehicles = _vehicle_types(frames)
    flying = [s for s in counts if s in vehicles and _is_vehicle(*vehicles[s])]
    rows = np.concatenate([frames.rows(name) for name in messages.OWN_MESSAGES])
    own = dict(_count_frames(frames, rows))
    # Companion computers may have autopilot heartbeats, so messages that only autopilots send
    # count first. Without a heartbeat, these messages or the component id identify the autopilot
    candidates = [s for s in flying if s in own] or [s for s in own if s not in vehicles] or flying
    candidates = candidates or [s for s in counts if s[1] == messages.AUTOPILOT_COMPONENT]
    # The recording may contain no message from the autopilot itself
    candidates = candidates or [(s[0], messages.AUTOPILOT_COMPONENT) for s in counts]
    if system is not None:
        candidates = [address for address in {*flying, *candidates} if address[0] == system]
        if not candidates:
            have = ", ".join(str(number) for number in sorted({s[0] for s in flying})) or "none"
            raise SettingsError(
                f"{frames.name}: no autopilot has MAVLink system id {system}. Autopilots in "
                f"this file: {have}."
            )
    best = max(candidates, key=lambda address: counts.get(address, 0))
    name = messages.AUTOPILOTS.get(vehicles[best][1]) if best in vehicles else None
    return best, name or "unknown autopilot"


def senders_of(recording: Recording, message: str) -> list[Address]:
    """Return the senders of one message other than this vehicle's autopilot and other vehicles."""
    frames, own = recording.frames, recording.address
    others = {
        s[0] for s, vehicle_type in _vehicle_types(frames).items() if _is_vehicle(*vehicle_type)
    } - {own[0]}
    counts = _count_frames(frames, recording.rows_of_all_senders(message))
    return [s for s, _ in counts if s != own and s[0] not in others][:MAX_SENDERS]


def map_senders(recording: Recording) -> dict[Address, ClockMapping]:
    """Map the clock of every sender of an external position to the boot clock."""
    message_names = {source.message for source in messages.POSITION_INPUTS}
    senders = {s for message in message_names for s in senders_of(recording, message)}
    unix = unix_of_boot(recording)
    return {sender: _map_sender(recording, sender, unix) for sender in sorted(senders)}


def _map_sender(recording: Recording, sender: Address, unix: Line | None) -> ClockMapping:
    frames = recording.frames
    stamps, received = [], []
    for source in messages.POSITION_INPUTS:
        rows = recording.rows(source.message, sender)
        stamps.append(frames.table(source.message, rows)[source.stamp] * 1e-6)
        received.append(recording.received_s[rows])
    median_stamp_s = float(np.median(np.concatenate(stamps)))
    clock_runs = is_running_clock(np.concatenate(stamps))
    rows = recording.rows("TIMESYNC", sender)
    sync = frames.table("TIMESYNC", rows)
    replied_s, sync_asked_s = sync["tc1"] * 1e-9, sync["ts1"] * 1e-9
    # Replies to another sender's request contain another clock
    replies = (replied_s != 0.0) & (
        np.abs(sync_asked_s - recording.receipt_boot_s(rows)) <= RESTART_S
    )
    # A TIMESYNC request gets its timestamp when it is sent, so it is hardly delayed
    questions = (
        clock_runs & (replied_s == 0.0) & (np.abs(sync_asked_s - median_stamp_s) < OTHER_CLOCK_S)
    )
    stamps.append(sync_asked_s[questions])
    received.append(recording.received_s[rows][questions])
    own = frames.table("TIMESYNC", recording.rows("TIMESYNC"))
    answered_s, question_s = own["tc1"] * 1e-9, own["ts1"] * 1e-9
    answers = (answered_s != 0.0) & (np.abs(question_s - median_stamp_s) < OTHER_CLOCK_S)
    answers &= ~np.isin(own["ts1"], _other_sync_questions(recording, sender))
    return map_clock(
        f"system {sender[0]}, component {sender[1]}",
        np.concatenate(stamps),
        np.concatenate(received),
        recording.boot_of_receipt,
        (sync_asked_s[replies], replied_s[replies]),
        (question_s[answers], answered_s[answers]),
        unix,
        has_receipt=frames.received_us is not None,
    )


def _other_sync_questions(recording: Recording, sender: Address) -> NDArray[np.int64]:
    """Return ``ts1`` of the TIMESYNC requests of all other senders."""
    frames = recording.frames
    rows = frames.rows("TIMESYNC")
    sync = frames.table("TIMESYNC", rows[~frames.sent_by(sender, rows)])
    return np.asarray(sync["ts1"][sync["tc1"] == 0])


def clock_maps(
    recording: Recording, clock_mappings: dict[Address, ClockMapping]
) -> tuple[ClockMap, ...]:
    """Return the maps from sender clocks and receive time to the boot clock."""
    clocks = [sender.statement for sender in clock_mappings.values()]
    received_us, line = recording.frames.received_us, recording.boot_of_receipt
    if received_us is not None and line.pairs:
        name = "receive time (UNIX time of the recording computer)"
        note = "the recording speed differs from real time (replayed link?)"
        if abs(line.slope - 1.0) < MAX_SPEED_DIFFERENCE:
            note = "from the messages with least delay; used only to order messages and map clocks"
        offset_s = line.y0 - line.x0 - float(received_us[0]) * 1e-6
        numbers = line.pairs, offset_s, (line.slope - 1.0) * 1e6, line.jitter
        clocks.append(ClockMap(name, "receive time", *numbers, note))
    return tuple(clocks)


def describe_senders(recording: Recording) -> tuple[Sender, ...]:
    """Describe the senders in the recording, most messages first."""
    frames, vehicles = recording.frames, _vehicle_types(recording.frames)
    sender_rows = []
    for address, count in _count_frames(frames)[:MAX_SENDERS]:
        description = "no heartbeat"
        if address in vehicles:
            kind, autopilot = vehicles[address]
            description = messages.VEHICLE_TYPES.get(kind, f"type {kind}")
            if autopilot != messages.NO_AUTOPILOT:
                description = f"{messages.AUTOPILOTS.get(autopilot, 'autopilot')} {description}"
        lost, chosen = _lost_share_of(frames, address), address == recording.address
        sender_rows.append(Sender(*address, description, count, lost, chosen))
    return tuple(sender_rows)


def _lost_share_of(frames: Frames, address: Address) -> float | None:
    """Return the fraction of a sender's messages that are missing, by its sequence numbers.

    Repeated or slightly late messages are not lost. None if the sender does not count its
    messages, or counts them separately on two links.
    """
    number = frames.sequence[frames.sent_by(address)].astype(np.int64)
    step = np.mod(np.diff(number) + MAX_LATE_MESSAGES, 256) - MAX_LATE_MESSAGES
    place = np.append(0, np.cumsum(step))
    share = float(1.0 - len(np.unique(place)) / (np.ptp(place) + 1))
    counts = len(place) == 1 or bool(place.any())
    return share if counts and share < MAX_LOST_SHARE else None
