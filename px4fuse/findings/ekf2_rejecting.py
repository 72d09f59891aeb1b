"""EKF2's gate threw measurements away."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.flight import Ekf2, Unavailable

REJECTED_SHARE_WARNING = Threshold(0.01, "of the innovations", "5 σ rejects 6e-7 when consistent")
REJECTED_SHARE_ERROR = Threshold(0.20, "of the innovations", "one in five: R or the clock is wrong")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis.comparison
    ekf2 = comparison.flight.ekf2
    gate = ekf2.gate if isinstance(ekf2, Ekf2) else float("nan")
    # a rejection is of the horizontal vector, so one horizontal axis speaks for all
    horizontal = [r for r in comparison.axes if r.axis.name != "down"][:1]
    for result in (*horizontal, *(r for r in comparison.axes if r.axis.name == "down")):
        frame = result.ekf2_innovations
        if isinstance(frame, Unavailable):
            continue
        known = frame["rejected"].dropna()
        if known.empty:
            continue
        share = float(known.mean())
        if share < REJECTED_SHARE_WARNING.value:
            continue
        what = "height" if result.axis.name == "down" else "horizontal position"
        yield Finding(
            "ekf2_rejecting",
            "error" if share >= REJECTED_SHARE_ERROR.value else "warning",
            f"EKF2 rejected {share:.1%} of the source's samples for {what} (outside {gate:g} √S): "
            "outliers, a noise set too small, or a late clock.",
            "First make EKF2_EVP_NOISE the source's own noise, then remove outliers (line of "
            "sight) and check the clock; widen EKF2_EVP_GATE last.",
            {"rejected_share": share, "count": float(len(frame)), "axis": result.axis.name},
        )


DETECTOR = Detector(
    _detect, {"ekf2_rejecting": "reject"}, {"ekf2_rejecting": ("--mistake ekf2-gate=2",)}
)
