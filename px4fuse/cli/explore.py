"""``px4fuse explore``: the filter's knobs, on a page that replays the flight."""

from pathlib import Path
from typing import Any

import click

from px4fuse.cli import inputs, outputs
from px4fuse.cli.sample import sample_log
from px4fuse.request import settings_name


@click.command()
@click.argument("log", required=False, type=inputs.InputPath())
@inputs.analysis_options
@inputs.options("explore")
@inputs.open_option
def explore(log: Path | None, output: Path | None, **given: Any) -> None:
    """Write a web page with sliders for SIGMA_A, SIGMA_Z, DT and the clock offset.

    LOG is a PX4 ULog or a MAVLink recording; without one it is the sample flight. The page is one
    file that needs no network: it replays the filter in the browser at every move and shows what
    that does to innovations, variances and errors, one step at a time if you like, and takes you on
    a tour of the flight.
    """
    from px4fuse.analysis import run

    log = log or sample_log()
    request = inputs.comparison_request(log, given)
    target = outputs.web_page(output, Path("reports", f"{log.stem}{settings_name(request)}.html"))
    with outputs.progress(target) as step:
        analysis = run(request, step)
        step("writing the page")
        # Bokeh takes long to import, and bad input needs none of it
        from px4fuse.explore.page import html_text

        content = html_text(analysis).encode()
    outputs.finish({target: content})
