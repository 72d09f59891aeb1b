"""Texts and axes of report pages, extracted from their blocks."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from msgspec import Struct, structs
from pypdf import PdfReader

from px4fuse.report.page import Page, PageBlock, to_typst_data
from px4fuse.report.style import apply_report_style
from px4fuse.report.typesetting import compile_pdf


def every(blocks: Sequence[PageBlock]) -> Iterator[PageBlock]:
    """Yield blocks and nested blocks in order."""
    for block in blocks:
        yield block
        for inner in block.get("columns", ()):
            yield from every(inner)


def texts(*pages: Page) -> list[str]:
    """Return all texts in order: titles, paragraphs, captions and table cells."""
    found = []
    for page in pages:
        for block in every(page.blocks):
            if block["kind"] == "cover":
                found += list(_strings(block))
                continue
            label = block["label"]["text"].split("\n") if "label" in block else ()
            cells = [cell for row in block.get("rows", ()) for cell in row]
            found += [block[key] for key in ("title", "text", "lead", "caption") if block.get(key)]
            found += [*label, *(part["text"] for part in block.get("texts", ()))]
            found += [*block.get("head", ()), *(c if isinstance(c, str) else c[0] for c in cells)]
    return found


def _strings(value: Any) -> Iterator[str]:
    """Yield all texts of nested mappings and sequences."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Struct):
        yield from _strings(structs.asdict(value))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _strings(inner)
    elif isinstance(value, Iterable):
        for inner in value:
            yield from _strings(inner)


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
    return [sheet.extract_text() for sheet in PdfReader(io.BytesIO(pdf_of(*pages))).pages]


def pdf_of(*pages: Page) -> bytes:
    with apply_report_style():
        blocks = to_typst_data([block for page in pages for block in page.blocks], "log.ulg")
    report = {
        "title": "t", "author": "a", "head": "", "student": "", "results": None,
        "blocks": blocks,
    }  # fmt: skip
    return compile_pdf(report)


def smallest_type(pdf: bytes) -> float:
    """Return the smallest size (points) of the letters on the pages of a PDF."""
    sizes = []
    for sheet in PdfReader(io.BytesIO(pdf)).pages:

        def visit(text: str, cm: list[float], tm: list[float], _: Any, size: float) -> None:
            if text.strip():
                matrix = np.array([cm[:2], cm[2:4]]) @ np.array([tm[:2], tm[2:4]])
                sizes.append(size * float(np.sqrt(abs(np.linalg.det(matrix)))))

        sheet.extract_text(visitor_text=visit)
    return min(sizes)
