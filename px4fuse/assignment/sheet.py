"""Tables that a learning platform or a person wrote, read so that they can be written as they were.

Spreadsheets and platforms differ in encoding (UTF-8 with and without a byte order mark, UTF-16,
Windows-1252), separator and quotes. What is filled in and given back has to be what the platform
gave, but for the cells that are filled.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.errors import SettingsError
from px4fuse.reading import read_whole

MAX_BYTES = 20_000_000
SEPARATORS = ",;\t|"
_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"),
          (codecs.BOM_UTF16_BE, "utf-16-be"))  # fmt: skip


@dataclass(frozen=True)
class Sheet:
    """A table with a header.

    Attributes
    ----------
    head : tuple of str
        Titles of the columns.
    rows : tuple of tuple of str
        Each as long as ``head``, or longer.
    numbers : tuple of int
        Line of each row in the file, for messages.
    mark : bytes
        Byte order mark; empty without.
    quoted : bool
        Whether every cell stands in quotes.
    """

    path: Path
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: tuple[int, ...] = ()
    mark: bytes = b""
    encoding: str = "utf-8"
    separator: str = ","
    line_end: str = "\r\n"
    quoted: bool = False

    def column(self, titles: Sequence[str]) -> int | None:
        """Place of the first of these titles that is there, letters and digits compared."""
        plain = [bare(title) for title in self.head]
        return next((plain.index(title) for title in titles if title in plain), None)

    def cell(self, row: Sequence[str], titles: Sequence[str]) -> str:
        """What stands in a row under the first of these titles; "" where there is none."""
        place = self.column(titles)
        return "" if place is None else row[place].strip()

    @property
    def text(self) -> str:
        """The table with its own separator, quotes and line ends."""
        out = io.StringIO()
        writer = csv.writer(
            out,
            delimiter=self.separator,
            lineterminator=self.line_end,
            quoting=csv.QUOTE_ALL if self.quoted else csv.QUOTE_MINIMAL,
        )
        writer.writerows((self.head, *self.rows))
        return out.getvalue()

    def content(self) -> bytes:
        """The file again, in its own encoding."""
        try:
            return self.mark + self.text.encode(self.encoding)
        except UnicodeEncodeError:  # feedback holds more signs than a Windows code page
            return codecs.BOM_UTF8 + self.text.encode()


def bare(title: str) -> str:
    """A column title for comparison.

    >>> bare("SIS User ID"), bare("Last modified (grade)"), bare("E-Mail-Adresse")
    ('sisuserid', 'lastmodifiedgrade', 'emailadresse')
    """
    return "".join(filter(str.isalnum, title.casefold()))


def read_sheet(path: Path) -> Sheet:
    """Read a table with a header.

    Raises
    ------
    SettingsError
        It cannot be read, is not text, or has no header.
    """
    content = read_whole(
        path, SettingsError, MAX_BYTES, name=str(path), smaller="Give a CSV file of one class"
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path}: a spreadsheet", "Save it as CSV.")
    mark, encoding = next(
        ((mark, name) for mark, name in _MARKS if content.startswith(mark)), (b"", "utf-8")
    )
    try:
        text = content.removeprefix(mark).decode(encoding)
    except UnicodeDecodeError:  # as spreadsheets on Windows save it
        encoding = "cp1252"
        text = content.decode(encoding, errors="replace")
    if "\0" in text:
        raise SettingsError(f"{path}: not text", "Give a CSV file with a header.")
    header = next((line for line in text.splitlines() if line.strip()), "")
    # quoted cells may hold any of them
    separator = max(SEPARATORS, key=re.sub(r'"[^"]*"', "", header).count)
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        lines = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise SettingsError(f"{path}: not a CSV file ({error}).") from error
    lines = [(number, cells) for number, cells in lines if any(map(str.strip, cells))]
    if not lines:
        raise SettingsError(f"{path}: empty", "Give a CSV file with a header.")
    (_, head), *rows = lines
    return Sheet(
        path,
        tuple(head),
        tuple((*cells, *[""] * (len(head) - len(cells))) for _, cells in rows),
        tuple(number for number, _ in rows),
        mark,
        encoding,
        separator,
        "\r\n" if "\r\n" in text else "\n",
        quoted=header.startswith('"') and header.count('"') >= 2 * len(head),
    )
