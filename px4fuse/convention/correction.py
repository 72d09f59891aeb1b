"""Faults of a source's convention, and the flight and source without them."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.arrays import Array
from px4fuse.convention.axes import CLOCKWISE, UNITS
from px4fuse.convention.model import Convention
from px4fuse.convention.motion import read_inertial, replace_heading
from px4fuse.convention.orientation import to_attitude
from px4fuse.flight import Columns, Ekf2, Flight, PositionTrack, Unavailable
from px4fuse.trajectory.rotation import heading

# Minimum rotation (°) of a frame with other axes, and of a frame that is only rotated: smaller
# ones are in the reach of the estimate of the heading error
MIN_REMAINDER_DEG, MIN_ROTATION_DEG = 8.0, 15.0
MIN_LATE_S = 0.5  # smaller time offsets are in the reach of the estimate of the time offset
MIN_HEADING_ERROR_DEG = 10.0  # of an orientation relative to its own positions
# Directions of positive and negative axes
DIRECTIONS = {
    "north": (1, 0, 0), "east": (0, 1, 0), "down": (0, 0, 1),
    "south": (-1, 0, 0), "west": (0, -1, 0), "up": (0, 0, -1),
}  # fmt: skip
OrientationFault = Literal["", "copied", "order", "frames", "heading"]


@dataclass(frozen=True)
class Faults:
    """Significant faults of a convention.

    Attributes
    ----------
    axes : bool
        True if the axes are not those of NED, except for a rotation about the vertical.
    rotation_deg : float
        Rotation of the positions relative to NED, or to ENU or NWU with these axes; clockwise.
    unit : bool
    late_s, clock_drift : float
        0 if not significant.
    orientation : str
        Fault of the orientation; "" if there is none.
    affects_ekf2 : bool
        True if EKF2 fused a faulty source, so that its attitude is wrong, too.
    is_north_unknown : bool
        True if EKF2's heading came from the source, so that the rotation is unknown.
    is_ambiguous : bool
        True if other conventions than NED in metres fit equally well, but NED does not.
    """

    axes: bool = False
    rotation_deg: float = 0.0
    unit: bool = False
    late_s: float = 0.0
    clock_drift: float = 0.0
    orientation: OrientationFault = ""
    affects_ekf2: bool = False
    is_north_unknown: bool = False
    is_ambiguous: bool = False

    @property
    def of_positions(self) -> bool:
        """True if the positions as sent are wrong."""
        return bool(self.axes or self.rotation_deg or self.unit or self.late_s or self.clock_drift)

    def __bool__(self) -> bool:
        """Return True if there is any fault."""
        return self != Faults()


def find_faults(convention: Convention | None, flight: Flight, frame: str) -> Faults:
    """Return the faults of a convention; ``frame`` is the stated frame of the source."""
    if convention is None:
        return Faults()
    orientation, fault = convention.orientation, _orientation_fault(convention)
    if convention.verdict == "ambiguous":
        is_usual = "x north, y east, z down, m" in (
            f"x {convention.x}, y {convention.y}, z {convention.z}, {convention.unit}",
            *(text.partition(", rotated")[0].partition(", timestamps")[0]
              for text in convention.alternatives),
        )  # fmt: skip
        return Faults(orientation=fault, is_ambiguous=not is_usual)
    if convention.verdict != "determined":
        return Faults(orientation=fault)
    ekf2 = flight.ekf2
    fusing = ekf2.fusing if isinstance(ekf2, Ekf2) else ekf2
    is_fused = isinstance(fusing, pd.DataFrame) and bool((fusing > 0).any(axis=None))
    axes, rotation_deg = _axes_and_rotation(convention)
    has_wrong_heading = fault in ("order", "heading")
    is_drifting = convention.heading_from == "gyroscopes"
    # if EKF2's heading came from the orientation, the positions have no reference to north
    has_own_heading = is_fused and is_drifting and orientation is not None and fault != "copied"
    is_other_drift = is_drifting and not is_fused and not axes
    if has_wrong_heading or has_own_heading or is_other_drift or frame == "FRD":
        rotation_deg = 0.0
    late_s = convention.late_s if abs(convention.late_s) >= MIN_LATE_S else 0.0
    faults = Faults(
        axes=axes,
        rotation_deg=rotation_deg,
        unit=convention.unit != "m",
        late_s=late_s,
        clock_drift=convention.clock_drift,
        orientation=fault,
        is_north_unknown=axes and has_own_heading,
    )
    is_wrong = faults.of_positions or has_wrong_heading
    return replace(faults, affects_ekf2=is_fused and is_wrong)


def _axes_and_rotation(convention: Convention) -> tuple[bool, float]:
    """Return True for axes other than NED, and the significant rotation (°) of the positions."""
    axes, rotation_deg = (convention.x, convention.y, convention.z), convention.rotation_deg
    is_rotated = abs(rotation_deg) > MIN_REMAINDER_DEG
    if convention.is_mirrored or convention.z not in ("up", "down"):
        return True, rotation_deg * is_rotated
    if convention.z == "up" and axes in (("east", "north", "up"), ("north", "west", "up")):
        return True, rotation_deg * is_rotated
    start_deg = 0.0 if convention.z == "down" else 90.0
    total_deg = rotation_deg - 90.0 * CLOCKWISE.index(convention.x) + start_deg
    total_deg = (total_deg + 180.0) % 360.0 - 180.0
    return convention.z == "up", total_deg * (abs(total_deg) > MIN_ROTATION_DEG)


def _orientation_fault(convention: Convention) -> OrientationFault:
    orientation = convention.orientation
    if orientation is None or orientation.verdict not in ("determined", "copied"):
        return ""
    if orientation.verdict == "copied":
        return "copied"
    if orientation.order != "w x y z":
        return "order"
    error_deg = orientation.heading_error_deg
    is_ned = convention.verdict == "determined" and convention.z == "down"
    if orientation.frames in {"FLU to NED", "FRD to ENU"} or (
        is_ned and orientation.frames != "FRD to NED"
    ):
        return "frames"
    if error_deg is not None and abs(error_deg) > MIN_HEADING_ERROR_DEG:
        return "heading"
    return ""


def correct(
    flight: Flight, track: PositionTrack, convention: Convention | None
) -> tuple[Flight, PositionTrack]:
    """Return the flight and the source without the faults of the convention.

    The positions become NED in metres, on the clock of the autopilot. A faulty orientation is
    converted or left out. If EKF2 fused a faulty source, the attitude of the gyroscopes replaces
    EKF2's, so that positions and attitude agree.
    """
    faults = find_faults(convention, flight, track.frame)
    if convention is None or not faults:
        return flight, track
    samples, orientation = track.samples, track.orientation
    to_ned = _matrix(convention, faults)
    position = samples[Columns.POSITION].to_numpy() @ to_ned.T
    variance = samples[Columns.POSITION_VARIANCE].to_numpy()
    known = np.nan_to_num(variance) @ (to_ned**2).T
    variance = np.where(np.isnan(variance).all(axis=1, keepdims=True), np.nan, known)
    samples = pd.DataFrame(
        np.hstack([position, variance]),
        _corrected_times(samples.index, faults),
        Columns.POSITION + Columns.POSITION_VARIANCE,
    )
    origin = track.origin
    if faults.orientation == "copied" and origin.kind == "vio":
        origin = structs.replace(origin, kind="uwb")
    if faults.orientation in ("copied", "heading"):
        orientation = None
    elif orientation is not None and convention.orientation is not None:
        quaternion = orientation[Columns.QUATERNION].to_numpy()
        attitude = to_attitude(quaternion, convention.orientation)
        orientation = orientation.assign(**dict(zip(Columns.QUATERNION, attitude.T, strict=True)))
        orientation = orientation.set_axis(_corrected_times(orientation.index, faults))
    track = replace(track, samples=samples, orientation=orientation, origin=origin)
    inertial = read_inertial(flight) if faults.affects_ekf2 else None
    if inertial is None or isinstance(inertial, Unavailable):
        return flight, track
    attitude = inertial.gyro
    if convention.heading_from == "EKF2":
        attitude = inertial.with_logged_heading
    if not faults.axes and not faults.rotation_deg:  # the positions refer to north
        turn_deg = convention.rotation_deg - 90.0 * CLOCKWISE.index(convention.x)
        attitude = replace_heading(attitude, heading(attitude) + np.radians(turn_deg))
    table = pd.DataFrame(attitude, pd.Index(inertial.time_s, name="time_s"), Columns.QUATERNION)
    return replace(flight, attitude=table), track


def _matrix(convention: Convention, faults: Faults) -> Array:
    """Return the matrix from the positions as sent to NED in metres."""
    scale = UNITS[convention.unit]
    if not faults.axes and not faults.rotation_deg:
        return scale * np.eye(3)
    columns = np.array([DIRECTIONS[name] for name in (convention.x, convention.y, convention.z)])
    is_rotated = abs(convention.rotation_deg) > MIN_REMAINDER_DEG
    angle = -np.radians(convention.rotation_deg) * is_rotated
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(scale * rotation @ columns.T)


def _corrected_times(times: "pd.Index[float]", faults: Faults) -> "pd.Index[float]":
    """Return timestamps without delay and clock drift."""
    middle = float(times.to_numpy().mean())
    corrected = middle + (times.to_numpy() - middle) / (1.0 + faults.clock_drift) - faults.late_s
    return pd.Index(corrected, name="time_s")
