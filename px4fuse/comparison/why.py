"""Why EKF2 differs from our filter, along each horizontal axis, in steps and in words.

The steps are those of :mod:`px4fuse.ekf2.walk`, from our filter as it was set to the logged EKF2.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.arrays import Array
from px4fuse.comparison.asked import tuned_noise_m
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.why_words import Facts, Outside, sentences
from px4fuse.display import Shown
from px4fuse.ekf2.agreement import judged_from, settled
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.walk import WHAT, AxisLine, Coast, OurFilter, Walked, walk
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.record import Span


class WhySteps(Walked, frozen=True, kw_only=True):
    """Why EKF2 differs, along one axis.

    Attributes
    ----------
    spans_s : tuple of (float, float)
        Parts of the flight that the means are over.
    coast : Coast or None
    outside : Outside or None
        None where the walk covers the segment.
    sentences : tuple of str
        What made the difference, in the order of their weight.
    """

    spans_s: tuple[Span, ...]
    coast: Coast | None = None
    outside: Outside | None = None
    sentences: tuple[str, ...]


class Why(Shown, WhySteps, frozen=True, kw_only=True, eq=False):
    """:class:`WhySteps`, with the tracks.

    Attributes
    ----------
    times_s, apart_m, left_m : ndarray
        EKF2's own sample times, and how far our filter and the model are from EKF2's position.
    """

    written_as = WhySteps
    times_s: Array
    apart_m: Array
    left_m: Array


def why_ekf2_differs(
    comparison: Comparison,
    model: Model | Unavailable,
    tuning: Mapping[str, AxisTuning | Unavailable],
    clock: ClockOffset | Unavailable,
) -> dict[str, Why | Unavailable]:
    """Why EKF2 differs along each axis of a comparison.

    Parameters
    ----------
    comparison : Comparison
    model : Model or Unavailable
        Of the comparison's flight.
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
        Tells a measurement noise of EKF2 that is too small.
    clock : ClockOffset or Unavailable
        Tells stamps that are wrong for both filters.

    Returns
    -------
    mapping from axis name to Why or Unavailable
        Of down only where nothing else was compared: the model is of horizontal position.
    """
    results = {r.axis.name: r for r in comparison.axes.values() if r.axis.name != "down"}
    if not results:
        reason = "the model of EKF2 is of horizontal position"
        return {"down": Unavailable(WHAT, reason, "Analyse a horizontal axis too (--axis).")}
    if isinstance(model, Unavailable):
        return {name: Unavailable(WHAT, model.reason, model.remedy) for name in results}
    same_source = comparison.source.name == model.inputs.vision.source
    settings = comparison.settings
    student = OurFilter(
        sigma_a_m_s2=settings.sigma_a_m_s2,
        sigma_z_m=settings.sigma_z_m,
        dt_s=settings.dt_s,
        clock_offset_s=settings.clock_offset_s if same_source else 0.0,
    )
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    lines = {name: _line(result, ekf2) for name, result in results.items()}
    walked = walk(model, student, lines)
    if isinstance(walked, Unavailable):
        return dict.fromkeys(results, walked)
    spans = _spans(model, walked.times_s)
    facts = Facts(comparison, model, walked, tuned_noise_m(tuning) if same_source else None, clock)
    found: dict[str, Why | Unavailable] = {}
    for name, axis in walked.axes.items():
        outside = _outside(results[name], spans)
        found[name] = Why(
            **structs.asdict(axis),
            coast=walked.coast,
            times_s=walked.times_s,
            spans_s=spans,
            outside=outside,
            sentences=sentences(name, axis, facts, outside),
        )
    return found


def _line(result: AxisComparison, ekf2: Ekf2) -> AxisLine:
    """The axis with our track at EKF2's own sample times, exact beside each update's jump."""
    north, east, _ = result.axis.direction
    steps, times = result.replay.steps.index, ekf2.state.index
    times = times[(times >= steps[0]) & (times <= steps[-1])]
    position, velocity = state_at(result.replay, times.to_numpy())
    track = pd.DataFrame({"position_m": position, "velocity_m_s": velocity}, index=times)
    return AxisLine(float(north), float(east), track)


def _spans(model: Model, times: Array) -> tuple[tuple[float, float], ...]:
    """The judged parts of the replay, as far as the walk's times reach."""
    first, last = float(times[0]), float(times[-1])
    return tuple(
        (max(start, first), min(end, last))
        for start, end in judged_from(model.flown)
        if start < last and end > first
    )


def _outside(result: AxisComparison, spans: tuple[tuple[float, float], ...]) -> Outside | None:
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return None
    state = result.ekf2_state[~settled(result.ekf2_state.index.to_numpy(), spans)]
    times = state.index.to_numpy()
    apart = np.abs(state_at(result.replay, times)[0] - state["position_m"].to_numpy())
    if not np.isfinite(apart).any():
        return None
    most = int(np.nanargmax(apart))
    return Outside(float(apart[most]), float(times[most]))
