"""Output predictor of EKF2, which computes the published state from the fusion horizon.

The output predictor propagates the delayed state to the present with the IMU. In each prediction
step, it compares its buffered output with the state at the fusion horizon, and corrects velocity
and position by gain · error + 0.1 · gain² · Σ error, with gain = step / τ. This linear recursion is
computed as a recursive (IIR) filter.

Source: PX4-Autopilot ``EKF/output_predictor/output_predictor.cpp`` (``EKF/ekf.cpp`` before v1.14).
"""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    POSITION,
    VELOCITY,
    ReplaySegment,
)
from px4fuse.trajectory.rotation import rotate

# Gain of the integrated error in the corrections of velocity and position (output_predictor.cpp)
INTEGRAL_GAIN = 0.1
# Gain of the attitude correction, times step / delay of the fusion horizon (output_predictor.cpp)
ATTITUDE_GAIN = 0.5


def publish(
    segment: ReplaySegment,
    state: Array,
    reset_m: Array,
    attitude_difference_rad: Array,
    lag_steps: int,
    settings: Mapping[str, float],
) -> tuple[Array, Array]:
    """Return the published velocity (m/s) and position (m) after each of n prediction steps.

    Parameters
    ----------
    segment : ReplaySegment
    state : ndarray, shape (n + 1, 15) or more
        State at the fusion horizon.
    reset_m : ndarray, shape (n + 1, 3)
        Sum of all position resets before each state.
    attitude_difference_rad : ndarray, shape (n + 1, 3)
        Published minus nominal attitude.
    lag_steps : int
        Number of steps between fusion horizon and present.
    settings : mapping
        EKF2 parameters by PX4 name.
    """
    step_s = segment.step_s[:, None]
    mean_step = float(np.mean(segment.step_s))
    # EKF2 corrects the newest IMU samples with the bias at the fusion horizon
    force_m_s2 = segment.force_m_s2 - delay_by(state[:, ACCELEROMETER_BIAS], lag_steps)[1:]
    force_m_s2 = rotate(segment.body_to_ned[1:], force_m_s2)
    velocity_increments = (
        force_m_s2 + np.cross(attitude_difference_rad[1:], force_m_s2) + GRAVITY_M_S2
    ) * step_s
    velocity_m_s = _follow_state(
        state[:, VELOCITY], velocity_increments, lag_steps, mean_step, settings["EKF2_TAU_VEL"]
    )
    # The IMU changes the velocity during a step. Corrections are made at the end of the step
    position_increments = (velocity_m_s[:-1] + 0.5 * velocity_increments) * step_s
    # Resets are subtracted, because EKF2 shifts its whole buffer at a reset
    position_without_resets = state[:, POSITION] - reset_m
    position_m = _follow_state(
        position_without_resets, position_increments, lag_steps, mean_step, settings["EKF2_TAU_POS"]
    )
    return velocity_m_s, position_m + delay_by(reset_m, lag_steps)


def _follow_state(
    state: Array, increments: Array, lag_steps: int, step_s: float, tau_s: float
) -> Array:
    """Return the output of the predictor: sum of IMU ``increments`` and of corrections.

    In step k, the error at the fusion horizon is e_k = o_(k-lag) - c_k. Here o is the state minus
    the sum of increments, and c is the sum of corrections: a correction shifts the whole buffer.
    With gain g, c_(k+1) = c_k + g e_k + 0.1 g² Σ e.
    """
    dead_reckoned = np.cumsum(np.concatenate([state[:1], increments]), axis=0)
    offset = state - dead_reckoned
    gain = step_s / np.clip(tau_s, step_s, 10.0)
    integral_gain = INTEGRAL_GAIN * gain**2
    delayed_offset = delay_by(offset - offset[0], lag_steps)
    correction_sum = _recursive_filter(
        np.array([gain + integral_gain, -gain]),
        np.array([1.0, gain + integral_gain - 2.0, 1.0 - gain]),
        delayed_offset,
    )
    return np.asarray(dead_reckoned + (correction_sum + offset[0]))


def delay_by(values: Array, lag_steps: int) -> Array:
    """Delay a series by ``lag_steps``; its first value is repeated."""
    return np.concatenate([np.repeat(values[:1], lag_steps, axis=0), values])[: len(values)]


def follow_attitude(error_rad: Array, lag_steps: int, step_s: float, horizon_s: float) -> Array:
    """Return the sum of the attitude corrections of the output predictor.

    Each step corrects the attitude by 0.5 · step / horizon of ``error_rad``, the attitude error at
    the fusion horizon (rotation vectors, shape (n + 1, 3)).
    """
    gain = ATTITUDE_GAIN * step_s / max(horizon_s, step_s)
    numerator, denominator = np.zeros((2, lag_steps + 2))
    numerator[-1] = gain
    denominator[:2] = (1.0, -1.0)
    denominator[-1] += gain
    return _recursive_filter(numerator, denominator, error_rad)


def _recursive_filter(numerator: Array, denominator: Array, values: Array) -> Array:
    """Apply a recursive (IIR) filter by solving a banded triangular system (LAPACK dtbtrs)."""
    value_count = len(values)
    weighted_inputs = np.zeros((values.shape[1], value_count))
    for delay in np.flatnonzero(numerator[:value_count]).tolist():
        weighted_inputs[:, delay:] += numerator[delay] * values[: value_count - delay].T
    bands = np.broadcast_to(denominator, (value_count, len(denominator))).T
    filtered, _ = lapack.dtbtrs(bands, weighted_inputs.T, uplo="L", overwrite_b=1)
    return np.asarray(filtered)
