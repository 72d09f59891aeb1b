"""KF with one prediction per measurement, and 95 % intervals of SIGMA_A and SIGMA_Z.

The intervals are from the likelihood of KF's innovations. The acceleration is first integrated
between measurements, which is faster. If SIGMA_A and SIGMA_Z are at least 1e-3, the innovations
equal those of :mod:`px4fuse.filter.kalman` to 1e-9.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import brentq, minimize_scalar
from scipy.special import chdtri

from px4fuse.core.arrays import Array, ArrayPair, BoolArray

from .model import (
    INITIAL_COVARIANCE,
    SymmetricElements,
    compute_unit_density_process_noise,
    propagate_covariance,
    propagate_state,
    update_step,
)
from .settings import Settings
from .signals import Axis
from .steps import PredictionSteps, make_prediction_steps

# Log-likelihood decrease (nats) at the ends of a 95 % interval: half the 95 % point of χ²(1)
MAX_LOG_LIKELIHOOD_DROP = float(chdtri(1, 0.05)) / 2.0
# Search for an end of the 95 % interval of SIGMA_A or SIGMA_Z: initial step of ln SIGMA_A or ln
# SIGMA_Z
INITIAL_LOG_SIGMA_SEARCH_STEP = 0.05
# For each tested SIGMA_A, the most likely SIGMA_Z is searched, or vice versa. In this search, ln
# SIGMA_Z changes at most by this value from the result for the previous tested SIGMA_A
MAX_PROFILED_LOG_SIGMA_CHANGE = 1.0
# Tolerance of ln σ in the search for the most likely SIGMA_Z for a given SIGMA_A, or vice versa
OTHER_NOISE_LOG_SIGMA_TOLERANCE = 2e-3


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
    measurement_m : ndarray
        Positions relative to the first measurement, which is KF's initial position.
    """

    interval_s: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    process_noise_per_sigma_a_squared: Array
    process_noise_independent_of_sigma_a: Array
    measurement_m: Array


def preintegrate(axis: Axis, settings: Settings) -> PreintegratedMotion:
    """Integrate the acceleration and process noise of KF between measurements.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    prediction_steps = make_prediction_steps(axis, settings)
    last_steps, step_times_s = prediction_steps.last_steps, prediction_steps.time_s
    # Covariance at the end of the interval due to the acceleration noise in one step
    process_noise_per_sigma_a_squared = settings.dt_s * np.stack(
        propagate_covariance(
            compute_unit_density_process_noise(np.diff(step_times_s)),
            prediction_steps.compute_time_to_interval_end_s(),
        ),
        1,
    )
    dp, dv = integrate_acceleration(prediction_steps, prediction_steps.acceleration_m_s2)

    def sum_by_interval(values: Array) -> Array:
        """Sum each column over the prediction steps of each interval between measurements."""
        return np.stack(
            [np.bincount(prediction_steps.interval_index, column) for column in values.T], 1
        )

    return PreintegratedMotion(
        interval_s=np.diff(step_times_s[np.append(0, last_steps)]),
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        process_noise_per_sigma_a_squared=sum_by_interval(process_noise_per_sigma_a_squared),
        process_noise_independent_of_sigma_a=sum_by_interval(
            process_noise_per_sigma_a_squared * prediction_steps.imu_gap_variance_m2_s4[:, None]
        ),
        measurement_m=axis.measurement_m[prediction_steps.measurement_index[last_steps]]
        - axis.measurement_m[0],
    )


def integrate_acceleration(
    prediction_steps: PredictionSteps, acceleration_m_s2: Array
) -> ArrayPair:
    """Integrate an acceleration over the intervals between measurements: Δp (m) and Δv (m/s).

    ``acceleration_m_s2`` contains the acceleration in each prediction step.
    """
    step_s = np.diff(prediction_steps.time_s)
    zeros = np.zeros(len(step_s))
    # A velocity change in a prediction step also changes the position in all later steps, until the
    # interval ends at the next measurement
    dp, dv = propagate_state(zeros, zeros, acceleration_m_s2, step_s)
    dp, dv = propagate_state(dp, dv, zeros, prediction_steps.compute_time_to_interval_end_s())
    dp, dv = (
        np.bincount(prediction_steps.interval_index, increment).astype(float)
        for increment in (dp, dv)
    )
    return dp, dv


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
    gains = compute_gains(preintegrated_motion, sigma_a_m_s2, sigma_z_m, is_skipped)
    return compute_innovations_with_gains(preintegrated_motion, *gains[1:]), gains[0]


def compute_gains(
    preintegrated_motion: PreintegratedMotion,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    is_skipped: BoolArray | None = None,
) -> Array:
    """Return the innovation variance S (m²), position gain and velocity gain of each measurement.

    S and gains do not depend on the measured positions. The shape is (3, m). ``is_skipped`` is True
    for measurements that KF does not fuse: their gains are 0, but S is computed. By default, KF
    fuses all.
    """
    process_noise = (
        sigma_a_m_s2 * sigma_a_m_s2 * preintegrated_motion.process_noise_per_sigma_a_squared
        + preintegrated_motion.process_noise_independent_of_sigma_a
    )
    if is_skipped is None:
        is_skipped = np.zeros(len(process_noise), bool)
    covariance: SymmetricElements[float] = INITIAL_COVARIANCE
    variance_and_gains_by_measurement = []
    for dt, (q00, q01, q11), skips_update in zip(
        preintegrated_motion.interval_s.tolist(),
        process_noise.tolist(),
        is_skipped.tolist(),
        strict=True,
    ):
        p00, p01, p11 = propagate_covariance(covariance, dt)  # P = FPFᵀ + Q
        covariance = p00 + q00, p01 + q01, p11 + q11
        (_, s, position_gain, velocity_gain), (_, _, updated_covariance) = update_step(
            0.0, 0.0, covariance, 0.0, sigma_z_m * sigma_z_m
        )
        if skips_update:
            position_gain = velocity_gain = 0.0
        else:
            covariance = updated_covariance
        variance_and_gains_by_measurement.append((s, position_gain, velocity_gain))
    return np.array(variance_and_gains_by_measurement).T


def compute_innovations_with_gains(
    preintegrated_motion: PreintegratedMotion, position_gain: Array, velocity_gain: Array
) -> Array:
    """Run KF with given position and velocity gains; return the innovation ν (m)."""
    # The predicted states (p, v) solve linear equations, so LAPACK computes all of them at once:
    # p_i - (1 - k0 - dt k1) p_(i-1) - dt v_(i-1) = Δp + (k0 + dt k1) z_(i-1)
    # v_i + k1 p_(i-1) - v_(i-1) = Δv + k1 z_(i-1)
    dt = preintegrated_motion.interval_s[1:]
    predicted_position_gain = position_gain[:-1] + dt * velocity_gain[:-1]
    measured_m = np.ascontiguousarray(preintegrated_motion.measurement_m.T)
    right_hand_side = np.empty((*measured_m.shape, 2))
    right_hand_side[..., 0] = preintegrated_motion.delta_position_m.T
    right_hand_side[..., 1] = preintegrated_motion.delta_velocity_m_s.T
    right_hand_side[..., 1:, 0] += predicted_position_gain * measured_m[..., :-1]
    right_hand_side[..., 1:, 1] += velocity_gain[:-1] * measured_m[..., :-1]
    # LAPACK's band storage contains the coefficients below the diagonal of ones. The unknowns have
    # the order p_0, v_0, p_1, v_1, ...: bands[i, 0] belongs to p_i, bands[i, 1] to v_i. The last
    # index is the distance from the diagonal, in rows
    bands = np.zeros((len(position_gain), 2, 4))
    bands[:-1, 1, 1] = -dt
    bands[:-1, 0, 2] = predicted_position_gain - 1.0
    bands[:-1, 1, 2] = -1.0
    bands[:-1, 0, 3] = velocity_gain[:-1]
    state, _ = lapack.dtbtrs(
        bands.reshape(-1, 4).T,
        right_hand_side.reshape(-1, 2 * len(position_gain)).T,
        uplo="L",
        diag="U",
        overwrite_b=1,
    )
    return np.asarray((measured_m - state[::2].T.reshape(measured_m.shape)).T)


def fit_parabola_vertex(profile: Array, index: int) -> tuple[float, float]:
    """Fit a parabola to ``profile[index]`` and its two neighbours.

    Return the distance from ``index`` to the minimum of the parabola, and its second difference.
    """
    left_value, middle_value, right_value = profile[index - 1 : index + 2]
    curvature = left_value - 2.0 * middle_value + right_value
    return (0.5 * (left_value - right_value) / curvature if curvature > 0.0 else 0.0), curvature


def compute_profile_likelihood_interval(
    grid: Array, profile: Array, max_log_likelihood_drop: float = MAX_LOG_LIKELIHOOD_DROP
) -> tuple[float | None, float | None]:
    """Return the interval of a parameter in which -ln p on a grid is close to its minimum.

    By default this is the 95 % interval. An end outside the grid is None.
    """
    score_rises = profile - profile.min()
    first_index, last_index = np.flatnonzero(score_rises <= max_log_likelihood_drop)[[0, -1]]

    def interpolate_interval_end(inside_index: int, outside_index: int) -> float | None:
        """Interpolate between a grid value inside the interval and its neighbour outside."""
        if not 0 <= outside_index < len(grid):
            return None
        indices = [inside_index, outside_index]
        return float(np.interp(max_log_likelihood_drop, score_rises[indices], grid[indices]))

    return interpolate_interval_end(first_index, first_index - 1), interpolate_interval_end(
        last_index, last_index + 1
    )


def find_profile_likelihood_interval(
    score: Callable[[float, float], float],
    best_log_sigmas: tuple[float, float],
    parameter_bounds: tuple[float, float],
    variance_factor: float = 1.0,
) -> tuple[float | None, float | None]:
    """Return the 95 % profile-likelihood interval of a parameter; None for an unbounded end.

    Parameters
    ----------
    score : callable
        -ln p as a function of the logarithms of this parameter and of a second one.
    best_log_sigmas : (float, float)
        Natural logarithms of both parameters at the minimum.
    parameter_bounds : (float, float)
        Bounds of the first parameter.
    variance_factor : float
        Factor on the variance, for uncertainty that ``score`` omits.
    """
    best_score = score(*best_log_sigmas)
    max_sqrt_log_likelihood_drop = float(np.sqrt(MAX_LOG_LIKELIHOOD_DROP * variance_factor))

    def find_interval_end(direction: float, search_limit: float) -> float | None:
        """Return the lower (direction -1) or upper (1) end of the interval of the first parameter.

        None if the end is beyond ``search_limit``.
        """
        other_log_sigma = best_log_sigmas[1]

        @cache  # brentq computes the ends of its bracket again
        def compute_drop_excess(change: float) -> float:
            """Return √(decrease of the log-likelihood) minus its limit, after a change of ln σ.

            ``change`` is the distance from the best ln σ. The result is zero at the end of the
            interval, and nearly linear, so brentq needs few steps.
            """
            # Profile likelihood: for each change of ln σ of one parameter, search the best value of
            # the other. The search starts at the result for the previous change
            nonlocal other_log_sigma
            if change == 0.0:  # the maximum-likelihood estimate
                return -max_sqrt_log_likelihood_drop
            profile_fit = minimize_scalar(
                lambda tested_other_log_sigma: score(
                    best_log_sigmas[0] + direction * change, tested_other_log_sigma
                ),
                bounds=(
                    other_log_sigma - MAX_PROFILED_LOG_SIGMA_CHANGE,
                    other_log_sigma + MAX_PROFILED_LOG_SIGMA_CHANGE,
                ),
                options={"xatol": OTHER_NOISE_LOG_SIGMA_TOLERANCE},
            )
            other_log_sigma = float(profile_fit.x)
            drop = max(profile_fit.fun - best_score, 0.0)
            return float(np.sqrt(drop)) - max_sqrt_log_likelihood_drop

        # Double the change of ln σ until the log-likelihood decreases by more than its limit. The
        # end of the interval is then between 0 and this change
        max_change = direction * (float(np.log(search_limit)) - best_log_sigmas[0])
        outer_change = min(INITIAL_LOG_SIGMA_SEARCH_STEP, max_change)
        while compute_drop_excess(outer_change) < 0.0:
            if outer_change == max_change:
                return None
            outer_change = min(2.0 * outer_change, max_change)
        end_change = brentq(compute_drop_excess, 0.0, outer_change, xtol=1e-3 * outer_change)
        return float(np.exp(best_log_sigmas[0] + direction * end_change))

    return find_interval_end(-1.0, parameter_bounds[0]), find_interval_end(1.0, parameter_bounds[1])
