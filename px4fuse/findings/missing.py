"""Data that the log lacks: EKF2, acceleration, innovations, or the position as PX4 received it."""

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2_parameters import BAROMETER
from px4fuse.findings.model import Findings, format_percent, note, warning
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.position_source import RECEIVED

RECEIVED_TOPIC = "vehicle_visual_odometry"
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
LOGGER_TOLERANCE = 0.25  # of the interval; jitter of PX4's logger on flights
# s; intervals at which PX4's default profile decimates these topics (logged_topics.cpp)
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 in v1.11
}
NOTHING_TO_SET = "Nothing to set"  # first words of a remedy without an action
MIN_INNOVATION_SHARE = 0.75  # of the source's samples; missing a quarter does not bias the test


def detect(analysis: Analysis) -> Findings:
    """Detect all data that the log lacks."""
    yield from detect_unavailable_data(analysis)
    yield from detect_source_not_logged(analysis)
    yield from detect_missing_innovations(analysis)


def detect_unavailable_data(analysis: Analysis) -> Findings:
    """Detect a missing EKF2 state, a missing acceleration, and too few innovations."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.lines[0].acceleration
    if isinstance(ekf2, Unavailable):
        message = f"The log contains no EKF2 state: {ekf2.reason}. The report contains KF only."
        yield warning("ekf2_not_logged", message, ekf2.remedy)
    if isinstance(acceleration, Unavailable):
        yield warning(
            "acceleration_not_logged",
            f"The acceleration is missing ({acceleration.what}: {acceleration.reason}). KF assumes "
            "constant velocity.",
            acceleration.remedy,
        )
    for result in analysis.axes.values():
        kf_summary = result.filters["kf"]
        if isinstance(kf_summary, Unavailable):
            yield warning(
                "too_few_innovations",
                f"Consistency is not tested: {kf_summary.reason}.",
                kf_summary.remedy,
                {"count": len(result.replay.updates)},
            )
            return


def detect_source_not_logged(analysis: Comparison) -> Findings:
    """Detect that the received positions are not logged, and a low logging rate of their copy."""
    source, preference = analysis.source, RECEIVED.preference
    is_logged = any(track.origin.preference == preference for track in analysis.flight.positions)
    if source.origin.has_all_samples or is_logged:
        return
    rate_hz, profile = source.rate_hz, int(analysis.flight.log.parameters.get("SDLOG_PROFILE", 1))
    reasons = (
        missing_data.reason
        for missing_data in analysis.missing
        if missing_data.source == RECEIVED_TOPIC
    )
    action = f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again."
    yield warning(
        "source_not_logged",
        f"The log lacks {RECEIVED_TOPIC} ({next(reasons, 'it is not in this log')}). px4fuse uses "
        f"{source.name} ({source.description}) at {rate_hz:.1f} Hz instead.",
        action,
        {"rate_hz": rate_hz, "sdlog_profile": profile},
    )
    for interval in LOGGER_INTERVALS_S.get(source.name, ()):
        if abs(1.0 / rate_hz / interval - 1.0) < LOGGER_TOLERANCE:
            yield warning(
                "source_rate_limited_by_logger",
                f"{source.name} is logged at {rate_hz:.1f} Hz, the logger's limit for this topic "
                f"({1.0 / interval:g} Hz). If the source is faster, the log lacks its other "
                "samples.",
                action,
                {"rate_hz": rate_hz, "logger_limit_hz": 1.0 / interval},
            )


def detect_missing_innovations(analysis: Comparison) -> Findings:
    """Detect fewer logged EKF2 innovations than measurements."""
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    counts = (
        (result.axis.name, len(frame))
        for result in axes
        if isinstance(frame := result.ekf2_innovations, pd.DataFrame)
    )
    axis, logged = next(counts, ("", 0))
    # a reconstructed source has as many samples as there are innovations
    if not axis or analysis.source.origin.reconstructed or not isinstance(ekf2, Ekf2):
        return
    count = len(next(iter(axes)).replay.updates)
    if logged / count < MIN_INNOVATION_SHARE:
        is_barometer = analysis.source.aid(axis) == BAROMETER
        topic = (ekf2.aids[BAROMETER.name].topics if is_barometer else ekf2.innovation_topics)[0]
        yield note(
            "ekf2_innovations_decimated",
            f"The log contains {logged} EKF2 innovations for {count} measurements; "
            f"{format_percent(1.0 - logged / count)} are missing. Rejections between logged "
            "samples are not visible.",
            f"{NOTHING_TO_SET}: no profile of PX4's logger records {topic} at a higher rate.",
            {"logged": logged, "measurements": count},
        )
