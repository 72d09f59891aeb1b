"""Colours and styles of all plots, which remain distinct in greyscale."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.arrays import Array

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
else:  # matplotlib is slow to import
    Artist = Axes = Any
__all__ = ["Artist", "Axes"]  # types for annotations

# Font that is part of matplotlib
FONT = "DejaVu Sans"
STYLE_SHEET = Path(__file__).with_name("report.mplstyle")
TIME_LABEL = "time since first sample (s)"

KF_COLOUR = "#12407f"
KF_BAND_COLOUR = "#d0d9e6"
EKF2_COLOUR = "#b85400"
TRUTH_COLOUR = "#111111"
MEASUREMENT_COLOUR = "#9a9a9a"
TEXT_COLOUR = "#000000"
MUTED_COLOUR = "#444444"
GOOD_COLOUR = "#1d5e34"
SEVERITY_COLOURS = {
    "error": "#9b1c1c",
    "warning": "#8a5200",
    "note": "#1f4e79",
    "clean": GOOD_COLOUR,
}
CONSISTENT_BAND_COLOUR = "#d5dfd8"


def line_style(colour: str, width: float, line_pattern: object = "-") -> dict[str, Any]:
    return {"color": colour, "lw": width, "ls": line_pattern}


def dot_style(
    colour: str, marker: str | int, size: float, edge_width: float = 0.0
) -> dict[str, Any]:
    """Return the matplotlib options of markers; sizes are in points."""
    return {"color": colour, "marker": marker, "ms": size, "mew": edge_width, "ls": "none"}


# Styles of each filter
TRACK_STYLES = {
    "KF": line_style(KF_COLOUR, 1.0),
    "EKF2": line_style(EKF2_COLOUR, 1.1, (0, (4, 1.6))),
    "ground truth": line_style(TRUTH_COLOUR, 0.7, (0, (1, 1.5))),
}
INNOVATION_STYLES = {
    "KF": dot_style(KF_COLOUR, "o", 2.0),
    "EKF2": dot_style(EKF2_COLOUR, "s", 2.2),
}
INNOVATION_SYMBOLS = {"KF": "●", "EKF2": "■"}  # in texts
SIGMA_BAND_COLOURS = {"KF": KF_BAND_COLOUR, "EKF2": "#f0dccd"}
FILTER_COLOURS = {name: TRACK_STYLES[label]["color"] for name, label in FILTER_NAMES.items()}
# Rejected innovations of EKF2 are hollow
REJECTED_INNOVATION_STYLE = dot_style(EKF2_COLOUR, "s", 2.8, 0.6) | {"mfc": "white"}
MEASUREMENT_STYLE = dot_style(MEASUREMENT_COLOUR, ".", 1.8)

MAX_DRAWN_POINTS = 1000  # maximum per curve


@contextmanager
def apply_report_style() -> Iterator[None]:
    """Apply the matplotlib settings of the report within a ``with`` block."""
    import matplotlib as mpl  # noqa: PLC0415 - slow import

    with mpl.rc_context({"font.family": [FONT]}, STYLE_SHEET):
        yield


def draw_curve(axes: Axes, values: pd.Series[float], **style: Any) -> None:
    """Draw a time series with a limited number of points."""
    axes.plot(*decimate_series(values.index.to_numpy(), np.asarray(values, np.float64)), **style)


def draw_sigma_band(
    axes: Axes,
    centre: pd.Series[float],
    sigma: pd.Series[float],
    colour: str = KF_BAND_COLOUR,
) -> None:
    """Draw the ±2σ band of a time series."""
    time_s = centre.index.to_numpy()
    upper_limit = np.asarray(centre + 2.0 * sigma, np.float64)
    drawn_time_s, drawn_upper_limit = decimate_series(time_s, upper_limit)
    lower_limit = np.interp(drawn_time_s, time_s, (centre - 2.0 * sigma).to_numpy())
    axes.fill_between(drawn_time_s, lower_limit, drawn_upper_limit, color=colour, lw=0)


def set_log_scale(axes: Axes) -> None:
    """Set a logarithmic y axis with plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator  # noqa: PLC0415

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    tick_multiples = (1.0, 2.0, 5.0) if high / low < 100.0 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=tick_multiples))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def draw_zero_line(axes: Axes) -> None:
    axes.axhline(0.0, color="black", lw=0.5)


def set_map_axes(axes: Axes, x_name: str, y_name: str) -> None:
    """Set equal scales and axis labels (m) for a map."""
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.set(xlabel=f"{x_name} (m)", ylabel=f"{y_name} (m)")


def decimate_series(times: Array, values: Array) -> tuple[Array, Array]:
    """Limit the points of a series; the minimum and maximum of each interval remain."""
    if len(times) <= MAX_DRAWN_POINTS:
        return times, values
    bounds = np.linspace(0, len(times), MAX_DRAWN_POINTS // 2 + 1).astype(int)
    starts, max_rows_per_interval = bounds[:-1], int(np.diff(bounds).max())
    # rows of each interval; shorter intervals repeat their last row
    rows = np.minimum(starts[:, None] + np.arange(max_rows_per_interval), bounds[1:, None] - 1)
    extremes = [starts + find(values[rows], axis=1) for find in (np.argmin, np.argmax)]
    selected_rows = np.unique(extremes)
    return times[selected_rows], values[selected_rows]
