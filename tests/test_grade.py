"""Grading of a class: outputs, repeated runs, and malicious files."""

from __future__ import annotations

import csv
import io
import json
import shutil
import zipfile
from pathlib import Path
from unittest.mock import Mock

import pytest
from class_tools import in_this_process
from cli_tools import error_line, run, run_checked
from conftest import LOG, REPORT, REPORT_PAGES
from forgery import forged, with_results
from pypdf import PdfReader, PdfWriter

from px4fuse.classroom.assignment.key import AnswerKey, CorrectAnswers
from px4fuse.classroom.assignment.roster import make_file_names
from px4fuse.classroom.grading.entries import Course, parse_late_rule
from px4fuse.classroom.grading.grade import GradeOutcome, grade
from px4fuse.classroom.grading.model import Grade, GradedReport
from px4fuse.classroom.grading.rubric import read_rubric
from px4fuse.classroom.terminal import grading_page
from px4fuse.cli.outputs import Interrupted
from px4fuse.core.reading import hash_files
from px4fuse.core.workers import JobFailure
from px4fuse.verification import pages
from px4fuse.verification.model import Verification

pytestmark = pytest.mark.usefixtures("cached_analyses")

UNKNOWN = Verification("cannot verify", (), with_log=False)


@pytest.fixture
def jobs_in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    in_this_process(monkeypatch)


@pytest.fixture
def submitted(tmp_path: Path) -> Path:
    """Export folder of a learning platform: a report twice, and invalid files."""
    folder = tmp_path / "handed in"
    for name in ("Lovelace Ada_1_assignsubmission_file_", "Hopper Grace_2_assignsubmission_file_"):
        (folder / name).mkdir(parents=True)
        shutil.copy(REPORT, folder / name / "report.pdf")
    (folder / "essay.pdf").write_bytes(b"%PDF-1.7\nnot one")
    (folder / "=cmd|'calc'!A0.pdf").write_bytes(b"MZ this is no PDF")
    locked = PdfWriter(clone_from=io.BytesIO(REPORT.read_bytes()))
    locked.encrypt("secret")
    with (folder / "locked.pdf").open("wb") as file:
        locked.write(file)
    with zipfile.ZipFile(tmp_path / "more.zip", "w") as archive:
        archive.write(REPORT, "../../escaped/<img src=x onerror=alert(1)>.pdf")
    return folder


def test_grade_table_lists_every_submitted_file(submitted, tmp_path) -> None:
    output = tmp_path / "class"
    before = {path for path in tmp_path.rglob("*") if not path.is_relative_to(output)}
    outcome = grade(
        [submitted, tmp_path / "more.zip"], Course(read_rubric(None)), output, processes=1
    )
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(output)} == before
    assert len(outcome.reports) == 6
    text = (output / "class.csv").read_text(encoding="utf-8-sig")
    table = list(csv.DictReader(io.StringIO(text)))
    assert len(table) == 6
    assert {row["status"] for row in table} == {"cannot verify"}  # no log was given
    scored = [row for row in table if float(row["pending points"] or 0) > 0]
    assert len(scored) == 3
    assert all(row["points"] == row["total"] == "" and "--logs" in row["pending"] for row in scored)
    assert all("the same" in row["flags"].lower() for row in scored)
    refused_files = {row["file"]: row["reasons"] for row in table if row["points"] == "0"}
    assert len(refused_files) == 3
    assert any("encrypted" in reason for reason in refused_files.values())
    assert not any(row["file"].startswith(("=", "+", "-", "@")) for row in table)
    page = (output / "class.html").read_text(encoding="utf-8")
    assert "<img src=x" not in page
    assert "<title>Lab: fusion and loop closure</title>" in page  # title of the rubric
    assert len(list((output / "feedback").glob("*.txt"))) == 6


@pytest.mark.usefixtures("jobs_in_process", "cached_pages")
def test_grade_report_that_exceeds_time_limit_is_not_verified(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "a.pdf").write_bytes(
        forged(REPORT.read_bytes(), lambda writer: writer.remove_page(REPORT_PAGES - 1))
    )
    monkeypatch.setattr(
        pages, "run_one_with_limits", lambda *_: JobFailure("it took longer than 10 s.")
    )
    (only,) = grade(
        [folder], Course(read_rubric(None), logs=[LOG.parent]), tmp_path / "class"
    ).reports
    assert only.status == "cannot verify"
    assert only.instructor_action.startswith("Ask the author of the report for the PDF")
    assert any("the PDF pages could not be compared" in flag for flag in only.flags)


@pytest.mark.usefixtures("jobs_in_process", "cached_pages")
def test_grade_verifies_original_report_and_rejects_forgeries(tmp_path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(REPORT, folder / "a.pdf")
    pdf = REPORT.read_bytes()
    results = json.loads(PdfReader(io.BytesIO(pdf)).attachments["results.json"][0])
    results["axes"]["north"]["filters"]["kf"]["nis_mean"] = 1.0
    (folder / "b.pdf").write_bytes(forged(pdf, with_results(json.dumps(results))))
    (folder / "c.pdf").write_bytes(forged(pdf, lambda writer: writer.remove_page(REPORT_PAGES - 1)))
    output = tmp_path / "class"
    outcome = grade([folder], Course(read_rubric(None), logs=[LOG.parent]), output, processes=2)
    first, second, third = outcome.reports
    assert first.verification.status == "verified"
    assert first.verification.with_log
    assert first.numbers["SIGMA_Z (m)"] == 0.1
    assert second.verification.status == "numbers differ"
    assert second.points == 0.0
    assert any("nis_mean" in difference.path for difference in second.verification.differences)
    # each report is redrawn from the log
    redrawn = [path.read_bytes() for path in (output / "reports").glob("*.pdf")]
    assert len(redrawn) == 3
    assert len(set(redrawn)) == 1
    assert len(PdfReader(io.BytesIO(redrawn[0])).pages) == REPORT_PAGES
    page = (output / "class.html").read_text(encoding="utf-8")
    assert all(f"reports/{name}.pdf" in page for name in ("a", "b", "c"))
    # a missing page is flagged and costs no points
    assert (third.verification.status, third.verification.outcome) == ("verified", "page differs")
    assert third.status == "page differs"
    assert third.points == first.points
    assert any(f"Page {REPORT_PAGES}: the PDF has" in flag for flag in third.flags)
    assert first.flags == ()
    # a second run reuses all results
    again = grade([folder], Course(read_rubric(None), logs=[LOG.parent]), output, processes=2)
    assert again.reused_count == 3
    assert again.reports == outcome.reports


@pytest.mark.usefixtures("jobs_in_process")
def test_grade_second_run_processes_only_changed_files(submitted, tmp_path) -> None:
    output = tmp_path / "class"

    def reused(title: str = "") -> int:
        return grade(
            [submitted, tmp_path / "more.zip"],
            Course(read_rubric(None), title=title),
            output,
            processes=2,
        ).reused_count

    assert reused() == 2  # there are three copies of one report
    assert reused("Lab 4") == 3  # other files are read again
    assert b"<title>Lab 4</title>" in (output / "class.html").read_bytes()
    # cached results are found by content, not by name
    (submitted / "essay.pdf").write_bytes(REPORT.read_bytes())
    assert reused() == 4
    (submitted / "essay.pdf").write_bytes(b"%PDF-1.7\nanother one")
    assert reused() == 3
    for record in (output / "records").glob("*.json"):
        record.write_text('{"rests_on": {"verdict": 3}}')
    assert reused() == 2
    (output / "overrides (1).csv").write_text("id,item,points,comment\n")
    again = grade([submitted, tmp_path / "more.zip"], Course(read_rubric(None)), output)
    assert "overrides (1).csv was ignored: px4fuse reads only overrides.csv." in again.notes


@pytest.mark.usefixtures("jobs_in_process", "cached_pages")
def test_grade_with_changed_logs_does_not_reuse_verification(tmp_path) -> None:
    (tmp_path / "in").mkdir()
    shutil.copy(REPORT, tmp_path / "in" / "a.pdf")
    said = []
    for logs in ([], [LOG], [LOG], []):
        outcome = grade(
            [tmp_path / "in"], Course(read_rubric(None), logs=logs), tmp_path / "out", processes=1
        )
        said.append((outcome.reports[0].verification.status, outcome.reused_count))
        # only the redrawn report of this run
        assert len([*(tmp_path / "out" / "records").glob("*.p*")]) == len(logs)
    assert said == [
        ("cannot verify", 0), ("verified", 0), ("verified", 1), ("cannot verify", 0)
    ]  # fmt: skip


@pytest.mark.usefixtures("jobs_in_process")
def test_points_of_report_are_pending_if_its_log_is_not_given(tmp_path) -> None:
    (tmp_path / "in").mkdir()
    shutil.copy(REPORT, tmp_path / "in")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "another.ulg").write_bytes(b"x")
    (sha256,) = hash_files([LOG])
    rubric, logs = read_rubric(None), [tmp_path / "logs"]
    for given, status in ((sha256, "cannot verify"), ("0" * 64, "other log")):
        key = AnswerKey("aisle", (CorrectAnswers("1", "Ada", "1.ulg", given),))
        outcome = grade([tmp_path / "in"], Course(rubric, key, logs), tmp_path / "out", processes=1)
        (one,) = outcome.reports
        assert one.verification.status == status
        assert one.points > 0
        assert one.counted_points is None
        assert "aisle_uwb.ulg" in one.instructor_action


@pytest.mark.usefixtures("jobs_in_process")
def test_interrupted_grade_command_prints_how_to_continue(tmp_path, monkeypatch) -> None:
    import px4fuse.classroom.grading.grade as module

    one = GradedReport("a.pdf", "Ada\nPoints 120\n" + "A" * 100_000, "1", UNKNOWN)
    grade = Grade(one.student, one.student_id, one)
    monkeypatch.chdir(tmp_path)
    shutil.copy(REPORT, "a.pdf")
    monkeypatch.setattr(module, "grade", lambda *_, **__: GradeOutcome((grade,), (), 0, ()))
    said = run_checked("grade", "a.pdf", "-o", "out").output
    assert len(said) < 3000
    assert not any(line.lstrip().startswith("Points 120") for line in said.splitlines())
    monkeypatch.setattr(module, "grade", Mock(side_effect=KeyboardInterrupt))
    assert "nothing was written" in str(run("grade", "a.pdf", "-o", "out").exception)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "class.csv").touch()
    result = run("grade", "a.pdf", "-o", "out")
    assert isinstance(result.exception, Interrupted)
    assert result.exception.exit_code == 130
    assert "out contains the results so far" in str(result.exception)
    assert "Run the same command to continue." in str(result.exception)


def test_grade_output_file_names_are_safe_and_unique() -> None:
    assert make_file_names(["12345", "12345", "../../etc/passwd", "CON", "", "日本"]) == [
        "12345", "12345-2", "_.._etc_passwd", "_CON", "report", "日本"
    ]  # fmt: skip


def test_grade_command_applies_all_course_options(tmp_path, monkeypatch) -> None:
    import px4fuse.classroom.grading.grade as module

    noted = Mock(return_value=GradeOutcome((), (), 0, ()))
    monkeypatch.setattr(module, "grade", noted)
    monkeypatch.chdir(tmp_path)
    shutil.copy(REPORT, "a.pdf")
    Path("sheet.csv").write_text("id,Grade\n0042,\n")
    words = (
        "grade a.pdf -o out --roster sheet.csv --worksheet sheet.csv --column Grade --attempt best "
        "--late 5%/hour --anonymous --title Lab --jobs 3 --due"
    )
    run_checked(*words.split(), "2026-11-20 23:59 +01:00")
    course, processes = noted.call_args.args[1], noted.call_args.kwargs["processes"]
    assert (course.title, processes) == ("Lab", 3)
    assert [person.student_id for person in course.roster] == ["0042"]
    assert course.worksheets[0].column_titles == ("id", "Grade")
    assert (course.grade_column_title, course.anonymous, course.attempt) == ("Grade", True, "best")
    assert course.due.isoformat() == "2026-11-20T23:59:59+01:00"
    assert (course.late_rule, course.include_pending) == (parse_late_rule("5%/hour"), False)


def test_grade_write_rubric_does_not_overwrite_existing_file(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_checked("grade", "--write-rubric", "lab.toml")
    assert read_rubric(Path("lab.toml")) == read_rubric(None)
    assert "not overwritten" in error_line("grade", "--write-rubric", "lab.toml")


def test_grading_page_counts_students_without_report() -> None:
    unnamed = Grade("", "", Mock(status="verified"), max_points=1.0)
    missing = Grade("Ada", "1", None, max_points=1.0)
    page = grading_page(Mock(grades=(missing, unnamed), reports=(), notes=(), reused_count=0))
    assert any("no submission from 1 student;" in str(block) for block in page.blocks)
