"""Estimate of the lever arm from the IMU to the position sensor."""

from typing import NamedTuple

import numpy as np

from px4fuse.core.arrays import Array
from px4fuse.filter.signals import interpolate_attitude
from px4fuse.flight.model import Columns, Flight, PositionTrack, Truth, Unavailable
from px4fuse.trajectory.rotation import to_rotation_matrix
from px4fuse.trajectory.scores import compute_autocorrelation_time

from .motion import (
    GRID_INTERVAL_S,
    SECOND_DIFFERENCE_WINDOW_S,
    SourceSecondDifferences,
    integrate_imu_motion,
    integrate_inertial_data,
)

# Minimum lever arm (m) that is reported: twice the noise of good UWB (0.1 m)
MIN_REPORTED_LEVER_ARM_M = 0.2
# Minimum ratio of a reported lever arm to its σ: noise alone causes ratios up to 1.5
MIN_LEVER_ARM_SIGMAS = 2.5
MIN_LEVER_ARM_WITH_TRUTH_M = 0.05
MIN_LEVER_ARM_SIGMAS_WITH_TRUTH = 5.0
# Maximum reported lever arm (m): larger values are frame errors of the position source
MAX_REPORTED_LEVER_ARM_M = 5.0
# Samples with a residual above this multiple of σ are outliers and omitted from the next fit of the
# lever arm
MAX_RESIDUAL_SIGMAS = 3.0
# Minimum ratio of smallest to largest singular value in the lever arm fit with ground truth: below
# it, not all parameters can be determined
MIN_SINGULAR_VALUE_RATIO = 0.02
MIN_COORDINATE_COUNT = 40
LEVER_ARM_FIT_COUNT = 4
# Minimum RMS distance (m) from the middle of the path, to fit a rotation
MIN_RMS_DISTANCE_FROM_PATH_MEAN_M = 0.01
IMU_POSITION_PARAMETERS = ("EKF2_IMU_POS_X", "EKF2_IMU_POS_Y", "EKF2_IMU_POS_Z")


class LeverArm(NamedTuple):
    """Distances (m) of the sensor forward and right of the vehicle's origin, and their σ (m).

    ``rotation_deg`` is the rotation of the positions (clockwise from above) that fits best together
    with the lever arm.
    """

    forward_m: float
    right_m: float
    sigma_m: float
    rotation_deg: float = 0.0
    rotation_sigma_deg: float = 0.0

    @property
    def horizontal_length_m(self) -> float:
        return float(np.hypot(self.forward_m, self.right_m))


def find_imu_position_m(flight: Flight) -> list[float]:
    """Return the position of the IMU (m, body FRD) that EKF2 assumes."""
    parameters = {} if isinstance(flight.ekf2, Unavailable) else flight.ekf2.parameters
    return [parameters.get(name, 0.0) for name in IMU_POSITION_PARAMETERS]


def estimate_lever_arm(flight: Flight, track: PositionTrack) -> LeverArm | None:
    """Estimate the error of the lever arm in EKF2's parameters (true minus parameter).

    The lever arm in the parameters was already subtracted from the positions of ``track``. The
    error is estimated with ground truth, or else with the IMU (not for GNSS). The estimate with the
    IMU also contains the negative error of EKF2_IMU_POS. Return None for an insignificant error.
    """
    lever_arm = None
    if isinstance(flight.truth, Truth):
        lever_arm = _fit_lever_arm_to_truth(flight, flight.truth, track)
    return lever_arm if lever_arm or track.origin.is_gnss else _fit_lever_arm_to_imu(flight, track)


def _fit_lever_arm_to_truth(flight: Flight, truth: Truth, track: PositionTrack) -> LeverArm | None:
    """Fit offset, lever arm, delay and rotation to the position errors against ground truth."""
    attitude, columns = flight.attitude, Columns.POSITION[:2]
    position_samples, airborne_s = track.samples[columns].dropna(), flight.airborne
    if airborne_s and not isinstance(airborne_s, Unavailable):
        position_samples = position_samples.loc[airborne_s[0][0] : airborne_s[-1][1]]
    if isinstance(attitude, Unavailable) or len(position_samples) < 2:
        return None
    time_s, truth_samples = position_samples.index.to_numpy(), truth.samples
    true_positions_m = np.column_stack(
        [
            np.interp(time_s, truth_samples.index, truth_samples[name], np.nan, np.nan)
            for name in columns
        ]
    )
    # Errors per second of delay, and per radian of rotation: the derivative of a rotation is a
    # rotation by 90°. Without the mean, the rotation does not change the offset
    velocity_m_s = np.gradient(true_positions_m, time_s, axis=0)
    error_per_radian_m = _rotate(true_positions_m - np.nanmean(true_positions_m, axis=0), 90.0)
    # Columns: derivatives of the position error with respect to lever arm (forward, right), offset
    # (north, east), delay and rotation. Delay and rotation are also fitted, because their effects
    # on the position resemble that of a lever arm
    attitude_columns = to_rotation_matrix(interpolate_attitude(attitude, time_s))[:, :2, :2]
    offset_columns = np.broadcast_to(np.eye(2), attitude_columns.shape)
    motion_columns = np.stack([velocity_m_s, error_per_radian_m], axis=2)
    design = np.concatenate([attitude_columns, offset_columns, motion_columns], axis=2)
    is_known = np.isfinite(velocity_m_s).all(axis=1)
    design_rows = design[is_known].reshape(-1, 6)
    if len(design_rows) < MIN_COORDINATE_COUNT:
        return None
    # The rank test of lstsq compares singular values, so all columns need a similar magnitude:
    # divide the rotation column by its RMS
    column_scales = np.ones(6)
    column_scales[-1] = max(
        np.sqrt(np.nanmean(error_per_radian_m**2)), MIN_RMS_DISTANCE_FROM_PATH_MEAN_M
    )
    rotation_deg = 0.0
    # The fit is linear in the rotation. A large rotation is not linear, so the fit is repeated with
    # positions that are rotated back by the estimate
    for _ in range(LEVER_ARM_FIT_COUNT):
        error_m = _rotate(position_samples.to_numpy(), -rotation_deg) - true_positions_m
        valid_position_errors_m = error_m[is_known].ravel()
        scaled_parameters, _, rank, _ = np.linalg.lstsq(
            design_rows / column_scales, valid_position_errors_m, rcond=MIN_SINGULAR_VALUE_RATIO
        )
        if rank < len(column_scales):  # with a constant heading, a lever arm is an offset
            return None
        fitted_parameters = scaled_parameters / column_scales
        rotation_deg += float(np.degrees(fitted_parameters[-1]))
    residual_m = (valid_position_errors_m - design_rows @ fitted_parameters).reshape(-1, 2)
    # Successive errors of a source may be correlated
    variance_factor = max(map(compute_autocorrelation_time, residual_m.T))
    covariance = (
        np.linalg.inv(design_rows.T @ design_rows) * np.mean(residual_m**2) * variance_factor
    )
    lever_arm = _make_lever_arm(fitted_parameters, covariance, rotation_deg)
    min_length_m = max(
        MIN_LEVER_ARM_WITH_TRUTH_M, MIN_LEVER_ARM_SIGMAS_WITH_TRUTH * lever_arm.sigma_m
    )
    return (
        lever_arm
        if min_length_m < lever_arm.horizontal_length_m < MAX_REPORTED_LEVER_ARM_M
        else None
    )


def _make_lever_arm(parameters: Array, covariance: Array, rotation_deg: float) -> LeverArm:
    """Make a lever arm from the fitted parameters and their covariance.

    The first two parameters are the lever arm forward and right (m). The last row of ``covariance``
    is that of the rotation (rad).
    """
    forward_m, right_m = parameters[:2].tolist()
    return LeverArm(
        forward_m,
        right_m,
        float(np.sqrt(np.trace(covariance[:2, :2]))),
        rotation_deg,
        float(np.degrees(np.sqrt(covariance[-1, -1]))),
    )


def _rotate(vectors: Array, angle_deg: float) -> Array:
    """Rotate horizontal vectors (north, east), clockwise from above."""
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.asarray(vectors @ np.array([[cosine, sine], [-sine, cosine]]))


def _fit_lever_arm_to_imu(flight: Flight, track: PositionTrack) -> LeverArm | None:
    """Fit the second differences of the positions to those of the IMU, with a lever arm.

    Delay, accelerometer bias and rotation are fitted too. Each iteration corrects delay and
    rotation, and removes outliers.
    """
    inertial_data = integrate_inertial_data(flight)
    position_samples = track.samples[Columns.POSITION[:2]].dropna()
    if inertial_data is None or len(position_samples) < 2:
        return None
    attitude = inertial_data.compute_attitudes()["EKF2"]
    imu_motion = integrate_imu_motion(inertial_data, attitude)
    rotation = to_rotation_matrix(attitude)[:, :2, :2].reshape(-1, 4)
    rotation_second_differences = SourceSecondDifferences.from_positions(
        inertial_data.time_s, rotation, imu_motion.time_s
    ).second_differences.reshape(-1, 2, 2)
    imu_second_differences_m = imu_motion.table[:, :2, 0]
    # Derivatives of the second differences of the positions with respect to the fitted parameters
    design = np.concatenate(
        [
            rotation_second_differences,  # lever arm forward, right
            imu_motion.second_difference_derivative_m_s[:, :2, None],  # time shift
            imu_motion.table[:, :2, 1:],  # accelerometer bias forward, right, down
            _rotate(imu_second_differences_m, 90.0)[:, :, None],  # rotation
        ],
        axis=2,
    )
    time_s, is_used = position_samples.index.to_numpy(), imu_motion.is_valid
    rotation_deg = 0.0
    for _ in range(LEVER_ARM_FIT_COUNT):
        source_motion = SourceSecondDifferences.from_positions(
            time_s, _rotate(position_samples.to_numpy(), -rotation_deg), imu_motion.time_s
        )
        is_used = is_used & source_motion.is_valid
        second_difference_error_m = source_motion.second_differences - imu_second_differences_m
        design_rows = design[is_used].reshape(-1, design.shape[2])
        valid_second_difference_errors_m = second_difference_error_m[is_used].ravel()
        # A second difference spans two windows. Differences closer than this are correlated and
        # count as one
        independent_difference_count = (
            len(valid_second_difference_errors_m)
            * GRID_INTERVAL_S
            / (2.0 * SECOND_DIFFERENCE_WINDOW_S)
        )
        if independent_difference_count < 2 * design_rows.shape[1]:
            return None
        fitted_parameters = np.linalg.lstsq(
            design_rows, valid_second_difference_errors_m, rcond=None
        )[0]
        residual_m: Array = np.linalg.norm(
            second_difference_error_m - design @ fitted_parameters, axis=1
        )
        sigma_m = np.sqrt(np.mean(residual_m[is_used] ** 2) / 2.0)
        # Least-squares covariance, increased for correlated second differences
        covariance = (
            np.linalg.pinv(design_rows.T @ design_rows)
            * sigma_m**2
            * len(valid_second_difference_errors_m)
            / independent_difference_count
        )
        # Corrections for the next fit: no outliers, and corrected timestamps and rotation
        is_used &= residual_m < MAX_RESIDUAL_SIGMAS * sigma_m
        early_s = fitted_parameters[2]
        time_s = time_s + early_s
        rotation_deg += float(np.degrees(fitted_parameters[-1]))
    # The fitted lever arm is relative to the IMU, EKF2's parameters are relative to the vehicle's
    # origin: add the position of the IMU
    fitted_parameters[:2] += find_imu_position_m(flight)[:2]
    lever_arm = _make_lever_arm(fitted_parameters, covariance, rotation_deg)
    min_length_m = max(MIN_REPORTED_LEVER_ARM_M, MIN_LEVER_ARM_SIGMAS * lever_arm.sigma_m)
    return lever_arm if lever_arm.horizontal_length_m > min_length_m else None
