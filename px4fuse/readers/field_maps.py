"""Maps from message fields to DataFrame columns, as two TOML files define them.

The files are ``px4_topics.toml`` (PX4 topics) and ``mavlink_messages.toml`` (MAVLink messages).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from px4fuse.flight.model import Columns

# Maximum absolute value of valid fields: larger values are from damaged bytes. The largest valid
# values are UNIX times in µs (1.8e15)
MAX_FIELD_VALUE = 1e17


@dataclass(frozen=True)
class Layout:
    """Fields of a topic or message, and the DataFrame columns to which they are converted."""

    # PX4 topic or MAVLink message; empty if the table row has another key for it
    topic: str = ""
    # Required fields, by column; ``name[i]`` is an array element
    columns: Mapping[str, str] = field(default_factory=dict)
    # Optional fields, by column; none for MAVLink messages, which contain all their fields
    optional: Mapping[str, str] = field(default_factory=dict)
    # Factor from field value to column value, by column; 1 if absent
    scale: Mapping[str, float] = field(default_factory=dict)


def expand_layouts(rows: Mapping[str, Any]) -> dict[str, Layout]:
    """Return a :class:`Layout` for each table row, with all column names in full."""
    return {
        name: replace(
            row,
            columns=expand_columns(row.columns),
            optional=expand_columns(row.optional),
            scale=expand_columns(row.scale),
        )
        for name, row in msgspec.convert(rows, dict[str, Layout]).items()
    }


def expand_columns(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Expand groups of columns to one entry per column.

    A key is a list in :class:`Columns`, or names separated by blanks. A value is a number for all
    columns, field names, an array ``q[]``, or elements of an array ``covariance[0 6]``.

    Examples
    --------
    >>> expand_columns({"POSITION": "x y z"})
    {'north_m': 'x', 'east_m': 'y', 'down_m': 'z'}
    >>> expand_columns({"north_m east_m": "position[]"})
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    >>> expand_columns({"north_m2 east_m2": "covariance[0 6]", "w x": 1.0})
    {'north_m2': 'covariance[0]', 'east_m2': 'covariance[6]', 'w': 1.0, 'x': 1.0}
    >>> expand_columns({"a b": "hpos[0] vpos"})
    {'a': 'hpos[0]', 'b': 'vpos'}
    """
    columns: dict[str, Any] = {}
    for column_names, field_names in fields.items():
        column_list: list[str] = (
            getattr(Columns, column_names) if column_names.isupper() else column_names.split()
        )
        if isinstance(field_names, float):
            columns |= dict.fromkeys(column_list, field_names)
            continue
        column_fields = field_names.split()
        if array_match := re.fullmatch(r"([^\[]+)\[([\d ]*)\]", field_names):
            element_indices = array_match[2].split() or range(len(column_list))
            column_fields = [f"{array_match[1]}[{element}]" for element in element_indices]
        columns |= zip(column_list, column_fields, strict=True)
    return columns
