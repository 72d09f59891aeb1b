"""Terminal output of ``px4fuse batch`` and ``px4fuse diff``."""

from px4fuse.batch.changes import MAX_OMITTED_DIFFERENCE, MAX_OMITTED_RELATIVE_DIFFERENCE
from px4fuse.batch.page import SIGMA_RATIO_LABELS, LogSummary, sort_logs, summarise_logs
from px4fuse.batch.rows import STATUS_FAILED
from px4fuse.batch.run import BatchResult
from px4fuse.core.text import format_count, format_number, format_ratio
from px4fuse.report.card_text import SEVERITY_SIGNS
from px4fuse.report.page import Cell, Page, styled_text
from px4fuse.report.style import MUTED_COLOUR, SEVERITY_COLOURS
from px4fuse.results.contract import ChangeResults, ConfidenceInterval

MAX_LISTED_REASONS = 8
MAX_LISTED_LOGS = 40
RATIO_NOTE = "Ratio of actual to reported σ: ● innovation ÷ √S, ◆ error ÷ σ (ground truth)"
ERROR_COLOUR, WARNING_COLOUR = SEVERITY_COLOURS["error"], SEVERITY_COLOURS["warning"]
NUMBER_TABLE_TITLES = ("number", "A", "95 %", "B", "95 %", "unit")


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
    sorted_logs = sort_logs(summarise_logs(batch_result.table))
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
    colour = SEVERITY_COLOURS.get(log["severity"], MUTED_COLOUR)
    ratios = (log.get(f"{name}_ratio") for name in SIGMA_RATIO_LABELS)
    return (
        (SEVERITY_SIGNS[log["severity"]][0], colour),
        log["name"],
        log["headline"],
        *("–" if ratio is None else format_ratio(ratio) for ratio in ratios),
    )


def format_differences(results: ChangeResults) -> Page:
    """Format the differences between two inputs A and B, for ``px4fuse diff``."""
    page = Page()
    for name, diff_input in (("A", results.a), ("B", results.b)):
        log_text = f" of {diff_input.log}" * (diff_input.given != diff_input.log)
        version_text = f"SHA-256 {diff_input.log_sha256[:12]}, px4fuse {diff_input.px4fuse}"
        page.write_labelled(
            name, f"{diff_input.given} ({diff_input.kind}{log_text}), {version_text}"
        )
    settings = [
        (setting.name, _format_setting(setting.a), _format_setting(setting.b))
        for setting in results.settings
    ]
    if settings:
        page.add_table(("setting", "A", "B"), settings)
    rows = []
    for number in results.numbers:
        display_factor, unit = (100.0, "%") if number.unit == "share" else (1.0, number.unit)
        rows.append(
            (
                number.label,
                _format_value(number.a, display_factor),
                _format_interval(number.a_interval),
                _format_value(number.b, display_factor),
                _format_interval(number.b_interval),
                unit,
            )
        )
    if rows:
        page.add_table(NUMBER_TABLE_TITLES, rows, right_aligned_columns=(1, 2, 3, 4))
    tolerance_text = f"{100.0 * MAX_OMITTED_RELATIVE_DIFFERENCE:g} % or {MAX_OMITTED_DIFFERENCE:g}"
    page.write_muted_text(f"Numbers that differ by less than {tolerance_text} are not listed.")
    for finding in results.findings:
        styled_message = styled_text(
            f"{finding.severity}: {finding.message}", SEVERITY_COLOURS[finding.severity]
        )
        page.write_labelled(f"Only {finding.only_in}", styled_message)
    for text in results.worse:
        page.write_labelled("Worse", styled_text(text, ERROR_COLOUR))
    if not results.worse:
        page.write("B contains no inconsistent filter and no error that A does not contain.")
    return page


def _format_setting(value: float | str | None) -> str:
    return f"{value:.6g}" if isinstance(value, int | float) else value or "–"


def _format_value(value: float | None, factor: float) -> str:
    return "" if value is None else format_number(factor * value)


def _format_interval(interval: ConfidenceInterval | None) -> str:
    if interval is None:
        return ""
    low, high = interval
    low_text = format_number(low)
    return f"above {low_text}" if high is None else f"{low_text} to {format_number(high)}"
