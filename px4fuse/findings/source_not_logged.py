"""The position source as it arrived is not in the log."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.origin import RECEIVED

VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
LOGGER_INTERVAL_TOLERANCE = Threshold(
    0.25, "of the interval", "jitter of PX4's logger seen in flights"
)
# Intervals (s) at which PX4's default profile thins these topics, logged_topics.cpp
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 in v1.11
}


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    source = comparison.source
    logged = any(
        track.origin.preference == RECEIVED.preference for track in comparison.flight.positions
    )
    if source.origin.as_sent or logged:
        return
    profile = int(comparison.flight.log.parameters.get("SDLOG_PROFILE", 1))
    wanted = "vehicle_visual_odometry"
    reasons = (part.reason for part in comparison.missing if part.source == wanted)
    why = next(reasons, "it is not in this log")
    remedy = f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again."
    yield Finding(
        "source_not_logged",
        "warning",
        f"The log lacks vehicle_visual_odometry, the position as it arrived ({why}); "
        f"{source.name} ({source.description}) stands in for it at {source.rate_hz:.1f} Hz.",
        remedy,
        {"rate_hz": source.rate_hz, "sdlog_profile": float(profile)},
    )
    for interval in LOGGER_INTERVALS_S.get(source.name, ()):
        if abs(1.0 / source.rate_hz / interval - 1.0) < LOGGER_INTERVAL_TOLERANCE.value:
            yield Finding(
                "source_decimated",
                "warning",
                f"{source.name} is logged at {source.rate_hz:.1f} Hz, the logger's own limit for "
                f"it ({1 / interval:g} Hz): the source may have run faster, the samples between "
                "are lost.",
                remedy,
                {"rate_hz": source.rate_hz, "logger_limit_hz": 1.0 / interval},
            )


DETECTOR = Detector(
    _detect,
    names={
        "source_not_logged": "a position source that was not logged",
        "source_decimated": "positions logged too slowly",
    },
)
