"""Which part of a trajectory is the loop, and where the vehicle really ended."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.closure import DOWN, heading_change_rad, upright
from px4fuse.trajectory.model import MIN_POSES, Trajectory

# Poses on the ground are averaged over this long, if they stay within this far of each other
REST_S = 1.0
REST_RANGE_M = 0.15
# A vehicle that ends within this of its first heading was set down as it stood
SAME_HEADING_DEG = 15.0


@dataclass(frozen=True)
class KnownEnd:
    """Where the vehicle really ended, seen from where it began.

    Attributes
    ----------
    displacement_m : tuple of float
        In the frame of the trajectory.
    heading_change_deg : float or None
        From the first heading to the last, clockwise; None where it is not known.
    sigma_m, sigma_heading_deg : float
        Standard deviations.
    source : str
        Who says so.
    assumed : bool
        Whether nobody knows.
    """

    displacement_m: tuple[float, float, float]
    heading_change_deg: float | None
    sigma_m: float
    sigma_heading_deg: float
    source: str
    assumed: bool = False


def part_of(trajectory: Trajectory, segment: Segment, at_rest: bool = False) -> Trajectory:
    """The poses of a part of a trajectory; those on the ground at its ends averaged into one.

    Raises
    ------
    TrajectoryError
        Fewer than three poses are in the part.
    """
    time = trajectory.time_s
    inside = (time >= segment.start_s) & (time <= segment.end_s)
    if inside.sum() < MIN_POSES:
        raise TrajectoryError(
            f"{trajectory.name}: {int(inside.sum())} poses between {segment.start_s:.2f} s and "
            f"{segment.end_s:.2f} s are too few (at least {MIN_POSES}); the trajectory runs from "
            f"{time[0]:.2f} s to {time[-1]:.2f} s."
        )
    part = trajectory[inside]
    if not at_rest:
        return part
    position = part.position_m.copy()
    quaternions = None if part.rotation is None else part.rotation.as_quat()
    for index, (low, high) in (
        (0, (segment.start_s - REST_S, segment.start_s)),
        (-1, (segment.end_s, segment.end_s + REST_S)),
    ):
        pose = _rest(trajectory, low, high)
        if pose is None:
            continue
        position[index] = pose[0]
        if quaternions is not None and pose[1] is not None:
            quaternions[index] = pose[1].as_quat()
    rotation = None if quaternions is None else Rotation.from_quat(quaternions)
    return replace(part, position_m=position, rotation=rotation)


def _rest(
    trajectory: Trajectory, low_s: float, high_s: float
) -> tuple[Array, Rotation | None] | None:
    """Mean pose over a time at rest; None where it moves, or where there is no pose."""
    chosen = (trajectory.time_s >= low_s) & (trajectory.time_s <= high_s)
    if not chosen.any():
        return None
    position = trajectory.position_m[chosen]
    if np.linalg.norm(np.ptp(position, axis=0)) > REST_RANGE_M:
        return None
    rotation = None if trajectory.rotation is None else trajectory.rotation[chosen].mean()
    return position.mean(axis=0), rotation


def part_of_flight(
    flight: Flight, trajectory: Trajectory, start_s: float | None, end_s: float | None
) -> tuple[Segment, bool]:
    """The part between first take-off and last landing, and whether the vehicle rests at its ends.

    Parameters
    ----------
    trajectory : Trajectory
        One of its tracks.
    start_s, end_s : float or None
        Override either end.
    """
    low, high = span = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    at_rest = False
    if isinstance(flight.airborne, Unavailable):
        reason = "the whole track: the log has no land detector"
    elif not flight.airborne:
        reason = "the whole track: the land detector never says that it flies"
    else:
        low = max(low, flight.airborne[0][0])
        high = min(high, flight.airborne[-1][1])
        count = len(flight.airborne)
        reason = "from take-off to landing, by the land detector"
        if count > 1:
            reason = f"from the first take-off to the last of {count} landings"
        at_rest = True
    return chosen_part(Segment(low, high, reason), start_s, end_s, span), (
        at_rest and start_s is None and end_s is None
    )


def chosen_part(
    segment: Segment, start_s: float | None, end_s: float | None, span: tuple[float, float]
) -> Segment:
    """A part with either end overridden, cut at the ends of the data, ``span`` (s).

    Raises
    ------
    SettingsError
        It is empty.
    """
    given = [n for n, v in (("--from", start_s), ("--to", end_s)) if v is not None]
    low = segment.start_s if start_s is None else start_s
    high = segment.end_s if end_s is None else end_s
    if not low < high:
        raise SettingsError(
            f"the part from {low:.12g} s to {high:.12g} s is empty; the track runs from "
            f"{span[0]:.2f} s to {span[1]:.2f} s. Change `start_s` or `end_s`."
        )
    reason = f"chosen with {' and '.join(given)}" if given else segment.reason
    inside = max(low, span[0]), min(high, span[1])
    if inside != (low, high) and inside[0] < inside[1]:
        return Segment(*inside, f"{reason}, cut at the ends of the data")
    return Segment(low, high, reason)


def assumed_end(heading_change_deg: float | None) -> KnownEnd:
    """The vehicle ends where it began; with the same heading if the odometry nearly says so."""
    same = heading_change_deg is not None and abs(heading_change_deg) <= SAME_HEADING_DEG
    return KnownEnd(
        (0.0, 0.0, 0.0),
        0.0 if same else None,
        0.10,
        5.0,
        "assumed: it landed where it took off"
        + (", with the same heading" if same else "; its heading there is not known"),
        assumed=True,
    )


def measured_end(
    trajectory: Trajectory,
    segment: Segment,
    at_rest: bool,
    forward_m: float,
    right_m: float,
    heading_change_deg: float | None,
) -> KnownEnd:
    """Where the vehicle landed, measured with a tape from the place where it took off.

    Parameters
    ----------
    forward_m, right_m : float
        Along its nose at take-off, and to the right of it.
    heading_change_deg : float or None
        How far it was turned, clockwise.
    """
    path = part_of(upright(trajectory), segment, at_rest)
    heading = 0.0
    if path.rotation is not None:
        nose = path.rotation[0].apply([1.0, 0.0, 0.0])
        heading = float(np.arctan2(nose[1], nose[0]))
    north, east, _ = Rotation.from_rotvec(heading * DOWN).apply([forward_m, right_m, 0.0])
    return KnownEnd(
        (float(north), float(east), 0.0),
        heading_change_deg,
        0.05,
        2.0,
        f"measured: it landed {forward_m:g} m ahead and {right_m:g} m to the right of where it "
        "took off (--landed-at)",
    )


def true_end(
    trajectory: Trajectory, truth: Trajectory, segment: Segment, at_rest: bool
) -> KnownEnd | Unavailable:
    """Where the vehicle really ended, by the ground truth in the same log.

    The truth is turned into the odometry's frame by their headings at the start.
    """
    path = part_of(upright(trajectory), segment, at_rest)
    try:
        real = part_of(truth, segment, at_rest)
    except TrajectoryError as error:
        return Unavailable("true end of the loop", str(error), "None needed.")
    moved = real.position_m[-1] - real.position_m[0]
    if path.rotation is not None and real.rotation is not None:
        turn = heading_change_rad(path.rotation[0] * real.rotation[0].inv())
        moved = Rotation.from_rotvec(turn * DOWN).apply(moved)
        heading = heading_change_rad(real.rotation[-1] * real.rotation[0].inv())
        change: float | None = float(np.degrees(heading))
    elif path.frame == real.frame:
        change = None
    else:
        return Unavailable(
            "true end of the loop",
            "the truth has no orientation by which to turn it into the odometry's frame",
            "None needed.",
        )
    return KnownEnd(
        (float(moved[0]), float(moved[1]), float(moved[2])),
        change,
        0.02,
        0.5,
        f"the ground truth in the log ({truth.name}): it landed {np.linalg.norm(moved):.2f} m from "
        "where it took off",
    )
