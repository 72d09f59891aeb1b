"""Maximum-likelihood estimates of SIGMA_A and SIGMA_Z, and outliers among the positions.

The noises maximise the likelihood of the innovations (Schweppe 1965). Outliers have a normal
distribution with a larger σ (Tukey 1960), which is estimated by expectation maximisation.

A score is a negative log-likelihood (-ln p): lower is better.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import exp, floor, log
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, comb, expit

from px4fuse.core.arrays import Array

from .likelihood import PreintegratedMotion
from .marginal_likelihood import (
    PositionFit,
    PositionsAndIncrements,
    estimate_squared_errors,
    fit_positions,
    subtract_smooth_path,
)
from .model import INITIAL_COVARIANCE

# Search range (m/s²) of SIGMA_A
SIGMA_A_SEARCH_RANGE_M_S2 = (1e-3, 30.0)
# Search range (m) of SIGMA_Z
SIGMA_Z_SEARCH_RANGE_M = (1e-3, 10.0)
# Maximum number of iterations of expectation maximisation, which estimates the outliers
MAX_OUTLIER_ITERATIONS = 12
# Maximum number of L-BFGS-B iterations of a fit
MAX_FIT_ITERATIONS = 50
# Number of iterations that estimate the outlier probabilities for given SIGMA_A and SIGMA_Z
OUTLIER_ITERATIONS_WITH_GIVEN_NOISES = 3
# Minimum ratio of the outliers' σ to SIGMA_Z
MIN_OUTLIER_SIGMA_RATIO = 3.0
MAX_OUTLIER_FRACTION = 0.4
# To detect outliers, SIGMA_Z is limited to this multiple of a robust estimate from the median
# squared position error
MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO = 1.2
# Convergence limit for the change of outlier probabilities
MAX_OUTLIER_PROBABILITY_CHANGE = 0.01
# Value of -ln p per measurement if the likelihood cannot be computed
UNCOMPUTABLE_SCORE = 1e6
# Step of ln σ for numerical derivatives of the log-likelihood
LOG_STEP_FOR_DERIVATIVES = 1e-4
# Grid for the interpolation of the log-likelihood: number of nodes, and spacing in ln σ
GRID_NODE_COUNT, LN_SIGMA_NODE_SPACING = 6, 0.2
GRID_NODES = np.arange(GRID_NODE_COUNT)
BARYCENTRIC_WEIGHTS = (-1.0) ** GRID_NODES * comb(GRID_NODE_COUNT - 1, GRID_NODES)
# In a long flight, a first fit to this number of measurements gives the initial values
INITIAL_FIT_MEASUREMENT_COUNT = 2000
# Precision (1 ÷ variance) of a known initial position (1/m²) and velocity (s²/m²)
KNOWN_INITIAL_STATE_PRECISION = 1e12


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


# Search range of each field of NoiseParameters, in the unit of the field
NOISE_SEARCH_RANGES = {
    "sigma_a_m_s2": SIGMA_A_SEARCH_RANGE_M_S2,
    "sigma_z_m": SIGMA_Z_SEARCH_RANGE_M,
    "random_walk_m": (1e-4, 1.0),
    "correlated_sigma_m": (1e-3, 10.0),
    "tau_s": (0.05, 60.0),
}


class NegativeLogLikelihood:
    """Negative log-likelihood (-ln p) of the measurements as a function of the noise parameters.

    Constant terms are omitted. For white noise, -ln p is interpolated on a grid.

    Parameters
    ----------
    positions_by_axis : sequence of PositionsAndIncrements
        Positions along each axis.
    measurement_weights : ndarray, shape (m,)
        The variance of a measurement is SIGMA_Z² / weight.
    sigma_z_m : float
        Approximate SIGMA_Z.

    Notes
    -----
    The coordinates of the grid are ln(SIGMA_A / SIGMA_Z) and ln SIGMA_Z. One fit gives -ln p for
    all SIGMA_Z with the same ratio, so few fits are necessary.
    """

    def __init__(
        self,
        positions_by_axis: Sequence[PositionsAndIncrements],
        measurement_weights: Array,
        sigma_z_m: float,
    ) -> None:
        """Prepare the two-dimensional grid on which -ln p is interpolated."""
        self.positions_by_axis = positions_by_axis
        self.measurement_weights = measurement_weights
        # The grid requires that a common factor on SIGMA_A and SIGMA_Z scales all covariances. This
        # is not true with process noise that is independent of SIGMA_A (IMU gaps)
        self.is_interpolated = not any(
            positions.process_noise_independent_of_sigma_a.any() for positions in positions_by_axis
        )

        # Node i of the grid has the coordinate i · LN_SIGMA_NODE_SPACING
        @cache
        def fit_axes(ratio_index: int) -> list[PositionFit]:
            """Fit each axis with the ratio SIGMA_A / SIGMA_Z of a grid node."""
            sigma_a_m_s2 = exp(LN_SIGMA_NODE_SPACING * ratio_index) * sigma_z_m
            return [
                fit_constant_errors(
                    [positions], NoiseParameters(sigma_a_m_s2, sigma_z_m), measurement_weights
                )
                for positions in positions_by_axis
            ]

        @cache
        def compute_scores_at_nodes(ratio_index: int, first_sigma_z_index: int) -> Array:
            """Return -ln p, summed over axes, at GRID_NODE_COUNT successive nodes of ln SIGMA_Z.

            All nodes have the same ratio SIGMA_A / SIGMA_Z, with the grid index ``ratio_index``.
            """
            sigmas_z_m = np.exp(LN_SIGMA_NODE_SPACING * (first_sigma_z_index + GRID_NODES))
            return np.asarray(
                sum(
                    axis_fit.compute_scores(sigmas_z_m / sigma_z_m)[:, 0]
                    for axis_fit in fit_axes(ratio_index)
                )
            )

        self._compute_scores_at_nodes = compute_scores_at_nodes

    def __call__(self, noise_parameters: NoiseParameters) -> float:
        """Return -ln p of the measurements, without the constant term with ln 2π."""
        if (
            noise_parameters.random_walk_m
            or noise_parameters.correlated_sigma_m
            or not self.is_interpolated
        ):
            return negative_log_likelihood(
                self.positions_by_axis, noise_parameters, self.measurement_weights
            )
        log_sigma_z = log(noise_parameters.sigma_z_m)
        log_ratio = log(noise_parameters.sigma_a_m_s2) - log_sigma_z
        ratio_index, ratio_weights = _interpolate_between_nodes(log_ratio / LN_SIGMA_NODE_SPACING)
        sigma_z_index, sigma_z_weights = _interpolate_between_nodes(
            log_sigma_z / LN_SIGMA_NODE_SPACING
        )
        # Interpolate -ln p by polynomials in ln(SIGMA_A / SIGMA_Z) (rows of the grid) and in ln
        # SIGMA_Z (columns)
        scores_at_nodes = [
            self._compute_scores_at_nodes(ratio_index + node, sigma_z_index)
            for node in range(GRID_NODE_COUNT)
        ]
        return float(ratio_weights @ scores_at_nodes @ sigma_z_weights)


def _interpolate_between_nodes(coordinate: float) -> tuple[int, Array]:
    """Return the first of the nearest grid nodes, and the interpolation weight of each.

    Method: barycentric interpolation (Berrut and Trefethen 2004).
    """
    first_index = floor(coordinate) - (GRID_NODE_COUNT - 1) // 2
    node_distances = coordinate - first_index - GRID_NODES
    if not node_distances.all():
        return first_index, np.asarray(node_distances == 0.0, dtype=np.float64)
    weights = BARYCENTRIC_WEIGHTS / node_distances
    return first_index, np.asarray(weights / weights.sum())


def add_noises(
    positions: PositionsAndIncrements, noise_parameters: NoiseParameters, measurement_weights: Array
) -> tuple[PositionsAndIncrements, Array]:
    """Add random walk and time-correlated noise to the noise model of the positions.

    Return also the variance of each measurement. ``measurement_weights`` may omit the first rows of
    the positions, which are initial states without a measurement. Their variance has no effect.
    """
    process_noise = positions.process_noise_independent_of_sigma_a.copy()
    process_noise[0] += positions.interval_s * noise_parameters.random_walk_m**2
    positions = replace(positions, process_noise_independent_of_sigma_a=process_noise)
    if noise_parameters.correlated_sigma_m:
        correlated_noise = noise_parameters.correlated_sigma_m, noise_parameters.tau_s
        positions = replace(positions, correlated_noise=correlated_noise)
    variance_m2 = np.ones(len(positions.measurement_m))
    variance_m2[-len(measurement_weights) :] = noise_parameters.sigma_z_m**2 / measurement_weights
    return positions, variance_m2


def fit_constant_errors(
    position_batches: Iterable[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> PositionFit:
    """Fit constant errors (such as biases) to positions, with given noise parameters.

    The batches contain successive segments of the flight. The variance of a measurement is
    SIGMA_Z² / weight.
    """
    batch_fits = []
    end = 0
    for positions in position_batches:
        begin, end = end, end + len(positions.measurement_m)
        noisy_positions, variance_m2 = add_noises(
            positions, noise_parameters, measurement_weights[begin:end]
        )
        batch_fits.append(
            fit_positions(noisy_positions, noise_parameters.sigma_a_m_s2, variance_m2)
        )
    return PositionFit(
        np.concatenate([fit.gram_matrix for fit in batch_fits]),
        sum(fit.covariance_log_determinant for fit in batch_fits),
        sum(fit.degrees_of_freedom for fit in batch_fits),
        batch_fits[0].prior_sigmas_of_constant_errors,
    )


def negative_log_likelihood(
    positions_by_axis: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> float:
    """Return -ln p of the measurements of all axes, without the constant term with ln 2π."""
    # There is only one σ factor and one time offset, so element [0, 0] is the only score
    return float(
        sum(
            fit_constant_errors(
                [positions], noise_parameters, measurement_weights
            ).compute_scores()[0, 0]
            for positions in positions_by_axis
        )
    )


class OutlierDistribution(NamedTuple):
    """Fraction of outliers, and ratio of their σ to SIGMA_Z.

    In the methods, ``normalised_squares`` contains the squared error of each measurement ÷
    SIGMA_Z², summed over its ``measured_axis_counts`` axes.
    """

    fraction: float
    sigma_ratio: float

    @classmethod
    def fit(
        cls, outlier_probability: Array, normalised_squares: Array, measured_axis_counts: Array
    ) -> OutlierDistribution:
        """Fit the distribution to measurements with known outlier probabilities (M step)."""
        mean_square = np.sum(outlier_probability * normalised_squares) / max(
            np.sum(outlier_probability * measured_axis_counts), 1e-9
        )
        min_fraction = 0.5 / len(outlier_probability)
        return cls(
            float(np.clip(outlier_probability.mean(), min_fraction, MAX_OUTLIER_FRACTION)),
            max(MIN_OUTLIER_SIGMA_RATIO, float(np.sqrt(mean_square))),
        )

    def compute_probability(self, normalised_squares: Array, measured_axis_counts: Array) -> Array:
        """Return the probability of each measurement to be an outlier (E step)."""
        log_odds = np.log(self.fraction / (1.0 - self.fraction)) - measured_axis_counts * np.log(
            self.sigma_ratio
        )
        return np.asarray(expit(log_odds + 0.5 * normalised_squares * (1.0 - self.sigma_ratio**-2)))

    def compute_weights(self, outlier_probability: Array) -> Array:
        """Return the weight of each measurement: SIGMA_Z² ÷ variance of the measurement.

        It is 1 for a good measurement, and 1 / ``sigma_ratio``² for an outlier.
        """
        return 1.0 - outlier_probability * (1.0 - self.sigma_ratio**-2)


INITIAL_OUTLIERS = OutlierDistribution(fraction=0.005, sigma_ratio=10.0)


@dataclass(frozen=True)
class NoiseFit:
    """Maximum-likelihood noise parameters, and the outliers among the measurements.

    Attributes
    ----------
    outlier_probability : ndarray, shape (m,)
        Probability of each measurement to be an outlier.
    measurement_weights : ndarray, shape (m,)
        1 for a good measurement, smaller for an outlier.
    score : NegativeLogLikelihood
        -ln p as a function of the noise parameters.
    variance_factor_of_ln_sigma_z : float
        Factor, at least 1, by which the variance of ln SIGMA_Z is larger because it is uncertain
        which measurements are outliers.
    """

    noise_parameters: NoiseParameters
    measurement_weights: Array
    outlier_probability: Array
    score: NegativeLogLikelihood
    variance_factor_of_ln_sigma_z: float
    outliers: OutlierDistribution

    def compute_score(self) -> float:
        """Return -ln p of the measurements at the maximum-likelihood noise parameters."""
        return self.score(self.noise_parameters)


def convert_to_positions_and_increments(
    preintegrated_motion: PreintegratedMotion,
) -> PositionsAndIncrements:
    """Convert the inputs of KF along one axis to the inputs of :func:`fit_constant_errors`.

    The only constant errors are those of KF's initial position and velocity. Their prior variances
    are KF's initial covariance.
    """
    # Row 0 is KF's initial state, which has a strong prior and no measurement
    measurement_count = len(preintegrated_motion.measurement_m)
    prior_precision = np.zeros((measurement_count + 1, 2))
    prior_precision[0] = KNOWN_INITIAL_STATE_PRECISION
    measured_m = np.append(np.nan, preintegrated_motion.measurement_m)[:, None]
    # Shape (axes, time offsets, inputs, intervals), with one axis and one time offset. Inputs: the
    # data, then unit errors of the initial position and of the initial velocity
    dp, dv = np.zeros((2, 1, 1, 3, measurement_count))
    dp[0, 0, 0] = preintegrated_motion.delta_position_m
    dv[0, 0, 0] = preintegrated_motion.delta_velocity_m_s
    # The strong prior fixes the state in row 0. Errors of the initial position and velocity are
    # therefore modelled as errors of the increments in the first interval
    dp[0, 0, 1:, 0] = (1.0, preintegrated_motion.interval_s[0])
    dv[0, 0, 2, 0] = 1.0
    return subtract_smooth_path(
        PositionsAndIncrements(
            measurement_m=measured_m,
            segment_start_indices=np.array([0]),
            interval_s=preintegrated_motion.interval_s,
            process_noise_per_sigma_a_squared=preintegrated_motion.process_noise_per_sigma_a_squared.T,
            process_noise_independent_of_sigma_a=preintegrated_motion.process_noise_independent_of_sigma_a.T,
            prior_precision=prior_precision,
            prior_sigmas_of_constant_errors=np.sqrt([INITIAL_COVARIANCE[0], INITIAL_COVARIANCE[2]]),
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )
    )


def maximise_likelihood(
    positions_by_axis: Sequence[PositionsAndIncrements],
    start_parameters: NoiseParameters,
    measurement_weights: Array,
    fits_outliers: bool = True,
) -> NoiseFit:
    """Estimate the noises and the outliers by maximum likelihood.

    Parameters
    ----------
    positions_by_axis : sequence of PositionsAndIncrements
        Positions along each axis, at equal times.
    start_parameters : NoiseParameters
        Initial values. Random walk or time-correlated noise of zero stays zero.
    measurement_weights : ndarray, shape (m,)
        Initial weight of each measurement.
    fits_outliers : bool
        True to estimate the outliers and reduce their weights; False to keep the initial weights.
    """
    if len(measurement_weights) <= 2 * INITIAL_FIT_MEASUREMENT_COUNT:
        return _fit_noises_and_outliers(
            positions_by_axis, start_parameters, measurement_weights, fits_outliers
        )
    # In a long flight, a fit to the first measurements gives the initial values. The positions may
    # have one more row at the start, KF's initial state. Therefore cut the same number of rows from
    # the end of both arrays
    omitted_count = len(measurement_weights) - INITIAL_FIT_MEASUREMENT_COUNT
    first_fit = _fit_noises_and_outliers(
        [
            positions.first(len(positions.measurement_m) - omitted_count)
            for positions in positions_by_axis
        ],
        start_parameters,
        measurement_weights[:INITIAL_FIT_MEASUREMENT_COUNT],
        fits_outliers,
    )
    return _fit_noises_and_outliers(
        positions_by_axis,
        first_fit.noise_parameters,
        measurement_weights,
        fits_outliers,
        first_fit.outliers,
        MAX_OUTLIER_ITERATIONS,
    )


def _fit_noises_and_outliers(
    positions_by_axis: Sequence[PositionsAndIncrements],
    start_parameters: NoiseParameters,
    measurement_weights: Array,
    fits_outliers: bool,
    outliers: OutlierDistribution = INITIAL_OUTLIERS,
    outlier_iterations_per_fit: int = 1,
) -> NoiseFit:
    """Alternately fit the outliers (expectation maximisation) and the noises."""
    outlier_probability = np.zeros_like(measurement_weights)
    likelihood = NegativeLogLikelihood(
        positions_by_axis, measurement_weights, start_parameters.sigma_z_m
    )
    noise_parameters = _maximise_by_gradient(likelihood, start_parameters)
    for _ in range(MAX_OUTLIER_ITERATIONS if fits_outliers else 0):
        # 1. Squared errors in units of SIGMA_Z², with SIGMA_Z limited by a robust estimate
        normalised_squares, measured_axis_counts = _estimate_normalised_squares(
            positions_by_axis, noise_parameters, measurement_weights
        )
        # Outliers increase the estimated SIGMA_Z, but hardly the median of the squared errors
        axis_count = measured_axis_counts[0]
        median_square = float(np.median(normalised_squares / measured_axis_counts))
        sigma_z_m = noise_parameters.sigma_z_m
        robust_sigma_z_m = sigma_z_m * (median_square * axis_count / chdtri(axis_count, 0.5)) ** 0.5
        # If most errors exceed the search range of SIGMA_Z, no measurement is treated as an outlier
        if robust_sigma_z_m > SIGMA_Z_SEARCH_RANGE_M[1]:
            break
        limited_sigma_z_m = min(
            sigma_z_m, MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO * robust_sigma_z_m
        )
        normalised_squares *= (sigma_z_m / limited_sigma_z_m) ** 2
        # 2. Outliers: E step and M step
        previous_probability = outlier_probability
        for _ in range(outlier_iterations_per_fit):
            outlier_probability = outliers.compute_probability(
                normalised_squares, measured_axis_counts
            )
            outliers = OutlierDistribution.fit(
                outlier_probability, normalised_squares, measured_axis_counts
            )
        has_outliers = outlier_probability.sum() >= 1.0 or outlier_probability.max() >= 0.5
        # If no outliers are found now or before, keep the noise fit to all measurements
        if not has_outliers and not previous_probability.any():
            outlier_probability = previous_probability
            break
        # Fit the noise parameters again; outliers have a small weight
        measurement_weights = outliers.compute_weights(outlier_probability)
        likelihood = NegativeLogLikelihood(
            positions_by_axis, measurement_weights, start_parameters.sigma_z_m
        )
        noise_parameters = _maximise_by_gradient(
            likelihood, replace(noise_parameters, sigma_z_m=limited_sigma_z_m)
        )
        probability_changes = np.abs(outlier_probability - previous_probability)
        if probability_changes.max() < MAX_OUTLIER_PROBABILITY_CHANGE:
            break
    variance_factor_of_ln_sigma_z = 1.0
    if outlier_probability.any():
        variance_factor_of_ln_sigma_z = compute_variance_factor_of_ln_sigma_z(
            *_estimate_normalised_squares(positions_by_axis, noise_parameters, measurement_weights),
            outlier_probability,
            outliers.sigma_ratio,
        )
    return NoiseFit(
        noise_parameters,
        measurement_weights,
        outlier_probability,
        likelihood,
        variance_factor_of_ln_sigma_z,
        outliers,
    )


def estimate_outlier_probability(
    positions_by_axis: Sequence[PositionsAndIncrements], fit: NoiseFit, measurement_count: int
) -> Array:
    """Return the probability of each measurement to be an outlier, with the noises of ``fit``."""
    outlier_probability = np.zeros(measurement_count)
    for _ in range(OUTLIER_ITERATIONS_WITH_GIVEN_NOISES):
        measurement_weights = fit.outliers.compute_weights(outlier_probability)
        outlier_probability = fit.outliers.compute_probability(
            *_estimate_normalised_squares(
                positions_by_axis, fit.noise_parameters, measurement_weights
            )
        )
    return outlier_probability


def _estimate_normalised_squares(
    positions_by_axis: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> tuple[Array, Array]:
    """Return the expected squared error ÷ SIGMA_Z² of each measurement, summed over its axes.

    Return also the number of measured axes of each measurement.
    """
    squared_errors_and_axis_counts = []
    for positions in positions_by_axis:
        # First estimate the constant errors (such as biases), to subtract their effect. positions
        # has only one time offset: index 0
        constant_errors = fit_constant_errors(
            [positions], noise_parameters, measurement_weights
        ).estimate_constant_errors_by_segment()[:, 0]
        noisy_positions, variance_m2 = add_noises(positions, noise_parameters, measurement_weights)
        squared_errors_and_axis_counts.append(
            estimate_squared_errors(
                noisy_positions, noise_parameters.sigma_a_m_s2, variance_m2, constant_errors
            )
        )
    # Omit KF's initial state, if it is the first row: it has no measurement
    squared_errors_m2, measured_axis_counts = np.sum(squared_errors_and_axis_counts, axis=0)[
        :, -len(measurement_weights) :
    ]
    return squared_errors_m2 / noise_parameters.sigma_z_m**2, measured_axis_counts


def compute_variance_factor_of_ln_sigma_z(
    normalised_squares: Array,
    measured_axis_counts: Array,
    outlier_probability: Array,
    outlier_sigma_ratio: float,
) -> float:
    """Return the variance of ln SIGMA_Z ÷ its variance if all outliers were known.

    It is not known which measurements are outliers. This increases the variance of the estimate of
    ln SIGMA_Z, so the factor is at least 1. Method: missing information (Louis 1982).

    ``normalised_squares`` contains the squared error of each measurement ÷ SIGMA_Z², summed over
    its ``measured_axis_counts`` axes.
    """
    # A measured axis with the standard deviation σ has the Fisher information 2 on ln σ. σ of an
    # outlier is ratio · SIGMA_Z, so an outlier has information on both ln SIGMA_Z and ln ratio
    outlier_fraction = np.mean(outlier_probability)
    sigma_z_information = 2.0 * float(np.sum(measured_axis_counts))
    outlier_information = 2.0 * float(np.sum(measured_axis_counts * outlier_probability))
    fraction_information = len(normalised_squares) * outlier_fraction * (1.0 - outlier_fraction)
    inverse_outlier_variance_ratio = outlier_sigma_ratio**-2.0
    # Parameters: ln SIGMA_Z, ln of the outliers' σ ÷ SIGMA_Z, and log odds of the outlier fraction
    information_with_known_outliers = np.array(
        [
            [sigma_z_information, outlier_information, 0.0],
            [outlier_information, outlier_information, 0.0],
            [0.0, 0.0, fraction_information],
        ]
    )
    # Derivative of the log-likelihood of a measurement with respect to each parameter: value for an
    # outlier minus value for a good measurement
    scores = np.stack(
        [
            normalised_squares * (inverse_outlier_variance_ratio - 1.0),
            normalised_squares * inverse_outlier_variance_ratio - measured_axis_counts,
            np.ones_like(normalised_squares),
        ]
    )
    # It is unknown if a measurement is an outlier. The variance of the score due to this is the
    # missing information
    missing_information = (scores * (outlier_probability * (1.0 - outlier_probability))) @ scores.T
    observed_information = information_with_known_outliers - missing_information
    # With very few outliers, the information matrix may not be positive definite
    if np.linalg.eigvalsh(observed_information)[0] <= 0.0:
        return 1.0
    return max(1.0, sigma_z_information * float(np.linalg.inv(observed_information)[0, 0]))


def _maximise_by_gradient(
    likelihood: NegativeLogLikelihood, start_parameters: NoiseParameters
) -> NoiseParameters:
    """Return the maximum-likelihood noises near the start parameters (L-BFGS-B in ln σ).

    Parameters that are 0 remain 0.
    """
    nonzero_parameters = {name: value for name, value in vars(start_parameters).items() if value}
    log_bounds = np.log([NOISE_SEARCH_RANGES[name] for name in nonzero_parameters])
    measurement_count = len(likelihood.measurement_weights)

    def score_per_measurement(log_parameters: Array) -> float:
        """Return -ln p ÷ number of measurements, which gives L-BFGS-B a suitable first step."""
        try:
            return likelihood(to_noise_parameters(log_parameters)) / measurement_count
        # A large score makes L-BFGS-B try a shorter step
        except np.linalg.LinAlgError:
            return UNCOMPUTABLE_SCORE

    def to_noise_parameters(log_parameters: Array) -> NoiseParameters:
        """Convert the logarithms of the nonzero parameters; all others are 0."""
        return NoiseParameters(
            **dict(zip(nonzero_parameters, np.exp(log_parameters).tolist(), strict=True))
        )

    search_result = minimize(
        score_per_measurement,
        np.clip(np.log([*nonzero_parameters.values()]), *log_bounds.T),
        method="L-BFGS-B",
        bounds=log_bounds.tolist(),
        options={
            "eps": LOG_STEP_FOR_DERIVATIVES,
            "ftol": 1e-10,
            "gtol": 1e-8,
            "maxiter": MAX_FIT_ITERATIONS,
        },
    )
    return to_noise_parameters(search_result.x)
