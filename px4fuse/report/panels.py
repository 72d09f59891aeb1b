"""Plots of KF and EKF2 over time, with events: gaps, resets, rejections and outliers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison, FilterDifference, FilterTracks
from px4fuse.core.arrays import Array
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight.model import Unavailable

from . import style
from .page import Page, PageBlock
from .phrases import format_sigma_verdict, get_statistics_by_filter
from .style import (
    INNOVATION_STYLES,
    REJECTED_INNOVATION_STYLE,
    TRACK_STYLES,
    Artist,
    Axes,
    dot_style,
    draw_curve,
    draw_sigma_band,
    set_log_scale,
)

NARROW_PLOT_HEIGHT = 72.0  # points
# Limit of the innovation axis ÷ largest innovation that the axis must show
INNOVATION_AXIS_MARGIN_FACTOR = 1.3
# The axis shows innovations up to this multiple of the median √S
MAX_AXIS_LIMIT_IN_INNOVATION_SIGMAS = 5.0
# The bands differ in shade and hatching, because reports may be printed in greyscale
_BAND_STYLE: dict[str, Any] = {"edgecolor": "none", "lw": 0.0}
ON_GROUND_BAND_STYLE = _BAND_STYLE | {"facecolor": "#e4e4e4"}
DROPOUT_BAND_STYLE = _BAND_STYLE | {"facecolor": "#a8a8a8"}
GAP_BAND_STYLE = _BAND_STYLE | {"facecolor": "#fbfbfb", "edgecolor": "#9a9a9a", "hatch": "/////"}
RESET_MARKER_STYLE = dot_style("#8a4508", 2, 6.0, 1.2)
OUTLIER_MARKER_STYLE = dot_style("black", "x", 3.0, 0.7)
TAKE_OFF_MARKER_STYLE, LANDING_MARKER_STYLE = (
    dot_style("black", "*", 6.0),
    dot_style("black", "P", 5.0),
)


class EventMarkers(NamedTuple):
    """Events of one type as markers or bands in a plot over time.

    Attributes
    ----------
    height : float or None
        Height of markers as fraction of the axes; None for bands.
    """

    label: str
    event_times_or_spans_s: Sequence[Any] | Array
    style: dict[str, Any]
    height: float | None = None


def _make_event_markers(
    analysis: Analysis, rejection_times_s: Sequence[float] | Array
) -> list[EventMarkers]:
    """Return the events to mark in plots over time: bands for time spans, symbols for times."""
    events = analysis.events
    event_markers = (
        EventMarkers("on the ground", events.ground_spans_s, ON_GROUND_BAND_STYLE),
        EventMarkers("position gap", events.gaps, GAP_BAND_STYLE),
        EventMarkers("log dropout", events.dropouts, DROPOUT_BAND_STYLE),
        EventMarkers("EKF2 rejected", rejection_times_s, REJECTED_INNOVATION_STYLE, 0.025),
        EventMarkers("outlier", find_outlier_times(analysis), OUTLIER_MARKER_STYLE, 0.075),
        EventMarkers("EKF2 reset", events.reset_times_s, RESET_MARKER_STYLE, 0.92),
        EventMarkers("take-off", events.take_off_times_s, TAKE_OFF_MARKER_STYLE, 0.0),
        EventMarkers("landing", events.landing_times_s, LANDING_MARKER_STYLE, 0.0),
    )
    return [markers for markers in event_markers if len(markers.event_times_or_spans_s)]


def add_time_panel(
    page: Page,
    analysis: Analysis,
    title: str,
    height: float,
    *,
    axis: str = "",
    with_time_label: bool = True,
    **options: Any,
) -> Axes:
    """Add a plot over time with gaps, resets, rejections and outliers."""
    axes = page.add_panel(title, height, **options)
    segment, x_transform = analysis.segment.whole_flight, axes.get_xaxis_transform()
    axes.set_xlim(segment.start_s, segment.end_s)
    if with_time_label:
        axes.set_xlabel(style.TIME_LABEL)
    axis_name = axis or analysis.main.axis.name
    rejection_times_s = analysis.events.rejection_times_s.get(axis_name, ())
    event_markers = _make_event_markers(analysis, rejection_times_s)
    for order, (_, times_or_spans_s, event_style, marker_height) in enumerate(event_markers, 1):
        if marker_height is None:  # bands over the whole height; later bands are on top
            starts_and_durations_s = [
                (start_s, end_s - start_s) for start_s, end_s in times_or_spans_s
            ]
            band_style = event_style | {"transform": x_transform, "zorder": 0.1 * order}
            axes.broken_barh(starts_and_durations_s, (0.0, 1.0), **band_style)
        else:
            heights = pd.Series(marker_height, np.asarray(times_or_spans_s, np.float64))
            # Markers at the lower edge (height 0) are drawn completely
            marker_style = event_style | {"zorder": 2.6, "clip_on": marker_height > 0.0}
            draw_curve(axes, heights, transform=x_transform, **marker_style)
    return axes


def find_outlier_times(analysis: Analysis) -> Array:
    """Return the times (s) of outliers of the position source."""
    tunings = map(analysis.tuning.get, (HORIZONTAL, analysis.main.axis.name))
    times_s = [tuning.outlier_time_s for tuning in tunings if isinstance(tuning, AxisTuning)]
    return np.asarray(np.unique(np.concatenate([[], *times_s])))


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


def draw_panels(
    page: Page,
    analysis: Analysis,
    result: AxisComparison,
    panels: Sequence[Panel],
    *,
    is_narrow: bool = False,
) -> None:
    """Draw plots below each other, with one common time axis; narrow plots have no captions."""
    for panel in panels:
        texts = [panel.make_statistics_text(result)]
        if not is_narrow:
            texts.append(panel.make_caption(result))
        axes = add_time_panel(
            page,
            analysis,
            panel.title,
            NARROW_PLOT_HEIGHT if is_narrow else panel.height,
            axis=result.axis.name,
            with_time_label=panel is panels[-1],
            caption=". ".join(filter(None, texts)),
        )
        panel.draw(axes, result.with_whole_flight_tracks())


def add_legend(page: Page, analysis: Analysis) -> PageBlock:
    """Add the legend of all plots over time: tracks, σ bands, and the events of the flight."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    all_rejection_times_s = [
        time for times in analysis.events.rejection_times_s.values() for time in times
    ]
    entries: list[Artist] = [
        Line2D([], [], **style.MEASUREMENT_STYLE | {"ms": 5.0}, label="position"),
        Patch(facecolor=style.KF_BAND_COLOUR, lw=0, label="±2σ reported"),
        *(
            Line2D([], [], **TRACK_STYLES[name], label=name)
            for name in _collect_states(analysis.main)
        ),
        *(
            Patch(**event_style, label=label)
            if height is None
            else Line2D([], [], **event_style, label=label)
            for label, _, event_style, height in _make_event_markers(
                analysis, all_rejection_times_s
            )
        ),
    ]
    return page.add_legend(entries)


def _select_available_tables(
    result: AxisComparison, get_table: Callable[[FilterTracks], object]
) -> dict[str, pd.DataFrame]:
    """Return a table of each filter, by the label of the filter."""
    return {
        FILTER_NAMES[name]: table
        for name, tracks in result.tracks.items()
        if isinstance(table := get_table(tracks), pd.DataFrame)
    }


def _collect_states(result: AxisComparison) -> dict[str, pd.DataFrame]:
    """Return positions and velocities of KF, of the other filters and of ground truth."""
    states = _select_available_tables(result, lambda tracks: tracks.state)
    if isinstance(result.truth, pd.DataFrame):
        states["ground truth"] = result.truth
    return states


def draw_tracks(axes: Axes, result: AxisComparison, quantity: QuantityColumns) -> None:
    """Draw position or velocity: measurements, KF with ±2σ, other filters and ground truth."""
    if quantity is POSITION_QUANTITY:
        measurements = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        draw_curve(axes, measurements, **style.MEASUREMENT_STYLE)
    kf_steps = result.kf_run.steps
    draw_sigma_band(axes, kf_steps[quantity.column], np.sqrt(kf_steps[quantity.variance_column]))
    states = _collect_states(result)
    for name, state in states.items():
        # KF below the other tracks
        zorder = 2.0 if name == "KF" else 2.5
        draw_curve(axes, state[quantity.column], **TRACK_STYLES[name], zorder=zorder)
    # The ±2σ band is very wide at the start, so it does not set the axis limits
    all_values = pd.concat([state[quantity.column] for state in states.values()])
    margin = 0.08 * (all_values.max() - all_values.min()) + 1e-3
    axes.set_ylim(all_values.min() - margin, all_values.max() + margin)


def _describe_errors(result: AxisComparison, quantity: QuantityColumns) -> str:
    """State RMSE of each filter against ground truth, and RMS difference KF - EKF2."""
    rmse_texts = [
        f"{name} {rmse:.3f} {quantity.unit}"
        for name, filter_summary in get_statistics_by_filter(result).items()
        if (rmse := getattr(filter_summary.truth, quantity.rmse_field_name, None)) is not None
    ]
    texts = [f"RMSE against ground truth {', '.join(rmse_texts)}"] if rmse_texts else []
    if isinstance(result.difference, FilterDifference):
        difference_rms = getattr(result.difference, quantity.difference_field_name)
        texts.append(f"KF - EKF2 RMS {difference_rms:.3f} {quantity.unit}")
    return "; ".join(texts)


def _find_innovation_limit_m(result: AxisComparison) -> float:
    """Return the limit (m) of the innovation axis for all filters."""
    limits_m = []
    for innovations in _collect_innovation_tables(result).values():
        median_innovation_sigma_m = np.sqrt(innovations["innovation_variance_m2"].median())
        # a quantile, because outliers would enlarge the axis
        quantile_m = np.quantile(innovations["innovation_m"].abs(), 0.99)
        highest_limit_m = MAX_AXIS_LIMIT_IN_INNOVATION_SIGMAS * median_innovation_sigma_m
        limits_m.append(
            float(np.clip(quantile_m, 2.0 * median_innovation_sigma_m, highest_limit_m))
        )
    return INNOVATION_AXIS_MARGIN_FACTOR * max(limits_m)


def _collect_innovation_tables(result: AxisComparison) -> dict[str, pd.DataFrame]:
    return _select_available_tables(result, lambda tracks: tracks.innovations)


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
    """Draw the innovations of all filters with ±2√S; KF, with a shaded band, is in front."""
    plot_limit_m = _find_innovation_limit_m(result)
    style.draw_zero_line(axes)
    for name, table in reversed(_collect_innovation_tables(result).items()):
        innovations, sqrt_s_m = table["innovation_m"], np.sqrt(table["innovation_variance_m2"])
        if name == "KF":
            draw_sigma_band(axes, 0.0 * innovations, sqrt_s_m)
        else:
            for limit in (2.0 * sqrt_s_m, -2.0 * sqrt_s_m):
                draw_curve(axes, limit, **TRACK_STYLES[name])
        is_rejected = table.get("rejected", 0.0 * innovations) > 0
        draw_dots(axes, innovations[~is_rejected], plot_limit_m, INNOVATION_STYLES[name])
        if "rejected" in table:
            draw_dots(axes, innovations[is_rejected], plot_limit_m, REJECTED_INNOVATION_STYLE)
    axes.set_ylim(-1.04 * plot_limit_m, 1.04 * plot_limit_m)


def _describe_innovations(result: AxisComparison) -> str:
    """State number, verdict, mean and standard deviation of the innovations of each filter."""
    sentences = []
    for name, consistency in result.filters.items():
        label = FILTER_NAMES[name]
        if isinstance(consistency, Unavailable):
            sentences.append(f"{label}: {consistency.reason}.")
            continue
        verdict_text = format_sigma_verdict(consistency.verdict, consistency.sigma_error_factor)
        sentences.append(
            f"{label}: {consistency.count} innovations, {verdict_text}; mean "
            f"{consistency.innovation_mean_m:+.3f} m, standard deviation "
            f"{consistency.innovation_std_m:.3f} m, median √S {consistency.sqrt_s_median_m:.3f} m."
        )
    return " ".join(
        [*sentences, "Triangles: values outside the plot. Hollow dots: rejected positions."]
    )


def _format_fraction_outside_two_sigma(result: AxisComparison) -> str:
    """Format the fraction of innovations outside ±2√S of each tested filter; "" without one."""
    fractions_text = ", ".join(
        f"{name} {consistency.fraction_outside_two_sigma:.1%}"
        for name, consistency in get_statistics_by_filter(result).items()
        if isinstance(consistency, Consistency)
    )
    return f"{fractions_text} outside ±2√S (expected 5 %)" if fractions_text else ""


def _draw_sigma(axes: Axes, result: AxisComparison, quantity: QuantityColumns) -> None:
    for name, table in _select_available_tables(result, lambda tracks: tracks.variance).items():
        draw_curve(axes, np.sqrt(table[quantity.variance_column]), **TRACK_STYLES[name])
    set_log_scale(axes)


def _format_median_sigma(result: AxisComparison, quantity: QuantityColumns) -> str:
    """Format the median of the reported σ of position or velocity for each filter."""
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
    "Innovations (m)",
    140.0,
    draw_innovations,
    _format_fraction_outside_two_sigma,
    _describe_innovations,
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
