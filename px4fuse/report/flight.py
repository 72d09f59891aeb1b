"""The flight along the main axis: position, velocity and error of both filters on one time axis."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from px4fuse.arrays import Array
from px4fuse.comparison.model import FILTERS, AgainstTruth, AxisComparison, Difference
from px4fuse.comparison.why import the
from px4fuse.flight import Unavailable
from px4fuse.report import marks
from px4fuse.report.document import Document
from px4fuse.report.page import Page
from px4fuse.report.style import (
    EKF2_LINE,
    MAX_POINTS,
    MEASURED,
    OURS_BAND,
    OURS_LINE,
    TIME_LABEL,
    TRUTH_LINE,
    bare_x,
    thin,
)
from px4fuse.report.why import nothing_concluded

# Of the axes, in points
HEIGHT = 150.0


def draw(document: Document) -> Iterator[Page]:
    """Draw one page."""
    result = document.comparison.main
    along = the(result.axis.name)
    page = Page(f"The flight along {along}")
    legend(page, document)
    reference = error_reference(result)
    panels = [
        (f"Position along {along} (m)", position_words(result), draw_position, position_numbers),
        (f"Velocity along {along} (m/s)", velocity_words(result), draw_velocity, velocity_numbers),
    ]
    if not isinstance(reference, Unavailable):
        truth = reference is result.truth
        title = "Error: position - truth (m)" if truth else "Difference: ours - EKF2 (m)"
        panels.append((title, error_words(result), draw_error, error_numbers))
    for place, (title, say, draw_panel, numbers) in enumerate(panels):
        strip = place == 0 and bool(document.events.modes)
        axes = page.panel(title, say, HEIGHT, above=12.0 if strip else 4.0)
        draw_panel(axes, result, MAX_POINTS)
        marks.draw(axes, document, strip=strip)
        if place < len(panels) - 1:
            bare_x(axes)
        else:
            axes.set_xlabel(TIME_LABEL)
        page.numbers(numbers(result))
    page.write(nothing_concluded(document), above=6.0)
    if isinstance(reference, Unavailable):
        page.write(f"No error is drawn: {reference.reason}. {reference.remedy}", above=6.0)
    yield page


def legend(page: Page, document: Document) -> None:
    """Write the legend of lines and marks that holds for all pages."""
    result = document.comparison.main
    lines: list[Artist] = [
        Line2D([], [], **{**MEASURED, "ms": 5.0}, label="measurement"),
        Line2D([], [], **OURS_LINE, label="ours"),
        Patch(facecolor=OURS_BAND, lw=0, label="ours ±2σ"),
    ]
    if isinstance(result.ekf2_state, pd.DataFrame):
        lines.append(Line2D([], [], **EKF2_LINE, label="EKF2"))
    if isinstance(result.truth, pd.DataFrame):
        lines.append(Line2D([], [], **TRUTH_LINE, label="truth"))
    page.legend(lines, marks.handles(document))


def error_reference(result: AxisComparison) -> pd.DataFrame | Unavailable:
    """What errors are counted from: the truth, or else EKF2."""
    return result.truth if isinstance(result.truth, pd.DataFrame) else result.ekf2_state


def draw_position(axes: Axes, result: AxisComparison, limit: int) -> None:
    """Draw the measurements, both filters with our band, and the truth."""
    axes.plot(*thin(result.axis.measurement_time_s, result.axis.measurement_m, limit), **MEASURED)
    _tracks(axes, result, "position_m", "position_variance_m2", limit)


def draw_velocity(axes: Axes, result: AxisComparison, limit: int) -> None:
    """Draw the velocity of both filters with our band, and the truth."""
    _tracks(axes, result, "velocity_m_s", "velocity_variance_m2_s2", limit)


def draw_error(axes: Axes, result: AxisComparison, limit: int) -> None:
    """Position errors against truth, or the difference to EKF2 where there is no truth."""
    reference = error_reference(result)
    assert isinstance(reference, pd.DataFrame)
    steps = result.replay.steps
    time = steps.index.to_numpy()
    sigma = np.sqrt(steps["position_variance_m2"].to_numpy())
    band_time, band = thin(time, 2.0 * sigma, limit)
    axes.fill_between(band_time, -band, band, color=OURS_BAND, lw=0)
    axes.axhline(0.0, color="black", lw=0.5)
    error = _from(reference, time, steps["position_m"].to_numpy())
    scale = [np.nanmax(np.abs(error)), 2.2 * float(np.median(sigma))]
    if reference is result.truth and isinstance(result.ekf2_state, pd.DataFrame):
        ekf2_time = result.ekf2_state.index.to_numpy()
        ekf2_error = _from(reference, ekf2_time, result.ekf2_state["position_m"].to_numpy())
        axes.plot(*thin(ekf2_time, ekf2_error, limit), **EKF2_LINE, zorder=2.5)
        scale.append(np.nanmax(np.abs(ekf2_error)))
    axes.plot(*thin(time, error, limit), **OURS_LINE)
    axes.set_ylim(-1.1 * max(scale), 1.1 * max(scale))


def _from(frame: pd.DataFrame, times: Array, position_m: Array) -> Array:
    at: Array = np.interp(times, frame.index, frame["position_m"], left=np.nan, right=np.nan)
    return position_m - at


def _tracks(axes: Axes, result: AxisComparison, column: str, variance: str, limit: int) -> None:
    steps = result.replay.steps
    time, value = steps.index.to_numpy(), steps[column].to_numpy()
    sigma = np.sqrt(steps[variance].to_numpy())
    band_time, upper = thin(time, value + 2.0 * sigma, limit)
    lower = np.interp(band_time, time, value - 2.0 * sigma)
    axes.fill_between(band_time, lower, upper, color=OURS_BAND, lw=0)
    shown = [value]
    for frame, style in ((result.ekf2_state, EKF2_LINE), (result.truth, TRUTH_LINE)):
        if isinstance(frame, pd.DataFrame) and frame[column].notna().any():
            axes.plot(
                *thin(frame.index.to_numpy(), frame[column].to_numpy(), limit), **style, zorder=2.5
            )
            shown.append(frame[column].dropna().to_numpy())
    axes.plot(*thin(time, value, limit), **OURS_LINE)
    # scaled to the tracks, not to the wide band of the first second
    every = np.concatenate(shown)
    pad = 0.08 * float(np.ptp(every)) + 1e-3
    axes.set_ylim(every.min() - pad, every.max() + pad)


def position_words(result: AxisComparison) -> str:
    """What to see in the positions."""
    travelled = float(np.ptp(result.axis.measurement_m))
    words = f"{len(result.replay.updates)} measurements over {travelled:.3g} m"
    apart = _farthest(result)
    if apart is None:
        return f"{words}; our filter follows them."
    time_s, distance_m = apart
    return f"{words}; ours and EKF2 are farthest apart, {distance_m:.2g} m, at {time_s:.1f} s."


def _farthest(result: AxisComparison) -> tuple[float, float] | None:
    if not isinstance(result.ekf2_state, pd.DataFrame) or isinstance(
        result.difference, Unavailable
    ):
        return None
    steps = result.replay.steps
    ours = pd.DataFrame({"position_m": steps["position_m"]}, index=steps.index)
    time = result.ekf2_state.index.to_numpy()
    apart = np.abs(_from(ours, time, result.ekf2_state["position_m"].to_numpy()))
    at = int(np.nanargmax(apart))
    return float(time[at]), float(apart[at])


def velocity_words(result: AxisComparison) -> str:
    """What to see in the velocities."""
    words = "Never measured: each filter infers it from positions and IMU"
    ours, theirs = result.filters["kf"].truth, result.filters["ekf2"].truth
    if not isinstance(ours, AgainstTruth) or ours.velocity_rmse_m_s is None:
        return f"{words}."
    if not isinstance(theirs, AgainstTruth) or theirs.velocity_rmse_m_s is None:
        return f"{words}, ours to {ours.velocity_rmse_m_s:.3f} m/s of the truth."
    return (
        f"{words}. {_nearer(ours.velocity_rmse_m_s, theirs.velocity_rmse_m_s)} "
        f"({ours.velocity_rmse_m_s:.3f} and {theirs.velocity_rmse_m_s:.3f} m/s RMS)."
    )


def _nearer(ours: float, theirs: float) -> str:
    """Which of two filters is nearer to the truth, by root mean square."""
    low, high = sorted((ours, theirs))
    if high < 1.1 * low:
        return "Ours and EKF2 are equally near to the truth"
    first, second = ("Ours", "EKF2") if ours < theirs else ("EKF2", "ours")
    return f"{first} is {high / low:.2g} times nearer to the truth than {second}"


def error_words(result: AxisComparison) -> str:
    """What to see in the errors."""
    share = inside_share(result)
    if isinstance(result.truth, pd.DataFrame):
        words = f"{share:.0%} of our error lies in our own ±2σ (blue), where 95% should"
        ours, theirs = (result.filters[name].truth for name in FILTERS)
        if isinstance(ours, AgainstTruth) and isinstance(theirs, AgainstTruth):
            nearer = _nearer(ours.position_rmse_m, theirs.position_rmse_m)
            words = f"{nearer}. {words}"
        return f"{words}."
    return (
        f"The log has no truth: this says how far both are apart, not who is right. {share:.0%} "
        "of it lies in our ±2σ (blue)."
    )


def inside_share(result: AxisComparison) -> float:
    """Share of our errors, or differences to EKF2, inside our own ±2σ."""
    reference = error_reference(result)
    assert isinstance(reference, pd.DataFrame)
    steps = result.replay.steps
    error = _from(reference, steps.index.to_numpy(), steps["position_m"].to_numpy())
    inside = np.abs(error) <= 2.0 * np.sqrt(steps["position_variance_m2"].to_numpy())
    return float(inside[np.isfinite(error)].mean())


def position_numbers(result: AxisComparison) -> str:
    """Numbers of the positions."""
    if not isinstance(result.difference, Difference):
        return f"{result.difference.what}: {result.difference.reason}"
    part = result.difference
    return (
        f"ours - EKF2: RMS {part.position_rmse_m:.3f} m, mean {part.position_mean_m:+.3f} m, "
        f"largest {part.position_maximum_m:.2f} m"
    )


def velocity_numbers(result: AxisComparison) -> str:
    """Numbers of the velocities."""
    words = [
        f"{name} {part.velocity_rmse_m_s:.3f}"
        for name, part in zip(
            ("ours", "EKF2"), (result.filters[name].truth for name in FILTERS), strict=True
        )
        if isinstance(part, AgainstTruth) and part.velocity_rmse_m_s is not None
    ]
    text = f"RMS to truth (m/s): {', '.join(words)}" if words else ""
    if isinstance(result.difference, Difference):
        apart = f"ours - EKF2: RMS {result.difference.velocity_rmse_m_s:.3f} m/s"
        text += f"{'; ' if text else ''}{apart}"
    return text


def error_numbers(result: AxisComparison) -> str:
    """Numbers of the errors."""
    words = [
        f"{name} {part.position_rmse_m:.3f}"
        for name, part in zip(
            ("ours", "EKF2"), (result.filters[name].truth for name in FILTERS), strict=True
        )
        if isinstance(part, AgainstTruth)
    ]
    return f"RMS to truth (m): {', '.join(words)}" if words else position_numbers(result)
