"""Loop closure by hand: path length, misclosure, and its distribution by distance.

Positions have z down here (NED, or forward-right-down at the start); see :func:`to_z_down`.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, IntArray
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.model import Frame, Trajectory, cumulative_distance

DOWN = np.array([0.0, 0.0, 1.0])
# Which of x, y, z of a frame is forward or north, right or east, and down, and with which sign
_TO_Z_DOWN: dict[Frame, tuple[list[int], list[float], Frame, str]] = {
    "ENU": ([1, 0, 2], [1.0, 1.0, -1.0], "NED", "east, north, up turned into north, east, down"),
    "camera": (
        [2, 0, 1],
        [1.0, 1.0, 1.0],
        "FRD",
        "the camera's right, down, forward turned into forward, right, down",
    ),
    "unknown": (
        [0, 1, 2],
        [1.0, -1.0, -1.0],
        "FRD",
        "the frame is not stated: z is taken to be up",
    ),
}
# Key frames are this share of the extent apart, between these bounds: the path of a hand-held
# camera over a desk and of a flight through a hall both bend on the scale of their own size
SPACING_SHARE = 0.02
MIN_SPACING_M, MAX_SPACING_M = 0.02, 0.5


def to_z_down(trajectory: Trajectory) -> Trajectory:
    """The same trajectory in a frame with z down.

    A camera's orientation becomes that of a vehicle whose nose is where the camera looks.
    """
    if trajectory.frame not in _TO_Z_DOWN:
        return trajectory
    order, sign, frame, note = _TO_Z_DOWN[trajectory.frame]
    variance = trajectory.position_variance_m2
    return replace(
        _rotate(trajectory, np.diag(sign) @ np.eye(3)[order], frame),
        position_variance_m2=None if variance is None else variance[:, order],
        rotation_variance_rad2=trajectory.rotation_variance_rad2,
        notes=(*trajectory.notes, note),
    )


def from_z_down(trajectory: Trajectory, frame: Frame) -> Trajectory:
    """What :func:`to_z_down` made of a trajectory in ``frame``, turned back into that frame."""
    if frame not in _TO_Z_DOWN or trajectory.frame in _TO_Z_DOWN:
        return trajectory
    order, sign, _, _ = _TO_Z_DOWN[frame]
    return _rotate(trajectory, (np.diag(sign) @ np.eye(3)[order]).T, frame)


def _rotate(trajectory: Trajectory, matrix: Array, frame: Frame) -> Trajectory:
    """The same poses in another frame; a camera's axes turn with its world."""
    turn = Rotation.from_matrix(matrix)
    rotated = replace(trajectory.moved(trajectory.position_m @ matrix.T, turn), frame=frame)
    if rotated.rotation is None or "camera" not in (trajectory.frame, frame):
        return rotated
    return replace(rotated, rotation=rotated.rotation * turn.inv())


def key_frame_spacing_m(position_m: Array) -> float:
    """Distance between key frames that suits a path, shape (n, d), in m."""
    extent = float(np.linalg.norm(np.ptp(position_m, axis=0)))
    return float(np.clip(SPACING_SHARE * extent, MIN_SPACING_M, MAX_SPACING_M))


def key_frames(position_m: Array, spacing_m: float) -> IntArray:
    """Indices of poses that are at least ``spacing_m`` from the one before, both ends included.

    Length along every sample of a noisy track is too long: each step of 30 Hz adds the noise of
    two positions. Steps that are long against the noise do not.
    """
    frame_indices = [0]
    last = position_m[0]
    for index, position in enumerate(position_m[1:-1], start=1):
        step = position - last
        if step @ step >= spacing_m * spacing_m:
            frame_indices.append(index)
            last = position
    if len(frame_indices) > 1 and np.linalg.norm(position_m[-1] - last) < spacing_m / 2.0:
        frame_indices.pop()  # so that the last step is not one of noise alone
    return np.array([*frame_indices, len(position_m) - 1])


def distribute_by_distance(
    position_m: Array, misclosure_m: Array, cumulative_m: Array | None = None
) -> Array:
    """Correct a path in proportion to cumulative distance: the surveyors' compass rule.

    p_k' = p_k - (s_k / s_n) · e

    It is what a pose graph gives when the variance of a step's translation is proportional to its
    length and orientation is perfect.

    Parameters
    ----------
    position_m : ndarray, shape (n, d)
    misclosure_m : ndarray, shape (d,)
        e, where the path ends minus where it should end.
    cumulative_m : ndarray, shape (n,), optional
        s, by default of the positions themselves.

    Returns
    -------
    ndarray, shape (n, d)

    Notes
    -----
    Bowditch (1808); UAT 366 module 2, Example 2.
    """
    cumulative = cumulative_distance(position_m) if cumulative_m is None else cumulative_m
    share = cumulative / cumulative[-1]
    return np.asarray(position_m - share[:, np.newaxis] * misclosure_m)


def heading_change_rad(rotation: Rotation) -> float:
    """Turn about the vertical that is part of a rotation within a frame with z down.

    The twist of the swing-twist decomposition about z; positive is clockwise seen from above.
    """
    _, _, z, w = rotation.as_quat()
    return float(lie.wrap(2.0 * np.arctan2(z, w)))


def correct_by_distance(
    trajectory: Trajectory, cumulative_m: Array, misclosure_m: Array, misclosure_heading_rad: float
) -> Trajectory:
    """Distribute a misclosure of position and heading by distance.

    Orientations are turned back by the share of the heading misclosure that their distance gives
    (slerp about the vertical), the steps between poses are turned with them, and what is left of
    the misclosure of position is distributed by the compass rule. Without turning the steps the
    shape would shear.

    Parameters
    ----------
    trajectory : Trajectory
        In a frame with z down.
    cumulative_m : ndarray, shape (n,)
        Distance along the path at each pose.
    misclosure_m : ndarray, shape (3,)
        Where the path ends minus where it should end.
    misclosure_heading_rad : float
        Heading at the end minus what it should be; 0 where that is not known.
    """
    position = trajectory.position_m
    share = cumulative_m / cumulative_m[-1]
    turn = Rotation.from_rotvec(np.outer(-share * misclosure_heading_rad, DOWN))
    middle_share = (share[1:] + share[:-1]) / 2.0
    middle_rotation = Rotation.from_rotvec(np.outer(-middle_share * misclosure_heading_rad, DOWN))
    steps = middle_rotation.apply(np.diff(position, axis=0))
    rotated_position = position[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    remaining_m = rotated_position[-1] - (position[-1] - misclosure_m)
    return trajectory.moved(
        distribute_by_distance(rotated_position, remaining_m, cumulative_m), turn
    )
