"""Data missing from the log: EKF2, acceleration, innovations, or positions that PX4 received."""

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTERS, Comparison, FilterName, FilterSummary
from px4fuse.core.text import capitalise_first
from px4fuse.filter.consistency import CONSISTENT_RATIOS, ratio_interval
from px4fuse.findings.model import Findings, note, warning
from px4fuse.flight.model import Ekf2, Unavailable, positions_of
from px4fuse.flight.position_source import RECEIVED

RECEIVED_TOPIC = "vehicle_visual_odometry"
DEFAULT_PROFILE = 1  # SDLOG_PROFILE bit 0, logged_topics.cpp
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
LOGGER_TOLERANCE = 0.25  # of the logging interval; jitter of PX4's logger
# Logging intervals (s) of topics in PX4's default profile (logged_topics.cpp)
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 s in v1.11
}
MIN_INNOVATION_SHARE = 0.75  # of the positions; with fewer logged innovations, verdicts may differ


def detect(analysis: Analysis) -> Findings:
    """Detect data that the log lacks."""
    yield from detect_unavailable_data(analysis)
    yield from detect_source_not_logged(analysis)
    yield from detect_missing_innovations(analysis)


def detect_unavailable_data(analysis: Analysis) -> Findings:
    """Detect a missing EKF2 state, a missing acceleration, and too few innovations."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.lines[0].acceleration
    if isinstance(ekf2, Unavailable):
        reason = capitalise_first(ekf2.reason)
        message = f"The log contains no EKF2 state. {reason}. The report contains KF only."
        yield warning("ekf2_not_logged", message, ekf2.remedy)
    if isinstance(acceleration, Unavailable):
        yield warning(
            "acceleration_not_logged",
            "The acceleration is missing, so KF assumes constant velocity. No "
            f"{acceleration.what}: {acceleration.reason}.",
            acceleration.remedy,
        )
    for result in analysis.axes.values():
        kf_summary = result.filters["kf"]
        if isinstance(kf_summary, Unavailable):
            yield warning(
                "too_few_innovations",
                f"The consistency of KF is not tested: {kf_summary.reason}.",
                kf_summary.remedy,
                {"count": len(result.replay.updates)},
            )
            return


def detect_source_not_logged(analysis: Comparison) -> Findings:
    """Detect missing received positions, and a low logging rate of the topic used instead."""
    source, preference = analysis.source, RECEIVED.preference
    is_logged = any(track.origin.preference == preference for track in analysis.flight.positions)
    if source.origin.has_all_samples or is_logged:
        return
    rate_hz, parameters = source.rate_hz, analysis.flight.log.parameters
    profile = int(parameters.get("SDLOG_PROFILE", DEFAULT_PROFILE))
    reasons = (
        missing_data.reason
        for missing_data in analysis.missing
        if missing_data.source == RECEIVED_TOPIC
    )
    action = f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} (bit 7) and fly again."
    yield warning(
        "source_not_logged",
        f"The log lacks the {positions_of(source)} as PX4 received them. Reason: "
        f"{next(reasons, f'{RECEIVED_TOPIC} is not in this log')}. px4fuse uses {source.name} "
        f"({source.description}) at {rate_hz:.1f} Hz instead.",
        action,
        {"rate_hz": rate_hz, "sdlog_profile": profile},
    )
    if not analysis.axes:  # px4fuse info runs no filter
        return
    for interval in LOGGER_INTERVALS_S.get(source.name, ()):
        is_limited = abs(1.0 / rate_hz / interval - 1.0) < LOGGER_TOLERANCE
        weak = next(
            filter(None, (_weak_verdict(analysis, filter_name) for filter_name in FILTERS)), None
        )
        if is_limited and weak:
            yield note(
                "source_rate_limited_by_logger",
                f"{capitalise_first(positions_of(source))} are logged at only {rate_hz:.1f} Hz, "
                f"{weak}",
                action,
                {"rate_hz": rate_hz, "logger_limit_hz": 1.0 / interval},
            )


def _weak_verdict(analysis: Comparison, filter_name: FilterName) -> str | None:
    """Format a clause if more innovations could change the verdict of a filter, else None.

    They could if there are too few for a verdict, or if the 95 % interval of the σ ratio contains a
    limit of the consistent band.
    """
    summary, limits = analysis.main.filters[filter_name], CONSISTENT_RATIOS["source"]
    filter_label = filter_name.upper()
    if not isinstance(summary, FilterSummary):
        return f"too few to test the consistency of {filter_label}."
    low, high = ratio_interval(summary.nis_mean, summary.nis_band)
    for limit in limits:
        if low <= limit <= high:
            return (
                f"and the verdict of {filter_label} is near its limit. The 95 % interval of "
                f"innovation ÷ √S ({low:.2f} to {high:.2f}) contains the limit {limit:g}."
            )
    return None


def detect_missing_innovations(analysis: Comparison) -> Findings:
    """Detect a log with fewer EKF2 innovations than measurements."""
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
    weak = _weak_verdict(analysis, "ekf2")
    if logged / count < MIN_INNOVATION_SHARE and weak:
        # no setting of PX4's logger records innovations at a higher rate, so there is no action
        yield note(
            "ekf2_innovations_decimated",
            f"Only {logged} of {count} EKF2 innovations are logged, {weak}",
            "",
            {"logged": logged, "measurements": count},
        )
