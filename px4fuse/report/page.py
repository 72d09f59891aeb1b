"""Pages as data: ordered blocks of titles, text, tables and panels.

``report.typ`` sets them as PDF, :mod:`px4fuse.report.screen` prints text and tables on the
terminal. Text from outside (names, notes) is data and is never interpreted as markup.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from px4fuse.core.text import with_log_name
from px4fuse.report.style import FONT, MUTED_COLOUR, Artist, Axes

# points; widths of the text, of the tick labels left of axes, of the labels before texts
PAGE_WIDTH, AXIS_LEFT, LABEL_WIDTH = 178.0 * 72.0 / 25.4, 30.0, 52.0
# points; gap between two columns of 86.5 mm, margin right of axes
COLUMN_GAP, AXES_RIGHT = 5.0 * 72.0 / 25.4, 8.0
# points; of a legend: height of a line, and width of the line and the gaps of an entry
LEGEND_LINE, LEGEND_HANDLE = 12.0, 30.0
# points; heights below axes for tick labels, for the axis label, and without tick labels
TICKS_HEIGHT, AXIS_LABEL_HEIGHT, UNLABELLED_HEIGHT = 12.0, 12.5, 3.0
ALLOWED_CHARACTERS = "\n\N{NO-BREAK SPACE}"  # printed, although str.isprintable is False
# Words this long are split, because PDF/A limits strings to 32,767 characters
LONG_WORD = re.compile(r"[^ \n]{100}(?=[^ \n]{400})")
Block = dict[str, Any]
Cell = str | tuple[str, str]


class Page:
    """Section of a report, or a column of a section.

    Attributes
    ----------
    blocks : list of Block
        Content in order; panels contain their figures until :func:`to_typst_data` converts them.
    """

    def __init__(self, title: str = "", lead: str = "", *, width: float = PAGE_WIDTH) -> None:
        self.blocks: list[Block] = []
        self.width = width
        if title:
            self.add("title", text=title, lead=lead)

    def add(self, kind: str, **fields: Any) -> Block:
        """Add a block of a kind that ``report.typ`` sets, and return it."""
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
        """Write a paragraph; `above` and `indent` in points, `mark` before a list item."""
        if text or mark:
            block = styled_text(text, size, colour, bold)
            self.add("text", above=above, indent=indent, mark=mark, **block)

    def heading(self, text: str, size: float = 9.0, above: float = 6.0) -> None:
        """Write a heading within the page."""
        self.add("heading", above=above, **styled_text(text, size, bold=True))

    def write_small(self, text: str) -> None:
        """Write a text in small print, such as the numbers of the panel above."""
        self.write(text, colour=MUTED_COLOUR, above=-1.0)

    def write_labelled(
        self,
        label: str,
        *texts: str | Block,
        size: float = 8.0,
        width: float = LABEL_WIDTH,
        above: float = 0.0,
        colour: str = "black",
        bold: bool = True,
    ) -> None:
        """Write a label with paragraphs beside it, styled by :func:`styled_text`."""
        styled_texts = [
            styled_text(text, size) if isinstance(text, str) else text for text in texts
        ]
        styled_label = styled_text(label, size, colour, bold)
        self.add("labelled", label=styled_label, texts=styled_texts, width=width, above=above)

    def write_labelled_texts(self, texts: Mapping[str, str], size: float = 8.0) -> None:
        """Write each text of a mapping beside its label."""
        for label, text in texts.items():
            self.write_labelled(label, text, size=size)

    def table(
        self,
        head: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        column_widths: Sequence[float] | None = None,
        right_aligned_columns: Sequence[int] = (),
        size: float = 8.0,
    ) -> None:
        """Add a table with a heading row.

        Parameters
        ----------
        head : sequence of str
        rows : sequence of sequence of str, or of (str, colour)
        column_widths : sequence of float, optional
            Relative widths of the columns; by default they follow the content.
        right_aligned_columns : sequence of int
            Right-aligned columns (numbers).
        """
        self.add(
            "table",
            head=head,
            rows=rows,
            column_widths=column_widths,
            right=right_aligned_columns,
            size=size,
        )

    def panel(
        self,
        title: str,
        caption: str,
        height: float,
        *,
        above: float = 4.0,
        left: float = AXIS_LEFT,
        right: float = AXES_RIGHT,
        space_below: float = 0.0,
        is_compact: bool = False,
    ) -> Axes:
        """Add axes as wide as the column, below a title and a caption; return them.

        Parameters
        ----------
        height : float
            Height of the axes alone (points).
        above, left, right, space_below : float
            Margins of the axes (points); the height of tick and axis labels is added below.
        is_compact : bool
            Small title and gaps, for the cover.
        """
        # imported here because matplotlib takes 0.3 s, which text-only commands save
        from matplotlib.figure import Figure  # noqa: PLC0415

        axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
        axes.locator_params(axis="x", nbins=8)
        axes.locator_params(axis="y", nbins=4)
        margins = left, right, space_below, above
        alt = ": ".join(filter(None, (title, caption)))
        block = self.add(
            "panel",
            title=title,
            caption=caption,
            alt=alt,
            axes=axes,
            margins=margins,
            height=height,
            width=self.width,
            figure=axes.figure,
            compact=is_compact,
        )
        _place_axes(block)
        return axes

    def legend(self, entries: Iterable[Artist]) -> Block:
        """Add a legend for several panels, on as many lines as its entries need."""
        from matplotlib.figure import Figure  # noqa: PLC0415

        rows: list[list[Artist]] = [[]]
        free_width = self.width
        for entry in entries:
            width = text_width(str(entry.get_label())) + LEGEND_HANDLE
            if rows[-1] and width > free_width:
                rows.append([])
                free_width = self.width
            rows[-1].append(entry)
            free_width -= width
        height = LEGEND_LINE * len(rows)
        figure = Figure(figsize=(self.width / 72.0, height / 72.0))
        for row_index, row in enumerate(rows):
            figure.legend(
                handles=row,
                loc="upper left",
                ncols=len(row),
                borderaxespad=0.0,
                borderpad=0.0,
                bbox_to_anchor=(0.0, 1.0 - row_index / len(rows)),
                handlelength=2.0,
                handletextpad=0.5,
                columnspacing=1.2,
            )
        labels = ", ".join(str(artist.get_label()) for row in rows for artist in row)
        alt = f"Legend: {labels}"
        return self.add(
            "panel",
            title="",
            caption="",
            alt=alt,
            width=self.width,
            height=height,
            figure=figure,
            compact=False,
        )

    def add_columns(self, *columns: Page, gap: float = COLUMN_GAP, above: float = 6.0) -> None:
        """Add columns side by side; `gap` between and space `above` them in points."""
        blocks, widths = [column.blocks for column in columns], [column.width for column in columns]
        self.add("columns", columns=blocks, widths=widths, gap=gap, above=above)


def halves(left_fraction: float = 0.5, gap: float = COLUMN_GAP) -> tuple[Page, Page]:
    """Return two columns that fill the page width; `left_fraction` belongs to the left column."""
    left = left_fraction * (PAGE_WIDTH - gap)
    return Page(width=left), Page(width=PAGE_WIDTH - gap - left)


def styled_text(text: str, size: float, colour: str = "black", bold: bool = False) -> Block:
    """Return a text with its size (points), colour and weight."""
    return {"text": text, "size": size, "colour": colour, "weight": "bold" if bold else "regular"}


def text_width(text: str, size: float = 8.0) -> float:
    """Return the width (points) of a text in DejaVu Sans."""
    from matplotlib import font_manager  # noqa: PLC0415 - as in :meth:`Page.panel`

    font = font_manager.get_font(font_manager.findfont(FONT))
    # at a large size, because glyphs of a small one are rounded to whole points
    font.set_size(100.0, 72.0)
    font.set_text(text, 0.0)
    return float(font.get_width_height()[0]) / 64.0 * size / 100.0


def line_count(text: str, width: float, size: float = 8.0) -> int:
    """Return the number of lines of a text that wraps at a width (points)."""
    lines, used_width = 1, 0.0
    for word in text.split(" "):
        word_width = text_width(f"{word} ", size)
        if used_width and used_width + text_width(word, size) > width:
            lines, used_width = lines + 1, 0.0
        used_width += word_width
    return lines


def appendix_title(title: str) -> str:
    """Return the title of an appendix page.

    >>> appendix_title("Notes by the student")
    'Appendix: notes by the student'
    """
    return f"Appendix: {title[0].lower()}{title[1:]}"


def draw_legend_above(axes: Axes) -> None:
    """Draw the legend of a panel above its axes, at the right."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=9,
        borderaxespad=0.0,
        borderpad=0.1,
        columnspacing=1.2,
        handlelength=1.4,
    )


def replace_unprintable(text: str) -> str:
    """Remove control characters, split long words, replace characters without a font by □."""
    from px4fuse.report import fonts  # noqa: PLC0415 - as in :meth:`Page.panel`

    return "".join(
        character if character in ALLOWED_CHARACTERS or fonts.font_of(character) else fonts.NO_GLYPH
        for character in LONG_WORD.sub(r"\g<0>\n", text.expandtabs(4))
        if character in ALLOWED_CHARACTERS or character.isprintable()
    )


def to_typst_data(block: Any, log: str) -> Any:
    """Convert blocks for Typst: printable text, commands with the log's name, figures as SVG."""
    if isinstance(block, str):
        return replace_unprintable(with_log_name(block, log))
    if isinstance(block, Mapping):
        fields = {
            name: to_typst_data(value, log)
            for name, value in block.items()
            if name not in ("figure", "axes")
        }
        return fields | ({"svg": _figure_svg(block)} if "figure" in block else {})
    if isinstance(block, Sequence):
        return [to_typst_data(item, log) for item in block]
    return block


def _figure_svg(block: Mapping[str, Any]) -> str:
    if "axes" in block:
        _place_axes(block)
    buffer = io.StringIO()
    block["figure"].savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _place_axes(block: Mapping[str, Any]) -> None:
    """Set the height of the figure and the place of its axes, with room for the labels it has."""
    axes, width, height = block["axes"], block["width"], block["height"]
    left, right, below, above = block["margins"]
    has_tick_labels = axes.axison and axes.xaxis.get_tick_params()["labelbottom"]
    below += (TICKS_HEIGHT if has_tick_labels else UNLABELLED_HEIGHT) + (
        AXIS_LABEL_HEIGHT if axes.get_xlabel() else 0.0
    )
    total_height = above + height + below
    block["figure"].set_size_inches(width / 72.0, total_height / 72.0)
    axes.set_position(
        (left / width, below / total_height, (width - left - right) / width, height / total_height)
    )
