"""Command ``px4fuse sample``: writes the sample logs."""

from pathlib import Path

import click

from .options import output_option
from .outputs import write_and_print_results

SAMPLES_FOLDER = Path("sample_logs")
SAMPLE_LOG = "aisle_uwb.ulg"
INSTALL_COMMAND = 'pip install "px4fuse[samples]"'


def sample_log() -> Path:
    """Return the path of the sample log, in ./sample_logs or in the installed package.

    Raises
    ------
    MissingDataError
        The sample logs are not installed.
    """
    from importlib.resources import files

    from px4fuse.errors import MissingDataError

    path = SAMPLES_FOLDER / SAMPLE_LOG
    if not path.is_file():
        try:
            path = Path(str(files("px4fuse_samples") / SAMPLE_LOG))
        except ModuleNotFoundError:
            raise MissingDataError(
                "No log was given, and the sample logs are not installed.",
                f"Give the path of a log, or install the sample logs: {INSTALL_COMMAND}",
            ) from None
    click.echo(f"No log was given: the sample log {SAMPLE_LOG} is used.", err=True)
    return path


@click.command()
@output_option("DIR", "Folder to write the sample logs to.", default=SAMPLES_FOLDER)
def sample(output: Path) -> None:
    """Write the sample logs (aisle with UWB, loop with VIO) to a folder."""
    from importlib.resources import files

    from px4fuse.errors import MissingDataError, OutputError
    from px4fuse.report.page import Page
    from px4fuse.request import ComparisonRequest, command_line

    try:
        logs = [file for file in files("px4fuse_samples").iterdir() if file.is_file()]
    except ModuleNotFoundError:
        raise MissingDataError(
            "The sample logs are not installed", f"Run {INSTALL_COMMAND}."
        ) from None
    contents = {output / file.name: file.read_bytes() for file in sorted(logs, key=str)}
    for path, content in contents.items():
        if path.is_file() and path.read_bytes() != content:
            raise OutputError(
                f"{path} already exists with different contents. Move that "
                "file, or choose another folder (-o)."
            )
    first_log_path = next(path for path in contents if path.suffix == ".ulg")
    compare_command = command_line(
        ComparisonRequest(log=str(first_log_path)), "compare", for_shell=True
    )
    page = Page()
    page.add("command", text=compare_command, label="Run")
    write_and_print_results(contents, page)
