"""Cover: what happened, the verdict, the findings, and the flight from above."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.interventions import error_beyond_reported_sigma
from px4fuse.comparison.model import Comparison
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE, Axis, within
from px4fuse.findings import Finding, by_root
from px4fuse.flight import Ekf2, Truth, Unavailable
from px4fuse.plain import format_length
from px4fuse.recording import LogInfo
from px4fuse.report import say
from px4fuse.report.marks import LANDING_MARK, TAKE_OFF_MARK
from px4fuse.report.page import PAGE_WIDTH, Page, halves, legend_above, words
from px4fuse.report.style import (
    EKF2_COLOUR,
    KF_COLOUR,
    LINES,
    MEASUREMENT_DOTS,
    MUTED_COLOUR,
    SEVERITY_COLOURS,
    Axes,
    set_map_axes,
)
from px4fuse.report.words import (
    filters_by_name,
    format_clock_map,
    format_consequences,
    format_settings,
    format_verdict,
    write_errors,
)
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.model import Student

# A track so many times longer than wide lies along the page, else north is up
MIN_LONG_RATIO = 2.2
MAX_MAP_HEIGHT, MIN_MAP_HEIGHT, SIDE_MAP_HEIGHT, SIDE_MAP_WIDTH = (
    120.0,
    56.0,
    150.0,
    256.0,
)  # points
MAX_POINTS = 2000
Coordinates = tuple[Array, Array]
HORIZONTAL_AXES = ("north", "east")


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the cover; findings that it has no room for go to the next page."""
    page = Page("Two-state Kalman filter against EKF2")
    page.foot(_map_and_facts(analysis, facts(analysis)))
    page.write(flight_line(results.student, analysis.flight.log), colour=MUTED_COLOUR, above=-4.0)
    for sentence in results.story:
        page.write(sentence, size=10.5, above=2.0)
    _write_verdict(page, analysis)
    write_errors(page, analysis)
    write_findings(page, results.findings)
    yield page


def flight_line(student: Student, log: LogInfo) -> str:
    """Whose report it is, and of which flight, on one line."""
    flight_facts = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    return " · ".join(filter(None, (student_line(student, ", "), *flight_facts)))


def student_line(student: Student, separator: str) -> str:
    """Name and id, as far as they are given."""
    return separator.join(filter(None, (student.name, student.id)))


def write_findings(page: Page, findings: tuple[Finding, ...]) -> None:
    """Write all findings below a heading, each with what follows from it."""
    page.heading("Findings", 10.5, above=12.0)
    if not findings:
        page.write("None: no detector has anything to say about this flight.")
    for findings_of_cause in by_root(findings):
        write_finding(page, findings_of_cause)


def _write_verdict(page: Page, analysis: Analysis) -> None:
    """The main axis, large: each filter on its half of the page."""
    result, columns = analysis.main, []
    along = result.axis.called
    for (name, one), colour in zip(
        filters_by_name(result).items(), (KF_COLOUR, EKF2_COLOUR), strict=False
    ):
        is_judged = isinstance(one, Consistency)
        column, _ = halves()
        owner = "our filter" if name == "ours" else name
        subject, large_text = "variance is", format_verdict(one)
        if excess := error_beyond_reported_sigma(one):
            subject, sigma_text = "error is", format_length(excess.reported_sigma_m)
            large_text = f"{format_length(excess.rmse_m)}, claimed {sigma_text}"
        column.write(f"Along {along} {owner}'s {subject}")
        column.write(
            large_text,
            size=16.0,
            bold=True,
            colour=colour if is_judged else MUTED_COLOUR,
            above=1.0,
        )
        if isinstance(one, Unavailable):
            column.write(f"{one.reason}.", above=1.0)
        columns.append(column)
    page.beside(*columns, above=14.0)
    notes = [say("nis")]
    if isinstance(result.ekf2_state, Unavailable):
        notes.append(f"There is no EKF2 to compare with: {result.ekf2_state.reason}.")
    if not isinstance(analysis.flight.truth, Truth):
        notes.append("The log has no truth to say who is right.")
    page.write(" ".join(notes), size=7.0, colour=MUTED_COLOUR)


def facts(comparison: Comparison) -> dict[str, str]:
    """What was compared, in labels and sentences."""
    flight = comparison.flight
    log, source, segment = flight.log, comparison.source, comparison.segment
    position = say("position", source=source, comparison=comparison)
    placement, clock = "", ""
    if source.alignment is not None:
        alignment, clock = source.alignment, source.clock
        sigma = alignment.clock_offset_sigma_s
        placement = (
            f"{alignment.frame}, yaw {alignment.yaw_deg:.1f}°, clock "
            f"{alignment.clock_offset_s:+.3f}{'' if sigma is None else f' ± {sigma:.3f}'} s"
        )
    if source.clock_map is not None:
        clock = format_clock_map(source.clock_map)
    aisle = _aisle(comparison)
    entries = {
        "Filter": format_settings(comparison.settings),
        "Position": position,
        "Placed": placement,
        "Clock": clock,
        "Segment": f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}",
        "Aisle": "" if aisle is None else f"{aisle.heading_deg:.1f}° from north ({aisle.note})",
        "With": ", ".join(f"{file.name}, SHA-256 {file.sha256[:12]}…" for file in flight.inputs),
        "SHA-256": f"{log.sha256[:32]}…, {log.bytes / 1e6:.2f} MB",
    }
    return {label: text for label, text in entries.items() if text}


def write_finding(page: Page, group: list[Finding]) -> None:
    """Write severity, when it shows, sentence and remedy, and what follows from it."""
    finding, *followers = group
    texts = [words(finding.message, 8.0), words(finding.remedy, 7.5, MUTED_COLOUR)]
    if followers:
        texts.append(words(format_consequences(followers), 7.5, MUTED_COLOUR))
    page.labelled(
        f"{finding.severity}\n{finding.when}".strip(),
        *texts,
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

    def project(self, north: Any, east: Any) -> Coordinates:
        """Where positions (m) lie on the page: to the right, and up."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


NORTH_UP = MapView(np.pi / 2.0, ("east", "north"))


def _map_and_facts(analysis: Analysis, facts: Mapping[str, str]) -> Page:
    """The map of a flight, with labelled sentences below or beside it.

    A long track lies along the page and takes its width, with the facts below it.

    Parameters
    ----------
    analysis : Analysis
    facts : mapping from labels to sentences
    """
    tracks = _tracks(analysis)
    along = _map_view(analysis)
    wide, high = (float(np.ptp(values)) for values in along.project(*tracks["measurement"]))
    is_long = wide >= MIN_LONG_RATIO * max(high, 1e-6)
    page, view, height = Page(), NORTH_UP, SIDE_MAP_HEIGHT
    map_page, beside = Page(width=SIDE_MAP_WIDTH), Page(width=PAGE_WIDTH - SIDE_MAP_WIDTH - 14.0)
    if is_long:
        map_page, beside, view = page, page, along
        height = float(
            np.clip(1.3 * high * PAGE_WIDTH / (1.1 * wide), MIN_MAP_HEIGHT, MAX_MAP_HEIGHT)
        )
    # beside the facts the legend needs two lines
    above = 16.0 if is_long else 28.0
    _draw_map(
        map_page.panel("From above", "", height, above=above, left=36.0), analysis, view, tracks
    )
    for label, text in facts.items():
        beside.labelled(label, text, size=7.0, above=-0.5)
    if not is_long:
        page.beside(map_page, beside)
    return page


def _tracks(comparison: Comparison) -> dict[str, Coordinates]:
    """North and east of each track in the segment, m."""
    segment, flight = comparison.segment, comparison.flight

    def cut(frame: pd.DataFrame) -> Coordinates:
        inside = within(frame, segment)
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

    tracks = {"measurement": cut(comparison.source.samples)}
    if isinstance(flight.truth, Truth):
        tracks["truth"] = cut(flight.truth.samples)
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    if set(HORIZONTAL_AXES) <= comparison.axes.keys():
        north, east = (
            comparison.axes[name].replay.steps["position_m"].to_numpy() for name in HORIZONTAL_AXES
        )
        tracks["ours"] = north, east
    return tracks


def _map_view(comparison: Comparison) -> MapView:
    """Along the aisle where one is known; north is up, not down."""
    aisle = _aisle(comparison)
    if aisle is None or aisle.heading_deg is None:
        return NORTH_UP
    degrees = aisle.heading_deg % 180.0
    return MapView(np.deg2rad(degrees), (f"along {degrees:.0f}° from north", "to its left"))


def _draw_map(
    axes: Axes, analysis: Analysis, view: MapView, tracks: Mapping[str, Coordinates]
) -> None:
    axes.plot(
        *view.project(*tracks["measurement"]),
        **{**MEASUREMENT_DOTS, "ms": 3.0},
        label="measurement",
    )
    for name in ("EKF2", "ours", "truth"):
        if name in tracks:
            north, east = tracks[name]
            stride = max(1, len(north) // MAX_POINTS)
            axes.plot(*view.project(north[::stride], east[::stride]), **LINES[name], label=name)
    samples = analysis.source.samples
    for times, mark_style, label in (
        (analysis.events.take_off_s, TAKE_OFF_MARK, "take-off"),
        (analysis.events.landing_s, LANDING_MARK, "landing"),
    ):
        if times:
            nearest = samples.iloc[samples.index.get_indexer(pd.Index(times), method="nearest")]
            coordinates = view.project(nearest["north_m"], nearest["east_m"])
            axes.plot(
                *coordinates, **{**mark_style, "ms": 7.0, "mec": "white", "mew": 0.6}, label=label
            )
    set_map_axes(axes, *view.labels)
    legend_above(axes, columns=3 if view is NORTH_UP else 9, handlelength=1.8)
