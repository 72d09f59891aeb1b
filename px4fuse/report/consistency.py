"""Report page on the consistency of KF and EKF2: NIS, distribution and whiteness."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison
from px4fuse.comparison.trials import (
    CONSISTENCY_STATISTICS,
    Statistic,
    Trial,
    find_cause_trial,
    find_trials,
)
from px4fuse.core.text import format_number, format_p_value
from px4fuse.filter.consistency import (
    MIN_INNOVATIONS,
    Consistency,
    compute_autocorrelation,
    compute_nis_band,
)
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings.cause_text import describe_explained_part, format_change
from px4fuse.flight.model import Unavailable
from px4fuse.report import event_marks
from px4fuse.report.page import Page, draw_legend_above, make_two_columns
from px4fuse.report.panels import normalised_innovations
from px4fuse.report.phrases import (
    MIN_WHITENESS_P_VALUE,
    VERDICT_LEGEND,
    VERDICT_TABLE_HEAD,
    format_noise_estimate,
    format_settings,
    get_statistics_by_filter,
    make_verdict_row,
)
from px4fuse.report.style import (
    INNOVATION_STYLES,
    KF_COLOUR,
    TRACK_STYLES,
    Axes,
    draw_curve,
    draw_zero_line,
    line_style,
    set_plain_ticks,
)

MAX_AUTOCORRELATION_LAG = 20
MAX_DRAWN_SIGMAS = 4.0
HISTOGRAM_EDGES = np.linspace(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS, 33)
# Upper limit of the density axis; the normal density has a maximum of 0.4
MAX_DENSITY_AXIS_LIMIT = 1.6
RUNNING_NIS_HEIGHT = 140.0  # points
DISTRIBUTION_HEIGHT = 150.0  # points
LEGEND_HEIGHT = 14.0  # points, of a legend above a plot
# Label of each statistic, and exponent before printing (0.5: square root)
STATISTIC_LABELS_AND_EXPONENTS: Mapping[Statistic, tuple[str, float]] = {
    "nis": ("mean NIS", 1.0),
    "nees": ("√NEES", 0.5),
    "difference": ("KF - EKF2 (m)", 1.0),
}
NOISE_TABLE_HEAD = ("axis", "SIGMA_A (m/s²)", "SIGMA_Z (m)")

InnovationsByFilter = Mapping[str, "pd.Series[float]"]


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the consistency tests of the main axis, and a table of all axes."""
    result = analysis.main
    axis_text = result.axis.label
    page = Page(
        "Appendix: consistency",
        "Innovations ν of a consistent filter have variance S (mean NIS = mean of ν²/S = 1), "
        "are normally distributed with mean 0, and are white. The plots show KF and EKF2 "
        f"along {axis_text}; the table lists all axes.",
    )
    if innovations := _select_tested_innovations(result):
        title = "Running mean NIS (log scale)"
        axes = event_marks.add_panel(
            page, analysis, title, RUNNING_NIS_HEIGHT, gap_above=LEGEND_HEIGHT
        )
        left_column, right_column = make_two_columns()
        histogram_axes = left_column.add_panel(
            "Distribution of ν/√S", DISTRIBUTION_HEIGHT, gap_above=LEGEND_HEIGHT, left_margin=4.0
        )
        autocorrelation_axes = right_column.add_panel(
            "Autocorrelation",
            DISTRIBUTION_HEIGHT,
            caption=_describe_whiteness(result, innovations),
            gap_above=LEGEND_HEIGHT,
        )
        _draw_running_nis(axes, innovations)
        _draw_histogram(histogram_axes, innovations)
        _draw_autocorrelation(autocorrelation_axes, innovations)
        for labelled_axes in (axes, histogram_axes, autocorrelation_axes):
            draw_legend_above(labelled_axes)
        page.add_columns(left_column, right_column)
    else:
        reason = getattr(result.filters["kf"], "reason", "too few innovations")
        page.write(f"The consistency along {axis_text} is not tested: {reason}.")
    page.write_heading("All axes")
    column_heads = [*VERDICT_TABLE_HEAD, "n", "beyond\n2√S", "t of\nmean", "lag 1", "Ljung-\nBox"]
    rows = [
        [*make_verdict_row(axis_result, name), *_statistic_cells(consistency)]
        for axis_result in analysis.axes.values()
        for name, consistency in get_statistics_by_filter(axis_result).items()
    ]
    page.add_table(column_heads, rows, right_aligned_columns=(2, 5, 6, 7, 8))
    page.write_small_text(VERDICT_LEGEND)
    noise_rows = [
        [name, *map(format_noise_estimate, (tuning.sigma_a_two_state, tuning.sigma_z))]
        for name, tuning in analysis.tuning.items()
        if isinstance(tuning, AxisTuning)
    ]
    if noise_rows:
        page.write_heading("Maximum-likelihood noises of KF, with 95 % intervals")
        page.add_table(NOISE_TABLE_HEAD, noise_rows, right_aligned_columns=(1, 2))
        page.write(f"This report uses {format_settings(analysis.settings)}.")
    _write_causes(page, analysis)
    yield page


def _write_causes(page: Page, analysis: Analysis) -> None:
    axis = analysis.main.axis
    trial_statistic_pairs: list[tuple[Trial, Statistic]] = []
    for filter_name, statistic in product(FILTER_NAMES, CONSISTENCY_STATISTICS):
        trials = find_trials(analysis.trials, filter_name, axis.name, statistic)
        trial_statistic_pairs += [(trial, statistic) for trial in trials]
        cause = find_cause_trial(trials, filter_name, axis.name, statistic)
        if cause and cause.before.difference_rms_m and cause.after.difference_rms_m:
            trial_statistic_pairs.append((cause, "difference"))
    rows = []
    for trial, statistic in trial_statistic_pairs:
        label, exponent = STATISTIC_LABELS_AND_EXPONENTS[statistic]
        statistic_values = [
            outcome.value(statistic) or 0.0 for outcome in (trial.before, trial.after)
        ]
        cells = [FILTER_NAMES[trial.filter], format_change(analysis, trial), label]
        cells += [format_number(value**exponent, 2) for value in statistic_values]
        rows.append([*cells, describe_explained_part(trial, statistic)])
    if not rows:
        return
    page.write_heading(f"Tested causes of inconsistent filters along {axis.label}")
    column_heads = ["filter", "change", "quantity", "as flown", "with change", "explains"]
    page.add_table(column_heads, rows, right_aligned_columns=(3, 4))
    page.write_small_text(
        "Each row is a re-run with one changed setting. 'explains' is the fraction of ln(mean NIS) "
        "or ln(mean NEES) that the change removes; for KF - EKF2, of the mean square. 'all': the "
        "filter becomes consistent. A change that explains 50 % or more is a cause."
    )


def _select_tested_innovations(result: AxisComparison) -> InnovationsByFilter:
    consistency_by_name = get_statistics_by_filter(result)
    return {
        name: values
        for name, values in normalised_innovations(result).items()
        if isinstance(consistency_by_name.get(name), Consistency) and len(values) >= MIN_INNOVATIONS
    }


def _thin_line_style(name: str) -> dict[str, Any]:
    return line_style(TRACK_STYLES[name]["color"], 0.6, (0, (1, 1.5)))


def _draw_running_nis(axes: Axes, innovations: InnovationsByFilter) -> None:
    min_drawn_nis, max_drawn_nis = 0.5, 2.0
    for name, values in innovations.items():
        innovation_counts = np.arange(1, len(values) + 1)
        running_nis = (values**2).cumsum() / innovation_counts
        draw_curve(axes, running_nis.iloc[2:], **TRACK_STYLES[name], label=name)
        band_innovation_counts = np.unique(np.geomspace(3, len(innovation_counts), 60).astype(int))
        band_low, band_high = np.array(
            [compute_nis_band(int(count)) for count in band_innovation_counts]
        ).T
        drawn_times_s = values.index[band_innovation_counts - 1]
        axes.plot(drawn_times_s, band_low, **_thin_line_style(name))
        axes.plot(drawn_times_s, band_high, **_thin_line_style(name), label=f"95 % band {name}")
        nis_after_first_quarter = running_nis.iloc[len(running_nis) // 4 :]
        min_drawn_nis = min(min_drawn_nis, 0.7 * nis_after_first_quarter.min())
        max_drawn_nis = max(max_drawn_nis, 1.4 * nis_after_first_quarter.max())
    axes.axhline(1.0, color="black", lw=0.5)
    axes.set(yscale="log", ylim=(min_drawn_nis, max_drawn_nis))
    set_plain_ticks(axes)


def _draw_histogram(axes: Axes, innovations: InnovationsByFilter) -> None:
    innovation_grid = np.linspace(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS, 81)
    normal_density = np.exp(-0.5 * innovation_grid**2) / np.sqrt(2.0 * np.pi)
    axes.fill_between(innovation_grid, normal_density, color="#dcdcdc", lw=0, label="normal")
    max_density = 0.4
    for name, values in innovations.items():
        drawn_values = values.clip(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS)
        density, _ = np.histogram(drawn_values, HISTOGRAM_EDGES, density=True)
        axes.stairs(density, HISTOGRAM_EDGES, **TRACK_STYLES[name], label=name)
        max_density = max(max_density, float(density.max()))
    axes.set_xlim(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS)
    axes.set_ylim(0.0, min(1.15 * max_density, MAX_DENSITY_AXIS_LIMIT))
    axes.set_yticks([])
    axes.set_xlabel("ν / √S")


def _draw_autocorrelation(axes: Axes, innovations: InnovationsByFilter) -> None:
    for shift, (name, values) in zip((-0.18, 0.18), innovations.items(), strict=False):
        lag_count = min(MAX_AUTOCORRELATION_LAG, len(values) // 3)
        correlations = compute_autocorrelation(np.asarray(values, np.float64), lag_count)
        bar_lags = np.arange(1, lag_count + 1) + shift
        axes.vlines(bar_lags, 0.0, correlations, color=TRACK_STYLES[name]["color"], lw=1.2)
        marker_style = INNOVATION_STYLES[name] | {
            "ms": 3.0,
            "mew": 0.6,
            "mfc": KF_COLOUR if name == "KF" else "white",
        }
        axes.plot(bar_lags, correlations, **marker_style, label=name)
        whiteness_limit = _compute_whiteness_limit(values)
        axes.axhline(-whiteness_limit, **_thin_line_style(name))
        axes.axhline(whiteness_limit, **_thin_line_style(name), label=f"95 % band {name}")
    draw_zero_line(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(max(min(low, -0.3), -1.05), min(max(high, 0.3), 1.05))
    axes.set_xlim(0.0, MAX_AUTOCORRELATION_LAG + 1)
    axes.set_xlabel("lag (measurements)")


def _compute_whiteness_limit(values: pd.Series[float]) -> float:
    """Return the limit of the autocorrelation of white noise (95 %)."""
    return float(1.96 / np.sqrt(len(values)))


def _describe_whiteness(result: AxisComparison, innovations: InnovationsByFilter) -> str:
    sentences = []
    for name, values in innovations.items():
        consistency = get_statistics_by_filter(result)[name]
        assert isinstance(consistency, Consistency)
        lag1_correlation, p_value = consistency.lag1_autocorrelation, consistency.ljung_box_p
        interpretation = "white" if p_value >= MIN_WHITENESS_P_VALUE else "not white"
        if p_value < MIN_WHITENESS_P_VALUE and abs(lag1_correlation) > _compute_whiteness_limit(
            values
        ):
            interpretation = (
                f"{name} {'lags' if lag1_correlation > 0.0 else 'follows measurement noise'}"
            )
        sentences.append(
            f"{name}: lag-1 autocorrelation {lag1_correlation:+.2f}, Ljung-Box test "
            f"{format_p_value(p_value)}: {interpretation}."
        )
    return "\n".join(sentences)


def _statistic_cells(consistency: Consistency | Unavailable) -> list[str]:
    if isinstance(consistency, Unavailable):
        return [""] * 5
    return [
        f"{consistency.count}",
        f"{consistency.fraction_outside_two_sigma:.1%}",
        f"{consistency.bias_t:+.1f}",
        f"{consistency.lag1_autocorrelation:+.2f}",
        format_p_value(consistency.ljung_box_p),
    ]
