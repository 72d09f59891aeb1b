"""Reader of CSV files from positioning systems (UWB); keeps the clock and frame of the file.

The documented format is a header and ``time, x, y, z`` in seconds and metres, optionally with
``sigma`` or ``sigma_x, sigma_y, sigma_z``. Other separators, column names and units are detected.
The detected format is reported, and options override columns and units.
"""

import csv
import hashlib
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.errors import LogError, SettingsError
from px4fuse.readers import position_names
from px4fuse.readers.position_names import LENGTH_UNITS, TIME_UNITS, ColumnMeaning, read_column_name
from px4fuse.readers.text_table import UNIX_END_S, UNIX_START_S, decode_text, quote
from px4fuse.readers.ulog_topics import longest_increasing_run
from px4fuse.reading import display_name, read_bytes_limited

SIGMA_COLUMNS = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]
SAMPLE_COLUMNS = ["x_m", "y_m", "z_m", *SIGMA_COLUMNS]

MAX_FILE_BYTES = 500_000_000  # several days of UWB positions
MIN_ROWS = 3
# s; UWB systems have rates of 0.2 Hz to 200 Hz, with 10 % variation of the interval
MIN_INTERVAL_S, MAX_INTERVAL_S = 0.9 / 200, 1.1 / 0.2
# s; tells UNIX time in s from a boot clock in µs, which has the same magnitude after half an hour
MAX_UNIX_INTERVAL_S = 60.0
# m; largest extent of an indoor flight
MAX_SPREAD_M = 200.0
MAX_COORDINATE = 1e9  # any length unit; larger values are timestamps or damage
# The header is searched in this part of the file
HEAD_LINES, HEAD_CHARS = 1000, 200_000
MAX_COLUMNS = 200
_COLUMNS = "`columns` TIME,X,Y,Z"
_SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}


@dataclass(frozen=True)
class PositionRecording:
    """Position file of a positioning system, in the clock and frame of the file.

    Attributes
    ----------
    name : str
        File name without folder.
    sha256 : str
        Hash of the file content.
    size_bytes : int
    samples : DataFrame, shape (n, 6)
        ``x_m, y_m, z_m, sigma_x_m, sigma_y_m, sigma_z_m`` (m); NaN if not in the file. The index
        ``time_s`` (s, clock of the file) is strictly increasing. In frame "ned" x is north, y
        east, z down; in "enu" x is east, y north, z up, independent of the order of columns.
    clock : "UNIX" or "local"
        "UNIX" if the timestamps are between 2000 and 2100.
    frame : str or None
        "ned" or "enu" if the column names contain it.
    detected : tuple of str
        One sentence per detected property of the format.
    notes : tuple of str
        Dropped rows with the reason, and warnings.
    dropped : int
        Rows with an invalid timestamp.
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


@dataclass(frozen=True)
class _Table:
    """Table in a text file: column names and rows."""

    file: str
    separator: str
    names: list[str]  # of the columns
    body: str  # complete lines after the header
    header_line: int

    def label(self, *columns: int | None) -> str:
        """Format the names of some columns for messages, without repetition."""
        used_labels = dict.fromkeys(
            quote(self.names[at]) if self.names[at] else f"column {at + 1}"
            for at in columns
            if at is not None
        )
        return ", ".join([*used_labels][:12]) + (", ..." if len(used_labels) > 12 else "")

    def texts(self, columns: Iterable[int]) -> pd.DataFrame:
        """Return the cells of some columns as text, without empty rows."""
        used = sorted({*columns})
        try:
            texts = pd.read_csv(
                io.StringIO(self.body),
                sep=r"\s+" if self.separator == " " else self.separator,
                header=None,
                index_col=False,
                names=range(used[-1] + 1),
                usecols=used,
                dtype=str,
                skipinitialspace=True,
                quoting=csv.QUOTE_NONE,
            )
        except ValueError as error:
            raise LogError(
                f"{self.file} contains no table of numbers.", "Export it as CSV again."
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
        Text table in the format of the module description.
    columns : tuple of str, optional
        TIME, X, Y, Z and optionally SIGMA, each a column name or number (from 1). Without SIGMA, Z
        may be omitted too.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of the time column; overrides detection.
    length_unit : {"m", "cm", "mm"}, optional
        Unit of positions and sigmas; overrides detection.

    Raises
    ------
    LogError
        The file cannot be read, is not a text table, has no columns of time and position, more
        columns than header names, or fewer than three usable rows.
    SettingsError
        An option has an invalid value or names a column that is not in the file.
    """
    _check_options(columns, time_unit, length_unit)
    path = Path(path)
    content = read_bytes_limited(path, LogError, MAX_FILE_BYTES, empty_remedy="Copy it again")
    table, notes = _find_table(display_name(path), content, columns)
    meanings = [read_column_name(name) for name in table.names]
    chosen_columns = _column_indices(table, columns or ())
    texts = table.texts([*chosen_columns, *(at for at, m in enumerate(meanings) if m.kind)])
    numbers = texts.apply(pd.to_numeric, errors="coerce").astype(np.float64)
    time, position, sigma, frame, time_words = _choose_columns(
        table, meanings, chosen_columns, numbers
    )
    axes = [at for at in position if at is not None]
    # Texts such as 1e999 become infinite
    is_usable = np.isfinite(numbers[time])
    is_usable &= (numbers[axes].abs() < MAX_COORDINATE).all(axis=1)
    if unusable_count := int(np.count_nonzero(~is_usable)):
        notes.insert(0, f"{_count_words(unusable_count)} dropped: no valid time or position")
    for tag in (at for at, m in enumerate(meanings) if m.kind == "tag"):
        tags = sorted({*texts[tag].dropna()})
        if tags[1:]:
            some_tags = ", ".join(map(quote, tags[:2]))
            notes.append(
                f"the file contains positions of {len(tags)} tags (such as {some_tags}): keep the "
                "rows of one tag only"
            )
    numbers = numbers[is_usable]
    ticks = numbers[time].to_numpy()
    name_unit = meanings[time].unit
    unit, unit_words = _time_unit(ticks, name_unit if name_unit in TIME_UNITS else "", time_unit)
    seconds = ticks / round(1.0 / TIME_UNITS[unit])
    usable = np.flatnonzero(np.abs(seconds) < UNIX_END_S)
    # Ranks instead of times, because times may be negative
    ranks = np.unique(seconds[usable], return_inverse=True)[1].astype(np.int64)
    keep = usable[longest_increasing_run(ranks + 1)]
    if dropped := len(seconds) - len(keep):
        notes.append(
            f"{_count_words(dropped)} dropped: timestamps repeat, go back or are out of range"
        )
    if len(keep) < MIN_ROWS:
        raise LogError(
            f"{table.file} contains {len(keep)} usable rows; at least {MIN_ROWS} are needed"
            f"{''.join('; ' + note for note in notes)}",
            f"Export it with decimal points, or name the columns with {_COLUMNS}.",
        )
    numbers = numbers.iloc[keep].set_index(pd.Index(seconds[keep], name="time_s"))
    step = float(np.median(np.diff(numbers.index)))
    if not MIN_INTERVAL_S <= step <= MAX_INTERVAL_S:
        rate = f"one sample per {step:.3g} s (median)"
        notes.append(f"{rate} is not a plausible UWB rate: check --position-time-unit")
    scales, length_words = _length_units(numbers, axes, meanings, length_unit)
    column_of_name = zip(SAMPLE_COLUMNS, (*position, *sigma), strict=True)
    lengths = {
        name: np.nan if at is None else numbers[at] * scales[at] for name, at in column_of_name
    }
    samples = pd.DataFrame(lengths, index=numbers.index)
    samples = samples.where(np.isfinite(samples))
    is_not_positive = samples[SIGMA_COLUMNS] <= 0.0
    if rows := int(is_not_positive.any(axis=1).sum()):
        notes.append(f"sigma is zero or negative in {rows} rows and was ignored there")
        samples[SIGMA_COLUMNS] = samples[SIGMA_COLUMNS].mask(is_not_positive)
    is_unix = UNIX_START_S <= float(np.median(numbers.index)) < UNIX_END_S
    clock: Literal["UNIX", "local"] = "UNIX" if is_unix else "local"
    names = frame.upper() if frame else "x, y, z"
    height = "" if len(axes) == 3 else " without height"
    return PositionRecording(
        name=table.file,
        sha256=hashlib.sha256(content).hexdigest(),
        size_bytes=len(content),
        samples=samples,
        clock=clock,
        frame=frame,
        dropped=dropped,
        detected=(
            f"table: {_SEPARATORS[table.separator]} between columns, header in line "
            f"{table.header_line}",
            f"time: {time_words}, {clock} clock, in {unit_words}",
            f"position: {table.label(*position)} as {names}{height}, in {length_words}",
            f"sigma: {table.label(*sigma) or 'none'}",
        ),
        notes=tuple(notes),
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
    titles = columns or ("1", "2", "3")
    if "" in titles or not 3 <= len({*titles}) == len(titles) <= 5:
        raise SettingsError(
            f"{_COLUMNS}[,SIGMA]: {','.join(titles)!r} must name four or five different "
            "columns (three without height)."
        )


def _count_words(rows: int) -> str:
    return "1 row was" if rows == 1 else f"{rows} rows were"


def _split_line(line: str, separator: str) -> list[str]:
    """Split one line into its fields."""
    if separator == " ":  # a name with unit, such as "x [mm]", is one field
        return re.sub(r" +(?=[\[(])", "", line.strip()).split()
    return [field.strip() for field in line.split(separator)]


def _find_table(
    file: str, content: bytes, columns: tuple[str, ...] | None
) -> tuple[_Table, list[str]]:
    """Find separator, header and first row; return also a note if the last line was dropped."""
    text = decode_text(content)
    if text is None:
        raise LogError(
            f"{file} is a binary file, not a text table",
            "Give the CSV file of the positioning system. A flight log is given as LOG, without "
            "--position.",
        )
    notes = []
    whole_lines, _, last = text.replace('"', "").rpartition("\n")
    text = f"{whole_lines}\n"
    if last.strip():
        notes.append("the last line was dropped: it has no line end and may be incomplete")
    lines = text[: text.rfind("\n", 0, HEAD_CHARS) + 1].split("\n")[:HEAD_LINES]
    wanted_names = {column.strip().casefold() for column in columns or () if not column.isdecimal()}
    headers = (
        (at + 1, separator, names)
        for at, line in enumerate(lines)
        for separator in _SEPARATORS
        for names in [_split_line(line.strip("#% "), separator)]
        if len(names) <= MAX_COLUMNS and _is_header(names, wanted_names)
    )
    line, separator, names = next(headers, (0, "", []))
    if not names:
        titles = ", ".join(map(quote, sorted(wanted_names))) or "time, x, y, z"
        raise LogError(
            f"{file}: the first {len(lines)} lines contain no header with the columns "
            f"{titles}. The first line is {quote(lines[0])}.",
            f"Give a CSV file with a header, or name its columns with {_COLUMNS}.",
        )
    body = re.sub(r"(?m)^[ \t]*[#%].*", "", text.split("\n", line)[line])
    head = body[:HEAD_CHARS].lstrip("\n").partition("\n")[0].rstrip(f"{separator} ")
    width = len(_split_line(head, separator))
    if width > len(names):
        raise LogError(
            f"{file}: the header has {len(names)} columns, but the rows have {width}.",
            "Export it with decimal points and a name for each column.",
        )
    return _Table(file, separator, names, body, line), notes


def _is_header(fields: list[str], wanted: set[str]) -> bool:
    """Return True if the fields contain the wanted names, or else names of time and position."""
    if wanted:
        return wanted <= {name.casefold() for name in fields}
    meanings = [read_column_name(name) for name in fields]
    has_time = any(column.kind == "time" for column in meanings)
    return has_time and position_names.find_position(meanings) is not None


def _column_indices(table: _Table, columns: tuple[str, ...]) -> list[int]:
    """Return the indices of the columns that the option names."""
    names = [name.casefold() for name in table.names]
    numbers = [str(at + 1) for at in range(len(names))]
    found = []
    for column in columns:
        wanted = column.strip().casefold()
        if wanted not in names + numbers:
            raise SettingsError(
                f"{table.file} has no column {quote(column)} (its columns are "
                f"{table.label(*range(len(names)))})",
                f"Name the columns with {_COLUMNS}.",
            )
        found.append((names if wanted in names else numbers).index(wanted))
    if len({*found}) < len(found):
        raise SettingsError(f"{_COLUMNS}: {quote(','.join(columns))} names one column twice.")
    return found


def _choose_columns(
    table: _Table,
    meanings: Sequence[ColumnMeaning],
    chosen_columns: list[int],
    numbers: pd.DataFrame,
) -> tuple[int, _Columns, _Columns, str | None, str]:
    """Choose the columns of time, position and sigma; return also frame and time description.

    The option names them; otherwise their names select them. A filled column with the time of
    measurement is preferred to the time of recording.
    """
    if chosen_columns:
        time, words = chosen_columns[0], table.label(chosen_columns[0])
        # The column names may contain the frame and so the order of the axes
        chosen_meanings = [
            m if at in chosen_columns[1:4] else ColumnMeaning() for at, m in enumerate(meanings)
        ]
        found = position_names.find_position(chosen_meanings)
        position: _Columns = (*chosen_columns[1:4], None)[:3]
        frame, position = found if found and {*found[1]} == {*position} else (None, position)
    else:
        times = [at for at, column in enumerate(meanings) if column.kind == "time"]
        empty = numbers[times].fillna(0.0).eq(0.0).mean() >= 0.5
        rank = position_names.TIME_KINDS.index
        time, *other_times = sorted(times, key=lambda at: (bool(empty[at]), rank(meanings[at].key)))
        words = table.label(time)
        if other_times:
            words += f", the {meanings[time].key} (not used: {table.label(*other_times)})"
        frame, position = position_names.find_position(meanings) or (None, ())
    if position[2] is not None and numbers[position[2]].isna().all():
        position = (*position[:2], None)
    sigma = (
        (chosen_columns[4],) * 3
        if len(chosen_columns) > 4
        else position_names.find_sigma(meanings, frame)
    )
    return time, position, sigma, frame, words


def _time_unit(ticks: Array, name_unit: str, option: str | None) -> tuple[str, str]:
    """Return the unit of the time column and its description."""
    if option is not None:
        return option, f"{option} from --position-time-unit"
    middle = float(np.median(ticks)) if len(ticks) else 0.0
    if name_unit and abs(middle) * TIME_UNITS[name_unit] < UNIX_END_S:
        return name_unit, f"{name_unit} from its name"
    steps = np.diff(ticks)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    fits = []
    for unit, scale in TIME_UNITS.items():
        is_unix = UNIX_START_S <= middle * scale < UNIX_END_S
        if is_unix and step * scale <= MAX_UNIX_INTERVAL_S:
            return unit, f"{unit} from its magnitude"
        if MIN_INTERVAL_S <= step * scale <= MAX_INTERVAL_S:
            fits.append(unit)
    if not fits:
        return "s", (
            "s assumed: no unit gives a plausible UWB rate (--position-time-unit overrides)"
        )
    words = f"{fits[0]} from its interval of {step * TIME_UNITS[fits[0]]:.3g} s"
    if fits[1:]:
        words += f" ({fits[1]} is also possible: then give --position-time-unit)"
    return fits[0], words


def _length_units(
    numbers: pd.DataFrame, axes: list[int], meanings: Sequence[ColumnMeaning], option: str | None
) -> tuple[dict[int, float], str]:
    """Return metres per unit of each column, and the description of the position's unit."""
    name_units = {at: m.unit for at, m in enumerate(meanings) if m.unit in LENGTH_UNITS}
    # Percentiles, because outliers must not determine the unit
    spreads = numbers[axes].quantile(0.95) - numbers[axes].quantile(0.05)
    spread = float(spreads.max())
    unit, reason = "m", "no unit in the column names"
    if option is not None:
        unit, name_units, reason = option, {}, "from --position-unit"
    elif used_labels := [name_units[at] for at in axes if at in name_units]:
        unit, reason = used_labels[0], "from the column names"
    elif MAX_SPREAD_M < spread <= MAX_SPREAD_M / LENGTH_UNITS["mm"]:
        unit = "mm"
        reason = f"{spread:.0f} m is too large for an indoor flight; if cm, give --position-unit"
    elif spread > MAX_SPREAD_M:
        reason = "assumed: no unit gives the size of an indoor flight; else give --position-unit"
    units = {at: name_units.get(at, unit) for at in map(int, numbers.columns)}
    scales = {at: LENGTH_UNITS[name] for at, name in units.items()}
    span = max(float(spreads[at]) * scales[at] for at in axes)
    used = ", ".join(dict.fromkeys(units[at] for at in axes))
    return scales, f"{used} ({reason}); 90 % of the positions within {span:.3g} m"
