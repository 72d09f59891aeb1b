"""Position of the source's sensor relative to the IMU, from ground truth or from turns."""

from typing import NamedTuple

import numpy as np

from px4fuse.convention.motion import (
    GRID_S,
    WINDOW_S,
    SourceMotion,
    motion_from_imu,
    read_inertial,
)
from px4fuse.core.arrays import Array
from px4fuse.flight.model import Columns, Flight, PositionTrack, Truth, Unavailable
from px4fuse.trajectory.rotation import interpolate, to_matrix
from px4fuse.trajectory.scores import autocorrelation_time

# Minimum lever arm (m) for a finding: twice the noise of good UWB (0.1 m)
MIN_ARM_M = 0.2
# Minimum lever arm in σ for a finding: sources without a lever arm reach 1.5
MIN_ARM_SIGMAS = 2.5
# Minimum lever arm (m) for a finding, estimated with ground truth
MIN_TRUE_ARM_M = 0.05
# Minimum lever arm in σ for a finding, estimated with ground truth
MIN_TRUE_ARM_SIGMAS = 5.0
# Maximum lever arm (m) for a finding: a larger one is an error of the frame
MAX_ARM_M = 5.0
# Samples with a larger residual (σ) are excluded from the next fit
CLIPPED_SIGMAS = 3.0
# Minimum ratio of the singular values of a fit with ground truth
MIN_SINGULAR_RATIO = 0.02
# Minimum number of measured coordinates for a fit with ground truth
MIN_ROWS = 40
# Number of fits; each excludes the outliers of the previous one
ITERATIONS = 4


class LeverArm(NamedTuple):
    """Distances (m) of the sensor forward and right of the vehicle's origin, and their σ (m)."""

    forward_m: float
    right_m: float
    sigma_m: float

    @property
    def size_m(self) -> float:
        return float(np.hypot(self.forward_m, self.right_m))


def estimate_lever_arm(flight: Flight, track: PositionTrack) -> LeverArm | None:
    """Estimate the lever arm that EKF2's parameters lack, from ground truth if logged."""
    arm = None
    if isinstance(flight.truth, Truth):
        arm = _fit_to_truth(flight, flight.truth, track)
    return arm if arm or track.origin.is_gnss else _fit_to_imu(flight, track)


def _fit_to_truth(flight: Flight, truth: Truth, track: PositionTrack) -> LeverArm | None:
    """Fit a constant, a lever arm and a delay to the position errors against ground truth."""
    attitude, columns = flight.attitude, Columns.POSITION[:2]
    airborne = () if isinstance(flight.airborne, Unavailable) else flight.airborne
    samples = track.samples[columns].dropna()
    if airborne:
        samples = samples.loc[airborne[0][0] : airborne[-1][1]]
    if isinstance(attitude, Unavailable) or len(samples) < 2:
        return None
    time_s, true_samples = samples.index.to_numpy(), truth.samples
    true_m = [
        np.interp(time_s, true_samples.index, true_samples[name], np.nan, np.nan)
        for name in columns
    ]
    error_m = samples.to_numpy() - np.transpose(true_m)
    # a delay is estimated too (error = velocity · delay), because it resembles a lever arm
    velocity_m_s = np.gradient(np.transpose(true_m), time_s, axis=0)
    quaternions = attitude[Columns.QUATERNION].to_numpy()
    rotation = to_matrix(interpolate(time_s, attitude.index.to_numpy(), quaternions))[:, :2, :2]
    constant = np.broadcast_to(np.eye(2), rotation.shape)
    design = np.concatenate([rotation, constant, velocity_m_s[:, :, None]], axis=2)
    is_known = np.isfinite(velocity_m_s).all(axis=1)
    rows, values = design[is_known].reshape(-1, 5), error_m[is_known].ravel()
    if len(rows) < MIN_ROWS:
        return None
    fit, _, rank, _ = np.linalg.lstsq(rows, values, rcond=MIN_SINGULAR_RATIO)
    if rank < rows.shape[1]:  # with a constant heading, a lever arm is a constant offset
        return None
    residual = (values - rows @ fit).reshape(-1, 2)
    # successive errors of a source may be correlated
    variance_factor = max(map(autocorrelation_time, residual.T))
    covariance = np.linalg.inv(rows.T @ rows) * np.mean(residual**2) * variance_factor
    sigma_m = float(np.sqrt(np.trace(covariance[:2, :2])))
    arm = LeverArm(float(fit[0]), float(fit[1]), sigma_m)
    is_significant = arm.size_m > max(MIN_TRUE_ARM_M, MIN_TRUE_ARM_SIGMAS * sigma_m)
    return arm if is_significant and arm.size_m < MAX_ARM_M else None


def _fit_to_imu(flight: Flight, track: PositionTrack) -> LeverArm | None:
    inertial = read_inertial(flight)
    samples = track.samples[Columns.POSITION[:2]].dropna()
    if inertial is None or len(samples) < 2:
        return None
    attitude = inertial.attitudes["EKF2"]
    imu = motion_from_imu(inertial, attitude)
    rotation = to_matrix(attitude)[:, :2, :2].reshape(-1, 4)
    arm_differences = SourceMotion.of(inertial.time_s, rotation, imu.time_s).table.reshape(-1, 2, 2)
    design = np.concatenate(
        [arm_differences, imu.rate_m_s[:, :2, None], imu.table[:, :2, 1:]], axis=2
    )
    time_s, is_used = samples.index.to_numpy(), imu.is_valid
    for _ in range(ITERATIONS):
        source = SourceMotion.of(time_s, samples.to_numpy(), imu.time_s)
        is_used = is_used & source.is_valid
        difference_m = source.table - imu.table[:, :2, 0]
        rows, values = design[is_used].reshape(-1, design.shape[2]), difference_m[is_used].ravel()
        # second differences overlap over twice the window, so only these are independent
        count = len(values) * GRID_S / (2.0 * WINDOW_S)
        if count < 2 * rows.shape[1]:
            return None
        fit = np.linalg.lstsq(rows, values, rcond=None)[0]
        residual: Array = np.linalg.norm(difference_m - design @ fit, axis=1)
        sigma_m = float(np.sqrt(np.mean(residual[is_used] ** 2) / 2.0))
        covariance = np.linalg.pinv(rows.T @ rows) * sigma_m**2 * len(values) / count
        sigma = float(np.sqrt(np.trace(covariance[:2, :2])))
        is_used &= residual < CLIPPED_SIGMAS * sigma_m
        time_s = time_s + fit[2]  # fit[2] is the time by which the timestamps are early
    arm = LeverArm(float(fit[0]), float(fit[1]), sigma)
    return arm if arm.size_m > max(MIN_ARM_M, MIN_ARM_SIGMAS * sigma) else None
