"""Tables (CSV) of learning platforms and users: reading, and writing with changed cells.

Encodings (UTF-8 with and without byte order mark, UTF-16, Windows-1252) and separators are
detected. A written table keeps the encoding and all cells that were not changed.
"""

import codecs
import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.errors import SettingsError
from px4fuse.reading import read_bytes_limited

MAX_BYTES = 20_000_000
SEPARATORS = ",;\t|"


@dataclass(frozen=True)
class Sheet:
    """Table with a header.

    Attributes
    ----------
    head : tuple of str
        Titles of the columns.
    rows : tuple of tuple of str
        Cells; each row has at least the length of ``head``.
    """

    path: Path
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    encoding: str = "utf-8"
    separator: str = ","

    def column(self, titles: Sequence[str]) -> int | None:
        """Return the index of the first of these titles that exists, or None."""
        plain_titles = [normalise_title(title) for title in self.head]
        return next((plain_titles.index(title) for title in titles if title in plain_titles), None)

    def cell(self, row: Sequence[str], titles: Sequence[str]) -> str:
        """Return the cell of a row under the first of these titles that exists; else ""."""
        column_index = self.column(titles)
        return "" if column_index is None else row[column_index].strip()

    @property
    def text(self) -> str:
        """Table as CSV (RFC 4180), with its original separator."""
        out = io.StringIO()
        csv.writer(out, delimiter=self.separator).writerows((self.head, *self.rows))
        return out.getvalue()

    def content(self) -> bytes:
        """Encode the table in its original encoding."""
        try:
            return self.text.encode(self.encoding)
        except UnicodeEncodeError:  # feedback may have characters outside of Windows-1252
            return self.text.encode("utf-8-sig")


def normalise_title(title: str) -> str:
    """Normalise a column title for comparison: lower-case letters and digits.

    >>> normalise_title("Last modified (grade)"), normalise_title("E-Mail-Adresse")
    ('lastmodifiedgrade', 'emailadresse')
    """
    return "".join(filter(str.isalnum, title.casefold()))


def read_sheet(path: Path) -> Sheet:
    """Read a table with a header.

    Raises
    ------
    SettingsError
        The file cannot be read, is not text, or has no header.
    """
    content = read_bytes_limited(
        path, SettingsError, MAX_BYTES, name=str(path), size_remedy="Give a CSV file of one class"
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path} is a spreadsheet, not a CSV file.", "Save it as CSV.")
    encoding = "utf-8-sig" if content.startswith(codecs.BOM_UTF8) else "utf-8"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:  # encoding of spreadsheets on Windows
        encoding = "cp1252"
        text = content.decode(encoding, errors="replace")
    if "\0" in text:
        raise SettingsError(f"{path} is not a text file.", "Give a CSV file with a header.")
    header = next((line for line in text.splitlines() if line.strip()), "")
    # quoted cells may contain separators
    separator = max(SEPARATORS, key=re.sub(r'"[^"]*"', "", header).count)
    try:
        lines = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)]
    except csv.Error as error:
        raise SettingsError(f"{path} is not a CSV file ({error}).") from error
    head, *rows = [cells for cells in lines if any(map(str.strip, cells))] or [[]]
    if not head:
        raise SettingsError(f"{path} is empty.", "Give a CSV file with a header.")
    padded_rows = (tuple(cells + [""] * (len(head) - len(cells))) for cells in rows)
    return Sheet(path, tuple(head), tuple(padded_rows), encoding, separator)


def number(value: float | None) -> str:
    """Format a number for spreadsheets; "" if it is absent or not finite.

    >>> number(7.0), number(0.1 + 0.2), number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"


def decimal(text: str) -> float | None:
    """Parse a number with decimal point or comma; None if the text is not a number.

    >>> decimal("12,5"), decimal("1_5"), decimal("nan")
    (12.5, None, None)
    """
    return float(text.replace(",", ".")) if re.fullmatch(r"[+-]?\d+([.,]\d*)?", text) else None
