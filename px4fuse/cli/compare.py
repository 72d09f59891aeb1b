"""Command ``px4fuse compare``: checks EKF2 against the two-state Kalman filter."""

import sys
from pathlib import Path
from typing import Any

import click

from px4fuse.core.writing import STANDARD_OUTPUT
from px4fuse.errors import LogError, MissingDataError
from px4fuse.finding import SEVERITIES, Severity
from px4fuse.request import format_settings_suffix

from . import options, outputs


@click.command()
@options.log_argument
@options.analysis_options
@options.student_options
@options.report_options(
    "Report to write (PDF).  [default: reports/LOG.pdf; changed settings are added to the name]"
)
@options.make_fail_on_option(SEVERITIES, "Exit with code 1 on a finding of at least this severity.")
@options.flag_option(
    "--checks",
    help="Exit with code 1 if an EKF2 aiding source is overconfident, biased or not fused for a "
    "long time.",
)
@options.flag_option("-v", "--verbose", help="Print all findings, axes and KF settings.")
@options.flag_option("-q", "--quiet", help="Print the diagnosis on one line only.")
@options.open_option
def compare(
    log: Path,
    output: Path | None,
    json_path: Path | None,
    fail_on: Severity | None,
    checks: bool,
    verbose: bool,
    quiet: bool,
    **option_values: Any,
) -> None:
    """Check EKF2 against a two-state Kalman filter and report faults.

    LOG is a PX4 ULog or a MAVLink recording (.tlog or raw stream). Runs a two-state Kalman filter
    (KF) on the IMU and position data, and compares its innovations and variances with EKF2. Lists
    faults and their corrections. Writes a PDF report and the results as JSON, for example
    reports/LOG_sigma-z-0.05.pdf and .json.
    """
    from px4fuse.analysis import find_failed_checks
    from px4fuse.card.build import build_unusable_log_card
    from px4fuse.core.memory import release_free_memory
    from px4fuse.diagnose import diagnose_or_check_aids
    from px4fuse.report.card_text import format_card_lines, format_closing_lines
    from px4fuse.report.terminal import make_card_page, make_comparison_page
    from px4fuse.results.build import make_comparison_or_aids_results

    student = options.read_student(option_values, log)
    request = options.comparison_request(log, option_values)
    # report an invalid path before the long analysis
    outputs.choose_report_paths(output, json_path)
    try:
        with outputs.progress(json_path) as show_progress:
            outcome = diagnose_or_check_aids(request, show_progress)
            results = make_comparison_or_aids_results(request, outcome, student)
            # keep the peak memory low: the next step imports the report modules
            release_free_memory()
            contents = outputs.make_result_files(
                results,
                json_path,
                output,
                outcome,
                show_progress,
                log.stem + format_settings_suffix(request),
            )
    except (LogError, MissingDataError) as error:
        if not sys.stderr.isatty():  # a program reads the error: one line, no diagnosis card
            raise
        card = build_unusable_log_card(error, log)
        outputs.show_page(make_card_page(format_card_lines(card)), uses_stderr=True)
        sys.exit(2)
    page = make_comparison_page(outcome, results, request.log, verbose=verbose, quiet=quiet)
    outputs.write_and_print_results(contents, page, request)
    if not quiet and STANDARD_OUTPUT not in contents:
        outputs.show_page(make_card_page(format_closing_lines(results.card, verbose=verbose)))
    failed_verdicts = find_failed_checks(outcome) if checks else {}
    for name, verdict in failed_verdicts.items():
        click.echo(f"{name}: {verdict.replace('_', ' ')}", err=True)
    if failed_verdicts:
        sys.exit(1)
    independent_findings = [finding for finding in results.findings if finding.caused_by is None]
    options.exit_if_severity_reached(
        fail_on, SEVERITIES, {finding.severity for finding in independent_findings}
    )
