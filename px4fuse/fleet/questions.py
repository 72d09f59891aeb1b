"""What a fleet's owner asks, above the table: charts, the worst, and what to set.

Here are the answers; ``above.html`` lays them out.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.fleet.by_log import Log
from px4fuse.fleet.rows import DONE
from px4fuse.plain import factor_words
from px4fuse.webpage.charts import Scale, over_time, sketched
from px4fuse.webpage.safe import clean, template

WORST = 10
MOST_REASONS = 3


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
        ("Worse than the baseline", sum(bool(log["changes"]) for log in logs) or ""),
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
