"""What a recording is: the log, its senders and clocks, and what was read from where."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from px4fuse.display import one_line_repr
from px4fuse.record import Count, NotNegative, Record, Sha256, Share


class Dropout(Record, frozen=True):
    """A stretch that the logger lost: start and length in seconds."""

    start_s: float
    duration_s: NotNegative


class Sender(Record, frozen=True):
    """One MAVLink sender that a recording heard.

    Attributes
    ----------
    system, component : int
        MAVLink ids.
    description : str
        What it says it is ("PX4 quadrotor", "companion computer").
    messages : int
        Messages with a good checksum.
    lost_share : float or None
        Share of its messages that the recording lacks, by the sequence numbers; None where it
        does not count them.
    chosen : bool
        Whether it is the autopilot that the flight was read from.
    """

    system: int
    component: int
    description: str
    messages: Count
    lost_share: Share | None
    chosen: bool


class ClockMap(Record, frozen=True):
    """How one clock was mapped to the autopilot's boot clock.

    boot = stamp + offset + drift · (stamp - middle of the stamps)

    Attributes
    ----------
    clock : str
        Which clock ("UNIX time of system 1, component 197").
    method : str
        "boot clock", "TIMESYNC", "SYSTEM_TIME", "receive time", "arrival time" or "position in the
        stream".
    pairs : int
        Pairs of readings that it rests on.
    offset_s : float
        Boot clock minus this clock, at the middle of the pairs.
    drift_ppm : float
        How much faster the boot clock runs (parts per million).
    jitter_s : float
        Standard deviation of the pairs about the fitted line (1.4826 · median absolute deviation).
    note : str
        What to keep in mind; may be empty.
    distinct_stamps : int or None
        How many values the stamps take where those do not tell the time.
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
    """Where one part of a flight was read from.

    Attributes
    ----------
    topics : tuple of str
        PX4 topics or MAVLink messages.
    clock : str
        Which clock its time stamps were given on.
    log : str
        Name of the file.
    """

    topics: tuple[str, ...]
    clock: str
    log: str


@dataclass(frozen=True)
class Unused:
    """Something in the log that bears on position but that px4fuse does not use, and why."""

    name: str
    count: int
    reason: str


class InputFile(Record, frozen=True):
    """A file that was read beside the log: name without its folder, hash, size, and its part."""

    name: str
    sha256: Sha256
    bytes: Count
    role: Literal["mavlink", "position"]


class LogInfo(Record, frozen=True, omit_defaults=False):
    """What the log is.

    Attributes
    ----------
    name : str
        File name without its folder.
    sha256 : str
        Of the file's bytes.
    bytes : int
    format : str
        "ULog", "MAVLink tlog" (with time of receipt) or "MAVLink stream" (without).
    firmware : str
        For example "PX4 v1.16.1"; "unknown" where the log does not say.
    firmware_hash : str
        Git hash, or "unknown".
    hardware : str
    boot_time_s : float
        Boot clock (s) of time zero, the first sample of data.
    duration_s : float
        Span of the data, not of the file: some logs carry one stale message hours away. In a ULog
        of the IMU (or else of the densest topic), in MAVLink of what carries the boot clock.
    dropouts : tuple of Dropout
        As the logger itself reported them.
    parameters : mapping
        Parameters that bear on fusion and logging, by PX4 name, as they were at the log's start.
    notes : tuple of str
        What the reader had to do: samples with impossible time stamps, clocks that were mapped.
    damage : tuple of str
        What of the file could not be read, and how much that is: sentences.
    bytes_read : int
        Part of ``bytes`` that was read as complete messages.
    ends_in_flight : bool
        Whether the land detector still says "flying" at the end of the data.
    restarts : int or None
        How often the boot clock began again: then one part of the recording was read.
    receipt_went_back : int or None
        How often the recording computer's clock was set back.
    dropped : mapping
        Samples whose time stamps cannot be, by topic or file.
    autopilot : str
        "PX4", "ArduPilot", or what the log says.
    start_unix_s : float or None
        UNIX time of time zero, by whichever clock the log has it from; None where it has none.
    senders : tuple of Sender
        Of a MAVLink recording, most messages first.
    vehicle : str
        Identifier of the flight controller, hexadecimal; empty where the log has none.
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
    receipt_went_back: Count | None = None
    dropped: Mapping[str, Count] = {}

    __repr__ = one_line_repr

    @property
    def has_ulog(self) -> bool:
        """Whether its autopilot writes a ULog: ArduPilot writes DataFlash, which is not read."""
        return self.autopilot != "ArduPilot"
