"""Results as plain data: what JSON can hold, without NaN."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any

from px4fuse.flight import Unavailable


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


def unavailable(part: Unavailable) -> dict[str, Any]:
    """What stands where a number could not be computed."""
    return {"unavailable": asdict(part)}


def present(values: dict[str, Any]) -> dict[str, Any]:
    """Without the entries that could not be computed."""
    return {name: value for name, value in values.items() if value is not None}
