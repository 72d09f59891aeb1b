"""Option types of the command line, and options that several commands share.

Numbers are typed without their unit; for a number with a unit the error shows the right number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

import click
from click.core import ParameterSource
from msgspec import NODEFAULT, Struct
from msgspec.structs import fields

from px4fuse.cli.outputs import OPEN_KEY
from px4fuse.errors import SettingsError
from px4fuse.input_files import add_input
from px4fuse.reading import max_log_bytes, read_text
from px4fuse.record import table
from px4fuse.request import (
    AUTO,
    CLOCK_OPTION,
    FILTER_OPTIONS,
    OPTIONS,
    POSITION_OPTIONS,
    RECORDINGS,
    ComparisonRequest,
    EvaluationRequest,
    PositionFile,
)
from px4fuse.request import Option as Declared
from px4fuse.units import NAMES, convert_to_unit

if TYPE_CHECKING:
    from px4fuse.results.model import Student


def column_names(text: str) -> tuple[str, ...]:
    """Parse comma-separated names or numbers of columns."""
    return tuple(text.split(","))


Option = Callable[[Callable[..., None]], Callable[..., None]]


def _combine_options(*options: Option) -> Option:
    """Combine several options into one decorator; the help lists them in this order."""

    def add(command: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


class NonEmptyPath(click.Path):
    """Path of a file or folder; an empty name is rejected, as it would mean the current folder."""

    def __init__(self, path_type: type[Path | str] = Path) -> None:
        super().__init__(path_type=path_type)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the typed text to a path."""
        if value == "":
            self.fail("the name is empty.", param, ctx)
        return super().convert(value, param, ctx)


class InputPath(NonEmptyPath):
    """File or folder to read; it is registered as input before the command begins.

    A log may be followed by the name of a track: ``LOG:vio``.

    A log may have a part of it after a colon, as ``LOG:vio``.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the typed text to a path and register the file."""
        path = super().convert(value, param, ctx)
        file, colon, _ = str(path).rpartition(":")
        add_input(Path(file) if colon and not Path(path).exists() else Path(path))
        return path


class TypedQuantity(click.ParamType["float | str"]):
    """Number in a fixed unit.

    Parameters
    ----------
    unit : str
        One of :data:`px4fuse.units.NAMES`.
    example : float
        Number in the error message if the typed text is not a number.
    auto : bool
        Accept ``auto`` in addition.
    """

    name = "number"

    def __init__(self, unit: str, example: float = 0.1, *, auto: bool = False) -> None:
        self.unit, self.example, self.auto = unit, example, auto

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Return the unit, which --help shows for the value."""
        unit = "DEG" if self.unit == "°" else self.unit.upper() or "NUMBER"
        return f"{unit}|auto" if self.auto else unit

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert the typed text to a number, or to "auto"."""
        if self.auto and value == AUTO:
            return str(value)
        unit = f" in {NAMES[self.unit]}" if self.unit else ""
        try:
            number = float(value)
        except ValueError:
            parsed = convert_to_unit(value, self.unit)
            example_text = f"{self.example if parsed is None else parsed:.12g}"
            self.fail(
                f"{value!r} is not a number{unit}. Give for example {example_text}"
                f"{', or auto' if self.auto else ''}.",
                param,
                ctx,
            )
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


def option(
    typed: str,
    meaning: str,
    least: float | None = None,
    most: float | None = None,
    *,
    name: str = "",
    **more: Any,
) -> Option:
    """Declare an option; its type and default are those of the command's parameter of that name.

    Parameters
    ----------
    typed : str
        Names and metavar as shown by --help: "-o, --output FILE".
    meaning : str
        Help text.
    least, most : float, optional
        Limits of a number.
    name : str
        Name of the parameter, if it differs from the option.
    **more
        Further arguments of ``click.option``.
    """
    names, _, metavar = typed.replace(", ", ",").partition(" ")
    field = name or names.rpartition("--")[2].replace("-", "_")

    def add(command: Callable[..., None]) -> Callable[..., None]:
        details: dict[str, Any] = {"help": meaning, "metavar": metavar or None}
        if "type" not in more and (hint := get_type_hints(command).get(field)) is not None:
            default = signature(command).parameters[field].default
            details |= _click_type(hint)
            if default is not Parameter.empty:
                details["default"] = default
            elif hint is Path:
                details["required"] = True
        if (least, most) != (None, None):
            range_type: Any = click.FloatRange if details.get("type") is float else click.IntRange
            details["type"] = range_type(least, most)
        return click.option(*names.split(","), field, **details | more)(command)

    return add


class _OptionRow(Struct, frozen=True):
    """Row of ``options.toml``: arguments of :func:`option`."""

    typed: str
    meaning: str
    least: int | float | None = None
    most: int | float | None = None


_TABLES = table(__file__, "options.toml", dict[str, dict[str, _OptionRow]])


def options(title: str, **more: Mapping[str, Any]) -> Option:
    """Declare the options of a table of ``options.toml``; ``more``: further arguments by option."""
    return _combine_options(
        *(
            option(row.typed, row.meaning, row.least, row.most, name=name, **more.get(name, {}))
            for name, row in _TABLES[title].items()
        )
    )


def request_options(kind: type[Struct], options: Mapping[str, Declared]) -> Option:
    """Declare options for fields of a request, with the type and default of each field."""
    hints, defaults = get_type_hints(kind), {field.name: field for field in fields(kind)}
    return _combine_options(
        *(
            _declared_option(name, declared, hints[name], defaults[name].default)
            for name, declared in options.items()
            if declared.meaning
        )
    )


def _declared_option(field: str, declared: Declared, hint: Any, default: Any) -> Option:
    """Declare the option of one field; parameters of a position file begin with ``position``."""
    name = declared.name[2:].replace("-", "_") if declared.name.startswith("--position") else field
    details = {"default": default or None} if default is not NODEFAULT else {}
    details |= _click_type(hint) | {"help": declared.meaning, "metavar": declared.metavar}
    if field in ("path", "mavlink", "reference"):
        details["type"] = InputPath(str)
    elif declared.unit:
        auto = len(get_args(hint)) > 2
        details["type"] = TypedQuantity(declared.unit, declared.example, auto=auto)
    elif field == "columns":
        details |= {"type": column_names, "multiple": False}
    elif field == "system":
        details["type"] = click.IntRange(0, 255)
    return click.option(declared.name, name, **details)


def _click_type(hint: Any) -> dict[str, Any]:
    """Return click's arguments for a type hint: a Literal is a choice, a tuple is repeatable."""
    types = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    inner = next(member for member in types if member is not NoneType)
    if get_origin(inner) is tuple:
        return _click_type(get_args(inner)[0]) | {"multiple": True}
    if get_origin(inner) is Literal:
        return {"type": click.Choice(get_args(inner), case_sensitive=False)}
    if inner is bool:
        return {"is_flag": True, "default": False}
    return {"type": NonEmptyPath() if inner is Path else inner}


def _set_max_size(ctx: click.Context, _: click.Parameter, megabytes: int | None) -> None:
    if megabytes is not None:
        before = max_log_bytes.set(megabytes * 1_000_000)
        ctx.call_on_close(lambda: max_log_bytes.reset(before))


# A limit of this computer, not a setting of the analysis, so it is not part of the request
max_size_option = option(
    "--max-size MB",
    f"Maximum size of a log.  [default: {max_log_bytes.get() // 1_000_000}]",
    1,
    expose_value=False,
    callback=_set_max_size,
)
_JSON_MEANING = "Write the results as JSON; - prints them to standard output."
#: Option --json of commands without a report
json_option = option("--json FILE", _JSON_MEANING, name="json_path")


def _open_flag(option_text: str, name: str) -> Option:
    """Declare a flag to open the output; :func:`~px4fuse.cli.outputs.write_and_print` opens it."""
    return option(
        option_text,
        "Open the written file in its default program.",
        name=name,
        is_flag=True,
        expose_value=False,
        callback=lambda ctx, _, value: ctx.meta.update({OPEN_KEY: value}),
    )


#: --open of commands that write a report or a page
open_option = _open_flag("--open, --show", "opened")
#: --show of px4fuse loop, whose --open means an open loop
show_option = _open_flag("--show", "shown")
#: Student, notes and answers
person_options = options("person", notes={"type": InputPath()}, answers={"type": InputPath()})


def report_options(meaning: str) -> Option:
    """Declare -o for the PDF report and --json for its results."""
    json_meaning = (
        f"{_JSON_MEANING} With --json and without -o, no report is written.  [default: beside the "
        "report]"
    )
    return _combine_options(
        option("-o, --output FILE.pdf", meaning),
        option("--json FILE", json_meaning, name="json_path"),
    )


system_option = request_options(EvaluationRequest, {"system": OPTIONS["system"]})
_FILTER_GROUP = request_options(ComparisonRequest, FILTER_OPTIONS)
_CLOCK_GROUP = request_options(ComparisonRequest, CLOCK_OPTION)
#: Recordings of one flight, for commands that read it as logged
flight_options = _combine_options(request_options(ComparisonRequest, RECORDINGS), max_size_option)
#: Recordings of one flight, position file and clock offset
recording_options = _combine_options(
    request_options(ComparisonRequest, RECORDINGS),
    request_options(PositionFile, POSITION_OPTIONS),
    _CLOCK_GROUP,
    max_size_option,
)
#: Settings, segment and recordings, for commands that run KF
analysis_options = _combine_options(_FILTER_GROUP, recording_options)
#: Settings that apply to many logs, so without the files of one flight
settings_options = _combine_options(_FILTER_GROUP, system_option, _CLOCK_GROUP, max_size_option)


def comparison_request(log: Path, option_values: dict[str, Any]) -> ComparisonRequest:
    """Make a request of the values of :func:`recording_options` or :func:`analysis_options`.

    Raises
    ------
    SettingsError
        An option for a position file is given without --position.
    """
    return ComparisonRequest(log=str(log), position=_position_file(option_values), **option_values)


def _position_file(option_values: dict[str, Any]) -> PositionFile | None:
    option_names = {field: option.name for field, option in POSITION_OPTIONS.items()}
    fields_of_file = {
        field: option_values.pop(name[2:].replace("-", "_")) for field, name in option_names.items()
    }
    if fields_of_file["path"] is not None:
        return PositionFile(**fields_of_file)
    for field, value in fields_of_file.items():
        if value is not None:
            raise SettingsError(f"{option_names[field]} requires --position.")
    return None


def typed_parameters() -> Iterator[click.Parameter]:
    """Yield the parameters that were typed, not those at their defaults."""
    context = click.get_current_context()
    for parameter in context.command.params:
        if context.get_parameter_source(parameter.name or "") == ParameterSource.COMMANDLINE:
            yield parameter


def read_student(option_values: dict[str, Any]) -> Student:
    """Take the values of :func:`person_options` out of the options and read their files.

    Raises
    ------
    SettingsError
        The notes or the answers cannot be read, or the notes cannot be printed.
    """
    from msgspec import UNSET

    from px4fuse.answer_form import read_answers
    from px4fuse.results.model import MAX_NOTES_BYTES, Student

    name, student_id = option_values.pop("student") or "", option_values.pop("student_id") or ""
    path, form, notes = option_values.pop("notes"), option_values.pop("answers"), ""
    if path is not None:
        from px4fuse.report.notes import parse  # imported here, as it is slow

        notes = read_text(path, SettingsError, MAX_NOTES_BYTES, name=f"--notes {path}")
        parse(notes, f"--notes {path}")  # report errors before the analysis
    answers = UNSET if form is None else read_answers(form)
    person = Student(replace_unencodable(name), replace_unencodable(student_id), notes, answers)
    _warn_missing_fonts(person.name + person.id + person.notes)
    return person


def _warn_missing_fonts(text: str) -> None:
    """Warn before the analysis if no installed font has a character of the text."""
    if text.isascii():
        return
    from px4fuse.report.fonts import font_advice, missing_characters

    if characters := missing_characters(text):
        click.echo(f"px4fuse: {font_advice(characters)}", err=True)


def replace_unencodable(text: str) -> str:
    """Replace bytes of a command line that are not valid text."""
    return text.encode(errors="replace").decode()
