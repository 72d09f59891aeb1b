"""EKF2's innovation gate rejects measurements, or is too small for a good source."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.causal_replays import find_cause
from px4fuse.ekf2_parameters import GNSS_POS, Aid
from px4fuse.findings.cause_text import format_remedy_of_ekf2
from px4fuse.findings.model import Finding, Findings, finding, format_percent, zero_length_spans
from px4fuse.flight import Ekf2, Unavailable

REJECTED_SHARE_WARNING = 0.01  # of the innovations; a gate of 5 √S rejects 6e-7 if consistent
REJECTED_SHARE_ERROR = 0.20  # of the innovations; usually R or the time offset is wrong


def format_default_remedy(aid: Aid) -> str:
    """Format the action if no replay shows which change helps."""
    return (
        f"First set {aid.noise} to the source's noise. Then remove outliers"
        f"{'' if aid == GNSS_POS else ' (line of sight)'} and check the time offset ({aid.delay}). "
        f"Widen {aid.gate} last."
    )


def detect(analysis: Analysis) -> Findings:
    """Detect rejections and a gate that is too small."""
    rejections = tuple(_detect_rejections(analysis))
    yield from _detect_small_gate(analysis, rejections)
    yield from rejections


def _detect_small_gate(analysis: Analysis, rejections: tuple[Finding, ...]) -> Findings:
    """Detect a gate that rejects samples even if the noise is as EKF2 assumes."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Ekf2) and rejections:
        # EKF2 accepts a sample if the normal innovations of both axes are inside: erf(gate/√2)²
        expected = 1.0 - math.erf(ekf2.gate / math.sqrt(2.0)) ** 2
        if expected >= REJECTED_SHARE_WARNING:
            aid = remedy.aid_of(analysis)
            rejected = float(rejections[0].evidence["rejected_fraction"])
            yield finding(
                rejections[0].severity,
                "ekf2_gate_too_small",
                f"{aid.gate} is {ekf2.gate:g}. This gate rejects {format_percent(expected)} of the "
                "samples of a source with the assumed noise; in this flight EKF2 rejected "
                f"{format_percent(rejected)}. Rejected samples do not correct EKF2.",
                f"Set {aid.gate} to {aid.default_gate:g} (PX4's default), then check the other "
                "findings again.",
                {"gate": ekf2.gate, "rejected_by_gate": expected},
            )


def _detect_rejections(analysis: Analysis) -> Findings:
    """Detect rejections; EKF2 rejects north and east together, so one of them is enough."""
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    horizontal = [result for result in axes if result.axis.name != "down"][:1]
    for result in (*horizontal, *(result for result in axes if result.axis.name == "down")):
        axis_name, frame = result.axis.name, result.ekf2_innovations
        if isinstance(frame, Unavailable) or not isinstance(ekf2, Ekf2):
            continue
        rejected_flags = frame["rejected"].dropna()
        share = float(rejected_flags.mean())  # NaN if the log has no rejections
        if share >= REJECTED_SHARE_WARNING:
            quantity = "height" if axis_name == "down" else "horizontal position"
            yield finding(
                "error" if share >= REJECTED_SHARE_ERROR else "warning",
                "ekf2_rejects_positions",
                f"EKF2 rejected {format_percent(share, 1)} of the samples for {quantity} (beyond "
                f"{ekf2.gate:g} √S). Possible causes: outliers, measurement noise set too small, "
                "or late timestamps.",
                _remedy(analysis, axis_name),
                {"rejected_fraction": share, "count": len(frame), "axis": axis_name},
                zero_length_spans(rejected_flags.index[rejected_flags > 0.0]),
            )


def _remedy(analysis: Analysis, axis: str) -> str:
    """Format the action against the cause of large innovations, or a general action."""
    fallback, model = format_default_remedy(remedy.aid_of(analysis, axis)), analysis.ekf2_model
    if axis == "down":
        return fallback
    if isinstance(model, Unavailable):
        return f"{fallback} {remedy.format_not_replayed(model)}"
    cause = find_cause(analysis.causes, "ekf2", axis)
    return fallback if cause is None else format_remedy_of_ekf2(analysis, cause)
