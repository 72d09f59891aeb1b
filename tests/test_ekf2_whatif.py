"""EKF2 replay with other parameters, and explanation of the difference between KF and EKF2."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ekf2_tools import REPLACED_PROPERTIES, RULES, explained, opened
from exchange import replace
from findings_tools import NONE, made
from msgspec import structs

from px4fuse.ekf2 import whatif
from px4fuse.ekf2.inputs import ReceivedPositions, ReplayInputs
from px4fuse.ekf2.model import Ekf2Model
from px4fuse.ekf2.replay import Ekf2Replay, compute_rmse_to_truth, interpolate_component
from px4fuse.ekf2.replay_segments import ReplaySegment, SensorSamples
from px4fuse.ekf2.steps import (
    ATTITUDE_PROPERTY_NAME,
    FLOW_PROPERTY_NAME,
    GNSS_VELOCITY_PROPERTY_NAME,
    MAGNETOMETER_PROPERTY_NAME,
    OUTPUT_PREDICTOR_PROPERTY_NAME,
    REJECTION_PROPERTY_NAME,
    DifferenceExplanation,
    _find_longest_rejection,
    explain_difference_by_replacements,
    make_stepwise_configurations,
)
from px4fuse.ekf2.whatif import (
    AxisStatistics,
    Ekf2Statistics,
    _describe_replay_limits,
    _find_longest_gap_s,
    what_if,
)
from px4fuse.errors import SettingsError
from px4fuse.filter.kalman import KfRun
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.flight.ekf2_parameters import GNSS_POS
from px4fuse.flight.model import Columns, Flight, Truth, Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate, to_ulog
from px4fuse.simulation.scenario import Scenario


def test_ekf2_replay_with_changed_noise_predicts_nis_and_rmse(model):
    made = what_if(model, [{"EKF2_EVP_NOISE": 0.5}, {"EKF2_EVP_NOISE": 0.02}])
    wide, narrow = made.whatif
    for axis in ("north", "east"):
        logged, replayed = made.logged.axes[axis], made.replayed.axes[axis]
        error_m = logged.position_rmse_to_truth_m
        assert replayed.position_rmse_to_truth_m == pytest.approx(error_m, abs=0.003)
        assert replayed.sigma_p_median_m == pytest.approx(logged.sigma_p_median_m, rel=0.02)
        assert replayed.nis_mean == pytest.approx(logged.nis_mean, rel=0.3)
        assert wide.axes[axis].nis_mean < 0.1
        assert narrow.axes[axis].nis_mean > 5.0
        assert replayed.nis_band[0] < 1.0 < replayed.nis_band[1]
        # ground truth shows the best setting: UWB noise is 0.10 m
        assert narrow.axes[axis].position_rmse_to_truth_m > replayed.position_rmse_to_truth_m
    assert made.replayed.samples > 2 * made.logged.samples  # the log has 2 of 5 samples per second
    assert isinstance(made.logged.longest_without_fusion_s, Unavailable)
    assert made.replayed.longest_without_fusion_s == pytest.approx(0.22, abs=0.04)
    assert made.replayed.rejected_fraction == made.logged.rejected_fraction == 0.0
    assert narrow.rejected_fraction > 0.2
    assert narrow.resets > 0
    assert narrow.longest_without_fusion_s > 1.0
    assert not made.notes


def test_ekf2_replay_that_disagrees_with_log_gives_no_prediction(model):
    doubtful = replace(model, agreement=replace(model.agreement, good=False, reason="no reason"))
    for result in (
        what_if(doubtful, [{"EKF2_EVP_NOISE": 0.5}]),
        explained(doubtful),
    ):
        assert isinstance(result, Unavailable)
        assert "no reason" in result.reason


def test_contributions_to_kf_minus_ekf2_position_add_up_to_total(model):
    for axis in explained(model).values():
        assert axis.longest_rejection is None
        assert tuple(step.name for step in axis.steps) == REPLACED_PROPERTIES
        for quantity in ("position_mean_square_m2", "velocity_mean_square_m2_s2"):
            unexplained = getattr(axis, f"unexplained_{quantity.removeprefix('position_')}")
            total = sum(getattr(step, quantity) for step in axis.steps) + unexplained
            assert total == pytest.approx(getattr(axis, quantity), abs=1e-12)
        assert axis.unexplained_fraction < 0.03
        by_name = {step.name: step for step in axis.steps}
        # properties that do not differ between the filters change nothing
        assert by_name["measurement noise"].position_moved_m < 1e-6
        assert by_name["rejections and resets"].position_moved_m < 1e-6
        largest = sorted(axis.steps, key=lambda step: -step.position_mean_square_m2)[:2]
        assert {step.name for step in largest} == {
            "process noise",
            OUTPUT_PREDICTOR_PROPERTY_NAME,
        }
        last = axis.steps[-1].position_rmse_to_truth_m
        assert last == pytest.approx(axis.position_rmse_to_truth_m["ekf2"], abs=0.003)


def test_kf_ekf2_difference_without_common_time_is_unavailable(model):
    axis, steps = made(Axis, direction=np.eye(3)[0]), pd.DataFrame(index=[1e4, 1e4 + 1.0])
    result = explain_difference_by_replacements(
        model, Settings(), {"north": made(KfRun, axis=axis, steps=steps)}
    )
    assert isinstance(result, Unavailable)
    assert "do not overlap" in result.reason


# ----------------------------------------------------------- cases with a known answer


def test_each_step_from_kf_to_ekf2_changes_one_filter_property():
    flown = {"EKF2_EVP_NOISE": 0.3, "EKF2_EV_NOISE_MD": 0.0, "EKF2_ACC_NOISE": 0.35}
    received = made(ReceivedPositions)
    plain = (made(ReplaySegment, flow=None, height_samples=None),)
    flight = made(
        ReplayInputs, settings=flown, mean_step_s=0.01, received_positions=received, segments=plain
    )
    kf_settings = Settings(0.5, 0.2, 0.16, clock_offset_s=-0.05)
    found = list(make_stepwise_configurations(flight, kf_settings).values())
    settings = [configuration.settings for configuration in found]
    assert [s["EKF2_ACC_NOISE"] for s in settings] == pytest.approx([2.0] * 4 + [0.35] * 3)
    assert [s["EKF2_EVP_NOISE"] for s in settings] == [0.2] * 2 + [0.3] * 5
    assert [configuration.uses_reported_noise for configuration in found] == [False] * 2 + [
        True
    ] * 5
    assert settings[0]["EKF2_EV_POS_X"] == 0.0
    assert [configuration.estimates_biases for configuration in found] == [False] * 3 + [True] * 4
    assert [configuration.estimates_attitude for configuration in found] == [False] * 5 + [True] * 2
    assert [configuration.has_gate for configuration in found] == [False] * 6 + [True]
    assert [configuration.uses_logged_decisions for configuration in found] == [False] * 6 + [True]
    assert [configuration.timestamp_offset_s for configuration in found] == [-0.05] + [None] * 6
    gnss = made(
        ReplayInputs,
        aid=GNSS_POS,
        mean_step_s=0.01,
        received_positions=made(ReceivedPositions, velocity_m_s=np.zeros((1, 3))),
        settings={"EKF2_ACC_NOISE": 0.35, "EKF2_GPS_P_NOISE": 0.5, "EKF2_GPS_DELAY": 110.0},
        segments=plain,
    )
    found = list(make_stepwise_configurations(gnss, kf_settings).values())
    assert [configuration.fuses_velocity for configuration in found] == [False] * 6 + [True] * 2
    assert [configuration.has_gate for configuration in found] == [False] * 7 + [True]
    # the GNSS positions of KF already include the delay
    assert found[0].timestamp_offset_s == pytest.approx(-0.16)
    assert [configuration.settings["EKF2_GPS_P_NOISE"] for configuration in found] == [0.2] * 2 + [
        0.5
    ] * 6
    flow = (made(ReplaySegment, flow=made(SensorSamples), height_samples=None),)
    more = {"segments": flow, "settings": gnss.settings | {"EKF2_MAG_NOISE": 0.05}}
    configurations = make_stepwise_configurations(
        made(ReplayInputs, **{**vars(gnss), **more}), kf_settings
    )
    assert list(configurations)[-5:] == [
        ATTITUDE_PROPERTY_NAME,
        MAGNETOMETER_PROPERTY_NAME,
        GNSS_VELOCITY_PROPERTY_NAME,
        FLOW_PROPERTY_NAME,
        REJECTION_PROPERTY_NAME,
    ]
    assert ["mag" in each.disable_time_s_by_aid for each in configurations.values()] == [
        True
    ] * 6 + [False] * 4
    assert ["optical_flow" in each.disable_time_s_by_aid for each in configurations.values()] == [
        True
    ] * 8 + [False] * 2
    assert [each.fuses_velocity for each in configurations.values()] == [False] * 7 + [True] * 3


def test_longest_run_of_ekf2_rejections_has_start_and_duration():
    taken = 20.0 + np.arange(10.0)
    updates = pd.DataFrame(
        {"rejected": [0, 1, 0, 0, 1, 1, 1, 0, 1, 1], "fused_at_s": taken + 0.5}, index=taken
    )
    time = np.arange(20.0, 31.0, 0.5)
    still = pd.DataFrame(0.0, index=time, columns=Columns.STATE)
    away = still.copy()
    away.iloc[:, 0] = np.where(time == 26.5, 3.0, 0.0)
    away.iloc[:, 1] = np.where(time == 26.5, -4.0, np.where(time < 24.0, 99.0, 0.0))
    one = made(Ekf2Replay, updates=updates, delayed_state=away)
    found = _find_longest_rejection(one, still, (0.0, 99.0), ((0.0, 99.0),))
    assert (found.start_s, found.samples, found.duration_s) == (24.5, 3, 3.0)
    assert found.distance_m == pytest.approx(5.0)
    # outside the evaluated time, and without rejections
    early = _find_longest_rejection(one, still, (0.0, 22.0), ((0.0, 99.0),))
    assert (early.start_s, early.samples, early.duration_s) == (21.5, 1, 0.0)
    assert _find_longest_rejection(one, still, (22.4, 24.4), ((0.0, 99.0),)) is None


def test_rmse_against_ground_truth_uses_only_common_times():
    times, direction = np.array([9.0, 10.0, 15.0, 20.0, 21.0]), np.array([0.6, 0.8, 0.0])
    frame = pd.DataFrame(0.0, index=[10.0, 20.0], columns=Columns.STATE)
    truth = made(Truth, samples=frame.assign(north_m=[0.0, 2.0], east_m=2.0))
    there = interpolate_component(truth.samples, ["north_m", "east_m"], direction, times)
    assert there == pytest.approx([1.6, 1.6, 2.2, 2.8, 2.8])
    off, flight = np.array([9.0, 3.0, 4.0, 5.0, 9.0]), made(Flight, truth=truth)
    error = compute_rmse_to_truth(flight, there + off, direction, times)
    assert error == pytest.approx(math.sqrt(50.0 / 3.0))
    assert compute_rmse_to_truth(flight, there[:1], direction, times[:1]) is None
    assert compute_rmse_to_truth(made(Flight, truth=NONE), there, direction, times) is None


def test_longest_fusion_gap_includes_ends_of_evaluated_segment():
    evaluated_spans = ((15.0, 30.0), (40.0, 60.0))
    assert _find_longest_gap_s(np.array([16.0, 29.0, 41.0, 59.0]), evaluated_spans) == 18.0
    assert _find_longest_gap_s(np.array([40.0]), evaluated_spans) == 25.0
    assert _find_longest_gap_s(np.array([16.0]), evaluated_spans) == 44.0


def test_replay_statistics_combine_north_and_east_nis_and_rmse() -> None:
    north, east = (
        AxisStatistics(nis, (0.9, 1.1), 0.1, 0.1, m) for nis, m in ((1.0, 0.3), (3.0, 0.4))
    )
    one = Ekf2Statistics(changed={}, north=north, east=east, samples=9, rejected_fraction=0.0,
                  longest_without_fusion_s=0.1, resets=0)  # fmt: skip
    assert (one.nis_mean, one.position_rmse_to_truth_m) == pytest.approx((2.0, 0.5))
    blind = structs.replace(east, position_rmse_to_truth_m=NONE)
    assert replace(one, east=blind).position_rmse_to_truth_m is NONE
    why = made(DifferenceExplanation, unexplained_mean_square_m2=1.0, position_mean_square_m2=4.0)
    assert why.unexplained_fraction == 0.25


def test_replay_with_delay_above_ekf2_delay_max_adds_a_note():
    """EKF2 increases EKF2_DELAY_MAX to the delay at its start (VerifyParams, EKF2.cpp)."""
    for by_delay, arrival_s, expected in (
        (False, 0.0, "EKF2 increases EKF2_DELAY_MAX from 200 to 264 ms"),
        (True, -np.inf, "Without logged arrival times"),
        (True, 0.0, None),
    ):
        rules = replace(RULES, is_horizon_set_by_largest_delay=by_delay)
        arrivals = SimpleNamespace(arrival_s=np.full(3, arrival_s))
        inputs = SimpleNamespace(rules=rules, received_positions=arrivals)
        model: Any = SimpleNamespace(inputs=inputs)
        one: Any = SimpleNamespace(
            late=0, lost=0, settings={"EKF2_DELAY_MAX": 200.0},
            changed_parameters={"EKF2_EV_DELAY": 264.0},
        )  # fmt: skip
        notes = list(_describe_replay_limits(model, one))
        assert len(notes) == (expected is not None)
        assert all(expected in note for note in notes)


def test_ekf2_replay_that_loses_late_samples_adds_a_note():
    for by_delay, remedy in ((False, ". Increase EKF2_DELAY_MAX"), (True, "")):
        rules = replace(RULES, is_horizon_set_by_largest_delay=by_delay)
        arrivals = SimpleNamespace(arrival_s=np.zeros(3))
        inputs = SimpleNamespace(rules=rules, received_positions=arrivals)
        model: Any = SimpleNamespace(inputs=inputs)
        one: Any = SimpleNamespace(
            late=3,
            lost=2,
            updates=range(8),
            settings={"EKF2_DELAY_MAX": 200.0},
            changed_parameters={"EKF2_EV_DELAY": 90},
        )
        (note,) = _describe_replay_limits(model, one)
        assert note.startswith("EKF2_EV_DELAY=90: 5 of 10 samples")
        assert note.endswith(f"EKF2 would never fuse 2 of them{remedy}")
        few = SimpleNamespace(**(vars(one) | {"updates": range(1)}))
        assert "5 of 5 samples" in next(_describe_replay_limits(model, few))
        one.late = one.lost = 0
        assert list(_describe_replay_limits(model, one)) == []


# ---------------------------------------------------------- predictability of results


def flown(tmp_path: Path, mistake: str, seed: int) -> Ekf2Model:
    """Return the model of a simulated flight with one wrong EKF2 parameter, read from its log."""
    log = tmp_path / f"{seed}{mistake.partition('=')[2]}.ulg"
    log.write_bytes(
        to_ulog(simulate(Scenario(seed=seed), parse_faults([mistake] if mistake else [])))
    )
    return opened(read_log(log))


@pytest.mark.slow
@pytest.mark.parametrize(("mistake", "seed", "changes"), [
    ("ekf2-noise=0.02", 1, {"EKF2_EVP_NOISE": 0.1}),
    ("ekf2-noise=0.02", 2, {"EKF2_EVP_NOISE": 0.1}), ("ekf2-gate=1", 1, {"EKF2_EVP_GATE": 5.0}),
])  # fmt: skip
def test_ekf2_replay_predicts_flight_with_corrected_parameter(tmp_path, mistake, seed, changes):
    """Only with the logged rejections does the replay agree with these logs."""
    faulty, correct = flown(tmp_path, mistake, seed), flown(tmp_path, "", seed)
    assert faulty.agreement.rejected_fraction_logged > 0.35
    assert faulty.agreement.good
    (predicted,) = what_if(faulty, [changes]).whatif
    expected = what_if(correct, [{}]).logged
    assert predicted.is_predictable
    assert predicted.nis_mean == pytest.approx(expected.nis_mean, rel=0.1)
    assert predicted.rejected_fraction == pytest.approx(expected.rejected_fraction, abs=0.03)
    assert predicted.position_rmse_to_truth_m == pytest.approx(
        expected.position_rmse_to_truth_m, rel=0.15
    )


def test_ekf2_replay_with_delay_too_large_for_fusion_is_rejected(model, monkeypatch):
    changed = {"EKF2_EV_DELAY": 300.0}
    never = replace(
        model.baseline_replay,
        updates=model.baseline_replay.updates[:0],
        lost=9,
        changed_parameters=changed,
    )
    monkeypatch.setattr(whatif, "replay_with_settings", lambda *_, **_more: [never])
    with pytest.raises(
        SettingsError, match=r"EKF2_EV_DELAY=300: .* fuses no sample .* 9 samples"
    ) as error:
        what_if(model, [changed])
    assert "--set EKF2_DELAY_MAX" in error.value.remedy


def test_replay_with_over_35_percent_rejections_is_unreliable(model):
    unpredictable, some, none = what_if(
        model, [{"EKF2_EVP_NOISE": 0.02}, {"EKF2_EVP_NOISE": 0.05}, {"EKF2_EVP_NOISE": 0.2}]
    ).whatif
    assert unpredictable.rejected_fraction > 0.35
    assert not unpredictable.is_predictable
    assert some.is_predictable
    assert none.rejected_fraction <= 0.02
    assert none.is_predictable


def test_replay_result_that_2_mm_noise_changes_is_unreliable(model, monkeypatch):
    """Vary NIS, rejections and RMSE just inside and just outside their limits."""
    north = AxisStatistics(1.0, (0.9, 1.1), 0.1, 0.1, 0.1)
    base = Ekf2Statistics(
        changed={"EKF2_EVP_GATE": 3.0}, north=north, east=north, samples=500, rejected_fraction=0.2,
        longest_without_fusion_s=1.0, resets=0,
    )  # fmt: skip
    runs: list[tuple[float, int]] = []

    def add_position_noise(model: object, sigma_m: float, seed: int) -> object:
        runs.append((sigma_m, seed))
        return model

    def is_predictable(changed: Ekf2Statistics) -> bool:
        monkeypatch.setattr(whatif, "add_position_noise", add_position_noise)
        monkeypatch.setattr(whatif, "replay_with_settings", lambda _, changes, **_more: changes)
        monkeypatch.setattr(whatif, "_summarise_replay", lambda *_: changed)
        (found,) = whatif._mark_unpredictable_statistics(model, [base], ((0.0, 1.0),), {})
        return found.is_predictable

    assert is_predictable(base)
    assert runs == [(0.002, 0), (0.002, 1), (0.002, 2), (0.002, 3)]
    for axes, field, value, steady in (
        (("north",), "nis_mean", 1.099, True), (("north",), "nis_mean", 1.101, False),
        (("east",), "nis_mean", 1.099, True), (("east",), "nis_mean", 1.101, False),
        # the RMSE is that of both axes together
        (("north", "east"), "position_rmse_to_truth_m", 0.1149, True),
        (("north", "east"), "position_rmse_to_truth_m", 0.1151, False),
        ((), "rejected_fraction", 0.2299, True), ((), "rejected_fraction", 0.2301, False),
    ):  # fmt: skip
        other = structs.replace(north, **{field: value}) if axes else None
        changed = dict.fromkeys(axes, other) if axes else {field: value}
        assert is_predictable(structs.replace(base, **changed)) is steady
    few, many = (structs.replace(base, rejected_fraction=share) for share in (0.02, 0.351))
    runs.clear()
    assert [
        one.is_predictable
        for one in whatif._mark_unpredictable_statistics(model, [few, many], (), {})
    ] == [
        True,
        False,
    ]
    assert runs == []  # no repeated runs are needed
