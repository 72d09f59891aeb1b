"""Formulas of KF along one axis.

State x = [position, velocity]. Input a: mean acceleration of a step. dt: length of the step, at
most DT. SIGMA_A: standard deviation of the mean acceleration over the prediction interval DT::

    F = [[1, dt], [0, 1]]    B = [dt²/2, dt]    H = [1, 0]    R = SIGMA_Z²
    Q(dt) = SIGMA_A² · DT · [[dt³/4, dt²/2], [dt²/2, dt]]

With dt = DT, Q equals that of the course UAT 366, module 2. The velocity variance increases by
SIGMA_A² · DT per second, independent of the length of the steps.

The functions accept floats and arrays. A covariance is a tuple of its elements 00, 01, 11.
"""

from typing import TypeVar

from px4fuse.core.arrays import Array
from px4fuse.trajectory.rotation import build_matrix

STATE_COLUMNS = ["position_m", "velocity_m_s"]
COVARIANCE_COLUMNS = ["position_variance_m2", "covariance_m2_s", "velocity_variance_m2_s2"]
# Initial standard deviations in the course UAT 366, module 2: P₀ = diag(0.5², 1.0²)
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


def compute_unit_density_process_noise(dt_s: T) -> SymmetricElements[T]:
    """Return Q / (SIGMA_A² · DT) of one prediction step of length ``dt_s``: elements 00, 01, 11."""
    return dt_s**3 / 4.0, dt_s**2 / 2.0, dt_s


def compute_continuous_unit_density_process_noise(dt_s: T) -> SymmetricElements[T]:
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


def predict_step(
    position: T,
    velocity: T,
    covariance: SymmetricElements[T],
    acceleration: T,
    noise_density: T,
    dt_s: T,
) -> tuple[T, T, SymmetricElements[T]]:
    """Return the predicted position, velocity and covariance: Fx + Ba and FPFᵀ + Q.

    ``noise_density`` (m²/s³) is (SIGMA_A² + acceleration variance in IMU gaps) · DT.
    """
    p00, p01, p11 = propagate_covariance(covariance, dt_s)
    q00, q01, q11 = compute_unit_density_process_noise(dt_s)
    predicted_covariance = (
        p00 + noise_density * q00,
        p01 + noise_density * q01,
        p11 + noise_density * q11,
    )
    position, velocity = propagate_state(position, velocity, acceleration, dt_s)
    return position, velocity, predicted_covariance


def update_step(
    position: T, velocity: T, covariance: SymmetricElements[T], measured_m: T, variance: T
) -> tuple[tuple[T, T, T, T], tuple[T, T, SymmetricElements[T]]]:
    """Update with a measurement: ν = z - Hx, S = HPHᵀ + R, K = PHᵀS⁻¹, x = x + Kν, P = (I - KH)P.

    Return (ν in m, S in m², position gain, velocity gain), and the updated state and covariance.
    """
    p00, p01, p11 = covariance
    nu = measured_m - position
    s = p00 + variance
    k0 = p00 / s
    k1 = p01 / s
    updated_covariance = variance * k0, variance * k1, p11 - k1 * p01
    return (nu, s, k0, k1), (position + k0 * nu, velocity + k1 * nu, updated_covariance)
