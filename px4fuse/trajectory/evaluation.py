"""Evaluation of a trajectory against a reference: ATE and RPE with 95 % intervals.

The absolute trajectory error (ATE) is the position error after alignment. The relative pose error
(RPE) is the error of the motion over a fixed distance or time (Sturm 2012).
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.record import NOT_IN_JSON, NotInJson, OrUnavailable, Record
from px4fuse.core.text import capitalise_first_letter, format_metres
from px4fuse.errors import TrajectoryError
from px4fuse.flight.model import Unavailable

from .alignment import (
    AlignmentKind,
    Transform,
    compute_rms_length_m,
    fit_alignment,
    umeyama,
)
from .association import Association, AssociationMethod, associate
from .model import Trajectory, compute_extent_m, cumulative_distance
from .scores import (
    RelativePoseError,
    RmseInterval,
    RpePairDistance,
    Statistics,
    choose_default_deltas,
    compute_relative_pose_error,
    compute_rotation_statistics,
    compute_statistics,
    estimate_rmse_interval,
    get_rotations,
)
from .time_offset import TimeOffset, compute_clock_offset_s, estimate_time_offset

# Maximum rotation (rad) of a constant orientation, above 0 because files contain rounded numbers
MAX_ROTATION_OF_CONSTANT_ORIENTATION_RAD = 1e-6
# Minimum number of poses and minimum extent (m) for the search for a constant orientation
MIN_POSE_COUNT_TO_TEST_CONSTANT_ORIENTATION, MIN_EXTENT_TO_TEST_CONSTANT_ORIENTATION_M = 10, 1.0
# Frozen positions of the estimate: minimum duration (s) of a repeated position, and minimum motion
# (m) of the reference meanwhile
MIN_FREEZE_DURATION_S, MIN_REFERENCE_MOTION_DURING_FREEZE_M = 2.0, 0.5
# Jumps of the estimate: a step is the distance between successive poses. Minimum difference (m)
# between the steps of estimate and reference, and its minimum ratio to the median difference
MIN_JUMP_M, MIN_JUMP_TO_MEDIAN_STEP_ERROR_RATIO = 0.5, 20.0
MAX_STATED_JUMPS = 5
# Minimum constant rotation (rad) between the orientations of two trajectories, if their body axes
# differ
MIN_ROTATION_BETWEEN_BODY_AXES_RAD = np.radians(30.0)
# Maximum variation (rad, RMS) of a rotation that counts as constant
MAX_DEVIATION_FROM_MEAN_ROTATION_RAD = np.radians(5.0)
# Number of alternating estimates of alignment and lever arm
LEVER_ARM_ITERATIONS = 5


def drop_constant_orientation(trajectory: Trajectory) -> tuple[Trajectory, tuple[str, ...]]:
    """Remove a constant orientation, which was not measured, and return a note."""
    rotation, extent_m = trajectory.rotation, np.ptp(trajectory.position_m, axis=0).max()
    if (
        rotation is None
        or len(trajectory) < MIN_POSE_COUNT_TO_TEST_CONSTANT_ORIENTATION
        or extent_m < MIN_EXTENT_TO_TEST_CONSTANT_ORIENTATION_M
        or (rotation[0].inv() * rotation).magnitude().max()
        > MAX_ROTATION_OF_CONSTANT_ORIENTATION_RAD
    ):
        return trajectory, ()
    return replace(trajectory, rotation=None), (
        f"The quaternion of {trajectory.name} is constant, so rotation errors are not computed.",
    )


def find_frozen_poses(
    estimate: Trajectory, reference: Trajectory, time_offset_s: float
) -> tuple[BoolArray, list[str]]:
    """Return a mask of repeated positions while the reference moves, and warnings."""
    is_frozen = np.zeros(len(estimate), bool)
    warnings = []
    is_new_position = np.append(True, np.diff(estimate.position_m, axis=0).any(axis=1))
    new_position_indices = np.append(np.flatnonzero(is_new_position), len(estimate)).tolist()
    for start_index, end_index in pairwise(new_position_indices):
        start_s, end_s = estimate.time_s[[start_index, end_index - 1]].tolist()
        if end_s - start_s < MIN_FREEZE_DURATION_S:
            continue
        motion_m = compute_extent_m(
            reference.cut_to_span(start_s + time_offset_s, end_s + time_offset_s).position_m
        )
        if motion_m > MIN_REFERENCE_MOTION_DURING_FREEZE_M:
            is_frozen[start_index + 1 : end_index] = True
            warnings.append(
                f"The position of {estimate.name} does not change from "
                f"{start_s - estimate.time_s[0]:.1f} s to {end_s - estimate.time_s[0]:.1f} s after "
                f"its start, while the reference moves {motion_m:.1f} m. ATE and RPE exclude these "
                f"poses ({(end_index - start_index) / len(estimate):.0%} of the estimate)."
            )
    return is_frozen, warnings


def find_jump_warnings(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Return a warning if the estimate jumps and the reference does not."""
    steps_of_estimate_m, steps_of_reference_m = (
        np.linalg.norm(np.diff(trajectory.position_m, axis=0), axis=1)
        for trajectory in (estimate, reference)
    )
    step_differences_m = steps_of_estimate_m - steps_of_reference_m
    median_difference_m = np.median(np.abs(step_differences_m))
    min_jump_m = max(MIN_JUMP_M, MIN_JUMP_TO_MEDIAN_STEP_ERROR_RATIO * median_difference_m)
    jump_indices = np.flatnonzero(step_differences_m > min_jump_m)
    if not len(jump_indices):
        return ()
    times_s = estimate.time_s[jump_indices + 1] - estimate.time_s[0]
    times_text = ", ".join(f"{time_s:.1f}" for time_s in times_s[:MAX_STATED_JUMPS])
    return (
        f"{estimate.name} jumps by up to {step_differences_m[jump_indices].max():.1f} m, "
        f"{times_text} s after its start. The SLAM system probably lost track, relocalised or "
        "restarted its map. ATE and RPE contain the jumps. Evaluate the poses before and after a "
        "jump as separate files: one alignment does not fit both.",
    )


def has_other_body_axes(aligned_estimate: Trajectory, reference: Trajectory) -> bool:
    """Return True if a constant rotation separates the body axes of both trajectories."""
    if aligned_estimate.rotation is None or reference.rotation is None:
        return False
    rotation_difference = aligned_estimate.rotation.inv() * reference.rotation
    mean_rotation = rotation_difference.mean()
    deviation_rad = (mean_rotation.inv() * rotation_difference).magnitude()
    return bool(
        mean_rotation.magnitude() > MIN_ROTATION_BETWEEN_BODY_AXES_RAD
        and np.sqrt(np.mean(deviation_rad**2)) < MAX_DEVIATION_FROM_MEAN_ROTATION_RAD
    )


# Maximum deviation of the estimated scale factor from 1 without a warning
MAX_SCALE_ERROR = 0.1
# Minimum fraction of poses or time that is evaluated, without a warning
MIN_EVALUATED_TRAJECTORY_FRACTION = 0.5
# Minimum time offset (s) for a warning, because estimators can have smaller delays
MIN_REPORTED_TIME_OFFSET_S = 0.1
# A frame is mirrored if reversing one axis reduces the ATE to this fraction or less
MAX_MIRRORED_ATE_RATIO = 0.3
# The test for a mirrored frame needs at least this ratio of ATE to extent of the reference
MIN_ATE_TO_EXTENT_RATIO_FOR_MIRROR_TEST = 0.03
# A better time offset must reduce the ATE to this fraction or less
MAX_ATE_RATIO_OF_BETTER_OFFSET = 0.8
# A better time offset must keep at least this fraction of the evaluated poses
MIN_POSE_COUNT_RATIO_OF_BETTER_OFFSET = 0.8

_Z_DOWN_FRAMES = ("NED", "FRD")
# Sources of trajectories with unknown vertical direction
_KINDS_WITHOUT_KNOWN_VERTICAL = ("slam", "unknown")
# File names that indicate monocular SLAM, which has an unknown scale
_MONOCULAR_PATTERN = re.compile(r"(?<![a-z])mono(?![a-z])|monocular", re.IGNORECASE)


class AbsoluteTrajectoryError(Record):
    """Absolute trajectory error (ATE): position (m) and orientation (degrees)."""

    translation_m: Statistics
    interval_m: OrUnavailable[RmseInterval]
    rotation_deg: OrUnavailable[Statistics]


class Evaluation(Record, kw_only=True):
    """ATE and RPE of an estimated trajectory against a reference.

    Attributes
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}
    alignment_reason : str
        Reason for the choice of the alignment, a sentence.
    transform : Transform
        Transform from the frame of the estimate to the frame of the reference.
    time_offset : TimeOffset
        Time offset added to the timestamps of the estimate.
    ate : AbsoluteTrajectoryError
        Absolute trajectory error.
    rpe : tuple of RelativePoseError
        Relative pose errors.
    notes, warnings : tuple of str
        Sentences for the user.
    estimate_track, reference_track : Trajectory
        Complete trajectories before alignment.
    time_s : ndarray, shape (n,)
        Times of the compared poses.
    distance_m : ndarray, shape (n,)
        Distance along the reference from the first compared pose.
    unaligned_position_m, aligned_position_m, reference_position_m : ndarray, shape (n, 3)
        Positions of estimate (before and after alignment) and reference.
    position_error_m : ndarray, shape (n,)
    """

    alignment: AlignmentKind
    alignment_reason: str
    transform: Transform
    association: Association
    time_offset: TimeOffset
    ate: AbsoluteTrajectoryError
    rpe: tuple[RelativePoseError, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    estimate_track: NotInJson[Trajectory] = NOT_IN_JSON
    reference_track: NotInJson[Trajectory] = NOT_IN_JSON
    time_s: NotInJson[Array] = NOT_IN_JSON
    distance_m: NotInJson[Array] = NOT_IN_JSON
    unaligned_position_m: NotInJson[Array] = NOT_IN_JSON
    aligned_position_m: NotInJson[Array] = NOT_IN_JSON
    reference_position_m: NotInJson[Array] = NOT_IN_JSON
    position_error_m: NotInJson[Array] = NOT_IN_JSON


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    alignment: AlignmentKind | None = None,
    association: AssociationMethod = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float | Literal["auto"] | None = None,
    rpe_deltas: Sequence[RpePairDistance] | None = None,
    all_pairs: bool = True,
) -> Evaluation:
    """Compute ATE and RPE of an estimated trajectory against a reference.

    Parameters
    ----------
    alignment : {"none", "yaw", "se3", "sim3"}, optional
        Default: see :func:`choose_alignment`.
    association : {"interpolate", "nearest"}
    max_gap_s : float, optional
        See :func:`~px4fuse.trajectory.association.associate`.
    time_offset_s : float, "auto" or None
        Time offset added to the timestamps of the estimate. "auto": estimate the offset from the
        motion. None: use UNIX time if available.
    rpe_deltas : sequence of RpePairDistance, optional
        Distances and times for the RPE. Default: chosen from the length of the flight.

    Raises
    ------
    TrajectoryError
        The trajectories do not overlap in time, or the motion does not determine the alignment.
    SettingsError
        A distance or time for the RPE is not positive, or a number of frames is not an integer.
    """
    estimate, estimate_notes = drop_constant_orientation(estimate)
    reference, reference_notes = drop_constant_orientation(reference)
    # 1. Match the poses in time
    time_offset, offset_warnings, better_offset_s = _choose_time_offset(
        estimate, reference, time_offset_s
    )
    added_offset_s = time_offset.offset_s or 0.0
    is_frozen, warnings = find_frozen_poses(estimate, reference, added_offset_s)
    matched_estimate, matched_reference, association_result = associate(
        estimate[~is_frozen],
        reference,
        method=association,
        max_gap_s=max_gap_s,
        time_offset_s=added_offset_s,
    )
    # 2. Choose and fit the alignment. If the user did not choose it, insufficient motion is only a
    # warning
    alignment_reason, is_alignment_given = "The user chose the alignment.", alignment is not None
    if alignment is None:
        alignment, alignment_reason = choose_alignment(matched_estimate, matched_reference)
    fit_positions = partial(
        fit_alignment, matched_estimate.position_m, matched_reference.position_m, alignment
    )
    jump_warnings = find_jump_warnings(matched_estimate, matched_reference)
    warnings += jump_warnings
    try:
        transform = fit_positions()
    except TrajectoryError as error:
        if is_alignment_given:
            raise
        transform = fit_positions(requires_motion=False)
        warnings.append(
            f"{capitalise_first_letter(error.reason)}. The ATE may be too small, and rotation "
            "errors may "
            "be wrong."
        )
    # 3. Convert the orientations of the estimate to the body axes of the reference
    aligned_estimate, notes = _rotate_to_reference_body(
        _apply_transform(transform, matched_estimate), matched_reference
    )
    # If the body axes differ by a constant rotation other than camera to vehicle, also estimate the
    # lever arm between the origins of both bodies
    if not notes and has_other_body_axes(aligned_estimate, matched_reference):
        matched_estimate, notes = _move_to_reference_body(
            matched_estimate, matched_reference, alignment
        )
        transform = fit_alignment(
            matched_estimate.position_m, matched_reference.position_m, alignment
        )
        aligned_estimate = _apply_transform(transform, matched_estimate)
    if estimate.kind == "truth" != reference.kind:
        warnings.append(
            f"{estimate.name} is ground truth, but {reference.name} is not. Give the estimate "
            "first, then the reference."
        )
    # 4. Compute the errors
    distance_m = cumulative_distance(matched_reference.position_m)
    position_error_m = np.linalg.norm(
        aligned_estimate.position_m - matched_reference.position_m, axis=1
    )
    position_statistics = compute_statistics(position_error_m)
    if better_offset_s is not None:
        # Evaluate again, to state in a warning how much the better time offset reduces the ATE.
        # With this offset, too few poses may match, or they do not move: then no warning
        with suppress(TrajectoryError):
            better_evaluation = evaluate(
                estimate,
                reference,
                alignment=alignment if is_alignment_given else None,
                association=association,
                max_gap_s=max_gap_s,
                time_offset_s=better_offset_s,
                rpe_deltas=(),
            )
            offset_warnings += _find_better_offset_warnings(position_statistics, better_evaluation)
    rotations = get_rotations(aligned_estimate, matched_reference, "ATE of the orientation")
    if rpe_deltas is None:
        rpe_deltas = choose_default_deltas(distance_m, matched_estimate.time_s)
    return Evaluation(
        estimate_track=estimate,
        reference_track=reference,
        alignment=alignment,
        alignment_reason=alignment_reason,
        transform=transform,
        association=association_result,
        time_offset=time_offset,
        ate=AbsoluteTrajectoryError(
            position_statistics,
            estimate_rmse_interval(position_error_m, "ATE"),
            rotations
            if isinstance(rotations, Unavailable)
            else compute_rotation_statistics(*rotations),
        ),
        rpe=tuple(
            compute_relative_pose_error(
                aligned_estimate, matched_reference, delta, all_pairs=all_pairs
            )
            for delta in rpe_deltas
        ),
        time_s=matched_estimate.time_s,
        distance_m=distance_m,
        unaligned_position_m=matched_estimate.position_m,
        aligned_position_m=aligned_estimate.position_m,
        reference_position_m=matched_reference.position_m,
        position_error_m=position_error_m,
        notes=(*estimate_notes, *reference_notes, *notes),
        # ``warnings`` already contains frozen poses, jumps, an uncertain alignment, and ground
        # truth that was given as the estimate
        warnings=(
            *warnings,
            *_find_mirror_warnings(
                matched_estimate, matched_reference, alignment, position_statistics.rmse
            ),
            *offset_warnings,
            *_find_comparison_warnings(
                matched_estimate,
                matched_reference,
                association_result,
                alignment,
                has_jumps=bool(jump_warnings),
            ),
        ),
    )


def _apply_transform(transform: Transform, estimate: Trajectory) -> Trajectory:
    return estimate.replace_positions(transform.apply(estimate.position_m), transform.to_rotation())


def choose_alignment(estimate: Trajectory, reference: Trajectory) -> tuple[AlignmentKind, str]:
    """Choose the alignment by the sources of the trajectories, and return the reason."""
    has_same_frame = estimate.frame == reference.frame != "unknown"
    if estimate.kind == "truth" and (has_same_frame or reference.kind == "truth"):
        return (
            "none",
            "No alignment: the file of the estimate contains ground truth in the frame of the "
            "reference.",
        )
    frames_text = f"{estimate.frame} and {reference.frame}"
    yaw_text = "Yaw and translation are aligned (4 degrees of freedom): "
    has_common_vertical = estimate.frame == reference.frame == "ENU" or (
        estimate.frame in _Z_DOWN_FRAMES and reference.frame in _Z_DOWN_FRAMES
    )
    if has_common_vertical and estimate.kind not in _KINDS_WITHOUT_KNOWN_VERTICAL:
        return "yaw", (
            f"{yaw_text}z is vertical in both frames ({frames_text}), so a tilt counts as an error."
        )
    try:
        scale = fit_alignment(estimate.position_m, reference.position_m, "sim3").scale
    except TrajectoryError:
        if has_common_vertical:
            return "yaw", (
                f"{yaw_text}motion along a line does not determine the rotation, but z is vertical "
                f"in both frames ({frames_text})."
            )
        # The scale is unknown: assume that the scales do not differ
        scale = 1.0
    se3_text = "Rotation and translation are aligned (6 degrees of freedom): "
    if estimate.kind in _KINDS_WITHOUT_KNOWN_VERTICAL:
        track_without_vertical = estimate
    elif reference.kind in _KINDS_WITHOUT_KNOWN_VERTICAL:
        track_without_vertical = reference
    else:
        return "se3", f"{se3_text}the frames {frames_text} have no common vertical direction."
    cause = "the source of this trajectory is unknown"
    if track_without_vertical.kind == "slam":
        cause = "SLAM uses the frame of the first key frame"
    frame_reason = (
        f"the vertical direction of {track_without_vertical.name} is unknown, because {cause}"
    )
    # Monocular SLAM has no scale
    monocular_names = [
        name for name in (estimate.name, reference.name) if _MONOCULAR_PATTERN.search(name)
    ]
    if monocular_names:
        scale_reason = f"the file name {monocular_names[0]} indicates monocular SLAM"
    elif abs(scale - 1.0) > MAX_SCALE_ERROR:
        scale_reason = (
            f"the scale factor {scale:.3g} differs from 1 by more than {MAX_SCALE_ERROR:.0%}"
        )
    else:
        return "se3", f"{se3_text}{frame_reason}."
    return "sim3", (
        "Rotation, translation and scale are aligned (7 degrees of freedom): "
        f"{frame_reason}, and {scale_reason}."
    )


def _choose_time_offset(
    estimate: Trajectory, reference: Trajectory, given_offset_s: float | Literal["auto"] | None
) -> tuple[TimeOffset, list[str], float | None]:
    """Choose the time offset to add to the timestamps of the estimate.

    Returns
    -------
    time_offset : TimeOffset
        Offset given by the user, estimated offset, or offset between the clocks.
    warnings : list of str
        Reason why an offset cannot be estimated, if an estimate is needed.
    better_offset_s : float or None
        Estimated offset, if it differs significantly from the offset between the clocks and is not
        used. The caller warns.
    """
    if isinstance(given_offset_s, float | int):
        reason = "The user chose the time offset."
        return TimeOffset(offset_s=given_offset_s, is_determinable=True, reason=reason), [], None
    # Offset between the clocks; files without UNIX time count as recordings of the same clock
    clock_offset_s = compute_clock_offset_s(estimate, reference)
    added_offset_s = clock_offset_s or 0.0
    match_text = (
        f"Poses are matched by {'UNIX time' if clock_offset_s else 'the timestamps in the files'}."
    )
    estimated_offset = estimate_time_offset(estimate, reference)
    start_s, end_s = estimate.time_s[[0, -1]] + added_offset_s
    is_disjoint = start_s > reference.time_s[-1] or end_s < reference.time_s[0]
    # An estimate is needed if the user asks for it, or if the times do not overlap
    if given_offset_s == "auto" or is_disjoint:
        if estimated_offset.is_determinable:
            return estimated_offset, [], None
        reason = estimated_offset.reason
        fallback = TimeOffset(offset_s=added_offset_s, is_determinable=False, reason=reason)
        return fallback, [f"{reason} {match_text}"], None
    time_offset = TimeOffset(offset_s=added_offset_s, is_determinable=True, reason=match_text)
    best_offset_s = estimated_offset.offset_s
    if best_offset_s is None or estimated_offset.interval_s is None:
        return time_offset, [], None
    low_s, high_s = estimated_offset.interval_s
    is_significant = not low_s <= added_offset_s <= high_s
    if is_significant and abs(best_offset_s - added_offset_s) >= MIN_REPORTED_TIME_OFFSET_S:
        return time_offset, [], best_offset_s
    return time_offset, [], None


def _find_better_offset_warnings(
    statistics: Statistics, better_evaluation: Evaluation
) -> Iterator[str]:
    """Yield a warning if another time offset reduces the ATE."""
    better_statistics = better_evaluation.ate.translation_m
    if (
        better_statistics.rmse <= MAX_ATE_RATIO_OF_BETTER_OFFSET * statistics.rmse
        and better_statistics.count >= MIN_POSE_COUNT_RATIO_OF_BETTER_OFFSET * statistics.count
    ):
        yield (
            f"With {better_evaluation.time_offset.offset_s:+.3f} s added to the timestamps of the "
            f"estimate, the ATE decreases from {format_metres(statistics.rmse)} to "
            f"{format_metres(better_statistics.rmse)} m. If the clocks differ, give --time-offset "
            "auto."
        )


def _find_mirror_warnings(
    estimate: Trajectory, reference: Trajectory, alignment: AlignmentKind, ate_m: float
) -> Iterator[str]:
    """Yield a warning if the estimate fits much better with the y or z axis reversed.

    ``ate_m`` is the ATE (RMSE, m) without reversal. A small ATE needs no test.
    """
    if ate_m < MIN_ATE_TO_EXTENT_RATIO_FOR_MIRROR_TEST * np.ptp(reference.position_m, axis=0).max():
        return
    for axis, signs in (("y", (1.0, -1.0, 1.0)), ("z", (1.0, 1.0, -1.0))):
        mirrored_m = estimate.position_m * signs
        transform = fit_alignment(
            mirrored_m, reference.position_m, alignment, requires_motion=False
        )
        mirrored_ate_m = compute_rms_length_m(transform.apply(mirrored_m) - reference.position_m)
        if mirrored_ate_m < MAX_MIRRORED_ATE_RATIO * ate_m:
            yield (
                f"The estimate is mirrored: with the sign of {axis} reversed, the ATE decreases "
                f"from {format_metres(ate_m)} to {format_metres(mirrored_ate_m)} m. Convert the "
                "estimate to a right-handed frame such as ENU or NED."
            )
            return


def _find_comparison_warnings(
    estimate: Trajectory,
    reference: Trajectory,
    association: Association,
    alignment: AlignmentKind,
    *,
    has_jumps: bool,
) -> Iterator[str]:
    """Yield warnings about trajectories that overlap only in part, and about a wrong scale."""
    if association.coverage_estimate < MIN_EVALUATED_TRAJECTORY_FRACTION:
        yield (
            f"Only {association.coverage_estimate:.0%} of the estimate is evaluated; the reference "
            "has no poses at the other times."
        )
    if association.coverage_reference < MIN_EVALUATED_TRAJECTORY_FRACTION:
        yield (
            f"The estimate covers only {association.coverage_reference:.0%} of the reference's "
            "duration."
        )
    if has_jumps:  # a jump changes the fitted scale
        return
    # Unlike fit_alignment, umeyama also returns the scale for motion along a line
    scale = umeyama(estimate.position_m, reference.position_m, with_scale=True).scale
    does_reference_move = np.ptp(reference.position_m, axis=0).any()
    if alignment != "sim3" and does_reference_move and abs(scale - 1.0) > MAX_SCALE_ERROR:
        yield (
            f"The scale factor of the estimate is {scale:.3g} instead of 1, which the alignment "
            f"{alignment} does not correct."
        )


def _move_to_reference_body(
    estimate: Trajectory, reference: Trajectory, alignment: AlignmentKind
) -> tuple[Trajectory, tuple[str, ...]]:
    """Convert the poses of the estimate to the body axes and body origin of the reference."""
    assert estimate.rotation is not None
    assert reference.rotation is not None
    # Model of the position error at each pose: R lever_arm + constant, with the rotation R of the
    # reference. Subtracting the mean values removes the constant, and least squares give lever_arm
    reference_rotation_matrices = reference.rotation.as_matrix()
    centred_rotation_matrices = (
        reference_rotation_matrices - reference_rotation_matrices.mean(axis=0)
    ).reshape(-1, 3)
    # The alignment depends on the lever arm, and the lever arm on the alignment: estimate both in
    # turn. The corrected positions are only for the alignment
    corrected_estimate = estimate
    for _ in range(LEVER_ARM_ITERATIONS):
        transform = fit_alignment(corrected_estimate.position_m, reference.position_m, alignment)
        # chordal mean of rotations (Hartley 2013, section 5.3)
        body_rotation = (
            (transform.to_rotation() * estimate.rotation).inv() * reference.rotation
        ).mean()
        error_m = transform.apply(estimate.position_m) - reference.position_m
        centred_error_m = (error_m - error_m.mean(axis=0)).ravel()
        lever_arm_m = np.linalg.lstsq(centred_rotation_matrices, centred_error_m, rcond=None)[0]
        rotation = estimate.rotation * body_rotation
        position_m = estimate.position_m - rotation.apply(lever_arm_m) / transform.scale
        corrected_estimate = replace(estimate, position_m=position_m, rotation=rotation)
    lever_arm_text = ", ".join(
        f"{value:+.2f} m along {axis}" for value, axis in zip(lever_arm_m, "xyz", strict=True)
    )
    return corrected_estimate, (
        "The body axes of estimate and reference differ by a constant rotation of "
        f"{np.degrees(body_rotation.magnitude()):.1f}°, and their origins by {lever_arm_text} in "
        "the axes of the reference. Both differences are removed before the errors are computed.",
    )


def _rotate_to_reference_body(
    aligned_estimate: Trajectory, reference: Trajectory
) -> tuple[Trajectory, tuple[str, ...]]:
    """Rotate the body axes of the estimate to those of the reference, if one has camera axes.

    The constant rotation between camera and vehicle axes is estimated. Return also a note on this
    rotation for the user, or no note.
    """
    # Body axes are camera axes in a camera frame, and probably also for SLAM in an unknown frame.
    # They differ between such a trajectory and a trajectory in another frame
    body_axes_differ = aligned_estimate.frame != reference.frame and any(
        track.frame == "camera" or (track.kind == "slam" and track.frame == "unknown")
        for track in (aligned_estimate, reference)
    )
    rotation_of_estimate = aligned_estimate.rotation
    if rotation_of_estimate is None or reference.rotation is None or not body_axes_differ:
        return aligned_estimate, ()
    # chordal mean of rotations (Hartley 2013, section 5.3)
    rotation = (rotation_of_estimate.inv() * reference.rotation).mean()
    return replace(aligned_estimate, rotation=rotation_of_estimate * rotation), (
        "Rotation errors exclude the estimated rotation between vehicle and camera axes, "
        f"{np.degrees(rotation.magnitude()):.1f}°. Position errors include the lever arm between "
        "vehicle and camera.",
    )
