"""Data model of a flight.

Times are measurement times (s) on the autopilot's boot clock since the first sample.
Vectors are NED (north, east, down) in m, m/s and m/s², or body FRD if stated.
Missing data are :class:`Unavailable` with a reason. They are never replaced by zeros.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.record import (
    Count,
    NonNegativeFloat,
    Record,
    Sha256,
    Share,
    Span,
    Vector,
    one_line_repr,
)
from px4fuse.core.record import Unavailable as Unavailable  # noqa: PLC0414 - public re-export

from .ekf2_parameters import BAROMETER, EV_POS, GNSS_POS, MODEL_PARAMETERS, Aid

PositionKind = Literal["uwb", "vio", "mocap", "gnss", "unknown", "file"]
PositionRoute = Literal[
    "given file",
    "as received",
    "aligned by EKF2",
    "kept by EKF2",
    "rebuilt from innovations",
]


class SourceOrigin(Record):
    """Kind of a position source, and logged data that contain its positions."""

    # Kind of the sensor, inferred from the data
    kind: PositionKind
    # File or logged data from which the positions are read. For example, "as received" means the
    # messages that the autopilot received
    route: PositionRoute
    # EKF2's aiding source for these positions; None if EKF2 never fuses them
    aid: Aid | None
    # True if px4fuse may select the source by default
    is_selectable_by_default: bool = True

    @property
    def may_drift(self) -> bool:
        """True if the position error may grow with the distance travelled, as for odometry."""
        return self.kind == "vio"

    @property
    def reconstructed(self) -> bool:
        """True if the positions are reconstructed from EKF2's logged data."""
        return self.route in ("kept by EKF2", "rebuilt from innovations")

    @property
    def has_all_samples(self) -> bool:
        """True for a file or received messages; EKF2's logged data contain only some positions."""
        return self.route in ("given file", "as received")

    @property
    def is_vision(self) -> bool:
        return self.aid == EV_POS

    @property
    def is_fused_as_gnss(self) -> bool:
        return self.aid == GNSS_POS

    @property
    def is_gnss(self) -> bool:
        """True for GNSS, whose errors (multipath, atmosphere) are correlated over minutes."""
        return self.kind == "gnss"

    def find_preference_rank(self) -> int:
        """Return the rank of the source. px4fuse prefers the source with the smallest rank."""
        return [(origin.aid, origin.route) for origin in SOURCE_ORIGINS].index(
            (self.aid, self.route)
        )


POSITION_FILE_ORIGIN = SourceOrigin("file", "given file", EV_POS)
AS_RECEIVED_ORIGIN = SourceOrigin("uwb", "as received", EV_POS)
MOTION_CAPTURE_ORIGIN = SourceOrigin("mocap", "as received", None)
ALIGNED_BY_EKF2_ORIGIN = SourceOrigin("uwb", "aligned by EKF2", EV_POS)
KEPT_BY_EKF2_ORIGIN = SourceOrigin("uwb", "kept by EKF2", EV_POS)
REBUILT_FROM_INNOVATIONS_ORIGIN = SourceOrigin("uwb", "rebuilt from innovations", EV_POS)
GNSS_ORIGIN = SourceOrigin("gnss", "as received", GNSS_POS, is_selectable_by_default=False)
# All kinds of position sources, in order of preference
SOURCE_ORIGINS = (
    POSITION_FILE_ORIGIN,
    AS_RECEIVED_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    ALIGNED_BY_EKF2_ORIGIN,
    KEPT_BY_EKF2_ORIGIN,
    REBUILT_FROM_INNOVATIONS_ORIGIN,
    GNSS_ORIGIN,
)


def find_source_origin(kind: str, route: str) -> SourceOrigin:
    for origin in SOURCE_ORIGINS:
        if (origin.kind, origin.route) == (kind, route):
            return origin
    raise ValueError(f"unknown position source: kind {kind!r}, route {route!r}")


REPEATED_TIMESTAMPS_NOTE = (
    "most timestamps of the sender are repeated, so they are not converted to boot time"
)
# Clock name for timestamps of an external sender
SENDER_CLOCK = "sender timestamps"
# The diagnosis would show students the injected fault of an assignment
DIAGNOSIS_WITHHELD = Unavailable(
    "diagnosis",
    "the flight is a student assignment, for which px4fuse shows no diagnosis",
    "Analyse the flight with your own settings. Give the answer form with compare --answers.",
)


class Dropout(Record):
    """Time span (s) in which the autopilot's logger lost data."""

    start_s: float
    duration_s: NonNegativeFloat


class Sender(Record):
    """Sender of messages in a MAVLink recording.

    Attributes
    ----------
    system, component : int
        MAVLink ids.
    description : str
        Type of the sender, for example "PX4 quadrotor".
    messages : int
        Number of messages with a valid checksum.
    lost_fraction : float or None
        Fraction of lost messages, from the sequence numbers; None if unknown.
    chosen : bool
        True for the autopilot of the analysed flight.
    """

    system: int
    component: int
    description: str
    messages: Count
    lost_fraction: Share | None
    chosen: bool


class ClockConversion(Record):
    """Linear conversion of a clock to the autopilot's boot clock.

    boot time = timestamp + offset + drift · (timestamp - middle of the timestamps)
    """

    # Name of the clock ("UNIX time of system 1, component 197")
    clock: str
    # Data from which this conversion was estimated, for example "TIMESYNC" or "receive time"
    method: str
    # Number of simultaneous readings of this clock and the boot clock
    pairs: Count
    # Boot clock minus this clock, at the middle of the timestamps
    offset_s: float
    # Drift (ppm) of the boot clock relative to the converted clock
    drift_ppm: float
    # Robust σ (s) of the residuals of the linear fit to simultaneous readings of both clocks
    jitter_s: NonNegativeFloat
    # Limitation of the clock conversion, if any
    note: str = ""
    # Number of distinct timestamps, if they are too few to convert the clock
    distinct_stamps: Count | None = None


def describe_repeated_timestamps(
    clock: str, sample_count: int, distinct_count: int
) -> ClockConversion | None:
    """Describe a clock that cannot be converted, because most timestamps are repeated.

    Return None if more than half of the timestamps are distinct.
    """
    if 2 * distinct_count > sample_count:
        return None
    return ClockConversion(
        clock, "as sent", sample_count, 0.0, 0.0, 0.0, REPEATED_TIMESTAMPS_NOTE, distinct_count
    )


@dataclass(frozen=True)
class DataSource:
    """Origin of one kind of data: topics or messages, clock of their timestamps, file name."""

    topics: tuple[str, ...]
    clock: str
    log: str


@dataclass(frozen=True)
class UnusedData:
    """Topic or message with positions that px4fuse does not use, and the reason."""

    name: str
    count: int
    reason: str


class InputFile(Record):
    """Input file in addition to the log: name without folder, SHA-256 and size (bytes)."""

    name: str
    sha256: Sha256
    bytes: Count
    role: Literal["position"]


class LogInfo(Record, omit_defaults=False):
    """Description of the log file; texts that are not logged are "unknown"."""

    # File name without folder
    name: str
    sha256: Sha256
    bytes: Count
    # A MAVLink tlog contains receive times, a MAVLink stream does not
    format: Literal["ULog", "MAVLink tlog", "MAVLink stream"]
    firmware: str
    firmware_hash: str
    hardware: str
    # Boot time of the first sample, which is time zero of the flight
    boot_time_s: float
    # Time span of the data, without outlying timestamps
    duration_s: NonNegativeFloat
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
    # Number of bytes in complete messages
    bytes_read: Count = 0
    # True if the land detector reports flight at the end of the data
    ends_in_flight: bool = False
    # Number of restarts of the boot clock
    restarts: Count | None = None
    # Number of backward jumps of the recording computer's clock
    receive_time_reversals: Count | None = None
    # Number of samples with invalid timestamps, by topic, message or file
    dropped: Mapping[str, Count] = {}
    # Firmware defaults of changed EKF2 parameters (ULog only)
    parameter_defaults: Mapping[str, int | float] = {}
    # True for a student assignment, for which px4fuse hides the faults
    is_assessed: Literal[True] | msgspec.UnsetType = msgspec.UNSET

    __repr__ = one_line_repr

    def find_default_value(self, parameter: str) -> float:
        """Return the default of an EKF2 parameter, from the log if possible."""
        return self.parameter_defaults.get(parameter, MODEL_PARAMETERS[parameter].default)

    @property
    def writes_ulog(self) -> bool:
        """True if the autopilot writes ULog files, as PX4 does."""
        return self.autopilot != "ArduPilot"


NedAxis = Literal["north", "east", "down"]
TableOrUnavailable = pd.DataFrame | Unavailable
# Step functions of time (s) by name: each value is valid until the next value
StepFunctions: TypeAlias = "Mapping[str, pd.Series[float]]"
# Intervals (start, end) in s of flight time
Spans = tuple[Span, ...]
# Minimum fraction of regular sample intervals; with fewer, the samples arrive in bursts
MIN_REGULAR_INTERVAL_FRACTION = 0.8
# Methods of clock conversion that do not give measurement times
CLOCK_METHODS_WITHOUT_MEASUREMENT_TIMES = ("arrival time", "receive time", "message order")
HEIGHT_ONLY_REASON = "x and y are NaN in all messages, so the source measures only the height"
# Ratio of the median absolute second difference to the σ of white noise
MEDIAN_ABS_SECOND_DIFFERENCE_PER_SIGMA = 6.0**0.5 / 1.4826
# Minimum number of positions to estimate their noise
MIN_NOISE_SAMPLES = 10
# Minimum noise (1 σ, m) of UWB positions
MIN_UWB_NOISE_M = 0.03
# Maximum rate (Hz) of UWB positions
MAX_UWB_RATE_HZ = 25.0
# Minimum time (s) on the ground between two flights; shorter landings are detector errors
MIN_LANDED_DURATION_S = 5.0
BODY_AXES = ("forward", "right", "down")
AXIS_NAMES: tuple[NedAxis, NedAxis, NedAxis] = ("north", "east", "down")
# Names of kinds of position sources in texts; other kinds are printed in capitals ("UWB")
SOURCE_NAMES: Mapping[str, str] = {"unknown": "external vision", "file": "position file"}


# dtype object instead of str: pandas reserves 1 GB of address space for the first column of strings
NO_INVALID_ROWS: pd.Series[str] = pd.Series(dtype=object, index=pd.Index([], dtype=np.float64))


class Columns:
    """Column names of the tables of a flight, with units."""

    GEODETIC: Final = ["latitude_deg", "longitude_deg", "altitude_m"]
    POSITION: Final = ["north_m", "east_m", "down_m"]
    VELOCITY: Final = ["north_m_s", "east_m_s", "down_m_s"]
    STATE: Final = POSITION + VELOCITY
    POSITION_VARIANCE: Final = ["north_m2", "east_m2", "down_m2"]
    VELOCITY_VARIANCE: Final = ["north_m2_s2", "east_m2_s2", "down_m2_s2"]
    SPECIFIC_FORCE: Final = ["forward_m_s2", "right_m_s2", "down_m_s2"]
    ANGULAR_RATE: Final = ["forward_rad_s", "right_rad_s", "down_rad_s"]
    ANTENNA_POSITION: Final = [f"antenna_{axis}_m" for axis in BODY_AXES]
    QUATERNION: Final = ["w", "x", "y", "z"]
    ROTATION_VARIANCE: Final = ["forward_rad2", "right_rad2", "down_rad2"]
    # Columns of EKF2's state and variances at the fusion horizon
    GYRO_BIAS: Final = [f"gyro_bias_{axis}_rad_s" for axis in BODY_AXES]
    ACCELEROMETER_BIAS: Final = [f"accelerometer_bias_{axis}_m_s2" for axis in BODY_AXES]
    EARTH_MAGNETIC_FIELD: Final = [f"earth_field_{axis}_gauss" for axis in AXIS_NAMES]
    BODY_MAGNETIC_FIELD: Final = [f"body_field_{axis}_gauss" for axis in BODY_AXES]
    MAGNETIC_FIELD_INNOVATION: Final = [f"innovation_{axis}_gauss" for axis in BODY_AXES]
    FUSION_HORIZON_STATE: Final = [
        *QUATERNION,
        *VELOCITY,
        *POSITION,
        *GYRO_BIAS,
        *ACCELEROMETER_BIAS,
        *EARTH_MAGNETIC_FIELD,
        *BODY_MAGNETIC_FIELD,
    ]
    FUSION_HORIZON_VARIANCE: Final = [
        *(f"attitude_{axis}_rad2" for axis in AXIS_NAMES),
        *VELOCITY_VARIANCE,
        *POSITION_VARIANCE,
        *(f"{name}_squared" for name in FUSION_HORIZON_STATE[10:]),
    ]


class Alignment(Record, kw_only=True):
    """Alignment of a position file with the flight in time and space.

    A position p of the file becomes origin + Rz(yaw) · C · p in NED. C converts the axes of the
    file to NED axes.
    """

    # Frame of the file: "ned", "enu", "nwu", "eus" or "edn"
    frame: str
    frame_reason: str
    # Rotation from the frame of the file to NED about the vertical, clockwise from above
    yaw_deg: float
    yaw_sigma_deg: NonNegativeFloat | None = None
    yaw_reason: str
    # Position (NED) of the origin of the file's frame
    origin_m: Vector
    # Time since boot minus timestamp in the file
    clock_offset_s: float
    clock_offset_sigma_s: NonNegativeFloat | None = None
    clock_reason: str
    # Reference of the alignment: "EKF2 position", "IMU" or "" (no estimate)
    reference: str
    # Correlation of the aligned positions with the reference
    correlation: float | None = None
    # Horizontal residual (RMS per axis) between the aligned positions and the reference
    residual_rms_m: NonNegativeFloat | None = None
    # Sentences about wrong axes, yaw or origin
    misplaced: tuple[str, ...] = ()
    # Sentences about alignment estimates with a large uncertainty
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PositionTrack:
    """Positions of one external source over time."""

    # Name for the option ``--position-source``, usually the PX4 topic
    name: str
    origin: SourceOrigin
    description: str
    # Position (NED) and reported variances; variances are NaN if not logged
    samples: pd.DataFrame
    # Frame: "NED", "FRD" (fixed, x along the initial heading) or "unknown"
    frame: str
    # Clock of the timestamps, for example "boot clock"
    clock: str
    # Topics or messages that contain the positions
    topics: tuple[str, ...]
    log: str = ""
    # Conversion of the sender's clock to the boot clock
    clock_map: ClockConversion | None = None
    alignment: Alignment | None = None
    # Quaternion from body FRD to ``frame``, and variances about the body axes
    orientation: pd.DataFrame | None = None
    # Velocity (NED) and its variances, for GNSS
    velocity: pd.DataFrame | None = None
    # Delay from measurement to timestamp that EKF2 assumes; already subtracted from the times
    assumed_delay_s: float = 0.0
    # Barometer height, if it replaces the height of the source
    barometer: pd.DataFrame | None = None
    # Sensor position (body FRD) that EKF2 assumes
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    # Sentences about interpolated, reconstructed or dropped samples
    notes: tuple[str, ...] = ()
    # Reason why a row is not a measurement, for example "NaN"
    invalid_reasons: pd.Series[str] = field(default_factory=lambda: NO_INVALID_ROWS)
    # Reset counter, quality and delay until arrival in PX4, if logged
    status: pd.DataFrame = field(default_factory=pd.DataFrame)
    # Quantisation step of the horizontal position; 0 if not quantised
    quantisation_step_m: float = 0.0

    __repr__ = one_line_repr

    def aid(self, axis: str) -> Aid | None:
        """Return EKF2's aiding source for the positions along an axis, if any."""
        return self.origin.aid if axis != "down" or self.barometer is None else BAROMETER

    def description_fields(self) -> dict[str, Any]:
        """Return the fields that describe the position source in results.json."""
        return {
            "name": self.name,
            "kind": self.origin.kind,
            "path": self.origin.route,
            "description": self.description,
            "frame": self.frame,
            "clock": self.clock,
            "reconstructed": self.origin.reconstructed,
            "topics": self.topics,
            "log": self.log,
            "alignment": self.alignment,
        }

    def compute_rate_hz(self) -> float:
        """Return the sample rate (Hz) without gaps; NaN for fewer than two samples."""
        return compute_sample_rate_hz(self.samples)

    @property
    def kind_name(self) -> str:
        """Name of the kind of source for users, such as "UWB"."""
        return SOURCE_NAMES.get(self.origin.kind, self.origin.kind.upper())

    @property
    def positions_text(self) -> str:
        """Name of the positions for users, such as "UWB positions"."""
        if self.origin.kind == "file":
            return "positions from the file"
        return f"{self.kind_name} positions"

    @property
    def reset_times_s(self) -> Array:
        """Times (s) at which the reset counter of the source changes."""
        reset_counter = self.status.get("reset_counter", pd.Series(dtype=float))
        return np.asarray(reset_counter.index[1:][np.diff(reset_counter) != 0.0], np.float64)


def estimate_white_noise_m(position_m: Array) -> float:
    """Estimate the white noise (1 σ, m) of positions, shape (n, axes), along the noisiest axis.

    The estimate uses second differences, which are zero at constant velocity.
    """
    second_difference_m = np.abs(np.diff(position_m, 2, axis=0))
    return (
        float(np.median(second_difference_m, axis=0).max()) / MEDIAN_ABS_SECOND_DIFFERENCE_PER_SIGMA
    )


def infer_position_kind(samples: pd.DataFrame) -> PositionKind:
    """Infer the kind of a position source: "uwb" for noisy positions, otherwise "unknown"."""
    position_m = samples[Columns.POSITION[:2]].dropna().drop_duplicates().to_numpy()
    is_uwb = (
        len(position_m) >= MIN_NOISE_SAMPLES
        and estimate_white_noise_m(position_m) > MIN_UWB_NOISE_M
        and compute_sample_rate_hz(samples) < MAX_UWB_RATE_HZ
    )
    return "uwb" if is_uwb else "unknown"


@dataclass(frozen=True)
class Reset:
    """Reset of EKF2's position or velocity to a new value.

    Attributes
    ----------
    time_s : float
        Time of the first sample after the reset.
    quantity : str
        "position" or "velocity".
    delta : tuple of float
        Change of the state (m or m/s; north, east, down).
    """

    time_s: float
    quantity: Literal["position", "velocity"]
    delta: Vector


EKF2_STEP_S = 0.010  # default of EKF2_PREDICT_US in s (ekf2_params.c)
BIAS_NOT_LOGGED = Unavailable(
    "EKF2 accelerometer bias",
    "estimator_sensor_bias and estimator_states are not logged",
    "Record a ULog with SDLOG_PROFILE bit 0 (default).",
)
FASTER_LOGGING_ACTION = "Use a faster SD card, or log fewer topics (SDLOG_PROFILE)."
FULL_IMU_RATE_ACTION = (
    "Record with SDLOG_PROFILE bit 0 (default), which logs sensor_combined at full rate."
)
HORIZON_NOT_LOGGED = Unavailable(
    "time of the fusion horizon",
    "the log contains no usable timestamp_sample of the EKF2 state",
    "Record a ULog with PX4 v1.13 or newer.",
)


RECORD_NOT_LOGGED = Unavailable(
    "EKF2 state at the fusion horizon",
    "estimator_states is not logged",
    "Give a ULog of PX4 v1.12 or newer, recorded with SDLOG_PROFILE bit 0 (default).",
)


# PX4's names of EKF2 status flags
GROUND_EFFECT_FLAG, BAD_ACCELERATION_FLAG = "gnd_effect", "bad_acc_vertical"
DEAD_RECKONING_FLAG = "inertial_dead_reckoning"
# Weight of a new sample in EKF2's low-pass filter of optical flow (_flow_vel_body_lpf in ekf.h)
FLOW_FILTER_NEW_SAMPLE_WEIGHT = 0.1


@dataclass(frozen=True)
class FusionRecord:
    """Logged data for the EKF2 replay: states at the fusion horizon and measurements."""

    # All EKF2 parameters at the start of the log, in PX4 units
    parameters: Mapping[str, float]
    # EKF2's state and variances at the fusion horizon
    delayed_state: pd.DataFrame
    # True if EKF2 stores biases as increments per prediction (up to PX4 v1.14)
    has_delta_angle_biases: bool
    # Other aiding sources that EKF2 fuses as horizontal position or velocity
    other_horizontal_aids: tuple[str, ...]
    # Delay (s) from measurement to publication of each external vision sample
    vision_age_s: pd.Series
    # Measured magnetic field (body FRD). ``fused_3d`` is 0 while EKF2 fuses the heading only
    magnetic_field_gauss: pd.DataFrame = field(default_factory=pd.DataFrame)
    # Velocity from optical flow (body FRD) before EKF2's low-pass filter, computed from the
    # filtered velocity that EKF2 logs
    flow: pd.DataFrame = field(default_factory=pd.DataFrame)
    # Latitude of the origin of the local NED frame
    latitude_deg: float = np.nan
    # Altitude of the origin, if EKF2 stores altitude above sea level (since PX4 v1.16)
    altitude_m: float = 0.0
    # Logged updates of EKF2's height bias estimators, by aiding source
    height_bias_updates: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    # Status flags of EKF2 by PX4 name; 1 while set
    status_flags: StepFunctions = field(default_factory=dict)

    __repr__ = one_line_repr

    def stores_latitude(self) -> bool:
        """Return True if EKF2 stores the position as latitude and longitude (since v1.16)."""
        return not np.isfinite(self.delayed_state["north_m"]).any()

    def was_flag_set(self, flag: str, times_s: Array) -> BoolArray:
        """Return True for each time at which the status flag of EKF2 was set."""
        step_function = self.status_flags.get(flag)
        return (
            np.zeros(len(times_s), bool)
            if step_function is None
            else sample_step_function(step_function, times_s) > 0.0
        )


@dataclass(frozen=True)
class AidLog:
    """Logged innovations, variances and fusion results of one aiding source of EKF2."""

    # Topics with the innovations and their variances
    topics: tuple[str, ...]
    axes: tuple[str, ...]
    # Innovation (measurement minus prediction) and innovation variance S of each axis
    samples: pd.DataFrame
    # 1 while fusion is enabled, otherwise 0; None if not logged
    enabled: pd.Series[float] | None
    # EKF2 parameters of the aiding source at the start of the log
    parameters: Mapping[str, float] = field(default_factory=dict)
    # Times (s) of innovations for which the log does not state if EKF2 fused them
    times_with_unknown_fusion_s: Array = field(default_factory=lambda: np.zeros(0))

    __repr__ = one_line_repr


def sample_step_function(step_function: pd.Series[float], times: pd.Index[float] | Array) -> Array:
    """Return the values of a step function at the given times."""
    previous_rows = np.clip(np.searchsorted(step_function.index, times, side="right") - 1, 0, None)
    return np.asarray(step_function, np.float64)[previous_rows]


class ParameterChange(NamedTuple):
    """Change of a PX4 parameter in flight."""

    time_s: float
    name: str
    value_before: float
    value_after: float


@dataclass(frozen=True)
class Ekf2:
    """State, variances and innovations of EKF2's primary instance."""

    # Position and velocity (NED) as published, including resets
    state: pd.DataFrame
    variance: TableOrUnavailable
    # Innovations are measurement minus prediction, opposite to PX4's sign
    innovations: Mapping[NedAxis, TableOrUnavailable]
    innovation_topics: tuple[str, ...]
    # 1 while EKF2 fuses the horizontal position, height or yaw of external vision
    fusion_flags: TableOrUnavailable
    resets: tuple[Reset, ...]
    # Start time (s) and number of each primary instance of EKF2
    primary_instances: tuple[tuple[float, int], ...]
    # Innovation gate (√S) of the position source, for example EKF2_EVP_GATE
    gate: float
    # Sentences about dropped samples and timestamps
    notes: tuple[str, ...] = ()
    # EKF2's estimate of the accelerometer bias (m/s², body FRD)
    accelerometer_bias: TableOrUnavailable = BIAS_NOT_LOGGED
    # Prediction interval (s) of EKF2
    step_s: float = EKF2_STEP_S
    # Delay (s) of the fusion horizon: EKF2 fuses measurements at this age
    horizon_s: float | Unavailable = HORIZON_NOT_LOGGED
    # Data at the fusion horizon for the replay of EKF2
    record: FusionRecord | Unavailable = RECORD_NOT_LOGGED
    # Innovations of each aiding source, by PX4's name
    aids: Mapping[str, AidLog] = field(default_factory=dict)
    # Status flags of EKF2, 1 while set; ``failed_checks`` is the bit mask gps_check_fail_flags
    status_flags: StepFunctions = field(default_factory=dict)
    # All EKF2 parameters at take-off, in PX4 units
    parameters: Mapping[str, float] = field(default_factory=dict)
    parameter_changes: tuple[ParameterChange, ...] = ()

    __repr__ = one_line_repr

    def find_horizontal_resets(self) -> list[Reset]:
        return [
            reset for reset in self.resets if reset.quantity == "position" and any(reset.delta[:2])
        ]


@dataclass(frozen=True)
class Truth:
    """Ground truth from simulation or motion capture.

    Attributes
    ----------
    name : str
        Name of the topic or message.
    samples : DataFrame, shape (n, 6)
        Position and velocity (m, m/s, NED); velocity is NaN if not logged.
    attitude : DataFrame, shape (m, 4), or None
        Quaternion ``w, x, y, z`` that rotates body FRD to NED; None if not logged.
    """

    name: str
    samples: pd.DataFrame
    attitude: pd.DataFrame | None = None

    __repr__ = one_line_repr


# eq=False, because == of DataFrames has no single truth value
@dataclass(frozen=True, eq=False)
class Flight:
    """One recorded flight.

    Attributes
    ----------
    imu : DataFrame or Unavailable
        Specific force (m/s²) and angular rate (rad/s), body FRD, without bias correction.
    attitude : DataFrame or Unavailable
        Quaternion w, x, y, z that rotates body FRD to NED.
    positions : tuple of PositionTrack
        Position sources, in order of preference.
    airborne : tuple of (float, float), or Unavailable
        Intervals (s) in which the land detector reports flight.
    """

    log: LogInfo
    # Column ``clipped``: above 0 if an accelerometer reached the limit of its range
    imu: TableOrUnavailable
    attitude: TableOrUnavailable
    positions: tuple[PositionTrack, ...]
    ekf2: Ekf2 | Unavailable
    truth: Truth | Unavailable
    airborne: Spans | Unavailable
    missing: tuple[Unavailable, ...] = ()
    # Topics of each kind of data, for example of "imu" or "ekf2_state"
    streams: Mapping[str, DataSource] = field(default_factory=dict)
    clocks: tuple[ClockConversion, ...] = ()
    # Position data in the log that px4fuse does not use
    unused: tuple[UnusedData, ...] = ()
    # Files read in addition to the log
    inputs: tuple[InputFile, ...] = ()
    # Intervals (s) in which PX4's failure detector reports excessive roll or pitch
    excessive_tilt_spans_s: Spans = ()
    # Barometer height as ``down_m`` (positive down), with unknown zero level
    barometer: pd.DataFrame | None = None

    __repr__ = one_line_repr


def join_flights(airborne: Spans) -> Spans:
    """Join flights (start and end in s) that are separated by less than MIN_LANDED_DURATION_S."""
    flight_spans_s: list[Span] = []
    for start_s, end_s in airborne:
        if flight_spans_s and start_s - flight_spans_s[-1][1] < MIN_LANDED_DURATION_S:
            flight_spans_s[-1] = (flight_spans_s[-1][0], end_s)
        else:
            flight_spans_s.append((start_s, end_s))
    return tuple(flight_spans_s)


def longest_flight(airborne: Spans) -> Span:
    """Return start and end (s) of the longest flight."""
    return max(join_flights(airborne), key=lambda span: span[1] - span[0])


def time_index(time_s: NDArray[Any]) -> pd.Index[float]:
    """Convert times (s) to a DataFrame index with the name "time_s"."""
    index: pd.Index[float] = pd.Index(time_s, name="time_s")
    return index


def rows_between(samples: pd.DataFrame, start_s: float, end_s: float) -> pd.DataFrame:
    """Return the rows from ``start_s`` to ``end_s`` of a table that is indexed by time (s).

    This needs less memory than ``samples.loc``, which builds a hash table of all times.
    """
    time_s = samples.index.to_numpy()
    first_row = int(np.searchsorted(time_s, start_s))
    return samples.iloc[first_row : int(np.searchsorted(time_s, end_s, side="right"))]


def compute_sample_rate_hz(samples: pd.DataFrame) -> float:
    """Return the sample rate (Hz) without gaps; NaN for fewer than two samples.

    It is the inverse of the mean interval. The median interval would be wrong for downsampled
    topics, whose intervals alternate between two values.
    """
    if len(samples) < 2:
        return np.nan
    intervals_s = samples.index.to_series().diff().dropna()
    regular_intervals_s = intervals_s[intervals_s <= 3.0 * intervals_s.median()]
    if len(regular_intervals_s) < MIN_REGULAR_INTERVAL_FRACTION * len(intervals_s):
        regular_intervals_s = intervals_s
    return float(1.0 / regular_intervals_s.mean())
