"""``px4fuse compare``: the main job."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.inputs import (
    analysis_options,
    command_line,
    encodable,
    progress,
    run_comparison,
    spare_inputs,
    terminal,
    write_outputs,
)
from px4fuse.errors import OutputError, SettingsError

if TYPE_CHECKING:
    from px4fuse.report.document import Document

SEVERITIES = ("error", "warning", "info")
MAX_NOTES_BYTES = 200_000


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@analysis_options
@click.option("--student", default="", metavar="NAME", help="Name on the report.")
@click.option("--id", "student_id", default="", metavar="ID", help="Student number on the report.")
@click.option(
    "--notes",
    type=click.Path(path_type=Path),
    default=None,
    metavar="FILE.md",
    help="Your own words, printed in the report.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=None,
    metavar="FILE.pdf",
    help="The report.  [default: reports/LOG.pdf]",
)
@click.option(
    "--json",
    "json_path",
    type=click.Path(path_type=Path),
    default=None,
    metavar="FILE",
    help="The results; - prints them alone on standard output.  [default: beside the PDF]",
)
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
    from px4fuse.report.results import results, to_json

    person = Student(encodable(student), encodable(student_id), _read_notes(notes))
    target = output or Path("reports") / f"{log.stem}.pdf"
    if target.suffix.lower() != ".pdf":
        raise OutputError(f"{target}: the report is a PDF. Give a name that ends in .pdf with -o.")
    spare_inputs([target, *([json_path] if json_path is not None else [])])
    with progress(json_path == Path("-")) as step:
        compared = explain(run_comparison(log, step, **analysis), step)
        document = Document(compared, find(compared), person, command_line("compare", log))
        found = results(document)
        _write(document, found, target, json_path, step)
    if json_path == Path("-"):
        click.echo(to_json(found), nl=False)
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


def _write(
    document: Document,
    found: dict[str, Any],
    target: Path,
    json_path: Path | None,
    step: Callable[[str], None],
) -> None:
    from px4fuse.report.pdf import render
    from px4fuse.report.results import to_json

    step("drawing the report")
    text = to_json(found)
    contents = {target: render(document, text)}
    beside = target.with_suffix(".json") if json_path in (None, Path("-")) else json_path
    if beside is not None:
        if beside.resolve() == target.resolve():
            raise OutputError(f"{beside}: --json and -o name the same file. Give two names.")
        contents[beside] = text.encode()
    write_outputs(contents)
