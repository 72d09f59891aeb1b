"""Diagnosis card as text: axis, actions, length, characters, and commands with the typed path."""

from __future__ import annotations

import re

import pytest
from cards import SMALL_SIGMA_A, verdicts
from msgspec.structs import replace

from px4fuse.card.model import Action, DiagnosisCard, Note
from px4fuse.report import card_text
from px4fuse.report.card_text import draw_sigma_ratio, to_ascii, with_typed_path

SENDER = Action("sender", "subtract 0.264 s from the timestamp of each position")
DELAY = Action("EKF2", "EKF2_EV_DELAY 0 → 264 ms", ("param set EKF2_EV_DELAY 264",), "console")


def text_of(card: DiagnosisCard) -> list[str]:
    return [text for line in card_text.format_card_lines(card) for text in line.wrap(100)]


@pytest.mark.parametrize(
    ("ratio", "column", "mark"),
    [(1.0, 21, "●"), (0.1, 5, "●"), (10.0, 37, "●"), (0.01, 5, "◀"), (128.0, 37, "▶")],
)
def test_text_plot_marks_error_to_sigma_ratio_on_log_scale(ratio, column, mark) -> None:
    drawn = draw_sigma_ratio(ratio, "source")
    assert (len(drawn), drawn.index(mark)) == (41, column)


def test_text_plot_without_sigma_ratio_shows_consistent_range() -> None:
    assert re.fullmatch("1/10 ─{14}░{5}─{14} 10", draw_sigma_ratio(None, "source"))
    assert re.fullmatch("1/10 ─{13}░{7}─{13} 10", draw_sigma_ratio(None, "truth"))


def test_diagnosis_text_has_at_most_40_lines() -> None:
    lines = text_of(SMALL_SIGMA_A)
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    whole = " ".join(" ".join(lines).split())
    assert f"error[{SMALL_SIGMA_A.id}]: {SMALL_SIGMA_A.headline}" in lines
    for part in (SMALL_SIGMA_A.effect_text, *SMALL_SIGMA_A.do_this, SMALL_SIGMA_A.difference):
        assert part in whole


def test_diagnosis_on_terminal_below_98_columns_omits_text_plots() -> None:
    card = replace(SMALL_SIGMA_A, causes=())
    wide, narrow = (
        [text for line in card_text.format_card_lines(card) for text in line.wrap(width)]
        for width in (98, 80)
    )
    assert any("─░" in text for text in wide)
    assert not any("─" in text for text in narrow)
    ratio_lines = [
        text[: card_text.SIGMA_RATIO_AXIS_INDENT].rstrip() for text in wide if "─░" in text
    ]
    assert ratio_lines == [text for text in narrow if text in ratio_lines]


def test_alternative_actions_are_numbered_in_diagnosis_text() -> None:
    cause = replace(SMALL_SIGMA_A.causes[0], alternatives=((SENDER,), (DELAY,)))
    card = replace(SMALL_SIGMA_A, causes=(cause,))
    lines = text_of(card)
    (first,) = (at for at, line in enumerate(lines) if line.startswith("  option 1: sender   "))
    assert SENDER.sentence in lines[first]
    assert lines[first + 1].startswith("  option 2: EKF2     set in the MAVLink Console")
    assert lines[first + 2].split() == ["param", "set", "EKF2_EV_DELAY", "264"]
    assert lines[first + 3].startswith("  in addition: KF    run again: px4fuse compare ")
    (explanation,) = (line.text for line in card_text.format_closing_lines(card))
    assert explanation.endswith(f"px4fuse explain {card.id}")


def test_verbose_diagnosis_does_not_advise_verbose_output() -> None:
    notes = tuple(Note(f"note_{number}", f"Text {number}.") for number in range(5))
    card = replace(SMALL_SIGMA_A, notes=notes, more_causes=3)
    for verbose in (False, True):
        lines = (
            *card_text.format_card_lines(card),
            *card_text.format_closing_lines(card, verbose=verbose),
        )
        advice = [line.text for line in lines if "-v" in line.text.replace(";", "").split()]
        assert [text.startswith("More: -v") for text in advice] == [True] * (not verbose)


def test_diagnosis_text_has_numbered_causes_and_count_of_notes() -> None:
    notes = tuple(Note(f"note_{number}", f"Text {number}.") for number in range(5))
    card = replace(SMALL_SIGMA_A, causes=2 * SMALL_SIGMA_A.causes, notes=notes)
    lines = text_of(card)
    assert [line.split()[1] for line in lines if line.startswith("  cause")] == ["1", "2"]
    assert lines[-2:] == [
        "note[note_2]: Text 2.",
        '2 more notes are listed in section "All findings" of the report',
    ]


def test_diagnosis_text_on_ascii_terminal_is_ascii() -> None:
    four = verdicts((0.01, "underconfident"), (128.0, "overconfident"), *[(1.0, "consistent")] * 2)
    text = "\n".join(map(to_ascii, text_of(replace(SMALL_SIGMA_A, verdicts=four))))
    assert text.isascii()
    assert "x error / sigma (ground truth)" in text
    assert "2.11 -> 0.060 m" in text
    assert "<---" in text


def test_commands_in_diagnosis_contain_log_path_as_typed() -> None:
    note = Note("x", "Text of aisle_uwb.ulg.", "Check it (px4fuse sync aisle_uwb.ulg).")
    card = replace(SMALL_SIGMA_A, notes=(note,), do_this=("Run px4fuse tune aisle_uwb.ulg.",))
    typed = with_typed_path(card, "my logs/aisle_uwb.ulg")
    shell, ekf2 = typed.causes[0].actions
    assert shell.commands == ("px4fuse compare 'my logs/aisle_uwb.ulg' --sigma-a 0.363",)
    assert ekf2 == card.causes[0].actions[1]
    assert typed.do_this == ("Run px4fuse tune 'my logs/aisle_uwb.ulg'.",)
    assert typed.notes[0].action == "Check it (px4fuse sync 'my logs/aisle_uwb.ulg')."
    assert typed.notes[0].text == "Text of aisle_uwb.ulg."
