"""Where a trajectory comes from: a file of its own, or a part of a flight log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from px4fuse.errors import MissingDataError, SettingsError, TrajectoryError
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.tracks import PARTS, Part, odometry_of, trajectory_of
from px4fuse.readers import read_log
from px4fuse.readers.trajectory import read_trajectory
from px4fuse.reading import read_head, shown
from px4fuse.trajectory.model import Frame, Trajectory

_HEAD_BYTES = 4096
_UTF16 = b"\xff\xfe"  # what a Windows shell's redirection writes
_G2O = (b"VERTEX_", b"EDGE_", b"FIX")


@dataclass(frozen=True)
class LoopSource:
    """A trajectory and, where it is part of one, the flight."""

    trajectory: Trajectory
    flight: Flight | None


def file_name(source: Path) -> str:
    """What a source is called in a file name: ``flight_vio`` of ``flight.ulg:vio``."""
    path, part = split_part(str(source))
    return path.stem if part is None else f"{path.stem}_{part}"


def split_part(argument: str) -> tuple[Path, Part | None]:
    """File and part of ``FILE`` or ``LOG:vio``, ``LOG:ekf2``, ``LOG:kf``, ``LOG:truth``.

    Raises
    ------
    TrajectoryError
        What follows the colon is no part.
    """
    whole = Path(argument)
    path, colon, part = argument.rpartition(":")
    if whole.exists() or not colon:
        return whole, None
    if part in PARTS:
        return Path(path), part
    if Path(path).is_file():
        raise TrajectoryError(
            f"{shown(Path(path))}:{part}: {part!r} is not a part of a flight",
            f"Choose from {', '.join(PARTS)}.",
        )
    return whole, None


def _is_text(head: bytes) -> bool:
    """Whether a file that begins like this is text, and so no flight log."""
    binary = any(byte < 9 or 13 < byte < 32 for byte in head)
    return head.startswith(_UTF16) or (bool(head) and not binary)


def is_g2o(path: Path) -> bool:
    """Whether a file is a pose graph in g2o's format.

    Raises
    ------
    TrajectoryError
        It cannot be read.
    """
    head = read_head(path, _HEAD_BYTES, TrajectoryError)
    return _is_text(head) and any(line.strip().startswith(_G2O) for line in head.splitlines())


def read_source(
    argument: str,
    *,
    default: Part | None = None,
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
        raise TrajectoryError(f"{shown(path)}: the file is empty", "Copy or export it again.")
    if is_g2o(path):
        raise TrajectoryError(
            f"{shown(path)}: a pose graph, not a trajectory",
            f"Solve it with px4fuse loop {shown(path)}.",
        )
    if _is_text(head):
        if part is not None:
            raise TrajectoryError(
                f"{shown(path)}: a trajectory file has no part {part!r}", "Leave it out."
            )
        trajectory = read_trajectory(path)
        return LoopSource(trajectory if frame is None else replace(trajectory, frame=frame), None)
    if frame is not None:
        raise SettingsError(
            f"`frame` {frame.lower()} is for trajectory files; {shown(path)} is a flight log, "
            "which states its frame",
            "Leave `frame` out.",
        )
    flight = read_log(path, system=system)
    chosen = part or default
    if chosen is None:
        odometry, chosen = odometry_of(flight), "vio"
        if isinstance(odometry, Unavailable):
            chosen = "ekf2"
            if isinstance(flight.ekf2, Unavailable):
                raise MissingDataError(f"{flight.log.name}: {odometry.reason}", odometry.remedy)
    return LoopSource(trajectory_of(flight, chosen), flight)
