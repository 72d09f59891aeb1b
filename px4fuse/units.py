"""Numbers as people type them, with the units that they may add."""

import re

NAMES = {
    "m": "metres", "m/s": "metres per second", "m/s²": "metres per second squared",
    "s": "seconds", "ms": "milliseconds", "°": "degrees", "Hz": "hertz",
    "gauss": "gauss", "%": "percent", "ppm": "parts per million", "": "a number",
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
    "gauss": {"gauss": 1.0, "ga": 1.0, "ut": 0.01, "µt": 0.01},
    "%": {"%": 1.0},
    "ppm": {"ppm": 1.0},
    "": {"": 1.0},
}  # fmt: skip
_TYPED = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)


def in_unit(typed: str, unit: str) -> float | None:
    """A number typed with or without a unit, in one of our units; None where it is not one.

    >>> in_unit("10cm", "m"), in_unit("0,5", "s"), in_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    found = _TYPED.fullmatch(typed.strip())
    scale = _UNITS.get(unit, {}).get(found[2].lower() or unit.lower()) if found else None
    if found is None or scale is None:
        return None
    try:
        return float(found[1].replace(",", ".")) * scale
    except ValueError:  # several points
        return None
