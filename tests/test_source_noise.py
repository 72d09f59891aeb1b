"""Noise of positions that is not white, equal and the same throughout: told apart, and by size."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import source_errors as errors
from exchange import replace
from filterpy.kalman import KalmanFilter
from scipy.interpolate import CubicSpline

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.comparison import compare
from px4fuse.filter import coloured as colours
from px4fuse.filter.coloured import Coloured
from px4fuse.filter.likelihood import preintegrate
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import Settings
from px4fuse.findings import Finding, find
from px4fuse.findings.causes import SETTINGS
from px4fuse.findings.source_noise import detect
from px4fuse.flight import POSITION_COLUMNS, Truth, Unavailable
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

RIGHT = Settings(0.27, 0.10)
NEW = {"source_coloured", "source_repeats", "source_axes_unequal", "source_noise_changes"}


@cache
def judged(model: errors.Model, rate_hz: float = 10.0, seed: int = 1) -> Analysis:
    """A simulated flight whose positions have errors of the study's models, without EKF2."""
    flight = simulate_flight(Scenario(seed=seed, passes=5, ekf2=False))
    assert isinstance(flight.truth, Truth)
    truth = flight.truth.samples[POSITION_COLUMNS].dropna()
    known = CubicSpline(truth.index.to_numpy(), truth.to_numpy())
    flight = errors.laid_over(flight, known, model, rate_hz, seed)
    return explain(compare(replace(flight, truth=Unavailable("truth", "", "")), RIGHT,
                           axes=("north", "east")))  # fmt: skip


def told(analysis: Analysis) -> dict[str, Finding]:
    """What is no information, no setting of ours, and follows from nothing else, by id."""
    left_out = SETTINGS | {"ekf2_unavailable"}
    return {
        one.id: one for one in find(analysis)
        if one.severity != "info" and one.caused_by is None and one.id not in left_out
    }  # fmt: skip


UNEQUAL = partial(errors.white, sigma=np.array([0.05, 0.2, 0.1]))
LOUD = partial(errors.two_levels, factor=3.0)
SLOW = partial(errors.coloured, tau_s=0.5, share=1.0)
MIXED = partial(errors.coloured, tau_s=0.3, share=0.5)
HELD, OFTEN_HELD = partial(errors.held, share=0.15), partial(errors.held, share=0.6)
SMOOTH = partial(errors.low_pass, tau_s=0.5)


@pytest.mark.parametrize("seed", range(1, 5))
def test_white_noise_is_no_other(seed: int) -> None:
    analysis = judged(errors.white, seed=seed)
    assert told(analysis) == {}
    assert list(detect(analysis)) == []
    assert isinstance(analysis.coloured, Unavailable)  # not even looked for


@pytest.mark.parametrize(
    ("model", "name", "severity", "evidence"),
    [
        (SLOW, "source_coloured", "error",  # as what it brings with it
         {"tau_s": (0.5, 0.35), "slow_m": (0.1, 0.03), "white_m": (0.0, 0.04)}),
        (MIXED, "source_coloured", "warning", {"slow_m": (0.07, 0.03), "white_m": (0.07, 0.02)}),
        (HELD, "source_repeats", "warning", {"share": (0.15, 0.03)}),
        (OFTEN_HELD, "source_repeats", "error", {"share": (0.6, 0.05)}),
        (UNEQUAL, "source_axes_unequal", "error",
         {"north_sigma_z_m": (0.05, 0.01), "east_sigma_z_m": (0.2, 0.02)}),
        (LOUD, "source_noise_changes", "error", {"ratio": (2.7, 0.4)}),
        (partial(errors.two_levels, factor=6.0), "source_noise_changes", "error",
         {"ratio": (6.0, 1.3)}),
    ],
)  # fmt: skip
def test_each_is_named_with_its_size_and_nothing_else(
    model: errors.Model, name: str, severity: str, evidence: Mapping[str, tuple[float, float]]
) -> None:
    found = told(judged(model))
    assert set(found) == {name}
    assert found[name].severity == severity
    for key, (value, within) in evidence.items():
        assert found[name].evidence[key] == pytest.approx(value, abs=within)


def test_the_noisy_part_is_where_it_was() -> None:
    analysis = judged(LOUD)
    ((start, end),) = told(analysis)["source_noise_changes"].spans_s
    time = analysis.axes["north"].axis.measurement_time_s
    third = (time[-1] - time[0]) / 3.0
    assert start == pytest.approx(time[0] + third, abs=third / 3.0)
    assert end == pytest.approx(time[0] + 2.0 * third, abs=third / 3.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_slow_error_is_no_low_pass_and_a_low_pass_no_slow_error(seed: int) -> None:
    slow, smooth = judged(SLOW, seed=seed), judged(SMOOTH, seed=seed)
    assert "source_smoothed" not in {one.id for one in find(slow)}
    assert "source_coloured" not in {one.id for one in find(smooth)}
    assert "source_smoothed" in told(smooth)
    for analysis, lags in ((slow, False), (smooth, True)):
        found = analysis.coloured
        assert isinstance(found, Coloured)
        assert found.gain_nats > 30.0
        assert (found.lag_nats > 4.0) == lags
        assert 0.5 < found.share <= 1.0


def test_outliers_and_a_jump_are_none_of_them() -> None:
    for model, name in (
        (partial(errors.with_outliers, share=0.05), "source_outliers"),
        (partial(errors.jumped, size=1.0), "source_jumps"),
        (partial(errors.clock, late=0.3), "source_clock_offset"),
    ):
        found = told(judged(model))
        assert name in found
        assert not NEW & set(found)


def test_the_likelihood_is_that_of_a_filter_of_three_states() -> None:
    """Against filterpy, measurement by measurement."""
    axis = judged(MIXED).axes["north"].axis
    axis = replace(axis, measurement_time_s=axis.measurement_time_s[:60],
                   measurement_m=axis.measurement_m[:60])  # fmt: skip
    legs = preintegrate(axis, RIGHT)
    skip = np.zeros(60, bool)
    skip[[20, 21, 40]] = True
    sigma_a, white, slow, tau = 0.3, 0.06, 0.09, 0.7
    ours = colours._slow_score([legs], skip, *(np.array([x]) for x in (sigma_a, white, slow, tau)))
    kf = KalmanFilter(dim_x=3, dim_z=1, dim_u=2)
    a, b, d = INITIAL_COVARIANCE
    kf.x = np.array([[legs.initial.position_m], [legs.initial.velocity_m_s], [0.0]])
    kf.P = np.array([[a, b, 0.0], [b, d, 0.0], [0.0, 0.0, slow**2]])
    kf.H, kf.R = np.array([[1.0, 0.0, 1.0]]), np.array([[white**2]])
    kf.B = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    total = 0.0
    for k in range(len(legs.length_s)):
        dt, rho = legs.length_s[k], np.exp(-legs.length_s[k] / tau)
        kf.F = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, rho]])
        q00, q01, q11 = sigma_a**2 * legs.noise_unit[k] + legs.noise_fixed[k]
        slow_q = slow**2 * (1.0 - rho**2)
        kf.Q = np.array([[q00, q01, 0.0], [q01, q11, 0.0], [0.0, 0.0, slow_q]])
        kf.predict(np.array([[legs.delta_position_m[k]], [legs.delta_velocity_m_s[k]]]))
        if not skip[-len(legs.length_s) :][k]:
            kf.update(legs.measurement_m[k])
            total += 0.5 * float(np.log(kf.S[0, 0]) + kf.y[0, 0] ** 2 / kf.S[0, 0])
    assert ours == pytest.approx([total], abs=1e-8)


def test_too_few_and_no_imu_are_said() -> None:
    axis: Any = judged(MIXED).axes["north"].axis
    given = {"sigma_a_m_s2": 0.3, "sigma_z_m": 0.1, "outlier_time_s": np.array([]), "lag_s": 0.2}
    few = replace(axis, measurement_time_s=axis.measurement_time_s[:99],
                  measurement_m=axis.measurement_m[:99])  # fmt: skip
    found = colours.coloured((few,), RIGHT, **given)
    assert isinstance(found, Unavailable)
    assert "99" in found.reason
    blind = replace(axis, acceleration=Unavailable("acceleration", "no IMU", ""))
    assert colours.coloured((blind,), RIGHT, **given) == blind.acceleration
