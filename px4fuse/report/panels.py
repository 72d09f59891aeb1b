"""Plots of KF and EKF2 over time along one axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison, Difference
from px4fuse.filter.consistency import Consistency
from px4fuse.flight.model import Unavailable
from px4fuse.report import event_marks, style
from px4fuse.report.page import Page, PageBlock
from px4fuse.report.phrases import format_sigma_verdict, get_statistics_by_filter
from px4fuse.report.style import (
    INNOVATION_STYLES,
    TRACK_STYLES,
    Artist,
    Axes,
    draw_curve,
    draw_sigma_band,
    set_log_scale,
)

NARROW_AXES_HEIGHT = 72.0  # points
# Axis limit divided by the largest innovation within the axis
INNOVATION_AXIS_MARGIN_FACTOR = 1.3
# The axis shows innovations up to this multiple of the median √S
MAX_AXIS_LIMIT_IN_SQRT_S = 5.0


class QuantityColumns(NamedTuple):
    """Unit, table columns and statistics of position or velocity."""

    unit: str
    column: str
    variance_column: str
    rmse_field_name: str
    difference_field_name: str
    median_sigma_field_name: str


POSITION_QUANTITY = QuantityColumns(
    "m",
    "position_m",
    "position_variance_m2",
    "position_rmse_m",
    "position_rms_m",
    "sigma_p_median_m",
)
VELOCITY_QUANTITY = QuantityColumns(
    "m/s",
    "velocity_m_s",
    "velocity_variance_m2_s2",
    "velocity_rmse_m_s",
    "velocity_rms_m_s",
    "sigma_v_median_m_s",
)


class Panel(NamedTuple):
    """Plot over time along one axis, with statistics and caption."""

    title: str
    height: float
    draw: Callable[[Axes, AxisComparison], None]
    make_statistics_text: Callable[[AxisComparison], str]
    make_caption: Callable[[AxisComparison], str] = lambda _: ""

    def draw_on_page(
        self,
        page: Page,
        analysis: Analysis,
        result: AxisComparison,
        *,
        with_time_label: bool,
        is_narrow: bool = False,
    ) -> None:
        """Draw the plot on a page; a narrow plot has no caption."""
        texts = [self.make_statistics_text(result)]
        if not is_narrow:
            texts.append(self.make_caption(result))
        axes = event_marks.add_panel(
            page,
            analysis,
            self.title,
            NARROW_AXES_HEIGHT if is_narrow else self.height,
            caption=". ".join(filter(None, texts)),
            # the innovation plot shows rejections as hollow dots, so it needs no markers
            axis="" if self is INNOVATIONS_PANEL else result.axis.name,
            with_time_label=with_time_label,
        )
        self.draw(axes, result.with_whole_flight_tracks())


def add_legend(page: Page, analysis: Analysis) -> PageBlock:
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    lines: list[Artist] = [
        Line2D([], [], **style.MEASUREMENT_STYLE | {"ms": 5.0}, label="position"),
        Line2D([], [], **TRACK_STYLES["KF"], label="KF"),
        Patch(facecolor=style.KF_BAND_COLOUR, lw=0, label="±2σ reported"),
        *(
            Line2D([], [], **TRACK_STYLES[name], label=name)
            for name in _list_ekf2_and_truth_tracks(analysis.main)
        ),
    ]
    return page.add_legend([*lines, *event_marks.make_legend_entries(analysis)])


def select_available_tables(**tables: object) -> dict[str, pd.DataFrame]:
    return {name: table for name, table in tables.items() if isinstance(table, pd.DataFrame)}


def _list_ekf2_and_truth_tracks(result: AxisComparison) -> dict[str, pd.DataFrame]:
    return select_available_tables(**{"EKF2": result.ekf2_state, "ground truth": result.truth})


def draw_tracks(axes: Axes, result: AxisComparison, quantity: QuantityColumns) -> None:
    """Draw position or velocity: measurements, KF with ±2σ, EKF2 and ground truth."""
    if quantity is POSITION_QUANTITY:
        measurements = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        draw_curve(axes, measurements, **style.MEASUREMENT_STYLE)
    kf_values = result.kf_run.steps[quantity.column]
    draw_sigma_band(axes, kf_values, np.sqrt(result.kf_run.steps[quantity.variance_column]))
    drawn_series = [kf_values]
    for name, track in _list_ekf2_and_truth_tracks(result).items():
        values = track[quantity.column]
        if values.notna().any():
            draw_curve(axes, values, **TRACK_STYLES[name], zorder=2.5)
            drawn_series.append(values)
    draw_curve(axes, kf_values, **TRACK_STYLES["KF"])
    # The ±2σ band is very wide at the start, so it does not set the axis limits
    all_values = pd.concat(drawn_series)
    margin = 0.08 * (all_values.max() - all_values.min()) + 1e-3
    axes.set_ylim(all_values.min() - margin, all_values.max() + margin)


def _describe_errors(result: AxisComparison, quantity: QuantityColumns) -> str:
    rmse_texts = [
        f"{name} {rmse:.3f} {quantity.unit}"
        for name, filter_summary in get_statistics_by_filter(result).items()
        if (rmse := getattr(filter_summary.truth, quantity.rmse_field_name, None)) is not None
    ]
    texts = [f"RMSE against ground truth {', '.join(rmse_texts)}"] if rmse_texts else []
    if isinstance(result.difference, Difference):
        difference_rms = getattr(result.difference, quantity.difference_field_name)
        texts.append(f"KF - EKF2 RMS {difference_rms:.3f} {quantity.unit}")
    return "; ".join(texts)


def _find_innovation_limit_m(result: AxisComparison) -> float:
    limits_m = []
    for innovations in _collect_innovation_tables(result).values():
        median_sqrt_s_m = float(np.sqrt(innovations["innovation_variance_m2"].median()))
        # a quantile, because outliers would enlarge the axis
        quantile_m = float(np.quantile(innovations["innovation_m"].abs(), 0.99))
        limits_in_sqrt_s = np.array([2.0, MAX_AXIS_LIMIT_IN_SQRT_S])
        limits_m.append(float(np.clip(quantile_m, *limits_in_sqrt_s * median_sqrt_s_m)))
    return INNOVATION_AXIS_MARGIN_FACTOR * max(limits_m)


def _collect_innovation_tables(result: AxisComparison) -> dict[str, pd.DataFrame]:
    return select_available_tables(KF=result.kf_run.updates, EKF2=result.ekf2_innovations)


def normalised_innovations(result: AxisComparison) -> dict[str, pd.Series[float]]:
    """Return the normalised innovations ν/√S by filter."""
    return {
        name: (table["innovation_m"] / np.sqrt(table["innovation_variance_m2"])).dropna()
        for name, table in _collect_innovation_tables(result).items()
    }


def draw_dots(
    axes: Axes, values: pd.Series[float], axis_limit: float, marker_style: dict[str, Any]
) -> None:
    """Draw dots; values beyond the limit are triangles at the edge."""
    draw_curve(axes, values[values.abs() <= axis_limit], **marker_style)
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        values_beyond_limit = values[sign * values > axis_limit]
        triangle_style = {**marker_style, "marker": marker, "ms": 3.2, "clip_on": False}
        if len(values_beyond_limit):
            draw_curve(axes, 0.0 * values_beyond_limit + sign * axis_limit, **triangle_style)


def draw_innovations(axes: Axes, result: AxisComparison) -> None:
    """Draw the innovations of KF and EKF2 with ±2√S."""
    plot_limit_m, ekf2_innovations = _find_innovation_limit_m(result), result.ekf2_innovations
    updates, kf_innovations = result.kf_run.updates, result.kf_run.updates["innovation_m"]
    draw_sigma_band(axes, 0.0 * kf_innovations, np.sqrt(updates["innovation_variance_m2"]))
    style.draw_zero_line(axes)
    innovations_and_styles = [(kf_innovations, INNOVATION_STYLES["KF"])]
    if isinstance(ekf2_innovations, pd.DataFrame):
        two_sqrt_s_m = 2.0 * np.sqrt(ekf2_innovations["innovation_variance_m2"])
        for limit in (two_sqrt_s_m, -two_sqrt_s_m):
            draw_curve(axes, limit, **TRACK_STYLES["EKF2"])
        is_rejected = ekf2_innovations["rejected"] > 0
        innovations = ekf2_innovations["innovation_m"]
        innovations_and_styles = [
            (innovations[~is_rejected], INNOVATION_STYLES["EKF2"]),
            (innovations[is_rejected], style.REJECTED_STYLE),
            *innovations_and_styles,
        ]
    for values, marker_style in innovations_and_styles:
        draw_dots(axes, values, plot_limit_m, marker_style)
    axes.set_ylim(-1.04 * plot_limit_m, 1.04 * plot_limit_m)


def _describe_innovations(result: AxisComparison) -> str:
    sentences = []
    for name, consistency in get_statistics_by_filter(result).items():
        if isinstance(consistency, Unavailable):
            sentences.append(f"{name}: {consistency.reason}.")
            continue
        verdict_text = format_sigma_verdict(consistency.verdict, consistency.sigma_error_factor)
        sentences.append(
            f"{name}: {consistency.count} innovations, {verdict_text}; mean "
            f"{consistency.innovation_mean_m:+.3f} m, standard deviation "
            f"{consistency.innovation_std_m:.3f} m, median √S {consistency.sqrt_s_median_m:.3f} m."
        )
    if isinstance(result.ekf2_state, Unavailable):
        sentences.append(f"EKF2: {result.ekf2_state.reason}.")
    plot_limit_m, innovation_tables = (
        _find_innovation_limit_m(result),
        _collect_innovation_tables(result),
    )
    if any(
        table["innovation_m"].abs().max() > plot_limit_m for table in innovation_tables.values()
    ):
        sentences.append("Triangles: values outside the plot.")
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        rejected_count = int((result.ekf2_innovations["rejected"] > 0).sum())
        if rejected_count:
            sentences.append(f"EKF2 rejected {rejected_count} positions (hollow dots).")
    return " ".join(sentences)


def _format_fraction_outside(result: AxisComparison) -> str:
    fractions_text = ", ".join(
        f"{name} {consistency.fraction_outside_two_sigma:.1%}"
        for name, consistency in get_statistics_by_filter(result).items()
        if isinstance(consistency, Consistency)
    )
    return f"{fractions_text} outside ±2√S (expected 5 %)" if fractions_text else ""


def _draw_sigma(axes: Axes, result: AxisComparison, quantity: QuantityColumns) -> None:
    variance_tables = select_available_tables(KF=result.kf_run.steps, EKF2=result.ekf2_variance)
    for name, table in variance_tables.items():
        draw_curve(axes, np.sqrt(table[quantity.variance_column]), **TRACK_STYLES[name])
    set_log_scale(axes)


def _format_median_sigma(result: AxisComparison, quantity: QuantityColumns) -> str:
    sigma_texts = []
    for name, filter_summary in get_statistics_by_filter(result).items():
        median_sigma = getattr(filter_summary, quantity.median_sigma_field_name)
        sigma_text = "not logged" if median_sigma is None else f"{median_sigma:.3f} {quantity.unit}"
        sigma_texts.append(f"{name} {sigma_text}")
    return f"median: {', '.join(sigma_texts)}"


POSITION_PANEL = Panel(
    "Position (m)",
    150.0,
    partial(draw_tracks, quantity=POSITION_QUANTITY),
    partial(_describe_errors, quantity=POSITION_QUANTITY),
)
VELOCITY_PANEL = Panel(
    "Velocity (m/s)",
    150.0,
    partial(draw_tracks, quantity=VELOCITY_QUANTITY),
    partial(_describe_errors, quantity=VELOCITY_QUANTITY),
    lambda _: "Velocity is not measured: each filter estimates it from positions and IMU.",
)
INNOVATIONS_PANEL = Panel(
    "Innovations (m)", 140.0, draw_innovations, _format_fraction_outside, _describe_innovations
)
POSITION_SIGMA_PANEL = Panel(
    "σ of position (m), log scale",
    80.0,
    partial(_draw_sigma, quantity=POSITION_QUANTITY),
    partial(_format_median_sigma, quantity=POSITION_QUANTITY),
)
VELOCITY_SIGMA_PANEL = Panel(
    "σ of velocity (m/s), log scale",
    60.0,
    partial(_draw_sigma, quantity=VELOCITY_QUANTITY),
    partial(_format_median_sigma, quantity=VELOCITY_QUANTITY),
)
