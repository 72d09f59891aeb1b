"""Likelihood of positions along several axes, with unknown constant errors.

A segment is a part of the flight without a gap in the IMU data. Each segment has an unknown initial
state and unknown constants (biases and other constant errors).

Given the acceleration, -2 ln p of the states x_k = [p, v] at the measurements is a sum of squares:

- x_{k+1} - Fx_k - [Δp, Δv] of each interval, weighted by Q⁻¹;
- z - p of each measurement, over its variance.

The matrix A of this quadratic form has three bands below the diagonal, so LAPACK factorises a
flight in a millisecond. log|A| and the squared residuals at the minimum give the likelihood, which
equals that of KF's innovations (Schweppe 1965).

The data, and their derivative with respect to each constant, are inputs of one linear system. The
Schur complement of the inner products of the inputs eliminates the constants. Time-correlated noise
is a third state, c_{k+1} = ρ c_k + noise, in the measurement: z - p - c.

Symbols in shapes: m measurements, a axes, s segments, T time offsets, c constants.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray

UNIT_SCALE = np.ones(1)
# SIGMA_A (m/s²) and SIGMA_Z (m) with which positions are smoothed to a path
SMOOTHED_PATH_NOISES = 0.5, 0.1
# Minimum prior precision (1/m²) of an initial position that is known
MIN_KNOWN_START_PRECISION = 1e-3
# MIN_NOISE_RATIO² · (R + Q₀₀) is added to Q₀₀, to make a singular Q invertible
MIN_NOISE_RATIO = 1e-5
# Number of pairs of inputs whose inner products are computed at once, to limit the memory
INPUT_BATCH_SIZE = 8
# Minimum ratio |Q| / (Q₀₀ Q₁₁): a smaller determinant is a rounding error
MIN_Q_DETERMINANT_RATIO = 1e-12


@dataclass(frozen=True)
class Positions:
    """Positions of one source along several axes, with the integrated acceleration.

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        Measured positions; NaN if an axis has no measurement.
    segment_starts : ndarray of int, shape (s,)
        Index of the first measurement of each segment.
    length_s : ndarray, shape (m - 1,)
        Intervals between measurements; not used between two segments.
    unit_process_noise, added_process_noise : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q for SIGMA_A = 1 m/s², and of additional process noise.
    prior_precision : ndarray, shape (m, 2)
        Prior precision of position and velocity; 0 without a prior.
    constants_prior_sigma : ndarray, shape (c,)
        Prior σ of the unknown constants of each segment.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, m - 1)
        Δp and Δv of each interval, then their derivative with respect to each constant.
    correlated_noise : (float, float) or None
        Standard deviation (m) and time constant (s) of time-correlated noise.
    """

    measurement_m: Array
    segment_starts: IntArray
    length_s: Array
    unit_process_noise: Array
    added_process_noise: Array
    prior_precision: Array
    constants_prior_sigma: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    correlated_noise: tuple[float, float] | None = None

    @cached_property
    def segments(self) -> list[tuple[int, int]]:
        """Index of the first measurement of each segment, and of its last measurement plus 1."""
        return list(pairwise([*self.segment_starts.tolist(), len(self.measurement_m)]))

    @cached_property
    def is_joined(self) -> BoolArray:
        """True for the intervals between two measurements of one segment, shape (m - 1,)."""
        return ~np.isin(np.arange(1, len(self.measurement_m)), self.segment_starts)

    def first(self, count: int) -> Positions:
        """Keep the first ``count`` measurements only."""
        interval_rows = np.s_[..., : count - 1]
        return replace(
            self,
            measurement_m=self.measurement_m[:count],
            segment_starts=self.segment_starts[self.segment_starts < count],
            prior_precision=self.prior_precision[:count],
            **{
                name: getattr(self, name)[interval_rows]
                for name in (
                    "length_s",
                    "unit_process_noise",
                    "added_process_noise",
                    "delta_position_m",
                    "delta_velocity_m_s",
                )
            },
        )

    def in_sigma_z_units(
        self, sigma_z_m: float, random_walk: float, measurement_weights: Array
    ) -> tuple[Positions, Array]:
        """Divide all noises by SIGMA_Z; return the positions and the measurement variances.

        ``random_walk`` (1/√s) is the random walk of the source, divided by SIGMA_Z. The variance of
        a measurement is 1 / weight. If the first measurement has no weight, it gets the weight 1.
        """
        added_process_noise = self.added_process_noise / sigma_z_m**2
        added_process_noise[0] += self.length_s * random_walk**2
        start_weights = np.ones(len(self.measurement_m) - len(measurement_weights))
        correlated_noise = self.correlated_noise
        if correlated_noise:
            correlated_noise = correlated_noise[0] / sigma_z_m, correlated_noise[1]
        scaled_positions = replace(
            self,
            added_process_noise=added_process_noise,
            prior_precision=self.prior_precision * sigma_z_m**2,
            correlated_noise=correlated_noise,
        )
        return scaled_positions, 1.0 / np.concatenate([start_weights, measurement_weights])

    def factorised_equations(
        self, sigma_a_m_s2: float, variance_m2: Array
    ) -> Iterator[tuple[list[int], BandedSystem, int]]:
        """Yield (axes, factorised normal equations, degrees of freedom of one axis).

        Axes that are measured at equal times are yielded together: their equations are equal.
        """
        is_measured = np.isfinite(self.measurement_m)
        process_noise = sigma_a_m_s2**2 * self.unit_process_noise + self.added_process_noise
        axes_left = list(range(is_measured.shape[1]))
        while axes_left:
            is_axis_measured = is_measured[:, axes_left[0]]
            axes = [
                axis for axis in axes_left if np.array_equal(is_measured[:, axis], is_axis_measured)
            ]
            axes_left = [axis for axis in axes_left if axis not in axes]
            state_precision = self.prior_precision.copy()
            # Fewer than two measurements do not determine the initial state of a segment. A prior
            # determines it, and the segment does not contribute to the likelihood
            has_too_few = np.add.reduceat(is_axis_measured.astype(int), self.segment_starts) < 2
            is_used = is_axis_measured & ~np.repeat(
                has_too_few, np.diff([*self.segment_starts, len(is_measured)])
            )
            state_precision[:, 0] += np.where(is_used, 1.0 / variance_m2, 0.0)
            state_precision[self.segment_starts[has_too_few]] += 1.0
            is_known = (state_precision > 0.0) & (
                (state_precision > self.prior_precision)
                | (self.prior_precision > MIN_KNOWN_START_PRECISION)
            )
            system = factorise(
                self.length_s,
                process_noise,
                self.is_joined,
                state_precision,
                self.correlated_noise,
            )
            # The weak prior of an unknown initial state must not contribute to the likelihood
            log_unknown_precision = float(
                np.sum(np.log(state_precision[(state_precision > 0.0) & ~is_known]))
            )
            system = replace(system, log_determinant=system.log_determinant + log_unknown_precision)
            yield axes, system, int(np.count_nonzero(is_known)) - 2 * len(self.segment_starts)


@dataclass(frozen=True)
class FittedPositions:
    """Likelihood of positions with one SIGMA_A and SIGMA_Z, for T time offsets.

    Attributes
    ----------
    gram : ndarray, shape (s, T, 1 + c, 1 + c)
        Inner products of the data and their derivatives, weighted by the inverse covariance.
    log_determinant : float
        Logarithm of the determinant of the covariance.
    degrees_of_freedom : int
        Number of measured positions minus the number that determines the initial states.
    constants_prior_sigma : ndarray, shape (c,)
    """

    gram: Array
    log_determinant: float
    degrees_of_freedom: int
    constants_prior_sigma: Array

    def scaled(self, factor: float) -> FittedPositions:
        """Return the likelihood if the σ of all noises is multiplied by ``factor``."""
        log_determinant = self.log_determinant + 2.0 * self.degrees_of_freedom * math.log(factor)
        return replace(self, gram=self.gram / factor**2, log_determinant=log_determinant)

    def information(self) -> Array:
        """Return the inverse covariance of the unknown constants, shape (s, T, c, c)."""
        return np.asarray(self.gram[..., 1:, 1:] + np.diag(self.constants_prior_sigma**-2.0))

    def constants(self) -> Array:
        """Return the maximum-likelihood values of the unknown constants, shape (s, T, c)."""
        return np.asarray(-np.linalg.solve(self.information(), self.gram[..., 1:, :1])[..., 0])

    def scores_by_segment(self, sigma_factors: Array = UNIT_SCALE) -> Array:
        """Return -ln p of each segment, shape (k, s, T), without the log-determinant.

        The σ of all noises is multiplied by each of k ``sigma_factors``.
        """
        scaled_gram = self.gram / sigma_factors[:, None, None, None, None] ** 2
        prior_sigma = self.constants_prior_sigma
        information = scaled_gram[..., 1:, 1:] * np.outer(prior_sigma, prior_sigma) + np.eye(
            len(prior_sigma)
        )
        cross_products = scaled_gram[..., 1:, 0] * prior_sigma
        cholesky = np.linalg.cholesky(information)
        estimated_constants = np.linalg.solve(information, cross_products[..., None])[..., 0]
        log_diagonal = np.log(np.diagonal(cholesky, axis1=-2, axis2=-1)).sum(axis=-1)
        square_sum = scaled_gram[..., 0, 0] - np.sum(cross_products * estimated_constants, axis=-1)
        return np.asarray(0.5 * square_sum + log_diagonal)

    def scores(self, sigma_factors: Array = UNIT_SCALE) -> Array:
        """Return -ln p, shape (k, T), without a constant.

        The σ of all noises is multiplied by each of k ``sigma_factors``.
        """
        determinant_terms = 0.5 * self.log_determinant + self.degrees_of_freedom * np.log(
            sigma_factors
        )
        return np.asarray(
            self.scores_by_segment(sigma_factors).sum(axis=1) + determinant_terms[:, None]
        )


def fit_positions(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array, measured_m: Array | None = None
) -> FittedPositions:
    """Compute the likelihood of positions for one SIGMA_A and one variance of each measurement.

    ``measured_m``, shape (a, 1 or T, k, m), replaces the measured positions of the first k inputs.
    The inputs are the data, then their derivatives.
    """
    if measured_m is None:
        measured_m = np.nan_to_num(positions.measurement_m.T)[:, None, None]
    measured_count = measured_m.shape[2]
    dp = positions.delta_position_m
    dv = positions.delta_velocity_m_s
    gram = np.zeros((len(positions.segment_starts), *dp.shape[1:3], dp.shape[2]))
    log_determinant = 0.0
    degrees_of_freedom = 0
    for axes, system, axis_degrees_of_freedom in positions.factorised_equations(
        sigma_a_m_s2, variance_m2
    ):
        log_determinant += len(axes) * system.log_determinant
        degrees_of_freedom += len(axes) * axis_degrees_of_freedom
        # segment by segment, which limits memory
        for index, (begin, end) in enumerate(positions.segments):
            rows, intervals = slice(begin, end), np.s_[axes, ..., begin : end - 1]
            segment_measured_m = measured_m[axes, ..., rows]
            increments, explained = system.cut(rows).whiten(
                segment_measured_m, dp[intervals], dv[intervals]
            )
            measured = np.sqrt(system.precision[rows, 0]) * segment_measured_m
            gram[index] += _inner_products(increments) - _inner_products(explained)
            gram[index, :, :measured_count, :measured_count] += _inner_products(measured)
    return FittedPositions(
        gram, log_determinant, degrees_of_freedom, positions.constants_prior_sigma
    )


def _inner_products(whitened: Array) -> Array:
    """Return the inner products of all pairs of whitened inputs, summed over the axes."""
    return np.asarray((whitened @ np.swapaxes(whitened, -1, -2)).sum(axis=0))


def centre_on_path(positions: Positions, *, has_scale: bool = False) -> Positions:
    """Subtract a smooth path through the positions from positions and IMU increments.

    The likelihood stays equal, but its rounding errors decrease. With ``has_scale``, the path also
    becomes the derivative with respect to the last constant, the scale of the positions.
    """
    measured_m = positions.measurement_m.copy()
    dp = positions.delta_position_m.copy()
    dv = positions.delta_velocity_m_s.copy()
    sigma_a, sigma_z = SMOOTHED_PATH_NOISES
    for axes, system, _ in positions.factorised_equations(
        sigma_a, np.full(len(measured_m), sigma_z**2)
    ):
        axes_measured_m = np.repeat(np.nan_to_num(measured_m[:, axes].T)[:, None], dp.shape[1], 1)
        smoothed_state = system.solve(axes_measured_m, dp[axes, :, 0], dv[axes, :, 0])
        smoothed_state[:, :, positions.segment_starts] = 0.0
        path_m = smoothed_state[..., 0]
        path_velocity_m_s = smoothed_state[..., 1]
        measured_m[:, axes] -= path_m[:, 0].T
        path_delta_position_m = np.diff(path_m) - positions.length_s * path_velocity_m_s[..., :-1]
        # The path for the first time offset is subtracted for all time offsets
        for array, increment in ((dp, path_delta_position_m), (dv, np.diff(path_velocity_m_s))):
            array[axes, :, 0] -= increment[:, :1]
            if has_scale:
                array[axes, :, -1] = increment
    return replace(positions, measurement_m=measured_m, delta_position_m=dp, delta_velocity_m_s=dv)


def expected_squared_errors(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array, constants: Array
) -> ArrayPair:
    """Return the expected squared error (m²) and the number of measured axes of each measurement.

    Parameters
    ----------
    positions : Positions
        Positions with one time offset.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    constants : ndarray, shape (s, c)
        Maximum-likelihood values of the unknown constants.
    """
    coefficients = np.concatenate([np.ones((len(constants), 1)), constants], axis=1)
    # Δp and Δv are corrected with the constants of the segment in which the interval ends
    interval_coefficients = np.repeat(
        coefficients, np.diff([*positions.segment_starts, len(variance_m2)]), axis=0
    )[1:]
    increments = positions.delta_position_m, positions.delta_velocity_m_s
    dp, dv = (np.einsum("akn,nk->an", array[:, 0], interval_coefficients) for array in increments)
    square_m2 = np.zeros(len(variance_m2))
    for axes, system, _ in positions.factorised_equations(sigma_a_m_s2, variance_m2):
        measured_m = positions.measurement_m[:, axes].T
        error_m = measured_m - system.solve(np.nan_to_num(measured_m), dp[axes], dv[axes])[..., 0]
        position_variance = np.where(np.isnan(error_m), np.nan, system.position_variance())
        square_m2 += np.nansum(error_m**2 + position_variance, axis=0)
    return square_m2, np.isfinite(positions.measurement_m).sum(axis=1)


def products_by_segment(
    positions: Positions,
    sigma_a_m_s2: float,
    variance_m2: Array,
    first_inputs: Sequence[Array],
    second_measured_m: Array,
) -> Array:
    """Return the inner products of k pairs of inputs in each of s segments, shape (s, k).

    An input consists of measurements and of changes of position and velocity. The inner product is
    weighted by the inverse covariance. Parts that the unknown constants explain are removed.

    Parameters
    ----------
    positions : Positions
        Positions with one time offset.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    first_inputs : three ndarray, shape (a, k, m) and twice (a, k, m - 1)
        Measurements, and changes of position and velocity, along a axes: first input of each pair.
    second_measured_m : ndarray, shape (a, k, m)
        Measurements of the second input of each pair; its changes are zero.
    """
    first_measured_m, *increments = first_inputs
    constant_increments = (
        positions.delta_position_m[:, 0, 1:],
        positions.delta_velocity_m_s[:, 0, 1:],
    )
    batch_products = []
    for begin in range(0, second_measured_m.shape[1], INPUT_BATCH_SIZE):
        batch = np.s_[:, begin : begin + INPUT_BATCH_SIZE]
        # Order: first inputs of the pairs, second inputs, derivatives for the constants
        dp, dv = (
            np.concatenate([increment[batch], 0.0 * increment[batch], constant_increment], axis=1)[
                :, None
            ]
            for increment, constant_increment in zip(increments, constant_increments, strict=True)
        )
        first_rows, second_rows, constant_rows = np.split(
            np.arange(dp.shape[2]), np.array([1, 2]) * first_measured_m[batch].shape[1]
        )
        batch_measured_m = np.concatenate(
            [first_measured_m[batch], second_measured_m[batch]], axis=1
        )[:, None]
        all_inputs = replace(positions, delta_position_m=dp, delta_velocity_m_s=dv)
        gram = fit_positions(all_inputs, sigma_a_m_s2, variance_m2, batch_measured_m).gram[:, 0]
        information = gram[:, constant_rows[:, None], constant_rows] + np.diag(
            positions.constants_prior_sigma**-2.0
        )
        constant_coefficients = np.linalg.solve(
            information, gram[:, constant_rows[:, None], second_rows]
        )
        explained_by_constants = np.einsum(
            "skc,sck->sk", gram[:, first_rows[:, None], constant_rows], constant_coefficients
        )
        batch_products.append(gram[:, first_rows, second_rows] - explained_by_constants)
    return np.concatenate(batch_products, axis=1)


@dataclass(frozen=True)
class BandedSystem:
    """Factorised normal equations of the states at all measurement times.

    Attributes
    ----------
    precision : ndarray, shape (m, 2)
        Precision of position (1/m²) and velocity (s²/m²) from measurement or prior; else 0.
    length_s : ndarray, shape (m - 1,)
        Intervals between successive states.
    inverse_q : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q⁻¹; zero between segments.
    inverse_sqrt_q11 : ndarray, shape (m - 1,)
        1/√Q₁₁; zero between segments.
    bands, cholesky_factor : ndarray, shape (2 + states, states · m)
        Matrix A and its Cholesky factor in LAPACK's band storage.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision.
    """

    precision: Array
    length_s: Array
    inverse_q: Array
    inverse_sqrt_q11: Array
    bands: Array
    cholesky_factor: Array
    log_determinant: float

    @property
    def state_count(self) -> int:
        """2 (position, velocity), or 3 with time-correlated noise."""
        return len(self.bands) - 2

    def cut(self, rows: slice) -> BandedSystem:
        """Return the equations of one segment, which does not depend on others."""
        columns = slice(self.state_count * rows.start, self.state_count * rows.stop)
        intervals = slice(rows.start, rows.stop - 1)
        return replace(
            self,
            precision=self.precision[rows],
            length_s=self.length_s[intervals],
            inverse_q=self.inverse_q[:, intervals],
            inverse_sqrt_q11=self.inverse_sqrt_q11[intervals],
            bands=self.bands[:, columns],
            cholesky_factor=self.cholesky_factor[:, columns],
        )

    def whiten(self, measured_m: Array, dp: Array, dv: Array) -> ArrayPair:
        """Return whitened Δp and Δv of inputs, and the component that the states explain.

        They give the inner product of two inputs, weighted by the inverse covariance: the product
        of whitened Δp and Δv, minus that of explained components, plus that of measurements / σ².
        ``measured_m``, shape (..., k, m), contains the measurements of the first k inputs.
        """
        whitened, right_side = self._whiten_increments(measured_m, dp, dv)
        # A unit diagonal is 30 % faster, because it needs no division in each row
        diagonal = self.cholesky_factor[0]
        unit_factor = self.cholesky_factor / diagonal
        explained, _ = lapack.dtbtrs(unit_factor, right_side.T, uplo="L", diag="U", overwrite_b=1)
        return whitened, (explained.T / diagonal).reshape(*dp.shape[:-1], -1)

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Return the estimated states, position and velocity first, shape (..., m, states)."""
        _, right_side = self._whiten_increments(measured_m, dp, dv)
        state, _ = lapack.dpbtrs(self.cholesky_factor, right_side.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, self.state_count))

    def _whiten_increments(self, measured_m: Array, dp: Array, dv: Array) -> ArrayPair:
        """Return whitened Δp and Δv, and the right-hand side of the normal equations."""
        i00, i01, _ = self.inverse_q
        # Cholesky factor U of Q⁻¹ = UᵀU
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        whitened = np.empty((*dp.shape, 2))
        whitened[..., 0] = u00 * dp + u01 * dv
        whitened[..., 1] = self.inverse_sqrt_q11 * dv
        g0 = u00 * whitened[..., 0]
        g1 = u01 * whitened[..., 0] + self.inverse_sqrt_q11 * whitened[..., 1]
        right_side = np.zeros((*dp.shape[:-1], len(self.precision), self.state_count))
        right_side[..., 1:, 0] = g0
        right_side[..., 1:, 1] = g1
        right_side[..., :-1, 0] -= g0
        g0 *= self.length_s
        g0 += g1
        right_side[..., :-1, 1] -= g0
        weighted_measurements = self.precision[:, 0] * measured_m
        measured_side = right_side[..., : measured_m.shape[-2], :, :]
        measured_side[..., 0] += weighted_measurements
        measured_side[..., 2:] += weighted_measurements[..., None]
        return whitened.reshape(*dp.shape[:-1], -1), right_side.reshape(
            -1, self.state_count * len(self.precision)
        )

    def position_variance(self) -> Array:
        """Return the variance (m²) of the position at each measurement, given all measurements.

        The information from earlier and from later measurements is added. Both are blocks of
        Cholesky factors: of A, and of A in reversed order (Fraser and Potter 1969).
        """
        # The order of the rows and columns of A is reversed
        reversed_bands = np.zeros_like(self.bands)
        unknown_count = self.bands.shape[1]
        for band in range(4):
            reversed_bands[band, : unknown_count - band] = self.bands[band, : unknown_count - band][
                ::-1
            ]
        reversed_lower, _ = lapack.dpbtrf(reversed_bands, lower=1, overwrite_ab=1)
        (a, c) = (self.cholesky_factor[0, first_row::2] for first_row in (0, 1))
        b = self.cholesky_factor[1, 0::2]
        # In reversed order, velocity is before position
        (d, f) = (reversed_lower[0, first_row::2][::-1] for first_row in (0, 1))
        e = reversed_lower[1, 0::2][::-1]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


def factorise(
    length_s: Array,
    process_noise: Array,
    is_joined: BoolArray,
    state_precision: Array,
    correlated_noise: tuple[float, float] | None = None,
) -> BandedSystem:
    """Factorise the normal equations of the states at the measurements.

    Parameters
    ----------
    length_s : ndarray, shape (m - 1,)
        Intervals between the states.
    process_noise : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q of each interval.
    is_joined : ndarray of bool, shape (m - 1,)
        False between segments.
    state_precision : ndarray, shape (m, 2)
        See :class:`BandedSystem`; without priors if there is time-correlated noise.
    correlated_noise : (float, float), optional
        See :class:`Positions`.

    Raises
    ------
    numpy.linalg.LinAlgError
        A segment has too few measurements for a position and a velocity.
    """
    q00, q01, q11 = process_noise
    measured_precision = state_precision[:, 0]
    min_noise = MIN_NOISE_RATIO**2 * (
        1.0 / np.median(measured_precision[measured_precision > 0.0]) + q00
    )
    # Q of one prediction step is singular. min_noise makes it invertible, if rounding errors of the
    # determinant are removed
    variance_product = q00 * q11
    raw_determinant = variance_product - q01**2
    determinant = (
        np.where(raw_determinant > MIN_Q_DETERMINANT_RATIO * variance_product, raw_determinant, 0.0)
        + min_noise * q11
    )
    inverse_q = np.where(is_joined, np.stack([q11, -q01, q00 + min_noise]) / determinant, 0.0)
    i00, i01, i11 = inverse_q
    velocity_weight = i00 * length_s
    cross_weight = velocity_weight + i01
    # A = Σ precision + [-F I]ᵀ Q⁻¹ [-F I], in the columns of LAPACK's band storage
    state_count = 2 if correlated_noise is None else 3
    band_columns = np.zeros((len(state_precision), state_count, state_count + 2))
    position_rows = band_columns[:, 0]
    velocity_rows = band_columns[:, 1]
    position_rows[:, 0], velocity_rows[:, 0] = state_precision.T
    position_rows[1:, 0] += i00
    position_rows[1:, 1] = i01
    velocity_rows[1:, 0] += i11
    position_rows[:-1, 0] += i00
    position_rows[:-1, 1] += cross_weight
    velocity_rows[:-1, 0] += (cross_weight + i01) * length_s + i11
    position_rows[:-1, state_count] = -i00
    position_rows[:-1, state_count + 1] = -i01
    velocity_rows[:-1, state_count - 1] = -cross_weight
    velocity_rows[:-1, state_count] = -(i01 * length_s + i11)
    log_noise = np.sum(np.log(determinant[is_joined]))
    if correlated_noise is not None:
        correlated_sigma_m, tau_s = correlated_noise
        rho = np.where(is_joined, np.exp(-length_s / tau_s), 0.0)
        # Variance of the white noise that drives the time-correlated noise at each time
        correlated_variance = correlated_sigma_m**2 * np.append(1.0, 1.0 - rho**2)
        correlated_rows = band_columns[:, 2]
        position_rows[:, 2] = measured_precision
        correlated_rows[:, 0] = measured_precision + 1.0 / correlated_variance
        correlated_rows[:-1, 0] += rho**2 / correlated_variance[1:]
        correlated_rows[:-1, state_count] = -rho / correlated_variance[1:]
        log_noise += np.sum(np.log(correlated_variance))
    bands = band_columns.reshape(-1, state_count + 2).T
    cholesky_factor, is_singular = lapack.dpbtrf(bands, lower=1)
    if is_singular:
        raise np.linalg.LinAlgError("a segment has too few positions to determine an initial state")
    log_factor = 2.0 * np.sum(np.log(cholesky_factor[0]))
    log_determinant = (
        log_factor + log_noise - np.sum(np.log(state_precision[state_precision > 0.0]))
    )
    inverse_sqrt_q11 = np.where(is_joined, 1.0 / np.sqrt(q11), 0.0)
    return BandedSystem(
        state_precision,
        length_s,
        inverse_q,
        inverse_sqrt_q11,
        bands,
        cholesky_factor,
        float(log_determinant),
    )
