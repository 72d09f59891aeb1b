"""Variances: a zoom in which σ grows on predict and shrinks on update, and the whole flight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import AxisComparison, FilterSummary
from px4fuse.filter.signals import Segment
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    EKF2_LINE,
    MEASUREMENT,
    OURS,
    OURS_LINE,
    caption,
    page,
    panels,
    thin,
)

ZOOM_UPDATES = 15
ZOOM_RANGE_S = (1.0, 12.0)
START_S = 5.0


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page: two zooms on one axis, then σ_p and σ_v of the flight, log scale."""
    comparison = document.comparison
    main = comparison.main
    others = [a for a in comparison.axes if a.axis.name == "down" and a is not main]
    figure, cursor = page(
        "Variances",
        "Between two measurements nothing corrects the filter, so its variance grows with SIGMA_A "
        "(predict); each measurement makes it shrink by the gain (update). EKF2 does the same: its "
        "σ before and after each logged update follows from its S and R.",
    )
    top = cursor.y - 0.03
    split = top - 0.42 * (top - BOTTOM)
    zoom = panels(figure, top, split, 1, 2, widths=(2.3, 1.0), wspace=0.17)[0]
    segment = comparison.segment
    window = zoom_window(main, segment)
    _sawtooth(zoom[0], main, window)
    zoom[0].set_title(
        f"{main.axis.name}: σ of position (m), {window[1] - window[0]:.1f} s of flight"
    )
    caption(zoom[0], _zoom_words(main))
    first = main.replay.steps.index[0]
    _sawtooth(zoom[1], main, (first, min(first + START_S, segment.end_s)), legend=False)
    zoom[1].set_title("the first seconds (log scale)")
    zoom[1].set_yscale("log")
    _log_ticks(zoom[1])
    initial = np.sqrt(main.replay.steps["position_variance_m2"].iloc[0])
    caption(
        zoom[1],
        f"From P₀ (σ_p {initial:g} m) to its steady state: what the first measurements teach.",
    )
    rows = [main, *others]
    lower = panels(figure, split - 0.085, BOTTOM + 0.045, len(rows), 2, hspace=0.4, wspace=0.17)
    for row, result in zip(lower, rows, strict=True):
        _flight(row[0], result, "position_variance_m2", "m")
        _flight(row[1], result, "velocity_variance_m2_s2", "m/s")
        for axes in row:
            axes.set_xlim(segment.start_s, segment.end_s)
            if row is lower[-1]:
                axes.set_xlabel("time since first data (s)")
        _numbers(row, result)
    yield figure


def zoom_window(result: AxisComparison, segment: Segment) -> tuple[float, float]:
    """Part of the flight with about fifteen updates, in the middle of what EKF2 logged too."""
    updates = result.replay.updates.index.to_numpy()
    length = (
        float(np.clip(ZOOM_UPDATES * np.median(np.diff(updates)), *ZOOM_RANGE_S))
        if len(updates) > 1
        else ZOOM_RANGE_S[0]
    )
    times = updates
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        times = result.ekf2_innovations.index.to_numpy()
    middle = float(times[len(times) // 2])
    start = float(
        np.clip(
            middle - length / 2.0, segment.start_s, max(segment.end_s - length, segment.start_s)
        )
    )
    return start, min(start + length, segment.end_s)


def sawtooth(result: AxisComparison) -> tuple[Array, Array]:
    """Time and σ_p of our filter with both values at each update: just before and just after."""
    steps, updates = result.replay.steps, result.replay.updates
    time = np.concatenate([updates.index.to_numpy(), steps.index.to_numpy()])
    variance = np.concatenate(
        [
            updates["prior_position_variance_m2"].to_numpy(),
            steps["position_variance_m2"].to_numpy(),
        ]
    )
    order = np.argsort(time, kind="stable")  # the prior stands first at equal times
    return time[order], np.sqrt(variance[order])


def _sawtooth(
    axes: Axes, result: AxisComparison, window: tuple[float, float], *, legend: bool = True
) -> None:
    time, sigma = sawtooth(result)
    shown = (time >= window[0]) & (time <= window[1])
    axes.plot(time[shown], sigma[shown], color=OURS, lw=1.1, marker=".", ms=2.4, mew=0,
              label="ours: predict, update")  # fmt: skip
    updates = result.replay.updates.index.to_numpy()
    inside = updates[(updates >= window[0]) & (updates <= window[1])]
    frame = result.ekf2_innovations
    if isinstance(frame, pd.DataFrame):
        cut = frame[(frame.index >= window[0]) & (frame.index <= window[1])]
        cut = cut.dropna(subset=["prior_variance_m2"])
        before = np.sqrt(cut["prior_variance_m2"].to_numpy())
        after = np.sqrt(cut["posterior_variance_m2"].to_numpy())
        at = cut.index.to_numpy()
        axes.vlines(at, after, before, color=EKF2, lw=1.0)
        axes.plot(at, before, ls="none", marker="^", ms=3.6, mew=0.7, mfc="none", color=EKF2,
                  label="EKF2 just before an update")  # fmt: skip
        axes.plot(at, after, ls="none", marker="v", ms=3.6, mew=0, color=EKF2,
                  label="EKF2 just after")  # fmt: skip
    if isinstance(result.ekf2_variance, pd.DataFrame):
        variance = result.ekf2_variance["position_variance_m2"]
        variance = variance[(variance.index >= window[0]) & (variance.index <= window[1])]
        axes.plot(variance.index.to_numpy(), np.sqrt(variance.to_numpy()), ls="none", marker="s",
                  ms=3.0, mew=0.7, mfc="white", color=EKF2, label="EKF2 as logged")  # fmt: skip
    axes.set_xlim(*window)
    if legend:
        low, high = axes.get_ylim()
        axes.set_ylim(low - 0.08 * (high - low), high + 0.34 * (high - low))
        axes.legend(loc="upper left", ncols=2, borderaxespad=0.2)
        for number, stamp in enumerate(inside):
            axes.axvline(stamp, 0.0, 0.035, color=MEASUREMENT, lw=1.2,
                         label="_" if number else "measurement")  # fmt: skip
    axes.set_xlabel("time since first data (s)")


def _zoom_words(result: AxisComparison) -> str:
    words = [_before_after("ours", result.kf)]
    if isinstance(result.ekf2, Unavailable):
        words.append(result.ekf2.reason)
    elif isinstance(result.ekf2_innovations, Unavailable):
        words.append(result.ekf2_innovations.reason)
    elif result.ekf2.sigma_p_before_update_m is None:
        words.append("EKF2: S or R not logged, so no before and after")
    else:
        words.append(_before_after("EKF2", result.ekf2))
    return "; ".join(words) + ". Ticks at the bottom: measurements."


def _before_after(name: str, summary: FilterSummary) -> str:
    before, after = summary.sigma_p_before_update_m, summary.sigma_p_after_update_m
    if before is None or after is None:
        return f"{name}: not available"
    shrink = 1.0 - after**2 / before**2
    return (
        f"{name}: median σ_p {before:.3f} m before and {after:.3f} m after an update "
        f"(variance shrinks by {shrink:.0%})"
    )


def _flight(axes: Axes, result: AxisComparison, column: str, unit: str) -> None:
    what = "position" if column.startswith("position") else "velocity"
    axes.set_title(f"{result.axis.name}: σ of {what} ({unit}), log scale")
    steps = result.replay.steps
    axes.plot(*thin(steps.index.to_numpy(), np.sqrt(steps[column].to_numpy())), **OURS_LINE,
              label="ours")  # fmt: skip
    frame = result.ekf2_variance
    if isinstance(frame, pd.DataFrame):
        axes.plot(*thin(frame.index.to_numpy(), np.sqrt(frame[column].to_numpy())), **EKF2_LINE,
                  marker="s", ms=1.6, mfc="white", mew=0.5, label="EKF2")  # fmt: skip
    axes.set_yscale("log")
    _log_ticks(axes)
    axes.legend(loc="upper right", ncols=2, borderaxespad=0.2)


def _log_ticks(axes: Axes) -> None:
    """Plain numbers on a log axis, at 1, 2 and 5 in each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator  # noqa: PLC0415

    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.15, high * 1.25)
    axes.yaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def _numbers(row: list[Axes], result: AxisComparison) -> None:
    ekf2 = None if isinstance(result.ekf2, Unavailable) else result.ekf2
    for axes, ours, theirs, unit in (
        (row[0], result.kf.sigma_p_median_m, ekf2 and ekf2.sigma_p_median_m, "m"),
        (row[1], result.kf.sigma_v_median_m_s, ekf2 and ekf2.sigma_v_median_m_s, "m/s"),
    ):
        words = [
            f"{name} not logged" if value is None else f"{name} {value:.3f} {unit}"
            for name, value in (("ours", ours), ("EKF2", theirs))
        ]
        caption(axes, f"median: {', '.join(words)}")
