"""KF as in :mod:`px4fuse.filter.kalman`, for whole grids of settings at once.

No other data enter the filter between two position measurements, so the input is preintegrated:
one step per measurement instead of one per DT, with an array element for every setting. Agrees with
the filterpy replay to 1e-9 for SIGMA_A and SIGMA_Z from 1e-3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import chdtri

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.filter.model import (
    INITIAL_COVARIANCE,
    Symmetric,
    process_noise_unit,
    propagate_covariance,
    propagate_state,
    update_step,
)
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import Timeline, make_timeline

# nats; drop of the log-likelihood at the ends of a 95 % interval: half the 95 % point of χ²
PROFILE_DROP = float(chdtri(1, 0.05)) / 2.0
# Distance in ln σ at which the search for the end of an interval starts
FIRST_LOG_DISTANCE = 0.05
# Step in ln σ for second differences; limits of a parabola's steps per iteration, and of iterations
CURVATURE_STEP = 0.05
MAX_PARABOLA_STEPS, MAX_PARABOLAS = 6.0, 4


@dataclass(frozen=True)
class Preintegrated:
    """Input integrated between consecutive measurements; arrays of shape (m,).

    Attributes
    ----------
    length_s : ndarray
    delta_position_m, delta_velocity_m_s : ndarray
        Δp (m) and Δv (m/s) due to the acceleration.
    noise_unit : ndarray, shape (m, 3)
        Elements 00, 01, 11 of Q for SIGMA_A = 1 m/s².
    noise_fixed : ndarray, shape (m, 3)
        Additional Q in gaps of the IMU, independent of SIGMA_A.
    measurement_m : ndarray
    initial : InitialState
    """

    length_s: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    noise_unit: Array
    noise_fixed: Array
    measurement_m: Array
    initial: InitialState

    def first(self, count: int) -> Preintegrated:
        """Return the first ``count`` measurements only."""
        arrays = {name: values[:count] for name, values in vars(self).items() if name != "initial"}
        return replace(self, **arrays)


def preintegrate(axis: Axis, settings: Settings) -> Preintegrated:
    """Integrate the input of one axis over the prediction steps of the replay.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    line = make_timeline(axis, settings)
    end_steps, interval_index, remaining_s = _interval_index(line)
    time = line.time_s
    noise_unit = settings.dt_s * np.stack(
        propagate_covariance(process_noise_unit(np.diff(time)), remaining_s), 1
    )
    dp, dv = integrate_acceleration(line, line.acceleration_m_s2)
    return Preintegrated(
        length_s=np.diff(time[np.concatenate([[0], end_steps])]),
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        noise_unit=np.stack([np.bincount(interval_index, noise_unit[:, i]) for i in range(3)], 1),
        noise_fixed=np.stack(
            [
                np.bincount(interval_index, noise_unit[:, i] * line.input_variance_m2_s4)
                for i in range(3)
            ],
            1,
        ),
        measurement_m=axis.measurement_m[line.measurement[end_steps]],
        initial=InitialState(float(time[0]), float(axis.measurement_m[0])),
    )


def integrate_acceleration(line: Timeline, acceleration_m_s2: Array) -> tuple[Array, Array]:
    """Integrate an acceleration to Δp (m) and Δv (m/s) between the measurements.

    Parameters
    ----------
    line : Timeline
    acceleration_m_s2 : ndarray, shape (n - 1,)
        Acceleration of each step.

    Returns
    -------
    delta_position_m, delta_velocity_m_s : ndarray, shape (m,)
    """
    _, interval_index, remaining_s = _interval_index(line)
    zero_state = np.zeros(len(remaining_s))
    dp, dv = propagate_state(
        *propagate_state(zero_state, zero_state, acceleration_m_s2, np.diff(line.time_s)),
        zero_state,
        remaining_s,
    )
    # numpy's stubs declare weighted bincounts as integers
    return np.asarray(np.bincount(interval_index, dp), float), np.asarray(
        np.bincount(interval_index, dv), float
    )


def _interval_index(line: Timeline) -> tuple[IntArray, IntArray, Array]:
    """Return each interval's last step, each step's interval, and the time to its end (s)."""
    end_steps = np.flatnonzero(line.measurement >= 0)
    interval_index = np.searchsorted(end_steps, np.arange(1, len(line.time_s)))
    return end_steps, interval_index, line.time_s[end_steps[interval_index]] - line.time_s[1:]


def innovations(
    intervals: Preintegrated,
    sigma_a_m_s2: ArrayLike,
    sigma_z_m: ArrayLike,
    skip: BoolArray | None = None,
) -> tuple[Array, Array]:
    """Compute innovations and their variances for every combination of settings.

    Parameters
    ----------
    intervals : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    skip : ndarray of bool, shape (m,), optional
        Measurements with an innovation but without an update.

    Returns
    -------
    innovation_m, innovation_variance_m2 : ndarray, shape (m, ...)
        For k signals through one filter: shapes (m, k) and (m,).
    """
    steps = run_filter(intervals, sigma_a_m_s2, sigma_z_m, skip)
    nu, s = zip(*(step[:2] for step in steps), strict=True)
    return np.array(nu), np.array(s)


@dataclass(frozen=True)
class FilterStates:
    """KF after each measurement; arrays of shape (m, ...) for a grid of settings."""

    gain: Array
    velocity_m_s: Array
    sigma_p_m: Array
    sigma_v_m_s: Array
    nis: Array


def filter_states(
    intervals: Preintegrated, sigma_a_m_s2: ArrayLike, sigma_z_m: ArrayLike
) -> FilterStates:
    """Compute gain, velocity, reported σ and NIS for every combination of settings.

    Parameters
    ----------
    intervals : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    """
    rows = [
        (k0, v, np.sqrt(p00), np.sqrt(p11), nu**2 / s)
        for nu, s, k0, _, v, (p00, _, p11) in run_filter(intervals, sigma_a_m_s2, sigma_z_m, None)
    ]
    return FilterStates(*(np.array(column) for column in zip(*rows, strict=True)))


def run_filter(
    intervals: Preintegrated,
    sigma_a_m_s2: ArrayLike,
    sigma_z_m: ArrayLike,
    skip: BoolArray | None,
    weight: Array | None = None,
) -> Iterator[tuple[Array, Array, Array, Array, Array, Symmetric[Array]]]:
    """Run KF over a grid of settings, measurement by measurement.

    The filter is linear: with Δp, Δv and measurements of shape (m, k) and one
    pair of settings, k signals run through one filter at once.

    Parameters
    ----------
    intervals : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    skip : ndarray of bool, shape (m,), or None
        Measurements with an innovation but without an update.
    weight : ndarray, shape (m,), optional
        Weight of each measurement: its variance is SIGMA_Z² / weight.

    Yields
    ------
    tuple
        ν (m), S (m²), gain, and after the update position (m), velocity (m/s) and covariance
        elements 00, 01, 11. Each has the grid's shape, or is a float for a single setting.
    """
    squares = (np.square(np.asarray(sigma, float)) for sigma in (sigma_a_m_s2, sigma_z_m))
    q, r = np.broadcast_arrays(*squares)
    if not q.ndim:  # floats are fifty times faster than arrays of a single element
        q, r = q.item(), r.item()
    p, v = (
        intervals.initial.position_m,
        intervals.initial.velocity_m_s + 0.0 * q,
    )  # of the grid's shape
    covariance: Symmetric[Any] = INITIAL_COVARIANCE
    variance = r
    for dt, dp, dv, unit, fixed, z, is_skipped, weight_k in zip(
        intervals.length_s.tolist(),
        _measurement_rows(intervals.delta_position_m),
        _measurement_rows(intervals.delta_velocity_m_s),
        intervals.noise_unit.tolist(),
        intervals.noise_fixed.tolist(),
        _measurement_rows(intervals.measurement_m),
        [False] * len(intervals.measurement_m) if skip is None else skip.tolist(),
        [1.0] * len(intervals.measurement_m) if weight is None else weight.tolist(),
        strict=True,
    ):
        r = variance / weight_k
        # x = Fx + Ba, P = FPFᵀ + Q
        p, v = p + dt * v + dp, v + dv
        p00, p01, p11 = propagate_covariance(covariance, dt)
        p00 = p00 + q * unit[0] + fixed[0]
        p01 = p01 + q * unit[1] + fixed[1]
        p11 = p11 + q * unit[2] + fixed[2]
        covariance = p00, p01, p11
        (nu, s, k0, _), updated = update_step(p, v, covariance, z, r)
        if not is_skipped:
            p, v, covariance = updated
        yield nu, s, k0, p, v, covariance


def _measurement_rows(values: Array) -> list[Any]:
    """Return the values per measurement: numbers, or rows of several signals."""
    return values.tolist() if values.ndim == 1 else list(values)


def score_grid(
    intervals: list[Preintegrated], sigma_a_m_s2: Array, sigma_z_m: Array, weight: Array
) -> Array:
    """Compute -ln p of all axes (without a constant) on the grid of settings.

    Parameters
    ----------
    intervals : list of Preintegrated
    sigma_a_m_s2, sigma_z_m : ndarray
        Broadcast against each other.
    weight : ndarray, shape (m,)
        Weight of each measurement: its variance is SIGMA_Z² / weight.
    """
    total = np.zeros(np.broadcast(sigma_a_m_s2, sigma_z_m).shape)
    for interval in intervals:
        for nu, s, *_ in run_filter(interval, sigma_a_m_s2, sigma_z_m, None, weight):
            total += 0.5 * (np.log(s) + nu**2 / s)
    return total


def parabola_vertex(profile: Array, index: int) -> tuple[float, float]:
    """Return the vertex of the parabola through three points of a profile.

    Parameters
    ----------
    profile : ndarray, shape (n,)
        Values at equal steps.
    index : int
        Index of the middle one, 1 to n - 2.

    Returns
    -------
    shift : float
        From the middle point to the minimum, in steps; 0 without a minimum.
    curvature : float
        Second difference, per square step.
    """
    left, middle, right = profile[index - 1 : index + 2]
    curvature = left - 2.0 * middle + right
    return (0.5 * (left - right) / curvature if curvature > 0.0 else 0.0), curvature


def profile_interval(
    grid: Array, profile: Array, allowed: float = PROFILE_DROP
) -> tuple[float | None, float | None]:
    """Return the ends of the 95 % interval of a profile; None for an end outside the grid.

    Parameters
    ----------
    grid, profile : ndarray, shape (n,)
        Parameter values and their negative log-likelihood, interpolated linearly.
    allowed : float
        Height above the minimum at the ends of the interval.
    """
    drop = profile - profile.min()
    inside_indices = np.flatnonzero(drop <= allowed)
    ends: list[float | None] = []
    for edge_index, outside_index in (
        (inside_indices[0], inside_indices[0] - 1),
        (inside_indices[-1], inside_indices[-1] + 1),
    ):
        if 0 <= outside_index < len(grid):
            share = (allowed - drop[edge_index]) / (drop[outside_index] - drop[edge_index])
            ends.append(float(grid[edge_index] + share * (grid[outside_index] - grid[edge_index])))
        else:
            ends.append(None)
    return ends[0], ends[1]


def profile_ends(
    score: Callable[[float, float], float],
    best: tuple[float, float],
    bounds: tuple[float, float],
    widening: float = 1.0,
) -> tuple[float | None, float | None]:
    """Return the ends of a 95 % profile-likelihood interval; None for an end beyond a bound.

    Parameters
    ----------
    score : callable
        -ln p as a function of ln of the parameter and ln of the other one, which is maximised out.
    best : (float, float)
        Logarithms at the minimum.
    bounds : (float, float)
        Bounds of the parameter (not of its logarithm).
    widening : float
        Factor on the variance for uncertainty that the score does not contain.
    """
    best_score, root_drop = score(*best), float(np.sqrt(PROFILE_DROP * widening))

    def find_end(direction: float, bound: float) -> float | None:
        other_log = best[1]

        @cache  # the search for the other parameter starts at the previous result
        def excess(distance: float) -> float:
            """Return √drop minus its value at the interval's end; √drop is nearly linear."""
            nonlocal other_log
            if distance == 0.0:
                return -root_drop
            lowest_score, other_log = _minimise_by_parabolas(
                lambda other_log_value: score(best[0] + direction * distance, other_log_value),
                other_log,
            )
            return float(np.sqrt(max(lowest_score - best_score, 0.0)) - root_drop)

        max_distance = direction * (float(np.log(bound)) - best[0])
        distance_limit = min(FIRST_LOG_DISTANCE, max_distance)
        while excess(distance_limit) < 0.0:
            if distance_limit == max_distance:
                return None
            distance_limit = min(2.0 * distance_limit, max_distance)
        return float(
            np.exp(
                best[0]
                + direction * brentq(excess, 0.0, distance_limit, xtol=1e-3 * distance_limit)
            )
        )

    return find_end(-1.0, bounds[0]), find_end(1.0, bounds[1])


def _minimise_by_parabolas(score: Callable[[float], float], start: float) -> tuple[float, float]:
    """Return the minimum of a score and its place, by parabolas from a nearby start."""
    for _ in range(MAX_PARABOLAS):
        profile = np.array([score(start + k * CURVATURE_STEP) for k in (-1.0, 0.0, 1.0)])
        middle = float(profile[1])
        if np.ptp(profile) == 0.0:  # there is no other parameter
            return middle, start
        shift, curvature = parabola_vertex(profile, 1)
        step = shift if curvature > 0.0 else np.sign(profile[0] - profile[2]) * MAX_PARABOLA_STEPS
        start += float(np.clip(step, -MAX_PARABOLA_STEPS, MAX_PARABOLA_STEPS)) * CURVATURE_STEP
        if curvature > 0.0 and abs(step) <= 1.0:
            return middle - 0.5 * shift**2 * curvature, start
    return score(start), start
