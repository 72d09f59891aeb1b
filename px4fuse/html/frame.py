"""Web page with one table that the page's script sorts, searches, filters and unfolds.

Rows are JSON; the script draws a hundred at a time, so thousands of rows remain fast. Without
scripts the page shows its first rows as a plain table.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from px4fuse.html.safe import clean_values, inert_json, load_template, policy_hash, read_asset

MAX_PAGE_ROWS = 100  # maximum number of rows on one page of the table
MAX_PLAIN_ROWS = 300  # maximum number of rows of the plain table, for browsers without scripts


@dataclass(frozen=True)
class Column:
    """Column of the table.

    Attributes
    ----------
    kind : {"text", "name", "full", "line", "number", "rank", "ratio"}
        Sort order; "name" is the text that unfolds the row (default: the first column), "full" is
        text that is never cut, "line" is text without line breaks, "rank" is text sorted by a
        number, and "ratio" is a number on the axis of the page.
    group : str
        Group whose check box shows the column; "": the column is always shown.
    visible_from : {"always", "tablet", "desk"}
        Smallest screen on which the column is visible.
    """

    title: str
    kind: Literal["text", "name", "full", "line", "number", "rank", "ratio"] = "text"
    group: str = ""
    visible_from: Literal["always", "tablet", "desk"] = "always"


@dataclass(frozen=True)
class Cell:
    """Cell of a row.

    Attributes
    ----------
    value : float, str or None
        Sort key; None is sorted last in both directions.
    below : str
        Second line in small print.
    style_class : str
        "" for text, "flags" for one flag per line, else the CSS class of a label.
    """

    text: str = ""
    value: float | str | None = None
    below: str = ""
    style_class: str = ""


def text_cell(text: str, text_below: str = "") -> Cell:
    """Return a cell sorted by its text."""
    return Cell(text, text or None, text_below)


def number_cell(value: float | None, text: str | None = None, text_below: str = "") -> Cell:
    """Return a cell sorted by a number; an empty cell if the value is None or not finite."""
    if value is None or not math.isfinite(value):
        return Cell()
    return Cell(f"{value:.4g}" if text is None else text, value, text_below)


Section = list[Any]


@dataclass(frozen=True)
class Row:
    """Row of the table.

    Attributes
    ----------
    cells : tuple of Cell
        One per column; the first one names the row and unfolds it.
    tags : tuple of str
        Values that the filters select.
    details, side_sections : tuple of Section
        Left and right column of the unfolded row, made by :func:`list_section` and the other
        functions below; empty sections are omitted.
    """

    cells: tuple[Cell, ...]
    tags: tuple[str, ...] = ()
    details: tuple[Section, ...] = ()
    side_sections: tuple[Section, ...] = ()


# ------------------------------------------------------------------ sections of an unfolded row


def list_section(title: str, texts: Sequence[str], is_warning: bool = False) -> Section:
    """Return a section with a list of texts, highlighted if `is_warning`."""
    return ["list", title, texts, is_warning]


def prose_section(title: str, text: str) -> Section:
    """Return a section with text that keeps its line breaks."""
    return ["prose", title, text]


def pairs_section(title: str, rows: Sequence[tuple[str, str]]) -> Section:
    """Return a section with names and values; rows without a value are omitted."""
    return ["pairs", title, [row for row in rows if row[1]]]


def table_section(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric_columns: Sequence[int] = (),
) -> Section:
    """Return a section with a small table; ``numeric_columns`` are right-aligned."""
    return ["table", title, heads, rows, list(numeric_columns)]


def links_section(title: str, rows: Sequence[tuple[str, str]]) -> Section:
    """Return a section with link texts and relative addresses."""
    return ["links", title, [row for row in rows if row[1]]]


def boxes_section(
    title: str,
    person_id: str,
    rows: Sequence[tuple[str, float, float | None, str]],
    other_rows: Sequence[tuple[str, float | None, str]] = (),
) -> Section:
    """Return a section with input boxes for points and comments, exported as CSV.

    Parameters
    ----------
    person_id : str
        Id of the person in the exported table.
    rows : sequence of (name, maximum, points, comment)
    other_rows : sequence of (name, points, comment)
        Further rows of the exported table, without boxes.
    """
    return ["boxes", title, person_id, rows, other_rows]


# ------------------------------------------------------------------ the page


def page(
    *,
    title: str,
    subtitle: str,
    html_above: str = "",
    noun: tuple[str, str],
    columns: Sequence[Column],
    rows: Sequence[Row],
    filters: Sequence[tuple[str, Sequence[tuple[str, str]]]],
    groups: Sequence[tuple[str, str]] = (),
    placeholder: str,
    full_table_note: str,
    ratio_axis: Mapping[str, Any] | None = None,
) -> str:
    """Make a web page with a table that can be sorted, searched and filtered.

    Parameters
    ----------
    html_above : str
        HTML above the table, made with :func:`~px4fuse.html.safe.load_template`.
    noun : (str, str)
        Name of a row, singular and plural.
    filters : sequence of (label, ((tag, text), ...))
        A selected tag limits the table to rows with it.
    groups : sequence of (group, label)
        Check boxes for groups of columns.
    placeholder : str
        Hint in the search field.
    full_table_note : str
        Sentence for readers without scripts: the file with all rows.
    ratio_axis : mapping, optional
        Scale of the plots in columns of ratios: ``ends``, ``bands`` and ``marks`` (SVG paths).
        The second word of the style class of a cell is a key of ``bands`` and ``marks``.

    Returns
    -------
    str
        HTML, identical for the same input; write it as UTF-8.
    """
    style = "".join(map(read_asset, ("colours.css", "base.css", "frame.css")))
    script = "".join(map(read_asset, ("dom.js", "frame.js")))
    content = {
        "columns": [(c.title, c.kind, c.group, c.visible_from) for c in columns],
        "rows": [
            (
                [_compact(cell) for cell in row.cells],
                row.tags,
                *(
                    [section for section in column if section[2]]
                    for column in (row.details, row.side_sections)
                ),
            )
            for row in rows
        ],
        "size": MAX_PAGE_ROWS,
        "nouns": noun,
        "axis": ratio_axis or {},
    }
    return load_template("html/frame.html").render(
        style_hash=policy_hash(style),
        script_hash=policy_hash(script),
        style=style,
        script=script,
        title=title,
        subtitle=subtitle,
        above=html_above,
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
    """Return the fields of a table cell without empty fields at the end.

    A value that equals the text of the cell is replaced by True.
    """
    value = True if cell.value == cell.text else "" if cell.value is None else cell.value
    fields = [cell.text, value, cell.below, cell.style_class]
    while fields and fields[-1] == "":
        fields.pop()
    return fields
