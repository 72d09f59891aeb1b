"""The flight from above, to scale, at the foot of the cover, with the facts of the comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.comparison.model import Comparison
from px4fuse.filter.signals import AISLE, within
from px4fuse.flight import Ekf2, Truth
from px4fuse.report.document import Document
from px4fuse.report.marks import LANDING, TAKE_OFF
from px4fuse.report.page import WIDTH, Page, legend_above
from px4fuse.report.style import EKF2_LINE, MEASURED, MUTED, OURS_LINE, TRUTH_LINE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A track so many times longer than wide lies along the page, else north is up
LONG = 2.2
TALLEST, LOWEST, BESIDE, WIDE = 120.0, 56.0, 150.0, 256.0  # points
MOST_POINTS = 2000
Pair = tuple[Array, Array]


@dataclass(frozen=True)
class MapView:
    """How the map lies on the page: the heading (rad) of its x axis, and the names of both."""

    heading: float
    labels: tuple[str, str]

    def __call__(self, north: Array, east: Array) -> Pair:
        """Where positions (m) lie on the page: to the right, and up."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


def plan(document: Document, facts: Mapping[str, str]) -> Page:
    """The map of a document's flight, with labelled sentences below or beside it.

    A long track lies along the page and takes its width, with the facts below it.

    Parameters
    ----------
    document : Document
    facts : mapping from labels to sentences
    """
    tracks = _tracks(document.analysis)
    view, ratio = _view(document.analysis, np.column_stack(tracks["measurement"]))
    page = Page()
    drawn = page if ratio >= LONG else Page(width=WIDE)
    height = _height(view, tracks) if ratio >= LONG else BESIDE
    _map(drawn.panel("From above", "", height, above=16.0, left=36.0), document, view, tracks)
    beside = page if ratio >= LONG else Page(width=WIDTH - WIDE - 14.0)
    for label, text in facts.items():
        beside.labelled(label, text, size=7.0, above=-0.5)
    if drawn is not page:
        page.beside(drawn, beside)
    return page


def _height(view: MapView, tracks: Mapping[str, Pair]) -> float:
    """Of a map of the page's width, in points."""
    x, y = view(*tracks["measurement"])
    scale = WIDTH / (1.1 * float(np.ptp(x)) + 1e-6)
    return float(np.clip(1.3 * float(np.ptp(y)) * scale, LOWEST, TALLEST))


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


def _view(comparison: Comparison, points: Array) -> tuple[MapView, float]:
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
    along = MapView(heading, (f"along {degrees:.0f}° from north (m)", "to its left (m)"))
    x, y = along(points[:, 0], points[:, 1])
    ratio = float(np.ptp(x)) / max(float(np.ptp(y)), 1e-6)
    if ratio >= LONG:
        return along, ratio
    return MapView(np.pi / 2.0, ("east (m)", "north (m)")), ratio


def _map(axes: Axes, document: Document, view: MapView, tracks: Mapping[str, Pair]) -> None:
    axes.plot(*view(*tracks["measurement"]), **{**MEASURED, "ms": 3.0}, label="measurement")
    for name, style in (("EKF2", EKF2_LINE), ("ours", OURS_LINE), ("truth", TRUTH_LINE)):
        if name in tracks:
            north, east = tracks[name]
            every = max(1, len(north) // MOST_POINTS)
            axes.plot(*view(north[::every], east[::every]), **style, label=name)
    samples = document.analysis.source.samples
    for times, style, label in (
        (document.events.take_off_s, TAKE_OFF, "take-off"),
        (document.events.landing_s, LANDING, "landing"),
    ):
        if times:
            near = np.clip(np.searchsorted(samples.index.to_numpy(), times), 0, len(samples) - 1)
            x, y = view(samples["north_m"].to_numpy()[near], samples["east_m"].to_numpy()[near])
            axes.plot(x, y, **{**style, "ms": 7.0, "mec": "white", "mew": 0.6}, label=label)
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.grid(visible=True, axis="both")
    axes.set(xlabel=view.labels[0], ylabel=view.labels[1])
    if view.heading != np.pi / 2.0:
        _north(axes, view)
    legend_above(axes, handlelength=1.8)


def _north(axes: Axes, view: MapView) -> None:
    """An arrow to the north in the corner."""
    x, y = view(np.array([1.0]), np.array([0.0]))
    axes.annotate(
        "N", xy=(0.97, 0.6), xycoords="axes fraction",
        xytext=(20.0 * float(x[0]), 20.0 * float(y[0])), textcoords="offset points",
        arrowprops={"arrowstyle": "<-", "color": MUTED, "lw": 0.8, "shrinkA": 1, "shrinkB": 0},
        size=7, color=MUTED, ha="center", va="center",
    )  # fmt: skip
