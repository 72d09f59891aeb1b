"""What changed from A to B in words: the same on the terminal, on the page and in the results."""

from __future__ import annotations

from px4fuse.plain import number_words
from px4fuse.results.changes import NumberChange
from px4fuse.results.contract import ChangeResults

# A number without a test is told where it moved by so much
TOLD_RATIO = 0.25


def told(results: ChangeResults) -> list[NumberChange]:
    """The changes that stand in a table: significant ones, then large ones that have no test."""
    return [c for c in results.numbers if c.judgement or is_large(c)]


def is_large(change: NumberChange) -> bool:
    """Whether a number that cannot be tested moved by so much that it is told."""
    if change.status != "not tested" or change.scale != "ratio" or change.change is None:
        return False
    return not 1.0 / (1.0 + TOLD_RATIO) < change.change < 1.0 + TOLD_RATIO


def judgement_words(change: NumberChange) -> str:
    """Worse, better or changed; or that there is no test."""
    return change.judgement or "no test"


def value_words(change: NumberChange, value: float, *, unit: bool = False) -> str:
    """A number of A or B; shares are per cent."""
    if is_share(change):
        return f"{value:.1%}"
    return number_words(value) + (f" {change.unit}" if unit and change.unit else "")


def is_share(change: NumberChange) -> bool:
    """Whether a number is a share."""
    return change.scale == "difference" and not change.unit


def change_words(change: NumberChange) -> str:
    """By how much it changed, with its 95 % interval where there is one."""
    if change.change is None:
        return ""
    bounds = change.change_interval
    if change.scale == "ratio":
        within = "" if bounds is None else " ({} to {})".format(*map(number_words, bounds))
        return f"× {number_words(change.change)}{within}"
    if is_share(change):
        within = "" if bounds is None else f" ({100 * bounds[0]:+.1f} to {100 * bounds[1]:+.1f})"
        return f"{100 * change.change:+.1f} points{within}"
    within = "" if bounds is None else " ({} to {})".format(*map(_signed, bounds))
    return f"{_signed(change.change)} {change.unit}{within}"


def chance_words(change: NumberChange) -> str:
    """What the correction for many tests leaves of the p-value."""
    if change.q is None:
        return ""
    return "q < 0.001" if change.q < 0.001 else f"q {number_words(change.q, 2)}"


def folded_words(results: ChangeResults) -> str:
    """The numbers that no table shows, in one line."""
    shown = {change.path for change in told(results)}
    rest: list[str] = [change.status for change in results.numbers if change.path not in shown]
    said = [
        f"{count} {words}"
        for status, words in (
            ("same", "unchanged"),
            ("within chance", "changed by no more than chance"),
            ("not tested", f"without a test, within {TOLD_RATIO:.0%}"),
        )
        if (count := rest.count(status))
    ]
    for only_in in ("A", "B"):
        if count := sum(one.only_in == only_in for one in results.one_sided):
            said.append(f"{count} in {only_in} alone")
    return f"Numbers not shown: {', '.join(said)}." if said else ""


def _signed(value: float) -> str:
    return ("+" if value >= 0.0 else "-") + number_words(abs(value), 2)
