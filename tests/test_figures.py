"""Figures of an assignment: questions, right answers and pictures."""

from __future__ import annotations

from functools import partial

import pytest

from px4fuse.classroom.assignment import figures
from px4fuse.classroom.assignment.figures import (
    FIGURE_ANSWERS_BY_FAULT,
    QUESTIONS,
    draw_figures,
    make_choice_questions,
)
from px4fuse.classroom.assignment.random_assignment import draw_uniform
from px4fuse.results.answer_form import (
    CHOICE_LETTERS,
    MAX_CHOICES,
    MAX_FORM_BYTES,
    format_answer_form,
)


def test_correct_answers_on_one_figure_describe_one_fault() -> None:
    for number in range(20):
        choices = make_choice_questions(partial(draw_uniform, b"secret", f"s{number}", "aisle"))
        assert len(choices) == len(QUESTIONS) * figures.FIGURE_COUNT <= MAX_CHOICES
        for first in range(0, len(choices), len(QUESTIONS)):
            rows = zip(choices[first:], QUESTIONS, strict=False)
            right = [(choice.answer_text(letter), field) for (choice, letter), field in rows]
            fault = next(
                each for each in FIGURE_ANSWERS_BY_FAULT.values() if each["fault"] == right[0][0]
            )
            assert all(fault[field] == text for text, field in right)
        form = format_answer_form("s.ulg", "0" * 64, [choice for choice, _ in choices])
        assert len(form.encode()) < MAX_FORM_BYTES


def test_each_multiple_choice_letter_is_correct_equally_often() -> None:
    draws = [partial(draw_uniform, b"secret", f"s{number}", "aisle") for number in range(200)]
    letters = [
        letter for random_number in draws for _, letter in make_choice_questions(random_number)
    ]
    for name in CHOICE_LETTERS:
        assert letters.count(name) / len(letters) == pytest.approx(0.2, abs=0.03)


def test_answers_to_plot_questions_differ_between_faults() -> None:
    for field in QUESTIONS:
        assert len({fault[field] for fault in FIGURE_ANSWERS_BY_FAULT.values()}) == len(
            FIGURE_ANSWERS_BY_FAULT
        )


@pytest.mark.slow
def test_same_student_always_gets_the_same_plots(monkeypatch) -> None:
    monkeypatch.setattr(figures, "FIGURE_COUNT", 1)
    random_number = partial(draw_uniform, b"secret", "s1", "aisle")
    content = draw_figures(random_number)
    assert content.startswith(b"\x89PNG")
    assert content == draw_figures(random_number)
    assert content != draw_figures(partial(draw_uniform, b"secret", "s2", "aisle"))
