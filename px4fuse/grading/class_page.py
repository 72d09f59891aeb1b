"""A class as one web page: a student per row, and on top what an instructor asks.

Nothing that a student wrote can act: see :mod:`px4fuse.webpage`. Pictures of redrawn pages
and PDFs stand in folders beside the page and are loaded as they are unfolded.
"""

from __future__ import annotations

import base64
import math
import posixpath
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from px4fuse.answers import Answers, form_rows
from px4fuse.grading.anonymous import Veil
from px4fuse.grading.class_questions import Copied, above
from px4fuse.grading.class_table import item_points, number, settled_report
from px4fuse.grading.flags import copied_notes
from px4fuse.grading.model import Entry, Graded, Override
from px4fuse.grading.overrides import TOTAL
from px4fuse.webpage.frame import (
    Cell,
    Column,
    Part,
    Row,
    boxes,
    figure,
    links,
    listed,
    page,
    pairs,
    pictures,
    prose,
    tabled,
    words,
)
from px4fuse.webpage.safe import local_link

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
# Reading time: words a minute of notes in a language that may be the reader's second, and of a page
WORDS_PER_MINUTE = 200.0
MINUTES_PER_PAGE = 0.5
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
    named = not entries or not all(entry.pseudonym for entry in entries)
    if not named:
        entries = sorted(entries, key=lambda entry: entry.pseudonym)
    veil = Veil(entries)
    copied = _copied(entries)
    graded = [one for entry in entries if (one := entry.counting)]
    items = tuple(dict.fromkeys(name for one in graded for name in item_points(one)))
    numbers = tuple(dict.fromkeys(name for one in graded for name in one.numbers))
    # The folder or zip file that all are in says nothing in a row
    common = posixpath.commonprefix([one.submission for one in graded]).rpartition("/")
    shared = len(common[0] + common[1])
    timed = any(entry.handed_in or entry.late_s for entry in entries)
    layout = _PageLayout(items, numbers, shared, timed, named)
    minutes = {at: reading_minutes(entry.counting) for at, entry in enumerate(entries)}
    return page(
        title=title,
        subtitle=f"{len(entries)} {'student' if len(entries) == 1 else 'students'}, graded with "
        f"{made_with}",
        above=above(entries, veil, copied, minutes),
        noun=("student", "students"),
        columns=(
            Column("Student"),
            *[Column("Id", "line", narrow="tablet")] * named,
            Column("Status", "rank"),
            Column("Points", "number"),
            *[Column("Handed in", "line", narrow="desk")] * timed,
            Column("To read (min)", "number", narrow="desk"),
            Column("Flags", "rank", narrow="desk"),
            *(Column(veil.hide(name), "number", "items") for name in items),
            *(Column(veil.hide(name), "number", "numbers") for name in numbers),
        ),
        rows=[
            _row(entry, layout, veil, minutes[at], _alike(entries, copied.get(at, ()), veil))
            for at, entry in enumerate(entries)
        ],
        filters=_filters(entries),
        groups=(("items", "Points of each item"), ("numbers", "Numbers")),
        placeholder="name, id, file, flag",
        otherwise="All rows are in class.csv.",
    )


def reading_minutes(one: Graded | None) -> float:
    """How long reading a report takes, roughly: its notes and a look at each page."""
    if one is None:
        return 0.0
    return len(one.notes.split()) / WORDS_PER_MINUTE + MINUTES_PER_PAGE * len(one.sheets)


def _copied(entries: Sequence[Entry]) -> dict[int, list[Copied]]:
    """By entry, whose notes share passages with its own, most alike first."""
    places = [at for at, entry in enumerate(entries) if entry.counting]
    found: dict[int, list[Copied]] = {}
    for share, first, second in copied_notes([one for e in entries if (one := e.counting)]):
        for mine, theirs in ((first, second), (second, first)):
            found.setdefault(places[mine], []).append((share, places[theirs]))
    return {at: sorted(others, key=lambda o: (-o[0], o[1])) for at, others in found.items()}


def status_of(entry: Entry) -> str:
    """That of the counting report."""
    return entry.counting.status if entry.counting else MISSING


def _tags(entry: Entry) -> list[str]:
    one = entry.counting
    tags = [status_of(entry)]
    if one:
        tags += ["pending"] * bool(one.pending) + ["to read"] * one.waits
        tags += ["flagged"] * bool(one.flags or entry.remarks)
        tags += [f"missed:{mistake}" for mistake, named in one.mistakes.items() if not named]
    tags += ["late"] * bool(entry.late_s)
    tags += ["said by you"] * bool(entry.overrides or entry.comment)
    return tags


def _filters(entries: Sequence[Entry]) -> list[tuple[str, list[tuple[str, str]]]]:
    counts = Counter(tag for entry in entries for tag in _tags(entry))
    shown = [(name, f"{name} ({counts[name]})") for name in SHOWN if counts[name]]
    filters = [("Status", [("", f"Everyone ({len(entries)})"), *shown])]
    missed = sorted(tag for tag in counts if tag.startswith("missed:"))
    if missed:
        options = [(tag, f"{tag.removeprefix('missed:')} ({counts[tag]})") for tag in missed]
        filters.append(("Missed", [("", "Whatever was missed"), *options]))
    return filters


@dataclass(frozen=True)
class _PageLayout:
    """Columns that depend on the class."""

    items: tuple[str, ...]
    numbers: tuple[str, ...]
    # Characters that all names of files begin with
    shared: int
    timed: bool
    named: bool


def _row(
    entry: Entry, layout: _PageLayout, veil: Veil, minutes: float, alike: tuple[Part, ...]
) -> Row:
    one = entry.counting
    status = status_of(entry)
    flags = [*entry.remarks, *(one.flags if one else ())]
    known = entry.pseudonym or entry.student
    file = one.submission[layout.shared :] if one and not entry.pseudonym else ""
    settled = settled_report(entry)
    points = item_points(settled) if settled else {}
    look, sign = LOOKS[status]
    few = f"{len(flags)} flag{'s' if len(flags) > 1 else ''}" if flags else ""
    cells = (
        Cell(entry.called, known or None, file),
        *[words("" if entry.pseudonym else entry.student_id)] * layout.named,
        Cell(f"{sign} {status}", float(STATUSES.index(status)), few, look),
        _points(entry),
        *[words(entry.handed_in, late_words(entry))] * layout.timed,
        figure(minutes or None, f"{math.ceil(minutes)}"),
        Cell("\n".join(map(veil.hide, flags)), float(len(flags)), "", "flags"),
        *(figure(points.get(title)) for title in layout.items),
        *(figure(one.numbers.get(title) if one else None) for title in layout.numbers),
    )
    beside = _beside(entry, one, veil) if one else ()
    return Row(cells, tuple(_tags(entry)), _details(entry, veil, alike), beside)


def _points(entry: Entry) -> Cell:
    one = entry.counting
    of = entry.of or (one.of if one else 0.0)
    if entry.total is None:
        proposed = f"{number(one.points)} proposed" if one and one.counted is None else ""
        return Cell("pending" if proposed else "–", None, proposed)
    share = (min(max(entry.total / of, 0.0), 1.0),) if of > 0.0 else ()
    said = [f"{number(entry.deduction)} off for being late"] * bool(entry.deduction)
    said += ["said by you"] * any(each.points is not None for each in entry.overrides.values())
    text = f"{number(entry.total)} / {number(of)}" if of > 0.0 else number(entry.total)
    return Cell(text, entry.total, ", ".join(said), "", share)


def late_words(entry: Entry) -> str:
    """How late it came.

    >>> late_words(Entry("", "", None, late_s=3 * 3600.0 + 1.0))
    '3 h late'
    """
    if not entry.late_s:
        return ""
    for unit, size in (("days", 86400.0), ("h", 3600.0)):
        if entry.late_s >= (2.0 if unit == "days" else 1.0) * size:
            return f"{entry.late_s / size:.0f} {unit} late"
    return f"{math.ceil(entry.late_s / 60.0)} min late"


def _details(entry: Entry, veil: Veil, alike: tuple[Part, ...]) -> tuple[Part, ...]:
    one = entry.counting
    comment = [veil.hide(text) for text in (entry.comment,) if text]
    if one is None:
        return listed("Missing", ["Nothing was handed in."]), listed("Your comment", comment)
    verdict = one.verdict
    more = len(verdict.differences) - MAX_DIFFERENCES
    return (
        listed("Flags", [veil.hide(text) for text in (*entry.remarks, *one.flags)], warn=True),
        listed("Pending: what you can do", [veil.hide(one.pending)] if one.pending else [], True),
        listed("Verification", [veil.hide(reason) for reason in verdict.reasons]),
        tabled(
            "Numbers that differ",
            ("Where", "Report", "New run") if verdict.differences else (),
            [
                [veil.hide(text) for text in (each.path, each.recorded, each.recomputed)]
                for each in verdict.differences[:MAX_DIFFERENCES]
            ],
            after=f"and {more} more" if more > 0 else "",
        ),
        _item_table(entry, one, veil),
        listed("Your comment", comment),
        listed(
            "Mistakes of this flight",
            [
                f"{mistake}: {'named' if named else 'not named'}"
                for mistake, named in one.mistakes.items()
            ],
        ),
        _form(one.form, veil),
        *([] if entry.pseudonym else [_boxes(entry, one)]),
        prose("The student's own words", veil.hide(one.notes, own_words=True)),
        *alike,
        tabled(
            "Other attempts",
            ("File", "Status", "Points") if entry.others else (),
            [
                [
                    f"attempt {at}" if entry.pseudonym else other.submission,
                    other.status,
                    "pending" if other.pending else f"{number(other.points)} / {number(other.of)}",
                ]
                for at, other in enumerate(entry.others, start=1)
            ],
            (2,),
        ),
        pairs(
            "Numbers",
            [
                (veil.hide(title), f"{value:.6g}")
                for title, value in one.numbers.items()
                if math.isfinite(value)
            ],
        ),
        pairs("Submission", _facts(entry, one)),
    )


def _facts(entry: Entry, one: Graded) -> list[tuple[str, str]]:
    version = f"px4fuse {one.version}" if one.version else ""
    facts = [("Handed in", entry.handed_in), ("Late", late_words(entry)), ("Version", version)]
    if entry.pseudonym:
        return facts
    return [
        ("Name", entry.student),
        ("Id", entry.student_id),
        ("File", one.submission),
        *facts,
        ("SHA-256 of the PDF", one.sha256),
        ("SHA-256 of the log", one.log_sha256),
    ]


def _item_table(entry: Entry, one: Graded, veil: Veil) -> Part:
    rows = []
    for title, item in zip(item_points(one), one.items, strict=True):
        said = entry.overrides.get(title, Override())
        own = "" if said.points is None else f"You: {number(item.points)} → {number(said.points)}. "
        comment = f"{own}{said.comment} {item.comment}" if own or said.comment else item.comment
        points = item.points if said.points is None else said.points
        rows.append([veil.hide(title), number(points), number(item.of), veil.hide(comment)])
    heads = ("Item", "Points", "Of", "Comment") if rows else ()
    return tabled("Points (proposed)" if one.pending else "Points", heads, rows, (1, 2))


def _alike(entries: Sequence[Entry], copied: Sequence[Copied], veil: Veil) -> tuple[Part, ...]:
    """The texts that share passages with a student's own, to be read beside it."""
    return tuple(
        prose(f"Text of {entries[to].called}, which shares {share:.0%}",
              veil.hide(other.notes, own_words=True))
        for share, to in copied[:MAX_COPIES]
        if (other := entries[to].counting)
    )  # fmt: skip


def _boxes(entry: Entry, one: Graded) -> Part:
    """Points and a comment for what only the instructor scores, and for the whole."""
    by_hand = [
        (title, item.of)
        for title, item in zip(item_points(one), one.items, strict=True)
        if item.by_hand
    ]
    rows = []
    for title, of in (*by_hand, (TOTAL, entry.of or one.of)):
        said = entry.overrides.get(title, Override())
        rows.append((title, of, said.points, said.comment))
    shown = {title for title, *_ in rows}
    kept = [
        (title, said.points, said.comment)
        for title, said in entry.overrides.items()
        if title not in shown
    ]
    kept += [("", None, entry.comment)] if entry.comment else []
    owner = entry.student_id or one.submission
    return boxes("Your points and words", owner, rows, kept)


def _form(answers: Answers | None, veil: Veil) -> Part:
    """What the form says, in its own words."""
    rows = [
        (veil.hide(name), veil.hide(value))
        for name, value in (form_rows(answers) if answers else ())
    ]
    return pairs("The form", rows)


def _beside(entry: Entry, one: Graded, veil: Veil) -> tuple[Part, ...]:
    """The report's pages, and links to it, but for those that would name its student."""
    whose = f"of the report of {entry.called}"
    drawn = [
        (f"Page {at} of {len(one.sheets)}", f"Page {at} {whose}, drawn again from the log", link)
        for at, name in enumerate(one.sheets, start=1)
        if (link := local_link(name))
    ]
    if entry.pseudonym:
        return (pictures("Every page, drawn again from the log", drawn),)
    handed_in = []
    if one.handed_in.startswith(PNG):
        said = f"Page {one.page}, as handed in: not verified"
        source = f"data:image/png;base64,{base64.b64encode(one.handed_in).decode()}"
        handed_in = [(said, f"Page {one.page} {whose}, as handed in", source)]
        # the redrawn one stands beside it
        handed_in = [*drawn[one.page - 1 : one.page], *handed_in]
    return (
        links(
            "The report",
            [
                ("Drawn again from the log (PDF): read this one", local_link(one.redrawn_name)),
                (
                    "As it was handed in (PDF): the student's own file",
                    local_link(one.handed_in_name),
                ),
            ],
        ),
        pictures("The page that differs" if drawn else "As handed in", handed_in),
        pictures("Every page, drawn again from the log", drawn),
    )
