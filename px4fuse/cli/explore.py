"""``px4fuse explore``: the filter's knobs, on a page that replays the flight."""

from pathlib import Path
from typing import Any

import click

from px4fuse.cli import inputs, outputs
from px4fuse.cli.sample import sample_log
from px4fuse.errors import SettingsError
from px4fuse.request import settings_name


@click.command()
@click.argument("logs", nargs=-1, type=inputs.InputPath())
@inputs.analysis_options
@inputs.options("explore")
@inputs.open_option
def explore(logs: tuple[Path, ...], output: Path | None, **option_values: Any) -> None:
    """Write a web page with sliders for SIGMA_A, SIGMA_Z, DT and the clock offset.

    LOG is a PX4 ULog or a MAVLink recording; with two of them, both stand side by side; without one
    it is the sample flight. The page is one file that needs no network: it replays the filter in
    the browser at every move and shows what that does to innovations, variances and errors, one
    step at a time if you like, and takes you on a tour of the flight.
    """
    from px4fuse.analysis import run

    if len(logs) > 2:
        raise SettingsError(f"{len(logs)} logs: give one, or two to see them side by side.")
    if len(logs) == 2 and (
        option_values["mavlink"] is not None or option_values["position"] is not None
    ):
        raise SettingsError("--mavlink and --position belong to one log: give only one LOG.")
    logs = logs or (sample_log(),)
    requests = [inputs.comparison_request(log, dict(option_values)) for log in logs]
    stems = "_".join(log.stem for log in logs)
    target = outputs.web_page(output, Path("reports", f"{stems}{settings_name(requests[0])}.html"))
    with outputs.progress(target) as step:
        analyses = [run(request, step) for request in requests]
        step("writing the page")
        # Bokeh takes long to import, and bad input needs none of it
        from px4fuse.explore.page import html_text

        content = html_text(analyses).encode()
    outputs.write_and_print({target: content})
