"""Explore page as a user sees it: layout, sentences, steps, keyboard, accessibility."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from comparisons import compare_prepared
from explore_tools import ask, axe, open_view, serious, settle, show

from px4fuse.analysis import Analysis
from px4fuse.card.model import map_ratio_to_axis
from px4fuse.card.verdicts import make_sigma_verdicts
from px4fuse.core.text import format_ratio
from px4fuse.diagnose import diagnose, prepare_comparison
from px4fuse.explore.page import make_analysis_page
from px4fuse.report.card_html import make_diagnosis_card
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("cached_analyses")

IN_VIEW = """(...names) => names.filter((name) => {
  const node = document.querySelector(name), box = node.getBoundingClientRect();
  const x = box.x + box.width / 2, y = box.y + box.height / 2;
  return node.checkVisibility() && box.height > 0 && box.top >= 0 && box.bottom <= innerHeight
    && node.contains(document.elementFromPoint(x, y));
})"""
SLIDERS = ("#sigma-a", "#sigma-z", "#dt", "#clock-offset")


def put(page: Browser, **values: float) -> None:
    """Set settings by their names in the page's script."""
    ask(page, f"Explore.then((e) => {{ e.set({json.dumps(values)}); }})")
    settle(page)


def text(page: Browser, name: str) -> str:
    return str(page.ask(f"document.getElementById({json.dumps(name)}).textContent"))


# ------------------------------------------------------------------ one screen


def test_explore_page_on_desktop_shows_settings_and_plot(page: Browser) -> None:
    wanted = [*SLIDERS, "#innovation", "#card h2", "#card figure", "#views", ".legend", "#flown"]
    assert page.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted


# Pairs of labels of the card's axis that overlap
OVERLAPPING = """(() => {
  const texts = [...document.querySelectorAll('#card figure text')];
  const boxes = texts.filter((text) => text.checkVisibility())
    .map((text) => [text.textContent, text.getBoundingClientRect()]);
  return [boxes.length, boxes.flatMap(([one, a], i) => boxes.slice(i + 1)
    .filter(([, b]) => a.right > b.left && b.right > a.left && a.bottom - 2 > b.top
      && b.bottom - 2 > a.top)
    .map(([other]) => `${one} ${other}`))];
})()"""


@pytest.mark.parametrize("width", [390, 1000, 1100, 1280, 1366, 1920])
def test_explore_page_plot_labels_do_not_overlap(
    browser: Browser, explored: tuple[Path, Analysis], width: int
) -> None:
    show(browser, explored[0], width=width)
    browser.resize(width, 844)
    settle(browser)
    count, overlapping = browser.ask(OVERLAPPING)
    assert count >= 7
    assert overlapping == []


def test_explore_page_on_phone_fits_diagnosis_and_plot(
    browser: Browser, explored: tuple[Path, Analysis]
) -> None:
    show(browser, explored[0], width=390)
    browser.resize(390, 844)
    settle(browser)
    wanted = ["#card h2", "#card figure", "#views", ".legend", "#innovation", *SLIDERS[:2]]
    assert browser.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted
    browser.ask("document.querySelector('#ekf2-r').scrollIntoView()")
    settle(browser)
    assert browser.ask(f"({IN_VIEW})('#ekf2-r')") == ["#ekf2-r"]
    assert browser.complaints() == []


def test_explore_page_marks_innovations_outside_plot_at_edge(page: Browser) -> None:
    put(page, sigma_a_m_s2=0.002)

    def drawn(name: str, *columns: str) -> list[Any]:
        data = f"e.model('innovation:{name}-source').data"
        lists = ", ".join(f"Array.from({data}.{column})" for column in columns)
        return [np.array(each) for each in ask(page, f"Explore.then((e) => [{lists}])")]

    ends = "(({start, end}) => [start, end])(e.model('innovation').y_range)"
    low, high = ask(page, f"Explore.then((e) => {ends})")
    nu, y, marker = drawn("innovations", "x", "y", "marker")
    out = (nu < low) | (nu > high)
    assert 50 < out.sum() < len(nu)
    assert ((y > low) & (y < high)).all()
    # arrow heads at the lower edge point down
    assert (marker[nu > high] == "triangle").all()
    assert (marker[nu < low] == "inverted_triangle").all()
    assert (marker[np.abs(nu) < 4.0] == "circle").all()


# ------------------------------------------------------------------ changed settings


ROWS = """Object.fromEntries([...document.querySelectorAll('#card [data-filter]')].map((row) => {
  const text = (name) => row.querySelector(name).textContent;
  const place = row.querySelector('.mark').getAttribute('x');
  return [`${row.dataset.filter} ${row.dataset.against}`, [text('.ratio'), text('.word'), place]];
}))"""


def test_explore_page_shows_report_diagnosis_before_any_change(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    card = make_diagnosis_card(explored[1])
    rows = page.ask(ROWS)
    for verdict in card.verdicts:
        ratio, word, place = rows[f"{verdict.filter} {verdict.against}"]
        assert (ratio, word) == (format_ratio(verdict.ratio), verdict.word)
        at = 100.0 * map_ratio_to_axis(verdict.ratio)
        assert float(place.rstrip("%")) == pytest.approx(at, abs=0.01)
    shown_headline = "document.querySelector('#card h2:not([hidden])').textContent"
    assert card.headline in page.ask(shown_headline)
    put(page, sigma_a_m_s2=0.3)
    assert card.headline not in page.ask(shown_headline)
    assert page.ask(ROWS) != rows
    put(page, sigma_a_m_s2=explored[1].settings.sigma_a_m_s2)
    assert page.ask(ROWS).keys() == rows.keys()
    assert [row[:2] for row in page.ask(ROWS).values()] == [row[:2] for row in rows.values()]
    assert card.headline in page.ask(shown_headline)


def test_explore_page_error_to_sigma_ratios_equal_python_ratios(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    analysis = explored[1]
    put(page, sigma_a_m_s2=0.002, sigma_z_m=0.05, clock_offset_s=0.1)
    request = ComparisonRequest(
        log="aisle_uwb.ulg", sigma_a_m_s2=0.002, sigma_z_m=0.05, clock_offset_s=0.1,
        start_s=analysis.segment.start_s, end_s=analysis.segment.end_s,
        heading_deg=analysis.main.axis.heading_deg,
    )  # fmt: skip
    main = compare_prepared(prepare_comparison(analysis.flight, request)).main
    source, truth = make_sigma_verdicts(main)[:2]
    rows = page.ask(ROWS)
    for verdict in (source, truth):
        assert rows[f"kf {verdict.against}"][:2] == [format_ratio(verdict.ratio), verdict.word]
    assert rows["kf truth"][2] == "100%"
    headline = page.ask("document.querySelector('#card h2:not([hidden])').textContent")
    expected = f"With these settings, KF is overconfident: σ is {format_ratio(truth.ratio)} "
    assert headline.startswith(expected)
    # the analysed ratio stays as a hollow mark
    was = "document.querySelector('#card [data-filter=kf] .was').getAttribute('display')"
    assert page.ask(was) == "inline"
    label = page.ask("document.querySelector('#card figure').ariaLabel")
    assert f"{format_ratio(truth.ratio)} overconfident" in label


def test_explore_page_apply_button_takes_recommended_values(
    browser: Browser, sample_log: Path, tmp_path: Path
) -> None:
    analysis = diagnose(ComparisonRequest(log=str(sample_log), sigma_a_m_s2=0.001))
    file = tmp_path / "small.html"
    file.write_bytes(make_analysis_page(analysis).encode())
    show(browser, file)
    command = browser.ask("document.querySelector('[data-apply]').dataset.apply")
    assert shlex.split(command)[:3] == ["px4fuse", "compare", str(sample_log)]
    browser.click("[data-apply]")
    settle(browser)
    value = browser.ask("document.getElementById('sigma-a-value').value")
    assert f"--sigma-a {value}" in command
    assert "With these settings, KF is consistent" in text(browser, "card")
    assert browser.complaints() == []


def test_explore_page_ekf2_curves_equal_logged_values(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    result = explored[1].main
    state, variance = result.ekf2_tracks.state.dropna(), result.ekf2_tracks.variance.dropna()
    for view, name, column, logged in (
        ("track", "position:ekf2", "p", state["position_m"]),
        ("speed", "velocity:ekf2", "v", state["velocity_m_s"]),
        ("sigma", "sigma_p:ekf2", "sp", variance["position_variance_m2"].pow(0.5)),
        ("sigma", "sigma_v:ekf2", "sv", variance["velocity_variance_m2_s2"].pow(0.5)),
    ):
        open_view(page, view)
        data = f"e.model('{name}-source').data"
        lists = f"[Array.from({data}.t), Array.from({data}.{column})]"
        drawn = ask(page, f"Explore.then((e) => {lists})")
        assert len(drawn[0]) > 100
        expected = np.interp(drawn[0], logged.index, logged)
        np.testing.assert_allclose(drawn[1], expected, rtol=0.0, atol=2e-6)
    open_view(page, "errors")
    rejected = "e.model('innovation:rejected-source').data.x.length"
    count = ask(page, f"Explore.then((e) => {rejected})")
    assert count == (result.ekf2_tracks.innovations["rejected"] > 0).sum()


# ------------------------------------------------------------------ the step


def test_explore_page_ellipse_shows_kf_covariance_at_each_update(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    shown = ask(
        page,
        "Explore.then((e) => { const run = e.result.run;"
        "return run.updates.nu.reduce((all, _, u) => [...all, Step.states(run, u).map((one) => {"
        "const {p, v} = Step.ellipse(one);"
        "return [one.p, one.v, Array.from(p), Array.from(v)]; })], []); })",
    )
    done = explored[1].main.kf_run
    steps, updates = done.steps, done.updates
    columns = ["position_variance_m2", "covariance_m2_s", "velocity_variance_m2_s2"]
    assert len(shown) == len(updates)

    def covariance(mean_p: float, mean_v: float, p: list[float], v: list[float]) -> list[float]:
        # the mean square of points on the 2σ ellipse is twice the covariance
        x = np.array([p[:-1], v[:-1]]) - np.array([[mean_p], [mean_v]])
        (a, b), (_, d) = x @ x.T / x.shape[1] / 2.0
        return [a, b, d]

    for (time_s, row), (_, prior, posterior) in zip(updates.iterrows(), shown, strict=True):
        assert prior[0] == pytest.approx(row["measurement_m"] - row["innovation_m"], abs=1e-9)
        prior_variance_m2 = row["prior_position_variance_m2"]
        assert covariance(*prior)[0] == pytest.approx(prior_variance_m2, abs=1e-9)
        step = steps.loc[time_s]
        assert posterior[0] == pytest.approx(step["position_m"], abs=1e-9)
        np.testing.assert_allclose(covariance(*posterior), step[columns], rtol=0.0, atol=1e-9)


# ------------------------------------------------------------------ accessibility


def press_right(page: Browser) -> None:
    page.call(
        "Input.dispatchKeyEvent", type="rawKeyDown", key="ArrowRight", code="ArrowRight",
        windowsVirtualKeyCode=39,
    )  # fmt: skip


def test_explore_page_views_and_sliders_work_with_keyboard(page: Browser) -> None:
    page.ask("document.querySelector('[name=view][value=errors]').focus()")
    span = text(page, "span")
    press_right(page)
    settle(page)
    assert page.ask("document.activeElement.value") == "sigma"
    assert page.ask("document.querySelector('#sigma_p').checkVisibility()")
    assert not page.ask("document.querySelector('#innovation').checkVisibility()")
    assert text(page, "span") == span
    page.ask("document.getElementById('sigma-z').focus()")
    before = float(page.ask("document.getElementById('sigma-z-value').value"))
    for _ in range(5):
        press_right(page)
    settle(page)
    assert float(page.ask("document.getElementById('sigma-z-value').value")) > before


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_explore_page_has_no_serious_accessibility_violation(
    browser: Browser, explored: tuple[Path, Analysis], width: int, height: int
) -> None:
    show(browser, explored[0], width=width)
    browser.resize(width, height)
    browser.ask(axe())
    assert browser.ask("document.documentElement.scrollWidth") <= width
    for view in ("errors", "track", "step"):
        open_view(browser, view)
        assert serious(browser) == [], view
