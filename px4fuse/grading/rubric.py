"""The rubric: what a report is worth, as an instructor writes it down.

A TOML file of items, each with a title, points, the name of a check and its parameters: see
:mod:`px4fuse.grading.checks`.
"""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Union

import msgspec
from msgspec import Meta

from px4fuse.assignment.roster import distinct
from px4fuse.errors import SettingsError
from px4fuse.grading import checks  # noqa: F401 - the kinds of items
from px4fuse.grading.evidence import RubricItem, Text
from px4fuse.grading.overrides import TOTAL
from px4fuse.reading import read_text
from px4fuse.results.reading import one_line

DEFAULT = "rubric.toml"
MAX_RUBRIC_BYTES = 1_000_000
HELP = "px4fuse grade --write-rubric FILE.toml writes one that explains itself."

if TYPE_CHECKING:
    AnyItem = RubricItem
else:
    # of every check, told apart by their tags
    AnyItem = Union[tuple(RubricItem.__subclasses__())]  # noqa: UP007
# What is done with points that nobody can vouch for: left for the instructor, taken, or counted
Doubtful = Literal["pending", "zero", "count"]


class Rubric(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a report is worth.

    Attributes
    ----------
    unverified : {"pending", "zero"}
        What becomes of the points of a report that cannot be verified.
    others_log : {"pending", "zero", "count"}
        What becomes of those of a report on a log that was not given to the student.
    pages : {"count", "pending", "zero"}
        What becomes of those of a verified report whose pages look otherwise.
    min_words : int
        Of a student's text, below which the instructor is told.
    common_words : tuple of str
        The commonest words of the course's language; empty for any language.
    """

    title: Text = ""
    unverified: Literal["pending", "zero"] = "pending"
    others_log: Doubtful = "pending"
    pages: Doubtful = "count"
    min_words: Annotated[int, Meta(ge=0, le=100_000)] = 100
    common_words: Annotated[tuple[Text, ...], Meta(max_length=100)] = ()
    items: Annotated[tuple[AnyItem, ...], Meta(min_length=1, max_length=100)] = msgspec.field(
        name="item"
    )

    def __post_init__(self) -> None:
        titles = [TOTAL, *(item.title for item in self.items)]
        for title, apart in zip(titles, distinct(titles), strict=True):
            if title != apart:
                whose = "that of the sum" if title.casefold() == TOTAL else "another item's"
                raise ValueError(f"the title {title!r} is {whose}; give each its own")


def rubric_text() -> str:
    """The default rubric, comments and all, for an instructor to copy and edit."""
    return files("px4fuse.grading").joinpath(DEFAULT).read_text(encoding="utf-8")


def read_rubric(path: Path | None) -> Rubric:
    """Read and check a rubric.

    Parameters
    ----------
    path : Path or None
        None is the default one.

    Raises
    ------
    SettingsError
        It cannot be read, or something in it is not what it should be: the text says which item.
    """
    if path is None:
        return parse_rubric(rubric_text(), DEFAULT)
    return parse_rubric(read_text(path, SettingsError, MAX_RUBRIC_BYTES, name=str(path)), str(path))


def parse_rubric(text: str, where: str) -> Rubric:
    """Check the text of a rubric; ``where`` names it in errors."""
    try:
        return msgspec.convert(tomllib.loads(text.replace("\r\n", "\n")), Rubric)
    # ValueError: not TOML, or an integer of a million digits
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        said = re.sub(r"`\$\.item\[(\d+)\]\.?([^`]*)`", _place, str(error))
        raise SettingsError(f"{where}: {one_line(said, 300)}", HELP) from error


def _place(path: re.Match[str]) -> str:
    """Which item and what of it, as a person counts."""
    return f"item {int(path[1]) + 1}{f', {path[2]}' * bool(path[2])}"
