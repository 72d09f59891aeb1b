"""Actions for KF and EKF2, and the re-runs that confirm them."""

import re
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
from comparisons import compare
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy as remedies
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.remedy import estimate_ekf2_parameters, find_used_noise_m
from px4fuse.comparison.rerun_effects import (
    Rerun,
    RunStatistics,
    classify_improvement,
    find_rerun,
    has_effect,
)
from px4fuse.comparison.reruns import rerun_filters
from px4fuse.diagnose import diagnose_comparison
from px4fuse.ekf2.whatif import what_if
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import AxisTuning, NoiseEstimate
from px4fuse.finding import Finding
from px4fuse.findings import ekf2_settings, find, source_clock
from px4fuse.findings.cause_text import format_sender_action
from px4fuse.flight.model import GNSS_ORIGIN
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

AXES = ("north", "east", "down")
FIELDS = {"sigma-z": "sigma_z_m", "sigma-a": "sigma_a_m_s2", "clock-offset": "clock_offset_s"}
ROUNDING = 1.01  # factor on the RMSE, from rounding settings to the printed digits
AISLE = Scenario(passes=3, seed=3)
LOOP = Scenario(kind="loop", passes=1, length_m=8.0, vio_rate_hz=10.0)


@cache
def flown(scenario: Scenario, settings: Settings, *mistakes: str) -> Analysis:
    return diagnose_comparison(
        compare(simulate_flight(scenario, parse_faults(mistakes)), settings, axes=AXES)
    )


def errors_m(comparison: Comparison) -> float:
    truths = [result.filters["kf"].truth for result in comparison.axes.values()]
    return sum(truth.position_rmse_m**2 for truth in truths) ** 0.5  # type: ignore[union-attr]


def typed(remedy: str) -> dict[str, float]:
    """KF settings in an action."""
    number = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"
    return {
        FIELDS[name]: float(value)
        for name, value in re.findall(rf"--(sigma-z|sigma-a|clock-offset) {number}", remedy)
    }


def parameters(remedy: str) -> dict[str, float]:
    """EKF2 parameters that an action sets."""
    found = re.findall(r"(EKF2_\w+) to (\d+(?:\.\d+)?)", remedy)
    return {name: float(value) for name, value in found}


@pytest.mark.parametrize(
    ("settings", "mistakes"),
    [({}, ()), ({"sigma_z_m": 0.02}, ()), ({}, ("ekf2-noise=4cm",)), ({}, ("ekf2-delay=175ms",)),
     ({}, ("clock-offset=250ms",)), ({}, ("nlos=5%",))],
    ids=str,
)  # fmt: skip
def test_recommended_actions_do_not_increase_rmse_when_applied(settings, mistakes) -> None:
    analysis = flown(AISLE, Settings(**settings), *mistakes)
    comparison, model = analysis, analysis.ekf2_model
    followed = 0
    for remedy in (finding.remedy for finding in find(analysis)):
        if kf_settings := typed(remedy):
            segment = {each: getattr(analysis.segment, each) for each in ("start_s", "end_s")}
            chosen = replace(analysis.settings, **kf_settings)
            again = compare(analysis.flight, chosen, axes=AXES, **segment)
            assert errors_m(again) <= ROUNDING * errors_m(comparison), remedy
            followed += 1
        changes = parameters(remedy)
        # EKF2_DELAY_MAX alone is only one part of the action; the sender does the other part
        if changes.keys() - {"EKF2_DELAY_MAX"}:
            done = what_if(model, [changes])
            before, after = (
                each.position_rmse_to_truth_m for each in (done.replayed, *done.whatif)
            )
            assert after <= ROUNDING * before, remedy
            followed += 1
    assert followed or (not settings and mistakes in ((), ("nlos=5%",)))


@pytest.mark.parametrize(("seed", "mistakes"), [(1, ()), (2, ("ekf2-noise=50cm",))])
def test_vio_drift_is_reported_before_its_consequences(seed, mistakes) -> None:
    """With PX4's default noise, and with an EKF2 noise of 50 times the short-term noise."""
    analysis = flown(replace(LOOP, seed=seed), Settings(), *mistakes)
    findings = find(analysis)
    first = findings[0]
    assert first.id == "source_drift"
    assert first.evidence["kf_nees_position_mean"] > 100.0 * first.evidence["kf_nis_mean"]
    for finding in findings:
        assert "set EKF2_EVP_NOISE" not in finding.remedy
        assert "--sigma-z" not in finding.remedy
    estimated = estimate_ekf2_parameters(
        analysis, analysis.ekf2_model, analysis.tuning, analysis.time_offset
    )
    flown_with = analysis.ekf2_model.inputs.settings["EKF2_EVP_NOISE"]
    assert estimated.get("EKF2_EVP_NOISE", flown_with) >= flown_with


def trial(after: RunStatistics, change: str = "sigma_z_m", kind: str = "noises") -> Rerun:
    before = RunStatistics(nis_mean=16.0, nees_mean=9.0, position_rmse_m=0.5)
    return Rerun(
        filter="kf", axis="aisle", kinds=(kind,), change={change: 1.0}, before=before, after=after
    )


@pytest.mark.parametrize(
    ("nis", "nees", "rmse_m", "expected", "has"),
    [
        (1.0, 1.0, 0.4, "position and σ", True),
        (1.0, 1.0, 0.41, "σ only", True),
        (4.1, 9.0, 0.5, "nothing", True),  # the logarithm of √(mean NIS) falls by 49 %
        (3.9, 9.0, 0.5, "σ only", True),
        (1.0, 9.1, 0.4, "position", True),  # σ gets worse against ground truth
        (16.0, 9.0, 0.474, "nothing", True),
        (16.0, 9.0, 0.476, "nothing", False),
        (13.3, 9.0, 0.5, "nothing", False),
    ],
)
def test_rerun_improvement_is_classified_by_nis_nees_and_rmse(
    nis, nees, rmse_m, expected, has
) -> None:
    one = trial(RunStatistics(nis_mean=nis, nees_mean=nees, position_rmse_m=rmse_m))
    assert classify_improvement(one) == expected
    assert has_effect(one) is has


def test_rerun_with_fewest_changed_settings_is_recommended() -> None:
    right, near = (
        RunStatistics(nis_mean=1.0, nees_mean=1.0),
        RunStatistics(nis_mean=1.2, nees_mean=1.2),
    )
    pair = replace(trial(right), change={"sigma_z_m": 1.0, "sigma_a_m_s2": 1.0})
    alone, bias = trial(near), trial(right, "bias_forward_m_s2", "bias")
    trials = (pair, alone, bias)
    assert find_rerun(trials, "kf", "noises") is alone
    assert find_rerun(trials, "kf", "noises", "sigma_a_m_s2") is pair
    assert find_rerun((pair, trial(near)), "ekf2", "noises") is None
    unchanged = replace(alone, after=alone.before)
    assert find_rerun((unchanged,), "kf", "noises") is None


# ---------------------------------------------------------------- EKF2


def offset(analysis: Analysis, offset_s: float) -> Analysis:
    """Make the analysis with another estimated time offset, and its re-runs."""
    clock = replace(
        analysis.time_offset, offset_s=offset_s, interval_s=(offset_s - 0.01, offset_s + 0.01),
        sigma_s=0.005, is_determinable=True, change_p_value=None,
    )  # fmt: skip
    changed = replace(analysis, time_offset=clock)
    trials = rerun_filters(changed, changed, changed.ekf2_model)
    return replace(changed, reruns=trials)


def test_recommended_ekf2_noise_and_delay_equal_estimates(sample: Analysis) -> None:
    model, comparison = sample.ekf2_model, sample

    def estimated(analysis: Analysis) -> dict[str, float]:
        return estimate_ekf2_parameters(comparison, model, analysis.tuning, analysis.time_offset)

    assert estimated(sample) == {}  # 0.1 m is within the interval
    settings = {**model.inputs.settings, "EKF2_EVP_NOISE": 0.3}
    model = replace(model, inputs=replace(model.inputs, settings=settings))
    assert estimated(sample) == {"EKF2_EVP_NOISE": 0.098}
    assert estimated(replace(sample, tuning={})) == {}
    aisle = {"aisle": sample.tuning["horizontal"]}  # --axis aisle
    assert estimated(replace(sample, tuning=aisle))["EKF2_EVP_NOISE"] == pytest.approx(
        0.1, abs=0.01
    )
    late = estimated(offset(sample, -0.25))
    assert late == {"EKF2_EVP_NOISE": 0.098, "EKF2_EV_DELAY": 250.0, "EKF2_DELAY_MAX": 300.0}
    assert estimated(offset(sample, -0.14))["EKF2_EV_DELAY"] == 140.0
    assert "EKF2_EV_DELAY" not in estimated(offset(sample, -0.019))  # 0 is within the interval
    assert "EKF2_DELAY_MAX" not in estimated(offset(sample, -0.14))
    assert "EKF2_EV_DELAY" not in estimated(offset(sample, -0.4))  # beyond PX4's range
    assert "EKF2_EV_DELAY" not in estimated(
        offset(sample, 0.2)
    )  # early: EKF2_EV_DELAY is already 0
    other = replace(comparison, source=replace(comparison.source, name="another"))
    assert estimate_ekf2_parameters(other, model, sample.tuning, sample.time_offset) == {}


def test_advised_noise_below_vision_sigma_also_sets_ev_noise_md(sample: Analysis) -> None:
    model = sample.ekf2_model
    assert find_used_noise_m(model.inputs) == pytest.approx(0.1)
    flown = model.inputs.aid, model.inputs.settings, find_used_noise_m(model.inputs)
    assert remedies.make_noise_change(*flown, 0.0012345) == {"EKF2_EVP_NOISE": 0.01}
    settings = {**model.inputs.settings, "EKF2_EVP_NOISE": 0.02, "EKF2_EV_NOISE_MD": 0.0}
    reported = replace(model, inputs=replace(model.inputs, settings=settings))
    used = reported.inputs.aid, settings, find_used_noise_m(reported.inputs)
    assert remedies.make_noise_change(*used, 0.05) == {
        "EKF2_EVP_NOISE": 0.05,
        "EKF2_EV_NOISE_MD": 1.0,
    }
    assert remedies.make_noise_change(*used, 0.2) == {"EKF2_EVP_NOISE": 0.2}
    changes = {"EKF2_EVP_NOISE": 0.02, "EKF2_EV_NOISE_MD": 1.0}
    assert remedies.select_changed_settings(changes, settings) == {"EKF2_EV_NOISE_MD": 1.0}
    assert remedies.make_delay_change(model.inputs, -40.0) == {}
    assert remedies.make_delay_change(model.inputs, 400.0) == {}


def only(name: str, analysis: Analysis) -> Finding:
    found = (*ekf2_settings.detect_rejections(analysis), *source_clock.detect(analysis))
    (finding,) = [each for each in found if each.id == name]
    return finding


def test_ekf2_ev_delay_is_not_advised_if_rerun_is_worse(sample: Analysis) -> None:
    """The timestamps of the sample are correct; a replay with 150 ms is worse."""
    late = offset(sample, -0.15)
    assert not list(source_clock.detect(late))  # ground truth contradicts --clock-offset
    unrefuted = replace(late, reruns=tuple(one for one in late.reruns if one.filter == "ekf2"))
    finding = only("ekf2_ev_delay_wrong", unrefuted)
    assert finding.remedy == "Correct the position timestamps before sending."


def test_height_noise_advice_needs_estimate_far_from_setting(sample: Analysis) -> None:
    """The sample fuses the horizontal position only."""
    down = sample.tuning["down"]
    assert isinstance(down, AxisTuning)
    tuning = {"down": replace(down, **NoiseEstimate(0.6, 0.5, 0.7).as_fields("sigma_z_m"))}
    assert remedies.make_height_noise_advice(sample, tuning, 0.1) == ""
    flags = sample.flight.ekf2.fusion_flags.assign(vertical=1.0)
    ekf2 = replace(sample.flight.ekf2, fusion_flags=flags)
    fused = replace(sample, flight=replace(sample.flight, ekf2=ekf2))
    advice = remedies.make_height_noise_advice(fused, tuning, 0.1)
    assert "but the estimated height noise is 0.6 m. " in advice
    assert "send each position with a z variance of 0.36 m²." in advice
    assert remedies.make_height_noise_advice(fused, tuning, 0.4) == ""


def test_advised_delay_is_applied_offset_if_in_its_interval(sample: Analysis) -> None:
    clock = offset(sample, -0.145).time_offset  # the interval is ± 0.01 s
    for applied_s, expected_ms in ((0.0, 145.0), (-0.15, 150.0), (-0.2, 145.0)):
        clock = replace(clock, applied_s=applied_s)
        delay_ms = remedies.estimate_delay_if_not_as_logged_ms(sample, clock, 0.0)
        assert delay_ms == pytest.approx(expected_ms)


def test_clock_offset_option_does_not_hide_wrong_gnss_delay(sample: Analysis) -> None:
    """--clock-offset corrects KF only."""
    log = replace(sample.flight.log, parameters={"EKF2_GPS_DELAY": 0.0})
    source = replace(sample.source, origin=GNSS_ORIGIN)
    analysis = replace(
        offset(sample, -0.15), source=source, flight=replace(sample.flight, log=log), reruns=()
    )
    clock = replace(analysis.time_offset, applied_s=-0.15)
    (finding,) = source_clock.detect_wrong_delay(analysis, clock)
    assert finding.id == "ekf2_gps_delay_wrong"
    assert not list(source_clock.detect_time_offset(analysis, clock))
    # without --clock-offset, source_time_offset reports the same fault
    assert not list(source_clock.detect_wrong_delay(analysis, analysis.time_offset))


def test_sender_without_timesync_is_advised_to_answer_timesync() -> None:
    """PX4 ignores the timestamps of a sender that does not answer TIMESYNC."""
    for method, expected in ("arrival time", "Answer TIMESYNC"), ("TIMESYNC", "Subtract 0.400 s"):
        source: Any = SimpleNamespace(clock_map=SimpleNamespace(method=method))
        assert format_sender_action(source, -0.4).startswith(expected)
