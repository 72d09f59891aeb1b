"""Alignment of an estimate with its reference: what of the difference is only a choice of frame.

An estimator that feels gravity knows what is vertical: it may be turned about the vertical and
shifted, four degrees of freedom, and a tilt of it is an error (Zhang & Scaramuzza 2018). SLAM whose
world is its first key frame may be turned in any way (six), and a single camera does not know the
scale (seven).
"""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.errors import TrajectoryError
from px4fuse.record import Count, Record, Vector
from px4fuse.trajectory.model import MIN_POSES

AlignmentKind = Literal["none", "yaw", "se3", "sim3"]

# Below this share of the motion's extent, or this RMS, there is nothing to turn by
MIN_SHARE, MIN_SPREAD_M = 1e-6, 1e-6
# The turn's standard deviation is residual / (spread · √n). Two spreads of mere noise leave √2 of
# one as residual in the plane, and √6 around a line: chance decides the turn
MAX_PLANE_RATIO, MAX_LINE_RATIO = 1.0, 2.0


class Transform(Record, frozen=True):
    """A similarity, from the estimate's world to the reference's: x ↦ scale · R x + t.

    Attributes
    ----------
    quaternion_wxyz : tuple of float
        R.
    translation_m : tuple of float
        t, in the reference's frame.
    scale : float
        Exactly 1 except for Sim(3).
    degrees_of_freedom : int
        How many of its numbers were fitted: 0, 4, 6 or 7.
    """

    quaternion_wxyz: tuple[float, float, float, float]
    translation_m: Vector
    scale: float
    degrees_of_freedom: Count

    @property
    def rotation(self) -> Rotation:
        """R, a single one."""
        return Rotation.from_quat(self.quaternion_wxyz, scalar_first=True)

    def apply(self, position_m: Array) -> Array:
        """Positions in the reference's frame, shape (n, 3) or (3,)."""
        rotated: Array = self.rotation.apply(self.scale * position_m)
        return rotated + self.translation_m

    def apply_inverse(self, position_m: Array) -> Array:
        """Positions in the estimate's world, shape (n, 3) or (3,)."""
        shifted: Array = self.rotation.inv().apply(position_m - np.array(self.translation_m))
        return shifted / self.scale


def fit_alignment(estimate_m: Array, reference_m: Array, kind: AlignmentKind) -> Transform:
    """Transform of the estimate that leaves the least squared distance to the reference.

    Umeyama (1991), eqs. 40 to 43, for "se3" and "sim3"; for "yaw" the closed form of Zhang &
    Scaramuzza (2018), section III-C, about z.

    Parameters
    ----------
    estimate_m, reference_m : ndarray, shape (n, 3)
        Positions at the same times.
    kind : {"none", "yaw", "se3", "sim3"}
        For "yaw" z must be vertical in both frames, and point the same way.

    Raises
    ------
    TrajectoryError
        Fewer than three positions, or a motion from which the transform cannot be found: none, or
        along a line, about which any turn fits as well.
    """
    if len(estimate_m) < MIN_POSES:
        raise TrajectoryError.of("matches_few", count=len(estimate_m), least=MIN_POSES)
    if kind == "none":
        return Transform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 0)
    if kind == "yaw":
        x, y = (m[:, 0] + 1j * m[:, 1] for m in (estimate_m, reference_m))
        heading = float(np.angle(np.vdot(x - x.mean(), y - y.mean())))
        transform = _similarity(Rotation.from_euler("z", heading), estimate_m, reference_m, 1.0, 4)
        _require_determined(transform, estimate_m, reference_m, kind)
        return transform
    # the scale is left out of the question: a wrong one is no reason to doubt the turn
    similarity = umeyama(estimate_m, reference_m, with_scale=True)
    _require_determined(similarity, estimate_m, reference_m, kind)
    return similarity if kind == "sim3" else umeyama(estimate_m, reference_m, with_scale=False)


def umeyama(estimate_m: Array, reference_m: Array, *, with_scale: bool) -> Transform:
    """SE(3) or Sim(3) of least squares, without asking whether the motion determines it.

    Along a line it is one of many that are equally good.

    Parameters
    ----------
    estimate_m, reference_m : ndarray, shape (n, 3)
    with_scale : bool
        Sim(3); scale 1 where the estimate does not move.
    """
    x, y = estimate_m - estimate_m.mean(axis=0), reference_m - reference_m.mean(axis=0)
    u, d, vt = np.linalg.svd(y.T @ x / len(x))  # eq. 38
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # eq. 43
    variance = float((x * x).sum() / len(x))  # eq. 36
    # eq. 42; the smallest double would give an infinite scale
    scale = float(d @ s / variance) if with_scale and variance > MIN_SPREAD_M**2 else 1.0
    turn = Rotation.from_matrix((u * s) @ vt)  # eq. 40
    return _similarity(turn, estimate_m, reference_m, scale, 7 if with_scale else 6)


def _similarity(
    turn: Rotation, estimate_m: Array, reference_m: Array, scale: float, freedom: int
) -> Transform:
    """The similarity of a turn and a scale, which brings the means together (eq. 41)."""
    shift = reference_m.mean(axis=0) - scale * turn.apply(estimate_m.mean(axis=0))
    w, x, y, z = turn.as_quat(scalar_first=True).tolist()
    return Transform((w, x, y, z), tuple(shift.tolist()), scale, freedom)


def _spread(position_m: Array) -> Array:
    """RMS about the mean along the principal directions, descending (m)."""
    centred = position_m - position_m.mean(axis=0)
    return np.asarray(np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred)))


def rms_m(difference_m: Array) -> float:
    """Root mean square length of vectors, shape (n, d)."""
    return float(np.sqrt((difference_m * difference_m).sum(axis=1).mean()))


def _require_determined(
    transform: Transform, estimate_m: Array, reference_m: Array, kind: str
) -> None:
    """Refuse a turn that the motion does not determine.

    What determines a yaw is the horizontal motion; any other turn, the extent away from a line,
    which is the second singular value.
    """
    spread, target = _spread(estimate_m), _spread(reference_m)
    if kind == "yaw":
        extent_m = min(float(np.hypot(*_spread(m[:, :2]))) for m in (estimate_m, reference_m))
        residual_m = rms_m((reference_m - transform.apply(estimate_m))[:, :2])
        length, limit = float(np.linalg.norm(target)), MAX_PLANE_RATIO
        motion, instead = "horizontal motion (RMS) is", "`alignment` none"
    else:
        length, extent_m, _ = np.minimum(transform.scale * spread, target)
        residual_m = rms_m(reference_m - transform.apply(estimate_m))
        limit = MAX_LINE_RATIO
        motion = f"motion is along a line: {length:.2g} m (RMS) by"
        instead = "`alignment` yaw if z is vertical in both, or `alignment` none"
    if extent_m < max(MIN_SPREAD_M, MIN_SHARE * length) or residual_m > limit * extent_m:
        raise TrajectoryError.of(
            "alignment_open",
            motion=motion,
            extent_m=extent_m,
            residual_m=residual_m,
            kind=kind,
            instead=instead,
        )
