"""Page of a report: titles, texts, tables and plots, for PDF and terminal."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from px4fuse.core.text import with_log_name
from px4fuse.report.style import FONT, MUTED_COLOUR, Artist, Axes
from px4fuse.report.ticks import replace_ticks

PAGE_WIDTH = 178.0 * 72.0 / 25.4  # points
COLUMN_GAP = 5.0 * 72.0 / 25.4  # points, between two columns
LABEL_WIDTH = 52.0  # points, of the labels beside texts
AXES_LEFT_MARGIN = 30.0  # points, for tick labels
AXES_RIGHT_MARGIN = 8.0  # points
LEGEND_LINE_HEIGHT = 12.0  # points
LEGEND_HANDLE_WIDTH = 30.0  # points, of the line sample with gaps
TICKS_HEIGHT = 12.0  # points, of tick labels
AXIS_LABEL_HEIGHT = 12.5  # points
UNLABELLED_HEIGHT = 3.0  # points, below axes without tick labels
# Printed characters for which str.isprintable is False
PRINTED_SPECIAL_CHARACTERS = "\n\N{NO-BREAK SPACE}"
# PDF/A limits strings to 32,767 characters, so very long words are split
LONG_WORD_PATTERN = re.compile(r"[^ \n]{100}(?=[^ \n]{400})")
PageBlock = dict[str, Any]
Cell = str | tuple[str, str]


class Page:
    """Titles, texts, tables and plots of a page or column."""

    def __init__(self, title: str = "", lead_text: str = "", *, width: float = PAGE_WIDTH) -> None:
        self.blocks: list[PageBlock] = []
        self.width = width
        if title:
            self.add("title", text=title, lead=lead_text)

    def add(self, kind: str, **fields: Any) -> PageBlock:
        """Add a block of a kind that ``report.typ`` defines, and return it."""
        self.blocks.append({"kind": kind, **fields})
        return self.blocks[-1]

    def write(
        self,
        text: str,
        *,
        size: float = 8.0,
        bold: bool = False,
        colour: str = "black",
        gap_above: float = 0.0,
        indent: float = 0.0,
        marker: str = "",
    ) -> None:
        """Write a paragraph; lengths are in points."""
        if text or marker:
            block = styled_text(text, size, colour, bold)
            self.add("text", above=gap_above, indent=indent, mark=marker, **block)

    def write_heading(self, text: str) -> None:
        self.add("heading", **styled_text(text, 9.5, bold=True))

    def write_small_text(self, text: str) -> None:
        self.write(text, colour=MUTED_COLOUR, gap_above=-1.0)

    def write_labelled(
        self,
        label: str,
        *texts: str | PageBlock,
        label_width: float = LABEL_WIDTH,
        gap_above: float = 0.0,
        colour: str = "black",
        bold: bool = True,
    ) -> None:
        styled_texts = [styled_text(text) if isinstance(text, str) else text for text in texts]
        styled_label = styled_text(label, 8.0, colour, bold)
        self.add(
            "labelled",
            label=styled_label,
            texts=styled_texts,
            width=label_width,
            above=gap_above,
        )

    def write_labelled_texts(self, texts: Mapping[str, str]) -> None:
        for label, text in texts.items():
            self.write_labelled(label, text)

    def add_table(
        self,
        head: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        column_widths: Sequence[float] | None = None,
        right_aligned_columns: Sequence[int] = (),
    ) -> None:
        """Add a table with a heading row.

        Parameters
        ----------
        head : sequence of str
        rows : sequence of sequence of str, or of (str, colour)
        column_widths : sequence of float, optional
            Relative widths of the columns.
        right_aligned_columns : sequence of int
            Indices of right-aligned columns.
        """
        self.add(
            "table",
            head=head,
            rows=rows,
            column_widths=column_widths,
            right=right_aligned_columns,
        )

    def add_panel(
        self,
        title: str,
        height: float,
        *,
        caption: str = "",
        gap_above: float = 4.0,
        left_margin: float = AXES_LEFT_MARGIN,
        right_margin: float = AXES_RIGHT_MARGIN,
        is_compact: bool = False,
    ) -> Axes:
        """Add axes with a title and a caption, and return the axes; lengths are in points."""
        # slow import (0.3 s), which texts do not need
        from matplotlib.figure import Figure  # noqa: PLC0415

        axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
        axes.locator_params(axis="x", nbins=8)
        axes.locator_params(axis="y", nbins=4)
        block = self.add(
            "panel",
            title=title,
            caption=caption,
            alt=": ".join(filter(None, (title, caption))),
            axes=axes,
            margins=(left_margin, right_margin, gap_above),
            height=height,
            width=self.width,
            figure=axes.figure,
            compact=is_compact,
        )
        _place_axes(block)
        return axes

    def add_legend(self, entries: Iterable[Artist]) -> PageBlock:
        from matplotlib.figure import Figure  # noqa: PLC0415

        rows: list[list[Artist]] = [[]]
        used_width = 0.0
        for entry in entries:
            width = measure_text_width(str(entry.get_label())) + LEGEND_HANDLE_WIDTH
            if rows[-1] and used_width + width > self.width:
                rows.append([])
                used_width = 0.0
            rows[-1].append(entry)
            used_width += width
        height = LEGEND_LINE_HEIGHT * len(rows)
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
        return self.add(
            "legend", alt=f"Legend: {labels}", width=self.width, height=height, figure=figure
        )

    def add_columns(self, *columns: Page, gap_above: float = 6.0) -> None:
        blocks, widths = [column.blocks for column in columns], [column.width for column in columns]
        self.add("columns", columns=blocks, widths=widths, gap=COLUMN_GAP, above=gap_above)


def make_two_columns(left_fraction: float = 0.5) -> tuple[Page, Page]:
    """Return two columns that fill the page width."""
    free_width = PAGE_WIDTH - COLUMN_GAP
    return Page(width=left_fraction * free_width), Page(width=(1.0 - left_fraction) * free_width)


def styled_text(
    text: str, size: float = 8.0, colour: str = "black", bold: bool = False
) -> PageBlock:
    """Return a text with its size (points), colour and weight."""
    return {"text": text, "size": size, "colour": colour, "weight": "bold" if bold else "regular"}


def measure_text_width(text: str) -> float:
    """Return the width (points) of a text in DejaVu Sans of 8 points."""
    from matplotlib import font_manager  # noqa: PLC0415 - as in :meth:`Page.add_panel`

    font = font_manager.get_font(font_manager.findfont(FONT))
    # widths are rounded to whole points, so the measured font is large
    font.set_size(100.0, 72.0)
    font.set_text(text, 0.0)
    return float(font.get_width_height()[0]) / 64.0 * 0.08


def count_wrapped_lines(text: str, width: float) -> int:
    """Return the number of lines of a text with a given width (points)."""
    lines, used_width = 1, 0.0
    for word in text.split(" "):
        word_width = measure_text_width(f"{word} ")
        if used_width and used_width + measure_text_width(word) > width:
            lines, used_width = lines + 1, 0.0
        used_width += word_width
    return lines


def make_appendix_title(title: str) -> str:
    """Return the title of an appendix page.

    >>> make_appendix_title("Notes by the student")
    'Appendix: notes by the student'
    """
    return f"Appendix: {title[0].lower()}{title[1:]}"


def draw_legend_above(axes: Axes) -> None:
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
    """Replace or remove characters that cannot be printed, and split long words."""
    from px4fuse.report import fonts  # noqa: PLC0415 - as in :meth:`Page.add_panel`

    return "".join(
        character
        if character in PRINTED_SPECIAL_CHARACTERS or fonts.find_font(character)
        else fonts.MISSING_GLYPH_SYMBOL
        for character in LONG_WORD_PATTERN.sub(r"\g<0>\n", text.expandtabs(4))
        if character in PRINTED_SPECIAL_CHARACTERS or character.isprintable()
    )


def to_typst_data(block: Any, log_name: str) -> Any:
    """Convert page blocks to data for Typst, with figures as SVG."""
    if isinstance(block, str):
        return replace_unprintable(with_log_name(block, log_name))
    if isinstance(block, Mapping):
        fields = {
            name: to_typst_data(value, log_name)
            for name, value in block.items()
            if name not in ("figure", "axes")
        }
        return fields | ({"svg": _render_figure_svg(block)} if "figure" in block else {})
    if isinstance(block, Sequence):
        return [to_typst_data(item, log_name) for item in block]
    return block


def _render_figure_svg(block: Mapping[str, Any]) -> str:
    if "axes" in block:
        _place_axes(block)
        replace_ticks(block["axes"], measure_text_width)
    buffer = io.StringIO()
    block["figure"].savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _place_axes(block: Mapping[str, Any]) -> None:
    axes, width, height = block["axes"], block["width"], block["height"]
    left_margin, right_margin, top_margin = block["margins"]
    has_tick_labels = axes.axison and axes.xaxis.get_tick_params()["labelbottom"]
    bottom_margin = (TICKS_HEIGHT if has_tick_labels else UNLABELLED_HEIGHT) + (
        AXIS_LABEL_HEIGHT if axes.get_xlabel() else 0.0
    )
    total_height = top_margin + height + bottom_margin
    block["figure"].set_size_inches(width / 72.0, total_height / 72.0)
    axes.set_position(
        (
            left_margin / width,
            bottom_margin / total_height,
            (width - left_margin - right_margin) / width,
            height / total_height,
        )
    )
