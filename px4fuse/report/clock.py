"""Texts and plot on the time offset of the position source."""

from collections.abc import Iterable, Iterator

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import PreparedComparison
from px4fuse.comparison.remedy import aid_of, delay_limit, delay_ms, wrong_delay_ms
from px4fuse.convention.correction import find_convention_faults
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.findings import Finding
from px4fuse.findings.source_clock import clock_offset_option_s
from px4fuse.flight.model import Unavailable
from px4fuse.report.page import Page, draw_legend_above
from px4fuse.report.style import KF_BAND_COLOUR, TRACK_LINES, Axes
from px4fuse.results.contract import ComparisonResults

CURVE_HEIGHT = 170.0  # height (points) of the axes of the log-likelihood
MAX_DRAWN_DROP_NATS = 12.0  # maximum drawn decrease (nats) of the log-likelihood from its maximum
# Ratio of the plotted range of the time offset to its 95 % interval
PLOT_WIDTH_IN_INTERVALS = 2.5
# Findings for which the report has an appendix on the time offset
CLOCK_FINDINGS = ("source_time_offset_changes", "source_time_offset", "ekf2_ev_delay_wrong")


def summarise_offset(analysis: Analysis, findings: Iterable[Finding]) -> str:
    """Summarise the time offset of the position source in one line."""
    if has_clock_page(analysis, findings):
        return "The appendix on the time offset contains the estimate."
    advice_by_label = clock_advice(analysis, analysis.clock)
    return " ".join(
        advice_by_label[label] for label in ("Result", "Offset") if label in advice_by_label
    )


def has_clock_page(analysis: Analysis, findings: Iterable[Finding]) -> bool:
    """Return True if the time offset is wrong, changes, or cannot be estimated."""
    clock = analysis.clock
    if isinstance(clock, Unavailable):
        return False
    return not clock.is_determinable or any(finding.id in CLOCK_FINDINGS for finding in findings)


def clock_advice(
    comparison: PreparedComparison, clock: ClockOffset | Unavailable
) -> dict[str, str]:
    """Return sentences on the time offset of the position source, by label such as "Action"."""
    if isinstance(clock, Unavailable):
        return {"Offset": f"The time offset cannot be estimated: {clock.reason}. {clock.remedy}"}
    if not clock.is_determinable:
        return {
            "Offset": f"The time offset cannot be estimated: {clock.reason}.",
            "Action": "Fly passes of 5 m or more, and stop after each pass.",
        }
    offset_s, (low_s, high_s) = clock.offset_s, clock.interval_s
    advice_by_label = {
        "Result": "The position source has no significant time offset.",
        "Offset": (
            f"Add {offset_s:+.3f} s (95 % {low_s:+.3f} to {high_s:+.3f} s) to the timestamps of "
            "the position source."
        ),
    }
    if clock.is_significant(offset_s):
        late_or_early = "late" if offset_s < 0.0 else "early"
        advice_by_label["Result"] = (
            f"The position timestamps are {abs(offset_s):.3f} s {late_or_early}."
        )
        new_option_s = clock_offset_option_s(comparison, clock)
        advice_by_label["Re-run"] = f"px4fuse compare LOG --clock-offset {new_option_s:.3f}"
    if (logged_ms := delay_ms(comparison)) is not None:
        advice_by_label["PX4"] = _delay_advice(comparison, clock, logged_ms)
    if clock.has_changed():
        offset_texts = ", ".join(
            f"{part.offset_s:+.2f} s from {part.start_s:.0f} s" for part in clock.parts
        )
        advice_by_label["Changes"] = f"The offset changes during the flight: {offset_texts}."
    faults = find_convention_faults(
        comparison.convention, comparison.flight, comparison.source.frame
    )
    if clock_drift := faults.clock_drift:
        advice_by_label["Drift"] = (
            f"The clock of the timestamps is {abs(100.0 * clock_drift):.1f} % "
            f"{'fast' if clock_drift > 0.0 else 'slow'}. The offset applies to the middle of the "
            "data."
        )
    elif clock.drift_ppm is not None and clock.drift_sigma_ppm is not None:
        half_width_ppm = 1.96 * clock.drift_sigma_ppm
        significance_text = ", not significant" if abs(clock.drift_ppm) < half_width_ppm else ""
        advice_by_label["Drift"] = (
            f"The clock of the source drifts by {clock.drift_ppm:+.0f} ± {half_width_ppm:.0f} ppm "
            f"(95 %){significance_text}."
        )
    return advice_by_label


def _delay_advice(comparison: PreparedComparison, clock: ClockOffset, logged_ms: float) -> str:
    name, fitted_delay_ms = aid_of(comparison).delay, wrong_delay_ms(comparison, clock, logged_ms)
    if fitted_delay_ms is None:
        return f"{name} {logged_ms:g} ms agrees with the estimate."
    if limit_text := delay_limit(name, fitted_delay_ms, logged_ms):
        return (
            f"The maximum-likelihood {name} is {fitted_delay_ms:.0f} ms, but {name} cannot "
            f"{limit_text}. Correct the sender's clock."
        )
    return (
        f"Set {name} to {max(fitted_delay_ms, 0.0):.0f} ms (now {logged_ms:g} ms), or correct the "
        "sender's clock."
    )


def draw_pages(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the appendix on a wrong or unknown time offset of the position source."""
    clock = analysis.clock
    if isinstance(clock, Unavailable) or not has_clock_page(analysis, results.findings):
        return
    page = Page(
        "Appendix: time offset of the position source",
        "Late or early timestamps hardly change the innovations, because the filter "
        "follows the positions. px4fuse maximises the likelihood of the positions over the "
        "time offset, together with sensor biases, attitude errors and noises. The attitude "
        "is from the gyros, because the same positions have corrected EKF2's attitude.",
    )
    page.write_labelled_texts(clock_advice(analysis, clock))
    (low, high), estimate_s = clock.interval_s, clock.offset_s
    curve_sentence = (
        f"The log-likelihood of {clock.count} measurements has its maximum at {estimate_s:+.3f} "
        f"s; 95 % interval {low:+.3f} to {high:+.3f} s. The interval also includes the IMU noise, "
        "so it is wider than the curve shows."
    )
    title = "Log-likelihood relative to its maximum (nats, downwards)"
    draw_offset_likelihood(
        page.panel(title, CURVE_HEIGHT, caption=curve_sentence, above=14.0), clock
    )
    yield page


def draw_offset_likelihood(axes: Axes, clock: ClockOffset) -> None:
    """Draw the log-likelihood of the positions over the time offset, with the 95 % interval."""
    (low_s, high_s), estimate_s, applied_s = clock.interval_s, clock.offset_s, clock.applied_s
    axes.axvspan(low_s, high_s, color=KF_BAND_COLOUR, lw=0, label="95 % interval")
    axes.plot(clock.curve_s, clock.curve_log_likelihood_drop, **TRACK_LINES["KF"])
    axes.axvline(applied_s, color="black", lw=0.8, ls="--", label="as analysed")
    axes.set_ylim(
        min(MAX_DRAWN_DROP_NATS, float(clock.curve_log_likelihood_drop.max()) * 1.05), 0.0
    )
    half_width_s = PLOT_WIDTH_IN_INTERVALS * max(high_s - estimate_s, estimate_s - low_s)
    margin_s = 0.1 * half_width_s
    axes.set_xlim(
        min(max(estimate_s - half_width_s, clock.curve_s[0]), applied_s - margin_s),
        max(min(estimate_s + half_width_s, clock.curve_s[-1]), applied_s + margin_s),
    )
    axes.set_xlabel("offset added to the source's timestamps (s)")
    draw_legend_above(axes)
