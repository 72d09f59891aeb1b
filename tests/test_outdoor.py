"""Outdoor flights: simulated GNSS against ground truth, EKF2, and the findings."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_tools import error_line, run_checked
from comparisons import compare
from ekf2_tools import opened
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.projection import project as project_state
from px4fuse.comparison.remedy import find_aid
from px4fuse.comparison.rerun_effects import (
    ROTATION_KEY,
    brings_inside_limits,
    compute_explained_fraction,
    find_cause_rerun,
    find_reruns,
)
from px4fuse.diagnose import diagnose_comparison
from px4fuse.ekf2.model import replay_with_settings
from px4fuse.ekf2.whatif import HEADING_LOGGED_NOTE, what_if
from px4fuse.errors import SettingsError
from px4fuse.filter.consistency import compute_nis_band
from px4fuse.filter.settings import Settings
from px4fuse.findings import find, source_clock
from px4fuse.flight.model import Columns
from px4fuse.readers import read_log
from px4fuse.readers.px4_positions import project, unproject
from px4fuse.simulation import sensors
from px4fuse.simulation.faults import FaultSizes, parse_faults
from px4fuse.simulation.flights import simulate, simulate_flight, to_ulog
from px4fuse.simulation.scenario import Scenario, make_scenario
from px4fuse.trajectory.rotation import interpolate, to_rotation_matrix

OUTDOOR = make_scenario("outdoor", seed=5)


@cache
def flown(*texts: str) -> Analysis:
    flight = simulate_flight(OUTDOOR, parse_faults(texts))
    return diagnose_comparison(compare(flight, Settings(0.27, 0.4)))


def roots(analysis: Analysis) -> list[str]:
    """Return the ids of findings above a note that no other finding causes."""
    return [item.id for item in find(analysis) if item.severity != "note" and not item.caused_by]


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-75.0, 75.0), st.floats(-180.0, 180.0))
def test_latitude_longitude_to_metres_and_back_is_exact(
    north_m: float, east_m: float, latitude_deg: float, longitude_deg: float
) -> None:
    origin = latitude_deg, longitude_deg
    there = unproject(np.array([north_m]), np.array([east_m]), origin)
    assert np.concatenate(project(*there, origin)) == pytest.approx([north_m, east_m], abs=1e-5)
    # on a sphere a degree of latitude has the same length everywhere
    north, _ = project(np.array([latitude_deg + 1.0]), np.array([longitude_deg]), origin)
    assert north[0] == pytest.approx(111_194.93, abs=0.01)


def test_simulated_gnss_fixes_have_configured_noise_and_delay(
    tmp_path: Path,
) -> None:
    simulation = simulate(make_scenario("outdoor", seed=2, passes=6))
    log = tmp_path / "outdoor.ulg"
    log.write_bytes(to_ulog(simulation))
    flight = read_log(log)
    track, truth = flight.positions[0], flight.truth
    assert (track.name, track.origin.is_gnss) == ("vehicle_gps_position", True)
    assert track.compute_rate_hz() == pytest.approx(5.0, rel=0.01)
    assert track.velocity is not None
    for measured, columns, sigma in (
        (track.samples, Columns.POSITION, 0.4),
        (track.velocity, Columns.VELOCITY, 0.3),
    ):
        for column, times in zip(columns, (1.0, 1.0, 1.5), strict=True):
            true = np.interp(measured.index, truth.samples.index, truth.samples[column])
            error = measured[column].to_numpy() - true
            assert error.std() == pytest.approx(times * sigma, rel=0.06)
            assert error.mean() == pytest.approx(0.0, abs=4 * times * sigma / len(error) ** 0.5)
    stated = track.samples[["north_m2", "east_m2", "down_m2"]].iloc[0]
    assert stated.to_numpy() == pytest.approx([0.16, 0.16, 0.36], rel=1e-5)


def test_simulated_magnetometer_and_height_noise_equal_settings(tmp_path: Path) -> None:
    """Includes EKF2's height, and its attitude published as vehicle_attitude."""
    log = tmp_path / "outdoor.ulg"
    log.write_bytes(to_ulog(simulate(OUTDOOR, parse_faults(["mag=0.3,60"]))))
    flight = read_log(log)
    truth, record = flight.truth.samples, flight.ekf2.record
    down = flight.barometer["down_m"] + sensors.HOME_POSITION[2]
    error = down.to_numpy() - np.interp(down.index, truth.index, truth["down_m"])
    assert error.std() == pytest.approx(0.4, rel=0.1)
    assert abs(error.mean()) < 4 * 0.4 / len(error) ** 0.5
    measured = record.magnetic_field_gauss
    true = interpolate(
        measured.index.to_numpy(), flight.truth.attitude.index.to_numpy(),
        flight.truth.attitude[Columns.QUATERNION].to_numpy(),
    )  # fmt: skip
    expected = np.einsum("nji,j->ni", to_rotation_matrix(true), sensors.EARTH_FIELD_GAUSS)
    off = measured.drop(columns="fused_3d").to_numpy() - expected
    before = measured.index < 60.0
    np.testing.assert_allclose(off[before].mean(axis=0), 0.0, atol=0.008)
    np.testing.assert_allclose(off[~before].mean(axis=0), [0.0, 0.3, 0.0], atol=0.008)
    np.testing.assert_allclose(off[before].std(axis=0), 0.02, rtol=0.2)
    height = record.delayed_state["down_m"].to_numpy()
    error = height - np.interp(record.delayed_state.index, truth.index, truth["down_m"])
    reported = float(np.sqrt(record.delayed_state["down_m2"].iloc[20:].mean()))
    assert error[20:].std() == pytest.approx(reported, rel=0.3)


def test_simulated_outdoor_flight_without_fault_is_consistent() -> None:
    analysis = flown()
    assert roots(analysis) == []
    for name, axes in {"gnss_pos": 2, "gnss_vel": 3}.items():
        aid = analysis.aids[name]
        assert (aid.verdict, len(aid.axes)) == ("consistent", axes)
        for axis in aid.axes.values():
            # simplifications of the model increase the NIS of GNSS velocity slightly
            low, high = compute_nis_band(axis.samples)
            assert low < axis.nis_mean < 1.05 * high
    height = analysis.aids["baro_hgt"]
    assert (height.verdict, height.rejected_fraction) == ("consistent", 0.0)
    # the simulated noise is 0.02 gauss, EKF2_MAG_NOISE 0.05
    field = analysis.aids["mag"].axes
    assert [axis.nis_mean for axis in field.values()] == pytest.approx([0.16] * 3, abs=0.05)
    model = analysis.ekf2_model
    assert find_aid(analysis).name == model.inputs.aid.name == "gnss_pos"
    assert model.agreement.good
    assert model.agreement.heading_rms_difference_deg < 0.5
    assert max(axis.position_rms_difference_m for axis in model.agreement.axes.values()) < 0.03
    for owner in ("kf", "ekf2"):
        statement = analysis.axes["north"].filters[owner]
        assert statement.truth.position_rmse_m < 0.25
        assert 0.5 < (statement.truth.nees_position_mean or 0.0) < 2.5


@pytest.mark.parametrize(
    ("mistake", "root"),
    [
        ("heading=-12", "ekf2_heading_error"),
        ("heading=25,40", "ekf2_heading_error"),
        ("clock-offset=0.25", "source_time_offset"),
        ("ekf2-delay=0", "source_time_offset"),
        ("r-scale=0.1", "ekf2_noise_too_small"),
        ("ekf2-gate=1", "ekf2_gate_too_small"),
        ("mag=0.2", "aid_innovation_shift"),
        ("slow-error=0.5,30", "source_noise_time_correlated"),
    ],
)
def test_simulated_outdoor_fault_is_reported_first(mistake: str, root: str) -> None:
    """Faults for which GNSS takes other branches in the findings than indoor positions."""
    assert roots(flown(mistake))[0] == root


@pytest.mark.parametrize(
    ("mistake", "of", "name", "value", "within"),
    [
        ("heading=20", "nees", ROTATION_KEY, 20.0, 3.0),
        ("clock-offset=-0.1", "nees", "EKF2_GPS_DELAY", 10.0, 60.0),
        ("r-scale=0.1", "nis", "EKF2_GPS_P_NOISE", 0.4, 0.02),
    ],
)
def test_ekf2_rerun_with_corrected_gnss_fault_is_consistent(
    mistake: str, of: Any, name: str, value: float, within: float
) -> None:
    analysis = flown(mistake)
    found = find_cause_rerun(analysis.reruns, "ekf2", "aisle", of)
    assert found.change[name] == pytest.approx(value, abs=within)
    assert brings_inside_limits(found, of)


def test_larger_ekf2_acc_noise_reduces_nees_under_vibration() -> None:
    """EKF2_ACC_NOISE corrects the filter, but the output predictor still integrates vibration."""
    analysis = flown("vibration=1")
    (tried,) = find_reruns(analysis.reruns, "ekf2", "aisle", "nees")
    assert tried.change == {"EKF2_ACC_NOISE": 1.0}
    assert brings_inside_limits(tried, "nees")
    assert compute_explained_fraction(tried, "nees") == pytest.approx(0.34, abs=0.05)
    assert find_cause_rerun(analysis.reruns, "ekf2", "aisle", "nees") is None
    before, after = tried.before.position_rmse_m, tried.after.position_rmse_m
    assert after == pytest.approx(0.8 * before, rel=0.05)
    # at the fusion horizon σ covers the error with this noise
    (replayed,) = replay_with_settings(analysis.ekf2_model, [dict(tried.change)])
    delayed_state = project_state(replayed.delayed_state, analysis.main.axis, analysis.segment)[
        "position_m"
    ]
    truth = analysis.main.truth["position_m"]
    error_m = delayed_state - np.interp(delayed_state.index, truth.index, truth, np.nan, np.nan)
    variances = (
        replayed.updates.filter(like="position_variance_")
        .filter(regex="north|east")
        .mean(axis=1)
        .mean()
    )
    assert np.nanmean(error_m**2) / variances < 1.5**2 < tried.after.nees_mean


def test_ekf2_replay_with_true_gnss_delay_has_fault_free_rmse() -> None:
    wrong, right = (flown(*texts).ekf2_model for texts in (("ekf2-delay=0",), ()))
    result, other = what_if(wrong, [{"EKF2_GPS_DELAY": 110.0}]), what_if(right, [])
    (predicted,), true = result.whatif, other.logged
    assert predicted.nis_mean == pytest.approx(true.nis_mean, rel=0.1)
    assert predicted.position_rmse_to_truth_m == pytest.approx(
        true.position_rmse_to_truth_m, rel=0.1
    )
    assert result.logged.position_rmse_to_truth_m > 1.4 * true.position_rmse_to_truth_m


def test_ekf2_replay_uses_logged_heading_if_mag_is_not_replayed(tmp_path: Path) -> None:
    log = tmp_path / "a.ulg"  # a log file has the true attitude, a flight in memory has not
    # with a heading fault EKF2 fuses the magnetic heading only
    log.write_bytes(to_ulog(simulate(OUTDOOR, parse_faults(["ekf2-delay=0", "heading=3"]))))
    model = opened(read_log(log))
    result = what_if(model, [{"EKF2_GPS_DELAY": 110.0}])
    assert result.notes[0] == HEADING_LOGGED_NOTE
    errors = [one.heading_error_mean_deg for one in (result.logged, *result.whatif)]
    assert errors[1] == pytest.approx(errors[0], abs=0.1)
    with pytest.raises(SettingsError, match="the log does not contain all magnetometer samples"):
        what_if(model, [{"EKF2_MAG_NOISE": 0.1}])


def test_time_offset_message_names_gnss_receiver_delay() -> None:
    analysis = flown("clock-offset=0.25")
    log = analysis.flight.log
    assert "SENS_GPS0_DELAY" not in next(source_clock.detect(analysis)).message
    since_v1_17 = structs.replace(log, parameters={**log.parameters, "SENS_GPS0_DELAY": 110.0})
    changed = replace(analysis, flight=replace(analysis.flight, log=since_v1_17))
    finding = next(source_clock.detect(changed))
    assert "SENS_GPS0_DELAY" in finding.remedy
    delays = re.search(r"is (\d+) ms; the estimate is (\d+) ms", finding.message)
    assumed_ms, estimate_ms = delays.groups()  # type: ignore[union-attr]
    assert int(assumed_ms) == 110
    assert int(estimate_ms) == pytest.approx(110 + 250, abs=60)


def test_magnetometer_shift_is_reported_as_cause_of_lost_fusion() -> None:
    changed, starved = [item for item in find(flown("mag=0.2")) if item.id.startswith("aid_")]
    assert (changed.id, starved.id) == ("aid_innovation_shift", "aid_not_fused")
    assert starved.caused_by == "aid_innovation_shift"
    assert "magnetometer" in changed.message
    # the middle of the flight
    assert changed.evidence["time_s"] == pytest.approx(67.0, abs=10.0)


def test_simulate_gnss_rejects_ekf2_noise_below_receiver_sigma() -> None:
    with pytest.raises(SettingsError, match=r"the larger of EKF2_GPS_P_NOISE .*0\.4 m"):
        simulate(OUTDOOR, parse_faults(["ekf2-noise=0.05"]))
    parameters = simulate(OUTDOOR, parse_faults(["ekf2-noise=0.8"])).parameters
    assert parameters["EKF2_GPS_P_NOISE"] == 0.8


def test_simulated_correlated_error_has_requested_sigma_and_tau() -> None:
    mistakes = FaultSizes(slow_error_m=0.5, slow_error_s=4.0)
    drawn = sensors.simulate_correlated_noise(OUTDOOR, mistakes, 100_000, 0.2)
    assert drawn.std(axis=0) == pytest.approx(0.5, rel=0.05)
    lag = int(4.0 / 0.2)
    after = np.mean(drawn[:-lag] * drawn[lag:], axis=0) / np.var(drawn, axis=0)
    assert after == pytest.approx(np.exp(-1.0), abs=0.05)
    # the first sample has the same σ
    first = [
        sensors.simulate_correlated_noise(Scenario(seed=s), mistakes, 2, 0.2)[0] for s in range(400)
    ]
    assert np.std(first) == pytest.approx(0.5, rel=0.1)


def test_simulated_heading_error_reaches_set_angle_exponentially() -> None:
    time_s = np.array([0.0, 39.9, 43.0, 100.0])
    clean = sensors.simulate_attitude_error(OUTDOOR, FaultSizes(), time_s).as_rotvec()
    wrong = sensors.simulate_attitude_error(
        OUTDOOR, parse_faults(["heading=25,40"]), time_s
    ).as_rotvec()
    turned = np.degrees(wrong - clean)[:, 2]
    assert turned == pytest.approx([0.0, 0.0, 25.0 * (1.0 - np.exp(-1.0)), 25.0], abs=0.01)


def test_simulate_outdoor_default_is_square_of_30_m_with_gnss(tmp_path: Path) -> None:
    arguments = "simulate", "--kind", "outdoor", "-o", tmp_path / "o.ulg"
    output = run_checked(*arguments, "--speed", "3").output
    assert "outdoor, square of 30 m, 3 times at 3 m/s" in output
    assert "GNSS, 0.4 m at 5 Hz" in output
    for more, expected in (
        (["--assignment", "r.csv"], "--kind outdoor"),
        (["--mistake", "yaw=10"], "--mistake yaw requires --kind aisle or loop"),
    ):
        assert expected in error_line(*arguments, *more)
