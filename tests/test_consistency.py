"""NIS, bias and whiteness against closed forms and simulated innovations."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from px4fuse.filter.consistency import (
    Consistency,
    assess_horizontal_nis,
    compute_nis_band,
)
from px4fuse.flight.model import Unavailable

# n, and 95 % band of the mean NIS with two degrees of freedom, as published for real flights
BANDS_OF_TWO = [(128, 1.67, 2.36), (72, 1.56, 2.49), (179, 1.72, 2.30), (103, 1.63, 2.40)]


def white(seed: int, count: int = 200) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=count)


def assessed(nu: NDArray[np.float64], s: float | NDArray[np.float64] = 1.0) -> Consistency:
    return Consistency.from_innovations(nu, np.broadcast_to(s, nu.shape).astype(float))


def test_nis_band_contains_95_percent_of_chi_square_values() -> None:
    for count, low, high in BANDS_OF_TWO:
        band = compute_nis_band(count, 2)
        assert (round(2 * band[0], 2), round(2 * band[1], 2)) == (low, high)
    for count in (10, 100, 1000):
        low, high = compute_nis_band(count)
        tails = stats.chi2.cdf(low * count, count), stats.chi2.sf(high * count, count)
        assert tails == pytest.approx((0.025, 0.025))


def test_white_innovations_have_verdict_consistent() -> None:
    """A small but significant deviation of σ is consistent, so all are; p-values stay exact."""
    found = [assessed(white(seed)) for seed in range(1000)]
    one = np.ones(200)
    pairs = [((white(seed), one), (white(seed + 5000), one)) for seed in range(1000)]
    assert all(each.verdict == "consistent" for each in found)
    assert all(assess_horizontal_nis(*pair).verdict == "consistent" for pair in pairs)
    inside = [each.nis_band[0] <= each.nis_mean <= each.nis_band[1] for each in found]
    for fine in (
        inside,
        [each.ljung_box_p > 0.05 for each in found], [each.bias_p > 0.05 for each in found],
    ):  # fmt: skip
        assert np.mean(fine) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize("factor", [0.05, 0.5, 2.0, 90.0])
def test_root_mean_nis_scales_as_1_over_root_innovation_variance(factor: float) -> None:
    variance = np.random.default_rng(2).uniform(0.5, 2.0, 2000)
    result = assessed(white(1, 2000) * np.sqrt(variance), factor * variance)
    assert result.sigma_ratio == pytest.approx(factor**-0.5, rel=0.04)
    assert result.sigma_ratio**2 == pytest.approx(result.nis_mean)
    assert result.sigma_error_factor == pytest.approx(
        max(result.sigma_ratio, 1.0 / result.sigma_ratio)
    )
    assert result.verdict == ("underconfident" if factor > 1 else "overconfident")


def test_innovation_statistics_equal_direct_computation() -> None:
    nu, s = white(9, 60) + 0.2, np.linspace(0.5, 2.0, 60)
    result = assessed(nu, s)
    normalised = [n / math.sqrt(v) for n, v in zip(nu, s, strict=True)]
    assert result.count == 60
    assert result.innovation_mean_m == pytest.approx(sum(nu) / 60)
    assert result.innovation_std_m == pytest.approx(np.std(nu, ddof=1))
    assert result.sqrt_s_median_m == pytest.approx(np.median([math.sqrt(v) for v in s]))
    assert result.nis_mean == pytest.approx(sum(e * e for e in normalised) / 60)
    assert result.nis_band == compute_nis_band(60)
    assert result.fraction_outside_two_sigma == sum(abs(e) > 2 for e in normalised) / 60
    power = sum(e * e for e in normalised)
    r = [np.dot(normalised[:-lag], normalised[lag:]) / power for lag in range(1, 11)]
    q = 60 * 62 * sum(each**2 / (60 - lag) for lag, each in enumerate(r, start=1))
    assert result.lag1_autocorrelation == pytest.approx(r[0])
    assert result.ljung_box_lags == 10
    assert result.ljung_box_p == pytest.approx(stats.chi2.sf(q, 10))
    student = stats.ttest_1samp(nu, 0.0)
    assert [result.bias_t, result.bias_p] == pytest.approx([student.statistic, student.pvalue])


def test_innovations_outside_gate_of_3_sigma_are_counted() -> None:
    nu = np.repeat([0.5, 2.5, 4.0, 6.0], 5)
    result = Consistency.from_innovations(nu, np.ones(20), gate=3.0)
    assert (result.fraction_outside_two_sigma, result.fraction_outside_gate) == (0.75, 0.5)
    assert assessed(nu).fraction_outside_gate == 0.25


def test_nis_statistics_ignore_nan_and_zero_variance() -> None:
    nu, s = white(1, 50), np.ones(50)
    nu[3], s[7], s[9] = np.nan, 0.0, np.nan
    kept = np.delete(np.arange(50), [3, 7, 9])
    assert Consistency.from_innovations(nu, s) == assessed(nu[kept])


def test_nis_verdict_of_few_or_equal_innovations_is_unavailable() -> None:
    for count in (0, 1, 9):
        result = Consistency.from_innovations(white(1, count), np.ones(count))
        assert isinstance(result, Unavailable)
        assert f"only {count} measurements (at least 10" in result.reason
    assert assessed(white(1, 14)).ljung_box_lags == 2
    for value in (0.0, -0.5):
        result = Consistency.from_innovations(np.full(50, value), np.ones(50))
        assert isinstance(result, Unavailable)
        assert "same value" in result.reason


def test_horizontal_nis_is_mean_of_north_and_east_nis() -> None:
    north, east = white(1), 0.5 * white(2)
    result = assess_horizontal_nis((north, np.ones(200)), (east, np.ones(200)))
    both = (assessed(north).nis_mean + assessed(east).nis_mean) / 2
    assert result.count == 200
    assert result.nis_mean == pytest.approx(both)
    assert result.sigma_ratio == pytest.approx(both**0.5)
    assert result.nis_band == compute_nis_band(200, 2)
    assert result.verdict == "underconfident"


def test_horizontal_nis_of_few_samples_is_not_evaluated() -> None:
    def axis(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return white(1, count), np.ones(count)

    assert assess_horizontal_nis(axis(9), axis(9)) is None
    assert assess_horizontal_nis((np.zeros(20), np.ones(20)), (np.zeros(20), np.ones(20))) is None


def test_horizontal_nis_ignores_nan_and_zero_variance() -> None:
    kept = np.delete(np.arange(200), 5)
    for column, value in ((0, np.nan), (1, np.nan), (1, 0.0)):
        north, east = (white(1), np.ones(200)), (white(2), np.ones(200))
        north[column][5] = value
        left = [(nu[kept], variance[kept]) for nu, variance in (north, east)]
        assert assess_horizontal_nis(north, east) == assess_horizontal_nis(*left)
