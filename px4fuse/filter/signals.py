"""Positions and acceleration of a flight along the axes north, east, down and aisle.

The aisle is the horizontal axis of largest motion. The acceleration in NED is R(q) · specific
force + [0, 0, g] (Groves 2013, eq. 5.52 without earth rate).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.core.arrays import (
    Array,
    ArrayPair,
    BoolArray,
    compute_median_interval_s,
    integrate_cumulatively,
    iterate_row_blocks,
    select_intervals,
)
from px4fuse.core.record import Span, one_line_repr
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight.model import (
    AXIS_NAMES,
    Columns,
    Flight,
    PositionTrack,
    Unavailable,
    rows_between,
)
from px4fuse.trajectory.rotation import interpolate, rotate, to_rotation_matrix

# Name of the axis along the main horizontal direction of the flight
AISLE_AXIS = "aisle"
# Note of the axis along the main direction if the user gives its heading
HEADING_NOTE = "heading chosen with --heading"
# Minimum length (s) of an IMU gap
MIN_IMU_GAP_S = 0.1
# Minimum length of an IMU gap, as multiple of the median sample interval
MIN_IMU_GAP_INTERVALS = 5.0
# Positions at a higher rate (Hz) are downsampled, because their errors are time-correlated
MAX_INDEPENDENT_ERROR_RATE_HZ = 25.0
# Minimum number of position measurements to run KF along an axis
MIN_MEASUREMENTS = 3


@dataclass(frozen=True)
class Segment:
    """Analysed time span (s) of a flight, and the reason why it was chosen.

    ``flight_span_s`` is the time span of the whole flight; None if all of it is analysed.
    """

    start_s: float
    end_s: float
    reason: str
    flight_span_s: Span | None = None

    @property
    def whole_flight(self) -> Segment:
        """Time span of the whole flight."""
        return Segment(*(self.flight_span_s or (self.start_s, self.end_s)), self.reason)

    def clip_spans(self, spans_s: Iterable[Span]) -> tuple[Span, ...]:
        """Cut time spans (s) to the analysed segment, and drop those outside."""
        clipped_spans = ((max(start, self.start_s), min(end, self.end_s)) for start, end in spans_s)
        return tuple((start, end) for start, end in clipped_spans if end > start)


@dataclass(frozen=True)
class Acceleration:
    """Acceleration in NED without gravity; its component along an axis is the input of KF.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    acceleration_integral_m_s : ndarray, shape (3, n)
        Velocity change since the first IMU sample.
    acceleration_second_moments_m2_s4 : ndarray, shape (3, 3)
        Mean products of the acceleration components in the segment.
    gap_edge_time_s : ndarray, shape (k,)
        Start and end of each IMU gap.
    cumulative_gap_s : ndarray, shape (k,)
        Total length of the IMU gaps before each time in ``gap_edge_time_s``.
    """

    time_s: Array
    acceleration_integral_m_s: Array
    acceleration_second_moments_m2_s4: Array
    gap_edge_time_s: Array
    cumulative_gap_s: Array

    __repr__ = one_line_repr

    def compute_velocity_change_m_s(self, direction: Array) -> Array:
        """Return the velocity change (m/s) along a unit vector since the first sample."""
        return direction @ self.acceleration_integral_m_s

    def compute_rms_m_s2(self, direction: Array) -> float:
        """Return the RMS acceleration (m/s²) along a unit vector in the segment."""
        return float(np.sqrt(direction @ self.acceleration_second_moments_m2_s4 @ direction))


@dataclass(frozen=True)
class Axis:
    """Positions and acceleration of a flight along one direction.

    Attributes
    ----------
    name : {"north", "east", "down", "aisle"}
        "aisle" is the horizontal axis of largest motion, or that of the user's heading.
    direction : ndarray, shape (3,)
        Unit vector in NED.
    heading_deg : float or None
        Heading of a horizontal axis, clockwise from north.
    note : str
        Explanation for the user how the heading of the axis "aisle" was determined.
    acceleration : Acceleration or Unavailable
        Input of KF.
    """

    name: str
    direction: Array
    heading_deg: float | None
    note: str
    measurement_time_s: Array
    measurement_m: Array
    acceleration: Acceleration | Unavailable

    __repr__ = one_line_repr

    @property
    def label(self) -> str:
        """Name of the axis in messages, for example "north" or "the axis of largest motion"."""
        if self.name != AISLE_AXIS:
            return self.name
        return f"the axis of {'--heading' if self.note == HEADING_NOTE else 'largest motion'}"


def imu_and_attitude(flight: Flight) -> tuple[pd.DataFrame, pd.DataFrame] | Unavailable:
    """Return the IMU samples during the time span of the attitude, and the attitude."""
    imu, attitude = flight.imu, flight.attitude
    if isinstance(imu, Unavailable):
        return imu
    if isinstance(attitude, Unavailable):
        return attitude
    imu = rows_between(imu, attitude.index[0], attitude.index[-1])
    if len(imu) < 2:
        return Unavailable(
            "acceleration in NED from IMU and attitude",
            "IMU and attitude data do not overlap in time",
            "Set SDLOG_MODE to 1 to log from boot.",
        )
    return imu, attitude


def interpolate_attitude(attitude: pd.DataFrame, time_s: Array) -> Array:
    """Return the attitude quaternions (w, x, y, z) at other times (s)."""
    quaternions = attitude[Columns.QUATERNION].to_numpy()
    return interpolate(time_s, attitude.index.to_numpy(), quaternions)


def compute_ned_acceleration(flight: Flight) -> pd.DataFrame | Unavailable:
    """Return the acceleration in NED without gravity (m/s²) for each IMU sample.

    The attitude is interpolated, because PX4 logs it at a lower rate.
    """
    if isinstance(imu_with_attitude := imu_and_attitude(flight), Unavailable):
        return imu_with_attitude
    imu, attitude = imu_with_attitude
    attitude_of_samples = interpolate_attitude(attitude, imu.index.to_numpy())
    specific_force_m_s2 = imu[Columns.SPECIFIC_FORCE].to_numpy()
    acceleration = np.empty(specific_force_m_s2.shape)
    for rows in iterate_row_blocks(len(imu)):
        acceleration[rows] = rotate(
            to_rotation_matrix(attitude_of_samples[rows]), specific_force_m_s2[rows]
        )
    acceleration[:, 2] += constants.g
    return pd.DataFrame(acceleration, imu.index, list(AXIS_NAMES), copy=False)


def estimate_main_heading(track: PositionTrack, segment: Segment) -> tuple[float, float]:
    """Return the main horizontal direction of the positions.

    Returns
    -------
    heading_deg : float
        Heading of this direction, 0 to 180.
    length_to_width_ratio : float
        Standard deviation along this direction, divided by that across it.
    """
    position_m = cut_to_segment(track.samples, segment)[Columns.POSITION[:2]].dropna().to_numpy()
    centred_m = position_m - position_m.mean(axis=0)
    _, singular_values, directions = np.linalg.svd(centred_m, full_matrices=False)
    heading_deg = float(np.degrees(np.arctan2(directions[0, 1], directions[0, 0]))) % 180.0
    length_to_width_ratio = (
        float(singular_values[0] / singular_values[1]) if singular_values[1] > 0 else float("inf")
    )
    return heading_deg, length_to_width_ratio


def make_axes(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    *,
    names: tuple[str, ...] | None = None,
    heading_deg: float | None = None,
) -> tuple[Axis, ...]:
    """Project positions and acceleration of a flight onto north, east, down and aisle.

    The aisle is the main horizontal direction of the flight. The positions of the down axis are
    from the barometer, if the track has one.

    Parameters
    ----------
    names : tuple of str, optional
        Names of the axes; by default all that have positions.
    heading_deg : float, optional
        Heading of the aisle, clockwise from north; default: main direction of the positions.

    Raises
    ------
    MissingDataError
        The source has no positions along a requested axis, or along any axis.
    SettingsError
        An axis has an unknown name, or the heading is not between 0 and 360.
    """
    acceleration = integrate_ned_acceleration(compute_ned_acceleration(flight), segment)
    valid_names = (*AXIS_NAMES, AISLE_AXIS)
    axis_names = tuple(dict.fromkeys(valid_names if names is None else names))
    if heading_deg is not None and not 0.0 <= heading_deg <= 360.0:
        raise SettingsError(f"`heading_deg` {heading_deg:g} is not between 0 and 360 degrees.")
    if unknown_names := [name for name in axis_names if name not in valid_names]:
        raise SettingsError(
            f"The axis {unknown_names[0]} is unknown.",
            f"Choose from the axes {', '.join(valid_names)}.",
        )
    source_label = f"{flight.log.name}: {track.name}"
    axes = []
    for name in axis_names:
        direction, heading, note = _choose_axis_direction(name, track, segment, heading_deg)
        track_samples = track.samples
        if name == "down" and track.barometer is not None:
            track_samples = track.barometer.reindex(columns=Columns.POSITION)
        track_samples = cut_to_segment(track_samples, segment)
        projected_position_m = weighted_sum(track_samples, Columns.POSITION, direction)
        is_finite = np.isfinite(projected_position_m)
        if np.count_nonzero(is_finite) < MIN_MEASUREMENTS:
            if names is None:
                continue
            raise MissingDataError(
                f"{source_label} has no position along the axis {name} in the analysed segment."
            )
        axes.append(
            Axis(
                name,
                direction,
                heading,
                note,
                track_samples.index.to_numpy()[is_finite],
                projected_position_m[is_finite],
                acceleration,
            )
        )
    if not axes:
        raise MissingDataError(f"{source_label} has no finite position in the analysed segment.")
    return tuple(axes)


def make_horizontal_axis(north_and_east: Sequence[Axis], heading_deg: float) -> Axis:
    """Combine the axes north and east to a horizontal axis with another heading."""
    north, east = north_and_east
    angle_rad = np.radians(heading_deg)
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return replace(
        north,
        name=f"{heading_deg % 180.0:.0f}° from north",
        direction=cosine * north.direction + sine * east.direction,
        heading_deg=heading_deg,
        measurement_m=cosine * north.measurement_m + sine * east.measurement_m,
    )


def make_downsampling_slice(time_s: Array) -> slice:
    """Return a slice that keeps every k-th position if the rate is high.

    The rate is then 1 to 2 times ``MAX_INDEPENDENT_ERROR_RATE_HZ``.
    """
    interval_s = compute_median_interval_s(time_s) if len(time_s) > 1 else np.inf
    return slice(None, None, max(1, int(1.0 / (interval_s * MAX_INDEPENDENT_ERROR_RATE_HZ))))


def report_too_few_measurements(
    analysis_name: str, measurement_count: int, min_count: int
) -> Unavailable:
    """Return the reason why an analysis has no result: it has too few measurements."""
    return Unavailable(
        analysis_name,
        f"only {measurement_count} measurements (at least {min_count} are needed)",
        "Analyse a longer segment, or log the source at a higher rate.",
    )


def weighted_sum(samples: pd.DataFrame, columns: list[str], weights: Array) -> Array:
    """Return the weighted sum of table columns. A column with weight zero may contain NaN."""
    weighted_total = np.zeros(len(samples))
    for column, weight in zip(columns, weights, strict=True):
        if weight != 0.0:
            weighted_total += weight * samples[column].to_numpy()
    return weighted_total


def _choose_axis_direction(
    name: str, track: PositionTrack, segment: Segment, heading_deg: float | None
) -> tuple[Array, float | None, str]:
    """Return direction (unit vector in NED), heading (°; None for down) and note of an axis."""
    if name != AISLE_AXIS:
        axis_index = AXIS_NAMES.index(name)
        return np.eye(3)[axis_index], (None if name == "down" else 90.0 * axis_index), ""
    note = HEADING_NOTE
    if heading_deg is None:
        heading_deg, elongation = estimate_main_heading(track, segment)
        note = f"main direction of the track (ratio of length to width: {elongation:.1f})"
    angle_rad = np.radians(heading_deg)
    return np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0]), heading_deg, note


def integrate_ned_acceleration(
    acceleration: pd.DataFrame | Unavailable, segment: Segment
) -> Acceleration | Unavailable:
    """Return the acceleration (m/s², NED) of the whole flight, with its integral over time."""
    if isinstance(acceleration, Unavailable):
        return acceleration
    time_s = acceleration.index.to_numpy()
    segment_acceleration_m_s2 = cut_to_segment(acceleration, segment).to_numpy()
    if len(segment_acceleration_m_s2) < 2:
        return Unavailable(
            "IMU",
            "the analysed segment contains no IMU samples",
            "Use --start and --end to choose a segment with IMU samples.",
        )
    is_gap = find_imu_gaps(time_s)
    gap_rows = np.flatnonzero(is_gap)
    # KF needs the time without IMU data in each step: the increase of the cumulative gap time from
    # start to end of the step. This time is linear between gap edges, so only its values at the
    # edges (and at the first and last sample) are stored
    cumulative_gap_s = np.cumsum(np.where(is_gap, np.diff(time_s), 0.0))
    gap_edge_rows = np.unique([0, *gap_rows, *(gap_rows + 1), len(time_s) - 1])
    return Acceleration(
        time_s=time_s,
        acceleration_integral_m_s=np.ascontiguousarray(
            integrate_cumulatively(acceleration.to_numpy(), time_s).T
        ),
        acceleration_second_moments_m2_s4=segment_acceleration_m_s2.T
        @ segment_acceleration_m_s2
        / len(segment_acceleration_m_s2),
        gap_edge_time_s=time_s[gap_edge_rows],
        cumulative_gap_s=np.append(0.0, cumulative_gap_s)[gap_edge_rows],
    )


def find_imu_gaps(time_s: Array) -> BoolArray:
    """Return a mask of the intervals between IMU samples that are gaps, shape (n - 1,)."""
    interval_s = np.diff(time_s)
    return interval_s > max(MIN_IMU_GAP_S, MIN_IMU_GAP_INTERVALS * float(np.median(interval_s)))


def find_gap_free_spans(imu_time_s: Array) -> list[Span]:
    """Return the time spans before, between and after the IMU gaps; the outer ends are infinite."""
    gaps_s = select_intervals(imu_time_s, find_imu_gaps(imu_time_s))
    edges_s = [-np.inf, *chain.from_iterable(gaps_s), np.inf]
    return list(zip(edges_s[::2], edges_s[1::2], strict=True))


def compute_mean_step_acceleration(
    acceleration: Acceleration, direction: Array, step_edges_s: Array
) -> ArrayPair:
    """Return the mean acceleration of each prediction step, and the fraction of it in IMU gaps.

    ``direction`` is a unit vector in NED. ``step_edges_s`` contains the start of the first step,
    and the end (s) of each step.
    """
    step_s = np.diff(step_edges_s)
    velocity_m_s = np.interp(
        step_edges_s, acceleration.time_s, acceleration.compute_velocity_change_m_s(direction)
    )
    cumulative_gap_at_edges_s = np.interp(
        step_edges_s, acceleration.gap_edge_time_s, acceleration.cumulative_gap_s
    )
    clipped_edges_s = np.clip(step_edges_s, acceleration.time_s[0], acceleration.time_s[-1])
    fraction_outside_imu_data = 1.0 - np.diff(clipped_edges_s) / step_s
    return np.diff(velocity_m_s) / step_s, np.clip(
        np.diff(cumulative_gap_at_edges_s) / step_s + fraction_outside_imu_data, 0.0, 1.0
    )


def cut_to_segment(samples: pd.DataFrame, segment: Segment) -> pd.DataFrame:
    """Return the rows of a time-indexed table inside a segment, both ends included."""
    return rows_between(samples, segment.start_s, segment.end_s)
