"""Page on trajectory errors: map coloured by error, APE and RPE (the names of the tool evo)."""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.flight.model import Unavailable
from px4fuse.loop.analysis import MIN_UNIX_TIME_S
from px4fuse.report import style
from px4fuse.report.page import PAGE_WIDTH, Page, halves
from px4fuse.report.style import EKF2_COLOUR, KF_COLOUR, MUTED_COLOUR, TRUTH_COLOUR, Axes, Colormap
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Frame, Trajectory
from px4fuse.trajectory.scores import Interval, RelativeError, Statistics

# Indices of the coordinates drawn to the right, drawn upwards, and vertical; True if that is down
PAGE_AXES: Mapping[Frame, tuple[int, int, int, bool]] = {
    "NED": (1, 0, 2, True),
    "FRD": (1, 0, 2, True),
    "ENU": (0, 1, 2, False),
    "camera": (0, 2, 1, True),
    "unknown": (0, 1, 2, False),
}
# Maximum height / length of a path whose page has no side view
MAX_FLAT_RATIO = 0.1
# Minimum time between two poses, in median times, at which the drawn path is interrupted
MIN_GAP_STEPS = 10.0
MAX_PATH_POINTS = 1200
MIN_ERROR_RANGE_M = 1e-3  # minimum range of an error axis, so that rounding errors look small
PANEL_HEIGHT, MAP_HEIGHT, MAP_GAP = 76.0, 128.0, 16.0  # heights and gap (points)
MAX_DELTA_LABELS = 12
REFERENCE_LINE = style.line_style(TRUTH_COLOUR, 0.8, (0, (4, 2)))
STATISTIC_LINES = (
    ("max", "max", style.line_style(MUTED_COLOUR, 0.8, (0, (1, 1.5)))),
    ("rmse", "RMSE", style.line_style(EKF2_COLOUR, 1.4)),
    ("mean", "mean", style.line_style("black", 0.9, (0, (5, 2)))),
    ("median", "median", style.line_style("black", 0.9, (0, (5, 1.5, 1, 1.5)))),
)
NEGLIGIBLE_ERROR_M = 1e-6  # smaller errors are rounding errors
SHADES_CAPTION = "Darker poses have a larger error; × marks the largest one."
ERROR_TABLE_HEAD = (
    "error",
    "RMSE",
    "95 %",
    "mean",
    "median",
    "std",
    "max",
    "n",
    "rotation\nRMSE (°)",
)


@cache
def error_colours() -> Colormap:
    """Return a colour map from light to dark that stays readable in grey and on white."""
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    rgba = mpl.colormaps["YlOrRd"](np.linspace(0.3, 1.0, 128)) * (1.0, 1.0, 1.0, 1.0)
    rgba[:, :3] *= np.linspace(1.0, 0.55, 128)[:, np.newaxis]
    return LinearSegmentedColormap.from_list("error", rgba)


class View(NamedTuple):
    """View of a path: indices and names of the coordinates drawn to the right and upwards."""

    across: int
    up: int
    is_down: bool
    names: tuple[str, str]

    def project(self, position_m: Array) -> Array:
        """Project positions, shape (n, 3), to page coordinates, shape (n, 2)."""
        return np.asarray(position_m[:, (self.across, self.up)])


def path_views(evaluation: Evaluation) -> list[View]:
    """Return the view from above, and the side view if the path is not flat."""
    across, up, vertical_axis, is_down = PAGE_AXES[evaluation.reference.frame]
    names = AXES_OF_FRAME[evaluation.reference.frame]
    extent = np.maximum(
        np.ptp(evaluation.reference_m, axis=0), np.ptp(evaluation.estimate_m, axis=0)
    )
    horizontal_axis = across if extent[across] >= extent[up] else up
    all_views = [
        View(across, up, False, (names[across], names[up])),
        View(
            horizontal_axis, vertical_axis, is_down, (names[horizontal_axis], names[vertical_axis])
        ),
    ]
    return (
        all_views
        if extent[vertical_axis] > MAX_FLAT_RATIO * extent[horizontal_axis]
        else all_views[:1]
    )


def draw(evaluation: Evaluation, _: object) -> Iterator[Page]:
    """Draw the evaluation of a trajectory: ATE and RPE, maps and error plots."""
    page = Page(
        "Trajectory error",
        (
            "APE: distance of one pose from the reference (its RMSE over all poses is "
            "the ATE). RPE: error of the relative motion over a fixed distance or time."
        ),
    )
    page.write(summary(evaluation), size=9.0, bold=True)
    write_evaluation(page, evaluation)
    _draw_maps(page, evaluation)
    _draw_panels(page, evaluation)
    yield page


def _draw_maps(page: Page, evaluation: Evaluation) -> None:
    """Draw both paths before alignment, and in each view the aligned path coloured by error."""
    map_views, is_aligned = path_views(evaluation), evaluation.alignment != "none"
    count = len(map_views) + is_aligned
    width = (PAGE_WIDTH - MAP_GAP * (count - 1)) / count
    columns, estimate_handle = [], []
    if is_aligned:
        columns.append(Page(width=width))
        axes = columns[-1].panel("Before alignment", "", MAP_HEIGHT, left=34.0)
        for position, line_style, label in (
            (evaluation.reference_m, REFERENCE_LINE, "reference"),
            (evaluation.unaligned_m, {"color": KF_COLOUR, "lw": 1.2}, "estimate"),
        ):
            plot_path(
                axes, map_views[0].project(position), evaluation.time_s, label=label, **line_style
            )
        _set_map_frame(axes, map_views[0])
        estimate_handle = axes.get_legend_handles_labels()[0][1:]
        columns[-1].write_small(unaligned_sentence(evaluation))
    for view in map_views:
        columns.append(Page(width=width))
        title = f"{'Aligned path' if is_aligned else 'Path'} coloured by error"
        axes = columns[-1].panel(title, "", MAP_HEIGHT, left=34.0, right=40.0)
        draw_path(axes, evaluation, view)
        columns[-1].write_small(
            SHADES_CAPTION if view is map_views[0] else vertical_error_sentence(evaluation, view.up)
        )
    page.legend([*axes.get_legend_handles_labels()[0], *estimate_handle])
    page.add_columns(*columns, gap=MAP_GAP)


def draw_path(axes: Axes, evaluation: Evaluation, view: View) -> None:
    """Draw the aligned path coloured by error, with the reference dashed."""
    error, path = evaluation.position_error_m, view.project(evaluation.estimate_m)
    stride = max(1, len(error) // MAX_PATH_POINTS)
    scatter_points = axes.scatter(
        path[::stride, 0],
        path[::stride, 1],
        c=error[::stride],
        s=9.0,
        cmap=error_colours(),
        linewidths=0,
        vmin=0.0,
        vmax=max(float(error.max()), MIN_ERROR_RANGE_M),
    )
    plot_path(
        axes,
        view.project(evaluation.reference_m),
        evaluation.time_s,
        label="reference",
        **REFERENCE_LINE,
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


def _draw_panels(page: Page, evaluation: Evaluation) -> None:
    left, right = halves()
    axes = left.panel("APE over time (m)", "", PANEL_HEIGHT)
    draw_ape(axes, evaluation, *time_from_start(evaluation))
    page.legend(axes.get_legend_handles_labels()[0])
    left.write_small(worst_poses_sentence(evaluation))
    axes = right.panel("APE over distance (m)", "", PANEL_HEIGHT)
    draw_ape(axes, evaluation, evaluation.distance_m, "distance along the reference (m)")
    right.write_small(quarters_sentence(evaluation))
    page.add_columns(left, right)
    if _rpe_statistics(evaluation):
        left, right = halves()
        _draw_rpe(left.panel("RPE per delta (m)", "", PANEL_HEIGHT), evaluation)
        right.write(rpe_growth_sentence(evaluation.rpe), colour=MUTED_COLOUR, above=24.0)
        page.add_columns(left, right)


def draw_ape(axes: Axes, evaluation: Evaluation, x_values: Array, label: str) -> None:
    """Draw the APE with its RMSE, mean, median and maximum as horizontal lines."""
    error, low, high = evaluation.position_error_m, float(x_values[0]), float(x_values[-1])
    shown_along, values = style.decimate_series(x_values, error, style.MAX_POINTS_NARROW)
    gap_indices = np.searchsorted(shown_along, x_values[_gap_indices(evaluation.time_s)])
    axes.plot(
        np.insert(shown_along, gap_indices, np.nan),
        np.insert(values, gap_indices, np.nan),
        color=KF_COLOUR,
        lw=0.8,
    )
    for name, title, line_style in STATISTIC_LINES:
        value = getattr(evaluation.ate.translation_m, name)
        axes.axhline(value, label=f"{title} {format_metres(value)}", zorder=3, **line_style)
    axes.set(xlim=(low, max(high, low + 1e-6)), xlabel=label)
    axes.set_ylim(0.0, 1.08 * max(float(error.max()), MIN_ERROR_RANGE_M))
    axes.locator_params(axis="x", nbins=6)
    axes.locator_params(axis="y", nbins=4)


def _draw_rpe(axes: Axes, evaluation: Evaluation) -> None:
    for index, (error, statistics) in enumerate(rpe_statistics := _rpe_statistics(evaluation)):
        if isinstance(error.interval_m, Interval):
            interval = error.interval_m.low, error.interval_m.high
            axes.plot([index] * 2, interval, color=KF_COLOUR, lw=1.6, solid_capstyle="butt")
        axes.plot(index, statistics.rmse, "D", color=EKF2_COLOUR, mec="black", mew=0.5, ms=3.6)
    shown_indices = range(0, len(rpe_statistics), 1 + len(rpe_statistics) // MAX_DELTA_LABELS)
    axes.set_xticks(shown_indices, [rpe_statistics[index][0].delta_text for index in shown_indices])
    axes.set_ylim(0.0, max(1.05 * axes.get_ylim()[1], MIN_ERROR_RANGE_M))
    axes.margins(x=0.1)
    axes.set_xlabel("delta")


def _rpe_statistics(evaluation: Evaluation) -> list[tuple[RelativeError, Statistics]]:
    return [(e, e.translation_m) for e in evaluation.rpe if isinstance(e.translation_m, Statistics)]


def time_from_start(evaluation: Evaluation) -> tuple[Array, str]:
    """Return the time of each pose since the origin of the time axis (s), and the axis label."""
    origin_s = time_origin_s(evaluation)
    return evaluation.time_s - origin_s, "time from the first pose (s)" if origin_s else "time (s)"


def _gap_indices(time_s: Array) -> IntArray:
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


def format_metres(value: float) -> str:
    """Format a length with three decimals, one from 10 m on.

    >>> format_metres(0.0512), format_metres(31.26)
    ('0.051 m', '31.3 m')
    """
    return f"{value:.3f} m" if abs(value) < 10.0 else f"{value:.1f} m"


def time_origin_s(evaluation: Evaluation) -> float:
    """Return the origin of the time axes: the first pose if timestamps are UNIX time, else 0 s."""
    start = float(evaluation.time_s[0])
    return start if start > MIN_UNIX_TIME_S else 0.0


def summary(evaluation: Evaluation) -> str:
    """Summarise ATE and largest position error in one line."""
    worst_index = int(np.argmax(evaluation.position_error_m))
    preposition = "without" if evaluation.alignment == "none" else "after"
    error = evaluation.ate.translation_m
    return (
        f"ATE {format_metres(error.rmse)} (RMSE {preposition} alignment). Largest error "
        f"{format_metres(error.max)} at "
        f"{evaluation.time_s[worst_index] - time_origin_s(evaluation):.1f} s, after "
        f"{evaluation.distance_m[worst_index]:.1f} m of the path."
    )


def write_evaluation(page: Page, evaluation: Evaluation) -> None:
    """Write estimate, reference, method and the table of error statistics."""
    page.write_labelled("Estimate", describe_track(evaluation.estimate))
    page.write_labelled("Against", describe_track(evaluation.reference))
    page.write_labelled("Method", describe_method(evaluation))
    for text in evaluation.warnings:
        page.write(text, bold=True, colour=style.SEVERITY_COLOURS["warning"])
    page.table(
        ERROR_TABLE_HEAD,
        error_rows(evaluation),
        right_aligned_columns=range(1, len(ERROR_TABLE_HEAD)),
    )
    page.write_small(" ".join([*missing_reasons(evaluation), *evaluation.notes]))


def error_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return the table rows of the ATE and of each RPE, with the columns of ERROR_TABLE_HEAD."""
    errors: dict[str, AbsoluteError | RelativeError] = {"ATE (m)": evaluation.ate}
    errors |= {f"RPE {error.delta_text} (m)": error for error in evaluation.rpe}
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


def missing_reasons(evaluation: Evaluation) -> list[str]:
    """Return a sentence with the reason for each missing quantity, without repetitions."""
    quantities = [
        evaluation.ate.interval_m,
        evaluation.ate.rotation_deg,
        *(error.translation_m for error in evaluation.rpe),
    ]
    unavailable = [quantity for quantity in quantities if isinstance(quantity, Unavailable)]
    return list(
        dict.fromkeys(f"No {quantity.what}: {quantity.reason}." for quantity in unavailable)
    )


def unaligned_sentence(evaluation: Evaluation) -> str:
    """Caption of the map before alignment: RMSE, and the transform of the alignment."""
    estimate_m, reference_m = evaluation.unaligned_m, evaluation.reference_m
    rmse_m = float(np.sqrt(((estimate_m - reference_m) ** 2).sum(axis=1).mean()))
    alignment = evaluation.transform
    scale_text = f", scale {alignment.scale:.3g}" if alignment.degrees_of_freedom == 7 else ""
    shift_m = float(
        np.linalg.norm(alignment.apply(estimate_m.mean(axis=0)) - estimate_m.mean(axis=0))
    )
    return (
        f"RMSE before alignment {format_metres(rmse_m)}. Alignment: rotation "
        f"{np.degrees(alignment.rotation.magnitude()):.1f}°, translation {format_metres(shift_m)}"
        f"{scale_text} (choice of frame, not an error)."
    )


def vertical_error_sentence(evaluation: Evaluation, axis: int) -> str:
    """State the RMSE along the vertical axis and its fraction of the mean squared error."""
    squares = ((evaluation.estimate_m - evaluation.reference_m) ** 2).mean(axis=0)
    name = AXES_OF_FRAME[evaluation.reference.frame][axis]
    if not squares.any():
        return "Estimate and reference are equal: the RMSE is zero along every axis."
    return (
        f"Along {name} the RMSE is {format_metres(float(np.sqrt(squares[axis])))}: "
        f"{squares[axis] / squares.sum():.0%} of the squared error."
    )


def worst_poses_sentence(evaluation: Evaluation) -> str:
    """State the fraction of the squared error that the worst 10 % of the poses contribute."""
    squared_errors = np.sort(evaluation.position_error_m**2)
    worst_share = squared_errors[-max(1, len(squared_errors) // 10) :].sum() / max(
        squared_errors.sum(), NEGLIGIBLE_ERROR_M**2
    )
    return (
        f"The worst 10 % of the poses contribute {worst_share:.0%} of the squared error. "
        "A constant error contributes 10 %; a few large errors contribute much more."
    )


def quarter_rmse(evaluation: Evaluation) -> list[float]:
    """Return the RMSE (m) of each quarter of the reference path that contains poses."""
    distance_m = evaluation.distance_m
    edges = np.linspace(0.0, distance_m[-1], 5)
    quarter_index = np.clip(np.searchsorted(edges, distance_m, side="right") - 1, 0, 3)
    errors = [evaluation.position_error_m[quarter_index == index] for index in range(4)]
    return [float(np.sqrt(np.mean(e**2))) for e in errors if len(e)]


def quarters_sentence(evaluation: Evaluation) -> str:
    """Caption of the APE over distance: RMSE per quarter of the path."""
    rmse_text = ", ".join(f"{rmse_m:.3f}" for rmse_m in quarter_rmse(evaluation))
    return (
        f"RMSE per quarter of the path: {rmse_text} m. Drift grows along the path. After "
        "alignment its error is large at both ends."
    )


def rpe_growth_sentence(rpe: tuple[RelativeError, ...]) -> str:
    """Caption of the RPE panel: growth of the RPE with delta, which separates noise from drift."""
    interval_note = "RMSE with its 95 % interval."
    rmse: dict[tuple[str, float], float] = {
        (error.unit, error.delta): error.translation_m.rmse
        for error in rpe
        if isinstance(error.translation_m, Statistics)
        and error.translation_m.rmse > NEGLIGIBLE_ERROR_M
    }
    units = [unit for unit, _ in rmse]
    unit = max(units, key=units.count, default="")
    deltas = sorted(delta for delta_unit, delta in rmse if delta_unit == unit)
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
    """Format an interval as "low–high"; "" if it is unavailable."""
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, Interval) else ""


def describe_track(path: Trajectory) -> str:
    """Format name, kind, number of poses, duration and frame of a trajectory."""
    return (
        f"{path.name}: {path.kind}, {len(path)} poses over "
        f"{path.time_s[-1] - path.time_s[0]:.1f} s, frame {path.frame}"
    )


def describe_method(evaluation: Evaluation) -> str:
    """Format alignment, association and time offset of an evaluation on one line."""
    association = evaluation.association
    offset = evaluation.time_offset.offset_s
    offset_text = "" if not offset else f"; time offset {offset:+.3f} s"
    return (
        f"alignment {evaluation.alignment} ({evaluation.alignment_reason.rstrip('.')}); "
        f"{association.poses} pose pairs, {association.coverage_estimate:.0%} of the "
        f"estimate and {association.coverage_reference:.0%} of the reference's time{offset_text}"
    )
