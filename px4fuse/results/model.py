"""What all results share: their schema's name, whose report it is, and what made it."""

import platform
from importlib import metadata
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from px4fuse.answers import Answers
from px4fuse.record import Record

VERSION: Literal["3.0"] = "3.0"
# The libraries on whose arithmetic the numbers rest
LIBRARIES = ("numpy", "scipy", "pandas", "pyulog", "pymavlink", "filterpy", "matplotlib", "pypdf")
MAX_NOTES_BYTES = 200_000
MAX_PERSON_LENGTH = 10_000

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

    name: Annotated[str, Meta(max_length=MAX_PERSON_LENGTH)] = ""
    id: Annotated[str, Meta(max_length=MAX_PERSON_LENGTH)] = ""
    notes: Annotated[str, Meta(max_length=MAX_NOTES_BYTES)] = ""
    answers: Answers | msgspec.UnsetType = msgspec.UNSET


NO_STUDENT = Student()


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


def schema_of(name: str) -> Schema:
    """Name and version of what is written."""
    return Schema(name, VERSION)


def provenance(command: str) -> Provenance:
    """Versions of this installation, and the command line."""
    return Provenance(
        px4fuse=metadata.version("px4fuse"),
        python=platform.python_version(),
        libraries={name: metadata.version(name) for name in LIBRARIES},
        command=command,
    )
