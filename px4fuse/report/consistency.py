"""Appendix: NIS, distribution and whiteness of both filters, by the same rules."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from px4fuse.arrays import Array
from px4fuse.comparison.model import AxisComparison
from px4fuse.comparison.why import the
from px4fuse.filter.consistency import MIN_INNOVATIONS, Consistency, autocorrelation, nis_band
from px4fuse.flight import Unavailable
from px4fuse.plain import capital, number_words, p_words
from px4fuse.report import marks
from px4fuse.report.document import Document
from px4fuse.report.page import Page, halves, legend_above
from px4fuse.report.style import EKF2, EKF2_LINE, OURS, OURS_BAND, OURS_LINE, TIME_LABEL, thin
from px4fuse.report.words import verdict_words

LAGS = 20
WIDEST = 4.0
BINS = np.linspace(-WIDEST, WIDEST, 33)
# Of the normal curve's 0.4: higher bars are cut, so that the curve stays in sight
HIGHEST = 1.6
BEYOND_TWO_SIGMA = 0.0455
# t of the mean, and p of "white", beyond which a word is said
LARGE_T, SMALL_P = 2.0, 0.01
# Heights of the axes in points
RUNNING, BELOW, LEGEND = 140.0, 150.0, 14.0


class Series(NamedTuple):
    """Innovations over √S of one filter, and what they state."""

    name: str
    colour: str
    time_s: Array
    values: Array
    statement: Consistency


def draw(document: Document) -> Iterator[Page]:
    """Draw one page: the axis of the lab in three panels, all axes in a table."""
    result = document.comparison.main
    along = the(result.axis.name)
    page = Page(
        "Appendix: consistency",
        "Innovations ν of a filter that knows its own variance S are as large as S says (NIS = "
        "ν²/S is 1 in the mean), normal about zero, and do not predict one another. Both filters "
        f"are judged by the same rules, along {along}; the table has all axes.",
    )
    series = _series(result)
    if series:
        axes = page.panel("Mean NIS so far, log scale", _nis_words(series), RUNNING, above=LEGEND)
        _running(axes, series)
        marks.draw(axes, document)
        legend_above(axes)
        first, second = halves()
        left = first.panel("Size: ν / √S", _shape_words(series), BELOW, above=LEGEND, left=4.0)
        right = second.panel("Autocorrelation", _white_words(series), BELOW, above=LEGEND)
        _histogram(left, series)
        _autocorrelation(right, series)
        for axes in (left, right):
            legend_above(axes, handlelength=1.4)
        page.beside(first, second)
    else:
        page.write(f"Along {along}: {_reason(result)}.")
    _table(page, document.comparison.axes.values())
    yield page


def _series(result: AxisComparison) -> list[Series]:
    """Of each filter that has enough innovations."""
    series = []
    for name, colour, frame, summary in (
        ("ours", OURS, result.replay.updates, result.filters["kf"]),
        ("EKF2", EKF2, result.ekf2_innovations, result.filters["ekf2"]),
    ):
        if (
            isinstance(frame, pd.DataFrame)
            and len(frame) >= MIN_INNOVATIONS
            and isinstance(summary, Consistency)
        ):
            values = frame["innovation_m"] / np.sqrt(frame["innovation_variance_m2"])
            known = values[np.isfinite(values)]
            time = known.index.to_numpy(dtype=np.float64)
            series.append(Series(name, colour, time, known.to_numpy(), summary))
    return series


def _running(axes: Axes, series: list[Series]) -> None:
    lowest, highest = 0.5, 2.0
    for one in series:
        number = np.arange(1, len(one.values) + 1)
        running = np.cumsum(one.values**2) / number
        line = OURS_LINE if one.colour == OURS else EKF2_LINE
        axes.plot(*thin(one.time_s[2:], running[2:]), **line, label=one.name)
        shown = np.unique(np.geomspace(3, len(number), 60).astype(int))
        bands = np.array([nis_band(int(count)) for count in shown])
        time = one.time_s[shown - 1]
        if one.colour == OURS:
            axes.fill_between(time, bands[:, 0], bands[:, 1], color="#dcdcdc", lw=0,
                              label="95 % band of ours")  # fmt: skip
        else:
            for side in (0, 1):
                axes.plot(time, bands[:, side], color=EKF2, lw=0.6, ls=(0, (1, 1.5)),
                          label="of EKF2" if side else None)  # fmt: skip
        settled = running[len(running) // 4 :]
        lowest, highest = min(lowest, 0.7 * settled.min()), max(highest, 1.4 * settled.max())
    axes.axhline(1.0, color="black", lw=0.5)
    axes.set_yscale("log")
    axes.set_ylim(lowest, highest)
    axes.yaxis.set_major_formatter(lambda value, _: number_words(value, 1))
    few = highest / lowest < 30.0
    axes.yaxis.set_minor_formatter(
        lambda value, _: number_words(value, 1) if few and f"{value:.0e}"[0] in "25" else ""
    )
    axes.tick_params(axis="y", which="minor", labelsize=7, size=1.5)
    axes.set_xlabel(TIME_LABEL)


def _histogram(axes: Axes, series: list[Series]) -> None:
    x = np.linspace(-WIDEST, WIDEST, 81)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    axes.fill_between(x, normal, color="#dcdcdc", lw=0, label="normal")
    highest = 0.4
    for one in series:
        inside = np.clip(one.values, -WIDEST, WIDEST)
        density, _ = np.histogram(inside, bins=BINS, density=True)
        line = "-" if one.colour == OURS else (0, (4, 1.6))
        axes.stairs(density, BINS, color=one.colour, lw=1.0, ls=line, label=one.name)
        highest = max(highest, float(density.max()))
    axes.set_xlim(-WIDEST, WIDEST)
    axes.set_ylim(0.0, min(1.15 * highest, HIGHEST))
    axes.set_yticks([])
    axes.set_xlabel("ν / √S")


def _autocorrelation(axes: Axes, series: list[Series]) -> None:
    for shift, one in zip((-0.18, 0.18), series, strict=False):
        ours = one.colour == OURS
        lags = min(LAGS, len(one.values) // 3)
        r = autocorrelation(one.values, lags)
        at = np.arange(1, lags + 1) + shift
        axes.vlines(at, 0.0, r, color=one.colour, lw=1.2)
        axes.plot(at, r, ls="none", color=one.colour, marker="o" if ours else "s", ms=3.0, mew=0.6,
                  mfc=one.colour if ours else "white", label=one.name)  # fmt: skip
        bound = 1.96 / np.sqrt(len(one.values))
        if ours:
            axes.axhspan(-bound, bound, color=OURS_BAND, lw=0, zorder=0.5, label="95 % of white")
        else:
            for level in (-bound, bound):
                axes.axhline(level, color=EKF2, lw=0.6, ls=(0, (1, 1.5)))
    axes.axhline(0.0, color="black", lw=0.5)
    low, high = axes.get_ylim()
    axes.set_ylim(max(min(low, -0.3), -1.05), min(max(high, 0.3), 1.05))
    axes.set_xlim(0.0, LAGS + 1)
    axes.set_xlabel("lag (measurements)")


def _nis_words(series: list[Series]) -> str:
    return " ".join(
        f"{capital(one.name)} ends at {number_words(one.statement.nis_mean)} ("
        f"{one.statement.nis_band[0]:.2f} to {one.statement.nis_band[1]:.2f} is consistent): "
        f"{verdict_words(one.statement)}."
        for one in series
    )


def _shape_words(series: list[Series]) -> str:
    said = [
        f"{capital(one.name)}: {one.statement.outside_two_sigma:.1%} beyond 2√S, "
        f"{_mean_words(one.statement)}."
        for one in series
    ]
    return "\n".join([*said, f"{BEYOND_TWO_SIGMA:.1%} are expected there."])


def _mean_words(statement: Consistency) -> str:
    if abs(statement.bias_t) < LARGE_T:
        return "mean near zero"
    return f"mean {statement.innovation_mean_m:+.3f} m ({p_words(statement.bias_p)})"


def _white_words(series: list[Series]) -> str:
    said = []
    for one in series:
        r, p = one.statement.lag1_autocorrelation, one.statement.ljung_box_p
        if p >= SMALL_P:
            reading = "white"
        elif r > 1.96 / np.sqrt(one.statement.count):
            reading = "it follows too slowly"
        elif r < -1.96 / np.sqrt(one.statement.count):
            reading = "it jumps after every measurement"
        else:
            reading = "not white"
        said.append(f"{capital(one.name)}: lag 1 {r:+.2f}, Ljung-Box {p_words(p)}: {reading}.")
    return "\n".join(said)


def _reason(result: AxisComparison) -> str:
    statement = result.filters["kf"]
    return statement.reason if isinstance(statement, Unavailable) else "too few innovations"


def _table(page: Page, axes: Iterable[AxisComparison]) -> None:
    """Every axis and filter with its numbers."""
    heads = ("axis", "filter", "n", "mean NIS", "95 % band", "innovation variance", "beyond 2√S",
             "t of mean", "lag 1", "Ljung-Box")  # fmt: skip
    rows = []
    for result in axes:
        for owner, statement in (("ours", result.filters["kf"]), ("EKF2", result.filters["ekf2"])):
            axis = result.axis.name if owner == "ours" else ""
            if isinstance(statement, Unavailable):
                rows.append((axis, owner, *[""] * 3, "not available", *[""] * 4))
                continue
            low, high = statement.nis_band
            rows.append(
                (
                    axis, owner, f"{statement.count}", number_words(statement.nis_mean),
                    f"{low:.2f} – {high:.2f}", verdict_words(statement),
                    f"{statement.outside_two_sigma:.1%}", f"{statement.bias_t:+.1f}",
                    f"{statement.lag1_autocorrelation:+.2f}", p_words(statement.ljung_box_p),
                )
            )  # fmt: skip
    page.heading("All axes", above=12.0)
    page.table(heads, rows, right=(2, 3, 6, 7, 8))
