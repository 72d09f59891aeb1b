"""Reader of position files from UWB, motion capture and other positioning systems.

The standard format has a header and the columns ``time, x, y, z`` in seconds and metres, optionally
``sigma`` or ``sigma_x, sigma_y, sigma_z``. Other formats, column names and units are detected.
The positions keep the clock and the coordinate frame of the file.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, IntArray, compute_median_interval_s
from px4fuse.core.reading import read_bytes_limited, split_path_and_part
from px4fuse.errors import LogError, SettingsError
from px4fuse.flight.model import NO_INVALID_ROWS, time_index

from .common import classify_invalid_positions, estimate_quantisation_step
from .position_names import (
    METRES_BY_LENGTH_UNIT,
    SECONDS_BY_TIME_UNIT,
    TIME_KINDS,
    ColumnMeaning,
    PositionColumns,
    find_position_columns,
    find_quaternion_columns,
    find_sigma_columns,
    read_column_name,
)
from .recording_table import (
    COLUMNS_OPTION,
    HEADERLESS_TABLE_FORMAT,
    MAX_FILE_BYTES,
    MAX_VALID_UNIX_TIME_S,
    MIN_VALID_UNIX_TIME_S,
    PositionTable,
    choose_body,
    find_position_table,
    quote,
    refuse_foreign_format,
)
from .ros_bag import is_bag, read_bag
from .ulog_topics import find_longest_increasing_subsequence

SIGMA_COLUMNS = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]
SAMPLE_COLUMNS = ["x_m", "y_m", "z_m", *SIGMA_COLUMNS]

# Maximum number of UWB tags in a column; with more values, the column is a counter
MAX_TAGS_IN_FILE = 100
MIN_USABLE_ROWS = 3
# Minimum fraction of rows with the expected pattern, such as increasing times
MIN_MATCHING_ROW_FRACTION = 0.9
# Maximum median interval (s) of timestamps that are UNIX times
MAX_MEDIAN_UNIX_TIMESTAMP_INTERVAL_S = 60.0
# Maximum extent (m) of an indoor flight; otherwise, the positions are probably in mm
MAX_INDOOR_EXTENT_M = 200.0
# Maximum absolute coordinate; larger values are timestamps or damaged text
MAX_COORDINATE_IN_FILE_UNIT = 1e9
# Plausible time units, with minimum and maximum median interval (s): 0.2 to 200 UWB positions per
# second, ±10 %
UWB_INTERVALS_S = dict.fromkeys(SECONDS_BY_TIME_UNIT, (0.9 / 200, 1.1 / 0.2))
TRAJECTORY_INTERVALS_S = dict.fromkeys(("s", "ns"), (1e-3, 1e3))


@dataclass(frozen=True)
class PositionRecording:
    """Content of a position file, in the clock and frame of the file."""

    name: str
    sha256: str
    size_bytes: int
    # Position and σ, indexed by increasing time (s); NaN if not in the file
    samples: pd.DataFrame
    # "UNIX" if the timestamps are UNIX times
    clock_kind: Literal["UNIX", "local"]
    # Possible coordinate frames; empty if all are possible
    frames: tuple[str, ...]
    # Sentences about the detected format, for example the unit
    format_detection_notes: tuple[str, ...]
    # Warnings, and sentences about dropped rows
    notes: tuple[str, ...]
    # Number of rows with an invalid timestamp
    dropped_row_count: int = 0
    # Factor that converted the positions of the file to metres
    metres_per_unit: float = 1.0
    # Reason for each row without a valid position
    reason_by_invalid_row: "pd.Series[str]" = field(default_factory=lambda: NO_INVALID_ROWS)
    # Quantisation step of the horizontal position; 0 if not quantised
    quantisation_step_m: float = 0.0
    # Name of the file format; "" for a table with a header
    format: str = ""
    # Number of rows with the selected rigid body or UWB tag
    row_count: int = 0
    # Orientation of each sample (x, y, z, w)
    quaternions: Array | None = None


def read_position_file(
    path: str | Path,
    *,
    columns: tuple[str, ...] | None = None,
    time_unit: str | None = None,
    length_unit: str | None = None,
    body: str | None = None,
    is_trajectory: bool = False,
) -> PositionRecording:
    """Read positions and their σ from the file of a positioning system.

    Parameters
    ----------
    path : str or Path
        File, or ``FILE:BODY`` and ``BAG:TOPIC``.
    columns : tuple of str, optional
        Names or numbers (from 1) of the columns time, x, y, optionally z, and optionally sigma.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of the time column; overrides detection.
    length_unit : {"m", "cm", "mm"}, optional
        Unit of positions and sigmas; overrides detection.
    body : str, optional
        Name of the rigid body or UWB tag, or topic of a ROS bag.
    is_trajectory : bool
        True for trajectories: a large extent and the position 0, 0, 0 are valid.

    Raises
    ------
    LogError
        The file cannot be read, or contains no table of times and positions.
    SettingsError
        An argument is invalid, or the file does not contain a given column.
    """
    _check_options(columns, time_unit, length_unit)
    path, body_in_path = split_path_and_part(str(path))
    body = body or body_in_path
    table, sha256, size_bytes = _open_table(path, columns, body)
    notes = [*table.notes]
    column_meanings = [read_column_name(name) for name in table.column_names]
    if columns:
        column_meanings = _interpret_given_columns(table, column_meanings, columns)
    quaternion_columns = find_quaternion_columns(table.column_names)
    numbers, column_meanings, has_time_zone = _read_numbers(
        table, column_meanings, quaternion_columns, body
    )
    row_count = len(numbers)
    time_column, time_text = _detect_time_column(table, column_meanings, numbers)
    frame, axis_columns = _find_axes(column_meanings, numbers)
    sigma_columns = find_sigma_columns(column_meanings, frame)
    position_columns = [index for index in axis_columns if index is not None]

    # 1. Select the rows with a time and a position. pandas reads numbers such as 1e999 as infinite
    has_time = np.isfinite(numbers[time_column])
    has_position = (numbers[position_columns].abs() < MAX_COORDINATE_IN_FILE_UNIT).all(axis=1)
    dropped_rows = numbers.index[~(has_time & has_position)]
    if len(dropped_rows):
        notes.append(
            f"number of dropped rows without valid time or position: {len(dropped_rows)}"
            f"{table.format_first_line_number(dropped_rows)}"
        )
    times_without_position = numbers.loc[has_time & ~has_position, time_column].to_numpy()
    numbers = numbers[has_time & has_position]

    # 2. Convert the times to seconds, and select the rows with increasing times
    plausible_intervals_s = TRAJECTORY_INTERVALS_S if is_trajectory else UWB_INTERVALS_S
    unit, unit_reason = _choose_time_unit(
        numbers[time_column],
        table.rate_hz,
        column_meanings[time_column].unit,
        time_unit,
        plausible_intervals_s,
    )
    units_per_second = table.rate_hz or round(1.0 / SECONDS_BY_TIME_UNIT[unit])
    times_s = numbers[time_column].to_numpy() / units_per_second
    increasing_rows = _find_increasing_rows(times_s)
    if dropped_count := len(times_s) - len(increasing_rows):
        notes.append(
            "number of dropped rows (timestamp repeated, decreasing or after the year 2100): "
            f"{dropped_count}"
        )
    numbers = numbers.iloc[increasing_rows].set_index(time_index(times_s[increasing_rows]))
    _check_row_count(table, len(numbers), row_count, notes)
    median_interval_s = compute_median_interval_s(numbers.index)
    min_interval_s, max_interval_s = plausible_intervals_s["s"]
    if not min_interval_s <= median_interval_s <= max_interval_s:
        notes.append(
            f"a median interval of {median_interval_s:.3g} s is unusual: check the unit of time "
            "(--position-time-unit)"
        )
    is_unix_time = MIN_VALID_UNIX_TIME_S <= np.median(numbers.index) < MAX_VALID_UNIX_TIME_S
    clock_kind: Literal["UNIX", "local"] = "UNIX" if has_time_zone and is_unix_time else "local"

    # 3. Convert the positions and σ to metres, and remove invalid values
    metres_per_unit, length_unit_text = _choose_length_units(
        numbers[position_columns],
        position_columns,
        column_meanings,
        length_unit,
        np.inf if is_trajectory else MAX_INDOOR_EXTENT_M,
    )
    columns_m = {
        name: np.nan if index is None else numbers[index] * metres_per_unit[index]
        for name, index in zip(SAMPLE_COLUMNS, (*axis_columns, *sigma_columns), strict=True)
    }
    samples = pd.DataFrame(columns_m, numbers.index).replace([np.inf, -np.inf], np.nan)
    invalid_reasons = classify_invalid_positions(samples, SAMPLE_COLUMNS[: len(position_columns)])
    is_valid = (invalid_reasons == "") | is_trajectory
    samples = samples[is_valid]
    is_ignored_sigma = samples[SIGMA_COLUMNS] <= 0.0
    samples[SIGMA_COLUMNS] = samples[SIGMA_COLUMNS].mask(is_ignored_sigma)
    if ignored_count := is_ignored_sigma.any(axis=1).sum():
        notes.append(f"number of rows with an ignored sigma (not positive): {ignored_count}")
    reasons_without_position = pd.Series("NaN", times_without_position / units_per_second)
    reason_by_invalid_row = pd.concat([invalid_reasons[~is_valid], reasons_without_position])

    return PositionRecording(
        name=table.file_name,
        sha256=sha256,
        size_bytes=size_bytes,
        samples=samples,
        clock_kind=clock_kind,
        frames=(frame,) if frame else table.frames,
        dropped_row_count=dropped_count,
        format_detection_notes=(
            table.describe_format(),
            f"time: column {time_text}, {clock_kind} clock, unit {unit} ({unit_reason})",
            f"position: columns {table.format_labels(*axis_columns)} as "
            f"{frame.upper() if frame else 'x, y, z'}"
            f"{'' if len(position_columns) == 3 else ' without height'}, unit {length_unit_text}",
            f"sigma: columns {table.format_labels(*sigma_columns) or 'none'}",
        ),
        notes=tuple(notes),
        metres_per_unit=metres_per_unit[position_columns[0]],
        reason_by_invalid_row=reason_by_invalid_row.sort_index(),
        format=table.format,
        row_count=row_count,
        quaternions=numbers.loc[is_valid, quaternion_columns].to_numpy()
        if quaternion_columns
        else None,
        quantisation_step_m=max(
            estimate_quantisation_step(samples[name].to_numpy()) for name in ("x_m", "y_m")
        ),
    )


def _open_table(
    path: Path, columns: tuple[str, ...] | None, body_name: str | None
) -> tuple[PositionTable, str, int]:
    """Return the positions in a file or ROS bag, and its SHA-256 and size (bytes)."""
    if is_bag(path):
        return read_bag(path, body_name)
    content = read_bytes_limited(
        path, LogError, MAX_FILE_BYTES, remedy_if_empty="Copy or export the file again."
    )
    refuse_foreign_format(path, content, LogError)
    table = find_position_table(path, content, columns, body_name)
    return table, hashlib.sha256(content).hexdigest(), len(content)


def _find_increasing_rows(times_s: Array) -> IntArray:
    """Return the longest series of rows with strictly increasing times, as row indices.

    Rows with a time after the year 2100 are omitted.
    """
    usable_rows = np.flatnonzero(np.abs(times_s) < MAX_VALID_UNIX_TIME_S)
    # Replace the times by their ranks: find_longest_increasing_subsequence needs positive integers
    time_ranks = np.unique(times_s[usable_rows], return_inverse=True)[1].astype(np.int64)
    return usable_rows[find_longest_increasing_subsequence(time_ranks + 1)]


def _check_row_count(
    table: PositionTable, usable_count: int, row_count: int, notes: list[str]
) -> None:
    """Raise LogError if the table has too few usable rows. ``notes`` become part of the message.

    A table without header also needs a high fraction of usable rows (``row_count`` rows in total).
    With a lower fraction, its first column is probably not the time.
    """
    min_count = MIN_USABLE_ROWS
    if table.format == HEADERLESS_TABLE_FORMAT:
        min_count = max(min_count, math.ceil(MIN_MATCHING_ROW_FRACTION * row_count))
    if usable_count < min_count:
        fault = f"{table.file_name} contains {usable_count} usable rows, fewer than {min_count}"
        raise LogError(
            "; ".join((fault, *notes)),
            "Write numbers with decimal points. Alternatively, name the columns with "
            f"{COLUMNS_OPTION}.",
        )


def _check_options(
    columns: tuple[str, ...] | None, time_unit: str | None, length_unit: str | None
) -> None:
    """Raise SettingsError if the units or the number of columns are not valid."""
    for name, value, units in (
        ("time_unit", time_unit, SECONDS_BY_TIME_UNIT),
        ("length_unit", length_unit, METRES_BY_LENGTH_UNIT),
    ):
        if value is not None and value not in units:
            raise SettingsError(f"`{name}`: {value!r} is not one of {', '.join(units)}.")
    if columns and ("" in columns or len({*columns}) < len(columns) or not 3 <= len(columns) <= 5):
        raise SettingsError(
            f"{COLUMNS_OPTION}[,SIGMA]: {','.join(columns)!r} does not name three to five "
            "different columns."
        )


def _read_numbers(
    table: PositionTable,
    column_meanings: Sequence[ColumnMeaning],
    quaternion_columns: list[int],
    body_name: str | None,
) -> tuple[pd.DataFrame, list[ColumnMeaning], bool]:
    """Convert the text of the needed columns to numbers, and dates (ISO 8601) to UNIX times.

    Return the numbers, the column meanings and True. For a column of dates, the returned meaning
    has the unit s. The last value is False if the dates have no time zone. Text that is not a
    number becomes NaN.
    """
    known_columns = [index for index, meaning in enumerate(column_meanings) if meaning.kind]
    texts = table.read_cells([*quaternion_columns, *known_columns])
    texts = _select_body(table, texts, column_meanings, body_name)
    # DataFrame.apply returns dtype object for an empty table
    numbers = texts.apply(_to_numbers, may_have_decimal_comma=table.separator != ",").astype(
        np.float64
    )
    meanings, has_time_zone = [*column_meanings], True
    for index, meaning in enumerate(column_meanings):
        # If most times are not numbers, they are dates
        if (
            meaning.kind == "time"
            and numbers[index].isna().mean() > 0.5
            and texts[index].notna().any()
        ):
            dates = texts[index].str.replace(",", ".", regex=False)
            times = pd.to_datetime(dates, format="ISO8601", utc=True, errors="coerce")
            numbers[index] = (times - pd.Timestamp(0, tz="UTC")).dt.total_seconds()
            has_time_zone = bool(dates.str.contains(r"(?:Z|[+-]\d\d:?\d\d)$").mean() > 0.5)
            meanings[index] = replace(meaning, unit="s")
    return numbers, meanings, has_time_zone


def _to_numbers(texts: "pd.Series[str]", *, may_have_decimal_comma: bool) -> "pd.Series[float]":
    """Convert texts to numbers, with a decimal comma if most cells contain one."""
    if may_have_decimal_comma and texts.str.contains(",", regex=False).mean() > 0.5:
        texts = texts.str.replace(",", ".", regex=False)
    return pd.to_numeric(texts, errors="coerce").astype(np.float64)


def _select_body(
    table: PositionTable,
    texts: pd.DataFrame,
    column_meanings: Sequence[ColumnMeaning],
    body_name: str | None,
) -> pd.DataFrame:
    """Return the rows of one rigid body or UWB tag."""
    for index, meaning in enumerate(column_meanings):
        if meaning.kind == "tag":
            tags = texts[index].dropna().unique().tolist()
            # A column with many different values is a counter, not a column of tags: ignore it,
            # unless the user chose a tag
            has_several_tags = 1 < len(tags) <= MAX_TAGS_IN_FILE
            if has_several_tags or (tags and body_name is not None):
                return texts[texts[index] == choose_body(table.file_name, tags, body_name)]
    if body_name is not None and not table.has_only_chosen_body:
        raise LogError(
            f"{table.file_name} contains only one rigid body, without a name",
            "Omit --body, and the name after the colon in FILE:NAME.",
        )
    return texts


def _find_column_indices(table: PositionTable, wanted_columns: tuple[str, ...]) -> list[int]:
    """Return the index of each column that the user gave by name or number (from 1)."""
    names = [name.casefold() for name in table.column_names]
    # A number is a column name or, otherwise, a position in the header
    names += [str(index + 1) for index in range(len(names))]
    indices = []
    for column in wanted_columns:
        wanted_name = column.strip().casefold()
        if wanted_name not in names:
            raise SettingsError(
                f"{table.file_name} has no column {quote(column)}; the columns are "
                f"{table.format_labels(*range(len(table.column_names)))}",
                f"Name the columns with {COLUMNS_OPTION}.",
            )
        indices.append(names.index(wanted_name) % len(table.column_names))
    if len({*indices}) < len(indices):
        raise SettingsError(
            f"{COLUMNS_OPTION}: {quote(','.join(wanted_columns))} names one column twice."
        )
    return indices


def _interpret_given_columns(
    table: PositionTable,
    column_meanings: Sequence[ColumnMeaning],
    given_column_names: tuple[str, ...],
) -> list[ColumnMeaning]:
    """Return the meanings of all columns if the user gave those of time, position and sigma.

    The axes are x, y, z in the given order, unless the names of the given columns state the axes.
    """
    given_columns = _find_column_indices(table, given_column_names)
    time_column, *position_columns = given_columns[:4]
    sigma_columns = given_columns[4:]
    # Ignore the meaning of columns that the user did not name. Exceptions are UWB tags and, if the
    # user named no σ columns, σ
    kept_kinds = ("tag",) if sigma_columns else ("tag", "sigma")
    meanings = [
        meaning if index in position_columns or meaning.kind in kept_kinds else ColumnMeaning()
        for index, meaning in enumerate(column_meanings)
    ]
    frame_and_axis_columns = find_position_columns(meanings)
    named_axis_columns = frame_and_axis_columns[1] if frame_and_axis_columns else ()
    if not {*position_columns} <= {*named_axis_columns}:
        for axis, index in zip("xyz", position_columns, strict=False):  # z may be missing
            meanings[index] = ColumnMeaning("position", axis, column_meanings[index].unit)
    time_unit = column_meanings[time_column].unit
    meanings[time_column] = ColumnMeaning("time", unit=time_unit, time_kind="time")
    for index in sigma_columns:
        meanings[index] = ColumnMeaning("sigma", unit=column_meanings[index].unit)
    return meanings


def _find_axes(
    column_meanings: Sequence[ColumnMeaning], numeric_table: pd.DataFrame
) -> tuple[str | None, PositionColumns]:
    """Return the frame of the position (None: unknown), and the column indices of its axes."""
    frame_and_axis_columns = find_position_columns(column_meanings)
    assert frame_and_axis_columns  # find_position_table returns only tables with positions
    frame, (x_column, y_column, z_column) = frame_and_axis_columns
    if z_column is not None and numeric_table[z_column].isna().all():
        z_column = None
    return frame, (x_column, y_column, z_column)


def _detect_time_column(
    table: PositionTable, column_meanings: Sequence[ColumnMeaning], numeric_table: pd.DataFrame
) -> tuple[int, str]:
    """Return the index of the time column, and its name for notes.

    The time of measurement is preferred to the time of recording. If the time column contains whole
    seconds, the nanoseconds of another column are added to it in ``numeric_table``.
    """
    # Prefer columns with less than half of their cells empty or 0, then the time of measurement
    # (TIME_KINDS), then units other than ns: ns may contain only the fraction of a second
    time_columns = [index for index, column in enumerate(column_meanings) if column.kind == "time"]
    is_mostly_empty = numeric_table[time_columns].fillna(0.0).eq(0.0).mean() >= 0.5
    time_column, *other_time_columns = sorted(
        time_columns,
        key=lambda index: (
            is_mostly_empty[index],
            TIME_KINDS.index(column_meanings[index].time_kind),
            column_meanings[index].unit == "ns",
        ),
    )
    time_text = table.format_labels(time_column)
    is_whole_second = numeric_table[time_column] % 1.0 == 0.0
    nanosecond_columns = [
        index
        for index in other_time_columns
        if column_meanings[index].unit == "ns" and numeric_table[index].max() < 1e9
    ]
    if nanosecond_columns and is_whole_second.mean() > MIN_MATCHING_ROW_FRACTION:
        index = nanosecond_columns[0]
        numeric_table[time_column] += numeric_table[index] * 1e-9
        other_time_columns.remove(index)
        time_text += f" plus {table.format_labels(index)}"
    if other_time_columns:
        unused_labels = table.format_labels(*other_time_columns)
        time_text += f" ({column_meanings[time_column].time_kind}; not used: {unused_labels})"
    return time_column, time_text


def _choose_time_unit(
    times: "pd.Series[float]",
    frame_rate_hz: float | None,
    unit_in_column_name: str,
    given_unit: str | None,
    plausible_intervals_s: Mapping[str, tuple[float, float]],
) -> tuple[str, str]:
    """Return the unit of the timestamps, and the reason for this unit.

    A missing unit is detected from UNIX times, or from a plausible median interval.
    """
    if frame_rate_hz:
        return "frame numbers", f"the frame rate is {frame_rate_hz:g} Hz"
    if given_unit is not None:
        return given_unit, "the unit was given with --position-time-unit"
    median_time, time_steps = times.median(), times.diff()
    named_unit_s = SECONDS_BY_TIME_UNIT.get(unit_in_column_name)
    if named_unit_s is not None and abs(median_time) * named_unit_s < MAX_VALID_UNIX_TIME_S:
        return unit_in_column_name, "from the column name"
    median_step = time_steps[time_steps > 0.0].median()
    for unit, unit_s in SECONDS_BY_TIME_UNIT.items():
        is_unix = MIN_VALID_UNIX_TIME_S <= median_time * unit_s < MAX_VALID_UNIX_TIME_S
        if is_unix and median_step * unit_s <= MAX_MEDIAN_UNIX_TIMESTAMP_INTERVAL_S:
            return unit, f"in {unit}, the timestamps are UNIX times between 2000 and 2100"
    plausible_units = [
        unit
        for unit, (min_interval_s, max_interval_s) in plausible_intervals_s.items()
        if min_interval_s <= median_step * SECONDS_BY_TIME_UNIT[unit] <= max_interval_s
    ]
    if not plausible_units:
        return "s", (
            "px4fuse assumes seconds, because no unit gives a plausible UWB rate; set another unit "
            "with --position-time-unit"
        )
    unit, *other_units = plausible_units
    interval_s = median_step * SECONDS_BY_TIME_UNIT[unit]
    reason = f"in {unit}, the median interval of the positions is {interval_s:.3g} s"
    if other_units:
        reason += f"; if the unit is {other_units[0]}, give --position-time-unit"
    return unit, reason


def _choose_length_units(
    positions: pd.DataFrame,
    position_columns: list[int],
    column_meanings: Sequence[ColumnMeaning],
    given_unit: str | None,
    max_extent_m: float,
) -> tuple[list[float], str]:
    """Return the factor from the unit of each column to metres, and the reason for the unit.

    Without a unit in the column names, positions with a very large extent are in mm.
    """
    named_position_units = [
        column_meanings[index].unit
        for index in position_columns
        if column_meanings[index].unit in METRES_BY_LENGTH_UNIT
    ]
    # Extents in the unit of the file. The range from 5 % to 95 % excludes outliers
    extents = positions.quantile(0.95) - positions.quantile(0.05)
    largest_extent = extents.max()
    # Unit of the columns whose names contain no unit
    default_unit = "m"
    reason = "px4fuse assumes metres, because the column names contain no unit"
    if given_unit is not None:
        reason = "the unit was given with --position-unit"
    elif named_position_units:
        default_unit = named_position_units[0]
        reason = "the column names contain the unit"
    elif max_extent_m < largest_extent <= max_extent_m / METRES_BY_LENGTH_UNIT["mm"]:
        default_unit = "mm"
        reason = (
            f"an extent of {largest_extent:.0f} m is too large for an indoor flight; if the unit "
            "is cm, give --position-unit"
        )
    units = [
        given_unit or (meaning.unit if meaning.unit in METRES_BY_LENGTH_UNIT else default_unit)
        for meaning in column_meanings
    ]
    metres_per_unit = [METRES_BY_LENGTH_UNIT[unit] for unit in units]
    extent_m = max(extents[index] * metres_per_unit[index] for index in position_columns)
    units_text = ", ".join(dict.fromkeys(units[index] for index in position_columns))
    return (
        metres_per_unit,
        f"{units_text} ({reason}); 90 % of the positions are within {extent_m:.3g} m",
    )
