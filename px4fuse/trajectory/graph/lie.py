"""Lie groups SE(2) and SE(3): poses and tangent vectors as arrays.

A pose is x, y, heading or x, y, z, qx, qy, qz, qw, in m and rad. A tangent vector is translation,
then rotation: 3 or 6 numbers. A perturbation xi of a pose X is on the right: ``X exp(xi)``.

Sources: Barfoot 2017, State Estimation for Robotics, chapter 7 and section 8.3; for SE(2) Sola,
Deray and Atchuthan 2018, A micro Lie theory for state estimation in robotics.
"""

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array

from ..rotation import build_matrix, skew

# Below this angle (rad), power series replace quotients, which lose precision
SMALL_ANGLE_RAD = 0.3
# Power series in theta^2 of f(theta) = (1 - theta/2 cot(theta/2)) / theta^2 and of f'(theta) /
# theta
_SQUARE_TERM_FACTOR_COEFFICIENTS = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
_SQUARE_TERM_DERIVATIVE_COEFFICIENTS = (
    1 / 360,
    1 / 7560,
    1 / 201600,
    1 / 5987520,
    691 / 130767436800,
)


def wrap(angle: Array) -> Array:
    """Wrap angles (rad) to (-pi, pi]."""
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def rotation_matrix(pose: Array) -> Array:
    """Return the rotation matrices of poses, shape (..., 2, 2) or (..., 3, 3)."""
    if pose.shape[-1] == 3:
        c = np.cos(pose[..., 2])
        s = np.sin(pose[..., 2])
        return build_matrix((c, -s), (s, c))
    return _rotation_of(pose).as_matrix()


def identity(pose_length: int) -> Array:
    """Return the identity pose; ``pose_length`` is 3 for SE(2) and 7 for SE(3)."""
    pose = np.zeros(pose_length)
    pose[6:] = 1.0  # the identity rotation has w = 1
    return pose


def compose(a: Array, b: Array) -> Array:
    """Compute the products ``a b`` of poses: motion a, then motion b in the axes of a.

    Headings are not wrapped.

    Parameters
    ----------
    a, b : ndarray, shape (..., 3) or (..., 7)
    """
    d = _get_dimension(a)
    rotation = a[..., 2:] + b[..., 2:] if d == 2 else (_rotation_of(a) * _rotation_of(b)).as_quat()
    return np.concatenate(
        [a[..., :d] + _multiply_matrix_by_vector(rotation_matrix(a), b[..., :d]), rotation], axis=-1
    )


def inverse(pose: Array) -> Array:
    """Return the inverses of poses."""
    return relative_pose(pose, identity(pose.shape[-1]))


def relative_pose(a: Array, b: Array) -> Array:
    """Return the poses b relative to the poses a: inverse of a, times b."""
    d = _get_dimension(a)
    inverse_rotation = np.swapaxes(rotation_matrix(a), -1, -2)
    rotation = (
        b[..., 2:] - a[..., 2:] if d == 2 else (_rotation_of(a).inv() * _rotation_of(b)).as_quat()
    )
    return np.concatenate(
        [_multiply_matrix_by_vector(inverse_rotation, b[..., :d] - a[..., :d]), rotation], axis=-1
    )


def exp(tangent: Array) -> Array:
    """Return the poses of tangent vectors: exponential map (Barfoot 2017, 7.35; Sola 2018, 156).

    Parameters
    ----------
    tangent : ndarray, shape (..., 3) or (..., 6)
        Tangent vectors with a rotation below 2 pi.
    """
    d = _get_dimension(tangent)
    rho = tangent[..., :d]
    phi = tangent[..., d:]
    position = np.linalg.solve(_left_jacobian_inverse(phi), rho[..., None])[..., 0]
    rotation = phi if d == 2 else Rotation.from_rotvec(phi).as_quat()
    return np.concatenate([position, rotation], axis=-1)


def log(pose: Array) -> Array:
    """Return the tangent vectors of poses: logarithm, the inverse of :func:`exp`.

    Parameters
    ----------
    pose : ndarray, shape (..., 3) or (..., 7)
        Poses with normalised quaternions.
    """
    d = _get_dimension(pose)
    phi = wrap(pose[..., 2:]) if d == 2 else _rotation_of(pose).as_rotvec()
    return np.concatenate(
        [_multiply_matrix_by_vector(_left_jacobian_inverse(phi), pose[..., :d]), phi], axis=-1
    )


def adjoint(pose: Array) -> Array:
    """Return the adjoint matrices of poses, shape (..., 3, 3) or (..., 6, 6).

    Definition: ``X exp(xi) = exp(adjoint(X) xi) X`` (Barfoot 2017, 7.45).
    """
    rotation = rotation_matrix(pose)
    translation = pose[..., : _get_dimension(pose)]
    if pose.shape[-1] == 3:
        return _build_block_matrix(rotation, _cross_vertical(translation), 1.0)
    return _build_block_matrix(rotation, skew(translation) @ rotation, rotation)


def right_jacobian_inverse(tangent: Array) -> Array:
    """Return the inverse right Jacobians, shape (..., 3, 3) or (..., 6, 6).

    They are the derivatives of log(X exp(xi)) with respect to xi at xi = 0, with X = exp(tangent).

    Parameters
    ----------
    tangent : ndarray, shape (..., 3) or (..., 6)
        Tangent vectors with a rotation below 2 pi.
    """
    # The Jacobian is the power series x / (1 - exp(-x)) = 1 + x/2 + x^2/12 - x^4/720 + ... of the
    # Lie bracket matrix x = ad. Since ad^5 = -2 theta^2 ad^3 - theta^4 ad, it is a polynomial
    # 1 + x/2 + a x^2 + b x^4. At the eigenvalues +-i theta of ad, polynomial and series have the
    # same value and derivative. Therefore a = f - theta f'/2 and b = -f'/(2 theta), with f(theta)
    # from _compute_square_term_factor
    ad = _make_lie_bracket_matrix(tangent)
    ad_squared = ad @ ad
    theta = np.linalg.norm(tangent[..., _get_dimension(tangent) :], axis=-1)[..., None, None]
    half_derivative_over_theta = 0.5 * _compute_square_term_derivative_over_theta(theta)
    a = _compute_square_term_factor(theta) - theta * theta * half_derivative_over_theta
    b = -half_derivative_over_theta
    jacobian: Array = np.eye(ad.shape[-1]) + 0.5 * ad + a * ad_squared
    return jacobian + b * (ad_squared @ ad_squared)


def _make_lie_bracket_matrix(tangent: Array) -> Array:
    """Return the Lie bracket matrices ad(xi) of tangent vectors (Barfoot 2017, 7.33)."""
    d = _get_dimension(tangent)
    rho, rotation = tangent[..., :d], _make_skew_matrix(tangent[..., d:])
    if d == 2:
        return _build_block_matrix(rotation, _cross_vertical(rho), 0.0)
    return _build_block_matrix(rotation, skew(rho), rotation)


def _build_block_matrix(rotation: Array, coupling: Array, corner: Array | float) -> Array:
    """Build the block matrices [[rotation, coupling], [0, corner]].

    They multiply tangent vectors that contain the translation first, then the rotation.
    """
    d = rotation.shape[-1]
    size = d + coupling.shape[-1]
    matrix = np.zeros((*rotation.shape[:-2], size, size))
    matrix[..., :d, :d] = rotation
    matrix[..., :d, d:] = coupling
    matrix[..., d:, d:] = corner
    return matrix


def _cross_vertical(vector: Array) -> Array:
    """Return the cross products of vectors in the plane with a vertical unit vector, as columns."""
    return build_matrix((vector[..., 1],), (-vector[..., 0],))


def _make_skew_matrix(phi: Array) -> Array:
    """Return the skew-symmetric matrices of rotation vectors in the plane or in space."""
    if phi.shape[-1] == 1:
        return build_matrix((0.0, -phi[..., 0]), (phi[..., 0], 0.0))
    return skew(phi)


def accumulate_poses(steps: Array) -> Array:
    """Compose n relative motions to n + 1 poses. The first pose is the identity.

    Columns of a pose: x, y, heading; or position and quaternion.

    Parameters
    ----------
    steps : ndarray, shape (n, 3) or (n, 7)
    """
    # Prefix products by doubling: row i contains the product of the last composed_count motions up
    # to motion i. Multiply it by row i - composed_count, which contains the motions before these.
    # compose returns a new array, so all rows of a round use the rows of the previous round
    poses = np.vstack([identity(steps.shape[-1]), steps])
    composed_count = 1
    while composed_count < len(poses):
        poses[composed_count:] = compose(poses[:-composed_count], poses[composed_count:])
        composed_count *= 2
    return poses


def _get_dimension(values: Array) -> int:
    return 2 if values.shape[-1] == 3 else 3


def _rotation_of(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[..., 3:])


def _multiply_matrix_by_vector(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


def _left_jacobian_inverse(phi: Array) -> Array:
    """Return the inverse left Jacobians of SO(2) or SO(3) (Barfoot 2017, 7.37)."""
    skew_matrix = _make_skew_matrix(phi)
    return (
        np.eye(skew_matrix.shape[-1])
        - 0.5 * skew_matrix
        + _compute_square_term_factor(np.linalg.norm(phi, axis=-1)[..., None, None])
        * (skew_matrix @ skew_matrix)
    )


def _compute_square_term_factor(theta: Array) -> Array:
    """Return the factor of the square term [phi]×² in the inverse left Jacobian of SO(3).

    The factor is f(theta) = (1 - theta/2 cot(theta/2)) / theta^2, with the angle theta = |phi|.
    """
    t = np.where(theta < SMALL_ANGLE_RAD, 1.0, theta)
    closed_form_value = (1.0 - 0.5 * t / np.tan(0.5 * t)) / t**2
    return np.where(
        theta < SMALL_ANGLE_RAD,
        polyval(theta * theta, _SQUARE_TERM_FACTOR_COEFFICIENTS),
        closed_form_value,
    )


def _compute_square_term_derivative_over_theta(theta: Array) -> Array:
    """Return f'(theta) / theta for the function f of :func:`_compute_square_term_factor`.

    f(theta) = (1 - theta/2 cot(theta/2)) / theta^2, with the rotation angle theta (rad). The
    inverse right Jacobian of SE(2) and SE(3) contains f'(theta) / theta.
    """
    t = np.where(theta < SMALL_ANGLE_RAD, 1.0, theta)
    half_cot_derivative = 0.5 / np.tan(0.5 * t) - 0.25 * t / np.sin(0.5 * t) ** 2
    closed_form_value = -(half_cot_derivative + 2.0 * (1.0 - 0.5 * t / np.tan(0.5 * t)) / t) / t**3
    return np.where(
        theta < SMALL_ANGLE_RAD,
        polyval(theta * theta, _SQUARE_TERM_DERIVATIVE_COEFFICIENTS),
        closed_form_value,
    )
