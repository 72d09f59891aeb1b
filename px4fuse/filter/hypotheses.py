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

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import constants
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray, IntArray, cumulative_integral
from px4fuse.filter.likelihood import Preintegrated, innovations_of_signals, moved, preintegrate
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, ned_acceleration, too_few
from px4fuse.filter.steps import Timeline, timeline
from px4fuse.flight import AXIS_NAMES, QUATERNION_COLUMNS, Flight, Unavailable

CAUSES = "causes beyond noise"
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
class HypothesisFit:
    """Generalised least squares of whitened innovations on their columns.

    Attributes
    ----------
    columns : ndarray, shape (n, k)
        Of all axes, one after the other.
    axis : ndarray of int, shape (n,)
        Which axis each row is of.
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

    columns: Array
    axis: IntArray
    rest: Array
    coefficients: Array
    covariance: Array
    square: float
    score: float
    spread: float

    def estimate(self, column: int) -> Estimate:
        """One coefficient, its σ widened where more remains than the noises say."""
        sigma = float(np.sqrt(self.covariance[column, column])) * max(self.spread, 1.0)
        return Estimate(float(self.coefficients[column]), sigma)


def fit(data: Array, columns: Array, axis: IntArray, prior: Array, log_s: float) -> HypothesisFit:
    """Regress whitened innovations on their columns.

    Parameters
    ----------
    data : ndarray, shape (n,)
    columns, axis
        As :class:`HypothesisFit` has them.
    prior : ndarray, shape (k,)
        Standard deviation of each coefficient before the data, infinite where nothing is known.
    log_s : float
        Σ ln S over all.
    """
    information = np.diag(prior**-2.0) + columns.T @ columns
    # a column that nothing excites (a turn in hover) must not stop the others
    information += 1e-12 * np.diag(np.diag(information)) + 1e-12 * np.eye(len(prior))
    moment = columns.T @ data
    factor = cho_factor(information)
    covariance = cho_solve(factor, np.eye(len(prior)))
    coefficients = covariance @ moment
    square = float(data @ data - coefficients @ moment)
    return HypothesisFit(
        columns,
        axis,
        data - columns @ coefficients,
        coefficients,
        covariance,
        square,
        0.5 * (square + log_s) + float(np.sum(np.log(np.diag(factor[0])))),
        float(np.sqrt(max(square, 0.0) / max(len(data) - CONSTANTS, 1))),
    )


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

    def respond(self, axis: int, added: Array, sigma_a: float, skip: BoolArray) -> Array:
        """Whitened innovations of one axis to signals that only its measurements have, (m, k)."""
        still = np.zeros_like(added)
        own = _with_signals(self.legs[axis], still, still, added)
        nu, s = innovations_of_signals(own, sigma_a, self.sigma_z_m, skip)
        return np.asarray((nu / np.sqrt(s)[:, None])[~skip])

    def fit(self, sigma_a: float, skip: BoolArray, scale: float = 1.0) -> HypothesisFit:
        """Fit all columns, with the acceleration (and its noise) scaled.

        Parameters
        ----------
        sigma_a : float
        skip : ndarray of bool, shape (m,)
            Measurements that are neither fused nor fitted.
        scale : float
        """
        hats, steps, axes = self.hats[0].shape[1], self.steps.shape[1], len(self.legs)
        width = len(self.prior)
        kept = np.count_nonzero(~skip)
        data = np.empty((axes, kept))
        columns = np.zeros((axes, kept, width + axes * steps))
        log_s = 0.0
        for at, legs in enumerate(self.legs):
            # acceleration in the source's own length: of what was measured, and of a turn of it
            factor = np.ones(1 + CONSTANTS)
            factor[[0, 1 + TURN]] = scale
            still = np.zeros_like(self.hats[0])
            signals = (
                [factor * legs.delta_position_m, self.hats[0], 0.0 * self.steps],
                [factor * legs.delta_velocity_m_s, self.hats[1], 0.0 * self.steps],
                [legs.measurement_m, still, self.steps],
            )
            own = _with_signals(legs, *map(np.hstack, signals))
            nu, s = innovations_of_signals(own, scale * sigma_a, self.sigma_z_m, skip)
            normalised = (nu / np.sqrt(s)[:, None])[~skip]
            data[at] = normalised[:, 0]
            first, step = CONSTANTS + hats * at, width + steps * at
            which = np.r_[:CONSTANTS, first : first + hats, step : step + steps]
            columns[at][:, which] = normalised[:, 1:]
            log_s += float(np.sum(np.log(s[~skip])))
        prior = np.append(self.prior, np.full(axes * steps, np.inf))
        axis = np.repeat(np.arange(axes), kept)
        return fit(data.ravel(), columns.reshape(axes * kept, -1), axis, prior, log_s)


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
    shifted = [
        replace(axis, measurement_time_s=axis.measurement_time_s + clock_offset_s) for axis in axes
    ]
    settings = replace(settings, input="imu")
    line = timeline(shifted[0], settings)
    common = _common_columns(attitude, acceleration)
    legs = []
    for axis in shifted:
        own = preintegrate(axis, settings)
        columns = [(own.delta_position_m, own.delta_velocity_m_s)]
        columns += [
            _added(frame.to_numpy() @ axis.direction, frame.index, line) for frame in common
        ]
        dp, dv = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
        measured = np.zeros_like(dp)
        # the filter starts at the first one
        measured[:, 0] = own.measurement_m - own.initial.position_m
        start = replace(own.initial, position_m=0.0)
        legs.append(replace(_with_signals(own, dp, dv, measured), initial=start))
    time_s = axes[0].measurement_time_s[-len(measured) :]
    fine, hats = _hats(time_s[0] + clock_offset_s, time_s[-1] + clock_offset_s)
    slow = [_added(hat, fine, line) for hat in hats]
    slow_position, slow_velocity = (np.stack(part, axis=1) for part in zip(*slow, strict=True))
    prior = np.append(
        np.full(CONSTANTS, np.inf), np.full(len(axes) * len(hats), TILT_SIGMA_RAD * constants.g)
    )
    return Hypotheses(
        time_s, tuple(legs), (slow_position, slow_velocity), prior, sigma_z, steps(time_s, [])
    )


def _added(acceleration_m_s2: Array, time_s: ArrayLike, line: Timeline) -> tuple[Array, Array]:
    """Position and velocity that an acceleration adds between the measurements."""
    time = np.asarray(time_s, dtype=np.float64)
    velocity = np.interp(line.time_s, time, cumulative_integral(acceleration_m_s2, time))
    return moved(line, np.diff(velocity) / np.diff(line.time_s))


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


def _hats(start_s: float, end_s: float) -> tuple[Array, Array]:
    """Hat functions between knots, of which any slow signal is made, at times so fine (n, h)."""
    count = int(np.clip(np.ceil((end_s - start_s) / KNOT_S), 1, MAX_KNOTS)) + 1
    time = np.linspace(start_s, end_s, 20 * (count - 1) + 1)
    knots = np.linspace(start_s, end_s, count)
    return time, np.array([np.interp(time, knots, hat) for hat in np.eye(count)])


def steps(time_s: Array, starts_s: Iterable[float]) -> Array:
    """Unit steps of the measurements, shape (m, j)."""
    return np.asarray(time_s[:, None] >= np.fromiter(starts_s, float)[None, :], dtype=np.float64)
