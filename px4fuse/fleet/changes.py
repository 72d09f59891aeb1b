"""What changed between two flights, or two settings of one flight: ``px4fuse diff``."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace

from px4fuse.display import Shown, draw, frame, words
from px4fuse.fleet import told
from px4fuse.fleet.measures import Number, numbers
from px4fuse.fleet.sides import Progress, Side, read_sides
from px4fuse.fleet.significance import (
    FALSE_DISCOVERY_RATE,
    Contrast,
    contrast,
    corrected,
    least_difference,
    spreads,
)
from px4fuse.results.changes import (
    Compared,
    Counts,
    Judgement,
    NumberChange,
    OneSided,
    Status,
    Which,
)
from px4fuse.results.contract import CHANGES, ChangeResults
from px4fuse.results.parts import provenance, schema_of

Numbers = Mapping[str, Number]
Pairs = Mapping[str, tuple[Number, Number]]
# What stands first of the significant changes; and of these, causes before what they bring
_ORDER: tuple[Judgement, ...] = ("worse", "better", "changed", "")
MAX_LINE, MAX_CHANGES, MAX_DRAWN = 160, 4, 20
_CAUSES = ("tuning", "clock", "heading")


@dataclass(frozen=True, repr=False)
class Changes(Shown):
    """What changed from A to B.

    Attributes
    ----------
    results : ChangeResults
        Its numbers, significant changes first.
    a, b : Side
    """

    results: ChangeResults
    a: Side
    b: Side

    @property
    def is_worse(self) -> bool:
        """Whether a number is significantly worse, or B has an error that A has not."""
        new = (f for f in self.results.findings if f.only_in == "B")
        return self.results.counts.worse > 0 or any(f.severity == "error" for f in new)


@words.register
def _(found: Changes) -> str:
    results = found.results
    first = [f"{c.judgement:7} {c.label}: {c.why}" for c in results.numbers if c.judgement]
    # a few lines: the table has them all
    return "\n".join(shorten(line, MAX_LINE) for line in [*results.summary, *first[:MAX_CHANGES]])


@frame.register
def _(found: Changes) -> pd.DataFrame:
    nothing = (np.nan, np.nan)
    return pd.DataFrame(
        {
            "path": change.path,
            "label": change.label,
            "unit": change.unit,
            "a": change.a,
            "b": change.b,
            "scale": change.scale,
            "change": np.nan if change.change is None else change.change,
            "change_low": (change.change_interval or nothing)[0],
            "change_high": (change.change_interval or nothing)[1],
            "p": np.nan if change.p is None else change.p,
            "q": np.nan if change.q is None else change.q,
            "status": change.status,
            "judgement": change.judgement,
        }
        for change in found.results.numbers
    )


@draw.register
def _(found: Changes, ax: Any = None) -> Any:
    """The first ratios with their intervals."""
    from matplotlib import pyplot as plt  # noqa: PLC0415 - takes its time

    ax = ax or plt.subplots(layout="constrained")[1]
    table = frame(found)
    table = table[(table["scale"] == "ratio") & table["change"].notna()].head(MAX_DRAWN).iloc[::-1]
    low, high = (table[name].fillna(table["change"]) for name in ("change_low", "change_high"))
    ax.errorbar(
        table["change"], table["label"], fmt="o", ms=4, color="black",
        xerr=[table["change"] - low, high - table["change"]],
    )  # fmt: skip
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set(xscale="log", xlabel="B / A, with 95 % intervals")
    return ax


def diff(a: str | Path, b: str | Path, *, progress: Progress = lambda _: None) -> Changes:
    """What changed from A to B, number by number.

    Parameters
    ----------
    a, b : str or Path
        Each a flight log, a report of ``px4fuse compare`` or its results as JSON. A log is
        analysed with the settings of the other one's results, where it has some.
    progress : callable
        Told what is being done.

    Raises
    ------
    LogError, MissingDataError, ResultsError
        A file cannot be read, is not of ``px4fuse compare``, or both are the same.
    """
    return changes(*read_sides(Path(a), Path(b), progress))


def changes(a: Side, b: Side) -> Changes:
    """Hold two comparisons against each other."""
    paired = a.results.log.sha256 == b.results.log.sha256
    first, second = (numbers(side.results, side.analysis) for side in (a, b))
    both = {path: (first[path], second[path]) for path in first if path in second}
    made = number_changes(both, paired=paired)
    counts = Counts(
        compared=len(made),
        tested=sum(change.p is not None for change in made),
        changed=sum(change.status in ("significant", "differs") for change in made),
        better=sum(change.judgement == "better" for change in made),
        worse=sum(change.judgement == "worse" for change in made),
    )
    results = ChangeResults(
        schema=schema_of(CHANGES),
        a=_compared(a),
        b=_compared(b),
        paired=paired,
        summary=(),
        counts=counts,
        numbers=tuple(made),
        texts=tuple(told.texts(a, b, paired=paired)),
        findings=tuple(told.findings(a.results, b.results)),
        one_sided=(*_only(first, second, "A"), *_only(second, first, "B")),
        methods=tuple(told.methods(both, paired=paired)),
        notes=tuple(told.notes(a, b, paired=paired)),
        provenance=provenance(shlex.join(["px4fuse", "diff", a.given, b.given])),
    )
    return Changes(replace(results, summary=told.summary(results)), a, b)


def _only(mine: Numbers, other: Numbers, which: Which) -> Iterator[OneSided]:
    for path, number in mine.items():
        if path not in other:
            yield OneSided(path, number.label, which)


def number_changes(both: Pairs, *, paired: bool) -> list[NumberChange]:
    """How each number of two changed, significant changes first.

    Parameters
    ----------
    both : mapping
        The number of A and that of B, by where they stand in the results.
    paired : bool
        Both are of one flight.
    """
    contrasts = {
        path: contrast(a, b, 0.0 if paired else spreads().get(a.kind, 0.0))
        for path, (a, b) in both.items()
    }
    qs = {} if paired else _corrected(contrasts)
    made = [
        _change(path, *both[path], found, qs.get(path), paired) for path, found in contrasts.items()
    ]
    return sorted(made, key=lambda change: _rank(change, contrasts[change.path]))


def _corrected(contrasts: Mapping[str, Contrast | None]) -> dict[str, float]:
    """p-values of the numbers that have intervals, corrected for how many they are."""
    ps = {path: c.p for path, c in contrasts.items() if c is not None and c.half is not None}
    return dict(zip(ps, corrected(list(ps.values())), strict=True))


def _change(
    path: str, a: Number, b: Number, found: Contrast | None, q: float | None, paired: bool
) -> NumberChange:
    status: Status = "not tested"
    judgement: Judgement = ""
    if paired:
        least = least_difference(a.scale, a.unit)
        moved = a.value != b.value if found is None else abs(found.delta) >= least
        status = "differs" if moved else "same"
    elif q is not None:
        status = "significant" if q < FALSE_DISCOVERY_RATE else "within chance"
    if status in ("differs", "significant"):
        # between two flights the distance from the best must differ by more than chance too
        judgement = _judged(found, 0.0 if paired or found is None else found.half or 0.0)
    made = NumberChange(
        path=path,
        label=a.label,
        unit=a.unit,
        a=a.value,
        b=b.value,
        a_interval=a.interval,
        b_interval=b.interval,
        scale=a.scale,
        change=None if found is None else _on_scale(a, found.delta),
        p=None if q is None or found is None else found.p,
        q=q,
        change_interval=None
        if q is None or found is None or found.interval is None
        else (_on_scale(a, found.interval[0]), _on_scale(a, found.interval[1])),
        status=status,
        judgement=judgement,
        why="",
    )
    return replace(made, why=told.why(made, a, b))


def _judged(found: Contrast | None, least: float) -> Judgement:
    if found is None or abs(found.nearer) <= least:
        return "changed"
    return "worse" if found.nearer > 0.0 else "better"


def _on_scale(number: Number, value: float) -> float:
    return float(np.exp(value)) if number.scale == "ratio" else value


def _rank(change: NumberChange, found: Contrast | None) -> tuple[int, bool, float]:
    is_cause = change.path.startswith(_CAUSES)
    moved = 0.0 if found is None else found.z or abs(found.delta)
    return _ORDER.index(change.judgement), not is_cause, -moved


def _compared(side: Side) -> Compared:
    log = side.results.log
    return Compared(
        given=side.given,
        kind=side.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=side.results.provenance.px4fuse,
    )
