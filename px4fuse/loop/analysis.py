"""Loop closure error of a trajectory, and corrected paths with ATE and RPE."""

import math
from contextlib import suppress

import numpy as np
from msgspec import structs

from px4fuse.comparison.estimates import Progress, ignore_progress
from px4fuse.core.arrays import Array, IntArray
from px4fuse.core.record import Span
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight.model import DIAGNOSIS_WITHHELD, Flight, Unavailable
from px4fuse.request import GivenClosure, LoopRequest
from px4fuse.trajectory.model import (
    Trajectory,
    compute_extent_m,
    cumulative_distance,
    split_by_axis,
)

from . import loop_segment
from .closure import choose_key_frames, compute_default_key_frame_spacing_m, to_z_down
from .corrections import (
    build_pose_graph,
    distribute_closure_error_by_distance,
    score_paths,
    solve_pose_graphs,
)
from .model import Loop, OdometryNoise, TrueFinalPose
from .tracks import LoopSource, find_odometry, trajectory_of

# Larger times (s) in options are UNIX times
MIN_UNIX_TIME_S = 1e6
# Minimum path length (m) of a loop
MIN_PATH_LENGTH_M = 2.0
# Minimum path length (m) of a loop in ``px4fuse compare``
MIN_FLIGHT_LOOP_PATH_M = 10.0
# Maximum distance between both ends of a loop in ``px4fuse compare``, as fraction of path length
MAX_END_TO_START_DISTANCE_FRACTION = 0.10
# Maximum of the options for drift (m or °), key frame spacing (m) and σ (m)
MAX_LOOP_OPTION_VALUE = 100.0


def analyse(
    source: LoopSource,
    request: LoopRequest | None = None,
    reference: Trajectory | None = None,
    progress: Progress = ignore_progress,
) -> Loop:
    """Compute the loop closure error of a trajectory, and correct the path.

    Parameters
    ----------
    source : LoopSource
        Trajectory, with its flight if it is from a flight log.
    request : LoopRequest, optional
        Options; times are on the clock of the trajectory.
    reference : Trajectory, optional
        Additional reference for ATE and RPE.

    Raises
    ------
    TrajectoryError, SettingsError
        The trajectory is too short, or an option is out of range.
    """
    request = request or LoopRequest(source=source.trajectory.name)
    noise = OdometryNoise(request.position_drift_m, request.heading_drift_deg)
    _require_in_range("position_drift_m", noise.position_m, 1e-4)
    _require_in_range("heading_drift_deg", noise.heading_deg, 1e-4)
    trajectory, flight = source.trajectory, source.flight
    is_assessed = flight is not None and bool(flight.log.is_assessed)
    start_s, end_s = (
        None if time_s is None else _convert_option_time_s(trajectory, time_s)
        for time_s in (request.start_s, request.end_s)
    )
    segment = loop_segment.choose_loop_segment(flight, trajectory, start_s, end_s)
    # Find the true final pose and the loop closures
    truth = None
    if flight is not None and trajectory.kind != "truth":
        with suppress(MissingDataError):
            truth = trajectory_of(flight, "truth")
    z_down_trajectory = to_z_down(trajectory)
    path = loop_segment.cut_trajectory(z_down_trajectory, segment)
    # Final pose, or the reason (text) why ground truth does not contain it
    final_pose_in_truth: TrueFinalPose | str | None = None
    if truth and request.closed_loop and request.landed_at is None:
        final_pose_in_truth = loop_segment.find_final_pose_in_truth(path, truth, segment)
    true_end = _find_true_end(path, request, final_pose_in_truth, segment, is_assessed=is_assessed)
    closures = []
    if not isinstance(true_end, Unavailable):
        # The closure between take-off and landing is the first
        closures.append(GivenClosure(segment.start_s, segment.end_s, true_end.sigma_m))
    for given_closure in request.closures:
        closure = structs.replace(
            given_closure,
            time_1_s=_convert_option_time_s(trajectory, given_closure.time_1_s),
            time_2_s=_convert_option_time_s(trajectory, given_closure.time_2_s),
        )
        _require_valid_closure(closure, path)
        closures.append(closure)
    # Make a pose graph with the key frames as nodes, and solve it
    key_frame_spacing_m = request.key_frames_m
    if key_frame_spacing_m is None:
        key_frame_spacing_m = compute_default_key_frame_spacing_m(path.position_m)
    key_frame_indices, distance_m = _choose_key_frames(path, key_frame_spacing_m)
    graph, node_indices, variance_note = build_pose_graph(
        path, key_frame_indices, closures, true_end, noise
    )
    notes = [*z_down_trajectory.notes, variance_note]
    if isinstance(final_pose_in_truth, str):
        notes.append(f"the landing place is not known from ground truth: {final_pose_in_truth}")
    pose_graph_corrections, tested_closures = solve_pose_graphs(
        path, node_indices, graph, closures, true_end, progress
    )
    # Compute the closure errors, and distribute them along the path
    displacement_m = path.position_m[-1] - path.position_m[0]
    odometry_heading_change_deg = loop_segment.compute_heading_change_deg(path)
    closure_error_vector_m: Array | Unavailable
    closure_error_m = closure_percent = closure_error_axes_m = None
    if isinstance(true_end, Unavailable):
        closure_error_vector_m = true_end
    else:
        closure_error_vector_m = error_m = displacement_m - true_end.displacement_vector_m
        closure_error_m = float(np.linalg.norm(error_m))
        closure_percent = 100.0 * closure_error_m / float(distance_m[-1])
        closure_error_axes_m = split_by_axis(path.frame, error_m)
    heading_error_deg = _compute_heading_error(true_end, odometry_heading_change_deg)
    paths_with_distributed_closure_error = distribute_closure_error_by_distance(
        path, distance_m, closure_error_vector_m, heading_error_deg, tested_closures
    )
    # Compute ATE and RPE of all paths
    references = tuple(track for track in (truth, reference) if track is not None)
    return Loop(
        track=path.name,
        kind=path.kind,
        frame=path.frame,
        start_s=segment.start_s,
        end_s=segment.end_s,
        part_reason=segment.reason,
        poses=len(path),
        key_frames=len(key_frame_indices),
        key_frame_spacing_m=key_frame_spacing_m,
        path_length_m=float(distance_m[-1]),
        end_from_start_m=split_by_axis(path.frame, displacement_m),
        heading_change_deg=odometry_heading_change_deg,
        true_end=true_end,
        closure_error_m=closure_error_m,
        closure_percent=closure_percent,
        closure_error_axes_m=closure_error_axes_m,
        heading_error_deg=heading_error_deg,
        is_absolute_track=flight is not None and _is_drift_free(trajectory, flight),
        odometry_noise=noise,
        closures=tested_closures,
        corrections=score_paths(
            path, paths_with_distributed_closure_error | pose_graph_corrections, references
        ),
        notes=tuple(note for note in notes if note),
        distance_m=distance_m,
        graph=graph,
        references=references,
        original_frame=trajectory.frame,
        is_assessed=is_assessed,
    )


def _convert_option_time_s(trajectory: Trajectory, time_s: float) -> float:
    """Convert a time (s) from an option to the clock of a trajectory.

    If the times of the trajectory are UNIX times, small times are relative to its first pose.
    """
    has_unix_times = trajectory.unix_offset_s == 0.0
    if has_unix_times and abs(time_s) < MIN_UNIX_TIME_S:
        return time_s + float(trajectory.time_s[0])
    return time_s


def _find_true_end(
    path: Trajectory,
    request: LoopRequest,
    final_pose_in_truth: TrueFinalPose | str | None,
    segment: Segment,
    *,
    is_assessed: bool,
) -> TrueFinalPose | Unavailable:
    """Return the true final pose: measured, from ground truth, or equal to the initial pose."""
    if request.landed_at is not None:
        if not request.closed_loop:
            raise SettingsError(
                "`landed_at` and `closed_loop` exclude each other.",
                "Omit --landed-at or --open.",
            )
        return loop_segment.convert_measured_final_pose(path, request.landed_at)
    if not request.closed_loop:
        return Unavailable(
            "loop closure error",
            "the path does not return to its start (stated with --open)",
            "Omit --open.",
        )
    if isinstance(final_pose_in_truth, TrueFinalPose):
        return final_pose_in_truth
    if is_assessed:
        return DIAGNOSIS_WITHHELD
    flight = segment.whole_flight
    if (
        max(segment.start_s - flight.start_s, flight.end_s - segment.end_s)
        > loop_segment.REST_DURATION_S
    ):
        return Unavailable(
            "loop closure error",
            f"{path.name} has poses only from {segment.start_s:.1f} to {segment.end_s:.1f} s of "
            "the flight",
            "Choose the time span of a loop with --from and --to.",
        )
    return loop_segment.assume_landing_at_takeoff(path)


def _is_drift_free(trajectory: Trajectory, flight: Flight) -> bool:
    """Return True if the trajectory is from a filter that fused positions without drift."""
    has_vision = any(track.origin.is_vision for track in flight.positions)
    has_no_odometry = isinstance(find_odometry(flight), Unavailable)
    return trajectory.kind in ("ekf2", "kf") and has_vision and has_no_odometry


def _choose_key_frames(path: Trajectory, key_frame_spacing_m: float) -> tuple[IntArray, Array]:
    """Return the key frame indices, and the path length (m) from the start to each pose."""
    _require_in_range("key_frames_m", key_frame_spacing_m, 1e-3)
    key_frame_indices = choose_key_frames(path.position_m, key_frame_spacing_m)
    distance_m = cumulative_distance(path.position_m[key_frame_indices])
    # Small key frame spacings are for small paths: below 0.5 m, the minimum length is proportional
    # to the spacing. The lower limit excludes a path without motion
    min_length_m = max(MIN_PATH_LENGTH_M * min(1.0, key_frame_spacing_m / 0.5), 1e-6)
    if not distance_m[-1] >= min_length_m:  # also if the length is not a number (NaN)
        raise TrajectoryError(
            f"{path.name}: the path of {distance_m[-1]:.2f} m is too short for key frames every "
            f"{key_frame_spacing_m:g} m",
            "Change the time span (--from, --to) or --key-frames.",
        )
    return key_frame_indices, np.interp(path.time_s, path.time_s[key_frame_indices], distance_m)


def _require_in_range(name: str, value: float, min_value: float) -> None:
    if not min_value <= value <= MAX_LOOP_OPTION_VALUE:
        raise SettingsError(
            f"`{name}` {value:g} is out of range ({min_value:g} to {MAX_LOOP_OPTION_VALUE:g})."
        )


def _require_valid_closure(closure: GivenClosure, path: Trajectory) -> None:
    """Raise TrajectoryError if times or σ of a loop closure are not possible for a path."""
    start_s, end_s = path.time_s[[0, -1]]
    closure_text = f"{path.name}: loop closure {closure.time_1_s:.12g},{closure.time_2_s:.12g}"
    if not start_s <= closure.time_1_s < closure.time_2_s <= end_s:
        raise TrajectoryError(
            f"{closure_text}: the times must be in ascending order, between {start_s:.2f} s and "
            f"{end_s:.2f} s."
        )
    if not 1e-4 <= closure.sigma_m <= MAX_LOOP_OPTION_VALUE:
        raise TrajectoryError(
            f"{closure_text}: SIGMA {closure.sigma_m:g} is out of range (0.0001 to 100 m)."
        )


def _compute_heading_error(
    true_end: TrueFinalPose | Unavailable, heading_change_deg: float | None
) -> float | Unavailable:
    """Return the heading error (°) at the end of the loop, from -180° to 180°."""
    quantity = "heading error at the end of the loop"
    if isinstance(true_end, Unavailable):
        return true_end
    if heading_change_deg is None:
        return Unavailable(
            quantity, "the trajectory has no orientations", "Use a trajectory with orientations."
        )
    if true_end.heading_change_deg is None:
        return Unavailable(
            quantity,
            f"the heading changes by {heading_change_deg:+.0f}°, and the true heading change is "
            "unknown",
            "Give the true heading change in flight: px4fuse loop --landed-at FORWARD,RIGHT,DEG.",
        )
    return math.remainder(heading_change_deg - true_end.heading_change_deg, 360.0)


def analyse_flight_loop(
    flight: Flight,
    progress: Progress = ignore_progress,
    analysed_span_s: Span | None = None,
) -> Loop | Unavailable:
    """Compute the loop closure error of the odometry of a flight.

    The result is Unavailable without odometry, if the path does not return to its start, or if
    the analysed time span (s) begins or ends in flight.
    """
    if analysed_span_s is not None and not isinstance(flight.airborne, Unavailable):
        for take_off_s, landing_s in flight.airborne:
            if any(take_off_s < limit_s < landing_s for limit_s in analysed_span_s):
                return Unavailable(
                    "loop closure",
                    "the analysed time span begins or ends in flight",
                    "Omit --start and --end, or give a loop closure with px4fuse loop --closure.",
                )
    try:
        trajectory = trajectory_of(flight, "vio")
    except MissingDataError as error:  # missing odometry, or too few poses
        odometry = find_odometry(flight)
        reason = odometry.reason if isinstance(odometry, Unavailable) else str(error).rstrip(".")
        return Unavailable(
            "loop closure",
            reason,
            "Send visual-inertial odometry to PX4 as MAVLink message ODOMETRY.",
        )
    segment = loop_segment.choose_loop_segment(flight, trajectory, None, None)
    position_m = trajectory.cut_to_span(segment.start_s, segment.end_s).position_m
    extent_m = compute_extent_m(position_m)
    # A loop is at least as long as the way to its farthest point and back
    min_path_length_m = 2.0 * extent_m
    end_to_start_distance_m = float(np.linalg.norm(position_m[-1] - position_m[0]))
    if (
        min_path_length_m < MIN_FLIGHT_LOOP_PATH_M
        or end_to_start_distance_m > MAX_END_TO_START_DISTANCE_FRACTION * min_path_length_m
    ):
        return Unavailable(
            "loop closure",
            f"the odometry has an extent of {extent_m:.1f} m and ends "
            f"{end_to_start_distance_m:.1f} m from its start: no loop",
            "Fly back to the take-off place, or give a loop closure with px4fuse loop --closure.",
        )
    return analyse(LoopSource(trajectory, flight), progress=progress)
