"""``px4fuse batch``: compares many logs and writes one table."""

import gc
import sys
import time
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import click

from px4fuse.cli import inputs, outputs
from px4fuse.cli.compare import SEVERITIES, Severity
from px4fuse.errors import OutputError, SettingsError
from px4fuse.fleet import TIMEOUT_S

FAILED = "failed"
# For --scheduler NAME, batch prints NAME.txt of this folder: how to start such a cluster
CLUSTERS = ("slurm", "kubernetes")


@click.command()
@click.argument("logs", nargs=-1, metavar="LOGS...")
@inputs.options("batch")
@inputs.settings_options
@inputs.options("batch-ends")
@inputs.open_option
def batch(
    logs: tuple[str, ...],
    *,
    output: Path | None,
    reports: bool,
    timeout: float = TIMEOUT_S,
    workers: int | None,
    memory: float = 4.0,
    scheduler: str | None,
    fail_on: Literal["failed", Severity] | None,
    **option_values: Any,
) -> None:
    """Run compare on many logs and collect one table.

    LOGS are files, folders, globs and URLs (s3://, gs://, https://, sftp://). Writes
    fleet.html, fleet.csv, fleet.parquet and the results of each log to DIR. A second run processes
    only new and failed logs. Ctrl-C keeps finished results.
    """
    if scheduler in CLUSTERS:
        click.echo(files("px4fuse.cli").joinpath(f"{scheduler}.txt").read_text("utf-8"), nl=False)
        return
    if output is None:
        raise SettingsError("batch requires an output folder: -o DIR.")
    if output.exists() and not output.is_dir():
        raise OutputError(f"-o {output} is not a folder. Choose another name.")
    if scheduler is not None and workers is not None:
        raise SettingsError("--workers applies to this computer. Omit it with --scheduler.")
    from px4fuse.fleet.run import run
    from px4fuse.fleet.terminal import format_summary

    gc.enable()  # the run is long, and Dask leaves reference cycles
    try:
        with outputs.progress() as step:
            fleet = run(
                logs,
                output,
                reports=reports,
                timeout_s=timeout,
                scheduler=scheduler,
                workers=workers,
                memory_gb=memory,
                progress=partial(_show_rate, step, time.monotonic()),
                **option_values,
            )
    except KeyboardInterrupt as stopped:
        message = f"finished results are in {output}. Run the same command to continue."
        raise outputs.Interrupted(stopped, message) from None
    outputs.write_and_print({}, format_summary(fleet), written=fleet.written)
    severities = SEVERITIES[: SEVERITIES.index(fail_on) + 1] if fail_on in SEVERITIES else ()
    failed = fail_on is not None and bool((fleet.table["status"] == FAILED).any())
    if failed or fleet.severities & set(severities):
        sys.exit(1)


def _show_rate(
    step: outputs.ShowStep, start_s: float, activity: str, done_count: int, total_count: int
) -> None:
    """Show the progress with the number of logs per minute; ``start_s`` is monotonic time."""
    per_minute = 60.0 * done_count / (time.monotonic() - start_s)
    text = f"{activity}, {per_minute:.3g} per minute" if done_count else activity
    step(text, done_count, total_count)
