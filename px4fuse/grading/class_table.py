"""A class as a table for spreadsheets, in which nothing that a student wrote comes to life."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence

from px4fuse.grading.model import Graded
from px4fuse.spreadsheet import neutral

FIRST = ("file", "student", "id", "status", "points", "of")
LAST = ("flags", "reasons", "log SHA-256")
BETWEEN = " | "


def csv_text(graded: Sequence[Graded]) -> str:
    """Lay out a class as CSV, for Excel and LibreOffice.

    Parameters
    ----------
    graded : sequence of Graded

    Returns
    -------
    str
        Begins with the byte order mark by which Excel knows UTF-8; lines end with CRLF. Write it
        without translating line ends.
    """
    items = tuple(dict.fromkeys(title for one in graded for title in item_points(one)))
    numbers = tuple(dict.fromkeys(title for one in graded for title in one.numbers))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(neutral(title) for title in (*FIRST, *items, *numbers, *LAST))
    for one in graded:
        points = item_points(one)
        row: list[str | float | None] = [
            one.submission, one.student, one.student_id, one.status, one.points, one.of,
            *(points.get(title) for title in items),
            *(one.numbers.get(title) for title in numbers),
            BETWEEN.join(one.flags), BETWEEN.join(one.verdict.reasons), one.log_sha256,
        ]  # fmt: skip
        writer.writerow(neutral(part) if isinstance(part, str) else number(part) for part in row)
    return "\ufeff" + out.getvalue()


def item_points(one: Graded) -> dict[str, float]:
    """Points by the title of the rubric's item; titles that come twice are numbered."""
    points: dict[str, float] = {}
    for title, item in zip(distinct(item.title for item in one.items), one.items, strict=True):
        points[title] = item.points
    return points


def distinct(titles: Iterable[str]) -> list[str]:
    """Titles with a number behind those that came before.

    >>> distinct(["notes", "cover", "notes"])
    ['notes', 'cover', 'notes (2)']
    """
    seen: list[str] = []
    for title in titles:
        name, count = title, 1
        while name in seen:
            count += 1
            name = f"{title} ({count})"
        seen.append(name)
    return seen


def number(value: float | None) -> str:
    """A number as spreadsheets read it; nothing for what is absent or not finite.

    >>> number(7.0), number(0.1 + 0.2), number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"
