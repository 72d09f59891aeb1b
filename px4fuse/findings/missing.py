"""Detection of missing data: EKF2 state, acceleration, innovations, positions received by PX4."""

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import PreparedComparison
from px4fuse.core.text import capitalise_first
from px4fuse.findings.model import Findings, make_warning
from px4fuse.flight.model import AS_RECEIVED_ORIGIN, Unavailable, positions_phrase

VISION_TOPIC = "vehicle_visual_odometry"
# SDLOG_PROFILE: default value, and mask of bit 7 for external vision (logged_topics.cpp)
DEFAULT_SDLOG_PROFILE, VISION_PROFILE_MASK = 1, 128


def detect(analysis: Analysis) -> Findings:
    yield from detect_unavailable_data(analysis)
    yield from detect_source_not_logged(analysis)


def detect_unavailable_data(analysis: Analysis) -> Findings:
    """Detect a missing EKF2 state, a missing acceleration, and too few innovations."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.input_axes[0].acceleration
    if isinstance(ekf2, Unavailable):
        reason = capitalise_first(ekf2.reason)
        message = f"The log contains no EKF2 state. {reason}. The report contains KF only."
        yield make_warning("ekf2_not_logged", message, ekf2.remedy)
    if isinstance(acceleration, Unavailable):
        yield make_warning(
            "acceleration_not_logged",
            "The acceleration is missing, so KF assumes constant velocity. Missing "
            f"{acceleration.what}: {acceleration.reason}.",
            acceleration.remedy,
        )
    for result in analysis.axes.values():
        kf_summary = result.filters["kf"]
        if isinstance(kf_summary, Unavailable):
            yield make_warning(
                "too_few_innovations",
                f"The consistency of KF is not tested: {kf_summary.reason}.",
                kf_summary.remedy,
                {"count": len(result.replay.updates)},
            )
            return


def detect_source_not_logged(analysis: PreparedComparison) -> Findings:
    """Detect that the log lacks the positions which PX4 received."""
    source, parameters = analysis.source, analysis.flight.log.parameters
    rank_as_received = AS_RECEIVED_ORIGIN.find_preference_rank()
    if source.origin.has_all_samples or any(
        track.origin.find_preference_rank() == rank_as_received
        for track in analysis.flight.positions
    ):
        return
    rate_hz = source.compute_rate_hz()
    sdlog_profile = int(parameters.get("SDLOG_PROFILE", DEFAULT_SDLOG_PROFILE))
    reason_by_source = {item.source: item.reason for item in reversed(analysis.missing)}
    reason = reason_by_source.get(VISION_TOPIC, f"{VISION_TOPIC} is not in this log")
    yield make_warning(
        "source_not_logged",
        f"The log lacks the {positions_phrase(source)} as PX4 received them. Reason: {reason}. "
        f"px4fuse uses {source.name} ({source.description}) at {rate_hz:.1f} Hz instead.",
        f"Set SDLOG_PROFILE to {sdlog_profile | VISION_PROFILE_MASK} (bit 7: vision topics) and "
        "fly again.",
        {"rate_hz": rate_hz, "sdlog_profile": sdlog_profile},
    )
