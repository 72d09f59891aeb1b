"""Cover: who, which log, what was compared with what, verdicts and findings."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd
from matplotlib.figure import Figure

from px4fuse.comparison.comparison import AgainstTruth, AxisComparison, Difference, FilterSummary
from px4fuse.filter.consistency import Consistency
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    EKF2_LINE,
    LEFT,
    MEASUREMENT,
    MUTED,
    OURS,
    OURS_LINE,
    POINTS_PER_HEIGHT,
    RIGHT,
    SEVERITY_COLOURS,
    Cursor,
    page,
)
from px4fuse.report.words import (
    clock_words,
    consequences_words,
    settings_words,
    verdict_notes,
    verdict_words,
)

LABEL_WIDTH = 0.115
PLAN_MIN_HEIGHT = 0.27
TABLE_SIZE = 7.6
# Right (numbers) or left (words) edges of the verdict table's columns, fractions of the page
COLUMNS = (
    ("axis", LEFT, "left"),
    ("filter", 0.150, "left"),
    ("n", 0.262, "right"),
    ("mean NIS", 0.345, "right"),
    ("95 % band", 0.440, "right"),
    ("innovation variance", 0.460, "left"),
    ("√S", 0.665, "right"),
    ("std ν", 0.725, "right"),
    ("σ_p", 0.783, "right"),
    ("p RMSE", 0.866, "right"),
    ("v RMSE", RIGHT, "right"),
)


def draw(document: Document) -> Iterator[Figure]:
    """Draw the cover, and a further page where the findings need one."""
    comparison = document.comparison
    figure, cursor = page("Two-state Kalman filter against EKF2")
    _facts(cursor, document)
    cursor.skip(8)
    cursor.write("Verdict", size=10.5, weight="bold")
    cursor.skip(3)
    _verdicts(figure, cursor, document)
    cursor.skip(3)
    truth = comparison.flight.truth
    against = (
        "RMSE of the rows ours and EKF2 is against ground truth, of ours - EKF2 between the two. "
        if not isinstance(truth, Unavailable)
        else "RMSE is between the two filters at EKF2's sample times; the log has no ground truth. "
    )
    cursor.write(
        "Mean NIS is 1 when a filter's innovations ν are as large as its own variance S says; "
        "below the band S is overstated, above it understated, by the factor given. "
        f"{against}√S, std ν, σ_p and p RMSE in m, v RMSE in m/s.",
        size=7,
        colour=MUTED,
    )
    for note in verdict_notes(comparison):
        cursor.write(note, size=7)
    cursor.skip(8)
    cursor.write("Findings", size=10.5, weight="bold")
    cursor.skip(2)
    if not document.findings:
        cursor.write("None: no detector has anything to say about this flight.")
    for finding in document.findings:
        if cursor.y - _finding_height(cursor, finding) < BOTTOM:
            yield figure
            figure, cursor = page("Findings, continued")
        write_finding(cursor, finding)
    _plan(figure, cursor, document)
    yield figure


def _plan(figure: Figure, cursor: Cursor, document: Document) -> None:
    """The flight from above, where the page has room for it."""
    room = cursor.y - BOTTOM
    axes_of = {result.axis.name: result for result in document.comparison.axes}
    if room < PLAN_MIN_HEIGHT or not {"north", "east"} <= axes_of.keys():
        return
    cursor.skip(14)
    cursor.write("From above", size=10.5, weight="bold")
    bottom = BOTTOM + 0.04
    axes = figure.add_axes((LEFT + 0.03, bottom, RIGHT - LEFT - 0.03, cursor.y - 0.01 - bottom))
    north, east = axes_of["north"], axes_of["east"]
    axes.plot(east.axis.measurement_m, north.axis.measurement_m, ".", color=MEASUREMENT, ms=1.8,
              mew=0, label="measurement")  # fmt: skip
    if isinstance(north.ekf2_state, pd.DataFrame) and isinstance(east.ekf2_state, pd.DataFrame):
        axes.plot(
            east.ekf2_state["position_m"], north.ekf2_state["position_m"], **EKF2_LINE, label="EKF2"
        )
    axes.plot(
        east.replay.steps["position_m"], north.replay.steps["position_m"], **OURS_LINE, label="ours"
    )
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.set_xlabel("east (m)")
    axes.set_ylabel("north (m)")
    axes.legend(loc="upper right", markerscale=3.0)


def _facts(cursor: Cursor, document: Document) -> None:
    comparison = document.comparison
    log, source, segment = comparison.flight.log, comparison.source, comparison.segment
    files = comparison.flight.inputs
    who = ", ".join(part for part in (document.student.name, document.student.id) if part)
    looked = [
        part.what.removeprefix("position source ")
        for part in comparison.missing
        if part.what == "position source vehicle_visual_odometry"
    ]
    source_text = (
        f"{source.name}: {source.description}, {source.rate_hz:.1f} Hz, {source.frame}; "
        f"{comparison.source_reason}"
    )
    if looked:
        source_text += ". SDLOG_PROFILE 129 would have logged it as it arrived"
    facts = [
        ("Student", who),
        ("Log", f"{log.name}, {log.size_bytes / 1e6:.2f} MB, {log.duration_s:.1f} s of data"),
        ("SHA-256", log.sha256),
        ("With", ", ".join(f"{f.name}, SHA-256 {f.sha256[:12]}…" for f in files)),
        ("Vehicle", f"{log.firmware}, {log.hardware}"),
        ("Position", source_text),
        ("Clock", _clock(document)),
        ("Segment", f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}"),
        ("Our filter", settings_words(comparison.settings)),
    ]
    aisle = next((a.axis for a in comparison.axes if a.axis.name == "aisle"), None)
    if aisle is not None:
        facts.append(("Aisle", f"{aisle.heading_deg:.1f}° from north ({aisle.note})"))
    for label, text in facts:
        if not text:
            continue
        top = cursor.y
        cursor.write(label, weight="bold", right=LEFT + LABEL_WIDTH)
        cursor.y = top
        cursor.write(text, x=LEFT + LABEL_WIDTH)


def _clock(document: Document) -> str:
    """Clock of the source, where it was mapped or matched here."""
    source = document.comparison.source
    if source.clock_map is not None:
        return clock_words(source.clock_map)
    return "" if source.alignment is None else source.clock


def _verdicts(figure: Figure, cursor: Cursor, document: Document) -> None:
    comparison = document.comparison
    _table_row(figure, cursor, [name for name, _, _ in COLUMNS], colour=MUTED)
    cursor.skip(2.5)
    cursor.rule()
    for result in comparison.axes:
        _table_row(
            figure, cursor, [result.axis.name, "ours", *_cells(result.kf, result.kf_truth)], OURS
        )
        if isinstance(result.ekf2, Unavailable):
            _table_row(figure, cursor, ["", "EKF2", "", "", "", "not available"], EKF2)
        else:
            _table_row(figure, cursor, ["", "EKF2", *_cells(result.ekf2, result.ekf2_truth)], EKF2)
            _table_row(figure, cursor, ["", "ours - EKF2", *[""] * 7, *_difference(result)], MUTED)
        cursor.skip(2.5)
        cursor.rule("#dddddd")


def _table_row(figure: Figure, cursor: Cursor, cells: list[str], colour: str) -> None:
    cursor.y -= TABLE_SIZE * 1.4 / POINTS_PER_HEIGHT
    for (name, x, align), text in zip(COLUMNS, cells, strict=False):
        weight = "bold" if name == "axis" or text.startswith(("over", "under")) else "normal"
        figure.text(
            x, cursor.y, text, size=TABLE_SIZE, ha=align, va="baseline", weight=weight,
            color="black" if name == "axis" else colour,
        )  # fmt: skip


def _cells(summary: FilterSummary, truth: AgainstTruth | Unavailable) -> list[str]:
    statement = summary.consistency
    errors = ["", ""]
    if isinstance(truth, AgainstTruth):
        velocity = truth.velocity_rmse_m_s
        errors = [f"{truth.position_rmse_m:.3f}", "" if velocity is None else f"{velocity:.3f}"]
    sigma = "" if summary.sigma_p_median_m is None else f"{summary.sigma_p_median_m:.3f}"
    if not isinstance(statement, Consistency):
        return ["", "", "", verdict_words(statement), "", "", sigma, *errors]
    low, high = statement.nis_band
    return [
        f"{statement.count}",
        f"{statement.nis_mean:.3g}",
        f"{low:.2f} – {high:.2f}",
        verdict_words(statement),
        f"{statement.sqrt_s_median_m:.3f}",
        f"{statement.innovation_std_m:.3f}",
        sigma,
        *errors,
    ]


def _difference(result: AxisComparison) -> list[str]:
    if not isinstance(result.difference, Difference):
        return ["", ""]
    return [
        f"{result.difference.position_rmse_m:.3f}",
        f"{result.difference.velocity_rmse_m_s:.3f}",
    ]


_TEXT_X = LEFT + 0.085


def _finding_height(cursor: Cursor, finding: Finding) -> float:
    text = cursor.height(finding.message, x=_TEXT_X) + cursor.height(
        finding.remedy, x=_TEXT_X, size=7.5
    )
    if finding.consequences:
        text += cursor.height(consequences_words(finding), x=_TEXT_X, size=7.5)
    return text + 12.0 / POINTS_PER_HEIGHT


def write_finding(cursor: Cursor, finding: Finding) -> None:
    """Write severity, sentence and remedy."""
    cursor.skip(3)
    top = cursor.y
    cursor.write(
        finding.severity, size=7.5, weight="bold", colour=SEVERITY_COLOURS[finding.severity]
    )
    cursor.y = top
    cursor.write(finding.message, x=_TEXT_X)
    cursor.write(finding.remedy, x=_TEXT_X, size=7.5, colour=MUTED)
    if finding.consequences:
        cursor.write(consequences_words(finding), x=_TEXT_X, size=7.5, colour=MUTED)
