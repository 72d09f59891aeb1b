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
from px4fuse.plain import capital
from px4fuse.report import marks, say, style
from px4fuse.report.page import Page
from px4fuse.report.style import DOTS, LINES, Axes, band, curve, log_ticks
from px4fuse.report.words import filters, verdict_words

NARROW = 72.0  # points: height of the axes in a column of three
# The axes of innovations reach this much beyond 2√S, or beyond 99 % of the innovations if that is
# further, but not beyond so many √S; what lies outside is drawn at the edge and counted
EDGE, LARGEST_SIGMA = 1.3, 5.0


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
    say: Callable[[Analysis, AxisComparison], str]
    numbers: Callable[[AxisComparison], str]

    def named(self, result: AxisComparison) -> str:
        """Its title, with what errors are counted from."""
        return self.title.format("truth" if isinstance(result.truth, pd.DataFrame) else "EKF2")

    def put(
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
        say, height = ("", NARROW) if narrow else (self.say(analysis, result), self.height)
        # rejected innovations are there themselves
        rejected = "" if self is INNOVATIONS else result.axis.name
        axes = marks.panel(
            page, analysis, self.named(result), say, height, axis=rejected, strip=strip, last=last
        )
        if narrow:
            axes.locator_params(axis="x", nbins=4)
        self.draw(axes, result)
        page.numbers(self.numbers(result))


# ------------------------------------------------------------------------------ position, velocity


def draw_tracks(axes: Axes, result: AxisComparison, of: Quantity) -> None:
    """Draw what was measured, both filters with our band, and the truth."""
    if of is POSITIONS:
        measured = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        curve(axes, measured, **style.MEASURED)
    ours = result.replay.steps[of.column]
    band(axes, ours, np.sqrt(result.replay.steps[of.variance]))
    shown = [ours]
    for frame, name in ((result.ekf2_state, "EKF2"), (result.truth, "truth")):
        if isinstance(frame, pd.DataFrame) and frame[of.column].notna().any():
            curve(axes, frame[of.column], **LINES[name], zorder=2.5)
            shown.append(frame[of.column])
    curve(axes, ours, **LINES["ours"])
    # scaled to the tracks, not to the wide band of the first second
    every = pd.concat(shown)
    pad = 0.08 * (every.max() - every.min()) + 1e-3
    axes.set_ylim(every.min() - pad, every.max() + pad)


def error_reference(result: AxisComparison) -> pd.DataFrame | Unavailable:
    """What errors are counted from: the truth, or else EKF2."""
    return result.truth if isinstance(result.truth, pd.DataFrame) else result.ekf2_state


def apart(frame: pd.DataFrame, reference: pd.DataFrame) -> pd.Series[float]:
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
    band(axes, 0.0 * sigma, sigma)
    axes.axhline(0.0, color="black", lw=0.5)
    error = apart(steps, reference)
    highest = [error.abs().max(), 2.2 * sigma.median()]
    if reference is result.truth and isinstance(result.ekf2_state, pd.DataFrame):
        theirs = apart(result.ekf2_state, reference)
        curve(axes, theirs, **LINES["EKF2"], zorder=2.5)
        highest.append(theirs.abs().max())
    curve(axes, error, **LINES["ours"])
    axes.set_ylim(-1.1 * max(highest), 1.1 * max(highest))


def _position_words(_: Analysis, result: AxisComparison) -> str:
    travelled = float(np.ptp(result.axis.measurement_m))
    words = f"{len(result.replay.updates)} measurements over {travelled:.3g} m"
    if isinstance(result.ekf2_state, Unavailable) or isinstance(result.difference, Unavailable):
        return f"{words}; our filter follows them."
    distance = apart(result.ekf2_state, result.replay.steps).abs()
    return say("farthest", words=words, most_m=distance.max(), at_s=distance.idxmax())


def _velocity_words(_: Analysis, result: AxisComparison) -> str:
    words = "Never measured: each filter infers it from positions and IMU."
    return f"{words} {nearer(result, VELOCITIES)}".rstrip()


def _error_words(_: Analysis, result: AxisComparison) -> str:
    share = inside_share(result)
    if isinstance(result.truth, pd.DataFrame):
        said = f"{share:.0%} of our error lies in our own ±2σ (blue), where 95% should."
        return f"{nearer(result, POSITIONS)} {said}".lstrip()
    return say("no_truth", share=share)


def nearer(result: AxisComparison, of: Quantity) -> str:
    """Which filter is nearer to the truth, by root mean square; empty where one is not known."""
    errors = _errors(result, of)
    if len(errors) < 2:
        return ""
    (low, first), (high, second) = sorted((error, name) for name, error in errors.items())
    if high < 1.1 * low:
        return "Ours and EKF2 are equally near to the truth."
    return f"{capital(first)} is {high / low:.2g} times nearer to the truth than {second}."


def inside_share(result: AxisComparison) -> float:
    """Share of our errors, or differences to EKF2, inside our own ±2σ."""
    reference, steps = error_reference(result), result.replay.steps
    assert isinstance(reference, pd.DataFrame)
    error = apart(steps, reference)
    return float((error.abs() <= 2.0 * np.sqrt(steps["position_variance_m2"])[error.index]).mean())


def _errors(result: AxisComparison, of: Quantity) -> dict[str, float]:
    """RMSE to the truth of each filter that has one."""
    found = {name: getattr(one.truth, of.rmse, None) for name, one in filters(result).items()}
    return {name: error for name, error in found.items() if error is not None}


def _error_numbers(result: AxisComparison, of: Quantity = POSITIONS) -> str:
    errors = ", ".join(f"{name} {error:.3f}" for name, error in _errors(result, of).items())
    return f"RMS to truth ({of.unit}): {errors}" if errors else ""


def _position_numbers(result: AxisComparison) -> str:
    part = result.difference
    if isinstance(part, Unavailable):
        return f"{part.what}: {part.reason}"
    return say("apart", part=part)


def _velocity_numbers(result: AxisComparison) -> str:
    said = [_error_numbers(result, VELOCITIES)]
    if isinstance(result.difference, Difference):
        said.append(f"ours - EKF2: RMS {result.difference.velocity_rmse_m_s:.3f} m/s")
    return "; ".join(filter(None, said))


# ---------------------------------------------------------------------------------- innovations, σ


def _limit(result: AxisComparison) -> float:
    """Half height of the axes: neither outliers nor a gap may flatten all the rest."""
    limits = []
    for frame in (result.replay.updates, result.ekf2_innovations):
        if isinstance(frame, pd.DataFrame):
            typical = float(np.sqrt(frame["innovation_variance_m2"].median()))
            usual = float(np.quantile(frame["innovation_m"].abs(), 0.99))
            limits.append(max(2.0 * typical, min(usual, LARGEST_SIGMA * typical)))
    return EDGE * max(limits)


def draw_innovations(axes: Axes, result: AxisComparison) -> None:
    """Draw innovations of both filters with ±2√S; what EKF2 rejected is hollow."""
    edge, updates, frame = _limit(result), result.replay.updates, result.ekf2_innovations
    ours = updates["innovation_m"]
    band(axes, 0.0 * ours, np.sqrt(updates["innovation_variance_m2"]))
    axes.axhline(0.0, color="black", lw=0.5)
    dots = [(ours, DOTS["ours"])]
    if isinstance(frame, pd.DataFrame):
        two_sigma = 2.0 * np.sqrt(frame["innovation_variance_m2"])
        for side in (two_sigma, -two_sigma):
            curve(axes, side, **LINES["EKF2"])
        rejected = frame["rejected"] > 0
        theirs = frame["innovation_m"]
        dots = [(theirs[~rejected], DOTS["EKF2"]), (theirs[rejected], style.EKF2_REJECTED), *dots]
    for values, look in dots:
        curve(axes, values[values.abs() <= edge], **look)
        for sign, marker in ((1.0, "^"), (-1.0, "v")):
            beyond = values.index[sign * values > edge]  # shown at the edge
            there: dict[str, Any] = {**look, "marker": marker, "ms": 3.2, "clip_on": False}
            if len(beyond):
                axes.plot(beyond, np.full(len(beyond), sign * 0.96 * edge), **there)
    axes.set_ylim(-edge, edge)


def innovation_words(_: Analysis, result: AxisComparison) -> str:
    """What to see in the innovations."""
    said = []
    for name, one in filters(result).items():
        if isinstance(one, Unavailable):
            said.append(f"{capital(name)}: {one.reason}.")
        else:
            said.append(say("outside", who=capital(name), one=one, verdict=verdict_words(one)))
    if isinstance(result.ekf2_state, Unavailable):
        said.append(f"EKF2: {result.ekf2_state.reason}.")
    elif isinstance(result.ekf2_innovations, pd.DataFrame):
        count = int((result.ekf2_innovations["rejected"] > 0).sum())
        said += [f"It rejected {count} of them (hollow)."] if count else []
    return " ".join(said)


def _innovation_numbers(result: AxisComparison) -> str:
    edge, said = _limit(result), []
    frames = {"ours": result.replay.updates, "EKF2": result.ekf2_innovations}
    for name, one in filters(result).items():
        frame = frames[name]
        if isinstance(one, Consistency) and isinstance(frame, pd.DataFrame):
            beyond = int((frame["innovation_m"].abs() > edge).sum())
            said.append(
                say("innovations", name=name, one=one)
                + (f", {beyond} beyond the axis (triangles)" if beyond else "")
            )
    return "; ".join(said)


def _draw_sigma(axes: Axes, result: AxisComparison, of: Quantity) -> None:
    for frame, name in ((result.replay.steps, "ours"), (result.ekf2_variance, "EKF2")):
        if isinstance(frame, pd.DataFrame):
            curve(axes, np.sqrt(frame[of.variance]), **LINES[name])
    log_ticks(axes)


def sigma_words(analysis: Analysis, result: AxisComparison) -> str:
    """By how much σ grows in the longest gap of the source; empty where there is none."""
    if not analysis.events.gaps:
        return ""
    start, end = max(analysis.events.gaps, key=lambda gap: gap[1] - gap[0])
    largest = {
        name: float(np.sqrt(frame.loc[start:end, "position_variance_m2"].max()))
        for name, frame in (("ours", result.replay.steps), ("EKF2's", result.ekf2_variance))
        if isinstance(frame, pd.DataFrame)
    }
    grown = ", ".join(f"{name} to {to:.2g} m" for name, to in largest.items() if np.isfinite(to))
    return f"In the {end - start:.1f} s without measurements from {start:.0f} s on σ grew: {grown}."


def _medians(result: AxisComparison, of: Quantity) -> str:
    medians = {name: getattr(one, of.sigma) for name, one in filters(result).items()}
    said = [
        f"{name} not logged" if median is None else f"{name} {median:.3f} {of.unit}"
        for name, median in medians.items()
    ]
    return f"median: {', '.join(said)}"


POSITION = Panel(
    "Position (m)", 150.0, partial(draw_tracks, of=POSITIONS), _position_words, _position_numbers
)
VELOCITY = Panel(
    "Velocity (m/s)", 150.0, partial(draw_tracks, of=VELOCITIES), _velocity_words, _velocity_numbers
)
ERROR = Panel(
    "Position - {} (m)",
    150.0,
    draw_error,
    _error_words,
    lambda result: _error_numbers(result) or _position_numbers(result),
)
INNOVATIONS = Panel(
    "Innovation: measurement - prediction (m)",
    140.0,
    draw_innovations,
    innovation_words,
    _innovation_numbers,
)
SIGMA_P = Panel(
    "σ of position (m), log scale",
    80.0,
    partial(_draw_sigma, of=POSITIONS),
    sigma_words,
    partial(_medians, of=POSITIONS),
)
SIGMA_V = Panel(
    "σ of velocity (m/s), log scale",
    60.0,
    partial(_draw_sigma, of=VELOCITIES),
    lambda *_: "",
    partial(_medians, of=VELOCITIES),
)
