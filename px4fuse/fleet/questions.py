"""What a fleet's owner asks, above the table: charts, counts, the worst, and what to set."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.by_log import LoggedFlight
from px4fuse.plain import factor_words
from px4fuse.webpage.charts import Scale, axis, bar, grid, over_time, plot, spread
from px4fuse.webpage.frame import card, note, opens, picks, ranking, summary
from px4fuse.webpage.safe import clean, escaped

MOST_GROUPS = 10
MOST_PANELS = 8
MOST_FINDINGS = 15
WORST = 10
MOST_REMEDIES = 10
MOST_REASONS = 3
FILTERS = (("kf", "ours"), ("ekf2", "ekf2"))


def above(
    logs: Sequence[LoggedFlight],
    names: Mapping[str, str],
    factor: Scale,
    sigma: Scale | None,
    clock: Scale | None,
) -> str:
    """HTML of all that stands above the table; ``names`` are short ones of vehicles."""
    cards = (
        _honesty(logs, "firmware", {}, factor),
        _honesty(logs, "vehicle", names, factor),
        _over_time(logs, names, "sigma_z", "m", "SIGMA_Z that the data ask for", sigma,
                   "A drifting anchor or a changed antenna shows as a step or a rise."),
        _over_time(logs, names, "clock_offset", "s", "Clock offset of the position source", clock,
                   "A changed camera, driver or network shows as a step."),
        _frequent(logs),
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


def _summary(logs: Sequence[LoggedFlight]) -> str:
    statuses = Counter(log.status for log in logs)
    dates = sorted(log.texts["date"][:10] for log in logs if log.texts["date"])
    entries = [
        ("Logs", f"{len(logs)}"),
        ("Judged", f"{statuses['done']}"),
        ("Not judged", f"{statuses['not judged']}"),
        ("Failed", f"{statuses['failed']}"),
        ("Vehicles", f"{len({v for log in logs if (v := log.texts['vehicle'])})}"),
        ("From", dates[0] if dates else ""),
        ("To", dates[-1] if dates else ""),
    ]
    worse = sum(bool(log.changes) for log in logs)
    if worse:
        entries.append(("Worse than the baseline", f"{worse}"))
    return summary([(name, escaped(value)) for name, value in entries if value])


def _honesty(logs: Sequence[LoggedFlight], by: str, names: Mapping[str, str], scale: Scale) -> str:
    """Distribution of over- and understatement in groups, those with most logs first."""
    title = f"Is the claimed uncertainty right? By {by}"
    groups: dict[str, list[LoggedFlight]] = defaultdict(list)
    for log in logs:
        if log.factors:
            groups[log.texts[by]].append(log)
    if not groups:
        return card(title, note("No log has updates that could be judged."))
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))
    lines = []
    for name, members in ordered[:MOST_GROUPS]:
        drawn, medians = [grid(scale, 30.0, 1.0)], []
        for place, (whose, kind) in enumerate(FILTERS):
            values = np.array([log.factors[whose] for log in members if whose in log.factors])
            drawn.append(spread(values, scale, kind, 9.0 + 13.0 * place))
            medians.append(factor_words(float(np.median(values))) if len(values) else "–")
        said = names.get(name, name) or f"no {by} named"
        lines.append(
            f'<tr><th scope="row">{picks(f"{by}:{name}", said)}</th>'
            f'<td class="n wide-only">{len(members)}</td>'
            f'<td class="chart">{plot(30, "", drawn)}</td>'
            + "".join(f'<td class="n">{median}</td>' for median in medians)
            + "</tr>"
        )
    others = note(f"And {len(ordered) - MOST_GROUPS} more, with fewer logs.")
    return card(
        title,
        note(
            "How many times each filter overstates the variance S of its innovations: 1 is right, "
            "right of it too large (too modest), left of it too small (too sure). The mark is the "
            "median, the box the middle half of the logs, the line nine tenths; few logs are drawn "
            "one by one."
        ),
        '<p class="note"><span class="key"></span>ours, round <span class="key ekf2"></span>'
        "EKF2, square</p>",
        f'<table class="spread"><thead><tr><th scope="col">{by.capitalize()}</th>'
        '<th scope="col" class="n wide-only">Logs</th>'
        f'<th scope="col" class="chart"><span>S overstated, times</span>{axis(scale)}</th>'
        '<th scope="col" class="n">Median, ours</th><th scope="col" class="n">Median, EKF2</th>'
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table>",
        others if len(ordered) > MOST_GROUPS else "",
    )


def _over_time(
    logs: Sequence[LoggedFlight], names: Mapping[str, str], name: str, unit: str, title: str,
    scale: Scale | None, hint: str,
) -> str:  # fmt: skip
    """A number over the dates of the logs, a panel per vehicle, those with most logs first."""
    table = pd.DataFrame(
        [
            (log.texts["vehicle"], log.texts["date"],
             *(log.numbers.get(f"{name}{end}_{unit}", math.nan) for end in ("", "_low", "_high")))
            for log in logs
        ],
        columns=["vehicle", "date", "value", "low", "high"],
    ).dropna(subset=["value"])  # fmt: skip
    table["date"] = pd.to_datetime(table["date"], errors="coerce", utc=True, format="ISO8601")
    undated = int(table["date"].isna().sum())
    table = table.dropna(subset=["date"]).sort_values("date", kind="stable")
    left_out = f"{undated} logs that have no date are left out." if undated else ""
    if table.empty or scale is None:
        return card(title, note(f"No log with a date has it. {left_out}"))
    span = table["date"].iloc[0], table["date"].iloc[-1]
    counts = table["vehicle"].value_counts()
    ordered = sorted(counts.index, key=lambda vehicle: (-counts[vehicle], vehicle))
    panels = []
    for vehicle in ordered[:MOST_PANELS]:
        mine = table[table["vehicle"] == vehicle]
        marks, each = over_time(mine["date"], mine[["value", "low", "high"]], span, scale)
        told = _told(mine["value"], unit, each)
        said = names.get(vehicle, vehicle) or "no vehicle named"
        panels.append(
            f"<div><h3>{picks(f'vehicle:{vehicle}', said)} <span>{escaped(told)}</span></h3>"
            f"{plot(74, f'{title} of {said} over time: {told}', [*marks, _dates(span)])}</div>"
        )
    more = len(ordered) - MOST_PANELS
    ends = "logarithmic" if scale.log else "linear"
    return card(
        title,
        note(
            f"In {unit} ({ends}), over the date of the log; the line through a mark is its 95 % "
            f"interval. {hint} {left_out}"
        ),
        f'<div class="panels">{"".join(panels)}</div>',
        note(f"And {more} vehicles with fewer logs.") if more > 0 else "",
    )


def _told(values: pd.Series, unit: str, each: int) -> str:
    """Number and medians: all that the picture says, in words."""
    quarter = len(values) // 4
    told = f"{len(values)} logs, median {values.median():.3g} {unit}"
    if quarter:
        first, last = values.iloc[:quarter].median(), values.iloc[-quarter:].median()
        told += f"; first quarter {first:.3g}, last quarter {last:.3g} {unit}"
    return told + (
        f"; a mark is the median of about {each} logs, its line nine tenths" if each > 1 else ""
    )


def _dates(span: tuple[pd.Timestamp, pd.Timestamp]) -> str:
    style = "%Y-%m-%d" if (span[1] - span[0]).days > 2 else "%m-%d %H:%M"
    ends = ((4, "first", span[0]), (98, "last", span[1]))
    return "".join(
        f'<text x="{x}%" y="71" class="{kind}">{moment.strftime(style)}</text>'
        for x, kind, moment in ends[: 1 if span[0] == span[1] else 2]
    )


def _frequent(logs: Sequence[LoggedFlight]) -> str:
    title = "Findings, most frequent first"
    counts = Counter(finding for log in logs for finding in set(log.findings))
    if not counts:
        return card(title, note("Nothing was found."))
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    most = ordered[0][1]
    judged = sum(log.status != "failed" for log in logs)
    lines = [
        f"<li>{bar(count / most)}{picks(f'finding:{finding}', named(finding))}"
        f'<span class="right">{count} ({count / judged:.0%})</span></li>'
        for finding, count in ordered
    ]
    said = f"Of {judged} logs that were read; press one to see its logs."
    return ranking(title, said, lines, MOST_FINDINGS, ", under Finding below")


def _worst(logs: Sequence[LoggedFlight]) -> str:
    """Those in which one of the filters is farthest from honest."""
    title = "The ten worst logs"
    off = [
        (max(abs(math.log(factor)) for factor in log.factors.values()), index)
        for index, log in enumerate(logs)
        if log.factors
    ]
    if not off:
        return card(title, note("No log has updates that could be judged."))
    ordered = sorted(off, key=lambda item: (-item[0], item[1]))[:WORST]
    lines = []
    for _, index in ordered:
        log = logs[index]
        whose = max(log.factors, key=lambda name: abs(math.log(log.factors[name])))
        who = "EKF2's" if whose == "ekf2" else "our"
        lines.append(
            f"<li>{opens(index, log.name)}<span class='right'>{who} S is "
            f"{overstated_words(log.factors[whose])}</span></li>"
        )
    said = "Those in which the variance S of one of the filters is farthest from right."
    return ranking(title, said, lines, WORST)


def _missing(logs: Sequence[LoggedFlight]) -> str:
    """What could not be judged, by what to set so that the next can; whole logs first."""
    title = "Not judged, and what to set so that the next can"
    groups: dict[str, list[tuple[LoggedFlight, str]]] = defaultdict(list)
    for log in logs:
        for reason, remedy in log.lacking:
            groups[remedy].append((log, reason))
    if not groups:
        return card(title, note("Every log was judged."))

    def rank(item: tuple[str, list[tuple[LoggedFlight, str]]]) -> tuple[bool, int, str]:
        remedy, members = item
        return all(log.status == "done" for log, _ in members), -len(members), remedy

    ordered = sorted(groups.items(), key=rank)
    lines = []
    for remedy, members in ordered:
        reasons = Counter(reason for _, reason in members if reason)
        said = [clean(reason, 300) for reason, _ in reasons.most_common(MOST_REASONS)]
        rest = f" (and {len(reasons) - len(said)} more)" if len(reasons) > len(said) else ""
        whole = {log.texts["log"]: log.status for log, _ in members}
        part = " (in part)" if set(whole.values()) == {"done"} else ""
        count = f"{len(whole)} log{'' if len(whole) == 1 else 's'}{part}"
        lines.append(
            f"<li>{picks(f'remedy:{remedy}', count)}"
            f'<p dir="auto"><strong>{escaped(remedy or "No advice.")}</strong></p>'
            f'<p class="note" dir="auto">{escaped(" / ".join(said) + rest)}</p></li>'
        )
    return ranking(title, "", lines, MOST_REMEDIES, ", under To set below")
