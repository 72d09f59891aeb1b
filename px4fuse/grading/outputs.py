"""What grading a class writes: table, page, redrawn reports, feedback, and platforms' tables."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

from px4fuse.assignment.sheet import read_sheet
from px4fuse.grading import exports, submissions
from px4fuse.grading.anonymous import hidden_words
from px4fuse.grading.class_page import html_text
from px4fuse.grading.class_table import csv_text
from px4fuse.grading.entries import Course
from px4fuse.grading.feedback import returned_text
from px4fuse.grading.gradescope import results
from px4fuse.grading.model import Entry, Graded, Submission
from px4fuse.grading.names import distinct, file_names
from px4fuse.grading.overrides import NAME, TEMPLATE
from px4fuse.grading.platforms import ExportOrigin, seen
from px4fuse.grading.records import HANDED_IN, REDRAWN, file_of
from px4fuse.grading.roster import Register
from px4fuse.grading.sheets import delete_others, draw_sheets
from px4fuse.plain import few_words
from px4fuse.spreadsheet import neutral, neutral_id
from px4fuse.verification.model import Refused
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


@dataclass(frozen=True)
class Class:
    """All that is written of a class.

    Attributes
    ----------
    register : Register
        Its people are those of the first entries.
    origins : mapping
        Name of a submission to where it came from.
    files : mapping
        Name of a submission to where it is read.
    """

    entries: tuple[Entry, ...]
    register: Register
    title: str
    course: Course
    origins: Mapping[str, ExportOrigin]
    files: Mapping[str, Submission]


def write_class(
    made: Class, output: Path, records: Path, processes: int | None = None
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write everything, and say what could not be entered.

    ``overrides.csv`` is made where it is not there, and never written over.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    names = file_names([_stem(entry) for entry in made.entries])
    written_out = [
        _with_files(entry, name, made, output, records)
        for entry, name in zip(made.entries, names, strict=True)
    ]
    pictured = _with_sheets(written_out, output, made.course.anonymous, processes)
    texts = {at: returned_text(entry, made.title) for at, entry in enumerate(made.entries)}
    table, page, said = output / "class.csv", output / "class.html", output / NAME
    contents = {table: csv_text(made.entries).encode()}
    if made.course.anonymous:
        pictured, listed = _pseudonyms(pictured, output / NAMES)
        contents[output / NAMES] = listed.encode()
    made_with = f"px4fuse {metadata.version('px4fuse')}"
    contents[page] = html_text(pictured, made.title, made_with).encode()
    if not said.exists():
        contents[said] = TEMPLATE.encode()
    for at, (entry, name) in enumerate(zip(made.entries, names, strict=True)):
        contents[output / FEEDBACK / f"{name}.txt"] = texts[at].encode()
        if entry.counting:
            found = json.dumps(results(entry, texts[at]), ensure_ascii=False, indent=2)
            contents[output / "gradescope" / name / "results.json"] = found.encode()
    grades, notes = _grades(made, texts)
    contents |= {output / GRADES / name: content for name, content in grades.items()}
    write_all(contents)
    drawn = {Path(name).name for entry in pictured for one in entry.files for name in one.sheets}
    delete_others(output / SHEETS, drawn)
    folders = [output / FEEDBACK, output / "gradescope"]
    if any(one.redrawn_name for entry in pictured for one in entry.files):
        folders = [output / REPORTS, output / SHEETS, *folders]
    written = (table, page, *folders, *([output / GRADES] if grades else []), said)
    return written, (*notes, *_left_over(output, names))


def _with_files(entry: Entry, name: str, made: Class, output: Path, records: Path) -> Entry:
    """With the redrawn reports, and what was handed in, in folders to read them."""

    def whole(one: Graded, stem: str) -> Graded:
        handed_in, redrawn = (
            _content(file_of(records, one.sha256, end)) if one.sha256 else b""
            for end in (HANDED_IN, REDRAWN)
        )
        where = f"{REPORTS}/{stem}.pdf" if redrawn else ""
        if redrawn:
            write_all({output / where: redrawn})
        original = f"{ORIGINALS}/{stem}.pdf"
        there = _copied(one, made.files.get(one.submission), output / original)
        return replace(
            one,
            handed_in=handed_in,
            redrawn_name=where,
            handed_in_name=original if there else "",
        )

    return replace(
        entry,
        counting=whole(entry.counting, name) if entry.counting else None,
        others=tuple(
            whole(one, f"{name}_other_{at}") for at, one in enumerate(entry.others, start=1)
        ),
    )


def _copied(one: Graded, submission: Submission | None, to: Path) -> bool:
    """Whether the student's own PDF stands where the class page leads to it."""
    if submission is None or not one.sha256:
        return False
    if hashlib.sha256(_content(to)).hexdigest() == one.sha256:
        return True
    content = submissions.read(submission)
    if isinstance(content, Refused) or not content.startswith(b"%PDF"):
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
        one = entry.counting
        names = drawn.get(one.redrawn_name, ()) if one else ()
        sheets = tuple(f"{SHEETS}/{name}" for name in names)
        made.append(replace(entry, counting=replace(one, sheets=sheets)) if one else entry)
    return made


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _pseudonyms(entries: Sequence[Entry], path: Path) -> tuple[list[Entry], str]:
    """Entries under other names, in their order, and the list of who is who.

    A second run keeps the pseudonyms of the first; their order says nothing of the names.
    """
    kept: dict[str, tuple[str, str]] = {}
    if path.exists():
        sheet = read_sheet(path)
        for row in sheet.rows:
            name, who, student = (
                sheet.cell(row, (title,)).removeprefix("'") for title in NAMES_HEAD
            )
            kept[who] = name, student
    identities = [one.student_id or one.student or _submission(one) for one in entries]
    taken = {name for name, _ in kept.values()}
    numbered = (f"Student {number:03}" for number in itertools.count(1))
    free = (name for name in numbered if name not in taken)
    new = [at for at, who in enumerate(identities) if who not in kept]
    random.SystemRandom().shuffle(new)
    kept |= {
        identities[at]: (name, entries[at].student) for at, name in zip(new, free, strict=False)
    }
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(NAMES_HEAD)
    for who, (name, student) in sorted(kept.items(), key=lambda pair: pair[1]):
        writer.writerow((name, neutral_id(who), neutral(student)))
    made = [
        replace(entry, pseudonym=kept[who][0])
        for entry, who in zip(entries, identities, strict=True)
    ]
    return sorted(made, key=lambda entry: entry.pseudonym), "\ufeff" + out.getvalue()


def _submission(entry: Entry) -> str:
    return entry.counting.submission if entry.counting else ""


def _grades(made: Class, texts: Mapping[int, str]) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """Files that a learning platform imports, by name, and what could not be entered."""
    contents: dict[str, bytes] = {}
    notes: list[str] = []
    names = distinct((sheet.path.stem for sheet in made.course.worksheets), "{}-{}")
    for sheet, name in zip(made.course.worksheets, names, strict=True):
        filled = exports.filled(sheet, made.entries, made.register, made.course.column, texts)
        contents[f"{name}{sheet.path.suffix}"] = filled.sheet.content()
        notes += filled.notes
    platforms = seen(made.origins.values())
    if "moodle" in platforms:
        contents["moodle_feedback.zip"] = exports.moodle_feedback(made.entries, made.origins, texts)
    for platform in ("blackboard", "ilias"):
        if platform in platforms:
            text = exports.plain_grades(
                platform, made.title, made.entries, made.origins, made.register, texts
            )
            contents[f"plain_{platform}.csv"] = text.encode()
    return contents, tuple(notes)


def _left_over(output: Path, names: Sequence[str]) -> tuple[str, ...]:
    """What an earlier run wrote for others: never taken away, but told."""
    others = sorted(p.stem for p in (output / FEEDBACK).glob("*.txt") if p.stem not in names)
    if not others:
        return ()
    return (
        f"feedback and gradescope also hold {len(others)} of an earlier run, which are not among "
        f"these submissions: {few_words(others, 4)}. Delete them if they are out of date.",
    )


def _stem(entry: Entry) -> str:
    return entry.student_id or (Path(entry.counting.submission).stem if entry.counting else "")
