"""Panels of the cover: map, errors of KF and EKF2, innovations; no value leaves one unmarked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.card.model import Card, FilterName
from px4fuse.card.numbers import format_metres, format_ratio
from px4fuse.comparison.comparison import kf_state_and_variance, position_errors, reported_sigma
from px4fuse.comparison.model import FILTERS, AxisComparison
from px4fuse.filter.signals import AISLE, cut_to_segment
from px4fuse.flight import Ekf2, Truth
from px4fuse.report import style
from px4fuse.report.card_text import FILTER_NAMES
from px4fuse.report.event_marks import (
    DROPOUT_BAND,
    GAP_BAND,
    LANDING_MARK,
    OUTLIER_MARK,
    TAKE_OFF_MARK,
    outlier_times,
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
from px4fuse.report.style import LINES, Artist, Axes, draw_curve

MM = 72.0 / 25.4
# Length / width of the track from which the panels stand one below the other
MIN_LONG_RATIO = 2.2
# pt; heights of panels with their titles and labels
MAP_HEIGHTS = 40.0 * MM, 53.0 * MM
# pt; least heights of all panels in two columns and in three
MIN_HALVES_HEIGHT, MIN_THIRDS_HEIGHT = 50.0 * MM, 38.0 * MM
INNOVATION_HEIGHTS = 27.0 * MM, 38.0 * MM
MIN_ERROR_HEIGHT = 17.0 * MM
# pt; height of all panels if the card fills its page
NEXT_PAGE_HEIGHT = 160.0 * MM
# pt; title with its gaps, each further line of it, gap above the legend, and what is left free
TITLE_HEIGHT, TITLE_LINE, LEGEND_GAP, SPARE = 16.5, 10.5, 11.0, 4.0
MIN_TICKS_HEIGHT = 48.0  # pt; lower axes of the innovations have ticks at -4, 0 and 4 only
MIN_WIDE = 200.0  # pt; narrower panels have fewer ticks
LEFT = 38.0  # pt; tick and axis labels left of the axes
# Share of the free height for the innovations and for the map
INNOVATION_SHARE, MAP_SHARE = 0.22, 0.25
MAX_DRAWN = 400  # innovations per filter; more are decimated evenly, those beyond the scale never
MAX_NORMALISED = 4.0
# pt; height below the axes, without and with labels of the x axis
BELOW = UNLABELLED_HEIGHT, TICKS_HEIGHT + AXIS_LABEL_HEIGHT
MAP_MARGIN, MAP_REACH, MIN_MAP_LENGTH_M = 1.08, 0.25, 0.5
# Fraction of the map's length between two triangles of a track
MIN_EXIT_DISTANCE = 0.02
# A curve that fills less of its scale than this is called flat
FLAT_SHARE = 0.1
FLAT_INNOVATIONS = 1.0
# σ is printed as one value if its largest is below this multiple of its smallest
MAX_SIGMA_SPREAD = 1.5
SETTLING_S = 2.0  # at the start, σ settles; its values do not count in the titles
# Markers of the innovations, as in the title
INNOVATION_DOTS: Mapping[str, dict[str, Any]] = {
    "KF": style.KF_DOTS,
    "EKF2": style.EKF2_DOTS | {"ms": 2.8, "mew": 0.6, "mfc": "none"},
}
# Fraction of the axes: of marks closer than this, one is drawn
MIN_MARK_DISTANCE = 1.0 / 150.0
GAP_HATCH: dict[str, Any] = {**GAP_BAND, "facecolor": "none"}  # σ in the gap stays visible
RESET_LINE: dict[str, Any] = {"color": style.EKF2_COLOUR, "lw": 1.0, "ls": (0, (1, 1))}
REJECTED_MARK: dict[str, Any] = {
    "color": "black",
    "marker": "|",
    "ms": 5.0,
    "mew": 0.7,
    "ls": "none",
}
Coordinates = tuple[Array, Array]
MapLimits = tuple[tuple[float, float], tuple[float, float]]
DrawStrip = Callable[[Axes], None]


class Strip(NamedTuple):
    """Panel over time: title, and the function that draws it."""

    title: str
    draw: DrawStrip


class FlightMap(NamedTuple):
    """Flight from above: tracks (m, right and up), and the labels of both axes.

    Of ``right_labels`` the first that fits is used.
    """

    tracks: Mapping[str, Coordinates]
    right_labels: Sequence[str]
    up_label: str
    to_map: Callable[[Any, Any], Coordinates]

    @property
    def is_long(self) -> bool:
        """True if the track is at least :data:`MIN_LONG_RATIO` times longer than wide."""
        length_m, width_m = (float(np.ptp(values)) for values in self.tracks["positions"])
        return length_m >= MIN_LONG_RATIO * max(width_m, 1e-6)


def write_panels(block: Block, analysis: Analysis, card: Card, free: float) -> None:
    """Draw legend, map and strips into the block of the cover.

    Parameters
    ----------
    block : Block
    analysis : Analysis
    card : Card
    free : float
        Height (pt) that is left on the page.
    """
    page = Page()
    block["blocks"] = page.blocks
    legend = page.legend(_legend_entries(analysis))
    errors, innovations = _error_strips(analysis, card), _innovation_strip(analysis.main)
    flight_map = _flight_map(analysis, card)
    rest = free - legend["height"] - LEGEND_GAP - SPARE
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
    """Draw strips on one time axis; heights include titles and labels."""
    for strip, height in zip(strips, heights, strict=True):
        is_last = strip is strips[-1]
        axes_height = height - _head_height(page, strip.title) - BELOW[is_last]
        axes = page.panel(strip.title, "", axes_height, above=4.0, left=LEFT, is_compact=True)
        shown = analysis.segment.flight
        axes.set_xlim(shown.start_s, shown.end_s)
        axes.locator_params(axis="x", nbins=_tick_count(page))
        strip.draw(axes)
        style.label_time_axis(axes, is_last)


def _equal_heights(
    page: Page, strips: Sequence[Strip], total: float, *, is_labelled: bool
) -> list[float]:
    """Return heights of strips that add up to a total (pt), with axes of equal height.

    If ``is_labelled``, the last strip has the labels of the time axis.
    """
    extras = [_head_height(page, strip.title) + BELOW[False] for strip in strips]
    if is_labelled:
        extras[-1] += BELOW[True] - BELOW[False]
    axes_height = (total - sum(extras)) / max(len(strips), 1)
    return [axes_height + extra for extra in extras]


def _tick_count(page: Page) -> int:
    return 6 if page.width > MIN_WIDE else 4


def _head_height(page: Page, title: str) -> float:
    """Return the height (pt) of a title with its gaps."""
    return TITLE_HEIGHT + TITLE_LINE * (line_count(title, page.width) - 1)


# ------------------------------------------------------------------------------------------ errors


def _error_strips(analysis: Analysis, card: Card) -> list[Strip]:
    """Return a strip of the errors of each filter, or of KF - EKF2 without ground truth."""
    result = analysis.main.in_flight
    found = {
        owner: errors
        for owner in FILTERS
        if isinstance(errors := position_errors(result, owner), pd.DataFrame)
        and errors["error_m"].notna().any()
    }
    if not found:
        return _difference_strip(analysis, card)
    half_height = 1.1 * max(_shown_height(errors) for errors in found.values())
    rmse_m = card.effect.position_rmse_m if card.effect else {}
    return [
        Strip(
            _error_title(owner, errors, rmse_m.get(owner), half_height),
            _error_drawing(analysis, owner, errors, half_height),
        )
        for owner, errors in found.items()
    ]


def _shown_height(errors: pd.DataFrame) -> float:
    """Return the largest error (m), or 2.2 σ if that is not much larger."""
    largest, sigma = float(errors["error_m"].abs().max()), errors["sigma_m"].median()
    return max(largest, 1e-3, min(2.2 * sigma, 3.0 * largest) if np.isfinite(sigma) else 0.0)


def _error_title(
    owner: FilterName, errors: pd.DataFrame, rmse_m: float | None, half_height: float
) -> str:
    parts = [] if rmse_m is None else [f"RMSE {format_metres(rmse_m)}"]
    if sigma := _format_sigma(errors["sigma_m"]):
        parts.append(f"σ {sigma}")
    largest = float(errors["error_m"].abs().max())
    if largest < FLAT_SHARE * half_height:
        parts.append(f"flat on this scale, at most {format_metres(largest)}")
    return f"{FILTER_NAMES[owner]} error (m): {', '.join(parts)}"


def _format_sigma(sigma: pd.Series[float]) -> str:
    known = sigma.dropna()
    known = known[known.index >= known.index.min() + SETTLING_S]
    if known.empty:
        return ""
    low, high = float(known.min()), float(known.max())
    if high < MAX_SIGMA_SPREAD * low:
        return format_metres(float(known.median()))
    return f"{format_metres(low)} to {format_metres(high)}"


def _error_drawing(
    analysis: Analysis, owner: FilterName, errors: pd.DataFrame, half_height: float
) -> DrawStrip:
    name = FILTER_NAMES[owner]

    def draw(axes: Axes) -> None:
        axes.set_ylim(-half_height, half_height)
        _draw_sigma(axes, errors["sigma_m"], name)
        axes.axhline(0.0, color="black", lw=0.5)
        draw_curve(axes, errors["error_m"], **LINES[name])
        _draw_spans(axes, analysis)
        if owner == "kf":
            _draw_at_edge(axes, outlier_times(analysis), 0.94, OUTLIER_MARK)
        else:
            _draw_ekf2_events(axes, analysis)

    return draw


def _difference_strip(analysis: Analysis, card: Card) -> list[Strip]:
    """Return the strip of KF - EKF2 with ±2σ of both; none without EKF2."""
    result = analysis.main.in_flight
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
    texts = [f"{name} {text}" for name, sigma in sigmas.items() if (text := _format_sigma(sigma))]
    rms_m = card.effect.difference_rms_m if card.effect else None
    size = [] if rms_m is None else [f"RMS {format_metres(rms_m)}"]

    def draw(axes: Axes) -> None:
        axes.set_ylim(-half_height, half_height)
        for name, sigma in sigmas.items():
            _draw_sigma(axes, sigma, name)
        axes.axhline(0.0, color="black", lw=0.5)
        draw_curve(axes, difference, color="black", lw=1.0)
        _draw_spans(axes, analysis)
        _draw_ekf2_events(axes, analysis)

    title = ", ".join([*size, *([f"σ {', '.join(texts)}"] if texts else [])])
    return [Strip(f"KF − EKF2 (m): {title}", draw)]


def _draw_sigma(axes: Axes, sigma: pd.Series[float], name: str) -> None:
    """Draw ±2σ of a filter; where it leaves the scale, a triangle and the largest value."""
    known = sigma.dropna()
    if known.empty:
        return
    style.draw_sigma_band(axes, 0.0 * known, known, style.BANDS[name])
    top = axes.get_ylim()[1]
    largest = 2.0 * float(known.max())
    if largest <= top:
        return
    at = float(known.index[int(np.argmax(known))])
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        axes.plot(at, sign * top, marker, color="black", ms=4.5, mew=0, clip_on=False)
    low, high = axes.get_xlim()
    is_right = at > 0.5 * (low + high)
    axes.annotate(
        f"±2σ of {name} up to ±{format_metres(largest)} m",
        (at, -top),
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


def _draw_ekf2_events(axes: Axes, analysis: Analysis) -> None:
    """Draw EKF2's rejections and horizontal resets."""
    for time_s in analysis.events.horizontal_resets_s:
        axes.axvline(time_s, **RESET_LINE)
    _draw_at_edge(axes, _rejected(analysis), 0.06, REJECTED_MARK)


def _rejected(analysis: Analysis) -> Array:
    return np.asarray(analysis.events.rejected_s.get(analysis.main.axis.name, ()), np.float64)


def _draw_at_edge(axes: Axes, times: Array, height: float, mark: Mapping[str, Any]) -> None:
    """Draw marks at a height of the axes (0 to 1)."""
    if len(times):
        visible = _distant(np.asarray(times), axes.get_xlim())
        axes.plot(
            visible, np.full(len(visible), height), transform=axes.get_xaxis_transform(), **mark
        )


def _distant(values: Array, limits: tuple[float, float]) -> Array:
    """Return the first value of each interval, so that marks do not overlap."""
    bins = np.floor(values / (MIN_MARK_DISTANCE * (limits[1] - limits[0])))
    return np.asarray(values[np.sort(np.unique(bins, return_index=True)[1])])


# ------------------------------------------------------------------------------------- innovations


def _innovation_strip(result: AxisComparison) -> Strip:
    """Return the strip of the innovations over √S, with triangles beyond its scale."""
    series = {
        name: (frame["innovation_m"] / np.sqrt(frame["innovation_variance_m2"])).dropna()
        for name, frame in (("KF", result.replay.updates), ("EKF2", result.ekf2_innovations))
        if isinstance(frame, pd.DataFrame)
    }
    signs = {"KF": "●", "EKF2": "□"}
    beyond = [
        f"{name} {format_ratio(size)}"
        for name, values in series.items()
        if len(values) and (size := float(values.abs().max())) > MAX_NORMALISED
    ]
    strides = {name: -(-len(values) // MAX_DRAWN) for name, values in series.items()}
    marks = ", ".join(f"{signs[name]} {name}" for name in series)
    title = f"Innovations ÷ √S ({marks}): 95 % belong inside ±2"
    largest = max(
        (float(values.abs().max()) for values in series.values() if len(values)), default=0
    )
    if largest < FLAT_INNOVATIONS:
        title += f"; all are inside ±{format_ratio(largest)}"
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
            inside = values[values.abs() <= MAX_NORMALISED]
            axes.plot(inside.iloc[:: strides[name]], **dots)
            for sign, marker in ((1.0, "^"), (-1.0, "v")):
                times = values.index[sign * values > MAX_NORMALISED].to_numpy()
                edge = {**dots, "marker": marker, "ms": 3.4, "mew": 0, "mfc": dots["color"]}
                visible = _distant(times, axes.get_xlim()) if len(times) else times
                axes.plot(visible, np.full(len(visible), sign * MAX_NORMALISED), **edge)

    return Strip(title, draw)


# ------------------------------------------------------------------------------------------ map


def _tracks(analysis: Analysis) -> dict[str, Coordinates]:
    """Return north and east (m) of each track in flight."""
    segment, flight = analysis.segment.flight, analysis.flight

    def cut(frame: pd.DataFrame) -> Coordinates:
        inside = cut_to_segment(frame, segment)
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

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
    """Return the map along the aisle, at a heading below 180°; else north up."""
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

    tracks = {name: to_map(*track) for name, track in _tracks(analysis).items()}
    return FlightMap(tracks, right_labels, up_label, to_map)


def _draw_map(page: Page, analysis: Analysis, flight_map: FlightMap, height: float) -> None:
    """Draw the tracks at equal scales; a triangle marks each place where one leaves the map."""
    tracks, width = flight_map.tracks, page.width - LEFT - AXES_RIGHT
    title, axes_height = "Map", height - TITLE_HEIGHT - BELOW[True]
    limits = _map_limits(tracks, width / axes_height)
    if leaving := _leaving(tracks, limits):
        title = f"Map; triangles: {leaving} outside"
        axes_height = height - _head_height(page, title) - BELOW[True]
        limits = _map_limits(tracks, width / axes_height)
    axes = page.panel(title, "", axes_height, above=4.0, left=LEFT, is_compact=True)
    right_label = next(
        text for text in flight_map.right_labels if text_width(text) < page.width - LEFT
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
        for marker, (x, y) in _exits((right, up), limits):
            axes.plot(x, y, marker, color=_track_colour(name), ms=5.0, mew=0, clip_on=False)
    samples = analysis.source.samples
    for times, mark in (
        (analysis.events.take_off_s, TAKE_OFF_MARK),
        (analysis.events.landing_s, LANDING_MARK),
    ):
        if times:
            nearest = samples.iloc[samples.index.get_indexer(pd.Index(times), method="nearest")]
            place = flight_map.to_map(nearest["north_m"], nearest["east_m"])
            axes.plot(*place, **{**mark, "ms": 9.0, "mec": "white", "mew": 0.8, "zorder": 3.0})


def _leaving(tracks: Mapping[str, Coordinates], limits: MapLimits) -> str:
    """Format the tracks that leave the map, each with its largest distance outside."""
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
            ends.append(_ends(tracks["ground truth"][side]))
        reach = MAP_REACH * (np.max(ends) - np.min(ends))
        shown = np.min(ends) - reach, np.max(ends) + reach
        ends += [np.clip(_ends(track[side]), *shown) for track in tracks.values()]
        low, high = np.min(ends), np.max(ends)
        spans.append((0.5 * (low + high), max(MAP_MARGIN * (high - low), MIN_MAP_LENGTH_M)))
    (x, length), (y, breadth) = spans
    length = max(length, breadth * ratio)
    breadth = length / ratio
    return (
        (float(x - 0.5 * length), float(x + 0.5 * length)),
        (float(y - 0.5 * breadth), float(y + 0.5 * breadth)),
    )


def _ends(values: Array) -> Array:
    return np.array([np.nanmin(values), np.nanmax(values)])


def _overshoot(values: Array, limits: tuple[float, float]) -> Array:
    """Return the signed distance beyond limits; 0 inside."""
    return np.asarray(values - np.clip(values, *limits))


def _distance_outside(track: Coordinates, limits: MapLimits) -> float:
    return max(
        float(np.nanmax(np.abs(_overshoot(values, ends))))
        for values, ends in zip(track, limits, strict=True)
    )


def _exits(track: Coordinates, limits: MapLimits) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield a triangle and its place on the frame where a track leaves or enters the map."""
    over = [_overshoot(values, ends) for values, ends in zip(track, limits, strict=True)]
    is_outside = (over[0] != 0.0) | (over[1] != 0.0)
    changes = np.flatnonzero(np.diff(is_outside, prepend=False, append=False))
    spacing = MIN_EXIT_DISTANCE * (limits[0][1] - limits[0][0])
    last = np.full(2, np.inf)
    for change in changes:
        # the outside sample next to the change
        index = change if change < len(is_outside) and is_outside[change] else change - 1
        x, y = over[0][index], over[1][index]
        marker = ("^" if y > 0.0 else "v") if abs(y) >= abs(x) else (">" if x > 0.0 else "<")
        place = np.array([np.clip(track[side][index], *limits[side]) for side in (0, 1)])
        if np.abs(place - last).max() >= spacing:
            yield marker, (float(place[0]), float(place[1]))
            last = place


# -------------------------------------------------------------------------------------- legend


def _legend_entries(analysis: Analysis) -> list[Artist]:
    """Return entries for all lines and marks that occur."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    names = _tracks(analysis).keys()
    entries: list[Artist] = [
        Line2D([], [], **line, label=name) for name, line in LINES.items() if name in names
    ]
    events = analysis.events
    marks: Sequence[tuple[str, Any, dict[str, Any]]] = (
        ("positions", names, {**style.MEASUREMENT_DOTS, "ms": 5.0}),
        ("take-off", events.take_off_s, TAKE_OFF_MARK),
        ("landing", events.landing_s, LANDING_MARK),
        ("outlier", outlier_times(analysis), OUTLIER_MARK),
        ("EKF2 rejected", _rejected(analysis), REJECTED_MARK),
        ("EKF2 reset", analysis.events.horizontal_resets_s, RESET_LINE),
    )
    entries += [Line2D([], [], **mark, label=label) for label, found, mark in marks if len(found)]
    bands: Sequence[tuple[str, Any, dict[str, Any]]] = (
        ("±2σ reported", names, {"facecolor": "#c9c9c9", "lw": 0.0}),
        ("gap", events.gaps, GAP_HATCH),
        ("log dropout", events.dropouts, DROPOUT_BAND),
    )
    entries += [Patch(**band, label=label) for label, found, band in bands if len(found)]
    return entries
