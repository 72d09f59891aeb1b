"""Invalid values and timestamps of a position source: reading, findings and logged flights."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from conftest import shared
from exchange import replace
from flights import Estimator, Uwb, aisle_flight, unexplained
from scipy.spatial.transform import Rotation
from studies.expected_cases import judge, run
from ulog_tools import make_log, odometry

from px4fuse.analysis import Analysis
from px4fuse.convention.lever_arm import LeverArm
from px4fuse.convention.model import Convention
from px4fuse.ekf2.model import prepare_ekf2_model, replay_with_settings
from px4fuse.finding import Finding
from px4fuse.findings import (
    ekf2_fusion,
    source_convention,
    source_intervals,
    source_positions,
    source_stamps,
    source_values,
)
from px4fuse.findings.model import finding, group_by_cause
from px4fuse.flight.model import (
    REPEATED_TIMESTAMPS_NOTE,
    ClockConversion,
    Columns,
    Flight,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.readers.common import classify_invalid_positions, estimate_quantisation_step
from px4fuse.readers.position_file import read_position_file
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario
from px4fuse.trajectory.rotation import interpolate, to_rotation_matrix

LAST = {"tracking_lost", "exact_zeros", "nan_rows", "quality_low", "ekf2_own_back", "two_senders"}
CASES = sorted(
    LAST
    | {"utm_float32", "lever_arm", "reset_counter", "timestamps_ms", "unix_time", "resolution_1s"}
    | {"clean_mocap_100hz"}
)


def track(count: int = 60) -> pd.DataFrame:
    """Return positions at 10 Hz that move by 0.1 m each, far from the origin."""
    time = pd.Index(0.1 * np.arange(count), name="time_s")
    moved = 5.0 + 0.1 * np.arange(count)
    return pd.DataFrame({"x": moved, "y": moved, "z": moved}, time)


def invalid(samples: pd.DataFrame) -> dict[str, list[int]]:
    """Return the row numbers of invalid positions by reason."""
    reason = classify_invalid_positions(samples, ["x", "y", "z"]).to_numpy()
    return {name: np.flatnonzero(reason == name).tolist() for name in sorted({*reason} - {""})}


def test_invalid_positions_are_found_with_their_reason():
    samples = track()
    samples.iloc[5:7] = np.nan
    samples.iloc[[10, 20]] = 0.0
    samples.iloc[30:45] = samples.iloc[29].to_numpy()
    assert invalid(samples) == {"NaN": [5, 6], "held": [*range(30, 45)], "zero": [10, 20]}


def test_randomly_repeated_positions_are_no_loss_of_tracking():
    """One run of more than ten is expected in 700 positions with 60 % repetitions."""
    random = np.random.default_rng(3)
    rows = np.maximum.accumulate(np.where(random.random(700) < 0.6, 0, np.arange(700)))
    positions = random.normal(0.0, 1.0, (700, 3))[rows]
    time_s = pd.Index(0.15 * np.arange(700.0))
    assert invalid(pd.DataFrame(positions, time_s, ["x", "y", "z"])) == {}


def test_position_0_0_0_is_valid_if_track_passes_the_origin():
    samples = track() - 8.0
    assert samples.iloc[30].abs().max() < 1e-9
    samples.iloc[30] = 0.0
    assert invalid(samples) == {}


def test_positions_sent_twice_are_not_marked_invalid():
    samples = track()
    assert invalid(samples.set_axis(samples.index, axis=0).iloc[np.arange(60) // 2 * 2]) == {}


def test_constant_positions_at_rest_are_valid():
    samples = track()
    samples.iloc[10:] = samples.iloc[10].to_numpy()
    assert invalid(samples) == {}


@pytest.mark.parametrize(("origin", "step"), [(5_334_567.0, 0.5), (691_234.0, 0.0625)])
def test_rounding_step_of_float32_positions_is_found(origin, step):
    values = origin + np.random.default_rng(1).normal(0.0, 5.0, 400)
    assert estimate_quantisation_step(values.astype(np.float32).astype(float)) == step
    assert estimate_quantisation_step(values) < 0.01


def test_position_rounding_step_of_subnormal_difference_is_zero():
    assert estimate_quantisation_step(np.array([0.0, 5e-324, 1e10])) == 0.0


@pytest.mark.parametrize(("column", "name", "severity", "control"), [
    ("down_m", "source_height_constant", "note", 1),
    ("north_m", "source_coordinate_constant", "error", 2),
])  # fmt: skip
def test_constant_coordinate_is_reported_and_not_fused(column, name, severity, control):
    flight = simulate_flight(Scenario(passes=1, seed=2))
    source = flight.positions[0]
    source = replace(source, samples=source.samples.assign(**{column: 1.25}))
    comparison = compare(replace(flight, positions=(source,)))
    (found,) = source_positions.detect_constant_coordinates(comparison)
    assert (found.id, found.severity) == (name, severity)
    assert "(constant: 1.25 m)" in found.message
    assert f"EKF2_EV_CTRL {'to' if control == 2 else 'at'} {control}" in found.remedy
    assert ("down" in comparison.axes) is (column != "down_m")


def test_constant_vision_positions_advise_to_disable_fusion():
    flight = simulate_flight(Scenario(passes=1, seed=2))
    flight = replace(flight, log=replace(flight.log, parameters={"EKF2_EV_CTRL": 15}))
    samples = flight.positions[0].samples.assign(north_m=1.0, east_m=1.0, down_m=1.0)
    source = replace(flight.positions[0], samples=samples)
    comparison = compare(replace(flight, positions=(source,)))
    (found,) = source_positions.detect_constant_coordinates(comparison)
    assert "Set EKF2_EV_CTRL to 12," in found.remedy


@pytest.mark.parametrize(("stamp", "clock"), [
    (lambda us: us // 1000, "milliseconds"),
    (lambda us: us // 1_000_000, "seconds"),
    (lambda us: us * 0, "0"),
    (lambda us: us + 1_795_251_250_000_000, "UNIX time in microseconds"),
    (lambda us: us + 3_600_000_000, "another clock"),
])  # fmt: skip
def test_read_log_detects_unit_and_clock_of_timestamps(tmp_path, stamp, clock):
    log = make_log("v1.16", 40.0).drop("vehicle_visual_odometry")
    source = odometry("vehicle_visual_odometry", 40.0, 16)
    source.fields["timestamp_sample"] = stamp(source.fields["timestamp_sample"])
    position, *_ = read_log(log.add(source).write(tmp_path / "log.ulg")).positions
    assert position.clock_map.clock == clock
    assert clock in source_stamps.EFFECT_BY_UNUSABLE_TIMESTAMP


@pytest.mark.parametrize(("clock", "action"), [
    ("an unknown clock", "Synchronise the clocks"),
    ("another clock", "Synchronise the clocks"),
    ("milliseconds", "Set timestamp_sample to the time of measurement"),
])  # fmt: skip
def test_timestamp_advice_is_clock_sync_or_other_time_unit(clock, action):
    (finding,) = source_stamps.detect_wrong_timestamp_unit_or_clock(
        compare(simulate_flight(Scenario(passes=1))), clock
    )
    assert action in finding.remedy


def test_read_log_reads_vision_reset_counter_and_quality(tmp_path):
    log = make_log("v1.16").drop("vehicle_visual_odometry")
    source = odometry("vehicle_visual_odometry", 10.0, 16)
    count = len(source.fields["timestamp"])
    counter = (np.arange(count) > 20).astype(np.uint8)
    source.fields.update(reset_counter=counter, quality=np.full(count, -1, np.int8))
    status = read_log(log.add(source).write(tmp_path / "log.ulg")).positions[0].status
    assert status["reset_counter"].tolist() == [0.0] * 21 + [1.0] * (count - 21)
    assert set(status["quality"]) == {-1.0}


def test_read_position_file_lists_times_of_rows_without_position(tmp_path):
    rows = [f"{0.1 * at:.1f},{at + 5},{at},{at}" for at in range(40)]
    rows[10:12] = ["1.0,nan,nan,nan", "1.1,,,"]
    rows[20] = "2.0,0,0,0"
    path = tmp_path / "uwb.csv"
    path.write_text("\n".join(["time,x,y,z", *rows, ""]))
    recording = read_position_file(path)
    assert recording.reason_by_invalid_row.to_dict() == {1.0: "NaN", 1.1: "NaN", 2.0: "zero"}
    assert len(recording.samples) == 37


def with_track(flight: Flight, **changes: object) -> Flight:
    return replace(flight, positions=(replace(flight.positions[0], **changes),))


def test_report_on_invalid_positions_contains_times_and_effect():
    flight = aisle_flight(uwb=Uwb(gap_s=(40.0, 46.0)))
    at = pd.Index([*np.arange(40.2, 46.0, 0.2), 80.1, 80.2])
    reasons = pd.Series(["held"] * (len(at) - 2) + ["zero"] * 2, at)
    findings = {one.id: one for one in detected(with_track(flight, invalid_reasons=reasons))}
    assert set(findings) == {"source_zero_positions", "source_position_held"}
    assert findings["source_zero_positions"].evidence["count"] == 2
    held = findings["source_position_held"]
    assert held.spans_s[0] == pytest.approx((40.2, 45.8))
    assert "40.2 s to 45.8 s" in held.message
    assert "IMU alone" in held.message
    assert [one.id for one in detected(flight)] == ["source_gap"]


def test_single_sample_without_position_has_severity_note():
    invalid_rows = pd.Series(["NaN"], pd.Index([60.05]))
    (one,) = detected(with_track(aisle_flight(), invalid_reasons=invalid_rows))
    assert (one.id, one.severity) == ("source_without_position", "note")


@pytest.mark.parametrize(("step_m", "words"), [(0.5, "64-bit"), (0.1, "more digits")])
def test_report_on_rounded_positions_recommends_more_digits(step_m, words):
    (one,) = detected(with_track(aisle_flight(), quantisation_step_m=step_m))
    assert words in one.remedy


def alternating(flight: Flight, lost: int = 0) -> Flight:
    """Move every other position by 1 m; one sample may be lost."""
    samples = flight.positions[0].samples.copy()
    samples.iloc[1::2, :2] += [0.6, -0.8]
    return with_track(flight, samples=samples.drop(samples.index[[200] * lost]))


def copied(flight: Flight, sigma_m: float = 0.0) -> Flight:
    """Send EKF2's position back 0.03 s later, with noise."""
    truth = flight.truth.samples
    time = np.arange(1.0, flight.log.duration_s - 1.0, 0.2)
    samples = flight.positions[0].samples.iloc[: len(time)].set_axis(time + 0.03)
    for name in Columns.POSITION:
        samples[name] = np.interp(time, truth.index, truth[name])
    samples += np.random.default_rng(1).normal(0.0, sigma_m, samples.shape)
    return with_track(replace(flight, ekf2=replace(flight.ekf2, state=truth)), samples=samples)


def without_rows(flight: Flight, reason: str) -> Flight:
    """Leave out the rows of 6 s."""
    samples = flight.positions[0].samples
    is_invalid = (samples.index > 40.0) & (samples.index < 46.0)
    return with_track(
        flight,
        samples=samples[~is_invalid],
        invalid_reasons=pd.Series(reason, samples.index[is_invalid]),
    )


def with_clock(flight: Flight, name: str, note: str = "", distinct: int | None = None) -> Flight:
    clock = ClockConversion(name, "arrival time", 600, 0.0, 0.0, 0.0, note, distinct)
    return with_track(flight, clock_map=clock)


VALUE_FAULTS = {
    "source_is_ekf2_estimate": copied,
    "source_two_senders": alternating,
    "source_positions_rounded": lambda flight: with_track(flight, quantisation_step_m=0.5),
    "source_timestamp_unit": lambda flight: with_clock(flight, "milliseconds"),
    "source_timestamps_shared": lambda flight: with_clock(
        flight, "local", REPEATED_TIMESTAMPS_NOTE, 120
    ),
    "source_position_held": lambda flight: without_rows(flight, "held"),
    "source_zero_positions": lambda flight: without_rows(flight, "zero"),
    "source_without_position": lambda flight: without_rows(flight, "NaN"),
}


def detected(flight: Flight) -> tuple[Finding, ...]:
    analysis = unexplained(compare(flight))
    detectors = (source_values, source_stamps, source_intervals, ekf2_fusion)
    findings = [one for detector in detectors for one in detector.detect(analysis)]
    return group_by_cause(source_convention.remove_convention_effects(analysis, findings))


def examples() -> Iterator[Finding]:
    """Return examples of the findings about values and timestamps, for their pages."""
    for name, change in VALUE_FAULTS.items():
        yield from (one for one in detected(change(aisle_flight())) if one.id == name)
    yield from source_values.detect_lever_arm(mounted((0.4, -0.3)))


@pytest.mark.parametrize("name", VALUE_FAULTS)
def test_invalid_position_values_are_the_only_reported_fault(name):
    assert [one.id for one in detected(VALUE_FAULTS[name](aisle_flight()))] == [name]


@pytest.mark.parametrize("lost", [0, 1])
def test_report_on_two_position_senders_states_their_distance(lost):
    (one,) = detected(alternating(aisle_flight(uwb=Uwb(rate_hz=10.0)), lost))
    assert one.evidence["distance_m"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("is_fused", [0.0, 1.0])
def test_report_on_ekf2_output_fed_back_as_source_states_delay(is_fused):
    flight = aisle_flight(ekf2=Estimator(fusing=((0.0, is_fused),)))
    first, *_ = detected(copied(flight))
    assert first.evidence["delay_s"] == pytest.approx(0.03, abs=0.01)
    assert "source_is_ekf2_estimate" not in {one.id for one in detected(copied(flight, 0.02))}


def test_clean_flight_has_no_report_on_invalid_positions():
    assert detected(aisle_flight()) == ()


def test_report_on_wrong_timestamp_unit_shows_ekf2_never_fused():
    flight = aisle_flight(ekf2=Estimator(fusing=((0.0, 0.0),)))
    flight = replace(flight, log=replace(flight.log, parameters={"EKF2_EV_CTRL": 15}))
    first, second = detected(with_clock(flight, "milliseconds"))
    assert "in milliseconds" in first.message
    assert "EKF2 never fused the positions" in first.message
    assert "timestamps are in milliseconds" in second.title


def test_report_on_repeated_timestamps_states_clock_resolution():
    (one,) = detected(
        with_clock(aisle_flight(uwb=Uwb(rate_hz=1.0)), "local", REPEATED_TIMESTAMPS_NOTE, 120)
    )
    assert one.evidence["resolution_s"] == pytest.approx(1.0)
    assert "(5 Hz)" in one.message


@pytest.mark.parametrize(("quality", "words"), [(20.0, "light"), (0.0, "ODOMETRY")])
def test_report_on_unfused_vision_shows_quality_below_ev_qmin(quality, words):
    flight = aisle_flight(ekf2=Estimator(fusing=((0.0, 0.0),)))
    parameters = {"EKF2_EV_CTRL": 15, "EKF2_EV_QMIN": 50}
    flight = replace(flight, log=replace(flight.log, parameters=parameters))
    status = pd.DataFrame({"quality": quality}, flight.positions[0].samples.index)
    (one,) = detected(with_track(flight, status=status))
    assert f"quality is {quality:.0f}, below EKF2_EV_QMIN 50" in one.title
    assert words in one.remedy


def test_faults_caused_by_two_position_senders_name_this_cause():
    analysis = unexplained(compare(aisle_flight()))
    findings = [
        finding("error", name, "m.", "r.")
        for name in ("ekf2_not_fusing", "source_outliers", "source_two_senders", "imu_gap")
    ]
    left = source_convention.remove_convention_effects(analysis, findings)
    assert [one.id for one in left] == ["source_two_senders", "ekf2_not_fusing", "imu_gap"]
    assert left[1].caused_by == "source_two_senders"


def test_noisy_axis_is_not_taken_for_positions_from_two_senders():
    flight = aisle_flight(uwb=Uwb(rate_hz=30.0, sigma_m=0.01))
    samples = flight.positions[0].samples.copy()
    samples["north_m"] += np.random.default_rng(9).normal(0.0, 0.4, len(samples))
    analysis = unexplained(compare(with_track(flight, samples=samples)))
    assert not [*source_values.detect_two_senders(analysis)]


LOOP, AISLE = Scenario(seed=3, kind="loop", passes=2), Scenario(seed=3, passes=6, yaw="follow")


def mounted(
    arm_m: tuple[float, float], rotation_deg: float = 0.0, scenario: Scenario = LOOP
) -> Analysis:
    """Return a flight whose sensor is mounted away from the IMU, in a rotated frame."""
    flight = simulate_flight(scenario, parse_faults(()))
    source, attitude = flight.positions[0], flight.truth.attitude
    time = source.samples.index.to_numpy()
    rotation = to_rotation_matrix(interpolate(time, attitude.index.to_numpy(), attitude.to_numpy()))
    samples = source.samples.copy()
    samples[Columns.POSITION] += rotation @ [*arm_m, 0.0]
    turn = Rotation.from_euler("z", rotation_deg, degrees=True)
    samples[Columns.POSITION] = turn.apply(samples[Columns.POSITION])
    analysis = unexplained(compare(with_track(flight, samples=samples)))
    if rotation_deg:
        return analysis
    return replace(analysis, convention=Convention(verdict="determined"))


def test_lever_arm_that_does_not_reduce_error_is_not_reported(monkeypatch):
    analysis = mounted((0.4, -0.3))
    monkeypatch.setattr(source_values, "_describe_replayed_effect", lambda *_: None)
    assert not [*source_values.detect_lever_arm(analysis)]


def test_estimated_lever_arm_equals_simulated_one():
    (one,) = source_values.detect_lever_arm(mounted((0.4, -0.3)))
    found_m = one.evidence["forward_m"], one.evidence["right_m"]
    assert found_m == pytest.approx((0.4, -0.3), abs=0.1)
    assert "Set EKF2_EV_POS_X to 0." in one.remedy


@pytest.mark.parametrize(("rotation_deg", "has_truth"), [(10.0, True), (30.0, False)])
def test_lever_arm_report_advises_to_rotate_positions_first(
    rotation_deg: float, has_truth: bool
) -> None:
    analysis = mounted((0.3, 0.0), rotation_deg, AISLE)
    if not has_truth:
        analysis = without_truth(analysis, 0.0)
    (one,) = source_values.detect_lever_arm(analysis)
    assert f"positions are rotated by {rotation_deg:+.0f}° (clockwise from above)" in one.message
    assert one.evidence["forward_m"] == pytest.approx(0.3, abs=0.05)
    assert one.evidence["right_m"] == pytest.approx(0.0, abs=0.05)
    assert one.remedy.startswith(f"Rotate the positions by {-rotation_deg:+.0f}°")
    assert "Set EKF2_EV_POS_X to 0." in one.remedy


def without_truth(analysis: Analysis, imu_x_m: float) -> Analysis:
    ekf2 = analysis.flight.ekf2
    ekf2 = replace(ekf2, parameters={**ekf2.parameters, "EKF2_IMU_POS_X": imu_x_m})
    flight = replace(analysis.flight, ekf2=ekf2, truth=Unavailable("ground truth", "none", ""))
    return replace(analysis, flight=flight)


@pytest.mark.slow
def test_lever_arm_estimate_from_imu_includes_imu_position() -> None:
    """A sensor 0.4 m behind the IMU is at the vehicle's origin if EKF2_IMU_POS_X is 0.4 m."""
    behind = mounted((-0.4, 0.0))
    assert not [*source_values.detect_lever_arm(without_truth(behind, 0.4))]
    (one,) = source_values.detect_lever_arm(without_truth(mounted((0.0, 0.0)), 0.4))
    assert one.evidence["forward_m"] == pytest.approx(0.4, abs=0.1)
    assert "Set EKF2_EV_POS_X to 0." in one.remedy
    assert "the IMU position is wrong: set EKF2_IMU_POS_X to " in one.remedy


def test_wrong_imu_position_is_reported_if_replay_confirms_it(monkeypatch) -> None:
    """EKF2's replay with a wrong EKF2_IMU_POS; ground truth contains no error of the source."""
    scenario = Scenario(seed=3, passes=3, yaw="follow")
    flight = simulate_flight(scenario, parse_faults(()))
    model = prepare_ekf2_model(flight)
    wrong = replace(model.inputs, imu_offset_m=np.array([0.6, 0.0, 0.0]))
    wrong_model = replace(model, inputs=wrong, runs=())
    (replay,) = replay_with_settings(wrong_model, [{}])
    wrong_model = replace(wrong_model, baseline_replay=replay)
    analysis = replace(unexplained(compare(flight)), ekf2_model=wrong_model)
    right = {"EKF2_IMU_POS_X": 0.0, "EKF2_IMU_POS_Y": 0.0}
    assert "Replay of EKF2" in source_values._describe_replayed_effect(analysis, right)
    moved = {"EKF2_EV_POS_X": 0.6, "EKF2_EV_POS_Y": 0.0}
    assert source_values._describe_replayed_effect(analysis, moved) is None
    monkeypatch.setattr(source_values, "estimate_lever_arm", lambda *_: LeverArm(0.6, 0.0, 0.1))
    monkeypatch.setattr(source_values, "find_imu_position_m", lambda _: (0.6, 0.0, 0.0))
    (one,) = source_values.detect_lever_arm(analysis)
    assert one.message.startswith("The IMU is mounted 0.60 m from")
    assert one.remedy.startswith("Set EKF2_IMU_POS_X to 0 m and EKF2_IMU_POS_Y to 0 m.")


def test_source_without_lever_arm_has_no_lever_arm_report():
    assert not [*source_values.detect_lever_arm(mounted((0.0, 0.0)))]


@pytest.mark.reallogs
@pytest.mark.parametrize("name", CASES)
def test_faults_reported_on_example_logs_equal_expected_ones(name):
    folder = shared("cases")
    case = json.loads((folder / "EXPECTED.json").read_text())["cases"][name]
    result, first, harmful = judge(case, run(case["command"], folder))
    assert (result, harmful) == ("correct", []), first
