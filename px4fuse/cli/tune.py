"""Command ``px4fuse tune``: estimates SIGMA_A and SIGMA_Z by maximum likelihood."""

from pathlib import Path
from typing import Any

import click

from px4fuse.core.record import Unavailable

from .options import analysis_options, comparison_request, json_option, log_argument
from .outputs import make_result_files, progress, write_and_print_results


@click.command()
@log_argument
@analysis_options
@json_option
def tune(log: Path, json_path: Path | None, **option_values: Any) -> None:
    """Estimate the process noise SIGMA_A and the measurement noise SIGMA_Z of KF.

    Prints the estimates for each axis with 95 % intervals, and compares them with --sigma-a and
    --sigma-z. LOG is a PX4 ULog or a MAVLink recording.
    """
    from px4fuse.comparison.estimates import estimate_noises
    from px4fuse.diagnose import prepare_comparison, read_flight
    from px4fuse.errors import MissingDataError
    from px4fuse.report.tuning import make_tuning_page
    from px4fuse.results.build import make_tuning_results

    request = comparison_request(log, option_values)
    with progress(json_path) as show_progress:
        comparison = prepare_comparison(read_flight(request, show_progress), request, show_progress)
        tunings = estimate_noises(comparison, progress=show_progress)
    unavailable = [tuning for tuning in tunings.values() if isinstance(tuning, Unavailable)]
    if len(unavailable) == len(tunings):
        raise MissingDataError(
            f"{comparison.flight.log.name}: SIGMA_A and SIGMA_Z cannot be estimated: "
            f"{unavailable[0].reason}",
            unavailable[0].remedy,
        )
    results = make_tuning_results(request, comparison, tunings)
    write_and_print_results(
        make_result_files(results, json_path), make_tuning_page(comparison, tunings), request
    )
