"""What grading a class writes: table, page, redrawn reports, feedback, and platforms' tables."""

from __future__ import annotations

import hashlib
import itertools
import random
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TypeVar

from px4fuse.assignment.roster import distinct, file_names
from px4fuse.assignment.sheet import Sheet, read_sheet
from px4fuse.flight import Unavailable
from px4fuse.grading import exports
from px4fuse.grading.anonymous import hidden_words
from px4fuse.grading.class_page import html_text
from px4fuse.grading.class_table import csv_text
from px4fuse.grading.entries import Course
from px4fuse.grading.feedback import returned_text
from px4fuse.grading.model import Entry
from px4fuse.grading.overrides import NAME, TEMPLATE
from px4fuse.grading.records import HANDED_IN, RECORDS, REDRAWN, file_of
from px4fuse.grading.roster import Register
from px4fuse.spreadsheet import neutral, neutral_id
from px4fuse.verification.pages import page_pictures
from px4fuse.verification.workers import run_bounded
from px4fuse.writing import write_all

# Reports drawn again from their logs: what to read instead of what was handed in
REPORTS = "reports"
# Pictures of their pages, for the class page, in files that it loads when a row is unfolded: three
# hundred reports have a hundred megabytes of them. Files are named by what they show, so that none
# is drawn twice and none says whose it is
SHEETS = "pages"
FEEDBACK = "feedback"
GRADES = "grades"
NAMES = "names.csv"
NAMES_HEAD = ("pseudonym", "id", "name")
# What a picture looks like besides its report; a change draws all anew
DRAWN_AS = "700 px, 16 colours"
# What the pictures are called; nothing else in their folder is ever deleted
NAMED = re.compile(r"([0-9a-f]{16})-\d{3}-of-\d{3}\.png")

Key = TypeVar("Key")
# A redrawn report, and the words that its pictures must not show
Redrawn = tuple[Path, Sequence[str]]


def write_class(
    entries: Sequence[Entry],
    register: Register,
    course: Course,
    title: str,
    output: Path,
    processes: int | None = None,
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
    shown = _with_sheets(shown, output, course.anonymous, processes)
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
    folders = [REPORTS, SHEETS] * drawn + [FEEDBACK] + [GRADES] * bool(course.worksheets)
    written = tuple(output / name for name in ("class.csv", "class.html", *folders, NAME))
    return written, tuple(notes)


def _identity(entry: Entry, stem: bool = False) -> str:
    """Id, or name, or the file: what stays the same over several runs."""
    file = entry.counting.submission if entry.counting else ""
    return entry.student_id or (Path(file).stem if stem else entry.student or file)


def _with_files(entry: Entry, stem: str, output: Path) -> Entry:
    """With the redrawn report in its folder, and the picture of what was handed in."""
    one = entry.counting
    if one is None or not one.sha256:
        return entry
    handed_in, redrawn = (
        path.read_bytes() if path.is_file() else b""
        for path in (file_of(output / RECORDS, one.sha256, end) for end in (HANDED_IN, REDRAWN))
    )
    name = f"{REPORTS}/{stem}.pdf" if redrawn else ""
    if redrawn:
        write_all({output / name: redrawn})
    return replace(entry, counting=replace(one, handed_in=handed_in, redrawn_name=name))


def _with_sheets(
    entries: Sequence[Entry], output: Path, anonymous: bool, processes: int | None
) -> list[Entry]:
    """With pictures of every page of the redrawn reports that count."""
    counting = {at: one for at, entry in enumerate(entries) if (one := entry.counting)}
    reports = {
        at: (output / one.redrawn_name, hidden_words(entries[at], one) if anonymous else ())
        for at, one in counting.items()
        if one.redrawn_name
    }
    made = list(entries)
    for at, drawn in draw_sheets(reports, output / SHEETS, processes).items():
        sheets = tuple(f"{SHEETS}/{name}" for name in drawn)
        made[at] = replace(entries[at], counting=replace(counting[at], sheets=sheets))
    return made


def _pseudonyms(entries: Sequence[Entry], path: Path) -> tuple[list[Entry], str]:
    """Entries under other names, and the list of who is who.

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
    made = [replace(entry, pseudonym=kept[_identity(entry)][0]) for entry in entries]
    return made, "\ufeff" + Sheet(path, NAMES_HEAD, tuple(rows)).text


# ------------------------------------------------------------------ pictures of pages


def draw_sheets(
    reports: Mapping[Key, Redrawn], folder: Path, processes: int | None = None
) -> dict[Key, tuple[str, ...]]:
    """Draw the pages of reports that are not drawn yet, in processes of their own.

    Pictures that it drew before of reports that are no longer among these are deleted.

    Parameters
    ----------
    reports : mapping
        Key to the redrawn PDF, and the words that its pictures must not show.
    processes : int, optional
        By default as many as there are cores.

    Returns
    -------
    dict
        Key to names of files in the folder, page by page; empty for what cannot be drawn.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    stems = {key: _stem(report) for key, report in reports.items()}
    missing = [reports[key] for key, stem in stems.items() if not _drawn(folder, stem)]
    for _ in run_bounded(partial(draw, folder=folder), missing, processes=processes):
        pass
    for path in folder.glob("*.png"):
        named = NAMED.fullmatch(path.name)
        if named and named[1] not in stems.values():
            path.unlink(missing_ok=True)
    return {key: _drawn(folder, stem) for key, stem in stems.items()}


def draw(report: Redrawn, folder: Path) -> None:
    """Write the pictures of one report, if it can be drawn."""
    pdf, hide = report
    drawn = page_pictures(pdf.read_bytes(), hide)
    if not isinstance(drawn, Unavailable):
        names = f"{_stem(report)}-{{:03}}-of-{len(drawn):03}.png"
        write_all({folder / names.format(at): made for at, made in enumerate(drawn, start=1)})


def _stem(report: Redrawn) -> str:
    """By which the pictures of a report are known."""
    pdf, hide = report
    made = hashlib.sha256(pdf.read_bytes())
    made.update("\0".join((DRAWN_AS, *hide)).encode("utf-8", "replace"))
    return made.hexdigest()[:16]


def _drawn(folder: Path, stem: str) -> tuple[str, ...]:
    """What is there of a report, if all of it is."""
    names = sorted(path.name for path in folder.glob(f"{stem}-*-of-*.png"))
    whole = bool(names) and names[0].endswith(f"-of-{len(names):03}.png")
    return tuple(names) if whole else ()
