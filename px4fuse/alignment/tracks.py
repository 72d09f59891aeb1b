"""Tracks (NED) to align a position file with a flight: file, EKF2 position and IMU motion."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.ndimage import binary_erosion, gaussian_filter1d, median_filter
from scipy.signal import butter, sosfiltfilt

from px4fuse.comparison.projection import remove_origin_resets
from px4fuse.core.arrays import (
    Array,
    BoolArray,
    ComplexArray,
    integrate_cumulatively,
    interpolate_columns,
)
from px4fuse.errors import Px4FuseError
from px4fuse.filter.signals import Segment, compute_ned_acceleration
from px4fuse.flight.model import (
    POSITION_FILE_ORIGIN,
    Columns,
    Ekf2,
    Flight,
    PositionTrack,
    Unavailable,
    time_index,
)
from px4fuse.readers.common import select_valid_rows
from px4fuse.trajectory.association import choose_gap_limit_s, is_bracketed
from px4fuse.trajectory.model import NED_COMPONENTS_BY_FRAME
from px4fuse.trajectory.time_offset import GRID_STEP_S

EKF2_REFERENCE, IMU_REFERENCE = "EKF2 position", "IMU"

# Minimum length (s) of a gap in a track
MIN_GAP_S = 0.5
# Minimum horizontal motion (m) of a track
MIN_MOTION_M = 0.5
MIN_MATCHED_SAMPLES = 10
# Minimum overlap (s) of two tracks
MIN_OVERLAP_S = 10.0
# σ (s) of the Gaussian filter of EKF2's position, which has steps at updates
SMOOTHING_SIGMA_S = 0.2
# Pass band (Hz) of integrated acceleration; at lower frequencies, the integral drifts
BAND_PASS_HZ = (0.1, 1.0)
# Time (s) near ends and gaps in which the band-pass filter has not settled
BAND_PASS_SETTLING_TIME_S = 2.0
# Maximum padding (s) at both ends before the band-pass filter
BAND_PASS_PADDING_S = 10.0


class NoMatchError(Px4FuseError):
    """Error: the position file does not match the flight."""


class AmbiguousMatchError(NoMatchError):
    """Error: the file matches the flight, but its time offset or its frame is ambiguous."""


@dataclass(frozen=True)
class SampledTrack:
    """Positions (NED) of a position file or of a reference over time.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Time since the start of the log, or since the first position of a file.
    position_m : ndarray, shape (n, 3)
        Positions north, east, down; down may be NaN.
    is_valid : ndarray of bool, shape (n,)
        False inside gaps.
    name : str
        Name of a reference track; empty for a position file.
    """

    time_s: Array
    position_m: Array
    is_valid: BoolArray
    name: str = ""

    def to_complex_m(self) -> ComplexArray:
        """Return horizontal positions as complex numbers north + i·east."""
        return self.position_m[:, 0] + 1j * self.position_m[:, 1]

    def at(self, time_s: Array) -> tuple[Array, BoolArray]:
        """Interpolate the position at given times; the mask is True between two valid samples."""
        # The interpolated validity is 1 (except for rounding errors) only between two valid samples
        is_valid = np.interp(time_s, self.time_s, self.is_valid.astype(float), 0.0, 0.0) > 0.999
        return interpolate_columns(time_s, self.time_s, self.position_m), is_valid


def convert_to_ned(samples: pd.DataFrame, frame: str) -> SampledTrack:
    """Convert the positions of a file from ``frame`` to north, east, down."""
    axis_order, axis_signs = NED_COMPONENTS_BY_FRAME[frame]
    position_m = samples[["x_m", "y_m", "z_m"]].to_numpy()[:, axis_order] * axis_signs
    return _make_gapless_track(samples.index.to_numpy() - samples.index[0], position_m)


def _make_gapless_track(time_s: Array, position_m: Array) -> SampledTrack:
    return SampledTrack(time_s, position_m, np.ones(len(time_s), bool))


def resample_to_grid(track: SampledTrack) -> SampledTrack:
    """Resample a track to a regular time grid, and mark gaps as invalid."""
    grid_s = np.arange(track.time_s[0], track.time_s[-1], GRID_STEP_S)
    is_known = is_bracketed(grid_s, track.time_s, choose_gap_limit_s(track.time_s, MIN_GAP_S))
    return SampledTrack(grid_s, track.at(grid_s)[0], is_known)


def remove_spikes(track: SampledTrack, window_size: int = 3) -> SampledTrack:
    """Remove outliers of the positions with a median filter."""
    return replace(track, position_m=median_filter(track.position_m, size=(window_size, 1)))


def apply_band_pass(position_m: Array) -> Array:
    """Filter positions with the pass band BAND_PASS_HZ, without delay."""
    second_order_sections = butter(2, BAND_PASS_HZ, "bandpass", fs=1.0 / GRID_STEP_S, output="sos")
    return sosfiltfilt(
        second_order_sections,
        position_m,
        axis=0,
        padlen=min(round(BAND_PASS_PADDING_S / GRID_STEP_S), len(position_m) - 1),
    )


def mark_transients(track: SampledTrack) -> SampledTrack:
    """Mark samples as invalid near ends and gaps, where the band-pass filter has not settled."""
    transient_sample_count = round(BAND_PASS_SETTLING_TIME_S / GRID_STEP_S)
    return replace(
        track,
        is_valid=binary_erosion(track.is_valid, np.ones(2 * transient_sample_count + 1, bool)),
    )


def compute_horizontal_range_m(track: SampledTrack) -> float:
    """Return the larger of the ranges (m) of north and east position, without outliers."""
    return float(np.max(np.ptp(remove_spikes(track, 5).position_m[:, :2], axis=0)))


def _smooth_ekf2_track(state: pd.DataFrame) -> SampledTrack:
    """Return EKF2's position at regular times, smoothed by a Gaussian filter."""
    finite_state = select_valid_rows(state, Columns.POSITION[:2])
    if len(finite_state) < MIN_MATCHED_SAMPLES:
        raise NoMatchError(
            f"the log has fewer than {MIN_MATCHED_SAMPLES} horizontal EKF2 positions"
        )
    position_m = finite_state[Columns.POSITION].to_numpy()
    resampled_track = resample_to_grid(
        _make_gapless_track(finite_state.index.to_numpy(), position_m)
    )
    return replace(
        resampled_track,
        position_m=gaussian_filter1d(
            resampled_track.position_m, SMOOTHING_SIGMA_S / GRID_STEP_S, axis=0, mode="nearest"
        ),
        name=EKF2_REFERENCE,
    )


def make_ekf2_references(flight: Flight) -> list[SampledTrack]:
    """Return EKF2's position, and a copy without horizontal resets if there are resets."""
    if isinstance(flight.ekf2, Unavailable):
        raise NoMatchError("the log has no EKF2 position")
    state = flight.ekf2.state
    states = [state]
    resets = flight.ekf2.find_horizontal_resets()
    if resets:
        # A reset moves all later positions. The matrix product sums the resets before each sample
        is_after_reset = state.index.to_numpy()[:, None] >= [reset.time_s for reset in resets]
        reset_sum_m = is_after_reset @ np.array([(*reset.delta[:2], 0.0) for reset in resets])
        states.append(state[Columns.POSITION] - reset_sum_m)
    references = [_smooth_ekf2_track(state) for state in states]
    if max(map(compute_horizontal_range_m, references)) < MIN_MOTION_M:
        raise NoMatchError(
            f"the EKF2 position changes by less than {MIN_MOTION_M:g} m, too little to match the "
            "position file"
        )
    return references


def make_imu_references(flight: Flight) -> list[SampledTrack]:
    """Return the double integral of the acceleration, with a band-pass filter against drift."""
    acceleration = compute_ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        raise NoMatchError(f"the log has no acceleration in NED ({acceleration.reason})")
    # Integrate to the velocity, filter it, integrate it to the position, and filter this too: each
    # integral drifts
    time_s = acceleration.index.to_numpy()
    velocity_m_s = integrate_cumulatively(acceleration.to_numpy(), time_s)
    # To resample the velocity (m/s) to the grid, it is stored in a track as "position_m"
    velocity_track = resample_to_grid(_make_gapless_track(time_s, velocity_m_s))
    grid_s = velocity_track.time_s
    if len(grid_s) * GRID_STEP_S < MIN_OVERLAP_S:
        raise NoMatchError(f"the IMU data are shorter than {MIN_OVERLAP_S:g} s")
    position_m = integrate_cumulatively(apply_band_pass(velocity_track.position_m), grid_s)
    imu_track = SampledTrack(
        grid_s, apply_band_pass(position_m), velocity_track.is_valid, IMU_REFERENCE
    )
    return [mark_transients(imu_track)]


def align_samples(
    samples: pd.DataFrame, frame: str, yaw_rad: float, origin_m: Array, lag_s: float
) -> pd.DataFrame:
    """Convert the samples of a position file to north, east, down and to flight time.

    ``lag_s`` is the flight time of the first sample. Positions are rotated by ``yaw_rad`` and
    shifted by ``origin_m``.
    """
    track = convert_to_ned(samples, frame)
    position_m = track.position_m
    axis_order, _ = NED_COMPONENTS_BY_FRAME[frame]
    variance_m2 = samples[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()[:, axis_order] ** 2
    # The rotation combines north and east variances, so both are NaN if one is missing
    if yaw_rad:
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        yaw_rotation = np.array([[c, -s], [s, c]])
        position_m[:, :2] = position_m[:, :2] @ yaw_rotation.T
        variance_m2[:, :2] = variance_m2[:, :2] @ (yaw_rotation**2).T
    return pd.DataFrame(
        np.hstack([position_m + origin_m, variance_m2]),
        time_index(track.time_s + lag_s),
        Columns.POSITION + Columns.POSITION_VARIANCE,
    )


def make_continuous_ekf2_track(ekf2: Ekf2, aligned_samples: pd.DataFrame) -> SampledTrack:
    """Return EKF2's position without resets that only moved the origin of EKF2's frame."""
    track = PositionTrack("", POSITION_FILE_ORIGIN, "", aligned_samples, "NED", "", ())
    segment = Segment(float(aligned_samples.index[0]), float(aligned_samples.index[-1]), "")
    return _smooth_ekf2_track(remove_origin_resets(ekf2, track, segment)[0])
