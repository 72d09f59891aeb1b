"""Names that stay apart: of items, of submissions, of files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from px4fuse.assignment.roster import file_stem


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
