"""What the log says of itself: loss, restarts, and what it cannot hold."""

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.inputs import MODEL_NOTE
from px4fuse.findings.model import Found, finding, format_count, info, warning
from px4fuse.flight import Ekf2, Flight
from px4fuse.plain import capitalise_first


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
        each
        for each in analysis.flight.log.dropouts
        if each.start_s <= segment.end_s and each.start_s + each.duration_s >= segment.start_s
    ]
    if lost:
        yield warning(
            "logger_dropouts",
            {"count": len(lost), "total_s": sum(each.duration_s for each in lost)},
            tuple((each.start_s, each.start_s + each.duration_s) for each in lost),
            often=format_count(len(lost)),
            longest_s=max(each.duration_s for each in lost),
        )


def loss(flight: Flight) -> Found:
    """Bytes that the reader had to pass over, a flight that goes on, single samples."""
    log = flight.log
    if log.damage or log.ends_in_flight:
        first, *others = map(
            _sentence,
            log.damage
            or (f"the log ends in flight, after {log.duration_s:.1f} s: the landing is not in it",),
        )
        yield finding(
            "warning" if log.damage else "info",
            "log_damaged",
            {"lost_bytes": log.bytes - log.bytes_read, "ends_in_flight": float(log.ends_in_flight)},
            headline=first,
            others="".join(f". {other}" for other in others),
            case="ends" if not log.damage else log.format.partition(" ")[0],
        )
    for topic, count in list(log.dropped.items())[:1]:
        more = len(log.dropped) - 1
        facts = {"topic": topic, "count": count, "others": more, "also": more > 0}
        yield info("samples_dropped", {"notes": more + 1}, (), **facts)


def clocks_set_back(flight: Flight) -> Found:
    """The boot clock began again, or the recording computer's clock was set back."""
    log = flight.log
    if log.restarts:
        yield warning(
            "autopilot_restarted", {"count": log.restarts}, often=format_count(log.restarts)
        )
    if back := log.receipt_went_back:
        yield info("receipt_out_of_order", {"count": back}, often=format_count(back))


def estimators(analysis: Analysis) -> Found:
    """What is called EKF2 is another estimator, a model, or lacks its innovations."""
    log, ekf2 = analysis.flight.log, analysis.flight.ekf2
    if MODEL_NOTE in log.notes:
        yield info("ekf2_is_a_model", headline=MODEL_NOTE)
    if not isinstance(ekf2, Ekf2):
        return
    if log.autopilot != "PX4":
        yield info("not_px4", {"autopilot": log.autopilot})
    if log.format.startswith("MAVLink"):
        has_variances = isinstance(ekf2.variance, pd.DataFrame)
        yield info("innovations_need_ulog", case=log.has_ulog, variances=has_variances)


def _sentence(note: str) -> str:
    """A note with a capital letter, unless it begins with a file's name."""
    return note if "." in note.split(" ", 1)[0] else capitalise_first(note)
