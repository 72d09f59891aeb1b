"""Trajectories from files of their own, or out of a flight: odometry, EKF2, our filter, truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.projection import continuous_state
from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.filter.signals import Segment
from px4fuse.flight import AXIS_NAMES, Columns, Ekf2, Flight, PositionTrack, Truth, Unavailable
from px4fuse.readers import read_log
from px4fuse.readers.parts import finite_rows
from px4fuse.readers.text_table import decode_text
from px4fuse.readers.trajectory import read_trajectory
from px4fuse.reading import display_name, read_head
from px4fuse.record import missing_data
from px4fuse.trajectory.model import MIN_POSES, Frame, Kind, Trajectory

FlightPart = Literal["vio", "ekf2", "kf", "truth"]
FLIGHT_PARTS: tuple[FlightPart, ...] = get_args(FlightPart)
_HEAD_BYTES = 4096
_G2O = (b"VERTEX_", b"EDGE_", b"FIX")


def odometry_of(flight: Flight) -> PositionTrack | Unavailable:
    """The track that is an odometry: external vision with an orientation that turns.

    A positioning system such as UWB sends no orientation, or always the same one.
    """
    for track in flight.positions:
        if track.origin.is_vision and track.orientation is not None:
            return track
    have = ", ".join(track.name for track in flight.positions) or "none"
    return missing_data("no_odometry", have=have)


def trajectory_of(flight: Flight, part: FlightPart) -> Trajectory:
    """One part of a flight as a trajectory.

    Parameters
    ----------
    flight : Flight
    part : {"vio", "ekf2", "kf", "truth"}
        "kf" is our filter, along north, east and down, with the autopilot's attitude.

    Raises
    ------
    MissingDataError
        The log lacks it; the text says what would have logged it.
    """
    if part == "kf":
        return _kf_trajectory(flight)
    found = {"vio": odometry_of(flight), "truth": flight.truth, "ekf2": flight.ekf2}[part]
    if isinstance(found, PositionTrack):
        # where the log does not say, x is taken to be forward at the start
        frame: Frame = "NED" if found.frame == "NED" else "FRD"
        note = f"{found.name}: {found.description}"
        return _trajectory(flight, part, found.samples, found.orientation, (note,), frame)
    if isinstance(found, Truth):
        return _trajectory(flight, part, found.samples, found.attitude, (found.name,))
    if not isinstance(found, Ekf2):
        raise MissingDataError(f"{flight.log.name}:{part}: {found.reason}", f"{found.remedy}")
    state, notes = found.state, ["EKF2's position as published"]
    source = next((t for t in flight.positions if t.origin.is_vision), None)
    if source is not None:
        log_segment = Segment(0.0, flight.log.duration_s, "the whole log")
        state, resets = continuous_state(found, source, log_segment)
        notes += [resets] if resets else []
    return _trajectory(flight, part, state, flight.attitude, tuple(notes))


def _kf_trajectory(flight: Flight) -> Trajectory:
    kf_comparison = compare(flight, axes=AXIS_NAMES)
    columns = zip(Columns.POSITION, kf_comparison.axes.values(), strict=True)
    position = pd.DataFrame({name: axis.replay.steps["position_m"] for name, axis in columns})
    used = kf_comparison.settings
    noises = f"SIGMA_A {used.sigma_a_m_s2:g} m/s², SIGMA_Z {used.sigma_z_m:g} m"
    note = f"our filter over {kf_comparison.source.name}, {noises}"
    return _trajectory(flight, "kf", position, flight.attitude, (note,))


def _trajectory(
    flight: Flight,
    part: Kind,
    samples: pd.DataFrame,
    orientation: pd.DataFrame | Unavailable | None,
    notes: tuple[str, ...],
    frame: Frame = "NED",
) -> Trajectory:
    """Poses at the times of the positions, the orientation interpolated to them (slerp)."""
    samples = finite_rows(samples, Columns.POSITION)
    rotation, rotation_variance = None, None
    if isinstance(orientation, pd.DataFrame):
        known = orientation.index.to_numpy()
        inside = samples[(samples.index >= known[0]) & (samples.index <= known[-1])]
        if len(inside) >= MIN_POSES:
            samples = inside
            quaternions = orientation[Columns.QUATERNION].to_numpy(copy=True)
            turns = Rotation.from_quat(quaternions, scalar_first=True)
            rotation = Slerp(known, turns)(samples.index.to_numpy())
            reported = _complete_variances(orientation, Columns.ROTATION_VARIANCE)
            if reported is not None:
                columns = [np.interp(samples.index, known, column) for column in reported.T]
                rotation_variance = np.column_stack(columns)
    if len(samples) < MIN_POSES:
        raise MissingDataError(
            f"{flight.log.name}:{part}: {len(samples)} poses are too few (at least {MIN_POSES})."
        )
    return Trajectory(
        name=f"{flight.log.name}:{part}",
        kind=part,
        time_s=samples.index.to_numpy(np.float64),
        position_m=samples[Columns.POSITION].to_numpy(np.float64),
        rotation=rotation,
        frame=frame,
        unix_offset_s=flight.log.start_unix_s,
        position_variance_m2=_complete_variances(samples, Columns.POSITION_VARIANCE),
        rotation_variance_rad2=rotation_variance,
        sha256=flight.log.sha256,
        size_bytes=flight.log.bytes,
        notes=notes,
    )


def _complete_variances(samples: pd.DataFrame, columns: list[str]) -> Array | None:
    """Reported variances, shape (n, 3); None where there are none, or some are missing."""
    if not set(columns) <= set(samples.columns) or samples[columns].isna().to_numpy().any():
        return None
    return samples[columns].to_numpy(np.float64)


@dataclass(frozen=True)
class LoopSource:
    """A trajectory and, where it is part of one, the flight."""

    trajectory: Trajectory
    flight: Flight | None


def file_name(source: Path) -> str:
    """What a source is called in a file name: ``flight_vio`` of ``flight.ulg:vio``."""
    path, part = split_part(str(source))
    return path.stem if part is None else f"{path.stem}_{part}"


def split_part(argument: str) -> tuple[Path, FlightPart | None]:
    """File and part of ``FILE`` or ``LOG:vio``, ``LOG:ekf2``, ``LOG:kf``, ``LOG:truth``.

    Raises
    ------
    TrajectoryError
        What follows the colon is no part.
    """
    full_path = Path(argument)
    path, colon, part = argument.rpartition(":")
    if full_path.exists() or not colon:
        return full_path, None
    if part in FLIGHT_PARTS:
        return Path(path), part
    if Path(path).is_file():
        raise TrajectoryError.of(
            "no_such_part", path=display_name(Path(path)), part=part, known=", ".join(FLIGHT_PARTS)
        )
    return full_path, None


def is_g2o(path: Path) -> bool:
    """Whether a file is a pose graph in g2o's format.

    Raises
    ------
    TrajectoryError
        It cannot be read.
    """
    head = read_head(path, _HEAD_BYTES, TrajectoryError)
    return decode_text(head) is not None and any(
        line.strip().startswith(_G2O) for line in head.splitlines()
    )


def read_source(
    argument: str,
    *,
    default: FlightPart | None = None,
    frame: Frame | None = None,
    system: int | None = None,
) -> LoopSource:
    """Read a trajectory from a file, or a part of a flight log.

    Parameters
    ----------
    argument : str
        As :func:`split_part` takes it.
    default : Part, optional
        Part of a log that is taken where none is named; by default its odometry, or EKF2's track
        where it has none.
    frame : Frame, optional
        What a file's axes are, where that is known better than its reader can tell.
    system : int, optional
        MAVLink system id.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError
        It cannot be read, or lacks the part.
    SettingsError
        A flight log states its frame.
    """
    path, part = split_part(argument)
    head = read_head(path, _HEAD_BYTES, TrajectoryError)
    if not head:
        raise TrajectoryError(
            f"{display_name(path)}: the file is empty", "Copy or export it again."
        )
    if is_g2o(path):
        raise TrajectoryError.of("graph_not_trajectory", path=display_name(path))
    if decode_text(head) is not None:  # and so no flight log
        if part is not None:
            raise TrajectoryError.of("part_of_trajectory", path=display_name(path), part=part)
        trajectory = read_trajectory(path)
        return LoopSource(trajectory if frame is None else replace(trajectory, frame=frame), None)
    if frame is not None:
        raise SettingsError.of("frame_of_log", frame=frame.lower(), path=display_name(path))
    flight = read_log(path, system=system)
    chosen = part or default
    if chosen is None:
        odometry, chosen = odometry_of(flight), "vio"
        if isinstance(odometry, Unavailable):
            chosen = "ekf2"
            if isinstance(flight.ekf2, Unavailable):
                raise MissingDataError(f"{flight.log.name}: {odometry.reason}", odometry.remedy)
    return LoopSource(trajectory_of(flight, chosen), flight)
