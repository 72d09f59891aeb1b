"""Likelihood of positions along several axes, with unknown constant errors.

A segment is a part of the flight without a gap in the IMU data. Each segment has an unknown initial
state and unknown constants (biases and other constant errors).

Given the acceleration, -2 ln p of the states x_k = [p, v] at the measurements is a sum of squares:

- x_{k+1} - Fx_k - [Δp, Δv] of each interval, weighted by Q⁻¹;
- z - p of each measurement, over its variance.

The matrix A of this quadratic form has three bands below the diagonal, so LAPACK factorises a
flight in a millisecond. log|A| and the squared residuals at the minimum give the likelihood, which
equals that of KF's innovations (Schweppe 1965).

The states at the minimum are linear in the data and in the constants. This is a linear regression:
the system is solved for several inputs, the data and their derivative with respect to each
constant. An input consists of z, Δp and Δv of all measurements. The inner products of all inputs,
weighted by the inverse covariance, are a Gram matrix; its Schur complement eliminates the
constants. Time-correlated noise is a third state, c_{k+1} = ρ c_k + noise. The residual of a
measurement is then z - p - c.

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
# Noise parameters with which positions are smoothed to a path
SMOOTHER_SIGMA_A_M_S2, SMOOTHER_SIGMA_Z_M = 0.5, 0.1
# A larger prior precision (1/m² or s²/m²) means that the initial state is known. A smaller one only
# prevents a singular matrix
MIN_KNOWN_STATE_PRECISION = 1e-3
# To make a singular process noise Q invertible, (this ratio)² · (R + Q₀₀) is added to Q₀₀, the
# position variance
ADDED_SIGMA_RATIO = 1e-5
# Number of pairs of inputs (z, Δp and Δv) whose inner products are computed at once, to limit
# memory
INPUT_PAIRS_PER_BATCH = 8
# Minimum ratio |Q| / (Q₀₀ Q₁₁): a smaller determinant is a rounding error
MIN_Q_DETERMINANT_RATIO = 1e-12


@dataclass(frozen=True)
class PositionsAndIncrements:
    """Positions of one source along several axes, and the IMU increments Δp and Δv between them.

    Symbols in shapes: m measurements, a axes, s segments, T tested time offsets, c unknown
    constants (biases, ...).

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        Measured positions; NaN if an axis has no measurement.
    segment_starts : ndarray of int, shape (s,)
        Index of the first measurement of each segment.
    interval_s : ndarray, shape (m - 1,)
        Intervals between measurements; not used between two segments.
    unit_process_noise, added_process_noise : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q for SIGMA_A = 1 m/s², and of additional process noise.
    prior_precision : ndarray, shape (m, 2)
        Prior precision of position and velocity; 0 without a prior.
    constant_prior_sigmas : ndarray, shape (c,)
        Prior σ of the unknown constants of each segment.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, m - 1)
        Position and velocity change by the acceleration in each interval, then their derivative
        with respect to each constant.
    correlated_noise : (float, float) or None
        Standard deviation (m) and time constant (s) of time-correlated noise.
    """

    measurement_m: Array
    segment_starts: IntArray
    interval_s: Array
    unit_process_noise: Array
    added_process_noise: Array
    prior_precision: Array
    constant_prior_sigmas: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    correlated_noise: tuple[float, float] | None = None

    @cached_property
    def segments(self) -> list[tuple[int, int]]:
        """Index of the first measurement of each segment, and of its last measurement plus 1."""
        return list(pairwise([*self.segment_starts.tolist(), len(self.measurement_m)]))

    @cached_property
    def is_within_segment(self) -> BoolArray:
        """True for each interval whose two measurements are in the same segment, shape (m - 1,)."""
        return ~np.isin(np.arange(1, len(self.measurement_m)), self.segment_starts)

    def first(self, count: int) -> PositionsAndIncrements:
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
                    "interval_s",
                    "unit_process_noise",
                    "added_process_noise",
                    "delta_position_m",
                    "delta_velocity_m_s",
                )
            },
        )

    def normalise_by_sigma_z(
        self, sigma_z_m: float, random_walk_to_sigma_z: float, measurement_weights: Array
    ) -> tuple[PositionsAndIncrements, Array]:
        """Divide all σ by SIGMA_Z; return the result and the variance of each measurement.

        ``random_walk_to_sigma_z`` (1/√s) is the random walk of the source, divided by SIGMA_Z. The
        variance is 1 / weight, or 1 for measurements before the first with a weight.
        """
        added_process_noise = self.added_process_noise / sigma_z_m**2
        added_process_noise[0] += self.interval_s * random_walk_to_sigma_z**2
        initial_state_weights = np.ones(len(self.measurement_m) - len(measurement_weights))
        correlated_noise = self.correlated_noise
        if correlated_noise:
            correlated_noise = correlated_noise[0] / sigma_z_m, correlated_noise[1]
        scaled_positions = replace(
            self,
            added_process_noise=added_process_noise,
            prior_precision=self.prior_precision * sigma_z_m**2,
            correlated_noise=correlated_noise,
        )
        return scaled_positions, 1.0 / np.concatenate([initial_state_weights, measurement_weights])

    def factorise_equations(
        self, sigma_a_m_s2: float, variance_m2: Array
    ) -> Iterator[tuple[list[int], BandedSystem, int]]:
        """Factorise the normal equations of the states along each axis.

        Yield (axis indices, factorised equations, degrees of freedom of one axis). Axes that are
        measured at equal times have equal equations and are yielded together.
        """
        is_measured = np.isfinite(self.measurement_m)
        process_noise = sigma_a_m_s2**2 * self.unit_process_noise + self.added_process_noise
        remaining_axes = list(range(is_measured.shape[1]))
        while remaining_axes:
            is_axis_measured = is_measured[:, remaining_axes[0]]
            axes = [
                axis
                for axis in remaining_axes
                if np.array_equal(is_measured[:, axis], is_axis_measured)
            ]
            remaining_axes = [axis for axis in remaining_axes if axis not in axes]
            state_precision = self.prior_precision.copy()
            # Fewer than two measurements do not determine the initial state of a segment. A prior
            # determines it, and the segment does not contribute to the likelihood
            has_too_few_measurements = (
                np.add.reduceat(is_axis_measured.astype(int), self.segment_starts) < 2
            )
            is_used = is_axis_measured & ~np.repeat(
                has_too_few_measurements, np.diff([*self.segment_starts, len(is_measured)])
            )
            state_precision[:, 0] += np.where(is_used, 1.0 / variance_m2, 0.0)
            state_precision[self.segment_starts[has_too_few_measurements]] += 1.0
            is_known = (state_precision > 0.0) & (
                (state_precision > self.prior_precision)
                | (self.prior_precision > MIN_KNOWN_STATE_PRECISION)
            )
            system = factorise(
                self.interval_s,
                process_noise,
                self.is_within_segment,
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
class PositionFit:
    """Fit of the constants (biases, ...) to positions with given noise parameters.

    Attributes
    ----------
    gram : ndarray, shape (segments, time offsets, 1 + c, 1 + c)
        Inner products of the data, and of their derivatives with respect to the constants, weighted
        by the inverse covariance of the positions.
    covariance_log_determinant : float
        Logarithm of the determinant of this covariance.
    degrees_of_freedom : int
        Number of measured positions minus the number that determines the initial states.
    constant_prior_sigmas : ndarray, shape (c,)
        Prior σ of the c constants.
    """

    gram: Array
    covariance_log_determinant: float
    degrees_of_freedom: int
    constant_prior_sigmas: Array

    def scale_sigmas(self, factor: float) -> PositionFit:
        """Return the fit with the σ of all noises multiplied by ``factor``."""
        covariance_log_determinant = (
            self.covariance_log_determinant + 2.0 * self.degrees_of_freedom * math.log(factor)
        )
        return replace(
            self, gram=self.gram / factor**2, covariance_log_determinant=covariance_log_determinant
        )

    def compute_information(self) -> Array:
        """Return the inverse covariance of the constants, shape (segments, time offsets, c, c)."""
        return np.asarray(self.gram[..., 1:, 1:] + np.diag(self.constant_prior_sigmas**-2.0))

    def estimate_segment_constants(self) -> Array:
        """Return maximum-likelihood constants (biases, ...), shape (segments, time offsets, c)."""
        return np.asarray(
            -np.linalg.solve(self.compute_information(), self.gram[..., 1:, :1])[..., 0]
        )

    def compute_segment_scores(self, sigma_factors: Array = UNIT_SCALE) -> Array:
        """Return -ln p of the positions in each segment, shape (factors, segments, time offsets).

        All σ are multiplied by each of ``sigma_factors``. The log-determinant of the covariance,
        which is equal for all time offsets, is omitted.
        """
        scaled_gram = self.gram / sigma_factors[:, None, None, None, None] ** 2
        prior_sigma = self.constant_prior_sigmas
        information = scaled_gram[..., 1:, 1:] * np.outer(prior_sigma, prior_sigma) + np.eye(
            len(prior_sigma)
        )
        cross_products = scaled_gram[..., 1:, 0] * prior_sigma
        cholesky_factor = np.linalg.cholesky(information)
        estimated_constants = np.linalg.solve(information, cross_products[..., None])[..., 0]
        half_log_determinant = np.log(np.diagonal(cholesky_factor, axis1=-2, axis2=-1)).sum(axis=-1)
        square_sum = scaled_gram[..., 0, 0] - np.sum(cross_products * estimated_constants, axis=-1)
        return np.asarray(0.5 * square_sum + half_log_determinant)

    def compute_scores(self, sigma_factors: Array = UNIT_SCALE) -> Array:
        """Return -ln p of the positions, shape (factors, time offsets), without a constant term.

        All σ are multiplied by each of ``sigma_factors``.
        """
        determinant_terms = (
            0.5 * self.covariance_log_determinant + self.degrees_of_freedom * np.log(sigma_factors)
        )
        return np.asarray(
            self.compute_segment_scores(sigma_factors).sum(axis=1) + determinant_terms[:, None]
        )


def fit_positions(
    positions: PositionsAndIncrements,
    sigma_a_m_s2: float,
    variance_m2: Array,
    measured_m: Array | None = None,
) -> PositionFit:
    """Fit the constants (biases, ...) to positions, with given SIGMA_A and measurement variances.

    The inputs are the data, then their derivative with respect to each constant. ``measured_m``,
    shape (axes, 1 or time offsets, k, measurements), contains the measured positions of the first k
    inputs, by default of the data only. They are zero for the other inputs.
    """
    if measured_m is None:
        measured_m = np.nan_to_num(positions.measurement_m.T)[:, None, None]
    measured_input_count = measured_m.shape[2]
    dp = positions.delta_position_m
    dv = positions.delta_velocity_m_s
    gram = np.zeros((len(positions.segment_starts), *dp.shape[1:3], dp.shape[2]))
    log_determinant = 0.0
    degrees_of_freedom = 0
    for axes, system, axis_degrees_of_freedom in positions.factorise_equations(
        sigma_a_m_s2, variance_m2
    ):
        log_determinant += len(axes) * system.log_determinant
        degrees_of_freedom += len(axes) * axis_degrees_of_freedom
        # segment by segment, which limits memory
        for index, (begin, end) in enumerate(positions.segments):
            rows, interval_index = slice(begin, end), np.s_[axes, ..., begin : end - 1]
            segment_measured_m = measured_m[axes, ..., rows]
            increments, state_projection = system.cut(rows).whiten(
                segment_measured_m, dp[interval_index], dv[interval_index]
            )
            whitened_measurements = np.sqrt(system.precision[rows, 0]) * segment_measured_m
            gram[index] += _compute_gram(increments) - _compute_gram(state_projection)
            gram[index, :, :measured_input_count, :measured_input_count] += _compute_gram(
                whitened_measurements
            )
    return PositionFit(gram, log_determinant, degrees_of_freedom, positions.constant_prior_sigmas)


def _compute_gram(whitened: Array) -> Array:
    """Return XXᵀ of whitened inputs X, shape (axes, ..., inputs, values), summed over axes."""
    return np.asarray((whitened @ np.swapaxes(whitened, -1, -2)).sum(axis=0))


def subtract_smooth_path(
    positions: PositionsAndIncrements, *, estimates_scale: bool = False
) -> PositionsAndIncrements:
    """Subtract a smooth path through the positions from positions and IMU increments.

    The likelihood stays equal, but its rounding errors decrease. With ``estimates_scale``, the path
    becomes the derivative with respect to the last constant, the scale factor error of positions.
    """
    measured_m = positions.measurement_m.copy()
    dp = positions.delta_position_m.copy()
    dv = positions.delta_velocity_m_s.copy()
    for axes, system, _ in positions.factorise_equations(
        SMOOTHER_SIGMA_A_M_S2, np.full(len(measured_m), SMOOTHER_SIGMA_Z_M**2)
    ):
        measured_m_by_axis = np.repeat(
            np.nan_to_num(measured_m[:, axes].T)[:, None], dp.shape[1], 1
        )
        smoothed_state = system.solve(measured_m_by_axis, dp[axes, :, 0], dv[axes, :, 0])
        smoothed_state[:, :, positions.segment_starts] = 0.0
        path_m = smoothed_state[..., 0]
        path_velocity_m_s = smoothed_state[..., 1]
        measured_m[:, axes] -= path_m[:, 0].T
        path_delta_position_m = np.diff(path_m) - positions.interval_s * path_velocity_m_s[..., :-1]
        # The measurements do not depend on the time offset, so the path of the first time offset is
        # subtracted for all time offsets
        for array, increment in ((dp, path_delta_position_m), (dv, np.diff(path_velocity_m_s))):
            array[axes, :, 0] -= increment[:, :1]
            if estimates_scale:
                array[axes, :, -1] = increment
    return replace(positions, measurement_m=measured_m, delta_position_m=dp, delta_velocity_m_s=dv)


def estimate_squared_errors(
    positions: PositionsAndIncrements, sigma_a_m_s2: float, variance_m2: Array, constants: Array
) -> ArrayPair:
    """Return the expected squared error (m²) and the number of measured axes of each measurement.

    The error is measured minus true position. Its expected square is the squared residual of the
    smoothed position plus the variance of this position, summed over the axes.

    Parameters
    ----------
    positions : PositionsAndIncrements
        Positions with one time offset.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    constants : ndarray, shape (segments, c)
        Maximum-likelihood values of the constants (biases, ...).
    """
    input_weights = np.concatenate([np.ones((len(constants), 1)), constants], axis=1)
    # Correct Δp and Δv of each interval with the constants (biases, ...) of its segment
    interval_input_weights = np.repeat(
        input_weights, np.diff([*positions.segment_starts, len(variance_m2)]), axis=0
    )[1:]
    increments = positions.delta_position_m, positions.delta_velocity_m_s
    dp, dv = (np.einsum("akn,nk->an", array[:, 0], interval_input_weights) for array in increments)
    expected_squared_error_m2 = np.zeros(len(variance_m2))
    for axes, system, _ in positions.factorise_equations(sigma_a_m_s2, variance_m2):
        measured_m = positions.measurement_m[:, axes].T
        error_m = measured_m - system.solve(np.nan_to_num(measured_m), dp[axes], dv[axes])[..., 0]
        position_variance = np.where(np.isnan(error_m), np.nan, system.position_variance())
        expected_squared_error_m2 += np.nansum(error_m**2 + position_variance, axis=0)
    return expected_squared_error_m2, np.isfinite(positions.measurement_m).sum(axis=1)


def compute_segment_inner_products(
    positions: PositionsAndIncrements,
    sigma_a_m_s2: float,
    variance_m2: Array,
    first_positions_and_increments: Sequence[Array],
    second_input_positions_m: Array,
) -> Array:
    """Return the inner product uᵀC⁻¹v of each of k pairs of inputs, shape (segments, k).

    An input u or v consists of measured positions, Δp and Δv. C is the covariance of the positions
    given the acceleration, including the effect of the unknown constants (biases, ...).

    Parameters
    ----------
    positions : PositionsAndIncrements
        Positions with one time offset.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    first_positions_and_increments : three ndarray
        First input u of each pair: measured positions, shape (axes, k, m); Δp and Δv, shape (axes,
        k, m - 1).
    second_input_positions_m : ndarray, shape (axes, k, m)
        Measured positions of the second input v of each pair; its Δp and Δv are zero.
    """
    first_positions_m, *increments = first_positions_and_increments
    constant_increments = (
        positions.delta_position_m[:, 0, 1:],
        positions.delta_velocity_m_s[:, 0, 1:],
    )
    batch_products = []
    for begin in range(0, second_input_positions_m.shape[1], INPUT_PAIRS_PER_BATCH):
        batch = np.s_[:, begin : begin + INPUT_PAIRS_PER_BATCH]
        # Stack the first inputs of all pairs, the second inputs of all pairs, and the derivatives
        # of the data with respect to the constants
        dp, dv = (
            np.concatenate([increment[batch], 0.0 * increment[batch], constant_increment], axis=1)[
                :, None
            ]
            for increment, constant_increment in zip(increments, constant_increments, strict=True)
        )
        first_input_rows, second_input_rows, constant_rows = np.split(
            np.arange(dp.shape[2]), np.array([1, 2]) * first_positions_m[batch].shape[1]
        )
        batch_measured_m = np.concatenate(
            [first_positions_m[batch], second_input_positions_m[batch]], axis=1
        )[:, None]
        stacked_positions = replace(positions, delta_position_m=dp, delta_velocity_m_s=dv)
        gram = fit_positions(stacked_positions, sigma_a_m_s2, variance_m2, batch_measured_m).gram[
            :, 0
        ]
        information = gram[:, constant_rows[:, None], constant_rows] + np.diag(
            positions.constant_prior_sigmas**-2.0
        )
        constant_coefficients = np.linalg.solve(
            information, gram[:, constant_rows[:, None], second_input_rows]
        )
        products_due_to_constants = np.einsum(
            "skc,sck->sk", gram[:, first_input_rows[:, None], constant_rows], constant_coefficients
        )
        batch_products.append(
            gram[:, first_input_rows, second_input_rows] - products_due_to_constants
        )
    return np.concatenate(batch_products, axis=1)


@dataclass(frozen=True)
class BandedSystem:
    """Factorised normal equations Ax = b of the states x (position, velocity) at all measurements.

    Attributes
    ----------
    precision : ndarray, shape (m, 2)
        Precision of position (1/m²) and velocity (s²/m²): sum of measurement and prior.
    interval_s : ndarray, shape (m - 1,)
        Time between successive measurements.
    inverse_q : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of the inverse process noise Q⁻¹; zero for intervals between segments.
    inverse_sqrt_q11 : ndarray, shape (m - 1,)
        1/√Q₁₁; zero for intervals between segments.
    bands, cholesky_factor : ndarray, shape (2 + state_count, state_count · m)
        Information matrix A of all states and its Cholesky factor in LAPACK's band storage.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision.
    """

    precision: Array
    interval_s: Array
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
        """Return the equations of one segment. Segments do not depend on each other."""
        columns = slice(self.state_count * rows.start, self.state_count * rows.stop)
        interval_slice = slice(rows.start, rows.stop - 1)
        return replace(
            self,
            precision=self.precision[rows],
            interval_s=self.interval_s[interval_slice],
            inverse_q=self.inverse_q[:, interval_slice],
            inverse_sqrt_q11=self.inverse_sqrt_q11[interval_slice],
            bands=self.bands[:, columns],
            cholesky_factor=self.cholesky_factor[:, columns],
        )

    def whiten(self, measured_m: Array, dp: Array, dv: Array) -> ArrayPair:
        """Return whitened Δp and Δv of each input (w), and its projection on the states (e).

        An input consists of measured positions z, Δp and Δv. The inner product of inputs i and j,
        weighted by the inverse covariance of the positions, is wᵢᵀwⱼ - eᵢᵀeⱼ + zᵢᵀzⱼ/σ².
        ``measured_m``, shape (..., k, m), contains z of the first k inputs; z of the others is
        zero.
        """
        whitened_increments, right_hand_side = self._whiten_increments(measured_m, dp, dv)
        # LAPACK solves a triangular system with unit diagonal 30 % faster: without divisions
        diagonal = self.cholesky_factor[0]
        unit_diagonal_factor = self.cholesky_factor / diagonal
        state_projection, _ = lapack.dtbtrs(
            unit_diagonal_factor, right_hand_side.T, uplo="L", diag="U", overwrite_b=1
        )
        return whitened_increments, (state_projection.T / diagonal).reshape(*dp.shape[:-1], -1)

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Estimate the states; shape (..., number of measurements, number of states).

        ``dp`` and ``dv`` are the increments of position and velocity from the IMU.

        The states are position (m), velocity (m/s) and time-correlated noise (m), if any.
        """
        _, right_hand_side = self._whiten_increments(measured_m, dp, dv)
        state, _ = lapack.dpbtrs(self.cholesky_factor, right_hand_side.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, self.state_count))

    def _whiten_increments(self, measured_m: Array, dp: Array, dv: Array) -> ArrayPair:
        """Return Δp and Δv whitened with Q, and b of the normal equations Ax = b."""
        inverse_q00, inverse_q01, _ = self.inverse_q
        # Cholesky factor U of Q⁻¹ = UᵀU
        u00 = np.sqrt(inverse_q00)
        u01 = np.divide(inverse_q01, u00, out=np.zeros_like(inverse_q01), where=u00 > 0.0)
        whitened_increments = np.empty((*dp.shape, 2))
        whitened_increments[..., 0] = u00 * dp + u01 * dv
        whitened_increments[..., 1] = self.inverse_sqrt_q11 * dv
        g0 = u00 * whitened_increments[..., 0]
        g1 = u01 * whitened_increments[..., 0] + self.inverse_sqrt_q11 * whitened_increments[..., 1]
        right_hand_side = np.zeros((*dp.shape[:-1], len(self.precision), self.state_count))
        right_hand_side[..., 1:, 0] = g0
        right_hand_side[..., 1:, 1] = g1
        right_hand_side[..., :-1, 0] -= g0
        g0 *= self.interval_s
        g0 += g1
        right_hand_side[..., :-1, 1] -= g0
        weighted_measurements = self.precision[:, 0] * measured_m
        measured_right_hand_side = right_hand_side[..., : measured_m.shape[-2], :, :]
        measured_right_hand_side[..., 0] += weighted_measurements
        measured_right_hand_side[..., 2:] += weighted_measurements[..., None]
        return whitened_increments.reshape(*dp.shape[:-1], -1), right_hand_side.reshape(
            -1, self.state_count * len(self.precision)
        )

    def position_variance(self) -> Array:
        """Return the variance (m²) of the position at each measurement, given all measurements.

        The information from earlier and from later measurements is added (Fraser and Potter 1969).
        That from earlier ones is a block of the Cholesky factor of A (Ax = b), that from later ones
        is a block of the factor of A with reversed rows and columns.
        """
        # Reverse A: its Cholesky factor then contains the information from later measurements
        reversed_bands = np.zeros_like(self.bands)
        unknown_count = self.bands.shape[1]
        for band in range(4):
            reversed_bands[band, : unknown_count - band] = self.bands[band, : unknown_count - band][
                ::-1
            ]
        reversed_cholesky_factor, _ = lapack.dpbtrf(reversed_bands, lower=1, overwrite_ab=1)
        # Diagonal blocks of the Cholesky factors: [[a, 0], [b, c]] of A, [[d, 0], [e, f]] of the
        # reversed A, in which velocity precedes position
        (a, c) = (self.cholesky_factor[0, first_row::2] for first_row in (0, 1))
        b = self.cholesky_factor[1, 0::2]
        (d, f) = (reversed_cholesky_factor[0, first_row::2][::-1] for first_row in (0, 1))
        e = reversed_cholesky_factor[1, 0::2][::-1]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


def factorise(
    interval_s: Array,
    process_noise: Array,
    is_within_segment: BoolArray,
    state_precision: Array,
    correlated_noise: tuple[float, float] | None = None,
) -> BandedSystem:
    """Factorise A of the normal equations Ax = b for the states x at the measurements.

    Parameters
    ----------
    interval_s : ndarray, shape (m - 1,)
        Time between successive measurements.
    process_noise : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q of each interval.
    is_within_segment : ndarray of bool, shape (m - 1,)
        False for intervals between segments.
    state_precision : ndarray, shape (m, 2)
        See :class:`BandedSystem`; without priors if there is time-correlated noise.
    correlated_noise : (float, float), optional
        See :class:`PositionsAndIncrements`.

    Raises
    ------
    numpy.linalg.LinAlgError
        A segment has too few measurements for a position and a velocity.
    """
    q00, q01, q11 = process_noise
    measured_precision = state_precision[:, 0]
    added_variance = ADDED_SIGMA_RATIO**2 * (
        1.0 / np.median(measured_precision[measured_precision > 0.0]) + q00
    )
    # Q of one prediction step is singular. added_variance makes it invertible. Determinants that
    # are only rounding errors are set to zero first
    variance_product = q00 * q11
    raw_determinant = variance_product - q01**2
    determinant = (
        np.where(raw_determinant > MIN_Q_DETERMINANT_RATIO * variance_product, raw_determinant, 0.0)
        + added_variance * q11
    )
    inverse_q = np.where(
        is_within_segment, np.stack([q11, -q01, q00 + added_variance]) / determinant, 0.0
    )
    inverse_q00, inverse_q01, inverse_q11 = inverse_q
    velocity_weight = inverse_q00 * interval_s
    position_velocity_weight = velocity_weight + inverse_q01
    # Information matrix of the states: A = diag(precision) + Σ [-F I]ᵀ Q⁻¹ [-F I] over the
    # intervals, with KF's transition matrix F. It is stored by columns in LAPACK's band format
    state_count = 2 if correlated_noise is None else 3
    band_columns = np.zeros((len(state_precision), state_count, state_count + 2))
    position_rows = band_columns[:, 0]
    velocity_rows = band_columns[:, 1]
    position_rows[:, 0], velocity_rows[:, 0] = state_precision.T
    position_rows[1:, 0] += inverse_q00
    position_rows[1:, 1] = inverse_q01
    velocity_rows[1:, 0] += inverse_q11
    position_rows[:-1, 0] += inverse_q00
    position_rows[:-1, 1] += position_velocity_weight
    velocity_rows[:-1, 0] += (position_velocity_weight + inverse_q01) * interval_s + inverse_q11
    position_rows[:-1, state_count] = -inverse_q00
    position_rows[:-1, state_count + 1] = -inverse_q01
    velocity_rows[:-1, state_count - 1] = -position_velocity_weight
    velocity_rows[:-1, state_count] = -(inverse_q01 * interval_s + inverse_q11)
    process_noise_log_determinant = np.sum(np.log(determinant[is_within_segment]))
    if correlated_noise is not None:
        correlated_sigma_m, tau_s = correlated_noise
        rho = np.where(is_within_segment, np.exp(-interval_s / tau_s), 0.0)
        # Variance of the driving white noise of a first-order Gauss-Markov process: σ_c² at the
        # first time of a segment, then (1 - ρ²) σ_c²
        driving_noise_variance_m2 = correlated_sigma_m**2 * np.append(1.0, 1.0 - rho**2)
        correlated_noise_rows = band_columns[:, 2]
        position_rows[:, 2] = measured_precision
        correlated_noise_rows[:, 0] = measured_precision + 1.0 / driving_noise_variance_m2
        correlated_noise_rows[:-1, 0] += rho**2 / driving_noise_variance_m2[1:]
        correlated_noise_rows[:-1, state_count] = -rho / driving_noise_variance_m2[1:]
        process_noise_log_determinant += np.sum(np.log(driving_noise_variance_m2))
    bands = band_columns.reshape(-1, state_count + 2).T
    cholesky_factor, is_singular = lapack.dpbtrf(bands, lower=1)
    if is_singular:
        raise np.linalg.LinAlgError(
            "the normal equations are singular (too few positions, or large rounding errors)"
        )
    information_log_determinant = 2.0 * np.sum(np.log(cholesky_factor[0]))
    log_determinant = (
        information_log_determinant
        + process_noise_log_determinant
        - np.sum(np.log(state_precision[state_precision > 0.0]))
    )
    inverse_sqrt_q11 = np.where(is_within_segment, 1.0 / np.sqrt(q11), 0.0)
    return BandedSystem(
        state_precision,
        interval_s,
        inverse_q,
        inverse_sqrt_q11,
        bands,
        cholesky_factor,
        float(log_determinant),
    )
