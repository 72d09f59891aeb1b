"""What is shown, as data: titles, sentences, tables and panels in order.

``report.typ`` sets a page as PDF, :mod:`px4fuse.report.screen` prints its words and tables on the
terminal. Text from outside (names, notes) is data too, and is never read as markup.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

from px4fuse.report.style import MUTED_COLOUR, Artist, Axes

# Points: width of the text, of the numbers beside an axes, of the labels before sentences
PAGE_WIDTH, AXIS_LEFT, LABEL_WIDTH = 512.0, 26.0, 52.0
# Points below an axes for its numbers, and for its label
TICKS_HEIGHT, AXIS_LABEL_HEIGHT, BARE_HEIGHT = 12.0, 11.0, 3.0
ALLOWED_CHARACTERS = "\n\N{NO-BREAK SPACE}"  # though not printable by themselves
# What has no place to break a line: PDF/A takes no string of 32,768 characters, and no page a line
LONG_WORD = re.compile(r"[^ \n]{100}(?=[^ \n]{400})")
Block = dict[str, Any]
Cell = str | tuple[str, str]


class Page:
    """A part of a report that begins on a new page, or a column of one.

    Attributes
    ----------
    blocks : list of Block
        What was written, in order; panels hold their figures until :func:`data`.
    """

    def __init__(self, title: str = "", lead: str = "", *, width: float = PAGE_WIDTH) -> None:
        self.blocks: list[Block] = []
        self.width = width
        if title:
            self.add("title", text=title, lead=lead)

    def add(self, kind: str, **fields: Any) -> Block:
        """Add a block of a kind that ``report.typ`` knows."""
        self.blocks.append({"kind": kind, **fields})
        return self.blocks[-1]

    def write(
        self,
        text: str,
        *,
        size: float = 8.0,
        bold: bool = False,
        colour: str = "black",
        above: float = 0.0,
        indent: float = 0.0,
        mark: str = "",
    ) -> None:
        """Write a paragraph, so many points below and to the right, with the mark of a list."""
        if text or mark:
            styled_text = words(text, size, colour, bold)
            self.add("text", above=above, indent=indent, mark=mark, **styled_text)

    def heading(self, text: str, size: float = 9.0, above: float = 6.0) -> None:
        """Write a heading within the page."""
        self.add("heading", above=above, **words(text, size, bold=True))

    def numbers(self, text: str) -> None:
        """Write the numbers of the panel above in small letters."""
        self.write(text, size=7.0, colour=MUTED_COLOUR, above=-1.0)

    def labelled(
        self,
        label: str,
        *texts: str | Block,
        size: float = 8.0,
        width: float = LABEL_WIDTH,
        above: float = 0.0,
        colour: str = "black",
        bold: bool = True,
    ) -> None:
        """Write a label, and beside it sentences, of which :func:`words` have their own looks."""
        styled_texts = [words(text, size) if isinstance(text, str) else text for text in texts]
        styled_label = words(label, size, colour, bold)
        self.add("labelled", label=styled_label, texts=styled_texts, width=width, above=above)

    def advice(self, texts: Mapping[str, str], size: float = 8.0) -> None:
        """Write sentences, each with its label."""
        for label, text in texts.items():
            self.labelled(label, text, size=size)

    def table(
        self,
        head: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        shares: Sequence[float] | None = None,
        right: Sequence[int] = (),
        size: float = 7.4,
    ) -> None:
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
        self.add("table", head=head, rows=rows, shares=shares, right=right, size=size)

    def panel(
        self,
        title: str,
        say: str,
        height: float,
        *,
        above: float = 4.0,
        left: float = AXIS_LEFT,
        right: float = 8.0,
        below: float = 0.0,
    ) -> Axes:
        """Axes of the column's width below a title and the sentence that says what to see.

        Parameters
        ----------
        height : float
            Of the axes alone, in points.
        above, left, right, below : float
            Points around the axes; below them those for ticks and label are added.
        """
        # matplotlib costs a third of a second: not where words alone are shown
        from matplotlib.figure import Figure  # noqa: PLC0415

        axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
        axes.locator_params(axis="x", nbins=8)
        axes.locator_params(axis="y", nbins=4)
        around = left, right, below, above
        alt = ": ".join(filter(None, (title, say)))
        block = self.add(
            "panel",
            title=title,
            say=say,
            alt=alt,
            axes=axes,
            around=around,
            height=height,
            width=self.width,
            figure=axes.figure,
        )
        _place_axes(block)
        return axes

    def legend(self, *rows: Sequence[Artist]) -> None:
        """Legend of several panels, a line for each row of entries."""
        from matplotlib.figure import Figure  # noqa: PLC0415

        visible_rows = [row for row in rows if row]
        figure = Figure(figsize=(self.width / 72.0, 13.0 * len(visible_rows) / 72.0))
        for row_index, entries in enumerate(visible_rows):
            figure.legend(
                handles=entries,
                loc="upper left",
                ncols=len(entries),
                borderaxespad=0.0,
                borderpad=0.0,
                bbox_to_anchor=(0.0, 1.0 - row_index / len(visible_rows)),
                handlelength=2.0,
                columnspacing=1.2,
            )
        labels = ", ".join(str(artist.get_label()) for row in visible_rows for artist in row)
        alt = f"Legend: {labels}"
        self.add("panel", title="", say="", alt=alt, width=self.width, figure=figure)

    def beside(self, *columns: Page, gap: float = 14.0, above: float = 6.0) -> None:
        """Put columns beside one another, so many points below what stands above."""
        blocks, widths = [c.blocks for c in columns], [c.width for c in columns]
        self.add("beside", columns=blocks, widths=widths, gap=gap, above=above)

    def foot(self, part: Page) -> None:
        """Put a part at the foot of this page; what does not fit above goes to the next one."""
        self.add("foot", blocks=part.blocks)


def halves(first: float = 0.5, gap: float = 14.0) -> tuple[Page, Page]:
    """Two columns that share the width of a page."""
    left = first * (PAGE_WIDTH - gap)
    return Page(width=left), Page(width=PAGE_WIDTH - gap - left)


def words(text: str, size: float, colour: str = "black", bold: bool = False) -> Block:
    """A sentence with its looks."""
    return {"text": text, "size": size, "colour": colour, "weight": "bold" if bold else "regular"}


def appendix(title: str) -> str:
    """Title of a page that stands after the core.

    >>> appendix("Notes by the student")
    'Appendix: notes by the student'
    """
    return f"Appendix: {title[0].lower()}{title[1:]}"


def legend_above(axes: Axes, columns: int = 9, **options: Any) -> None:
    """Legend of a panel in the line above its axes, at the right, where nothing lies beneath."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        borderaxespad=0.0,
        borderpad=0.1,
        columnspacing=1.2,
        **options,
    )


def replace_unprintable(text: str) -> str:
    """Text without control characters or endless words, a white square for what no font draws."""
    from px4fuse.report import fonts  # noqa: PLC0415 - as in :meth:`Page.panel`

    return "".join(
        character if character in ALLOWED_CHARACTERS or fonts.font_of(character) else fonts.NO_GLYPH
        for character in LONG_WORD.sub(r"\g<0>\n", text.expandtabs(4))
        if character in ALLOWED_CHARACTERS or character.isprintable()
    )


def data(block: Any) -> Any:
    """Blocks as Typst takes them: text that can be printed, and figures as SVG."""
    if isinstance(block, str):
        return replace_unprintable(block)
    if isinstance(block, Mapping):
        fields = {
            name: data(value) for name, value in block.items() if name not in ("figure", "axes")
        }
        return fields | ({"svg": _figure_svg(block)} if "figure" in block else {})
    if isinstance(block, Sequence):
        return [data(item) for item in block]
    return block


def _figure_svg(block: Mapping[str, Any]) -> str:
    if "axes" in block:
        _place_axes(block)
    buffer = io.StringIO()
    block["figure"].savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _place_axes(block: Mapping[str, Any]) -> None:
    """Give the axes of a panel their place, with room for the ticks and the label that they have.

    The figure is as high as that asks for.
    """
    axes, width, height = block["axes"], block["width"], block["height"]
    left, right, below, above = block["around"]
    has_tick_labels = axes.axison and axes.xaxis.get_tick_params()["labelbottom"]
    below += (TICKS_HEIGHT if has_tick_labels else BARE_HEIGHT) + (
        AXIS_LABEL_HEIGHT if axes.get_xlabel() else 0.0
    )
    total = above + height + below
    block["figure"].set_size_inches(width / 72.0, total / 72.0)
    axes.set_position((left / width, below / total, (width - left - right) / width, height / total))
