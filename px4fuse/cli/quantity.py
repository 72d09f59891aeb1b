"""Numbers with a unit, which is not typed: who types it is told the number."""

from __future__ import annotations

import math
from typing import Any

import click

from px4fuse.request import AUTO
from px4fuse.units import NAMES, in_unit


class TypedQuantity(click.ParamType["float | str"]):
    """A number in a unit.

    Parameters
    ----------
    unit : str
        One of :data:`px4fuse.units.NAMES`.
    example : float
        Shown where what was typed cannot be understood.
    auto : bool
        Also take the word ``auto``.
    """

    name = "number"

    def __init__(self, unit: str, example: float = 0.1, *, auto: bool = False) -> None:
        self.unit, self.example, self.auto = unit, example, auto

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Its unit, as the help shows what to type."""
        del param, ctx
        unit = "DEG" if self.unit == "°" else self.unit.upper() or "NUMBER"
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
        return number
