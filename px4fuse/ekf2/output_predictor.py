"""From the fusion horizon to what EKF2 publishes: its output predictor.

The filter's state is as old as its horizon. The output predictor carries it to the present with the
IMU and pulls towards it: each step the buffered output of the horizon's time is compared with the
state, and velocity and position of the whole buffer are corrected by gain · error + 0.1 · gain² ·
Σ error, gain = step / τ. All of it is linear and the same at every step, so it runs as recursive
filters over the whole stretch.

Source: PX4-Autopilot ``EKF/output_predictor/output_predictor.cpp`` (``EKF/ekf.cpp`` before v1.14).
"""

import numpy as np
from scipy.linalg import lapack

from px4fuse.arrays import Array

INTEGRAL_SHARE = 0.1
ATTITUDE_SHARE = 0.5


def publish(
    *,
    gain_m_s: Array,
    step_s: Array,
    velocity_m_s: Array,
    position_m: Array,
    reset_m: Array,
    lag: int,
    tau_velocity_s: float,
    tau_position_s: float,
) -> tuple[Array, Array]:
    """Published velocity and position at each step's end.

    Parameters
    ----------
    gain_m_s : ndarray, shape (n, k)
        Velocity gained in each step by the newest IMU samples, gravity removed.
    step_s : ndarray, shape (n,)
    velocity_m_s, position_m : ndarray, shape (n + 1, k)
        The filter's state, by the time that it is of.
    reset_m : ndarray, shape (n + 1, k)
        Sum of the position's resets up to each state.
    lag : int
        Steps between the horizon and the present.
    tau_velocity_s, tau_position_s : float
        EKF2_TAU_VEL and EKF2_TAU_POS.

    Returns
    -------
    velocity_m_s, position_m : ndarray, shape (n + 1, k)
        Before the first comparison, at step ``lag``, dead reckoning from the first state.
    """
    mean_step = float(np.mean(step_s))
    free = np.cumsum(np.concatenate([velocity_m_s[:1], gain_m_s]), axis=0)
    velocity = free + _followed(velocity_m_s - free, lag, mean_step, tau_velocity_s)
    # within a step the velocity grows by what the IMU gives; corrections come at its end
    moved = (velocity[:-1] + 0.5 * gain_m_s) * step_s[:, None]
    steady = position_m - reset_m  # the buffer is moved along with a reset
    free = np.cumsum(np.concatenate([steady[:1], moved]), axis=0)
    position = free + _followed(steady - free, lag, mean_step, tau_position_s)
    return velocity, position + later(reset_m, lag)


def _followed(offset: Array, lag: int, step_s: float, tau_s: float) -> Array:
    """Sum of the corrections up to each step that make the output follow the state.

    With e_k = offset_(k-lag) - c_k: c_(k+1) = c_k + g e_k + 0.1 g² Σ e.
    """
    g = step_s / np.clip(tau_s, step_s, 10.0)
    h = INTEGRAL_SHARE * g**2
    late = later(offset - offset[0], lag)
    corrected = _recursive(np.array([g + h, -g]), np.array([1.0, g + h - 2.0, 1.0 - g]), late)
    return np.asarray(corrected + offset[0])


def later(values: Array, lag: int) -> Array:
    """The same values ``lag`` steps later, the first one before them."""
    return np.concatenate([np.repeat(values[:1], lag, axis=0), values])[: len(values)]


def follow_attitude(error_rad: Array, lag: int, step_s: float, horizon_s: float) -> Array:
    """How the published attitude follows a difference of the filter's attitude.

    Each step the newest attitude is turned by 0.5 · step / horizon of the error at the horizon.

    Parameters
    ----------
    error_rad : ndarray, shape (n + 1, 3)
        Rotation vectors, by the time that they are of.
    lag : int
    step_s, horizon_s : float
    """
    share = ATTITUDE_SHARE * step_s / max(horizon_s, step_s)
    numerator, denominator = np.zeros((2, lag + 2))
    numerator[-1], denominator[:2] = share, (1.0, -1.0)
    denominator[-1] += share
    return _recursive(numerator, denominator, error_rad)


def _recursive(numerator: Array, denominator: Array, values: Array) -> Array:
    """Values through a recursive filter: a triangular system whose bands are the denominator."""
    count = len(values)
    driven = np.zeros((values.shape[1], count))
    for late in np.flatnonzero(numerator[:count]).tolist():
        driven[:, late:] += numerator[late] * values[: count - late].T
    bands = np.broadcast_to(denominator, (count, len(denominator))).T
    filtered, _ = lapack.dtbtrs(bands, driven.T, uplo="L", overwrite_b=1)
    return np.asarray(filtered)
