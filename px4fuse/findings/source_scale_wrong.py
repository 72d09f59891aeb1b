"""The source's distances are too long or too short, by what the IMU makes of every motion.

How well a log can show it: six passes at 5 Hz and 0.10 m give the scale to 3.5 % (one σ), so that
5 % is invisible, whatever is computed; 15 % is seen at 10 Hz and 0.05 m. Small errors need a tape
measure or the truth.
"""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import Explained
from px4fuse.findings.logging_rate_low import MIN_IMU_RATE, RATE_MARGIN
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_smoothed import low_pass
from px4fuse.flight import sample_rate

SCALE = Threshold(0.12, "of the distance", "flights of PX4's simulation are within 0.11")
SCALE_ERROR = Threshold(0.15, "of the distance", "a metre in seven")
SCALE_SIGMAS = Threshold(3.0, "standard deviations", "0.3 % of clean flights lie beyond")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    imu = comparison.flight.imu
    # motion that the IMU misses would pass for positions that are too long
    if not isinstance(imu, pd.DataFrame) or sample_rate(imu) < RATE_MARGIN * MIN_IMU_RATE.value:
        return
    # what odometry makes of a distance drifts, and is no constant
    if comparison.source.orientation is not None or comparison.source.origin.reconstructed:
        return
    found = analysis.explained
    if not isinstance(found, Explained):
        return
    scale = found.scale
    if abs(scale.value) < max(SCALE.value, SCALE_SIGMAS.value * scale.sigma):
        return
    if low_pass(analysis) is not None:  # it takes from the motion as well
        return
    yield Finding(
        "source_scale_wrong",
        "error" if abs(scale.value) >= SCALE_ERROR.value else "warning",
        f"Distances of {comparison.source.name} are {abs(scale.value):.0%} too "
        f"{'long' if scale.value > 0 else 'short'} (± {1.96 * scale.sigma:.0%}) against the motion "
        "that the IMU measures: neither filter's innovations show it, since both follow the "
        "positions.",
        "Measure a known distance with the source; survey the anchors again, and check its unit "
        "and its calibration.",
        {"scale": 1.0 + scale.value, "sigma": scale.sigma},
    )


DETECTOR = Detector(
    _detect,
    {
        "source_scale_wrong": (
            *(f"--mistake scale={percent}%" for percent in (5, 15, 20, 25)),
            "--uwb-rate 10 --sigma-uwb 0.05 --yaw follow --mistake scale=15%",
        )
    },
    names={"source_scale_wrong": "positions whose scale is wrong"},
)
