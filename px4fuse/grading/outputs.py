"""Output files of grading: class table and page, redrawn reports, feedback, platform tables.

Tables exported by a platform are returned with the grade and, if they have a column for it, the
feedback; all other cells stay. Rows of students without a grade (pending, or no submission) are not
changed: a platform reads an empty cell as "delete", and zero as a grade.

- Moodle: "Using Assignment", Offline grading worksheet, docs.moodle.org.
  ``mod/assign/feedback/offline/importgradeslib.php`` finds "Identifier" ("Participant 12"), "Grade"
  and "Last modified (grade)" by their titles, reads "Feedback comments" as HTML, ignores grades
  above "Maximum Grade", and reads numbers in the language of the site.
- Canvas: "How do I import grades in the Gradebook?", Instructor Guide: the exported gradebook, with
  Student, ID, SIS User ID, SIS Login ID, Section, and ``Title (12345)`` for an assignment. Columns
  marked "(read only)" in the row "Points Possible" are ignored.
- Others: a table with a column of ids, logins, emails or names, and a grade column, with the given
  title or one of :data:`GRADE_TITLES`.
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
from px4fuse.input_files import inputs_not_registered
from px4fuse.results.reading import one_line
from px4fuse.spreadsheet import neutralise_formulas, neutralise_id
from px4fuse.text import join_first
from px4fuse.webpage.safe import load_template
from px4fuse.writing import write_all

# folder of the reports redrawn from the logs, to be read instead of the handed-in PDFs
REPORTS = "reports"
FEEDBACK = "feedback"
GRADES = "grades"
NAMES = "names.csv"
NAMES_HEAD = ("pseudonym", "id", "name")
# columns of the class table before and after those of items and numbers
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
# number of reasons in a sentence
MAX_REASONS = 4
# column titles of platform tables
GRADE_TITLES = ("grade", "bewertung", "points", "punkte", "mark", "note", "score")
MAX_GRADE_TITLES = ("maximumgrade", "hoechstebewertung", "höchstebewertung")
# column titles of feedback: read as HTML, or as text
HTML_COMMENT_TITLES = ("feedbackcomments", "feedbackalskommentar")
COMMENT_TITLES = (*HTML_COMMENT_TITLES, "feedbacktolearner", "feedback", "comment")
ASSIGNMENT_NUMBER = re.compile(r" \(\d+\)$")
# mark of columns that Canvas computes; never changed
READ_ONLY = "(read only)"


def write_class(
    entries: Sequence[Entry], course: Course, output: Path
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write all output files; return them, and notes on grades that could not be entered.

    ``overrides.csv`` is created if it does not exist, and never overwritten.

    Parameters
    ----------
    entries : sequence of Entry
        Entries of the students in the course's register first, in its order.

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
    """Return id, name or file: an identity that stays the same in later runs."""
    file = entry.counting.submission if entry.counting else ""
    return entry.student_id or (Path(file).stem if stem else entry.student or file)


def _add_file_names(entry: Entry, stem: str, output: Path) -> Entry:
    """Copy the redrawn report of an entry to the output folder, and add its path."""
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
    """Replace names by pseudonyms, and sort by them; return the entries and the list of names.

    A later run keeps the pseudonyms. Their order is random.
    """
    names_by_identity: dict[str, tuple[str, str]] = {}
    if path.exists():
        with inputs_not_registered():
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
    """Reduce an entry to status, points and form, without texts, under a pseudonym."""
    one = entry.counting
    if one is not None:
        one = GradedReport(
            "",
            "",
            "",
            replace(one.verdict, reasons=(), differences=()),
            tuple(replace(item, comment="") for item in one.items),
            pending=one.pending and "Points are pending.",
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
    """Format the class as CSV, for Excel and LibreOffice; points include overrides.

    Returns
    -------
    str
        Begins with the byte order mark by which Excel detects UTF-8; lines end with CRLF. Write
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
    """Format the feedback for one student: points, late deduction, instructor's comment.

    Flags are not included.
    """
    graded = entry.counting
    reasons = (
        (text_of(one).rstrip(".") for one in graded.verdict.reasons[:MAX_REASONS]) if graded else ()
    )
    text = load_template("grading/feedback.j2").render(
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


# ------------------------------------------------------------------ platform tables


def grade_column(sheet: Sheet, wanted: str) -> int:
    """Find the grade column of a platform table.

    Parameters
    ----------
    wanted : str
        Title of the column, in Canvas without its number; "" if there is only one.

    Raises
    ------
    SettingsError
        No column matches, or several without a given title.
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
    # for Moodle a title that does not match is ignored: it may be of another table
    if wanted and (matching_columns or sheet.column(("identifier",)) is None):
        candidates = matching_columns
    if len(candidates) == 1:
        return candidates[0]
    problem = "several grade columns" if candidates else "no grade column"
    shown = (ASSIGNMENT_NUMBER.sub("", titles[at]) for at in assignments or titles)
    others = one_line(", ".join(one_line(title, 40) for title in shown), 300)
    raise SettingsError(f"{sheet.path}: {problem}.", f"Name one with --column: {others}.")


def fill_grades(
    sheet: Sheet, entries: Sequence[Entry], register: Register, column: str, feedback: Sequence[str]
) -> tuple[Sheet, tuple[str, ...]]:
    """Enter the grades of a class into a platform table; return notes on those that do not fit.

    Parameters
    ----------
    entries : sequence of Entry
        Entries of the students in ``register`` first, in its order.
    column : str
        See :func:`grade_column`.
    feedback : sequence of str
        Feedback of each entry.

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
                f"{sheet.path.name}: {names[at]} has {number(total)} points, above the maximum of "
                f"the platform ({number(max_points)}). Increase the maximum on the platform."
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
        notes.append(f"{sheet.path.name}: no row for {join_first(missing_names, 4)}.")
    return replace(sheet, rows=tuple(map(tuple, cells))), tuple(notes)


def _max_points(sheet: Sheet, row: Sequence[str], student_index: int) -> float | None:
    """Return the maximum points of the platform, if the table contains them."""
    possible = (
        one[student_index] for one in sheet.rows[:3] if "points possible" in one[0].casefold()
    )
    return decimal(next(possible, sheet.cell(row, MAX_GRADE_TITLES)))


def as_html(text: str) -> str:
    r"""Escape plain text for a field that is shown as HTML, with line breaks and indentation.

    >>> as_html("a <b>\n 1")
    'a &lt;b&gt;<br>&nbsp;1'
    """
    lines = html.escape(text, quote=False).rstrip("\n").split("\n")
    return "<br>".join(re.sub(r"^ +", lambda m: "&nbsp;" * len(m[0]), line) for line in lines)
