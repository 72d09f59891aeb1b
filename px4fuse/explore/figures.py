"""The page's plots, empty: the page fills them with what its settings give."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    FactorRange,
    HoverTool,
    LinearColorMapper,
    Range1d,
    Span,
)
from bokeh.plotting import figure

from px4fuse.analysis import Tuning
from px4fuse.arrays import Array
from px4fuse.filter.tuning import AxisTuning
from px4fuse.report.style import EKF2, MEASUREMENT, OURS, TRUTH

HEIGHT, TALL = 190, 250
# Ours is dark, solid and round; EKF2 is lighter, dashed and square, as in the report
OURS_LINE: dict[str, Any] = {"line_color": OURS, "line_width": 1.6, "name": "ours"}
EKF2_LINE: dict[str, Any] = {
    "line_color": EKF2, "line_width": 1.6, "line_dash": [6, 3], "name": "ekf2",
}  # fmt: skip
TRUTH_LINE: dict[str, Any] = {
    "line_color": TRUTH, "line_width": 1.2, "line_dash": [1, 3], "name": "truth",
}  # fmt: skip
# Rows of the strip of events
STRIP = ["EKF2 reset", "EKF2 rejected", "log dropout", "source silent", "on the ground", "mode"]
# √(2 · drop of log-likelihood): as far as so many standard deviations
MAP_SIGMAS = 6.0
MAP_COLOURS = [
    "#f7fbff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6",
    "#3182bd", "#2171b5", "#11599d", "#08519c", "#084285", "#08306b",
][::-1]  # fmt: skip


def document_json(
    flights: list[dict[str, Any]], tunings: list[Tuning]
) -> tuple[Any, dict[str, str]]:
    """Bokeh's document, and of each root the id of the element that it goes into.

    Parameters
    ----------
    flights : list of dict
        From :func:`px4fuse.explore.data.flight_data`.
    tunings : list of mapping
        Of each flight, for its likelihood maps.
    """
    document = Document()
    time_range = Range1d(0.0, 1.0, name="time")
    places: dict[str, str] = {}
    for number, (data, tuning) in enumerate(zip(flights, tunings, strict=True)):
        plots = _plots(number, data, time_range)
        plots |= {
            "strip": _strip(number, data, time_range),
            "map": _map(number, tuning),
            "plan": _plan(number),
            "step": _step(number),
        }
        for name, plot in plots.items():
            document.add_root(plot)
            places[plot.id] = f"{name}-{number}"
    return document.to_json(deferred=False), places


def _plots(number: int, data: dict[str, Any], time_range: Range1d) -> dict[str, Any]:
    sources = {
        name: _source(name, number, columns)
        for name, columns in {
            "steps": "t p v sp sv",
            "updates": "t nu plus minus k0 k1 running",
            "measured": "t z",
            "state": "t p v",
            "variance": "t sp sv",
            "fused": "t nu",
            "rejected": "t nu",
            "limits": "t plus minus",
            "running": "t running",
            "truth_p": "t p",
            "truth_v": "t v",
            "error": "t e",
            "error_ekf2": "t e",
        }.items()
    }
    has_ekf2 = any(isinstance(axis["ekf2"], dict) for axis in data["axes"])
    has_truth = any(isinstance(axis["truth"], dict) for axis in data["axes"])

    def plot(name: str, label: str, height: int = HEIGHT, **more: Any) -> Any:
        made = figure(
            name=f"{name}-{number}", height=height, sizing_mode="stretch_width",
            x_range=time_range, y_range=Range1d(0.0, 1.0), toolbar_location=None,
            tools="xbox_zoom,xpan,tap", active_drag="xbox_zoom", y_axis_label=label,
            output_backend="canvas", lod_threshold=None, min_border_left=96, **more,
        )  # fmt: skip
        made.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
        shift = data["shift"]
        for low, high, style in _bands(data):
            made.add_layout(
                BoxAnnotation(left=low - shift, right=high - shift, level="underlay", **style)
            )
        return made

    def dots(made: Any, source: str, column: str, **style: Any) -> Any:
        return made.scatter("t", column, source=sources[source], **style)

    def hover(made: Any, renderers: list[Any], *rows: tuple[str, str]) -> None:
        made.add_tools(
            HoverTool(renderers=renderers, tooltips=[("time", "@t{0.00} s"), *rows], mode="vline")
        )

    plots: dict[str, Any] = {}
    made = plots["position"] = plot("position", "position (m)", TALL)
    dots(made, "measured", "z", size=3, fill_color=MEASUREMENT, line_color=None, name="measured")
    if has_truth:
        made.line("t", "p", source=sources["truth_p"], **TRUTH_LINE)
    if has_ekf2:
        theirs = made.line("t", "p", source=sources["state"], **EKF2_LINE)
        hover(made, [theirs], ("EKF2", "@p{0.000} m"))
    ours = made.line("t", "p", source=sources["steps"], **OURS_LINE)
    hover(made, [ours], ("ours", "@p{0.000} m"))

    made = plots["velocity"] = plot("velocity", "velocity (m/s)")
    if has_truth:
        made.line("t", "v", source=sources["truth_v"], **TRUTH_LINE)
    if has_ekf2:
        theirs = made.line("t", "v", source=sources["state"], **EKF2_LINE)
        hover(made, [theirs], ("EKF2", "@v{0.000} m/s"))
    ours = made.line("t", "v", source=sources["steps"], **OURS_LINE)
    hover(made, [ours], ("ours", "@v{0.000} m/s"))

    if has_truth:
        made = plots["error"] = plot("error", "error (m)")
        made.line("t", "e", source=sources["error_ekf2"], **EKF2_LINE)
        ours = made.line("t", "e", source=sources["error"], **OURS_LINE)
        hover(made, [ours], ("ours", "@e{0.000} m"))

    made = plots["innovation"] = plot("innovation", "innovation ν (m)", TALL)
    updates = sources["updates"]
    made.varea(
        "t", "minus", "plus", source=updates, fill_color=OURS, fill_alpha=0.15, name="ours_band"
    )
    if has_ekf2:
        for side in ("plus", "minus"):
            made.line("t", side, source=sources["limits"], **EKF2_LINE)
        theirs = dots(made, "fused", "nu", size=4, marker="square", fill_color=EKF2,
                      line_color=None, name="ekf2")  # fmt: skip
        hollow = dots(made, "rejected", "nu", size=7, marker="square", fill_color=None,
                      line_color=EKF2, name="ekf2")  # fmt: skip
        hover(made, [theirs], ("EKF2", "@nu{0.000} m"))
        hover(made, [hollow], ("EKF2 rejected", "@nu{0.000} m"))
    ours = dots(
        made, "updates", "nu", size=4, marker="circle", fill_color=OURS, line_color=None,
        name="ours",
    )  # fmt: skip
    hover(made, [ours], ("ours", "@nu{0.000} m"), ("2√S", "@plus{0.000} m"))

    for name, label, column, unit in (
        ("sigma_p", "σ of position (m)", "sp", "m"), ("sigma_v", "σ of velocity (m/s)", "sv", "m/s")
    ):  # fmt: skip
        made = plots[name] = plot(name, label, y_axis_type="log")
        if has_ekf2:
            theirs = made.line("t", column, source=sources["variance"], **EKF2_LINE)
            hover(made, [theirs], ("EKF2", f"@{column}{{0.0000}} {unit}"))
        ours = made.line("t", column, source=sources["steps"], **OURS_LINE)
        hover(made, [ours], ("ours", f"@{column}{{0.0000}} {unit}"))

    made = plots["nis"] = plot("nis", "running mean of NIS", y_axis_type="log")
    made.add_layout(BoxAnnotation(name="nis_band", level="underlay", fill_alpha=0.15,
                                  fill_color="#4a8f5a", line_color="#4a8f5a"))  # fmt: skip
    if has_ekf2:
        theirs = made.line("t", "running", source=sources["running"], **EKF2_LINE)
        hover(made, [theirs], ("EKF2", "@running{0.00}"))
    ours = made.line("t", "running", source=updates, **OURS_LINE)
    hover(made, [ours], ("ours", "@running{0.00}"))

    made = plots["gain"] = plot("gain", "gain K (1, 1/s)")
    first = made.line("t", "k0", source=updates, **OURS_LINE)
    made.line("t", "k1", source=updates, **(OURS_LINE | {"line_dash": [2, 2]}))
    hover(made, [first], ("position", "@k0{0.0000}"), ("velocity", "@k1{0.0000} 1/s"))
    return plots


def _source(name: str, number: int, columns: str) -> ColumnDataSource:
    """Empty, for the page to fill."""
    empty: dict[str, list[float]] = {column: [] for column in columns.split()}
    return ColumnDataSource(empty, name=f"{name}-source-{number}")


def _bands(data: dict[str, Any]) -> list[tuple[float, float, dict[str, Any]]]:
    """Shading behind every plot against time: where the source is silent, and on the ground."""
    grey: dict[str, Any] = {"fill_color": "#888888", "line_color": None}
    hatched: dict[str, Any] = {
        "hatch_pattern": "/", "hatch_color": "#888888", "hatch_alpha": 0.6, "fill_alpha": 0.05,
    }  # fmt: skip
    events = data["events"]
    return [
        *((low, high, grey | {"fill_alpha": 0.18}) for low, high in events["ground"]),
        *((low, high, grey | hatched) for low, high in events["silent"]),
        *((low, high, grey | {"fill_alpha": 0.45}) for low, high in events["dropout"]),
    ]


def _strip(number: int, data: dict[str, Any], time_range: Range1d) -> Any:
    """What happened when, a row for each kind, so that no colour is needed to tell them apart."""
    source = _source("strip", number, "row left right text")
    rows = STRIP if any(isinstance(axis["ekf2"], dict) for axis in data["axes"]) else STRIP[2:]
    made = figure(
        name=f"strip-{number}", height=28 * len(rows) + 24, sizing_mode="stretch_width",
        x_range=time_range, y_range=FactorRange(factors=rows), toolbar_location=None,
        tools="xbox_zoom,xpan", active_drag="xbox_zoom", min_border_left=96,
        x_axis_label="time (s)",
    )  # fmt: skip
    made.hbar(
        y="row", left="left", right="right", height=0.55, source=source, fill_color="#7d8894",
        line_color="#7d8894", name="event",
    )  # fmt: skip
    made.text(
        "left", "row", "text", source=source, text_font_size="11px", text_baseline="middle",
        x_offset=3, name="ink",
    )  # fmt: skip
    made.add_layout(Span(dimension="height", location=0.0, visible=False, name="cursor"))
    return made


def _map(number: int, tuning: Tuning) -> Any:
    """How likely the innovations are over both noises, and where the sliders stand."""
    made = figure(
        name=f"map-{number}", height=250, sizing_mode="stretch_width", x_axis_type="log",
        y_axis_type="log", x_range=Range1d(0.1, 1.0), y_range=Range1d(0.01, 1.0), tools="tap",
        toolbar_location=None, x_axis_label="SIGMA_A (m/s²)", y_axis_label="SIGMA_Z (m)",
    )  # fmt: skip
    mapper = LinearColorMapper(palette=MAP_COLOURS, low=0.0, high=MAP_SIGMAS)
    for name, tuned in tuning.items():
        if isinstance(tuned, AxisTuning):
            x, dw = _outer(tuned.map.sigma_a_m_s2)
            y, dh = _outer(tuned.map.sigma_z_m)
            # rows are SIGMA_Z
            image = np.sqrt(2.0 * np.maximum(tuned.map.drop.T, 0.0)).astype(np.float32)
            made.image(
                [image], [x], [y], [dw], [dh], color_mapper=mapper, name=f"map:{name}",
                visible=False,
            )  # fmt: skip
    trail = _source("trail", number, "x y")
    best = _source("best", number, "x y")
    point = _source("point", number, "x y")
    made.line("x", "y", source=trail, line_color=EKF2, line_width=1.2, name="ekf2")
    made.scatter("x", "y", source=trail, size=3, fill_color=EKF2, line_color=None, name="ekf2")
    made.scatter("x", "y", source=best, size=13, marker="cross", line_color="white", line_width=2.5)
    made.scatter(
        "x", "y", source=point, size=12, marker="circle", fill_color=EKF2, line_color="white",
        line_width=2.0,
    )  # fmt: skip
    return made


def _outer(values: Array) -> tuple[float, float]:
    """Where the pixels of a logarithmic axis begin, and how far they reach."""
    half = float(np.sqrt(values[1] / values[0]))
    return float(values[0]) / half, float(values[-1]) * half - float(values[0]) / half


def _plan(number: int) -> Any:
    """The track seen from above; what is chosen on it is the time that all plots show."""
    made = figure(
        name=f"plan-{number}", height=250, sizing_mode="stretch_width", match_aspect=True,
        tools="box_select,tap", active_drag="box_select", toolbar_location=None,
        x_axis_label="east (m)", y_axis_label="north (m)",
    )  # fmt: skip
    track = _source("plan", number, "t east north")
    shown = _source("shown", number, "east north")
    here = _source("here", number, "east north")
    made.line("east", "north", source=track, line_color=MEASUREMENT, line_width=1.0)
    made.scatter(
        "east", "north", source=track, size=3, fill_color=MEASUREMENT, line_color=None,
        nonselection_fill_alpha=0.6,
    )  # fmt: skip
    made.scatter(
        "east", "north", source=shown, size=4, fill_color=OURS, line_color=None, name="ours"
    )
    made.scatter(
        "east", "north", source=here, size=12, marker="circle_x", fill_color=None,
        line_color=EKF2, line_width=2.0, name="ekf2",
    )  # fmt: skip
    return made


def _step(number: int) -> Any:
    """One measurement: what was predicted, what was measured, and what both make."""
    made = figure(
        name=f"step-{number}", height=230, sizing_mode="stretch_width", x_range=Range1d(0.0, 1.0),
        y_range=Range1d(0.0, 1.0), tools="", toolbar_location=None,
        x_axis_label="position (m)", y_axis_label="density (1/m)",
    )  # fmt: skip
    for name, style in (
        ("before", OURS_LINE | {"line_dash": [6, 3]}),
        ("posterior", OURS_LINE | {"line_width": 2.6}),
        ("measurement", {"line_color": MEASUREMENT, "line_width": 2.0, "line_dash": [2, 2]}),
    ):
        source = _source(name, number, "x y")
        made.line("x", "y", source=source, **style)
    return made
