"""Trajectory: poses over time, from a file or a flight log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, BoolArray, IntArray
from px4fuse.core.record import Count, Record, one_line_repr

# Source of a trajectory; "slam": its frame is that of the first key frame
TrajectoryKind = Literal["vio", "ekf2", "kf", "truth", "slam", "unknown"]
# World frame; in "camera", y is down and z is forward
Frame = Literal["NED", "FRD", "ENU", "camera", "unknown"]
MIN_POSES = 3
# Columns of north, east and down in (x, y, z), and their signs, by frame
NED_COMPONENTS_BY_FRAME = {
    "ned": ([0, 1, 2], [1.0, 1.0, 1.0]),
    "enu": ([1, 0, 2], [1.0, 1.0, -1.0]),
    "nwu": ([0, 1, 2], [1.0, -1.0, -1.0]),
    "eus": ([2, 0, 1], [-1.0, 1.0, -1.0]),
    "edn": ([2, 0, 1], [1.0, 1.0, 1.0]),
}
AXES_OF_FRAME: Mapping[Frame, tuple[str, str, str]] = {
    "NED": ("north", "east", "down"),
    "FRD": ("forward", "right", "down"),
    "ENU": ("east", "north", "up"),
    "camera": ("right", "down", "forward"),
    "unknown": ("x", "y", "z"),
}


VectorComponents = Annotated[dict[str, float], Meta(min_length=3, max_length=3)]


OPPOSITE_DIRECTIONS = {
    "north": "south",
    "east": "west",
    "up": "down",
    "down": "up",
    "forward": "back",
    "right": "left",
}


def format_vector(vector_m: Mapping[str, float]) -> str:
    """Format the components of a vector as distances in named directions.

    >>> format_vector({"forward": 1.0, "right": -0.5}), format_vector({"x": -1.0})
    ('1.00 m forward, 0.50 m left', '-1.00 m along x')
    """
    return ", ".join(
        f"{value:.2f} m along {name}"
        if name not in OPPOSITE_DIRECTIONS
        else f"{abs(value):.2f} m {OPPOSITE_DIRECTIONS[name] if value < 0.0 else name}"
        for name, value in vector_m.items()
    )


def split_by_axis(frame: Frame, vector_m: Array) -> dict[str, float]:
    """Return the components of a vector by axis name."""
    return dict(zip(AXES_OF_FRAME[frame], vector_m.tolist(), strict=True))


class TrajectorySummary(Record):
    """Summary of a trajectory and its file, for results.json."""

    name: str
    sha256: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")]
    size_bytes: Count
    kind: TrajectoryKind
    frame: Frame
    poses: Count
    start_s: float
    end_s: float
    orientations: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Trajectory:
    """Positions and orientations over time.

    Attributes
    ----------
    name : str
        File name; for a flight log with the name of the track ("log.ulg:vio").
    kind : TrajectoryKind
        Source of the trajectory.
    time_s : ndarray, shape (n,)
        Strictly increasing times (s).
    position_m : ndarray, shape (n, 3)
        Positions in ``frame``.
    rotation : Rotation of n, or None
        Rotations from body (or camera) axes to ``frame``.
    frame : Frame
        World frame.
    unix_offset_s : float or None
        UNIX time minus ``time_s``; None if unknown.
    position_variance_m2, rotation_variance_rad2 : ndarray, shape (n, 3), or None
        Variances reported by the estimator; of the rotation, about the body axes.
    sha256 : str
        SHA-256 of the file.
    size_bytes : int
        Size of the file.
    notes : tuple of str
        Sentences on the format and on missing data.
    """

    name: str
    kind: TrajectoryKind
    time_s: Array
    position_m: Array
    rotation: Rotation | None
    frame: Frame = "unknown"
    unix_offset_s: float | None = None
    position_variance_m2: Array | None = None
    rotation_variance_rad2: Array | None = None
    sha256: str = ""
    size_bytes: int = 0
    notes: tuple[str, ...] = ()

    __repr__ = one_line_repr

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, selection: slice | BoolArray | IntArray) -> Trajectory:
        """Select poses by slice, mask or indices."""
        selected_arrays: dict[str, Any] = {
            name: values[selection]
            for name, values in vars(self).items()
            if isinstance(values, np.ndarray | Rotation)
        }
        return replace(self, **selected_arrays)

    def cut_to_span(self, start_s: float, end_s: float) -> Trajectory:
        """Return the poses from ``start_s`` to ``end_s``."""
        return self[(self.time_s >= start_s) & (self.time_s <= end_s)]

    def replace_positions(
        self, position_m: Array, world_rotation: Rotation | None = None
    ) -> Trajectory:
        """Return the trajectory with new positions, and without reported variances.

        ``world_rotation`` rotates the orientations in the world frame.
        """
        rotation = self.rotation
        if rotation is not None and world_rotation is not None:
            rotation = world_rotation * rotation
        return replace(
            self,
            position_m=position_m,
            rotation=rotation,
            position_variance_m2=None,
            rotation_variance_rad2=None,
        )

    def describe_track(self) -> TrajectorySummary:
        """Return a summary of the trajectory for results.json."""
        track_fields = ("name", "sha256", "size_bytes", "kind", "frame", "notes")
        return TrajectorySummary(
            **{name: getattr(self, name) for name in track_fields},
            poses=len(self),
            start_s=float(self.time_s[0]),
            end_s=float(self.time_s[-1]),
            orientations=self.rotation is not None,
        )


def compute_extent_m(position_m: Array) -> float:
    """Return the diagonal (m) of the box around positions; 0 without positions."""
    return float(np.linalg.norm(np.ptp(position_m, axis=0))) if len(position_m) else 0.0


def cumulative_distance(position_m: Array) -> Array:
    """Return the path length (m) from the start to each position, shape (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position_m, axis=0), axis=1))])
