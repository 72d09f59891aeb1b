"""Display of results in notebooks: HTML, and records with tables or arrays as short texts."""

from collections.abc import Mapping
from functools import singledispatch
from typing import Any

from msgspec import UnsetType

# Maximum length (characters) of a text field in the representation of a record
MAX_TEXT_LENGTH = 60


@singledispatch
def display_html(result: object) -> str | None:
    """Return a result as HTML for notebooks; None for types without a registered function."""
    return None


def one_line_repr(result: Any) -> str:
    """Format a record on one line, with the shapes of tables and arrays instead of their values.

    >>> import pandas as pd
    >>> from px4fuse.flight.model import Truth
    >>> one_line_repr(Truth("mocap", pd.DataFrame({"north_m": [0.0, 1.0]})))
    "Truth(name='mocap', samples=<2 × 1>)"
    """
    field_names = getattr(result, "__struct_fields__", None) or result.__dataclass_fields__
    values = ((name, getattr(result, name)) for name in field_names)
    field_texts = ", ".join(
        f"{name}={_format_value(value)}"
        for name, value in values
        if not isinstance(value, UnsetType | None)
    )
    return f"{type(result).__name__}({field_texts})"


def _format_value(value: Any) -> str:
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
