"""Command ``px4fuse batch``: compares many logs and writes one table."""

import gc
from pathlib import Path
from typing import Any, Literal

import click

from px4fuse.errors import SettingsError
from px4fuse.finding import SEVERITIES, Severity

from . import options, outputs

FAIL_ON_LEVELS = ("failed", *SEVERITIES)


@click.command()
@click.argument("logs", nargs=-1, metavar="LOGS...")
@options.output_option("DIR", "Output folder.", required=True)
@options.flag_option("--reports", help="Also write a PDF report for each log.")
@options.timeout_option
@options.count_option(
    "--workers",
    1,
    1024,
    help="Number of parallel processes on this computer.  [default: number of cores]",
)
@options.memory_option
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Address of the Dask scheduler of a cluster (tcp://host:8786).  [default: this computer]",
)
@options.settings_options
@options.make_fail_on_option(
    FAIL_ON_LEVELS, "Exit with code 1 if a log failed or has a finding of at least this severity."
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
    only new and failed logs. After Ctrl-C the results so far are kept.
    """
    if scheduler is not None and option_values["workers"] is not None:
        raise SettingsError("--workers applies to this computer. Omit --workers with --scheduler.")
    from px4fuse.batch.run import run
    from px4fuse.batch.terminal import format_summary

    gc.enable()  # otherwise the reference cycles of Dask fill the memory in a long run
    with outputs.folder_progress(output) as show_progress:
        batch_result = run(
            logs, output, scheduler=scheduler, progress=show_progress, **option_values
        )
    outputs.write_and_print_results(
        {}, format_summary(batch_result), written_files=batch_result.written_paths
    )
    options.exit_if_severity_reached(
        fail_on, FAIL_ON_LEVELS, {*batch_result.severities, *batch_result.table["status"]}
    )
