"""Base class of immutable data classes, and :class:`Unavailable` for missing data."""

from __future__ import annotations

import csv
from abc import ABCMeta
from collections.abc import Mapping
from functools import singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar, Union, dataclass_transform

import msgspec
from msgspec import Meta, UnsetType

# Maximum length (characters) of a text in ``repr`` of a record
MAX_TEXT_LENGTH = 60


@singledispatch
def display_html(result: object) -> str | None:
    """Return a result as HTML for Jupyter notebooks; None for types without HTML."""
    return None


def one_line_repr(result: Any) -> str:
    """Format a data class on one line; arrays and tables are replaced by their shape.

    >>> import pandas as pd
    >>> from px4fuse.flight.model import Truth
    >>> one_line_repr(Truth("mocap", pd.DataFrame({"north_m": [0.0, 1.0]})))
    "Truth(name='mocap', samples=<2 × 1>)"
    """
    field_names = getattr(result, "__struct_fields__", None) or result.__dataclass_fields__
    values = ((name, getattr(result, name)) for name in field_names)
    fields_text = ", ".join(
        f"{name}={_format_value(value)}"
        for name, value in values
        if not isinstance(value, UnsetType | None)
    )
    return f"{type(result).__name__}({fields_text})"


def _format_value(value: Any) -> str:
    """Format a value of a data class in a short form, by its type."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str):
        return repr(
            value if len(value) <= MAX_TEXT_LENGTH else f"{value[: MAX_TEXT_LENGTH - 3]}..."
        )
    if shape := getattr(value, "shape", ()):
        return f"<{' × '.join(f'{length:,}' for length in shape)}>"
    if isinstance(value, int):
        return repr(value)
    return f"<{len(value):,}>" if isinstance(value, Mapping | tuple) else type(value).__name__


NonNegativeFloat = Annotated[float, Meta(ge=0.0)]
PositiveFloat = Annotated[float, Meta(gt=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Correlation = Annotated[float, Meta(ge=-1.0, le=1.0)]
Count = Annotated[int, Meta(ge=0)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Span = tuple[float, float]
Vector = tuple[float, float, float]


# Default value of fields that are not written to the JSON results
NOT_IN_JSON: Any = msgspec.UNSET


# With this decorator, type checkers report an assignment to a field of a subclass as an error
@dataclass_transform(frozen_default=True)
class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Immutable data class; fields that are None are not written to the JSON results."""

    __repr__ = one_line_repr


class Unavailable(Record):
    """Reason why data are missing, returned instead of the data.

    Attributes
    ----------
    what : str
        Missing data, for example "EKF2 innovations".
    reason : str
        Cause in the log, for example "no topic vehicle_attitude".
    remedy : str
        Advice to the user, for example a setting to log the data.
    source : str
        Name of the missing position source; "" for other data.
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
    NotInJson: TypeAlias = Annotated[T, "not written"]
else:

    class NotInJson:
        """Type of fields, such as arrays, that are not written to the JSON results."""

        def __class_getitem__(cls, kind: object) -> type:
            return msgspec.UnsetType

    class RecordOrUnavailable:
        """Union of a record type and a subclass of :class:`Unavailable`.

        msgspec cannot decode this union; :func:`decode_record_or_unavailable` does.
        """

        def __class_getitem__(cls, member_types: tuple[type, type]) -> type:
            """Return the type ``RecordOrUnavailable[A, B]``; objects of A and B are instances."""
            union_class = ABCMeta(
                "Or".join(kind.__name__ for kind in member_types),
                (),
                {"union_members": member_types},
            )
            for kind in member_types:
                union_class.register(kind)
            return union_class

    class OrUnavailable:
        """Union of a record type and :class:`Unavailable`."""

        def __class_getitem__(cls, kind: type) -> type:
            return RecordOrUnavailable[kind, Unavailable]


def decode_record_or_unavailable(union_type: Any, value: Any) -> Any:
    """Decode a record or :class:`Unavailable` (argument ``dec_hook`` of msgspec)."""
    record_type, unavailable_type = union_type.union_members
    record_class = (
        unavailable_type
        if isinstance(value, dict) and {"what", "reason"} <= value.keys()
        else record_type
    )
    try:
        return msgspec.convert(value, record_class, dec_hook=decode_record_or_unavailable)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error  # msgspec adds the path of the value to the message


def read_toml(module_file: str, kind: type[T], name: str = "") -> T:
    """Read a TOML file in the folder of a module, and convert it to the type ``kind``.

    Parameters
    ----------
    module_file : str
        ``__file__`` of the module.
    name : str
        Name of the TOML file; by default the module name with the suffix .toml.
    """
    path = Path(module_file).with_suffix(".toml")
    return msgspec.toml.decode((path.with_name(name) if name else path).read_bytes(), type=kind)


def read_csv(module_file: str, row_type: type[T], name: str) -> tuple[T, ...]:
    """Read a CSV file in the folder of a module, and convert each row to the type ``row_type``."""
    with Path(module_file).with_name(name).open(encoding="utf-8") as file:
        return tuple(msgspec.convert(row, row_type, strict=False) for row in csv.DictReader(file))
