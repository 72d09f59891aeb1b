"""EKF2's innovation gate rejects measurements, or is too small for a good source."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.causal_replays import cause_of
from px4fuse.ekf2_parameters import GNSS_POS, Aid
from px4fuse.findings.cause_text import format_remedy_of_ekf2
from px4fuse.findings.model import Finding, Found, finding, format_percent, moments
from px4fuse.flight import Ekf2, Unavailable

REJECTED_SHARE_WARNING = 0.01  # of the innovations; a gate of 5 √S rejects 6e-7 if consistent
REJECTED_SHARE_ERROR = 0.20  # of the innovations; usually R or the time offset is wrong


def default_remedy(aid: Aid) -> str:
    """Action if no replay shows which change helps."""
    return (
        f"First set {aid.noise} to the source's noise. Then remove outliers"
        f"{'' if aid == GNSS_POS else ' (line of sight)'} and check the time offset ({aid.delay}). "
        f"Widen {aid.gate} last."
    )


def detect(analysis: Analysis) -> Found:
    """Detect rejections and a gate that is too small."""
    rejections = tuple(_rejections(analysis))
    yield from _narrow_gate(analysis, rejections)
    yield from rejections


def _narrow_gate(analysis: Analysis, rejections: tuple[Finding, ...]) -> Found:
    """Detect a gate that rejects samples of a source with the noise that EKF2 assumes."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Ekf2) and rejections:
        # both axes must be inside, each normal: erf(gate/√2)²
        expected = 1.0 - math.erf(ekf2.gate / math.sqrt(2.0)) ** 2
        if expected >= REJECTED_SHARE_WARNING:
            aid = remedy.aid_of(analysis)
            rejected = float(rejections[0].evidence["rejected_fraction"])
            yield finding(
                rejections[0].severity,
                "ekf2_gate_too_small",
                f"{aid.gate} is {ekf2.gate:g}: such a gate rejects {format_percent(expected)} of "
                "the samples of a source with the assumed noise. Here EKF2 rejected "
                f"{format_percent(rejected)}. Rejected samples do not correct EKF2.",
                f"Set {aid.gate} to {aid.default_gate:g} (PX4's default), then check the other "
                "findings again.",
                {"gate": ekf2.gate, "rejected_by_gate": expected},
            )


def _rejections(analysis: Analysis) -> Found:
    """Detect rejections; EKF2 rejects the horizontal vector, so one horizontal axis is enough."""
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    horizontal = [result for result in axes if result.axis.name != "down"][:1]
    for result in (*horizontal, *(result for result in axes if result.axis.name == "down")):
        name, frame = result.axis.name, result.ekf2_innovations
        if isinstance(frame, Unavailable) or not isinstance(ekf2, Ekf2):
            continue
        known = frame["rejected"].dropna()
        share = float(known.mean())  # NaN if the log has no rejections
        if share >= REJECTED_SHARE_WARNING:
            quantity = "height" if name == "down" else "horizontal position"
            yield finding(
                "error" if share >= REJECTED_SHARE_ERROR else "warning",
                "ekf2_rejects_positions",
                f"EKF2 rejected {format_percent(share, 1)} of the samples for {quantity} (beyond "
                f"{ekf2.gate:g} √S). Possible causes: outliers, measurement noise set too small, "
                "or late timestamps.",
                _remedy(analysis, name),
                {"rejected_fraction": share, "count": len(frame), "axis": name},
                moments(known.index[known > 0.0]),
            )


def _remedy(analysis: Analysis, axis: str) -> str:
    """Action against the cause of large innovations, if a replay shows one."""
    default, model = default_remedy(remedy.aid_of(analysis, axis)), analysis.ekf2_model
    if axis == "down":
        return default
    if isinstance(model, Unavailable):
        return f"{default} {remedy.format_not_replayed(model)}"
    cause = cause_of(analysis.causes, "ekf2", axis)
    return default if cause is None else format_remedy_of_ekf2(analysis, cause)
