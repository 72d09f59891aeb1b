"""IMU biases that EKF2 cannot estimate, and a tilt or heading that EKF2 did not align."""

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.arrays import Array
from px4fuse.core.text import format_metres
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.model import (
    Findings,
    error,
    format_percent,
    fraction_of_ones,
    spans_with_value,
)
from px4fuse.flight.ekf2_parameters import BAROMETER, MAG, NO_MAGNETOMETER
from px4fuse.flight.model import BODY_AXES, Columns, Ekf2, Flight, Unavailable, rows_between

# Limit parameter, unit, sensor and columns of each bias state of EKF2
BIAS_STATES = (
    ("EKF2_ABL_LIM", "m/s²", "accelerometer", Columns.ACCELEROMETER_BIAS),
    ("EKF2_GYR_B_LIM", "rad/s", "gyroscope", Columns.GYRO_BIAS),
)
# Minimum ratio of a bias state to its limit parameter if the bias is at the limit
MIN_LIMIT_FRACTION = 0.98
# Minimum fraction of the flight with a bias state at its limit for a finding
MIN_LIMITED_FRACTION = 0.5
# Length (s) of the windows in which the IMU is tested for rest
REST_WINDOW_S = 1.0
# Time (s) before take-off in which the motors run, so the IMU is not at rest
RUN_UP_S = 0.5
# Maximum standard deviation of angular rate (rad/s) and specific force (m/s²) at rest
MAX_REST_STDS = (0.04, 1.5)
# Maximum change (rad/s) of the mean angular rate between windows at rest
MAX_REST_CHANGE_RAD_S = 0.01
# Minimum gyroscope bias (rad/s) for a finding: the heading turns by 90° in 30 s
MIN_GYRO_BIAS_RAD_S = 0.05
# Minimum difference (m/s²) between gravity and the specific force at rest that a message states
MIN_GRAVITY_ERROR_M_S2 = 0.3
# Maximum fraction of the flight without tilt or yaw alignment that is not reported
MAX_UNALIGNED_FRACTION = 0.02


def detect(analysis: Analysis) -> Findings:
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2):
        return
    rest_values = measure_imu_at_rest(analysis.flight)
    if not isinstance(ekf2.record, Unavailable):
        bias_states = cut_to_segment(ekf2.record.delayed, analysis.segment)
        if len(bias_states):
            yield from _detect_limited_bias(analysis, ekf2, bias_states, rest_values)
            yield from _detect_gyro_bias(bias_states, rest_values)
    yield from _detect_missing_alignment(analysis, ekf2)


def measure_imu_at_rest(flight: Flight) -> pd.Series | None:
    """Return the median angular rate and specific force at rest before take-off, if known."""
    if not isinstance(flight.imu, pd.DataFrame) or not flight.airborne:
        return None
    if isinstance(flight.airborne, Unavailable):
        return None
    imu = rows_between(flight.imu, -np.inf, flight.airborne[0][0] - RUN_UP_S).astype(np.float64)
    windows = imu.groupby(np.floor(imu.index / REST_WINDOW_S))
    window_means, window_stds = windows.mean(), windows.std()
    is_at_rest = np.ones(len(window_means), bool)
    for columns, limit in zip(
        (Columns.ANGULAR_RATE, Columns.SPECIFIC_FORCE), MAX_REST_STDS, strict=True
    ):
        is_at_rest &= np.linalg.norm(window_stds[columns], axis=1) < limit
    window_means = window_means[is_at_rest]
    if (
        window_means.empty
        or np.ptp(window_means[Columns.ANGULAR_RATE], axis=0).max() > MAX_REST_CHANGE_RAD_S
    ):
        return None
    return window_means.median()


def _detect_limited_bias(
    analysis: Analysis, ekf2: Ekf2, bias_states: pd.DataFrame, rest_values: pd.Series | None
) -> Findings:
    for parameter, unit, sensor, columns in BIAS_STATES:
        limit = ekf2.parameters.get(parameter, 0.0)
        fractions = (bias_states[columns].abs() >= MIN_LIMIT_FRACTION * limit).mean().to_numpy()
        axis_index = int(np.argmax(fractions))
        limited_fraction = float(fractions[axis_index])
        if limit <= 0.0 or limited_fraction < MIN_LIMITED_FRACTION:
            continue
        bias = float(bias_states[columns[axis_index]].median())
        message = (
            f"EKF2's {sensor} bias is at its limit {parameter} {limit:.3g} {unit} for "
            f"{format_percent(limited_fraction)} of the flight. The estimate is {bias:+.3g} "
            f"{unit} {BODY_AXES[axis_index]}; EKF2 cannot estimate a larger bias."
        )
        if sensor == "accelerometer" and rest_values is not None:
            force_m_s2 = float(np.linalg.norm(rest_values[Columns.SPECIFIC_FORCE]))
            if abs(force_m_s2 - constants.g) > MIN_GRAVITY_ERROR_M_S2:
                message += (
                    f" At rest before take-off the accelerometer measures {force_m_s2:.2f} m/s² "
                    f"instead of {constants.g:.2f}. Its bias along the down axis is "
                    f"{constants.g - force_m_s2:+.2f} m/s²."
                )
        yield error(
            "ekf2_bias_at_limit",
            message + (_describe_height_error(analysis, ekf2) if axis_index == 2 else ""),
            f"Calibrate the {sensor}s at the temperature of the flight.",
            {"bias": bias, "limit": limit, "limited_fraction": limited_fraction},
        )


def _describe_height_error(analysis: Analysis, ekf2: Ekf2) -> str:
    error_text, down_comparison = "", analysis.axes.get("down")
    truth = None if down_comparison is None else down_comparison.filters["ekf2"].truth
    if isinstance(truth, ErrorsAgainstTruth):
        error_text = (
            f" EKF2's height RMSE against ground truth is {format_metres(truth.position_rmse_m)} m."
        )
    if (barometer_log := ekf2.aids.get(BAROMETER.name)) is not None:
        innovations = cut_to_segment(barometer_log.samples, analysis.segment)[
            f"innovation_{barometer_log.axes[0]}"
        ]
        error_text += f" Barometer innovations have a mean of {abs(innovations.mean()):.1f} m."
    return error_text


def _detect_gyro_bias(bias_states: pd.DataFrame, rest_values: pd.Series | None) -> Findings:
    if rest_values is None:
        return
    measured_rad_s: Array = rest_values[Columns.ANGULAR_RATE].to_numpy()
    estimated_rad_s: Array = bias_states[Columns.GYRO_BIAS].median().to_numpy()
    axis_index = int(np.argmax(np.abs(measured_rad_s - estimated_rad_s)))
    if abs(measured_rad_s[axis_index] - estimated_rad_s[axis_index]) < MIN_GYRO_BIAS_RAD_S:
        return
    direction = ("forward", "right", "down (vertical)")[axis_index]
    yield error(
        "gyroscope_bias",
        f"The gyroscope measures {measured_rad_s[axis_index]:+.2f} rad/s about {direction} at "
        f"rest. EKF2 estimates only {estimated_rad_s[axis_index]:+.3f} rad/s of this bias in "
        "flight (median), so its attitude turns by "
        f"{np.degrees(abs(measured_rad_s[axis_index] - estimated_rad_s[axis_index])):.0f}°/s.",
        "Calibrate the gyroscopes, and keep the vehicle at rest during the calibration.",
        {
            "measured_rad_s": float(measured_rad_s[axis_index]),
            "estimated_rad_s": float(estimated_rad_s[axis_index]),
        },
    )


def _detect_missing_alignment(analysis: Analysis, ekf2: Ekf2) -> Findings:
    fusion_flags, segment = ekf2.fusion_flags, analysis.segment
    fuses_source_yaw = analysis.source.frame == "FRD" or (
        isinstance(fusion_flags, pd.DataFrame)
        and fraction_of_ones(fusion_flags["yaw"], segment) > 0.0
    )
    has_source_yaw = analysis.source.orientation is not None
    mag_type = analysis.flight.log.parameters.get(MAG.switch)
    magnetometer_action = "Calibrate the magnetometer"
    if mag_type == NO_MAGNETOMETER:
        magnetometer_action = f"Enable the magnetometer ({MAG.switch} 0)"
    for flag, quantity, action in (
        ("tilt_align", "tilt", "Keep the vehicle at rest after boot until EKF2 is ready."),
        (
            "yaw_align",
            "heading",
            f"{magnetometer_action}. Alternatively, "
            f"{'' if has_source_yaw else 'send the orientation of the source, and '}let EKF2 fuse "
            "the yaw of the source.",
        ),
    ):
        alignment_flag = ekf2.states.get(flag)
        if alignment_flag is None or (flag == "yaw_align" and fuses_source_yaw):
            continue
        unaligned_fraction = 1.0 - fraction_of_ones(alignment_flag, segment)
        if unaligned_fraction > MAX_UNALIGNED_FRACTION:
            spans = spans_with_value(0.0, alignment_flag, segment)
            until_text = (
                ""
                if unaligned_fraction > 1.0 - MAX_UNALIGNED_FRACTION
                else f" until {spans[-1][1]:.1f} s"
            )
            yield error(
                "ekf2_not_aligned",
                f"EKF2 has not aligned its {quantity}{until_text}. cs_{flag} is 0 for "
                f"{format_percent(unaligned_fraction)} of the flight. EKF2 fuses no position "
                f"before {'tilt is' if flag == 'tilt_align' else 'tilt and heading are'} aligned.",
                action,
                {"unaligned_fraction": unaligned_fraction, "flag": flag},
                spans,
            )
