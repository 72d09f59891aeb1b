"""Loop analysis: segment, landing place, closures, corrections and their scores."""

from collections.abc import Callable

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop import loop_segment
from px4fuse.loop.closure import key_frame_spacing_m, key_frames, to_z_down
from px4fuse.loop.corrections import correct_paths_by_distance, gate_closures, score_all, solve_all
from px4fuse.loop.model import LANDING, Loop, OdometryNoise, TrueEnd
from px4fuse.loop.odometry import ClosureClaim, pose_graph
from px4fuse.loop.tracks import LoopSource, odometry_of, trajectory_of
from px4fuse.request import GivenClosure, LoopRequest
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.model import Trajectory, by_axis, cumulative_distance

# s; with UNIX timestamps, smaller times count from the first pose
SMALLEST_STAMP_S = 1e6
# m; shortest path of a loop
MIN_PATH_M = 2.0
# loops in compare: shortest path (m), and largest end distance as fraction of the path
LOOP_MIN_PATH_M = 10.0
LOOP_MAX_GAP_SHARE = 0.10
# m or degrees; limit of options
MAX_VALUE = 100.0


def analyse(
    source: LoopSource,
    request: LoopRequest | None = None,
    reference: Trajectory | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Loop:
    """Measure and correct the loop of a trajectory or of a flight.

    Parameters
    ----------
    source : LoopSource
        Trajectory, and its flight.
    request : LoopRequest, optional
        Options. Times are on the clock of the trajectory; with UNIX timestamps, small times count
        from the first pose. The landing place is by default that of the ground truth in the log,
        else the take-off place.
    reference : Trajectory, optional
        Reference for the scores, besides the ground truth in the log.

    Raises
    ------
    TrajectoryError, SettingsError
        The segment is too short, a closure is outside of it, or a number is out of range.
    """
    request = request or LoopRequest(source=source.trajectory.name)
    noise = OdometryNoise(request.position_drift_m, request.heading_drift_deg)
    _require_in_range("position_drift_m", noise.position_m, 1e-4)
    _require_in_range("heading_drift_deg", noise.heading_deg, 1e-4)
    trajectory, flight = source.trajectory, source.flight
    zero_s = float(trajectory.time_s[0]) if trajectory.unix_offset_s == 0.0 else 0.0

    def stamp(time_s: float) -> float:
        return time_s + zero_s if abs(time_s) < SMALLEST_STAMP_S else time_s

    request_times = (request.start_s, request.end_s)
    start, end = (None if time_s is None else stamp(time_s) for time_s in request_times)
    segment, at_rest = loop_segment.choose_loop_segment(flight, trajectory, start, end)
    truth = None if flight is None or trajectory.kind == "truth" else truth_of(flight)
    z_down_trajectory = to_z_down(trajectory)
    path = loop_segment.cut_trajectory(z_down_trajectory, segment, at_rest)
    truth_used = truth if request.closed_loop and request.landed_at is None else None
    by_truth = (
        None if truth_used is None else loop_segment.true_end(path, truth_used, segment, at_rest)
    )
    true_end_found = _find_true_end(path, request, by_truth)
    given_closures = [
        GivenClosure(stamp(c.time_1_s), stamp(c.time_2_s), c.sigma_m) for c in request.closures
    ]
    for closure in given_closures:
        _require_valid_closure(closure, path)
    claims: list[ClosureClaim] = [(closure, None) for closure in given_closures]
    if not isinstance(true_end_found, Unavailable):
        claims.insert(
            0,
            (
                GivenClosure(segment.start_s, segment.end_s, true_end_found.sigma_m),
                true_end_found,
            ),
        )
    spacing = request.key_frames_m
    spacing = key_frame_spacing_m(path.position_m) if spacing is None else spacing
    frames, distance = _key_frames(path, spacing)
    graph, nodes, statement = pose_graph(path, frames, claims, noise)
    notes = [*z_down_trajectory.notes, statement]
    if isinstance(by_truth, str):
        notes.append(f"the landing place is not in the ground truth: {by_truth}")
    gated_closures = gate_closures(graph, claims)
    graph_corrections, gated_closures = solve_all(path, nodes, graph, gated_closures, progress)
    end_m, heading = path.position_m[-1] - path.position_m[0], loop_segment.heading_change_deg(path)
    misclosure_m = (
        true_end_found
        if isinstance(true_end_found, Unavailable)
        else end_m - true_end_found.displacement
    )
    heading_error = _heading_error(true_end_found, heading)
    landing = gated_closures[0] if gated_closures and gated_closures[0].source == LANDING else None
    corrected_by_distance = correct_paths_by_distance(
        path, distance, misclosure_m, heading_error, landing
    )
    references = tuple(track for track in (truth, reference) if track is not None)
    error = error_axes = None
    if not isinstance(misclosure_m, Unavailable):
        error, error_axes = float(np.linalg.norm(misclosure_m)), by_axis(path.frame, misclosure_m)
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
        path_length_m=float(distance[-1]),
        end_from_start_m=by_axis(path.frame, end_m),
        heading_change_deg=heading,
        true_end=true_end_found,
        closure_error_m=error,
        closure_percent=None if error is None else 100.0 * error / float(distance[-1]),
        closure_error_axes_m=error_axes,
        heading_error_deg=heading_error,
        is_absolute_track=flight is not None and _is_absolute(trajectory, flight),
        odometry_noise=noise,
        closures=gated_closures,
        corrections=score_all(path, corrected_by_distance | graph_corrections, references),
        notes=tuple(note for note in notes if note),
        nodes=frames,
        distance_m=distance,
        graph=graph,
        references=references,
        original_frame=trajectory.frame,
    )


def _find_true_end(
    path: Trajectory, request: LoopRequest, by_truth: TrueEnd | str | None
) -> TrueEnd | Unavailable:
    """Return the landing place: measured, by ground truth, or the take-off place."""
    if request.landed_at is not None:
        if not request.closed_loop:
            raise SettingsError(
                "`landed_at` and `closed_loop` exclude each other.", "Omit one of them."
            )
        return loop_segment.measured_end(path, request.landed_at)
    if not request.closed_loop:
        return Unavailable("closure error", "the loop is declared open (--open)", "Remove --open.")
    return by_truth if isinstance(by_truth, TrueEnd) else loop_segment.assumed_end(path)


def _is_absolute(trajectory: Trajectory, flight: Flight) -> bool:
    """Return True if the track follows an external position source without odometry."""
    has_vision = any(track.origin.is_vision for track in flight.positions)
    no_odometry = isinstance(odometry_of(flight), Unavailable)
    return trajectory.kind in ("ekf2", "kf") and has_vision and no_odometry


def _key_frames(path: Trajectory, spacing_m: float) -> tuple[IntArray, Array]:
    """Return the indices of the key frames, and the distance along them at each pose."""
    _require_in_range("key_frames_m", spacing_m, 1e-3)
    frames = key_frames(path.position_m, spacing_m)
    along = cumulative_distance(path.position_m[frames])
    if not along[-1] >= max(MIN_PATH_M * min(1.0, spacing_m / 0.5), 1e-6):
        raise TrajectoryError(
            f"{path.name}: the path is only {along[-1]:.2f} m long (key frame spacing "
            f"{spacing_m:g} m), too short for a loop.",
            "Choose a longer part (--from, --to) or a smaller --key-frames.",
        )
    return frames, np.interp(path.time_s, path.time_s[frames], along)


def _require_in_range(name: str, value: float, least: float) -> None:
    if not least <= value <= MAX_VALUE:
        raise SettingsError(f"`{name}` {value:g} is out of range ({least:g} to {MAX_VALUE:g}).")


def _require_valid_closure(closure: GivenClosure, path: Trajectory) -> None:
    """Raise TrajectoryError if times or σ of a closure are out of range."""
    (low, high), times = path.time_s[[0, -1]], (closure.time_1_s, closure.time_2_s)
    label = f"{path.name}: closure {times[0]:.12g},{times[1]:.12g}"
    if not low <= times[0] < times[1] <= high:
        raise TrajectoryError(
            f"{label}: the times must be in ascending order and on the path "
            f"({low:.2f} s to {high:.2f} s)."
        )
    if not 1e-4 <= closure.sigma_m <= MAX_VALUE:
        raise TrajectoryError(
            f"{label}: SIGMA {closure.sigma_m:g} is out of range (0.0001 to 100 m)."
        )


def _heading_error(end: TrueEnd | Unavailable, heading_deg: float | None) -> float | Unavailable:
    """Return the heading error at the end (°), or Unavailable."""
    what = "heading error of the loop"
    if isinstance(end, Unavailable):
        return end
    if heading_deg is None:
        return Unavailable(what, "the trajectory has no orientations", "No action needed.")
    if end.heading_change_deg is None:
        return Unavailable(
            what,
            f"the final heading differs by {heading_deg:+.0f}° from the initial one, and "
            "the true rotation is not known",
            "Give it as the third number of --landed-at FORWARD,RIGHT,DEG.",
        )
    return float(np.degrees(lie.wrap(np.radians(heading_deg - end.heading_change_deg))))


def truth_of(flight: Flight) -> Trajectory | None:
    """Return the ground truth of a flight; None if it is missing."""
    try:
        return trajectory_of(flight, "truth")
    except MissingDataError:
        return None


def analyse_flight_loop(
    flight: Flight, progress: Callable[[str], None] = lambda _: None
) -> Loop | Unavailable:
    """Analyse the loop of a flight's odometry, for ``px4fuse compare``.

    Unavailable without odometry, or if the odometry does not return near its start.
    """
    odometry = odometry_of(flight)
    try:
        trajectory = trajectory_of(flight, "vio")
    except MissingDataError as error:  # too few poses, or none
        reason = odometry.reason if isinstance(odometry, Unavailable) else str(error).rstrip(".")
        return Unavailable(
            "loop closure", reason, "A loop needs visual-inertial odometry, sent as ODOMETRY."
        )
    segment, _ = loop_segment.choose_loop_segment(flight, trajectory, None, None)
    time = trajectory.time_s
    inside = trajectory.position_m[(time >= segment.start_s) & (time <= segment.end_s)]
    extent = gap = 0.0
    if len(inside):
        extent = float(np.linalg.norm(np.ptp(inside, axis=0)))
        gap = float(np.linalg.norm(inside[-1] - inside[0]))
    if 2.0 * extent < LOOP_MIN_PATH_M or gap > LOOP_MAX_GAP_SHARE * 2.0 * extent:
        return Unavailable(
            "loop closure",
            f"the odometry ends {gap:.1f} m from its start and spans {extent:.1f} m, so "
            "it is not a loop",
            "Fly back to the take-off place, or use px4fuse loop with --closure.",
        )
    return analyse(LoopSource(trajectory, flight), progress=progress)
