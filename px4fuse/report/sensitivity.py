"""Appendix: what the knobs do. The ratio SIGMA_A/SIGMA_Z makes the track, their size the claims."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.filter.fitting import FIRST_WIDTH
from px4fuse.filter.likelihood import States, preintegrate, states, total_over_grid
from px4fuse.filter.tuning import HORIZONTAL, MIN_MEASUREMENTS, AxisTuning, Noise
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words
from px4fuse.report import say
from px4fuse.report.page import Page, legend_above
from px4fuse.report.style import OURS, plain_ticks

FACTOR = 4.0
# The chosen pair, and what is done to SIGMA_A and SIGMA_Z: two of them share each other gain
SETTINGS = (
    ("as chosen", 1.0, 1.0),
    ("SIGMA_A × 4", FACTOR, 1.0),
    ("SIGMA_Z / 4", 1.0, 1.0 / FACTOR),
    ("SIGMA_A / 4", 1.0 / FACTOR, 1.0),
    ("SIGMA_Z × 4", 1.0, FACTOR),
)
# What two of them do alike, and where these stand
PAIRS = (("larger gain", (1, 2)), ("smaller gain", (3, 4)))
# ln of how much less likely a pair is than the best: the joint 95 % region, then powers of ten
REGION = float(-np.log(0.05))
LEVELS = (0.0, REGION, 10.0, 100.0, 1000.0, 10_000.0)
SHADES = ("#0b2a55", "#3f6aa8", "#86a7d3", "#c3d4ea", "#e6edf6")
SHADE_LABELS = ("95 % region", "10 below", "100", "1,000", "10,000")
COARSE_POINTS, FINE_POINTS = 14, 11
# Beyond what has to be seen, as a factor; and how many intervals the fine points reach
MARGIN, FINE_REACH = 1.3, 2.3
MAP, BESIDE = 140.0, 40.0  # of the axes, and beside them, in points


def draw(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw one page; none where nothing was tuned, or the start is not forgotten."""
    result, settings = analysis.main, analysis.settings
    if not analysis.tuning or len(result.replay.updates) < MIN_MEASUREMENTS:
        return
    page = Page("Appendix: what the knobs do", say("knobs"))
    chosen = np.array([settings.sigma_a_m_s2, settings.sigma_z_m])
    factors = np.array([(a, z) for _, a, z in SETTINGS]).T
    run = states(preintegrate(result.axis, settings), *(chosen[:, None] * factors))
    _map(page, analysis)
    _table(page, result, run, chosen)
    yield page


def _map(page: Page, analysis: Analysis) -> None:
    """Likelihood of every pair, with the lines on which the gain is the same."""
    from matplotlib.patches import Patch  # noqa: PLC0415

    tuning, settings = analysis.tuning, analysis.settings
    names = (HORIZONTAL, analysis.main.axis.name, *tuning)
    name = next(name for name in names if name in tuning)
    found = tuning[name]
    title = f"How likely the innovations are ({name})"
    if isinstance(found, Unavailable):
        page.write(f"{title}: no map, {found.reason}.")
        return
    axes = page.panel(title, _map_words(found), MAP, left=BESIDE, above=14.0)
    chosen = settings.sigma_a_m_s2, settings.sigma_z_m
    noises = found.filter_sigma_a, found.sigma_z
    (a, a_limits), (z, z_limits) = map(_grid, chosen, noises)
    axes.contourf(z, a, _drop(analysis, name, found, a, z), LEVELS, colors=SHADES)
    for factor in (1.0 / FACTOR, 1.0, FACTOR):
        same_gain = factor * chosen[0] / chosen[1] * z[[0, -1]]
        axes.plot(z[[0, -1]], same_gain, color="black", lw=0.7, ls=(0, (1, 1.5)))
    scaled = {label: (chosen[1] * of_z, chosen[0] * of_a) for label, of_a, of_z in SETTINGS}
    for (label, pair), marker in zip(PAIRS, "^v", strict=True):
        at = [scaled[SETTINGS[column][0]] for column in pair]
        axes.plot(*zip(*at, strict=True), marker, color=OURS, ms=4.0, label=label)
    best = [_point(noise) for noise in noises]
    axes.plot(best[1], best[0], "o", color="white", mec="black", ms=6.0, label="asked for")
    axes.plot(chosen[1], chosen[0], "X", color="black", mec="white", ms=8.0, label="chosen")
    axes.set(
        xscale="log",
        yscale="log",
        xlim=z_limits,
        ylim=a_limits,
        xlabel="SIGMA_Z (m)",
        ylabel="SIGMA_A (m/s²)",
    )
    plain_ticks(axes.xaxis)
    plain_ticks(axes.yaxis)
    axes.grid(False)
    shades = [
        Patch(facecolor=shade, label=label)
        for shade, label in zip(SHADES, SHADE_LABELS, strict=True)
    ]
    legend_above(axes, handles=[*shades, *axes.get_legend_handles_labels()[0]], handlelength=1.2)


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
        f"Asked for: SIGMA_A {noise_words(found.filter_sigma_a, 'm/s²')}, SIGMA_Z "
        f"{noise_words(found.sigma_z, 'm')}. The chosen pair lies {lost} below (ln). Along a "
        f"dotted line the gain is the same.{wander}"
    )


def noise_words(noise: Noise, unit: str) -> str:
    """A noise with its interval, or the bound that the data set where the search ended."""
    if noise.value is None:
        ends = (("at least", noise.low), ("at most", noise.high))
        known = [f"{word} {number_words(end)} {unit}" for word, end in ends if end is not None]
        return " and ".join(known) or "not determined"
    low, high = (number_words(end or 0.0) for end in (noise.low, noise.high))
    within = "or more" if noise.high is None else f"({low} to {high})"
    return f"{number_words(noise.value)} {unit} {within}"


def _point(noise: Noise) -> float:
    return noise.value or noise.high or noise.low or float("nan")


def _drop(comparison: Comparison, name: str, found: AxisTuning, a: Array, z: Array) -> Array:
    """Ln of how much less likely each pair is than the best of them, shape (n, m)."""
    axes = [
        one.axis
        for one in comparison.axes.values()
        if one.axis.name == name or (name == HORIZONTAL and one.axis.name in ("north", "east"))
    ]
    legs = [preintegrate(axis, comparison.settings) for axis in axes]
    time = axes[0].measurement_time_s[-len(legs[0].measurement_m) :]
    weight = np.where(np.isin(time, found.outlier_time_s), FIRST_WIDTH**-2.0, 1.0)
    total = total_over_grid(legs, a[:, None], z[None, :], weight)
    return np.asarray(total - total.min())


def _settled(values: Array) -> Array:
    """Median over the second half, when the start is forgotten."""
    return np.asarray(np.median(values[len(values) // 2 :], axis=0))


def _table(page: Page, result: AxisComparison, run: States, chosen: Array) -> None:
    """What each setting claims, beside what it does."""
    half = slice(len(run.gain) // 2, None)
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
            time = result.axis.measurement_time_s[-len(run.gain) :][half]
            error = run.velocity_m_s[half] - np.interp(time, true.index, true)[:, np.newaxis]
            head.append("v RMSE (m/s)")
            for row, rmse in zip(rows, np.sqrt((error**2).mean(axis=0)), strict=True):
                row.append(f"{rmse:.3f}")
    smaller = ""
    if nis[1] > 0.0:  # zero where the positions never change
        smaller = (
            f", and the NIS {factor_words(nis[2] / nis[1])} times smaller, about the same track"
        )
    page.heading("One track, two claims", above=10.0)
    page.write(say("two_claims", times=factor_words(sigmas[1] / sigmas[2]), smaller=smaller))
    page.table(head, rows, right=range(1, len(head)))
