"""Empty Bokeh plots of the page, which the page's script fills with data."""

from typing import Any, Literal

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    ColumnDataSource,
    FactorRange,
    HoverTool,
    LinearColorMapper,
    Range1d,
)
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure

from px4fuse.arrays import Array
from px4fuse.card.model import BANDS
from px4fuse.comparison.estimates import Tuning
from px4fuse.filter.tuning import AxisTuning
from px4fuse.record import Record, table
from px4fuse.report.style import EKF2_COLOUR, KF_COLOUR, MEASUREMENT_COLOUR, TRUTH_COLOUR

PLOT_HEIGHT = 215
# KF is dark, solid and round, EKF2 lighter, dashed and square, as in the report
KF_LINE: dict[str, Any] = {"line_color": KF_COLOUR, "line_width": 1.6, "name": "kf"}
EKF2_LINE: dict[str, Any] = {
    "line_color": EKF2_COLOUR,
    "line_width": 1.6,
    "line_dash": [6, 3],
    "name": "ekf2",
}
TRUTH_LINE: dict[str, Any] = {
    "line_color": TRUTH_COLOUR,
    "line_width": 1.2,
    "line_dash": [1, 3],
    "name": "truth",
}
# Bands in which the values of a consistent filter are
CONSISTENT_BAND: dict[str, Any] = {"level": "underlay", "fill_alpha": 1.0, "name": "consistent"}
# ±√S in which 95 % of the innovations are, and the range of their plot
NORMAL_BAND, NORMAL_RANGE = 2.0, 4.6
LEFT_BORDER, EVENT_BORDER = 50, 82  # pixels; the labels of events are longer
STYLES = {
    "kf": KF_LINE,
    "dotted": KF_LINE | {"line_dash": [2, 2]},
    "ekf2": EKF2_LINE,
    "truth": TRUTH_LINE,
}
# Range of the colours of the likelihood map, in standard deviations: √(2 · (ln L_max − ln L))
MAP_SIGMAS = 6.0


class Plot(Record, frozen=True):
    """A plot against time.

    Attributes
    ----------
    lines : tuple of (source, column, style, name)
        Key of :data:`STYLES`, and name in the tooltip ("": no tooltip).
    """

    lines: tuple[tuple[str, str, str, str], ...]
    scale: Literal["linear", "log"] = "linear"
    unit: str = ""


class Figures(Record, frozen=True):
    """Tables of ``figures.toml``."""

    event_rows: list[str]
    map_colours: list[str]
    panels: dict[str, str]
    sources: dict[str, str]
    plots: dict[str, Plot]


FIGURES = table(__file__, "figures.toml", Figures)


def document_json(data: dict[str, Any], tuning: Tuning) -> tuple[Any, dict[str, str]]:
    """Return Bokeh's document, and the element id of each root.

    Parameters
    ----------
    data : dict
        From :func:`px4fuse.explore.data.flight_data`.
    tuning : mapping
        Contains the likelihood maps.
    """
    document = Document()
    time_range = _page_range("time")
    plots = _plots(data, time_range)
    plots |= {
        "strip": _event_strip(data, time_range),
        "map": _likelihood_map(tuning),
        "plan": _plan_plot(),
        "step": _phase_plot(),
    }
    with document.models.freeze():  # collect the models of all roots once
        for plot in plots.values():
            document.add_root(plot)
    return document.to_json(deferred=False), {plot.id: name for name, plot in plots.items()}


def has_reference(data: dict[str, Any]) -> bool:
    """Return True if KF can be compared with ground truth or EKF2 along some axis."""
    return any(isinstance(axis[kind], dict) for axis in data["axes"] for kind in ("truth", "ekf2"))


def _plots(data: dict[str, Any], time_range: Range1d) -> dict[str, Any]:
    """Return the plots over time by name."""
    missing_kinds = {
        kind
        for kind in ("ekf2", "truth")
        if not any(isinstance(axis[kind], dict) for axis in data["axes"])
    }
    plots: dict[str, Any] = {}
    for name, plot in FIGURES.plots.items():
        if name == "error" and not has_reference(data):
            continue
        sources = _Sources(name)
        fig = plots[name] = figure(
            name=name,
            height=PLOT_HEIGHT,
            sizing_mode="stretch_width",
            x_range=time_range,
            y_range=_page_range(),
            toolbar_location=None,
            y_axis_type=plot.scale,
            tools="xbox_zoom,xpan,tap",
            active_drag="xbox_zoom",
            lod_threshold=None,
            min_border_left=LEFT_BORDER,
        )
        if name == "position":
            _draw_dots(fig, sources["measured"], MEASUREMENT_COLOUR, 3, name="measured")
            _draw_arrows(fig, sources["beyond"], MEASUREMENT_COLOUR, "measured")
        if name == "innovation":
            _draw_innovations(fig, sources, with_ekf2="ekf2" not in missing_kinds)
        if name == "error":
            fig.varea(
                "t", "minus", "plus", source=sources["error"], fill_alpha=0.25, name="kf_band"
            )
        if name == "running":
            low, high = BANDS["source"]
            fig.add_layout(BoxAnnotation(bottom=low, top=high, **CONSISTENT_BAND))
        for source, column, style_name, hover_name in plot.lines:
            if style_name in missing_kinds:
                continue
            line_renderer = fig.line("t", column, source=sources[source], **STYLES[style_name])
            if hover_name:
                _add_hover(fig, line_renderer, (hover_name, f"@{column}{{0.000}} {plot.unit}"))
        fig.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
        for low, high, style in _event_bands(data):
            fig.add_layout(BoxAnnotation(left=low, right=high, level="underlay", **style))
    return plots


class _Sources(dict[str, ColumnDataSource]):
    """Data sources of one plot, created on first use."""

    def __init__(self, plot: str) -> None:
        self.plot = plot

    def __missing__(self, name: str) -> ColumnDataSource:
        self[name] = _empty_source(f"{self.plot}:{name}", FIGURES.sources[name])
        return self[name]


def _draw_arrows(fig: Any, source: ColumnDataSource, colour: str, name: str) -> None:
    """Draw arrow heads at the upper or lower edge for values outside the plot."""
    fig.scatter(
        "t",
        "y",
        angle="turn",
        source=source,
        marker="triangle",
        size=9,
        fill_color=colour,
        line_color=None,
        name=name,
    )


def _draw_innovations(fig: Any, sources: dict[str, ColumnDataSource], *, with_ekf2: bool) -> None:
    """Draw innovation ÷ √S of KF and EKF2 as dots, in a band that contains 95 % of them."""
    fig.y_range = Range1d(start=-NORMAL_RANGE, end=NORMAL_RANGE)
    fig.add_layout(BoxAnnotation(bottom=-NORMAL_BAND, top=NORMAL_BAND, **CONSISTENT_BAND))
    kf_dots = fig.scatter(
        "t",
        "x",
        source=sources["updates"],
        size=4,
        fill_color=KF_COLOUR,
        line_color=None,
        name="kf",
    )
    _add_hover(fig, kf_dots, ("KF", "@x{0.00}"))
    _draw_arrows(fig, sources["beyond"], KF_COLOUR, "kf")
    if with_ekf2:
        square: dict[str, Any] = {"marker": "square", "name": "ekf2"}
        fused = _draw_dots(fig, sources["fused"], EKF2_COLOUR, 4, **square)
        rejected = _draw_dots(fig, sources["rejected"], None, 7, line_color=EKF2_COLOUR, **square)
        _add_hover(fig, fused, ("EKF2", "@x{0.00}"))
        _add_hover(fig, rejected, ("EKF2 rejected", "@x{0.00}"))
        _draw_arrows(fig, sources["beyond_ekf2"], EKF2_COLOUR, "ekf2")


def _add_hover(fig: Any, renderer: Any, *rows: tuple[str, str]) -> None:
    tips = [("time", "@t{0.00} s"), *rows]
    # The tooltips are on different sides, so that they do not overlap
    side: Any = {"EKF2": "right", "ground truth": "above"}.get(rows[0][0], "left")
    fig.add_tools(HoverTool(renderers=[renderer], tooltips=tips, mode="vline", attachment=side))


def _page_range(name: str | None = None) -> Range1d:
    """Return a range that the page sets."""
    return Range1d(start=0.1, end=1.0, name=name)


def _empty_source(name: str, columns: str) -> ColumnDataSource:
    """Return an empty source that the page fills."""
    empty: dict[str, Any] = {column: [] for column in columns.split()}
    return ColumnDataSource(empty, name=f"{name}-source")


def _event_bands(data: dict[str, Any]) -> list[tuple[float, float, dict[str, Any]]]:
    """Return the shaded spans behind the plots: modes (alternating), ground, gaps, dropouts."""
    grey: dict[str, Any] = {"fill_color": "#888888", "line_color": None}
    hatched: dict[str, Any] = {
        "hatch_pattern": "/",
        "hatch_color": "#888888",
        "hatch_alpha": 0.6,
        "fill_alpha": 0.05,
    }
    events = data["events"]
    sand: dict[str, Any] = {"fill_color": "#b08a3a", "fill_alpha": 0.1, "line_color": None}
    return [
        *((low, high, sand) for low, high, _ in events["modes"][1::2]),
        *((low, high, grey | {"fill_alpha": 0.18}) for low, high in events["ground"]),
        *((low, high, grey | hatched) for low, high in events["gap"]),
        *((low, high, grey | {"fill_alpha": 0.45}) for low, high in events["dropout"]),
    ]


def _event_strip(data: dict[str, Any], time_range: Range1d) -> Any:
    """Make the event plot, with a row per kind of event."""
    source = _empty_source("strip", "row left right text")
    has_ekf2 = any(isinstance(axis["ekf2"], dict) for axis in data["axes"])
    rows = FIGURES.event_rows if has_ekf2 else FIGURES.event_rows[2:]
    fig = figure(
        name="strip",
        height=28 * len(rows) + 24,
        sizing_mode="stretch_width",
        x_range=time_range,
        y_range=FactorRange(factors=rows),
        toolbar_location=None,
        tools="xbox_zoom,xpan",
        active_drag="xbox_zoom",
        min_border_left=EVENT_BORDER,
    )
    fig.hbar(
        y="row",
        left="left",
        right="right",
        height=0.55,
        source=source,
        fill_color="#7d8894",
        line_color="#7d8894",
        name="event",
    )
    fig.text(
        "left",
        "row",
        "text",
        source=source,
        text_font_size="11px",
        text_baseline="middle",
        x_offset=3,
        name="ink",
    )
    fig.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
    return fig


def _likelihood_map(tuning: Tuning) -> Any:
    """Make the map of the log-likelihood over SIGMA_A and SIGMA_Z, with the current settings."""
    fig = figure(
        name="map",
        height=250,
        sizing_mode="stretch_width",
        x_axis_type="log",
        y_axis_type="log",
        x_range=_page_range(),
        y_range=_page_range(),
        tools="tap",
        toolbar_location=None,
        x_axis_label="SIGMA_A (m/s²)",
        y_axis_label="SIGMA_Z (m)",
    )
    mapper = LinearColorMapper(palette=FIGURES.map_colours, low=0.0, high=MAP_SIGMAS)
    for name, tuned in tuning.items():
        if isinstance(tuned, AxisTuning):
            x, dw = _pixel_extent(tuned.map.sigma_a_m_s2)
            y, dh = _pixel_extent(tuned.map.sigma_z_m)
            # rows: SIGMA_Z, columns: SIGMA_A
            image = np.sqrt(2.0 * np.maximum(tuned.map.drop.T, 0.0)).astype(np.float32)
            draw: Any = fig.image  # color_mapper is missing in its type signature
            draw([image], x, y, dw, dh, color_mapper=mapper, name=f"map:{name}", visible=False)
    trail = _empty_source("trail", "x y")
    best = _empty_source("best", "x y")
    point = _empty_source("point", "x y")
    white: dict[str, Any] = {"line_color": "white"}
    fig.line("x", "y", source=trail, line_color=EKF2_COLOUR, line_width=1.2, name="ekf2")
    _draw_dots(fig, trail, EKF2_COLOUR, 3, name="ekf2")
    fig.scatter("x", "y", source=best, size=13, marker="cross", line_width=2.5, **white)
    _draw_dots(fig, point, EKF2_COLOUR, 12, marker="circle", line_width=2.0, **white)
    return fig


def _draw_dots(
    fig: Any, source: ColumnDataSource, colour: str | None, size: int, **style: Any
) -> Any:
    """Draw dots at the last two columns of a source, without an edge line by default."""
    x, y = source.column_names[-2:]
    marker_style = {"size": size, "fill_color": colour, "line_color": None} | style
    return fig.scatter(x, y, source=source, **marker_style)


def _pixel_extent(values: Array) -> tuple[float, float]:
    """Return start and length of an image on a logarithmic axis from the centres of its pixels."""
    half_pixel = float(np.sqrt(values[1] / values[0]))
    start, end = float(values[0]) / half_pixel, float(values[-1]) * half_pixel
    return start, end - start


def _plan_plot() -> Any:
    """Make the map of the track; a selection on it sets the time range of all plots."""
    fig = figure(
        name="plan",
        height=250,
        sizing_mode="stretch_width",
        match_aspect=True,
        tools="box_select,tap",
        active_drag="box_select",
        toolbar_location=None,
        x_axis_label="east (m)",
        y_axis_label="north (m)",
    )
    track = _empty_source("plan", "t east north")
    shown_source = _empty_source("shown", "east north")
    cursor = _empty_source("here", "east north")
    fig.line("east", "north", source=track, line_color=MEASUREMENT_COLOUR, line_width=1.0)
    _draw_dots(fig, track, MEASUREMENT_COLOUR, 3, nonselection_fill_alpha=0.6)
    _draw_dots(fig, shown_source, KF_COLOUR, 4, name="kf")
    _draw_dots(
        fig,
        cursor,
        None,
        12,
        marker="circle_x",
        line_color=EKF2_COLOUR,
        line_width=2.0,
        name="ekf2",
    )
    return fig


def _phase_plot() -> Any:
    """Make the phase plane: position and velocity with their 2σ ellipse, and the measurement."""
    fig = figure(
        name="step",
        height=330,
        sizing_mode="stretch_width",
        x_range=_page_range(),
        y_range=_page_range(),
        tools="",
        toolbar_location=None,
        x_axis_label="position (m)",
        y_axis_label="velocity (m/s)",
    )
    band: dict[str, Any] = {"left": 0.0, "right": 0.0, "visible": False}
    fig.add_layout(
        BoxAnnotation(
            name="band", fill_color=MEASUREMENT_COLOUR, fill_alpha=0.25, line_color=None, **band
        )
    )
    fig.add_layout(
        Span(dimension="height", location=0.0, visible=False, name="measurement", line_dash=[2, 2])
    )
    trail = _empty_source("trail-means", "p v")
    before, current = _empty_source("before", "p v"), _empty_source("now", "p v")
    mean = _empty_source("mean", "p v")
    fig.line("p", "v", source=trail, line_color=MEASUREMENT_COLOUR, line_width=1.0, name="measured")
    fig.line("p", "v", source=before, **KF_LINE | {"line_dash": [6, 3]})
    fig.patch("p", "v", source=current, fill_color=KF_COLOUR, fill_alpha=0.25, **KF_LINE)
    _draw_dots(fig, mean, KF_COLOUR, 7, name="kf")
    return fig
