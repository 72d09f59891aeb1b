"""Rows of the table of ``px4fuse batch``: one row per log and axis."""

import shlex
from collections.abc import Iterable, Mapping
from itertools import groupby, product
from typing import Any

import pandas as pd

from px4fuse.card.model import DiagnosisCard
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.record import Unavailable, read_csv
from px4fuse.core.text import format_utc_time, neutralise_formulas, replace_unencodable
from px4fuse.ekf2.aids import AidResult
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.finding import Finding
from px4fuse.request import quote_command
from px4fuse.results.contract import ComparisonResults, Log

STATUS_DONE, STATUS_NOT_COMPARED, STATUS_FAILED = "done", "not compared", "failed"
FINDING_SEPARATOR = ";"


# Columns of the table of px4fuse batch: rows of columns.csv. A row that contains FILTER is repeated
# with the name of each filter. A row without FILTER is repeated unchanged, and the dictionaries
# below keep it once
_COLUMN_DEFINITIONS = [
    {key: text.replace("FILTER", name) for key, text in row.items()}
    for _, rows in groupby(
        read_csv(__file__, dict[str, str], "columns.csv"), lambda row: "FILTER" in row["column"]
    )
    for name, row in product(FILTER_NAMES, rows)
]
#: Path of each table column in the results, for example ``log.firmware``. A path that begins with
#: "axis", "tuning" or "agreement" refers to the results of the axis of the table row
RESULT_PATH_BY_COLUMN = {row["column"]: row["path"] for row in _COLUMN_DEFINITIONS}
#: Data type of each table column; missing numbers are NA, and missing texts are empty
COLUMN_TYPES = {row["column"]: row["type"] or "str" for row in _COLUMN_DEFINITIONS}
TEXT_COLUMNS = [name for name, kind in COLUMN_TYPES.items() if kind == "str"]

Row = dict[str, Any]


def find_value(results: object, path: str) -> Any:
    """Return the value at a path such as "axes.north.updates", or None if it is missing."""
    value: Any = results
    for name in path.split("."):
        if isinstance(value, tuple):
            value = value[int(name)]
        else:
            value = value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)
    return value


def make_axis_rows(results: ComparisonResults) -> list[Row]:
    """Return the table rows of one log, one per axis."""
    common_values = collect_log_values(results.log) | collect_finding_values(
        results.findings, results.aids
    )
    common_values |= collect_card_values(results.card)
    is_offset_determinable = bool(find_value(results, "clock.is_determinable"))
    rows = []
    for name, axis in results.axes.items():
        unavailable_filter = next(
            (summary for summary in axis.filters.values() if isinstance(summary, Unavailable)), None
        )
        row = common_values | {"axis": name, "status": STATUS_DONE}
        if isinstance(axis.filters["kf"], Unavailable):
            row["status"] = STATUS_NOT_COMPARED
        if unavailable_filter:
            row["reason"] = f"{unavailable_filter.what}: {unavailable_filter.reason}"
            row["remedy"] = unavailable_filter.remedy
        records = {
            "axis": axis,
            # north and east have one noise estimate together
            "tuning": results.tuning.get(HORIZONTAL if name in ("north", "east") else name),
            "agreement": find_value(results, f"ekf2_replay.agreement.{name}"),
            "clock": results.clock if is_offset_determinable else None,
            "source": results.source,
            "provenance": results.provenance,
        }
        values = {
            column: find_value(records, path) for column, path in RESULT_PATH_BY_COLUMN.items()
        }
        # values in ``row`` have priority. clean_row() removes missing values
        rows.append(clean_row(values | row))
    return rows


def collect_finding_values(findings: Iterable[Finding], aids: Mapping[str, AidResult]) -> Row:
    """Return the values of the table columns about findings and about EKF2's aiding sources.

    Findings that are an effect of another finding are omitted.
    """
    cause_findings = [finding for finding in findings if finding.caused_by is None]
    aid_verdicts = [
        f"{name} {aid.verdict}" for name, aid in aids.items() if aid.verdict != "disabled"
    ]
    return {
        "aids": FINDING_SEPARATOR.join(aid_verdicts),
        "findings": FINDING_SEPARATOR.join(finding.id for finding in cause_findings),
        "severities": sorted({finding.severity for finding in cause_findings}),
    }


def collect_card_values(card: DiagnosisCard) -> Row:
    """Return the diagnosis of a flight as columns of the table of ``px4fuse batch``.

    Columns: headline, recommended action, position RMSE, ratios of actual to reported σ, ...
    """
    rmse_values_m = card.effect.position_rmse_m.values() if card.effect else ()
    return {
        "severity": card.severity,
        "headline": card.headline,
        "action": find_first_action(card),
        "changed": "; ".join((*card.identity.changed, *card.identity.parameters)),
        "verdicts": FINDING_SEPARATOR.join(
            f"{verdict.word}, explained" if verdict.is_explained else verdict.word
            for verdict in card.verdicts
        ),
        **{f"{verdict.filter}_{verdict.against}_ratio": verdict.ratio for verdict in card.verdicts},
        "position_rmse_m": max(rmse_values_m, default=None),
        "difference_rms_m": card.effect.difference_rms_m if card.effect else None,
    }


def find_first_action(card: DiagnosisCard) -> str:
    """Return the commands, or else the text, of the first recommended action."""
    if not card.causes:
        return ""
    first_cause = card.causes[0]
    # the user takes one group of alternatives, and then the further actions
    actions = first_cause.actions
    if first_cause.alternatives:
        actions = first_cause.alternatives[0] + actions
    for action in actions:
        if action.commands:
            return "\n".join(action.commands)
        # The action, such as the repair of a sensor, has no command. It comes before all commands,
        # so return its text
        if action.changes_something():
            break
    return card.do_this[0] if card.do_this else ""


def replace_name_by_path(row: Row, path: str) -> Row:
    """Replace the file name of the log by its path, in the command of a table row.

    >>> row = {"name": "a.ulg", "action": "px4fuse compare a.ulg --sigma-a 0.4"}
    >>> replace_name_by_path(row, "my logs/a.ulg")["action"]
    "px4fuse compare 'my logs/a.ulg' --sigma-a 0.4"
    """
    action = row.get("action", "")
    if not action.startswith("px4fuse "):
        return row
    command_words = [path if word == row["name"] else word for word in shlex.split(action)]
    return row | {"action": quote_command(command_words)}


def collect_log_values(log: Log) -> Row:
    """Return the table columns that describe the log itself, such as vehicle and date."""
    start_utc = format_utc_time(log.start_unix_s)
    return {
        name: find_value({"log": log}, path)
        for name, path in RESULT_PATH_BY_COLUMN.items()
        if path.startswith("log.")
    } | {
        "airframe": f"{airframe:g}" if (airframe := log.parameters.get("SYS_AUTOSTART")) else "",
        "date": f"{start_utc[:19]}Z" if start_utc else "",
    }


def make_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Make the table of all logs, with the columns and data types of COLUMN_TYPES."""
    empty_texts = dict.fromkeys(TEXT_COLUMNS, "")
    return pd.DataFrame(
        [empty_texts | clean_row(row) for row in rows], columns=list(COLUMN_TYPES)
    ).astype(COLUMN_TYPES)


def clean_row(row: Row) -> Row:
    """Remove missing values, and replace bytes of file names that are not UTF-8."""
    return {
        name: replace_unencodable(value) if isinstance(value, str) else value
        for name, value in row.items()
        if value is not None
    }


def format_csv(table: pd.DataFrame) -> bytes:
    """Format the table as CSV; texts that a spreadsheet would run as formulas are escaped."""
    csv_text = table.assign(**table[TEXT_COLUMNS].map(neutralise_formulas)).to_csv(
        index=False, lineterminator="\r\n", float_format="%.10g"
    )
    return ("\ufeff" + csv_text).encode()
