"""The structures that results are made of."""

from __future__ import annotations

import msgspec

MAX_NOTES_BYTES = 200_000


class Student(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose report it is; every part may be empty.

    Attributes
    ----------
    name, id : str
    notes : str
        The student's own words, Markdown.
    """

    name: str = ""
    id: str = ""
    notes: str = ""
