"""Noise estimates against simulated data with known noises."""

from functools import cache

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from filter_tools import COUNT, SETTINGS, TRUE, made_flight, modelled, score_grid
from flights import line
from scipy.interpolate import CubicSpline
from scipy.stats import binom, norm

from px4fuse.filter import fitting
from px4fuse.filter.likelihood import MAX_LOG_LIKELIHOOD_DROP, innovations, preintegrate
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.tuning import (
    HORIZONTAL,
    MIN_MEASUREMENTS,
    SIGMA_Z_SEARCH_RANGE_M,
    AxisTuning,
    NoiseEstimate,
    tune,
    tune_axes,
)
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.report.phrases import format_noise_estimate

SIGMA_A, SIGMA_Z, SEEDS = TRUE.sigma_a_m_s2, TRUE.sigma_z_m, 40


def tuned(*axes: Axis, chosen: Settings = TRUE) -> AxisTuning:
    return tune_axes("north", axes, chosen)


@cache
def many() -> tuple[AxisTuning, ...]:
    """Return the tuning of one flight with many seeds."""
    return tuple(tuned(modelled(seed)) for seed in range(SEEDS))


# --- the estimates ---


@pytest.mark.parametrize(("name", "true"), [("sigma_z", SIGMA_Z), ("sigma_a", SIGMA_A)])
def test_fitted_noise_95_percent_interval_contains_true_value(name: str, true: float) -> None:
    """With 1000 seeds of 400 measurements the coverage was 95.2 % (SIGMA_Z), 95.5 % (SIGMA_A)."""
    noises = [getattr(found, name) for found in many()]
    inside = sum(noise.low <= true <= noise.high for noise in noises)
    # 0.5 % in each tail of the binomial distribution
    low, high = binom.ppf([0.005, 0.995], SEEDS, 0.95)
    assert low <= inside <= high
    # no significant bias; with 1000 seeds it was -0.5 % (SIGMA_Z) and -0.3 % (SIGMA_A)
    values = np.array([noise.value for noise in noises])
    error = np.std(values) / np.sqrt(SEEDS)
    assert np.mean(values) == pytest.approx(true, abs=0.01 * true + 2.6 * error)
    assert error < 0.03 * true


def test_noise_fit_finds_no_outliers_in_clean_data() -> None:
    assert sum(len(found.outlier_time_s) for found in many()) <= 0.001 * SEEDS * COUNT


def test_noise_fit_result_does_not_depend_on_start_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The fit that starts at the first measurements has the same result, also with outliers."""
    axis = modelled(3, 1300)
    outliers = np.arange(20, 1300, 40)
    measured_m = axis.measurement_m.copy()
    measured_m[outliers] += 1.5
    axis = replace(axis, measurement_m=measured_m)
    expected = tuned(axis)
    monkeypatch.setattr(fitting, "INITIAL_FIT_MEASUREMENT_COUNT", 400)
    found = tuned(axis)
    for name in ("sigma_a_two_state", "sigma_z"):
        noise, expected_noise = getattr(found, name), getattr(expected, name)
        interval = expected_noise.high - expected_noise.low
        assert noise.value == pytest.approx(expected_noise.value, abs=0.05 * interval)
    np.testing.assert_array_equal(found.outlier_time_s, expected.outlier_time_s)
    assert set(axis.measurement_time_s[outliers]) <= set(found.outlier_time_s)


def test_noise_fit_finds_outliers_in_positions_not_used_in_fit() -> None:
    """Only every fourth position is used for the noises at 100 Hz."""
    axis = modelled(4, 2000)
    fast = replace(axis, measurement_time_s=0.01 * np.arange(2001.0))
    measured_m = 0.1 * np.random.default_rng(4).standard_normal(2001)
    measured_m[1000:1003] += 5.0
    found = tuned(replace(fast, measurement_m=measured_m))
    expected_s = fast.measurement_time_s[1000:1003]
    np.testing.assert_array_equal(found.outlier_time_s, expected_s)
    assert found.count == 2000
    assert found.sigma_z.value == pytest.approx(0.1, rel=0.1)


def test_fitted_noise_is_no_likelier_than_true_on_held_out_data() -> None:
    gains = np.array([found.held_out.log_likelihood_gain_per_measurement for found in many()])
    assert np.mean(gains) < 0.0
    assert np.median(gains) <= 0.0
    assert np.max(gains) < 0.05
    # on the data of the fit there is always a gain: half a χ² of two parameters, mean 1 per flight
    seen = np.array([found.log_likelihood_gain_per_measurement * found.count for found in many()])
    assert np.all(seen >= -1e-3)
    assert np.mean(seen) == pytest.approx(1.0, abs=2.6 / np.sqrt(SEEDS))


def test_noise_estimates_increase_likelihood_of_held_out_data() -> None:
    bad = Settings(sigma_a_m_s2=5.0, sigma_z_m=0.02, input="zero")
    found = tuned(modelled(1), chosen=bad)
    assert found.held_out.log_likelihood_gain_per_measurement > 0.1
    assert found.held_out.count == COUNT // 2
    assert found.log_likelihood_gain_per_measurement > 0.1
    assert found.before.verdict != "consistent"
    assert found.after.verdict == "consistent"
    assert abs(found.after.lag1_autocorrelation) < abs(found.before.lag1_autocorrelation)
    # the estimates do not depend on the chosen settings
    other = tuned(modelled(1), chosen=Settings(sigma_a_m_s2=0.01, sigma_z_m=5.0, input="zero"))
    for name in ("sigma_a", "sigma_z"):
        one, two = ([getattr(getattr(each, name), of) for of in ("value", "low", "high")]
                    for each in (found, other))  # fmt: skip
        assert one == pytest.approx(two, rel=1e-4)


def test_noise_interval_of_two_axes_is_narrower_by_root_2() -> None:
    for seed in range(2):
        north, east = modelled(seed), modelled(seed + 100)
        both = tuned(north, east)
        for single in (tuned(north), tuned(east)):
            for name in ("sigma_a", "sigma_z"):
                one, pooled = getattr(single, name), getattr(both, name)
                width = np.log(one.high / one.low), np.log(pooled.high / pooled.low)
                # twice the data: 1/√2 of the width
                assert width[1] / width[0] == pytest.approx(np.sqrt(0.5), rel=0.25)
                assert pooled.value is not None


# --- the map ---


def test_noise_interval_ends_where_profile_likelihood_drops() -> None:
    axis = modelled(5)
    found = tuned(axis)
    assert len(found.outlier_time_s) == 0
    legs = preintegrate(axis, TRUE)

    def total(sigma_a: float, sigma_z: float) -> float:
        nu, s = innovations(legs, sigma_a, sigma_z)
        return float(-np.sum(norm.logpdf(nu, scale=np.sqrt(s))))

    grid_a, grid_z = (
        np.geomspace(0.7 * noise.low, 1.4 * noise.high, 40)
        for noise in (found.sigma_a_two_state, found.sigma_z)
    )
    drops = score_grid([legs], grid_a[:, None], grid_z, np.ones(len(legs.measurement_m)))
    drops -= drops.min()
    best = total(found.sigma_a.value, found.sigma_z.value)
    for i, j in ((0, 0), (10, 30), (39, 5)):
        drop = total(grid_a[i], grid_z[j]) - best
        assert drops[i, j] == pytest.approx(drop, rel=0.02, abs=0.02)
    ends = ((grid_a, 1, found.sigma_a_two_state), (grid_z, 0, found.sigma_z))
    for grid, axis_of_other, noise in ends:
        profile = CubicSpline(np.log(grid), drops.min(axis=axis_of_other))
        for end in (noise.low, noise.high):
            assert profile(np.log(end)) == pytest.approx(MAX_LOG_LIKELIHOOD_DROP, abs=0.1)
        assert noise.low < noise.value < noise.high


# --- the edges ---


@pytest.mark.parametrize("sigma_a", [0.05, 0.5])
def test_noise_fit_of_exact_positions_gives_only_upper_bound(sigma_a: float) -> None:
    found = tuned(modelled(3, 500, sigma_a=sigma_a, sigma_z=0.0))
    assert found.sigma_z.value is found.sigma_z.low is None
    assert SIGMA_Z_SEARCH_RANGE_M[0] <= found.sigma_z.high < 0.003
    assert found.sigma_a.low <= sigma_a <= found.sigma_a.high or sigma_a < 0.1


def test_noise_at_end_of_search_range_is_reported_as_bound() -> None:
    noise = np.random.default_rng(0).normal(0.0, 1.0, 300)
    still, wild = (tuned(line(0.2 * np.arange(300), sigma * noise)) for sigma in (0.1, 30.0))
    assert still.sigma_a.value is still.sigma_a.low is None
    assert 0.001 < still.sigma_a.high < 0.02
    assert still.sigma_z.low < 0.1 < still.sigma_z.high
    assert wild.sigma_z.value is wild.sigma_z.high is None
    assert wild.sigma_z.low > 9.0


def test_noise_fit_of_too_few_measurements_is_unavailable() -> None:
    short = tune_axes("down", (modelled(1, MIN_MEASUREMENTS - 1),), TRUE)
    assert isinstance(short, Unavailable)
    assert short.what == "estimate of SIGMA_A and SIGMA_Z (down)"
    assert f"only {MIN_MEASUREMENTS - 1} measurements" in short.reason
    enough = tuned(modelled(1, MIN_MEASUREMENTS))
    assert isinstance(enough.held_out, Unavailable)
    assert f"{MIN_MEASUREMENTS // 2} measurements" in enough.held_out.reason
    assert enough.sigma_z.low < SIGMA_Z < enough.sigma_z.high


def test_noise_fit_combines_axes_with_equal_timestamps() -> None:
    north, east = modelled(1, 60), replace(modelled(2, 60), name="east")
    steps: list[str] = []
    found = tune((north, east), TRUE, progress=steps.append)
    assert list(found) == steps == ["north", "east", HORIZONTAL]
    assert list(tune((north, east), TRUE, (HORIZONTAL, "down"))) == [HORIZONTAL]
    late = replace(east, measurement_time_s=east.measurement_time_s + 0.01)
    assert list(tune((north, late), TRUE)) == ["north", "east"]


# --- noise separated from constant errors ---


def horizontal(flight: Flight, *, imu: bool = True, drifts: bool = False) -> AxisTuning:
    axes, given = compare(flight, SETTINGS).input_axes, flight if imu else None
    found = tune(axes, SETTINGS, (HORIZONTAL,), flight=given, may_drift=drifts)[HORIZONTAL]
    assert found.biases_fitted == imu
    return found


def test_noise_fit_separates_imu_bias_and_tilt_from_noise() -> None:
    """KF has no states for biases and tilt, so its SIGMA_A is larger than the noise."""
    flight, _ = made_flight(3, offset_s=0.1)
    found, without = horizontal(flight), horizontal(flight, imu=False)
    assert found.sigma_a.low <= 0.1 <= found.sigma_a.high
    assert found.sigma_z.low <= 0.1 <= found.sigma_z.high
    assert found.sigma_a_two_state.low > found.sigma_a.high
    # without fitted constants there is only KF's SIGMA_A
    assert without.sigma_a == without.sigma_a_two_state
    assert without.sigma_a.value == pytest.approx(found.sigma_a_two_state.value, rel=0.1)
    assert len(found.outlier_time_s) == 0
    assert found.noises.random_walk_m == 0.0


@pytest.mark.slow
def test_acceleration_noise_estimate_at_slow_motion_is_unbiased() -> None:
    """A scale signal that contains the noise would explain part of it (errors in variables)."""
    ratios = [
        horizontal(made_flight(seed, moving=0.1, sigma_a=0.5)[0]).noises.sigma_a_m_s2 / 0.5
        for seed in range(6)
    ]
    assert np.mean(ratios) == pytest.approx(1.0, abs=2.6 * np.std(ratios) / np.sqrt(len(ratios)))


def test_noise_fit_estimates_random_walk_of_drifting_source() -> None:
    """Add 0.1 m/√s, which would otherwise be estimated as acceleration noise."""
    flight, _ = made_flight(4, duration_s=90.0)
    track = flight.positions[0]
    steps = np.random.default_rng(4).normal(0.0, 0.1 * np.sqrt(0.2), (len(track.samples), 3))
    samples = track.samples.copy()
    samples[Columns.POSITION] += np.cumsum(steps, axis=0)
    drifting = replace(flight, positions=(replace(track, samples=samples),))
    with_walk, without_walk = horizontal(drifting, drifts=True), horizontal(drifting)
    assert with_walk.noises.random_walk_m == pytest.approx(0.1, rel=0.25)
    assert with_walk.noises.sigma_z_m == pytest.approx(0.1, rel=0.15)
    assert without_walk.noises.sigma_a_m_s2 > 1.5 * with_walk.noises.sigma_a_m_s2


# --- real and simulated logs ---


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (NoiseEstimate(None, None, None), "not identifiable"),
        (NoiseEstimate(None, None, 0.25), "at most 0.25 m"),
        (NoiseEstimate(None, 8.0, None), "at least 8 m"),
        (NoiseEstimate(0.1, None, 0.2), "0.1 m (95 % 0 to 0.2)"),
        (NoiseEstimate(0.1, 0.05, None), "0.1 m (95 % above 0.05)"),
    ],
)
def test_noise_estimate_is_printed_with_interval_or_bound(
    noise: NoiseEstimate, expected: str
) -> None:
    assert format_noise_estimate(noise, "m") == expected
