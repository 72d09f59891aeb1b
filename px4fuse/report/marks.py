"""What happened, drawn the same way on every time axis: gaps, modes, resets, rejections."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from px4fuse.arrays import Array
from px4fuse.comparison.events import Span
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.report.document import Document
from px4fuse.report.style import EKF2_REJECTED, MUTED

# Bands differ in grey by hatch and depth; marks stand on lines at the foot of the axes, resets
# hang from their top
GROUND: dict[str, Any] = {"facecolor": "#e4e4e4", "edgecolor": "none", "lw": 0.0}
GAP: dict[str, Any] = {"facecolor": "#fbfbfb", "edgecolor": "#9a9a9a", "lw": 0.0, "hatch": "/////"}
DROPOUT: dict[str, Any] = {"facecolor": "#a8a8a8", "edgecolor": "none", "lw": 0.0}
MODE: dict[str, Any] = {"facecolor": "#f6f0e2", "edgecolor": "none", "lw": 0.0}
RESET: dict[str, Any] = {"color": "#8a4508", "marker": 2, "ms": 6.0, "mew": 1.2, "ls": "none"}
OUTLIER: dict[str, Any] = {"color": "black", "marker": "x", "ms": 3.0, "mew": 0.7, "ls": "none"}
TAKE_OFF: dict[str, Any] = {"color": "black", "marker": "^", "ms": 4.5, "mew": 0, "ls": "none"}
LANDING: dict[str, Any] = {"color": "black", "marker": "v", "ms": 4.5, "mew": 0, "ls": "none"}
REJECTED_LINE, OUTLIER_LINE, RESET_LINE = 0.025, 0.075, 0.92
# Marks closer than this share of the segment fall on one another
CLOSEST = 1.0 / 300.0
STRIP_SIZE, STRIP_WIDTH = 6.5, 4.0  # of the letters, and of one of them, in points


def draw(axes: Axes, document: Document, *, axis: str | None = None, strip: bool = False) -> None:
    """Mark what happened on a time axis, behind what is drawn there; it spans the segment.

    Parameters
    ----------
    axes : Axes
        x is seconds since the first data.
    document : Document
    axis : str, optional
        Whose rejections to mark at the foot; by default the main axis. Empty for none, where the
        axes show the rejected innovations themselves.
    strip : bool
        Name the flight modes above the axes.
    """
    events, segment = document.events, document.comparison.segment
    axes.set_xlim(segment.start_s, segment.end_s)
    modes = [(mode.start_s, mode.end_s) for mode in events.modes]
    for spans, style, order in (
        (modes[1::2], MODE, 0.1),
        (events.ground, GROUND, 0.2),
        (events.gaps, GAP, 0.3),
        (events.dropouts, DROPOUT, 0.4),
    ):
        _bands(axes, spans, {**style, "zorder": order})
    name = document.comparison.main.axis.name if axis is None else axis
    span = segment.end_s - segment.start_s
    for times, height, style in (
        (events.rejected_s.get(name, ()), REJECTED_LINE, EKF2_REJECTED),
        (outliers(document), OUTLIER_LINE, OUTLIER),
        (events.resets_s, RESET_LINE, RESET),
        (events.take_off_s, 0.0, TAKE_OFF),
        (events.landing_s, 0.0, LANDING),
    ):
        shown = _apart(times, CLOSEST * span)
        if len(shown):
            axes.add_artist(  # which leaves the limits alone
                Line2D(
                    shown, np.full(len(shown), height), transform=axes.get_xaxis_transform(),
                    zorder=2.6, clip_on=height > 0.0, **style,
                )
            )  # fmt: skip
    if strip:
        _strip(axes, document)


def outliers(document: Document) -> Array:
    """Times of the measurements that tuning takes for outliers, of all its axes together."""
    names = HORIZONTAL, document.comparison.main.axis.name
    found = [
        tuned.outlier_time_s
        for name, tuned in document.analysis.tuning.items()
        if isinstance(tuned, AxisTuning) and name in names
    ]
    times: Array = np.unique(np.concatenate(found)) if found else np.empty(0)
    return times


def handles(document: Document) -> list[Artist]:
    """Legend entries of the kinds of marks that this flight has."""
    events = document.events
    entries: list[tuple[object, Artist]] = [
        (events.gaps, Patch(**GAP, label="source silent")),
        (events.ground, Patch(**GROUND, label="on the ground")),
        (events.dropouts, Patch(**DROPOUT, label="log dropout")),
        (events.modes[1:], Patch(**MODE, label="flight modes, in turn")),
        (events.resets_s, Line2D([], [], **RESET, label="EKF2 reset")),
        (
            any(len(times) for times in events.rejected_s.values()),
            Line2D([], [], **EKF2_REJECTED, label="EKF2 rejected"),
        ),
        (outliers(document).size, Line2D([], [], **OUTLIER, label="outlier")),
        (events.take_off_s, Line2D([], [], **TAKE_OFF, label="take-off")),
        (events.landing_s, Line2D([], [], **LANDING, label="landing")),
    ]
    return [artist for there, artist in entries if there]


def _bands(axes: Axes, spans: Iterable[Span], style: dict[str, Any]) -> None:
    corners = [[(s, 0.0), (s, 1.0), (e, 1.0), (e, 0.0)] for s, e in spans]
    if corners:
        bands = PolyCollection(corners, transform=axes.get_xaxis_transform(), **style)
        axes.add_collection(bands, autolim=False)


def _apart(times: Sequence[float] | Array, least_s: float) -> Array:
    """Times without those that would be drawn on one another."""
    values = np.asarray(times, dtype=np.float64)
    if not len(values):
        return values
    kept: Array = values[np.unique(np.floor(values / least_s), return_index=True)[1]]
    return kept


def _strip(axes: Axes, document: Document) -> None:
    """Names of the flight modes above the axes, as far as each has room for its name."""
    low, high = axes.get_xlim()
    width = 72.0 * axes.bbox.width / axes.figure.dpi
    for mode in document.events.modes:
        start, end = max(mode.start_s, low), min(mode.end_s, high)
        if (end - start) / (high - low) * width >= STRIP_WIDTH * len(mode.name):
            axes.text(
                (start + end) / 2.0, 1.012, mode.name, transform=axes.get_xaxis_transform(),
                ha="center", va="bottom", size=STRIP_SIZE, color=MUTED,
            )  # fmt: skip
