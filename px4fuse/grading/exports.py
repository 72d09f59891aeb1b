"""Grades as learning platforms import them: their own tables, filled in.

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
  title is given or one of :data:`GRADE`.
"""

import html
import re
from collections.abc import Sequence
from dataclasses import replace

from px4fuse.assignment.roster import Register, folded, person_of_row
from px4fuse.assignment.sheet import Sheet, decimal, number
from px4fuse.errors import SettingsError
from px4fuse.grading.model import Entry
from px4fuse.plain import few_words
from px4fuse.results.reading import one_line
from px4fuse.spreadsheet import neutral

GRADE = ("grade", "bewertung", "points", "punkte", "mark", "note", "score")
MAX_GRADE = ("maximumgrade", "hoechstebewertung", "höchstebewertung")
# Read as HTML, and read as text
HTML_COMMENTS = ("feedbackcomments", "feedbackalskommentar")
COMMENTS = (*HTML_COMMENTS, "feedbacktolearner", "feedback", "comment")
ASSIGNMENT = re.compile(r" \(\d+\)$")
# Never written into: of Canvas, what it computes
READ_ONLY = "(read only)"


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
    usual = sheet.column(GRADE)
    assignments = [at for at in titles if ASSIGNMENT.search(titles[at])]
    named = [at for at, title in titles.items()
             if folded(wanted) in (folded(title), folded(ASSIGNMENT.sub("", title)))]  # fmt: skip
    found = assignments if usual is None else [usual]
    # the title may be meant for another table than Moodle's
    if wanted and (named or sheet.column(("identifier",)) is None):
        found = named
    if len(found) == 1:
        return found[0]
    several = "several columns for the grade" if found else "no column for the grade"
    shown = (ASSIGNMENT.sub("", titles[at]) for at in assignments or titles)
    others = one_line(", ".join(one_line(title, 40) for title in shown), 300)
    raise SettingsError(f"{sheet.path}: {several}", f"Name one with --column: {others}.")


def filled(
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
    place, comments = grade_column(sheet, column), sheet.column(COMMENTS)
    as_read = neutral if sheet.column(HTML_COMMENTS) is None else as_html
    cells = [list(row) for row in sheet.rows]
    comma = any(re.fullmatch(r"\d+,\d+", cell.strip()) for row in cells for cell in row)
    notes, seen = [], set()
    for row in cells:
        person = person_of_row(sheet, row)
        at = register.place(person) if person else None
        if at is None:
            continue
        seen.add(at)
        total = entries[at].total
        if total is None:
            continue
        most = _most(sheet, row, place)
        if most is not None and total > most:
            notes.append(
                f"{sheet.path.name}: {number(total)} points of {_who(entries[at])} are more than "
                f"the platform's {number(most)}, and will not be taken: change its maximum."
            )
        row[place] = number(total).replace(".", "," if comma else ".")
        if comments is not None and comments != place:
            row[comments] = as_read(feedback[at])
    left = [_who(entries[at]) for at in range(len(register.people))
            if at not in seen and entries[at].total is not None]  # fmt: skip
    if left:
        notes.append(f"{sheet.path.name}: it has no row for {few_words(left, 4)}.")
    return replace(sheet, rows=tuple(map(tuple, cells))), tuple(notes)


def _most(sheet: Sheet, row: Sequence[str], place: int) -> float | None:
    """The most points that the platform takes, where the table says it."""
    possible = (one[place] for one in sheet.rows[:3] if "points possible" in one[0].casefold())
    return decimal(next(possible, sheet.cell(row, MAX_GRADE)))


def _who(entry: Entry) -> str:
    return one_line(entry.student or entry.student_id, 40)


def as_html(text: str) -> str:
    r"""Plain text for a field that is shown as HTML, in which nothing of it is markup.

    >>> as_html("a <b>\n 1")
    'a &lt;b&gt;<br>&nbsp;1'
    """
    lines = html.escape(text, quote=False).rstrip("\n").split("\n")
    return "<br>".join(re.sub(r"^ +", lambda m: "&nbsp;" * len(m[0]), line) for line in lines)
