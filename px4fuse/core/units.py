"""Parsing of numbers with a unit, for example "10cm"."""

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from px4fuse.core.record import read_toml

_UNIT_TABLES = read_toml(__file__, dict[str, dict[str, Any]])
# Full name of each unit, by its symbol
UNIT_NAMES: Mapping[str, str] = _UNIT_TABLES["names"]
# Conversion factors to the base unit of each quantity
_UNIT_FACTORS: Mapping[str, Mapping[str, float]] = _UNIT_TABLES["typed"]
_NUMBER_WITH_UNIT = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def convert_to_unit(text: str, unit: str) -> float | None:
    """Parse a number with or without a unit, and convert it to ``unit``.

    Return None if the text is not a number, or has a unit of another quantity.

    >>> convert_to_unit("10cm", "m"), convert_to_unit("0,5", "s"), convert_to_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    match = _NUMBER_WITH_UNIT.fullmatch(text.strip())
    unit = unit.lower()
    unit_in_text = match[2].lower() or unit if match else ""
    for factors in ({unit: 1.0}, *_UNIT_FACTORS.values()):
        if match and {unit_in_text, unit} <= factors.keys():
            with suppress(ValueError):  # float() rejects several decimal points
                return float(match[1].replace(",", ".")) * (factors[unit_in_text] / factors[unit])
    return None
