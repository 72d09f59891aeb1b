"""Terminal output of ``px4fuse tune``: estimated noises of KF."""

from px4fuse.comparison.model import PreparedComparison
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight.model import Unavailable
from px4fuse.report.page import Page
from px4fuse.report.phrases import format_noise_estimate, format_settings, make_tuning_advice

TUNING_HEAD = (
    "axis",
    "SIGMA_A (m/s²)\nestimate (95 %)",
    "SIGMA_Z (m)\nestimate (95 %)",
    "log-likelihood\ngain (nats per\nmeasurement)",
    "log-likelihood\ngain, 2nd half\nof the data",
    "autocorrelation\nof innovations\n(lag 1), before\nand after tuning",
)
TUNING_NOTE = "Gain on the 2nd half: with SIGMA_A and SIGMA_Z estimated on the 1st half."


def make_tuning_page(
    comparison: PreparedComparison, tunings: dict[str, AxisTuning | Unavailable]
) -> Page:
    """Make a page on the estimates of SIGMA_A and SIGMA_Z along each axis."""
    page, rows, sentences = Page(), [], list[str]()
    for name, tuning in tunings.items():
        if isinstance(tuning, Unavailable):
            sentences.append(f"{name}: {tuning.reason}. {tuning.remedy}")
            continue
        held_out_gain_text = correlation_text = ""
        if not isinstance(tuning.held_out, Unavailable):
            held_out_gain_text = f"{tuning.held_out.log_likelihood_gain_per_measurement:+.3f}"
        if not isinstance(tuning.before, Unavailable) and not isinstance(tuning.after, Unavailable):
            before, after = tuning.before.lag1_autocorrelation, tuning.after.lag1_autocorrelation
            correlation_text = f"{before:+.2f} {after:+.2f}"
        rows.append(
            [
                name,
                format_noise_estimate(tuning.sigma_a_two_state),
                format_noise_estimate(tuning.sigma_z),
                f"{tuning.log_likelihood_gain_per_measurement:.3f}",
                held_out_gain_text,
                correlation_text,
            ]
        )
    page.write_labelled("Chosen", format_settings(comparison.settings))
    if rows:
        page.add_table(TUNING_HEAD, rows, right_aligned_columns=(1, 2, 3, 4, 5))
        sentences.append(TUNING_NOTE)
    for text in sentences:
        page.write_small_text(text)
    page.write_labelled_texts(make_tuning_advice(comparison, tunings))
    return page
