"""Loop: the path before and after, the closure error, and scores of every correction."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.findings import Finding, by_root
from px4fuse.flight import Unavailable
from px4fuse.loop import corrections
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.loop.corrections import SINGLE_LOOP
from px4fuse.loop.model import LANDING, Closure, CorrectedPath, Loop
from px4fuse.plain import capital, p_words
from px4fuse.report import say, style
from px4fuse.report.cover import who, write_finding
from px4fuse.report.evaluation import interval_words, score_words, way
from px4fuse.report.page import AXIS_LABEL, TICKS, Cell, Page, appendix
from px4fuse.report.style import EKF2, LINES, MUTED, OURS, Axes, as_map
from px4fuse.results.contract import LoopResults
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import MANY_CLOSURES, SOLUTIONS, SolvedGraph
from px4fuse.trajectory.graph.covariance import GATE_ALPHA
from px4fuse.trajectory.model import AXES_OF_FRAME, in_words
from px4fuse.trajectory.scores import Interval, Statistics

MOST_ROWS = 10  # of rejected closures
GREEN, RED = "#3a7d5c", style.SEVERITY_COLOURS["error"]
STYLES: Mapping[str, dict[str, Any]] = {
    corrections.UNCORRECTED: {"color": EKF2, "lw": 1.1, "ls": (0, (4, 1.6))},
    corrections.PLAIN: {"color": "#79b294", "lw": 1.3, "ls": (0, (1.2, 1.2))},
    corrections.BY_DISTANCE: {"color": GREEN, "lw": 1.0, "ls": (0, (6, 1.2, 1, 1.2))},
    SOLUTIONS["gated"]: {"color": OURS, "lw": 1.2, "ls": "-"},
    SOLUTIONS["all"]: {"color": "#8d6a9f", "lw": 0.9, "ls": (0, (2, 1))},
}
KINDS = {
    "vio": "odometry (external vision)",
    "ekf2": "EKF2's track",
    "kf": "our filter's track",
    "truth": "ground truth",
    "slam": "a SLAM system's trajectory",
    "unknown": "a trajectory",
}
CLOSURE_HEAD = (
    "same place at",
    "missed\nby (m)",
    "d²",
    "dof",
    "p",
    "gate",
    "DCS\nweight",
    "GNC\nweight",
)
TITLE = "Loop closure"
MAP_POINTS = 2000
MAP, LEGEND = 290.0, 38.0  # of the axes, and of the legend below them, in points


def draw(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the loop's page; none where the flight holds no loop."""
    if isinstance(analysis.loop, Loop):
        page = Page(appendix(TITLE), say("loop"))
        _write(page, analysis.loop)
        yield page


def draw_report(loop: Loop, results: LoopResults) -> Iterator[Page]:
    """Draw the page of a report on a loop alone, with its findings."""
    page = Page(TITLE, say("loop"))
    if student := who(results.student, ", "):
        page.labelled("Student", student)
    page.labelled("SHA-256", loop.odometry.trajectory.sha256)
    _write(page, loop, results.findings)
    yield page


def _write(page: Page, loop: Loop, findings: tuple[Finding, ...] = ()) -> None:
    """Write what was found, the map, and the scores; as many sheets as that takes."""
    write_loop(page, loop, findings)
    _map(page, loop)
    page.heading("Closures and scores", 10.5, above=14.0)
    page.write(say("closures"), colour=MUTED)
    write_scores(page, loop)


def shown(loop: Loop) -> list[CorrectedPath]:
    """The paths that are drawn: each kind of correction once."""
    return [part for part in loop.reported if part.name in STYLES]


def _map(page: Page, loop: Loop) -> None:
    axes = page.panel("From above, in the odometry's frame", "", MAP, left=36.0, below=LEGEND)
    draw_map(axes, loop)
    below = -(TICKS + AXIS_LABEL + 2.0) / MAP
    axes.legend(loc="upper left", ncols=4, borderaxespad=0.0, bbox_to_anchor=(0.0, below))


def draw_map(axes: Axes, loop: Loop) -> None:
    """Every path from above, where it ended, and where it should have."""
    path = loop.odometry.trajectory
    names = AXES_OF_FRAME[path.frame]
    _reference(axes, loop)
    for part in shown(loop):
        position = part.trajectory.position_m[:: max(1, len(part.trajectory) // MAP_POINTS)]
        axes.plot(position[:, 1], position[:, 0], label=part.name, **STYLES[part.name])
    start, end = path.position_m[[0, -1]][:, (1, 0)]
    axes.plot(*start, "o", color="black", ms=5, label="start", zorder=5)
    axes.plot(*end, "s", color=EKF2, mec="black", mew=0.6, ms=5, label="end by odometry", zorder=5)
    if loop.closure_error_axes_m is not None:
        true = end - np.array(list(loop.closure_error_axes_m.values()))[[1, 0]]
        arrow = {"arrowstyle": "->", "color": RED, "lw": 1.2, "shrinkA": 3, "shrinkB": 0}
        axes.annotate("", xy=true, xytext=end, zorder=6, arrowprops=arrow)
        axes.plot([], [], color=RED, lw=1.2, label=f"gap {loop.closure_error_m:.2f} m")
        axes.plot(*true, "x", color=RED, ms=5, mew=1.2, zorder=6, label="where it really ended")
    as_map(axes, names[1], names[0])


def _reference(axes: Axes, loop: Loop) -> None:
    """The first reference in the odometry's frame, placed by the best correction there is."""
    for reference in loop.references[:1]:
        score = loop.best.scores.get(reference.name)
        if isinstance(score, Evaluation):
            at = score.transform.undo(score.reference_m)[:, (1, 0)]
            way(axes, at, score.time_s, label=reference.name, **LINES["truth"], zorder=4)


# ---------------------------------------------------------------------------------------- words


def summary(loop: Loop, findings: tuple[Finding, ...]) -> Page:
    """What was found about a loop."""
    page = Page()
    write_loop(page, loop)
    write_scores(page, loop)
    for group in by_root(findings):
        write_finding(page, group)
    return page


def write_loop(page: Page, loop: Loop, findings: tuple[Finding, ...] = ()) -> None:
    """Write what was found, with every path, how far it moved, and its ATE to each reference."""
    path = loop.odometry.trajectory
    told = say("loop_track", path=path, kind=KINDS[path.kind], poses=len(path), loop=loop)
    page.labelled("Track", told)
    page.labelled("Part", f"{_span(loop)}, {loop.part_reason}")
    page.labelled("Closure", closure_words(loop))
    end = loop.known_end
    page.labelled("End", "not used" if isinstance(end, Unavailable) else end.source)
    for closure in loop.closures[:1]:
        page.labelled("Gate", gate_words(closure))
    single = SINGLE_LOOP if len(loop.closures) == 1 else ""
    for text in (by_distance_words(loop), single, *refusals(loop)):
        page.write(text, colour=MUTED, above=2.0)
    for group in by_root(findings):
        write_finding(page, group)
    names = [reference.name for reference in loop.references]
    page.table(
        ["path", "moved RMS\n/ max (m)", *(f"ATE to\n{name} (m)" for name in names)],
        [
            [part.name, moved_words(part), *(_ate(part.scores[name]) for name in names)]
            for part in loop.reported
        ],
    )
    page.numbers(say("ate") if names else say("no_reference"))


def write_scores(page: Page, loop: Loop) -> None:
    """Write every closure with its gate and weights, RPE, and how scores were made."""
    rows: list[list[Cell]] = []
    for closure in loop.closures:
        cells = [
            closure_name(closure, loop),
            f"{closure.distance_m:.2f}",
            f"{closure.d2:.1f}",
            f"{closure.degrees_of_freedom}",
            p_words(closure.p).removeprefix("p "),
            "accepted" if closure.accepted else "REJECTED",
        ]
        weights = closure.weight_dcs, closure.weight_gnc
        cells += ["–" if weight is None else f"{weight:.2f}" for weight in weights]
        colour = "black" if closure.accepted else style.SEVERITY_COLOURS["error"]
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
        page.table(
            head,
            [
                [
                    name,
                    *(_error(e.translation_m, e.interval_m) for e in score.rpe),
                    _rmse(score.ate.rotation_deg, 2),
                ]
                for name, score in known.items()
            ],
        )
        for text in (score_words(first), *first.notes, *first.warnings):
            page.numbers(capital(text))


def _span(part: Loop) -> str:
    if part.start_s > SMALLEST_STAMP_S:
        return f"{part.end_s - part.start_s:.1f} s from stamp {part.start_s:.2f} s"
    return f"{part.start_s:.1f} s to {part.end_s:.1f} s"


def closure_words(loop: Loop) -> str:
    """The closure error in m, in percent, per axis and in heading."""
    error, misclosure = loop.closure_error_m, loop.closure_error_axes_m
    if error is None or misclosure is None:
        return f"path {loop.path_length_m:.1f} m; no closure error is stated: it did not come back"
    text = (
        f"{error:.2f} m after {loop.path_length_m:.1f} m = {error / loop.path_length_m:.2%} "
        f"({in_words(misclosure)})"
    )
    turned = loop.heading_error_deg
    if isinstance(turned, Unavailable):
        return f"{text}; heading: not known, {turned.reason}"
    return f"{text}; heading {turned:+.1f}°"


def gate_words(closure: Closure) -> str:
    """What the gate says about one closure."""
    verdict = "as the stated drift allows"
    if not closure.accepted:
        verdict = "REJECTED: the drift cannot explain it"
    return say("gate", closure=closure, least=GATE_ALPHA, verdict=verdict)


def closure_name(closure: Closure, loop: Loop) -> str:
    """Which closure; long stamps count from the first pose."""
    if closure.source == LANDING:
        return "take-off and landing"
    zero = loop.start_s if loop.start_s > SMALLEST_STAMP_S else 0.0
    return f"{closure.time_1_s - zero:.2f} s and {closure.time_2_s - zero:.2f} s"


def by_distance_words(loop: Loop) -> str:
    """What the corrections by distance are; nothing where there is none."""
    if "by_distance_plain" not in loop.paths:
        return ""
    turned = loop.heading_error_deg
    headings = "Headings too: each step is first turned back by its share of the heading error."
    if isinstance(turned, Unavailable):
        headings = f"Headings are not turned: {turned.reason}."
    return say("by_distance", headings=headings)


def refusals(loop: Loop) -> list[str]:
    """Why a correction is missing, each reason once."""
    parts = [p for p in loop.corrections.values() if isinstance(p, Unavailable)]
    reasons = [f"{p.what}: {p.reason}" for p in parts]
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


def moved_words(correction: CorrectedPath) -> str:
    """How far the poses moved."""
    if not correction.moved_max_m:
        return "–"
    return f"{correction.moved_rms_m:.2f} / {correction.moved_max_m:.2f}"


def graph_summary(solved: SolvedGraph) -> Page:
    """How a pose graph was solved, and the closures that the gate rejects."""
    page = Page()
    page.labelled("Graph", say("graph", solved=solved))
    gates = solved.gates
    if isinstance(gates, Unavailable):
        page.labelled("Gate", f"none: {gates.reason}")
    elif not gates:
        page.labelled("Gate", "no closures to judge: every edge is odometry")
    else:
        rejected = [gate for gate in gates if not gate.accepted]
        said = [f"{g.first} – {g.second}: d² {g.d2:.1f}, p {g.p:.2g}" for g in rejected[:MOST_ROWS]]
        said += [f"and {len(rejected) - MOST_ROWS} more"] if len(rejected) > MOST_ROWS else []
        page.labelled("Gate", f"rejects {len(rejected)} of {len(gates)} closures", *said)
    if len(solved.solutions) == 1 and (~solved.graph.successive).sum() > MANY_CLOSURES:
        page.labelled("Robust", "left out for so many closures: --robust takes minutes")
    unsolved = [SOLUTIONS[key] for key, one in solved.solutions.items() if not one.converged]
    if unsolved:
        page.labelled(
            "Solver", f"not converged: {', '.join(unsolved)}. Its cost is not the minimum"
        )
    rows = [
        [
            SOLUTIONS[key],
            f"{solution.cost_initial:.6g}",
            f"{solution.cost:.6g}",
            f"{solution.iterations}" + ("" if solution.converged else " (not converged)"),
            "" if key == "all" else f"{solution.dropped}",
        ]
        for key, solution in solved.solutions.items()
    ]
    head = ("path", "cost before", "cost", "iterations", "closures dropped")
    page.table(head, rows, right=(1, 2, 3, 4))
    return page
