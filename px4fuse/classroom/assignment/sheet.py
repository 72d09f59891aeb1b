"""Reading and writing of CSV tables of learning platforms and instructors.

The reader detects the encoding (UTF-8, UTF-16, Windows-1252) and the separator.
"""

import codecs
import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.core.reading import read_bytes_limited
from px4fuse.errors import SettingsError

MAX_TABLE_BYTES = 20_000_000
COLUMN_SEPARATORS = ",;\t|"


@dataclass(frozen=True)
class Sheet:
    """CSV table with a header (column titles)."""

    path: Path
    column_titles: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    encoding: str = "utf-8"
    separator: str = ","

    def find_column_index(self, titles: Sequence[str]) -> int | None:
        """Return the index of the column with the first matching title of ``titles``, or None."""
        plain_titles = [normalise_title(title) for title in self.column_titles]
        return next((plain_titles.index(title) for title in titles if title in plain_titles), None)

    def find_cell(self, row: Sequence[str], titles: Sequence[str]) -> str:
        """Return the cell in the column with the first matching title of ``titles``, or ""."""
        column_index = self.find_column_index(titles)
        return "" if column_index is None else row[column_index].strip()

    @property
    def text(self) -> str:
        """Table as CSV (RFC 4180), with the original separator."""
        csv_file = io.StringIO()
        csv.writer(csv_file, delimiter=self.separator).writerows((self.column_titles, *self.rows))
        return csv_file.getvalue()

    def content(self) -> bytes:
        try:
            return self.text.encode(self.encoding)
        except UnicodeEncodeError:  # Windows-1252 lacks some characters of the feedback
            return self.text.encode("utf-8-sig")


def normalise_title(title: str) -> str:
    """Normalise a column title for comparison: lower-case letters and digits.

    >>> normalise_title("Last modified (grade)"), normalise_title("E-Mail-Adresse")
    ('lastmodifiedgrade', 'emailadresse')
    """
    return "".join(filter(str.isalnum, title.casefold()))


def read_sheet(path: Path) -> Sheet:
    """Read a CSV table with a header.

    Raises
    ------
    SettingsError
        The file cannot be read, is not text, or has no header.
    """
    content = read_bytes_limited(
        path,
        SettingsError,
        MAX_TABLE_BYTES,
        name=str(path),
        remedy_if_too_large="Give a CSV table with the students of one class only.",
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path} is a spreadsheet, not a CSV file.", "Save the table as CSV.")
    encoding = "utf-8-sig" if content.startswith(codecs.BOM_UTF8) else "utf-8"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:  # spreadsheet programs on Windows write Windows-1252
        encoding = "cp1252"
        text = content.decode(encoding, errors="replace")
    if "\0" in text:
        raise SettingsError(f"{path} is not a text file.", "Give a CSV file with a header.")
    header = next((line for line in text.splitlines() if line.strip()), "")
    # do not count separators in quoted column titles
    separator = max(COLUMN_SEPARATORS, key=re.sub(r'"[^"]*"', "", header).count)
    try:
        lines = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)]
    except csv.Error as error:
        raise SettingsError(f"{path} is not a CSV file ({error}).") from error
    column_titles, *rows = [cells for cells in lines if any(map(str.strip, cells))] or [[]]
    if not column_titles:
        raise SettingsError(f"{path} is empty.", "Give a CSV file with a header.")
    padded_rows = (tuple(cells + [""] * (len(column_titles) - len(cells))) for cells in rows)
    return Sheet(path, tuple(column_titles), tuple(padded_rows), encoding, separator)


def format_cell_number(value: float | None) -> str:
    """Format a number for a table cell; "" for None, infinity and NaN.

    >>> format_cell_number(7.0), format_cell_number(0.1 + 0.2), format_cell_number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"


def parse_decimal(text: str) -> float | None:
    """Parse a number with decimal point or comma; None if the text is not a number.

    >>> parse_decimal("12,5"), parse_decimal("1_5"), parse_decimal("nan")
    (12.5, None, None)
    """
    return float(text.replace(",", ".")) if re.fullmatch(r"[+-]?\d+([.,]\d*)?", text) else None
