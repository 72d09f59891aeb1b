"""Causes of inconsistency: each re-run equals a replay, and the simulated cause is found."""

from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
from comparisons import compare
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison.rerun_effects import (
    FORWARD_BIAS_KEY,
    OUTLIERS_KEY,
    ROTATION_KEY,
    TIME_OFFSET_KEY,
    Rerun,
    RunStatistics,
    brings_inside_limits,
    compute_explained_fraction,
    find_cause_rerun,
    find_reruns,
)
from px4fuse.comparison.rerun_effects import RIGHT_BIAS_KEY as TO_RIGHT
from px4fuse.comparison.reruns import (
    list_rerun_configurations,
    rerun_filters,
)
from px4fuse.diagnose import diagnose_comparison
from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.model import add_position_noise, misalign_positions, replay_with_settings
from px4fuse.ekf2.whatif import what_if
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Columns, Unavailable
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

RIGHT = Settings(0.27, 0.10)
LATE = "clock-offset=0.25"
SLOW = pytest.mark.slow


@cache
def flown(*mistakes: str, sigma_a=0.27, sigma_z=0.10, passes=4) -> Analysis:
    flight = simulate_flight(Scenario(seed=5, passes=passes), parse_faults(mistakes))
    return diagnose_comparison(
        compare(flight, Settings(sigma_a, sigma_z), axes=("aisle", "north", "east"))
    )


def cause(analysis: Analysis, owner: Any, of: Any = "nis") -> Rerun:
    return find_cause_rerun(analysis.reruns, owner, "aisle", of)


def test_filter_reruns_of_consistent_flight_find_no_discrepancy() -> None:
    assert not any(trial.discrepancies for trial in flown().reruns)


@pytest.mark.parametrize(
    ("mistake", "settings", "owner", "of", "change"),
    [
        ("", {"sigma_z": 0.03}, "kf", "nis", {"sigma_z_m": (0.1, 0.01)}),
        pytest.param(
            "", {"sigma_z": 0.4}, "kf", "nis", {"sigma_z_m": (0.1, 0.01)}, marks=SLOW
        ),
        ("", {"sigma_a": 0.02}, "kf", "nis", {"sigma_a_m_s2": (0.27, 0.05)}),
        ("nlos=7%", {}, "kf", "nis", {OUTLIERS_KEY: (25, 4)}),
        ("nlos=7%", {}, "ekf2", "nis", {OUTLIERS_KEY: (25, 4)}),
        ("nlos=7%", {"sigma_z": 0.05}, "kf", "nis",
         {OUTLIERS_KEY: (25, 4), "sigma_z_m": (0.1, 0.01)}),
        (LATE, {}, "kf", "nees", {TIME_OFFSET_KEY: (-0.25, 0.06)}),
        (LATE, {}, "ekf2", "nees",
         {"EKF2_EV_DELAY": (250, 60), "EKF2_DELAY_MAX": (300, 0)}),
        # no parameter of EKF2 shifts positions to an earlier time than their timestamp
        pytest.param(
            "clock-offset=-0.19", {}, "ekf2", "nees", {TIME_OFFSET_KEY: (0.19, 0.06)}, marks=SLOW
        ),
        ("accel-bias=0.5", {}, "kf", "nis",
         {FORWARD_BIAS_KEY: (0.5, 0.03), TO_RIGHT: (-0.04, 0.03)}),
        ("yaw=20", {}, "kf", "nees", {ROTATION_KEY: (-20, 4)}),
        ("yaw=20", {}, "ekf2", "nees", {ROTATION_KEY: (-20, 4)}),
        ("ekf2-noise=0.03", {}, "ekf2", "nis", {"EKF2_EVP_NOISE": (0.1, 0.01)}),
        pytest.param(
            "ekf2-noise=0.5", {}, "ekf2", "nis", {"EKF2_EVP_NOISE": (0.1, 0.01)}, marks=SLOW
        ),
        pytest.param(
            "ekf2-gate=1", {"passes": 6}, "ekf2", "nis", {"EKF2_EVP_GATE": (5, 0)}, marks=SLOW
        ),
        ("ekf2-delay=0.175", {}, "ekf2", "nees", {"EKF2_EV_DELAY": (0, 0)}),
    ],
)  # fmt: skip
def test_filter_reruns_find_the_simulated_fault_as_cause(
    mistake, settings, owner, of, change
) -> None:
    analysis = flown(*filter(None, (mistake,)), **settings)
    found = cause(analysis, owner, of)
    assert found.change.keys() == change.keys()
    for name, (value, within) in change.items():
        assert found.change[name] == pytest.approx(value, abs=within)
    distance = abs(compute_explained_fraction(found, of) - 1.0)
    assert brings_inside_limits(found, of) or (found.corrects_sensor and distance <= 0.25)


def test_kf_rerun_without_bias_equals_run_on_unbiased_imu() -> None:
    analysis = flown("accel-bias=0.5")
    found, imu = cause(analysis, "kf"), analysis.flight.imu
    without = imu[Columns.SPECIFIC_FORCE] - [
        found.change[FORWARD_BIAS_KEY],
        found.change[TO_RIGHT],
        0.0,
    ]
    flight = replace(analysis.flight, imu=imu.assign(**without))
    again = compare(flight, analysis.settings).axes["aisle"].filters["kf"]
    assert found.after.nis_mean == pytest.approx(again.nis_mean, rel=1e-6)


def test_filter_rerun_for_vibration_increases_ekf2_acc_noise() -> None:
    analysis = flown("vibration=1.5")
    found = cause(analysis, "ekf2", "nis")
    assert found.change == {"EKF2_ACC_NOISE": 1.0}  # PX4's maximum
    assert compute_explained_fraction(found, "nis") > 0.5
    assert not any("EKF2_ACC_NOISE" in row.change for row in flown("nlos=7%").reruns)


def test_ekf2_is_rerun_with_time_offset_that_kf_already_uses() -> None:
    bare = flown("clock-offset=-0.19")
    offset_s = cause(bare, "kf", "nees").change[TIME_OFFSET_KEY]
    analysis = diagnose_comparison(compare(bare.flight, replace(RIGHT, clock_offset_s=offset_s)))
    assert {row.filter for row in analysis.reruns if row.discrepancies} == {"ekf2"}
    again, before = cause(analysis, "ekf2", "nees"), cause(bare, "ekf2", "nees")
    assert again.change == pytest.approx(before.change, abs=0.01)
    assert again.after.nees_mean == pytest.approx(before.after.nees_mean, rel=0.05)


@pytest.mark.parametrize(
    ("analysis", "of"), [(lambda: flown(sigma_z=0.03), "nis"), (lambda: flown(LATE), "nees")]
)
def test_kf_rerun_equals_compare_with_the_changed_setting(analysis, of) -> None:
    analysis = analysis()
    found = find_cause_rerun(analysis.reruns, "kf", "north", of)
    again = compare(analysis.flight, replace(analysis.settings, **found.change))

    def statistic(of_comparison: Any) -> float:
        kf = of_comparison.axes["north"].filters["kf"]
        return float(kf.nis_mean if of == "nis" else kf.truth.nees_position_mean)

    before, after = found.before.value(of), found.after.value(of)
    assert before == pytest.approx(statistic(analysis), rel=1e-9)
    # the re-run's NEES is at KF's steps, that of the comparison at EKF2's sample times
    assert after == pytest.approx(statistic(again), rel=1e-6 if of == "nis" else 0.1)
    assert compute_explained_fraction(found, of) == pytest.approx(
        1.0 - np.log(after) / np.log(before)
    )


def test_ekf2_rerun_equals_ekf2_replay_with_the_same_parameters() -> None:
    analysis = flown("ekf2-noise=0.03")
    found = [find_cause_rerun(analysis.reruns, "ekf2", axis) for axis in ("north", "east")]
    model, change = analysis.ekf2_model, found[0].change  # type: ignore[union-attr]
    replays = what_if(replace(model, runs=()), [change])  # a copy without cached replays
    for one, axis in zip(found, ("north", "east"), strict=True):
        nis_before = pytest.approx(one.before.nis_mean, rel=0.1)  # of the log
        assert replays.replayed.axes[axis].nis_mean == nis_before
        assert analysis.axes[axis].filters["ekf2"].nis_mean == nis_before
        nis_after = replays.whatif[0].axes[axis].nis_mean
        assert one.after.nis_mean == pytest.approx(nis_after, rel=1e-9)
    # the configuration was planned with EKF2 as flown; other positions give another replay
    assert FilterConfiguration({**model.inputs.settings, **change}) in list_rerun_configurations(
        analysis, analysis, model.inputs
    )
    once, other = (
        next(replay_with_settings(of, [change]))
        for of in (model, add_position_noise(model, 0.01, 1))
    )
    assert not once.updates.equals(other.updates)


rms_difference = attrgetter("main.difference.position_rms_m")


def test_rerun_reports_kf_ekf2_difference_before_and_after_fix() -> None:
    kf_case = flown(sigma_a=0.02)
    right = compare(kf_case.flight, replace(kf_case.settings, **cause(kf_case, "kf").change))
    row = cause(kf_case, "kf")
    assert (row.before.difference_rms_m, row.after.difference_rms_m) == pytest.approx(
        (rms_difference(kf_case), rms_difference(right))
    )
    assert compute_explained_fraction(row, "difference") > 0.8
    # corrected EKF2 differs from KF as much as EKF2 in the same flight without the fault
    ekf2_case = flown("ekf2-gate=1", passes=6)
    right = compare(simulate_flight(Scenario(seed=5)), RIGHT)
    row = cause(ekf2_case, "ekf2")
    assert (row.before.difference_rms_m, row.after.difference_rms_m) == pytest.approx(
        (rms_difference(ekf2_case), rms_difference(right)), rel=0.1
    )


@pytest.mark.slow
def test_rerun_with_time_offset_also_shifts_excluded_outliers() -> None:
    analysis = flown("clock-offset=-0.19", "nlos=7%")
    count = cause(analysis, "ekf2").change[OUTLIERS_KEY]
    rows = [one for one in analysis.reruns if one.filter == "ekf2" and one.axis == "aisle"]
    alone = next(one for one in rows if one.change == {OUTLIERS_KEY: count})
    assert brings_inside_limits(alone, "nis")
    model, out = analysis.ekf2_model, analysis.tuning["horizontal"]
    (bare,) = replay_with_settings(model, [{}], out.outlier_time_s)
    (late,) = replay_with_settings(
        misalign_positions(model, 0.0, 0.19), [{}], out.outlier_time_s + 0.19
    )
    assert len(late.updates) == pytest.approx(len(bare.updates), abs=2)
    # both replays exclude their outliers
    for each in (bare, late):
        nis = each.updates["innovation_north_m"] ** 2 / each.updates["innovation_variance_north_m2"]
        assert nis.mean() < 1.3


def test_ekf2_is_rerun_with_px4_default_of_each_changed_noise() -> None:
    analysis = flown("ekf2-noise=0.03")
    settings = {**analysis.ekf2_model.inputs.settings, "EKF2_ACC_NOISE": 0.5, "EKF2_GYR_NOISE": 0.1}
    inputs = replace(analysis.ekf2_model.inputs, settings=settings)
    model = replace(analysis.ekf2_model, inputs=inputs)
    rows = rerun_filters(analysis, analysis, model)
    tried = [one.change for one in find_reruns(rows, "ekf2", "aisle")]
    assert tried[1:] == [{"EKF2_ACC_NOISE": 0.35}, {"EKF2_GYR_NOISE": 0.015}]


def test_rerun_with_small_reduction_of_excess_nis_is_no_cause() -> None:
    def one(change: Any, explains: float, *, into: bool = False) -> Rerun:
        after = RunStatistics(innovations=10 if into else 10**6, nis_mean=9.0 ** (1.0 - explains))
        return Rerun(
            filter="kf", axis="aisle", kinds=(), change=change, discrepancies=("nis",),
            before=RunStatistics(nis_mean=9.0), after=after,
        )  # fmt: skip

    for explains in (0.49, 1.51, -1.0):
        assert find_cause_rerun([one({"sigma_z_m": 1.0}, explains)], "kf", "aisle") is None
    part, whole = one({"sigma_a_m_s2": 0.1}, 0.99), one({"sigma_z_m": 1.0}, 0.9, into=True)
    assert (
        find_cause_rerun([part, whole], "kf", "aisle") is whole
    )  # a change into the band precedes a larger share
    both = one({TIME_OFFSET_KEY: 0.1, "sigma_z_m": 1.0}, 1.0, into=True)
    assert find_cause_rerun([both, whole], "kf", "aisle") is whole  # fewer changes precede
    fault = one({TIME_OFFSET_KEY: 0.1}, 0.9, into=True)
    assert (
        find_cause_rerun([whole, fault], "kf", "aisle") is fault
    )  # sensor faults precede settings
    nearly, far = (
        one({FORWARD_BIAS_KEY: 0.3, TO_RIGHT: 0.1}, 0.8),
        one({FORWARD_BIAS_KEY: 0.3, TO_RIGHT: 0.1}, 0.7),
    )
    assert (
        find_cause_rerun([whole, nearly], "kf", "aisle") is nearly
    )  # both bias components are one change
    assert find_cause_rerun([whole, far], "kf", "aisle") is whole
    assert (
        find_cause_rerun([whole], "ekf2", "aisle")
        is find_cause_rerun([whole], "kf", "north")
        is None
    )


def test_filter_rerun_without_required_data_is_skipped() -> None:
    analysis = flown("nlos=7%", sigma_z=0.05)
    missing = Unavailable("it", "not known", "None.")

    def tried(model: Any = analysis.ekf2_model, **parts: Any) -> set[tuple[str, str]]:
        rows = rerun_filters(analysis, replace(analysis, **parts), model)
        return {(row.filter, name) for row in rows if row.discrepancies for name in row.change}

    assert tried() == {("kf", "sigma_z_m"), ("kf", OUTLIERS_KEY), ("ekf2", OUTLIERS_KEY)}
    assert tried(model=missing) == {("kf", "sigma_z_m"), ("kf", OUTLIERS_KEY)}
    assert tried(tuning={}) == set()
    turned = HeadingError(
        misalignment_deg=2.9, sigma_deg=1.0, drifts=False, parts=(), drift_p=1.0, by="positions"
    )
    assert tried(heading=turned, tuning={}) == set()
    turned = replace(turned, misalignment_deg=3.1)
    assert tried(heading=turned, tuning={}) == {("kf", ROTATION_KEY), ("ekf2", ROTATION_KEY)}
