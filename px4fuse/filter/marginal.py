"""Likelihood of positions under the two-state model, by one banded Cholesky factorisation.

Given the acceleration, the states x_k = [p, v] at the measurements form a chain, and what is known
of them is a sum of squares: each leg's x_{k+1} - Fx_k - [Δp, Δv] over its Q, and each measurement's
z - p over its variance. Its matrix A has three bands below the diagonal, so that LAPACK factorises
a flight in a millisecond; the marginal likelihood of the measurements, which is that of the
filter's innovations (Schweppe 1965), follows from log|A| and the squares that remain at the
minimum. Signals that enter linearly (data, or what a bias would add to them) are columns: the
factorisation does not depend on them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from px4fuse.arrays import Array, IntArray

# Numbers that are worked on at once: more do not fit the processor's cache
BLOCK = 2**16
# Position noise of a leg over that of a measurement that is always there: Q has an inverse, also
# that of a single step, which is of rank one, or without process noise
LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class Chain:
    """States at the measurements, and the legs that connect them.

    Attributes
    ----------
    end : ndarray of int, shape (n,)
        State at which each leg ends; it starts at the one before. Where no leg ends, a stretch
        begins that knows nothing of what was before.
    length_s : ndarray, shape (n,)
    noise_unit : ndarray, shape (n, 3)
        Q's elements 00, 01, 11 for SIGMA_A = 1 m/s².
    noise_fixed : ndarray, shape (n, 3)
        What is added to them, whatever SIGMA_A is.
    """

    end: IntArray
    length_s: Array
    noise_unit: Array
    noise_fixed: Array


@dataclass(frozen=True)
class Columns:
    """Signals that enter linearly: measurements (m, k), and Δp, Δv of the legs (n, k)."""

    measurement_m: Array
    delta_position_m: Array
    delta_velocity_m_s: Array


@dataclass(frozen=True)
class Factor:
    """The chain for one SIGMA_A and one variance of each measurement, factorised.

    Attributes
    ----------
    chain : Chain
    precision : ndarray, shape (m, 2)
        Of the measured position (1/m²) and of the velocity, whose measured value is zero (s²/m²);
        0 where there is none.
    length_s : ndarray, shape (m - 1,)
        Between any two states; 0 where a stretch begins.
    inverse : ndarray, shape (m - 1, 3)
        Q⁻¹ by elements 00, 01, 11; zero where a stretch begins.
    lower : ndarray, shape (4, 2m)
        Bands of the Cholesky factor.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision: twice the part of -ln p that no signal enters.
    """

    chain: Chain
    precision: Array
    length_s: Array
    inverse: Array
    lower: Array
    log_determinant: float

    def solve(self, columns: Columns) -> tuple[Array, Array]:
        """Most likely states, and what remains of the data, each divided by its sigma.

        Parameters
        ----------
        columns : Columns

        Returns
        -------
        state : ndarray, shape (m, 2, k)
            Position and velocity.
        whitened : ndarray, shape (2m + 2(m - 1), k)
            Rows of measurements (position, velocity), then of legs between any two states, zero
            where there is none: their products are those of the signals under the inverse
            covariance of the data.
        """
        count = len(self.precision)
        i00, i01, i11 = (row[:, None] for row in self.inverse.T)
        dt = self.length_s[:, None]
        dp, dv = (
            self._everywhere(part)
            for part in (columns.delta_position_m, columns.delta_velocity_m_s)
        )
        right = np.zeros((count, 2, dp.shape[1]))
        right[:, 0] = self.precision[:, :1] * columns.measurement_m
        g0, g1 = i00 * dp + i01 * dv, i01 * dp + i11 * dv
        right[1:, 0] += g0
        right[1:, 1] += g1
        right[:-1, 0] -= g0
        g1 += g0 * dt
        right[:-1, 1] -= g1
        flat = right.reshape(2 * count, -1)
        solved = cho_solve_banded((self.lower, True), flat, overwrite_b=True, check_finite=False)
        state = np.asarray(solved.reshape(right.shape))
        position, velocity = state[:, 0], state[:, 1]
        e0 = position[1:] - position[:-1] - dt * velocity[:-1] - dp
        e1 = velocity[1:] - velocity[:-1] - dv
        # Q⁻¹ = UᵀU; where a stretch begins it is zero
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        whitened = np.empty((4 * count - 2, dp.shape[1]))
        np.subtract(columns.measurement_m, position, out=whitened[:count])
        whitened[:count] *= np.sqrt(self.precision[:, :1])
        np.multiply(-np.sqrt(self.precision[:, 1:]), velocity, out=whitened[count : 2 * count])
        legs = whitened[2 * count :].reshape(2, count - 1, -1)
        np.multiply(np.sqrt(i11 - u01**2), e1, out=legs[1])
        e1 *= u01
        np.multiply(u00, e0, out=legs[0])
        legs[0] += e1
        return state, whitened

    def _everywhere(self, of_legs: Array) -> Array:
        """One row between any two states, zero where a stretch begins."""
        if len(of_legs) == len(self.inverse):
            return of_legs
        made = np.zeros((len(self.inverse), *of_legs.shape[1:]))
        made[self.chain.end - 1] = of_legs
        return made

    def position_variance(self) -> Array:
        """Variance of each state's position given all data (m²), shape (m,).

        The diagonal of A⁻¹, by the backward recursion of its block-tridiagonal factor (Takahashi,
        Fagan and Chin 1973).
        """
        a, b, c = self.lower[0, 0::2], self.lower[1, 0::2], self.lower[0, 1::2]
        # (L Lᵀ)⁻¹ of each diagonal block
        v11 = 1.0 / c**2
        v01 = -b / a * v11
        v00 = 1.0 / a**2 + (b / a) ** 2 * v11
        # G = D⁻¹Oᵀ with O the block below: its rows are L's below times the block's Lᵀ
        low = np.zeros((len(a), 2, 2))
        low[:-1, 0, 0], low[:-1, 0, 1] = self.lower[2, 0:-2:2], self.lower[1, 1:-2:2]
        low[:-1, 1, 0], low[:-1, 1, 1] = self.lower[3, 0:-2:2], self.lower[2, 1:-2:2]
        # G = L⁻ᵀ lowᵀ
        g1 = low[:, :, 1] / c[:, None]
        g0 = (low[:, :, 0] - b[:, None] * g1) / a[:, None]
        made = np.empty(len(a))
        s00 = s01 = s11 = 0.0
        rows = zip(v00.tolist(), v01.tolist(), v11.tolist(), g0.tolist(), g1.tolist(), strict=True)
        for k, (d00, d01, d11, (p, q), (r, s)) in reversed(list(enumerate(rows))):
            t00 = d00 + p * p * s00 + 2.0 * p * q * s01 + q * q * s11
            t01 = d01 + p * r * s00 + (p * s + q * r) * s01 + q * s * s11
            s11 = d11 + r * r * s00 + 2.0 * r * s * s01 + s * s * s11
            s00, s01 = t00, t01
            made[k] = s00
        return made


def factorise(chain: Chain, sigma_a_m_s2: float, precision: Array) -> Factor:
    """Factorise a chain.

    Parameters
    ----------
    chain : Chain
    sigma_a_m_s2 : float
    precision : ndarray, shape (m,) or (m, 2)
        Of the measured positions, 1/m², 0 for one that is not used; with a second column, of the
        velocities around zero.

    Raises
    ------
    numpy.linalg.LinAlgError
        A stretch has too few measurements for a position and a velocity.
    """
    if precision.ndim == 1:
        precision = np.stack([precision, np.zeros_like(precision)], 1)
    q00, q01, q11 = (sigma_a_m_s2**2 * chain.noise_unit + chain.noise_fixed).T
    q00 = q00 + LEAST_SHARE**2 / precision.max()
    determinant = q00 * q11 - q01**2
    count = len(precision)
    inverse, dt = np.zeros((count - 1, 3)), np.zeros(count - 1)
    inverse[chain.end - 1] = np.stack([q11, -q01, q00], 1) / determinant[:, None]
    dt[chain.end - 1] = chain.length_s
    i00, i01, i11 = inverse.T
    bands = np.zeros((4, 2 * count))
    # A = Σ precision + [-F I]ᵀ Q⁻¹ [-F I]
    position, velocity, cross = precision[:, 0].copy(), precision[:, 1].copy(), np.zeros(count)
    position[1:] += i00
    cross[1:] += i01
    velocity[1:] += i11
    position[:-1] += i00
    cross[:-1] += i00 * dt + i01
    velocity[:-1] += i00 * dt**2 + 2.0 * i01 * dt + i11
    bands[0, 0::2], bands[0, 1::2], bands[1, 0::2] = position, velocity, cross
    bands[2, 0:-2:2] = -i00
    bands[1, 1:-2:2] = -(i00 * dt + i01)
    bands[3, 0:-2:2] = -i01
    bands[2, 1:-2:2] = -(i01 * dt + i11)
    lower = cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False)
    log_determinant = (
        2.0 * np.sum(np.log(lower[0]))
        + np.sum(np.log(determinant))
        - np.sum(np.log(precision[precision > 0.0]))
    )
    return Factor(chain, precision, dt, inverse, lower, float(log_determinant))


@dataclass(frozen=True)
class Positions:
    """Positions of one source along a few axes, and what moves them.

    Attributes
    ----------
    chain : Chain
        The same on every axis.
    measurement_m : ndarray, shape (m, a)
        NaN where an axis has none.
    start : ndarray of int, shape (s,)
        First state of each stretch.
    initial : ndarray, shape (m, 2)
        Precision of what is known of position and velocity beforehand: 0 for nothing.
    constant_sigma : ndarray, shape (c,)
        Prior standard deviations of the constants, which each stretch has for itself.
    """

    chain: Chain
    measurement_m: Array
    start: IntArray
    initial: Array
    constant_sigma: Array


@dataclass(frozen=True)
class Fitted:
    """Positions fitted with one pair of noises, over T choices of the legs.

    Attributes
    ----------
    gram : ndarray, shape (s, T, 1 + c, 1 + c)
        Products of the data and of the constants' signals, under the inverse covariance.
    log_determinant : float
    constant_sigma : ndarray, shape (c,)
    """

    gram: Array
    log_determinant: float
    constant_sigma: Array

    def constants(self) -> tuple[Array, Array]:
        """Most likely constants (s, T, c), and their covariance (s, T, c, c)."""
        information = self.gram[..., 1:, 1:] + np.diag(self.constant_sigma**-2.0)
        covariance = np.linalg.inv(information)
        found = -np.einsum("stij,stj->sti", covariance, self.gram[..., 1:, 0])
        return np.asarray(found), np.asarray(covariance)

    def by_stretch(self) -> Array:
        """-ln p of each stretch but for what the noises alone make, shape (s, T)."""
        square = self.gram[..., 0, 0]
        if not len(self.constant_sigma):
            return np.asarray(0.5 * square)
        scale = self.constant_sigma
        information = self.gram[..., 1:, 1:] * np.outer(scale, scale) + np.eye(len(scale))
        cross = self.gram[..., 1:, 0] * scale
        lower = np.linalg.cholesky(information)
        solved = np.linalg.solve(information, cross[..., None])[..., 0]
        log_lower = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * (square - np.sum(cross * solved, axis=-1)) + log_lower)

    def total(self) -> Array:
        """-ln p of all, but for a constant, shape (T,)."""
        return np.asarray(self.by_stretch().sum(axis=0) + 0.5 * self.log_determinant)


def fit(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
) -> Fitted:
    """Fit positions with one pair of noises.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (n, a, T, 1 + c)
        What the acceleration adds on each leg, and what each constant adds to that.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Of each measurement.

    Returns
    -------
    Fitted
    """
    shape = delta_position_m.shape
    gram = np.zeros((len(positions.start), *shape[2:], shape[3]))
    log_determinant = 0.0
    for axes, factor in _factors(positions, sigma_a_m_s2, variance_m2):
        log_determinant += len(axes) * factor.log_determinant
        size = len(axes) * shape[3] * len(positions.measurement_m)
        for first in range(0, shape[2], max(1, BLOCK // size)):
            block = slice(first, first + max(1, BLOCK // size))
            dp, dv = delta_position_m[:, axes, block], delta_velocity_m_s[:, axes, block]
            _, whitened = _solve(positions, factor, axes, dp, dv)
            gram[:, block] += products(positions, whitened.reshape(len(whitened), *dp.shape[1:]))
    return Fitted(gram, log_determinant, positions.constant_sigma)


def products(positions: Positions, whitened: Array) -> Array:
    """Products of whitened columns by stretch: (rows, a, T, k) to (s, T, k, k)."""
    m = len(positions.measurement_m)
    edges = [*positions.start.tolist(), m]
    made = np.zeros((len(edges) - 1, whitened.shape[2], whitened.shape[3], whitened.shape[3]))
    by_offset = np.moveaxis(whitened, 2, 0)
    for at, (begin, end) in enumerate(pairwise(edges)):
        for first, size in (
            (begin, end - begin),
            (m + begin, end - begin),
            (2 * m + begin, end - begin - 1),
            (3 * m - 1 + begin, end - begin - 1),
        ):
            part = by_offset[:, first : first + size]
            part = part.reshape(len(by_offset), -1, whitened.shape[3])
            made[at] += np.swapaxes(part, 1, 2) @ part
    return made


def _factors(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array
) -> Iterator[tuple[list[int], Factor]]:
    """Factors of the chain, each with the axes that it serves: those measured at the same times."""
    known = np.isfinite(positions.measurement_m)
    left = list(range(known.shape[1]))
    while left:
        axes = [axis for axis in left if np.array_equal(known[:, axis], known[:, left[0]])]
        precision = positions.initial.copy()
        # a stretch that this axis hardly measures is held by its start, and says nothing
        few = np.add.reduceat(known[:, axes[0]].astype(int), positions.start) < 2
        used = known[:, axes[0]] & ~np.repeat(few, np.diff([*positions.start, len(known)]))
        precision[:, 0] += np.where(used, 1.0 / variance_m2, 0.0)
        precision[positions.start[few]] += 1.0
        yield axes, factorise(positions.chain, sigma_a_m_s2, precision)
        left = [axis for axis in left if axis not in axes]


def _solve(
    positions: Positions, factor: Factor, axes: list[int], dp: Array, dv: Array
) -> tuple[Array, Array]:
    measured = np.zeros((len(positions.measurement_m), len(axes), *dp.shape[2:]))
    measured[..., 0] = np.nan_to_num(positions.measurement_m[:, axes])[..., None]
    flat = [part.reshape(len(part), -1) for part in (measured, dp, dv)]
    return factor.solve(Columns(*flat))


def squares(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
) -> tuple[Array, Array]:
    """Expected square of each measurement's error given all data, summed over its axes.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (n, a, 1, 1 + c)
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)

    Returns
    -------
    square_m2 : ndarray, shape (m,)
    count : ndarray, shape (m,)
        Axes that were measured.
    """
    arguments = positions, delta_position_m, delta_velocity_m_s, sigma_a_m_s2, variance_m2
    constants = fit(*arguments).constants()[0][:, 0]
    weight = np.concatenate([np.ones((len(constants), 1)), constants], axis=1)
    stretch = np.searchsorted(positions.start, np.arange(len(variance_m2)), side="right") - 1
    square = np.zeros(len(variance_m2))
    count = np.isfinite(positions.measurement_m).sum(axis=1)
    for axes, factor in _factors(positions, sigma_a_m_s2, variance_m2):
        state, _ = _solve(
            positions, factor, axes, delta_position_m[:, axes], delta_velocity_m_s[:, axes]
        )
        at = state[:, 0].reshape(len(state), len(axes), -1)
        error = positions.measurement_m[:, axes] - np.einsum("mak,mk->ma", at, weight[stretch])
        spread = factor.position_variance()[:, None]
        square += np.nansum(error**2 + np.where(np.isnan(error), np.nan, spread), axis=1)
    return square, count


def projected_products(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
    measured_m: Array,
    added_position_m: Array,
    added_velocity_m_s: Array,
) -> Array:
    """Products of other signals by stretch, with the constants' signals taken out.

    Parameters
    ----------
    positions : Positions
        Their measurements only say which of them there are.
    delta_position_m, delta_velocity_m_s : ndarray, shape (n, a, 1, 1 + c)
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    measured_m : ndarray, shape (m, a, k)
    added_position_m, added_velocity_m_s : ndarray, shape (n, a, k)

    Returns
    -------
    ndarray, shape (s, k, k)
    """
    count = measured_m.shape[2]
    none = np.zeros((*measured_m.shape[:2], delta_position_m.shape[3] - 1))
    columns = [
        np.concatenate(pair, axis=2)
        for pair in (
            (measured_m, none),
            (added_position_m, delta_position_m[:, :, 0, 1:]),
            (added_velocity_m_s, delta_velocity_m_s[:, :, 0, 1:]),
        )
    ]
    gram = np.zeros((len(positions.start), columns[0].shape[2], columns[0].shape[2]))
    for axes, factor in _factors(positions, sigma_a_m_s2, variance_m2):
        flat = [part[:, axes].reshape(len(part), -1) for part in columns]
        _, whitened = factor.solve(Columns(*flat))
        gram += products(positions, whitened.reshape(len(whitened), len(axes), 1, -1))[:, 0]
    cross = gram[:, :count, count:]
    information = gram[:, count:, count:] + np.diag(positions.constant_sigma**-2.0)
    taken = cross @ np.linalg.solve(information, np.swapaxes(cross, 1, 2))
    return np.asarray(gram[:, :count, :count] - taken)
