"""The class list that a learning platform exports."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.assignment.key import MAX_STUDENTS
from px4fuse.assignment.sheet import Sheet, read_sheet
from px4fuse.errors import SettingsError
from px4fuse.results.reading import one_line

MAX_NAME = 200
# A file system takes 255 bytes, and a character up to 4
MAX_STEM = 48
RESERVED = {"con", "prn", "aux", "nul"} | {f"{n}{i}" for n in ("com", "lpt") for i in range(10)}
# Column titles, letters and digits only, best first. The university's own id; Canvas's "ID",
# Moodle's "Identifier" and ILIAS's "User ID" are the platform's and stand below
ID_COLUMNS = (
    "studentid", "studentnumber", "studentno", "idnumber", "matriculationnumber", "matriculation",
    "matrikelnummer", "matrikelnr", "orgdefinedid", "sisuserid", "sid", "id", "number",
)  # fmt: skip
LOGIN_COLUMNS = ("username", "login", "sisloginid", "loginid", "user", "benutzername")
EMAIL_COLUMNS = ("emailaddress", "email", "mail", "emailadresse")
NAME_COLUMNS = ("name", "fullname", "studentname", "displayname", "student")
FIRST_NAME_COLUMNS = ("firstname", "givenname", "forename", "vorname")
LAST_NAME_COLUMNS = ("lastname", "surname", "familyname", "nachname")


@dataclass(frozen=True)
class RosterStudent:
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


def read_roster(path: Path) -> tuple[RosterStudent, ...]:
    """Read the class list that a learning platform exports: a CSV file with a header.

    Raises
    ------
    SettingsError
        It cannot be read, has no column of ids, or an id is missing or stands there twice.
    """
    sheet = read_sheet(path)
    # platforms export columns that nobody filled in
    every = (*ID_COLUMNS, "userid", *LOGIN_COLUMNS, *EMAIL_COLUMNS)
    listed = [title for title in every if sheet.column((title,)) is not None]
    filled = [one for one in listed if any(sheet.cell(row, (one,)) for row in sheet.rows)]
    if not listed:
        raise SettingsError(
            f"{path}: no column of ids. The first row must name the columns; call one 'student id' "
            "and, if you like, one 'name'."
        )
    column = (filled or listed)[:1]
    students: list[RosterStudent] = []
    row_of: dict[str, int] = {}
    for number, row in zip(sheet.numbers, sheet.rows, strict=True):
        student_id = one_line(sheet.cell(row, column), MAX_NAME)
        if not student_id:
            title = sheet.head[sheet.column(column) or 0].strip()
            raise SettingsError(
                f"{path}: row {number} has no id in the column {title!r}. Give every "
                "student one, or delete the row."
            )
        stem = file_stem(student_id)
        shown = repr(one_line(student_id, 40))
        if stem is None:
            raise SettingsError(
                f"{path}: row {number}: the id {shown} has neither letters nor digits, so that no "
                "file can be named after it."
            )
        other = row_of.setdefault(stem.casefold(), number)
        if other != number:
            raise SettingsError(
                f"{path}: rows {other} and {number} have the same id {shown}, or ids that give the "
                "same file name. Give every student one of its own."
            )
        students.append(RosterStudent(student_id, full_name(sheet, row), f"{stem}.ulg"))
    if not students:
        raise SettingsError(f"{path}: no students below the header. Give one row for each.")
    if len(students) > MAX_STUDENTS:
        raise SettingsError(
            f"{path}: {len(students)} students are too many (at most {MAX_STUDENTS}). Split the "
            "roster."
        )
    return tuple(students)


def full_name(sheet: Sheet, row: Sequence[str]) -> str:
    """A student's name, from one column or from two."""
    parts = (sheet.cell(row, titles) for titles in (FIRST_NAME_COLUMNS, LAST_NAME_COLUMNS))
    whole = sheet.cell(row, NAME_COLUMNS) or " ".join(filter(None, parts))
    return one_line(whole, MAX_NAME)


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
