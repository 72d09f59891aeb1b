"""Page of a report: titles, texts, tables and plots, for PDF and terminal."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct, structs

from px4fuse.core.text import with_log_name

from .style import MUTED_COLOUR, TEXT_COLOUR, Artist, Axes

PAGE_WIDTH = 178.0 * 72.0 / 25.4  # points
COLUMN_GAP = 5.0 * 72.0 / 25.4  # points, between two columns
LABEL_WIDTH = 52.0  # points, width of the column with labels, such as "Action"
AXES_LEFT_MARGIN = 38.0  # points, for tick labels and axis label
AXES_RIGHT_MARGIN = 8.0  # points
LEGEND_HEIGHT = 12.0  # points, of each line
# Width (points) of the line or symbol before each label of a legend, with margins
LEGEND_HANDLE_WIDTH = 30.0
# Upper limit (points) of the mean character width in the legend, DejaVu Sans of 8 points
LEGEND_CHARACTER_WIDTH = 5.0
TICK_SPACING = 62.0  # points, approximate minimum distance of two ticks
# Height (points) below the axes with and without tick labels and axis label
LABELLED_BOTTOM_MARGIN, UNLABELLED_BOTTOM_MARGIN = 24.5, 3.0
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
        bold: bool = False,
        colour: str = TEXT_COLOUR,
        indent: float = 0.0,
        marker: str = "",
    ) -> None:
        """Write a paragraph; ``indent`` is in points."""
        if text or marker:
            self.add("text", indent=indent, mark=marker, **styled_text(text, colour, bold=bold))

    def write_heading(self, text: str) -> None:
        self.add("heading", **styled_text(text, bold=True))

    def write_muted_text(self, text: str) -> None:
        self.write(text, colour=MUTED_COLOUR)

    def write_labelled_text(
        self,
        label: str,
        *texts: str | PageBlock,
        label_width: float = LABEL_WIDTH,
        colour: str = TEXT_COLOUR,
    ) -> None:
        """Add texts with a bold label to their left."""
        styled_texts = [styled_text(text) if isinstance(text, str) else text for text in texts]
        styled_label = styled_text(label, colour, bold=True)
        self.add("labelled", label=styled_label, texts=styled_texts, width=label_width)

    def write_labelled_texts(self, texts: Mapping[str, str]) -> None:
        for label, text in texts.items():
            self.write_labelled_text(label, text)

    def add_table(
        self,
        head: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        *,
        right_aligned_columns: Sequence[int] = (),
    ) -> None:
        """Add a table with a heading row; a cell is a text, or a text and its colour."""
        self.add("table", head=head, rows=rows, right=right_aligned_columns)

    def add_panel(
        self,
        title: str,
        height: float,
        *,
        caption: str = "",
        left_margin: float = AXES_LEFT_MARGIN,
        right_margin: float = AXES_RIGHT_MARGIN,
    ) -> Axes:
        """Add axes with a title and a caption, and return the axes; lengths are in points."""
        # slow import (0.3 s), only needed for plots
        from matplotlib.figure import Figure  # noqa: PLC0415

        axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
        axes.locator_params(axis="x", nbins=round(self.width / TICK_SPACING))
        axes.locator_params(axis="y", nbins=max(4, round(height / TICK_SPACING)))
        self.add(
            "panel",
            title=title,
            caption=caption,
            alt=f"{title} {caption}".strip(),
            axes=axes,
            margins=(left_margin, right_margin),
            height=height,
            width=self.width,
            figure=axes.figure,
        )
        return axes

    def add_legend(self, entries: Sequence[Artist]) -> PageBlock:
        """Add a legend in as many columns as fit into the page width, and return its block."""
        from matplotlib.figure import Figure  # noqa: PLC0415 - as in :meth:`add_panel`

        labels = [str(entry.get_label()) for entry in entries]
        entry_width = LEGEND_HANDLE_WIDTH + LEGEND_CHARACTER_WIDTH * max(map(len, labels))
        column_count = max(int(self.width / entry_width), 1)
        height = LEGEND_HEIGHT * math.ceil(len(labels) / column_count)
        figure = Figure(figsize=(self.width / 72.0, height / 72.0))
        figure.legend(handles=entries, loc="upper left", ncols=column_count, borderpad=0.0)
        alt = f"Legend: {', '.join(labels)}"
        return self.add("legend", alt=alt, width=self.width, height=height, figure=figure)

    def add_columns(self, *columns: Page) -> None:
        blocks, widths = [column.blocks for column in columns], [column.width for column in columns]
        self.add("columns", columns=blocks, widths=widths, gap=COLUMN_GAP)


def make_columns(count: int = 2) -> list[Page]:
    """Return columns that fill the page width."""
    width = (PAGE_WIDTH - COLUMN_GAP * (count - 1)) / count
    return [Page(width=width) for _ in range(count)]


def styled_text(text: str, colour: str = TEXT_COLOUR, *, bold: bool = False) -> PageBlock:
    return {"text": text, "colour": colour, "weight": "bold" if bold else "regular"}


def draw_legend_above(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=9)


def replace_unprintable(text: str) -> str:
    """Replace or remove characters that cannot be printed, and split long words."""
    from . import fonts  # noqa: PLC0415 - as in :meth:`Page.add_panel`

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
    if isinstance(block, Struct):
        block = structs.asdict(block)
    if isinstance(block, Mapping):
        fields = {
            name: to_typst_data(value, log_name)
            for name, value in block.items()
            if name not in ("figure", "axes")
        }
        return fields | (_render_figure(block) if "figure" in block else {})
    if isinstance(block, Sequence):
        return [to_typst_data(item, log_name) for item in block]
    return block


def _render_figure(block: Mapping[str, Any]) -> PageBlock:
    """Return a figure as SVG, and its frame, ticks and axis labels, which Typst draws."""
    fields: PageBlock = {}
    if "axes" in block:
        fields["frame"], axes = _place_axes(block), block["axes"]
        axes.apply_aspect()  # sets the final limits of maps
        fields["x_axis"], fields["y_axis"] = _find_ticks(axes.xaxis), _find_ticks(axes.yaxis)
        axes.set_axis_off()  # the ticks of matplotlib are slow: each consists of five artists
    buffer = io.StringIO()
    block["figure"].savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return fields | {"svg": buffer.getvalue()}


def _place_axes(block: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """Set the size of a figure and its axes; return left, top, width and height (points)."""
    axes, width, height = block["axes"], block["width"], block["height"]
    left_margin, right_margin = block["margins"]
    top_margin = 14.0 if axes.get_legend() else 4.0
    bottom_margin = LABELLED_BOTTOM_MARGIN if axes.get_xlabel() else UNLABELLED_BOTTOM_MARGIN
    total_height = top_margin + height + bottom_margin
    block["figure"].set_size_inches(width / 72.0, total_height / 72.0)
    axes_width = width - left_margin - right_margin
    axes.set_position(
        (
            left_margin / width,
            bottom_margin / total_height,
            axes_width / width,
            height / total_height,
        )
    )
    return left_margin, top_margin, axes_width, height


def _find_ticks(axis: Any) -> tuple[list[tuple[float, str]], str]:
    """Return the ticks of an axis (fraction of its length, label), and the axis label."""
    formatter, locations = axis.get_major_formatter(), axis.get_majorticklocs()
    labels = formatter.format_ticks(locations)
    # Scale (linear or logarithmic) of the axis
    to_scale = axis.get_transform().transform
    start, end = to_scale(axis.get_view_interval())
    fractions = (to_scale(locations) - start) / (end - start)
    ticks = [
        (fraction, label)
        for fraction, label in zip(fractions.tolist(), labels, strict=True)
        if -1e-9 <= fraction <= 1.0 + 1e-9  # ticks outside the axis are not drawn
    ]
    return ticks, f"{axis.get_label_text()} {formatter.get_offset()}".strip()
