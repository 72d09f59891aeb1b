"""Who is in the class, and which of them handed a file in."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from px4fuse.assignment.key import AnswerKey, folded
from px4fuse.assignment.roster import (
    EMAIL_COLUMNS,
    ID_COLUMNS,
    LAST_NAME_COLUMNS,
    LOGIN_COLUMNS,
    MAX_NAME,
    NAME_COLUMNS,
    full_name,
)
from px4fuse.assignment.sheet import Sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.platforms import ExportOrigin
from px4fuse.results.reading import one_line

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
    """

    student_id: str
    name: str = ""
    email: str = ""
    login: str = ""
    numbers: dict[str, str] = field(default_factory=dict)


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
    _, ids = _ids(sheet)
    known = (ids, LOGIN_COLUMNS, EMAIL_COLUMNS, NAME_COLUMNS, LAST_NAME_COLUMNS)
    if not any(sheet.column(titles) is not None for titles in known):
        raise SettingsError(
            f"{sheet.path}: no column tells who a student is. Give one a title such as id, email "
            "or name."
        )
    people = [one for row in sheet.rows if (one := person_of_row(sheet, row))]
    seen: set[str] = set()
    for person in people:
        wanted = folded(person.student_id)
        if wanted and wanted in seen:
            raise SettingsError(
                f"{sheet.path}: the id {one_line(person.student_id, 40)} stands there twice. Give "
                "every student one of its own."
            )
        seen.add(wanted)
    return tuple(people)


def person_of_row(sheet: Sheet, row: Sequence[str]) -> Person | None:
    """Whom a row of such a table is about; None for a row that is about nobody."""
    canvas, ids = _ids(sheet)
    name = full_name(sheet, row)
    if re.sub(r"\W", "", name.casefold()) in NOT_STUDENTS:
        return None
    email = one_line(sheet.cell(row, EMAIL_COLUMNS), MAX_NAME)
    login = one_line(sheet.cell(row, LOGIN_COLUMNS), MAX_NAME)
    numbers = {}
    if participant := re.search(r"\d+$", sheet.cell(row, ("identifier",))):
        numbers["moodle"] = participant[0]
    if canvas and (user := sheet.cell(row, ("id",))):
        numbers["canvas"] = user
    student_id = one_line(sheet.cell(row, ids), MAX_NAME) or login or email
    found = Person(student_id, name, email, login, numbers)
    return found if student_id or name or numbers else None


def _ids(sheet: Sheet) -> tuple[bool, list[str]]:
    """Whether a table is Canvas's, and titles of the university's ids."""
    canvas = sheet.column(("sisuserid", "sisloginid")) is not None
    return canvas, [name for name in ID_COLUMNS if not (canvas and name == "id")]


def people_of_key(key: AnswerKey) -> tuple[Person, ...]:
    """The students of an answer key."""
    return tuple(Person(answer.student_id, answer.name) for answer in key.answers)


class Register:
    """The class, to be asked who somebody is."""

    def __init__(self, people: Sequence[Person]) -> None:
        self.people = list(people)

    def add(self, others: Iterable[Person]) -> None:
        """What another list knows of the same people; who is not among them is left out."""
        for other in others:
            place = self.place(other)
            if place is not None:
                known = self.people[place]
                self.people[place] = replace(
                    known,
                    name=known.name or other.name,
                    email=known.email or other.email,
                    login=known.login or other.login,
                    numbers={**other.numbers, **known.numbers},
                )

    def place(self, other: Person) -> int | None:
        """Where somebody stands of whom another list knows: by number, id, email, login or name."""
        looks: tuple[Callable[[Person], bool], ...] = (
            *(
                lambda one, at=platform, said=said: _same(one.numbers.get(at, ""), said)
                for platform, said in other.numbers.items()
            ),
            lambda one: _same(one.student_id, other.student_id),
            lambda one: same_id(one.student_id, other.student_id),
            lambda one: _same(one.email, other.email),
            # Blackboard's user name and ILIAS's login are ids where the roster has no other
            lambda one: _same(one.login or one.student_id, other.login),
            lambda one: same_name(one.name, other.name),
        )
        for look in looks:
            places = [place for place, one in enumerate(self.people) if look(one)]
            if len(places) == 1:
                return places[0]
        return None

    def by_platform(self, origin: ExportOrigin) -> int | None:
        """Whose file it is by what the platform says, which no student can change."""
        if not origin.platform:
            return None
        return self.place(
            Person(
                origin.student_id,
                origin.name,
                origin.email,
                origin.login,
                {origin.platform: origin.number} if origin.number else {},
            )
        )

    def by_report(self, student_id: str, name: str) -> int | None:
        """Whose report it is by what stands in it: the id, else the name."""
        return self.place(Person(student_id, name))


def _same(known: str, said: str) -> bool:
    return folded(known) == folded(said) != ""


def same_id(one: str, other: str) -> bool:
    """Whether two ids are the same; spreadsheets take away leading zeros.

    >>> same_id("0042", "42"), same_id("S1", "s1 "), same_id("", "")
    (True, True, False)
    """
    one, other = folded(one), folded(other)
    return bool(one) and (one == other or one.lstrip("0") == other.lstrip("0") != "")


def same_name(one: str, other: str) -> bool:
    """Whether two names have the same words in any order, or run together as Canvas has them.

    >>> same_name("Ada Lovelace", "Lovelace, Ada"), same_name("Ada Lovelace", "lovelaceada")
    (True, True)
    >>> same_name("Ada", "ada lovelace"), same_name("", "")
    (False, False)
    """
    mine, theirs = (re.findall(r"[^\W_]+", folded(name)) for name in (one, other))
    if not mine or not theirs:
        return False
    if sorted(mine) == sorted(theirs):
        return True
    short, long = sorted((mine, theirs), key=len)
    turned = ("".join(long[at:] + long[:at]) for at in range(len(long)))
    return len(short) == 1 and len(long) > 1 and short[0] in turned
