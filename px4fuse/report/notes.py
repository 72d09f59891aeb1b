"""The student's own words, from a Markdown file, as text: headings, lists, code and tables.

Mathematics between dollar signs becomes letters (σ, ², √), a picture its description, and HTML
what it says: nothing is printed as markup, nothing is loaded and nothing runs.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from px4fuse.answers import Answers, form_rows
from px4fuse.report.document import AidsDocument, Document, LoopDocument
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
SUPERSCRIPTS = str.maketrans("0123456789+-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻")
GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma "
    "tau upsilon phi chi psi omega"
)
SYMBOLS = dict(zip(GREEK.split(), "αβγδεζηθικλμνξοπρστυφχψω", strict=True)) | {
    "cdot": "·", "times": "×", "pm": "±", "le": "≤", "leq": "≤", "ge": "≥", "geq": "≥",
    "approx": "≈", "neq": "≠", "sim": "~", "infty": "∞", "sum": "Σ", "int": "∫", "partial": "∂",
    "to": "→", "rightarrow": "→", "degree": "°", "circ": "°", "sqrt": "√", "ldots": "…",
    "left": "", "right": "", "mathrm": "", "text": "", "mathbf": "", "hat": "", "bar": "",
    "varepsilon": "ε", "quad": " ", ",": " ", ";": " ", "!": "", " ": " ",
}  # fmt: skip


def draw(document: Document | AidsDocument | LoopDocument) -> Iterator[Page]:
    """Draw as many pages as the form and the notes need; none without both."""
    title, answers = "What the student found", document.student.answers
    page = Page(appendix(title) if isinstance(document, Document) else title)
    if isinstance(answers, Answers):
        page.heading("The form, as it was filled in")
        rows = [list(row) for row in form_rows(answers)]
        page.table(("Asked", "Answer"), rows, shares=[3.0, 4.0], size=TABLE_SIZE)
    write(page, document.student.notes)
    if len(page.blocks) > 1:
        yield page


def write(page: Page, notes: str) -> None:
    r"""Write Markdown on a page, without its marks.

    >>> page = Page()
    >>> write(page, "# A *b*\n\n- $\\sigma_z^2$ is `R`\n\n![a map](m.png)")
    >>> [block["text"] for block in page.blocks]
    ['A b', 'σ_z² is R', '[picture: a map]']
    """
    # the parser costs a fiftieth of a second: not where there are no notes
    from markdown_it import MarkdownIt  # noqa: PLC0415
    from markdown_it.tree import SyntaxTreeNode  # noqa: PLC0415

    markdown = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    markdown.inline.ruler.before("escape", "maths", _maths)
    _blocks(page, SyntaxTreeNode(markdown.parse(notes)), 0)


def _blocks(page: Page, node: SyntaxTreeNode, indents: int, mark: str = "") -> None:
    """Write what a node holds, the mark of a list before the first line of it."""
    indent = INDENT * min(indents, MOST_INDENTS)
    children = node.children
    if mark and (not children or children[0].type.endswith("_list")):
        page.write("", size=BODY_SIZE, indent=indent, mark=mark)
        mark = ""
    for child in children:
        match child.type:
            case "heading":
                size = HEADING_SIZES.get(child.tag, BODY_SIZE)
                page.write(_inline(child), size=size, bold=True, indent=indent, above=6.0)
            case "bullet_list" | "ordered_list":
                first = int(child.attrs.get("start", 1))
                for number, item in enumerate(child.children, first):
                    numbered = child.type == "ordered_list"
                    _blocks(page, item, indents + 1, f"{number}." if numbered else "•")
            case "blockquote":
                _blocks(page, child, indents + 1)
            case "fence" | "code_block":
                code = child.content.rstrip("\n").expandtabs(4).replace(" ", "\N{NO-BREAK SPACE}")
                page.write(code, size=7.5, colour=MUTED, indent=indent + INDENT)
            case "table":
                rows = [row.children for part in child.children for row in part.children]
                head, *body = ([_inline(cell) for cell in row] for row in rows)
                page.table(head, body, shares=[1.0] * len(head), size=TABLE_SIZE)
            case "html_block":
                said = "\n".join(filter(None, map(str.strip, _said(child.content).split("\n"))))
                page.write(said, size=BODY_SIZE, indent=indent, above=2.0)
            case _:  # also a rule across, which says nothing
                above = 0.0 if mark else 2.0
                page.write(_inline(child), size=BODY_SIZE, indent=indent, mark=mark, above=above)
        mark = ""


def _inline(node: SyntaxTreeNode) -> str:
    """Words of a block without their marks."""
    return "".join(map(_words, node.children))


def _words(node: SyntaxTreeNode) -> str:
    match node.type:
        case "text" | "code_inline":
            return node.content
        case "softbreak" | "hardbreak":
            return " " if node.type == "softbreak" else "\n"
        case "maths" | "image" | "html_inline":
            of = {"maths": _letters, "image": _picture, "html_inline": _said}
            return of[node.type](node.content)
        case "link":
            words, address = _inline(node), str(node.attrs.get("href", ""))
            return words if words in (address, "") else f"{words} ({address})"
        case _:
            return _inline(node)


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
    text = POWER.sub(lambda found: (found[1] or found[2]).translate(SUPERSCRIPTS), text)
    return COMMAND.sub(_symbol, text).replace("{", "").replace("}", "").replace("~", " ")


def _fraction(found: re.Match[str]) -> str:
    return "/".join(part if part.isalnum() else f"({part})" for part in found.groups())


def _symbol(found: re.Match[str]) -> str:
    name = found[1]
    if name in SYMBOLS:
        return SYMBOLS[name]
    return SYMBOLS[name.lower()].upper() if name.lower() in SYMBOLS else name
