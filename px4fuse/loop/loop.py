"""A loop: how far it fails to close, and the path corrected for that in several ways."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.display import Shown
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight import Unavailable
from px4fuse.loop.closure import heading_change_rad, key_frame_spacing_m, key_frames, upright
from px4fuse.loop.corrections import by_distance, judge, score_all, solve_all
from px4fuse.loop.model import (
    CorrectedPath,
    KnownEnd,
    LoopPart,
    OdometryNoise,
    Way,
)
from px4fuse.loop.odometry import Told, pose_graph
from px4fuse.loop.part import assumed_end, part_of
from px4fuse.request import GivenClosure
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Frame, Trajectory, by_axis, cumulative_distance

# A path that is shorter is no loop, whatever its ends
MIN_PATH_M = 2.0


class Loop(Shown, LoopPart, frozen=True, kw_only=True, eq=False):
    """The result of ``px4fuse loop``: what is written, and the paths.

    Attributes
    ----------
    corrections : mapping from way to CorrectedPath or Unavailable
    odometry : CorrectedPath
        The part between take-off and landing as it was measured, in a frame with z down.
    nodes : ndarray of int, shape (k,)
        Key frames, as indices of poses.
    distance_m : ndarray, shape (n,)
        Along the path at each pose, by key frames.
    graph : PoseGraph or Unavailable
        With all closures, before it is solved.
    references : tuple of Trajectory
    given_frame : Frame
        That of the trajectory as it was given.
    """

    written_as = LoopPart
    corrections: Mapping[Way, CorrectedPath | Unavailable]
    odometry: CorrectedPath
    nodes: IntArray
    distance_m: Array
    graph: PoseGraph | Unavailable
    references: tuple[Trajectory, ...]
    given_frame: Frame

    @property
    def paths(self) -> dict[Way, CorrectedPath]:
        """Every path that there is, the odometry first."""
        every = self.corrections.items()
        return {way: path for way, path in every if isinstance(path, CorrectedPath)}

    @property
    def reported(self) -> tuple[CorrectedPath, ...]:
        """The paths worth a row: each once."""
        same: set[Way] = set()
        if all(closure.accepted for closure in self.closures):
            same.add("pose_graph_all")
        if isinstance(self.heading_error_deg, Unavailable):
            same.add("by_distance")
        return tuple(path for way, path in self.paths.items() if way not in same)

    @property
    def best(self) -> CorrectedPath:
        """The gated solution of the pose graph, else by distance, else the odometry."""
        ways: tuple[Way, ...] = ("pose_graph_gated", "by_distance", "uncorrected")
        return next(self.paths[way] for way in ways if way in self.paths)

    @property
    def end_assumed(self) -> bool:
        """Whether the misclosure rests on the assumption that it landed where it took off."""
        return isinstance(self.known_end, KnownEnd) and self.known_end.assumed

    def solved_graph(self) -> PoseGraph:
        """The pose graph with all its closures, its poses those of the best solution there is.

        Raises
        ------
        MissingDataError
            There is no graph.
        """
        if isinstance(self.graph, Unavailable):
            raise MissingDataError(f"{self.graph.what}: {self.graph.reason}.")
        ways: tuple[Way, ...] = ("pose_graph_gated", "pose_graph_all")
        for solution in (self.paths[way].solution for way in ways if way in self.paths):
            if solution is not None:
                return replace(self.graph, poses=solution.poses)
        return self.graph


def close_loop(
    trajectory: Trajectory,
    segment: Segment | None = None,
    *,
    known_end: KnownEnd | None = None,
    came_back: bool = True,
    closures: tuple[GivenClosure, ...] = (),
    noise: OdometryNoise | None = None,
    references: tuple[Trajectory, ...] = (),
    spacing_m: float | None = None,
    at_rest: bool = False,
    absolute: bool = False,
    notes: tuple[str, ...] = (),
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
    absolute : bool
        Whether the track follows an absolute position, so that it does not drift.
    notes : tuple of str
        More to say.

    Raises
    ------
    TrajectoryError
        The part is too short, or a closure lies outside it.
    SettingsError
        A number is out of range.
    """
    noise = noise or OdometryNoise()
    _check_drift(noise)
    whole = upright(trajectory)
    low, high = whole.time_s[[0, -1]].tolist()
    segment = segment or Segment(low, high, "the whole trajectory")
    path = part_of(whole, segment, at_rest)
    spacing = key_frame_spacing_m(path.position_m) if spacing_m is None else spacing_m
    if not 1e-3 <= spacing <= 100.0:
        raise SettingsError(f"`key_frames_m` {spacing:g} is outside 0.001 to 100 m.")
    frames = key_frames(path.position_m, spacing)
    along = cumulative_distance(path.position_m[frames])
    length = float(along[-1])
    if not length >= max(MIN_PATH_M * min(1.0, spacing / 0.5), 1e-6):
        raise TrajectoryError(
            f"{trajectory.name}: the path is {length:.2f} m long on key frames {spacing:g} m "
            "apart, too short for a loop. Give the part with `start_s` and `end_s`, or "
            "`key_frames_m`."
        )
    distance = np.interp(path.time_s, path.time_s[frames], along)
    end_m = path.position_m[-1] - path.position_m[0]
    heading = None
    if path.rotation is not None:
        heading = float(np.degrees(heading_change_rad(path.rotation[-1] * path.rotation[0].inv())))
    end: KnownEnd | Unavailable
    end = Unavailable(
        "misclosure", "the vehicle is not said to have come back", "Leave out --open."
    )
    told: list[Told] = [(closure, None) for closure in closures]
    if came_back:
        end = known_end or assumed_end(path.frame, heading)
        told.insert(0, (GivenClosure(segment.start_s, segment.end_s, end.sigma_m), end))
    for closure, known in told:
        _check(closure, path, is_landing=known is not None)
    misclosure: Array | Unavailable
    heading_error: float | Unavailable
    if isinstance(end, Unavailable):
        misclosure = heading_error = end
    else:
        misclosure, heading_error = end_m - end.displacement, _heading_error(end, heading)
    graph, nodes, statement = pose_graph(path, frames, told, noise)
    judged = judge(graph, told)
    solved, judged = solve_all(path, nodes, graph, judged, progress)
    landing = judged[0] if came_back and judged else None
    spread = by_distance(path, distance, misclosure, heading_error, landing)
    raw, corrections = score_all(path, spread | solved, references)
    missed = None if isinstance(misclosure, Unavailable) else float(np.linalg.norm(misclosure))
    return Loop(
        track=path.name,
        kind=path.kind,
        frame=path.frame,
        start_s=segment.start_s,
        end_s=segment.end_s,
        part_reason=segment.reason,
        poses=len(path),
        key_frames=len(frames),
        key_frame_spacing_m=spacing,
        path_length_m=length,
        end_from_start_m=by_axis(path.frame, end_m),
        heading_change_deg=heading,
        known_end=end,
        closure_error_m=missed,
        closure_percent=None if missed is None else 100.0 * missed / length,
        closure_error_axes_m=None
        if isinstance(misclosure, Unavailable)
        else by_axis(path.frame, misclosure),
        heading_error_deg=heading_error,
        absolute=absolute,
        odometry_noise=noise,
        closures=judged,
        corrections=corrections,
        notes=tuple(note for note in (*whole.notes, statement, *notes) if note),
        odometry=raw,
        nodes=frames,
        distance_m=distance,
        graph=graph,
        references=references,
        given_frame=trajectory.frame,
    )


def _check_drift(noise: OdometryNoise) -> None:
    drifts = {"position_drift_m": noise.position_m, "heading_drift_deg": noise.heading_deg}
    for name, drift in drifts.items():
        if not 1e-4 <= drift <= 100.0:
            raise SettingsError(f"`{name}` {drift:g} is outside 0.0001 to 100.")


def _check(closure: GivenClosure, path: Trajectory, *, is_landing: bool) -> None:
    """Refuse a closure outside the path, one that leads back in time, and one without width."""
    (low, high), times = path.time_s[[0, -1]], (closure.time_1_s, closure.time_2_s)
    label = f"{path.name}: closure {times[0]:.12g},{times[1]:.12g}"
    outside = [] if is_landing else [time for time in times if not low <= time <= high]
    if outside:
        raise TrajectoryError(
            f"{label}: {outside[0]:.12g} s is outside the path, which runs from {low:.2f} s to "
            f"{high:.2f} s."
        )
    if not (is_landing or times[0] < times[1]):
        raise TrajectoryError(f"{label}: the first time must be before the second.")
    if not 1e-4 <= closure.sigma_m <= 100.0:
        raise TrajectoryError(f"{label}: SIGMA {closure.sigma_m:g} is outside 0.0001 to 100 m.")


def _heading_error(end: KnownEnd, heading_deg: float | None) -> float | Unavailable:
    """How far the heading is off at the end (°)."""
    what = "heading misclosure"
    if heading_deg is None:
        return Unavailable(what, "the trajectory has no orientations", "None needed.")
    if end.heading_change_deg is None:
        return Unavailable(
            what,
            f"the vehicle ends turned by {heading_deg:+.0f}°, and how far it was really turned is "
            "not known",
            "Give it as the third number of --landed-at FORWARD,RIGHT,DEG.",
        )
    return float(np.degrees(lie.wrap(np.radians(heading_deg - end.heading_change_deg))))
