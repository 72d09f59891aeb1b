"""Innovations of both filters on common axes, with ±2√S and the share outside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import AxisComparison, FilterSummary
from px4fuse.filter.consistency import Consistency
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    EKF2_BAND,
    EKF2_DOTS,
    EKF2_LINE,
    OURS,
    OURS_BAND,
    OURS_DOTS,
    caption,
    page,
    panels,
    thin,
)

# The axes reach this much beyond 2√S, or beyond 99 % of the innovations if that is further, but
# not beyond so many √S; what lies outside is drawn at the edge and counted.
EDGE = 1.3
LARGEST_SIGMA = 5.0
HISTOGRAM_BINS = 41


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page with a row per axis: the series, and beside it how they are distributed."""
    comparison = document.comparison
    figure, cursor = page(
        "Innovations",
        "Innovation = measurement - prediction, before the update. About 95 % should lie inside "
        "±2√S, the filter's own expectation: many more outside means that S is too small, hardly "
        "any means that S is too large. Both filters on one scale; EKF2's sign is turned to ours.",
    )
    rows = len(comparison.axes)
    grid = panels(
        figure, cursor.y - 0.035, BOTTOM + 0.045, rows, 2, widths=(4.6, 1.0), hspace=0.36,
        wspace=0.06,
    )  # fmt: skip
    for row, result in zip(grid, comparison.axes, strict=True):
        limit = _limit(result)
        _series(row[0], result, limit)
        row[0].set_xlim(comparison.segment.start_s, comparison.segment.end_s)
        _distribution(row[1], result, limit)
        if row is grid[-1]:
            row[0].set_xlabel("time since first data (s)")
        _numbers(row[0], result)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="lower left", ncols=len(labels),
        bbox_to_anchor=(grid[0][0].get_position().x0 - 0.012, cursor.y - 0.02), borderaxespad=0.0,
    )  # fmt: skip
    yield figure


def _limit(result: AxisComparison) -> float:
    """Half height of the axes: neither outliers nor a gap may flatten all the rest."""
    limits = []
    for frame in (result.replay.updates, result.ekf2_innovations):
        if isinstance(frame, pd.DataFrame):
            typical = float(np.sqrt(frame["innovation_variance_m2"].median()))
            usual = float(np.quantile(frame["innovation_m"].abs(), 0.99))
            limits.append(max(2.0 * typical, min(usual, LARGEST_SIGMA * typical)))
    return EDGE * max(limits)


def _series(axes: Axes, result: AxisComparison, limit: float) -> None:
    axes.set_title(f"{result.axis.name}: innovation (m)")
    updates = result.replay.updates
    time = updates.index.to_numpy()
    two_sigma = 2.0 * np.sqrt(updates["innovation_variance_m2"].to_numpy())
    band_time, band = thin(time, two_sigma)
    axes.fill_between(band_time, -band, band, color=OURS_BAND, lw=0, label="ours ±2√S")
    axes.axhline(0.0, color="black", lw=0.5)
    frame = result.ekf2_innovations
    if isinstance(frame, pd.DataFrame):
        ekf2_time = frame.index.to_numpy()
        two_sigma = 2.0 * np.sqrt(frame["innovation_variance_m2"].to_numpy())
        axes.plot(*thin(ekf2_time, two_sigma), **EKF2_LINE, label="EKF2 ±2√S")
        axes.plot(*thin(ekf2_time, -two_sigma), **EKF2_LINE)
        axes.plot(
            *_inside(ekf2_time, frame["innovation_m"].to_numpy(), limit),
            **EKF2_DOTS, label="EKF2 innovation",
        )  # fmt: skip
        _edge(axes, ekf2_time, frame["innovation_m"].to_numpy(), limit, EKF2)
    nu = updates["innovation_m"].to_numpy()
    axes.plot(*_inside(time, nu, limit), **OURS_DOTS, label="our innovation")
    _edge(axes, time, nu, limit, OURS)
    axes.set_ylim(-limit, limit)


def _inside(time: Array, nu: Array, limit: float) -> tuple[Array, Array]:
    keep = np.abs(nu) <= limit
    return thin(time[keep], nu[keep])


def _edge(axes: Axes, time: Array, nu: Array, limit: float, colour: str) -> None:
    """Mark what lies beyond the axes with a triangle at its edge."""
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        beyond = sign * nu > limit
        if np.any(beyond):
            axes.plot(
                time[beyond], np.full(np.count_nonzero(beyond), sign * 0.96 * limit),
                marker=marker, ls="none", color=colour, ms=3.2, mew=0, clip_on=False,
            )  # fmt: skip


def _distribution(axes: Axes, result: AxisComparison, limit: float) -> None:
    """Histograms of both beside what each filter expects, on the same scale."""
    bins = np.linspace(-limit, limit, HISTOGRAM_BINS)
    centres = (bins[:-1] + bins[1:]) / 2.0
    axes.set_title("distribution")
    updates = result.replay.updates
    sources = [(updates, OURS, "-")]
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        sources.append((result.ekf2_innovations, EKF2, (0, (4, 1.6))))  # type: ignore[arg-type]
    widest = 0.0
    for frame, colour, line in sources:
        density, _ = np.histogram(frame["innovation_m"], bins=bins, density=True)
        axes.step(density, centres, where="mid", color=colour, lw=0.8, ls=line)
        expected = norm.pdf(centres, scale=np.sqrt(frame["innovation_variance_m2"].median()))
        axes.fill_betweenx(
            centres, 0.0, expected, lw=0, alpha=0.55,
            color=OURS_BAND if colour == OURS else EKF2_BAND,
        )  # fmt: skip
        widest = max(widest, float(np.max(density, initial=0.0)), float(expected.max()))
    axes.set_xlim(0.0, 1.05 * widest if widest > 0 else 1.0)
    axes.set_ylim(-limit, limit)
    axes.set_yticklabels([])
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)


def _numbers(axes: Axes, result: AxisComparison) -> None:
    limit = axes.get_ylim()[1]
    nu = result.replay.updates["innovation_m"]
    texts = [_statement("ours", result.kf, int((nu.abs() > limit).sum()))]
    if isinstance(result.ekf2, Unavailable):
        texts.append(result.ekf2.reason)
    elif isinstance(result.ekf2_innovations, Unavailable):
        texts.append(result.ekf2_innovations.reason)
    else:
        nu = result.ekf2_innovations["innovation_m"]
        texts.append(_statement("EKF2", result.ekf2, int((nu.abs() > limit).sum())))
    caption(axes, "\n".join(texts))


def _statement(name: str, summary: FilterSummary, beyond: int) -> str:
    statement = summary.consistency
    if not isinstance(statement, Consistency):
        return f"{name}: {statement.reason}"
    return (
        f"{name}: mean {statement.innovation_mean_m:+.3f} m, "
        f"std {statement.innovation_std_m:.3f} m, √S {statement.sqrt_s_median_m:.3f} m, "
        f"{statement.outside_two_sigma:.1%} outside ±2√S "
        f"(n {statement.count})" + (f", {beyond} beyond the axis" if beyond else "")
    )
