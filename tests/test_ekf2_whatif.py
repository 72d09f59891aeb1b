"""What if EKF2 had had other parameters, and why it differs: sums, sweeps and messages."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ekf2_tools import RULES
from exchange import replace
from findings_tools import NONE, made

from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, delayed_variants, open_model
from px4fuse.ekf2.replay import Ekf2Replay
from px4fuse.ekf2.walk import (
    OUTPUT,
    SAMPLES,
    STEPS,
    AxisLine,
    AxisWalk,
    OurFilter,
    Walk,
    _coast,
    _variants,
    walk,
)
from px4fuse.ekf2.walk import _to_truth as walk_to_truth
from px4fuse.ekf2.whatif import (
    AxisSummary,
    Summary,
    WhatIf,
    _longest,
    _notes,
    _sigma,
    _to_truth,
    sweep,
    sweep_values,
    what_if,
)
from px4fuse.ekf2_parameters import PARAMETERS, check, settings_in_force
from px4fuse.errors import SettingsError
from px4fuse.flight import STATE_COLUMNS, Ekf2, Flight, Truth, Unavailable


@pytest.fixture(scope="module")
def model(sample_flight: Flight) -> Model:
    made = open_model(sample_flight)
    assert isinstance(made, Model)
    return made


def found(result: WhatIf | Unavailable) -> WhatIf:
    assert isinstance(result, WhatIf)
    return result


def test_side_by_side(model: Model) -> None:
    made = found(what_if(model, [{"EKF2_EVP_NOISE": 0.5}, {"EKF2_EVP_NOISE": 0.02}]))
    wide, narrow = made.whatif
    for axis in ("north", "east"):
        logged, replayed = made.logged.axes[axis], made.replayed.axes[axis]
        assert isinstance(logged.position_rmse_to_truth_m, float)
        assert isinstance(logged.sigma_p_median_m, float)
        assert replayed.position_rmse_to_truth_m == pytest.approx(
            logged.position_rmse_to_truth_m, abs=0.003
        )
        assert replayed.sigma_p_median_m == pytest.approx(logged.sigma_p_median_m, rel=0.02)
        assert replayed.nis_mean == pytest.approx(logged.nis_mean, rel=0.3)
        assert wide.axes[axis].nis_mean < 0.1
        assert narrow.axes[axis].nis_mean > 5.0
        low, high = replayed.nis_band
        assert low < 1.0 < high
        # the truth knows which is best: UWB noise is 0.10 m
        assert narrow.axes[axis].position_rmse_to_truth_m > replayed.position_rmse_to_truth_m
    assert made.replayed.samples > 2 * made.logged.samples  # the log holds 2 Hz of 5 Hz
    assert isinstance(made.logged.longest_without_fusion_s, Unavailable)
    assert made.replayed.longest_without_fusion_s == pytest.approx(0.22, abs=0.04)
    assert made.replayed.rejected_share == made.logged.rejected_share == 0.0
    assert narrow.rejected_share > 0.2
    assert narrow.resets > 0
    assert isinstance(narrow.longest_without_fusion_s, float)
    assert narrow.longest_without_fusion_s > 1.0
    assert not made.notes


def test_without_agreement_there_is_no_what_if_and_no_why(model: Model) -> None:
    doubtful = replace(model, agreement=replace(model.agreement, good=False, reason="no reason"))
    for result in (what_if(doubtful, [{"EKF2_EVP_NOISE": 0.5}]), walk(doubtful)):
        assert isinstance(result, Unavailable)
        assert "no reason" in result.reason


def test_a_flight_without_truth_has_no_rmse(model: Model) -> None:
    blind = replace(model.flight, truth=Unavailable("truth", "none", "None."))
    made = found(what_if(replace(model, flight=blind), [{"EKF2_EVP_GATE": 3.0}]))
    for summary in (made.logged, made.replayed, *made.whatif):
        assert isinstance(summary.axes["north"].position_rmse_to_truth_m, Unavailable)


def test_sweeps(model: Model) -> None:
    values = sweep_values("EKF2_EVP_NOISE", 0.02, 0.5, 5)
    assert values == pytest.approx(np.geomspace(0.02, 0.5, 5))
    made = found(sweep(model, "EKF2_EVP_NOISE", values))
    nis = [summary.axes["north"].nis_mean for summary in made.whatif]
    assert nis == sorted(nis, reverse=True)
    assert [summary.changed["EKF2_EVP_NOISE"] for summary in made.whatif] == values
    assert sweep_values("EKF2_EV_DELAY", 0.0, 200.0, 5) == [0.0, 50.0, 100.0, 150.0, 200.0]


@pytest.mark.parametrize(
    ("name", "low", "high", "count", "said"),
    [
        ("EKF2_EVP_NOISE", 0.5, 0.02, 5, "smaller"),
        ("EKF2_EVP_NOISE", 0.02, 0.5, 1, "between 2 and 200"),
        ("EKF2_EVP_NOISE", 0.0, 0.5, 5, "outside PX4's range"),
        ("EKF2_BARO_NOISE", 1.0, 2.0, 5, "does not have this parameter"),
    ],
)
def test_senseless_sweeps_are_refused(
    name: str, low: float, high: float, count: int, said: str
) -> None:
    with pytest.raises(SettingsError, match=said):
        sweep_values(name, low, high, count)


def test_parameters_are_checked_by_name_and_range() -> None:
    with pytest.raises(SettingsError) as error:
        check({"EKF2_HEAD_NOISE": 0.3})
    assert all(name in str(error.value) for name in PARAMETERS)
    assert "\n" not in str(error.value)
    for name, value in (
        ("EKF2_EVP_NOISE", 0.0), ("EKF2_EV_DELAY", -1.0), ("EKF2_EV_DELAY", float("nan")),
        ("EKF2_EVP_GATE", 0.5), ("EKF2_EV_NOISE_MD", 0.5), ("EKF2_EV_POS_X", float("inf")),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=name):
            check({name: value})
    for name, parameter in PARAMETERS.items():
        assert check({name: parameter.default}) == {name: parameter.default}


def test_defaults_are_the_releases() -> None:
    assert settings_in_force({})["EKF2_EV_DELAY"] == 0.0
    assert settings_in_force({"EKF2_AID_MASK": 8.0})["EKF2_EV_DELAY"] == 175.0
    assert settings_in_force({"EKF2_AID_MASK": 0.0, "EKF2_EV_CTRL": 1.0})["EKF2_EV_DELAY"] == 0.0
    assert settings_in_force({"EKF2_EVP_NOISE": 0.2})["EKF2_EVP_NOISE"] == 0.2


def stages(model: Model) -> dict[str, pd.DataFrame]:
    """Track of the filter after each step."""
    variants = _variants(model, OurFilter())
    delayed, flown = delayed_variants(model, list(variants.values()))
    tracks = (*delayed, flown.delayed, flown.published)
    return dict(zip((*variants, OUTPUT), tracks, strict=True))


def walked(result: Walk | Unavailable) -> Walk:
    assert isinstance(result, Walk)
    return result


def test_the_bars_add_up_and_little_is_left(model: Model) -> None:
    made = walked(walk(model))
    assert made.coast is None
    for axis in made.axes.values():
        assert tuple(step.name for step in axis.steps) == STEPS
        position = sum(step.position_mean_square_m2 for step in axis.steps)
        velocity = sum(step.velocity_mean_square_m2_s2 for step in axis.steps)
        assert position + axis.position_left_mean_square_m2 == pytest.approx(
            axis.position_mean_square_m2, abs=1e-12
        )
        assert velocity + axis.velocity_left_mean_square_m2_s2 == pytest.approx(
            axis.velocity_mean_square_m2_s2, abs=1e-12
        )
        assert axis.position_left_share < 0.03
        by_name = {step.name: step for step in axis.steps}
        # what is the same in both filters moves nothing
        assert by_name["measurement noise"].position_moved_m < 1e-6
        assert by_name["gate, missed samples, resets"].position_moved_m < 1e-6
        largest = sorted(axis.steps, key=lambda step: -step.position_mean_square_m2)[:2]
        assert {step.name for step in largest} == {"process noise", OUTPUT}
        last = axis.steps[-1].position_rmse_to_truth_m
        assert last == pytest.approx(axis.position_rmse_to_truth_m["ekf2"], abs=0.003)


def test_the_ends_of_the_walk_are_student_and_model_against_log(model: Model) -> None:
    made = walked(walk(model))
    assert isinstance(model.flight.ekf2, Ekf2)
    logged = model.flight.ekf2.state
    tracks = stages(model)
    inside = (logged.index > model.flown.stretches_s[0][0] + 5.0) & (
        logged.index < model.flown.stretches_s[0][1]
    )
    times = logged.index[inside]
    assert len(made.times_s) == pytest.approx(len(times), abs=2)
    for axis in ("north", "east"):
        for ours, name in (
            (tracks[SAMPLES], "position_mean_square_m2"),
            (tracks[OUTPUT], "position_left_mean_square_m2"),
        ):
            there = np.interp(times, ours.index, ours[f"{axis}_m"])
            square = np.mean((there - logged.loc[times, f"{axis}_m"]) ** 2)
            assert getattr(made.axes[axis], name) == pytest.approx(square, rel=0.02)


def test_the_walk_starts_where_the_student_is(model: Model) -> None:
    plain = walked(walk(model))
    noisy = walked(walk(model, OurFilter(sigma_z_m=0.5)))
    north = plain.axes["north"], noisy.axes["north"]
    assert north[1].position_mean_square_m2 != pytest.approx(
        north[0].position_mean_square_m2, rel=0.05
    )
    assert north[1].position_left_mean_square_m2 == pytest.approx(
        north[0].position_left_mean_square_m2, rel=1e-9
    )
    assert abs(noisy.axes["north"].steps[2].position_mean_square_m2) > 1e-5
    late = walked(walk(model, OurFilter(clock_offset_s=-0.3)))
    assert late.axes["north"].steps[0].position_moved_m == 0.0
    assert late.axes["north"].steps[1].position_moved_m > 0.2


def test_a_track_of_ones_own_is_the_first_step(model: Model) -> None:
    plain = walked(walk(model))
    # a track of one's own: 0.4 m off, so that 0.16 m² more are to be explained by the first step
    first = stages(model)[SAMPLES]
    track = pd.DataFrame({"position_m": first["north_m"] + 0.4, "velocity_m_s": first["north_m_s"]})
    own = walked(walk(model, lines={"north": AxisLine(1.0, 0.0, track)})).axes["north"]
    bias = np.mean(track["position_m"] - model.flown.published["north_m"])
    assert own.position_mean_square_m2 > 0.8 * bias**2
    assert own.position_mean_square_m2 == pytest.approx(
        own.position_left_mean_square_m2 + sum(step.position_mean_square_m2 for step in own.steps),
        abs=1e-12,
    )
    assert own.steps[0].position_moved_m == pytest.approx(0.4, abs=1e-6)
    for ours, theirs in zip(own.steps[1:], plain.axes["north"].steps[1:], strict=True):
        assert ours.position_mean_square_m2 == pytest.approx(theirs.position_mean_square_m2)


def test_a_slanted_axis_is_the_projection(model: Model) -> None:
    half = np.sqrt(0.5)
    made = walked(
        walk(model, lines={"aisle": AxisLine(half, half), "across": AxisLine(half, -half)})
    ).axes
    plain = walked(walk(model)).axes
    for name in (
        "position_mean_square_m2",
        "position_left_mean_square_m2",
        "velocity_mean_square_m2_s2",
    ):
        sums = [sum(getattr(axis, name) for axis in axes.values()) for axes in (made, plain)]
        assert sums[0] == pytest.approx(sums[1], rel=1e-9)  # turning keeps the squares
    assert made["aisle"].position_mean_square_m2 != pytest.approx(
        plain["north"].position_mean_square_m2
    )


def test_a_track_of_another_time_is_refused(model: Model) -> None:
    elsewhere = pd.DataFrame(
        {"position_m": 0.0, "velocity_m_s": 0.0},
        index=pd.Index(model.flown.delayed.index.to_numpy() + 1e4, name="time_s"),
    )
    result = walk(model, lines={"north": AxisLine(1.0, 0.0, elsewhere)})
    assert isinstance(result, Unavailable)
    assert "no time in common" in result.reason


# ---------------------------------------------------------------- on numbers whose answer is known


def test_the_walk_changes_one_thing_after_the_other() -> None:
    flown = {"EKF2_EVP_NOISE": 0.3, "EKF2_EV_NOISE_MD": 0.0, "EKF2_ACC_NOISE": 0.35}
    model = made(Model, inputs=made(Inputs, settings=flown, step_s=0.01))
    found = list(_variants(model, OurFilter(0.5, 0.2, 0.16, -0.05)).values())
    assert [one.settings["EKF2_ACC_NOISE"] for one in found] == pytest.approx(
        [2.0] * 4 + [0.35] * 3
    )
    assert [one.settings["EKF2_EVP_NOISE"] for one in found] == [0.2] * 2 + [0.3] * 5
    assert [one.settings["EKF2_EV_NOISE_MD"] for one in found] == [1.0] * 2 + [0.0] * 5
    assert [one.biases for one in found] == [False] * 3 + [True] * 4
    assert [one.attitude for one in found] == [False] * 5 + [True] * 2
    assert [one.gated for one in found] == [False] * 6 + [True]
    assert [one.as_logged for one in found] == [False] * 6 + [True]
    assert [one.stamp_offset_s for one in found] == [-0.05] + [None] * 6


def test_the_longest_run_of_rejections_is_told_with_how_far_it_led() -> None:
    taken = 20.0 + np.arange(10.0)
    updates = pd.DataFrame(
        {"rejected": [0, 1, 0, 0, 1, 1, 1, 0, 1, 1], "fused_at_s": taken + 0.5}, index=taken
    )
    time = np.arange(20.0, 31.0, 0.5)
    still = pd.DataFrame(0.0, index=time, columns=STATE_COLUMNS)
    away = still.copy()
    away.iloc[:, 0] = np.where(time == 26.5, 3.0, 0.0)
    away.iloc[:, 1] = np.where(time == 26.5, -4.0, np.where(time < 24.0, 99.0, 0.0))
    one = made(Ekf2Replay, updates=updates, delayed=away)
    found = _coast(one, still, (0.0, 99.0), ((0.0, 99.0),))
    assert found is not None
    assert (found.start_s, found.samples, found.duration_s) == (24.5, 3, 3.0)
    assert found.distance_m == pytest.approx(5.0)
    # what is not judged, and what nobody rejected
    early = _coast(one, still, (0.0, 22.0), ((0.0, 99.0),))
    assert early is not None
    assert (early.start_s, early.samples, early.duration_s) == (21.5, 1, 0.0)
    assert _coast(one, still, (22.4, 24.4), ((0.0, 99.0),)) is None


def truth_of(where: dict[str, float]) -> Truth:
    frame = pd.DataFrame(0.0, index=[10.0, 20.0], columns=STATE_COLUMNS)
    return made(Truth, samples=frame.assign(**where))


def test_errors_to_the_truth_are_of_its_own_span() -> None:
    times = np.array([9.0, 10.0, 15.0, 20.0, 21.0])
    off = np.array([9.0, 3.0, 4.0, 5.0, 9.0])
    flight = made(Flight, truth=truth_of({"north_m": 1.0, "east_m": 2.0}))
    line = AxisLine(0.6, 0.8)  # along which the truth is at 2.2 m
    model = SimpleNamespace(flight=flight)
    found = walk_to_truth(model, 2.2 + off, line, times)  # type: ignore[arg-type]
    assert found == pytest.approx(math.sqrt(50.0 / 3.0))
    later = walk_to_truth(model, off[:1], line, times[:1])  # type: ignore[arg-type]
    assert isinstance(later, Unavailable)
    published = pd.DataFrame({"east_m": 2.0 + off}, index=times)
    assert _to_truth(flight, published, "east", times) == pytest.approx(math.sqrt(50.0 / 3.0))
    assert isinstance(_to_truth(flight, published, "east", times[:1]), Unavailable)
    assert isinstance(_to_truth(made(Flight, truth=NONE), published, "east", times), Unavailable)


def test_the_longest_time_without_fusion_counts_both_ends() -> None:
    judged = ((15.0, 30.0), (40.0, 60.0))
    assert _longest(np.array([16.0, 29.0, 41.0, 59.0]), judged) == 18.0
    assert _longest(np.array([40.0]), judged) == 25.0
    assert _longest(np.array([16.0]), judged) == 44.0


def test_the_stated_sigma_goes_from_after_one_sample_to_before_the_next() -> None:
    """At the middle between them the variance is the mean of 0.01 after and 0.09 before."""
    updates = pd.DataFrame(
        {
            "innovation_variance_east_m2": [0.05, 0.13], "observation_variance_east_m2": 0.04,
            "position_variance_east_m2": [0.01, 0.02], "fused_at_s": [20.0, 22.0],
        }
    )  # fmt: skip
    ekf2 = made(Ekf2, variance=pd.DataFrame(index=[21.0]))
    one = made(Ekf2Replay, updates=updates)
    assert _sigma(ekf2, one, "east", ((10.0, 30.0),)) == pytest.approx(math.sqrt(0.05))
    assert _sigma(made(Ekf2, variance=NONE), one, "east", ((10.0, 30.0),)) is NONE


def test_a_summary_joins_north_and_east() -> None:
    def axis(nis: float, error: Any) -> AxisSummary:
        return AxisSummary(nis, (0.9, 1.1), 0.1, 0.1, error)

    one = Summary({}, axis(1.0, 0.3), axis(3.0, 0.4), 9, 0.0, 0.1, 0)
    assert one.nis_mean == 2.0
    assert one.position_rmse_to_truth_m == pytest.approx(0.5)
    lacking = replace(one, east=axis(3.0, NONE))
    assert lacking.position_rmse_to_truth_m is NONE


def test_samples_that_come_too_late_are_a_note() -> None:
    for by_delay, remedy in ((False, ": raise EKF2_DELAY_MAX"), (True, "")):
        rules = replace(RULES, horizon_by_delay=by_delay)
        model = SimpleNamespace(inputs=SimpleNamespace(rules=rules))
        one = SimpleNamespace(late=3, lost=2, updates=range(8), changed={"EKF2_EV_DELAY": 90.0})
        (note,) = _notes(model, one)  # type: ignore[arg-type]
        assert note == (
            "EKF2_EV_DELAY=90: 5 of 10 samples would reach EKF2 after its fusion horizon has "
            f"passed them (2 would never be fused){remedy}"
        )
        assert _notes(model, SimpleNamespace(late=0, lost=0)) == []  # type: ignore[arg-type]
        one.late, one.changed = 0, {}
        assert _notes(model, one)[0].startswith("as flown: 2 of 10 samples")  # type: ignore[arg-type]


def test_what_is_left_is_a_share_of_all() -> None:
    assert (
        made(
            AxisWalk, position_left_mean_square_m2=1.0, position_mean_square_m2=4.0
        ).position_left_share
        == 0.25
    )
    frame = pd.DataFrame({"north_m": [0.0, 2.0], "east_m": [4.0, 4.0]}, index=[0.0, 1.0])
    along = AxisLine(0.6, 0.8).along(frame, ["north_m", "east_m"], np.array([0.5]))
    assert along == pytest.approx([3.8])
