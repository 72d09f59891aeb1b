"""Maximum-likelihood estimates of SIGMA_A and SIGMA_Z, and outliers among the positions.

The noises maximise the likelihood of the innovations (Schweppe 1965). Outliers have a normal
distribution with a larger σ (Tukey 1960), which is estimated by expectation maximisation.

A score is a negative log-likelihood (-ln p): lower is better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, expit

from px4fuse.core.arrays import Array, ArrayPair
from px4fuse.filter.likelihood import preintegrate
from px4fuse.filter.marginal_likelihood import (
    NoiseParameters,
    PositionsAndIncrements,
    estimate_squared_errors,
    fit_constant_errors,
    subtract_smooth_path,
)
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis

# Search range (m/s²) of SIGMA_A
SIGMA_A_SEARCH_RANGE_M_S2 = (1e-3, 30.0)
# Search range (m) of SIGMA_Z
SIGMA_Z_SEARCH_RANGE_M = (1e-3, 10.0)
# Maximum number of expectation maximisation iterations
MAX_OUTLIER_ITERATIONS = 12
# Maximum number of L-BFGS-B iterations of a complete fit
MAX_FINAL_ITERATIONS = 50
# Maximum number of L-BFGS-B iterations between two estimates of the outlier probabilities
MAX_COARSE_ITERATIONS = 3
# Minimum ratio of the outliers' σ to SIGMA_Z
MIN_OUTLIER_SIGMA_RATIO = 3.0
INITIAL_OUTLIER_FRACTION = 0.005
INITIAL_OUTLIER_SIGMA_RATIO = 10.0
MAX_OUTLIER_FRACTION = 0.4
# Maximum ratio of SIGMA_Z to its robust estimate from the median squared error
MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO = 1.2
# Convergence limit for the change of outlier probabilities
MAX_OUTLIER_PROBABILITY_CHANGE = 0.01
# Value of -ln p per measurement if the likelihood cannot be computed
UNCOMPUTABLE_SCORE = 1e6
# Step of ln σ for numerical derivatives of the log-likelihood
LOG_STEP_FOR_DERIVATIVES = 1e-4
# Number of measurements that give the initial values for a long flight
INITIAL_FIT_MEASUREMENT_COUNT = 2000
# Search range of each field of NoiseParameters, in the unit of the field
NOISE_SEARCH_RANGES = {
    "sigma_a_m_s2": SIGMA_A_SEARCH_RANGE_M_S2,
    "sigma_z_m": SIGMA_Z_SEARCH_RANGE_M,
    "random_walk_m": (1e-4, 1.0),
    "correlated_sigma_m": (1e-3, 10.0),
    "tau_s": (0.05, 60.0),
}


@dataclass(frozen=True)
class NoiseFit:
    """Maximum-likelihood noise parameters, and the outliers among the measurements.

    Attributes
    ----------
    axis_positions : sequence of PositionsAndIncrements
        Positions along each axis, at equal times.
    outlier_fraction, outlier_sigma_ratio : float
        Fraction of outliers, and ratio of their σ to SIGMA_Z.
    outlier_probability : ndarray, shape (m,)
        Probability of each measurement to be an outlier.
    measurement_weights : ndarray, shape (m,)
        1 for a good measurement, smaller for an outlier.
    log_sigma_z_variance_factor : float
        Increase of the variance of ln SIGMA_Z by uncertain outliers; at least 1.
    lowest_score : float
        -ln p of the measurements with ``noise_parameters``.
    """

    axis_positions: Sequence[PositionsAndIncrements]
    noise_parameters: NoiseParameters
    measurement_weights: Array
    outlier_probability: Array
    log_sigma_z_variance_factor: float
    outlier_fraction: float
    outlier_sigma_ratio: float
    lowest_score: float

    def score(self, noise_parameters: NoiseParameters) -> float:
        """Return -ln p of the measurements, without a constant term."""
        return compute_score(self.axis_positions, noise_parameters, self.measurement_weights)


def compute_score(
    axis_positions: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> float:
    """Return -ln p of the measurements of all axes, without a constant term."""
    return sum(
        fit_constant_errors(positions, noise_parameters, measurement_weights).compute_score()
        for positions in axis_positions
    )


def make_kf_positions(axis: Axis, settings: Settings) -> PositionsAndIncrements:
    """Return the inputs of KF along one axis as inputs of :func:`fit_constant_errors`.

    The first row is KF's initial state, which has no measurement.
    """
    motion = preintegrate(axis, settings)
    return subtract_smooth_path(
        PositionsAndIncrements(
            measurement_m=np.append(np.nan, motion.measurement_m - motion.initial_state.position_m)[
                :, None
            ],
            segment_starts=np.array([0]),
            interval_s=motion.interval_s,
            process_noise_per_sigma_a_squared=motion.process_noise_per_sigma_a_squared.T,
            process_noise_independent_of_sigma_a=motion.process_noise_independent_of_sigma_a.T,
            initial_state_precision=(1.0 / INITIAL_COVARIANCE[0], 1.0 / INITIAL_COVARIANCE[2]),
            is_initial_state_known=True,
            constant_prior_sigmas=np.zeros(0),
            delta_position_m=motion.delta_position_m[None, None],
            delta_velocity_m_s=motion.delta_velocity_m_s[None, None],
        )
    )


def maximise_likelihood(
    axis_positions: Sequence[PositionsAndIncrements],
    start_parameters: NoiseParameters,
    measurement_weights: Array,
    fits_outliers: bool = True,
) -> NoiseFit:
    """Estimate the noises and the outliers by maximum likelihood.

    Parameters
    ----------
    axis_positions : sequence of PositionsAndIncrements
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
            for positions in axis_positions
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
    noise_parameters = start_parameters
    for iteration in range(MAX_OUTLIER_ITERATIONS if fits_outliers else 0):
        noise_parameters, _ = _maximise_by_gradient(
            axis_positions,
            noise_parameters,
            measurement_weights,
            MAX_COARSE_ITERATIONS if iteration else MAX_FINAL_ITERATIONS,
        )
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            axis_positions, noise_parameters, measurement_weights
        )
        # Outliers increase the estimated SIGMA_Z, but hardly change the median of squared errors
        robust_variance_m2 = float(
            np.median(expected_squared_errors_m2 / measured_axis_counts)
            / (chdtri(measured_axis_counts[0], 0.5) / measured_axis_counts[0])
        )
        # No measurement is an outlier if most errors exceed the search range of SIGMA_Z
        if robust_variance_m2 > SIGMA_Z_SEARCH_RANGE_M[1] ** 2:
            break
        limited_sigma_z_variance_m2 = min(
            noise_parameters.sigma_z_m**2,
            MAX_SIGMA_Z_TO_MEDIAN_BASED_SIGMA_Z_RATIO**2 * robust_variance_m2,
        )
        normalised_squares = expected_squared_errors_m2 / limited_sigma_z_variance_m2
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
        if (
            np.abs(outlier_probability - previous_probability).max()
            < MAX_OUTLIER_PROBABILITY_CHANGE
        ):
            break
        noise_parameters = replace(
            noise_parameters, sigma_z_m=float(np.sqrt(limited_sigma_z_variance_m2))
        )
    noise_parameters, lowest_score = _maximise_by_gradient(
        axis_positions, noise_parameters, measurement_weights
    )
    log_sigma_z_variance_factor = 1.0
    if outlier_probability.any():
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            axis_positions, noise_parameters, measurement_weights
        )
        log_sigma_z_variance_factor = compute_log_sigma_z_variance_factor(
            expected_squared_errors_m2 / noise_parameters.sigma_z_m**2,
            measured_axis_counts,
            outlier_probability,
            outlier_sigma_ratio,
        )
    return NoiseFit(
        axis_positions,
        noise_parameters,
        measurement_weights,
        outlier_probability,
        log_sigma_z_variance_factor,
        outlier_fraction,
        outlier_sigma_ratio,
        lowest_score,
    )


def estimate_outlier_probability(
    axis_positions: Sequence[PositionsAndIncrements], fit: NoiseFit, measurement_count: int
) -> Array:
    """Return the probability of each measurement to be an outlier, with the noises of ``fit``."""
    outlier_probability = np.zeros(measurement_count)
    for _ in range(MAX_COARSE_ITERATIONS):
        measurement_weights = 1.0 - outlier_probability * (1.0 - fit.outlier_sigma_ratio**-2.0)
        expected_squared_errors_m2, measured_axis_counts = _estimate_squared_errors(
            axis_positions, fit.noise_parameters, measurement_weights
        )
        outlier_probability = _compute_outlier_probability(
            expected_squared_errors_m2 / fit.noise_parameters.sigma_z_m**2,
            measured_axis_counts,
            fit.outlier_fraction,
            fit.outlier_sigma_ratio,
        )
    return outlier_probability


def _estimate_squared_errors(
    axis_positions: Sequence[PositionsAndIncrements],
    noise_parameters: NoiseParameters,
    measurement_weights: Array,
) -> ArrayPair:
    """Return the expected squared error (m²) of each measurement, and its number of axes.

    The squared error is summed over the measured axes.
    """
    squared_errors_and_axis_counts = [
        estimate_squared_errors(positions, noise_parameters, measurement_weights)
        for positions in axis_positions
    ]
    # The initial states of KF are not measurements
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


def compute_log_sigma_z_variance_factor(
    normalised_squares: Array,
    measured_axis_counts: Array,
    outlier_probability: Array,
    outlier_sigma_ratio: float,
) -> float:
    """Return the variance of ln SIGMA_Z, relative to its variance with known outliers.

    Method: missing information (Louis 1982). ``normalised_squares`` are squared errors over
    SIGMA_Z², summed over ``measured_axis_counts`` axes.
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
    axis_positions: Sequence[PositionsAndIncrements],
    start_parameters: NoiseParameters,
    measurement_weights: Array,
    max_steps: int = MAX_FINAL_ITERATIONS,
) -> tuple[NoiseParameters, float]:
    """Return the noises with the lowest score (-ln p), and this score."""
    nonzero_parameters = {name: value for name, value in vars(start_parameters).items() if value}
    log_bounds = np.log([NOISE_SEARCH_RANGES[name] for name in nonzero_parameters])
    measurement_count = len(measurement_weights)

    def to_noise_parameters(log_parameters: Array) -> NoiseParameters:
        return NoiseParameters(
            **dict(zip(nonzero_parameters, np.exp(log_parameters).tolist(), strict=True))
        )

    def score_per_measurement(log_parameters: Array) -> float:
        # Dividing by the number of measurements gives L-BFGS-B a suitable first step
        try:
            return (
                compute_score(
                    axis_positions, to_noise_parameters(log_parameters), measurement_weights
                )
                / measurement_count
            )
        # After a large score, L-BFGS-B tries a shorter step
        except np.linalg.LinAlgError:
            return UNCOMPUTABLE_SCORE

    search_result = minimize(
        score_per_measurement,
        np.clip(np.log([*nonzero_parameters.values()]), *log_bounds.T),
        method="L-BFGS-B",
        bounds=log_bounds.tolist(),
        options={
            "eps": LOG_STEP_FOR_DERIVATIVES,
            "ftol": 1e-10,
            "gtol": 1e-8,
            "maxiter": max_steps,
        },
    )
    return to_noise_parameters(search_result.x), search_result.fun * measurement_count
