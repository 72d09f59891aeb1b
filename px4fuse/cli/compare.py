"""``px4fuse compare``: the main job."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from px4fuse.cli.inputs import (
    Named,
    analysis_options,
    comparison_request,
    person_options,
    read_person,
    report_options,
)
from px4fuse.cli.outputs import (
    default_report,
    progress,
    report_paths,
    terminal,
    write_outputs,
)
from px4fuse.writing import STANDARD_OUTPUT

STEPS = (
    "reading", "filtering", "tuning", "clock offset", "changes of the clock", "replaying EKF2",
    "heading", "looking for a loop", "drawing",
)  # fmt: skip
SEVERITIES = ("error", "warning", "info")


@click.command()
@click.argument("log", type=Named())
@analysis_options
@person_options
@report_options
@click.option(
    "--fail-on",
    type=click.Choice(SEVERITIES),
    default=None,
    help="Exit with 1 if there is a finding of at least this severity.",
)
def compare(
    log: Path,
    output: Path | None,
    json_path: Path | None,
    fail_on: str | None,
    **given: Any,
) -> None:
    """Compare a flight's EKF2 with a two-state Kalman filter over IMU and position.

    LOG is a PX4 ULog or a MAVLink recording (.tlog or raw stream). Writes a PDF report and its
    results as JSON, for example reports/LOG_sigma-z-0.05.pdf and .json.
    """
    from px4fuse.analysis import run
    from px4fuse.findings import find
    from px4fuse.report.document import Document
    from px4fuse.report.pdf import render
    from px4fuse.request import command_line
    from px4fuse.results.build import results
    from px4fuse.results.contract import to_json

    person = read_person(given)
    request = comparison_request(log, given)
    alone = json_path == STANDARD_OUTPUT
    report_paths(output or Path("reports/LOG.pdf"), json_path)  # before the work, not after it
    contents: dict[Path, bytes] = {}
    target = None
    with progress(alone, STEPS) as step:
        analysis = run(request, step)
        document = Document(analysis, find(analysis), person, command_line(request))
        found = results(request, analysis, document.findings, person, document.command)
        text = to_json(found)
        if output is not None or not alone:
            step("drawing the report")
            target, beside = report_paths(output or default_report(request, found), json_path)
            contents |= {target: render(document, text), beside: text.encode()}
    if alone:
        contents[STANDARD_OUTPUT] = text.encode()
    write_outputs(contents)
    if not alone:
        from px4fuse.report.terminal import print_summary

        print_summary(terminal(), document, request, target)
    if fail_on is not None:
        worst = SEVERITIES[: SEVERITIES.index(fail_on) + 1]
        if any(one.severity in worst and one.caused_by is None for one in document.findings):
            sys.exit(1)
