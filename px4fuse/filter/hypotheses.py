"""What would explain the innovations better than noise: a bias, a scale, a turn, a step.

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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.filter.banded import driven
from px4fuse.filter.likelihood import Preintegrated, moved, preintegrate, recursion
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    Axis,
    Segment,
    ned_acceleration,
    project_acceleration,
    step_means,
)
from px4fuse.filter.steps import Timeline, timeline
from px4fuse.flight import AXIS_NAMES, QUATERNION_COLUMNS, Flight, Unavailable

MIN_MEASUREMENTS = 50
# Slow error of the logged attitude: its root mean square, and how far apart it is independent
TILT_SIGMA_RAD = 0.002
KNOT_S = 15.0
MAX_KNOTS = 40
FORWARD, RIGHT, TURN = range(3)
CONSTANTS = 3


@dataclass(frozen=True)
class Estimate:
    """A number and its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class HypothesisSignals:
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
    """Innovations over √S of some axes, each of which most columns are not about.

    Attributes
    ----------
    data : tuple of ndarray, shape (n,)
        Of each axis.
    columns : tuple of ndarray, shape (n, k)
        Those that are about it.
    which : tuple of ndarray of int, shape (k,)
        Which of all columns these are.
    log_s : float
        Σ ln S over all.
    """

    data: tuple[Array, ...]
    columns: tuple[Array, ...]
    which: tuple[IntArray, ...]
    log_s: float

    def rest(self, coefficients: Array) -> list[Array]:
        """What the columns, so many times each, leave of the data of each axis."""
        return [
            data - columns @ coefficients[which]
            for data, columns, which in zip(self.data, self.columns, self.which, strict=True)
        ]


@dataclass(frozen=True)
class HypothesisFit:
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


def gains(
    legs: Preintegrated, sigma_a: float, sigma_z: float, skip: BoolArray
) -> tuple[Array, Array]:
    """S, shape (m,), and K, shape (m, 2), of a filter; K is zero for what is not fused.

    Parameters
    ----------
    legs : Preintegrated
        Of the axis: its lengths and noises are used.
    sigma_a, sigma_z : float
        m/s² and m.
    skip : ndarray of bool, shape (m,)
        Measurements that are not fused.
    """
    made = np.array(
        [
            (s, k0, covariance[1] / sigma_z**2)
            for _, s, k0, _, _, covariance in recursion(legs, sigma_a, sigma_z, skip)
        ]
    )
    return made[:, 0], np.where(skip[:, None], 0.0, made[:, 1:])


def respond(legs: Preintegrated, signals: HypothesisSignals, s: Array, gain: Array) -> Array:
    """Innovations over √S of many signals, all by the gains of one filter, shape (m, k).

    Parameters
    ----------
    legs : Preintegrated
        Of the axis: its lengths are used.
    signals : HypothesisSignals
        k of them.
    s, gain : ndarray
        As :func:`gains` returns them.
    """
    start = np.stack([signals.start_m, np.zeros_like(signals.start_m)])
    pushed = signals.position_m, signals.velocity_m_s
    prior, _ = driven(legs.length_s, gain, *pushed, signals.measured_m, start)
    return (signals.measured_m - prior) / np.sqrt(s)[:, None]


def fit(white: Whitened, prior: Array) -> HypothesisFit:
    """Regress whitened innovations on their columns.

    Parameters
    ----------
    white : Whitened
    prior : ndarray, shape (k,)
        Standard deviation of each coefficient before the data, infinite where nothing is known.
    """
    information, moment = np.diag(prior**-2.0), np.zeros(len(prior))
    for y, X, which in zip(white.data, white.columns, white.which, strict=True):
        information[np.ix_(which, which)] += X.T @ X
        moment[which] += X.T @ y
    # a column that nothing excites (a turn in hover) must not stop the others
    information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(len(prior))
    factor = cho_factor(information)
    covariance = cho_solve(factor, np.eye(len(prior)))
    coefficients = covariance @ moment
    square = float(sum(y @ y for y in white.data) - coefficients @ moment)
    log_determinant = float(np.sum(np.log(np.diag(factor[0]))))
    return HypothesisFit(
        coefficients,
        covariance,
        square,
        0.5 * (square + white.log_s) + log_determinant,
        float(np.sqrt(max(square, 0.0) / max(sum(map(len, white.data)) - CONSTANTS, 1))),
    )


@dataclass(frozen=True)
class Lines:
    """Axes with their columns: what every hypothesis is fitted on.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Of the measurements, as they were stamped.
    legs, signals : tuple of Preintegrated and of HypothesisSignals
        Of each axis.
    hats : HypothesisSignals
        Slow accelerations, the same for each axis, but with coefficients for each.
    prior : ndarray, shape (k,)
        Standard deviations of the columns' coefficients before the data.
    sigma_z_m : float
    steps : ndarray, shape (m, j)
        Added to the measurements, in j more columns for each axis.
    """

    time_s: Array
    legs: tuple[Preintegrated, ...]
    signals: tuple[HypothesisSignals, ...]
    hats: HypothesisSignals
    prior: Array
    sigma_z_m: float
    steps: Array

    def fit(self, sigma_a: float, skip: BoolArray, scale: float = 1.0) -> HypothesisFit:
        """Fit all columns."""
        return fit(self.whiten(sigma_a, skip, scale), self.priors)

    @property
    def priors(self) -> Array:
        """Of all columns, those of the steps included."""
        return np.append(self.prior, np.full(len(self.legs) * self.steps.shape[1], np.inf))

    def whiten(self, sigma_a: float, skip: BoolArray, scale: float = 1.0) -> Whitened:
        """Whitened innovations with the acceleration (and its noise) scaled."""
        width, extra = len(self.prior), self.steps.shape[1]
        own_hats = len(self.hats.start_m)
        signals = [_scaled(each, scale) for each in self.signals]
        # the same for every axis
        shared = _joined([self.hats, _measured(self.steps)])
        data, columns, which, log_s = [], [], [], 0.0
        for at, (normalised, s) in enumerate(
            respond_each(self.legs, signals, shared, scale * sigma_a, self.sigma_z_m, skip)
        ):
            own = normalised[~skip]
            first, step = CONSTANTS + own_hats * at, width + extra * at
            data.append(own[:, 0])
            columns.append(own[:, 1:])
            which.append(np.r_[:CONSTANTS, first : first + own_hats, step : step + extra])
            log_s += float(np.sum(np.log(s[~skip])))
        return Whitened(tuple(data), tuple(columns), tuple(which), log_s)


def respond_each(
    legs: Sequence[Preintegrated],
    signals: Sequence[HypothesisSignals],
    shared: HypothesisSignals,
    sigma_a: float,
    sigma_z: float,
    skip: BoolArray,
) -> list[tuple[Array, Array]]:
    """:func:`respond` of each axis to its own signals, then to those that all axes share.

    Axes with the same legs go through one filter together.
    """
    if not same_gains(legs):
        made = [gains(leg, sigma_a, sigma_z, skip) for leg in legs]
        return [
            (respond(leg, _joined([each, shared]), *own), own[0])
            for leg, each, own in zip(legs, signals, made, strict=True)
        ]
    s, gain = gains(legs[0], sigma_a, sigma_z, skip)
    normalised = respond(legs[0], _joined([*signals, shared]), s, gain)
    widths = np.cumsum([len(each.start_m) for each in signals])
    *own_parts, of_shared = np.split(normalised, widths, axis=1)
    return [(np.hstack([own, of_shared]), s) for own in own_parts]


def same_gains(legs: Sequence[Preintegrated]) -> bool:
    """Whether the filters of some axes have the same gains."""
    return all(
        np.array_equal(getattr(legs[0], name), getattr(each, name))
        for each in legs[1:]
        for name in ("length_s", "noise_unit", "noise_fixed")
    )


def _scaled(signals: HypothesisSignals, scale: float) -> HypothesisSignals:
    """Acceleration in the source's own length: of what was measured, and of a turn of it."""
    factor = np.ones(signals.position_m.shape[1])
    factor[[0, 1 + TURN]] = scale
    return replace(
        signals,
        position_m=signals.position_m * factor,
        velocity_m_s=signals.velocity_m_s * factor,
    )


def _joined(signals: Sequence[HypothesisSignals]) -> HypothesisSignals:
    return HypothesisSignals(
        np.hstack([each.position_m for each in signals]),
        np.hstack([each.velocity_m_s for each in signals]),
        np.hstack([each.measured_m for each in signals]),
        np.hstack([each.start_m for each in signals]),
    )


def _measured(added: Array) -> HypothesisSignals:
    """Signals that only the measurements have."""
    still = np.broadcast_to(0.0, added.shape)
    return HypothesisSignals(still, still, added, np.zeros(added.shape[1]))


def too_few(count: int) -> Unavailable:
    """What stands in for an estimate from so few measurements."""
    return Unavailable(
        "causes beyond noise",
        f"{count} measurements are too few (at least {MIN_MEASUREMENTS})",
        "Analyse a longer segment, or log the source at a higher rate.",
    )


def lines_of(
    flight: Flight,
    axes: tuple[Axis, ...],
    segment: Segment,
    settings: Settings,
    sigma_z: float,
    clock_offset_s: float,
) -> Lines | Unavailable:
    """Lay out the axes with the columns that every hypothesis is fitted beside.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        Horizontal, with the same measurement times.
    segment : Segment
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_z : float
        Measurement noise (m).
    clock_offset_s : float
        Added to the stamps first.
    """
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        return acceleration
    if isinstance(axes[0].acceleration, Unavailable):
        return axes[0].acceleration
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if len(axes[0].measurement_time_s) <= MIN_MEASUREMENTS:
        return too_few(len(axes[0].measurement_time_s))
    shifted = [
        replace(axis, measurement_time_s=axis.measurement_time_s + clock_offset_s) for axis in axes
    ]
    settings = replace(settings, input="imu")
    legs = tuple(preintegrate(axis, settings) for axis in shifted)
    time_s = axes[0].measurement_time_s[-len(legs[0].measurement_m) :]
    common = _common_columns(flight.attitude, acceleration)
    hats = _hats(time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s)
    prior = np.concatenate(
        [np.full(CONSTANTS, np.inf), np.full(len(axes) * len(hats), TILT_SIGMA_RAD * constants.g)]
    )
    signals = []
    line = timeline(shifted[0], settings)
    ramps = [moved(line, _step_means(hat, line)) for hat in hats]
    slow = [np.stack(part, axis=1) for part in zip(*ramps, strict=True)]
    for axis, own in zip(shifted, legs, strict=True):
        columns = [(own.delta_position_m, own.delta_velocity_m_s)]
        for frame in common:
            pushed = project_acceleration(frame, axis.direction, segment)
            columns.append(moved(line, _step_means(pushed, line)))
        position, velocity = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
        measured, start = np.zeros_like(position), np.zeros(position.shape[1])
        measured[:, 0], start[0] = own.measurement_m, own.initial.position_m
        signals.append(HypothesisSignals(position, velocity, measured, start))
    return Lines(
        time_s,
        legs,
        tuple(signals),
        HypothesisSignals(slow[0], slow[1], np.zeros_like(slow[0]), np.zeros(len(hats))),
        prior,
        sigma_z,
        steps(time_s, []),
    )


def _step_means(acceleration: Acceleration | Unavailable, line: Timeline) -> Array:
    """Over each step; zero where there is none."""
    if isinstance(acceleration, Unavailable):
        return np.zeros(len(line.time_s) - 1)
    return step_means(acceleration, line.time_s)[0]


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


def _hats(start_s: float, end_s: float) -> list[Acceleration | Unavailable]:
    """Hat functions between knots, of which any slow signal is made."""
    count = int(np.clip(np.ceil((end_s - start_s) / KNOT_S), 1, MAX_KNOTS)) + 1
    knots = np.linspace(start_s, end_s, count)
    # so fine that no interval passes for a gap
    time = np.linspace(start_s, end_s, 20 * (count - 1) + 1)
    between = Segment(start_s, end_s, "between the knots")
    hats = (pd.DataFrame(np.interp(time, knots, hat), time) for hat in np.eye(count))
    return [project_acceleration(hat, np.ones(1), between) for hat in hats]


def steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Unit steps of the measurements, shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
