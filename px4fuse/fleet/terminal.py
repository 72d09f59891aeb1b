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
    from px4fuse.fleet.run import Fleet

# Maximum number of listed reasons, and of listed findings
MAX_SHOWN = 8
RED, YELLOW = SEVERITY_COLOURS["error"], SEVERITY_COLOURS["warning"]
NUMBER_HEADS = ("number", "A", "95 %", "B", "95 %", "unit")


def summary(fleet: Fleet) -> Page:
    """Format logs that could not be compared, the σ of both filters by axis, and findings."""
    page, logs = Page(), fleet.table.drop_duplicates("log")
    uncompared = logs[logs["axis"] == ""].groupby(["status", "reason", "remedy"], sort=False)["log"]
    causes = uncompared.agg(["count", "first"]).reset_index()
    sorted_causes = causes.sort_values("count", ascending=False, kind="stable")
    for cause in sorted_causes.head(MAX_SHOWN).to_dict("records"):
        prefix = "" if cause["count"] == 1 else f"{cause['count']} logs, for example "
        text = "{first}: {status}: {reason}. {remedy}".format_map(cause).rstrip()
        page.write(prefix + text, colour=RED if cause["status"] == FAILED else YELLOW)
    if len(sorted_causes) > MAX_SHOWN:
        page.write(f"{len(sorted_causes) - MAX_SHOWN} further reasons are in fleet.html.")
    heads = [
        f"{filter_name}\
{title}"
        for filter_name in ("KF", "EKF2")
        for title in ("logs", "σ ratio")
    ]
    lines = []
    for axis, rows in fleet.table[fleet.table["axis"] != ""].groupby("axis", sort=False):
        cells = []
        for ratios in (rows["kf_sigma_ratio"].dropna(), rows["ekf2_sigma_ratio"].dropna()):
            cells += [f"{len(ratios)}", format_factor(ratios.median()) if len(ratios) else "–"]
        lines.append((str(axis), *cells))
    if lines:
        page.table(("axis", *heads), lines, right=(1, 2, 3, 4))
        ratio_note = "σ ratio: median of actual σ / reported σ (above 1: overconfident)"
        page.write(ratio_note, colour=MUTED_COLOUR)
    finding_ids = logs["findings"].str.split(FINDING_SEPARATOR).explode()
    for finding, count in finding_ids[finding_ids != ""].value_counts().head(MAX_SHOWN).items():
        page.write(f"{count} × {finding_title(str(finding))}")
    counts = logs["status"].value_counts()
    status_counts = ", ".join(f"{count} {status}" for status, count in counts.items())
    again = " Run the same command to repeat failed logs." if FAILED in counts else ""
    page.write(
        f"{len(logs)} logs: {status_counts}; {fleet.reused} reused from an earlier run.{again}"
    )
    return page


def differences(results: ChangeResults) -> Page:
    """Format settings, numbers and findings that differ, and verdicts that are worse in B."""
    page = Page()
    for name, side in (("A", results.a), ("B", results.b)):
        log = side.kind if side.given == side.log else f"{side.kind} of {side.log}"
        versions = f"SHA-256 {side.log_sha256[:12]}, px4fuse {side.px4fuse}"
        page.write_labelled(name, f"{side.given} ({log}), {versions}")
    if results.settings:
        settings = [
            (setting.name, _plain(setting.a), _plain(setting.b)) for setting in results.settings
        ]
        page.table(("setting", "A", "B"), settings)
    rows = []
    for number in results.numbers:
        factor, unit = (100.0, "%") if number.unit == "share" else (1.0, number.unit)
        cells = [
            cell
            for value, interval in ((number.a, number.a_interval), (number.b, number.b_interval))
            for cell in (_value(value, factor), _range(interval))
        ]
        rows.append((number.label, *cells, unit))
    if rows:
        page.table(NUMBER_HEADS, rows, right=(1, 2, 3, 4))
    least = f"{100.0 * RELATIVE_TOLERANCE:g} % or {ABSOLUTE_TOLERANCE:g}"
    page.write(f"Numbers that differ by less than {least} are not listed.", colour=MUTED_COLOUR)
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


def _plain(value: float | str | None) -> str:
    if value is None:
        return "–"
    return value if isinstance(value, str) else f"{value:.6g}"


def _value(value: float | None, factor: float) -> str:
    return "" if value is None else format_number(factor * value)


def _range(interval: Interval | None) -> str:
    if interval is None:
        return ""
    low, high = interval
    return (
        f"above {format_number(low)}"
        if high is None
        else f"{format_number(low)} to {format_number(high)}"
    )
