"""Events in plots over time: gaps, resets, rejections and outliers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

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
# Minimum interval between two markers, as fraction of the plotted time
MIN_MARKER_INTERVAL_FRACTION = 1.0 / 300.0


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
) -> tuple[EventMarkers, ...]:
    events = analysis.events
    return (
        EventMarkers("on the ground", events.ground_spans_s, ON_GROUND_BAND_STYLE),
        EventMarkers("gap in position source", events.gaps, GAP_BAND_STYLE),
        EventMarkers("log dropout", events.dropouts, DROPOUT_BAND_STYLE),
        EventMarkers("EKF2 rejected", rejection_times_s, REJECTED_STYLE, 0.025),
        EventMarkers("outlier", find_outlier_times(analysis), OUTLIER_MARKER_STYLE, 0.075),
        EventMarkers("EKF2 reset", events.reset_times_s, RESET_MARKER_STYLE, 0.92),
        EventMarkers("take-off", events.take_off_times_s, TAKE_OFF_MARKER_STYLE, 0.0),
        EventMarkers("landing", events.landing_times_s, LANDING_MARKER_STYLE, 0.0),
    )


def draw_event_markers(axes: Axes, analysis: Analysis, *, axis: str | None = None) -> None:
    """Draw gaps, resets, rejections and outliers on a time axis."""
    from matplotlib.collections import PolyCollection  # noqa: PLC0415
    from matplotlib.lines import Line2D  # noqa: PLC0415

    segment, x_transform = analysis.segment.whole_flight, axes.get_xaxis_transform()
    axes.set_xlim(segment.start_s, segment.end_s)
    axis_name = analysis.main.axis.name if axis is None else axis
    event_markers = _make_event_markers(
        analysis, analysis.events.rejection_times_s.get(axis_name, ())
    )
    for order, (_, event_times_or_spans_s, style, height) in enumerate(event_markers, start=1):
        if not len(event_times_or_spans_s):
            continue
        if height is None:
            corners = [
                [(start_s, 0.0), (start_s, 1.0), (end_s, 1.0), (end_s, 0.0)]
                for start_s, end_s in event_times_or_spans_s
            ]
            bands = PolyCollection(corners, transform=x_transform, zorder=0.1 * order, **style)
            axes.add_collection(bands, autolim=False)
        else:
            min_interval_s = MIN_MARKER_INTERVAL_FRACTION * (segment.end_s - segment.start_s)
            times_s = select_marker_times(event_times_or_spans_s, min_interval_s)
            markers = Line2D(
                times_s,
                np.full(len(times_s), height),
                **style,
                transform=x_transform,
                zorder=2.6,
                clip_on=height > 0.0,
            )
            axes.add_artist(markers)  # keeps the axis limits, unlike add_line


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
    axes = page.add_panel(title, height, **options)
    draw_event_markers(axes, analysis, axis=axis)
    if with_time_label:
        axes.set_xlabel(TIME_LABEL)
    return axes


def find_outlier_times(analysis: Analysis) -> Array:
    """Return the times (s) of outliers of the position source."""
    tunings = map(analysis.tuning.get, (HORIZONTAL, analysis.main.axis.name))
    times_s = [tuning.outlier_time_s for tuning in tunings if isinstance(tuning, AxisTuning)]
    outlier_times_s: Array = np.unique(np.concatenate([[], *times_s]))
    return outlier_times_s


def make_legend_entries(analysis: Analysis) -> list[Artist]:
    """Return a legend entry for each type of event in the flight."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    rejection_times_s = [
        time for times in analysis.events.rejection_times_s.values() for time in times
    ]
    return [
        Patch(**style, label=label) if height is None else Line2D([], [], **style, label=label)
        for label, event_times_or_spans_s, style, height in _make_event_markers(
            analysis, rejection_times_s
        )
        if len(event_times_or_spans_s)
    ]


def select_marker_times(times: Any, min_interval_s: float) -> Array:
    """Keep one time (s) per interval, so that markers do not overlap."""
    times_s = np.asarray(times, dtype=np.float64)
    kept_times_s: Array = times_s[
        np.unique(np.floor(times_s / min_interval_s), return_index=True)[1]
    ]
    return kept_times_s
