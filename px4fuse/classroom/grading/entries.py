"""Grade of each student: choice of one report, deduction for lateness, and instructor's points.

Points that the instructor writes into ``overrides.csv`` replace the computed points.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date, datetime, tzinfo
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from px4fuse.core.text import clean_text, shorten_to_line
from px4fuse.errors import SettingsError

from ..assignment.key import AnswerKey
from ..assignment.roster import (
    ClassList,
    Person,
    Sheet,
    format_cell_number,
    normalise_text,
    parse_decimal,
    read_csv_sheet,
    read_people,
)
from .model import (
    TOTAL_POINTS_TITLE,
    Grade,
    GradedReport,
    GradeOverride,
    ItemScore,
    select_counted_reports,
)
from .rubric import Rubric, flag_equal_contents

TIME_FORMAT = "%Y-%m-%d %H:%M"
# Table of the instructor's points and comments, which px4fuse never overwrites
OVERRIDES_NAME = "overrides.csv"
OVERRIDE_TITLES = ("id", "item", "points", "comment")
OVERRIDES_TEMPLATE = "\ufeff" + ",".join(OVERRIDE_TITLES) + "\r\n"
MAX_COMMENT_LENGTH = 10_000

# Points and comment of the instructor, by student id and rubric item ("" for the whole report)
OverridesByStudent = Mapping[str, Mapping[str, GradeOverride]]
# Syntax of the option --late, for example "10 % / day up to 50 %"
_LATE_RULE_PATTERN = re.compile(r"(\d+\.?\d*)\s*%\s*/\s*(day|hour)(?:\s+up to\s+(\d+\.?\d*)\s*%)?")
# English names of the months whose German names begin with other letters
ENGLISH_MONTHS = {"mär": "mar", "mai": "may", "okt": "oct", "dez": "dec"}


@dataclass(frozen=True)
class LateDeductionRule:
    """Deduction of points for late submissions.

    Each started day or hour costs the fraction ``deduction_per_unit`` of the maximum points.
    """

    deduction_per_unit: float
    lateness_unit_s: float
    max_deduction_fraction: float

    def compute_deduction(self, lateness_s: float, max_points: float) -> float:
        """Compute the points to deduct from a submission that is late by ``lateness_s`` seconds.

        >>> parse_late_rule("10%/day").compute_deduction(86_401.0, 50.0)
        10.0
        >>> parse_late_rule("10%/day up to 30%").compute_deduction(1e9, 50.0)
        15.0
        """
        started_day_or_hour_count = math.ceil(max(lateness_s, 0.0) / self.lateness_unit_s)
        return round(
            max_points
            * min(started_day_or_hour_count * self.deduction_per_unit, self.max_deduction_fraction),
            2,
        )


@dataclass(frozen=True)
class Course:
    """Class list, answer key, logs and rules for grading.

    Attributes
    ----------
    logs : sequence of Path
        Flight logs, and folders of logs.
    roster : tuple of Person or None
        Class list; None for the students of the answer key or first worksheet.
    worksheets : tuple of Sheet
        Tables of learning platforms, into which the grades are entered.
    grade_column_title : str
        Title of the grade column in the worksheets.
    attempt : {"latest", "best", "first"}
        Report that counts if a student submitted several.
    due : datetime or None
        Due time of the submission.
    grace_period_s : float
        Maximum delay (s) without a deduction.
    scale : float or None
        Maximum points on the learning platform; None for the maximum of the rubric.
    question_count : int
        Number of questions per student for an oral examination.
    include_pending : bool
        True to count points that wait for a decision of the instructor.
    anonymous : bool
        True to show pseudonyms instead of names on the web page.
    """

    rubric: Rubric
    key: AnswerKey | None = None
    logs: Sequence[Path] = ()
    title: str = ""
    roster: tuple[Person, ...] | None = None
    worksheets: tuple[Sheet, ...] = ()
    grade_column_title: str = ""
    attempt: Literal["latest", "best", "first"] = "latest"
    due: datetime | None = None
    grace_period_s: float = 0.0
    scale: float | None = None
    question_count: int = 0
    late_rule: LateDeductionRule | None = None
    include_pending: bool = False
    anonymous: bool = False

    @cached_property
    def class_list(self) -> ClassList:
        """Students of the class, with the data of all worksheets."""
        people_by_sheet = [read_people(sheet) for sheet in self.worksheets]
        answers = self.key.answers if self.key else ()
        assigned_people = tuple(Person(answer.student_id, answer.name) for answer in answers)
        people = self.roster or assigned_people or next(iter(people_by_sheet), ())
        return ClassList(people, *people_by_sheet)


class _CandidateReport(NamedTuple):
    """Report that may count for a student's grade.

    Attributes
    ----------
    time_s : float
        UNIX time of submission; 0 if unknown.
    grade : Grade
        Grade of the student if this report counts.
    """

    time_s: float
    report: GradedReport
    grade: Grade


def build_grades(
    reports: Sequence[GradedReport], course: Course, overrides: OverridesByStudent
) -> tuple[tuple[Grade, ...], tuple[str, ...]]:
    """Assign the reports to students, and compute the grade of each student.

    Returns
    -------
    grades : tuple of Grade
        Grades of all students, then of reports of unknown students.
    notes : tuple of str
        Sentences about missing times, and about points without a matching student or item.
    """
    grades = _choose_reports(reports, course)
    overrides_per_grade, notes = match_overrides(overrides, grades)
    flags_by_submission = flag_equal_contents(select_counted_reports(grades))
    grades_with_report = [grade for grade in grades if grade.counted_report]
    unknown_time_count = sum(grade.lateness_s is None for grade in grades_with_report)
    if course.late_rule and unknown_time_count:
        notes.append(
            f"The submission time is unknown for {unknown_time_count} of {len(grades_with_report)} "
            "students, so no points were deducted. Add the times with --worksheet."
        )
    final_grades = (
        _apply_overrides(grade, override_by_item_title, flags_by_submission, course)
        for grade, override_by_item_title in zip(grades, overrides_per_grade, strict=True)
    )
    return tuple(final_grades), tuple(notes)


def _choose_reports(reports: Sequence[GradedReport], course: Course) -> list[Grade]:
    """Assign the reports to students, and choose the report that counts for each student.

    Each report of an unknown student gets a grade.
    """
    class_list, unknown_student_flag = course.class_list, "The student is not in the class list."
    if not class_list.people:
        class_list = _collect_students(reports)
        unknown_student_flag = "Neither the report nor the learning platform names a student."
    candidates_by_student_index: dict[int, list[_CandidateReport]] = defaultdict(list)
    grades_of_unknown_students = []
    for report in reports:
        student_index = class_list.find_student_index(report.origin.person)
        if student_index is None:
            student_index = class_list.find_student_index(Person(report.student_id, report.student))
        candidate = _make_candidate(report, course, student_index, class_list)
        if student_index is None:
            flags = (unknown_student_flag, *candidate.grade.flags)
            grades_of_unknown_students.append(replace(candidate.grade, flags=flags))
        else:
            candidates_by_student_index[student_index].append(candidate)
    max_points = max((report.max_points for report in reports), default=0.0)
    grades_of_students = (
        _choose_counted_report(candidates, course)
        if (candidates := candidates_by_student_index[student_index])
        else Grade(person.name, person.student_id, None, max_points=max_points)
        for student_index, person in enumerate(class_list.people)
    )
    return [*grades_of_students, *grades_of_unknown_students]


def _collect_students(reports: Sequence[GradedReport]) -> ClassList:
    """Make a class list of the students that learning platforms and reports name."""
    class_list = ClassList()
    for report in reports:
        person, new_id = report.origin.person, report.student_id
        if class_list.find_student_index(Person(new_id)) is not None:
            new_id = ""  # the id in the report is that of a listed student
        if person.numbers or person.login:  # the learning platform identifies the student
            if class_list.find_student_index(person) is not None:
                continue
            student_id, name = person.student_id or new_id, person.name
            if student_id:
                name = report.student.strip() or name
            else:
                # the report contains no student id, or the id of another student: identify the
                # student by the login or the number from the learning platform
                student_id = person.login or " ".join(person.numbers.values())
            person = replace(person, student_id=student_id, name=shorten_to_line(name, 200))
            class_list.people.append(person)
        elif new_id:  # only the report identifies the student
            class_list.people.append(Person(new_id, shorten_to_line(report.student, 200)))
    return class_list


def _make_candidate(
    report: GradedReport, course: Course, student_index: int | None, class_list: ClassList
) -> _CandidateReport:
    """Return a report with its submission time, and the grade that it gives to the student.

    The grade applies only if the report is chosen from all reports of the student.
    """
    origin = report.origin
    person = (
        Person(report.student_id) if student_index is None else class_list.people[student_index]
    )
    due_time = course.due
    if due_time is not None and person.extended_due:
        name = f"extension of {shorten_to_line(person.student_id, 40)}:"
        due_time = parse_due_time(person.extended_due, name, due_time.tzinfo)
    submission_time = origin.time or parse_moodle_time(person.submission_time)
    if submission_time is not None:
        submission_time = add_time_zone(submission_time, due_time.tzinfo if due_time else None)
    lateness_s, deducted_points = None, 0.0
    if due_time is not None and submission_time is not None:
        # UNIX times, because differences of datetime objects ignore daylight saving time
        lateness_s = submission_time.timestamp() - due_time.timestamp()
        lateness_s = lateness_s if lateness_s > course.grace_period_s else 0.0
        if course.late_rule is not None:
            deducted_points = course.late_rule.compute_deduction(lateness_s, report.max_points)
    grade = Grade(
        person.name or shorten_to_line(report.student or origin.person.name, 200),
        person.student_id,
        report,
        submission_time=f"{submission_time:{TIME_FORMAT}}" if submission_time else "",
        lateness_s=lateness_s,
        deducted_points=deducted_points,
        max_points=report.max_points,
        flags=tuple(_flag_submission(report, lateness_s, student_index, class_list)),
    )
    time_s = submission_time.timestamp() if submission_time else 0.0
    return _CandidateReport(time_s, report, grade)


def _flag_submission(
    report: GradedReport,
    lateness_s: float | None,
    student_index: int | None,
    class_list: ClassList,
) -> Iterator[str]:
    """Yield warnings about time and student of a submission.

    Reasons are a late submission without a known time, an imitated file name of a platform, and an
    id in the report that is not the id of the student on the platform. ``lateness_s`` is None if
    due time or submission time are unknown. ``student_index`` is None for an unknown student.
    """
    origin = report.origin
    platform = origin.platform.capitalize()
    if origin.is_late and lateness_s is None:
        yield (
            f"{platform} marks the file as late, but states no submission time, so no points were "
            "deducted."
        )
    if origin.has_imitated_platform_name:
        yield (
            "The student chose a file name that only learning platforms give. Check who handed in "
            "the file."
        )
    reported_student_index = class_list.find_student_index(Person(report.student_id))
    if (
        platform
        and reported_student_index is not None
        and student_index not in (None, reported_student_index)
    ):
        reported_person = class_list.people[reported_student_index]
        yield (
            f"The id in the report is that of {reported_person.student_id} "
            f"({reported_person.name or 'no name'}), but {platform} names another student."
        )


def _choose_counted_report(candidates: Sequence[_CandidateReport], course: Course) -> Grade:
    """Choose the report of a student that counts: best, first or last, as the course specifies."""
    candidates = sorted(candidates, key=lambda each: each.time_s)
    # prefer reports without open decisions of the instructor
    readable_reports = [each for each in candidates if each.report.version]
    # reports without an open decision of the instructor
    final_reports = [each for each in readable_reports if not each.report.instructor_action]
    eligible_candidates = final_reports or readable_reports or candidates

    def rank(candidate: _CandidateReport) -> tuple[float, float, str]:
        """Return the sort key of a report: the report with the largest key counts."""
        points = max(candidate.report.points - candidate.grade.deducted_points, 0.0)
        # the name decides between reports with equal time and points
        time_s, name = candidate.time_s, candidate.report.submission
        if course.attempt == "best":
            return points, time_s, name
        return (-time_s if course.attempt == "first" else time_s), points, name

    chosen = max(eligible_candidates, key=rank)
    report, flags = chosen.report, list(chosen.grade.flags)
    # a student could hand in several answer forms with different guesses to get the points of the
    # best form. If the best report counts, all forms compete; otherwise only the forms that were
    # handed in at the same time compete
    if course.attempt == "best":
        if len({each.report.form for each in readable_reports}) > 1:
            flags.append(
                f"The student handed in {len(candidates)} reports with different answer forms."
            )
    else:
        forms = [each.report.form for each in eligible_candidates if each.time_s == chosen.time_s]
        if len(set(forms)) > 1:
            action = (
                f"The student handed in {len(forms)} reports with different answer forms. Ask the "
                "student which report counts."
            )
            report = replace(report, instructor_action=action)
    other_candidates = [each for each in candidates if each is not chosen]
    for other in other_candidates:
        is_pending = other.report.instructor_action or not other.report.version
        if is_pending and other.time_s >= chosen.time_s:
            status = "pending" if other.report.version else "not a report"
            name = shorten_to_line(other.report.submission, 80)
            flags.append(f"The file {name} does not count for the grade: it is {status}.")
    return replace(
        chosen.grade,
        counted_report=report,
        other_reports=tuple(other.report for other in other_candidates),
        flags=tuple(flags),
    )


def _apply_overrides(
    grade: Grade,
    override_by_item_title: Mapping[str, GradeOverride],
    flags_by_submission: Mapping[str, Sequence[str]],
    course: Course,
) -> Grade:
    """Apply the instructor's points and comments, and compute the total points."""
    report, total_points, flags = grade.counted_report, None, grade.flags
    if report is not None:
        items = (
            _apply_item_override(item, override_by_item_title.get(item.title))
            for item in report.items
        )
        report = replace(report, items=tuple(items))
        flags = (*flags, *report.flags, *flags_by_submission.get(report.submission, ()))
        # without include_pending, points with an open decision of the instructor do not count
        if report.counted_points is not None or course.include_pending:
            total_points = round(max(report.points - grade.deducted_points, 0.0), 2)
    report_override = override_by_item_title.get("", GradeOverride())
    total_override = override_by_item_title.get(TOTAL_POINTS_TITLE, GradeOverride())
    return replace(
        grade,
        counted_report=report,
        overrides=override_by_item_title,
        comment="\n".join(filter(None, (report_override.comment, total_override.comment))),
        total=total_points if total_override.points is None else total_override.points,
        flags=flags,
    )


def _apply_item_override(item: ItemScore, override: GradeOverride | None) -> ItemScore:
    """Replace points by the instructor's points, and append the instructor's comment."""
    if override is None:
        return item
    comment = item.comment
    if override.comment:
        comment += f" Your instructor: {override.comment}"
    if override.points is None:
        return replace(item, comment=comment)
    if override.points != item.points:
        comment = f"{comment} (Your instructor gave {format_cell_number(override.points)} points.)"
    return replace(item, points=override.points, comment=comment, is_awaiting_points=False)


# ------------------------------------------------------------------ overrides


def read_overrides(path: Path) -> OverridesByStudent:
    """Read the instructor's points and comments from ``overrides.csv``, if the file exists.

    Columns: id, item (rubric title, "total" or empty), points, comment.

    Raises
    ------
    SettingsError
        A column is missing, or points are not a valid number.
    """
    if not path.exists():
        return {}
    sheet = read_csv_sheet(path)
    missing_titles = [
        title for title in OVERRIDE_TITLES if sheet.find_column_index((title,)) is None
    ]
    if missing_titles:
        raise SettingsError(
            f"{path}: no column {', '.join(missing_titles)}.",
            f"Required columns: {', '.join(OVERRIDE_TITLES)}.",
        )
    overrides: dict[str, dict[str, GradeOverride]] = defaultdict(dict)
    for row_number, row in enumerate(sheet.rows, start=2):
        if any(map(str.strip, row[len(sheet.column_titles) :])):
            raise SettingsError(
                f"{path}: row {row_number} has more cells than the header.",
                "Enclose a comment that contains a comma in double quotes.",
            )
        student, item_title, points, comment = (
            sheet.find_cell(row, (title,)).removeprefix("'") for title in OVERRIDE_TITLES
        )
        parsed_points = parse_decimal(points)
        problem = ""
        if item_title in overrides[student]:
            item_text = shorten_to_line(item_title, 40) or "(whole report)"
            problem = (
                f"student {shorten_to_line(student, 40)} has two rows for the item {item_text}"
            )
        elif points and (parsed_points is None or parsed_points < 0.0):
            problem = (
                f"the points must be a number of 0 or more, not {shorten_to_line(points, 20)!r}"
            )
        elif points and not item_title:
            problem = "the row has points but no item: write a rubric title or 'total' as item"
        if problem:
            raise SettingsError(f"{path}: row {row_number}: {problem}.")
        overrides[student][item_title] = GradeOverride(
            parsed_points, clean_text(comment[:MAX_COMMENT_LENGTH])
        )
    return overrides


def match_overrides(
    overrides: OverridesByStudent, grades: Sequence[Grade]
) -> tuple[list[dict[str, GradeOverride]], list[str]]:
    """Assign the instructor's points and comments to students and rubric items.

    Returns
    -------
    matched_overrides : list of dict
        Points and comments for each student, by rubric item, "total", or "" (whole report).
    notes : list of str
        Sentences about points and comments without a matching student or item.
    """
    matched_overrides: list[dict[str, GradeOverride]] = [{} for _ in grades]
    max_points_of_reports = (report.max_points for grade in grades for report in grade.reports)
    max_points_of_class = max(max_points_of_reports, default=math.inf)
    class_list = ClassList(Person(grade.student_id, login=grade.file_name) for grade in grades)
    notes = []
    for student, override_by_item in overrides.items():
        # the instructor may type an id or a file name
        student_index = class_list.find_student_index(Person(student, login=student))
        student_text = shorten_to_line(student, 40) or "(empty)"
        if student_index is None:
            notes.append(f"{OVERRIDES_NAME}: no student has the id {student_text}.")
            continue
        override_by_item_title = matched_overrides[student_index]
        report = grades[student_index].counted_report
        # titles that the instructor may use ("": comment on the whole report), and maximum points
        max_points_by_title = {
            TOTAL_POINTS_TITLE: report.max_points if report else max_points_of_class,
            "": math.inf,
        }
        if report:
            max_points_by_title |= {item.title: item.max_points for item in report.items}
        # Titles are compared without case and without blanks at start and end
        title_by_normalised_title = {normalise_text(title): title for title in max_points_by_title}
        for item_title, override in override_by_item.items():
            title, problem = title_by_normalised_title.get(normalise_text(item_title)), ""
            if title is None:
                problem = (
                    f"student {student_text} has no rubric item {shorten_to_line(item_title, 60)!r}"
                )
            elif title in override_by_item_title:
                problem = f"student {student_text} has two rows for {title or 'the whole report'!r}"
            elif (override.points or 0.0) > (max_points := max_points_by_title[title]):
                limit_text = f"{max_points:g} points of {shorten_to_line(title, 60)!r}"
                problem = f"points of student {student_text} are above the maximum, {limit_text}"
            else:
                override_by_item_title[title] = override
            if problem:
                notes.append(f"{OVERRIDES_NAME}: {problem}.")
    return matched_overrides, notes


# ------------------------------------------------------------------ due time


def parse_late_rule(text: str) -> LateDeductionRule:
    """Parse a rule for late submissions such as ``10%/day`` or ``10%/day up to 50%``.

    Raises
    ------
    SettingsError
        The text is not a late rule.
    """
    match = _LATE_RULE_PATTERN.fullmatch(text.strip())
    if match is None or float(match[1]) > 100.0:
        raise SettingsError(
            f"--late {text!r} is not a deduction, such as 10%/day or 10%/day up to 50%."
        )
    deduction_text, unit, limit_text = match.groups()
    unit_s = 86_400.0 if unit == "day" else 3_600.0
    max_deduction_fraction = min(float(limit_text or 100.0) / 100.0, 1.0)
    return LateDeductionRule(float(deduction_text) / 100.0, unit_s, max_deduction_fraction)


def parse_due_time(
    text: str, name: str = "--due", default_time_zone: tzinfo | None = None
) -> datetime:
    """Parse a due time: ``2026-11-20 23:59``, optionally with ``+01:00`` or ``Europe/Berlin``.

    A date without a time means the end of the day. The default time zone is that of this computer.

    Raises
    ------
    SettingsError
        The text is not a valid time.
    """
    words, time_zone = text.split(), default_time_zone
    try:
        if words and words[-1][0].isalpha():
            time_zone = ZoneInfo(words.pop())
        # ISO 8601: date, "T", time of day and offset from UTC
        iso_text = "T".join(words[:2]) + "".join(words[2:])
        due_time = datetime.fromisoformat(iso_text)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"{name} {text!r} is not a valid time. Use '2026-11-20 23:59', optionally "
            "followed by a time zone ('+01:00' or 'Europe/Berlin')."
        ) from error
    with suppress(ValueError):
        date.fromisoformat(iso_text)
        # only a date: the end of the day
        due_time = due_time.replace(hour=23, minute=59)
    # without seconds (HH:MM:SS or HHMMSS): the last second of the minute
    if not re.search(r"\D\d\d:?\d\d:?\d\d", iso_text):
        due_time = due_time.replace(second=59)
    return add_time_zone(due_time, time_zone)


def add_time_zone(time: datetime, time_zone: tzinfo | None) -> datetime:
    """Add a time zone (None: that of this computer) to a time without a time zone."""
    if time.tzinfo is not None:
        return time
    return time.replace(tzinfo=time_zone) if time_zone else time.astimezone()


def parse_moodle_time(text: str) -> datetime | None:
    """Parse the submission time in a table of Moodle; None for an unsupported format.

    >>> parse_moodle_time("Friday, 20 November 2026, 11:58 PM").isoformat()
    '2026-11-20T23:58:00'
    >>> parse_moodle_time("Freitag, 20. November 2026, 23:58").isoformat()
    '2026-11-20T23:58:00'
    >>> parse_moodle_time("2026-11-20 23:58").isoformat()
    '2026-11-20T23:58:00'
    >>> parse_moodle_time("-")
    """
    with suppress(ValueError):
        return datetime.fromisoformat(text.strip())
    with suppress(ValueError):
        _, day, month, year, *time_of_day = re.findall(r"[\w:]+", text)
        month = ENGLISH_MONTHS.get(month[:3].casefold(), month[:3])
        clock_format = "%I:%M %p" if len(time_of_day) > 1 else "%H:%M"
        return datetime.strptime(
            " ".join([day, month, year, *time_of_day]), f"%d %b %Y {clock_format}"
        )
    return None
