"""Bokeh plots of the web page of ``px4fuse explore``; JavaScript adds the data."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal

from bokeh.document import Document
from bokeh.models import ColumnDataSource, FactorRange, HoverTool, Range1d
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure

from px4fuse.core.record import Record, read_toml
from px4fuse.explore.data import PageData
from px4fuse.report.style import (
    CONSISTENT_BAND_COLOUR,
    EKF2_COLOUR,
    KF_COLOUR,
    MEASUREMENT_COLOUR,
    TRUTH_COLOUR,
)

# Keyword arguments of Bokeh's drawing functions
BokehStyle = dict[str, Any]
# Columns of the Bokeh data sources, which JavaScript fills
BOKEH_SOURCE_COLUMNS = (
    "t p v sp sv "  # t: time (s); p: position (m), v: velocity (m/s); sp, sv: their σ
    "k0 k1 "  # KF gain: k0 of position, k1 of velocity (1/s)
    "e minus plus "  # e: position error (m); minus, plus: limits (m) of its 2σ band
    "x y marker "  # x: innovation ÷ √S; y: drawn value; marker: arrow head outside the plot
    "row left right"  # row of the event plot; left, right: start and end (s) of the event
)
KF_LINE_STYLE: BokehStyle = {"line_width": 1.6, "line_color": KF_COLOUR}
# Style and name in the tooltip of each line, by its data source
LINE_STYLES: dict[str, tuple[BokehStyle, str]] = {
    "kf": (KF_LINE_STYLE, "KF"),
    "gain": (KF_LINE_STYLE, "KF"),
    "ekf2": ({"line_width": 1.6, "line_color": EKF2_COLOUR, "line_dash": [6, 3]}, "EKF2"),
    "truth": ({"line_width": 1.2, "line_color": TRUTH_COLOUR, "line_dash": [1, 3]}, "ground truth"),
}
KF_BAND_STYLE: BokehStyle = {"fill_color": KF_COLOUR, "fill_alpha": 0.25}
# Limit (±) of innovation ÷ √S for 95 % of the innovations of a consistent filter
CONSISTENCY_LIMIT_IN_SQRT_S = 2.0
# Limit (±) of the plot axis of innovation ÷ √S
PLOT_LIMIT_IN_SQRT_S = 4.6
# Left margin (pixels) of a plot
LEFT_MARGIN_PIXELS = 50
# Left margin (pixels) of the event plot, which has long labels, and of the plot above
EVENT_LEFT_MARGIN_PIXELS = 82


class Plot(Record):
    """Plot of one column of several data sources (keys of :data:`LINE_STYLES`) over time."""

    column: str
    lines: tuple[str, ...] = ()
    scale: Literal["linear", "log"] = "linear"


class PageTab(Record):
    """Tab of the web page, with the titles of its plots by name."""

    title: str
    plots: Mapping[str, str]


class PageLayout(Record):
    """Tabs and plots of the web page (``figures.toml``)."""

    event_rows: list[str]
    tabs: dict[str, PageTab]
    plots: dict[str, Plot]


PAGE_LAYOUT = read_toml(__file__, PageLayout)


def make_document_json(data: PageData) -> tuple[Any, dict[str, str]]:
    """Return a Bokeh document with all plots as JSON, and the name of each plot by its id."""
    document = Document()
    shared_time_range = Range1d(name="time")
    plots = {
        name: _make_plot(name, plot, data, shared_time_range)
        for name, plot in PAGE_LAYOUT.plots.items()
        if name != "error" or has_truth_or_ekf2(data)
    }
    plots |= {"strip": _make_event_plot(data, shared_time_range), "step": _make_phase_plot()}
    with document.models.freeze():  # Bokeh collects all models once, which is faster
        for plot_figure in plots.values():
            document.add_root(plot_figure)
    return document.to_json(deferred=False), {plot.id: name for name, plot in plots.items()}


def has_truth_or_ekf2(data: PageData) -> bool:
    """Return True if ground truth or EKF2's state is logged along at least one axis."""
    return _has_track(data, "truth") or _has_track(data, "ekf2")


def _has_track(data: PageData, kind: str) -> bool:
    return any(isinstance(axis[kind], dict) for axis in data["axes"])


def _make_plot(name: str, plot: Plot, data: PageData, shared_time_range: Range1d) -> Any:
    get_source = cache(lambda source: _make_data_source(f"{name}:{source}"))
    plot_figure = _make_time_figure(
        name,
        215,
        shared_time_range,
        y_axis_type=plot.scale,
        lod_threshold=None,
        min_border_left=EVENT_LEFT_MARGIN_PIXELS if name == "position" else LEFT_MARGIN_PIXELS,
    )
    if name == "position":
        _draw_dots(plot_figure, get_source("measured"), "t p", 3, fill_color=MEASUREMENT_COLOUR)
    if name == "innovation":
        _draw_innovations(plot_figure, get_source, with_ekf2=_has_track(data, "ekf2"))
    if name == "error":
        plot_figure.varea("t", "minus", "plus", source=get_source("kf"), **KF_BAND_STYLE)
    line_renderers: list[Any] = []
    for line in plot.lines:
        if line in ("ekf2", "truth") and not _has_track(data, line):
            continue
        style, label = LINE_STYLES[line]
        renderer = plot_figure.line("t", plot.column, source=get_source(line), **style)
        line_renderers.append(renderer)
        _add_hover(plot_figure, renderer, label, f"@{plot.column}{{0.000}}")
    if name == "error":  # scale the axis without the 2σ band, which is very wide at the start
        plot_figure.y_range.renderers = line_renderers
    for start_s, end_s in data["events"]["gap"]:
        gap_band = BoxAnnotation(
            left=start_s,
            right=end_s,
            level="underlay",
            fill_color=None,
            line_color=None,
            hatch_pattern="/",
            hatch_color="#888888",
            hatch_alpha=0.6,
        )
        plot_figure.add_layout(gap_band)
    return plot_figure


def _draw_innovations(
    plot_figure: Any, get_source: Callable[[str], ColumnDataSource], *, with_ekf2: bool
) -> None:
    plot_figure.y_range = Range1d(start=-PLOT_LIMIT_IN_SQRT_S, end=PLOT_LIMIT_IN_SQRT_S)
    consistent_band = BoxAnnotation(
        bottom=-CONSISTENCY_LIMIT_IN_SQRT_S,
        top=CONSISTENCY_LIMIT_IN_SQRT_S,
        level="underlay",
        fill_color=CONSISTENT_BAND_COLOUR,
        fill_alpha=1.0,
        line_color=None,
    )
    plot_figure.add_layout(consistent_band)
    dots: list[tuple[str, str, int, BokehStyle]] = [
        ("innovations", "KF", 5, {"fill_color": KF_COLOUR})
    ]
    if with_ekf2:
        dots += [
            ("fused", "EKF2", 5, {"fill_color": EKF2_COLOUR}),
            ("rejected", "EKF2 rejected", 7, {"fill_color": None, "line_color": EKF2_COLOUR}),
        ]
    for source_name, label, size, style in dots:
        renderer = _draw_dots(
            plot_figure, get_source(source_name), "t y", size, marker="marker", **style
        )
        _add_hover(plot_figure, renderer, label, "@x{0.00}")


def _add_hover(plot_figure: Any, renderer: Any, label: str, value: str) -> None:
    # place tooltips on different sides, so that they do not overlap
    side: Any = {"EKF2": "right", "ground truth": "above"}.get(label, "left")
    tooltip_rows = [("time", "@t{0.00} s"), (label, value)]
    plot_figure.add_tools(
        HoverTool(renderers=[renderer], tooltips=tooltip_rows, mode="vline", attachment=side)
    )


def _make_figure(name: str, height: int, **options: Any) -> Any:
    return figure(
        name=name, height=height, sizing_mode="stretch_width", toolbar_location=None, **options
    )


def _make_time_figure(name: str, height: int, time_range: Range1d, **options: Any) -> Any:
    """Make a plot over time, with a vertical line at the time of the selected measurement."""
    plot_figure = _make_figure(name, height, x_range=time_range, tools="xbox_zoom", **options)
    plot_figure.add_layout(Span(dimension="height", name="cursor"))
    return plot_figure


def _make_data_source(name: str) -> ColumnDataSource:
    return ColumnDataSource(
        {column: [] for column in BOKEH_SOURCE_COLUMNS.split()}, name=f"{name}-source"
    )


def _make_event_plot(data: PageData, shared_time_range: Range1d) -> Any:
    rows = PAGE_LAYOUT.event_rows if _has_track(data, "ekf2") else PAGE_LAYOUT.event_rows[2:]
    plot_figure = _make_time_figure(
        "strip",
        28 * len(rows) + 24,
        shared_time_range,
        y_range=FactorRange(factors=rows),
        min_border_left=EVENT_LEFT_MARGIN_PIXELS,
    )
    plot_figure.hbar(
        y="row",
        left="left",
        right="right",
        height=0.55,
        source=_make_data_source("strip"),
        color="#7d8894",
    )
    return plot_figure


def _draw_dots(
    plot_figure: Any, data_source: ColumnDataSource, xy_column_names: str, size: int, **style: Any
) -> Any:
    x, y = xy_column_names.split()
    return plot_figure.scatter(x, y, source=data_source, size=size, **{"line_color": None} | style)


def _make_phase_plot() -> Any:
    """Make the plot of KF position and velocity with 2σ ellipses and measurement."""
    plot_figure = _make_figure(
        "step",
        330,
        x_range=Range1d(),
        y_range=Range1d(),
        tools="",
        x_axis_label="position (m)",
        y_axis_label="velocity (m/s)",
    )
    measurement_band = BoxAnnotation(
        name="band", fill_color=MEASUREMENT_COLOUR, fill_alpha=0.25, line_color=None
    )
    plot_figure.add_layout(measurement_band)
    plot_figure.add_layout(
        Span(
            dimension="height",
            name="measurement",
            line_color=MEASUREMENT_COLOUR,
            line_dash=[2, 2],
        )
    )
    before, now, mean = map(_make_data_source, ("before", "now", "mean"))
    plot_figure.line("p", "v", source=before, line_dash=[6, 3], **KF_LINE_STYLE)
    plot_figure.patch("p", "v", source=now, **KF_LINE_STYLE, **KF_BAND_STYLE)
    _draw_dots(plot_figure, mean, "p v", 7, fill_color=KF_COLOUR)
    return plot_figure
