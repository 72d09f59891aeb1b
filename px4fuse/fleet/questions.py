"""What a fleet's owner asks, above the table: charts, the worst, and what to set."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from px4fuse.fleet.by_log import Log
from px4fuse.fleet.rows import DONE
from px4fuse.plain import factor_words
from px4fuse.webpage.charts import Scale, over_time, sketch
from px4fuse.webpage.frame import card, note, opens, picks, ranking, summary
from px4fuse.webpage.safe import clean, escaped

# Groups, vehicles, logs, remedies and reasons that are shown
MOST_GROUPS = 10
MOST_PANELS = 8
WORST = 10
MOST_REMEDIES = 10
MOST_REASONS = 3


def above(
    logs: Sequence[Log], names: Mapping[str, str], factor: Scale | None, sigma_z: Scale | None,
    clock: Scale | None,
) -> str:  # fmt: skip
    """HTML of all that stands above the table; ``names`` are short ones of vehicles."""
    cards = (
        _honesty(logs, "firmware", {}, factor),
        _honesty(logs, "vehicle", names, factor),
        _over_time(logs, names, "sigma_z{}_m", "SIGMA_Z that the data ask for, m", sigma_z,
                   "A drifting anchor or a changed antenna shows as a step or a rise."),
        _over_time(logs, names, "clock_offset{}_s", "Clock offset of the position source, s", clock,
                   "A changed camera, driver or network shows as a step."),
        _worst(logs),
        _missing(logs),
    )  # fmt: skip
    return f'{_summary(logs)}<div class="cards">{"".join(cards)}</div>'


def overstated_words(factor: float) -> str:
    """By how much a filter's S is off.

    >>> [overstated_words(factor) for factor in (1.004, 3.2, 0.25)]
    ['right', '3.2 × too large', '4 × too small']
    """
    off = max(factor, 1.0 / factor)
    if off < 1.01:
        return "right"
    return f"{factor_words(off)} × too {'large' if factor > 1.0 else 'small'}"


def _summary(logs: Sequence[Log]) -> str:
    statuses = Counter(log["status"] for log in logs)
    dates = sorted(log["date"][:10] for log in logs if "date" in log)
    entries = {
        "Logs": len(logs),
        "Judged": statuses[DONE],
        "Not judged": statuses["not judged"],
        "Failed": statuses["failed"],
        "Vehicles": len({log["vehicle"] for log in logs if "vehicle" in log}),
        "From": dates[0] if dates else "",
        "To": dates[-1] if dates else "",
        "Worse than the baseline": sum(bool(log["changes"]) for log in logs) or "",
    }
    return summary([(name, escaped(f"{value}")) for name, value in entries.items() if value != ""])


def _groups(logs: Sequence[Log], by: str) -> list[tuple[str, list[Log]]]:
    """Logs by what they have in a column, those with most logs first."""
    groups: dict[str, list[Log]] = defaultdict(list)
    for log in logs:
        groups[log.get(by, "")].append(log)
    return sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))


def _honesty(logs: Sequence[Log], by: str, names: Mapping[str, str], scale: Scale | None) -> str:
    """Distribution of over- and understatement in groups."""
    title = f"Is the claimed uncertainty right? By {by}"
    if scale is None:
        return card(title, note("No log has updates that could be judged."))
    groups = _groups([log for log in logs if log["factors"]], by)
    lines = []
    for name, members in groups[:MOST_GROUPS]:
        cells = ""
        for whose in ("kf", "ekf2"):
            values = [log["factors"][whose] for log in members if whose in log["factors"]]
            ends = np.quantile(values, (0.05, 0.5, 0.95)).tolist() if values else []
            drawn = sketch(map(scale.share, ends), 0.5) if ends else ""
            said = factor_words(ends[1]) if ends else "–"
            cells += f'<td class="n">{said}</td><td class="chart">{drawn}</td>'
        said = names.get(name, name) or f"no {by} named"
        lines.append(
            f'<tr><th scope="row">{picks(f"{by}:{name}", said)}</th>'
            f'<td class="n wide-only">{len(members)}</td>{cells}</tr>'
        )
    more = len(groups) - MOST_GROUPS
    return card(
        title,
        note(
            "How many times each filter overstates the variance S of its innovations: 1, the "
            "upright line, is right, more is too large (too modest), less too small (too sure). "
            "Number and dot are the median, the line is nine tenths of the logs, from "
            f"{factor_words(scale.low)} to {factor_words(scale.high)} times."
        ),
        f'<table class="spread"><thead><tr><th scope="col">{by.capitalize()}</th>'
        '<th scope="col" class="n wide-only">Logs</th>'
        '<th scope="colgroup" colspan="2">S of ours, times</th>'
        '<th scope="colgroup" colspan="2">S of EKF2, times</th>'
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table>",
        note(f"And {more} more, with fewer logs.") if more > 0 else "",
    )


def _over_time(
    logs: Sequence[Log], names: Mapping[str, str], column: str, title: str, scale: Scale | None,
    hint: str,
) -> str:  # fmt: skip
    """A number over the dates of the logs, a panel per vehicle."""
    dated = [log for log in logs if column.format("") in log and "date" in log]
    if not dated or scale is None:
        return card(title, note("No log with a date has it."))
    dates = pd.to_datetime(sorted(log["date"] for log in dated), utc=True, format="ISO8601")
    groups = _groups(dated, "vehicle")
    panels = []
    for vehicle, mine in groups[:MOST_PANELS]:
        table = pd.DataFrame(
            {
                "date": pd.to_datetime([log["date"] for log in mine], utc=True, format="ISO8601"),
                **{
                    name: [log.get(column.format(end), math.nan) for log in mine]
                    for name, end in (("value", ""), ("low", "_low"), ("high", "_high"))
                },
            }
        ).sort_values("date", kind="stable")
        said = names.get(vehicle, vehicle) or "no vehicle named"
        told = _told(table["value"])
        drawn = over_time(table, (dates[0], dates[-1]), scale, f"{title}, of {said}: {told}")
        panels.append(
            f"<div><h3>{picks(f'vehicle:{vehicle}', said)} <span>{told}</span></h3>{drawn}</div>"
        )
    more = len(groups) - MOST_PANELS
    return card(
        title,
        note(
            f"Over the date of the log; the line through a mark is its 95 % interval. {hint} "
            "Logs without a date are left out."
        ),
        f'<div class="panels">{"".join(panels)}</div>',
        note(f"And {more} vehicles with fewer logs.") if more > 0 else "",
    )


def _told(values: pd.Series) -> str:
    """Number and medians: all that the picture says, in words."""
    quarter = len(values) // 4
    told = f"{len(values)} logs, median {values.median():.3g}"
    if quarter:
        first, last = values.iloc[:quarter].median(), values.iloc[-quarter:].median()
        told += f"; first quarter {first:.3g}, last quarter {last:.3g}"
    return told


def _worst(logs: Sequence[Log]) -> str:
    """Those in which one of the filters is farthest from honest."""
    off = [
        (max((abs(math.log(factor)), whose) for whose, factor in log["factors"].items()), index)
        for index, log in enumerate(logs)
        if log["factors"]
    ]
    lines = []
    for (_, whose), index in sorted(off, key=lambda each: (-each[0][0], each[1]))[:WORST]:
        name, factor = logs[index]["name"], logs[index]["factors"][whose]
        said = f"{'EKF2’s' if whose == 'ekf2' else 'our'} S is {overstated_words(factor)}"
        lines.append(f"<li>{opens(index, name)}<span class='right'>{said}</span></li>")
    said = "Those in which the variance S of one of the filters is farthest from right."
    return ranking("The ten worst logs", said, lines, WORST)


def _missing(logs: Sequence[Log]) -> str:
    """What could not be judged, by what to set so that the next can; whole logs first."""
    title = "Not judged, and what to set so that the next can"
    groups: dict[str, list[tuple[Log, str]]] = defaultdict(list)
    for log in logs:
        for reason, remedy in log["lacking"]:
            groups[remedy].append((log, reason))
    if not groups:
        return card(title, note("Every log was judged."))

    def in_part(remedy: str) -> bool:
        return all(log["status"] == DONE for log, _ in groups[remedy])

    lines = []
    for remedy in sorted(groups, key=lambda each: (in_part(each), -len(groups[each]), each)):
        reasons = Counter(reason for _, reason in groups[remedy] if reason)
        said = [clean(reason, 300) for reason, _ in reasons.most_common(MOST_REASONS)]
        rest = f" (and {len(reasons) - len(said)} more)" if len(reasons) > len(said) else ""
        whole = len({log["log"] for log, _ in groups[remedy]})
        part = " (in part)" if in_part(remedy) else ""
        count = f"{whole} log{'' if whole == 1 else 's'}{part}"
        lines.append(
            f"<li>{picks(f'remedy:{remedy}', count)}"
            f'<p dir="auto"><strong>{escaped(remedy or "No advice.")}</strong></p>'
            f'<p class="note" dir="auto">{escaped(" / ".join(said) + rest)}</p></li>'
        )
    return ranking(title, "", lines, MOST_REMEDIES, ", under To set below")
