"""``px4fuse diff``: what changed between two flights, or two settings of one."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from px4fuse.cli.inputs import Named, json_option, max_size_option, open_option, path_option
from px4fuse.cli.outputs import finish, free_report, progress, report_paths, result_files
from px4fuse.writing import STANDARD_OUTPUT


@click.command()
@click.argument("a", type=Named())
@click.argument("b", type=Named())
@max_size_option
@path_option(
    "-o", "--output", metavar="FILE.pdf", help="The report.  [default: reports/A_to_B.pdf]"
)
@json_option
@click.option(
    "--fail-on",
    type=click.Choice(["worse"]),
    help="Exit with 1 if a number is significantly worse in B, or B has a new error.",
)
@open_option
def diff(
    a: Path, b: Path, output: Path | None, json_path: Path | None, fail_on: str | None
) -> None:
    """Say what changed from A to B, number by number, significant changes first.

    A and B are each a flight log, a report that px4fuse compare wrote, or its results (JSON). Two
    reports of one log show what other settings change. For example, px4fuse diff monday.ulg
    tuesday.ulg --fail-on worse ends with exit code 1 where a number is worse by more than chance.
    Writes a PDF report and its results as JSON.
    """
    from px4fuse.fleet.changes import diff as compared
    from px4fuse.report.changes import print_changes

    alone = json_path == STANDARD_OUTPUT
    report_paths(output or Path("reports/LOG.pdf"), json_path)  # before the work, not after it
    with progress(alone) as step:
        found = compared(a, b, progress=step)
        results = found.results
        if output is None and not alone:
            output = free_report(f"{a.stem}_to_{b.stem}", "", results)
        contents = result_files(results, json_path, output, results, step)
    finish(contents, lambda console: print_changes(console, results))
    if fail_on is not None and found.is_worse:
        sys.exit(1)
