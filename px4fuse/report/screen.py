"""Output of report pages on the terminal."""

import re
from collections.abc import Iterable, Sequence
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from px4fuse.request import ComparisonRequest, Request, command_line

from .card_text import CARD_WIDTH, Paragraph, to_ascii
from .page import Cell, PageBlock
from .style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS

# Terminal encodings that contain all characters of the printed diagnosis, for example ● and σ
UNICODE_ENCODINGS = ("utf-8", "utf8", "utf-16")
LABEL_CHARACTERS = 9  # width of a label
MIN_TABLE_WIDTH = 50  # characters; narrower terminals show no tables
POINTS_PER_CHARACTER = 6.0  # points in the PDF per character on the terminal
STYLES_BY_COLOUR = {
    MUTED_COLOUR: "dim",
    SEVERITY_COLOURS["error"]: "bold red",
    SEVERITY_COLOURS["warning"]: "yellow",
    SEVERITY_COLOURS["note"]: "cyan",
    GOOD_COLOUR: "green",
}
# Commands of px4fuse in a text, without the full stop at the end
_COMMAND_PATTERN = re.compile(r"px4fuse (\w+) LOG(?![\w.])((?: --[a-z-]+ [-\w]+(?:\.\d+)?)*)")


def print_blocks(
    console: Console, blocks: Iterable[PageBlock], request: Request | None = None
) -> None:
    """Print the blocks of a page on the terminal: texts, tables, commands and the diagnosis.

    Commands in labelled texts are completed with the options of ``request``, if it is given. Tables
    are printed as texts on a narrow terminal.
    """
    for block in blocks:
        match block["kind"]:
            case "text" | "heading":
                indent = round(block.get("indent", 0.0) / POINTS_PER_CHARACTER)
                print_paragraph(console, _make_rich_text(block), Text(), indent=indent)
            case "labelled":
                _show_labelled(console, block, request)
            case "table" if console.width < MIN_TABLE_WIDTH:
                for row in (block["head"], *block["rows"]):
                    texts = (cell if isinstance(cell, str) else cell[0] for cell in row)
                    row_text = Text(", ".join(filter(None, texts)))
                    print_paragraph(console, row_text, Text(), indent=2)
            case "table":
                console.print(_make_rich_table(**block))
            case "command":
                print_line(console, block["label"], block["text"])
            case "blank":
                console.print()
            case "card":
                _show_card(console, block["paragraphs"])


def _show_card(console: Console, paragraphs: Sequence[Paragraph]) -> None:
    """Print the paragraphs of a diagnosis card, in ASCII if the terminal has no Unicode."""
    is_ascii_terminal = console.encoding.lower() not in UNICODE_ENCODINGS
    # In a pipe, each sentence is one line
    width = min(console.width, CARD_WIDTH) if console.is_terminal else console.width
    for paragraph in paragraphs:
        for text in paragraph.wrap(width):
            console.print(
                Text(to_ascii(text) if is_ascii_terminal else text, paragraph.style),
                soft_wrap=True,
            )


def _show_labelled(console: Console, block: PageBlock, request: Request | None) -> None:
    """Print texts beside their label, which is printed only once."""
    label, _, spans_text = block["label"]["text"].partition("\n")
    for index, text_block in enumerate(block["texts"]):
        text, commands = _make_rich_text(text_block), list[str]()
        if request is not None:
            text.plain, commands = shorten_commands(text.plain, request)
        if spans_text and index == 0:
            text.append(f" ({spans_text})")
        styled_label = _make_rich_text(block["label"] | {"text": "" if index else f"{label} "})
        print_paragraph(console, text, styled_label, indent=LABEL_CHARACTERS)
        for command in commands:
            print_line(console, "", command)


def shorten_commands(text: str, request: Request) -> tuple[str, list[str]]:
    """Shorten each command in a text to its options, and return the complete commands too.

    >>> request = ComparisonRequest(log="a b.ulg")
    >>> shorten_commands("px4fuse compare LOG --sigma-z 0.2: better.", request)
    ('--sigma-z 0.2: better.', ["px4fuse compare 'a b.ulg' --sigma-z 0.2"])
    """
    log_path = str(getattr(request, "log", "") or getattr(request, "source", ""))
    default_request = ComparisonRequest(log=log_path)
    commands = [
        command_line(request if name == "compare" else default_request, name, for_shell=True)
        + options
        for name, options in _COMMAND_PATTERN.findall(text)
    ]
    short_text = _COMMAND_PATTERN.sub(lambda match: match[2].strip() or f"px4fuse {match[1]}", text)
    return short_text, list(dict.fromkeys(commands))


def _make_rich_text(block: PageBlock) -> Text:
    style = STYLES_BY_COLOUR.get(block["colour"], "")
    return Text(block["text"], f"{style} bold" if block["weight"] == "bold" else style)


def print_paragraph(console: Console, text: Text, label: Text, *, indent: int) -> None:
    """Print an indented paragraph beside its label."""
    margin = label.copy()
    margin.pad_right(max(indent - margin.cell_len, 0))
    for line in text.wrap(console, max(console.width - indent, 1)):
        line.rstrip()
        console.print(margin.append_text(line), soft_wrap=True)
        margin = Text(" " * indent)


def print_line(console: Console, label: str, text: str, style: str = "bold cyan not dim") -> None:
    """Print a command or path on one line, so that the user can copy it."""
    console.print(Text(f"{label:{LABEL_CHARACTERS}}", "bold").append(text, style), soft_wrap=True)


def _make_rich_table(
    head: Sequence[str],
    rows: Iterable[Iterable[Cell]],
    right: Sequence[int],
    **_: object,
) -> Table:
    """Make a table for the terminal; ``right`` contains the indices of right-aligned columns."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    vertical_alignment: Literal["bottom", "top"] = "bottom" if "\n" in "".join(head) else "top"
    for index, title in enumerate(head):
        justify: Literal["right", "left"] = "right" if index in right else "left"
        table.add_column(Text(title), justify=justify, overflow="fold", vertical=vertical_alignment)
    for row in rows:
        texts = [(cell, "") if isinstance(cell, str) else cell for cell in row]
        table.add_row(*(Text(text, STYLES_BY_COLOUR.get(colour, "")) for text, colour in texts))
    return table
