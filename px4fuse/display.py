"""How results show themselves in a notebook.

What each result has to say stands in :mod:`px4fuse.notebook`, which knows them all; here is what
they have in common.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

MAX_TEXT, MAX_ROWS = 60, 12


def brief(result: Any) -> str:
    """A record on one line, its tables and arrays by their shapes.

    >>> import pandas as pd
    >>> from px4fuse.flight import Truth
    >>> brief(Truth("mocap", pd.DataFrame({"north_m": [0.0, 1.0]})))
    "Truth(name='mocap', samples=<2 × 1>)"
    """
    names = getattr(result, "__struct_fields__", None) or result.__dataclass_fields__
    values = ((name, getattr(result, name)) for name in names)
    said = ", ".join(f"{name}={_short(value)}" for name, value in values if value is not None)
    return f"{type(result).__name__}({said})"


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str):
        return repr(value if len(value) <= MAX_TEXT else f"{value[: MAX_TEXT - 3]}...")
    if shape := getattr(value, "shape", ()):
        return f"<{' × '.join(f'{length:,}' for length in shape)}>"
    if isinstance(value, int):
        return repr(value)
    return f"<{len(value):,}>" if isinstance(value, Mapping | tuple) else type(value).__name__


@singledispatch
def words(result: object) -> str:
    """A result in one line or a few."""
    return brief(result)


@singledispatch
def frame(result: object) -> pd.DataFrame:
    """A result as a table."""
    raise TypeError(f"{type(result).__name__} has no table")


@singledispatch
def draw(result: object, **options: Any) -> Any:
    """Draw a result."""
    raise TypeError(f"{type(result).__name__} has no picture")


def as_html(text: str, table: pd.DataFrame) -> str:
    """A text above a table, as a notebook shows it."""
    shown = table.to_html(
        max_rows=MAX_ROWS,
        float_format=lambda value: f"{value:.4g}",
        na_rep="",
        index=table.index.name is not None,
    )
    return f"<pre>{escape(text)}</pre>{shown}"


class Shown:
    """A result that shows itself: as text, as a table, as a picture."""

    __slots__ = ()

    def __repr__(self) -> str:
        return words(self)

    def _repr_html_(self) -> str:
        return as_html(words(self), frame(self))

    def to_frame(self) -> pd.DataFrame:
        """Its numbers as a table, with units in the names of the columns.

        What is not available is missing.
        """
        return frame(self)

    def plot(self, **options: Any) -> Any:
        """Draw it.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; by default in a figure of its own.
        axis : str, optional
            Of a comparison: "north", "east", "down" or "aisle".

        Returns
        -------
        Axes, or an array of them
        """
        return draw(self, **options)
