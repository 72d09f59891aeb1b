"""Errors of a trajectory as evo's users know them: path by error, APE and RPE, on one page."""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.report import say, style
from px4fuse.report.page import WIDTH, Page, halves
from px4fuse.report.style import EKF2, MUTED, OURS, TRUTH, Axes, Colormap
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Frame, Trajectory
from px4fuse.trajectory.scores import Interval, PairwiseError, Statistics

# Indices of the axes that are right, up the page and vertical; and whether the last points down
AXES: Mapping[Frame, tuple[int, int, int, bool]] = {
    "NED": (1, 0, 2, True),
    "FRD": (1, 0, 2, True),
    "ENU": (0, 1, 2, False),
    "camera": (0, 2, 1, True),
    "unknown": (0, 1, 2, False),
}
# A path whose height is less than this share of its length is seen from above alone
FLAT = 0.1
# Steps of so many median ones are gaps: no line crosses them
GAP_STEPS = 10.0
PIECES = 1200
# Axes of errors reach at least this far: rounding is no error to look at
LEAST_SCALE_M = 1e-3
# In points: heights of a panel, of the maps and of a legend, and between the maps
HEIGHT, MAPS, GAP = 76.0, 128.0, 16.0
MOST_DELTAS = 12
REFERENCE: dict[str, Any] = {"color": TRUTH, "lw": 0.8, "ls": (0, (4, 2))}
STATISTICS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("max", "max", {"color": MUTED, "lw": 0.8, "ls": (0, (1, 1.5))}),
    ("rmse", "RMSE", {"color": EKF2, "lw": 1.4, "ls": "-"}),
    ("mean", "mean", {"color": "black", "lw": 0.9, "ls": (0, (5, 2))}),
    ("median", "median", {"color": "black", "lw": 0.9, "ls": (0, (5, 1.5, 1, 1.5))}),
)
# Rounding: no error to say anything about
NEGLIGIBLE_M = 1e-6
SHADES = "The darker the path, the larger its error; × is the largest."
SCORE_HEAD = ("error", "RMSE", "95 %", "mean", "median", "std", "max", "n", "rotation\nRMSE (°)")


@cache
def colours() -> Colormap:
    """Colours from light to dark, so that grey shows them in order; none is as light as paper."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    made = mpl.colormaps["YlOrRd"](np.linspace(0.3, 1.0, 128)) * (1.0, 1.0, 1.0, 1.0)
    made[:, :3] *= np.linspace(1.0, 0.55, 128)[:, np.newaxis]
    return LinearSegmentedColormap.from_list("error", made)


class View(NamedTuple):
    """From where a path is seen: the axes across and up the page, and their names."""

    across: int
    up: int
    down: bool
    names: tuple[str, str]

    def of(self, position_m: Array) -> Array:
        """Coordinates on the page, shape (n, 3) to (n, 2)."""
        return np.asarray(position_m[:, (self.across, self.up)])


def views(score: Evaluation) -> list[View]:
    """From above; and from the side where the path is not flat."""
    across, up, vertical, down = AXES[score.reference.frame]
    names = AXES_OF_FRAME[score.reference.frame]
    extent = np.maximum(np.ptp(score.reference_m, axis=0), np.ptp(score.estimate_m, axis=0))
    level = across if extent[across] >= extent[up] else up
    seen = [
        View(across, up, False, (names[across], names[up])),
        View(level, vertical, down, (names[level], names[vertical])),
    ]
    return seen if extent[vertical] > FLAT * extent[level] else seen[:1]


def draw(score: Evaluation, _: object) -> Iterator[Page]:
    """Draw the page, and another where the table of a run over many deltas fills the first."""
    page = Page("Trajectory error", say("errors"))
    page.write(summary(score), size=9.0, bold=True)
    write_evaluation(page, score)
    _maps(page, score)
    _panels(page, score)
    yield page


def _maps(page: Page, score: Evaluation) -> None:
    """The two as they stand, and the aligned path by its error, from one or two sides."""
    seen, is_aligned = views(score), score.alignment != "none"
    count = len(seen) + is_aligned
    width = (WIDTH - GAP * (count - 1)) / count
    columns, estimate = [], []
    if is_aligned:
        columns.append(Page(width=width))
        axes = columns[-1].panel("Before alignment", "", MAPS, left=34.0)
        for position, looks, label in (
            (score.reference_m, REFERENCE, "reference"),
            (score.unaligned_m, {"color": OURS, "lw": 1.2}, "estimate"),
        ):
            way(axes, seen[0].of(position), score.time_s, label=label, **looks)
        _framed(axes, seen[0])
        estimate = axes.get_legend_handles_labels()[0][1:]
        columns[-1].numbers(before_words(score))
    for view in seen:
        columns.append(Page(width=width))
        title = f"{'After alignment, by' if is_aligned else 'By'} error"
        axes = columns[-1].panel(title, "", MAPS, left=34.0, right=40.0)
        draw_path(axes, score, view)
        columns[-1].numbers(SHADES if view is seen[0] else side_words(score, view.up))
    page.legend([*axes.get_legend_handles_labels()[0], *estimate])
    page.beside(*columns, gap=GAP)


def draw_path(axes: Axes, score: Evaluation, view: View) -> None:
    """The aligned path by its error, the reference dashed upon it."""
    error, path = score.position_error_m, view.of(score.estimate_m)
    every = max(1, len(error) // PIECES)
    shown = axes.scatter(
        path[::every, 0],
        path[::every, 1],
        c=error[::every],
        s=9.0,
        cmap=colours(),
        linewidths=0,
        vmin=0.0,
        vmax=max(float(error.max()), LEAST_SCALE_M),
    )
    way(axes, view.of(score.reference_m), score.time_s, label="reference", **REFERENCE)
    axes.plot(*path[0], "o", color="white", mec="black", ms=5, mew=1.0, label="start", zorder=5)
    worst = path[np.argmax(error)]
    axes.plot(*worst, "x", color="black", ms=7, mew=1.6, label="largest error", zorder=5)
    _framed(axes, view)
    bar = axes.figure.colorbar(shown, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)))
    bar.set_label("APE (m)", labelpad=1)
    bar.outline.set_linewidth(0.5)


def _framed(axes: Axes, view: View) -> None:
    style.as_map(axes, *view.names)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    if view.down:
        axes.invert_yaxis()


def _panels(page: Page, score: Evaluation) -> None:
    """APE over time and over distance; RPE per delta."""
    left, right = halves()
    axes = left.panel("APE over time (m)", "", HEIGHT)
    draw_ape(axes, score, *over_time(score))
    page.legend(axes.get_legend_handles_labels()[0])
    left.numbers(time_words(score))
    axes = right.panel("APE over distance (m)", "", HEIGHT)
    draw_ape(axes, score, score.distance_m, "distance along the reference (m)")
    right.numbers(distance_words(score))
    page.beside(left, right)
    if _known(score):
        left, right = halves()
        _deltas(left.panel("RPE per delta (m)", "", HEIGHT), score)
        right.write(growth_words(score.rpe), size=7.0, colour=MUTED, above=24.0)
        page.beside(left, right)


def draw_ape(axes: Axes, score: Evaluation, along: Array, label: str) -> None:
    """APE with its statistics as lines; thinned to its extremes, no gap in time is crossed."""
    error, low, high = score.position_error_m, float(along[0]), float(along[-1])
    kept, values = style.thin(along, error, style.MAX_POINTS_NARROW)
    after = np.searchsorted(kept, along[_gaps(score.time_s)])
    axes.plot(np.insert(kept, after, np.nan), np.insert(values, after, np.nan), color=OURS, lw=0.8)
    for name, title, looks in STATISTICS:
        value = getattr(score.ate.translation_m, name)
        axes.axhline(value, label=f"{title} {metres(value)}", zorder=3, **looks)
    axes.set(xlim=(low, max(high, low + 1e-6)), xlabel=label)
    axes.set_ylim(0.0, 1.08 * max(float(error.max()), LEAST_SCALE_M))
    axes.locator_params(axis="x", nbins=6)
    axes.locator_params(axis="y", nbins=4)


def _deltas(axes: Axes, score: Evaluation) -> None:
    """RMSE of the RPE of every delta, with its 95 % interval."""
    for place, (error, found) in enumerate(known := _known(score)):
        if isinstance(error.interval_m, Interval):
            ends = error.interval_m.low, error.interval_m.high
            axes.plot([place] * 2, ends, color=OURS, lw=1.6, solid_capstyle="butt")
        axes.plot(place, found.rmse, "D", color=EKF2, mec="black", mew=0.5, ms=3.6)
    shown = range(0, len(known), 1 + len(known) // MOST_DELTAS)
    axes.set_xticks(shown, [known[place][0].delta_words for place in shown])
    axes.set_ylim(0.0, max(1.05 * axes.get_ylim()[1], LEAST_SCALE_M))
    axes.margins(x=0.1)
    axes.set_xlabel("delta")


def _known(score: Evaluation) -> list[tuple[PairwiseError, Statistics]]:
    return [(e, e.translation_m) for e in score.rpe if isinstance(e.translation_m, Statistics)]


def over_time(score: Evaluation) -> tuple[Array, str]:
    """Time of each pose on the page, and what its axis is called."""
    zero = zero_s(score)
    return score.time_s - zero, "time from the first pose (s)" if zero else "time (s)"


def _gaps(time_s: Array) -> IntArray:
    """Indices of the poses after a gap in time."""
    steps = np.diff(time_s)
    return np.asarray(np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1)


def way(axes: Axes, seen: Array, time_s: Array, **style: Any) -> None:
    """A path on a map, shape (n, 2), thinned evenly; no gap in time is crossed."""
    gaps = _gaps(time_s)
    even = np.linspace(0, len(seen) - 1, min(len(seen), PIECES)).astype(np.intp)
    kept = np.unique(np.concatenate([even, gaps]))
    axes.plot(*np.insert(seen[kept], np.searchsorted(kept, gaps), np.nan, axis=0).T, **style)


# ---------------------------------------------------------------------------------------- words


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
    aligned = "without" if score.alignment == "none" else "after"
    return (
        f"{score.estimate.name} is {metres(score.ate.translation_m.rmse)} (RMSE) from "
        f"{score.reference.name} {aligned} alignment; farthest, "
        f"{metres(score.ate.translation_m.max)}, at {score.time_s[worst] - zero_s(score):.1f} s, "
        f"{score.distance_m[worst]:.1f} m along."
    )


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
    worst = squares[-max(1, len(squares) // 10) :].sum() / max(squares.sum(), NEGLIGIBLE_M**2)
    return say("moments", worst=worst)


def quarters(score: Evaluation) -> list[float]:
    """RMSE over each quarter of the reference's path (m); fewer where one has no pose."""
    along = score.distance_m
    edges = np.linspace(0.0, along[-1], 5)
    parts = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, 3)
    errors = [score.position_error_m[parts == part] for part in range(4)]
    return [float(np.sqrt(np.mean(e**2))) for e in errors if len(e)]


def distance_words(score: Evaluation) -> str:
    """Whether the error grows along the path."""
    found = ", ".join(f"{q:.3f}" for q in quarters(score))
    return say("quarters", found=found)


def growth_words(rpe: tuple[PairwiseError, ...]) -> str:
    """How the RPE grows with its delta, which tells noise from drift."""
    said = "RMSE with its 95 % interval."
    rmse: dict[tuple[str, float], float] = {
        (error.unit, error.delta): error.translation_m.rmse
        for error in rpe
        if isinstance(error.translation_m, Statistics) and error.translation_m.rmse > NEGLIGIBLE_M
    }
    units = [unit for unit, _ in rmse]
    unit = max(units, key=units.count, default="")
    deltas = sorted(delta for one, delta in rmse if one == unit)
    if len(deltas) < 2:
        return f"{said} A second distance would tell noise from drift."
    low, high = deltas[0], deltas[-1]
    ratio, grown = high / low, rmse[unit, high] / rmse[unit, low]
    return (
        f"{said} From {low:g} to {high:g} {unit}, {ratio:.3g} times, the RMSE is {grown:.2g} times "
        f"as large: 1 is noise of each pose, {np.sqrt(ratio):.2g} a random walk, {ratio:.3g} a "
        "wrong scale or heading."
    )


def interval_words(interval: Interval | Unavailable) -> str:
    """An interval; nothing where there is none."""
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, Interval) else ""


def track_words(path: Trajectory) -> str:
    """A trajectory by its name, what it is, its length in time and its frame."""
    return say("track", path=path, poses=len(path), span_s=path.time_s[-1] - path.time_s[0])


def score_words(score: Evaluation) -> str:
    """How a score was made, in one sentence."""
    matched = score.association
    offset = score.time_offset.offset_s
    clock = "" if not offset else f"; clocks matched by {offset:+.3f} s"
    return say(
        "how", score=score, reason=score.alignment_reason.rstrip("."), matched=matched, clock=clock
    )
