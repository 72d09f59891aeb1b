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
# Minimum length (m) of a jump of the estimate relative to the reference, and minimum ratio of the
# jump to the median difference of the step lengths
MIN_JUMP_M, MIN_JUMP_RATIO = 0.5, 20.0
# Maximum distance (m) from the first position, or from 0, after a restart of the map
MAX_RESTART_DISTANCE_M = 0.5
# Maximum number of jumps whose times are stated
MAX_STATED_JUMPS = 5
# Minimum constant rotation (rad) between orientations of different body axes
MIN_BODY_ROTATION_RAD = np.radians(30.0)
# Maximum RMS deviation (rad) from the constant rotation between body axes
MAX_BODY_DEVIATION_RAD = np.radians(5.0)
# Number of alternating estimates of alignment and lever arm
LEVER_ARM_ITERATIONS = 5


def drop_constant_orientation(trajectory: Trajectory) -> tuple[Trajectory, tuple[str, ...]]:
    """Remove the orientation of a trajectory that moves without rotating; return also a note."""
    rotation, extent_m = trajectory.rotation, np.ptp(trajectory.position_m, axis=0).max()
    if rotation is None or len(trajectory) < MIN_CONSTANT_POSES or extent_m < MIN_CONSTANT_MOTION_M:
        return trajectory, ()
    if (rotation[0].inv() * rotation).magnitude().max() > MAX_CONSTANT_ROTATION_RAD:
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
        is_at_same_time = (reference.time_s >= start_s + time_offset_s) & (
            reference.time_s <= end_s + time_offset_s
        )
        if not is_at_same_time.any():
            continue
        motion_m = float(np.linalg.norm(np.ptp(reference.position_m[is_at_same_time], axis=0)))
        if motion_m > MIN_FROZEN_MOTION_M:
            is_frozen[start + 1 : end] = True
            warnings.append(
                f"The position of {estimate.name} does not change from "
                f"{start_s - estimate.time_s[0]:.1f} s to {end_s - estimate.time_s[0]:.1f} s after "
                f"its start ({(end - start) / len(estimate):.0%} of the estimate), while the "
                f"reference moves {motion_m:.1f} m. These poses are not scored."
            )
    return is_frozen, tuple(warnings)


def find_jumps(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Return a warning if matched poses of the estimate jump and those of the reference do not."""
    step_lengths_m = [
        np.linalg.norm(np.diff(trajectory.position_m, axis=0), axis=1)
        for trajectory in (estimate, reference)
    ]
    differences_m = np.abs(step_lengths_m[0] - step_lengths_m[1])
    if not len(differences_m):
        return ()
    is_jump = (differences_m > max(MIN_JUMP_M, MIN_JUMP_RATIO * np.median(differences_m))) & (
        step_lengths_m[0] > step_lengths_m[1]
    )
    rows = np.flatnonzero(is_jump)
    if not len(rows):
        return ()
    times_s = estimate.time_s[rows + 1] - estimate.time_s[0]
    times_text = ", ".join(f"{time_s:.1f}" for time_s in times_s[:MAX_STATED_JUMPS])
    starts_m = estimate.position_m[0], np.zeros(3)
    distances_m = [
        np.linalg.norm(estimate.position_m[rows + 1] - start_m, axis=1) for start_m in starts_m
    ]
    cause = "a lost track or a relocalisation"
    if np.min(distances_m) < MAX_RESTART_DISTANCE_M:
        cause = "a restart of the map, because it returns to its origin"
    return (
        f"{estimate.name} jumps by up to {differences_m[rows].max():.1f} m, {times_text} s after "
        f"its start: probably {cause}. ATE and RPE contain the jumps. One alignment does not fit "
        "both parts: evaluate the poses before and after a jump as separate files.",
    )


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
