"""No TIMESYNC between sender and autopilot: PX4 takes the time of arrival instead."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found

# ClockMap.method where no exchange of stamps tied the two clocks together
MAPPED_BY_RECEIPT = ("receive time", "position in the stream", "arrival time")


def _detect(analysis: Analysis) -> Found:
    source = analysis.source
    clock = source.clock_map
    if clock is None or clock.distinct_stamps is not None or clock.method not in MAPPED_BY_RECEIPT:
        return
    ours = (
        "Our filter has to do the same, so that its track is late by the age of the positions"
        if clock.method == "arrival time"
        else f"Our filter has the sender's own stamps, mapped by the {clock.method}"
    )
    yield Finding(
        "companion_not_synchronised",
        "warning",
        f"The clock of the sender of {source.name} was never synchronised with the autopilot's "
        "(TIMESYNC): EKF2 took the time at which a position arrived for the time at which it was "
        f"measured. {ours}.",
        "Let the companion answer TIMESYNC (MAVROS does by default; with pymavlink answer every "
        "request), and send the positions after 500 answers, 50 s at 10 Hz.",
        {"jitter_s": clock.jitter_s},
    )


DETECTOR = Detector(
    _detect,
    names={"companion_not_synchronised": "a companion computer without time synchronisation"},
)
