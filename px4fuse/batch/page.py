"""Web page of ``px4fuse batch``: a sortable table with one row per log."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from typing import Any

import pandas as pd

from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import (
    format_count,
    format_metres,
    format_number,
    format_ratio,
    join_first_names,
    shorten_to_line,
)
from px4fuse.findings.model import finding_title
from px4fuse.html import frame
from px4fuse.html.frame import Cell, Column, Row, RowDetailsSection
from px4fuse.html.safe import load_template, make_relative_url
from px4fuse.report.card_html import SIGMA_RATIO_AXIS
from px4fuse.report.card_text import SEVERITY_SIGNS, SYMBOL_BY_REFERENCE, format_consistent_ratios

from .rows import (
    FINDING_SEPARATOR,
    RESULT_PATH_BY_COLUMN,
    STATUS_DONE,
    STATUS_FAILED,
    STATUS_NOT_COMPARED,
)

# Columns of σ ratios from innovations (source) and from errors against ground truth (truth)
SIGMA_RATIO_LABELS = {
    f"{filter_name}_{reference}": f"{filter_label} {symbol}"
    for filter_name, filter_label in FILTER_NAMES.items()
    for reference, symbol in SYMBOL_BY_REFERENCE.items()
}
SEVERITIES = list(SEVERITY_SIGNS)
FILE_LINKS = (("Report (PDF)", "report"), ("Results (JSON)", "results"))
# Table columns with one value per axis
AXIS_COLUMNS = [
    name
    for name, path in RESULT_PATH_BY_COLUMN.items()
    if path.startswith(("axis.", "tuning.", "agreement."))
]
# Values of a log, by table column, that the page shows under "Flight" below the row of the log
LOG_COLUMNS = (
    *("log", "log_sha256", "px4fuse", "settings", "vehicle", "firmware", "firmware_hash"),
    *("airframe", "hardware", "date", "duration_s", "source", "source_rate_hz", "aids"),
    "position_rmse_m",
)
# Group of columns that the page hides until the user clicks on "more columns"
OPTIONAL_COLUMN_GROUP = "numbers"
# Order of preference: the page shows the numbers of the first of these axes that a log has
AXES_BY_PREFERENCE = ("aisle", "north", "east", "down")

#: Values of one log by name
LogSummary = Mapping[str, Any]


def format_html(table: pd.DataFrame, title: str, version_text: str) -> str:
    """Format the table of logs as an HTML page.

    Parameters
    ----------
    table : DataFrame
        One row per log and axis, with the columns of :data:`px4fuse.batch.rows.COLUMN_TYPES`.
    title : str
    version_text : str
        Name and version of px4fuse.
    """
    logs = summarise_logs(table)
    rows = [
        Row(
            _make_log_cells(log),
            tuple(
                f"{label}:{value}"
                for label, values in log["filter_values"].items()
                for value in values
            ),
            _make_log_details(log),
            _make_file_and_flight_sections(log),
        )
        for log in logs
    ]
    return frame.page(
        title=title,
        subtitle=f"{format_count(len(logs), 'log')}. Compared by {version_text}.",
        html_above_table=load_template("batch/axis.html").render(limits=format_consistent_ratios()),
        rows_name="logs",
        columns=(
            Column("Sign", "rank"),
            Column("Log", "name"),
            Column("Diagnosis and first action", "full"),
            *(Column(label, "ratio", is_on_phones=False) for label in SIGMA_RATIO_LABELS.values()),
            Column("KF − EKF2 (m)", "number", is_on_phones=False),
            *(
                Column(label, "line", OPTIONAL_COLUMN_GROUP)
                for label in ("Date (UTC)", "Vehicle", "Firmware")
            ),
            Column("SIGMA_Z estimate (m)", "number", OPTIONAL_COLUMN_GROUP),
            Column("Time offset (s)", "number", OPTIONAL_COLUMN_GROUP),
            Column("Findings", "rank", OPTIONAL_COLUMN_GROUP),
        ),
        rows=rows,
        filters=_make_drop_down_lists(logs),
        column_groups=[(OPTIONAL_COLUMN_GROUP, "more columns")],
        search_placeholder="search by name, vehicle, firmware or finding",
        full_table_note="fleet.csv contains the table of all logs.",
        sigma_ratio_axis=SIGMA_RATIO_AXIS,
    )


def _make_log_cells(log: LogSummary) -> tuple[Cell, ...]:
    """Return the cells of a log in the table of the web page: diagnosis, σ ratios, properties."""
    finding_titles = [finding_title(finding) for finding in log["findings"]]
    severity, action = log["severity"], log.get("action", "")
    css_class = "command" if action.startswith(("px4fuse ", "param ")) else ""
    return (
        Cell(SEVERITY_SIGNS[severity], SEVERITIES.index(severity), style_class=f"sign {severity}"),
        Cell(log["name"], second_line=log.get("changed", "")),
        Cell(log["headline"], second_line=action, style_class=css_class),
        *(
            _make_ratio_cell(log.get(f"{name}_ratio"), name, verdict)
            # a log without results has no verdicts
            for name, verdict in zip_longest(SIGMA_RATIO_LABELS, log["verdicts"], fillvalue="")
        ),
        frame.make_number_cell(log.get("difference_rms_m"), format_metres),
        Cell(log.get("date", "")[:10]),
        Cell(log.get("vehicle", "")),
        Cell(log.get("firmware", "")),
        frame.make_number_cell(log.get("sigma_z_m"), format_number),
        frame.make_number_cell(log.get("clock_offset_s"), format_number),
        frame.make_number_cell(
            None if log["status"] == STATUS_FAILED else len(finding_titles),
            second_line=join_first_names(finding_titles, 2),
        ),
    )


def _make_ratio_cell(ratio: float | None, column_name: str, verdict: str) -> Cell:
    """Return the cell of a σ ratio; empty for None."""
    if ratio is None:
        return Cell()
    emphasis_css_class = " loud" if verdict in ("overconfident", "underconfident") else ""
    return Cell(
        format_ratio(ratio),
        ratio,
        style_class=column_name.replace("_", " ") + emphasis_css_class,
    )


def sort_logs(logs: Iterable[LogSummary]) -> list[LogSummary]:
    """Sort logs by severity, then |ln(σ ratio)|, then position RMSE, largest first."""

    def compute_sort_key(log: LogSummary) -> tuple[float, ...]:
        """Return the key that sorts logs: first the most severe, then the least consistent."""
        # σ ratios of this log; a missing ratio, or a ratio of 0 (without logarithm), is omitted
        ratios = [log[key] for name in SIGMA_RATIO_LABELS if log.get(key := f"{name}_ratio")]
        largest_log_ratio = max((abs(math.log(ratio)) for ratio in ratios), default=0.0)
        return (
            SEVERITIES.index(log["severity"]),
            -largest_log_ratio,
            -log.get("position_rmse_m", 0.0),
        )

    return sorted(logs, key=compute_sort_key)


def _make_log_details(log: LogSummary) -> tuple[RowDetailsSection, ...]:
    """Return the sections that open below a log in the table of the web page."""
    # one row per quantity: its name, and its value for each axis. Rows without a value are omitted
    value_rows = [
        [name, *(_format_value(axis.get(name, "")) for axis in log["axes"])]
        for name in AXIS_COLUMNS
        if any(name in axis for axis in log["axes"])
    ]
    column_titles = ["", *(axis["axis"] for axis in log["axes"])]
    return (
        frame.make_list_section(
            "Missing results",
            [reason for reason, _ in log["missing_results"] if reason],
            is_warning=True,
        ),
        frame.make_list_section(
            # each action once: several axes may need the same action
            "Actions",
            list(dict.fromkeys(remedy for _, remedy in log["missing_results"] if remedy)),
        ),
        frame.make_list_section(
            "Findings",
            [f"{finding_title(finding_id)} ({finding_id})" for finding_id in log["findings"]],
        ),
        frame.make_table_section("Axes", value_rows, column_titles, range(1, len(column_titles))),
    )


def _make_file_and_flight_sections(log: LogSummary) -> tuple[RowDetailsSection, ...]:
    """Return the links to report and results of a log, and the values that describe the flight."""
    return (
        frame.make_links_section(
            "Files", [(label, make_relative_url(log.get(name, ""))) for label, name in FILE_LINKS]
        ),
        frame.make_name_value_section(
            "Flight", [(name, _format_value(log.get(name, ""))) for name in LOG_COLUMNS]
        ),
    )


def _format_value(value: str | float) -> str:
    return value if isinstance(value, str) else format_number(float(value))


def _make_drop_down_lists(logs: Sequence[LogSummary]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the lists that filter logs: label, and options (tag, text), most frequent first."""
    counts_by_label: dict[str, Counter[str]] = defaultdict(Counter)
    for log in logs:
        for label, values in log["filter_values"].items():
            counts_by_label[label].update(values)
    drop_down_lists = []
    for label, counts in counts_by_label.items():
        options = [("", "All")]
        for value, count in counts.most_common():
            options.append((f"{label}:{value}", f"{shorten_to_line(value, 60)} ({count})"))
        if counts:
            drop_down_lists.append((label, options))
    return drop_down_lists


# -------------------- combination of the table rows of each log


def summarise_logs(table: pd.DataFrame) -> list[LogSummary]:
    """Combine the table rows of each log, one per axis, into one summary; sort the summaries."""
    rows_by_log: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in table.to_dict("records"):
        rows_by_log[row["log"]].append(
            {str(name): value for name, value in row.items() if pd.notna(value) and value != ""}
        )
    return sort_logs(map(_summarise_log, rows_by_log.values()))


def _summarise_log(rows: list[dict[str, Any]]) -> LogSummary:
    """Combine the table rows of one log, one per axis, into one summary.

    The summary contains the values of the preferred axis, and values that combine all axes.
    """
    summary: dict[str, Any] = {}
    # the preferred axis is the last, so that its values replace those of the other axes
    for row in sorted(
        rows, key=lambda row: AXES_BY_PREFERENCE.index(row.get("axis", "aisle")), reverse=True
    ):
        summary |= row
    # a log is done if the results of at least one axis are done
    is_done = any(row["status"] == STATUS_DONE for row in rows)
    summary["status"] = STATUS_DONE if is_done else rows[0]["status"]
    if "headline" not in summary:  # a log without results has no diagnosis: show the reason instead
        is_refused = summary["status"] != STATUS_NOT_COMPARED
        status_text = "refused" if is_refused else STATUS_NOT_COMPARED
        summary |= {
            "severity": "refused",
            "headline": f"{status_text}: {summary.get('reason', '')}",
            "action": summary.get("remedy", ""),
        }
    reasons_and_remedies = ((row.get("reason", ""), row.get("remedy", "")) for row in rows)
    summary |= {
        "missing_results": tuple(dict.fromkeys(pair for pair in reasons_and_remedies if any(pair))),
        "axes": [row for row in rows if "axis" in row],
        "findings": [id_ for id_ in summary.get("findings", "").split(FINDING_SEPARATOR) if id_],
        "verdicts": summary.get("verdicts", "").split(FINDING_SEPARATOR),
    }
    return summary | {"filter_values": _list_filter_values(summary)}


def _list_filter_values(log: LogSummary) -> dict[str, list[str]]:
    """Return the values by which the page filters logs, by label of the drop-down list."""
    actions = [remedy or "no action" for _, remedy in log["missing_results"]]
    return {
        "Diagnosis": [log["severity"]],
        "Status": [log["status"]],
        "Vehicle": [log.get("vehicle", "vehicle unknown")],
        "Firmware": [log.get("firmware", "firmware unknown")],
        "Finding": list(dict.fromkeys(map(finding_title, log["findings"]))),
        "Action": list(dict.fromkeys(actions)),
    }
