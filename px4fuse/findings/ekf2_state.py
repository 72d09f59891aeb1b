"""IMU biases that EKF2 cannot estimate, and a tilt or heading that EKF2 did not align."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.arrays import Array
from px4fuse.core.text import format_metres
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.model import Findings, error, format_percent, fraction_on, spans_with_value
from px4fuse.flight.ekf2_parameters import BAROMETER, MAG, NO_MAGNETOMETER
from px4fuse.flight.model import BODY_AXES, Columns, Ekf2, Flight, Unavailable

# Parameter with the limit of a bias state, its unit, sensor, and columns of the bias
BIAS_STATES = (
    ("EKF2_ABL_LIM", "m/s²", "accelerometer", Columns.ACCELEROMETER_BIAS),
    ("EKF2_GYR_B_LIM", "rad/s", "gyroscope", Columns.GYRO_BIAS),
)
# Fraction of its limit above which a bias state is at the limit
AT_LIMIT = 0.98
# Minimum fraction of the flight with a bias state at its limit for a finding
MIN_LIMITED_FRACTION = 0.5
# Length (s) of the windows in which the IMU is tested for rest
REST_WINDOW_S = 1.0
# Time (s) before take-off in which the motors run, so the IMU is not at rest
RUN_UP_S = 0.5
# Maximum standard deviation of angular rate (rad/s) and specific force (m/s²) at rest
MAX_REST_STD = (0.04, 1.5)
# Maximum change (rad/s) of the angular rate at rest
MAX_REST_CHANGE_RAD_S = 0.01
# Minimum gyroscope bias (rad/s) for a finding: the heading turns by 90° in 30 s
MIN_GYRO_BIAS_RAD_S = 0.05
GRAVITY_M_S2 = 9.80665
# Minimum difference (m/s²) between gravity and the specific force at rest that a message states
MIN_GRAVITY_ERROR_M_S2 = 0.3
# Maximum fraction of the flight without alignment for no finding: 2 % of a minute are about 1 s
MAX_UNALIGNED_FRACTION = 0.02


def detect(analysis: Analysis) -> Findings:
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2):
        return
    at_rest = measure_at_rest(analysis.flight)
    if not isinstance(ekf2.record, Unavailable):
        bias_states = cut_to_segment(ekf2.record.delayed, analysis.segment)
        if len(bias_states):
            yield from _detect_limited_bias(analysis, ekf2, bias_states, at_rest)
            yield from _detect_gyro_bias(bias_states, at_rest)
    yield from _detect_missing_alignment(analysis, ekf2)


def measure_at_rest(flight: Flight) -> pd.Series | None:
    """Return the median angular rate and specific force at rest before take-off, if known."""
    if not isinstance(flight.imu, pd.DataFrame) or not flight.airborne:
        return None
    if isinstance(flight.airborne, Unavailable):
        return None
    imu = flight.imu.loc[: flight.airborne[0][0] - RUN_UP_S]
    windows = imu.groupby(np.floor(imu.index / REST_WINDOW_S))
    mean, std = windows.mean(), windows.std()
    is_at_rest = np.ones(len(mean), bool)
    for columns, limit in zip(
        (Columns.ANGULAR_RATE, Columns.SPECIFIC_FORCE), MAX_REST_STD, strict=True
    ):
        is_at_rest &= np.linalg.norm(std[columns], axis=1) < limit
    mean = mean[is_at_rest]
    if mean.empty or np.ptp(mean[Columns.ANGULAR_RATE], axis=0).max() > MAX_REST_CHANGE_RAD_S:
        return None
    return mean.median()


def _detect_limited_bias(
    analysis: Analysis, ekf2: Ekf2, bias_states: pd.DataFrame, at_rest: pd.Series | None
) -> Findings:
    for parameter, unit, sensor, columns in BIAS_STATES:
        limit = ekf2.parameters.get(parameter, 0.0)
        fractions = (bias_states[columns].abs() >= AT_LIMIT * limit).mean().to_numpy()
        axis = int(np.argmax(fractions))
        limited_fraction = float(fractions[axis])
        if limit <= 0.0 or limited_fraction < MIN_LIMITED_FRACTION:
            continue
        bias = float(bias_states[columns[axis]].median())
        message = (
            f"EKF2's {sensor} bias is at its limit {parameter} {limit:.3g} {unit} for "
            f"{format_percent(limited_fraction)} of the flight. The estimate is {bias:+.3g} "
            f"{unit} {BODY_AXES[axis]}; EKF2 cannot estimate a larger bias."
        )
        if sensor == "accelerometer" and at_rest is not None:
            force_m_s2 = float(np.linalg.norm(at_rest[Columns.SPECIFIC_FORCE]))
            if abs(force_m_s2 - GRAVITY_M_S2) > MIN_GRAVITY_ERROR_M_S2:
                message += (
                    f" At rest before take-off the accelerometer measures {force_m_s2:.2f} m/s² "
                    f"instead of {GRAVITY_M_S2:.2f}: the bias is {GRAVITY_M_S2 - force_m_s2:+.2f} "
                    "m/s² down."
                )
        yield error(
            "ekf2_bias_at_limit",
            message + (_describe_height_error(analysis, ekf2) if axis == 2 else ""),
            f"Calibrate the {sensor}s at the temperature of the flight.",
            {"bias": bias, "limit": limit, "limited_fraction": limited_fraction},
        )


def _describe_height_error(analysis: Analysis, ekf2: Ekf2) -> str:
    text, down = "", analysis.axes.get("down")
    truth = None if down is None else down.filters["ekf2"].truth
    if isinstance(truth, ErrorsAgainstTruth):
        text = (
            f" EKF2's height RMSE against ground truth is {format_metres(truth.position_rmse_m)} m."
        )
    if (log := ekf2.aids.get(BAROMETER.name)) is not None:
        innovations = cut_to_segment(log.samples, analysis.segment)[f"innovation_{log.axes[0]}"]
        text += f" Barometer innovations have a mean of {abs(innovations.mean()):.1f} m."
    return text


def _detect_gyro_bias(bias_states: pd.DataFrame, at_rest: pd.Series | None) -> Findings:
    if at_rest is None:
        return
    measured: Array = at_rest[Columns.ANGULAR_RATE].to_numpy()
    estimated: Array = bias_states[Columns.GYRO_BIAS].median().to_numpy()
    axis = int(np.argmax(np.abs(measured - estimated)))
    if abs(measured[axis] - estimated[axis]) < MIN_GYRO_BIAS_RAD_S:
        return
    direction = ("forward", "right", "down (vertical)")[axis]
    yield error(
        "gyroscope_bias",
        f"The gyroscope measures {measured[axis]:+.2f} rad/s about {direction} at rest. EKF2 "
        f"estimates only {estimated[axis]:+.3f} rad/s of this bias in flight (median), so its "
        f"attitude turns by {np.degrees(abs(measured[axis] - estimated[axis])):.0f}°/s.",
        "Calibrate the gyroscopes, and keep the vehicle at rest during the calibration.",
        {"measured_rad_s": float(measured[axis]), "estimated_rad_s": float(estimated[axis])},
    )


def _detect_missing_alignment(analysis: Analysis, ekf2: Ekf2) -> Findings:
    fusing, segment = ekf2.fusion_flags, analysis.segment
    has_own_yaw = analysis.source.frame == "FRD" or (
        isinstance(fusing, pd.DataFrame) and fraction_on(fusing["yaw"], segment) > 0.0
    )
    has_yaw = analysis.source.orientation is not None
    mag_type = analysis.flight.log.parameters.get(MAG.switch)
    magnetometer = "Calibrate the magnetometer"
    if mag_type == NO_MAGNETOMETER:
        magnetometer = f"Enable the magnetometer ({MAG.switch} 0)"
    for flag, quantity, action in (
        ("tilt_align", "tilt", "Keep the vehicle at rest after boot until EKF2 is ready."),
        (
            "yaw_align",
            "heading",
            f"{magnetometer}, or {'' if has_yaw else 'send the orientation of the source and '}"
            "let EKF2 fuse the yaw of the source.",
        ),
    ):
        steps = ekf2.states.get(flag)
        if steps is None or (flag == "yaw_align" and has_own_yaw):
            continue
        unaligned_fraction = 1.0 - fraction_on(steps, segment)
        if unaligned_fraction > MAX_UNALIGNED_FRACTION:
            spans = spans_with_value(0.0, steps, segment)
            until = (
                ""
                if unaligned_fraction > 1.0 - MAX_UNALIGNED_FRACTION
                else f" until {spans[-1][1]:.1f} s"
            )
            yield error(
                "ekf2_not_aligned",
                f"EKF2 has not aligned its {quantity}{until}. cs_{flag} is 0 for "
                f"{format_percent(unaligned_fraction)} of the flight. EKF2 fuses no position "
                f"before {'tilt is' if flag == 'tilt_align' else 'tilt and heading are'} aligned.",
                action,
                {"unaligned_fraction": unaligned_fraction, "flag": flag},
                spans,
            )
