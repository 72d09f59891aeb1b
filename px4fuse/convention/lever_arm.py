"""Position of the source's sensor relative to the IMU, from the motion in turns."""

from typing import NamedTuple

import numpy as np

from px4fuse.arrays import Array
from px4fuse.convention.motion import (
    GRID_S,
    WINDOW_S,
    SourceMotion,
    motion_from_imu,
    read_inertial,
)
from px4fuse.flight import Columns, Flight, PositionTrack, Unavailable
from px4fuse.trajectory.rotation import to_matrix

# Minimum lever arm: m (twice the noise of good UWB), and σ; sources without one have up to 1.5
MIN_ARM_M, MIN_ARM_SIGMAS = 0.2, 4.0
CLIPPED_SIGMAS = 3.0  # residuals beyond are left out
ITERATIONS = 4


class LeverArm(NamedTuple):
    """Sensor position in the body frame (m), with its standard deviation."""

    forward_m: float
    right_m: float
    sigma_m: float


def estimate_lever_arm(flight: Flight, track: PositionTrack) -> LeverArm | None:
    """Estimate the lever arm in addition to the one that is already subtracted.

    Least squares of the second differences of the positions, with time offset and accelerometer
    bias; None if it is not significant.
    """
    inertial = read_inertial(flight)
    samples = track.samples[Columns.POSITION[:2]].dropna()
    if isinstance(inertial, Unavailable) or len(samples) < 2:
        return None
    attitude = inertial.with_logged_heading
    imu = motion_from_imu(inertial, attitude)
    rotation = to_matrix(attitude)[:, :2, :2].reshape(-1, 4)
    arms = SourceMotion.of(inertial.time_s, rotation, imu.time_s).table.reshape(-1, 2, 2)
    design = np.concatenate([arms, imu.rate_m_s[:, :2, None], imu.table[:, :2, 1:]], axis=2)
    time_s, is_used, result = samples.index.to_numpy(), imu.is_valid, None
    for _ in range(ITERATIONS):
        source = SourceMotion.of(time_s, samples.to_numpy(), imu.time_s)
        is_used = is_used & source.is_valid
        excess = source.table - imu.table[:, :2, 0]
        rows, values = design[is_used].reshape(-1, design.shape[2]), excess[is_used].ravel()
        # successive second differences overlap by twice the window
        count = len(values) * GRID_S / (2.0 * WINDOW_S)
        if count < 2 * rows.shape[1]:
            return None
        fit = np.linalg.lstsq(rows, values, rcond=None)[0]
        residual: Array = np.linalg.norm(excess - design @ fit, axis=1)
        sigma_m = float(np.sqrt(np.mean(residual[is_used] ** 2) / 2.0))
        covariance = np.linalg.pinv(rows.T @ rows) * sigma_m**2 * len(values) / count
        sigma = float(np.sqrt(np.trace(covariance[:2, :2])))
        result = LeverArm(float(fit[0]), float(fit[1]), sigma)
        is_used &= residual < CLIPPED_SIGMAS * sigma_m
        time_s = time_s + fit[2]  # the rate's coefficient is the time by which they are early
    if result is None:
        return None
    size_m = float(np.hypot(result.forward_m, result.right_m))
    return result if size_m > max(MIN_ARM_M, MIN_ARM_SIGMAS * result.sigma_m) else None
