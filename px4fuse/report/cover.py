"""Cover: what happened, the verdict, the findings, and the flight from above."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.interventions import beyond_claim
from px4fuse.comparison.model import Comparison
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE, Axis, within
from px4fuse.findings import Finding, by_root
from px4fuse.flight import Ekf2, Truth, Unavailable
from px4fuse.plain import length_words
from px4fuse.recording import LogInfo
from px4fuse.report import say
from px4fuse.report.marks import LANDING, TAKE_OFF
from px4fuse.report.page import WIDTH, Page, halves, legend_above, words
from px4fuse.report.style import EKF2, LINES, MEASURED, MUTED, OURS, SEVERITY_COLOURS, Axes, as_map
from px4fuse.report.words import (
    clock_words,
    consequences_words,
    filters,
    settings_words,
    verdict_words,
    write_errors,
)
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.model import Student

# A track so many times longer than wide lies along the page, else north is up
LONG = 2.2
TALLEST, LOWEST, BESIDE, WIDE = 120.0, 56.0, 150.0, 256.0  # points
MOST_POINTS = 2000
Pair = tuple[Array, Array]
NORTH_EAST = ("north", "east")


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the cover; findings that it has no room for go to the next page."""
    page = Page("Two-state Kalman filter against EKF2")
    page.foot(_plan(analysis, facts(analysis)))
    page.write(about(results.student, analysis.flight.log), colour=MUTED, above=-4.0)
    for sentence in results.story:
        page.write(sentence, size=10.5, above=2.0)
    _verdict(page, analysis)
    write_errors(page, analysis)
    write_findings(page, results.findings)
    yield page


def about(student: Student, log: LogInfo) -> str:
    """Whose report it is, and of which flight, on one line."""
    told = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    return " · ".join(filter(None, (who(student, ", "), *told)))


def who(student: Student, between: str) -> str:
    """Name and id, as far as they are given."""
    return between.join(filter(None, (student.name, student.id)))


def write_findings(page: Page, findings: tuple[Finding, ...]) -> None:
    """Write all findings below a heading, each with what follows from it."""
    page.heading("Findings", 10.5, above=12.0)
    if not findings:
        page.write("None: no detector has anything to say about this flight.")
    for group in by_root(findings):
        write_finding(page, group)


def _verdict(page: Page, analysis: Analysis) -> None:
    """The main axis, large: each filter on its half of the page."""
    result, columns = analysis.main, []
    along = result.axis.called
    for (name, one), colour in zip(filters(result).items(), (OURS, EKF2), strict=False):
        judged = isinstance(one, Consistency)
        column, _ = halves()
        owner = "our filter" if name == "ours" else name
        what, large = "variance is", verdict_words(one)
        if hidden := beyond_claim(one):
            what, claimed = "error is", length_words(hidden.claimed_m)
            large = f"{length_words(hidden.rmse_m)}, claimed {claimed}"
        column.write(f"Along {along} {owner}'s {what}")
        column.write(large, size=16.0, bold=True, colour=colour if judged else MUTED, above=1.0)
        if isinstance(one, Unavailable):
            column.write(f"{one.reason}.", above=1.0)
        columns.append(column)
    page.beside(*columns, above=14.0)
    said = [say("nis")]
    if isinstance(result.ekf2_state, Unavailable):
        said.append(f"There is no EKF2 to compare with: {result.ekf2_state.reason}.")
    if not isinstance(analysis.flight.truth, Truth):
        said.append("The log has no truth to say who is right.")
    page.write(" ".join(said), size=7.0, colour=MUTED)


def facts(comparison: Comparison) -> dict[str, str]:
    """What was compared, in labels and sentences."""
    flight = comparison.flight
    log, source, segment = flight.log, comparison.source, comparison.segment
    position = say("position", source=source, comparison=comparison)
    placed, clock = "", ""
    if source.alignment is not None:
        alignment, clock = source.alignment, source.clock
        sigma = alignment.clock_offset_sigma_s
        placed = (
            f"{alignment.frame}, yaw {alignment.yaw_deg:.1f}°, clock "
            f"{alignment.clock_offset_s:+.3f}{'' if sigma is None else f' ± {sigma:.3f}'} s"
        )
    if source.clock_map is not None:
        clock = clock_words(source.clock_map)
    aisle = _aisle(comparison)
    listed = {
        "Filter": settings_words(comparison.settings),
        "Position": position,
        "Placed": placed,
        "Clock": clock,
        "Segment": f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}",
        "Aisle": "" if aisle is None else f"{aisle.heading_deg:.1f}° from north ({aisle.note})",
        "With": ", ".join(f"{file.name}, SHA-256 {file.sha256[:12]}…" for file in flight.inputs),
        "SHA-256": f"{log.sha256[:32]}…, {log.bytes / 1e6:.2f} MB",
    }
    return {label: text for label, text in listed.items() if text}


def write_finding(page: Page, group: list[Finding]) -> None:
    """Write severity, when it shows, sentence and remedy, and what follows from it."""
    finding, *followers = group
    said = [words(finding.message, 8.0), words(finding.remedy, 7.5, MUTED)]
    if followers:
        said.append(words(consequences_words(followers), 7.5, MUTED))
    page.labelled(
        f"{finding.severity}\n{finding.when}".strip(),
        *said,
        size=7.0,
        above=2.0,
        colour=SEVERITY_COLOURS[finding.severity],
    )


def _aisle(comparison: Comparison) -> Axis | None:
    """The aisle, where one is known."""
    return next((line for line in comparison.lines if line.name == AISLE), None)


# ------------------------------------------------------------------------- the flight from above


class MapView(NamedTuple):
    """How the map lies on the page: the heading (rad) of its x axis, and the names of both."""

    heading: float
    labels: tuple[str, str]

    def of(self, north: Any, east: Any) -> Pair:
        """Where positions (m) lie on the page: to the right, and up."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


NORTH_UP = MapView(np.pi / 2.0, ("east", "north"))


def _plan(analysis: Analysis, facts: Mapping[str, str]) -> Page:
    """The map of a flight, with labelled sentences below or beside it.

    A long track lies along the page and takes its width, with the facts below it.

    Parameters
    ----------
    analysis : Analysis
    facts : mapping from labels to sentences
    """
    tracks = _tracks(analysis)
    along = _along(analysis)
    wide, high = (float(np.ptp(values)) for values in along.of(*tracks["measurement"]))
    is_long = wide >= LONG * max(high, 1e-6)
    page, view, height = Page(), NORTH_UP, BESIDE
    drawn, beside = Page(width=WIDE), Page(width=WIDTH - WIDE - 14.0)
    if is_long:
        drawn, beside, view = page, page, along
        height = float(np.clip(1.3 * high * WIDTH / (1.1 * wide), LOWEST, TALLEST))
    # beside the facts the legend needs two lines
    above = 16.0 if is_long else 28.0
    _map(drawn.panel("From above", "", height, above=above, left=36.0), analysis, view, tracks)
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
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    if set(NORTH_EAST) <= comparison.axes.keys():
        north, east = (
            comparison.axes[name].replay.steps["position_m"].to_numpy() for name in NORTH_EAST
        )
        tracks["ours"] = north, east
    return tracks


def _along(comparison: Comparison) -> MapView:
    """Along the aisle where one is known; north is up, not down."""
    aisle = _aisle(comparison)
    if aisle is None or aisle.heading_deg is None:
        return NORTH_UP
    degrees = aisle.heading_deg % 180.0
    return MapView(np.deg2rad(degrees), (f"along {degrees:.0f}° from north", "to its left"))


def _map(axes: Axes, analysis: Analysis, view: MapView, tracks: Mapping[str, Pair]) -> None:
    axes.plot(*view.of(*tracks["measurement"]), **{**MEASURED, "ms": 3.0}, label="measurement")
    for name in ("EKF2", "ours", "truth"):
        if name in tracks:
            north, east = tracks[name]
            every = max(1, len(north) // MOST_POINTS)
            axes.plot(*view.of(north[::every], east[::every]), **LINES[name], label=name)
    samples = analysis.source.samples
    for times, looks, label in (
        (analysis.events.take_off_s, TAKE_OFF, "take-off"),
        (analysis.events.landing_s, LANDING, "landing"),
    ):
        if times:
            near = samples.iloc[samples.index.get_indexer(pd.Index(times), method="nearest")]
            signs = view.of(near["north_m"], near["east_m"])
            axes.plot(*signs, **{**looks, "ms": 7.0, "mec": "white", "mew": 0.6}, label=label)
    as_map(axes, *view.labels)
    legend_above(axes, columns=3 if view is NORTH_UP else 9, handlelength=1.8)
