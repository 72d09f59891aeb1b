"""A class as a table for spreadsheets, in which nothing that a student wrote can act."""

import math
import re
from collections.abc import Sequence
from pathlib import Path

from px4fuse.assignment.sheet import Sheet
from px4fuse.grading.model import Entry, columns
from px4fuse.spreadsheet import neutral, neutral_id

FIRST = ("file", "student", "id", "status", "points", "pending points", "of", "deducted", "total")
LAST = (
    "handed in", "hours late", "pending", "comment", "flags", "other files", "reasons",
    "log SHA-256",
)  # fmt: skip
BETWEEN = " | "


def csv_text(entries: Sequence[Entry]) -> str:
    """Lay out a class as CSV, for Excel and LibreOffice.

    Points of the items are those that count, the instructor's where there are some.

    Returns
    -------
    str
        Begins with the byte order mark by which Excel knows UTF-8; lines end with CRLF. Write it
        without translating line ends.
    """
    items, numbers = columns(entries)
    head = tuple(map(neutral, (*FIRST, *items, *numbers, *LAST)))
    rows = []
    for entry in entries:
        one = entry.counting
        points = {item.title: item.points for item in one.items} if one else {}
        row: list[str | float | None] = [
            one.submission if one else "", entry.student, None, one.status if one else "missing",
            one.counted if one else None, one.points if one and one.counted is None else None,
            entry.of, entry.deduction or None, entry.total,
            *map(points.get, items),
            *(one.numbers.get(title) if one else None for title in numbers),
            entry.handed_in, None if entry.late_s is None else entry.late_s / 3600.0,
            one.pending if one else "", entry.comment, BETWEEN.join(entry.flags),
            BETWEEN.join(other.submission for other in entry.others),
            BETWEEN.join(one.verdict.reasons) if one else "", one.log_sha256 if one else "",
        ]  # fmt: skip
        cells = [neutral(part) if isinstance(part, str) else number(part) for part in row]
        cells[FIRST.index("id")] = neutral_id(entry.student_id)
        rows.append(tuple(cells))
    return "\ufeff" + Sheet(Path(), head, tuple(rows)).text


def number(value: float | None) -> str:
    """A number as spreadsheets read it; nothing for what is absent or not finite.

    >>> number(7.0), number(0.1 + 0.2), number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"


def decimal(text: str) -> float | None:
    """A number as people type it in tables, also with a comma; None for anything else.

    >>> decimal("12,5"), decimal("1_5"), decimal("nan")
    (12.5, None, None)
    """
    return float(text.replace(",", ".")) if re.fullmatch(r"[+-]?\d+([.,]\d*)?", text) else None
