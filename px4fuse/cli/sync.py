"""Command ``px4fuse sync``: estimates the time offset between position source and IMU."""

from pathlib import Path
from typing import Any

import click

from .options import analysis_options, comparison_request, json_option, log_argument
from .outputs import make_result_files, progress, write_and_print_results


@click.command()
@log_argument
@analysis_options
@json_option
def sync(log: Path, json_path: Path | None, **option_values: Any) -> None:
    """Estimate the time offset between position source and IMU.

    Estimates the time (s) to add to the timestamps of the position source, with a 95 % interval,
    from the IMU and the positions (EKF2's attitude is not used). LOG is a PX4 ULog or a MAVLink
    recording.
    """
    from px4fuse.comparison.estimates import estimate_noises_and_time_offset
    from px4fuse.comparison.reruns import rerun_kf_with_time_offset
    from px4fuse.diagnose import prepare_comparison, read_flight
    from px4fuse.errors import MissingDataError
    from px4fuse.flight.model import Unavailable
    from px4fuse.report.clock import make_time_offset_advice
    from px4fuse.report.page import Page
    from px4fuse.results.build import make_sync_results

    request = comparison_request(log, option_values)
    with progress(json_path) as show_progress:
        comparison = prepare_comparison(read_flight(request, show_progress), request, show_progress)
        _, time_offset = estimate_noises_and_time_offset(comparison, show_progress)
        rerun = None
        if not isinstance(time_offset, Unavailable) and time_offset.is_significant(
            time_offset.remaining_s
        ):
            rerun = rerun_kf_with_time_offset(comparison, time_offset)
    advice = make_time_offset_advice(comparison, time_offset, rerun)
    if isinstance(time_offset, Unavailable) or not time_offset.is_determinable:
        remedy = time_offset.remedy if isinstance(time_offset, Unavailable) else advice["Action"]
        raise MissingDataError(
            f"{comparison.flight.log.name}: the time offset cannot be estimated: "
            f"{time_offset.reason}",
            remedy,
        )
    results = make_sync_results(request, comparison, time_offset)
    page = Page()
    page.write(comparison.flight.log.name, bold=True)
    page.write_labelled_texts(advice)
    write_and_print_results(make_result_files(results, json_path), page, request)
