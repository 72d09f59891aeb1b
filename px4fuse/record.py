"""Base class of the records in results: immutable, strictly typed, and written without change.

Field names contain the unit. A number that could not be computed is absent, or its record is
replaced by an :class:`Unavailable`; it is never replaced by zero.
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
    """Immutable record; fields that are None are not written.

    Attributes
    ----------
    schema_type : type or None
        For a record that also contains arrays or tables: its base class with the written fields.
    """

    schema_type: ClassVar[type[Record] | None] = None


class Unavailable(Record, frozen=True):
    """Missing data, with reason and action, in place of a record.

    Attributes
    ----------
    what : str
        Missing data as a noun phrase ("EKF2 innovations").
    reason : str
        Reason in terms of the log ("no topic vehicle_attitude").
    remedy : str
        Action: how to log the data, or an alternative.
    source : str
        Name of the position source, if a position source is missing; else empty.
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
    RecordOrUnavailable: TypeAlias = Union[T, A]  # noqa: UP007 - generic alias
    OrUnavailable: TypeAlias = Union[T, Unavailable]  # noqa: UP007
else:

    class RecordOrUnavailable:
        """``RecordOrUnavailable[T, A]``: a record T, or a subclass A of :class:`Unavailable`.

        msgspec needs tags to decode a union of two structs, and the records have none. So each
        union is a separate type, which :func:`decode_record_or_unavailable` decodes.
        """

        def __class_getitem__(cls, kinds: tuple[type, type]) -> type:
            either_type = ABCMeta(
                "Or".join(kind.__name__ for kind in kinds), (), {"union_members": kinds}
            )
            for kind in kinds:
                either_type.register(kind)
            return either_type

    class OrUnavailable:
        """``OrUnavailable[T]``: a record T, or :class:`Unavailable`."""

        def __class_getitem__(cls, kind: type) -> type:
            return RecordOrUnavailable[kind, Unavailable]


def decode_record_or_unavailable(union_type: Any, value: Any) -> Any:
    """Decode a :class:`RecordOrUnavailable`; a ``dec_hook`` of msgspec.

    Raises
    ------
    ValueError
        The value is neither the record nor an Unavailable.
    """
    record_type, unavailable_type = union_type.union_members
    kind = (
        unavailable_type
        if isinstance(value, dict) and {"what", "reason"} <= value.keys()
        else record_type
    )
    try:
        return msgspec.convert(value, kind, dec_hook=decode_record_or_unavailable)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error  # msgspec adds the path to a ValueError


def to_serializable(value: Any) -> Any:
    """Return the written fields of a record and of records in it, without arrays and tables."""
    if isinstance(value, Record):
        kind = value.schema_type or type(value)
        return kind(
            **{name: to_serializable(getattr(value, name)) for name in kind.__struct_fields__}
        )
    if isinstance(value, Mapping):
        return {key: to_serializable(part) for key, part in value.items()}
    return tuple(map(to_serializable, value)) if isinstance(value, tuple) else value


def table(beside: str, name: str, kind: type[T]) -> T:
    """Read a TOML file of the package as a type.

    Parameters
    ----------
    beside : str
        ``__file__`` of a module in the folder of the file.
    name : str
        Name of the TOML file.
    kind : type
        Type of the content.
    """
    return msgspec.toml.decode(Path(beside).with_name(name).read_bytes(), type=kind)
