"""KF of many settings against the KF replay, and likelihoods of the noises."""

import numpy as np
import pytest
from exchange import replace
from filter_tools import any_axis, any_settings, sample_axes, score_grid
from flights import line, random_walk
from hypothesis import given, settings
from numpy.typing import NDArray
from scipy.stats import norm

from px4fuse.filter.kalman import run_kf
from px4fuse.filter.likelihood import (
    fit_parabola_vertex,
    innovations,
    preintegrate,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.flight.model import Flight

SIGMA_A = [0.05, 0.5, 5.0]
SIGMA_Z = [0.02, 0.1, 1.0]
ZERO = Settings(sigma_a_m_s2=0.5, input="zero")


def replayed(axis: Axis, chosen: Settings) -> NDArray[np.float64]:
    """ν and S of the KF replay, shape (2, m)."""
    return run_kf(axis, chosen).updates[["innovation_m", "innovation_variance_m2"]].to_numpy().T


def walk(seed: int = 3, *, sigma_z: float = 0.1, count: int = 4000) -> Axis:
    """Make a flight whose process noise is that of ``ZERO``."""
    rng = np.random.default_rng(seed)
    return random_walk(rng, count=count, interval_s=0.2, sigma_a=0.5, sigma_z=sigma_z)


def test_vectorised_kf_innovations_equal_kf_replay_at_any_noise(sample_flight: Flight) -> None:
    for axis in sample_axes(sample_flight):
        intervals = preintegrate(axis, Settings())
        for i, sigma_a in enumerate(SIGMA_A):
            for j in range(3) if axis.name == "north" else [i]:
                chosen = Settings(sigma_a_m_s2=sigma_a, sigma_z_m=SIGMA_Z[j])
                found = innovations(intervals, sigma_a, SIGMA_Z[j])
                np.testing.assert_allclose(found, replayed(axis, chosen), rtol=1e-9, atol=1e-9)


@settings(max_examples=60)
@given(axis=any_axis(), chosen=any_settings)
def test_vectorised_kf_innovations_equal_kf_replay_on_any_axis(
    axis: Axis, chosen: Settings
) -> None:
    found = innovations(preintegrate(axis, chosen), chosen.sigma_a_m_s2, chosen.sigma_z_m)
    np.testing.assert_allclose(found, replayed(axis, chosen), rtol=1e-9, atol=1e-9)


def test_fast_kf_innovations_with_imu_gap_equal_kf_replay() -> None:
    imu = np.arange(0.0, 12.0, 0.02)
    imu = imu[(imu < 4.0) | (imu > 5.3)]
    time = 0.37 * np.arange(30)
    axis = line(time, np.sin(time), (imu, -np.sin(imu)))
    assert run_kf(axis, Settings()).input_gap_s > 1.0
    found = innovations(preintegrate(axis, Settings()), 0.5, 0.1)
    np.testing.assert_allclose(found, replayed(axis, Settings()), rtol=1e-9, atol=1e-9)


def test_vectorised_kf_does_not_fuse_excluded_measurement() -> None:
    """Later innovations are as without the skipped measurement."""
    axis = walk(count=60)
    skip = np.zeros(59, dtype=bool)
    skip[[20, 21, 40]] = True
    nu, s = innovations(preintegrate(axis, ZERO), 0.5, 0.1, skip)
    kept = np.concatenate([[True], ~skip])
    without = line(axis.measurement_time_s[kept], axis.measurement_m[kept])
    expected = innovations(preintegrate(without, ZERO), 0.5, 0.1)
    np.testing.assert_allclose([nu[~skip], s[~skip]], expected, rtol=1e-9, atol=1e-9)
    assert np.all(s[skip] > 0.0)
    assert np.all(nu[skip] != 0.0)


def test_kf_likelihood_equals_normal_density_of_innovations() -> None:
    """Compare both axes with scipy's density of the replay's innovations."""
    axes = walk(4, count=60), walk(5, count=60)
    a, z = np.array([0.2, 0.5, 2.0]), np.array([0.05, 0.1])
    legs = [preintegrate(axis, ZERO) for axis in axes]
    total = score_grid(legs, a[:, None], z, np.ones(59))
    density = np.zeros((3, 2))
    for axis in axes:
        for i, j in np.ndindex(3, 2):
            nu, s = replayed(axis, replace(ZERO, sigma_a_m_s2=a[i], sigma_z_m=z[j]))
            density[i, j] -= np.sum(norm.logpdf(nu, scale=np.sqrt(s)))
    constant = 2 * 59 * 0.5 * np.log(2.0 * np.pi)
    np.testing.assert_allclose(total + constant, density, rtol=1e-10)


def test_parabola_vertex_from_three_points_is_exact() -> None:
    steps = np.arange(7) - 3.0
    for vertex, bend in ((-0.5, 0.3), (-0.2, 4.0), (0.0, 0.3), (0.35, 4.0)):
        found = fit_parabola_vertex(1.0 + 0.5 * bend * (steps - vertex) ** 2, 3)
        assert found == pytest.approx((vertex, bend), abs=1e-12)
    # without upward curvature there is no vertex
    assert fit_parabola_vertex(np.array([3.0, 2.0, 1.0]), 1) == (0.0, 0.0)
    assert fit_parabola_vertex(np.array([1.0, 2.0, 1.0]), 1) == (0.0, -2.0)
