"""Cover: what happened, the verdict, the findings, and the flight from above."""

from __future__ import annotations

from collections.abc import Iterator

from px4fuse.comparison.why import the
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE
from px4fuse.findings import Finding, by_root
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document, who
from px4fuse.report.page import Page, halves, words
from px4fuse.report.plan import plan
from px4fuse.report.style import EKF2, MUTED, OURS, SEVERITY_COLOURS
from px4fuse.report.words import (
    clock_words,
    consequences_words,
    error_rows,
    filters,
    settings_words,
    verdict_words,
)

EXPLANATION = (
    "Mean NIS is 1 where the innovations are as large as a filter's own variance says; below its "
    "95 % band the variance is overstated, above it understated."
)


def draw(document: Document) -> Iterator[Page]:
    """Draw the cover; findings that it has no room for go to the next page."""
    page = Page("Two-state Kalman filter against EKF2")
    page.foot(plan(document, facts(document)))
    log = document.analysis.flight.log
    about = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    student = who(document.student, ", ")
    page.write(" · ".join(filter(None, (student, *about))), colour=MUTED, above=-4.0)
    for sentence in document.story:
        page.write(sentence, size=10.5, above=2.0)
    _verdict(page, document)
    write_axes(page, document)
    page.heading("Findings", 10.5, above=12.0)
    if not document.findings:
        page.write("None: no detector has anything to say about this flight.")
    for group in by_root(document.findings):
        write_finding(page, group)
    yield page


def _verdict(page: Page, document: Document) -> None:
    """The main axis, large: each filter on its half of the page."""
    result, columns = document.analysis.main, []
    along = the(result.axis.name)
    for (name, one), colour in zip(filters(result).items(), (OURS, EKF2), strict=False):
        judged = isinstance(one, Consistency)
        column, _ = halves()
        owner = "our filter" if name == "ours" else name
        column.write(f"Along {along} {owner}'s variance is")
        column.write(verdict_words(one), size=16.0, bold=True, colour=colour if judged else MUTED,
                     above=1.0)  # fmt: skip
        if isinstance(one, Unavailable):
            column.write(f"{one.reason}.", above=1.0)
        columns.append(column)
    page.beside(*columns, above=14.0)
    said = [EXPLANATION]
    if isinstance(result.ekf2_state, Unavailable):
        said.append(f"There is no EKF2 to compare with: {result.ekf2_state.reason}.")
    if not document.truth_known:
        said.append("The log has no truth to say who is right.")
    page.write(" ".join(said), size=7.0, colour=MUTED)


def write_axes(page: Page, document: Document) -> None:
    """Write a row for each axis and filter: verdict, distance from one another, errors."""
    page.table(*error_rows(document), right=(2, 3, 5, 6, 7, 8))


def facts(document: Document) -> dict[str, str]:
    """What was compared, in labels and sentences."""
    comparison, flight = document.analysis, document.analysis.flight
    log, source, segment = flight.log, comparison.source, comparison.segment
    position = (
        f"{source.name}: {source.description}, {source.rate_hz:.1f} Hz, {source.frame}; "
        f"{comparison.source_reason}"
    )
    if any(part.source == "vehicle_visual_odometry" for part in comparison.missing):
        position += ". SDLOG_PROFILE 129 would have logged it as it arrived"
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
    aisle = next((line for line in comparison.lines if line.name == AISLE), None)
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
        f"{finding.severity}\n{finding.when}".strip(), *said, size=7.0, above=2.0,
        colour=SEVERITY_COLOURS[finding.severity],
    )  # fmt: skip
