"""EKF2's gate threw measurements away, or is so narrow that it must."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.interventions import cause_of
from px4fuse.ekf2_parameters import GNSS_POS, Aid
from px4fuse.findings.model import Finding, Found, finding, moments
from px4fuse.findings.since import format_remedy_of_ekf2
from px4fuse.flight import Ekf2, Unavailable

REJECTED_SHARE_WARNING = 0.01  # of the innovations; 5 σ rejects 6e-7 when consistent
REJECTED_SHARE_ERROR = 0.20  # of the innovations: one in five, R or the clock is wrong


def default_remedy(aid: Aid) -> str:
    """What to do where no replay tells what helps."""
    return (
        f"First make {aid.noise} the source's own noise, then remove outliers"
        f"{'' if aid == GNSS_POS else ' (line of sight)'} and check the clock ({aid.delay}); widen "
        f"{aid.gate} last."
    )


def detect(analysis: Analysis) -> Found:
    """A rejection is of the horizontal vector, so one horizontal axis speaks for all."""
    rejections = tuple(_rejections(analysis))
    yield from _narrow_gate(analysis, rejections)
    yield from rejections


def _narrow_gate(analysis: Analysis, rejections: tuple[Finding, ...]) -> Found:
    """The gate by itself: what it rejects of a source that is as good as EKF2 expects."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Ekf2) and rejections:
        # both axes must be inside, each normal: erf(gate/√2)²
        must = 1.0 - math.erf(ekf2.gate / math.sqrt(2.0)) ** 2
        if must >= REJECTED_SHARE_WARNING:
            aid = remedy.aid_of(analysis)
            yield finding(
                rejections[0].severity,
                "ekf2_gate_small",
                {"gate": ekf2.gate, "rejected_by_gate": must},
                name_of_gate=aid.gate,
                default=aid.default_gate,
                rejected=rejections[0].evidence["rejected_share"],
            )


def _rejections(analysis: Analysis) -> Found:
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    horizontal = [result for result in axes if result.axis.name != "down"][:1]
    for result in (*horizontal, *(result for result in axes if result.axis.name == "down")):
        name, frame = result.axis.name, result.ekf2_innovations
        if isinstance(frame, Unavailable) or not isinstance(ekf2, Ekf2):
            continue
        known = frame["rejected"].dropna()
        share = float(known.mean())  # NaN where it is not known
        if share >= REJECTED_SHARE_WARNING:
            yield finding(
                "error" if share >= REJECTED_SHARE_ERROR else "warning",
                "ekf2_rejecting",
                {"rejected_share": share, "count": len(frame), "axis": name},
                moments(known.index[known > 0.0]),
                down=name == "down",
                gate=ekf2.gate,
                remedy=_remedy(analysis, name),
            )


def _remedy(analysis: Analysis, axis: str) -> str:
    """What puts the cause of the innovations right, which the gate is there for."""
    order, model = default_remedy(remedy.aid_of(analysis, axis)), analysis.ekf2_model
    if axis == "down":
        return order
    if isinstance(model, Unavailable):
        return f"{order} {remedy.format_not_replayed(model)}"
    cause = cause_of(analysis.causes, "ekf2", axis)
    return order if cause is None else format_remedy_of_ekf2(analysis, cause)
