"""Report page on the consistency of KF and EKF2: NIS, distribution and whiteness."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison
from px4fuse.comparison.rerun_effects import (
    CONSISTENCY_STATISTICS,
    find_reruns,
)
from px4fuse.core.text import format_number, format_p_value
from px4fuse.filter.consistency import (
    MIN_INNOVATIONS,
    Consistency,
    compute_autocorrelation,
    compute_nis_band,
)
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings.cause_text import describe_part_explained_by_change, format_change
from px4fuse.flight.model import Unavailable

from .page import Page, draw_legend_above, make_columns
from .panels import add_time_panel, normalised_innovations
from .phrases import (
    VERDICT_LEGEND,
    VERDICT_TABLE_HEAD,
    format_noise_estimate,
    get_statistics_by_filter,
    make_verdict_row,
)
from .style import (
    INNOVATION_STYLES,
    TRACK_STYLES,
    Axes,
    draw_curve,
    draw_zero_line,
    line_style,
    set_log_scale,
)

MAX_AUTOCORRELATION_LAG = 20
MAX_DRAWN_SIGMAS = 4.0
HISTOGRAM_EDGES = np.linspace(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS, 33)
RUNNING_NIS_HEIGHT = 140.0  # points
DISTRIBUTION_PLOT_HEIGHT = 150.0  # points
InnovationsByFilter = Mapping[str, "pd.Series[float]"]


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the consistency tests along one axis, and a table of all axes."""
    result = analysis.main
    axis_text = result.axis.label
    page = Page(
        "Appendix: consistency",
        "Innovations ν of a consistent filter have variance S (mean NIS = mean of ν²/S = 1), "
        f"are normally distributed with mean 0, and are white. The plots are along {axis_text}.",
    )
    if innovations := _select_tested_innovations(result):
        nis_axes = add_time_panel(
            page, analysis, "Running mean NIS (log scale)", RUNNING_NIS_HEIGHT
        )
        _draw_running_nis(nis_axes, innovations)
        left_column, right_column = make_columns()
        histogram_axes = left_column.add_panel("Distribution of ν/√S", DISTRIBUTION_PLOT_HEIGHT)
        _draw_histogram(histogram_axes, innovations)
        autocorrelation_axes = right_column.add_panel("Autocorrelation", DISTRIBUTION_PLOT_HEIGHT)
        _draw_autocorrelation(autocorrelation_axes, innovations)
        for axes in (nis_axes, histogram_axes, autocorrelation_axes):
            draw_legend_above(axes)
        page.add_columns(left_column, right_column)
    else:
        reason = getattr(result.filters["kf"], "reason", "too few innovations")
        page.write(f"The consistency along {axis_text} is not tested: {reason}.")
    page.write_heading("All axes")
    column_heads = [*VERDICT_TABLE_HEAD, "n", "beyond\n2√S", "t of\nmean", "lag 1", "Ljung-\nBox"]
    rows = [
        [*make_verdict_row(axis_result, name), *_format_statistics(consistency)]
        for axis_result in analysis.axes.values()
        for name, consistency in get_statistics_by_filter(axis_result).items()
    ]
    page.add_table(column_heads, rows, right_aligned_columns=(2, 5, 6, 7, 8))
    page.write_muted_text(VERDICT_LEGEND)
    noise_rows = [
        [
            name,
            format_noise_estimate(tuning.sigma_a_two_state, "m/s²"),
            format_noise_estimate(tuning.sigma_z, "m"),
        ]
        for name, tuning in analysis.tuning.items()
        if isinstance(tuning, AxisTuning)
    ]
    if noise_rows:
        page.write_heading("Maximum-likelihood SIGMA_A and SIGMA_Z, with 95 % intervals")
        page.add_table(("axis", "SIGMA_A", "SIGMA_Z"), noise_rows)
    _write_causes(page, analysis)
    yield page


def _write_causes(page: Page, analysis: Analysis) -> None:
    """Write a table of the re-runs that may correct the mean NIS or mean NEES of a filter."""
    axis, rows = analysis.main.axis, []
    for filter_name, statistic in product(FILTER_NAMES, CONSISTENCY_STATISTICS):
        label, exponent = ("mean NIS", 1.0) if statistic == "nis" else ("√NEES", 0.5)
        for rerun in find_reruns(analysis.reruns, filter_name, axis.name, statistic):
            cells = [FILTER_NAMES[filter_name], format_change(analysis, rerun), label]
            for outcome in (rerun.before, rerun.after):
                cells.append(format_number((outcome.value(statistic) or 0.0) ** exponent, 2))
            rows.append([*cells, describe_part_explained_by_change(rerun, statistic)])
    if not rows:
        return
    page.write_heading(f"Tested causes of inconsistent filters along {axis.label}")
    column_heads = ["filter", "change", "quantity", "as flown", "with change", "explains"]
    page.add_table(column_heads, rows, right_aligned_columns=(3, 4))
    page.write_muted_text(
        "Each row is a re-run with one change. 'explains' is the relative reduction of ln(mean "
        "NIS) or ln(mean NEES). 'all' means that the filter becomes consistent. A change that "
        "explains 50 % or more is a cause."
    )


def _select_tested_innovations(result: AxisComparison) -> InnovationsByFilter:
    """Return ν/√S along an axis by filter, for filters with enough innovations for the tests."""
    return {
        name: values
        for name, values in normalised_innovations(result).items()
        if isinstance(get_statistics_by_filter(result)[name], Consistency)
    }


def _thin_line_style(name: str) -> dict[str, Any]:
    return line_style(TRACK_STYLES[name]["color"], 0.6, (0, (1, 1.5)))


def _draw_running_nis(axes: Axes, innovations: InnovationsByFilter) -> None:
    """Draw the mean NIS of all innovations (ν/√S, by filter) up to each time."""
    for name, values in innovations.items():
        running_nis = (values**2).expanding(MIN_INNOVATIONS).mean().dropna()
        draw_curve(axes, running_nis, **TRACK_STYLES[name], label=name)
        innovation_counts = np.unique(np.geomspace(MIN_INNOVATIONS, len(values), 60).astype(int))
        band_low, band_high = np.array(
            [compute_nis_band(int(count)) for count in innovation_counts]
        ).T
        band_times_s = values.index[innovation_counts - 1]
        axes.plot(band_times_s, band_low, **_thin_line_style(name))
        axes.plot(band_times_s, band_high, **_thin_line_style(name), label=f"95 % band {name}")
    axes.axhline(1.0, color="black", lw=0.5)
    set_log_scale(axes)


def _draw_histogram(axes: Axes, innovations: InnovationsByFilter) -> None:
    """Draw the distribution of ν/√S of each filter, and the standard normal distribution."""
    innovation_grid = np.linspace(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS, 81)
    normal_density = np.exp(-0.5 * innovation_grid**2) / np.sqrt(2.0 * np.pi)
    axes.fill_between(innovation_grid, normal_density, color="#dcdcdc", lw=0, label="normal")
    for name, values in innovations.items():
        drawn_values = values.clip(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS)
        density, _ = np.histogram(drawn_values, HISTOGRAM_EDGES, density=True)
        axes.stairs(density, HISTOGRAM_EDGES, **TRACK_STYLES[name], label=name)
    axes.set(xlim=(-MAX_DRAWN_SIGMAS, MAX_DRAWN_SIGMAS), xlabel="ν / √S", yticks=[])


def _draw_autocorrelation(axes: Axes, innovations: InnovationsByFilter) -> None:
    """Plot the autocorrelation of the innovations, with the 95 % band of white noise."""
    # Bars of KF and EKF2 are shifted (in lags) to be side by side. EKF2 may be missing
    for shift, (name, values) in zip(
        np.linspace(-0.18, 0.18, len(FILTER_NAMES)), innovations.items(), strict=False
    ):
        lag_count = min(MAX_AUTOCORRELATION_LAG, len(values) // 3)
        correlations = compute_autocorrelation(np.asarray(values, np.float64), lag_count)
        bar_lags = np.arange(1, lag_count + 1) + shift
        axes.vlines(bar_lags, 0.0, correlations, color=TRACK_STYLES[name]["color"], lw=1.2)
        axes.plot(bar_lags, correlations, **INNOVATION_STYLES[name] | {"ms": 3.0}, label=name)
        # 95 % band of the autocorrelation of white noise
        whiteness_limit = 1.96 / np.sqrt(len(values))
        axes.axhline(-whiteness_limit, **_thin_line_style(name))
        axes.axhline(whiteness_limit, **_thin_line_style(name), label=f"95 % band {name}")
    draw_zero_line(axes)
    axes.set(xlim=(0.0, MAX_AUTOCORRELATION_LAG + 1), xlabel="lag (measurements)")


def _format_statistics(consistency: Consistency | Unavailable) -> list[str]:
    """Return the last five cells of the row of a filter; empty cells if it was not tested."""
    if isinstance(consistency, Unavailable):
        return [""] * 5
    return [
        f"{consistency.count}",
        f"{consistency.fraction_outside_two_sigma:.1%}",
        f"{consistency.bias_t:+.1f}",
        f"{consistency.lag1_autocorrelation:+.2f}",
        format_p_value(consistency.ljung_box_p),
    ]
