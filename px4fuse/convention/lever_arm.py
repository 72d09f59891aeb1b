"""Lever arm from the IMU to the position sensor, from the motion of the sensor in turns."""

import numpy as np

from px4fuse.convention.motion import (
    GRID_S,
    WINDOW_S,
    SourceMotion,
    motion_from_imu,
    read_inertial,
)
from px4fuse.core.arrays import Array
from px4fuse.flight.model import Columns, Flight, PositionTrack
from px4fuse.trajectory.rotation import to_matrix

# Minimum lever arm (m) for a finding: twice the noise of good UWB (0.1 m)
MIN_ARM_M = 0.2
# Minimum lever arm in σ for a finding: sources without a lever arm reach 1.5
MIN_ARM_SIGMAS = 2.5
# Maximum residual, in σ, of a sample that the next fit uses
CLIPPED_SIGMAS = 3.0
# Number of successive least squares fits, each without the outliers of the previous fit
ITERATIONS = 4


def estimate_lever_arm(flight: Flight, track: PositionTrack) -> tuple[float, float, float] | None:
    """Estimate the lever arm of the position sensor in addition to that of EKF2's parameters.

    Return the distances forward and right and their σ (m); None if the lever arm is not
    significant.
    """
    inertial = read_inertial(flight)
    samples = track.samples[Columns.POSITION[:2]].dropna()
    if inertial is None or len(samples) < 2:
        return None
    attitude = inertial.attitudes["EKF2"]
    imu = motion_from_imu(inertial, attitude)
    rotation = to_matrix(attitude)[:, :2, :2].reshape(-1, 4)
    arms = SourceMotion.of(inertial.time_s, rotation, imu.time_s).table.reshape(-1, 2, 2)
    design = np.concatenate([arms, imu.rate_m_s[:, :2, None], imu.table[:, :2, 1:]], axis=2)
    time_s, is_used = samples.index.to_numpy(), imu.is_valid
    for _ in range(ITERATIONS):
        source = SourceMotion.of(time_s, samples.to_numpy(), imu.time_s)
        is_used = is_used & source.is_valid
        excess = source.table - imu.table[:, :2, 0]
        rows, values = design[is_used].reshape(-1, design.shape[2]), excess[is_used].ravel()
        # second differences overlap over twice the window, so only these are independent
        count = len(values) * GRID_S / (2.0 * WINDOW_S)
        if count < 2 * rows.shape[1]:
            return None
        fit = np.linalg.lstsq(rows, values, rcond=None)[0]
        residual: Array = np.linalg.norm(excess - design @ fit, axis=1)
        sigma_m = float(np.sqrt(np.mean(residual[is_used] ** 2) / 2.0))
        covariance = np.linalg.pinv(rows.T @ rows) * sigma_m**2 * len(values) / count
        sigma = float(np.sqrt(np.trace(covariance[:2, :2])))
        is_used &= residual < CLIPPED_SIGMAS * sigma_m
        time_s = time_s + fit[2]  # fit[2]: time (s) by which timestamps are early
    forward_m, right_m = fit[:2].tolist()
    is_significant = np.hypot(forward_m, right_m) > max(MIN_ARM_M, MIN_ARM_SIGMAS * sigma)
    return (forward_m, right_m, sigma) if is_significant else None
