"""Trajectories from files and flight logs: odometry, EKF2, KF and ground truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.preparation import prepare_comparison_inputs
from px4fuse.comparison.projection import remove_origin_resets
from px4fuse.core.arrays import Array, interpolate_columns
from px4fuse.core.reading import display_name, read_head, split_path_and_part
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight.model import (
    AXIS_NAMES,
    DIAGNOSIS_WITHHELD,
    Columns,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.readers.common import select_valid_rows
from px4fuse.readers.recording_table import decode_text
from px4fuse.readers.ros_bag import is_bag
from px4fuse.readers.trajectory import read_trajectory
from px4fuse.request import SIGMA_Z_M, ComparisonRequest
from px4fuse.trajectory.model import MIN_POSES, Frame, Trajectory, TrajectoryKind

TrackName = Literal["vio", "ekf2", "kf", "truth"]
TRACK_NAMES: tuple[TrackName, ...] = get_args(TrackName)
_FILE_HEAD_BYTES = 4096
_G2O_TAGS = (b"VERTEX_", b"EDGE_", b"FIX")


def find_odometry(flight: Flight) -> PositionTrack | Unavailable:
    """Return the odometry of a flight: external vision with orientation."""
    for track in flight.positions:
        if track.origin.is_vision and track.orientation is not None:
            return track
    source_list_text = ", ".join(track.name for track in flight.positions) or "none"
    return Unavailable(
        "visual-inertial odometry",
        f"the log has no external vision with orientation (position sources: {source_list_text})",
        "Send odometry to PX4 as MAVLink message ODOMETRY, and set SDLOG_PROFILE to 129.",
    )


def trajectory_of(flight: Flight, track_name: TrackName) -> Trajectory:
    """Return a track of a flight as a trajectory.

    Parameters
    ----------
    flight : Flight
    track_name : {"vio", "ekf2", "kf", "truth"}
        Odometry, EKF2, KF with the attitude of EKF2, or ground truth.

    Raises
    ------
    MissingDataError
        The log does not contain the track.
    """
    if track_name == "kf":
        return _make_kf_trajectory(flight)
    truth = DIAGNOSIS_WITHHELD if flight.log.is_assessed else flight.truth
    track_data = {"vio": find_odometry(flight), "truth": truth, "ekf2": flight.ekf2}[track_name]
    if isinstance(track_data, Unavailable):
        raise MissingDataError(
            f"{flight.log.name}:{track_name}: {track_data.reason}", track_data.remedy
        )
    if isinstance(track_data, PositionTrack):  # odometry
        # Without a frame in the log, x is assumed to be forward at the start (FRD)
        frame: Frame = "NED" if track_data.frame == "NED" else "FRD"
        note = f"{track_data.name}: {track_data.description}"
        return _make_trajectory(
            flight, track_name, track_data.samples, track_data.orientation, (note,), frame
        )
    if isinstance(track_data, Truth):
        return _make_trajectory(
            flight, track_name, track_data.samples, track_data.attitude, (track_data.name,)
        )
    # EKF2
    state = track_data.state
    notes = ["EKF2 position as published by PX4"]
    vision_tracks = [track for track in flight.positions if track.origin.is_vision]
    if vision_tracks:
        segment = Segment(0.0, flight.log.duration_s, "")
        state, reset_note = remove_origin_resets(track_data, vision_tracks[0], segment)
        if reset_note:
            notes.append(reset_note)
    return _make_trajectory(flight, track_name, state, flight.attitude, tuple(notes))


def _make_kf_trajectory(flight: Flight) -> Trajectory:
    """Run KF with default settings, and return its positions with the attitude of EKF2."""
    request = ComparisonRequest(log=flight.log.name, sigma_z_m=SIGMA_Z_M, axes=AXIS_NAMES)
    prepared_comparison = prepare_comparison_inputs(flight, request)
    kf_comparison = compare(prepared_comparison)
    columns = zip(Columns.POSITION, kf_comparison.axes.values(), strict=True)
    position_samples = pd.DataFrame(
        {name: axis.kf_run.steps["position_m"] for name, axis in columns}
    )
    settings = kf_comparison.settings
    note = (
        f"KF with position source {kf_comparison.source.name}, SIGMA_A {settings.sigma_a_m_s2:g} "
        f"m/s², SIGMA_Z {settings.sigma_z_m:g} m"
    )
    return _make_trajectory(flight, "kf", position_samples, flight.attitude, (note,))


def _make_trajectory(
    flight: Flight,
    track_name: TrajectoryKind,
    position_samples: pd.DataFrame,
    orientation: pd.DataFrame | Unavailable | None,
    notes: tuple[str, ...],
    frame: Frame = "NED",
) -> Trajectory:
    """Make a trajectory from positions, with orientations interpolated to their times."""
    position_samples = select_valid_rows(position_samples, Columns.POSITION)
    rotation = rotation_variance = None
    if isinstance(orientation, pd.DataFrame):
        orientation_times_s = orientation.index.to_numpy()
        covered_samples = position_samples.loc[orientation_times_s[0] : orientation_times_s[-1]]
        if len(covered_samples) >= MIN_POSES:
            position_samples = covered_samples
            rotations = Rotation.from_quat(
                orientation[Columns.QUATERNION].to_numpy(copy=True), scalar_first=True
            )
            rotation = Slerp(orientation_times_s, rotations)(position_samples.index.to_numpy())
            reported_variance = _read_reported_variances(orientation, Columns.ROTATION_VARIANCE)
            if reported_variance is not None:
                rotation_variance = interpolate_columns(
                    position_samples.index.to_numpy(), orientation_times_s, reported_variance
                )
    if len(position_samples) < MIN_POSES:
        raise MissingDataError(
            f"{flight.log.name}:{track_name} has {len(position_samples)} poses; {MIN_POSES} are "
            "needed"
        )
    return Trajectory(
        name=f"{flight.log.name}:{track_name}",
        kind=track_name,
        time_s=position_samples.index.to_numpy(np.float64),
        position_m=position_samples[Columns.POSITION].to_numpy(np.float64),
        rotation=rotation,
        frame=frame,
        unix_offset_s=flight.log.start_unix_s,
        position_variance_m2=_read_reported_variances(position_samples, Columns.POSITION_VARIANCE),
        rotation_variance_rad2=rotation_variance,
        sha256=flight.log.sha256,
        size_bytes=flight.log.bytes,
        notes=notes,
    )


def _read_reported_variances(samples: pd.DataFrame, columns: list[str]) -> Array | None:
    """Return reported variances, shape (n, 3), or None if values are missing."""
    variances = samples.reindex(columns=columns).to_numpy(np.float64)
    return None if np.isnan(variances).any() else variances


@dataclass(frozen=True)
class LoopSource:
    """Trajectory of a loop, and the flight if the trajectory is from a flight log."""

    trajectory: Trajectory
    flight: Flight | None


def make_file_stem(source: Path) -> str:
    """Return the stem of output file names, such as ``flight_vio`` for ``flight.ulg:vio``."""
    path, track_name = split_path_and_part(str(source))
    return "_".join([path.stem, *(track_name or "").split("/")]).rstrip("_")


def is_g2o(path: Path) -> bool:
    """Return True if a file is a pose graph in g2o format.

    Raises
    ------
    TrajectoryError
        The file cannot be read.
    """
    file_head = b"" if is_bag(path) else read_head(path, _FILE_HEAD_BYTES, TrajectoryError)
    return decode_text(file_head) is not None and any(
        line.strip().startswith(_G2O_TAGS) for line in file_head.splitlines()
    )


def read_trajectory_source(
    argument: str,
    *,
    default_track: TrackName | None = None,
    frame: Frame | None = None,
    system: int | None = None,
) -> LoopSource:
    """Read a trajectory from a file or flight log.

    Parameters
    ----------
    argument : str
        ``FILE``, ``LOG:TRACK``, ``TABLE:BODY`` (body of a motion capture table) or ``BAG:TOPIC``.
    default_track : {"vio", "ekf2", "kf", "truth"}, optional
        Default track of a flight log.
    frame : Frame, optional
        Frame of a trajectory file.
    system : int, optional
        MAVLink system id.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError
        The file cannot be read, or does not contain the track.
    SettingsError
        ``frame`` is given for a flight log.
    """
    path, track_name = split_path_and_part(argument)
    if is_g2o(path):
        raise TrajectoryError(
            f"{display_name(path)} is a pose graph, not a trajectory.",
            f"Optimise the pose graph with px4fuse loop {display_name(path)}.",
        )
    # Text files and bags contain trajectories; flight logs are binary
    if is_bag(path) or decode_text(read_head(path, _FILE_HEAD_BYTES, TrajectoryError)) is not None:
        trajectory = read_trajectory(path, track_name)
        return LoopSource(trajectory if frame is None else replace(trajectory, frame=frame), None)
    if frame is not None:
        raise SettingsError(
            f"--frame is only for trajectory files, but {display_name(path)} is a flight log",
            "Omit --frame.",
        )
    flight = read_log(path, system=system)
    if track_name not in (None, *TRACK_NAMES):
        raise TrajectoryError(
            f"{display_name(path)}: a flight log contains no trajectory {track_name!r}",
            f"Choose a trajectory: {', '.join(TRACK_NAMES)}.",
        )
    chosen_track_name = track_name or default_track
    if chosen_track_name is None:
        has_only_ekf2 = isinstance(find_odometry(flight), Unavailable) and not isinstance(
            flight.ekf2, Unavailable
        )
        chosen_track_name = "ekf2" if has_only_ekf2 else "vio"
    return LoopSource(trajectory_of(flight, chosen_track_name), flight)
