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


def people_of_sheet(sheet: Sheet) -> tuple[Person, ...]:
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
        person = person_of_row(sheet, row)
        if person is None:
            continue
        wanted = folded(person.student_id)
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
        From :func:`~px4fuse.assignment.sheet.read_sheet` and :func:`people_of_sheet`, or no file
        can be named after an id.
    """
    people = people_of_sheet(read_sheet(path))
    if not people or len(people) > MAX_STUDENTS:
        raise SettingsError(f"{path}: {len(people)} students", f"Give 1 to {MAX_STUDENTS}.")
    stems: dict[str, Person] = {}
    for person in people:
        stem = file_stem(person.student_id)
        if stem is None or stems.setdefault(stem.casefold(), person) is not person:
            who = one_line(person.student_id or person.name, 40)
            raise SettingsError.of("id_without_file", path=path, who=who)
    return people


def person_of_row(sheet: Sheet, row: Sequence[str]) -> Person | None:
    """The student in a row of a table; None for a row without one."""
    said = {what: one_line(sheet.cell(row, titles), MAX_NAME) for what, titles in COLUMNS.items()}
    name = said["name"] or f"{said['first']} {said['last']}".strip()
    if re.sub(r"\W", "", name.casefold()) in NOT_STUDENTS:
        return None
    numbers = {}
    if participant := re.search(r"\d+$", sheet.cell(row, ("identifier",))):
        numbers["moodle"] = participant[0]
    if sheet.column(("sisuserid", "sisloginid")) is not None:
        numbers |= {"canvas": user} if (user := sheet.cell(row, ("id",))) else {}
        said["student_id"] = one_line(sheet.cell(row, ("sisuserid",)), MAX_NAME)
    student_id = said["student_id"] or said["login"] or said["email"]
    submitted = sheet.cell(row, ("lastmodifiedsubmission",))
    found = Person(student_id, name, said["email"], said["login"], numbers, submitted)
    return found if student_id or name or numbers else None


class Register:
    """The class, to be asked who somebody is; without people where nothing says who is in it."""

    def __init__(self, people: Iterable[Person] = (), *lists: Iterable[Person]) -> None:
        self.people = list(people)
        # what other lists know of the same people; who is not among them is left out
        for other in chain.from_iterable(lists):
            if (place := self.place(other)) is not None:
                known = self.people[place]
                whole = {name: getattr(known, name) or getattr(other, name) for name in ADDED}
                numbers = {**other.numbers, **known.numbers}
                self.people[place] = replace(known, numbers=numbers, **whole)

    def place(self, other: Person) -> int | None:
        """Where somebody stands of whom another list knows: by number, id, email, login or name.

        By the first of these that exactly one of the class has. Leading zeros, which spreadsheets
        take away from ids, may be missing.
        """
        numbers = other.numbers.items()
        looks: tuple[tuple[Callable[[str, str], bool], Callable[[Person], str], str], ...] = (
            *((_same, lambda one, at=at: one.numbers.get(at, ""), said) for at, said in numbers),
            (_same, attrgetter("student_id"), other.student_id),
            (same_id, attrgetter("student_id"), other.student_id),
            (_same, attrgetter("email"), other.email),
            # Blackboard's user name and ILIAS's login are ids where the roster has no other
            (_same, lambda one: one.login or one.student_id, other.login),
            (same_name, attrgetter("name"), other.name),
        )
        for same, known, said in looks:
            places = [at for at, one in enumerate(self.people) if same(known(one), said)]
            if len(places) == 1:
                return places[0]
        return None


def folded(text: str) -> str:
    """Id or name for comparison: one spelling per character, case and outer spaces ignored."""
    return unicodedata.normalize("NFKC", text).strip().casefold()


def _same(known: str, said: str) -> bool:
    return folded(known) == folded(said) != ""


def same_id(one: str, other: str) -> bool:
    """Whether two ids are the same; spreadsheets take away leading zeros.

    >>> same_id("0042", "42"), same_id("S1", "s1 "), same_id("00", "0")
    (True, True, False)
    """
    return folded(one).lstrip("0") == folded(other).lstrip("0") != ""


def same_name(one: str, other: str) -> bool:
    """Whether two names have the same words in any order, or run together as Canvas has them.

    >>> same_name("Ada Lovelace", "Lovelace, Ada"), same_name("Ada Lovelace", "lovelaceada")
    (True, True)
    >>> same_name("Ada", "ada lovelace"), same_name("", "")
    (False, False)
    """
    mine, theirs = (re.findall(r"[^\W_]+", folded(name)) for name in (one, other))
    short, long = sorted((mine, theirs), key=len)
    turned = ("".join(long[at:] + long[:at]) for at in range(len(long)))
    together = len(short) == 1 < len(long) and short[0] in turned
    return bool(short) and (sorted(mine) == sorted(theirs) or together)


def file_stem(student_id: str) -> str | None:
    """An id as the name of a file on any system; None where nothing of it is left.

    >>> file_stem("s01/2026"), file_stem("../../x"), file_stem("nul"), file_stem("=;")
    ('s01_2026', '_.._x', '_nul', None)
    >>> file_stem("com1.txt"), file_stem("-rf"), file_stem("a."), len(file_stem("x" * 300))
    ('_com1.txt', 'rf', 'a', 48)
    """
    text = unicodedata.normalize("NFC", student_id.strip())
    kept = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in text)
    if not any(c.isalnum() for c in kept):
        return None
    stem = kept[:MAX_STEM].lstrip(".-+@").rstrip(".")
    return f"_{stem}" if stem.split(".")[0].casefold() in RESERVED else stem


def distinct(names: Iterable[str], form: str = "{} ({})") -> list[str]:
    """Names with a number behind those that came before, however they are capitalised.

    >>> distinct(["notes", "cover", "Notes"])
    ['notes', 'cover', 'Notes (2)']
    """
    made: dict[str, str] = {}
    count: Counter[str] = Counter()
    for name in names:
        new, plain = name, name.casefold()
        while new.casefold() in made:
            count[plain] += 1
            new = form.format(name, count[plain] + 1)
        made[new.casefold()] = new
    return list(made.values())


def file_names(stems: Iterable[str]) -> list[str]:
    """A name for each one's files on any system, unique ignoring case."""
    return distinct((file_stem(stem) or "report" for stem in stems), "{}-{}")
