"""Description of a flight log: file, senders, clocks, and topics of each kind of data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from px4fuse.core.notebook_display import one_line_repr
from px4fuse.core.record import Count, NotNegative, Record, Sha256, Share, Unavailable
from px4fuse.flight.ekf2_parameters import PARAMETERS

REPEATED_TIMESTAMPS = "most timestamps are repeated"
# Name of the clock of a sender in a ULog: PX4 converts or replaces the sender's timestamps
SENDER_CLOCK = "sender timestamps"
# Replacement for the estimates, re-runs and findings of a flight that is a student assignment
DIAGNOSIS_WITHHELD = Unavailable(
    "diagnosis",
    "the flight is an assignment, so px4fuse withholds its diagnosis",
    "Analyse the flight with your own settings, and give your diagnosis with --answers.",
)


class Dropout(Record):
    """Time span (s) in which the logger of the autopilot lost data."""

    start_s: float
    duration_s: NotNegative


class Sender(Record):
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


class ClockMap(Record):
    """Linear conversion of a clock to the autopilot's boot clock.

    boot = timestamp + offset + drift · (timestamp - middle of the timestamps)
    """

    # Name of the clock ("UNIX time of system 1, component 197")
    clock: str
    # Source of the conversion: "boot clock", "TIMESYNC", "SYSTEM_TIME", "receive time", "arrival
    # time" or "position in the stream"
    method: str
    # Number of simultaneous readings of both clocks
    pairs: Count
    # Boot clock minus this clock, at the middle of the readings
    offset_s: float
    # Rate of the boot clock minus rate of this clock
    drift_ppm: float
    # Standard deviation of the readings from the fitted line (1.4826 · median absolute deviation)
    jitter_s: NotNegative
    # Limitation of the conversion, if any
    note: str = ""
    # Number of different timestamps, only if too few for a conversion
    distinct_stamps: Count | None = None


def clock_of_repeated_timestamps(
    clock: str, sample_count: int, distinct_count: int
) -> ClockMap | None:
    """Describe a clock of which most timestamps are repeated, else return None."""
    if 2 * distinct_count > sample_count:
        return None
    return ClockMap(
        clock, "as sent", sample_count, 0.0, 0.0, 0.0, REPEATED_TIMESTAMPS, distinct_count
    )


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


class InputFile(Record):
    """Input file in addition to the log: name without folder, SHA-256, size (bytes) and role."""

    name: str
    sha256: Sha256
    bytes: Count
    role: Literal["position"]


class LogInfo(Record, omit_defaults=False):
    """Description of the log file; "unknown" for texts that are not in the log."""

    # File name without folder
    name: str
    sha256: Sha256
    bytes: Count
    # A "MAVLink tlog" contains receive times, a "MAVLink stream" does not
    format: Literal["ULog", "MAVLink tlog", "MAVLink stream"]
    firmware: str
    firmware_hash: str
    hardware: str
    # Boot clock at time zero of the flight, which is the first sample
    boot_time_s: float
    # ULog: duration of the IMU samples, else of the topic with the most samples. MAVLink: duration
    # of the messages with boot time. Outliers of time are ignored
    duration_s: NotNegative
    dropouts: tuple[Dropout, ...] = ()
    # PX4 parameters for fusion and logging at the start of the log
    parameters: Mapping[str, int | float] = {}
    # Sentences about dropped samples and clocks
    notes: tuple[str, ...] = ()
    autopilot: str = "PX4"
    # UNIX time at time zero of the flight
    start_unix_s: float | None = None
    # Senders of a MAVLink recording, most messages first
    senders: tuple[Sender, ...] = ()
    # Hexadecimal identifier of the flight controller
    vehicle: str = ""
    # Sentences about damaged bytes of the file
    damage: tuple[str, ...] = ()
    # Number of bytes that were read as complete messages
    bytes_read: Count = 0
    # True if the land detector reports flight at the end of the data
    ends_in_flight: bool = False
    # Number of restarts of the boot clock; only data between two restarts are used
    restarts: Count | None = None
    # Number of backward jumps of the recording computer's clock
    receive_time_reversals: Count | None = None
    # Number of samples with invalid timestamps, by topic, message or file
    dropped: Mapping[str, Count] = {}
    # Firmware defaults of the changed EKF2 parameters; ULog only
    parameter_defaults: Mapping[str, int | float] = {}
    # True if ``px4fuse simulate --assignment`` wrote the log: px4fuse withholds its diagnosis
    is_assessed: Literal[True] | msgspec.UnsetType = msgspec.UNSET

    __repr__ = one_line_repr

    def default_of(self, parameter: str) -> float:
        """Return the default of an EKF2 parameter: the logged default, else PX4's since v1.14."""
        return self.parameter_defaults.get(parameter, PARAMETERS[parameter].default)

    @property
    def has_ulog(self) -> bool:
        """True if the autopilot writes ULog files, as PX4 does."""
        return self.autopilot != "ArduPilot"
