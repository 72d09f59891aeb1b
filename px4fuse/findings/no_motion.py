"""The vehicle hardly moved: nothing about dynamics can be identified."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.filter.signals import within
from px4fuse.findings.model import Found, warning
from px4fuse.flight import POSITION_COLUMNS

MOTION_RANGE_M = 0.5  # 5 to 95 %; a hovering drone with 0.1 m UWB stays below


def motion_range_m(comparison: Comparison) -> float:
    """Larger horizontal extent of the source in the segment, 5 to 95 %."""
    inside = within(comparison.source.samples, comparison.segment)
    low, high = inside[POSITION_COLUMNS[:2]].quantile([0.05, 0.95]).to_numpy()
    return float(np.max(high - low))


def detect(analysis: Analysis) -> Found:
    """A smaller range than noise makes."""
    extent = motion_range_m(analysis)
    if extent < MOTION_RANGE_M:
        yield warning(
            "no_motion",
            f"The vehicle moved only {extent:.2f} m horizontally",
            " (5 to 95 %): velocity, heading and clock offset cannot be judged from this flight.",
            "Fly several passes of 5 m or more, with clear starts and stops.",
            {"range_m": extent},
        )
