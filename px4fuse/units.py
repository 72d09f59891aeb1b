"""Numbers as people type them, with the units that they may add."""

import re
from collections.abc import Mapping
from typing import Any

from px4fuse.record import table

_UNITS = table(__file__, "units.toml", dict[str, dict[str, Any]])
# Of each of our units how it is called, and units that people type, in it
NAMES: Mapping[str, str] = _UNITS["names"]
_SCALES: Mapping[str, Mapping[str, float]] = _UNITS["typed"]
_TYPED = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def in_unit(typed: str, unit: str) -> float | None:
    """A number typed with or without a unit, in one of our units; None where it is not one.

    >>> in_unit("10cm", "m"), in_unit("0,5", "s"), in_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    found = _TYPED.fullmatch(typed.strip())
    scale = _SCALES.get(unit, {}).get(found[2].lower() or unit.lower()) if found else None
    if found is None or scale is None:
        return None
    try:
        return float(found[1].replace(",", ".")) * scale
    except ValueError:  # several points
        return None
