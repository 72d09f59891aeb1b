"""Plots over time along one axis, with caption and numbers."""

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
from px4fuse.report.page import Block, Page
from px4fuse.report.phrases import filters_by_name, format_verdict
from px4fuse.report.style import (
    DOTS,
    LINES,
    Artist,
    Axes,
    draw_curve,
    draw_sigma_band,
    set_log_scale,
)

NARROW_HEIGHT = 72.0  # height (points) of the axes in narrow columns
# Margin factor of the axis of innovations
EDGE_FACTOR = 1.3
# Maximum limit (in √S) of the axis of innovations
MAX_EDGE_SIGMAS = 5.0


class Quantity(NamedTuple):
    """Position or velocity: its unit, and its names in tables and results."""

    unit: str
    column: str
    variance: str
    rmse: str
    sigma: str


POSITIONS = Quantity(
    "m", "position_m", "position_variance_m2", "position_rmse_m", "sigma_p_median_m"
)
VELOCITIES = Quantity(
    "m/s", "velocity_m_s", "velocity_variance_m2_s2", "velocity_rmse_m_s", "sigma_v_median_m_s"
)


class Panel(NamedTuple):
    """Plot over time along one axis; ``height`` of the axes in points."""

    title: str
    height: float
    draw: Callable[[Axes, AxisComparison], None]
    caption: Callable[[Analysis, AxisComparison], str]
    numbers: Callable[[AxisComparison], str]

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
        title, caption, height, numbers = self.title, "", NARROW_HEIGHT, self.numbers(result)
        if not is_narrow:
            caption, height = self.caption(analysis, result), self.height
            title, numbers = ": ".join(filter(None, (title, numbers))), ""
        # innovations that EKF2 rejected are already drawn as hollow dots
        rejection_axis = "" if self is INNOVATIONS else result.axis.name
        axes = event_marks.panel(
            page,
            analysis,
            title,
            caption,
            height,
            axis=rejection_axis,
            with_time_label=with_time_label,
        )
        if is_narrow:
            axes.locator_params(axis="x", nbins=4)
        self.draw(axes, result.in_flight)
        page.write_small(numbers)


def add_legend(page: Page, analysis: Analysis) -> Block:
    """Add the legend of tracks and events to a page."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    result = analysis.main
    lines: list[Artist] = [
        Line2D([], [], **{**style.MEASUREMENT_DOTS, "ms": 5.0}, label="position"),
        Line2D([], [], **LINES["KF"], label="KF"),
        Patch(facecolor=style.KF_BAND_COLOUR, lw=0, label="±2σ reported"),
    ]
    for name, track in (("EKF2", result.ekf2_state), ("ground truth", result.truth)):
        if isinstance(track, pd.DataFrame):
            lines.append(Line2D([], [], **LINES[name], label=name))
    return page.legend([*lines, *event_marks.legend_entries(analysis)])


def draw_tracks(axes: Axes, result: AxisComparison, quantity: Quantity) -> None:
    """Draw position or velocity: measurements, KF with ±2σ, EKF2 and ground truth."""
    if quantity is POSITIONS:
        measurements = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        draw_curve(axes, measurements, **style.MEASUREMENT_DOTS)
    kf_values = result.replay.steps[quantity.column]
    draw_sigma_band(axes, kf_values, np.sqrt(result.replay.steps[quantity.variance]))
    drawn_series = [kf_values]
    for track, name in ((result.ekf2_state, "EKF2"), (result.truth, "ground truth")):
        if isinstance(track, pd.DataFrame) and track[quantity.column].notna().any():
            draw_curve(axes, track[quantity.column], **LINES[name], zorder=2.5)
            drawn_series.append(track[quantity.column])
    draw_curve(axes, kf_values, **LINES["KF"])
    # the ±2σ band is very wide in the first second, so the axis is scaled to the tracks
    all_values = pd.concat(drawn_series)
    pad = 0.08 * (all_values.max() - all_values.min()) + 1e-3
    axes.set_ylim(all_values.min() - pad, all_values.max() + pad)


def _position_sentence(_: Analysis, result: AxisComparison) -> str:
    extent_m = float(np.ptp(result.axis.measurement_m))
    return f"{len(result.replay.updates)} measurements over {extent_m:.3g} m."


def _error_numbers(result: AxisComparison, quantity: Quantity) -> list[str]:
    values = {
        name: getattr(filter_summary.truth, quantity.rmse, None)
        for name, filter_summary in filters_by_name(result).items()
    }
    errors = [
        f"{name} {error:.3f} {quantity.unit}" for name, error in values.items() if error is not None
    ]
    return [f"RMSE against ground truth {', '.join(errors)}"] if errors else []


def _position_numbers(result: AxisComparison) -> str:
    difference = result.difference
    text = (
        f"{difference.what}: {difference.reason}"
        if isinstance(difference, Unavailable)
        else f"KF - EKF2 RMS {difference.position_rms_m:.3f} m, mean "
        f"{difference.position_mean_m:+.3f} m, maximum {difference.position_maximum_m:.2f} m"
    )
    return "; ".join([*_error_numbers(result, POSITIONS), text])


def _velocity_numbers(result: AxisComparison) -> str:
    texts = _error_numbers(result, VELOCITIES)
    if isinstance(result.difference, Difference):
        texts.append(f"KF - EKF2 RMS {result.difference.velocity_rms_m_s:.3f} m/s")
    return "; ".join(texts)


def _axis_half_height(result: AxisComparison) -> float:
    half_heights_m = []
    for innovations in (result.replay.updates, result.ekf2_innovations):
        if isinstance(innovations, pd.DataFrame):
            median_sigma = float(np.sqrt(innovations["innovation_variance_m2"].median()))
            # a quantile, so that outliers do not enlarge the axis
            quantile_m = float(np.quantile(innovations["innovation_m"].abs(), 0.99))
            half_heights_m.append(
                max(2.0 * median_sigma, min(quantile_m, MAX_EDGE_SIGMAS * median_sigma))
            )
    return EDGE_FACTOR * max(half_heights_m)


def normalised_innovations(result: AxisComparison) -> dict[str, pd.Series[float]]:
    """Return ν/√S of KF and, if logged, of EKF2, by filter name."""
    return {
        name: (
            innovations["innovation_m"] / np.sqrt(innovations["innovation_variance_m2"])
        ).dropna()
        for name, innovations in (("KF", result.replay.updates), ("EKF2", result.ekf2_innovations))
        if isinstance(innovations, pd.DataFrame)
    }


def draw_dots(
    axes: Axes, values: pd.Series[float], limit: float, marker_style: dict[str, Any]
) -> None:
    """Draw dots between -limit and limit; values outside are triangles at the limits."""
    draw_curve(axes, values[values.abs() <= limit], **marker_style)
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        outside = values[sign * values > limit]
        triangles = {**marker_style, "marker": marker, "ms": 3.2, "clip_on": False}
        if len(outside):
            draw_curve(axes, 0.0 * outside + sign * limit, **triangles)


def draw_innovations(axes: Axes, result: AxisComparison) -> None:
    """Draw the innovations of KF and EKF2 with ±2√S; rejected innovations are hollow."""
    half_height, ekf2_innovations = _axis_half_height(result), result.ekf2_innovations
    updates = result.replay.updates
    kf_innovations = updates["innovation_m"]
    draw_sigma_band(axes, 0.0 * kf_innovations, np.sqrt(updates["innovation_variance_m2"]))
    axes.axhline(0.0, color="black", lw=0.5)
    dots = [(kf_innovations, DOTS["KF"])]
    if isinstance(ekf2_innovations, pd.DataFrame):
        two_sigma = 2.0 * np.sqrt(ekf2_innovations["innovation_variance_m2"])
        for side in (two_sigma, -two_sigma):
            draw_curve(axes, side, **LINES["EKF2"])
        is_rejected = ekf2_innovations["rejected"] > 0
        innovations = ekf2_innovations["innovation_m"]
        dots = [
            (innovations[~is_rejected], DOTS["EKF2"]),
            (innovations[is_rejected], style.EKF2_REJECTED),
            *dots,
        ]
    for values, marker_style in dots:
        draw_dots(axes, values, half_height, marker_style)
    axes.set_ylim(-1.04 * half_height, 1.04 * half_height)


def innovation_sentence(_: Analysis, result: AxisComparison) -> str:
    """Return the caption of the innovation plot."""
    half_height, sentences = _axis_half_height(result), []
    innovation_tables = {"KF": result.replay.updates, "EKF2": result.ekf2_innovations}
    for name, consistency in filters_by_name(result).items():
        if isinstance(consistency, Unavailable):
            sentences.append(f"{name}: {consistency.reason}.")
            continue
        table = innovation_tables[name]
        assert isinstance(table, pd.DataFrame)
        outside_count = int((table["innovation_m"].abs() > half_height).sum())
        outside = f"; outside the plot (triangles): {outside_count}" if outside_count else ""
        sentences.append(
            f"{name}: {consistency.count} innovations, {format_verdict(consistency)}; mean "
            f"{consistency.innovation_mean_m:+.3f} m, standard deviation "
            f"{consistency.innovation_std_m:.3f} m, median √S {consistency.sqrt_s_median_m:.3f} m"
            f"{outside}."
        )
    if isinstance(result.ekf2_state, Unavailable):
        sentences.append(f"EKF2: {result.ekf2_state.reason}.")
    elif isinstance(result.ekf2_innovations, pd.DataFrame):
        count = int((result.ekf2_innovations["rejected"] > 0).sum())
        sentences += [f"EKF2 rejected {count} positions (hollow dots)."] if count else []
    return " ".join(sentences)


def _innovation_numbers(result: AxisComparison) -> str:
    fractions = ", ".join(
        f"{name} {consistency.fraction_outside_two_sigma:.1%}"
        for name, consistency in filters_by_name(result).items()
        if isinstance(consistency, Consistency)
    )
    return f"{fractions} outside ±2√S (expected 5 %)" if fractions else ""


def _draw_sigma(axes: Axes, result: AxisComparison, quantity: Quantity) -> None:
    for variance, name in ((result.replay.steps, "KF"), (result.ekf2_variance, "EKF2")):
        if isinstance(variance, pd.DataFrame):
            draw_curve(axes, np.sqrt(variance[quantity.variance]), **LINES[name])
    set_log_scale(axes)


def sigma_sentence(analysis: Analysis, result: AxisComparison) -> str:
    """Return the caption of the σ plot: growth of σ in the longest gap of the position source."""
    if not analysis.events.gaps:
        return ""
    start, end = max(analysis.events.gaps, key=lambda gap: gap[1] - gap[0])
    largest_sigmas = {
        name: float(np.sqrt(variance.loc[start:end, "position_variance_m2"].max()))
        for name, variance in (
            ("KF", result.replay.steps),
            ("EKF2", result.in_flight.ekf2_variance),
        )
        if isinstance(variance, pd.DataFrame) and len(variance.loc[start:end]) > 1
    }
    growth = " and ".join(
        f"{sigma:.2g} m ({name})" for name, sigma in largest_sigmas.items() if np.isfinite(sigma)
    )
    return growth and f"In the gap of {end - start:.1f} s from {start:.0f} s, σ grew to {growth}."


def _median_text(result: AxisComparison, quantity: Quantity) -> str:
    medians = {
        name: getattr(filter_summary, quantity.sigma)
        for name, filter_summary in filters_by_name(result).items()
    }
    texts = [
        f"{name} not logged" if median is None else f"{name} {median:.3f} {quantity.unit}"
        for name, median in medians.items()
    ]
    return f"median: {', '.join(texts)}"


POSITION = Panel(
    "Position (m)",
    150.0,
    partial(draw_tracks, quantity=POSITIONS),
    _position_sentence,
    _position_numbers,
)
VELOCITY = Panel(
    "Velocity (m/s)",
    150.0,
    partial(draw_tracks, quantity=VELOCITIES),
    lambda *_: "Velocity is not measured: each filter estimates it from positions and IMU.",
    _velocity_numbers,
)
INNOVATIONS = Panel(
    "Innovations (m)",
    140.0,
    draw_innovations,
    innovation_sentence,
    _innovation_numbers,
)
SIGMA_P = Panel(
    "σ of position (m), log scale",
    80.0,
    partial(_draw_sigma, quantity=POSITIONS),
    sigma_sentence,
    partial(_median_text, quantity=POSITIONS),
)
SIGMA_V = Panel(
    "σ of velocity (m/s), log scale",
    60.0,
    partial(_draw_sigma, quantity=VELOCITIES),
    lambda *_: "",
    partial(_median_text, quantity=VELOCITIES),
)
