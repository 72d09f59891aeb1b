"""What changed between two flights: against closed forms, and on flights whose change is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from detector_rates import RIGHT
from exchange import replace
from msgspec import structs
from scipy.signal import lfilter
from scipy.special import ndtr
from scipy.stats import chi2
from scipy.stats import f as fisher
from spread import spread

from px4fuse.analysis import explain
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import FilterSummary
from px4fuse.ekf2.aids import AidAxis, AidResult
from px4fuse.filter.consistency import assess
from px4fuse.fleet.changes import changes, number_changes
from px4fuse.fleet.inputs import DiffInput
from px4fuse.fleet.measures import (
    Z95,
    Measure,
    Number,
    bootstrapped,
    contrast,
    independent_count,
    interval_of,
    numbers,
    share_interval,
    spreads,
)
from px4fuse.flight import Unavailable
from px4fuse.report.changes import change_line, printed
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import results
from px4fuse.results.contract import ChangeResults, NumberChange, to_json
from px4fuse.results.reading import read_results
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario


def number(value: float, interval=None, *, aim="low", scale="ratio", kind="x") -> Number:
    return Number(Measure(kind, "it", "m", aim, scale), value, interval)


def around(value: float, factor: float, **kinds) -> Number:
    """A number whose interval reaches as far down as up, as a factor."""
    return number(value, (value / factor, value * factor), **kinds)


def normal(mean: float, sigma: float, **kinds) -> Number:
    """A number whose interval is that of a normal distribution."""
    return number(mean, (mean - Z95 * sigma, mean + Z95 * sigma), scale="difference", **kinds)


def changed(a: Number, b: Number, *, paired: bool = False) -> NumberChange:
    (change,) = number_changes({"it": a}, {"it": b}, paired=paired)
    return change


def white(nis_mean: float, count: int, lag1: float = 0.0) -> FilterSummary:
    """A filter with normal innovations of this mean square."""
    return summary(
        np.random.default_rng(1).normal(size=count), nis_mean=nis_mean,
        outside_two_sigma=float(2.0 * ndtr(-2.0 / np.sqrt(nis_mean))), lag1_autocorrelation=lag1,
    )  # fmt: skip


def summary(values, **more) -> FilterSummary:
    """A filter with these innovations, of variance 1."""
    made = assess(values, np.ones(len(values)))
    fields = {name: getattr(made, name) for name in made.__struct_fields__} | more
    return FilterSummary(**fields, truth=Unavailable("truth", "none", "Log it."))


# -- two intervals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "sigma"),
    [
        (normal(1.0, 0.3), normal(2.5, 0.4), 0.5),
        # the side of an interval that faces the other number counts
        (number(1.0, (1.0 - Z95 * 0.1, 9.0), scale="difference"), normal(0.5, 0.1),
         np.hypot(0.1, 0.1)),
        (number(1.0, (-9.0, 1.0 + Z95 * 0.2), scale="difference"), normal(1.5, 0.1),
         np.hypot(0.2, 0.1)),
        # noises are compared by the ratio of their logarithms
        (around(0.1, 1.1), around(0.2, 1.2), np.hypot(np.log(1.1), np.log(1.2)) / Z95),
    ],
)  # fmt: skip
def test_two_intervals_are_combined_by_their_summed_variances(a, b, sigma):
    found = contrast(a, b)
    delta = np.log(b.value / a.value) if a.measure.scale == "ratio" else b.value - a.value
    assert found.delta == pytest.approx(delta)
    assert found.z == pytest.approx(abs(delta) / sigma)
    assert found.p == pytest.approx(2.0 * ndtr(-abs(delta) / sigma))
    towards = found.interval[0 if delta > 0.0 else 1]
    assert towards == pytest.approx(delta - np.sign(delta) * Z95 * sigma)
    # a spread between flights widens both
    wide = contrast(a, b, spread=0.5)
    assert wide.z == pytest.approx(abs(delta) / np.sqrt(sigma**2 + 2 * 0.5**2))


def test_shares_are_those_of_newcombe_1998():
    # Statistics in Medicine 17, table II: 56/70 against 48/80, method 10
    shares = ((48 / 80, 80), (56 / 70, 70))
    a, b = (number(p, share_interval(p, n), scale="difference") for p, n in shares)
    assert contrast(a, b).interval == pytest.approx((0.0524, 0.3339), abs=5e-5)


@pytest.mark.parametrize(("n", "m"), [(60, 60), (624, 250)])
@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.0, 1.3, 2.0])
def test_means_of_nis_are_compared_as_the_f_test_would(n, m, ratio):
    both = [
        number(value, interval_of(white(value, count), "nis_mean", value))
        for value, count in ((1.0, n), (ratio, m))
    ]
    assert interval_of(white(1.0, n), "innovation_std_m", 3.0) == pytest.approx(
        tuple(3.0 * np.sqrt(both[0].interval))
    )
    exact = 2.0 * min(fisher.cdf(ratio, m, n), fisher.sf(ratio, m, n))
    assert contrast(*both).p == pytest.approx(exact, rel=0.25, abs=0.02)


# -- intervals of one flight -----------------------------------------------------------------------


def test_correlated_innovations_count_for_as_many_as_are_independent():
    # squares of a first-order process are correlated by the square
    assert independent_count(100, 0.5) == pytest.approx(100 * 0.75 / 1.25)
    rng = np.random.default_rng(7)
    r, count, flights = 0.6, 400, 400
    inside = {"as they are": 0, "as if white": 0}
    for _ in range(flights):
        steps = np.sqrt(1.0 - r * r) * rng.normal(size=2 * count)
        judged = summary(lfilter([1.0], [1.0, -r], steps)[count:])
        for name, lag in (("as they are", judged.lag1_autocorrelation), ("as if white", 0.0)):
            lagged = replace(judged, lag1_autocorrelation=lag)
            found = interval_of(lagged, "nis_mean", judged.nis_mean)
            inside[name] += found is not None and found[0] < 1.0 < found[1]
    assert inside["as they are"] / flights == pytest.approx(0.95, abs=0.025)
    assert inside["as if white"] / flights < 0.88


def test_chi_square_is_not_used_for_innovations_with_outliers():
    values = np.random.default_rng(3).normal(size=500)
    values[::25] *= 12.0
    judged = summary(values)
    assert interval_of(judged, "nis_mean", judged.nis_mean) is None
    # the log tells it all the same
    low, high = bootstrapped(values, "nis_mean")
    assert low < judged.nis_mean < high


# -- many tests ------------------------------------------------------------------------------------


def test_of_many_numbers_that_did_not_change_few_are_called_significant():
    rng = np.random.default_rng(11)
    hits = []
    for _ in range(400):
        both = [{str(k): normal(v, 1.0) for k, v in enumerate(rng.normal(size=40))} for _ in "ab"]
        hits.append(any(c.status == "significant" for c in number_changes(*both, paired=False)))
    assert np.mean(hits) == pytest.approx(0.05, abs=0.025)


# -- better or worse -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("aim", "a", "b", "judgement"),
    [
        ("one", 1.1, 4.0, "worse"), ("one", 4.0, 1.1, "better"), ("one", 0.9, 0.2, "worse"),
        ("one", 0.25, 4.0, "changed"),  # as far from 1, on the other side
        ("low", 0.1, 0.2, "worse"), ("low", 0.2, 0.1, "better"), ("", 0.1, 0.2, "changed"),
    ],
)  # fmt: skip
def test_each_number_has_its_direction(aim, a, b, judgement):
    first, second = (around(value, 1.1, aim=aim) for value in (a, b))
    change = changed(first, second)
    assert (change.status, change.judgement) == ("significant", judgement)
    change = changed(first, second, paired=True)
    assert (change.status, change.judgement, change.q) == ("differs", judgement, None)


def test_on_the_other_side_of_the_best_it_must_be_farther_by_more_than_chance():
    first, second = (around(value, 1.1, aim="one") for value in (0.25, 4.1))
    change = changed(first, second)
    assert (change.status, change.judgement) == ("significant", "changed")
    assert changed(first, second, paired=True).judgement == "worse"
    late, soon, early = (normal(value, 0.01, aim="zero") for value in (-0.25, 0.02, -0.02))
    assert (changed(late, soon).judgement, changed(soon, early).judgement) == ("better", "changed")


def test_significant_changes_stand_first_and_causes_before_what_they_bring():
    moved = {
        "axes.east.filters.kf.nis_mean": 0.05, "axes.down.filters.kf.nis_mean": -9.0,
        "axes.north.filters.kf.nis_mean": 9.0, "tuning.horizontal.sigma_z_m": 2.0,
    }  # fmt: skip
    first = {path: normal(0.0, 0.1) for path in moved}
    second = {path: normal(by, 0.1) for path, by in moved.items()}
    paths = [change.path for change in number_changes(first, second, paired=False)]
    assert paths == [*list(moved)[:1:-1], *list(moved)[1::-1]]


def test_a_number_that_cannot_be_tested_says_so_and_one_may_be_in_one_alone():
    first = {"it": number(0.1), "none": number(0.0), "a": number(1.0)}
    second = {"it": number(0.3, (0.2, 0.4)), "none": number(0.1), "b": number(1.0)}
    it, none, only_a, only_b = sorted(
        number_changes(first, second, paired=False), key=lambda c: [*first, *second].index(c.path)
    )
    assert (it.status, it.q, it.change) == ("not tested", None, pytest.approx(3.0))
    assert change_line(it) == "it, no test: 0.1 to 0.3 m, × 3"
    assert printed(SimpleNamespace(numbers=(it, none, only_a))) == [it]  # since it is large
    assert (none.status, none.change) == ("not tested", None)
    assert (only_a.status, only_a.b) == ("only in A", None)
    assert (only_b.status, only_b.a) == ("only in B", None)


# -- simulated flights -----------------------------------------------------------------------------


def flown(name: str, seed: int, *mistakes: str, with_log: bool = True, **scenario) -> DiffInput:
    """A simulated flight as an input."""
    flight = simulate_flight(Scenario(seed=seed, **scenario), parse(mistakes))
    analysis = explain(compare(flight, RIGHT))
    request = ComparisonRequest(
        log=name, sigma_a_m_s2=RIGHT.sigma_a_m_s2, sigma_z_m=RIGHT.sigma_z_m
    )
    found = results(request, analysis)
    read = read_results(to_json(found).encode())
    return DiffInput(name, *(("log", read, analysis) if with_log else ("results", read)))


@pytest.fixture(scope="module")
def clean() -> DiffInput:
    return flown("clean.ulg", 501)


@pytest.fixture(scope="module")
def noisy() -> DiffInput:
    return flown("noisy.ulg", 502, sigma_uwb_m=0.2)


def significant(found: ChangeResults) -> dict[str, str]:
    numbers = found.numbers
    return {c.path: c.judgement for c in numbers if c.status == "significant"}


def test_two_flights_with_the_same_truth_show_nothing(clean):
    found = changes(clean, flown("again.ulg", 503))
    assert sum(change.q is not None for change in found.numbers) >= 50
    assert (significant(found), found.is_worse) == ({}, False)
    assert found.summary[0].startswith("None of")


def test_a_doubled_noise_of_the_source_is_the_first_that_is_told(clean, noisy):
    found = changes(clean, noisy)
    first = found.numbers[0]
    assert (first.path, first.judgement) == ("tuning.horizontal.sigma_z_m", "worse")
    assert first.change_interval[0] < 2.0 < first.change_interval[1]
    judged = significant(found)
    assert judged["axes.aisle.filters.kf.truth.position_rmse_m"] == "worse"
    assert "clock.offset_s" not in judged
    assert found.is_worse
    assert significant(changes(noisy, clean))["tuning.horizontal.sigma_z_m"] == "better"
    assert "SIGMA_Z found, horizontal" in repr(found)
    # without the logs errors are not tested, and it is said
    alone = changes(*(DiffInput("r.json", "results", each.results) for each in (clean, noisy)))
    told = {"tuning.horizontal.sigma_z_m", "axes.aisle.filters.kf.nis_mean"}
    assert told <= set(significant(alone))
    errors = [c for c in alone.numbers if c.path.endswith("kf.truth.position_rmse_m")]
    assert {c.status for c in errors} == {"not tested"}
    assert any("RMSE is not tested without the logs" in note for note in alone.notes)


def test_late_stamps_are_the_first_that_is_told(clean):
    found = changes(clean, flown("late.ulg", 505, "clock-offset=0.25", with_log=False))
    first = found.numbers[0]
    assert (first.path, first.judgement) == ("clock.offset_s", "worse")
    assert first.change_interval[0] < -0.25 < first.change_interval[1]


def test_another_noise_of_ekf2_is_named_as_setting_and_in_its_nis(clean):
    found = changes(clean, flown("modest.ulg", 506, "ekf2-noise=0.3", with_log=False))
    assert significant(found)["axes.aisle.filters.ekf2.nis_mean"] == "worse"
    assert "axes.aisle.filters.kf.nis_mean" not in significant(found)
    (text,) = [t for t in found.texts if t.what == "EKF2_EVP_NOISE"]
    assert (text.kind, text.a, text.b) == ("parameter", "0.1", "0.3")
    assert "ekf2_variance_overstated" in {one.id for one in found.findings if one.only_in == "B"}


# -- what was measured -----------------------------------------------------------------------------


def test_the_spread_is_what_varies_beyond_the_intervals():
    rng = np.random.default_rng(5)
    sigmas = {"axes.a": np.hypot(0.3, 0.4), "axes.b": 0.4}
    told = [
        {name: normal(rng.normal(0.0, s), 0.4, kind="axes.*") for name, s in sigmas.items()}
        for _ in range(4000)
    ]
    table = spread(told).set_index("kind")
    assert table.loc["axes.*", "spread"] == pytest.approx(0.3, abs=0.02)
    assert table.loc["axes.*", "numbers"] == 8000


def test_every_kind_that_has_an_interval_has_a_measured_spread(clean):
    found = numbers(clean.results, clean.analysis).values()
    assert {number.measure.path for number in found if number.interval} <= spreads().keys()


def aid(*axes: AidAxis, rejected_share: float = 0.0) -> AidResult:
    return AidResult(
        label="GNSS velocity", unit="m/s", topic="", fused_share=1.0, fused_logged=True,
        rejected_share=rejected_share, longest_without_s=(0.0, 0.5), resets=0, gate=5.0,
        noise_from="", verdict="consistent",
        axes=dict(zip(("north", "east"), axes, strict=False)),
    )  # fmt: skip


def aid_axis(nis_mean: float, samples: int, lag1: float = 0.0, rejected: float = 0.0) -> AidAxis:
    return AidAxis(
        samples=samples, innovation_mean=0.0, innovation_std=1.0, s_sqrt_median=1.0,
        nis_mean=nis_mean, nis_band=(0.8, 1.2), sigma_factor=1.0, rejected_share=rejected,
        lag1_autocorrelation=lag1, ljung_box_p=0.5, bias_p=0.5,
    )  # fmt: skip


def test_aids_are_compared_by_their_nis_and_what_was_rejected(clean):
    axes = aid_axis(1.2, 200), aid_axis(0.9, 200, lag1=0.6)
    judged = {"gnss_vel": aid(*axes, rejected_share=0.1), "ev_pos": aid(*axes)}
    found = numbers(structs.replace(clean.results, aids=judged))
    velocity = {path: n for path, n in found.items() if path.startswith("aids.")}
    # external vision is the source itself, and among the axes
    assert {path.split(".")[1] for path in velocity} == {"gnss_vel"}
    north = velocity["aids.gnss_vel.axes.north.nis_mean"]
    assert (north.measure.label, north.measure.aim) == ("NIS, GNSS velocity, north", "one")
    assert north.interval == pytest.approx(200 * 1.2 / chi2.ppf([0.975, 0.025], 200))
    few = 200 * (1 - 0.36) / (1 + 0.36)
    east = velocity["aids.gnss_vel.axes.east.nis_mean"].interval
    assert east == pytest.approx(few * 0.9 / chi2.ppf([0.975, 0.025], few))
    share = velocity["aids.gnss_vel.rejected_share"]
    assert share.measure.label == "share rejected, GNSS velocity"
    assert share.interval == pytest.approx(share_interval(0.1, few))
    assert interval_of(aid_axis(1.2, 200, rejected=0.01), "nis_mean", 1.2) is None
    assert interval_of(aid(), "rejected_share", 0.0) is None
    source = structs.replace(clean.results.source, kind="gnss")
    found = numbers(structs.replace(clean.results, source=source, aids=judged))
    assert "ev_pos" in {path.split(".")[1] for path in found}


def test_what_one_side_lacks_is_listed(clean):
    part = replace(clean.results, axes={"north": clean.results.axes["north"]})
    whole, part = (DiffInput("r.json", "results", found) for found in (clean.results, part))
    status = {change.path: change.status for change in changes(whole, part).numbers}
    assert status["axes.down.filters.kf.nis_mean"] == "only in A"
    assert set(status.values()) == {"only in A", "same"}
