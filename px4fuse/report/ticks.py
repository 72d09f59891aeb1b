"""Fast drawing of ticks, grid and labels of plots.

The axis classes of matplotlib draw seven artists for each tick, which is slow.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any

import numpy as np

from px4fuse.report.style import Axes

TICKS_ZORDER = 0.5  # below the curves
LINE_HEIGHT = 8.0  # points, for a tick label of 8 points


def replace_ticks(axes: Axes, measure_text_width: Callable[[str], float]) -> None:
    """Draw ticks, grid and labels of axes, and hide those of matplotlib.

    The data and limits of the axes must not change afterwards.
    """
    axes.apply_aspect()  # sets the final limits of maps
    for is_x, axis in ((True, axes.xaxis), (False, axes.yaxis)):
        if axes.axison and axis.get_visible():
            _draw_axis_as_artists(axes, measure_text_width, is_x=is_x)


def _draw_axis_as_artists(
    axes: Axes, measure_text_width: Callable[[str], float], *, is_x: bool
) -> None:
    from matplotlib import rcParams  # noqa: PLC0415 - slow import
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.markers import TICKDOWN, TICKLEFT  # noqa: PLC0415

    axis = axes.xaxis if is_x else axes.yaxis
    transform: Any = axes.get_xaxis_transform if is_x else axes.get_yaxis_transform
    options, (low, high) = axis.get_tick_params(), sorted(axis.get_view_interval())
    size, label_gap = rcParams["xtick.major.size"], rcParams["xtick.major.pad"]

    def order_xy(coordinate_along_axis: Any, coordinate_across_axis: Any) -> tuple[Any, Any]:
        """Return (x, y) from the coordinates along and across the axis."""
        return (
            (coordinate_along_axis, coordinate_across_axis)
            if is_x
            else (coordinate_across_axis, coordinate_along_axis)
        )

    all_locations, formatter = np.asarray(axis.get_majorticklocs()), axis.get_major_formatter()
    is_visible = np.abs(all_locations - (low + high) / 2.0) <= (0.5 + 1e-9) * (high - low)
    locations = all_locations[is_visible]
    labels = [*compress(formatter.format_ticks(all_locations.tolist()), is_visible)]
    if options["gridOn"]:
        ends = np.tile([0.0, 1.0, np.nan], len(locations))  # nan separates the lines
        grid = Line2D(*order_xy(np.repeat(locations, 3), ends), transform=transform("grid"))
        grid.set(color=rcParams["grid.color"], lw=rcParams["grid.linewidth"], zorder=TICKS_ZORDER)
        axes.add_artist(grid)
    ticks = Line2D(*order_xy(locations, 0.0 * locations), transform=transform("tick1"), ls="none")
    ticks.set(marker=TICKDOWN if is_x else TICKLEFT, ms=size, color="black")
    ticks.set(mew=rcParams["xtick.major.width"], clip_on=False, zorder=TICKS_ZORDER)
    axes.add_artist(ticks)
    tick_extent = size + label_gap  # points
    if options["labelbottom" if is_x else "labelleft"] and labels:
        get_label_transform = (
            axes.get_xaxis_text1_transform if is_x else axes.get_yaxis_text1_transform
        )
        label_transform, vertical_alignment, horizontal_alignment = get_label_transform(tick_extent)
        for location, label in zip(locations, labels, strict=True):
            text = axes.text(*order_xy(location, 0.0), label, transform=label_transform)
            text.set(va=vertical_alignment, ha=horizontal_alignment, zorder=TICKS_ZORDER)
        tick_extent += LINE_HEIGHT if is_x else max(map(measure_text_width, labels))
    # axis label in the middle, and common factor of the tick labels (such as 1e-3) at the end
    for label, position in ((axis.get_label_text(), 0.5), (formatter.get_offset(), 1.0)):
        if not label:
            continue
        is_axis_label = position == 0.5
        text = axes.annotate(
            label,
            order_xy(position, 0.0),
            order_xy(0.0, -tick_extent - rcParams["axes.labelpad"]),
            xycoords="axes fraction",
            textcoords="offset points",
        )
        text.set(
            ha="center" if is_x and is_axis_label else "right",
            va="top" if is_x else "center" if is_axis_label else "bottom",
            rotation=90.0 if is_axis_label and not is_x else 0.0,
        )
    axis.set_visible(False)
