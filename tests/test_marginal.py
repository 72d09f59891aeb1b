"""The banded likelihood and the noise estimates against dense linear algebra."""

from typing import Any

import numpy as np
import pytest
from exchange import replace
from filter_tools import TRUE, modelled, score_grid
from flights import line, random_walk
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.differentiate import hessian
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import norm

from px4fuse.core.arrays import Array, IntArray
from px4fuse.filter.fitting import (
    INITIAL_OUTLIERS,
    NegativeLogLikelihood,
    NoiseFit,
    NoiseParameters,
    OutlierDistribution,
    add_noises,
    compute_variance_factor_of_ln_sigma_z,
    convert_to_positions_and_increments,
    fit_constant_errors,
    maximise_likelihood,
    negative_log_likelihood,
)
from px4fuse.filter.likelihood import (
    MAX_LOG_LIKELIHOOD_DROP,
    find_profile_likelihood_interval,
    innovations,
    preintegrate,
)
from px4fuse.filter.marginal_likelihood import (
    PositionsAndIncrements,
    estimate_squared_errors,
    factorise,
    fit_positions,
    subtract_smooth_path,
)
from px4fuse.filter.model import compute_continuous_unit_density_process_noise
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis


def matrices(elements: Array) -> Array:
    """Return Q of each interval from its elements 00, 01, 11."""
    q00, q01, q11 = elements
    return np.moveaxis([[q00, q01], [q01, q11]], -1, 0)


# --- the factorisation ---


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_banded_solver_equals_dense_normal_equations(seed: int) -> None:
    """Two stretches and one unmeasured state, compared with lstsq, slogdet and inv."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 14))
    second = int(rng.integers(3, count - 2))
    joined = np.arange(1, count) != second
    length = rng.uniform(0.05, 0.6, count - 1)
    noise = rng.uniform(0.001, 0.4) * np.stack(
        compute_continuous_unit_density_process_noise(length)
    )
    noise[[0, 2]] += rng.choice([0.0, 0.003], count - 1)
    precision = np.stack([rng.uniform(1.0, 100.0, count), np.zeros(count)], 1)
    precision[[0, second], 1] = 0.5, 2.0
    precision[rng.integers(1, count), 0] = 0.0
    widths = count, count - 1, count - 1
    signals = measured, dp, dv = [rng.normal(size=(3, width)) for width in widths]
    # rows of the prior and the measurements, divided by their σ
    rows = np.diag(np.sqrt(precision.ravel()))
    known = np.zeros((2 * count, 3))
    known[0::2] = np.sqrt(precision[:, :1]) * measured.T
    log_determinant = -np.log(precision[precision > 0.0]).sum()
    for leg in np.flatnonzero(joined):
        q = matrices(noise)[leg]
        white = np.linalg.inv(np.linalg.cholesky(q))
        row = np.zeros((2, 2 * count))
        row[:, 2 * leg : 2 * leg + 2] = -np.array([[1.0, length[leg]], [0.0, 1.0]])
        row[:, 2 * leg + 2 : 2 * leg + 4] = np.eye(2)
        rows = np.vstack([rows, white @ row])
        known = np.vstack([known, white @ [dp[:, leg], dv[:, leg]]])
        log_determinant += np.linalg.slogdet(q)[1]
    expected = np.linalg.lstsq(rows, known, rcond=None)[0]
    left, normal = known - rows @ expected, rows.T @ rows

    system = factorise(length, noise, joined, precision)
    state = system.solve(*signals).reshape(3, 2 * count)
    np.testing.assert_allclose(state.T, expected, rtol=1e-6, atol=1e-6)
    weighted = system.weight_increments(dp, dv)
    explained = system.whiten_explained_part(measured, *weighted)
    products = precision[:, 0] * measured @ measured.T + dp @ weighted[0].T + dv @ weighted[1].T
    products -= explained @ explained.T
    np.testing.assert_allclose(products, left.T @ left, rtol=1e-6, atol=1e-6)
    log_determinant += np.linalg.slogdet(normal)[1]
    assert system.log_determinant == pytest.approx(log_determinant, abs=1e-6)
    variance = np.diag(np.linalg.inv(normal))[0::2]
    np.testing.assert_allclose(system.position_variance(), variance, rtol=1e-6)


def test_log_determinant_of_s_grows_with_large_process_noise() -> None:
    """Q of a single step has rank one, so the term that makes it invertible is below rounding."""
    step, joined = np.full(19, 0.09755900000000004), np.ones(19, dtype=bool)
    unit = 0.1 * step * np.stack([step**2 / 4.0, step / 2.0, np.ones(19)])
    precision = np.stack([np.ones(20), np.zeros(20)], 1)
    values = [
        factorise(step, sigma_a**2 * unit, joined, precision).log_determinant
        for sigma_a in np.geomspace(1e4, 1e6, 100)
    ]
    # ln|S| grows with the noise
    assert np.all(np.diff(values) > 0.0)
    precision[4:, 0] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        factorise(step, unit, np.arange(1, 20) != 3, precision)


# --- the likelihood with constants ---

START, COUNT = np.array([0, 11]), 24
WEAK = np.array([1e-6, 1e-4])  # prior precision of position and velocity
WEIGHT = np.random.default_rng(2).uniform(0.1, 1.0, COUNT)
SOME_NOISES = [
    NoiseParameters(0.5, 0.1), NoiseParameters(0.05, 0.1), NoiseParameters(2.0, 0.1),
    NoiseParameters(0.5, 0.02), NoiseParameters(0.5, 4.0), NoiseParameters(0.5, 0.1, 0.3),
    NoiseParameters(0.5, 0.1, 0.0, 0.3, 0.7), NoiseParameters(0.5, 0.1, 0.3, 0.05, 3.0),
]  # fmt: skip


def with_constants(offsets: int = 3) -> PositionsAndIncrements:
    """Two stretches of three axes with three constants.

    The first two axes lack some measurements, the second its first one; the third has one only in
    its second stretch.
    """
    rng = np.random.default_rng(5)
    length = rng.uniform(0.05, 0.6, COUNT - 1)
    measured = rng.normal(0.0, 1.0, (COUNT, 3))
    measured[START] = 0.0
    measured[[4, 17], 0] = measured[[0, 7], 1] = measured[11:, 2] = np.nan
    measured[15, 2] = -500.0
    initial = np.zeros((COUNT, 2))
    initial[START] = WEAK
    return PositionsAndIncrements(
        measurement_m=measured, segment_start_indices=START, interval_s=length,
        process_noise_per_sigma_a_squared=0.1
        * np.stack(compute_continuous_unit_density_process_noise(length)),
        process_noise_independent_of_sigma_a=np.outer(
            [0.3, 0.0, 0.2], rng.choice([0.0, 0.01], COUNT - 1)
        ),
        prior_precision=initial, prior_sigmas_of_constant_errors=np.array([0.3, 1.0, 0.1]),
        delta_position_m=rng.normal(0.0, 0.3, (3, offsets, 4, COUNT - 1)),
        delta_velocity_m_s=rng.normal(0.0, 0.3, (3, offsets, 4, COUNT - 1)),
    )  # fmt: skip


def arguments(
    positions: PositionsAndIncrements, noises: NoiseParameters, weight: Array
) -> tuple[Any, float, Array]:
    """Return the arguments of :func:`fit_positions`."""
    noisy, variance = add_noises(positions, noises, weight)
    return noisy, noises.sigma_a_m_s2, variance


def stretch_normal(
    part: PositionsAndIncrements,
    noises: NoiseParameters,
    variance: Array,
    stretch: int,
    axis: int,
    at: int = 0,
) -> tuple[IntArray, Array, Array]:
    """Return measured rows, their signals (data minus mean, constants) and their covariance."""
    q = matrices(
        noises.sigma_a_m_s2**2 * part.process_noise_per_sigma_a_squared
        + part.process_noise_independent_of_sigma_a
    )
    rows = list(range(*(*START, COUNT)[stretch : stretch + 2]))
    # position and velocity for the signals of data and constants
    means = [np.zeros((2, 4))]
    cross = {(0, 0): np.diag(1.0 / WEAK)}  # covariance of each state with all earlier ones
    for k, row in enumerate(rows[1:], start=1):
        length = part.interval_s[row - 1]
        f = np.array([[1.0, length], [0.0, 1.0]])
        legs = part.delta_position_m, part.delta_velocity_m_s
        means.append(f @ means[-1] + [each[axis, at, :, row - 1] for each in legs])
        for j in range(k):
            cross[k, j] = f @ cross[k - 1, j]
            cross[j, k] = cross[k, j].T
        walk = np.diag([noises.random_walk_m**2 * length, 0.0])
        cross[k, k] = f @ cross[k - 1, k - 1] @ f.T + q[row - 1] + walk
    used = [k for k, row in enumerate(rows) if np.isfinite(part.measurement_m[row, axis])]
    used = used if len(used) > 1 else []
    kept = np.array([rows[k] for k in used], dtype=int)
    signals = np.array([-means[k][0] for k in used]).reshape(-1, 4)
    signals[:, 0] += part.measurement_m[kept, axis]
    covariance = np.array([cross[k, j][0, 0] for k in used for j in used])
    if noises.correlated_sigma_m:
        time = np.concatenate([[0.0], np.cumsum(part.interval_s)])[kept]
        correlated_noise = noises.correlated_sigma_m**2 * np.exp(
            -np.abs(time[:, None] - time) / noises.tau_s
        )
        covariance = covariance + correlated_noise.ravel()
    return kept, signals, covariance.reshape(len(used), len(used)) + np.diag(variance[kept])


def joint_normal(
    part: PositionsAndIncrements,
    noises: NoiseParameters,
    variance: Array,
    stretch: int,
    at: int = 0,
) -> tuple[Array, Array, list[tuple[IntArray, Array, Array]]]:
    """Return data and covariance (with constants) of all axes, and each axis separately."""
    made = [stretch_normal(part, noises, variance, stretch, axis, at) for axis in range(3)]
    signals = np.concatenate([each[1] for each in made])
    covariance = signals[:, 1:] * part.prior_sigmas_of_constant_errors**2 @ signals[:, 1:].T
    return signals[:, 0], covariance + block_diag(*(each[2] for each in made)), made


def test_likelihood_with_imu_biases_equals_multivariate_normal() -> None:
    """Equal at all offsets and noises, except for a constant."""
    part = with_constants()

    def dense(noises: NoiseParameters, at: int) -> float:
        total, variance = 0.0, noises.sigma_z_m**2 / WEIGHT
        for stretch in range(2):
            data, covariance, _ = joint_normal(part, noises, variance, stretch, at)
            total += 0.5 * data @ np.linalg.solve(covariance, data)
            total += 0.5 * np.linalg.slogdet(covariance)[1]
        return float(total)

    expected = np.array([[dense(noises, at) for at in range(3)] for noises in SOME_NOISES])
    assert np.ptp(expected) > 1000.0
    found_values = np.array(
        [
            fit_positions(*arguments(part, noises, WEIGHT)).compute_scores()[0]
            for noises in SOME_NOISES
        ]
    )
    np.testing.assert_allclose(
        found_values - found_values[0, 0], expected - expected[0, 0], rtol=1e-5, atol=1e-3
    )
    # in units of SIGMA_Z, which changes only negligible priors
    scaled = np.array(
        [fit_constant_errors([part], noises, WEIGHT).compute_scores()[0] for noises in SOME_NOISES]
    )
    np.testing.assert_allclose(
        scaled - scaled[0, 0], found_values - found_values[0, 0], rtol=1e-5, atol=1e-3
    )


@pytest.mark.parametrize("start_known", [True, False])
def test_likelihood_ignores_segment_with_a_single_position(start_known: bool) -> None:
    part = with_constants()
    if not start_known:
        part = replace(part, prior_precision=np.zeros((COUNT, 2)))
    without = part.measurement_m.copy()
    without[15, 2] = np.nan
    for noises in SOME_NOISES:
        both = part, replace(part, measurement_m=without)
        one, none = (fit_positions(*arguments(each, noises, np.ones(COUNT))) for each in both)
        np.testing.assert_allclose(one.compute_scores(), none.compute_scores(), rtol=1e-12)
        np.testing.assert_allclose(
            one.estimate_constant_errors_by_segment(),
            none.estimate_constant_errors_by_segment(),
            rtol=1e-9,
            atol=1e-12,
        )


def test_fitted_imu_biases_equal_dense_least_squares() -> None:
    part = with_constants(offsets=1)
    # without the third axis, which has too few measurements
    part = replace(part, measurement_m=part.measurement_m * [1.0, 1.0, np.nan])
    for noises in SOME_NOISES[:5]:
        variance, square = np.full(COUNT, noises.sigma_z_m**2), np.zeros(COUNT)
        arranged = arguments(part, noises, np.ones(COUNT))
        constants = fit_positions(*arranged).estimate_constant_errors_by_segment()[:, 0]
        for stretch in range(2):
            _, _, made = joint_normal(part, noises, variance, stretch)
            information, right = np.diag(part.prior_sigmas_of_constant_errors**-2.0), np.zeros(3)
            for _, signals, covariance in made[:2]:
                by = -signals[:, 1:]  # effect of a constant on the positions
                information = information + by.T @ np.linalg.solve(covariance, by)
                right += by.T @ np.linalg.solve(covariance, signals[:, 0])
            found = np.linalg.solve(information, right)
            np.testing.assert_allclose(constants[stretch], found, rtol=1e-4)
            for rows, signals, covariance in made[:2]:
                # z - E[p | z] = R C⁻¹ left, with variance R - R C⁻¹ R
                r = np.diag(variance[rows])
                error = r @ np.linalg.solve(covariance, signals @ [1.0, *found])
                square[rows] += error**2 + np.diag(r - r @ np.linalg.solve(covariance, r))
        found_values, count = estimate_squared_errors(*arranged, constants)
        np.testing.assert_allclose(found_values, square, rtol=1e-4, atol=1e-9)
        np.testing.assert_array_equal(count, np.isfinite(part.measurement_m).sum(axis=1))


def test_likelihood_is_unchanged_if_smooth_path_is_subtracted() -> None:
    part = with_constants()
    given = [arguments(each, SOME_NOISES[0], WEIGHT) for each in (part, subtract_smooth_path(part))]
    plain, found_values = (fit_positions(*each).compute_scores()[0] for each in given)
    assert np.ptp(plain) > 1.0
    np.testing.assert_allclose(found_values, plain, rtol=1e-7)
    # the signal of the scale is the path of each offset
    scaled = fit_positions(
        *arguments(subtract_smooth_path(part, estimates_scale=True), SOME_NOISES[0], WEIGHT)
    ).gram_matrix
    way, speed = part.delta_position_m[:, 1:2], part.delta_velocity_m_s[:, 1:2]
    alone = replace(part, delta_position_m=way, delta_velocity_m_s=speed)
    one = fit_positions(
        *arguments(subtract_smooth_path(alone, estimates_scale=True), SOME_NOISES[0], WEIGHT)
    ).gram_matrix
    assert np.ptp(scaled[..., -1, -1]) > 1.0
    np.testing.assert_allclose(scaled[:, [1]], one, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("which", ["filter", "constants"])
def test_likelihood_between_grid_points_equals_exact_likelihood(which: str) -> None:
    """Equal over four decades of the ratio and of SIGMA_Z, except for a constant."""
    parts = [
        convert_to_positions_and_increments(preintegrate(modelled(seed, COUNT), TRUE))
        for seed in (1, 2)
    ]
    if which == "constants":
        part = with_constants(offsets=1)
        parts = [
            replace(
                part,
                process_noise_independent_of_sigma_a=0.0
                * part.process_noise_independent_of_sigma_a,
            )
        ]
    some = np.exp(np.random.default_rng(4).uniform(-4.6, 1.0, (30, 2))).tolist()
    direct = [negative_log_likelihood(parts, NoiseParameters(*pair), WEIGHT) for pair in some]
    assert np.ptp(direct) > 100.0
    # far from the maximum the weak prior of the initial state has an effect
    score = NegativeLogLikelihood(parts, WEIGHT, 0.1)
    assert score.is_interpolated
    found_values = np.array([score(NoiseParameters(*pair)) for pair in some])
    expected = np.array(direct) - direct[0]
    np.testing.assert_allclose(found_values - found_values[0], expected, rtol=2e-3, atol=1e-3)


# --- likelihood of KF ---


def with_gap() -> Axis:
    imu = np.arange(0.0, 45.0, 0.02)
    imu = imu[(imu < 14.0) | (imu > 15.3)]
    time = 0.37 * np.arange(120)
    measured = np.sin(time) + np.random.default_rng(3).normal(0.0, 0.1, 120)
    return line(time, measured, (imu, -np.sin(imu)))


@pytest.mark.parametrize("interval", [0.1, 0.2, 0.5, None])
def test_likelihood_by_banded_matrix_equals_kf_likelihood(interval: float | None) -> None:
    """Intervals of one step (singular Q), of several steps, and with an IMU gap."""
    axis, chosen = with_gap(), Settings()
    if interval is not None:
        rng = np.random.default_rng(3)
        axis = random_walk(rng, count=300, interval_s=interval, sigma_a=0.5, sigma_z=0.1)
        chosen = Settings(input="zero")
    legs = preintegrate(axis, chosen)
    pairs = [(0.5, 0.1), (0.05, 0.1), (3.0, 0.1), (0.5, 0.01), (0.5, 1.0), (0.02, 2.0)]
    a, z = np.transpose(pairs)
    scores = [np.log(s) + nu**2 / s for nu, s in (innovations(legs, *pair) for pair in pairs)]
    expected = 0.5 * np.sum(scores, axis=1)
    weight = np.ones(len(legs.measurement_m))
    assert np.ptp(expected) > 50.0
    np.testing.assert_allclose(score_grid([legs], a, z, weight), expected, rtol=1e-9)
    part = [convert_to_positions_and_increments(legs)]
    found_values = np.array(
        [negative_log_likelihood(part, NoiseParameters(*pair), weight) for pair in pairs]
    )
    np.testing.assert_allclose(
        found_values - found_values[0], expected - expected[0], rtol=1e-6, atol=2e-3
    )
    # weights have the same meaning in both
    weight = np.random.default_rng(1).uniform(0.01, 1.0, len(weight))
    grid = score_grid([legs], a, z, weight)
    found_values = np.array(
        [negative_log_likelihood(part, NoiseParameters(*pair), weight) for pair in pairs]
    )
    np.testing.assert_allclose(found_values - found_values[0], grid - grid[0], rtol=2e-3, atol=0.02)


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.8, -3.0])
def test_profile_likelihood_interval_of_parabola_is_1_96_sigma(slope: float) -> None:
    """With the other parameter maximised out, σ is the marginal one."""
    sigma, other_sigma = 0.2, 0.05

    def score(at: float, other: float) -> float:
        along, across = (at - 1.0) / sigma, (other - 2.0 - slope * (at - 1.0)) / other_sigma
        return 0.5 * along**2 + 0.5 * across**2

    reach = sigma * np.sqrt(2.0 * MAX_LOG_LIKELIHOOD_DROP)
    ends = np.log(find_profile_likelihood_interval(score, (1.0, 2.0), (np.exp(-4.0), np.exp(6.0))))
    assert ends == pytest.approx((1.0 - reach, 1.0 + reach), abs=0.01 * reach)
    bounds = np.exp(1.0 - 0.5 * reach), np.exp(1.0 + 0.5 * reach)
    assert find_profile_likelihood_interval(score, (1.0, 2.0), bounds) == (None, None)
    wide = np.log(
        find_profile_likelihood_interval(score, (1.0, 2.0), (np.exp(-4.0), np.exp(6.0)), 4.0)
    )
    assert wide == pytest.approx((1.0 - 2.0 * reach, 1.0 + 2.0 * reach), abs=0.02 * reach)


# --- outliers by expectation and maximisation ---

SEEDS, MANY = range(3), 400


def pair(seed: int) -> tuple[Axis, Axis]:
    return modelled(seed, MANY), modelled(seed + 500, MANY)


def spoiled(axis: Axis, outlier_probability: Array, size_m: float, seed: int) -> Axis:
    wrong = np.random.default_rng(seed).choice([-size_m, size_m], len(outlier_probability))
    return line(
        axis.measurement_time_s, axis.measurement_m + np.where(outlier_probability, wrong, 0.0)
    )


def bursts(seed: int, share: float, length: int) -> Array:
    rng = np.random.default_rng(seed + 77)
    outlier_probability = np.zeros(MANY + 1, dtype=bool)
    while outlier_probability.sum() < share * MANY:
        at = rng.integers(1, MANY + 1 - length)
        outlier_probability[at : at + length] = True
    return outlier_probability


def noises_of(*axes: Axis) -> NoiseFit:
    parts = [convert_to_positions_and_increments(preintegrate(axis, TRUE)) for axis in axes]
    return maximise_likelihood(
        parts, NoiseParameters(TRUE.sigma_a_m_s2, TRUE.sigma_z_m), np.ones(MANY)
    )


@pytest.fixture(scope="module")
def clean() -> list[NoiseFit]:
    return [noises_of(*pair(seed)) for seed in SEEDS]


@pytest.mark.parametrize(
    ("share", "size_m", "length", "least_found"),
    [(0.05, 2.0, 4, 0.99), (0.12, 2.0, 4, 0.99), (0.06, 0.5, 2, 0.9)],
)
def test_maximum_likelihood_fit_finds_simulated_outliers(clean, share, size_m, length, least_found):
    hits = wrong = missed = 0
    ratio = []
    for seed in SEEDS:
        outlier_probability = bursts(seed, share, length)
        north, east = pair(seed)
        axes = (
            spoiled(north, outlier_probability, size_m, seed),
            spoiled(east, outlier_probability, size_m, seed + 50),
        )
        found = noises_of(*axes)
        ratio.append(found.noise_parameters.sigma_z_m / clean[seed].noise_parameters.sigma_z_m)
        called = found.outlier_probability > 0.5
        hits += np.count_nonzero(called & outlier_probability[1:])
        wrong += np.count_nonzero(called & ~outlier_probability[1:])
        missed += np.count_nonzero(~called & outlier_probability[1:])
        # outliers have a low weight, all others weight 1
        assert np.all(found.measurement_weights[called & outlier_probability[1:]] < 0.6)
        assert np.median(found.measurement_weights) > 0.98
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.025)
    assert hits / (hits + missed) > least_found
    assert hits / (hits + wrong) > 0.9


@pytest.mark.parametrize(("axes", "share", "width"), [(1, 0.15, 4.0), (2, 0.1, 5.0), (2, 0.3, 3.0)])
def test_sigma_of_noise_estimate_follows_likelihood_curvature(axes, share, width):
    """Without motion the likelihood has a closed form."""
    rng = np.random.default_rng(axes)
    wrong = rng.random(4000) < share
    error = rng.normal(0.0, np.where(wrong, width, 1.0)[:, None], (4000, axes))
    square = np.sum(error**2, axis=1)

    def score(parameters: Array) -> Array:
        log_sigma, log_width, odds = (
            parameters[:, None] if parameters.ndim == 1 else (parameters[..., None])
        )
        variance = np.exp(2.0 * log_sigma)
        wide = variance * np.exp(2.0 * log_width)
        chance = expit(odds)
        each = [
            np.log(part) - 0.5 * axes * np.log(of) - 0.5 * square / of
            for part, of in ((1.0 - chance, variance), (chance, wide))
        ]
        return -np.logaddexp(*each).sum(axis=-1)

    start = np.array([0.0, np.log(width), np.log(share / (1.0 - share))])
    best = minimize(score, start, method="BFGS", options={"gtol": 1e-4}).x
    curved = np.linalg.inv(hessian(score, best, initial_step=0.05).ddf)[0, 0]
    sigma, wide = np.exp(best[0]), np.exp(best[1])
    over = square / sigma**2
    outliers = OutlierDistribution(float(expit(best[2])), float(wide))
    found = outliers.compute_probability(over, np.full(4000, axes))
    widening = compute_variance_factor_of_ln_sigma_z(over, np.full(4000, axes), found, float(wide))
    assert widening > 1.1
    assert widening == pytest.approx(curved * 2.0 * axes * 4000, rel=0.01)


def test_noise_fit_without_outlier_model_keeps_given_weights() -> None:
    weight = np.random.default_rng(1).uniform(0.2, 1.0, MANY)
    parts = [convert_to_positions_and_increments(preintegrate(pair(1)[0], TRUE))]
    found = maximise_likelihood(parts, NoiseParameters(0.5, 0.1), weight, fits_outliers=False)
    np.testing.assert_array_equal(found.measurement_weights, weight)
    assert not found.outlier_probability.any()
    best = negative_log_likelihood(parts, found.noise_parameters, weight)
    for a, z in ((1.1, 1.0), (0.9, 1.0), (1.0, 1.05), (1.0, 0.95)):
        other = NoiseParameters(
            a * found.noise_parameters.sigma_a_m_s2, z * found.noise_parameters.sigma_z_m
        )
        assert negative_log_likelihood(parts, other, weight) > best


def test_outlier_probability_follows_bayes_rule() -> None:
    """Bayes: ε N(e; 0, w²σ²) against (1 - ε) N(e; 0, σ²), over all axes."""
    error = np.linspace(0.0, 6.0, 25)
    for axes in (1, 2):
        narrow = (1.0 - INITIAL_OUTLIERS.fraction) * norm.pdf(error) ** axes
        wide = (
            INITIAL_OUTLIERS.fraction * norm.pdf(error, scale=INITIAL_OUTLIERS.sigma_ratio) ** axes
        )
        got = INITIAL_OUTLIERS.compute_probability(axes * error**2, np.full(25, axes))
        np.testing.assert_allclose(got, wide / (wide + narrow), rtol=1e-9)
    # where the density underflows
    assert INITIAL_OUTLIERS.compute_probability(np.array([1e200]), np.ones(1)) == 1.0
