"""Rows of the table of ``px4fuse batch``, made of results, and their formats."""

import csv
from collections.abc import Iterable, Mapping
from functools import reduce
from importlib.resources import files
from typing import Any

import pandas as pd

from px4fuse.ekf2.aids import AidResult
from px4fuse.findings import Finding
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, Log
from px4fuse.spreadsheet import neutralise_formulas
from px4fuse.text import utc_time

DONE, NOT_COMPARED, FAILED = "done", "not compared", "failed"
FINDING_SEPARATOR = ";"
# Tuning result of each axis
_TUNING_OF_AXIS = {"north": "horizontal", "east": "horizontal"}


def read_rows(name: str) -> list[dict[str, str]]:
    """Read a CSV file of this folder as dicts by column title."""
    with files("px4fuse.fleet").joinpath(name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


_COLUMNS = read_rows("columns.csv")
#: Columns of the table with their path in the results; empty if the value is composed
PLACES = {row["column"]: row["place"] for row in _COLUMNS}
#: Types of the columns; missing numbers are NA, missing texts are empty
COLUMNS = {row["column"]: row["type"] for row in _COLUMNS}

Row = dict[str, Any]


def at(results: object, path: str) -> Any:
    """Return the value at a path in the results; None if there is none."""

    def below(parent: Any, name: str) -> Any:
        if isinstance(parent, tuple):
            return parent[int(name)]
        return parent.get(name) if isinstance(parent, Mapping) else getattr(parent, name, None)

    return reduce(below, path.split("."), results)


def axis_rows(results: ComparisonResults) -> list[Row]:
    """Return the rows of one log, one per axis; columns without a value are absent.

    A σ ratio is actual σ over reported σ: above 1 the filter is overconfident. SIGMA_Z and
    SIGMA_A are the maximum-likelihood estimates, for north and east together. The clock
    offset is present if it is determinable.
    """
    common = log_columns(results.log) | finding_columns(results.findings, results.aids)
    common["summary"] = "\n".join(results.summary)
    clock = bool(at(results, "clock.is_determinable"))
    rows = []
    for name, axis in results.axes.items():
        unavailable = next((f for f in axis.filters.values() if isinstance(f, Unavailable)), None)
        row = common | {
            "axis": name,
            "status": NOT_COMPARED if isinstance(axis.filters["kf"], Unavailable) else DONE,
            "reason": f"{unavailable.what}: {unavailable.reason}" if unavailable else "",
            "remedy": unavailable.remedy if unavailable else "",
        }
        for column, place in PLACES.items():
            if column not in row and place and (clock or not place.startswith("clock.")):
                tuned = _TUNING_OF_AXIS.get(name, name)
                row[column] = at(results, place.format(axis=name, tuned=tuned))
        rows.append(row)
    return rows


def finding_columns(findings: Iterable[Finding], aids: Mapping[str, AidResult]) -> Row:
    """Return the findings that are causes, and the verdict on each aid that EKF2 fused."""
    causes = [finding for finding in findings if finding.caused_by is None]
    fused = [f"{name} {aid.verdict}" for name, aid in aids.items() if aid.verdict != "disabled"]
    return {
        "aids": FINDING_SEPARATOR.join(fused),
        "findings": FINDING_SEPARATOR.join(finding.id for finding in causes),
        "severities": sorted({finding.severity for finding in causes}),
    }


def log_columns(log: Log) -> Row:
    """Return the columns that describe the log."""
    start, values = utc_time(log.start_unix_s), {"log": log}
    places = {name: place for name, place in PLACES.items() if place.startswith("log.")}
    return {name: at(values, place) for name, place in places.items()} | {
        "airframe": f"{airframe:g}" if (airframe := log.parameters.get("SYS_AUTOSTART")) else "",
        "date": f"{start[:19]}Z" if start else "",
    }


def fleet_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Make the table of all rows, with all columns in order and with their types."""
    texts = dict.fromkeys((name for name, kind in COLUMNS.items() if kind == "str"), "")
    filled_rows = [texts | clean_row(row) for row in rows]
    return pd.DataFrame(filled_rows, columns=list(COLUMNS)).astype(COLUMNS)


def clean_row(row: Row) -> Row:
    """Drop missing values, and replace bytes of file names that are not UTF-8."""
    return {
        name: value.encode(errors="replace").decode() if isinstance(value, str) else value
        for name, value in row.items()
        if value is not None
    }


def csv_bytes(table: pd.DataFrame) -> bytes:
    """Write the table as CSV for Excel and LibreOffice, without active formulas."""
    texts = {
        name: table[name].map(neutralise_formulas)
        for name, kind in COLUMNS.items()
        if kind == "str"
    }
    text = table.assign(**texts).to_csv(index=False, lineterminator="\r\n", float_format="%.10g")
    return ("\ufeff" + text).encode()
