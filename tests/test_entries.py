"""One grade per student: counting attempt, deduction if late, overrides by the instructor."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from class_tools import graded_report
from exchange import replace

from px4fuse.classroom.assignment.roster import Person
from px4fuse.classroom.grading.class_page import _make_points_input_boxes
from px4fuse.classroom.grading.entries import (
    Course,
    add_time_zone,
    build_grades,
    parse_due_time,
    parse_late_rule,
    parse_moodle_time,
    read_overrides,
)
from px4fuse.classroom.grading.model import GradeOverride
from px4fuse.classroom.grading.outputs import feedback_text
from px4fuse.classroom.grading.rubric import read_rubric
from px4fuse.classroom.grading.submissions import parse_submission_path
from px4fuse.errors import SettingsError
from px4fuse.results.answer_form import Answers, NamedFault
from px4fuse.verification.model import Verification

DUE = parse_due_time("2026-11-20 12:00:00 +01:00")
RUBRIC = read_rubric(None)
LATEST = Course(RUBRIC)
PEOPLE = (Person("1", "Ada Lovelace", login="ada"), Person("2", "Grace Hopper", login="grace"))


def make_grades(files, term=LATEST, overrides=None, people=PEOPLE):
    """Make the grades of reports, given by file name."""
    reports = [
        replace(one, submission=name, sha256=name, origin=parse_submission_path(name))
        for name, one in files.items()
    ]
    return build_grades(reports, replace(term, roster=people), overrides or {})


def blackboard(login: str, stamp: str, name: str = "r.pdf") -> str:
    return f"Lab_{login}_attempt_2026-11-{stamp}_{name}"


THREE = {
    blackboard("ada", "19-10-00-00"): graded_report("", 4.0),
    blackboard("ada", "20-11-00-00"): graded_report("", 9.0),
    blackboard("ada", "22-10-00-00"): graded_report("", 7.0),
}


@pytest.mark.parametrize(("attempt", "points"), [("latest", 7.0), ("first", 4.0), ("best", 9.0)])
def test_grade_attempt_option_selects_the_report_that_counts(attempt, points) -> None:
    (ada, grace), _ = make_grades(THREE, Course(RUBRIC, attempt=attempt))
    assert ada.counted_report.points == ada.total == points
    assert len(ada.other_reports) == 2
    assert ada.counted_report not in ada.other_reports
    assert (grace.counted_report, grace.total, grace.max_points) == (None, None, 10.0)


def test_grade_of_late_report_has_points_deducted() -> None:
    term = Course(RUBRIC, due=DUE, late_rule=parse_late_rule("10%/day"))
    (ada, _), _ = make_grades(THREE, term)
    assert (ada.lateness_s, ada.deducted_points, ada.total) == (46 * 3600.0, 2.0, 5.0)
    assert ada.submission_time == "2026-11-22 10:00"
    # the best attempt is the one after deduction
    files = {blackboard("ada", "20-11-00-00"): graded_report("", 6.0),
             blackboard("ada", "22-10-00-00"): graded_report("", 7.0)}  # fmt: skip
    (ada, _), _ = make_grades(files, replace(term, attempt="best"))
    assert (ada.lateness_s, ada.deducted_points, ada.total) == (0.0, 0.0, 6.0)


@pytest.mark.parametrize(
    ("due", "rule", "lateness_s", "off"),
    [
        (DUE, "100%/day", 46 * 3600.0, 10.0),  # points are never negative
        # end of summer time: on 25 October the hour from 2 to 3 occurs twice
        (
            parse_due_time("2026-10-24 23:00:00 Europe/Berlin"),
            "1%/hour",
            683 * 3600.0 + 3600.0,
            10.0,
        ),
    ],
)
def test_grade_of_very_late_report_is_not_below_zero(due, rule, lateness_s, off) -> None:
    (ada, _), _ = make_grades(THREE, Course(RUBRIC, due=due, late_rule=parse_late_rule(rule)))
    assert (ada.lateness_s, ada.deducted_points) == (lateness_s, off)
    assert ada.total == 0.0


def test_grade_without_submission_time_has_no_late_deduction() -> None:
    files = {
        "hoppergrace_7_9_a.pdf": graded_report("", 7.0),
        "hoppergrace_7_8_b.pdf": graded_report("", 9.0),
    }
    term = Course(RUBRIC, due=DUE, late_rule=parse_late_rule("10%/day"))
    (_, grace), notes = make_grades(files, term)
    assert (grace.total, grace.lateness_s, grace.submission_time) == (9.0, None, "")
    assert "time is unknown for 1 of 1 students" in notes[0]
    # a late mark without a time has no deduction either
    (_, grace), _ = make_grades({"hoppergrace_LATE_7_8_r.pdf": graded_report("", 7.0)}, term)
    assert (grace.lateness_s, grace.total) == (None, 7.0)
    assert "Canvas marks the file as late" in grace.flags[0]


@pytest.mark.parametrize(
    ("extension", "grace_period_s", "lateness_s"),
    [
        ("", 0.0, 46 * 3600.0),
        ("2026-11-22 09:00", 0.0, 3541.0),
        ("2026-11-22 09:00", 3600.0, 0.0),
        ("2026-11-22", 0.0, 0.0),
    ],
)
def test_due_date_extension_and_grace_period_reduce_lateness(
    extension, grace_period_s, lateness_s
) -> None:
    term = Course(
        RUBRIC, due=DUE, grace_period_s=grace_period_s, late_rule=parse_late_rule("10%/day")
    )
    people = (replace(PEOPLE[0], extended_due=extension), *PEOPLE[1:])
    (ada, _), _ = make_grades(THREE, term, people=people)
    assert (ada.lateness_s, ada.deducted_points > 0.0) == (lateness_s, lateness_s > 0.0)


def test_invalid_due_date_extension_error_names_the_student() -> None:
    people = (replace(PEOPLE[0], extended_due="two days"), *PEOPLE[1:])
    with pytest.raises(SettingsError, match=r"extension of .*'two days' is not a valid time"):
        make_grades(THREE, Course(RUBRIC, due=DUE), people=people)


def test_grade_ignores_other_file_submitted_beside_a_report() -> None:
    essay = replace(
        graded_report("", 0.0),
        version="",
        verification=Verification("cannot verify", ("x",), False),
    )
    files = {blackboard("ada", "19-10-00-00"): graded_report("", 4.0),
             blackboard("ada", "20-10-00-00"): essay}  # fmt: skip
    (ada, _), _ = make_grades(files)
    assert ada.total == 4.0
    assert "it is not a report" in ada.flags[0]
    (ada, _), _ = make_grades({blackboard("ada", "20-10-00-00"): essay})
    assert ada.total == 0.0


def of_form(points: float, kind: str, **more):
    form = Answers(log_sha256="a" * 64, mistakes=(NamedFault(kind),))
    return replace(graded_report("", points, student_id="1"), form=form, **more)


def test_grade_with_two_different_answer_forms_is_pending() -> None:
    """None of the files submitted together counts until the instructor selects one."""
    files = {"a.pdf": of_form(4.0, "yaw"), "b.pdf": of_form(9.0, "nlos")}
    (ada, _), _ = make_grades(files)
    assert ada.total is None
    assert (
        ada.counted_report.instructor_action
        == "The student handed in 2 reports with different answer forms. Ask the student which "
        "report counts."
    )
    assert len(ada.other_reports) == 1
    assert make_grades(files, Course(RUBRIC, attempt="best"))[0][0].total == 9.0
    # equal forms are not pending
    (ada, _), _ = make_grades({name: of_form(4.0, "yaw") for name in files})
    assert ada.total == 4.0


def test_grade_keeps_first_report_if_later_one_needs_review() -> None:
    """For example a later report of another student with this student's id."""
    files = {
        "a.pdf": of_form(9.0, "yaw"),
        "z.pdf": of_form(2.0, "nlos", instructor_action="Ask whose."),
    }
    (ada, _), _ = make_grades(files)
    assert ada.total == 9.0
    assert [one.submission for one in ada.other_reports] == ["z.pdf"]
    assert ada.flags == ("The file z.pdf does not count for the grade: it is pending.",)
    waiting = replace(
        files["a.pdf"].items[0], is_awaiting_points=True
    )  # waits for the points of the notes
    files["a.pdf"] = replace(files["a.pdf"], items=(waiting,))
    (ada, _), _ = make_grades(files)
    assert ada.counted_report.submission == "a.pdf"


def test_student_file_name_that_imitates_blackboard_is_flagged() -> None:
    name = blackboard("ada", "20-10-00-00", "ada_attempt_2026-11-18-10-00-00_r.pdf")
    (ada, _), _ = make_grades({name: graded_report("", 4.0)})
    assert ada.submission_time == "2026-11-20 10:00"
    assert ada.flags == (
        "The student chose a file name that only learning platforms give. "
        "Check who handed in the file.",
    )


def test_grade_with_several_reports_in_attempt_uses_best() -> None:
    files = {blackboard("ada", "19-10-00-00", "a.pdf"): graded_report("", 8.0),
             blackboard("ada", "19-10-00-00", "b.pdf"): graded_report("", 2.0)}  # fmt: skip
    for attempt in ("first", "latest", "best"):
        (ada, _), _ = make_grades(files, Course(RUBRIC, attempt=attempt))
        assert ada.total == 8.0, attempt


def test_learning_platform_id_overrides_id_in_report() -> None:
    files = {
        blackboard("grace", "19-10-00-00"): graded_report("", 8.0, student="Ada", student_id="1")
    }
    (ada, grace), _ = make_grades(files)
    assert ada.counted_report is None
    assert grace.total == 8.0
    assert "is that of 1 (Ada Lovelace)" in grace.flags[0]


def test_student_missing_in_class_list_is_flagged() -> None:
    files = {
        "report.pdf": graded_report("", 8.0, student="Mallory", student_id="9"),
        "other.pdf": graded_report("", 3.0, student="lovelace ADA"),
    }
    (ada, grace, stranger), _ = make_grades(files)
    assert (ada.total, grace.total) == (3.0, None)
    assert (stranger.student, stranger.student_id, stranger.total) == ("Mallory", "9", 8.0)
    assert stranger.flags[0] == "The student is not in the class list."


def test_grades_without_class_list_have_one_row_per_student() -> None:
    files = {
        "Doe Jane_5_assignsubmission_file_/a.pdf": graded_report(
            "", 1.0, student="Jane", student_id="42"
        ),
        "Roe Max_6_assignsubmission_file_/a.pdf": graded_report(
            "", 2.0, student="Jane", student_id="42"
        ),
        "b.pdf": graded_report("", 3.0, student="Kim", student_id="44"),
        "c.pdf": graded_report("", 4.0, student="Kim", student_id="44"),
        "d.pdf": graded_report("", 5.0),
    }
    grades, _ = make_grades(files, people=())
    assert [(one.student, one.student_id, one.total) for one in grades] == [
        ("Jane", "42", 1.0), ("Roe Max", "6", 2.0), ("Kim", "44", 4.0), ("", "", 5.0)
    ]  # fmt: skip


# ------------------------------------------------------------------ overrides


def write_overrides(tmp_path: Path, *rows: str, head: str = "id,item,points,comment"):
    path = tmp_path / "overrides.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return read_overrides(path)


TWO_OF_ONE = {"1.pdf": graded_report("", 4.0, 6.0, student_id="1")}
TWO = {
    "1.pdf": graded_report("", 4.0, 6.0, student_id="1"),
    "2.pdf": graded_report("", 1.0, student_id="2"),
}


def test_instructor_overrides_replace_points_and_add_comments(tmp_path) -> None:
    rows = write_overrides(
        tmp_path, "1,a,9.5,A good idea.", '01,,,"Come and', 'see me."', "1,total,8,Agreed.",
        "2,total,3,", "3,total,1,", "1,C,1,", '2,B,2,"x"',
    )  # fmt: skip
    (ada, grace), notes = make_grades(TWO, overrides=rows)
    assert ada.overrides == {
        "A": GradeOverride(9.5, "A good idea."), "total": GradeOverride(8.0, "Agreed."),
        "": GradeOverride(None, "Come and\nsee me."),
    }  # fmt: skip
    assert (ada.counted_report.points, ada.total, grace.total) == (15.5, 8.0, 3.0)
    told = (
        "student 1 has no rubric item 'C'",
        "student 2 has no rubric item 'B'",
        "no student has the id 3",
    )
    assert notes == tuple(f"overrides.csv: {one}." for one in told)
    text, reason = feedback_text(ada, "Lab"), "Because. Your instructor: A good idea."
    assert f"9.5 of 10  A\n    {reason} (Your instructor gave 9.5" in text
    end = "Total    8 of 20\n\nFrom your instructor:\n\nCome and\nsee me.\nAgreed.\n"
    assert text.endswith(end)


@pytest.mark.parametrize(
    ("rows", "points", "told"),
    [
        (("1,A,95,A slip.", "1,total,200,"), (10.0, 10.0), (
            "points of student 1 are above the maximum, 10 points of 'A'",
            "points of student 1 are above the maximum, 20 points of 'total'",
        )),
        (("1,A,9,", "1,a,2,", "01,total,12,", "1,Total,3,"), (15.0, 3.0), (
            "student 1 has two rows for 'A'", "student 01 has two rows for 'total'",
        )),
    ], ids=["points above the maximum", "duplicate row"],
)  # fmt: skip
def test_instructor_override_above_maximum_points_gives_a_note(
    rows, points, told, tmp_path
) -> None:
    (ada, _), notes = make_grades(TWO, overrides=write_overrides(tmp_path, *rows))
    assert (ada.counted_report.points, ada.total) == points
    assert notes == tuple(f"overrides.csv: {one}." for one in told)


def test_grades_download_includes_students_without_report(tmp_path) -> None:
    """Includes students without a submission, because the download replaces the file."""
    rows = write_overrides(
        tmp_path, "1,A,9.5,Good.", "1,,,Come.", "1,total,8,Agreed.", "2,total,5,Shown."
    )
    grades, notes = make_grades({"1.pdf": TWO["1.pdf"]}, overrides=rows)
    again: dict[str, dict[str, GradeOverride]] = {}
    for _, _, owner, boxes, kept in map(_make_points_input_boxes, grades):
        for item, points, comment in (*((a, c, d) for a, _, c, d in boxes), *kept):
            if points is not None or comment:
                again.setdefault(owner, {})[item] = GradeOverride(points, comment)
    assert (again, notes) == (rows, ())


def test_instructor_total_points_clear_pending_status(tmp_path) -> None:
    files = {"1.pdf": graded_report("", 4.0, student_id="1", instructor_action="Run 0.1.1.")}
    (ada, _), _ = make_grades(files, overrides=write_overrides(tmp_path, "1,A,9,"))
    assert ada.total is None
    (ada, _), _ = make_grades(files, overrides=write_overrides(tmp_path, "1,total,9,"))
    assert ada.total == 9.0


def test_instructor_override_without_submission_gives_points(tmp_path) -> None:
    (_, grace), notes = make_grades(
        {}, overrides=write_overrides(tmp_path, "2,Total,5,Shown in class.")
    )
    assert (grace.total, notes) == (5.0, ())
    assert "Shown in class." in feedback_text(grace)
    (_, grace), notes = make_grades(TWO_OF_ONE, overrides=write_overrides(tmp_path, "2,total,50,"))
    assert (grace.total, len(notes)) == (None, 1)


def test_instructor_overrides_csv_accepts_decimal_commas(tmp_path) -> None:
    rows = write_overrides(tmp_path, "1;A;7,5;", head="\ufeffid;item;points;comment")
    assert rows == {"1": {"A": GradeOverride(7.5)}}


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1,A,abc,", "row 2: the points must be a number of 0 or more, not 'abc'"),
        ("1,A,-1,", "must be a number of 0 or more"),
        ("1,A,nan,", "must be a number of 0 or more"),
        ("1,A,1_5,", "must be a number of 0 or more"),
        ("1,,5,", "the row has points but no item: write a rubric title or 'total' as item"),
        ("1,A,5,\n1,A,6,", "student 1 has two rows for the item A"),
    ],
)
def test_instructor_overrides_csv_invalid_row_raises_error(tmp_path, row, says) -> None:
    with pytest.raises(SettingsError, match=says):
        write_overrides(tmp_path, row)
    with pytest.raises(SettingsError, match="no column comment"):
        write_overrides(tmp_path, row, head="id,item,points")


# ------------------------------------------------------------------ due times and late rules


BERLIN = "2026-11-20T23:59:59+01:00"


@pytest.mark.parametrize(
    ("text", "is_"),
    [
        ("2026-11-20 23:59 +01:00", BERLIN),
        ("2026-11-20 23:59 Europe/Berlin", BERLIN),
        ("2026-11-20 22:59:59 +0000", BERLIN),
        ("2026-11-20T22:59Z", BERLIN),
        ("2026-07-20 23:59 Europe/Berlin", "2026-07-20T23:59:59+02:00"),  # summer time
        ("2026-11-20 Europe/Berlin", BERLIN),
        ("20261120T2359+0100", BERLIN),
        ("2026-11-20 1200 Europe/Berlin", "2026-11-20T12:00:59+01:00"),
    ],
)
def test_due_time_with_time_zone_is_parsed(text, is_) -> None:
    assert parse_due_time(text) == datetime.fromisoformat(is_)


def test_due_time_without_time_zone_uses_local_time_zone(monkeypatch) -> None:
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    try:
        assert parse_due_time("2026-11-20 23:59") == datetime(2026, 11, 21, 4, 59, 59, tzinfo=UTC)
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize(
    ("read", "said", "texts"),
    [(parse_due_time, "--due", ("", "tomorrow", "20.11.2026", "2026-11-20 23:59 Mars/Base", "Z")),
     (parse_late_rule, "--late", ("", "10", "10%", "-1%/day", "110%/day", "10%/week", "x%/day",
                                 "1 0%/day"))],
)  # fmt: skip
def test_invalid_due_time_or_late_rule_raises_one_line_error(read, said, texts) -> None:
    for text in texts:
        with pytest.raises(SettingsError, match=said) as caught:
            read(text)
        assert "\n" not in str(caught.value)


def test_late_rule_deducts_points_per_started_day_up_to_limit() -> None:
    for lateness_s, off in ((0.0, 0), (1.0, 12), (86_400.0, 12), (86_400.5, 24), (1e9, 120)):
        assert parse_late_rule("10%/day").compute_deduction(lateness_s, 120.0) == off
    # a rule may state a limit, and hours
    assert parse_late_rule("1 % / hour up to 5%").compute_deduction(3600.0 * 3.5, 100.0) == 4.0
    assert parse_late_rule("1%/hour up to 5%").compute_deduction(1e6, 100.0) == 5.0


def test_submission_time_without_zone_uses_zone_of_due_time() -> None:
    due = parse_due_time("2026-11-20 23:59:00 +05:30")
    bare = datetime(2026, 11, 21, 0, 59)
    assert (add_time_zone(bare, due.tzinfo) - due).total_seconds() == 3600.0
    told = datetime(2026, 11, 20, 18, 29, tzinfo=timezone(timedelta(0)))
    assert add_time_zone(told, due.tzinfo) == due


@pytest.mark.parametrize(
    "text",
    [
        "Friday, 20 November 2026, 23:58",
        "Friday, 20 November 2026, 11:58 PM",
        "Freitag, 20. November 2026, 23:58",
        "2026-11-20 23:58",
    ],
)
def test_parse_moodle_time_accepts_english_german_and_iso_dates(text: str) -> None:
    assert parse_moodle_time(text) == datetime(2026, 11, 20, 23, 58)


def test_overrides_csv_unquoted_comma_error_names_row(tmp_path: Path) -> None:
    path = tmp_path / "overrides.csv"
    path.write_text("id,item,points,comment\n0001,,,Good, but late\n", encoding="utf-8")
    with pytest.raises(SettingsError, match="row 2 has more cells than the header"):
        read_overrides(path)
