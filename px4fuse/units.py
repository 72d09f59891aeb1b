"""Parsing of numbers that users type with a unit."""

import re
from collections.abc import Mapping
from typing import Any

from px4fuse.record import table

_UNITS = table(__file__, "units.toml", dict[str, dict[str, Any]])
# Name of each unit that px4fuse uses, and factors from units that users may type
NAMES: Mapping[str, str] = _UNITS["names"]
_SCALES: Mapping[str, Mapping[str, float]] = _UNITS["typed"]
_TYPED = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def in_unit(typed: str, unit: str) -> float | None:
    """Parse a number with or without a unit and convert it to ``unit``; None if impossible.

    >>> in_unit("10cm", "m"), in_unit("0,5", "s"), in_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    match = _TYPED.fullmatch(typed.strip())
    scale = _SCALES.get(unit, {}).get(match[2].lower() or unit.lower()) if match else None
    if match is None or scale is None:
        return None
    try:
        return float(match[1].replace(",", ".")) * scale
    except ValueError:  # several decimal points
        return None
