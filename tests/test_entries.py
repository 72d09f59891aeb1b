"""One row per student: which attempt counts, what being late costs, what the instructor says."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from class_tools import graded
from exchange import replace

from px4fuse.answer_form import Answers, ClaimedMistake
from px4fuse.assignment.roster import Person
from px4fuse.errors import SettingsError
from px4fuse.grading.class_page import _point_boxes
from px4fuse.grading.entries import (
    Course,
    add_time_zone,
    make_entries,
    parse_due_time,
    parse_late_rule,
    parse_moodle_time,
    read_overrides,
)
from px4fuse.grading.model import Override, Submission
from px4fuse.grading.outputs import feedback_text
from px4fuse.grading.rubric import read_rubric
from px4fuse.grading.submissions import parse_origin
from px4fuse.verification.model import Verdict

DUE = parse_due_time("2026-11-20 12:00:00 +01:00")
RUBRIC = read_rubric(None)
LATEST = Course(RUBRIC)
PEOPLE = (Person("1", "Ada Lovelace", login="ada"), Person("2", "Grace Hopper", login="grace"))


def laid_out(files, term=LATEST, overrides=None, people=PEOPLE, packed=None):
    """Entries by id, of reports by the names of their files."""
    reports = [replace(one, submission=name, sha256=name) for name, one in files.items()]
    zipped, times = Path("x.zip"), packed or {}
    found = [Submission(zipped, name, name, times.get(name), parse_origin(name)) for name in files]
    return make_entries(reports, found, replace(term, roster=people), overrides or {})


def blackboard(login: str, stamp: str, name: str = "r.pdf") -> str:
    return f"Lab_{login}_attempt_2026-11-{stamp}_{name}"


THREE = {
    blackboard("ada", "19-10-00-00"): graded("", 4.0),
    blackboard("ada", "20-11-00-00"): graded("", 9.0),
    blackboard("ada", "22-10-00-00"): graded("", 7.0),
}


@pytest.mark.parametrize(("attempt", "points"), [("latest", 7.0), ("first", 4.0), ("best", 9.0)])
def test_one_attempt_counts_and_the_others_are_beneath(attempt, points) -> None:
    (ada, grace), _ = laid_out(THREE, Course(RUBRIC, attempt=attempt))
    assert ada.counted_report.points == ada.total == points
    assert len(ada.other_reports) == 2
    assert ada.counted_report not in ada.other_reports
    assert (grace.counted_report, grace.total, grace.max_points) == (None, None, 10.0)


def test_late_is_what_comes_after_the_due_time_in_its_zone() -> None:
    term = Course(RUBRIC, due=DUE, late_rule=parse_late_rule("10%/day"))
    (ada, _), _ = laid_out(THREE, term)
    assert (ada.late_s, ada.deduction, ada.total) == (46 * 3600.0, 2.0, 5.0)
    assert ada.submission_time == "2026-11-22 10:00"
    # of the best, the loss for being late is part
    files = {blackboard("ada", "20-11-00-00"): graded("", 6.0),
             blackboard("ada", "22-10-00-00"): graded("", 7.0)}  # fmt: skip
    (ada, _), _ = laid_out(files, replace(term, attempt="best"))
    assert (ada.late_s, ada.deduction, ada.total) == (0.0, 0.0, 6.0)


@pytest.mark.parametrize(
    ("due", "rule", "late_s", "off"),
    [
        (DUE, "100%/day", 46 * 3600.0, 10.0),  # nobody has less than nothing
        # in the night to 25 October Berlin has the hour from 2 to 3 twice
        (
            parse_due_time("2026-10-24 23:00:00 Europe/Berlin"),
            "1%/hour",
            683 * 3600.0 + 3600.0,
            10.0,
        ),
    ],
)
def test_what_is_taken_off(due, rule, late_s, off) -> None:
    (ada, _), _ = laid_out(THREE, Course(RUBRIC, due=due, late_rule=parse_late_rule(rule)))
    assert (ada.late_s, ada.deduction) == (late_s, off)
    assert ada.total == 0.0


def test_a_zip_files_time_orders_attempts_and_costs_nothing() -> None:
    first, second = "hoppergrace_7_8_b.pdf", "hoppergrace_7_9_a.pdf"
    packed = {first: datetime(2026, 11, 24), second: datetime(2026, 11, 25)}
    files = {second: graded("", 7.0), first: graded("", 9.0)}
    term = Course(RUBRIC, due=DUE, late_rule=parse_late_rule("10%/day"))
    (_, grace), _ = laid_out(files, term, packed=packed)
    assert (grace.total, grace.late_s, grace.submission_time) == (7.0, None, "")
    assert "no points" in grace.flags[0]
    # nor does a mark without a time
    (_, grace), _ = laid_out({"hoppergrace_LATE_7_8_r.pdf": graded("", 7.0)}, term)
    assert (grace.late_s, grace.total) == (None, 7.0)
    assert "Canvas marks the file as late" in grace.flags[0]


def test_what_is_no_report_counts_only_where_nothing_else_is_there() -> None:
    essay = replace(graded("", 0.0), version="", verdict=Verdict("cannot verify", ("x",), False))
    files = {blackboard("ada", "19-10-00-00"): graded("", 4.0),
             blackboard("ada", "20-10-00-00"): essay}  # fmt: skip
    (ada, _), _ = laid_out(files)
    assert ada.total == 4.0
    assert "is not a report" in ada.flags[0]
    (ada, _), _ = laid_out({blackboard("ada", "20-10-00-00"): essay})
    assert ada.total == 0.0


def of_form(points: float, kind: str, **more):
    form = Answers(log_sha256="a" * 64, mistakes=(ClaimedMistake(kind),))
    return replace(graded("", points, student_id="1"), form=form, **more)


def test_a_guess_in_each_of_several_files_does_not_pay() -> None:
    """None of those that came together counts until the instructor says which is meant."""
    files = {"a.pdf": of_form(4.0, "yaw"), "b.pdf": of_form(9.0, "nlos")}
    (ada, _), _ = laid_out(files)
    assert ada.total is None
    assert ada.counted_report.pending_action == "Ask which of 2 reports counts: their forms differ."
    assert len(ada.other_reports) == 1
    assert laid_out(files, Course(RUBRIC, attempt="best"))[0][0].total == 9.0
    # the same form twice is no guess
    (ada, _), _ = laid_out({name: of_form(4.0, "yaw") for name in files})
    assert ada.total == 4.0


def test_what_is_pending_displaces_no_report_that_counts() -> None:
    """As another's report under this student's id, handed in later."""
    files = {
        "a.pdf": of_form(9.0, "yaw"),
        "z.pdf": of_form(2.0, "nlos", pending_action="Ask whose."),
    }
    packed = {"a.pdf": datetime(2026, 11, 18), "z.pdf": datetime(2026, 11, 19)}
    for times in (None, packed):
        (ada, _), _ = laid_out(files, packed=times)
        assert ada.total == 9.0
        assert [one.submission for one in ada.other_reports] == ["z.pdf"]
        assert ada.flags == ("z.pdf is pending, so another file counts.",)
    waiting = replace(files["a.pdf"].items[0], awaits_points=True)  # for the points of the text
    files["a.pdf"] = replace(files["a.pdf"], items=(waiting,))
    (ada, _), _ = laid_out(files)
    assert ada.counted_report.submission == "a.pdf"


def test_a_name_that_imitates_a_platforms_is_flagged() -> None:
    name = blackboard("ada", "20-10-00-00", "ada_attempt_2026-11-18-10-00-00_r.pdf")
    (ada, _), _ = laid_out({name: graded("", 4.0)})
    assert ada.submission_time == "2026-11-20 10:00"
    assert ada.flags == (
        "The file name looks like a file name of a platform, but a student wrote it "
        "(platform of the export: Blackboard).",
    )


def test_of_two_files_of_one_submission_the_better_one_counts() -> None:
    files = {blackboard("ada", "19-10-00-00", "a.pdf"): graded("", 8.0),
             blackboard("ada", "19-10-00-00", "b.pdf"): graded("", 2.0)}  # fmt: skip
    for attempt in ("first", "latest", "best"):
        (ada, _), _ = laid_out(files, Course(RUBRIC, attempt=attempt))
        assert ada.total == 8.0, attempt


def test_who_handed_in_is_the_platforms_word_and_a_false_id_is_said() -> None:
    files = {blackboard("grace", "19-10-00-00"): graded("", 8.0, student="Ada", student_id="1")}
    (ada, grace), _ = laid_out(files)
    assert ada.counted_report is None
    assert grace.total == 8.0
    assert "is that of 1 (Ada Lovelace)" in grace.flags[0]


def test_who_is_not_in_the_roster_has_a_row_that_says_so() -> None:
    files = {
        "report.pdf": graded("", 8.0, student="Mallory", student_id="9"),
        "other.pdf": graded("", 3.0, student="lovelace ADA"),
    }
    (ada, grace, stranger), _ = laid_out(files)
    assert (ada.total, grace.total) == (3.0, None)
    assert (stranger.student, stranger.student_id, stranger.total) == ("Mallory", "9", 8.0)
    assert stranger.flags[0] == "Not in the class list."


def test_without_a_roster_everyone_who_is_named_has_one_row() -> None:
    files = {
        "Doe Jane_5_assignsubmission_file_/a.pdf": graded("", 1.0, student="Jane", student_id="42"),
        "Roe Max_6_assignsubmission_file_/a.pdf": graded("", 2.0, student="Jane", student_id="42"),
        "b.pdf": graded("", 3.0, student="Kim", student_id="44"),
        "c.pdf": graded("", 4.0, student="Kim", student_id="44"),
        "d.pdf": graded("", 5.0),
    }
    entries, _ = laid_out(files, people=())
    assert [(one.student, one.student_id, one.total) for one in entries] == [
        ("Jane", "42", 1.0), ("Roe Max", "6", 2.0), ("Kim", "44", 4.0), ("", "", 5.0)
    ]  # fmt: skip


# ------------------------------------------------------------------ overrides


def said(tmp_path: Path, *rows: str, head: str = "id,item,points,comment"):
    path = tmp_path / "overrides.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return read_overrides(path)


TWO_OF_ONE = {"1.pdf": graded("", 4.0, 6.0, student_id="1")}
TWO = {"1.pdf": graded("", 4.0, 6.0, student_id="1"), "2.pdf": graded("", 1.0, student_id="2")}


def test_the_instructors_word_is_the_last(tmp_path) -> None:
    rows = said(
        tmp_path, "1,a,9.5,A good idea.", '01,,,"Come and', 'see me."', "1,total,8,Agreed.",
        "2,total,3,", "3,total,1,", "1,C,1,", '2,B,2,"x"',
    )  # fmt: skip
    (ada, grace), notes = laid_out(TWO, overrides=rows)
    assert ada.overrides == {
        "A": Override(9.5, "A good idea."), "total": Override(8.0, "Agreed."),
        "": Override(None, "Come and\nsee me."),
    }  # fmt: skip
    assert (ada.counted_report.points, ada.total, grace.total) == (15.5, 8.0, 3.0)
    told = ("1 has no item 'C'", "2 has no item 'B'", "no student has the id 3")
    assert notes == tuple(f"overrides.csv: {one}." for one in told)
    text, reason = feedback_text(ada, "Lab"), "Because. Your instructor: A good idea."
    assert f"9.5 of 10  A\n    {reason} (Your instructor gave 9.5" in text
    end = "Total    8 of 20\n\nFrom your instructor:\n\nCome and\nsee me.\nAgreed.\n"
    assert text.endswith(end)


@pytest.mark.parametrize(
    ("rows", "points", "told"),
    [
        (("1,A,95,A slip.", "1,total,200,"), (10.0, 10.0), (
            "1 cannot have more than 10 points of 'A'",
            "1 cannot have more than 20 points of 'total'",
        )),
        (("1,A,9,", "1,a,2,", "01,total,12,", "1,Total,3,"), (15.0, 3.0), (
            "1 has two rows for 'A'", "01 has two rows for 'total'",
        )),
    ], ids=["more points than there are", "a second row on the same"],
)  # fmt: skip
def test_a_row_that_is_not_taken_is_told(rows, points, told, tmp_path) -> None:
    (ada, _), notes = laid_out(TWO, overrides=said(tmp_path, *rows))
    assert (ada.counted_report.points, ada.total) == points
    assert notes == tuple(f"overrides.csv: {one}." for one in told)


def test_what_was_said_comes_back_from_the_class_page(tmp_path) -> None:
    """Also of who handed in nothing: the download replaces the file."""
    rows = said(tmp_path, "1,A,9.5,Good.", "1,,,Come.", "1,total,8,Agreed.", "2,total,5,Shown.")
    entries, notes = laid_out({"1.pdf": TWO["1.pdf"]}, overrides=rows)
    again: dict[str, dict[str, Override]] = {}
    for _, _, owner, boxes, kept in map(_point_boxes, entries):
        for item, points, comment in (*((a, c, d) for a, _, c, d in boxes), *kept):
            if points is not None or comment:
                again.setdefault(owner, {})[item] = Override(points, comment)
    assert (again, notes) == (rows, ())


def test_pending_points_do_not_count_until_the_instructor_says_so(tmp_path) -> None:
    files = {"1.pdf": graded("", 4.0, student_id="1", pending_action="Run 0.1.1.")}
    (ada, _), _ = laid_out(files, overrides=said(tmp_path, "1,A,9,"))
    assert ada.total is None
    (ada, _), _ = laid_out(files, overrides=said(tmp_path, "1,total,9,"))
    assert ada.total == 9.0


def test_who_handed_in_nothing_can_be_given_points(tmp_path) -> None:
    (_, grace), notes = laid_out({}, overrides=said(tmp_path, "2,Total,5,Shown in class."))
    assert (grace.total, notes) == (5.0, ())
    assert "Shown in class." in feedback_text(grace)
    (_, grace), notes = laid_out(TWO_OF_ONE, overrides=said(tmp_path, "2,total,50,"))
    assert (grace.total, len(notes)) == (None, 1)


def test_a_semicolon_table_with_decimal_commas_is_read(tmp_path) -> None:
    rows = said(tmp_path, "1;A;7,5;", head="\ufeffid;item;points;comment")
    assert rows == {"1": {"A": Override(7.5)}}


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1,A,abc,", "row 2: points 'abc': give a number of 0 or more"),
        ("1,A,-1,", "give a number"),
        ("1,A,nan,", "give a number"),
        ("1,A,1_5,", "give a number"),
        ("1,,5,", "and an item or total"),
        ("1,A,5,\n1,A,6,", "a second row for student 1, item A"),
    ],
)
def test_what_the_instructor_cannot_have_meant_stops_the_run(tmp_path, row, says) -> None:
    with pytest.raises(SettingsError, match=says):
        said(tmp_path, row)
    with pytest.raises(SettingsError, match="no column comment"):
        said(tmp_path, row, head="id,item,points")


# ------------------------------------------------------------------ due times and late rules


BERLIN = "2026-11-20T23:59:59+01:00"


@pytest.mark.parametrize(
    ("text", "is_"),
    [
        ("2026-11-20 23:59 +01:00", BERLIN),
        ("2026-11-20 23:59 Europe/Berlin", BERLIN),
        ("2026-11-20 22:59:59 +0000", BERLIN),
        ("2026-11-20T22:59Z", BERLIN),
        ("2026-07-20 23:59 Europe/Berlin", "2026-07-20T23:59:59+02:00"),  # summer
        ("2026-11-20 Europe/Berlin", BERLIN),
    ],
)
def test_a_due_time_has_its_zone(text, is_) -> None:
    assert parse_due_time(text) == datetime.fromisoformat(is_)


def test_without_a_zone_it_is_this_computers(monkeypatch) -> None:
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
     (parse_late_rule, "--late", ("", "10", "10%", "-1%/day", "110%/day", "10%/week", "x%/day"))],
)  # fmt: skip
def test_what_is_no_time_and_no_rule_is_one_line(read, said, texts) -> None:
    for text in texts:
        with pytest.raises(SettingsError, match=said) as caught:
            read(text)
        assert "\n" not in str(caught.value)


def test_every_started_day_costs_and_never_more_than_all() -> None:
    for late_s, off in ((0.0, 0), (1.0, 12), (86_400.0, 12), (86_400.5, 24), (1e9, 120)):
        assert parse_late_rule("10%/day").deduction(late_s, 120.0) == off
    # a rule may name its limit and hours
    assert parse_late_rule("1 % / hour up to 5%").deduction(3600.0 * 3.5, 100.0) == 4.0
    assert parse_late_rule("1%/hour up to 5%").deduction(1e6, 100.0) == 5.0


def test_platforms_times_without_a_zone_are_in_that_of_the_due_time() -> None:
    due = parse_due_time("2026-11-20 23:59:00 +05:30")
    bare = datetime(2026, 11, 21, 0, 59)
    assert (add_time_zone(bare, due) - due).total_seconds() == 3600.0
    told = datetime(2026, 11, 20, 18, 29, tzinfo=timezone(timedelta(0)))
    assert add_time_zone(told, due) == due


def test_moodles_words_for_a_time() -> None:
    assert parse_moodle_time("Friday, 20 November 2026, 23:58") == datetime(2026, 11, 20, 23, 58)
    assert parse_moodle_time("Friday, 20 November 2026, 11:58 PM") == datetime(2026, 11, 20, 23, 58)
    assert parse_moodle_time("Freitag, 20. November 2026, 23:58") is None
