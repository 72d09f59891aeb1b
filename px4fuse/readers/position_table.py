"""Where the table is in a text: separator, decimal mark, header, first row."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from px4fuse.errors import LogError
from px4fuse.readers.position_names import find_position, meaning
from px4fuse.readers.text_table import NUMBER, quote, text_of

COLUMNS = "`columns` TIME,X,Y,Z"

# The layout is decided from the first lines, up to both of these
HEAD_LINES = 1000
HEAD_CHARS = 200_000
MIN_COLUMNS = 3  # time, x, y
MAX_NAMES = 12  # of columns in one sentence

# In the order in which one is taken where several fit
_SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}
_COMMENTS = ("#", "%")
ISO_TIME = re.compile(r"[0-9]{4}[-/][0-9]{2}[-/][0-9]{2}[T ][0-9]{2}:[0-9]{2}.*")
MISSING = ["", "-", "--", "inf", "+inf", "-inf", "Inf", "-Inf", "INF", "infinity", "-infinity"]
MISSING += ["nan", "NaN", "NAN", "+nan", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "NA", "N/A"]
MISSING += ["n/a", "null", "Null", "NULL", "none", "None", "nil"]


def plain_text(name: str, content: bytes) -> str:
    """Text with line feeds between lines, without quotes and blanks around fields."""
    text = text_of(content)
    if text is None:
        raise LogError(
            f"{name}: a binary file, not a text table. Give the CSV file of the UWB system; a "
            "flight log is read without `position`."
        )
    if '"' in text:  # within quotes, as in "1,5", there are no separators
        quoted = re.compile(r'(?<![^,;\t\n ])"([^"\n]*)"(?![^,;\t\n ])')
        text = quoted.sub(lambda field: re.sub("[,;\t]", ".", field[1]), text)
    return re.sub("(?<! ) +([,;\t\n])", r"\1", text) if " " in text else text


@dataclass(frozen=True)
class Table:
    """Layout of the text."""

    file: str
    separator: str
    names: list[str]  # from the header; empty where there is none
    head: list[list[str]]  # fields of the first rows
    body: str  # all lines after the header; only the last may lack its line feed
    first_line: int  # number of the body's first line
    detected: str

    def label(self, index: int) -> str:
        """Name of a column for a person."""
        if index < len(self.names) and self.names[index]:
            return quote(self.names[index])
        return f"column {index + 1}"

    def labels(self, columns: Iterable[int | None]) -> str:
        """Names of the first columns of some, each once."""
        some = dict.fromkeys(self.label(index) for index in columns if index is not None)
        return ", ".join(list(some)[:MAX_NAMES]) + (", ..." if len(some) > MAX_NAMES else "")

    def not_found(self, what: str) -> str:
        """Say that a column is not there, and which are."""
        names = self.labels(range(len(self.names))) or "unnamed"
        return f"{self.file}: no {what} found (the columns are {names}). Name them with {COLUMNS}."

    def column(self, index: int) -> list[str]:
        """Texts of one column in the first rows, without those for missing values."""
        texts = (row[index] for row in self.head if index < len(row))
        return [text for text in texts if text not in MISSING]

    def is_numeric(self, index: int) -> bool:
        """Whether a column holds numbers and no text in the first rows."""
        texts = self.column(index)
        return bool(texts) and all(map(NUMBER.fullmatch, texts))

    def width(self) -> int:
        """Usual number of columns of the first rows, without empty ones at their end."""
        widths = [max((i for i, f in enumerate(row, 1) if f), default=0) for row in self.head]
        return int(np.median(widths)) if widths else 0


def split(line: str, separator: str) -> list[str]:
    """Fields of one line."""
    if separator == " ":  # "x [mm]" is one name
        return " ".join(line.split()).replace(" [", "[").replace(" (", "(").split(" ")
    return [field.strip() for field in line.split(separator)]


def _is_value(text: str) -> bool:
    """Whether this is a number or a time."""
    return bool(NUMBER.fullmatch(text) or ISO_TIME.fullmatch(text))


def _is_row(fields: list[str]) -> bool:
    """Whether these are values and words for missing ones, enough for a position."""
    values = sum(map(_is_value, fields))
    return values > 0 and values + sum(bool(f) and f in MISSING for f in fields) >= MIN_COLUMNS


def find_table(file: str, text: str, columns: tuple[str, ...] | None) -> Table:
    """Find separator, header and first row."""
    # without the last line, which may be cut
    lines = text[: text.rfind("\n", 0, HEAD_CHARS) + 1].split("\n")[:-1][:HEAD_LINES]
    # how many values stand in rows of two or more, when split this way
    values = {
        mark: [sum(map(_is_value, split(line, mark))) for line in lines] for mark in _SEPARATORS
    }
    scores = {mark: sum(n for n in counts if n > 1) for mark, counts in values.items()}
    separator = max(scores, key=scores.__getitem__)
    if not scores[separator]:
        raise LogError(
            f"{file}: no row of numbers in its first {len(lines)} lines, so this is not a table "
            "of positions. Give a CSV file with the columns time, x, y, z."
        )
    fields = [field for line in lines for field in split(line, separator)]
    has_comma = any("," in field and NUMBER.fullmatch(field) for field in fields)
    if has_comma:
        text = text.replace(",", ".")
        lines = [line.replace(",", ".") for line in lines]
    start, names = _find_header(lines, separator, columns)
    body = text.split("\n", start)[start]
    if "#" in body or "%" in body:
        body = re.sub(r"(?m)^[ \t]*[#%].*", "", body)
    words = f"header in line {start}" if names else "no header"
    skipped = [
        line for line in lines[: start - bool(names)] if line and line.lstrip()[:1] not in _COMMENTS
    ]
    if skipped:
        words += f", {len(skipped)} line{'s'[: len(skipped) > 1]} before the table skipped"
    decimal = "comma" if has_comma else "point"
    rows = (line for line in lines[start:] if line.strip(f" {separator}"))
    head = [split(line, separator) for line in rows if line.lstrip()[:1] not in _COMMENTS]
    words = f"table: {_SEPARATORS[separator]} between columns, decimal {decimal}, {words}"
    table = Table(file, separator, names, head, body, start + 1, words)
    by_number = columns is not None and all(column.isdecimal() for column in columns)
    if names and table.width() > len(names) and not by_number:
        is_double = separator == "," and table.width() == 2 * len(names)
        raise LogError(
            f"{file}: the header names {len(names)} columns, but rows have {table.width()}"
            f"{', as with a decimal comma between commas' if is_double else ''}. Export it with "
            f"semicolons, or give the columns' numbers with {COLUMNS}."
        )
    return table


def _find_header(
    lines: list[str], separator: str, columns: tuple[str, ...] | None
) -> tuple[int, list[str]]:
    """How many lines stand before the first row, and the names (none without a header)."""
    wanted = {column.strip().casefold() for column in columns or () if not column.isdecimal()}

    def is_header(names: list[str]) -> bool:
        if wanted or _is_row(names):
            return bool(wanted) and wanted <= {name.casefold() for name in names}
        meanings = [meaning(name) for name in names]
        has_time = any(column.kind == "time" for column in meanings)
        return has_time and find_position(meanings) is not None

    for at in sorted(range(len(lines)), key=lambda at: lines[at].lstrip()[:1] in _COMMENTS):
        line = lines[at].strip("#% ")
        candidates = [split(line, separator)]
        if (
            lines[at].lstrip()[:1] in _COMMENTS
        ):  # numpy.savetxt separates header and rows differently
            candidates.append(re.split(r"[,;\s]+", line))
        for names in candidates:
            if is_header(names):
                return at + 1, names
    before: list[str] = []
    for at, line in enumerate(lines):
        fields = split(line, separator)
        if _is_row(fields):
            # a line of as many words is a header whose names are unknown
            words = [field for field in before if field and not _is_value(field)]
            return at, before if len(words) > 1 and len(before) >= len(fields) - 1 else []
        if line and line.lstrip()[:1] not in _COMMENTS:
            before = fields
    return 0, []
