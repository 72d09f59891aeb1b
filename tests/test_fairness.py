"""What an ideal, an idle and a guessing student earn on assigned flights."""

from __future__ import annotations

from pathlib import Path

import fairness as made
import pandas as pd
import pytest
from fairness import NONE, STUDENTS, flown, measured, summary
from fairness_notes import SENTENCES, guessed, sentence
from scipy.stats import binomtest

from px4fuse.assignment.drawing import CHOICES
from px4fuse.filter.tuning import Tuned
from px4fuse.grading.claims import entailed
from px4fuse.grading.rubric import read_rubric
from px4fuse.results.contract import ComparisonResults

# Shares of the points: what the ideal student must have at least, the others at most
BOUNDS = {"ideal": 0.95, "default": 0.50, "guesser": 0.30}
TABLE = pd.read_csv(made.TABLE, keep_default_na=False)
MEANS = summary(TABLE)
# An aisle and a loop
AGAIN = ("s0", "s6")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where analyses that three students ask for are kept."""
    return tmp_path_factory.mktemp("kept")


def test_every_mistake_and_size_was_measured() -> None:
    assert TABLE["student"].is_unique
    wanted = {
        (choice.mistake, size)
        for kind in CHOICES.values()
        for choice in kind
        for size in (("plain", "small") if choice.limit is not None else ("",))
    }
    rows = {(row["mistake"], row["size"]): row["flights"] for row in MEANS.to_dict("records")}
    assert set(rows) == wanted | {(f"{NONE}, {kind}", "") for kind in CHOICES}
    assert min(rows.values()) >= 3


@pytest.mark.parametrize("who", STUDENTS)
def test_points_are_fair_for_every_mistake_and_size(who: str) -> None:
    percent, bound = (100 * MEANS[who]).round(), round(100 * BOUNDS[who])
    unfair = MEANS[percent < bound] if who == "ideal" else MEANS[percent > bound]
    assert unfair.empty, f"\n{unfair}"


def test_what_was_drawn_is_found() -> None:
    for name, rows in MEANS.groupby("mistake"):
        found, flights = round((rows["found"] * rows["flights"]).sum()), rows["flights"].sum()
        # not less often than in 19 of 20, as far as so few flights can say
        assert binomtest(found, flights, 0.95, alternative="less").pvalue > 0.05, name


@pytest.mark.parametrize("student", AGAIN)
def test_flights_give_again_what_the_table_has(student: str, kept: Path) -> None:
    (row,) = TABLE[TABLE["student"] == student].to_dict("records")
    again = measured(flown(int(student[1:]), kept), read_rubric(None))
    assert again == pytest.approx(row, abs=1e-3)


def test_means_are_by_mistake_and_size() -> None:
    limit = next(c.limit for c in CHOICES["aisle"] if c.mistake == "yaw")
    assert limit is not None
    flights = pd.DataFrame(
        [
            ("aisle", f"yaw={limit}deg ekf2-off", "source_frame_turned", 1.0, 0.4, 0.1),
            ("aisle", f"yaw=-{limit / 0.7:.1f}deg", "", 0.9, 0.2, 0.0),
            ("aisle", "ekf2-off", "", 0.8, 0.5, 0.3),
            ("loop", NONE, "", 0.7, 0.1, 0.2),
        ],
        columns=["kind", "mistakes", "missed", *STUDENTS],
    )
    rows = summary(flights).set_index(["mistake", "size"]).T.to_dict("list")
    assert rows == {
        ("ekf2-off", ""): [2, 1.0, 0.9, 0.45, 0.2],
        ("none, loop", ""): [1, 1.0, 0.7, 0.1, 0.2],
        ("yaw", "plain"): [1, 1.0, 0.9, 0.2, 0.0],
        ("yaw", "small"): [1, 0.0, 1.0, 0.4, 0.1],
    }


def test_there_are_words_for_every_mistake() -> None:
    assert set(SENTENCES) == {choice.mistake for kind in CHOICES.values() for choice in kind}
    assert "213ms" in sentence("clock-offset=-213ms", 0)


def test_the_ideal_student_sets_what_the_report_asks_for(kept: Path) -> None:
    one = flown(0, kept)
    ((first, _),) = made.by_default(one)
    (report, notes), (_, other) = made.ideal(one)
    assert isinstance(first, ComparisonResults)
    assert isinstance(report, ComparisonResults)
    tuned = report.tuning["horizontal"]
    assert isinstance(tuned, Tuned)
    assert tuned.filter_sigma_a_m_s2_interval is not None
    low, high = tuned.filter_sigma_a_m_s2_interval
    assert not low <= first.settings.sigma_a_m_s2 <= high
    assert low <= report.settings.sigma_a_m_s2 <= high
    assert all(sentence(typed, 0) in notes for typed in one.drawn.typed)
    assert all(sentence(typed, 1) in other for typed in one.drawn.typed)


def test_what_follows_from_a_mistake_may_be_said_and_what_causes_it_may_not() -> None:
    assert "ekf2_ev_delay_wrong" in entailed({"source_clock_offset"})
    assert "source_stamps_of_arrival" not in entailed({"source_clock_offset"})
    assert "source_stamps_of_arrival" in entailed({"source_stamps_of_arrival"})
    assert "source_outliers" not in entailed({"ekf2_rejecting"})


def test_a_subject_with_a_size_is_a_claim_where_nothing_right_is_named(kept: Path) -> None:
    one, rubric = flown(6, kept), read_rubric(None)
    assert one.drawn.findings == ("false_loop_closure",)
    ((report, _),) = made.by_default(one)
    wrong = guessed(report, ["clock-offset=247ms"], 0)
    nothing = wrong.replace("247ms", "0.00 s").replace("at 1 m/s that moves", "that moves")
    right = guessed(report, one.drawn.typed, 0)

    def points(notes: str, title: str) -> float:
        items = made.earned(one, report, notes, rubric).items
        return next(item.points for item in items if item.title == title)

    for title in ("The mistake in your log", "Findings explained"):
        assert points(wrong, title) < points(nothing, title) < points(right, title)
    assert points(wrong, "The mistake in your log") == -40.0
    assert points(nothing, "The mistake in your log") == 0.0
    assert points(right, "The mistake in your log") == 40.0
    assert points(wrong, "Notes of your own") == 0.0 < points(right, "Notes of your own")
