"""Likelihood of positions along a few axes, with what is constant in each stretch taken out.

Given the acceleration, what is known of the states x_k = [p, v] at the measurements is a sum of
squares: each leg's x_{k+1} - Fx_k - [Δp, Δv] over its Q, and each measurement's z - p over its
variance. Its matrix A has three bands below the diagonal, so that LAPACK factorises a flight in a
millisecond; the marginal likelihood of the measurements, which is that of the filter's innovations
(Schweppe 1965), follows from log|A| and the squares that remain at the minimum. Signals that enter
linearly (data, or what a bias would add to them) are columns: the factorisation does not depend on
them. Biases and the like have a prior, and are marginalised by the Schur complement of their
products. A slow error of the source is a third state, c_{k+1} = ρ c_k + noise, that the measurement
sees: z - p - c; it begins anew in each stretch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from px4fuse.arrays import Array, BoolArray, IntArray

ONE = np.ones(1)
# SIGMA_A and SIGMA_Z of a smooth path
PATH_NOISES = 0.5, 0.1
# Precision of a start (1/m²) above which it is known, below which as good as nothing is
HELD = 1e-3
# Position noise of a leg that is always there, over a measurement's and over its own: Q has an
# inverse, also that of a single step, which is of rank one, or without process noise
LEAST_SHARE = 1e-5
# Signals whose states are found at once: more take more memory, and no less time
AT_ONCE = 8
# A determinant below this share of its terms is their rounding
SINGULAR = 1e-12


@dataclass(frozen=True)
class Positions:
    """Positions of one source along a few axes, and what moves them.

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        NaN where an axis has none.
    start : ndarray of int, shape (s,)
        First state of each stretch.
    length_s : ndarray, shape (m - 1,)
        Of the legs between any two measurements, also where a stretch begins.
    noise_unit, noise_fixed : ndarray, shape (3, m - 1)
        Q's elements 00, 01, 11 of each leg for SIGMA_A = 1 m/s², and what is added to them
        whatever SIGMA_A is.
    initial : ndarray, shape (m, 2)
        Precision of what is known of position and velocity beforehand: 0 for nothing.
    constant_sigma : ndarray, shape (c,)
        Prior standard deviations of the constants, which each stretch has for itself.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, m - 1)
        What the acceleration adds on each leg, and what each constant adds to that, for T clock
        offsets; any value where a stretch begins.
    slow : (float, float) or None
        Standard deviation (m) and time constant (s) of a slow error of the source.
    """

    measurement_m: Array
    start: IntArray
    length_s: Array
    noise_unit: Array
    noise_fixed: Array
    initial: Array
    constant_sigma: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    slow: tuple[float, float] | None = None

    @cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """First state of each stretch, and the one after its last."""
        return list(pairwise([*self.start.tolist(), len(self.measurement_m)]))

    @cached_property
    def joined(self) -> BoolArray:
        """Which legs lie in a stretch, shape (m - 1,)."""
        return ~np.isin(np.arange(1, len(self.measurement_m)), self.start)

    def over(self, sigma_z_m: float, walk: float, weight: Array) -> tuple[Positions, Array]:
        """The same with all that is random over SIGMA_Z, and the measurements' variances, (m,).

        Parameters
        ----------
        sigma_z_m : float
        walk : float
            Random walk of the source over SIGMA_Z, per square root of a second.
        weight : ndarray
            What each of the last measurements counts; one before is the filter's start.
        """
        fixed = self.noise_fixed / sigma_z_m**2
        fixed[0] += self.length_s * walk**2
        extra = np.ones(len(self.measurement_m) - len(weight))
        slow = self.slow and (self.slow[0] / sigma_z_m, self.slow[1])
        scaled = replace(self, noise_fixed=fixed, initial=self.initial * sigma_z_m**2, slow=slow)
        return scaled, 1.0 / np.concatenate([extra, weight])

    def systems(
        self, sigma_a_m_s2: float, variance_m2: Array
    ) -> Iterator[tuple[list[int], BandedSystem, int]]:
        """Banded systems, each with the axes that it serves, and their degrees of freedom.

        An axis that is measured at the same times as another shares its system.
        """
        known = np.isfinite(self.measurement_m)
        noise = sigma_a_m_s2**2 * self.noise_unit + self.noise_fixed
        left = list(range(known.shape[1]))
        while left:
            own = known[:, left[0]]
            axes = [axis for axis in left if np.array_equal(known[:, axis], own)]
            left = [axis for axis in left if axis not in axes]
            precision = self.initial.copy()
            # a stretch that this axis hardly measures is held by its start, and says nothing
            few = np.add.reduceat(own.astype(int), self.start) < 2
            used = own & ~np.repeat(few, np.diff([*self.start, len(known)]))
            precision[:, 0] += np.where(used, 1.0 / variance_m2, 0.0)
            precision[self.start[few]] += 1.0
            said = (precision > 0.0) & ((precision > self.initial) | (self.initial > HELD))
            system = factorise(self.length_s, noise, self.joined, precision, self.slow)
            # where the start is as good as unknown, what is known of it does not count
            vague = float(np.sum(np.log(precision[(precision > 0.0) & ~said])))
            system = replace(system, log_determinant=system.log_determinant + vague)
            yield axes, system, int(np.count_nonzero(said)) - 2 * len(self.start)


@dataclass(frozen=True)
class Fitted:
    """Positions fitted with one pair of noises, for T clock offsets.

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
        log_determinant = self.log_determinant + 2.0 * self.freedom * float(np.log(sigma))
        return replace(self, gram=self.gram / sigma**2, log_determinant=log_determinant)

    def constants(self) -> Array:
        """Most likely constants, shape (s, T, c)."""
        information = self.gram[..., 1:, 1:] + np.diag(self.constant_sigma**-2.0)
        return np.asarray(-np.linalg.solve(information, self.gram[..., 1:, :1])[..., 0])

    def by_stretch(self, scales: Array = ONE) -> Array:
        """-ln p of each stretch but for what the noises alone make, shape (k, s, T).

        Parameters
        ----------
        scales : ndarray, shape (k,)
            By which all noises are multiplied.
        """
        gram = self.gram / scales[:, None, None, None, None] ** 2
        sigma = self.constant_sigma
        information = gram[..., 1:, 1:] * np.outer(sigma, sigma) + np.eye(len(sigma))
        cross = gram[..., 1:, 0] * sigma
        lower = np.linalg.cholesky(information)
        solved = np.linalg.solve(information, cross[..., None])[..., 0]
        log_lower = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * (gram[..., 0, 0] - np.sum(cross * solved, axis=-1)) + log_lower)

    def totals(self, scales: Array = ONE) -> Array:
        """-ln p of all with all noises so many times as large, but for a constant, (k, T)."""
        noises_alone = 0.5 * self.log_determinant + self.freedom * np.log(scales)
        return np.asarray(self.by_stretch(scales).sum(axis=1) + noises_alone[:, None])


def fit(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array, measured_m: Array | None = None
) -> Fitted:
    """Fit positions with one pair of noises.

    Parameters
    ----------
    positions : Positions
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Of each measurement.
    measured_m : ndarray, shape (a, 1 or T, 1 + c, m), optional
        Of the data and of each constant, where the positions only say which there are.
    """
    if measured_m is None:
        states, axes = positions.measurement_m.shape
        measured_m = np.zeros((axes, 1, 1 + len(positions.constant_sigma), states))
        measured_m[:, 0, 0] = np.nan_to_num(positions.measurement_m.T)
    dp, dv = positions.delta_position_m, positions.delta_velocity_m_s
    gram = np.zeros((len(positions.start), *dp.shape[1:3], dp.shape[2]))
    log_determinant, freedom = 0.0, 0
    for axes, system, own in positions.systems(sigma_a_m_s2, variance_m2):
        log_determinant += len(axes) * system.log_determinant
        freedom += len(axes) * own
        data = measured_m[axes]
        legs, explained = system.whiten(data, dp[axes], dv[axes])
        parts = (np.sqrt(system.precision[:, 0]) * data, *legs, explained)
        for at, (begin, end) in enumerate(positions.stretches):
            rows = slice(begin, end - 1)
            states = slice(system.states * begin, system.states * end)
            for sign, part, here in zip(
                (1.0, 1.0, 1.0, -1.0), parts, (slice(begin, end), rows, rows, states), strict=True
            ):
                signal = part[..., here]
                gram[at] += sign * (signal @ np.swapaxes(signal, -1, -2)).sum(axis=0)
    return Fitted(gram, log_determinant, freedom, positions.constant_sigma)


def centred(positions: Positions, *, scaled: bool = False) -> Positions:
    """The same data about a smooth path through them, from zero where a stretch starts.

    The likelihood is the same, but it is no longer a small difference of large squares.

    Parameters
    ----------
    positions : Positions
    scaled : bool
        Whether the last constant is a scale of the positions: its signal becomes the path's.
    """
    measured = positions.measurement_m.copy()
    dp, dv = positions.delta_position_m.copy(), positions.delta_velocity_m_s.copy()
    sigma_a, sigma_z = PATH_NOISES
    for axes, system, _ in positions.systems(sigma_a, np.full(len(measured), sigma_z**2)):
        data = np.nan_to_num(measured[:, axes].T)[:, None]
        state = system.solve(data, dp[axes, :, 0], dv[axes, :, 0])
        state[:, :, positions.start] = 0.0
        path, speed = state[..., 0], state[..., 1]
        measured[:, axes] -= path[:, 0].T
        way = np.diff(path) - positions.length_s * speed[..., :-1]
        # one path is taken out of all; a scale is of the path to which each input leads
        for part, leads in ((dp, way), (dv, np.diff(speed))):
            part[axes, :, 0] -= leads[:, :1]
            if scaled:
                part[axes, :, -1] = leads
    return replace(positions, measurement_m=measured, delta_position_m=dp, delta_velocity_m_s=dv)


def squares(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array, constants: Array
) -> tuple[Array, Array]:
    """Expected square of each measurement's error given all data, summed over its axes.

    Parameters
    ----------
    positions : Positions
        With one clock offset.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    constants : ndarray, shape (s, c)
        Most likely ones.

    Returns
    -------
    square_m2 : ndarray, shape (m,)
    count : ndarray, shape (m,)
        Axes that were measured.
    """
    weight = np.concatenate([np.ones((len(constants), 1)), constants], axis=1)
    # of each leg, by the stretch in which it ends
    of_leg = np.repeat(weight, np.diff([*positions.start, len(variance_m2)]), axis=0)[1:]
    moved = positions.delta_position_m, positions.delta_velocity_m_s
    dp, dv = (np.einsum("akn,nk->an", part[:, 0], of_leg) for part in moved)
    square = np.zeros(len(variance_m2))
    for axes, system, _ in positions.systems(sigma_a_m_s2, variance_m2):
        measured = positions.measurement_m[:, axes].T
        error = measured - system.solve(np.nan_to_num(measured), dp[axes], dv[axes])[..., 0]
        spread = np.where(np.isnan(error), np.nan, system.position_variance())
        square += np.nansum(error**2 + spread, axis=0)
    return square, np.isfinite(positions.measurement_m).sum(axis=1)


def paired_products(
    positions: Positions,
    sigma_a_m_s2: float,
    variance_m2: Array,
    signals: Sequence[Array],
    measured_m: Array,
) -> Array:
    """Products of signals with others by stretch, with the constants' signals taken out.

    Parameters
    ----------
    positions : Positions
        With one clock offset; their measurements only say which of them there are.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    signals : three ndarray, shape (a, k, m) and twice (a, k, m - 1)
        Measurements, Δp and Δv of k signals.
    measured_m : ndarray, shape (a, k, m)
        Of the others, which have nothing on the legs.

    Returns
    -------
    ndarray, shape (s, k)
    """
    error, *legs = signals
    constants = positions.delta_position_m[:, 0, 1:], positions.delta_velocity_m_s[:, 0, 1:]
    found = []
    for begin in range(0, measured_m.shape[1], AT_ONCE):
        few = np.s_[:, begin : begin + AT_ONCE]
        # one set of signals, then the other, then those of the constants
        dp, dv = (
            np.concatenate([leg[few], 0.0 * leg[few], of_constant], axis=1)[:, None]
            for leg, of_constant in zip(legs, constants, strict=True)
        )
        measured = np.zeros((*dp.shape[:3], error.shape[-1]))
        one, other, rest = np.split(np.arange(dp.shape[2]), np.array([1, 2]) * error[few].shape[1])
        measured[:, 0, one], measured[:, 0, other] = error[few], measured_m[few]
        both = replace(positions, delta_position_m=dp, delta_velocity_m_s=dv)
        gram = fit(both, sigma_a_m_s2, variance_m2, measured).gram[:, 0]
        information = gram[:, rest[:, None], rest] + np.diag(positions.constant_sigma**-2.0)
        taken = np.linalg.solve(information, gram[:, rest[:, None], other])
        by_constants = np.einsum("skc,sck->sk", gram[:, one[:, None], rest], taken)
        found.append(gram[:, one, other] - by_constants)
    return np.concatenate(found, axis=1)


@dataclass(frozen=True)
class BandedSystem:
    """The normal equations of all states, factorised.

    Attributes
    ----------
    precision : ndarray, shape (m, 2)
        Of the measured position (1/m²) and of the velocity, whose measured value is zero (s²/m²);
        0 where there is none.
    length_s : ndarray, shape (m - 1,)
        Between any two states.
    inverse : ndarray, shape (3, m - 1)
        Q⁻¹ by elements 00, 01, 11; zero where a stretch begins.
    root : ndarray, shape (m - 1,)
        1/√Q₁₁, as Q⁻¹ has it but for rounding; zero where a stretch begins.
    bands, lower : ndarray, shape (2 + states, states · m)
        Bands of A and of its Cholesky factor.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision: twice the part of -ln p that no signal enters.
    """

    precision: Array
    length_s: Array
    inverse: Array
    root: Array
    bands: Array
    lower: Array
    log_determinant: float

    @property
    def states(self) -> int:
        """Of each time: position, velocity, and a slow error of the source where there is one."""
        return len(self.bands) - 2

    def whiten(self, measured_m: Array, dp: Array, dv: Array) -> tuple[tuple[Array, Array], Array]:
        """Signals such that the products under the inverse covariance are a difference of two.

        Those of the rows, less those of what the states explain, and of the measurements over
        their sigma besides, which most signals have none of.

        Parameters
        ----------
        measured_m : ndarray, shape (..., m)
        dp, dv : ndarray, shape (..., m - 1)
            Δp (m) and Δv (m/s) of the legs; any value where a stretch begins.

        Returns
        -------
        legs : two ndarray, shape (..., m - 1)
            Over their covariance's root, zero where a stretch begins.
        explained : ndarray, shape (..., states · m)
        """
        legs, right = self._sides(measured_m, dp, dv)
        explained, _ = lapack.dtbtrs(self.lower, right.T, uplo="L", overwrite_b=1)
        return legs, explained.T.reshape(*dp.shape[:-1], -1)

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Most likely states: position and velocity first, shape (..., m, states); as `whiten`."""
        _, right = self._sides(measured_m, dp, dv)
        state, _ = lapack.dpbtrs(self.lower, right.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, self.states))

    def _sides(self, measured_m: Array, dp: Array, dv: Array) -> tuple[tuple[Array, Array], Array]:
        """Legs as `whiten`, and the right side of the equations, shape (columns, states · m)."""
        i00, i01, _ = self.inverse
        # Q⁻¹ = UᵀU; where a stretch begins it is zero
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        first, second = u00 * dp + u01 * dv, self.root * dv
        g0, g1 = u00 * first, u01 * first + self.root * second
        right = np.zeros((*dp.shape[:-1], len(self.precision), self.states))
        right[..., 1:, 0], right[..., 1:, 1] = g0, g1
        right[..., :-1, 0] -= g0
        g0 *= self.length_s
        g0 += g1
        right[..., :-1, 1] -= g0
        if measured_m.any():
            weighed = self.precision[:, 0] * measured_m
            right[..., 0] += weighed
            right[..., 2:] += weighed[..., None]
        return (first, second), right.reshape(-1, self.states * len(self.precision))

    def position_variance(self) -> Array:
        """Variance of each state's position given all data (m²), shape (m,).

        The information about a state is what all before it and what all after it leave of its own
        block of A: the Cholesky factor's blocks from either end (Fraser and Potter 1969).
        """
        # A with its rows and columns in reverse
        turned, size = np.zeros_like(self.bands), self.bands.shape[1]
        for below in range(4):
            turned[below, : size - below] = self.bands[below, : size - below][::-1]
        behind, _ = lapack.dpbtrf(turned, lower=1, overwrite_ab=1)
        (a, c), b = (self.lower[0, at::2] for at in (0, 1)), self.lower[1, 0::2]
        # of the reverse, each block has the velocity first
        (d, f), e = (behind[0, at::2][::-1] for at in (0, 1)), behind[1, 0::2][::-1]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


def factorise(
    length_s: Array,
    noise: Array,
    joined: BoolArray,
    precision: Array,
    slow: tuple[float, float] | None = None,
) -> BandedSystem:
    """Factorise the normal equations of the states at the measurements.

    Parameters
    ----------
    length_s : ndarray, shape (m - 1,)
        Of each leg.
    noise : ndarray, shape (3, m - 1)
        Its Q by elements 00, 01, 11.
    joined : ndarray of bool, shape (m - 1,)
        False where a stretch begins that knows nothing of what was before.
    precision : ndarray, shape (m, 2)
        Of the measured positions, 1/m², 0 for one that is not used, and of the velocities around
        zero.
    slow : (float, float), optional
        As :class:`Positions` has it; what is known of positions must then be measurements.

    Raises
    ------
    numpy.linalg.LinAlgError
        A stretch has too few measurements for a position and a velocity.
    """
    q00, q01, q11 = noise
    measured = precision[:, 0]
    least = LEAST_SHARE**2 * (1.0 / np.median(measured[measured > 0.0]) + q00)
    # of a single step Q has no inverse but for that, which rounding would hide
    product = q00 * q11
    own = product - q01**2
    determinant = np.where(own > SINGULAR * product, own, 0.0) + least * q11
    inverse = np.where(joined, np.stack([q11, -q01, q00 + least]) / determinant, 0.0)
    i00, i01, i11 = inverse
    slope = i00 * length_s
    cross = slope + i01
    # A = Σ precision + [-F I]ᵀ Q⁻¹ [-F I]; by columns, as LAPACK keeps bands
    states = 2 if slow is None else 3
    columns = np.zeros((len(precision), states, states + 2))
    position, velocity = columns[:, 0], columns[:, 1]
    position[:, 0], velocity[:, 0] = precision.T
    position[1:, 0] += i00
    position[1:, 1] = i01
    velocity[1:, 0] += i11
    position[:-1, 0] += i00
    position[:-1, 1] += cross
    velocity[:-1, 0] += (cross + i01) * length_s + i11
    position[:-1, states], position[:-1, states + 1] = -i00, -i01
    velocity[:-1, states - 1], velocity[:-1, states] = -cross, -(i01 * length_s + i11)
    log_noise = np.sum(np.log(determinant[joined]))
    if slow is not None:
        sigma, tau_s = slow
        kept = np.where(joined, np.exp(-length_s / tau_s), 0.0)
        variance = sigma**2 * np.append(1.0, 1.0 - kept**2)  # of what is new in each state
        error = columns[:, 2]
        position[:, 2] = measured
        error[:, 0] = measured + 1.0 / variance
        error[:-1, 0] += kept**2 / variance[1:]
        error[:-1, states] = -kept / variance[1:]
        log_noise += np.sum(np.log(variance))
    bands = columns.reshape(-1, states + 2).T
    lower, broken = lapack.dpbtrf(bands, lower=1)
    if broken:
        raise np.linalg.LinAlgError("a stretch has too few measurements")
    log_lower = 2.0 * np.sum(np.log(lower[0]))
    log_determinant = log_lower + log_noise - np.sum(np.log(precision[precision > 0.0]))
    root = np.where(joined, 1.0 / np.sqrt(q11), 0.0)
    return BandedSystem(precision, length_s, inverse, root, bands, lower, float(log_determinant))
