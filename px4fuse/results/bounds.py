"""Valid range of each number in the JSON results, from the name of its field."""

import math
import re
from collections.abc import Mapping
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec.structs import fields, replace

from px4fuse.core.record import Unavailable
from px4fuse.errors import ResultsError

# Maximum absolute values in results: lengths (m), and statistics such as NIS, ratios and factors
MAX_ABSOLUTE_LENGTH_M, MAX_ABSOLUTE_RATIO = 1e9, 1e6
# Valid range of a number, by pattern of its field name; the first match applies
RANGE_BY_FIELD_PATTERN = {
    r"(^|_)(nis|nees)($|_)": (0.0, MAX_ABSOLUTE_RATIO),
    r"(enabled|fused|lost|rejected)_fraction($|_)": (0.0, 1.0),
    r"(^|_)correlation$": (-1.0, 1.0),
    r"(^|_)(ratio|factor)($|_)": (-MAX_ABSOLUTE_RATIO, MAX_ABSOLUTE_RATIO),
    r"_m$": (-MAX_ABSOLUTE_LENGTH_M, MAX_ABSOLUTE_LENGTH_M),
}
CHECK_LOG_REMEDY = "Check the logged data."
T = TypeVar("T", bound=msgspec.Struct)


class _OutOfBoundsError(Exception):
    """Number in results outside its valid range."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(reason)
        self.path, self.reason = path, reason


def find_field_bounds(name: str) -> tuple[float, float]:
    """Return the smallest and the largest valid value of a field in the results.

    >>> find_field_bounds("nis_mean"), find_field_bounds("start_s")
    ((0.0, 1000000.0), (-inf, inf))
    """
    matching_bounds = (
        bounds for pattern, bounds in RANGE_BY_FIELD_PATTERN.items() if re.search(pattern, name)
    )
    return next(matching_bounds, (-math.inf, math.inf))


def drop_invalid_numbers(results: T) -> T:
    """Remove numbers outside their valid range from results.

    The reasons are added to ``missing`` or ``notes``.

    Raises
    ------
    ResultsError
        The results are not valid without the number.
    """
    errors: list[_OutOfBoundsError] = []
    try:
        checked_results: T = _drop_invalid_values(results, None, "", errors)
    except _OutOfBoundsError as error:
        raise ResultsError(
            f"a required result is not valid: {error.reason}", CHECK_LOG_REMEDY
        ) from error
    if hasattr(checked_results, "missing"):
        unavailable_numbers = (
            Unavailable(error.path, error.reason, CHECK_LOG_REMEDY) for error in errors
        )
        return replace(checked_results, missing=(*checked_results.missing, *unavailable_numbers))
    if hasattr(checked_results, "notes"):
        reasons = (error.reason for error in errors)
        return replace(checked_results, notes=(*checked_results.notes, *reasons))
    return checked_results


def list_types(annotation: Any) -> tuple[Any, ...]:
    """Return the types in a type annotation, for example float and None for ``float | None``."""
    if get_origin(annotation) is Annotated:
        return list_types(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return tuple(member for part in get_args(annotation) for member in list_types(part))
    return getattr(annotation, "union_members", (annotation,))


def find_value_type(annotation: Any) -> Any:
    """Return the type of the values of a mapping, such as float for ``Mapping[str, float]``."""
    for member in list_types(annotation):
        match get_args(member):
            case [_, value_type]:
                return value_type
    return Any


def _drop_invalid_values(
    value: Any, annotation: Any, path: str, errors: list[_OutOfBoundsError]
) -> Any:
    """Return the value without invalid numbers, or an Unavailable if ``annotation`` allows it."""
    try:
        if isinstance(value, msgspec.Struct):
            return _drop_invalid_fields(value, path, errors)
        if isinstance(value, Mapping):
            return _drop_invalid_entries(value, annotation, path, errors)
        if isinstance(value, tuple):
            return _drop_invalid_elements(value, path, errors)
        if isinstance(value, float):
            _require_valid_number(value, path)
    except _OutOfBoundsError as error:
        # the value is a record with an invalid number: replace the record by the reason, if its
        # field allows this
        for unavailable_type in list_types(annotation):
            if isinstance(unavailable_type, type) and issubclass(unavailable_type, Unavailable):
                text_fields = {"what": path, "reason": error.reason, "remedy": CHECK_LOG_REMEDY}
                # Keep the fields that the Unavailable type also has, for example the errors of a
                # filter against ground truth if its NIS is not valid
                kept_fields = {
                    field.name: _drop_invalid_values(
                        getattr(value, field.name), field.type, path, errors
                    )
                    for field in fields(unavailable_type)
                    if field.name not in text_fields and hasattr(value, field.name)
                }
                return unavailable_type(**text_fields, **kept_fields)
        # A reason cannot be stored in this field: the caller removes the value or its record
        raise
    return value


def _require_valid_number(value: float, path: str) -> None:
    """Raise ``_OutOfBoundsError`` if a number is not finite, or outside the range of its field."""
    low, high = find_field_bounds(path.rpartition(".")[2])
    if not math.isfinite(value):
        raise _OutOfBoundsError(path, f"{path} has a value that is not finite")
    if not low <= value <= high:
        raise _OutOfBoundsError(path, f"{path} is {value:.3g} (allowed: {low:g} to {high:g})")


def _drop_invalid_fields(
    value: msgspec.Struct, path: str, errors: list[_OutOfBoundsError]
) -> msgspec.Struct:
    """Return a copy of a record in which invalid values are None; append their errors to a list."""
    changes: dict[str, Any] = {}
    for field in fields(value):
        if field.type is msgspec.UnsetType:  # not in the JSON results, for example an array
            continue
        field_value, field_path = getattr(value, field.name), f"{path}.{field.name}".lstrip(".")
        try:
            changes[field.name] = _drop_invalid_values(field_value, field.type, field_path, errors)
        except _OutOfBoundsError as error:
            if field.default is not None:  # only fields with the default None may be missing
                raise
            errors.append(error)
            changes[field.name] = None
    return type(value)(**changes)


def _drop_invalid_entries(
    value: Mapping[str, Any], annotation: Any, path: str, errors: list[_OutOfBoundsError]
) -> Any:
    """Return a copy of a mapping without invalid entries; append their errors to a list."""
    checked_elements: dict[str, Any] = {}
    for key, element in value.items():
        try:
            checked_elements[key] = _drop_invalid_values(
                element, find_value_type(annotation), f"{path}.{key}", errors
            )
        except _OutOfBoundsError as error:
            errors.append(error)
    # if all entries are invalid, a mapping that must not be empty (Meta(min_length=1)), for example
    # that of the axes, is invalid too
    metadata = get_args(annotation)[1:]
    if value and not checked_elements and any(getattr(meta, "min_length", 0) for meta in metadata):
        raise errors[-1]
    return checked_elements


def _drop_invalid_elements(
    value: tuple[Any, ...], path: str, errors: list[_OutOfBoundsError]
) -> tuple[Any, ...]:
    """Return the valid elements of a tuple.

    An invalid record is omitted, and the error is added to ``errors``. An invalid number raises
    :class:`_OutOfBoundsError`, because the other numbers of the tuple have no meaning without it.
    """
    checked_elements = []
    for element in value:
        try:
            checked_elements.append(_drop_invalid_values(element, Any, path, errors))
        except _OutOfBoundsError as error:
            if not isinstance(element, msgspec.Struct):
                raise
            errors.append(error)
    return tuple(checked_elements)
