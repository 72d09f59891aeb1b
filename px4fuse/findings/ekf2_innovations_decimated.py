"""EKF2's innovations were logged more slowly than they were computed."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.flight import Ekf2

MIN_INNOVATION_SHARE = Threshold(
    0.75, "of the source's samples", "a quarter lost biases nothing yet"
)


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    ekf2 = comparison.flight.ekf2
    per_axis = (result.ekf2_innovations for result in comparison.axes.values())
    innovations = next((frame for frame in per_axis if isinstance(frame, pd.DataFrame)), None)
    if innovations is None or comparison.source.origin.reconstructed or not isinstance(ekf2, Ekf2):
        return
    count = len(next(iter(comparison.axes.values())).replay.updates)
    share = len(innovations) / count
    if share < MIN_INNOVATION_SHARE.value:
        yield Finding(
            "ekf2_innovations_decimated",
            "info",
            f"The log holds {len(innovations)} EKF2 innovations for {count} measurements: "
            f"{1 - share:.0%} of what EKF2 did with the source is not in it.",
            f'Put the line "{ekf2.innovation_topics[0]} 0" into etc/logging/logger_topics.txt on '
            "the SD card.",
            {"logged": float(len(innovations)), "measurements": float(count)},
        )


DETECTOR = Detector(
    _detect,
    names={"ekf2_innovations_decimated": "EKF2's innovations logged too slowly"},
)
