"""What changed from A to B: numbers in a table, then both flights side by side."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from px4fuse.comparison.model import AxisComparison
from px4fuse.comparison.why import the
from px4fuse.report import panels
from px4fuse.report.changes_words import cells, folded_words, other_lines, printed
from px4fuse.report.document import ChangesDocument
from px4fuse.report.page import Cell, Page, halves
from px4fuse.report.style import MUTED, SEVERITY_COLOURS, TIME_LABEL
from px4fuse.results.contract import ChangeResults

COLOURS = {"worse": SEVERITY_COLOURS["error"], "better": "#1f6b3a"}
SIZE = 7.6
SHARES = (7.5, 28.0, 7.5, 10.0, 25.0, 9.0)
HEADS = ("", "number", "A", "B", "change, with its 95 % interval", "by chance?")
HEIGHT = 105.0


PANELS = (panels.POSITION, panels.ERROR, panels.INNOVATIONS, panels.SIGMA_P)


def draw(document: ChangesDocument) -> Iterator[Page]:
    """Draw the summary, and where both logs are at hand what they show."""
    yield _numbers(document.results)
    a, b = document.a, document.b
    if a is not None and b is not None and (common := [name for name in a.axes if name in b.axes]):
        name = a.main.axis.name if a.main.axis.name in common else common[0]
        yield _flights(a[name], b[name])


def _numbers(results: ChangeResults) -> Page:
    page = Page("What changed from A to B")
    for text in results.summary[:1]:
        page.write(text, size=10.0, bold=True)
    for text in results.summary[1:]:
        page.write(text, size=8.6, above=2.0)
    for name, side in (("A", results.a), ("B", results.b)):
        kind = {"log": "its log", "report": "its report", "results": "its results"}[side.kind]
        page.write(
            f"{name}: {side.given}, {kind}; SHA-256 {side.log_sha256[:12]}, px4fuse {side.px4fuse}",
            size=7.4, colour=MUTED,
        )  # fmt: skip
    rows: list[list[Cell]] = []
    for change in printed(results):
        judged, *others = cells(change)
        rows.append([(judged, COLOURS.get(judged, "black")), *others])
    if rows:
        page.table(HEADS, rows, shares=SHARES, size=SIZE)
    page.write(folded_words(results), size=SIZE, colour=MUTED, above=3.0)
    for head, text, severity in other_lines(results):
        colour = SEVERITY_COLOURS[severity] if severity else "black"
        page.write(f"{head}: {text}", size=SIZE, colour=colour, above=1.0)
    for text in results.notes:
        page.write(text, size=SIZE, colour=MUTED, above=1.0)
    return page


def _flights(a: AxisComparison, b: AxisComparison) -> Page:
    """Both flights along one axis, with common scales."""
    page = Page(
        f"A and B along {the(a.axis.name)}",
        "A at the left, B at the right. Ours is dark and solid, EKF2 lighter and dashed, the truth "
        "dotted. An error is the distance from the truth, and without one that of ours from EKF2.",
    )
    known = [isinstance(panels.error_reference(result), pd.DataFrame) for result in (a, b)]
    for panel in PANELS:
        if panel is panels.ERROR and not all(known):
            continue
        columns, drawn = halves(), []
        for side, result, column in zip("AB", (a, b), columns, strict=True):
            axes = column.panel(f"{side}: {panel.named(result)}", panel.numbers(result), HEIGHT)
            panel.draw(axes, result)
            axes.set_xlabel(TIME_LABEL)
            drawn.append(axes)
        low, high = zip(*(axes.get_ylim() for axes in drawn), strict=True)
        for axes in drawn:
            axes.set_ylim(min(low), max(high))
        page.beside(*columns)
    return page
