"""Options that several commands share: which recordings of one flight are read, and how."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from px4fuse.cli.quantity import TypedQuantity
from px4fuse.errors import SettingsError
from px4fuse.reading import max_log_bytes, read_text
from px4fuse.request import AxisName, InputName

if TYPE_CHECKING:
    from px4fuse.request import ComparisonRequest, PositionFile
    from px4fuse.results.model import Student


class ColumnNames(click.ParamType["tuple[str, ...]"]):
    """Names or numbers of columns, with commas between them."""

    name = "columns"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Convert what was typed."""
        return tuple(value.split(",")) if isinstance(value, str) else value


Option = Callable[[Callable[..., None]], Callable[..., None]]


def _together(*options: Option) -> Option:
    """Several options as one, in the order in which the help lists them."""

    def add(command: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


class Named(click.Path):
    """A file or folder; an empty name, which would be the current folder, is a slip."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert what was typed."""
        if value == "":
            self.fail("the name is empty.", param, ctx)
        return super().convert(value, param, ctx)


# An option that names a file or folder
path_option = partial(click.option, type=Named())
_ANALYSIS = _together(
    click.option(
        "--sigma-a",
        "sigma_a_m_s2",
        type=TypedQuantity("m/s²", 0.5),
        default=0.5,
        help="Process noise SIGMA_A, 0.0001 to 100.",
    ),
    click.option(
        "--sigma-z",
        "sigma_z_m",
        type=TypedQuantity("m"),
        default=0.10,
        help="Measurement noise SIGMA_Z, 0.0001 to 100.",
    ),
    click.option(
        "--dt",
        "dt_s",
        type=TypedQuantity("s"),
        default=0.1,
        help="Prediction step DT, 0.001 to 1; Q is proportional to it.",
    ),
    click.option(
        "--input",
        type=click.Choice(get_args(InputName)),
        help="Acceleration from the IMU, or constant velocity.  [default: imu where logged]",
    ),
    click.option(
        "--axis",
        "axes",
        type=click.Choice(get_args(AxisName)),
        multiple=True,
        help="Axis to analyse; may be repeated.  [default: all that the source supports]",
    ),
    click.option(
        "--heading",
        "heading_deg",
        type=TypedQuantity("°", 30.0),
        help="Heading of the aisle, clockwise from north.  [default: from the track]",
    ),
    click.option(
        "--start",
        "start_s",
        type=TypedQuantity("s", 20.0),
        help="Start, seconds from the first data.  [default: take-off]",
    ),
    click.option(
        "--end", "end_s", type=TypedQuantity("s", 60.0), help="End.  [default: touch-down]"
    ),
    click.option(
        "--position-source",
        metavar="NAME",
        help="Position source, for example vehicle_gps_position.  [default: the best logged]",
    ),
)
system_option = click.option(
    "--system",
    type=click.IntRange(0, 255),
    metavar="ID",
    help="MAVLink system id of the vehicle.  [default: the one with the most data]",
)


def _allow_size(ctx: click.Context, _: click.Parameter, megabytes: int | None) -> None:
    if megabytes is not None:
        before = max_log_bytes.set(megabytes * 1_000_000)
        ctx.call_on_close(lambda: max_log_bytes.reset(before))


# It says what this machine can take, not what is analysed, so it is no setting of the analysis
max_size_option = click.option(
    "--max-size",
    type=click.IntRange(min=1),
    expose_value=False,
    callback=_allow_size,
    metavar="MB",
    help=f"Largest log that is read.  [default: {max_log_bytes.get() // 1_000_000}]",
)
_RECORDINGS = _together(
    path_option(
        "--mavlink",
        metavar="FILE.tlog",
        help="MAVLink recording of the same flight: gives what LOG lacks.",
    ),
    system_option,
)
_POSITION = _together(
    path_option(
        "--position",
        metavar="FILE.csv",
        help="The positioning system's own recording: time, x, y, z.",
    ),
    click.option(
        "--position-frame",
        type=click.Choice(["ned", "enu", "nwu"]),
        help="What its x, y, z are.  [default: from its column names, or what fits EKF2]",
    ),
    click.option(
        "--position-yaw",
        type=TypedQuantity("°", 30.0, auto=True),
        help="Turn it clockwise, seen from above; auto finds yaw and origin.  [default: 0]",
    ),
    click.option(
        "--position-columns",
        type=ColumnNames(),
        metavar="TIME,X,Y,Z[,SIGMA]",
        help="Names or numbers of its columns.  [default: by their names]",
    ),
    click.option(
        "--position-time-unit",
        type=click.Choice(["s", "ms", "us", "ns"]),
        help="Unit of its time.  [default: detected]",
    ),
    click.option(
        "--position-unit",
        type=click.Choice(["m", "cm", "mm"]),
        help="Unit of its x, y, z.  [default: detected]",
    ),
)
# Fields of a request's PositionFile by the option that gives them
_POSITION_FIELDS = {
    "position_frame": "frame",
    "position_yaw": "yaw_deg",
    "position_columns": "columns",
    "position_time_unit": "time_unit",
    "position_unit": "length_unit",
}
clock_offset_option = click.option(
    "--clock-offset",
    "clock_offset_s",
    type=TypedQuantity("s", auto=True),
    help="Added to the position source's time stamps; auto estimates it.  [default: 0; auto with "
    "--position]",
)
json_option = path_option(
    "--json",
    "json_path",
    metavar="FILE",
    help="Write it as JSON; - prints that alone on standard output.",
)
#: Whose report it is
person_options = _together(
    click.option("--student", metavar="NAME", help="Name on the report."),
    click.option("--id", "student_id", metavar="ID", help="Student number on the report."),
    path_option("--notes", metavar="FILE.md", help="Your own words, printed in the report."),
    path_option(
        "--answers",
        metavar="FILE.toml",
        help="The form about the flight, filled in (see px4fuse answers), printed in the report.",
    ),
)
#: Of commands whose results stand beside a report
results_option = path_option(
    "--json",
    "json_path",
    metavar="FILE",
    help="The results; - prints them alone on standard output, and without -o writes no report.  "
    "[default: beside the PDF]",
)
#: Of every command that makes a report: the PDF and its results
report_options = _together(
    path_option(
        "-o",
        "--output",
        metavar="FILE.pdf",
        help="The report.  [default: reports/LOG.pdf, settings that are not at their defaults in "
        "its name]",
    ),
    results_option,
)


#: Which recordings of the flight are read, and how
recording_options = _together(_RECORDINGS, _POSITION, clock_offset_option, max_size_option)
#: Of commands that read a flight as it was recorded
flight_options = _together(_RECORDINGS, max_size_option)
#: Of every command that runs the filter: settings, segment and recordings
analysis_options = _together(_ANALYSIS, recording_options)
#: Of an analysis that hold for many logs: no other files of one flight
settings_options = _together(_ANALYSIS, system_option, clock_offset_option, max_size_option)


def comparison_request(log: Path, given: dict[str, Any]) -> ComparisonRequest:
    """What :func:`recording_options`, or :func:`analysis_options` with them, gave as a request.

    Raises
    ------
    SettingsError
        An option is about a position file, and none is given.
    """
    from px4fuse.request import ComparisonRequest

    position = _position_file(given)
    mavlink = given.pop("mavlink")
    return ComparisonRequest(
        log=str(log), mavlink=None if mavlink is None else str(mavlink), position=position, **given
    )


def _position_file(given: dict[str, Any]) -> PositionFile | None:
    from px4fuse.request import PositionFile

    path = given.pop("position")
    how = {field: given.pop(option) for option, field in _POSITION_FIELDS.items()}
    if path is not None:
        return PositionFile(path=str(path), **how)
    for option, field in _POSITION_FIELDS.items():
        if how[field] is not None:
            raise SettingsError(f"--{option.replace('_', '-')} requires --position.")
    return None


def read_person(given: dict[str, Any]) -> Student:
    """Whose report it is, taken out of what :func:`person_options` gave.

    Raises
    ------
    SettingsError
        The notes or the answers cannot be read.
    """
    from msgspec import UNSET

    from px4fuse.answers import read_answers
    from px4fuse.results.model import Student

    name, number = given.pop("student") or "", given.pop("student_id") or ""
    notes, form = _read_notes(given.pop("notes")), given.pop("answers")
    answers = UNSET if form is None else read_answers(form)
    person = Student(encodable(name), encodable(number), notes, answers)
    _tell_fonts(person.name + person.id + person.notes)
    return person


def _tell_fonts(text: str) -> None:
    """Say before all work that the report will lack characters, and what to install."""
    if text.isascii():
        return
    from px4fuse.report.fonts import advice, missing

    if lacking := missing(text):
        click.echo(f"px4fuse: {advice(lacking)}", err=True)


def _read_notes(path: Path | None) -> str:
    from px4fuse.results.model import MAX_NOTES_BYTES

    if path is None:
        return ""
    return read_text(path, SettingsError, MAX_NOTES_BYTES, name=f"--notes {path}")


def encodable(text: str) -> str:
    """Text without the stray bytes that a terminal may hand over."""
    return text.encode(errors="replace").decode()
