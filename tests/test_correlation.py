"""Moments over all lags, against explicit sums."""

import numpy as np
import pytest
from scipy.stats import f

from px4fuse.trajectory.correlation import autocovariance, compute_moments
from px4fuse.trajectory.time_offset import MIN_SECOND_BEST_RESIDUAL_RATIO


@pytest.mark.parametrize("is_complex", [False, True])
def test_cross_correlation_equals_direct_sum_at_each_lag(is_complex: bool) -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(5.0, 1.0, 7), rng.normal(-3.0, 2.0, 11)
    if is_complex:
        a, b = a + 1j * rng.normal(size=7), b + 1j * rng.normal(size=11)
    a_known, b_known = rng.random(7) < 0.7, rng.random(11) < 0.7
    a[~a_known] = np.nan
    found = compute_moments(a, b, a_known, b_known)
    assert len(found.count) == 7 + 11 - 1
    for k, count in enumerate(found.count):
        lag = k - 6  # a's sample 0 meets b's sample lag
        both = [i for i in range(7) if 0 <= i + lag < 11 and a_known[i] and b_known[i + lag]]
        assert count == len(both)
        x, y = a[both], b[[i + lag for i in both]]
        x, y = (v - v.mean() if len(v) else v for v in (x, y))
        np.testing.assert_allclose(found.covariance[k], np.sum(x.conj() * y), atol=1e-10)
        np.testing.assert_allclose(found.sum_of_squares_a[k], np.sum(np.abs(x) ** 2), atol=1e-10)
        np.testing.assert_allclose(found.sum_of_squares_b[k], np.sum(np.abs(y) ** 2), atol=1e-10)


def test_autocovariance_equals_sum_of_products() -> None:
    v = np.array([1.0 + 2.0j, -3.0, 0.5j, 2.0])
    expected = [sum((v[i].conj() * v[i + k]).real for i in range(4 - k)) for k in range(4)]
    np.testing.assert_allclose(autocovariance(v), expected, atol=1e-12)


def test_time_offset_ambiguity_threshold_equals_f_quantile() -> None:
    assert pytest.approx(0.05, abs=0.005) == f.sf(MIN_SECOND_BEST_RESIDUAL_RATIO**2, 80, 80)
