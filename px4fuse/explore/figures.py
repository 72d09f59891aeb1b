"""The page's plots, empty: the page fills them with what its settings give."""

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
from px4fuse.comparison.estimates import Tuning
from px4fuse.explore.data import RUNNING
from px4fuse.filter.consistency import nis_band
from px4fuse.filter.tuning import AxisTuning
from px4fuse.record import Record, table
from px4fuse.report.style import EKF2, MEASUREMENT, OURS, TRUTH

HEIGHT, TALL = 150, 210
# Ours is dark, solid and round; EKF2 is lighter, dashed and square, as in the report
OURS_LINE: dict[str, Any] = {"line_color": OURS, "line_width": 1.6, "name": "ours"}
EKF2_LINE: dict[str, Any] = {
    "line_color": EKF2,
    "line_width": 1.6,
    "line_dash": [6, 3],
    "name": "ekf2",
}
TRUTH_LINE: dict[str, Any] = {
    "line_color": TRUTH,
    "line_width": 1.2,
    "line_dash": [1, 3],
    "name": "truth",
}
NIS_BAND: dict[str, Any] = {
    "level": "underlay",
    "fill_alpha": 0.15,
    "fill_color": "#4a8f5a",
    "line_color": "#4a8f5a",
}
LEFT = 96
STYLES = {
    "ours": OURS_LINE,
    "dotted": OURS_LINE | {"line_dash": [2, 2]},
    "ekf2": EKF2_LINE,
    "truth": TRUTH_LINE,
}
# √(2 · drop of log-likelihood): as far as so many standard deviations
MAP_SIGMAS = 6.0


class Plot(Record, frozen=True):
    """A plot against time.

    Attributes
    ----------
    lines : tuple of (source, column, style, name)
        Of :data:`STYLES`; the name at the pointer, where it has one.
    """

    label: str
    lines: tuple[tuple[str, str, str, str], ...]
    tall: bool = False
    scale: Literal["linear", "log"] = "linear"
    unit: str = ""


class Figures(Record, frozen=True):
    """The tables of ``figures.toml``."""

    strip: list[str]
    map_colours: list[str]
    panels: dict[str, str]
    sources: dict[str, str]
    plots: dict[str, Plot]


FIGURES = table(__file__, "figures.toml", Figures)


def document_json(data: dict[str, Any], tuning: Tuning) -> tuple[Any, dict[str, str]]:
    """Bokeh's document, and of each root the id of the element that it goes into.

    Parameters
    ----------
    data : dict
        From :func:`px4fuse.explore.data.flight_data`.
    tuning : mapping
        For the likelihood maps.
    """
    document = Document()
    time_range = _range("time")
    plots = _plots(data, time_range)
    plots |= {
        "strip": _strip(data, time_range),
        "map": _map(tuning),
        "plan": _plan(),
        "step": _step(),
    }
    with document.models.freeze():  # what belongs to the roots is looked for once
        for plot in plots.values():
            document.add_root(plot)
    return document.to_json(deferred=False), {plot.id: name for name, plot in plots.items()}


def _plots(data: dict[str, Any], time_range: Range1d) -> dict[str, Any]:
    """Every plot against time, by its name."""
    lacking = {
        kind
        for kind in ("ekf2", "truth")
        if not any(isinstance(axis[kind], dict) for axis in data["axes"])
    }
    plots: dict[str, Any] = {}
    for name, plot in FIGURES.plots.items():
        if name == "error" and "truth" in lacking:
            continue
        sources = _Sources(name)
        made = plots[name] = figure(
            name=name,
            height=TALL if plot.tall else HEIGHT,
            sizing_mode="stretch_width",
            x_range=time_range,
            y_range=_range(),
            toolbar_location=None,
            y_axis_type=plot.scale,
            tools="xbox_zoom,xpan,tap",
            active_drag="xbox_zoom",
            y_axis_label=plot.label,
            lod_threshold=None,
            min_border_left=LEFT,
        )
        if name == "position":
            _dots(made, sources["measured"], MEASUREMENT, 3, name="measured")
            _beyond(made, sources["beyond"], MEASUREMENT, "measured")
        if name == "innovation":
            _innovations(made, sources, with_ekf2="ekf2" not in lacking)
        if name == "nis":
            low, high = nis_band(RUNNING)
            made.add_layout(BoxAnnotation(bottom=low, top=high, **NIS_BAND))
        for source, column, whose, who in plot.lines:
            if whose in lacking:
                continue
            drawn = made.line("t", column, source=sources[source], **STYLES[whose])
            if who:
                _hover(made, drawn, (who, f"@{column}{{0.000}} {plot.unit}"))
        made.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
        for low, high, style in _bands(data):
            made.add_layout(BoxAnnotation(left=low, right=high, level="underlay", **style))
    return plots


class _Sources(dict[str, ColumnDataSource]):
    """The sources of one plot, each made when it is first asked for."""

    def __init__(self, plot: str) -> None:
        self.plot = plot

    def __missing__(self, name: str) -> ColumnDataSource:
        self[name] = _source(f"{self.plot}:{name}", FIGURES.sources[name])
        return self[name]


def _beyond(made: Any, source: ColumnDataSource, colour: str, name: str) -> None:
    """Arrow heads at the edge that hides something, turned upside down at the lower one."""
    made.scatter(
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


def _innovations(made: Any, sources: dict[str, ColumnDataSource], *, with_ekf2: bool) -> None:
    """Innovations of both filters as dots, and our ±2√S as a band."""
    updates = sources["updates"]
    made.varea(
        "t", "minus", "plus", source=updates, fill_color=OURS, fill_alpha=0.15, name="ours_band"
    )
    if with_ekf2:
        square: dict[str, Any] = {"marker": "square", "name": "ekf2"}
        fused = _dots(made, sources["fused"], EKF2, 4, **square)
        rejected = _dots(made, sources["rejected"], None, 7, line_color=EKF2, **square)
        _hover(made, fused, ("EKF2", "@nu{0.000} m"))
        _hover(made, rejected, ("EKF2 rejected", "@nu{0.000} m"))
        _beyond(made, sources["beyond_ekf2"], EKF2, "ekf2")
    ours = made.scatter(
        "t", "nu", source=updates, size=4, fill_color=OURS, line_color=None, name="ours"
    )
    _hover(made, ours, ("ours", "@nu{0.000} m"), ("2√S", "@plus{0.000} m"))
    _beyond(made, sources["beyond"], OURS, "ours")


def _hover(made: Any, renderer: Any, *rows: tuple[str, str]) -> None:
    tips = [("time", "@t{0.00} s"), *rows]
    side: Any = {"EKF2": "right", "truth": "above"}.get(rows[0][0], "left")  # none hides another
    made.add_tools(HoverTool(renderers=[renderer], tooltips=tips, mode="vline", attachment=side))


def _range(name: str | None = None) -> Range1d:
    """For the page to set."""
    return Range1d(start=0.1, end=1.0, name=name)


def _source(name: str, columns: str) -> ColumnDataSource:
    """Empty, for the page to fill."""
    empty: dict[str, Any] = {column: [] for column in columns.split()}
    return ColumnDataSource(empty, name=f"{name}-source")


def _bands(data: dict[str, Any]) -> list[tuple[float, float, dict[str, Any]]]:
    """Shading behind every plot against time: modes in turn, ground, silence, dropouts."""
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
        *((low, high, grey | hatched) for low, high in events["silent"]),
        *((low, high, grey | {"fill_alpha": 0.45}) for low, high in events["dropout"]),
    ]


def _strip(data: dict[str, Any], time_range: Range1d) -> Any:
    """What happened when, a row for each kind, so that no colour is needed to tell them apart."""
    source = _source("strip", "row left right text")
    has_ekf2 = any(isinstance(axis["ekf2"], dict) for axis in data["axes"])
    rows = FIGURES.strip if has_ekf2 else FIGURES.strip[2:]
    made = figure(
        name="strip",
        height=28 * len(rows) + 24,
        sizing_mode="stretch_width",
        x_range=time_range,
        y_range=FactorRange(factors=rows),
        toolbar_location=None,
        tools="xbox_zoom,xpan",
        active_drag="xbox_zoom",
        min_border_left=LEFT,
        x_axis_label="time (s)",
    )
    made.hbar(
        y="row",
        left="left",
        right="right",
        height=0.55,
        source=source,
        fill_color="#7d8894",
        line_color="#7d8894",
        name="event",
    )
    made.text(
        "left",
        "row",
        "text",
        source=source,
        text_font_size="11px",
        text_baseline="middle",
        x_offset=3,
        name="ink",
    )
    made.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
    return made


def _map(tuning: Tuning) -> Any:
    """How likely the innovations are over both noises, and where the sliders stand."""
    made = figure(
        name="map",
        height=250,
        sizing_mode="stretch_width",
        x_axis_type="log",
        y_axis_type="log",
        x_range=_range(),
        y_range=_range(),
        tools="tap",
        toolbar_location=None,
        x_axis_label="SIGMA_A (m/s²)",
        y_axis_label="SIGMA_Z (m)",
    )
    mapper = LinearColorMapper(palette=FIGURES.map_colours, low=0.0, high=MAP_SIGMAS)
    for name, tuned in tuning.items():
        if isinstance(tuned, AxisTuning):
            x, dw = _outer(tuned.map.sigma_a_m_s2)
            y, dh = _outer(tuned.map.sigma_z_m)
            # rows are SIGMA_Z
            image = np.sqrt(2.0 * np.maximum(tuned.map.drop.T, 0.0)).astype(np.float32)
            draw: Any = made.image  # its colours stand in no signature
            draw([image], x, y, dw, dh, color_mapper=mapper, name=f"map:{name}", visible=False)
    trail = _source("trail", "x y")
    best = _source("best", "x y")
    point = _source("point", "x y")
    white: dict[str, Any] = {"line_color": "white"}
    made.line("x", "y", source=trail, line_color=EKF2, line_width=1.2, name="ekf2")
    _dots(made, trail, EKF2, 3, name="ekf2")
    made.scatter("x", "y", source=best, size=13, marker="cross", line_width=2.5, **white)
    _dots(made, point, EKF2, 12, marker="circle", line_width=2.0, **white)
    return made


def _dots(made: Any, source: ColumnDataSource, colour: str | None, size: int, **style: Any) -> Any:
    """Dots without an edge, unless the style has one, at a source's last two columns."""
    x, y = source.column_names[-2:]
    look = {"size": size, "fill_color": colour, "line_color": None} | style
    return made.scatter(x, y, source=source, **look)


def _outer(values: Array) -> tuple[float, float]:
    """Where the pixels of a logarithmic axis begin, and how far they reach."""
    half = float(np.sqrt(values[1] / values[0]))
    return float(values[0]) / half, float(values[-1]) * half - float(values[0]) / half


def _plan() -> Any:
    """The track seen from above; what is chosen on it is the time that all plots show."""
    made = figure(
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
    track = _source("plan", "t east north")
    shown = _source("shown", "east north")
    here = _source("here", "east north")
    made.line("east", "north", source=track, line_color=MEASUREMENT, line_width=1.0)
    _dots(made, track, MEASUREMENT, 3, nonselection_fill_alpha=0.6)
    _dots(made, shown, OURS, 4, name="ours")
    _dots(made, here, None, 12, marker="circle_x", line_color=EKF2, line_width=2.0, name="ekf2")
    return made


def _step() -> Any:
    """The phase plane: position and velocity with their ellipse of 2σ, and what was measured."""
    made = figure(
        name="step",
        height=330,
        sizing_mode="stretch_width",
        x_range=_range(),
        y_range=_range(),
        tools="",
        toolbar_location=None,
        x_axis_label="position (m)",
        y_axis_label="velocity (m/s)",
    )
    band: dict[str, Any] = {"left": 0.0, "right": 0.0, "visible": False}
    made.add_layout(
        BoxAnnotation(name="band", fill_color=MEASUREMENT, fill_alpha=0.25, line_color=None, **band)
    )
    made.add_layout(
        Span(dimension="height", location=0.0, visible=False, name="measurement", line_dash=[2, 2])
    )
    trail = _source("trail-means", "p v")
    before, now = _source("before", "p v"), _source("now", "p v")
    mean = _source("mean", "p v")
    made.line("p", "v", source=trail, line_color=MEASUREMENT, line_width=1.0, name="measured")
    made.line("p", "v", source=before, **OURS_LINE | {"line_dash": [6, 3]})
    made.patch("p", "v", source=now, fill_color=OURS, fill_alpha=0.25, **OURS_LINE)
    _dots(made, mean, OURS, 7, name="ours")
    return made
