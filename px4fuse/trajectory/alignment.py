"""Alignment of an estimated trajectory with a reference before the error is computed.

Source: Zhang and Scaramuzza 2018, A tutorial on quantitative trajectory evaluation.
"""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.core.record import Count, Record, Vector
from px4fuse.errors import TrajectoryError

from .model import MIN_POSES

AlignmentKind = Literal["none", "yaw", "se3", "sim3"]

# Minimum extent of a path along its second principal axis, divided by the largest extent
MIN_EXTENT_RATIO_FOR_ROTATION = 1e-6
# Minimum extent (m, RMS) of a path
MIN_PATH_EXTENT_M = 1e-6
# Maximum residual (RMS) after a yaw alignment, divided by the horizontal motion (RMS)
MAX_RESIDUAL_TO_MOTION_RATIO_FOR_YAW = 1.0
# Maximum residual (RMS) after a rotation alignment, divided by the motion (RMS) perpendicular to
# the main direction
MAX_RESIDUAL_TO_MOTION_RATIO_FOR_3D_ROTATION = 2.0


class Transform(Record):
    """Similarity transform x ↦ scale · R x + t from the estimate's frame to the reference's.

    Attributes
    ----------
    quaternion_wxyz : tuple of float
        Rotation R.
    translation_m : tuple of float
        Translation t (m), in the frame of the reference.
    scale : float
    degrees_of_freedom : int
        Number of fitted parameters: 0, 4, 6 or 7.
    """

    quaternion_wxyz: tuple[float, float, float, float]
    translation_m: Vector
    scale: float
    degrees_of_freedom: Count

    def to_rotation(self) -> Rotation:
        """Return the rotation R from the frame of the estimate to the frame of the reference."""
        return Rotation.from_quat(self.quaternion_wxyz, scalar_first=True)

    def apply(self, position_m: Array) -> Array:
        """Transform positions to the frame of the reference, shape (n, 3) or (3,)."""
        rotated_position_m: Array = self.to_rotation().apply(self.scale * position_m)
        return rotated_position_m + self.translation_m

    def apply_inverse(self, position_m: Array) -> Array:
        """Transform positions to the frame of the estimate, shape (n, 3) or (3,)."""
        rotated_position_m: Array = self.to_rotation().inv().apply(position_m - self.translation_m)
        return rotated_position_m / self.scale


def fit_alignment(
    estimate_m: Array,
    reference_m: Array,
    kind: AlignmentKind,
    *,
    requires_motion: bool = True,
) -> Transform:
    """Fit the transform that minimises the squared distance of the estimate to the reference.

    Sources: Umeyama (1991), eqs. 40 to 43; for "yaw" Zhang and Scaramuzza (2018), section III-C.

    Parameters
    ----------
    estimate_m, reference_m : ndarray, shape (n, 3)
        Positions at the same times.
    kind : {"none", "yaw", "se3", "sim3"}
        Kind of transform. For "yaw", z must be vertical, with the same direction in both frames.
    requires_motion : bool
        True to raise an error if the motion does not determine the rotation.

    Raises
    ------
    TrajectoryError
        There are fewer than three positions, or the motion does not determine the rotation.
    """
    if len(estimate_m) < MIN_POSES:
        raise TrajectoryError(
            f"{len(estimate_m)} poses match in time; an alignment needs at least {MIN_POSES}",
            "Check that both trajectories are of the same flight, or set `time_offset_s` to auto.",
        )
    if kind == "none":
        return Transform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 0)
    if kind == "yaw":
        estimate_xy_m, reference_xy_m = (m[:, 0] + 1j * m[:, 1] for m in (estimate_m, reference_m))
        centred_estimate_m = estimate_xy_m - estimate_xy_m.mean()
        yaw_rad = np.angle(np.vdot(centred_estimate_m, reference_xy_m - reference_xy_m.mean()))
        transform = _make_transform(
            Rotation.from_euler("z", yaw_rad), estimate_m, reference_m, 1.0, degrees_of_freedom=4
        )
    else:
        # Fit the scale even for SE(3): a scale factor error would increase the residuals in the
        # following test of sufficient motion
        transform = umeyama(estimate_m, reference_m, with_scale=True)
    if requires_motion:
        _require_sufficient_motion(transform, estimate_m, reference_m, kind)
    return umeyama(estimate_m, reference_m, with_scale=False) if kind == "se3" else transform


def umeyama(estimate_m: Array, reference_m: Array, *, with_scale: bool) -> Transform:
    """Fit SE(3) or Sim(3) to two sets of positions by least squares (Umeyama 1991).

    Parameters
    ----------
    estimate_m, reference_m : ndarray, shape (n, 3)
    with_scale : bool
        True to fit Sim(3), False to fit SE(3).
    """
    x = estimate_m - estimate_m.mean(axis=0)
    y = reference_m - reference_m.mean(axis=0)
    u, d, vt = np.linalg.svd(y.T @ x / len(x))  # Umeyama eq. 38
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # Umeyama eq. 43
    estimate_variance_m2 = float((x * x).sum() / len(x))  # Umeyama eq. 36
    scale = 1.0
    if with_scale and estimate_variance_m2 > MIN_PATH_EXTENT_M**2:  # avoid an infinite scale
        scale = float(d @ s / estimate_variance_m2)  # Umeyama eq. 42
    rotation = Rotation.from_matrix((u * s) @ vt)  # Umeyama eq. 40
    return _make_transform(rotation, estimate_m, reference_m, scale, 7 if with_scale else 6)


def _make_transform(
    rotation: Rotation, estimate_m: Array, reference_m: Array, scale: float, degrees_of_freedom: int
) -> Transform:
    """Return the transform that maps the mean position to the mean reference (Umeyama eq. 41)."""
    translation_m = reference_m.mean(axis=0) - scale * rotation.apply(estimate_m.mean(axis=0))
    quaternion = tuple(rotation.as_quat(scalar_first=True).tolist())
    return Transform(quaternion, tuple(translation_m.tolist()), scale, degrees_of_freedom)


def _compute_principal_extents_m(position_m: Array) -> Array:
    """Compute the RMS extents (m) along the principal directions, largest first."""
    centred_m = position_m - position_m.mean(axis=0)
    return np.asarray(np.linalg.svd(centred_m, compute_uv=False) / np.sqrt(len(centred_m)))


def compute_rms_length_m(difference_m: Array) -> float:
    """Return the RMS length (m) of vectors, shape (n, d)."""
    return float(np.sqrt((difference_m * difference_m).sum(axis=1).mean()))


def _require_sufficient_motion(
    transform: Transform, estimate_m: Array, reference_m: Array, kind: str
) -> None:
    """Raise TrajectoryError if the motion is too small to estimate the rotation.

    ``transform`` is the fitted alignment of the kind "yaw", "se3" or "sim3".
    """
    reference_extents_m = _compute_principal_extents_m(reference_m)
    residuals_m = reference_m - transform.apply(estimate_m)
    # The motion that determines the rotation (extent_m) must exceed rounding errors, which are
    # proportional to the largest motion (max_extent_m). It must also be large relative to the
    # residuals, because otherwise it may be only noise
    if kind == "yaw":
        # Horizontal motion determines the yaw: its extent must not be negligible relative to the
        # extent of the whole motion
        extent_m = min(
            float(np.linalg.norm(position_m[:, :2].std(axis=0)))
            for position_m in (estimate_m, reference_m)
        )
        residuals_m = residuals_m[:, :2]
        max_extent_m = float(np.linalg.norm(reference_extents_m))
        max_residual_ratio = MAX_RESIDUAL_TO_MOTION_RATIO_FOR_YAW
        motion_text = "horizontal motion"
        remedy = "Set `alignment` to none to compare the trajectories without alignment."
    else:
        # Motion along a line does not determine the rotation around the line. Take the smaller
        # extent of both trajectories along each principal direction; the second extent shows motion
        # beside the line
        max_extent_m, extent_m, _ = np.minimum(
            transform.scale * _compute_principal_extents_m(estimate_m), reference_extents_m
        )
        max_residual_ratio = MAX_RESIDUAL_TO_MOTION_RATIO_FOR_3D_ROTATION
        motion_text = "motion perpendicular to the main direction of flight"
        remedy = "Set `alignment` to yaw or none."
    residual_m = compute_rms_length_m(residuals_m)
    if (
        extent_m < max(MIN_PATH_EXTENT_M, MIN_EXTENT_RATIO_FOR_ROTATION * max_extent_m)
        or residual_m > max_residual_ratio * extent_m
    ):
        raise TrajectoryError(
            f"the alignment {kind} cannot be estimated: the {motion_text} is too small ("
            f"{extent_m:.2g} m RMS, residual after alignment {residual_m:.2g} m RMS)",
            remedy,
        )
