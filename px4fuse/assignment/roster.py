"""The class list that a learning platform exports: who is in the class, and who somebody is."""

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
# A file system takes 255 bytes, and a character up to 4
MAX_STEM = 48
RESERVED = {"con", "prn", "aux", "nul"} | {f"{n}{i}" for n in ("com", "lpt") for i in range(10)}
COLUMNS = table(__file__, "columns.toml", dict[str, tuple[str, ...]])
# What another list may know besides
ADDED = ("name", "email", "login", "submitted")
# Of Canvas, above the students
NOT_STUDENTS = ("pointspossible", "studenttest")


@dataclass(frozen=True)
class Person:
    """One of the class.

    Attributes
    ----------
    student_id, name, email : str
        As the roster says.
    login : str
        By which Blackboard and ILIAS know the student.
    numbers : mapping
        Platform to the number that it gave the student.
    submitted : str
        When Moodle's worksheet says that the student handed in, in its words.
    """

    student_id: str
    name: str = ""
    email: str = ""
    login: str = ""
    numbers: dict[str, str] = field(default_factory=dict)
    submitted: str = ""

    @property
    def file(self) -> str:
        """Name of the student's log: the id, as far as a file system takes it."""
        return f"{file_stem(self.student_id)}.ulg"


def read_people(sheet: Sheet) -> tuple[Person, ...]:
    """The class list that a learning platform exports, or any table with a column of ids or names.

    Columns are found by their titles: id (Student ID, ID number, Matrikelnummer, SIS User ID),
    login (Username, SIS Login ID), email, name (or first and last name). Worksheets of Moodle and
    gradebooks of Canvas are class lists too.

    Raises
    ------
    SettingsError
        No column tells who somebody is, or two rows have the same id.
    """
    if all(sheet.column(titles) is None for titles in COLUMNS.values()):
        raise SettingsError.of("no_column", path=sheet.path)
    rows: dict[str, int] = {}
    people = []
    for number, row in enumerate(sheet.rows, start=2):
        person = read_student(sheet, row)
        if person is None:
            continue
        wanted = normalise_text(person.student_id)
        if wanted and rows.setdefault(wanted, number) != number:
            raise SettingsError.of(
                "id_twice",
                sheet=sheet,
                before=rows[wanted],
                number=number,
                student_id=one_line(person.student_id, 40),
            )
        people.append(person)
    return tuple(people)


def read_roster(path: Path) -> tuple[Person, ...]:
    """The class list from which an assignment is made: everyone has an id of its own.

    Raises
    ------
    SettingsError
        From :func:`~px4fuse.assignment.sheet.read_sheet` and :func:`read_people`, or no file
        can be named after an id.
    """
    people = read_people(read_sheet(path))
    if not people or len(people) > MAX_STUDENTS:
        raise SettingsError(f"{path}: {len(people)} students", f"Give 1 to {MAX_STUDENTS}.")
    stems: dict[str, Person] = {}
    for person in people:
        stem = file_stem(person.student_id)
        if stem is None or stems.setdefault(stem.casefold(), person) is not person:
            who = one_line(person.student_id or person.name, 40)
            raise SettingsError.of("id_without_file", path=path, who=who)
    return people


def read_student(sheet: Sheet, row: Sequence[str]) -> Person | None:
    """The student in a row of a table; None for a row without one."""
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
    """The class, to be asked who somebody is; without people where nothing says who is in it."""

    def __init__(self, people: Iterable[Person] = (), *lists: Iterable[Person]) -> None:
        self.people = list(people)
        # what other lists know of the same people; who is not among them is left out
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
        """Where somebody stands of whom another list knows: by number, id, email, login or name.

        By the first of these that exactly one of the class has. Leading zeros, which spreadsheets
        take away from ids, may be missing.
        """
        numbers = other.numbers.items()
        criteria: tuple[tuple[Callable[[str, str], bool], Callable[[Person], str], str], ...] = (
            *(
                (_is_same_text, lambda one, at=at: one.numbers.get(at, ""), value)
                for at, value in numbers
            ),
            (_is_same_text, attrgetter("student_id"), other.student_id),
            (is_same_id, attrgetter("student_id"), other.student_id),
            (_is_same_text, attrgetter("email"), other.email),
            # Blackboard's user name and ILIAS's login are ids where the roster has no other
            (_is_same_text, lambda one: one.login or one.student_id, other.login),
            (is_same_name, attrgetter("name"), other.name),
        )
        for same, known_person, value in criteria:
            places = [at for at, one in enumerate(self.people) if same(known_person(one), value)]
            if len(places) == 1:
                return places[0]
        return None


def normalise_text(text: str) -> str:
    """Id or name for comparison: one spelling per character, case and outer spaces ignored."""
    return unicodedata.normalize("NFKC", text).strip().casefold()


def _is_same_text(known: str, other: str) -> bool:
    return normalise_text(known) == normalise_text(other) != ""


def is_same_id(one: str, other: str) -> bool:
    """Whether two ids are the same; spreadsheets take away leading zeros.

    >>> is_same_id("0042", "42"), is_same_id("S1", "s1 "), is_same_id("00", "0")
    (True, True, False)
    """
    return normalise_text(one).lstrip("0") == normalise_text(other).lstrip("0") != ""


def is_same_name(one: str, other: str) -> bool:
    """Whether two names have the same words in any order, or run together as Canvas has them.

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
    """An id as the name of a file on any system; None where nothing of it is left.

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
    """Names with a number behind those that came before, however they are capitalised.

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
    """A name for each one's files on any system, unique ignoring case."""
    return make_unique((file_stem(stem) or "report" for stem in stems), "{}-{}")
