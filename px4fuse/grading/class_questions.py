"""What stands above the table of a class: how many there are, and their points by item."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Sequence

from px4fuse.grading.anonymous import Veil
from px4fuse.grading.class_table import number
from px4fuse.grading.model import Entry, Item
from px4fuse.webpage.charts import bins, histogram
from px4fuse.webpage.frame import card, note, summary
from px4fuse.webpage.safe import escaped


def above(entries: Sequence[Entry], veil: Veil) -> str:
    """HTML of all that stands above the table."""
    shown = _items(entries, veil)
    return _summary(entries) + (f'<div class="cards">{shown}</div>' if shown else "")


def _summary(entries: Sequence[Entry]) -> str:
    totals = [entry.total for entry in entries if entry.total is not None]
    graded = [one for entry in entries if (one := entry.counting)]
    most = {entry.of for entry in entries if entry.of > 0.0}
    of = f" <small>of {number(max(most))}</small>" if len(most) == 1 else ""
    counts = {
        "Students": len(entries),
        "Missing": len(entries) - len(graded),
        "Verified": sum(one.status == "verified" for one in graded),
        "Flagged": sum(bool(one.flags) for one in graded),
        "Late": sum(bool(entry.late_s) for entry in entries),
    }
    cells = [(name, f"{count}") for name, count in counts.items() if count or name == "Verified"]
    cells += [
        ("Mean points", f"{statistics.fmean(totals):.1f}{of}" if totals else "–"),
        ("Median", f"{statistics.median(totals):.1f}{of}" if totals else "–"),
    ]
    if pending := [one.points for one in graded if one.pending]:
        said = f"{number(sum(pending))} points, not counted"
        cells.append(("Pending", f"{len(pending)} <small>{said}</small>"))
    drawn = histogram(totals, max(most, default=1.0), "Students by points")
    return summary(cells, drawn, note("Points that are pending are in no sum here."))


def _items(entries: Sequence[Entry], veil: Veil) -> str:
    """Distribution of points per item, as they count."""
    found: dict[str, list[Item]] = defaultdict(list)
    for entry in entries:
        one = entry.counting
        for title, item in one.by_title.items() if one and not one.pending else ():
            found[title].append(item)
    if not found:
        return ""
    lines = []
    for title, items in found.items():
        shares = [item.points / item.of if item.of else 0.0 for item in items]
        mean, most = statistics.fmean(i.points for i in items), max(i.of for i in items)
        none, full = sum(share <= 0.0 for share in shares), sum(share >= 1.0 for share in shares)
        lines.append(
            f'<tr><th scope="row" dir="auto">{escaped(veil.hide(title))}</th>'
            f'<td class="chart">{bins(shares)}</td>'
            f'<td class="n">{mean:.1f}&nbsp;/&nbsp;{number(most)}</td>'
            f'<td class="n wide-only">{none}</td><td class="n wide-only">{full}</td></tr>'
        )
    return card(
        "Points by item",
        note("From none to all, in tenths, below none with none; pending reports left out."),
        '<table class="spread"><thead><tr><th scope="col">Item</th>'
        '<th scope="col" class="chart">none to all</th><th scope="col" class="n">Mean</th>'
        '<th scope="col" class="n wide-only">None</th>'
        '<th scope="col" class="n wide-only">All</th></tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table>",
    )
