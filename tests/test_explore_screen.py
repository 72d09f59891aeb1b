"""What a user sees and does on the page: one screen, words that follow, steps, tour, everybody."""

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
from px4fuse.comparison.interventions import beyond_claim
from px4fuse.explore.page import html_text
from px4fuse.filter.kalman import replay
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.findings.story import story
from px4fuse.plain import length_words, number_words
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("analysed_once")

IN_VIEW = """(...names) => names.filter((name) => {
  const node = document.querySelector(name), box = node.getBoundingClientRect();
  const x = box.x + box.width / 2, y = box.y + box.height / 2;
  return node.checkVisibility() && box.height > 0 && box.top >= 0 && box.bottom <= innerHeight
    && node.contains(document.elementFromPoint(x, y));
})"""
KNOBS = ("#sigma-a", "#sigma-z", "#dt", "#clock-offset")
STATIONS = ["Q forgotten", "R too small", "The ratio is the track", "Size is the claim", "Clocks",
            "Outliers", "EKF2 beside you"]  # fmt: skip


def nis_with(analysis: Analysis, settings: Settings) -> float:
    """Mean NIS of our filter along the axis of the lab with other settings."""
    updates = replay(analysis.main.axis, settings).updates
    return float(np.mean(updates["innovation_m"] ** 2 / updates["innovation_variance_m2"]))


def put(page: Browser, **values: float) -> None:
    """Knobs, by their names in the page."""
    ask(page, f"Explore.then((e) => {{ e.set({json.dumps(values)}); }})")
    settle(page)


def text(page: Browser, name: str) -> str:
    return str(page.ask(f"document.getElementById({json.dumps(name)}).textContent"))


def key(page: Browser, name: str) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)


# ------------------------------------------------------------------ one screen


def test_knobs_innovations_sigmas_and_needle_are_in_view_at_once(page: Browser) -> None:
    wanted = [*KNOBS, "#innovation", "#sigma_p", "#sigma_v", "#needle", "#live"]
    assert page.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_on_a_phone_knobs_and_a_plot_stay(
    browser: Browser, explored: tuple[Path, Analysis], share: float
) -> None:
    show(browser, explored[0], width=390)
    browser.resize(390, 844)
    settle(browser)
    height = browser.ask("document.documentElement.scrollHeight")
    assert height <= 3 * 844
    browser.ask(f"scrollTo(0, {share * height})")
    settle(browser)
    wanted = [*KNOBS, "#innovation"]
    assert browser.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted
    # the tabs choose which one
    browser.ask("document.getElementById('tab-sigma_v').click()")
    settle(browser)
    wanted = [*KNOBS, "#sigma_v"]
    assert browser.ask(f"({IN_VIEW})(...{json.dumps(wanted)})") == wanted
    assert not browser.ask("document.querySelector('#innovation').checkVisibility()")
    assert browser.complaints() == []


def test_what_leaves_an_axis_is_marked_at_its_edge(page: Browser) -> None:
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
    np.testing.assert_array_equal(turn > 0.0, nu[out] < low)  # those below point down


# ------------------------------------------------------------------ everything follows


def test_the_words_follow_the_knobs_and_their_cure_was_replayed(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    analysis = explored[1]
    told = text(page, "live")
    ours = analysis.main.filters["kf"]
    assert told.startswith(
        f"Along the aisle our filter is {length_words(ours.truth.position_rmse_m)} from the truth "
        "(RMS) and 9 % too modest; EKF2 is 6 cm from the truth and is honest about it."
    )
    assert told.split("; EKF2")[0].split("our filter is ")[1] == (
        story(analysis, ())[0].split("our filter was ")[1].rstrip(".")
    )
    put(page, sigmaA=0.002, sigmaZ=0.05)
    told = text(page, "live")
    now = Settings(sigma_a_m_s2=0.002, sigma_z_m=0.05)
    nis = nis_with(analysis, now)
    assert f"{number_words(nis**0.5, 2)} times too sure of itself" in told
    cure = re.search(r"nearest comes SIGMA_A ([\d.]+) \(mean NIS ([\d,]+) → ([\d.]+)\)", told)
    assert cure[2] == number_words(nis, 2)
    cured = nis_with(analysis, Settings(sigma_a_m_s2=float(cure[1]), sigma_z_m=0.05))
    assert cure[3] == number_words(cured, 2)
    assert f"ours {number_words(nis, 2)} (understated" in text(page, "read")
    hand = page.ask("document.querySelector('#needle .hand.ours').style.left")
    assert hand == "100%"


def test_an_error_that_innovations_hide_is_told_by_what_the_filter_claims(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    put(page, offset=0.3)
    shifted = _shifted(explored[1], 0.3)
    hidden = beyond_claim(shifted.axes["aisle"].filters["kf"])
    assert hidden is not None
    error, claimed = length_words(hidden.rmse_m), length_words(hidden.claimed_m)
    assert f"our filter is {error} from the truth (RMS) and claims {claimed};" in text(page, "live")


def test_findings_of_the_settings_follow_and_the_others_stay(
    browser: Browser, sample_log: Path, tmp_path: Path
) -> None:
    analysis = run(ComparisonRequest(log=str(sample_log), sigma_z_m=1.0))
    assert any(one.id == "sigma_z_large" for one in find(analysis))
    file = tmp_path / "large.html"
    file.write_bytes(html_text(analysis).encode())
    show(browser, file)
    open_view(browser, "recorded")
    said = "[...document.querySelectorAll('.now-said')].map((one) => one.textContent)"
    before = browser.ask(said)
    assert len(before) >= 1
    assert set(before) == {""}
    assert "SIGMA_Z 1," in text(browser, "found")
    put(browser, sigmaZ=0.1)
    after = browser.ask(said)
    assert all(one.startswith("The knobs stand elsewhere now: Along the aisle") for one in after)
    stale = browser.ask(said.replace(".now-said", ".stale") + ".join(' ')")
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


def test_the_address_restores_every_knob(page: Browser, explored: tuple[Path, Analysis]) -> None:
    wanted = (
        "#axis=east&input=zero&sigma-a=0.7&sigma-z=0.07&dt=0.05&clock-offset=-0.1"
        "&view=step&measurement=17"
    )
    page.ask(f"location.hash = {json.dumps(wanted)}")
    settle(page)
    address = page.ask("location.hash")
    show(page, explored[0])  # anew
    page.ask(f"location.hash = {json.dumps(address)}")
    settle(page)
    assert page.ask("location.hash") == address
    assert {*wanted[1:].split("&")} == {*address[1:].split("&")}
    assert page.ask("document.getElementById('sigma-z-value').value") == "0.07"
    assert page.ask("document.querySelector('[name=input][value=zero]').checked")
    assert text(page, "now").startswith("Measurement 17 of")


# ------------------------------------------------------------------ the step


def test_the_ellipse_is_the_replays_p_at_every_step(
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
        # of points even around 2σ, the mean square is twice the covariance
        x = np.array([p[:-1], v[:-1]]) - np.array(mean)[:, None]
        (a, b), (_, d) = x @ x.T / x.shape[1] / 2.0
        if u >= 0 and not updated:
            row = updates.iloc[place[updates.index[u]]]
            assert a == pytest.approx(row["prior_position_variance_m2"], abs=1e-9)
            assert mean[0] == pytest.approx(row["measurement_m"] - row["innovation_m"], abs=1e-9)
        else:
            np.testing.assert_allclose([a, b, d], posterior[i], rtol=0.0, atol=1e-9)
            assert mean[0] == pytest.approx(steps["position_m"].iloc[i], abs=1e-9)


def test_space_plays_and_pauses(page: Browser) -> None:
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


def test_the_tour_from_end_to_end(page: Browser, explored: tuple[Path, Analysis]) -> None:
    analysis = explored[1]
    put(page, sigmaA=0.8, sigmaZ=0.2)
    before = page.ask("location.hash")
    page.click("#tour-start")
    settle(page)
    assert page.ask("document.getElementById('tour-back').disabled")
    seen = []
    knobs = "Explore.then((e) => [e.settings.sigmaA, e.settings.sigmaZ, e.settings.offset])"
    for _ in STATIONS:
        settle(page)
        a, z, offset = ask(page, knobs)
        assert page.ask(f"({IN_VIEW})('#sigma-a', '#needle').length") == 2
        seen.append((text(page, "tour-title"), text(page, "tour-sentence"), a, z, offset))
        assert text(page, "tour-task").startswith("Do: ")
        assert text(page, "tour-see").startswith("See: ")
        page.click("#tour-next")
    settle(page)
    assert [title for title, *_ in seen] == [f"{n + 1} of 7: {t}" for n, t in enumerate(STATIONS)]
    assert page.ask("document.getElementById('tour').hidden")
    assert page.ask("location.hash") == before
    # the numbers are this flight's
    _, forgotten, a, z, _ = seen[0]
    assert a == 0.002
    told = re.search(r"mean NIS goes from ([\d.]+) to ([\d.,]+)\.", forgotten)
    with_clock = _shifted(analysis, seen[0][4])
    assert told[2] == number_words(nis_with(with_clock, Settings(a, z)), 2)
    _, _, a, z, _ = seen[3]
    size = re.search(r"NIS from ([\d.]+) to ([\d.]+), a ninth", seen[3][1])
    assert float(size[2]) == pytest.approx(float(size[1]) / 9.0, rel=0.1)
    assert seen[6][1].startswith("EKF2's mean NIS is 0.86, ours ")


def _shifted(analysis: Analysis, offset_s: float) -> Any:
    """The same flight with its stamps corrected."""
    request = ComparisonRequest(
        log=str(Path("sample_logs") / analysis.flight.log.name), clock_offset_s=offset_s,
        start_s=analysis.segment.start_s, end_s=analysis.segment.end_s,
        heading_deg=analysis.main.axis.heading_deg,
    )  # fmt: skip
    return run_comparison(request, flight=analysis.flight)


# ------------------------------------------------------------------ everybody


def test_by_keyboard_alone(page: Browser) -> None:
    page.ask("document.getElementById('tab-filter').focus()")
    key(page, "ArrowRight")
    settle(page)
    assert page.ask("document.activeElement.id") == "tab-track"
    assert page.ask("document.querySelector('#position').checkVisibility()")
    assert not page.ask("document.querySelector('#innovation').checkVisibility()")
    key(page, "End")
    settle(page)
    assert page.ask("document.querySelector('#view-recorded').checkVisibility()")
    key(page, "ArrowRight")  # around
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
def test_axe_finds_nothing_serious(
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
