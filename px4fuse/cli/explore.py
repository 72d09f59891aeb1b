"""Command ``px4fuse explore``: writes a page with sliders that re-run KF in the browser."""

from pathlib import Path
from typing import Any

import click

from px4fuse.request import format_settings_suffix

from . import options, outputs
from .sample import sample_log


@click.command()
@click.argument("log", required=False, type=options.InputPath())
@options.analysis_options
@options.output_option("FILE.html", "Web page to write.  [default: reports/LOG.html]")
@options.open_option
def explore(log: Path | None, output: Path | None, **option_values: Any) -> None:
    """Write an interactive page with sliders for the filter settings.

    LOG is a PX4 ULog or a MAVLink recording; without LOG, the sample flight is used. Sliders for
    SIGMA_A, SIGMA_Z, DT and the clock offset re-run KF in the browser. Plots show innovations, σ
    and errors. A step view shows each prediction and update.
    The page is one file and needs no network.
    """
    from px4fuse.diagnose import diagnose

    log = log or sample_log()
    request = options.comparison_request(log, option_values)
    page_path = outputs.choose_web_page_path(
        output, Path("reports", f"{log.stem}{format_settings_suffix(request)}.html")
    )
    with outputs.progress(page_path) as show_progress:
        analysis = diagnose(request, show_progress)
        show_progress("writing the web page")
        # a slow import (Bokeh), which is not needed if the analysis fails
        from px4fuse.explore.page import make_analysis_page

        page = make_analysis_page(analysis)
        if output is None:
            outputs.check_default_page(page_path, page)
    outputs.write_and_print_results({page_path: page.encode()})
