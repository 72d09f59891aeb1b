"""Colours, lines and matplotlib's settings for the panels of reports and pictures.

Our filter is dark, solid and round; EKF2 is lighter, dashed and square; so that the two stay apart
in grey. Text from outside (names, notes) is drawn as it is: no mathematics, no markup.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from px4fuse.arrays import Array

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import Colormap
else:  # matplotlib costs a third of a second: not where words alone are shown
    Artist = Axes = Colormap = Any
__all__ = ["Artist", "Axes", "Colormap"]  # of matplotlib, for annotations

FONT = "DejaVu Sans"
SHEET = Path(__file__).with_name("report.mplstyle")
TIME_LABEL = "time since first data (s)"

OURS = "#123f7a"
OURS_BAND = "#b9cbe4"
EKF2 = "#e0741a"
EKF2_BAND = "#f6c99f"
TRUTH = "#111111"
MEASUREMENT = "#9a9a9a"
MUTED = "#555555"
GOOD = "#1f6b3a"
SEVERITY_COLOURS = {"error": "#a61b1b", "warning": "#8a5a00", "info": "#33556b"}

OURS_LINE: dict[str, Any] = {"color": OURS, "lw": 1.0, "ls": "-"}
EKF2_LINE: dict[str, Any] = {"color": EKF2, "lw": 1.1, "ls": (0, (4, 1.6))}
TRUTH_LINE: dict[str, Any] = {"color": TRUTH, "lw": 0.7, "ls": (0, (1, 1.5))}
OURS_DOTS: dict[str, Any] = {"color": OURS, "marker": "o", "ms": 2.0, "mew": 0, "ls": "none"}
EKF2_DOTS: dict[str, Any] = {"color": EKF2, "marker": "s", "ms": 2.2, "mew": 0, "ls": "none"}
# What EKF2 did not fuse is hollow everywhere
EKF2_REJECTED: dict[str, Any] = {
    "color": EKF2,
    "marker": "s",
    "ms": 2.8,
    "mew": 0.6,
    "mfc": "white",
    "ls": "none",
}
MEASURED: dict[str, Any] = {"color": MEASUREMENT, "marker": ".", "ms": 1.8, "mew": 0, "ls": "none"}
# By the names that a reader sees
LINES = {"ours": OURS_LINE, "EKF2": EKF2_LINE, "truth": TRUTH_LINE}
DOTS = {"ours": OURS_DOTS, "EKF2": EKF2_DOTS}

# What the eye can see across a page, and across a third of it: longer series are thinned to their
# extremes per bucket.
MAX_POINTS, MAX_POINTS_NARROW, WIDE_INCHES = 1500, 500, 3.0


@contextmanager
def report_style() -> Iterator[None]:
    """Matplotlib settings of the panels, for the duration of a block."""
    import matplotlib as mpl  # noqa: PLC0415 - not where words alone are shown

    with mpl.rc_context({"font.family": [FONT]}, SHEET):
        yield


def curve(axes: Axes, values: pd.Series[float], **style: Any) -> None:
    """Draw a series over its index, with as many points as the eye can see in these axes."""
    axes.plot(*thin(values.index.to_numpy(), np.asarray(values, np.float64), _seen(axes)), **style)


def band(axes: Axes, middle: pd.Series[float], sigma: pd.Series[float]) -> None:
    """Draw our ±2σ about a series."""
    time = middle.index.to_numpy()
    shown, upper = thin(time, np.asarray(middle + 2.0 * sigma, np.float64), _seen(axes))
    lower = np.interp(shown, time, (middle - 2.0 * sigma).to_numpy())
    axes.fill_between(shown, lower, upper, color=OURS_BAND, lw=0)


def _seen(axes: Axes) -> int:
    return MAX_POINTS if axes.bbox.width / axes.figure.dpi > WIDE_INCHES else MAX_POINTS_NARROW


def log_ticks(axes: Axes) -> None:
    """Log scale of y with some room, and with plain numbers."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.15, high * 1.25)
    plain_ticks(axes.yaxis)


def plain_ticks(axis: Axis) -> None:
    """Plain numbers on a log axis, at 1, 2 and 5 in each decade; of many decades at 1."""
    from matplotlib.ticker import LogLocator, NullLocator  # noqa: PLC0415

    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high / low < 30.0 else (1.0, 3.0) if high / low < 300.0 else (1.0,)
    axis.set_major_locator(LogLocator(base=10.0, subs=subs))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())


def time_axis(axes: Axes, last: bool) -> None:
    """Name an axis of time, or leave out its numbers where another below it shows them."""
    if last:
        axes.set_xlabel(TIME_LABEL)
    else:
        axes.tick_params(axis="x", labelbottom=False)


def as_map(axes: Axes, right: str, up: str) -> None:
    """Make both directions of the same scale, with a grid and their names (m)."""
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.grid(True, axis="both")
    axes.set(xlabel=f"{right} (m)", ylabel=f"{up} (m)")


def thin(time: Array, value: Array, limit: int = MAX_POINTS) -> tuple[Array, Array]:
    """Thin a series to at most ``limit`` points, keeping the extremes of every bucket."""
    if len(time) <= limit:
        return time, value
    size, larger = divmod(len(time), limit // 2)
    cut, keep = larger * (size + 1), []
    for first, last, width in ((0, cut, size + 1), (cut, len(time), size)):
        buckets, starts = value[first:last].reshape(-1, width), np.arange(first, last, width)
        keep += [starts + buckets.argmin(axis=1), starts + buckets.argmax(axis=1)]
    kept = np.unique(np.concatenate(keep))
    return time[kept], value[kept]
