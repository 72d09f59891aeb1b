"""Report page with a student's answers and notes (Markdown)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from px4fuse.analysis import Analysis
from px4fuse.results.answer_form import Answers, form_rows
from px4fuse.results.contract import LoopResults

from .cover import FlightResults
from .page import Page
from .style import MUTED_COLOUR

if TYPE_CHECKING:
    from markdown_it.token import Token

INDENT = 12.0  # points, per list level
MAX_INDENTS = 8  # deeper list levels are not indented further
TAG_PATTERN = re.compile(r"<!--.*?-->|<[^>]*>", re.DOTALL)


def draw_pages(analysis_or_loop: object, results: FlightResults | LoopResults) -> Iterator[Page]:
    """Draw a page with the student's answers and notes, if any."""
    answers, is_appendix = results.student.answers, isinstance(analysis_or_loop, Analysis)
    page = Page("Appendix: student notes" if is_appendix else "Student notes")
    if isinstance(answers, Answers):
        page.write_heading("Answer form")
        rows = [list(row) for row in form_rows(answers)]
        page.add_table(("Question", "Answer"), rows)
    write_markdown(page, results.student.notes)
    if len(page.blocks) > 1:
        yield page


def write_markdown(page: Page, notes: str) -> None:
    r"""Write Markdown on a page as plain text.

    >>> page = Page()
    >>> write_markdown(page, "# A *b*\n\n- σ_z² is `R`\n\n![a map](m.png)")
    >>> [block["text"] for block in page.blocks]
    ['A b', 'σ_z² is R', '[picture: a map]']
    """
    # slow import (20 ms)
    from markdown_it import MarkdownIt  # noqa: PLC0415

    parser = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    # The Markdown parser returns a list of tokens, which open and close nested elements. State
    # after each token:
    next_item_numbers = list[int]()  # number of the next item in each open list, unused for bullets
    level = 0  # number of open list items and quotes
    marker = ""  # bullet or number of a list item, until it is written beside the first text
    table_rows = list[list[str]]()  # rows of the current table, with the text of each cell
    previous_type = ""  # type of the last token; "heading_open" precedes the text of a heading
    for token in parser.parse(notes):
        # Indent of the current list item. Compute it before this token changes the level: if the
        # token ends an item without text, the marker of the item is written with this indent
        indent = INDENT * min(level, MAX_INDENTS)
        if marker and token.type not in ("paragraph_open", "inline"):
            page.write("", indent=indent, marker=marker)  # the item does not begin with a paragraph
            marker = ""
        # nesting: 1 for an opening, -1 for a closing token
        level += token.nesting if token.type.startswith(("list_item", "blockquote")) else 0
        match token.type:
            case "bullet_list_open" | "ordered_list_open":
                next_item_numbers.append(int(token.attrs.get("start", 1)))
            case "bullet_list_close" | "ordered_list_close":
                next_item_numbers.pop()
            case "list_item_open":
                marker = f"{next_item_numbers[-1]}." if token.info else "•"
                next_item_numbers[-1] += 1
            case "fence" | "code_block":
                code = token.content.rstrip("\n").expandtabs(4).replace(" ", "\N{NO-BREAK SPACE}")
                page.write(code, colour=MUTED_COLOUR, indent=indent + INDENT)
            case "html_block":
                page.write(TAG_PATTERN.sub("", token.content).strip(), indent=indent)
            case "tr_open":
                table_rows.append([])
            case "table_close":
                page.add_table(table_rows[0], table_rows[1:])
                table_rows = []
            case "inline" if previous_type in ("th_open", "td_open"):
                table_rows[-1].append(_format_inline(token))
            case "inline" if previous_type == "heading_open":
                page.write_heading(_format_inline(token))
            case "inline":
                page.write(_format_inline(token), indent=indent, marker=marker)
                marker = ""
        previous_type = token.type


def _format_inline(token: Token) -> str:
    """Return the text of a paragraph, heading or cell; links are followed by their addresses."""
    text, label_start, address = "", 0, ""
    for part in token.children or ():
        match part.type:
            case "text" | "code_inline":
                text += part.content
            case "softbreak":
                text += " "
            case "hardbreak":
                text += "\n"
            case "image":
                text += f"[picture: {part.content}]" if part.content else "[picture]"
            case "link_open":
                label_start, address = len(text), str(part.attrs["href"])
            case "link_close" if text[label_start:] != address != "":
                text += f" ({address})"
    return text
