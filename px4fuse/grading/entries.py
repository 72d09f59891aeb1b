"""From what was handed in to one row per student: which attempt counts, and what it is worth.

The instructor's word, ``overrides.csv``, counts instead of the rules.

Points are taken off for every started day (or hour) after the due time: so many per cent of the
most points that there are to have, never more than the limit that the rule names, and never below
zero points.
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
# What the instructor says instead of the rules: a table that is read and never written over
OVERRIDES_NAME = "overrides.csv"
OVERRIDE_TITLES = ("id", "item", "points", "comment")
OVERRIDES_TEMPLATE = "\ufeff" + ",".join(OVERRIDE_TITLES) + "\r\n"
MAX_OVERRIDE_POINTS = 1e6
MAX_COMMENT_LENGTH = 10_000

# Id as it was typed, to item as it was typed ("" for all of it), to what is said
Overrides = Mapping[str, Mapping[str, Override]]
# What being late costs, as it is typed
_RULE = re.compile(
    r"(?P<rate>\d+(?:\.\d+)?)\s*%\s*/\s*(?P<unit>day|hour)"
    r"(?:\s+up to\s+(?P<most>\d+(?:\.\d+)?)\s*%)?"
)
# Moodle's strftimedaydatetime in English, with hours of twelve and of twenty-four
_MOODLE_FORMATS = ("%A, %d %B %Y, %I:%M %p", "%A, %d %B %Y, %H:%M")


@dataclass(frozen=True)
class LateRule:
    """What late hand-ins cost.

    Attributes
    ----------
    share : float
        Of the most points, for every started unit.
    max_share : float
        Share that is never exceeded.
    text : str
        As it was given.
    """

    share: float
    unit_s: float
    max_share: float
    text: str

    def deduction(self, late_s: float, of: float) -> float:
        """Points that are taken off.

        >>> late_rule("10%/day").deduction(86_401.0, 50.0)
        10.0
        >>> late_rule("10%/day up to 30%").deduction(1e9, 50.0)
        15.0
        """
        units = math.ceil(max(late_s, 0.0) / self.unit_s)
        return round(of * min(units * self.share, self.max_share), 2)


@dataclass(frozen=True)
class Course:
    """What is known of a class besides what it handed in, and its rules.

    Attributes
    ----------
    rubric : Rubric
    key : AnswerKey or None
        Which mistakes each student's flight has.
    logs : sequence of Path
        Flight logs and folders of them; a report names its log by SHA-256.
    title : str
        Of the class page; by default the rubric's.
    roster : tuple of Person or None
        Without one the students of the answer key, else those of the worksheets.
    worksheets : tuple of Sheet
        Tables of learning platforms, to be filled in.
    column : str
        Of the worksheets, for the grade; "" where there is only one.
    attempt : {"latest", "best", "first"}
        Which one counts of several.
    due : datetime or None
        With a time zone.
    include_pending : bool
        Whether points that wait for the instructor are entered as they are proposed.
    anonymous : bool
        Whether the class page shows pseudonyms.
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
        """Who is in the class, with what all worksheets know of them."""
        people_by_sheet = [read_people(sheet) for sheet in self.worksheets]
        handed_out_flights = self.key.answers if self.key else ()
        handed_out = tuple(Person(one.student_id, one.name) for one in handed_out_flights)
        return Register(
            self.roster or handed_out or next(iter(people_by_sheet), ()), *people_by_sheet
        )


# When it came and when it was packed, by which attempts are ordered; the file; and the row that it
# would make alone
Attempt = tuple[tuple[float, float], GradedReport, Entry]


def class_entries(
    graded: Sequence[GradedReport],
    submissions: Sequence[Submission],
    course: Course,
    overrides: Overrides,
) -> tuple[tuple[Entry, ...], tuple[str, ...]]:
    """Lay out a class: everyone in the register, then what belongs to nobody in it.

    A file belongs to whom the platform says; where it says nothing that the register knows, to
    whom the report names, by id, then by name. Without a register every student that the reports
    or the platform name has a row.

    Parameters
    ----------
    graded, submissions : sequences
        Of every file, in one order.

    Returns
    -------
    entries : tuple of Entry
    notes : tuple of str
        On overrides that fit nobody.
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
    nobody = "Neither the report nor the platform names anyone."
    note = "Not in the roster." if course.register.people else nobody
    class_rows += [replace(entry, flags=(note, *entry.flags)) for *_, entry in attempts[None]]
    overrides_by_entry, notes = match_overrides(overrides, class_rows)
    common_flags = class_flags([entry.counting for entry in class_rows if entry.counting])
    settled = (
        _apply_overrides(*each, common_flags, course)
        for each in zip(class_rows, overrides_by_entry, strict=True)
    )
    return tuple(settled), notes


def _people_named(graded: Sequence[GradedReport], submissions: Sequence[Submission]) -> Register:
    """Without a roster: everyone whom a platform, else a report, names; each once."""
    register = Register()
    for one, submission in zip(graded, submissions, strict=True):
        person = submission.origin.person
        claimed = register.student_index(Person(one.student_id)) if one.student_id else None
        if person.numbers or person.login:
            if register.student_index(person) is not None:
                continue
            # two students may not hand in under one id: the second is known by the platform alone
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
    """One file as if it were the only one of its student."""
    origin, due = submission.origin, course.due
    platform = origin.platform.capitalize()
    person = Person(graded.student_id) if student_index is None else register.people[student_index]
    stated_time = origin.time or moodle_time(person.submitted)
    time, packed = (one and in_zone_of(one, due) for one in (stated_time, submission.time))
    late_s = None
    flags = []
    if due is not None and time is not None:
        # not their difference: in one zone Python takes the clock's, also over a change of it
        late_s = max(time.timestamp() - due.timestamp(), 0.0)
    elif origin.late:
        flags.append(f"{platform} marks it as late and not by how much: nothing was taken off.")
    elif course.late and due and packed and packed.timestamp() > due.timestamp():
        flags.append(
            f"The zip file dates it {packed.strftime(TIME_FORMAT)}, after the due time; that may be when "
            "it was downloaded, so nothing was taken off."
        )
    if origin.is_imitated:
        flags.append(f"Its name has more of a platform's than {platform or 'none'} writes.")
    claimed = register.student_index(Person(graded.student_id)) if origin.platform else None
    if claimed is not None and student_index is not None and claimed != student_index:
        other = register.people[claimed]
        flags.append(
            f"The report gives the id of {other.student_id} ({other.name or 'no name'}), but "
            f"{platform} says who handed it in."
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
    """For the best of several: what it gives without what the instructor has still to say."""
    _, one, entry = attempt
    return max(one.points - entry.deduction, 0.0)


def _choose_attempt(attempts: Sequence[Attempt], course: Course) -> Entry:
    """The attempt that counts, with the others and what that needs said."""
    # by time, of one submission the better file later
    ordered = sorted(
        attempts, key=lambda one: (one[0], _points_after_deduction(one), one[1].submission)
    )
    # what is pending, such as another's report under this id, or no report counts only where there
    # is nothing else
    reports = [one for one in ordered if one[1].version]
    eligible = [one for one in reports if not one[1].pending] or reports or ordered
    attempts_by_rule = {
        "latest": eligible[-1],
        # several files of one submission: the best
        "first": [one for one in eligible if one[0] == eligible[0][0]][-1],
        "best": max(reversed(eligible), key=_points_after_deduction),
    }[course.attempt]
    stamps, graded, entry = attempts_by_rule
    flags = list(entry.flags)
    others = tuple(one for _, one, _ in ordered if one is not graded)
    simultaneous = [one for stamp, one, _ in eligible if stamp == stamps]
    if course.attempt != "best" and len({one.form for one in simultaneous}) > 1:  # a guess in each
        question = f"Ask which of {len(simultaneous)} reports is meant: their forms differ."
        graded = replace(graded, pending=question)
    elif len(simultaneous) > 1 and any(stamps):
        flags.append(f"{len(simultaneous)} reports came at the same time; the best of them counts.")
    for stamp, one, _ in ordered:
        if one in others and stamp >= stamps and (one.pending or not one.version):
            why = "is pending" if one.version else "cannot be read as a report"
            flags.append(f"{one_line(one.submission, 80)} {why}, so that another file counts.")
    return replace(entry, counting=graded, others=others, flags=tuple(flags))


def _apply_overrides(
    entry: Entry,
    own_overrides: Mapping[str, Override],
    common_flags: Mapping[str, Sequence[str]],
    course: Course,
) -> Entry:
    """With the instructor's word on items and on all of it, the total that follows, and flags."""
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
    """An item with the instructor's points and comment in place of, or behind, the rules'."""
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


# ------------------------------------------------------------------ the instructor's word


def read_overrides(path: Path) -> Overrides:
    """Read ``overrides.csv``; nothing where it is not there.

    Its columns are id (as in class.csv, or the file's name), item (a title of the rubric, "total",
    or empty for a comment on all of it), points and comment.

    Raises
    ------
    SettingsError
        A column is missing, or a row says no number of points where it should.
    """
    if not path.exists():
        return {}
    sheet = read_sheet(path)
    missing = [title for title in OVERRIDE_TITLES if sheet.column((title,)) is None]
    if missing:
        raise SettingsError(
            f"{path}: no column {', '.join(missing)}",
            f"Its columns are {', '.join(OVERRIDE_TITLES)}.",
        )
    overrides: dict[str, dict[str, Override]] = defaultdict(dict)
    for at, row in enumerate(sheet.rows, start=2):
        student, item, points, comment = (
            sheet.cell(row, (title,)).removeprefix("'") for title in OVERRIDE_TITLES
        )
        value = decimal(points)
        problem = ""
        if item in overrides[student]:
            problem = f"{one_line(student, 40)}, {one_line(item, 40) or 'all'} stands there twice"
        elif points and (value is None or not 0.0 <= value <= MAX_OVERRIDE_POINTS or not item):
            points_text = one_line(points, 20)
            problem = f"points {points_text!r}: give a number from 0 up, and an item or total"
        if problem:
            raise SettingsError(f"{path}: row {at}: {problem}.")
        overrides[student][item] = Override(value, clean_text(comment[:MAX_COMMENT_LENGTH]))
    return overrides


def match_overrides(
    overrides: Overrides, entries: Sequence[Entry]
) -> tuple[list[dict[str, Override]], tuple[str, ...]]:
    """What is said of whom, and a sentence for every row that fits nobody, or no item.

    Returns
    -------
    matched_overrides : list of dict
        For each entry, by the title of an item, "total", or "" for all of it.
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
        # by the very id, the id but for leading zeros, or the file's name
        student_index = people.student_index(Person(student, login=student))
        if student_index is None:
            notes.append(
                f"{OVERRIDES_NAME}: nobody has the id {one_line(student, 40) or '(empty)'}."
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
                problem = f"has {title or 'a comment on all'!r} from another row already"
            elif (override.points or 0.0) > max_by_title[title]:
                problem = f"cannot have more than {max_by_title[title]:g} points of {one_line(title, 60)!r}"
            else:
                matched_overrides[student_index][title] = override
            notes += [f"{OVERRIDES_NAME}: {one_line(student, 40)} {problem}."] if problem else []
    return matched_overrides, tuple(notes)


# ------------------------------------------------------------------ when it was due


def late_rule(text: str) -> LateRule:
    """Read ``10%/day`` or ``10%/day up to 50%``.

    Raises
    ------
    SettingsError
        It is not such a rule.
    """
    match = _RULE.fullmatch(text.strip())
    if match is None or not 0.0 <= float(match["rate"]) <= 100.0:
        raise SettingsError(f"--late {text!r}: give a rule such as 10%/day or 10%/day up to 50%.")
    unit_s = {"day": 86_400.0, "hour": 3_600.0}[match["unit"]]
    max_share = min(float(match["most"] or 100.0) / 100.0, 1.0)
    return LateRule(float(match["rate"]) / 100.0, unit_s, max_share, text.strip())


def due_time(text: str) -> datetime:
    """Read a due time: ``2026-11-20 23:59``, with a zone ``+01:00`` or ``Europe/Berlin`` behind it.

    Without a zone it is that of this computer. A date alone means the end of that day, and a time
    without seconds the end of that minute.

    Raises
    ------
    SettingsError
        It is not such a time.
    """
    words = text.split()
    try:
        zone = ZoneInfo(words.pop()) if words and words[-1][0].isalpha() else None
        time = datetime.fromisoformat("T".join(words[:2]) + "".join(words[2:]))
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError.of("due_wrong", text=text) from error
    clock = re.search(r"\d\d:\d\d(:\d\d)?", text)
    if clock is None:
        time = time.replace(hour=23, minute=59)
    if clock is None or clock[1] is None:
        time = time.replace(second=59)
    return time.replace(tzinfo=zone) if zone else time if time.tzinfo else time.astimezone()


def in_zone_of(time: datetime, due: datetime | None) -> datetime:
    """A platform's time, which is in the zone of the due time where it says none."""
    if time.tzinfo is not None:
        return time
    return time.replace(tzinfo=due.tzinfo) if due is not None else time.astimezone()


def moodle_time(text: str) -> datetime | None:
    """When Moodle's worksheet says that something was handed in; None where it cannot be read.

    >>> moodle_time("Friday, 20 November 2026, 11:58 PM").isoformat()
    '2026-11-20T23:58:00'
    >>> moodle_time("-")
    """
    for form in _MOODLE_FORMATS:
        with suppress(ValueError):
            return datetime.strptime(text.strip(), form)
    return None
