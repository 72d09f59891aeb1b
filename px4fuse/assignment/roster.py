"""Class list of a learning platform: students, and their identification."""

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import attrgetter
from pathlib import Path

from px4fuse.assignment.sheet import Sheet, read_sheet
from px4fuse.errors import SettingsError
from px4fuse.record import table
from px4fuse.results.reading import one_line

MAX_NAME = 200
MAX_STUDENTS = 1000
# characters; a file name may have 255 bytes, and a character has up to 4
MAX_STEM = 48
RESERVED = {"con", "prn", "aux", "nul"} | {f"{n}{i}" for n in ("com", "lpt") for i in range(10)}
COLUMNS = table(__file__, "columns.toml", dict[str, tuple[str, ...]])
# fields that a second list may add
ADDED = ("name", "email", "login", "submitted")
# rows of Canvas that are not students
NOT_STUDENTS = ("pointspossible", "studenttest")


@dataclass(frozen=True)
class Person:
    """Student of the class.

    Attributes
    ----------
    student_id, name, email : str
        As in the class list.
    login : str
        Login on Blackboard or ILIAS.
    numbers : mapping
        Number of the student on each platform, by platform.
    submitted : str
        Submission time as text, from Moodle's worksheet.
    """

    student_id: str
    name: str = ""
    email: str = ""
    login: str = ""
    numbers: dict[str, str] = field(default_factory=dict)
    submitted: str = ""

    @property
    def file(self) -> str:
        """File name of the student's log, made from the id."""
        return f"{file_stem(self.student_id)}.ulg"


def read_people(sheet: Sheet) -> tuple[Person, ...]:
    """Read the students from a class list, worksheet or gradebook.

    Columns are found by their titles: id (Student ID, ID number, Matrikelnummer, SIS User ID),
    login (Username, SIS Login ID), email, name (or first and last name). Worksheets of Moodle and
    gradebooks of Canvas are accepted.

    Raises
    ------
    SettingsError
        No column identifies the students, or two rows have the same id.
    """
    if all(sheet.column(titles) is None for titles in COLUMNS.values()):
        raise SettingsError(
            f"{sheet.path}: no column identifies the student.", "Name one column id, email or name."
        )
    rows: dict[str, int] = {}
    people = []
    for number, row in enumerate(sheet.rows, start=2):
        person = read_student(sheet, row)
        if person is None:
            continue
        wanted = normalise_text(person.student_id)
        if wanted and rows.setdefault(wanted, number) != number:
            raise SettingsError(
                f"{sheet.path}: rows {rows[wanted]} and {number} have the same id "
                f"{one_line(person.student_id, 40)!r}.",
                "Give each student a unique id.",
            )
        people.append(person)
    return tuple(people)


def read_roster(path: Path) -> tuple[Person, ...]:
    """Read the class list of an assignment, in which each student has a unique id.

    Raises
    ------
    SettingsError
        From :func:`~px4fuse.assignment.sheet.read_sheet` and :func:`read_people`, or an id cannot
        be used as a file name.
    """
    people = read_people(read_sheet(path))
    if not people or len(people) > MAX_STUDENTS:
        raise SettingsError(
            f"{path}: {len(people)} students.", f"A class list has 1 to {MAX_STUDENTS} students."
        )
    stems: dict[str, Person] = {}
    for person in people:
        stem = file_stem(person.student_id)
        if stem is None or stems.setdefault(stem.casefold(), person) is not person:
            who = one_line(person.student_id or person.name, 40)
            raise SettingsError(
                f"{path}: the id of {who!r} cannot be used as a file name.",
                "Give each student an id with letters or digits.",
            )
    return people


def read_student(sheet: Sheet, row: Sequence[str]) -> Person | None:
    """Read the student in a row of a table; None for a row without a student."""
    cells = {what: one_line(sheet.cell(row, titles), MAX_NAME) for what, titles in COLUMNS.items()}
    name = cells["name"] or f"{cells['first']} {cells['last']}".strip()
    if re.sub(r"\W", "", name.casefold()) in NOT_STUDENTS:
        return None
    numbers = {}
    if participant := re.search(r"\d+$", sheet.cell(row, ("identifier",))):
        numbers["moodle"] = participant[0]
    if sheet.column(("sisuserid", "sisloginid")) is not None:
        numbers |= {"canvas": user} if (user := sheet.cell(row, ("id",))) else {}
        cells["student_id"] = one_line(sheet.cell(row, ("sisuserid",)), MAX_NAME)
    student_id = cells["student_id"] or cells["login"] or cells["email"]
    submitted = sheet.cell(row, ("lastmodifiedsubmission",))
    found = Person(student_id, name, cells["email"], cells["login"], numbers, submitted)
    return found if student_id or name or numbers else None


class Register:
    """Students of the class, with search by number, id, email, login or name."""

    def __init__(self, people: Iterable[Person] = (), *lists: Iterable[Person]) -> None:
        self.people = list(people)
        # add fields from the other lists; people outside of the class are ignored
        for other in chain.from_iterable(lists):
            if (student_index := self.student_index(other)) is not None:
                known_person = self.people[student_index]
                combined_fields = {
                    name: getattr(known_person, name) or getattr(other, name) for name in ADDED
                }
                numbers = {**other.numbers, **known_person.numbers}
                self.people[student_index] = replace(
                    known_person, numbers=numbers, **combined_fields
                )

    def student_index(self, other: Person) -> int | None:
        """Find a person of another list in the class; None if the match is not unique.

        Criteria in this order: number, id, email, login, name. The first that matches exactly one
        student decides. Leading zeros of ids may be missing, because spreadsheets remove them.
        """
        numbers = other.numbers.items()
        criteria: tuple[tuple[Callable[[str, str], bool], Callable[[Person], str], str], ...] = (
            *(
                (_is_same_text, lambda person, at=at: person.numbers.get(at, ""), value)
                for at, value in numbers
            ),
            (_is_same_text, attrgetter("student_id"), other.student_id),
            (is_same_id, attrgetter("student_id"), other.student_id),
            (_is_same_text, attrgetter("email"), other.email),
            # without a login in the class list, compare its id
            (_is_same_text, lambda person: person.login or person.student_id, other.login),
            (is_same_name, attrgetter("name"), other.name),
        )
        for same, field_of, value in criteria:
            places = [at for at, person in enumerate(self.people) if same(field_of(person), value)]
            if len(places) == 1:
                return places[0]
        return None


def normalise_text(text: str) -> str:
    """Normalise an id or name for comparison: NFKC, without case and outer blanks."""
    return unicodedata.normalize("NFKC", text).strip().casefold()


def _is_same_text(known: str, other: str) -> bool:
    return normalise_text(known) == normalise_text(other) != ""


def is_same_id(one: str, other: str) -> bool:
    """Return True if two ids are equal except for case and leading zeros.

    >>> is_same_id("0042", "42"), is_same_id("S1", "s1 "), is_same_id("00", "0")
    (True, True, False)
    """
    return normalise_text(one).lstrip("0") == normalise_text(other).lstrip("0") != ""


def is_same_name(one: str, other: str) -> bool:
    """Return True if two names have the same words in any order, or joined as by Canvas.

    >>> is_same_name("Ada Lovelace", "Lovelace, Ada"), is_same_name("Ada Lovelace", "lovelaceada")
    (True, True)
    >>> is_same_name("Ada", "ada lovelace"), is_same_name("", "")
    (False, False)
    """
    words, other_words = (re.findall(r"[^\W_]+", normalise_text(name)) for name in (one, other))
    short, long = sorted((words, other_words), key=len)
    rotated_words = ("".join(long[at:] + long[:at]) for at in range(len(long)))
    is_run_together = len(short) == 1 < len(long) and short[0] in rotated_words
    return bool(short) and (sorted(words) == sorted(other_words) or is_run_together)


def file_stem(student_id: str) -> str | None:
    """Convert an id to a file name valid on all systems; None if no character remains.

    >>> file_stem("s01/2026"), file_stem("../../x"), file_stem("nul"), file_stem("=;")
    ('s01_2026', '_.._x', '_nul', None)
    >>> file_stem("com1.txt"), file_stem("-rf"), file_stem("a."), len(file_stem("x" * 300))
    ('_com1.txt', 'rf', 'a', 48)
    """
    text = unicodedata.normalize("NFC", student_id.strip())
    safe_characters = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in text)
    if not any(c.isalnum() for c in safe_characters):
        return None
    stem = safe_characters[:MAX_STEM].lstrip(".-+@").rstrip(".")
    return f"_{stem}" if stem.split(".")[0].casefold() in RESERVED else stem


def make_unique(names: Iterable[str], form: str = "{} ({})") -> list[str]:
    """Make names unique, ignoring case, by a number after repeated names.

    >>> make_unique(["notes", "cover", "Notes"])
    ['notes', 'cover', 'Notes (2)']
    """
    unique_names: dict[str, str] = {}
    count: Counter[str] = Counter()
    for name in names:
        new, plain = name, name.casefold()
        while new.casefold() in unique_names:
            count[plain] += 1
            new = form.format(name, count[plain] + 1)
        unique_names[new.casefold()] = new
    return list(unique_names.values())


def file_names(stems: Iterable[str]) -> list[str]:
    """Make file names that are valid on all systems and unique, ignoring case."""
    return make_unique((file_stem(stem) or "report" for stem in stems), "{}-{}")
