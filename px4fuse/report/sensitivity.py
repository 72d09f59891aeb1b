"""Sensitivity: what SIGMA_A and SIGMA_Z do, and which of them the data ask for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import AxisComparison
from px4fuse.filter.likelihood import PROFILE_DROP, States, preintegrate, states
from px4fuse.filter.signals import AISLE
from px4fuse.filter.tuning import HORIZONTAL, Noise
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    EKF2,
    LEFT,
    MUTED,
    OURS,
    OURS_LINE,
    RIGHT,
    TRUTH_LINE,
    caption,
    empty,
    page,
    panels,
)

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
# Drops of log-likelihood: the 95 % intervals of one parameter, then further down
LEVELS = (0.0, PROFILE_DROP, 4.6, 9.0)
SHADES = ("#123f7a", "#6f93c4", "#c9d8ec")
WINDOW_S = 20.0
MAP_HEIGHT = 0.235


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page; none where nothing was tuned."""
    comparison, tuning = document.comparison, document.analysis.tuning
    name = next((n for n in (HORIZONTAL, AISLE) if n in tuning), None)
    if name is None:
        name = next(iter(tuning), None)
    if name is None:
        return
    results = {result.axis.name: result for result in comparison.axes}
    result = results.get(AISLE, comparison.axes[0])
    figure, cursor = page(
        "What the knobs do",
        "Top: how likely the innovations are under every pair of SIGMA_A and SIGMA_Z; darkest is "
        "most likely. Right and below: the same flight at a quarter, half, twice and four times "
        f"the chosen value of each ({result.axis.name}). A larger SIGMA_A or a smaller SIGMA_Z "
        "gives a larger gain: the filter follows the measurements, noise and all.",
    )
    legs = preintegrate(result.axis, comparison.settings)
    by_a = states(legs, np.array(FACTORS) * comparison.settings.sigma_a_m_s2,
                  comparison.settings.sigma_z_m)  # fmt: skip
    by_z = states(legs, comparison.settings.sigma_a_m_s2,
                  np.array(FACTORS) * comparison.settings.sigma_z_m)  # fmt: skip
    top = cursor.y - 0.02
    _map(figure, top, document, name)
    _curves(figure, top, by_a, by_z)
    grid = panels(figure, top - MAP_HEIGHT - 0.095, BOTTOM + 0.045, 4, len(FACTORS),
                  hspace=0.62, wspace=0.12)  # fmt: skip
    for rows, symbol, run in ((grid[:2], "SIGMA_A", by_a), (grid[2:], "SIGMA_Z", by_z)):
        _multiples(rows, symbol, run, result)
    yield figure


def _map(figure: Figure, top: float, document: Document, name: str) -> None:
    """Likelihood map with the optimum, its intervals and the chosen point."""
    width = (RIGHT - LEFT) * 0.45
    axes = figure.add_axes((LEFT + 0.015, top - MAP_HEIGHT, width, MAP_HEIGHT))
    found = document.analysis.tuning[name]
    if isinstance(found, Unavailable):
        empty(axes, f"No likelihood map: {found.reason}.")
        return
    settings = document.comparison.settings
    axes.contourf(
        found.map.sigma_z_m, found.map.sigma_a_m_s2, found.map.drop, LEVELS, colors=SHADES
    )
    best_a, best_z = _point(found.filter_sigma_a), _point(found.sigma_z)
    axes.plot(best_z, best_a, "o", color="white", mec="black", ms=4.5, label="most likely")
    axes.plot(settings.sigma_z_m, settings.sigma_a_m_s2, "X", color=EKF2, mec="black", mew=0.5,
              ms=6.5, label="chosen")  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for low, high, chosen, limit in (
        (*found.map.sigma_z_m[[0, -1]], settings.sigma_z_m, axes.set_xlim),
        (*found.map.sigma_a_m_s2[[0, -1]], settings.sigma_a_m_s2, axes.set_ylim),
    ):
        limit(min(low, chosen / 1.3), max(high, chosen * 1.3))
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(FixedLocator(_ticks(low, high)))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    axes.grid(False)
    axes.set_title(f"{name}: log-likelihood")
    axes.set_xlabel("SIGMA_Z (m)")
    axes.set_ylabel("SIGMA_A (m/s²)")
    axes.legend(loc="upper left", handlelength=1.0)
    caption(
        axes,
        f"SIGMA_A {_words(found.filter_sigma_a, 'm/s²')}; SIGMA_Z {_words(found.sigma_z, 'm')}. "
        f"The chosen pair is {found.gain_nats * found.count:.1f} below the maximum (ln, "
        f"{found.count} measurements).",
    )


def _ticks(low: float, high: float) -> list[float]:
    """A few round numbers on a log scale."""
    steps = [m * 10.0**e for e in range(-5, 4) for m in (1, 2, 5)]
    inside = [step for step in steps if low <= step <= high]
    if len(inside) >= 2:
        return inside
    return [float(f"{value:.2g}") for value in np.geomspace(low, high, 5)[1:-1]]


def _point(noise: Noise) -> float:
    return noise.value if noise.value is not None else (noise.high or noise.low or float("nan"))


def _words(noise: Noise, unit: str) -> str:
    if noise.value is None:
        if noise.high is None:
            return "not determined by this flight"
        return f"at most {noise.high:.2g} {unit} (95 %)"
    if noise.high is None:
        return f"{noise.value:.3g} {unit}, without an upper bound"
    low = 0.0 if noise.low is None else noise.low
    return f"{noise.value:.3g} {unit} (95 % {low:.3g} to {noise.high:.3g})"


def _settled(values: Array) -> Array:
    """Median over the second half, when the start is forgotten."""
    return np.asarray(np.median(values[len(values) // 2 :], axis=0))


def _curves(figure: Figure, top: float, by_a: States, by_z: States) -> None:
    """Settled gain and σ against the factor on each knob."""
    left = LEFT + (RIGHT - LEFT) * 0.56
    height = MAP_HEIGHT * 0.4
    for at, (title, column) in enumerate(
        (("settled gain (position)", "gain"), ("settled σ of position (m)", "sigma_p_m"))
    ):
        bottom = top - height - at * (MAP_HEIGHT - height)
        axes = figure.add_axes((left, bottom, RIGHT - left, height))
        for run, style, label in (
            (by_a, {"color": OURS, "marker": "o", "ls": "-"}, "SIGMA_A × factor"),
            (by_z, {"color": EKF2, "marker": "s", "ls": "--", "mfc": "none"}, "SIGMA_Z × factor"),
        ):
            axes.plot(FACTORS, _settled(getattr(run, column)), ms=3.5, lw=1.0, label=label, **style)  # type: ignore[arg-type]
        axes.set_xscale("log", base=2)
        axes.set_xticks(FACTORS, [f"{factor:g}" for factor in FACTORS])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(bottom=0.0)
        axes.set_title(title)
        if at == 0:
            axes.tick_params(axis="x", labelbottom=False)
        else:
            axes.legend(loc="upper left")
            gain, sigma = _settled(by_a.gain), _settled(by_a.sigma_p_m)
            axes.set_xlabel("factor on the chosen value")
            caption(axes, f"at the chosen values: gain {gain[2]:.2f}, σ_p {sigma[2]:.3f} m")


def _multiples(rows: list[list[Axes]], symbol: str, run: States, result: AxisComparison) -> None:
    """Velocity and σ of velocity over a stretch of the flight, one column per factor."""
    time = result.axis.measurement_time_s[-len(run.velocity_m_s) :]
    middle = (time[0] + time[-1]) / 2.0
    inside = np.abs(time - middle) <= WINDOW_S / 2.0
    settled = slice(len(time) // 2, None)
    truth = None if isinstance(result.truth, Unavailable) else result.truth["velocity_m_s"].dropna()
    against = truth if truth is not None and len(truth) else None
    low, high = run.velocity_m_s[inside].min(), run.velocity_m_s[inside].max()
    for column, factor in enumerate(FACTORS):
        axes, below = rows[0][column], rows[1][column]
        value, sigma = run.velocity_m_s[:, column], run.sigma_v_m_s[:, column]
        if against is not None:
            shown = against[np.abs(against.index - middle) <= WINDOW_S / 2.0]
            axes.plot(shown.index, shown, **TRUTH_LINE)
        axes.plot(time[inside], value[inside], **OURS_LINE)
        axes.set_ylim(low - 0.1 * (high - low) - 1e-3, high + 0.1 * (high - low) + 1e-3)
        axes.set_title(f"{symbol} × {factor:g}", size=7.5)
        below.plot(time[inside], sigma[inside], **OURS_LINE)
        below.set_ylim(0.0, 1.15 * float(run.sigma_v_m_s[inside].max()))
        for single in (axes, below):
            single.tick_params(axis="y", labelleft=column == 0)
            single.tick_params(axis="x", labelbottom=False, bottom=False)
        numbers = f"mean NIS {np.mean(run.nis[settled, column]):.2f}"
        if against is not None:
            error = value - np.interp(time, against.index, against)
            numbers = f"RMSE {np.sqrt(np.mean(error[settled] ** 2)):.3f} m/s; " + numbers
        caption(axes, numbers, size=6.3)
        caption(below, f"σ_v {np.median(sigma[settled]):.3f} m/s", size=6.3)
    rows[0][0].set_ylabel("v (m/s)")
    rows[1][0].set_ylabel("σ_v (m/s)")
    figure = rows[0][0].get_figure()
    if figure is not None and symbol == "SIGMA_Z":
        box = rows[1][0].get_position()
        figure.text(
            box.x0, BOTTOM + 0.01,
            f"{WINDOW_S:g} s about the middle of the flight"
            + (", dotted: truth" if against is not None else "")
            + "; numbers over its second half.",
            size=6.8, color=MUTED,
        )  # fmt: skip
