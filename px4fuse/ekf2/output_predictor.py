"""Output predictor of EKF2, which computes the published state from the delayed state.

The output predictor propagates the delayed state to the present with the IMU. In each prediction
step, it compares its buffered output with the state at the fusion horizon, and corrects velocity
and position by gain · error + 0.1 · gain² · Σ error, with gain = step / τ. This linear recursion is
computed as a recursive (IIR) filter.

Source: PX4-Autopilot ``EKF/output_predictor/output_predictor.cpp`` (``EKF/ekf.cpp`` before v1.14).
"""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array, iterate_row_blocks
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    POSITION,
    VELOCITY,
    ReplaySegment,
)
from px4fuse.trajectory.rotation import rotate

# Velocity and position: correction = gain · error + INTEGRAL_GAIN · gain² · Σ error
# (output_predictor.cpp)
INTEGRAL_GAIN = 0.1
# Attitude: correction = ATTITUDE_GAIN · error · step / delay of the fusion horizon
# (output_predictor.cpp)
ATTITUDE_CORRECTION_GAIN = 0.5


def compute_published_state(
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
    mean_step_s = float(np.mean(segment.step_s))
    # EKF2 corrects the newest IMU samples with the bias at the fusion horizon. To save memory, one
    # array contains specific force, then velocity increments, then position increments
    imu_increments = segment.force_m_s2 - delay_by(state[:, ACCELEROMETER_BIAS], lag_steps)[1:]
    imu_increments = rotate(segment.body_to_ned[1:], imu_increments)
    imu_increments += np.cross(attitude_difference_rad[1:], imu_increments)
    imu_increments += GRAVITY_M_S2
    imu_increments *= step_s
    velocity_m_s = _predict_output(
        state[:, VELOCITY], imu_increments, lag_steps, mean_step_s, settings["EKF2_TAU_VEL"]
    )
    # mean velocity of a step = velocity before + half of the IMU increment, because corrections are
    # added at the end of the step
    imu_increments *= 0.5
    imu_increments += velocity_m_s[:-1]
    imu_increments *= step_s
    # Resets are removed from the state: EKF2 also shifts all buffered outputs by a reset, so the
    # output predictor does not have to correct it
    position_without_resets = state[:, POSITION] - reset_m
    position_m = _predict_output(
        position_without_resets, imu_increments, lag_steps, mean_step_s, settings["EKF2_TAU_POS"]
    )
    position_m += delay_by(reset_m, lag_steps)
    return velocity_m_s, position_m


def _predict_output(
    state: Array, output_increments: Array, lag_steps: int, step_s: float, tau_s: float
) -> Array:
    """Return the sum of increments from the IMU, corrected with the delayed ``state`` as in EKF2.

    o: state minus sum of increments; c: sum of corrections, each of which shifts all buffered
    outputs; g: gain. In step k, the error at the fusion horizon, ``lag_steps`` ago, is
    e_k = o_(k-lag) - c_k, and c_(k+1) = c_k + g e_k + 0.1 g² Σ e.
    """
    dead_reckoned_state = np.concatenate([state[:1], output_increments])
    np.cumsum(dead_reckoned_state, axis=0, out=dead_reckoned_state)
    offset = state - dead_reckoned_state
    offset -= (start_offset := offset[0].copy())
    gain = step_s / np.clip(tau_s, step_s, 10.0)
    integral_gain = INTEGRAL_GAIN * gain**2
    correction_sum = _apply_recursive_filter(
        np.array([gain + integral_gain, -gain]),
        np.array([1.0, gain + integral_gain - 2.0, 1.0 - gain]),
        delay_by(offset, lag_steps),
    )
    correction_sum += start_offset
    dead_reckoned_state += correction_sum
    return dead_reckoned_state


def delay_by(values: Array, lag_steps: int) -> Array:
    """Delay a series by ``lag_steps``; its first value is repeated."""
    return np.concatenate([np.repeat(values[:1], lag_steps, axis=0), values])[: len(values)]


def sum_attitude_corrections(
    error_rad: Array, lag_steps: int, step_s: float, horizon_s: float
) -> Array:
    """Return the sum of the output predictor's attitude corrections (rad) after each step.

    ``error_rad`` (rotation vectors, shape (n + 1, 3)) is the attitude error at the fusion horizon,
    ``lag_steps`` before the output. Each step corrects the fraction 0.5 · step_s / horizon_s of it.
    """
    gain = ATTITUDE_CORRECTION_GAIN * step_s / max(horizon_s, step_s)
    numerator, denominator = np.zeros((2, lag_steps + 2))
    numerator[-1] = gain
    denominator[:2] = (1.0, -1.0)
    denominator[-1] += gain
    return _apply_recursive_filter(numerator, denominator, error_rad)


def _apply_recursive_filter(numerator: Array, denominator: Array, values: Array) -> Array:
    """Apply a recursive (IIR) filter by solving banded triangular systems (LAPACK dtbtrs)."""
    value_count = len(values)
    filtered_values = np.zeros(values.shape)
    for delay in np.flatnonzero(numerator[:value_count]).tolist():
        filtered_values[delay:] += numerator[delay] * values[: value_count - delay]
    for rows in iterate_row_blocks(value_count):
        block = filtered_values[rows]
        if rows.start:
            for delay in (1 + np.flatnonzero(denominator[1:])).tolist():
                past_output = filtered_values[rows.start - delay : rows.start][: len(block)]
                block[:delay] -= denominator[delay] * past_output
        bands = np.tile(denominator, (len(block), 1)).T
        block[:] = lapack.dtbtrs(bands, block, uplo="L")[0]
    return filtered_values
