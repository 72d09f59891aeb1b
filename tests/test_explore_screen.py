"""Explore page as a user sees it: layout, sentences, steps, tour, keyboard, accessibility."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from explore_tools import ask, axe, open_view, serious, settle, show

from px4fuse.analysis import Analysis, run, run_comparison
from px4fuse.comparison.causal_replays import error_above_reported_sigma
from px4fuse.explore.page import html_text
from px4fuse.filter.kalman import replay
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.request import ComparisonRequest
from px4fuse.text import format_number

pytestmark = pytest.mark.usefixtures("cached_analyses")

IN_VIEW = """(...names) => names.filter((name) => {
  const node = document.querySelector(name), box = node.getBoundingClientRect();
  const x = box.x + box.width / 2, y = box.y + box.height / 2;
  return node.checkVisibility() && box.height > 0 && box.top >= 0 && box.bottom <= innerHeight
    && node.contains(document.elementFromPoint(x, y));
})"""
SLIDERS = ("#sigma-a", "#sigma-z", "#dt", "#clock-offset")
STATIONS = ["Q almost zero", "R too small", "The ratio determines the track",
            "The scale determines σ", "Time offset", "Outliers",
            "Comparison with EKF2"]  # fmt: skip


def nis_with(analysis: Analysis, settings: Settings) -> float:
    """Return the mean NIS of KF along the main axis with other settings."""
    updates = replay(analysis.main.axis, settings).updates
    return float(np.mean(updates["innovation_m"] ** 2 / updates["innovation_variance_m2"]))


def format_metres(metres: float) -> str:
    """Format a length as on the page: two decimals, three below 0.1 m."""
    return f"{metres:.{3 if metres < 0.0995 else 2}f} m"


def put(page: Browser, **values: float) -> None:
    """Set settings by their names in the page's script."""
    ask(page, f"Explore.then((e) => {{ e.set({json.dumps(values)}); }})")
    settle(page)


def text(page: Browser, name: str) -> str:
    return str(page.ask(f"document.getElementById({json.dumps(name)}).textContent"))


def key(page: Browser, name: str) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)


# ------------------------------------------------------------------ one screen


def test_desktop_settings_plots_and_gauge_are_visible(page: Browser) -> None:
    wanted = [*SLIDERS, "#innovation", "#sigma_p", "#sigma_v", "#needle", "#live"]
    assert page.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_phone_settings_and_one_plot_stay_visible(
    browser: Browser, explored: tuple[Path, Analysis], share: float
) -> None:
    show(browser, explored[0], width=390)
    browser.resize(390, 844)
    settle(browser)
    height = browser.ask("document.documentElement.scrollHeight")
    assert height <= 3 * 844
    browser.ask(f"scrollTo(0, {share * height})")
    settle(browser)
    wanted = [*SLIDERS, "#innovation"]
    assert browser.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted
    # the tabs select the plot
    browser.ask("document.getElementById('tab-sigma_v').click()")
    settle(browser)
    wanted = [*SLIDERS, "#sigma_v"]
    assert browser.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted
    assert not browser.ask("document.querySelector('#innovation').checkVisibility()")
    assert browser.complaints() == []


def test_innovations_outside_plot_are_marked_at_edge(page: Browser) -> None:
    put(page, sigmaA=0.002)

    def drawn(name: str, *columns: str) -> list[Any]:
        data = f"e.model('innovation:{name}-source').data"
        lists = ", ".join(f"Array.from({data}.{column})" for column in columns)
        return [np.array(each) for each in ask(page, f"Explore.then((e) => [{lists}])")]

    ends = "(({start, end}) => [start, end])(e.model('innovation').y_range)"
    low, high = ask(page, f"Explore.then((e) => {ends})")
    t, nu = drawn("updates", "t", "nu")
    out = (nu < low) | (nu > high)
    assert 50 < out.sum() < len(nu)
    at, y, turn = drawn("beyond", "t", "y", "turn")
    np.testing.assert_array_equal(at, t[out])
    assert ((y > low) & (y < high)).all()
    np.testing.assert_array_equal(turn > 0.0, nu[out] < low)  # arrows at the lower edge point down


# ------------------------------------------------------------------ changed settings


def test_sentences_follow_settings_and_name_re_run(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    analysis = explored[1]
    sentence = text(page, "live")
    kf, ekf2 = (analysis.main.filters[name] for name in ("kf", "ekf2"))
    assert sentence.startswith(
        "Along the aisle KF has a position RMSE of "
        f"{format_metres(kf.truth.position_rmse_m)} and is underconfident: σ is "
        f"{format_number(kf.nis_mean**-0.5)} times too large. EKF2 has a position RMSE of "
        f"{format_metres(ekf2.truth.position_rmse_m)} and is consistent."
    )
    put(page, sigmaA=0.002, sigmaZ=0.05)
    sentence = text(page, "live")
    nis = nis_with(analysis, Settings(sigma_a_m_s2=0.002, sigma_z_m=0.05))
    assert f"overconfident: σ is {format_number(nis**0.5, 2)} times too small" in sentence
    best = re.search(r"Best re-run: SIGMA_A ([\d.]+) \(mean NIS ([\d,]+) → ([\d.]+)\)", sentence)
    assert best[2] == format_number(nis, 2)
    after = nis_with(analysis, Settings(sigma_a_m_s2=float(best[1]), sigma_z_m=0.05))
    assert best[3] == format_number(after, 2)
    assert f"KF {format_number(nis, 2)} (overconfident" in text(page, "read")
    hand = page.ask("document.querySelector('#needle .hand.kf').style.left")
    assert hand == "100%"


def test_sentence_error_beyond_sigma_states_reported_sigma(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    put(page, offset=0.3)
    shifted = _shifted(explored[1], 0.3)
    hidden = error_above_reported_sigma(shifted.axes["aisle"].filters["kf"])
    assert hidden is not None
    rmse, sigma = format_metres(hidden.rmse_m), format_metres(hidden.reported_sigma_m)
    assert f"KF has a position RMSE of {rmse}, but reports σ {sigma}." in text(page, "live")


def test_changed_settings_mark_dependent_findings(
    browser: Browser, sample_log: Path, tmp_path: Path
) -> None:
    analysis = run(ComparisonRequest(log=str(sample_log), sigma_z_m=1.0))
    assert any(one.id == "sigma_z_too_large" for one in find(analysis))
    file = tmp_path / "large.html"
    file.write_bytes(html_text(analysis).encode())
    show(browser, file)
    open_view(browser, "recorded")
    notes = "[...document.querySelectorAll('.changed-note')].map((one) => one.textContent)"
    before = browser.ask(notes)
    assert len(before) >= 1
    assert set(before) == {""}
    assert "SIGMA_Z 1 m," in text(browser, "found")
    put(browser, sigmaZ=0.1)
    after = browser.ask(notes)
    assert all(one.startswith("Settings changed since the report: Along the ais") for one in after)
    stale = browser.ask(notes.replace(".changed-note", ".stale") + ".join(' ')")
    assert "SIGMA_Z" in stale
    assert "reset its height" not in stale
    assert browser.complaints() == []


def test_ekf2_curves_equal_the_log(page: Browser, explored: tuple[Path, Analysis]) -> None:
    result = explored[1].main
    state, variance = result.ekf2_state.dropna(), result.ekf2_variance.dropna()
    for view, name, column, logged in (
        ("track", "position:state", "p", state["position_m"]),
        ("track", "velocity:state", "v", state["velocity_m_s"]),
        ("filter", "sigma_p:variance", "sp", variance["position_variance_m2"].pow(0.5)),
        ("filter", "sigma_v:variance", "sv", variance["velocity_variance_m2_s2"].pow(0.5)),
    ):
        open_view(page, view)
        data = f"e.model('{name}-source').data"
        lists = f"[Array.from({data}.t), Array.from({data}.{column})]"
        drawn = ask(page, f"Explore.then((e) => {lists})")
        assert len(drawn[0]) > 100
        expected = np.interp(drawn[0], logged.index, logged)
        np.testing.assert_allclose(drawn[1], expected, rtol=0.0, atol=2e-6)
    rejected = "e.model('strip-source').data.row.filter((row) => row === 'EKF2 rejected').length"
    count = ask(page, f"Explore.then((e) => {rejected})")
    assert count == (result.ekf2_innovations["rejected"] > 0).sum()


def test_address_restores_all_settings(page: Browser, explored: tuple[Path, Analysis]) -> None:
    wanted = (
        "#axis=east&input=zero&sigma-a=0.7&sigma-z=0.07&dt=0.05&clock-offset=-0.1"
        "&view=step&measurement=17"
    )
    page.ask(f"location.hash = {json.dumps(wanted)}")
    settle(page)
    address = page.ask("location.hash")
    show(page, explored[0])  # reload
    page.ask(f"location.hash = {json.dumps(address)}")
    settle(page)
    assert page.ask("location.hash") == address
    assert {*wanted[1:].split("&")} == {*address[1:].split("&")}
    assert page.ask("document.getElementById('sigma-z-value').value") == "0.07"
    assert page.ask("document.querySelector('[name=input][value=zero]').checked")
    assert text(page, "now").startswith("Measurement 17 of")


# ------------------------------------------------------------------ the step


def test_ellipse_equals_covariance_in_each_step(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    open_view(page, "step")
    shown = ask(
        page,
        "Explore.then((e) => { const run = e.result.run;"
        "return Step.moments(run).map((one) => { const s = Step.state(run, one);"
        "const {p, v} = Step.ellipse(s); return [one.i, one.u, one.updated, s.slice(0, 2),"
        "Array.from(p), Array.from(v)]; }); })",
    )
    done = explored[1].main.replay
    steps, updates = done.steps, done.updates
    columns = ["position_variance_m2", "covariance_m2_s", "velocity_variance_m2_s2"]
    posterior = steps[columns].to_numpy()
    assert len(shown) == len(steps) + len(updates)
    place = {time: i for i, time in enumerate(updates.index)}
    for i, u, updated, mean, p, v in shown:
        # the mean square of points on the 2σ ellipse is twice the covariance
        x = np.array([p[:-1], v[:-1]]) - np.array(mean)[:, None]
        (a, b), (_, d) = x @ x.T / x.shape[1] / 2.0
        if u >= 0 and not updated:
            row = updates.iloc[place[updates.index[u]]]
            assert a == pytest.approx(row["prior_position_variance_m2"], abs=1e-9)
            assert mean[0] == pytest.approx(row["measurement_m"] - row["innovation_m"], abs=1e-9)
        else:
            np.testing.assert_allclose([a, b, d], posterior[i], rtol=0.0, atol=1e-9)
            assert mean[0] == pytest.approx(steps["position_m"].iloc[i], abs=1e-9)


def test_space_key_starts_and_pauses_steps(page: Browser) -> None:
    page.ask("document.activeElement.blur()")
    steps = "Explore.then((e) => e.stepper.at())"
    page.call("Input.dispatchKeyEvent", type="keyDown", key=" ", text=" ")
    settle(page)
    assert text(page, "play") == "Pause"
    ask(page, "new Promise((r) => setTimeout(r, 1300))")
    page.call("Input.dispatchKeyEvent", type="keyDown", key=" ", text=" ")
    settle(page)
    assert text(page, "play") == "Play"
    at = ask(page, steps)
    assert at >= 2
    ask(page, "new Promise((r) => setTimeout(r, 700))")
    assert ask(page, steps) == at


# ------------------------------------------------------------------ the tour


def test_tour_shows_numbers_of_flight_in_each_station(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    analysis = explored[1]
    put(page, sigmaA=0.8, sigmaZ=0.2)
    before = page.ask("location.hash")
    page.click("#tour-start")
    settle(page)
    assert page.ask("document.getElementById('tour-back').disabled")
    shown = []
    settings = "Explore.then((e) => [e.settings.sigmaA, e.settings.sigmaZ, e.settings.offset])"
    for _ in STATIONS:
        settle(page)
        a, z, offset = ask(page, settings)
        assert page.ask(f"({IN_VIEW})('#sigma-a', '#needle').length") == 2
        shown.append((text(page, "tour-title"), text(page, "tour-sentence"), a, z, offset))
        assert text(page, "tour-task").startswith("Task: ")
        assert text(page, "tour-see").startswith("Result: ")
        page.click("#tour-next")
    settle(page)
    assert [title for title, *_ in shown] == [f"{n + 1} of 7: {t}" for n, t in enumerate(STATIONS)]
    assert page.ask("document.getElementById('tour').hidden")
    assert page.ask("location.hash") == before
    # the sentences contain the numbers of this flight
    _, no_process_noise, a, z, offset = shown[0]
    assert a == 0.002
    change = re.search(r"mean NIS changes from ([\d.]+) to ([\d.,]+)\.", no_process_noise)
    with_clock = _shifted(analysis, offset)
    assert change[2] == format_number(nis_with(with_clock, Settings(a, z)), 2)
    scale = re.search(r"NIS from ([\d.]+) to ([\d.]+) \(one ninth\)", shown[3][1])
    assert float(scale[2]) == pytest.approx(float(scale[1]) / 9.0, rel=0.1)
    assert shown[6][1].startswith("Mean NIS: EKF2 0.86, KF ")


def _shifted(analysis: Analysis, offset_s: float) -> Any:
    """Compare the flight with corrected timestamps."""
    request = ComparisonRequest(
        log=str(Path("sample_logs") / analysis.flight.log.name), clock_offset_s=offset_s,
        start_s=analysis.segment.start_s, end_s=analysis.segment.end_s,
        heading_deg=analysis.main.axis.heading_deg,
    )  # fmt: skip
    return run_comparison(request, flight=analysis.flight)


# ------------------------------------------------------------------ accessibility


def test_tabs_and_sliders_work_with_keyboard(page: Browser) -> None:
    page.ask("document.getElementById('tab-filter').focus()")
    key(page, "ArrowRight")
    settle(page)
    assert page.ask("document.activeElement.id") == "tab-track"
    assert page.ask("document.querySelector('#position').checkVisibility()")
    assert not page.ask("document.querySelector('#innovation').checkVisibility()")
    key(page, "End")
    settle(page)
    assert page.ask("document.querySelector('#view-recorded').checkVisibility()")
    key(page, "ArrowRight")  # from the last tab to the first one
    settle(page)
    assert page.ask("document.activeElement.ariaSelected") == "true"
    assert page.ask("document.activeElement.id") == "tab-filter"
    page.ask("document.getElementById('sigma-z').focus()")
    before = float(page.ask("document.getElementById('sigma-z-value').value"))
    for _ in range(5):
        page.call("Input.dispatchKeyEvent", type="rawKeyDown", key="ArrowRight",
                  code="ArrowRight", windowsVirtualKeyCode=39)  # fmt: skip
    settle(page)
    assert float(page.ask("document.getElementById('sigma-z-value').value")) > before


@pytest.mark.parametrize(("width", "height", "scheme"), [(1400, 900, "dark"), (390, 844, "light")])
def test_explore_page_has_no_serious_axe_violations(
    browser: Browser, explored: tuple[Path, Analysis], width: int, height: int, scheme: str
) -> None:
    show(browser, explored[0], width=width)
    browser.resize(width, height)
    browser.scheme(scheme)
    browser.ask(axe())
    assert browser.ask("document.documentElement.scrollWidth") <= width
    for view in ("filter", "track", "step", "map", "numbers", "recorded"):
        open_view(browser, view)
        assert serious(browser) == [], view
    browser.ask("document.getElementById('tour-start').click()")
    settle(browser)
    assert serious(browser) == []
