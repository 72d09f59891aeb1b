"""What changed in words: settings, parameters and findings, the summary, and how it was tested."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from px4fuse.comparison.events import happened
from px4fuse.ekf2.replay import Replayed
from px4fuse.findings import named
from px4fuse.fleet.measures import BOOTSTRAP, CHI_SQUARE, LIKELIHOOD, WILSON, Number
from px4fuse.fleet.sides import Side
from px4fuse.fleet.significance import FALSE_DISCOVERY_RATE, LEAST_RATIO
from px4fuse.report.changes_words import chance_words, change_words, value_words
from px4fuse.results.changes import FindingChange, NumberChange, TextChange, Which
from px4fuse.results.contract import ChangeResults, ComparisonResults

_SETTINGS = {
    "sigma_a_m_s2": "SIGMA_A (m/s²)",
    "sigma_z_m": "SIGMA_Z (m)",
    "dt_s": "DT (s)",
    "input": "input",
    "clock_offset_s": "clock offset added (s)",
}
_SEGMENT = {"start_s": "start (s)", "end_s": "end (s)"}
_LOG = {"firmware": "firmware", "firmware_hash": "firmware hash", "hardware": "hardware"}
ABSENT = "not logged"
_HOW = {
    LIKELIHOOD: "of noises, clock and heading from their likelihood",
    BOOTSTRAP: "of innovations and errors by a bootstrap over blocks of the flight",
    CHI_SQUARE: "of innovations by chi-square for as many as are independent (from their lag-1 "
    "autocorrelation)",
    WILSON: "of shares by Wilson's formula for as many as are independent",
}


def why(change: NumberChange, a: Number, b: Number) -> str:
    """What the status of a number rests on."""
    moved = f"{value_words(change, change.a)} to {value_words(change, change.b, unit=True)}"
    by = change_words(change)
    text = f"{moved}, {by}" if by else moved
    if change.status in ("differs", "same"):
        return f"{text}; the same flight."
    if change.q is not None:
        words = "more" if change.status == "significant" else "no more"
        methods = " and ".join(dict.fromkeys((a.method, b.method)))
        return f"{text}; {words} than chance ({chance_words(change)}; {methods})."
    if change.change is None:
        return f"{text}; no test where one is 0."
    lacking = " and ".join(name for name, one in (("A", a), ("B", b)) if one.interval is None)
    return f"{text}; not tested, no interval for {lacking}."


def texts(a: Side, b: Side, *, paired: bool) -> Iterator[TextChange]:
    """Settings, parameters of PX4 and facts about the flight that are not the same."""
    first, second = a.results, b.results
    for name, label in (_SETTINGS | (_SEGMENT if paired else {})).items():
        one, other = (_plain(getattr(found.settings, name)) for found in (first, second))
        if one != other:
            yield TextChange("setting", label, one, other)
    for name in sorted(_parameters(first).keys() | _parameters(second).keys()):
        one, other = (_plain(_parameters(found).get(name)) for found in (first, second))
        if one != other:
            yield TextChange("parameter", name, one, other)
    facts = [(label, getattr(first.log, n), getattr(second.log, n)) for n, label in _LOG.items()]
    facts += [
        ("position source", first.source.name, second.source.name),
        ("px4fuse", first.provenance.px4fuse, second.provenance.px4fuse),
    ]
    if a.analysis is not None and b.analysis is not None:
        facts.append(("flight modes", _modes(a), _modes(b)))
    for label, one, other in facts:
        if one != other:
            yield TextChange("flight", label, one, other)


def _plain(value: object) -> str:
    if value is None:
        return ABSENT
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _parameters(found: ComparisonResults) -> Mapping[str, float]:
    """Of PX4: those that the log has, and those that EKF2 was replayed with."""
    replay = found.ekf2_replay
    return (dict(replay.settings) if isinstance(replay, Replayed) else {}) | {
        name: float(value) for name, value in found.log.parameters.items()
    }


def _modes(side: Side) -> str:
    """Flight modes in the order in which they were first flown."""
    assert side.analysis is not None
    modes = happened(side.analysis).modes
    return ", ".join(dict.fromkeys(mode.name for mode in modes)) or ABSENT


def findings(a: ComparisonResults, b: ComparisonResults) -> Iterator[FindingChange]:
    """Findings that only one of the two has, as a cause or as a consequence."""
    sides: tuple[tuple[ComparisonResults, ComparisonResults, Which], ...]
    sides = ((b, a, "B"), (a, b, "A"))
    for mine, other, only_in in sides:
        known = {one.id for one in other.findings}
        for one in mine.findings:
            if one.id not in known:
                yield FindingChange(one.id, one.severity, one.message, only_in)


def summary(found: ChangeResults) -> tuple[str, ...]:
    """What changed, in a few sentences."""
    counts = found.counts
    first = next((change for change in found.numbers if change.judgement), None)
    judged = [
        f"{count} {word}"
        for count, word in ((counts.worse, "worse"), (counts.better, "better"))
        if count
    ]
    of_these = f" ({', '.join(judged)})" if judged else ""
    if found.paired:
        sentence = (
            f"Both are of {found.a.log}: {counts.changed} of {counts.compared} numbers "
            f"differ{of_these}."
        )
    elif not counts.tested:
        sentence = "No number has an interval in both, so none can be tested."
    else:
        sentence = (
            f"{counts.changed or 'None'} of {counts.tested} tested numbers changed by more than "
            f"chance from A to B{of_these}."
        )
    said = [sentence]
    if first is not None:
        said.append(f"The first of them: {first.label}, {first.why}")
    for only_in, word in (("B", "New"), ("A", "Gone")):
        those = dict.fromkeys(named(f.id) for f in found.findings if f.only_in == only_in)
        if those:
            said.append(f"{word} findings: {', '.join(those)}.")
    if found.texts:
        said.append(f"Not the same: {', '.join(text.what for text in found.texts)}.")
    return tuple(said)


def methods(both: Mapping[str, tuple[Number, Number]], *, paired: bool) -> Iterator[str]:
    """How significance was decided, a sentence each."""
    if paired:
        return
    yield (
        f"Of the changes that are called significant, {FALSE_DISCOVERY_RATE:.0%} are expected to "
        "be chance (Benjamini and Hochberg 1995); q is the p-value after that correction."
    )
    used = dict.fromkeys(number.method for pair in both.values() for number in pair)
    if how := [_HOW[method] for method in used if method]:
        yield f"Intervals (95 %) are {'; '.join(how)}."
    yield (
        "Two intervals are combined by the distances from each value to its ends (Zou and Donner "
        "2008), and widened by what flights of one simulated vehicle differ by beyond them. A "
        "real vehicle may vary more: px4fuse batch --baseline takes that from your own flights."
    )


def notes(a: Side, b: Side, *, paired: bool) -> Iterator[str]:
    """What to mind, a sentence each."""
    lacking = [(name, side) for name, side in (("A", a), ("B", b)) if side.analysis is None]
    logs = " and ".join(f"{side.results.log.name} for {name}" for name, side in lacking)
    if paired:
        yield (
            "Both are of one flight, so there is no sampling between them: each difference is "
            "exact for this flight, and nothing says whether another flight would show it too. "
            f"Less than {LEAST_RATIO:.0%} counts as the same."
        )
    else:
        if lacking:
            yield f"RMSE is not tested without the logs. Give {logs}."
        one, other = (side.results.settings for side in (a, b))
        if any(getattr(one, name) != getattr(other, name) for name in _SETTINGS):
            yield (
                "The filter's settings are not the same, so numbers of ours differ by them too, "
                "not by the flights alone."
            )
    if lacking:
        yield f"Tracks and innovations are drawn from the logs. Give {logs}."
