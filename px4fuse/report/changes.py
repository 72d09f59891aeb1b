"""What changed from A to B: its words and numbers, on a page and on the terminal."""

from collections.abc import Iterator

from px4fuse.plain import number_words
from px4fuse.report.page import Cell, Page, words
from px4fuse.report.style import GOOD, MUTED, SEVERITY_COLOURS
from px4fuse.results.contract import ChangeResults, NumberChange

COLOURS = {"worse": SEVERITY_COLOURS["error"], "better": GOOD}
SIZE = 7.6
SHARES = (7.5, 28.0, 7.5, 10.0, 25.0, 9.0)
HEADS = ("", "number", "A", "B", "change (95 %)", "by chance?")
# Columns and rows of the table, notes, and sentences of the summary that fit on a screen
SCREEN = (5, 15, 2, 1)
# A number without a test is printed where it moved by so much
PRINTED_RATIO = 0.25
LABELS = {"setting": "Setting", "parameter": "PX4", "flight": "Flight", "B": "New", "A": "Gone"}
_NOT_SHOWN = {
    "same": "unchanged",
    "within chance": "changed by no more than chance",
    "not tested": f"without a test, within {PRINTED_RATIO:.0%}",
    "only in A": "in A alone",
    "only in B": "in B alone",
}


def draw(_: object, results: ChangeResults) -> Iterator[Page]:
    """One page, and more where much changed."""
    page = Page("What changed from A to B")
    _write(page, results)
    yield page


def summary(results: ChangeResults) -> Page:
    """What changed, significant changes first, as much as fits on a screen."""
    page = Page()
    _write(page, results, short=True)
    return page


def _write(page: Page, results: ChangeResults, *, short: bool = False) -> None:
    """Write all that is said in words and numbers, or as much of it as fits on a screen."""
    columns, most_rows, most_notes, most_said = SCREEN if short else (None,) * 4
    first, *others = results.summary[:most_said]
    page.write(first, size=10.0, bold=True)
    for text in others:
        page.write(text, size=8.6, above=2.0)
    for name, side in (("A", results.a), ("B", results.b)):
        kind = {"log": "its log", "report": "its report", "results": "its results"}[side.kind]
        of = "" if side.given == side.log else f" of {side.log}"
        said = f"{side.given}, {kind}{of}; SHA-256 {side.log_sha256[:12]}, px4fuse {side.px4fuse}"
        page.labelled(name, said, size=SIZE, above=1.0)
    changes = printed(results)
    rows: list[list[Cell]] = []
    for change in changes[:most_rows]:
        judged, *others = cells(change)[:columns]
        rows.append([(judged, COLOURS.get(judged, "black")), *others])
    if rows:
        page.table(HEADS[:columns], rows, right=(2, 3), shares=SHARES[:columns], size=SIZE)
    if len(changes) > len(rows):
        page.write(f"and {len(changes) - len(rows)} more in the report and in the results")
    page.write(_not_shown(results), size=SIZE, colour=MUTED, above=3.0)
    for fact in results.texts:
        page.labelled(LABELS[fact.kind], f"{fact.what}: {fact.a} → {fact.b}", size=SIZE)
    for finding in results.findings:
        said, colour = f"{finding.severity}: {finding.message}", SEVERITY_COLOURS[finding.severity]
        page.labelled(LABELS[finding.only_in], words(said, SIZE, colour), size=SIZE)
    for text in results.notes[:most_notes]:
        page.write(text, size=SIZE, colour=MUTED, above=3.0)


# ---------------------------------------------------------------------------------------- words


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


def _not_shown(results: ChangeResults) -> str:
    """The numbers that no table shows, in one line."""
    shown = {change.path for change in printed(results)}
    rest: list[str] = [change.status for change in results.numbers if change.path not in shown]
    said = [f"{n} {words}" for status, words in _NOT_SHOWN.items() if (n := rest.count(status))]
    return f"Numbers not shown: {', '.join(said)}." if said else ""
