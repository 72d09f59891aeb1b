"""What all records share: they are frozen and strict, and are written as they are.

Names carry units. A number that could not be computed is left out, or an :class:`Unavailable`
stands in place of the part that it belongs to; it is never zero.
"""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeAlias, TypeVar, Union

import msgspec
from msgspec import Meta

NotNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Correlation = Annotated[float, Meta(ge=-1.0, le=1.0)]
Count = Annotated[int, Meta(ge=0)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Span = tuple[float, float]
Vector = tuple[float, float, float]


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A fact as it is computed and written: no field but its own, and what is None is left out.

    Attributes
    ----------
    schema_type : type or None
        Of a record that carries arrays or tables too: its base, which has what is written.
    """

    schema_type: ClassVar[type[Record] | None] = None


class Unavailable(Record, frozen=True):
    """Something that was looked for and not found; it stands in place of what it would have been.

    Attributes
    ----------
    what : str
        What is missing, as a noun phrase ("EKF2 innovations").
    reason : str
        Why, in terms of the log ("no topic vehicle_attitude").
    remedy : str
        What would have logged it, or what to do instead.
    source : str
        Name of the position source that this is; empty where it is something else.
    """

    what: str
    reason: str
    remedy: str
    source: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.reason}. {self.remedy}"


T = TypeVar("T")
A = TypeVar("A")
if TYPE_CHECKING:
    RecordOrUnavailable: TypeAlias = Union[T, A]  # noqa: UP007 - an alias that takes parameters
    OrUnavailable: TypeAlias = Union[T, Unavailable]  # noqa: UP007
else:

    class RecordOrUnavailable:
        """``RecordOrUnavailable[T, A]``: a record, or the other one, a kind of :class:`Unavailable`.

        msgspec decodes a union of two structs only by a tag, which these have not. To msgspec each
        ``RecordOrUnavailable[T, A]`` is therefore a type of its own, which :func:`decode_record_or_unavailable` decodes.
        """

        def __class_getitem__(cls, kinds: tuple[type, type]) -> type:
            either_type = ABCMeta("Or".join(kind.__name__ for kind in kinds), (), {"kinds": kinds})
            for kind in kinds:
                either_type.register(kind)
            return either_type

    class OrUnavailable:
        """``OrUnavailable[T]``: a record, or :class:`Unavailable`."""

        def __class_getitem__(cls, kind: type) -> type:
            return RecordOrUnavailable[kind, Unavailable]


def decode_record_or_unavailable(union_type: Any, value: Any) -> Any:
    """Decode an :class:`RecordOrUnavailable`, as a ``dec_hook`` of msgspec.

    Raises
    ------
    ValueError
        It is none of the two.
    """
    record_type, unavailable_type = union_type.kinds
    kind = (
        unavailable_type
        if isinstance(value, dict) and {"what", "reason"} <= value.keys()
        else record_type
    )
    try:
        return msgspec.convert(value, kind, dec_hook=decode_record_or_unavailable)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error  # so that msgspec adds where this part is


def to_serializable(value: Any) -> Any:
    """What is written of a record, without the arrays that it carries, in all its parts."""
    if isinstance(value, Record):
        kind = value.schema_type or type(value)
        return kind(
            **{name: to_serializable(getattr(value, name)) for name in kind.__struct_fields__}
        )
    if isinstance(value, Mapping):
        return {key: to_serializable(part) for key, part in value.items()}
    return tuple(map(to_serializable, value)) if isinstance(value, tuple) else value


def table(beside: str, name: str, kind: type[T]) -> T:
    """A table of the package, in a TOML file beside a module.

    Parameters
    ----------
    beside : str
        ``__file__`` of the module.
    name : str
        Of the table's file.
    kind : type
        What it holds.
    """
    return msgspec.toml.decode(Path(beside).with_name(name).read_bytes(), type=kind)


_MISSING_DATA = table(__file__, "lacking.toml", dict[str, Unavailable])


def missing_data(name: str, /, **facts: object) -> Unavailable:
    """What was looked for and not found, in the words of ``missing_data.toml``.

    Examples
    --------
    >>> str(missing_data("measurements_few", what="tuning", count=3, least=30)).partition(". ")[0]
    'tuning: 3 measurements are too few (at least 30)'
    """
    row = _MISSING_DATA[name]
    return Unavailable(*(text.format(**facts) for text in (row.what, row.reason, row.remedy)))
