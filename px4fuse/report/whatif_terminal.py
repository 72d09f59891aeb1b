"""What if EKF2 had had other parameters, on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

from rich.console import Console
from rich.table import Table
from rich.text import Text

from px4fuse.analysis import Counterfactual
from px4fuse.filter.signals import AISLE
from px4fuse.report.screen import plain_table, print_line, say
from px4fuse.report.terminal import print_why
from px4fuse.report.whatif import heads, reading, rows, sweep_heads, sweep_of, sweep_rows
from px4fuse.report.why import agreement_words

NARROW = 12  # characters of a column's head


def print_what_if(console: Console, made_of: Counterfactual) -> None:
    """Print EKF2 as logged, as replayed and with other parameters, and a sweep where there is one.

    Parameters
    ----------
    console : Console
        Standard output.
    made_of : Counterfactual
    """
    log, found = made_of.flight.log, made_of.whatif
    print_line(console, "Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found.judged)
    print_line(console, "Judged", spans)
    print_line(console, "Replay", agreement_words(found.agreement))
    if AISLE in made_of.why:
        print_why(console, made_of.why[AISLE])
    console.print(_table(["", *heads(made_of)], rows(made_of)))
    if sweep_of(made_of):
        console.print()
        # seven columns on a screen of 80
        narrow = [fill(head, NARROW, break_long_words=False) for head in sweep_heads(made_of)]
        body = [[cell.replace(", ", "/") for cell in cells] for cells in sweep_rows(made_of)]
        console.print(_table(narrow, body))
    for line in reading(made_of):
        say(console, line)
    say(console, Text("Replays are of px4fuse's model of EKF2, not of PX4's own code.", "dim"))


def _table(head: Sequence[str], body: list[list[str]]) -> Table:
    table = plain_table(*((name, "right" if at else "left") for at, name in enumerate(head)))
    for cells in body:
        table.add_row(*map(Text, cells))
    return table
