"""What commands take: kinds of options, and those that several share.

A unit is not typed: who types it is told the number.
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
from px4fuse.units import NAMES, in_unit

if TYPE_CHECKING:
    from px4fuse.results.model import Student


def column_names(text: str) -> tuple[str, ...]:
    """Read names or numbers of columns, with commas between them."""
    return tuple(text.split(","))


Option = Callable[[Callable[..., None]], Callable[..., None]]


def _combine_options(*options: Option) -> Option:
    """Several options as one, in the order in which the help lists them."""

    def add(command: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


class NonEmptyPath(click.Path):
    """A file or folder; an empty name, which would be the current folder, is a slip."""

    def __init__(self, path_type: type[Path | str] = Path) -> None:
        super().__init__(path_type=path_type)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert what was typed."""
        if value == "":
            self.fail("the name is empty.", param, ctx)
        return super().convert(value, param, ctx)


class InputPath(NonEmptyPath):
    """A file or folder to read, which is registered before the command begins.

    A log may have a part of it after a colon, as ``LOG:vio``.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert what was typed."""
        path = super().convert(value, param, ctx)
        file, colon, _ = str(path).rpartition(":")
        add_input(Path(file) if colon and not Path(path).exists() else Path(path))
        return path


class TypedQuantity(click.ParamType["float | str"]):
    """A number in a unit.

    Parameters
    ----------
    unit : str
        One of :data:`px4fuse.units.NAMES`.
    example : float
        Shown where what was typed cannot be understood.
    auto : bool
        Also take the word ``auto``.
    """

    name = "number"

    def __init__(self, unit: str, example: float = 0.1, *, auto: bool = False) -> None:
        self.unit, self.example, self.auto = unit, example, auto

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Its unit, as the help shows what to type."""
        unit = "DEG" if self.unit == "°" else self.unit.upper() or "NUMBER"
        return f"{unit}|auto" if self.auto else unit

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert what was typed."""
        if self.auto and value == AUTO:
            return str(value)
        name = NAMES[self.unit]
        try:
            number = float(value)
        except ValueError:
            parsed = in_unit(value, self.unit)
            example_text = f"{self.example if parsed is None else parsed:.12g}"
            self.fail(
                f"{value!r}: give {name}, as {example_text}{', or auto' if self.auto else ''}.",
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
    """An option of the command below: what it takes and its default are its parameter's there.

    Parameters
    ----------
    typed : str
        As the help has it: "-o, --output FILE".
    meaning : str
        Its help.
    least, most : float, optional
        Of a number.
    name : str
        Of its parameter, where that is called otherwise.
    **more
        As click has them: what it takes where the command has no parameter of its name.
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
    """A row of ``options.toml``; as :func:`option` takes it."""

    typed: str
    meaning: str
    least: int | float | None = None
    most: int | float | None = None


_TABLES = table(__file__, "options.toml", dict[str, dict[str, _OptionRow]])


def options(title: str, **more: Mapping[str, Any]) -> Option:
    """The options of a table of ``options.toml``; of some more, as click has it."""
    return _combine_options(
        *(
            option(one.typed, one.meaning, one.least, one.most, name=name, **more.get(name, {}))
            for name, one in _TABLES[title].items()
        )
    )


def request_options(kind: type[Struct], options: Mapping[str, Declared]) -> Option:
    """The options of some fields of a request: what each takes and its default are the field's."""
    hints, defaults = get_type_hints(kind), {field.name: field for field in fields(kind)}
    return _combine_options(
        *(
            _declared_option(name, one, hints[name], defaults[name].default)
            for name, one in options.items()
            if one.meaning
        )
    )


def _declared_option(field: str, declared: Declared, hint: Any, default: Any) -> Option:
    """One of them; the parameters of a position file begin with what file they are about."""
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
    """What a parameter of a type takes: of a Literal one of its words, of a tuple several."""
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


# It says what this machine can take, not what is analysed, so it is no setting of the analysis
max_size_option = option(
    "--max-size MB",
    f"Largest log that is read.  [default: {max_log_bytes.get() // 1_000_000}]",
    1,
    expose_value=False,
    callback=_set_max_size,
)
#: The results, which stand beside a report where there is one
json_option = option(
    "--json FILE",
    "The results as JSON; - prints them alone on standard output. Without -o, no report is "
    "written then.  [default: beside the report, where there is one]",
    name="json_path",
)


def _open_flag(option_text: str, name: str) -> Option:
    """That what was written is to be opened; :func:`~px4fuse.cli.outputs.write_and_print` does."""
    return option(
        option_text,
        "Open what was written, in the program for it.",
        name=name,
        is_flag=True,
        expose_value=False,
        callback=lambda ctx, _, value: ctx.meta.update({OPEN_KEY: value}),
    )


#: Of every command that writes something to look at
open_option = _open_flag("--open, --show", "opened")
#: Of the command whose --open is of a loop that did not close
show_option = _open_flag("--show", "shown")
#: Whose report it is
person_options = options("person", notes={"type": InputPath()}, answers={"type": InputPath()})


def report_options(meaning: str) -> Option:
    """Of every command that makes a report: the PDF and its results."""
    return _combine_options(option("-o, --output FILE.pdf", meaning), json_option)


system_option = request_options(EvaluationRequest, {"system": OPTIONS["system"]})
_FILTER_GROUP = request_options(ComparisonRequest, FILTER_OPTIONS)
_CLOCK_GROUP = request_options(ComparisonRequest, CLOCK_OPTION)
#: Of commands that read a flight as it was recorded
flight_options = _combine_options(request_options(ComparisonRequest, RECORDINGS), max_size_option)
#: Which recordings of the flight are read, and how
recording_options = _combine_options(
    request_options(ComparisonRequest, RECORDINGS),
    request_options(PositionFile, POSITION_OPTIONS),
    _CLOCK_GROUP,
    max_size_option,
)
#: Of every command that runs the filter: settings, segment and recordings
analysis_options = _combine_options(_FILTER_GROUP, recording_options)
#: Of an analysis that hold for many logs: no other files of one flight
settings_options = _combine_options(_FILTER_GROUP, system_option, _CLOCK_GROUP, max_size_option)


def comparison_request(log: Path, option_values: dict[str, Any]) -> ComparisonRequest:
    """What :func:`recording_options`, or :func:`analysis_options` with them, gave as a request.

    Raises
    ------
    SettingsError
        An option is about a position file, and none is given.
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
    """What was typed of the running command, and not left at its default."""
    context = click.get_current_context()
    for parameter in context.command.params:
        if context.get_parameter_source(parameter.name or "") == ParameterSource.COMMANDLINE:
            yield parameter


def read_student(option_values: dict[str, Any]) -> Student:
    """Whose report it is, taken out of what :func:`person_options` gave.

    Raises
    ------
    SettingsError
        The notes or the answers cannot be read, or the notes cannot be drawn.
    """
    from msgspec import UNSET

    from px4fuse.answers import read_answers
    from px4fuse.results.model import MAX_NOTES_BYTES, Student

    name, student_id = option_values.pop("student") or "", option_values.pop("student_id") or ""
    path, form, notes = option_values.pop("notes"), option_values.pop("answers"), ""
    if path is not None:
        from px4fuse.report.notes import parse  # the report takes long to import

        notes = read_text(path, SettingsError, MAX_NOTES_BYTES, name=f"--notes {path}")
        parse(notes, f"--notes {path}")  # before the analysis
    answers = UNSET if form is None else read_answers(form)
    person = Student(replace_unencodable(name), replace_unencodable(student_id), notes, answers)
    _warn_missing_fonts(person.name + person.id + person.notes)
    return person


def _warn_missing_fonts(text: str) -> None:
    """Say before all work that the report will lack characters, and what to install."""
    if text.isascii():
        return
    from px4fuse.report.fonts import font_advice, missing_characters

    if characters := missing_characters(text):
        click.echo(f"px4fuse: {font_advice(characters)}", err=True)


def replace_unencodable(text: str) -> str:
    """Text without the stray bytes that a terminal may hand over."""
    return text.encode(errors="replace").decode()
