"""Frames, gravity, the aisle axis and resampling: Flight → one-dimensional signals.

NED acceleration = R(q) · specific force + [0, 0, g] (Groves 2013, eq. 5.52 without earth rate).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import constants
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array, BoolArray, cumulative_integral
from px4fuse.display import one_line_repr
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight import AXIS_NAMES, Columns, Flight, PositionTrack, Unavailable
from px4fuse.record import missing_data

AISLE = "aisle"
# A track that is so many times longer than wide was flown along an aisle
MIN_AISLE_ELONGATION = 3.0
# An IMU interval is a gap when it is longer than this and than five median intervals.
IMU_GAP_S = 0.1
IMU_GAP_INTERVALS = 5.0
MIN_MEASUREMENTS = 3


@dataclass(frozen=True)
class Segment:
    """The part of the flight that is analysed: start and end (s), and why these."""

    start_s: float
    end_s: float
    reason: str

    def cut(self, spans: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
        """What lies inside of some spans (s)."""
        clipped_spans = ((max(start, self.start_s), min(end, self.end_s)) for start, end in spans)
        return tuple((start, end) for start, end in clipped_spans if end > start)


@dataclass(frozen=True)
class Acceleration:
    """Acceleration along one axis.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    ned_m_s2 : ndarray, shape (n, 3)
        Gravity removed; all axes share it, as long as the flight is.
    direction : ndarray, shape (3,)
        Unit vector in NED.
    integral_m_s : ndarray, shape (n,)
        Along the axis, trapezoidal from the first sample, for averages over steps.
    gap_time_s, gap_integral_s : ndarray, shape (k,)
        Ends of the gaps and of all, and seconds of gap passed since the first sample.
    rms_m_s2 : float
        Root mean square of the signal: how wrong the input may be inside a gap.
    """

    time_s: Array
    ned_m_s2: Array
    direction: Array
    integral_m_s: Array
    gap_time_s: Array
    gap_integral_s: Array
    rms_m_s2: float

    __repr__ = one_line_repr

    @property
    def value_m_s2(self) -> Array:
        """Along the axis, shape (n,)."""
        return np.asarray(self.ned_m_s2 @ self.direction)


@dataclass(frozen=True)
class Axis:
    """The flight along one direction.

    Attributes
    ----------
    name : str
        "north", "east", "down" or "aisle".
    direction : ndarray, shape (3,)
        Unit vector in NED.
    heading_deg : float or None
        Of horizontal axes, clockwise from north.
    note : str
        How the direction was found, where that is a choice; else empty.
    measurement_time_s, measurement_m : ndarray, shape (n,)
        Position measurements along the axis; n ≥ 3.
    acceleration : Acceleration or Unavailable
        The filter's input.
    elongation : float or None
        How many times longer than wide the track is; None where the direction was given.
    """

    name: str
    direction: Array
    heading_deg: float | None
    note: str
    measurement_time_s: Array
    measurement_m: Array
    acceleration: Acceleration | Unavailable
    elongation: float | None = None

    __repr__ = one_line_repr

    @property
    def called(self) -> str:
        """What the axis is in a sentence; an aisle is what was flown as one, or asked for."""
        if self.name != AISLE:
            return self.name
        flown = self.elongation is None or self.elongation >= MIN_AISLE_ELONGATION
        return "the aisle" if flown else "the longest direction"


def ned_acceleration(flight: Flight) -> pd.DataFrame | Unavailable:
    """Acceleration in NED with gravity removed, at the IMU's own times.

    The attitude is interpolated on the sphere (slerp, Shoemake 1985), since default logs hold it
    at a tenth of the IMU's rate. It is made once for a flight, as long as that is there.

    Returns
    -------
    DataFrame, shape (n, 3), m/s², or Unavailable
    """
    if flight not in _ACCELERATION_CACHE:
        _ACCELERATION_CACHE[flight] = _ned_acceleration(flight)
    return _ACCELERATION_CACHE[flight]


_ACCELERATION_CACHE: WeakKeyDictionary[Flight, pd.DataFrame | Unavailable] = WeakKeyDictionary()


def _ned_acceleration(flight: Flight) -> pd.DataFrame | Unavailable:
    if isinstance(flight.imu, Unavailable):
        return flight.imu
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    known = flight.attitude.index.to_numpy()
    imu = flight.imu[(flight.imu.index >= known[0]) & (flight.imu.index <= known[-1])]
    if len(imu) < 2:
        return missing_data("no_overlap")
    quaternions = flight.attitude[Columns.QUATERNION].to_numpy(copy=True)
    rotations = Rotation.from_quat(quaternions, scalar_first=True)
    body_to_ned = Slerp(known, rotations)(imu.index.to_numpy())
    acceleration = body_to_ned.apply(imu[Columns.SPECIFIC_FORCE].to_numpy(copy=True))
    acceleration[:, 2] += constants.g
    return pd.DataFrame(acceleration, index=imu.index, columns=list(AXIS_NAMES))


def aisle_heading(track: PositionTrack, segment: Segment) -> tuple[float, float]:
    """Heading of the horizontal principal direction of the track.

    Returns
    -------
    heading_deg : float
        In [0, 180): an aisle has no front.
    elongation : float
        Ratio of the standard deviations along and across it (1: no direction is distinct).
    """
    horizontal = within(track.samples, segment)[Columns.POSITION[:2]].dropna().to_numpy()
    centred = horizontal - horizontal.mean(axis=0)
    _, singular, directions = np.linalg.svd(centred, full_matrices=False)
    heading = float(np.degrees(np.arctan2(directions[0, 1], directions[0, 0]))) % 180.0
    elongation = float(singular[0] / singular[1]) if singular[1] > 0 else float("inf")
    return heading, elongation


def make_axes(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    *,
    names: tuple[str, ...] | None = None,
    heading_deg: float | None = None,
) -> tuple[Axis, ...]:
    """Project a flight on its axes.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
    segment : Segment
    names : tuple of str, optional
        From "north", "east", "down", "aisle"; by default all that the source supports.
    heading_deg : float, optional
        Of the aisle, clockwise from north; by default the horizontal principal direction.

    Raises
    ------
    MissingDataError
        An axis was asked for that the source has no finite samples for, or none has any.
    SettingsError
        An axis has an unknown name, or the heading is not between 0 and 360.
    """
    acceleration = ned_acceleration(flight)
    known = (*AXIS_NAMES, AISLE)
    axis_names = tuple(dict.fromkeys(known if names is None else names))
    if heading_deg is not None and not 0.0 <= heading_deg <= 360.0:
        raise SettingsError(f"`heading_deg` {heading_deg:g} is not between 0 and 360 degrees.")
    if unknown := [name for name in axis_names if name not in known]:
        raise SettingsError.of("axis_unknown", axis=unknown[0], known=", ".join(known))
    source_label = f"{flight.log.name}: {track.name}"
    axes = []
    for name in axis_names:
        direction, heading, note, elongation = _direction(name, track, segment, heading_deg)
        samples = track.samples
        if name == "down" and track.barometer is not None:
            samples = track.barometer.reindex(columns=Columns.POSITION)
        samples = within(samples, segment)
        projected = along(samples, Columns.POSITION, direction)
        is_finite = np.isfinite(projected)
        if np.count_nonzero(is_finite) < MIN_MEASUREMENTS:
            if names is None:
                continue
            raise MissingDataError(f"{source_label} has no position along {name} in this segment.")
        projected_acceleration = project_acceleration(acceleration, direction, segment)
        measurements = samples.index.to_numpy()[is_finite], projected[is_finite]
        axes.append(
            Axis(name, direction, heading, note, *measurements, projected_acceleration, elongation)
        )
    if not axes:
        raise MissingDataError(f"{source_label} has no finite position in this segment.")
    return tuple(axes)


def too_few_measurements(what: str, count: int, least: int) -> Unavailable:
    """What stands in for an estimate from so few measurements."""
    return missing_data("measurements_few", what=what, count=count, least=least)


def along(frame: pd.DataFrame, columns: list[str], weights: Array) -> Array:
    """Weighted sum of columns; a column of weight zero may be NaN."""
    total = np.zeros(len(frame))
    for column, weight in zip(columns, weights, strict=True):
        if weight != 0.0:
            total += weight * frame[column].to_numpy()
    return total


def _direction(
    name: str, track: PositionTrack, segment: Segment, heading_deg: float | None
) -> tuple[Array, float | None, str, float | None]:
    elongation = None
    if name != AISLE:
        axis_index = AXIS_NAMES.index(name)
        return np.eye(3)[axis_index], (None if name == "down" else 90.0 * axis_index), "", None
    if heading_deg is None:
        heading, elongation = aisle_heading(track, segment)
        note = f"horizontal principal direction, {elongation:.1f} times longer than wide"
    else:
        heading, note = heading_deg, "given with --heading"
    angle = np.radians(heading)
    return np.array([np.cos(angle), np.sin(angle), 0.0]), heading, note, elongation


def project_acceleration(
    acceleration: pd.DataFrame | Unavailable, direction: Array, segment: Segment
) -> Acceleration | Unavailable:
    """Acceleration along a direction, with what step averages need.

    Parameters
    ----------
    acceleration : DataFrame, shape (n, 3), m/s², NED, or Unavailable
    direction : ndarray, shape (3,)
    segment : Segment
        Only for the root mean square.
    """
    if isinstance(acceleration, Unavailable):
        return acceleration
    time = acceleration.index.to_numpy()
    ned = acceleration.to_numpy()
    value = ned @ direction
    inside = (time >= segment.start_s) & (time <= segment.end_s)
    if np.count_nonzero(inside) < 2:
        return missing_data("imu_outside_segment")
    is_gap = imu_gaps(time)
    gap, passed_s = np.flatnonzero(is_gap), np.cumsum(np.where(is_gap, np.diff(time), 0.0))
    ends = np.unique([0, *gap, *(gap + 1), len(time) - 1])
    return Acceleration(
        time_s=time,
        ned_m_s2=ned,
        direction=direction,
        integral_m_s=cumulative_integral(value, time),
        gap_time_s=time[ends],
        gap_integral_s=np.append(0.0, passed_s)[ends],
        rms_m_s2=float(np.sqrt(np.mean(value[inside] ** 2))),
    )


def imu_gaps(time_s: Array) -> BoolArray:
    """Whether each interval between IMU samples is a gap, shape (n - 1,)."""
    interval = np.diff(time_s)
    return interval > max(IMU_GAP_S, IMU_GAP_INTERVALS * float(np.median(interval)))


def step_means(acceleration: Acceleration, edges: ArrayLike) -> tuple[Array, Array]:
    """Mean acceleration over each step, and the fraction of it that lies in an IMU gap.

    Parameters
    ----------
    acceleration : Acceleration
    edges : array_like, shape (n + 1,)
        Strictly increasing times in s.

    Returns
    -------
    mean_m_s2 : ndarray, shape (n,)
    gap_fraction : ndarray, shape (n,)
        1 also where the step lies outside the IMU's span, where the mean is 0.
    """
    edges = np.asarray(edges, dtype=np.float64)
    length = np.diff(edges)
    velocity = np.interp(edges, acceleration.time_s, acceleration.integral_m_s)
    gap = np.interp(edges, acceleration.gap_time_s, acceleration.gap_integral_s)
    covered = np.clip(edges, acceleration.time_s[0], acceleration.time_s[-1])
    outside = 1.0 - np.diff(covered) / length
    return np.diff(velocity) / length, np.clip(np.diff(gap) / length + outside, 0.0, 1.0)


def within(frame: pd.DataFrame, segment: Segment) -> pd.DataFrame:
    """Rows of a time-indexed frame inside a segment, both ends included."""
    return frame[(frame.index >= segment.start_s) & (frame.index <= segment.end_s)]
