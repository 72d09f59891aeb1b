"""Likelihood of positions along several axes, with unknown constant errors.

A segment is a part of the flight without a gap in the IMU data. Each segment has an unknown initial
state and unknown constants (biases and other constant errors).

Given the acceleration, position and velocity at the measurements are estimated by least squares.
The normal equations Ax = b have a banded matrix A. The likelihood equals that of KF's innovations
(Schweppe 1965).

The constants are estimated by linear regression. Its inputs are the data, and their derivatives
with respect to each constant. The Gram matrix contains the weighted inner products of the inputs.

Symbols in shapes: m measurements, a axes, s segments, c constants, k inputs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.filter.model import make_symmetric_matrix, make_transition_matrix

# Q can be singular, so a small variance is added to Q₀₀: its σ as a fraction of √(R + Q₀₀)
REGULARISATION_TO_POSITION_SIGMA_RATIO = 1e-5
# Minimum ratio |Q| / (Q₀₀ Q₁₁): a smaller determinant is a rounding error
MIN_DETERMINANT_TO_VARIANCE_PRODUCT_RATIO = 1e-12


@dataclass(frozen=True)
class NoiseParameters:
    """Noise parameters of the IMU and of the position source.

    Attributes
    ----------
    sigma_a_m_s2 : float
        Standard deviation of the acceleration error over one step DT.
    sigma_z_m : float
        Standard deviation of the white position noise.
    random_walk_m : float
        Random walk of the source (m/√s); 0 for none.
    correlated_sigma_m, tau_s : float
        Standard deviation and time constant of time-correlated noise; 0 for none.
    """

    sigma_a_m_s2: float
    sigma_z_m: float
    random_walk_m: float = 0.0
    correlated_sigma_m: float = 0.0
    tau_s: float = 0.0

    def multiply_sigmas(self, factor: float) -> NoiseParameters:
        """Multiply the standard deviations of all noises by a factor."""
        multiplied = {name: factor * value for name, value in vars(self).items() if name != "tau_s"}
        return replace(self, **multiplied)


# Noises of the smoother that estimates a path from the positions
PATH_SMOOTHER_NOISE = NoiseParameters(sigma_a_m_s2=0.5, sigma_z_m=0.1)


@dataclass(frozen=True)
class PositionsAndIncrements:
    """Positions of one source along several axes, with the IMU increments Δp and Δv between them.

    Attributes
    ----------
    measurement_m : ndarray, shape (m, a)
        Measured positions; NaN if an axis has none.
    segment_starts : ndarray of int, shape (s,)
        Index of the first measurement of each segment.
    interval_s : ndarray, shape (m - 1,)
        Intervals between measurements.
    process_noise_per_sigma_a_squared : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of Q / SIGMA_A² in each interval.
    process_noise_independent_of_sigma_a : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of further process noise, for example in IMU gaps.
    initial_state_precision : (float, float)
        Prior precision of position (1/m²) and velocity (s²/m²) at the start of each segment.
    is_initial_state_known : bool
        False if this precision is only small, to prevent a singular matrix.
    constant_prior_sigmas : ndarray, shape (c,)
        Prior σ of the unknown constants of each segment.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, 1 + c, m - 1)
        Δp and Δv in each interval, then their derivatives with respect to each constant.
    """

    measurement_m: Array
    segment_starts: IntArray
    interval_s: Array
    process_noise_per_sigma_a_squared: Array
    process_noise_independent_of_sigma_a: Array
    initial_state_precision: tuple[float, float]
    is_initial_state_known: bool
    constant_prior_sigmas: Array
    delta_position_m: Array
    delta_velocity_m_s: Array

    @cached_property
    def segments(self) -> list[tuple[int, int]]:
        """Index of the first measurement of each segment, and of its last measurement plus 1."""
        return list(pairwise([*self.segment_starts.tolist(), len(self.measurement_m)]))

    @cached_property
    def segment_index(self) -> IntArray:
        """Index of the segment of each measurement, shape (m,)."""
        return np.searchsorted(self.segment_starts, np.arange(len(self.measurement_m)), "right") - 1

    @cached_property
    def is_within_segment(self) -> BoolArray:
        """True for each interval whose two measurements are in the same segment, shape (m - 1,)."""
        return np.asarray(np.diff(self.segment_index) == 0)

    def first(self, count: int) -> PositionsAndIncrements:
        """Keep the first ``count`` measurements only."""
        return replace(
            self,
            measurement_m=self.measurement_m[:count],
            segment_starts=self.segment_starts[self.segment_starts < count],
            **{
                name: getattr(self, name)[..., : count - 1]
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
        self, noise_parameters: NoiseParameters, measurement_weights: Array
    ) -> Iterator[tuple[list[int], BandedNormalEquations]]:
        """Factorise the normal equations of positions and velocities, for each group of axes.

        Axes with the same measurement times form one group, because their equations are equal.
        Yield axis indices and equations.

        Parameters
        ----------
        measurement_weights : ndarray
            The variance of a measurement is SIGMA_Z² / weight. An initial state before the first
            measurement has no weight.

        Raises
        ------
        numpy.linalg.LinAlgError
            A segment has too few measurements for a position and a velocity.
        """
        weights = np.ones(len(self.measurement_m))
        weights[-len(measurement_weights) :] = measurement_weights
        axes_by_mask: dict[bytes, list[int]] = {}
        for axis, is_measured in enumerate(np.isfinite(self.measurement_m).T):
            axes_by_mask.setdefault(is_measured.tobytes(), []).append(axis)
        for axes in axes_by_mask.values():
            is_measured = np.isfinite(self.measurement_m[:, axes[0]])
            # A segment with fewer than two measurements does not contribute to the likelihood
            has_too_few_measurements = (
                np.add.reduceat(is_measured.astype(int), self.segment_starts) < 2
            )
            is_used = is_measured & ~has_too_few_measurements[self.segment_index]
            precision = np.where(is_used, weights / noise_parameters.sigma_z_m**2, 0.0)
            initial_precision = np.where(
                has_too_few_measurements[:, None], 1.0, self.initial_state_precision
            )
            bands, inverse_q_factor, log_determinant = self._make_bands(
                noise_parameters, precision, initial_precision
            )
            cholesky_factor, is_singular = lapack.dpbtrf(bands, lower=1)
            if is_singular:
                raise np.linalg.LinAlgError(
                    "the normal equations are singular (too few positions, or large rounding "
                    "errors)"
                )
            # The weak prior of an unknown initial state must not contribute to the likelihood
            is_start_known = has_too_few_measurements | self.is_initial_state_known
            for squares in (precision[is_used], initial_precision[is_start_known]):
                log_determinant -= np.sum(np.log(squares))
            yield (
                axes,
                BandedNormalEquations(
                    precision,
                    self.interval_s,
                    inverse_q_factor,
                    bands,
                    cholesky_factor,
                    log_determinant + 2.0 * float(np.sum(np.log(cholesky_factor[0]))),
                    int(np.sum(is_used) - 2 * np.sum(~is_start_known)),
                ),
            )

    def _make_bands(
        self, noise_parameters: NoiseParameters, precision: Array, initial_precision: Array
    ) -> tuple[Array, Array, float]:
        """Return A, elements 00, 01, 11 of U in Q⁻¹ = UᵀU, and the sum of ln |Q|.

        A = diag(precision) + Σ [-F I]ᵀ Q⁻¹ [-F I] over the intervals, in LAPACK's band format.
        """
        q00, q01, q11 = (
            noise_parameters.sigma_a_m_s2**2 * self.process_noise_per_sigma_a_squared
            + self.process_noise_independent_of_sigma_a
        )
        q00 = q00 + noise_parameters.random_walk_m**2 * self.interval_s
        # Q of one prediction step is singular, so a small variance is added. A tiny determinant is
        # a rounding error
        q_determinant = q00 * q11 - q01**2
        q_determinant[q_determinant < MIN_DETERMINANT_TO_VARIANCE_PRODUCT_RATIO * q00 * q11] = 0.0
        q_determinant += (
            REGULARISATION_TO_POSITION_SIGMA_RATIO**2 * (noise_parameters.sigma_z_m**2 + q00) * q11
        )
        log_determinant = np.sum(np.log(q_determinant[self.is_within_segment]))
        u00, u11 = np.where(self.is_within_segment, np.sqrt([q11 / q_determinant, 1.0 / q11]), 0.0)
        u01 = -u00 * q01 / q11
        inverse_q = make_symmetric_matrix((u00**2, u00 * u01, u01**2 + u11**2))
        transition = make_transition_matrix(self.interval_s)
        # Columns of A for each measurement; the first rows belong to the same measurement
        state_count = 3 if noise_parameters.correlated_sigma_m else 2
        columns = np.zeros((len(precision), 2 * state_count + 1, state_count))
        columns[:, 0, 0] = precision
        columns[self.segment_starts, [[0], [1]], [[0], [1]]] += initial_precision.T
        columns[1:, :2, :2] += inverse_q
        columns[:-1, :2, :2] += np.swapaxes(transition, 1, 2) @ inverse_q @ transition
        columns[:-1, state_count : state_count + 2, :2] = -inverse_q @ transition
        if noise_parameters.correlated_sigma_m:
            rho = np.exp(-self.interval_s / noise_parameters.tau_s) * self.is_within_segment
            # Variance of a Gauss-Markov process: σ_c² at the start of a segment, then (1 - ρ²) σ_c²
            step_variance_m2 = noise_parameters.correlated_sigma_m**2 * np.append(1.0, 1.0 - rho**2)
            columns[:, 2, 0] = precision
            columns[:, 2, 2] = precision + 1.0 / step_variance_m2
            columns[:-1, 2, 2] += rho**2 / step_variance_m2[1:]
            columns[:-1, 5, 2] = -rho / step_variance_m2[1:]
            log_determinant += np.sum(np.log(step_variance_m2))
        bands = np.stack(
            [columns[:, state : state + state_count + 2, state] for state in range(state_count)],
            axis=1,
        ).reshape(-1, state_count + 2)
        return bands.T, np.stack([u00, u01, u11]), float(log_determinant)


@dataclass(frozen=True)
class PositionFit:
    """Fit of constant errors (such as biases) to positions, with given noise parameters.

    Attributes
    ----------
    gram_matrix : ndarray, shape (s, 1 + c, 1 + c)
        Inner products of the data and their derivatives, weighted by the inverse covariance.
    covariance_log_determinant : float
        Log determinant of the covariance of the positions.
    degrees_of_freedom : int
        Number of measured positions minus the number needed for the initial states.
    constant_prior_sigmas : ndarray, shape (c,)
        Prior σ of the constant errors.
    """

    gram_matrix: Array
    covariance_log_determinant: float
    degrees_of_freedom: int
    constant_prior_sigmas: Array

    def estimate_constants(self) -> ArrayPair:
        """Return the constant errors of each segment, shape (s, c), and their covariances."""
        covariance = np.asarray(
            np.linalg.inv(self.gram_matrix[:, 1:, 1:] + np.diag(self.constant_prior_sigmas**-2.0))
        )
        return -(covariance @ self.gram_matrix[:, 1:, :1])[..., 0], covariance

    def compute_segment_scores(self, sigma_factor: float = 1.0) -> Array:
        """Return -ln p of the positions in each segment, if all σ are multiplied by a factor.

        A term that is equal for all time offsets is omitted.
        """
        gram_matrix = self.gram_matrix / sigma_factor**2
        prior_sigmas = self.constant_prior_sigmas
        information = gram_matrix[:, 1:, 1:] * np.outer(prior_sigmas, prior_sigmas) + np.eye(
            len(prior_sigmas)
        )
        cross_products = gram_matrix[:, 1:, :1] * prior_sigmas[:, None]
        explained_square_sum = np.sum(
            cross_products * np.linalg.solve(information, cross_products), axis=(1, 2)
        )
        cholesky_diagonal = np.diagonal(np.linalg.cholesky(information), axis1=1, axis2=2)
        return np.asarray(
            0.5 * (gram_matrix[:, 0, 0] - explained_square_sum)
            + np.log(cholesky_diagonal).sum(axis=1)
        )

    def compute_score(self, sigma_factor: float = 1.0) -> float:
        """Return -ln p of the positions, if all σ are multiplied by a factor.

        A constant term is omitted.
        """
        return float(
            self.compute_segment_scores(sigma_factor).sum()
            + 0.5 * self.covariance_log_determinant
            + self.degrees_of_freedom * math.log(sigma_factor)
        )


def fit_constant_errors(
    positions: PositionsAndIncrements,
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> PositionFit:
    """Fit constant errors (such as biases) to positions, with given noise parameters.

    The inputs of the fit are the data, and their derivatives with respect to each constant error.
    The variance of a measurement is SIGMA_Z² / weight.
    """
    input_count = positions.delta_position_m.shape[1]
    gram_matrix = np.zeros((len(positions.segments), input_count, input_count))
    log_determinant, degrees_of_freedom = 0.0, 0
    for axes, system in positions.factorise_equations(noise_parameters, measurement_weights):
        log_determinant += len(axes) * system.log_determinant
        degrees_of_freedom += len(axes) * system.degrees_of_freedom
        # Segment by segment, which is faster for long flights
        for segment, (begin, end) in enumerate(positions.segments):
            measured_m = np.nan_to_num(positions.measurement_m[begin:end, axes].T)
            whitened_increments, right_hand_side = system.make_right_hand_side(
                measured_m,
                positions.delta_position_m[axes, :, begin : end - 1],
                positions.delta_velocity_m_s[axes, :, begin : end - 1],
                begin,
            )
            state_columns = slice(system.state_count * begin, system.state_count * end)
            part_explained_by_states, _ = lapack.dtbtrs(
                system.cholesky_factor[:, state_columns], right_hand_side.T, uplo="L"
            )
            gram_matrix[segment] += _compute_inner_products(
                whitened_increments
            ) - _compute_inner_products(
                part_explained_by_states.T.reshape(len(axes), input_count, -1)
            )
            # Only the data have measured positions
            gram_matrix[segment, 0, 0] += np.sum(system.precision[begin:end] * measured_m**2)
    return PositionFit(
        gram_matrix, log_determinant, degrees_of_freedom, positions.constant_prior_sigmas
    )


def _compute_inner_products(inputs: Array) -> Array:
    """Return the inner products of inputs, shape (..., inputs, values), summed over the axes."""
    products = inputs @ np.swapaxes(inputs, -1, -2)
    return np.asarray(products.sum(axis=tuple(range(products.ndim - 2))))


def subtract_smooth_path(positions: PositionsAndIncrements) -> PositionsAndIncrements:
    """Subtract a smooth path through the positions from the positions and the IMU increments.

    Smaller numbers have smaller rounding errors. The path also becomes the derivative with respect
    to the last constant error, if there are any: the scale factor error of the positions.
    """
    measured_m = positions.measurement_m.copy()
    dp, dv = positions.delta_position_m.copy(), positions.delta_velocity_m_s.copy()
    for axes, system in positions.factorise_equations(
        PATH_SMOOTHER_NOISE, np.ones(len(measured_m))
    ):
        path = system.solve(measured_m[:, axes].T, dp[axes, 0], dv[axes, 0])
        path[:, positions.segment_starts] = 0.0
        path_m, path_velocity_m_s = path[..., 0], path[..., 1]
        measured_m[:, axes] -= path_m.T
        path_dp = np.diff(path_m) - positions.interval_s * path_velocity_m_s[:, :-1]
        for increments, path_increments in ((dp, path_dp), (dv, np.diff(path_velocity_m_s))):
            increments[axes, 0] -= path_increments
            if positions.constant_prior_sigmas.size:
                increments[axes, -1] = path_increments
    return replace(positions, measurement_m=measured_m, delta_position_m=dp, delta_velocity_m_s=dv)


def estimate_squared_errors(
    positions: PositionsAndIncrements,
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> ArrayPair:
    """Return the expected squared error (m²) of each measurement, and its number of measured axes.

    It is the squared distance to the smoothed position plus its variance, summed over the axes.
    """
    constant_errors, _ = fit_constant_errors(
        positions, noise_parameters, measurement_weights
    ).estimate_constants()
    input_weights = np.insert(constant_errors, 0, 1.0, axis=1)[positions.segment_index[1:]]
    dp, dv = (
        np.einsum("akn,nk->an", increments, input_weights)
        for increments in (positions.delta_position_m, positions.delta_velocity_m_s)
    )
    expected_squared_error_m2 = np.zeros(len(positions.measurement_m))
    for axes, system in positions.factorise_equations(noise_parameters, measurement_weights):
        measured_m = positions.measurement_m[:, axes].T
        error_m = measured_m - system.solve(measured_m, dp[axes], dv[axes])[..., 0]
        expected_squared_error_m2 += np.nansum(
            error_m**2 + np.where(np.isnan(error_m), np.nan, system.position_variance()), axis=0
        )
    return expected_squared_error_m2, np.isfinite(positions.measurement_m).sum(axis=1)


@dataclass(frozen=True)
class BandedNormalEquations:
    """Factorised normal equations Ax = b for positions and velocities x at the measurements.

    Attributes
    ----------
    precision : ndarray, shape (m,)
        Inverse variance (1/m²) of each measurement; 0 without a measurement.
    interval_s : ndarray, shape (m - 1,)
        Time between successive measurements.
    inverse_q_factor : ndarray, shape (3, m - 1)
        Elements 00, 01, 11 of U in Q⁻¹ = UᵀU; zero between segments.
    bands, cholesky_factor : ndarray, shape (2 + states, states · m)
        A and its Cholesky factor in LAPACK's band storage.
    log_determinant : float
        Log determinant of the covariance of the positions.
    degrees_of_freedom : int
        Number of measured positions minus the number needed for the initial states.
    """

    precision: Array
    interval_s: Array
    inverse_q_factor: Array
    bands: Array
    cholesky_factor: Array
    log_determinant: float
    degrees_of_freedom: int

    @property
    def state_count(self) -> int:
        """2 (position, velocity), or 3 with time-correlated noise."""
        return len(self.bands) - 2

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Return the estimated states of each axis, shape (a, m, states).

        States: position (m), velocity (m/s), and time-correlated noise (m) if it is fitted.
        """
        _, right_hand_side = self.make_right_hand_side(
            np.nan_to_num(measured_m), dp[:, None], dv[:, None]
        )
        state, _ = lapack.dpbtrs(self.cholesky_factor, right_hand_side.T, lower=1)
        return np.asarray(state.T.reshape(*measured_m.shape, -1))

    def make_right_hand_side(
        self, measured_m: Array, dp: Array, dv: Array, begin: int = 0
    ) -> ArrayPair:
        """Return U [Δp, Δv], and the right-hand side b of Ax = b, shape (a · k, states · m).

        Shapes of the arguments: (a, m), and twice (a, k, m - 1). ``begin`` is the index of the
        first measurement.
        """
        end = begin + measured_m.shape[1]
        u00, u01, u11 = self.inverse_q_factor[:, begin : end - 1]
        w0, w1 = whitened_increments = np.array([u00 * dp + u01 * dv, u11 * dv])
        # Q⁻¹ [Δp, Δv]
        g0, g1 = u00 * w0, u01 * w0 + u11 * w1
        right_hand_side = np.zeros((*dp.shape[:2], end - begin, self.state_count))
        right_hand_side[..., 1:, 0] = g0
        right_hand_side[..., 1:, 1] = g1
        right_hand_side[..., :-1, 0] -= g0
        right_hand_side[..., :-1, 1] -= self.interval_s[begin : end - 1] * g0 + g1
        # Position and time-correlated noise are measured together
        right_hand_side[:, 0, :, ::2] += (self.precision[begin:end] * measured_m)[..., None]
        return whitened_increments, right_hand_side.reshape(-1, self.state_count * (end - begin))

    def position_variance(self) -> Array:
        """Return the variance (m²) of the smoothed position at each measurement.

        The information of earlier and of later measurements is added (Fraser and Potter 1969).
        """
        # The Cholesky factor of A in reverse time order contains the later measurements
        time_reversed_factor, _ = lapack.dpbtrf(self.bands[::-1, ::-1], lower=0)
        matrices = self.cholesky_factor, time_reversed_factor[::-1, ::-1], self.bands
        # Diagonal blocks of the Cholesky factors: [[a, 0], [b, c]], and in reverse time order
        # [[d, 0], [e, f]]. In reverse order, velocity precedes position
        (a, c), (f, d), (a00, a11) = (matrix[0].reshape(-1, 2).T for matrix in matrices)
        b, e, a01 = (matrix[1, ::2] for matrix in matrices)
        p00 = a**2 + e**2 + f**2 - a00
        p01 = a * b + d * e - a01
        p11 = b**2 + c**2 + d**2 - a11
        return np.asarray(p11 / (p00 * p11 - p01**2))
