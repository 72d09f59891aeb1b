"""``px4fuse compare``: the main job."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from px4fuse.cli.inputs import (
    STANDARD_OUTPUT,
    analysis_options,
    command_line,
    encodable,
    path_option,
    progress,
    report_options,
    report_paths,
    run_comparison,
    terminal,
    write_outputs,
)
from px4fuse.errors import SettingsError

SEVERITIES = ("error", "warning", "info")
MAX_NOTES_BYTES = 200_000


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@analysis_options
@click.option("--student", default="", metavar="NAME", help="Name on the report.")
@click.option("--id", "student_id", default="", metavar="ID", help="Student number on the report.")
@path_option("--notes", metavar="FILE.md", help="Your own words, printed in the report.")
@report_options
@click.option(
    "--fail-on",
    type=click.Choice(SEVERITIES),
    default=None,
    help="Exit with 1 if there is a finding of at least this severity.",
)
def compare(
    log: Path,
    student: str,
    student_id: str,
    notes: Path | None,
    output: Path | None,
    json_path: Path | None,
    fail_on: str | None,
    **analysis: Any,
) -> None:
    """Compare a flight's EKF2 with a two-state Kalman filter over IMU and position.

    LOG is a PX4 ULog or a MAVLink recording (.tlog or raw stream). Writes a PDF report and its
    results as JSON.
    """
    from px4fuse.explanation import explain
    from px4fuse.findings import find
    from px4fuse.report.document import Document, Student
    from px4fuse.report.pdf import render
    from px4fuse.report.results import results, to_json

    person = Student(encodable(student), encodable(student_id), _read_notes(notes))
    target, beside = report_paths(output or Path("reports") / f"{log.stem}.pdf", json_path)
    with progress(json_path == STANDARD_OUTPUT) as step:
        compared = explain(run_comparison(log, step, **analysis), step)
        document = Document(compared, find(compared), person, command_line("compare", log))
        text = to_json(results(document))
        step("drawing the report")
        write_outputs({target: render(document, text), beside: text.encode()})
    if json_path == STANDARD_OUTPUT:
        click.echo(text, nl=False)
    else:
        from px4fuse.report.terminal import print_summary

        console = terminal()
        print_summary(console, document)
        console.print(f"Report   {target}", markup=False, style="bold", soft_wrap=True)
    if fail_on is not None:
        worst = SEVERITIES[: SEVERITIES.index(fail_on) + 1]
        if any(finding.severity in worst for finding in document.findings):
            sys.exit(1)


def _read_notes(path: Path | None) -> str:
    if path is None:
        return ""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SettingsError(f"--notes {path}: cannot be read ({error.strerror}).") from error
    if len(content) > MAX_NOTES_BYTES:
        raise SettingsError(
            f"--notes {path}: {len(content)} bytes are too many for notes "
            f"(at most {MAX_NOTES_BYTES})."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SettingsError(
            f"--notes {path}: not UTF-8 text (byte {error.start}). Save it as UTF-8."
        ) from error
