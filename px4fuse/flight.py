"""The data model: what every reader makes and everything else takes.

Times are float seconds on the autopilot's boot clock, counted from the first sample of data (whose
own boot time is ``boot_time_s`` of the log), and they are times of *measurement*, not of
publication. Vectors are NED (north, east, down) in m, m/s and m/s², or body FRD (forward, right,
down) where said. Time series are pandas frames whose index is time in seconds, named ``time_s``;
every column's unit stands in its name or in the field's description.

What was looked for and not found is an :class:`Unavailable`; it travels to the report and is never
replaced by zero, an empty plot or a "pass".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray
from px4fuse.display import one_line_repr
from px4fuse.ekf2_parameters import BAROMETER, Aid
from px4fuse.origin import Origin
from px4fuse.record import NotNegative, Record, Vector, missing_data
from px4fuse.record import Unavailable as Unavailable  # noqa: PLC0414 - for everybody
from px4fuse.recording import ClockMap, InputFile, LogInfo, Stream, Unused

AxisName = Literal["north", "east", "down"]
# Below this share of intervals near the median, samples come in bursts
BURST_SHARE = 0.8
# Methods of a ClockMap that know no time of measurement
ARRIVAL_METHODS = ("arrival time", "receive time", "position in the stream")
AXIS_NAMES: tuple[AxisName, AxisName, AxisName] = ("north", "east", "down")


class Columns:
    """Names of columns of all tables of a flight, with their units."""

    POSITION: Final = ["north_m", "east_m", "down_m"]
    VELOCITY: Final = ["north_m_s", "east_m_s", "down_m_s"]
    STATE: Final = POSITION + VELOCITY
    POSITION_VARIANCE: Final = ["north_m2", "east_m2", "down_m2"]
    VELOCITY_VARIANCE: Final = ["north_m2_s2", "east_m2_s2", "down_m2_s2"]
    SPECIFIC_FORCE: Final = ["forward_m_s2", "right_m_s2", "down_m_s2"]
    ANGULAR_RATE: Final = ["forward_rad_s", "right_rad_s", "down_rad_s"]
    QUATERNION: Final = ["w", "x", "y", "z"]
    ROTATION_VARIANCE: Final = ["forward_rad2", "right_rad2", "down_rad2"]
    # What EKF2's filter holds at its fusion horizon, whatever the PX4 release logs it as
    GYRO_BIAS: Final = [f"gyro_bias_{axis}_rad_s" for axis in ("forward", "right", "down")]
    ACCELEROMETER_BIAS: Final = [
        f"accelerometer_bias_{axis}_m_s2" for axis in ("forward", "right", "down")
    ]
    EARTH_FIELD: Final = [f"earth_field_{axis}_gauss" for axis in AXIS_NAMES]
    BODY_FIELD: Final = [f"body_field_{axis}_gauss" for axis in ("forward", "right", "down")]
    FIELD_INNOVATION: Final = [f"innovation_{axis}_gauss" for axis in ("forward", "right", "down")]
    DELAYED_STATE: Final = [
        *QUATERNION,
        *VELOCITY,
        *POSITION,
        *GYRO_BIAS,
        *ACCELEROMETER_BIAS,
        *EARTH_FIELD,
        *BODY_FIELD,
    ]
    DELAYED_VARIANCE: Final = [
        *(f"attitude_{axis}_rad2" for axis in AXIS_NAMES),
        *VELOCITY_VARIANCE,
        *POSITION_VARIANCE,
        *(f"{name.removesuffix('_rad_s')}_rad2_s2" for name in GYRO_BIAS),
        *(f"{name.removesuffix('_m_s2')}_m2_s4" for name in ACCELEROMETER_BIAS),
        *(f"{name}2" for name in (*EARTH_FIELD, *BODY_FIELD)),
    ]


@dataclass(frozen=True)
class FlightMode:
    """A stretch (s) in one flight mode, by the name that PX4's users know."""

    start_s: float
    end_s: float
    name: str


class Alignment(Record, frozen=True, kw_only=True):
    """How an external position file was placed into the flight.

    A position p of the file becomes origin + Rz(yaw) · C · p, where C turns its frame into NED.

    Attributes
    ----------
    frame, frame_reason : str
        "ned", "enu" or "nwu", and why.
    yaw_deg : float
        Rotation about down, clockwise seen from above, applied after the frame.
    yaw_sigma_deg : float or None
        Its standard deviation where it was estimated.
    yaw_reason : str
    origin_m : tuple of float
        Added after the rotation, NED.
    clock_offset_s : float
        Added to the file's time stamps to give the autopilot's boot clock.
    clock_offset_sigma_s : float or None
        Its standard deviation where it was estimated.
    clock_reason : str
    reference : str
        What it was matched with: "EKF2 position", "IMU", or "" where nothing was.
    correlation : float or None
        Of the file's track with the reference after alignment (1 is perfect).
    residual_rms_m : float or None
        Horizontal, root mean square per axis; None where the reference has no position.
    misplaced : tuple of str
        Where its frame is another one, each a sentence.
    warnings : tuple of str
        What is poorly determined, each a sentence.
    """

    frame: str
    frame_reason: str
    yaw_deg: float
    yaw_sigma_deg: NotNegative | None = None
    yaw_reason: str
    origin_m: Vector
    clock_offset_s: float
    clock_offset_sigma_s: NotNegative | None = None
    clock_reason: str
    reference: str
    correlation: float | None = None
    residual_rms_m: NotNegative | None = None
    misplaced: tuple[str, ...] = ()
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PositionTrack:
    """One external position track found in the log.

    Attributes
    ----------
    name : str
        The name that ``--position-source`` takes; the PX4 topic where there is one.
    origin : Origin
        Where it comes from and how it got here, with all that follows from it.
    description : str
        What it is, for a person.
    samples : DataFrame, shape (n, 6)
        ``north_m, east_m, down_m`` and their reported variances ``north_m2, east_m2, down_m2``
        (NaN where the sender gave none or the topic has none). NaN positions were dropped.
    frame : str
        "NED", "FRD" (x is forward at start, not north) or "unknown".
    clock : str
        Which clock the time stamps are on.
    topics : tuple of str
        The topics or messages that it was read from.
    log : str
        Name of the file that it was read from.
    clock_map : ClockMap or None
        How the sender's clock was mapped to the autopilot's, where that was done here.
    alignment : Alignment or None
        Of a track from a file of its own.
    orientation : DataFrame, shape (m, 7), or None
        Quaternion ``w, x, y, z`` that turns body FRD into ``frame``, and its reported variances
        about the body's axes ``forward_rad2, right_rad2, down_rad2`` (NaN where none was given).
        None where the sender gave no orientation, or only ever the same one: a positioning
        system, no odometry.
    velocity : DataFrame, shape (n, 6), or None
        ``north_m_s, east_m_s, down_m_s`` and their variances ``north_m2_s2, …`` at the times of
        ``samples``, where the source measures it by itself: GNSS.
    age_s : float
        What EKF2 takes a sample to be older than its stamp, as far as that was taken off already.
    barometer : DataFrame or None
        ``down_m`` by the barometer, at times of its own, where that is what "down" is to be.
    lever_arm_m : tuple of float
        Where EKF2 takes the sensor to be in the body (forward, right, down); the positions are the
        sensor's.
    notes : tuple of str
        Joins and what they dropped.
    """

    name: str
    origin: Origin
    description: str
    samples: pd.DataFrame
    frame: str
    clock: str
    topics: tuple[str, ...]
    log: str = ""
    clock_map: ClockMap | None = None
    alignment: Alignment | None = None
    orientation: pd.DataFrame | None = None
    velocity: pd.DataFrame | None = None
    age_s: float = 0.0
    barometer: pd.DataFrame | None = None
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()

    __repr__ = one_line_repr

    def aid(self, axis: str) -> Aid | None:
        """What EKF2 takes it as along an axis; None where EKF2 never fuses it."""
        return self.origin.aid if axis != "down" or self.barometer is None else BAROMETER

    def description_fields(self) -> dict[str, Any]:
        """What is written of it, and of where it comes from, by the names in results."""
        names = (
            "name",
            "kind",
            "passage",
            "description",
            "frame",
            "clock",
            "reconstructed",
            "topics",
            "log",
            "alignment",
        )
        owners = {name: self.origin if hasattr(self.origin, name) else self for name in names}
        return {name: getattr(owners[name], name) for name in names}

    @property
    def rate_hz(self) -> float:
        """Samples per second between gaps (NaN with fewer than two samples)."""
        return sample_rate(self.samples)


@dataclass(frozen=True)
class Reset:
    """One reset of EKF2's output: the new state is the old one plus ``delta``.

    Attributes
    ----------
    time_s : float
        Time of the first sample after it.
    quantity : str
        "position" or "velocity".
    delta : tuple of float
        North, east, down in m or m/s; 0 for axes that were not reset.
    """

    time_s: float
    quantity: Literal["position", "velocity"]
    delta: tuple[float, float, float]


# EKF2_PREDICT_US, ekf2_params.c
EKF2_STEP_S = 0.010
BIAS_NOT_LOGGED = missing_data("bias_not_logged")
HORIZON_NOT_LOGGED = missing_data("horizon_not_logged")


RECORD_NOT_LOGGED = missing_data("record_not_logged")


GROUND_EFFECT, BAD_ACCELERATION = "gnd_effect", "bad_acc_vertical"
# Of a sample of optical flow in EKF2's low pass of them (_flow_vel_body_lpf, ekf.h)
FLOW_SHARE = 0.1


@dataclass(frozen=True)
class FusionRecord:
    """What the log tells of the inside of EKF2's filter: where a replay of it starts from.

    Attributes
    ----------
    parameters : mapping
        Every EKF2_ parameter in the log, by PX4 name, in PX4's units, as at the log's start.
    delayed : DataFrame, shape (n, 43)
        State and variances at the fusion horizon. ``w, x, y, z`` turns body FRD into NED; velocity
        and position NED (horizontal position NaN where PX4 keeps it as latitude and longitude);
        biases of gyro (rad/s) and accelerometer (m/s²), body FRD; magnetic field of the earth
        (NED) and of the body (FRD), in gauss; then the variances of attitude error about north,
        east and down, of velocity, position, the biases and both fields.
    per_step_biases : bool
        Whether this release keeps the biases as increments per prediction (up to v1.14).
    other_aiding : tuple of str
        Horizontal aiding besides vision position that EKF2 used at any time.
    vision_age_s : Series
        How long after its measurement stamp each external vision sample was published (s), by that
        stamp; empty where not logged.
    field_gauss : DataFrame, shape (m, 4) or (m, 7)
        Magnetic field that was measured, body FRD, by time of measurement, and ``fused_3d``: 1
        where EKF2 fused all of it, 0 where only its heading; empty where not logged. From v1.16 on
        also EKF2's low pass of all its innovations (expected minus measured).
    flow : DataFrame, shape (l, 5)
        Velocity of the body by optical flow, ``forward_m_s`` and ``right_m_s`` (FRD), by the time
        that EKF2 takes the last of ``samples`` to be of, which are ``interval_s`` apart and count
        for less the older they are (:data:`FLOW_SHARE`); ``noise_m2_s2`` is R of each. Empty where
        the log does not hold it.
    latitude_deg : float
        Of the origin; NaN where the log has none.
    altitude_m : float
        Of the origin, where EKF2 keeps its height as altitude above the sea (from v1.16); else 0.
    height_bias : mapping from PX4's name of an aid to DataFrame, shape (k, 2)
        By how much its height is above the reference's: ``bias_m`` and its variance ``bias_m2``.
    states : mapping from :data:`GROUND_EFFECT` and :data:`BAD_ACCELERATION` to Series
        1 while EKF2 takes the rotors' wash to disturb the barometer, and the vertical acceleration
        to be wrong; 0 while not, step functions. Without those that the log does not tell.
    """

    parameters: Mapping[str, float]
    delayed: pd.DataFrame
    per_step_biases: bool
    other_aiding: tuple[str, ...]
    vision_age_s: pd.Series
    field_gauss: pd.DataFrame = field(default_factory=pd.DataFrame)
    flow: pd.DataFrame = field(default_factory=pd.DataFrame)
    latitude_deg: float = np.nan
    altitude_m: float = 0.0
    height_bias: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    states: Mapping[str, pd.Series[float]] = field(default_factory=dict)

    __repr__ = one_line_repr

    @property
    def keeps_latitude(self) -> bool:
        """Whether EKF2 keeps its position as latitude and longitude (from v1.16)."""
        return not np.isfinite(self.delayed["north_m"]).any()

    def was_in_state(self, state: str, times_s: Array) -> BoolArray:
        """Whether EKF2 was in one of :attr:`states` then; not where the log does not tell."""
        known = self.states.get(state)
        return (
            np.zeros(len(times_s), bool) if known is None else step_values_at(known, times_s) > 0.0
        )


@dataclass(frozen=True)
class AidLog:
    """What a log has of one aid of EKF2.

    Attributes
    ----------
    topics : tuple of str
        Where its innovations, and their variances, are from.
    axes : tuple of str
    samples : DataFrame
        By time of measurement, for each axis: ``innovation_<axis>`` (measurement minus prediction)
        and ``variance_<axis>`` (S); where the aid has a topic of its own also ``noise_<axis>``
        (R), ``ratio_<axis>`` (ν²/(gate²·S)), ``fused`` and ``rejected`` (1 or 0), of external
        vision's position ``observation_<axis>`` as well. In the aid's unit, variances in its
        square.
    enabled : Series or None
        1 while EKF2 means to fuse it, 0 while it does not, a step function; None where the log
        does not tell.
    parameters : mapping
        EKF2's for this aid, by PX4 name, as at the log's start.
    excluded_count : int
        Innovations without a variance near in time, which are not among the samples.
    """

    topics: tuple[str, ...]
    axes: tuple[str, ...]
    samples: pd.DataFrame
    enabled: pd.Series[float] | None
    parameters: Mapping[str, float] = field(default_factory=dict)
    excluded_count: int = 0

    __repr__ = one_line_repr


def step_values_at(steps: pd.Series[float], times: pd.Index[float] | Array) -> Array:
    """Values of a step function at some times; before its first step that of the first."""
    at = np.clip(np.searchsorted(steps.index, times, side="right") - 1, 0, None)
    return np.asarray(steps, dtype=np.float64)[at]


@dataclass(frozen=True)
class Ekf2:
    """EKF2's output, variances and innovations, of the instance that was primary at each time.

    Attributes
    ----------
    state : DataFrame, shape (n, 6)
        Position and velocity (m, m/s, NED) exactly as published, resets included.
    variance : DataFrame, shape (n, 6), or Unavailable
        Position and velocity variances (m², m²/s²).
    innovations : mapping from axis name to DataFrame, or to Unavailable
        Per axis: ``innovation_m`` (measurement minus prediction: PX4's own sign is flipped, here
        and only here), ``innovation_variance_m2``, ``observation_variance_m2`` (NaN where not
        logged), ``test_ratio``, ``fused``, ``rejected`` (1, 0, or NaN where not logged).
    innovation_topics : tuple of str
    fusing : DataFrame or Unavailable
        Columns ``horizontal``, ``vertical``, ``yaw``: 1 while EKF2 reports that it fuses external
        vision for them, a step function.
    resets : tuple of Reset
    instances : tuple of (float, int)
        Primary instance from each time on.
    gate : float
        EKF2_EVP_GATE in standard deviations.
    notes : tuple of str
        Joins and what they dropped, time bases, and the like.
    accelerometer_bias : DataFrame, shape (n, 3), or Unavailable
        Estimated bias (m/s², body FRD) that EKF2 subtracts from the specific force.
    step_s : float
        Time between two of its predictions.
    horizon_s : float or Unavailable
        How far its fusion runs behind its output: the state at t knows measurements up to
        t - horizon, carried to t by the IMU.
    record : FusionRecord or Unavailable
        The inside of the filter, as far as it is logged.
    aids : mapping from PX4's name to AidLog
        What the log has of everything that EKF2 can fuse.
    """

    state: pd.DataFrame
    variance: pd.DataFrame | Unavailable
    innovations: Mapping[AxisName, pd.DataFrame | Unavailable]
    innovation_topics: tuple[str, ...]
    fusing: pd.DataFrame | Unavailable
    resets: tuple[Reset, ...]
    instances: tuple[tuple[float, int], ...]
    gate: float
    notes: tuple[str, ...] = ()
    accelerometer_bias: pd.DataFrame | Unavailable = BIAS_NOT_LOGGED
    step_s: float = EKF2_STEP_S
    horizon_s: float | Unavailable = HORIZON_NOT_LOGGED
    record: FusionRecord | Unavailable = RECORD_NOT_LOGGED
    aids: Mapping[str, AidLog] = field(default_factory=dict)

    __repr__ = one_line_repr


@dataclass(frozen=True)
class Truth:
    """A reference that no estimator used: simulation ground truth or motion capture.

    Attributes
    ----------
    name : str
        The topic.
    samples : DataFrame, shape (n, 6)
        Position and velocity (m, m/s, NED); velocity is NaN where not logged.
    attitude : DataFrame, shape (m, 4), or None
        Quaternion ``w, x, y, z`` that turns body FRD into NED; None where not logged.
    """

    name: str
    samples: pd.DataFrame
    attitude: pd.DataFrame | None = None

    __repr__ = one_line_repr


MODES_NOT_LOGGED = missing_data("modes_not_logged")


# equal to itself only: what is made of it is kept by it
@dataclass(frozen=True, eq=False)
class Flight:
    """One recorded flight.

    Attributes
    ----------
    log : LogInfo
    imu : DataFrame or Unavailable
        Specific force (m/s², body FRD, not bias corrected) and angular rate (rad/s, body FRD), and
        ``clipped``, above 0 where an accelerometer was at the end of its range, where logged.
    attitude : DataFrame or Unavailable
        Quaternion w, x, y, z that turns body FRD into NED.
    positions : tuple of PositionTrack
        Every external position track found, in order of preference.
    ekf2 : Ekf2 or Unavailable
    truth : Truth or Unavailable
    airborne : tuple of (float, float), or Unavailable
        Stretches (s) in which the land detector says that the vehicle flies; empty if never.
    missing : tuple of Unavailable
        What was looked for and not found, with the remedy.
    streams : mapping from part to Stream
        Where each part was read from: "imu", "attitude", "ekf2_state", "ekf2_variance",
        "ekf2_innovations", "ekf2_fusing", "truth", "airborne", as far as there is one.
    clocks : tuple of ClockMap
        Clocks other than the autopilot's that were mapped to it.
    unused : tuple of Unused
        What the log holds besides, and why it is not used.
    inputs : tuple of InputFile
        Files read beside the log.
    modes : tuple of FlightMode, or Unavailable
        In order of time, without overlap.
    tumble_spans : tuple of (float, float)
        Stretches (s) in which PX4's failure detector found roll or pitch beyond their limits.
    barometer : DataFrame or None
        ``down_m`` by the pressure, from a height that is not known.
    """

    log: LogInfo
    imu: pd.DataFrame | Unavailable
    attitude: pd.DataFrame | Unavailable
    positions: tuple[PositionTrack, ...]
    ekf2: Ekf2 | Unavailable
    truth: Truth | Unavailable
    airborne: tuple[tuple[float, float], ...] | Unavailable
    missing: tuple[Unavailable, ...] = ()
    streams: Mapping[str, Stream] = field(default_factory=dict)
    clocks: tuple[ClockMap, ...] = ()
    unused: tuple[Unused, ...] = ()
    inputs: tuple[InputFile, ...] = ()
    modes: tuple[FlightMode, ...] | Unavailable = MODES_NOT_LOGGED
    tumble_spans: tuple[tuple[float, float], ...] = ()
    barometer: pd.DataFrame | None = None

    __repr__ = one_line_repr


def sort_by_preference(tracks: Iterable[PositionTrack]) -> tuple[PositionTrack, ...]:
    """Position tracks in the order in which a comparison prefers them."""
    return tuple(sorted(tracks, key=lambda track: track.origin.preference))


def sample_rate(samples: pd.DataFrame) -> float:
    """Rate of a time-indexed frame in Hz, gaps left out; NaN below two samples.

    From the mean of all intervals up to three times the median one: a thinned topic alternates
    between two intervals, of which the median knows only one. Samples that come in bursts have no
    regular interval, so that all of them count.
    """
    if len(samples) < 2:
        return float("nan")
    intervals = samples.index.to_series().diff().dropna()
    regular = intervals[intervals <= 3.0 * intervals.median()]
    if len(regular) < BURST_SHARE * len(intervals):
        regular = intervals
    return float(1.0 / regular.mean())
