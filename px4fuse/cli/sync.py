"""``px4fuse sync``: the clock offset between position source and IMU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from px4fuse.cli.inputs import (
    analysis_options,
    command_line,
    progress,
    run_comparison,
    write_outputs,
)


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@analysis_options
@click.option(
    "--json",
    "json_path",
    type=click.Path(path_type=Path),
    default=None,
    metavar="FILE",
    help="Write it as JSON; - prints that alone on standard output.",
)
def sync(log: Path, json_path: Path | None, **analysis: Any) -> None:
    """Estimate what must be added to the position source's time stamps, with its interval.

    From the acceleration that the IMU felt; EKF2 and its attitude are not asked. LOG is a PX4 ULog
    or a MAVLink recording.
    """
    from px4fuse.explanation import clock_offset, tuned_horizontally
    from px4fuse.report.results import sync_results, to_json
    from px4fuse.report.words import clock_advice

    with progress(json_path == Path("-")) as step:
        compared = tuned_horizontally(run_comparison(log, step, **analysis))
        found = clock_offset(compared, step)
    text = to_json(sync_results(compared, found, command_line("sync", log)))
    if json_path == Path("-"):
        click.echo(text, nl=False)
        return
    if json_path is not None:
        write_outputs({json_path: text.encode()})
    for line in clock_advice(compared, found):
        click.echo(line)
