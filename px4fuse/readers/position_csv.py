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
import re
import stat
import unicodedata
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.errors import LogError, SettingsError
from px4fuse.readers.ulog_topics import increasing

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SAMPLE_COLUMNS = ["x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "quality"]
SIGMA_COLUMNS = SAMPLE_COLUMNS[3:6]
COLUMNS_OPTION = "--position-columns TIME,X,Y,Z"

MAX_FILE_BYTES = 500_000_000  # days of any UWB system
MAX_LINE_CHARS = 100_000
# The layout is decided from the first lines, up to both of these
HEAD_LINES = 1000
HEAD_CHARS = 200_000
MIN_ROWS = 3
MIN_COLUMNS = 3  # time, x, y
MAX_NAMES = 12  # of columns in one sentence
# A UNIX clock that is set lies between 2000 and 2100
UNIX_START_S, UNIX_END_S = 946_684_800, 4_102_444_800
# UWB systems run between 0.2 Hz and 200 Hz; their intervals vary by a tenth
MIN_INTERVAL_S, MAX_INTERVAL_S = 0.9 / 200, 1.1 / 0.2
# A boot clock in µs after half an hour has the magnitude of UNIX time in s; its intervals have not
MAX_UNIX_INTERVAL_S = 60.0
# What an indoor flight spans
MIN_SPREAD_M, MAX_SPREAD_M = 0.2, 200.0
MAX_COORDINATE = 1e9  # in any unit; beyond it stands a time stamp, or damage
MAX_TICKS = 2**62  # of a time stamp in its own unit; differences must fit into int64

_SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}  # ties: the first
_COMMENT_MARKS = ("#", "%")
_PADDING = "\n\0\x1a \t"  # a power cut leaves NULs at the end, DOS Ctrl-Z
_ENCODINGS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?|[0-9]*[.,][0-9]+)(?:[eE][+-]?[0-9]+)?")
_PLAIN_NUMBER = re.compile(r"([+-]?)([0-9]{1,19})(?:[.,]([0-9]*))?")
_ISO_TIME = re.compile(r"[0-9]{4}[-/][0-9]{2}[-/][0-9]{2}[T ][0-9]{2}:[0-9]{2}.*")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _words(table: Mapping[str, str]) -> dict[str, str]:
    """Turn a table of meaning to words into one of word to meaning."""
    return {word: meaning for meaning, words in table.items() for word in words.split()}


# Names of columns are read in lower case and as words: "position.x_m" is position, x, m
_UNITS = _words(
    {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisecond milliseconds",
        "us": "us usec usecs micros microsecond microseconds",
        "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
        "m": "m meter meters metre metres",
        "cm": "cm centimeter centimeters centimetre centimetres",
        "mm": "mm millimeter millimeters millimetre millimetres",
    }
)
# In order of preference
_TIMES = _words(
    {
        "time of measurement": "headerstamp headertimestamp headertime measurementtime sampletime "
        "measurementtimestamp sensortime timestampsample",
        "time": "timestamp time t ts stamp unix unixtime unixtimestamp timestampunix timeunix "
        "epoch epochtime datetime utc utctime timeutc timestamputc elapsed elapsedtime",
        "time of recording": "bagtime bagtimestamp bagstamp rosbagtime rosbagtimestamp recvtime "
        "receivetime receivetimestamp receivedtime rxtime arrivaltime logtime logtimestamp "
        "recordtime recordingtime hosttime hosttimestamp pctime systemtime",
    }
)
_AXES = _words(
    {
        "x": "x v0",
        "y": "y v1",
        "z": "z v2",
        "north": "n north northing",
        "east": "e east easting",
        "down": "d down",
        "up": "u up height altitude alt",
    }
)
_WORDS = _words(
    {
        "sigma": "sigma std stdev stddev sd s accuracy uncertainty deviation",
        "context": "p t pos position positions pose point translation transform location loc coord "
        "coordinate coordinates field msg data uwb rtls tag est estimate estimated measured raw "
        "filtered local world map",
    }
)
_WHOLE_NAMES = _words(
    {
        "quality": "quality q qf qualityfactor positionquality confidence",
        "tag": "tag tagid id serial address node nodeid deviceid",
    }
)
_TIME_CONTEXT = ("field", "msg", "data", "uwb", "tag", "since", "start", "boot")
_MISSING = _words(
    {"": "- -- nan +nan -nan nan(ind) -nan(ind) na n/a null none nil inf +inf -inf infinity"}
)
_GLUED = re.compile(r"(pos|position|p|t|sigma|std|stddev|s)([xyzneud])|([xyz])(pos|std|sigma)")
# Frame, and the names of its axes in order; the first whose horizontal names are there is taken
_FRAMES: tuple[tuple[str | None, tuple[str, str, str]], ...] = (
    ("ned", ("north", "east", "down")),
    ("enu", ("east", "north", "up")),
    (None, ("x", "y", "z")),
    (None, ("x", "y", "up")),
    (None, ("x", "y", "down")),
)


@dataclass(frozen=True)
class PositionFile:
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
) -> PositionFile:
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

    Returns
    -------
    PositionFile

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
    name = path.name.encode(errors="replace").decode()
    content = _read_bytes(path, name)
    text = _Text(name, content, _encoding(name, content))
    table = _find_table(text, columns)
    choice = _choose(name, table, columns)
    rows = _read_rows(text, table, choice)
    unit, unit_words = _time_unit(rows, choice, time_unit)
    seconds = _seconds(rows, unit)
    usable = np.flatnonzero(np.abs(seconds) < UNIX_END_S)
    # by rank: stamps that are apart as integers can be one float
    ranks = np.unique(seconds[usable], return_inverse=True)[1].astype(np.int64)
    keep = usable[increasing(ranks + 1)]
    notes = [*table.notes, *choice.notes, *rows.notes]
    if dropped := len(seconds) - len(keep):
        notes.append(f"{_count(dropped)} dropped: their time stamps repeat, go back or are absurd")
    if len(keep) < MIN_ROWS:
        raise LogError(
            f"{name}: usable rows: {len(keep)}, at least {MIN_ROWS} are needed"
            f"{''.join('; ' + note for note in notes)}. Copy the file again, or say where time and "
            f"position are with {COLUMNS_OPTION}."
        )
    values = {index: column[keep] for index, column in rows.values.items()}
    units, unit_reason = _length_units(values, choice, length_unit)
    samples, doubts = _samples(values, choice, units)
    samples.index = pd.Index(seconds[keep], name="time_s")
    step = float(np.median(np.diff(seconds[keep])))
    if not MIN_INTERVAL_S <= step <= MAX_INTERVAL_S:
        doubts.append(
            f"one sample in {step:.3g} s (median) is no rate of a UWB: check --position-time-unit"
        )
    is_unix = UNIX_START_S <= float(np.median(seconds[keep])) < UNIX_END_S
    clock: Literal["UNIX", "local"] = "UNIX" if is_unix else "local"
    time, position, sigma, quality = choice.detected
    return PositionFile(
        name=name,
        sha256=hashlib.sha256(content).hexdigest(),
        size_bytes=len(content),
        samples=samples,
        clock=clock,
        frame=choice.frame,
        detected=(
            table.detected,
            f"{time}, {clock} clock, in {unit_words}",
            f"{position}, in {unit_reason}",
            sigma,
            quality,
        ),
        notes=(*notes, *doubts),
    )


# -- the file and its lines ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Text:
    """The file as lines of text."""

    name: str
    content: bytes
    encoding: str

    def lines(self) -> Iterator[tuple[int, str]]:
        """Number from 1 and text of each line; only a last line may lack its line feed."""
        # undecodable bytes become characters that no number has, so they are met as text
        stream = io.TextIOWrapper(io.BytesIO(self.content), self.encoding, errors="replace")
        for number, line in enumerate(iter(partial(stream.readline, MAX_LINE_CHARS), ""), 1):
            if len(line) == MAX_LINE_CHARS:
                raise LogError(
                    f"{self.name}: line {number} has {MAX_LINE_CHARS} characters or more, so this "
                    "is no table of positions. Give the CSV file of the UWB system."
                )
            yield number, line

    def head(self) -> list[tuple[int, str]]:
        """The first lines that are not blank."""
        lines: list[tuple[int, str]] = []
        chars = 0
        for number, line in self.lines():
            if chars > HEAD_CHARS or number > HEAD_LINES:
                break
            chars += len(line)
            if line.strip():
                lines.append((number, line))
        return lines


def _check_options(
    columns: tuple[str, ...] | None, time_unit: str | None, length_unit: str | None
) -> None:
    """Refuse option values that are wrong for any file."""
    for option, value, units in (
        ("--position-time-unit", time_unit, TIME_UNITS),
        ("--position-unit", length_unit, LENGTH_UNITS),
    ):
        if value is not None and value not in units:
            raise SettingsError(f"{option}: {value!r} is none of {', '.join(units)}.")
    if columns is not None:
        given = [column.strip().casefold() for column in columns]
        if not 3 <= len(given) <= 5 or "" in given or len(set(given)) < len(given):
            raise SettingsError(
                f"{COLUMNS_OPTION}[,SIGMA]: {','.join(columns)!r} does not name four or five "
                "different columns (three where there is no height)."
            )


def _read_bytes(path: Path, name: str) -> bytes:
    """All bytes of a regular file that is neither empty nor too large."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "no regular file"
            raise LogError(f"{name}: this is {kind}. Give the CSV file of the UWB system.")
        if status.st_size > MAX_FILE_BYTES:
            raise LogError(
                f"{name}: {status.st_size / 1e6:.0f} MB, more than the limit of "
                f"{MAX_FILE_BYTES / 1e6:.0f} MB. Cut the file down to the flight."
            )
        content = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"{name}: cannot be read ({reason}). Check its path.") from error
    if not content:
        raise LogError(f"{name}: the file is empty. Copy it from the UWB computer again.")
    return content


def _encoding(name: str, content: bytes) -> str:
    """Encoding of the text.

    Raises
    ------
    LogError
        The file is not text.
    """
    if content[:2] in _ENCODINGS:
        return _ENCODINGS[content[:2]]
    head = content[:HEAD_CHARS]
    if b"\0" in head.rstrip(b"\0"):  # a power cut leaves NULs behind the last line
        raise LogError(
            f"{name}: a binary file, not a text table. Give the CSV file of the UWB system; "
            "a flight log is read without --position."
        )
    try:
        head[: head.rfind(b"\n") + 1].decode()
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _split(line: str, separator: str) -> list[str]:
    """Fields of one line without quotes, blanks around them and empty fields at the end."""
    line = line.strip(_PADDING if separator != "\t" else _PADDING[:-1])
    if separator == " ":
        fields = " ".join(line.split()).replace(" [", "[").replace(" (", "(").split(" ")
    elif '"' in line:  # each line alone: a quote that is never closed costs one line
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    else:
        fields = line.split(separator)
    fields = [field.strip(" \t\"'") for field in fields]
    while fields and not fields[-1]:
        fields.pop()
    return fields


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENT_MARKS)


def _is_value(text: str) -> bool:
    """Whether this is a number or a time."""
    return bool(_NUMBER.fullmatch(text) or _ISO_TIME.fullmatch(text))


def _is_missing(text: str) -> bool:
    return not text or text.lower() in _MISSING


def _quote(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _count(rows: int) -> str:
    return "1 row was" if rows == 1 else f"{rows} rows were"


# -- what the names mean ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Meaning:
    """What one column's name says.

    Attributes
    ----------
    kind : str
        "time", "position", "sigma", "quality", "tag", or "" where the name says nothing.
    key : str
        Name of the axis, or of the time without its unit.
    unit : str or None
    group : str
        What else a position's name holds, which its x, y and z share.
    """

    kind: str = ""
    key: str = ""
    unit: str | None = None
    group: str = ""


def _meaning(name: str) -> _Meaning:
    """Read a column's name."""
    plain = unicodedata.normalize("NFKC", name).replace("μ", "u")
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", plain).lower()
    words = re.findall(r"[^\W_]+", plain)
    unit = _UNITS.get(words[-1]) if words else None
    if unit and len(words) > 1:
        words.pop()
    elif unit in TIME_UNITS:
        words = ["time"]  # a column named "secs" or "millis"
    else:
        unit = None
    key = "".join(word for word in words if word not in _TIME_CONTEXT)
    if key in _TIMES and unit not in LENGTH_UNITS:
        return _Meaning("time", key, unit)
    whole = "".join(word for word in words if not word.isdecimal())  # "quality (0-100)"
    if whole in _WHOLE_NAMES and unit is None:
        return _Meaning(_WHOLE_NAMES[whole])
    return _Meaning() if unit in TIME_UNITS else _length_meaning(words, unit)


def _length_meaning(words: list[str], unit: str | None) -> _Meaning:
    """Read the words of a position's or a sigma's name."""
    parts: list[str] = []
    for word in words:
        glued = None if word in _WORDS or word in _AXES else _GLUED.fullmatch(word)
        parts += [part for part in glued.groups() if part] if glued else [word]
    axes = [_AXES[part] for part in parts if part in _AXES]
    rest = [part for part in parts if part not in _AXES]
    roles = {_WORDS.get(part.rstrip("0123456789")) for part in rest}
    if len(axes) > 1 or None in roles:
        return _Meaning()
    if "sigma" in roles:
        return _Meaning("sigma", "".join(axes), unit)
    return _Meaning("position", axes[0], unit, ".".join(rest)) if axes else _Meaning()


_Position = tuple[int, int, int | None]


def _find_position(meanings: Sequence[_Meaning]) -> tuple[str | None, _Position] | None:
    """Frame and columns of the first track that has two horizontal axes, best all three."""
    groups: dict[str, dict[str, int]] = {}
    for index, meaning in enumerate(meanings):
        if meaning.kind == "position":
            groups.setdefault(meaning.group, {}).setdefault(meaning.key, index)
    for complete in (True, False):
        for axes in groups.values():
            for frame, (first, second, third) in _FRAMES:
                if first in axes and second in axes and (third in axes or not complete):
                    return frame, (axes[first], axes[second], axes.get(third))
    return None


# -- where the table is ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Table:
    """Layout of the text.

    Attributes
    ----------
    separator : str
    names : tuple of str
        From the header; empty where there is none.
    header : str
        The header's line, stripped.
    first_line : int
        Number of the first line after the header.
    head : list of list of str
        Fields of the first rows.
    detected : str
    notes : tuple of str
    """

    separator: str
    names: tuple[str, ...]
    header: str
    first_line: int
    head: list[list[str]]
    detected: str
    notes: tuple[str, ...]

    def label(self, index: int) -> str:
        """Name of a column for a person."""
        if index < len(self.names) and self.names[index]:
            return _quote(self.names[index])
        return f"column {index + 1}"

    def labels(self, columns: Iterable[int | None]) -> str:
        """Names of the first columns of some, each once."""
        some = dict.fromkeys(self.label(index) for index in columns if index is not None)
        return ", ".join(list(some)[:MAX_NAMES]) + (", ..." if len(some) > MAX_NAMES else "")

    def header_words(self) -> str:
        """What the header holds, for a person."""
        return self.labels(range(len(self.names))) if self.names else "none: no header"

    def column(self, index: int) -> list[str]:
        """Texts of one column in the first rows."""
        return [row[index] if index < len(row) else "" for row in self.head]

    def is_numeric(self, index: int) -> bool:
        """Whether a column holds numbers and no text in the first rows."""
        texts = [text for text in self.column(index) if not _is_missing(text)]
        return bool(texts) and all(map(_NUMBER.fullmatch, texts))

    def is_filled(self, index: int) -> bool:
        """Whether most first rows hold a time that is not zero."""
        texts = self.column(index)
        filled = sum(_is_value(text) and bool(text.strip("+-0.,")) for text in texts)
        return 2 * filled > len(texts)


def _find_table(text: _Text, columns: tuple[str, ...] | None) -> _Table:
    """Find separator, header and first row.

    Raises
    ------
    LogError
        The first lines hold no row of numbers, or rows have more columns than the header.
    """
    head = text.head()
    rows = [line for _, line in head if not _is_comment(line)]
    scores = {mark: sum(_score(_split(line, mark)) for line in rows) for mark in _SEPARATORS}
    separator = max(scores, key=scores.__getitem__)
    if not scores[separator]:
        raise LogError(
            f"{text.name}: no row of numbers in its first {len(head)} lines, so this is no table "
            "of positions. Give a CSV file with the columns time, x, y, z."
        )
    start, names = _find_header(head, separator, columns)
    header = head[start - 1] if names else (0, "")
    rest = [(number, line) for number, line in head[start:] if not _is_comment(line)]
    units = _split(rest[0][1], separator) if names and rest else []
    if len(units) > 1 and all(unit.strip("[]()").lower() in _UNITS for unit in units):
        units += [""] * (len(names) - len(units))
        names = [f"{name} {unit}".strip() for name, unit in zip(names, units, strict=False)]
        rest = rest[1:]
    # the last line may be cut
    fields = [_split(line, separator) for _, line in rest if line.endswith("\n")]
    comma = any("," in field and _NUMBER.fullmatch(field) for row in fields for field in row)
    notes = []
    skipped = sum(not _is_comment(line) for _, line in head[: start - bool(names)])
    if skipped:
        notes.append(f"{skipped} line{'s'[: skipped > 1]} before the table skipped")
    usual = _usual_width(fields)
    room = 0 if separator == " " else header[1].count(separator) + 1
    by_number = columns is not None and all(column.isdecimal() for column in columns)
    if names and usual > max(len(names), room) and not by_number:
        is_double = separator == "," and usual == 2 * len(names)
        raise LogError(
            f"{text.name}: the header names {len(names)} columns, but rows have {usual}"
            f"{', as with a decimal comma between commas' if is_double else ''}. Export it with "
            f"semicolons, or give the columns' numbers with {COLUMNS_OPTION}."
        )
    return _Table(
        separator=separator,
        names=tuple(names),
        header=header[1].strip(),
        first_line=rest[0][0] if rest else head[-1][0] + 1,
        head=fields,
        detected=(
            f"table: {_SEPARATORS[separator]} between columns, "
            f"decimal {'comma' if comma else 'point'}, "
            + (f"header in line {header[0]}" if names else "no header")
            + ("" if text.encoding == "utf-8-sig" else f", {text.encoding}")
        ),
        notes=tuple(notes),
    )


def _score(fields: list[str]) -> int:
    """How much of a row a line is, when split this way."""
    values = sum(map(_is_value, fields))
    return values if values > 1 else 0


def _is_row(fields: list[str]) -> bool:
    """Whether these are values and words for missing ones, enough for a position."""
    values = sum(map(_is_value, fields))
    return values > 0 and values + sum(bool(f) and _is_missing(f) for f in fields) >= MIN_COLUMNS


def _usual_width(rows: list[list[str]]) -> int:
    return int(np.median([len(row) for row in rows])) if rows else 0


def _find_header(
    head: list[tuple[int, str]], separator: str, columns: tuple[str, ...] | None
) -> tuple[int, list[str]]:
    """Where in the first lines the rows start, and the names (none without a header)."""
    wanted = {column.strip().casefold() for column in columns or () if not column.isdecimal()}

    def is_header(names: list[str]) -> bool:
        if wanted or _is_row(names):
            return bool(wanted) and wanted <= {name.casefold() for name in names}
        meanings = [_meaning(name) for name in names]
        has_time = any(meaning.kind == "time" for meaning in meanings)
        return has_time and _find_position(meanings) is not None

    # a header behind a comment mark may be separated otherwise than the rows: numpy.savetxt
    for comment, pattern in ((False, None), (True, None), (True, r"[,;\s]+")):
        for at, (_, line) in enumerate(head):
            if _is_comment(line) == comment:
                bare = line.strip("#% \n") if comment else line
                names = re.split(pattern, bare) if pattern else _split(bare, separator)
                if is_header(names):
                    return at + 1, names
    before: list[str] = []
    for at, (_, line) in enumerate(head):
        if _is_comment(line):
            continue
        fields = _split(line, separator)
        if _is_row(fields):
            # a line of as many words is a header whose names are unknown
            words = [field for field in before if field and not _is_value(field)]
            return at, before if len(words) > 1 and len(before) >= len(fields) - 1 else []
        before = fields
    return 0, []


# -- which columns ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Choice:
    """Columns to read, by index.

    Attributes
    ----------
    time : int
    nanoseconds : int or None
        The column with the other half of the time, where it is split.
    position, sigma : tuple of int or None
        Of x, y, z.
    quality : int or None
    units : mapping from column to unit
        Those that names give.
    frame : str or None
    detected : tuple of str
        On time, position, sigma and quality.
    notes : tuple of str
    """

    time: int
    nanoseconds: int | None
    position: _Position
    sigma: tuple[int | None, int | None, int | None]
    quality: int | None
    units: Mapping[int, str]
    frame: str | None
    detected: tuple[str, str, str, str]
    notes: tuple[str, ...]

    @property
    def axes(self) -> list[int]:
        """Columns of position that there are."""
        return [index for index in self.position if index is not None]

    @property
    def numbers(self) -> list[int]:
        """Columns of numbers besides time, each once, those of position first."""
        every = (*self.position, *self.sigma, self.quality, self.nanoseconds)
        return list(dict.fromkeys(index for index in every if index is not None))


def _choose(name: str, table: _Table, columns: tuple[str, ...] | None) -> _Choice:
    """Choose the columns.

    Raises
    ------
    LogError
        There are none for time or position.
    SettingsError
        The option names columns that the file has not.
    """
    width = max([len(table.names), *map(len, table.head)])
    meanings = [*map(_meaning, table.names), *[_Meaning()] * (width - len(table.names))]
    told = None
    if columns is not None:
        told = _resolve(columns, table, width)
    elif not table.names:
        usual = _usual_width(table.head)
        if usual < MIN_COLUMNS:
            raise LogError(_not_found(name, table, "time and position columns"))
        # of more than five columns the fifth is no sigma but an attitude or the like
        told = list(range(5 if usual == 5 and table.is_numeric(4) else min(usual, 4)))
    nanoseconds = None
    if told is None:
        time, nanoseconds, time_words = _choose_time(name, table, meanings)
        found = _find_position(meanings)
        if found is None:
            raise LogError(_not_found(name, table, "position columns"))
        frame, position = found
    else:
        time, time_words = told[0], table.label(told[0])
        frame, position = None, (told[1], told[2], told[3] if len(told) > 3 else None)
        chosen = [m if index in told[1:4] else _Meaning() for index, m in enumerate(meanings)]
        found = _find_position(chosen)
        if found and set(found[1]) == set(position):
            frame, position = found
    notes = []
    if position[2] is not None and all(map(_is_missing, table.column(position[2]))):
        notes.append(f"{table.label(position[2])} is empty, so height is not given")
        position = (position[0], position[1], None)
    if told is not None and len(told) > 4:
        sigma: tuple[int | None, ...] = (told[4],) * 3
    else:
        sigma = _find_sigma(table, meanings, frame)
    kinds = [meaning.kind for meaning in meanings]
    quality = kinds.index("quality") if "quality" in kinds else None
    if quality is not None and not table.is_numeric(quality):
        notes.append(f"{table.label(quality)} holds no numbers and was left out")
        quality = None
    tags = set(table.column(kinds.index("tag"))) - {""} if "tag" in kinds else set()
    if len(tags) > 1:
        notes.append(
            f"{table.label(kinds.index('tag'))} has several values ({_quote(min(tags))}, "
            f"{_quote(max(tags))}): if these are several tags, keep one in the file"
        )
    others = [i for i, kind in enumerate(kinds) if kind == "position" and i not in position]
    return _Choice(
        time=time,
        nanoseconds=nanoseconds,
        position=position,
        sigma=(sigma[0], sigma[1], sigma[2]),
        quality=quality,
        units={
            i: meaning.unit
            for i, meaning in enumerate(meanings)
            if meaning.unit in (TIME_UNITS if i == time else LENGTH_UNITS) and meaning.unit
        },
        frame=frame,
        detected=(
            f"time: {time_words}",
            f"position: {table.labels(position)} as {frame.upper() if frame else 'x, y, z'}"
            + ("" if position[2] is not None else " without height")
            + (f" (not used: {table.labels(others)})" if others else ""),
            f"sigma: {table.labels(sigma) or 'none'}",
            "quality: " + ("none" if quality is None else f"{table.label(quality)}, as given"),
        ),
        notes=tuple(notes),
    )


def _not_found(name: str, table: _Table, what: str) -> str:
    return (
        f"{name}: no {what} found (the columns are {table.header_words()}). "
        f"Name them with {COLUMNS_OPTION}."
    )


def _resolve(columns: tuple[str, ...], table: _Table, width: int) -> list[int]:
    """Columns that the option names, by index."""
    names = [name.casefold() for name in table.names]
    found = []
    for column in columns:
        wanted = column.strip().casefold()
        if wanted in names:
            found.append(names.index(wanted))
        elif wanted.isdecimal() and 1 <= float(wanted) <= width:
            found.append(int(wanted) - 1)
        else:
            raise SettingsError(
                f"{COLUMNS_OPTION}: the file has no column {_quote(column)} (it has {width}, "
                f"named {table.header_words()})."
            )
    if len(set(found)) < len(found):
        raise SettingsError(
            f"{COLUMNS_OPTION}: {_quote(','.join(columns))} names one column twice."
        )
    return found


def _choose_time(
    name: str, table: _Table, meanings: Sequence[_Meaning]
) -> tuple[int, int | None, str]:
    """Column of time, the column of its nanoseconds where it is split, and the words on it."""
    order = list(dict.fromkeys(_TIMES.values()))
    candidates = sorted(
        (index for index, meaning in enumerate(meanings) if meaning.kind == "time"),
        key=lambda index: order.index(_TIMES[meanings[index].key]),
    )
    if not candidates:
        raise LogError(_not_found(name, table, "time column"))
    filled = [index for index in candidates if table.is_filled(index)]
    time = (filled or candidates)[0]
    key = meanings[time].key
    halves = {meanings[i].unit: i for i in reversed(candidates) if meanings[i].key == key}
    if {"s", "ns"} <= set(halves):
        whole, rest = halves["s"], halves["ns"]
        numbers = map(_number, table.column(rest))
        if not any(number is not None and number >= 1e9 for number in numbers):
            return whole, rest, f"{table.labels((whole, rest))} together"
    words = table.label(time)
    if len(candidates) > 1:
        empty = [index for index in candidates[: candidates.index(time)] if index not in filled]
        others = [index for index in candidates if index not in (time, *empty)]
        words += f", the {_TIMES[key]}" + (f" ({table.labels(empty)} is empty)" if empty else "")
        words += f" (not used: {table.labels(others)})" if others else ""
    return time, None, words


def _find_sigma(
    table: _Table, meanings: Sequence[_Meaning], frame: str | None
) -> tuple[int | None, ...]:
    """Columns of sigma of x, y and z."""
    found: dict[str, int] = {}
    for index, meaning in enumerate(meanings):
        if meaning.kind == "sigma" and table.is_numeric(index):
            found.setdefault(meaning.key, index)
    axes = next(axes for name, axes in _FRAMES if name == frame)
    return tuple(
        found.get(axis, found.get(letter, found.get("")))
        for axis, letter in zip(axes, "xyz", strict=True)
    )


# -- the rows --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Rows:
    """Rows with time and position, in the file's units.

    Attributes
    ----------
    whole : array of int64, shape (n,)
        Whole part of the time: float64 does not hold the 19 digits of UNIX time in ns.
    fraction : array of float64, shape (n,)
        The rest of it.
    iso : str
        Where the times were ISO 8601 text, on which they are in µs: the words on that.
    values : mapping from column to array of float64, shape (n,)
    notes : tuple of str
    """

    whole: NDArray[np.int64]
    fraction: NDArray[np.float64]
    iso: str
    values: Mapping[int, NDArray[np.float64]]
    notes: tuple[str, ...]


def _number(text: str) -> float | None:
    """Value of a number, NaN where it is missing, None where it is text."""
    if _NUMBER.fullmatch(text):
        return float(text.replace(",", "."))
    return float("nan") if _is_missing(text) else None


def _stamp(text: str) -> tuple[int, float] | None:
    """Whole and fractional part of a time; None where it is text, missing or out of any range."""
    if plain := _PLAIN_NUMBER.fullmatch(text):
        sign = -1 if plain[1] == "-" else 1
        whole, fraction = sign * int(plain[2]), sign * float(f"0.{plain[3] or 0}")
    else:
        value = _number(text)
        if value is None or not abs(value) < MAX_TICKS:
            return None
        whole = int(value)
        fraction = value - whole
    return (whole, fraction) if abs(whole) < MAX_TICKS else None


def _iso_stamp(text: str) -> tuple[int, float] | None:
    """UNIX time in µs of ISO 8601 text (UTC where it names no zone); None where it is none."""
    try:
        moment = datetime.fromisoformat(text.replace("/", "-"))
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // timedelta(microseconds=1), 0.0


def _read_rows(text: _Text, table: _Table, choice: _Choice) -> _Rows:
    """Read all rows that have time and position.

    Raises
    ------
    LogError
        There is text where a number belongs.
    """
    numbers = choice.numbers
    # arrays of the standard library: a list of floats takes four times as much
    whole, fraction = array("q"), array("d")
    values = {index: array("d") for index in numbers}
    times = [time for time in table.column(choice.time) if not _is_missing(time)]
    iso = times[0] if times and _ISO_TIME.fullmatch(times[0]) else ""
    missing = repeated = cut = 0
    for number, line in text.lines():
        if number < table.first_line or not line.strip(f"{_PADDING}{table.separator}"):
            continue
        if line.strip() == table.header or _is_comment(line):
            repeated += not _is_comment(line)
            continue
        fields = _split(line, table.separator)
        if not line.endswith("\n") and _is_cut(fields, table, choice):
            cut = number
            continue
        fields += [""] * (max(choice.time, *numbers) + 1 - len(fields))
        time = fields[choice.time]
        stamp = _iso_stamp(time) if iso else _stamp(time)
        row = [_number(fields[index]) for index in numbers]
        is_text = stamp is None and (iso or not _NUMBER.fullmatch(time)) and not _is_missing(time)
        if is_text or None in row:
            column = choice.time if is_text else numbers[row.index(None)]
            raise LogError(
                f"{text.name}: line {number}, {table.label(column)}: {_quote(fields[column])} is "
                f"no {'time' if is_text else 'number'}. Correct or remove that line, or say where "
                f"time and position are with {COLUMNS_OPTION}."
            )
        known = [float("nan") if value is None else value for value in row]
        if choice.nanoseconds is not None and stamp is not None:
            rest = known[numbers.index(choice.nanoseconds)]
            stamp = (stamp[0], rest * 1e-9) if abs(rest) < 1e9 else None
        position = known[: len(choice.axes)]
        if stamp is None or not all(abs(value) < MAX_COORDINATE for value in position):
            missing += 1
            continue
        whole.append(stamp[0])
        fraction.append(stamp[1])
        for index, value in zip(numbers, known, strict=True):
            values[index].append(value)
    notes = {
        f"{_count(missing)} dropped: without a usable time or position": missing,
        f"the header stands {repeated} more times between the rows": repeated,
        f"line {cut}, the last one, was dropped: it is cut": cut,
    }
    has_zone = re.search(r"(?:z|[+-]\d\d(?::?\d\d)?)$", iso[10:].lower())
    return _Rows(
        whole=np.array(whole, dtype=np.int64),
        fraction=np.array(fraction, dtype=np.float64),
        iso=iso and ("ISO 8601 text" if has_zone else "ISO 8601 text, no zone, taken as UTC"),
        values={index: np.array(column) for index, column in values.items()},
        notes=tuple(note for note, happened in notes.items() if happened),
    )


def _is_cut(fields: list[str], table: _Table, choice: _Choice) -> bool:
    """Whether a last line without line feed ends early.

    It does where it has fewer fields or fewer digits in its last one than every row before it.
    """
    rows = [row for row in table.head if row]
    if not fields or not rows or len(fields) < min(map(len, rows)):
        return True
    if _number(fields[-1]) is None and not _ISO_TIME.fullmatch(fields[-1]):
        return len(fields) - 1 in (choice.time, *choice.numbers)
    texts = [row[-1].replace(",", ".") for row in rows]
    has_point = any("." in text for text in texts)

    def digits(text: str) -> int:
        return len(text.partition(".")[2] if has_point else text)

    return digits(fields[-1].replace(",", ".")) < min(map(digits, texts))


# -- units -----------------------------------------------------------------------------------------


def _seconds(rows: _Rows, unit: str) -> NDArray[np.float64]:
    """Time in s, to the precision of float64."""
    ticks = round(1.0 / TIME_UNITS[unit])
    seconds: NDArray[np.float64] = (
        rows.whole // ticks + (rows.whole % ticks + rows.fraction) / ticks
    )
    return seconds


def _time_unit(rows: _Rows, choice: _Choice, option: str | None) -> tuple[str, str]:
    """Unit of the time column, and the words on it."""
    if rows.iso:
        return "us", rows.iso
    if option is not None:
        return option, f"{option} as --position-time-unit says"
    named = choice.units.get(choice.time)
    if named is None or not len(rows.whole):
        return _guess_time_unit(rows)
    if abs(float(np.median(rows.whole))) * TIME_UNITS[named] < UNIX_END_S:
        return named, f"{named} from its name"
    unit, words = _guess_time_unit(rows)
    return unit, f"{words}; its name says {named}, which cannot be"


def _guess_time_unit(rows: _Rows) -> tuple[str, str]:
    """Unit of the time column from its values, and the words on it."""
    middle = float(np.median(rows.whole)) if len(rows.whole) else 0.0
    steps = np.diff(rows.whole) + np.diff(rows.fraction)
    steps = steps[steps > 0.0]
    step = float(np.median(steps)) if len(steps) else 0.0
    unix = [u for u, scale in TIME_UNITS.items() if UNIX_START_S <= middle * scale < UNIX_END_S]
    if unix and step * TIME_UNITS[unix[0]] <= MAX_UNIX_INTERVAL_S:
        return unix[0], f"{unix[0]} from its magnitude"
    fits = [
        u for u, scale in TIME_UNITS.items() if MIN_INTERVAL_S <= step * scale <= MAX_INTERVAL_S
    ]
    if not fits:
        return (*unix, "s")[0], (
            f"{(*unix, 's')[0]} assumed, as no unit gives the rate of a UWB: "
            "else give --position-time-unit"
        )
    words = f"{fits[0]} from its interval of {step * TIME_UNITS[fits[0]]:.3g} s"
    return fits[0], words + (
        f" ({fits[1]} would do as well: then give --position-time-unit)" if fits[1:] else ""
    )


def _length_units(
    values: Mapping[int, NDArray[np.float64]], choice: _Choice, option: str | None
) -> tuple[dict[int, str], str]:
    """Length unit of each column of numbers, and the words on those of position."""
    # outliers must not decide
    tracks = {index: np.percentile(values[index], [5.0, 95.0]) for index in choice.axes}
    spread = max(float(high - low) for low, high in tracks.values())
    named = [choice.units[index] for index in choice.axes if index in choice.units]
    if option is not None:
        unit, reason = option, "as --position-unit says"
    elif named:
        unit, reason = named[0], "from the names"
    elif spread <= MAX_SPREAD_M:
        unit, reason = "m", "no unit in the names"
    elif MIN_SPREAD_M <= spread * LENGTH_UNITS["mm"] <= MAX_SPREAD_M:
        unit, reason = "mm", f"as {spread:.0f} m is no indoor flight; if cm, give --position-unit"
    else:
        unit, reason = "m", "assumed, as no unit gives an indoor flight: else give --position-unit"
    units = {index: option or choice.units.get(index, unit) for index in values}
    used = ", ".join(dict.fromkeys(units[index] for index in choice.axes))
    spans = max(float(b - a) * LENGTH_UNITS[units[index]] for index, (a, b) in tracks.items())
    return units, f"{used} ({reason}), nine tenths of it within {spans:.3g} m"


def _samples(
    values: Mapping[int, NDArray[np.float64]], choice: _Choice, units: Mapping[int, str]
) -> tuple[pd.DataFrame, list[str]]:
    """Samples in m, and notes on what is doubtful in them."""
    rows = len(values[choice.position[0]])
    samples = pd.DataFrame(np.nan, index=range(rows), columns=SAMPLE_COLUMNS)
    for column, index in zip(SAMPLE_COLUMNS, (*choice.position, *choice.sigma), strict=False):
        if index is not None:
            samples[column] = values[index] * LENGTH_UNITS[units[index]]
    if choice.quality is not None:
        samples["quality"] = values[choice.quality]
    samples = samples.where(np.isfinite(samples))  # 1e999 reads as infinity
    notes = []
    sigma = samples[SIGMA_COLUMNS]
    if wrong := int((sigma <= 0.0).any(axis=1).sum()):
        samples[SIGMA_COLUMNS] = sigma.where(sigma > 0.0)
        notes.append(f"sigma is not above zero in {wrong} rows and was left out there")
    if all(units[i] == "m" and not np.any(values[i] % 1.0) for i in choice.axes):
        notes.append("all positions are whole metres: if they are mm or cm, give --position-unit")
    return samples, notes
