"""What the report has to do without: EKF2, the acceleration, or statements on consistency."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.flight import Unavailable


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    ekf2 = comparison.flight.ekf2
    if isinstance(ekf2, Unavailable):
        yield Finding(
            "ekf2_unavailable",
            "warning",
            f"Nothing to compare with: {ekf2.reason}. The report holds our filter alone.",
            ekf2.remedy,
        )
    acceleration = comparison.lines[0].acceleration
    if isinstance(acceleration, Unavailable):
        yield Finding(
            "input_unavailable",
            "warning",
            f"No acceleration input ({acceleration.what}: {acceleration.reason}); "
            "our filter assumes constant velocity.",
            acceleration.remedy,
        )
    for result in comparison.axes.values():
        ours = result.filters["kf"]
        if isinstance(ours, Unavailable):
            yield Finding(
                "too_few_innovations",
                "warning",
                f"No statement on consistency: {ours.reason}.",
                ours.remedy,
                {"count": float(len(result.replay.updates))},
            )
            return


DETECTOR = Detector(
    _detect,
    names={
        "ekf2_unavailable": "a log without EKF2",
        "input_unavailable": "a log without acceleration",
        "too_few_innovations": "too few measurements to judge a filter by",
    },
)
