"""Records that the results of several commands share: schema, student and provenance."""

import platform
from importlib import metadata
from typing import Annotated

import msgspec
from msgspec import Meta

from px4fuse.core.record import Record

from .answer_form import Answers

# Version of the JSON schema: new fields increase the minor version, other changes the major version
SCHEMA_VERSION = "4.0"
# Libraries that affect the numbers in the results
LIBRARIES = ("numpy", "scipy", "pandas", "pyulog", "pymavlink", "filterpy", "matplotlib", "pypdf")
MAX_NOTES_BYTES = 200_000
MAX_STUDENT_NAME_LENGTH = 10_000

Version = Annotated[str, Meta(pattern="^[0-9A-Za-z.+!_-]{1,60}$")]


class Schema(Record):
    """Name and version of the JSON schema of results."""

    name: str
    version: Annotated[str, Meta(pattern=r"^4\.[0-9]{1,4}$")]


class Student(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Student who wrote a report, with notes (Markdown) and answers to questions on the flight."""

    name: Annotated[str, Meta(max_length=MAX_STUDENT_NAME_LENGTH)] = ""
    id: Annotated[str, Meta(max_length=MAX_STUDENT_NAME_LENGTH)] = ""
    notes: Annotated[str, Meta(max_length=MAX_NOTES_BYTES)] = ""
    answers: Answers | msgspec.UnsetType = msgspec.UNSET


NO_STUDENT = Student()


class Provenance(Record):
    """Command that produced the results, and versions of px4fuse and its libraries.

    Attributes
    ----------
    px4fuse, python : str
    libraries : mapping of str to str
        Versions of the libraries that affect the numbers in the results.
    command : str
        Command line for users; programs read ``request`` instead.
    """

    px4fuse: Version
    python: Version
    libraries: dict[str, Version]
    command: str


def provenance(command: str) -> Provenance:
    return Provenance(
        px4fuse=metadata.version("px4fuse"),
        python=platform.python_version(),
        libraries={name: metadata.version(name) for name in LIBRARIES},
        command=command,
    )
