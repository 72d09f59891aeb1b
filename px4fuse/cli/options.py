"""Option types of the command line, and options that several commands share.

The value of an option is a number without a unit. A value with a unit is rejected; the message
contains the converted number.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import click
from click.core import ParameterSource
from msgspec import Struct, structs

from px4fuse.batch import LOG_ANALYSIS_TIMEOUT_S
from px4fuse.core.input_files import register_input_path
from px4fuse.core.reading import (
    max_log_bytes,
    read_log_bytes,
    read_text,
    split_path_and_part,
)
from px4fuse.core.text import (
    UNIT_BY_SUFFIX,
    UNIT_NAME_BY_SYMBOL,
    convert_to_unit,
    replace_unencodable,
)
from px4fuse.errors import SettingsError
from px4fuse.filter.settings import SETTING_RANGES
from px4fuse.request import AUTO, OPTION_NAMES, ComparisonRequest, PositionFile

from .outputs import OPENS_OUTPUT_KEY

if TYPE_CHECKING:
    from px4fuse.results.model import Student


CommandFunction = Callable[..., None]
OptionDecorator = Callable[[CommandFunction], CommandFunction]
Choice = partial(click.Choice, case_sensitive=False)


def _combine_options(*options: OptionDecorator) -> OptionDecorator:
    """Combine options into one decorator; --help lists them in this order."""

    def add_options(command: CommandFunction) -> CommandFunction:
        for option in reversed(options):
            command = option(command)
        return command

    return add_options


class NonEmptyPath(click.Path):
    """Path of a file or folder; an empty name (the current folder) is rejected."""

    def __init__(self, path_type: type[Path | str] = Path) -> None:
        super().__init__(path_type=path_type)

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if value == "":
            self.fail("the file name is empty.", param, ctx)
        return super().convert(value, param, ctx)


class InputPath(NonEmptyPath):
    """Input file, input folder, or a track of a log (``LOG:vio``); no output may overwrite it."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path = super().convert(value, param, ctx)
        register_input_path(split_path_and_part(str(path))[0])
        return path


class NumberWithUnit(click.ParamType["float | str"]):
    """Number in a fixed unit, or the text "auto" if ``accepts_auto``, as type of an option."""

    name = "number"

    def __init__(self, unit: str, *, accepts_auto: bool = False) -> None:
        self.unit, self.accepts_auto = unit, accepts_auto

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Return the unit in capital letters, for --help."""
        unit = "DEG" if self.unit == "°" else self.unit.upper() or "NUMBER"
        return f"{unit}|auto" if self.accepts_auto else unit

    def convert(self, value: Any, param: Any, ctx: Any) -> float | str:
        """Convert the text of an option to a finite number, or return "auto" if allowed."""
        if self.accepts_auto and value == AUTO:
            return str(value)
        try:
            number = float(value)
        except ValueError:
            message = f"{value!r} is not a number"
            if self.unit:
                message += f" in {UNIT_NAME_BY_SYMBOL.get(self.unit, self.unit)}"
            if self.accepts_auto:
                message += " or auto"
            if (converted_number := convert_to_unit(value, self.unit)) is not None:
                message += f". Give {converted_number:.12g}"
            self.fail(f"{message}.", param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


def _set_max_log_size(ctx: click.Context, _: click.Parameter, megabytes: int | None) -> None:
    if megabytes is not None:
        token = max_log_bytes.set(megabytes * 1_000_000)
        ctx.call_on_close(lambda: max_log_bytes.reset(token))


log_argument = click.argument("log", type=InputPath())
#: Option --timeout of commands that analyse logs in worker processes
timeout_option = click.option(
    "--timeout",
    "timeout_s",
    type=click.FloatRange(1.0),
    metavar="SECONDS",
    default=LOG_ANALYSIS_TIMEOUT_S,
    help="Maximum time to analyse one log (s).",
)
#: Option --memory of commands that analyse logs in worker processes
memory_option = click.option(
    "--memory",
    "memory_gb",
    type=click.FloatRange(1.0),
    metavar="GB",
    default=4.0,
    help="Maximum memory for one log (GB, Linux only).",
)
# --max-size is not stored in the settings of a report, because it does not affect results
max_size_option = click.option(
    "--max-size",
    type=click.IntRange(1),
    metavar="MB",
    expose_value=False,
    callback=_set_max_log_size,
    help=f"Maximum size of a log (MB).  [default: {max_log_bytes.get() // 1_000_000}]",
)


def _json_option(extra_help_text: str = "") -> OptionDecorator:
    """Make the option --json for the results of a command."""
    return click.option(
        "--json",
        "json_path",
        type=NonEmptyPath(),
        metavar="FILE",
        help=f"Results to write (JSON); - prints them to standard output.{extra_help_text}",
    )


#: Option --json of commands without a report
json_option = _json_option()


flag_option = partial(click.option, is_flag=True)


def count_option(name: str, low: int, high: int, **details: Any) -> OptionDecorator:
    return click.option(name, type=click.IntRange(low, high), metavar="N", **details)


def input_option(name: str, metavar: str, help_text: str, **details: Any) -> OptionDecorator:
    return click.option(name, type=InputPath(), metavar=metavar, help=help_text, **details)


def output_option(metavar: str, help_text: str, **details: Any) -> OptionDecorator:
    """Make the option -o for an output file or folder."""
    return click.option(
        "-o", "--output", type=NonEmptyPath(), metavar=metavar, help=help_text, **details
    )


def report_options(help_text: str) -> OptionDecorator:
    """Make the option -o for the PDF report, and the option --json for the results."""
    json_text = " --json without -o writes no report.  [default: FILE.json for the report FILE.pdf]"
    return _combine_options(output_option("FILE.pdf", help_text), _json_option(json_text))


def make_fail_on_option(levels: tuple[str, ...], help_text: str) -> OptionDecorator:
    return click.option("--fail-on", type=Choice(levels), help=help_text)


def exit_if_severity_reached(
    fail_on: str | None, levels: Sequence[str], found_levels: Iterable[str]
) -> None:
    """Exit with code 1 if a level in ``found_levels`` is at least as severe as --fail-on."""
    if fail_on is not None and {*found_levels} & {*levels[: levels.index(fail_on) + 1]}:
        sys.exit(1)


def _make_open_option(*names: str) -> OptionDecorator:
    return flag_option(
        *names,
        expose_value=False,
        callback=lambda ctx, _, value: ctx.meta.update({OPENS_OUTPUT_KEY: value}),
        help="Open the written report or page in its default program.",
    )


#: Option --open of commands that write a report or a page
open_option = _make_open_option("--open", "--show", "opened")
#: Option --show of px4fuse loop. It has no alias --open, because px4fuse loop uses --open for a
#: flight that does not return to its start
show_option = _make_open_option("--show", "shown")
#: Options about the student, for the report: name, id, notes and answer form
student_options = _combine_options(
    click.option("--student", metavar="NAME", help="Name of the student for the report."),
    click.option("--id", "student_id", metavar="ID", help="Id of the student for the report."),
    input_option("--notes", "FILE.md", "Notes of the student for the report (Markdown)."),
    input_option("--answers", "FILE.toml", "Completed answer form (file from px4fuse answers)."),
)
system_option = click.option(
    "--system",
    type=click.IntRange(0, 255),
    metavar="ID",
    help="MAVLink system id of the vehicle.  [default: the id with the most messages]",
)


def request_option(
    request_type: type[Struct], name: str, help_text: str, **details: Any
) -> OptionDecorator:
    """Make the option for a field of ``request_type``, with its type, unit and default.

    The unit follows from the suffix of the name; an option for a bool is a flag.

    RANGE in ``help_text`` is replaced by the range of the KF setting. ``details`` are arguments of
    ``click.option``.
    """
    field = {field.name: field for field in structs.fields(request_type)}[name]
    # the type, and its members if it is a union such as ``float | Literal["auto"] | None``
    types = (field.type, *get_args(field.type))
    literal_types = [each for each in types if get_origin(each) is Literal]
    if float in types:  # the only word instead of a number is "auto"
        units = (unit for suffix, unit in UNIT_BY_SUFFIX.items() if name.endswith(suffix))
        details["type"] = NumberWithUnit(next(units, ""), accepts_auto=bool(literal_types))
    elif literal_types:
        details["type"] = Choice(get_args(literal_types[0]))
    elif field.type is bool:
        details["is_flag"] = True
    if field.default:
        details["default"] = field.default
    if name in SETTING_RANGES:
        help_text = help_text.replace("RANGE", SETTING_RANGES[name].format_limits())
    # without a name, click derives it from the option: --position-frame gives position_frame
    parameter_names = () if request_type is PositionFile else (name,)
    return click.option(
        OPTION_NAMES[request_type][name], *parameter_names, help=help_text, **details
    )


_comparison_option = partial(request_option, ComparisonRequest)
_position_option = partial(request_option, PositionFile)
_clock_offset_option = _comparison_option(
    "clock_offset_s",
    "Time (s) to add to the timestamps of the position source; auto estimates it.  [default: 0; "
    "auto with --position]",
)
#: Options for a position file; the names of their parameters begin with ``position``
position_options = _combine_options(
    click.option(
        "--position",
        type=InputPath(str),
        metavar="FILE",
        help="Recording of the positioning system (CSV or BAG:TOPIC), instead of the positions in "
        "LOG.",
    ),
    _position_option(
        "body", "Rigid body, tag or topic, if the file contains several.", metavar="NAME"
    ),
    _position_option(
        "frame",
        "Frame of x, y, z in the position file.  [default: from the column names, else the best "
        "fit to EKF2]",
    ),
    _position_option(
        "yaw_deg",
        "Yaw (°, clockwise from above) by which the positions are rotated; auto estimates yaw and "
        "origin.  [default: 0]",
    ),
    _position_option(
        "columns",
        "Names or numbers of the columns of the position file; SIGMA: σ of the position.  "
        "[default: detected]",
        type=lambda names: tuple(names.split(",")),
        metavar="TIME,X,Y,Z[,SIGMA]",
    ),
    _position_option("time_unit", "Unit of the times in the position file.  [default: detected]"),
    _position_option("length_unit", "Unit of x, y, z in the position file.  [default: detected]"),
)
#: Options for the KF settings, the axes, the time span and the position source
filter_options = _combine_options(
    _comparison_option(
        "sigma_a_m_s2",
        "KF process noise SIGMA_A (RANGE): σ of the acceleration error over one step DT.",
    ),
    _comparison_option(
        "sigma_z_m",
        "KF measurement noise SIGMA_Z (RANGE): σ of a measured position.  [default: 0.1; for GNSS "
        "√R of EKF2]",
    ),
    _comparison_option("dt_s", "KF prediction interval DT (RANGE)."),
    _comparison_option(
        "input",
        "KF input: acceleration measured by the IMU, or zero (constant velocity).  [default: imu "
        "if logged]",
    ),
    _comparison_option(
        "axes",
        "Axis to analyse, repeatable; aisle is the axis of largest motion.  [default: all axes "
        "with a position; for GNSS the horizontal axes]",
        multiple=True,
    ),
    _comparison_option(
        "heading_deg",
        "Heading (°, clockwise from north) of --axis aisle.  [default: axis of largest motion]",
    ),
    _comparison_option(
        "start_s",
        "Start of the analysed time span (s after the first sample).  [default: take-off]",
    ),
    _comparison_option(
        "end_s",
        "End of the analysed time span (s after the first sample).  [default: landing]",
    ),
    _comparison_option(
        "position_source",
        "Position source for KF; px4fuse info lists all sources.  [default: positions as "
        "received by PX4, if logged]",
        metavar="NAME",
    ),
    _comparison_option(
        "source_kind",
        "Kind of the position source; vio may drift.  [default: vio if the orientation in the "
        "messages changes, otherwise by message type]",
    ),
    _comparison_option(
        "height",
        "Height source of a flight with GNSS.  [default: the source that EKF2 fused, GNSS first]",
    ),
)
#: Options for the input files and the clock offset of one flight
flight_options = _combine_options(
    system_option, position_options, _clock_offset_option, max_size_option
)
#: Options of commands that run KF on one flight
analysis_options = _combine_options(filter_options, flight_options)
#: Options of commands that run KF on many logs: ``analysis_options`` without ``position_options``
settings_options = _combine_options(
    filter_options, system_option, _clock_offset_option, max_size_option
)


def comparison_request(log: Path, option_values: dict[str, Any]) -> ComparisonRequest:
    """Convert the values of options to the settings of ``px4fuse compare``.

    Raises
    ------
    SettingsError
        An option for a position file is given without --position.
    """
    position = _remove_position_file(option_values)
    return ComparisonRequest(log=str(log), position=position, **option_values)


def _remove_position_file(option_values: dict[str, Any]) -> PositionFile | None:
    """Take the values of ``position_options`` out of a dict; return them as a ``PositionFile``."""
    option_names = OPTION_NAMES[PositionFile]
    # click stores the value of --position-frame under the name position_frame
    fields = {
        field: option_values.pop(name[2:].replace("-", "_")) for field, name in option_names.items()
    }
    if fields["path"] is not None:
        return PositionFile(**fields)
    for field, value in fields.items():
        if value is not None:
            raise SettingsError(f"{option_names[field]} requires --position.")
    return None


def list_given_parameters() -> Iterator[click.Parameter]:
    context = click.get_current_context()
    for parameter in context.command.params:
        if context.get_parameter_source(parameter.name or "") == ParameterSource.COMMANDLINE:
            yield parameter


def read_student(option_values: dict[str, Any], log: Path) -> Student:
    """Read name, notes and answer form of a student, from the values of ``student_options``.

    These values are removed from ``option_values``.

    Raises
    ------
    SettingsError
        The notes or the answer form cannot be read, or the form is about another log.
    """
    from msgspec import UNSET

    from px4fuse.results.answer_form import read_answers
    from px4fuse.results.model import MAX_NOTES_BYTES, Student

    name, student_id, notes_path, answers_path = (
        option_values.pop(name) for name in ("student", "student_id", "notes", "answers")
    )
    notes = ""
    if notes_path is not None:
        notes = read_text(notes_path, SettingsError, MAX_NOTES_BYTES, name=f"--notes {notes_path}")
    answers = UNSET if answers_path is None else read_answers(answers_path)
    if answers and answers.log_sha256 != hashlib.sha256(read_log_bytes(log)).hexdigest():
        raise SettingsError(
            f"--answers {answers_path} was made for another log than {log.name}.",
            f"Write the form of this log with px4fuse answers {log.name}.",
        )
    name, student_id = (replace_unencodable(text or "") for text in (name, student_id))
    if not (texts := name + student_id + notes).isascii():
        from px4fuse.report.fonts import find_missing_characters, format_font_advice

        if characters := find_missing_characters(texts):
            click.echo(f"px4fuse: {format_font_advice(characters)}", err=True)
    return Student(name, student_id, notes, answers)
