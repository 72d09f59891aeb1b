"""The flight from above, to scale, at the foot of the cover, with the facts of the comparison."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.comparison.model import Comparison
from px4fuse.filter.signals import AISLE, within
from px4fuse.flight import Ekf2, Truth
from px4fuse.report.document import Document
from px4fuse.report.marks import LANDING, TAKE_OFF
from px4fuse.report.page import WIDTH, Page, legend_above
from px4fuse.report.style import LINES, MEASURED, MUTED, as_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A track so many times longer than wide lies along the page, else north is up
LONG = 2.2
TALLEST, LOWEST, BESIDE, WIDE = 120.0, 56.0, 150.0, 256.0  # points
MOST_POINTS = 2000
Pair = tuple[Array, Array]


class MapView(NamedTuple):
    """How the map lies on the page: the heading (rad) of its x axis, and the names of both."""

    heading: float
    labels: tuple[str, str]

    def of(self, north: Any, east: Any) -> Pair:
        """Where positions (m) lie on the page: to the right, and up."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


NORTH_UP = MapView(np.pi / 2.0, ("east", "north"))


def plan(document: Document, facts: Mapping[str, str]) -> Page:
    """The map of a document's flight, with labelled sentences below or beside it.

    A long track lies along the page and takes its width, with the facts below it.

    Parameters
    ----------
    document : Document
    facts : mapping from labels to sentences
    """
    tracks = _tracks(document.analysis)
    along = _along(document.analysis, np.column_stack(tracks["measurement"]))
    wide, high = (float(np.ptp(values)) for values in along.of(*tracks["measurement"]))
    is_long = wide >= LONG * max(high, 1e-6)
    page, view, height = Page(), NORTH_UP, BESIDE
    drawn, beside = Page(width=WIDE), Page(width=WIDTH - WIDE - 14.0)
    if is_long:
        drawn, beside, view = page, page, along
        height = float(np.clip(1.3 * high * WIDTH / (1.1 * wide), LOWEST, TALLEST))
    _map(drawn.panel("From above", "", height, above=16.0, left=36.0), document, view, tracks)
    for label, text in facts.items():
        beside.labelled(label, text, size=7.0, above=-0.5)
    if not is_long:
        page.beside(drawn, beside)
    return page


def _tracks(comparison: Comparison) -> dict[str, Pair]:
    """North and east of each track in the segment, m."""
    segment, flight = comparison.segment, comparison.flight

    def cut(frame: pd.DataFrame) -> Pair:
        inside = within(frame, segment)
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

    tracks = {"measurement": cut(comparison.source.samples)}
    if isinstance(flight.truth, Truth):
        tracks["truth"] = cut(flight.truth.samples)
    if {"north", "east"} <= comparison.axes.keys():
        both = [comparison.axes[name] for name in ("north", "east")]
        theirs, ours = [one.ekf2_state for one in both], [one.replay.steps for one in both]
        for name, frames in (("EKF2", theirs), ("ours", ours)):
            known = [f["position_m"].to_numpy() for f in frames if isinstance(f, pd.DataFrame)]
            if len(known) == len(both):
                tracks[name] = known[0], known[1]
    elif isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    return tracks


def _along(comparison: Comparison, points: Array) -> MapView:
    """Along the aisle, or else the longest direction of the track; north is up, not down."""
    aisle = next((line for line in comparison.lines if line.name == AISLE), None)
    if aisle is not None and aisle.heading_deg is not None:
        heading = np.deg2rad(aisle.heading_deg)
    else:
        direction = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
        heading = float(np.arctan2(direction[1], direction[0]))
    if np.sin(heading) < 0.0:
        heading += np.pi
    degrees = np.rad2deg(heading) % 360.0
    return MapView(heading, (f"along {degrees:.0f}° from north", "to its left"))


def _map(axes: Axes, document: Document, view: MapView, tracks: Mapping[str, Pair]) -> None:
    axes.plot(*view.of(*tracks["measurement"]), **{**MEASURED, "ms": 3.0}, label="measurement")
    for name in ("EKF2", "ours", "truth"):
        if name in tracks:
            north, east = tracks[name]
            every = max(1, len(north) // MOST_POINTS)
            axes.plot(*view.of(north[::every], east[::every]), **LINES[name], label=name)
    samples = document.analysis.source.samples
    for times, looks, label in (
        (document.events.take_off_s, TAKE_OFF, "take-off"),
        (document.events.landing_s, LANDING, "landing"),
    ):
        if times:
            near = samples.iloc[samples.index.get_indexer(pd.Index(times), method="nearest")]
            signs = view.of(near["north_m"], near["east_m"])
            axes.plot(*signs, **{**looks, "ms": 7.0, "mec": "white", "mew": 0.6}, label=label)
    as_map(axes, *view.labels)
    if view is not NORTH_UP:
        x, y = view.of(20.0, 0.0)
        arrow = {"arrowstyle": "<-", "color": MUTED, "lw": 0.8, "shrinkA": 1, "shrinkB": 0}
        axes.annotate(
            "N", xy=(0.97, 0.6), xycoords="axes fraction", xytext=(float(x), float(y)),
            textcoords="offset points", arrowprops=arrow, size=7, color=MUTED, ha="center",
            va="center",
        )  # fmt: skip
    legend_above(axes, handlelength=1.8)
