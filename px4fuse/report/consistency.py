"""Consistency: NIS, distribution and whiteness of both filters, by the same rules."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import AxisComparison, FilterSummary
from px4fuse.filter.consistency import MIN_INNOVATIONS, Consistency, autocorrelation, nis_band
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    EKF2_LINE,
    OURS,
    OURS_BAND,
    OURS_LINE,
    caption,
    empty,
    page,
    panels,
    thin,
)
from px4fuse.report.words import verdict_words

LAGS = 20
BINS = np.linspace(-4.0, 4.0, 33)


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page with a row per axis: running NIS, histogram, autocorrelation."""
    comparison = document.comparison
    figure, cursor = page(
        "Consistency",
        "Left: the mean NIS so far must end inside its 95 % band around 1. Middle: innovations "
        "divided by √S must follow the normal curve (4.6 % beyond 2√S, Student's t of the mean "
        "within ±2); narrower is S overstated. Right: they must "
        "not predict one another; a positive first lag says that the filter follows too slowly "
        "(R too large or Q too small), a negative one that it jumps after every measurement.",
    )
    rows = len(comparison.axes)
    grid = panels(figure, cursor.y - 0.03, BOTTOM + 0.05, rows, 3, hspace=0.5, wspace=0.24)
    for row, result in zip(grid, comparison.axes, strict=True):
        series = _normalised(result)
        if not series:
            for axes, reason in zip(row, (_reason(result), "", ""), strict=True):
                empty(axes, f"{result.axis.name}: {reason}" if reason else "")
            continue
        _running_nis(row[0], result, series)
        _histogram(row[1], series)
        _autocorrelation(row[2], series)
        for axes, label, say in zip(
            row,
            ("measurement number", "ν / √S", "lag"),
            (_nis_words, _shape_words, _white_words),
            strict=True,
        ):
            if row is grid[-1]:
                axes.set_xlabel(label)
            caption(axes, _words(result, say), size=6.6)
    yield figure


Series = list[tuple[str, str, Array]]


def _normalised(result: AxisComparison) -> Series:
    """Innovations over √S of each filter that has enough of them."""
    series = []
    for name, colour, frame in (
        ("ours", OURS, result.replay.updates),
        ("EKF2", EKF2, result.ekf2_innovations),
    ):
        if isinstance(frame, pd.DataFrame) and len(frame) >= MIN_INNOVATIONS:
            normalised = frame["innovation_m"] / np.sqrt(frame["innovation_variance_m2"])
            series.append((name, colour, normalised.to_numpy()))
    return series


def _running_nis(axes: Axes, result: AxisComparison, series: Series) -> None:
    axes.set_title(f"{result.axis.name}: running mean of the NIS")
    longest = max(len(values) for _, _, values in series)
    counts = np.unique(np.geomspace(3, longest, 60).astype(int))
    bands = np.array([nis_band(int(count)) for count in counts])
    axes.fill_between(counts, bands[:, 0], bands[:, 1], color="#dcdcdc", lw=0, label="95 % band")
    axes.axhline(1.0, color="black", lw=0.5)
    lowest, highest = 0.4, 2.5
    for name, colour, values in series:
        running = np.cumsum(values**2) / np.arange(1, len(values) + 1)
        line = OURS_LINE if colour == OURS else EKF2_LINE
        axes.plot(*thin(np.arange(3.0, len(values) + 1), running[2:]), **line, label=name)
        settled = running[len(running) // 4 :]
        lowest, highest = min(lowest, 0.7 * settled.min()), max(highest, 1.6 * settled.max())
    axes.set_yscale("log")
    axes.set_ylim(lowest, highest)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(
        lambda value, _: f"{value:g}" if highest / lowest < 30 and f"{value:.0e}"[0] in "25" else ""
    )
    axes.tick_params(axis="y", which="minor", labelsize=7, size=1.5)
    axes.set_xlim(3, longest)
    axes.legend(loc="upper right", ncols=3, borderaxespad=0.1, handlelength=1.4, columnspacing=0.8)


def _histogram(axes: Axes, series: Series) -> None:
    axes.set_title("normalised innovations")
    x = np.linspace(-4.0, 4.0, 161)
    axes.fill_between(x, norm.pdf(x), color="#dcdcdc", lw=0, label="normal")
    highest = 0.4
    for name, colour, values in series:
        density, _ = np.histogram(np.clip(values, -4.0, 4.0), bins=BINS, density=True)
        line = "-" if colour == OURS else (0, (4, 1.6))
        axes.stairs(density, BINS, color=colour, lw=0.9, ls=line, label=name)
        highest = max(highest, float(density.max()))
    axes.set_ylim(0.0, 1.3 * highest)
    axes.set_yticks([])
    axes.legend(loc="upper right", borderaxespad=0.1, handlelength=1.4)


def _autocorrelation(axes: Axes, series: Series) -> None:
    axes.set_title("autocorrelation")
    for shift, (name, colour, values) in zip((-0.18, 0.18), series, strict=False):
        lags = min(LAGS, len(values) // 3)
        r = autocorrelation(values, lags)
        at = np.arange(1, lags + 1) + shift
        axes.vlines(at, 0.0, r, color=colour, lw=1.2)
        marker = {"marker": "o", "ms": 2.6} if colour == OURS else {"marker": "s", "ms": 2.6}
        axes.plot(at, r, ls="none", color=colour, mew=0.6,
                  mfc=colour if colour == OURS else "white", label=name, **marker)  # type: ignore[arg-type]  # fmt: skip
        bound = 1.96 / np.sqrt(len(values))
        if colour == OURS:
            axes.axhspan(-bound, bound, color=OURS_BAND, lw=0, zorder=0.5)
        else:
            for level in (-bound, bound):
                axes.axhline(level, **EKF2_LINE | {"lw": 0.7})
    axes.axhline(0.0, color="black", lw=0.5)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -0.3), max(high, 0.3) * 1.25)
    axes.set_xlim(0.0, LAGS + 1)
    axes.legend(loc="upper right", ncols=2, borderaxespad=0.1, handlelength=1.0)


def _reason(result: AxisComparison) -> str:
    statement = result.kf.consistency
    return statement.reason if isinstance(statement, Unavailable) else "too few innovations"


def _words(result: AxisComparison, say: Callable[[Consistency], str]) -> str:
    parts = []
    for name, summary in (("ours", result.kf), ("EKF2", result.ekf2)):
        if isinstance(summary, FilterSummary) and isinstance(summary.consistency, Consistency):
            parts.append(f"{name}: {say(summary.consistency)}")
    return "\n".join(parts)


def _nis_words(statement: Consistency) -> str:
    low, high = statement.nis_band
    return f"{statement.nis_mean:.3g} ({low:.2f}–{high:.2f}), {verdict_words(statement)}"


def _shape_words(statement: Consistency) -> str:
    return (
        f"{statement.outside_two_sigma:.1%} beyond 2√S, "
        f"t {statement.bias_t:+.1f} (p {statement.bias_p:.2g})"
    )


def _white_words(statement: Consistency) -> str:
    return f"lag 1 {statement.lag1_autocorrelation:+.2f}, Ljung-Box p {statement.ljung_box_p:.2g}"
