"""Page on trajectory errors: map coloured by error, APE and RPE, named as in evo."""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.report import style
from px4fuse.report.page import PAGE_WIDTH, Page, halves
from px4fuse.report.style import EKF2_COLOUR, KF_COLOUR, MUTED_COLOUR, TRUTH_COLOUR, Axes, Colormap
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Frame, Trajectory
from px4fuse.trajectory.scores import Interval, PairwiseError, Statistics

# Indices of the axes to the right, up the page and vertical; True if the vertical axis is down
PAGE_AXES: Mapping[Frame, tuple[int, int, int, bool]] = {
    "NED": (1, 0, 2, True),
    "FRD": (1, 0, 2, True),
    "ENU": (0, 1, 2, False),
    "camera": (0, 2, 1, True),
    "unknown": (0, 1, 2, False),
}
# Ratio of height and length of a path below which the side view is left out
MAX_FLAT_RATIO = 0.1
# Time step, as a multiple of the median one, above which a line is interrupted
MIN_GAP_STEPS = 10.0
MAX_PATH_POINTS = 1200
MIN_SCALE_M = 1e-3  # m; minimum range of an error axis, so that rounding errors look small
PANEL_HEIGHT, MAP_HEIGHT, MAP_GAP = 76.0, 128.0, 16.0  # points
MAX_DELTA_LABELS = 12
REFERENCE_LINE: dict[str, Any] = {"color": TRUTH_COLOUR, "lw": 0.8, "ls": (0, (4, 2))}
STATISTIC_LINES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("max", "max", {"color": MUTED_COLOUR, "lw": 0.8, "ls": (0, (1, 1.5))}),
    ("rmse", "RMSE", {"color": EKF2_COLOUR, "lw": 1.4, "ls": "-"}),
    ("mean", "mean", {"color": "black", "lw": 0.9, "ls": (0, (5, 2))}),
    ("median", "median", {"color": "black", "lw": 0.9, "ls": (0, (5, 1.5, 1, 1.5))}),
)
NEGLIGIBLE_M = 1e-6  # m; smaller errors are rounding
SHADES_CAPTION = "Darker: larger error. ×: largest error."
SCORE_HEAD = ("error", "RMSE", "95 %", "mean", "median", "std", "max", "n", "rotation\nRMSE (°)")


@cache
def error_colours() -> Colormap:
    """Return a colour map from light to dark that stays readable in grey and on white."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    rgba = mpl.colormaps["YlOrRd"](np.linspace(0.3, 1.0, 128)) * (1.0, 1.0, 1.0, 1.0)
    rgba[:, :3] *= np.linspace(1.0, 0.55, 128)[:, np.newaxis]
    return LinearSegmentedColormap.from_list("error", rgba)


class View(NamedTuple):
    """View of a path: indices of the axes across and up the page, and their names."""

    across: int
    up: int
    is_down: bool
    names: tuple[str, str]

    def project(self, position_m: Array) -> Array:
        """Project positions, shape (n, 3), to page coordinates, shape (n, 2)."""
        return np.asarray(position_m[:, (self.across, self.up)])


def path_views(score: Evaluation) -> list[View]:
    """Return the view from above, and the side view if the path is not flat."""
    across, up, vertical, is_down = PAGE_AXES[score.reference.frame]
    names = AXES_OF_FRAME[score.reference.frame]
    extent = np.maximum(np.ptp(score.reference_m, axis=0), np.ptp(score.estimate_m, axis=0))
    level = across if extent[across] >= extent[up] else up
    all_views = [
        View(across, up, False, (names[across], names[up])),
        View(level, vertical, is_down, (names[level], names[vertical])),
    ]
    return all_views if extent[vertical] > MAX_FLAT_RATIO * extent[level] else all_views[:1]


def draw(score: Evaluation, _: object) -> Iterator[Page]:
    """Draw the evaluation: scores, maps and error panels."""
    page = Page(
        "Trajectory error",
        (
            "APE: distance of one pose from the reference (its RMSE over all poses is "
            "the ATE). RPE: error of the relative motion over a fixed distance or time."
        ),
    )
    page.write(summary(score), size=9.0, bold=True)
    write_evaluation(page, score)
    _draw_maps(page, score)
    _draw_panels(page, score)
    yield page


def _draw_maps(page: Page, score: Evaluation) -> None:
    """Draw the paths before alignment, and the aligned path coloured by error in each view."""
    map_views, is_aligned = path_views(score), score.alignment != "none"
    count = len(map_views) + is_aligned
    width = (PAGE_WIDTH - MAP_GAP * (count - 1)) / count
    columns, estimate = [], []
    if is_aligned:
        columns.append(Page(width=width))
        axes = columns[-1].panel("Before alignment", "", MAP_HEIGHT, left=34.0)
        for position, line_style, label in (
            (score.reference_m, REFERENCE_LINE, "reference"),
            (score.unaligned_m, {"color": KF_COLOUR, "lw": 1.2}, "estimate"),
        ):
            plot_path(axes, map_views[0].project(position), score.time_s, label=label, **line_style)
        _set_map_frame(axes, map_views[0])
        estimate = axes.get_legend_handles_labels()[0][1:]
        columns[-1].numbers(unaligned_sentence(score))
    for view in map_views:
        columns.append(Page(width=width))
        title = f"{'After alignment, coloured' if is_aligned else 'Coloured'} by error"
        axes = columns[-1].panel(title, "", MAP_HEIGHT, left=34.0, right=40.0)
        draw_path(axes, score, view)
        columns[-1].numbers(
            SHADES_CAPTION if view is map_views[0] else vertical_error_sentence(score, view.up)
        )
    page.legend([*axes.get_legend_handles_labels()[0], *estimate])
    page.beside(*columns, gap=MAP_GAP)


def draw_path(axes: Axes, score: Evaluation, view: View) -> None:
    """Draw the aligned path coloured by error, with the reference dashed."""
    error, path = score.position_error_m, view.project(score.estimate_m)
    stride = max(1, len(error) // MAX_PATH_POINTS)
    scatter_points = axes.scatter(
        path[::stride, 0],
        path[::stride, 1],
        c=error[::stride],
        s=9.0,
        cmap=error_colours(),
        linewidths=0,
        vmin=0.0,
        vmax=max(float(error.max()), MIN_SCALE_M),
    )
    plot_path(
        axes, view.project(score.reference_m), score.time_s, label="reference", **REFERENCE_LINE
    )
    axes.plot(*path[0], "o", color="white", mec="black", ms=5, mew=1.0, label="start", zorder=5)
    worst_point = path[np.argmax(error)]
    axes.plot(*worst_point, "x", color="black", ms=7, mew=1.6, label="largest error", zorder=5)
    _set_map_frame(axes, view)
    bar = axes.figure.colorbar(scatter_points, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)))
    bar.set_label("APE (m)", labelpad=1)
    bar.outline.set_linewidth(0.5)


def _set_map_frame(axes: Axes, view: View) -> None:
    style.set_map_axes(axes, *view.names)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    if view.is_down:
        axes.invert_yaxis()


def _draw_panels(page: Page, score: Evaluation) -> None:
    """Draw the panels: APE over time and distance, RPE per delta."""
    left, right = halves()
    axes = left.panel("APE over time (m)", "", PANEL_HEIGHT)
    draw_ape(axes, score, *time_from_start(score))
    page.legend(axes.get_legend_handles_labels()[0])
    left.numbers(worst_moments_sentence(score))
    axes = right.panel("APE over distance (m)", "", PANEL_HEIGHT)
    draw_ape(axes, score, score.distance_m, "distance along the reference (m)")
    right.numbers(quarters_sentence(score))
    page.beside(left, right)
    if _known_rpe(score):
        left, right = halves()
        _draw_rpe(left.panel("RPE per delta (m)", "", PANEL_HEIGHT), score)
        right.write(rpe_growth_sentence(score.rpe), size=7.0, colour=MUTED_COLOUR, above=24.0)
        page.beside(left, right)


def draw_ape(axes: Axes, score: Evaluation, along: Array, label: str) -> None:
    """Draw the APE with its statistics as horizontal lines, interrupted at gaps in time."""
    error, low, high = score.position_error_m, float(along[0]), float(along[-1])
    shown_along, values = style.thin_series(along, error, style.MAX_POINTS_NARROW)
    gap_indices = np.searchsorted(shown_along, along[_gap_indices(score.time_s)])
    axes.plot(
        np.insert(shown_along, gap_indices, np.nan),
        np.insert(values, gap_indices, np.nan),
        color=KF_COLOUR,
        lw=0.8,
    )
    for name, title, line_style in STATISTIC_LINES:
        value = getattr(score.ate.translation_m, name)
        axes.axhline(value, label=f"{title} {format_metres(value)}", zorder=3, **line_style)
    axes.set(xlim=(low, max(high, low + 1e-6)), xlabel=label)
    axes.set_ylim(0.0, 1.08 * max(float(error.max()), MIN_SCALE_M))
    axes.locator_params(axis="x", nbins=6)
    axes.locator_params(axis="y", nbins=4)


def _draw_rpe(axes: Axes, score: Evaluation) -> None:
    """Draw the RPE (RMSE) of each delta with its 95 % interval."""
    for place, (error, statistics) in enumerate(known := _known_rpe(score)):
        if isinstance(error.interval_m, Interval):
            ends = error.interval_m.low, error.interval_m.high
            axes.plot([place] * 2, ends, color=KF_COLOUR, lw=1.6, solid_capstyle="butt")
        axes.plot(place, statistics.rmse, "D", color=EKF2_COLOUR, mec="black", mew=0.5, ms=3.6)
    shown_indices = range(0, len(known), 1 + len(known) // MAX_DELTA_LABELS)
    axes.set_xticks(shown_indices, [known[place][0].delta_text for place in shown_indices])
    axes.set_ylim(0.0, max(1.05 * axes.get_ylim()[1], MIN_SCALE_M))
    axes.margins(x=0.1)
    axes.set_xlabel("delta")


def _known_rpe(score: Evaluation) -> list[tuple[PairwiseError, Statistics]]:
    return [(e, e.translation_m) for e in score.rpe if isinstance(e.translation_m, Statistics)]


def time_from_start(score: Evaluation) -> tuple[Array, str]:
    """Return the time of each pose as drawn (s), and the axis label."""
    zero = time_origin_s(score)
    return score.time_s - zero, "time from the first pose (s)" if zero else "time (s)"


def _gap_indices(time_s: Array) -> IntArray:
    """Return the indices of the poses after a gap in time."""
    steps = np.diff(time_s)
    return np.asarray(np.flatnonzero(steps > MIN_GAP_STEPS * np.median(steps)) + 1)


def plot_path(axes: Axes, positions: Array, time_s: Array, **style: Any) -> None:
    """Draw a path, shape (n, 2), reduced to MAX_PATH_POINTS and interrupted at gaps in time."""
    gaps = _gap_indices(time_s)
    evenly_spaced = np.linspace(0, len(positions) - 1, min(len(positions), MAX_PATH_POINTS)).astype(
        np.intp
    )
    selected = np.unique(np.concatenate([evenly_spaced, gaps]))
    axes.plot(
        *np.insert(positions[selected], np.searchsorted(selected, gaps), np.nan, axis=0).T, **style
    )


# ---------------------------------------------------------------------------------------- text


def format_metres(value: float) -> str:
    """Format a length with three decimals, one from 10 m on.

    >>> format_metres(0.0512), format_metres(31.26)
    ('0.051 m', '31.3 m')
    """
    return f"{value:.3f} m" if abs(value) < 10.0 else f"{value:.1f} m"


def time_origin_s(score: Evaluation) -> float:
    """Return the origin of the time axes: the first pose if timestamps are UNIX time, else 0 s."""
    start = float(score.time_s[0])
    return start if start > SMALLEST_STAMP_S else 0.0


def summary(score: Evaluation) -> str:
    """Summarise ATE and largest error in one line."""
    worst_index = int(np.argmax(score.position_error_m))
    aligned = "without" if score.alignment == "none" else "after"
    return (
        f"ATE {format_metres(score.ate.translation_m.rmse)} (RMSE {aligned} alignment). Largest "
        f"error {format_metres(score.ate.translation_m.max)} at "
        f"{score.time_s[worst_index] - time_origin_s(score):.1f} s, after "
        f"{score.distance_m[worst_index]:.1f} m of the path."
    )


def write_evaluation(page: Page, score: Evaluation) -> None:
    """Write estimate, reference, method and the table of error statistics."""
    page.labelled("Estimate", describe_track(score.estimate))
    page.labelled("Against", describe_track(score.reference))
    page.labelled("Method", describe_score(score))
    for text in score.warnings:
        page.write(text, bold=True, colour=style.SEVERITY_COLOURS["warning"])
    page.table(SCORE_HEAD, score_rows(score), right=range(1, len(SCORE_HEAD)))
    page.numbers(" ".join([*missing_reasons(score), *score.notes]))


def score_rows(score: Evaluation) -> list[list[str]]:
    """Return the table rows of the ATE and each RPE, with the columns of SCORE_HEAD."""
    errors: dict[str, AbsoluteError | PairwiseError] = {"ATE (m)": score.ate}
    errors |= {f"RPE {error.delta_text} (m)": error for error in score.rpe}
    rows = []
    for name, error in errors.items():
        translation, rotation = error.translation_m, error.rotation_deg
        cells = ["–", *[""] * 6]
        if isinstance(translation, Statistics):
            numbers = (translation.mean, translation.median, translation.std, translation.max)
            cells = [f"{translation.rmse:.4f}", format_interval(error.interval_m)]
            cells += [*(f"{number:.4f}" for number in numbers), f"{translation.count}"]
        rows.append(
            [name, *cells, f"{rotation.rmse:.2f}" if isinstance(rotation, Statistics) else "–"]
        )
    return rows


def missing_reasons(score: Evaluation) -> list[str]:
    """Return a sentence per missing quantity with its reason, without repetitions."""
    quantities = [
        score.ate.interval_m,
        score.ate.rotation_deg,
        *(e.translation_m for e in score.rpe),
    ]
    unavailable = [quantity for quantity in quantities if isinstance(quantity, Unavailable)]
    return list(
        dict.fromkeys(f"No {quantity.what}: {quantity.reason}." for quantity in unavailable)
    )


def unaligned_sentence(score: Evaluation) -> str:
    """Caption of the map before alignment: RMSE, and the transform of the alignment."""
    x, y = score.unaligned_m, score.reference_m
    rmse_m = float(np.sqrt(((x - y) ** 2).sum(axis=1).mean()))
    alignment = score.transform
    scale_text = f", scale {alignment.scale:.3g}" if alignment.degrees_of_freedom == 7 else ""
    shift_m = float(np.linalg.norm(alignment.apply(x.mean(axis=0)) - x.mean(axis=0)))
    return (
        f"RMSE before alignment {format_metres(rmse_m)}. Alignment: rotation "
        f"{np.degrees(alignment.rotation.magnitude()):.1f}°, translation {format_metres(shift_m)}"
        f"{scale_text} (choice of frame, not an error)."
    )


def vertical_error_sentence(score: Evaluation, axis: int) -> str:
    """Caption of the side view: RMSE along the vertical axis and its share."""
    squares = ((score.estimate_m - score.reference_m) ** 2).mean(axis=0)
    name = AXES_OF_FRAME[score.reference.frame][axis]
    if not squares.any():
        return f"The error along {name} is zero."
    return (
        f"Along {name} the RMSE is {format_metres(float(np.sqrt(squares[axis])))}: "
        f"{squares[axis] / squares.sum():.0%} of the squared error."
    )


def worst_moments_sentence(score: Evaluation) -> str:
    """Caption of the APE panel: share of the squared error in the worst 10 % of the poses."""
    squares = np.sort(score.position_error_m**2)
    worst = squares[-max(1, len(squares) // 10) :].sum() / max(squares.sum(), NEGLIGIBLE_M**2)
    return (
        f"The worst 10 % of the poses contribute {worst:.0%} of the squared error. "
        "10 % means a constant error; much more means a few large errors."
    )


def quarter_rmse(score: Evaluation) -> list[float]:
    """Return the RMSE (m) of each quarter of the reference path that contains poses."""
    along = score.distance_m
    edges = np.linspace(0.0, along[-1], 5)
    quarter_index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, 3)
    errors = [score.position_error_m[quarter_index == index] for index in range(4)]
    return [float(np.sqrt(np.mean(e**2))) for e in errors if len(e)]


def quarters_sentence(score: Evaluation) -> str:
    """Caption of the APE over distance: RMSE per quarter of the path."""
    found = ", ".join(f"{rmse_m:.3f}" for rmse_m in quarter_rmse(score))
    return (
        f"RMSE per quarter of the path: {found} m. Drift grows along the path; after "
        "alignment it is large at both ends."
    )


def rpe_growth_sentence(rpe: tuple[PairwiseError, ...]) -> str:
    """Caption of the RPE panel: growth of the RPE with delta, which separates noise from drift."""
    interval_note = "RMSE with its 95 % interval."
    rmse: dict[tuple[str, float], float] = {
        (error.unit, error.delta): error.translation_m.rmse
        for error in rpe
        if isinstance(error.translation_m, Statistics) and error.translation_m.rmse > NEGLIGIBLE_M
    }
    units = [unit for unit, _ in rmse]
    unit = max(units, key=units.count, default="")
    deltas = sorted(delta for one, delta in rmse if one == unit)
    if len(deltas) < 2:
        return f"{interval_note} Give a second distance (--rpe) to distinguish noise from drift."
    low, high = deltas[0], deltas[-1]
    ratio, growth = high / low, rmse[unit, high] / rmse[unit, low]
    return (
        f"{interval_note} From {low:g} to {high:g} {unit} the RMSE grows {growth:.2g} times. "
        f"Expected: 1 for independent noise, {np.sqrt(ratio):.2g} for a random walk, {ratio:.3g} "
        "for a scale or heading error."
    )


def format_interval(interval: Interval | Unavailable) -> str:
    """Format an interval as "low–high", "" if it is missing."""
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, Interval) else ""


def describe_track(path: Trajectory) -> str:
    """Format name, kind, number of poses, duration and frame of a trajectory."""
    return (
        f"{path.name}: {path.kind}, {len(path)} poses over "
        f"{path.time_s[-1] - path.time_s[0]:.1f} s, frame {path.frame}"
    )


def describe_score(score: Evaluation) -> str:
    """Format alignment, association and time offset of a score on one line."""
    matched = score.association
    offset = score.time_offset.offset_s
    clock = "" if not offset else f"; time offset {offset:+.3f} s"
    return (
        f"alignment {score.alignment} ({score.alignment_reason.rstrip('.')}); "
        f"{matched.poses} pose pairs, {matched.coverage_estimate:.0%} of the "
        f"estimate and {matched.coverage_reference:.0%} of the reference's time{clock}"
    )
