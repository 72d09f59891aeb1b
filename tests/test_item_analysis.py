"""Item analysis of a class, and questions for an oral examination."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from class_tools import grade, graded_report

from px4fuse.classroom.assignment.key import (
    AnswerKey,
    CorrectAnswers,
    CorrectFormAnswers,
    CorrectVerdict,
    InjectedFault,
)
from px4fuse.classroom.grading.class_page import analyse_items
from px4fuse.classroom.grading.model import ItemScore
from px4fuse.classroom.grading.oral_check import ask_about_form, format_questions
from px4fuse.results.answer_form import Answers, Choice, NamedFault

POINTS = np.array([[9, 2, 1], [8, 4, 9], [5, 6, 3], [2, 8, 8], [1, 9, 2]], dtype=float)
REPORTS = [graded_report(f"{n}.pdf", *row) for n, row in enumerate(POINTS.tolist())]
TRUTH = CorrectFormAnswers(
    (InjectedFault("nlos", 10.0, 8.5, 11.5), InjectedFault("yaw", 20.0, 17.0, 23.0)),
    0.1,
    CorrectVerdict("overconfident", 2.0),
    CorrectVerdict("consistent"),
    ("normal",),
    (),
    (1.0, 2.0, 3.0),
    ((Choice("Figure 1: injected fault", ("yaw", "gap", "delay", "gate", "jump")), "c"),),
)
FORM = Answers(
    log_sha256="a" * 64,
    mistakes=(NamedFault("nlos"), NamedFault("dropout")),
    verdict_kf="consistent",
    choices=("a",),
)


def test_item_discrimination_is_correlation_with_other_items() -> None:
    for index, item in enumerate(analyse_items(REPORTS)):
        others = POINTS.sum(axis=1) - POINTS[:, index]
        expected = np.corrcoef(POINTS[:, index], others)[0, 1]
        assert item.discrimination == pytest.approx(expected)
        assert (item.mean_points, item.max_points) == (POINTS[:, index].mean(), 10.0)


def test_four_reports_are_too_few_for_rubric_item_correlation() -> None:
    assert [item.discrimination for item in analyse_items(REPORTS[:4])] == [None] * 3


def test_class_statistics_list_answer_form_parts_and_faults() -> None:
    reports = [
        replace(
            each,
            form_part_scores=(ItemScore("sizes", n, 15.0, ""),),
            did_student_name_fault={"nlos": n > 1},
        )
        for n, each in enumerate(REPORTS)
    ]
    *_, sizes, fault = analyse_items(reports)
    assert (sizes.title, fault.title) == ("Answer form: sizes", "Fault: nlos")
    assert (fault.mean_points, fault.max_points) == (0.6, 1.0)


def test_class_statistics_exclude_items_not_yet_graded() -> None:
    text = ItemScore("Text", 0.0, 20.0, "", True, True)
    reports = [replace(each, items=(*each.items, text)) for each in REPORTS]
    assert [item.title for item in analyse_items(reports)] == ["A", "B", "C"]


def test_class_statistics_exclude_reports_pending_review() -> None:
    reports = [replace(each, instructor_action="Decide.") for each in REPORTS]
    assert analyse_items(reports) == []


def test_oral_exam_asks_first_about_wrong_and_missed_faults() -> None:
    questions = [*ask_about_form(FORM, TRUTH)]
    assert "You named dropout" in questions[0][0]
    assert "nlos, yaw" in questions[0][1]
    assert "You named nlos" in questions[1][0]
    assert "accepted fault size 8.5 to 11.5 %" in questions[1][1]
    assert "Your flight also has this fault" in questions[2][0]
    assert "Your answer: yaw" in questions[3][0]
    assert "Right: delay" in questions[3][1]
    assert len(questions) == 4


def test_oral_exam_page_lists_n_questions_per_student() -> None:
    key = AnswerKey("aisle", (CorrectAnswers("s1", "Ada", "s1.ulg", "a" * 64, form=TRUTH),))
    report = graded_report("r.pdf", 5.0, form=FORM, log_sha256="a" * 64)
    rows = (replace(grade("s1", "Ada", 5.0), counted_report=report), grade("s2", "Max", None))
    text = format_questions(rows, key, 2)
    assert text.count("Expected:") == 2
    assert "Ada s1" in text
    assert "Max" not in text
