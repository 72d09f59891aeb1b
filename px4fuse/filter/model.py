"""Formulas of KF along one axis.

State x = [position, velocity]; input a, the mean acceleration of the step::

    F = [[1, dt], [0, 1]]    B = [dt²/2, dt]    H = [1, 0]    R = SIGMA_Z²
    Q(dt) = SIGMA_A² · DT · [[dt³/4, dt²/2], [dt²/2, dt]]

With dt = DT, Q equals that of the lesson UAT 366, module 2. The velocity noise per second does not
depend on dt.

The functions accept floats and arrays. A covariance is a tuple of its elements 00, 01, 11.
"""

from typing import TypeVar

from px4fuse.core.arrays import Array
from px4fuse.trajectory.rotation import build_matrix

STATE_COLUMNS = ["position_m", "velocity_m_s"]
COVARIANCE_COLUMNS = ["position_variance_m2", "covariance_m2_s", "velocity_variance_m2_s2"]
# Initial standard deviations in the lesson UAT 366, module 2: P₀ = diag(0.5², 1.0²)
INITIAL_POSITION_SIGMA_M = 0.5
INITIAL_VELOCITY_SIGMA_M_S = 1.0
INITIAL_COVARIANCE = (INITIAL_POSITION_SIGMA_M**2, 0.0, INITIAL_VELOCITY_SIGMA_M_S**2)

T = TypeVar("T", float, Array)
# Elements 00, 01, 11 of a symmetric 2 × 2 matrix
SymmetricElements = tuple[T, T, T]


def make_symmetric_matrix(covariance: SymmetricElements[float] | SymmetricElements[Array]) -> Array:
    """Return a symmetric 2 × 2 matrix from its elements 00, 01, 11."""
    p00, p01, p11 = covariance
    return build_matrix((p00, p01), (p01, p11))


def make_transition_matrix(dt_s: float | Array) -> Array:
    """Return KF's transition matrix F, shape (2, 2)."""
    return build_matrix((1.0, dt_s), (0.0, 1.0))


def compute_process_noise_per_density(dt_s: T) -> SymmetricElements[T]:
    """Return Q / (SIGMA_A² · DT) of one prediction step of length ``dt_s``: elements 00, 01, 11."""
    return dt_s**3 / 4.0, dt_s**2 / 2.0, dt_s


def compute_continuous_process_noise_per_density(dt_s: T) -> SymmetricElements[T]:
    """Return Q / (SIGMA_A² · DT) of continuous white acceleration noise: elements 00, 01, 11."""
    return dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s


def propagate_state(position: T, velocity: T, acceleration: T, dt_s: T) -> tuple[T, T]:
    """Return position (m) and velocity (m/s) after ``dt_s`` of constant acceleration: Fx + Ba."""
    new_position = position + velocity * dt_s + acceleration * dt_s**2 / 2.0
    return new_position, velocity + acceleration * dt_s


def propagate_covariance(covariance: SymmetricElements[T], dt_s: T) -> SymmetricElements[T]:
    """Return FPFᵀ, the predicted covariance without process noise: elements 00, 01, 11."""
    p00, p01, p11 = covariance
    return p00 + 2.0 * dt_s * p01 + dt_s**2 * p11, p01 + dt_s * p11, p11


def update_step(
    position: Array,
    velocity: Array,
    covariance: SymmetricElements[float],
    measured_m: Array,
    variance: float,
) -> tuple[tuple[Array, float], tuple[Array, Array, SymmetricElements[float]]]:
    """Update with a measurement: ν = z - Hx, S = HPHᵀ + R, K = PHᵀS⁻¹, x = x + Kν, P = (I - KH)P.

    Return ν (m) and S (m²), then the updated position, velocity and covariance.
    """
    p00, p01, p11 = covariance
    nu = measured_m - position
    s = p00 + variance
    k0, k1 = p00 / s, p01 / s
    updated_covariance = variance * k0, variance * k1, p11 - k1 * p01
    return (nu, s), (position + k0 * nu, velocity + k1 * nu, updated_covariance)
