"""The source's distances are too long or too short, by what the IMU makes of every motion.

How well a log can show it: six passes at 5 Hz and 0.10 m give the scale to 3.5 % (one σ), so that
5 % is invisible, whatever is computed; 15 % is seen at 10 Hz and 0.05 m. Small errors need a tape
measure or the truth.
"""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import Explained
from px4fuse.findings.logging_rate_low import MIN_IMU_RATE_HZ, too_slow
from px4fuse.findings.model import Found, finding
from px4fuse.findings.source_smoothed import low_pass

SCALE = 0.12  # of the distance; flights of PX4's simulation are within 0.11
SCALE_ERROR = 0.15  # of the distance: a metre in seven
SCALE_SIGMAS = 3.0  # standard deviations; 0.3 % of clean flights lie beyond


def detect(analysis: Analysis) -> Found:
    """Of what is no odometry, whose scale drifts, with an IMU that misses no motion."""
    source, imu, found = analysis.source, analysis.flight.imu, analysis.explained
    if not isinstance(imu, pd.DataFrame) or too_slow(imu, MIN_IMU_RATE_HZ):
        return
    if source.orientation is not None or source.origin.reconstructed:
        return
    if not isinstance(found, Explained):
        return
    off, sigma = found.scale.value, found.scale.sigma
    if abs(off) < max(SCALE, SCALE_SIGMAS * sigma) or low_pass(analysis) is not None:
        return  # a low pass takes from the motion as well
    yield finding(
        "error" if abs(off) >= SCALE_ERROR else "warning",
        "source_scale_wrong",
        f"Distances of {source.name} are {abs(off):.0%} too {'long' if off > 0 else 'short'} "
        f"(± {1.96 * sigma:.0%}) against the motion that the IMU measures",
        ": neither filter's innovations show it, since both follow the positions.",
        "Measure a known distance with the source; survey the anchors again, and check its unit "
        "and its calibration.",
        {"scale": 1.0 + off, "sigma": sigma},
    )
