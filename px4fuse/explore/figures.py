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

# Keyword arguments of Bokeh's drawing functions
BokehStyle = dict[str, Any]
# Columns of the Bokeh data sources, which JavaScript fills
BOKEH_SOURCE_COLUMNS = (
    "t p v sp sv "  # t: time (s); p: position (m), v: velocity (m/s); sp, sv: their σ
    "k0 k1 "  # KF gain: k0 of position, k1 of velocity (1/s)
    "e minus plus "  # e: position error (m); minus, plus: limits (m) of its 2σ band
    "x y "  # x: innovation ÷ √S; y: ± plot limit, where an arrow head marks a larger |x|
    "z turn "  # z: measured position (m); turn: angle (rad) of an arrow head
    "row left right"  # row of the event plot; left, right: start and end (s) of the event
)
# JavaScript sets the colours by `name`
KF_LINE_STYLE: BokehStyle = {"line_width": 1.6, "name": "kf"}
EKF2_LINE_STYLE: BokehStyle = {"line_width": 1.6, "line_dash": [6, 3], "name": "ekf2"}
TRUTH_LINE_STYLE: BokehStyle = {"line_width": 1.2, "line_dash": [1, 3], "name": "truth"}
HOLLOW_MARKER: BokehStyle = {"fill_color": None, "line_color": "black"}
# Arrow head at the upper or lower edge of a plot, for a value outside the axis range
ARROW_MARKER: BokehStyle = {"angle": "turn", "marker": "triangle"}
# Style of the shaded band that contains the values of a consistent filter
CONSISTENT_BAND_STYLE: BokehStyle = {"level": "underlay", "fill_alpha": 1.0, "name": "consistent"}
GAP_BAND_STYLE: BokehStyle = {
    "level": "underlay",
    "fill_color": None,
    "line_color": None,
    "hatch_pattern": "/",
    "hatch_color": "#888888",
    "hatch_alpha": 0.6,
}
# Limit (±) of innovation ÷ √S for 95 % of the innovations of a consistent filter
CONSISTENCY_LIMIT_IN_SQRT_S = 2.0
# Limit (±) of the plot axis of innovation ÷ √S
PLOT_LIMIT_IN_SQRT_S = 4.6
# Left margin (pixels) of a plot
LEFT_MARGIN_PIXELS = 50
# Left margin (pixels) of the event plot, which has long labels, and of the plot above
EVENT_LEFT_MARGIN_PIXELS = 82
LINE_STYLES = {
    "kf": KF_LINE_STYLE,
    "dotted": KF_LINE_STYLE | {"line_dash": [2, 2]},
    "ekf2": EKF2_LINE_STYLE,
    "truth": TRUTH_LINE_STYLE,
}


class Plot(Record):
    """Plot of several quantities over time.

    Attributes
    ----------
    line_definitions : tuple of (str, str, str, str)
        Data source, column, key of :data:`LINE_STYLES`, and label in the tooltip of each line.
    """

    line_definitions: tuple[tuple[str, str, str, str], ...]
    scale: Literal["linear", "log"] = "linear"
    unit: str = ""


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
    shared_time_range = _make_axis_range("time")
    plots = _make_plots(data, shared_time_range)
    plots |= {"strip": _make_event_plot(data, shared_time_range), "step": _make_phase_plot()}
    with document.models.freeze():  # Bokeh collects all models once, which is faster
        for plot in plots.values():
            document.add_root(plot)
    return document.to_json(deferred=False), {plot.id: name for name, plot in plots.items()}


def has_truth_or_ekf2(data: PageData) -> bool:
    """Return True if ground truth or EKF2's state is logged along at least one axis."""
    return _has_track(data, "truth") or _has_track(data, "ekf2")


def _has_track(data: PageData, kind: str) -> bool:
    return any(isinstance(axis[kind], dict) for axis in data["axes"])


def _make_plots(data: PageData, shared_time_range: Range1d) -> dict[str, Any]:
    missing_tracks = {kind for kind in ("ekf2", "truth") if not _has_track(data, kind)}
    plots: dict[str, Any] = {}
    for name, plot in PAGE_LAYOUT.plots.items():
        if name == "error" and not has_truth_or_ekf2(data):
            continue
        get_source = cache(lambda source, plot=name: _make_data_source(f"{plot}:{source}"))
        plot_figure = plots[name] = _make_figure(
            name,
            215,
            x_range=shared_time_range,
            y_axis_type=plot.scale,
            tools="xbox_zoom,xpan,tap",
            active_drag="xbox_zoom",
            lod_threshold=None,
            min_border_left=EVENT_LEFT_MARGIN_PIXELS if name == "position" else LEFT_MARGIN_PIXELS,
        )
        if name == "position":
            _draw_dots(plot_figure, get_source("measured"), "t z", 3, name="measured")
        if name == "innovation":
            _draw_innovations(plot_figure, get_source, with_ekf2="ekf2" not in missing_tracks)
        if name == "error":
            plot_figure.varea(
                "t", "minus", "plus", source=get_source("error"), fill_alpha=0.25, name="kf_band"
            )
        line_renderers: list[Any] = []
        for source_name, column, style_name, hover_name in plot.line_definitions:
            if style_name in missing_tracks:
                continue
            line_renderer = plot_figure.line(
                "t", column, source=get_source(source_name), **LINE_STYLES[style_name]
            )
            line_renderers.append(line_renderer)
            if hover_name:
                _add_hover(
                    plot_figure, line_renderer, hover_name, f"@{column}{{0.000}} {plot.unit}"
                )
        if name == "error":  # scale the axis without the 2σ band, which is very wide at the start
            plot_figure.y_range.renderers = line_renderers
        _add_cursor(plot_figure)
        for low, high in data["events"]["gap"]:
            plot_figure.add_layout(BoxAnnotation(left=low, right=high, **GAP_BAND_STYLE))
    return plots


def _draw_innovations(
    plot_figure: Any, get_source: Callable[[str], ColumnDataSource], *, with_ekf2: bool
) -> None:
    plot_figure.y_range = Range1d(start=-PLOT_LIMIT_IN_SQRT_S, end=PLOT_LIMIT_IN_SQRT_S)
    plot_figure.add_layout(
        BoxAnnotation(
            bottom=-CONSISTENCY_LIMIT_IN_SQRT_S,
            top=CONSISTENCY_LIMIT_IN_SQRT_S,
            **CONSISTENT_BAND_STYLE,
        )
    )
    kf_renderer = _draw_dots(plot_figure, get_source("updates"), "t x", 4, name="kf")
    _add_hover(plot_figure, kf_renderer, "KF", "@x{0.00}")
    _draw_dots(plot_figure, get_source("beyond"), "t y", 9, name="kf", **ARROW_MARKER)
    if with_ekf2:
        style: BokehStyle = {"marker": "square", "name": "ekf2"}
        fused_renderer = _draw_dots(plot_figure, get_source("fused"), "t x", 4, **style)
        rejected_renderer = _draw_dots(
            plot_figure, get_source("rejected"), "t x", 7, **style, **HOLLOW_MARKER
        )
        _add_hover(plot_figure, fused_renderer, "EKF2", "@x{0.00}")
        _add_hover(plot_figure, rejected_renderer, "EKF2 rejected", "@x{0.00}")
        _draw_dots(plot_figure, get_source("beyond_ekf2"), "t y", 9, name="ekf2", **ARROW_MARKER)


def _add_hover(plot_figure: Any, renderer: Any, label: str, value: str) -> None:
    tooltip_rows = [("time", "@t{0.00} s"), (label, value)]
    # place tooltips on different sides, so that they do not overlap
    tooltip_side: Any = {"EKF2": "right", "ground truth": "above"}.get(label, "left")
    plot_figure.add_tools(
        HoverTool(
            renderers=[renderer], tooltips=tooltip_rows, mode="vline", attachment=tooltip_side
        )
    )


def _make_figure(name: str, height: int, **options: Any) -> Any:
    return figure(
        name=name, height=height, sizing_mode="stretch_width", toolbar_location=None, **options
    )


def _add_cursor(plot_figure: Any, name: str = "cursor", **style: Any) -> None:
    """Add a vertical line at the time or position of the selected measurement."""
    plot_figure.add_layout(
        Span(dimension="height", location=0.0, visible=False, name=name, **style)
    )


def _make_axis_range(name: str | None = None) -> Range1d:
    return Range1d(start=0.1, end=1.0, name=name)


def _make_data_source(name: str) -> ColumnDataSource:
    return ColumnDataSource(
        {column: [] for column in BOKEH_SOURCE_COLUMNS.split()}, name=f"{name}-source"
    )


def _make_event_plot(data: PageData, shared_time_range: Range1d) -> Any:
    data_source = _make_data_source("strip")
    rows = PAGE_LAYOUT.event_rows if _has_track(data, "ekf2") else PAGE_LAYOUT.event_rows[2:]
    plot_figure = _make_figure(
        "strip",
        28 * len(rows) + 24,
        x_range=shared_time_range,
        y_range=FactorRange(factors=rows),
        tools="xbox_zoom,xpan",
        active_drag="xbox_zoom",
        min_border_left=EVENT_LEFT_MARGIN_PIXELS,
    )
    plot_figure.hbar(
        y="row",
        left="left",
        right="right",
        height=0.55,
        source=data_source,
        color="#7d8894",
        name="event",
    )
    _add_cursor(plot_figure)
    return plot_figure


def _draw_dots(
    plot_figure: Any, data_source: ColumnDataSource, xy_column_names: str, size: int, **style: Any
) -> Any:
    x, y = xy_column_names.split()
    return plot_figure.scatter(x, y, source=data_source, size=size, **{"line_color": None} | style)


def _make_phase_plot() -> Any:
    """Make the plot of KF position and velocity with 2σ ellipse and measurement."""
    plot_figure = _make_figure(
        "step",
        330,
        x_range=_make_axis_range(),
        y_range=_make_axis_range(),
        tools="",
        x_axis_label="position (m)",
        y_axis_label="velocity (m/s)",
    )
    plot_figure.add_layout(
        BoxAnnotation(name="band", fill_alpha=0.25, line_color=None, visible=False)
    )
    _add_cursor(plot_figure, "measurement", line_dash=[2, 2])
    plot_figure.line(
        "p", "v", source=_make_data_source("before"), **KF_LINE_STYLE | {"line_dash": [6, 3]}
    )
    plot_figure.patch("p", "v", source=_make_data_source("now"), fill_alpha=0.25, **KF_LINE_STYLE)
    _draw_dots(plot_figure, _make_data_source("mean"), "p v", 7, name="kf")
    return plot_figure
