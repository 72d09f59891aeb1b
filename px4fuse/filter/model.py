"""The lesson's filter along one axis, as formulas that the replay and every estimate share.

State x = [position, velocity]; input a, the acceleration averaged over the step::

    F = [[1, dt], [0, 1]]    B = [dt²/2, dt]    H = [1, 0]    R = SIGMA_Z²
    Q(dt) = SIGMA_A² · DT · [[dt³/4, dt²/2], [dt²/2, dt]]

With dt = DT, Q is the lesson's SIGMA_A² · [[dt⁴/4, dt³/2], [dt³/2, dt²]] digit for digit. For other
steps it keeps the velocity noise per second, so that SIGMA_A means the same at every rate.

The functions write out the products, element by element, so that they serve plain floats (one
filter, where arrays of one element would take fifty times as long) and arrays (many at once).
A covariance is its elements 00, 01, 11.
"""

from typing import TypeVar

import numpy as np

from px4fuse.arrays import Array

STATES = ["position_m", "velocity_m_s"]
COVARIANCES = ["position_variance_m2", "covariance_m2_s", "velocity_variance_m2_s2"]
# The lesson's initial standard deviations, P₀ = diag(0.5², 1.0²)
INITIAL_SIGMA_P_M = 0.5
INITIAL_SIGMA_V_M_S = 1.0
INITIAL_COVARIANCE = (INITIAL_SIGMA_P_M**2, 0.0, INITIAL_SIGMA_V_M_S**2)
H = np.array([[1.0, 0.0]])

T = TypeVar("T", float, Array)
Symmetric = tuple[T, T, T]


def symmetric_matrix(covariance: Symmetric[float]) -> Array:
    """Symmetric matrix of its elements 00, 01, 11, shape (2, 2)."""
    p00, p01, p11 = covariance
    return np.array([[p00, p01], [p01, p11]])


def transition(dt_s: float) -> Array:
    """F, shape (2, 2)."""
    return np.array([[1.0, dt_s], [0.0, 1.0]])


def input_matrix(dt_s: float) -> Array:
    """B, shape (2, 1)."""
    return np.array([[dt_s**2 / 2.0], [dt_s]])


def process_noise_unit(dt_s: T) -> Symmetric[T]:
    """Q(dt) over SIGMA_A² · DT, by element: what one step adds."""
    return dt_s**3 / 4.0, dt_s**2 / 2.0, dt_s


def continuous_noise_unit(dt_s: T) -> Symmetric[T]:
    """What many short steps of together ``dt_s`` add, over SIGMA_A² · DT, by element.

    The limit of ΣFQFᵀ: the position's noise of one step, dt³/4, is dt³/3 where the acceleration
    may change within it.
    """
    return dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s


def propagate_state(position: T, velocity: T, acceleration: T, dt_s: T) -> tuple[T, T]:
    """X = Fx + Ba: position (m) and velocity (m/s) after ``dt_s``."""
    new_position = position + velocity * dt_s + acceleration * dt_s**2 / 2.0
    return new_position, velocity + acceleration * dt_s


def propagate_covariance(covariance: Symmetric[T], dt_s: T) -> Symmetric[T]:
    """FPFᵀ, by element: the covariance after ``dt_s``, before Q is added."""
    p00, p01, p11 = covariance
    return p00 + 2.0 * dt_s * p01 + dt_s**2 * p11, p01 + dt_s * p11, p11


def predict_step(
    position: T, velocity: T, covariance: Symmetric[T], acceleration: T, density: T, dt_s: T
) -> tuple[T, T, Symmetric[T]]:
    """X = Fx + Ba, P = FPFᵀ + Q: position, velocity and covariance after ``dt_s``.

    ``density`` (m²/s³) is what Q adds to the velocity's variance per second, SIGMA_A² · DT.
    """
    (p00, p01, p11), (q00, q01, q11) = (
        propagate_covariance(covariance, dt_s),
        process_noise_unit(dt_s),
    )
    after = p00 + density * q00, p01 + density * q01, p11 + density * q11
    position, velocity = propagate_state(position, velocity, acceleration, dt_s)
    return position, velocity, after


def update_step(
    position: T, velocity: T, covariance: Symmetric[T], measured: T, variance: T
) -> tuple[tuple[T, T, T, T], tuple[T, T, Symmetric[T]]]:
    """ν = z - Hx, S = HPHᵀ + R, K = PHᵀS⁻¹; x = x + Kν, P = (I - KH)P.

    Returns
    -------
    tuple
        ν (m), S (m²) and both gains; then position, velocity and covariance after it.
    """
    p00, p01, p11 = covariance
    nu, s = measured - position, p00 + variance
    k0, k1 = p00 / s, p01 / s
    after = variance * k0, variance * k1, p11 - k1 * p01
    return (nu, s, k0, k1), (position + k0 * nu, velocity + k1 * nu, after)
