"""Command ``px4fuse mcp``: provides the other commands as tools of the Model Context Protocol."""

import gc
import io
import json
import os
import signal
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from types import UnionType
from typing import Any, get_args

import click

from px4fuse.core.reading import (
    check_readable,
    max_log_bytes,
    readable_folders,
    split_path_and_part,
)
from px4fuse.errors import SettingsError

from . import TERMINATION_SIGNALS, cli, find_command, help_text, options, outputs

# Arguments of MCP tools whose names differ from the parameters of the px4fuse commands
TOOL_ARGUMENT_BY_PARAMETER = {
    "finding": "finding_id",
    "source": "log",
}
# Parameters of px4fuse commands that the MCP tools do not have: output files, exit codes, and data
# of students
PARAMETERS_WITHOUT_TOOL_ARGUMENT = {
    "output",
    "json_path",
    "tum_path",
    "g2o_path",
    "fail_on",
    "checks",
    "student",
    "student_id",
    "notes",
    "answers",
}


@click.command()
@click.option(
    "--root",
    "roots",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    metavar="DIR",
    multiple=True,
    default=(".",),
    help="Folder that the tools may read, with its subfolders; repeatable.",
)
@click.option(
    "--out",
    "report_folder",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Folder for PDF reports.  [default: no file is written]",
)
@options.timeout_option
@options.memory_option
@options.max_size_option
def mcp(
    roots: tuple[Path, ...], report_folder: Path | None, timeout_s: float, memory_gb: float
) -> None:
    """Serve px4fuse to assistants (Model Context Protocol).

    A program with a language model starts this command, and exchanges messages with it on standard
    input and output. The tools of the server run other commands of px4fuse, for example compare.
    """
    if find_spec("mcp") is None:
        raise SettingsError(
            "px4fuse mcp requires the package mcp.", 'Run pip install "px4fuse[mcp]".'
        )
    from px4fuse.mcp.server import Server

    gc.enable()  # main() disables it for short commands, but the server runs for a long time
    for signal_number in TERMINATION_SIGNALS:
        # end the process; an exception would not end the thread that reads standard input
        signal.signal(signal_number, lambda number, _: os._exit(128 + number))
    folders = tuple(root.resolve() for root in roots)
    if report_folder is not None:
        report_folder = report_folder.resolve()
        report_folder.mkdir(parents=True, exist_ok=True)
    run = partial(run_command, folders, max_log_bytes.get(), report_folder)
    server = Server(make_tools(folders), run, timeout_s, int(memory_gb * 1e9))
    try:
        server.run()
    except* BrokenPipeError:  # the MCP client closed the pipe: end without an error
        pass


def run_command(
    folders: tuple[Path, ...],
    max_bytes: int,
    report_folder: Path | None,
    sender: Connection | None,
    command_words: Sequence[str],
) -> tuple[str, Any]:
    """Run a command in this process; return its terminal text, and its results (JSON) or None.

    For ``compare``, the second value is only the diagnosis (faults, causes and actions), which is
    the field ``card`` of the results.

    Parameters
    ----------
    folders : tuple of Path
        Folders from which files may be read.
    max_bytes : int
        Maximum size of a log (bytes).
    report_folder : Path or None
        Folder for reports; None: no report is written.
    sender : Connection or None
        Pipe to the process that shows the progress.
    command_words : sequence of str
        Command line without ``px4fuse``.
    """
    readable_folders.set(folders)
    max_log_bytes.set(max_bytes)
    # The command writes its report to reports/ in the current folder. Only worker processes, which
    # have a ``sender``, change their current folder: the server process writes no reports
    if report_folder and sender:
        os.chdir(report_folder)
    output, results_json_texts = io.StringIO(), list[str]()
    try:
        with redirect_stdout(output), redirect_stderr(io.StringIO()):
            # without a folder, the default of --json is standard output ("-"), so that the command
            # writes no report
            default_options = {command_words[0]: {"json_path": None if report_folder else "-"}}
            with cli.make_context(
                "px4fuse", [*command_words], default_map=default_options
            ) as context:
                # progress() sends messages, and make_result_files() adds the results to the list
                context.meta[outputs.SEND_PROGRESS_KEY] = sender and sender.send
                context.meta[outputs.RESULTS_KEY] = results_json_texts
                cli.invoke(context)
    except click.UsageError as error:
        raise SettingsError(error.format_message()) from error
    if not results_json_texts:
        return output.getvalue(), None
    results = json.loads(results_json_texts[0])
    return output.getvalue(), results["card"] if command_words[0] == "compare" else results


def make_tools(folders: tuple[Path, ...]) -> list[tuple[Any, Any]]:
    """Return each tool of the MCP server with the function that parses its arguments.

    The options of the px4fuse command give the input schema, its JSON results the output schema.
    """
    from mcp.types import Tool

    from px4fuse.card.model import DiagnosisCard
    from px4fuse.results import contract

    command_and_type_by_tool: dict[str, tuple[str, type | UnionType | None]] = {
        "info": ("info", dict),
        "diagnose": ("compare", DiagnosisCard),
        "what_if": ("whatif", contract.WhatIfResults),
        "estimate_noise": ("tune", contract.TuningResults),
        "estimate_time_offset": ("sync", contract.SyncResults),
        "evaluate": ("evaluate", contract.EvaluationResults),
        "close_loop": ("loop", contract.LoopResults | contract.GraphResults),
        "explain": ("explain", None),
        "list_findings": ("explain", None),
    }
    tools = []
    for name, (command_name, result_type) in command_and_type_by_tool.items():
        parameters = {} if name == "list_findings" else _list_parameters(command_name)
        output_schema = None
        if result_type is not None:
            schemas, definitions = contract.make_schemas_of_types(
                get_args(result_type) or (result_type,)
            )
            output_schema = {"type": "object", "anyOf": schemas, "$defs": definitions}
        input_schema = {
            "type": "object",
            "properties": {key: _make_schema(parameter) for key, parameter in parameters.items()},
            "required": [
                key
                for key, parameter in parameters.items()
                if isinstance(parameter, click.Argument)
            ],
            "additionalProperties": False,
        }
        tool = Tool(
            name=name,
            description=help_text(command_name) if parameters else "List the ids of all findings.",
            input_schema=input_schema,
            output_schema=output_schema,
        )
        tools.append((tool, partial(_parse_arguments, command_name, parameters, folders)))
    return tools


def _list_parameters(command_name: str) -> dict[str, click.Parameter]:
    """Return the parameters of a command, by the name of the argument of the MCP tool."""
    return {
        TOOL_ARGUMENT_BY_PARAMETER.get(name, name): parameter
        for parameter in find_command(command_name).params
        if parameter.expose_value
        and (name := str(parameter.name)) not in PARAMETERS_WITHOUT_TOOL_ARGUMENT
    }


def _make_schema(parameter: click.Parameter) -> dict[str, Any]:
    """Return the JSON Schema of the values that an option of a command accepts."""
    # Without another type below, the value is a text without null characters
    value_type, schema = parameter.type, dict[str, Any](type="string", pattern=r"^[^\x00]+$")
    if isinstance(value_type, click.Choice):
        schema = {"enum": [*value_type.choices]}
    elif isinstance(value_type, options.NumberWithUnit):
        number = {"type": "number"}
        schema = {"anyOf": [number, {"const": "auto"}]} if value_type.accepts_auto else number
    elif isinstance(value_type, click.IntRange):
        schema = {"type": "integer"}
    elif getattr(parameter, "is_flag", False):
        schema = {"type": "boolean"}
    elif parameter.metavar == "NAME=VALUE":
        return {"type": "object", "additionalProperties": {"type": "number"}}
    if parameter.multiple:
        schema = {"type": "array", "items": schema}
    return schema | {"description": getattr(parameter, "help", None) or ""}


def _parse_arguments(
    command_name: str,
    parameters: Mapping[str, click.Parameter],
    folders: Sequence[Path],
    arguments: Mapping[str, Any],
) -> list[str]:
    """Convert the arguments of an MCP tool call to those of a px4fuse command line.

    Raises
    ------
    LogError
        A file is outside ``folders``, the folders that the MCP server may access.
    """
    command_words, operands = [command_name], ["--"]
    for name, parameter in parameters.items():
        if name not in arguments:
            continue
        value, option = arguments[name], parameter.opts[-1]
        if value is False:
            continue
        if value is True:
            command_words.append(option)
            continue
        if isinstance(value, dict):  # NAME=VALUE of px4fuse whatif --set
            value = [f"{key}={number}" for key, number in value.items()]
        elif isinstance(parameter.type, options.InputPath):
            value = _find_file(value, folders)
        texts = value if isinstance(value, list) else [value]
        if isinstance(parameter, click.Argument):
            operands += texts
        else:
            command_words += [f"{option}={text}" for text in texts]
    return command_words + operands


def _find_file(file_argument: str, folders: Sequence[Path]) -> str:
    """Return the absolute path of ``FILE`` or ``FILE:PART`` in the first folder that contains it.

    Raises
    ------
    LogError
        The file is outside the folders.
    """
    paths = [str(folder / file_argument) for folder in folders]
    path = next((path for path in paths if split_path_and_part(path)[0].exists()), paths[0])
    check_readable(split_path_and_part(path)[0], folders)
    return path
