"""The estimator that is called EKF2 here is not PX4's."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.flight import Ekf2


def _detect(analysis: Analysis) -> Found:
    flight = analysis.flight
    autopilot = flight.log.autopilot
    if autopilot == "PX4" or not isinstance(flight.ekf2, Ekf2):
        return
    yield Finding(
        "not_px4",
        "info",
        f"This is {autopilot}: where the report says EKF2 it means this autopilot's own estimator, "
        "and the PX4 parameters named do not exist there.",
        "Read EKF2 as the autopilot's own estimator.",
        {"autopilot": autopilot},
    )


DETECTOR = Detector(
    _detect,
    names={"not_px4": "a log that is not of PX4"},
)
