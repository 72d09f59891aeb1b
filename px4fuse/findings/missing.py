"""What the log lacks: EKF2, an acceleration, innovations, the position as it arrived."""

from typing import Any

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2_parameters import BAROMETER
from px4fuse.findings.model import Found, info, warning
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.origin import RECEIVED

WANTED_TOPIC = "vehicle_visual_odometry"
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
LOGGER_TOLERANCE = 0.25  # of the interval: jitter of PX4's logger seen in flights
# Intervals (s) at which PX4's default profile thins these topics, logged_topics.cpp
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 in v1.11
}
MIN_INNOVATION_SHARE = 0.75  # of the source's samples: a quarter lost biases nothing yet


def detect(analysis: Analysis) -> Found:
    """All of them."""
    yield from unavailable(analysis)
    yield from source_as_sent(analysis)
    yield from innovations(analysis)


def unavailable(analysis: Analysis) -> Found:
    """The report has to do without, with the reason and the remedy that stand in its place."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.lines[0].acceleration
    if isinstance(ekf2, Unavailable):
        yield warning("ekf2_unavailable", lacking=ekf2, remedy=ekf2.remedy)
    if isinstance(acceleration, Unavailable):
        yield warning("input_unavailable", lacking=acceleration, remedy=acceleration.remedy)
    for result in analysis.axes.values():
        kf_summary = result.filters["kf"]
        if isinstance(kf_summary, Unavailable):
            count = {"count": len(result.replay.updates)}
            yield warning(
                "too_few_innovations", count, lacking=kf_summary, remedy=kf_summary.remedy
            )
            return


def source_as_sent(analysis: Comparison) -> Found:
    """The position as it arrived is not in the log: what stands in, and whether that is thinned."""
    source, received = analysis.source, RECEIVED.preference
    logged = any(track.origin.preference == received for track in analysis.flight.positions)
    if source.origin.has_all_samples or logged:
        return
    rate_hz, profile = source.rate_hz, int(analysis.flight.log.parameters.get("SDLOG_PROFILE", 1))
    reasons = (part.reason for part in analysis.missing if part.source == WANTED_TOPIC)
    facts: dict[str, Any] = {"source": source, "asked": profile | VISION_PROFILE_BIT}
    yield warning(
        "source_not_logged",
        {"rate_hz": rate_hz, "sdlog_profile": profile},
        reason=next(reasons, "it is not in this log"),
        **facts,
    )
    for interval in LOGGER_INTERVALS_S.get(source.name, ()):
        if abs(1.0 / rate_hz / interval - 1.0) < LOGGER_TOLERANCE:
            evidence = {"rate_hz": rate_hz, "logger_limit_hz": 1.0 / interval}
            yield warning("source_decimated", evidence, **facts)


def innovations(analysis: Comparison) -> Found:
    """Too few innovations of EKF2 for the measurements, which are not made of them."""
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    found = (
        (result.axis.name, len(frame))
        for result in axes
        if isinstance(frame := result.ekf2_innovations, pd.DataFrame)
    )
    axis, logged = next(found, ("", 0))
    if not axis or analysis.source.origin.reconstructed or not isinstance(ekf2, Ekf2):
        return
    count = len(next(iter(axes)).replay.updates)
    if logged / count < MIN_INNOVATION_SHARE:
        is_barometer = analysis.source.aid(axis) == BAROMETER
        topic = (ekf2.aids[BAROMETER.name].topics if is_barometer else ekf2.innovation_topics)[0]
        evidence = {"logged": logged, "measurements": count}
        lost = 1 - logged / count
        yield info("ekf2_innovations_decimated", evidence, topic=topic, lost=lost)
