"""Loop: the path before and after, the closure error, and scores of every correction."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from px4fuse.arrays import Array
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.loop.corrections import BY_DISTANCE, PLAIN, UNCORRECTED, Correction
from px4fuse.loop.loop import Loop
from px4fuse.plain import capital
from px4fuse.report.document import Document, LoopDocument, who
from px4fuse.report.evaluation import way
from px4fuse.report.loop_words import write_loop, write_scores
from px4fuse.report.page import AXIS_LABEL, TICKS, Page, appendix, legend_above
from px4fuse.report.style import EKF2, OURS, SEVERITY_COLOURS, TRUTH_LINE, bare_x, thin
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SOLUTIONS
from px4fuse.trajectory.model import AXES_OF_FRAME

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GREEN, RED = "#3a7d5c", SEVERITY_COLOURS["error"]
STYLES: Mapping[str, dict[str, Any]] = {
    UNCORRECTED: {"color": EKF2, "lw": 1.1, "ls": (0, (4, 1.6))},
    PLAIN: {"color": "#79b294", "lw": 1.3, "ls": (0, (1.2, 1.2))},
    BY_DISTANCE: {"color": GREEN, "lw": 1.0, "ls": (0, (6, 1.2, 1, 1.2))},
    SOLUTIONS["gated"]: {"color": OURS, "lw": 1.2, "ls": "-"},
    SOLUTIONS["all"]: {"color": "#8d6a9f", "lw": 0.9, "ls": (0, (2, 1))},
}
TITLE, LEAD = (
    "Loop closure",
    "A path that truly returns must close; the gap is what the odometry drifted. Each correction "
    "spreads it over the path: by distance (positions only as in the lesson's Example 2, or "
    "headings too), or as a pose graph weighs it. A closure that is not true would warp the whole "
    "path, so that each one is tested before its use.",
)
WARPED = SOLUTIONS["all"]  # by closures that are not true
MAP_POINTS = 2000
MAP, HEIGHT, LEGEND = 290.0, 105.0, 30.0  # of the axes, and of a legend, in points


def draw(document: Document) -> Iterator[Page]:
    """Draw the loop's pages; none where the flight holds no loop."""
    if isinstance(document.analysis.loop, Loop):
        yield from _draw(document.analysis.loop, Page(appendix(TITLE), LEAD), appendix)


def draw_report(document: LoopDocument) -> Iterator[Page]:
    """Draw the pages of a report on a loop alone, its findings on the first."""
    page = Page(TITLE, LEAD)
    if student := who(document.student, ", "):
        page.labelled("Student", student)
    page.labelled("SHA-256", document.log[1])
    yield from _draw(document.loop, page, str, document.findings)


def _draw(
    loop: Loop, page: Page, name: Callable[[str], str], findings: tuple[Finding, ...] = ()
) -> Iterator[Page]:
    """Draw the first page to its end and those after it, their titles made by ``name``."""
    write_loop(page, loop, findings)
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
    page = Page(
        name("Closures and scores"),
        "d² is the squared misclosure against what drift and closure explain together; p is the "
        "chance of a larger one if the closure is true. Robust solving (dynamic covariance "
        "scaling, DCS; graduated non-convexity, GNC) weighs each closure by how well the others "
        "agree with it: 1 keeps it, 0 drops it.",
    )
    write_scores(page, loop)
    yield page


def shown(loop: Loop) -> list[Correction]:
    """The paths that are drawn: each kind of correction once."""
    return [part for part in loop.reported if part.name in STYLES]


def _map(page: Page, loop: Loop) -> None:
    axes = page.panel("From above, in the odometry's frame", "", MAP, left=36.0, below=LEGEND)
    path = loop.odometry.trajectory
    names = AXES_OF_FRAME[path.frame]
    _reference(axes, loop)
    for part in shown(loop):
        position = part.trajectory.position_m[:: max(1, len(part.trajectory) // MAP_POINTS)]
        axes.plot(position[:, 1], position[:, 0], label=part.name, **STYLES[part.name])
    start, end = path.position_m[[0, -1]][:, (1, 0)]
    axes.plot(*start, "o", color="black", ms=5, label="start", zorder=5)
    axes.plot(*end, "s", color=EKF2, mec="black", mew=0.6, ms=5, label="end by odometry", zorder=5)
    if not isinstance(loop.misclosure_m, Unavailable):
        true = end - loop.misclosure_m[[1, 0]]
        arrow = {"arrowstyle": "->", "color": RED, "lw": 1.2, "shrinkA": 3, "shrinkB": 0}
        axes.annotate("", xy=true, xytext=end, zorder=6, arrowprops=arrow)
        axes.plot([], [], color=RED, lw=1.2, label=f"gap {loop.closure_error_m:.2f} m")
        axes.plot(*true, "x", color=RED, ms=5, mew=1.2, zorder=6, label="where it really ended")
    axes.set_aspect("equal", adjustable="datalim", anchor="W")
    axes.grid(True, axis="both")
    axes.set(xlabel=f"{names[1]} (m)", ylabel=f"{names[0]} (m)")
    below = -(TICKS + AXIS_LABEL + 2.0) / MAP
    axes.legend(loc="upper left", ncols=4, borderaxespad=0.0, bbox_to_anchor=(0.0, below))


def _reference(axes: Axes, loop: Loop) -> None:
    """The reference in the odometry's frame, placed by the best correction there is."""
    for name in (reference.name for reference in loop.references):
        for part in reversed(shown(loop)):
            score = part.scores.get(name)
            if not isinstance(score, Evaluation):
                continue
            transform = score.transform
            back = transform.rotation.inv().apply(score.reference_m - transform.translation_m)
            position = back / transform.scale
            way(axes, position[:, (1, 0)], score.time_s, label=name, **TRUTH_LINE, zorder=4)
            return


def _along(page: Page, loop: Loop) -> None:
    """Height of each path, how far it moved, and its error: a panel for each, over distance."""
    height = f"{capital(AXES_OF_FRAME[loop.odometry.trajectory.frame][2])} (m)"
    along, paths = loop.distance_m, shown(loop)
    panels: dict[str, dict[str, tuple[Array, Array, str]]] = {
        height: {part.name: (along, part.trajectory.position_m[:, 2], "") for part in paths},
        "How far each pose moved (m)": {
            part.name: (along, part.moved_m, f"at most {part.moved_m.max():.2f} m")
            for part in paths
            if part is not loop.odometry
        },
    }
    for reference in loop.references:
        scores = [(part, part.scores[reference.name]) for part in paths]
        panels[f"Distance to {reference.name} after alignment (m)"] = {
            part.name: (
                np.interp(score.time_s, part.trajectory.time_s, along),
                score.position_error_m,
                f"RMSE {score.ate.translation_m.rmse:.3f} m, max "
                f"{score.ate.translation_m.max:.3f} m",
            )
            for part, score in scores
            if isinstance(score, Evaluation)
        }
    drawn = {title: curves for title, curves in panels.items() if curves}
    for place, (title, curves) in enumerate(drawn.items(), start=1):
        axes = page.panel(title, "", HEIGHT, above=14.0 if title == height else 4.0)
        for name, (x, y, _) in curves.items():
            axes.plot(*thin(x, y), label=name, **STYLES[name])
        axes.set_xlim(0.0, loop.path_length_m)
        if place == len(drawn):
            axes.set_xlabel("distance along the path (m)")
        else:
            bare_x(axes)
        if title == height:
            legend_above(axes)
            continue
        # a path that a false closure warps runs out of sight
        used = [float(np.nanmax(y)) for name, (_, y, _) in curves.items() if name != WARPED]
        if used:
            axes.set_ylim(0.0, 1.15 * max(*used, 1e-3))
        page.numbers("; ".join(f"{name}: {said}" for name, (*_, said) in curves.items()))
