"""Maximum-likelihood estimates of SIGMA_A and SIGMA_Z, and outliers among the positions.

The noises maximise the likelihood of the innovations (Schweppe 1965). Outliers have a normal
distribution that is many times wider (Tukey 1960). Expectation maximisation estimates their
fraction, their width (σ of outliers over SIGMA_Z) and the probability that a measurement is an
outlier.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import floor, log

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, comb, expit

from px4fuse.core.arrays import Array
from px4fuse.filter.likelihood import Preintegrated
from px4fuse.filter.marginal_likelihood import (
    FittedPositions,
    Positions,
    centre_on_path,
    expected_squared_errors,
    fit_positions,
)
from px4fuse.filter.model import INITIAL_COVARIANCE

# Search range (m/s²) of SIGMA_A
SIGMA_A_SEARCH_M_S2 = (1e-3, 30.0)
# Search range (m) of SIGMA_Z: no positioning system is better than 1 mm
SIGMA_Z_SEARCH_M = (1e-3, 10.0)
# Maximum number of expectation maximisation iterations that estimate the outliers
MAX_OUTLIER_ITERATIONS = 12
# Maximum number of L-BFGS-B iterations after the outlier probabilities have converged
MAX_FINAL_ITERATIONS = 50
# Maximum number of L-BFGS-B iterations while the outlier probabilities still change
MAX_COARSE_ITERATIONS = 3
# Minimum ratio of the outliers' σ to SIGMA_Z: outliers with a smaller σ cannot be distinguished
MIN_OUTLIER_WIDTH = 3.0
# Initial value of the fraction of outliers
START_OUTLIER_FRACTION = 0.005
# Initial value of the ratio of the outliers' σ to SIGMA_Z
START_OUTLIER_WIDTH = 10.0
# Maximum fraction of outliers
MAX_OUTLIER_FRACTION = 0.4
# Maximum ratio of SIGMA_Z to its estimate from the median squared error, while outliers are
# estimated
MAX_SIGMA_Z_RATIO = 1.2
# Expectation maximisation has converged if no outlier probability changes by more than this
MAX_PROBABILITY_CHANGE = 0.01
# Value of -ln p per measurement if the likelihood cannot be computed: larger than any real value
UNCOMPUTABLE_SCORE = 1e6
# Step of ln σ for numerical derivatives of the log-likelihood
DERIVATIVE_LOG_STEP = 1e-4
# Interpolation of the final likelihood: number of nodes, and their distance in ln σ
LIKELIHOOD_NODES = 10, 0.25
# Interpolation while the outlier probabilities still change: number and distance of the nodes
COARSE_LIKELIHOOD_NODES = 6, 0.2
# A noise fit to a long flight starts with the noises of this number of first measurements
FIRST_MEASUREMENTS = 2000
# Precision of a known initial position (1/m²) and velocity (s²/m²): σ of 1 µm and 1 µm/s
KNOWN_START_PRECISION = 1e12


@dataclass(frozen=True)
class Noises:
    """Noise parameters of the IMU and of the position source.

    Attributes
    ----------
    sigma_a_m_s2 : float
        Noise of the acceleration over one DT.
    sigma_z_m : float
        White noise of a position.
    random_walk_m : float
        Random walk of the source (m/√s); 0 if the source does not drift.
    correlated_sigma_m, tau_s : float
        Standard deviation and time constant of time-correlated noise; 0 without it.
    """

    sigma_a_m_s2: float
    sigma_z_m: float
    random_walk_m: float = 0.0
    correlated_sigma_m: float = 0.0
    tau_s: float = 0.0


# Search range of each field of Noises, in the unit of the field
SEARCH_RANGES = {
    "sigma_a_m_s2": SIGMA_A_SEARCH_M_S2,
    "sigma_z_m": SIGMA_Z_SEARCH_M,
    "random_walk_m": (1e-4, 1.0),
    "correlated_sigma_m": (1e-3, 10.0),
    "tau_s": (0.05, 60.0),
}


class Likelihood:
    """-ln p of the measurements (without a constant) as a function of the noises.

    For white noise, -ln p is computed at the nodes of a grid over ln(SIGMA_A/SIGMA_Z) and ln
    SIGMA_Z, and interpolated by polynomials to the accuracy of rounding.

    Parameters
    ----------
    axis_positions : sequence of Positions
        Positions with one time offset.
    weight : ndarray, shape (m,)
        Weight of each measurement: its variance is SIGMA_Z² / weight.
    sigma_z_m : float
        Approximate SIGMA_Z, which all noises are divided by.
    is_coarse : bool
        True for fewer nodes, if an approximate maximum is sufficient.
    """

    def __init__(
        self,
        axis_positions: Sequence[Positions],
        weight: Array,
        sigma_z_m: float,
        is_coarse: bool = False,
    ) -> None:
        self.axis_positions = axis_positions
        self.weight = weight
        self.sigma_z_m = sigma_z_m
        self.is_interpolated = not any(
            positions.added_process_noise.any() for positions in axis_positions
        )
        self.node_count, self.step = node_count, step = (
            COARSE_LIKELIHOOD_NODES if is_coarse else LIKELIHOOD_NODES
        )

        @cache
        def fits_at_ratio(ratio_index: int) -> list[FittedPositions]:
            ratio = float(np.exp(step * ratio_index))
            return [
                fit_ratios([positions], [ratio], 0.0, weight, sigma_z_m)[0]
                for positions in axis_positions
            ]

        @cache
        def scores_at_ratio(ratio_index: int, z_index: int) -> Array:
            sigma_factors = np.exp(step * (z_index + np.arange(node_count)))
            axis_scores = [
                axis_fit.scores(sigma_factors)[:, 0] for axis_fit in fits_at_ratio(ratio_index)
            ]
            return np.asarray(np.sum(axis_scores, axis=0))

        @cache
        def scores_at_nodes(ratio_index: int, z_index: int) -> Array:
            return np.array(
                [scores_at_ratio(ratio_index + node, z_index) for node in range(node_count)]
            )

        self._scores_at_nodes = scores_at_nodes

    def __call__(self, noises: Noises) -> float:
        """Return -ln p of the measurements, without a constant."""
        if noises.random_walk_m or noises.correlated_sigma_m or not self.is_interpolated:
            return negative_log_likelihood(self.axis_positions, noises, self.weight)
        z_node = log(noises.sigma_z_m) / self.step
        ratio_node = log(noises.sigma_a_m_s2) / self.step - z_node
        node_offset = (self.node_count - 1) // 2
        first_ratio_node = floor(ratio_node) - node_offset
        first_z_node = floor(z_node) - node_offset
        ratio_weights = _interpolation_weights(ratio_node - first_ratio_node, self.node_count)
        z_weights = _interpolation_weights(z_node - first_z_node, self.node_count)
        return float(
            ratio_weights @ self._scores_at_nodes(first_ratio_node, first_z_node) @ z_weights
        )


@cache
def _barycentric_signs(node_count: int) -> Array:
    nodes = np.arange(node_count)
    return np.asarray((-1.0) ** nodes * comb(node_count - 1, nodes))


def _interpolation_weights(node_position: float, node_count: int) -> Array:
    """Return the weights of the values at nodes 0, 1, ... to interpolate at ``node_position``.

    Method: barycentric interpolation, Berrut and Trefethen (2004).
    """
    node_distances = node_position - np.arange(node_count)
    if not node_distances.all():
        return np.asarray(node_distances == 0.0, dtype=np.float64)
    weights = _barycentric_signs(node_count) / node_distances
    return np.asarray(weights / weights.sum())


def fit_ratios(
    position_batches: Iterable[Positions],
    ratios: Sequence[float],
    random_walk: float,
    measurement_weights: Array,
    sigma_z_m: float,
) -> list[FittedPositions]:
    """Compute the likelihood of positions for several ratios SIGMA_A / SIGMA_Z (1/s²).

    ``position_batches`` contains the positions with different time offsets. ``random_walk`` (1/√s)
    is the random walk of the source, divided by SIGMA_Z.
    """
    scaled_batches = (
        positions.in_sigma_z_units(sigma_z_m, random_walk, measurement_weights)
        for positions in position_batches
    )
    fits_by_batch = [
        [fit_positions(scaled_positions, ratio, variance_m2) for ratio in ratios]
        for scaled_positions, variance_m2 in scaled_batches
    ]
    return [
        replace(
            batch_fits[0], gram=np.concatenate([batch_fit.gram for batch_fit in batch_fits], axis=1)
        )
        for batch_fits in zip(*fits_by_batch, strict=True)
    ]


def fit_noises(
    position_batches: Iterable[Positions], noises: Noises, measurement_weights: Array
) -> FittedPositions:
    """Compute the likelihood of positions for given noises.

    The variance of a measurement is SIGMA_Z² / weight.
    """
    sigma_z_m = noises.sigma_z_m
    if noises.correlated_sigma_m:
        position_batches = (
            replace(positions, correlated_noise=(noises.correlated_sigma_m, noises.tau_s))
            for positions in position_batches
        )
    (fitted_positions,) = fit_ratios(
        position_batches,
        [noises.sigma_a_m_s2 / sigma_z_m],
        noises.random_walk_m / sigma_z_m,
        measurement_weights,
        sigma_z_m,
    )
    return fitted_positions.scaled(sigma_z_m)


def negative_log_likelihood(
    axis_positions: Sequence[Positions], noises: Noises, measurement_weights: Array
) -> float:
    """Return -ln p of the measurements of all axes, without a constant."""
    return float(
        sum(
            fit_noises([positions], noises, measurement_weights).scores()[0, 0]
            for positions in axis_positions
        )
    )


@dataclass(frozen=True)
class NoiseFit:
    """Maximum-likelihood noises, and the outliers among the measurements.

    Attributes
    ----------
    weight : ndarray, shape (m,)
        1 for a good measurement, 1/width² for an outlier.
    outlier_probability : ndarray, shape (m,)
    score : Likelihood
        -ln p as a function of the noises.
    sigma_z_variance_factor : float
        Factor (at least 1) by which unknown outliers increase the variance of ln SIGMA_Z.
    outlier_share, outlier_width : float
        Fraction of outliers, and ratio of their σ to SIGMA_Z.
    """

    noises: Noises
    weight: Array
    outlier_probability: Array
    score: Likelihood
    sigma_z_variance_factor: float
    outlier_share: float
    outlier_width: float

    def compute_score(self) -> float:
        """Return -ln p at the maximum-likelihood noises."""
        return self.score(self.noises)


def filter_positions(kf_input: Preintegrated) -> Positions:
    """Convert KF's measurements and integrated acceleration to Positions with one segment.

    The unknown constants of the segment are the errors of the initial position and velocity.
    """
    measurement_count = len(kf_input.measurement_m)
    prior_precision = np.zeros((measurement_count + 1, 2))
    prior_precision[0] = KNOWN_START_PRECISION
    measured_m = np.append(np.nan, kf_input.measurement_m - kf_input.initial.position_m)[:, None]
    dp, dv = np.zeros((2, 1, 1, 3, measurement_count))
    dp[0, 0, 0] = kf_input.delta_position_m
    dv[0, 0, 0] = kf_input.delta_velocity_m_s
    # An error of the initial position or velocity changes only the first interval
    dp[0, 0, 1:, 0] = (1.0, kf_input.length_s[0])
    dv[0, 0, 2, 0] = 1.0
    return centre_on_path(
        Positions(
            measurement_m=measured_m,
            segment_starts=np.array([0]),
            length_s=kf_input.length_s,
            unit_process_noise=kf_input.unit_process_noise.T,
            added_process_noise=kf_input.added_process_noise.T,
            prior_precision=prior_precision,
            constants_prior_sigma=np.sqrt([INITIAL_COVARIANCE[0], INITIAL_COVARIANCE[2]]),
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )
    )


def maximise_likelihood(
    axis_positions: Sequence[Positions],
    start_noises: Noises,
    weight: Array,
    fits_outliers: bool = True,
) -> NoiseFit:
    """Estimate the noises and the outliers by maximum likelihood.

    The initial values for a long flight are estimated from its first measurements, to reduce
    computing time.

    Parameters
    ----------
    axis_positions : sequence of Positions
        Positions along each axis, at equal times.
    start_noises : Noises
        Initial values. A random walk or time-correlated noise of zero stays zero.
    weight : ndarray, shape (m,)
        Initial weight of each measurement.
    fits_outliers : bool
        True to estimate the outliers; False to keep the weights.
    """
    outlier_probability = np.zeros_like(weight)
    outlier_share, outlier_width = START_OUTLIER_FRACTION, START_OUTLIER_WIDTH
    is_long = len(weight) > 2 * FIRST_MEASUREMENTS
    if is_long:
        first_positions = [
            positions.first(len(positions.measurement_m) - len(weight) + FIRST_MEASUREMENTS)
            for positions in axis_positions
        ]
        first_fit = maximise_likelihood(
            first_positions, start_noises, weight[:FIRST_MEASUREMENTS], fits_outliers
        )
        start_noises = first_fit.noises
        outlier_share, outlier_width = first_fit.outlier_share, first_fit.outlier_width
    noises = start_noises
    for iteration in range(MAX_OUTLIER_ITERATIONS if fits_outliers else 0):
        likelihood = Likelihood(axis_positions, weight, start_noises.sigma_z_m, is_coarse=True)
        noises = _maximise_by_gradient(
            likelihood, noises, MAX_COARSE_ITERATIONS if iteration else MAX_FINAL_ITERATIONS
        )
        expected_squared_errors_m2, axis_counts = _expected_squared_errors(
            axis_positions, noises, weight
        )
        # Outliers increase the estimated SIGMA_Z and would hide themselves. They hardly change the
        # median of the squared errors
        median_square_m2 = float(
            np.median(expected_squared_errors_m2 / axis_counts)
            / (chdtri(axis_counts[0], 0.5) / axis_counts[0])
        )
        # If the median error is above the search range of SIGMA_Z, large errors are no outliers
        if median_square_m2 > SIGMA_Z_SEARCH_M[1] ** 2:
            break
        sigma_z_variance_m2 = min(noises.sigma_z_m**2, MAX_SIGMA_Z_RATIO**2 * median_square_m2)
        normalised_squares = expected_squared_errors_m2 / sigma_z_variance_m2
        previous_probability = outlier_probability
        for _ in range(MAX_OUTLIER_ITERATIONS if is_long else 1):
            outlier_probability = _outlier_probability(
                normalised_squares, axis_counts, outlier_share, outlier_width
            )
            outlier_share = float(
                np.clip(outlier_probability.mean(), 0.5 / len(weight), MAX_OUTLIER_FRACTION)
            )
            outlier_square = np.sum(outlier_probability * normalised_squares) / max(
                np.sum(outlier_probability * axis_counts), 1e-9
            )
            outlier_width = max(MIN_OUTLIER_WIDTH, float(np.sqrt(outlier_square)))
        if (
            outlier_probability.sum() < 1.0
            and outlier_probability.max() < 0.5
            and not previous_probability.any()
        ):
            outlier_probability = previous_probability
            break
        weight = 1.0 - outlier_probability * (1.0 - outlier_width**-2.0)
        if np.abs(outlier_probability - previous_probability).max() < MAX_PROBABILITY_CHANGE:
            break
        noises = replace(noises, sigma_z_m=float(np.sqrt(sigma_z_variance_m2)))
    likelihood = Likelihood(axis_positions, weight, start_noises.sigma_z_m, is_coarse=is_long)
    noises = _maximise_by_gradient(likelihood, noises)
    sigma_z_variance_factor = 1.0
    if outlier_probability.any():
        expected_squared_errors_m2, axis_counts = _expected_squared_errors(
            axis_positions, noises, weight
        )
        sigma_z_variance_factor = outlier_variance_factor(
            expected_squared_errors_m2 / noises.sigma_z_m**2,
            axis_counts,
            outlier_probability,
            outlier_width,
        )
    return NoiseFit(
        noises,
        weight,
        outlier_probability,
        likelihood,
        sigma_z_variance_factor,
        outlier_share,
        outlier_width,
    )


def outlier_probability(axis_positions: Sequence[Positions], fit: NoiseFit, count: int) -> Array:
    """Return the probability that each of ``count`` measurements is an outlier.

    Noises and outlier fraction are those of ``fit``.
    """
    probability = np.zeros(count)
    for _ in range(MAX_COARSE_ITERATIONS):
        weight = 1.0 - probability * (1.0 - fit.outlier_width**-2.0)
        squares_m2, axis_counts = _expected_squared_errors(axis_positions, fit.noises, weight)
        probability = _outlier_probability(
            squares_m2 / fit.noises.sigma_z_m**2, axis_counts, fit.outlier_share, fit.outlier_width
        )
    return probability


def _expected_squared_errors(
    axis_positions: Sequence[Positions], noises: Noises, measurement_weights: Array
) -> tuple[Array, Array]:
    """Return for each measurement the expected squared error (m²) and the number of its axes."""
    squares_and_counts = []
    for positions in axis_positions:
        constants = fit_noises([positions], noises, measurement_weights).constants()[:, 0]
        scaled_positions, scaled_variance = positions.in_sigma_z_units(
            1.0, noises.random_walk_m, measurement_weights / noises.sigma_z_m**2
        )
        squares_and_counts.append(
            expected_squared_errors(
                scaled_positions, noises.sigma_a_m_s2, scaled_variance, constants
            )
        )
    squares_m2, axis_counts = np.sum(squares_and_counts, axis=0)[:, -len(measurement_weights) :]
    return squares_m2, axis_counts


def _outlier_probability(
    normalised_squares: Array, axis_counts: Array, outlier_share: float, outlier_width: float
) -> Array:
    log_odds = np.log(outlier_share / (1.0 - outlier_share)) - axis_counts * np.log(outlier_width)
    return np.asarray(expit(log_odds + 0.5 * normalised_squares * (1.0 - outlier_width**-2.0)))


def outlier_variance_factor(
    normalised_squares: Array, axis_counts: Array, outlier_probability: Array, outlier_width: float
) -> float:
    """Return the factor by which unknown outliers increase the variance of ln SIGMA_Z.

    Observed information = complete information - missing information (Louis 1982), for the
    parameters ln σ, ln width and the log odds of an outlier. ``normalised_squares`` is the squared
    error of each measurement / σ², summed over its ``axis_counts`` axes.
    """
    outlier_share = np.mean(outlier_probability)
    sigma_information = 2.0 * float(np.sum(axis_counts))
    inverse_square_width = outlier_width**-2.0
    complete_information = np.zeros((3, 3))
    complete_information[:2, :2] = 2.0 * np.sum(axis_counts * outlier_probability)
    complete_information[0, 0] = sigma_information
    complete_information[2, 2] = len(normalised_squares) * outlier_share * (1.0 - outlier_share)
    scores = np.stack(
        [
            normalised_squares * (inverse_square_width - 1.0),
            normalised_squares * inverse_square_width - axis_counts,
            np.ones_like(normalised_squares),
        ]
    )
    missing_information = (scores * (outlier_probability * (1.0 - outlier_probability))) @ scores.T
    observed_information = complete_information - missing_information
    # With hardly any outliers, the information matrix is singular, and their effect is negligible
    if np.linalg.eigvalsh(observed_information)[0] <= 0.0:
        return 1.0
    return max(1.0, sigma_information * float(np.linalg.inv(observed_information)[0, 0]))


def _maximise_by_gradient(
    likelihood: Likelihood, start_noises: Noises, max_steps: int = MAX_FINAL_ITERATIONS
) -> Noises:
    nonzero_noises = {name: value for name, value in vars(start_noises).items() if value}
    log_bounds = np.log([SEARCH_RANGES[name] for name in nonzero_noises])
    measurement_count = len(likelihood.weight)

    def score_per_measurement(log_noises: Array) -> float:
        # The division makes gradient and first step about 1
        try:
            return likelihood(to_noises(log_noises)) / measurement_count
        # If rounding errors dominate, a large value makes L-BFGS-B shorten its step
        except np.linalg.LinAlgError:
            return UNCOMPUTABLE_SCORE

    def to_noises(log_noises: Array) -> Noises:
        return Noises(**dict(zip(nonzero_noises, np.exp(log_noises).tolist(), strict=True)))

    minimum = minimize(
        score_per_measurement,
        np.clip(np.log([*nonzero_noises.values()]), *log_bounds.T),
        method="L-BFGS-B",
        bounds=log_bounds.tolist(),
        options={"eps": DERIVATIVE_LOG_STEP, "ftol": 1e-10, "gtol": 1e-8, "maxiter": max_steps},
    )
    return to_noises(minimum.x)
