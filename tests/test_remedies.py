"""What a remedy does to the error against the truth, and what is said of sources that drift."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from exchange import replace

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import AgainstTruth, Comparison
from px4fuse.comparison.remedy import asked_of_ekf2, filter_words
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.whatif import what_if
from px4fuse.filter.settings import Settings
from px4fuse.findings import Finding, find
from px4fuse.flight import Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

AXES = ("north", "east", "down")
FIELDS = {
    "sigma-z": "sigma_z_m",
    "sigma-a": "sigma_a_m_s2",
    "clock-offset": "clock_offset_s",
}
# What rounding to the digits that are printed may do
ROUNDING = 1.01
AISLE = Scenario(passes=3, seed=3)
LOOP = Scenario(kind="loop", passes=1, length_m=8.0, vio_rate_hz=10.0)


@cache
def flown(scenario: Scenario, settings: Settings, *mistakes: str) -> Analysis:
    return explain(compare(simulate_flight(scenario, parse(mistakes)), settings, axes=AXES))


def errors_m(comparison: Comparison) -> float:
    truths = [result.filters["kf"].truth for result in comparison.axes.values()]
    assert all(isinstance(truth, AgainstTruth) for truth in truths)
    return sum(truth.position_rmse_m**2 for truth in truths) ** 0.5  # type: ignore[union-attr]


def given(findings: tuple[Finding, ...]) -> list[str]:
    """Remedies that are one, those of consequences too."""
    remedies = [one.remedy for finding in findings for one in (finding, *finding.consequences)]
    return [each for each in remedies if "Leave it" not in each and "no remedy" not in each]


def typed(remedy: str) -> dict[str, float]:
    """Settings of our filter that a remedy names."""
    number = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"
    return {
        FIELDS[name]: float(value)
        for name, value in re.findall(rf"--(sigma-z|sigma-a|clock-offset) {number}", remedy)
    }


def parameters(remedy: str) -> dict[str, float]:
    """Parameters of EKF2 that a remedy sets."""
    found = re.findall(r"(EKF2_\w+) to (\d+(?:\.\d+)?)", remedy)
    return {name: float(value) for name, value in found}


@pytest.mark.parametrize(
    ("settings", "mistakes"),
    [
        ({}, ()),
        ({"sigma_z_m": 0.02}, ()),
        ({"sigma_a_m_s2": 0.001}, ()),
        ({}, ("ekf2-noise=4cm",)),
        ({}, ("ekf2-noise=50cm",)),
        ({}, ("ekf2-delay=175ms",)),
        ({}, ("clock-offset=250ms",)),
        ({}, ("nlos=5%",)),
        ({}, ("smoothed=1s",)),
        ({}, ("vibration=1.5",)),
    ],
    ids=str,
)
def test_no_remedy_increases_the_error_to_the_truth(settings, mistakes) -> None:
    analysis = flown(AISLE, Settings(**settings), *mistakes)
    comparison, model = analysis, analysis.ekf2_model
    assert isinstance(model, Model)
    followed = 0
    for remedy in given(find(analysis)):
        if ours := typed(remedy):
            again = compare(
                comparison.flight,
                replace(comparison.settings, **ours),
                axes=AXES,
                start_s=comparison.segment.start_s,
                end_s=comparison.segment.end_s,
            )
            assert errors_m(again) <= ROUNDING * errors_m(comparison), remedy
            followed += 1
        if theirs := parameters(remedy):
            done = what_if(model, [theirs])
            assert not isinstance(done, Unavailable)
            before, after = (
                each.position_rmse_to_truth_m for each in (done.replayed, *done.whatif)
            )
            assert isinstance(before, float)
            assert isinstance(after, float)
            assert after <= ROUNDING * before, remedy
            followed += 1
    assert followed or mistakes in {("nlos=5%",), ("smoothed=1s",)}


@pytest.mark.parametrize(("seed", "mistakes"), [(1, ()), (2, ("ekf2-noise=50cm",))])
def test_on_a_loop_of_vio_the_truth_is_told_first_and_no_noise_is_lowered(seed, mistakes) -> None:
    """Neither where EKF2 trusts the VIO nor where its noise is 50 times the short-term one."""
    analysis = flown(replace(LOOP, seed=seed), Settings(), *mistakes)
    findings = find(analysis)
    first = findings[0]
    assert first.id == "errors_larger_than_claimed"
    assert first.evidence["kf_nees_position_mean"] > 100.0 * first.evidence["kf_nis_mean"]
    for finding in findings:
        for one in (finding, *finding.consequences):
            assert "set EKF2_EVP_NOISE" not in one.remedy
            assert "--sigma-z" not in one.remedy
    assert isinstance(analysis.ekf2_model, Model)
    asked = asked_of_ekf2(analysis, analysis.ekf2_model, analysis.tuning, analysis.clock)
    flown_with = analysis.ekf2_model.inputs.settings["EKF2_EVP_NOISE"]
    assert asked.get("EKF2_EVP_NOISE", flown_with) >= flown_with


def test_without_truth_the_report_says_that_consistency_is_not_correctness() -> None:
    findings = find(flown(replace(LOOP, truth=False, seed=1), Settings()))
    assert {finding.severity for finding in findings} == {"info"}
    drift = next(finding for finding in findings if finding.id == "source_may_drift")
    assert "is not correctness" in drift.message
    assert drift.evidence["short_term_noise_m"] == pytest.approx(0.01, rel=0.1)
    assert {one.id for one in drift.consequences} == {"kf_variance_overstated"}


def test_the_sample_loop_has_no_clock_change_and_no_smaller_noise(sample_log: Path) -> None:
    """Its stamps are 21.0 to 21.2 ms late in every part, by the simulation."""
    analysis = explain(
        compare(read_log(sample_log.with_name("loop_vio.ulg")), axes=("north", "east"))
    )
    findings = find(analysis)
    ids = {name for finding in findings for name in finding.ids}
    assert findings[0].id == "errors_larger_than_claimed"
    assert "source_clock_changes" not in ids
    assert not any("EKF2_EVP_NOISE" in remedy for remedy in given(findings))


def test_a_remedy_of_our_filter_that_the_truth_contradicts_is_not_given() -> None:
    comparison = flown(AISLE, Settings())
    worse = filter_words(comparison, Settings(sigma_z_m=3.0), "--sigma-z 3")
    assert worse.startswith("Leave it: --sigma-z 3 fits")
    truth = Unavailable("ground truth", "none", "")
    blind = replace(
        comparison,
        axes={
            name: replace(
                a,
                truth=truth,
                filters={each: replace(one, truth=truth) for each, one in a.filters.items()},
            )
            for name, a in comparison.axes.items()
        },
    )
    typed = "px4fuse compare LOG --sigma-z 0.2."
    assert filter_words(blind, Settings(sigma_z_m=0.2), "--sigma-z 0.2", 0.1) == typed
    assert filter_words(blind, Settings(sigma_z_m=0.2), "--sigma-z 0.2", -0.1).startswith("Leave")
