"""Events in plots over time: gaps, resets, rejections and outliers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.core.arrays import Array
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.report.page import Page
from px4fuse.report.style import (
    REJECTED_STYLE,
    TIME_LABEL,
    Artist,
    Axes,
    dot_style,
    draw_curve,
)

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
    events = analysis.events
    event_markers = (
        EventMarkers("on the ground", events.ground_spans_s, ON_GROUND_BAND_STYLE),
        EventMarkers("position gap", events.gaps, GAP_BAND_STYLE),
        EventMarkers("log dropout", events.dropouts, DROPOUT_BAND_STYLE),
        EventMarkers("EKF2 rejected", rejection_times_s, REJECTED_STYLE, 0.025),
        EventMarkers("outlier", find_outlier_times(analysis), OUTLIER_MARKER_STYLE, 0.075),
        EventMarkers("EKF2 reset", events.reset_times_s, RESET_MARKER_STYLE, 0.92),
        EventMarkers("take-off", events.take_off_times_s, TAKE_OFF_MARKER_STYLE, 0.0),
        EventMarkers("landing", events.landing_times_s, LANDING_MARKER_STYLE, 0.0),
    )
    return [markers for markers in event_markers if len(markers.event_times_or_spans_s)]


def add_panel(
    page: Page,
    analysis: Analysis,
    title: str,
    height: float,
    *,
    axis: str | None = None,
    with_time_label: bool = True,
    **options: Any,
) -> Axes:
    """Add a plot over time with gaps, resets, rejections and outliers."""
    from matplotlib.collections import PolyCollection  # noqa: PLC0415

    axes = page.add_panel(title, height, **options)
    segment, x_transform = analysis.segment.whole_flight, axes.get_xaxis_transform()
    axes.set_xlim(segment.start_s, segment.end_s)
    if with_time_label:
        axes.set_xlabel(TIME_LABEL)
    axis_name = analysis.main.axis.name if axis is None else axis
    rejection_times_s = analysis.events.rejection_times_s.get(axis_name, ())
    for order, (_, times_or_spans_s, style, marker_height) in enumerate(
        _make_event_markers(analysis, rejection_times_s), start=1
    ):
        if marker_height is None:
            corners = [
                [(start_s, 0.0), (start_s, 1.0), (end_s, 1.0), (end_s, 0.0)]
                for start_s, end_s in times_or_spans_s
            ]
            bands = PolyCollection(corners, transform=x_transform, zorder=0.1 * order, **style)
            axes.add_collection(bands, autolim=False)
        else:
            heights = pd.Series(marker_height, np.asarray(times_or_spans_s, np.float64))
            marker_style = style | {"zorder": 2.6, "clip_on": marker_height > 0.0}
            draw_curve(axes, heights, transform=x_transform, **marker_style)
    return axes


def find_outlier_times(analysis: Analysis) -> Array:
    """Return the times (s) of outliers of the position source."""
    tunings = map(analysis.tuning.get, (HORIZONTAL, analysis.main.axis.name))
    times_s = [tuning.outlier_time_s for tuning in tunings if isinstance(tuning, AxisTuning)]
    return np.asarray(np.unique(np.concatenate([[], *times_s])))


def make_legend_entries(analysis: Analysis) -> list[Artist]:
    """Return a legend entry for each type of event in the flight."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    rejection_times_s = [
        time for times in analysis.events.rejection_times_s.values() for time in times
    ]
    return [
        Patch(**style, label=label) if height is None else Line2D([], [], **style, label=label)
        for label, _, style, height in _make_event_markers(analysis, rejection_times_s)
    ]
