"""What the report has to do without: EKF2, the acceleration, or statements on consistency."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, warning
from px4fuse.flight import Unavailable


def detect(analysis: Analysis) -> Found:
    """All that is missing, with the reason and the remedy that stand in its place."""
    ekf2, acceleration = analysis.flight.ekf2, analysis.lines[0].acceleration
    if isinstance(ekf2, Unavailable):
        yield warning(
            "ekf2_unavailable",
            "Nothing to compare with",
            f": {ekf2.reason}. The report holds our filter alone.",
            ekf2.remedy,
        )
    if isinstance(acceleration, Unavailable):
        yield warning(
            "input_unavailable",
            "No acceleration input",
            f" ({acceleration.what}: {acceleration.reason}); our filter assumes constant velocity.",
            acceleration.remedy,
        )
    for result in analysis.axes.values():
        ours = result.filters["kf"]
        if isinstance(ours, Unavailable):
            yield warning(
                "too_few_innovations",
                "No statement on consistency",
                f": {ours.reason}.",
                ours.remedy,
                {"count": len(result.replay.updates)},
            )
            return
