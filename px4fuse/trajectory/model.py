"""What a trajectory is: poses over time, from a file or out of a flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.record import Count, Record

# What made it; "slam" is a system whose world is its first key frame (ORB-SLAM3 and the like)
Kind = Literal["vio", "ekf2", "kf", "truth", "slam", "unknown"]
# Axes of its world: "NED" and "FRD" have z down, "ENU" z up, "camera" y down and z forward
Frame = Literal["NED", "FRD", "ENU", "camera", "unknown"]
MIN_POSES = 3
AXES_OF_FRAME: Mapping[Frame, tuple[str, str, str]] = {
    "NED": ("north", "east", "down"),
    "FRD": ("forward", "right", "down"),
    "ENU": ("east", "north", "up"),
    "camera": ("right", "down", "forward"),
    "unknown": ("x", "y", "z"),
}


# A vector by the names of a frame's axes
AxisLengths = Annotated[dict[str, float], Meta(min_length=3, max_length=3)]


# Where what is negative along an axis lies
OPPOSITE = {
    "north": "south",
    "east": "west",
    "up": "down",
    "down": "up",
    "forward": "back",
    "right": "left",
}


def format_vector(vector_m: Mapping[str, float]) -> str:
    """A vector by the names of the axes, without signs where the axes have a direction.

    >>> format_vector({"forward": 1.0, "right": -0.5}), format_vector({"x": -1.0})
    ('1.00 m forward, 0.50 m left', '-1.00 m along x')
    """
    return ", ".join(
        f"{value:.2f} m along {name}"
        if name not in OPPOSITE
        else f"{abs(value):.2f} m {OPPOSITE[name] if value < 0.0 else name}"
        for name, value in vector_m.items()
    )


def by_axis(frame: Frame, vector_m: Array) -> dict[str, float]:
    """A vector by the names of the axes."""
    return dict(zip(AXES_OF_FRAME[frame], vector_m.tolist(), strict=True))


class Track(Record, frozen=True):
    """A trajectory as results name it, and the file that it was read from."""

    name: str
    sha256: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")]
    size_bytes: Count
    kind: Kind
    frame: Frame
    poses: Count
    start_s: float
    end_s: float
    orientations: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Trajectory:
    """Poses over time.

    Attributes
    ----------
    name : str
        File name without its folder, with the part for a log ("log.ulg:vio").
    kind : Kind
    time_s : ndarray, shape (n,)
        Strictly increasing seconds: the file's own stamps, or seconds from a log's first data.
    position_m : ndarray, shape (n, 3)
        In ``frame``.
    rotation : Rotation of n, or None
        Turns vectors of the body (or camera) into ``frame``; None where only positions are known.
    frame : Frame
    unix_offset_s : float or None
        What must be added to ``time_s`` to give UNIX time; None where that is not known.
    position_variance_m2, rotation_variance_rad2 : ndarray, shape (n, 3), or None
        As the estimator itself reported them, rotation about the body's axes; None where it gave
        none.
    sha256 : str
        Of the file that it was read from.
    size_bytes : int
        Of that file.
    notes : tuple of str
        What the reader recognised and did, each a sentence.
    """

    name: str
    kind: Kind
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

    @property
    def is_of_log(self) -> bool:
        """Whether it is part of a flight log, on the autopilot's boot clock."""
        return self.name.endswith(f":{self.kind}")

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, selection: slice | BoolArray | IntArray) -> Trajectory:
        """Some of its poses, in order.

        Parameters
        ----------
        selection : slice, boolean array of shape (n,), or integer array
        """
        array_fields = (
            "time_s",
            "position_m",
            "rotation",
            "position_variance_m2",
            "rotation_variance_rad2",
        )
        known_arrays: dict[str, Any] = {name: getattr(self, name) for name in array_fields}
        selected = {
            name: values[selection] for name, values in known_arrays.items() if values is not None
        }
        return replace(self, **selected)

    def moved(self, position_m: Array, world_rotation: Rotation | None = None) -> Trajectory:
        """The same poses elsewhere, of which no reported variance holds any longer.

        ``world_rotation`` is of their world: one, or one for each pose.
        """
        rotated = (
            self.rotation
            if self.rotation is None or world_rotation is None
            else world_rotation * self.rotation
        )
        no_variances: dict[str, Any] = {
            "position_variance_m2": None,
            "rotation_variance_rad2": None,
        }
        return replace(self, position_m=position_m, rotation=rotated, **no_variances)

    def track(self) -> Track:
        """What results say about it."""
        track_fields = ("name", "sha256", "size_bytes", "kind", "frame", "notes")
        return Track(
            **{name: getattr(self, name) for name in track_fields},
            poses=len(self),
            start_s=float(self.time_s[0]),
            end_s=float(self.time_s[-1]),
            orientations=self.rotation is not None,
        )


def cumulative_distance(position_m: Array) -> Array:
    """Length of the path from its start to each position, shape (n, d) to (n,), in m."""
    steps = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
