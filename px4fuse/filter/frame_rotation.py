"""Misalignment in yaw between the position source's frame and EKF2's heading, over the flight.

Indoors, a disturbed magnetometer may rotate EKF2's heading by tens of degrees within one flight.
The misalignment is estimated from orientations of the source, or from positions and IMU data. A
chi-square test decides if it changes in flight.
"""

from typing import Literal

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.special import chdtrc

from px4fuse.core.arrays import Array, compute_median_interval_s
from px4fuse.core.record import NonNegativeFloat, Record, Share
from px4fuse.flight.model import Columns, Flight, PositionTrack, Unavailable
from px4fuse.trajectory.rotation import heading

from .fitting import NoiseParameters, fit_constant_errors, maximise_likelihood
from .imu_motion import (
    HEADING_INDEX_IN_CONSTANT_ERRORS,
    MAX_IMU_INTERVAL_S,
    MIN_SEGMENT_MEASUREMENTS,
    MotionCache,
    PositionsAndImuMotion,
    compute_imu_motion,
)
from .settings import Settings
from .signals import Segment, cut_to_segment, report_too_few_measurements

# Duration (s) of each flight part if the heading error is estimated from orientations
FLIGHT_PART_DURATION_S = 2.0
# Fit of the heading error to positions and IMU data: duration (s) of each flight part
HEADING_FIT_DURATION_S = 15.0
# Fit of the heading error to positions and IMU data: minimum duration (s) of a flight part
MIN_HEADING_FIT_DURATION_S = 5.0
MIN_FLIGHT_PART_COUNT = 3
MIN_MEASUREMENTS = 50
MIN_FLIGHT_PART_SAMPLES = 3
MAX_MEASUREMENTS = 1000
# The heading error changes in flight if the p-value of a constant error is below this limit
MAX_DRIFT_P_VALUE = 0.002
# Minimum reported change (°) of the heading error in flight
MIN_HEADING_DRIFT_DEG = 5.5
# Maximum yaw rate (°/s) at which the headings of source and EKF2 are compared: a delay of 0.2 s
# causes 2° error
MAX_YAW_RATE_DEG_S = 10.0
# Minimum σ (°) of a heading difference between source and EKF2
MIN_HEADING_SIGMA_DEG = 0.5
# Maximum median interval (s) of the logged attitude
MAX_ATTITUDE_INTERVAL_S = 0.11
MAX_HEADING_FIT_ITERATIONS = 5
# Convergence limit (rad) for the change of the heading error in one iteration
MAX_HEADING_CHANGE_AT_CONVERGENCE_RAD = 0.01
# Prior σ (rad) of the heading error
HEADING_SIGMA_RAD = 1.0
# Lower limit of the estimated ratio of true to measured distances, which is a divisor
MIN_TRUE_TO_MEASURED_SCALE = 0.1


class HeadingErrorInPart(Record):
    """Heading error (°) in one part of the flight: yaw of the source frame relative to EKF2."""

    start_s: float
    end_s: float
    heading_error_deg: float
    sigma_deg: NonNegativeFloat


class HeadingError(Record):
    """Misalignment in yaw between the position source's frame and the logged attitude.

    Attributes
    ----------
    misalignment_deg, sigma_deg : float
        Mean angle over the flight, and its σ.
    drifts : bool
        True if the angle changes significantly in flight.
    parts : tuple of HeadingErrorInPart
        Angles in consecutive parts of the flight, clockwise from above.
    drift_p : float
        p-value of the test for a constant angle.
    by : {"orientation", "positions"}
        Data of the position source that give the angle.
    """

    misalignment_deg: float
    sigma_deg: NonNegativeFloat
    drifts: bool
    parts: tuple[HeadingErrorInPart, ...]
    drift_p: Share
    by: Literal["orientation", "positions"]

    def find_extreme_parts(self) -> list[HeadingErrorInPart]:
        """Return flight parts with the smallest and the largest misalignment, in time order."""
        sorted_parts = sorted(self.parts, key=lambda part: part.heading_error_deg)
        return sorted((sorted_parts[0], sorted_parts[-1]), key=lambda part: part.start_s)


def combine_heading_parts(
    parts: tuple[HeadingErrorInPart, ...],
    drift_p_value: float,
    method: Literal["orientation", "positions"],
) -> HeadingError:
    """Combine the heading errors of all parts of a flight: mean, σ, and drift."""
    heading_errors_deg = [heading_part.heading_error_deg for heading_part in parts]
    return HeadingError(
        misalignment_deg=float(np.mean(heading_errors_deg)),
        sigma_deg=float(np.mean([heading_part.sigma_deg for heading_part in parts])),
        drifts=drift_p_value < MAX_DRIFT_P_VALUE
        and max(heading_errors_deg) - min(heading_errors_deg) >= MIN_HEADING_DRIFT_DEG,
        parts=parts,
        drift_p=drift_p_value,
        by=method,
    )


def estimate_heading_error(  # noqa: PLR0911 (one return per missing input)
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    sigma_z_m: float,
    offset_s: float = 0.0,
) -> HeadingError | Unavailable:
    """Estimate the misalignment in yaw between the position source's frame and the attitude.

    If the yaw of the source's orientations drifts relative to the attitude, the estimate is from
    these orientations. A constant yaw difference can be the mounting angle of the source, which is
    unknown. Without a drift, the estimate is therefore from the positions and the IMU.

    Parameters
    ----------
    settings : Settings
        ``sigma_a_m_s2`` is the initial value of the acceleration noise.
    sigma_z_m : float
        Initial value of the position noise.
    offset_s : float
        Time offset added to the timestamps of the track.
    """
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if (interval_s := compute_median_interval_s(flight.attitude.index)) > MAX_ATTITUDE_INTERVAL_S:
        return Unavailable(
            "heading error",
            f"the attitude is logged at only {1.0 / interval_s:.1f} Hz",
            "Log the attitude at 10 Hz or more.",
        )
    orientation_heading_error = None
    if track.orientation is not None:
        orientation_heading_error = _compare_orientations(
            flight.attitude, track.orientation, segment, offset_s
        )
        if orientation_heading_error is not None and orientation_heading_error.drifts:
            return orientation_heading_error
    if isinstance(flight.imu, Unavailable):
        return flight.imu
    if (interval_s := compute_median_interval_s(flight.imu.index)) > MAX_IMU_INTERVAL_S:
        return Unavailable(
            "heading error",
            f"the IMU is logged at only {1.0 / interval_s:.1f} Hz",
            "Log sensor_combined at full rate.",
        )
    position_samples = cut_to_segment(track.samples, segment)[Columns.POSITION[:2]].dropna()
    if len(position_samples) < MIN_MEASUREMENTS:
        return report_too_few_measurements("heading error", len(position_samples), MIN_MEASUREMENTS)
    position_samples = position_samples.iloc[
        :: int(np.ceil(len(position_samples) / MAX_MEASUREMENTS))
    ]
    position_samples = position_samples.set_axis(position_samples.index.to_numpy() + offset_s)
    noise_parameters = NoiseParameters(settings.sigma_a_m_s2, sigma_z_m)
    # The mounting angle of the source is unknown, so its orientations show only changes of yaw
    return _estimate_heading_error_from_positions(
        flight,
        position_samples,
        noise_parameters,
        settings.dt_s,
        has_constant_heading=orientation_heading_error is not None,
    )


def _average_flight_parts(
    time_s: Array, misalignment_rad: Array, sigma_rad: float
) -> tuple[HeadingErrorInPart, ...]:
    """Average yaw misalignment (rad) over flight parts of equal duration.

    σ is not reduced by averaging, because errors in one part are correlated.
    """
    # At a low sample rate, the flight parts are longer, so that they contain enough samples
    part_count = max(
        int(
            min(
                (time_s[-1] - time_s[0]) / FLIGHT_PART_DURATION_S,
                len(time_s) / (2 * MIN_FLIGHT_PART_SAMPLES),
            )
        ),
        1,
    )
    part_edges_s = np.linspace(time_s[0], time_s[-1], part_count + 1)[1:-1]
    rows_by_part = np.split(np.arange(len(time_s)), np.searchsorted(time_s, part_edges_s))
    return tuple(
        HeadingErrorInPart(
            start_s=float(time_s[part_rows[0]]),
            end_s=float(time_s[part_rows[-1]]),
            heading_error_deg=float(np.degrees(misalignment_rad[part_rows].mean())),
            sigma_deg=float(np.degrees(sigma_rad)),
        )
        for part_rows in rows_by_part
        if len(part_rows) >= MIN_FLIGHT_PART_SAMPLES
    )


def heading_rad(quaternions: pd.DataFrame) -> Array:
    """Return the headings (rad, clockwise from above, without jumps by 2π) of an attitude table."""
    return heading(quaternions[Columns.QUATERNION].to_numpy())


def _compare_orientations(
    attitude: pd.DataFrame, orientation: pd.DataFrame, segment: Segment, offset_s: float
) -> HeadingError | None:
    """Compare the position source's heading with EKF2's; None if there are too few samples."""
    orientation_samples = cut_to_segment(orientation, segment)
    time_s = orientation_samples.index.to_numpy() + offset_s
    attitude_time_s = attitude.index.to_numpy()
    is_covered = (time_s >= attitude_time_s[0]) & (time_s <= attitude_time_s[-1])
    if np.count_nonzero(is_covered) < MIN_FLIGHT_PART_COUNT * MIN_FLIGHT_PART_SAMPLES:
        return None
    source_yaw_rad = heading_rad(orientation_samples)[is_covered]
    time_s = time_s[is_covered]
    ekf2_yaw_rad = np.interp(time_s, attitude_time_s, heading_rad(attitude))
    misalignment_rad = source_yaw_rad - ekf2_yaw_rad
    misalignment_rad -= 2.0 * np.pi * np.round(np.median(misalignment_rad) / (2.0 * np.pi))
    has_low_yaw_rate = np.abs(np.gradient(ekf2_yaw_rad, time_s)) < np.radians(MAX_YAW_RATE_DEG_S)
    if np.count_nonzero(has_low_yaw_rate) < MIN_FLIGHT_PART_COUNT * MIN_FLIGHT_PART_SAMPLES:
        return None
    time_s = time_s[has_low_yaw_rate]
    misalignment_rad = misalignment_rad[has_low_yaw_rate]
    # Robust σ from the differences of successive samples
    noise_sigma_rad = 1.4826 * np.median(np.abs(np.diff(misalignment_rad))) / np.sqrt(2.0)
    sigma_rad = max(float(noise_sigma_rad), np.radians(MIN_HEADING_SIGMA_DEG))
    heading_errors_of_parts = _average_flight_parts(time_s, misalignment_rad, sigma_rad)
    if len(heading_errors_of_parts) < MIN_FLIGHT_PART_COUNT:
        return None
    heading_errors_deg = [part.heading_error_deg for part in heading_errors_of_parts]
    part_count = len(heading_errors_deg)
    chi_square = part_count * np.var(heading_errors_deg) / np.degrees(sigma_rad) ** 2
    return combine_heading_parts(
        heading_errors_of_parts, float(chdtrc(part_count - 1, chi_square)), "orientation"
    )


def _estimate_heading_error_from_positions(
    flight: Flight,
    position_samples: pd.DataFrame,
    noise_parameters: NoiseParameters,
    dt_s: float,
    *,
    has_constant_heading: bool,
) -> HeadingError | Unavailable:
    """Estimate the heading error of each part of the flight from positions and IMU.

    With ``has_constant_heading``, all parts have equal heading errors.
    """
    time_s = position_samples.index.to_numpy()
    fit_duration_s = max(
        HEADING_FIT_DURATION_S, 2 * MIN_SEGMENT_MEASUREMENTS * compute_median_interval_s(time_s)
    )
    motion_cache = MotionCache()
    # 1. Mean heading error. The fit is linear in the heading error, so it is repeated with
    # positions that are rotated back by the estimate
    misalignment_rad = 0.0
    for _ in range(MAX_HEADING_FIT_ITERATIONS):
        cosine, sine = np.cos(misalignment_rad), np.sin(misalignment_rad)
        motion = compute_imu_motion(
            flight,
            time_s,
            position_samples.to_numpy() @ np.array([[cosine, -sine], [sine, cosine]]),
            axis_directions=np.eye(3)[:2],
            dt_s=dt_s,
            motion_cache=motion_cache,
            heading_sigma_rad=HEADING_SIGMA_RAD,
            max_segment_duration_s=fit_duration_s,
        )
        if isinstance(motion, Unavailable):
            return structs.replace(motion, what="heading error")
        spans_s = motion.time_s[
            np.column_stack([motion.segment_edges[:-1], motion.segment_edges[1:] - 1])
        ]
        is_part_long_enough = np.ptp(spans_s, axis=1) >= MIN_HEADING_FIT_DURATION_S
        if not is_part_long_enough.any():
            return Unavailable(
                "heading error",
                "the longest part of the flight without an IMU gap is shorter than "
                f"{MIN_HEADING_FIT_DURATION_S:g} s",
                "Analyse a longer segment.",
            )
        noise_parameters, error_rad, heading_variance_rad2 = _fit_heading_errors(
            motion, noise_parameters
        )
        error_rad = error_rad[is_part_long_enough]
        heading_variance_rad2 = heading_variance_rad2[is_part_long_enough]
        correction_rad, weight_sum = np.average(
            error_rad, weights=1.0 / heading_variance_rad2, returned=True
        )
        misalignment_rad += float(correction_rad)
        if abs(correction_rad) < MAX_HEADING_CHANGE_AT_CONVERGENCE_RAD:
            break
    # Deviation of each flight part from the mean heading error. Variance due to drift: variance of
    # the deviations minus their noise variance
    deviation_rad = error_rad - correction_rad
    drift_variance_rad2 = 0.0
    if not has_constant_heading:
        drift_variance_rad2 = max(float(np.mean(deviation_rad**2 - heading_variance_rad2)), 0.0)
    # The larger the noise variance of a flight part, the more its estimate is moved to the mean
    # heading error
    weight_of_part_estimate = drift_variance_rad2 / (drift_variance_rad2 + heading_variance_rad2)
    misalignment_rad = float(np.angle(np.exp(1j * misalignment_rad)))
    # One row for each flight part: start, end, heading error, σ
    heading_part_fields = np.column_stack(
        [
            spans_s[is_part_long_enough],
            np.degrees(misalignment_rad + weight_of_part_estimate * deviation_rad),
            np.degrees(np.sqrt(1.0 / weight_sum + weight_of_part_estimate * heading_variance_rad2)),
        ]
    )
    # 3. Test for a constant heading error
    chi_square = float(np.sum(deviation_rad**2 / heading_variance_rad2))
    is_drift_tested = len(heading_variance_rad2) > 1 and not has_constant_heading
    return combine_heading_parts(
        tuple(HeadingErrorInPart(*row) for row in heading_part_fields.tolist()),
        float(chdtrc(len(heading_variance_rad2) - 1, chi_square)) if is_drift_tested else 1.0,
        "positions",
    )


def _fit_heading_errors(
    motion: PositionsAndImuMotion, noise_parameters: NoiseParameters
) -> tuple[NoiseParameters, Array, Array]:
    """Fit the noises; return them, and heading error (rad) and variance (rad²) of each segment."""
    positions_and_increments = motion.make_positions_at_offset(0.0)
    # A scale factor error adds a multiple of the motion to the increments, and a small heading
    # error a multiple of the motion rotated by 90°. The motion is that of a smooth path through the
    # positions: noise in the IMU motion would make the estimates too small
    for increments in (
        positions_and_increments.delta_position_m,
        positions_and_increments.delta_velocity_m_s,
    ):
        north_m, east_m = increments[:, :, -1]
        increments[:, :, 1 + HEADING_INDEX_IN_CONSTANT_ERRORS] = -east_m, north_m
    noise_parameters = maximise_likelihood(
        [positions_and_increments],
        noise_parameters,
        motion.measurement_weights,
        fits_outliers=False,
    ).noise_parameters
    position_fit = fit_constant_errors(
        [positions_and_increments], noise_parameters, motion.measurement_weights
    )
    constant_errors = position_fit.estimate_constant_errors_by_segment()[:, 0]
    covariance = np.linalg.inv(position_fit.compute_constant_error_information())[:, 0]
    # The derivative with respect to the heading error contains measured distances instead of true
    # ones. The heading error is therefore divided by true ÷ measured distance. This ratio is 1
    # minus the scale factor error, which is the last constant error
    true_to_measured_scale = np.maximum(1.0 - constant_errors[:, -1], MIN_TRUE_TO_MEASURED_SCALE)
    return (
        noise_parameters,
        constant_errors[:, HEADING_INDEX_IN_CONSTANT_ERRORS] / true_to_measured_scale,
        covariance[:, HEADING_INDEX_IN_CONSTANT_ERRORS, HEADING_INDEX_IN_CONSTANT_ERRORS]
        / true_to_measured_scale**2,
    )
