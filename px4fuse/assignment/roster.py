"""The class list that a learning platform exports."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.assignment.key import MAX_STUDENTS
from px4fuse.errors import SettingsError
from px4fuse.reading import read_whole

MAX_ROSTER_BYTES = 5_000_000
MAX_NAME = 200
# A file system takes 255 bytes, and a character up to 4
MAX_STEM = 48
RESERVED = {"con", "prn", "aux", "nul"} | {f"{n}{i}" for n in ("com", "lpt") for i in range(10)}
# Column titles, letters only, best first: those of Moodle, Canvas, Blackboard, Brightspace, ILIAS
ID_COLUMNS = (
    "studentid", "studentnumber", "studentno", "idnumber", "matriculationnumber", "matriculation",
    "matrikelnummer", "orgdefinedid", "sisuserid", "sid", "id", "number", "userid", "username",
    "user", "login", "loginid", "sisloginid", "emailaddress", "email", "mail",
)  # fmt: skip
NAME_COLUMNS = ("name", "fullname", "studentname", "displayname", "student")
FIRST_NAME_COLUMNS = ("firstname", "givenname", "forename", "vorname")
LAST_NAME_COLUMNS = ("lastname", "surname", "familyname", "nachname")


@dataclass(frozen=True)
class Student:
    """One row of the roster.

    Attributes
    ----------
    id, name : str
        As they stand there.
    file : str
        Name of the student's log: the id, as far as a file system takes it.
    """

    id: str
    name: str
    file: str


def read_roster(path: Path) -> tuple[Student, ...]:
    """Read the class list that a learning platform exports: a CSV file with a header.

    Raises
    ------
    SettingsError
        It cannot be read, has no column of ids, or an id is missing or stands there twice.
    """
    lines = _rows(path)
    ids, names, first, last = _columns(path, lines)
    students: list[Student] = []
    row_of: dict[str, int] = {}
    for number, cells in lines[1:]:

        def cell(column: int | None, cells: list[str] = cells) -> str:
            inside = column is not None and column < len(cells)
            return _clean(cells[column]) if inside and column is not None else ""

        student_id = cell(ids)
        if not student_id:
            raise SettingsError(
                f"{path}: row {number} has no id in the column {lines[0][1][ids].strip()!r}. "
                "Give every student one, or delete the row."
            )
        stem = file_stem(student_id)
        if stem is None:
            raise SettingsError(
                f"{path}: row {number}: the id {_short(student_id)} has neither letters nor "
                "digits, so that no file can be named after it."
            )
        other = row_of.setdefault(stem.casefold(), number)
        if other != number:
            raise SettingsError(
                f"{path}: rows {other} and {number} have the same id {_short(student_id)}, or ids "
                "that give the same file name. Give every student one of its own."
            )
        whole = cell(names) or " ".join(part for part in (cell(first), cell(last)) if part)
        students.append(Student(student_id, whole, f"{stem}.ulg"))
    if not students:
        raise SettingsError(f"{path}: no students below the header. Give one row for each.")
    if len(students) > MAX_STUDENTS:
        raise SettingsError(
            f"{path}: {len(students)} students are too many (at most {MAX_STUDENTS}). Split the "
            "roster."
        )
    return tuple(students)


def file_stem(student_id: str) -> str | None:
    """An id as the name of a file on any system; None where nothing of it is left.

    >>> file_stem("s01/2026"), file_stem("../../x"), file_stem("nul"), file_stem("=;")
    ('s01_2026', '_.._x', '_nul', None)
    """
    text = unicodedata.normalize("NFC", student_id.strip())
    kept = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in text)
    if not any(c.isalnum() for c in kept):
        return None
    stem = kept[:MAX_STEM].lstrip(".-+@").rstrip(".")
    return f"_{stem}" if stem.split(".")[0].casefold() in RESERVED else stem


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Rows that are not empty, with their numbers; the first is the header."""
    content = read_whole(
        path,
        SettingsError,
        MAX_ROSTER_BYTES,
        name=str(path),
        smaller="Give a CSV file with one row per student",
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path}: a spreadsheet. Save it as CSV.")
    text = _decoded(content)
    if "\0" in text:
        raise SettingsError(f"{path}: not text. Give a CSV file with a header.")
    header = next((line for line in text.splitlines() if line.strip()), "")
    # quoted cells may hold any of them
    bare = Counter(re.sub(r'"[^"]*"', "", header))
    delimiter = max(",;\t|", key=lambda mark: bare[mark])
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        rows = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise SettingsError(f"{path}: not a CSV file ({error}).") from error
    return [(number, cells) for number, cells in rows if any(map(str.strip, cells))]


def _decoded(content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # as spreadsheets on Windows save it
        return content.decode("cp1252", errors="replace")


def _columns(
    path: Path, lines: list[tuple[int, list[str]]]
) -> tuple[int, int | None, int | None, int | None]:
    """Where id, name, first name and last name stand."""
    titles = ["".join(filter(str.isalpha, t.casefold())) for t in (lines[0][1] if lines else [])]

    def found(names: Sequence[str]) -> list[int]:
        return [titles.index(name) for name in names if name in titles]

    candidates = found(ID_COLUMNS)
    if not candidates:
        raise SettingsError(
            f"{path}: no column of ids. The first row must name the columns; call one 'student id' "
            "and, if you like, one 'name'."
        )
    # platforms export columns that nobody filled in
    filled = [c for c in candidates if any(c < len(row) and row[c].strip() for _, row in lines[1:])]
    names = (found(NAME_COLUMNS), found(FIRST_NAME_COLUMNS), found(LAST_NAME_COLUMNS))
    whole, first, last = (columns[0] if columns else None for columns in names)
    return (filled or candidates)[0], whole, first, last


def _clean(text: str) -> str:
    """A cell without control characters; what looks like a formula stays the text that it is."""
    kept = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in text)
    return " ".join(kept.split())[:MAX_NAME]


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:39] + "…")
