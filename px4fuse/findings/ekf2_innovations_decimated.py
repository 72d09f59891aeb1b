"""EKF2's innovations were logged more slowly than they were computed."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, info
from px4fuse.flight import Ekf2

MIN_INNOVATION_SHARE = 0.75  # of the source's samples: a quarter lost biases nothing yet


def detect(analysis: Analysis) -> Found:
    """Too few innovations for the measurements, which are not made of them."""
    ekf2, axes = analysis.flight.ekf2, analysis.axes.values()
    frames = (result.ekf2_innovations for result in axes)
    logged = next((len(frame) for frame in frames if isinstance(frame, pd.DataFrame)), None)
    if logged is None or analysis.source.origin.reconstructed or not isinstance(ekf2, Ekf2):
        return
    count = len(next(iter(axes)).replay.updates)
    if logged / count < MIN_INNOVATION_SHARE:
        yield info(
            "ekf2_innovations_decimated",
            f"The log holds {logged} EKF2 innovations for {count} measurements",
            f": {1 - logged / count:.0%} of what EKF2 did with the source is not in it.",
            f'Put the line "{ekf2.innovation_topics[0]} 0" into etc/logging/logger_topics.txt on '
            "the SD card.",
            {"logged": logged, "measurements": count},
        )
