"""Panels of the cover: map, position errors of KF and EKF2, innovations.

Values outside of a panel are marked by triangles at its edge.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.card.build import horizontal_resets
from px4fuse.card.model import Card
from px4fuse.card.numbers import format_metres, format_ratio
from px4fuse.comparison.comparison import kf_state_and_variance, position_errors, reported_sigma
from px4fuse.comparison.model import FILTERS, AxisComparison
from px4fuse.core.arrays import Array
from px4fuse.filter.signals import AISLE, cut_to_segment
from px4fuse.flight.model import Ekf2, Truth
from px4fuse.report import style
from px4fuse.report.card_text import FILTER_NAMES
from px4fuse.report.event_marks import (
    DROPOUT_BAND,
    GAP_BAND,
    LANDING_MARK,
    OUTLIER_MARK,
    TAKE_OFF_MARK,
    outlier_times,
    visible_times,
)
from px4fuse.report.page import (
    AXES_RIGHT,
    AXIS_LABEL_HEIGHT,
    COLUMN_GAP,
    PAGE_WIDTH,
    TICKS_HEIGHT,
    UNLABELLED_HEIGHT,
    Block,
    Page,
    halves,
    line_count,
    text_width,
)
from px4fuse.report.panels import normalised_innovations
from px4fuse.report.style import LINES, Artist, Axes, draw_curve

POINTS_PER_MM = 72.0 / 25.4
# Minimum length / width of the track for panels that fill the page width
MIN_LONG_RATIO = 2.2
# Least and largest height (pt) of the map, with title and labels
MAP_HEIGHTS = 40.0 * POINTS_PER_MM, 53.0 * POINTS_PER_MM
# Least total heights (pt) of the panels in two columns and in three columns
MIN_HALVES_HEIGHT, MIN_THIRDS_HEIGHT = 50.0 * POINTS_PER_MM, 38.0 * POINTS_PER_MM
INNOVATION_HEIGHTS = 27.0 * POINTS_PER_MM, 38.0 * POINTS_PER_MM
MIN_ERROR_HEIGHT = 17.0 * POINTS_PER_MM
# Total height (pt) of the panels on the next page, if the card fills the first one
NEXT_PAGE_HEIGHT = 160.0 * POINTS_PER_MM
# Heights (pt): title with gaps, each further line of it, gap above the legend, unused rest
TITLE_HEIGHT, TITLE_LINE, LEGEND_GAP, SPARE_HEIGHT = 16.5, 10.5, 11.0, 4.0
# Minimum height (pt) of the innovations for ticks at ±2 besides -4, 0 and 4
MIN_TICKS_HEIGHT = 48.0
MIN_WIDE_PANEL = 200.0  # minimum width (pt) of a panel for six ticks of the time axis
LEFT_MARGIN = 38.0  # width (pt) for tick and axis labels left of the axes
# Fraction of the height of all panels for the innovations, and for the map
INNOVATION_SHARE, MAP_SHARE = 0.22, 0.25
# Maximum number of drawn innovations per filter; those beyond the scale are always drawn
MAX_DRAWN_INNOVATIONS = 400
MAX_NORMALISED = 4.0
# Height (pt) below the axes, without and with labels of the time axis
HEIGHT_BELOW_AXES = UNLABELLED_HEIGHT, TICKS_HEIGHT + AXIS_LABEL_HEIGHT
MAP_MARGIN, MAP_REACH, MIN_MAP_LENGTH_M = 1.08, 0.25, 0.5
# Minimum distance between two triangles of a track, as a fraction of the map's length
MIN_EXIT_DISTANCE = 0.02
# Maximum part of the scale that a curve fills if the title calls it flat
FLAT_SHARE = 0.1
FLAT_INNOVATIONS = 1.0
# Maximum ratio of the largest to the smallest σ for a title with one value of σ
MAX_SIGMA_SPREAD = 1.5
# Time (s) in which σ settles at the start; titles do not include its values
SETTLING_S = 2.0
# Markers of the innovations; the title of their panel shows the same symbols
INNOVATION_DOTS: Mapping[str, dict[str, Any]] = {
    "KF": style.KF_DOTS,
    "EKF2": style.EKF2_DOTS | {"ms": 2.8, "mew": 0.6, "mfc": "none"},
}
# Minimum distance of two marks as a fraction of the axes; of closer marks one is drawn
MIN_MARK_DISTANCE = 1.0 / 150.0
GAP_HATCH: dict[str, Any] = {
    **GAP_BAND,
    "facecolor": "none",
}  # no fill, so that σ in the gap is visible
RESET_LINE = style.line_style(style.EKF2_COLOUR, 1.0, (0, (1, 1)))
REJECTED_MARK = style.dot_style("black", "|", 5.0, 0.7)
Coordinates = tuple[Array, Array]
MapLimits = tuple[tuple[float, float], tuple[float, float]]
DrawStrip = Callable[[Axes], None]


class Strip(NamedTuple):
    """Small plot over time: title, and the function that draws it."""

    title: str
    draw: DrawStrip


class FlightMap(NamedTuple):
    """Flight from above: tracks in metres to the right and upwards, and the axis labels.

    Of ``right_labels`` the first that fits is used.
    """

    tracks: Mapping[str, Coordinates]
    right_labels: Sequence[str]
    up_label: str
    to_map: Callable[[Any, Any], Coordinates]

    @property
    def is_long(self) -> bool:
        """True if the track is so long and narrow that the panels fill the page width."""
        length_m, width_m = (float(np.ptp(values)) for values in self.tracks["positions"])
        return length_m >= MIN_LONG_RATIO * max(width_m, 1e-6)


def write_panels(block: Block, analysis: Analysis, card: Card, free_height: float) -> None:
    """Draw legend, map and plots over time into the block of the cover.

    Parameters
    ----------
    block : Block
    analysis : Analysis
    card : Card
    free_height : float
        Height (pt) that is left on the page.
    """
    page = Page()
    block["blocks"] = page.blocks
    legend = page.legend(_legend_entries(analysis))
    errors, innovations = _error_strips(analysis, card), _innovation_strip(analysis.main)
    flight_map = _flight_map(analysis, card)
    rest = free_height - legend["height"] - LEGEND_GAP - SPARE_HEIGHT
    if rest < MIN_THIRDS_HEIGHT:
        rest = NEXT_PAGE_HEIGHT
        page.blocks.insert(0, {"kind": "break"})
    least = MAP_HEIGHTS[0] + INNOVATION_HEIGHTS[0] + len(errors) * MIN_ERROR_HEIGHT
    innovation_height = float(np.clip(INNOVATION_SHARE * rest, *INNOVATION_HEIGHTS))
    if flight_map.is_long and rest >= least:
        map_height = float(np.clip(MAP_SHARE * rest, *MAP_HEIGHTS))
        _draw_map(page, analysis, flight_map, map_height)
        heights = _equal_heights(
            page, errors, rest - map_height - innovation_height, is_labelled=False
        )
        _draw_strips(page, analysis, [*errors, innovations], [*heights, innovation_height])
        return
    columns = list(halves())
    left_strips = [innovations] if errors else []
    if errors and rest < MIN_HALVES_HEIGHT:
        columns = [Page(width=(PAGE_WIDTH - 2.0 * COLUMN_GAP) / 3.0) for _ in range(3)]
        _draw_strips(columns[2], analysis, left_strips, [rest])
        left_strips = []
    heights = [innovation_height] * len(left_strips)
    _draw_map(columns[0], analysis, flight_map, rest - sum(heights))
    _draw_strips(columns[0], analysis, left_strips, heights)
    strips = errors or [innovations]
    heights = _equal_heights(columns[1], strips, rest, is_labelled=True)
    _draw_strips(columns[1], analysis, strips, heights)
    page.add_columns(*columns, above=0.0)


def _draw_strips(
    page: Page, analysis: Analysis, strips: Sequence[Strip], heights: Sequence[float]
) -> None:
    """Draw plots on one time axis; their heights (pt) include titles and labels."""
    for strip, height in zip(strips, heights, strict=True):
        is_last = strip is strips[-1]
        axes_height = height - _head_height(page, strip.title) - HEIGHT_BELOW_AXES[is_last]
        axes = page.panel(
            strip.title, "", axes_height, above=4.0, left=LEFT_MARGIN, is_compact=True
        )
        shown = analysis.segment.flight
        axes.set_xlim(shown.start_s, shown.end_s)
        axes.locator_params(axis="x", nbins=_tick_count(page))
        strip.draw(axes)
        style.label_time_axis(axes, is_last)


def _equal_heights(
    page: Page, strips: Sequence[Strip], total: float, *, is_labelled: bool
) -> list[float]:
    """Return heights (pt) of plots with equal axes that add up to a total.

    If ``is_labelled``, the last strip has the labels of the time axis.
    """
    extras = [_head_height(page, strip.title) + HEIGHT_BELOW_AXES[False] for strip in strips]
    if is_labelled:
        extras[-1] += HEIGHT_BELOW_AXES[True] - HEIGHT_BELOW_AXES[False]
    axes_height = (total - sum(extras)) / max(len(strips), 1)
    return [axes_height + extra_height for extra_height in extras]


def _tick_count(page: Page) -> int:
    return 6 if page.width > MIN_WIDE_PANEL else 4


def _head_height(page: Page, title: str) -> float:
    return TITLE_HEIGHT + TITLE_LINE * (line_count(title, page.width) - 1)


def _error_strips(analysis: Analysis, card: Card) -> list[Strip]:
    """Return a plot of the position error of each filter, or of KF - EKF2 without ground truth."""
    result, effect = analysis.main.in_flight, card.effect
    errors_by_filter = {
        filter_name: errors
        for filter_name in FILTERS
        if isinstance(errors := position_errors(result, filter_name), pd.DataFrame)
        and errors["error_m"].notna().any()
    }
    if errors_by_filter:
        half_height = 1.1 * max(map(_shown_height, errors_by_filter.values()))
        rmse_m = effect.position_rmse_m if effect else {}
        return [
            _error_strip(
                analysis,
                f"{(name := FILTER_NAMES[filter_name])} error (m)",
                _format_size("RMSE", rmse_m.get(filter_name)),
                errors["error_m"],
                {name: errors["sigma_m"]},
                half_height,
            )
            for filter_name, errors in errors_by_filter.items()
        ]
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return []
    time_s = result.ekf2_state.index.to_numpy()
    state, variance = kf_state_and_variance(result.replay, time_s)
    difference = state["position_m"] - result.ekf2_state["position_m"]
    if not difference.notna().any():
        return []
    sigmas = {
        name: pd.Series(reported_sigma(time_s, frame, "position_variance_m2"), time_s)
        for name, frame in (("KF", variance), ("EKF2", result.ekf2_variance))
    }
    widest = [2.2 * sigma.median() for sigma in sigmas.values() if sigma.notna().any()]
    half_height = 1.1 * max(float(difference.abs().max()), *widest)
    size = _format_size("RMS", effect.difference_rms_m if effect else None)
    return [_error_strip(analysis, "KF − EKF2 (m)", size, difference, sigmas, half_height)]


def _format_size(label: str, length_m: float | None) -> list[str]:
    return [] if length_m is None else [f"{label} {format_metres(length_m)}"]


def _error_strip(
    analysis: Analysis,
    label: str,
    sizes: list[str],
    curve: pd.Series[float],
    sigmas: Mapping[str, pd.Series[float]],
    half_height: float,
) -> Strip:
    """Return the plot of a position error or of KF - EKF2 (m), with ±2σ of each filter."""
    texts = [f"{name} {text}" for name, sigma in sigmas.items() if (text := _format_sigma(sigma))]
    if len(sigmas) == 1:
        texts = [text.partition(" ")[2] for text in texts]
    if texts:
        sizes = [*sizes, f"σ {', '.join(texts)}"]
    largest_value = float(curve.abs().max())
    if largest_value < FLAT_SHARE * half_height:
        sizes = [*sizes, f"at most {format_metres(largest_value)}, flat on this scale"]
    line = LINES[next(iter(sigmas))] if len(sigmas) == 1 else style.line_style("black", 1.0)

    def draw(axes: Axes) -> None:
        axes.set_ylim(-half_height, half_height)
        for name, sigma in sigmas.items():
            _draw_sigma(axes, sigma, name)
        axes.axhline(0.0, color="black", lw=0.5)
        draw_curve(axes, curve, **line)
        _draw_spans(axes, analysis)
        if "EKF2" in sigmas:
            for time_s in horizontal_resets(analysis):
                axes.axvline(time_s, **RESET_LINE)
            _draw_at_edge(axes, _rejection_times(analysis), 0.06, REJECTED_MARK)
        else:
            _draw_at_edge(axes, outlier_times(analysis), 0.94, OUTLIER_MARK)

    return Strip(f"{label}: {', '.join(sizes)}", draw)


def _shown_height(errors: pd.DataFrame) -> float:
    """Return the largest position error (m) of a filter, or 2.2 σ if that is not much larger."""
    largest_error, sigma = float(errors["error_m"].abs().max()), errors["sigma_m"].median()
    return max(
        largest_error, 1e-3, min(2.2 * sigma, 3.0 * largest_error) if np.isfinite(sigma) else 0.0
    )


def _format_sigma(sigma: pd.Series[float]) -> str:
    valid_sigma = _settled_sigma(sigma)
    if valid_sigma.empty:
        return ""
    low, high = float(valid_sigma.min()), float(valid_sigma.max())
    if high < MAX_SIGMA_SPREAD * low:
        return format_metres(float(valid_sigma.median()))
    return f"{format_metres(low)} to {format_metres(high)}"


def _settled_sigma(sigma: pd.Series[float]) -> pd.Series[float]:
    """Return the known σ of a filter from :data:`SETTLING_S` after its start on."""
    valid_sigma = sigma.dropna()
    settled: pd.Series[float] = valid_sigma[
        valid_sigma.index >= valid_sigma.index.min() + SETTLING_S
    ]
    return settled


def _draw_sigma(axes: Axes, sigma: pd.Series[float], name: str) -> None:
    """Draw ±2σ of a filter; beyond the plot, draw triangles and write the largest value."""
    valid_sigma = sigma.dropna()
    if valid_sigma.empty:
        return
    style.draw_sigma_band(axes, 0.0 * valid_sigma, valid_sigma, style.BANDS[name])
    valid_sigma = _settled_sigma(sigma)
    top = axes.get_ylim()[1]
    if valid_sigma.empty or (largest_2_sigma := 2.0 * float(valid_sigma.max())) <= top:
        return
    largest_sigma_s = float(valid_sigma.index[int(np.argmax(valid_sigma))])
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        axes.plot(largest_sigma_s, sign * top, marker, color="black", ms=4.5, mew=0, clip_on=False)
    low, high = axes.get_xlim()
    is_right = largest_sigma_s > 0.5 * (low + high)
    axes.annotate(
        f"±2σ of {name} up to ±{format_metres(largest_2_sigma)} m",
        (largest_sigma_s, -top),
        xytext=(-6.0 if is_right else 6.0, 3.0),
        textcoords="offset points",
        ha="right" if is_right else "left",
        va="bottom",
        size=8.0,
        bbox={"facecolor": "white", "alpha": 0.8, "lw": 0.0, "pad": 1.0},
    )


def _draw_spans(axes: Axes, analysis: Analysis) -> None:
    for spans, band in (
        (analysis.events.gaps, GAP_HATCH),
        (analysis.events.dropouts, DROPOUT_BAND),
    ):
        for start, end in spans:
            axes.axvspan(start, end, **band, zorder=1.5)


def _rejection_times(analysis: Analysis) -> Array:
    return np.asarray(analysis.events.rejected_s.get(analysis.main.axis.name, ()), np.float64)


def _draw_at_edge(axes: Axes, times: Array, height: float, mark: Mapping[str, Any]) -> None:
    if len(times):
        visible_times_s = _thinned_times(axes, times)
        axes.plot(
            visible_times_s,
            np.full(len(visible_times_s), height),
            transform=axes.get_xaxis_transform(),
            **mark,
        )


def _thinned_times(axes: Axes, times: Array) -> Array:
    low, high = axes.get_xlim()
    return visible_times(times, MIN_MARK_DISTANCE * (high - low))


def _innovation_strip(result: AxisComparison) -> Strip:
    """Return the plot of innovation ÷ √S, with triangles for values beyond its scale."""
    series = normalised_innovations(result)
    sizes = {name: float(values.abs().max()) for name, values in series.items() if len(values)}
    marks = ", ".join(f"{sign} {name}" for name, sign in zip(series, "●□", strict=False))
    title = f"Innovations ÷ √S ({marks}): 95 % belong inside ±2"
    if (largest_size := max(sizes.values(), default=0.0)) < FLAT_INNOVATIONS:
        title += f"; all are inside ±{format_ratio(largest_size)}"
    beyond = [
        f"{name} {format_ratio(size)}" for name, size in sizes.items() if size > MAX_NORMALISED
    ]
    if beyond:
        title += f"; ▲▼ beyond ±{MAX_NORMALISED:g}, up to {', '.join(beyond)}"

    def draw(axes: Axes) -> None:
        axes.set_ylim(-1.12 * MAX_NORMALISED, 1.12 * MAX_NORMALISED)
        height = axes.bbox.height * 72.0 / axes.figure.dpi
        axes.set_yticks(np.arange(-4.0, 4.1, 2.0 if height >= MIN_TICKS_HEIGHT else 4.0))
        axes.axhspan(-2.0, 2.0, color=style.CONSISTENT_BAND_COLOUR, lw=0, zorder=0.5)
        axes.axhline(0.0, color="black", lw=0.5)
        for name in reversed(series):
            values, dots = series[name], INNOVATION_DOTS[name]
            values_in_scale = values[values.abs() <= MAX_NORMALISED]
            axes.plot(values_in_scale.iloc[:: -(-len(values) // MAX_DRAWN_INNOVATIONS)], **dots)
            for sign, marker in ((1.0, "^"), (-1.0, "v")):
                times = values.index[sign * values > MAX_NORMALISED].to_numpy()
                edge = {**dots, "marker": marker, "ms": 3.4, "mew": 0, "mfc": dots["color"]}
                visible_times_s = _thinned_times(axes, times)
                axes.plot(
                    visible_times_s, np.full(len(visible_times_s), sign * MAX_NORMALISED), **edge
                )

    return Strip(title, draw)


def _map_tracks(analysis: Analysis) -> dict[str, Coordinates]:
    """Return north and east (m) of positions, KF, EKF2 and ground truth within the segment."""
    segment, flight = analysis.segment.flight, analysis.flight

    def cut(track: pd.DataFrame) -> Coordinates:
        segment_track = cut_to_segment(track, segment)
        return segment_track["north_m"].to_numpy(), segment_track["east_m"].to_numpy()

    tracks = {"positions": cut(analysis.source.samples)}
    if {"north", "east"} <= analysis.axes.keys():
        north, east = (
            analysis.axes[name].replay.steps["position_m"].to_numpy() for name in ("north", "east")
        )
        tracks["KF"] = north, east
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    if isinstance(flight.truth, Truth):
        tracks["ground truth"] = cut(flight.truth.samples)
    return {name: track for name, track in tracks.items() if len(track[0])}


def _flight_map(analysis: Analysis, card: Card) -> FlightMap:
    """Return the map along the main axis, at a heading below 180°; without it, north is up."""
    aisle = next((line for line in analysis.lines if line.name == AISLE), None)
    heading, right_labels, up_label = np.pi / 2.0, ["east (m)"], "north (m)"
    if aisle is not None and aisle.heading_deg is not None:
        heading, up_label = np.deg2rad(aisle.heading_deg % 180.0), "left (m)"
        axis = card.effect.axis if card.effect else "along the aisle"
        right_labels = [f"{text} (m)" for text in (axis, axis.partition(", ")[2], "main axis")]
    elif analysis.source.frame == "FRD":
        name = analysis.source.name
        right_labels, up_label = [f"y of {name} (m)", "y (m)"], f"x of {name} (m)"
    c, s = np.cos(heading), np.sin(heading)

    def to_map(north: Any, east: Any) -> Coordinates:
        return c * north + s * east, s * north - c * east

    tracks = {name: to_map(*track) for name, track in _map_tracks(analysis).items()}
    return FlightMap(tracks, right_labels, up_label, to_map)


def _draw_map(page: Page, analysis: Analysis, flight_map: FlightMap, height: float) -> None:
    """Draw the tracks at equal scales, with triangles where a track leaves the map."""
    tracks, width = flight_map.tracks, page.width - LEFT_MARGIN - AXES_RIGHT
    title, axes_height = "Map", height - TITLE_HEIGHT - HEIGHT_BELOW_AXES[True]
    limits = _map_limits(tracks, width / axes_height)
    if leaving := _leaving_tracks(tracks, limits):
        title = f"Map; tracks leave it at the triangles ({leaving})"
        axes_height = height - _head_height(page, title) - HEIGHT_BELOW_AXES[True]
        limits = _map_limits(tracks, width / axes_height)
    axes = page.panel(title, "", axes_height, above=4.0, left=LEFT_MARGIN, is_compact=True)
    right_label = next(
        text for text in flight_map.right_labels if text_width(text) < page.width - LEFT_MARGIN
    )
    axes.set(xlim=limits[0], ylim=limits[1], xlabel=right_label, ylabel=flight_map.up_label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.locator_params(axis="x", nbins=_tick_count(page))
    axes.grid(True, axis="both")
    for name, (right, up) in tracks.items():
        if name == "positions":
            axes.plot(right, up, **style.MEASUREMENT_DOTS | {"ms": 2.4})
        else:
            stride = max(1, len(right) // style.MAX_POINTS)
            axes.plot(right[::stride], up[::stride], **LINES[name])
        for marker, (x, y) in _map_exits((right, up), limits):
            axes.plot(x, y, marker, color=_track_colour(name), ms=5.0, mew=0, clip_on=False)
    samples = analysis.source.samples
    for times, mark in (
        (analysis.events.take_off_s, TAKE_OFF_MARK),
        (analysis.events.landing_s, LANDING_MARK),
    ):
        if times:
            nearest_samples = samples.iloc[
                samples.index.get_indexer(pd.Index(times), method="nearest")
            ]
            place = flight_map.to_map(nearest_samples["north_m"], nearest_samples["east_m"])
            axes.plot(*place, **{**mark, "ms": 9.0, "mec": "white", "mew": 0.8, "zorder": 3.0})


def _leaving_tracks(tracks: Mapping[str, Coordinates], limits: MapLimits) -> str:
    sizes = {name: _distance_outside(track, limits) for name, track in tracks.items()}
    return ", ".join(
        f"{name} {format_metres(size)} m" for name, size in sizes.items() if size > 0.0
    )


def _track_colour(name: str) -> str:
    return style.MEASUREMENT_COLOUR if name == "positions" else str(LINES[name]["color"])


def _map_limits(tracks: Mapping[str, Coordinates], ratio: float) -> MapLimits:
    """Return the limits of both map axes at equal scales.

    They show all ground truth and 98 % of the positions, and the other tracks up to
    :data:`MAP_REACH` outside of these; a filter with a large error does not shrink the flight.
    """
    spans = []
    for side in (0, 1):
        ends = [np.percentile(tracks["positions"][side], (1.0, 99.0))]
        if "ground truth" in tracks:
            ends.append(_range_of(tracks["ground truth"][side]))
        reach = MAP_REACH * (np.max(ends) - np.min(ends))
        limits = np.min(ends) - reach, np.max(ends) + reach
        ends += [np.clip(_range_of(track[side]), *limits) for track in tracks.values()]
        low, high = np.min(ends), np.max(ends)
        spans.append((0.5 * (low + high), max(MAP_MARGIN * (high - low), MIN_MAP_LENGTH_M)))
    (x, length), (y, breadth) = spans
    length = max(length, breadth * ratio)
    breadth = length / ratio
    return (
        (float(x - 0.5 * length), float(x + 0.5 * length)),
        (float(y - 0.5 * breadth), float(y + 0.5 * breadth)),
    )


def _range_of(values: Array) -> Array:
    return np.array([np.nanmin(values), np.nanmax(values)])


def _overshoot(values: Array, limits: tuple[float, float]) -> Array:
    """Return the signed distance of values beyond two limits; 0 between them."""
    return np.asarray(values - np.clip(values, *limits))


def _distance_outside(track: Coordinates, limits: MapLimits) -> float:
    return max(
        float(np.nanmax(np.abs(_overshoot(values, ends))))
        for values, ends in zip(track, limits, strict=True)
    )


def _map_exits(track: Coordinates, limits: MapLimits) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield a triangle and its place on the frame where a track leaves or enters the map."""
    over = [_overshoot(values, ends) for values, ends in zip(track, limits, strict=True)]
    is_outside = (over[0] != 0.0) | (over[1] != 0.0)
    changes = np.flatnonzero(np.diff(is_outside, prepend=False, append=False))
    spacing = MIN_EXIT_DISTANCE * (limits[0][1] - limits[0][0])
    last = np.full(2, np.inf)
    for change in changes:
        # use the sample outside of the map next to the crossing of its frame
        index = change if change < len(is_outside) and is_outside[change] else change - 1
        x, y = over[0][index], over[1][index]
        marker = ("^" if y > 0.0 else "v") if abs(y) >= abs(x) else (">" if x > 0.0 else "<")
        place = np.array([np.clip(track[side][index], *limits[side]) for side in (0, 1)])
        if np.abs(place - last).max() >= spacing:
            yield marker, (float(place[0]), float(place[1]))
            last = place


def _legend_entries(analysis: Analysis) -> list[Artist]:
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    names = _map_tracks(analysis).keys()
    entries: list[Artist] = [
        Line2D([], [], **line, label=name) for name, line in LINES.items() if name in names
    ]
    events = analysis.events
    marks: Sequence[tuple[str, Any, dict[str, Any]]] = (
        ("positions", names, {**style.MEASUREMENT_DOTS, "ms": 5.0}),
        ("take-off", events.take_off_s, TAKE_OFF_MARK),
        ("landing", events.landing_s, LANDING_MARK),
        ("outlier", outlier_times(analysis), OUTLIER_MARK),
        ("EKF2 rejected", _rejection_times(analysis), REJECTED_MARK),
        ("EKF2 reset", horizontal_resets(analysis), RESET_LINE),
    )
    entries += [
        Line2D([], [], **mark, label=label)
        for label, marked_values, mark in marks
        if len(marked_values)
    ]
    bands: Sequence[tuple[str, Any, dict[str, Any]]] = (
        ("±2σ reported", names, {"facecolor": "#c9c9c9", "lw": 0.0}),
        ("gap", events.gaps, GAP_HATCH),
        ("log dropout", events.dropouts, DROPOUT_BAND),
    )
    entries += [
        Patch(**band, label=label) for label, marked_values, band in bands if len(marked_values)
    ]
    return entries
