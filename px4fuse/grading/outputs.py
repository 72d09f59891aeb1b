"""What grading a class writes: table, page, redrawn reports, feedback, and platforms' tables.

A table that a platform exports for this purpose is given back with two kinds of cells filled, the
grade and, where it has a column for it, the feedback; everything else stays. Rows of students with
no grade yet (pending, or nothing handed in) stay as they are: a platform would take an empty cell
for one to delete, and zero for a grade.

- Moodle: "Using Assignment", Offline grading worksheet, docs.moodle.org; read back by
  ``mod/assign/feedback/offline/importgradeslib.php``, which finds "Identifier" ("Participant 12"),
  "Grade" and "Last modified (grade)" by their titles, takes "Feedback comments" as HTML, passes
  over grades above "Maximum Grade", and numbers in the language of the site.
- Canvas: "How do I import grades in the Gradebook?", Instructor Guide: the exported gradebook, with
  Student, ID, SIS User ID, SIS Login ID, Section, and ``Title (12345)`` for an assignment; columns
  marked "(read only)" in the row "Points Possible" are ignored.
- Any other: a table with a column of ids, logins, emails or names, and one for the grade, whose
  title is given or one of :data:`GRADE_TITLES`.
"""

import html
import itertools
import random
import re
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from px4fuse.assignment.roster import (
    Register,
    file_names,
    make_unique,
    normalise_text,
    read_student,
)
from px4fuse.assignment.sheet import Sheet, decimal, number, read_sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.checks import text_of
from px4fuse.grading.class_page import html_text
from px4fuse.grading.entries import OVERRIDES_NAME, OVERRIDES_TEMPLATE, Course
from px4fuse.grading.model import TOTAL, Entry, GradedReport, columns
from px4fuse.grading.records import RECORDS, REDRAWN_SUFFIX
from px4fuse.input_files import own_files
from px4fuse.plain import join_first
from px4fuse.results.reading import one_line
from px4fuse.spreadsheet import neutralise_formulas, neutralise_id
from px4fuse.webpage.safe import template
from px4fuse.writing import write_all

# Reports drawn again from their logs: what to read instead of what was handed in
REPORTS = "reports"
FEEDBACK = "feedback"
GRADES = "grades"
NAMES = "names.csv"
NAMES_HEAD = ("pseudonym", "id", "name")
# Columns of the class table, before and behind those of items and numbers
FIRST_COLUMNS = (
    "file",
    "student",
    "id",
    "status",
    "points",
    "pending points",
    "of",
    "deducted",
    "total",
)
LAST_COLUMNS = (
    "handed in",
    "hours late",
    "pending",
    "comment",
    "flags",
    "other files",
    "reasons",
    "log SHA-256",
)
LIST_SEPARATOR = " | "
# A list of reasons is cut where it would become longer than a sentence
MAX_REASONS = 4
# Titles of columns of platforms' tables
GRADE_TITLES = ("grade", "bewertung", "points", "punkte", "mark", "note", "score")
MAX_GRADE_TITLES = ("maximumgrade", "hoechstebewertung", "höchstebewertung")
# Read as HTML, and read as text
HTML_COMMENT_TITLES = ("feedbackcomments", "feedbackalskommentar")
COMMENT_TITLES = (*HTML_COMMENT_TITLES, "feedbacktolearner", "feedback", "comment")
ASSIGNMENT_NUMBER = re.compile(r" \(\d+\)$")
# Never written into: of Canvas, what it computes
READ_ONLY = "(read only)"


def write_class(
    entries: Sequence[Entry], course: Course, output: Path
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything, and say what could not be entered.

    ``overrides.csv`` is made where it is not there, and never written over.

    Parameters
    ----------
    entries : sequence of Entry
        Those of the people in the course's register first, in its order.

    Returns
    -------
    written : tuple of Path
    notes : tuple of str

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    title = course.title or course.rubric.title or "Class"
    stems = file_names([_identity(entry, stem=True) for entry in entries])
    page_entries = [
        _add_file_names(entry, stem, output) for entry, stem in zip(entries, stems, strict=True)
    ]
    has_redrawn = any(entry.counting and entry.counting.redrawn_name for entry in page_entries)
    texts = [feedback_text(entry, title) for entry in entries]
    contents = {"class.csv": csv_text(entries).encode()}
    if course.anonymous:
        page_entries, names_table = _pseudonyms(page_entries, output / NAMES)
        contents[NAMES] = names_table.encode()
    made_with = f"px4fuse {metadata.version('px4fuse')}"
    contents["class.html"] = html_text(page_entries, title, made_with).encode()
    if not (output / OVERRIDES_NAME).exists():
        contents[OVERRIDES_NAME] = OVERRIDES_TEMPLATE.encode()
    for stem, text in zip(stems, texts, strict=True):
        contents[f"{FEEDBACK}/{stem}.txt"] = text.encode()
    notes: list[str] = []
    names = make_unique((sheet.path.name for sheet in course.worksheets), "{1}-{0}")
    for sheet, name in zip(course.worksheets, names, strict=True):
        filled_sheet, sheet_notes = fill_grades(
            sheet, entries, course.register, course.column, texts
        )
        contents[f"{GRADES}/{name}"] = filled_sheet.content()
        notes += sheet_notes
    write_all({output / name: content for name, content in contents.items()})
    folders = [REPORTS] * has_redrawn + [FEEDBACK] + [GRADES] * bool(course.worksheets)
    written = tuple(output / name for name in ("class.csv", "class.html", *folders, OVERRIDES_NAME))
    return written, tuple(notes)


def _identity(entry: Entry, stem: bool = False) -> str:
    """Id, or name, or the file: what stays the same over several runs."""
    file = entry.counting.submission if entry.counting else ""
    return entry.student_id or (Path(file).stem if stem else entry.student or file)


def _add_file_names(entry: Entry, stem: str, output: Path) -> Entry:
    """Add the place of the redrawn report, and write it there."""
    one = entry.counting
    if one is None or not one.sha256:
        return entry
    redrawn = output / RECORDS / f"{one.sha256}{REDRAWN_SUFFIX}"
    if not redrawn.exists():
        return entry
    name = f"{REPORTS}/{stem}.pdf"
    write_all({output / name: redrawn.read_bytes()})
    return replace(entry, counting=replace(one, redrawn_name=name))


def _pseudonyms(entries: Sequence[Entry], path: Path) -> tuple[list[Entry], str]:
    """Entries under other names, in the order of these, and the list of who is who.

    A second run keeps the pseudonyms of the first; their order says nothing of the names.
    """
    names_by_identity: dict[str, tuple[str, str]] = {}
    if path.exists():
        with own_files():
            sheet = read_sheet(path)
        for row in sheet.rows:
            name, identity, student = (sheet.cell(row, (t,)).removeprefix("'") for t in NAMES_HEAD)
            names_by_identity[identity] = name, student
    used_names = {name for name, _ in names_by_identity.values()}
    numbered = (f"Student {number:03}" for number in itertools.count(1))
    free = (name for name in numbered if name not in used_names)
    new = {
        identity: entry.student
        for entry in entries
        if (identity := _identity(entry)) not in names_by_identity
    }
    for identity in random.SystemRandom().sample(list(new), len(new)):
        names_by_identity[identity] = next(free), new[identity]
    ordered = sorted(names_by_identity.items(), key=lambda pair: pair[1])
    rows = (
        (name, neutralise_id(identity), neutralise_formulas(student))
        for identity, (name, student) in ordered
    )
    anonymous_entries = [
        anonymise_entry(entry, names_by_identity[_identity(entry)][0]) for entry in entries
    ]
    names_table = "\ufeff" + Sheet(path, NAMES_HEAD, tuple(rows)).text
    return sorted(anonymous_entries, key=lambda entry: entry.student), names_table


def anonymise_entry(entry: Entry, pseudonym: str) -> Entry:
    """What may be shown to others: states, points and the form, and no text that anybody wrote."""
    one = entry.counting
    if one is not None:
        one = GradedReport(
            "",
            "",
            "",
            replace(one.verdict, reasons=(), differences=()),
            tuple(replace(item, comment="") for item in one.items),
            pending=one.pending and "Its points are pending.",
            form=one.form,
            numbers=one.numbers,
            mistakes=one.mistakes,
        )
    return Entry(
        pseudonym,
        "",
        one,
        (),
        entry.handed_in,
        entry.late_s,
        entry.deduction,
        total=entry.total,
        of=entry.of,
        flags=("Flagged.",) * bool(entry.flags),
    )


# ------------------------------------------------------------------ the class table


def csv_text(entries: Sequence[Entry]) -> str:
    """Lay out a class as CSV, for Excel and LibreOffice.

    Points of the items are those that count, the instructor's where there are some.

    Returns
    -------
    str
        Begins with the byte order mark by which Excel knows UTF-8; lines end with CRLF. Write it
        without translating line ends.
    """
    items, numbers = columns(entries)
    head = tuple(map(neutralise_formulas, (*FIRST_COLUMNS, *items, *numbers, *LAST_COLUMNS)))
    rows = []
    for entry in entries:
        one = entry.counting
        points = {item.title: item.points for item in one.items} if one else {}
        row: list[str | float | None] = [
            one.submission if one else "",
            entry.student,
            None,
            one.status if one else "missing",
            one.counted if one else None,
            one.points if one and one.counted is None else None,
            entry.of,
            entry.deduction or None,
            entry.total,
            *map(points.get, items),
            *(one.numbers.get(title) if one else None for title in numbers),
            entry.handed_in,
            None if entry.late_s is None else entry.late_s / 3600.0,
            one.pending if one else "",
            entry.comment,
            LIST_SEPARATOR.join(entry.flags),
            LIST_SEPARATOR.join(other.submission for other in entry.others),
            LIST_SEPARATOR.join(one.verdict.reasons) if one else "",
            one.log_sha256 if one else "",
        ]
        cells = [
            neutralise_formulas(part) if isinstance(part, str) else number(part) for part in row
        ]
        cells[FIRST_COLUMNS.index("id")] = neutralise_id(entry.student_id)
        rows.append(tuple(cells))
    return "\ufeff" + Sheet(Path(), head, tuple(rows)).text


# ------------------------------------------------------------------ feedback


def feedback_text(entry: Entry, class_name: str = "") -> str:
    """Plain text for one student: points and why, what being late costs, and the instructor's word.

    Flags and remarks are for the instructor and are not in it.
    """
    graded = entry.counting
    reasons = (
        (text_of(one).rstrip(".") for one in graded.verdict.reasons[:MAX_REASONS]) if graded else ()
    )
    text = template("grading/feedback.j2").render(
        entry=entry,
        graded=graded,
        class_name=class_name,
        reasons="; ".join(filter(None, reasons)),
        final=TOTAL in entry.overrides,
        line=text_of,
        number=number,
        wrapped=_wrap_text,
    )
    return text.rstrip("\n") + "\n"


def _wrap_text(text: str, indent: str = "") -> str:
    return textwrap.fill(
        text,
        88,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


# ------------------------------------------------------------------ platforms' tables


def grade_column(sheet: Sheet, wanted: str) -> int:
    """Where the grade goes.

    Parameters
    ----------
    wanted : str
        Title of the column, of Canvas without its number; "" where there is only one.

    Raises
    ------
    SettingsError
        There is none, or several and none was named.
    """
    titles = {
        at: title
        for at, title in enumerate(sheet.head)
        if not any(READ_ONLY in row[at] for row in sheet.rows[:3])
    }
    grade_index = sheet.column(GRADE_TITLES)
    assignments = [at for at in titles if ASSIGNMENT_NUMBER.search(titles[at])]
    matching_columns = [
        at
        for at, title in titles.items()
        if normalise_text(wanted)
        in (normalise_text(title), normalise_text(ASSIGNMENT_NUMBER.sub("", title)))
    ]
    candidates = assignments if grade_index is None else [grade_index]
    # the title may be meant for another table than Moodle's
    if wanted and (matching_columns or sheet.column(("identifier",)) is None):
        candidates = matching_columns
    if len(candidates) == 1:
        return candidates[0]
    several = "several columns for the grade" if candidates else "no column for the grade"
    shown = (ASSIGNMENT_NUMBER.sub("", titles[at]) for at in assignments or titles)
    others = one_line(", ".join(one_line(title, 40) for title in shown), 300)
    raise SettingsError(f"{sheet.path}: {several}", f"Name one with --column: {others}.")


def fill_grades(
    sheet: Sheet, entries: Sequence[Entry], register: Register, column: str, feedback: Sequence[str]
) -> tuple[Sheet, tuple[str, ...]]:
    """Enter the grades of a class into a platform's table, and say what could not be entered.

    Parameters
    ----------
    entries : sequence of Entry
        The first ones of the people in ``register``, in its order.
    column : str
        As :func:`grade_column` takes it.
    feedback : sequence of str
        What the student of each entry reads.

    Raises
    ------
    SettingsError
        From :func:`grade_column`.
    """
    student_index, comments = grade_column(sheet, column), sheet.column(COMMENT_TITLES)
    as_read = neutralise_formulas if sheet.column(HTML_COMMENT_TITLES) is None else as_html
    cells = [list(row) for row in sheet.rows]
    names = [one_line(entry.student or entry.student_id, 40) for entry in entries]
    comma = any(re.fullmatch(r"\d+,\d+", cell.strip()) for row in cells for cell in row)
    notes, found_people = [], set()
    for row in cells:
        person = read_student(sheet, row)
        at = register.student_index(person) if person else None
        if at is None:
            continue
        found_people.add(at)
        total = entries[at].total
        if total is None:
            continue
        max_points = _max_points(sheet, row, student_index)
        if max_points is not None and total > max_points:
            notes.append(
                f"{sheet.path.name}: {number(total)} points of {names[at]} are more than "
                f"the platform's {number(max_points)}, and will not be taken: change its maximum."
            )
        row[student_index] = number(total).replace(".", "," if comma else ".")
        if comments is not None and comments != student_index:
            row[comments] = as_read(feedback[at])
    missing_names = [
        names[at]
        for at in range(len(register.people))
        if at not in found_people and entries[at].total is not None
    ]
    if missing_names:
        notes.append(f"{sheet.path.name}: it has no row for {join_first(missing_names, 4)}.")
    return replace(sheet, rows=tuple(map(tuple, cells))), tuple(notes)


def _max_points(sheet: Sheet, row: Sequence[str], student_index: int) -> float | None:
    """The most points that the platform takes, where the table says it."""
    possible = (
        one[student_index] for one in sheet.rows[:3] if "points possible" in one[0].casefold()
    )
    return decimal(next(possible, sheet.cell(row, MAX_GRADE_TITLES)))


def as_html(text: str) -> str:
    r"""Plain text for a field that is shown as HTML, in which nothing of it is markup.

    >>> as_html("a <b>\n 1")
    'a &lt;b&gt;<br>&nbsp;1'
    """
    lines = html.escape(text, quote=False).rstrip("\n").split("\n")
    return "<br>".join(re.sub(r"^ +", lambda m: "&nbsp;" * len(m[0]), line) for line in lines)
