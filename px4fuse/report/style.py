"""Page geometry, colours, fonts and text for the report's pages.

Our filter is dark, solid and round; EKF2 is lighter, dashed and square; so that the two stay apart
in grey. Text from outside (names, notes) is drawn as it is: no mathematics, no markup.
"""

from __future__ import annotations

import logging
import textwrap
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.ft2font import LoadFlags
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from px4fuse.arrays import Array
from px4fuse.report import fonts

A4_INCHES = (8.27, 11.69)
LEFT, RIGHT, TOP, BOTTOM = 0.085, 0.945, 0.95, 0.05
PANEL_LEFT = LEFT + 0.04  # of axes: the numbers beside them stand in between
LABEL_WIDTH = 0.085
ROW_SIZE = 7.4
SPACING = 1.32  # of lines, times the size
POINTS_PER_WIDTH = A4_INCHES[0] * 72.0
POINTS_PER_HEIGHT = A4_INCHES[1] * 72.0

TIME_LABEL = "time since first data (s)"

OURS = "#123f7a"
OURS_BAND = "#b9cbe4"
EKF2 = "#e0741a"
EKF2_BAND = "#f6c99f"
TRUTH = "#111111"
MEASUREMENT = "#9a9a9a"
MUTED = "#555555"
RULE = "#bbbbbb"
SEVERITY_COLOURS = {"error": "#a61b1b", "warning": "#8a5a00", "info": "#33556b"}

OURS_LINE: dict[str, Any] = {"color": OURS, "lw": 1.0, "ls": "-"}
EKF2_LINE: dict[str, Any] = {"color": EKF2, "lw": 1.1, "ls": (0, (4, 1.6))}
TRUTH_LINE: dict[str, Any] = {"color": TRUTH, "lw": 0.7, "ls": (0, (1, 1.5))}
OURS_DOTS: dict[str, Any] = {"color": OURS, "marker": "o", "ms": 2.0, "mew": 0, "ls": "none"}
EKF2_DOTS: dict[str, Any] = {"color": EKF2, "marker": "s", "ms": 2.2, "mew": 0, "ls": "none"}
# What EKF2 did not fuse is hollow everywhere
EKF2_REJECTED: dict[str, Any] = {
    "color": EKF2, "marker": "s", "ms": 2.8, "mew": 0.6, "mfc": "white", "ls": "none",
}  # fmt: skip
MEASURED: dict[str, Any] = {
    "color": MEASUREMENT, "marker": ".", "ms": 1.8, "mew": 0, "ls": "none",
}  # fmt: skip

# What the eye can see across a page, and across a third of it: longer series are thinned to their
# extremes per bucket.
MAX_POINTS = 1500
MAX_POINTS_NARROW = 500


@contextmanager
def report_style(outside: str = "") -> Iterator[None]:
    """Matplotlib settings of the report, for the duration of a block.

    Parameters
    ----------
    outside : str
        What comes from outside (names, notes), for fonts that have its characters.
    """
    with (
        _quiet(),
        mpl.rc_context(
            {
                "font.family": fonts.families(outside),
                "font.size": 7.5,
                "axes.titlesize": 8.5,
                "axes.titlelocation": "left",
                "axes.titlepad": 4,
                "axes.titley": 1.0,  # fixed: placing titles automatically lays every axis out twice
                "axes.labelsize": 7.5,
                "axes.labelpad": 2,
                "axes.linewidth": 0.6,
                "axes.spines.top": False,
                "axes.spines.right": False,
                "axes.unicode_minus": True,
                "axes.grid": True,
                "axes.grid.axis": "y",
                "grid.color": "#e3e3e3",
                "grid.linewidth": 0.5,
                "axes.axisbelow": True,
                "xtick.labelsize": 7,
                "ytick.labelsize": 7,
                "xtick.major.width": 0.6,
                "ytick.major.width": 0.6,
                "xtick.major.size": 2.5,
                "ytick.major.size": 2.5,
                "legend.fontsize": 7,
                "legend.frameon": False,
                "legend.handlelength": 2.4,
                "text.parse_math": False,
                "pdf.fonttype": 42,
                "ps.fonttype": 42,  # by which the PDF too is cut: one file per font, not two
                "pdf.compression": 6,
                "path.simplify": True,
                "path.simplify_threshold": 0.5,
            }
        ),
    ):
        yield


@contextmanager
def _quiet() -> Iterator[None]:
    """Without matplotlib's remarks that a font has no regular weight."""
    logger = logging.getLogger(font_manager.__name__)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


@cache
def _font(name: str, weight: str) -> Any:
    properties = font_manager.FontProperties(family=name, weight=weight)
    return font_manager.get_font(font_manager.findfont(properties))


def printable(text: str) -> str:
    """Text with what no font here can draw replaced by a white square, and tabs by spaces."""
    drawn = []
    for character in text.expandtabs(4):
        if character in "\n" or (character.isprintable() and _has_glyph(character)):
            drawn.append(character)
        elif character.isprintable():
            drawn.append(fonts.NO_GLYPH)
    return "".join(drawn)


def _has_glyph(character: str) -> bool:
    return fonts.font_of(character) in mpl.rcParams["font.family"]


@cache
def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Width of a line of text in points, kerning and shaping left out."""
    return size * sum(_advance(character, weight) for character in text)


@cache
def _advance(character: str, weight: str) -> float:
    """Advance of one character in em."""
    font = _font(fonts.font_of(character) or fonts.FONT, weight)
    font.set_size(100.0, 72.0)
    return (
        float(font.load_char(ord(character), flags=LoadFlags.NO_HINTING).linearHoriAdvance)
        / 65536.0
        / 100.0
    )


def wrap(text: str, size: float, width_points: float, weight: str = "normal") -> list[str]:
    """Break text into lines that fit; a word longer than a line is broken too."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = " " * (len(paragraph) - len(paragraph.lstrip(" ")))
        for word in paragraph.lstrip(" ").split(" "):
            candidate = f"{line} {word}" if line.strip() else line + word
            if text_width(candidate, size, weight) <= width_points:
                line = candidate
                continue
            if line.strip():
                lines.append(line)
            line = word
            while (fitting := _fitting(line, size, width_points, weight)) < len(line):
                lines.append(line[:fitting])
                line = line[fitting:]
        lines.append(line)
    return lines


def shorten(text: str, size: float, width_points: float, weight: str = "normal") -> str:
    """One line that fits, with an ellipsis where it was cut."""
    text = " ".join(text.split())
    if _fitting(text, size, width_points, weight) == len(text):
        return text
    return text[: _fitting(text, size, width_points - size, weight)] + "…"


def _fitting(text: str, size: float, width_points: float, weight: str) -> int:
    """How many characters of a text fit, at least one."""
    width = 0.0
    for count, character in enumerate(text):
        width += text_width(character, size, weight)
        if width > width_points and not unicodedata.category(character).startswith("M"):
            return max(count, 1)
    return len(text)


class Words(Text):
    """A line of text from a point to the right, drawn without being measured before."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw it."""
        if self.get_text():
            x, y = self.get_transform().transform(self.get_position())
            gc = renderer.new_gc()
            gc.set_foreground(self.get_color())
            if renderer.flipy():
                y = renderer.get_canvas_width_height()[1] - y
            shaped = self.get_text(), self.get_fontproperties()
            renderer.draw_text(gc, x, y, *shaped, 0.0, ismath=False, mtext=self)
            gc.restore()


def put(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    """Put a line of text on a page, its baseline's left end at a point (fractions)."""
    line = Words(x, y, text, transform=figure.transSubfigure, **style)
    line.set_figure(figure)
    figure.texts.append(line)


@dataclass
class Cursor:
    """A place on a page for text that runs down it; moves as text is written."""

    figure: Figure
    y: float = TOP

    def write(
        self,
        text: str,
        *,
        size: float = 8.0,
        weight: str = "normal",
        colour: str = "black",
        x: float = LEFT,
        right: float = RIGHT,
        spacing: float = SPACING,
    ) -> None:
        """Write wrapped text and move below it."""
        for line in wrap(printable(text), size, (right - x) * POINTS_PER_WIDTH, weight):
            self.y -= size * spacing / POINTS_PER_HEIGHT
            put(self.figure, x, self.y, line, size=size, weight=weight, color=colour)

    def columns(self, columns: Mapping[float, tuple[str, Sequence[str]]]) -> None:
        """Write a table and move below it.

        Parameters
        ----------
        columns : mapping from float to (str, sequence of str)
            Left edge (fraction of the page) to head and cells.
        """
        size, count = 7.6, max(len(cells) for _, cells in columns.values())
        self.skip(size * 1.35)
        for x, (head, cells) in columns.items():
            put(self.figure, x, self.y, printable(head), size=size, color=MUTED)
            for number, cell in enumerate(cells, start=1):
                if cell:
                    y = self.y - (3.0 + number * size * 1.4) / POINTS_PER_HEIGHT
                    put(self.figure, x, y, printable(cell), size=size)
        self.skip(3.0)
        self.rule()
        self.skip(count * size * 1.4)

    def height(
        self, text: str, *, size: float = 8.0, x: float = LEFT, right: float = RIGHT
    ) -> float:
        """Height that :meth:`write` would take, as a fraction of the page."""
        lines = wrap(printable(text), size, (right - x) * POINTS_PER_WIDTH)
        return len(lines) * size * SPACING / POINTS_PER_HEIGHT

    def labelled(self, label: str, text: str, *, size: float = 8.0, x: float = LEFT) -> None:
        """Write a bold label, text beside it, and move below the text."""
        top = self.y
        self.write(label, size=size, weight="bold", x=x, right=x + LABEL_WIDTH)
        self.y = top
        self.write(text, size=size, x=x + LABEL_WIDTH)

    def row(
        self, edges: Sequence[float], cells: Sequence[str], *, head: bool = False,
        colour: str = "black",
    ) -> None:  # fmt: skip
        """Write one row of a table, each cell cut at the next left edge; a line below a head."""
        self.y -= ROW_SIZE * 1.45 / POINTS_PER_HEIGHT
        for x, end, text in zip(edges, (*edges[1:], RIGHT), cells, strict=True):
            cut = shorten(printable(text), ROW_SIZE, (end - x) * POINTS_PER_WIDTH - 4.0)
            put(self.figure, x, self.y, cut, size=ROW_SIZE, color=MUTED if head else colour)
        if head:
            self.skip(2.5)
            self.rule()

    def skip(self, points: float) -> None:
        """Leave a gap."""
        self.y -= points / POINTS_PER_HEIGHT

    def rule(self, colour: str = RULE) -> None:
        """Draw a thin line across the page."""
        self.figure.add_artist(
            mpl.lines.Line2D([LEFT, RIGHT], [self.y, self.y], color=colour, lw=0.6)
        )


def page(title: str, lead: str = "") -> tuple[Figure, Cursor]:
    """Start a page with a heading and a sentence that says what to see."""
    figure = Figure(figsize=A4_INCHES)
    cursor = Cursor(figure)
    cursor.write(title, size=13, weight="bold")
    if lead:
        cursor.skip(2)
        cursor.write(lead, size=8.0, colour=MUTED)
    cursor.skip(6)
    return figure, cursor


def appendix(title: str) -> str:
    """Title of a page that stands after the core.

    >>> appendix("Notes by the student")
    'Appendix: notes by the student'
    """
    return f"Appendix: {title[0].lower()}{title[1:]}"


def panel(
    cursor: Cursor, title: str, say: str, height_points: float, *, left: float = PANEL_LEFT,
    right: float = RIGHT, above: float = 4.0,
) -> Axes:  # fmt: skip
    """Axes below their title and the sentence that says what to see; the cursor moves below them.

    Parameters
    ----------
    height_points : float
        Of the axes alone.
    above : float
        Points between the sentence and the axes.
    """
    cursor.write(title, size=9.0, weight="bold", x=left - PANEL_LEFT + LEFT, right=right)
    cursor.write(say, size=8.0, x=left - PANEL_LEFT + LEFT, right=right)
    cursor.skip(above)
    height = height_points / POINTS_PER_HEIGHT
    cursor.y -= height
    axes = cursor.figure.add_axes((left, cursor.y, right - left, height))
    axes.xaxis.set_major_locator(MaxNLocator(8))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    return axes


def level(beside: Sequence[Axes]) -> float:
    """Move axes that stand beside one another to the lowest of them; returns how low that is."""
    lowest = min(float(axes.get_position().y0) for axes in beside)
    for axes in beside:
        box = axes.get_position()
        axes.set_position((box.x0, lowest, box.width, box.height))
    return lowest


def legend_beside_title(axes: Axes, top: float, **options: Any) -> None:
    """Legend of a panel on the line of its title, at the right, where nothing lies beneath.

    Parameters
    ----------
    top : float
        Where the cursor stood before the panel.
    """
    figure, right = axes.figure, axes.get_position().x1
    axes.legend(
        loc="lower right", bbox_to_anchor=(right, top - 12.5 / POINTS_PER_HEIGHT), ncols=9,
        bbox_transform=figure.transFigure, borderaxespad=0.0, borderpad=0.0, columnspacing=1.2,
        **options,
    )  # fmt: skip


def bare_x(axes: Axes) -> None:
    """Leave out the numbers of an x axis that another below it shows."""
    axes.tick_params(axis="x", labelbottom=False)


def below(cursor: Cursor, text: str, *, points: float = 1.0) -> None:
    """Write numbers under an axes of the page's width."""
    cursor.skip(points)
    cursor.write(text, size=7.0, colour=MUTED, spacing=1.25)


def caption(axes: Axes, text: str, *, size: float = 7.0) -> None:
    """Numbers below an axes (below its x label, if it has one yet), wrapped to its width."""
    box = axes.get_position()
    offset_points = 24.0 if axes.get_xlabel() else 5.0
    lines = wrap(printable(text), size, box.width * POINTS_PER_WIDTH)
    axes.figure.text(
        box.x0, box.y0 - offset_points / POINTS_PER_HEIGHT, "\n".join(lines), size=size,
        color=MUTED, va="top", linespacing=1.25,
    )  # fmt: skip


def empty(axes: Axes, reason: str) -> None:
    """Say in an axes why there is nothing to draw."""
    axes.set_axis_off()
    width = max(20, int(axes.get_position().width * 95))
    axes.text(
        0.5, 0.5, textwrap.fill(reason, width), ha="center", va="center", size=7.5, color=MUTED,
        transform=axes.transAxes,
    )  # fmt: skip


def thin(time: Array, value: Array, limit: int = MAX_POINTS) -> tuple[Array, Array]:
    """Thin a series to at most ``limit`` points, keeping the extremes of every bucket."""
    if len(time) <= limit:
        return time, value
    size, larger = divmod(len(time), limit // 2)
    cut, keep = larger * (size + 1), []
    for first, last, width in ((0, cut, size + 1), (cut, len(time), size)):
        buckets, starts = value[first:last].reshape(-1, width), np.arange(first, last, width)
        keep += [starts + buckets.argmin(axis=1), starts + buckets.argmax(axis=1)]
    kept = np.unique(np.concatenate(keep))
    return time[kept], value[kept]
