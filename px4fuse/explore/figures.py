"""Bokeh plots of the web page of ``px4fuse explore``; JavaScript adds the data."""

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple

from bokeh.document import Document
from bokeh.models import ColumnDataSource, HoverTool, Range1d
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure

from px4fuse.report.style import (
    CONSISTENT_BAND_COLOUR,
    EKF2_COLOUR,
    KF_COLOUR,
    MEASUREMENT_COLOUR,
    TRUTH_COLOUR,
)

from .data import PageData


class Plot(NamedTuple):
    """Plot of one column of several data sources over time.

    Attributes
    ----------
    tab : str
        Tab of the web page, a key of :data:`TITLE_BY_TAB`.
    lines : tuple of str
        Data sources (keys of :data:`LINE_STYLES`); later lines are drawn on top.
    """

    tab: str
    title: str
    column: str
    lines: tuple[str, ...] = ()
    scale: Literal["linear", "log"] = "linear"


TITLE_BY_TAB = {
    "errors": "Errors",
    "sigma": "σ",
    "track": "Position",
    "speed": "Velocity",
    "gains": "Gain",
    "step": "Step by step",
}
# Plots over time. Each plot has separate data sources: the page fills only those of visible plots
PLOTS = {
    "innovation": Plot("errors", "Innovation ÷ √S", "x"),
    "error": Plot("errors", "Position error (m)", "e", ("kf", "ekf2")),
    "sigma_p": Plot("sigma", "σ of position (m)", "sp", ("kf", "ekf2"), "log"),
    "sigma_v": Plot("sigma", "σ of velocity (m/s)", "sv", ("kf", "ekf2"), "log"),
    "position": Plot("track", "Position (m)", "p", ("truth", "kf", "ekf2")),
    "velocity": Plot("speed", "Velocity (m/s)", "v", ("truth", "kf", "ekf2")),
    "gain_p": Plot("gains", "Position gain of KF", "k0", ("gain",)),
    "gain_v": Plot("gains", "Velocity gain of KF (1/s)", "k1", ("gain",)),
}
# Keyword arguments of Bokeh's drawing functions
BokehStyle = dict[str, Any]
# Columns of the Bokeh data sources, which JavaScript fills
BOKEH_SOURCE_COLUMNS = (
    "t p v sp sv "  # t: time (s); p: position (m), v: velocity (m/s); sp, sv: their σ
    "k0 k1 "  # KF gain: k0 of position, k1 of velocity (1/s)
    "e minus plus "  # e: position error (m); minus, plus: limits (m) of its 2σ band
    "x y marker"  # x: innovation ÷ √S; y: drawn value (plot edge if x is outside); marker: symbol
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
# End (±) of the plot axis for innovation ÷ √S
INNOVATION_AXIS_LIMIT_IN_SQRT_S = 4.6


def make_document_json(data: PageData) -> tuple[Any, dict[str, str]]:
    """Return a Bokeh document with all plots as JSON, and the name of each plot by its id."""
    document = Document()
    shared_time_range = Range1d(name="time")
    plots = {
        name: _make_plot(name, plot, data, shared_time_range)
        for name, plot in select_plots(data).items()
    }
    plots["step"] = _make_phase_plot()
    with document.models.freeze():  # Bokeh collects all models once, which is faster
        for plot_figure in plots.values():
            document.add_root(plot_figure)
    return document.to_json(deferred=False), {plot.id: name for name, plot in plots.items()}


def select_plots(data: PageData) -> dict[str, Plot]:
    """Return all plots, without the position error if ground truth and EKF2's state are missing."""
    has_reference = any(axis["truth"] or axis["ekf2"] for axis in data["axes"])
    return {name: plot for name, plot in PLOTS.items() if name != "error" or has_reference}


def _make_plot(name: str, plot: Plot, data: PageData, shared_time_range: Range1d) -> Any:
    """Make the plot ``name`` over time; JavaScript fills its data sources."""
    # Data source of the plot by its short name; the first call makes the source
    get_source = cache(lambda source: _make_data_source(f"{name}:{source}"))
    plot_figure: Any = figure(
        name=name,
        height=215,
        sizing_mode="stretch_width",
        toolbar_location=None,
        x_range=shared_time_range,
        y_axis_type=plot.scale,
        tools="xbox_zoom",
        lod_threshold=None,
        min_border_left=50,
    )
    # vertical line at the time of the selected measurement
    plot_figure.add_layout(Span(dimension="height", name="cursor"))
    if name == "position":
        plot_figure.scatter(
            "t",
            "p",
            source=get_source("measured"),
            size=3,
            fill_color=MEASUREMENT_COLOUR,
            line_color=None,
        )
    if name == "innovation":
        _draw_innovations(plot_figure, get_source)
    if name == "error":
        plot_figure.varea("t", "minus", "plus", source=get_source("kf"), **KF_BAND_STYLE)
    line_renderers: list[Any] = []
    for line in plot.lines:
        style, label = LINE_STYLES[line]
        renderer = plot_figure.line("t", plot.column, source=get_source(line), **style)
        line_renderers.append(renderer)
        _add_hover(plot_figure, renderer, label, f"@{plot.column}{{0.000}}")
    if name == "error":  # scale the axis without the 2σ band, which is very wide at the start
        plot_figure.y_range.renderers = line_renderers
    for start_s, end_s in data["gaps"]:
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


def _draw_innovations(plot_figure: Any, get_source: Callable[[str], ColumnDataSource]) -> None:
    """Draw the innovations ÷ √S of KF and EKF2, and the band of consistent innovations."""
    plot_figure.y_range = Range1d(
        start=-INNOVATION_AXIS_LIMIT_IN_SQRT_S, end=INNOVATION_AXIS_LIMIT_IN_SQRT_S
    )
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
        ("innovations", "KF", 5, {"fill_color": KF_COLOUR, "line_color": None}),
        ("fused", "EKF2", 5, {"fill_color": EKF2_COLOUR, "line_color": None}),
        ("rejected", "EKF2 rejected", 7, {"fill_color": None, "line_color": EKF2_COLOUR}),
    ]
    for source_name, label, size, style in dots:
        renderer = plot_figure.scatter(
            "t", "y", source=get_source(source_name), size=size, marker="marker", **style
        )
        _add_hover(plot_figure, renderer, label, "@x{0.00}")


def _add_hover(plot_figure: Any, renderer: Any, label: str, value: str) -> None:
    """Add a tooltip with time and value; ``value`` is the value's column and format in Bokeh."""
    # Place tooltips on different sides, so that they do not overlap
    side: Any = {"EKF2": "right", "ground truth": "above"}.get(label, "left")
    tooltip_rows = [("time", "@t{0.00} s"), (label, value)]
    plot_figure.add_tools(
        HoverTool(renderers=[renderer], tooltips=tooltip_rows, mode="vline", attachment=side)
    )


def _make_data_source(name: str) -> ColumnDataSource:
    """Make an empty data source with all columns, which JavaScript finds by its name."""
    return ColumnDataSource(
        {column: [] for column in BOKEH_SOURCE_COLUMNS.split()}, name=f"{name}-source"
    )


def _make_phase_plot() -> Any:
    """Make the plot of KF position and velocity with 2σ ellipses and measurement."""
    plot_figure = figure(
        name="step",
        height=330,
        sizing_mode="stretch_width",
        toolbar_location=None,
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
    before_source, now_source, mean_source = map(_make_data_source, ("before", "now", "mean"))
    plot_figure.line("p", "v", source=before_source, line_dash=[6, 3], **KF_LINE_STYLE)
    plot_figure.patch("p", "v", source=now_source, **KF_LINE_STYLE, **KF_BAND_STYLE)
    plot_figure.scatter("p", "v", source=mean_source, size=7, fill_color=KF_COLOUR, line_color=None)
    return plot_figure
