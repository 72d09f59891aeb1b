"""Class list: students in the CSV tables of learning platforms (Moodle, Canvas, ...).

The reader detects the encoding (UTF-8, UTF-16, Windows-1252) and the separator.
"""

import codecs
import csv
import io
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from px4fuse.core.reading import read_bytes_limited
from px4fuse.core.record import read_toml
from px4fuse.core.text import shorten_to_line
from px4fuse.errors import SettingsError

MAX_TABLE_BYTES = 20_000_000
COLUMN_SEPARATORS = ",;\t|"
MAX_NAME_LENGTH = 200
MAX_STUDENTS = 1000
# Maximum length (characters) of a file name without suffix; operating systems allow 255 bytes
MAX_STEM_LENGTH = 48
# File names that Windows does not allow
WINDOWS_RESERVED_NAMES = {"con", "prn", "aux", "nul"} | {
    f"{n}{i}" for n in ("com", "lpt") for i in range(10)
}
COLUMN_TITLES_BY_FIELD = {
    field_name: titles.split()
    for field_name, titles in read_toml(__file__, dict[str, str], "columns.toml").items()
}
# Fields that are copied from other tables if the class list lacks them
FIELDS_FROM_OTHER_TABLES = ("name", "email", "login", "submission_time", "extended_due")
# Names in Canvas gradebooks that are not students ("Points Possible", "Student, Test")
NON_STUDENT_ROW_NAMES = ("pointspossible", "studenttest")


# ------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Sheet:
    """CSV table with a header (column titles)."""

    path: Path
    column_titles: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    encoding: str = "utf-8"
    separator: str = ","

    def find_column_index(self, titles: Sequence[str]) -> int | None:
        """Return the index of the column with the first matching title of ``titles``, or None."""
        plain_titles = [normalise_title(title) for title in self.column_titles]
        return next((plain_titles.index(title) for title in titles if title in plain_titles), None)

    def find_cell(self, row: Sequence[str], titles: Sequence[str]) -> str:
        """Return the cell in the column with the first matching title of ``titles``, or ""."""
        column_index = self.find_column_index(titles)
        return "" if column_index is None else row[column_index].strip()

    def content(self) -> bytes:
        """Return the table as a CSV file, with the original separator and encoding (or UTF-8)."""
        text = format_csv((self.column_titles, *self.rows), self.separator)
        try:
            return text.encode(self.encoding)
        except UnicodeEncodeError:  # Windows-1252 lacks some characters of the feedback
            return text.encode("utf-8-sig")


def format_csv(rows: Iterable[Iterable[str]], separator: str = ",") -> str:
    """Format a table as CSV (RFC 4180)."""
    csv_file = io.StringIO()
    csv.writer(csv_file, delimiter=separator).writerows(rows)
    return csv_file.getvalue()


def normalise_title(title: str) -> str:
    """Normalise a column title for comparison: lower-case letters and digits.

    >>> normalise_title("Last modified (grade)"), normalise_title("E-Mail-Adresse")
    ('lastmodifiedgrade', 'emailadresse')
    """
    return "".join(filter(str.isalnum, title.casefold()))


def read_csv_sheet(path: Path) -> Sheet:
    """Read a CSV table with a header.

    Raises
    ------
    SettingsError
        The file cannot be read, is not text, or has no header.
    """
    content = read_bytes_limited(
        path,
        SettingsError,
        MAX_TABLE_BYTES,
        name=str(path),
        remedy_if_too_large="Give a CSV table with the students of one class only.",
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path} is a spreadsheet, not a CSV file.", "Save the table as CSV.")
    encoding = "utf-8-sig" if content.startswith(codecs.BOM_UTF8) else "utf-8"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:  # spreadsheet programs on Windows write Windows-1252
        encoding = "cp1252"
        text = content.decode(encoding, errors="replace")
    csv_remedy = "Give a CSV file with a header."
    if "\0" in text:
        raise SettingsError(f"{path} is not a text file.", csv_remedy)
    header = next((line for line in text.splitlines() if line.strip()), "")
    # do not count separators in quoted column titles
    separator = max(COLUMN_SEPARATORS, key=re.sub(r'"[^"]*"', "", header).count)
    try:
        rows_of_cells = [
            *csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        ]
    except csv.Error as error:
        raise SettingsError(f"{path} is not a CSV file ({error}).") from error
    # the first row with a text is the header; [[]] gives an empty header for an empty file
    column_titles, *rows = [cells for cells in rows_of_cells if any(map(str.strip, cells))] or [[]]
    if not column_titles:
        raise SettingsError(f"{path} is empty.", csv_remedy)
    padded_rows = (tuple(cells + [""] * (len(column_titles) - len(cells))) for cells in rows)
    return Sheet(path, tuple(column_titles), tuple(padded_rows), encoding, separator)


def format_cell_number(value: float | None) -> str:
    """Format a number for a table cell; "" for None, infinity and NaN.

    >>> format_cell_number(7.0), format_cell_number(0.1 + 0.2), format_cell_number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"


def parse_decimal(text: str) -> float | None:
    """Parse a number with decimal point or comma; None if the text is not a number.

    >>> parse_decimal("12,5"), parse_decimal("1_5"), parse_decimal("nan")
    (12.5, None, None)
    """
    return float(text.replace(",", ".")) if re.fullmatch(r"[+-]?\d+([.,]\d*)?", text) else None


# ------------------------------------------------------------------ students


@dataclass(frozen=True)
class Person:
    """Student of the class, as in a table of a learning platform.

    Attributes
    ----------
    login : str
        Login on Blackboard or ILIAS.
    numbers : dict
        Number that a learning platform uses for the student, by name of the platform.
    submission_time : str
        Submission time (text) from a grading worksheet of Moodle.
    extended_due : str
        Later due time (text) that the instructor granted; "" without it.
    """

    student_id: str
    name: str = ""
    email: str = ""
    login: str = ""
    numbers: dict[str, str] = field(default_factory=dict)
    submission_time: str = ""
    extended_due: str = ""

    @property
    def log_file_name(self) -> str:
        """File name of the student's assigned log."""
        return f"{make_file_stem(self.student_id)}.ulg"


def read_people(sheet: Sheet) -> tuple[Person, ...]:
    """Read the students from a class list, Moodle worksheet or Canvas gradebook.

    The table needs at least one of these columns: id (Student ID, ID number, Matrikelnummer, SIS
    User ID), login (Username, SIS Login ID), email, name (or first and last name).

    Raises
    ------
    SettingsError
        No column identifies the students, or two rows have the same id.
    """
    if all(sheet.find_column_index(titles) is None for titles in COLUMN_TITLES_BY_FIELD.values()):
        raise SettingsError(
            f"{sheet.path}: no column contains ids, emails or names of students.",
            "Give one column the title id, email or name.",
        )
    row_number_by_id: dict[str, int] = {}
    people = []
    for row_number, row in enumerate(sheet.rows, start=2):
        person = read_student(sheet, row)
        if person is None:
            continue
        normalised_id = normalise_text(person.student_id)
        if normalised_id and row_number_by_id.setdefault(normalised_id, row_number) != row_number:
            raise SettingsError(
                f"{sheet.path}: rows {row_number_by_id[normalised_id]} and {row_number} have the "
                f"same id {shorten_to_line(person.student_id, 40)!r}.",
                "Give each student a unique id.",
            )
        people.append(person)
    return tuple(people)


def read_roster(path: Path) -> tuple[Person, ...]:
    """Read the class list of an assignment; each student must have a unique id.

    Raises
    ------
    SettingsError
        The file is not a valid table of 1 to MAX_STUDENTS students.
    """
    people = read_people(read_csv_sheet(path))
    if not people or len(people) > MAX_STUDENTS:
        raise SettingsError(
            f"{path} contains {len(people)} students.",
            f"Give a class list with 1 to {MAX_STUDENTS} students.",
        )
    # different ids may give the same file name, for example "a/1" and "a_1"
    used_stems = set()
    for person in people:
        stem = (make_file_stem(person.student_id) or "").casefold()
        if not stem or stem in used_stems:
            student_text = shorten_to_line(person.student_id or person.name, 40)
            raise SettingsError(
                f"{path}: the id of {student_text!r} cannot be used as a file name.",
                "Give each student a unique id with letters or digits.",
            )
        used_stems.add(stem)
    return people


def read_student(sheet: Sheet, row: Sequence[str]) -> Person | None:
    """Return the student in a table row; None for a row without a student."""
    cells = {
        field_name: shorten_to_line(sheet.find_cell(row, titles), MAX_NAME_LENGTH)
        for field_name, titles in COLUMN_TITLES_BY_FIELD.items()
    }
    name = cells["name"] or f"{cells['first']} {cells['last']}".strip()
    if re.sub(r"\W", "", name.casefold()) in NON_STUDENT_ROW_NAMES:
        return None
    numbers = {}
    # worksheet of the learning platform Moodle: the column "Identifier" contains "Participant 123"
    if participant := re.search(r"\d+$", sheet.find_cell(row, ("identifier",))):
        numbers["moodle"] = participant[0]
    # gradebook of the learning platform Canvas: the column "ID" contains Canvas's number of the
    # student, and "SIS User ID" contains the student id
    if sheet.find_column_index(("sisuserid", "sisloginid")) is not None:
        if canvas_number := sheet.find_cell(row, ("id",)):
            numbers["canvas"] = canvas_number
        cells["student_id"] = shorten_to_line(sheet.find_cell(row, ("sisuserid",)), MAX_NAME_LENGTH)
    student_id = cells["student_id"] or cells["login"] or cells["email"]
    person = Person(
        student_id,
        name,
        cells["email"],
        cells["login"],
        numbers,
        sheet.find_cell(row, ("lastmodifiedsubmission",)),
        cells["extended_due"],
    )
    return person if student_id or name or numbers else None


class ClassList:
    """Students of a class, who can be found by name, id, login or email.

    Empty fields of a student are filled from ``other_lists``, such as grade sheets.
    """

    def __init__(self, people: Iterable[Person] = (), *other_lists: Iterable[Person]) -> None:
        """Make a class list, and add data of the same students from other lists."""
        self.people = list(people)
        for other_person in chain.from_iterable(other_lists):
            student_index = self.find_student_index(other_person)
            if student_index is not None:
                student = self.people[student_index]
                fields = {
                    name: getattr(student, name) or getattr(other_person, name)
                    for name in FIELDS_FROM_OTHER_TABLES
                }
                self.people[student_index] = replace(
                    student, numbers=other_person.numbers | student.numbers, **fields
                )

    def find_student_index(self, searched_person: Person) -> int | None:
        """Return the index of a person in ``people``; None for an unknown person.

        The fields are compared in this order: number on the platform, id, email, login, name. The
        first field that matches exactly one student decides.
        """
        conditions: tuple[Callable[[Person], bool], ...] = (
            lambda person: bool(person.numbers.items() & searched_person.numbers.items()),
            lambda person: _is_same_text(person.student_id, searched_person.student_id),
            lambda person: is_same_id(person.student_id, searched_person.student_id),
            lambda person: _is_same_text(person.email, searched_person.email),
            # a class list without a login column may contain logins in its id column
            lambda person: _is_same_text(person.login or person.student_id, searched_person.login),
            lambda person: is_same_name(person.name, searched_person.name),
        )
        for is_same_person in conditions:
            matches = [index for index, each in enumerate(self.people) if is_same_person(each)]
            if len(matches) == 1:
                return matches[0]
        return None


def normalise_text(text: str) -> str:
    """Normalise an id or name for comparison: Unicode NFKC, lower case, no outer blanks."""
    return unicodedata.normalize("NFKC", text).strip().casefold()


def _is_same_text(text: str, other_text: str) -> bool:
    return normalise_text(text) == normalise_text(other_text) != ""


def is_same_id(student_id: str, other_id: str) -> bool:
    """Return True if two ids differ at most in case and leading zeros.

    Return False for ids that are empty or contain only zeros.

    >>> is_same_id("0042", "42"), is_same_id("S1", "s1 "), is_same_id("00", "0")
    (True, True, False)
    """
    return normalise_text(student_id).lstrip("0") == normalise_text(other_id).lstrip("0") != ""


def is_same_name(name: str, other_name: str) -> bool:
    """Return True if two names have equal words, in any order or joined.

    >>> is_same_name("Ada Lovelace", "Lovelace, Ada"), is_same_name("Ada Lovelace", "lovelaceada")
    (True, True)
    >>> is_same_name("Ada", "ada lovelace"), is_same_name("", "")
    (False, False)
    """
    words, other_words = (
        re.findall(r"[^\W_]+", normalise_text(text)) for text in (name, other_name)
    )
    if sorted(words) == sorted(other_words):
        return bool(words)
    # one of the names may be a single word, in which the words of the other name are joined in any
    # cyclic order: "lovelaceada" for "Ada Lovelace"
    shorter_name_words, longer_name_words = sorted((words, other_words), key=len)
    rotations = (
        "".join(longer_name_words[start:] + longer_name_words[:start])
        for start in range(len(longer_name_words))
    )
    return len(shorter_name_words) == 1 and shorter_name_words[0] in rotations


def make_file_stem(student_id: str) -> str | None:
    """Convert a student id to a portable file name; None if it has no letter or digit.

    >>> [make_file_stem(student_id) for student_id in ("s01/2026", "../../x", "nul", "=;")]
    ['s01_2026', '_.._x', '_nul', None]
    >>> [make_file_stem(student_id) for student_id in ("com1.txt", "-rf", "a.", "x" * 50)]
    ['_com1.txt', 'rf', 'a', 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx']
    """
    text = unicodedata.normalize("NFC", student_id.strip())
    safe_characters = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in text)
    if not any(c.isalnum() for c in safe_characters):
        return None
    stem = safe_characters[:MAX_STEM_LENGTH].lstrip(".-+@").rstrip(".")
    return f"_{stem}" if stem.split(".")[0].casefold() in WINDOWS_RESERVED_NAMES else stem


def make_unique(names: Iterable[str], pattern: str = "{} ({})") -> list[str]:
    """Append numbers to repeated names, ignoring case.

    >>> make_unique(["notes", "cover", "Notes"])
    ['notes', 'cover', 'Notes (2)']
    """
    unique_names: dict[str, str] = {}
    repetition_counts: Counter[str] = Counter()
    for name in names:
        unique_name, normalised_name = name, name.casefold()
        while unique_name.casefold() in unique_names:
            repetition_counts[normalised_name] += 1
            unique_name = pattern.format(name, repetition_counts[normalised_name] + 1)
        unique_names[unique_name.casefold()] = unique_name
    return list(unique_names.values())


def make_file_names(stems: Iterable[str]) -> list[str]:
    """Convert texts to unique, portable file names."""
    return make_unique((make_file_stem(stem) or "report" for stem in stems), "{}-{}")
