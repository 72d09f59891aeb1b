"""The sender's time stamps tell no time, or the time of arrival instead of the measurement."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.findings.model import Found, error, warning
from px4fuse.flight import ARRIVAL_METHODS, Ekf2, FusionRecord
from px4fuse.recording import ClockMap

RECEIPT_JITTER_S = 0.010  # 1 cm at 1 m/s, a tenth of a good UWB's noise
ARRIVAL_AGE_S = 0.001  # from receiving a message to publishing it
LATENCY_S = 0.02  # at 1 m/s a fifth of a good UWB's noise
LATENCY_ERROR_S = 0.10  # at 1 m/s a good UWB's noise
MIN_SAMPLES = 10
MIN_PURE_SHARE = 0.95  # of the samples of each part; a late message now and then passes


def detect(analysis: Analysis) -> Found:
    """By how a recording's stamps were mapped, or by their age in a log of the autopilot."""
    clock = analysis.source.clock_map
    if clock is None:
        yield from arrivals(analysis)
    elif clock.distinct_stamps is not None:
        yield from constant(analysis.source.name, clock, clock.distinct_stamps)
    elif clock.method in ARRIVAL_METHODS:
        yield warning(
            "companion_not_synchronised",
            {"jitter_s": clock.jitter_s},
            source=analysis.source.name,
            method=clock.method,
            own=clock.method != "arrival time",
        )


def constant(name: str, clock: ClockMap, distinct: int) -> Found:
    """They take too few values, and the receipt that stands in for them may jitter."""
    evidence = {"stamps": clock.pairs, "distinct": distinct}
    yield error("source_stamps_constant", evidence, source=name, values=distinct > 1)
    if (jitter_s := clock.jitter_s) > RECEIPT_JITTER_S:
        jitter_ms = jitter_s * 1e3
        yield warning(
            "source_receipt_jitter", {"jitter_s": jitter_s}, source=name, jitter_ms=jitter_ms
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
        make_finding = error if latency >= LATENCY_ERROR_S else warning
        evidence, spans = {"until_s": until, "latency_s": latency}, ((float(age.index[0]), until),)
        yield make_finding("source_stamps_of_arrival", evidence, spans, source=name, case=True)
    elif np.mean(age.abs() < ARRIVAL_AGE_S) >= MIN_PURE_SHARE:
        evidence = {"until_s": float(age.index[-1])}
        yield warning("source_stamps_of_arrival", evidence, source=name, case=False)


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
    if np.mean(arrival) >= MIN_PURE_SHARE or min(cut, len(age) - cut) < MIN_SAMPLES:
        return None
    latency = float(age.iloc[cut:].median())
    pure = min(np.mean(arrival[:cut]), np.mean(~arrival[cut:])) >= MIN_PURE_SHARE
    return (float(age.index[cut]), latency) if pure and latency >= LATENCY_S else None


def _age_s(analysis: Analysis) -> pd.Series | None:
    """Age of each position as it was published; None where the log does not show it."""
    ekf2, source, segment = analysis.flight.ekf2, analysis.source, analysis.segment
    record = ekf2.record if isinstance(ekf2, Ekf2) else None
    if not isinstance(record, FusionRecord) or source.origin.reconstructed or source.clock_map:
        return None
    age = record.vision_age_s.loc[segment.start_s : segment.end_s]
    return age if len(age) >= 2 * MIN_SAMPLES else None
