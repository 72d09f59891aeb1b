"""Conversion of message fields to DataFrame columns.

The definitions are in ``px4_topics.toml`` and ``mavlink_messages.toml``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from px4fuse.flight.model import Columns

# Maximum absolute value of valid fields, above UNIX times in µs (1.8e15)
MAX_FIELD_VALUE = 1e17


@dataclass(frozen=True)
class Layout:
    """Fields of a PX4 topic or MAVLink message, and the DataFrame columns that they become."""

    # PX4 topic or MAVLink message
    topic: str = ""
    # Message field for each required column, for example ``q[0]``
    columns: Mapping[str, str] = field(default_factory=dict)
    # Message field for each column that only some PX4 releases log
    optional_columns: Mapping[str, str] = field(default_factory=dict)
    # Factor from the message field to the unit of each column; 1 if absent
    scale: Mapping[str, float] = field(default_factory=dict)
    # True if a value is valid until the next sample
    is_step_function: bool = False


def expand_layouts(toml_tables: Mapping[str, Any]) -> dict[str, Layout]:
    """Convert TOML tables to definitions with one message field per column.

    By default, the topic or message is the name of the table.
    """
    rows = {name: {"topic": name, **row} for name, row in toml_tables.items()}
    return {
        name: replace(
            layout,
            columns=assign_fields_to_columns(layout.columns),
            optional_columns=assign_fields_to_columns(layout.optional_columns),
            scale=assign_fields_to_columns(layout.scale),
        )
        for name, layout in msgspec.convert(rows, dict[str, Layout]).items()
    }


def assign_fields_to_columns(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message field of each DataFrame column.

    An empty text stands for the column names, ``q[]`` for all elements of an array, and
    ``covariance[0,6]`` for the elements 0 and 6.

    Examples
    --------
    >>> assign_fields_to_columns({"POSITION": "x,y,z"})
    {'north_m': 'x', 'east_m': 'y', 'down_m': 'z'}
    >>> assign_fields_to_columns({"north_m,east_m": "position[]"})
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    >>> assign_fields_to_columns({"north_m2,east_m2": "covariance[0,6]", "w,x": 1.0})
    {'north_m2': 'covariance[0]', 'east_m2': 'covariance[6]', 'w': 1.0, 'x': 1.0}
    >>> assign_fields_to_columns({"a,b": "hpos[0],vpos"})
    {'a': 'hpos[0]', 'b': 'vpos'}
    """
    columns: dict[str, Any] = {}
    for column_names, field_names in fields.items():
        column_list: list[str] = (
            getattr(Columns, column_names) if column_names.isupper() else column_names.split(",")
        )
        if isinstance(field_names, float):
            columns |= dict.fromkeys(column_list, field_names)
            continue
        column_fields = (field_names or column_names).split(",")
        if array_match := re.fullmatch(r"([^\[]+)\[([\d,]*)\]", field_names):
            element_indices = re.findall(r"\d+", array_match[2]) or range(len(column_list))
            column_fields = [f"{array_match[1]}[{element}]" for element in element_indices]
        columns |= zip(column_list, column_fields, strict=True)
    return columns
