"""What would explain the innovations better than noise: a bias, a scale, a turn, a step.

The filter is linear. Whatever adds a known signal to the measurements or to the acceleration adds
to the innovations what the same filter, with the same gains, makes of that signal. So each
hypothesis is a column, the response of the innovations to its unit, and generalised least squares
(whitened by √S) gives its size, its standard deviation and its likelihood (Willsky and Jones 1976,
the generalised likelihood ratio). What could pass for it is fitted along: constant accelerometer
biases, a turn of the frame, and a slow error of the acceleration as a tilt of the attitude makes
it.

A scale also acts on the noise of the acceleration, so that its regression would be biased (errors
in variables): it is estimated by the likelihood itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.kalman import Settings
from px4fuse.filter.likelihood import Preintegrated, parabola_vertex, preintegrate, recursion
from px4fuse.filter.signals import Axis, Segment, ned_acceleration, project_acceleration
from px4fuse.flight import AXIS_NAMES, QUATERNION_COLUMNS, Flight, Unavailable

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
# The vehicle's own reading is relied on across this time, in which bursts of outliers end
BURST_S = 1.0
# A run of outliers that begins within this time after a step belongs to it
AFTER_STEP_S = 6.0
# Chance that a flight without a step shows one anywhere
STEP_FALSE_ALARM = 1e-4
# Mean NIS of what follows a step that is one: of outliers that end, it stays far above 1
STEP_NIS = 2.5
MAX_JUMPS = 3
# Measurements that a step must have on either side
EDGE = 8


@dataclass(frozen=True)
class Estimate:
    """A number and its standard deviation."""

    value: float
    sigma: float

    @property
    def significance(self) -> float:
        """How many standard deviations it is from zero."""
        return abs(self.value) / self.sigma


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
    scale : Estimate
        Distances of the source over those that the IMU gives, minus 1.
    jumps : tuple of Jump
    sigma_a_m_s2 : float
        White noise of the acceleration that is left.
    count : int
        Measurements that were used.
    """

    forward_bias: Estimate
    right_bias: Estimate
    scale: Estimate
    jumps: tuple[Jump, ...]
    sigma_a_m_s2: float
    count: int


@dataclass(frozen=True)
class Signals:
    """Signals of one axis, of which the first is what was measured, the others columns.

    Attributes
    ----------
    position_m, velocity_m_s : ndarray, shape (m, k)
        What the acceleration of each adds between consecutive measurements.
    measured_m : ndarray, shape (m, k)
    start_m : ndarray, shape (k,)
    """

    position_m: Array
    velocity_m_s: Array
    measured_m: Array
    start_m: Array


@dataclass(frozen=True)
class Whitened:
    """Innovations over √S: data, shape (n,), columns, shape (n, k), and Σ ln S."""

    data: Array
    columns: Array
    log_s: float


@dataclass(frozen=True)
class Fit:
    """Generalised least squares: coefficients, their covariance, and what remains.

    ``square`` is the sum of squares that remains, ``spread`` their root mean, 1 where the noises
    are right, and ``score`` the restricted negative log-likelihood.
    """

    coefficients: Array
    covariance: Array
    square: float
    score: float
    spread: float

    def estimate(self, column: int) -> Estimate:
        """One coefficient, its σ widened where more remains than the noises say."""
        sigma = float(np.sqrt(self.covariance[column, column])) * max(self.spread, 1.0)
        return Estimate(float(self.coefficients[column]), sigma)


def respond(
    legs: Preintegrated, signals: Signals, sigma_a: float, sigma_z: float, skip: BoolArray
) -> tuple[Array, Array]:
    """Innovations over √S of many signals, all by the gains of one filter.

    Parameters
    ----------
    legs : Preintegrated
        Of the axis: its lengths and noises are used.
    signals : Signals
        k of them.
    sigma_a, sigma_z : float
        m/s² and m.
    skip : ndarray of bool, shape (m,)
        Measurements that are not fused.

    Returns
    -------
    normalised : ndarray, shape (m, k)
    s : ndarray, shape (m,)
    """
    r = sigma_z**2
    gains = [
        (s, 0.0, 0.0) if skipped else (s, k0, covariance[1] / r)
        for (_, s, k0, _, _, covariance), skipped in zip(
            recursion(legs, sigma_a, sigma_z, skip), skip.tolist(), strict=True
        )
    ]
    position, velocity = signals.start_m.copy(), np.zeros_like(signals.start_m)
    out = np.empty_like(signals.measured_m)
    for k, (dt, (_, k0, k1)) in enumerate(zip(legs.length_s.tolist(), gains, strict=True)):
        position += dt * velocity + signals.position_m[k]
        velocity += signals.velocity_m_s[k]
        innovation = signals.measured_m[k] - position
        out[k] = innovation
        position += k0 * innovation
        velocity += k1 * innovation
    s = np.array([gain[0] for gain in gains])
    return out / np.sqrt(s)[:, None], s


def fit(white: Whitened, prior: Array) -> Fit:
    """Regress whitened innovations on their columns.

    Parameters
    ----------
    white : Whitened
    prior : ndarray, shape (k,)
        Standard deviation of each coefficient before the data, infinite where nothing is known.
    """
    X, y = white.columns, white.data
    information = X.T @ X + np.diag(prior**-2.0)
    # a column that nothing excites (a turn in hover) must not stop the others
    information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(len(prior))
    factor = cho_factor(information)
    covariance = cho_solve(factor, np.eye(len(prior)))
    coefficients = covariance @ (X.T @ y)
    square = float(y @ y - coefficients @ (X.T @ y))
    log_determinant = float(np.sum(np.log(np.diag(factor[0]))))
    return Fit(
        coefficients,
        covariance,
        square,
        0.5 * (square + white.log_s) + log_determinant,
        float(np.sqrt(max(square, 0.0) / max(len(y) - CONSTANTS, 1))),
    )


@dataclass(frozen=True)
class _Lines:
    """Axes with their columns: what every hypothesis is fitted on."""

    time_s: Array
    legs: tuple[Preintegrated, ...]
    signals: tuple[Signals, ...]
    prior: Array
    sigma_z_m: float

    def whiten(
        self, sigma_a: float, skip: BoolArray, scale: float = 1.0, steps: Array | None = None
    ) -> Whitened:
        """Whitened innovations with the acceleration (and its noise) scaled.

        ``steps``, shape (m, j), are signals added to the measurements of each axis in turn: j
        further columns per axis.
        """
        data, columns, log_s = [], [], 0.0
        extra = 0 if steps is None else steps.shape[1]
        for at, (legs, signals) in enumerate(zip(self.legs, self.signals, strict=True)):
            used = _scaled(signals, scale)
            if steps is not None:
                used = _with_measured(used, steps)
            normalised, s = respond(legs, used, scale * sigma_a, self.sigma_z_m, skip)
            own = normalised[~skip]
            width = signals.measured_m.shape[1]
            block = np.zeros((len(own), width - 1 + extra * len(self.legs)))
            block[:, : width - 1] = own[:, 1:width]
            start = width - 1 + extra * at
            block[:, start : start + extra] = own[:, width:]
            data.append(own[:, 0])
            columns.append(block)
            log_s += float(np.sum(np.log(s[~skip])))
        return Whitened(np.concatenate(data), np.vstack(columns), log_s)


def _scaled(signals: Signals, scale: float) -> Signals:
    """Acceleration in the source's own length: of what was measured, and of a turn of it."""
    factor = np.ones(signals.position_m.shape[1])
    factor[[0, 1 + TURN]] = scale
    return replace(
        signals,
        position_m=signals.position_m * factor,
        velocity_m_s=signals.velocity_m_s * factor,
    )


def _with_measured(signals: Signals, added: Array) -> Signals:
    still = np.zeros_like(added)
    return Signals(
        np.hstack([signals.position_m, still]),
        np.hstack([signals.velocity_m_s, still]),
        np.hstack([signals.measured_m, added]),
        np.concatenate([signals.start_m, np.zeros(added.shape[1])]),
    )


def explained(
    flight: Flight,
    axes: tuple[Axis, ...],
    segment: Segment,
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    clock_offset_s: float = 0.0,
) -> Explained | Unavailable:
    """Estimate biases and scale, and look for jumps of the source.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    segment : Segment
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
    lines = _lines(flight, axes, segment, settings, sigma_z_m, clock_offset_s)
    if isinstance(lines, Unavailable):
        return lines
    skip = np.isin(axes[0].measurement_time_s[-len(lines.time_s) :], outlier_time_s)
    if np.count_nonzero(~skip) < MIN_MEASUREMENTS:
        return _too_few(int(np.count_nonzero(~skip)))
    levels = sigma_a_m_s2 * SIGMA_A_FACTORS
    fits = [fit(lines.whiten(float(level), skip), lines.prior) for level in levels]
    best = int(np.argmin([each.score for each in fits]))
    sigma_a, found = float(levels[best]), fits[best]
    return Explained(
        found.estimate(FORWARD),
        found.estimate(RIGHT),
        _scale(lines, sigma_a, skip),
        _jumps(lines, sigma_a, skip),
        sigma_a,
        int(np.count_nonzero(~skip)),
    )


def _too_few(count: int) -> Unavailable:
    return Unavailable(
        "causes beyond noise",
        f"{count} measurements are too few (at least {MIN_MEASUREMENTS})",
        "Analyse a longer segment, or log the source at a higher rate.",
    )


def _lines(
    flight: Flight,
    axes: tuple[Axis, ...],
    segment: Segment,
    settings: Settings,
    sigma_z: float,
    clock_offset_s: float,
) -> _Lines | Unavailable:
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        return acceleration
    if isinstance(axes[0].acceleration, Unavailable):
        return axes[0].acceleration
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if len(axes[0].measurement_time_s) <= MIN_MEASUREMENTS:
        return _too_few(len(axes[0].measurement_time_s))
    shifted = [
        replace(axis, measurement_time_s=axis.measurement_time_s + clock_offset_s) for axis in axes
    ]
    settings = replace(settings, input="imu")
    legs = tuple(preintegrate(axis, settings) for axis in shifted)
    time_s = shifted[0].measurement_time_s[-len(legs[0].measurement_m) :]
    common = _common_columns(flight.attitude, acceleration)
    hats = _hats(time_s[0], time_s[-1])
    prior = np.concatenate(
        [np.full(CONSTANTS, np.inf), np.full(len(axes) * len(hats), TILT_SIGMA_RAD * constants.g)]
    )
    signals = []
    for at, (axis, own) in enumerate(zip(shifted, legs, strict=True)):
        still = np.zeros_like(own.length_s)
        moved = [(own.delta_position_m, own.delta_velocity_m_s)]
        moved += [_moved(axis, frame, segment, settings) for frame in common]
        for group in range(len(axes)):
            moved += [
                _moved(axis, _along(hat, axis.direction), segment, settings)
                if group == at
                else (still, still)
                for hat in hats
            ]
        position, velocity = (np.stack(part, axis=1) for part in zip(*moved, strict=True))
        measured, start = np.zeros_like(position), np.zeros(position.shape[1])
        measured[:, 0], start[0] = own.measurement_m, own.initial.position_m
        signals.append(Signals(position, velocity, measured, start))
    return _Lines(time_s, legs, tuple(signals), prior, sigma_z)


def _common_columns(attitude: pd.DataFrame, acceleration: pd.DataFrame) -> list[pd.DataFrame]:
    """NED acceleration that takes out a bias forward and right, and that a turn adds."""
    body_to_ned = Rotation.from_quat(
        attitude[QUATERNION_COLUMNS].to_numpy(copy=True), scalar_first=True
    )
    names: list[Any] = list(AXIS_NAMES)
    biases = [
        pd.DataFrame(body_to_ned.apply(np.eye(3)[axis]), index=attitude.index, columns=names)
        for axis in (FORWARD, RIGHT)
    ]
    north, east, _ = acceleration.to_numpy().T
    turned = np.column_stack([-east, north, np.zeros(len(north))])
    return [*biases, pd.DataFrame(turned, index=acceleration.index, columns=names)]


def _hats(start_s: float, end_s: float) -> list[pd.Series]:
    """Hat functions between knots, of which any slow signal is made."""
    count = int(np.clip(np.ceil((end_s - start_s) / KNOT_S), 1, MAX_KNOTS)) + 1
    knots = np.linspace(start_s, end_s, count)
    # so fine that no interval passes for a gap
    time = np.linspace(start_s, end_s, 20 * (count - 1) + 1)
    return [pd.Series(np.interp(time, knots, hat), index=time) for hat in np.eye(count)]


def _along(values: pd.Series, direction: Array) -> pd.DataFrame:
    """A signal along a direction, in NED."""
    return pd.DataFrame(
        np.outer(values.to_numpy(), direction), index=values.index, columns=list(AXIS_NAMES)
    )


def _moved(
    axis: Axis, acceleration: pd.DataFrame, segment: Segment, settings: Settings
) -> tuple[Array, Array]:
    """What another acceleration adds to position and velocity between the measurements."""
    projected = project_acceleration(acceleration, axis.direction, segment)
    legs = preintegrate(replace(axis, acceleration=projected), settings)
    return legs.delta_position_m, legs.delta_velocity_m_s


def _scale(lines: _Lines, sigma_a: float, skip: BoolArray) -> Estimate:
    """Scale of the source minus 1, from the likelihood of a few; a turn's share is put back."""
    fits = [fit(lines.whiten(sigma_a, skip, scale=float(scale)), lines.prior) for scale in SCALES]
    # with S's logarithm, which grows with the scale, this would be biased towards zero
    score = np.array([each.square / 2.0 for each in fits])
    at = int(np.clip(np.argmin(score), 1, len(SCALES) - 2))
    shift, bend = parabola_vertex(score, at)
    step = float(SCALES[1] - SCALES[0])
    if bend <= 0.0:
        return Estimate(0.0, float("inf"))
    found = SCALES[at] + float(np.clip(shift, -1.5, 1.5)) * step
    sigma = step / np.sqrt(bend) * max(fits[at].spread, 1.0)
    turned = np.hypot(1.0, fits[at].coefficients[TURN])
    return Estimate(float(found * turned - 1.0), float(sigma))


def _jumps(lines: _Lines, sigma_a: float, skip: BoolArray) -> tuple[Jump, ...]:
    """Steps of the source that stay, the largest first found, in order of time.

    Times are proposed by a scan over all, and by where runs of outliers begin: a step begins with
    one. Each is then judged without what follows within a second, by what the vehicle's own
    reading makes of the rest, so that a burst of outliers is none.
    """
    jumps: list[Jump] = []
    found = skip
    for _ in range(MAX_JUMPS):
        known = _steps(lines.time_s, [jump.time_s for jump in jumps])
        starts = np.flatnonzero(found & ~np.concatenate([[False], found[:-1]]))
        proposed = [float(lines.time_s[at]) for at in starts]
        proposed += _scan(lines, sigma_a, found, known)
        judged = [_judge(lines, sigma_a, found, known, time_s) for time_s in proposed]
        named = [jump for jump in judged if jump is not None]
        if not named:
            break
        best = max(named, key=lambda jump: jump.chi_square)
        jumps.append(best)
        found = found & ~_from(lines.time_s, best.time_s, AFTER_STEP_S)
    return tuple(sorted(jumps, key=lambda jump: jump.time_s))


def _from(time_s: Array, start_s: float, length_s: float) -> BoolArray:
    return np.asarray((time_s >= start_s) & (time_s < start_s + length_s))


def _steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Unit steps of the measurements, shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)


def _scan(lines: _Lines, sigma_a: float, skip: BoolArray, known: Array) -> list[float]:
    """The time at which a step would explain most, where that is more than chance would."""
    white = lines.whiten(sigma_a, skip, steps=known)
    base = fit(white, np.append(lines.prior, np.full(len(lines.legs) * known.shape[1], np.inf)))
    times = lines.time_s[EDGE:-EDGE]
    times = times[:: max(1, -(-len(times) // MAX_STEPS))]
    if not len(times):
        return []
    candidates = _steps(lines.time_s, times)
    still = np.zeros_like(candidates)
    signals = Signals(still, still, candidates, np.zeros(len(times)))
    rest = white.data - white.columns @ base.coefficients
    chi_square = np.zeros(len(times))
    rows = np.count_nonzero(~skip)
    for at, legs in enumerate(lines.legs):
        response = respond(legs, signals, sigma_a, lines.sigma_z_m, skip)[0][~skip]
        own = slice(at * rows, (at + 1) * rows)
        mixed = white.columns[own].T @ response
        size = np.sum(response**2, axis=0) - np.sum(mixed * (base.covariance @ mixed), axis=0)
        chi_square += (rest[own] @ response) ** 2 / np.maximum(size, 1e-9)
    chi_square /= max(base.spread, 1.0) ** 2
    best = int(np.argmax(chi_square))
    if chi_square[best] < chi2.isf(STEP_FALSE_ALARM / len(lines.time_s), len(lines.legs)):
        return []
    return [float(times[best])]


def _judge(
    lines: _Lines, sigma_a: float, skip: BoolArray, known: Array, time_s: float
) -> Jump | None:
    """A step at a time, where what comes later still asks for it; None where it does not."""
    after = _from(lines.time_s, time_s, AFTER_STEP_S)
    burst = _from(lines.time_s, time_s, BURST_S)
    steps = np.hstack([known, _steps(lines.time_s, [time_s])])
    prior = np.append(lines.prior, np.full(len(lines.legs) * steps.shape[1], np.inf))
    columns = len(lines.prior) + steps.shape[1] * (1 + np.arange(len(lines.legs))) - 1
    later = (skip & ~after) | burst
    before = np.count_nonzero(~later & (lines.time_s < time_s))
    if min(before, np.count_nonzero(~later & (lines.time_s >= time_s))) < EDGE:
        return None
    white = lines.whiten(sigma_a, later, steps=steps)
    found = fit(white, prior)
    size, covariance = found.coefficients[columns], found.covariance[np.ix_(columns, columns)]
    chi_square = float(size @ np.linalg.solve(covariance, size)) / max(found.spread, 1.0) ** 2
    if chi_square < chi2.isf(STEP_FALSE_ALARM, len(columns)):
        return None
    rest = white.data - white.columns @ found.coefficients
    near = np.tile(after[~later], len(lines.legs))
    if np.mean(rest[near] ** 2) > STEP_NIS * max(found.spread, 1.0) ** 2:
        return None
    # its size from all, now that it is known to be one
    whole = fit(lines.whiten(sigma_a, skip & ~after, steps=steps), prior)
    return Jump(time_s, tuple(whole.estimate(int(at)) for at in columns), chi_square)
