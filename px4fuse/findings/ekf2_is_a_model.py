"""What the log holds of EKF2 is not PX4's."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.ekf2.model import MODEL_NOTE
from px4fuse.findings.model import Detector, Finding, Found


def _detect(analysis: Analysis) -> Found:
    if MODEL_NOTE in analysis.flight.log.notes:
        yield Finding(
            "ekf2_is_a_model",
            "info",
            f"{MODEL_NOTE}.",
            "Read what is said of EKF2 as what its equations do with these sensors; fly for what "
            "PX4's own EKF2 does.",
        )


DETECTOR = Detector(
    _detect,
    names={"ekf2_is_a_model": "EKF2 that is a model of it"},
)
