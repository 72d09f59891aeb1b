"""``px4fuse sync``: the clock offset between position source and IMU."""

from pathlib import Path
from typing import Any

import click

from px4fuse.cli.inputs import InputPath, analysis_options, comparison_request, json_option
from px4fuse.cli.outputs import check_targets, finish, progress, result_files


@click.command()
@click.argument("log", type=InputPath())
@analysis_options
@json_option
def sync(log: Path, json_path: Path | None, **given: Any) -> None:
    """Estimate what must be added to the position source's time stamps, with its interval.

    From the acceleration that the IMU felt; EKF2 and its attitude are not asked. LOG is a PX4 ULog
    or a MAVLink recording.
    """
    from px4fuse.analysis import run_preparation
    from px4fuse.comparison.estimates import noises_and_clock
    from px4fuse.errors import MissingDataError
    from px4fuse.flight import Unavailable
    from px4fuse.report.clock import clock_advice
    from px4fuse.report.page import Page
    from px4fuse.results.build import sync_results

    request = comparison_request(log, given)
    check_targets([json_path])
    with progress(json_path) as step:
        compared = run_preparation(request, step)
        _, found = noises_and_clock(compared, step)
    advice = clock_advice(compared, found)
    if isinstance(found, Unavailable) or not found.determinable:
        name = compared.flight.log.name
        remedy = found.remedy if isinstance(found, Unavailable) else advice["Next"].capitalize()
        raise MissingDataError(
            f"{name}: no clock offset could be determined: {found.reason}", remedy
        )
    results = sync_results(request, compared, found)
    page = Page()
    page.advice(advice)
    finish(result_files(results, json_path), page, request)
