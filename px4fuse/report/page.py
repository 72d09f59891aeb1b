"""A report as data: titles, sentences, tables and panels in order, which ``report.typ`` sets.

What is written here is words and numbers; Typst breaks lines and pages. Text from outside (names,
notes) is data too, and is never read as markup.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from px4fuse.report import fonts
from px4fuse.report.style import MUTED

# Points: width of the text, of the numbers beside an axes, of the labels before sentences
WIDTH, AXIS_LEFT, LABEL = 512.0, 26.0, 52.0
# Points below an axes for its numbers, and for its label
TICKS, AXIS_LABEL, BARE = 12.0, 11.0, 3.0
Block = dict[str, Any]
Cell = str | tuple[str, str]


class Page:
    """A part of a report that begins on a new page, or a column of one.

    Attributes
    ----------
    blocks : list of Block
        What was written, in order; panels hold their figures until :meth:`data`.
    """

    def __init__(self, title: str = "", lead: str = "", *, width: float = WIDTH) -> None:
        self.blocks: list[Block] = []
        self.width = width
        if title:
            self.blocks.append({"kind": "title", "text": title, "lead": printable(lead)})

    def write(
        self, text: str, *, size: float = 8.0, bold: bool = False, colour: str = "black",
        above: float = 0.0,
    ) -> None:  # fmt: skip
        """Write a paragraph, so many points below what stands above."""
        if text:
            self.blocks.append({"kind": "text", "above": above, **_words(text, size, bold, colour)})

    def heading(self, text: str, size: float = 9.0, above: float = 6.0) -> None:
        """Write a heading within the page."""
        self.blocks.append({"kind": "heading", "above": above, **_words(text, size, True, "black")})

    def labelled(
        self, label: str, *texts: str, size: float = 8.0, beside: Sequence[Block] = (),
        width: float = LABEL, above: float = 0.0, colour: str = "black", bold: bool = True,
    ) -> None:  # fmt: skip
        """Write a label, and sentences beside it; ``beside`` in their place has its own looks."""
        words = list(beside) or [_words(text, size) for text in texts]
        left = [_words(part, size, bold, colour) for part in label.split("\n") if part]
        self.blocks.append(
            {"kind": "labelled", "left": left, "right": words, "width": width, "above": above}
        )

    def table(
        self, head: Sequence[str], rows: Sequence[Sequence[Cell]], *,
        shares: Sequence[float] | None = None, right: Sequence[int] = (), size: float = 7.4,
    ) -> None:  # fmt: skip
        """Write a table.

        Parameters
        ----------
        head : sequence of str
        rows : sequence of sequence of str, or of (str, colour)
        shares : sequence of float, optional
            Widths of the columns; by default as wide as their words, and the page is shared.
        right : sequence of int
            Columns of numbers, which stand at the right.
        """
        cells = [
            [{"text": printable(text), "colour": colour} for text, colour in map(_coloured, row)]
            for row in rows
        ]
        align = ["right" if at in right else "left" for at in range(len(head))]
        self.blocks.append(
            {"kind": "table", "head": [printable(cell) for cell in head], "rows": cells,
             "align": align, "shares": shares, "size": size}
        )  # fmt: skip

    def panel(
        self, title: str, say: str, height: float, *, above: float = 4.0, left: float = AXIS_LEFT,
        right: float = 8.0, below: float = 0.0,
    ) -> Axes:  # fmt: skip
        """Axes of the column's width below a title and the sentence that says what to see.

        Parameters
        ----------
        height : float
            Of the axes alone, in points.
        above, left, right, below : float
            Points around the axes; below them those for ticks and label are added.
        """
        figure = Figure(figsize=(self.width / 72.0, (above + height + below + 24.0) / 72.0))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.blocks.append(
            {"kind": "panel", "title": title, "say": printable(say), "figure": figure,
             "axes": axes, "around": (left, right, below, above), "height": height}
        )  # fmt: skip
        axes.xaxis.set_major_locator(MaxNLocator(8))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        _place(self.blocks[-1], self.width)
        return axes

    def drawing(self, figure: Figure, alt: str) -> None:
        """A figure as it is, with the sentence that a screen reader gets."""
        self.blocks.append({"kind": "drawing", "figure": figure, "alt": alt})

    def legend(self, *rows: Sequence[Artist]) -> None:
        """Legend of several panels, a line for each row of entries."""
        kept = [row for row in rows if row]
        figure = Figure(figsize=(self.width / 72.0, 13.0 * len(kept) / 72.0))
        for place, entries in enumerate(kept):
            figure.legend(
                handles=entries, loc="upper left", ncols=len(entries), borderaxespad=0.0,
                borderpad=0.0, bbox_to_anchor=(0.0, 1.0 - place / len(kept)), handlelength=2.0,
                columnspacing=1.2,
            )  # fmt: skip
        named = ", ".join(str(artist.get_label()) for row in kept for artist in row)
        self.drawing(figure, f"Legend: {named}")

    def numbers(self, text: str) -> None:
        """Write the numbers of the panel above in small letters."""
        self.write(text, size=7.0, colour=MUTED, above=-1.0)

    def beside(self, *columns: Page, gap: float = 14.0) -> None:
        """Put columns beside one another."""
        self.blocks.append(
            {"kind": "beside", "columns": [column.blocks for column in columns], "gap": gap,
             "widths": [column.width for column in columns]}
        )  # fmt: skip

    def note(
        self, text: str, size: float, bold: bool, colour: str, *, indent: float, mark: str,
        above: float,
    ) -> None:  # fmt: skip
        """Write a paragraph of somebody's own words, so many points to the right, with its mark."""
        self.blocks.append(
            {"kind": "note", "indent": indent, "mark": mark, "above": above,
             **_words(text, size, bold, colour)}
        )  # fmt: skip

    def foot(self, part: Page) -> None:
        """Put a part at the foot of this page; what does not fit above goes to the next one."""
        self.blocks.append({"kind": "foot", "blocks": part.blocks})

    def skip(self, points: float) -> None:
        """Leave a gap."""
        self.blocks.append({"kind": "skip", "points": points})

    def rule(self) -> None:
        """Draw a thin line across."""
        self.blocks.append({"kind": "rule"})


def halves(first: float = 0.5, gap: float = 14.0) -> tuple[Page, Page]:
    """Two columns that share the width of a page."""
    left = first * (WIDTH - gap)
    return Page(width=left), Page(width=WIDTH - gap - left)


def words(text: str, size: float, colour: str = "black") -> Block:
    """A sentence with its looks, for :meth:`Page.labelled`."""
    return _words(text, size, colour=colour)


def appendix(title: str) -> str:
    """Title of a page that stands after the core.

    >>> appendix("Notes by the student")
    'Appendix: notes by the student'
    """
    return f"Appendix: {title[0].lower()}{title[1:]}"


def legend_above(axes: Axes, **options: Any) -> None:
    """Legend of a panel in the line above its axes, at the right, where nothing lies beneath."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=9, borderaxespad=0.0, borderpad=0.1,
        columnspacing=1.2, **options,
    )  # fmt: skip


def printable(text: str) -> str:
    """Text without control characters, and a white square for what no font here can draw."""
    return "".join(
        character if character == "\n" or fonts.font_of(character) else fonts.NO_GLYPH
        for character in text.expandtabs(4)
        if character == "\n" or character.isprintable()
    )


def data(blocks: Sequence[Block]) -> list[Block]:
    """Blocks as Typst takes them: figures as SVG."""
    return [_serialised(block) for block in blocks]


def _serialised(block: Block) -> Block:
    made = dict(block)
    if block["kind"] == "beside":
        made["columns"] = [data(column) for column in block["columns"]]
    elif block["kind"] == "foot":
        made["blocks"] = data(block["blocks"])
    elif "figure" in block:
        figure: Figure = made.pop("figure")
        if made.pop("axes", None) is not None:
            _place(block, 72.0 * figure.get_figwidth())
            del made["around"], made["height"]
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
        made["svg"] = drawn.getvalue()
        made["width"] = 72.0 * figure.get_figwidth()
    return made


def _place(block: Mapping[str, Any], width: float) -> None:
    """Give the axes of a panel their place, with room for the ticks and the label that they have.

    The figure is as high as that asks for.
    """
    axes: Axes = block["axes"]
    left, right, below, above = block["around"]
    shown = axes.axison and axes.xaxis.get_tick_params()["labelbottom"]
    below += (TICKS if shown else BARE) + (AXIS_LABEL if axes.get_xlabel() else 0.0)
    total = above + block["height"] + below
    block["figure"].set_size_inches(width / 72.0, total / 72.0)
    axes.set_position(
        (left / width, below / total, (width - left - right) / width, block["height"] / total)
    )


def _words(text: str, size: float, bold: bool = False, colour: str = "black") -> Block:
    return {
        "text": printable(text), "size": size, "colour": _hex(colour),
        "weight": "bold" if bold else "regular",
    }  # fmt: skip


def _coloured(cell: Cell) -> tuple[str, str]:
    text, colour = cell if isinstance(cell, tuple) else (cell, "black")
    return text, _hex(colour)


def _hex(colour: str) -> str:
    return "#000000" if colour == "black" else colour
