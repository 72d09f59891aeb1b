"""Biases, scale and jumps that explain the innovations better than noise does.

The filter is linear. Whatever adds a known signal to the measurements or to the acceleration adds
to the innovations what the same filter, with the same gains, makes of that signal. So each
hypothesis is a column, the response of the innovations to its unit, and generalised least squares
(whitened by √S) gives its size, its standard deviation and its likelihood (Willsky and Jones 1976,
the generalised likelihood ratio). What could pass for it is fitted along: constant accelerometer
biases, a turn of the frame, and a slow error of the acceleration as a tilt of the attitude makes
it.

A scale also acts on the noise of the acceleration, so that its regression would be biased (errors
in variables): what remains is weighed by the variance that it has at each scale (Deming 1943).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from px4fuse.arrays import Array, BoolArray, IntArray, cumulative_integral
from px4fuse.display import brief
from px4fuse.filter.likelihood import (
    Preintegrated,
    innovations,
    moved,
    parabola_vertex,
    preintegrate,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, ned_acceleration, too_few
from px4fuse.filter.steps import Timeline, timeline
from px4fuse.flight import Columns, Flight, Unavailable

CAUSES = "causes beyond noise"
MIN_MEASUREMENTS = 50
# Slow error of the logged attitude: its root mean square, and how far apart it is independent
TILT_SIGMA_RAD = 0.002
KNOT_S = 15.0
MAX_KNOTS = 40
FORWARD, RIGHT, TURN = range(3)
CONSTANTS = 3
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
# Chance that a measurement that is no outlier beside a step is taken for one; places of it tried
AGREES, PLACES = 1e-3, 6
MAX_JUMPS = 3
BIAS_M_S2 = 0.2  # half of EKF2's own limit, EKF2_ABL_LIM
BIAS_SIGMAS = 4.0  # 6e-5 of clean flights lie beyond
# Measurements that a step must have on either side
EDGE = 8


@dataclass(frozen=True)
class Estimate:
    """A number and its standard deviation."""

    value: float
    sigma: float


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
        one, other = self.forward_bias, self.right_bias
        return Estimate(math.hypot(one.value, other.value), math.hypot(one.sigma, other.sigma))

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
    jumps, skip = _jumps(model, sigma_a, skip)
    if jumps:
        model = replace(model, steps=steps(model.time_s, [jump.time_s for jump in jumps]))
        sigma_a, found = _fit_noise(model, levels, skip)
    forward, right, turn = map(found.estimate, (FORWARD, RIGHT, TURN))
    return Explained(forward, right, turn, _scale(model, sigma_a, skip), jumps, sigma_a)


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


def _jumps(
    model: Hypotheses, sigma_a: float, skip: BoolArray
) -> tuple[tuple[Jump, ...], BoolArray]:
    """Steps of the source that stay, in order of time, and what is an outlier beside them.

    Times are proposed by a scan over all, and by where runs of outliers begin: a step begins with
    one. Each is then judged without what follows within a second, so that a burst of outliers is
    none. Where exactly it is, which its size depends on, is found last.
    """
    jumps: list[Jump] = []
    for _ in range(MAX_JUMPS):
        model = replace(model, steps=steps(model.time_s, [jump.time_s for jump in jumps]))
        starts = model.time_s[np.flatnonzero(skip & ~np.concatenate([[False], skip[:-1]]))]
        proposed = [*_scan(model, sigma_a, skip, starts), *_scan(model, sigma_a, skip)[:1]]
        chance = STEP_FALSE_ALARM / max(len(starts), 1)
        judged = [_judge(model, sigma_a, skip, time_s, chance) for time_s in proposed]
        named = [jump for jump in judged if jump is not None]
        if not named:
            break
        best, skip = _placed(model, sigma_a, skip, max(named, key=lambda jump: jump.chi_square))
        jumps.append(best)
    return tuple(sorted(jumps, key=lambda jump: jump.time_s)), skip


def _from(time_s: Array, start_s: float, length_s: float) -> BoolArray:
    return np.asarray((time_s >= start_s) & (time_s < start_s + length_s))


def _scan(
    model: Hypotheses, sigma_a: float, skip: BoolArray, times: Array | None = None
) -> list[float]:
    """The times at which a step would explain more than chance, by default of all; most first."""
    if times is None:
        times = model.time_s[EDGE:-EDGE]
        times = times[:: max(1, -(-len(times) // MAX_STEPS))]
    if not len(times):
        return []
    chi_square = _step_squares(model, sigma_a, skip, times)
    least = chdtri(len(model.legs), STEP_FALSE_ALARM / len(model.time_s))
    order = np.argsort(-chi_square)
    return [float(times[at]) for at in order if chi_square[at] >= least]


def _step_squares(model: Hypotheses, sigma_a: float, skip: BoolArray, times: Array) -> Array:
    """χ² of a step at each time: what it takes away of the squares, summed over the axes."""
    data, columns, log_s = model.laid_out(sigma_a, skip)
    base = model.regress(data, columns, log_s, skip)
    chi_square = np.zeros(len(times))
    for few in np.array_split(np.arange(len(times)), -(-len(times) // STEPS_AT_ONCE)):
        added = steps(model.time_s, times[few])
        for axis, legs in enumerate(model.legs):
            if axis in (alike[0] for alike in model.alike):
                still = np.broadcast_to(0.0, added.shape)
                alone = _with_signals(legs, still, still, added)
                response = model.whitened(alone, sigma_a, skip)[0][~skip]
            rest, mixed = base.rest[base.axis == axis], columns[axis][~skip].T @ response
            size = np.sum(response**2, axis=0) - np.sum(mixed * (base.covariance @ mixed), axis=0)
            chi_square[few] += (rest @ response / base.spreads[axis]) ** 2 / np.maximum(size, 1e-9)
    return chi_square


def _placed(
    model: Hypotheses, sigma_a: float, skip: BoolArray, jump: Jump
) -> tuple[Jump, BoolArray]:
    """A jump at the most likely time near its own, with its size, and what is an outlier then."""
    near = np.abs(model.time_s - jump.time_s) <= BURST_S
    # with the step in the middle of what is not known, what follows is no outlier where it agrees
    square = model.with_step(jump.time_s)[0].squares(sigma_a, skip | near)
    after = near | _from(model.time_s, jump.time_s, AFTER_STEP_S)
    skip = np.where(after & ~near, square > chdtri(len(model.legs), AGREES), skip)
    times = model.time_s[near]
    likely = np.argsort(-_step_squares(model, sigma_a, skip & ~near, times))[:PLACES]
    placed = []
    for at in times[likely].tolist():
        square = model.with_step(at)[0].squares(sigma_a, skip | near)
        placed.append((at, np.where(near, square > chdtri(len(model.legs), AGREES), skip)))
    # an outlier beside a step looks like one: fewest are left where it is
    time_s, skip = min(placed, key=lambda each: np.count_nonzero(each[1]))
    stepped, columns = model.with_step(time_s)
    found = stepped.fit(sigma_a, skip)
    step_m = tuple(found.estimate(int(column)) for column in columns)
    return replace(jump, time_s=time_s, step_m=step_m), skip


def _judge(
    model: Hypotheses, sigma_a: float, skip: BoolArray, time_s: float, chance: float
) -> Jump | None:
    """A step at a time, where what comes later still asks for it; None where that is chance."""
    later = skip | _from(model.time_s, time_s, BURST_S)
    model, columns = model.with_step(time_s)
    before = np.count_nonzero(~later & (model.time_s < time_s))
    if min(before, np.count_nonzero(~later & (model.time_s >= time_s))) < EDGE:
        return None
    found = model.fit(sigma_a, later)
    size, covariance = found.coefficients[columns], found.covariance[np.ix_(columns, columns)]
    size = size / found.spreads
    chi_square = float(size @ np.linalg.solve(covariance, size))
    if chi_square < chdtri(len(columns), chance):
        return None
    return Jump(time_s, tuple(found.estimate(int(at)) for at in columns), chi_square)


@dataclass(frozen=True)
class HypothesisFit:
    """Generalised least squares of whitened innovations on their columns.

    Attributes
    ----------
    axis : ndarray of int, shape (n,)
        Which axis each row is of: all of one, then of the next.
    rest : ndarray, shape (n,)
        What the columns leave of the innovations.
    coefficients, covariance : ndarray, shape (k,) and (k, k)
    square : float
        Sum of squares that remains, what the prior adds included.
    score : float
        Restricted negative log-likelihood.
    spread : float
        Root mean square that remains, 1 where the noises are right.
    """

    axis: IntArray
    rest: Array
    coefficients: Array
    covariance: Array
    square: float
    score: float
    spread: float

    @property
    def spreads(self) -> Array:
        """Root mean square that remains along each axis, at least 1: one may be the noisier."""
        square = np.bincount(self.axis, self.rest**2) / np.bincount(self.axis)
        return np.sqrt(np.maximum(square, 1.0))

    def estimate(self, column: int) -> Estimate:
        """One coefficient, its σ widened where more remains than the noises say."""
        sigma = float(np.sqrt(self.covariance[column, column])) * max(self.spread, 1.0)
        return Estimate(float(self.coefficients[column]), sigma)


@dataclass(frozen=True)
class Hypotheses:
    """Axes with their columns: what every hypothesis is fitted on.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Of the measurements, as they were stamped.
    legs : tuple of Preintegrated
        Of each axis, with several signals: what was measured, then what each constant adds.
    hats : (ndarray, ndarray), shape (m, h)
        Position and velocity that slow accelerations add, with coefficients of their own for each
        axis.
    prior : ndarray, shape (k,)
        Standard deviations of the columns' coefficients before the data, steps left out.
    sigma_z_m : float
    steps : ndarray, shape (m, j)
        Added to the measurements, in j more columns for each axis.
    """

    time_s: Array
    legs: tuple[Preintegrated, ...]
    hats: tuple[Array, Array]
    prior: Array
    sigma_z_m: float
    steps: Array

    def with_step(self, time_s: float) -> tuple[Hypotheses, IntArray]:
        """The same with one more step, and its column of each axis."""
        model = replace(self, steps=np.hstack([self.steps, steps(self.time_s, [time_s])]))
        width, count = len(self.prior), model.steps.shape[1]
        return model, width + count * (1 + np.arange(len(self.legs))) - 1

    @cached_property
    def alike(self) -> list[list[int]]:
        """Axes with the same filter: all, but where gaps in the IMU tell less of one."""
        same = all(np.array_equal(each.noise_fixed, self.legs[0].noise_fixed) for each in self.legs)
        every = list(range(len(self.legs)))
        return [every] if same else [[axis] for axis in every]

    def whitened(self, legs: Preintegrated, sigma_a: float, skip: BoolArray) -> tuple[Array, float]:
        """Innovations over √S of signals along any axis, (m, k), and Σ ln S of those used."""
        nu, s = innovations(legs, sigma_a, self.sigma_z_m, skip)
        nu /= np.sqrt(s)[:, None]
        return nu, float(np.sum(np.log(s[~skip])))

    def fit(self, sigma_a: float, skip: BoolArray, scale: float = 1.0) -> HypothesisFit:
        """Fit all columns, with the acceleration (and its noise) scaled.

        Parameters
        ----------
        sigma_a : float
        skip : ndarray of bool, shape (m,)
            Measurements that are neither fused nor fitted.
        scale : float
        """
        return self.regress(*self.laid_out(sigma_a, skip, scale), skip)

    def regress(self, data: Array, columns: Array, log_s: float, skip: BoolArray) -> HypothesisFit:
        """Fit what :meth:`laid_out` gave, without the measurements that are left out."""
        axis = np.repeat(np.arange(len(data)), np.count_nonzero(~skip))
        data, columns = data[:, ~skip].ravel(), columns[:, ~skip].reshape(len(axis), -1)
        count = columns.shape[1]
        prior = np.append(self.prior, np.full(count - len(self.prior), np.inf))
        information = np.diag(prior**-2.0) + columns.T @ columns
        # a column that nothing excites (a turn in hover) must not stop the others
        information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(count)
        moment, factor = columns.T @ data, cho_factor(information)
        covariance = cho_solve(factor, np.eye(count))
        coefficients = covariance @ moment
        square = float(data @ data - coefficients @ moment)
        score = 0.5 * (square + log_s) + float(np.sum(np.log(np.diag(factor[0]))))
        spread = float(np.sqrt(max(square, 0.0) / max(len(data) - CONSTANTS, 1)))
        rest = data - columns @ coefficients
        return HypothesisFit(axis, rest, coefficients, covariance, square, score, spread)

    def squares(self, sigma_a: float, skip: BoolArray) -> Array:
        """What a fit leaves of every measurement, over its σ: squares summed over the axes."""
        data, columns, log_s = self.laid_out(sigma_a, skip)
        found = self.regress(data, columns, log_s, skip)
        rest = data - columns @ found.coefficients
        return np.asarray(np.sum(rest**2, axis=0)) / max(found.spread, 1.0) ** 2

    def laid_out(
        self, sigma_a: float, skip: BoolArray, scale: float = 1.0
    ) -> tuple[Array, Array, float]:
        """Whitened innovations (a, m) of all axes and their columns (a, m, k), and Σ ln S."""
        hats, steps, axes = self.hats[0].shape[1], self.steps.shape[1], len(self.legs)
        width = len(self.prior)
        data = np.empty((axes, len(skip)))
        columns = np.zeros((axes, len(skip), width + axes * steps))
        # acceleration in the source's own length: of what was measured, and of a turn of it
        factor = np.ones(1 + CONSTANTS)
        factor[[0, 1 + TURN]] = scale
        still, log_s = np.zeros_like(self.hats[0]), 0.0
        for alike in self.alike:
            legs = [self.legs[at] for at in alike]
            dp = [*(factor * each.delta_position_m for each in legs), self.hats[0]]
            dv = [*(factor * each.delta_velocity_m_s for each in legs), self.hats[1]]
            measured = [*(each.measurement_m for each in legs), still, self.steps]
            dp, dv = ([*each, 0.0 * self.steps] for each in (dp, dv))
            own = _with_signals(legs[0], *map(np.hstack, (dp, dv, measured)))
            normalised, own_log_s = self.whitened(own, scale * sigma_a, skip)
            log_s += len(alike) * own_log_s
            *each_own, common = np.split(normalised, len(factor) * np.arange(1, 1 + len(legs)), 1)
            for at, signals in zip(alike, each_own, strict=True):
                data[at] = signals[:, 0]
                first, step = CONSTANTS + hats * at, width + steps * at
                columns[at][:, :CONSTANTS] = signals[:, 1:]
                which = np.r_[first : first + hats, step : step + steps]
                columns[at][:, which] = common
        return data, columns, log_s


def _with_signals(legs: Preintegrated, dp: Array, dv: Array, measured_m: Array) -> Preintegrated:
    return replace(legs, delta_position_m=dp, delta_velocity_m_s=dv, measurement_m=measured_m)


def hypotheses_of(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    sigma_z: float,
    clock_offset_s: float,
) -> Hypotheses | Unavailable:
    """Lay out the axes with the columns that every hypothesis is fitted beside.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_z : float
        Measurement noise (m).
    clock_offset_s : float
        Added to the stamps first.
    """
    acceleration, attitude = ned_acceleration(flight), flight.attitude
    for needed in (acceleration, axes[0].acceleration, attitude):
        if isinstance(needed, Unavailable):
            return needed
    assert isinstance(acceleration, pd.DataFrame)
    assert isinstance(attitude, pd.DataFrame)
    if len(axes[0].measurement_time_s) <= MIN_MEASUREMENTS:
        return too_few(CAUSES, len(axes[0].measurement_time_s), MIN_MEASUREMENTS)
    time_s = axes[0].measurement_time_s + clock_offset_s
    shifted = [replace(axis, measurement_time_s=time_s) for axis in axes]
    settings = replace(settings, input="imu")
    line = timeline(shifted[0], settings)
    common = _common_columns(attitude, acceleration)
    legs = []
    for axis in shifted:
        own = preintegrate(axis, settings)
        columns = [(own.delta_position_m, own.delta_velocity_m_s)]
        columns += [_added(value @ axis.direction, when, line) for when, value in common]
        dp, dv = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
        measured = np.zeros_like(dp)
        # the filter starts at the first one
        measured[:, 0] = own.measurement_m - own.initial.position_m
        start = replace(own.initial, position_m=0.0)
        legs.append(replace(_with_signals(own, dp, dv, measured), initial=start))
    time_s = axes[0].measurement_time_s[-len(measured) :]
    fine, hats = _hats(time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s)
    slow = [_added(hat, fine, line) for hat in hats]
    position, velocity = (np.stack(part, axis=1) for part in zip(*slow, strict=True))
    tilt = np.full(len(axes) * len(hats), TILT_SIGMA_RAD * constants.g)
    prior = np.append(np.full(CONSTANTS, np.inf), tilt)
    return Hypotheses(time_s, tuple(legs), (position, velocity), prior, sigma_z, steps(time_s, []))


def _added(acceleration_m_s2: Array, time_s: ArrayLike, line: Timeline) -> tuple[Array, Array]:
    """Position and velocity that an acceleration adds between the measurements."""
    time = np.asarray(time_s, dtype=np.float64)
    velocity = np.interp(line.time_s, time, cumulative_integral(acceleration_m_s2, time))
    return moved(line, np.diff(velocity) / np.diff(line.time_s))


def _common_columns(
    attitude: pd.DataFrame, acceleration: pd.DataFrame
) -> list[tuple[pd.Index, Array]]:
    """NED acceleration that takes out a bias forward and right, and that a turn adds; and when."""
    quaternions = attitude[Columns.QUATERNION].to_numpy(copy=True)
    body_to_ned = Rotation.from_quat(quaternions, scalar_first=True)
    biases = [(attitude.index, body_to_ned.apply(np.eye(3)[axis])) for axis in (FORWARD, RIGHT)]
    north, east, _ = acceleration.to_numpy().T
    return [*biases, (acceleration.index, np.column_stack([-east, north, 0.0 * north]))]


def _hats(start_s: float, end_s: float) -> tuple[Array, Array]:
    """Hat functions between knots, of which any slow signal is made, at times so fine (n, h)."""
    count = int(np.clip(np.ceil((end_s - start_s) / KNOT_S), 1, MAX_KNOTS)) + 1
    time = np.linspace(start_s, end_s, 20 * (count - 1) + 1)
    knots = np.linspace(start_s, end_s, count)
    return time, np.array([np.interp(time, knots, hat) for hat in np.eye(count)])


def steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Unit steps of the measurements, shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
