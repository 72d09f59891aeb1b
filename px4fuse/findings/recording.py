"""What a MAVLink recording or a position file of its own brings with it: clocks, losses, frames."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import within
from px4fuse.findings.model import Finding, sentence
from px4fuse.findings.thresholds import (
    GAP,
    GAP_INTERVALS,
    LOST_SHARE,
    MAPPED_BY_RECEIPT,
    RECEIPT_JITTER,
)
from px4fuse.flight import Ekf2

SYNCHRONISE = (
    "Let the companion answer TIMESYNC (MAVROS does by default; with pymavlink answer every "
    "request), and send the positions after 500 answers, 50 s at 10 Hz."
)


def stamps_meaningless(analysis: Analysis) -> Iterator[Finding]:
    """The sender's time stamps take so few values that they tell no time."""
    comparison = analysis.comparison
    clock = comparison.source.clock_map
    if clock is None or clock.distinct_stamps is None:
        return
    yield Finding(
        "source_stamps_constant",
        "error",
        f"The {clock.pairs} time stamps of {comparison.source.name} take only "
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
            f"The receipt of {comparison.source.name}, which stands in for its time stamps, "
            f"jitters by {clock.jitter_s * 1e3:.0f} ms: at 1 m/s that is an error of "
            f"{clock.jitter_s:.3f} m.",
            "Send the time of measurement in the message, and record close to the sender.",
            {"jitter_s": clock.jitter_s},
        )


def companion_not_synchronised(analysis: Analysis) -> Iterator[Finding]:
    """No TIMESYNC between sender and autopilot: PX4 takes the time of arrival instead."""
    comparison = analysis.comparison
    clock = comparison.source.clock_map
    if clock is None or clock.distinct_stamps is not None:
        return
    if clock.method not in MAPPED_BY_RECEIPT:
        return
    ours = (
        "Ours has to do the same; however old they were, by that much its track is late"
        if clock.method == "arrival time"
        else f"Ours has the sender's own stamps, mapped by the {clock.method}"
    )
    yield Finding(
        "companion_not_synchronised",
        "warning",
        f"The clock of the sender of {comparison.source.name} was never synchronised with the "
        "autopilot's (TIMESYNC): EKF2 took the positions to be measured when they arrived. "
        f"{ours}.",
        SYNCHRONISE,
        {"jitter_s": clock.jitter_s},
    )


def innovations_need_ulog(analysis: Analysis) -> Iterator[Finding]:
    """MAVLink carries EKF2's states and variances, but no innovations."""
    comparison = analysis.comparison
    flight = comparison.flight
    if not flight.log.format.startswith("MAVLink") or not isinstance(flight.ekf2, Ekf2):
        return
    variances = isinstance(flight.ekf2.variance, pd.DataFrame)
    yield Finding(
        "innovations_need_ulog",
        "info",
        f"A MAVLink recording holds EKF2's states{' and variances' if variances else ''} but not "
        "its innovations: whether EKF2 is consistent cannot be said from it.",
        f"Give the ULog of the same flight: px4fuse compare LOG.ulg --mavlink {flight.log.name}.",
    )


def other_autopilot(analysis: Analysis) -> Iterator[Finding]:
    """The estimator that is called EKF2 here is not PX4's."""
    comparison = analysis.comparison
    autopilot = comparison.flight.log.autopilot
    if autopilot == "PX4" or not isinstance(comparison.flight.ekf2, Ekf2):
        return
    yield Finding(
        "not_px4",
        "info",
        f"This is {autopilot}: where the report says EKF2 it means this autopilot's own estimator, "
        "and the PX4 parameters named do not exist there.",
        "Read EKF2 as the autopilot's own estimator.",
        {"autopilot": autopilot},
    )


def autopilot_restarted(analysis: Analysis) -> Iterator[Finding]:
    """The boot clock began again in mid-recording, and only one part was read."""
    comparison = analysis.comparison
    for note in comparison.flight.log.notes:
        if "boot clock went back" in note:
            yield Finding(
                "autopilot_restarted",
                "warning",
                f"{sentence(note)}.",
                "Record each flight into a file of its own.",
            )


def samples_lost(analysis: Analysis) -> Iterator[Finding]:
    """The recording lacks single samples of a regular source."""
    comparison = analysis.comparison
    source = comparison.source
    if source.clock_map is None or source.clock_map.method == "arrival time":
        return
    intervals = np.diff(within(source.samples, comparison.segment).index.to_numpy())
    if len(intervals) < 2 or source.clock_map.distinct_stamps is not None:
        return
    typical = float(np.median(intervals))
    short = intervals[intervals <= max(GAP.value, GAP_INTERVALS.value * typical)]
    lost = int(np.sum(np.rint(short / typical) - 1.0))
    share = lost / (lost + len(short))
    if share > LOST_SHARE.value:
        yield Finding(
            "source_samples_lost",
            "info",
            f"About {share:.0%} of {source.name} is not in the recording ({lost} samples of "
            f"{lost + len(short)} at one per {typical:.2f} s); EKF2 may have had them.",
            "Record on the companion, or on a link that does not lose messages; the ULog has what "
            "arrived (SDLOG_PROFILE 129).",
            {"lost": float(lost), "lost_share": share},
        )


def position_file_placement(analysis: Analysis) -> Iterator[Finding]:
    """What is poorly determined about where an external position file lies in the flight."""
    comparison = analysis.comparison
    alignment = comparison.source.alignment
    if alignment is None:
        return
    for warning in alignment.warnings:
        said, option, value = warning.rstrip(".").partition("ive --position-")
        message = sentence(f"{said[:-1].rstrip(' :')}" if option else said)
        yield Finding(
            "position_file_placement",
            "error" if option else "warning",
            f"{comparison.source.name}: {message.rstrip('.')}.",
            f"Give --position-{value}."
            if option
            else "Give --clock-offset, --position-frame and --position-yaw where you know them.",
        )


def receipt_out_of_order(analysis: Analysis) -> Iterator[Finding]:
    """The recording computer's clock was set back while it recorded."""
    comparison = analysis.comparison
    for note in comparison.flight.log.notes:
        if "time of receipt went back" in note:
            yield Finding(
                "receipt_out_of_order",
                "info",
                f"{sentence(note)}: the recording computer's clock was set, or "
                "recordings were put together; what is stamped by the sender is not affected.",
                "Switch the recording computer's time service off while recording.",
            )
