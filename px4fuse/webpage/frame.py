"""One page with one table: sorted, searched, filtered and unfolded by the page's own script.

Rows are JSON, and the script draws a hundred of them at a time, so that thousands stay fluid.
Without scripts the page shows its first rows as a plain table.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from px4fuse.webpage.safe import clean_values, inert_json, part, policy_hash, template

# Rows that the script draws at once, and that are there without it
MAX_PAGE_ROWS = 100
MAX_PLAIN_ROWS = 300


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes
    ----------
    kind : {"text", "line", "number", "rank"}
        How it is sorted; a line is text that stays in one, a rank is text sorted by a number.
    group : str
        Shown only while the box of this group is ticked; "" for always.
    visible_from : {"always", "tablet", "desk"}
        The smallest screen on which it is shown.
    """

    title: str
    kind: Literal["text", "line", "number", "rank"] = "text"
    group: str = ""
    visible_from: Literal["always", "tablet", "desk"] = "always"


@dataclass(frozen=True)
class Cell:
    """What stands in a row under one column.

    Attributes
    ----------
    value : float, str or None
        By which it is sorted; None comes last both ways.
    below : str
        A second, small line.
    style_class : str
        "" for text, "flags" for one flag per line, else the class of a chip.
    bar : float or None
        Length of a bar below the text, from 0 to 1.
    """

    text: str = ""
    value: float | str | None = None
    below: str = ""
    style_class: str = ""
    bar: float | None = None


def text_cell(text: str, below: str = "") -> Cell:
    """A cell that is sorted by its text."""
    return Cell(text, text or None, below)


def number_cell(value: float | None, text: str | None = None, below: str = "") -> Cell:
    """A cell that is sorted by a number; empty for what is absent or not finite."""
    if value is None or not math.isfinite(value):
        return Cell()
    return Cell(f"{value:.4g}" if text is None else text, value, below)


Part = list[Any]


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    cells : tuple of Cell
        One per column; the first names the row and unfolds it.
    tags : tuple of str
        What filters look for.
    details, side_parts : tuple of Part
        What it unfolds to, and what stands at the right of it: of :func:`list_part` and the like;
        those with nothing in them are left out.
    """

    cells: tuple[Cell, ...]
    tags: tuple[str, ...] = ()
    details: tuple[Part, ...] = ()
    side_parts: tuple[Part, ...] = ()


# ------------------------------------------------------------------ what a row unfolds to


def list_part(title: str, texts: Sequence[str], warn: bool = False) -> Part:
    """A list of sentences."""
    return ["list", title, texts, warn]


def prose_part(title: str, text: str) -> Part:
    """Text with its own lines."""
    return ["prose", title, text]


def pairs_part(title: str, rows: Sequence[tuple[str, str]]) -> Part:
    """Names and what they are; those without a value are left out."""
    return ["pairs", title, [row for row in rows if row[1]]]


def table_part(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[int] = (),
) -> Part:
    """A small table; ``numeric`` are the columns that end flush."""
    return ["table", title, heads, rows, list(numeric)]


def links_part(title: str, rows: Sequence[tuple[str, str]]) -> Part:
    """Words and where they lead: addresses of :func:`px4fuse.webpage.safe.local_link` only."""
    return ["links", title, [row for row in rows if row[1]]]


def boxes_part(
    title: str,
    owner: str,
    rows: Sequence[tuple[str, float, float | None, str]],
    other_rows: Sequence[tuple[str, float | None, str]] = (),
) -> Part:
    """Boxes for points and words, which the page gives as a table to download.

    Parameters
    ----------
    owner : str
        Whose they are, as the table says it.
    rows : sequence of (name, most, points, words)
    other_rows : sequence of (name, points, words)
        What the table holds besides.
    """
    return ["boxes", title, owner, rows, other_rows]


# ------------------------------------------------------------------ the page


def page(
    *,
    title: str,
    subtitle: str,
    above: str = "",
    noun: tuple[str, str],
    columns: Sequence[Column],
    rows: Sequence[Row],
    filters: Sequence[tuple[str, Sequence[tuple[str, str]]]],
    groups: Sequence[tuple[str, str]] = (),
    placeholder: str,
    full_table_note: str,
) -> str:
    """Lay out a page.

    Parameters
    ----------
    above : str
        HTML above the table, of a :func:`~px4fuse.webpage.safe.template`.
    noun : (str, str)
        What a row is, one and many.
    filters : sequence of (label, ((tag, words), ...))
        Rows that have the chosen tag are shown.
    groups : sequence of (group, label)
        Boxes that show more columns.
    placeholder : str
        What one may search for.
    full_table_note : str
        Sentence: where all rows are for whom the page shows only some of them.

    Returns
    -------
    str
        Write it as UTF-8. The same for the same input.
    """
    style = part("base.css") + part("frame.css")
    script = part("frame.js")
    content = {
        "columns": [(c.title, c.kind, c.group, c.visible_from) for c in columns],
        "rows": [
            (
                [_compact(cell) for cell in row.cells],
                row.tags,
                *([part for part in side if part[2]] for side in (row.details, row.side_parts)),
            )
            for row in rows
        ],
        "size": MAX_PAGE_ROWS,
        "nouns": noun,
    }
    return template("webpage/frame.html").render(
        style_hash=policy_hash(style),
        script_hash=policy_hash(script),
        style=style,
        script=script,
        title=title,
        subtitle=subtitle,
        above=above,
        placeholder=placeholder,
        filters=filters,
        groups=groups,
        noun=noun,
        columns=columns,
        rows=rows,
        plain_rows=MAX_PLAIN_ROWS,
        full_table_note=full_table_note,
        content=inert_json(clean_values(content)),
    )


def _compact(cell: Cell) -> list[Any]:
    """Its fields without those at the end that are empty; true stands for a value like its text."""
    value = True if cell.value == cell.text else "" if cell.value is None else cell.value
    bar = "" if cell.bar is None else round(cell.bar, 3)
    fields = [cell.text, value, cell.below, cell.style_class, bar]
    while fields and fields[-1] == "":
        fields.pop()
    return fields
