"""A loop: how far it fails to close, and the path corrected for that in several ways."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.display import Shown
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import (
    heading_change_rad,
    key_frame_spacing_m,
    key_frames,
    upright,
)
from px4fuse.loop.corrections import (
    BY_DISTANCE,
    UNCORRECTED,
    Correction,
    Judged,
    by_distance,
    offsets_of,
    scored,
    solve_all,
)
from px4fuse.loop.odometry import Closure, OdometryNoise
from px4fuse.loop.part import KnownEnd, assumed_end, part_of
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.analysis import SOLUTIONS
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Frame, Trajectory, cumulative_distance

LANDING = "landing"
# A path that is shorter is no loop, whatever its ends
MIN_PATH_M = 2.0


@dataclass(frozen=True, repr=False)
class Loop(Shown):
    """The result of ``px4fuse loop``.

    Attributes
    ----------
    odometry : Correction
        The part between take-off and landing as it was measured, in a frame with z down.
    segment : Segment
        In the trajectory's own time, and why.
    nodes : ndarray of int, shape (k,)
        Key frames, as indices of poses.
    spacing_m : float
        Between key frames.
    distance_m : ndarray, shape (n,)
        Along the path at each pose, by key frames.
    known_end : KnownEnd or Unavailable
        Unavailable where it is not assumed that the vehicle came back.
    end_m : ndarray, shape (3,)
        Last position minus first, by the odometry.
    heading_change_deg : float or None
        Last heading minus first, by the odometry; None without orientations.
    misclosure_m : ndarray, shape (3,), or Unavailable
        Last position by the odometry minus where the vehicle really was.
    misclosure_heading_deg : float or Unavailable
    closures : tuple of Judged
        That of the landing first, then those given.
    noise : OdometryNoise
    graph : PoseGraph or Unavailable
        With all closures, before it is solved.
    plain : Correction or Unavailable
        By distance as in the lesson's Example 2: positions alone.
    by_distance : Correction or Unavailable
        Headings too, where it is known how far they are off; else the same as ``plain``.
    solved : mapping from "all", "gated", "dcs" and "gnc" to Correction or Unavailable
    references : tuple of Trajectory
    notes : tuple of str
    absolute : bool
        Whether the track follows an absolute position, so that it does not drift.
    frame : Frame
        That of the trajectory as it was given.
    """

    odometry: Correction
    segment: Segment
    nodes: IntArray
    spacing_m: float
    distance_m: Array
    known_end: KnownEnd | Unavailable
    end_m: Array
    heading_change_deg: float | None
    misclosure_m: Array | Unavailable
    misclosure_heading_deg: float | Unavailable
    closures: tuple[Judged, ...]
    noise: OdometryNoise
    graph: PoseGraph | Unavailable
    plain: Correction | Unavailable
    by_distance: Correction | Unavailable
    solved: Mapping[str, Correction | Unavailable]
    references: tuple[Trajectory, ...]
    notes: tuple[str, ...]
    absolute: bool = False
    frame: Frame = "NED"

    @property
    def path_length_m(self) -> float:
        """Length of the path, by key frames."""
        return float(self.distance_m[-1])

    @property
    def closure_error_m(self) -> float | None:
        """Length of the misclosure; None where it is not known where the vehicle ended."""
        if isinstance(self.misclosure_m, Unavailable):
            return None
        return float(np.linalg.norm(self.misclosure_m))

    @property
    def end_assumed(self) -> bool:
        """Whether the misclosure rests on the assumption that it landed where it took off."""
        return isinstance(self.known_end, KnownEnd) and self.known_end.assumed

    @property
    def reported(self) -> tuple[Correction, ...]:
        """The paths worth a row: each once."""
        same = set()
        if all(judged.gate.accepted for judged in self.closures):
            same.add(SOLUTIONS["all"])
        if isinstance(self.misclosure_heading_deg, Unavailable):
            same.add(BY_DISTANCE)
        return tuple(part for part in self.corrections if part.name not in same)

    @property
    def best(self) -> Correction:
        """The gated solution of the pose graph, else by distance, else the odometry."""
        for part in (self.solved.get("gated"), self.by_distance):
            if isinstance(part, Correction):
                return part
        return self.odometry

    def solved_graph(self) -> PoseGraph:
        """The pose graph with all its closures, its poses those of the best solution there is.

        Raises
        ------
        MissingDataError
            There is no graph.
        """
        if isinstance(self.graph, Unavailable):
            raise MissingDataError(f"{self.graph.what}: {self.graph.reason}.")
        for name in ("gated", "all"):
            part = self.solved.get(name)
            if isinstance(part, Correction) and part.solution is not None:
                return replace(self.graph, poses=part.solution.poses)
        return self.graph

    @property
    def corrections(self) -> tuple[Correction, ...]:
        """Every path that there is, the odometry first."""
        every = (self.odometry, self.plain, self.by_distance, *self.solved.values())
        return tuple(part for part in every if isinstance(part, Correction))


def close_loop(
    trajectory: Trajectory,
    segment: Segment | None = None,
    *,
    known_end: KnownEnd | None = None,
    came_back: bool = True,
    closures: tuple[Closure, ...] = (),
    noise: OdometryNoise | None = None,
    references: tuple[Trajectory, ...] = (),
    spacing_m: float | None = None,
    at_rest: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> Loop:
    """Measure how far a loop fails to close, and correct its path.

    Parameters
    ----------
    segment : Segment, optional
        Part to take, in the trajectory's own time; by default all of it.
    known_end : KnownEnd, optional
        By default the vehicle ends where it began, and with the heading that it began with if
        the odometry has it within 15° of that.
    came_back : bool
        False where only the closures given are to be used.
    closures, noise, spacing_m, progress
        As :func:`px4fuse.loop.analysis.analyse` takes them, times in the trajectory's own.
    references : tuple of Trajectory
        What the paths are scored against: the truth, or a SLAM system's trajectory.
    at_rest : bool
        Whether the vehicle stands before the part and after it, so that its poses there may be
        averaged.

    Raises
    ------
    TrajectoryError
        The part is too short, or a closure lies outside it.
    SettingsError
        A number is out of range.
    """
    noise = noise or OdometryNoise()
    whole = upright(trajectory)
    segment = segment or Segment(
        float(whole.time_s[0]), float(whole.time_s[-1]), "the whole trajectory"
    )
    path = part_of(whole, segment, at_rest)
    spacing = key_frame_spacing_m(path.position_m) if spacing_m is None else spacing_m
    if not 1e-3 <= spacing <= 100.0:
        raise SettingsError(f"`key_frames_m` {spacing:g} is outside 0.001 to 100 m.")
    frames = key_frames(path.position_m, spacing)
    along = cumulative_distance(path.position_m[frames])
    if not along[-1] >= max(MIN_PATH_M * min(1.0, spacing / 0.5), 1e-6):
        raise TrajectoryError(
            f"{trajectory.name}: the path is {along[-1]:.2f} m long on key frames {spacing:g} m "
            "apart, too short for a loop. Give the part with `start_s` and `end_s`, or "
            "`key_frames_m`."
        )
    distance = np.interp(path.time_s, path.time_s[frames], along)
    end_m = path.position_m[-1] - path.position_m[0]
    heading = None
    if path.rotation is not None:
        heading = float(np.degrees(heading_change_rad(path.rotation[-1] * path.rotation[0].inv())))
    notes = list(whole.notes)
    end: KnownEnd | Unavailable
    if came_back:
        end = known_end or assumed_end(heading)
        every = (_landing(end, segment), *closures)
    else:
        end = Unavailable(
            "misclosure", "the vehicle is not said to have come back", "Leave out --open."
        )
        every = closures
    for closure in every:
        _check(closure, path)
    misclosure_m, misclosure_heading = _misclosure(end, end_m, heading)
    raw = scored(Correction(UNCORRECTED, path, np.zeros(len(path))), references)
    offset = offsets_of(raw)
    judged, graph, solved, statement = solve_all(
        path, frames, every, noise, references, offset, progress
    )
    notes.append(statement)
    plain, turned = (
        scored(part, references, offset) if isinstance(part, Correction) else part
        for part in by_distance(
            path, distance, misclosure_m, misclosure_heading, judged if came_back else ()
        )
    )
    return Loop(
        odometry=raw,
        segment=segment,
        nodes=frames,
        spacing_m=spacing,
        distance_m=distance,
        known_end=end,
        end_m=end_m,
        heading_change_deg=heading,
        misclosure_m=misclosure_m,
        misclosure_heading_deg=misclosure_heading,
        closures=judged,
        noise=noise,
        graph=graph,
        plain=plain,
        by_distance=turned,
        solved=solved,
        references=references,
        notes=tuple(note for note in notes if note),
        frame=trajectory.frame,
    )


def _landing(end: KnownEnd, segment: Segment) -> Closure:
    return Closure(
        segment.start_s,
        segment.end_s,
        end.sigma_m,
        end.displacement_m,
        end.heading_change_deg,
        end.sigma_heading_deg,
        LANDING,
    )


def _check(closure: Closure, path: Trajectory) -> None:
    low, high = float(path.time_s[0]), float(path.time_s[-1])
    times = (closure.time_1_s, closure.time_2_s)
    label = f"closure {closure.time_1_s:.12g},{closure.time_2_s:.12g}"
    if closure.source != LANDING:
        for time in times:
            if not low <= time <= high:
                raise TrajectoryError(
                    f"{path.name}: {label}: {time:.12g} s is outside the path, which runs from "
                    f"{low:.2f} s to {high:.2f} s."
                )
        if not times[0] < times[1]:
            raise TrajectoryError(
                f"{path.name}: {label}: the first time must be before the second."
            )
    if not 1e-4 <= closure.sigma_m <= 100.0:
        raise TrajectoryError(
            f"{path.name}: {label}: SIGMA {closure.sigma_m:g} is outside 0.0001 to 100 m."
        )


def _misclosure(
    end: KnownEnd | Unavailable, end_m: Array, heading_deg: float | None
) -> tuple[Array | Unavailable, float | Unavailable]:
    if isinstance(end, Unavailable):
        return end, end
    if heading_deg is None:
        turned: float | Unavailable = Unavailable(
            "heading misclosure", "the trajectory has no orientations", "None needed."
        )
    elif end.heading_change_deg is None:
        turned = Unavailable(
            "heading misclosure",
            f"the vehicle ends turned by {heading_deg:+.0f}°, and how far it was really turned is "
            "not known",
            "Give it as the third number of --landed-at FORWARD,RIGHT,DEG.",
        )
    else:
        turned = float(np.degrees(lie.wrap(np.radians(heading_deg - end.heading_change_deg))))
    return end_m - np.array(end.displacement_m), turned
