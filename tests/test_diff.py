"""Differences between two comparisons: numbers, findings, and verdicts that are worse."""

from __future__ import annotations

import pytest
from comparisons import compare
from detector_rates import RIGHT
from exchange import replace
from msgspec import structs

from px4fuse.batch.changes import (
    COMPARED_NUMBER_DEFINITIONS,
    ComparedNumber,
    InputResults,
    collect_compared_numbers,
    compare_numbers,
    list_changes,
)
from px4fuse.diagnose import diagnose_comparison
from px4fuse.ekf2.aids import AidAxisStatistics, AidResult
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_results
from px4fuse.results.contract import ComparisonResults, DiffResults, to_json
from px4fuse.results.reading import read_results
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario


def number(value: float, interval=None) -> ComparedNumber:
    return ComparedNumber("label", "m", value, interval)


# -- numbers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "differs"),
    [
        (1.0, 1.009, False), (1.0, 1.02, True), (0.0, 0.0009, False), (0.0, 0.0011, True),
        (-0.05, 0.05, True),
    ],
)  # fmt: skip
def test_diff_lists_numbers_that_differ_beyond_tolerance(a, b, differs):
    found = list(compare_numbers({"it": number(a)}, {"it": number(b)}))
    assert [(one.a, one.b) for one in found] == [(a, b)] * differs


def test_diff_lists_numbers_present_in_only_one_input():
    first, second = {"a": number(1.0, (0.5, None))}, {"b": number(2.0)}
    only_a, only_b = compare_numbers(first, second)
    assert (only_a.path, only_a.a, only_a.b, only_a.a_interval) == ("a", 1.0, None, (0.5, None))
    assert (only_b.path, only_b.a, only_b.b, only_b.b_interval) == ("b", None, 2.0, None)


# -- simulated flights -----------------------------------------------------------------------------


def flown(seed: int, *mistakes: str, **scenario) -> InputResults:
    """Compare a simulated flight, as an input of diff."""
    flight = simulate_flight(Scenario(seed=seed, **scenario), parse_faults(mistakes))
    request = ComparisonRequest(
        log="f.ulg", sigma_a_m_s2=RIGHT.sigma_a_m_s2, sigma_z_m=RIGHT.sigma_z_m
    )
    found = make_comparison_results(request, diagnose_comparison(compare(flight, RIGHT)))
    return as_input(read_results(to_json(found).encode()))


def as_input(found: ComparisonResults) -> InputResults:
    return InputResults("f.json", "results", found)


@pytest.fixture(scope="module")
def clean() -> InputResults:
    return flown(501)


def by_path(found: DiffResults) -> dict[str, tuple[float | None, float | None]]:
    return {one.path: (one.a, one.b) for one in found.numbers}


def test_diff_of_two_clean_flights_lists_no_worsened_verdict(clean):
    found = list_changes(clean, flown(503))
    assert found.worse == ()
    assert {one.name for one in found.settings} <= {
        "start of the analysed time (s)",
        "end of the analysis (s)",
    }
    assert list_changes(clean, clean).numbers == ()


def test_diff_of_estimated_measurement_noise_reports_intervals(clean):
    found = list_changes(clean, flown(502, sigma_uwb_m=0.2))
    (sigma_z,) = [one for one in found.numbers if one.path == "tuning.horizontal.sigma_z_m"]
    assert sigma_z.label == "SIGMA_Z estimate, horizontal"
    assert sigma_z.a_interval == clean.results.tuning["horizontal"].sigma_z_m_interval
    assert sigma_z.a_interval[1] < 0.15 < sigma_z.b_interval[0]
    assert any(text.startswith("Mean NIS of KF, axis of largest motion: ") for text in found.worse)


def test_diff_with_larger_ekf2_noise_reports_worse_ekf2_nis(clean):
    found = list_changes(clean, flown(506, "ekf2-noise=0.3"))
    (noise,) = [one for one in found.settings if one.name == "EKF2_EVP_NOISE"]
    assert (noise.a, noise.b) == (0.1, 0.3)
    assert "ekf2_underconfident" in {one.id for one in found.findings if one.only_in == "B"}
    (text,) = [
        text
        for text in found.worse
        if text.startswith("Mean NIS of EKF2, axis of largest motion: ")
    ]
    assert "(consistent) → " in text
    assert text.endswith(" times too large).")
    assert not any("NIS of KF" in text for text in found.worse)


# -- verdicts --------------------------------------------------------------------------------------


def with_kf(side: InputResults, **fields) -> InputResults:
    """Replace fields of the KF summary along north in the results."""
    axis = side.results.axes["north"]
    summary = structs.replace(axis.filters["kf"], **fields)
    axis = structs.replace(axis, filters={**axis.filters, "kf": summary})
    return as_input(replace(side.results, axes={**side.results.axes, "north": axis}))


def nees(side: InputResults, value: float) -> InputResults:
    truth = side.results.axes["north"].filters["kf"].truth
    return with_kf(side, truth=structs.replace(truth, nees_position_mean=value))


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (3.9, ""), (0.26, ""), (9.0, "9 (overconfident, σ 3 times too small)."),
        (0.04, "0.04 (underconfident, σ 5 times too large)."),
    ],
)  # fmt: skip
def test_diff_with_nees_beyond_limit_is_reported_as_worse(clean, value, said):
    before, after = nees(clean, 1.0), nees(clean, value)
    worse = [f"Mean NEES of KF, north: 1 (consistent) → {said}"] if said else []
    assert list(list_changes(before, after).worse) == worse
    assert list_changes(after, before).worse == ()


def test_diff_with_larger_nis_but_same_verdict_is_not_worse(clean):
    before = with_kf(clean, nis_mean=1.0, verdict="consistent")
    for nis_mean, verdict, count in (
        (1.7, "overconfident", 1), (1.7, "consistent", 0), (0.5, "underconfident", 1),
    ):  # fmt: skip
        after = with_kf(clean, nis_mean=nis_mean, verdict=verdict)
        assert len(list_changes(before, after).worse) == count
        assert list_changes(after, after).worse == ()


@pytest.mark.slow
def test_diff_with_additional_fault_is_reported_as_worse(clean):
    late = flown(505, "clock-offset=0.25")
    errors = {one.id for one in late.results.findings if one.severity == "error"}
    assert errors
    alone = as_input(replace(clean.results, findings=late.results.findings))
    worse = list_changes(as_input(replace(clean.results, findings=())), alone).worse
    assert set(worse) == {f"New finding of severity error: {one}." for one in errors}
    assert list_changes(alone, clean).worse == ()
    # the same finding with a higher severity is new
    raised = tuple(structs.replace(one, severity="error") for one in clean.results.findings)
    assert raised
    assert list_changes(clean, as_input(replace(clean.results, findings=raised))).worse


# -- the list of measures --------------------------------------------------------------------------


def test_diff_compares_each_json_number_only_once(clean):
    paths = [one["path"] for one in COMPARED_NUMBER_DEFINITIONS]
    assert len(set(paths)) == len(paths)
    found = collect_compared_numbers(clean.results)
    assert {path for path, one in found.items() if one.interval} >= {
        "tuning.horizontal.sigma_z_m", "tuning.horizontal.sigma_a_two_state_m_s2", "clock.offset_s",
    }  # fmt: skip


def aid(*axes: AidAxisStatistics, rejected_fraction: float = 0.0) -> AidResult:
    return AidResult(
        label="GNSS velocity", unit="m/s", topic="", fused_fraction=1.0, fused_logged=True,
        rejected_fraction=rejected_fraction, longest_gap_s=(0.0, 0.5), resets=0, gate=5.0,
        noise_from="", verdict="consistent",
        axes=dict(zip(("north", "east"), axes, strict=False)),
    )  # fmt: skip


def aid_axis(nis_mean: float) -> AidAxisStatistics:
    return AidAxisStatistics(
        samples=200, innovation_mean=0.0, innovation_std=1.0, s_sqrt_median=1.0,
        nis_mean=nis_mean, nis_band=(0.8, 1.2), sigma_ratio=1.0, rejected_fraction=0.0,
        lag1_autocorrelation=0.0, ljung_box_p=0.5, bias_p=0.5,
    )  # fmt: skip


def test_diff_does_not_list_position_source_as_aiding_source(clean):
    axes = aid_axis(1.2), aid_axis(0.9)
    judged = {"gnss_vel": aid(*axes, rejected_fraction=0.1), "ev_pos": aid(*axes)}
    found = collect_compared_numbers(structs.replace(clean.results, aids=judged))
    of_aids = {path: one for path, one in found.items() if path.startswith("aids.")}
    # external vision is the source itself, and listed by axis
    assert {path.split(".")[1] for path in of_aids} == {"gnss_vel"}
    north = of_aids["aids.gnss_vel.axes.north.nis_mean"]
    assert (north.label, north.value) == ("mean NIS of EKF2, GNSS velocity, north", 1.2)
    share = of_aids["aids.gnss_vel.rejected_fraction"]
    assert (share.label, share.unit) == (
        "fraction of measurements rejected by EKF2, GNSS velocity",
        "share",
    )
    source = structs.replace(clean.results.source, kind="gnss")
    found = collect_compared_numbers(structs.replace(clean.results, source=source, aids=judged))
    assert "ev_pos" in {path.split(".")[1] for path in found}


def test_diff_lists_numbers_of_axis_that_only_one_input_has(clean):
    part = as_input(replace(clean.results, axes={"north": clean.results.axes["north"]}))
    found = by_path(list_changes(clean, part))
    assert found["axes.down.filters.kf.nis_mean"][1] is None
    assert all(b is None for _, b in found.values())
