"""The same filter as :mod:`px4fuse.filter.kalman` over whole grids of settings at once.

Between two position measurements nothing else enters the filter, so the input is preintegrated
once: one step per measurement instead of one per DT, with every setting an array element.
Agrees with the filterpy replay to 1e-9 for SIGMA_A and SIGMA_Z from 1e-3.
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
from px4fuse.filter.model import INITIAL_COVARIANCE, Symmetric, move, noise, spread, update
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import Timeline, timeline

# Half of the 95 % point of chi-square: the drop of log-likelihood that bounds an interval
PROFILE_DROP = float(chdtri(1, 0.05)) / 2.0
# ln σ at which the end of an interval is sought first
FIRST_REACH = 0.05
# Step of ln σ for bends; of those, how far a parabola is followed at once, and how often
BEND_STEP = 0.05
FAR_STEPS, PARABOLAS = 6.0, 4


@dataclass(frozen=True)
class Preintegrated:
    """The input between consecutive measurements, each of shape (m,).

    Attributes
    ----------
    length_s : ndarray
    delta_position_m, delta_velocity_m_s : ndarray
        What the acceleration alone adds to position and velocity.
    noise_unit : ndarray, shape (m, 3)
        Q's elements 00, 01, 11 for SIGMA_A = 1 m/s².
    noise_fixed : ndarray, shape (m, 3)
        What IMU gaps add to them, whatever SIGMA_A is.
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
        """The first measurements only."""
        arrays = {name: of[:count] for name, of in vars(self).items() if name != "initial"}
        return replace(self, **arrays)


def preintegrate(axis: Axis, settings: Settings) -> Preintegrated:
    """Preintegrate the input of one axis on the steps that the replay takes.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    line = timeline(axis, settings)
    ends, leg, rest = _legs(line)
    time = line.time_s
    unit = settings.dt_s * np.stack(spread(noise(np.diff(time)), rest), 1)
    dp, dv = moved(line, line.acceleration_m_s2)
    return Preintegrated(
        length_s=np.diff(time[np.concatenate([[0], ends])]),
        delta_position_m=dp,
        delta_velocity_m_s=dv,
        noise_unit=np.stack([np.bincount(leg, unit[:, i]) for i in range(3)], 1),
        noise_fixed=np.stack(
            [np.bincount(leg, unit[:, i] * line.input_variance_m2_s4) for i in range(3)], 1
        ),
        measurement_m=axis.measurement_m[line.measurement[ends]],
        initial=InitialState(float(time[0]), float(axis.measurement_m[0])),
    )


def moved(line: Timeline, acceleration_m_s2: Array) -> tuple[Array, Array]:
    """What an acceleration adds to position (m) and velocity (m/s) between the measurements.

    Parameters
    ----------
    line : Timeline
    acceleration_m_s2 : ndarray, shape (n - 1,)
        Over each of its steps.

    Returns
    -------
    delta_position_m, delta_velocity_m_s : ndarray, shape (m,)
    """
    _, leg, rest = _legs(line)
    still = np.zeros(len(rest))
    dp, dv = move(*move(still, still, acceleration_m_s2, np.diff(line.time_s)), still, rest)
    # numpy's stubs call the sums of weights integers
    return np.asarray(np.bincount(leg, dp), float), np.asarray(np.bincount(leg, dv), float)


def _legs(line: Timeline) -> tuple[IntArray, IntArray, Array]:
    """Last step of each leg; of each step its leg, and the time from its end to the leg's."""
    ends = np.flatnonzero(line.measurement >= 0)
    leg = np.searchsorted(ends, np.arange(1, len(line.time_s)))
    return ends, leg, line.time_s[ends[leg]] - line.time_s[1:]


def innovations(
    legs: Preintegrated,
    sigma_a_m_s2: ArrayLike,
    sigma_z_m: ArrayLike,
    skip: BoolArray | None = None,
) -> tuple[Array, Array]:
    """Innovations and their variances for every combination of settings.

    Parameters
    ----------
    legs : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    skip : ndarray of bool, shape (m,), optional
        Measurements that are compared but not fused.

    Returns
    -------
    innovation_m, innovation_variance_m2 : ndarray, shape (m, ...)
        Of k signals through one filter of shape (m, k) and (m,).
    """
    steps = recursion(legs, sigma_a_m_s2, sigma_z_m, skip)
    nu, s = zip(*(step[:2] for step in steps), strict=True)
    return np.array(nu), np.array(s)


@dataclass(frozen=True)
class States:
    """The filter just after each measurement, each of shape (m, ...) for a grid of settings."""

    gain: Array
    velocity_m_s: Array
    sigma_p_m: Array
    sigma_v_m_s: Array
    nis: Array


def states(legs: Preintegrated, sigma_a_m_s2: ArrayLike, sigma_z_m: ArrayLike) -> States:
    """Gain, velocity and standard deviations for every combination of settings.

    Parameters
    ----------
    legs : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    """
    rows = [
        (k0, v, np.sqrt(p00), np.sqrt(p11), nu**2 / s)
        for nu, s, k0, _, v, (p00, _, p11) in recursion(legs, sigma_a_m_s2, sigma_z_m, None)
    ]
    return States(*(np.array(column) for column in zip(*rows, strict=True)))


def recursion(
    legs: Preintegrated,
    sigma_a_m_s2: ArrayLike,
    sigma_z_m: ArrayLike,
    skip: BoolArray | None,
    weight: Array | None = None,
) -> Iterator[tuple[Array, Array, Array, Array, Array, Symmetric[Array]]]:
    """Run the filter over a grid of settings, measurement by measurement.

    The filter is linear in what drives it: with Δp, Δv and measurements of shape (m, k) and one
    pair of settings, k signals run through one filter at once.

    Parameters
    ----------
    legs : Preintegrated
    sigma_a_m_s2, sigma_z_m : array_like
        Broadcast against each other to a grid of shape (...).
    skip : ndarray of bool, shape (m,), or None
        Measurements that are compared but not fused.
    weight : ndarray, shape (m,), optional
        What each measurement counts: its variance is SIGMA_Z² over that.

    Yields
    ------
    tuple
        ν (m), S (m²), gain, and after the update position (m), velocity (m/s) and covariance by
        its elements 00, 01, 11: each of shape (...), and a plain float where that is ().
    """
    squares = (np.square(np.asarray(sigma, float)) for sigma in (sigma_a_m_s2, sigma_z_m))
    q, r = np.broadcast_arrays(*squares)
    if not q.ndim:  # in plain floats: fifty times as fast as arrays of a single element
        q, r = q.item(), r.item()
    p, v = legs.initial.position_m, legs.initial.velocity_m_s + 0.0 * q  # of the grid's shape
    covariance: Symmetric[Any] = INITIAL_COVARIANCE
    variance = r
    for dt, dp, dv, unit, fixed, z, skipped, counts in zip(
        legs.length_s.tolist(),
        _rows(legs.delta_position_m),
        _rows(legs.delta_velocity_m_s),
        legs.noise_unit.tolist(),
        legs.noise_fixed.tolist(),
        _rows(legs.measurement_m),
        [False] * len(legs.measurement_m) if skip is None else skip.tolist(),
        [1.0] * len(legs.measurement_m) if weight is None else weight.tolist(),
        strict=True,
    ):
        r = variance / counts
        # x = Fx + Ba, P = FPFᵀ + Q
        p, v = p + dt * v + dp, v + dv
        p00, p01, p11 = spread(covariance, dt)
        p00 = p00 + q * unit[0] + fixed[0]
        p01 = p01 + q * unit[1] + fixed[1]
        p11 = p11 + q * unit[2] + fixed[2]
        covariance = p00, p01, p11
        (nu, s, k0, _), after = update(p, v, covariance, z, r)
        if not skipped:
            p, v, covariance = after
        yield nu, s, k0, p, v, covariance


def _rows(values: Array) -> list[Any]:
    """What the filter takes in turn: numbers, or a row of several signals."""
    return values.tolist() if values.ndim == 1 else list(values)


def total_over_grid(
    legs: list[Preintegrated], sigma_a_m_s2: Array, sigma_z_m: Array, weight: Array
) -> Array:
    """-ln p of all axes but for a constant, of the shape of the grid of settings.

    Parameters
    ----------
    legs : list of Preintegrated
    sigma_a_m_s2, sigma_z_m : ndarray
        Broadcast against each other.
    weight : ndarray, shape (m,)
        What each measurement counts: its variance is SIGMA_Z² over that.
    """
    total = np.zeros(np.broadcast(sigma_a_m_s2, sigma_z_m).shape)
    for leg in legs:
        for nu, s, *_ in recursion(leg, sigma_a_m_s2, sigma_z_m, None, weight):
            total += 0.5 * (np.log(s) + nu**2 / s)
    return total


def parabola_vertex(profile: Array, at: int) -> tuple[float, float]:
    """Vertex of the parabola through three points of a profile.

    Parameters
    ----------
    profile : ndarray, shape (n,)
        At equal steps.
    at : int
        Index of the middle one, 1 to n - 2.

    Returns
    -------
    shift : float
        From the middle point to the minimum, in steps; 0 where there is none.
    bend : float
        Second difference, per square step.
    """
    left, middle, right = profile[at - 1 : at + 2]
    bend = left - 2.0 * middle + right
    return (0.5 * (left - right) / bend if bend > 0.0 else 0.0), bend


def profile_interval(
    grid: Array, profile: Array, allowed: float = PROFILE_DROP
) -> tuple[float | None, float | None]:
    """Ends of the 95 % interval of a profile likelihood, None where it does not end on the grid.

    Parameters
    ----------
    grid, profile : ndarray, shape (n,)
        Values, and the negative log-likelihood at each; between two of them it is a line.
    allowed : float
        How far above its minimum the interval reaches.
    """
    drop = profile - profile.min()
    inside = np.flatnonzero(drop <= allowed)
    ends: list[float | None] = []
    for edge, beyond in ((inside[0], inside[0] - 1), (inside[-1], inside[-1] + 1)):
        if 0 <= beyond < len(grid):
            share = (allowed - drop[edge]) / (drop[beyond] - drop[edge])
            ends.append(float(grid[edge] + share * (grid[beyond] - grid[edge])))
        else:
            ends.append(None)
    return ends[0], ends[1]


def profile_ends(
    score: Callable[[float, float], float],
    best: tuple[float, float],
    bounds: tuple[float, float],
    widening: float = 1.0,
) -> tuple[float | None, float | None]:
    """Ends of a parameter's 95 % profile-likelihood interval, None where beyond a bound.

    Parameters
    ----------
    score : callable
        -ln p of ln of the parameter and ln of the other one, which is maximised out where there is
        one.
    best : (float, float)
        Where it is least.
    bounds : (float, float)
        Of the parameter itself.
    widening : float
        Of the variance, by what the score does not hold.
    """
    least, root = score(*best), float(np.sqrt(PROFILE_DROP * widening))

    def end(side: float, bound: float) -> float | None:
        other = best[1]

        @cache  # where the other parameter is sought from depends on the call before
        def excess(distance: float) -> float:
            """How far √(drop), which is nearly a line, lies above that of the interval's end."""
            nonlocal other
            if distance == 0.0:
                return -root
            lowest, other = _lowest(lambda at: score(best[0] + side * distance, at), other)
            return float(np.sqrt(max(lowest - least, 0.0)) - root)

        reach = side * (float(np.log(bound)) - best[0])
        far = min(FIRST_REACH, reach)
        while excess(far) < 0.0:
            if far == reach:
                return None
            far = min(2.0 * far, reach)
        return float(np.exp(best[0] + side * brentq(excess, 0.0, far, xtol=1e-3 * far)))

    return end(-1.0, bounds[0]), end(1.0, bounds[1])


def _lowest(score: Callable[[float], float], near: float) -> tuple[float, float]:
    """Least value of a score and where it is, by parabolas from near there."""
    for _ in range(PARABOLAS):
        profile = np.array([score(near + k * BEND_STEP) for k in (-1.0, 0.0, 1.0)])
        middle = float(profile[1])
        if np.ptp(profile) == 0.0:  # there is no other parameter
            return middle, near
        shift, bend = parabola_vertex(profile, 1)
        step = shift if bend > 0.0 else np.sign(profile[0] - profile[2]) * FAR_STEPS
        near += float(np.clip(step, -FAR_STEPS, FAR_STEPS)) * BEND_STEP
        if bend > 0.0 and abs(step) <= 1.0:
            return middle - 0.5 * shift**2 * bend, near
    return score(near), near
