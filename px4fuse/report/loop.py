"""Loop: the path before and after, the closure error, and scores of every correction."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from px4fuse.findings import Finding, by_root
from px4fuse.flight import Unavailable
from px4fuse.loop.corrections import BY_DISTANCE, PLAIN, UNCORRECTED
from px4fuse.loop.loop import Loop
from px4fuse.loop.model import CorrectedPath
from px4fuse.plain import capital, p_words
from px4fuse.report.cover import write_finding
from px4fuse.report.document import Document, LoopDocument
from px4fuse.report.evaluation import way
from px4fuse.report.loop_words import (
    ate_words,
    by_distance_words,
    closure_name,
    loop_lines,
    moved_words,
    redundancy_words,
    refusals,
    score_words,
    statistics_words,
)
from px4fuse.report.page import AXIS_LABEL, TICKS, Cell, Page, appendix, legend_above
from px4fuse.report.style import EKF2, MUTED, OURS, SEVERITY_COLOURS, TRUTH_LINE, bare_x, thin
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.graph.analysis import SOLUTIONS
from px4fuse.trajectory.model import AXES_OF_FRAME
from px4fuse.trajectory.scores import RelativeError

GREEN = "#3a7d5c"
STYLES: Mapping[str, dict[str, Any]] = {
    UNCORRECTED: {"color": EKF2, "lw": 1.1, "ls": (0, (4, 1.6))},
    PLAIN: {"color": "#79b294", "lw": 1.3, "ls": (0, (1.2, 1.2))},
    BY_DISTANCE: {"color": GREEN, "lw": 1.0, "ls": (0, (6, 1.2, 1, 1.2))},
    SOLUTIONS["gated"]: {"color": OURS, "lw": 1.2, "ls": "-"},
    SOLUTIONS["all"]: {"color": "#8d6a9f", "lw": 0.9, "ls": (0, (2, 1))},
}
MAP_POINTS = 2000
MAP, HEIGHT, LEGEND = 290.0, 105.0, 30.0  # of the axes, and of a legend, in points


def draw(document: Document) -> Iterator[Page]:
    """Draw the loop's pages; none where the flight holds no loop."""
    loop = document.analysis.loop
    if isinstance(loop, Loop):
        yield from draw_loop(loop, name=appendix)


def draw_report(document: LoopDocument) -> Iterator[Page]:
    """Draw the pages of a report on a loop alone, its findings on the first."""
    yield from draw_loop(document.loop, document.findings, document.facts)


def draw_loop(
    loop: Loop,
    findings: tuple[Finding, ...] = (),
    facts: tuple[tuple[str, str], ...] = (),
    name: Callable[[str], str] = str,
) -> Iterator[Page]:
    """Draw the pages about one loop, their titles made by ``name``."""
    page = Page(
        name("Loop closure"),
        "A path that truly returns must close; the gap is what the odometry drifted. Each "
        "correction spreads it over the path: by distance (positions only as in the lesson's "
        "Example 2, or headings too), or as a pose graph weighs it. A closure "
        "that is not true would warp the whole path, so that each one is tested before its use.",
    )
    for label, text in (*facts, *loop_lines(loop)):
        page.labelled(label, text)
    for text in (by_distance_words(loop), redundancy_words(loop), *refusals(loop)):
        page.write(text, colour=MUTED, above=2.0)
    for group in by_root(findings):
        write_finding(page, group)
    page.skip(6.0)
    _table(page, loop)
    _map(page, loop)
    yield page
    page = Page(
        name("Along the path"),
        "How far each correction moved each pose, and how far the path is from the reference after "
        "alignment. A correction that helps brings the error down along most of the path, not only "
        "at its end.",
    )
    _along(page, loop)
    yield page
    yield _scores(loop, name)


def _table(page: Page, loop: Loop) -> None:
    """Every path with how far it moved and its ATE against each reference."""
    references = [reference.name for reference in loop.references]
    page.table(
        ["path", "moved RMS / max (m)", *(f"ATE to {name} (m)" for name in references)],
        [
            [part.name, moved_words(part), *(ate_words(part.scores[name]) for name in references)]
            for part in loop.reported
        ],
    )
    page.numbers(
        "ATE is the RMSE of position after alignment, in brackets its 95 % interval by block "
        "bootstrap where the flight is long enough for one."
        if references
        else "Neither ground truth nor a SLAM trajectory is given, so that no error of the path "
        "can be stated; --reference FILE scores it."
    )


def shown(loop: Loop) -> list[CorrectedPath]:
    """The paths that are drawn: each kind of correction once."""
    return [part for part in loop.reported if part.name in STYLES]


def _map(page: Page, loop: Loop) -> None:
    title = "From above, in the odometry's frame"
    axes = page.panel(title, "", MAP, left=36.0, below=LEGEND)
    path = loop.odometry.trajectory
    names = AXES_OF_FRAME[path.frame]
    _reference(axes, loop)
    for part in shown(loop):
        position = part.trajectory.position_m[:: max(1, len(part.trajectory) // MAP_POINTS)]
        axes.plot(position[:, 1], position[:, 0], label=part.name, **STYLES[part.name])
    start, end = path.position_m[0], path.position_m[-1]
    axes.plot(start[1], start[0], "o", color="black", ms=5, label="start", zorder=5)
    axes.plot(end[1], end[0], "s", color=EKF2, mec="black", mew=0.6, ms=5,
              label="end by odometry", zorder=5)  # fmt: skip
    if loop.closure_error_axes_m is not None:
        true = end - np.array(list(loop.closure_error_axes_m.values()))
        axes.annotate(
            "", xy=(true[1], true[0]), xytext=(end[1], end[0]), zorder=6,
            arrowprops={"arrowstyle": "->", "color": "#a61b1b", "lw": 1.2, "shrinkA": 3,
                        "shrinkB": 0},
        )  # fmt: skip
        axes.plot([], [], color="#a61b1b", lw=1.2, label=f"gap {loop.closure_error_m:.2f} m")
        axes.plot(true[1], true[0], "x", color="#a61b1b", ms=5, mew=1.2, zorder=6,
                  label="where it really ended")  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.grid(True, axis="both")
    axes.set_xlabel(f"{names[1]} (m)")
    axes.set_ylabel(f"{names[0]} (m)")
    axes.legend(
        loc="upper left", ncols=4, borderaxespad=0.0,
        bbox_to_anchor=(0.0, -(TICKS + AXIS_LABEL + 2.0) / MAP),
    )  # fmt: skip


def _reference(axes: Axes, loop: Loop) -> None:
    """The reference in the odometry's frame, placed by the best correction there is."""
    for name in (reference.name for reference in loop.references):
        for part in reversed(shown(loop)):
            score = part.scores.get(name)
            if not isinstance(score, Evaluation):
                continue
            position = score.transform.undo(score.reference_m)
            way(axes, position[:, (1, 0)], score.time_s, label=name, **TRUTH_LINE, zorder=4)
            return


def _along(page: Page, loop: Loop) -> None:
    scored = [name for name in (reference.name for reference in loop.references)
              if isinstance(loop.odometry.scores[name], Evaluation)]  # fmt: skip
    corrected = [part for part in shown(loop) if part is not loop.odometry]
    every: list[Axes] = []

    def panel(title: str) -> Axes:
        axes = page.panel(title, "", HEIGHT, above=4.0 if every else 14.0)
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.set_xlim(0.0, loop.path_length_m)
        every.append(axes)
        return axes

    axes = panel(f"{capital(AXES_OF_FRAME[loop.odometry.trajectory.frame][2])} (m)")
    for part in shown(loop):
        axes.plot(*thin(loop.distance_m, part.trajectory.position_m[:, 2]), label=part.name,
                  **STYLES[part.name])  # fmt: skip
    legend_above(axes)
    if corrected:
        axes = panel("How far each pose moved (m)")
        for part in corrected:
            axes.plot(*thin(loop.distance_m, part.moved_m), **STYLES[part.name])
        _fit(axes, corrected)
        page.numbers("; ".join(f"{p.name}: at most {p.moved_m.max():.2f} m" for p in corrected))
    for name in scored:
        axes = panel(f"Distance to {name} after alignment (m)")
        said, drawn = [], []
        for part in shown(loop):
            score = part.scores[name]
            if not isinstance(score, Evaluation):
                said.append(f"{part.name}: {score.reason}")
                continue
            along = np.interp(score.time_s, part.trajectory.time_s, loop.distance_m)
            axes.plot(*thin(along, score.position_error_m), **STYLES[part.name])
            drawn.append(part)
            said.append(f"{part.name}: RMSE {score.ate.translation_m.rmse:.3f} m, max "
                        f"{score.ate.translation_m.max:.3f} m")  # fmt: skip
        _fit(axes, drawn)
        page.numbers("; ".join(said))
    for axes in every[:-1]:
        bare_x(axes)
    every[-1].set_xlabel("distance along the path (m)")


def _fit(axes: Axes, drawn: list[CorrectedPath]) -> None:
    """Scale to the paths that might be used: one that a false closure warps runs out of sight."""
    highest = [
        float(np.nanmax(line.get_ydata()))
        for line, part in zip(axes.get_lines(), drawn, strict=True)
        if part.name != SOLUTIONS["all"]
    ]
    if highest:
        axes.set_ylim(0.0, 1.15 * max(*highest, 1e-3))


def _scores(loop: Loop, name: Callable[[str], str]) -> Page:
    """Tables: every closure with its gate and weights, RPE, and how scores were made."""
    page = Page(
        name("Closures and scores"),
        "d² is the squared misclosure against what drift and closure explain together; p is the "
        "chance of a larger one if the closure is true. Robust solving (dynamic covariance "
        "scaling, DCS; graduated non-convexity, GNC) weighs each closure by how well the others "
        "agree with it: 1 keeps it, 0 drops it.",
    )
    page.heading("Closures", 10.5)
    rows: list[list[Cell]] = []
    for closure in loop.closures:
        weights = [
            "–" if weight is None else f"{weight:.2f}"
            for weight in (closure.weight_dcs, closure.weight_gnc)
        ]
        cells = [
            closure_name(closure, loop), f"{closure.distance_m:.2f}", f"{closure.d2:.1f}",
            f"{closure.degrees_of_freedom}", p_words(closure.p).removeprefix("p "),
            "accepted" if closure.accepted else "REJECTED", *weights,
        ]  # fmt: skip
        colour = "black" if closure.accepted else SEVERITY_COLOURS["error"]
        rows.append([(cell, colour) for cell in cells])
    if rows:
        heads = ["same place at", "missed by (m)", "d²", "dof", "p", "gate", "DCS weight",
                 "GNC weight"]  # fmt: skip
        page.table(heads, rows)
    else:
        page.write("None.")
    for reference in loop.references:
        _relative(page, loop, reference.name)
    return page


def _relative(page: Page, loop: Loop, name: str) -> None:
    page.heading(f"Against {name}", 10.5, above=14.0)
    scores = [(part, part.scores[name]) for part in loop.reported]
    good = [(part, s) for part, s in scores if isinstance(s, Evaluation)]
    for reason in dict.fromkeys(s.reason for _, s in scores if isinstance(s, Unavailable)):
        page.write(reason, size=7.5)
    if not good:
        return
    rows: list[list[str]] = []
    for part, score in good:
        errors: list[tuple[str, AbsoluteError | RelativeError]]
        errors = [("ATE", score.ate), *((f"RPE {e.delta_words}", e) for e in score.rpe)]
        for index, (label, e) in enumerate(errors):
            numbers = statistics_words(e.translation_m, e.interval_m, e.rotation_deg)
            rows.append([part.name if index == 0 else "", label, *numbers])
    heads = ["path", "error over", "RMSE (m)", "95 % interval (m)", "rotation RMSE (°)", "n"]
    page.table(heads, rows)
    first = good[0][1]
    for text in (score_words(first), *first.notes, *first.warnings):
        page.numbers(capital(text))
