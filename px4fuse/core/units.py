"""Parsing of numbers that users type with a unit."""

import re
from collections.abc import Mapping
from typing import Any

from px4fuse.core.record import read_toml

_UNITS = read_toml(__file__, dict[str, dict[str, Any]])
# Full name of each unit, by its symbol
UNIT_NAMES: Mapping[str, str] = _UNITS["names"]
# Factors that convert typed units to a unit of px4fuse, by the unit of px4fuse
_SCALES_BY_UNIT: Mapping[str, Mapping[str, float]] = _UNITS["typed"]
_NUMBER_WITH_UNIT = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def convert_to_unit(text: str, unit: str) -> float | None:
    """Parse a number with or without a unit, and convert it to ``unit``.

    Return None if the text is no number or has another kind of unit.

    >>> convert_to_unit("10cm", "m"), convert_to_unit("0,5", "s"), convert_to_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    match = _NUMBER_WITH_UNIT.fullmatch(text.strip())
    scale = _SCALES_BY_UNIT.get(unit, {}).get(match[2].lower() or unit.lower()) if match else None
    if match is None or scale is None:
        return None
    try:
        return float(match[1].replace(",", ".")) * scale
    except ValueError:  # the text contains several decimal points
        return None
