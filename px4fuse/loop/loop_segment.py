"""Start, end and true final pose of a loop."""

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.request import Landing
from px4fuse.trajectory.model import (
    MIN_POSES,
    Trajectory,
    compute_extent_m,
    format_vector,
    split_by_axis,
)

from .closure import DOWN_DIRECTION, compute_heading_change_rad
from .model import TrueFinalPose

# Time (s) over which poses are averaged on the ground
REST_DURATION_S = 1.0
# Maximum extent (m) of the positions of a vehicle at rest
MAX_POSITION_EXTENT_AT_REST_M = 0.15
# If odometry measures at most this heading change (°) from take-off to landing, the true heading
# change is assumed to be zero
MAX_HEADING_CHANGE_ASSUMED_ZERO_DEG = 15.0


def cut_trajectory(trajectory: Trajectory, segment: Segment) -> Trajectory:
    """Return the part of a trajectory in a time segment.

    In a segment from take-off to landing, poses on the ground are averaged at both ends.

    Raises
    ------
    TrajectoryError
        The segment contains fewer than three poses.
    """
    time_s = trajectory.time_s
    segment_track = trajectory.cut_to_span(segment.start_s, segment.end_s)
    if len(segment_track) < MIN_POSES:
        raise TrajectoryError(
            f"{trajectory.name} ({time_s[0]:.2f} to {time_s[-1]:.2f} s) has {len(segment_track)} "
            f"poses from {segment.start_s:.2f} to {segment.end_s:.2f} s; {MIN_POSES} are needed"
        )
    if segment.flight_span_s is None:
        return segment_track
    # The selected poses are copies, so changes do not affect ``trajectory``
    for index, rest_start_s in ((0, segment.start_s - REST_DURATION_S), (-1, segment.end_s)):
        poses_at_rest = trajectory.cut_to_span(rest_start_s, rest_start_s + REST_DURATION_S)
        if not len(poses_at_rest):
            continue
        # If the vehicle moves, no mean is computed
        if compute_extent_m(poses_at_rest.position_m) <= MAX_POSITION_EXTENT_AT_REST_M:
            segment_track.position_m[index] = poses_at_rest.position_m.mean(axis=0)
            if segment_track.rotation is not None and poses_at_rest.rotation is not None:
                segment_track.rotation[index] = poses_at_rest.rotation.mean()
    return segment_track


def choose_loop_segment(
    flight: Flight | None, trajectory: Trajectory, start_s: float | None, end_s: float | None
) -> Segment:
    """Return the time span of a loop: the given span, or from take-off to landing.

    Parameters
    ----------
    flight : Flight or None
        Flight with take-off and landing times.
    start_s, end_s : float or None
        Start and end from the user.

    Raises
    ------
    SettingsError
        The trajectory has no poses in the segment.
    """
    if start_s is not None and end_s is not None and end_s <= start_s:
        raise SettingsError(
            f"The end ({end_s:.12g} s) is not after the start ({start_s:.12g} s).",
            "Change --from or --to.",
        )
    track_start_s, track_end_s = trajectory.time_s[[0, -1]].tolist()
    segment_start_s, segment_end_s = track_start_s, track_end_s
    flight_span_s = None
    if flight is None:
        reason = "the whole trajectory"
    elif isinstance(flight.airborne, Unavailable) or not flight.airborne:
        reason = "the whole trajectory, because the log contains no detected take-off"
    else:
        take_off_s, landing_s = flight_span_s = flight.airborne[0][0], flight.airborne[-1][1]
        segment_start_s = max(segment_start_s, take_off_s)
        segment_end_s = min(segment_end_s, landing_s)
        reason = "from take-off to landing, by the land detector"
        if len(flight.airborne) > 1:
            reason = f"from the first take-off to the last of {len(flight.airborne)} landings"
    if start_s is not None or end_s is not None:
        segment_start_s = segment_start_s if start_s is None else start_s
        segment_end_s = segment_end_s if end_s is None else end_s
        flight_span_s = None
        reason = "the time span was chosen with --from or --to"
    limited_span_s = max(segment_start_s, track_start_s), min(segment_end_s, track_end_s)
    if not limited_span_s[0] < limited_span_s[1]:
        raise SettingsError(
            f"The track ({track_start_s:.2f} to {track_end_s:.2f} s) has no poses between "
            f"{segment_start_s:.12g} s and {segment_end_s:.12g} s.",
            "Change --from or --to.",
        )
    if limited_span_s != (segment_start_s, segment_end_s):
        reason += "; times without poses are omitted"
    return Segment(*limited_span_s, reason, flight_span_s)


def compute_heading_change_deg(path: Trajectory) -> float | None:
    """Return the final heading minus the initial heading (°), clockwise, if known."""
    if path.rotation is None:
        return None
    return float(np.degrees(compute_heading_change_rad(path.rotation[-1] * path.rotation[0].inv())))


def assume_landing_at_takeoff(path: Trajectory) -> TrueFinalPose:
    """Return the true final pose if the vehicle landed at the take-off place.

    For a small heading change of odometry, the true heading change is assumed to be zero.
    """
    odometry_heading_change_deg = compute_heading_change_deg(path)
    is_same_heading = (
        odometry_heading_change_deg is not None
        and abs(odometry_heading_change_deg) <= MAX_HEADING_CHANGE_ASSUMED_ZERO_DEG
    )
    return TrueFinalPose(
        displacement_m=split_by_axis(path.frame, np.zeros(3)),
        heading_change_deg=0.0 if is_same_heading else None,
        sigma_m=0.10,
        sigma_heading_deg=5.0 if is_same_heading else None,
        source="assumption: the vehicle landed at the take-off place"
        f"{' with the initial heading' if is_same_heading else ''}",
        assumed=True,
    )


def convert_measured_final_pose(path: Trajectory, landing: Landing) -> TrueFinalPose:
    """Convert the measured landing place to the frame of the trajectory."""
    forward_m, right_m, heading_change_deg = structs.astuple(landing)
    heading_rad = 0.0
    if path.rotation is not None:
        nose_direction = path.rotation[0].apply([1.0, 0.0, 0.0])
        heading_rad = float(np.arctan2(nose_direction[1], nose_direction[0]))
    displacement_m = Rotation.from_rotvec(heading_rad * DOWN_DIRECTION).apply(
        [forward_m, right_m, 0.0]
    )
    return TrueFinalPose(
        displacement_m=split_by_axis(path.frame, displacement_m),
        heading_change_deg=heading_change_deg,
        sigma_m=0.05,
        sigma_heading_deg=None if heading_change_deg is None else 2.0,
        source="landing place relative to take-off, measured by the user: "
        f"{format_vector({'forward': forward_m, 'right': right_m})} (--landed-at)",
        assumed=False,
    )


def find_final_pose_in_truth(
    path: Trajectory, truth: Trajectory, segment: Segment
) -> TrueFinalPose | str:
    """Return the true final pose from ground truth, or the reason why it is unknown."""
    try:
        true_path = cut_trajectory(truth, segment)
    except TrajectoryError as error:
        return str(error)
    displacement_m = true_path.position_m[-1] - true_path.position_m[0]
    true_heading_change_deg = None
    start_to_landing_distance_m = np.linalg.norm(displacement_m)
    if path.rotation is not None and true_path.rotation is not None:
        heading_difference_rad = compute_heading_change_rad(
            path.rotation[0] * true_path.rotation[0].inv()
        )
        displacement_m = Rotation.from_rotvec(heading_difference_rad * DOWN_DIRECTION).apply(
            displacement_m
        )
        true_heading_change_deg = compute_heading_change_deg(true_path)
    elif path.frame != true_path.frame:
        return (
            "the ground truth cannot be rotated to the odometry frame without orientations of both"
        )
    return TrueFinalPose(
        displacement_m=split_by_axis(path.frame, displacement_m),
        heading_change_deg=true_heading_change_deg,
        sigma_m=0.02,
        sigma_heading_deg=None if true_heading_change_deg is None else 0.5,
        source=f"from ground truth in the log ({truth.name}): landing "
        f"{start_to_landing_distance_m:.2f} m from the take-off place",
        assumed=False,
    )
