"""Plots on the first page of a report: map, position errors, and innovations ÷ √S."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from px4fuse.analysis import Analysis
from px4fuse.card.model import Card
from px4fuse.comparison.comparison import (
    compute_position_errors,
    interpolate_sigma,
    sample_kf_run,
)
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison, select_north_and_east
from px4fuse.core.arrays import Array
from px4fuse.core.text import format_metres, format_ratio
from px4fuse.filter.signals import AISLE, cut_to_segment
from px4fuse.flight.model import Ekf2, Truth
from px4fuse.report import event_marks, style
from px4fuse.report.page import (
    AXES_RIGHT_MARGIN,
    AXIS_LABEL_HEIGHT,
    TICKS_HEIGHT,
    UNLABELLED_HEIGHT,
    Page,
    PageBlock,
    count_wrapped_lines,
    make_two_columns,
    measure_text_width,
)
from px4fuse.report.panels import add_legend, draw_dots, normalised_innovations
from px4fuse.report.style import TRACK_STYLES, Axes, draw_curve

POINTS_PER_MM = 72.0 / 25.4
# Tracks with a larger ratio of length to width can have a map of full page width
MIN_ELONGATED_TRACK_RATIO = 2.2
# Minimum and maximum height (points) of the map
MAP_HEIGHT_RANGE = 40.0 * POINTS_PER_MM, 53.0 * POINTS_PER_MM
# With less free height (points) on the first page, the plots are on the next page
MIN_PLOTS_HEIGHT = 38.0 * POINTS_PER_MM
# Minimum free height (points) for a plot of the innovations
MIN_HEIGHT_FOR_INNOVATION_PLOT = 50.0 * POINTS_PER_MM
# Minimum and maximum height (points) of the innovation plot
INNOVATION_PLOT_HEIGHT_RANGE = 27.0 * POINTS_PER_MM, 38.0 * POINTS_PER_MM
# Minimum height (points) of a plot of position errors
MIN_ERROR_PLOT_HEIGHT = 17.0 * POINTS_PER_MM
# Height (points) of all plots on the next page
NEXT_PAGE_PLOTS_HEIGHT = 160.0 * POINTS_PER_MM
TITLE_HEIGHT = 16.5  # points, for one line with gaps
TITLE_LINE_HEIGHT = 10.5  # points, for each further line
# Height (points) of the gaps above and below the plots
UNUSED_PAGE_HEIGHT = 15.0
# Minimum height (points) of an innovation plot with ticks at ±2
MIN_HEIGHT_FOR_TICKS_AT_2_SIGMA = 48.0
# Minimum width (points) of a plot with six time ticks
MIN_WIDE_PLOT_WIDTH = 200.0
LEFT_MARGIN = 38.0  # points, for labels left of the axes
INNOVATION_HEIGHT_FRACTION = 0.22
MAP_HEIGHT_FRACTION = 0.25
# Larger innovations ÷ √S are triangles at the edge of the plot
MAX_DRAWN_SIGMAS = 4.0
LABELLED_HEIGHT = TICKS_HEIGHT + AXIS_LABEL_HEIGHT  # points, for labels below a plot
# Extent of the map divided by the extent of the tracks
MAP_MARGIN_FACTOR = 1.08
# Maximum margin of the map, as fraction of the extent of the positions
MAX_MAP_MARGIN_FRACTION = 0.25
MIN_MAP_EXTENT_M = 0.5
# For a smaller ratio of largest to smallest σ, plot titles state the median instead of the range
MAX_SIGMA_RATIO_SHOWN_AS_MEDIAN = 1.5
# Time (s) after the start of a filter that plot titles exclude from σ
SIGMA_SETTLING_DURATION_S = 2.0
Coordinates = tuple[Array, Array]


class TimePlot(NamedTuple):
    """Plot over time: title, and function that draws the plot."""

    title: str
    draw: Callable[[Axes], None]


class FlightMap(NamedTuple):
    """Tracks seen from above, in m to the right and upwards, with axis labels."""

    tracks: Mapping[str, Coordinates]
    x_labels: Sequence[str]
    y_label: str


def write_panels(block: PageBlock, analysis: Analysis, card: Card, free_height: float) -> None:
    """Draw legend, map and plots over time on the first page."""
    page = Page()
    block["blocks"] = page.blocks
    legend = add_legend(page, analysis)
    error_plots, innovation_plot = (
        _make_error_plots(analysis, card),
        _make_innovation_plot(analysis.main),
    )
    flight_map = _make_flight_map(analysis, card)
    plots_height = free_height - legend["height"] - UNUSED_PAGE_HEIGHT
    if plots_height < MIN_PLOTS_HEIGHT:
        plots_height = NEXT_PAGE_PLOTS_HEIGHT
        note = Page()
        if free_height > UNUSED_PAGE_HEIGHT:
            note.write_small_text("Plots of the map, the errors and the innovations: next page.")
        page.blocks[:0] = [*note.blocks, {"kind": "break"}]
    min_wide_map_height = (
        MAP_HEIGHT_RANGE[0]
        + INNOVATION_PLOT_HEIGHT_RANGE[0]
        + len(error_plots) * MIN_ERROR_PLOT_HEIGHT
    )
    innovation_plot_height = float(
        np.clip(INNOVATION_HEIGHT_FRACTION * plots_height, *INNOVATION_PLOT_HEIGHT_RANGE)
    )
    length_m, width_m = np.ptp(flight_map.tracks["positions"], axis=1)
    is_track_elongated = length_m >= MIN_ELONGATED_TRACK_RATIO * max(width_m, 1e-6)
    if is_track_elongated and plots_height >= min_wide_map_height:
        map_height = float(np.clip(MAP_HEIGHT_FRACTION * plots_height, *MAP_HEIGHT_RANGE))
        _draw_map(page, analysis, flight_map, map_height)
        error_plot_heights = _compute_plot_heights(
            page, error_plots, plots_height - map_height - innovation_plot_height
        )
        _draw_plots(
            page,
            analysis,
            [*error_plots, innovation_plot],
            [*error_plot_heights, innovation_plot_height],
        )
        return
    columns, map_height = make_two_columns(), plots_height
    if not error_plots:
        error_plots = [innovation_plot]
    elif plots_height >= MIN_HEIGHT_FOR_INNOVATION_PLOT:
        map_height -= innovation_plot_height
    _draw_map(columns[0], analysis, flight_map, map_height)
    if map_height < plots_height:
        _draw_plots(columns[0], analysis, [innovation_plot], [innovation_plot_height])
    label_height = LABELLED_HEIGHT - UNLABELLED_HEIGHT
    plot_heights = _compute_plot_heights(columns[1], error_plots, plots_height - label_height)
    plot_heights[-1] += label_height
    _draw_plots(columns[1], analysis, error_plots, plot_heights)
    page.add_columns(*columns, gap_above=0.0)


def _draw_plots(
    page: Page, analysis: Analysis, plots: Sequence[TimePlot], plot_heights: Sequence[float]
) -> None:
    """Draw plots over time with given heights (points)."""
    for plot, height in zip(plots, plot_heights, strict=True):
        is_last = plot is plots[-1]
        height_below_axes = LABELLED_HEIGHT if is_last else UNLABELLED_HEIGHT
        axes_height = height - _find_title_height(page, plot.title) - height_below_axes
        axes = _add_panel(page, plot.title, axes_height)
        event_marks.draw_event_markers(axes, analysis)
        plot.draw(axes)
        style.label_time_axis(axes, is_last)


def _add_panel(page: Page, title: str, axes_height: float) -> Axes:
    axes = page.add_panel(title, axes_height, left_margin=LEFT_MARGIN, is_compact=True)
    axes.locator_params(axis="x", nbins=6 if page.width > MIN_WIDE_PLOT_WIDTH else 4)
    return axes


def _compute_plot_heights(
    page: Page, plots: Sequence[TimePlot], total_height: float
) -> list[float]:
    """Return heights (points) of plots, so that all axes have the same height."""
    title_heights = [_find_title_height(page, plot.title) for plot in plots]
    axes_height = (total_height - sum(title_heights)) / max(len(plots), 1)
    return [axes_height + title_height for title_height in title_heights]


def _find_title_height(page: Page, title: str) -> float:
    return TITLE_HEIGHT + TITLE_LINE_HEIGHT * (count_wrapped_lines(title, page.width) - 1)


def _make_error_plots(analysis: Analysis, card: Card) -> list[TimePlot]:
    """Return plots of the position errors of KF and EKF2, or of their difference."""
    result, effect = analysis.main.with_whole_flight_tracks(), card.effect
    errors_by_filter = {
        filter_name: errors
        for filter_name in FILTER_NAMES
        if isinstance(errors := compute_position_errors(result, filter_name), pd.DataFrame)
        and errors["error_m"].notna().any()
    }
    if errors_by_filter:
        half_range_m = 1.1 * max(map(_compute_error_axis_limit_m, errors_by_filter.values()))
        rmse_by_filter_m = effect.position_rmse_m if effect else {}
        return [
            _make_error_plot(
                f"{(name := FILTER_NAMES[filter_name])} error (m)",
                ("RMSE", rmse_by_filter_m.get(filter_name)),
                errors["error_m"],
                {name: errors["sigma_m"]},
                half_range_m,
            )
            for filter_name, errors in errors_by_filter.items()
        ]
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return []
    time_s = result.ekf2_state.index.to_numpy()
    state, variance = sample_kf_run(result.replay, time_s)
    difference_m = state["position_m"] - result.ekf2_state["position_m"]
    if not difference_m.notna().any():
        return []
    sigmas_m = {
        name: pd.Series(interpolate_sigma(time_s, frame, "position_variance_m2"), time_s)
        for name, frame in (("KF", variance), ("EKF2", result.ekf2_variance))
    }
    sigma_limits_m = [2.2 * sigma.median() for sigma in sigmas_m.values() if sigma.notna().any()]
    half_range_m = 1.1 * max(float(difference_m.abs().max()), *sigma_limits_m)
    label_and_rms = ("RMS", effect.difference_rms_m if effect else None)
    return [_make_error_plot("KF − EKF2 (m)", label_and_rms, difference_m, sigmas_m, half_range_m)]


def _make_error_plot(
    label: str,
    label_and_rms: tuple[str, float | None],
    error_m: pd.Series[float],
    sigmas: Mapping[str, pd.Series[float]],
    half_range_m: float,
) -> TimePlot:
    rms_label, rms_m = label_and_rms
    statistic_texts = [] if rms_m is None else [f"{rms_label} {format_metres(rms_m)}"]
    finite_sigmas = {
        name: finite_sigma
        for name, sigma in sigmas.items()
        if not (finite_sigma := sigma.dropna()).empty
    }
    sigma_texts = [
        f"{name} {_format_sigma(sigma)}" if len(sigmas) > 1 else _format_sigma(sigma)
        for name, sigma in finite_sigmas.items()
    ]
    if sigma_texts:
        statistic_texts.append(f"σ {', '.join(sigma_texts)}")
    line = TRACK_STYLES[next(iter(sigmas))] if len(sigmas) == 1 else style.line_style("black", 1.0)

    def draw(axes: Axes) -> None:
        axes.set_ylim(-half_range_m, half_range_m)
        for name, sigma in finite_sigmas.items():
            style.draw_sigma_band(axes, 0.0 * sigma, sigma, style.SIGMA_BAND_COLOURS[name])
        style.draw_zero_line(axes)
        draw_curve(axes, error_m, **line)

    return TimePlot(f"{label}: {', '.join(statistic_texts)}", draw)


def _compute_error_axis_limit_m(errors: pd.DataFrame) -> float:
    largest_error_m, median_sigma_m = (
        float(errors["error_m"].abs().max()),
        errors["sigma_m"].median(),
    )
    return max(
        largest_error_m,
        1e-3,
        min(2.2 * median_sigma_m, 3.0 * largest_error_m) if np.isfinite(median_sigma_m) else 0.0,
    )


def _format_sigma(sigma: pd.Series[float]) -> str:
    sigma_after_settling = sigma[
        sigma.index >= min(sigma.index[0] + SIGMA_SETTLING_DURATION_S, sigma.index[-1])
    ]
    min_sigma_m, max_sigma_m = float(sigma_after_settling.min()), float(sigma_after_settling.max())
    if max_sigma_m < MAX_SIGMA_RATIO_SHOWN_AS_MEDIAN * min_sigma_m:
        return format_metres(float(sigma_after_settling.median()))
    return f"{format_metres(min_sigma_m)} to {format_metres(max_sigma_m)}"


def _make_innovation_plot(result: AxisComparison) -> TimePlot:
    innovations = normalised_innovations(result)
    legend = ", ".join(f"{sign} {name}" for name, sign in zip(innovations, "●■", strict=False))
    titles = [f"Innovations ÷ √S ({legend}): 95 % expected within ±2"]
    clipped_texts = [
        f"{name} {format_ratio(ratio)}"
        for name, values in innovations.items()
        if (ratio := float(values.abs().max())) > MAX_DRAWN_SIGMAS
    ]
    if clipped_texts:
        titles.append(f"▲▼ beyond ±{MAX_DRAWN_SIGMAS:g}, largest {', '.join(clipped_texts)}")

    def draw(axes: Axes) -> None:
        axes.set_ylim(-1.12 * MAX_DRAWN_SIGMAS, 1.12 * MAX_DRAWN_SIGMAS)
        height = axes.bbox.height * 72.0 / axes.figure.dpi
        axes.set_yticks(
            np.arange(-4.0, 4.1, 2.0 if height >= MIN_HEIGHT_FOR_TICKS_AT_2_SIGMA else 4.0)
        )
        axes.axhspan(-2.0, 2.0, color=style.CONSISTENT_BAND_COLOUR, lw=0, zorder=0.05)
        style.draw_zero_line(axes)
        for name in reversed(innovations):
            draw_dots(
                axes,
                innovations[name],
                MAX_DRAWN_SIGMAS,
                style.INNOVATION_STYLES[name],
            )

    return TimePlot("; ".join(titles), draw)


def _select_map_tracks(analysis: Analysis) -> dict[str, Coordinates]:
    """Return the positions, KF, EKF2 and ground truth tracks as north and east (m)."""
    segment, flight = analysis.segment.whole_flight, analysis.flight

    def cut_to_flight(track: pd.DataFrame) -> Coordinates:
        segment_track = cut_to_segment(track, segment)
        return segment_track["north_m"].to_numpy(), segment_track["east_m"].to_numpy()

    tracks = {"positions": cut_to_flight(analysis.source.samples)}
    results = select_north_and_east(analysis)
    if len(results) == 2:
        north, east = (result.replay.steps["position_m"].to_numpy() for result in results)
        tracks["KF"] = north, east
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut_to_flight(flight.ekf2.state)
    if isinstance(flight.truth, Truth):
        tracks["ground truth"] = cut_to_flight(flight.truth.samples)
    return {name: track for name, track in tracks.items() if len(track[0])}


def _make_flight_map(analysis: Analysis, card: Card) -> FlightMap:
    """Return a map with the main flight direction to the right, or with north upwards."""
    aisle_heading_deg = next(
        (line.heading_deg for line in analysis.input_axes if line.name == AISLE), None
    )
    heading_rad, x_labels, y_label = np.pi / 2.0, ["east (m)"], "north (m)"
    if aisle_heading_deg is not None:
        heading_rad, y_label = np.deg2rad(aisle_heading_deg % 180.0), "left (m)"
        axis = card.effect.axis if card.effect else "along the aisle"
        x_labels = [f"{text} (m)" for text in (axis, axis.partition(", ")[2], "main axis")]
    elif analysis.source.frame == "FRD":
        name = analysis.source.name
        x_labels, y_label = [f"y of {name} (m)", "y (m)"], f"x of {name} (m)"
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    tracks = {
        name: (cosine * north + sine * east, sine * north - cosine * east)
        for name, (north, east) in _select_map_tracks(analysis).items()
    }
    return FlightMap(tracks, x_labels, y_label)


def _draw_map(page: Page, analysis: Analysis, flight_map: FlightMap, height: float) -> None:
    tracks, width = flight_map.tracks, page.width - LEFT_MARGIN - AXES_RIGHT_MARGIN
    title, axes_height = "Map", height - TITLE_HEIGHT - LABELLED_HEIGHT
    limits = _compute_map_limits(tracks, width / axes_height)
    distance_texts = []
    for name, coordinates in tracks.items():
        track = np.transpose(coordinates)
        distance_m = np.nanmax(np.abs(track - np.clip(track, *limits)))
        if distance_m > 0.0:
            distance_texts.append(f"{name} {format_metres(distance_m)} m")
    if distance_texts:
        title = f"Map; largest distance of points outside the map: {', '.join(distance_texts)}"
        axes_height = height - _find_title_height(page, title) - LABELLED_HEIGHT
        limits = _compute_map_limits(tracks, width / axes_height)
    axes = _add_panel(page, title, axes_height)
    x_label = next(
        text for text in flight_map.x_labels if measure_text_width(text) < page.width - LEFT_MARGIN
    )
    (left, bottom), (right, top) = limits
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel=x_label, ylabel=flight_map.y_label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(True, axis="both")
    for name, (map_x_m, map_y_m) in tracks.items():
        if name == "positions":
            axes.plot(map_x_m, map_y_m, **style.MEASUREMENT_STYLE | {"ms": 2.4})
        else:
            stride = max(1, len(map_x_m) // style.MAX_WIDE_AXES_POINTS)
            axes.plot(map_x_m[::stride], map_y_m[::stride], **TRACK_STYLES[name])
    position_times = cut_to_segment(analysis.source.samples, analysis.segment.whole_flight).index
    map_x_m, map_y_m = tracks["positions"]
    for times, marker_style in (
        (analysis.events.take_off_times_s, event_marks.TAKE_OFF_MARKER_STYLE),
        (analysis.events.landing_times_s, event_marks.LANDING_MARKER_STYLE),
    ):
        position_rows = position_times.get_indexer(pd.Index(times, dtype=float), method="nearest")
        large_marker_style = marker_style | {"ms": 9.0, "mec": "white", "mew": 0.8}
        axes.plot(map_x_m[position_rows], map_y_m[position_rows], **large_marker_style)


def _compute_map_limits(
    tracks: Mapping[str, Coordinates], aspect_ratio: float
) -> tuple[Array, Array]:
    """Return the lower left and the upper right corner of the map (m)."""
    # Tracks are clipped, because a diverged filter would make the flight tiny on the map
    centres_m, sizes_m = [], []
    for axis_index in (0, 1):
        range_ends_m = [np.percentile(tracks["positions"][axis_index], (1.0, 99.0))]
        if "ground truth" in tracks:
            range_ends_m.append(_compute_min_and_max(tracks["ground truth"][axis_index]))
        range_low_m, range_high_m = _compute_min_and_max(range_ends_m)
        margin_m = MAX_MAP_MARGIN_FRACTION * (range_high_m - range_low_m)
        limits_m = range_low_m - margin_m, range_high_m + margin_m
        range_ends_m += [
            np.clip(_compute_min_and_max(track[axis_index]), *limits_m) for track in tracks.values()
        ]
        range_low_m, range_high_m = _compute_min_and_max(range_ends_m)
        centres_m.append(0.5 * (range_low_m + range_high_m))
        sizes_m.append(max(MAP_MARGIN_FACTOR * (range_high_m - range_low_m), MIN_MAP_EXTENT_M))
    map_length_m = max(sizes_m[0], sizes_m[1] * aspect_ratio)
    half_size_m = 0.5 * np.array([map_length_m, map_length_m / aspect_ratio])
    return np.array(centres_m) - half_size_m, np.array(centres_m) + half_size_m


def _compute_min_and_max(values: ArrayLike) -> Array:
    return np.array([np.nanmin(values), np.nanmax(values)])
