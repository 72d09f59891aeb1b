"""Command ``px4fuse info``: lists the contents of a log and the possible analyses."""

from pathlib import Path
from typing import Any

import click

from .options import (
    comparison_request,
    flag_option,
    flight_options,
    json_option,
    log_argument,
)
from .outputs import make_result_files, progress, write_and_print_results


def _print_versions(context: click.Context, _: click.Parameter, is_requested: bool) -> None:
    """Print the versions of px4fuse, Python and libraries, and end the command (``--versions``)."""
    if not is_requested:
        return
    import platform

    from px4fuse.results.model import provenance

    versions = provenance("")
    click.echo(f"px4fuse {versions.px4fuse}, Python {versions.python}, {platform.platform()}")
    click.echo(", ".join(map(" ".join, versions.libraries.items())))
    context.exit()


@click.command()
@log_argument
@flag_option(
    "--versions",
    is_eager=True,
    expose_value=False,
    callback=_print_versions,
    help="Print the versions of px4fuse, system and libraries, and exit.",
)
@json_option
@flight_options
def info(log: Path, json_path: Path | None, **option_values: Any) -> None:
    """List the contents of a log and which analyses are possible.

    Lists topics, rates (Hz) and gaps, the possible analyses, the reasons why other analyses are
    not possible, and settings to log the missing data on the next flight.
    """
    from px4fuse.diagnose import read_flight
    from px4fuse.info.inventory import list_log_contents, to_json_dict
    from px4fuse.report.inventory import make_log_page

    request = comparison_request(log, option_values)
    with progress(json_path) as show_progress:
        flight = read_flight(request, show_progress)
        show_progress("reading the contents of the log")
        inventory = list_log_contents(flight)
    contents = make_result_files(to_json_dict(inventory), json_path)
    write_and_print_results(contents, make_log_page(inventory, request))
