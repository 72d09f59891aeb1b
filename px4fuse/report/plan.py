"""The flight from above, to scale, at the foot of the cover, with the facts of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from px4fuse.arrays import Array
from px4fuse.comparison.model import Comparison
from px4fuse.filter.signals import AISLE, within
from px4fuse.flight import Ekf2, Truth
from px4fuse.report.document import Document
from px4fuse.report.marks import LANDING, TAKE_OFF
from px4fuse.report.style import (
    BOTTOM,
    EKF2_LINE,
    LABEL_WIDTH,
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
TALLEST, LOWEST = 150.0, 62.0  # points
LEAST_BESIDE, MOST_BESIDE = 122.0, 290.0
# Width of a map that has north up, fraction of the page
WIDE = 0.43
HEAD, LABELS = 22.0, 34.0  # points above the axes, and below them: ticks, label, a gap
FACT_SIZE = 7.0
BESIDE_X = PANEL_LEFT + WIDE + 0.03
Pair = tuple[Array, Array]


@dataclass(frozen=True)
class View:
    """How the map lies on the page: the heading (rad) of its x axis, and the names of both."""

    heading: float
    labels: tuple[str, str]

    def __call__(self, north: Array, east: Array) -> Pair:
        """Where positions (m) lie on the page: to the right, and up."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


@dataclass(frozen=True)
class Plan:
    """A map with the facts below or beside it, ready to be drawn.

    Attributes
    ----------
    document : Document
    tracks : mapping from name to arrays
        North and east, m.
    view : View
    long : bool
        Whether the map takes the page's width, with the facts below it.
    facts : sequence of (str, str)
        Labels and sentences.
    """

    document: Document
    tracks: Mapping[str, Pair]
    view: View
    long: bool
    facts: Sequence[tuple[str, str]]

    def least(self, cursor: Cursor) -> float:
        """Height on the page (fraction) that it needs."""
        map_points = (self._height() if self.long else LEAST_BESIDE) + HEAD + LABELS
        facts = self._facts_height(cursor, LEFT if self.long else BESIDE_X)
        if self.long:
            return map_points / POINTS_PER_HEIGHT + facts
        return max(map_points / POINTS_PER_HEIGHT, HEAD / POINTS_PER_HEIGHT + facts)

    def draw(self, cursor: Cursor) -> None:
        """Draw it below the cursor."""
        figure = cursor.figure
        cursor.write("From above", size=10.5, weight="bold")
        top = cursor.y - 6.0 / POINTS_PER_HEIGHT
        room = (top - BOTTOM) * POINTS_PER_HEIGHT - LABELS
        height = self._height() if self.long else min(room, MOST_BESIDE)
        width = RIGHT - PANEL_LEFT if self.long else WIDE
        bottom = top - height / POINTS_PER_HEIGHT
        axes = figure.add_axes((PANEL_LEFT, bottom, width, height / POINTS_PER_HEIGHT))
        _map(axes, self.document, self.view, self.tracks)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="lower right", ncols=len(labels), borderaxespad=0.0,
            borderpad=0.0, bbox_to_anchor=(RIGHT, cursor.y), handlelength=1.8, columnspacing=1.2,
        )  # fmt: skip
        below = bottom - LABELS / POINTS_PER_HEIGHT
        beside = Cursor(figure, below if self.long else top)
        for label, text in self.facts:
            beside.labelled(label, text, size=FACT_SIZE, x=LEFT if self.long else BESIDE_X)

    def _height(self) -> float:
        """Of a map of the page's width, in points."""
        x, y = self.view(*self.tracks["measurement"])
        scale = (RIGHT - PANEL_LEFT) * POINTS_PER_WIDTH / (1.1 * float(np.ptp(x)) + 1e-6)
        return float(np.clip(1.3 * float(np.ptp(y)) * scale, LOWEST, TALLEST))

    def _facts_height(self, cursor: Cursor, left: float) -> float:
        return sum(
            cursor.height(text, size=FACT_SIZE, x=left + LABEL_WIDTH) for _, text in self.facts
        )


def plan(document: Document, facts: Sequence[tuple[str, str]]) -> Plan:
    """The map of a document's flight.

    Parameters
    ----------
    document : Document
    facts : sequence of (str, str)
    """
    tracks = _tracks(document.comparison)
    view, ratio = _view(document.comparison, np.column_stack(tracks["measurement"]))
    return Plan(document, tracks, view, ratio >= LONG, facts)


def _tracks(comparison: Comparison) -> dict[str, Pair]:
    """North and east of each track in the segment, m."""
    segment, flight = comparison.segment, comparison.flight

    def cut(frame: pd.DataFrame) -> Pair:
        inside = within(frame, segment)
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

    tracks = {"measurement": cut(comparison.source.samples)}
    if isinstance(flight.truth, Truth):
        tracks["truth"] = cut(flight.truth.samples)
    both = comparison.axes
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


def _view(comparison: Comparison, points: Array) -> tuple[View, float]:
    """Along the track where it is long and narrow, else with north up; how long against wide."""
    aisle = next((line for line in comparison.lines if line.name == AISLE), None)
    centred = points - points.mean(axis=0)
    if aisle is not None and aisle.heading_deg is not None:
        heading = np.deg2rad(aisle.heading_deg)
    else:
        direction = np.linalg.svd(centred, full_matrices=False)[2][0]
        heading = float(np.arctan2(direction[1], direction[0]))
    if np.sin(heading) < 0.0:  # north is up rather than down
        heading += np.pi
    degrees = np.rad2deg(heading) % 360.0
    along = View(heading, (f"along {degrees:.0f}° from north (m)", "to its left (m)"))
    x, y = along(points[:, 0], points[:, 1])
    ratio = float(np.ptp(x)) / max(float(np.ptp(y)), 1e-6)
    if ratio >= LONG:
        return along, ratio
    return View(np.pi / 2.0, ("east (m)", "north (m)")), ratio


def _map(axes: Axes, document: Document, view: View, tracks: Mapping[str, Pair]) -> None:
    axes.plot(*view(*tracks["measurement"]), **{**MEASURED, "ms": 3.0}, label="measurement")
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


def _north(axes: Axes, view: View) -> None:
    """An arrow to the north in the corner."""
    x, y = view(np.array([1.0]), np.array([0.0]))
    axes.annotate(
        "N", xy=(0.97, 0.6), xycoords="axes fraction",
        xytext=(20.0 * float(x[0]), 20.0 * float(y[0])), textcoords="offset points",
        arrowprops={"arrowstyle": "<-", "color": MUTED, "lw": 0.8, "shrinkA": 1, "shrinkB": 0},
        size=7, color=MUTED, ha="center", va="center",
    )  # fmt: skip
