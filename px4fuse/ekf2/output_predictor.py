"""Output predictor of EKF2, which computes the published state from the delayed state.

EKF2's state belongs to the fusion horizon, which is in the past. The output predictor propagates
this state to the present with the IMU. Each prediction step corrects velocity and position by
gain · error + 0.1 · gain² · Σ error, with gain = step / τ and the error at the fusion horizon.

Source: PX4-Autopilot ``EKF/output_predictor/output_predictor.cpp`` (``EKF/ekf.cpp`` before v1.14).
"""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array, ArrayPair
from px4fuse.trajectory.rotation import rotate

from .replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    POSITION,
    VELOCITY,
    ReplaySegment,
)

# Gain of the integral correction of velocity and position (output_predictor.cpp)
OUTPUT_INTEGRAL_GAIN = 0.1
# Maximum time constant (s) of the corrections of velocity and position (output_predictor.cpp)
MAX_OUTPUT_TIME_CONSTANT_S = 10.0
# Gain of the attitude correction (output_predictor.cpp)
ATTITUDE_CORRECTION_GAIN = 0.5


def compute_published_state(
    segment: ReplaySegment,
    state: Array,
    reset_m: Array,
    published_minus_nominal_attitude_rad: Array,
    lag_steps: int,
    settings: Mapping[str, float],
) -> ArrayPair:
    """Return the published velocity (m/s) and position (m) after each of n prediction steps.

    Parameters
    ----------
    segment : ReplaySegment
    state : ndarray, shape (n + 1, 15) or more
        State at the fusion horizon.
    reset_m : ndarray, shape (n + 1, 3)
        Sum of the position resets so far.
    published_minus_nominal_attitude_rad : ndarray, shape (n + 1, 3)
        Small rotation from the nominal attitude (published by EKF2 in the log) to the attitude that
        the output predictor of the replay publishes.
    lag_steps : int
        Number of prediction steps from the fusion horizon to the present.
    settings : mapping
        EKF2 parameters by PX4 name.
    """
    step_s = segment.step_s[:, None]
    mean_step_s = float(np.mean(segment.step_s))
    # EKF2 corrects the newest IMU samples with the accelerometer bias at the fusion horizon
    acceleration_m_s2 = rotate(
        segment.body_to_ned[1:],
        segment.specific_force_m_s2 - delay_by(state[:, ACCELEROMETER_BIAS], lag_steps)[1:],
    )
    acceleration_m_s2 += np.cross(published_minus_nominal_attitude_rad[1:], acceleration_m_s2)
    acceleration_m_s2 += GRAVITY_M_S2
    velocity_increments_m_s = acceleration_m_s2 * step_s
    velocity_m_s = _predict_output(
        state[:, VELOCITY],
        velocity_increments_m_s,
        lag_steps,
        mean_step_s,
        settings["EKF2_TAU_VEL"],
    )
    # Mean velocity of a step = velocity before the step + half of the velocity increment
    position_increments_m = (0.5 * velocity_increments_m_s + velocity_m_s[:-1]) * step_s
    # EKF2 shifts all outputs by a position reset, so resets bypass the output predictor
    position_m = _predict_output(
        state[:, POSITION] - reset_m,
        position_increments_m,
        lag_steps,
        mean_step_s,
        settings["EKF2_TAU_POS"],
    )
    position_m += delay_by(reset_m, lag_steps)
    return velocity_m_s, position_m


def _predict_output(
    state: Array, imu_increments: Array, lag_steps: int, step_s: float, tau_s: float
) -> Array:
    """Return the output predictor's velocity or position: sum of IMU increments and corrections.

    Each correction is added to the whole output buffer, so the error at the fusion horizon in step
    k is e_k = u_k - c_(k-1). Here u is the state minus the integrated IMU increments at the fusion
    horizon, and c is the sum of the corrections: c_k = c_(k-1) + g e_k + i Σ e with the gain g and
    the integral gain i. Without the sum (difference of two steps), this is the recursive filter

        c_k + (g + i - 2) c_(k-1) + (1 - g) c_(k-2) = (g + i) u_k - g u_(k-1)
    """
    integrated_state = np.cumsum(np.concatenate([state[:1], imu_increments]), axis=0)
    gain = step_s / np.clip(tau_s, step_s, MAX_OUTPUT_TIME_CONSTANT_S)
    integral_gain = OUTPUT_INTEGRAL_GAIN * gain**2
    return integrated_state + _apply_recursive_filter(
        np.array([gain + integral_gain, -gain]),
        np.array([1.0, gain + integral_gain - 2.0, 1.0 - gain]),
        delay_by(state - integrated_state, lag_steps),
    )


def delay_by(values: Array, lag_steps: int) -> Array:
    """Delay a series by ``lag_steps``; its first value is repeated."""
    return np.concatenate([np.repeat(values[:1], lag_steps, axis=0), values])[: len(values)]


def sum_attitude_corrections(
    error_rad: Array, lag_steps: int, step_s: float, horizon_s: float
) -> Array:
    """Return the sum of the output predictor's attitude corrections (rad) after each step.

    ``error_rad``, shape (n + 1, 3), is the attitude error at the fusion horizon without
    corrections. ``lag_steps`` is the number of prediction steps L from the fusion horizon to the
    present.

    Each step adds a correction of g · (error at the fusion horizon - sum of the corrections at the
    fusion horizon). With the sum c and the gain g:

        c_k - c_(k-1) + g c_(k-L-1) = g error_(k-L-1)
    """
    gain = ATTITUDE_CORRECTION_GAIN * step_s / max(horizon_s, step_s)
    # Element i is the coefficient of the value i steps ago
    numerator, denominator = np.zeros((2, lag_steps + 2))
    numerator[-1] = gain
    denominator[:2] = (1.0, -1.0)
    denominator[-1] += gain
    return _apply_recursive_filter(numerator, denominator, error_rad)


def _apply_recursive_filter(numerator: Array, denominator: Array, values: Array) -> Array:
    """Apply a recursive (IIR) filter by solving a banded triangular system (LAPACK dtbtrs)."""
    value_count = len(values)
    weighted_sums = np.zeros(values.shape)
    for delay in np.flatnonzero(numerator[:value_count]).tolist():
        weighted_sums[delay:] += numerator[delay] * values[: value_count - delay]
    bands = np.tile(denominator, (value_count, 1)).T
    return np.asarray(lapack.dtbtrs(bands, weighted_sums, uplo="L")[0])
