"""KF with one prediction per measurement, and the likelihood on a grid.

The acceleration is first integrated between measurements, which is faster. If all σ are at least
1e-3, the innovations equal those of :mod:`px4fuse.filter.kalman` to 1e-9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.filter.model import (
    INITIAL_COVARIANCE,
    compute_process_noise_per_density,
    propagate_covariance,
    propagate_state,
    update_step,
)
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import PredictionSteps, make_prediction_steps

# Log-likelihood decrease (nats) at the ends of a 95 % interval: half the 95 % point of χ²(1)
MAX_LOG_LIKELIHOOD_DROP = float(chdtri(1, 0.05)) / 2.0


@dataclass(frozen=True)
class PreintegratedMotion:
    """Positions for KF, and IMU acceleration integrated over the intervals between them.

    Arrays have one row for each position.

    Attributes
    ----------
    interval_s : ndarray
        Time since the previous position (first: since the initial state).
    delta_position_m, delta_velocity_m_s : ndarray
        Δp and Δv in each interval due to the acceleration.
    process_noise_per_sigma_a_squared, process_noise_independent_of_sigma_a : ndarray, shape (m, 3)
        Q / SIGMA_A² of each interval, and additional Q in IMU gaps: elements 00, 01, 11.
    """

    interval_s: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    process_noise_per_sigma_a_squared: Array
    process_noise_independent_of_sigma_a: Array
    measurement_m: Array
    initial_state: InitialState


def preintegrate(axis: Axis, settings: Settings) -> PreintegratedMotion:
    """Integrate the acceleration and process noise of KF between measurements.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    prediction_steps = make_prediction_steps(axis, settings)
    last_steps, interval_index, time_from_step_to_interval_end_s = _assign_steps_to_intervals(
        prediction_steps
    )
    step_times_s = prediction_steps.time_s
    process_noise_per_sigma_a_squared = settings.dt_s * np.stack(
        propagate_covariance(
            compute_process_noise_per_density(np.diff(step_times_s)),
            time_from_step_to_interval_end_s,
        ),
        1,
    )
    dp, dv = integrate_acceleration(prediction_steps, prediction_steps.acceleration_m_s2)

    def sum_by_interval(values: Array) -> Array:
        return np.stack([np.bincount(interval_index, column) for column in values.T], 1)

    return PreintegratedMotion(
        interval_s=np.diff(step_times_s[np.append(0, last_steps)]),
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        process_noise_per_sigma_a_squared=sum_by_interval(process_noise_per_sigma_a_squared),
        process_noise_independent_of_sigma_a=sum_by_interval(
            process_noise_per_sigma_a_squared * prediction_steps.input_variance_m2_s4[:, None]
        ),
        measurement_m=axis.measurement_m[prediction_steps.measurement_index[last_steps]],
        initial_state=InitialState(float(step_times_s[0]), float(axis.measurement_m[0])),
    )


def integrate_acceleration(
    prediction_steps: PredictionSteps, acceleration_m_s2: Array
) -> ArrayPair:
    """Integrate an acceleration over the intervals between measurements: Δp (m) and Δv (m/s).

    ``acceleration_m_s2`` contains the acceleration in each prediction step.
    """
    _, interval_index, time_from_step_to_interval_end_s = _assign_steps_to_intervals(
        prediction_steps
    )
    zeros = np.zeros(len(time_from_step_to_interval_end_s))
    dp, dv = propagate_state(
        *propagate_state(zeros, zeros, acceleration_m_s2, np.diff(prediction_steps.time_s)),
        zeros,
        time_from_step_to_interval_end_s,
    )
    dp, dv = (np.bincount(interval_index, increment).astype(float) for increment in (dp, dv))
    return dp, dv


def _assign_steps_to_intervals(
    prediction_steps: PredictionSteps,
) -> tuple[IntArray, IntArray, Array]:
    """Assign each prediction step to an interval between measurements.

    Returns
    -------
    last_steps : ndarray
        Index of the last step of each interval.
    interval_index : ndarray
        Index of the interval that contains each step.
    time_from_step_to_interval_end_s : ndarray
        Time from the end of each step to the end of its interval.
    """
    last_steps = np.flatnonzero(prediction_steps.measurement_index >= 0)
    interval_index = np.searchsorted(last_steps, np.arange(1, len(prediction_steps.time_s)))
    time_from_step_to_interval_end_s = (
        prediction_steps.time_s[last_steps[interval_index]] - prediction_steps.time_s[1:]
    )
    return last_steps, interval_index, time_from_step_to_interval_end_s


def innovations(
    preintegrated_motion: PreintegratedMotion,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    is_skipped: BoolArray | None = None,
) -> ArrayPair:
    """Run KF; return the innovation ν (m) and its variance S (m²) of each measurement.

    With k columns of measurements and increments, KF filters them at once: ν has the shape (m, k).

    Parameters
    ----------
    is_skipped : ndarray of bool, shape (m,), optional
        True for measurements that KF does not fuse. Their innovation is also returned.
    """
    initial_state = preintegrated_motion.initial_state
    position = np.asarray(initial_state.position_m)
    velocity = np.asarray(initial_state.velocity_m_s)
    covariance = INITIAL_COVARIANCE
    process_noise = (
        sigma_a_m_s2**2 * preintegrated_motion.process_noise_per_sigma_a_squared
        + preintegrated_motion.process_noise_independent_of_sigma_a
    )
    measurement_count = len(preintegrated_motion.interval_s)
    innovation_m = np.empty_like(preintegrated_motion.measurement_m)
    innovation_variance_m2 = np.empty(measurement_count)
    for row, (dt_s, (q00, q01, q11), measured_m, dp, dv, skips_update) in enumerate(
        zip(
            preintegrated_motion.interval_s.tolist(),
            process_noise.tolist(),
            preintegrated_motion.measurement_m,
            preintegrated_motion.delta_position_m,
            preintegrated_motion.delta_velocity_m_s,
            [False] * measurement_count if is_skipped is None else is_skipped.tolist(),
            strict=True,
        )
    ):
        position, velocity = position + dt_s * velocity + dp, velocity + dv
        p00, p01, p11 = propagate_covariance(covariance, dt_s)
        covariance = p00 + q00, p01 + q01, p11 + q11  # P = FPFᵀ + Q
        (innovation_m[row], innovation_variance_m2[row]), updated_state = update_step(
            position, velocity, covariance, measured_m, sigma_z_m**2
        )
        if not skips_update:
            position, velocity, covariance = updated_state
    return innovation_m, innovation_variance_m2


def fit_parabola_vertex(profile: Array, index: int) -> tuple[float, float]:
    """Fit a parabola to ``profile[index]`` and its two neighbours.

    Return the distance from ``index`` to the minimum of the parabola, and its second difference.
    """
    left_value, middle_value, right_value = profile[index - 1 : index + 2]
    curvature = left_value - 2.0 * middle_value + right_value
    return (0.5 * (left_value - right_value) / curvature if curvature > 0.0 else 0.0), curvature


def compute_profile_likelihood_interval(
    grid: Array, profile: Array, max_log_likelihood_drop: float = MAX_LOG_LIKELIHOOD_DROP
) -> tuple[float, float]:
    """Return the interval of a parameter in which -ln p on a grid is close to its minimum.

    By default this is the 95 % interval. An end outside the grid is replaced by the grid's end.
    """
    score_rises = profile - profile.min()
    first, last = np.flatnonzero(score_rises <= max_log_likelihood_drop)[[0, -1]].tolist()
    neighbours = [first, max(first - 1, 0)], [last, min(last + 1, len(grid) - 1)]
    low, high = (
        float(np.interp(max_log_likelihood_drop, score_rises[indices], grid[indices]))
        for indices in neighbours
    )
    return low, high
