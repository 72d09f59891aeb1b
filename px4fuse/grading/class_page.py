"""A class as one web page: a student per row, and on top what an instructor asks.

Nothing that a student wrote can act: see :mod:`px4fuse.webpage`. The redrawn PDFs stand in a
folder beside the page.
"""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from px4fuse.answers import form_rows
from px4fuse.assignment.sheet import number
from px4fuse.grading.model import TOTAL, Entry, Graded, Item, Override, columns
from px4fuse.plain import number_words
from px4fuse.webpage import frame
from px4fuse.webpage.frame import Cell, Column, Part, Row
from px4fuse.webpage.safe import local_link, template

BINS = 10
MISSING = "nothing handed in"
# How each status looks, and its sign, from the best to what says nothing
LOOKS: dict[str, tuple[str, str]] = {
    "verified": ("good", "✓"),
    "numbers differ": ("bad", "≠"),
    "other log": ("odd", "⇄"),
    "cannot verify": ("open", "?"),
    "page differs": ("odd", "≠"),
    MISSING: ("open", "–"),
}
STATUSES = tuple(LOOKS)
SHOWN = (*STATUSES, "pending", "to read", "flagged", "late", "said by you")


def html_text(entries: Sequence[Entry], title: str, made_with: str) -> str:
    """Lay out a class as one HTML file.

    Parameters
    ----------
    entries : sequence of Entry
        One per student.
    made_with : str
        Name and version of the program.

    Returns
    -------
    str
        Write it as UTF-8. The same for the same input: no dates of today.
    """
    items, numbers = columns(entries)
    counts = Counter(tag for entry in entries for tag in _tags(entry))
    tags = (*SHOWN, *sorted(tag for tag in counts if tag not in SHOWN))
    options = [(tag, f"{tag} ({counts[tag]})") for tag in tags if counts[tag]]
    return frame.page(
        title=title,
        subtitle=f"{len(entries)} {'student' if len(entries) == 1 else 'students'}, graded with "
        f"{made_with}",
        above=_above(entries, counts),
        noun=("student", "students"),
        columns=(
            Column("Student"),
            Column("Id", "line", narrow="tablet"),
            Column("Status", "rank"),
            Column("Points", "number"),
            Column("Handed in", "line", narrow="desk"),
            Column("Flags", "rank", narrow="desk"),
            *(Column(name, "number", "items") for name in items),
            *(Column(name, "number", "numbers") for name in numbers),
        ),
        rows=[_row(entry, items, numbers) for entry in entries],
        filters=[("Status", [("", f"Everyone ({len(entries)})"), *options])],
        groups=(("items", "Points of each item"), ("numbers", "Numbers")),
        placeholder="name, id, file, flag",
        otherwise="All rows are in class.csv.",
    )


def _above(entries: Sequence[Entry], counts: Mapping[str, int]) -> str:
    """What stands above the table: counts, the points of all, and those of each item."""
    totals = [entry.total for entry in entries if entry.total is not None]
    most = max((entry.of for entry in entries if entry.of > 0.0), default=1.0)
    graded = [one for entry in entries if (one := entry.counting)]
    return template("grading/above.html").render(
        students=len(entries),
        counts=counts,
        averages=(statistics.fmean(totals), statistics.median(totals)) if totals else (),
        totals=tenths(totals, most) if totals else (),
        most=(number(most), number_words(most)),
        pending=[one.points for one in graded if one.pending],
        number=number,
        items=list(_items(graded)),
    )


def _items(graded: Sequence[Graded]) -> Iterator[tuple[Any, ...]]:
    """Distribution of points per item, as they count: a row of the table each."""
    found: dict[str, list[Item]] = defaultdict(list)
    for one in graded:
        for item in () if one.pending else one.items:
            found[item.title].append(item)
    for title, items in found.items():
        shares = [item.points / item.of if item.of else 0.0 for item in items]
        mean, most = statistics.fmean(i.points for i in items), max(i.of for i in items)
        none, full = sum(share <= 0.0 for share in shares), sum(share >= 1.0 for share in shares)
        yield title, tenths(shares, 1.0), mean, number(most), none, full


def tenths(values: Sequence[float], most: float) -> list[tuple[int, str]]:
    """How many values lie in each tenth from 0 to ``most``, and where it begins, in words.

    >>> tenths([0.0, 5.0, 5.5, 9.0], 10.0)[5]
    (2, '5')
    """
    counts, edges = np.histogram(np.clip(values, 0.0, most), BINS, (0.0, most))
    words = (number_words(round(edge, 2)) for edge in edges.tolist())
    return list(zip(counts.tolist(), words, strict=False))


def _tags(entry: Entry) -> list[str]:
    one = entry.counting
    tags = [one.status if one else MISSING]
    tags += ["flagged"] * bool(entry.flags) + ["late"] * bool(entry.late_s)
    if one:
        tags += ["pending"] * bool(one.pending) + ["to read"] * one.waits
        tags += [f"missed: {mistake}" for mistake, named in one.mistakes.items() if not named]
    return tags + ["said by you"] * bool(entry.overrides or entry.comment)


def _row(entry: Entry, items: Sequence[str], numbers: Sequence[str]) -> Row:
    """One student."""
    one = entry.counting
    status = one.status if one else MISSING
    look, sign = LOOKS[status]
    count = len(entry.flags)
    few = f"{count} flag{'s' if count > 1 else ''}" if count else ""
    file = one.submission if one else ""
    late_s = entry.late_s or 0.0
    minutes = f"{math.ceil(late_s / 60.0)} min late" * bool(late_s)
    late = f"{late_s / 3600.0:.1f} h late" if late_s >= 3600.0 else minutes
    points = {item.title: item.points for item in one.items} if one else {}
    held = one.numbers if one else {}
    cells = (
        Cell(entry.called, entry.student or None, file),
        frame.words(entry.student_id),
        Cell(f"{sign} {status}", float(STATUSES.index(status)), few, look),
        _points(entry),
        frame.words(entry.handed_in, late),
        Cell("\n".join(entry.flags), float(count), "", "flags"),
        *(frame.figure(points.get(name)) for name in items),
        *(frame.figure(held.get(name)) for name in numbers),
    )
    # who has neither id nor file cannot be named in overrides.csv
    boxes = (_boxes(entry),) if entry.student_id or file else ()
    # the name of the file may name its student
    report = [("Drawn again from the log (PDF)", local_link(one.redrawn_name))] if one else []
    beside = (frame.links("The report", report),)
    return Row(cells, tuple(_tags(entry)), (*_details(entry), *boxes), beside)


def _details(entry: Entry) -> Iterator[Part]:
    """What a row unfolds to, as long as nobody is to be hidden."""
    one, comment = entry.counting, frame.prose("Your comment", entry.comment)
    if one is None:
        yield frame.listed("Missing", ["Nothing was handed in."])
        yield comment
        return
    verdict = one.verdict
    differ = [(each.path, each.recorded, each.recomputed) for each in verdict.differences]
    items = [(item.title, number(item.points), number(item.of), item.comment) for item in one.items]
    named = [f"{name}: {'' if found else 'not '}named" for name, found in one.mistakes.items()]
    attempts = [f"{other.submission}: {other.status}" for other in entry.others]
    yield frame.listed("Flags", entry.flags, warn=True)
    yield frame.listed("Pending: what you can do", [one.pending] if one.pending else [], warn=True)
    yield frame.listed("Verification", verdict.reasons)
    heads = ("Where", "Report", "New run") if differ else ()
    yield frame.tabled("The first numbers that differ", heads, differ)
    title = "Points (proposed)" if one.pending else "Points"
    yield frame.tabled(title, ("Item", "Points", "Of", "Comment") if items else (), items, (1, 2))
    yield comment
    yield frame.listed("Mistakes of this flight", named)
    yield frame.pairs("The form", [*form_rows(one.form)] if one.form else [])
    yield frame.prose("The student's own words", one.notes)
    yield frame.listed("Other attempts", attempts)


def _points(entry: Entry) -> Cell:
    one = entry.counting
    if entry.total is None:
        proposed = f"{number(one.points)} proposed" if one and one.counted is None else ""
        return Cell("pending" if proposed else "–", None, proposed)
    share = min(max(entry.total / entry.of, 0.0), 1.0) if entry.of > 0.0 else None
    said = [f"{number(entry.deduction)} off for being late"] * bool(entry.deduction)
    said += ["said by you"] * any(each.points is not None for each in entry.overrides.values())
    text = f"{number(entry.total)} / {number(entry.of)}"
    return Cell(text, entry.total, ", ".join(said), "", share)


def _boxes(entry: Entry) -> Part:
    """Points and a comment for what only the instructor scores, and for the whole.

    With all else that overrides.csv says, since the download takes its place.
    """
    one = entry.counting
    by_hand = {item.title: item.of for item in (one.items if one else ()) if item.by_hand}
    by_hand[TOTAL] = entry.of
    said = {title: entry.overrides.get(title, Override()) for title in by_hand}
    rows = [(title, by_hand[title], own.points, own.comment) for title, own in said.items()]
    kept = [
        (title, own.points, own.comment)
        for title, own in entry.overrides.items()
        if title not in by_hand
    ]
    owner = entry.student_id or (one.submission if one else "")
    return frame.boxes("Your points and words", owner, rows, kept)
