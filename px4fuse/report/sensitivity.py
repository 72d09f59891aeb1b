"""Appendix: what the knobs do. The ratio SIGMA_A/SIGMA_Z makes the track, their size the claims."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.comparison.events import Span
from px4fuse.comparison.model import AxisComparison
from px4fuse.filter.fitting import FIRST_WIDTH
from px4fuse.filter.likelihood import States, preintegrate, states, total_over_grid
from px4fuse.filter.tuning import HORIZONTAL, MIN_MEASUREMENTS, AxisTuning, Noise
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words
from px4fuse.report import marks, style
from px4fuse.report.document import Document
from px4fuse.report.page import Page, halves, legend_above
from px4fuse.report.style import LINES, MUTED, OURS, OURS_BAND, curve, plain_ticks

FACTOR = 4.0
# The chosen pair, and what is done to SIGMA_A and SIGMA_Z: two of them share each other gain
SETTINGS = (
    ("as chosen", 1.0, 1.0),
    ("SIGMA_A × 4", FACTOR, 1.0),
    ("SIGMA_Z / 4", 1.0, 1.0 / FACTOR),
    ("SIGMA_A / 4", 1.0 / FACTOR, 1.0),
    ("SIGMA_Z × 4", 1.0, FACTOR),
)
# Names, columns of SETTINGS, and what the pair does
PAIRS = (
    ("Four times SIGMA_A, or a quarter of SIGMA_Z: larger gain", (1, 2)),
    ("A quarter of SIGMA_A, or four times SIGMA_Z: smaller gain", (3, 4)),
)
CURVE = FACTOR ** np.linspace(-2.0, 2.0, 17)
# ln of how much less likely a pair is than the best: the joint 95 % region, then powers of ten
REGION = float(-np.log(0.05))
LEVELS = (0.0, REGION, 10.0, 100.0, 1000.0, 10_000.0)
SHADES = ("#0b2a55", "#3f6aa8", "#86a7d3", "#c3d4ea", "#e6edf6")
SHADE_LABELS = ("95 % region", "10 below", "100", "1,000", "10,000")
COARSE_POINTS, FINE_POINTS = 14, 11
# Beyond what has to be seen, as a factor; and how many intervals the fine points reach
MARGIN, FINE_REACH = 1.3, 2.3
# Tracks further apart than this share of what the knobs do are not the same
LITTLE_APART = 0.1
SAME_GAIN = 0.02
WINDOW_S, WINDOW_STEP_S = 20.0, 0.5
# Heights of the axes in points
MAP, TRACK, BESIDE, BELOW = 140.0, 85.0, 40.0, 26.0
THICK: dict[str, Any] = {"color": OURS_BAND, "lw": 4.0, "ls": "-", "solid_capstyle": "butt"}
THIN: dict[str, Any] = {"color": OURS, "lw": 1.0, "ls": (0, (4, 1.6))}
CHOSEN: dict[str, Any] = {"color": "black", "marker": "X", "mec": "white", "mew": 0.8, "ms": 8.0,
                          "ls": "none"}  # fmt: skip
OF_A: dict[str, Any] = {"color": OURS, "marker": "o", "ms": 5.0, "mew": 0, "ls": "none"}
OF_Z: dict[str, Any] = {"color": "black", "marker": "s", "ms": 8.0, "mew": 0.8, "mfc": "none",
                        "ls": "none"}  # fmt: skip


def draw(document: Document) -> Iterator[Page]:
    """Draw one page; none where nothing was tuned, or the start is not forgotten."""
    result, settings = document.analysis.main, document.analysis.settings
    if not document.analysis.tuning or len(result.replay.updates) < MIN_MEASUREMENTS:
        return
    page = Page(
        "Appendix: what the knobs do",
        "The filter's gain depends on SIGMA_A / SIGMA_Z alone. Their size does not move the track: "
        "it scales what the filter claims about it, σ and S, and so the NIS. NIS tells the size, "
        "the track the ratio; maximum likelihood weighs both.",
    )
    chosen = np.array([settings.sigma_a_m_s2, settings.sigma_z_m])
    factors = np.array([(a, z) for _, a, z in SETTINGS] + [(f, 1.0) for f in CURVE]).T
    run = states(preintegrate(result.axis, settings), *(chosen[:, None] * factors))
    left, right = halves()
    _map(left, document)
    _gains(right, chosen[0] / chosen[1], _settled(run.gain))
    page.beside(left, right)
    time = result.axis.measurement_time_s[-len(run.gain) :]
    velocity = pd.DataFrame(run.velocity_m_s[:, : len(SETTINGS)], time)
    missing = [*document.events.gaps, *document.events.dropouts]
    window = _window(velocity[0], missing)
    for title, pair in PAIRS:
        axes = marks.panel(page, document, title, _apart_words(run, pair), TRACK, above=14.0,
                           last=pair is PAIRS[-1][1])  # fmt: skip
        for column, look in zip(pair, (THICK, THIN), strict=True):
            label = SETTINGS[column][0]
            curve(axes, velocity[column].loc[slice(*window)], **look, label=label)
        if isinstance(result.truth, pd.DataFrame):
            true = result.truth["velocity_m_s"].loc[slice(*window)].dropna()
            curve(axes, true, **LINES["truth"], label="truth")
        axes.set_xlim(*window)
        legend_above(axes)
    page.numbers(
        f"Velocity along {result.axis.called} (m/s) over the {window[1] - window[0]:.0f} s with "
        "the most motion in which nothing is missing."
    )
    _table(page, result, run, chosen, velocity)
    yield page


def _map(page: Page, document: Document) -> None:
    """Likelihood of every pair, with the lines on which the gain is the same."""
    from matplotlib.patches import Patch  # noqa: PLC0415

    tuning, settings = document.analysis.tuning, document.analysis.settings
    names = (HORIZONTAL, document.analysis.main.axis.name, *tuning)
    name = next(name for name in names if name in tuning)
    found = tuning[name]
    title = f"How likely the innovations are ({name})"
    if isinstance(found, Unavailable):
        style.empty(page.panel(title, "", MAP), f"No map: {found.reason}.")
        return
    axes = page.panel(title, _map_words(found), MAP, left=BESIDE, below=BELOW)
    chosen = settings.sigma_a_m_s2, settings.sigma_z_m
    noises = found.filter_sigma_a, found.sigma_z
    (a, a_limits), (z, z_limits) = map(_grid, chosen, noises)
    drop = _drop(document, name, found, a, z)
    axes.contourf(z, a, drop, LEVELS, colors=SHADES)
    for factor in (1.0 / FACTOR, 1.0, FACTOR):
        same_gain = factor * chosen[0] / chosen[1] * z[[0, -1]]
        axes.plot(z[[0, -1]], same_gain, color="black", lw=0.7, ls=(0, (1, 1.5)))
    for (_, of_a, of_z), look in zip(SETTINGS[1:], (OF_A, OF_Z, OF_A, OF_Z), strict=True):
        axes.plot(chosen[1] * of_z, chosen[0] * of_a, **look | {"ms": 4.0})
    best = [_point(noise) for noise in noises]
    axes.plot(best[1], best[0], "o", color="white", mec="black", ms=6.0, label="asked for")
    axes.plot(chosen[1], chosen[0], **CHOSEN, label="chosen")
    axes.set(xscale="log", yscale="log", xlim=z_limits, ylim=a_limits,
             xlabel="SIGMA_Z (m)", ylabel="SIGMA_A (m/s²)")  # fmt: skip
    plain_ticks(axes.xaxis)
    plain_ticks(axes.yaxis)
    axes.grid(False)
    shades = [
        Patch(facecolor=shade, label=label)
        for shade, label, level in zip(SHADES, SHADE_LABELS, LEVELS, strict=False)
        if level < drop.max()
    ]
    axes.legend(
        handles=[*shades, *axes.get_legend_handles_labels()[0]], loc="upper left", ncols=4,
        bbox_to_anchor=(-0.1, -0.2), borderaxespad=0.0, handlelength=1.2, columnspacing=1.0,
    )  # fmt: skip


def _grid(chosen: float, noise: Noise) -> tuple[Array, tuple[float, float]]:
    """Values of a knob, fine where it is likely, and the first and last that are shown."""
    best = _point(noise)
    least, most = noise.low or best, noise.high or best
    needed = (chosen / FACTOR, chosen * FACTOR, best, least, most)
    low, high = min(needed) / MARGIN, max(needed) * MARGIN
    spread = max(most / best, best / least, 1.02)
    fine = best * spread ** np.linspace(-FINE_REACH, FINE_REACH, FINE_POINTS)
    grid = np.concatenate([np.geomspace(low, high, COARSE_POINTS), fine])
    return np.unique(grid[(low <= grid) & (grid <= high)]), (low, high)


def _map_words(found: AxisTuning) -> str:
    lost = number_words(max(found.gain_nats * found.count, 0.0), 2)
    wanders = found.noises.walk_m > found.noises.sigma_z_m
    wander = " What the source wanders is not in them." if wanders else ""
    return (
        f"Asked for: SIGMA_A {_words(found.filter_sigma_a, 'm/s²')}, SIGMA_Z "
        f"{_words(found.sigma_z, 'm')}. The chosen pair lies {lost} below (ln). Along a dotted "
        f"line the gain is the same.{wander}"
    )


def _words(noise: Noise, unit: str) -> str:
    if noise.value is None:
        return (
            "not determined" if noise.high is None else f"at most {number_words(noise.high)} {unit}"
        )
    low, high = (number_words(end or 0.0) for end in (noise.low, noise.high))
    within = "or more" if noise.high is None else f"({low} to {high})"
    return f"{number_words(noise.value)} {unit} {within}"


def _point(noise: Noise) -> float:
    return noise.value or noise.high or noise.low or float("nan")


def _drop(document: Document, name: str, found: AxisTuning, a: Array, z: Array) -> Array:
    """Ln of how much less likely each pair is than the best of them, shape (n, m)."""
    comparison = document.analysis
    axes = [
        one.axis for one in comparison.axes.values()
        if one.axis.name == name or (name == HORIZONTAL and one.axis.name in ("north", "east"))
    ]  # fmt: skip
    legs = [preintegrate(axis, comparison.settings) for axis in axes]
    time = axes[0].measurement_time_s[-len(legs[0].measurement_m) :]
    weight = np.where(np.isin(time, found.outlier_time_s), FIRST_WIDTH**-2.0, 1.0)
    total = total_over_grid(legs, a[:, None], z[None, :], weight)
    return np.asarray(total - total.min())


def _gains(page: Page, ratio: float, gains: Array) -> None:
    """Settled gain over the ratio: a curve, on which both knobs stand."""
    at = np.array([ratio * a / z for _, a, z in SETTINGS])
    say = (
        f"{gains[0]:.2f} as chosen; {gains[1]:.2f} with four times SIGMA_A and {gains[2]:.2f} with "
        f"a quarter of SIGMA_Z; {gains[3]:.2f} with a quarter of SIGMA_A and {gains[4]:.2f} with "
        "four times SIGMA_Z."
    )
    if np.allclose(gains[[1, 3]], gains[[2, 4]], atol=SAME_GAIN):
        say = f"{say[:-1]}: each square holds its circle."
    axes = page.panel("Gain of position, settled, over the ratio", say, MAP, below=BELOW)
    axes.plot(ratio * CURVE, gains[len(SETTINGS) :], color=MUTED, lw=1.0)
    for columns, look, label in (
        ([1, 3], OF_A, "SIGMA_A × or / 4"), ([2, 4], OF_Z, "SIGMA_Z / or × 4"),
        ([0], CHOSEN, "chosen"),
    ):  # fmt: skip
        axes.plot(at[columns], gains[columns], **look, label=label)
    axes.set(xscale="log", xlim=ratio * CURVE[[0, -1]], ylim=(0.0, 1.0),
             xlabel="SIGMA_A / SIGMA_Z (1/s²)")  # fmt: skip
    ticks = ratio * CURVE[::4]
    axes.set_xticks(ticks, [number_words(tick, 2) for tick in ticks])
    axes.minorticks_off()
    axes.legend(loc="upper left", ncols=3, bbox_to_anchor=(-0.08, -0.2), borderaxespad=0.0,
                handlelength=1.0, columnspacing=1.0)  # fmt: skip


def _settled(values: Array) -> Array:
    """Median over the second half, when the start is forgotten."""
    return np.asarray(np.median(values[len(values) // 2 :], axis=0))


def _apart_words(run: States, pair: tuple[int, int]) -> str:
    """How far the two tracks of a pair are from one another and from the chosen one."""
    settled = run.velocity_m_s[len(run.velocity_m_s) // 2 :]
    apart, moved = (
        float(np.sqrt(np.mean((settled[:, pair[0]] - settled[:, other]) ** 2)))
        for other in (pair[1], 0)
    )
    same = "Less than 0.001" if apart < 0.0005 else f"{apart:.3f}"
    said = f"{same} m/s RMS from one another, {moved:.3f} m/s from the chosen track."
    if apart > LITTLE_APART * moved:
        said += " What the start and gaps of the IMU add to the variance does not scale with them."
    return said


def _window(velocity: pd.Series[float], missing: Sequence[Span]) -> Span:
    """The stretch with the most motion, among those in which the least is missing."""
    first, last = float(velocity.index[0]), float(velocity.index[-1])

    def worth(start: float) -> tuple[float, float]:
        end = start + WINDOW_S
        lost = sum(max(0.0, min(end, until) - max(start, since)) for since, until in missing)
        inside = velocity.loc[start:end]
        return -lost, float(inside.max() - inside.min()) if len(inside) else 0.0

    starts = np.arange(first, max(last - WINDOW_S, first) + 1e-9, WINDOW_STEP_S)
    best = max(starts.tolist(), key=worth)
    return best, min(best + WINDOW_S, last)


def _table(
    page: Page, result: AxisComparison, run: States, chosen: Array, velocity: pd.DataFrame
) -> None:
    """What each setting claims, beside what it does."""
    half = slice(len(velocity) // 2, None)
    gains, sigmas, nis = _settled(run.gain), _settled(run.sigma_p_m), run.nis[half].mean(axis=0)
    head = ["", "SIGMA_A (m/s²)", "SIGMA_Z (m)", "gain", "σ_p (m)", "mean NIS"]
    rows = []
    for at, (label, *scale) in enumerate(SETTINGS):
        noises = [number_words(value) for value in chosen * scale]
        claims = [number_words(value) for value in (sigmas[at], nis[at])]
        rows.append([label, *noises, f"{gains[at]:.2f}", *claims])
    if isinstance(result.truth, pd.DataFrame):
        true = result.truth["velocity_m_s"].dropna()
        if len(true):
            settled = velocity[half]
            error = settled.sub(np.interp(settled.index, true.index, true), axis=0)
            head.append("v RMSE (m/s)")
            for row, rmse in zip(rows, np.sqrt((error**2).mean()), strict=True):
                row.append(f"{rmse:.3f}")
    smaller = ""
    if nis[1] > 0.0:  # zero where the positions never change
        smaller = (
            f", and the NIS {factor_words(nis[2] / nis[1])} times smaller, about the same track"
        )
    page.heading("One track, two claims", above=10.0)
    page.write(
        f"With four times SIGMA_A σ_p is {factor_words(sigmas[1] / sigmas[2])} times what it is "
        f"with a quarter of SIGMA_Z{smaller}. Numbers over the second half of the flight."
    )
    page.table(head, rows, right=range(1, len(head)))
