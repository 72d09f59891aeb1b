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
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from px4fuse.arrays import Array, IntArray

# Position noise of a leg over that of a measurement that is always there: Q has an inverse, also
# that of a single step, which is of rank one, or without process noise
LEAST_SHARE = 1e-5
ONE = np.ones(1)
# SIGMA_A and SIGMA_Z of a smooth path
PATH_NOISES = 0.5, 0.1
# Precision of a start (1/m²) above which it is known, below which as good as nothing is
HELD = 1e-3


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
    """Signals that enter linearly, time last: measurements (..., m), Δp and Δv of the legs.

    Legs have shape (..., n), or (..., m - 1) with any value where a stretch begins.
    """

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
    bands, lower : ndarray, shape (4, 2m)
        Bands of A and of its Cholesky factor.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision: twice the part of -ln p that no signal enters.
    """

    chain: Chain
    precision: Array
    length_s: Array
    inverse: Array
    bands: Array
    lower: Array
    log_determinant: float

    def whiten(self, columns: Columns) -> tuple[Array, Array]:
        """Signals such that the products under the inverse covariance are a difference of two.

        Those of the rows, less those of what the states explain, and of the measurements over
        their sigma besides, which most signals have none of.

        Parameters
        ----------
        columns : Columns

        Returns
        -------
        rows : ndarray, shape (..., 2m - 2)
            Legs over their covariance's root, two for each, zero where a stretch begins.
        explained : ndarray, shape (..., 2m)
        """
        dp, dv = self._everywhere(columns)
        i00, i01, i11 = self.inverse.T
        # Q⁻¹ = UᵀU; where a stretch begins it is zero
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        rows = np.empty((*dp.shape, 2))
        np.add(u00 * dp, u01 * dv, out=rows[..., 0])
        np.multiply(np.sqrt(i11 - u01**2), dv, out=rows[..., 1])
        right = self._right(columns.measurement_m, dp, dv)
        explained, _ = lapack.dtbtrs(self.lower, right.T, uplo="L", overwrite_b=1)
        return rows.reshape(*dp.shape[:-1], -1), explained.T.reshape(*dp.shape[:-1], -1)

    def solve(self, columns: Columns) -> Array:
        """Most likely states: position and velocity, shape (..., m, 2)."""
        dp, dv = self._everywhere(columns)
        right = self._right(columns.measurement_m, dp, dv)
        state, _ = lapack.dpbtrs(self.lower, right.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, 2))

    def _right(self, measured: Array, dp: Array, dv: Array) -> Array:
        """The right side of the normal equations, shape (columns, 2m)."""
        i00, i01, i11 = self.inverse.T
        right = np.zeros((*dp.shape[:-1], len(self.precision), 2))
        right[..., 0] = self.precision[:, 0] * measured
        g0, g1 = i00 * dp + i01 * dv, i01 * dp + i11 * dv
        right[..., 1:, 0] += g0
        right[..., 1:, 1] += g1
        right[..., :-1, 0] -= g0
        g1 += g0 * self.length_s
        right[..., :-1, 1] -= g1
        return right.reshape(-1, 2 * len(self.precision))

    def _everywhere(self, columns: Columns) -> tuple[Array, Array]:
        """Legs between any two states, whatever where a stretch begins."""
        dp, dv = columns.delta_position_m, columns.delta_velocity_m_s
        if dp.shape[-1] == len(self.inverse):
            return dp, dv
        made = np.zeros((2, *dp.shape[:-1], len(self.inverse)))
        made[0][..., self.chain.end - 1], made[1][..., self.chain.end - 1] = dp, dv
        return made[0], made[1]

    def position_variance(self) -> Array:
        """Variance of each state's position given all data (m²), shape (m,).

        The information about a state is what all before it and what all after it leave of its own
        block of A: the Cholesky factor's blocks from either end (Fraser and Potter 1969).
        """
        # A with its rows and columns in reverse
        turned = np.zeros_like(self.bands)
        for below in range(4):
            turned[below, : len(turned.T) - below] = self.bands[below, : len(turned.T) - below][
                ::-1
            ]
        behind, _ = lapack.dpbtrf(turned, lower=1, overwrite_ab=1)
        (a, c), b = (self.lower[0, at::2] for at in (0, 1)), self.lower[1, 0::2]
        # of the reverse, each block has the velocity first
        (d, f), e = (behind[0, at::2][::-1] for at in (0, 1)), behind[1, 0::2][::-1]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


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
    measured = precision[:, 0]
    q00 = q00 + LEAST_SHARE**2 / np.median(measured[measured > 0.0])
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
    lower, broken = lapack.dpbtrf(bands, lower=1)
    if broken:
        raise np.linalg.LinAlgError("a stretch has too few measurements")
    log_determinant = (
        2.0 * np.sum(np.log(lower[0]))
        + np.sum(np.log(determinant))
        - np.sum(np.log(precision[precision > 0.0]))
    )
    return Factor(chain, precision, dt, inverse, bands, lower, float(log_determinant))


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
    freedom : int
        Measured positions less what the starts take of them: ln of the scale of all noises counts
        so many times.
    constant_sigma : ndarray, shape (c,)
    """

    gram: Array
    log_determinant: float
    freedom: int
    constant_sigma: Array

    def scaled(self, sigma: float) -> Fitted:
        """The same with all noises ``sigma`` times as large."""
        return replace(
            self,
            gram=self.gram / sigma**2,
            log_determinant=self.log_determinant + 2.0 * self.freedom * float(np.log(sigma)),
        )

    def constants(self) -> tuple[Array, Array]:
        """Most likely constants (s, T, c), and their covariance (s, T, c, c)."""
        information = self.gram[..., 1:, 1:] + np.diag(self.constant_sigma**-2.0)
        covariance = np.linalg.inv(information)
        found = -np.einsum("stij,stj->sti", covariance, self.gram[..., 1:, 0])
        return np.asarray(found), np.asarray(covariance)

    def by_stretch(self, scales: Array = ONE) -> Array:
        """-ln p of each stretch but for what the noises alone make, shape (s, T).

        Parameters
        ----------
        scales : ndarray, shape (k,), optional
            By which all noises are multiplied: the shape is then (k, s, T).
        """
        gram = self.gram if scales is ONE else self.gram / scales[:, None, None, None, None] ** 2
        square = gram[..., 0, 0]
        if not len(self.constant_sigma):
            return np.asarray(0.5 * square)
        scale = self.constant_sigma
        information = gram[..., 1:, 1:] * np.outer(scale, scale) + np.eye(len(scale))
        cross = gram[..., 1:, 0] * scale
        lower = np.linalg.cholesky(information)
        solved = np.linalg.solve(information, cross[..., None])[..., 0]
        log_lower = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * (square - np.sum(cross * solved, axis=-1)) + log_lower)

    def totals(self, scales: Array) -> Array:
        """-ln p of all with all noises so many times as large, but for a constant, (k, T)."""
        noises_alone = 0.5 * self.log_determinant + self.freedom * np.log(scales)
        return np.asarray(self.by_stretch(scales).sum(axis=1) + noises_alone[:, None])

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
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        What the acceleration adds on each leg, and what each constant adds to that; legs as in
        :class:`Columns`.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Of each measurement.

    Returns
    -------
    Fitted
    """
    shape = delta_position_m.shape
    gram = np.zeros((len(positions.start), shape[1], shape[2], shape[2]))
    log_determinant, freedom = 0.0, 0
    for axes, factor, measured in _factors(positions, sigma_a_m_s2, variance_m2):
        log_determinant += len(axes) * factor.log_determinant
        freedom += len(axes) * measured
        data = np.zeros((len(axes), 1, shape[2], len(positions.measurement_m)))
        data[:, 0, 0] = np.nan_to_num(positions.measurement_m[:, axes].T)
        square = factor.precision[:, 0] * np.sum(data[:, 0, 0] ** 2, axis=0)
        gram[..., 0, 0] += np.add.reduceat(square, positions.start)[:, None]
        dp, dv = (_picked(part, axes) for part in (delta_position_m, delta_velocity_m_s))
        rows, explained = factor.whiten(Columns(data, dp, dv))
        for at, (begin, end) in enumerate(_stretches(positions)):
            own, less = rows[..., 2 * begin : 2 * end - 2], explained[..., 2 * begin : 2 * end]
            gram[at] += (own @ np.swapaxes(own, -1, -2)).sum(axis=0)
            gram[at] -= (less @ np.swapaxes(less, -1, -2)).sum(axis=0)
    return Fitted(gram, log_determinant, freedom, positions.constant_sigma)


def _picked(parts: Array, axes: list[int]) -> Array:
    """Some axes, without a copy where they are all."""
    return parts if axes == list(range(len(parts))) else parts[axes]


def _stretches(positions: Positions) -> Iterator[tuple[int, int]]:
    return pairwise([*positions.start.tolist(), len(positions.measurement_m)])


def _factors(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array
) -> Iterator[tuple[list[int], Factor, int]]:
    """Factors of the chain, each with the axes that it serves, and their degrees of freedom.

    An axis that is measured at the same times as another shares its factor.
    """
    known = np.isfinite(positions.measurement_m)
    left = list(range(known.shape[1]))
    states = len(known)
    while left:
        axes = [axis for axis in left if np.array_equal(known[:, axis], known[:, left[0]])]
        precision = positions.initial.copy()
        # a stretch that this axis hardly measures is held by its start, and says nothing
        few = np.add.reduceat(known[:, axes[0]].astype(int), positions.start) < 2
        used = known[:, axes[0]] & ~np.repeat(few, np.diff([*positions.start, states]))
        precision[:, 0] += np.where(used, 1.0 / variance_m2, 0.0)
        precision[positions.start[few]] += 1.0
        said = (precision > 0.0) & ((precision > positions.initial) | (positions.initial > HELD))
        factor = factorise(positions.chain, sigma_a_m_s2, precision)
        # where the start is as good as unknown, what is known of it does not count
        vague = float(np.sum(np.log(precision[(precision > 0.0) & ~said])))
        factor = replace(factor, log_determinant=factor.log_determinant + vague)
        yield axes, factor, int(np.count_nonzero(said)) - 2 * len(positions.start)
        left = [axis for axis in left if axis not in axes]


def centred(
    positions: Positions, delta_position_m: Array, delta_velocity_m_s: Array
) -> tuple[Positions, Array, Array]:
    """The same data about a smooth path through them, from zero where a stretch starts.

    The likelihood is the same, but it is no longer a small difference of large squares.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        Changed in place.
    """
    measured = positions.measurement_m.copy()
    chain = positions.chain
    count = delta_position_m.shape[-1]
    of_leg = chain.end - 1 if count == len(chain.end) else slice(None)
    variance = np.full(len(measured), PATH_NOISES[1] ** 2)
    for axes, factor, _ in _factors(positions, PATH_NOISES[0], variance):
        dp, dv = (part[axes, 0, 0] for part in (delta_position_m, delta_velocity_m_s))
        state = factor.solve(Columns(np.nan_to_num(measured[:, axes].T), dp, dv))
        state[:, positions.start] = 0.0
        path, speed = state[..., 0], state[..., 1]
        measured[:, axes] -= path.T
        way = np.diff(path) - factor.length_s * speed[:, :-1]
        for axis, p, v in zip(axes, way[:, of_leg], np.diff(speed)[:, of_leg], strict=True):
            delta_position_m[axis, :, 0] -= p
            delta_velocity_m_s[axis, :, 0] -= v
    return replace(positions, measurement_m=measured), delta_position_m, delta_velocity_m_s


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
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, 1, 1 + c, n)
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
    # of each leg, by the stretch in which it ends
    end = np.arange(1, len(variance_m2))
    if delta_position_m.shape[-1] < len(end):
        end = positions.chain.end
    of_leg = weight[np.searchsorted(positions.start, end, side="right") - 1]
    dp, dv = (
        np.einsum("akn,nk->an", part[:, 0], of_leg)
        for part in (delta_position_m, delta_velocity_m_s)
    )
    square = np.zeros(len(variance_m2))
    count = np.isfinite(positions.measurement_m).sum(axis=1)
    for axes, factor, _ in _factors(positions, sigma_a_m_s2, variance_m2):
        measured = positions.measurement_m[:, axes].T
        state = factor.solve(Columns(np.nan_to_num(measured), dp[axes], dv[axes]))
        error = measured - state[..., 0]
        spread = np.where(np.isnan(error), np.nan, factor.position_variance())
        square += np.nansum(error**2 + spread, axis=0)
    return square, count


def paired_products(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
    first: Columns,
    second: Columns,
) -> Array:
    """Products of pairs of other signals by stretch, with the constants' signals taken out.

    Parameters
    ----------
    positions : Positions
        Their measurements only say which of them there are.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, 1, 1 + c, n)
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    first, second : Columns
        Signals of shape (a, k, ...).

    Returns
    -------
    ndarray, shape (s, k)
    """
    states = len(variance_m2)
    made = np.zeros((len(positions.start), first.measurement_m.shape[1]))
    constants = len(positions.constant_sigma)
    cross = np.zeros((2, *made.shape, constants))
    information = np.zeros((len(made), constants, constants)) + np.diag(
        positions.constant_sigma**-2.0
    )
    for axes, factor, _ in _factors(positions, sigma_a_m_s2, variance_m2):
        for axis in axes:  # one at a time: they are long
            of_constants = factor.whiten(
                Columns(
                    np.zeros((constants, states)),
                    delta_position_m[axis, 0, 1:],
                    delta_velocity_m_s[axis, 0, 1:],
                )
            )
            pair = [
                (
                    np.sqrt(factor.precision[:, 0]) * each.measurement_m[axis],
                    *factor.whiten(
                        Columns(
                            each.measurement_m[axis],
                            each.delta_position_m[axis],
                            each.delta_velocity_m_s[axis],
                        )
                    ),
                )
                for each in (first, second)
            ]
            for at, (begin, end) in enumerate(_stretches(positions)):
                parts = [
                    (
                        white[:, begin:end],
                        rows[:, 2 * begin : 2 * end - 2],
                        explained[:, 2 * begin : 2 * end],
                    )
                    for white, rows, explained in pair
                ]
                rows, explained = (
                    of_constants[0][:, 2 * begin : 2 * end - 2],
                    of_constants[1][:, 2 * begin : 2 * end],
                )
                by_part = [np.einsum("kr,kr->k", *both) for both in zip(*parts, strict=True)]
                made[at] += by_part[0] + by_part[1] - by_part[2]
                for which, (_, own, less) in enumerate(parts):
                    cross[which, at] += own @ rows.T - less @ explained.T
                information[at] += rows @ rows.T - explained @ explained.T
    taken = np.linalg.solve(information, np.swapaxes(cross[1], 1, 2))
    return np.asarray(made - np.einsum("skc,sck->sk", cross[0], taken))
