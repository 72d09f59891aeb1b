"""``px4fuse diff``: what changed between two flights, or two settings of one."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from px4fuse.cli.inputs import Named, max_size_option, path_option, results_option
from px4fuse.cli.outputs import free_report, progress, report_paths, terminal, write_outputs
from px4fuse.writing import STANDARD_OUTPUT

if TYPE_CHECKING:
    from px4fuse.results.contract import ChangeResults

STEPS = (
    "reading", "filtering", "tuning", "clock offset", "replaying EKF2", "heading",
    "looking for a loop", "comparing", "drawing",
)  # fmt: skip
# Of each of the two names in the default name of the report: with both it stays below 255
MAX_NAME_BYTES = 90


@click.command()
@click.argument("a", type=Named())
@click.argument("b", type=Named())
@max_size_option
@path_option(
    "-o", "--output", metavar="FILE.pdf", help="The report.  [default: reports/A_to_B.pdf]"
)
@results_option
@click.option(
    "--fail-on",
    type=click.Choice(["worse"]),
    help="Exit with 1 if a number is significantly worse in B, or B has a new error.",
)
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
    from px4fuse.report.document import ChangesDocument
    from px4fuse.results.contract import to_json

    alone = json_path == STANDARD_OUTPUT
    report_paths(output or Path("reports/LOG.pdf"), json_path)  # before the work, not after it
    contents: dict[Path, bytes] = {}
    target = None
    with progress(alone, STEPS) as step:
        found = compared(a, b, progress=step)
        text = to_json(found.results)
        if output is not None or not alone:
            from px4fuse.report.pdf import render

            step("drawing the report")
            target, beside = report_paths(output or _default(a, b, found.results), json_path)
            document = ChangesDocument(found.results, found.a.analysis, found.b.analysis)
            contents |= {target: render(document, text), beside: text.encode()}
    if alone:
        contents[STANDARD_OUTPUT] = text.encode()
    write_outputs(contents)
    if not alone:
        print_changes(terminal(), found.results, target)
    if fail_on is not None and found.is_worse:
        sys.exit(1)


def _default(a: Path, b: Path, mine: ChangeResults) -> Path:
    """Where a report goes that was given no name: an earlier one of the same two is replaced."""
    from px4fuse.results.contract import ChangeResults, Results

    def is_same(old: Results) -> bool:
        return isinstance(old, ChangeResults) and [
            (side.given, side.log_sha256) for side in (old.a, old.b)
        ] == [(side.given, side.log_sha256) for side in (mine.a, mine.b)]

    first, second = (
        os.fsencode(path.stem)[:MAX_NAME_BYTES].decode(errors="ignore") for path in (a, b)
    )
    return free_report(f"{first}_to_{second}", "", is_same)
