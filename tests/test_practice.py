"""Practice: what is drawn, what the page asks and tells, and that every tell-tale is true."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import time
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from browser import Browser
from cli_tools import done
from explore_tools import ask, axe, serious, settle, show
from hypothesis import given
from hypothesis import strategies as st

from px4fuse import practice
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.filter.settings import Settings
from px4fuse.flight import Flight
from px4fuse.practice import CHOICES, NOISY_UWB, Trick, draw
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

# Nothing, the source, the frame
SEED, COUNT = 5, 3


# ------------------------------------------------------------------ what is drawn


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 20))
def test_a_set_has_every_choice_in_turn(seed: int, level: int, count: int) -> None:
    rounds = draw(seed, level, count)
    assert draw(seed, level, count) == rounds
    assert len(rounds) == count
    first = Counter(one.tricks[0].choice if one.tricks else "nothing" for one in rounds)
    assert max(first.values()) - min(first[name] for name in CHOICES) <= 1
    for one in rounds:
        assert set(one.right) <= set(CHOICES)
        assert len(one.right) == max(len(one.tricks), 1)
        assert len(one.tricks) <= (2 if level == 3 else 1)
        for trick, size in zip(one.tricks, one.typed, strict=True):
            assert size.removeprefix("-") == trick.sizes[level - 1]
            assert trick.either_sign or not size.startswith("-")


def test_the_hardest_level_has_two_mistakes_at_times() -> None:
    rounds = [one for seed in range(5) for one in draw(seed, 3, 12)]
    two = sum(len(one.tricks) == 2 for one in rounds)
    assert 0.15 * len(rounds) < two < 0.5 * len(rounds)


# ------------------------------------------------------------------ the tell-tales


def flown(trick: Trick | None, level: int, seed: int) -> Flight:
    """With one mistake of a level, or without."""
    size = "" if trick is None else trick.sizes[level - 1]
    noisy = trick is not None and trick.mistake == NOISY_UWB
    scenario = Scenario(**practice.FLOWN, length_m=9.0 + 0.7 * seed, heading_deg=50.0 * seed,
                        seed=seed, sigma_uwb_m=float(size) if noisy else 0.1)  # fmt: skip
    named = [] if trick is None or noisy else [f"{trick.mistake}={size}"]
    return simulate_flight(scenario, parse(named))


def judged(flight: Flight, **settings: float) -> Comparison:
    return compare(flight, Settings(**({"sigma_a_m_s2": practice.SIGMA_A_M_S2} | settings)))


def ours(flight: Flight, **settings: float) -> Any:
    """What is said of our filter along the aisle."""
    return judged(flight, **settings).main.filters["kf"]


LEVELS_AND_SEEDS = [(1, 1), (3, 3)]


def trick(mistake: str) -> Trick:
    return next(one for one in practice.TRICKS if one.mistake == mistake)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_wrong_is_honest(seed: int) -> None:
    found = judged(flown(None, 1, seed))
    assert {one.verdict for one in found.main.filters.values()} == {"consistent"}
    assert 0.01 < np.mean(_sigmas(found.main) > 2.0) < 0.09


def _sigmas(result: AxisComparison) -> Any:
    rows = result.replay.updates
    return np.abs(rows["innovation_m"]) / np.sqrt(rows["innovation_variance_m2"])


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_outliers_lie_far_outside_while_the_rest_fits(level: int, seed: int) -> None:
    found = judged(flown(trick("nlos"), level, seed))
    far = [np.mean(_sigmas(found.axes[name]) > 4.0) for name in ("north", "east")]
    assert 0.01 < max(far) < 0.2
    assert all(np.median(_sigmas(found.axes[name])) < 1.0 for name in ("north", "east"))
    jumped = judged(flown(trick("jump"), level, seed)).main
    rows = jumped.replay.updates
    far = np.flatnonzero(_sigmas(jumped) > 4.0)
    assert len(far) >= 1
    assert far[-1] - far[0] < 25  # one burst
    assert len(set(np.sign(rows["innovation_m"].iloc[far[:2]]))) == 1
    silent = judged(flown(trick("dropout"), level, seed)).main
    apart = np.diff(silent.replay.updates.index)
    assert apart.max() > 4.0
    steps = silent.replay.steps
    start = silent.replay.updates.index[apart.argmax()]
    sigma = np.sqrt(steps["position_variance_m2"])
    assert sigma.loc[start : start + apart.max() - 0.01].max() > 2.0 * sigma.median()


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_the_clock_knob_undoes_a_clock(level: int, seed: int) -> None:
    one = trick("clock-offset")
    flight = flown(one, level, seed)
    late_s = float(one.sizes[level - 1].removesuffix("ms")) / 1e3
    wrong, right = ours(flight), ours(flight, clock_offset_s=-late_s)
    assert wrong.nis_mean > 1.25 * right.nis_mean
    assert (wrong.verdict, right.verdict) == ("variance understated", "consistent")


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_no_clock_knob_undoes_a_turned_frame(level: int, seed: int) -> None:
    flight = flown(trick("yaw"), level, seed)
    for offset_s in (-0.4, -0.2, 0.0, 0.2, 0.4):
        found = judged(flight, clock_offset_s=offset_s)
        assert max(found.axes[name].filters["kf"].nis_mean for name in ("north", "east")) > 1.5


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_each_noise_is_cured_by_its_own_knob(level: int, seed: int) -> None:
    noisy = flown(trick(NOISY_UWB), level, seed)
    assert ours(noisy).nis_mean > 2.0
    size = float(trick(NOISY_UWB).sizes[level - 1])
    assert ours(noisy, sigma_z_m=size).verdict == "consistent"
    shaken = flown(trick("vibration"), level, seed)
    before = ours(shaken)
    assert before.nis_mean > 1.5
    assert before.lag1_autocorrelation > 0.2  # they follow each other
    size = float(trick("vibration").sizes[level - 1])
    assert ours(shaken, sigma_a_m_s2=size).verdict == "consistent"
    wrong = ours(shaken, sigma_z_m=0.1 * np.sqrt(before.nis_mean))
    assert wrong.lag1_autocorrelation > 0.2  # a larger SIGMA_Z leaves their order
    filters = judged(flown(trick("ekf2-noise"), level, seed)).main.filters
    assert filters["kf"].verdict == "consistent"
    assert filters["ekf2"].nis_mean > 2.0


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_a_small_gate_rejects_what_fits_ours(level: int, seed: int) -> None:
    found = judged(flown(trick("ekf2-gate"), level, seed)).main
    rows = found.ekf2_innovations
    assert (rows["rejected"] > 0).mean() > 0.15
    assert found.filters["kf"].verdict == "consistent"
    assert np.mean(_sigmas(found) > 2.0) < 0.1


# ------------------------------------------------------------------ the page


@pytest.fixture(scope="module")
def quiz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("practice") / "quiz.html"
    file.write_bytes(practice.practice_text(SEED, 1, COUNT).encode())
    return file


def keys(file: Path) -> list[dict[str, Any]]:
    packed = re.findall(r'id="key-\d+">([^<]+)<', file.read_text(encoding="utf-8"))
    return [json.loads(zlib.decompress(base64.b64decode(text))) for text in packed]


def test_nobody_reads_the_answers_by_chance(quiz: Path) -> None:
    source = quiz.read_text(encoding="utf-8")
    told = keys(quiz)
    assert [one["right"] for one in told] == [one.right for one in draw(SEED, 1, COUNT)]
    for content in re.findall(r'id="content-\d+">([^<]+)<', source):
        flight = json.loads(content)["flight"]
        assert flight["findings"] == flight["story"] == []
        assert "mistake" not in content
        assert "px4fuse compare 'flight" in flight["command"]["bare"]
    for one in told:
        assert one["story"]
        for made in one["made"]:
            assert made["what"] not in source
            assert made["tell"] not in source


def choose(page: Browser, *names: str) -> None:
    for name in names:
        page.click(f"[name=choice][value={name}]")
    renewed(page, "#quiz-check")


def renewed(page: Browser, button: str) -> None:
    """On what loads the page anew; until that is there."""
    page.ask("window.before = true")
    page.click(button)
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        with contextlib.suppress(AssertionError):  # in between there is no page
            if page.ask(
                "window.before === undefined && document.querySelector('#table tbody tr') !== null"
                " && document.getElementById('quiz-title').textContent !== ''"
            ):
                break
        time.sleep(0.05)
    ask(page, "Explore.then(() => 1)")
    settle(page)


def said(page: Browser, name: str) -> str:
    return str(page.ask(f"document.getElementById({json.dumps(name)}).textContent"))


def test_flights_with_right_and_wrong_answers(browser: Browser, quiz: Path) -> None:
    page, told = show(browser, quiz), keys(quiz)
    points = 0
    for number, key in enumerate(told):
        assert said(page, "quiz-title") == f"Flight {number + 1} of {COUNT}"
        assert "truth" not in said(page, "live")
        assert said(page, "found") == "Not told yet."
        assert page.ask("document.getElementById('quiz-told').textContent") == ""
        if number == 0:
            page.click("#quiz-check")
            assert said(page, "quiz-said") == "Choose at least one."
        right = number % 3 != 1
        wrong = next(name for name in CHOICES if name not in key["right"])
        choose(page, *(key["right"] if right else [wrong]))
        points += right
        answer = " and ".join(key["right"])
        assert said(page, "quiz-said") == ("Right." if right else f"Not so. It was: {answer}.")
        for made in key["made"]:
            assert (made["span"] is not None) == (key["right"] == ["source"])
            assert made["what"] in said(page, "quiz-told")
            assert made["tell"] in said(page, "quiz-told")
        assert f"{points} of {number + 1} right" in said(page, "quiz-score")
        for made in key["made"]:
            page.click("#quiz-told button")
            settle(page)
            low, high = ask(page, "Explore.then((e) => [e.timeRange.start, e.timeRange.end])")
            if made["span"] is not None:
                assert low < made["span"][0] < high < low + 25.0
        # now the truth stands beside the filter
        assert "from the truth" in said(page, "live")
        assert key["story"][0] in said(page, "found")
        assert page.ask("[...document.querySelectorAll('[name=choice]')].every((b) => b.disabled)")
        if number < COUNT - 1:
            renewed(page, "#quiz-next")
    assert said(page, "quiz-score") == f"{points} of {COUNT} right: the set is done"
    assert page.ask("document.getElementById('quiz-next').hidden")
    assert page.complaints() == []
    assert page.requests() <= {"file", "data", "blob"}
    renewed(page, "#quiz-again")
    assert said(page, "quiz-title") == f"Flight 1 of {COUNT}"
    assert said(page, "quiz-score") == ""


def test_half_of_two_is_half_and_nothing_excludes_the_rest(browser: Browser, quiz: Path) -> None:
    page = show(browser, quiz)
    for name in ("gate", "clock", "nothing"):
        page.click(f"[name=choice][value={name}]")
    chosen = "[...document.querySelectorAll('[name=choice]:checked')].map((b) => b.value)"
    assert page.ask(chosen) == ["nothing"]
    page.click("[name=choice][value=gate]")
    assert page.ask(chosen) == ["gate"]
    points = page.ask(
        "['gate', 'clock gate', 'frame gate', 'clock'].map((answer) =>"
        "Practice.points(answer, {right: ['clock', 'gate']}))"
    )
    assert points == [0.5, 1, 0, 0.5]


def test_axe_finds_nothing_serious_in_the_quiz(browser: Browser, quiz: Path) -> None:
    page = show(browser, quiz, width=390)
    assert page.ask("document.documentElement.scrollWidth") <= 390
    page.ask(axe())
    assert serious(page) == []
    choose(page, "gate")
    page.ask(axe())
    assert serious(page) == []


# ------------------------------------------------------------------ the command


def test_the_command_writes_one_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(click, "launch", opened.append)
    # what it holds is tested above, and the lab's own command makes one
    monkeypatch.setattr("px4fuse.practice.practice_text", lambda *given: repr(given[:3]))
    done("practice", "--seed", "3", "--flights", "1")
    page = tmp_path / "reports" / "practice_3.html"
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [page]
    assert page.read_text(encoding="utf-8") == "(3, 1, 1)"
    assert opened == []  # nobody sits there
    done("practice", "--seed", "3", "--flights", "1", "--open", "-o", "a.html")
    assert opened == [str(tmp_path / "a.html")]
