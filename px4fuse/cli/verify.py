"""``px4fuse verify``: whether a report is what its log gives."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from px4fuse.cli.inputs import json_option, max_size_option
from px4fuse.cli.outputs import (
    progress,
    spare_inputs,
    terminal,
    write_json,
)
from px4fuse.errors import LogError
from px4fuse.reading import files_by_sha256, read_whole, shown
from px4fuse.writing import STANDARD_OUTPUT

if TYPE_CHECKING:
    from rich.console import Console

    from px4fuse.verification.model import Report, Verdict

SCHEMA = {"name": "px4fuse-verification", "version": "1.0"}
STYLES = {"verified": "bold green", "cannot verify": "bold yellow"}


@click.command()
@click.argument("report", type=click.Path(path_type=Path), metavar="REPORT.pdf")
@click.argument("logs", type=click.Path(path_type=Path), nargs=-1, metavar="[LOG ...]")
@max_size_option
@json_option
def verify(report: Path, logs: tuple[Path, ...], json_path: Path | None) -> None:
    """Check that REPORT.pdf is what its log gives: every number, and every page.

    LOG is the flight log and whatever was read besides it, or folders of such; they are found by
    their SHA-256. The analysis is run again with the recorded settings. Without LOG only the pages
    are compared with the attached results, and nothing is verified.

    This proves that the numbers belong to the log, not who wrote them.

    Exit code 0: verified; 1: numbers differ, page altered, other log, or cannot verify; 2: bad
    input.
    """
    from px4fuse.verification.intake import MAX_BYTES, read_report
    from px4fuse.verification.model import Refused
    from px4fuse.verification.verification import verify as verify_report

    content = read_whole(report, LogError, MAX_BYTES, smaller="Reports are below 2 MB")
    read = read_report(content, shown(report))
    if isinstance(read, Refused):
        raise LogError(read.reason)
    if json_path not in (None, STANDARD_OUTPUT):
        spare_inputs([json_path])
    with progress(json_path == STANDARD_OUTPUT) as step:
        step("hashing the logs")
        files = files_by_sha256(logs)
        if logs and not files:
            raise LogError("there is no file in what was given as LOG.")
        step("running the analysis again" if files else "comparing pages and results")
        verdict = verify_report(read, files)
    if not write_json(_plain(read, verdict), json_path):
        _print(terminal(), shown(report), verdict)
    sys.exit(0 if verdict.status == "verified" else 1)


def _plain(report: Report, verdict: Verdict) -> dict[str, object]:
    from px4fuse.verification.verification import LIMIT

    return {
        "schema": SCHEMA,
        "report_sha256": report.sha256,
        "seal": report.seal,
        **asdict(verdict),
        "limit": LIMIT,
    }


def _print(console: Console, name: str, verdict: Verdict) -> None:
    from rich.text import Text

    from px4fuse.results.reading import one_line
    from px4fuse.verification.verification import LIMIT

    style = STYLES.get(verdict.status, "bold red")
    console.print(Text.assemble(f"{one_line(name, 200)}: ", (verdict.status, style)))
    for reason in verdict.reasons:
        if reason != LIMIT:
            console.print(Text(f"  {one_line(reason, 400)}"), soft_wrap=True)
    for one in verdict.differences:
        console.print(
            Text(f"  {one.path}: {one.recorded}, recomputed {one.recomputed}"), soft_wrap=True
        )
    if verdict.pages:
        console.print(Text(f"  Pages: {', '.join(map(str, verdict.pages))}"))
    console.print(Text(LIMIT), style="dim", soft_wrap=True)
