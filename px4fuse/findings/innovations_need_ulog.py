"""MAVLink carries EKF2's states and variances, but no innovations."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.flight import Ekf2


def _detect(analysis: Analysis) -> Found:
    flight = analysis.flight
    if not flight.log.format.startswith("MAVLink") or not isinstance(flight.ekf2, Ekf2):
        return
    variances = isinstance(flight.ekf2.variance, pd.DataFrame)
    yield Finding(
        "innovations_need_ulog",
        "info",
        f"A MAVLink recording holds EKF2's states{' and variances' if variances else ''} but not "
        "its innovations: whether EKF2 is consistent cannot be said from it.",
        "Give the ULog of the same flight as LOG, and this recording with --mavlink."
        if flight.log.has_ulog
        else "They are in the autopilot's own DataFlash log (.BIN), which px4fuse does not read.",
    )


DETECTOR = Detector(
    _detect,
    names={"innovations_need_ulog": "innovations that only a ULog holds"},
)
