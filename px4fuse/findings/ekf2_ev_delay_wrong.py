"""EKF2_EV_DELAY is not the delay that the data have."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import delay_change, delay_helps, remedy_words
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.clock import ClockOffset
from px4fuse.findings.model import Found, warning
from px4fuse.findings.source_clock import OFFSET_S
from px4fuse.flight import Unavailable

EKF2_UPDATE_S = 0.010  # EKF2_PREDICT_US, EKF2's own step
AT_THE_SENDER = "Correct the stamps at the sender:"


def delay_remedy(analysis: Analysis, delay_ms: float, flown_ms: float) -> str:
    """EKF2_EV_DELAY as the data ask for it, as far as PX4's range and a replay allow."""
    model, most_ms = analysis.ekf2_model, PARAMETERS["EKF2_EV_DELAY"].maximum
    if delay_ms > most_ms:
        return f"{AT_THE_SENDER} PX4 allows {most_ms:g} ms (EKF2_EV_DELAY)."
    if round(delay_ms) <= 0.0 and flown_ms == 0.0:
        return f"{AT_THE_SENDER} EKF2 has no parameter for stamps that are early."
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), 0.0)}
    if not isinstance(model, Unavailable):
        changes = delay_change(model, delay_ms) or changes
    words, _ = remedy_words(model, changes, delay_helps, otherwise=AT_THE_SENDER)
    return words


def detect(analysis: Analysis) -> Found:
    """The delay lies outside what the clock offset and EKF2's step leave open."""
    clock, delay_ms = analysis.clock, analysis.flight.log.parameters.get("EKF2_EV_DELAY")
    if not isinstance(clock, ClockOffset) or analysis.source.origin.reconstructed:
        return
    asked_ms = -1e3 * clock.offset_s
    if not clock.determinable or delay_ms is None:
        return
    if abs(delay_ms - asked_ms) < 1e3 * max(clock.chance_s + EKF2_UPDATE_S, OFFSET_S):
        return
    low_ms, high_ms = (-1e3 * end for end in reversed(clock.interval_s))
    asked, more = f"the data ask for {round(asked_ms)} ms", ""
    ends = f"{round(low_ms)} to {round(high_ms)}"
    if asked_ms < 0.0:
        asked = f"the stamps are early by {round(-asked_ms)} ms"
        ends, more = f"{round(-high_ms)} to {round(-low_ms)}", ", for which there is no delay"
    yield warning(
        "ekf2_ev_delay_wrong",
        f"EKF2_EV_DELAY is {delay_ms:g} ms, while {asked}",
        f" (95 % {ends}){more}: EKF2 fuses each position at the wrong time, and its track lags or "
        "leads by the difference.",
        delay_remedy(analysis, 0.0 if low_ms <= 0.0 else asked_ms, delay_ms),
        {"ekf2_ev_delay_ms": delay_ms, "asked_ms": asked_ms},
    )
