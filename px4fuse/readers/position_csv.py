"""An external UWB positioning log (CSV) to samples on its own clock and in its own frame.

The documented format is a header and ``time, x, y, z`` in seconds and metres, with ``sigma`` or
``sigma_x, sigma_y, sigma_z`` or ``quality`` where the system gives them. Vendors write many others,
so separator, header, columns and units are detected. Every decision is stated, and every decision
that a person might have to correct has an option.
"""

from __future__ import annotations

import csv
import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from px4fuse.errors import LogError, SettingsError
from px4fuse.readers.position_columns import ColumnChoice, choose
from px4fuse.readers.position_names import (
    LENGTH_UNITS,
    TIME_UNITS,
)
from px4fuse.readers.position_table import (
    COLUMNS,
    MISSING,
    Table,
    find_table,
    plain_text,
    split,
)
from px4fuse.readers.text_table import UNIX_END_S, UNIX_START_S, at_line, quote, seconds_of
from px4fuse.readers.ulog_topics import increasing
from px4fuse.reading import read_whole, shown

SAMPLE_COLUMNS = ["x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "quality"]
SIGMA_COLUMNS = SAMPLE_COLUMNS[3:6]

MAX_FILE_BYTES = 500_000_000  # days of any UWB system
MIN_ROWS = 3
# UWB systems run between 0.2 Hz and 200 Hz; their intervals vary by a tenth
MIN_INTERVAL_S, MAX_INTERVAL_S = 0.9 / 200, 1.1 / 0.2
# A boot clock in µs after half an hour has the magnitude of UNIX time in s; its intervals have not
MAX_UNIX_INTERVAL_S = 60.0
# What an indoor flight spans
MIN_SPREAD_M, MAX_SPREAD_M = 0.2, 200.0
MAX_COORDINATE = 1e9  # in any unit; beyond it stands a time stamp, or damage
MAX_TICKS = 2**61  # of a time stamp in its own unit; differences must fit into int64

_CSV = {
    "header": None,
    "index_col": False,
    "dtype_backend": "numpy_nullable",  # integers stay exact where some are missing
    "na_values": MISSING,
    "keep_default_na": False,
    "skip_blank_lines": False,  # so that rows are lines
    "skipinitialspace": True,
    "quoting": csv.QUOTE_NONE,
    "low_memory": False,
}


@dataclass(frozen=True)
class PositionRecording:
    """An external position log as its own system wrote it: its own clock, its own frame.

    Attributes
    ----------
    name : str
        File name without its folder.
    sha256 : str
        Of the file's bytes.
    size_bytes : int
    samples : DataFrame, shape (n, 7)
        ``x_m, y_m, z_m, sigma_x_m, sigma_y_m, sigma_z_m`` (m) and ``quality`` (no unit, as given),
        NaN where the file has none. The index ``time_s`` is in seconds on the file's own clock and
        strictly increasing. In frame "ned" x is north, y east, z down; in "enu" x is east, y
        north, z up; whatever the order of the columns was.
    clock : "UNIX" or "local"
        "UNIX" where the stamps are between 2000 and 2100.
    frame : str or None
        "ned" or "enu" where the columns' names say so.
    detected : tuple of str
        One sentence per decision.
    notes : tuple of str
        What was dropped and why, and what looks doubtful.
    """

    name: str
    sha256: str
    size_bytes: int
    samples: pd.DataFrame
    clock: Literal["UNIX", "local"]
    frame: str | None
    detected: tuple[str, ...]
    notes: tuple[str, ...]


def read_position_csv(
    path: str | Path,
    *,
    columns: tuple[str, ...] | None = None,
    time_unit: str | None = None,
    length_unit: str | None = None,
) -> PositionRecording:
    """Read an external position log.

    Parameters
    ----------
    path : str or Path
        A text table; see the module's description.
    columns : tuple of str, optional
        TIME, X, Y, Z and optionally SIGMA, each a column's name or its number from 1. Z may be
        left out together with SIGMA.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of the time column, whatever its name and its values say; ISO 8601 text has none.
    length_unit : {"m", "cm", "mm"}, optional
        Unit of positions and sigmas, whatever their names say.

    Raises
    ------
    LogError
        The file cannot be read, is no text table, has no columns for time and position or more
        columns than its header names, text where a number belongs, or fewer than three usable rows.
    SettingsError
        An option's value is not among those above, or names a column that the file has not.
    """
    _check_options(columns, time_unit, length_unit)
    path = Path(path)
    name = shown(path)
    content = read_whole(path, LogError, MAX_FILE_BYTES, again="Copy it again")
    table = find_table(name, plain_text(name, content), columns)
    choice = choose(table, columns)
    ticks, numbers, notes = _read_rows(table, choice)
    unit, unit_words = _time_unit(ticks, choice, time_unit)
    seconds = seconds_of(ticks, round(1.0 / TIME_UNITS[unit]))
    usable = np.flatnonzero(np.abs(seconds) < UNIX_END_S)
    # by rank: stamps that are apart as integers can be one float
    ranks = np.unique(seconds[usable], return_inverse=True)[1].astype(np.int64)
    keep = usable[increasing(ranks + 1)]
    if dropped := len(seconds) - len(keep):
        notes.append(f"{_count(dropped)} dropped: their time stamps repeat, go back or are absurd")
    if len(keep) < MIN_ROWS:
        raise LogError(
            f"{name}: usable rows: {len(keep)}, at least {MIN_ROWS} are needed"
            f"{''.join('; ' + note for note in notes)}. Copy the file again, or say where time and "
            f"position are with {COLUMNS}."
        )
    numbers = numbers.iloc[keep].set_index(pd.Index(seconds[keep], name="time_s"))
    step = float(np.median(np.diff(numbers.index)))
    if not MIN_INTERVAL_S <= step <= MAX_INTERVAL_S:
        notes.append(
            f"one sample in {step:.3g} s (median) is not a rate of a UWB: check "
            "--position-time-unit"
        )
    units, length_words = _length_units(numbers, choice, length_unit)
    samples = pd.DataFrame(np.nan, index=numbers.index, columns=SAMPLE_COLUMNS)
    sources = (*choice.position, *choice.sigma, choice.quality)
    for column, index in zip(SAMPLE_COLUMNS, sources, strict=True):
        if index is not None:
            scale = 1.0 if column == "quality" else LENGTH_UNITS[units[index]]
            samples[column] = numbers[index] * scale
    wrong = samples[SIGMA_COLUMNS] <= 0.0
    if rows := int(wrong.any(axis=1).sum()):
        notes.append(f"sigma is not above zero in {rows} rows and was left out there")
        samples[SIGMA_COLUMNS] = samples[SIGMA_COLUMNS].mask(wrong)
    is_unix = UNIX_START_S <= float(np.median(numbers.index)) < UNIX_END_S
    clock: Literal["UNIX", "local"] = "UNIX" if is_unix else "local"
    time, position, *others = choice.detected
    time, position = f"{time}, {clock} clock, in {unit_words}", f"{position}, in {length_words}"
    return PositionRecording(
        name=name,
        sha256=hashlib.sha256(content).hexdigest(),
        size_bytes=len(content),
        samples=samples.where(np.isfinite(samples)),  # 1e999 reads as infinity
        clock=clock,
        frame=choice.frame,
        detected=(table.detected, time, position, *others),
        notes=(*choice.notes, *notes),
    )


def _check_options(
    columns: tuple[str, ...] | None, time_unit: str | None, length_unit: str | None
) -> None:
    """Refuse option values that are wrong for any file."""
    for name, value, units in (
        ("time_unit", time_unit, TIME_UNITS),
        ("length_unit", length_unit, LENGTH_UNITS),
    ):
        if value is not None and value not in units:
            raise SettingsError(f"`{name}`: {value!r} is not one of {', '.join(units)}.")
    given = [column.strip().casefold() for column in columns or ("1", "2", "3")]
    if not 3 <= len(given) <= 5 or "" in given or len(set(given)) < len(given):
        raise SettingsError(
            f"{COLUMNS}[,SIGMA]: {','.join(given)!r} does not name four or five different "
            "columns (three where there is no height)."
        )


def _count(rows: int) -> str:
    return "1 row was" if rows == 1 else f"{rows} rows were"


def _convert(texts: Any, is_iso: bool, errors: Literal["raise", "coerce"]) -> Any:
    """Times, or numbers, of texts."""
    if is_iso:
        plain = texts.str.replace("/", "-")
        return pd.to_datetime(plain, format="ISO8601", utc=True, errors=errors)
    return pd.to_numeric(texts, errors=errors)


def _read_rows(table: Table, choice: ColumnChoice) -> tuple[Any, pd.DataFrame, list[str]]:
    """Times in their own unit (µs from ISO 8601 text), the other columns by index, and notes.

    Of rows with time and position.
    """
    body, notes = table.body, []
    last = body[body.rfind("\n") + 1 :]
    if last and _is_cut(split(last, table.separator), table.head):
        body = body[: -len(last)]
        number = table.first_line + body.count("\n")
        notes.append(f"line {number}, the last one, was dropped: it is cut")
    used = [choice.time, *choice.numbers]
    options: dict[str, Any] = _CSV | {
        "sep": r"\s+" if table.separator == " " else table.separator,
        "names": list(range(max(used) + 1)),
        "usecols": used,
    }
    kinds = {choice.time: "str"} if choice.iso else {}
    kinds |= dict.fromkeys(choice.numbers, "float64")
    try:
        rows = pd.read_csv(io.StringIO(body), dtype=kinds, **options)
        times = _convert(rows[choice.time], bool(choice.iso), "raise")
    except ValueError as error:
        texts = pd.read_csv(io.StringIO(body), dtype=str, **options)
        raise LogError(_name_text(table, choice, texts)) from error
    numbers = rows[choice.numbers]
    filled = times.notna() | numbers.notna().any(axis=1)  # others are blank lines
    is_usable = times.notna() & (numbers[choice.axes].abs() < MAX_COORDINATE).all(axis=1)
    if choice.iso:
        times = times.dt.as_unit("us").astype("int64")
    elif choice.nanoseconds is not None:
        times = times + numbers[choice.nanoseconds] * 1e-9
    is_usable &= times.between(-MAX_TICKS, MAX_TICKS).fillna(False)
    if missing := int(filled.sum() - is_usable.sum()):
        notes.insert(0, f"{_count(missing)} dropped: without a usable time or position")
    exact = "int64" if times.dtype.kind == "i" else "float64"
    return times[is_usable].to_numpy(dtype=exact), numbers[is_usable], notes


def _name_text(table: Table, choice: ColumnChoice, texts: pd.DataFrame) -> str:
    """Name the first text where a number or a time belongs."""
    bad = []
    for column in (choice.time, *choice.numbers):
        is_iso = bool(choice.iso) and column == choice.time
        is_text = texts[column].notna() & _convert(texts[column], is_iso, "coerce").isna()
        bad += [(int(row), column) for row in np.flatnonzero(is_text)[:1]]
    if not bad:
        return f"{table.file}: no table of numbers. Export it as CSV again."
    row, column = min(bad)
    kind = "time" if column == choice.time else "number"
    return at_line(
        table.file,
        table.first_line + row,
        f"{table.label(column)}: {quote(str(texts[column].iloc[row]))} is not a {kind}",
        f"Correct or remove that line, or say where time and position are with {COLUMNS}.",
    )


def _is_cut(fields: list[str], head: list[list[str]]) -> bool:
    """Whether a last line without line feed ends early.

    It does where it has fewer fields or fewer digits in its last one than every row before it.
    """
    texts = [row[-1] for row in head]
    if not head or len(fields) < min(map(len, head)):
        return True
    has_point = any("." in text for text in texts)

    def digits(text: str) -> int:
        return len(text.partition(".")[2] if has_point else text)

    return digits(fields[-1]) < min(map(digits, texts))


def _time_unit(ticks: Any, choice: ColumnChoice, option: str | None) -> tuple[str, str]:
    """Unit of the time column, and the words on it."""
    if choice.iso:
        return "us", choice.iso
    if option is not None:
        return option, f"{option} as --position-time-unit says"
    middle = float(np.median(ticks)) if len(ticks) else 0.0
    named = choice.units.get(choice.time)
    if named and abs(middle) * TIME_UNITS[named] < UNIX_END_S:
        return named, f"{named} from its name"
    contradiction = f"; its name says {named}, which cannot be" if named else ""
    steps = np.diff(ticks)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    for unit, scale in TIME_UNITS.items():
        is_unix = UNIX_START_S <= middle * scale < UNIX_END_S
        if is_unix and step * scale <= MAX_UNIX_INTERVAL_S:
            return unit, f"{unit} from its magnitude{contradiction}"
    fits = [
        u for u, scale in TIME_UNITS.items() if MIN_INTERVAL_S <= step * scale <= MAX_INTERVAL_S
    ]
    if not fits:
        return "s", "s assumed, as no unit gives the rate of a UWB: else give --position-time-unit"
    words = f"{fits[0]} from its interval of {step * TIME_UNITS[fits[0]]:.3g} s"
    if fits[1:]:
        words += f" ({fits[1]} would do as well: then give --position-time-unit)"
    return fits[0], words + contradiction


def _length_units(
    numbers: pd.DataFrame, choice: ColumnChoice, option: str | None
) -> tuple[dict[int, str], str]:
    """Length unit of each column of numbers, and the words on those of position."""
    # outliers must not decide
    spreads = numbers[choice.axes].quantile(0.95) - numbers[choice.axes].quantile(0.05)
    spread = float(spreads.max())
    named = [choice.units[index] for index in choice.axes if index in choice.units]
    if option is not None:
        unit, reason = option, "as --position-unit says"
    elif named:
        unit, reason = named[0], "from the names"
    elif spread <= MAX_SPREAD_M:
        unit, reason = "m", "no unit in the names"
    elif MIN_SPREAD_M <= spread * LENGTH_UNITS["mm"] <= MAX_SPREAD_M:
        unit, reason = (
            "mm",
            f"as {spread:.0f} m is not an indoor flight; if cm, give --position-unit",
        )
    else:
        unit, reason = "m", "assumed, as no unit gives an indoor flight: else give --position-unit"
    units = {index: option or choice.units.get(index, unit) for index in choice.numbers}
    used = ", ".join(dict.fromkeys(units[index] for index in choice.axes))
    span = max(float(spreads[index]) * LENGTH_UNITS[units[index]] for index in choice.axes)
    return units, f"{used} ({reason}), nine tenths of it within {span:.3g} m"
