"""Options that several commands share: which recordings of one flight are read, and how."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import click
from click.core import ParameterSource

from px4fuse.errors import LogError, SettingsError
from px4fuse.reading import max_log_bytes, read_text, shown

if TYPE_CHECKING:
    from px4fuse.comparison.comparison import Comparison
    from px4fuse.flight import Flight
    from px4fuse.report.document import Student

AXES = ("north", "east", "down", "aisle")
# Options that name places or people; the command line in the report leaves them out
NOT_RECORDED = (
    "output", "json_path", "tum", "g2o", "student", "student_id", "notes", "fail_on", "max_size",
)  # fmt: skip
AUTO: Literal["auto"] = "auto"
MAX_NOTES_BYTES = 200_000


class NumberOrAuto(click.ParamType[float | str]):
    """A number, or the word ``auto``."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert what was typed."""
        if value == AUTO or isinstance(value, float):
            return value  # type: ignore[no-any-return]
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is neither a number nor 'auto'.", param, ctx)


# An option that names a file or folder
path_option = partial(click.option, type=click.Path(path_type=Path))
_ANALYSIS = (
    click.option(
        "--sigma-a",
        type=float,
        default=0.5,
        show_default=True,
        metavar="M/S²",
        help="Process noise SIGMA_A, 0.0001 to 100.",
    ),
    click.option(
        "--sigma-z",
        type=float,
        default=0.10,
        show_default=True,
        metavar="M",
        help="Measurement noise SIGMA_Z, 0.0001 to 100.",
    ),
    click.option(
        "--dt",
        type=float,
        default=0.1,
        show_default=True,
        metavar="S",
        help="Prediction step DT, 0.001 to 1; Q is proportional to it.",
    ),
    click.option(
        "--input",
        "input_name",
        type=click.Choice(["imu", "zero"]),
        default=None,
        help="Acceleration from the IMU, or constant velocity.  [default: imu where logged]",
    ),
    click.option(
        "--axis",
        "axes",
        type=click.Choice(AXES),
        multiple=True,
        help="Axis to analyse; may be repeated.  [default: all that the source supports]",
    ),
    click.option(
        "--heading",
        type=float,
        default=None,
        metavar="DEG",
        help="Heading of the aisle, clockwise from north.  [default: from the track]",
    ),
    click.option(
        "--start",
        type=float,
        default=None,
        metavar="S",
        help="Start, seconds from the first data.  [default: take-off]",
    ),
    click.option(
        "--end", type=float, default=None, metavar="S", help="End.  [default: touch-down]"
    ),
    click.option(
        "--position-source",
        default=None,
        metavar="NAME",
        help="Position source, for example vehicle_gps_position.  [default: the best logged]",
    ),
)
system_option = click.option(
    "--system",
    type=click.IntRange(0, 255),
    default=None,
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
    default=None,
    expose_value=False,
    callback=_allow_size,
    metavar="MB",
    help=f"Largest log that is read.  [default: {max_log_bytes.get() // 1_000_000}]",
)
_RECORDINGS = (
    path_option(
        "--mavlink",
        metavar="FILE.tlog",
        help="MAVLink recording of the same flight: gives what LOG lacks.",
    ),
    system_option,
)
_POSITION = (
    path_option(
        "--position",
        metavar="FILE.csv",
        help="The positioning system's own recording: time, x, y, z.",
    ),
    click.option(
        "--position-frame",
        type=click.Choice(["ned", "enu", "nwu"]),
        default=None,
        help="What its x, y, z are.  [default: from its column names, or what fits EKF2]",
    ),
    click.option(
        "--position-yaw",
        type=NumberOrAuto(),
        default=None,
        metavar="DEG|auto",
        help="Turn it clockwise, seen from above; auto finds yaw and origin.  [default: 0]",
    ),
    click.option(
        "--position-columns",
        default=None,
        metavar="TIME,X,Y,Z[,SIGMA]",
        help="Names or numbers of its columns.  [default: by their names]",
    ),
    click.option(
        "--position-time-unit",
        type=click.Choice(["s", "ms", "us", "ns"]),
        default=None,
        help="Unit of its time.  [default: detected]",
    ),
    click.option(
        "--position-unit",
        type=click.Choice(["m", "cm", "mm"]),
        default=None,
        help="Unit of its x, y, z.  [default: detected]",
    ),
)


clock_offset_option = click.option(
    "--clock-offset",
    type=NumberOrAuto(),
    default=None,
    metavar="S|auto",
    help="Added to the position source's time stamps; auto estimates it.  [default: 0; auto with "
    "--position]",
)
json_option = path_option(
    "--json",
    "json_path",
    metavar="FILE",
    help="Write it as JSON; - prints that alone on standard output.",
)
_PERSON = (
    click.option("--student", default="", metavar="NAME", help="Name on the report."),
    click.option(
        "--id", "student_id", default="", metavar="ID", help="Student number on the report."
    ),
    path_option("--notes", metavar="FILE.md", help="Your own words, printed in the report."),
)
_REPORT = (
    path_option(
        "-o", "--output", metavar="FILE.pdf", help="The report.  [default: reports/LOG.pdf]"
    ),
    path_option(
        "--json",
        "json_path",
        metavar="FILE",
        help="The results; - prints them alone on standard output.  [default: beside the PDF]",
    ),
)


def recording_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say which recordings of the flight are read, and how."""
    for option in reversed((*_RECORDINGS, *_POSITION, clock_offset_option, max_size_option)):
        command = option(command)
    return command


def analysis_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of every command that runs the filter: settings, segment and recordings."""
    command = recording_options(command)
    for option in reversed(_ANALYSIS):
        command = option(command)
    return command


def person_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say whose report it is."""
    for option in reversed(_PERSON):
        command = option(command)
    return command


def report_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of every command that makes a report: the PDF and its results."""
    for option in reversed(_REPORT):
        command = option(command)
    return command


def read_recordings(log: Path, mavlink: Path | None, system: int | None) -> Flight:
    """Read a log, joined with the MAVLink recording of the same flight where one is given."""
    from px4fuse.readers import read_log

    if mavlink is None:
        return read_log(log, system=system)
    from px4fuse.placing.joining import join

    flight = read_log(log)
    other = read_log(mavlink, system=system)
    if not other.log.format.startswith("MAVLink"):
        raise LogError(
            f"--mavlink {shown(mavlink)}: a {other.log.format}, no MAVLink recording. Give the "
            "ULog first: px4fuse compare LOG.ulg --mavlink LOG.tlog."
        )
    return join(flight, other)


def with_position(
    flight: Flight,
    position: Path | None,
    clock_offset: float | str | None,
    **options: Any,
) -> Flight:
    """Bring in the external position file, where one is given.

    Parameters
    ----------
    flight : Flight
    position : Path or None
    clock_offset : float, "auto" or None
        What must be added to the file's stamps; None and "auto" find it.
    **options
        ``position_frame, position_yaw, position_columns, position_time_unit, position_unit``.
    """
    given = [name for name, value in options.items() if value is not None]
    if position is None:
        if given:
            raise SettingsError(f"--{given[0].replace('_', '-')} is of use with --position only.")
        return flight
    from px4fuse.placing.placement import place
    from px4fuse.readers.position_csv import read_position_csv

    columns = options["position_columns"]
    file = read_position_csv(
        position,
        columns=None if columns is None else tuple(columns.split(",")),
        time_unit=options["position_time_unit"],
        length_unit=options["position_unit"],
    )
    return place(
        flight,
        file,
        frame=options["position_frame"],
        yaw_deg=options["position_yaw"],
        clock_offset_s=clock_offset if isinstance(clock_offset, float) else None,
    )


def run_comparison(
    log: Path,
    step: Callable[[str], None],
    *,
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
    **position_format: Any,
) -> Comparison:
    """Read what :func:`analysis_options` name and run the filter over it."""
    from px4fuse.comparison import comparison
    from px4fuse.filter.kalman import InputName, Settings

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
    step(f"reading {shown(log)}")
    flight = read_recordings(log, mavlink, system)
    flight = with_position(flight, position, clock_offset, **position_format)

    def run(settings: Settings) -> Comparison:
        return comparison.compare(
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

    compared = run(settings)
    if clock_offset == AUTO and position is None:
        from px4fuse.analysis import clock_offset_found

        found = clock_offset_found(compared, step)
        compared = run(replace(settings, clock_offset_s=found))
    return compared


def read_person(given: dict[str, Any]) -> Student:
    """Whose report it is, taken out of what :func:`person_options` gave.

    Raises
    ------
    SettingsError
        The notes cannot be read.
    """
    from px4fuse.report.document import Student

    name, number = given.pop("student"), given.pop("student_id")
    return Student(encodable(name), encodable(number), _read_notes(given.pop("notes")))


def _read_notes(path: Path | None) -> str:
    if path is None:
        return ""
    return read_text(path, SettingsError, MAX_NOTES_BYTES, name=f"--notes {path}")


def encodable(text: str) -> str:
    """Text without the stray bytes that a terminal may hand over."""
    return text.encode(errors="replace").decode()


def command_line(command: str, *files: Path) -> str:
    """The command that makes this again: what was given, without folders and names."""
    context = click.get_current_context()
    words = ["px4fuse", command, *(encodable(file.name) for file in files)]
    for parameter in context.command.params:
        name = parameter.name or ""
        given = context.get_parameter_source(name) == ParameterSource.COMMANDLINE
        if not given or name in NOT_RECORDED or isinstance(parameter, click.Argument):
            continue
        if getattr(parameter, "is_flag", False):
            words.append(parameter.opts[-1])
            continue
        value: Any = context.params[name]
        for single in value if isinstance(value, tuple) else (value,):
            text = single.name if isinstance(single, Path) else str(single)
            words += [parameter.opts[-1], encodable(text)]
    return shlex.join(words)
