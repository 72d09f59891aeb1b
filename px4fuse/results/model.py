"""What all results share: their base, what stands for an absent part, kinds of numbers, people.

Names carry units. A number that could not be computed is absent, or there is ``{"unavailable":
{"what", "reason", "remedy"}}`` in place of the part that it belongs to; it is never zero.
"""

from __future__ import annotations

from abc import ABCMeta
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar, Union

import msgspec
from msgspec import Meta

MAX_NOTES_BYTES = 200_000
MAX_PERSON = 10_000

NotNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Count = Annotated[int, Meta(ge=0)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Version = Annotated[str, Meta(pattern="^[0-9A-Za-z.+!_-]{1,60}$")]
Interval = tuple[float, float]
Vector = tuple[float, float, float]


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Strict: no field but its own; what is None is left out."""


class Missing(Base, frozen=True):
    """What could not be computed, why, and what to do about it."""

    what: str
    reason: str
    remedy: str


class Absent(Base, frozen=True):
    """Stands in place of a part that could not be computed."""

    unavailable: Missing


T = TypeVar("T")
A = TypeVar("A")
if TYPE_CHECKING:
    Either: TypeAlias = Union[T, A]  # noqa: UP007 - an alias that takes parameters
    Part: TypeAlias = Union[T, Absent]  # noqa: UP007
else:

    class Either:
        """``Either[T, A]``: a struct, or the other one where it has a key ``unavailable``.

        msgspec decodes a union of two structs only by a tag, which these have not. To msgspec each
        ``Either[T, A]`` is therefore a type of its own, which :func:`choose` decodes.
        """

        def __class_getitem__(cls, kinds: tuple[type, type]) -> type:
            made = ABCMeta("Or".join(kind.__name__ for kind in kinds), (), {"kinds": kinds})
            for kind in kinds:
                made.register(kind)
            return made

    class Part:
        """``Part[T]``: a struct, or :class:`Absent`."""

        def __class_getitem__(cls, kind: type) -> type:
            return Either[kind, Absent]


def choose(either: Any, value: Any) -> Any:
    """Decode an :class:`Either`, as a ``dec_hook`` of msgspec.

    Raises
    ------
    ValueError
        It is none of the two.
    """
    whole, absent = either.kinds
    kind = absent if isinstance(value, dict) and "unavailable" in value else whole
    try:
        return msgspec.convert(value, kind, dec_hook=choose)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error  # so that msgspec adds where this part is


class Schema(Base, frozen=True):
    """Which results these are, and the version of their contract."""

    name: str
    version: Literal["2.0"]


class Student(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose report it is; every part may be empty.

    Attributes
    ----------
    name, id : str
    notes : str
        The student's own words, Markdown.
    """

    name: Annotated[str, Meta(max_length=MAX_PERSON)] = ""
    id: Annotated[str, Meta(max_length=MAX_PERSON)] = ""
    notes: Annotated[str, Meta(max_length=MAX_NOTES_BYTES)] = ""


class FoundMistake(Base, frozen=True):
    """A finding: what is wrong, the numbers that say so, and what to do.

    Its ``consequences`` are what the same cause brings with it; ``spans_s`` says from when to when
    it shows, and is empty where that is throughout.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Literal["error", "warning", "info"]
    message: str
    evidence: dict[str, int | float | str]
    remedy: str
    consequences: tuple[FoundMistake, ...] = ()
    spans_s: tuple[Interval, ...] = ()

    @property
    def ids(self) -> tuple[str, ...]:
        """Its own id and those of its consequences."""
        return (self.id, *(finding.id for finding in self.consequences))


class Provenance(Base, frozen=True):
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
