"""Results as plain data: what JSON can hold, without NaN."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def plain(value: object) -> Any:
    """Dataclasses, mappings and tuples as dicts and lists.

    What is None or not a finite number is left out of a dict, never written as zero or NaN.

    >>> plain({"rate_hz": float("nan"), "topics": ("a", "b")})
    {'topics': ['a', 'b']}
    """
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        made = {str(name): plain(part) for name, part in value.items()}
        return {name: part for name, part in made.items() if part is not None}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def factor_words(factor: float) -> str:
    """A factor with as many digits as a person reads.

    >>> [factor_words(f) for f in (1.18, 9.87, 61.2, 388.0, 3412.0)]
    ['1.18', '9.9', '61', '390', '3,400']
    """
    digits = 3 if factor < 2.0 else 2
    return f"{float(f'{factor:.{digits}g}'):,g}"
