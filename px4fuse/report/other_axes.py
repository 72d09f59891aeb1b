"""Appendix: the axes that the core does not show, a column each, by the panels of the core."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator

from px4fuse.comparison.model import FILTERS, AxisComparison, Difference
from px4fuse.flight import Unavailable
from px4fuse.report import flight, innovations, marks
from px4fuse.report.document import Document
from px4fuse.report.page import WIDTH, Page
from px4fuse.report.style import MAX_POINTS_NARROW, MUTED, TIME_LABEL, bare_x
from px4fuse.report.words import verdict_words

GAP, HEIGHT, PANEL_SIZE = 14.0, 72.0, 6.6
# Title, how it is drawn, and its numbers
Panel = tuple[str, Callable[[Axes, AxisComparison, int], None], Callable[[AxisComparison], str]]


def draw(document: Document) -> Iterator[Page]:
    """Draw one page; none where there is but one axis."""
    others = [
        axis for axis in document.analysis.axes.values() if axis is not document.analysis.main
    ]
    if not others:
        return
    page = Page(
        "Appendix: other axes",
        "The panels of the pages before for the axes that they leave out; lines, bands and marks "
        "are the same.",
    )
    rows: tuple[Panel, ...] = (
        ("position (m)", flight.draw_position, flight.position_numbers),
        ("velocity (m/s)", flight.draw_velocity, flight.velocity_numbers),
        (
            "position - truth (m)" if document.truth_known else "ours - EKF2 (m)",
            flight.draw_error,
            flight.error_numbers,
        ),
        ("innovation (m), ±2√S", innovations.draw_innovations, innovations.short_numbers),
        ("σ of position (m), log scale", innovations.draw_sigma, innovations.sigma_numbers),
    )
    if all(isinstance(flight.error_reference(axis), Unavailable) for axis in others):
        rows = tuple(row for row in rows if row[1] is not flight.draw_error)
    width = (WIDTH - GAP * (len(others) - 1)) / max(len(others), 3)
    columns = [Page(width=width) for _ in others]
    for column, result in zip(columns, others, strict=True):
        column.heading(result.axis.name)
        column.write(_axis_words(result), size=7.5)
    page.beside(*columns, gap=GAP)
    for row in rows:
        columns = [Page(width=width) for _ in others]
        for column, result in zip(columns, others, strict=True):
            _panel(column, row, result, document, last=row is rows[-1])
        page.beside(*columns, gap=GAP)
    yield page


def _panel(
    column: Page, row: Panel, result: AxisComparison, document: Document, *, last: bool
) -> None:
    title, draw_panel, numbers = row
    axes = column.panel(title, "", HEIGHT)
    axes.xaxis.set_major_locator(MaxNLocator(4) if last else NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(3))
    draw_panel(axes, result, MAX_POINTS_NARROW)
    shown = "" if draw_panel is innovations.draw_innovations else result.axis.name
    marks.draw(axes, document, axis=shown)
    if last:
        axes.set_xlabel(TIME_LABEL)
    else:
        bare_x(axes)
    column.write(numbers(result), size=PANEL_SIZE, colour=MUTED, above=-1.0)


def _axis_words(result: AxisComparison) -> str:
    """What to see in one column."""
    ours, ekf2 = (result.filters[name] for name in FILTERS)
    words = [f"innovation variance: ours {verdict_words(ours)}"]
    if not isinstance(result.ekf2_state, Unavailable):
        words.append(f"EKF2 {verdict_words(ekf2)}")
    text = ", ".join(words)
    if isinstance(result.difference, Difference):
        text += f"; {result.difference.position_rmse_m:.3f} m RMS apart"
    return f"{text[0].upper()}{text[1:]}."
