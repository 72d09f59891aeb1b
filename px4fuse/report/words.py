"""Phrases that the terminal and the PDF share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from px4fuse.comparison.model import AxisComparison, Comparison, Difference, FilterSummary
from px4fuse.comparison.model import UnjudgedFilter as Unjudged
from px4fuse.filter.consistency import SIGMA_FACTOR_FINDING, Consistency
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings import Finding
from px4fuse.flight import Alignment, Truth, Unavailable
from px4fuse.plain import format_factor, format_number, format_p_value
from px4fuse.recording import ClockMap
from px4fuse.report import say
from px4fuse.report.style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS

if TYPE_CHECKING:
    from px4fuse.analysis import Analysis
    from px4fuse.report.page import Cell, Page

# Below, "white" is wrong: of the eight verdicts of a flight one in a hundred by chance
MIN_WHITE_P = 0.001
RMSE_FIELDS = ("position_rmse_m", "velocity_rmse_m_s")


def format_settings(settings: Settings) -> str:
    """The filter's settings in one phrase."""
    offset = f", clock offset {settings.clock_offset_s:+g} s" if settings.clock_offset_s else ""
    return say("settings", settings=settings, offset=offset)


def format_verdict(statement: Consistency | Unavailable) -> str:
    """Verdict with its factor, or why there is none."""
    if isinstance(statement, Unavailable):
        return "not available"
    if statement.verdict == "consistent":
        return "consistent"
    side = statement.verdict.removeprefix("variance ")
    return f"{side} {format_factor(statement.sigma_error_factor)}× in σ"


def filters_by_name(result: AxisComparison) -> dict[str, FilterSummary | Unjudged]:
    """Both filters of an axis by the names that a reader sees; ours alone where EKF2 is missing."""
    known = {"ours": result.filters["kf"]}
    if not isinstance(result.ekf2_state, Unavailable):
        known["EKF2"] = result.filters["ekf2"]
    return known


VERDICT_HEAD = ("axis", "filter", "mean\nNIS", "95 %\nband", "innovation\nvariance")


def verdict_rows(
    axes: Iterable[AxisComparison],
    extra_cells: Callable[[AxisComparison, str, FilterSummary | Unjudged], Sequence[str]],
) -> list[list[Cell]]:
    """A row for each axis and filter: what :data:`VERDICT_HEAD` says, and more cells."""
    rows: list[list[Cell]] = []
    for result in axes:
        for name, one in filters_by_name(result).items():
            label = result.axis.name if name == "ours" else ""
            nis, colour = ("", ""), MUTED_COLOUR
            if isinstance(one, Consistency):
                nis = (format_number(one.nis_mean), "{:.2f} – {:.2f}".format(*one.nis_band))
                colour = GOOD_COLOUR if one.verdict == "consistent" else SEVERITY_COLOURS["warning"]
            rows.append(
                [label, name, *nis, (format_verdict(one), colour), *extra_cells(result, name, one)]
            )
    return rows


def write_errors(page: Page, analysis: Analysis) -> None:
    """Write verdicts and errors as a table, the main axis first.

    Between both filters, and between each and the truth, where the flight has these.
    """
    axes = (analysis.main, *analysis.others)
    has_ekf2 = any(isinstance(result.difference, Difference) for result in axes)
    has_truth = isinstance(analysis.flight.truth, Truth)

    def rms_cells(result: AxisComparison, name: str, one: FilterSummary | Unjudged) -> list[str]:
        statistics: list[Any] = [result.difference if name == "ours" else None] if has_ekf2 else []
        statistics += [one.truth] if has_truth else []
        return [_format_rms(statistic, field) for statistic in statistics for field in RMSE_FIELDS]

    head = [*VERDICT_HEAD, *(["apart\n(m)", "\n(m/s)"] if has_ekf2 else [])]
    head += ["to truth\n(m)", "\n(m/s)"] if has_truth else []
    page.table(head, verdict_rows(axes, rms_cells), right=(2, 3, 5, 6, 7, 8))


def _format_rms(statistic: object, field: str) -> str:
    """A root mean square of three digits; empty where there is none."""
    value = getattr(statistic, field, None)
    return "" if value is None else f"{value:.3f}"


def verdict_notes(comparison: Comparison) -> list[str]:
    """What the verdicts mean where they could be misread, a sentence each.

    A source that may drift; factors that are too small for a finding; innovations of the right
    size that are not white.
    """
    statements = [
        (result.axis.name, filter_name, statement)
        for result in comparison.axes.values()
        for filter_name, statement in filters_by_name(result).items()
        if isinstance(statement, Consistency)
    ]
    notes = []
    if comparison.source.origin.may_drift:
        notes.append(say("follows_source"))
    small_deviations = [
        f"{filter_name} {axis} {format_verdict(statement)}"
        for axis, filter_name, statement in statements
        if statement.verdict != "consistent" and statement.sigma_error_factor < SIGMA_FACTOR_FINDING
    ]
    if small_deviations:
        notes.append(
            say("small_factors", which=", ".join(small_deviations), least=SIGMA_FACTOR_FINDING)
        )
    correlated = [
        f"{filter_name} {axis} {format_p_value(statement.ljung_box_p)}, lag-1 "
        f"{statement.lag1_autocorrelation:+.2f}"
        for axis, filter_name, statement in statements
        if statement.verdict == "consistent" and statement.ljung_box_p < MIN_WHITE_P
    ]
    if correlated:
        notes.append(say("not_white", which="; ".join(correlated)))
    return notes


def format_consequences(followers: Sequence[Finding]) -> str:
    """What the same cause brings with it, each in one sentence."""
    return "With it: " + " ".join(f"{finding.headline}." for finding in followers)


def format_clock_map(clock: ClockMap) -> str:
    """How one clock was mapped to the autopilot's, with its figures."""
    is_note_sufficient = clock.method in ("boot clock", "arrival time") or "own speed" in clock.note
    if is_note_sufficient or clock.distinct_stamps is not None:
        return f"{clock.clock}: {clock.note}"
    return say("clock_map", clock=clock, jitter_ms=clock.jitter_s * 1e3) + (
        f"; {clock.note}" if clock.note else ""
    )


def describe_alignment(alignment: Alignment) -> dict[str, str]:
    """How a position file was placed into the flight: labels and sentences."""
    north, east, down = alignment.origin_m
    yaw = "" if alignment.yaw_sigma_deg is None else f" ± {alignment.yaw_sigma_deg:.2f}°"
    sigma, residual = alignment.clock_offset_sigma_s, alignment.residual_rms_m
    clock = "" if sigma is None else f" ± {sigma:.3f} s"
    lines = {
        "frame": f"{alignment.frame} ({alignment.frame_reason})",
        "yaw": f"{alignment.yaw_deg:.2f}°{yaw} ({alignment.yaw_reason})",
        "origin": f"north {north:.3f} m, east {east:.3f} m, down {down:.3f} m",
        "clock": f"{alignment.clock_offset_s:+.3f} s{clock} to the boot clock "
        f"({alignment.clock_reason})",
    }
    if alignment.correlation is not None:
        residual_text = "" if residual is None else f", {residual:.3f} m RMS per axis"
        correlation_text = f"correlation {alignment.correlation:.4f} with {alignment.reference}"
        lines["match"] = correlation_text + residual_text
    return lines


def tuning_advice(
    comparison: Comparison, tuned: Mapping[str, AxisTuning | Unavailable]
) -> dict[str, str]:
    """What follows from tuning: the command to run again, PX4's parameter, and cautions.

    Labels and sentences, with ``px4fuse compare LOG`` as in :mod:`px4fuse.report.commands`.
    """
    names = (HORIZONTAL, "aisle", *tuned)
    name = next((name for name in names if isinstance(tuned.get(name), AxisTuning)), "")
    found = tuned.get(name)
    if not isinstance(found, AxisTuning):
        return {}
    advice, sigma_a, sigma_z = {}, found.filter_sigma_a, found.sigma_z
    drifts, log = comparison.source.origin.may_drift, comparison.flight.log
    if drifts:
        advice["Drift"] = say("tuned_drifts")
    options = [
        f" {option} {noise.value:.3g}"
        for option, noise in (("--sigma-a", sigma_a), ("--sigma-z", sigma_z))
        if noise.value is not None and not drifts
    ]
    if options:
        command = f"px4fuse compare LOG{''.join(options)}"
        advice["Re-run"] = f"with the noises of {name}: {command}"
    if sigma_z.value is None and sigma_z.low is not None:
        advice["SIGMA_Z"] = f"is at least {sigma_z.low:.2g} m: is this a position source at all?"
    elif sigma_z.value is None:
        bound = "" if sigma_z.high is None else f" (at most {sigma_z.high:.2g} m)"
        advice["SIGMA_Z"] = say("sigma_z_hidden", bound=bound)
    elif log.autopilot == "PX4" and not drifts and comparison.source.origin.is_vision:
        px4_value = log.parameters.get("EKF2_EVP_NOISE")
        current_value = "" if px4_value is None else f" (now {px4_value:g})"
        advice["PX4"] = f"EKF2_EVP_NOISE {sigma_z.value:.3g}{current_value}"
    if sigma_a.value is None:
        advice["SIGMA_A"] = (
            "is not determined by this flight: too little motion, or too short."
            if sigma_a.low is None
            else f"is at least {sigma_a.low:.2g} m/s²: the acceleration is wrong."
        )
    elif found.biases_fitted and (alone := found.sigma_a.value or found.sigma_a.high) is not None:
        bound = "" if found.sigma_a.value is not None else "at most "
        advice["SIGMA_A"] = say("sigma_a_alone", bound=bound, alone=alone, sigma_a=sigma_a)
    if len(found.outlier_time_s):
        advice["Outliers"] = say(
            "tuned_outliers", count=len(found.outlier_time_s), found=found, name=name
        )
    return advice
