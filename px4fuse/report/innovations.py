"""Innovations and variances of both filters on one time axis; a zoom into predict and update."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from px4fuse.arrays import Array
from px4fuse.comparison.events import Span
from px4fuse.comparison.model import AxisComparison, FilterSummary, UnjudgedFilter
from px4fuse.comparison.why import the
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.signals import Segment
from px4fuse.flight import Unavailable
from px4fuse.report import marks
from px4fuse.report.document import Document
from px4fuse.report.page import Page, halves
from px4fuse.report.style import (
    EKF2,
    EKF2_DOTS,
    EKF2_LINE,
    EKF2_REJECTED,
    MAX_POINTS,
    MEASUREMENT,
    OURS,
    OURS_BAND,
    OURS_DOTS,
    OURS_LINE,
    TIME_LABEL,
    bare_x,
    thin,
)
from px4fuse.report.words import verdict_notes, verdict_words

# The axes reach this much beyond 2√S, or beyond 99 % of the innovations if that is further, but
# not beyond so many √S; what lies outside is drawn at the edge and counted.
EDGE = 1.3
LARGEST_SIGMA = 5.0
ZOOM_UPDATES = 15
ZOOM_RANGE_S = (1.0, 12.0)
# Of the updates that a zoom of its length can hold, it must hold this share
ZOOM_FILLED = 0.8
START_S = 5.0
ZOOM_SHARE = 0.66  # of the page
# Heights of the axes in points
INNOVATIONS, SIGMA_P, SIGMA_V, ZOOM = 140.0, 80.0, 60.0, 125.0


def draw(document: Document) -> Iterator[Page]:
    """Draw one page: innovations, σ_p and σ_v on one time axis, then the zooms."""
    result = document.comparison.main
    page = Page(f"Innovations and variances along {the(result.axis.name)}")
    axes = page.panel(
        "Innovation = measurement - prediction (m)", innovation_words(result), INNOVATIONS,
        above=12.0 if document.events.modes else 4.0,
    )  # fmt: skip
    draw_innovations(axes, result, MAX_POINTS)
    marks.draw(axes, document, axis="", strip=True)
    bare_x(axes)
    page.numbers(innovation_numbers(result, axes.get_ylim()[1]))
    for title, say, height, column in (
        (
            "Standard deviation of position (m), log scale",
            sigma_words(document),
            SIGMA_P,
            "position_variance_m2",
        ),
        (
            "Standard deviation of velocity (m/s), log scale",
            f"Median σ: {_medians(result, 'sigma_v_median_m_s', 'm/s')}.",
            SIGMA_V,
            "velocity_variance_m2_s2",
        ),
    ):
        axes = page.panel(title, say, height)
        draw_sigma(axes, result, MAX_POINTS, column)
        marks.draw(axes, document)
        if column.startswith("position"):
            bare_x(axes)
        else:
            axes.set_xlabel(TIME_LABEL)
    _zooms(page, document)
    for note in verdict_notes(document.comparison):
        page.numbers(note)
    yield page


def _zooms(page: Page, document: Document) -> None:
    """Two zooms beside one another: in flight, and from the start."""
    result, segment = document.comparison.main, document.comparison.segment
    window = zoom_window(result, segment)
    left, right = halves(ZOOM_SHARE)
    axes = left.panel(
        f"Standard deviation of position (m), {window[1] - window[0]:.1f} s of the flight",
        zoom_words(result),
        ZOOM,
    )
    start = right.panel("The first seconds, log scale", start_words(result), ZOOM)
    page.beside(left, right)
    _sawtooth(axes, result, window)
    first = float(result.replay.steps.index[0])
    _sawtooth(start, result, (first, min(first + START_S, segment.end_s)))
    start.set_yscale("log")
    log_ticks(start)
    updates = result.replay.updates.index.to_numpy()
    inside = updates[(updates >= window[0]) & (updates <= window[1])]
    axes.vlines(inside, 0.0, 0.03, transform=axes.get_xaxis_transform(), color=MEASUREMENT, lw=1.2)
    axes.set_xlabel(TIME_LABEL)
    start.set_xlabel("time (s)")
    shown = []
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        shown += ["triangle up just before an update", "down just after"]
    if isinstance(result.ekf2_variance, pd.DataFrame):
        shown.append("square as logged")
    ekf2 = f" EKF2: {', '.join(shown)}." if shown else ""
    page.numbers(f"Line: our filter, predict and update; grey ticks: measurements.{ekf2}")


def _limit(result: AxisComparison) -> float:
    """Half height of the axes: neither outliers nor a gap may flatten all the rest."""
    limits = []
    for frame in (result.replay.updates, result.ekf2_innovations):
        if isinstance(frame, pd.DataFrame):
            typical = float(np.sqrt(frame["innovation_variance_m2"].median()))
            usual = float(np.quantile(frame["innovation_m"].abs(), 0.99))
            limits.append(max(2.0 * typical, min(usual, LARGEST_SIGMA * typical)))
    return EDGE * max(limits)


def draw_innovations(axes: Axes, result: AxisComparison, limit: int) -> None:
    """Innovations of both filters with ±2√S; what EKF2 rejected is hollow."""
    edge = _limit(result)
    updates = result.replay.updates
    time = updates.index.to_numpy()
    two_sigma = 2.0 * np.sqrt(updates["innovation_variance_m2"].to_numpy())
    band_time, band = thin(time, two_sigma, limit)
    axes.fill_between(band_time, -band, band, color=OURS_BAND, lw=0)
    axes.axhline(0.0, color="black", lw=0.5)
    frame = result.ekf2_innovations
    if isinstance(frame, pd.DataFrame):
        ekf2_time, nu = frame.index.to_numpy(), frame["innovation_m"].to_numpy()
        two_sigma = 2.0 * np.sqrt(frame["innovation_variance_m2"].to_numpy())
        axes.plot(*thin(ekf2_time, two_sigma, limit), **EKF2_LINE)
        axes.plot(*thin(ekf2_time, -two_sigma, limit), **EKF2_LINE)
        rejected = (frame["rejected"] > 0).to_numpy()
        for part, style in ((~rejected, EKF2_DOTS), (rejected, EKF2_REJECTED)):
            shown = part & (np.abs(nu) <= edge)
            axes.plot(*thin(ekf2_time[shown], nu[shown], limit), **style)
            _at_edge(axes, ekf2_time[part], nu[part], edge, style)
    nu = updates["innovation_m"].to_numpy()
    shown = np.abs(nu) <= edge
    axes.plot(*thin(time[shown], nu[shown], limit), **OURS_DOTS)
    _at_edge(axes, time, nu, edge, OURS_DOTS)
    axes.set_ylim(-edge, edge)


def _at_edge(axes: Axes, time: Array, nu: Array, limit: float, style: dict[str, Any]) -> None:
    """Mark what lies beyond the axes with a triangle at its edge."""
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        beyond = sign * nu > limit
        if np.any(beyond):
            axes.plot(
                time[beyond], np.full(np.count_nonzero(beyond), sign * 0.96 * limit),
                **{**style, "marker": marker, "ms": 3.2}, clip_on=False,
            )  # fmt: skip


def innovation_words(result: AxisComparison) -> str:
    """What to see in the innovations."""
    words = [_outside_words("Ours", result.filters["kf"])]
    if isinstance(result.ekf2_state, Unavailable):
        words.append(f"EKF2: {result.ekf2_state.reason}")
    elif isinstance(result.ekf2_innovations, Unavailable):
        words.append(f"EKF2: {result.ekf2_innovations.reason}")
    else:
        words.append(_outside_words("EKF2", result.filters["ekf2"]))
        count = int((result.ekf2_innovations["rejected"] > 0).sum())
        if count:
            words.append(f"It rejected {count} of them (hollow)")
    return ". ".join(words) + "."


def _outside_words(name: str, statement: Consistency | Unavailable) -> str:
    if isinstance(statement, Unavailable):
        return f"{name}: {statement.reason}"
    return (
        f"{name}: {statement.outside_two_sigma:.1%} of {statement.count} outside its own ±2√S, "
        f"where 5% should be: {verdict_words(statement)}"
    )


def innovation_numbers(result: AxisComparison, limit: float) -> str:
    """Numbers of the innovations, and how many lie beyond the axes."""
    words = [_numbers("ours", result.filters["kf"], result.replay.updates, limit)]
    if not isinstance(result.ekf2_state, Unavailable):
        words.append(_numbers("EKF2", result.filters["ekf2"], result.ekf2_innovations, limit))
    return "; ".join(filter(None, words))


def _numbers(
    name: str, statement: Consistency | Unavailable, frame: pd.DataFrame | Unavailable, limit: float
) -> str:
    if isinstance(statement, Unavailable) or isinstance(frame, Unavailable):
        return ""
    beyond = int((frame["innovation_m"].abs() > limit).sum())
    return (
        f"{name}: mean {statement.innovation_mean_m:+.3f} m, std "
        f"{statement.innovation_std_m:.3f} m, median √S {statement.sqrt_s_median_m:.3f} m"
        + (f", {beyond} beyond the axis (triangles)" if beyond else "")
    )


def short_numbers(result: AxisComparison) -> str:
    """Verdict and share outside ±2√S of both filters, a line each."""
    return "\n".join(
        f"{name}: {statement.outside_two_sigma:.1%} outside, {verdict_words(statement)}"
        if isinstance(statement, Consistency)
        else f"{name}: not available"
        for name, statement in (("ours", result.filters["kf"]), ("EKF2", result.filters["ekf2"]))
        if name == "ours" or not isinstance(result.ekf2_state, Unavailable)
    )


def sigma_numbers(result: AxisComparison) -> str:
    """Median σ_p of both filters."""
    return f"median: {_medians(result, 'sigma_p_median_m', 'm')}"


def draw_sigma(
    axes: Axes, result: AxisComparison, limit: int, column: str = "position_variance_m2"
) -> None:
    """σ of position or velocity of both filters, log scale."""
    steps = result.replay.steps
    axes.plot(*thin(steps.index.to_numpy(), np.sqrt(steps[column].to_numpy()), limit), **OURS_LINE)
    frame = result.ekf2_variance
    if isinstance(frame, pd.DataFrame):
        axes.plot(
            *thin(frame.index.to_numpy(), np.sqrt(frame[column].to_numpy()), limit), **EKF2_LINE
        )
    axes.set_yscale("log")
    log_ticks(axes)


def sigma_words(document: Document) -> str:
    """What to see in σ_p."""
    result, gaps = document.comparison.main, document.events.gaps
    words = f"Median σ: {_medians(result, 'sigma_p_median_m', 'm')}."
    if gaps:
        start, end = max(gaps, key=lambda gap: gap[1] - gap[0])
        words += (
            f" In the {end - start:.1f} s without measurements from {start:.0f} s on ours grew to "
            f"{_largest(result.replay.steps, start, end):.2g} m"
        )
        if isinstance(result.ekf2_variance, pd.DataFrame):
            largest = _largest(result.ekf2_variance, start, end)
            words += f", EKF2's to {largest:.2g} m" if np.isfinite(largest) else ""
        words += "."
    return words


def _cut(frame: pd.DataFrame, window: Span) -> pd.DataFrame:
    return frame[(frame.index >= window[0]) & (frame.index <= window[1])]


def _largest(frame: pd.DataFrame, start_s: float, end_s: float) -> float:
    return float(np.sqrt(_cut(frame, (start_s, end_s))["position_variance_m2"].max()))


def _medians(result: AxisComparison, field: str, unit: str) -> str:
    filters = [("ours", result.filters["kf"])]
    if not isinstance(result.ekf2_state, Unavailable):
        filters.append(("EKF2", result.filters["ekf2"]))
    values = [(name, getattr(summary, field)) for name, summary in filters]
    return ", ".join(
        f"{name} not logged" if value is None else f"{name} {value:.3f} {unit}"
        for name, value in values
    )


def zoom_window(result: AxisComparison, segment: Segment) -> Span:
    """Part of the flight with about fifteen updates, near the middle of what EKF2 logged too.

    Never in a gap of the source, if it has enough updates anywhere.
    """
    updates = result.replay.updates.index.to_numpy()
    if len(updates) < 2:
        return segment.start_s, min(segment.start_s + ZOOM_RANGE_S[0], segment.end_s)
    interval = float(np.median(np.diff(updates)))
    length = float(np.clip(ZOOM_UPDATES * interval, *ZOOM_RANGE_S))
    times = updates
    if isinstance(result.ekf2_innovations, pd.DataFrame) and len(result.ekf2_innovations):
        times = result.ekf2_innovations.index.to_numpy()
    last = max(segment.end_s - length, segment.start_s)
    starts = np.clip(times - length / 2.0, segment.start_s, last)
    held = np.searchsorted(updates, starts + length) - np.searchsorted(updates, starts)
    near = np.abs(starts + length / 2.0 - times[len(times) // 2])
    full = held >= min(ZOOM_FILLED * length / interval, float(held.max()))
    start = float(starts[np.argmin(np.where(full, near, np.inf))])
    return start, min(start + length, segment.end_s)


def _sawtooth(axes: Axes, result: AxisComparison, window: Span) -> None:
    """σ_p with both values at each update, just before and just after."""
    updates, steps = result.replay.updates, result.replay.steps
    prior, after_each = updates["prior_position_variance_m2"], steps["position_variance_m2"]
    # stable, so that the prior stands first at equal times
    both = pd.concat([prior, after_each]).sort_index(kind="stable").loc[slice(*window)]
    axes.plot(both.index, np.sqrt(both), color=OURS, lw=1.1, marker=".", ms=2.4, mew=0)
    frame = result.ekf2_innovations
    if isinstance(frame, pd.DataFrame):
        cut = _cut(frame, window).dropna(subset=["prior_variance_m2"])
        before = np.sqrt(cut["prior_variance_m2"].to_numpy())
        after = np.sqrt(cut["posterior_variance_m2"].to_numpy())
        at = cut.index.to_numpy()
        axes.vlines(at, after, before, color=EKF2, lw=1.0)
        axes.plot(at, before, ls="none", marker="^", ms=3.6, mew=0.7, mfc="none", color=EKF2)
        axes.plot(at, after, ls="none", marker="v", ms=3.6, mew=0, color=EKF2)
    if isinstance(result.ekf2_variance, pd.DataFrame):
        variance = _cut(result.ekf2_variance, window)["position_variance_m2"]
        axes.plot(variance.index.to_numpy(), np.sqrt(variance.to_numpy()), ls="none", marker="s",
                  ms=3.0, mew=0.7, mfc="white", color=EKF2)  # fmt: skip
    axes.set_xlim(*window)


def zoom_words(result: AxisComparison) -> str:
    """What to see in the zoom."""
    words = []
    ours = result.filters["kf"]
    if ours.sigma_p_before_update_m is not None:
        words.append(
            f"Without measurement σ grows, by SIGMA_A {result.replay.settings.sigma_a_m_s2:g} m/s² "
            f"(predict); each measurement shrinks it ({_before_after('ours', ours)})"
        )
    if not isinstance(result.ekf2_state, Unavailable):
        words.append(_before_after("EKF2", result.filters["ekf2"]))
    return "; ".join(words) + "."


def _before_after(name: str, summary: FilterSummary | UnjudgedFilter) -> str:
    before, after = summary.sigma_p_before_update_m, summary.sigma_p_after_update_m
    if before is None or after is None:
        return f"{name}: S or R not logged, so no before and after"
    shrink = 1.0 - after**2 / before**2
    return f"{name} {before:.3f} to {after:.3f} m, {shrink:.0%} of the variance"


def start_words(result: AxisComparison) -> str:
    """What to see in the first seconds."""
    sigma = np.sqrt(result.replay.steps["position_variance_m2"])
    first = f"From σ {sigma.iloc[0]:g} m (P₀)"
    steady = result.filters["kf"].sigma_p_after_update_m
    settled = sigma.index[(sigma < 1.2 * (steady or 0.0)).to_numpy()]
    if steady is None or not len(settled):
        return f"{first} on."
    return f"{first} to its steady {steady:.2g} m within {settled[0] - sigma.index[0]:.1f} s."


def log_ticks(axes: Axes) -> None:
    """Plain numbers on a log axis, at 1, 2 and 5 in each decade; of many decades at 1."""
    low, high = axes.get_ylim()
    low, high = low / 1.15, high * 1.25
    axes.set_ylim(low, high)
    subs = (1.0, 2.0, 5.0) if high / low < 30.0 else (1.0, 3.0) if high / low < 300.0 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(base=10.0, subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
