"""``px4fuse verify``: whether a report's numbers are what its log gives, and the report redrawn."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from px4fuse.cli.inputs import InputPath, max_size_option, open_option, report_options
from px4fuse.cli.outputs import check_targets, progress, result_files, write_and_print
from px4fuse.errors import LogError
from px4fuse.reading import display_name, files_by_sha256, read_bytes_limited

if TYPE_CHECKING:
    from px4fuse.report.page import Page
    from px4fuse.verification.model import Verdict

SCHEMA = {"name": "px4fuse-verification", "version": "3.0"}
# A flight of ten minutes takes about one; what takes longer than this was made to
TIMEOUT_S = 1800.0


@click.command()
@click.argument("report", type=InputPath(), metavar="REPORT.pdf")
@click.argument("logs", type=InputPath(), nargs=-1, metavar="[LOG ...]")
@max_size_option
@report_options("Write the report, drawn again from the log.")
@open_option
def verify(
    report: Path, logs: tuple[Path, ...], output: Path | None, json_path: Path | None
) -> None:
    """Check that the numbers of REPORT.pdf are what its log gives, and draw the report again.

    LOG is the flight log and whatever was read besides it, or folders of such; they are found by
    their SHA-256. The analysis is run again with the recorded settings. REPORT.pdf is compared
    with the redrawn report part by part; differences are listed: read the redrawn report (-o).
    Without LOG nothing is verified.

    This proves that the numbers belong to the log, not who wrote them.

    Exit code 0: verified; 1: numbers differ, page differs, other log, or cannot verify; 2: bad
    input.
    """
    from px4fuse.verification.intake import MAX_BYTES, read_report
    from px4fuse.verification.verification import verify as verify_report
    from px4fuse.workers import JobFailure, run_one_bounded

    content = read_bytes_limited(report, LogError, MAX_BYTES, size_remedy="Reports are below 2 MB")
    read = read_report(content, display_name(report))
    with progress(json_path) as step:
        step("hashing the logs")
        files = files_by_sha256(logs)
        check_targets([json_path, output])
        if logs and not files:
            raise LogError("there is no file in what was given as LOG.")
        step("running the analysis again")
        verdict = run_one_bounded(partial(verify_report, pdf=content, logs=files), read, TIMEOUT_S)
    if isinstance(verdict, JobFailure):
        raise LogError(f"{display_name(report)}: cannot be verified: {verdict.reason}")
    redrawn = {} if output is None or not verdict.redrawn else {output: verdict.redrawn}
    contents = redrawn | result_files(_verdict_data(content, verdict), json_path)
    write_and_print(contents, _page(display_name(report), verdict, output))
    sys.exit(0 if verdict.outcome == "verified" else 1)


def _verdict_data(pdf: bytes, verdict: Verdict) -> dict[str, object]:
    from px4fuse.verification.verification import LIMIT

    values = asdict(verdict)
    for name in ("redrawn", "remedy", "missing"):  # which are for whoever grades a class
        del values[name]
    return {
        "schema": SCHEMA,
        "report_sha256": hashlib.sha256(pdf).hexdigest(),
        "outcome": verdict.outcome,
        **values,
        "limit": LIMIT,
    }


def _page(name: str, verdict: Verdict, output: Path | None) -> Page:
    from px4fuse.report.page import Page
    from px4fuse.report.style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS
    from px4fuse.results.reading import one_line
    from px4fuse.verification.verification import LIMIT

    page = Page()
    colours = {"verified": GOOD_COLOUR, "cannot verify": SEVERITY_COLOURS["warning"]}
    colour = colours.get(verdict.outcome, SEVERITY_COLOURS["error"])
    page.write(f"{one_line(name, 200)}: {verdict.outcome}", bold=True, colour=colour)
    sentences = [one_line(reason, 400) for reason in verdict.reasons if reason != LIMIT]
    sentences += [f"{d.path}: {d.recorded}, recomputed {d.recomputed}" for d in verdict.differences]
    for text in sentences:
        page.write(text, indent=12.0)
    if output is not None and not verdict.redrawn:
        page.write("Nothing was redrawn, since the analysis was not run again.")
    elif output is None and verdict.pages:
        page.write("Read the redrawn report instead: -o writes it.")
    page.write(LIMIT, colour=MUTED_COLOUR)
    return page
