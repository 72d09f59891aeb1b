"""The banded likelihood against dense linear algebra, and the noises that it finds."""

from __future__ import annotations

import numpy as np
import pytest
from exchange import replace
from flights import line, random_walk
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.differentiate import hessian
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import norm
from test_tuning import SIGMA_A, SIGMA_Z, TRUE, modelled

from px4fuse.arrays import Array, IntArray
from px4fuse.filter.chain import Chain, Columns, factorise
from px4fuse.filter.fitting import (
    FIRST_SHARE,
    FIRST_WIDTH,
    Likelihood,
    NoiseFit,
    Noises,
    Part,
    _outlier_probability,
    arguments,
    filter_part,
    most_likely,
    negative_log_likelihood,
    widened_by_outliers,
)
from px4fuse.filter.lanes import gains, lanes_of_paths
from px4fuse.filter.likelihood import (
    PROFILE_DROP,
    innovations,
    preintegrate,
    profile_end,
    total_over_grid,
)
from px4fuse.filter.marginal import (
    Positions,
    centred,
    fit,
    paired_products,
    squares,
)
from px4fuse.filter.model import noise_of_many_steps
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis

seeds = st.integers(0, 2**32 - 1)


def chain_of(rng: np.random.Generator, count: int, start: list[int]) -> Chain:
    end = np.setdiff1d(np.arange(count), start)
    length = rng.uniform(0.05, 0.6, len(end))
    fixed = np.outer(rng.choice([0.0, 0.01], len(end)), [0.3, 0.0, 0.2])
    return Chain(end, length, 0.1 * np.stack(noise_of_many_steps(length), 1), fixed)


def covariances(chain: Chain, sigma_a: float) -> list[Array]:
    """Q of each leg."""
    elements = sigma_a**2 * chain.noise_unit + chain.noise_fixed
    return [np.array([[a, b], [b, c]]) for a, b, c in elements]


# --- the factorisation ---


@settings(max_examples=40)
@given(seed=seeds)
def test_the_factor_is_that_of_the_dense_normal_equations(seed: int) -> None:
    """Two stretches, and a state that nothing measures, by lstsq, slogdet and inv."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 14))
    second = int(rng.integers(3, count - 2))
    chain = chain_of(rng, count, [0, second])
    precision = np.stack([rng.uniform(1.0, 100.0, count), np.zeros(count)], 1)
    precision[[0, second], 1] = 0.5, 2.0
    precision[rng.integers(1, count), 0] = 0.0
    sigma_a = float(rng.uniform(0.1, 2.0))
    columns = Columns(
        rng.normal(size=(3, count)),
        rng.normal(size=(3, len(chain.end))),
        rng.normal(size=(3, len(chain.end))),
    )
    # rows of what is known, over their standard deviations
    rows = np.diag(np.sqrt(precision.ravel()))
    known = np.zeros((2 * count, 3))
    known[0::2] = np.sqrt(precision[:, :1]) * columns.measurement_m.T
    log_determinant = -np.log(precision[precision > 0.0]).sum()
    for leg, q in enumerate(covariances(chain, sigma_a)):
        white = np.linalg.inv(np.linalg.cholesky(q))
        at = 2 * chain.end[leg]
        row = np.zeros((2, 2 * count))
        row[:, at - 2 : at] = -np.array([[1.0, chain.length_s[leg]], [0.0, 1.0]])
        row[:, at : at + 2] = np.eye(2)
        rows = np.vstack([rows, white @ row])
        added = np.stack([columns.delta_position_m[:, leg], columns.delta_velocity_m_s[:, leg]])
        known = np.vstack([known, white @ added])
        log_determinant += np.linalg.slogdet(q)[1]
    expected = np.linalg.lstsq(rows, known, rcond=None)[0]
    left = known - rows @ expected
    normal = rows.T @ rows
    log_determinant += np.linalg.slogdet(normal)[1]

    factor = factorise(chain, sigma_a, precision)
    state = factor.solve(columns).reshape(3, 2 * count)
    np.testing.assert_allclose(state.T, expected, rtol=1e-6, atol=1e-6)
    rows_over_sigma, explained = factor.whiten(columns)
    measured = np.sqrt(precision[:, 0]) * columns.measurement_m
    products = measured @ measured.T + rows_over_sigma @ rows_over_sigma.T - explained @ explained.T
    np.testing.assert_allclose(products, left.T @ left, rtol=1e-6, atol=1e-6)
    assert factor.log_determinant == pytest.approx(log_determinant, abs=1e-6)
    variance = np.diag(np.linalg.inv(normal))[0::2]
    np.testing.assert_allclose(factor.position_variance(), variance, rtol=1e-6)


def test_legs_of_one_step_are_factorised_far_beyond_the_search() -> None:
    """Their Q is of rank one: of what makes it invertible, rounding leaves nothing."""
    step = 0.09755900000000004
    unit = 0.1 * step * np.array([step**2 / 4.0, step / 2.0, 1.0])
    chain = Chain(np.arange(1, 20), np.full(19, step), np.tile(unit, (19, 1)), np.zeros((19, 3)))
    tried = np.geomspace(1e4, 1e6, 100).tolist()
    values = [factorise(chain, sigma_a, np.ones(20)).log_determinant for sigma_a in tried]
    # with more noise the innovations are larger
    assert np.all(np.diff(values) > 0.0)


def test_a_stretch_without_measurements_cannot_be_factorised() -> None:
    chain = chain_of(np.random.default_rng(1), 8, [0, 4])
    with pytest.raises(np.linalg.LinAlgError):
        factorise(chain, 1.0, np.array([9.0, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0]))


# --- the likelihood with constants ---

START = np.array([0, 11])
COUNT = 24
WEAK = np.array([1e-6, 1e-4])  # of position and velocity where a stretch starts


def constants_part(seed: int = 5, offsets: int = 3) -> Part:
    """Two stretches of three axes with three constants.

    The first two axes lack some measurements, the second its first one; the third has one only in
    its second stretch.
    """
    rng = np.random.default_rng(seed)
    chain = chain_of(rng, COUNT, START.tolist())
    measured = rng.normal(0.0, 1.0, (COUNT, 3))
    measured[START] = 0.0
    measured[[4, 17], 0] = np.nan
    measured[[0, 7], 1] = np.nan
    measured[11:, 2] = np.nan
    measured[15, 2] = -500.0
    initial = np.zeros((COUNT, 2))
    initial[START] = WEAK
    positions = Positions(chain, measured, START, initial, np.array([0.3, 1.0, 0.1]))
    dp, dv = np.moveaxis(rng.normal(0.0, 0.3, (2, len(chain.end), 3, offsets, 4)), 1, -1)
    return Part(positions, dp, dv)


def stretch_normal(
    part: Part, noises: Noises, variance: Array, stretch: int, axis: int, at: int
) -> tuple[IntArray, Array, Array]:
    """Rows that are measured, their signals (data minus mean, constants), and their covariance."""
    positions, chain = part.positions, part.positions.chain
    edges = [*START.tolist(), COUNT]
    q = covariances(chain, noises.sigma_a_m_s2)
    mean = np.zeros((2, 4))  # of position and velocity, over the data's and the constants' signals
    by_state = [np.diag(1.0 / WEAK)]  # covariance of each state with all before it
    rows = list(range(edges[stretch], edges[stretch + 1]))
    means = [mean]
    cross = {(0, 0): by_state[0]}
    for k, row in enumerate(rows[1:], start=1):
        leg = int(np.flatnonzero(chain.end == row)[0])
        f = np.array([[1.0, chain.length_s[leg]], [0.0, 1.0]])
        added = np.stack(
            [part.delta_position_m[axis, at, :, leg], part.delta_velocity_m_s[axis, at, :, leg]]
        )
        means.append(f @ means[-1] + added)
        for j in range(k):
            cross[k, j] = f @ cross[k - 1, j]
            cross[j, k] = cross[k, j].T
        walk = np.diag([noises.walk_m**2 * chain.length_s[leg], 0.0])
        cross[k, k] = f @ cross[k - 1, k - 1] @ f.T + q[leg] + walk
    used = [k for k, row in enumerate(rows) if np.isfinite(positions.measurement_m[row, axis])]
    if len(used) < 2:
        used = []
    signals = np.array([-means[k][0] for k in used]).reshape(-1, 4)
    kept = np.array([rows[k] for k in used], dtype=int)
    signals[:, 0] += positions.measurement_m[kept, axis]
    covariance = np.array([[cross[k, j][0, 0] for j in used] for k in used]).reshape(
        len(used), len(used)
    )
    return kept, signals, covariance + np.diag(variance[kept])


def dense_total(part: Part, noises: Noises, weight: Array, at: int) -> float:
    """-ln p with the constants as further covariance, all axes at once."""
    variance = noises.sigma_z_m**2 / weight
    total = 0.0
    for stretch in range(2):
        made = [stretch_normal(part, noises, variance, stretch, axis, at) for axis in range(3)]
        signals = np.concatenate([each[1] for each in made])
        size = np.cumsum([0, *(len(each[1]) for each in made)])
        covariance = signals[:, 1:] * part.positions.constant_sigma**2 @ signals[:, 1:].T
        for axis in range(3):
            block = slice(size[axis], size[axis + 1])
            covariance[block, block] += made[axis][2]
        total += 0.5 * signals[:, 0] @ np.linalg.solve(covariance, signals[:, 0])
        total += 0.5 * np.linalg.slogdet(covariance)[1]
    return float(total)


SOME_NOISES = (
    Noises(0.5, 0.1),
    Noises(0.05, 0.1),
    Noises(2.0, 0.1),
    Noises(0.5, 0.02),
    Noises(0.5, 1.0),
    Noises(0.5, 0.1, 0.3),
)


def test_marginal_constants_are_a_covariance() -> None:
    """At all offsets and noises, weights and a walk, but for one number that is always the same."""
    part = constants_part()
    weight = np.random.default_rng(2).uniform(0.1, 1.0, COUNT)
    ours = np.array([fit(*arguments(part, noises, weight)).total() for noises in SOME_NOISES])
    dense = np.array(
        [[dense_total(part, noises, weight, at) for at in range(3)] for noises in SOME_NOISES]
    )
    assert np.ptp(dense) > 1000.0
    np.testing.assert_allclose(ours - ours[0, 0], dense - dense[0, 0], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("start_known", [True, False])
def test_an_axis_that_is_hardly_measured_says_nothing(start_known: bool) -> None:
    """One position in a stretch, wherever it is, and none at all are the same."""
    part = constants_part()
    if not start_known:
        nothing = np.zeros((COUNT, 2))
        part = replace(part, positions=replace(part.positions, initial=nothing))
    without = part.positions.measurement_m.copy()
    without[15, 2] = np.nan
    weight = np.ones(COUNT)
    for noises in SOME_NOISES:
        gone = replace(part, positions=replace(part.positions, measurement_m=without))
        one, none = (fit(*arguments(each, noises, weight)) for each in (part, gone))
        np.testing.assert_allclose(one.total(), none.total(), rtol=1e-12)
        for ours, expected in zip(one.constants(), none.constants(), strict=True):
            np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-12)


def joint_estimate(part: Part, noises: Noises) -> tuple[Array, Array]:
    """Constants, and squares of the errors, by the conditional normal distribution."""
    variance = np.full(COUNT, noises.sigma_z_m**2)
    prior = np.diag(part.positions.constant_sigma**2)
    found, square = [], np.zeros(COUNT)
    for stretch in range(2):
        made = [stretch_normal(part, noises, variance, stretch, axis, 0) for axis in range(2)]
        information = np.linalg.inv(prior)
        right = np.zeros(3)
        for _, signals, covariance in made:
            by = -signals[:, 1:]  # what a constant adds to the positions
            information = information + by.T @ np.linalg.solve(covariance, by)
            right += by.T @ np.linalg.solve(covariance, signals[:, 0])
        constants = np.linalg.solve(information, right)
        found.append(constants)
        for rows, signals, covariance in made:
            r = np.diag(variance[rows])
            left = signals[:, 0] + signals[:, 1:] @ constants
            # z - E[p | z] = R C⁻¹ left, with variance R - R C⁻¹ R
            error = r @ np.linalg.solve(covariance, left)
            square[rows] += error**2 + np.diag(r - r @ np.linalg.solve(covariance, r))
    return np.array(found), square


def test_constants_and_squares_are_those_of_the_conditional_distribution() -> None:
    part = constants_part(offsets=1)
    # two axes: of a third that is hardly measured the square would say nothing
    part = Part(
        replace(part.positions, measurement_m=part.positions.measurement_m[:, :2]),
        part.delta_position_m[:2],
        part.delta_velocity_m_s[:2],
    )
    for noises in SOME_NOISES[:5]:
        given = arguments(part, noises, np.ones(COUNT))
        constants, expected = joint_estimate(part, noises)
        np.testing.assert_allclose(fit(*given).constants()[0][:, 0], constants, rtol=1e-4)
        square, count = squares(*given, fit(*given).constants()[0][:, 0])
        np.testing.assert_allclose(square, expected, rtol=1e-4, atol=1e-9)
        np.testing.assert_array_equal(count, np.isfinite(part.positions.measurement_m).sum(axis=1))


def test_paired_products_are_under_the_covariance_with_the_constants() -> None:
    part, noises = constants_part(offsets=1), Noises(0.5, 0.1)
    rng = np.random.default_rng(8)
    signal = rng.normal(0.0, 1.0, (COUNT, 3, 2))
    nothing = np.zeros((3, 1, len(part.positions.chain.end)))
    first, second = (
        Columns(signal[..., [at]].transpose(1, 2, 0), nothing, nothing) for at in (0, 1)
    )
    given = arguments(part, noises, np.ones(COUNT))
    ours = paired_products(*given, [(first, second), (second, second)])
    variance = np.full(COUNT, noises.sigma_z_m**2)
    for stretch in range(2):
        made = [stretch_normal(part, noises, variance, stretch, axis, 0) for axis in range(3)]
        constants = np.concatenate([signals[:, 1:] for _, signals, _ in made])
        picked = np.concatenate([signal[rows, axis] for axis, (rows, *_) in enumerate(made)])
        covariance = constants * part.positions.constant_sigma**2 @ constants.T
        size = np.cumsum([0, *(len(rows) for rows, *_ in made)])
        for axis in range(3):
            block = slice(size[axis], size[axis + 1])
            covariance[block, block] += made[axis][2]
        expected = picked.T @ np.linalg.solve(covariance, picked)
        np.testing.assert_allclose(ours[stretch], expected[1], rtol=1e-4, atol=1e-4)


def test_side_by_side_stretches_are_those_of_the_factorisation() -> None:
    """At all offsets, with weights and a walk; stretches of 11 and 13, axes with gaps of theirs."""
    part = constants_part()
    weight = np.random.default_rng(2).uniform(0.1, 1.0, COUNT)
    assert part.lanes is not None
    given = [arguments(part, noises, weight) for noises in SOME_NOISES]
    ours = [
        part.lanes.fit(gains(positions, [sigma_a], variance))[0]
        for positions, _, _, sigma_a, variance in given
    ]
    expected = [fit(*each) for each in given]
    for one, other in zip(ours, expected, strict=True):
        assert one.freedom == other.freedom
        np.testing.assert_allclose(one.gram, other.gram, rtol=1e-6, atol=1e-6)
    total, factorised = (np.array([each.total() for each in both]) for both in (ours, expected))
    np.testing.assert_allclose(
        total - total[0, 0], factorised - factorised[0, 0], rtol=1e-6, atol=1e-5
    )
    # several ratios at once are each by itself
    positions, _, _, _, variance = given[0]
    together = part.lanes.fit(gains(positions, [0.5, 2.0], variance))
    np.testing.assert_allclose(together[0].gram, ours[0].gram, rtol=1e-9)
    np.testing.assert_allclose(together[1].gram, ours[2].gram, rtol=1e-9)


def test_where_the_input_leads_says_the_same_as_its_legs() -> None:
    """Positions about a smooth path, whose scale is the last constant, at all offsets."""
    part = constants_part()
    positions, chain = part.positions, part.positions.chain
    dp, dv = part.delta_position_m.copy(), part.delta_velocity_m_s.copy()
    dp[:, :, -1] = dv[:, :, -1] = 0.0
    path, speed = np.zeros((2, COUNT, *dp.shape[:-1]))
    for leg, (end, length) in enumerate(zip(chain.end, chain.length_s, strict=True)):
        path[end] = path[end - 1] + length * speed[end - 1] + dp[..., leg]
        speed[end] = speed[end - 1] + dv[..., leg]
    variance = np.full(COUNT, 0.3)
    of_legs = Part(*centred(positions, dp, dv, scaled=True)).lanes
    assert of_legs is not None
    steps = gains(positions, [0.5, 2.0], variance)
    by_path = lanes_of_paths(positions, path[..., :-1]).fit(steps)
    for expected, ours in zip(of_legs.fit(steps), by_path, strict=True):
        assert np.ptp(expected.gram[..., -1, -1]) > 1.0
        np.testing.assert_allclose(ours.gram, expected.gram, rtol=1e-7, atol=1e-7)
    # what else is tried with an offset does not matter
    alone = lanes_of_paths(positions, path[:, :, -1:, :-1]).fit(steps)
    for ours, one in zip(by_path, alone, strict=True):
        np.testing.assert_allclose(ours.gram[:, -1:], one.gram, rtol=1e-7, atol=1e-7)


def test_a_start_that_is_known_is_not_laid_side_by_side() -> None:
    assert filter_part(preintegrate(modelled(1, 80), TRUE)).lanes is None


@pytest.mark.parametrize("which", ["filter", "constants"])
def test_the_likelihood_between_its_nodes_is_the_likelihood(which: str) -> None:
    """Over four powers of ten of the ratio and of SIGMA_Z, but for one number always the same."""
    if which == "filter":
        count, parts = 80, [filter_part(preintegrate(modelled(seed, 80), TRUE)) for seed in (1, 2)]
    else:
        count, part = COUNT, constants_part(offsets=1)
        chain = replace(part.positions.chain, noise_fixed=0.0 * part.positions.chain.noise_fixed)
        parts = [replace(part, positions=replace(part.positions, chain=chain))]
    weight = np.random.default_rng(3).uniform(0.1, 1.0, count)
    # far from its maximum the start with constants, which is as good as unknown, tells
    for rough, error in ((False, 1e-6 if which == "filter" else 1e-4), (True, 2e-3)):
        score = Likelihood(parts, weight, 0.1, rough)
        assert score.tabulated
        some = [
            Noises(*pair)
            for pair in np.exp(np.random.default_rng(4).uniform(-4.6, 1.0, (30, 2))).tolist()
        ]
        ours = np.array([score(noises) for noises in some])
        direct = np.array([negative_log_likelihood(parts, noises, weight) for noises in some])
        assert np.ptp(direct) > 100.0
        np.testing.assert_allclose(ours - ours[0], direct - direct[0], rtol=error, atol=1e-3)


# --- the filter's own likelihood ---

SETTINGS_TRIED = [(0.5, 0.1), (0.05, 0.1), (3.0, 0.1), (0.5, 0.01), (0.5, 1.0), (0.02, 2.0)]


def with_gap() -> Axis:
    imu = np.arange(0.0, 45.0, 0.02)
    imu = imu[(imu < 14.0) | (imu > 15.3)]
    time = 0.37 * np.arange(120)
    rng = np.random.default_rng(3)
    return line(time, np.sin(time) + rng.normal(0.0, 0.1, 120), (imu, -np.sin(imu)))


@pytest.mark.parametrize("interval", [0.1, 0.2, 0.5])
def test_the_filters_likelihood_is_that_of_its_innovations(interval: float) -> None:
    """With legs of one step, whose Q has no inverse, and of more."""
    axis = random_walk(
        np.random.default_rng(3), count=300, interval_s=interval, sigma_a=0.5, sigma_z=0.1
    )
    _assert_same(axis, Settings(input="zero"))


def test_the_filters_likelihood_is_that_of_its_innovations_through_an_imu_gap() -> None:
    _assert_same(with_gap(), Settings())


def _assert_same(axis: Axis, chosen: Settings) -> None:
    legs = preintegrate(axis, chosen)
    ours, expected = [], []
    for sigma_a, sigma_z in SETTINGS_TRIED:
        nu, s = innovations(legs, sigma_a, sigma_z)
        expected.append(0.5 * np.sum(np.log(s) + nu**2 / s))
        weight = np.ones(len(nu))
        noises = Noises(sigma_a, sigma_z)
        ours.append(negative_log_likelihood([filter_part(legs)], noises, weight))
    assert np.ptp(expected) > 50.0
    np.testing.assert_allclose(
        np.array(ours) - ours[0], np.array(expected) - expected[0], rtol=1e-6, atol=2e-3
    )


def test_weights_mean_the_same_in_both_likelihoods() -> None:
    legs = [preintegrate(modelled(seed, 80), TRUE) for seed in (1, 2)]
    weight = np.random.default_rng(1).uniform(0.01, 1.0, 80)
    a, z = np.array([0.2, 0.5, 2.0]), np.array([0.05, 0.1, 0.3])
    grid = total_over_grid(legs, a, z, weight)
    parts = [filter_part(leg) for leg in legs]
    ours = [
        negative_log_likelihood(parts, Noises(*pair), weight)
        for pair in zip(a.tolist(), z.tolist(), strict=True)
    ]
    np.testing.assert_allclose(np.array(ours) - ours[0], grid - grid[0], rtol=2e-3, atol=0.02)


# --- the ends of an interval ---


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.8, -3.0])
def test_the_ends_of_a_parabola_are_196_sigma_away(slope: float) -> None:
    """With the other parameter free, which follows: its sigma is that of the margin."""
    sigma, other_sigma = 0.2, 0.05

    def score(at: float, other: float) -> float:
        return (
            0.5 * (at - 1.0) ** 2 / sigma**2
            + 0.5 * ((other - 2.0 - slope * (at - 1.0)) / other_sigma) ** 2
        )

    reach = sigma * np.sqrt(2.0 * PROFILE_DROP)
    for side in (-1.0, 1.0):
        end = profile_end(score, (1.0, 2.0), side, 1.0 + side * 5.0)
        assert end == pytest.approx(1.0 + side * reach, abs=0.01 * reach)
        assert profile_end(score, (1.0, 2.0), side, 1.0 + side * 0.5 * reach) is None


# --- outliers by expectation and maximisation ---

SEEDS = range(3)
MANY = 400


def pair(seed: int) -> tuple[Axis, Axis]:
    return modelled(seed, MANY), modelled(seed + 500, MANY)


def spoiled(axis: Axis, outlier: Array, size_m: float, seed: int) -> Axis:
    rng = np.random.default_rng(seed)
    wrong = rng.choice([-size_m, size_m], len(outlier))
    return line(axis.measurement_time_s, axis.measurement_m + np.where(outlier, wrong, 0.0))


def bursts(seed: int, share: float, length: int) -> Array:
    rng = np.random.default_rng(seed + 77)
    outlier = np.zeros(MANY + 1, dtype=bool)
    while outlier.sum() < share * MANY:
        at = rng.integers(1, MANY + 1 - length)
        outlier[at : at + length] = True
    return outlier


def noises_of(*axes: Axis) -> NoiseFit:
    parts = [filter_part(preintegrate(axis, TRUE)) for axis in axes]
    return most_likely(parts, Noises(SIGMA_A, SIGMA_Z), np.ones(MANY))


@pytest.fixture(scope="module")
def clean() -> list[NoiseFit]:
    return [noises_of(*pair(seed)) for seed in SEEDS]


def test_clean_data_have_no_outliers(clean: list[NoiseFit]) -> None:
    for found in clean:
        assert found.outlier.sum() < 0.5
        assert found.outlier.max() < 0.5
        assert found.noises.sigma_z_m == pytest.approx(SIGMA_Z, rel=0.08)
        assert found.noises.walk_m == 0.0


@pytest.mark.parametrize(
    ("share", "size_m", "length", "least_found"),
    [(0.05, 2.0, 4, 0.99), (0.07, 2.0, 4, 0.99), (0.12, 2.0, 4, 0.99), (0.06, 0.5, 2, 0.9)],
)
def test_outliers_are_found_and_do_not_move_the_noise(
    clean: list[NoiseFit], share: float, size_m: float, length: int, least_found: float
) -> None:
    hits = wrong = missed = 0
    ratio = []
    for seed in SEEDS:
        outlier = bursts(seed, share, length)
        north, east = pair(seed)
        axes = spoiled(north, outlier, size_m, seed), spoiled(east, outlier, size_m, seed + 50)
        found = noises_of(*axes)
        ratio.append(found.noises.sigma_z_m / clean[seed].noises.sigma_z_m)
        called = found.outlier > 0.5
        hits += np.count_nonzero(called & outlier[1:])
        wrong += np.count_nonzero(called & ~outlier[1:])
        missed += np.count_nonzero(~called & outlier[1:])
        # what is called an outlier counts little, and all else counts
        assert np.all(found.weight[called & outlier[1:]] < 0.6)
        assert np.median(found.weight) > 0.98
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.025)
    assert hits / (hits + missed) > least_found
    assert hits / (hits + wrong) > 0.9


@pytest.mark.parametrize(("axes", "share", "width"), [(1, 0.15, 4.0), (2, 0.1, 5.0), (2, 0.3, 3.0)])
def test_noise_is_as_uncertain_as_the_likelihood_of_the_mixture_is_curved(
    axes: int, share: float, width: float
) -> None:
    """Of measurements without any motion, whose likelihood can be written down."""
    rng = np.random.default_rng(axes)
    wrong = rng.random(4000) < share
    square = np.sum(
        rng.normal(0.0, np.where(wrong, width, 1.0)[:, None], (4000, axes)) ** 2, axis=1
    )

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
    found = _outlier_probability(over, np.full(4000, axes), float(expit(best[2])), float(wide))
    widening = widened_by_outliers(over, np.full(4000, axes), found, float(wide))
    assert widening > 1.1
    assert widening == pytest.approx(curved * 2.0 * axes * 4000, rel=0.01)


def test_what_one_axis_sees_both_leave_out() -> None:
    outlier = bursts(1, 0.05, 3)
    north, east = pair(1)
    found = noises_of(north, spoiled(east, outlier, 2.0, 1))
    np.testing.assert_array_equal(found.outlier > 0.5, outlier[1:])


def test_without_a_search_the_weights_stay() -> None:
    weight = np.random.default_rng(1).uniform(0.2, 1.0, MANY)
    parts = [filter_part(preintegrate(pair(1)[0], TRUE))]
    found = most_likely(parts, Noises(SIGMA_A, SIGMA_Z), weight, outliers=False)
    np.testing.assert_array_equal(found.weight, weight)
    assert not found.outlier.any()
    best = negative_log_likelihood(parts, found.noises, weight)
    for a, z in ((1.1, 1.0), (0.9, 1.0), (1.0, 1.05), (1.0, 0.95)):
        other = Noises(a * found.noises.sigma_a_m_s2, z * found.noises.sigma_z_m)
        assert negative_log_likelihood(parts, other, weight) > best


def test_outlier_probability_goes_from_the_prior_to_certainty() -> None:
    """Bayes: ε N(e; 0, w²σ²) against (1 - ε) N(e; 0, σ²), over all axes."""
    error = np.linspace(0.0, 6.0, 25)
    share, width = FIRST_SHARE, FIRST_WIDTH
    for axes in (1, 2):
        narrow = (1.0 - share) * norm.pdf(error) ** axes
        wide = share * norm.pdf(error, scale=width) ** axes
        got = _outlier_probability(axes * error**2, np.full(25, axes), share, width)
        np.testing.assert_allclose(got, wide / (wide + narrow), rtol=1e-9)
        assert np.all(np.diff(got) > 0.0)
        assert got[0] < share  # no evidence at all speaks against an outlier
    # beyond every floating-point density
    assert _outlier_probability(np.array([1e200]), np.ones(1), share, width) == 1.0
    # both axes together see what neither sees alone
    one = _outlier_probability(np.array([3.2**2]), np.ones(1), share, width)
    both = _outlier_probability(np.array([2.0 * 3.2**2]), np.full(1, 2.0), share, width)
    assert one < 0.5 < both
