"""The accelerometer reads too much or too little all the time.

Our own estimate is from the positions: a bias that is taken for acceleration moves the innovations
in a way that nothing else does. EKF2's stands in where there is none, and for the down axis.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import Explained
from px4fuse.filter.signals import within
from px4fuse.findings.model import Found, finding, warning
from px4fuse.flight import SPECIFIC_FORCE_COLUMNS, Ekf2

BIAS_M_S2 = 0.2  # half of EKF2's own limit, EKF2_ABL_LIM
BIAS_ERROR_M_S2 = 0.3  # as SIGMA_A tripled; 0.15 m after one second
BIAS_SIGMAS = 4.0  # 6e-5 of clean flights lie beyond
TILT_DEG_PER_M_S2 = float(np.degrees(1.0 / 9.80665))


def _ekf2_bias(analysis: Analysis) -> list[float] | None:
    """Median of what EKF2 subtracts, forward, right and down (m/s²)."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2) or not isinstance(ekf2.accelerometer_bias, pd.DataFrame):
        return None
    inside = within(ekf2.accelerometer_bias, analysis.segment)[SPECIFIC_FORCE_COLUMNS]
    return None if inside.empty else [float(median) for median in inside.median()]


def detect(analysis: Analysis) -> Found:
    """Our estimate where it is sure, else EKF2's."""
    found, of_ekf2 = analysis.explained, _ekf2_bias(analysis)
    if isinstance(found, Explained):
        forward, right = found.forward_bias, found.right_bias
        size = float(np.hypot(forward.value, right.value))
        sigma = float(np.hypot(forward.sigma, right.sigma))
        if size >= max(BIAS_M_S2, BIAS_SIGMAS * sigma):
            in_ekf2 = ""
            if of_ekf2 is not None:
                in_ekf2 = f" EKF2 subtracts {of_ekf2[0]:+.2f} forward, {of_ekf2[1]:+.2f} right."
            yield finding(
                "error" if size >= BIAS_ERROR_M_S2 else "warning",
                "accelerometer_bias",
                f"The accelerometer reads {forward.value:+.2f} m/s² too much forward and "
                f"{right.value:+.2f} right",
                f" (± {1.96 * forward.sigma:.2f}), by what the positions show of the motion: our "
                "filter integrates it as acceleration. An attitude that is off by "
                f"{size * TILT_DEG_PER_M_S2:.1f}° does the same.{in_ekf2}",
                "Calibrate the accelerometers and the level horizon, at the temperature of the "
                "flight; a larger SIGMA_A only hides it.",
                {"bias_m_s2": size, "sigma_m_s2": sigma},
            )
            return
    if of_ekf2 is None:
        return
    # horizontally ours is the better estimate, where there is one
    bias = [0.0, 0.0, of_ekf2[2]] if isinstance(found, Explained) else of_ekf2
    size = float(np.linalg.norm(bias))
    if size >= BIAS_M_S2:
        yield warning(
            "accelerometer_bias",
            f"EKF2 subtracts an accelerometer bias of {size:.2f} m/s²",
            f" ({of_ekf2[0]:+.2f} forward, {of_ekf2[1]:+.2f} right, {of_ekf2[2]:+.2f} down). Our "
            "filter integrates it and needs a larger SIGMA_A for that.",
            "Calibrate the accelerometers, at the temperature of the flight.",
            {"bias_m_s2": size},
        )
