"""What an instructor asks of a class, above the table."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence

from px4fuse.grading.anonymous import Veil
from px4fuse.grading.class_table import item_points, number, settled_report
from px4fuse.grading.model import Entry
from px4fuse.plain import few_words
from px4fuse.webpage.charts import bar, bins, histogram
from px4fuse.webpage.frame import card, note, opens, picks, ranking, summary
from px4fuse.webpage.safe import escaped

# How alike the notes are, and the place of the other entry
Copied = tuple[float, int]
MOST_NAMES = 40
MOST_PAIRS = 20


def above(
    entries: Sequence[Entry],
    veil: Veil,
    copied: Mapping[int, Sequence[Copied]],
    minutes: Mapping[int, float],
) -> str:
    """HTML of all that stands above the table."""
    cards = (_items(entries, veil), _mistakes(entries), _to_judge(entries), _pairs(entries, copied))
    shown = "".join(cards)
    return _summary(entries, minutes) + (f'<div class="cards">{shown}</div>' if shown else "")


def _summary(entries: Sequence[Entry], minutes: Mapping[int, float]) -> str:
    totals = [entry.total for entry in entries if entry.total is not None]
    graded = [one for entry in entries if (one := entry.counting)]
    most = {entry.of for entry in entries if entry.of > 0.0}
    of = f" <small>of {number(most.pop())}</small>" if len(most) == 1 else ""
    pending = [one.points for one in graded if one.pending]
    whole = sum(minutes.values())
    counts = [
        ("Students", len(entries)),
        ("Missing", len(entries) - len(graded)),
        ("Verified", sum(one.status == "verified" for one in graded)),
        ("Flagged", sum(bool(one.flags) for one in graded)),
        ("Late", sum(bool(entry.late_s) for entry in entries)),
    ]
    cells = [(name, f"{count}") for name, count in counts if count or name == "Verified"]
    cells += [
        ("Mean points", f"{statistics.fmean(totals):.1f}{of}" if totals else "–"),
        ("Median", f"{statistics.median(totals):.1f}{of}" if totals else "–"),
    ]
    if pending:
        cells.append(
            ("Pending", f"{len(pending)} <small>{number(sum(pending))} points, not counted</small>")
        )
    if whole:
        cells.append(("To read", f"{whole / 60.0:.1f} h" if whole >= 90.0 else f"{whole:.0f} min"))
    of_all = max((entry.of for entry in entries), default=0.0) or 1.0
    drawn = histogram(totals, of_all, "Students by points")
    reading = note(
        "Points that are pending are in no sum here. The time to read is an estimate: 200 words of "
        "notes a minute, and half a minute for each page."
    )
    return summary(cells, drawn, reading)


def _items(entries: Sequence[Entry], veil: Veil) -> str:
    """Distribution of points per item, as they count."""
    points: dict[str, list[float]] = defaultdict(list)
    most: dict[str, float] = {}
    for entry in entries:
        one = settled_report(entry)
        if one is None or one.pending:
            continue
        for title, item in zip(item_points(one), one.items, strict=True):
            points[title].append(item.points)
            most[title] = max(item.of, most.get(title, 0.0))
    if not points:
        return ""
    lines = []
    for title, values in points.items():
        mean = statistics.fmean(values)
        of = most[title]
        full = sum(value >= of for value in values)
        none = sum(value <= 0.0 for value in values)
        lines.append(
            f'<tr><th scope="row" dir="auto">{escaped(veil.hide(title))}</th>'
            f'<td class="chart">{bins([v / of if of else 0.0 for v in values])}</td>'
            f'<td class="n">{mean:.1f}&nbsp;/&nbsp;{number(of)}</td>'
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


def _mistakes(entries: Sequence[Entry]) -> str:
    """Who missed which mistake, from the answer key; those that most missed first."""
    found: dict[str, list[tuple[int, bool]]] = defaultdict(list)
    for at, entry in enumerate(entries):
        for mistake, was in (entry.counting.mistakes if entry.counting else {}).items():
            found[mistake].append((at, was))
    if not found:
        return ""
    lines = []
    for mistake, those in sorted(
        found.items(), key=lambda item: (sum(n for _, n in item[1]) / len(item[1]), item[0])
    ):
        named = sum(was for _, was in those)
        missed = [opens(at, entries[at].called) for at, was in those if not was]
        by = f"<p>Not named by {few_words(missed, MOST_NAMES)}.</p>" if missed else ""
        said = picks(f"missed:{mistake}", mistake) if missed else f"<span>{escaped(mistake)}</span>"
        lines.append(
            f"<li>{bar(named / len(those))}{said}"
            f"<span class='right'>{named} of {len(those)} named it</span>{by}</li>"
        )
    said = "Of the students whose flight has it, by the answer key; hardest first."
    return ranking("Who missed which mistake", said, lines, len(lines))


def _to_judge(entries: Sequence[Entry]) -> str:
    """Passages that no rule can judge, and points that wait for the instructor."""
    lines = []
    for at, entry in enumerate(entries):
        one = entry.counting
        if one is None:
            continue
        # what to do stands in the row, where names are hidden
        waiting = ["points that are pending"] * bool(one.pending)
        waiting += ["a text to read"] * one.waits
        if waiting:
            said = f"<span class='right'>{escaped(' and '.join(waiting))}</span>"
            lines.append(f"<li>{opens(at, entry.called)}{said}</li>")
    if not lines:
        return ""
    rest = ": choose “pending” or “to read” under Status"
    return ranking("For you to judge", "", lines, MOST_NAMES, rest)


def _pairs(entries: Sequence[Entry], copied: Mapping[int, Sequence[Copied]]) -> str:
    """Pairs of students whose notes share passages, most alike first."""
    found = sorted(
        (-share, at, other)
        for at, others in copied.items()
        for share, other in others
        if at < other
    )
    if not found:
        return ""
    lines = [
        f"<li><span>{opens(at, entries[at].called)} and "
        f"{opens(other, entries[other].called)}</span>"
        f"<span class='right'>{-share:.0%} of both</span></li>"
        for share, at, other in found
    ]
    said = "Open one of the two to read them one after the other. Alike does not mean copied."
    return ranking("Texts that share passages", said, lines, MOST_PAIRS, " pairs")
