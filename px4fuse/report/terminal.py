"""The summary on the terminal: what was compared with what, verdicts, findings, on one screen."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from px4fuse.comparison.comparison import AgainstTruth, AxisComparison, Difference, FilterSummary
from px4fuse.filter.consistency import Consistency
from px4fuse.findings import Finding, Severity
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.words import consequences_words, settings_words, verdict_notes, verdict_words

MOST_FINDINGS = 4
# the screen shows the beginning of a long line; the report has it whole
ONE_LINE: dict[str, Any] = {"no_wrap": True, "overflow": "ellipsis", "crop": True}
STYLES: dict[Severity, str] = {"error": "bold red", "warning": "yellow", "info": "cyan"}


def print_summary(console: Console, document: Document) -> None:
    """Print the summary of one comparison.

    Parameters
    ----------
    console : Console
        Standard output.
    document : Document
    """
    comparison = document.comparison
    log = comparison.flight.log
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
    console.print(Text("vs: RMSE of position (m), velocity (m/s). NIS 1 is consistent.", "dim"))
    for note in verdict_notes(document.comparison):
        console.print(Text(note, "dim"), soft_wrap=True)
    if not document.findings:
        console.print(Text("No findings."))
    for finding in document.findings[:MOST_FINDINGS]:
        print_finding(console, finding)
    if (more := len(document.findings) - MOST_FINDINGS) > 0:
        console.print(Text(f"and {more} more in the report"))


def print_finding(console: Console, finding: Finding, *, whole: bool = False) -> None:
    """Print severity, sentence and remedy, cut at the screen's edge unless all of it is wanted."""
    how = {"soft_wrap": True} if whole else ONE_LINE
    line = Text(f"{finding.severity:9}", style=STYLES[finding.severity])
    console.print(line.append(finding.message, style="none"), **how)
    console.print(Text(" " * 9 + finding.remedy, style="dim"), **how)
    if finding.consequences:
        console.print(Text(" " * 9 + consequences_words(finding), style="dim"), **how)


def _table(document: Document) -> Table:
    truth = not isinstance(document.comparison.flight.truth, Unavailable)
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    columns = ["axis", "filter", "mean NIS", "95 % band", "innovation S", "vs EKF2"]
    columns += ["vs truth"] if truth else []
    for name in columns:
        left = name in ("axis", "filter", "innovation S")
        table.add_column(name, justify="left" if left else "right", no_wrap=True)
    for result in document.comparison.axes:
        table.add_row(
            result.axis.name, "ours", *_statement(result.kf), _difference(result),
            *([_errors(result.kf_truth)] if truth else []),
        )  # fmt: skip
        if not isinstance(result.ekf2, Unavailable):
            table.add_row(
                "", "EKF2", *_statement(result.ekf2), "",
                *([_errors(result.ekf2_truth)] if truth else []),
            )  # fmt: skip
    return table


def print_line(console: Console, label: str, text: str, *, whole: bool = False) -> None:
    """Print a label and a text, cut at the screen's edge unless all of it is wanted."""
    line = Text(f"{label:9}", style="bold").append(text, style="none")
    console.print(line, **({"soft_wrap": True} if whole else ONE_LINE))


def _statement(summary: FilterSummary) -> tuple[str, str, Text]:
    statement = summary.consistency
    if not isinstance(statement, Consistency):
        return "", "", Text(verdict_words(statement), style="dim")
    low, high = statement.nis_band
    style = "green" if statement.verdict == "consistent" else "yellow"
    return (
        f"{statement.nis_mean:.3g}",
        f"{low:.2f}-{high:.2f}",
        Text(verdict_words(statement), style=style),
    )


def _errors(truth: AgainstTruth | Unavailable) -> str:
    if isinstance(truth, Unavailable):
        return ""
    if truth.velocity_rmse_m_s is None:
        return f"{truth.position_rmse_m:.3f}"
    return f"{truth.position_rmse_m:.3f} {truth.velocity_rmse_m_s:.3f}"


def _difference(result: AxisComparison) -> str:
    if not isinstance(result.difference, Difference):
        return ""
    return f"{result.difference.position_rmse_m:.3f} {result.difference.velocity_rmse_m_s:.3f}"
