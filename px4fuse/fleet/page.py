"""Web page of ``px4fuse batch``: a sortable table with one row per log."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import pandas as pd

from px4fuse.findings import finding_title
from px4fuse.fleet.rows import DONE, FAILED, FINDING_SEPARATOR, NOT_COMPARED, RESULT_PATHS
from px4fuse.text import format_factor, format_number, join_first
from px4fuse.webpage import frame
from px4fuse.webpage.frame import Cell, Column, Row, Section
from px4fuse.webpage.safe import clean, local_link

STATUS_STYLES = {DONE: "good", NOT_COMPARED: "open", FAILED: "bad"}
FILE_LINKS = (("Report (PDF)", "report"), ("Results (JSON)", "results"))
# Columns that the page shows if the user opens a row: one value per axis, and one per log
AXIS_COLUMNS = [name for name, path in RESULT_PATHS.items() if "{" in path]
LOG_COLUMNS = [
    name
    for name, path in RESULT_PATHS.items()
    if name
    not in (
        *AXIS_COLUMNS,
        "axis",
        "status",
        "reason",
        "remedy",
        "summary",
        "findings",
        "results",
        "report",
    )
]
FILTERS = (
    ("Status", "status", "All"),
    ("Vehicle", "vehicle", "All"),
    ("Firmware", "firmware", "All"),
    ("Finding", "finding", "All"),
    ("Action", "remedy", "All"),
)
# Maximum ratio of actual to reported σ, or of reported to actual σ, of a consistent filter
MAX_CONSISTENT_RATIO = 1.25
# Axes whose numbers are shown for the log: the aisle if it exists, else north and east, else down
MAIN_AXES = (("aisle",), ("north", "east"), ("down",))

#: Entry of one log: the non-empty columns of its rows, of the main axes if present, and
#: ``sigma_ratios`` (by "kf" and "ekf2": actual over reported σ, √(mean NIS) of the main axes),
#: ``status`` ("done" if one axis is), ``lacking`` (reasons for missing results, with actions),
#: ``axes`` (rows with an axis), ``findings`` (ids) and ``tags`` (label by page filter value)
Log = Mapping[str, Any]


def html_text(table: pd.DataFrame, title: str, made_with: str) -> str:
    """Write the table of logs as one HTML file.

    Parameters
    ----------
    table : DataFrame
        One row per log and axis, with the columns of :data:`px4fuse.fleet.rows.COLUMN_TYPES`; a log
        that could not be read has one row without axis.
    made_with : str
        Name and version of px4fuse.

    Returns
    -------
    str
        HTML to write as UTF-8; equal for equal input, because it does not contain the date.
    """
    logs = logs_of(table)
    names = short_names(logs)
    rows = []
    for log in logs:
        finding_titles = [finding_title(finding) for finding in log["findings"]]
        vehicle = log.get("vehicle", "")
        cells = (
            Cell(log["name"], log["name"], log["log"].rpartition("/")[0]),
            frame.text_cell(log.get("date", "")[:10]),
            frame.text_cell(names.get(vehicle, str(vehicle))),
            frame.text_cell(log.get("firmware", "")),
            Cell(log["status"], log["status"], style_class=STATUS_STYLES[log["status"]]),
            *(
                _value_cell(log["sigma_ratios"].get(filter_name), describe_sigma_ratio)
                for filter_name in ("kf", "ekf2")
            ),
            *(
                _value_cell(log.get(name), format_number)
                for name in ("sigma_z_m", "clock_offset_s", "position_rms_m")
            ),
            Cell()
            if log["status"] == FAILED
            else frame.number_cell(float(len(finding_titles)), below=join_first(finding_titles, 2)),
        )
        rows.append(Row(cells, tuple(log["tags"]), _details(log), _side_sections(log)))
    return frame.page(
        title=title,
        subtitle=f"{len(logs)} log{'' if len(logs) == 1 else 's'}, compared with {made_with}",
        noun=("log", "logs"),
        columns=(
            Column("Log"),
            Column("Date (UTC)", "line", visible_from="tablet"),
            Column("Vehicle", "line", visible_from="desk"),
            Column("Firmware", "line", visible_from="desk"),
            Column("Status"),
            Column("σ of KF", "number"),
            Column("σ of EKF2", "number", visible_from="tablet"),
            Column("SIGMA_Z estimate (m)", "number", visible_from="tablet"),
            Column("Time offset (s)", "number", visible_from="desk"),
            Column("KF - EKF2, RMS (m)", "number", visible_from="desk"),
            Column("Findings", "rank", visible_from="desk"),
        ),
        rows=rows,
        filters=_filters(logs),
        placeholder="name, vehicle, firmware, finding",
        full_table_note="All rows are in fleet.csv.",
    )


def _value_cell(value: float | None, format_value: Callable[[float], str]) -> Cell:
    return Cell() if value is None else frame.number_cell(value, format_value(value))


def _details(log: Log) -> tuple[Section, ...]:
    axes = [
        [name, *(_format_value(axis.get(name, "")) for axis in log["axes"])]
        for name in AXIS_COLUMNS
        if any(name in axis for axis in log["axes"])
    ]
    titles = ["", *(axis["axis"] for axis in log["axes"])]
    return (
        frame.list_section(
            "Missing results", [reason for reason, _ in log["lacking"] if reason], is_warning=True
        ),
        frame.list_section("Actions", list(dict.fromkeys(r for _, r in log["lacking"] if r))),
        frame.list_section("Summary", list(filter(None, log.get("summary", "").splitlines()))),
        frame.list_section(
            "Findings", [f"{finding_title(id_)} ({id_})" for id_ in log["findings"]]
        ),
        frame.table_section("Axes", titles if axes else (), axes, range(1, len(titles))),
    )


def _side_sections(log: Log) -> tuple[Section, ...]:
    return (
        frame.links_section(
            "Files", [(label, local_link(log.get(name, ""))) for label, name in FILE_LINKS]
        ),
        frame.pairs_section(
            "Flight", [(name, _format_value(log.get(name, ""))) for name in LOG_COLUMNS]
        ),
    )


def _format_value(value: str | float) -> str:
    return value if isinstance(value, str) else format_number(float(value))


def _filters(logs: Sequence[Log]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the selection lists of the page with their options, most frequent option first."""
    counts = Counter(tag for log in logs for tag in log["tags"])
    label_by_tag: Mapping[str, str] = {
        tag: label for log in logs for tag, label in log["tags"].items()
    }
    filters = []
    for label, kind, all_label in FILTERS:
        options = [
            (tag, f"{clean(label_by_tag[tag], 60)} ({count})")
            for tag, count in counts.most_common()
            if tag.startswith(f"{kind}:")
        ]
        if options:
            filters.append((label, [("", all_label), *options]))
    return filters


# -------------------- one entry per log


def logs_of(table: pd.DataFrame) -> list[Log]:
    """Combine the rows of each log into one :data:`Log`, in the order of the table."""
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    present = (table.notna() & (table != "")).to_numpy()
    for row, is_present in zip(table.to_dict("records"), present, strict=True):
        row_values = {
            str(n): value
            for (n, value), is_value_present in zip(row.items(), is_present, strict=True)
            if is_value_present
        }
        rows[str(row["log"])].append(row_values)
    return [_log_summary(axes) for axes in rows.values()]


def _log_summary(rows: Sequence[Mapping[str, Any]]) -> Log:
    axes = [row for row in rows if "axis" in row]
    main_rows = next(
        (m for names in MAIN_AXES if (m := [a for a in axes if a["axis"] in names])), rows
    )
    log: dict[str, Any] = {}
    for row in reversed((*main_rows, *rows)):
        log |= row
    reasons_and_remedies = ((row.get("reason", ""), row.get("remedy", "")) for row in rows)
    log |= {
        "name": log.get("name") or PurePosixPath(log["log"]).name or "unnamed",
        "sigma_ratios": {
            filter_name: ratio
            for filter_name in ("kf", "ekf2")
            if (ratio := _mean_sigma_ratio(main_rows, f"{filter_name}_nis_mean")) is not None
        },
        "status": DONE if any(row["status"] == DONE for row in rows) else rows[0]["status"],
        "lacking": tuple(dict.fromkeys(pair for pair in reasons_and_remedies if any(pair))),
        "axes": axes,
        "findings": [id_ for id_ in log.get("findings", "").split(FINDING_SEPARATOR) if id_],
    }
    return log | {"tags": _tags(log)}


def _mean_sigma_ratio(axes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    nis_and_updates = [(row[name], row.get("updates", 1)) for row in axes if name in row]
    total = sum(nis * updates for nis, updates in nis_and_updates)
    updates_total = sum(updates for _, updates in nis_and_updates)
    return float(total / updates_total) ** 0.5 if total > 0.0 else None


def _tags(log: Log) -> dict[str, str]:
    tags = {f"status:{log['status']}": log["status"]}
    for name in ("vehicle", "firmware"):
        tags[f"{name}:{log.get(name, '')}"] = log.get(name, f"{name} unknown")
    tags |= {f"finding:{finding}": finding_title(finding) for finding in log["findings"]}
    return tags | {f"remedy:{remedy}": remedy or "no action" for _, remedy in log["lacking"]}


def short_names(logs: Sequence[Log]) -> dict[str, str]:
    """Shorten ids of flight controllers above 20 characters to the last 8 if these are unique."""
    long_ids = {vehicle for log in logs if len(vehicle := log.get("vehicle", "")) > 20}
    short_ids = {vehicle: f"…{vehicle[-8:]}" for vehicle in long_ids}
    return short_ids if len(set(short_ids.values())) == len(short_ids) else {}


def describe_sigma_ratio(ratio: float) -> str:
    """Describe the reported σ of a filter; ``ratio``: actual σ over reported σ.

    >>> [describe_sigma_ratio(ratio) for ratio in (1.2, 3.2, 0.25)]
    ['consistent', '3.2 × too small', '4 × too large']
    """
    factor = max(ratio, 1.0 / ratio)
    if factor <= MAX_CONSISTENT_RATIO:
        return "consistent"
    return f"{format_factor(factor)} × too {'small' if ratio > 1.0 else 'large'}"
