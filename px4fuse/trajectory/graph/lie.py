"""Rigid motions in the plane and in space, and their tangents, over arrays.

A pose is x, y, heading (last axis 3) or x, y, z, qx, qy, qz, qw (last axis 7), in m and rad. A
tangent has translation (rho) first, then rotation (phi): 3 or 6 numbers, in the order of g2o's
information matrices. Perturbations stand on the right, in the axes of the pose itself:
``X exp(xi)``.

Sources: Barfoot 2017, State Estimation for Robotics, chapter 7 and section 8.3; Sola, Deray and
Atchuthan 2018, A micro Lie theory for state estimation in robotics, for the plane.
"""

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.trajectory.rotation import from_elements, skew

# Below this angle (rad) series replace quotients that cancel; five terms then reach 1e-14
SMALL = 0.3
_B = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800)
_C = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
_C_SLOPE = (1 / 360, 1 / 7560, 1 / 201600, 1 / 5987520, 691 / 130767436800)


def wrap(angle: Array) -> Array:
    """Angles within (-pi, pi].

    Parameters
    ----------
    angle : ndarray
        rad.
    """
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def rotation_matrix(pose: Array) -> Array:
    """Rotation of poses as a matrix.

    Returns
    -------
    ndarray, shape (..., 2, 2) or (..., 3, 3)
    """
    if pose.shape[-1] == 3:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        return from_elements((c, -s), (s, c))
    return _turn(pose).as_matrix()


def identity(width: int) -> Array:
    """Pose that moves nothing.

    Parameters
    ----------
    width : int
        3 in the plane, 7 in space.
    """
    made = np.zeros(width)
    made[6:] = 1.0  # w of the quaternion
    return made


def compose(a: Array, b: Array) -> Array:
    """Poses ``a b``: first the motion a, then b in the axes that a reached.

    Parameters
    ----------
    a, b : ndarray, shape (..., 3) or (..., 7)
        Quaternions are normalised in the result; headings are not wrapped.
    """
    made = np.empty(np.broadcast_shapes(a.shape, b.shape))
    if a.shape[-1] == 3:
        c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
        made[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
        made[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
        made[..., 2] = a[..., 2] + b[..., 2]
        return made
    turn = _turn(a)
    made[..., :3] = a[..., :3] + turn.apply(b[..., :3])
    made[..., 3:] = (turn * _turn(b)).as_quat()
    return made


def inverse(pose: Array) -> Array:
    """Poses that undo poses."""
    return between(pose, identity(pose.shape[-1]))


def between(a: Array, b: Array) -> Array:
    """Poses b as seen from a: the inverse of a, composed with b."""
    made = np.empty(np.broadcast_shapes(a.shape, b.shape))
    if a.shape[-1] == 3:
        c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
        x, y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
        made[..., 0], made[..., 1] = c * x + s * y, c * y - s * x
        made[..., 2] = b[..., 2] - a[..., 2]
        return made
    back = _turn(a).inv()
    made[..., :3] = back.apply(b[..., :3] - a[..., :3])
    made[..., 3:] = (back * _turn(b)).as_quat()
    return made


def exp(tangent: Array) -> Array:
    """Poses that a constant twist reaches in unit time (Barfoot 2017, 7.35; Sola 2018, 156)."""
    if tangent.shape[-1] == 3:
        theta = tangent[..., 2]
        x, y = tangent[..., 0], tangent[..., 1]
        s, c = np.sinc(theta / np.pi), theta * _a(theta)
        return np.stack([s * x - c * y, c * x + s * y, theta], axis=-1)
    rho, phi = tangent[..., :3], tangent[..., 3:]
    theta = np.linalg.norm(phi, axis=-1)[..., None]
    turned = np.cross(phi, rho)
    position = rho + _a(theta) * turned + _b(theta) * np.cross(phi, turned)
    return np.concatenate([position, Rotation.from_rotvec(phi).as_quat()], axis=-1)


def log(pose: Array) -> Array:
    """Tangents that :func:`exp` turns into poses, with a rotation of pi at most.

    Parameters
    ----------
    pose : ndarray, shape (..., 3) or (..., 7)
        Quaternions normalised; q and -q are the same rotation.
    """
    if pose.shape[-1] == 3:
        theta = wrap(pose[..., 2])
        x, y, half = pose[..., 0], pose[..., 1], 0.5 * theta
        cotangent = 1.0 - theta * theta * _c(np.abs(theta))
        return np.stack([cotangent * x + half * y, cotangent * y - half * x, theta], axis=-1)
    position, phi = pose[..., :3], _turn(pose).as_rotvec()
    turned = np.cross(phi, position)
    theta = np.linalg.norm(phi, axis=-1)[..., None]
    rho = position - 0.5 * turned + _c(theta) * np.cross(phi, turned)
    return np.concatenate([rho, phi], axis=-1)


def adjoint(pose: Array) -> Array:
    """Adjoints: ``X exp(xi) = exp(adjoint(X) xi) X`` (Barfoot 2017, 7.45; Sola 2018, 159).

    Returns
    -------
    ndarray, shape (..., 3, 3) or (..., 6, 6)
    """
    rotation = rotation_matrix(pose)
    if pose.shape[-1] == 3:
        made = np.zeros((*pose.shape, 3))
        made[..., :2, :2] = rotation
        made[..., 0, 2], made[..., 1, 2] = pose[..., 1], -pose[..., 0]
        made[..., 2, 2] = 1.0
        return made
    made = np.zeros((*pose.shape[:-1], 6, 6))
    made[..., :3, :3] = made[..., 3:, 3:] = rotation
    made[..., :3, 3:] = skew(pose[..., :3]) @ rotation
    return made


def right_jacobian_inverse(tangent: Array) -> Array:
    """Inverse of the right Jacobian: how log(X) changes as X is moved in its own axes.

    Parameters
    ----------
    tangent : ndarray, shape (..., 3) or (..., 6)
        With a rotation below 2 pi.

    Returns
    -------
    ndarray, shape (..., 3, 3) or (..., 6, 6)
    """
    once = _commutator(tangent)
    twice = once @ once
    turn = tangent[..., 2 if tangent.shape[-1] == 3 else 3 :]
    theta = np.linalg.norm(turn, axis=-1)[..., None, None]
    c, slope = _c(theta), 0.5 * _c_slope(theta)
    # x / (1 - exp(-x)) of it, as ad^5 = -2 theta^2 ad^3 - theta^4 ad
    made: Array = np.eye(once.shape[-1]) + 0.5 * once + (c - theta * theta * slope) * twice
    return made - slope * (twice @ twice)


def _commutator(tangent: Array) -> Array:
    """``ad``: how :func:`adjoint` of ``exp(t tangent)`` grows with t (Barfoot 2017, 7.33)."""
    if tangent.shape[-1] == 3:
        x, y, theta = np.moveaxis(tangent, -1, 0)
        return from_elements((0.0, -theta, y), (theta, 0.0, -x), (0.0, 0.0, 0.0))
    made = np.zeros((*tangent.shape, 6))
    made[..., :3, :3] = made[..., 3:, 3:] = skew(tangent[..., 3:])
    made[..., :3, 3:] = skew(tangent[..., :3])
    return made


def chain(steps: Array) -> Array:
    """Poses along a chain of motions: the products of the first 0, 1, ..., n of them.

    Doubles the length of what is composed, so that log2(n) passes over arrays do.

    Parameters
    ----------
    steps : ndarray, shape (n, 3) or (n, 7)

    Returns
    -------
    ndarray, shape (n + 1, 3) or (n + 1, 7)
    """
    made = np.vstack([identity(steps.shape[-1]), steps])
    reach = 1
    while reach < len(made):
        made[reach:] = compose(made[:-reach], made[reach:])
        reach *= 2
    return made


def _turn(pose: Array) -> Rotation:
    """Rotation of poses in space."""
    return Rotation.from_quat(pose[..., 3:])


def _a(theta: Array) -> Array:
    """(1 - cos theta) / theta^2."""
    return 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2


def _b(theta: Array) -> Array:
    """(theta - sin theta) / theta^3."""
    t = np.where(theta < SMALL, 1.0, theta)
    return np.where(theta < SMALL, polyval(theta * theta, _B), (t - np.sin(t)) / t**3)


def _c(theta: Array) -> Array:
    """(1 - theta/2 cot(theta/2)) / theta^2."""
    t = np.where(theta < SMALL, 1.0, theta)
    exact = (1.0 - 0.5 * t / np.tan(0.5 * t)) / t**2
    return np.where(theta < SMALL, polyval(theta * theta, _C), exact)


def _c_slope(theta: Array) -> Array:
    """Derivative of c by theta, over theta."""
    t = np.where(theta < SMALL, 1.0, theta)
    g_slope = 0.5 / np.tan(0.5 * t) - 0.25 * t / np.sin(0.5 * t) ** 2
    exact = -(g_slope + 2.0 * (1.0 - 0.5 * t / np.tan(0.5 * t)) / t) / t**3
    return np.where(theta < SMALL, polyval(theta * theta, _C_SLOPE), exact)
