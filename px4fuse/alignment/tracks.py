"""Tracks of a position file and of its references, on one time grid, in north, east, down."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import binary_erosion, gaussian_filter1d, median_filter
from scipy.signal import butter, sosfiltfilt

from px4fuse.arrays import Array, BoolArray, Complex
from px4fuse.comparison.projection import continuous_state
from px4fuse.filter.signals import Segment, ned_acceleration
from px4fuse.flight import Columns, Ekf2, Flight, PositionTrack, Unavailable
from px4fuse.position_source import POSITION_FILE
from px4fuse.readers.common import finite_rows
from px4fuse.trajectory.association import gap_limit, is_bracketed
from px4fuse.trajectory.time_offset import STEP_S

# indices of north, east, down in x, y, z, and their signs
FRAMES = {
    "ned": ([0, 1, 2], [1.0, 1.0, 1.0]),
    "enu": ([1, 0, 2], [1.0, 1.0, -1.0]),
    "nwu": ([0, 1, 2], [1.0, -1.0, -1.0]),
}
EKF2_POSITION, IMU = "EKF2 position", "IMU"

GAP_S = 0.5  # longest interval that is interpolated, or three median intervals
MIN_MOTION_M = 0.5
MIN_SAMPLES = 10
MIN_OVERLAP_S = 10.0  # smallest overlap, or half of the shorter track
# s; EKF2's output has steps at its updates; this smoothing has no delay
SMOOTHING_S = 0.2
# band in which acceleration integrated twice equals a position; it drifts below
BAND_HZ = (0.1, 1.0)
BAND_EDGE_S, BAND_PADDING_S = 2.0, 10.0  # length of the filter transients, and padding


class NoMatchError(Exception):
    """Reason why a reference does not match; with a remedy if other references are no better."""

    def __init__(self, reason: str, remedy: str = "") -> None:
        super().__init__(reason)
        self.remedy = remedy


@dataclass(frozen=True)
class SampledTrack:
    """Positions over time, of the file or of its reference.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Flight time; for the file the time since its first sample.
    position_m : ndarray, shape (n, 3)
        North, east, down; down may be NaN.
    valid : ndarray of bool, shape (n,)
        False inside gaps.
    name : str
        Name of a reference.
    """

    time_s: Array
    position_m: Array
    valid: BoolArray
    name: str = ""

    @property
    def horizontal_m(self) -> Complex:
        """North + i·east, shape (n,)."""
        return self.position_m[:, 0] + 1j * self.position_m[:, 1]

    def at(self, time_s: Array) -> tuple[Array, BoolArray]:
        """Interpolate the position; also return the mask of times outside of gaps."""
        position = [np.interp(time_s, self.time_s, column) for column in self.position_m.T]
        valid = np.interp(time_s, self.time_s, self.valid.astype(float), 0.0, 0.0) > 0.999
        return np.stack(position, axis=1), valid


def file_track(samples: pd.DataFrame, frame: str) -> SampledTrack:
    """Convert the axes of the file to north, east, down; time since its first sample."""
    order, sign = FRAMES[frame]
    time = samples.index.to_numpy()
    position = samples[["x_m", "y_m", "z_m"]].to_numpy()[:, order] * sign
    return SampledTrack(time - time[0], position, np.ones(len(time), dtype=bool))


def resample_to_grid(track: SampledTrack) -> SampledTrack:
    """Resample a track to a regular grid, with gaps marked."""
    grid = np.arange(track.time_s[0], track.time_s[-1], STEP_S)
    known = is_bracketed(grid, track.time_s, gap_limit(track.time_s, GAP_S))
    return SampledTrack(grid, track.at(grid)[0], known)


def remove_spikes(track: SampledTrack, window: int = 3) -> SampledTrack:
    """Remove single outliers by a median filter; a longer window removes more."""
    return replace(track, position_m=median_filter(track.position_m, size=(window, 1)))


def band_pass(position_m: Array) -> Array:
    """Band-pass positions without delay."""
    sos = butter(2, BAND_HZ, "bandpass", fs=1.0 / STEP_S, output="sos")
    padding = min(round(BAND_PADDING_S / STEP_S), len(position_m) - 1)
    return sosfiltfilt(sos, position_m, axis=0, padlen=padding)


def remove_edges(track: SampledTrack) -> SampledTrack:
    """Mark the filter transients at the ends and gaps as invalid."""
    edge = round(BAND_EDGE_S / STEP_S)
    return replace(track, valid=binary_erosion(track.valid, np.ones(2 * edge + 1, dtype=bool)))


def horizontal_range_m(track: SampledTrack) -> float:
    """Return the larger horizontal range (m), without noise and outliers."""
    return float(np.max(np.ptp(remove_spikes(track, 5).position_m[:, :2], axis=0)))


def _ekf2_track(state: pd.DataFrame) -> SampledTrack:
    """Return EKF2's position on the grid, smoothed."""
    known = finite_rows(state, Columns.POSITION[:2])
    if len(known) < MIN_SAMPLES:
        raise NoMatchError("no horizontal EKF2 position in the log")
    time, position = known.index.to_numpy(), known[Columns.POSITION].to_numpy()
    grid = resample_to_grid(SampledTrack(time, position, np.ones(len(known), dtype=bool)))
    smooth = gaussian_filter1d(grid.position_m, SMOOTHING_S / STEP_S, axis=0, mode="nearest")
    return replace(grid, position_m=smooth, name=EKF2_POSITION)


def ekf2_references(flight: Flight) -> list[SampledTrack]:
    """Return EKF2's position as published and, with horizontal resets, also without them.

    The height is always as published: most of its resets correct an error from before take-off.
    """
    if isinstance(flight.ekf2, Unavailable):
        raise NoMatchError("the log has no EKF2 position")
    state = flight.ekf2.state
    states = [state]
    resets = [r for r in flight.ekf2.resets if r.quantity == "position" and any(r.delta[:2])]
    if resets:
        is_after_reset = state.index.to_numpy()[:, None] >= np.array(
            [reset.time_s for reset in resets]
        )
        reset_sum_m = is_after_reset @ np.array([(*reset.delta[:2], 0.0) for reset in resets])
        states.append(state.assign(**(state[Columns.POSITION] - reset_sum_m)))
    references = [_ekf2_track(state) for state in states]
    if max(map(horizontal_range_m, references)) < MIN_MOTION_M:
        raise NoMatchError("the EKF2 position hardly changes")
    return references


def imu_references(flight: Flight) -> list[SampledTrack]:
    """Return the acceleration integrated twice, band-passed after each integration."""
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        raise NoMatchError("the log has no acceleration in NED")
    time = acceleration.index.to_numpy()
    velocity = cumulative_trapezoid(acceleration.to_numpy(), time, axis=0, initial=0)
    grid = resample_to_grid(SampledTrack(time, velocity, np.ones(len(time), dtype=bool)))
    if len(grid.time_s) * STEP_S < MIN_OVERLAP_S:
        raise NoMatchError("the IMU data are too short")
    position = cumulative_trapezoid(band_pass(grid.position_m), dx=STEP_S, axis=0, initial=0)
    return [remove_edges(replace(grid, position_m=band_pass(position), name=IMU))]


def placed_samples(
    samples: pd.DataFrame, frame: str, yaw_rad: float, origin_m: Array, lag_s: float
) -> pd.DataFrame:
    """Return NED positions R·C·p + origin, and variances: diagonal of R·C·diag(σ²)·Cᵀ·Rᵀ."""
    track = file_track(samples, frame)
    position = track.position_m.copy()
    order, _ = FRAMES[frame]
    variance = samples[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()[:, order] ** 2
    if yaw_rad:  # without rotation a missing sigma of one axis does not affect the other
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, -s], [s, c]])
        position[:, :2] = position[:, :2] @ turn.T
        variance[:, :2] = variance[:, :2] @ (turn**2).T
    columns = Columns.POSITION + Columns.POSITION_VARIANCE
    values = np.hstack([position + origin_m, variance])
    times = pd.Index(track.time_s + lag_s, name="time_s")
    return pd.DataFrame(dict(zip(columns, values.T, strict=True)), index=times)


def continuous_track(ekf2: Ekf2, placed: pd.DataFrame) -> SampledTrack:
    """Return EKF2's track with its resets corrected for the comparison with the placed file."""
    track = PositionTrack("", POSITION_FILE, "", placed, "NED", "", ())
    segment = Segment(float(placed.index[0]), float(placed.index[-1]), "")
    return _ekf2_track(continuous_state(ekf2, track, segment)[0])
