"""Texts and axes of report pages, extracted from their blocks."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

from matplotlib.axes import Axes
from pypdf import PdfReader

from px4fuse.report import fonts
from px4fuse.report.page import Block, Page, to_typst_data
from px4fuse.report.pdf import compile_pdf


def every(blocks: Sequence[Block]) -> Iterator[Block]:
    """Yield blocks and nested blocks in order."""
    for block in blocks:
        yield block
        for inner in (*block.get("columns", ()), block.get("blocks", ())):
            yield from every(inner)


def texts(*pages: Page) -> list[str]:
    """Return all texts in order: titles, paragraphs, captions and table cells."""
    found = []
    for page in pages:
        for block in every(page.blocks):
            label = block["label"]["text"].split("\n") if "label" in block else ()
            cells = [cell for row in block.get("rows", ()) for cell in row]
            found += [block[key] for key in ("title", "text", "lead", "caption") if block.get(key)]
            found += [*label, *(part["text"] for part in block.get("texts", ()))]
            found += [*block.get("head", ()), *(c if isinstance(c, str) else c[0] for c in cells)]
    return found


def words(*pages: Page) -> str:
    """Return all texts as one string."""
    return " ".join(texts(*pages))


def axes_of(*pages: Page) -> list[Axes]:
    """Return all axes of the pages."""
    return [
        axes
        for page in pages
        for block in every(page.blocks)
        if "figure" in block
        for axes in block["figure"].axes
    ]


def set_by_typst(*pages: Page) -> list[str]:
    """Set the pages as PDF and return the text of each sheet."""
    blocks = to_typst_data([block for page in pages for block in page.blocks])
    report = {
        "title": "t", "author": "a", "head": "", "student": "", "foot": "", "results": None,
        "fonts": [fonts.FONT], "blocks": blocks,
    }  # fmt: skip
    return [sheet.extract_text() for sheet in PdfReader(io.BytesIO(compile_pdf(report))).pages]
