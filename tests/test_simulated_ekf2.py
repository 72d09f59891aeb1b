"""EKF2 of simulated flights against ground truth and its replay, and in the findings."""

import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from exchange import replace
from flights import unexplained
from scipy.spatial.transform import Rotation

from px4fuse.diagnose import diagnose_comparison
from px4fuse.ekf2.inputs import SIMULATED_EKF2_NOTE
from px4fuse.ekf2.model import prepare_ekf2_model
from px4fuse.ekf2.replay import ReplayAgreement
from px4fuse.filter.consistency import compute_nis_band
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.readers.px4_ekf2 import compute_samples_per_step
from px4fuse.simulation import ekf2, sensors
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate, simulate_flight, to_ulog
from px4fuse.simulation.scenario import Scenario

AISLE = Scenario(passes=3, seed=5)
RIGHT = Settings(sigma_a_m_s2=0.27, sigma_z_m=0.10)


def flown(*texts: str, scenario: Scenario = AISLE) -> Flight:
    return simulate_flight(scenario, parse_faults(texts))


def fused(flight: Flight, axis: str = "north") -> pd.DataFrame:
    """Return innovations while airborne."""
    frame = flight.ekf2.innovations[axis]
    start, end = flight.airborne[0]
    return frame.loc[start:end]


def agreement(flight: Flight) -> ReplayAgreement:
    model = prepare_ekf2_model(flight)
    return model.agreement


def rmse(flight: Flight, start_s: float, end_s: float, column: str = "north_m") -> float:
    """Return the RMSE of the published position."""
    track, truth = flight.ekf2.state.loc[start_s:end_s, column], flight.truth.samples[column]
    return float(np.sqrt(np.mean((track - np.interp(track.index, truth.index, truth)) ** 2)))


def named(flight: Flight) -> set[str]:
    compared = compare(flight, RIGHT, axes=("north", "east"))
    return {finding.id for finding in find(unexplained(compared))}


@pytest.fixture(scope="module")
def clean() -> Flight:
    return flown()


# --- the model from take-off on


def test_simulated_ekf2_of_clean_flight_agrees_with_replay(clean):
    found = agreement(clean)
    assert found.good
    assert found.decisions_same == 1.0
    for axis in found.ev_pos.values():
        assert axis.innovation_correlation > 0.999
        assert axis.s_ratio_median == pytest.approx(1.0, abs=0.01)
        assert (axis.s_ratio_p5, axis.s_ratio_p95) == pytest.approx((1.0, 1.0), abs=0.01)
        assert axis.position_rms_difference_m < 0.012
        assert axis.velocity_rms_difference_m_s < 0.03  # vehicle_attitude is not that of EKF2


@pytest.mark.parametrize(("texts", "scenario"), [
    (("nlos=5%",), AISLE),
    (("ekf2-delay=175ms",), AISLE),
    ((), Scenario(kind="loop", passes=1, seed=5)),
], ids=["outliers", "delay", "loop"])  # fmt: skip
def test_simulated_ekf2_with_faults_agrees_with_replay(texts, scenario):
    found = agreement(flown(*texts, scenario=scenario))
    assert found.good
    assert found.decisions_same > 0.99
    for axis in found.ev_pos.values():
        assert axis.innovation_correlation > 0.99
        assert axis.s_ratio_median == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_simulated_ekf2_of_clean_flights_is_consistent():
    values, inside, errors, stated = [], [], [], []
    for seed in range(8):
        flight = flown(scenario=Scenario(passes=2, seed=seed))
        for axis in ("north", "east"):
            frame = fused(flight, axis)
            nis = frame["innovation_m"] ** 2 / frame["innovation_variance_m2"]
            low, high = compute_nis_band(len(frame))
            values.append(float(nis.mean()))
            inside.append(low < values[-1] < high)
            errors.append(rmse(flight, 10.0, 50.0, f"{axis}_m"))
        variance = flight.ekf2.variance
        stated.append(float(np.sqrt(variance["north_m2"].median())))
    # EKF2 treats the 1° heading error as white noise
    assert np.mean(values) == pytest.approx(1.0, abs=0.08)
    assert np.mean(inside) >= 0.85
    assert np.max(errors) < 0.14  # m; UWB noise is 0.10 m, and EKF2 predicts 0.23 s ahead
    assert np.median(stated) == pytest.approx(0.06, abs=0.01)


def test_simulated_ekf2_is_consistent_at_its_fusion_horizon(clean):
    """Position and velocity at the fusion horizon, their variances, and the estimated biases."""
    record, truth = clean.ekf2.record, clean.truth.samples
    later = record.delayed_state[record.delayed_state.index > 15.0]
    error = later["north_m_s"] - np.interp(later.index, truth.index, truth["north_m_s"])
    assert 0.5 < np.mean(error**2 / later["north_m2_s2"]) < 2.5
    bias, gyro_bias = sensors.draw_imu_biases(AISLE, parse_faults([]))
    last = later.iloc[-1]
    names = [f"gyro_bias_{axis}_rad_s" for axis in ("forward", "right")]
    assert last[names].to_numpy(float) == pytest.approx(gyro_bias[:2], abs=0.002)
    assert last["accelerometer_bias_down_m_s2"] == pytest.approx(bias[2], abs=0.05)


def test_simulated_ekf2_at_rest_estimates_level_attitude():
    tilt = Rotation.from_euler("x", 0.1).as_matrix()
    gravity = np.array([0.0, 0.0, 9.80665])
    bias, rate = np.array([0.03, -0.02, 0.05]), np.array([0.002, -0.001, 0.003])
    x, P = ekf2._compute_state_at_rest(tilt, tilt.T @ -gravity + bias, rate, 0.01)
    assert x[9:12] == pytest.approx(rate, rel=1e-3)
    # the remaining horizontal bias is compensated by a tilt
    force = tilt @ (tilt.T @ -gravity + bias - x[12:15])
    assert np.cross(x[:3], force) + force == pytest.approx(-gravity, abs=0.01)
    assert x[14] == pytest.approx(bias[2], abs=0.01)
    deviation = np.sqrt(np.diag(P))
    assert deviation[0] * 9.80665 == pytest.approx(0.2, rel=0.1)
    assert abs(P[0, 13]) / deviation[0] / deviation[13] > 0.95


def test_simulated_ekf2_stops_fusing_a_slow_source():
    slow = flown("decimate=2Hz")
    fusing = slow.ekf2.fusion_flags
    assert not fusing["horizontal"].any()
    assert "ekf2_not_fusing" in named(slow)
    # EKF2 holds its position instead of drifting on the IMU
    assert slow.ekf2.state[["north_m", "east_m"]].abs().max().max() < 5.0
    gap = flown("dropout=8s,30s")
    fusing = gap.ekf2.fusion_flags
    off = fusing[fusing["horizontal"] == 0.0].loc[28.0:39.0]
    assert off.index[0] == pytest.approx(30.4, abs=0.3)
    resets = [reset for reset in gap.ekf2.resets if reset.time_s > 10.0]
    assert len(resets) == 1
    assert 38.2 < resets[0].time_s < 39.2
    # the step of the published position equals the logged reset
    state = gap.ekf2.state["north_m"]
    at = int(np.searchsorted(state.index, resets[0].time_s))
    moved = state.iloc[at] - state.iloc[at - 1]
    assert moved == pytest.approx(resets[0].delta[0], abs=0.3)


def test_simulated_ekf2_does_not_fuse_late_samples():
    early = flown("clock-offset=-350ms")
    compared = compare(early, RIGHT, axes=("north",))
    (finding,) = (f for f in find(unexplained(compared)) if f.id == "ekf2_not_fusing")
    assert "0.38 s" in finding.message
    assert "0.23 s" in finding.message
    assert "EKF2_DELAY_MAX" in finding.remedy


def test_imu_samples_per_ekf2_step_are_rounded_to_nearest():
    found = [compute_samples_per_step(0.01, t) for t in (0.00375, 0.004, 0.005, 0.0021, 0.05)]
    assert found == [3, 3, 2, 5, 1]
    # a median of timestamps is never exactly 4 ms
    assert (
        compute_samples_per_step(0.01, 0.004 + 1e-12)
        == compute_samples_per_step(0.01, 0.004 - 1e-12)
        == 3
    )


def test_imu_samples_per_ekf2_step_are_2_or_3_as_in_the_log():
    """EKF2 rounds a measured mean: 2.5 samples become two or three."""
    by_two, by_three = 2 * np.arange(0, 60, 7), 3 * np.arange(0, 60, 7)
    ends = by_two, by_three, [5], [0, 25, 50]
    assert [compute_samples_per_step(0.01, 0.004, each) for each in ends] == [2, 3, 3, 3]
    # IMU dropouts change single steps
    assert compute_samples_per_step(0.01, 0.004, np.append(3 * np.arange(30), [91])) == 3
    # the log is not used if the ratio is not close to a half
    assert compute_samples_per_step(0.01, 0.00375, by_two) == 3


def test_simulated_ekf2_ignores_samples_with_older_timestamps():
    simulation = simulate(Scenario(passes=4, seed=5), parse_faults(["clock-jump=400ms"]))
    topics = {topic.name: topic.fields for topic in simulation.topics}
    sent = topics["vehicle_visual_odometry"]["timestamp_sample"].astype(np.int64)
    taken = topics["estimator_aid_src_ev_pos"]["timestamp_sample"].astype(np.int64)
    assert np.any(np.diff(sent) < 0)
    assert np.all(np.diff(taken) > 0)
    rows = ekf2._select_accepted_positions(simulation.positions)
    assert len(rows.timestamp_s) < len(sent)
    assert np.all(np.diff(rows.timestamp_s) > 0)


# --- faults in EKF2 parameters


@pytest.mark.slow
def test_simulated_ekf2_holds_position_if_fusion_is_disabled(clean):
    flight = flown("ekf2-off")
    assert flight.log.parameters["EKF2_EV_CTRL"] == 0.0
    assert flight.ekf2.fusion_flags["horizontal"].max() == 0.0
    assert clean.ekf2.fusion_flags["horizontal"].max() == 1.0
    # as in PX4, samples are compared with the state but not fused
    record, plain = flight.ekf2.record, clean.ekf2.record
    assert len(record.vision_age_s) == len(plain.vision_age_s)
    # EKF2 holds its position after 5 s, while the vehicle flies 12 m back and forth
    assert rmse(flight, 10.0, 50.0) > 2.0 > 10.0 * rmse(clean, 10.0, 50.0)
    (finding,) = (
        item
        for item in diagnose_comparison(compare(flight, RIGHT)).findings
        if item.id == "ekf2_not_fusing"
    )
    assert "EKF2_EV_CTRL" in finding.message


@pytest.mark.slow
def test_unfused_innovation_is_estimated_minus_measured_position():
    simulation = simulate(AISLE, parse_faults(["ekf2-off"]))
    topics = {topic.name: topic.fields for topic in simulation.topics}
    innovations, published = topics["estimator_aid_src_ev_pos"], topics["vehicle_local_position"]
    assert not innovations["fused"].any()
    for column, name in enumerate("xy"):
        times_us = (each["timestamp_sample"].astype(float) for each in (innovations, published))
        estimated_m = np.interp(*times_us, published[name])
        difference_m = innovations["innovation"][:, column] - (
            estimated_m - innovations["observation"][:, column]
        )
        # the published position is ahead of the fusion horizon
        assert np.median(np.abs(difference_m)) < 0.05


# --- the log


def test_simulated_log_has_note_that_ekf2_is_simulated(clean, tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(to_ulog(simulate(AISLE)))
    assert read_log(path).log.notes == clean.log.notes == (SIMULATED_EKF2_NOTE,)
    assert "ekf2_simulated" in named(clean)
    path.write_bytes(to_ulog(simulate(replace(AISLE, ekf2=False))))
    flight = read_log(path)
    assert isinstance(flight.ekf2, Unavailable)
    assert "EKF2_EN is 0" in flight.ekf2.reason
    assert flight.log.notes == ()
    assert b"model of EKF2" not in path.read_bytes()
