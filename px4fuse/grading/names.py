"""Names that stay apart: of items, of submissions, of files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from px4fuse.assignment.roster import RESERVED


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
    """A name for each one's files, unique ignoring case: letters, digits, - and _ only."""
    safe = (
        "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stem)[:60]
        for stem in stems
    )
    usable = (f"report_{s}" if not s or s.casefold() in RESERVED else s for s in safe)
    return distinct(usable, "{}-{}")
