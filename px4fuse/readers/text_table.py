"""What the readers of text tables share: text of bytes, numbers, and errors that name the line.

Position files, trajectories and pose graphs (g2o) are such tables.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from px4fuse.arrays import Array, BoolArray
from px4fuse.errors import TrajectoryError

# A UNIX clock that is set lies between 2000 and 2100
UNIX_START_S, UNIX_END_S = 946_684_800.0, 4_102_444_800.0
# A control character within these says that the file is binary; a NUL does anywhere
_SNIFFED_CHARS = 100_000
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")  # a Windows shell's redirection
_CONTROL = re.compile("[\x00-\x08\x0e-\x1b]")
_NUMBER = re.compile(
    r"[+-]?(?:(?:[0-9]+\.?|[0-9]*\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf)", re.IGNORECASE
)


def decode_text(content: bytes) -> str | None:
    """Text with line feeds between lines; None where the bytes are no text.

    UTF-8, UTF-16 with its mark, or else Latin-1, as in comments of old programs.
    """
    if content.startswith(_UTF_16):
        even_bytes = content[: len(content) // 2 * 2]
        text = even_bytes.decode("utf-16", errors="replace")
    else:
        content = content.rstrip(b"\0\x1a")  # what a power cut, or DOS, leaves at the end
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text or _CONTROL.search(text, 0, _SNIFFED_CHARS):
        return None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_number(text: str) -> bool:
    """Whether this is a number with a decimal point, NaN or infinite."""
    return _NUMBER.fullmatch(text) is not None


def quote(text: str) -> str:
    """Quote a text of the file, shortened."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def format_line_error(name: str, number: int, description: str, remedy: str) -> str:
    """Message on one line of a file.

    >>> format_line_error("uwb.csv", 7, "'x' is not a number", "Correct or remove that line.")
    "uwb.csv, line 7: 'x' is not a number. Correct or remove that line."
    """
    return f"{name}, line {number}: {description}. {remedy}"


@dataclass(frozen=True)
class Rows:
    """Rows of a table in a text file, of trajectories and pose graphs.

    Attributes
    ----------
    file : str
        Name of the file, for messages.
    lines : list of (int, str)
        Their numbers in the file, and what they say.
    """

    file: str
    lines: list[tuple[int, str]] = field(default_factory=list)

    def row_error(self, row: int, description: str, remedy: str) -> TrajectoryError:
        """Error that names the line of a row."""
        return TrajectoryError(
            format_line_error(self.file, self.lines[row][0], description, remedy)
        )

    def raise_where(self, bad: BoolArray, description: str, remedy: str) -> None:
        """Refuse the first row with something bad, shape (n,) or (n, k).

        Raises
        ------
        TrajectoryError
        """
        bad_places = np.argwhere(bad)
        if len(bad_places):
            raise self.row_error(int(bad_places[0, 0]), description, remedy)

    def parse(
        self, words: int, values: int, separator: str | None = None
    ) -> tuple[np.ndarray[Any, np.dtype[np.str_]], Array]:
        """Columns of words, and behind them columns of numbers; ``#`` begins a remark.

        Parameters
        ----------
        words, values : int
            How many columns there are of either.
        separator : str, optional
            White space by default.

        Returns
        -------
        words : ndarray of str, shape (n, words)
        values : ndarray, shape (n, values)

        Raises
        ------
        TrajectoryError
            Names the first row that has other columns.
        """
        texts = [text for _, text in self.lines]
        columns = [("words", "U80", (words,)), ("values", "f8", (values,))]
        try:
            table = np.loadtxt(texts, dtype=columns, delimiter=separator, ndmin=1)
        except ValueError as error:
            row_fields = (text.partition("#")[0].split(separator) for text in texts)
            is_valid = (
                len(fields) == words + values
                and all(is_number(field_text.strip()) for field_text in fields[words:])
                for fields in row_fields
            )
            row = next((row for row, good in enumerate(is_valid) if not good), 0)
            description = f"{quote(texts[row])} is not {words + values} columns of numbers"
            raise self.row_error(row, description, "Correct or remove that line.") from error
        return table["words"], np.ascontiguousarray(table["values"])
