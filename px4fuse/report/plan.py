"""The flight from above, to scale, at the foot of the cover, with the facts of the comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import Comparison
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Ekf2, Truth
from px4fuse.report.document import Document
from px4fuse.report.marks import LANDING, TAKE_OFF
from px4fuse.report.style import (
    BOTTOM,
    EKF2_LINE,
    LEFT,
    MEASURED,
    MUTED,
    OURS_LINE,
    PANEL_LEFT,
    POINTS_PER_HEIGHT,
    POINTS_PER_WIDTH,
    RIGHT,
    TRUTH_LINE,
    Cursor,
)

# A track so many times longer than wide lies along the page, else north is up
LONG = 2.2
TALLEST, LOWEST, BESIDE = 150.0, 62.0, 190.0  # points
# Width of a map that has north up, fraction of the page
WIDE = 0.40
LABELS = 34.0  # points below the axes: ticks, label, a gap
FACT_SIZE = 7.0
FACT_WIDTH = 0.085
Pair = tuple[Array, Array]


@dataclass(frozen=True)
class _View:
    """How the map lies on the page: the heading (rad) of its x axis, and the names of both."""

    heading: float
    labels: tuple[str, str]

    def __call__(self, north: Array, east: Array) -> Pair:
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


def draw(figure: Figure, document: Document, facts: Sequence[tuple[str, str]]) -> float:
    """Draw the map and write the facts below or beside it, from the foot of the page upwards.

    Returns
    -------
    float
        Height on the page (fraction) that is free above them.
    """
    comparison = document.comparison
    tracks = _tracks(comparison)
    points = np.column_stack(tracks["measurement"])
    view, ratio = _view(comparison, points)
    x, y = view(points[:, 0], points[:, 1])
    if ratio >= LONG:
        width = RIGHT - PANEL_LEFT
        scale = width * POINTS_PER_WIDTH / (1.1 * float(np.ptp(x)) + 1e-6)
        height = float(np.clip(1.3 * float(np.ptp(y)) * scale, LOWEST, TALLEST))
        below = Cursor(figure, BOTTOM)
        foot = sum(below.height(text, size=FACT_SIZE, x=LEFT + FACT_WIDTH) for _, text in facts)
        box = (PANEL_LEFT, BOTTOM + foot + LABELS / POINTS_PER_HEIGHT, width)
        below.y = BOTTOM + foot
        _facts(below, facts, LEFT)
    else:
        height = BESIDE
        box = (PANEL_LEFT, BOTTOM + LABELS / POINTS_PER_HEIGHT, WIDE)
        beside = Cursor(figure, box[1] + height / POINTS_PER_HEIGHT)
        _facts(beside, facts, PANEL_LEFT + WIDE + 0.03)
    axes = figure.add_axes((*box, height / POINTS_PER_HEIGHT))
    _map(axes, document, view, tracks)
    top = box[1] + height / POINTS_PER_HEIGHT
    title = Cursor(figure, top + 24.0 / POINTS_PER_HEIGHT)
    title.write("From above", size=10.5, weight="bold")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper right", ncols=len(labels), borderaxespad=0.0, borderpad=0.0,
        bbox_to_anchor=(RIGHT, top + 21.0 / POINTS_PER_HEIGHT), handlelength=1.8,
        columnspacing=1.2, markerscale=1.5,
    )  # fmt: skip
    return top + 40.0 / POINTS_PER_HEIGHT


def _tracks(comparison: Comparison) -> dict[str, Pair]:
    """North and east of each track in the segment, m."""
    segment, flight = comparison.segment, comparison.flight

    def cut(frame: pd.DataFrame) -> Pair:
        inside = frame[(frame.index >= segment.start_s) & (frame.index <= segment.end_s)]
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

    tracks = {"measurement": cut(comparison.source.samples)}
    if isinstance(flight.truth, Truth):
        tracks["truth"] = cut(flight.truth.samples)
    both = {result.axis.name: result for result in comparison.axes}
    if {"north", "east"} <= both.keys():
        north, east = both["north"], both["east"]
        if isinstance(north.ekf2_state, pd.DataFrame) and isinstance(east.ekf2_state, pd.DataFrame):
            tracks["EKF2"] = (
                north.ekf2_state["position_m"].to_numpy(),
                east.ekf2_state["position_m"].to_numpy(),
            )
        tracks["ours"] = (
            north.replay.steps["position_m"].to_numpy(),
            east.replay.steps["position_m"].to_numpy(),
        )
    elif isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    return tracks


def _view(comparison: Comparison, points: Array) -> tuple[_View, float]:
    """Along the track where it is long and narrow, else with north up; how long against wide."""
    aisle = next((a.axis for a in comparison.axes if a.axis.name == AISLE), None)
    centred = points - points.mean(axis=0)
    if aisle is not None and aisle.heading_deg is not None:
        heading = np.deg2rad(aisle.heading_deg)
    else:
        direction = np.linalg.svd(centred, full_matrices=False)[2][0]
        heading = float(np.arctan2(direction[1], direction[0]))
    if np.sin(heading) < 0.0:  # north is up rather than down
        heading += np.pi
    degrees = np.rad2deg(heading) % 360.0
    along = _View(heading, (f"along {degrees:.0f}° from north (m)", "to its left (m)"))
    x, y = along(points[:, 0], points[:, 1])
    ratio = float(np.ptp(x)) / max(float(np.ptp(y)), 1e-6)
    if ratio >= LONG:
        return along, ratio
    return _View(np.pi / 2.0, ("east (m)", "north (m)")), ratio


def _map(axes: Axes, document: Document, view: _View, tracks: dict[str, Pair]) -> None:
    axes.plot(*view(*tracks["measurement"]), **MEASURED, label="measurement")
    for name, style in (("EKF2", EKF2_LINE), ("ours", OURS_LINE), ("truth", TRUTH_LINE)):
        if name in tracks:
            axes.plot(*_thinned(view(*tracks[name])), **style, label=name)
    samples = document.comparison.source.samples
    for times, style, label in (
        (document.events.take_off_s, TAKE_OFF, "take-off"),
        (document.events.landing_s, LANDING, "landing"),
    ):
        if times:
            near = np.clip(np.searchsorted(samples.index.to_numpy(), times), 0, len(samples) - 1)
            x, y = view(samples["north_m"].to_numpy()[near], samples["east_m"].to_numpy()[near])
            axes.plot(x, y, **{**style, "ms": 7.0, "mec": "white", "mew": 0.6}, label=label)
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.xaxis.set_major_locator(MaxNLocator(8))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(visible=True, axis="both")
    axes.set_xlabel(view.labels[0])
    axes.set_ylabel(view.labels[1])
    if view.heading != np.pi / 2.0:
        _north(axes, view)


def _thinned(track: Pair, most: int = 2000) -> Pair:
    """Every so many points of a path."""
    every = max(1, len(track[0]) // most)
    return track[0][::every], track[1][::every]


def _north(axes: Axes, view: _View) -> None:
    """An arrow to the north in the corner."""
    x, y = view(np.array([1.0]), np.array([0.0]))
    axes.annotate(
        "N", xy=(0.985, 0.80), xycoords="axes fraction",
        xytext=(-22.0 * float(x[0]), -22.0 * float(y[0])), textcoords="offset points",
        arrowprops={"arrowstyle": "<-", "color": MUTED, "lw": 0.8}, size=7, color=MUTED,
        ha="center", va="center",
    )  # fmt: skip


def _facts(cursor: Cursor, facts: Sequence[tuple[str, str]], left: float) -> None:
    for label, text in facts:
        top = cursor.y
        cursor.write(label, size=FACT_SIZE, weight="bold", x=left)
        cursor.y = top
        cursor.write(text, size=FACT_SIZE, x=left + FACT_WIDTH)
