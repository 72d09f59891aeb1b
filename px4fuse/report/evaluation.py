"""Errors of a trajectory as evo's users know them: path by error, APE and RPE, on one page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.report import style
from px4fuse.report.page import WIDTH, Page, halves, legend_above
from px4fuse.report.screen import show
from px4fuse.report.style import EKF2, MUTED, OURS, TRUTH
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Frame, Trajectory
from px4fuse.trajectory.scores import Interval, PairwiseError, Statistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

# Indices of the axes that are right, up the page and vertical; and whether the last points down
_AXES: Mapping[Frame, tuple[int, int, int, bool]] = {
    "NED": (1, 0, 2, True), "FRD": (1, 0, 2, True), "ENU": (0, 1, 2, False),
    "camera": (0, 2, 1, True), "unknown": (0, 1, 2, False),
}  # fmt: skip
# A path whose height is less than this share of its length is seen from above alone
FLAT = 0.1
# Steps of so many median ones are gaps: no line crosses them
GAP_STEPS = 10.0
# and over time those that are this share of it: shorter ones do not show
GAP_SHARE = 0.01
PIECES = 1200
# Axes of errors reach at least this far: rounding is no error to look at
LEAST_SCALE_M = 1e-3
# In points: heights of a panel, of the maps and of a legend, and between the maps
HEIGHT, MAPS, GAP = 76.0, 128.0, 16.0
MOST_CURVES, MOST_BOXES = 3, 12
REFERENCE: dict[str, Any] = {"color": TRUTH, "lw": 0.8, "ls": (0, (4, 2))}
STATISTICS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("max", "max", {"color": MUTED, "lw": 0.8, "ls": (0, (1, 1.5))}),
    ("rmse", "RMSE", {"color": EKF2, "lw": 1.4, "ls": "-"}),
    ("mean", "mean", {"color": "black", "lw": 0.9, "ls": (0, (5, 2))}),
    ("median", "median", {"color": "black", "lw": 0.9, "ls": (0, (5, 1.5, 1, 1.5))}),
)
CURVES: tuple[dict[str, Any], ...] = (
    {"color": "#9db7d5", "lw": 0.8},
    {"color": "#4f7fb5", "lw": 0.9, "ls": (0, (4, 1))},
    {"color": OURS, "lw": 1.1},
)
# Above this share of the squared error the worst tenth of the poses is what there is to look at
FEW_DECIDE = 0.5
# Quarters of a path differ if one is so many times the other
DIFFERS = 1.3
# Rounding: no error to say anything about
NEGLIGIBLE_M = 1e-6
SHADES = "The darker the path, the larger its error; × is the largest."
SCORE_HEAD = (
    "error", "RMSE", "95 %", "mean", "median", "std", "max", "n", "rotation\nRMSE (°)",
)  # fmt: skip


@cache
def colours() -> Colormap:
    """Colours from light to dark, so that grey shows them in order; none is as light as paper."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    made = mpl.colormaps["YlOrRd"](np.linspace(0.3, 1.0, 128)) * (1.0, 1.0, 1.0, 1.0)
    made[:, :3] *= np.linspace(1.0, 0.55, 128)[:, np.newaxis]
    return LinearSegmentedColormap.from_list("error", made)


class View(NamedTuple):
    """From where a path is seen: the axes across and up the page."""

    title: str
    across: int
    up: int
    down: bool = False

    def of(self, position_m: Array) -> Array:
        """Coordinates on the page, shape (n, 3) to (n, 2)."""
        return np.asarray(position_m[:, (self.across, self.up)])


def views(score: Evaluation) -> list[View]:
    """From above; and from the side where the path is not flat."""
    across, up, vertical, down = _AXES[score.reference.frame]
    extent = np.maximum(np.ptp(score.reference_m, axis=0), np.ptp(score.estimate_m, axis=0))
    level = across if extent[across] >= extent[up] else up
    titles = ["from above", "from the side"]
    if score.reference.frame == "unknown":
        names = AXES_OF_FRAME["unknown"]
        titles = [f"{names[across]} and {names[up]}", f"{names[level]} and {names[vertical]}"]
    seen = [View(titles[0], across, up), View(titles[1], level, vertical, down)]
    return seen if extent[vertical] > FLAT * extent[level] else seen[:1]


def draw(score: Evaluation) -> Iterator[Page]:
    """Draw the page, and another where the table of a run over many deltas fills the first."""
    page = Page(
        "Trajectory error",
        "APE: how far a pose is from the reference; over all poses, the ATE. RPE: how wrong a "
        "motion over a delta is.",
    )
    page.write(summary(score), size=9.0, bold=True)
    write_evaluation(page, score)
    _maps(page, score)
    _panels(page, score)
    yield page


def _maps(page: Page, score: Evaluation) -> None:
    """The two as they stand, and the aligned path by its error, from one or two sides."""
    seen, is_aligned = views(score), score.alignment != "none"
    title = "After alignment, by error" if is_aligned else "By error"
    parts = {f"{title}, {view.title}": side_words(score, view.up) for view in seen}
    parts[f"{title}, {seen[0].title}"] = SHADES
    if is_aligned:
        parts = {"Before alignment": before_words(score), **parts}
    width = (WIDTH - GAP * (len(parts) - 1)) / len(parts)
    columns = [Page(width=width) for _ in parts]
    panels = [
        column.panel(head, "", MAPS, left=34.0, right=34.0 if column is columns[-1] else 4.0)
        for column, head in zip(columns, parts, strict=True)
    ]
    for axes, view in zip(panels[int(is_aligned) :], seen, strict=True):
        scale = axes.inset_axes((1.02, 0.0, 0.03, 1.0)) if axes is panels[-1] else None
        draw_path(axes, score, view, scale)
    if is_aligned:
        _before(panels[0], score, seen[0])
    entries = {
        label: handle
        for axes in panels[: 1 + is_aligned]
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    page.legend(list(entries.values()))
    for column, text in zip(columns, parts.values(), strict=True):
        column.numbers(text)
    page.beside(*columns, gap=GAP)


def _before(axes: Axes, score: Evaluation, view: View) -> None:
    for position, looks, label in (
        (score.reference_m, REFERENCE, "reference"),
        (score.unaligned_m, {"color": OURS, "lw": 1.2}, "estimate before alignment"),
    ):
        way(axes, view.of(position), score.time_s, label=label, **looks)
    _framed(axes, score, view)


def draw_path(axes: Axes, score: Evaluation, view: View, scale: Axes | None) -> None:
    """The aligned path by its error, the reference dashed upon it."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    error, gaps = score.position_error_m, _gaps(score.time_s)
    at = np.unique(np.linspace(0, len(error) - 1, min(len(error), PIECES)).astype(np.intp))
    corners = view.of(score.estimate_m)[at]
    before_gap = np.searchsorted(gaps, at, side="right")  # how many gaps come before each corner
    unbroken = np.diff(before_gap) == 0
    pieces = np.stack([corners[:-1], corners[1:]], axis=1)[unbroken]
    drawn = LineCollection(list(pieces), cmap=colours(), lw=3.0, capstyle="round")
    drawn.set_array(np.maximum.reduceat(error, at[:-1])[unbroken])
    drawn.set_clim(0.0, max(float(error.max()), LEAST_SCALE_M))
    axes.add_collection(drawn)
    way(axes, view.of(score.reference_m), score.time_s, label="reference", **REFERENCE)
    start, worst = view.of(score.estimate_m)[[0, int(np.argmax(error))]]
    axes.plot(*start, "o", color="white", mec="black", ms=5, mew=1.0, label="start", zorder=5)
    axes.plot(*worst, "x", color="black", ms=7, mew=1.6, label="largest error", zorder=5)
    _framed(axes, score, view)
    if scale is not None:
        bar = scale.figure.colorbar(drawn, cax=scale)
        bar.set_label("APE (m)", labelpad=1)
        bar.outline.set_linewidth(0.5)


def _framed(axes: Axes, score: Evaluation, view: View) -> None:
    names = AXES_OF_FRAME[score.reference.frame]
    axes.autoscale_view()
    style.as_map(axes, names[view.across], names[view.up])
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    if view.down:
        axes.invert_yaxis()


def _panels(page: Page, score: Evaluation) -> None:
    """APE over time and over distance; RPE over time and per delta."""
    left, right = halves()
    axes = left.panel("APE over time (m)", "", HEIGHT)
    draw_ape(axes, score, score.time_s - zero_s(score), time_label(score))
    page.legend(axes.get_legend_handles_labels()[0])
    left.numbers(time_words(score))
    axes = right.panel("APE over distance (m)", "", HEIGHT)
    draw_ape(axes, score, score.distance_m, "distance along the reference (m)")
    right.numbers(distance_words(score))
    page.beside(left, right)
    left, right = halves()
    axes = left.panel("RPE over time (m)", "", HEIGHT, above=14.0)
    if known := [e for e in score.rpe if isinstance(e.translation_m, Statistics)]:
        left.numbers(relative_words(_relative(axes, score, known), score.time_s, zero_s(score)))
        _boxes(right.panel("RPE per delta (m)", "", HEIGHT, above=14.0), score)
        right.numbers(growth_words(score.rpe))
    else:
        _none(axes, score)
    page.beside(left, right)


def draw_ape(axes: Axes, score: Evaluation, along: Array, label: str) -> None:
    """APE with its statistics as lines."""
    _line(axes, along, score.position_error_m, score.time_s, color=OURS, lw=0.8)
    for name, title, looks in STATISTICS:
        value = getattr(score.ate.translation_m, name)
        axes.axhline(value, label=f"{title} {metres(value)}", zorder=3, **looks)
    _from_zero(axes, along, float(score.position_error_m.max()), label)


def _relative(axes: Axes, score: Evaluation, known: list[PairwiseError]) -> list[PairwiseError]:
    """RPE over time, of the distances where there are any; returns what is shown."""
    unit = "m" if any(e.unit == "m" for e in known) else known[0].unit
    shown = [e for e in known if e.unit == unit][-MOST_CURVES:]
    zero = zero_s(score)
    for error, looks in zip(shown, CURVES[-len(shown) :], strict=True):
        ends = score.time_s[error.end]
        _line(axes, ends - zero, error.translation_error_m, ends, label=error.delta_words, **looks)
    highest = max(float(error.translation_error_m.max()) for error in shown)
    _from_zero(axes, score.time_s - zero, highest, time_label(score))
    legend_above(axes, handlelength=1.8)
    return shown


def _boxes(axes: Axes, score: Evaluation) -> None:
    """RPE of every delta as a box, with its RMSE and the interval of that."""
    known = [(e, e.translation_m) for e in score.rpe if isinstance(e.translation_m, Statistics)]
    if not known:
        _none(axes, score)
        return
    known = known[:: -(-len(known) // MOST_BOXES)]
    edge, middle = {"color": OURS, "lw": 0.8}, {"color": "black", "lw": 1.0}
    axes.boxplot(
        [error.translation_error_m for error, _ in known], whis=(0, 100), widths=0.5,
        tick_labels=[error.delta_words for error, _ in known], patch_artist=True,
        boxprops={"facecolor": "#dbe5f1", "edgecolor": OURS, "lw": 0.8}, medianprops=middle,
        whiskerprops=edge, capprops=edge,
    )  # fmt: skip
    for place, (error, found) in enumerate(known, start=1):
        if isinstance(error.interval_m, Interval):
            ends = (error.interval_m.low, error.interval_m.high)
            axes.plot([place + 0.36] * 2, ends, color=EKF2, lw=1.2, solid_capstyle="butt")
        axes.plot(place + 0.36, found.rmse, "D", color=EKF2, mec="black", mew=0.5, ms=3.6)
    axes.set_ylim(0.0, max(axes.get_ylim()[1], LEAST_SCALE_M))
    axes.set_xlim(0.5, len(known) + 0.6)
    axes.set_xlabel("delta")


def _none(axes: Axes, score: Evaluation) -> None:
    missing = [e.translation_m for e in score.rpe if isinstance(e.translation_m, Unavailable)]
    reason = missing[0].reason if missing else "the path is too short for a delta"
    style.empty(axes, f"No RPE: {reason}.")


def time_label(score: Evaluation) -> str:
    """What the axis of time counts from."""
    return "time from the first pose (s)" if zero_s(score) else "time (s)"


def _from_zero(axes: Axes, along: Array, highest: float, label: str) -> None:
    axes.set_ylim(0.0, 1.08 * max(highest, LEAST_SCALE_M))
    axes.set_xlim(float(along[0]), max(float(along[-1]), float(along[0]) + 1e-6))
    axes.locator_params(axis="x", nbins=6)
    axes.locator_params(axis="y", nbins=4)
    axes.set_xlabel(label)


def _gaps(time_s: Array, least_s: float = 0.0) -> IntArray:
    """Indices of the poses after a gap in time."""
    steps = np.diff(time_s)
    longest = max(GAP_STEPS * float(np.median(steps)), least_s) if len(steps) else least_s
    return np.asarray(np.flatnonzero(steps > longest) + 1)


def _line(axes: Axes, x: Array, y: Array, time_s: Array, **looks: Any) -> None:
    """A line over time or distance, thinned to its extremes; no gap that shows is crossed."""
    kept, values = style.thin(x, y, style.MAX_POINTS_NARROW)
    after = np.searchsorted(kept, x[_gaps(time_s, GAP_SHARE * float(time_s[-1] - time_s[0]))])
    axes.plot(np.insert(kept, after, np.nan), np.insert(values, after, np.nan), **looks)


def way(axes: Axes, seen: Array, time_s: Array, **style: Any) -> None:
    """A path on a map, shape (n, 2), thinned evenly; no gap in time is crossed."""
    gaps = _gaps(time_s)
    even = np.linspace(0, len(seen) - 1, min(len(seen), PIECES)).astype(np.intp)
    kept = np.unique(np.concatenate([even, gaps]))
    axes.plot(*np.insert(seen[kept], np.searchsorted(kept, gaps), np.nan, axis=0).T, **style)


# ---------------------------------------------------------------------------------------- words


def print_evaluation(console: Console, score: Evaluation) -> None:
    """Print the scores of one trajectory against another."""
    page = Page()
    write_evaluation(page, score)
    show(console, page.blocks)


def metres(value: float) -> str:
    """A length with the digits that matter.

    >>> metres(0.0512), metres(31.26)
    ('0.051 m', '31.3 m')
    """
    return f"{value:.3f} m" if abs(value) < 10.0 else f"{value:.1f} m"


def zero_s(score: Evaluation) -> float:
    """Where times on the page count from: the first pose where stamps are UNIX time, else zero."""
    start = float(score.time_s[0])
    return start if start > SMALLEST_STAMP_S else 0.0


def summary(score: Evaluation) -> str:
    """The score in one sentence."""
    worst = int(np.argmax(score.position_error_m))
    return (
        f"{score.estimate.name} is {metres(score.ate.translation_m.rmse)} (RMSE) from "
        f"{score.reference.name} {_aligned(score)}; farthest, "
        f"{metres(score.ate.translation_m.max)}, at {score.time_s[worst] - zero_s(score):.1f} s, "
        f"{score.distance_m[worst]:.1f} m along."
    )


def _aligned(score: Evaluation) -> str:
    return "without alignment" if score.alignment == "none" else "after alignment"


def write_evaluation(page: Page, score: Evaluation) -> None:
    """Write what was scored and how, and the statistics of all errors."""
    page.labelled("Estimate", track_words(score.estimate))
    page.labelled("Against", track_words(score.reference))
    page.labelled("How", score_words(score))
    for text in score.warnings:
        page.write(text, bold=True, colour=style.SEVERITY_COLOURS["warning"])
    page.table(SCORE_HEAD, score_rows(score), right=range(1, len(SCORE_HEAD)))
    page.numbers(" ".join([*reasons(score), *score.notes]))


def score_rows(score: Evaluation) -> list[list[str]]:
    """Of the ATE and every RPE: what :data:`SCORE_HEAD` says."""
    errors: dict[str, AbsoluteError | PairwiseError] = {"ATE (m)": score.ate}
    errors |= {f"RPE {error.delta_words} (m)": error for error in score.rpe}
    rows = []
    for name, error in errors.items():
        moved, turned = error.translation_m, error.rotation_deg
        cells = ["–", *[""] * 6]
        if isinstance(moved, Statistics):
            numbers = (moved.mean, moved.median, moved.std, moved.max)
            cells = [f"{moved.rmse:.4f}", interval_words(error.interval_m)]
            cells += [*(f"{number:.4f}" for number in numbers), f"{moved.count}"]
        rows.append([name, *cells, f"{turned.rmse:.2f}" if isinstance(turned, Statistics) else "–"])
    return rows


def reasons(score: Evaluation) -> list[str]:
    """Why a number is missing, each reason once."""
    parts = [score.ate.interval_m, score.ate.rotation_deg, *(e.translation_m for e in score.rpe)]
    missing = [part for part in parts if isinstance(part, Unavailable)]
    return list(dict.fromkeys(f"No {part.what}: {part.reason}." for part in missing))


def before_words(score: Evaluation) -> str:
    """How far the two are apart as their numbers stand, and what the alignment took away."""
    x, y = score.unaligned_m, score.reference_m
    apart = float(np.sqrt(((x - y) ** 2).sum(axis=1).mean()))
    fitted = score.transform
    scaled = f", scaled {fitted.scale:.3g} times" if fitted.degrees_of_freedom == 7 else ""
    moved = float(np.linalg.norm(fitted.apply(x.mean(axis=0)) - x.mean(axis=0)))
    return (
        f"As they stand {metres(apart)} apart (RMSE). Turned by "
        f"{np.degrees(fitted.rotation.magnitude()):.1f}°, moved {metres(moved)}{scaled}: a choice "
        "of frame, no error."
    )


def side_words(score: Evaluation, axis: int) -> str:
    """How much of the squared error is vertical."""
    squares = ((score.estimate_m - score.reference_m) ** 2).mean(axis=0)
    name = AXES_OF_FRAME[score.reference.frame][axis]
    if not squares.any():
        return f"There is no error along {name}."
    return (
        f"Along {name} the RMSE is {metres(float(np.sqrt(squares[axis])))}: "
        f"{squares[axis] / squares.sum():.0%} of the squared error."
    )


def time_words(score: Evaluation) -> str:
    """Whether a few moments decide."""
    squares = np.sort(score.position_error_m**2)
    total = float(squares.sum())
    if score.ate.translation_m.rmse < NEGLIGIBLE_M:
        return "There is no error at any time."
    share = float(squares[-max(1, len(squares) // 10) :].sum()) / total
    said = "it is spread over time, and no matter of a few moments"
    if share > FEW_DECIDE:
        said = "a few moments decide, look at these"
    return f"The worst tenth of the poses makes {share:.0%} of the squared error: {said}."


def quarters(score: Evaluation) -> list[float]:
    """RMSE over each quarter of the reference's path (m); fewer where one has no pose."""
    along = score.distance_m
    edges = np.linspace(0.0, along[-1], 5)
    parts = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, 3)
    errors = [score.position_error_m[parts == part] for part in range(4)]
    return [float(np.sqrt(np.mean(e**2))) for e in errors if len(e)]


def distance_words(score: Evaluation) -> str:
    """Whether the error grows along the path."""
    found = quarters(score)
    said = f"RMSE by quarters of the path {', '.join(f'{q:.3f}' for q in found)} m: "
    if len(found) < 4:
        return f"{said}the poses do not cover all of it."
    if score.ate.translation_m.rmse < NEGLIGIBLE_M:
        return f"{said}there is no error."
    first, *middle, last = found
    if min(first, last) > DIFFERS * max(middle):
        return f"{said}high at both ends, as drift looks after an alignment."
    if all(a <= b for a, b in pairwise(found)) and last > DIFFERS * first:
        return f"{said}it grows along the path, as drift does."
    where = ("first", "second", "third", "last")[int(np.argmax(found))]
    return f"{said}largest in the {where}, no steady growth as a drift from the start has."


def relative_words(shown: list[PairwiseError], times: Array, zero: float) -> str:
    """Where the motion itself is worst."""
    last = shown[-1]
    worst = int(np.argmax(last.translation_error_m))
    return (
        "What a motion over the delta is wrong by, wherever the path was before, drawn at its end: "
        f"a peak is where it went wrong. Largest over {last.delta}: "
        f"{metres(float(last.translation_error_m[worst]))}, from "
        f"{times[last.start[worst]] - zero:.1f} to {times[last.end[worst]] - zero:.1f} s."
    )


def growth_words(rpe: tuple[PairwiseError, ...]) -> str:
    """How the RPE grows with its delta, which tells noise from drift."""
    boxes = "Box: middle half; whiskers: all; diamond: RMSE with its 95 % interval."
    by_unit: dict[str, list[tuple[float, float]]] = {}
    for error in rpe:
        if isinstance(error.translation_m, Statistics) and error.translation_m.rmse > NEGLIGIBLE_M:
            by_unit.setdefault(error.unit, []).append((error.delta, error.translation_m.rmse))
    several = max(by_unit.values(), key=len, default=[])
    (low, small), (high, large) = min(several, default=(0, 0)), max(several, default=(0, 0))
    if not low < high:
        return f"{boxes} A second distance would tell noise from drift."
    ratio = high / low
    unit = next(unit for unit, found in by_unit.items() if found is several)
    return (
        f"{boxes} From {low:g} to {high:g} {unit}, {ratio:.3g} times, the RMSE is "
        f"{large / small:.2g} times as large: 1 is noise of each pose, {np.sqrt(ratio):.2g} a "
        f"random walk, {ratio:.3g} a wrong scale or heading."
    )


def interval_words(interval: Interval | Unavailable) -> str:
    """An interval; nothing where there is none."""
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, Interval) else ""


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
        f"{matched.poses} poses, "
        f"{matched.coverage_estimate:.0%} of the estimate, {matched.coverage_reference:.0%} of the "
        f"reference's time{clock}"
    )
