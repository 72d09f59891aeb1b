"""Report page on the time offset of the position source."""

from collections.abc import Iterable, Iterator

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import PreparedComparison
from px4fuse.comparison.remedy import (
    describe_delay_limit,
    estimate_delay_if_not_as_logged_ms,
    find_aid,
    find_delay_max_change,
    find_logged_delay_ms,
    format_changes,
)
from px4fuse.comparison.rerun_effects import Rerun
from px4fuse.convention.correction import find_convention_faults
from px4fuse.core.text import format_metres
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.finding import Finding
from px4fuse.findings.source_clock import (
    compute_clock_offset_option_s,
    find_offset_rerun,
    truth_refutes_offset,
)
from px4fuse.flight.model import Unavailable
from px4fuse.results.contract import ComparisonResults

from .page import Page, draw_legend_above
from .style import KF_BAND_COLOUR, TRACK_STYLES, Axes

CURVE_HEIGHT = 170.0  # points
# Range of the log-likelihood curve on each side of the estimated time offset ÷ width of its 95 %
# interval
CURVE_TO_INTERVAL_RATIO = 1.25
# Faults for which the report has a page on the time offset
TIME_OFFSET_FINDINGS = ("source_time_offset_changes", "source_time_offset", "ekf2_ev_delay_wrong")


def summarise_offset(analysis: Analysis, findings: Iterable[Finding]) -> str:
    """Summarise the time offset of the position source in one line.

    Return "" if the report has a page on the time offset.
    """
    if has_time_offset_page(analysis, findings):
        return ""
    advice_by_label = make_time_offset_advice(
        analysis, analysis.time_offset, find_offset_rerun(analysis)
    )
    return f"{advice_by_label.get('Result', '')} {advice_by_label['Offset']}".lstrip()


def has_time_offset_page(analysis: Analysis, findings: Iterable[Finding]) -> bool:
    """Return True if the report needs a page on the time offset of the position source.

    The page is drawn if the time offset is a fault (TIME_OFFSET_FINDINGS), or is not determinable.
    """
    time_offset = analysis.time_offset
    if isinstance(time_offset, Unavailable):
        return False
    return not time_offset.is_determinable or any(
        finding.id in TIME_OFFSET_FINDINGS for finding in findings
    )


def make_time_offset_advice(
    comparison: PreparedComparison,
    time_offset: SourceTimeOffset | Unavailable,
    rerun: Rerun | None = None,
) -> dict[str, str]:
    """Return sentences on the time offset of the source, by their label in the report.

    "Offset" is always present. ``rerun`` is a re-run of KF with the time offset.
    """
    if isinstance(time_offset, Unavailable):
        reason, remedy = time_offset.reason, time_offset.remedy
        return {"Offset": f"The time offset cannot be estimated: {reason}. {remedy}"}
    if not time_offset.is_determinable:
        return {
            "Offset": f"The time offset cannot be estimated: {time_offset.reason}.",
            "Action": "Fly passes of 5 m or more, and stop after each pass.",
        }
    offset_s, (low_offset_s, high_offset_s) = time_offset.offset_s, time_offset.interval_s
    offset_text = f"{offset_s:+.3f} s (95 % {low_offset_s:+.3f} to {high_offset_s:+.3f} s)"
    estimate_sentence = f"The estimated time offset is {offset_text}."
    if rerun is not None and truth_refutes_offset(rerun):
        return {
            "Result": (
                "Ground truth refutes the estimated time offset. A re-run with this offset "
                "increases KF's position RMSE from "
                f"{format_metres(rerun.before.position_rmse_m or 0.0)} to "
                f"{format_metres(rerun.after.position_rmse_m or 0.0)} m."
            ),
            "Offset": estimate_sentence,
            "Action": "Check the timestamps of the ground truth, not of the positions.",
        }
    # Only "Result", "Offset" and "Re-run" depend on the significance of the time offset, and only a
    # significant time offset has a "Re-run"
    advice_by_label = {
        "Result": "The position source has no significant time offset.",
        "Offset": estimate_sentence,
    }
    if time_offset.is_significant(offset_s):
        late_or_early = "late" if offset_s < 0.0 else "early"
        suggested_offset_s = compute_clock_offset_option_s(comparison, time_offset)
        advice_by_label = {
            "Result": f"The position timestamps are {abs(offset_s):.3f} s {late_or_early}.",
            "Offset": f"Add {offset_text} to the timestamps of the position source.",
            "Re-run": "Run again with corrected timestamps: px4fuse compare LOG "
            f"--clock-offset {suggested_offset_s:.3f}",
        }
    elif not low_offset_s <= 0.0 <= high_offset_s:
        advice_by_label["Result"] = (
            "The time offset is too small for a correction: the limit is "
            f"{time_offset.min_significant_offset_s:.3f} s."
        )
    if (logged_delay_ms := find_logged_delay_ms(comparison)) is not None:
        advice_by_label["PX4"] = _format_delay_advice(comparison, time_offset, logged_delay_ms)
    if time_offset.has_changed():
        part_offsets_text = ", ".join(
            f"{part.offset_s:+.2f} s from {part.start_s:.0f} s" for part in time_offset.parts
        )
        advice_by_label["Changes"] = (
            f"The time offset changes during the flight: {part_offsets_text}."
        )
    faults = find_convention_faults(
        comparison.convention, comparison.flight, comparison.source.frame
    )
    if clock_drift := faults.clock_drift:
        advice_by_label["Drift"] = (
            f"The clock of the timestamps is {abs(100.0 * clock_drift):.1f} % "
            f"{'fast' if clock_drift > 0.0 else 'slow'}, so the time offset changes. 'Offset' is "
            "the time offset in the middle of the data."
        )
    elif time_offset.drift_ppm is not None and time_offset.drift_sigma_ppm is not None:
        half_width_ppm = 1.96 * time_offset.drift_sigma_ppm
        is_significant = abs(time_offset.drift_ppm) >= half_width_ppm
        advice_by_label["Drift"] = (
            f"The clock of the source drifts by {time_offset.drift_ppm:+.0f} ± "
            f"{half_width_ppm:.0f} ppm (95 %){'' if is_significant else ', not significant'}."
        )
    return advice_by_label


def _format_delay_advice(
    comparison: PreparedComparison, time_offset: SourceTimeOffset, logged_delay_ms: float
) -> str:
    """Return advice on EKF2's delay parameter of the position source."""
    delay_parameter = find_aid(comparison).delay
    fitted_delay_ms = estimate_delay_if_not_as_logged_ms(comparison, time_offset, logged_delay_ms)
    if fitted_delay_ms is None:
        return f"{delay_parameter} {logged_delay_ms:g} ms agrees with the estimated time offset."
    text = (
        f"Set {delay_parameter} to {max(fitted_delay_ms, 0.0):.0f} ms (now {logged_delay_ms:g} "
        "ms), or correct the sender's clock."
    )
    if limit_text := describe_delay_limit(delay_parameter, fitted_delay_ms, logged_delay_ms):
        text = (
            f"The maximum-likelihood {delay_parameter} is {fitted_delay_ms:.0f} ms, but "
            f"{delay_parameter} cannot {limit_text}. Correct the sender's clock."
        )
    if delay_max_change := find_delay_max_change(comparison, fitted_delay_ms):
        text += f" Also set {format_changes(delay_max_change)}."
    return text


def draw_pages(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the page on a wrong or unknown time offset of the position source."""
    time_offset = analysis.time_offset
    if isinstance(time_offset, Unavailable) or not has_time_offset_page(analysis, results.findings):
        return
    page = Page(
        "Appendix: time offset of the position source",
        "Late or early timestamps hardly change the innovations, because the filter "
        "follows the positions. px4fuse estimates the time offset by maximum likelihood, together "
        "with sensor biases, attitude errors and noise levels.",
    )
    page.write_labelled_texts(make_time_offset_advice(analysis, time_offset))
    caption = (
        f"Likelihood of the time offset from {time_offset.count} measurements. The 95 % interval "
        "includes the IMU noise, but the curve does not."
    )
    title = "Decrease of the log-likelihood below its maximum (nats)"
    _draw_likelihood(page.add_panel(title, CURVE_HEIGHT, caption=caption), time_offset)
    yield page


def _draw_likelihood(axes: Axes, time_offset: SourceTimeOffset) -> None:
    """Draw the log-likelihood of the positions over the time offset."""
    low_s, high_s = time_offset.interval_s
    offsets_s, log_likelihood_drops = (
        time_offset.likelihood_curve_offsets_s,
        time_offset.curve_log_likelihood_drops,
    )
    is_near = np.abs(offsets_s - time_offset.offset_s) <= CURVE_TO_INTERVAL_RATIO * (high_s - low_s)
    axes.axvspan(low_s, high_s, color=KF_BAND_COLOUR, lw=0, label="95 % interval")
    axes.plot(offsets_s[is_near], log_likelihood_drops[is_near], **TRACK_STYLES["KF"])
    axes.axvline(time_offset.applied_s, color="black", lw=0.8, ls="--", label="as analysed")
    axes.set_ylim(1.05 * log_likelihood_drops[is_near].max(), 0.0)
    axes.set_xlabel("offset added to the source's timestamps (s)")
    draw_legend_above(axes)
