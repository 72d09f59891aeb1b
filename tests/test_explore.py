"""Explore page in a browser: numbers against Python, interaction, security; the command."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
import sys
from pathlib import Path

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
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import format_metres
from px4fuse.diagnose import prepare_comparison, read_flight
from px4fuse.explore import page as pages
from px4fuse.explore.page import make_analysis_page
from px4fuse.flight.model import Flight
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("cached_analyses")

MARKUP = '<img src=x onerror="window.alive=1"></script><script>window.alive=2</script>\u202e'
NUMBERS = "Explore.then((e) => e.result.numbers)"
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
        f"(({{value, min, max}}) => (value - min) / (max - min))"
        f"(document.getElementById({json.dumps(slider)}))"
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


def title(page: Browser, plot: str) -> str:
    """Return the title of a plot."""
    return str(
        page.ask(f"document.getElementById({json.dumps(plot)}).parentElement.innerText.trim()")
    )


def test_explore_page_sliders_equal_values_of_shown_command(
    page: Browser, explored: tuple[Path, Analysis], sample_log: Path
) -> None:
    for slider, share in (
        ("sigma-a", 0.72),
        ("sigma-z", 0.38),
        ("dt", 0.3),
        ("clock-offset", 0.55),
    ):
        drag(page, slider, share)
    page.ask("document.querySelector('#settings details').open = true")
    page.click("[name=axis][value=north]")
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
    shown, kf = ask(page, NUMBERS), north.filters["kf"]
    assert shown["count"] == kf.count
    expected = {
        "nis": kf.nis_mean, "outside": kf.fraction_outside_two_sigma,
        "truth": kf.truth.nees_position_mean**0.5, "rmse": kf.truth.position_rmse_m,
        "differenceRms": north.difference.position_rms_m,
    }  # fmt: skip
    assert {name: shown[name] for name in expected} == pytest.approx(expected, rel=1e-4)
    fractions = [
        f"{name} {100 * north.filters[key].fraction_outside_two_sigma:.0f} %"
        for key, name in FILTER_NAMES.items()
    ]
    assert title(page, "innovation").endswith(": " + ", ".join(fractions))
    rmse = [
        f"{name} {format_metres(north.filters[key].truth.position_rmse_m)} m"
        for key, name in FILTER_NAMES.items()
    ]
    assert f"position RMSE against ground truth: {', '.join(rmse)} ·" in title(page, "error")


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
    frame = explored[1].main.ekf2_tracks.innovations
    r = float(np.sqrt(frame["observation_variance_m2"].median()))
    assert float(page.ask("document.getElementById('sigma-z-value').value")) == pytest.approx(r)


def test_explore_page_rejects_value_out_of_range(page: Browser) -> None:
    page.ask(
        "(() => { const n = document.getElementById('sigma-z-value'); n.value = '500';"
        "n.dispatchEvent(new Event('change')); })()"
    )
    settle(page)
    assert page.ask("document.querySelector('.setting :invalid').id") == "sigma-z-value"
    assert ask(page, "Explore.then((e) => e.settings.sigma_z_m)") == 0.1


def test_explore_page_step_view_shows_one_measurement_at_a_time(
    page: Browser, explored: tuple[Path, Analysis]
) -> None:
    result = explored[1].main
    updates, steps = result.kf_run.updates, result.kf_run.steps
    open_view(page, "step")
    first = page.ask("document.getElementById('now').textContent")
    measurement_text = f"Measurement 1 of {len(updates)}, at {updates.index[0]:.3f} s"
    assert first == measurement_text
    for button in ("#next", "#next", "#previous"):
        page.click(button)
    settle(page)
    now = page.ask("document.getElementById('now').textContent")
    measurement_text = f"Measurement 2 of {len(updates)}, at {updates.index[1]:.3f} s"
    assert now == measurement_text
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
    page.press("n", "n")
    settle(page)
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
        "Explore.then((e) => Array.from(e.model('sigma_p:kf-source').data.t.slice(0, 2)))",
    )
    assert low - 1.0 < points[0] <= low
    page.click("#later")
    settle(page)
    new_low, new_high = (float(word) for word in re.findall(r"[\d.]+", page.ask(span)))
    assert (new_low, new_high - new_low) == pytest.approx(((low + high) / 2, high - low), abs=0.2)
    page.click("#whole")
    settle(page)
    assert page.ask(span) == whole


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
    assert re.search(r"KF: *-?\d+\.\d+", tooltips.replace("EKF2", ""))
    assert re.search(r"EKF2: *-?\d+\.\d+", tooltips)


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
    reasons = browser.ask(
        "[...document.querySelectorAll('#card .reason')].map((node) => node.textContent)"
    )
    assert len(reasons) == 3  # only KF against the source is evaluated
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
