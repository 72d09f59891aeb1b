"""Actions for KF and EKF2: their effect is confirmed by a replay or ground truth, or not."""

import re
from functools import cache

import pytest
from exchange import replace

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison import remedy as remedies
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.remedy import ml_ekf2_parameters, noise_used_m
from px4fuse.ekf2.model import replay_settings
from px4fuse.ekf2.whatif import AxisSummary, Summary, what_if
from px4fuse.filter.settings import Settings
from px4fuse.findings import Finding, ekf2_rejecting, find, source_clock
from px4fuse.flight import Unavailable
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

AXES = ("north", "east", "down")
FIELDS = {"sigma-z": "sigma_z_m", "sigma-a": "sigma_a_m_s2", "clock-offset": "clock_offset_s"}
ROUNDING = 1.01  # factor on the RMSE, from rounding settings to the printed digits
AISLE = Scenario(passes=3, seed=3)
LOOP = Scenario(kind="loop", passes=1, length_m=8.0, vio_rate_hz=10.0)


@cache
def flown(scenario: Scenario, settings: Settings, *mistakes: str) -> Analysis:
    return explain(compare(simulate_flight(scenario, parse(mistakes)), settings, axes=AXES))


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
def test_remedies_followed_do_not_increase_rmse(settings, mistakes) -> None:
    analysis = flown(AISLE, Settings(**settings), *mistakes)
    comparison, model = analysis, analysis.ekf2_model
    followed = 0
    for remedy in (finding.remedy for finding in find(analysis)):
        if re.search(r"Leave it|No change advised|no remedy|does not help", remedy):
            continue
        if kf_settings := typed(remedy):
            segment = {each: getattr(analysis.segment, each) for each in ("start_s", "end_s")}
            chosen = replace(analysis.settings, **kf_settings)
            again = compare(analysis.flight, chosen, axes=AXES, **segment)
            assert errors_m(again) <= ROUNDING * errors_m(comparison), remedy
            followed += 1
        if changes := parameters(remedy):
            done = what_if(model, [changes])
            before, after = (
                each.position_rmse_to_truth_m for each in (done.replayed, *done.whatif)
            )
            assert after <= ROUNDING * before, remedy
            followed += 1
    assert followed or mistakes == ("nlos=5%",)


@pytest.mark.parametrize(("seed", "mistakes"), [(1, ()), (2, ("ekf2-noise=50cm",))])
def test_find_drifting_vio_lists_error_first_and_keeps_noises(seed, mistakes) -> None:
    """With PX4's default noise, and with an EKF2 noise of 50 times the short-term noise."""
    analysis = flown(replace(LOOP, seed=seed), Settings(), *mistakes)
    findings = find(analysis)
    first = findings[0]
    assert first.id == "error_exceeds_reported_sigma"
    assert first.evidence["kf_nees_position_mean"] > 100.0 * first.evidence["kf_nis_mean"]
    for finding in findings:
        assert "set EKF2_EVP_NOISE" not in finding.remedy
        assert "--sigma-z" not in finding.remedy
    estimated = ml_ekf2_parameters(analysis, analysis.ekf2_model, analysis.tuning, analysis.clock)
    flown_with = analysis.ekf2_model.inputs.settings["EKF2_EVP_NOISE"]
    assert estimated.get("EKF2_EVP_NOISE", flown_with) >= flown_with


def test_kf_remedy_contradicted_by_truth_is_not_advised() -> None:
    comparison = flown(AISLE, Settings())
    worse = remedies.format_kf_remedy(comparison, {"sigma_z_m": 3.0})
    assert not worse.startswith("px4fuse compare")
    assert "--sigma-z 3 fits the innovations better" in worse
    truth = Unavailable("ground truth", "none", "")
    axes = {}
    for name, axis in comparison.axes.items():
        filters = {each: replace(one, truth=truth) for each, one in axis.filters.items()}
        axes[name] = replace(axis, truth=truth, filters=filters)
    blind = replace(comparison, axes=axes)
    typed = "px4fuse compare LOG --sigma-z 0.2."
    assert remedies.format_kf_remedy(blind, {"sigma_z_m": 0.2}, held_out_nats=0.1) == typed
    unseen = remedies.format_kf_remedy(blind, {"sigma_z_m": 0.2}, held_out_nats=-0.1)
    assert not unseen.startswith("px4fuse compare")
    assert "first half" in unseen


# ---------------------------------------------------------------- EKF2

NO_TRUTH = Unavailable("truth", "none", "None.")


def flown_with(analysis: Analysis, **changes: float) -> Analysis:
    """Make the analysis of a flight with other EKF2 parameters."""
    model = analysis.ekf2_model
    (flown,) = replay_settings(model, [changes])
    inputs = replace(model.inputs, settings={**model.inputs.settings, **changes})
    return replace(analysis, ekf2_model=replace(model, inputs=inputs, flown=flown))


def offset(analysis: Analysis, offset_s: float) -> Analysis:
    """Make the analysis with another estimated time offset."""
    clock = replace(
        analysis.clock, offset_s=offset_s, interval_s=(offset_s - 0.01, offset_s + 0.01),
        sigma_s=0.005, is_determinable=True, change_p_value=None,
    )  # fmt: skip
    return replace(analysis, clock=clock)


def summary(
    nis: float, rejected: float = 0.0, error: float | Unavailable = 0.1, std: float = 0.1
) -> Summary:
    axis = AxisSummary(nis, (0.9, 1.1), std, 0.05, error)
    return Summary(
        changed={}, north=axis, east=axis, samples=600, rejected_fraction=rejected,
        longest_without_fusion_s=0.2, resets=0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("after", "noise", "fewer", "delay"),
    [
        (summary(1.0, 0.0, 0.08, 0.09), True, True, True),
        (summary(1.0, 0.0, NO_TRUTH, 0.09), True, True, True),
        (summary(1.0, 0.0, 0.12, 0.09), False, False, False),  # RMSE 20 % larger
        (summary(9.0, 0.0, 0.08, 0.09), False, True, True),  # mean NIS unchanged
        (summary(0.05, 0.0, 0.08, 0.09), False, True, True),  # mean NIS as far below 1
        (summary(1.0, 0.2, 0.08, 0.09), True, False, True),
        (summary(1.0, 0.3, 0.08, 0.09), False, False, False),
        (summary(1.0, 0.0, 0.08, 0.11), True, True, False),
    ],
)  # fmt: skip
def test_remedy_tests_require_improvement_without_larger_rmse(after, noise, fewer, delay) -> None:
    known = isinstance(after.axes["north"].position_rmse_to_truth_m, float)
    before = summary(10.0, 0.25, 0.1 if known else NO_TRUTH, 0.1)
    assert remedies.noise_helps(before, after) is noise
    assert remedies.rejects_less(before, after) is fewer
    assert remedies.delay_helps(before, after) is delay


def ekf2_remedy(analysis: Analysis, **changes: float) -> str:
    model, why, fallback_remedy = analysis.ekf2_model, "Reason: ", "Other action."
    return remedies.format_ekf2_remedy(
        model, changes, remedies.noise_helps, prefix=why, fallback_remedy=fallback_remedy
    )


def test_ekf2_remedy_states_replay_result_or_reason(sample: Analysis) -> None:
    overconfident = flown_with(sample, EKF2_EVP_NOISE=0.03)
    text = ekf2_remedy(overconfident, EKF2_EVP_NOISE=0.1)
    assert text.startswith("Reason: set EKF2_EVP_NOISE to 0.1 m: rejected ")
    assert re.search(r"→ 0 ?%, mean NIS", text)
    text = ekf2_remedy(sample, EKF2_EVP_NOISE=0.5)  # the flown value is correct
    assert text.startswith("Other action. EKF2_EVP_NOISE 0.5")
    assert "mean NIS 0.9 → 0.041" in text
    blind = replace(sample, ekf2_model=Unavailable("EKF2 replay", "no IMU", "Record it."))
    text = ekf2_remedy(blind, EKF2_EVP_NOISE=0.2)
    assert text.startswith("Reason: set EKF2_EVP_NOISE to 0.2 m. ")
    assert "no IMU" in text
    model = sample.ekf2_model
    agreement = replace(model.agreement, good=False, reason="they differ")
    doubtful = replace(sample, ekf2_model=replace(model, agreement=agreement))
    assert "they differ" in ekf2_remedy(doubtful, EKF2_EVP_NOISE=0.2)


def test_ml_ekf2_parameters_follow_noise_and_time_offset(sample: Analysis) -> None:
    model, comparison = sample.ekf2_model, sample

    def estimated(analysis: Analysis) -> dict[str, float]:
        return ml_ekf2_parameters(comparison, model, analysis.tuning, analysis.clock)

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
    assert ml_ekf2_parameters(other, model, sample.tuning, sample.clock) == {}


def test_noise_change_reported_variance_sets_noise_mode(sample: Analysis) -> None:
    model = sample.ekf2_model
    assert noise_used_m(model) == pytest.approx(0.1)
    flown = model.inputs.aid, model.inputs.settings, noise_used_m(model)
    assert remedies.noise_change(*flown, 0.0012345) == {"EKF2_EVP_NOISE": 0.01}
    settings = {**model.inputs.settings, "EKF2_EVP_NOISE": 0.02, "EKF2_EV_NOISE_MD": 0.0}
    reported = replace(model, inputs=replace(model.inputs, settings=settings))
    used = reported.inputs.aid, settings, noise_used_m(reported)
    assert remedies.noise_change(*used, 0.05) == {"EKF2_EVP_NOISE": 0.05, "EKF2_EV_NOISE_MD": 1.0}
    assert remedies.noise_change(*used, 0.2) == {"EKF2_EVP_NOISE": 0.2}
    assert remedies.delay_change(model.inputs, -40.0) == {}
    assert remedies.delay_change(model.inputs, 400.0) == {}


def only(name: str, analysis: Analysis) -> Finding:
    found = (*ekf2_rejecting.detect(analysis), *source_clock.detect(analysis))
    (finding,) = [each for each in found if each.id == name]
    return finding


def test_delay_remedy_worse_replay_is_not_proposed(sample: Analysis) -> None:
    """The timestamps of the sample are correct; a replay with 150 ms is worse."""
    finding = only("ekf2_ev_delay_wrong", offset(sample, -0.15))
    assert finding.remedy == "Correct the timestamps at the sender."
    # ground truth contradicts --clock-offset too
    found = [finding.id for finding in source_clock.detect(offset(sample, -0.15))]
    assert found == ["ekf2_ev_delay_wrong"]
