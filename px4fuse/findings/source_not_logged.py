"""The position source as it arrived is not in the log."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, warning
from px4fuse.origin import RECEIVED

WANTED = "vehicle_visual_odometry"
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
LOGGER_TOLERANCE = 0.25  # of the interval: jitter of PX4's logger seen in flights
# Intervals (s) at which PX4's default profile thins these topics, logged_topics.cpp
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 in v1.11
}


def detect(analysis: Analysis) -> Found:
    """What stands in for it, and whether the logger thinned that."""
    source, received = analysis.source, RECEIVED.preference
    logged = any(track.origin.preference == received for track in analysis.flight.positions)
    if source.origin.as_sent or logged:
        return
    name, rate_hz = source.name, source.rate_hz
    profile = int(analysis.flight.log.parameters.get("SDLOG_PROFILE", 1))
    reasons = (part.reason for part in analysis.missing if part.source == WANTED)
    remedy = f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again."
    yield warning(
        "source_not_logged",
        f"The log lacks {WANTED}, the position as it arrived",
        f" ({next(reasons, 'it is not in this log')}); {name} ({source.description}) stands in "
        f"for it at {rate_hz:.1f} Hz.",
        remedy,
        {"rate_hz": rate_hz, "sdlog_profile": profile},
    )
    for interval in LOGGER_INTERVALS_S.get(name, ()):
        if abs(1.0 / rate_hz / interval - 1.0) < LOGGER_TOLERANCE:
            yield warning(
                "source_decimated",
                f"{name} is logged at {rate_hz:.1f} Hz, the logger's own limit for it",
                f" ({1 / interval:g} Hz): the source may have run faster, the samples between are "
                "lost.",
                remedy,
                {"rate_hz": rate_hz, "logger_limit_hz": 1.0 / interval},
            )
