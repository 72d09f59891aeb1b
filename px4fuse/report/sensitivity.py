"""Appendix: sensitivity of KF to SIGMA_A and SIGMA_Z, with their log-likelihood map."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison
from px4fuse.core.arrays import Array
from px4fuse.core.text import format_factor, format_number
from px4fuse.filter.likelihood import FilterStates, filter_states, preintegrate
from px4fuse.filter.tuning import (
    HORIZONTAL,
    MIN_MEASUREMENTS,
    AxisTuning,
    Noise,
    log_likelihood_drop,
)
from px4fuse.flight.model import Unavailable
from px4fuse.report.page import Page, draw_legend_above, halves
from px4fuse.report.style import KF_COLOUR, set_plain_ticks

NOISE_FACTOR = 4.0
# Label of each compared pair of noises, and its factors on SIGMA_A and SIGMA_Z
SETTINGS = (
    ("as chosen", 1.0, 1.0),
    ("SIGMA_A × 4", NOISE_FACTOR, 1.0),
    ("SIGMA_Z / 4", 1.0, 1.0 / NOISE_FACTOR),
    ("SIGMA_A / 4", 1.0 / NOISE_FACTOR, 1.0),
    ("SIGMA_Z × 4", 1.0, NOISE_FACTOR),
)
# Log-likelihood below its maximum (nats) of the contours: joint 95 % region, then decades
REGION_95_NATS = float(-np.log(0.05))
LEVELS_NATS = (0.0, REGION_95_NATS, 10.0, 100.0, 1000.0, 10_000.0)
SHADES = ("#0b2a55", "#3f6aa8", "#86a7d3", "#c3d4ea", "#e6edf6")
SHADE_LABELS = ("95 %", "10 below", "100", "1,000", "10,000")
COARSE_POINTS, FINE_POINTS = 14, 11
# Factor of the map's margin, and reach of the fine grid in half 95 % intervals (log scale)
MAP_MARGIN_FACTOR, FINE_GRID_REACH = 1.3, 2.3
MAP_HEIGHT, MAP_LEFT, LEGEND_HEIGHT = 150.0, 40.0, 42.0  # points
MAP_COLUMN_FRACTION = 0.42  # fraction of the page width for the map


def draw(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the appendix on SIGMA_A and SIGMA_Z if they were estimated."""
    result, settings = analysis.main, analysis.settings
    if not analysis.tuning or len(result.replay.updates) < MIN_MEASUREMENTS:
        return
    page = Page(
        "Appendix: sensitivity to SIGMA_A and SIGMA_Z",
        (
            "The KF gain depends only on the ratio SIGMA_A / SIGMA_Z. Their common "
            "scale changes the reported σ, S and NIS, but not the track. NIS determines "
            "the scale, the innovations' correlation the ratio; maximum likelihood uses "
            "both."
        ),
    )
    used_noises = np.array([settings.sigma_a_m_s2, settings.sigma_z_m])
    factors = np.array([(a, z) for _, a, z in SETTINGS]).T
    states = filter_states(preintegrate(result.axis, settings), *(used_noises[:, None] * factors))
    map_column, table_column = halves(MAP_COLUMN_FRACTION)
    _draw_map(map_column, analysis)
    _write_table(table_column, result, states, used_noises)
    page.add_columns(map_column, table_column)
    yield page


def _draw_map(page: Page, analysis: Analysis) -> None:
    """Draw the log-likelihood over SIGMA_A and SIGMA_Z, with lines of constant gain."""
    from matplotlib.patches import Patch  # noqa: PLC0415

    tuning, settings = analysis.tuning, analysis.settings
    names = (HORIZONTAL, analysis.main.axis.name, *tuning)
    name = next(name for name in names if name in tuning)
    tuned_noises = tuning[name]
    title = f"Log-likelihood over SIGMA_A and SIGMA_Z ({name})"
    if isinstance(tuned_noises, Unavailable):
        page.write(f"{title} is not available: {tuned_noises.reason}.")
        return
    axes = page.panel(
        title, _map_sentence(tuned_noises), MAP_HEIGHT, left=MAP_LEFT, above=LEGEND_HEIGHT
    )
    used_noises = settings.sigma_a_m_s2, settings.sigma_z_m
    noises = tuned_noises.sigma_a_two_state, tuned_noises.sigma_z
    (a, a_limits), (z, z_limits) = map(_noise_grid, used_noises, noises)
    kf_axes = (result.axis for result in analysis.axes.values())
    drop = log_likelihood_drop(tuned_noises, kf_axes, settings, a, z)
    axes.contourf(z, a, drop, LEVELS_NATS, colors=SHADES)
    for factor in (1.0 / NOISE_FACTOR, 1.0, NOISE_FACTOR):
        sigma_a_of_gain = factor * used_noises[0] / used_noises[1] * z[[0, -1]]
        axes.plot(z[[0, -1]], sigma_a_of_gain, color="black", lw=0.7, ls=(0, (1, 1.5)))
    compared_points = [
        (used_noises[1] * z_factor, used_noises[0] * a_factor)
        for _, a_factor, z_factor in SETTINGS[1:]
    ]
    axes.plot(
        *zip(*compared_points, strict=True),
        "D",
        color=KF_COLOUR,
        ms=4.0,
        label="pairs in the table",
    )
    best_noises = [_best_value(noise) for noise in noises]
    axes.plot(
        best_noises[1], best_noises[0], "o", color="white", mec="black", ms=6.0, label="maximum"
    )
    axes.plot(
        used_noises[1], used_noises[0], "X", color="black", mec="white", ms=8.0, label="chosen"
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlim=z_limits,
        ylim=a_limits,
        xlabel="SIGMA_Z (m)",
        ylabel="SIGMA_A (m/s²)",
    )
    set_plain_ticks(axes.xaxis)
    set_plain_ticks(axes.yaxis)
    axes.grid(False)
    shades = [
        Patch(facecolor=shade, label=label)
        for shade, label in zip(SHADES, SHADE_LABELS, strict=True)
    ]
    draw_legend_above(
        axes,
        column_count=3,
        handles=[*shades, *axes.get_legend_handles_labels()[0]],
        handlelength=1.2,
    )


def _noise_grid(used_noise: float, noise: Noise) -> tuple[Array, tuple[float, float]]:
    """Return grid values of a noise, fine near its estimate, and the limits of the axis."""
    best_noise = _best_value(noise)
    lowest_noise, highest_noise = noise.low or best_noise, noise.high or best_noise
    shown_values = (
        used_noise / NOISE_FACTOR,
        used_noise * NOISE_FACTOR,
        best_noise,
        lowest_noise,
        highest_noise,
    )
    low, high = min(shown_values) / MAP_MARGIN_FACTOR, max(shown_values) * MAP_MARGIN_FACTOR
    spread = max(highest_noise / best_noise, best_noise / lowest_noise, 1.02)
    fine_grid = best_noise * spread ** np.linspace(-FINE_GRID_REACH, FINE_GRID_REACH, FINE_POINTS)
    grid = np.concatenate([np.geomspace(low, high, COARSE_POINTS), fine_grid])
    return np.unique(grid[(low <= grid) & (grid <= high)]), (low, high)


def _map_sentence(tuned_noises: AxisTuning) -> str:
    drop = format_number(
        max(tuned_noises.log_likelihood_gain_per_measurement * tuned_noises.count, 0.0), 2
    )
    has_random_walk = tuned_noises.noises.random_walk_m > tuned_noises.noises.sigma_z_m
    walk_note = " The random walk of the source is not included." if has_random_walk else ""
    return (
        "Maximum-likelihood estimate: SIGMA_A "
        f"{format_noise(tuned_noises.sigma_a_two_state, 'm/s²')}, SIGMA_Z "
        f"{format_noise(tuned_noises.sigma_z, 'm')}. The chosen pair is {drop} nats below the "
        f"maximum. Dotted lines: constant gain.{walk_note}"
    )


def format_noise(noise: Noise, unit: str) -> str:
    """Format an estimated noise with its 95 % interval, or its bounds without an estimate."""
    if noise.value is None:
        ends = (("at least", noise.low), ("at most", noise.high))
        bounds = [f"{word} {format_number(end)} {unit}" for word, end in ends if end is not None]
        return " and ".join(bounds) or "unknown"
    low, high = (format_number(end or 0.0) for end in (noise.low, noise.high))
    interval = "or more" if noise.high is None else f"({low} to {high})"
    return f"{format_number(noise.value)} {unit} {interval}"


def _best_value(noise: Noise) -> float:
    return noise.value or noise.high or noise.low or float("nan")


def _second_half_median(values: Array) -> Array:
    """Return the median over the second half of the flight, which has no initial transient."""
    return np.asarray(np.median(values[len(values) // 2 :], axis=0))


def _write_table(
    page: Page, result: AxisComparison, states: FilterStates, used_noises: Array
) -> None:
    """Write gain, reported σ, mean NIS and velocity RMSE of KF for each pair of noises."""
    second_half = slice(len(states.gain) // 2, None)
    gains, sigmas, nis = (
        _second_half_median(states.gain),
        _second_half_median(states.sigma_p_m),
        states.nis[second_half].mean(axis=0),
    )
    head = ["", "SIGMA_A\n(m/s²)", "SIGMA_Z\n(m)", "gain", "σ_p\n(m)", "mean\nNIS"]
    rows = []
    for index, (label, *scale) in enumerate(SETTINGS):
        noises = [format_number(value) for value in used_noises * scale]
        reported_sigmas = [format_number(value) for value in (sigmas[index], nis[index])]
        rows.append([label, *noises, f"{gains[index]:.2f}", *reported_sigmas])
    if isinstance(result.truth, pd.DataFrame):
        true_velocity = result.truth["velocity_m_s"].dropna()
        if len(true_velocity):
            time = result.axis.measurement_time_s[-len(states.gain) :][second_half]
            error = (
                states.velocity_m_s[second_half]
                - np.interp(time, true_velocity.index, true_velocity)[:, np.newaxis]
            )
            head.append("v RMSE\n(m/s)")
            for row, rmse in zip(rows, np.sqrt((error**2).mean(axis=0)), strict=True):
                row.append(f"{rmse:.3f}")
    nis_text = ""
    if nis[1] > 0.0:  # NIS is zero if the positions never change
        nis_text = f", and the NIS {format_factor(nis[2] / nis[1])} times smaller"
    page.heading("Settings with the same track and different σ", 9.5, above=9.0)
    page.write(
        f"With SIGMA_A × 4, σ_p is {format_factor(sigmas[1] / sigmas[2])} times larger than with "
        f"SIGMA_Z / 4{nis_text}; the track is nearly the same. All numbers are of the second half "
        "of the flight."
    )
    page.table(head, rows, right_aligned_columns=range(1, len(head)))
