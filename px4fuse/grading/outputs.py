"""What grading a class writes: table, page, redrawn reports, feedback, and platforms' tables."""

import itertools
import random
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from px4fuse.assignment.roster import Register, distinct, file_names
from px4fuse.assignment.sheet import Sheet, read_sheet
from px4fuse.grading import exports
from px4fuse.grading.class_page import html_text
from px4fuse.grading.class_table import csv_text
from px4fuse.grading.entries import Course
from px4fuse.grading.feedback import returned_text
from px4fuse.grading.model import Entry, Graded
from px4fuse.grading.overrides import NAME, TEMPLATE
from px4fuse.grading.records import HANDED_IN, PAGE, RECORDS, REDRAWN, file_of
from px4fuse.spreadsheet import neutral, neutral_id
from px4fuse.writing import write_all

# Reports drawn again from their logs: what to read instead of what was handed in
REPORTS = "reports"
FEEDBACK = "feedback"
GRADES = "grades"
NAMES = "names.csv"
NAMES_HEAD = ("pseudonym", "id", "name")


def write_class(
    entries: Sequence[Entry],
    register: Register,
    course: Course,
    title: str,
    output: Path,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything, and say what could not be entered.

    ``overrides.csv`` is made where it is not there, and never written over.

    Parameters
    ----------
    register : Register
        Its people are those of the first entries.

    Returns
    -------
    written : tuple of Path
    notes : tuple of str

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    stems = file_names([_identity(entry, stem=True) for entry in entries])
    shown = [_with_files(entry, stem, output) for entry, stem in zip(entries, stems, strict=True)]
    drawn = any(entry.counting and entry.counting.redrawn_name for entry in shown)
    texts = [returned_text(entry, title) for entry in entries]
    contents = {"class.csv": csv_text(entries).encode()}
    if course.anonymous:
        shown, listed = _pseudonyms(shown, output / NAMES)
        contents[NAMES] = listed.encode()
    made_with = f"px4fuse {metadata.version('px4fuse')}"
    contents["class.html"] = html_text(shown, title, made_with).encode()
    if not (output / NAME).exists():
        contents[NAME] = TEMPLATE.encode()
    for stem, text in zip(stems, texts, strict=True):
        contents[f"{FEEDBACK}/{stem}.txt"] = text.encode()
    notes: list[str] = []
    names = distinct((sheet.path.name for sheet in course.worksheets), "{1}-{0}")
    for sheet, name in zip(course.worksheets, names, strict=True):
        made, said = exports.filled(sheet, entries, register, course.column, texts)
        contents[f"{GRADES}/{name}"] = made.content()
        notes += said
    write_all({output / name: content for name, content in contents.items()})
    folders = [REPORTS] * drawn + [FEEDBACK] + [GRADES] * bool(course.worksheets)
    written = tuple(output / name for name in ("class.csv", "class.html", *folders, NAME))
    return written, tuple(notes)


def _identity(entry: Entry, stem: bool = False) -> str:
    """Id, or name, or the file: what stays the same over several runs."""
    file = entry.counting.submission if entry.counting else ""
    return entry.student_id or (Path(file).stem if stem else entry.student or file)


def _with_files(entry: Entry, stem: str, output: Path) -> Entry:
    """With the redrawn report in its folder, and where the pictures of the pages stand."""
    one = entry.counting
    if one is None or not one.sha256:
        return entry

    def there(end: str) -> str:
        path = file_of(output / RECORDS, one.sha256, end)
        return f"{RECORDS}/{path.name}" if path.exists() else ""

    name = f"{REPORTS}/{stem}.pdf" if (redrawn := there(REDRAWN)) else ""
    if name:
        write_all({output / name: (output / redrawn).read_bytes()})
    sheets = tuple(itertools.takewhile(bool, map(there, map(PAGE.format, itertools.count(1)))))
    shown = replace(one, handed_in=there(HANDED_IN), redrawn_name=name, sheets=sheets)
    return replace(entry, counting=shown)


def _pseudonyms(entries: Sequence[Entry], path: Path) -> tuple[list[Entry], str]:
    """Entries under other names, in the order of these, and the list of who is who.

    A second run keeps the pseudonyms of the first; their order says nothing of the names.
    """
    kept: dict[str, tuple[str, str]] = {}
    if path.exists():
        sheet = read_sheet(path)
        for row in sheet.rows:
            name, who, student = (sheet.cell(row, (t,)).removeprefix("'") for t in NAMES_HEAD)
            kept[who] = name, student
    taken = {name for name, _ in kept.values()}
    numbered = (f"Student {number:03}" for number in itertools.count(1))
    free = (name for name in numbered if name not in taken)
    new = {who: entry.student for entry in entries if (who := _identity(entry)) not in kept}
    for who in random.SystemRandom().sample(list(new), len(new)):
        kept[who] = next(free), new[who]
    ordered = sorted(kept.items(), key=lambda pair: pair[1])
    rows = ((name, neutral_id(who), neutral(student)) for who, (name, student) in ordered)
    made = [nameless(entry, kept[_identity(entry)][0]) for entry in entries]
    listed = "\ufeff" + Sheet(path, NAMES_HEAD, tuple(rows)).text
    return sorted(made, key=lambda entry: entry.student), listed


def nameless(entry: Entry, pseudonym: str) -> Entry:
    """What may be shown to others: states, points and the form, and no text that anybody wrote."""
    one = entry.counting
    if one is not None:
        one = Graded(
            "", "", "", replace(one.verdict, reasons=(), differences=()),
            tuple(replace(item, comment="") for item in one.items),
            pending=one.pending and "Its points are pending.",
            form=one.form, numbers=one.numbers, mistakes=one.mistakes,
        )  # fmt: skip
    return Entry(
        pseudonym, "", one, (), entry.handed_in, entry.late_s, entry.deduction,
        total=entry.total, of=entry.of, flags=("Flagged.",) * bool(entry.flags),
    )  # fmt: skip
