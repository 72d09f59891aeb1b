"""``px4fuse compare``: the main job."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from click.core import ParameterSource

from px4fuse.cli.inputs import (
    clock_offset_option,
    position_options,
    read_recordings,
    recording_options,
    with_position,
)
from px4fuse.errors import OutputError, SettingsError

if TYPE_CHECKING:
    from px4fuse.report.document import Document

AXES = ("north", "east", "down", "aisle")
SEVERITIES = ("error", "warning", "info")
MAX_NOTES_BYTES = 200_000
# Options that name places or people; the command line in the report leaves them out
NOT_RECORDED = ("log", "output", "json_path", "student", "student_id", "notes", "fail_on")


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--sigma-a",
    type=float,
    default=0.5,
    show_default=True,
    metavar="M/S²",
    help="Process noise SIGMA_A, 0.0001 to 100.",
)
@click.option(
    "--sigma-z",
    type=float,
    default=0.10,
    show_default=True,
    metavar="M",
    help="Measurement noise SIGMA_Z, 0.0001 to 100.",
)
@click.option(
    "--dt",
    type=float,
    default=0.1,
    show_default=True,
    metavar="S",
    help="Prediction step DT, 0.001 to 1; Q is proportional to it.",
)
@click.option(
    "--input",
    "input_name",
    type=click.Choice(["imu", "zero"]),
    default=None,
    help="Acceleration from the IMU, or constant velocity.  [default: imu where logged]",
)
@click.option(
    "--axis",
    "axes",
    type=click.Choice(AXES),
    multiple=True,
    help="Axis to analyse; may be repeated.  [default: all that the source supports]",
)
@click.option(
    "--heading",
    type=float,
    default=None,
    metavar="DEG",
    help="Heading of the aisle, clockwise from north.  [default: from the track]",
)
@click.option(
    "--start",
    type=float,
    default=None,
    metavar="S",
    help="Start, seconds from the first data.  [default: take-off]",
)
@click.option("--end", type=float, default=None, metavar="S", help="End.  [default: touch-down]")
@click.option(
    "--position-source",
    default=None,
    metavar="NAME",
    help="Position source, for example vehicle_gps_position.  [default: the best logged]",
)
@recording_options
@position_options
@clock_offset_option
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
    sigma_a: float,
    sigma_z: float,
    dt: float,
    input_name: str | None,
    axes: tuple[str, ...],
    heading: float | None,
    start: float | None,
    end: float | None,
    position_source: str | None,
    mavlink: Path | None,
    system: int | None,
    position: Path | None,
    clock_offset: float | str | None,
    student: str,
    student_id: str,
    notes: Path | None,
    output: Path | None,
    json_path: Path | None,
    fail_on: str | None,
    **position_format: Any,
) -> None:
    """Compare a flight's EKF2 with a two-state Kalman filter over IMU and position.

    LOG is a PX4 ULog or a MAVLink recording (.tlog or raw stream). Writes a PDF report and its
    results as JSON.
    """
    from rich.console import Console

    from px4fuse import comparison
    from px4fuse.findings import find
    from px4fuse.kalman import InputName, Settings
    from px4fuse.report.document import Document, Student
    from px4fuse.report.results import results, to_json

    settings = Settings(
        sigma_a_m_s2=sigma_a,
        sigma_z_m=sigma_z,
        dt_s=dt,
        input=cast(InputName, input_name or "imu"),
        # that of a position file is spent on placing it
        clock_offset_s=clock_offset if isinstance(clock_offset, float) and not position else 0.0,
    )
    for name, value in (("--start", start), ("--end", end), ("--clock-offset", clock_offset)):
        if isinstance(value, float) and not abs(value) < float("inf"):
            raise SettingsError(f"{name} {value:g} is not a finite number.")
    person = Student(_encodable(student), _encodable(student_id), _read_notes(notes))
    target = output or Path("reports") / f"{log.stem}.pdf"
    if target.suffix.lower() != ".pdf":
        raise OutputError(f"{target}: the report is a PDF. Give a name that ends in .pdf with -o.")
    with _progress(json_path) as step:
        step(f"reading {log.name}")
        flight = read_recordings(log, mavlink, system)
        flight = with_position(flight, position, clock_offset, **position_format)
        compared = comparison.compare(
            flight,
            settings,
            axes=axes or None,
            heading_deg=heading,
            position_source=position_source,
            start_s=start,
            end_s=end,
            input_required=input_name == "imu",
            progress=lambda name: step(f"filtering {name}"),
        )
        document = Document(compared, find(compared), person, _command_line(log))
        found = results(document)
        _write(document, found, target, json_path, step)
    if json_path == Path("-"):
        click.echo(to_json(found), nl=False)
    else:
        from px4fuse.report.terminal import print_summary

        console = Console(highlight=False)
        print_summary(console, document)
        console.print(f"Report   {target}", markup=False, style="bold", soft_wrap=True)
    if fail_on is not None:
        worst = SEVERITIES[: SEVERITIES.index(fail_on) + 1]
        if any(finding.severity in worst for finding in document.findings):
            sys.exit(1)


@contextmanager
def _progress(json_path: Path | None) -> Iterator[Callable[[str], None]]:
    """Say what is being done on a terminal; be quiet in a pipe."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal or json_path == Path("-"):
        yield lambda _: None
        return
    with console.status("starting") as status:
        yield status.update


def _encodable(text: str) -> str:
    """Text without the stray bytes that a terminal may hand over."""
    return text.encode(errors="replace").decode()


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


def _command_line(log: Path) -> str:
    """The command that makes this report again: what was given, without folders and names."""
    context = click.get_current_context()
    words = ["px4fuse", "compare", _encodable(log.name)]
    for parameter in context.command.params:
        name = parameter.name or ""
        given = context.get_parameter_source(name) == ParameterSource.COMMANDLINE
        if not given or name in NOT_RECORDED:
            continue
        value: Any = context.params[name]
        for single in value if isinstance(value, tuple) else (value,):
            text = single.name if isinstance(single, Path) else str(single)
            words += [parameter.opts[-1], _encodable(text)]
    return shlex.join(words)


def _write(
    document: Document,
    found: dict[str, Any],
    target: Path,
    json_path: Path | None,
    step: Callable[[str], None],
) -> None:
    from px4fuse.report.pdf import render
    from px4fuse.report.results import to_json
    from px4fuse.report.writing import write_all

    step("drawing the report")
    text = to_json(found)
    contents = {target: render(document, text)}
    beside = target.with_suffix(".json") if json_path in (None, Path("-")) else json_path
    if beside is not None:
        if beside.resolve() == target.resolve():
            raise OutputError(f"{beside}: --json and -o name the same file. Give two names.")
        contents[beside] = text.encode()
    write_all(contents)
