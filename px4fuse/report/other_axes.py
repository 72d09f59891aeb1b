"""Appendix: the axes that the core does not show, a column each, by the panels of the core."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from px4fuse.comparison.model import FILTERS, AxisComparison, Difference
from px4fuse.flight import Unavailable
from px4fuse.report import flight, innovations, marks
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    LEFT,
    MAX_POINTS_NARROW,
    POINTS_PER_HEIGHT,
    RIGHT,
    TIME_LABEL,
    Cursor,
    caption,
    page,
)
from px4fuse.report.words import verdict_words

GAP, INDENT = 0.045, 0.03
# Points above a panel for its title and below it for its numbers
HEAD, FOOT = 16.0, 24.0
PANEL_SIZE = 6.6
# Title, how it is drawn, and its numbers
Panel = tuple[str, Callable[[Axes, AxisComparison, int], None], Callable[[AxisComparison], str]]


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page; none where there is but one axis."""
    others = [
        axis for axis in document.analysis.axes.values() if axis is not document.analysis.main
    ]
    if not others:
        return
    figure, cursor = page(
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
    width = (RIGHT - LEFT - INDENT - 2 * GAP) / 3.0 if len(others) < 4 else 0.16
    top = cursor.y
    for column, result in enumerate(others):
        head = Cursor(figure, cursor.y)
        left = LEFT + column * (width + GAP)
        head.write(result.axis.name, size=9.0, weight="bold", x=left, right=left + width + INDENT)
        head.write(_axis_words(result), size=7.5, x=left, right=left + width + INDENT)
        top = min(top, head.y - 4.0 / POINTS_PER_HEIGHT)
    height = (top - BOTTOM - 20.0 / POINTS_PER_HEIGHT) / len(rows)
    for column, result in enumerate(others):
        left = LEFT + INDENT + column * (width + GAP)
        for place, row in enumerate(rows):
            box = (
                left,
                top - (place + 1) * height + FOOT / POINTS_PER_HEIGHT,
                width,
                height - (FOOT + HEAD) / POINTS_PER_HEIGHT,
            )
            _panel(figure, box, row, result, document, last=place == len(rows) - 1)
    yield figure


def _panel(
    figure: Figure, box: tuple[float, float, float, float], row: Panel, result: AxisComparison,
    document: Document, *, last: bool,
) -> None:  # fmt: skip
    title, draw_panel, numbers = row
    axes = figure.add_axes(box, title=title)
    axes.xaxis.set_major_locator(MaxNLocator(4) if last else NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(3))
    draw_panel(axes, result, MAX_POINTS_NARROW)
    shown = "" if draw_panel is innovations.draw_innovations else result.axis.name
    marks.draw(axes, document, axis=shown)
    if last:
        axes.set_xlabel(TIME_LABEL)
    caption(axes, numbers(result), size=PANEL_SIZE)


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
