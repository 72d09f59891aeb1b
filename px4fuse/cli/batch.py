"""``px4fuse batch``: many logs become one table."""

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
# How a cluster of each kind is started, for people who have one: beside this file, as NAME.txt
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
    """Compare many logs, as px4fuse compare does each, into one table.

    LOGS are files, folders, globs and URLs (s3://, gs://, https://, sftp://). Writes
    fleet.html, fleet.csv, fleet.parquet and every log's results into DIR. A second run does only
    what is new, and tries again what has failed; Ctrl-C keeps what is done.
    """
    if scheduler in CLUSTERS:
        click.echo(files("px4fuse.cli").joinpath(f"{scheduler}.txt").read_text("utf-8"), nl=False)
        return
    if output is None:
        raise SettingsError("say with -o which folder the table goes to.")
    if output.exists() and not output.is_dir():
        raise OutputError(f"-o {output}: is not a folder. Give another place.")
    if scheduler is not None and workers is not None:
        raise SettingsError("--workers is for this computer, and --scheduler for a cluster.")
    from px4fuse.fleet.run import run
    from px4fuse.fleet.terminal import summary

    gc.enable()  # a long run, of a library that leaves circles
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
        message = f"what is done is kept in {output}. The same command goes on from there."
        raise outputs.Interrupted(stopped, message) from None
    outputs.write_and_print({}, summary(fleet), written=fleet.written)
    severities = SEVERITIES[: SEVERITIES.index(fail_on) + 1] if fail_on in SEVERITIES else ()
    failed = fail_on is not None and bool((fleet.table["status"] == FAILED).any())
    if failed or fleet.severities & set(severities):
        sys.exit(1)


def _show_rate(step: outputs.ShowStep, since_s: float, what: str, done: int, of: int) -> None:
    """How far it is, with its rate."""
    per_minute = 60.0 * done / (time.monotonic() - since_s)
    step(f"{what}, {per_minute:.3g} per minute" if done else what, done, of)
