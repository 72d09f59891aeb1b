"""What changed from A to B, on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from px4fuse.report.changes_words import cells, folded_words, other_lines, printed
from px4fuse.report.screen import STYLES, plain_table, print_line, say
from px4fuse.report.style import SEVERITY_COLOURS
from px4fuse.results.contract import ChangeResults

MOST = 15
JUDGED = {"worse": "bold red", "better": "green", "changed": "bold", "no test": "dim"}


def print_changes(console: Console, results: ChangeResults, report: object = None) -> None:
    """Print what changed, significant changes first.

    Parameters
    ----------
    console : Console
        Standard output.
    results : ChangeResults
    report : Path, optional
        Where the page was written.
    """
    say(console, Text(results.summary[0], "bold"))
    console.print()
    for name, side in (("A", results.a), ("B", results.b)):
        of = "" if side.given == side.log else f", of {side.log}"
        print_line(console, name, f"{side.given}{of}")
    shown = printed(results)
    table = plain_table(
        ("", "left"), ("number", "left"), ("A", "right"), ("B", "right"), ("change (95 %)", "left")
    )
    for change in shown[:MOST]:
        judged, *others, _ = cells(change)
        table.add_row(Text(judged, JUDGED[judged]), *others)
    if shown:
        console.print(table)
    if (more := len(shown) - MOST) > 0:
        say(console, f"and {more} more in the report" if report else f"and {more} more (--json)")
    if folded := folded_words(results):
        say(console, Text(folded, "dim"))
    for head, text, severity in other_lines(results):
        style = STYLES[SEVERITY_COLOURS[severity]] if severity else ""
        print_line(console, head, Text(text, style))
    for note in results.notes[:2]:
        say(console, Text(note, "dim"))
