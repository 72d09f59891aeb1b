"""Reader of CSV files from positioning systems (UWB), in the clock and frame of the file.

The standard format is a header and the columns ``time, x, y, z`` in seconds and metres, optionally
``sigma`` or ``sigma_x, sigma_y, sigma_z``. Other separators, column names and units are detected
and reported. Options override the detected columns and units.
"""

import csv
import hashlib
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, median_interval
from px4fuse.core.reading import display_name, read_bytes_limited
from px4fuse.errors import LogError, SettingsError
from px4fuse.flight.model import NO_INVALID_ROWS, time_index
from px4fuse.readers import position_names
from px4fuse.readers.common import find_invalid, rounding_step
from px4fuse.readers.position_names import LENGTH_UNITS, TIME_UNITS, ColumnMeaning, read_column_name
from px4fuse.readers.text_table import UNIX_END_S, UNIX_START_S, decode_text, quote
from px4fuse.readers.ulog_topics import longest_increasing_run

SIGMA_COLUMNS = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]
SAMPLE_COLUMNS = ["x_m", "y_m", "z_m", *SIGMA_COLUMNS]

# Maximum file size (bytes): several days of UWB positions
MAX_FILE_BYTES = 500_000_000
MIN_ROWS = 3
# Minimum plausible median interval (s): UWB systems send at most 200 positions per second, ±10 %
MIN_INTERVAL_S = 0.9 / 200
# Maximum plausible median interval (s): UWB systems send a position every 5 s or more often, ±10 %
MAX_INTERVAL_S = 1.1 / 0.2
# Maximum median interval (s) of timestamps in UNIX time: boot times in µs can be equally large
# numbers, but they have larger intervals
MAX_UNIX_TIME_INTERVAL_S = 60.0
# Maximum extent (m) of an indoor flight: a larger extent shows that the unit of length is mm
MAX_INDOOR_EXTENT_M = 200.0
# Maximum absolute coordinate in any unit of length: larger values are timestamps or damaged text
MAX_COORDINATE = 1e9
# Number of lines at the beginning of the file in which the header is searched
MAX_HEADER_LINES = 1000
# Number of characters at the beginning of the file in which the header is searched
MAX_HEADER_CHARS = 200_000
MAX_COLUMNS = 200
_COLUMNS_OPTION = "`columns` TIME,X,Y,Z"
_SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}


@dataclass(frozen=True)
class PositionRecording:
    """Content of a position file, in the clock and frame of the file.

    Attributes
    ----------
    name : str
        File name without folder.
    sha256 : str
        SHA-256 hash of the file.
    size_bytes : int
    samples : DataFrame, shape (n, 6)
        ``x_m, y_m, z_m, sigma_x_m, sigma_y_m, sigma_z_m`` (m); NaN if not in the file. The index
        ``time_s`` (s, clock of the file) is strictly increasing. In frame "ned" x is north, y
        east, z down; in "enu" x is east, y north, z up. The order of columns in the file does not
        matter.
    clock : "UNIX" or "local"
        "UNIX" if the timestamps are between 2000 and 2100.
    frame : str or None
        "ned" or "enu" according to the column names; None if they do not contain the frame.
    detected : tuple of str
        One sentence per detected property of the format.
    notes : tuple of str
        Number of dropped rows with the reason, and warnings.
    dropped : int
        Number of rows with an invalid timestamp.
    metres_per_unit : float
        Factor that was applied to the first position column.
    invalid : Series
        Rows without a measurement, as in :class:`~px4fuse.flight.model.PositionTrack`.
    step_m : float
        Rounding step of the coarsest horizontal coordinate; 0 if there is none.
    """

    name: str
    sha256: str
    size_bytes: int
    samples: pd.DataFrame
    clock: Literal["UNIX", "local"]
    frame: str | None
    detected: tuple[str, ...]
    notes: tuple[str, ...]
    dropped: int = 0
    metres_per_unit: float = 1.0
    invalid: "pd.Series[str]" = field(default_factory=lambda: NO_INVALID_ROWS)
    step_m: float = 0.0


@dataclass(frozen=True)
class _Table:
    """Table in a text file: column names, and the text of the lines below the header (``body``)."""

    file_name: str
    separator: str
    names: list[str]
    body: str
    header_line: int

    def label(self, *columns: int | None) -> str:
        """Join the names of columns for messages, without repeated columns and None."""
        labels = dict.fromkeys(
            quote(self.names[index]) if self.names[index] else f"column {index + 1}"
            for index in columns
            if index is not None
        )
        return ", ".join([*labels][:12]) + (", ..." if len(labels) > 12 else "")

    def texts(self, columns: Iterable[int]) -> pd.DataFrame:
        """Return the cells of the columns as text, without rows in which all cells are empty."""
        column_indices = sorted({*columns})
        try:
            texts = pd.read_csv(
                io.StringIO(self.body),
                sep=r"\s+" if self.separator == " " else self.separator,
                header=None,
                index_col=False,
                names=range(column_indices[-1] + 1),
                usecols=column_indices,
                dtype=str,
                skipinitialspace=True,
                quoting=csv.QUOTE_NONE,
            )
        except ValueError as error:
            raise LogError(
                f"{self.file_name} contains no table of numbers",
                "Export the positions as CSV again.",
            ) from error
        return texts.dropna(how="all")


# Column indices of position or sigma along x, y, z; None if missing
_Columns = tuple[int | None, ...]


def read_position_csv(
    path: str | Path,
    *,
    columns: tuple[str, ...] | None = None,
    time_unit: str | None = None,
    length_unit: str | None = None,
) -> PositionRecording:
    """Read the position file of a positioning system.

    Parameters
    ----------
    path : str or Path
        Text table, see :mod:`px4fuse.readers.position_csv`.
    columns : tuple of str, optional
        Columns of time, x, y, z and optionally sigma, each a name or number (from 1). Without
        sigma, z may also be omitted.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of the time column; overrides detection.
    length_unit : {"m", "cm", "mm"}, optional
        Unit of positions and sigmas; overrides detection.

    Raises
    ------
    LogError
        The file cannot be read, is not a text table, has no columns of time and position, has more
        columns than header names, or has fewer than three usable rows.
    SettingsError
        An option has an invalid value or names a column that is not in the file.
    """
    _check_options(columns, time_unit, length_unit)
    path = Path(path)
    content = read_bytes_limited(
        path, LogError, MAX_FILE_BYTES, empty_remedy="Copy the position file again."
    )
    table, notes = _find_table(display_name(path), content, columns)
    meanings = [read_column_name(name) for name in table.names]
    chosen_columns = _column_indices(table, columns or ())
    texts = table.texts(
        [*chosen_columns, *(index for index, meaning in enumerate(meanings) if meaning.kind)]
    )
    numbers = texts.apply(pd.to_numeric, errors="coerce").astype(np.float64)
    time, position, sigma, frame, time_text = _choose_columns(
        table, meanings, chosen_columns, numbers
    )
    axes = [index for index in position if index is not None]
    # pandas reads numbers such as 1e999 as infinite
    has_time = np.isfinite(numbers[time])
    is_usable = has_time & (numbers[axes].abs() < MAX_COORDINATE).all(axis=1)
    if unusable_count := int(np.count_nonzero(~is_usable)):
        notes.insert(0, f"number of dropped rows without valid time or position: {unusable_count}")
    empty_times = numbers.loc[has_time & ~is_usable, time].to_numpy()
    for tag in (index for index, meaning in enumerate(meanings) if meaning.kind == "tag"):
        tags = sorted({*texts[tag].dropna()})
        if tags[1:]:
            notes.append(
                f"the position file contains {len(tags)} tags (such as {quote(tags[0])}): remove "
                "all tags but one"
            )
    numbers = numbers[is_usable]
    times = numbers[time].to_numpy()
    name_unit = meanings[time].unit
    unit, unit_text = _time_unit(times, name_unit if name_unit in TIME_UNITS else "", time_unit)
    units_per_second = round(1.0 / TIME_UNITS[unit])
    seconds = times / units_per_second
    usable_rows = np.flatnonzero(np.abs(seconds) < UNIX_END_S)
    # Ranks are used instead of times, because longest_increasing_run requires positive values
    ranks = np.unique(seconds[usable_rows], return_inverse=True)[1].astype(np.int64)
    kept_rows = usable_rows[longest_increasing_run(ranks + 1)]
    if dropped := len(seconds) - len(kept_rows):
        notes.append(
            "number of dropped rows with timestamps that repeat, decrease or are after 2100: "
            f"{dropped}"
        )
    if len(kept_rows) < MIN_ROWS:
        raise LogError(
            "; ".join(
                [
                    f"{table.file_name} contains {len(kept_rows)} usable rows, fewer than "
                    f"{MIN_ROWS}",
                    *notes,
                ]
            ),
            f"Write numbers with decimal points, or name the columns with {_COLUMNS_OPTION}.",
        )
    numbers = numbers.iloc[kept_rows].set_index(time_index(seconds[kept_rows]))
    median_interval_s = median_interval(numbers.index)
    if not MIN_INTERVAL_S <= median_interval_s <= MAX_INTERVAL_S:
        notes.append(
            f"a median interval of {median_interval_s:.3g} s is not plausible for UWB: check "
            "the unit of time (--position-time-unit)"
        )
    scale_by_column, length_unit_text = _length_units(numbers, axes, meanings, length_unit)
    columns_m = {
        name: np.nan if index is None else numbers[index] * scale_by_column[index]
        for name, index in zip(SAMPLE_COLUMNS, (*position, *sigma), strict=True)
    }
    samples = pd.DataFrame(columns_m, index=numbers.index).replace([np.inf, -np.inf], np.nan)
    reason = find_invalid(samples, SAMPLE_COLUMNS[: len(axes)])
    invalid = reason[reason != ""], pd.Series("NaN", empty_times / units_per_second)
    samples = samples[reason == ""]
    is_not_positive = samples[SIGMA_COLUMNS] <= 0.0
    if bad_row_count := int(is_not_positive.any(axis=1).sum()):
        notes.append(f"number of ignored sigmas that are zero or negative: {bad_row_count}")
        samples[SIGMA_COLUMNS] = samples[SIGMA_COLUMNS].mask(is_not_positive)
    is_unix = UNIX_START_S <= float(np.median(numbers.index)) < UNIX_END_S
    clock: Literal["UNIX", "local"] = "UNIX" if is_unix else "local"
    axis_names = frame.upper() if frame else "x, y, z"
    height_text = "" if len(axes) == 3 else " without height"
    return PositionRecording(
        name=table.file_name,
        sha256=hashlib.sha256(content).hexdigest(),
        size_bytes=len(content),
        samples=samples,
        clock=clock,
        frame=frame,
        dropped=dropped,
        detected=(
            f"the separator is {_SEPARATORS[table.separator]}, the header is line "
            f"{table.header_line}",
            f"time: column {time_text}, {clock} clock, unit {unit_text}",
            f"position: columns {table.label(*position)} as {axis_names}{height_text}, "
            f"unit {length_unit_text}",
            f"sigma: columns {table.label(*sigma) or 'none'}",
        ),
        notes=tuple(notes),
        metres_per_unit=scale_by_column[axes[0]],
        invalid=pd.concat(invalid).sort_index(),
        step_m=max(rounding_step(samples[name].to_numpy()) for name in ("x_m", "y_m")),
    )


def _check_options(
    columns: tuple[str, ...] | None, time_unit: str | None, length_unit: str | None
) -> None:
    """Raise SettingsError for option values that are invalid for every file."""
    for name, value, units in (
        ("time_unit", time_unit, TIME_UNITS),
        ("length_unit", length_unit, LENGTH_UNITS),
    ):
        if value is not None and value not in units:
            raise SettingsError(f"`{name}`: {value!r} is not one of {', '.join(units)}.")
    names = columns or ("1", "2", "3")
    if "" in names or not 3 <= len({*names}) == len(names) <= 5:
        raise SettingsError(
            f"{_COLUMNS_OPTION}[,SIGMA]: {','.join(names)!r} must name four or five different "
            "columns (three without height)."
        )


def _split_line(line: str, separator: str) -> list[str]:
    if separator == " ":  # a name with unit, such as "x [mm]", is one field
        return re.sub(r" +(?=[\[(])", "", line.strip()).split()
    return [field.strip() for field in line.split(separator)]


def _find_table(
    file_name: str, content: bytes, columns: tuple[str, ...] | None
) -> tuple[_Table, list[str]]:
    """Find the table in a text file.

    Also return a list with a note if an incomplete last line was dropped.
    """
    text = decode_text(content)
    if text is None:
        raise LogError(f"{file_name} is a binary file, not a text table", "Give a CSV file.")
    notes = []
    whole_lines, _, last_line = text.replace('"', "").rpartition("\n")
    text = f"{whole_lines}\n"
    if last_line.strip():
        notes.append("the last line of the position file was dropped, because it has no line end")
    lines = text[: text.rfind("\n", 0, MAX_HEADER_CHARS) + 1].split("\n")[:MAX_HEADER_LINES]
    wanted_names = {column.strip().casefold() for column in columns or () if not column.isdecimal()}
    headers = (
        (index + 1, separator, names)
        for index, header_line in enumerate(lines)
        for separator in _SEPARATORS
        for names in [_split_line(header_line.strip("#% "), separator)]
        if len(names) <= MAX_COLUMNS and _is_header(names, wanted_names)
    )
    header_line, separator, names = next(headers, (0, "", []))
    if not names:
        title_list = ", ".join(map(quote, sorted(wanted_names))) or "time, x, y, z"
        raise LogError(
            f"{file_name}: the first {len(lines)} lines contain no header with the columns "
            f"{title_list}. The first line is {quote(lines[0])}.",
            f"Name the columns with {_COLUMNS_OPTION}.",
        )
    body = re.sub(r"(?m)^[ \t]*[#%].*", "", text.split("\n", header_line)[header_line])
    first_row = body[:MAX_HEADER_CHARS].lstrip("\n").partition("\n")[0].rstrip(f"{separator} ")
    row_width = len(_split_line(first_row, separator))
    if row_width > len(names):
        raise LogError(
            f"{file_name}: the header has {len(names)} columns, but the rows have {row_width}.",
            "Write numbers with decimal points, and give each column a name.",
        )
    return _Table(file_name, separator, names, body, header_line), notes


def _is_header(fields: list[str], wanted_names: set[str]) -> bool:
    """Return True if the fields of a line are a header: they contain all wanted names.

    Without wanted names, a header contains names of time and position.
    """
    if wanted_names:
        return wanted_names <= {name.casefold() for name in fields}
    meanings = [read_column_name(name) for name in fields]
    has_time = any(column.kind == "time" for column in meanings)
    return has_time and position_names.find_position(meanings) is not None


def _column_indices(table: _Table, columns: tuple[str, ...]) -> list[int]:
    names = [name.casefold() for name in table.names]
    numbers = [str(index + 1) for index in range(len(names))]
    indices = []
    for column in columns:
        wanted_name = column.strip().casefold()
        if wanted_name not in names + numbers:
            raise SettingsError(
                f"{table.file_name} has no column {quote(column)}; the columns are "
                f"{table.label(*range(len(names)))}",
                f"Name the columns with {_COLUMNS_OPTION}.",
            )
        indices.append((names if wanted_name in names else numbers).index(wanted_name))
    if len({*indices}) < len(indices):
        raise SettingsError(
            f"{_COLUMNS_OPTION}: {quote(','.join(columns))} names one column twice."
        )
    return indices


def _choose_columns(
    table: _Table,
    meanings: Sequence[ColumnMeaning],
    chosen_columns: list[int],
    numbers: pd.DataFrame,
) -> tuple[int, _Columns, _Columns, str | None, str]:
    """Choose the columns of time, position and sigma.

    Also return the frame, and the description of the time column. Columns that the user chose are
    used. Otherwise the column names determine the columns. A column with the time of measurement is
    preferred to a column with the time of recording if it is not empty.
    """
    if chosen_columns:
        time = chosen_columns[0]
        time_text = table.label(time)
        frame = None
        position: _Columns = (*chosen_columns[1:4], None)[:3]
        # The column names may contain the frame, which determines the order of the axes
        chosen_meanings = [
            meaning if index in position else ColumnMeaning()
            for index, meaning in enumerate(meanings)
        ]
        named = position_names.find_position(chosen_meanings)
        if named and {*named[1]} == {*position}:
            frame, position = named
    else:
        time_columns = [index for index, column in enumerate(meanings) if column.kind == "time"]
        is_mostly_empty = numbers[time_columns].fillna(0.0).eq(0.0).mean() >= 0.5
        rank = position_names.TIME_KINDS.index
        time, *other_times = sorted(
            time_columns, key=lambda index: (is_mostly_empty[index], rank(meanings[index].key))
        )
        time_text = table.label(time)
        if other_times:
            time_text += f" ({meanings[time].key}; not used: {table.label(*other_times)})"
        frame, position = position_names.find_position(meanings) or (None, ())
    if position[2] is not None and numbers[position[2]].isna().all():
        position = (*position[:2], None)
    sigma = (
        (chosen_columns[4],) * 3
        if len(chosen_columns) > 4
        else position_names.find_sigma(meanings, frame)
    )
    return time, position, sigma, frame, time_text


def _time_unit(times: Array, name_unit: str, option: str | None) -> tuple[str, str]:
    """Return the unit of the time column, and a text with the reason for this unit."""
    if option is not None:
        return option, f"{option} (given with --position-time-unit)"
    median = float(np.median(times)) if len(times) else 0.0
    if name_unit and abs(median) * TIME_UNITS[name_unit] < UNIX_END_S:
        return name_unit, f"{name_unit} (from the column name)"
    steps = np.diff(times)
    median_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    plausible_units = []
    for unit, scale in TIME_UNITS.items():
        is_unix = UNIX_START_S <= median * scale < UNIX_END_S
        if is_unix and median_step * scale <= MAX_UNIX_TIME_INTERVAL_S:
            return unit, f"{unit} (because the times are then UNIX times)"
        if MIN_INTERVAL_S <= median_step * scale <= MAX_INTERVAL_S:
            plausible_units.append(unit)
    if not plausible_units:
        return "s", (
            "s (assumed, because no unit gives a plausible UWB rate; set another unit with "
            "--position-time-unit)"
        )
    unit = plausible_units[0]
    description = (
        f"{unit} (because the median interval is then {median_step * TIME_UNITS[unit]:.3g} s)"
    )
    if plausible_units[1:]:
        description = (
            f"{description}; if the unit is {plausible_units[1]}, give --position-time-unit"
        )
    return unit, description


def _length_units(
    numbers: pd.DataFrame, axes: list[int], meanings: Sequence[ColumnMeaning], option: str | None
) -> tuple[dict[int, float], str]:
    """Return metres per unit of each column, and a text with the unit of the positions."""
    name_units = {
        index: meaning.unit
        for index, meaning in enumerate(meanings)
        if meaning.unit in LENGTH_UNITS
    }
    # Extent from 5 % to 95 % of the coordinates, because outliers must not determine the unit
    extents = numbers[axes].quantile(0.95) - numbers[axes].quantile(0.05)
    max_extent = float(extents.max())
    unit = "m"
    reason = "assumed, because the column names contain no unit"
    if option is not None:
        unit = option
        name_units = {}
        reason = "the unit was given with --position-unit"
    elif axis_units := [name_units[index] for index in axes if index in name_units]:
        unit = axis_units[0]
        reason = "from the column names"
    elif MAX_INDOOR_EXTENT_M < max_extent <= MAX_INDOOR_EXTENT_M / LENGTH_UNITS["mm"]:
        unit = "mm"
        reason = (
            f"an extent of {max_extent:.0f} m is too large for an indoor flight; if the unit is "
            "cm, give --position-unit"
        )
    elif max_extent > MAX_INDOOR_EXTENT_M:
        reason = (
            "assumed, because no unit gives the extent of an indoor flight; set another unit with "
            "--position-unit"
        )
    unit_by_column = {index: name_units.get(index, unit) for index in map(int, numbers.columns)}
    scale_by_column = {index: LENGTH_UNITS[name] for index, name in unit_by_column.items()}
    span_m = max(float(extents[index]) * scale_by_column[index] for index in axes)
    used_units = ", ".join(dict.fromkeys(unit_by_column[index] for index in axes))
    return (
        scale_by_column,
        f"{used_units} ({reason}); 90 % of the positions are within {span_m:.3g} m",
    )
