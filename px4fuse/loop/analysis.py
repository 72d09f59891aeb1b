"""A loop from what was given: which part, where it ended, what it is scored against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.filter.signals import Segment
from px4fuse.flight import Flight, Truth, Unavailable
from px4fuse.loop.loop import Loop, close_loop
from px4fuse.loop.model import KnownEnd, OdometryNoise
from px4fuse.loop.part import chosen_part, measured_end, part_of_flight, true_end
from px4fuse.loop.sources import LoopSource
from px4fuse.loop.tracks import odometry_of, trajectory_of
from px4fuse.request import GivenClosure
from px4fuse.trajectory.model import Trajectory

# Where stamps are UNIX time, a smaller time counts from the first pose
SMALLEST_STAMP_S = 1e6
# What `compare` takes for a loop: this long, and ending within this share of its length
LOOP_MIN_PATH_M = 10.0
LOOP_MAX_GAP_SHARE = 0.10


def analyse(
    source: LoopSource,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    landed_at: tuple[float, float, float | None] | None = None,
    came_back: bool = True,
    closures: tuple[GivenClosure, ...] = (),
    noise: OdometryNoise | None = None,
    reference: Trajectory | None = None,
    spacing_m: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Loop:
    """Measure and correct the loop of a trajectory or of a flight.

    Parameters
    ----------
    start_s, end_s : float, optional
        Override take-off and landing.
    landed_at : tuple of forward_m, right_m and heading change (degrees or None), optional
        Where it landed, measured from the place and heading of take-off; by default the truth in
        the log where there is one, else the place of take-off.
    came_back : bool
        False where the landing closes no loop.
    closures : tuple of GivenClosure
        Times as the trajectory counts; where those are UNIX time, small ones count from the
        first pose.
    noise : OdometryNoise, optional
    reference : Trajectory, optional
        Scored against, besides the truth in the log.
    spacing_m : float, optional
        Between key frames; by default a fiftieth of the extent, 0.02 to 0.5 m.

    Raises
    ------
    TrajectoryError, SettingsError
        As :func:`px4fuse.loop.loop.close_loop`.
    """
    trajectory, flight = source.trajectory, source.flight
    zero_s = float(trajectory.time_s[0]) if trajectory.unix_offset_s == 0.0 else 0.0

    def stamp(time_s: float) -> float:
        return time_s + zero_s if abs(time_s) < SMALLEST_STAMP_S else time_s

    start = None if start_s is None else stamp(start_s)
    end = None if end_s is None else stamp(end_s)
    truth, absolute, at_rest = None, False, False
    if flight is None:
        span = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
        segment = chosen_part(Segment(*span, "the whole trajectory"), start, end, span)
    else:
        segment, at_rest = part_of_flight(flight, trajectory, start, end)
        truth = None if trajectory.kind == "truth" else truth_of(flight)
        # it was told its position, and no odometry
        told = any(track.origin.is_vision for track in flight.positions)
        no_odometry = isinstance(odometry_of(flight), Unavailable)
        absolute = trajectory.kind in ("ekf2", "kf") and told and no_odometry
    known: KnownEnd | None = None
    notes: tuple[str, ...] = ()
    if landed_at is not None:
        if not came_back:
            raise SettingsError("`landed_at` and `came_back` exclude each other. Leave one out.")
        known = measured_end(trajectory, segment, at_rest, *landed_at)
    elif truth is not None and came_back:
        found = true_end(trajectory, truth, segment, at_rest)
        if isinstance(found, KnownEnd):
            known = found
        else:
            notes = (f"the truth does not tell where it ended: {found}",)
    return close_loop(
        trajectory,
        segment,
        known_end=known,
        came_back=came_back,
        closures=tuple(
            GivenClosure(stamp(c.time_1_s), stamp(c.time_2_s), c.sigma_m) for c in closures
        ),
        noise=noise,
        references=tuple(part for part in (truth, reference) if part is not None),
        spacing_m=spacing_m,
        at_rest=at_rest,
        absolute=absolute,
        notes=notes,
        progress=progress,
    )


def truth_of(flight: Flight) -> Trajectory | None:
    """Ground truth of a flight; None without any."""
    if not isinstance(flight.truth, Truth):
        return None
    try:
        return trajectory_of(flight, "truth")
    except MissingDataError:  # too few samples
        return None


def loop_in(flight: Flight, progress: Callable[[str], None] = lambda _: None) -> Loop | Unavailable:
    """The loop that a flight's odometry holds, for ``px4fuse compare``.

    Unavailable where there is no odometry, or where it does not come back near its start.
    """
    odometry = odometry_of(flight)
    try:
        trajectory = trajectory_of(flight, "vio")
    except MissingDataError as error:  # too few poses, or none
        reason = odometry.reason if isinstance(odometry, Unavailable) else str(error).rstrip(".")
        remedy = "A loop is measured on visual-inertial odometry, sent as ODOMETRY."
        return Unavailable("loop closure", reason, remedy)
    segment, _ = part_of_flight(flight, trajectory, None, None)
    time = trajectory.time_s
    inside = trajectory.position_m[(time >= segment.start_s) & (time <= segment.end_s)]
    extent = gap = 0.0
    if len(inside):
        extent = float(np.linalg.norm(np.ptp(inside, axis=0)))
        gap = float(np.linalg.norm(inside[-1] - inside[0]))
    if 2.0 * extent < LOOP_MIN_PATH_M or gap > LOOP_MAX_GAP_SHARE * 2.0 * extent:
        return Unavailable(
            "loop closure",
            f"the odometry ends {gap:.1f} m from where it began and spans {extent:.1f} m: no loop",
            "Fly back to the place of take-off, or use px4fuse loop with --closure.",
        )
    return analyse(LoopSource(trajectory, flight), progress=progress)
