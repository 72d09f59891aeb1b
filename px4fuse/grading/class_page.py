"""A class as one self-contained page, in which nothing that a student wrote comes to life.

The page's only script and style are allowed by their hash, and nothing else is: no network, no
markup from data. Rows stand in the page as escaped text; what a row unfolds to is JSON, which the
script puts into the page as text.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import posixpath
import re
import statistics
import unicodedata
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any, get_args

from px4fuse.grading.class_table import distinct, item_points, number
from px4fuse.grading.model import Graded
from px4fuse.verification.model import Status

STATUSES: tuple[str, ...] = (*get_args(Status), "page differs")
SIGNS = {
    "verified": "✓",
    "numbers differ": "≠",
    "other log": "⇄",
    "cannot verify": "?",
    "page differs": "≠",
}
BINS = 10
# Of one submission, on the page; all of it stands in the CSV and the report
MAX_DIFFERENCES = 50
MAX_CHARACTERS = 20_000
PNG = b"\x89PNG\r\n\x1a\n"


def html_text(graded: Sequence[Graded], title: str, made_with: str) -> str:
    """Lay out a class as one HTML file.

    Parameters
    ----------
    graded : sequence of Graded
        With their pictures, of which each takes four thirds of its size.
    title : str
    made_with : str
        Name and version of the program.

    Returns
    -------
    str
        Write it as UTF-8. The same for the same input: no dates.
    """
    template = files("px4fuse.grading").joinpath("class_page.html").read_text(encoding="utf-8")
    items = tuple(dict.fromkeys(name for one in graded for name in item_points(one)))
    numbers = tuple(dict.fromkeys(name for one in graded for name in one.numbers))
    # The folder or zip file that all are in says nothing in a row
    common = posixpath.commonprefix([one.submission for one in graded]).rpartition("/")
    shared = len(common[0] + common[1])
    return Template(template).substitute(
        style_hash=_hash_of("style", template),
        script_hash=_hash_of("script", template),
        title=_safe(title),
        made_with=_safe(made_with),
        count=len(graded),
        submissions="submission" if len(graded) == 1 else "submissions",
        summary=_summary(graded),
        histogram=_histogram(graded),
        options=_options(graded),
        item_heads=_heads(items, "i"),
        number_heads=_heads(numbers, "x"),
        rows="\n".join(_row(one, items, numbers, shared) for one in graded),
        details="\n".join(_details(one) for one in graded),
    )


def _hash_of(tag: str, template: str) -> str:
    """What the content security policy allows: this very text."""
    match = re.search(rf"<{tag}>(.*?)</{tag}>", template, re.DOTALL)
    assert match is not None
    return base64.b64encode(hashlib.sha256(match[1].encode()).digest()).decode()


def _text(text: str) -> str:
    """Text without what HTML cannot hold, of a length that a page can."""
    if len(text) > MAX_CHARACTERS:
        text = text[:MAX_CHARACTERS] + "…"
    return "".join(
        c if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cs") else "�" for c in text
    )


def _safe(text: str) -> str:
    return escape(_text(text))


# ------------------------------------------------------------------ above the table


def _summary(graded: Sequence[Graded]) -> str:
    points = [one.points for one in graded if one.of > 0.0]
    most = {one.of for one in graded if one.of > 0.0}
    of = f" <small>of {number(most.pop())}</small>" if len(most) == 1 else ""
    entries = [
        ("Submissions", str(len(graded))),
        ("Mean points", f"{statistics.fmean(points):.1f}{of}" if points else "–"),
        ("Median", f"{statistics.median(points):.1f}{of}" if points else "–"),
        ("Verified", str(sum(one.status == "verified" for one in graded))),
        ("Flagged", str(sum(bool(one.flags) for one in graded))),
    ]
    return "\n".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in entries)


def _histogram(graded: Sequence[Graded]) -> str:
    """Bars of how many have how many points; empty without any."""
    points = [one.points for one in graded if one.of > 0.0]
    most = max((one.of for one in graded), default=0.0)
    if not points:
        return ""
    counts = [0] * BINS
    for value in points:
        counts[min(max(math.floor(value / most * BINS), 0), BINS - 1)] += 1
    edges = [number(round(most * edge / BINS, 2)) for edge in range(BINS + 1)]
    words = "; ".join(
        f"{edges[place]} to {edges[place + 1]}: {count}" for place, count in enumerate(counts)
    )
    bars = []
    for place, count in enumerate(counts):
        height = 64.0 * count / max(counts)
        bars.append(
            f'<rect x="{place * 34 + 3}" y="{80.0 - height:.1f}" width="30" height="{height:.1f}"/>'
        )
        if count:
            bars.append(f'<text x="{place * 34 + 18}" y="{76.0 - height:.1f}">{count}</text>')
    ticks = [f'<text x="{edge * 34 + 1}" y="94">{edges[edge]}</text>' for edge in range(0, 11, 2)]
    return (
        '<figure><svg viewBox="-12 0 366 98" role="img" '
        f'aria-label="Submissions by points. {words}">{"".join(bars)}'
        f'<path d="M-2 80.5H344"/>{"".join(ticks)}</svg>'
        "<figcaption>Submissions by points</figcaption></figure>"
    )


def _options(graded: Sequence[Graded]) -> str:
    counts = [(name, sum(one.status == name for one in graded)) for name in STATUSES]
    flagged = sum(bool(one.flags) for one in graded)
    return "\n".join(
        [f'<option value="">Every status ({len(graded)})</option>']
        + [f'<option value="{name}">{name} ({count})</option>' for name, count in counts if count]
        + [f'<option value="flagged">flagged ({flagged})</option>']
    )


# ------------------------------------------------------------------ the table


def _heads(titles: Sequence[str], kind: str) -> str:
    return "\n".join(
        f'<th scope="col" class="n {kind}" data-kind="number">{_safe(title)}</th>'
        for title in titles
    )


def _row(one: Graded, items: Sequence[str], numbers: Sequence[str], shared: int) -> str:
    status = one.status
    missing = "" if one.student else ' data-v=""'
    flags = "".join(f"<li dir=auto>{_safe(flag)}</li>" for flag in one.flags)
    number_of_flags = f"{len(one.flags)} flag{'s' if len(one.flags) > 1 else ''}"
    points = item_points(one)
    parts = [
        f'<tr data-status="{status}" data-flagged="{"yes" if one.flags else ""}">'
        f'<th scope="row"{missing}><span class="name" dir="auto">'
        f"{_safe(one.student) or 'no name'}</span>"
        f'<span class="file" dir="auto">{_safe(one.submission[shared:])}</span></th>',
        f'<td class="id"><span dir="auto">{_safe(one.student_id)}</span></td>',
        f'<td data-v="{STATUSES.index(status)}"><span class="chip s{STATUSES.index(status)}">'
        f'<span aria-hidden="true">{SIGNS[status]}</span> {status}</span>'
        + (f'<span class="few">{number_of_flags}</span>' if flags else "")
        + "</td>",
        _points(one),
        f'<td data-v="{len(one.flags)}" class="flags">{f"<ul>{flags}</ul>" if flags else ""}</td>',
        *(_number(points.get(title), "i") for title in items),
        *(_number(one.numbers.get(title), "x") for title in numbers),
        "</tr>",
    ]
    return "".join(parts)


def _points(one: Graded) -> str:
    if one.of <= 0.0:
        return '<td class="n p" data-v="">–</td>'
    width = 56.0 * min(max(one.points / one.of, 0.0), 1.0)
    return (
        f'<td class="n p" data-v="{number(one.points)}">{number(one.points)} '
        f'<small>/ {number(one.of)}</small><svg width="56" height="4" aria-hidden="true">'
        f'<rect width="56" height="4" class="all"/><rect width="{width:.1f}" height="4"/></svg>'
        "</td>"
    )


def _number(value: float | None, kind: str) -> str:
    if value is None or not math.isfinite(value):
        return f'<td class="n {kind}" data-v=""></td>'
    return f'<td class="n {kind}" data-v="{number(value)}">{value:.4g}</td>'


# ------------------------------------------------------------------ what a row unfolds to


def _details(one: Graded) -> str:
    differences = one.verdict.differences
    more = len(differences) - MAX_DIFFERENCES
    details: dict[str, Any] = {
        "student": _text(one.student),
        "reasons": [_text(reason) for reason in one.verdict.reasons],
        "flags": [_text(flag) for flag in one.flags],
        "items": [
            [_text(title), number(item.points), number(item.of), _text(item.comment)]
            for title, item in zip(
                distinct(item.title for item in one.items), one.items, strict=True
            )
        ],
        "differences": [
            [_text(part) for part in (each.path, each.recorded, each.recomputed)]
            for each in differences[:MAX_DIFFERENCES]
        ],
        "more": f"and {more} more" if more > 0 else "",
        "numbers": [
            [_text(title), f"{value:.6g}"]
            for title, value in one.numbers.items()
            if math.isfinite(value)
        ],
        "facts": [
            [title, _text(value)]
            for title, value in (
                ("Name", one.student),
                ("Id", one.student_id),
                ("File", one.submission),
                ("Version", f"px4fuse {one.version}" if one.version else ""),
                ("SHA-256 of the PDF", one.sha256),
                ("SHA-256 of the log", one.log_sha256),
            )
            if value
        ],
        "notes": _text(one.notes),
        "report": one.redrawn_name,
        "pictures": [
            [f"Page {one.page}, {said}", base64.b64encode(png).decode()]
            for png, said in (
                (one.picture, "drawn again from the log"),
                (one.handed_in, "as handed in: not verified"),
            )
            if png.startswith(PNG)
        ],
    }
    return f'<script type="application/json">{_inert_json(details)}</script>'


def _inert_json(value: object) -> str:
    """JSON in which an HTML parser finds nothing: no <, > or &, and ASCII only."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")
