"""Numbers with a unit, which is not typed: who types it is told the number."""

from __future__ import annotations

import math
import re
from typing import Any

import click

from px4fuse.request import AUTO

NAMES = {
    "m": "metres", "m/s": "metres per second", "m/s²": "metres per second squared",
    "s": "seconds", "ms": "milliseconds", "°": "degrees", "Hz": "hertz",
}  # fmt: skip
_LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "in": 0.0254, "ft": 0.3048}
_TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
# Units that people type, in each of ours
_UNITS: dict[str, dict[str, float]] = {
    "m": _LENGTHS,
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "km/h": 1.0 / 3.6},
    "m/s²": {"m/s²": 1.0, "m/s2": 1.0, "m/s^2": 1.0, "cm/s²": 1e-2, "cm/s2": 1e-2,
             "g": 9.80665, "mg": 9.80665e-3},
    "s": _TIMES,
    "ms": {unit: 1e3 * seconds for unit, seconds in _TIMES.items()},
    "°": {"°": 1.0, "deg": 1.0, "degrees": 1.0, "rad": 57.29577951308232},
    "Hz": {"hz": 1.0, "khz": 1e3},
}  # fmt: skip
_TYPED = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def in_unit(typed: str, unit: str) -> float | None:
    """A number typed with a unit or a comma, in one of our units; None where it is not one.

    >>> in_unit("10cm", "m"), in_unit("0,5", "s"), in_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    found = _TYPED.fullmatch(typed.strip())
    scale = _UNITS.get(unit, {}).get(found[2].lower() or unit.lower()) if found else None
    if found is None or scale is None:
        return None
    try:
        return float(f"{float(found[1].replace(',', '.')) * scale:.12g}")
    except ValueError:  # several points
        return None


class TypedQuantity(click.ParamType["float | str"]):
    """A number in a unit.

    Parameters
    ----------
    unit : str
        One of ``NAMES``.
    example : float
        Shown where what was typed cannot be understood.
    auto : bool
        Also take the word ``auto``.
    between : (float, float), optional
        Smallest and largest number.
    """

    name = "number"

    def __init__(
        self,
        unit: str,
        example: float = 0.1,
        *,
        auto: bool = False,
        between: tuple[float, float] | None = None,
    ) -> None:
        self.unit, self.example, self.auto, self.between = unit, example, auto, between

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Its unit, as the help shows what to type."""
        del param, ctx
        unit = "DEG" if self.unit == "°" else self.unit.upper()
        return f"{unit}|auto" if self.auto else unit

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert what was typed."""
        if self.auto and value == AUTO:
            return str(value)
        name = NAMES[self.unit]
        try:
            number = float(value)
        except ValueError:
            meant = in_unit(value, self.unit)
            shown = f"{self.example if meant is None else meant:.12g}"
            self.fail(
                f"{value!r}: give {name}, as {shown}{', or auto' if self.auto else ''}.", param, ctx
            )
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        if self.between is not None and not self.between[0] <= number <= self.between[1]:
            low, high = self.between
            self.fail(f"{value} is not between {low:g} and {high:g} {name}.", param, ctx)
        return number
