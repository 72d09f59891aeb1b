"""Segment of a trajectory that is the loop, and the true landing place."""

from dataclasses import replace

import numpy as np
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.closure import DOWN, heading_change_rad
from px4fuse.loop.model import TrueEnd
from px4fuse.request import Landing
from px4fuse.trajectory.model import MIN_POSES, Trajectory, by_axis

# s, m; averaging time of poses on the ground, and their largest range
REST_S = 1.0
REST_RANGE_M = 0.15
# a smaller heading change is assumed to be zero in truth
SAME_HEADING_DEG = 15.0


def cut_trajectory(trajectory: Trajectory, segment: Segment, at_rest: bool = False) -> Trajectory:
    """Cut a trajectory to a segment; poses on the ground at its ends are averaged.

    Raises
    ------
    TrajectoryError
        The segment contains fewer than three poses.
    """
    time = trajectory.time_s
    inside = (time >= segment.start_s) & (time <= segment.end_s)
    if inside.sum() < MIN_POSES:
        raise TrajectoryError(
            f"{trajectory.name}: only {int(inside.sum())} poses between {segment.start_s:.2f} s "
            f"and {segment.end_s:.2f} s (at least {MIN_POSES} are needed). The trajectory is from "
            f"{time[0]:.2f} s to {time[-1]:.2f} s."
        )
    part = trajectory[inside]
    if not at_rest:
        return part
    position = part.position_m.copy()
    quaternions = None if part.rotation is None else part.rotation.as_quat()
    for index, low in ((0, segment.start_s - REST_S), (-1, segment.end_s)):
        resting = trajectory[(time >= low) & (time <= low + REST_S)]
        # only if the vehicle is at rest
        if not len(resting) or np.linalg.norm(np.ptp(resting.position_m, axis=0)) > REST_RANGE_M:
            continue
        position[index] = resting.position_m.mean(axis=0)
        if quaternions is not None and resting.rotation is not None:
            quaternions[index] = resting.rotation.mean().as_quat()
    rotation = None if quaternions is None else Rotation.from_quat(quaternions)
    return replace(part, position_m=position, rotation=rotation)


def choose_loop_segment(
    flight: Flight | None, trajectory: Trajectory, start_s: float | None, end_s: float | None
) -> tuple[Segment, bool]:
    """Return the segment from take-off to landing; True if the vehicle rests at its ends.

    Parameters
    ----------
    flight : Flight or None
        Flight of the trajectory; without it the segment is the whole trajectory.
    start_s, end_s : float or None
        Override an end.

    Raises
    ------
    SettingsError
        The segment is empty.
    """
    low, high = span = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    at_rest = False
    if flight is None:
        reason = "the whole trajectory"
    elif isinstance(flight.airborne, Unavailable) or not flight.airborne:
        reason = "the whole track (no land detector in the log)"
    else:
        low, high = max(low, flight.airborne[0][0]), min(high, flight.airborne[-1][1])
        reason = "from take-off to landing, by the land detector"
        if len(flight.airborne) > 1:
            reason = f"from the first take-off to the last of {len(flight.airborne)} landings"
        at_rest = start_s is None and end_s is None
    if start_s is not None or end_s is not None:
        low, high = low if start_s is None else start_s, high if end_s is None else end_s
        reason = "chosen with --from or --to"
    if not low < high:
        raise SettingsError(
            f"No poses between {low:.12g} s and {high:.12g} s; the track is from "
            f"{span[0]:.2f} s to {span[1]:.2f} s.",
            "Change --from or --to.",
        )
    inside = max(low, span[0]), min(high, span[1])
    if inside != (low, high) and inside[0] < inside[1]:
        reason, (low, high) = f"{reason}, cut at the ends of the data", inside
    return Segment(low, high, reason), at_rest


def heading_change_deg(path: Trajectory) -> float | None:
    """Return final minus initial heading (°), clockwise; None without orientations."""
    if path.rotation is None:
        return None
    return float(np.degrees(heading_change_rad(path.rotation[-1] * path.rotation[0].inv())))


def assumed_end(path: Trajectory) -> TrueEnd:
    """Return the take-off place as landing place; equal heading if odometry nearly agrees."""
    change = heading_change_deg(path)
    same = change is not None and abs(change) <= SAME_HEADING_DEG
    heading = " with the same heading" if same else "; final heading unknown"
    return TrueEnd(
        displacement_m=by_axis(path.frame, np.zeros(3)),
        heading_change_deg=0.0 if same else None,
        sigma_m=0.10,
        sigma_heading_deg=5.0 if same else None,
        source=f"assumed: landing at the take-off place{heading}",
        assumed=True,
    )


def measured_end(path: Trajectory, landed: Landing) -> TrueEnd:
    """Return the landing place that was measured relative to the take-off place."""
    forward_m, right_m, turned_deg = structs.astuple(landed)
    heading = 0.0
    if path.rotation is not None:
        nose = path.rotation[0].apply([1.0, 0.0, 0.0])
        heading = float(np.arctan2(nose[1], nose[0]))
    ned_displacement_m = Rotation.from_rotvec(heading * DOWN).apply([forward_m, right_m, 0.0])
    return TrueEnd(
        displacement_m=by_axis(path.frame, ned_displacement_m),
        heading_change_deg=turned_deg,
        sigma_m=0.05,
        sigma_heading_deg=None if turned_deg is None else 2.0,
        source=f"measured: landing {abs(forward_m):g} m "
        f"{'behind' if forward_m < 0 else 'ahead'} and {abs(right_m):g} m "
        f"{'left' if right_m < 0 else 'right'} of the take-off place (--landed-at)",
        assumed=False,
    )


def true_end(path: Trajectory, truth: Trajectory, segment: Segment, at_rest: bool) -> TrueEnd | str:
    """Return the landing place by the ground truth in the log, or the reason why it is unknown.

    The ground truth is rotated into the odometry frame by the headings at the start.
    """
    try:
        true_path = cut_trajectory(truth, segment, at_rest)
    except TrajectoryError as error:
        return str(error)
    ned_displacement_m, change = true_path.position_m[-1] - true_path.position_m[0], None
    landed_m = np.linalg.norm(ned_displacement_m)
    if path.rotation is not None and true_path.rotation is not None:
        turn = heading_change_rad(path.rotation[0] * true_path.rotation[0].inv())
        ned_displacement_m = Rotation.from_rotvec(turn * DOWN).apply(ned_displacement_m)
        change = heading_change_deg(true_path)
    elif path.frame != true_path.frame:
        return (
            "the ground truth has no orientation, so it cannot be rotated into the odometry frame"
        )
    return TrueEnd(
        displacement_m=by_axis(path.frame, ned_displacement_m),
        heading_change_deg=change,
        sigma_m=0.02,
        sigma_heading_deg=None if change is None else 0.5,
        source=f"ground truth in the log ({truth.name}): landing {landed_m:.2f} m from the "
        "take-off place",
        assumed=False,
    )
