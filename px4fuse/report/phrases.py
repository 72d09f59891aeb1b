"""Texts of both terminal output and PDF report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from px4fuse.comparison.model import (
    FILTER_NAMES,
    AxisComparison,
    Comparison,
    FilterSummary,
    UntestedFilter,
)
from px4fuse.core.text import capitalise_first_letter, format_factor, format_number
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.settings import KF_NUMERIC_SETTINGS, SETTING_RANGES, Settings
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.finding import Finding, format_spans
from px4fuse.findings.model import finding_title, split_cause_groups
from px4fuse.flight.model import Alignment, ClockConversion, Unavailable

from .page import Cell, Page, styled_text
from .style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS

if TYPE_CHECKING:
    from px4fuse.analysis import Analysis

# Minimum p value (Ljung-Box test) of white innovations; small, because a flight has eight tests
MIN_WHITENESS_P_VALUE = 0.001
VERDICT_LEGEND = (
    "A filter is consistent if √(mean NIS) is 0.8 to 1.25, or if the mean NIS is inside the 95 % "
    "band."
)
SIGMA_ERROR_TEXTS = {"underconfident": "too large", "overconfident": "too small"}


def format_settings(settings: Settings) -> str:
    """Format noises, DT, acceleration input and clock offset of KF as one line."""
    offset_text = (
        f", clock offset {settings.clock_offset_s:+g} s" if settings.clock_offset_s else ""
    )
    setting_texts = (
        SETTING_RANGES[name].format_value(getattr(settings, name)) for name in KF_NUMERIC_SETTINGS
    )
    return f"{', '.join(setting_texts)}, acceleration input {settings.input}{offset_text}"


def format_sigma_verdict(verdict: str, factor: float) -> str:
    """Format the result of a consistency test with the factor between reported and actual σ.

    >>> format_sigma_verdict("overconfident", 2.41)
    'overconfident, σ 2.4× too small'
    """
    if verdict not in SIGMA_ERROR_TEXTS:
        return verdict
    return f"{verdict}, σ {format_factor(factor)}× {SIGMA_ERROR_TEXTS[verdict]}"


def get_statistics_by_filter(result: AxisComparison) -> dict[str, FilterSummary | UntestedFilter]:
    """Return the consistency statistics of each filter, of EKF2 only if it is logged."""
    return {
        FILTER_NAMES[name]: statistics
        for name, statistics in result.filters.items()
        if not isinstance(result.tracks[name].state, Unavailable)
    }


VERDICT_TABLE_HEAD = ("axis", "filter", "mean NIS", "95 % band", "verdict")


def make_verdict_row(result: AxisComparison, name: str) -> list[Cell]:
    """Return the table row on the consistency of a filter along an axis."""
    consistency = get_statistics_by_filter(result)[name]
    label = result.axis.label.removeprefix("the axis of ")
    if isinstance(consistency, Unavailable):
        return [label, name, "", "", ("not evaluated", MUTED_COLOUR)]
    is_consistent = consistency.verdict == "consistent"
    colour = GOOD_COLOUR if is_consistent else SEVERITY_COLOURS["warning"]
    band_text = "{:.2f} – {:.2f}".format(*consistency.nis_band)
    verdict_text = format_sigma_verdict(consistency.verdict, consistency.sigma_error_factor)
    return [label, name, format_number(consistency.nis_mean), band_text, (verdict_text, colour)]


def write_error_table(page: Page, analysis: Analysis) -> None:
    """Write a table of consistency tests and position errors of KF and EKF2."""
    rows = []
    for result in (analysis.main, *analysis.select_secondary_axes()):
        for name, consistency in get_statistics_by_filter(result).items():
            difference = result.difference if name == "KF" else None
            cells = [
                _format_rms(difference, "position_rms_m"),
                _format_rms(difference, "velocity_rms_m_s"),
                _format_rms(consistency.truth, "position_rmse_m"),
                _format_rms(consistency.truth, "velocity_rmse_m_s"),
            ]
            rows.append([*make_verdict_row(result, name), *cells])
    head = [*VERDICT_TABLE_HEAD, "KF-EKF2 (m)", "(m/s)", "RMSE (m)", "(m/s)"]
    page.add_table(head, rows, right_aligned_columns=(2, 3, 5, 6, 7, 8))


def _format_rms(statistic: object, field: str) -> str:
    value = getattr(statistic, field, None)
    return "" if value is None else f"{value:.3f}"


def list_verdict_warnings(comparison: Comparison) -> list[str]:
    """Return warnings about the consistency tests of KF and EKF2."""
    notes = []
    if comparison.source.origin.may_drift:
        notes.append(
            "The position source may drift. The verdicts compare each filter with the source, "
            "not with the true position. Check the error with ground truth or a loop closure."
        )
    autocorrelated_innovation_texts = [
        f"{filter_name} along {result.axis.label}, lag-1 autocorrelation "
        f"{consistency.lag1_autocorrelation:+.2f}"
        for result in comparison.axes.values()
        for filter_name, consistency in get_statistics_by_filter(result).items()
        if isinstance(consistency, Consistency)
        and consistency.verdict == "consistent"
        and consistency.ljung_box_p < MIN_WHITENESS_P_VALUE
    ]
    if autocorrelated_innovation_texts:
        notes.append(
            "Innovations are not white, although their variance is consistent (Ljung-Box test, p "
            f"< {MIN_WHITENESS_P_VALUE:g}): {'; '.join(autocorrelated_innovation_texts)}. Positive "
            "autocorrelation: the filter lags, so SIGMA_A may be too small. Negative "
            "autocorrelation: the filter follows measurement noise, so SIGMA_A may be too large."
        )
    return notes


def format_clock_map(clock: ClockConversion) -> str:
    """Describe the conversion of a clock to the boot clock: offset, drift and jitter."""
    # These timestamps are boot times, or they cannot be converted (arrival times, few distinct
    # values). The note describes them, because they have no offset and no drift
    if clock.method in ("boot clock", "arrival time") or clock.distinct_stamps is not None:
        return f"{clock.clock}: {clock.note}"
    return (
        f"{clock.clock}, mapped by {clock.method}: offset {clock.offset_s:+.4f} s, drift "
        f"{clock.drift_ppm:+.3g} ppm, jitter {clock.jitter_s * 1000.0:.2g} ms, {clock.pairs} pairs"
    ) + (f"; {clock.note}" if clock.note else "")


def describe_alignment(alignment: Alignment) -> dict[str, str]:
    """Describe the alignment of a position file with the flight, by label."""
    yaw_text, clock_text = f"{alignment.yaw_deg:.2f}°", f"{alignment.clock_offset_s:+.3f} s"
    if alignment.yaw_sigma_deg is not None:
        yaw_text += f" ± {alignment.yaw_sigma_deg:.2f}°"
    if alignment.clock_offset_sigma_s is not None:
        clock_text += f" ± {alignment.clock_offset_sigma_s:.3f} s"
    text_by_label = {
        "frame": f"{alignment.frame} ({alignment.frame_reason})",
        "yaw": f"{yaw_text} ({alignment.yaw_reason})",
        "origin": "north {:.3f} m, east {:.3f} m, down {:.3f} m".format(*alignment.origin_m),
        "clock": f"offset {clock_text} from the boot clock ({alignment.clock_reason})",
    }
    if alignment.correlation is not None:
        text_by_label["match"] = (
            f"correlation {alignment.correlation:.4f} with {alignment.reference}"
        )
        if alignment.residual_rms_m is not None:
            text_by_label["match"] += f", residual {alignment.residual_rms_m:.3f} m RMS per axis"
    return text_by_label


def write_findings(page: Page, findings: tuple[Finding, ...]) -> None:
    """Write the findings (detected faults), each with its action and its consequences."""
    for finding, *effects in split_cause_groups(findings):
        title = f"{capitalise_first_letter(finding_title(finding.id))} [{finding.id}]"
        texts = [styled_text(title, bold=True), styled_text(finding.message)]
        if finding.remedy:
            texts.append(styled_text(f"Action: {finding.remedy}", colour=MUTED_COLOUR))
        if effects:
            consequences_text = " ".join(f"{effect.title} [{effect.id}]." for effect in effects)
            texts.append(styled_text(f"Consequences: {consequences_text}", colour=MUTED_COLOUR))
        page.write_labelled_text(
            f"{finding.severity}\n{format_spans(finding.spans_s)}".strip(),
            *texts,
            colour=SEVERITY_COLOURS[finding.severity],
        )


def format_noise_estimate(noise: NoiseEstimate, unit: str) -> str:
    """Format a maximum-likelihood noise with its 95 % interval."""
    if noise.value is not None:
        low_text = f"{noise.low or 0:.2g}"  # without a lower bound, the interval begins at 0
        interval_text = (
            f"above {low_text}" if noise.high is None else f"{low_text} to {noise.high:.2g}"
        )
        return f"{noise.value:.3g} {unit} (95 % {interval_text})"
    if noise.high is not None:
        return f"at most {noise.high:.2g} {unit}"
    if noise.low is not None:
        return f"at least {noise.low:.2g} {unit}"
    return "not identifiable"
