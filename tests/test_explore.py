"""Explore page in a browser: numbers against Python, interaction, security; the command."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from browser import Browser, Elements
from cli_tools import error_line, run_checked
from comparisons import compare, compare_prepared
from exchange import replace
from explore_tools import ask, box, mouse, open_view, settle, show
from flights import Imu, aisle_flight, unexplained

from px4fuse.analysis import Analysis
from px4fuse.cli.compare import compare as compare_command
from px4fuse.cli.options import comparison_request, read_student
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison
from px4fuse.core.text import format_ratio
from px4fuse.diagnose import prepare_comparison, read_flight
from px4fuse.explore import page as pages
from px4fuse.explore.page import make_analysis_page
from px4fuse.flight.model import Flight
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("cached_analyses")

MARKUP = '<img src=x onerror="window.alive=1"></script><script>window.alive=2</script>\u202e'
TABLE = """Object.fromEntries([...document.querySelectorAll('#table tbody tr')].map((row) =>
  [row.cells[0].textContent, [row.cells[1].textContent, row.cells[2].textContent]]))"""

VALUES = "[...document.querySelectorAll('.setting input[type=number]')].map((node) => node.value)"


def bare(flight: Flight) -> Analysis:
    """Make an analysis without the slow explanations, which the page does not need."""
    asked = ComparisonRequest(log=flight.log.name)
    return replace(unexplained(compare(flight)), request=asked)


def page_of(analysis: Analysis, file: Path) -> Path:
    file.write_bytes(make_analysis_page(analysis).encode())
    return file


# ------------------------------------------------------------------ without a browser


def test_explore_page_content_policy_allows_only_its_scripts(
    explored: tuple[Path, Analysis],
) -> None:
    text = explored[0].read_text(encoding="utf-8")
    policy = next(a["content"] or "" for _, a in Elements(text).found if a.get("http-equiv"))
    assert "default-src 'none'" in policy
    assert "unsafe-eval" not in policy
    assert not re.search(r"https?:|connect-src|script-src[^;]*unsafe", policy)
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert len(scripts) == 3
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    assert policy.count("sha256") == 3
    for tag, attributes in Elements(text).found:
        assert tag not in ("img", "iframe", "object", "a", "base")
        assert "src" not in attributes
        assert attributes.get("href") in (None, "data:,")


def test_explore_page_is_small_and_contains_no_file_paths(
    explored: tuple[Path, Analysis], tmp_path: Path
) -> None:
    text = explored[0].read_text(encoding="utf-8")
    assert len(text.encode()) < 3e6
    own = text.replace(text[text.index("<script>") : text.index("</script>", 10**6)], "")
    assert str(explored[0].parent) not in own
    assert "/home/" not in own
    assert "/tmp/" not in own
    # ten minutes of IMU data at the full rate
    analysis = bare(aisle_flight(duration_s=600.0, imu=Imu(rate_hz=250.0)))
    assert page_of(analysis, tmp_path / "long.html").stat().st_size < 6e6


# ------------------------------------------------------------------ numbers


def drag(page: Browser, slider: str, share: float) -> None:
    """Drag a slider with the mouse to a share of its range."""
    x, y, width, height = box(page, slider)
    now = page.ask(
        f"(({{value, max}}) => value / max)(document.getElementById({json.dumps(slider)}))"
    )
    # the centre of the thumb does not reach the ends of the slider
    places = [x + 8 + (width - 16) * at for at in np.linspace(now, share, 6)]
    mouse(page, [(at, y + height / 2) for at in places])


def of_command(page: Browser, sample_log: Path) -> ComparisonRequest:
    """Parse the command on the page into a request."""
    words = shlex.split(page.ask("document.querySelector('#command').textContent"))
    assert words[:2] == ["px4fuse", "compare"]
    with compare_command.make_context("compare", words[2:]) as context:
        given = dict(context.params)
        for name in ("output", "json_path", "fail_on", "checks", "verbose", "quiet"):
            given.pop(name, None)
        read_student(given, given.pop("log"))
        return comparison_request(sample_log, given)


def cells(result: AxisComparison) -> dict[str, list[str]]:
    def statement(found: Any) -> list[str]:
        return [
            format_ratio(found.nis_mean**0.5), format_ratio(found.truth.nees_position_mean**0.5),
            f"{100 * found.fraction_outside_two_sigma:.1f} %", f"{found.lag1_autocorrelation:.2f}",
            str(found.count),
        ]  # fmt: skip

    names = ["● innovation ÷ √S, RMS", "◆ error ÷ σ, RMS",
             "Innovations outside ±2√S (expected 5 %)",
             "Lag-1 autocorrelation of the innovations", "Number of measurements"]  # fmt: skip
    both = zip(*(statement(result.filters[name]) for name in FILTER_NAMES), strict=True)
    expected = {name: list(pair) for name, pair in zip(names, both, strict=True)}
    difference: Any = result.difference
    errors = [result.filters[name].truth for name in FILTER_NAMES]
    expected["KF − EKF2 position difference, RMS"] = [f"{difference.position_rms_m:.3f} m", "–"]
    expected["KF − EKF2 velocity difference, RMS"] = [f"{difference.velocity_rms_m_s:.3f} m/s", "–"]
    for name, unit in (("Position", "m"), ("Velocity", "m/s")):
        field = "position_rmse_m" if unit == "m" else "velocity_rmse_m_s"
        expected[f"{name} RMSE"] = [f"{getattr(one, field):.3f} {unit}" for one in errors]
    return expected


def test_explore_page_sliders_equal_values_of_shown_command(
    page: Browser, explored: tuple[Path, Analysis], sample_log: Path
) -> None:
    before = page.ask(TABLE)
    for slider, share in (
        ("sigma-a", 0.72),
        ("sigma-z", 0.38),
        ("dt", 0.3),
        ("clock-offset", 0.55),
    ):
        drag(page, slider, share)
    page.ask("document.querySelector('#settings details').open = true")
    page.click("#axes input[value=north]")
    settle(page)
    request = of_command(page, sample_log)
    values = page.ask(VALUES)
    assert [float(value) for value in values] == [
        request.sigma_a_m_s2, request.sigma_z_m, request.clock_offset_s, request.dt_s
    ]  # fmt: skip
    assert request.sigma_a_m_s2 > 2.0
    assert request.sigma_z_m < 0.05
    assert request.dt_s < 0.05
    assert 0.03 < request.clock_offset_s < 0.09
    # the command states segment and aisle, which the timestamps would change
    segment = explored[1].segment
    assert (request.start_s, request.end_s) == pytest.approx((segment.start_s, segment.end_s))
    assert request.heading_deg == pytest.approx(explored[1].main.axis.heading_deg)
    comparison = compare_prepared(prepare_comparison(read_flight(request), request))
    north = next(result for result in comparison.axes.values() if result.axis.name == "north")
    shown = page.ask(TABLE)
    assert shown != before
    expected = cells(north)
    assert {name: shown[name] for name in expected} == expected


def test_explore_page_buttons_set_estimated_or_ekf2_noises(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    tuned = explored[1].tuning["horizontal"]
    page.click("#likely")
    settle(page)
    a, z = (float(page.ask(f"document.getElementById('{name}-value').value"))
            for name in ("sigma-a", "sigma-z"))  # fmt: skip
    assert a == pytest.approx(tuned.sigma_a_two_state.value, rel=5e-3)
    assert z == pytest.approx(tuned.sigma_z.value, rel=5e-3)
    page.click("#ekf2-r")
    settle(page)
    frame = explored[1].main.ekf2_innovations
    r = float(np.sqrt(frame["observation_variance_m2"].median()))
    assert float(page.ask("document.getElementById('sigma-z-value').value")) == pytest.approx(r)
    page.click("#lesson")
    settle(page)
    assert page.ask("document.querySelector('#command').textContent").endswith("aisle_uwb.ulg")


def test_explore_page_invalid_input_shows_a_message(page: Browser) -> None:
    page.ask("location.hash = '#sigma-a=-1&sigma-z=0.2&dt=abc&axis=<b>&input=gps&view=nowhere'")
    settle(page)
    message = "document.getElementById('message').textContent"
    assert page.ask(message) == (
        "Invalid values in the page address are ignored: sigma-a, dt, axis, input, view."
    )
    page.ask(
        "(() => { const n = document.getElementById('sigma-z-value'); n.value = '500';"
        "n.dispatchEvent(new Event('change')); })()"
    )
    settle(page)
    assert "must be between 0.0001 and 100 m" in page.ask(message)
    assert page.ask(VALUES) == ["0.5", "0.2", "0", "0.1"]


def test_explore_page_step_view_shows_one_measurement_at_a_time(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    result = explored[1].main
    updates, steps = result.replay.updates, result.replay.steps
    open_view(page, "step")
    first = page.ask("document.getElementById('now').textContent")
    measurement_text = f"Measurement 1 of {len(updates)}, at {updates.index[0]:.3f} s"
    assert first == f"{measurement_text}: after the update of KF"
    page.click("#next")
    page.click("#next")
    page.click("#previous")
    now = page.ask("document.getElementById('now').textContent")
    measurement_text = f"Measurement 2 of {len(updates)}, at {updates.index[1]:.3f} s"
    assert now == f"{measurement_text}: after the update of KF"
    text = page.ask("document.getElementById('numbers').innerText")
    row, after = updates.iloc[1], steps.loc[updates.index[1]]
    for part in (
        f"z = {row['measurement_m']:.4f} m",
        f"ν = z − Hx⁻ = {row['innovation_m']:.4f} m",
        f"S = HP⁻Hᵀ + R = {row['innovation_variance_m2']:.5f} m²",
        f"K = P⁻Hᵀ/S = [{row['gain_position']:.4f}, {row['gain_velocity']:.4f} 1/s]",
        f"x⁺ = x⁻ + Kν = [{after['position_m']:.4f} m, {after['velocity_m_s']:.4f} m/s]",
        f"σ_p decreases: {np.sqrt(row['prior_position_variance_m2']):.4f} to "
        f"{np.sqrt(after['position_variance_m2']):.4f} m",
    ):
        assert part in text
    assert "measurement=2" in page.ask("location.hash")
    page.press("Tab")
    page.ask("document.activeElement.blur()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="n", text="n")
    assert page.ask("document.getElementById('now').textContent").startswith("Measurement 3 ")


def test_explore_page_zoom_buttons_set_time_axis_of_all_plots(page: Browser) -> None:
    span = "document.getElementById('span').textContent"
    whole = page.ask(span)
    open_view(page, "sigma")
    page.click("#closer")
    settle(page)
    low, high = (float(word) for word in re.findall(r"[\d.]+", page.ask(span)))
    assert 0.0 < low < high
    points = ask(
        page,
        "Explore.then((e) => Array.from(e.model('sigma_p:steps-source').data.t.slice(0, 2)))",
    )
    assert low - 1.0 < points[0] <= low
    page.click("#whole")
    settle(page)
    assert page.ask(span) == whole
    page.call("Input.dispatchKeyEvent", type="keyDown", key="+", text="+")
    settle(page)
    assert page.ask(span) != whole


def test_explore_page_tooltips_show_values(page: Browser) -> None:
    open_view(page, "track")
    x, y, width, height = box(page, "position")
    for step in range(3):
        at = {"x": x + width / 2 + step, "y": y + height / 2}
        page.call("Input.dispatchMouseEvent", type="mouseMoved", **at)
        settle(page)
    # tooltips are in the shadow roots of the plots
    tooltips = page.ask(
        "(() => { const all = (root) => [...root.querySelectorAll('*')].flatMap((node) =>"
        "node.shadowRoot ? [...node.shadowRoot.children].map((one) => one.textContent)"
        ".concat(all(node.shadowRoot)) : []);"
        "return all(document.body).join(' '); })()"
    )
    assert re.search(r"KF: *-?[\d.]+ m", tooltips.replace("EKF2", ""))
    assert re.search(r"EKF2: *-?[\d.]+ m", tooltips)
    colour = "Explore.then((e) => e.model('position').renderers.at(-1).glyph.line_color)"
    light = ask(page, colour)
    page.scheme("dark")
    settle(page)
    assert ask(page, colour) != light
    page.scheme("")
    settle(page)
    assert ask(page, colour) == light


def test_explore_page_shows_markup_in_log_name_as_text(browser: Browser, tmp_path: Path) -> None:
    flight = aisle_flight(duration_s=20.0)
    flight = replace(flight, log=replace(flight.log, name=f"{MARKUP}.ulg"))
    show(browser, page_of(bare(flight), tmp_path / "hostile.html"))
    assert browser.ask("window.alive") is None
    assert browser.ask("document.querySelectorAll('img').length") == 0
    assert "onerror" in browser.ask("document.querySelector('header').textContent")
    assert "\u202e" not in browser.ask("document.body.innerText")
    assert browser.complaints() == []


def test_explore_page_without_ekf2_and_truth_shows_only_kf(
    browser: Browser, tmp_path: Path
) -> None:
    flight = aisle_flight(duration_s=20.0, ekf2=None, truth=False, imu=None)
    show(browser, page_of(bare(flight), tmp_path / "bare.html"))
    table = browser.ask(TABLE)
    assert {pair[1] for pair in table.values()} == {"–"}
    assert "Ground truth is missing: " in browser.ask("document.getElementById('why').textContent")
    assert browser.ask("document.querySelector('[value=imu]').disabled")
    assert browser.ask("document.getElementById('likely').disabled")
    assert browser.complaints() == []


# ------------------------------------------------------------------ the command


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the page by an empty one, for tests of the output path."""
    monkeypatch.setattr(pages, "make_analysis_page", lambda _: "")


@pytest.mark.usefixtures("no_page")
def test_explore_command_without_log_uses_sample_flight(
    sample_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "px4fuse_samples", None)
    assert "no log was given" in error_line("explore").lower()
    assert list(tmp_path.iterdir()) == []
    here = tmp_path / "sample_logs"
    here.mkdir()
    (here / sample_log.name).write_bytes(sample_log.read_bytes())
    output = run_checked("explore", "--start", "20", "--end", "40").stderr
    assert "No log was given: the sample log aisle_uwb.ulg is used." in output
    assert (tmp_path / "reports" / "aisle_uwb_start-20_end-40.html").is_file()


@pytest.mark.usefixtures("no_drawing", "no_page")
def test_open_option_opens_the_written_file(
    sample_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(click, "launch", opened.append)
    monkeypatch.chdir(tmp_path)
    log, part = str(sample_log), ["--start", "20", "--end", "40"]
    for words, name in (
        (["explore", log, *part, "--open", "-o", "page.html"], "page.html"),
        (["compare", log, *part, "--show", "-o", "report.pdf"], "report.pdf"),
        (["evaluate", f"{log}:ekf2", f"{log}:truth", "-o", "a.pdf", "--open"], "a.pdf"),
        (["compare", log, *part, "--json", "only.json", "-o", "other.pdf"], None),
    ):
        run_checked(*words)
        assert opened == ([] if name is None else [str(tmp_path / name)])
        opened.clear()
