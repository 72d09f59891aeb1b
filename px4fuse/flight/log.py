"""Description of a flight log: file, senders, clocks, and topics of each kind of data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from px4fuse.core.notebook_display import one_line_repr
from px4fuse.core.record import Count, NotNegative, Record, Sha256, Share
from px4fuse.flight.ekf2_parameters import PARAMETERS

SHARED_STAMPS = "most timestamps are repeated"
# Name of the clock of timestamps that PX4 converted from the sender's clock, or replaced
SENDER_CLOCK = "sender timestamps"


class Dropout(Record, frozen=True):
    """Time span (s) in which the logger of the autopilot lost data."""

    start_s: float
    duration_s: NotNegative


class Sender(Record, frozen=True):
    """Sender of messages in a MAVLink recording.

    Attributes
    ----------
    system, component : int
        MAVLink ids.
    description : str
        Type from the heartbeat of the sender ("PX4 quadrotor", "companion computer").
    messages : int
        Number of messages with a valid checksum.
    lost_fraction : float or None
        Fraction of the sender's messages that the recording does not contain, from the sequence
        numbers; None if the sender does not count its messages.
    chosen : bool
        True for the autopilot of the analysed flight.
    """

    system: int
    component: int
    description: str
    messages: Count
    lost_fraction: Share | None
    chosen: bool


class ClockMap(Record, frozen=True):
    """Conversion of the timestamps of a clock to the autopilot's boot clock.

    boot = timestamp + offset + drift · (timestamp - middle of the timestamps)

    Attributes
    ----------
    clock : str
        Name of the clock ("UNIX time of system 1, component 197").
    method : str
        Data from which the conversion is estimated: "boot clock", "TIMESYNC", "SYSTEM_TIME",
        "receive time", "arrival time" or "position in the stream".
    pairs : int
        Number of simultaneous readings of both clocks.
    offset_s : float
        Boot clock minus this clock, at the middle of the readings.
    drift_ppm : float
        Rate of the boot clock minus rate of this clock (parts per million).
    jitter_s : float
        Standard deviation of the readings from the fitted line (1.4826 · median absolute
        deviation).
    note : str
        Limitation of the conversion; may be empty.
    distinct_stamps : int or None
        Number of different timestamps, if the timestamps are not usable as a clock.
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
    """Origin of one kind of data: topics or messages, clock of the timestamps, and file name."""

    topics: tuple[str, ...]
    clock: str
    log: str


@dataclass(frozen=True)
class UnusedData:
    """Topic or message with position data that px4fuse does not use, and its number of messages."""

    name: str
    count: int
    reason: str


class InputFile(Record, frozen=True):
    """Input file in addition to the log: name without folder, SHA-256, size (bytes) and role."""

    name: str
    sha256: Sha256
    bytes: Count
    role: Literal["position"]


class LogInfo(Record, frozen=True, omit_defaults=False):
    """Description of the log file.

    Attributes
    ----------
    name : str
        File name without folder.
    sha256 : str
        SHA-256 of the file content.
    bytes : int
        Size of the file.
    format : str
        "ULog", "MAVLink tlog" (with receive times) or "MAVLink stream" (without).
    firmware : str
        Version, for example "PX4 v1.16.1"; "unknown" if not in the log.
    firmware_hash : str
        Git hash of the firmware; "unknown" if not in the log.
    hardware : str
    boot_time_s : float
        Boot clock (s) at time zero of the flight, which is the first sample.
    duration_s : float
        Duration of the data. ULog: duration of the IMU samples, else of the topic with the most
        samples. MAVLink: duration of the messages with boot time. Outliers of time are ignored.
    dropouts : tuple of Dropout
        Dropouts that the logger reported.
    parameters : mapping
        PX4 parameters for fusion and logging at the start of the log, by name.
    parameter_defaults : mapping
        Logged firmware defaults of the EKF2 parameters whose values are changed; ULog only.
    notes : tuple of str
        Sentences about dropped samples and clocks.
    damage : tuple of str
        Sentences about damaged bytes of the file.
    bytes_read : int
        Number of bytes that were read as complete messages.
    ends_in_flight : bool
        True if the land detector reports flight at the end of the data.
    restarts : int or None
        Number of restarts of the boot clock; if any, only the data between two restarts are used.
    receive_time_reversals : int or None
        Number of backward jumps of the recording computer's clock.
    dropped : mapping
        Number of samples with invalid timestamps, by topic, message or file.
    autopilot : str
        "PX4", "ArduPilot", or the name in the log.
    start_unix_s : float or None
        UNIX time at time zero of the flight; None if not in the log.
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
    parameter_defaults: Mapping[str, int | float] = {}

    __repr__ = one_line_repr

    def default_of(self, parameter: str) -> float:
        """Return the default of an EKF2 parameter: the logged default, else PX4's since v1.14."""
        return self.parameter_defaults.get(parameter, PARAMETERS[parameter].default)

    @property
    def has_ulog(self) -> bool:
        """True if the autopilot writes ULog files, as PX4 does."""
        return self.autopilot != "ArduPilot"
