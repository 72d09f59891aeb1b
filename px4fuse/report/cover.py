"""Cover: what happened, the verdict, the findings, and the flight from above."""

from __future__ import annotations

from collections.abc import Iterator

from px4fuse.comparison.model import (
    FILTERS,
    AgainstTruth,
    Difference,
    FilterSummary,
    UnjudgedFilter,
)
from px4fuse.comparison.why import the
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE
from px4fuse.findings import Finding, by_root
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document, who
from px4fuse.report.page import Cell, Page, halves, words
from px4fuse.report.plan import plan
from px4fuse.report.style import EKF2, MUTED, OURS, SEVERITY_COLOURS
from px4fuse.report.words import (
    clock_words,
    consequences_words,
    difference_cells,
    error_cells,
    settings_words,
    statement_cells,
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
    page.write(_subtitle(document), colour=MUTED, above=-4.0)
    for sentence in document.story:
        page.write(sentence, size=10.5, above=2.0)
    page.skip(8.0)
    _verdict(page, document)
    _other_axes(page, document)
    page.heading("Findings", 10.5, above=12.0)
    if not document.findings:
        page.write("None: no detector has anything to say about this flight.")
    for group in by_root(document.findings):
        write_finding(page, group)
    yield page


def _subtitle(document: Document) -> str:
    log = document.comparison.flight.log
    about = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    return " · ".join(filter(None, (who(document.student, ", "), *about)))


def _verdict(page: Page, document: Document) -> None:
    """The main axis, large: each filter on its half of the page."""
    result = document.comparison.main
    along = the(result.axis.name)
    columns = []
    for owner, name, colour in zip(("our filter's", "EKF2's"), FILTERS, (OURS, EKF2), strict=True):
        if name == "ekf2" and isinstance(result.ekf2_state, Unavailable):
            continue
        statement = result.filters[name]
        shade = colour if isinstance(statement, Consistency) else MUTED
        column, _ = halves()
        column.write(f"Along {along} {owner} variance is")
        column.write(verdict_words(statement), size=16.0, bold=True, colour=shade, above=1.0)
        column.write(_large_numbers(statement), above=1.0)
        columns.append(column)
    page.beside(*columns)
    if isinstance(result.difference, Difference):
        part = result.difference
        page.write(
            f"Ours - EKF2: {' m and '.join(difference_cells(part))} m/s RMS, "
            f"at most {part.position_maximum_m:.2f} m."
            + ("" if document.truth_known else " The log has no truth to say who is right."),
            above=2.0,
        )
    elif isinstance(result.ekf2_state, Unavailable):
        page.write(f"There is no EKF2 to compare with: {result.ekf2_state.reason}.", above=2.0)
    page.write(EXPLANATION, size=7.0, colour=MUTED)


def _large_numbers(statement: FilterSummary | UnjudgedFilter) -> str:
    if isinstance(statement, FilterSummary):
        cells = statement_cells(statement)
        words = f"Mean NIS {cells.nis}, band {cells.band}, from {statement.count} innovations."
    else:
        words = f"{statement.reason}."
    if isinstance(statement.truth, AgainstTruth):
        position, velocity = error_cells(statement.truth)
        words += f" {position} m{f' and {velocity} m/s' if velocity else ''} RMS from the truth."
    return words


def _other_axes(page: Page, document: Document) -> None:
    """The axes beside the main one, a row each."""
    others = [
        axis for axis in document.analysis.axes.values() if axis is not document.analysis.main
    ]
    if not others:
        return
    beside = not isinstance(document.comparison.main.ekf2_state, Unavailable)
    names = ["variance", "mean NIS", *(["to truth (m)"] if document.truth_known else [])]
    head = ["axis", *(f"ours: {name}" for name in names)]
    head += [*(f"EKF2: {name}" for name in names), "ours - EKF2 (m)"] if beside else []
    rows = []
    for result in others:
        row: list[Cell] = [result.axis.name]
        for name, colour in zip(FILTERS[: 1 + beside], (OURS, EKF2), strict=False):
            row += [(cell, colour) for cell in _cells(result.filters[name])[: len(names)]]
        rows.append([*row, difference_cells(result.difference)[0]] if beside else row)
    page.table(head, rows)


def _cells(statement: FilterSummary | UnjudgedFilter) -> tuple[str, str, str]:
    cells = statement_cells(statement)
    return cells.words, cells.nis, error_cells(statement.truth)[0]


def facts(document: Document) -> list[tuple[str, str]]:
    """What was compared, in labels and sentences."""
    comparison, flight = document.comparison, document.comparison.flight
    log, source, segment = flight.log, comparison.source, comparison.segment
    source_text = (
        f"{source.name}: {source.description}, {source.rate_hz:.1f} Hz, {source.frame}; "
        f"{comparison.source_reason}"
    )
    if any(part.source == "vehicle_visual_odometry" for part in comparison.missing):
        source_text += ". SDLOG_PROFILE 129 would have logged it as it arrived"
    clock = "" if source.alignment is None else source.clock
    if source.clock_map is not None:
        clock = clock_words(source.clock_map)
    aisle = next((line for line in comparison.lines if line.name == AISLE), None)
    listed = [
        ("Position", source_text),
        ("Clock", clock),
        ("Segment", f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}"),
        ("Our filter", settings_words(comparison.settings)),
        ("Aisle", "" if aisle is None else f"{aisle.heading_deg:.1f}° from north ({aisle.note})"),
        ("With", ", ".join(f"{f.name}, SHA-256 {f.sha256[:12]}…" for f in flight.inputs)),
        ("SHA-256", f"{log.sha256}, {log.bytes / 1e6:.2f} MB"),
    ]
    return [(label, text) for label, text in listed if text]


def write_finding(page: Page, group: list[Finding]) -> None:
    """Write severity, when it shows, sentence and remedy, and what follows from it."""
    finding, *followers = group
    said = [words(finding.message, 8.0), words(finding.remedy, 7.5, MUTED)]
    if followers:
        said.append(words(consequences_words(followers), 7.5, MUTED))
    page.labelled(
        f"{finding.severity}\n{finding.when}", size=7.0, beside=said, above=2.0,
        colour=SEVERITY_COLOURS[finding.severity],
    )  # fmt: skip
