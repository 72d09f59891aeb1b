"""Terminal output of ``px4fuse batch`` and ``px4fuse diff``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from px4fuse.findings import finding_title
from px4fuse.fleet.measures import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE
from px4fuse.fleet.rows import FAILED, FINDING_SEPARATOR
from px4fuse.report.page import Page, styled_text
from px4fuse.report.style import MUTED_COLOUR, SEVERITY_COLOURS
from px4fuse.results.contract import ChangeResults, Interval
from px4fuse.text import format_factor, format_number

if TYPE_CHECKING:
    from px4fuse.fleet.run import BatchResult

# Maximum number of reasons, and of findings, in the summary
MAX_LISTED = 8
RED, YELLOW = SEVERITY_COLOURS["error"], SEVERITY_COLOURS["warning"]
NUMBER_HEADS = ("number", "A", "95 %", "B", "95 %", "unit")


def format_summary(batch_result: BatchResult) -> Page:
    """Format the reasons for failed logs, the σ factors of both filters by axis, and findings."""
    page, logs = Page(), batch_result.table.drop_duplicates("log")
    uncompared = logs[logs["axis"] == ""].groupby(["status", "reason", "remedy"], sort=False)["log"]
    causes = uncompared.agg(["count", "first"]).reset_index()
    sorted_causes = causes.sort_values("count", ascending=False, kind="stable")
    for cause in sorted_causes.head(MAX_LISTED).to_dict("records"):
        prefix = "" if cause["count"] == 1 else f"{cause['count']} logs, for example "
        text = "{first}: {status}: {reason}. {remedy}".format_map(cause).rstrip()
        page.write(prefix + text, colour=RED if cause["status"] == FAILED else YELLOW)
    if len(sorted_causes) > MAX_LISTED:
        remaining_count = len(sorted_causes) - MAX_LISTED
        page.write(f"fleet.html lists {remaining_count} further reasons for logs without a result.")
    heads = [
        f"{filter_name}\n{title}" for filter_name in ("KF", "EKF2") for title in ("logs", "σ ratio")
    ]
    lines = []
    for axis, rows in batch_result.table[batch_result.table["axis"] != ""].groupby(
        "axis", sort=False
    ):
        cells = []
        for ratios in (rows["kf_sigma_ratio"].dropna(), rows["ekf2_sigma_ratio"].dropna()):
            cells += [f"{len(ratios)}", format_factor(ratios.median()) if len(ratios) else "–"]
        lines.append((str(axis), *cells))
    if lines:
        page.table(("axis", *heads), lines, right=(1, 2, 3, 4))
        ratio_note = (
            "σ ratio: median over the logs of actual σ / reported σ (above 1: overconfident)"
        )
        page.write(ratio_note, colour=MUTED_COLOUR)
    finding_ids = logs["findings"].str.split(FINDING_SEPARATOR).explode()
    for finding, count in finding_ids[finding_ids != ""].value_counts().head(MAX_LISTED).items():
        page.write(f"{count} × {finding_title(str(finding))}")
    counts = logs["status"].value_counts()
    status_counts = ", ".join(f"{count} {status}" for status, count in counts.items())
    retry_note = " Run the same command to repeat failed logs." if FAILED in counts else ""
    reused = f"{batch_result.reused_count} reused from an earlier run"
    page.write(f"{len(logs)} logs: {status_counts}; {reused}.{retry_note}")
    return page


def format_differences(results: ChangeResults) -> Page:
    """Format settings, numbers and findings that differ, and verdicts that are worse in B."""
    page = Page()
    for name, diff_input in (("A", results.a), ("B", results.b)):
        log = (
            diff_input.kind
            if diff_input.given == diff_input.log
            else f"{diff_input.kind} of {diff_input.log}"
        )
        versions = f"SHA-256 {diff_input.log_sha256[:12]}, px4fuse {diff_input.px4fuse}"
        page.write_labelled(name, f"{diff_input.given} ({log}), {versions}")
    if results.settings:
        settings = [
            (setting.name, _format_setting(setting.a), _format_setting(setting.b))
            for setting in results.settings
        ]
        page.table(("setting", "A", "B"), settings)
    rows = []
    for number in results.numbers:
        factor, unit = (100.0, "%") if number.unit == "share" else (1.0, number.unit)
        cells = [
            cell
            for value, interval in ((number.a, number.a_interval), (number.b, number.b_interval))
            for cell in (_format_value(value, factor), _format_interval(interval))
        ]
        rows.append((number.label, *cells, unit))
    if rows:
        page.table(NUMBER_HEADS, rows, right=(1, 2, 3, 4))
    tolerance_text = f"{100.0 * RELATIVE_TOLERANCE:g} % or {ABSOLUTE_TOLERANCE:g}"
    page.write(
        f"Numbers that differ by less than {tolerance_text} are not listed.", colour=MUTED_COLOUR
    )
    for finding in results.findings:
        styled = styled_text(
            f"{finding.severity}: {finding.message}", 8.0, SEVERITY_COLOURS[finding.severity]
        )
        page.write_labelled(f"Only {finding.only_in}", styled)
    for text in results.worse:
        page.write_labelled("Worse", styled_text(text, 8.0, RED))
    if not results.worse:
        page.write("No verdict is worse in B.")
    return page


def _format_setting(value: float | str | None) -> str:
    if value is None:
        return "–"
    return value if isinstance(value, str) else f"{value:.6g}"


def _format_value(value: float | None, factor: float) -> str:
    return "" if value is None else format_number(factor * value)


def _format_interval(interval: Interval | None) -> str:
    if interval is None:
        return ""
    low, high = interval
    return (
        f"above {format_number(low)}"
        if high is None
        else f"{format_number(low)} to {format_number(high)}"
    )
