"""Class page: one web page with a row per student, and statistics of the class above.

Texts of students cannot act as HTML or scripts: see :mod:`px4fuse.webpage`. The redrawn PDFs are in
a folder beside the page.
"""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from px4fuse.answer_form import form_rows
from px4fuse.assignment.sheet import number
from px4fuse.grading.model import TOTAL, Entry, GradedReport, Item, Override, columns
from px4fuse.text import format_number
from px4fuse.webpage import frame
from px4fuse.webpage.frame import Cell, Column, Row, Section
from px4fuse.webpage.safe import load_template, local_link

BINS = 10
MISSING = "no submission"
# style and symbol of each status, from best to undecided
STATUS_STYLES: dict[str, tuple[str, str]] = {
    "verified": ("good", "✓"),
    "numbers differ": ("bad", "≠"),
    "other log": ("odd", "⇄"),
    "cannot verify": ("open", "?"),
    "page differs": ("odd", "≠"),
    MISSING: ("open", "–"),
}
STATUSES = tuple(STATUS_STYLES)
FILTER_TAGS = (*STATUSES, "pending", "to read", "flagged", "late", "set by instructor")


def html_text(entries: Sequence[Entry], title: str, made_with: str) -> str:
    """Format a class as one HTML file.

    Parameters
    ----------
    entries : sequence of Entry
        One per student.
    made_with : str
        Name and version of the program.

    Returns
    -------
    str
        HTML, to be written as UTF-8; equal for equal input (no current date).
    """
    items, numbers = columns(entries)
    counts = Counter(tag for entry in entries for tag in _tags(entry))
    tags = (*FILTER_TAGS, *sorted(tag for tag in counts if tag not in FILTER_TAGS))
    options = [(tag, f"{tag} ({counts[tag]})") for tag in tags if counts[tag]]
    return frame.page(
        title=title,
        subtitle=f"{len(entries)} {'student' if len(entries) == 1 else 'students'}, graded with "
        f"{made_with}",
        html_above=_above_html(entries, counts),
        noun=("student", "students"),
        columns=(
            Column("Student"),
            Column("Id", "line", visible_from="tablet"),
            Column("Status", "rank"),
            Column("Points", "number"),
            Column("Handed in", "line", visible_from="desk"),
            Column("Flags", "rank", visible_from="desk"),
            *(Column(name, "number", "items") for name in items),
            *(Column(name, "number", "numbers") for name in numbers),
        ),
        rows=[_row(entry, items, numbers) for entry in entries],
        filters=[("Status", [("", f"Everyone ({len(entries)})"), *options])],
        groups=(("items", "Points of each item"), ("numbers", "Numbers")),
        placeholder="name, id, file, flag",
        full_table_note="All rows are in class.csv.",
    )


def _above_html(entries: Sequence[Entry], counts: Mapping[str, int]) -> str:
    """Format the part above the table: counts, points of the class and of each item."""
    totals = [entry.total for entry in entries if entry.total is not None]
    most = max((entry.of for entry in entries if entry.of > 0.0), default=1.0)
    graded = [one for entry in entries if (one := entry.counting)]
    return load_template("grading/above.html").render(
        students=len(entries),
        counts=counts,
        averages=(statistics.fmean(totals), statistics.median(totals)) if totals else (),
        totals=tenths(totals, most) if totals else (),
        most=(number(most), format_number(most)),
        pending=[one.points for one in graded if one.pending],
        number=number,
        items=list(_items(graded)),
    )


def _items(graded: Sequence[GradedReport]) -> Iterator[tuple[Any, ...]]:
    """Yield title and distribution of the points of each item."""
    items_by_title: dict[str, list[Item]] = defaultdict(list)
    for one in graded:
        for item in () if one.pending else one.items:
            items_by_title[item.title].append(item)
    for title, items in items_by_title.items():
        shares = [item.points / item.of if item.of else 0.0 for item in items]
        mean, max_points = statistics.fmean(i.points for i in items), max(i.of for i in items)
        none, full = sum(share <= 0.0 for share in shares), sum(share >= 1.0 for share in shares)
        yield title, tenths(shares, 1.0), mean, number(max_points), none, full


def tenths(values: Sequence[float], most: float) -> list[tuple[int, str]]:
    """Count the values in each tenth from 0 to ``most``; return counts and lower edges.

    >>> tenths([0.0, 5.0, 5.5, 9.0], 10.0)[5]
    (2, '5')
    """
    counts, edges = np.histogram(np.clip(values, 0.0, most), BINS, (0.0, most))
    lower_edges = (format_number(round(edge, 2)) for edge in edges.tolist())
    return list(zip(counts.tolist(), lower_edges, strict=False))


def _tags(entry: Entry) -> list[str]:
    one = entry.counting
    tags = [one.status if one else MISSING]
    tags += ["flagged"] * bool(entry.flags) + ["late"] * bool(entry.late_s)
    if one:
        tags += ["pending"] * bool(one.pending) + ["to read"] * one.awaits_points
        tags += [f"missed: {mistake}" for mistake, is_named in one.mistakes.items() if not is_named]
    return tags + ["set by instructor"] * bool(entry.overrides or entry.comment)


def _row(entry: Entry, items: Sequence[str], numbers: Sequence[str]) -> Row:
    one = entry.counting
    status = one.status if one else MISSING
    style, sign = STATUS_STYLES[status]
    count = len(entry.flags)
    flag_count_text = f"{count} flag{'s' if count > 1 else ''}" if count else ""
    file = one.submission if one else ""
    late_s = entry.late_s or 0.0
    minutes = f"{math.ceil(late_s / 60.0)} min late" * bool(late_s)
    late = f"{late_s / 3600.0:.1f} h late" if late_s >= 3600.0 else minutes
    points = {item.title: item.points for item in one.items} if one else {}
    number_values = one.numbers if one else {}
    cells = (
        Cell(entry.display_name, entry.student or None, file),
        frame.text_cell(entry.student_id),
        Cell(f"{sign} {status}", float(STATUSES.index(status)), flag_count_text, style),
        _points_cell(entry),
        frame.text_cell(entry.handed_in, late),
        Cell("\n".join(entry.flags), float(count), "", "flags"),
        *(frame.number_cell(points.get(name)) for name in items),
        *(frame.number_cell(number_values.get(name)) for name in numbers),
    )
    # overrides.csv identifies students by id or file
    box_parts = (_point_boxes(entry),) if entry.student_id or file else ()
    # not for pseudonyms: the file name may contain the student's name
    report = [("Redrawn from the log (PDF)", local_link(one.redrawn_name))] if one else []
    report_parts = (frame.links_section("Report", report),)
    return Row(cells, tuple(_tags(entry)), (*_details(entry), *box_parts), report_parts)


def _details(entry: Entry) -> Iterator[Section]:
    """Yield the unfolded details of a row; without names for pseudonyms."""
    one, comment = entry.counting, frame.prose_section("Your comment", entry.comment)
    if one is None:
        yield frame.list_section("Missing", ["No submission."])
        yield comment
        return
    verdict = one.verdict
    differ = [(each.path, each.recorded, each.recomputed) for each in verdict.differences]
    items = [(item.title, number(item.points), number(item.of), item.comment) for item in one.items]
    named_texts = [
        f"{name}: {'' if is_named else 'not '}named" for name, is_named in one.mistakes.items()
    ]
    attempts = [f"{other.submission}: {other.status}" for other in entry.others]
    yield frame.list_section("Flags", entry.flags, is_warning=True)
    yield frame.list_section(
        "Pending: action required", [one.pending] if one.pending else [], is_warning=True
    )
    yield frame.list_section("Verification", verdict.reasons)
    heads = ("Value", "Report", "New run") if differ else ()
    yield frame.table_section("First differing numbers", heads, differ)
    title = "Points (proposed)" if one.pending else "Points"
    yield frame.table_section(
        title, ("Item", "Points", "Of", "Comment") if items else (), items, (1, 2)
    )
    yield comment
    yield frame.list_section("Mistakes of this flight", named_texts)
    yield frame.pairs_section("Answer form", [*form_rows(one.form)] if one.form else [])
    yield frame.prose_section("Text of the student", one.notes)
    yield frame.list_section("Other attempts", attempts)


def _points_cell(entry: Entry) -> Cell:
    one = entry.counting
    if entry.total is None:
        proposed = f"{number(one.points)} proposed" if one and one.counted is None else ""
        return Cell("pending" if proposed else "–", None, proposed)
    share = min(max(entry.total / entry.of, 0.0), 1.0) if entry.of > 0.0 else None
    notes = [f"{number(entry.deduction)} deducted (late)"] * bool(entry.deduction)
    notes += ["set by instructor"] * any(
        each.points is not None for each in entry.overrides.values()
    )
    text = f"{number(entry.total)} / {number(entry.of)}"
    return Cell(text, entry.total, ", ".join(notes), "", share)


def _point_boxes(entry: Entry) -> Section:
    """Input boxes for the items that the instructor scores, and for the total.

    Other rows of overrides.csv are included, because the download replaces the file.
    """
    one = entry.counting
    by_hand = {item.title: item.of for item in (one.items if one else ()) if item.by_hand}
    by_hand[TOTAL] = entry.of
    own_overrides = {title: entry.overrides.get(title, Override()) for title in by_hand}
    rows = [
        (title, by_hand[title], own.points, own.comment) for title, own in own_overrides.items()
    ]
    other_rows = [
        (title, own.points, own.comment)
        for title, own in entry.overrides.items()
        if title not in by_hand
    ]
    owner = entry.student_id or (one.submission if one else "")
    return frame.boxes_section("Your points and comments", owner, rows, other_rows)
