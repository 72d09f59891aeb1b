"""Results as plain data: what JSON can hold, without NaN; and numbers as people read them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import msgspec

from px4fuse.record import table


def to_json_types(value: object) -> Any:
    """Records, mappings and tuples as dicts and lists.

    What is None or not a finite number is left out of a dict, never written as zero or NaN.

    >>> to_json_types({"rate_hz": float("nan"), "topics": ("a", "b")})
    {'topics': ['a', 'b']}
    """
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        fields_by_name = {str(name): to_json_types(part) for name, part in value.items()}
        return {name: part for name, part in fields_by_name.items() if part is not None}
    if isinstance(value, list | tuple):
        return [to_json_types(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def utc_time(unix_s: float | None) -> str | None:
    """ISO 8601 with milliseconds; None where it is not known, or a clock is beyond the calendar.

    >>> utc_time(1.5), utc_time(1e18)
    ('1970-01-01T00:00:01.500+00:00', None)
    """
    if unix_s is None:
        return None
    try:
        return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):
        return None


def format_number(value: float, digits: int = 3) -> str:
    """A number with as many digits as a person reads, never with an exponent.

    >>> [format_number(value) for value in (0.811, 22.41, 3412.0, 4.2e6, 0.0129, 2.9e-05, 0.0)]
    ['0.811', '22.4', '3,410', '4,200,000', '0.0129', '0.000029', '0']
    """
    return f"{Decimal(f'{value:.{digits}g}'):,f}"


def format_factor(factor: float) -> str:
    """A factor with as many digits as a person reads.

    >>> [format_factor(f) for f in (1.18, 9.87, 61.2, 388.0, 3412.0, 5.13e6)]
    ['1.18', '9.9', '61', '390', '3,400', '5,100,000']
    """
    return format_number(factor, 3 if factor < 2.0 else 2)


def capitalise_first(text: str) -> str:
    """A text that begins with a capital letter; the rest of it stays as it is."""
    return text[:1].upper() + text[1:]


def join_first(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first few of several names, and how many more there are.

    >>> join_first("abcd", 2), join_first("ab", 2)
    ('a, b and 2 more', 'a, b')
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(names[:most]) + more


def format_p_value(p: float) -> str:
    """A p-value as it is read: small is small.

    >>> [format_p_value(p) for p in (0.43, 0.0214, 0.00051, 3e-113, 0.0)]
    ['p 0.43', 'p 0.021', 'p < 0.001', 'p < 0.001', 'p < 0.001']
    """
    return "p < 0.001" if p < 0.001 else f"p {format_number(p, 2)}"


def format_length(metres: float) -> str:
    """A length as a person says it.

    >>> [format_length(m) for m in (0.0041, 0.0612, 0.336, 1.42, 23.4, 250.0)]
    ['4 mm', '6 cm', '34 cm', '1.4 m', '23 m', '250 m']
    """
    for limit, unit, scale in ((0.0095, "mm", 1e3), (0.995, "cm", 1e2)):
        if metres < limit:
            return f"{metres * scale:.0f} {unit}"
    return f"{metres:.{1 if metres < 9.95 else 0}f} m"


def format_excess(factor: float) -> str:
    """By how much something is too large, from how many times (1 or more) it is.

    >>> [format_excess(f) for f in (1.18, 1.96, 2.4, 24.3)]
    ['18 %', '96 %', '2.4 times', '24 times']
    """
    return (
        f"{factor - 1.0:.0%}".replace("%", " %")
        if factor < 2.0
        else (f"{format_factor(factor)} times")
    )


def sentences(beside: str) -> Callable[..., str]:
    """What says the sentences of the ``words.toml`` beside a module.

    Parameters
    ----------
    beside : str
        ``__file__`` of the module.

    Returns
    -------
    callable
        Takes the name of a sentence, and by name the facts that it is filled with.
    """
    texts = table(beside, "words.toml", dict[str, str])

    def say(which: str, /, **facts: Any) -> str:
        return texts[which].format_map(facts)

    return say
