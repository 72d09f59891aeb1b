"""Stamps are times of arrival, throughout or at first: TIMESYNC had not converged.

PX4 then stamps a position when it comes (Timesync.cpp). The log shows it without any estimate: the
age of what is published, time of publication less stamp, is nothing at first and the latency later.
"""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.flight import Ekf2, FusionRecord

ARRIVAL_AGE = Threshold(0.001, "s", "from receiving a message to publishing it")
LATENCY = Threshold(0.02, "s", "at 1 m/s a fifth of a good UWB's noise")
LATENCY_ERROR = Threshold(0.10, "s", "at 1 m/s a good UWB's noise")
MIN_SAMPLES = 10
PURE = Threshold(0.95, "of the samples of each part", "a late message now and then passes")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    ekf2, source = comparison.flight.ekf2, comparison.source
    record = ekf2.record if isinstance(ekf2, Ekf2) else None
    if (
        not isinstance(record, FusionRecord)
        or source.origin.reconstructed
        or source.clock_map is not None
    ):
        return
    segment = comparison.segment
    age = record.vision_age_s.loc[segment.start_s : segment.end_s]
    arrival = (age.abs() < ARRIVAL_AGE.value).to_numpy()
    if len(age) < 2 * MIN_SAMPLES:
        return
    if np.mean(arrival) >= PURE.value:
        yield Finding(
            "source_stamps_of_arrival",
            "warning",
            f"The stamps of {source.name} are the times at which it arrived, not those of the "
            "measurement: the sender's clock was never synchronised with the autopilot's "
            "(TIMESYNC), and every position is late by its latency.",
            "Let the companion answer TIMESYNC (MAVROS does by default; with pymavlink answer "
            "every request), and send the positions after 500 answers, 50 s at 10 Hz.",
            {"until_s": float(age.index[-1])},
        )
        return
    # the cut that leaves as few as possible on the wrong side
    wrong: Array = np.cumsum(~arrival) + np.sum(arrival) - np.cumsum(arrival)
    cut = int(np.argmin(wrong)) + 1
    if min(cut, len(age) - cut) < MIN_SAMPLES:
        return
    if min(np.mean(arrival[:cut]), np.mean(~arrival[cut:])) < PURE.value:
        return
    latency, until = float(age.iloc[cut:].median()), float(age.index[cut])
    if latency < LATENCY.value:
        return
    yield Finding(
        "source_stamps_of_arrival",
        "error" if latency >= LATENCY_ERROR.value else "warning",
        f"Until {until:.1f} s the stamps of {source.name} are the times at which it arrived, from "
        f"then on those of the measurement, {latency:.3f} s before it arrives: the clocks were not "
        "synchronised before (PX4 wants 500 TIMESYNC answers). One clock offset cannot hold for "
        "both parts.",
        f"Analyse the rest (px4fuse compare LOG --start {until:.0f}), and let the clocks "
        "synchronise for a minute before take-off.",
        {"until_s": until, "latency_s": latency},
        spans_s=((float(age.index[0]), until),),
    )


def stamps_of_arrival_end_s(analysis: Analysis) -> float | None:
    """When the stamps of arrival end (s), None where there are none or nothing else."""
    found = (finding.evidence for finding in _detect(analysis))
    return next((float(one["until_s"]) for one in found if "latency_s" in one), None)


DETECTOR = Detector(
    _detect,
    {"source_stamps_of_arrival": tuple(f"--mistake clock-jump={ms}ms" for ms in (50, 150, 300))},
    names={
        "source_stamps_of_arrival": "position stamps that are times of arrival until the clocks "
        "agree",
    },
)
