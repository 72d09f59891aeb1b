"""What a page of a report says and draws, taken out of its blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from matplotlib.axes import Axes

from px4fuse.report.page import Block, Page


def every(blocks: Sequence[Block]) -> Iterator[Block]:
    """Blocks with those within them, in order."""
    for block in blocks:
        yield block
        for inner in (*block.get("columns", ()), block.get("blocks", ())):
            yield from every(inner)


def texts(*pages: Page) -> list[str]:
    """Every text, in order: titles, sentences, cells, sentences of panels."""
    found = []
    for page in pages:
        for block in every(page.blocks):
            parts = (*block.get("left", ()), *block.get("right", ()))
            cells = [cell["text"] for row in block.get("rows", ()) for cell in row]
            found += [block[key] for key in ("title", "text", "lead", "say") if block.get(key)]
            found += [*(part["text"] for part in parts), *block.get("head", ()), *cells]
    return found


def words(*pages: Page) -> str:
    """All that they say."""
    return " ".join(texts(*pages))


def axes_of(*pages: Page) -> list[Axes]:
    """Every axes that they draw."""
    return [
        axes
        for page in pages
        for block in every(page.blocks)
        if "figure" in block
        for axes in block["figure"].axes
    ]
