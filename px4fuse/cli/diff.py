"""``px4fuse diff``: what changed between two flights, or two settings of one."""

import sys
from pathlib import Path
from typing import Literal

import click

from px4fuse.cli import inputs, outputs
from px4fuse.writing import STANDARD_OUTPUT


@click.command()
@click.argument("a", type=inputs.InputPath())
@click.argument("b", type=inputs.InputPath())
@inputs.max_size_option
@inputs.report_options("The report.  [default: reports/A_to_B.pdf]")
@inputs.options("diff")
@inputs.open_option
def diff(
    a: Path,
    b: Path,
    output: Path | None,
    json_path: Path | None,
    fail_on: Literal["worse"] | None,
) -> None:
    """Say what changed from A to B, number by number, significant changes first.

    A and B are each a flight log, a report that px4fuse compare wrote, or its results (JSON). Two
    reports of one log show what other settings change. For example, px4fuse diff monday.ulg
    tuesday.ulg --fail-on worse ends with exit code 1 where a number is worse by more than chance.
    Writes a PDF report and its results as JSON.
    """
    from px4fuse.fleet.changes import diff as compared
    from px4fuse.report.changes import summary

    outputs.report_paths(output, json_path)  # before the work, not after it
    with outputs.progress(json_path) as step:
        results = compared(a, b, progress=step)
        if output is None and json_path != STANDARD_OUTPUT:
            output = outputs.default_report(f"{a.stem}_to_{b.stem}", "", results)
        contents = outputs.result_files(results, json_path, output, results, step)
    outputs.finish(contents, summary(results))
    if fail_on is not None and results.is_worse:
        sys.exit(1)
