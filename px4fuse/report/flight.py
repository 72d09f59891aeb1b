"""The flight along the main axis, both filters on one time axis; and the other axes beside it."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from px4fuse.comparison.model import Difference
from px4fuse.flight import Unavailable
from px4fuse.report import marks, panels
from px4fuse.report.document import Document
from px4fuse.report.page import WIDTH, Page
from px4fuse.report.style import LINES, MEASURED, OURS_BAND, Artist
from px4fuse.report.why import nothing_concluded
from px4fuse.report.words import filters, verdict_words

GAP = 14.0  # points between columns


def draw(document: Document) -> Iterator[Page]:
    """Draw one page."""
    result = document.analysis.main
    page = Page(f"The flight along {result.axis.called}")
    _legend(page, document)
    reference = panels.error_reference(result)
    shown = [panels.POSITION, panels.VELOCITY]
    if isinstance(reference, pd.DataFrame):
        shown.append(panels.ERROR)
    for panel in shown:
        panel.put(page, document, result, last=panel is shown[-1], strip=panel is shown[0])
    page.write(nothing_concluded(document), above=6.0)
    if isinstance(reference, Unavailable):
        page.write(f"No error is drawn: {reference.reason}. {reference.remedy}", above=6.0)
    yield page


def _legend(page: Page, document: Document) -> None:
    """Write the legend of lines and marks that holds for all pages."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    result = document.analysis.main
    lines: list[Artist] = [
        Line2D([], [], **{**MEASURED, "ms": 5.0}, label="measurement"),
        Line2D([], [], **LINES["ours"], label="ours"),
        Patch(facecolor=OURS_BAND, lw=0, label="ours ±2σ"),
    ]
    for name, frame in (("EKF2", result.ekf2_state), ("truth", result.truth)):
        if isinstance(frame, pd.DataFrame):
            lines.append(Line2D([], [], **LINES[name], label=name))
    page.legend(lines, marks.handles(document))


def draw_other_axes(document: Document) -> Iterator[Page]:
    """Draw the axes that the core leaves out, a column each; no page where there is but one."""
    others = document.other_axes
    if not others:
        return
    page = Page(
        "Appendix: other axes",
        "The panels of the pages before for the axes that they leave out; lines, bands and marks "
        "are the same.",
    )
    width = (WIDTH - GAP * (len(others) - 1)) / max(len(others), 3)
    columns = [Page(width=width) for _ in others]
    for column, result in zip(columns, others, strict=True):
        said = ", ".join(f"{name} {verdict_words(one)}" for name, one in filters(result).items())
        if isinstance(result.difference, Difference):
            said += f"; {result.difference.position_rmse_m:.3f} m RMS apart"
        column.heading(result.axis.name)
        column.write(f"Innovation variance: {said}.", size=7.5)
    page.beside(*columns, gap=GAP)
    shown = [panels.POSITION, panels.VELOCITY, panels.INNOVATIONS, panels.SIGMA_P]
    if any(isinstance(panels.error_reference(axis), pd.DataFrame) for axis in others):
        shown.insert(2, panels.ERROR)
    for panel in shown:
        columns = [Page(width=width) for _ in others]
        for column, result in zip(columns, others, strict=True):
            panel.put(column, document, result, last=panel is shown[-1], narrow=True)
        page.beside(*columns, gap=GAP)
    yield page
