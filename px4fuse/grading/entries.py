"""Rows of the class table: the report that counts, late deduction, and the instructor's overrides.

Points that the instructor writes into ``overrides.csv`` replace all computed points. A late
deduction is a percentage of the maximum points for each started day (or hour) after the due time,
at most the maximum that the rule states. The total is never negative.
"""

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from px4fuse.assignment.key import AnswerKey
from px4fuse.assignment.roster import Person, Register, normalise_text, read_people
from px4fuse.assignment.sheet import Sheet, format_cell_number, parse_decimal, read_sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.flags import flag_equal_contents
from px4fuse.grading.model import TOTAL_TITLE, Entry, GradedReport, Item, Override, Submission
from px4fuse.grading.rubric import Rubric
from px4fuse.results.reading import clean_text, one_line

TIME_FORMAT = "%Y-%m-%d %H:%M"
# table of the instructor's points and comments, which px4fuse never overwrites
OVERRIDES_NAME = "overrides.csv"
OVERRIDE_TITLES = ("id", "item", "points", "comment")
OVERRIDES_TEMPLATE = "\ufeff" + ",".join(OVERRIDE_TITLES) + "\r\n"
MAX_OVERRIDE_POINTS = 1e6
MAX_COMMENT_LENGTH = 10_000

# override by student id and item title, as the instructor typed them ("": the whole report)
Overrides = Mapping[str, Mapping[str, Override]]
# syntax of --late
_LATE_RULE = re.compile(
    r"(?P<rate>\d+(?:\.\d+)?)\s*%\s*/\s*(?P<unit>day|hour)"
    r"(?:\s+up to\s+(?P<most>\d+(?:\.\d+)?)\s*%)?"
)
# Moodle's format strftimedaydatetime in English, with a 12-hour and a 24-hour clock
_MOODLE_FORMATS = ("%A, %d %B %Y, %I:%M %p", "%A, %d %B %Y, %H:%M")


@dataclass(frozen=True)
class LateRule:
    """Deduction for late submissions.

    Attributes
    ----------
    share_per_unit : float
        Fraction of the maximum points that is deducted per started unit.
    unit_s : float
        A day or an hour (s).
    max_share : float
        Largest fraction of the maximum points that is deducted.
    text : str
        Rule as the instructor typed it.
    """

    share_per_unit: float
    unit_s: float
    max_share: float
    text: str

    def deduction(self, late_s: float, max_points: float) -> float:
        """Compute the deducted points, for a submission that is late by ``late_s`` seconds.

        >>> parse_late_rule("10%/day").deduction(86_401.0, 50.0)
        10.0
        >>> parse_late_rule("10%/day up to 30%").deduction(1e9, 50.0)
        15.0
        """
        units = math.ceil(max(late_s, 0.0) / self.unit_s)
        return round(max_points * min(units * self.share_per_unit, self.max_share), 2)


@dataclass(frozen=True)
class Course:
    """Class list, answer key, logs and rules, without the submissions.

    Attributes
    ----------
    rubric : Rubric
    key : AnswerKey or None
        Mistakes of each student's flight.
    logs : sequence of Path
        Flight logs, and folders of logs. The SHA-256 identifies the log of a report.
    title : str
        Title of the class page; by default that of the rubric.
    roster : tuple of Person or None
        Class list; by default the students of the answer key, else of the worksheets.
    worksheets : tuple of Sheet
        Tables of learning platforms that receive the grades.
    column : str
        Title of the grade column in the worksheets; "" if there is only one.
    attempt : {"latest", "best", "first"}
        Attempt of a student that counts.
    due : datetime or None
        Due time, with time zone.
    include_pending : bool
        True to count the proposed points of pending reports, on which the instructor has to decide.
    late_rule : LateRule or None
    anonymous : bool
        True to show pseudonyms instead of names on the class page.
    """

    rubric: Rubric
    key: AnswerKey | None = None
    logs: Sequence[Path] = ()
    title: str = ""
    roster: tuple[Person, ...] | None = None
    worksheets: tuple[Sheet, ...] = ()
    column: str = ""
    attempt: Literal["latest", "best", "first"] = "latest"
    due: datetime | None = None
    late_rule: LateRule | None = None
    include_pending: bool = False
    anonymous: bool = False

    @cached_property
    def register(self) -> Register:
        """Students of the class, with the data of all worksheets."""
        people_by_sheet = [read_people(sheet) for sheet in self.worksheets]
        answers = self.key.answers if self.key else ()
        assigned_people = tuple(Person(answer.student_id, answer.name) for answer in answers)
        return Register(
            self.roster or assigned_people or next(iter(people_by_sheet), ()), *people_by_sheet
        )


# one submitted report: sort key (submission time, time of the zip entry), graded report, and the
# row of the class table if the student had submitted this report only
Attempt = tuple[tuple[float, float], GradedReport, Entry]


def build_entries(
    reports: Sequence[GradedReport],
    submissions: Sequence[Submission],
    course: Course,
    overrides: Overrides,
) -> tuple[tuple[Entry, ...], tuple[str, ...]]:
    """Make the rows of the class table: all students, then the reports of unknown students.

    A report belongs to the student that the platform names. If the class list does not contain this
    student, the id in the report decides, then the name in the report. Without a class list, each
    student that a report or a platform names has a row.

    Parameters
    ----------
    reports, submissions : sequences
        All files, in the same order.

    Returns
    -------
    entries : tuple of Entry
    notes : tuple of str
        Overrides that match no student or item.
    """
    register = (
        course.register if course.register.people else _collect_students(reports, submissions)
    )
    attempts: dict[int | None, list[Attempt]] = defaultdict(list)
    for report, submission in zip(reports, submissions, strict=True):
        student_index = register.student_index(submission.origin.person)
        if student_index is None:
            student_index = register.student_index(Person(report.student_id, report.student))
        attempts[student_index].append(
            _make_attempt(report, submission, course, student_index, register)
        )
    max_points = max((report.max_points for report in reports), default=0.0)
    class_rows = [
        _choose_attempt(attempts[student_index], course)
        if attempts[student_index]
        else Entry(person.name, person.student_id, None, max_points=max_points)
        for student_index, person in enumerate(register.people)
    ]
    no_name = "Neither the report nor the platform names a student."
    unknown_note = "Not in the class list." if course.register.people else no_name
    class_rows += [
        replace(entry, flags=(unknown_note, *entry.flags)) for *_, entry in attempts[None]
    ]
    overrides_by_entry, notes = match_overrides(overrides, class_rows)
    flags_by_submission = flag_equal_contents(
        [entry.counted_report for entry in class_rows if entry.counted_report]
    )
    final_entries = (
        _apply_overrides(*entry_and_overrides, flags_by_submission, course)
        for entry_and_overrides in zip(class_rows, overrides_by_entry, strict=True)
    )
    return tuple(final_entries), notes


def _collect_students(
    reports: Sequence[GradedReport], submissions: Sequence[Submission]
) -> Register:
    """Collect the students that platforms and reports name, each once."""
    register = Register()
    for report, submission in zip(reports, submissions, strict=True):
        person = submission.origin.person
        index_of_stated_id = (
            register.student_index(Person(report.student_id)) if report.student_id else None
        )
        if person.numbers or person.login:
            if register.student_index(person) is not None:
                continue
            # if another student has this id already, only the platform identifies this student
            student_id = person.student_id or (
                "" if index_of_stated_id is not None else report.student_id
            )
            name = one_line(report.student if student_id else person.name, 200) or person.name
            student_id = next(filter(None, (student_id, person.login, *person.numbers.values())))
            register.people.append(replace(person, student_id=student_id, name=name))
        elif report.student_id and index_of_stated_id is None:
            register.people.append(Person(report.student_id, one_line(report.student, 200)))
    return register


def _make_attempt(
    report: GradedReport,
    submission: Submission,
    course: Course,
    student_index: int | None,
    register: Register,
) -> Attempt:
    """Make the row of a student as if this were the only report, with the sort key."""
    origin, due = submission.origin, course.due
    platform = origin.platform.capitalize()
    person = Person(report.student_id) if student_index is None else register.people[student_index]
    stated_time = origin.time or parse_moodle_time(person.submitted)
    time, zip_time = (time and add_time_zone(time, due) for time in (stated_time, submission.time))
    late_s = None
    flags = []
    if due is not None and time is not None:
        # differences of UNIX times: datetime differences in one time zone ignore daylight saving
        late_s = max(time.timestamp() - due.timestamp(), 0.0)
    elif origin.is_late:
        flags.append(
            f"{platform} marks the file as late without a time, so no points were deducted."
        )
    elif course.late_rule and due and zip_time and zip_time.timestamp() > due.timestamp():
        flags.append(
            f"The time in the zip file ({zip_time:{TIME_FORMAT}}) is after the due time. It may be "
            "the time of the download, so no points were deducted."
        )
    if origin.is_imitated:
        flags.append(
            "The file name looks like a file name of a platform, but a student wrote it "
            f"(platform of the export: {platform or 'none'})."
        )
    index_of_stated_id = (
        register.student_index(Person(report.student_id)) if origin.platform else None
    )
    if (
        index_of_stated_id is not None
        and student_index is not None
        and index_of_stated_id != student_index
    ):
        other = register.people[index_of_stated_id]
        flags.append(
            f"The id in the report is that of {other.student_id} ({other.name or 'no name'}), but "
            f"{platform} names another student."
        )
    entry = Entry(
        person.name or one_line(report.student or origin.person.name, 200),
        person.student_id,
        report,
        (),
        "" if time is None else time.strftime(TIME_FORMAT),
        late_s,
        course.late_rule.deduction(late_s, report.max_points)
        if course.late_rule and late_s
        else 0.0,
        max_points=report.max_points,
        flags=tuple(flags),
    )
    sort_key = (time.timestamp() if time else 0.0, zip_time.timestamp() if zip_time else 0.0)
    return sort_key, report, entry


def _points_after_deduction(attempt: Attempt) -> float:
    """Return the points, proposed or final, minus the late deduction."""
    _, report, entry = attempt
    return max(report.points - entry.deduction, 0.0)


def _choose_attempt(attempts: Sequence[Attempt], course: Course) -> Entry:
    """Choose the attempt that counts, and add flags if the choice is ambiguous."""
    # several reports of one submission have the same time; points are the second sort key
    ordered_attempts = sorted(
        attempts,
        key=lambda attempt: (attempt[0], _points_after_deduction(attempt), attempt[1].submission),
    )
    # reports that need no decision of the instructor come first, then pending reports, then other
    # files
    report_attempts = [attempt for attempt in ordered_attempts if attempt[1].version]
    eligible_attempts = (
        [attempt for attempt in report_attempts if not attempt[1].pending_action]
        or report_attempts
        or ordered_attempts
    )
    chosen_attempt = {
        "latest": eligible_attempts[-1],
        # of several reports in the first submission, the one with the most points
        "first": [
            attempt for attempt in eligible_attempts if attempt[0] == eligible_attempts[0][0]
        ][-1],
        "best": max(reversed(eligible_attempts), key=_points_after_deduction),
    }[course.attempt]
    chosen_key, chosen_report, entry = chosen_attempt
    flags = list(entry.flags)
    other_reports = tuple(
        report for _, report, _ in ordered_attempts if report is not chosen_report
    )
    simultaneous_reports = [
        report for sort_key, report, _ in eligible_attempts if sort_key == chosen_key
    ]
    if (
        course.attempt != "best" and len({report.form for report in simultaneous_reports}) > 1
    ):  # otherwise students could hand in several guesses, and the best one would count
        pending_action = (
            f"Ask which of {len(simultaneous_reports)} reports counts: their forms differ."
        )
        chosen_report = replace(chosen_report, pending_action=pending_action)
    elif len(simultaneous_reports) > 1 and any(chosen_key):
        flags.append(
            f"{len(simultaneous_reports)} reports have the same time; the best one counts."
        )
    for sort_key, report, _ in ordered_attempts:
        if (
            report in other_reports
            and sort_key >= chosen_key
            and (report.pending_action or not report.version)
        ):
            reason = "is pending" if report.version else "is not a report"
            flags.append(f"{one_line(report.submission, 80)} {reason}, so another file counts.")
    return replace(
        entry, counted_report=chosen_report, other_reports=other_reports, flags=tuple(flags)
    )


def _apply_overrides(
    entry: Entry,
    own_overrides: Mapping[str, Override],
    flags_by_submission: Mapping[str, Sequence[str]],
    course: Course,
) -> Entry:
    """Apply the instructor's overrides, compute the total, and add the flags of the report."""
    report, total, flags = entry.counted_report, None, entry.flags
    if report is not None:
        items = (_override_item(item, own_overrides.get(item.title)) for item in report.items)
        report = replace(report, items=tuple(items))
        flags = (*flags, *report.flags, *flags_by_submission.get(report.submission, ()))
        if report.counted_points is not None or course.include_pending:
            total = round(max(report.points - entry.deduction, 0.0), 2)
    total_override = own_overrides.get(TOTAL_TITLE, Override())
    return replace(
        entry,
        counted_report=report,
        overrides=own_overrides,
        comment="\n".join(
            filter(None, (own_overrides.get("", Override()).comment, total_override.comment))
        ),
        total=total if total_override.points is None else total_override.points,
        flags=flags,
    )


def _override_item(item: Item, override: Override | None) -> Item:
    """Replace the points of an item by the instructor's points, and append the comment."""
    if override is None:
        return item
    comment = (
        f"{item.comment} Your instructor: {override.comment}" if override.comment else item.comment
    )
    if override.points is None:
        return replace(item, comment=comment)
    if override.points != item.points:
        comment = f"{comment} (Your instructor gave {format_cell_number(override.points)} points.)"
    return replace(item, points=override.points, comment=comment, awaits_points=False)


# ------------------------------------------------------------------ overrides


def read_overrides(path: Path) -> Overrides:
    """Read ``overrides.csv``; empty if the file does not exist.

    Columns: id (as in class.csv, or the file name of the report), item (a title of the rubric,
    "total", or empty for a comment on the whole report), points, comment.

    Raises
    ------
    SettingsError
        A column is missing, or points are not a valid number.
    """
    if not path.exists():
        return {}
    sheet = read_sheet(path)
    missing = [title for title in OVERRIDE_TITLES if sheet.column((title,)) is None]
    if missing:
        raise SettingsError(
            f"{path}: no column {', '.join(missing)}.",
            f"Required columns: {', '.join(OVERRIDE_TITLES)}.",
        )
    overrides: dict[str, dict[str, Override]] = defaultdict(dict)
    for row_number, row in enumerate(sheet.rows, start=2):
        student, item, points, comment = (
            sheet.cell(row, (title,)).removeprefix("'") for title in OVERRIDE_TITLES
        )
        value = parse_decimal(points)
        problem = ""
        if item in overrides[student]:
            item_text = one_line(item, 40) or "(whole report)"
            problem = f"a second row for student {one_line(student, 40)}, item {item_text}"
        elif points and (value is None or not 0.0 <= value <= MAX_OVERRIDE_POINTS or not item):
            points_text = one_line(points, 20)
            problem = f"points {points_text!r}: give a number of 0 or more, and an item or total"
        if problem:
            raise SettingsError(f"{path}: row {row_number}: {problem}.")
        overrides[student][item] = Override(value, clean_text(comment[:MAX_COMMENT_LENGTH]))
    return overrides


def match_overrides(
    overrides: Overrides, entries: Sequence[Entry]
) -> tuple[list[dict[str, Override]], tuple[str, ...]]:
    """Match overrides with entries; return a note for each override that matches no entry or item.

    Returns
    -------
    matched_overrides : list of dict
        Overrides of each entry, by the title of an item, "total", or "" (the whole report).
    notes : tuple of str
    """
    matched_overrides: list[dict[str, Override]] = [{} for _ in entries]
    max_total = max(
        (report.max_points for entry in entries for report in entry.reports),
        default=MAX_OVERRIDE_POINTS,
    )
    file_names = (
        entry.counted_report.submission if entry.counted_report else "" for entry in entries
    )
    people = Register(
        Person(entry.student_id, login=file)
        for entry, file in zip(entries, file_names, strict=True)
    )
    notes = []
    for student, override_by_item in overrides.items():
        # the instructor may type an id, with or without leading zeros, or a file name
        student_index = people.student_index(Person(student, login=student))
        if student_index is None:
            notes.append(
                f"{OVERRIDES_NAME}: no student has the id {one_line(student, 40) or '(empty)'}."
            )
            continue
        report = entries[student_index].counted_report
        max_by_title = {item.title: item.max_points for item in report.items} if report else {}
        max_by_title |= {
            TOTAL_TITLE: report.max_points if report else max_total,
            "": MAX_OVERRIDE_POINTS,
        }
        titles = {normalise_text(title): title for title in max_by_title}
        for item, override in override_by_item.items():
            title, problem = titles.get(normalise_text(item)), ""
            if title is None:
                problem = f"has no item {one_line(item, 60)!r}"
            elif title in matched_overrides[student_index]:
                problem = f"has two rows for {title or 'a comment on the whole report'!r}"
            elif (override.points or 0.0) > max_by_title[title]:
                limit = f"{max_by_title[title]:g} points of {one_line(title, 60)!r}"
                problem = f"cannot have more than {limit}"
            else:
                matched_overrides[student_index][title] = override
            notes += [f"{OVERRIDES_NAME}: {one_line(student, 40)} {problem}."] if problem else []
    return matched_overrides, tuple(notes)


# ------------------------------------------------------------------ due time


def parse_late_rule(text: str) -> LateRule:
    """Parse a late rule such as ``10%/day`` or ``10%/day up to 50%``.

    Raises
    ------
    SettingsError
        The text is not a late rule.
    """
    match = _LATE_RULE.fullmatch(text.strip())
    if match is None or not 0.0 <= float(match["rate"]) <= 100.0:
        raise SettingsError(f"--late {text!r} is not a rule. Use 10%/day or 10%/day up to 50%.")
    unit_s = {"day": 86_400.0, "hour": 3_600.0}[match["unit"]]
    max_share = min(float(match["most"] or 100.0) / 100.0, 1.0)
    return LateRule(float(match["rate"]) / 100.0, unit_s, max_share, text.strip())


def parse_due_time(text: str) -> datetime:
    """Parse a due time: ``2026-11-20 23:59``, optionally with ``+01:00`` or ``Europe/Berlin``.

    The default time zone is that of this computer. A date without a time means the end of the day,
    and a time without seconds the end of the minute.

    Raises
    ------
    SettingsError
        The text is not a valid time.
    """
    parts = text.split()
    try:
        zone = ZoneInfo(parts.pop()) if parts and parts[-1][0].isalpha() else None
        time = datetime.fromisoformat("T".join(parts[:2]) + "".join(parts[2:]))
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"--due {text!r} is not a valid time. Use '2026-11-20 23:59', optionally "
            "followed by a time zone ('+01:00' or 'Europe/Berlin')."
        ) from error
    clock = re.search(r"\d\d:\d\d(:\d\d)?", text)
    if clock is None:
        time = time.replace(hour=23, minute=59)
    if clock is None or clock[1] is None:
        time = time.replace(second=59)
    return time.replace(tzinfo=zone) if zone else time if time.tzinfo else time.astimezone()


def add_time_zone(time: datetime, due: datetime | None) -> datetime:
    """Add the time zone of the due time to a time without time zone."""
    if time.tzinfo is not None:
        return time
    return time.replace(tzinfo=due.tzinfo) if due is not None else time.astimezone()


def parse_moodle_time(text: str) -> datetime | None:
    """Parse the submission time in Moodle's worksheet; None if the format is not known.

    >>> parse_moodle_time("Friday, 20 November 2026, 11:58 PM").isoformat()
    '2026-11-20T23:58:00'
    >>> parse_moodle_time("-")
    """
    for time_format in _MOODLE_FORMATS:
        with suppress(ValueError):
            return datetime.strptime(text.strip(), time_format)
    return None
