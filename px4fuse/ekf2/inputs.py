"""Flight → what the model of EKF2 runs on, or why its log cannot carry the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.display import brief
from px4fuse.ekf2.stretches import MIN_STRETCH_S, Stretch, find_stretches, predict_s
from px4fuse.ekf2.vision import WHAT, Vision, read_vision
from px4fuse.ekf2_parameters import fuses_by_mask, settings_in_force
from px4fuse.flight import Ekf2, Flight, FusionRecord, Unavailable

# Predictions of more than this lose turns and vibration inside a step; EKF2's own are 8 to 13 ms
MAX_IMU_INTERVAL_S = 0.012
# The first release that stamps estimator_states with the time of the horizon
STAMPED_AT_HORIZON = "PX4 v1.13"
NO_LIMIT = 1_000_000
MAX_INTERVAL_S = 0.25


@dataclass(frozen=True)
class Rules:
    """What decides when EKF2 starts, stops and resets vision position, by release.

    Attributes
    ----------
    start_interval_s : float
        Fusion starts on a sample that follows the one before it within this.
    stop_s : float
        Fusion stops after this time without a sample.
    reset_s : float
        The position is reset to the sample after this time of rejections.
    resets : int
        So many resets in a row, then fusion stops until a sample on which it may start.
    bias_floor : float or None
        Least variance of the accelerometer's bias (m²/s⁴), where the release has one.
    horizon_by_delay : bool
        Whether the longest delay makes the horizon; else EKF2_DELAY_MAX does (from v1.15).
    """

    start_interval_s: float
    stop_s: float
    reset_s: float
    resets: int
    bias_floor: float | None
    horizon_by_delay: bool


@dataclass(frozen=True)
class Inputs:
    """All that the model needs of a flight.

    Attributes
    ----------
    settings : dict
        The model's parameters as flown, by PX4 name.
    stretches : tuple of Stretch
    vision : Vision
    rules : Rules
    step_s : float
        Average prediction step.
    horizon_s : float
        How far the fusion runs behind the output.
    predict_s : float
        EKF2_PREDICT_US.
    vision_height : bool
        Whether EKF2 took its height from vision.
    imu_offset_m : ndarray, shape (3,)
        EKF2_IMU_POS, body FRD.
    max_interval_s : float
        Height and heading are measured at least this often where vision is silent.
    """

    settings: dict[str, float]
    stretches: tuple[Stretch, ...]
    vision: Vision
    rules: Rules
    step_s: float
    horizon_s: float
    predict_s: float
    vision_height: bool
    imu_offset_m: Array
    max_interval_s: float = MAX_INTERVAL_S

    __repr__ = brief


def prepare(flight: Flight) -> Inputs | Unavailable:  # noqa: PLR0911 (a reason each)
    """What the model runs on, or why the log cannot carry it.

    Parameters
    ----------
    flight : Flight
    """
    imu, attitude, ekf2 = flight.imu, flight.attitude, flight.ekf2
    for part in (imu, attitude, ekf2):
        if isinstance(part, Unavailable):
            return Unavailable(WHAT, f"{part.what}: {part.reason}", part.remedy)
    assert isinstance(imu, pd.DataFrame)
    assert isinstance(attitude, pd.DataFrame)
    assert isinstance(ekf2, Ekf2)
    record, horizon_s = ekf2.record, ekf2.horizon_s
    for each in (record, ekf2.innovations["north"]):
        if isinstance(each, Unavailable):
            return Unavailable(WHAT, each.reason, each.remedy)
    assert isinstance(record, FusionRecord)
    if record.other_aiding:
        return Unavailable(
            WHAT,
            f"EKF2 fused more than vision position horizontally ({', '.join(record.other_aiding)})",
            "Fly with EKF2_GPS_CTRL 0, EKF2_OF_CTRL 0 and without bit 2 of EKF2_EV_CTRL.",
        )
    interval = float(np.median(np.diff(imu.index.to_numpy())))
    if interval > MAX_IMU_INTERVAL_S:
        return Unavailable(
            WHAT,
            f"the IMU is logged at {1 / interval:.0f} Hz, slower than EKF2 predicts",
            "Record with SDLOG_PROFILE bit 0 (default), which logs sensor_combined at full rate.",
        )
    vision = read_vision(flight, ekf2, record, attitude)
    if isinstance(vision, Unavailable):
        return vision
    if isinstance(horizon_s, Unavailable):
        if not flight.log.firmware.startswith(STAMPED_AT_HORIZON):
            return Unavailable(WHAT, horizon_s.reason, horizon_s.remedy)
        horizon_s = 0.0  # a buffer of one step: EKF2_EV_DELAY is at most EKF2_PREDICT_US
    stretches = find_stretches(flight, imu, attitude, ekf2, record, vision)
    if not stretches:
        return Unavailable(
            WHAT,
            f"no {MIN_STRETCH_S:g} s of external vision fused without a gap in IMU or vision",
            "Record without dropouts (a faster SD card, fewer topics), and send vision steadily.",
        )
    floor = 5e-8 / ekf2.step_s**2 if record.per_step_biases else None
    # EV_MAX_INTERVAL, ev_control.cpp; no_aid_timeout_max and reset_timeout_max, common.h
    limits = (
        (np.inf, 7.0, 7.0, NO_LIMIT) if fuses_by_mask(record.parameters) else (0.2, 0.4, 1.0, 5)
    )
    fusing = ekf2.fusing
    return Inputs(
        settings=settings_in_force(record.parameters),
        stretches=stretches,
        vision=vision,
        rules=Rules(*limits, floor, "EKF2_DELAY_MAX" not in record.parameters),
        step_s=ekf2.step_s,
        horizon_s=horizon_s,
        predict_s=predict_s(record),
        vision_height=isinstance(fusing, pd.DataFrame) and bool(fusing["vertical"].mean() > 0.5),
        imu_offset_m=np.array([record.parameters.get(f"EKF2_IMU_POS_{x}", 0.0) for x in "XYZ"]),
    )
