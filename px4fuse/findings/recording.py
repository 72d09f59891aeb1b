"""Faults of the log: missing data, autopilot restarts, clock jumps, another estimator than EKF2."""

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import PreparedComparison
from px4fuse.core.text import capitalise_first_letter, format_number
from px4fuse.ekf2.inputs import SIMULATED_EKF2_NOTE
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    FASTER_LOGGING_ACTION,
    Ekf2,
    Flight,
    Unavailable,
)

from .model import Findings, format_occurrences, make_note, make_warning

VISION_TOPIC = "vehicle_visual_odometry"
# SDLOG_PROFILE: default value, and mask of bit 7 for external vision (logged_topics.cpp)
DEFAULT_SDLOG_PROFILE, VISION_PROFILE_MASK = 1, 128


def detect(analysis: Analysis) -> Findings:
    yield from detect_dropouts(analysis)
    yield from detect_lost_data(analysis.flight)
    yield from detect_backward_clock_jumps(analysis.flight)
    yield from detect_other_estimators(analysis)
    yield from detect_unavailable_data(analysis)
    yield from detect_source_not_logged(analysis)


def detect_dropouts(analysis: PreparedComparison) -> Findings:
    """Detect dropouts of PX4's logger in the analysed time."""
    spans = tuple(
        (dropout.start_s, end_s)
        for dropout in analysis.flight.log.dropouts
        if dropout.start_s <= analysis.segment.end_s
        and (end_s := dropout.start_s + dropout.duration_s) >= analysis.segment.start_s
    )
    if spans:
        durations_s = [end - start for start, end in spans]
        yield make_warning(
            "logger_dropouts",
            f"The logger lost {sum(durations_s):.2f} s of data. Number of dropouts: {len(spans)}, "
            f"longest dropout: {max(durations_s):.2f} s.",
            FASTER_LOGGING_ACTION,
            {"count": len(spans), "total_s": sum(durations_s)},
            spans,
        )


def detect_lost_data(flight: Flight) -> Findings:
    """Detect unreadable bytes, a log that ends in flight, and wrong timestamps."""
    log = flight.log
    lost_bytes = log.bytes - log.bytes_read
    evidence = {"lost_bytes": lost_bytes, "ends_in_flight": float(log.ends_in_flight)}
    if log.damage:
        damage_text = "the log is damaged"
        if log.bytes and lost_bytes:
            lost_percent_text = format_number(100.0 * lost_bytes / log.bytes, 2)
            damage_text += f": px4fuse cannot read {lost_percent_text} % of its bytes"
        # A file name at the start of a note keeps its case
        notes = (
            note if "." in note.split(" ", 1)[0] else capitalise_first_letter(note)
            for note in (damage_text, *log.damage)
        )
        message = f"{'. '.join(notes)}."
        action = "Copy the log again. If this does not help, replace the SD card."
        if log.format.startswith("MAVLink"):
            action = "Record on a link without loss: by cable, or on the companion computer."
        yield make_warning("log_damaged", message, action, evidence)
    elif log.ends_in_flight:
        yield make_note(
            "log_damaged",
            f"The log ends in flight after {log.duration_s:.1f} s. The landing is missing.",
            "Stop logging only after landing. If the file is incomplete, copy the file again.",
            evidence,
        )
    if log.dropped:
        topic = next(iter(log.dropped))
        yield make_note(
            "samples_out_of_order",
            f"{log.dropped[topic]} samples of the topic {topic} have wrong timestamps: zero, or "
            "earlier than the previous timestamp. Possible cause: a clock was set back, or "
            "messages arrived in another order.",
            "Synchronise the clock of the sending computer before take-off (TIMESYNC).",
            {"notes": len(log.dropped)},
        )


def detect_backward_clock_jumps(flight: Flight) -> Findings:
    """Detect a boot clock (restart of the autopilot) or receive times that jump back."""
    log = flight.log
    if log.restarts:
        yield make_warning(
            "autopilot_restarted",
            f"The autopilot's boot clock restarted {format_occurrences(log.restarts)}. px4fuse "
            "reads only the longest recording.",
            "Record each flight in a separate file.",
            {"count": log.restarts},
        )
    if reversals := log.receive_time_reversals:
        yield make_note(
            "receive_time_went_back",
            f"The recorded receive time decreased {format_occurrences(reversals)}. Possible cause: "
            "the clock of the recording computer was set back, or the file consists of several "
            "recordings.",
            "Do not synchronise the clock of the recording computer while recording.",
            {"count": reversals},
        )


def detect_other_estimators(analysis: Analysis) -> Findings:
    """Detect estimates that are not from PX4's EKF2, and MAVLink logs, which lack innovations."""
    log, ekf2 = analysis.flight.log, analysis.flight.ekf2
    if SIMULATED_EKF2_NOTE in log.notes:
        yield make_note(
            "ekf2_simulated",
            "This log is simulated: px4fuse's own model of EKF2 computed the EKF2 estimates, not "
            "PX4's code.",
            "To assess PX4's EKF2, analyse a real flight.",
        )
    if not isinstance(ekf2, Ekf2):
        return
    if log.autopilot != "PX4":
        yield make_note(
            "not_px4",
            f"This log is from {log.autopilot}, not PX4, so the report contains no PX4 parameters.",
            f'In this report, "EKF2" stands for the estimator of {log.autopilot}.',
            {"autopilot": log.autopilot},
        )
    if log.format.startswith("MAVLink"):
        contents = "states and variances" if isinstance(ekf2.variance, pd.DataFrame) else "states"
        action = "Give the ULog of this flight as argument LOG."
        if not log.writes_ulog:
            action = "The innovations are in the DataFlash log (.BIN), which px4fuse does not read."
        yield make_note(
            "innovations_need_ulog",
            f"A MAVLink recording contains the {contents} of EKF2, but no innovations. The "
            "consistency of EKF2 cannot be tested.",
            action,
        )


def detect_unavailable_data(analysis: Analysis) -> Findings:
    """Detect a missing EKF2 state, a missing acceleration, and too few innovations."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.input_axes[0].acceleration
    if isinstance(ekf2, Unavailable):
        message = f"The log contains no EKF2 state: {ekf2.reason}. The report contains KF only."
        yield make_warning("ekf2_not_logged", message, ekf2.remedy)
    if isinstance(acceleration, Unavailable):
        yield make_warning(
            "acceleration_not_logged",
            "The acceleration is missing, so KF assumes constant velocity. Reason: "
            f"{acceleration.reason}.",
            acceleration.remedy,
        )
    for result in analysis.axes.values():
        kf_summary = result.filters["kf"]
        if isinstance(kf_summary, Unavailable):
            yield make_warning(
                "too_few_innovations",
                f"The consistency of KF is not tested: {kf_summary.reason}.",
                kf_summary.remedy,
                {"count": len(result.kf_run.updates)},
            )
            return  # report only one axis


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
    reasons = (item.reason for item in analysis.missing if item.source == VISION_TOPIC)
    reason = next(reasons, f"{VISION_TOPIC} is not in this log")
    yield make_warning(
        "source_not_logged",
        f"The log lacks the {source.positions_text} that PX4 received. Reason: {reason}. "
        f"px4fuse uses {source.name} ({source.description}) at {rate_hz:.1f} Hz instead.",
        f"Set SDLOG_PROFILE to {sdlog_profile | VISION_PROFILE_MASK} (bit 7: vision topics) and "
        "fly again.",
        {"rate_hz": rate_hz, "sdlog_profile": sdlog_profile},
    )
