"""What the log says of itself: loss, restarts, and what it cannot hold."""

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.inputs import MODEL_NOTE
from px4fuse.findings.model import Found, finding, info, times, warning
from px4fuse.flight import Ekf2, Flight
from px4fuse.plain import capital


def detect(analysis: Analysis) -> Found:
    """All of them; what was lost first."""
    yield from dropouts(analysis)
    yield from loss(analysis.flight)
    yield from clocks_set_back(analysis.flight)
    yield from estimators(analysis)


def dropouts(analysis: Comparison) -> Found:
    """The logger stopped for a while."""
    segment = analysis.segment
    lost = [
        each for each in analysis.flight.log.dropouts
        if each.start_s <= segment.end_s and each.start_s + each.duration_s >= segment.start_s
    ]  # fmt: skip
    if lost:
        total = sum(each.duration_s for each in lost)
        yield warning(
            "logger_dropouts",
            f"The logger lost data {times(len(lost))}, {total:.2f} s in all, the longest "
            f"{max(each.duration_s for each in lost):.2f} s",
            ".",
            "Use a faster SD card, or log less (SDLOG_PROFILE).",
            {"count": len(lost), "total_s": total},
            tuple((each.start_s, each.start_s + each.duration_s) for each in lost),
        )


def loss(flight: Flight) -> Found:
    """Bytes that the reader had to pass over, a flight that goes on, single samples."""
    log = flight.log
    if log.damage or log.ends_in_flight:
        first, *others = map(_sentence, log.damage or (
            f"the log ends in flight, after {log.duration_s:.1f} s: the landing is not in it",
        ))  # fmt: skip
        yield finding(
            "warning" if log.damage else "info",
            "log_damaged",
            first,
            "".join(f". {other}" for other in others) + ".",
            "Log until after the landing; if the log was cut short, copy it again."
            if not log.damage
            else "Record where the link loses no bytes: by cable, or on the companion."
            if log.format.startswith("MAVLink")
            else "Copy the log again; if that does not help, replace the SD card.",
            {"lost_bytes": log.bytes - log.bytes_read, "ends_in_flight": float(log.ends_in_flight)},
        )
    for name, count in list(log.dropped.items())[:1]:
        topics = len(log.dropped) - 1
        yield info(
            "samples_dropped",
            f"{count} samples of {name} were dropped",
            ": their time stamps are zero or go back"
            f"{f' (as are some of {topics} more)' if topics else ''}.",
            "The file is whole: a clock was set back, or messages overtook each other. If it is "
            "the position source, synchronise its clock before take-off (TIMESYNC).",
            {"notes": len(log.dropped)},
        )


def clocks_set_back(flight: Flight) -> Found:
    """The boot clock began again, or the recording computer's clock was set back."""
    log = flight.log
    if log.restarts:
        yield warning(
            "autopilot_restarted",
            f"The autopilot's boot clock went back {times(log.restarts)} (restart)",
            ": only the longest part was read.",
            "Record each flight into a file of its own.",
            {"count": log.restarts},
        )
    if log.receipt_went_back:
        yield info(
            "receipt_out_of_order",
            f"The time of receipt went back {times(log.receipt_went_back)}",
            ": the recording computer's clock was set, or recordings were put together; the "
            "sender's own stamps are not affected.",
            "Switch the recording computer's time service off while recording.",
            {"count": log.receipt_went_back},
        )


def estimators(analysis: Analysis) -> Found:
    """What is called EKF2 is another estimator, a model, or lacks its innovations."""
    log, ekf2 = analysis.flight.log, analysis.flight.ekf2
    if MODEL_NOTE in log.notes:
        yield info(
            "ekf2_is_a_model",
            MODEL_NOTE,
            ".",
            "Read what is said of EKF2 as what its equations do with these sensors; fly for what "
            "PX4's own EKF2 does.",
        )
    if not isinstance(ekf2, Ekf2):
        return
    if log.autopilot != "PX4":
        yield info(
            "not_px4",
            f"This is {log.autopilot}",
            ": where the report says EKF2 it means this autopilot's own estimator, and the PX4 "
            "parameters named do not exist there.",
            "Read EKF2 as the autopilot's own estimator.",
            {"autopilot": log.autopilot},
        )
    if log.format.startswith("MAVLink"):
        variances = " and variances" if isinstance(ekf2.variance, pd.DataFrame) else ""
        yield info(
            "innovations_need_ulog",
            f"A MAVLink recording holds EKF2's states{variances} but not its innovations",
            ": whether EKF2 is consistent cannot be said from it.",
            "Give the ULog of the same flight as LOG, and this recording with --mavlink."
            if log.has_ulog
            else "They are in the autopilot's own DataFlash log (.BIN), which px4fuse does not "
            "read.",
        )


def _sentence(note: str) -> str:
    """A note with a capital letter, unless it begins with a file's name."""
    return note if "." in note.split(" ", 1)[0] else capital(note)
