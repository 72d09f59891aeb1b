"""Terminal output of ``px4fuse batch`` and ``px4fuse diff``."""

from px4fuse.core.text import capitalise_first_letter, format_count, format_number, format_ratio
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.report.card_text import SEVERITY_SIGNS
from px4fuse.report.page import Cell, Page, styled_text
from px4fuse.report.style import MUTED_COLOUR, SEVERITY_COLOURS
from px4fuse.results.contract import ConfidenceInterval, DiffResults

from .changes import (
    MIN_DIFFERENCE_OF_LISTED_NUMBERS,
    MIN_RELATIVE_DIFFERENCE_OF_LISTED_NUMBERS,
)
from .page import SIGMA_RATIO_LABELS, LogSummary, summarise_logs
from .rows import STATUS_FAILED
from .run import BatchResult

MAX_LISTED_REASONS = 8
MAX_LISTED_LOGS = 40
RATIO_NOTE = "Ratio of actual to reported σ: ● innovation ÷ √S, ◆ error ÷ σ (ground truth)"
ERROR_COLOUR, WARNING_COLOUR = SEVERITY_COLOURS["error"], SEVERITY_COLOURS["warning"]


def format_summary(batch_result: BatchResult) -> Page:
    """Format diagnoses and σ ratios (actual ÷ reported σ), and reasons for missing results."""
    page, logs = Page(), batch_result.table.drop_duplicates("log")
    # a log without results has one row, with an empty axis
    logs_by_reason = sorted(
        logs[logs["axis"] == ""].groupby(["status", "reason", "remedy"], sort=False)["log"],
        key=lambda reason_and_logs: len(reason_and_logs[1]),
        reverse=True,
    )
    for (status, reason, remedy), failed_logs in logs_by_reason[:MAX_LISTED_REASONS]:
        text = f"{failed_logs.iloc[0]}: {status}: {reason}. {remedy}".rstrip()
        if len(failed_logs) > 1:
            text = f"{len(failed_logs)} logs without results, for example {text}"
        page.write(text, colour=ERROR_COLOUR if status == STATUS_FAILED else WARNING_COLOUR)
    if (unlisted_count := len(logs_by_reason) - MAX_LISTED_REASONS) > 0:
        page.write(f"fleet.html also lists {unlisted_count} other reasons for missing results.")
    sorted_logs = summarise_logs(batch_result.table)
    if sorted_logs:
        rows = [_make_log_row(log) for log in sorted_logs[:MAX_LISTED_LOGS]]
        page.add_table(
            ("", "log", "diagnosis", *SIGMA_RATIO_LABELS.values()),
            rows,
            right_aligned_columns=range(3, 3 + len(SIGMA_RATIO_LABELS)),
        )
        page.write_muted_text(RATIO_NOTE)
    if len(sorted_logs) > MAX_LISTED_LOGS:
        page.write(f"fleet.html lists {len(sorted_logs) - MAX_LISTED_LOGS} more logs.")
    counts = logs["status"].value_counts()
    counts_text = ", ".join(f"{count} {status}" for status, count in counts.items())
    retry_note = " Run the same command to repeat failed logs." if STATUS_FAILED in counts else ""
    page.write(
        f"{format_count(len(logs), 'log')}: {counts_text}. Results from an earlier run: "
        f"{format_count(batch_result.reused_count, 'log')}.{retry_note}"
    )
    return page


def _make_log_row(log: LogSummary) -> tuple[Cell, ...]:
    """Return the cells of a log: sign of the severity, name, diagnosis, and σ ratios."""
    colour = SEVERITY_COLOURS.get(log["severity"], MUTED_COLOUR)
    ratios = (log.get(f"{name}_ratio") for name in SIGMA_RATIO_LABELS)
    return (
        (SEVERITY_SIGNS[log["severity"]][0], colour),
        log["name"],
        log["headline"],
        *("–" if ratio is None else format_ratio(ratio) for ratio in ratios),
    )


def format_differences(results: DiffResults) -> Page:
    """Format the differences between two inputs A and B, for ``px4fuse diff``."""
    page = Page()
    for name, diff_input in (("A", results.a), ("B", results.b)):
        log_text = f" of {diff_input.log}" * (diff_input.given != diff_input.log)
        version_text = f"SHA-256 {diff_input.log_sha256[:12]}, px4fuse {diff_input.px4fuse}"
        page.write_labelled_text(
            name, f"{diff_input.given} ({diff_input.kind}{log_text}), {version_text}"
        )
    for text in results.worse:
        page.write_labelled_text("Worse", styled_text(text, ERROR_COLOUR))
    if not results.worse:
        page.write("B has no new finding of severity error and no new inconsistent filter.")
    for finding in results.findings:
        styled_message = styled_text(
            f"{finding.severity}: {finding.message}", SEVERITY_COLOURS[finding.severity]
        )
        page.write_labelled_text(f"Only in {finding.only_in}", styled_message)
    for setting in results.settings:
        a_text, b_text = map(_format_setting, (setting.a, setting.b))
        page.write(f"Changed setting: {setting.name}, A → B: {a_text} → {b_text}")
    # Numbers of the axis of largest motion. If there are any, the numbers of the other axes are not
    # printed: one axis is sufficient for a summary
    main_numbers = [number for number in results.numbers if f".{AISLE_AXIS}." in number.path]
    for number in results.numbers:
        if main_numbers and number not in main_numbers and number.path.startswith("axes."):
            continue
        a_text = _format_value(number.a, number.a_interval, number.unit)
        b_text = _format_value(number.b, number.b_interval, number.unit)
        label = capitalise_first_letter(number.label.replace(AISLE_AXIS, "axis of largest motion"))
        page.write(f"{label}, A → B: {a_text} → {b_text}")
    tolerance_text = (
        f"{100.0 * MIN_RELATIVE_DIFFERENCE_OF_LISTED_NUMBERS:g} % or "
        f"{MIN_DIFFERENCE_OF_LISTED_NUMBERS:g}"
    )
    page.write_muted_text(
        f"Differences between A and B below {tolerance_text} are not listed. --json FILE lists "
        "all axes."
    )
    return page


def _format_setting(value: float | str | None) -> str:
    return f"{value:.6g}" if isinstance(value, int | float) else value or "missing"


def _format_value(value: float | None, interval: ConfidenceInterval | None, unit: str) -> str:
    """Format a value with its unit and 95 % interval; "missing" for None."""
    if value is None:
        return "missing"
    if unit == "share":  # a fraction, such as that of rejected positions, has no interval
        return f"{format_number(100.0 * value)} %"
    text = f"{format_number(value)} {unit}".rstrip()
    if interval is None:
        return text
    low, high = interval
    high_text = "" if high is None else f" to {format_number(high)}"
    return f"{text} (95 % {'above ' * (high is None)}{format_number(low)}{high_text})"
