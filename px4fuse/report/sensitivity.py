"""Appendix: what the knobs do. The ratio SIGMA_A/SIGMA_Z makes the track, their size the claims."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from px4fuse.arrays import Array
from px4fuse.comparison.events import Span
from px4fuse.comparison.model import AxisComparison
from px4fuse.filter.fitting import FIRST_WIDTH
from px4fuse.filter.likelihood import States, preintegrate, states, total_over_grid
from px4fuse.filter.signals import AISLE
from px4fuse.filter.tuning import HORIZONTAL, MIN_MEASUREMENTS, AxisTuning, Noise
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words
from px4fuse.report import marks
from px4fuse.report.document import Document
from px4fuse.report.page import Page, halves, legend_above
from px4fuse.report.style import MUTED, OURS, OURS_BAND, TIME_LABEL, TRUTH_LINE, bare_x, empty, thin

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
    result, settings = document.comparison.main, document.comparison.settings
    if not document.analysis.tuning or len(result.replay.updates) < MIN_MEASUREMENTS:
        return
    name = result.axis.name
    page = Page(
        "Appendix: what the knobs do",
        "The filter's gain depends on SIGMA_A / SIGMA_Z alone. Their size does not move the track: "
        "it scales what the filter claims about it, σ and S, and so the NIS. NIS tells the size, "
        "the track the ratio; maximum likelihood weighs both.",
    )
    chosen = np.array([settings.sigma_a_m_s2, settings.sigma_z_m])
    ratio = chosen[0] / chosen[1]
    factors = np.array([(a, z) for _, a, z in SETTINGS] + [(f, 1.0) for f in CURVE]).T
    run = states(preintegrate(result.axis, settings), *(chosen[:, None] * factors))
    curve = _settled(run.gain)
    left, right = halves()
    _map(left, document)
    _gains(right, ratio, curve)
    page.beside(left, right)
    window = _window(
        result, run.velocity_m_s[:, 0], [*document.events.gaps, *document.events.dropouts]
    )
    for place, (title, pair) in enumerate(PAIRS):
        axes = page.panel(title, _apart_words(run, pair), TRACK, above=14.0)
        marks.draw(axes, document)
        _tracks(axes, result, run, pair, window)
        legend_above(axes)
        if place < len(PAIRS) - 1:
            bare_x(axes)
        else:
            axes.set_xlabel(TIME_LABEL)
    along = "the aisle" if name == AISLE else name
    page.numbers(
        f"Velocity along {along} (m/s) over the {window[1] - window[0]:.0f} s with the most "
        "motion in which nothing is missing.",
    )
    _table(page, result, run, chosen)
    yield page


def _map(page: Page, document: Document) -> None:
    """Likelihood of every pair, with the lines on which the gain is the same."""
    tuning, settings = document.analysis.tuning, document.comparison.settings
    main = document.comparison.main.axis.name
    name = next((n for n in (HORIZONTAL, main) if n in tuning), next(iter(tuning)))
    found = tuning[name]
    title = f"How likely the innovations are ({name})"
    if isinstance(found, Unavailable):
        empty(page.panel(title, "", MAP), f"No map: {found.reason}.")
        return
    axes = page.panel(title, _map_words(found), MAP, left=BESIDE, below=BELOW)
    best = _point(found.filter_sigma_a), _point(found.sigma_z)
    grids, shown = [], []
    for value, asked, noise in (
        (settings.sigma_a_m_s2, best[0], found.filter_sigma_a),
        (settings.sigma_z_m, best[1], found.sigma_z),
    ):
        needed = (value / FACTOR, value * FACTOR, asked, noise.low or asked, noise.high or asked)
        low, high = min(needed) / MARGIN, max(needed) * MARGIN
        spread = max((noise.high or asked) / asked, asked / (noise.low or asked), 1.02)
        fine = asked * spread ** np.linspace(-FINE_REACH, FINE_REACH, FINE_POINTS)
        grid = np.concatenate([np.geomspace(low, high, COARSE_POINTS), fine])
        grids.append(np.unique(grid[(low <= grid) & (grid <= high)]))
        shown.append((low, high))
    a, z = grids
    drop = _drop(document, name, found, a, z)
    axes.contourf(z, a, drop, LEVELS, colors=SHADES)
    for factor in (1.0 / FACTOR, 1.0, FACTOR):
        slope = factor * settings.sigma_a_m_s2 / settings.sigma_z_m
        axes.plot(z[[0, -1]], slope * z[[0, -1]], color="black", lw=0.7, ls=(0, (1, 1.5)))
    for (_, of_a, of_z), style in zip(SETTINGS[1:], (OF_A, OF_Z, OF_A, OF_Z), strict=True):
        axes.plot(settings.sigma_z_m * of_z, settings.sigma_a_m_s2 * of_a, **style | {"ms": 4.0})
    axes.plot(best[1], best[0], "o", color="white", mec="black", ms=6.0, label="asked for")
    axes.plot(settings.sigma_z_m, settings.sigma_a_m_s2, **CHOSEN, label="chosen")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(*shown[0])
    axes.set_xlim(*shown[1])
    _round_ticks(axes)
    axes.grid(False)
    axes.set_xlabel("SIGMA_Z (m)")
    axes.set_ylabel("SIGMA_A (m/s²)")
    shades = [
        Patch(facecolor=shade, label=label)
        for shade, label, level in zip(
            SHADES, ("95 % region", "10 below", "100", "1,000", "10,000"), LEVELS,
            strict=False,
        )
        if level < drop.max()
    ]  # fmt: skip
    axes.legend(
        handles=[*shades, *axes.get_legend_handles_labels()[0]], loc="upper left", ncols=4,
        bbox_to_anchor=(-0.1, -0.2), borderaxespad=0.0, handlelength=1.2, columnspacing=1.0,
    )  # fmt: skip


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
        if noise.high is None:
            return "not determined"
        return f"at most {number_words(noise.high)} {unit}"
    low, high = (number_words(end or 0.0) for end in (noise.low, noise.high))
    if noise.high is None:
        return f"{number_words(noise.value)} {unit} or more"
    return f"{number_words(noise.value)} {unit} ({low} to {high})"


def _point(noise: Noise) -> float:
    return noise.value or noise.high or noise.low or float("nan")


def _drop(document: Document, name: str, found: AxisTuning, a: Array, z: Array) -> Array:
    """Ln of how much less likely each pair is than the best of them, shape (n, m)."""
    comparison = document.comparison
    axes = [
        one.axis for one in comparison.axes.values()
        if one.axis.name == name or (name == HORIZONTAL and one.axis.name in ("north", "east"))
    ]  # fmt: skip
    legs = [preintegrate(axis, comparison.settings) for axis in axes]
    time = axes[0].measurement_time_s[-len(legs[0].measurement_m) :]
    weight = np.where(np.isin(time, found.outlier_time_s), FIRST_WIDTH**-2.0, 1.0)
    total = total_over_grid(legs, a[:, None], z[None, :], weight)
    return np.asarray(total - total.min())


def _round_ticks(axes: Axes) -> None:
    """A few round numbers on both logarithmic axes."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        ones = 10.0 ** np.arange(-5, 4)
        steps = np.sort(np.concatenate([ones, 2 * ones, 5 * ones]))
        ticks = steps[(low <= steps) & (steps <= high)]
        if len(ticks) > 6:
            ticks = ones[(low <= ones) & (ones <= high)]
        axis.set_major_locator(FixedLocator(ticks.tolist()))
        axis.set_major_formatter(lambda value, _: number_words(value))
        axis.set_minor_locator(NullLocator())
        axis.set_minor_formatter(NullFormatter())


def _gains(page: Page, ratio: float, gains: Array) -> None:
    """Settled gain over the ratio: a curve, on which both knobs stand."""
    at = [ratio * a / z for _, a, z in SETTINGS]
    say = (
        f"{gains[0]:.2f} as chosen; {gains[1]:.2f} with four times SIGMA_A and {gains[2]:.2f} with "
        f"a quarter of SIGMA_Z; {gains[3]:.2f} with a quarter of SIGMA_A and {gains[4]:.2f} with "
        "four times SIGMA_Z."
    )
    if np.allclose(gains[[1, 3]], gains[[2, 4]], atol=SAME_GAIN):
        say = f"{say[:-1]}: each square holds its circle."
    axes = page.panel("Gain of position, settled, over the ratio", say, MAP, below=BELOW)
    axes.plot(ratio * CURVE, gains[len(SETTINGS) :], color=MUTED, lw=1.0)
    axes.plot(np.array(at)[[1, 3]], gains[[1, 3]], **OF_A, label="SIGMA_A × or / 4")
    axes.plot(np.array(at)[[2, 4]], gains[[2, 4]], **OF_Z, label="SIGMA_Z / or × 4")
    axes.plot(at[0], gains[0], **CHOSEN, label="chosen")
    axes.set_xscale("log")
    axes.set_xlim(ratio * CURVE[0], ratio * CURVE[-1])
    axes.set_ylim(0.0, 1.0)
    axes.xaxis.set_major_locator(FixedLocator((ratio * CURVE[::4]).tolist()))
    axes.xaxis.set_major_formatter(lambda value, _: number_words(value, 2))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("SIGMA_A / SIGMA_Z (1/s²)")
    axes.legend(loc="upper left", ncols=3, bbox_to_anchor=(-0.08, -0.2), borderaxespad=0.0,
                handlelength=1.0, columnspacing=1.0)  # fmt: skip


def _settled(values: Array) -> Array:
    """Median over the second half, when the start is forgotten."""
    return np.asarray(np.median(values[len(values) // 2 :], axis=0))


def _apart_words(run: States, pair: tuple[int, int]) -> str:
    """How far the two tracks of a pair are from one another and from the chosen one."""
    settled = run.velocity_m_s[len(run.velocity_m_s) // 2 :]
    apart = float(np.sqrt(np.mean((settled[:, pair[0]] - settled[:, pair[1]]) ** 2)))
    moved = float(np.sqrt(np.mean((settled[:, pair[0]] - settled[:, 0]) ** 2)))
    same = "Less than 0.001" if apart < 0.0005 else f"{apart:.3f}"
    why = (
        " What the start and gaps of the IMU add to the variance does not scale with them."
        if apart > LITTLE_APART * moved
        else ""
    )
    return f"{same} m/s RMS from one another, {moved:.3f} m/s from the chosen track.{why}"


def _window(result: AxisComparison, velocity: Array, missing: Sequence[Span]) -> Span:
    """The stretch with the most motion, among those in which the least is missing."""
    time = result.axis.measurement_time_s[-len(velocity) :]
    latest = max(time[-1] - WINDOW_S, time[0])

    def worth(start: float) -> tuple[float, float]:
        end = start + WINDOW_S
        lost = sum(max(0.0, min(end, until) - max(start, since)) for since, until in missing)
        inside = velocity[(start <= time) & (time <= end)]
        return -lost, float(np.ptp(inside)) if len(inside) else 0.0

    best = max(np.arange(time[0], latest + 1e-9, WINDOW_STEP_S).tolist(), key=worth)
    return best, min(best + WINDOW_S, float(time[-1]))


def _tracks(
    axes: Axes, result: AxisComparison, run: States, pair: tuple[int, int], window: Span
) -> None:
    """Two tracks on one another, and the truth."""
    time = result.axis.measurement_time_s[-len(run.velocity_m_s) :]
    inside = (window[0] <= time) & (time <= window[1])
    truth = _truth(result)
    for column, style in zip(pair, (THICK, THIN), strict=True):
        axes.plot(*thin(time[inside], run.velocity_m_s[inside, column]), **style,
                  label=SETTINGS[column][0])  # fmt: skip
    if truth is not None:
        shown = (window[0] <= truth[0]) & (truth[0] <= window[1])
        axes.plot(*thin(truth[0][shown], truth[1][shown]), **TRUTH_LINE, label="truth")
    axes.set_xlim(*window)


def _truth(result: AxisComparison) -> tuple[Array, Array] | None:
    """Times and velocities of the truth."""
    if isinstance(result.truth, Unavailable):
        return None
    known = result.truth["velocity_m_s"].dropna()
    return (known.index.to_numpy(), known.to_numpy()) if len(known) else None


def _table(page: Page, result: AxisComparison, run: States, chosen: Array) -> None:
    """What each setting claims, beside what it does: one text per column."""
    time = result.axis.measurement_time_s[-len(run.nis) :]
    half = slice(len(time) // 2, None)
    truth = _truth(result)
    count = len(SETTINGS)
    gains, sigmas = _settled(run.gain), _settled(run.sigma_p_m)
    nis = np.mean(run.nis[half], axis=0)
    columns = [
        ("", [label for label, _, _ in SETTINGS]),
        ("SIGMA_A (m/s²)", [number_words(chosen[0] * a) for _, a, _ in SETTINGS]),
        ("SIGMA_Z (m)", [number_words(chosen[1] * z) for _, _, z in SETTINGS]),
        ("gain", [f"{gain:.2f}" for gain in gains[:count]]),
        ("σ_p (m)", [number_words(sigma) for sigma in sigmas[:count]]),
        ("mean NIS", [number_words(value) for value in nis[:count]]),
    ]
    if truth is not None:
        error = run.velocity_m_s[half, :count] - np.interp(time[half], *truth)[:, None]
        rmse = np.sqrt(np.mean(error**2, axis=0))
        columns.append(("v RMSE (m/s)", [f"{value:.3f}" for value in rmse]))
    page.heading("One track, two claims", above=10.0)
    page.write(
        f"With four times SIGMA_A σ_p is {factor_words(sigmas[1] / sigmas[2])} times what it is "
        f"with a quarter of SIGMA_Z, and the NIS {factor_words(nis[2] / nis[1])} times smaller, "
        "about the same track. Numbers over the second half of the flight."
    )
    heads = [head for head, _ in columns]
    page.table(heads, list(zip(*(cells for _, cells in columns), strict=True)))
