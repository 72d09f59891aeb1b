"""Report page on trajectory errors: map, APE and RPE."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array
from px4fuse.core.text import format_metres
from px4fuse.flight.model import Unavailable
from px4fuse.loop.analysis import MIN_UNIX_TIME_S
from px4fuse.trajectory.alignment import compute_rms_length_m
from px4fuse.trajectory.evaluation import AbsoluteTrajectoryError, Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME
from px4fuse.trajectory.scores import RelativePoseError, RmseInterval, Statistics

from . import style
from .page import Page, make_columns
from .style import EKF2_COLOUR, KF_COLOUR, TRUTH_COLOUR, Axes

# Indices of the position axes to the right and upwards on a map, by frame
MAP_AXIS_INDICES = {"NED": (1, 0), "FRD": (1, 0), "camera": (0, 2)}
# Minimum pose interval of a gap in the drawn path, in median intervals
MIN_GAP_TO_MEDIAN_INTERVAL_RATIO = 10.0
MIN_DRAWN_ERROR_RANGE_M = 1e-3  # so that rounding errors look small
ERROR_PLOT_HEIGHT = 110.0  # points
MAP_HEIGHT = 150.0  # points
COLOUR_BAR_MARGIN = 40.0  # points
REFERENCE_LINE_STYLE = style.line_style(TRUTH_COLOUR, 0.8, (0, (4, 2)))


def draw_pages(evaluation: Evaluation, _: object) -> Iterator[Page]:
    """Draw the page on trajectory errors: method, table of errors, maps, and APE over time."""
    page = Page(
        "Trajectory error",
        "APE: distance of one pose from the reference (its RMSE over all poses is "
        "the ATE). RPE: error of the relative motion over a fixed distance or time.",
    )
    _write_evaluation(page, evaluation)
    _draw_maps(page, evaluation)
    _draw_ape(page, evaluation)
    yield page


def _draw_maps(page: Page, evaluation: Evaluation) -> None:
    """Draw both paths before alignment, and the aligned path coloured by error."""
    frame, is_aligned = evaluation.reference_track.frame, evaluation.alignment != "none"
    axis_indices = list(MAP_AXIS_INDICES.get(frame, (0, 1)))
    names = [AXES_OF_FRAME[frame][index] for index in axis_indices]
    left_column, right_column = columns = make_columns()
    title = f"{'Aligned path' if is_aligned else 'Path'} coloured by error"
    axes = right_column.add_panel(title, MAP_HEIGHT, right_margin=COLOUR_BAR_MARGIN)
    _draw_path(axes, evaluation, axis_indices)
    style.set_map_axes(axes, *names)
    worst_index = int(np.argmax(evaluation.position_error_m))
    worst_time_s = evaluation.time_s[worst_index] - _compute_time_origin_s(evaluation)
    right_column.write_muted_text(
        f"Darker poses have a larger error; × marks the largest one, at {worst_time_s:.1f} s, "
        f"after {evaluation.distance_m[worst_index]:.1f} m of travel."
    )
    legend_handles = axes.get_legend_handles_labels()[0]
    if not is_aligned:
        columns = [right_column]
    else:
        axes = left_column.add_panel("Before alignment", MAP_HEIGHT)
        reference_m = evaluation.reference_position_m[:, axis_indices]
        plot_path(axes, reference_m, evaluation.time_s, **REFERENCE_LINE_STYLE)
        estimate_m = evaluation.unaligned_position_m[:, axis_indices]
        plot_path(axes, estimate_m, evaluation.time_s, label="estimate", color=KF_COLOUR)
        style.set_map_axes(axes, *names)
        left_column.write_muted_text(describe_unaligned_rmse(evaluation))
        legend_handles += axes.get_legend_handles_labels()[0]
    page.add_legend(legend_handles)
    page.add_columns(*columns)


def _draw_path(axes: Axes, evaluation: Evaluation, axis_indices: list[int]) -> None:
    """Draw the aligned path coloured by APE (m), with the reference, start and largest error."""
    error_m, path_m = evaluation.position_error_m, evaluation.aligned_position_m[:, axis_indices]
    stride = max(1, len(error_m) // style.MAX_DRAWN_POINTS)
    dots = axes.scatter(
        path_m[::stride, 0],
        path_m[::stride, 1],
        c=error_m[::stride],
        s=9.0,
        cmap="copper_r",  # its colours also differ in greyscale
        linewidths=0,
        vmin=0.0,
        vmax=max(float(error_m.max()), MIN_DRAWN_ERROR_RANGE_M),
    )
    reference_m = evaluation.reference_position_m[:, axis_indices]
    plot_path(axes, reference_m, evaluation.time_s, label="reference", **REFERENCE_LINE_STYLE)
    axes.plot(*path_m[0], "o", color="white", mec="black", ms=5, mew=1.0, label="start", zorder=5)
    worst_point = path_m[np.argmax(error_m)]
    axes.plot(*worst_point, "x", color="black", ms=7, mew=1.6, label="largest error", zorder=5)
    colour_bar = axes.figure.colorbar(dots, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)))
    colour_bar.set_label("APE (m)", labelpad=1)
    colour_bar.outline.set_linewidth(0.5)


def _draw_ape(page: Page, evaluation: Evaluation) -> None:
    """Draw the absolute pose error (APE) over time, with its RMSE as a horizontal line."""
    time_origin_s = _compute_time_origin_s(evaluation)
    error_m = pd.Series(evaluation.position_error_m, evaluation.time_s - time_origin_s)
    rmse_m = evaluation.ate.translation_m.rmse
    title = f"APE over time (m); line: RMSE {format_metres(rmse_m)} m"
    axes = page.add_panel(title, ERROR_PLOT_HEIGHT)
    style.draw_curve(axes, error_m, color=KF_COLOUR, lw=0.8)
    axes.axhline(rmse_m, **style.line_style(EKF2_COLOUR, 1.4))
    axes.set_ylim(0.0, 1.08 * max(error_m.max(), MIN_DRAWN_ERROR_RANGE_M))
    axes.set_xlabel("time from the first pose (s)" if time_origin_s else "time (s)")


def plot_path(axes: Axes, positions_m: Array, time_s: Array, **style: Any) -> None:
    """Draw a path, shape (n, 2), with its gaps in time."""
    intervals_s = np.diff(time_s)
    is_gap = intervals_s > MIN_GAP_TO_MEDIAN_INTERVAL_RATIO * np.median(intervals_s)
    gap_indices = np.flatnonzero(is_gap) + 1
    axes.plot(*np.insert(positions_m, gap_indices, np.nan, axis=0).T, **style)


def _compute_time_origin_s(evaluation: Evaluation) -> float:
    """Return the time (s) of the first pose if times are UNIX time, else 0."""
    start_s = float(evaluation.time_s[0])
    return start_s if start_s > MIN_UNIX_TIME_S else 0.0


def _write_evaluation(page: Page, evaluation: Evaluation) -> None:
    """Write both trajectories, the method, warnings, the table of errors, and notes."""
    for label, track in (
        ("Estimate", evaluation.estimate_track),
        ("Against", evaluation.reference_track),
    ):
        duration_s = track.time_s[-1] - track.time_s[0]
        page.write_labelled_text(
            label,
            f"{track.name}: {track.kind}, {len(track)} poses over {duration_s:.1f} s, frame "
            f"{track.frame}",
        )
    page.write_labelled_text("Method", describe_method(evaluation))
    _write_warnings(page, evaluation)
    head = "error", "RMSE", "mean (m)", "median (m)", "std (m)", "max (m)", "n", "rotation RMSE (°)"
    page.add_table(head, _make_error_rows(evaluation), right_aligned_columns=range(2, len(head)))
    _write_notes(page, evaluation)


def _write_notes(page: Page, evaluation: Evaluation) -> None:
    """Write the reasons why parts of ATE or RPE cannot be computed, and the notes."""
    ate, rpe_translations = evaluation.ate, (error.translation_m for error in evaluation.rpe)
    missing_reasons = [
        f"No {quantity.what}: {quantity.reason}."
        for quantity in (ate.interval_m, ate.rotation_deg, *rpe_translations)
        if isinstance(quantity, Unavailable)
    ]
    page.write_muted_text(" ".join(dict.fromkeys([*missing_reasons, *evaluation.notes])))


def make_evaluation_page(evaluation: Evaluation) -> Page:
    """Make the terminal output of ``px4fuse evaluate``."""
    page = Page()
    page.write(
        f"Errors of {evaluation.estimate_track.name} against {evaluation.reference_track.name}:"
    )
    page.write(f"ATE: {format_error(evaluation.ate)}")
    for error in evaluation.rpe:
        page.write(f"RPE over {error.delta_text}: {format_error(error)}")
    _write_warnings(page, evaluation)
    page.write_muted_text(
        f"ATE: position RMSE after alignment ({evaluation.alignment}). RPE: RMSE of the change of "
        "position."
    )
    _write_notes(page, evaluation)
    return page


def _write_warnings(page: Page, evaluation: Evaluation) -> None:
    for text in evaluation.warnings:
        page.write(text, bold=True, colour=style.SEVERITY_COLOURS["warning"])


def _make_error_rows(evaluation: Evaluation) -> list[list[str]]:
    """Return the table rows: ATE, then the RPE of each distance or time."""
    rows = []
    errors: list[AbsoluteTrajectoryError | RelativePoseError] = [evaluation.ate, *evaluation.rpe]
    for error in errors:
        name = f"RPE over {error.delta_text}" if isinstance(error, RelativePoseError) else "ATE"
        statistics, cells = error.translation_m, ["–", *[""] * 5]
        if isinstance(statistics, Statistics):
            numbers = (statistics.mean, statistics.median, statistics.std, statistics.max)
            number_texts = (f"{number:.3f}" for number in numbers)
            cells = [format_error(error), *number_texts, f"{statistics.count}"]
        rows.append([name, *cells, format_rmse(error.rotation_deg)])
    return rows


def format_error(error: AbsoluteTrajectoryError | RelativePoseError) -> str:
    """Format the RMSE of positions with its 95 % interval, or the reason why it is missing."""
    translation_errors_m, interval = error.translation_m, error.interval_m
    if isinstance(translation_errors_m, Unavailable):
        return translation_errors_m.reason
    interval_text = ""
    if isinstance(interval, RmseInterval):
        interval_text = f" (95 % {interval.low:.3f} to {interval.high:.3f})"
    return f"{translation_errors_m.rmse:.3f} m{interval_text}"


def describe_unaligned_rmse(evaluation: Evaluation) -> str:
    """State the RMSE before the alignment, and rotation, translation and scale of the alignment."""
    estimate_m, reference_m = evaluation.unaligned_position_m, evaluation.reference_position_m
    rmse_m = compute_rms_length_m(estimate_m - reference_m)
    alignment = evaluation.transform
    scale_text = f", scale {alignment.scale:.3g}" if alignment.degrees_of_freedom == 7 else ""
    centre_m = estimate_m.mean(axis=0)
    shift_m = float(np.linalg.norm(alignment.apply(centre_m) - centre_m))
    return (
        f"RMSE before alignment {format_metres(rmse_m)} m. Alignment: "
        f"rotation {np.degrees(alignment.to_rotation().magnitude()):.1f}°, translation "
        f"{format_metres(shift_m)} m{scale_text}."
    )


def format_rmse(statistics: Statistics | Unavailable) -> str:
    return f"{statistics.rmse:.2f}" if isinstance(statistics, Statistics) else "–"


def describe_method(evaluation: Evaluation) -> str:
    """Describe alignment, matched poses and time offset of an evaluation as one line."""
    association, offset_s = evaluation.association, evaluation.time_offset.offset_s
    offset_text = f"; time offset {offset_s:+.3f} s" if offset_s else ""
    return (
        f"alignment {evaluation.alignment} ({evaluation.alignment_reason.rstrip('.')}); "
        f"{association.poses} pose pairs cover {association.coverage_estimate:.0%} of the "
        f"estimate's duration and {association.coverage_reference:.0%} of the reference's duration"
        f"{offset_text}"
    )
