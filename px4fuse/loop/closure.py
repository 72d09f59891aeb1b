"""Correction of a path by its loop closure error, and choice of key frames."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, IntArray, cumulative_sums
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.model import (
    NED_COMPONENTS_BY_FRAME,
    Frame,
    Trajectory,
    compute_extent_m,
)

DOWN_DIRECTION = np.array([0.0, 0.0, 1.0])
# Conversion of each frame to z down: axis directions, new frame, note to the user
_Z_DOWN_CONVERSIONS: dict[Frame, tuple[str, Frame, str]] = {
    "ENU": ("enu", "NED", "the axes were converted from east, north, up to north, east, down"),
    "camera": (
        "edn",
        "FRD",
        "the axes were converted from right, down, forward (camera) to forward, right, down",
    ),
    "unknown": ("nwu", "FRD", "the coordinate frame is unknown, so z is assumed to be up"),
}
# Default key frame spacing as fraction of the extent of the path
KEY_FRAME_SPACING_TO_EXTENT_RATIO = 0.02
MIN_KEY_FRAME_SPACING_M = 0.02
MAX_KEY_FRAME_SPACING_M = 0.5


def to_z_down(trajectory: Trajectory) -> Trajectory:
    """Convert a trajectory to a frame with z down (NED or FRD)."""
    if trajectory.frame not in _Z_DOWN_CONVERSIONS:
        return trajectory
    axes, z_down_frame, note = _Z_DOWN_CONVERSIONS[trajectory.frame]
    # _rotate does not convert variances: only trajectories of flight logs have variances, and their
    # z is already down
    rotated = _rotate(trajectory, _matrix_to_ned(axes), z_down_frame)
    return replace(rotated, notes=(*trajectory.notes, note))


def from_z_down(trajectory: Trajectory, frame: Frame) -> Trajectory:
    """Convert a trajectory with z down back to its original frame."""
    if frame not in _Z_DOWN_CONVERSIONS or trajectory.frame in _Z_DOWN_CONVERSIONS:
        return trajectory
    return _rotate(trajectory, _matrix_to_ned(_Z_DOWN_CONVERSIONS[frame][0]).T, frame)


def _matrix_to_ned(axes: str) -> Array:
    axis_order, axis_signs = NED_COMPONENTS_BY_FRAME[axes]
    return np.asarray(np.diag(axis_signs) @ np.eye(3)[axis_order])


def _rotate(trajectory: Trajectory, matrix: Array, frame: Frame) -> Trajectory:
    """Rotate a trajectory to another frame, and convert between camera axes and body axes."""
    frame_rotation = Rotation.from_matrix(matrix)
    rotated = replace(
        trajectory.replace_positions(trajectory.position_m @ matrix.T, frame_rotation), frame=frame
    )
    if rotated.rotation is None or "camera" not in (trajectory.frame, frame):
        return rotated
    return replace(rotated, rotation=rotated.rotation * frame_rotation.inv())


def compute_default_key_frame_spacing_m(position_m: Array) -> float:
    """Return the default spacing (m) of the key frames along a path, from its extent."""
    spacing_m = KEY_FRAME_SPACING_TO_EXTENT_RATIO * compute_extent_m(position_m)
    return float(np.clip(spacing_m, MIN_KEY_FRAME_SPACING_M, MAX_KEY_FRAME_SPACING_M))


def choose_key_frames(position_m: Array, spacing_m: float) -> IntArray:
    """Choose key frames: poses at distances of at least ``spacing_m``, and both ends of the path.

    Without key frames, position noise makes the path length too large.
    """
    key_frame_indices = [0]
    last_key_frame_position_m = position_m[0]
    for pose_index, position in enumerate(position_m[1:-1], start=1):
        displacement_m = position - last_key_frame_position_m
        if displacement_m @ displacement_m >= spacing_m * spacing_m:
            key_frame_indices.append(pose_index)
            last_key_frame_position_m = position
    if (
        len(key_frame_indices) > 1
        and np.linalg.norm(position_m[-1] - last_key_frame_position_m) < spacing_m / 2.0
    ):
        # The distance between two close key frames is mostly noise
        key_frame_indices.pop()
    return np.array([*key_frame_indices, len(position_m) - 1])


def distribute_by_distance(
    position_m: Array, closure_error_vector_m: Array, cumulative_distance_m: Array
) -> Array:
    """Correct positions by a part of the loop closure error, in proportion to path length.

    Source: compass rule of surveying (Bowditch 1808; UAT 366 module 2, Example 2).

    Parameters
    ----------
    position_m : ndarray, shape (n, 3)
    closure_error_vector_m : ndarray, shape (3,)
        Final position minus true final position.
    cumulative_distance_m : ndarray, shape (n,)
        Path length from the start to each position.
    """
    distance_fraction = cumulative_distance_m / cumulative_distance_m[-1]
    return np.asarray(position_m - distance_fraction[:, None] * closure_error_vector_m)


def compute_heading_change_rad(rotation: Rotation) -> float:
    """Return the rotation angle (rad) about z, clockwise from above in a frame with z down.

    It is the twist of the swing-twist decomposition.
    """
    _, _, z, w = rotation.as_quat()
    return float(lie.wrap(2.0 * np.arctan2(z, w)))


def remove_closure_error_by_distance(
    trajectory: Trajectory,
    cumulative_distance_m: Array,
    closure_error_vector_m: Array,
    heading_closure_error_rad: float,
) -> Trajectory:
    """Distribute the closure errors of position and heading in proportion to path length.

    The errors are final values minus true final values.
    """
    position_m = trajectory.position_m
    distance_fraction = cumulative_distance_m / cumulative_distance_m[-1]

    def rotate_heading(fraction: Array) -> Rotation:
        rotation_rad = np.outer(-fraction * heading_closure_error_rad, DOWN_DIRECTION)
        return Rotation.from_rotvec(rotation_rad)

    rotation_at_step_middle = rotate_heading((distance_fraction[1:] + distance_fraction[:-1]) / 2.0)
    rotated_position_m = position_m[0] + cumulative_sums(
        rotation_at_step_middle.apply(np.diff(position_m, axis=0))
    )
    remaining_error_m = rotated_position_m[-1] - (position_m[-1] - closure_error_vector_m)
    return trajectory.replace_positions(
        distribute_by_distance(rotated_position_m, remaining_error_m, cumulative_distance_m),
        rotate_heading(distance_fraction),
    )
