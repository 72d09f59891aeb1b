"""Practice page: random sets, symptoms of each fault, questions, answers and score."""

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
from cards import SMALL_SIGMA_A
from cli_tools import run_checked
from comparisons import compare
from explore_tools import ask, axe, serious, settle, show
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.explore import practice
from px4fuse.explore.practice import NOISY_UWB_FAULT, QUIZ_ANSWERS, QuizFault, choose_random_flights
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Flight
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

# A set without a fault, with one of the source, and with one of the frame
SEED, COUNT = 5, 3


# ------------------------------------------------------------------ random sets


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 20))
def test_practice_flights_contain_each_fault_equally_often(
    seed: int, level: int, count: int
) -> None:
    rounds = choose_random_flights(seed, level, count)
    assert choose_random_flights(seed, level, count) == rounds
    assert len(rounds) == count
    first = Counter(
        one.faults_and_sizes[0][0].choice if one.faults_and_sizes else "nothing" for one in rounds
    )
    assert max(first.values()) - min(first[name] for name in QUIZ_ANSWERS) <= 1
    for one in rounds:
        assert set(one.correct_answers) <= set(QUIZ_ANSWERS)
        assert len(one.correct_answers) == max(len(one.faults_and_sizes), 1)
        assert len(one.faults_and_sizes) <= (2 if level == 3 else 1)
        for mistake, size in one.faults_and_sizes:
            assert size.removeprefix("-") == mistake.sizes[level - 1]
            assert mistake.has_random_sign or not size.startswith("-")


def test_practice_level_3_has_some_flights_with_two_faults() -> None:
    rounds = [one for seed in range(5) for one in choose_random_flights(seed, 3, 12)]
    two = sum(len(one.faults_and_sizes) == 2 for one in rounds)
    assert 0.15 * len(rounds) < two < 0.5 * len(rounds)


# ------------------------------------------------------------------ symptoms


def flown(mistake: QuizFault | None, level: int, seed: int) -> Flight:
    """Simulate a practice flight with one fault of a level, or without a fault."""
    size = "" if mistake is None else mistake.sizes[level - 1]
    noisy = mistake is not None and mistake.name == NOISY_UWB_FAULT
    scenario = Scenario(
        **practice.SCENARIO_SETTINGS,
        length_m=9.0 + 0.7 * seed,
        heading_deg=50.0 * seed,
        seed=seed,
        sigma_uwb_m=float(size) if noisy else 0.1,
    )
    options = [] if mistake is None or noisy else [f"{mistake.name}={size}"]
    return simulate_flight(scenario, parse_faults(options))


def compared(flight: Flight, **settings: float) -> Comparison:
    chosen = Settings(**({"sigma_a_m_s2": practice.SIGMA_A_M_S2} | settings))
    return compare(flight, chosen, keep_positions_as_sent=True)


def kf_statistics(flight: Flight, **settings: float) -> Any:
    """Return the consistency statistics of KF along the axis of largest motion."""
    return compared(flight, **settings).main.filters["kf"]


LEVELS_AND_SEEDS = [(1, 1), (3, 3)]


def hidden(name: str) -> QuizFault:
    """Return the fault with this name in px4fuse simulate."""
    return next(one for one in practice.QUIZ_FAULTS if one.name == name)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_practice_flight_without_fault_is_consistent(seed: int) -> None:
    found = compared(flown(None, 1, seed))
    assert {one.verdict for one in found.main.filters.values()} == {"consistent"}
    assert 0.01 < np.mean(_sigmas(found.main) > 2.0) < 0.09


def _sigmas(result: AxisComparison) -> Any:
    """Return |ν|/√S of KF."""
    rows = result.kf_run.updates
    return np.abs(rows["innovation_m"]) / np.sqrt(rows["innovation_variance_m2"])


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_practice_flight_with_nlos_or_jump_has_large_innovations(level: int, seed: int) -> None:
    found = compared(flown(hidden("nlos"), level, seed))
    far = [np.mean(_sigmas(found.axes[name]) > 4.0) for name in ("north", "east")]
    assert 0.01 < max(far) < 0.2
    assert all(np.median(_sigmas(found.axes[name])) < 1.0 for name in ("north", "east"))
    jumped = compared(flown(hidden("jump"), level, seed)).main
    rows = jumped.kf_run.updates
    far = np.flatnonzero(_sigmas(jumped) > 4.0)
    assert len(far) >= 1
    assert far[-1] - far[0] < 25  # one burst
    assert len(set(np.sign(rows["innovation_m"].iloc[far[:2]]))) == 1
    with_gap = compared(flown(hidden("dropout"), level, seed)).main
    intervals_s = np.diff(with_gap.kf_run.updates.index)
    assert intervals_s.max() > 4.0
    start = with_gap.kf_run.updates.index[intervals_s.argmax()]
    sigma = np.sqrt(with_gap.kf_run.steps["position_variance_m2"])
    assert sigma.loc[start : start + intervals_s.max() - 0.01].max() > 2.0 * sigma.median()


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_clock_offset_setting_corrects_late_timestamps(level: int, seed: int) -> None:
    one = hidden("clock-offset")
    flight = flown(one, level, seed)
    late_s = float(one.sizes[level - 1].removesuffix("ms")) / 1e3
    wrong, right = kf_statistics(flight), kf_statistics(flight, clock_offset_s=-late_s)
    assert wrong.nis_mean > 1.25 * right.nis_mean
    assert right.verdict == "consistent"


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_clock_offset_setting_does_not_correct_misaligned_frame(level: int, seed: int) -> None:
    flight = flown(hidden("yaw"), level, seed)
    for offset_s in (-0.4, -0.2, 0.0, 0.2, 0.4):
        found = compared(flight, clock_offset_s=offset_s)
        assert max(found.axes[name].filters["kf"].nis_mean for name in ("north", "east")) > 1.5


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_kf_on_noisy_practice_flight_is_consistent_at_true_noise(level: int, seed: int) -> None:
    noisy = flown(hidden(NOISY_UWB_FAULT), level, seed)
    assert kf_statistics(noisy).nis_mean > 2.0
    size = float(hidden(NOISY_UWB_FAULT).sizes[level - 1])
    assert kf_statistics(noisy, sigma_z_m=size).verdict == "consistent"
    vibrating = flown(hidden("vibration"), level, seed)
    before = kf_statistics(vibrating)
    assert before.nis_mean > 1.5
    assert before.lag1_autocorrelation > 0.2  # time-correlated
    size = float(hidden("vibration").sizes[level - 1])
    assert kf_statistics(vibrating, sigma_a_m_s2=size).verdict == "consistent"
    wrong = kf_statistics(vibrating, sigma_z_m=0.1 * np.sqrt(before.nis_mean))
    assert wrong.lag1_autocorrelation > 0.2  # a larger SIGMA_Z does not change the correlation
    filters = compared(flown(hidden("ekf2-noise"), level, seed)).main.filters
    assert filters["kf"].verdict == "consistent"
    assert filters["ekf2"].nis_mean > 2.0


@pytest.mark.parametrize(("level", "seed"), LEVELS_AND_SEEDS)
def test_too_small_ekf2_gate_rejects_consistent_innovations(level: int, seed: int) -> None:
    found = compared(flown(hidden("ekf2-gate"), level, seed)).main
    rows = found.ekf2_tracks.innovations
    assert (rows["rejected"] > 0).mean() > 0.15
    assert found.filters["kf"].verdict == "consistent"
    assert np.mean(_sigmas(found) > 2.0) < 0.1


# ------------------------------------------------------------------ page


@pytest.fixture(scope="module")
def quiz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("practice") / "quiz.html"
    file.write_bytes(practice.make_practice_page(SEED, 1, COUNT, lambda *_: None).encode())
    return file


def keys(file: Path) -> list[dict[str, Any]]:
    packed = re.findall(r'id="key-\d+">([^<]+)<', file.read_text(encoding="utf-8"))
    return [json.loads(zlib.decompress(base64.b64decode(text))) for text in packed]


def test_practice_page_html_source_does_not_show_solutions(quiz: Path) -> None:
    source = quiz.read_text(encoding="utf-8")
    answers = keys(quiz)
    assert [one["right"] for one in answers] == [
        one.correct_answers for one in choose_random_flights(SEED, 1, COUNT)
    ]
    for content in re.findall(r'id="content-\d+">([^<]+)<', source):
        flight = json.loads(content)["flight"]
        assert flight.keys().isdisjoint({"findings", "summary", "card"})
        assert "mistake" not in content
        assert "px4fuse compare 'flight" in flight["command"]
    for one in answers:
        assert "px4fuse-card" in one["card"]
        # a flight with a fault is never called consistent
        assert ("No fault found" in one["card"]) == (one["right"] == ["nothing"])
        for mistake in one["mistakes"]:
            assert mistake["size"] not in source
            assert mistake["symptom"] not in source


def choose(page: Browser, *names: str) -> None:
    for name in names:
        page.click(f"[name=choice][value={name}]")
    renewed(page, "#quiz-check")


def renewed(page: Browser, button: str) -> None:
    """Click a button that reloads the page, and wait for the new page."""
    page.ask("window.before = true")
    page.click(button)
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        with contextlib.suppress(AssertionError):  # no page while it reloads
            if page.ask(
                "window.before === undefined && document.querySelector('#span').textContent !== ''"
                " && document.getElementById('quiz-title').textContent !== ''"
            ):
                break
        time.sleep(0.05)
    ask(page, "Explore.then(() => 1)")
    settle(page)


def element_text(page: Browser, name: str) -> str:
    return str(page.ask(f"document.getElementById({json.dumps(name)}).textContent"))


def test_practice_page_scores_right_and_wrong_answers(browser: Browser, quiz: Path) -> None:
    page, answers = show(browser, quiz), keys(quiz)
    points = 0
    for number, key in enumerate(answers):
        title = f"Flight {number + 1} of {COUNT}: find the fault"
        assert element_text(page, "quiz-title") == title
        # the axis is evidence; headline, effect and causes are hidden
        assert page.ask("document.querySelectorAll('#card [data-filter] .mark').length") == 4
        assert "Evidence" in element_text(page, "card")
        assert "RMSE" not in element_text(page, "card")
        assert page.ask("document.getElementById('quiz-solution').hidden")
        if number == 0:
            page.click("#quiz-check")
            assert element_text(page, "quiz-message") == "Select at least one fault, or “no fault”."
        right = number % 3 != 1
        wrong = next(name for name in QUIZ_ANSWERS if name not in key["right"])
        choose(page, *(key["right"] if right else [wrong]))
        points += right
        heading = page.ask("document.querySelector('#quiz-solution h2').textContent")
        assert heading == ("✓ Correct" if right else "✕ Wrong")
        if not key["mistakes"]:
            assert "no fault" in element_text(page, "quiz-solution")
        for mistake in key["mistakes"]:
            assert (mistake["time"] != "whole flight") == (key["right"] == ["source"])
            for name in ("fault", "size", "time", "symptom"):
                assert mistake[name] in element_text(page, "quiz-solution")
        assert f"Score: {points} of {number + 1} answered flights" in element_text(
            page, "quiz-score"
        )
        # after the answer the page shows the card
        assert page.ask("document.querySelector('#card h2').textContent")
        assert "RMSE" in element_text(page, "card")
        assert page.ask("[...document.querySelectorAll('[name=choice]')].every((b) => b.disabled)")
        if number < COUNT - 1:
            renewed(page, "#quiz-next")
    assert (
        element_text(page, "quiz-score")
        == f"Score: {points} of {COUNT} answered flights, all answered"
    )
    assert page.ask("document.getElementById('quiz-next').hidden")
    assert page.complaints() == []
    assert page.requests() <= {"file", "data", "blob"}


def test_practice_page_gives_half_a_point_for_half_an_answer(browser: Browser, quiz: Path) -> None:
    points = show(browser, quiz).ask(
        "['gate', 'clock gate', 'frame gate', 'clock'].map((answer) =>"
        "Practice.points(answer, {right: ['clock', 'gate']}))"
    )
    assert points == [0.5, 1, 0, 0.5]


def test_practice_page_summary_names_fault_missed_by_student() -> None:
    clean = structs.replace(SMALL_SIGMA_A, severity="clean", causes=(), headline="No fault found")
    described = [{"fault": "gate of EKF2 too small", "size": "EKF2_EVP_GATE 1.4"}]
    named = practice._with_fault_headline(clean, described)
    assert named.headline == "Gate of EKF2 too small: EKF2_EVP_GATE 1.4"
    assert named.severity == "warning"
    assert practice._with_fault_headline(clean, []) is clean
    assert practice._with_fault_headline(SMALL_SIGMA_A, described) is SMALL_SIGMA_A


def test_practice_page_has_no_serious_accessibility_violation(browser: Browser, quiz: Path) -> None:
    page = show(browser, quiz, width=390)
    assert page.ask("document.documentElement.scrollWidth") <= 390
    page.ask(axe())
    assert serious(page) == []
    choose(page, "gate")
    page.ask(axe())
    assert serious(page) == []


# ------------------------------------------------------------------ command


def test_practice_command_writes_one_html_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(click, "launch", opened.append)
    # the content of the page is tested above
    monkeypatch.setattr(
        "px4fuse.explore.practice.make_practice_page", lambda *given: repr(given[:3])
    )
    run_checked("practice", "--seed", "3", "--flights", "1")
    page = tmp_path / "reports" / "practice_3.html"
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [page]
    assert page.read_text(encoding="utf-8") == "(3, 1, 1)"
    assert opened == []  # without --open and without a terminal
    run_checked("practice", "--seed", "3", "--flights", "1", "--open", "-o", "a.html")
    assert opened == [str(tmp_path / "a.html")]
