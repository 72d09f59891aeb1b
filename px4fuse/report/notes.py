"""Report page with a student's answers and notes (Markdown)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import accumulate
from typing import TYPE_CHECKING

from px4fuse.analysis import Analysis
from px4fuse.errors import SettingsError
from px4fuse.report.cover import FlightResults
from px4fuse.report.page import Page
from px4fuse.report.style import MUTED_COLOUR
from px4fuse.results.answer_form import Answers, form_rows
from px4fuse.results.contract import LoopResults

if TYPE_CHECKING:
    from markdown_it.token import Token
    from markdown_it.tree import SyntaxTreeNode

INDENT = 12.0  # points, per list level
MAX_INDENTS = 8  # deeper list levels are not indented further
# Deeper Markdown would exceed Python's recursion limit
MAX_NESTING_DEPTH = 100
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
    from markdown_it.tree import SyntaxTreeNode  # noqa: PLC0415

    _write_blocks(page, SyntaxTreeNode(parse_markdown(notes)), 0)


def parse_markdown(notes: str, name: str = "the notes") -> list[Token]:
    """Parse Markdown into tokens.

    Raises
    ------
    SettingsError
        Emphasis, lists and quotes are nested too deep.
    """
    # slow import (20 ms)
    from markdown_it import MarkdownIt  # noqa: PLC0415

    markdown_parser = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    tokens = markdown_parser.parse(notes)
    all_tokens = (
        nested_token for token in tokens for nested_token in (token, *(token.children or ()))
    )
    nesting_depth = max(accumulate(token.nesting for token in all_tokens), default=0)
    if nesting_depth > MAX_NESTING_DEPTH:
        raise SettingsError(
            f"{name}: emphasis, lists and quotes are nested {nesting_depth} levels deep; at most "
            f"{MAX_NESTING_DEPTH} levels are allowed",
            "Remove repeated * and _ from the text.",
        )
    return tokens


def _write_blocks(page: Page, node: SyntaxTreeNode, indent_level: int, marker: str = "") -> None:
    indent = INDENT * min(indent_level, MAX_INDENTS)
    children = node.children
    if marker and (not children or children[0].type.endswith("_list")):
        page.write("", indent=indent, marker=marker)
        marker = ""
    for child in children:
        match child.type:
            case "heading":
                page.write_heading(_inline_text(child))
            case "bullet_list" | "ordered_list":
                first_number = int(child.attrs.get("start", 1))
                for number, item in enumerate(child.children, first_number):
                    item_marker = f"{number}." if child.type == "ordered_list" else "•"
                    _write_blocks(page, item, indent_level + 1, item_marker)
            case "blockquote":
                _write_blocks(page, child, indent_level + 1)
            case "fence" | "code_block":
                code = child.content.rstrip("\n").expandtabs(4).replace(" ", "\N{NO-BREAK SPACE}")
                page.write(code, colour=MUTED_COLOUR, indent=indent + INDENT)
            case "table":
                rows = [row.children for section in child.children for row in section.children]
                head, *body_rows = ([_inline_text(cell) for cell in row] for row in rows)
                page.add_table(head, body_rows)
            case "html_block":
                page.write(TAG_PATTERN.sub("", child.content).strip(), indent=indent)
            case _:  # paragraph, or horizontal rule without text
                page.write(_inline_text(child), indent=indent, marker=marker)
        marker = ""


def _inline_text(node: SyntaxTreeNode) -> str:
    return "".join(map(_node_text, node.children))


def _node_text(node: SyntaxTreeNode) -> str:
    match node.type:
        case "text" | "code_inline":
            return node.content
        case "softbreak":
            return " "
        case "hardbreak":
            return "\n"
        case "image":
            return f"[picture: {node.content}]" if node.content else "[picture]"
        case "link":
            label, address = _inline_text(node), str(node.attrs.get("href", ""))
            return label if label in (address, "") else f"{label} ({address})"
        case _:
            return _inline_text(node)
