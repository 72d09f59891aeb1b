"""Results of a comparison → rows of the fleet's table, and how that table is written."""

import csv
from collections.abc import Iterable, Mapping
from functools import reduce
from importlib.resources import files
from typing import Any

import pandas as pd

from px4fuse.ekf2.aids import AidResult
from px4fuse.findings import Finding
from px4fuse.plain import utc_time
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, Log
from px4fuse.spreadsheet import neutralise_formulas

DONE, NOT_JUDGED, FAILED = "done", "not judged", "failed"
FINDING_SEPARATOR = ";"
# Which tuning speaks for an axis
_TUNING_OF_AXIS = {"north": "horizontal", "east": "horizontal"}


def read_rows(name: str) -> list[dict[str, str]]:
    """Rows of a table of this folder, by the titles of its columns."""
    with files("px4fuse.fleet").joinpath(name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


_COLUMNS = read_rows("columns.csv")
#: Columns of the table and where each stands in the results; empty where it is put together
PLACES = {row["column"]: row["place"] for row in _COLUMNS}
#: Types of the columns; absent numbers are NA, absent texts are empty
COLUMNS = {row["column"]: row["type"] for row in _COLUMNS}

Row = dict[str, Any]


def at(found: object, path: str) -> Any:
    """What stands at a place in the results; None where there is nothing."""

    def below(part: Any, name: str) -> Any:
        if isinstance(part, tuple):
            return part[int(name)]
        return part.get(name) if isinstance(part, Mapping) else getattr(part, name, None)

    return reduce(below, path.split("."), found)


def axis_rows(results: ComparisonResults) -> list[Row]:
    """Rows of one log, an axis each; columns that are not in them are absent.

    A factor says how many times √S is overstated (above 1) or understated (below 1), as
    ``sigma_factor`` in the results. SIGMA_Z and SIGMA_A are what the data ask for, north and
    east together. The clock offset is there where it is determinable.
    """
    common = log_columns(results.log) | finding_columns(results.findings, results.aids)
    common["story"] = "\n".join(results.story)
    clock = bool(at(results, "clock.determinable"))
    rows = []
    for name, axis in results.axes.items():
        unavailable = next((f for f in axis.filters.values() if isinstance(f, Unavailable)), None)
        row = common | {
            "axis": name,
            "status": NOT_JUDGED if isinstance(axis.filters["kf"], Unavailable) else DONE,
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
    """Causes among the findings, and the verdict on each aid that EKF2 fused."""
    causes = [one for one in findings if one.caused_by is None]
    fused = [f"{name} {aid.verdict}" for name, aid in aids.items() if aid.verdict != "idle"]
    return {
        "aids": FINDING_SEPARATOR.join(fused),
        "findings": FINDING_SEPARATOR.join(one.id for one in causes),
        "severities": sorted({one.severity for one in causes}),
    }


def log_columns(log: Log) -> Row:
    """What is known of a log once it is read."""
    start, values = utc_time(log.start_unix_s), {"log": log}
    places = {name: place for name, place in PLACES.items() if place.startswith("log.")}
    return {name: at(values, place) for name, place in places.items()} | {
        "airframe": f"{airframe:g}" if (airframe := log.parameters.get("SYS_AUTOSTART")) else "",
        "date": f"{start[:19]}Z" if start else "",
    }


def fleet_table(rows: Iterable[Row]) -> pd.DataFrame:
    """The fleet's table: all columns in their order, with their types."""
    texts = dict.fromkeys((name for name, kind in COLUMNS.items() if kind == "str"), "")
    known = [texts | clean_row(row) for row in rows]
    return pd.DataFrame(known, columns=list(COLUMNS)).astype(COLUMNS)


def clean_row(row: Row) -> Row:
    """A row without what is absent, and what is not UTF-8 in a file's name replaced."""
    return {
        name: value.encode(errors="replace").decode() if isinstance(value, str) else value
        for name, value in row.items()
        if value is not None
    }


def csv_bytes(table: pd.DataFrame) -> bytes:
    """The table for Excel and LibreOffice, in which no text of a log acts as a formula."""
    texts = {
        name: table[name].map(neutralise_formulas)
        for name, kind in COLUMNS.items()
        if kind == "str"
    }
    text = table.assign(**texts).to_csv(index=False, lineterminator="\r\n", float_format="%.10g")
    return ("\ufeff" + text).encode()
