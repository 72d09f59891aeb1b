"""Most likely noises of positions: SIGMA_A, SIGMA_Z, and which measurements are outliers.

The innovations of a filter with the right noises are white and as large as it says, and these
noises make them most likely (Schweppe 1965). A share of the measurements may come from a normal
distribution many times as wide (Tukey 1960): how many, how wide and which is found by expectation
and maximisation, one decision for all axes of a sample, with what *all* data say of its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.special import expit
from scipy.stats import chi2

from px4fuse.arrays import Array
from px4fuse.filter.likelihood import PROFILE_DROP, Preintegrated
from px4fuse.filter.marginal import Chain, Positions, fit, squares
from px4fuse.filter.model import INITIAL_COVARIANCE

SIGMA_A_SEARCH_M_S2 = (1e-3, 30.0)
# From what no positioning system resolves
SIGMA_Z_SEARCH_M = (1e-3, 10.0)
WALK_SEARCH_M = (1e-4, 1.0)
MAX_PASSES = 12
# Of the maximisation, in the end and while the outliers still change
MAX_STEPS, ROUGH_STEPS = 50, 3
# Outliers are at least this many times as wide as the rest: less is not told from it
LEAST_WIDTH = 3.0
FIRST_SHARE, FIRST_WIDTH, MAX_SHARE = 0.005, 10.0, 0.4
# SIGMA_Z is at most this many times what the median of the squares says
BULK = 1.2
SETTLED = 0.01
# Steps of ln σ for slopes and bends
SLOPE_STEP, BEND_STEP = 1e-4, 0.05
# Of those: how far a parabola is followed at once, and how often
FAR_STEPS, PARABOLAS = 6.0, 4
# ln σ at which the end of an interval is sought first
FIRST_REACH = 0.05


@dataclass(frozen=True)
class Part:
    """Axes that are fitted together, with the legs under them, shape (n, a, 1, 1 + c)."""

    positions: Positions
    delta_position_m: Array
    delta_velocity_m_s: Array


@dataclass(frozen=True)
class Noises:
    """What is random.

    Attributes
    ----------
    sigma_a_m_s2, sigma_z_m : float
        Of the acceleration, as the filter's, and of each measurement.
    walk_m : float
        Random walk of the source itself, m per square root of a second; 0 for one that does not
        drift.
    """

    sigma_a_m_s2: float
    sigma_z_m: float
    walk_m: float = 0.0


@dataclass(frozen=True)
class NoiseFit:
    """Noises of greatest likelihood.

    Attributes
    ----------
    noises : Noises
    weight : ndarray, shape (m,)
        What each measurement counts: 1 for a good one, 1/width² for an outlier.
    outlier : ndarray, shape (m,)
        Probability that it is one.
    """

    noises: Noises
    weight: Array
    outlier: Array


def filter_part(legs: Preintegrated) -> Part:
    """The lesson's filter of one axis: it starts with P₀ and knows no constants."""
    count = len(legs.measurement_m)
    initial = np.zeros((count + 1, 2))
    initial[0] = 1.0 / INITIAL_COVARIANCE[0], 1.0 / INITIAL_COVARIANCE[2]
    measured = np.concatenate([[0.0], legs.measurement_m - legs.initial.position_m])[:, None]
    chain = Chain(np.arange(1, count + 1), legs.length_s, legs.noise_unit, legs.noise_fixed)
    positions = Positions(chain, measured, np.array([0]), initial, np.array([]))
    dp, dv = legs.delta_position_m, legs.delta_velocity_m_s
    return Part(positions, dp[:, None, None, None], dv[:, None, None, None])


def negative_log_likelihood(parts: Sequence[Part], noises: Noises, weight: Array) -> float:
    """-ln p of the measurements but for a constant.

    Parameters
    ----------
    parts : sequence of Part
    noises : Noises
    weight : ndarray, shape (m,)
    """
    return float(sum(fit(*arguments(part, noises, weight)).total()[0] for part in parts))


def arguments(
    part: Part, noises: Noises, weight: Array
) -> tuple[Positions, Array, Array, float, Array]:
    """What :func:`px4fuse.filter.marginal.fit` takes."""
    variance = noises.sigma_z_m**2 / weight
    positions = part.positions
    extra = len(positions.measurement_m) - len(variance)
    if extra:  # the filter's start, which counts by its own precision
        variance = np.concatenate([np.full(extra, np.inf), variance])
    if noises.walk_m:
        chain = positions.chain
        walk = np.outer(chain.length_s * noises.walk_m**2, [1.0, 0.0, 0.0])
        positions = replace(positions, chain=replace(chain, noise_fixed=chain.noise_fixed + walk))
    legs = part.delta_position_m, part.delta_velocity_m_s
    return positions, *legs, noises.sigma_a_m_s2, variance


def most_likely(
    parts: Sequence[Part], start: Noises, weight: Array, outliers: bool = True
) -> NoiseFit:
    """Fit the noises, and find the outliers.

    Parameters
    ----------
    parts : sequence of Part
        With the same measurements.
    start : Noises
        To start with. A walk is fitted where this one is not zero.
    weight : ndarray, shape (m,)
        Of each measurement to start with.
    outliers : bool
        Whether they are sought; else the weights stay.
    """
    noises = _maximise(parts, start, weight)
    if not outliers:
        return NoiseFit(noises, weight, np.zeros_like(weight))
    share, width, outlier = FIRST_SHARE, FIRST_WIDTH, np.zeros_like(weight)
    for _ in range(MAX_PASSES):
        square, count = _squares(parts, noises, weight)
        # outliers raise the noise that hides them: the median does not follow them
        bulk = float(np.median(square / count) / (chi2.median(count[0]) / count[0]))
        if bulk > SIGMA_Z_SEARCH_M[1] ** 2:  # noise beyond the search is not outliers
            return NoiseFit(noises, weight, outlier)
        variance = min(noises.sigma_z_m**2, BULK**2 * bulk)
        found = _outlier_probability(square / variance, count, share, width)
        if found.sum() < 1.0 and found.max() < 0.5 and not outlier.any():
            return NoiseFit(noises, weight, outlier)
        share = float(np.clip(found.mean(), 0.5 / len(found), MAX_SHARE))
        wide = float(np.sum(found * square) / max(np.sum(found * count), 1e-9)) / variance
        width = max(LEAST_WIDTH, float(np.sqrt(wide)))
        weight = 1.0 - found * (1.0 - width**-2.0)
        settled = bool(np.max(np.abs(found - outlier)) < SETTLED)
        outlier = found
        if settled:
            break
        guess = replace(noises, sigma_z_m=float(np.sqrt(variance)))
        noises = _maximise(parts, guess, weight, ROUGH_STEPS)
    return NoiseFit(_maximise(parts, noises, weight), weight, outlier)


def _squares(parts: Sequence[Part], noises: Noises, weight: Array) -> tuple[Array, Array]:
    found = [squares(*arguments(part, noises, weight)) for part in parts]
    size = len(weight)
    return (
        np.sum([square[-size:] for square, _ in found], axis=0),
        np.sum([count[-size:] for _, count in found], axis=0),
    )


def _outlier_probability(square: Array, count: Array, share: float, width: float) -> Array:
    odds = np.log(share / (1.0 - share)) - count * np.log(width)
    return np.asarray(expit(odds + 0.5 * square * (1.0 - width**-2.0)))


def _maximise(
    parts: Sequence[Part], start: Noises, weight: Array, steps: int = MAX_STEPS
) -> Noises:
    values = [start.sigma_a_m_s2, start.sigma_z_m, *([start.walk_m] if start.walk_m else [])]
    bounds = np.log([SIGMA_A_SEARCH_M_S2, SIGMA_Z_SEARCH_M, WALK_SEARCH_M][: len(values)])

    def score(logs: Array) -> float:
        return negative_log_likelihood(parts, Noises(*np.exp(logs).tolist()), weight)

    found = minimize(
        score,
        np.clip(np.log(values), *bounds.T),
        method="L-BFGS-B",
        bounds=bounds.tolist(),
        options={"eps": SLOPE_STEP, "ftol": 1e-8, "maxiter": steps},
    )
    return Noises(*np.exp(found.x).tolist())


def profile_end(
    score: Callable[[float, float], float],
    best: tuple[float, float],
    side: float,
    bound: float,
) -> float | None:
    """End of a 95 % profile-likelihood interval, None where it lies beyond a bound.

    Parameters
    ----------
    score : callable
        -ln p of ln of the parameter and ln of the other one, which is maximised out where there is
        one.
    best : (float, float)
        Where it is least.
    side : float
        -1.0 for the low end, +1.0 for the high one.
    bound : float
        Of ln of the parameter.
    """
    least, other, root = score(*best), best[1], float(np.sqrt(PROFILE_DROP))

    @cache  # where the other parameter is sought from depends on the call before
    def excess(distance: float) -> float:
        """How far √(drop), which is nearly a line, lies above that of the interval's end."""
        nonlocal other
        if distance == 0.0:
            return -root
        lowest, other = _lowest(lambda at: score(best[0] + side * distance, at), other)
        return float(np.sqrt(max(lowest - least, 0.0)) - root)

    reach = side * (bound - best[0])
    far = min(FIRST_REACH, reach)
    while excess(far) < 0.0:
        if far == reach:
            return None
        far = min(2.0 * far, reach)
    return float(best[0] + side * brentq(excess, 0.0, far, xtol=1e-3 * far))


def _lowest(score: Callable[[float], float], near: float) -> tuple[float, float]:
    """Least value of a score and where it is, by parabolas from near there."""
    for _ in range(PARABOLAS):
        left, middle, right = (score(near + k * BEND_STEP) for k in (-1.0, 0.0, 1.0))
        if left == middle == right:  # there is no other parameter
            return middle, near
        bend = left - 2.0 * middle + right
        step = 0.5 * (left - right) / bend if bend > 0.0 else np.sign(left - right) * FAR_STEPS
        near += float(np.clip(step, -FAR_STEPS, FAR_STEPS)) * BEND_STEP
        if bend > 0.0 and abs(step) <= 1.0:
            return middle - 0.125 * (left - right) ** 2 / bend, near
    return score(near), near
