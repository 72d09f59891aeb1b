"""Lines on the terminal: words wrap at its width with a hanging indent, and nothing is cut.

In a pipe a paragraph is one line, however long, so that other programs find what they look for.
"""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.style import StyleType
from rich.table import Table
from rich.text import Text

INDENT = 9


def say(console: Console, text: str | Text, head: str | Text = "", indent: int = 0) -> None:
    """Print a paragraph.

    Parameters
    ----------
    console : Console
    text : str or Text
        Its words wrap.
    head : str or Text
        What stands before its first line.
    indent : int
        Columns before its other lines, and the width of the head.
    """
    words = Text(text) if isinstance(text, str) else text
    head = Text(head) if isinstance(head, str) else head.copy()
    head.pad_right(max(indent - head.cell_len, 0))
    for line in words.wrap(console, max(console.width - indent, 1)):
        line.rstrip()
        console.print(head.append_text(line), soft_wrap=True)
        head = Text(" " * indent)


def print_line(console: Console, label: str, text: str | Text, style: StyleType = "") -> None:
    """Print a label and a text whose words wrap beside it."""
    words = Text(text, style) if isinstance(text, str) else text
    say(console, words, Text(label.ljust(INDENT), "bold"), INDENT)


def print_command(console: Console, command: str, label: str = "") -> None:
    """Print a command on one line, however long: it is to be copied."""
    console.print(
        Text(label.ljust(INDENT), "bold").append(command, "bold cyan not dim"), soft_wrap=True
    )


def print_file(console: Console, label: str, path: object) -> None:
    """Print where something was written, on one line."""
    console.print(Text(f"{label:{INDENT}}{path}", "bold"), soft_wrap=True)


def print_list(console: Console, rows: Iterable[tuple[str | Text, ...]]) -> None:
    """Print rows of short columns and a last one whose words wrap."""
    cells = [tuple(Text(c) if isinstance(c, str) else c for c in row) for row in rows]
    widths = [max(cell.cell_len for cell in column) + 1 for column in zip(*cells, strict=True)]
    for row in cells:
        head = Text()
        for cell, width in zip(row[:-1], widths, strict=False):
            padded = cell.copy()
            padded.pad_right(width - cell.cell_len)
            head.append_text(padded)
        say(console, row[-1], head, head.cell_len)


def plain_table(*heads: tuple[str, str]) -> Table:
    """A table without lines.

    Parameters
    ----------
    *heads : tuple of (str, str)
        Head of each column, whose lines are its group, name and unit, and "left" or "right".
    """
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for head, justify in heads:
        table.add_column(
            Text(head), justify="left" if justify == "left" else "right", overflow="fold",
            vertical="bottom",
        )  # fmt: skip
    return table
