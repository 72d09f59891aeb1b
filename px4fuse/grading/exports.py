"""Grades as learning platforms import them: their own tables, filled in.

A table that a platform exports for this purpose is given back with two kinds of cells filled, the
grade and, where it has a column for it, the feedback; everything else stays. Rows of students with
no grade yet (pending, or nothing handed in) stay as they are: a platform would take an empty cell
for one to delete, and zero for a grade.

- Moodle: "Using Assignment", Offline grading worksheet, docs.moodle.org; read back by
  ``mod/assign/feedback/offline/importgradeslib.php``, which finds "Identifier" ("Participant 12"),
  "Grade" and "Last modified (grade)" by their titles, takes "Feedback comments" as HTML, passes
  over grades above "Maximum Grade", and numbers in the language of the site.
- Moodle, files: "Upload multiple feedback files in a zip"; read back by
  ``mod/assign/feedback/file/importziplib.php``: ``{name}_{participant}_assignfeedback_file_/``.
- Canvas: "How do I import grades in the Gradebook?", Instructor Guide: the exported gradebook, with
  Student, ID, SIS User ID, SIS Login ID, Section, and ``Title (12345)`` for an assignment; columns
  marked "(read only)" in the row "Points Possible" are ignored.
- Blackboard Learn: "Work Offline with Grade Data", Instructor Help: Username and
  ``Title [Total Pts: 100 Score] |12345``, with "Feedback to Learner" and "Feedback Format" beside a
  single column; UTF-16 with tabs, or commas with every cell in quotes.
- ILIAS takes no table back without a plugin: a plain one, with login and matriculation.
"""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from px4fuse.assignment.key import folded
from px4fuse.assignment.sheet import Sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.class_table import number
from px4fuse.grading.model import Entry
from px4fuse.grading.platforms import ExportOrigin
from px4fuse.grading.roster import Register, person_of_row
from px4fuse.grading.zipping import zipped
from px4fuse.plain import few_words
from px4fuse.results.reading import one_line
from px4fuse.spreadsheet import neutral, neutral_id

Kind = Literal["moodle", "canvas", "blackboard", "other"]
GRADE = ("grade", "bewertung", "points", "punkte", "mark", "note", "score")
MAX_GRADE = ("maximumgrade", "hoechstebewertung", "höchstebewertung")
COMMENTS = ("feedbackcomments", "feedbackalskommentar", "feedbacktolearner", "feedback", "comment")
CANVAS = re.compile(r"^(?P<title>.*) \((?P<id>\d+)\)$")
BLACKBOARD = re.compile(r"^(?P<title>.*) \[Total Pts: (?P<of>[^\]]*?)( \w+)?\] \|(?P<id>\d+)$")
# Never written into: of Canvas, and what other platforms compute
READ_ONLY = "(read only)"


@dataclass(frozen=True)
class Filled:
    """A table as a platform takes it, and what could not be entered: sentences."""

    sheet: Sheet
    notes: tuple[str, ...]


def kind_of(sheet: Sheet) -> Kind:
    """Which platform a table is from."""
    if sheet.column(("identifier",)) is not None and sheet.column(GRADE) is not None:
        return "moodle"
    if any(BLACKBOARD.match(title) for title in sheet.head):
        return "blackboard"
    if sheet.column(("student",)) is not None and any(map(CANVAS.match, sheet.head)):
        return "canvas"
    return "other"


def grade_column(sheet: Sheet, wanted: str) -> int:
    """Where the grade goes.

    Parameters
    ----------
    wanted : str
        Title of the column, without the platform's number; "" where there is only one.

    Raises
    ------
    SettingsError
        There is none, or several and none was named.
    """
    kind = kind_of(sheet)
    named = any(folded(wanted) == folded(title) for title in sheet.head)
    if (kind == "moodle" and not named) or (kind == "other" and not wanted):
        place = sheet.column(GRADE)
        found = {} if place is None else {place: sheet.head[place]}
    else:
        found = {}
        pattern = {"canvas": CANVAS, "blackboard": BLACKBOARD}.get(kind)
        for at, title in enumerate(sheet.head):
            match = pattern.match(title) if pattern else None
            plain = match["title"] if match else title
            is_open = not any(READ_ONLY in row[at] for row in sheet.rows[:3])
            asked = not wanted or folded(wanted) in (folded(plain), folded(title))
            if is_open and asked and (match or not pattern):
                found[at] = plain
    if len(found) == 1:
        return next(iter(found))
    others = ", ".join(one_line(title, 40) for title in (found.values() or sheet.head))
    raise SettingsError(
        f"{sheet.path}: "
        + ("several columns for the grade" if found else "no column for the grade")
        + f". Name one with --column: {one_line(others, 300)}."
    )


def filled(
    sheet: Sheet,
    entries: Sequence[Entry],
    register: Register,
    column: str,
    feedback: Mapping[int, str],
) -> Filled:
    """Enter the grades of a class into a platform's table.

    Parameters
    ----------
    entries : sequence of Entry
        The first ones of the people in ``register``, in its order.
    column : str
        As :func:`grade_column` takes it.
    feedback : mapping
        Index into ``entries`` to what the student reads.

    Raises
    ------
    SettingsError
        From :func:`grade_column`.
    """
    place = grade_column(sheet, column)
    comments, formats = sheet.column(COMMENTS), sheet.column(("feedbackformat",))
    kind = kind_of(sheet)
    cells = [list(row) for row in sheet.rows]
    comma = any(re.fullmatch(r"\d+,\d+", cell.strip()) for row in cells for cell in row)
    notes, seen = [], set()
    for row in cells:
        person = person_of_row(sheet, row)
        at = register.place(person) if person else None
        if at is None:
            continue
        seen.add(at)
        entry = entries[at]
        if entry.total is None:
            continue
        most = _most(sheet, row, place)
        if most is not None and entry.total > most:
            notes.append(
                f"{sheet.path.name}: {number(entry.total)} points of {_who(entry)} are more than "
                f"the platform's {number(most)}, and will not be taken: change its maximum."
            )
        said = number(entry.total)
        row[place] = said.replace(".", ",") if comma and kind == "moodle" else said
        if comments is not None and comments != place and at in feedback:
            row[comments] = as_html(feedback[at]) if kind != "other" else neutral(feedback[at])
            if formats is not None:
                row[formats] = "HTML"
    left = [_who(entries[at]) for at in range(len(register.people))
            if at not in seen and entries[at].total is not None]  # fmt: skip
    if left:
        notes.append(f"{sheet.path.name}: it has no row for {few_words(left, 4)}.")
    return Filled(replace(sheet, rows=tuple(map(tuple, cells))), tuple(notes))


def _most(sheet: Sheet, row: Sequence[str], place: int) -> float | None:
    """The most points that the platform takes, where the table says it."""
    said = sheet.cell(row, MAX_GRADE)
    if match := BLACKBOARD.match(sheet.head[place]):
        said = match["of"]
    for other in sheet.rows[:3]:
        if any("points possible" in cell.casefold() for cell in other[:1]):
            said = other[place]
    try:
        return float(said.replace(",", ".").removeprefix("up to "))
    except ValueError:
        return None


def _who(entry: Entry) -> str:
    return one_line(entry.student or entry.student_id, 40)


def as_html(text: str) -> str:
    r"""Plain text for a field that is shown as HTML, in which nothing of it is markup.

    >>> as_html("a <b>\n 1")
    'a &lt;b&gt;<br>&nbsp;1'
    """
    lines = html.escape(text, quote=False).rstrip("\n").split("\n")
    return "<br>".join(re.sub(r"^ +", lambda m: "&nbsp;" * len(m[0]), line) for line in lines)


def moodle_feedback(
    entries: Sequence[Entry], origins: Mapping[str, ExportOrigin], feedback: Mapping[int, str]
) -> bytes:
    """Feedback files as Moodle's "Upload multiple feedback files in a zip" takes them.

    Parameters
    ----------
    origins : mapping
        Name of a submission to where it came from.
    """
    files = {}
    for at, entry in enumerate(entries):
        origin = _origin(entry, origins, "moodle")
        if origin is not None and at in feedback:
            # Moodle splits at _ and looks for the number in the second part
            name = re.sub(r'[_/\\:*?"<>|\x00-\x1f]+', " ", origin.name).strip() or "student"
            folder = f"{name}_{origin.number}_assignfeedback_file_"
            files[f"{folder}/feedback.txt"] = feedback[at].encode("utf-8-sig")
    return zipped(files)


def _origin(
    entry: Entry, origins: Mapping[str, ExportOrigin], platform: str
) -> ExportOrigin | None:
    """Where an entry's counting file came from, if from this platform."""
    origin = origins.get(entry.counting.submission) if entry.counting else None
    return origin if origin is not None and origin.platform == platform else None


def plain_grades(
    platform: str,
    title: str,
    entries: Sequence[Entry],
    origins: Mapping[str, ExportOrigin],
    register: Register,
    feedback: Mapping[int, str],
) -> str:
    """Grades of who handed in by Blackboard or ILIAS, with the ids that these know."""
    of = max((entry.of for entry in entries), default=0.0)
    head = {
        "blackboard": ("Username", "Student ID", "Name", f"{title} [Total Pts: {number(of)} Score]",
                       "Feedback to Learner", "Feedback Format"),
        "ilias": ("Login", "User ID", "Matriculation", "Name", "Mark", "Comment"),
    }[platform]  # fmt: skip
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n", quoting=csv.QUOTE_ALL)
    writer.writerow(map(neutral, head))
    for at, entry in enumerate(entries):
        origin = _origin(entry, origins, platform)
        if origin is None or entry.total is None:
            continue
        login = register.people[at].login if at < len(register.people) else ""
        who: tuple[str, ...] = (login or origin.login, entry.student_id, entry.student)
        if platform == "ilias":
            who = (who[0], origin.number, *who[1:])
        said = feedback.get(at, "")
        more = (as_html(said), "HTML") if platform == "blackboard" else (said,)
        name = neutral(who[-1])
        writer.writerow(
            [*map(neutral_id, who[:-1]), name, number(entry.total), *map(neutral, more)]
        )
    return "\ufeff" + out.getvalue()
