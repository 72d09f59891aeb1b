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


def one_by_one(rows: Mapping[str, Any]) -> dict[str, Layout]:
    """Rows as they are written, with every column named."""
    return {
        name: replace(
            row,
            columns=columns_of(row.columns),
            optional=columns_of(row.optional),
            scale=columns_of(row.scale),
        )
        for name, row in msgspec.convert(rows, dict[str, Layout]).items()
    }


def columns_of(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Columns one by one, of which a row names several at once.

    Parameters
    ----------
    fields : mapping
        Names of columns with blanks between them, or of a list of :class:`Columns`; and their
        fields with blanks between them, elements of one field (``name[]`` from the first on,
        ``name[0 6 11]``), or a number for all of them.

    Examples
    --------
    >>> columns_of({"POSITION": "x y z"})
    {'north_m': 'x', 'east_m': 'y', 'down_m': 'z'}
    >>> columns_of({"north_m east_m": "position[]"})
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    """
    found: dict[str, Any] = {}
    for ours, theirs in fields.items():
        names: list[str] = getattr(Columns, ours) if ours.isupper() else ours.split()
        if isinstance(theirs, float):
            found |= dict.fromkeys(names, theirs)
            continue
        name, of_field, at = theirs.removesuffix("]").partition("[")
        places = at.split() or range(len(names))
        each = [f"{name}[{place}]" for place in places] if of_field else theirs.split()
        found |= zip(names, each, strict=True)
    return found
