"""KF and its formulas against a recursion in plain Python, as in the lesson."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from filter_tools import any_axis, any_settings
from flights import line
from hypothesis import given, settings
from hypothesis import strategies as st

from px4fuse.errors import SettingsError
from px4fuse.filter import model
from px4fuse.filter.kalman import UPDATE_TABLE_COLUMNS, predict_track, run_kf
from px4fuse.filter.model import COVARIANCE_COLUMNS, STATE_COLUMNS
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis

SAME_TIME_S = 5e-7
STATE = STATE_COLUMNS + COVARIANCE_COLUMNS


def steps_of(measured: Sequence[float], dt: float) -> list[float]:
    """Return the DT grid from the first measurement, with all measurement times."""
    kept = list(measured)
    for k in range(math.floor((measured[-1] - measured[0]) / dt + 1e-6) + 1):
        time = measured[0] + k * dt
        at = bisect_right(measured, time)
        near = measured[max(at - 1, 0) : at + 1]
        if min(abs(time - other) for other in near) > SAME_TIME_S:
            kept.append(time)
    return sorted(kept)


def plain_replay(axis: Axis, chosen: Settings) -> tuple[list[list[float]], list[list[float]]]:
    """The lesson's loop with an input and with Q(dt) = SIGMA_A² DT [[dt³/4, dt²/2], [dt²/2, dt]].

    Returns the state after each step (p, v, P00, P01, P11) and, per update, a row of UPDATES.
    """
    measured = axis.measurement_time_s.tolist()
    z_at = dict(zip(measured, axis.measurement_m.tolist(), strict=True))
    steps = steps_of(measured, chosen.dt_s)
    if chosen.input == "imu":
        imu = (
            axis.acceleration.time_s,
            axis.acceleration.compute_velocity_change_m_s(axis.direction),
        )
    q, r = chosen.sigma_a_m_s2**2 * chosen.dt_s, chosen.sigma_z_m**2
    x = [z_at[measured[0]], 0.0]
    P = [[0.5**2, 0.0], [0.0, 1.0**2]]
    states, updates = [[*x, P[0][0], P[0][1], P[1][1]]], []
    for before, now in pairwise(steps):
        dt = now - before
        a = np.diff(np.interp([before, now], *imu))[0] / dt if chosen.input == "imu" else 0.0
        x = [x[0] + dt * x[1] + dt * dt / 2 * a, x[1] + dt * a]
        P = [
            [
                P[0][0] + dt * (P[1][0] + P[0][1]) + dt * dt * P[1][1] + q * dt**3 / 4,
                P[0][1] + dt * P[1][1] + q * dt**2 / 2,
            ],
            [P[1][0] + dt * P[1][1] + q * dt**2 / 2, P[1][1] + q * dt],
        ]
        if now in z_at:
            s = P[0][0] + r
            k = [P[0][0] / s, P[1][0] / s]
            nu = z_at[now] - x[0]
            updates.append([z_at[now], nu, s, *k, x[0], P[0][0], P[1][1]])
            x = [x[0] + k[0] * nu, x[1] + k[1] * nu]
            P = [[r * P[0][0] / s, r * P[0][1] / s], [r * P[1][0] / s, P[1][1] - k[1] * P[0][1]]]
        states.append([*x, P[0][0], P[0][1], P[1][1]])
    return states, updates


@pytest.fixture
def axis() -> Axis:
    """Twenty measurements at 4 Hz on a constant acceleration of 0.3 m/s²."""
    time = 2.0 + 0.25 * np.arange(20)
    imu = np.arange(1.5, 7.5, 0.02)
    return line(time, 0.15 * (time - 2.0) ** 2, (imu, np.full(len(imu), 0.3)))


@settings(max_examples=60)
@given(axis=any_axis(), chosen=any_settings)
def test_kf_replay_of_any_axis_equals_textbook_recursion(axis: Axis, chosen: Settings) -> None:
    run = run_kf(axis, chosen)
    states, updates = plain_replay(axis, chosen)
    np.testing.assert_allclose(run.steps[STATE], states, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.updates[UPDATE_TABLE_COLUMNS], updates, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["sigma_a_m_s2", "sigma_z_m", "dt_s", "clock_offset_s"])
def test_kf_settings_out_of_range_are_rejected(name: str) -> None:
    for value in (-11.0, 1e300, math.nan, math.inf, *([] if name[0] == "c" else [0.0, 1e-300])):
        with pytest.raises(SettingsError, match=rf"^`{name}` \S+ is out of range: give .+\.$"):
            Settings(**{name: value})


def test_kf_replay_with_imu_input_but_no_imu_is_rejected() -> None:
    with pytest.raises(SettingsError, match="`input` is imu, but the axis"):
        run_kf(line([0.0, 0.2, 0.4], [0.0, 0.0, 0.0]), Settings(input="imu"))


def test_kf_replay_starts_at_first_measurement(axis: Axis) -> None:
    run = run_kf(axis, Settings())
    assert run.steps.index[0] == axis.measurement_time_s[0]
    assert run.steps[STATE].iloc[0].tolist() == [axis.measurement_m[0], 0.0, 0.25, 0.0, 1.0]
    assert run.updates.index.tolist() == axis.measurement_time_s[1:].tolist()


def test_kf_state_between_steps_is_predicted_from_previous_step(axis: Axis) -> None:
    """At a step the state is that of the step, between two predicted, outside NaN."""
    run = run_kf(axis, Settings())
    edges = run.steps.index.to_numpy()
    np.testing.assert_array_equal(predict_track(run, edges), run.steps[STATE])
    step = run.steps.iloc[30]
    track = predict_track(run, edges[[30]] + 0.01)
    expected = step["position_m"] + 0.01 * step["velocity_m_s"] + 0.5 * 0.01**2 * 0.3
    assert track["position_m"].item() == pytest.approx(expected, abs=1e-12)
    expected = step["velocity_m_s"] + 0.01 * 0.3
    assert track["velocity_m_s"].item() == pytest.approx(expected, abs=1e-12)
    around = np.array([edges[0] - 0.01, edges[0], edges[-1], edges[-1] + 0.01])
    for _, part in predict_track(run, around).items():
        assert np.isnan(part).tolist() == [True, False, False, True]


@pytest.mark.parametrize("dt", [0.02, 0.1, 0.4])
@pytest.mark.parametrize("gap", [False, True])
def test_kf_variance_between_steps_is_predicted_from_previous(dt: float, gap: bool) -> None:
    """P = FPFᵀ + Q in matrix form, at several points of every step, with and without a gap."""
    time = 0.37 * np.arange(12)
    imu = np.arange(0.0, 5.0, 0.02)
    imu = imu[(imu < 1.0) | (imu > 2.5)] if gap else imu
    chosen = Settings(sigma_a_m_s2=0.7, sigma_z_m=0.2, dt_s=dt)
    run = run_kf(line(time, np.sin(time), (imu, 2.0 * np.cos(imu))), chosen)
    edges = run.steps.index.to_numpy()
    for share in (0.0, 0.3, 0.9):
        times = edges[:-1] + share * np.diff(edges)
        track = predict_track(run, times)
        for k, at in enumerate(times):
            step = run.steps.iloc[k]
            ahead = at - edges[k]
            P = model.make_symmetric_matrix(step[COVARIANCE_COLUMNS])
            F = np.array([[1.0, ahead], [0.0, 1.0]])
            q = (0.7**2 + step["imu_gap_variance_m2_s4"]) * dt
            Q = q * np.array([[ahead**3 / 4.0, ahead**2 / 2.0], [ahead**2 / 2.0, ahead]])
            found = model.make_symmetric_matrix(track.iloc[k][COVARIANCE_COLUMNS])
            np.testing.assert_allclose(found, F @ P @ F.T + Q, rtol=1e-12)
    assert bool((run.steps["imu_gap_variance_m2_s4"] > 0.0).any()) == gap


@settings(max_examples=30)
@given(axis=any_axis(), chosen=any_settings, data=st.data())
def test_kf_state_does_not_depend_on_later_measurements(axis, chosen, data) -> None:
    changed = data.draw(st.integers(1, len(axis.measurement_m) - 1))
    arrival = axis.measurement_time_s[changed]
    measured = axis.measurement_m.copy()
    measured[changed] += 100.0
    other = replace(axis, measurement_m=measured)
    times = np.append(np.linspace(axis.measurement_time_s[0], arrival - 1e-9, 50), arrival)

    before, after = (predict_track(run_kf(one, chosen), times) for one in (axis, other))
    np.testing.assert_array_equal(before[:-1], after[:-1])
    assert abs(after["position_m"].iloc[-1] - before["position_m"].iloc[-1]) > 0.0


def test_kf_replay_adds_process_noise_during_imu_gap() -> None:
    time = 0.5 * np.arange(21)
    imu = np.arange(0.0, 10.001, 0.02)
    value = 2.0 * np.sin(imu)
    outside_gap = (imu <= 4.0) | (imu >= 5.0)
    chosen = Settings()
    whole = run_kf(line(time, 0.0 * time, (imu, value)), chosen)
    broken_axis = line(time, 0.0 * time, (imu[outside_gap], value[outside_gap]))
    broken = run_kf(broken_axis, chosen)
    assert whole.input_gap_s == 0.0
    assert broken.input_gap_s == pytest.approx(1.0, abs=1e-6)
    mean_square = np.mean(value[outside_gap] ** 2)
    at = broken.steps.index.searchsorted([4.09, 4.19])
    before, after = broken.steps["velocity_variance_m2_s2"].iloc[at]
    # the gap between two measurements lasts 0.5 s, five times DT, with persistent acceleration
    assert after - before == pytest.approx((0.5**2 + 5.0 * mean_square) * 0.1 * 0.1, rel=1e-6)
    at = whole.steps.index[(whole.steps.index > 4.05) & (whole.steps.index < 4.95)]
    raised = broken.steps.loc[at, "position_variance_m2"]
    assert np.all(raised > whole.steps.loc[at, "position_variance_m2"])


def test_kf_fast_replay_equals_replay_with_filterpy(axis: Axis) -> None:
    chosen = Settings(sigma_a_m_s2=0.7, sigma_z_m=0.2)
    with_filterpy, fast = run_kf(axis, chosen), run_kf(axis, chosen, fast=True)
    for name in ("steps", "updates"):
        expected, actual = getattr(with_filterpy, name), getattr(fast, name)
        pd.testing.assert_frame_equal(actual, expected, rtol=1e-9)


# ---- formulas by elements against their matrices ----

P = (0.5, -0.2, 0.7)


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.7])
def test_kf_prediction_formulas_equal_matrix_products(dt: float) -> None:
    f, b = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2.0], [dt]])
    propagate_covariance = f @ model.make_symmetric_matrix(P) @ f.T
    np.testing.assert_allclose(
        model.make_symmetric_matrix(model.propagate_covariance(P, dt)),
        propagate_covariance,
        rtol=1e-14,
    )
    x = np.array([[1.5], [-2.0]])
    moved = f @ x + b * 3.0
    np.testing.assert_allclose(model.propagate_state(1.5, -2.0, 3.0, dt), moved[:, 0], rtol=1e-14)
    # Q = B Bᵀ / dt: the acceleration is constant over the step
    np.testing.assert_allclose(
        model.make_symmetric_matrix(model.compute_unit_density_process_noise(dt)),
        b @ b.T / dt,
        rtol=1e-14,
    )


def test_kf_process_noise_sum_of_short_steps_equals_closed_form() -> None:
    count, total = 10_000, 0.7
    dt = total / count
    covariance = (0.0, 0.0, 0.0)
    for _ in range(count):
        propagate_covariance, added = (
            model.propagate_covariance(covariance, dt),
            model.compute_unit_density_process_noise(dt),
        )
        covariance = tuple(a + b for a, b in zip(propagate_covariance, added, strict=True))
    np.testing.assert_allclose(
        covariance, model.compute_continuous_unit_density_process_noise(total), rtol=1e-7
    )
