"""EKF2 found a large accelerometer bias, which our filter takes for acceleration."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import within
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.flight import SPECIFIC_FORCE_COLUMNS, Unavailable

ACCELEROMETER_BIAS = Threshold(0.2, "m/s²", "half of EKF2's own limit, EKF2_ABL_LIM")


def _detect(analysis: Analysis) -> Found:
    ekf2 = analysis.comparison.flight.ekf2
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.accelerometer_bias, Unavailable):
        return
    inside = within(ekf2.accelerometer_bias, analysis.comparison.segment)
    if inside.empty:
        return
    bias = inside[SPECIFIC_FORCE_COLUMNS].median().to_numpy()
    size = float(np.linalg.norm(bias))
    if size < ACCELEROMETER_BIAS.value:
        return
    yield Finding(
        "accelerometer_bias",
        "warning",
        f"EKF2 subtracts an accelerometer bias of {size:.2f} m/s² ({bias[0]:+.2f} forward, "
        f"{bias[1]:+.2f} right, {bias[2]:+.2f} down). Our filter integrates it and needs a larger "
        "SIGMA_A for that.",
        "Calibrate the accelerometers, at the temperature of the flight.",
        {"bias_m_s2": size},
    )


DETECTOR = Detector(_detect, {"accelerometer_bias": "acceler bias, imu bias"})
