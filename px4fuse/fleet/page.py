"""A fleet as one web page: a log per row, and on top what a fleet's owner asks."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.rows import BETWEEN_FINDINGS, DONE, FAILED, PLACES
from px4fuse.plain import factor_words, few_words, number_words
from px4fuse.webpage import frame
from px4fuse.webpage.charts import Scale, over_time, sketched
from px4fuse.webpage.frame import Cell, Column, Part, Row
from px4fuse.webpage.safe import clean, local_link, template

SIGMA_Z, CLOCK = ("sigma_z_m", "sigma_z_low_m", "sigma_z_high_m"), (
    "clock_offset_s", "clock_offset_low_s", "clock_offset_high_s",
)  # fmt: skip
WORST = 10
MOST_REASONS = 3
LOOKS = {"done": "good", "not judged": "open", "failed": "bad"}
FILES = (("The report (PDF)", "report"), ("The results (JSON)", "results"))
# Unfolded, the table's columns stand under their own names: those of each axis, and the others
BY_AXIS = [name for name, place in PLACES.items() if "{" in place]
OF_LOG = [
    name for name, place in PLACES.items()
    if name not in (*BY_AXIS, "axis", "status", "reason", "remedy", "story", "findings", "results",
                    "report")
]  # fmt: skip
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
    factors = [factor for log in logs for factor in log["factors"].values()]
    # the same to both sides of 1
    factor = Scale.of([*factors, *(1.0 / each for each in factors)], 4.0, log=True)
    sigma_z = Scale.of([log["sigma_z_m"] for log in logs if "sigma_z_m" in log], 0.01)
    clock = Scale.of([log["clock_offset_s"] for log in logs if "clock_offset_s" in log], 0.02)
    zero = clock.share(0.0) if clock.low < 0.0 < clock.high else None
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
            *(_factor(log["factors"].get(whose), factor) for whose in ("kf", "ekf2")),
            _interval(log, SIGMA_Z, sigma_z),
            _interval(log, CLOCK, clock),
            frame.figure(log.get("position_rmse_m")),
            Cell() if log["status"] == FAILED else
            frame.figure(float(len(said)), below=few_words(said, 2)),
        )  # fmt: skip
        rows.append(Row(cells, tuple(log["tags"]), _details(log), _beside(log)))
    return frame.page(
        title=title,
        subtitle=f"{len(logs)} log{'' if len(logs) == 1 else 's'}, compared with {made_with}",
        above=above(logs, names, factor, sigma_z, clock),
        noun=("log", "logs"),
        columns=(
            Column("Log"),
            Column("Date (UTC)", "line", narrow="tablet"),
            Column("Vehicle", "line", narrow="desk"),
            Column("Firmware", "line", narrow="desk"),
            Column("Status"),
            Column("Variance S, ours", "number", mark=0.5),
            Column("Variance S, EKF2", "number", narrow="tablet", mark=0.5),
            Column("SIGMA_Z (m)", "number", narrow="tablet"),
            Column("Clock offset (s)", "number", narrow="desk", mark=zero),
            Column("RMSE between (m)", "number", narrow="desk"),
            Column("Findings", "rank", narrow="desk"),
        ),
        rows=rows,
        filters=_filters(logs),
        placeholder="name, vehicle, firmware, finding",
        otherwise="All rows are in fleet.csv.",
    )


def _factor(value: float | None, scale: Scale) -> Cell:
    if value is None:
        return Cell()
    at = scale.share(value)
    return frame.figure(value, overstated_words(value), (min(at, 0.5), at, max(at, 0.5)))


def _interval(log: Log, columns: Sequence[str], scale: Scale) -> Cell:
    value, low, high = map(log.get, columns)
    if value is None:
        return Cell()
    ends = (value if low is None else low, value, value if high is None else high)
    return frame.figure(value, f"{value:.3g}", tuple(map(scale.share, ends)))


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
        kept = {str(n): value for (n, value), is_there in zip(row.items(), there, strict=True)
                if is_there}  # fmt: skip
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
            whose: factor for whose in ("kf", "ekf2")
            if (factor := _overstated(main, f"{whose}_nis_mean")) is not None
        },
        "status": DONE if any(row["status"] == DONE for row in rows) else rows[0]["status"],
        "lacking": tuple(dict.fromkeys(one for one in lacking if any(one))),
        "axes": axes,
        "findings": [part for part in log.get("findings", "").split(BETWEEN_FINDINGS) if part],
    }  # fmt: skip
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


# -------------------- what stands above the table, as above.html has it


def above(
    logs: Sequence[Log], names: Mapping[str, str], factor: Scale, sigma_z: Scale, clock: Scale
) -> str:
    """HTML of all that stands above the table; ``names`` are short ones of vehicles."""
    return template("fleet/above.html").render(
        summary=_summary(logs),
        honesty=[
            (by, list(_honesty(logs, by, names, factor))) for by in ("firmware", "vehicle")
        ],
        factors=[factor_words(end) for end in (factor.low, factor.high)],
        drifts=[
            (title, hint, list(_drift(logs, names, column, scale)))
            for title, hint, column, scale in (
                ("SIGMA_Z that the data ask for, m",
                 "A drifting anchor or a changed antenna shows as a step or a rise.",
                 "sigma_z{}_m", sigma_z),
                ("Clock offset of the position source, s",
                 "A changed camera, driver or network shows as a step.",
                 "clock_offset{}_s", clock),
            )
        ],
        worst=list(_worst(logs)),
        missing=list(_missing(logs)),
    )  # fmt: skip


def overstated_words(factor: float) -> str:
    """By how much a filter's √S is off.

    >>> [overstated_words(factor) for factor in (1.004, 3.2, 0.25)]
    ['right', '3.2 × too large', '4 × too small']
    """
    off = max(factor, 1.0 / factor)
    if off < 1.01:
        return "right"
    return f"{factor_words(off)} × too {'large' if factor > 1.0 else 'small'}"


def _summary(logs: Sequence[Log]) -> list[tuple[str, object]]:
    statuses = Counter(log["status"] for log in logs)
    dates = sorted(log["date"][:10] for log in logs if "date" in log)
    entries = (
        ("Logs", len(logs)),
        ("Judged", statuses[DONE]),
        ("Not judged", statuses["not judged"]),
        ("Failed", statuses["failed"]),
        ("Vehicles", len({log["vehicle"] for log in logs if "vehicle" in log})),
        ("From", dates[0] if dates else ""),
        ("To", dates[-1] if dates else ""),
    )
    return [entry for entry in entries if entry[1] != ""]


def _groups(logs: Sequence[Log], by: str) -> list[tuple[str, list[Log]]]:
    """Logs by what they have in a column, those with most logs first."""
    groups: dict[str, list[Log]] = defaultdict(list)
    for log in logs:
        groups[log.get(by, "")].append(log)
    return sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))


def _honesty(
    logs: Sequence[Log], by: str, names: Mapping[str, str], scale: Scale
) -> Iterator[dict[str, Any]]:
    """Distribution of over- and understatement in groups: median and nine tenths."""
    for name, members in _groups([log for log in logs if log["factors"]], by):
        spreads = []
        for whose in ("kf", "ekf2"):
            values = [log["factors"][whose] for log in members if whose in log["factors"]]
            ends = np.quantile(values, (0.05, 0.5, 0.95)).tolist() if values else []
            spreads.append((factor_words(ends[1]) if ends else "–", sketched(ends, scale)))
        said = names.get(name, name) or f"no {by} named"
        yield {"name": name, "said": said, "count": len(members), "spreads": spreads}


def _drift(
    logs: Sequence[Log], names: Mapping[str, str], column: str, scale: Scale
) -> Iterator[dict[str, Any]]:
    """A number over the dates of the logs, for each vehicle."""
    dated = [log for log in logs if column.format("") in log and "date" in log]
    dates = pd.to_datetime([log["date"] for log in dated], utc=True, format="ISO8601")
    for vehicle, mine in _groups(dated, "vehicle"):
        values = {
            name: [log.get(column.format(end), math.nan) for log in mine]
            for name, end in (("value", ""), ("low", "_low"), ("high", "_high"))
        }
        index = pd.to_datetime([log["date"] for log in mine], utc=True, format="ISO8601")
        table = pd.DataFrame(values, index).sort_index(kind="stable")
        yield {
            "vehicle": vehicle,
            "said": names.get(vehicle, vehicle) or "no vehicle named",
            "medians": _medians(table["value"]),
            "drawn": partial(over_time, table, (dates.min(), dates.max()), scale),
        }


def _medians(values: pd.Series) -> str:
    """Number and medians: all that the picture says, in words."""
    quarter = len(values) // 4
    words = f"{len(values)} logs, median {values.median():.3g}"
    if quarter:
        first, last = values.iloc[:quarter].median(), values.iloc[-quarter:].median()
        words += f"; first quarter {first:.3g}, last quarter {last:.3g}"
    return words


def _worst(logs: Sequence[Log]) -> Iterator[tuple[int, str, str]]:
    """Those in which one of the filters is farthest from honest."""
    off = [
        (max((abs(math.log(factor)), whose) for whose, factor in log["factors"].items()), index)
        for index, log in enumerate(logs)
        if log["factors"]
    ]
    for (_, whose), index in sorted(off, key=lambda each: (-each[0][0], each[1]))[:WORST]:
        who = "EKF2's" if whose == "ekf2" else "our"
        said = overstated_words(logs[index]["factors"][whose])
        yield index, logs[index]["name"], f"{who} S is {said}"


def _missing(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """What could not be judged, by what to set so that the next can; whole logs first."""
    groups: dict[str, list[tuple[Log, str]]] = defaultdict(list)
    for log in logs:
        for reason, remedy in log["lacking"]:
            groups[remedy].append((log, reason))
    made = []
    for remedy, members in groups.items():
        reasons = Counter(reason for _, reason in members if reason)
        said = " / ".join(clean(reason, 300) for reason, _ in reasons.most_common(MOST_REASONS))
        rest = f" (and {more} more)" if (more := len(reasons) - MOST_REASONS) > 0 else ""
        whole = len({log["log"] for log, _ in members})
        in_part = all(log["status"] == DONE for log, _ in members)
        count = f"{whole} log{'' if whole == 1 else 's'}{' (in part)' if in_part else ''}"
        rank = in_part, -len(members), remedy
        made.append({"remedy": remedy, "count": count, "reasons": said + rest, "rank": rank})
    return sorted(made, key=lambda each: each["rank"])
