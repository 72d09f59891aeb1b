"""The sender's time stamps tell no time, or the time of arrival instead of the measurement."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.findings.model import Found, error, finding, warning
from px4fuse.flight import ARRIVAL_METHODS, Ekf2, FusionRecord
from px4fuse.recording import ClockMap

RECEIPT_JITTER_S = 0.010  # 1 cm at 1 m/s, a tenth of a good UWB's noise
ARRIVAL_AGE_S = 0.001  # from receiving a message to publishing it
LATENCY_S = 0.02  # at 1 m/s a fifth of a good UWB's noise
LATENCY_ERROR_S = 0.10  # at 1 m/s a good UWB's noise
MIN_SAMPLES = 10
PURE = 0.95  # of the samples of each part; a late message now and then passes
ANSWER = (
    "Let the companion answer TIMESYNC (MAVROS does by default; with pymavlink answer every "
    "request), and send the positions after 500 answers, 50 s at 10 Hz."
)


def detect(analysis: Analysis) -> Found:
    """By how a recording's stamps were mapped, or by their age in a log of the autopilot."""
    clock = analysis.source.clock_map
    if clock is None:
        yield from arrivals(analysis)
    elif clock.distinct_stamps is not None:
        yield from constant(analysis.source.name, clock, clock.distinct_stamps)
    elif clock.method in ARRIVAL_METHODS:
        ours = f"has the sender's own stamps, mapped by the {clock.method}"
        if clock.method == "arrival time":
            ours = "has to do the same, so that its track is late by the age of the positions"
        yield warning(
            "companion_not_synchronised",
            f"The clock of the sender of {analysis.source.name} was never synchronised with the "
            "autopilot's",
            " (TIMESYNC): EKF2 took the time at which a position arrived for the time at which it "
            f"was measured. Our filter {ours}.",
            ANSWER,
            {"jitter_s": clock.jitter_s},
        )


def constant(name: str, clock: ClockMap, distinct: int) -> Found:
    """They take too few values, and the receipt that stands in for them may jitter."""
    yield error(
        "source_stamps_constant",
        f"The {clock.pairs} time stamps of {name} take only {distinct} "
        f"{'values' if distinct > 1 else 'value'}",
        ": when each position was measured is not known, the time of receipt stands in.",
        "Send the time of measurement in the message (usec, time_usec), in microseconds as an "
        "integer: a 32-bit float cannot hold it.",
        {"stamps": clock.pairs, "distinct": distinct},
    )
    if clock.jitter_s > RECEIPT_JITTER_S:
        yield warning(
            "source_receipt_jitter",
            f"The receipt of {name}, which stands in for its time stamps, jitters by "
            f"{clock.jitter_s * 1e3:.0f} ms",
            f": at 1 m/s that is an error of {clock.jitter_s:.3f} m.",
            "Send the time of measurement in the message, and record close to the sender.",
            {"jitter_s": clock.jitter_s},
        )


def arrivals(analysis: Analysis) -> Found:
    """Stamps are times of arrival, throughout or at first: TIMESYNC had not converged.

    PX4 then stamps a position when it comes (Timesync.cpp). The log shows it without any estimate:
    the age of what is published, time of publication less stamp, is nothing at first and the
    latency later.
    """
    age, name = _age_s(analysis), analysis.source.name
    if age is None:
        return
    cut = until_synchronised(analysis)
    if cut is not None:
        until, latency = cut
        yield finding(
            "error" if latency >= LATENCY_ERROR_S else "warning",
            "source_stamps_of_arrival",
            f"Until {until:.1f} s the stamps of {name} are the times at which it arrived, from "
            f"then on those of the measurement, {latency:.3f} s before it arrives",
            ": the clocks were not synchronised before (PX4 wants 500 TIMESYNC answers). One clock "
            "offset cannot hold for both parts.",
            f"Analyse the rest (px4fuse compare LOG --start {until:.0f}), and let the clocks "
            "synchronise for a minute before take-off.",
            {"until_s": until, "latency_s": latency},
            ((float(age.index[0]), until),),
        )
    elif np.mean(age.abs() < ARRIVAL_AGE_S) >= PURE:
        yield warning(
            "source_stamps_of_arrival",
            f"The stamps of {name} are the times at which it arrived, not those of the measurement",
            ": the sender's clock was never synchronised with the autopilot's (TIMESYNC), and "
            "every position is late by its latency.",
            ANSWER,
            {"until_s": float(age.index[-1])},
        )


def until_synchronised(analysis: Analysis) -> tuple[float, float] | None:
    """When stamps of arrival end, and the latency after that (s); None where there is no such time.

    The cut leaves as few samples as possible on the wrong side.
    """
    age = _age_s(analysis)
    if age is None:
        return None
    arrival = (age.abs() < ARRIVAL_AGE_S).to_numpy()
    wrong: Array = np.cumsum(~arrival) + np.sum(arrival) - np.cumsum(arrival)
    cut = int(np.argmin(wrong)) + 1
    if np.mean(arrival) >= PURE or min(cut, len(age) - cut) < MIN_SAMPLES:
        return None
    latency = float(age.iloc[cut:].median())
    pure = min(np.mean(arrival[:cut]), np.mean(~arrival[cut:])) >= PURE
    return (float(age.index[cut]), latency) if pure and latency >= LATENCY_S else None


def _age_s(analysis: Analysis) -> pd.Series | None:
    """Age of each position as it was published; None where the log does not show it."""
    ekf2, source, segment = analysis.flight.ekf2, analysis.source, analysis.segment
    record = ekf2.record if isinstance(ekf2, Ekf2) else None
    if not isinstance(record, FusionRecord) or source.origin.reconstructed or source.clock_map:
        return None
    age = record.vision_age_s.loc[segment.start_s : segment.end_s]
    return age if len(age) >= 2 * MIN_SAMPLES else None
