"""``px4fuse sample``: the sample flights, to try things on."""

from pathlib import Path

import click

from px4fuse.cli.inputs import options
from px4fuse.cli.outputs import write_and_print

FOLDER = Path("sample_logs")
SAMPLE = "aisle_uwb.ulg"
INSTALL = 'pip install "px4fuse[samples]"'


def sample_log() -> Path:
    """The sample flight where no log is given: here if it is here, else the installed one.

    Raises
    ------
    MissingDataError
        There is none.
    """
    from importlib.resources import as_file, files

    from px4fuse.errors import MissingDataError

    local_path = FOLDER / SAMPLE
    if local_path.is_file():
        sample_path = local_path
    else:
        try:
            with as_file(files("px4fuse_samples") / SAMPLE) as installed:
                sample_path = installed
        except ModuleNotFoundError:
            raise MissingDataError.of("no_sample", install=INSTALL) from None
    click.echo(f"No log was given: this is the sample flight, {SAMPLE}.", err=True)
    return sample_path


@click.command()
@options("sample")
def sample(output: Path = FOLDER) -> None:
    """Write the sample flights: an aisle with UWB, a loop on visual-inertial odometry."""
    from importlib.resources import files

    from px4fuse.errors import MissingDataError, OutputError
    from px4fuse.report.page import Page
    from px4fuse.request import ComparisonRequest, command_line

    try:
        flights = [one for one in files("px4fuse_samples").iterdir() if one.is_file()]
    except ModuleNotFoundError:
        raise MissingDataError("the sample flights are not installed", f"Run {INSTALL}.") from None
    contents = {output / one.name: one.read_bytes() for one in sorted(flights, key=str)}
    for path, content in contents.items():
        if path.is_file() and path.read_bytes() != content:
            raise OutputError.of("sample_there", path=path)
    first = next(path for path in contents if path.suffix == ".ulg")
    command = command_line(ComparisonRequest(log=str(first)), "compare", typed=True)
    page = Page()
    page.add("command", text=command, label="Next")
    write_and_print(contents, page)
