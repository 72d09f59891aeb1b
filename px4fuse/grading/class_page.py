"""A class as one web page: a student per row, and on top what an instructor asks.

Nothing that a student wrote can act: see :mod:`px4fuse.webpage`. Pictures of redrawn pages
and PDFs stand in folders beside the page and are loaded as they are unfolded.
"""

from __future__ import annotations

import base64
import math
import posixpath
import statistics
from collections import Counter, defaultdict
from collections.abc import Sequence

from px4fuse.answers import form_rows
from px4fuse.grading.anonymous import Veil
from px4fuse.grading.class_table import number
from px4fuse.grading.flags import copied_notes
from px4fuse.grading.model import Entry, Graded, Item, Override, columns
from px4fuse.grading.overrides import TOTAL
from px4fuse.webpage.charts import bins, histogram
from px4fuse.webpage.frame import (
    Cell,
    Column,
    Part,
    Row,
    boxes,
    card,
    figure,
    links,
    listed,
    note,
    page,
    pairs,
    pictures,
    prose,
    summary,
    tabled,
    words,
)
from px4fuse.webpage.safe import escaped, local_link

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
# Of one submission, on the page; all of it stands in the report
MAX_DIFFERENCES = 50
MAX_COPIES = 3
PNG = b"\x89PNG\r\n\x1a\n"
SHOWN = (*STATUSES, "pending", "to read", "flagged", "late", "said by you")


def html_text(entries: Sequence[Entry], title: str, made_with: str) -> str:
    """Lay out a class as one HTML file.

    Parameters
    ----------
    entries : sequence of Entry
        One per student. Where they have pseudonyms, no name, id or file's name is on the page.
    made_with : str
        Name and version of the program.

    Returns
    -------
    str
        Write it as UTF-8. The same for the same input: no dates of today.
    """
    if entries and all(entry.pseudonym for entry in entries):
        entries = sorted(entries, key=lambda entry: entry.pseudonym)
    made = _Page(entries)
    veil = made.veil
    return page(
        title=title,
        subtitle=f"{len(entries)} {'student' if len(entries) == 1 else 'students'}, graded with "
        f"{made_with}",
        above=_summary(entries) + _items(entries, veil),
        noun=("student", "students"),
        columns=(
            Column("Student"),
            *[Column("Id", "line", narrow="tablet")] * made.named,
            Column("Status", "rank"),
            Column("Points", "number"),
            *[Column("Handed in", "line", narrow="desk")] * made.timed,
            Column("Flags", "rank", narrow="desk"),
            *(Column(veil.hide(name), "number", "items") for name in made.items),
            *(Column(veil.hide(name), "number", "numbers") for name in made.numbers),
        ),
        rows=[made.row(at, entry) for at, entry in enumerate(entries)],
        filters=_filters(entries),
        groups=(("items", "Points of each item"), ("numbers", "Numbers")),
        placeholder="name, id, file, flag",
        otherwise="All rows are in class.csv.",
    )


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
    made = card(
        "Points by item",
        note("From none to all, in tenths, below none with none; pending reports left out."),
        '<table class="spread"><thead><tr><th scope="col">Item</th>'
        '<th scope="col" class="chart">none to all</th><th scope="col" class="n">Mean</th>'
        '<th scope="col" class="n wide-only">None</th>'
        '<th scope="col" class="n wide-only">All</th></tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table>",
    )
    return f'<div class="cards">{made}</div>'


def status_of(entry: Entry) -> str:
    """That of the counting report."""
    return entry.counting.status if entry.counting else MISSING


def _tags(entry: Entry) -> list[str]:
    one = entry.counting
    tags = [status_of(entry)]
    if one:
        tags += ["pending"] * bool(one.pending) + ["to read"] * one.waits
        tags += ["flagged"] * bool(entry.flags)
        tags += [f"missed:{mistake}" for mistake, named in one.mistakes.items() if not named]
    tags += ["late"] * bool(entry.late_s)
    return tags + ["said by you"] * bool(entry.overrides or entry.comment)


def _filters(entries: Sequence[Entry]) -> list[tuple[str, list[tuple[str, str]]]]:
    counts = Counter(tag for entry in entries for tag in _tags(entry))
    shown = [(name, f"{name} ({counts[name]})") for name in SHOWN if counts[name]]
    filters = [("Status", [("", f"Everyone ({len(entries)})"), *shown])]
    missed = sorted(tag for tag in counts if tag.startswith("missed:"))
    if missed:
        options = [(tag, f"{tag.removeprefix('missed:')} ({counts[tag]})") for tag in missed]
        filters.append(("Missed", [("", "Whatever was missed"), *options]))
    return filters


class _Page:
    """A class, and what its rows share: columns, names to hide, texts that are alike."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        self.entries = entries
        self.veil = Veil(entries)
        self.named = not entries or not all(entry.pseudonym for entry in entries)
        self.timed = any(entry.handed_in or entry.late_s for entry in entries)
        places = [at for at, entry in enumerate(entries) if entry.counting]
        graded = [one for entry in entries if (one := entry.counting)]
        self.items, self.numbers = columns(entries)
        self.copied = {
            places[at]: [(share, places[to]) for share, to in others]
            for at, others in copied_notes(graded).items()
        }
        # the folder or zip file that all are in says nothing in a row
        common = posixpath.commonprefix([one.submission for one in graded])
        self.shared = common.rfind("/") + 1

    def hidden(self, texts: Sequence[str]) -> list[str]:
        """Texts without names, and without those that are empty."""
        return [self.veil.hide(text) for text in texts if text]

    def row(self, at: int, entry: Entry) -> Row:
        """One student."""
        one = entry.counting
        status = status_of(entry)
        look, sign = LOOKS[status]
        flags = self.hidden(entry.flags)
        few = f"{len(flags)} flag{'s' if len(flags) > 1 else ''}" if flags else ""
        known = entry.pseudonym or entry.student
        file = one.submission[self.shared :] if one and not entry.pseudonym else ""
        items = one.by_title if one else {}
        numbers = one.numbers if one else {}
        cells = (
            Cell(entry.called, known or None, file),
            *[words("" if entry.pseudonym else entry.student_id)] * self.named,
            Cell(f"{sign} {status}", float(STATUSES.index(status)), few, look),
            _points(entry),
            *[words(entry.handed_in, late_words(entry))] * self.timed,
            Cell("\n".join(flags), float(len(flags)), "", "flags"),
            *(figure(items[name].points if name in items else None) for name in self.items),
            *(figure(numbers.get(title)) for title in self.numbers),
        )
        beside = _beside(entry, one) if one else ()
        return Row(cells, tuple(_tags(entry)), self._details(at, entry), beside)

    def _details(self, at: int, entry: Entry) -> tuple[Part, ...]:
        one, hide = entry.counting, self.veil.hide
        comment = listed("Your comment", self.hidden([entry.comment]))
        if one is None:
            return listed("Missing", ["Nothing was handed in."]), comment
        verdict = one.verdict
        more = len(verdict.differences) - MAX_DIFFERENCES
        items = [
            [hide(title), number(item.points), number(item.of), hide(item.comment)]
            for title, item in one.by_title.items()
        ]
        attempts = [
            f"{f'attempt {place}' if entry.pseudonym else other.submission}: {other.status}"
            for place, other in enumerate(entry.others, start=1)
        ]
        return (
            listed("Flags", self.hidden(entry.flags), warn=True),
            listed("Pending: what you can do", self.hidden([one.pending]), warn=True),
            listed("Verification", self.hidden(verdict.reasons)),
            tabled(
                "Numbers that differ",
                ("Where", "Report", "New run") if verdict.differences else (),
                [
                    [hide(text) for text in (each.path, each.recorded, each.recomputed)]
                    for each in verdict.differences[:MAX_DIFFERENCES]
                ],
                after=f"and {more} more" if more > 0 else "",
            ),
            tabled(
                "Points (proposed)" if one.pending else "Points",
                ("Item", "Points", "Of", "Comment") if items else (),
                items,
                (1, 2),
            ),
            comment,
            listed(
                "Mistakes of this flight",
                [f"{name}: {'' if n else 'not '}named" for name, n in one.mistakes.items()],
            ),
            pairs(
                "The form",
                [(hide(a), hide(b)) for a, b in (form_rows(one.form) if one.form else ())],
            ),
            *([] if entry.pseudonym else [_boxes(entry, one)]),
            prose("The student's own words", hide(one.notes, own_words=True)),
            *self._alike(at),
            listed("Other attempts", attempts),
        )

    def _alike(self, at: int) -> list[Part]:
        """The texts that share passages with a student's own, to be read beside it."""
        found = [(share, self.entries[to]) for share, to in self.copied.get(at, ())[:MAX_COPIES]]
        return [
            prose(
                f"Text of {other.called}, which shares {share:.0%}",
                self.veil.hide(other.counting.notes if other.counting else "", own_words=True),
            )
            for share, other in found
        ]


def _points(entry: Entry) -> Cell:
    one = entry.counting
    if entry.total is None:
        proposed = f"{number(one.points)} proposed" if one and one.counted is None else ""
        return Cell("pending" if proposed else "–", None, proposed)
    share = (min(max(entry.total / entry.of, 0.0), 1.0),) if entry.of > 0.0 else ()
    said = [f"{number(entry.deduction)} off for being late"] * bool(entry.deduction)
    said += ["said by you"] * any(each.points is not None for each in entry.overrides.values())
    text = f"{number(entry.total)} / {number(entry.of)}"
    return Cell(text, entry.total, ", ".join(said), "", share)


def late_words(entry: Entry) -> str:
    """How late it came.

    >>> late_words(Entry("", "", None, late_s=3 * 3600.0 + 1.0))
    '3 h late'
    """
    if not entry.late_s:
        return ""
    for unit, size, least in (("days", 86400.0, 2.0), ("h", 3600.0, 1.0)):
        if entry.late_s >= least * size:
            return f"{entry.late_s / size:.0f} {unit} late"
    return f"{math.ceil(entry.late_s / 60.0)} min late"


def _boxes(entry: Entry, one: Graded) -> Part:
    """Points and a comment for what only the instructor scores, and for the whole."""
    by_hand = {title: item.of for title, item in one.by_title.items() if item.by_hand}
    by_hand[TOTAL] = entry.of
    said = [(title, of, entry.overrides.get(title, Override())) for title, of in by_hand.items()]
    rows = [(title, of, own.points, own.comment) for title, of, own in said]
    kept = [
        (title, own.points, own.comment)
        for title, own in entry.overrides.items()
        if title not in by_hand
    ]
    kept += [("", None, entry.comment)] if entry.comment else []
    return boxes("Your points and words", entry.student_id or one.submission, rows, kept)


def _beside(entry: Entry, one: Graded) -> tuple[Part, ...]:
    """The report's pages, and links to it, but for those that would name its student."""
    whose = f"of the report of {entry.called}"
    drawn = [
        (f"Page {at} of {len(one.sheets)}", f"Page {at} {whose}, drawn again from the log", link)
        for at, name in enumerate(one.sheets, start=1)
        if (link := local_link(name))
    ]
    every = pictures("Every page, drawn again from the log", drawn)
    if entry.pseudonym:
        return (every,)
    handed_in = []
    if one.handed_in.startswith(PNG):
        said = f"Page {one.page}, as handed in: not verified"
        source = f"data:image/png;base64,{base64.b64encode(one.handed_in).decode()}"
        # the redrawn one stands beside it
        handed_in = drawn[one.page - 1 : one.page]
        handed_in += [(said, f"Page {one.page} {whose}, as handed in", source)]
    report = (
        ("Drawn again from the log (PDF): read this one", local_link(one.redrawn_name)),
        ("As it was handed in (PDF): the student's own file", local_link(one.handed_in_name)),
    )
    title = "The page that differs" if drawn else "As handed in"
    return links("The report", report), pictures(title, handed_in), every
