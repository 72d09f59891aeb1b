"""What changed between two flights, or two settings of one flight: ``px4fuse diff``."""

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import msgspec

from px4fuse.findings import named
from px4fuse.fleet import measures
from px4fuse.fleet.inputs import DiffInput, Progress, read_inputs
from px4fuse.fleet.measures import FALSE_DISCOVERY_RATE, LEAST_RATIO, Contrast, Number, at
from px4fuse.report.changes import change_line
from px4fuse.results import contract
from px4fuse.results.model import provenance, schema_of

# What stands first of the significant changes; and of these, causes before what they bring
_ORDER: tuple[contract.Judgement, ...] = ("worse", "better", "changed", "")
_CAUSES = ("tuning", "clock", "heading")
# What is compared as text, and where it stands in the results; the segment of one flight alone
_TEXTS = measures.read_rows("texts.csv")

Results = contract.ComparisonResults | contract.AidsResults


def diff(
    a: str | Path, b: str | Path, *, progress: Progress = lambda _: None
) -> contract.ChangeResults:
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


def changes(a: DiffInput, b: DiffInput) -> contract.ChangeResults:
    """Hold two comparisons against each other."""
    paired = a.results.log.sha256 == b.results.log.sha256
    found = contract.ChangeResults(
        schema=schema_of(contract.CHANGES),
        a=_compared(a),
        b=_compared(b),
        paired=paired,
        summary=(),
        numbers=number_changes(
            measures.numbers(a.results, a.analysis),
            measures.numbers(b.results, b.analysis),
            paired=paired,
        ),
        texts=tuple(_texts(a.results, b.results, paired=paired)),
        findings=tuple(_findings(a.results, b.results)),
        notes=tuple(_notes(a, b, paired=paired)),
        provenance=provenance(shlex.join(["px4fuse", "diff", a.given, b.given])),
    )
    return msgspec.structs.replace(found, summary=tuple(_sentences(found)))


def number_changes(
    first: Mapping[str, Number], second: Mapping[str, Number], *, paired: bool
) -> tuple[contract.NumberChange, ...]:
    """How each number of two changed, significant changes first.

    Parameters
    ----------
    first, second : mapping
        Numbers of A and B, by where they stand in the results.
    paired : bool
        Both are of one flight, so that nothing is left to chance.
    """
    spread_of: Mapping[str, float] = {} if paired else measures.spreads()
    contrasts = {
        path: measures.contrast(a, second[path], spread_of.get(a.measure.path, 0.0))
        for path, a in first.items()
        if path in second
    }
    ps = {path: c.p for path, c in contrasts.items() if c and c.interval and not paired}
    qs = dict(zip(ps, measures.corrected(list(ps.values())), strict=True))
    made = [
        _change(path, first.get(path), second.get(path), contrasts.get(path), qs.get(path), paired)
        for path in {**first, **second}
    ]
    return tuple(sorted(made, key=lambda change: _rank(change, contrasts.get(change.path))))


def _change(
    path: str, a: Number | None, b: Number | None, found: Contrast | None, q: float | None,
    paired: bool,
) -> contract.NumberChange:  # fmt: skip
    number = a or b
    assert number is not None
    measure = number.measure
    status: contract.Status = "not tested"
    if a is None or b is None:
        status = "only in A" if b is None else "only in B"
    elif paired:
        moved = a.value != b.value if found is None else abs(found.delta) >= measure.least
        status = "differs" if moved else "same"
    elif q is not None:
        status = "significant" if q < FALSE_DISCOVERY_RATE else "within chance"
    judgement: contract.Judgement = ""
    if status in ("differs", "significant"):
        # between two flights the distance from the best must differ by more than chance too
        least = found.half if found and not paired else 0.0
        judgement = "changed"
        if found and abs(found.farther) > least:
            judgement = "worse" if found.farther > 0.0 else "better"
    within = None if found is None or q is None else found.interval
    return contract.NumberChange(
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


def _rank(change: contract.NumberChange, found: Contrast | None) -> tuple[int, bool, float]:
    is_cause = change.path.startswith(_CAUSES)
    # what is the same differs by the last digits of a machine, if at all
    moved = 0.0
    if found is not None and change.status != "same":
        moved = found.z or abs(found.delta)
    return _ORDER.index(change.judgement), not is_cause, -moved


def _compared(side: DiffInput) -> contract.Compared:
    log = side.results.log
    return contract.Compared(
        given=side.given,
        kind=side.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=side.results.provenance.px4fuse,
    )


# ------------------------------------------------------------- what else is not the same, in words


def _texts(a: Results, b: Results, *, paired: bool) -> Iterator[contract.TextChange]:
    """Settings, parameters of PX4 and facts about the flight that are not the same."""
    for row in _TEXTS:
        place = row["place"]
        if (first := at(a, place)) != (second := at(b, place)) and (
            paired or row["of"] != "segment"
        ):
            kind: Literal["setting", "flight"]
            kind = "flight" if row["of"] == "flight" else "setting"
            yield contract.TextChange(kind, row["what"], _plain(first), _plain(second))
    one, other = _parameters(a), _parameters(b)
    for name in sorted(one.keys() | other.keys()):
        if (first := one.get(name)) != (second := other.get(name)):
            yield contract.TextChange("parameter", name, _plain(first), _plain(second))


def _parameters(found: Results) -> dict[str, float]:
    """Of PX4: those that EKF2 was replayed with, and those that the log has."""
    replayed, logged = at(found, "ekf2_replay.settings") or {}, found.log.parameters
    return {name: float(value) for name, value in (*replayed.items(), *logged.items())}


def _plain(value: object) -> str:
    if value is None:
        return "not logged"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _findings(a: Results, b: Results) -> Iterator[contract.FindingChange]:
    """Findings that only one of the two has, as a cause or as a consequence."""
    both: tuple[tuple[Results, Results, contract.Which], ...]
    both = ((b, a, "B"), (a, b, "A"))
    for mine, other, only_in in both:
        known = {one.id for one in other.findings}
        for one in mine.findings:
            if one.id not in known:
                yield contract.FindingChange(one.id, one.severity, one.message, only_in)


def _sentences(found: contract.ChangeResults) -> Iterator[str]:
    """What changed, in a few sentences."""
    judgements = Counter(change.judgement for change in found.numbers)
    changed = judgements.total() - judgements[""]
    judged = [f"{n} {word}" for word in ("worse", "better") if (n := judgements[word])]
    of_these = f" ({', '.join(judged)})" if judged else ""
    tested = sum(change.q is not None for change in found.numbers)
    if found.paired:
        compared = sum(not change.status.startswith("only") for change in found.numbers)
        yield f"Both are of {found.a.log}: {changed} of {compared} numbers differ{of_these}."
    elif not tested:
        yield "No number has an interval in both, so none can be tested."
    else:
        yield (
            f"{changed or 'None'} of {tested} tested numbers changed by more than chance from A to "
            f"B{of_these}."
        )
    if changed:
        yield f"The first of them: {change_line(found.numbers[0])}."
    for only_in, word in (("B", "New"), ("A", "Gone")):
        if those := dict.fromkeys(named(f.id) for f in found.findings if f.only_in == only_in):
            yield f"{word} findings: {', '.join(those)}."
    if found.texts:
        yield f"Not the same: {', '.join(text.what for text in found.texts)}."


def _notes(a: DiffInput, b: DiffInput, *, paired: bool) -> Iterator[str]:
    """What to mind, and how significance was decided, a sentence each."""
    lacking = [(name, side) for name, side in (("A", a), ("B", b)) if side.analysis is None]
    logs = " and ".join(f"{side.results.log.name} for {name}" for name, side in lacking)
    if lacking:
        untested = "" if paired else "RMSE is not tested without the logs. "
        yield f"{untested}Flights are drawn from their logs. Give {logs}."
    if paired:
        yield (
            "Both are of one flight: each difference is exact for it, and nothing says whether "
            f"another flight would show it too. Less than {LEAST_RATIO:.0%} counts as the same."
        )
        return
    settings = [row["place"] for row in _TEXTS if row["of"] == "settings"]
    if any(at(a.results, place) != at(b.results, place) for place in settings):
        yield "The filter's settings are not the same: numbers of ours differ by them too."
    yield (
        f"Of the changes that are called significant, {FALSE_DISCOVERY_RATE:.0%} are expected to "
        "be chance (Benjamini and Hochberg 1995); q is the p-value after that correction. "
        "Intervals are from the likelihood, of innovations and errors from a bootstrap over blocks "
        "(without the log of innovations from chi-square), of shares from Wilson's formula; they "
        "are combined after Zou and Donner (2008), and widened by what flights of one simulated "
        "vehicle differ by. A real one may vary more: px4fuse batch --baseline takes that from "
        "your own flights."
    )
