"""Cover: summary, verdict along the main axis, findings and map."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.causal_replays import error_above_reported_sigma
from px4fuse.comparison.model import Comparison
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE, Axis, cut_to_segment
from px4fuse.findings import Finding, finding_title, group_by_root
from px4fuse.flight import Ekf2, Truth, Unavailable
from px4fuse.log import LogInfo
from px4fuse.report.event_marks import LANDING_MARK, TAKE_OFF_MARK
from px4fuse.report.page import PAGE_WIDTH, Page, draw_legend_above, halves, styled_text
from px4fuse.report.phrases import (
    filters_by_name,
    format_clock_map,
    format_consequences,
    format_settings,
    format_verdict,
    write_errors,
)
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
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.model import Student
from px4fuse.text import capitalise_first, format_number

# Length / width of the track above which the map shows it along the page; else north is up
MIN_LONG_RATIO = 2.2
MAX_MAP_HEIGHT, MIN_MAP_HEIGHT = 120.0, 56.0  # points; of a map above the facts
SIDE_MAP_HEIGHT, SIDE_MAP_WIDTH = 150.0, 256.0  # points; of a map beside the facts
MAX_POINTS = 2000  # drawn points per track
Coordinates = tuple[Array, Array]
HORIZONTAL_AXES = ("north", "east")


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the cover; findings that do not fit continue on the next page."""
    page = Page("EKF2 check: comparison with a two-state Kalman filter (KF)")
    page.add_foot(_map_and_facts(analysis, facts(analysis)))
    page.write(flight_line(results.student, analysis.flight.log), colour=MUTED_COLOUR, above=-4.0)
    for sentence in results.summary:
        page.write(sentence, size=10.5, above=2.0)
    _write_verdict(page, analysis)
    write_errors(page, analysis)
    write_findings(page, results.findings)
    yield page


def flight_line(student: Student, log: LogInfo) -> str:
    """Format student, log, duration, firmware and hardware on one line."""
    flight_facts = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    return " · ".join(filter(None, (student_line(student, ", "), *flight_facts)))


def student_line(student: Student, separator: str) -> str:
    """Join the student's name and id; either may be empty."""
    return separator.join(filter(None, (student.name, student.id)))


def write_findings(page: Page, findings: tuple[Finding, ...]) -> None:
    """Write all findings below a heading, each with its consequences."""
    page.heading("Findings", 10.5, above=12.0)
    if not findings:
        page.write("None.")
    for findings_of_cause in group_by_root(findings):
        write_finding(page, findings_of_cause)


def _write_verdict(page: Page, analysis: Analysis) -> None:
    """Write the verdicts along the main axis in large letters: KF left, EKF2 right."""
    result, columns = analysis.main, []
    axis_text = result.axis.label
    for (name, consistency), colour in zip(
        filters_by_name(result).items(), (KF_COLOUR, EKF2_COLOUR), strict=False
    ):
        is_judged = isinstance(consistency, Consistency)
        column, _ = halves()
        large_text = format_verdict(consistency)
        if excess := error_above_reported_sigma(consistency):
            rmse, sigma = (
                format_number(value_m, 2) for value_m in (excess.rmse_m, excess.reported_sigma_m)
            )
            large_text = f"position RMSE {rmse} m, reported σ {sigma} m"
        column.write(f"{name} along {axis_text}")
        column.write(
            large_text,
            size=12.0,
            bold=True,
            colour=colour if is_judged else MUTED_COLOUR,
            above=1.0,
        )
        if isinstance(consistency, Unavailable):
            column.write(f"{consistency.reason}.", above=1.0)
        columns.append(column)
    page.add_columns(*columns, above=14.0)
    notes = [
        (
            "Mean NIS: expected 1. Below its 95 % band: underconfident (σ too large). "
            "Above: overconfident (σ too small)."
        )
    ]
    if isinstance(result.ekf2_state, Unavailable):
        notes.append(f"No EKF2 in the log: {result.ekf2_state.reason}.")
    if not isinstance(analysis.flight.truth, Truth):
        notes.append("No ground truth in the log, so position errors are unknown.")
    page.write(" ".join(notes), size=7.0, colour=MUTED_COLOUR)


def facts(comparison: Comparison) -> dict[str, str]:
    """Return filter settings, position source, segment and input files as texts by label."""
    flight = comparison.flight
    log, source, segment = flight.log, comparison.source, comparison.segment
    position = (
        f"{source.name}: {source.description}, {source.rate_hz:.1f} Hz, "
        f"{source.frame}; {comparison.source_reason}"
    )
    alignment_text, clock_text = "", ""
    if source.alignment is not None:
        alignment, clock_text = source.alignment, source.clock
        sigma = alignment.clock_offset_sigma_s
        alignment_text = (
            f"{alignment.frame}, yaw {alignment.yaw_deg:.1f}°, clock "
            f"{alignment.clock_offset_s:+.3f}{'' if sigma is None else f' ± {sigma:.3f}'} s"
        )
    if source.clock_map is not None:
        clock_text = format_clock_map(source.clock_map)
    aisle = _aisle(comparison)
    texts = {
        "Filter": format_settings(comparison.settings),
        "Position": position,
        "Aligned": alignment_text,
        "Clock": clock_text,
        "Segment": f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}",
        "Aisle": "" if aisle is None else f"{aisle.heading_deg:.1f}° from north ({aisle.note})",
        "Inputs": ", ".join(f"{file.name}, SHA-256 {file.sha256[:12]}…" for file in flight.inputs),
        "SHA-256": f"{log.sha256[:32]}…, {log.bytes / 1e6:.2f} MB",
    }
    return {label: text for label, text in texts.items() if text}


def write_finding(page: Page, group: list[Finding]) -> None:
    """Write severity, time, title with id, message, action and consequences of a finding."""
    finding, *consequences = group
    title = f"{capitalise_first(finding_title(finding.id))} [{finding.id}]"
    texts = [styled_text(title, 8.0, bold=True), styled_text(finding.message, 8.0)]
    if finding.remedy:
        texts.append(styled_text(f"Action: {finding.remedy}", 7.5, MUTED_COLOUR))
    if consequences:
        texts.append(styled_text(format_consequences(consequences), 7.5, MUTED_COLOUR))
    page.write_labelled(
        f"{finding.severity}\n{finding.when}".strip(),
        *texts,
        size=7.0,
        above=2.0,
        colour=SEVERITY_COLOURS[finding.severity],
    )


def _aisle(comparison: Comparison) -> Axis | None:
    """Return the aisle axis, if the comparison has one."""
    return next((line for line in comparison.lines if line.name == AISLE), None)


# ------------------------------------------------------------------------- the flight from above


class MapView(NamedTuple):
    """Orientation of the map: heading (rad) of its x axis, and the labels of both axes."""

    heading: float
    labels: tuple[str, str]

    def project(self, north: Any, east: Any) -> Coordinates:
        """Rotate north and east (m) to map coordinates: right and up (m)."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * north + s * east, s * north - c * east


NORTH_UP = MapView(np.pi / 2.0, ("east", "north"))


def _map_and_facts(analysis: Analysis, facts: Mapping[str, str]) -> Page:
    """Draw the map, with the facts below it (long track) or beside it."""
    tracks = _tracks(analysis)
    aisle_view = _map_view(analysis)
    length_m, width_m = (
        float(np.ptp(values)) for values in aisle_view.project(*tracks["measurement"])
    )
    is_long = length_m >= MIN_LONG_RATIO * max(width_m, 1e-6)
    page, view, height = Page(), NORTH_UP, SIDE_MAP_HEIGHT
    map_page, facts_page = (
        Page(width=SIDE_MAP_WIDTH),
        Page(width=PAGE_WIDTH - SIDE_MAP_WIDTH - 14.0),
    )
    if is_long:
        map_page, facts_page, view = page, page, aisle_view
        height = float(
            np.clip(1.3 * width_m * PAGE_WIDTH / (1.1 * length_m), MIN_MAP_HEIGHT, MAX_MAP_HEIGHT)
        )
    # The legend of the narrow map needs two lines
    above = 16.0 if is_long else 28.0
    _draw_map(map_page.panel("Map", "", height, above=above, left=36.0), analysis, view, tracks)
    for label, text in facts.items():
        facts_page.write_labelled(label, text, size=7.0, above=-0.5)
    if not is_long:
        page.add_columns(map_page, facts_page)
    return page


def _tracks(comparison: Comparison) -> dict[str, Coordinates]:
    """Return north and east (m) of each track within the segment."""
    segment, flight = comparison.segment, comparison.flight

    def cut(frame: pd.DataFrame) -> Coordinates:
        inside = cut_to_segment(frame, segment)
        return inside["north_m"].to_numpy(), inside["east_m"].to_numpy()

    tracks = {"measurement": cut(comparison.source.samples)}
    if isinstance(flight.truth, Truth):
        tracks["ground truth"] = cut(flight.truth.samples)
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut(flight.ekf2.state)
    if set(HORIZONTAL_AXES) <= comparison.axes.keys():
        north, east = (
            comparison.axes[name].replay.steps["position_m"].to_numpy() for name in HORIZONTAL_AXES
        )
        tracks["KF"] = north, east
    return tracks


def _map_view(comparison: Comparison) -> MapView:
    """Return the view along the aisle axis, at a heading below 180°; else north up."""
    aisle = _aisle(comparison)
    if aisle is None or aisle.heading_deg is None:
        return NORTH_UP
    degrees = aisle.heading_deg % 180.0
    return MapView(np.deg2rad(degrees), (f"along heading {degrees:.0f}°", "left of it"))


def _draw_map(
    axes: Axes, analysis: Analysis, view: MapView, tracks: Mapping[str, Coordinates]
) -> None:
    axes.plot(
        *view.project(*tracks["measurement"]),
        **{**MEASUREMENT_DOTS, "ms": 3.0},
        label="measurement",
    )
    for name in ("EKF2", "KF", "ground truth"):
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
    draw_legend_above(axes, column_count=3 if view is NORTH_UP else 9, handlelength=1.8)
