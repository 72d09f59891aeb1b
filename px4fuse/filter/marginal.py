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

UNIT_SCALE = np.ones(1)
# SIGMA_A and SIGMA_Z of a smooth path
PATH_SIGMAS = 0.5, 0.1
# Precision of a start (1/m²) above which it is known, below which as good as nothing is
KNOWN_START_PRECISION = 1e-3
# Position noise of a leg that is always there, over a measurement's and over its own: Q has an
# inverse, also that of a single step, which is of rank one, or without process noise
MIN_NOISE_SHARE = 1e-5
# Signals whose states are found at once: more take more memory, and no less time
SIGNAL_BATCH_SIZE = 8
# A determinant below this share of its terms is their rounding
MIN_DETERMINANT_SHARE = 1e-12


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
        noise_fixed = self.noise_fixed / sigma_z_m**2
        noise_fixed[0] += self.length_s * walk**2
        start_weights = np.ones(len(self.measurement_m) - len(weight))
        slow = self.slow and (self.slow[0] / sigma_z_m, self.slow[1])
        scaled_positions = replace(
            self, noise_fixed=noise_fixed, initial=self.initial * sigma_z_m**2, slow=slow
        )
        return scaled_positions, 1.0 / np.concatenate([start_weights, weight])

    def systems(
        self, sigma_a_m_s2: float, variance_m2: Array
    ) -> Iterator[tuple[list[int], BandedSystem, int]]:
        """Banded systems, each with the axes that it serves, and their degrees of freedom.

        An axis that is measured at the same times as another shares its system.
        """
        is_measured = np.isfinite(self.measurement_m)
        noise = sigma_a_m_s2**2 * self.noise_unit + self.noise_fixed
        remaining_axes = list(range(is_measured.shape[1]))
        while remaining_axes:
            is_axis_measured = is_measured[:, remaining_axes[0]]
            axes = [
                axis
                for axis in remaining_axes
                if np.array_equal(is_measured[:, axis], is_axis_measured)
            ]
            remaining_axes = [axis for axis in remaining_axes if axis not in axes]
            precision = self.initial.copy()
            # a stretch that this axis hardly measures is held by its start, and says nothing
            has_few = np.add.reduceat(is_axis_measured.astype(int), self.start) < 2
            is_used = is_axis_measured & ~np.repeat(
                has_few, np.diff([*self.start, len(is_measured)])
            )
            precision[:, 0] += np.where(is_used, 1.0 / variance_m2, 0.0)
            precision[self.start[has_few]] += 1.0
            is_known = (precision > 0.0) & (
                (precision > self.initial) | (self.initial > KNOWN_START_PRECISION)
            )
            system = factorise(self.length_s, noise, self.joined, precision, self.slow)
            # where the start is as good as unknown, what is known of it does not count
            log_unknown_precision = float(np.sum(np.log(precision[(precision > 0.0) & ~is_known])))
            system = replace(system, log_determinant=system.log_determinant + log_unknown_precision)
            yield axes, system, int(np.count_nonzero(is_known)) - 2 * len(self.start)


@dataclass(frozen=True)
class FittedPositions:
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

    def scaled(self, sigma: float) -> FittedPositions:
        """The same with all noises ``sigma`` times as large."""
        log_determinant = self.log_determinant + 2.0 * self.freedom * float(np.log(sigma))
        return replace(self, gram=self.gram / sigma**2, log_determinant=log_determinant)

    def constants(self) -> Array:
        """Most likely constants, shape (s, T, c)."""
        information = self.gram[..., 1:, 1:] + np.diag(self.constant_sigma**-2.0)
        return np.asarray(-np.linalg.solve(information, self.gram[..., 1:, :1])[..., 0])

    def by_stretch(self, scales: Array = UNIT_SCALE) -> Array:
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

    def totals(self, scales: Array = UNIT_SCALE) -> Array:
        """-ln p of all with all noises so many times as large, but for a constant, (k, T)."""
        noises_alone = 0.5 * self.log_determinant + self.freedom * np.log(scales)
        return np.asarray(self.by_stretch(scales).sum(axis=1) + noises_alone[:, None])


def fit_positions(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array, measured_m: Array | None = None
) -> FittedPositions:
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
    for axes, system, axis_freedom in positions.systems(sigma_a_m_s2, variance_m2):
        log_determinant += len(axes) * system.log_determinant
        freedom += len(axes) * axis_freedom
        data = measured_m[axes]
        intervals, explained = system.whiten(data, dp[axes], dv[axes])
        signals = (np.sqrt(system.precision[:, 0]) * data, *intervals, explained)
        for segment_index, (begin, end) in enumerate(positions.stretches):
            rows = slice(begin, end - 1)
            states = slice(system.states * begin, system.states * end)
            for sign, array, columns in zip(
                (1.0, 1.0, 1.0, -1.0), signals, (slice(begin, end), rows, rows, states), strict=True
            ):
                signal = array[..., columns]
                gram[segment_index] += sign * (signal @ np.swapaxes(signal, -1, -2)).sum(axis=0)
    return FittedPositions(gram, log_determinant, freedom, positions.constant_sigma)


def centre_on_path(positions: Positions, *, scaled: bool = False) -> Positions:
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
    sigma_a, sigma_z = PATH_SIGMAS
    for axes, system, _ in positions.systems(sigma_a, np.full(len(measured), sigma_z**2)):
        data = np.nan_to_num(measured[:, axes].T)[:, None]
        state = system.solve(data, dp[axes, :, 0], dv[axes, :, 0])
        state[:, :, positions.start] = 0.0
        path, speed = state[..., 0], state[..., 1]
        measured[:, axes] -= path[:, 0].T
        path_increment = np.diff(path) - positions.length_s * speed[..., :-1]
        # one path is taken out of all; a scale is of the path to which each input leads
        for array, increment in ((dp, path_increment), (dv, np.diff(speed))):
            array[axes, :, 0] -= increment[:, :1]
            if scaled:
                array[axes, :, -1] = increment
    return replace(positions, measurement_m=measured, delta_position_m=dp, delta_velocity_m_s=dv)


def expected_squares(
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
    interval_weight = np.repeat(weight, np.diff([*positions.start, len(variance_m2)]), axis=0)[1:]
    increments = positions.delta_position_m, positions.delta_velocity_m_s
    dp, dv = (np.einsum("akn,nk->an", array[:, 0], interval_weight) for array in increments)
    square = np.zeros(len(variance_m2))
    for axes, system, _ in positions.systems(sigma_a_m_s2, variance_m2):
        measured = positions.measurement_m[:, axes].T
        error = measured - system.solve(np.nan_to_num(measured), dp[axes], dv[axes])[..., 0]
        position_variance = np.where(np.isnan(error), np.nan, system.position_variance())
        square += np.nansum(error**2 + position_variance, axis=0)
    return square, np.isfinite(positions.measurement_m).sum(axis=1)


def products_by_stretch(
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
    measurement_errors, *increments = signals
    constants = positions.delta_position_m[:, 0, 1:], positions.delta_velocity_m_s[:, 0, 1:]
    results = []
    for begin in range(0, measured_m.shape[1], SIGNAL_BATCH_SIZE):
        batch = np.s_[:, begin : begin + SIGNAL_BATCH_SIZE]
        # one set of signals, then the other, then those of the constants
        dp, dv = (
            np.concatenate([increment[batch], 0.0 * increment[batch], constant_signal], axis=1)[
                :, None
            ]
            for increment, constant_signal in zip(increments, constants, strict=True)
        )
        measured = np.zeros((*dp.shape[:3], measurement_errors.shape[-1]))
        first_rows, second_rows, constant_rows = np.split(
            np.arange(dp.shape[2]), np.array([1, 2]) * measurement_errors[batch].shape[1]
        )
        measured[:, 0, first_rows], measured[:, 0, second_rows] = (
            measurement_errors[batch],
            measured_m[batch],
        )
        all_signals = replace(positions, delta_position_m=dp, delta_velocity_m_s=dv)
        gram = fit_positions(all_signals, sigma_a_m_s2, variance_m2, measured).gram[:, 0]
        information = gram[:, constant_rows[:, None], constant_rows] + np.diag(
            positions.constant_sigma**-2.0
        )
        constant_coefficients = np.linalg.solve(
            information, gram[:, constant_rows[:, None], second_rows]
        )
        by_constants = np.einsum(
            "skc,sck->sk", gram[:, first_rows[:, None], constant_rows], constant_coefficients
        )
        results.append(gram[:, first_rows, second_rows] - by_constants)
    return np.concatenate(results, axis=1)


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
    inverse_sqrt_q11 : ndarray, shape (m - 1,)
        1/√Q₁₁, as Q⁻¹ has it but for rounding; zero where a stretch begins.
    bands, lower : ndarray, shape (2 + states, states · m)
        Bands of A and of its Cholesky factor.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision: twice the part of -ln p that no signal enters.
    """

    precision: Array
    length_s: Array
    inverse: Array
    inverse_sqrt_q11: Array
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
        intervals : two ndarray, shape (..., m - 1)
            Over their covariance's root, zero where a stretch begins.
        explained : ndarray, shape (..., states · m)
        """
        intervals, right = self._interval_sides(measured_m, dp, dv)
        explained, _ = lapack.dtbtrs(self.lower, right.T, uplo="L", overwrite_b=1)
        return intervals, explained.T.reshape(*dp.shape[:-1], -1)

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Most likely states: position and velocity first, shape (..., m, states); as `whiten`."""
        _, right = self._interval_sides(measured_m, dp, dv)
        state, _ = lapack.dpbtrs(self.lower, right.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, self.states))

    def _interval_sides(
        self, measured_m: Array, dp: Array, dv: Array
    ) -> tuple[tuple[Array, Array], Array]:
        """Legs as `whiten`, and the right side of the equations, shape (columns, states · m)."""
        i00, i01, _ = self.inverse
        # Q⁻¹ = UᵀU; where a stretch begins it is zero
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        first, second = u00 * dp + u01 * dv, self.inverse_sqrt_q11 * dv
        g0, g1 = u00 * first, u01 * first + self.inverse_sqrt_q11 * second
        right_side = np.zeros((*dp.shape[:-1], len(self.precision), self.states))
        right_side[..., 1:, 0], right_side[..., 1:, 1] = g0, g1
        right_side[..., :-1, 0] -= g0
        g0 *= self.length_s
        g0 += g1
        right_side[..., :-1, 1] -= g0
        if measured_m.any():
            weighted_m = self.precision[:, 0] * measured_m
            right_side[..., 0] += weighted_m
            right_side[..., 2:] += weighted_m[..., None]
        return (first, second), right_side.reshape(-1, self.states * len(self.precision))

    def position_variance(self) -> Array:
        """Variance of each state's position given all data (m²), shape (m,).

        The information about a state is what all before it and what all after it leave of its own
        block of A: the Cholesky factor's blocks from either end (Fraser and Potter 1969).
        """
        # A with its rows and columns in reverse
        reversed_bands, size = np.zeros_like(self.bands), self.bands.shape[1]
        for below in range(4):
            reversed_bands[below, : size - below] = self.bands[below, : size - below][::-1]
        reversed_lower, _ = lapack.dpbtrf(reversed_bands, lower=1, overwrite_ab=1)
        (a, c), b = (self.lower[0, at::2] for at in (0, 1)), self.lower[1, 0::2]
        # of the reverse, each block has the velocity first
        (d, f), e = (reversed_lower[0, at::2][::-1] for at in (0, 1)), reversed_lower[1, 0::2][::-1]
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
    min_noise = MIN_NOISE_SHARE**2 * (1.0 / np.median(measured[measured > 0.0]) + q00)
    # of a single step Q has no inverse but for that, which rounding would hide
    product = q00 * q11
    raw_determinant = product - q01**2
    determinant = (
        np.where(raw_determinant > MIN_DETERMINANT_SHARE * product, raw_determinant, 0.0)
        + min_noise * q11
    )
    inverse = np.where(joined, np.stack([q11, -q01, q00 + min_noise]) / determinant, 0.0)
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
        rho = np.where(joined, np.exp(-length_s / tau_s), 0.0)
        variance = sigma**2 * np.append(1.0, 1.0 - rho**2)  # of what is new in each state
        error = columns[:, 2]
        position[:, 2] = measured
        error[:, 0] = measured + 1.0 / variance
        error[:-1, 0] += rho**2 / variance[1:]
        error[:-1, states] = -rho / variance[1:]
        log_noise += np.sum(np.log(variance))
    bands = columns.reshape(-1, states + 2).T
    lower, is_singular = lapack.dpbtrf(bands, lower=1)
    if is_singular:
        raise np.linalg.LinAlgError("a stretch has too few measurements")
    log_lower = 2.0 * np.sum(np.log(lower[0]))
    log_determinant = log_lower + log_noise - np.sum(np.log(precision[precision > 0.0]))
    inverse_sqrt_q11 = np.where(joined, 1.0 / np.sqrt(q11), 0.0)
    return BandedSystem(
        precision, length_s, inverse, inverse_sqrt_q11, bands, lower, float(log_determinant)
    )
