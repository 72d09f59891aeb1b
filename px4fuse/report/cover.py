"""Cover: what happened, the verdict, the findings, and the flight from above."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure

from px4fuse.comparison.model import (
    AgainstTruth,
    Difference,
    FilterName,
    FilterSummary,
    UnjudgedFilter,
)
from px4fuse.comparison.why_words import the
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import AISLE
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document, who
from px4fuse.report.plan import plan
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    LABEL_WIDTH,
    LEFT,
    MUTED,
    OURS,
    POINTS_PER_HEIGHT,
    RIGHT,
    SEVERITY_COLOURS,
    Cursor,
    page,
)
from px4fuse.report.words import (
    clock_words,
    consequences_words,
    difference_cells,
    error_cells,
    settings_words,
    statement_cells,
    verdict_words,
)

TEXT_X = LEFT + LABEL_WIDTH
# Points before the map, and for the line that says that findings follow
BEFORE_MAP, MORE = 14.0, 13.0
SECOND = 0.5 * (LEFT + RIGHT)  # where the right half of the page begins
TABLE_SIZE = 7.6
# Right (numbers) or left (words) edges of the columns of the other axes, fractions of the page
COLUMNS: tuple[tuple[float, str], ...] = (
    (LEFT, "left"), (TEXT_X, "left"), (0.385, "right"), (0.47, "right"),
    (0.515, "left"), (0.73, "right"), (0.815, "right"), (RIGHT, "right"),
)  # fmt: skip
EXPLANATION = (
    "Mean NIS is 1 where the innovations are as large as a filter's own variance says; below its "
    "95 % band the variance is overstated, above it understated."
)


def draw(document: Document) -> Iterator[Figure]:
    """Draw the cover, and a further page where the findings need one."""
    figure, cursor = page("Two-state Kalman filter against EKF2")
    cursor.write(_subtitle(document), size=8.0, colour=MUTED)
    if document.story:
        cursor.skip(5)
        for sentence in document.story:
            cursor.skip(2)
            cursor.write(sentence, size=10.5)
    cursor.skip(12)
    _verdict(cursor, document)
    _other_axes(cursor, document)
    cursor.skip(10)
    above = plan(document, facts(document))
    cursor.write("Findings", size=10.5, weight="bold")
    if not document.findings:
        cursor.write("None: no detector has anything to say about this flight.")
    room = cursor.y - BOTTOM - above.least(cursor) - BEFORE_MAP / POINTS_PER_HEIGHT
    heights = np.cumsum([_finding_height(cursor, finding) for finding in document.findings])
    fitting = int(np.searchsorted(heights, room))
    if fitting < len(heights):
        fitting = int(np.searchsorted(heights, room - MORE / POINTS_PER_HEIGHT))
    for finding in document.findings[:fitting]:
        write_finding(cursor, finding)
    rest = document.findings[fitting:]
    if rest:
        cursor.skip(3)
        more = f"{len(rest)} of {len(document.findings)} findings: next page."
        cursor.write(more, x=TEXT_X, size=7.5, colour=MUTED)
    cursor.skip(BEFORE_MAP)
    above.draw(cursor)
    yield figure
    if rest:
        yield from _continued(rest)


def _continued(findings: tuple[Finding, ...]) -> Iterator[Figure]:
    figure, cursor = page("Findings, continued")
    for finding in findings:
        if cursor.y - _finding_height(cursor, finding) < BOTTOM:
            yield figure
            figure, cursor = page("Findings, continued")
        write_finding(cursor, finding)
    yield figure


def _subtitle(document: Document) -> str:
    log = document.comparison.flight.log
    about = (log.name, f"{log.duration_s:.1f} s", f"{log.firmware}, {log.hardware}")
    return " · ".join(filter(None, (who(document.student, ", "), *about)))


def _verdict(cursor: Cursor, document: Document) -> None:
    """The main axis, large: each filter on its half of the page."""
    result = document.comparison.main
    along = the(result.axis.name)
    top = cursor.y
    ends = []
    places: tuple[tuple[str, FilterName, str, float, float], ...] = (
        ("our filter's", "kf", OURS, LEFT, SECOND),
        ("EKF2's", "ekf2", EKF2, SECOND, RIGHT),
    )
    for owner, name, colour, left, right in places:
        if name == "ekf2" and isinstance(result.ekf2_state, Unavailable):
            continue
        cursor.y = top
        statement = result.filters[name]
        label = f"Along {along} {owner} variance is"
        shade = colour if isinstance(statement, Consistency) else MUTED
        cursor.write(label, size=8.0, x=left, right=right)
        cursor.write(verdict_words(statement), size=16.0, weight="bold", colour=shade, x=left)
        cursor.skip(2)
        cursor.write(_large_numbers(statement), size=8.0, x=left, right=right - 0.02)
        ends.append(cursor.y)
    cursor.y = min(ends)
    cursor.skip(2)
    if isinstance(result.difference, Difference):
        part = result.difference
        cursor.write(
            f"Ours - EKF2: {' m and '.join(difference_cells(part))} m/s RMS, "
            f"at most {part.position_maximum_m:.2f} m."
            + ("" if document.truth_known else " The log has no truth to say who is right."),
            size=8.0,
        )
    elif isinstance(result.ekf2_state, Unavailable):
        cursor.write(f"There is no EKF2 to compare with: {result.ekf2_state.reason}.", size=8.0)
    cursor.skip(2)
    cursor.write(EXPLANATION, size=7.0, colour=MUTED)


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


def _other_axes(cursor: Cursor, document: Document) -> None:
    """The axes beside the main one, a row each."""
    others = [
        axis for axis in document.analysis.axes.values() if axis is not document.analysis.main
    ]
    if not others:
        return
    to_truth = "to truth (m)" if document.truth_known else ""
    beside = not isinstance(document.comparison.main.ekf2_state, Unavailable)
    names = ("variance", "mean NIS", to_truth)
    blank = ("",) * 3
    cursor.skip(5)
    _row(cursor, ("", "our filter", "", "", "EKF2" if beside else "", "", "", ""), [MUTED] * 8)
    apart = "ours - EKF2 (m)" if beside else ""
    _row(cursor, ("axis", *names, *(names if beside else blank), apart), [MUTED] * 8)
    cursor.skip(2.5)
    cursor.rule()
    colours = ["black", *[OURS] * 3, *[EKF2] * 3, "black"]
    for result in others:
        cells = (
            result.axis.name,
            *_cells(result.filters["kf"]),
            *(_cells(result.filters["ekf2"]) if beside else blank),
            difference_cells(result.difference)[0],
        )
        _row(cursor, cells, colours)


def _row(cursor: Cursor, cells: Sequence[str], colours: Sequence[str]) -> None:
    cursor.y -= TABLE_SIZE * 1.4 / POINTS_PER_HEIGHT
    for (x, align), text, colour in zip(COLUMNS, cells, colours, strict=True):
        if text:
            cursor.figure.text(
                x, cursor.y, text, size=TABLE_SIZE, ha=align, va="baseline", color=colour,
                weight="bold" if text.startswith(("over", "under")) else "normal",
            )  # fmt: skip


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


def _finding_height(cursor: Cursor, finding: Finding) -> float:
    text = sum(cursor.height(part, x=TEXT_X, size=size) for part, size in _finding_parts(finding))
    beside = cursor.height(finding.severity, size=7.5) + cursor.height(
        finding.when, size=6.5, right=TEXT_X - 0.01
    )
    return max(text, beside) + 4.0 / POINTS_PER_HEIGHT


def _finding_parts(finding: Finding) -> list[tuple[str, float]]:
    parts = [(finding.message, 8.0), (finding.remedy, 7.5)]
    return [*parts, (consequences_words(finding), 7.5)] if finding.consequences else parts


def write_finding(cursor: Cursor, finding: Finding) -> None:
    """Write severity, when it shows, sentence and remedy."""
    cursor.skip(4)
    top = cursor.y
    cursor.write(
        finding.severity, size=7.5, weight="bold", colour=SEVERITY_COLOURS[finding.severity]
    )
    if finding.when:
        cursor.write(finding.when, size=6.5, colour=MUTED, right=TEXT_X - 0.01)
    beside, cursor.y = cursor.y, top
    for text, size in _finding_parts(finding):
        cursor.write(text, x=TEXT_X, size=size, colour="black" if size == 8.0 else MUTED)
    cursor.y = min(cursor.y, beside)
