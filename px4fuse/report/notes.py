"""The student's own words, from a Markdown file, as plain text with headings and bullets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from matplotlib.figure import Figure

from px4fuse.report.document import Document, LoopDocument
from px4fuse.report.style import BOTTOM, LEFT, POINTS_PER_WIDTH, RIGHT, page, printable, wrap

HEADING = re.compile(r"^(#{1,6})\s+(.*?)\s*#*$")
BULLET = re.compile(r"^(\s*)(?:[-*+]|(\d+)[.)])\s+(.*)$")
EMPHASIS = re.compile(r"(\*\*|__)(?=\S)(.+?)(?<=\S)\1")
BODY_SIZE = 8.5


def draw(document: Document | LoopDocument) -> Iterator[Figure]:
    """Draw as many pages as the notes need; none without notes."""
    text = document.student.notes
    if not text.strip():
        return
    figure, cursor = page("Notes by the student")
    for line in text.splitlines():
        words, style = _style(line)
        if not words.strip():
            cursor.skip(5)
            continue
        # written line by line, so that a paragraph may run over a page's end
        x = style.pop("x")
        for piece in wrap(printable(words), style["size"], (RIGHT - x) * POINTS_PER_WIDTH):
            if cursor.y - 0.016 < BOTTOM:
                yield figure
                figure, cursor = page("Notes by the student, continued")
            cursor.write(piece, x=x, **style)
    yield figure


def _style(line: str) -> tuple[str, dict[str, Any]]:
    """Text of one Markdown line without its marks, and how to write it."""
    if heading := HEADING.match(line):
        size = max(BODY_SIZE, 12.0 - 1.2 * (len(heading[1]) - 1))
        return _plain(heading[2]), {"x": LEFT, "size": size, "weight": "bold"}
    if bullet := BULLET.match(line):
        mark = f"{bullet[2]}." if bullet[2] else "•"
        indent = LEFT + 0.015 + 0.008 * min(len(bullet[1].expandtabs(4)), 12)
        return f"{mark} {_plain(bullet[3])}", {"x": indent, "size": BODY_SIZE}
    return _plain(line), {"x": LEFT, "size": BODY_SIZE}


def _plain(text: str) -> str:
    return EMPHASIS.sub(r"\2", text)
