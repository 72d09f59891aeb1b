"""Rows of a class: the attempt that counts for each student, its deduction, and overrides.

``overrides.csv`` of the instructor takes precedence over the rules. A late deduction is a
percentage of the maximum points for each started day (or hour) after the due time. It is limited by
the maximum that the rule states, and the total is never negative.
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
from px4fuse.assignment.sheet import Sheet, decimal, number, read_sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.flags import class_flags
from px4fuse.grading.model import TOTAL, Entry, GradedReport, Item, Override, Submission
from px4fuse.grading.rubric import Rubric
from px4fuse.results.reading import clean_text, one_line

TIME_FORMAT = "%Y-%m-%d %H:%M"
# table of points and comments by the instructor; never overwritten
OVERRIDES_NAME = "overrides.csv"
OVERRIDE_TITLES = ("id", "item", "points", "comment")
OVERRIDES_TEMPLATE = "\ufeff" + ",".join(OVERRIDE_TITLES) + "\r\n"
MAX_OVERRIDE_POINTS = 1e6
MAX_COMMENT_LENGTH = 10_000

# override by student id and item as typed ("": the whole report)
Overrides = Mapping[str, Mapping[str, Override]]
# format of --late
_RULE = re.compile(
    r"(?P<rate>\d+(?:\.\d+)?)\s*%\s*/\s*(?P<unit>day|hour)"
    r"(?:\s+up to\s+(?P<most>\d+(?:\.\d+)?)\s*%)?"
)
# Moodle's strftimedaydatetime in English, with 12 and 24 hours
_MOODLE_FORMATS = ("%A, %d %B %Y, %I:%M %p", "%A, %d %B %Y, %H:%M")


@dataclass(frozen=True)
class LateRule:
    """Deduction for late submissions.

    Attributes
    ----------
    share : float
        Fraction of the maximum points, per started unit.
    unit_s : float
        Length of the unit (s).
    max_share : float
        Maximum fraction.
    text : str
        Rule as typed.
    """

    share: float
    unit_s: float
    max_share: float
    text: str

    def deduction(self, late_s: float, of: float) -> float:
        """Compute the points that are deducted.

        >>> late_rule("10%/day").deduction(86_401.0, 50.0)
        10.0
        >>> late_rule("10%/day up to 30%").deduction(1e9, 50.0)
        15.0
        """
        units = math.ceil(max(late_s, 0.0) / self.unit_s)
        return round(of * min(units * self.share, self.max_share), 2)


@dataclass(frozen=True)
class Course:
    """Class and grading rules, without the submissions.

    Attributes
    ----------
    rubric : Rubric
    key : AnswerKey or None
        Mistakes of each student's flight.
    logs : sequence of Path
        Flight logs and folders of them; the log of a report is found by SHA-256.
    title : str
        Title of the class page; by default that of the rubric.
    roster : tuple of Person or None
        Class list; by default the students of the answer key, else of the worksheets.
    worksheets : tuple of Sheet
        Tables of learning platforms that receive the grades.
    column : str
        Title of their grade column; "" if there is only one.
    attempt : {"latest", "best", "first"}
        Attempt that counts.
    due : datetime or None
        Due time, with time zone.
    include_pending : bool
        Enter pending points as proposed.
    anonymous : bool
        Show pseudonyms on the class page.
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
    late: LateRule | None = None
    include_pending: bool = False
    anonymous: bool = False

    @cached_property
    def register(self) -> Register:
        """Students of the class, with the fields of all worksheets."""
        people_by_sheet = [read_people(sheet) for sheet in self.worksheets]
        handed_out_flights = self.key.answers if self.key else ()
        handed_out = tuple(Person(answer.student_id, answer.name) for answer in handed_out_flights)
        return Register(
            self.roster or handed_out or next(iter(people_by_sheet), ()), *people_by_sheet
        )


# sort key (submission time, zip time); graded file; row of the student with this file only
Attempt = tuple[tuple[float, float], GradedReport, Entry]


def class_entries(
    graded: Sequence[GradedReport],
    submissions: Sequence[Submission],
    course: Course,
    overrides: Overrides,
) -> tuple[tuple[Entry, ...], tuple[str, ...]]:
    """Make the rows of a class: all students, then the reports of unknown students.

    A file belongs to the student that the platform names. If the class list does not contain this
    student, it belongs to the student in the report, by id, then by name. Without a class list each
    student that a report or platform names has a row.

    Parameters
    ----------
    graded, submissions : sequences
        All files, in the same order.

    Returns
    -------
    entries : tuple of Entry
    notes : tuple of str
        Overrides that match no student or item.
    """
    everyone = course.register if course.register.people else _people_named(graded, submissions)
    attempts: dict[int | None, list[Attempt]] = defaultdict(list)
    for one, submission in zip(graded, submissions, strict=True):
        student_index = everyone.student_index(submission.origin.person)
        if student_index is None:
            student_index = everyone.student_index(Person(one.student_id, one.student))
        attempts[student_index].append(_attempt(one, submission, course, student_index, everyone))
    max_points = max((one.of for one in graded), default=0.0)
    class_rows = [
        _choose_attempt(attempts[at], course)
        if attempts[at]
        else Entry(person.name, person.student_id, None, of=max_points)
        for at, person in enumerate(everyone.people)
    ]
    no_name = "Neither the report nor the platform names a student."
    note = "Not in the class list." if course.register.people else no_name
    class_rows += [replace(entry, flags=(note, *entry.flags)) for *_, entry in attempts[None]]
    overrides_by_entry, notes = match_overrides(overrides, class_rows)
    common_flags = class_flags([entry.counting for entry in class_rows if entry.counting])
    settled = (
        _apply_overrides(*each, common_flags, course)
        for each in zip(class_rows, overrides_by_entry, strict=True)
    )
    return tuple(settled), notes


def _people_named(graded: Sequence[GradedReport], submissions: Sequence[Submission]) -> Register:
    """Return each student that a platform or report names, once, if there is no class list."""
    register = Register()
    for one, submission in zip(graded, submissions, strict=True):
        person = submission.origin.person
        claimed = register.student_index(Person(one.student_id)) if one.student_id else None
        if person.numbers or person.login:
            if register.student_index(person) is not None:
                continue
            # an id belongs to one student: a second one is identified by the platform only
            student_id = person.student_id or ("" if claimed is not None else one.student_id)
            name = one_line(one.student if student_id else person.name, 200) or person.name
            student_id = next(filter(None, (student_id, person.login, *person.numbers.values())))
            register.people.append(replace(person, student_id=student_id, name=name))
        elif one.student_id and claimed is None:
            register.people.append(Person(one.student_id, one_line(one.student, 200)))
    return register


def _attempt(
    graded: GradedReport,
    submission: Submission,
    course: Course,
    student_index: int | None,
    register: Register,
) -> Attempt:
    """Make the row of a student from one file."""
    origin, due = submission.origin, course.due
    platform = origin.platform.capitalize()
    person = Person(graded.student_id) if student_index is None else register.people[student_index]
    stated_time = origin.time or moodle_time(person.submitted)
    time, packed = (one and in_zone_of(one, due) for one in (stated_time, submission.time))
    late_s = None
    flags = []
    if due is not None and time is not None:
        # timestamps, because Python's difference in one time zone ignores daylight saving
        late_s = max(time.timestamp() - due.timestamp(), 0.0)
    elif origin.late:
        flags.append(f"{platform} marks the file as late, without a time: no points deducted.")
    elif course.late and due and packed and packed.timestamp() > due.timestamp():
        flags.append(
            f"Time in the zip file: {packed.strftime(TIME_FORMAT)}, after the due time. It may be "
            "the time of the download, so no points were deducted."
        )
    if origin.is_imitated:
        flags.append(
            f"The file name imitates the names of a platform (found: {platform or 'none'})."
        )
    claimed = register.student_index(Person(graded.student_id)) if origin.platform else None
    if claimed is not None and student_index is not None and claimed != student_index:
        other = register.people[claimed]
        flags.append(
            f"The id in the report is that of {other.student_id} ({other.name or 'no name'}), but "
            f"{platform} names another student."
        )
    entry = Entry(
        person.name or one_line(graded.student or origin.person.name, 200),
        person.student_id,
        graded,
        (),
        "" if time is None else time.strftime(TIME_FORMAT),
        late_s,
        course.late.deduction(late_s, graded.of) if course.late and late_s else 0.0,
        of=graded.of,
        flags=tuple(flags),
    )
    stamps = (time.timestamp() if time else 0.0, packed.timestamp() if packed else 0.0)
    return stamps, graded, entry


def _points_after_deduction(attempt: Attempt) -> float:
    """Points minus deduction, for comparing attempts; pending points as proposed."""
    _, one, entry = attempt
    return max(one.points - entry.deduction, 0.0)


def _choose_attempt(attempts: Sequence[Attempt], course: Course) -> Entry:
    """Choose the attempt that counts, and flag ambiguities."""
    # by time; several files of one submission by points
    ordered = sorted(
        attempts, key=lambda one: (one[0], _points_after_deduction(one), one[1].submission)
    )
    # pending reports and files that are not reports count only if there are no others
    reports = [attempt for attempt in ordered if attempt[1].version]
    eligible = [attempt for attempt in reports if not attempt[1].pending] or reports or ordered
    attempts_by_rule = {
        "latest": eligible[-1],
        # of several files of one submission the best
        "first": [attempt for attempt in eligible if attempt[0] == eligible[0][0]][-1],
        "best": max(reversed(eligible), key=_points_after_deduction),
    }[course.attempt]
    stamps, graded, entry = attempts_by_rule
    flags = list(entry.flags)
    others = tuple(one for _, one, _ in ordered if one is not graded)
    simultaneous = [one for stamp, one, _ in eligible if stamp == stamps]
    if (
        course.attempt != "best" and len({one.form for one in simultaneous}) > 1
    ):  # different guesses
        question = f"Ask which of {len(simultaneous)} reports counts: their forms differ."
        graded = replace(graded, pending=question)
    elif len(simultaneous) > 1 and any(stamps):
        flags.append(f"{len(simultaneous)} reports have the same time; the best one counts.")
    for stamp, one, _ in ordered:
        if one in others and stamp >= stamps and (one.pending or not one.version):
            why = "is pending" if one.version else "is not a report"
            flags.append(f"{one_line(one.submission, 80)} {why}, so another file counts.")
    return replace(entry, counting=graded, others=others, flags=tuple(flags))


def _apply_overrides(
    entry: Entry,
    own_overrides: Mapping[str, Override],
    common_flags: Mapping[str, Sequence[str]],
    course: Course,
) -> Entry:
    """Apply the overrides of the instructor; compute the total and collect the flags."""
    one, total, flags = entry.counting, None, entry.flags
    if one is not None:
        items = (_override_item(item, own_overrides.get(item.title)) for item in one.items)
        one = replace(one, items=tuple(items))
        flags = (*flags, *one.flags, *common_flags.get(one.submission, ()))
        if one.counted is not None or course.include_pending:
            total = round(max(one.points - entry.deduction, 0.0), 2)
    final = own_overrides.get(TOTAL, Override())
    return replace(
        entry,
        counting=one,
        overrides=own_overrides,
        comment="\n".join(filter(None, (own_overrides.get("", Override()).comment, final.comment))),
        total=total if final.points is None else final.points,
        flags=flags,
    )


def _override_item(item: Item, override: Override | None) -> Item:
    """Replace the points of an item by those of the instructor, and append the comment."""
    if override is None:
        return item
    comment = (
        f"{item.comment} Your instructor: {override.comment}" if override.comment else item.comment
    )
    if override.points is None:
        return replace(item, comment=comment)
    if override.points != item.points:
        comment = f"{comment} (Your instructor gave {number(override.points)} points.)"
    return replace(item, points=override.points, comment=comment, awaits_points=False)


# ------------------------------------------------------------------ overrides


def read_overrides(path: Path) -> Overrides:
    """Read ``overrides.csv``; empty if the file does not exist.

    Columns: id (as in class.csv, or the file name), item (a title of the rubric, "total", or empty
    for a comment on the whole report), points, comment.

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
    for at, row in enumerate(sheet.rows, start=2):
        student, item, points, comment = (
            sheet.cell(row, (title,)).removeprefix("'") for title in OVERRIDE_TITLES
        )
        value = decimal(points)
        problem = ""
        if item in overrides[student]:
            problem = f"{one_line(student, 40)}, {one_line(item, 40) or 'all'} is given twice"
        elif points and (value is None or not 0.0 <= value <= MAX_OVERRIDE_POINTS or not item):
            points_text = one_line(points, 20)
            problem = f"points {points_text!r}: give a number from 0, and an item or total"
        if problem:
            raise SettingsError(f"{path}: row {at}: {problem}.")
        overrides[student][item] = Override(value, clean_text(comment[:MAX_COMMENT_LENGTH]))
    return overrides


def match_overrides(
    overrides: Overrides, entries: Sequence[Entry]
) -> tuple[list[dict[str, Override]], tuple[str, ...]]:
    """Match overrides with entries; return a note for each override without student or item.

    Returns
    -------
    matched_overrides : list of dict
        For each entry, by the title of an item, "total", or "" (the whole report).
    notes : tuple of str
    """
    matched_overrides: list[dict[str, Override]] = [{} for _ in entries]
    max_total = max(
        (one.of for entry in entries for one in entry.files), default=MAX_OVERRIDE_POINTS
    )
    files = (entry.counting.submission if entry.counting else "" for entry in entries)
    people = Register(
        Person(entry.student_id, login=file) for entry, file in zip(entries, files, strict=True)
    )
    notes = []
    for student, rows in overrides.items():
        # by id (with or without leading zeros) or file name
        student_index = people.student_index(Person(student, login=student))
        if student_index is None:
            notes.append(
                f"{OVERRIDES_NAME}: no student has the id {one_line(student, 40) or '(empty)'}."
            )
            continue
        one = entries[student_index].counting
        max_by_title = {item.title: item.of for item in one.items} if one else {}
        max_by_title |= {TOTAL: one.of if one else max_total, "": MAX_OVERRIDE_POINTS}
        titles = {normalise_text(title): title for title in max_by_title}
        for item, override in rows.items():
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


def late_rule(text: str) -> LateRule:
    """Read a late rule such as ``10%/day`` or ``10%/day up to 50%``.

    Raises
    ------
    SettingsError
        The text is not a late rule.
    """
    match = _RULE.fullmatch(text.strip())
    if match is None or not 0.0 <= float(match["rate"]) <= 100.0:
        raise SettingsError(f"--late {text!r} is not a rule. Use 10%/day or 10%/day up to 50%.")
    unit_s = {"day": 86_400.0, "hour": 3_600.0}[match["unit"]]
    max_share = min(float(match["most"] or 100.0) / 100.0, 1.0)
    return LateRule(float(match["rate"]) / 100.0, unit_s, max_share, text.strip())


def due_time(text: str) -> datetime:
    """Read a due time: ``2026-11-20 23:59``, optionally with ``+01:00`` or ``Europe/Berlin``.

    The default time zone is that of this computer. A date without time is the end of the day, and a
    time without seconds the end of the minute.

    Raises
    ------
    SettingsError
        The text is not a valid time.
    """
    words = text.split()
    try:
        zone = ZoneInfo(words.pop()) if words and words[-1][0].isalpha() else None
        time = datetime.fromisoformat("T".join(words[:2]) + "".join(words[2:]))
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


def in_zone_of(time: datetime, due: datetime | None) -> datetime:
    """Add a time zone to a platform's time: that of the due time, unless it has one."""
    if time.tzinfo is not None:
        return time
    return time.replace(tzinfo=due.tzinfo) if due is not None else time.astimezone()


def moodle_time(text: str) -> datetime | None:
    """Read the submission time of Moodle's worksheet; None if it cannot be read.

    >>> moodle_time("Friday, 20 November 2026, 11:58 PM").isoformat()
    '2026-11-20T23:58:00'
    >>> moodle_time("-")
    """
    for form in _MOODLE_FORMATS:
        with suppress(ValueError):
            return datetime.strptime(text.strip(), form)
    return None
