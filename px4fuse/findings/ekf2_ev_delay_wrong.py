"""EKF2_EV_DELAY is not the delay that the data have."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import delay_change, delay_helps, remedy_words
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.clock import ClockOffset
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_clock import CLOCK_OFFSET
from px4fuse.flight import Unavailable

EKF2_UPDATE = Threshold(0.010, "s", "EKF2_PREDICT_US, EKF2's own step")


def delay_remedy(analysis: Analysis, delay_ms: float, flown_ms: float) -> str:
    """EKF2_EV_DELAY as the data ask for it, as far as PX4's range and a replay allow."""
    model = analysis.ekf2_model
    known = PARAMETERS["EKF2_EV_DELAY"]
    if delay_ms > known.maximum:
        return f"Correct the stamps at the sender: PX4 allows {known.maximum:g} ms (EKF2_EV_DELAY)."
    if round(delay_ms) <= 0.0 and flown_ms == 0.0:
        return "Correct the stamps at the sender: EKF2 has no parameter for stamps that are early."
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), 0.0)}
    if not isinstance(model, Unavailable):
        changes = delay_change(model, delay_ms) or changes
    return remedy_words(
        analysis.ekf2_model, changes, delay_helps, otherwise="Correct the stamps at the sender:"
    )


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    clock = analysis.clock
    delay = comparison.flight.log.parameters.get("EKF2_EV_DELAY")
    if not isinstance(clock, ClockOffset) or comparison.source.origin.reconstructed:
        return
    if not clock.determinable or delay is None:
        return
    asked = -np.array([clock.interval_s[1], clock.interval_s[0]])
    best = -clock.offset_s
    apart = abs(delay * 1e-3 - best)
    if apart < max(clock.chance_s + EKF2_UPDATE.value, CLOCK_OFFSET.value):
        return
    low_ms, high_ms = asked * 1e3
    found = (
        f"the data ask for {round(best * 1e3)} ms (95 % {round(low_ms)} to {round(high_ms)})"
        if best >= 0.0
        else f"the stamps are early by {round(-best * 1e3)} ms (95 % {round(-high_ms)} to "
        f"{round(-low_ms)}), for which there is no delay"
    )
    yield Finding(
        "ekf2_ev_delay_wrong",
        "warning",
        f"EKF2_EV_DELAY is {delay:g} ms, while {found}: EKF2 fuses each position at the wrong "
        "time, and its track lags or leads by the difference.",
        delay_remedy(analysis, 0.0 if asked[0] <= 0.0 else best * 1e3, delay),
        {"ekf2_ev_delay_ms": delay, "asked_ms": best * 1e3},
    )


DETECTOR = Detector(
    _detect,
    {"ekf2_ev_delay_wrong": tuple(f"--mistake ekf2-delay={ms}ms" for ms in (120, 150, 175))},
    names={"ekf2_ev_delay_wrong": "a delay set in EKF2 that is not that of the positions"},
)
