"""Detection of constant orientations, frozen poses and other body axes before the evaluation."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from px4fuse.core.arrays import BoolArray
from px4fuse.trajectory.model import Trajectory

# Maximum rotation (rad) in a constant orientation, from rounded digits in a file
MAX_CONSTANT_ROTATION_RAD = 1e-6
# Minimum number of poses, and minimum motion (m), for a constant orientation
MIN_CONSTANT_POSES, MIN_CONSTANT_MOTION_M = 10, 1.0
# Minimum duration (s) of a frozen pose, and minimum motion (m) of the reference during a frozen
# pose
MIN_FROZEN_S, MIN_FROZEN_MOTION_M = 2.0, 0.5
# Minimum constant rotation (rad) between orientations of different body axes
MIN_BODY_ROTATION_RAD = np.radians(30.0)
# Maximum RMS deviation (rad) from the constant rotation between body axes
MAX_BODY_DEVIATION_RAD = np.radians(5.0)
# Number of alternating estimates of alignment and lever arm
LEVER_ARM_ITERATIONS = 5


def drop_constant_orientation(trajectory: Trajectory) -> tuple[Trajectory, tuple[str, ...]]:
    """Remove the orientation of a trajectory that moves without rotating; return also a note."""
    rotation, extent_m = trajectory.rotation, np.ptp(trajectory.position_m, axis=0).max()
    if (
        rotation is None
        or len(trajectory) < MIN_CONSTANT_POSES
        or extent_m < MIN_CONSTANT_MOTION_M
        or (rotation[0].inv() * rotation).magnitude().max() > MAX_CONSTANT_ROTATION_RAD
    ):
        return trajectory, ()
    return replace(trajectory, rotation=None), (
        f"{trajectory.name} has no orientation (constant quaternion). Rotations are not scored.",
    )


def find_frozen_poses(
    estimate: Trajectory, reference: Trajectory, time_offset_s: float
) -> tuple[BoolArray, tuple[str, ...]]:
    """Return a mask of positions that repeat while the reference moves, and warnings."""
    is_frozen, warnings = np.zeros(len(estimate), bool), []
    is_new = np.r_[True, np.any(np.diff(estimate.position_m, axis=0) != 0.0, axis=1)]
    for start, end in pairwise([*np.flatnonzero(is_new).tolist(), len(estimate)]):
        start_s, end_s = estimate.time_s[[start, end - 1]].tolist()
        if end_s - start_s < MIN_FROZEN_S:
            continue
        motion = reference.between(start_s + time_offset_s, end_s + time_offset_s).position_m
        if (
            len(motion)
            and (motion_m := np.linalg.norm(np.ptp(motion, axis=0))) > MIN_FROZEN_MOTION_M
        ):
            is_frozen[start + 1 : end] = True
            warnings.append(
                f"The position of {estimate.name} does not change from "
                f"{start_s - estimate.time_s[0]:.1f} s to {end_s - estimate.time_s[0]:.1f} s after "
                f"its start ({(end - start) / len(estimate):.0%} of the estimate), while the "
                f"reference moves {motion_m:.1f} m. These poses are not scored."
            )
    return is_frozen, tuple(warnings)


def has_other_body_axes(aligned_estimate: Trajectory, reference: Trajectory) -> bool:
    """Return True if the orientations are of different body axes, such as those of a camera."""
    if aligned_estimate.rotation is None or reference.rotation is None:
        return False
    difference = aligned_estimate.rotation.inv() * reference.rotation
    mean_difference = difference.mean()
    deviation_rad = (mean_difference.inv() * difference).magnitude()
    return bool(
        mean_difference.magnitude() > MIN_BODY_ROTATION_RAD
        and np.sqrt(np.mean(deviation_rad**2)) < MAX_BODY_DEVIATION_RAD
    )
