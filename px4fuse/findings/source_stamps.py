"""The sender's time stamps take so few values that they tell no time."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, Threshold

RECEIPT_JITTER = Threshold(0.010, "s", "1 cm at 1 m/s, a tenth of a good UWB's noise")


def _detect(analysis: Analysis) -> Found:
    source = analysis.source
    clock = source.clock_map
    if clock is None or clock.distinct_stamps is None:
        return
    yield Finding(
        "source_stamps_constant",
        "error",
        f"The {clock.pairs} time stamps of {source.name} take only "
        f"{clock.distinct_stamps} {'values' if clock.distinct_stamps > 1 else 'value'}: when each "
        "position was measured is not known, the time of receipt stands in.",
        "Send the time of measurement in the message (usec, time_usec), in microseconds as an "
        "integer: a 32-bit float cannot hold it.",
        {"stamps": float(clock.pairs), "distinct": float(clock.distinct_stamps)},
    )
    if clock.jitter_s > RECEIPT_JITTER.value:
        yield Finding(
            "source_receipt_jitter",
            "warning",
            f"The receipt of {source.name}, which stands in for its time stamps, jitters by "
            f"{clock.jitter_s * 1e3:.0f} ms: at 1 m/s that is an error of {clock.jitter_s:.3f} m.",
            "Send the time of measurement in the message, and record close to the sender.",
            {"jitter_s": clock.jitter_s},
        )


DETECTOR = Detector(
    _detect,
    names={
        "source_stamps_constant": "position stamps that never change",
        "source_receipt_jitter": "stamps of receipt instead of measurement",
    },
)
