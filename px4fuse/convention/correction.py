"""Deviations of a source from PX4's convention (axes, unit, clock), and their correction."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.core.arrays import Array
from px4fuse.flight.model import (
    Columns,
    Flight,
    PositionTrack,
    infer_position_kind,
    time_index,
)
from px4fuse.trajectory.rotation import build_matrix, heading

from .axes import CLOCKWISE_DIRECTIONS, METRES_PER_UNIT, correct_clock_drift
from .check import is_source_fused
from .model import Convention
from .motion import integrate_inertial_data, replace_heading
from .orientation import convert_to_attitude
from .texts import FRAME_AXES, OPPOSITE_DIRECTION, format_axes

# Minimum rotation (°) of the positions about the vertical that is corrected in addition to wrong
# axes
MIN_RESIDUAL_ROTATION_DEG = 8.0
# Minimum rotation (°) of the positions about the vertical that is corrected if the horizontal axes
# have no other fault
MIN_FRAME_ROTATION_DEG = 15.0
# Minimum delay (s) of the position timestamps that is corrected together with axes and unit of the
# positions
MIN_DELAY_TO_CORRECT_S = 0.5
# Minimum reported heading error (°) of the source's orientation, from a comparison of its positions
# with the motion from IMU and orientation
MIN_HEADING_ERROR_DEG = 10.0
# Fault of the orientation: copy of EKF2's attitude, quaternion order, frames, or heading
OrientationFault = Literal["", "copied", "order", "frames", "heading"]


@dataclass(frozen=True)
class ConventionFaults:
    """Deviations of a position source from PX4's convention: NED, metres, boot clock.

    Attributes
    ----------
    has_wrong_axes : bool
        True if the axes are not NED, even after a rotation about the vertical.
    rotation_deg : float
        Clockwise rotation of the positions from NED, ENU or NWU.
    late_s : float
        Delay of the timestamps.
    clock_drift : float
        Rate of the source's clock minus 1.
    affects_ekf2 : bool
        True if EKF2 fused the source, so that EKF2's attitude is wrong.
    is_north_unknown : bool
        True if the log contains no heading that is independent of the source.
    is_ambiguous : bool
        True if several axes and units fit, but not NED in metres.
    """

    has_wrong_axes: bool = False
    rotation_deg: float = 0.0
    has_wrong_unit: bool = False
    late_s: float = 0.0
    clock_drift: float = 0.0
    orientation: OrientationFault = ""
    affects_ekf2: bool = False
    is_north_unknown: bool = False
    is_ambiguous: bool = False

    @property
    def has_axes_to_correct(self) -> bool:
        """True if the positions must be rotated or mirrored to NED."""
        return self.has_wrong_axes or self.rotation_deg != 0.0

    @property
    def has_position_fault(self) -> bool:
        """True if axes, rotation, unit or timestamps of the positions are wrong."""
        return bool(
            self.has_axes_to_correct or self.has_wrong_unit or self.late_s or self.clock_drift
        )

    def __bool__(self) -> bool:
        return self != ConventionFaults()


def find_convention_faults(
    convention: Convention | None, flight: Flight, frame: str
) -> ConventionFaults:
    """Return the deviations of a source from PX4's convention; ``frame`` is the logged frame."""
    if convention is None:
        return ConventionFaults()
    orientation_fault = _find_orientation_fault(convention)
    if convention.verdict == "ambiguous":
        # NED in metres, with any rotation and delay
        is_ned_likely = any(
            convention_text.startswith(format_axes(FRAME_AXES["NED"], "m"))
            for convention_text in (
                format_axes(convention.axes, convention.unit),
                *convention.alternatives,
            )
        )
        return ConventionFaults(orientation=orientation_fault, is_ambiguous=not is_ned_likely)
    if convention.verdict != "determined":
        return ConventionFaults(orientation=orientation_fault)
    is_fused = is_source_fused(flight)
    has_wrong_axes, rotation_deg = _find_axis_fault_and_rotation(convention)
    # In the following cases, a rotation of the positions is not reported as their fault:
    # - The orientation sent by the source has a wrong heading. The orientation is then the fault
    has_wrong_heading = orientation_fault in ("order", "heading")
    # - EKF2 fused the yaw of the source, so EKF2's heading is not an independent reference
    uses_gyro_heading = convention.heading_from == "gyroscopes"
    is_heading_from_source = (
        is_fused
        and uses_gyro_heading
        and convention.orientation is not None
        and orientation_fault != "copied"
    )
    # Third case: EKF2 did not fuse the source, and the heading is from the gyroscopes. This heading
    # drifts, so it reveals only wrong axes (multiples of 90°), but no smaller rotation
    has_no_heading_reference = uses_gyro_heading and not is_fused and not has_wrong_axes
    # - The frame of the positions is FRD, which has no fixed rotation from north
    if has_wrong_heading or is_heading_from_source or has_no_heading_reference or frame == "FRD":
        rotation_deg = 0.0
    faults = ConventionFaults(
        has_wrong_axes=has_wrong_axes,
        rotation_deg=rotation_deg,
        has_wrong_unit=convention.unit != "m",
        late_s=convention.late_s if abs(convention.late_s) >= MIN_DELAY_TO_CORRECT_S else 0.0,
        clock_drift=convention.clock_drift,
        orientation=orientation_fault,
        is_north_unknown=has_wrong_axes and is_heading_from_source,
    )
    return replace(
        faults, affects_ekf2=is_fused and (faults.has_position_fault or has_wrong_heading)
    )


def _find_axis_fault_and_rotation(convention: Convention) -> tuple[bool, float]:
    """Return True if the axes are not NED, and the clockwise rotation (°) of the positions.

    The axes are wrong if no rotation about the vertical makes them NED. The rotation is the one
    that remains after a conversion of wrong axes to NED; it is 0 if it is small.
    """
    # If a rotation about the vertical cannot make the axes NED, report the nearest frame with axes
    # along north, east, south or west as the fault. Only a small rotation remains
    rotation_deg, is_z_up = convention.rotation_deg, convention.z == "up"
    is_enu_or_nwu = convention.axes in (FRAME_AXES["ENU"], FRAME_AXES["NWU"])
    if convention.is_mirrored or is_enu_or_nwu or convention.z not in ("up", "down"):
        return True, rotation_deg if abs(rotation_deg) > MIN_RESIDUAL_ROTATION_DEG else 0.0
    # Otherwise, the frame is NED (x north), or ENU (z up, x east), rotated by any angle
    total_rotation_deg = _compute_angle_from_x_to_north_deg(convention) + 90.0 * is_z_up
    total_rotation_deg = math.remainder(total_rotation_deg, 360.0)
    return is_z_up, total_rotation_deg if abs(total_rotation_deg) > MIN_FRAME_ROTATION_DEG else 0.0


def _compute_angle_from_x_to_north_deg(convention: Convention) -> float:
    """Return the clockwise angle (°) from the x axis of the positions to north."""
    return convention.rotation_deg - 90.0 * CLOCKWISE_DIRECTIONS.index(convention.x)


def _find_orientation_fault(convention: Convention) -> OrientationFault:
    """Return the fault of the orientation that the source sends; "" if it is correct or unknown."""
    orientation = convention.orientation
    if orientation is None or orientation.verdict not in ("determined", "copied"):
        return ""
    if orientation.verdict == "copied":
        return "copied"
    if orientation.order != "w x y z":
        return "order"
    # Frames with z up are consistent with positions with z up, so they are a fault only if the z
    # axis of the positions is known to be down. All other frames are always a fault
    is_z_known_to_be_down = convention.verdict == "determined" and convention.z == "down"
    has_z_up_frames = orientation.frames in ("FLU to ENU", "FLU to NWU")
    if orientation.frames != "FRD to NED" and (is_z_known_to_be_down or not has_z_up_frames):
        return "frames"
    return "heading" if abs(orientation.heading_error_deg or 0.0) > MIN_HEADING_ERROR_DEG else ""


def convert_to_px4_convention(
    flight: Flight, track: PositionTrack, convention: Convention, faults: ConventionFaults
) -> tuple[Flight, PositionTrack]:
    """Convert a position source to PX4's axes (NED), unit (m) and boot clock.

    If EKF2 fused the positions in the wrong convention, EKF2's attitude is also wrong. It is then
    replaced by the attitude from the gyroscopes.
    """
    samples, orientation, origin = track.samples, track.orientation, track.origin
    matrix_to_ned = _make_matrix_to_ned_metres(convention, faults)
    position_m = _multiply_known_values(samples[Columns.POSITION].to_numpy(), matrix_to_ned)
    variance_m2 = _multiply_known_values(
        samples[Columns.POSITION_VARIANCE].to_numpy(), matrix_to_ned**2
    )
    samples = pd.DataFrame(
        np.hstack([position_m, variance_m2]),
        _correct_times(samples.index, faults),
        Columns.POSITION + Columns.POSITION_VARIANCE,
    )
    # The kind "vio" was inferred because the source sends an orientation. A copy of EKF2's attitude
    # is not a measurement, so infer the kind from the positions
    if faults.orientation == "copied" and origin.kind == "vio":
        origin = structs.replace(origin, kind=infer_position_kind(samples))
    if faults.orientation in ("copied", "heading"):
        orientation = None  # not a measurement, or with a wrong heading
    elif orientation is not None and convention.orientation is not None:
        quaternion = orientation[Columns.QUATERNION].to_numpy()
        orientation = orientation.set_axis(_correct_times(orientation.index, faults))
        orientation[Columns.QUATERNION] = convert_to_attitude(quaternion, convention.orientation)
    track = replace(track, samples=samples, orientation=orientation, origin=origin)
    return _replace_attitude(flight, convention, faults), track


def _replace_attitude(flight: Flight, convention: Convention, faults: ConventionFaults) -> Flight:
    """Replace EKF2's attitude by that from the gyroscopes, if EKF2 fused wrong positions.

    The heading of the new attitude refers to the frame of the positions: north if axes or rotation
    of the positions were corrected, else their x axis.
    """
    inertial_data = integrate_inertial_data(flight) if faults.affects_ekf2 else None
    if inertial_data is None:
        return flight
    attitude = inertial_data.compute_attitudes()[convention.heading_from]
    if not faults.has_axes_to_correct:
        heading_change_rad = np.radians(_compute_angle_from_x_to_north_deg(convention))
        attitude = replace_heading(attitude, heading(attitude) + heading_change_rad)
    attitude_table = pd.DataFrame(attitude, time_index(inertial_data.time_s), Columns.QUATERNION)
    return replace(flight, attitude=attitude_table)


def _make_matrix_to_ned_metres(convention: Convention, faults: ConventionFaults) -> Array:
    """Return the 3×3 matrix that converts positions of the source to NED and metres."""
    metres_per_unit = METRES_PER_UNIT[convention.unit]
    if not faults.has_axes_to_correct:
        return metres_per_unit * np.eye(3)
    # Row: north, east or down. Column: 1 if this axis of the source has that direction, -1 if it
    # has the opposite direction
    signed_permutation_matrix = [
        [(axis == name) - (OPPOSITE_DIRECTION[axis] == name) for axis in convention.axes]
        for name in FRAME_AXES["NED"]
    ]
    # The positions are rotated clockwise, so they are rotated back counterclockwise (negative)
    is_rotated = abs(convention.rotation_deg) > MIN_RESIDUAL_ROTATION_DEG
    rotation_rad = -np.radians(convention.rotation_deg) * is_rotated
    cosine, sine = np.cos(rotation_rad), np.sin(rotation_rad)
    rotation = build_matrix((cosine, -sine, 0.0), (sine, cosine, 0.0), (0.0, 0.0, 1.0))
    return np.asarray(metres_per_unit * rotation @ np.array(signed_permutation_matrix))


def _multiply_known_values(values: Array, matrix: Array) -> Array:
    """Multiply each row by a matrix. NaN values with the matrix coefficient 0 are ignored."""
    is_unknown = np.isnan(values).astype(float) @ (matrix != 0.0).T > 0.0
    return np.where(is_unknown, np.nan, np.nan_to_num(values) @ matrix.T)


def _correct_times(times: "pd.Index[float]", faults: ConventionFaults) -> "pd.Index[float]":
    return time_index(correct_clock_drift(times.to_numpy(), faults.clock_drift) - faults.late_s)
