"""What there is to say about a loop, in words and tables, for the terminal and the PDF."""

from __future__ import annotations

import numpy as np

from px4fuse.filter.signals import Segment
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.loop.corrections import SINGLE_LOOP, Correction, Judged
from px4fuse.loop.loop import Loop
from px4fuse.plain import capital, p_words
from px4fuse.report.cover import write_finding
from px4fuse.report.page import Cell, Page
from px4fuse.report.style import MUTED, SEVERITY_COLOURS
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import GATE_ALPHA
from px4fuse.trajectory.model import AXES_OF_FRAME, Trajectory
from px4fuse.trajectory.scores import Interval, Statistics

KINDS = {
    "vio": "odometry (external vision)",
    "ekf2": "EKF2's track",
    "kf": "our filter's track",
    "truth": "ground truth",
    "slam": "a SLAM system's trajectory",
    "unknown": "a trajectory",
}
CLOSURE_HEAD = (
    "same place at", "missed\nby (m)", "d²", "dof", "p", "gate", "DCS\nweight", "GNC\nweight",
)  # fmt: skip


def write_loop(page: Page, loop: Loop, findings: tuple[Finding, ...] = ()) -> None:
    """Write what was found, with every path, how far it moved, and its ATE to each reference."""
    path = loop.odometry.trajectory
    page.labelled(
        "Track",
        f"{path.name}: {KINDS[path.kind]}, {len(path)} poses, {len(loop.nodes)} key frames "
        f"{loop.spacing_m:.2g} m apart",
    )
    page.labelled("Part", f"{_span(loop.segment)}, {loop.segment.reason}")
    page.labelled("Closure", closure_words(loop))
    end = loop.known_end
    page.labelled("End", "not used" if isinstance(end, Unavailable) else end.source)
    for judged in loop.closures[:1]:
        page.labelled("Gate", gate_words(judged))
    for text in (by_distance_words(loop), *redundancy_words(loop), *refusals(loop)):
        page.write(text, colour=MUTED, above=2.0)
    for finding in findings:
        write_finding(page, finding)
    names = [reference.name for reference in loop.references]
    page.table(
        ["path", "moved RMS\n/ max (m)", *(f"ATE to\n{name} (m)" for name in names)],
        [
            [part.name, moved_words(part), *(_ate(part.scores[name]) for name in names)]
            for part in loop.reported
        ],
    )
    page.numbers(
        "ATE is the RMSE of position after alignment, in brackets its 95 % interval by block "
        "bootstrap where the flight is long enough for one."
        if names
        else "Neither ground truth nor a SLAM trajectory is given, so that no error of the path "
        "can be stated; --reference FILE scores it."
    )


def write_scores(page: Page, loop: Loop) -> None:
    """Write every closure with its gate and weights, RPE, and how scores were made."""
    rows: list[list[Cell]] = []
    for judged in loop.closures:
        gate = judged.gate
        cells = [
            closure_name(judged, loop), f"{judged.distance_m:.2f}", f"{gate.d2:.1f}",
            f"{gate.degrees_of_freedom}", p_words(gate.p).removeprefix("p "),
            "accepted" if gate.accepted else "REJECTED",
        ]  # fmt: skip
        weights = (judged.weights.get(name) for name in ("dcs", "gnc"))
        cells += ["–" if weight is None else f"{weight:.2f}" for weight in weights]
        colour = "black" if gate.accepted else SEVERITY_COLOURS["error"]
        rows.append([(cell, colour) for cell in cells])
    if rows:
        page.table(CLOSURE_HEAD, rows, right=(1, 2, 3, 4, 6, 7))
    for reference in loop.references:
        scores = {part.name: part.scores[reference.name] for part in loop.reported}
        known = {name: score for name, score in scores.items() if isinstance(score, Evaluation)}
        page.heading(f"RPE against {reference.name}", 10.5, above=14.0)
        missing = (score.reason for score in scores.values() if isinstance(score, Unavailable))
        for reason in dict.fromkeys(missing):
            page.write(reason, size=7.5)
        if not known:
            continue
        first = next(iter(known.values()))
        head = ["path", *(f"{e.delta_words} (m)" for e in first.rpe), "rotation (°)"]
        page.table(head, [
            [name, *(_error(e.translation_m, e.interval_m) for e in score.rpe),
             _rmse(score.ate.rotation_deg, 2)]
            for name, score in known.items()
        ])  # fmt: skip
        for text in (score_words(first), *first.notes, *first.warnings):
            page.numbers(capital(text))


def _span(part: Segment) -> str:
    if part.start_s > SMALLEST_STAMP_S:
        return f"{part.end_s - part.start_s:.1f} s from stamp {part.start_s:.2f} s"
    return f"{part.start_s:.1f} s to {part.end_s:.1f} s"


def closure_words(loop: Loop) -> str:
    """The closure error in m, in percent, per axis and in heading."""
    error, misclosure = loop.closure_error_m, loop.misclosure_m
    if error is None or isinstance(misclosure, Unavailable):
        return f"path {loop.path_length_m:.1f} m; no closure error is stated: it did not come back"
    named = zip(AXES_OF_FRAME[loop.odometry.trajectory.frame], misclosure, strict=True)
    text = (
        f"{error:.2f} m after {loop.path_length_m:.1f} m = {error / loop.path_length_m:.2%} "
        f"({', '.join(f'{name} {part:+.2f} m' for name, part in named)})"
    )
    turned = loop.misclosure_heading_deg
    if isinstance(turned, Unavailable):
        return f"{text}; heading: not known, {turned.reason}"
    return f"{text}; heading {turned:+.1f}°"


def gate_words(judged: Judged) -> str:
    """What the gate says about one closure."""
    gate = judged.gate
    verdict = (
        "as the stated drift allows" if gate.accepted else "REJECTED: the drift cannot explain it"
    )
    return (
        f"d² {gate.d2:.1f} with {gate.degrees_of_freedom} degrees of freedom, p {gate.p:.2g} "
        f"(rejected below {GATE_ALPHA:g}): {verdict}"
    )


def closure_name(judged: Judged, loop: Loop) -> str:
    """Which closure; long stamps count from the first pose."""
    closure = judged.closure
    if closure.source == "landing":
        return "take-off and landing"
    start = loop.segment.start_s
    zero = start if start > SMALLEST_STAMP_S else 0.0
    return f"{closure.time_1_s - zero:.2f} s and {closure.time_2_s - zero:.2f} s"


def by_distance_words(loop: Loop) -> str:
    """What the corrections by distance are; nothing where there is none."""
    if isinstance(loop.plain, Unavailable):
        return ""
    example = (
        "By distance, positions only, is the lesson's Example 2: each position moves by its share "
        "of the gap, and the path keeps the bend of its headings."
    )
    turned = loop.misclosure_heading_deg
    if isinstance(turned, Unavailable):
        return f"{example} Headings are not turned: {turned.reason}."
    return (
        f"{example} Headings too: each step is first turned back by its share of the {turned:+.1f}°"
        " that the heading is off at the end, and what is left of the gap is spread as before."
    )


def redundancy_words(loop: Loop) -> list[str]:
    """That one loop has no redundancy, or nothing."""
    return [SINGLE_LOOP] if len(loop.closures) == 1 else []


def refusals(loop: Loop) -> list[str]:
    """Why a correction is missing, each reason once."""
    parts = (loop.by_distance, *loop.solved.values())
    reasons = [f"{p.what}: {p.reason}" for p in parts if isinstance(p, Unavailable)]
    return [r for r in dict.fromkeys(reasons) if SINGLE_LOOP not in r]


def _ate(score: Evaluation | Unavailable) -> str:
    if isinstance(score, Unavailable):
        return "–"
    return _error(score.ate.translation_m, score.ate.interval_m)


def _error(moved: Statistics | Unavailable, interval: Interval | Unavailable) -> str:
    """RMSE of an error, in brackets its interval where there is one."""
    within = interval_words(interval)
    return _rmse(moved) + (f" ({within})" if within else "")


def _rmse(found: Statistics | Unavailable, digits: int = 3) -> str:
    return f"{found.rmse:.{digits}f}" if isinstance(found, Statistics) else "–"


def interval_words(interval: Interval | Unavailable) -> str:
    """An interval; nothing where there is none."""
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, Interval) else ""


def moved_words(correction: Correction) -> str:
    """How far the poses moved."""
    if not correction.moved_m.any():
        return "–"
    return f"{np.sqrt(np.mean(correction.moved_m**2)):.2f} / {correction.moved_m.max():.2f}"


def track_words(path: Trajectory) -> str:
    """A trajectory by its name, what it is, its length in time and its frame."""
    return (
        f"{path.name}: {path.kind}, {len(path)} poses over "
        f"{path.time_s[-1] - path.time_s[0]:.1f} s, frame {path.frame}"
    )


def score_words(score: Evaluation) -> str:
    """How a score was made, in one sentence."""
    matched = score.association
    offset = score.time_offset.offset_s
    clock = "" if not offset else f"; clocks matched by {offset:+.3f} s"
    return (
        f"alignment {score.alignment} ({score.alignment_reason.rstrip('.')}); "
        f"{len(matched)} poses, "
        f"{matched.coverage_estimate:.0%} of the estimate, {matched.coverage_reference:.0%} of the "
        f"reference's time{clock}"
    )
