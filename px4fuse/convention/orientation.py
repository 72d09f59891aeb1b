"""Determination of the quaternion order, body frame and world frame of a source's orientation.

Each possible convention is compared with the attitude from the gyroscopes.
"""

import math
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from px4fuse.core.arrays import Array
from px4fuse.ekf2.replay import is_inside_spans
from px4fuse.trajectory.rotation import (
    from_rotation_vector,
    heading,
    interpolate,
    multiply,
    to_rotation_matrix,
)

from .model import BodyAndWorldFrame, OrientationConvention, QuaternionOrder
from .motion import InertialData

IDENTITY_QUATERNION = np.array([1.0, 0.0, 0.0, 0.0])
# Quaternion (w, x, y, z) of half a turn about x, from FLU to FRD
FLU_TO_FRD = np.array([0.0, 1.0, 0.0, 0.0])
# Quaternion (w, x, y, z) from ENU to NED
ENU_TO_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
# Quaternions to NED and to FRD, by body frame and world frame of the orientation
QUATERNIONS_BY_FRAMES: Final[dict[BodyAndWorldFrame, tuple[Array, Array]]] = {
    "FRD to NED": (IDENTITY_QUATERNION, IDENTITY_QUATERNION),
    "FLU to ENU": (ENU_TO_NED, FLU_TO_FRD),
    "FLU to NWU": (FLU_TO_FRD, FLU_TO_FRD),
    "FLU to NED": (IDENTITY_QUATERNION, FLU_TO_FRD),
    "FRD to ENU": (ENU_TO_NED, IDENTITY_QUATERNION),
}
QUATERNION_ORDERS: tuple[QuaternionOrder, QuaternionOrder] = ("w x y z", "x y z w")
# If the median difference (°) from EKF2's attitude is smaller, the orientation is a copy of EKF2's
# attitude. Orientations from motion capture differ by 0.2° or more
MAX_DIFFERENCE_OF_ATTITUDE_COPY_DEG = 0.15
# Tested delays (s) of an orientation that may be a copy of EKF2's attitude
COPY_DELAYS_S = np.arange(0.0, 0.205, 0.01)
# Convention of an orientation: quaternion order and frames. If the median tilt difference (°)
# between orientation and gyroscope attitude exceeds this value even with the best convention, the
# orientation is unrelated to the vehicle's attitude
MAX_TILT_DIFFERENCE_DEG = 6.0
# If the median heading difference (°) between orientation and gyroscope attitude exceeds this value
# even with the best convention (quaternion order, frames), the orientation is unrelated to the
# vehicle's attitude
MAX_HEADING_DIFFERENCE_DEG = 12.0
# The score of a convention (quaternion order, frames) is larger for smaller median angles (°)
# between orientation and reference attitude. Angles below this value count as this value, because
# smaller ones are noise
ANGLE_DIFFERENCE_FLOOR_DEG = 0.7
# The score of a convention (quaternion order, frames) contains -weight · duration (s) · (ln(median
# tilt difference) + ln(median heading difference)), with this weight
ANGLE_DIFFERENCE_WEIGHT_PER_S = 0.5
# For the verdict "determined", the score of the best convention (quaternion order, frames) must
# exceed that of the second best by this value
MIN_CONVENTION_SCORE_LEAD = 4.0
MAX_TESTED_ORIENTATIONS = 600
MIN_TESTED_ORIENTATIONS = 20


class OrientationCandidate(NamedTuple):
    """Possible convention of an orientation, with its difference from the reference attitude."""

    convention: OrientationConvention
    heading_difference_deg: float
    score: float

    @property
    def order_and_frames_up_to_heading(self) -> tuple[str, str]:
        """Quaternion order and frames; frames that differ only in heading are not distinguished.

        For example, ENU and NWU differ only in heading, so ENU is replaced by NWU.
        """
        return self.convention.order, self.convention.frames.replace("ENU", "NWU")


def determine_orientation_convention(
    inertial_data: InertialData, time_s: Array, quaternion: Array
) -> tuple[OrientationConvention, Array, Array] | None:
    """Determine the quaternion order and frames of a source's orientation.

    Returns
    -------
    convention : OrientationConvention
        Convention without ``heading_error_deg``.
    time_s : ndarray, shape (m,)
        Times (s) of the compared orientations.
    attitude : ndarray, shape (m, 4)
        Orientations converted to quaternions (w, x, y, z; FRD to NED).

    Return None for fewer than MIN_TESTED_ORIENTATIONS orientations.
    """
    flight_rows = np.flatnonzero(is_inside_spans(time_s, inertial_data.valid_spans_s))
    if len(flight_rows) < MIN_TESTED_ORIENTATIONS:
        return None
    flight_rows = flight_rows[:: math.ceil(len(flight_rows) / MAX_TESTED_ORIENTATIONS)]
    sample_times_s, sent_quaternions = time_s[flight_rows], quaternion[flight_rows]
    sent_quaternions = sent_quaternions / np.linalg.norm(sent_quaternions, axis=1, keepdims=True)
    for delay_s in COPY_DELAYS_S:
        logged_attitude = interpolate(
            sample_times_s - delay_s, inertial_data.time_s, inertial_data.logged_attitude
        )
        # |q1 · q2| is the cosine of half the angle between two attitudes
        half_angle_cosine = np.median(np.abs(np.sum(sent_quaternions * logged_attitude, axis=1)))
        if half_angle_cosine > np.cos(np.radians(MAX_DIFFERENCE_OF_ATTITUDE_COPY_DEG) / 2.0):
            return OrientationConvention(verdict="copied"), sample_times_s, sent_quaternions
    reference_attitude = interpolate(
        sample_times_s, inertial_data.time_s, inertial_data.gyro_attitude
    )
    candidates = [
        _score_convention(
            sample_times_s, sent_quaternions, reference_attitude, order, frames, quarter_turns
        )
        for order, frames, quarter_turns in product(
            QUATERNION_ORDERS, QUATERNIONS_BY_FRAMES, range(4)
        )
    ]
    best_candidate = max(candidates, key=lambda candidate: candidate.score)
    # Conventions (quaternion order, frames) that differ only in heading are not alternatives: the
    # heading error is determined with the positions
    second_best_score = max(
        candidate.score
        for candidate in candidates
        if candidate.order_and_frames_up_to_heading != best_candidate.order_and_frames_up_to_heading
    )
    orientation_convention = best_candidate.convention
    if (
        orientation_convention.tilt_difference_deg > MAX_TILT_DIFFERENCE_DEG
        or best_candidate.heading_difference_deg > MAX_HEADING_DIFFERENCE_DEG
    ):
        orientation_convention = replace(orientation_convention, verdict="unrelated")
    elif best_candidate.score - second_best_score < MIN_CONVENTION_SCORE_LEAD:
        orientation_convention = replace(orientation_convention, verdict="ambiguous")
    return (
        orientation_convention,
        sample_times_s,
        convert_to_attitude(sent_quaternions, orientation_convention),
    )


def convert_to_attitude(sent_quaternions: Array, convention: OrientationConvention) -> Array:
    """Convert an orientation as sent to the attitude (w, x, y, z; FRD to NED)."""
    world_rotation, body_rotation = QUATERNIONS_BY_FRAMES[convention.frames]
    w_first_quaternions = (
        sent_quaternions if convention.order == "w x y z" else np.roll(sent_quaternions, 1, 1)
    )
    return multiply(multiply(world_rotation, w_first_quaternions), body_rotation)


def _score_convention(
    time_s: Array,
    sent_quaternions: Array,
    reference_attitude: Array,
    order: QuaternionOrder,
    frames: BodyAndWorldFrame,
    body_quarter_turns: int,
) -> OrientationCandidate:
    """Score one convention of the quaternions by their distance from the reference attitude.

    The score is a log likelihood plus log prior odds (nats). Orientation errors are correlated, so
    the number of independent samples is proportional to the duration. A constant heading difference
    is allowed: the positions determine the heading error.
    """
    convention = OrientationConvention(verdict="determined", order=order, frames=frames)
    # The sensor can be mounted with a yaw of a multiple of 90°
    body_rotation = from_rotation_vector(np.array([0.0, 0.0, body_quarter_turns * np.pi / 2.0]))
    attitude = multiply(convert_to_attitude(sent_quaternions, convention), body_rotation)
    # Heading differences, relative to their mean. Unit complex numbers give the mean of angles
    heading_difference_phasor = np.exp(1j * (heading(attitude) - heading(reference_attitude)))
    mean_heading_difference_rad = np.angle(np.mean(heading_difference_phasor))
    heading_difference_rad = np.abs(
        np.angle(heading_difference_phasor * np.exp(-1j * mean_heading_difference_rad))
    )
    # Tilt: angle between the vertical directions in the body frame, which are the third rows of the
    # rotation matrices
    tilt_difference_cosine = np.sum(
        to_rotation_matrix(attitude)[:, 2] * to_rotation_matrix(reference_attitude)[:, 2], axis=1
    )
    tilt_difference_rad = np.arccos(np.clip(tilt_difference_cosine, -1.0, 1.0))
    tilt_difference_deg, heading_difference_deg = np.degrees(
        np.median([tilt_difference_rad, heading_difference_rad], axis=1)
    ).tolist()
    # Log likelihood: -(number of independent samples) · (ln(median tilt difference) + ln(median
    # heading difference)). The number of samples is proportional to the duration
    log_angle_differences = np.log(
        np.maximum([tilt_difference_deg, heading_difference_deg], ANGLE_DIFFERENCE_FLOOR_DEG)
    )
    score = (
        -ANGLE_DIFFERENCE_WEIGHT_PER_S * (time_s[-1] - time_s[0]) * np.sum(log_angle_differences)
    )
    # Assumed log prior odds (nats): PX4's convention, and a sensor without rotation or heading
    # error, are more probable
    if order != "w x y z":
        score -= 4.0
    if frames != "FRD to NED":
        score -= 2.0
    if body_quarter_turns:
        score -= 2.0
    if abs(mean_heading_difference_rad) > np.radians(8.0):
        score -= 1.0
    convention = replace(convention, tilt_difference_deg=tilt_difference_deg)
    return OrientationCandidate(convention, heading_difference_deg, score)
