"""What changed between two flights: against closed forms, and on flights whose change is known."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from exchange import replace as exchange
from results_tools import EXAMPLE
from scipy.signal import lfilter
from scipy.special import ndtr
from scipy.stats import f as fisher
from spread import NOTHING, RATES_TABLE, SETTINGS, rates, spread

from px4fuse.analysis import explain
from px4fuse.comparison.comparison import compare
from px4fuse.filter.consistency import Consistency, assess
from px4fuse.findings import find
from px4fuse.fleet.changes import Changes, changes, number_changes
from px4fuse.fleet.measures import (
    BOOTSTRAP,
    CHI_SQUARE,
    Z95,
    Number,
    independent_share,
    interval_of,
    numbers,
    share_interval,
)
from px4fuse.fleet.sides import Side
from px4fuse.fleet.significance import contrast, corrected, spreads
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import results
from px4fuse.results.contract import to_json
from px4fuse.results.model import Student
from px4fuse.results.reading import read_results
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario


def number(value: float, interval=None, *, aim="low", scale="ratio", kind="x") -> Number:
    return Number("it", "m", value, interval, aim, scale, "likelihood", kind)


def normal(mean: float, sigma: float, **kinds) -> Number:
    """A number whose interval is that of a normal distribution."""
    return number(mean, (mean - Z95 * sigma, mean + Z95 * sigma), scale="difference", **kinds)


# -- two intervals ---------------------------------------------------------------------------------


def test_normal_numbers_are_compared_by_their_summed_variances():
    found = contrast(normal(1.0, 0.3), normal(2.5, 0.4))
    assert found.delta == pytest.approx(1.5)
    assert found.z == pytest.approx(1.5 / 0.5)
    assert found.p == pytest.approx(0.0026998, rel=1e-4)
    assert found.interval == pytest.approx((1.5 - Z95 * 0.5, 1.5 + Z95 * 0.5))


def test_a_spread_between_flights_widens_both():
    found = contrast(normal(1.0, 0.3), normal(2.5, 0.4), spread=0.5)
    assert found.z == pytest.approx(1.5 / np.sqrt(0.3**2 + 0.4**2 + 2 * 0.5**2))


def test_noises_are_compared_by_the_ratio_of_their_logarithms():
    a = number(0.1, (0.1 / 1.1, 0.1 * 1.1))
    found = contrast(a, number(0.2, (0.2 / 1.2, 0.2 * 1.2)))
    assert found.delta == pytest.approx(np.log(2.0))
    half = np.hypot(np.log(1.1), np.log(1.2))
    assert found.interval == pytest.approx((np.log(2.0) - half, np.log(2.0) + half))


def test_the_side_of_an_interval_that_faces_the_other_number_counts():
    a = number(1.0, (0.9, 2.0), scale="difference")
    below, above = (number(v, (v - 0.1, v + 0.1), scale="difference") for v in (0.5, 1.5))
    assert contrast(a, below).z == pytest.approx(Z95 * 0.5 / np.hypot(0.1, 0.1))
    assert contrast(a, above).z == pytest.approx(Z95 * 0.5 / np.hypot(1.0, 0.1))


def test_shares_are_those_of_newcombe_1998():
    # Statistics in Medicine 17, table II: 56/70 against 48/80, method 10
    a, b = (
        number(k / n, share_interval(k / n, n), scale="difference") for k, n in ((48, 80), (56, 70))
    )
    assert contrast(a, b).interval == pytest.approx((0.0524, 0.3339), abs=5e-5)


@pytest.mark.parametrize(("n", "m"), [(60, 60), (624, 250)])
@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.0, 1.3, 2.0])
def test_means_of_nis_are_compared_as_the_f_test_would(n, m, ratio):
    sides = []
    for value, count in ((1.0, n), (ratio, m)):
        interval, method = interval_of("kf.nis_mean", value, white(value, count), {})
        assert method == CHI_SQUARE
        sides.append(number(value, interval))
    exact = 2.0 * min(fisher.cdf(ratio, m, n), fisher.sf(ratio, m, n))
    assert contrast(*sides).p == pytest.approx(exact, rel=0.25, abs=0.02)


def white(nis_mean: float, count: int, lag1: float = 0.0) -> Consistency:
    """A filter with normal innovations of this mean square."""
    rng = np.random.default_rng(1)
    made = assess(rng.normal(size=count), np.ones(count))
    return exchange(
        made,
        nis_mean=nis_mean,
        outside_two_sigma=float(2.0 * ndtr(-2.0 / np.sqrt(nis_mean))),
        lag1_autocorrelation=lag1,
    )


# -- intervals of one flight -----------------------------------------------------------------------


def test_correlated_innovations_count_for_as_many_as_areindependent_share():
    rng = np.random.default_rng(7)
    r, count, flights = 0.6, 400, 400
    inside = {"as they are": 0, "as if white": 0}
    for _ in range(flights):
        steps = np.sqrt(1.0 - r * r) * rng.normal(size=2 * count)
        values = lfilter([1.0], [1.0, -r], steps)[count:]
        judged = assess(values, np.ones(count))
        for name, lag in (("as they are", judged.lag1_autocorrelation), ("as if white", 0.0)):
            found, _ = interval_of(
                "kf.nis_mean", judged.nis_mean, exchange(judged, lag1_autocorrelation=lag), {}
            )
            inside[name] += found is not None and found[0] < 1.0 < found[1]
    assert inside["as they are"] / flights == pytest.approx(0.95, abs=0.025)
    assert inside["as if white"] / flights < 0.88


def _with_lag(judged: Consistency, lag: float) -> Consistency:
    return exchange(judged, lag1_autocorrelation=lag)


def test_squares_of_a_first_order_process_are_correlated_by_the_square():
    assert independent_share(white(1.0, 100, lag1=0.5)) == pytest.approx(0.75 / 1.25)


def test_chi_square_is_not_used_for_innovations_with_outliers():
    rng = np.random.default_rng(3)
    values = rng.normal(size=500)
    values[::25] *= 12.0
    judged = assess(values, np.ones(500))
    assert interval_of("kf.nis_mean", judged.nis_mean, judged, {}) == (None, "")
    # the log tells it all the same
    interval, method = interval_of("kf.nis_mean", judged.nis_mean, judged, {"kf.nis_mean": values})
    assert method == BOOTSTRAP
    assert interval[0] < judged.nis_mean < interval[1]


# -- many tests ------------------------------------------------------------------------------------


def test_p_values_are_corrected_as_benjamini_and_hochberg_do():
    # their 1995 example has 15 tests, of which this procedure rejects the first four at 0.05
    p = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.324, 0.4262,
         0.5719, 0.6528, 0.759, 1.0]  # fmt: skip
    q = corrected(p)
    assert [value < 0.05 for value in q] == [True] * 4 + [False] * 11
    assert q[3] == pytest.approx(0.0095 * 15 / 4)
    assert corrected([]) == []


def test_of_many_numbers_that_did_not_change_few_are_called_significant():
    rng = np.random.default_rng(11)
    pairs = []
    for _ in range(400):
        both = {str(k): tuple(normal(v, 1.0) for v in rng.normal(size=2)) for k in range(40)}
        pairs.append(any(c.status == "significant" for c in number_changes(both, paired=False)))
    assert np.mean(pairs) == pytest.approx(0.05, abs=0.025)


# -- better or worse -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("aim", "a", "b", "judgement"),
    [
        ("one", 1.1, 4.0, "worse"),
        ("one", 4.0, 1.1, "better"),
        ("one", 0.9, 0.2, "worse"),
        ("one", 0.25, 4.0, "changed"),  # as far from 1, on the other side
        ("low", 0.1, 0.2, "worse"),
        ("low", 0.2, 0.1, "better"),
        ("", 0.1, 0.2, "changed"),
    ],
)
def test_each_number_has_its_direction(aim, a, b, judgement):
    first, second = (number(v, (v / 1.1, v * 1.1), aim=aim) for v in (a, b))
    (change,) = number_changes({"it": (first, second)}, paired=False)
    assert (change.status, change.judgement) == ("significant", judgement)
    (change,) = number_changes({"it": (first, second)}, paired=True)
    assert (change.status, change.judgement, change.p) == ("differs", judgement, None)


def test_on_the_other_side_of_the_best_it_must_be_farther_by_more_than_chance():
    first, second = (number(v, (v / 1.1, v * 1.1), aim="one") for v in (0.25, 4.1))
    (change,) = number_changes({"it": (first, second)}, paired=False)
    assert (change.status, change.judgement) == ("significant", "changed")
    (change,) = number_changes({"it": (first, second)}, paired=True)
    assert change.judgement == "worse"


def test_an_offset_is_better_nearer_to_zero():
    made = [normal(v, 0.01, aim="zero") for v in (-0.25, 0.02, -0.02)]
    (better,) = number_changes({"it": (made[0], made[1])}, paired=False)
    (other,) = number_changes({"it": (made[1], made[2])}, paired=False)
    assert (better.judgement, other.judgement) == ("better", "changed")


def test_significant_changes_stand_first_and_causes_before_what_they_bring():
    def moved(by: float) -> tuple[Number, Number]:
        return normal(0.0, 0.1), normal(by, 0.1)

    both = {
        "axes.north.filters.kf.nis_mean": moved(9.0),
        "axes.east.filters.kf.nis_mean": moved(0.05),
        "axes.down.filters.kf.nis_mean": moved(-9.0),
        "tuning.horizontal.sigma_z_m": moved(2.0),
    }
    paths = [change.path for change in number_changes(both, paired=False)]
    assert paths == [
        "tuning.horizontal.sigma_z_m", "axes.north.filters.kf.nis_mean",
        "axes.down.filters.kf.nis_mean",
        "axes.east.filters.kf.nis_mean",
    ]  # fmt: skip


def test_a_number_without_interval_is_not_tested_and_says_why():
    both = {"it": (number(0.1), number(0.3, (0.2, 0.4))), "none": (number(0.0), number(0.1))}
    one, other = number_changes(both, paired=False)
    assert (one.status, one.q, one.change) == ("not tested", None, pytest.approx(3.0))
    assert one.why == "0.1 to 0.3 m, × 3; not tested, no interval for A."
    assert (other.change, other.why) == (None, "0 to 0.1 m; no test where one is 0.")


# -- simulated flights -----------------------------------------------------------------------------


def flown(name: str, seed: int, *mistakes: str, with_log: bool = True, **scenario) -> Side:
    """A simulated flight as a side."""
    flight = simulate_flight(Scenario(seed=seed, **scenario), parse(mistakes))
    analysis = explain(compare(flight, SETTINGS))
    request = ComparisonRequest(
        log=name, sigma_a_m_s2=SETTINGS.sigma_a_m_s2, sigma_z_m=SETTINGS.sigma_z_m
    )
    found = results(request, analysis, find(analysis), Student(), "px4fuse compare")
    read = read_results(to_json(found).encode())
    return Side(name, "log", read, analysis) if with_log else Side(name, "results", read)


@pytest.fixture(scope="module")
def clean() -> Side:
    return flown("clean.ulg", 501)


@pytest.fixture(scope="module")
def noisy() -> Side:
    return flown("noisy.ulg", 502, sigma_uwb_m=0.2)


def significant(found: Changes) -> dict[str, str]:
    numbers = found.results.numbers
    return {c.path: c.judgement for c in numbers if c.status == "significant"}


def test_two_flights_with_the_same_truth_show_nothing(clean):
    found = changes(clean, flown("again.ulg", 503))
    assert found.results.counts.tested >= 50
    assert significant(found) == {}
    assert not found.is_worse
    assert found.results.summary[0].startswith("None of")


def test_a_doubled_noise_of_the_source_is_the_first_that_is_told(clean, noisy):
    found = changes(clean, noisy)
    first = found.results.numbers[0]
    assert (first.path, first.judgement) == ("tuning.horizontal.sigma_z_m", "worse")
    assert first.change_interval[0] < 2.0 < first.change_interval[1]
    judged = significant(found)
    assert judged["axes.aisle.filters.kf.truth.position_rmse_m"] == "worse"
    assert "clock.offset_s" not in judged
    assert found.is_worse
    assert significant(changes(noisy, clean))["tuning.horizontal.sigma_z_m"] == "better"
    assert "SIGMA_Z found, horizontal" in repr(found)
    assert found.to_frame().set_index("path").loc[first.path, "q"] == first.q


def test_without_the_logs_errors_are_not_tested_and_it_is_said(clean, noisy):
    found = changes(*(Side("r.json", "results", side.results) for side in (clean, noisy)))
    judged = significant(found)
    assert "tuning.horizontal.sigma_z_m" in judged
    assert "axes.aisle.filters.kf.nis_mean" in judged
    errors = [c for c in found.results.numbers if c.path.endswith("kf.truth.position_rmse_m")]
    assert {c.status for c in errors} == {"not tested"}
    assert any("RMSE is not tested without the logs" in note for note in found.results.notes)


def test_late_stamps_are_the_first_that_is_told():
    # twice as long as usual: of two flights of two minutes the clock alone is not sure of 0.1 s
    sides = [
        flown("in_time.ulg", 504, passes=12, with_log=False),
        flown("late.ulg", 505, "clock-offset=0.15", passes=12, with_log=False),
    ]
    found = changes(*sides)
    assert found.results.numbers[0].path == "clock.offset_s"
    assert found.results.numbers[0].judgement == "worse"
    low, high = found.results.numbers[0].change_interval
    assert low < -0.15 < high


def test_another_noise_of_ekf2_is_named_as_setting_and_in_its_nis(clean):
    found = changes(clean, flown("modest.ulg", 506, "ekf2-noise=0.3", with_log=False))
    assert significant(found)["axes.aisle.filters.ekf2.nis_mean"] == "worse"
    assert "axes.aisle.filters.kf.nis_mean" not in significant(found)
    (text,) = [t for t in found.results.texts if t.what == "EKF2_EVP_NOISE"]
    assert (text.kind, text.a, text.b) == ("parameter", "0.1", "0.3")
    assert "ekf2_variance_overstated" in {
        one.id for one in found.results.findings if one.only_in == "B"
    }


# -- what was measured -----------------------------------------------------------------------------


def test_the_spread_is_what_varies_beyond_the_intervals():
    rng = np.random.default_rng(5)
    told = [
        {
            "axes.a": normal(rng.normal(0.0, np.hypot(0.3, 0.4)), 0.4, kind="axes.*"),
            "axes.b": normal(rng.normal(0.0, 0.4), 0.4, kind="axes.*"),
        }
        for _ in range(4000)
    ]
    table = spread(told).set_index("kind")
    assert table.loc["axes.*", "spread"] == pytest.approx(0.3, abs=0.02)
    assert table.loc["axes.*", "numbers"] == 8000


def test_rates_count_pairs_with_any_significant_change():
    same = {"x": normal(0.0, 1.0)}
    other = {"x": normal(9.0, 1.0)}
    with_logs, alone = rates([(same, same)] * 4, [(other, same)] * 3 + [(same, same)])
    assert (with_logs["rate"], with_logs["first"], alone["rate"]) == (0.75, "x", 0.0)


def test_measured_rates_are_as_the_readme_says():
    table = pd.read_csv(RATES_TABLE)
    table = table.set_index(["change", "given"])
    none = table.loc[NOTHING.words]
    assert (none["low"] <= 0.05).all()
    assert (none["rate"] <= 0.10).all()
    for change in ("--sigma-uwb 0.2", "--mistake ekf2-noise=0.3"):
        assert (table.loc[change]["rate"] == 1.0).all()


def test_every_kind_that_has_an_interval_has_a_measured_spread(clean):
    kinds = {n.kind for n in numbers(clean.results, clean.analysis).values() if n.interval}
    assert kinds <= spreads().keys()


# -- settings of one flight ------------------------------------------------------------------------


def test_of_one_flight_nothing_is_left_to_chance(clean):
    flight = clean.analysis.flight
    analysis = explain(compare(flight, replace(SETTINGS, sigma_z_m=0.2)))
    request = ComparisonRequest(log="clean.ulg", sigma_z_m=0.2)
    found = results(request, analysis, (), Student(), "")
    changed = changes(clean, Side("other.json", "results", found)).results
    status = {change.path: change.status for change in changed.numbers}
    assert status["axes.aisle.filters.kf.nis_mean"] == "differs"
    assert status["axes.aisle.filters.ekf2.nis_mean"] == "same"
    assert {change.q for change in changed.numbers} == {None}
    assert changed.paired
    assert any("no sampling between them" in note for note in changed.notes)
    assert [(t.what, t.a, t.b) for t in changed.texts] == [("SIGMA_Z (m)", "0.1", "0.2")]


def test_what_one_side_lacks_is_listed(clean):
    down = {**EXAMPLE, "axes": {"north": EXAMPLE["axes"]["north"]}}
    whole, part = (read_results(json.dumps(found).encode()) for found in (EXAMPLE, down))
    found = changes(Side("a.json", "results", whole), Side("b.json", "results", part)).results
    assert {one.only_in for one in found.one_sided} == {"A"}
    assert "axes.down.filters.kf.nis_mean" in {one.path for one in found.one_sided}
    assert found.counts.changed == 0
