"""Which of the class handed a file in."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime

from px4fuse.assignment.key import folded, only_place, same_id
from px4fuse.assignment.roster import Person
from px4fuse.grading.platforms import ExportOrigin


class Register:
    """The class, to be asked who somebody is; without people where nothing says who is in it.

    ``times`` is when Moodle says that the person at a place handed in.
    """

    def __init__(self, people: Iterable[Person] = ()) -> None:
        self.people = list(people)
        self.times: dict[int, datetime] = {}

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
        return only_place(self.people, looks)

    def by_platform(self, origin: ExportOrigin) -> int | None:
        """Whose file it is by what the platform says, which no student can change."""
        return self.place(origin.person) if origin.platform else None


def _same(known: str, said: str) -> bool:
    return folded(known) == folded(said) != ""


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
