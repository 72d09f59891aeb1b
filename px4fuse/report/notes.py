"""The student's own words, from a Markdown file, as text: headings, lists, code and tables.

Mathematics between dollar signs becomes letters (σ, ², √), a picture its description, and HTML
what it says: nothing is printed as markup, nothing is loaded and nothing runs.
"""

from __future__ import annotations

import html
import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from px4fuse.answers import Answers, form_rows
from px4fuse.report.document import Document, LoopDocument
from px4fuse.report.page import Page, appendix
from px4fuse.report.style import MUTED

if TYPE_CHECKING:
    from markdown_it.rules_inline import StateInline
    from markdown_it.tree import SyntaxTreeNode

BODY_SIZE = 8.5
HEADING_SIZES = {"h1": 12.0, "h2": 10.8, "h3": 9.6}
INDENT = 12.0  # points
MOST_INDENTS = 8
TABLE_SIZE = 8.0
# $ opens before what is no space and closes after it, not before a digit: prices stay prices
MATHS = re.compile(r"\$\$(.+?)\$\$|\$(?!\s)((?:\\.|[^$\\])+?)(?<!\s)\$(?!\d)", re.DOTALL)
COMMAND = re.compile(r"\\([A-Za-z]+|.)")
FRACTION = re.compile(r"\\frac\s*\{([^{}]*)\}\s*\{([^{}]*)\}")
ROOT = re.compile(r"\\sqrt\s*\{([^{}]*)\}")
INDEX = re.compile(r"_\{([^{}]*\W[^{}]*)\}")
POWER = re.compile(r"\^\{([-+]?\d+)\}|\^(\d)")
# HTML: what is no text, pictures with what they are called, ends of lines, all other tags
SILENT = re.compile(r"<!--.*?-->|<(script|style)\b.*?(</\1\s*>|$)", re.DOTALL | re.IGNORECASE)
IMAGE = re.compile(r"""<img\b(?:[^>]*?\balt\s*=\s*(["'])(.*?)\1)?[^>]*>""", re.IGNORECASE)
BREAK = re.compile(r"<(br|/p|/div|/tr|/li|/h\d)\b[^>]*>", re.IGNORECASE)
TAG = re.compile(r"<[^>]*>")
SYMBOLS = {
    "cdot": "·", "times": "×", "pm": "±", "le": "≤", "leq": "≤", "ge": "≥", "geq": "≥",
    "approx": "≈", "neq": "≠", "sim": "~", "infty": "∞", "sum": "Σ", "int": "∫", "partial": "∂",
    "to": "→", "rightarrow": "→", "degree": "°", "circ": "°", "sqrt": "√", "ldots": "…",
    "left": "", "right": "", "mathrm": "", "text": "", "mathbf": "", "hat": "", "bar": "",
    "varepsilon": "ε", "quad": " ", ",": " ", ";": " ", "!": "", " ": " ",
}  # fmt: skip


@dataclass(frozen=True)
class Paragraph:
    """A paragraph, or a line of code: its words, how they look, and the mark of a list before."""

    text: str
    size: float = BODY_SIZE
    weight: str = "normal"
    colour: str = "black"
    indents: int = 0
    mark: str = ""
    above: float = 4.0


@dataclass(frozen=True)
class NotesTable:
    """Rows of cells, the first one the head."""

    rows: tuple[tuple[str, ...], ...]
    indents: int = 0


def draw(document: Document | LoopDocument) -> Iterator[Page]:
    """Draw as many pages as the form and the notes need; none without both."""
    title = "What the student found"
    if isinstance(document, Document):
        title = appendix(title)
    blocks, answers = list(read(document.student.notes)), document.student.answers
    if not blocks and not isinstance(answers, Answers):
        return
    page = Page(title)
    if isinstance(answers, Answers):
        page.heading("The form, as it was filled in")
        page.table(("Asked", "Answer"), [list(row) for row in form_rows(answers)],
                   shares=[3.0, 4.0], size=TABLE_SIZE)  # fmt: skip
    for block in blocks:
        if isinstance(block, Paragraph):
            page.write(
                block.text, size=block.size, bold=block.weight == "bold", colour=block.colour,
                indent=INDENT * min(block.indents, MOST_INDENTS), mark=block.mark,
                above=block.above - 2.0,
            )  # fmt: skip
        else:
            columns = max(map(len, block.rows))
            head, *rows = ([*row, *[""] * (columns - len(row))] for row in block.rows)
            page.table(head, rows, shares=[1.0] * columns, size=TABLE_SIZE)
    yield page


def read(notes: str) -> Iterator[Paragraph | NotesTable]:
    r"""Markdown as lines and tables, in their order.

    >>> [line.text for line in read("# A *b*\n\n- $\\sigma_z^2$ is `R`\n\n![a map](m.png)")]
    ['A b', 'σ_z² is R', '[picture: a map]']
    """
    # the parser costs a fiftieth of a second: not where there are no notes
    from markdown_it import MarkdownIt  # noqa: PLC0415
    from markdown_it.tree import SyntaxTreeNode  # noqa: PLC0415

    markdown = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    markdown.inline.ruler.before("escape", "maths", _maths)
    yield from _blocks(SyntaxTreeNode(markdown.parse(notes)), 0)


def _blocks(node: SyntaxTreeNode, indents: int) -> Iterator[Paragraph | NotesTable]:
    for child in node.children:
        match child.type:
            case "heading":
                size = HEADING_SIZES.get(child.tag, BODY_SIZE)
                yield Paragraph(_inline(child), size, "bold", indents=indents, above=8.0)
            case "bullet_list" | "ordered_list":
                yield from _items(child, indents)
            case "blockquote":
                yield from _blocks(child, indents + 1)
            case "fence" | "code_block":
                for number, text in enumerate(child.content.rstrip("\n").split("\n")):
                    code = text.expandtabs(4).replace(" ", "\N{NO-BREAK SPACE}")
                    yield Paragraph(code or " ", 7.5, colour=MUTED, indents=indents + 1,
                               above=0.0 if number else 4.0)  # fmt: skip
            case "table":
                rows = [row for part in child.children for row in part.children]
                yield NotesTable(
                    tuple(tuple(_inline(c) for c in row.children) for row in rows), indents
                )
            case "html_block":
                for text in _said(child.content).split("\n"):
                    if text.strip():
                        yield Paragraph(text.strip(), indents=indents)
            case "hr":
                yield Paragraph("")
            case _:
                yield Paragraph(_inline(child), indents=indents)


def _items(node: SyntaxTreeNode, indents: int) -> Iterator[Paragraph | NotesTable]:
    """Items of a list, the first line of each with its mark."""
    first = int(node.attrs.get("start", 1))
    for number, item in enumerate(node.children, start=first):
        mark = "•" if node.type == "bullet_list" else f"{number}."
        blocks = list(_blocks(item, indents + 1))
        if not blocks or not isinstance(blocks[0], Paragraph) or blocks[0].mark:
            blocks.insert(0, Paragraph("", indents=indents + 1))
        head = blocks[0]
        assert isinstance(head, Paragraph)
        yield Paragraph(head.text, head.size, head.weight, head.colour, head.indents, mark, 2.0)
        yield from blocks[1:]


def _inline(node: SyntaxTreeNode) -> str:
    """Words of a block without their marks."""
    said = []
    for child in node.children:
        match child.type:
            case "text" | "code_inline":
                said.append(child.content)
            case "maths":
                said.append(_letters(child.content))
            case "softbreak":
                said.append(" ")
            case "hardbreak":
                said.append("\n")
            case "image":
                said.append(_picture(child.content))
            case "html_inline":
                said.append(_said(child.content))
            case "link":
                words, address = _inline(child), str(child.attrs.get("href", ""))
                said.append(words if words in (address, "") else f"{words} ({address})")
            case _:
                said.append(_inline(child))
    return "".join(said)


def _picture(description: str) -> str:
    return f"[picture: {description}]" if description else "[picture]"


def _said(markup: str) -> str:
    """What HTML says: its text, and what pictures in it are called."""
    text = SILENT.sub("", markup)
    text = IMAGE.sub(lambda found: _picture(found[2] or ""), text)
    return html.unescape(TAG.sub("", BREAK.sub("\n", text)))


def _maths(state: StateInline, silent: bool) -> bool:
    """Mathematics in dollar signs, as a rule of the parser: code and escapes come before it."""
    found = MATHS.match(state.src, state.pos)
    if found is None:
        return False
    if not silent:
        state.push("maths", "", 0).content = (found[1] or found[2]).strip()
    state.pos = found.end()
    return True


def _letters(maths: str) -> str:
    """TeX as letters, as far as letters go."""
    text = INDEX.sub(r"_(\1)", FRACTION.sub(_fraction, ROOT.sub(r"√(\1)", maths)))
    text = POWER.sub(lambda m: "".join(map(_superscript, m[1] or m[2])), text)
    return COMMAND.sub(_symbol, text).replace("{", "").replace("}", "").replace("~", " ")


def _fraction(found: re.Match[str]) -> str:
    return "/".join(part if part.isalnum() else f"({part})" for part in found.groups())


def _superscript(character: str) -> str:
    if character in "+-":
        return "⁺" if character == "+" else "⁻"
    return unicodedata.lookup(f"SUPERSCRIPT {unicodedata.name(character).split()[-1]}")


def _symbol(found: re.Match[str]) -> str:
    name = found[1]
    if name in SYMBOLS:
        return SYMBOLS[name]
    if not name.isalpha():
        return name
    size = "CAPITAL" if name[0].isupper() else "SMALL"
    greek = "LAMDA" if name.lower() == "lambda" else name.upper()
    try:
        return unicodedata.lookup(f"GREEK {size} LETTER {greek}")
    except KeyError:
        return name
