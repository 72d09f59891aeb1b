"""Options that are numbers with a unit, which is not typed."""

from __future__ import annotations

import re
from typing import Any

import click

from px4fuse.request import AUTO

# Name of each unit, and what others are of it
_UNITS: dict[str, tuple[str, dict[str, float]]] = {
    "m": ("metres", {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "in": 0.0254,
                     "ft": 0.3048}),
    "m/s": ("metres per second", {"m/s": 1.0, "mps": 1.0, "cm/s": 1e-2, "km/h": 1.0 / 3.6}),
    "m/s²": ("metres per second squared", {"m/s²": 1.0, "m/s2": 1.0, "m/s^2": 1.0, "m/s/s": 1.0,
                                           "cm/s²": 1e-2, "cm/s2": 1e-2, "mm/s2": 1e-3,
                                           "g": 9.80665, "mg": 9.80665e-3}),
    "s": ("seconds", {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9,
                      "min": 60.0, "h": 3600.0}),
    "°": ("degrees", {"°": 1.0, "deg": 1.0, "degrees": 1.0, "rad": 57.29577951308232}),
    "Hz": ("hertz", {"hz": 1.0, "khz": 1e3}),
}  # fmt: skip
_TYPED = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


class Quantity(click.ParamType["float | str"]):
    """A number in a unit; what is typed with a unit or a comma is told how to be typed.

    Parameters
    ----------
    unit : str
        "m", "m/s", "m/s²", "s", "°" or "Hz".
    example : float
        Shown where what was typed cannot be read.
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

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert what was typed."""
        if self.auto and value == AUTO:
            return str(value)
        name, units = _UNITS[self.unit]
        try:
            number = float(value)
        except ValueError:
            meant = self._meant(value, units)
            example = f"{self.example if meant is None else meant:.12g}"
            self.fail(
                f"{value!r}: give {name}, as {example}{', or auto' if self.auto else ''}.",
                param,
                ctx,
            )
        if self.between is not None and not self.between[0] <= number <= self.between[1]:
            low, high = self.between
            self.fail(f"{value} is not between {low:g} and {high:g} {name}.", param, ctx)
        return number

    def _meant(self, value: str, units: dict[str, float]) -> float | None:
        """What a number with a unit is in ours; None where it cannot be told."""
        typed = _TYPED.fullmatch(value.strip())
        if typed is None or (typed[2] and typed[2].lower() not in units):
            return None
        try:
            return float(typed[1].replace(",", ".")) * units.get(typed[2].lower(), 1.0)
        except ValueError:
            return None
