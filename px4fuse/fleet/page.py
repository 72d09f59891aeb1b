"""A fleet as one web page: a sortable table with a log per row."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.rows import BETWEEN_FINDINGS, DONE, FAILED, PLACES
from px4fuse.plain import factor_words, few_words, number_words
from px4fuse.webpage import frame
from px4fuse.webpage.frame import Cell, Column, Part, Row
from px4fuse.webpage.safe import clean, local_link

LOOKS = {"done": "good", "not judged": "open", "failed": "bad"}
FILES = (("The report (PDF)", "report"), ("The results (JSON)", "results"))
# Unfolded, the table's columns stand under their own names: those of each axis, and the others
BY_AXIS = [name for name, place in PLACES.items() if "{" in place]
OF_LOG = [
    name
    for name, place in PLACES.items()
    if name
    not in (
        *BY_AXIS,
        "axis",
        "status",
        "reason",
        "remedy",
        "story",
        "findings",
        "results",
        "report",
    )
]
FILTERS = (
    ("Status", "status", "Every status"),
    ("Vehicle", "vehicle", "Every vehicle"),
    ("Firmware", "firmware", "Every firmware"),
    ("Finding", "finding", "Whatever was found"),
    ("To set", "remedy", "Whatever is missing"),
)
# What speaks for a log: along the aisle where that is known, else both horizontal axes
MAIN = (("aisle",), ("north", "east"), ("down",))

#: One log: every column that its rows have something in, from the main axes first, and
#: ``factors`` ("kf" and "ekf2": how many times √S is overstated, by the mean NIS of all updates
#: of the main axes), ``status`` (the best of its axes), ``lacking`` (why something could not be
#: judged, and what to set), ``axes`` (their rows), ``findings`` (ids) and ``tags`` (what filters
#: look for, with the words for it)
Log = Mapping[str, Any]


def html_text(table: pd.DataFrame, title: str, made_with: str) -> str:
    """Lay out a fleet as one HTML file.

    Parameters
    ----------
    table : DataFrame
        A row per log and axis, with the columns of :data:`px4fuse.fleet.rows.COLUMNS`; a log that
        could not be read has one row without an axis.
    made_with : str
        Name and version of the program.

    Returns
    -------
    str
        Write it as UTF-8. The same for the same input: nothing depends on the day.
    """
    logs = logs_of(table)
    names = short_names(logs)
    rows = []
    for log in logs:
        said = [named(finding) for finding in log["findings"]]
        vehicle = log.get("vehicle", "")
        cells = (
            Cell(log["name"], log["name"], log["log"].rpartition("/")[0]),
            frame.words(log.get("date", "")[:10]),
            frame.words(names.get(vehicle, str(vehicle))),
            frame.words(log.get("firmware", "")),
            Cell(log["status"], log["status"], look=LOOKS[log["status"]]),
            *(_figure(log["factors"].get(whose), overstated_words) for whose in ("kf", "ekf2")),
            *(
                _figure(log.get(name), number_words)
                for name in ("sigma_z_m", "clock_offset_s", "position_rmse_m")
            ),
            Cell()
            if log["status"] == FAILED
            else frame.figure(float(len(said)), below=few_words(said, 2)),
        )
        rows.append(Row(cells, tuple(log["tags"]), _details(log), _beside(log)))
    return frame.page(
        title=title,
        subtitle=f"{len(logs)} log{'' if len(logs) == 1 else 's'}, compared with {made_with}",
        noun=("log", "logs"),
        columns=(
            Column("Log"),
            Column("Date (UTC)", "line", narrow="tablet"),
            Column("Vehicle", "line", narrow="desk"),
            Column("Firmware", "line", narrow="desk"),
            Column("Status"),
            Column("Variance S, ours", "number"),
            Column("Variance S, EKF2", "number", narrow="tablet"),
            Column("SIGMA_Z (m)", "number", narrow="tablet"),
            Column("Clock offset (s)", "number", narrow="desk"),
            Column("RMSE between (m)", "number", narrow="desk"),
            Column("Findings", "rank", narrow="desk"),
        ),
        rows=rows,
        filters=_filters(logs),
        placeholder="name, vehicle, firmware, finding",
        otherwise="All rows are in fleet.csv.",
    )


def _figure(value: float | None, words: Callable[[float], str]) -> Cell:
    return Cell() if value is None else frame.figure(value, words(value))


def _details(log: Log) -> tuple[Part, ...]:
    axes = [
        [name, *(_said(axis.get(name, "")) for axis in log["axes"])]
        for name in BY_AXIS
        if any(name in axis for axis in log["axes"])
    ]
    heads = ["", *(axis["axis"] for axis in log["axes"])]
    return (
        frame.listed("Not judged", [reason for reason, _ in log["lacking"] if reason], warn=True),
        frame.listed("What to set", list(dict.fromkeys(r for _, r in log["lacking"] if r))),
        frame.listed("What happened", list(filter(None, log.get("story", "").splitlines()))),
        frame.listed("Findings", [f"{named(one)} ({one})" for one in log["findings"]]),
        frame.tabled("Axes", heads if axes else (), axes, range(1, len(heads))),
    )


def _beside(log: Log) -> tuple[Part, ...]:
    return (
        frame.links("Files", [(said, local_link(log.get(name, ""))) for said, name in FILES]),
        frame.pairs("Flight", [(name, _said(log.get(name, ""))) for name in OF_LOG]),
    )


def _said(value: str | float) -> str:
    return value if isinstance(value, str) else number_words(float(value))


def _filters(logs: Sequence[Log]) -> list[tuple[str, list[tuple[str, str]]]]:
    """What the logs have, most frequent first."""
    counts = Counter(tag for log in logs for tag in log["tags"])
    words_of: Mapping[str, str] = {tag: said for log in logs for tag, said in log["tags"].items()}
    filters = []
    for label, kind, every in FILTERS:
        options = [
            (tag, f"{clean(words_of[tag], 60)} ({count})")
            for tag, count in counts.most_common()
            if tag.startswith(f"{kind}:")
        ]
        if options:
            filters.append((label, [("", every), *options]))
    return filters


# -------------------- the table by logs


def logs_of(table: pd.DataFrame) -> list[Log]:
    """One per log, in the order of the table."""
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    present = (table.notna() & (table != "")).to_numpy()
    for row, there in zip(table.to_dict("records"), present, strict=True):
        kept = {
            str(n): value
            for (n, value), is_there in zip(row.items(), there, strict=True)
            if is_there
        }
        rows[str(row["log"])].append(kept)
    return [_log(axes) for axes in rows.values()]


def _log(rows: Sequence[Mapping[str, Any]]) -> Log:
    axes = [row for row in rows if "axis" in row]
    main = next((m for names in MAIN if (m := [a for a in axes if a["axis"] in names])), rows)
    log: dict[str, Any] = {}
    for row in reversed((*main, *rows)):
        log |= row
    lacking = ((row.get("reason", ""), row.get("remedy", "")) for row in rows)
    log |= {
        "name": log.get("name") or PurePosixPath(log["log"]).name or "nameless",
        "factors": {
            whose: factor
            for whose in ("kf", "ekf2")
            if (factor := _overstated(main, f"{whose}_nis_mean")) is not None
        },
        "status": DONE if any(row["status"] == DONE for row in rows) else rows[0]["status"],
        "lacking": tuple(dict.fromkeys(one for one in lacking if any(one))),
        "axes": axes,
        "findings": [part for part in log.get("findings", "").split(BETWEEN_FINDINGS) if part],
    }
    return log | {"tags": _tags(log)}


def _overstated(axes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    judged = [(row[name], row.get("updates", 1)) for row in axes if name in row]
    total = sum(nis * updates for nis, updates in judged)
    return float(sum(updates for _, updates in judged) / total) ** 0.5 if total > 0.0 else None


def _tags(log: Log) -> dict[str, str]:
    tags = {f"status:{log['status']}": log["status"]}
    for name in ("vehicle", "firmware"):
        tags[f"{name}:{log.get(name, '')}"] = log.get(name, f"no {name} named")
    tags |= {f"finding:{finding}": named(finding) for finding in log["findings"]}
    return tags | {f"remedy:{remedy}": remedy or "no advice" for _, remedy in log["lacking"]}


def short_names(logs: Sequence[Log]) -> dict[str, str]:
    """Long ids of flight controllers by their last digits, where these tell them apart."""
    long = {vehicle for log in logs if len(vehicle := log.get("vehicle", "")) > 20}
    short = {vehicle: f"…{vehicle[-8:]}" for vehicle in long}
    return short if len(set(short.values())) == len(short) else {}


def overstated_words(factor: float) -> str:
    """By how much a filter's √S is off.

    >>> [overstated_words(factor) for factor in (1.004, 3.2, 0.25)]
    ['right', '3.2 × too large', '4 × too small']
    """
    off = max(factor, 1.0 / factor)
    if off < 1.01:
        return "right"
    return f"{factor_words(off)} × too {'large' if factor > 1.0 else 'small'}"
