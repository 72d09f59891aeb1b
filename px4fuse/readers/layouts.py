"""How a topic or message holds a quantity: the rows of the tables of both formats.

The tables are ``px4_topics.toml`` and ``mavlink_messages.toml``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from px4fuse.flight import Columns

# No field reaches it, flags and UNIX times in µs (1.8e15) included
IMPOSSIBLE = 1e17
GLOBAL_COLUMNS = ["latitude_deg", "longitude_deg", "altitude_m"]


@dataclass(frozen=True)
class Layout:
    """One way in which a quantity is written.

    Attributes
    ----------
    topic : str
        A PX4 topic or a MAVLink message; empty where the table names it elsewhere.
    columns : mapping
        Our column name to the field's name, ``name[i]`` for an element; all must be present.
    optional : mapping
        Further columns, read where the topic has them.
    scale : mapping
        Our unit per unit of the field, by our column name; 1 where there is none.
    """

    topic: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    optional: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)


def expand_layouts(rows: Mapping[str, Any]) -> dict[str, Layout]:
    """Rows as they are written, with every column named."""
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
    """Columns one by one, of which a row names several at once.

    Parameters
    ----------
    fields : mapping
        Names of columns with blanks between them, or of a list of :class:`Columns`; and their
        fields with blanks between them, elements of one field (``name[]`` from the first on,
        ``name[0 6 11]``), or a number for all of them.

    Examples
    --------
    >>> expand_columns({"POSITION": "x y z"})
    {'north_m': 'x', 'east_m': 'y', 'down_m': 'z'}
    >>> expand_columns({"north_m east_m": "position[]"})
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    """
    columns: dict[str, Any] = {}
    for column_names, field_names in fields.items():
        names: list[str] = (
            getattr(Columns, column_names) if column_names.isupper() else column_names.split()
        )
        if isinstance(field_names, float):
            columns |= dict.fromkeys(names, field_names)
            continue
        name, is_array, elements = field_names.removesuffix("]").partition("[")
        element_numbers = elements.split() or range(len(names))
        column_fields = (
            [f"{name}[{place}]" for place in element_numbers] if is_array else field_names.split()
        )
        columns |= zip(names, column_fields, strict=True)
    return columns
