"""Rows of the fleet's table, one per axis, as one log each."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.rows import BETWEEN_FINDINGS, DONE

# What speaks for a log: along the aisle where that is known, else both horizontal axes
MAIN = (("aisle",), ("north", "east"), ("down",))

#: One log: every column that its rows have something in, from the main axes first, and
#: ``factors`` ("kf" and "ekf2": how many times √S is overstated, by the mean NIS of all updates
#: of the main axes), ``status`` (the best of its axes), ``lacking`` (why something could not be
#: judged, and what to set), ``changes`` (what is worse than before), ``axes`` (their rows),
#: ``findings`` (ids) and ``tags`` (what filters look for, with the words for it)
Log = Mapping[str, Any]


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
            if (factor := _factor(main, f"{whose}_nis_mean")) is not None
        },
        "status": DONE if any(row["status"] == DONE for row in rows) else rows[0]["status"],
        "lacking": tuple(dict.fromkeys(one for one in lacking if any(one))),
        "changes": tuple(dict.fromkeys(row["change"] for row in rows if "change" in row)),
        "axes": axes,
        "findings": [part for part in log.get("findings", "").split(BETWEEN_FINDINGS) if part],
    }  # fmt: skip
    return log | {"tags": _tags(log)}


def _factor(axes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    judged = [(row[name], row.get("updates", 1)) for row in axes if name in row]
    total = sum(nis * updates for nis, updates in judged)
    return float(sum(updates for _, updates in judged) / total) ** 0.5 if total > 0.0 else None


def _tags(log: Log) -> dict[str, str]:
    tags = {f"status:{log['status']}": log["status"]}
    if log["changes"]:
        tags["status:worse"] = "worse than in the baseline"
    for name in ("vehicle", "firmware"):
        tags[f"{name}:{log.get(name, '')}"] = log.get(name, f"no {name} named")
    tags |= {f"finding:{finding}": named(finding) for finding in log["findings"]}
    return tags | {f"remedy:{remedy}": remedy or "no advice" for _, remedy in log["lacking"]}


def short_names(logs: Sequence[Log]) -> dict[str, str]:
    """Long ids of flight controllers by their last digits, where these tell them apart."""
    long = {vehicle for log in logs if len(vehicle := log.get("vehicle", "")) > 20}
    short = {vehicle: f"…{vehicle[-8:]}" for vehicle in long}
    return short if len(set(short.values())) == len(short) else {}
