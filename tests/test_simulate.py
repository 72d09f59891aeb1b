"""Simulated flights against ground truth: motion, sensors, faults, ULog and command."""

import json
from dataclasses import fields

import numpy as np
import pandas as pd
import pytest
from cli_tools import run_checked
from comparisons import compare
from exchange import replace
from flights import unexplained
from scipy.integrate import cumulative_simpson
from scipy.spatial.transform import Rotation

import px4fuse
from px4fuse.errors import SettingsError
from px4fuse.filter.consistency import compute_nis_band
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Segment,
    compute_mean_step_acceleration,
    integrate_ned_acceleration,
    make_axes,
)
from px4fuse.findings import find
from px4fuse.flight.model import Columns
from px4fuse.simulation import sensors
from px4fuse.simulation.faults import (
    FAULT_TYPES,
    FaultSizes,
    format_fault,
    injected_fault_names,
    parse_faults,
)
from px4fuse.simulation.flights import (
    make_answer_key,
    simulate,
    simulate_flight,
    to_flight,
    to_ulog,
)
from px4fuse.simulation.motion import compute_attitude_and_imu, compute_direction, plan_flight
from px4fuse.simulation.scenario import DT_S, Scenario, collect_field_bounds

NO_FAULTS = FaultSizes()
AISLE = Scenario(passes=2, seed=4)
UNFILTERED = replace(AISLE, ekf2=False)
LOOP = Scenario(kind="loop", passes=1, length_m=8.0, seed=4)
FOLLOWING = Scenario(passes=2, yaw="follow", seed=4)
# no sensor errors except white noise
IDEAL = {
    "accel_bias_sigma_m_s2": 0.0, "gyro_bias_sigma_rad_s": 0.0, "tilt_error_deg": 0.0,
    "yaw_error_deg": 0.0,
}  # fmt: skip


def test_each_simulated_fault_size_has_limits() -> None:
    numbers = {item.name for item in fields(FaultSizes) if "float" in str(item.type)}
    assert set(collect_field_bounds(FaultSizes)) == numbers


def motion_of(scenario, mistakes=NO_FAULTS):
    return plan_flight(
        scenario,
        mistakes,
        sensors.make_random_generator(scenario, sensors.RandomStream.PATH_DEVIATION),
    )


def position_errors_m(simulation):
    positions = simulation.positions
    return (
        positions.position_m
        - simulation.motion.compute_true_state(positions.measurement_times_s).position_m
    )


def stamps_s(simulation):
    source = simulation.positions.topic.fields
    return (source["timestamp_sample"].astype(np.int64) - sensors.FIRST_TIMESTAMP_US) * 1e-6


# --- motion


@pytest.mark.parametrize("scenario", [AISLE, LOOP, FOLLOWING], ids=["aisle", "loop", "follow"])
class TestMotion:
    def test_simulated_velocity_integrates_to_position(self, scenario):
        motion = motion_of(scenario)
        time = np.linspace(0.0, motion.duration_s, 40_001)
        state = motion.compute_true_state(time)
        for value, derivative, tolerance in (
            (state.position_m, state.velocity_m_s, 1e-6),
            (state.velocity_m_s, state.acceleration_m_s2, 1e-6),
            # the jerk has steps at the ends of the fade of the slow deviation
            (state.acceleration_m_s2, state.jerk_m_s3, 1e-3),
        ):
            integral = value[0] + cumulative_simpson(derivative, x=time, axis=0, initial=0)
            assert np.max(np.abs(integral - value)) < tolerance
        turned = cumulative_simpson(state.yaw_rate_rad_s, x=time, initial=0)
        assert np.allclose(state.yaw_rad, state.yaw_rad[0] + turned, atol=1e-6)

    def test_simulated_flight_starts_and_ends_at_rest_on_ground(self, scenario):
        motion = motion_of(scenario)
        time = np.array([0.0, motion.take_off_s, motion.touch_down_s + 1e-6, motion.duration_s])
        state = motion.compute_true_state(time)
        assert np.allclose(state.velocity_m_s, 0.0, atol=1e-9)
        assert np.allclose(state.acceleration_m_s2, 0.0, atol=1e-9)
        assert np.allclose(state.position_m[:, 2], 0.0, atol=1e-9)

    def test_simulated_attitude_matches_acceleration_and_rates(self, scenario):
        motion = motion_of(scenario)
        # the jerk has small steps at the ends of the fade
        time = np.linspace(0.0, motion.duration_s, 20_001)
        step = 1e-4
        before, here, after = (
            compute_attitude_and_imu(motion.compute_true_state(time + s))
            for s in (-step, 0.0, step)
        )
        force = np.einsum("nij,nj->ni", here.body_to_ned, here.specific_force_m_s2)
        force[:, 2] += 9.80665
        assert np.allclose(force, motion.compute_true_state(time).acceleration_m_s2, atol=1e-9)
        turn = np.swapaxes(before.body_to_ned, 1, 2) @ after.body_to_ned
        rate = Rotation.from_matrix(turn).as_rotvec() / (2 * step)
        error = np.abs(rate - here.angular_rate_rad_s)
        assert np.quantile(error, 0.999) < 1e-5
        assert error.max() < 0.01


@pytest.mark.parametrize(("left_out", "texts"), [(0.0, []), (2.5, ["open-end=2.5m"])])
def test_simulated_open_loop_has_requested_closure_error(left_out, texts):
    scenario = replace(LOOP, passes=2)
    flown = simulate(scenario, parse_faults(texts))
    first, last = flown.motion.compute_true_state(
        np.array([0.0, flown.motion.duration_s])
    ).position_m
    # the last side points back along heading + 270 degrees
    assert np.allclose(last - first, -left_out * compute_direction(30.0 + 270.0), atol=1e-9)
    error_m = make_answer_key(flown)["truth"]["closure_error_m"]
    assert error_m == pytest.approx(left_out, abs=1e-9)


@pytest.mark.parametrize("yaw", ["fixed", "follow"])
def test_simulated_aisle_flight_has_requested_length_and_yaw(yaw):
    motion = motion_of(replace(AISLE, wander_m=0.0, yaw=yaw))
    state = motion.compute_true_state(np.linspace(0.0, motion.duration_s, 5001))
    assert (state.position_m @ compute_direction(30.0)).max() == pytest.approx(12.0, abs=1e-9)
    assert np.abs(state.position_m @ compute_direction(120.0)).max() < 1e-9
    assert state.position_m[:, 2].min() == pytest.approx(-1.5, abs=1e-9)
    assert np.allclose(state.position_m[-1], 0.0, atol=1e-9)
    moving = np.hypot(*state.velocity_m_s[:, :2].T) > 0.8
    course = np.arctan2(state.velocity_m_s[:, 1], state.velocity_m_s[:, 0])
    expected = np.radians(30.0) if yaw == "fixed" else course
    off = np.angle(np.exp(1j * (expected - state.yaw_rad)))[moving]
    assert np.abs(off).max() < 1e-6


# --- sensors


@pytest.mark.parametrize("texts", [[], ["vibration=0.5"]])
def test_simulated_imu_noise_per_kf_step_has_requested_sigma(texts):
    scenario = Scenario(seed=3, passes=4, wander_m=0.0, **IDEAL)
    simulation = simulate(scenario, parse_faults(texts))
    imu = to_flight(simulation).imu
    time = imu.index.to_numpy()
    truth = compute_attitude_and_imu(simulation.motion.compute_true_state(time))
    error = np.einsum("nij,nj->ni", truth.body_to_ned, imu.to_numpy()[:, :3])
    error[:, 2] += 9.80665
    error -= simulation.motion.compute_true_state(time).acceleration_m_s2
    frame = pd.DataFrame(error, index=imu.index)
    signal = integrate_ned_acceleration(frame, Segment(0.0, time[-1], ""))
    for axis in np.eye(3):
        mean, _ = compute_mean_step_acceleration(signal, axis, np.arange(0.0, time[-1], DT_S))
        expected = np.hypot(0.2, 0.5 if texts else 0.0)
        assert np.std(mean) == pytest.approx(expected, rel=0.07)


def test_simulated_imu_biases_are_constant_with_requested_sigma():
    simulation = simulate(Scenario(seed=9))
    imu = to_flight(simulation).imu
    truth = compute_attitude_and_imu(simulation.motion.compute_true_state(imu.index.to_numpy()))
    truth_values = make_answer_key(simulation)["truth"]
    bias = imu.to_numpy()[:, :3].astype(float) - truth.specific_force_m_s2
    assert bias.mean(axis=0) == pytest.approx(truth_values["accelerometer_bias_m_s2"], abs=0.025)
    bias = imu[Columns.ANGULAR_RATE].to_numpy(float) - truth.angular_rate_rad_s
    assert bias.mean(axis=0) == pytest.approx(truth_values["gyro_bias_rad_s"], abs=3e-4)
    drawn = [sensors.draw_imu_biases(Scenario(seed=seed), NO_FAULTS) for seed in range(400)]
    assert np.std([b[0] for b in drawn]) == pytest.approx(0.03, rel=0.1)
    assert np.std([b[1] for b in drawn]) == pytest.approx(0.002, rel=0.1)


def test_simulated_vio_drift_has_requested_rate():
    ends = []
    for seed in range(40):
        scenario = Scenario(kind="loop", passes=1, length_m=8.0, seed=seed, sigma_vio_m=0.0)
        motion = motion_of(scenario)
        source = sensors.simulate_positions(scenario, NO_FAULTS, motion)
        errors_m = (
            source.position_m - motion.compute_true_state(source.measurement_times_s).position_m
        )
        assert np.allclose(errors_m[-1], source.drift_m, atol=1e-9)
        ends.append(source.drift_m)
    # 1.5 % of 32 m plus the deviation, with a random walk of 0.01 m/√m
    length = np.hypot(*np.array(ends)[:, :2].T)
    assert np.mean(length) == pytest.approx(0.015 * source.distance_m, rel=0.06)
    assert np.std(np.array(ends)[:, 2]) == pytest.approx(0.01 * np.sqrt(source.distance_m), rel=0.3)
    assert source.distance_m == pytest.approx(32.0, rel=0.1)


# --- faults


class TestMistakes:
    CLEAN = simulate(AISLE)

    @pytest.mark.parametrize(("text", "offset_s", "share"), [
        ("clock-offset=80ms", 0.08, 0), ("clock-drift=500ppm", 0, 5e-4),
    ])  # fmt: skip
    def test_simulated_clock_error_shifts_only_timestamps(self, text, offset_s, share):
        late = simulate(UNFILTERED, parse_faults([text]))
        time = late.positions.measurement_times_s
        assert np.allclose(stamps_s(late) - time, offset_s + share * time, atol=1e-6)
        arrivals = (s.positions.topic.fields["timestamp"] for s in (late, self.CLEAN))
        assert np.array_equal(*arrivals)
        assert make_answer_key(late)["truth"]["clock_offset_to_add_s"] == -offset_s

    def test_simulated_timestamps_are_late_until_timesync_converges(self):
        jumping = simulate(Scenario(seed=4), parse_faults(["clock-jump=0.25"]))
        fields, time = jumping.positions.topic.fields, jumping.positions.measurement_times_s
        before = time < 50.0
        assert 0.0 < before.mean() < 1.0
        assert np.array_equal(fields["timestamp"] == fields["timestamp_sample"], before)
        late = stamps_s(jumping) - time
        assert np.mean(late[before]) == pytest.approx(0.25, abs=1e-3)
        assert np.allclose(late[~before], 0.0, atol=1e-6)

    def test_simulated_nlos_outliers_have_requested_fraction(self):
        simulation = simulate(Scenario(seed=6, sigma_uwb_m=0.0), parse_faults(["nlos=5%,3m"]))
        outlier, motion = simulation.positions.is_outlier, simulation.motion
        time = simulation.positions.measurement_times_s
        flying = (time > motion.take_off_s) & (time < motion.touch_down_s)
        assert np.count_nonzero(outlier) == round(0.05 * np.count_nonzero(flying))
        assert not np.any(outlier & ~flying)
        size = np.hypot(*position_errors_m(simulation)[:, :2].T)
        assert np.all(size[~outlier] < 1e-9)
        assert np.all((size[outlier] >= 1.5) & (size[outlier] <= 4.5))
        assert np.mean(size[outlier]) == pytest.approx(3.0, rel=0.2)
        starts = np.count_nonzero(np.diff(outlier.astype(int)) == 1)
        assert np.count_nonzero(outlier) / starts > 1.5
        truth_values = make_answer_key(simulation)["truth"]
        assert truth_values["outlier_index"] == np.flatnonzero(outlier).tolist()
        assert np.allclose(truth_values["outlier_time_s"], stamps_s(simulation)[outlier])

    @pytest.mark.parametrize(
        ("text", "start", "end"), [("dropout=6s,12s", 12.0, 18.0), ("dropout=6", None, None)]
    )
    def test_simulated_dropout_removes_position_samples(self, text, start, end):
        with_gap = simulate(UNFILTERED, parse_faults([text]))
        middle = with_gap.motion.duration_s / 2.0
        start, end = start or middle - 3.0, end or middle + 3.0
        clean = self.CLEAN.positions.measurement_times_s
        remaining = clean[(clean <= start) | (clean >= end)]
        assert np.array_equal(with_gap.positions.measurement_times_s, remaining)

    @pytest.mark.parametrize("rate", [2.0, 4.0])
    def test_simulated_decimation_reduces_position_and_imu_rate(self, rate):
        mistakes = parse_faults(
            [f"decimate={rate}Hz", f"imu-rate={10 * rate}", "imu-dropout=2s,10s"]
        )
        decimated, clean = (to_flight(s) for s in (simulate(AISLE, mistakes), self.CLEAN))
        samples = decimated.positions[0].samples
        assert len(samples) / decimated.log.duration_s == pytest.approx(rate, rel=0.1)
        assert samples.index.isin(clean.positions[0].samples.index).all()
        pd.testing.assert_frame_equal(decimated.imu, clean.imu.loc[decimated.imu.index])
        intervals = np.diff(decimated.imu.index)
        assert np.median(intervals) == pytest.approx(0.1 / rate, rel=0.05)
        assert intervals.max() == pytest.approx(2.0, abs=0.1 / rate)
        assert len(decimated.attitude) == len(clean.attitude)

    def test_simulated_low_pass_positions_lag_by_time_constant(self):
        scenario = Scenario(seed=4, sigma_uwb_m=0.0, uwb_rate_hz=50.0, wander_m=0.0)
        simulation = simulate(scenario, parse_faults(["smoothed=0.5s"]))
        truth = simulation.motion.compute_true_state(simulation.positions.measurement_times_s)
        along = truth.velocity_m_s @ compute_direction(30.0)
        lag = -(position_errors_m(simulation) @ compute_direction(30.0))
        fast = np.abs(np.abs(along) - 1.0) < 1e-9
        settled = fast & np.roll(fast, 150)  # 3 s are six time constants
        assert np.any(settled)
        assert np.allclose(lag[settled] / along[settled], 0.5, atol=0.02)
        noisy = simulate(replace(AISLE, ekf2=False), parse_faults(["smoothed=1s"]))
        assert (
            np.std(position_errors_m(noisy)[:25]) < 0.07
        )  # on the ground; 0.10 m without the filter

    def test_simulated_fault_removes_topic_vehicle_visual_odometry(self):
        remaining = to_flight(simulate(AISLE, parse_faults(["no-vvo"]))).positions
        assert [round(track.compute_rate_hz()) for track in remaining] == [2, 2]
        flight = to_flight(simulate(replace(AISLE, ekf2=False), parse_faults(["no-vvo"])))
        assert flight.positions == ()
        with pytest.raises(px4fuse.Px4FuseError, match="SDLOG_PROFILE"):
            compare(flight)


@pytest.mark.parametrize(("text", "field", "value"), [
    ("clock-offset=-80ms", "clock_offset_s", -0.08),
    ("nlos=5%,50cm", "nlos_size_m", 0.5),
    ("dropout=8,0", "dropout_at_s", 0.0),  # a gap may begin with the flight
    ("r-scale=1e-1", "r_scale", 0.1),
    ("accel-bias=.5m/s²", "accel_bias_m_s2", 0.5),
    ("no-motion", "no_motion", True),
])  # fmt: skip
def test_simulate_fault_option_converts_units(text, field, value):
    assert getattr(parse_faults([text]), field) == pytest.approx(value)


@pytest.mark.parametrize("name", FAULT_TYPES)
def test_simulate_fault_option_is_formatted_and_parsed_back(name):
    parsed = parse_faults([name])
    assert injected_fault_names(parsed) == (name,)
    assert parse_faults([format_fault(name, parsed)]) == parsed
    assert injected_fault_names(parse_faults(["clock-offset=0", "nlos=0"])) == ()


@pytest.mark.parametrize(("text", "expected"), [
    ("fog", "Choose from clock-offset, clock-drift"),
    ("dropout = 8s", "cannot inject the fault dropout "),
    ("nlos=5s", "give percent"),
    ("nlos=80%", "give 0 to 50 %"),
    ("nlos=5%,1m,2", r"Use nlos=PERCENT\[,SIZE\]"),
    ("clock-offset=nan", "give seconds"),
    ("clock-offset=1e999", "out of range"),
    ("clock-offset=", "give seconds"),
    ("no-motion=1", "Use no-motion"),
])  # fmt: skip
def test_simulate_invalid_fault_option_raises_one_line_error(text, expected):
    with pytest.raises(SettingsError, match=expected) as error:
        parse_faults([text])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("changes", [
    {"passes": 0}, {"speed_m_s": float("nan")},
    {"length_m": 2.0, "speed_m_s": 4.0}, {"seed": -1},
])  # fmt: skip
def test_simulation_scenario_with_invalid_value_raises_error(changes):
    with pytest.raises(SettingsError):
        Scenario(**changes)


@pytest.mark.parametrize(("scenario", "texts", "expected"), [
    (AISLE, ["open-end"], "requires --kind loop"), (UNFILTERED, ["ekf2-noise"], "--no-ekf2"),
    (LOOP, ["open-end=7"], "Use at most 6 m"),
    (Scenario(passes=100, length_m=100.0), [], "limited to 3600 s"),
    (AISLE, ["dropout=600s,0s"], "vehicle_visual_odometry contains no messages"),
])  # fmt: skip
def test_simulate_fault_unsuited_to_flight_kind_raises_error(scenario, texts, expected):
    with pytest.raises(SettingsError, match=expected):
        simulate(scenario, parse_faults(texts))


# --- ULog and memory


def test_simulated_ulog_contains_no_names_of_faults():
    texts = [name for name, one in FAULT_TYPES.items() if "aisle" in one.kinds and name != "no-vvo"]
    content = to_ulog(simulate(AISLE, parse_faults(texts)))
    for name in (
        *FAULT_TYPES,
        *(field for mistake in FAULT_TYPES.values() for field in mistake.field_names),
    ):
        # these names occur in the log for other reasons
        if name not in ("yaw", "scale", "jump", "heading", "mag"):
            assert name.encode() not in content
    assert b"mistake" not in content.lower()


# --- KF on simulated flights


def nis(scenario, names=("north", "east", "down")):
    """Return mean NIS per axis at the true noises, from the fast filter, and its 95 % band."""
    flight = simulate_flight(replace(scenario, ekf2=False))
    (start, end) = flight.airborne[0]
    settings = Settings(sigma_a_m_s2=scenario.sigma_a_m_s2, sigma_z_m=scenario.sigma_uwb_m)
    found = []
    for axis in make_axes(flight, flight.positions[0], Segment(start, end, ""), names=names):
        nu, s = innovations(preintegrate(axis, settings), settings.sigma_a_m_s2, settings.sigma_z_m)
        found.append(float(np.mean(nu**2 / s)))
    return found, compute_nis_band(len(nu))


@pytest.mark.slow
@pytest.mark.parametrize(("errors", "off", "share"), [
    ({}, np.inf, 0.75), (IDEAL, 0.03, 0.88),
], ids=["usual", "ideal"])  # fmt: skip
def test_kf_with_true_noises_is_consistent(errors, off, share):
    values, inside = [], []
    for seed in range(14):
        found, (low, high) = nis(Scenario(seed=seed, passes=4, **errors))
        values += found
        inside += [low < value < high for value in found]
    assert np.mean(values) == pytest.approx(1.0, abs=off)
    assert np.mean(inside) > share


@pytest.mark.parametrize("scenario", [Scenario(seed=7, passes=4), LOOP], ids=["aisle", "loop"])
def test_simulated_clean_flight_reports_at_most_odometry_drift(scenario):
    """The VIO of a loop drifts, which is not a fault; its effect on the filters is reported."""
    settings = Settings(sigma_a_m_s2=0.2, sigma_z_m=scenario.source_sigma_m)
    compared = compare(simulate_flight(scenario), settings)
    findings = find(unexplained(compared))
    drift = ["source_drift"] if scenario.kind == "loop" else []
    assert [finding.id for finding in findings] == [*drift, "ekf2_simulated"]
    most_m = 0.12 if scenario.kind == "aisle" else 0.7
    for axis in compared.axes.values():
        assert axis.filters["kf"].truth.position_rmse_m < most_m


# --- the command


def test_simulate_command_with_same_seed_is_reproducible(tmp_path):
    log, answer_path, again = (tmp_path / name for name in ("s07.ulg", "s07.json", "again.ulg"))
    options = ("--seed", 7, "--passes", 1, "--mistake", "nlos=5%", "--mistake", "clock-offset=80ms")
    assert (
        "nlos=5%,2m" in run_checked("simulate", "-o", log, *options, "--answer", answer_path).output
    )
    content = json.loads(answer_path.read_text(encoding="utf-8"))
    assert set(content["mistakes"]) == {"nlos", "clock-offset"}
    assert content["scenario"]["seed"] == 7
    run_checked("simulate", "-o", again, *options)
    assert again.read_bytes() == log.read_bytes()
    run_checked("simulate", "-o", again, "--seed", 8, *options[2:], "--no-truth")
    assert again.read_bytes() != log.read_bytes()
    assert b"groundtruth" not in again.read_bytes()
