"""Web page with one table. Users can sort, search and filter rows, and show their details."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from .safe import (
    clean_texts,
    compute_csp_hash,
    encode_safe_json,
    load_template,
    read_asset,
)

MAX_PAGE_ROWS = 100  # maximum number of rows on one page of the table


class Column(NamedTuple):
    """Column of the table on a web page.

    Attributes
    ----------
    kind : str
        Type of the cells. A click on a "name" shows or hides the details of the row. "rank" sorts
        texts by a number.
    group : str
        Check box that shows or hides the column; "" if it is always shown.
    is_on_phones : bool
        False if the column is hidden on small screens.
    """

    title: str
    kind: Literal["text", "name", "full", "line", "number", "rank", "ratio"] = "text"
    group: str = ""
    is_on_phones: bool = True


class Cell(NamedTuple):
    """Cell of the table: text, text of the second line, sort key ``value`` of a numeric column."""

    text: str = ""
    value: float | None = None
    second_line: str = ""
    style_class: str = ""


def make_number_cell(
    value: float | None,
    format_value: Callable[[float], str] = "{:.4g}".format,
    second_line: str = "",
) -> Cell:
    """Return a cell with a number; empty if the number is None or not finite."""
    if value is None or not math.isfinite(value):
        return Cell()
    return Cell(format_value(value), value, second_line)


# Section of the details of a table row, as a list for frame.js: kind, title, contents
RowDetailsSection = list[Any]


@dataclass(frozen=True)
class Row:
    """Row of the table; drop-down lists filter rows by ``tags``.

    The page shows ``details`` and ``side_sections`` after a click on the row.
    """

    cells: tuple[Cell, ...]
    tags: tuple[str, ...] = ()
    details: tuple[RowDetailsSection, ...] = ()
    side_sections: tuple[RowDetailsSection, ...] = ()


# ------------------------------------------------------------------ sections of an unfolded row


def make_list_section(
    title: str, texts: Sequence[str], is_warning: bool = False
) -> RowDetailsSection:
    return ["list", title, texts, is_warning]


def make_prose_section(title: str, text: str) -> RowDetailsSection:
    """Return a section with a text, whose line breaks are kept."""
    return ["prose", title, text]


def make_name_value_section(title: str, rows: Sequence[tuple[str, str]]) -> RowDetailsSection:
    """Return a section with pairs (name, value); empty values are omitted."""
    return ["pairs", title, [row for row in rows if row[1]]]


def make_table_section(
    title: str,
    rows: Sequence[Sequence[str]],
    column_titles: Sequence[str],
    numeric_columns: Sequence[int] = (),
) -> RowDetailsSection:
    return ["table", title, rows, column_titles, list(numeric_columns)]


def make_links_section(title: str, rows: Sequence[tuple[str, str]]) -> RowDetailsSection:
    return ["links", title, [row for row in rows if row[1]]]


def make_input_boxes_section(
    title: str,
    student_id: str,
    rows: Sequence[tuple[str, float, float | None, str]],
    rows_without_boxes: Sequence[tuple[str, float | None, str]],
) -> RowDetailsSection:
    """Return a section in which an instructor enters points and comments.

    Parameters
    ----------
    rows : sequence of (item, maximum, points, comment)
        Rows with input boxes.
    rows_without_boxes : sequence of (item, points, comment)
        Rows without input boxes.

    The page writes the rows of both kinds to one CSV file.
    """
    return ["boxes", title, student_id, rows, rows_without_boxes]


def _omit_empty(sections: Sequence[RowDetailsSection]) -> list[RowDetailsSection]:
    return [section for section in sections if section[2]]


# ------------------------------------------------------------------ the page


def page(
    *,
    columns: Sequence[Column],
    rows: Sequence[Row],
    sigma_ratio_axis: Mapping[str, Any] | None = None,
    **fields: object,
) -> str:
    """Make a web page with a table that can be sorted, searched and filtered.

    Parameters
    ----------
    columns, rows
        Contents of the table. The sections of a row without contents are omitted.
    sigma_ratio_axis : mapping, optional
        Axis of the columns with σ ratios: range, shaded bands and marks.
    title, subtitle, html_above_table : str
    rows_name : str
        Name of the rows (plural).
    filters : sequence of (label, ((tag, text), ...))
        Drop-down lists that filter rows by a tag.
    column_groups : sequence of (group, label)
        Check boxes that show or hide groups of columns.
    search_placeholder : str
        Hint in the search field.
    full_table_note : str
        Sentence about the file with all rows.

    All parameters from ``title`` on are fields of the template ``frame.html``, which raises an
    error if one is missing.
    """
    css_text = "".join(map(read_asset, ("colours.css", "base.css", "frame.css")))
    script = "".join(map(read_asset, ("dom.js", "frame.js")))
    page_data = {
        "columns": columns,
        "rows": [
            (row.cells, row.tags, _omit_empty(row.details), _omit_empty(row.side_sections))
            for row in rows
        ],
        "size": MAX_PAGE_ROWS,
        "axis": sigma_ratio_axis or {},
    }
    return load_template("html/frame.html").render(
        style_hash=compute_csp_hash(css_text),
        script_hash=compute_csp_hash(script),
        style=css_text,
        script=script,
        content=encode_safe_json(clean_texts(page_data)),
        **fields,
    )
