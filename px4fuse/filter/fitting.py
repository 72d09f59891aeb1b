"""Most likely noises of positions: SIGMA_A, SIGMA_Z, and which measurements are outliers.

The innovations of a filter with the right noises are white and as large as it says, and these
noises make them most likely (Schweppe 1965). A share of the measurements may come from a normal
distribution many times as wide (Tukey 1960): how many, how wide and which is found by expectation
and maximisation, one decision for all axes of a sample, with what *all* data say of its error.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import floor, log

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, comb, expit

from px4fuse.arrays import Array
from px4fuse.filter.likelihood import Preintegrated
from px4fuse.filter.marginal import (
    FittedPositions,
    Positions,
    centre_on_path,
    expected_squares,
    fit_positions,
)
from px4fuse.filter.model import INITIAL_COVARIANCE

SIGMA_A_SEARCH_M_S2 = (1e-3, 30.0)
# From what no positioning system resolves
SIGMA_Z_SEARCH_M = (1e-3, 10.0)
WALK_SEARCH_M = (1e-4, 1.0)
SLOW_SEARCH_M, SLOW_SEARCH_S = (1e-3, 10.0), (0.05, 60.0)
MAX_PASSES = 12
# Of the maximisation, in the end and while the outliers still change
MAX_STEPS, ROUGH_MAX_STEPS = 50, 3
# Outliers are at least this many times as wide as the rest: less is not told from it
MIN_WIDTH = 3.0
FIRST_SHARE, FIRST_WIDTH, MAX_SHARE = 0.005, 10.0, 0.4
# SIGMA_Z is at most this many times what the median of the squares says
MAX_SIGMA_RATIO = 1.2
MAX_PROBABILITY_CHANGE = 0.01
# -ln p of each measurement where it cannot be computed; any that can be is far below
UNCOMPUTABLE_SCORE = 1e6
# Step of ln σ for slopes
SLOPE_STEP = 1e-4
# Nodes about each place, and their distance in ln σ; while the outliers still change, few
NODES, ROUGH_NODES = (10, 0.25), (6, 0.2)
# Precision of a start that is known (1/m² and s²/m²): to a micrometre
KNOWN_START_PRECISION = 1e12


@dataclass(frozen=True)
class Noises:
    """What is random.

    Attributes
    ----------
    sigma_a_m_s2, sigma_z_m : float
        Of the acceleration, as the filter's, and of each measurement.
    walk_m : float
        Random walk of the source itself, m per square root of a second; 0 for one that does not
        drift.
    slow_m, tau_s : float
        Standard deviation and time constant of a slow error of the source; 0 for none.
    """

    sigma_a_m_s2: float
    sigma_z_m: float
    walk_m: float = 0.0
    slow_m: float = 0.0
    tau_s: float = 0.0


SEARCHES = {
    "sigma_a_m_s2": SIGMA_A_SEARCH_M_S2,
    "sigma_z_m": SIGMA_Z_SEARCH_M,
    "walk_m": WALK_SEARCH_M,
    "slow_m": SLOW_SEARCH_M,
    "tau_s": SLOW_SEARCH_S,
}


class Likelihood:
    """-ln p of the measurements but for a constant, over the noises.

    Where nothing but the noises of acceleration and measurements is random, all but a scale depends
    on their ratio alone, smoothly: it is evaluated at nodes of ln(SIGMA_A/SIGMA_Z) and ln SIGMA_Z,
    when they are first needed, and polynomials give what is between. Singularities of the
    likelihood lie π/2 off the real axis, so that these are as good as rounding.

    Parameters
    ----------
    axis_positions : sequence of Positions
        With one choice of the legs.
    weight : ndarray, shape (m,)
    sigma_z_m : float
        About what it will be: what is as good as known or unknown at a start scales with it.
    rough : bool
        Whether the maximum only needs to be near.
    """

    def __init__(
        self,
        axis_positions: Sequence[Positions],
        weight: Array,
        sigma_z_m: float,
        rough: bool = False,
    ) -> None:
        self.axis_positions, self.weight, self.sigma_z_m = axis_positions, weight, sigma_z_m
        self.tabulated = not any(positions.noise_fixed.any() for positions in axis_positions)
        self.nodes, self.step = nodes, step = ROUGH_NODES if rough else NODES

        @cache
        def fits(ratio_index: int) -> list[FittedPositions]:
            ratio = float(np.exp(step * ratio_index))
            return [
                fit_ratios([positions], [ratio], 0.0, weight, sigma_z_m)[0]
                for positions in axis_positions
            ]

        @cache
        def row(ratio_index: int, z_index: int) -> Array:
            scales = np.exp(step * (z_index + np.arange(nodes)))
            totals = [fitted_part.totals(scales)[:, 0] for fitted_part in fits(ratio_index)]
            return np.asarray(np.sum(totals, axis=0))

        @cache
        def values(ratio_index: int, z_index: int) -> Array:
            """At the nodes about one place, from the first ones on."""
            return np.array([row(ratio_index + node, z_index) for node in range(nodes)])

        self._values = values

    def __call__(self, noises: Noises) -> float:
        """-ln p with some noises."""
        if noises.walk_m or noises.slow_m or not self.tabulated:
            return negative_log_likelihood(self.axis_positions, noises, self.weight)
        ln_z = log(noises.sigma_z_m) / self.step
        ln_ratio = log(noises.sigma_a_m_s2) / self.step - ln_z
        node_offset = (self.nodes - 1) // 2
        first, first_z = floor(ln_ratio) - node_offset, floor(ln_z) - node_offset
        ratio_weights = _interpolation_weights(ln_ratio - first, self.nodes)
        z_weights = _interpolation_weights(ln_z - first_z, self.nodes)
        return float(ratio_weights @ self._values(first, first_z) @ z_weights)


@cache
def _barycentric_signs(count: int) -> Array:
    nodes = np.arange(count)
    return np.asarray((-1.0) ** nodes * comb(count - 1, nodes))


def _interpolation_weights(position: float, count: int) -> Array:
    """Weights of values at 0, 1, ... for the polynomial through them (Berrut, Trefethen 2004)."""
    distances = position - np.arange(count)
    if not distances.all():
        return np.asarray(distances == 0.0, dtype=np.float64)
    weights = _barycentric_signs(count) / distances
    return np.asarray(weights / weights.sum())


def fit_ratios(
    blocks: Iterable[Positions],
    ratios: Sequence[float],
    walk: float,
    weight: Array,
    sigma_z_m: float,
) -> list[FittedPositions]:
    """Fit with noises over SIGMA_Z; what is fixed is taken at a SIGMA_Z.

    Parameters
    ----------
    blocks : iterable of Positions
        The same ones at other clock offsets.
    ratios : sequence of float
        SIGMA_A / SIGMA_Z, 1/s².
    walk : float
        Walk of the source over SIGMA_Z.
    weight : ndarray, shape (m,)
    sigma_z_m : float
    """
    scaled_blocks = (positions.over(sigma_z_m, walk, weight) for positions in blocks)
    fits_by_block = [
        [fit_positions(scaled_block, ratio, variance_m2) for ratio in ratios]
        for scaled_block, variance_m2 in scaled_blocks
    ]
    return [
        replace(
            block_fits[0], gram=np.concatenate([block_fit.gram for block_fit in block_fits], axis=1)
        )
        for block_fits in zip(*fits_by_block, strict=True)
    ]


def fit_noises(blocks: Iterable[Positions], noises: Noises, weight: Array) -> FittedPositions:
    """Fit with some noises and weights."""
    sigma = noises.sigma_z_m
    ratio, walk = noises.sigma_a_m_s2 / sigma, noises.walk_m / sigma
    if noises.slow_m:
        blocks = (replace(positions, slow=(noises.slow_m, noises.tau_s)) for positions in blocks)
    return fit_ratios(blocks, [ratio], walk, weight, sigma)[0].scaled(sigma)


def negative_log_likelihood(
    axis_positions: Sequence[Positions], noises: Noises, weight: Array
) -> float:
    """-ln p of the measurements of all parts but for a constant."""
    return float(
        sum(fit_noises([positions], noises, weight).totals()[0, 0] for positions in axis_positions)
    )


@dataclass(frozen=True)
class NoiseFit:
    """Noises of greatest likelihood.

    Attributes
    ----------
    noises : Noises
    weight : ndarray, shape (m,)
        What each measurement counts: 1 for a good one, 1/width² for an outlier.
    outlier_probability : ndarray, shape (m,)
        Probability that it is one.
    score : Likelihood
        With these weights.
    widening : float
        How much larger the variance of ln SIGMA_Z is than the score's bend says, since outliers,
        their share and their width are themselves found.
    """

    noises: Noises
    weight: Array
    outlier_probability: Array
    score: Likelihood
    widening: float


def filter_positions(intervals: Preintegrated) -> Positions:
    """The lesson's filter of one axis: its constants are the errors of its start, with P₀."""
    count = len(intervals.measurement_m)
    initial = np.zeros((count + 1, 2))
    initial[0] = KNOWN_START_PRECISION
    measured = np.concatenate([[np.nan], intervals.measurement_m - intervals.initial.position_m])[
        :, None
    ]
    dp, dv = np.zeros((2, 1, 1, 3, count))
    dp[0, 0, 0], dv[0, 0, 0] = intervals.delta_position_m, intervals.delta_velocity_m_s
    # an error of the start moves the first leg
    dp[0, 0, 1:, 0], dv[0, 0, 2, 0] = (1.0, intervals.length_s[0]), 1.0
    return centre_on_path(
        Positions(
            measurement_m=measured,
            start=np.array([0]),
            length_s=intervals.length_s,
            noise_unit=intervals.noise_unit.T,
            noise_fixed=intervals.noise_fixed.T,
            initial=initial,
            constant_sigma=np.sqrt([INITIAL_COVARIANCE[0], INITIAL_COVARIANCE[2]]),
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )
    )


def maximise_likelihood(
    axis_positions: Sequence[Positions], start: Noises, weight: Array, outliers: bool = True
) -> NoiseFit:
    """Fit the noises, and find the outliers.

    Parameters
    ----------
    axis_positions : sequence of Positions
        With the same measurements.
    start : Noises
        To start with. A walk and a slow error are fitted where they are not zero.
    weight : ndarray, shape (m,)
        Of each measurement to start with.
    outliers : bool
        Whether they are sought; else the weights stay.
    """
    outlier_probability = np.zeros_like(weight)
    share, width, noises = FIRST_SHARE, FIRST_WIDTH, start
    for pass_index in range(MAX_PASSES if outliers else 0):
        likelihood = Likelihood(axis_positions, weight, start.sigma_z_m, rough=True)
        noises = _maximise(likelihood, noises, ROUGH_MAX_STEPS if pass_index else MAX_STEPS)
        square, count = _squares(axis_positions, noises, weight)
        # outliers raise the noise that hides them: the median does not follow them
        median_square = float(np.median(square / count) / (chdtri(count[0], 0.5) / count[0]))
        if median_square > SIGMA_Z_SEARCH_M[1] ** 2:  # noise beyond the search is not outliers
            break
        variance = min(noises.sigma_z_m**2, MAX_SIGMA_RATIO**2 * median_square)
        probability = _outlier_probability(square / variance, count, share, width)
        if probability.sum() < 1.0 and probability.max() < 0.5 and not outlier_probability.any():
            break
        share = float(np.clip(probability.mean(), 0.5 / len(probability), MAX_SHARE))
        square_width = (
            float(np.sum(probability * square) / max(np.sum(probability * count), 1e-9)) / variance
        )
        width = max(MIN_WIDTH, float(np.sqrt(square_width)))
        weight = 1.0 - probability * (1.0 - width**-2.0)
        is_settled = bool(
            np.max(np.abs(probability - outlier_probability)) < MAX_PROBABILITY_CHANGE
        )
        outlier_probability = probability
        if is_settled:
            break
        noises = replace(noises, sigma_z_m=float(np.sqrt(variance)))
    likelihood = Likelihood(axis_positions, weight, start.sigma_z_m)
    noises = _maximise(likelihood, noises)
    widening = 1.0
    if outlier_probability.any():
        square, count = _squares(axis_positions, noises, weight)
        widening = outlier_variance_factor(
            square / noises.sigma_z_m**2, count, outlier_probability, width
        )
    return NoiseFit(noises, weight, outlier_probability, likelihood, widening)


def _squares(
    axis_positions: Sequence[Positions], noises: Noises, weight: Array
) -> tuple[Array, Array]:
    """:func:`expected_squares` of all parts together, at the most likely constants."""
    results = []
    for positions in axis_positions:
        constants = fit_noises([positions], noises, weight).constants()[:, 0]
        scaled_positions, variance = positions.over(
            1.0, noises.walk_m, weight / noises.sigma_z_m**2
        )
        results.append(expected_squares(scaled_positions, noises.sigma_a_m_s2, variance, constants))
    square, count = np.sum(results, axis=0)[:, -len(weight) :]
    return square, count


def _outlier_probability(square: Array, count: Array, share: float, width: float) -> Array:
    log_odds = np.log(share / (1.0 - share)) - count * np.log(width)
    return np.asarray(expit(log_odds + 0.5 * square * (1.0 - width**-2.0)))


def outlier_variance_factor(
    square: Array, count: Array, outlier_probability: Array, width: float
) -> float:
    """Variance of ln σ over that with known outliers, at the maximum of the likelihood.

    The information of the data is that of the complete data, in which each measurement is known to
    be an outlier or not, less what is missing: the covariance of the score over what it may be
    (Louis 1982). Parameters are ln σ, ln width and the log odds of the share.

    Parameters
    ----------
    square : ndarray, shape (m,)
        Of each measurement's error over σ², summed over its axes.
    count : ndarray, shape (m,)
        Axes.
    outlier_probability : ndarray, shape (m,)
        Probability that it is one.
    width : float
        Outliers' σ over σ.
    """
    share = float(np.mean(outlier_probability))
    sigma_information, outlier_information = (
        2.0 * float(np.sum(count)),
        2.0 * float(np.sum(count * outlier_probability)),
    )
    share_information, inverse_square_width = len(square) * share * (1.0 - share), width**-2.0
    complete_information = np.array(
        [
            [sigma_information, outlier_information, 0.0],
            [outlier_information, outlier_information, 0.0],
            [0.0, 0.0, share_information],
        ]
    )
    scores = np.stack(
        [
            square * (inverse_square_width - 1.0),
            square * inverse_square_width - count,
            np.ones_like(square),
        ]
    )
    missing_information = (scores * (outlier_probability * (1.0 - outlier_probability))) @ scores.T
    observed_information = complete_information - missing_information
    if (
        np.linalg.eigvalsh(observed_information)[0] <= 0.0
    ):  # hardly any outlier: what they are adds nothing
        return 1.0
    return max(1.0, sigma_information * float(np.linalg.inv(observed_information)[0, 0]))


def _maximise(likelihood: Likelihood, start: Noises, max_steps: int = MAX_STEPS) -> Noises:
    values = {name: value for name, value in vars(start).items() if value}
    bounds = np.log([SEARCHES[name] for name in values])
    count = len(likelihood.weight)

    def score(logs: Array) -> float:
        # of each measurement: the first step is as long as the slope, at most 1
        try:
            return likelihood(to_noises(logs)) / count
        except np.linalg.LinAlgError:  # so far from the data that rounding is all: the step is cut
            return UNCOMPUTABLE_SCORE

    def to_noises(logs: Array) -> Noises:
        return Noises(**dict(zip(values, np.exp(logs).tolist(), strict=True)))

    result = minimize(
        score,
        np.clip(np.log([*values.values()]), *bounds.T),
        method="L-BFGS-B",
        bounds=bounds.tolist(),
        options={"eps": SLOPE_STEP, "ftol": 1e-10, "gtol": 1e-8, "maxiter": max_steps},
    )
    return to_noises(result.x)
