"""A class as a table for spreadsheets, in which nothing that a student wrote can act."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import replace

from px4fuse.grading.model import Entry, Graded, Override
from px4fuse.grading.names import distinct
from px4fuse.spreadsheet import neutral, neutral_id

FIRST = ("file", "student", "id", "status", "points", "pending points", "of", "deducted", "total")
LAST = (
    "handed in", "hours late", "pending", "comment", "remarks", "flags", "other files", "reasons",
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
    settled = [settled_report(entry) for entry in entries]
    items = tuple(dict.fromkeys(title for one in settled if one for title in item_points(one)))
    numbers = tuple(dict.fromkeys(title for one in settled if one for title in one.numbers))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(neutral(title) for title in (*FIRST, *items, *numbers, *LAST))
    for entry, one in zip(entries, settled, strict=True):
        points = item_points(one) if one else {}
        row: list[str | float | None] = [
            one.submission if one else "", entry.student, None, one.status if one else "missing",
            one.counted if one else None, one.points if one and one.counted is None else None,
            entry.of, entry.deduction or None, entry.total,
            *(points.get(title) for title in items),
            *((one.numbers if one else {}).get(title) for title in numbers),
            entry.handed_in, None if entry.late_s is None else entry.late_s / 3600.0,
            one.pending if one else "", entry.comment, BETWEEN.join(entry.remarks),
            BETWEEN.join(one.flags) if one else "",
            BETWEEN.join(other.submission for other in entry.others),
            BETWEEN.join(one.verdict.reasons) if one else "", one.log_sha256 if one else "",
        ]  # fmt: skip
        cells = [neutral(part) if isinstance(part, str) else number(part) for part in row]
        cells[FIRST.index("id")] = neutral_id(entry.student_id)
        writer.writerow(cells)
    return "\ufeff" + out.getvalue()


def settled_report(entry: Entry) -> Graded | None:
    """The report that counts, with the instructor's points and comments on its items."""
    graded = entry.counting
    if graded is None or not entry.overrides:
        return graded
    items = []
    for title, item in zip(item_points(graded), graded.items, strict=True):
        said = entry.overrides.get(title, Override())
        points = item.points if said.points is None else said.points
        comment = (
            f"{item.comment} Your instructor: {said.comment}" if said.comment else item.comment
        )
        if said.points is not None and said.points != item.points:
            comment = f"{comment} (Your instructor gave {number(points)} points.)"
        waits = item.waits and said.points is None
        items.append(replace(item, points=points, comment=comment, waits=waits))
    return replace(graded, items=tuple(items))


def item_points(one: Graded) -> dict[str, float]:
    """Points by the title of the rubric's item; titles that come twice are numbered."""
    titles = distinct(item.title for item in one.items)
    return dict(zip(titles, (item.points for item in one.items), strict=True))


def number(value: float | None) -> str:
    """A number as spreadsheets read it; nothing for what is absent or not finite.

    >>> number(7.0), number(0.1 + 0.2), number(float("nan"))
    ('7', '0.3', '')
    """
    return "" if value is None or not math.isfinite(value) else f"{value:.10g}"
