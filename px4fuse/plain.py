"""Results as plain data: what JSON can hold, without NaN; and numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from decimal import Decimal
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


def number_words(value: float, digits: int = 3) -> str:
    """A number with as many digits as a person reads, never with an exponent.

    >>> [number_words(value) for value in (0.811, 22.41, 3412.0, 4.2e6, 0.0129, 2.9e-05, 0.0)]
    ['0.811', '22.4', '3,410', '4,200,000', '0.0129', '0.000029', '0']
    """
    return f"{Decimal(f'{value:.{digits}g}'):,f}"


def factor_words(factor: float) -> str:
    """A factor with as many digits as a person reads.

    >>> [factor_words(f) for f in (1.18, 9.87, 61.2, 388.0, 3412.0, 5.13e6)]
    ['1.18', '9.9', '61', '390', '3,400', '5,100,000']
    """
    return number_words(factor, 3 if factor < 2.0 else 2)


def p_words(p: float) -> str:
    """A p-value as it is read: small is small.

    >>> [p_words(p) for p in (0.43, 0.0214, 0.00051, 3e-113, 0.0)]
    ['p 0.43', 'p 0.021', 'p < 0.001', 'p < 0.001', 'p < 0.001']
    """
    return "p < 0.001" if p < 0.001 else f"p {number_words(p, 2)}"
