"""Biases, scale and jumps that explain the innovations better than noise does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtri

from px4fuse.arrays import Array, BoolArray
from px4fuse.display import brief
from px4fuse.filter.hypotheses import (
    CAUSES,
    FORWARD,
    MIN_MEASUREMENTS,
    RIGHT,
    TURN,
    Estimate,
    Hypotheses,
    HypothesisFit,
    hypotheses_of,
    steps,
)
from px4fuse.filter.likelihood import parabola_vertex
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, too_few
from px4fuse.flight import Flight, Unavailable

# With biases and tilt taken out, less noise of the acceleration is left than the filter needs
SIGMA_A_FACTORS = np.geomspace(0.2, 2.0, 7)
SCALES = np.linspace(0.7, 1.3, 7)
# A step is sought at no more times than these
MAX_STEPS = 800
# So many of them are tried together: the responses of all would be the largest arrays of a run
STEPS_AT_ONCE = 200
# The vehicle's own reading is relied on across this time, in which bursts of outliers end
BURST_S = 1.0
# A run of outliers that begins within this time after a step belongs to it
AFTER_STEP_S = 6.0
# Chance that a flight without a step shows one anywhere
STEP_FALSE_ALARM = 1e-3
# Mean NIS of what follows a step that is one: of outliers that end, it stays far above 1
STEP_NIS = 2.5
MAX_JUMPS = 3
BIAS_M_S2 = 0.2  # half of EKF2's own limit, EKF2_ABL_LIM
BIAS_SIGMAS = 4.0  # 6e-5 of clean flights lie beyond
# Measurements that a step must have on either side
EDGE = 8


@dataclass(frozen=True)
class Jump:
    """A step of the source that stays: time (s), size along each axis (m), and its χ²."""

    time_s: float
    step_m: tuple[Estimate, ...]
    chi_square: float

    @property
    def size_m(self) -> float:
        """Length of the step."""
        return float(np.hypot.reduce([step.value for step in self.step_m]))


@dataclass(frozen=True)
class Explained:
    """What explains the innovations of some axes better than noise alone.

    Attributes
    ----------
    forward_bias, right_bias : Estimate
        Accelerometer bias (m/s²) along the body's axes; a constant tilt of the attitude is the
        same where the nose keeps its heading.
    turn : Estimate
        Of the source's frame against the attitude (rad, clockwise seen from above), with the biases
        accounted for.
    scale : Estimate
        Distances of the source over those that the IMU gives, minus 1.
    jumps : tuple of Jump
    sigma_a_m_s2 : float
        White noise of the acceleration that is left.
    """

    forward_bias: Estimate
    right_bias: Estimate
    turn: Estimate
    scale: Estimate
    jumps: tuple[Jump, ...]
    sigma_a_m_s2: float

    __repr__ = brief

    @property
    def bias(self) -> Estimate:
        """Size of both biases together (m/s²)."""
        forward, right = self.forward_bias, self.right_bias
        return Estimate(
            math.hypot(forward.value, right.value), math.hypot(forward.sigma, right.sigma)
        )

    @property
    def biased(self) -> bool:
        """Whether the accelerometer has a bias that matters, beyond chance."""
        return self.bias.value >= max(BIAS_M_S2, BIAS_SIGMAS * self.bias.sigma)


def explained(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    clock_offset_s: float,
) -> Explained | Unavailable:
    """Estimate biases and scale, and look for jumps of the source.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_a_m_s2, sigma_z_m : float
        Noises that the two-state filter needs.
    outlier_time_s : ndarray
        Measurements to leave out.
    clock_offset_s : float
        Added to the stamps first.

    Returns
    -------
    Explained, or Unavailable where there is no acceleration or too few measurements.
    """
    model = hypotheses_of(flight, axes, settings, sigma_z_m, clock_offset_s)
    if isinstance(model, Unavailable):
        return model
    skip = np.isin(axes[0].measurement_time_s[-len(model.time_s) :], outlier_time_s)
    if (count := int(np.count_nonzero(~skip))) < MIN_MEASUREMENTS:
        return too_few(CAUSES, count, MIN_MEASUREMENTS)
    levels = sigma_a_m_s2 * SIGMA_A_FACTORS
    sigma_a, found = _fit_noise(model, levels, skip)
    jumps = _jumps(model, sigma_a, skip)
    if jumps:
        for jump in jumps:
            skip = skip & ~_from(model.time_s, jump.time_s, AFTER_STEP_S)
        model = replace(model, steps=steps(model.time_s, [jump.time_s for jump in jumps]))
        sigma_a, found = _fit_noise(model, levels, skip)
    return Explained(
        found.estimate(FORWARD),
        found.estimate(RIGHT),
        found.estimate(TURN),
        _scale(model, sigma_a, skip),
        jumps,
        sigma_a,
    )


def _fit_noise(model: Hypotheses, levels: Array, skip: BoolArray) -> tuple[float, HypothesisFit]:
    """The most likely of some SIGMA_A, and what is fitted with it."""
    fitted = cache(lambda at: model.fit(float(levels[at]), skip))
    best = _lowest(lambda at: fitted(at).score, len(levels))
    return float(levels[best]), fitted(best)


def _lowest(score: Callable[[int], float], count: int) -> int:
    """Index of the least of some scores that have one minimum, sought from the middle."""
    at = count // 2
    step = 1 if at + 1 < count and score(at + 1) < score(at) else -1
    while 0 <= at + step < count and score(at + step) < score(at):
        at += step
    return at


def _scale(model: Hypotheses, sigma_a: float, skip: BoolArray) -> Estimate:
    """Scale of the source minus 1, from the likelihood of a few; a turn's share is put back."""
    fitted = cache(lambda at: model.fit(sigma_a, skip, float(SCALES[at])))
    # with S's logarithm, which grows with the scale, this would be biased towards zero
    lowest = _lowest(lambda at: fitted(at).square, len(SCALES))
    at = int(np.clip(lowest, 1, len(SCALES) - 2))
    score = np.array([fitted(near).square / 2.0 for near in (at - 1, at, at + 1)])
    shift, bend = parabola_vertex(score, 1)
    step = float(SCALES[1] - SCALES[0])
    if bend <= 0.0:
        return Estimate(0.0, float("inf"))
    found = SCALES[at] + float(np.clip(shift, -1.5, 1.5)) * step
    sigma = step / np.sqrt(bend) * max(fitted(at).spread, 1.0)
    turned = np.hypot(1.0, fitted(at).coefficients[TURN])
    return Estimate(float(found * turned - 1.0), float(sigma))


def _jumps(model: Hypotheses, sigma_a: float, skip: BoolArray) -> tuple[Jump, ...]:
    """Steps of the source that stay, the largest first found, in order of time.

    Times are proposed by a scan over all, and by where runs of outliers begin: a step begins with
    one. Each is then judged without what follows within a second, by what the vehicle's own
    reading makes of the rest, so that a burst of outliers is none.
    """
    jumps: list[Jump] = []
    found = skip
    for _ in range(MAX_JUMPS):
        model = replace(model, steps=steps(model.time_s, [jump.time_s for jump in jumps]))
        starts = np.flatnonzero(found & ~np.concatenate([[False], found[:-1]]))
        proposed = [float(model.time_s[at]) for at in starts]
        proposed += _scan(model, sigma_a, found)
        chance = STEP_FALSE_ALARM / max(len(proposed), 1)
        judged = [_judge(model, sigma_a, found, time_s, chance) for time_s in proposed]
        named = [jump for jump in judged if jump is not None]
        if not named:
            break
        best = max(named, key=lambda jump: jump.chi_square)
        jumps.append(best)
        found = found & ~_from(model.time_s, best.time_s, AFTER_STEP_S)
    return tuple(sorted(jumps, key=lambda jump: jump.time_s))


def _from(time_s: Array, start_s: float, length_s: float) -> BoolArray:
    return np.asarray((time_s >= start_s) & (time_s < start_s + length_s))


def _scan(model: Hypotheses, sigma_a: float, skip: BoolArray) -> list[float]:
    """The time at which a step would explain most, where that is more than chance would."""
    base = model.fit(sigma_a, skip)
    times = model.time_s[EDGE:-EDGE]
    times = times[:: max(1, -(-len(times) // MAX_STEPS))]
    if not len(times):
        return []
    # what a step at each time takes away of the squares, summed over the axes
    chi_square = np.zeros(len(times))
    for axis in range(len(model.legs)):
        rows = base.axis == axis
        columns, rest = base.columns[rows], base.rest[rows]
        for few in np.array_split(np.arange(len(times)), -(-len(times) // STEPS_AT_ONCE)):
            response = model.respond(axis, steps(model.time_s, times[few]), sigma_a, skip)
            mixed = columns.T @ response
            size = np.sum(response**2, axis=0) - np.sum(mixed * (base.covariance @ mixed), axis=0)
            chi_square[few] += (rest @ response) ** 2 / np.maximum(size, 1e-9)
    chi_square /= max(base.spread, 1.0) ** 2
    best = int(np.argmax(chi_square))
    if chi_square[best] < chdtri(len(model.legs), STEP_FALSE_ALARM / len(model.time_s)):
        return []
    return [float(times[best])]


def _judge(
    model: Hypotheses, sigma_a: float, skip: BoolArray, time_s: float, chance: float
) -> Jump | None:
    """A step at a time, where what comes later still asks for it; None where that is chance."""
    after = _from(model.time_s, time_s, AFTER_STEP_S)
    burst = _from(model.time_s, time_s, BURST_S)
    model = replace(model, steps=np.hstack([model.steps, steps(model.time_s, [time_s])]))
    columns = len(model.prior) + model.steps.shape[1] * (1 + np.arange(len(model.legs))) - 1
    later = (skip & ~after) | burst
    before = np.count_nonzero(~later & (model.time_s < time_s))
    if min(before, np.count_nonzero(~later & (model.time_s >= time_s))) < EDGE:
        return None
    found = model.fit(sigma_a, later)
    size, covariance = found.coefficients[columns], found.covariance[np.ix_(columns, columns)]
    chi_square = float(size @ np.linalg.solve(covariance, size)) / max(found.spread, 1.0) ** 2
    if chi_square < chdtri(len(columns), chance):
        return None
    near = np.tile(after[~later], len(model.legs))
    if np.mean(found.rest[near] ** 2) > STEP_NIS * max(found.spread, 1.0) ** 2:
        return None
    # its size from all, now that it is known to be one
    whole = model.fit(sigma_a, skip & ~after)
    return Jump(time_s, tuple(whole.estimate(int(at)) for at in columns), chi_square)
