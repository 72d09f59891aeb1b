"""Description of a recording: log file, senders, clocks, and topics of each kind of data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from px4fuse.notebook_display import one_line_repr
from px4fuse.record import Count, NotNegative, Record, Sha256, Share


SHARED_STAMPS = "most samples share a timestamp"
# Clock of timestamps that PX4 converted or replaced
SENDER_CLOCK = "sender timestamps"


class Dropout(Record, frozen=True):
    """Interval that the logger lost: start and duration in s."""

    start_s: float
    duration_s: NotNegative


class Sender(Record, frozen=True):
    """MAVLink sender in a recording.

    Attributes
    ----------
    system, component : int
        MAVLink ids.
    description : str
        Type from its heartbeat ("PX4 quadrotor", "companion computer").
    messages : int
        Messages with a valid checksum.
    lost_fraction : float or None
        Fraction of its messages missing in the recording, by the sequence numbers; None if the
        sender does not count its messages.
    chosen : bool
        True for the autopilot of the flight.
    """

    system: int
    component: int
    description: str
    messages: Count
    lost_fraction: Share | None
    chosen: bool


class ClockMap(Record, frozen=True):
    """Map from one clock to the autopilot's boot clock.

    boot = timestamp + offset + drift · (timestamp - middle of the timestamps)

    Attributes
    ----------
    clock : str
        Name of the clock ("UNIX time of system 1, component 197").
    method : str
        "boot clock", "TIMESYNC", "SYSTEM_TIME", "receive time", "arrival time" or "position in the
        stream".
    pairs : int
        Number of pairs of clock readings.
    offset_s : float
        Boot clock minus this clock, at the middle of the pairs.
    drift_ppm : float
        Rate of the boot clock minus rate of this clock (parts per million).
    jitter_s : float
        Standard deviation of the pairs about the fitted line (1.4826 · median absolute deviation).
    note : str
        Limitation of the map; may be empty.
    distinct_stamps : int or None
        Number of distinct timestamps if the timestamps are not usable as a clock.
    """

    clock: str
    method: str
    pairs: Count
    offset_s: float
    drift_ppm: float
    jitter_s: NotNegative
    note: str = ""
    distinct_stamps: Count | None = None


@dataclass(frozen=True)
class Stream:
    """Topics, clock and file of one kind of data (IMU, attitude, ...).

    Attributes
    ----------
    topics : tuple of str
        PX4 topics or MAVLink messages.
    clock : str
        Clock of the timestamps.
    log : str
        File name.
    """

    topics: tuple[str, ...]
    clock: str
    log: str


@dataclass(frozen=True)
class UnusedData:
    """Position-related topic or message that px4fuse does not use, with the reason."""

    name: str
    count: int
    reason: str


class InputFile(Record, frozen=True):
    """File read in addition to the log: name without folder, hash, size and role."""

    name: str
    sha256: Sha256
    bytes: Count
    role: Literal["mavlink", "position"]


class LogInfo(Record, frozen=True, omit_defaults=False):
    """Description of the log file.

    Attributes
    ----------
    name : str
        File name without folder.
    sha256 : str
        Hash of the file content.
    bytes : int
        File size.
    format : str
        "ULog", "MAVLink tlog" (with receive times) or "MAVLink stream" (without).
    firmware : str
        For example "PX4 v1.16.1"; "unknown" if not in the log.
    firmware_hash : str
        Git hash, or "unknown".
    hardware : str
    boot_time_s : float
        Boot clock (s) of time zero, the first sample of data.
    duration_s : float
        Duration of the data: in a ULog of the IMU (or else of the topic with most samples), in
        MAVLink of the messages with boot time. Single messages hours away are ignored.
    dropouts : tuple of Dropout
        Dropouts that the logger reported.
    parameters : mapping
        Parameters of fusion and logging at the start of the log, by PX4 name.
    notes : tuple of str
        Sentences on dropped samples and mapped clocks.
    damage : tuple of str
        Sentences on unreadable parts of the file.
    bytes_read : int
        Number of bytes that were read as complete messages.
    ends_in_flight : bool
        True if the land detector reports flight at the end of the data.
    restarts : int or None
        Number of restarts of the boot clock; only one part of the recording is used then.
    receive_time_reversals : int or None
        Number of backward steps of the recording computer's clock.
    dropped : mapping
        Number of samples with invalid timestamps, by topic, message or file.
    autopilot : str
        "PX4", "ArduPilot", or the name in the log.
    start_unix_s : float or None
        UNIX time of time zero; None if not in the log.
    senders : tuple of Sender
        Senders of a MAVLink recording, most messages first.
    vehicle : str
        Hexadecimal identifier of the flight controller; empty if not in the log.
    """

    name: str
    sha256: Sha256
    bytes: Count
    format: Literal["ULog", "MAVLink tlog", "MAVLink stream"]
    firmware: str
    firmware_hash: str
    hardware: str
    boot_time_s: float
    duration_s: NotNegative
    dropouts: tuple[Dropout, ...] = ()
    parameters: Mapping[str, int | float] = {}
    notes: tuple[str, ...] = ()
    autopilot: str = "PX4"
    start_unix_s: float | None = None
    senders: tuple[Sender, ...] = ()
    vehicle: str = ""
    damage: tuple[str, ...] = ()
    bytes_read: Count = 0
    ends_in_flight: bool = False
    restarts: Count | None = None
    receive_time_reversals: Count | None = None
    dropped: Mapping[str, Count] = {}

    __repr__ = one_line_repr

    @property
    def has_ulog(self) -> bool:
        """True if the autopilot writes ULog files; ArduPilot writes DataFlash instead."""
        return self.autopilot != "ArduPilot"
