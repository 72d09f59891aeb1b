"""The summary on the terminal: what happened, what was compared with what, verdicts, findings."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from px4fuse.comparison.model import Difference
from px4fuse.ekf2.walk import Why
from px4fuse.filter.consistency import Consistency
from px4fuse.findings import Finding, Severity, by_root
from px4fuse.flight import Unavailable
from px4fuse.report.commands import runnable
from px4fuse.report.document import Document
from px4fuse.report.screen import (
    INDENT,
    plain_table,
    print_command,
    print_file,
    print_line,
    say,
)
from px4fuse.report.words import (
    consequences_words,
    difference_cells,
    error_cells,
    finding_words,
    settings_words,
    statement_cells,
    verdict_notes,
)
from px4fuse.request import Request

MOST_FINDINGS = 4
LEGEND = "Apart: ours - EKF2, RMS of position and velocity. NIS in the band: consistent."
STYLES: dict[Severity, str] = {"error": "bold red", "warning": "yellow", "info": "cyan"}


def print_summary(
    console: Console, document: Document, request: Request, report: object = None
) -> None:
    """Print the summary of one comparison.

    Parameters
    ----------
    console : Console
        Standard output.
    document : Document
    request : Request
        As it was typed: the commands that are printed run.
    report : Path, optional
        Where the report was written.
    """
    comparison = document.comparison
    log = comparison.flight.log
    for sentence in document.story:
        say(console, sentence)
    console.print()
    opponent = "" if isinstance(comparison.flight.ekf2, Unavailable) else ", against EKF2"
    names = " + ".join([log.name, *(file.name for file in comparison.flight.inputs)])
    print_line(console, "Log", f"{names}, {log.firmware}, {log.duration_s:.1f} s")
    print_line(console, "Filter", settings_words(comparison.settings) + opponent)
    source = comparison.source
    print_line(
        console, "Position", f"{source.name}, {source.rate_hz:.1f} Hz ({comparison.source_reason})"
    )
    if source.alignment is not None:
        placed = source.alignment
        sigma = placed.clock_offset_sigma_s
        placing = (
            f"{placed.frame}, yaw {placed.yaw_deg:.1f}°, clock {placed.clock_offset_s:+.3f}"
            + (f" ± {sigma:.3f} s" if sigma is not None else " s")
        )
        print_line(console, "Placed", placing)
    segment = comparison.segment
    print_line(
        console, "Segment", f"{segment.start_s:.1f} s to {segment.end_s:.1f} s, {segment.reason}"
    )
    console.print(_table(document))
    say(console, Text(LEGEND, "dim"))
    for note in verdict_notes(comparison):
        say(console, Text(note, "dim"))
    why = document.analysis.why.get(comparison.main.axis.name)
    if why is not None and not _told(why, document.story):
        print_why(console, why)
    if not document.findings:
        say(console, "No findings.")
    groups = by_root(document.findings)
    for group in groups[:MOST_FINDINGS]:
        print_finding(console, group, request)
    if (more := len(groups) - MOST_FINDINGS) > 0:
        say(console, f"and {more} more in the report" if report else f"and {more} more")
    if report is not None:
        print_file(console, "Report", report)


def print_why(console: Console, why: Why | Unavailable) -> None:
    """Print in one sentence why EKF2 differs."""
    if isinstance(why, Unavailable):
        print_line(console, "Why", f"EKF2 differs is not known: {why.reason}.", "dim")
    else:
        print_line(console, "Why", why.sentences[0])


def _told(why: Why | Unavailable, story: tuple[str, ...]) -> bool:
    """Whether the story has the sentence, which it cuts where it names the moment."""
    if isinstance(why, Unavailable):
        return False
    return any(why.sentences[0].startswith(sentence.removesuffix(".")) for sentence in story)


def print_advice(console: Console, lines: Iterable[str], request: Request) -> None:
    """Print lines whose first columns are a label, with the commands in them in full."""
    for line in lines:
        label, (text, commands) = line[:INDENT].strip(), runnable(line[INDENT:], request)
        print_line(console, label, text)
        for command in commands:
            print_command(console, command)


def print_finding(console: Console, group: list[Finding], request: Request) -> None:
    """Print severity, sentence, remedy and the commands that it names, and what follows."""
    finding, *followers = group
    head = Text(finding.severity.ljust(INDENT), STYLES[finding.severity])
    say(console, finding_words(finding), head, INDENT)
    remedy, commands = runnable(finding.remedy, request)
    print_line(console, "", remedy, "dim")
    if followers:
        print_line(console, "", consequences_words(followers), "dim")
    for command in commands:
        print_command(console, command)


def _table(document: Document) -> Table:
    comparison = document.comparison
    ekf2 = any(isinstance(result.difference, Difference) for result in comparison.axes.values())
    table = plain_table(
        ("axis", "left"), ("filter", "left"), ("mean\nNIS", "right"), ("95 %\nband", "right"),
        ("innovation\nvariance", "left"),
        *((("apart\n(m)", "right"), ("\n(m/s)", "right")) if ekf2 else ()),
        *((("to truth\n(m)", "right"), ("\n(m/s)", "right")) if document.truth_known else ()),
    )  # fmt: skip
    main = comparison.main
    for result in (main, *(result for result in comparison.axes.values() if result is not main)):
        for name, statement in result.filters.items():
            ours = name == "kf"
            if not ours and isinstance(result.ekf2_state, Unavailable):
                continue
            verdict = statement_cells(statement)
            table.add_row(
                Text(result.axis.name if ours else "", "bold"), "ours" if ours else "EKF2",
                verdict.nis, verdict.band, Text(verdict.words, _style(statement)),
                *((difference_cells(result.difference) if ours else ("", "")) if ekf2 else ()),
                *(error_cells(statement.truth) if document.truth_known else ()),
            )  # fmt: skip
    return table


def _style(statement: Consistency | Unavailable) -> str:
    if isinstance(statement, Unavailable):
        return "dim"
    return "green" if statement.verdict == "consistent" else "yellow"
