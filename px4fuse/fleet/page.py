"""A fleet as one web page: a log per row, and on top what a fleet's owner asks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.by_log import Log, logs_of, short_names
from px4fuse.fleet.questions import above, overstated_words
from px4fuse.fleet.rows import FAILED, PLACES
from px4fuse.plain import few_words, number_words
from px4fuse.webpage import frame
from px4fuse.webpage.charts import Scale
from px4fuse.webpage.frame import Cell, Column, Part, Row
from px4fuse.webpage.safe import clean, local_link

SIGMA_Z, CLOCK = ("sigma_z_m", "sigma_z_low_m", "sigma_z_high_m"), (
    "clock_offset_s", "clock_offset_low_s", "clock_offset_high_s",
)  # fmt: skip
LOOKS = {"done": "good", "not judged": "open", "failed": "bad"}
FILES = (("The report (PDF)", "report"), ("The results (JSON)", "results"))
# Unfolded, the table's columns stand under their own names: those of each axis, and the others
BY_AXIS = [name for name, place in PLACES.items() if "{" in place]
OF_LOG = [
    name for name, place in PLACES.items()
    if name not in (*BY_AXIS, "axis", "status", "reason", "remedy", "story", "findings", "results",
                    "report", "change")
]  # fmt: skip
FILTERS = (
    ("Status", "status", "Every status"),
    ("Vehicle", "vehicle", "Every vehicle"),
    ("Firmware", "firmware", "Every firmware"),
    ("Finding", "finding", "Whatever was found"),
    ("To set", "remedy", "Whatever is missing"),
)


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
            Cell(log["status"], log["status"], "worse than before" * bool(log["changes"]),
                 LOOKS[log["status"]]),
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
        frame.listed("Worse than in the baseline", log["changes"], warn=True),
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
