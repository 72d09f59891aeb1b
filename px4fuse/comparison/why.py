"""Why EKF2 differs from our filter, along each horizontal axis, in steps and in words.

The steps are those of :mod:`px4fuse.ekf2.walk`, from our filter as it was set to the logged EKF2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.comparison.asked import tuned_noise_m
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.why_words import Facts, with_words
from px4fuse.ekf2.agreement import settled
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.replay import Spans
from px4fuse.ekf2.walk import WHAT, Outside, Why, walk
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight import Unavailable


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
        Shows a measurement noise of EKF2 that is too small.
    clock : ClockOffset or Unavailable
        Shows stamps that are wrong for both filters.

    Returns
    -------
    mapping from axis name to Why or Unavailable
        Of down only where nothing else was compared: the model is of horizontal position.
    """
    results = {name: result for name, result in comparison.axes.items() if name != "down"}
    if not results:
        reason = "the model of EKF2 is of horizontal position"
        return {"down": Unavailable(WHAT, reason, "Analyse a horizontal axis too (--axis).")}
    if isinstance(model, Unavailable):
        return {name: Unavailable(WHAT, model.reason, model.remedy) for name in results}
    settings, asked_m = comparison.settings, tuned_noise_m(tuning)
    if comparison.source.name != model.inputs.vision.source:
        settings, asked_m = replace(settings, clock_offset_s=0.0), None
    walked = walk(model, settings, {name: result.replay for name, result in results.items()})
    if isinstance(walked, Unavailable):
        return dict.fromkeys(results, walked)
    certain = clock if isinstance(clock, ClockOffset) and clock.determinable else None
    facts = Facts(comparison, model, asked_m, certain)
    found: dict[str, Why | Unavailable] = {}
    for name, why in walked.items():
        outside = _outside(results[name], why.spans_s)
        found[name] = with_words(name, structs.replace(why, outside=outside), facts)
    return found


def _outside(result: AxisComparison, spans: Spans) -> Outside | None:
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return None
    state = result.ekf2_state[~settled(result.ekf2_state.index, spans)]
    times = state.index.to_numpy()
    apart = np.abs(state_at(result.replay, times)[0] - state["position_m"].to_numpy())
    if not np.isfinite(apart).any():
        return None
    most = int(np.nanargmax(apart))
    return Outside(float(apart[most]), float(times[most]))
