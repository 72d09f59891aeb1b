"""Why EKF2 differs: from our filter to the logged EKF2, one change at a time."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.ekf2.replay import Agreement, Ekf2Replay
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2_parameters import AIDS
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.plain import capital
from px4fuse.report import marks, say
from px4fuse.report.page import Page, halves
from px4fuse.report.style import EKF2, EKF2_BAND, LINES, MUTED, OURS, OURS_BAND, Axes, curve

TITLE = "Why EKF2 differs"
ROW_POINTS, LABELS, GAP = 12.0, 128.0, 14.0  # height of a bar, width of the names of steps
WITH_NAMES = 0.62  # of the width: the bars that have the names of steps beside them
TIME_POINTS = 105.0
AWAY = {"color": "white", "hatch": "////"}  # bars of steps that lead away from EKF2


def draw(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw as many pages as the axes need; none where nothing is concluded for any."""
    found = _walks(analysis)
    if not any(isinstance(why, Why) for why in found.values()):
        return
    page = Page(TITLE, say("why"))
    for name, why in found.items():
        if isinstance(why, Unavailable):
            page.heading(f"{name}: nothing is concluded", 9.5, above=10.0)
            page.write(f"{capital(why.reason)}. {why.remedy}")
        else:
            _axis(page, name, why, analysis)
    replay = analysis.ekf2_replay  # without one nothing is concluded
    assert isinstance(replay, Ekf2Replay)
    assert replay.agreement is not None
    page.numbers(f"Replay against log: {agreement_words(replay.agreement)}.")
    yield page


def _walks(analysis: Analysis) -> Mapping[str, Why | Unavailable]:
    """Of the aisle, or else of every axis."""
    found = analysis.why
    return {AISLE: found[AISLE]} if AISLE in found else found


def write_why(page: Page, why: Why | Unavailable) -> None:
    """Write in one sentence why EKF2 differs."""
    if isinstance(why, Unavailable):
        page.labelled("Why", f"EKF2 differs is not known: {why.reason}.")
    else:
        page.labelled("Why", why.sentences[0])


def nothing_concluded(analysis: Analysis) -> str:
    """Why there is no such page, in a line; empty where there is one, or no EKF2 to explain."""
    found = list(_walks(analysis).values())
    if isinstance(analysis.flight.ekf2, Unavailable) or any(isinstance(why, Why) for why in found):
        return ""
    reasons = {f"{why.reason}. {why.remedy}": None for why in found if isinstance(why, Unavailable)}
    return f"{TITLE}: nothing is concluded, {' '.join(reasons)}" if reasons else ""


def agreement_words(agreement: Agreement) -> str:
    """How well the replay as flown agrees with the log, in numbers and in a verdict."""
    axes = agreement.axes.items()
    correlation = ", ".join(f"{axis.innovation_correlation:.4f} ({name})" for name, axis in axes)
    ratio = ", ".join(
        f"{axis.s_ratio_median:.3f} (5 to 95 % {axis.s_ratio_p5:.3f} to {axis.s_ratio_p95:.3f})"
        for _, axis in axes
    )
    return (
        f"{agreement.samples} innovations correlate {correlation}; S is {ratio} times the logged "
        f"one; rejected {agreement.rejected_share_replayed:.1%}, in the log "
        f"{agreement.rejected_share_logged:.1%}. "
        + ("It agrees: " if agreement.good else "It does not agree: ")
        + agreement.reason
        + "".join(
            f". Not so the {AIDS[name].label}, of which nothing is concluded: {reason}"
            for name, reason in agreement.doubtful.items()
        )
    )


def _axis(page: Page, name: str, why: Why, analysis: Analysis) -> None:
    spans = ", ".join(f"{start:.0f} to {end:.0f} s" for start, end in why.spans_s)
    page.heading(f"{name}, {spans}", 9.5, above=10.0)
    for sentence in why.sentences:
        page.write(sentence, size=8.5, above=1.0)
    names = [step.name for step in why.steps]
    columns = halves(WITH_NAMES, gap=GAP)
    for column, left, (what, unit, power) in zip(
        columns, (LABELS, 4.0), (("position", "m", "m2"), ("velocity", "m/s", "m2_s2")), strict=True
    ):
        total = getattr(why, f"{what}_mean_square_{power}")
        steps = np.array([getattr(step, f"{what}_mean_square_{power}") for step in why.steps])
        unexplained = getattr(why, f"{what}_left_mean_square_{power}")
        title, height = f"{what}, {np.sqrt(total):.3f} {unit} rms", ROW_POINTS * (len(names) + 2)
        axes = column.panel(title, "", height, left=left)
        _waterfall(axes, names, 100.0 * steps / total, 100.0 * unexplained / total)
    axes.set_yticklabels([])
    page.beside(*columns, gap=GAP)
    title = "Position apart (m): ours - EKF2 (dark), and what the model leaves of it (light)"
    axes = marks.panel(page, analysis, title, _time_words(why), TIME_POINTS, axis=name, strip=True)
    apart, left_over = (pd.Series(v, why.times_s) for v in (why.apart_m, why.left_m))
    for start, end in why.spans_s:
        curve(axes, apart.loc[start:end], **LINES["ours"])
        curve(axes, left_over.loc[start:end], color=EKF2, lw=0.8)


def _waterfall(axes: Axes, names: list[str], shares: Array, left: float) -> None:
    """Bars from the whole difference down to what is left, in per cent of the whole."""
    before = 100.0 - np.concatenate([[0.0], np.cumsum(shares)])
    rows, farthest = len(names) + 2, max(100.0, float(before.max()))
    style: dict[str, Any] = {"height": 0.7, "edgecolor": OURS, "lw": 0.6, "color": OURS}
    axes.barh(0, 100.0, **style)
    for row, (share, start) in enumerate(zip(shares, before, strict=False), start=1):
        style |= {"color": OURS_BAND, "hatch": ""} if share >= 0.0 else AWAY
        axes.barh(row, -share, left=start, **style)
        axes.plot([start] * 2, [row - 1.35, row + 0.35], color=MUTED, lw=0.5)
    style |= {"color": EKF2_BAND, "edgecolor": EKF2, "hatch": ""}
    axes.barh(rows - 1, left, **style)
    for row, number in enumerate((100.0, *shares, left)):
        digits = 1 if 0.05 <= abs(number) < 9.95 else 0
        axes.text(1.03 * farthest, row, f"{number:z.{digits}f} %", va="center", size=6.5)
    axes.set_yticks(range(rows), ["ours to EKF2, all of it", *names, "left unexplained"])
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_xlim(min(0.0, float(before.min())), 1.2 * farthest)
    axes.set_xlabel("% of the mean square")
    axes.grid(visible=False)


def _time_words(why: Why) -> str:
    """What to see along the flight."""
    farthest = int(np.argmax(np.abs(why.apart_m)))
    return (
        f"Farthest apart at {why.times_s[farthest]:.1f} s, {abs(why.apart_m[farthest]):.2g} m; the "
        f"model leaves {np.sqrt(np.mean(why.left_m**2)):.2g} m RMS."
    )
