"""What else is not the same in A and B, and the sentences about it all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Literal

from px4fuse.findings import named
from px4fuse.fleet.inputs import DiffInput
from px4fuse.fleet.measures import LEAST_RATIO, at
from px4fuse.fleet.significance import FALSE_DISCOVERY_RATE
from px4fuse.report.changes import change_line
from px4fuse.results.changes import FindingChange, TextChange, Which
from px4fuse.results.contract import ChangeResults, ComparisonResults

# What is compared as text: its kind, its name, and where it stands in the results
_Row = tuple[Literal["setting", "parameter", "flight"], str, str]
_SETTINGS: tuple[_Row, ...] = (
    ("setting", "SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("setting", "SIGMA_Z (m)", "settings.sigma_z_m"),
    ("setting", "DT (s)", "settings.dt_s"),
    ("setting", "input", "settings.input"),
    ("setting", "clock offset added (s)", "settings.clock_offset_s"),
)
_SEGMENT: tuple[_Row, ...] = (
    ("setting", "start (s)", "settings.start_s"),
    ("setting", "end (s)", "settings.end_s"),
)
_FLIGHT: tuple[_Row, ...] = (
    ("flight", "firmware", "log.firmware"),
    ("flight", "firmware hash", "log.firmware_hash"),
    ("flight", "hardware", "log.hardware"),
    ("flight", "position source", "source.name"),
    ("flight", "px4fuse", "provenance.px4fuse"),
)


def texts(a: ComparisonResults, b: ComparisonResults, *, paired: bool) -> Iterator[TextChange]:
    """Settings, parameters of PX4 and facts about the flight that are not the same."""
    one, other = _parameters(a), _parameters(b)
    facts = (*_SETTINGS, *(_SEGMENT if paired else ()), *_FLIGHT)
    rows = [
        *((kind, what, at(a, place), at(b, place)) for kind, what, place in facts),
        *(("parameter", n, one.get(n), other.get(n)) for n in sorted(one.keys() | other.keys())),
    ]
    for kind, what, first, second in rows:
        if first != second:
            yield TextChange(kind, what, _plain(first), _plain(second))


def _parameters(found: ComparisonResults) -> dict[str, float]:
    """Of PX4: those that EKF2 was replayed with, and those that the log has."""
    replayed, logged = at(found, "ekf2_replay.settings") or {}, found.log.parameters
    return {name: float(value) for name, value in (*replayed.items(), *logged.items())}


def _plain(value: object) -> str:
    if value is None:
        return "not logged"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def findings(a: ComparisonResults, b: ComparisonResults) -> Iterator[FindingChange]:
    """Findings that only one of the two has, as a cause or as a consequence."""
    both: tuple[tuple[ComparisonResults, ComparisonResults, Which], ...]
    both = ((b, a, "B"), (a, b, "A"))
    for mine, other, only_in in both:
        known = {one.id for one in other.findings}
        for one in mine.findings:
            if one.id not in known:
                yield FindingChange(one.id, one.severity, one.message, only_in)


def sentences(found: ChangeResults) -> Iterator[str]:
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


def notes(a: DiffInput, b: DiffInput, *, paired: bool) -> Iterator[str]:
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
    if any(at(a.results, place) != at(b.results, place) for _, _, place in _SETTINGS):
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
