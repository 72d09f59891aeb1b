"""Rows of the fleet's table, one per axis, as one log each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import pandas as pd

from px4fuse.findings import named
from px4fuse.fleet.rows import BETWEEN_FINDINGS, COLUMNS

# What speaks for a log: along the aisle where that is known, else both horizontal axes
MAIN = (("aisle",), ("north", "east"), ("down",))


@dataclass(frozen=True)
class LoggedFlight:
    """One log of a fleet.

    Attributes
    ----------
    texts : mapping
        Of all columns of texts, from the first axis that has one; "" where absent.
    numbers : mapping
        Of columns of numbers those that are there, from the first main axis that has them.
    factors : mapping
        "kf" and "ekf2": how many times S is overstated, below 1 understated; 1 over the mean NIS
        of all updates of the main axes.
    status : {"done", "not judged", "failed"}
        The best of its axes.
    lacking : tuple of (str, str)
        Why something of it could not be judged, and what to set; also of a log that is done.
    changes : tuple of str
        What is worse than in the baseline.
    axes : tuple of mapping
        What the table has of each axis, without what is absent.
    """

    texts: Mapping[str, str]
    numbers: Mapping[str, float]
    factors: Mapping[str, float]
    status: str
    lacking: tuple[tuple[str, str], ...]
    changes: tuple[str, ...]
    axes: tuple[Mapping[str, Any], ...]

    @property
    def name(self) -> str:
        """Of the log's file."""
        return self.texts["name"] or PurePosixPath(self.texts["log"]).name or "nameless"

    @property
    def findings(self) -> tuple[str, ...]:
        """Ids."""
        return tuple(part for part in self.texts["findings"].split(BETWEEN_FINDINGS) if part)

    @property
    def tags(self) -> dict[str, str]:
        """What filters look for, with the words for it."""
        tags = {f"status:{self.status}": self.status}
        if self.changes:
            tags["status:worse"] = "worse than in the baseline"
        for name in ("vehicle", "firmware"):
            tags[f"{name}:{self.texts[name]}"] = self.texts[name] or f"no {name} named"
        tags |= {f"finding:{finding}": named(finding) for finding in self.findings}
        return tags | {f"remedy:{remedy}": remedy or "no advice" for _, remedy in self.lacking}


def short_names(logs: Sequence[LoggedFlight]) -> dict[str, str]:
    """Long ids of flight controllers by their last digits, where these tell them apart."""
    long = {vehicle for log in logs if len(vehicle := log.texts["vehicle"]) > 20}
    short = {vehicle: f"…{vehicle[-8:]}" for vehicle in long}
    return short if len(set(short.values())) == len(short) else {}


def logs_of(table: pd.DataFrame) -> list[LoggedFlight]:
    """One per log, in the order of the table."""
    rows: dict[str, list[dict[str, Any]]] = {}
    present = table.notna().to_numpy()
    for row, there in zip(table.to_dict("records"), present, strict=True):
        kept = {
            str(name): value for (name, value), is_there in zip(row.items(), there, strict=True)
            if is_there and value != ""
        }  # fmt: skip
        rows.setdefault(str(row["log"]), []).append(kept)
    return [_log(axes) for axes in rows.values()]


def _log(rows: Sequence[Mapping[str, Any]]) -> LoggedFlight:
    axes = [row for row in rows if "axis" in row]
    main = next(
        (found for names in MAIN if (found := [axis for axis in axes if axis["axis"] in names])),
        list(rows),
    )
    statuses = [str(row["status"]) for row in (*main, *rows)]
    lacking = [(str(row.get("reason", "")), str(row.get("remedy", ""))) for row in rows]
    return LoggedFlight(
        texts={name: str(_first(rows, name) or "") for name in COLUMNS if COLUMNS[name] == "str"},
        numbers={
            name: float(value) for name, kind in COLUMNS.items()
            if kind == "float64" and (value := _first((*main, *rows), name)) is not None
        },
        factors={
            whose: factor for whose in ("kf", "ekf2")
            if (factor := _factor(main, f"{whose}_nis_mean")) is not None
        },
        status="done" if "done" in statuses else statuses[0],
        lacking=tuple(dict.fromkeys(one for one in lacking if any(one))),
        changes=tuple(dict.fromkeys(str(row["change"]) for row in rows if "change" in row)),
        axes=tuple(axes),
    )  # fmt: skip


def _first(rows: Sequence[Mapping[str, Any]], name: str) -> Any:
    return next((row[name] for row in rows if name in row), None)


def _factor(axes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    judged = [(float(row[name]), float(row.get("updates", 1))) for row in axes if name in row]
    total = sum(nis * updates for nis, updates in judged)
    return sum(updates for _, updates in judged) / total if total > 0.0 else None
