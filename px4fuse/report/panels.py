"""What is drawn of one axis, for every page: each panel with its sentence and its numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison, Difference
from px4fuse.filter.consistency import Consistency
from px4fuse.flight import Unavailable
from px4fuse.plain import capitalise_first
from px4fuse.report import marks, say, style
from px4fuse.report.page import Page
from px4fuse.report.style import DOTS, LINES, Axes, draw_curve, draw_sigma_band, set_log_scale
from px4fuse.report.words import filters_by_name, format_verdict

NARROW_HEIGHT = 72.0  # points: height of the axes in a column of three
# The axes of innovations reach this much beyond 2√S, or beyond 99 % of the innovations if that is
# further, but not beyond so many √S; what lies outside is drawn at the edge and counted
EDGE_FACTOR, MAX_EDGE_SIGMAS = 1.3, 5.0


class Quantity(NamedTuple):
    """What both filters estimate: its unit, and where it and its errors stand."""

    unit: str
    column: str
    variance: str
    rmse: str
    sigma: str


POSITIONS = Quantity(
    "m", "position_m", "position_variance_m2", "position_rmse_m", "sigma_p_median_m"
)
VELOCITIES = Quantity(
    "m/s", "velocity_m_s", "velocity_variance_m2_s2", "velocity_rmse_m_s", "sigma_v_median_m_s"
)


class Panel(NamedTuple):
    """A panel over time: how it is drawn, and what is said above and below it."""

    title: str
    height: float
    draw: Callable[[Axes, AxisComparison], None]
    sentence: Callable[[Analysis, AxisComparison], str]
    numbers: Callable[[AxisComparison], str]

    def full_title(self, result: AxisComparison) -> str:
        """Its title, with what errors are counted from."""
        return self.title.format("truth" if isinstance(result.truth, pd.DataFrame) else "EKF2")

    def draw_on_page(
        self,
        page: Page,
        analysis: Analysis,
        result: AxisComparison,
        *,
        last: bool,
        strip: bool = False,
        narrow: bool = False,
    ) -> None:
        """Draw it on a page, above others on the same time axis unless it is the last.

        Parameters
        ----------
        strip : bool
            Name the flight modes above it.
        narrow : bool
            In a column of its own, without its sentence.
        """
        sentence, height = (
            ("", NARROW_HEIGHT) if narrow else (self.sentence(analysis, result), self.height)
        )
        # rejected innovations are there themselves
        rejected = "" if self is INNOVATIONS else result.axis.name
        axes = marks.panel(
            page,
            analysis,
            self.full_title(result),
            sentence,
            height,
            axis=rejected,
            strip=strip,
            last=last,
        )
        if narrow:
            axes.locator_params(axis="x", nbins=4)
        self.draw(axes, result)
        page.numbers(self.numbers(result))


# ------------------------------------------------------------------------------ position, velocity


def draw_tracks(axes: Axes, result: AxisComparison, quantity: Quantity) -> None:
    """Draw what was measured, both filters with our band, and the truth."""
    if quantity is POSITIONS:
        measurements = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        draw_curve(axes, measurements, **style.MEASUREMENT_DOTS)
    kf_values = result.replay.steps[quantity.column]
    draw_sigma_band(axes, kf_values, np.sqrt(result.replay.steps[quantity.variance]))
    drawn_series = [kf_values]
    for frame, name in ((result.ekf2_state, "EKF2"), (result.truth, "truth")):
        if isinstance(frame, pd.DataFrame) and frame[quantity.column].notna().any():
            draw_curve(axes, frame[quantity.column], **LINES[name], zorder=2.5)
            drawn_series.append(frame[quantity.column])
    draw_curve(axes, kf_values, **LINES["ours"])
    # scaled to the tracks, not to the wide band of the first second
    all_values = pd.concat(drawn_series)
    pad = 0.08 * (all_values.max() - all_values.min()) + 1e-3
    axes.set_ylim(all_values.min() - pad, all_values.max() + pad)


def error_reference(result: AxisComparison) -> pd.DataFrame | Unavailable:
    """What errors are counted from: the truth, or else EKF2."""
    return result.truth if isinstance(result.truth, pd.DataFrame) else result.ekf2_state


def position_difference(frame: pd.DataFrame, reference: pd.DataFrame) -> pd.Series[float]:
    """Position of one track minus another's (m), where both are known."""
    times, known = frame.index, reference["position_m"]
    at = np.interp(times, known.index, known, left=np.nan, right=np.nan)
    distance: pd.Series[float] = (frame["position_m"] - at).dropna()
    return distance


def draw_error(axes: Axes, result: AxisComparison) -> None:
    """Draw position errors against truth, or the difference to EKF2 where there is no truth."""
    reference, steps = error_reference(result), result.replay.steps
    assert isinstance(reference, pd.DataFrame)
    sigma = np.sqrt(steps["position_variance_m2"])
    draw_sigma_band(axes, 0.0 * sigma, sigma)
    axes.axhline(0.0, color="black", lw=0.5)
    error = position_difference(steps, reference)
    highest = [error.abs().max(), 2.2 * sigma.median()]
    if reference is result.truth and isinstance(result.ekf2_state, pd.DataFrame):
        ekf2_error = position_difference(result.ekf2_state, reference)
        draw_curve(axes, ekf2_error, **LINES["EKF2"], zorder=2.5)
        highest.append(ekf2_error.abs().max())
    draw_curve(axes, error, **LINES["ours"])
    axes.set_ylim(-1.1 * max(highest), 1.1 * max(highest))


def _position_sentence(_: Analysis, result: AxisComparison) -> str:
    travelled = float(np.ptp(result.axis.measurement_m))
    words = f"{len(result.replay.updates)} measurements over {travelled:.3g} m"
    if isinstance(result.ekf2_state, Unavailable) or isinstance(result.difference, Unavailable):
        return f"{words}; our filter follows them."
    distance = position_difference(result.ekf2_state, result.replay.steps).abs()
    return say("farthest", words=words, most_m=distance.max(), at_s=distance.idxmax())


def _velocity_sentence(_: Analysis, result: AxisComparison) -> str:
    words = "Never measured: each filter infers it from positions and IMU."
    return f"{words} {compare_rmse(result, VELOCITIES)}".rstrip()


def _error_sentence(_: Analysis, result: AxisComparison) -> str:
    share = fraction_inside_two_sigma(result)
    if isinstance(result.truth, pd.DataFrame):
        coverage_text = f"{share:.0%} of our error lies in our own ±2σ (blue), where 95% should."
        return f"{compare_rmse(result, POSITIONS)} {coverage_text}".lstrip()
    return say("no_truth", share=share)


def compare_rmse(result: AxisComparison, quantity: Quantity) -> str:
    """Which filter is nearer to the truth, by root mean square; empty where one is not known."""
    errors = _rmse_by_filter(result, quantity)
    if len(errors) < 2:
        return ""
    (low, first), (high, second) = sorted((error, name) for name, error in errors.items())
    if high < 1.1 * low:
        return "Ours and EKF2 are equally near to the truth."
    return f"{capitalise_first(first)} is {high / low:.2g} times nearer to the truth than {second}."


def fraction_inside_two_sigma(result: AxisComparison) -> float:
    """Share of our errors, or differences to EKF2, inside our own ±2σ."""
    reference, steps = error_reference(result), result.replay.steps
    assert isinstance(reference, pd.DataFrame)
    error = position_difference(steps, reference)
    return float((error.abs() <= 2.0 * np.sqrt(steps["position_variance_m2"])[error.index]).mean())


def _rmse_by_filter(result: AxisComparison, quantity: Quantity) -> dict[str, float]:
    """RMSE to the truth of each filter that has one."""
    values = {
        name: getattr(one.truth, quantity.rmse, None)
        for name, one in filters_by_name(result).items()
    }
    return {name: error for name, error in values.items() if error is not None}


def _error_numbers(result: AxisComparison, quantity: Quantity = POSITIONS) -> str:
    errors = ", ".join(
        f"{name} {error:.3f}" for name, error in _rmse_by_filter(result, quantity).items()
    )
    return f"RMS to truth ({quantity.unit}): {errors}" if errors else ""


def _position_numbers(result: AxisComparison) -> str:
    part = result.difference
    if isinstance(part, Unavailable):
        return f"{part.what}: {part.reason}"
    return say("apart", part=part)


def _velocity_numbers(result: AxisComparison) -> str:
    texts = [_error_numbers(result, VELOCITIES)]
    if isinstance(result.difference, Difference):
        texts.append(f"ours - EKF2: RMS {result.difference.velocity_rmse_m_s:.3f} m/s")
    return "; ".join(filter(None, texts))


# ---------------------------------------------------------------------------------- innovations, σ


def _axis_half_height(result: AxisComparison) -> float:
    """Half height of the axes: neither outliers nor a gap may flatten all the rest."""
    limits = []
    for frame in (result.replay.updates, result.ekf2_innovations):
        if isinstance(frame, pd.DataFrame):
            median_sigma = float(np.sqrt(frame["innovation_variance_m2"].median()))
            usual_innovation = float(np.quantile(frame["innovation_m"].abs(), 0.99))
            limits.append(
                max(2.0 * median_sigma, min(usual_innovation, MAX_EDGE_SIGMAS * median_sigma))
            )
    return EDGE_FACTOR * max(limits)


def draw_innovations(axes: Axes, result: AxisComparison) -> None:
    """Draw innovations of both filters with ±2√S; what EKF2 rejected is hollow."""
    edge, updates, frame = _axis_half_height(result), result.replay.updates, result.ekf2_innovations
    kf_innovations = updates["innovation_m"]
    draw_sigma_band(axes, 0.0 * kf_innovations, np.sqrt(updates["innovation_variance_m2"]))
    axes.axhline(0.0, color="black", lw=0.5)
    dots = [(kf_innovations, DOTS["ours"])]
    if isinstance(frame, pd.DataFrame):
        two_sigma = 2.0 * np.sqrt(frame["innovation_variance_m2"])
        for side in (two_sigma, -two_sigma):
            draw_curve(axes, side, **LINES["EKF2"])
        rejected = frame["rejected"] > 0
        innovations = frame["innovation_m"]
        dots = [
            (innovations[~rejected], DOTS["EKF2"]),
            (innovations[rejected], style.EKF2_REJECTED),
            *dots,
        ]
    for values, marker_style in dots:
        draw_curve(axes, values[values.abs() <= edge], **marker_style)
        for sign, marker in ((1.0, "^"), (-1.0, "v")):
            outside_times = values.index[sign * values > edge]  # shown at the edge
            edge_style: dict[str, Any] = {
                **marker_style,
                "marker": marker,
                "ms": 3.2,
                "clip_on": False,
            }
            if len(outside_times):
                axes.plot(
                    outside_times, np.full(len(outside_times), sign * 0.96 * edge), **edge_style
                )
    axes.set_ylim(-edge, edge)


def innovation_sentence(_: Analysis, result: AxisComparison) -> str:
    """What to see in the innovations."""
    sentences = []
    for name, one in filters_by_name(result).items():
        if isinstance(one, Unavailable):
            sentences.append(f"{capitalise_first(name)}: {one.reason}.")
        else:
            sentences.append(
                say("outside", who=capitalise_first(name), one=one, verdict=format_verdict(one))
            )
    if isinstance(result.ekf2_state, Unavailable):
        sentences.append(f"EKF2: {result.ekf2_state.reason}.")
    elif isinstance(result.ekf2_innovations, pd.DataFrame):
        count = int((result.ekf2_innovations["rejected"] > 0).sum())
        sentences += [f"It rejected {count} of them (hollow)."] if count else []
    return " ".join(sentences)


def _innovation_numbers(result: AxisComparison) -> str:
    edge, texts = _axis_half_height(result), []
    frames = {"ours": result.replay.updates, "EKF2": result.ekf2_innovations}
    for name, one in filters_by_name(result).items():
        frame = frames[name]
        if isinstance(one, Consistency) and isinstance(frame, pd.DataFrame):
            outside_count = int((frame["innovation_m"].abs() > edge).sum())
            texts.append(
                say("innovations", name=name, one=one)
                + (f", {outside_count} beyond the axis (triangles)" if outside_count else "")
            )
    return "; ".join(texts)


def _draw_sigma(axes: Axes, result: AxisComparison, quantity: Quantity) -> None:
    for frame, name in ((result.replay.steps, "ours"), (result.ekf2_variance, "EKF2")):
        if isinstance(frame, pd.DataFrame):
            draw_curve(axes, np.sqrt(frame[quantity.variance]), **LINES[name])
    set_log_scale(axes)


def sigma_sentence(analysis: Analysis, result: AxisComparison) -> str:
    """By how much σ grows in the longest gap of the source; empty where there is none."""
    if not analysis.events.gaps:
        return ""
    start, end = max(analysis.events.gaps, key=lambda gap: gap[1] - gap[0])
    largest = {
        name: float(np.sqrt(frame.loc[start:end, "position_variance_m2"].max()))
        for name, frame in (("ours", result.replay.steps), ("EKF2's", result.ekf2_variance))
        if isinstance(frame, pd.DataFrame)
    }
    growth = ", ".join(f"{name} to {to:.2g} m" for name, to in largest.items() if np.isfinite(to))
    return (
        f"In the {end - start:.1f} s without measurements from {start:.0f} s on σ grew: {growth}."
    )


def _medians(result: AxisComparison, quantity: Quantity) -> str:
    medians = {name: getattr(one, quantity.sigma) for name, one in filters_by_name(result).items()}
    texts = [
        f"{name} not logged" if median is None else f"{name} {median:.3f} {quantity.unit}"
        for name, median in medians.items()
    ]
    return f"median: {', '.join(texts)}"


POSITION = Panel(
    "Position (m)",
    150.0,
    partial(draw_tracks, quantity=POSITIONS),
    _position_sentence,
    _position_numbers,
)
VELOCITY = Panel(
    "Velocity (m/s)",
    150.0,
    partial(draw_tracks, quantity=VELOCITIES),
    _velocity_sentence,
    _velocity_numbers,
)
ERROR = Panel(
    "Position - {} (m)",
    150.0,
    draw_error,
    _error_sentence,
    lambda result: _error_numbers(result) or _position_numbers(result),
)
INNOVATIONS = Panel(
    "Innovation: measurement - prediction (m)",
    140.0,
    draw_innovations,
    innovation_sentence,
    _innovation_numbers,
)
SIGMA_P = Panel(
    "σ of position (m), log scale",
    80.0,
    partial(_draw_sigma, quantity=POSITIONS),
    sigma_sentence,
    partial(_medians, quantity=POSITIONS),
)
SIGMA_V = Panel(
    "σ of velocity (m/s), log scale",
    60.0,
    partial(_draw_sigma, quantity=VELOCITIES),
    lambda *_: "",
    partial(_medians, quantity=VELOCITIES),
)
