"""What grading a class writes: table, page, redrawn reports, feedback, and platforms' tables."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from px4fuse.assignment.sheet import read_sheet
from px4fuse.grading import exports, submissions
from px4fuse.grading.anonymous import hidden_words
from px4fuse.grading.class_page import html_text
from px4fuse.grading.class_table import csv_text
from px4fuse.grading.entries import Course
from px4fuse.grading.feedback import returned_text
from px4fuse.grading.model import Entry, Graded, Submission
from px4fuse.grading.names import distinct, file_names
from px4fuse.grading.overrides import NAME, TEMPLATE
from px4fuse.grading.records import HANDED_IN, REDRAWN, file_of
from px4fuse.grading.roster import Register
from px4fuse.grading.sheets import draw_sheets
from px4fuse.plain import few_words
from px4fuse.spreadsheet import neutral, neutral_id
from px4fuse.writing import write_all

# Reports drawn again from their logs: what to read instead of what was handed in
REPORTS = "reports"
# Pictures of their pages, and the students' own files, both for the class page
SHEETS = "pages"
ORIGINALS = "handed_in"
FEEDBACK = "feedback"
GRADES = "grades"
NAMES = "names.csv"
NAMES_HEAD = ("pseudonym", "id", "name")


def write_class(
    entries: Sequence[Entry],
    files: Mapping[str, Submission],
    register: Register,
    course: Course,
    title: str,
    output: Path,
    records: Path,
    processes: int | None = None,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything, and say what could not be entered.

    ``overrides.csv`` is made where it is not there, and never written over.

    Parameters
    ----------
    files : mapping
        Name of a submission to where it is read.
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
    names = file_names([_identity(entry, stem=True) for entry in entries])
    shown = [
        _with_files(entry, name, files, output, records)
        for entry, name in zip(entries, names, strict=True)
    ]
    shown = _with_sheets(shown, output, course.anonymous, processes)
    drawn = any(one.redrawn_name for entry in shown for one in entry.files)
    texts = [returned_text(entry, title) for entry in entries]
    contents = {"class.csv": csv_text(entries).encode()}
    if course.anonymous:
        shown, listed = _pseudonyms(shown, output / NAMES)
        contents[NAMES] = listed.encode()
    made_with = f"px4fuse {metadata.version('px4fuse')}"
    contents["class.html"] = html_text(shown, title, made_with).encode()
    if not (output / NAME).exists():
        contents[NAME] = TEMPLATE.encode()
    for name, text in zip(names, texts, strict=True):
        contents[f"{FEEDBACK}/{name}.txt"] = text.encode()
    notes: list[str] = []
    stems = distinct((sheet.path.stem for sheet in course.worksheets), "{}-{}")
    for sheet, stem in zip(course.worksheets, stems, strict=True):
        made, said = exports.filled(sheet, entries, register, course.column, texts)
        contents[f"{GRADES}/{stem}{sheet.path.suffix}"] = made.content()
        notes += said
    if moodle := exports.moodle_feedback(entries, files, texts):
        contents[f"{GRADES}/moodle_feedback.zip"] = moodle
    write_all({output / name: content for name, content in contents.items()})
    folders = [REPORTS, SHEETS] * drawn + [FEEDBACK]
    folders += [GRADES] * any(name.startswith(GRADES) for name in contents)
    written = tuple(output / name for name in ("class.csv", "class.html", *folders, NAME))
    return written, (*notes, *_left_over(output, names))


def _identity(entry: Entry, stem: bool = False) -> str:
    """Id, or name, or the file: what stays the same over several runs."""
    file = entry.counting.submission if entry.counting else ""
    return entry.student_id or (Path(file).stem if stem else entry.student or file)


def _with_files(
    entry: Entry, name: str, files: Mapping[str, Submission], output: Path, records: Path
) -> Entry:
    """With the redrawn reports, and what was handed in, in folders to read them."""

    def whole(one: Graded, stem: str) -> Graded:
        if not one.sha256:
            return one
        handed_in, redrawn = (
            _content(file_of(records, one.sha256, end)) for end in (HANDED_IN, REDRAWN)
        )
        where, original = f"{REPORTS}/{stem}.pdf", f"{ORIGINALS}/{stem}.pdf"
        if redrawn:
            write_all({output / where: redrawn})
        there = _copied(one, files[one.submission], output / original)
        return replace(
            one,
            handed_in=handed_in,
            redrawn_name=where if redrawn else "",
            handed_in_name=original if there else "",
        )

    others = (whole(one, f"{name}_other_{at}") for at, one in enumerate(entry.others, start=1))
    counting = whole(entry.counting, name) if entry.counting else None
    return replace(entry, counting=counting, others=tuple(others))


def _copied(one: Graded, submission: Submission, to: Path) -> bool:
    """Whether the student's own PDF stands where the class page leads to it."""
    if hashlib.sha256(_content(to)).hexdigest() == one.sha256:
        return True
    content = submissions.read(submission)
    if not isinstance(content, bytes) or not content.startswith(b"%PDF"):
        return False
    write_all({to: content})
    return True


def _with_sheets(
    entries: Sequence[Entry], output: Path, anonymous: bool, processes: int | None
) -> list[Entry]:
    """With pictures of every page of the redrawn reports that count."""
    reports = {
        one.redrawn_name: (
            output / one.redrawn_name,
            hidden_words(entry, one) if anonymous else (),
        )
        for entry in entries
        if (one := entry.counting) and one.redrawn_name
    }
    drawn = draw_sheets(reports, output / SHEETS, processes)
    made = []
    for entry in entries:
        if one := entry.counting:
            sheets = tuple(f"{SHEETS}/{name}" for name in drawn.get(one.redrawn_name, ()))
            entry = replace(entry, counting=replace(one, sheets=sheets))  # noqa: PLW2901
        made.append(entry)
    return made


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _pseudonyms(entries: Sequence[Entry], path: Path) -> tuple[list[Entry], str]:
    """Entries under other names, in their order, and the list of who is who.

    A second run keeps the pseudonyms of the first; their order says nothing of the names.
    """
    kept: dict[str, tuple[str, str]] = {}
    sheet = read_sheet(path) if path.exists() else None
    for row in sheet.rows if sheet else ():
        name, who, student = (sheet.cell(row, (title,)).removeprefix("'") for title in NAMES_HEAD)  # type: ignore[union-attr]
        kept[who] = name, student
    taken = {name for name, _ in kept.values()}
    numbered = (f"Student {number:03}" for number in itertools.count(1))
    free = (name for name in numbered if name not in taken)
    new = {who: entry.student for entry in entries if (who := _identity(entry)) not in kept}
    for who in random.SystemRandom().sample(list(new), len(new)):
        kept[who] = next(free), new[who]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(NAMES_HEAD)
    for who, (name, student) in sorted(kept.items(), key=lambda pair: pair[1]):
        writer.writerow((name, neutral_id(who), neutral(student)))
    made = [replace(entry, pseudonym=kept[_identity(entry)][0]) for entry in entries]
    return sorted(made, key=lambda entry: entry.pseudonym), "\ufeff" + out.getvalue()


def _left_over(output: Path, names: Sequence[str]) -> tuple[str, ...]:
    """What an earlier run wrote for others: never taken away, but told."""
    others = sorted(p.stem for p in (output / FEEDBACK).glob("*.txt") if p.stem not in names)
    if not others:
        return ()
    return (
        f"feedback also holds {len(others)} of an earlier run, which are not among "
        f"these submissions: {few_words(others, 4)}. Delete them if they are out of date.",
    )
