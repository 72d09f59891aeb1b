"""Command ``px4fuse tune``: estimates SIGMA_A and SIGMA_Z by maximum likelihood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.options import InputPath, analysis_options, comparison_request, json_option
from px4fuse.cli.outputs import check_targets, progress, result_files, write_and_print
from px4fuse.core.record import Unavailable

if TYPE_CHECKING:
    from px4fuse.comparison.model import PreparedComparison
    from px4fuse.filter.tuning import AxisTuning
    from px4fuse.report.page import Page

TUNING_HEAD = (
    "axis",
    "SIGMA_A (m/s²)\nvalue, 95 %",
    "SIGMA_Z (m)\nvalue, 95 %",
    "log-likelihood\ngain (nats)",
    "gain on\n2nd half",
    "autocorrelation\nbefore, after",
)
TUNING_NOTE = (
    "The log-likelihood gain is the increase per measurement from the chosen settings to the "
    "estimates. For the gain on the 2nd half of the data, the noises are estimated on the first "
    "half. The autocorrelation of the innovations is at lag 1, with the chosen settings (before) "
    "and with the estimates (after)."
)


@click.command()
@click.argument("log", type=InputPath())
@analysis_options
@json_option
def tune(log: Path, json_path: Path | None, **option_values: Any) -> None:
    """Estimate SIGMA_A and SIGMA_Z by maximum likelihood.

    Prints the estimates for each axis with 95 % intervals, and compares them with --sigma-a and
    --sigma-z. LOG is a PX4 ULog or a MAVLink recording.
    """
    from px4fuse.comparison.estimates import tuned as tuned_noises
    from px4fuse.diagnose import prepare_comparison
    from px4fuse.errors import MissingDataError
    from px4fuse.results.build import tuning_results

    request = comparison_request(log, option_values)
    check_targets([json_path])
    with progress(json_path) as show_progress:
        comparison = prepare_comparison(request, show_progress)
        tunings = tuned_noises(comparison, progress=show_progress)
    missing_estimates = [
        noise_result for noise_result in tunings.values() if isinstance(noise_result, Unavailable)
    ]
    if len(missing_estimates) == len(tunings):
        name, reason = comparison.flight.log.name, missing_estimates[0].reason
        raise MissingDataError(
            f"{name}: SIGMA_A and SIGMA_Z cannot be estimated: {reason}",
            missing_estimates[0].remedy,
        )
    results = tuning_results(request, comparison, tunings)
    write_and_print(result_files(results, json_path), _tuning_page(comparison, tunings), request)


def _tuning_page(
    comparison: PreparedComparison, tunings: dict[str, AxisTuning | Unavailable]
) -> Page:
    from px4fuse.report.page import Page
    from px4fuse.report.phrases import format_noise_estimate, format_settings, tuning_advice
    from px4fuse.report.style import MUTED_COLOUR

    page, rows, sentences = Page(), [], list[str]()
    for name, tuning in tunings.items():
        if isinstance(tuning, Unavailable):
            sentences.append(f"{name}: {tuning.reason}. {tuning.remedy}")
            continue
        held_out_gain = correlation_text = ""
        if not isinstance(tuning.held_out, Unavailable):
            held_out_gain = f"{tuning.held_out.log_likelihood_gain_per_measurement:+.3f}"
        if not isinstance(tuning.before, Unavailable) and not isinstance(tuning.after, Unavailable):
            before, after = tuning.before.lag1_autocorrelation, tuning.after.lag1_autocorrelation
            correlation_text = f"{before:+.2f} {after:+.2f}"
        rows.append(
            [
                name,
                format_noise_estimate(tuning.sigma_a_two_state),
                format_noise_estimate(tuning.sigma_z),
                f"{tuning.log_likelihood_gain_per_measurement:.3f}",
                held_out_gain,
                correlation_text,
            ]
        )
    page.write_labelled("Chosen", format_settings(comparison.settings))
    if rows:
        page.table(TUNING_HEAD, rows, right_aligned_columns=(1, 2, 3, 4, 5))
        sentences.append(TUNING_NOTE)
    for text in sentences:
        page.write(text, colour=MUTED_COLOUR)
    page.write_labelled_texts(tuning_advice(comparison, tunings))
    return page
