"""What all results share: their schema's name, whose report it is, and what made it."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from px4fuse.answers import Answers
from px4fuse.record import Record

MAX_NOTES_BYTES = 200_000
MAX_PERSON = 10_000

Version = Annotated[str, Meta(pattern="^[0-9A-Za-z.+!_-]{1,60}$")]


class Schema(Record, frozen=True):
    """Which results these are, and the version of their contract."""

    name: str
    version: Literal["3.0"]


class Student(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose report it is; every part may be empty.

    Attributes
    ----------
    name, id : str
    notes : str
        The student's own words, Markdown.
    answers : Answers or UNSET
        The form about the flight, as filled in.
    """

    name: Annotated[str, Meta(max_length=MAX_PERSON)] = ""
    id: Annotated[str, Meta(max_length=MAX_PERSON)] = ""
    notes: Annotated[str, Meta(max_length=MAX_NOTES_BYTES)] = ""
    answers: Answers | msgspec.UnsetType = msgspec.UNSET


class Provenance(Record, frozen=True):
    """Versions and the command line; nothing else of the machine is recorded.

    Attributes
    ----------
    px4fuse, python : str
    libraries : mapping of str to str
        On whose arithmetic the numbers rest.
    command : str
        For people; the request says what was analysed and how.
    """

    px4fuse: Version
    python: Version
    libraries: dict[str, Version]
    command: str
