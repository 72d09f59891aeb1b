"""Interpretation of column names in position files, such as "x_m", "East [mm]" or "bag_time"."""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from px4fuse.core.record import read_toml

SECONDS_BY_TIME_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES_BY_LENGTH_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}

# Column indices of x, y and z; z is None without height
PositionColumns = tuple[int, int, int | None]
_WORD_TABLES = read_toml(__file__, dict[str, dict[str, str]])
_UNIT_BY_WORD, _AXIS_BY_WORD = (
    {
        word: meaning
        for meaning, column_words in _WORD_TABLES[group].items()
        for word in column_words.split(",")
    }
    for group in ("units", "axes")
)
_WORDS_BY_ROLE = {
    role: {*column_words.split(",")} for role, column_words in _WORD_TABLES["roles"].items()
}
_TIME_WORDS = {
    word for role in ("time", "measured", "recorded", "context") for word in _WORDS_BY_ROLE[role]
}
# Kinds of time columns, in order of preference
TIME_KINDS = ["time of measurement", "time", "time of recording"]
# Two words without separator, such as "px" (position, x) and "xstd" (x, sigma)
_NAME_WITHOUT_SEPARATOR_PATTERN = re.compile(
    r"(pos|p|t|sigma|std|s)([xyzneud])|([xyz])(pos|std|sigma)"
)
# Quaternion components, such as "qx", "q_RS_w []" and "pose.orientation.x"
_QUATERNION_NAME_PATTERN = re.compile(r"(?:\bq|orientation|rotation|quat)(?:\w*_|[ .])?([wxyz])\b")
# Axis names by coordinate frame, in order of preference
_AXIS_NAMES_BY_FRAME: tuple[tuple[str | None, tuple[str, str, str]], ...] = (
    ("ned", ("north", "east", "down")),
    ("enu", ("east", "north", "up")),
    (None, ("x", "y", "z")),
    (None, ("x", "y", "up")),
    (None, ("x", "y", "down")),
)


@dataclass(frozen=True)
class ColumnMeaning:
    """Quantity, axis and unit in a column name; empty texts if the name is unknown.

    Attributes
    ----------
    kind : str
        "time", "position", "sigma" or "tag" (number of a UWB tag).
    axis : str
        Axis of a position or sigma, such as "x" or "north".
    name_without_axis_and_unit : str
        Column name without axis and unit.
    time_kind : str
        Kind of a time, for example "time of measurement".
    """

    kind: str = ""
    axis: str = ""
    unit: str = ""
    name_without_axis_and_unit: str = ""
    time_kind: str = ""


def read_column_name(name: str) -> ColumnMeaning:
    """Find quantity, axis and unit in a column name."""
    snake_case_name = unicodedata.normalize("NFKC", name).replace("μ", "u")
    snake_case_name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", snake_case_name).lower()
    words = re.findall(r"[^\W_]+", snake_case_name) or [""]
    # 1. Unit: the last word, for example "m" in "pos_x_m"
    unit = _UNIT_BY_WORD.get(words[-1], "")
    if len(words) == 1:
        # A unit alone, such as "sec", is a time. A short unit alone, such as "s" or "ms", is none
        if unit in SECONDS_BY_TIME_UNIT and len(words[0]) > 2:
            return ColumnMeaning("time", unit=unit, time_kind="time")
        unit = ""
    elif unit:
        words.pop()
    # 2. Times, or numbers of UWB tags: the column name contains only words that are known for such
    # columns
    word_set = {*words}
    is_time = bool(word_set & _WORDS_BY_ROLE["time"]) and word_set <= _TIME_WORDS
    if is_time and unit not in METRES_BY_LENGTH_UNIT:
        time_kind = "time"
        if word_set & _WORDS_BY_ROLE["measured"]:
            time_kind = "time of measurement"
        elif word_set & _WORDS_BY_ROLE["recorded"]:
            time_kind = "time of recording"
        return ColumnMeaning("time", unit=unit, time_kind=time_kind)
    if word_set <= _WORDS_BY_ROLE["tag"]:
        return ColumnMeaning("tag")
    # 3. Positions or their σ: first split words without separator. For example, "px" means position
    # and axis x
    sigma_and_context_words = _WORDS_BY_ROLE["sigma"] | _WORDS_BY_ROLE["context"]
    split_words: list[str] = []
    for word in words:
        match = _NAME_WITHOUT_SEPARATOR_PATTERN.fullmatch(word)
        if match and word not in sigma_and_context_words:
            split_words += filter(None, match.groups())
        else:
            split_words.append(word)
    axes = [_AXIS_BY_WORD[word] for word in split_words if word in _AXIS_BY_WORD]
    other_words = [word for word in split_words if word not in _AXIS_BY_WORD]
    # The name of a position or σ column contains at most one axis, no time unit and no unknown word
    is_known = (
        unit not in SECONDS_BY_TIME_UNIT
        and len(axes) <= 1
        and {*other_words} <= sigma_and_context_words
    )
    if is_known and {*other_words} & _WORDS_BY_ROLE["sigma"]:
        return ColumnMeaning("sigma", "".join(axes), unit)
    if is_known and axes:
        return ColumnMeaning("position", axes[0], unit, ".".join(other_words))
    return ColumnMeaning()


def find_position_columns(
    column_meanings: Sequence[ColumnMeaning],
) -> tuple[str | None, PositionColumns] | None:
    """Return the coordinate frame of the position, and the column indices of its axes.

    Return None if no column contains a position.
    """
    column_by_name_and_axis: dict[str, dict[str, int]] = {}
    for index, column in enumerate(column_meanings):
        if column.kind == "position":
            columns_by_axis = column_by_name_and_axis.setdefault(
                column.name_without_axis_and_unit, {}
            )
            columns_by_axis.setdefault(column.axis, index)
    for axis_count in (3, 2):
        for columns_by_axis in column_by_name_and_axis.values():
            for frame, axes in _AXIS_NAMES_BY_FRAME:
                # x, y, z, w is a quaternion
                if {*axes[:axis_count]} <= columns_by_axis.keys() and "w" not in columns_by_axis:
                    return frame, (
                        columns_by_axis[axes[0]],
                        columns_by_axis[axes[1]],
                        columns_by_axis.get(axes[2]),
                    )
    return None


def find_sigma_columns(
    column_meanings: Sequence[ColumnMeaning], frame: str | None
) -> tuple[int | None, ...]:
    """Return the index of the σ column for each axis."""
    sigma_columns: dict[str, int] = {}
    for index, meaning in enumerate(column_meanings):
        if meaning.kind == "sigma":
            sigma_columns.setdefault(meaning.axis, index)
    axes = next(axes for name, axes in _AXIS_NAMES_BY_FRAME if name == frame)
    # The name contains the axis of the frame ("sigma_north"), the letter ("sigma_x"), or, for one
    # σ of all axes, no axis ("sigma")
    return tuple(
        sigma_columns.get(axis, sigma_columns.get(letter, sigma_columns.get("")))
        for axis, letter in zip(axes, "xyz", strict=True)
    )


def find_quaternion_columns(names: Sequence[str]) -> list[int]:
    """Return the column indices of the quaternion (x, y, z, w); empty without quaternion."""
    indices: dict[str, int] = {}
    for index, name in enumerate(names):
        if match := _QUATERNION_NAME_PATTERN.search(name.casefold()):
            indices.setdefault(match[1], index)
    return [indices[axis] for axis in "xyzw"] if len(indices) == 4 else []
