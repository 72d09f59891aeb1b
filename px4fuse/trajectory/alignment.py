"""Alignment of an estimate with its reference: what of the difference is only a choice of frame.

An estimator that feels gravity knows what is vertical: it may be turned about the vertical and
shifted, four degrees of freedom, and a tilt of it is an error (Zhang & Scaramuzza 2018). SLAM whose
world is its first key frame may be turned in any way (six), and a single camera does not know the
scale (seven).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.model import MIN_POSES

AlignmentKind = Literal["none", "yaw", "se3", "sim3"]

# Below this share of the motion's extent, or this RMS, there is nothing to turn by
MIN_SHARE, MIN_SPREAD_M = 1e-6, 1e-6
# The turn's standard deviation is residual / (spread · √n). Two spreads of mere noise leave √2 of
# one as residual in the plane, and √6 around a line: chance decides the turn
MAX_PLANE_RATIO, MAX_LINE_RATIO = 1.0, 2.0


@dataclass(frozen=True)
class Transform:
    """A similarity, from the estimate's world to the reference's: s·R·p + t.

    Attributes
    ----------
    rotation : Rotation
        R, a single one.
    translation_m : ndarray, shape (3,)
        t, in the reference's frame.
    scale : float
        s; exactly 1 except for Sim(3).
    degrees_of_freedom : int
        How many of its numbers were fitted: 0, 4, 6 or 7.
    """

    rotation: Rotation
    translation_m: Array
    scale: float
    degrees_of_freedom: int

    def apply(self, position_m: Array) -> Array:
        """Positions in the reference's frame, shape (n, 3) or (3,)."""
        turned: Array = self.rotation.apply(self.scale * position_m)
        return turned + self.translation_m


def fit(estimate_m: Array, reference_m: Array, kind: AlignmentKind) -> Transform:
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
        raise TrajectoryError(
            f"Only {len(estimate_m)} poses match in time: an alignment needs {MIN_POSES}. Check "
            "that both are of the same flight, and their clocks (`time_offset_s` auto)."
        )
    if kind == "none":
        return Transform(Rotation.identity(), np.zeros(3), 1.0, 0)
    if kind == "yaw":
        transform = _yaw(estimate_m, reference_m)
        level = (True, True, False)
        _check_yaw(transform, estimate_m[:, level], reference_m[:, level], reference_m)
        return transform
    # the scale is left out of the question: a wrong one is no reason to doubt the turn
    free = umeyama(estimate_m, reference_m, with_scale=True)
    _check_turn(free, estimate_m, reference_m, kind)
    return free if kind == "sim3" else umeyama(estimate_m, reference_m, with_scale=False)


def umeyama(estimate_m: Array, reference_m: Array, *, with_scale: bool) -> Transform:
    """SE(3) or Sim(3) of least squares, without asking whether the motion determines it.

    Along a line it is one of many that are equally good.

    Parameters
    ----------
    estimate_m, reference_m : ndarray, shape (n, 3)
    with_scale : bool
        Sim(3); scale 1 where the estimate does not move.
    """
    x_mean, y_mean = estimate_m.mean(axis=0), reference_m.mean(axis=0)
    x, y = estimate_m - x_mean, reference_m - y_mean
    u, d, vt = np.linalg.svd(y.T @ x / len(x))  # eq. 38
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # eq. 43
    turn = (u * s) @ vt  # eq. 40
    variance = float((x * x).sum() / len(x))  # eq. 36
    # eq. 42; the smallest double would give an infinite scale
    scale = float(d @ s / variance) if with_scale and variance > MIN_SPREAD_M**2 else 1.0
    translation: Array = y_mean - scale * (turn @ x_mean)  # eq. 41
    return Transform(Rotation.from_matrix(turn), translation, scale, 7 if with_scale else 6)


def _yaw(estimate_m: Array, reference_m: Array) -> Transform:
    """Four degrees of freedom: horizontal positions as complex numbers, a turn as a factor."""
    x_mean, y_mean = estimate_m.mean(axis=0), reference_m.mean(axis=0)
    x, y = estimate_m - x_mean, reference_m - y_mean
    cross = np.vdot(x[:, 0] + 1j * x[:, 1], y[:, 0] + 1j * y[:, 1])
    turn = Rotation.from_euler("z", float(np.angle(cross)))
    return Transform(turn, y_mean - turn.apply(x_mean), 1.0, 4)


def _spread(position_m: Array) -> Array:
    """RMS about the mean along the principal directions, descending (m)."""
    centred = position_m - position_m.mean(axis=0)
    rms: Array = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))
    return rms


def _check_yaw(transform: Transform, x: Array, y: Array, reference_m: Array) -> None:
    """Refuse a yaw that the horizontal motion does not determine."""
    moved = min(float(np.hypot(*_spread(x))), float(np.hypot(*_spread(y))))
    turned = (x - x.mean(axis=0)) @ transform.rotation.as_matrix()[:2, :2].T
    left = float(np.sqrt(((y - y.mean(axis=0) - turned) ** 2).sum(axis=1).mean()))
    extent = float(np.linalg.norm(_spread(reference_m)))
    if moved < max(MIN_SPREAD_M, MIN_SHARE * extent) or left > MAX_PLANE_RATIO * moved:
        raise TrajectoryError(
            f"The horizontal motion is {moved:.2g} m (RMS) and what an alignment leaves is "
            f"{left:.2g} m: a yaw cannot be found from it. The vehicle did not move, or the "
            f"estimate does not follow; `alignment` none compares without turning."
        )


def _check_turn(
    transform: Transform, estimate_m: Array, reference_m: Array, kind: AlignmentKind
) -> None:
    """Refuse a turn that the motion does not determine.

    The second singular value is the extent of the motion away from a line.
    """
    x, y = transform.scale * _spread(estimate_m), _spread(reference_m)
    length, width = min(x[0], y[0]), min(x[1], y[1])
    left = reference_m - transform.apply(estimate_m)
    rms = float(np.sqrt((left * left).sum(axis=1).mean()))
    if length < MIN_SPREAD_M or _spread(estimate_m)[0] < MIN_SPREAD_M:
        raise TrajectoryError(
            f"One of the two does not move, so {kind} cannot be found from it. `alignment` none "
            "compares without turning."
        )
    if width < MIN_SHARE * length or rms > MAX_LINE_RATIO * width:
        raise TrajectoryError(
            f"The motion is along a line: {length:.2g} m (RMS) by {width:.2g} m across it, where "
            f"an alignment leaves {rms:.2g} m, so the turn about that line and with it {kind} "
            f"cannot be found. Use `alignment` yaw if z is vertical in both, or `alignment` none."
        )
