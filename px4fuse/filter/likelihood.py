"""KF with one prediction per measurement, and 95 % likelihood intervals of its noises.

The acceleration is first integrated between measurements, so KF needs few predictions and is fast.
If SIGMA_A and SIGMA_Z are at least 1e-3, the innovations equal those of
:mod:`px4fuse.filter.kalman` to 1e-9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import brentq, minimize_scalar
from scipy.special import chdtri

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.filter.model import (
    INITIAL_COVARIANCE,
    SymmetricElements,
    compute_unit_process_noise,
    propagate_covariance,
    propagate_state,
    update_step,
)
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import Timeline, make_timeline

# Decrease of the log-likelihood (nats) from its maximum to the ends of a 95 % interval: half of the
# 95 % point of χ²(1)
MAX_LOG_LIKELIHOOD_DROP = float(chdtri(1, 0.05)) / 2.0
# Initial distance (in ln σ) from the maximum in the search for an end of a 95 % interval
START_LOG_SIGMA_DISTANCE = 0.05
# The profile likelihood of SIGMA_A or SIGMA_Z is maximised over the other σ, the nuisance
# parameter. Maximum change of ln(nuisance σ) from one point of the profile to the next
MAX_NUISANCE_LOG_SIGMA_STEP = 1.0
# Tolerance of ln(nuisance σ) when the likelihood is maximised over it
NUISANCE_LOG_SIGMA_TOLERANCE = 2e-3


@dataclass(frozen=True)
class PreintegratedMotion:
    """Positions for KF, and IMU acceleration integrated over the intervals between them.

    Arrays have the shape (m,), if not stated otherwise.

    Attributes
    ----------
    interval_s : ndarray
        Time from the initial state or the previous position to each position.
    delta_position_m, delta_velocity_m_s : ndarray
        Δp and Δv in each interval due to the acceleration.
    unit_process_noise, added_process_noise : ndarray, shape (m, 3)
        Elements 00, 01, 11 of the process noise Q in each interval for SIGMA_A = 1 m/s², and of
        the additional Q in gaps of the IMU.
    measurement_m : ndarray
        Measured positions.
    initial_state : InitialState
    """

    interval_s: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    unit_process_noise: Array
    added_process_noise: Array
    measurement_m: Array
    initial_state: InitialState


def preintegrate(axis: Axis, settings: Settings) -> PreintegratedMotion:
    """Integrate the acceleration and process noise of KF between measurements.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    timeline = make_timeline(axis, settings)
    last_steps, interval_index, time_to_interval_end_s = _assign_steps_to_intervals(timeline)
    step_times_s = timeline.time_s
    unit_process_noise = settings.dt_s * np.stack(
        propagate_covariance(
            compute_unit_process_noise(np.diff(step_times_s)), time_to_interval_end_s
        ),
        1,
    )
    dp, dv = integrate_acceleration(timeline, timeline.acceleration_m_s2)

    def sum_by_interval(values: Array) -> Array:
        return np.stack([np.bincount(interval_index, column) for column in values.T], 1)

    return PreintegratedMotion(
        interval_s=np.diff(step_times_s[np.append(0, last_steps)]),
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        unit_process_noise=sum_by_interval(unit_process_noise),
        added_process_noise=sum_by_interval(
            unit_process_noise * timeline.input_variance_m2_s4[:, None]
        ),
        measurement_m=axis.measurement_m[timeline.measurement_index[last_steps]],
        initial_state=InitialState(float(step_times_s[0]), float(axis.measurement_m[0])),
    )


def integrate_acceleration(timeline: Timeline, acceleration_m_s2: Array) -> ArrayPair:
    """Integrate an acceleration over the intervals between measurements: Δp (m) and Δv (m/s).

    ``acceleration_m_s2``, shape (n - 1,), contains the acceleration in each prediction step.
    """
    _, interval_index, time_to_interval_end_s = _assign_steps_to_intervals(timeline)
    zeros = np.zeros(len(time_to_interval_end_s))
    dp, dv = propagate_state(
        *propagate_state(zeros, zeros, acceleration_m_s2, np.diff(timeline.time_s)),
        zeros,
        time_to_interval_end_s,
    )
    dp, dv = (np.bincount(interval_index, increment).astype(float) for increment in (dp, dv))
    return dp, dv


def _assign_steps_to_intervals(timeline: Timeline) -> tuple[IntArray, IntArray, Array]:
    """Assign each prediction step to an interval between measurements.

    Returns
    -------
    last_steps : ndarray
        Index of the last step of each interval.
    interval_index : ndarray
        Index of the interval that contains each step.
    time_to_interval_end_s : ndarray
        Time from the end of each step to the end of its interval.
    """
    last_steps = np.flatnonzero(timeline.measurement_index >= 0)
    interval_index = np.searchsorted(last_steps, np.arange(1, len(timeline.time_s)))
    time_to_interval_end_s = timeline.time_s[last_steps[interval_index]] - timeline.time_s[1:]
    return last_steps, interval_index, time_to_interval_end_s


def innovations(
    preintegrated_motion: PreintegratedMotion,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    is_skipped: BoolArray | None = None,
) -> ArrayPair:
    """Run KF; return ν (m) and S (m²) of each measurement, shape (m,).

    If Δp, Δv and the measurements have k columns, KF filters each column, and ν has the shape
    (m, k).

    Parameters
    ----------
    preintegrated_motion : PreintegratedMotion
    sigma_a_m_s2, sigma_z_m : float
    is_skipped : ndarray of bool, shape (m,), optional
        True for measurements without update; their innovation is computed.
    """
    q, r = sigma_a_m_s2 * sigma_a_m_s2, sigma_z_m * sigma_z_m
    covariance: SymmetricElements[float] = INITIAL_COVARIANCE
    variances_and_gains = []
    for dt, unit_process_noise, added_process_noise, skips_update in zip(
        preintegrated_motion.interval_s.tolist(),
        preintegrated_motion.unit_process_noise.tolist(),
        preintegrated_motion.added_process_noise.tolist(),
        [False] * len(preintegrated_motion.interval_s)
        if is_skipped is None
        else is_skipped.tolist(),
        strict=True,
    ):
        p00, p01, p11 = propagate_covariance(covariance, dt)  # P = FPFᵀ + Q
        covariance = (
            p00 + q * unit_process_noise[0] + added_process_noise[0],
            p01 + q * unit_process_noise[1] + added_process_noise[1],
            p11 + q * unit_process_noise[2] + added_process_noise[2],
        )
        (_, s, k0, k1), (_, _, updated_covariance) = update_step(0.0, 0.0, covariance, 0.0, r)
        variances_and_gains.append((s, 0.0, 0.0) if skips_update else (s, k0, k1))
        covariance = covariance if skips_update else updated_covariance
    s, k0, k1 = np.array(variances_and_gains).T
    # KF predicts x' = F(x + K(z - Hx)) + [Δp, Δv] at the next measurement, with transition matrix F
    # and gain K. This is linear in x, so LAPACK solves for the states at all measurements at once,
    # in a lower triangular band system with unit diagonal
    dt = preintegrated_motion.interval_s[1:]
    position_gain = k0[:-1] + dt * k1[:-1]
    measured_m = np.ascontiguousarray(preintegrated_motion.measurement_m.T)
    right_hand_side = np.empty((*measured_m.shape, 2))
    right_hand_side[..., 0] = preintegrated_motion.delta_position_m.T
    right_hand_side[..., 1] = preintegrated_motion.delta_velocity_m_s.T
    right_hand_side[..., 1:, 0] += position_gain * measured_m[..., :-1]
    right_hand_side[..., 1:, 1] += k1[:-1] * measured_m[..., :-1]
    initial_state = preintegrated_motion.initial_state
    right_hand_side[..., 0, 0] += (
        initial_state.position_m + preintegrated_motion.interval_s[0] * initial_state.velocity_m_s
    )
    right_hand_side[..., 0, 1] += initial_state.velocity_m_s
    bands = np.zeros((len(s), 2, 4))
    bands[:-1, 1, 1] = -dt
    bands[:-1, 0, 2] = position_gain - 1.0
    bands[:-1, 1, 2] = -1.0
    bands[:-1, 0, 3] = k1[:-1]
    state, _ = lapack.dtbtrs(
        bands.reshape(-1, 4).T,
        right_hand_side.reshape(-1, 2 * len(s)).T,
        uplo="L",
        diag="U",
        overwrite_b=1,
    )
    return np.asarray((measured_m - state[::2].T.reshape(measured_m.shape)).T), s


def fit_parabola_vertex(profile: Array, index: int) -> tuple[float, float]:
    """Fit a parabola to ``profile[index]`` and its two neighbours.

    Return the distance from ``index`` to the minimum (0 without a minimum), and the second
    difference of the profile.
    """
    left_value, middle_value, right_value = profile[index - 1 : index + 2]
    curvature = left_value - 2.0 * middle_value + right_value
    return (0.5 * (left_value - right_value) / curvature if curvature > 0.0 else 0.0), curvature


def compute_profile_interval(
    grid: Array, profile: Array, max_log_likelihood_drop: float = MAX_LOG_LIKELIHOOD_DROP
) -> tuple[float | None, float | None]:
    """Return the interval of a parameter in which -ln p on a grid is close to its minimum.

    At its ends, -ln p is ``max_log_likelihood_drop`` larger than the minimum; the default gives a
    95 % interval. An end outside the grid is None.
    """
    score_rises = profile - profile.min()
    first_index, last_index = np.flatnonzero(score_rises <= max_log_likelihood_drop)[[0, -1]]

    def interpolate_end(inside_index: int, outside_index: int) -> float | None:
        if not 0 <= outside_index < len(grid):
            return None
        grid_fraction = (max_log_likelihood_drop - score_rises[inside_index]) / (
            score_rises[outside_index] - score_rises[inside_index]
        )
        return float(
            grid[inside_index] + grid_fraction * (grid[outside_index] - grid[inside_index])
        )

    return interpolate_end(first_index, first_index - 1), interpolate_end(
        last_index, last_index + 1
    )


def find_profile_interval(
    score: Callable[[float, float], float],
    best_log_sigmas: tuple[float, float],
    parameter_bounds: tuple[float, float],
    variance_factor: float = 1.0,
) -> tuple[float | None, float | None]:
    """Return the 95 % profile-likelihood interval of a parameter; None for an end beyond a bound.

    Parameters
    ----------
    score : callable
        -ln p as a function of the logarithms of the parameter and of a second parameter, over
        which -ln p is minimised.
    best_log_sigmas : (float, float)
        Natural logarithms of both parameters at the minimum.
    parameter_bounds : (float, float)
        Bounds of the first parameter, not of its logarithm.
    variance_factor : float
        Factor on the parameter's variance, for uncertainty that ``score`` does not include.
    """
    best_score = score(*best_log_sigmas)
    max_sqrt_likelihood_drop = float(np.sqrt(MAX_LOG_LIKELIHOOD_DROP * variance_factor))

    def find_interval_end(direction: float, bound: float) -> float | None:
        nuisance_log_sigma = best_log_sigmas[1]

        # √(decrease of the log-likelihood from its maximum) is nearly linear in the distance of ln
        # σ from its estimate, so brentq is fast
        @cache
        def compute_sqrt_drop_minus_limit(log_sigma_distance: float) -> float:
            nonlocal nuisance_log_sigma
            if log_sigma_distance == 0.0:
                return -max_sqrt_likelihood_drop
            minimum_over_nuisance = minimize_scalar(
                lambda log_nuisance: score(
                    best_log_sigmas[0] + direction * log_sigma_distance, log_nuisance
                ),
                bounds=(
                    nuisance_log_sigma - MAX_NUISANCE_LOG_SIGMA_STEP,
                    nuisance_log_sigma + MAX_NUISANCE_LOG_SIGMA_STEP,
                ),
                options={"xatol": NUISANCE_LOG_SIGMA_TOLERANCE},
            )
            nuisance_log_sigma = float(minimum_over_nuisance.x)
            return float(
                np.sqrt(max(minimum_over_nuisance.fun - best_score, 0.0)) - max_sqrt_likelihood_drop
            )

        max_log_sigma_distance = direction * (float(np.log(bound)) - best_log_sigmas[0])
        outer_log_sigma_distance = min(START_LOG_SIGMA_DISTANCE, max_log_sigma_distance)
        while compute_sqrt_drop_minus_limit(outer_log_sigma_distance) < 0.0:
            if outer_log_sigma_distance == max_log_sigma_distance:
                return None
            outer_log_sigma_distance = min(2.0 * outer_log_sigma_distance, max_log_sigma_distance)
        log_sigma_distance = brentq(
            compute_sqrt_drop_minus_limit,
            0.0,
            outer_log_sigma_distance,
            xtol=1e-3 * outer_log_sigma_distance,
        )
        return float(np.exp(best_log_sigmas[0] + direction * log_sigma_distance))

    return find_interval_end(-1.0, parameter_bounds[0]), find_interval_end(1.0, parameter_bounds[1])
