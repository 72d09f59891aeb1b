"""A fleet as one web page: a log per row, and on top what a fleet's owner asks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Literal

import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.by_log import LoggedFlight, logs_of, short_names
from px4fuse.fleet.questions import above, overstated_words
from px4fuse.plain import few_words, number_words
from px4fuse.webpage.charts import Scale, around_one, linear_scale, log_scale
from px4fuse.webpage.frame import (
    Cell,
    Column,
    Part,
    Row,
    figure,
    links,
    listed,
    page,
    pairs,
    tabled,
    words,
)
from px4fuse.webpage.safe import local_link

LOOKS = {"done": "good", "not judged": "open", "failed": "bad"}
# Of each axis: title and column of the table
AXES = (
    ("Updates", "updates"),
    ("Mean NIS, ours", "kf_nis_mean"),
    ("Verdict, ours", "kf_verdict"),
    ("Mean NIS, EKF2", "ekf2_nis_mean"),
    ("Verdict, EKF2", "ekf2_verdict"),
    ("RMSE between, position (m)", "position_rmse_m"),
    ("RMSE between, velocity (m/s)", "velocity_rmse_m_s"),
    ("RMSE to truth, ours (m)", "kf_position_rmse_to_truth_m"),
    ("RMSE to truth, EKF2 (m)", "ekf2_position_rmse_to_truth_m"),
    ("Share that EKF2 rejected", "rejected_share"),
    ("Correlation of EKF2's model with the log", "model_correlation"),
)
MORE: tuple[tuple[str, Literal["text", "number"], str], ...] = (
    ("RMSE between (m)", "number", "position_rmse_m"),
    ("Duration (s)", "number", "duration_s"),
    ("SIGMA_A (m/s²)", "number", "sigma_a_m_s2"),
    ("Source", "text", "source"),
    ("Source rate (Hz)", "number", "source_rate_hz"),
    ("Airframe", "text", "airframe"),
    ("Hardware", "text", "hardware"),
)
FILES = (("The report (PDF)", "report"), ("The results (JSON)", "results"))
TUNED = (
    ("SIGMA_Z", "sigma_z", "m"),
    ("SIGMA_A", "sigma_a", "m_s2"),
    ("Clock offset", "clock_offset", "s"),
)
FACTS = (
    ("Log", "log"),
    ("Date (UTC)", "date"),
    ("Vehicle", "vehicle"),
    ("Firmware", "firmware"),
    ("Firmware's hash", "firmware_hash"),
    ("Airframe", "airframe"),
    ("Hardware", "hardware"),
    ("Position source", "source"),
    ("px4fuse", "px4fuse"),
    ("Settings", "settings"),
    ("SHA-256", "log_sha256"),
)
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
    factor = around_one([value for log in logs for value in log.factors.values()])
    sigmas = [value for log in logs if (value := log.numbers.get("sigma_z_m"))]
    offsets = [log.numbers["clock_offset_s"] for log in logs if "clock_offset_s" in log.numbers]
    sigma = log_scale(sigmas) if sigmas else None
    clock = linear_scale(offsets, 0.02) if offsets else None
    zero = clock.share(0.0) if clock and clock.low < 0.0 < clock.high else None
    one = factor.share(1.0)
    return page(
        title=title,
        subtitle=f"{len(logs)} log{'' if len(logs) == 1 else 's'}, compared with {made_with}",
        above=above(logs, names, factor, sigma, clock),
        noun=("log", "logs"),
        columns=(
            Column("Log"),
            Column("Date (UTC)", "line", narrow="tablet"),
            Column("Vehicle", "line", narrow="desk"),
            Column("Firmware", "line", narrow="desk"),
            Column("Status"),
            Column("Variance S, ours", "number", mark=one),
            Column("Variance S, EKF2", "number", narrow="tablet", mark=one),
            Column("SIGMA_Z (m)", "number", narrow="tablet"),
            Column("Clock offset (s)", "number", narrow="desk", mark=zero),
            Column("Findings", "rank", narrow="desk"),
            *(Column(name, kind, "numbers") for name, kind, _ in MORE),
        ),
        rows=[_row(log, names, factor, sigma, clock) for log in logs],
        filters=_filters(logs),
        groups=(("numbers", "More numbers"),),
        placeholder="name, vehicle, firmware, finding",
        otherwise="All rows are in fleet.csv.",
    )


def _row(
    log: LoggedFlight,
    names: Mapping[str, str],
    factor: Scale,
    sigma: Scale | None,
    clock: Scale | None,
) -> Row:
    said = [named(finding) for finding in log.findings]
    folder = log.texts["log"].rpartition("/")[0]
    worse = "worse than before" if log.changes else ""
    cells = (
        Cell(log.name, log.name, folder),
        words(log.texts["date"][:10]),
        words(names.get(log.texts["vehicle"], log.texts["vehicle"])),
        words(log.texts["firmware"]),
        Cell(log.status, log.status, worse, LOOKS[log.status]),
        *(_factor(log.factors.get(whose), factor) for whose in ("kf", "ekf2")),
        _interval(log, "sigma_z", "m", sigma),
        _interval(log, "clock_offset", "s", clock),
        figure(float(len(said)), below=few_words(said, 2)) if log.status != "failed" else Cell(),
        *(
            words(log.texts[name]) if kind == "text" else figure(log.numbers.get(name))
            for _, kind, name in MORE
        ),
    )
    return Row(cells, tuple(log.tags), _details(log), _beside(log))


def _factor(value: float | None, scale: Scale) -> Cell:
    if value is None:
        return Cell()
    at, one = scale.share(value), scale.share(1.0)
    return figure(value, overstated_words(value), (min(at, one), at, max(at, one)))


def _interval(log: LoggedFlight, name: str, unit: str, scale: Scale | None) -> Cell:
    value, low, high = (log.numbers.get(f"{name}{end}_{unit}") for end in ("", "_low", "_high"))
    if value is None or scale is None:
        return figure(value)
    ends = (value if low is None else low, value, value if high is None else high)
    return figure(value, f"{value:.3g}", tuple(scale.share(end) for end in ends))


def _details(log: LoggedFlight) -> tuple[Part, ...]:
    return (
        listed("Not judged", [reason for reason, _ in log.lacking if reason], warn=True),
        listed("What to set", list(dict.fromkeys(remedy for _, remedy in log.lacking if remedy))),
        listed("Worse than in the baseline", log.changes, warn=True),
        listed("What happened", [line for line in log.texts["story"].splitlines() if line]),
        listed("Findings", [f"{named(one)} ({one})" for one in log.findings]),
        _axes(log),
    )


def _beside(log: LoggedFlight) -> tuple[Part, ...]:
    return (
        links("Files", [(said, local_link(log.texts[name])) for said, name in FILES]),
        pairs("Tuned on this flight", [(said, _with_interval(log, *at)) for said, *at in TUNED]),
        pairs("Flight", _flight(log)),
    )


def _axes(log: LoggedFlight) -> Part:
    """An axis per column, since there are few of them."""
    rows = [
        [said, *(_said(axis.get(name, "")) for axis in log.axes)]
        for said, name in AXES
        if any(name in axis for axis in log.axes)
    ]
    heads = ["", *(str(axis["axis"]) for axis in log.axes)] if rows else []
    return tabled("Axes", heads, rows, range(1, len(heads)))


def _said(value: object) -> str:
    return value if isinstance(value, str) else number_words(float(value))  # type: ignore[arg-type]


def _with_interval(log: LoggedFlight, name: str, unit: str) -> str:
    value, low, high = (log.numbers.get(f"{name}{end}_{unit}") for end in ("", "_low", "_high"))
    if value is None:
        return ""
    spoken = unit.replace("m_s2", "m/s²")
    if low is None or high is None:
        return f"{value:.3g} {spoken}"
    return f"{value:.3g} {spoken} (95 % from {low:.3g} to {high:.3g})"


def _flight(log: LoggedFlight) -> list[tuple[str, str]]:
    numbers = [
        (said, f"{log.numbers[name]:.4g} {unit}")
        for said, name, unit in (
            ("Duration", "duration_s", "s"),
            ("Rate of the source", "source_rate_hz", "Hz"),
        )
        if name in log.numbers
    ]
    return [*((said, log.texts[name]) for said, name in FACTS), *numbers]


def _filters(logs: Sequence[LoggedFlight]) -> list[tuple[str, list[tuple[str, str]]]]:
    """What the logs have, most frequent first."""
    counts = Counter(tag for log in logs for tag in log.tags)
    words_of = {tag: said for log in logs for tag, said in log.tags.items()}
    filters = []
    for label, kind, every in FILTERS:
        options = [
            (tag, f"{said if len(said := words_of[tag]) <= 60 else said[:59] + '…'} ({count})")
            for tag, count in counts.most_common()
            if tag.startswith(f"{kind}:")
        ]
        if options:
            filters.append((label, [("", every), *options]))
    return filters
