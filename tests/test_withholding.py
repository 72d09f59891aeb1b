"""Assignments: px4fuse withholds its diagnosis from students, and shows it to the instructor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import pytest
from cli_tools import error_line, run, run_checked
from exchange import replace
from form_guesses import right

from px4fuse.classroom.assignment.assignment import simulate_assigned_flight
from px4fuse.classroom.assignment.roster import Person
from px4fuse.classroom.grading.form_points import (
    POINTS_FRACTION_OF_FLIGHT_QUESTIONS,
    compute_form_points,
)
from px4fuse.classroom.grading.grade import load_or_verify
from px4fuse.classroom.grading.rubric import read_rubric, score_report
from px4fuse.core.reading import hash_files
from px4fuse.flight.model import DIAGNOSIS_WITHHELD
from px4fuse.readers.ulog_topics import ULOG_ASSIGNMENT_KEY
from px4fuse.results.answer_form import CHOICE_LETTERS, format_answer_form
from px4fuse.results.contract import ComparisonResults, to_json
from px4fuse.results.reading import read_results
from px4fuse.verification.model import Verification

SECRET = b"a secret for tests"


class Assigned(NamedTuple):
    """Assigned log with an answer form, the student's report, and its results."""

    log: Path
    report: Path
    results: ComparisonResults


@pytest.fixture(scope="module")
def assigned(tmp_path_factory: pytest.TempPathFactory) -> Assigned:
    folder = tmp_path_factory.mktemp("assigned")
    content, answer = simulate_assigned_flight(SECRET, Person("s01"), "aisle", 2)
    log, form, report = (folder / name for name in ("s01.ulg", "s01.toml", "s01.pdf"))
    log.write_bytes(content)
    text = format_answer_form(log.name, answer.sha256)
    form.write_text(text.replace('verdict_kf = ""', 'verdict_kf = "consistent"'))
    run_checked("compare", log, "--answers", form, "-o", report)
    results = read_results(report.with_suffix(".json").read_bytes())
    assert isinstance(results, ComparisonResults)
    return Assigned(log, report, results)


def test_report_on_student_assignment_contains_no_diagnosis(assigned: Assigned) -> None:
    results = assigned.results
    assert results.log.is_assessed is True
    assert (results.findings, results.trials, results.card.causes) == ((), (), ())
    assert results.card.facts == {"Answers": "Consistency of KF: consistent"}
    assert {*results.tuning.values(), results.clock, results.heading, results.loop} == {
        DIAGNOSIS_WITHHELD
    }
    assert results.axes["aisle"].updates.count > 100


@pytest.mark.parametrize(
    "command",
    [
        "tune {log}",
        "sync {log}",
        "whatif {log}",
        "evaluate {log}:ekf2 {log}",
        "compare {log} --clock-offset auto",
    ],
)
def test_diagnosing_commands_on_student_assignment_are_refused(
    assigned: Assigned, command: str
) -> None:
    assert DIAGNOSIS_WITHHELD.reason in error_line(*command.format(log=assigned.log).split())


def test_loop_command_on_student_assignment_hides_diagnosis(
    assigned: Assigned, tmp_path: Path
) -> None:
    run_checked("loop", assigned.log, "--json", tmp_path / "loop.json")
    data = json.loads((tmp_path / "loop.json").read_text(encoding="utf-8"))
    assert data["loop"]["true_end"]["reason"] == DIAGNOSIS_WITHHELD.reason
    assert (data["loop"]["closures"], data["findings"]) == ([], [])


@pytest.mark.slow
def test_grade_gives_instructor_the_diagnosis_of_assigned_flight(
    assigned: Assigned, tmp_path: Path
) -> None:
    logs, pdf = hash_files([assigned.log]), assigned.report.read_bytes()
    assigned_hashes = frozenset(logs)
    results, verdict, _ = load_or_verify(tmp_path, pdf, logs, assigned_hashes)
    assert verdict.status == "verified"
    assert results.findings
    assert [*tmp_path.glob("*.diagnosis.pdf")]
    again, _, is_loaded_from_cache = load_or_verify(tmp_path, pdf, logs, assigned_hashes)
    assert is_loaded_from_cache
    assert to_json(again) == to_json(results)


@pytest.mark.slow
def test_report_on_log_without_its_assignment_key_is_rejected(
    assigned: Assigned, tmp_path: Path
) -> None:
    copy = tmp_path / assigned.log.name
    key = ULOG_ASSIGNMENT_KEY.encode()
    copy.write_bytes(assigned.log.read_bytes().replace(key, b"x" * len(key)))
    run_checked("compare", copy, "-o", tmp_path / "copy.pdf")
    assert json.loads((tmp_path / "copy.json").read_text(encoding="utf-8"))["findings"]
    result = run("verify", tmp_path / "copy.pdf", assigned.log)
    assert result.exit_code != 0
    assert "other log" in result.stdout


def test_answer_form_without_plot_answers_earns_part_of_points() -> None:
    _, answer = simulate_assigned_flight(SECRET, Person("s01"), "aisle", 2)
    assert answer.form is not None
    complete = right(answer.form)
    assert compute_form_points(complete, answer.form).fraction == pytest.approx(1.0)
    copied = replace(complete, choices=())
    assert compute_form_points(copied, answer.form).fraction == pytest.approx(
        POINTS_FRACTION_OF_FLIGHT_QUESTIONS
    )
    for letter in CHOICE_LETTERS:
        guessed = replace(complete, choices=(letter,) * len(answer.form.choices))
        assert compute_form_points(guessed, answer.form).fraction < 0.6


def test_grade_flags_answer_form_of_other_log(assigned: Assigned) -> None:
    student = assigned.results.student
    other = replace(student, answers=replace(student.answers, log_sha256="0" * 64))
    results = replace(assigned.results, student=other)
    report = score_report(results, Verification("verified", (), True), read_rubric(None), None)
    assert report.counted_points is None
    assert "made for another log" in report.pending_actions
    assert report.pending_actions in report.flags
