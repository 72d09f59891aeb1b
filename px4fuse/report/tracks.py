"""Tracks: the flight from above, position and velocity of both filters with our 2σ band."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import AgainstTruth, AxisComparison, Difference
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2_LINE,
    MAX_POINTS_NARROW,
    MEASUREMENT,
    OURS_BAND,
    OURS_LINE,
    TRUTH_LINE,
    caption,
    empty,
    page,
    panels,
    thin,
)

thin_narrow = partial(thin, limit=MAX_POINTS_NARROW)


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page with a row per axis: position, its error, velocity."""
    comparison = document.comparison
    known = not isinstance(comparison.flight.truth, Unavailable)
    figure, cursor = page(
        "Tracks",
        "Position is measured (grey dots), velocity never is: the filter infers it. The middle "
        f"column shows {'each filter minus the truth' if known else 'our filter minus EKF2'}, on "
        "a scale on which it can be seen; outside our ±2σ band (blue) our own variance is too "
        "small. The numbers below each panel, not its looks, decide.",
    )
    rows = len(comparison.axes)
    grid = panels(figure, cursor.y - 0.035, BOTTOM + 0.05, rows, 3, hspace=0.44, wspace=0.22)
    for row, result in zip(grid, comparison.axes, strict=True):
        name = result.axis.name
        row[0].set_title(f"{name}: position (m)")
        row[0].plot(
            *thin_narrow(result.axis.measurement_time_s, result.axis.measurement_m),
            ".", color=MEASUREMENT, ms=1.6, mew=0, label="measurement",
        )  # fmt: skip
        _lines(row[0], result, "position_m", "position_variance_m2")
        _errors(row[1], result)
        row[2].set_title(f"{name}: velocity (m/s)")
        _lines(row[2], result, "velocity_m_s", "velocity_variance_m2_s2")
        for axes in row:
            axes.set_xlim(comparison.segment.start_s, comparison.segment.end_s)
            if row is grid[-1]:
                axes.set_xlabel("time since first data (s)")
        _numbers(row, result)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="lower left", ncols=len(labels), markerscale=3.0,
        bbox_to_anchor=(grid[0][0].get_position().x0 - 0.012, cursor.y - 0.02), borderaxespad=0.0,
    )  # fmt: skip
    yield figure


def _errors(axes: Axes, result: AxisComparison) -> None:
    """Position errors against truth, or the difference to EKF2 where there is no truth."""
    steps = result.replay.steps
    time = steps.index.to_numpy()
    sigma = np.sqrt(steps["position_variance_m2"].to_numpy())
    band_time, band = thin_narrow(time, 2.0 * sigma)
    reference = result.truth if isinstance(result.truth, pd.DataFrame) else result.ekf2_state
    if isinstance(reference, Unavailable):
        empty(axes, f"No error to draw: {reference.reason}.")
        return
    against = "truth" if reference is result.truth else "EKF2"
    axes.set_title(f"{result.axis.name}: position - {against} (m)")
    axes.fill_between(band_time, -band, band, color=OURS_BAND, lw=0)
    axes.axhline(0.0, color="black", lw=0.5)
    error = steps["position_m"].to_numpy() - _at(reference, time)
    scale = [np.nanmax(np.abs(error)), 2.2 * float(np.median(sigma))]
    if against == "truth" and isinstance(result.ekf2_state, pd.DataFrame):
        ekf2_time = result.ekf2_state.index.to_numpy()
        ekf2_error = result.ekf2_state["position_m"].to_numpy() - _at(reference, ekf2_time)
        axes.plot(*thin_narrow(ekf2_time, ekf2_error), **EKF2_LINE, zorder=2.5)
        scale.append(np.nanmax(np.abs(ekf2_error)))
    axes.plot(*thin_narrow(time, error), **OURS_LINE)
    axes.set_ylim(-1.1 * max(scale), 1.1 * max(scale))


def _at(frame: pd.DataFrame, times: Array) -> Array:
    at: Array = np.interp(times, frame.index, frame["position_m"], left=np.nan, right=np.nan)
    return at


def _lines(axes: Axes, result: AxisComparison, column: str, variance: str) -> None:
    steps = result.replay.steps
    time, value = steps.index.to_numpy(), steps[column].to_numpy()
    sigma = np.sqrt(steps[variance].to_numpy())
    band_time, upper = thin_narrow(time, value + 2.0 * sigma)
    lower = np.interp(band_time, time, value - 2.0 * sigma)
    axes.fill_between(band_time, lower, upper, color=OURS_BAND, lw=0, label="ours ±2σ")
    if isinstance(result.ekf2_state, pd.DataFrame):
        axes.plot(*_series(result.ekf2_state, column), **EKF2_LINE, zorder=2.5, label="EKF2")
    axes.plot(*thin_narrow(time, value), **OURS_LINE, label="ours")
    if isinstance(result.truth, pd.DataFrame) and result.truth[column].notna().any():
        axes.plot(*_series(result.truth, column), **TRUTH_LINE, label="truth")
    _limit(axes, value, result, column)


def _series(frame: pd.DataFrame, column: str) -> tuple[Array, Array]:
    return thin_narrow(frame.index.to_numpy(), frame[column].to_numpy())


def _limit(axes: Axes, value: Array, result: AxisComparison, column: str) -> None:
    """Scale to the tracks, not to the wide band of the first second."""
    series = [value]
    for frame in (result.ekf2_state, result.truth):
        if isinstance(frame, pd.DataFrame):
            series.append(frame[column].dropna().to_numpy())
    every = np.concatenate(series)
    low, high = np.min(every), np.max(every)
    pad = 0.08 * (high - low) + 1e-3
    axes.set_ylim(low - pad, high + pad)


def _numbers(row: list[Axes], result: AxisComparison) -> None:
    updates = result.replay.updates
    captions: tuple[list[str], list[str], list[str]] = ([f"{len(updates)} measurements"], [], [])
    for name, part in (("ours", result.kf_truth), ("EKF2", result.ekf2_truth)):
        if isinstance(part, AgainstTruth):
            captions[1].append(f"{name}: RMSE {part.position_rmse_m:.3f} m to truth")
            if part.velocity_rmse_m_s is not None:
                captions[2].append(f"{name}: RMSE {part.velocity_rmse_m_s:.3f} m/s to truth")
    if isinstance(result.difference, Difference):
        difference = result.difference
        captions[1].append(
            f"ours - EKF2: RMSE {difference.position_rmse_m:.3f}, "
            f"max {difference.position_maximum_m:.2f} m"
        )
        captions[2].append(
            f"ours - EKF2: RMSE {difference.velocity_rmse_m_s:.3f}, "
            f"max {difference.velocity_maximum_m_s:.2f} m/s"
        )
        captions[0].append(f"ours - EKF2: mean {difference.position_mean_m:+.3f} m")
    else:
        captions[0].append(f"{result.difference.what}: {result.difference.reason}")
    for axes, texts in zip(row, captions, strict=True):
        if axes.axison:
            caption(axes, "\n".join(texts), size=6.8)
