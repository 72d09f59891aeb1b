"""Likelihood of positions along several axes, with unknown constant errors.

A segment is a part of the flight without a gap in the IMU data. Each segment has an unknown initial
state and unknown constants (biases and other constant errors).

For given constants, position and velocity at the measurement times are estimated by least squares
from the measured positions and the IMU acceleration. The normal equations Ax = b have a banded
matrix A. The resulting likelihood equals the likelihood of KF's innovations (Schweppe 1965).

The constants are estimated by linear regression. The dependent variable is the data: measured
positions and IMU increments. The regressors are the derivatives of the data with respect to each
constant. The data and the regressors are called the inputs of the regression. The Gram matrix
contains the inner products of all pairs of inputs, weighted by the inverse covariance of the data.

Symbols in shapes: m measurements, a axes, s segments, T time offsets, c constants.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray

UNIT_SIGMA_FACTOR = np.ones(1)
# Acceleration noise and position noise of the smoother that estimates a path from the positions
PATH_SMOOTHER_SIGMA_A_M_S2, PATH_SMOOTHER_SIGMA_Z_M = 0.5, 0.1
# A position or velocity without a measurement counts as known only if its prior precision (1/m² or
# s²/m²) exceeds this limit
MIN_PRECISION_OF_KNOWN_STATE = 1e-3
# Q can be singular, so a small variance is added to Q₀₀: its σ as a fraction of √(R + Q₀₀)
REGULARISATION_TO_POSITION_SIGMA_RATIO = 1e-5
# Number of inner products that are computed at once, to limit the memory
INNER_PRODUCTS_PER_BATCH = 8
# Minimum ratio |Q| / (Q₀₀ Q₁₁): a smaller determinant is a rounding error
MIN_DETERMINANT_TO_VARIANCE_PRODUCT_RATIO = 1e-12


@dataclass(frozen=True)
class PositionsAndIncrements:
    """Positions of one source along several axes, with the IMU increments Δp and Δv between them.

    Symbols in shapes: m measurements, a axes, s segments, T tested time offsets, c unknown
    constants (biases, ...).

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        Measured positions; NaN if an axis has none.
    segment_start_indices : ndarray of int, shape (s,)
        Index of the first measurement of each segment.
    interval_s : ndarray, shape (m - 1,)
        Intervals between measurements.
    process_noise_per_sigma_a_squared : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q / SIGMA_A² in each interval.
    process_noise_independent_of_sigma_a : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of further process noise, for example in IMU gaps.
    prior_precision : ndarray, shape (m, 2)
        Prior precision of position and velocity; 0 without a prior.
    prior_sigmas_of_constant_errors : ndarray, shape (c,)
        Prior σ of the unknown constants of each segment.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, m - 1)
        Third dimension: Δp and Δv in each interval, then their derivatives with respect to each
        constant. Δp does not include the motion with the velocity at the start of the interval.
    correlated_noise : (float, float) or None
        Standard deviation (m) and time constant (s) of time-correlated noise.
    """

    measurement_m: Array
    segment_start_indices: IntArray
    interval_s: Array
    process_noise_per_sigma_a_squared: Array
    process_noise_independent_of_sigma_a: Array
    prior_precision: Array
    prior_sigmas_of_constant_errors: Array
    delta_position_m: Array
    delta_velocity_m_s: Array
    correlated_noise: tuple[float, float] | None = None

    @cached_property
    def is_within_segment(self) -> BoolArray:
        """True for each interval whose two measurements are in the same segment, shape (m - 1,)."""
        return ~np.isin(np.arange(1, len(self.measurement_m)), self.segment_start_indices)

    def first(self, count: int) -> PositionsAndIncrements:
        """Keep the first ``count`` measurements only."""
        interval_rows = np.s_[..., : count - 1]
        return replace(
            self,
            measurement_m=self.measurement_m[:count],
            segment_start_indices=self.segment_start_indices[self.segment_start_indices < count],
            prior_precision=self.prior_precision[:count],
            **{
                name: getattr(self, name)[interval_rows]
                for name in (
                    "interval_s",
                    "process_noise_per_sigma_a_squared",
                    "process_noise_independent_of_sigma_a",
                    "delta_position_m",
                    "delta_velocity_m_s",
                )
            },
        )

    def factorise_equations(
        self, sigma_a_m_s2: float, variance_m2: Array
    ) -> Iterator[tuple[list[int], BandedNormalEquations, int]]:
        """Factorise the normal equations for position and velocity at the measurement times.

        Axes with measurements at the same times have the same matrix, so they form one group. Yield
        the axis indices and the equations of each group, and the degrees of freedom of one axis.
        """
        is_measured = np.isfinite(self.measurement_m)
        process_noise = (
            sigma_a_m_s2**2 * self.process_noise_per_sigma_a_squared
            + self.process_noise_independent_of_sigma_a
        )
        axes_by_measured_rows = defaultdict[bytes, list[int]](list)
        for axis, is_axis_measured in enumerate(is_measured.T):
            axes_by_measured_rows[is_axis_measured.tobytes()].append(axis)
        for axes in axes_by_measured_rows.values():
            # 1. Precision of each state (position and velocity): of its measurement plus its prior
            is_axis_measured = is_measured[:, axes[0]]
            measurement_and_prior_precision = self.prior_precision.copy()
            # A segment with fewer than two measurements does not contribute to the likelihood
            has_too_few_measurements = (
                np.add.reduceat(is_axis_measured.astype(int), self.segment_start_indices) < 2
            )
            is_used = is_axis_measured & ~np.repeat(
                has_too_few_measurements, np.diff([*self.segment_start_indices, len(is_measured)])
            )
            measurement_and_prior_precision[:, 0] += np.where(is_used, 1.0 / variance_m2, 0.0)
            # Give the initial state of this segment any precision, so that its equations are
            # regular. The value has no other effect
            measurement_and_prior_precision[
                self.segment_start_indices[has_too_few_measurements]
            ] += 1.0
            # Degrees of freedom: number of measured states and of initial states with a strong
            # prior, minus two per segment (its initial position and velocity are fitted)
            is_known = (measurement_and_prior_precision > 0.0) & (
                (measurement_and_prior_precision > self.prior_precision)
                | (self.prior_precision > MIN_PRECISION_OF_KNOWN_STATE)
            )
            system = factorise(
                self.interval_s,
                process_noise,
                self.is_within_segment,
                measurement_and_prior_precision,
                self.correlated_noise,
            )
            # 3. factorise subtracts ln(precision) of all states from the log determinant. The weak
            # prior of an unknown initial state must not contribute, so its term is added back
            is_weak_prior = (measurement_and_prior_precision > 0.0) & ~is_known
            log_precisions = np.log(measurement_and_prior_precision[is_weak_prior])
            system = replace(
                system, log_determinant=system.log_determinant + float(np.sum(log_precisions))
            )
            yield (
                axes,
                system,
                int(np.count_nonzero(is_known)) - 2 * len(self.segment_start_indices),
            )


@dataclass(frozen=True)
class PositionFit:
    """Fit of constant errors (such as biases) to positions, with given noise parameters.

    Attributes
    ----------
    gram_matrix : ndarray, shape (segments, time offsets, 1 + c, 1 + c)
        Weighted inner products of all pairs of inputs of the regression. The inputs are the data
        (positions and IMU increments), then their derivative with respect to each constant error.
    covariance_log_determinant : float
        Log determinant of the covariance of the positions.
    degrees_of_freedom : int
        Number of measured positions minus the number needed for the initial states.
    prior_sigmas_of_constant_errors : ndarray, shape (c,)
        Prior σ of the c constant errors.
    """

    gram_matrix: Array
    covariance_log_determinant: float
    degrees_of_freedom: int
    prior_sigmas_of_constant_errors: Array

    def compute_constant_error_information(self) -> Array:
        """Return the information matrix of the c constant errors (such as biases).

        The shape is (segments, time offsets, c, c).
        """
        return self.gram_matrix[..., 1:, 1:] + np.diag(self.prior_sigmas_of_constant_errors**-2.0)

    def estimate_constant_errors_by_segment(self) -> Array:
        """Return the estimates of the c constant errors (such as biases) of each segment.

        The shape is (segments, time offsets, c).
        """
        return np.asarray(
            -np.linalg.solve(
                self.compute_constant_error_information(), self.gram_matrix[..., 1:, :1]
            )[..., 0]
        )

    def compute_segment_scores(self, sigma_factors: Array = UNIT_SIGMA_FACTOR) -> Array:
        """Return the negative log likelihood of the positions in each segment.

        The shape is (factors, segments, time offsets).

        All σ are multiplied by each of ``sigma_factors``. A term that is equal for all time offsets
        is omitted.
        """
        # Row and column 0 of the Gram matrix G belong to the data d, the others to the constant
        # errors e in units of their prior σ. Marginalised over e, -ln p of the data is
        # ½ (G_dd - G_de (G_ee + I)⁻¹ G_ed) + ½ ln |G_ee + I|
        units = np.append(1.0, self.prior_sigmas_of_constant_errors)
        sigma_factors = sigma_factors[:, None, None, None, None]
        gram_matrix = self.gram_matrix / sigma_factors**2 * np.outer(units, units)
        information = gram_matrix[..., 1:, 1:] + np.eye(len(units) - 1)
        right_hand_side = gram_matrix[..., 1:, 0]
        solution = np.linalg.solve(information, right_hand_side[..., None])[..., 0]
        square_sum = gram_matrix[..., 0, 0] - np.sum(right_hand_side * solution, axis=-1)
        # Unlike slogdet, cholesky reports a matrix that is indefinite due to rounding errors
        cholesky_factor = np.linalg.cholesky(information)
        half_log_determinant = np.log(np.diagonal(cholesky_factor, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * square_sum + half_log_determinant)

    def compute_scores(self, sigma_factors: Array = UNIT_SIGMA_FACTOR) -> Array:
        """Return the negative log likelihood of the positions, without a constant term.

        The shape is (factors, time offsets).

        All σ are multiplied by each of ``sigma_factors``.
        """
        log_determinant_terms = (
            0.5 * self.covariance_log_determinant + self.degrees_of_freedom * np.log(sigma_factors)
        )
        return np.asarray(
            self.compute_segment_scores(sigma_factors).sum(axis=1) + log_determinant_terms[:, None]
        )


def fit_positions(
    positions: PositionsAndIncrements,
    sigma_a_m_s2: float,
    variance_m2: Array,
    measured_m: Array | None = None,
) -> PositionFit:
    """Fit constant errors (such as biases) to positions, with given SIGMA_A and variances.

    The regression has 1 + c inputs: the data, then the derivative of the data with respect to each
    of the c constant errors. An input consists of positions and of IMU increments Δp and Δv.
    Constant errors change only the increments, so the positions of the derivatives are zero.

    ``measured_m``, shape (axes, 1 or time offsets, k, measurements), contains the positions of the
    first k inputs; the positions of the other inputs are zero. By default, k is 1, and
    ``measured_m`` contains the measured positions.
    """
    if measured_m is None:
        measured_m = np.nan_to_num(positions.measurement_m.T)[:, None, None]
    measured_input_count = measured_m.shape[2]
    dp = positions.delta_position_m
    dv = positions.delta_velocity_m_s
    segment_edges = np.append(positions.segment_start_indices, len(positions.measurement_m))
    gram_matrix = np.zeros((len(segment_edges) - 1, *dp.shape[1:3], dp.shape[2]))
    log_determinant = 0.0
    degrees_of_freedom = 0
    for axes, system, axis_degrees_of_freedom in positions.factorise_equations(
        sigma_a_m_s2, variance_m2
    ):
        log_determinant += len(axes) * system.log_determinant
        degrees_of_freedom += len(axes) * axis_degrees_of_freedom
        # One axis after the other: twice as fast in a long flight, because the arrays are smaller
        for rows in (slice(axis, axis + 1) for axis in axes):
            measured_axis_m, increments = measured_m[rows], (dp[rows], dv[rows])
            weighted_increments = system.weight_increments(*increments)
            # This array has state_count values per measurement. Below, the segment edges are
            # therefore multiplied by state_count
            whitened_explained_part = system.whiten_explained_part(
                measured_axis_m, *weighted_increments
            )
            # The inner product of two inputs is ΔᵀQ⁻¹Δ of their IMU increments, plus zᵀR⁻¹z of
            # their positions (added below). The least-squares estimate of position and velocity
            # explains a part of it, which is subtracted
            for sign, left, right, values_per_measurement in (
                (1.0, increments[0], weighted_increments[0], 1),
                (1.0, increments[1], weighted_increments[1], 1),
                (-1.0, whitened_explained_part, whitened_explained_part, system.state_count),
            ):
                gram_matrix += sign * _compute_inner_products(
                    left, right, values_per_measurement * segment_edges
                )
            gram_matrix[..., :measured_input_count, :measured_input_count] += (
                _compute_inner_products(
                    system.precision[:, 0] * measured_axis_m, measured_axis_m, segment_edges
                )
            )
    return PositionFit(
        gram_matrix, log_determinant, degrees_of_freedom, positions.prior_sigmas_of_constant_errors
    )


def _compute_inner_products(left: Array, right: Array, segment_edges: IntArray) -> Array:
    """Return the inner products of all rows of ``left`` with all rows of ``right``.

    The products are summed over the axes, separately for each segment. ``left`` and ``right`` have
    the shape (axes, ..., rows, values). Each row is one input of the regression in
    :func:`fit_positions`. ``segment_edges`` contains the index of the first value of each segment,
    then the end of the last segment.
    """
    right = np.swapaxes(right, -1, -2)
    products = [
        left[..., begin:end] @ right[..., begin:end, :]
        for begin, end in pairwise(segment_edges.tolist())
    ]
    return np.asarray(np.sum(products, axis=1))


def subtract_smooth_path(
    positions: PositionsAndIncrements, *, estimates_scale: bool = False
) -> PositionsAndIncrements:
    """Subtract a smooth path through the positions from the positions and the IMU increments.

    The remaining numbers are small and have small rounding errors. With ``estimates_scale``, also
    set the last column of the increments: the derivative with respect to a scale factor error of
    the positions. Such an error is proportional to the path, so this column contains the increments
    of the path.
    """
    measured_m = positions.measurement_m.copy()
    dp = positions.delta_position_m.copy()
    dv = positions.delta_velocity_m_s.copy()
    # The smooth path has the shape (axes, time offsets, measurements), its increments have the
    # shape (axes, time offsets, intervals)
    for axes, system, _ in positions.factorise_equations(
        PATH_SMOOTHER_SIGMA_A_M_S2, np.full(len(measured_m), PATH_SMOOTHER_SIGMA_Z_M**2)
    ):
        measured_m_by_axis = np.repeat(
            np.nan_to_num(measured_m[:, axes].T)[:, None], dp.shape[1], 1
        )
        # In dp and dv, index 0 of the third dimension is the measured increment. The last index is
        # the derivative with respect to the scale factor error
        smoothed_state = system.solve(measured_m_by_axis, dp[axes, :, 0], dv[axes, :, 0])
        smoothed_state[:, :, positions.segment_start_indices] = 0.0
        path_m = smoothed_state[..., 0]
        path_velocity_m_s = smoothed_state[..., 1]
        # The increments Δp of the path must have the same definition as those of the IMU: without
        # the motion due to the velocity at the start of the interval
        path_delta_position_m = np.diff(path_m) - positions.interval_s * path_velocity_m_s[..., :-1]
        measured_m[:, axes] -= path_m[:, 0].T
        # The measured positions are the same for all tested time offsets, so the path of the first
        # time offset is subtracted for all of them
        for array, increment in ((dp, path_delta_position_m), (dv, np.diff(path_velocity_m_s))):
            array[axes, :, 0] -= increment[:, :1]
            if estimates_scale:
                array[axes, :, -1] = increment
    return replace(positions, measurement_m=measured_m, delta_position_m=dp, delta_velocity_m_s=dv)


def estimate_squared_errors(
    positions: PositionsAndIncrements,
    sigma_a_m_s2: float,
    variance_m2: Array,
    constant_errors: Array,
) -> ArrayPair:
    """Return the expected squared error (m²) and the number of measured axes of each measurement.

    Along one axis, the expected squared error is the squared difference between measured and
    smoothed position, plus the variance of the smoothed position. It is summed over the axes that
    have a measured position (not NaN).

    Parameters
    ----------
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    constant_errors : ndarray, shape (segments, c)
        Estimated constant errors (such as biases).
    """
    # Correct the increments for the constant errors: measured increment + Σ constant error ·
    # derivative. This is one weighted sum, in which the measured increment (k = 0) has the weight 1
    input_weights = np.insert(constant_errors, 0, 1.0, axis=1)
    # The interval between two measurements belongs to the segment of the later measurement
    input_weights_by_interval = np.repeat(
        input_weights, np.diff([*positions.segment_start_indices, len(variance_m2)]), axis=0
    )[1:]
    dp, dv = (
        # Sum over the inputs k, for each axis a and interval n; there is only one time offset
        np.einsum("akn,nk->an", increments[:, 0], input_weights_by_interval)
        for increments in (positions.delta_position_m, positions.delta_velocity_m_s)
    )
    expected_squared_error_m2 = np.zeros(len(variance_m2))
    for axes, system, _ in positions.factorise_equations(sigma_a_m_s2, variance_m2):
        measured_m = positions.measurement_m[:, axes].T
        # A missing measurement remains NaN, so nansum below omits it
        error_m = measured_m - system.solve(np.nan_to_num(measured_m), dp[axes], dv[axes])[..., 0]
        position_variance = np.where(np.isnan(error_m), np.nan, system.position_variance())
        expected_squared_error_m2 += np.nansum(error_m**2 + position_variance, axis=0)
    return expected_squared_error_m2, np.isfinite(positions.measurement_m).sum(axis=1)


def compute_segment_inner_products(
    positions: PositionsAndIncrements,
    sigma_a_m_s2: float,
    variance_m2: Array,
    left_factor_positions_and_increments: Sequence[Array],
    right_factor_positions_m: Array,
) -> Array:
    """Return k inner products uᵀC⁻¹v in each segment, shape (segments, k).

    Each u and each v is a vector like the data: a position at each measurement, and IMU increments
    Δp and Δv between them. C is the covariance of measured positions, given the measured
    acceleration. It includes unknown constant errors (such as biases).

    Parameters
    ----------
    variance_m2 : ndarray, shape (m,)
        Variance of each measurement.
    left_factor_positions_and_increments : three ndarray
        Positions, Δp and Δv of each u, shapes (axes, k, m) and twice (axes, k, m - 1).
    right_factor_positions_m : ndarray, shape (axes, k, m)
        Positions of each v; its Δp and Δv are zero.
    """
    left_factor_positions_m, *increments = left_factor_positions_and_increments
    increments_per_constant_error = (
        positions.delta_position_m[:, 0, 1:],
        positions.delta_velocity_m_s[:, 0, 1:],
    )
    inner_products_by_batch = []
    for begin in range(0, right_factor_positions_m.shape[1], INNER_PRODUCTS_PER_BATCH):
        batch_slice = np.s_[:, begin : begin + INNER_PRODUCTS_PER_BATCH]
        # Inputs of fit_positions, which returns the inner products of all pairs of inputs: the left
        # factors u, the right factors v (with zero increments), and the derivatives with respect to
        # the constant errors (with zero positions)
        dp, dv = (
            np.concatenate(
                [
                    increment[batch_slice],
                    0.0 * increment[batch_slice],
                    increment_per_constant_error,
                ],
                axis=1,
            )[:, None]
            for increment, increment_per_constant_error in zip(
                increments, increments_per_constant_error, strict=True
            )
        )
        count = left_factor_positions_m[batch_slice].shape[1]
        left, right, errors = slice(count), slice(count, 2 * count), slice(2 * count, None)
        left_and_right_factor_positions_m = np.concatenate(
            [left_factor_positions_m[batch_slice], right_factor_positions_m[batch_slice]], axis=1
        )[:, None]
        # Inner products of all pairs of inputs in each segment. Only the products of each left
        # factor u with the right factor v of the same index are returned below (np.diagonal)
        gram_matrix = fit_positions(
            replace(positions, delta_position_m=dp, delta_velocity_m_s=dv),
            sigma_a_m_s2,
            variance_m2,
            left_and_right_factor_positions_m,
        ).gram_matrix[:, 0]
        information = gram_matrix[:, errors, errors] + np.diag(
            positions.prior_sigmas_of_constant_errors**-2.0
        )
        # Subtract the part that the fitted constant errors explain (Schur complement)
        products = gram_matrix[:, left, right] - gram_matrix[:, left, errors] @ np.linalg.solve(
            information, gram_matrix[:, errors, right]
        )
        inner_products_by_batch.append(np.diagonal(products, axis1=1, axis2=2))
    return np.concatenate(inner_products_by_batch, axis=1)


@dataclass(frozen=True)
class BandedNormalEquations:
    """Factorised normal equations Ax = b for positions and velocities x at the measurements.

    Attributes
    ----------
    precision : ndarray, shape (m, 2)
        Precision of position (1/m²) and velocity (s²/m²), including the prior.
    interval_s : ndarray, shape (m - 1,)
        Time between successive measurements.
    inverse_q : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q⁻¹; zero between segments.
    bands, cholesky_factor : ndarray, shape (2 + state_count, state_count · m)
        A and its Cholesky factor in LAPACK's band storage.
    log_determinant : float
        Log determinant of the covariance of the positions.
    """

    precision: Array
    interval_s: Array
    inverse_q: Array
    bands: Array
    cholesky_factor: Array
    log_determinant: float

    @property
    def state_count(self) -> int:
        """Number of estimated states at each measurement.

        2 (position, velocity), or 3 with time-correlated noise.
        """
        return len(self.bands) - 2

    def weight_increments(self, delta_position_m: Array, delta_velocity_m_s: Array) -> ArrayPair:
        """Return Q⁻¹ [Δp, Δv] of each interval."""
        inverse_q00, inverse_q01, inverse_q11 = self.inverse_q
        return (
            inverse_q00 * delta_position_m + inverse_q01 * delta_velocity_m_s,
            inverse_q01 * delta_position_m + inverse_q11 * delta_velocity_m_s,
        )

    def whiten_explained_part(self, measured_m: Array, *weighted_increments: Array) -> Array:
        """Return L⁻¹b for each input of the regression, with Ax = b and A = LLᵀ.

        The shape is (..., state_count · m). The inner product of two results, b₁ᵀA⁻¹b₂, is the part
        of the weighted inner product of the two inputs that position and velocity x explain.
        """
        right_hand_side = self._make_right_hand_side(measured_m, *weighted_increments)
        # LAPACK solves a triangular system with unit diagonal 30 % faster. With L = UD, D the
        # diagonal of L, the result is D⁻¹(U⁻¹b)
        diagonal = self.cholesky_factor[0]
        unit_diagonal_factor = self.cholesky_factor / diagonal
        whitened_explained_part, _ = lapack.dtbtrs(
            unit_diagonal_factor, right_hand_side.T, uplo="L", diag="U", overwrite_b=1
        )
        return np.asarray(
            (whitened_explained_part.T / diagonal).reshape(*weighted_increments[0].shape[:-1], -1)
        )

    def solve(self, measured_m: Array, delta_position_m: Array, delta_velocity_m_s: Array) -> Array:
        """Return the least-squares estimate x of the states at the measurements.

        The shape is (..., measurements, states). States: position (m), velocity (m/s), and
        time-correlated noise (m) if it is fitted.
        """
        right_hand_side = self._make_right_hand_side(
            measured_m, *self.weight_increments(delta_position_m, delta_velocity_m_s)
        )
        state, _ = lapack.dpbtrs(self.cholesky_factor, right_hand_side.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*delta_position_m.shape[:-1], -1, self.state_count))

    def _make_right_hand_side(
        self, measured_m: Array, weighted_dp: Array, weighted_dv: Array
    ) -> Array:
        """Return the right-hand side b of the normal equations Ax = b.

        ``weighted_dp`` and ``weighted_dv`` are the IMU increments Δp and Δv, multiplied by Q⁻¹.
        """
        # Interval i has the prediction residual r = x_(i+1) - F x_i - Δ and the cost rᵀQ⁻¹r. Its
        # derivative adds Q⁻¹Δ to the rows of x_(i+1), and -FᵀQ⁻¹Δ to the rows of x_i.
        # States: position, velocity, and the time-correlated noise if it is fitted
        right_hand_side = np.zeros((*weighted_dp.shape[:-1], len(self.precision), self.state_count))
        right_hand_side[..., 1:, 0] = weighted_dp
        right_hand_side[..., 1:, 1] = weighted_dv
        right_hand_side[..., :-1, 0] -= weighted_dp
        right_hand_side[..., :-1, 1] -= self.interval_s * weighted_dp + weighted_dv
        # Only the first inputs of the regression contain positions; the derivatives with respect to
        # constant errors do not. A measurement is the sum of position and time-correlated noise (if
        # it is fitted), so its weighted value is added in the rows of both states
        weighted_measurements = self.precision[:, 0] * measured_m
        right_hand_side_with_measurements = right_hand_side[..., : measured_m.shape[-2], :, :]
        right_hand_side_with_measurements[..., 0] += weighted_measurements
        right_hand_side_with_measurements[..., 2:] += weighted_measurements[..., None]
        return right_hand_side.reshape(-1, self.state_count * len(self.precision))

    def position_variance(self) -> Array:
        """Return the variance (m²) of the smoothed position at each measurement.

        The information of earlier and of later measurements is added (Fraser and Potter 1969).
        """
        # At each measurement, the Cholesky factor of A contains the information of all earlier
        # measurements. If A is reversed in time, its factor contains that of all later
        # measurements. Reversal moves element (i + band, i) of A to (n - 1 - i, n - 1 - i - band)
        time_reversed_bands = [np.roll(row[::-1], -band) for band, row in enumerate(self.bands)]
        time_reversed_cholesky_factor, _ = lapack.dpbtrf(time_reversed_bands, lower=1)
        # Each measurement has a 2 × 2 diagonal block in each Cholesky factor. In the first factor
        # it is [[a, 0], [b, c]] with the states position, velocity. In the time-reversed factor it
        # is [[d, 0], [e, f]] with the states velocity, position
        (a, c), b = self.cholesky_factor[0].reshape(-1, 2).T, self.cholesky_factor[1, ::2]
        d, f = time_reversed_cholesky_factor[0].reshape(-1, 2)[::-1].T
        e = time_reversed_cholesky_factor[1, ::2][::-1]
        # A block L of a Cholesky factor contains the information LLᵀ. Add LLᵀ of both factors, and
        # subtract the diagonal block of A once, because both contain it. The position variance is
        # element 00 of the inverse of the result [[p00, p01], [p01, p11]]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


def factorise(
    interval_s: Array,
    process_noise: Array,
    is_within_segment: BoolArray,
    measurement_and_prior_precision: Array,
    correlated_noise: tuple[float, float] | None = None,
) -> BandedNormalEquations:
    """Return the factorised normal equations Ax = b of the states at the measurements.

    Parameters
    ----------
    interval_s : ndarray, shape (m - 1,)
        Time between successive measurements.
    process_noise : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q of each interval.
    is_within_segment : ndarray of bool, shape (m - 1,)
        False for intervals between segments.
    measurement_and_prior_precision : ndarray, shape (m, 2)
        Precision of position (1/m²) and velocity (s²/m²), including the prior.
        With time-correlated noise, the prior must be negligible.
    correlated_noise : (float, float), optional
        Standard deviation (m) and time constant (s) of time-correlated noise.

    Raises
    ------
    numpy.linalg.LinAlgError
        A segment has too few measurements for a position and a velocity.
    """
    position_measurement_precision = measurement_and_prior_precision[:, 0]
    q00, q01, q11 = process_noise
    regularisation_variance_m2 = REGULARISATION_TO_POSITION_SIGMA_RATIO**2 * (
        1.0 / np.median(position_measurement_precision[position_measurement_precision > 0.0]) + q00
    )
    # Q of one prediction step is singular, so a small variance is added. A tiny determinant is a
    # rounding error
    variance_product = q00 * q11
    raw_q_determinant = variance_product - q01**2
    q_determinant = (
        np.where(
            raw_q_determinant > MIN_DETERMINANT_TO_VARIANCE_PRODUCT_RATIO * variance_product,
            raw_q_determinant,
            0.0,
        )
        + regularisation_variance_m2 * q11
    )
    inverse_q = np.where(
        is_within_segment,
        np.stack([q11, -q01, q00 + regularisation_variance_m2]) / q_determinant,
        0.0,
    )
    # With the transition matrix F = [[1, dt], [0, 1]], position_velocity_weight is the element of
    # FᵀQ⁻¹ in the row of velocity and the column of position
    inverse_q00, inverse_q01, inverse_q11 = inverse_q
    position_velocity_weight = inverse_q00 * interval_s + inverse_q01
    # A = diag(precision) + Σ [-F I]ᵀ Q⁻¹ [-F I] over the intervals, with the transition matrix F.
    # Each interval adds three 2 × 2 blocks to A: FᵀQ⁻¹F for the states at its start, Q⁻¹ for the
    # states at its end, and -Q⁻¹F below the first block. With Q⁻¹ = [[a, b], [b, c]]:
    #   FᵀQ⁻¹F = [[a, a dt + b], [a dt + b, (a dt + 2 b) dt + c]]
    #   Q⁻¹F = [[a, a dt + b], [b, b dt + c]]
    # LAPACK's band format: each state has its element on the diagonal, then the elements below it.
    # The states of the next measurement begin state_count rows below
    state_count = 2 if correlated_noise is None else 3
    band_storage = np.zeros((len(measurement_and_prior_precision), state_count, state_count + 2))
    position_bands = band_storage[:, 0]
    velocity_bands = band_storage[:, 1]
    position_bands[:, 0], velocity_bands[:, 0] = measurement_and_prior_precision.T
    # Add Q⁻¹ to the block of the states at the end of each interval
    position_bands[1:, 0] += inverse_q00
    position_bands[1:, 1] = inverse_q01
    velocity_bands[1:, 0] += inverse_q11
    # Add FᵀQ⁻¹F to the block of the states at the start of each interval
    position_bands[:-1, 0] += inverse_q00
    position_bands[:-1, 1] += position_velocity_weight
    velocity_bands[:-1, 0] += (position_velocity_weight + inverse_q01) * interval_s + inverse_q11
    # Set the block that connects the states at start and end of an interval, below the diagonal, to
    # -Q⁻¹F
    position_bands[:-1, state_count] = -inverse_q00
    position_bands[:-1, state_count + 1] = -inverse_q01
    velocity_bands[:-1, state_count - 1] = -position_velocity_weight
    velocity_bands[:-1, state_count] = -(inverse_q01 * interval_s + inverse_q11)
    process_noise_log_determinant = np.sum(np.log(q_determinant[is_within_segment]))
    if correlated_noise is not None:
        correlated_sigma_m, tau_s = correlated_noise
        rho = np.where(is_within_segment, np.exp(-interval_s / tau_s), 0.0)
        # Gauss-Markov process: variance σ_c² at the start of a segment, driving noise (1 - ρ²) σ_c²
        correlated_noise_step_variance_m2 = correlated_sigma_m**2 * np.append(1.0, 1.0 - rho**2)
        # A measurement is the sum of position and correlated noise. Its precision is therefore
        # added to A three times: diagonal element of each state, and element that connects them
        correlated_noise_bands = band_storage[:, 2]
        position_bands[:, 2] = position_measurement_precision
        correlated_noise_bands[:, 0] = (
            position_measurement_precision + 1.0 / correlated_noise_step_variance_m2
        )
        correlated_noise_bands[:-1, 0] += rho**2 / correlated_noise_step_variance_m2[1:]
        correlated_noise_bands[:-1, state_count] = -rho / correlated_noise_step_variance_m2[1:]
        process_noise_log_determinant += np.sum(np.log(correlated_noise_step_variance_m2))
    bands = band_storage.reshape(-1, state_count + 2).T
    cholesky_factor, is_singular = lapack.dpbtrf(bands, lower=1)
    if is_singular:
        raise np.linalg.LinAlgError(
            "the normal equations are singular (too few positions, or large rounding errors)"
        )
    log_determinant = (
        2.0 * np.sum(np.log(cholesky_factor[0]))
        + process_noise_log_determinant
        - np.sum(np.log(measurement_and_prior_precision[measurement_and_prior_precision > 0.0]))
    )
    return BandedNormalEquations(
        measurement_and_prior_precision,
        interval_s,
        inverse_q,
        bands,
        cholesky_factor,
        float(log_determinant),
    )
