"""Bounds of the numbers in results: a number outside is absent, with the reason.

The bounds follow from the name of a field, which carries its quantity and unit.
"""

import math
import re
from collections.abc import Mapping
from operator import is_
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec.structs import fields, replace

from px4fuse.errors import ResultsError
from px4fuse.record import Unavailable

# No length of a flight is longer (m), and no ratio of two quantities in it is larger
LONGEST_M, LARGEST_RATIO = 1e9, 1e6
# Lowest and highest value by the name of a field, first match
BOUNDS = {
    r"(^|_)(nis|nees)($|_)": (0.0, LARGEST_RATIO),
    r"(fused|intended|lost|rejected)_share($|_)": (0.0, 1.0),
    r"(^|_)correlation$": (-1.0, 1.0),
    r"(^|_)(ratio|factor)($|_)": (-LARGEST_RATIO, LARGEST_RATIO),
    r"_m$": (-LONGEST_M, LONGEST_M),
}
REMEDY = "Check the values in the log."
T = TypeVar("T", bound=msgspec.Struct)


class _OutsideError(Exception):
    """A number outside its bounds, by the names that lead to it."""


def bounds_of(name: str) -> tuple[float, float]:
    """Lowest and highest value of a field.

    >>> bounds_of("nis_mean"), bounds_of("position_rmse_m"), bounds_of("start_s")
    ((0.0, 1000000.0), (-1000000000.0, 1000000000.0), (-inf, inf))
    """
    found = (bounds for pattern, bounds in BOUNDS.items() if re.search(pattern, name))
    return next(found, (-math.inf, math.inf))


def within_bounds(results: T) -> T:
    """Take numbers outside their bounds out of results; the same object if there are none.

    An optional number is left out; the part of which a required one is, is unavailable or left out.
    The reasons are added to ``missing`` or ``notes`` of the results, where they have these.

    Raises
    ------
    ResultsError
        A required number outside its bounds has no part that can be left out.
    """
    reasons: list[str] = []
    try:
        found: T = _part(results, None, "", reasons)
    except _OutsideError as error:
        raise ResultsError(f"no results: {error}", REMEDY) from error
    if not reasons:
        return results
    if hasattr(found, "missing"):
        lacking = (Unavailable(one.split(" ", 1)[0], one, REMEDY) for one in reasons)
        return replace(found, missing=(*found.missing, *lacking))
    return replace(found, notes=(*found.notes, *reasons)) if hasattr(found, "notes") else found


def _kinds(kind: Any) -> tuple[Any, ...]:
    """Types that a field takes."""
    if get_origin(kind) is Annotated:
        return _kinds(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return tuple(one for part in get_args(kind) for one in _kinds(part))
    return getattr(kind, "kinds", (kind,))


def _part(value: Any, kind: Any, path: str, reasons: list[str]) -> Any:
    """Return a part with what is outside left out; raise if that is the part itself."""
    if isinstance(value, float):
        low, high = bounds_of(path.rpartition(".")[2])
        if not math.isfinite(value):
            raise _OutsideError(f"{path} is not a finite number")
        if not low <= value <= high:
            raise _OutsideError(f"{path} is {value:.3g}, its bounds are {low:g} and {high:g}")
        return value
    if isinstance(value, msgspec.Struct):
        return _struct(value, path, reasons)
    if isinstance(value, Mapping):
        return _mapping(value, kind, path, reasons)
    return _tuple(value, path, reasons) if isinstance(value, tuple) else value


def _struct(value: msgspec.Struct, path: str, reasons: list[str]) -> msgspec.Struct:
    changes: dict[str, Any] = {}
    for field in fields(value):
        old, name = getattr(value, field.name), f"{path}.{field.name}".lstrip(".")
        try:
            new = _part(old, field.type, name, reasons)
        except _OutsideError as error:
            if field.default is None:
                reasons.append(str(error))
                new = None
            else:
                new = _instead(old, field.type, name, error, reasons)
        if new is not old:
            changes[field.name] = new
    return replace(value, **changes) if changes else value


def _mapping(value: Mapping[str, Any], kind: Any, path: str, reasons: list[str]) -> Any:
    of_values = next((get_args(one)[1] for one in _kinds(kind) if len(get_args(one)) == 2), Any)
    made: dict[str, Any] = {}
    for key, old in value.items():
        name = f"{path}.{key}"
        try:
            made[key] = _part(old, of_values, name, reasons)
        except _OutsideError as error:
            try:
                made[key] = _instead(old, of_values, name, error, reasons)
            except _OutsideError:
                reasons.append(str(error))
    if not made and any(getattr(meta, "min_length", 0) for meta in get_args(kind)[1:]):
        raise _OutsideError(reasons[-1])
    same = len(made) == len(value) and all(made[key] is value[key] for key in value)
    return value if same else made


def _tuple(value: tuple[Any, ...], path: str, reasons: list[str]) -> tuple[Any, ...]:
    """Records are left out one by one; of numbers, as a vector's, all are needed."""
    made = []
    for old in value:
        try:
            made.append(_part(old, Any, path, reasons))
        except _OutsideError as error:
            if not isinstance(old, msgspec.Struct):
                raise
            reasons.append(str(error))
    same = len(made) == len(value) and all(map(is_, value, made))
    return value if same else tuple(made)


def _instead(
    old: Any, kind: Any, path: str, error: _OutsideError, reasons: list[str]
) -> Unavailable:
    """Make the kind of Unavailable that may stand for a part; raise the error without one."""
    for one in _kinds(kind):
        if isinstance(one, type) and issubclass(one, Unavailable):
            said = {"what": path, "reason": str(error), "remedy": REMEDY}
            kept = {
                field.name: _part(getattr(old, field.name), field.type, path, reasons)
                for field in fields(one)
                if field.name not in said and hasattr(old, field.name)
            }
            return one(**said, **kept)
    raise error
