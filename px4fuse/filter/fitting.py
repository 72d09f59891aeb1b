"""Maximum-likelihood estimates of SIGMA_A and SIGMA_Z, and outliers among the positions.

The noises maximise the likelihood of the innovations (Schweppe 1965). Outliers have a normal
distribution with a larger σ (Tukey 1960), which is estimated by expectation maximisation.

A score is a negative log-likelihood (-ln p): lower is better.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import floor, log

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, comb, expit

from px4fuse.core.arrays import Array
from px4fuse.filter.likelihood import PreintegratedMotion
from px4fuse.filter.marginal_likelihood import (
    PositionFit,
    PositionsAndIncrements,
    estimate_squared_errors,
    fit_positions,
    subtract_smooth_path,
)
from px4fuse.filter.model import INITIAL_COVARIANCE

# Search range (m/s²) of SIGMA_A
SIGMA_A_SEARCH_RANGE_M_S2 = (1e-3, 30.0)
# Search range (m) of SIGMA_Z
SIGMA_Z_SEARCH_RANGE_M = (1e-3, 10.0)
# Maximum number of iterations of expectation maximisation, which estimates the outliers
MAX_OUTLIER_ITERATIONS = 12
# Maximum number of L-BFGS-B iterations of a fit
MAX_FIT_ITERATIONS = 50
# Number of iterations to estimate the outlier probabilities if the noises are given
OUTLIER_ITERATIONS_WITH_GIVEN_NOISES = 3
# Minimum ratio of the outliers' σ to SIGMA_Z
MIN_OUTLIER_SIGMA_RATIO = 3.0
INITIAL_OUTLIER_FRACTION = 0.005
INITIAL_OUTLIER_SIGMA_RATIO = 10.0
MAX_OUTLIER_FRACTION = 0.4
# To detect outliers, SIGMA_Z is limited to this multiple of a robust estimate, which is from the
# median squared error
MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO = 1.2
# Convergence limit for the change of outlier probabilities
MAX_OUTLIER_PROBABILITY_CHANGE = 0.01
# Value of -ln p per measurement if the likelihood cannot be computed
UNCOMPUTABLE_SCORE = 1e6
# Step of ln σ for numerical derivatives of the log-likelihood
LOG_STEP_FOR_DERIVATIVES = 1e-4
# Grid for the interpolation of the log-likelihood: number of nodes, and spacing in ln σ
GRID_NODE_COUNT, GRID_NODE_SPACING = 6, 0.2
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
    """

    def __init__(
        self,
        positions_by_axis: Sequence[PositionsAndIncrements],
        measurement_weights: Array,
        sigma_z_m: float,
    ) -> None:
        self.positions_by_axis = positions_by_axis
        self.measurement_weights = measurement_weights
        self.sigma_z_m = sigma_z_m
        self.is_interpolated = not any(
            positions.process_noise_independent_of_sigma_a.any() for positions in positions_by_axis
        )

        @cache
        def fit_axes_with_sigma_ratio(log_sigma_ratio_grid_index: int) -> list[PositionFit]:
            sigma_a_to_sigma_z_ratio = float(np.exp(GRID_NODE_SPACING * log_sigma_ratio_grid_index))
            return [
                fit_with_sigma_ratios(
                    [positions], [sigma_a_to_sigma_z_ratio], 0.0, measurement_weights, sigma_z_m
                )[0]
                for positions in positions_by_axis
            ]

        @cache
        def compute_scores_with_sigma_ratio(
            log_sigma_ratio_grid_index: int, log_sigma_z_grid_index: int
        ) -> Array:
            sigma_factors = np.exp(GRID_NODE_SPACING * (log_sigma_z_grid_index + GRID_NODES))
            scores_by_axis = [
                axis_fit.compute_scores(sigma_factors)[:, 0]
                for axis_fit in fit_axes_with_sigma_ratio(log_sigma_ratio_grid_index)
            ]
            return np.asarray(np.sum(scores_by_axis, axis=0))

        @cache
        def compute_scores_at_nodes(
            log_sigma_ratio_grid_index: int, log_sigma_z_grid_index: int
        ) -> Array:
            return np.array(
                [
                    compute_scores_with_sigma_ratio(
                        log_sigma_ratio_grid_index + node, log_sigma_z_grid_index
                    )
                    for node in range(GRID_NODE_COUNT)
                ]
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
        log_sigma_z_in_node_steps = log(noise_parameters.sigma_z_m) / GRID_NODE_SPACING
        log_sigma_ratio_in_node_steps = (
            log(noise_parameters.sigma_a_m_s2) / GRID_NODE_SPACING - log_sigma_z_in_node_steps
        )
        grid_nodes_below_value = (GRID_NODE_COUNT - 1) // 2
        first_log_sigma_ratio_grid_index = (
            floor(log_sigma_ratio_in_node_steps) - grid_nodes_below_value
        )
        first_log_sigma_z_grid_index = floor(log_sigma_z_in_node_steps) - grid_nodes_below_value
        log_sigma_ratio_interpolation_weights = _compute_interpolation_weights(
            log_sigma_ratio_in_node_steps - first_log_sigma_ratio_grid_index
        )
        log_sigma_z_interpolation_weights = _compute_interpolation_weights(
            log_sigma_z_in_node_steps - first_log_sigma_z_grid_index
        )
        return float(
            log_sigma_ratio_interpolation_weights
            @ self._compute_scores_at_nodes(
                first_log_sigma_ratio_grid_index, first_log_sigma_z_grid_index
            )
            @ log_sigma_z_interpolation_weights
        )


def _compute_interpolation_weights(position_in_node_steps: float) -> Array:
    """Return the weights of barycentric interpolation (Berrut and Trefethen 2004)."""
    node_distances = position_in_node_steps - GRID_NODES
    if not node_distances.all():
        return np.asarray(node_distances == 0.0, dtype=np.float64)
    weights = BARYCENTRIC_WEIGHTS / node_distances
    return np.asarray(weights / weights.sum())


def fit_with_sigma_ratios(
    position_batches: Iterable[PositionsAndIncrements],
    sigma_a_to_sigma_z_ratios: Sequence[float],
    random_walk_to_sigma_z_ratio: float,
    measurement_weights: Array,
    sigma_z_m: float,
) -> list[PositionFit]:
    """Fit constant errors (such as biases) to positions, for each ratio SIGMA_A / SIGMA_Z (1/s²).

    The batches contain successive segments of the flight. The result has one fit for each ratio.
    ``random_walk_to_sigma_z_ratio`` has the unit 1/√s.
    """
    fits_by_batch = []
    end = 0
    for positions in position_batches:
        begin, end = end, end + len(positions.measurement_m)
        positions_over_sigma_z, variance_m2 = positions.divide_sigmas_by_sigma_z(
            sigma_z_m, random_walk_to_sigma_z_ratio, measurement_weights[begin:end]
        )
        fits_by_batch.append(
            [
                fit_positions(positions_over_sigma_z, ratio, variance_m2)
                for ratio in sigma_a_to_sigma_z_ratios
            ]
        )
    return [
        replace(
            batch_fits[0],
            gram_matrix=np.concatenate([batch_fit.gram_matrix for batch_fit in batch_fits]),
            covariance_log_determinant=sum(
                batch_fit.covariance_log_determinant for batch_fit in batch_fits
            ),
            degrees_of_freedom=sum(batch_fit.degrees_of_freedom for batch_fit in batch_fits),
        )
        for batch_fits in zip(*fits_by_batch, strict=True)
    ]


def fit_constant_errors(
    position_batches: Iterable[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> PositionFit:
    """Fit constant errors (such as biases) to positions, with given noise parameters.

    The batches contain successive segments of the flight. The variance of a measurement is
    SIGMA_Z² / weight.
    """
    sigma_z_m = noise_parameters.sigma_z_m
    if noise_parameters.correlated_sigma_m:
        position_batches = (
            replace(
                positions,
                correlated_noise=(noise_parameters.correlated_sigma_m, noise_parameters.tau_s),
            )
            for positions in position_batches
        )
    (position_fit,) = fit_with_sigma_ratios(
        position_batches,
        [noise_parameters.sigma_a_m_s2 / sigma_z_m],
        noise_parameters.random_walk_m / sigma_z_m,
        measurement_weights,
        sigma_z_m,
    )
    return position_fit.scale_sigmas(sigma_z_m)


def negative_log_likelihood(
    positions_by_axis: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> float:
    """Return -ln p of the measurements of all axes, without the constant term with ln 2π."""
    return float(
        sum(
            fit_constant_errors(
                [positions], noise_parameters, measurement_weights
            ).compute_scores()[0, 0]
            for positions in positions_by_axis
        )
    )


@dataclass(frozen=True)
class NoiseFit:
    """Maximum-likelihood noise parameters, and the outliers among the measurements.

    Attributes
    ----------
    outlier_fraction, outlier_sigma_ratio : float
        Fraction of outliers, and ratio of their σ to SIGMA_Z.
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
    outlier_fraction: float
    outlier_sigma_ratio: float

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
    measurement_count = len(preintegrated_motion.measurement_m)
    prior_precision = np.zeros((measurement_count + 1, 2))
    prior_precision[0] = KNOWN_INITIAL_STATE_PRECISION
    measured_m = np.append(np.nan, preintegrated_motion.measurement_m)[:, None]
    dp, dv = np.zeros((2, 1, 1, 3, measurement_count))
    dp[0, 0, 0] = preintegrated_motion.delta_position_m
    dv[0, 0, 0] = preintegrated_motion.delta_velocity_m_s
    # Errors of the initial position and velocity enter in the first interval only
    dp[0, 0, 1:, 0] = (1.0, preintegrated_motion.interval_s[0])
    dv[0, 0, 2, 0] = 1.0
    return subtract_smooth_path(
        PositionsAndIncrements(
            measurement_m=measured_m,
            segment_starts=np.array([0]),
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
        True to estimate the outliers; False to keep the weights.
    """
    outlier_probability = np.zeros_like(measurement_weights)
    outlier_fraction, outlier_sigma_ratio = INITIAL_OUTLIER_FRACTION, INITIAL_OUTLIER_SIGMA_RATIO
    is_long = len(measurement_weights) > 2 * INITIAL_FIT_MEASUREMENT_COUNT
    if is_long:
        positions_of_first_fit = [
            positions.first(
                len(positions.measurement_m)
                - len(measurement_weights)
                + INITIAL_FIT_MEASUREMENT_COUNT
            )
            for positions in positions_by_axis
        ]
        first_fit = maximise_likelihood(
            positions_of_first_fit,
            start_parameters,
            measurement_weights[:INITIAL_FIT_MEASUREMENT_COUNT],
            fits_outliers,
        )
        start_parameters = first_fit.noise_parameters
        outlier_fraction = first_fit.outlier_fraction
        outlier_sigma_ratio = first_fit.outlier_sigma_ratio
    likelihood = NegativeLogLikelihood(
        positions_by_axis, measurement_weights, start_parameters.sigma_z_m
    )
    noise_parameters = _maximise_by_gradient(likelihood, start_parameters)
    for _ in range(MAX_OUTLIER_ITERATIONS if fits_outliers else 0):
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            positions_by_axis, noise_parameters, measurement_weights
        )
        # Outliers increase the estimated SIGMA_Z, but hardly the median of the squared errors
        robust_variance_m2 = float(
            np.median(expected_squared_errors_m2 / measured_axis_counts)
            / (chdtri(measured_axis_counts[0], 0.5) / measured_axis_counts[0])
        )
        # If most errors exceed the search range of SIGMA_Z, no measurement is treated as an outlier
        if robust_variance_m2 > SIGMA_Z_SEARCH_RANGE_M[1] ** 2:
            break
        limited_measurement_variance_m2 = min(
            noise_parameters.sigma_z_m**2,
            MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO**2 * robust_variance_m2,
        )
        normalised_squares = expected_squared_errors_m2 / limited_measurement_variance_m2
        previous_probability = outlier_probability
        for _ in range(MAX_OUTLIER_ITERATIONS if is_long else 1):
            outlier_probability = _compute_outlier_probability(
                normalised_squares, measured_axis_counts, outlier_fraction, outlier_sigma_ratio
            )
            outlier_fraction = float(
                np.clip(
                    outlier_probability.mean(), 0.5 / len(measurement_weights), MAX_OUTLIER_FRACTION
                )
            )
            outlier_mean_normalised_square = np.sum(outlier_probability * normalised_squares) / max(
                np.sum(outlier_probability * measured_axis_counts), 1e-9
            )
            outlier_sigma_ratio = max(
                MIN_OUTLIER_SIGMA_RATIO, float(np.sqrt(outlier_mean_normalised_square))
            )
        if (
            outlier_probability.sum() < 1.0
            and outlier_probability.max() < 0.5
            and not previous_probability.any()
        ):
            outlier_probability = previous_probability
            break
        measurement_weights = 1.0 - outlier_probability * (1.0 - outlier_sigma_ratio**-2.0)
        likelihood = NegativeLogLikelihood(
            positions_by_axis, measurement_weights, start_parameters.sigma_z_m
        )
        noise_parameters = _maximise_by_gradient(
            likelihood,
            replace(noise_parameters, sigma_z_m=float(np.sqrt(limited_measurement_variance_m2))),
        )
        if (
            np.abs(outlier_probability - previous_probability).max()
            < MAX_OUTLIER_PROBABILITY_CHANGE
        ):
            break
    variance_factor_of_ln_sigma_z = 1.0
    if outlier_probability.any():
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            positions_by_axis, noise_parameters, measurement_weights
        )
        variance_factor_of_ln_sigma_z = compute_variance_factor_of_ln_sigma_z(
            expected_squared_errors_m2 / noise_parameters.sigma_z_m**2,
            measured_axis_counts,
            outlier_probability,
            outlier_sigma_ratio,
        )
    return NoiseFit(
        noise_parameters,
        measurement_weights,
        outlier_probability,
        likelihood,
        variance_factor_of_ln_sigma_z,
        outlier_fraction,
        outlier_sigma_ratio,
    )


def estimate_outlier_probability(
    positions_by_axis: Sequence[PositionsAndIncrements], fit: NoiseFit, measurement_count: int
) -> Array:
    """Return the probability of each measurement to be an outlier, with the noises of ``fit``."""
    outlier_probability = np.zeros(measurement_count)
    for _ in range(OUTLIER_ITERATIONS_WITH_GIVEN_NOISES):
        measurement_weights = 1.0 - outlier_probability * (1.0 - fit.outlier_sigma_ratio**-2.0)
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            positions_by_axis, fit.noise_parameters, measurement_weights
        )
        outlier_probability = _compute_outlier_probability(
            expected_squared_errors_m2 / fit.noise_parameters.sigma_z_m**2,
            measured_axis_counts,
            fit.outlier_fraction,
            fit.outlier_sigma_ratio,
        )
    return outlier_probability


def _estimate_squared_errors(
    positions_by_axis: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> tuple[Array, Array]:
    """Return the expected squared error (m²) of each measurement, summed over its measured axes.

    Return also the number of measured axes of each measurement.
    """
    squared_errors_and_axis_counts = []
    for positions in positions_by_axis:
        constant_errors = fit_constant_errors(
            [positions], noise_parameters, measurement_weights
        ).estimate_constant_errors_by_segment()[:, 0]
        positions_with_random_walk, measurement_variance_m2 = positions.divide_sigmas_by_sigma_z(
            1.0, noise_parameters.random_walk_m, measurement_weights / noise_parameters.sigma_z_m**2
        )
        squared_errors_and_axis_counts.append(
            estimate_squared_errors(
                positions_with_random_walk,
                noise_parameters.sigma_a_m_s2,
                measurement_variance_m2,
                constant_errors,
            )
        )
    expected_squared_errors_m2, measured_axis_counts = np.sum(
        squared_errors_and_axis_counts, axis=0
    )[:, -len(measurement_weights) :]
    return expected_squared_errors_m2, measured_axis_counts


def _compute_outlier_probability(
    normalised_squares: Array,
    measured_axis_counts: Array,
    outlier_fraction: float,
    outlier_sigma_ratio: float,
) -> Array:
    log_odds = np.log(outlier_fraction / (1.0 - outlier_fraction)) - measured_axis_counts * np.log(
        outlier_sigma_ratio
    )
    return np.asarray(
        expit(log_odds + 0.5 * normalised_squares * (1.0 - outlier_sigma_ratio**-2.0))
    )


def compute_variance_factor_of_ln_sigma_z(
    normalised_squares: Array,
    measured_axis_counts: Array,
    outlier_probability: Array,
    outlier_sigma_ratio: float,
) -> float:
    """Return the factor (at least 1) by which unknown outliers increase the variance of ln SIGMA_Z.

    With a factor of 1, the variance is as small as if it were known which measurements are
    outliers. Method: missing information (Louis 1982). ``normalised_squares`` contains the squared
    error of each measurement ÷ SIGMA_Z², summed over its ``measured_axis_counts`` axes.
    """
    outlier_fraction = np.mean(outlier_probability)
    log_sigma_z_information = 2.0 * float(np.sum(measured_axis_counts))
    inverse_outlier_variance_ratio = outlier_sigma_ratio**-2.0
    information_with_known_outliers = np.zeros((3, 3))
    information_with_known_outliers[:2, :2] = 2.0 * np.sum(
        measured_axis_counts * outlier_probability
    )
    information_with_known_outliers[0, 0] = log_sigma_z_information
    information_with_known_outliers[2, 2] = (
        len(normalised_squares) * outlier_fraction * (1.0 - outlier_fraction)
    )
    scores = np.stack(
        [
            normalised_squares * (inverse_outlier_variance_ratio - 1.0),
            normalised_squares * inverse_outlier_variance_ratio - measured_axis_counts,
            np.ones_like(normalised_squares),
        ]
    )
    missing_information = (scores * (outlier_probability * (1.0 - outlier_probability))) @ scores.T
    observed_information = information_with_known_outliers - missing_information
    # With very few outliers, the information matrix may not be positive definite
    if np.linalg.eigvalsh(observed_information)[0] <= 0.0:
        return 1.0
    return max(1.0, log_sigma_z_information * float(np.linalg.inv(observed_information)[0, 0]))


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
        # Dividing by the number of measurements gives L-BFGS-B a suitable first step
        try:
            return likelihood(to_noise_parameters(log_parameters)) / measurement_count
        # A large score makes L-BFGS-B try a shorter step
        except np.linalg.LinAlgError:
            return UNCOMPUTABLE_SCORE

    def to_noise_parameters(log_parameters: Array) -> NoiseParameters:
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
