"""What changed from A to B in words: the same on the terminal, on the page and in the results."""

from __future__ import annotations

from collections.abc import Iterator

from px4fuse.findings import Severity
from px4fuse.plain import number_words
from px4fuse.results.changes import NumberChange
from px4fuse.results.contract import ChangeResults

# A number without a test is printed where it moved by so much
PRINTED_RATIO = 0.25
_HEADS = {"setting": "Setting", "parameter": "PX4", "flight": "Flight"}
_NOT_SHOWN = {
    "same": "unchanged",
    "within chance": "changed by no more than chance",
    "not tested": f"without a test, within {PRINTED_RATIO:.0%}",
    "only in A": "in A alone",
    "only in B": "in B alone",
}


def printed(results: ChangeResults) -> list[NumberChange]:
    """The changes that stand in a table: significant ones, then large ones that have no test."""
    return [change for change in results.numbers if change.judgement or _is_large(change)]


def _is_large(change: NumberChange) -> bool:
    """Whether a number that cannot be tested moved by so much that it is printed."""
    if change.status != "not tested" or change.scale != "ratio" or change.change is None:
        return False
    return not 1.0 / (1.0 + PRINTED_RATIO) < change.change < 1.0 + PRINTED_RATIO


def cells(change: NumberChange) -> tuple[str, ...]:
    """A line of the table: judgement, number, A, B, by how much, and whether by chance."""
    q = change.q
    chance = "" if q is None else "q < 0.001" if q < 0.001 else f"q {number_words(q, 2)}"
    b = _value(change, change.b)
    unit = f" {change.unit}" if b and change.unit else ""
    judged = change.judgement or "no test"
    return judged, change.label, _value(change, change.a), f"{b}{unit}", _moved(change), chance


def change_line(change: NumberChange) -> str:
    """A change in one line."""
    judged, label, a, b, moved, chance = cells(change)
    rest = ", ".join(filter(None, (moved, chance)))
    return f"{label}, {judged}: {a} to {b}{rest and ', '}{rest}"


def _value(change: NumberChange, value: float | None) -> str:
    if value is None:
        return ""
    share = change.scale == "difference" and not change.unit
    return f"{value:.1%}" if share else number_words(value)


def _moved(change: NumberChange) -> str:
    """By how much it changed, with its 95 % interval where there is one."""
    if change.change is None:
        return ""
    values = (change.change, *(change.change_interval or ()))
    if change.scale == "ratio":
        by, *ends = map(number_words, values)
        by = f"× {by}"
    elif change.unit:
        by, *ends = (f"{'+' if v >= 0.0 else '-'}{number_words(abs(v), 2)}" for v in values)
        by = f"{by} {change.unit}"
    else:
        by, *ends = (f"{100.0 * value:+.1f}" for value in values)
        by = f"{by} points"
    return f"{by} ({' to '.join(ends)})" if ends else by


def folded_words(results: ChangeResults) -> str:
    """The numbers that no table shows, in one line."""
    shown = {change.path for change in printed(results)}
    rest: list[str] = [change.status for change in results.numbers if change.path not in shown]
    said = [f"{n} {words}" for status, words in _NOT_SHOWN.items() if (n := rest.count(status))]
    return f"Numbers not shown: {', '.join(said)}." if said else ""


def other_lines(results: ChangeResults) -> Iterator[tuple[str, str, Severity | None]]:
    """What else is not the same: a head, a sentence, and the severity where it is a finding."""
    for text in results.texts:
        yield _HEADS[text.kind], f"{text.what}: {text.a} → {text.b}", None
    for finding in results.findings:
        head = "New" if finding.only_in == "B" else "Gone"
        yield head, f"{finding.severity}: {finding.message}", finding.severity
