"""Command ``px4fuse batch``: compares many logs and writes one table."""

import gc
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click

from px4fuse.cli import options, outputs
from px4fuse.cli.compare import SEVERITIES, Severity
from px4fuse.errors import SettingsError

FAILED_STATUS = "failed"


@click.command()
@click.argument("logs", nargs=-1, metavar="LOGS...")
@options.output_option(
    "DIR", "Output folder for the table and the results of each log.", required=True
)
@click.option("--reports", is_flag=True, help="Also write a PDF report for each log.")
@options.timeout_option
@click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Number of logs that this computer processes in parallel.  [default: number of cores]",
)
@options.memory_option
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Address of a running Dask scheduler (tcp://host:8786) whose cluster processes the logs.  "
    "[default: this computer]",
)
@options.settings_options
@options.fail_option(
    (FAILED_STATUS, *SEVERITIES),
    "Exit with code 1 if a log failed or has a finding of at least this severity.",
)
@options.open_option
def batch(
    logs: tuple[str, ...],
    *,
    output: Path,
    scheduler: str | None,
    fail_on: Literal["failed", Severity] | None,
    **option_values: Any,
) -> None:
    """Compare KF and EKF2 on many logs and write one table.

    LOGS are files, folders, globs and URLs (s3://, gs://, https://, sftp://). Writes
    fleet.html, fleet.csv, fleet.parquet and the results of each log to DIR. A second run processes
    only new and failed logs. After Ctrl-C the results of finished logs are kept.
    """
    if scheduler is not None and option_values["workers"] is not None:
        raise SettingsError("--workers applies to this computer. Omit --workers with --scheduler.")
    from px4fuse.batch.run import run
    from px4fuse.batch.terminal import format_summary

    gc.enable()  # Dask leaves reference cycles, which would fill the memory in a long run
    try:
        with outputs.progress() as show_progress:
            fleet = run(
                logs,
                output,
                scheduler=scheduler,
                progress=partial(_show_rate, show_progress, time.monotonic()),
                **option_values,
            )
    except KeyboardInterrupt as interrupt:
        message = "no log was finished, and nothing was written."
        if (output / "rows").is_dir():
            message = f"results of finished logs are in {output}. Run the same command to continue."
        raise outputs.Interrupted(interrupt, message) from None
    outputs.write_and_print({}, format_summary(fleet), written_files=fleet.written)
    severities = SEVERITIES[: SEVERITIES.index(fail_on) + 1] if fail_on in SEVERITIES else ()
    has_failed = fail_on is not None and bool((fleet.table["status"] == FAILED_STATUS).any())
    if has_failed or fleet.severities & set(severities):
        sys.exit(1)


def _show_rate(
    show_progress: outputs.ShowProgress,
    start_s: float,
    activity: str,
    done_count: int,
    total_count: int,
) -> None:
    per_minute = 60.0 * done_count / (time.monotonic() - start_s)
    text = f"{activity}, {per_minute:.3g} logs per minute" if done_count else activity
    show_progress(text, done_count, total_count)
