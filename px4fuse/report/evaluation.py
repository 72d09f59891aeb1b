"""Report page on trajectory errors: map, APE and RPE."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.core.text import format_metres
from px4fuse.flight.model import Unavailable
from px4fuse.loop.analysis import MIN_UNIX_TIME_S
from px4fuse.report import style
from px4fuse.report.page import Page, make_two_columns
from px4fuse.report.style import EKF2_COLOUR, KF_COLOUR, MUTED_COLOUR, TRUTH_COLOUR, Artist, Axes
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Trajectory
from px4fuse.trajectory.scores import RelativeError, RmseInterval, Statistics

# Indices of the position axes to the right and upwards on a map, by frame
MAP_AXIS_INDICES = {"NED": (1, 0), "FRD": (1, 0), "camera": (0, 2)}
# Minimum pose interval of a gap in the drawn path, in median intervals
MIN_GAP_INTERVAL_RATIO = 10.0
MAX_PATH_POINTS = 1200  # maximum per path
MIN_ERROR_RANGE_M = 1e-3  # so that rounding errors look small
ERROR_PLOT_HEIGHT = 76.0  # points
MAP_HEIGHT = 128.0  # points
COLOUR_BAR_MARGIN = 40.0  # points
REFERENCE_LINE_STYLE = style.line_style(TRUTH_COLOUR, 0.8, (0, (4, 2)))
STATISTIC_LINES = (
    ("max", "max", style.line_style(MUTED_COLOUR, 0.8, (0, (1, 1.5)))),
    ("rmse", "RMSE", style.line_style(EKF2_COLOUR, 1.4)),
)
NEGLIGIBLE_ERROR_M = 1e-6  # smaller errors can be rounding errors


def draw_pages(evaluation: Evaluation, _: object) -> Iterator[Page]:
    page = Page(
        "Trajectory error",
        "APE: distance of one pose from the reference (its RMSE over all poses is "
        "the ATE). RPE: error of the relative motion over a fixed distance or time.",
    )
    page.write(summarise_ate(evaluation), size=9.0, bold=True)
    write_evaluation(page, evaluation)
    _draw_maps(page, evaluation)
    _draw_ape_and_rpe(page, evaluation)
    yield page


def _draw_maps(page: Page, evaluation: Evaluation) -> None:
    """Draw both paths before alignment, and the aligned path coloured by error."""
    frame, is_aligned = evaluation.reference_track.frame, evaluation.alignment != "none"
    axis_indices = list(MAP_AXIS_INDICES.get(frame, (0, 1)))
    names = [AXES_OF_FRAME[frame][index] for index in axis_indices]
    left_column, right_column = make_two_columns()
    unaligned_legend_handles: dict[str, Artist] = {}
    if is_aligned:
        axes = left_column.add_panel("Before alignment", MAP_HEIGHT)
        for position_m, line_style, label in (
            (evaluation.reference_position_m, REFERENCE_LINE_STYLE, "reference"),
            (evaluation.unaligned_position_m, {"color": KF_COLOUR, "lw": 1.2}, "estimate"),
        ):
            drawn_position_m = position_m[:, axis_indices]
            plot_path(axes, drawn_position_m, evaluation.time_s, label=label, **line_style)
        style.set_map_axes(axes, *names)
        unaligned_legend_handles = _get_legend_handles(axes)
        left_column.write_small_text(describe_unaligned_rmse(evaluation))
    title = f"{'Aligned path' if is_aligned else 'Path'} coloured by error"
    axes = right_column.add_panel(title, MAP_HEIGHT, right_margin=COLOUR_BAR_MARGIN)
    _draw_path(axes, evaluation, axis_indices)
    style.set_map_axes(axes, *names)
    right_column.write_small_text("Darker poses have a larger error; × marks the largest one.")
    # both maps share one legend
    page.add_legend([*(_get_legend_handles(axes) | unaligned_legend_handles).values()])
    page.add_columns(*[left_column] * is_aligned, right_column)


def _get_legend_handles(axes: Axes) -> dict[str, Artist]:
    handles, labels = axes.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def _draw_path(axes: Axes, evaluation: Evaluation, axis_indices: list[int]) -> None:
    error_m, path_m = evaluation.position_error_m, evaluation.aligned_position_m[:, axis_indices]
    stride = max(1, len(error_m) // MAX_PATH_POINTS)
    dots = axes.scatter(
        path_m[::stride, 0],
        path_m[::stride, 1],
        c=error_m[::stride],
        s=9.0,
        cmap="copper_r",  # differs in greyscale too
        linewidths=0,
        vmin=0.0,
        vmax=max(float(error_m.max()), MIN_ERROR_RANGE_M),
    )
    reference_m = evaluation.reference_position_m[:, axis_indices]
    plot_path(axes, reference_m, evaluation.time_s, label="reference", **REFERENCE_LINE_STYLE)
    axes.plot(*path_m[0], "o", color="white", mec="black", ms=5, mew=1.0, label="start", zorder=5)
    worst_point = path_m[np.argmax(error_m)]
    axes.plot(*worst_point, "x", color="black", ms=7, mew=1.6, label="largest error", zorder=5)
    colour_bar = axes.figure.colorbar(dots, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)))
    colour_bar.set_label("APE (m)", labelpad=1)
    colour_bar.outline.set_linewidth(0.5)


def _draw_ape_and_rpe(page: Page, evaluation: Evaluation) -> None:
    left_column, right_column = make_two_columns()
    axes = left_column.add_panel("APE over time (m)", ERROR_PLOT_HEIGHT)
    time_origin_s = compute_time_origin_s(evaluation)
    label = "time from the first pose (s)" if time_origin_s else "time (s)"
    draw_ape(axes, evaluation, evaluation.time_s - time_origin_s, label)
    page.add_legend(axes.get_legend_handles_labels()[0])
    axes = right_column.add_panel("APE over distance (m)", ERROR_PLOT_HEIGHT)
    draw_ape(axes, evaluation, evaluation.distance_m, "distance along the reference (m)")
    page.add_columns(left_column, right_column)
    if _collect_rpe_statistics(evaluation):
        left_column, right_column = make_two_columns()
        _draw_rpe(
            left_column.add_panel("RPE (m) of pose pairs at distance delta", ERROR_PLOT_HEIGHT),
            evaluation,
        )
        right_column.write(describe_rpe_growth(evaluation.rpe), colour=MUTED_COLOUR, gap_above=24.0)
        page.add_columns(left_column, right_column)


def draw_ape(axes: Axes, evaluation: Evaluation, x_values: Array, label: str) -> None:
    """Draw the absolute pose error (APE), with its RMSE and maximum as horizontal lines."""
    error_m, x_start, x_end = evaluation.position_error_m, float(x_values[0]), float(x_values[-1])
    drawn_x, drawn_errors_m = style.decimate_series(x_values, error_m)
    gap_indices = np.searchsorted(drawn_x, x_values[_find_gap_indices(evaluation.time_s)])
    curve_with_gaps = np.insert([drawn_x, drawn_errors_m], gap_indices, np.nan, axis=1)
    axes.plot(*curve_with_gaps, color=KF_COLOUR, lw=0.8)
    for name, title, line_style in STATISTIC_LINES:
        value = getattr(evaluation.ate.translation_m, name)
        axes.axhline(value, label=f"{title} {format_metres(value)} m", zorder=3, **line_style)
    axes.set(xlim=(x_start, max(x_end, x_start + 1e-6)), xlabel=label)
    axes.set_ylim(0.0, 1.08 * max(float(error_m.max()), MIN_ERROR_RANGE_M))


def _draw_rpe(axes: Axes, evaluation: Evaluation) -> None:
    for index, (error, statistics) in enumerate(
        rpe_statistics := _collect_rpe_statistics(evaluation)
    ):
        if isinstance(error.interval_m, RmseInterval):
            interval = error.interval_m.low, error.interval_m.high
            axes.plot([index] * 2, interval, color=KF_COLOUR, lw=1.6, solid_capstyle="butt")
        axes.plot(index, statistics.rmse, "D", color=EKF2_COLOUR, mec="black", mew=0.5, ms=3.6)
    delta_texts = [error.delta_text for error, _ in rpe_statistics]
    axes.set_xticks(range(len(delta_texts)), delta_texts)
    axes.set_ylim(0.0, max(1.05 * axes.get_ylim()[1], MIN_ERROR_RANGE_M))
    axes.margins(x=0.1)
    axes.set_xlabel("delta: distance, time or frames between poses")


def _collect_rpe_statistics(evaluation: Evaluation) -> list[tuple[RelativeError, Statistics]]:
    return [(e, e.translation_m) for e in evaluation.rpe if isinstance(e.translation_m, Statistics)]


def _find_gap_indices(time_s: Array) -> IntArray:
    intervals_s = np.diff(time_s)
    is_gap = intervals_s > MIN_GAP_INTERVAL_RATIO * np.median(intervals_s)
    return np.asarray(np.flatnonzero(is_gap) + 1)


def plot_path(axes: Axes, positions_m: Array, time_s: Array, **style: Any) -> None:
    """Draw a path, shape (n, 2), with its gaps in time."""
    gap_indices, count = _find_gap_indices(time_s), len(positions_m)
    evenly_spaced_indices = np.linspace(0, count - 1, min(count, MAX_PATH_POINTS)).astype(np.intp)
    drawn_indices = np.unique(np.concatenate([evenly_spaced_indices, gap_indices]))
    gap_rows = np.searchsorted(drawn_indices, gap_indices)
    axes.plot(*np.insert(positions_m[drawn_indices], gap_rows, np.nan, axis=0).T, **style)


def compute_time_origin_s(evaluation: Evaluation) -> float:
    """Return the time (s) of the first pose if times are UNIX time, else 0."""
    start_s = float(evaluation.time_s[0])
    return start_s if start_s > MIN_UNIX_TIME_S else 0.0


def summarise_ate(evaluation: Evaluation) -> str:
    """Summarise ATE and largest position error."""
    worst_index = int(np.argmax(evaluation.position_error_m))
    preposition = "without" if evaluation.alignment == "none" else "after"
    error, time_s = (
        evaluation.ate.translation_m,
        evaluation.time_s - compute_time_origin_s(evaluation),
    )
    return (
        f"ATE {format_metres(error.rmse)} m (RMSE {preposition} alignment). Largest error "
        f"{format_metres(error.max)} m at {time_s[worst_index]:.1f} s, after a path of "
        f"{evaluation.distance_m[worst_index]:.1f} m."
    )


def write_evaluation(page: Page, evaluation: Evaluation) -> None:
    page.write_labelled("Estimate", describe_track(evaluation.estimate_track))
    page.write_labelled("Against", describe_track(evaluation.reference_track))
    page.write_labelled("Method", describe_method(evaluation))
    for text in evaluation.warnings:
        page.write(text, bold=True, colour=style.SEVERITY_COLOURS["warning"])
    head = ["error", "RMSE", "95 %", "mean", "median", "std", "max", "n", "rotation\nRMSE (°)"]
    page.add_table(head, make_error_rows(evaluation), right_aligned_columns=range(1, len(head)))
    page.write_small_text(" ".join([*list_missing_reasons(evaluation), *evaluation.notes]))


def make_error_rows(evaluation: Evaluation) -> list[list[str]]:
    error_by_name: dict[str, AbsoluteError | RelativeError] = {"ATE (m)": evaluation.ate}
    error_by_name |= {f"RPE {error.delta_text} (m)": error for error in evaluation.rpe}
    rows = []
    for name, error in error_by_name.items():
        errors_m, errors_deg = error.translation_m, error.rotation_deg
        cells = ["–", *[""] * 6]
        if isinstance(errors_m, Statistics):
            numbers = (errors_m.mean, errors_m.median, errors_m.std, errors_m.max)
            cells = [f"{errors_m.rmse:.4f}", format_interval(error.interval_m)]
            cells += [*(f"{number:.4f}" for number in numbers), f"{errors_m.count}"]
        rotation_text = f"{errors_deg.rmse:.2f}" if isinstance(errors_deg, Statistics) else "–"
        rows.append([name, *cells, rotation_text])
    return rows


def list_missing_reasons(evaluation: Evaluation) -> list[str]:
    ate, rpe_translations = evaluation.ate, (error.translation_m for error in evaluation.rpe)
    reasons = {
        f"No {quantity.what}: {quantity.reason}.": None
        for quantity in (ate.interval_m, ate.rotation_deg, *rpe_translations)
        if isinstance(quantity, Unavailable)
    }
    return list(reasons)


def describe_unaligned_rmse(evaluation: Evaluation) -> str:
    estimate_m, reference_m = evaluation.unaligned_position_m, evaluation.reference_position_m
    rmse_m = float(np.sqrt(((estimate_m - reference_m) ** 2).sum(axis=1).mean()))
    alignment = evaluation.transform
    scale_text = f", scale {alignment.scale:.3g}" if alignment.degrees_of_freedom == 7 else ""
    centre_m = estimate_m.mean(axis=0)
    shift_m = float(np.linalg.norm(alignment.apply(centre_m) - centre_m))
    return (
        f"RMSE before alignment {format_metres(rmse_m)} m. The alignment corrects the frame, not "
        f"errors: rotation {np.degrees(alignment.to_rotation().magnitude()):.1f}°, translation "
        f"{format_metres(shift_m)} m{scale_text}."
    )


def describe_rpe_growth(rpe: tuple[RelativeError, ...]) -> str:
    """Describe the growth of the relative pose error (RPE) with distance or time."""
    interval_note = "RMSE with its 95 % interval."
    rmse_by_unit_and_delta: dict[tuple[str, float], float] = {
        (error.unit, error.delta): error.translation_m.rmse
        for error in rpe
        if isinstance(error.translation_m, Statistics)
        and error.translation_m.rmse > NEGLIGIBLE_ERROR_M
    }
    units = [unit for unit, _ in rmse_by_unit_and_delta]
    unit = max(units, key=units.count, default="")
    deltas = sorted(delta for delta_unit, delta in rmse_by_unit_and_delta if delta_unit == unit)
    if len(deltas) < 2:
        return f"{interval_note} Add a distance (--rpe): drift grows with distance, noise does not."
    smallest_delta, *_, largest_delta = deltas
    delta_ratio = largest_delta / smallest_delta
    rmse_growth_factor = (
        rmse_by_unit_and_delta[unit, largest_delta] / rmse_by_unit_and_delta[unit, smallest_delta]
    )
    return (
        f"{interval_note} From {smallest_delta:g} to {largest_delta:g} {unit}, the RMSE grows "
        f"{rmse_growth_factor:.2g} times. Expected factor: 1 for independent noise, "
        f"{np.sqrt(delta_ratio):.2g} for a random walk, {delta_ratio:.3g} for a scale or heading "
        "error."
    )


def format_interval(interval: RmseInterval | Unavailable) -> str:
    return f"{interval.low:.3f}–{interval.high:.3f}" if isinstance(interval, RmseInterval) else ""


def describe_track(track: Trajectory) -> str:
    return (
        f"{track.name}: {track.kind}, {len(track)} poses over "
        f"{track.time_s[-1] - track.time_s[0]:.1f} s, frame {track.frame}"
    )


def describe_method(evaluation: Evaluation) -> str:
    association, offset_s = evaluation.association, evaluation.time_offset.offset_s
    method_texts = [
        f"alignment {evaluation.alignment} ({evaluation.alignment_reason.rstrip('.')})",
        f"{association.poses} pose pairs, which cover {association.coverage_estimate:.0%} of the "
        f"time of the estimate and {association.coverage_reference:.0%} of the time of the "
        "reference",
    ]
    return "; ".join(method_texts + [f"time offset {offset_s:+.3f} s"] * bool(offset_s))
