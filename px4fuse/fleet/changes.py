"""What changed between two flights, or two settings of one flight: ``px4fuse diff``."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from px4fuse.display import Shown, draw, frame, words
from px4fuse.fleet import summary
from px4fuse.fleet.inputs import DiffInput, Progress, read_inputs
from px4fuse.fleet.measures import Number, numbers
from px4fuse.fleet.significance import (
    FALSE_DISCOVERY_RATE,
    Contrast,
    contrast,
    corrected,
    spreads,
)
from px4fuse.report.changes_words import change_line
from px4fuse.results.changes import Compared, Judgement, NumberChange, Status
from px4fuse.results.contract import CHANGES, ChangeResults
from px4fuse.results.model import provenance, schema_of

# What stands first of the significant changes; and of these, causes before what they bring
_ORDER: tuple[Judgement, ...] = ("worse", "better", "changed", "")
_CAUSES = ("tuning", "clock", "heading")
MAX_LINE, MAX_CHANGES, MAX_DRAWN = 160, 4, 20


@dataclass(frozen=True, repr=False)
class Changes(Shown):
    """What changed from A to B.

    Attributes
    ----------
    results : ChangeResults
        Its numbers, significant changes first.
    a, b : DiffInput
    """

    results: ChangeResults
    a: DiffInput
    b: DiffInput

    @property
    def is_worse(self) -> bool:
        """Whether a number is significantly worse, or B has an error that A has not."""
        new = (f for f in self.results.findings if f.only_in == "B")
        worse = any(change.judgement == "worse" for change in self.results.numbers)
        return worse or any(finding.severity == "error" for finding in new)


@words.register
def _(found: Changes) -> str:
    judged = [change_line(change) for change in found.results.numbers if change.judgement]
    # a few lines: the table has them all
    lines = [*found.results.summary, *judged[:MAX_CHANGES]]
    return "\n".join(shorten(line, MAX_LINE) for line in lines)


@frame.register
def _(found: Changes) -> pd.DataFrame:
    table = pd.DataFrame(map(msgspec.structs.asdict, found.results.numbers))
    for name in ("a_interval", "b_interval", "change_interval"):
        ends = table.pop(name).map(lambda span: span or (np.nan, np.nan))
        table[[f"{name[:-8]}low", f"{name[:-8]}high"]] = ends.tolist()
    return table


@draw.register
def _(found: Changes, ax: Any = None) -> Any:
    """The first ratios with their intervals."""
    from matplotlib import pyplot as plt  # noqa: PLC0415 - takes its time

    ax = ax or plt.subplots(layout="constrained")[1]
    table = frame(found)
    table = table[(table["scale"] == "ratio") & table["change"].notna()].head(MAX_DRAWN).iloc[::-1]
    ends = table[["change_low", "change_high"]].sub(table["change"], axis=0).abs().fillna(0.0)
    ax.errorbar(table["change"], table["label"], xerr=ends.to_numpy().T, fmt="o", color="black")
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
    return changes(*read_inputs(Path(a), Path(b), progress))


def changes(a: DiffInput, b: DiffInput) -> Changes:
    """Hold two comparisons against each other."""
    paired = a.results.log.sha256 == b.results.log.sha256
    found = ChangeResults(
        schema=schema_of(CHANGES),
        a=_compared(a),
        b=_compared(b),
        paired=paired,
        summary=(),
        numbers=number_changes(
            numbers(a.results, a.analysis), numbers(b.results, b.analysis), paired=paired
        ),
        texts=tuple(summary.texts(a.results, b.results, paired=paired)),
        findings=tuple(summary.findings(a.results, b.results)),
        notes=tuple(summary.notes(a, b, paired=paired)),
        provenance=provenance(shlex.join(["px4fuse", "diff", a.given, b.given])),
    )
    said = tuple(summary.sentences(found))
    return Changes(msgspec.structs.replace(found, summary=said), a, b)


def number_changes(
    first: Mapping[str, Number], second: Mapping[str, Number], *, paired: bool
) -> tuple[NumberChange, ...]:
    """How each number of two changed, significant changes first.

    Parameters
    ----------
    first, second : mapping
        Numbers of A and B, by where they stand in the results.
    paired : bool
        Both are of one flight, so that nothing is left to chance.
    """
    spread_of: Mapping[str, float] = {} if paired else spreads()
    contrasts = {
        path: contrast(a, second[path], spread_of.get(a.measure.path, 0.0))
        for path, a in first.items()
        if path in second
    }
    ps = {path: c.p for path, c in contrasts.items() if c and c.interval and not paired}
    qs = dict(zip(ps, corrected(list(ps.values())), strict=True))
    made = [
        _change(path, first.get(path), second.get(path), contrasts.get(path), qs.get(path), paired)
        for path in {**first, **second}
    ]
    return tuple(sorted(made, key=lambda change: _rank(change, contrasts.get(change.path))))


def _change(
    path: str, a: Number | None, b: Number | None, found: Contrast | None, q: float | None,
    paired: bool,
) -> NumberChange:  # fmt: skip
    number = a or b
    assert number is not None
    measure = number.measure
    status: Status = "not tested"
    if a is None or b is None:
        status = "only in A" if b is None else "only in B"
    elif paired:
        moved = a.value != b.value if found is None else abs(found.delta) >= measure.least
        status = "differs" if moved else "same"
    elif q is not None:
        status = "significant" if q < FALSE_DISCOVERY_RATE else "within chance"
    judgement: Judgement = ""
    if status in ("differs", "significant"):
        # between two flights the distance from the best must differ by more than chance too
        least = found.half if found and not paired else 0.0
        judgement = "changed"
        if found and abs(found.farther) > least:
            judgement = "worse" if found.farther > 0.0 else "better"
    within = None if found is None or q is None else found.interval
    return NumberChange(
        path=path,
        label=measure.label,
        unit=measure.unit,
        a=None if a is None else a.value,
        b=None if b is None else b.value,
        a_interval=None if a is None else a.interval,
        b_interval=None if b is None else b.interval,
        scale=measure.scale,
        change=None if found is None else measure.unscaled(found.delta),
        change_interval=within and (measure.unscaled(within[0]), measure.unscaled(within[1])),
        q=q,
        status=status,
        judgement=judgement,
    )


def _rank(change: NumberChange, found: Contrast | None) -> tuple[int, bool, float]:
    is_cause = change.path.startswith(_CAUSES)
    moved = 0.0 if found is None else found.z or abs(found.delta)
    return _ORDER.index(change.judgement), not is_cause, -moved


def _compared(side: DiffInput) -> Compared:
    log = side.results.log
    return Compared(
        given=side.given,
        kind=side.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=side.results.provenance.px4fuse,
    )
