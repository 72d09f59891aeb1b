"""State of EKF2: resets, instance changes, biases that it cannot estimate, missing alignment."""

import math

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.analysis import Analysis
from px4fuse.comparison.flight_events import find_airborne_spans
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.text import format_metres
from px4fuse.filter.signals import Segment, cut_to_segment
from px4fuse.flight.ekf2_parameters import BAROMETER, MAG
from px4fuse.flight.model import (
    BODY_AXES,
    Columns,
    Ekf2,
    Flight,
    PositionTrack,
    Reset,
    Unavailable,
    rows_between,
)

from .model import (
    CAUSE_KEY,
    SOURCE_GAP_CAUSE,
    UNKNOWN_CAUSE,
    Findings,
    compute_flag_fraction,
    find_spans_with_value,
    finding,
    format_occurrences,
    format_percent,
    magnetometer_advice,
    make_error,
    make_warning,
    make_zero_length_spans,
)

# Parameter that limits a bias estimate, its unit, sensor, and columns of the bias
BIAS_LIMIT_PARAMETERS = (
    ("EKF2_ABL_LIM", "m/s²", "accelerometer", Columns.ACCELEROMETER_BIAS),
    ("EKF2_GYR_B_LIM", "rad/s", "gyroscope", Columns.GYRO_BIAS),
)
# A bias is at its limit if bias ÷ limit parameter is at least this ratio
MIN_BIAS_TO_LIMIT_RATIO = 0.98
# Minimum fraction of the flight in which EKF2's accelerometer or gyroscope bias is at its limit,
# for a finding
MIN_TIME_AT_LIMIT_FRACTION = 0.5
# Length (s) of the windows in which px4fuse tests if the vehicle is at rest before take-off
REST_WINDOW_S = 1.0
# Time (s) before take-off in which the motors run
MOTOR_RUN_UP_DURATION_S = 0.5
# Detection of rest before take-off: maximum standard deviation of angular rate (rad/s) and specific
# force (m/s²) in a window
MAX_ANGULAR_RATE_STD_AT_REST_RAD_S, MAX_SPECIFIC_FORCE_STD_AT_REST_M_S2 = 0.04, 1.5
# Detection of rest before take-off: maximum change (rad/s) of the mean angular rate between windows
MAX_ANGULAR_RATE_CHANGE_AT_REST_RAD_S = 0.01
# Minimum difference (rad/s) between the angular rate measured at rest and EKF2's gyroscope bias,
# for a finding: it causes an attitude error of 86° in 30 s
MIN_GYRO_BIAS_RAD_S = 0.05
# If EKF2's accelerometer bias is at its limit, and the specific force measured at rest differs from
# gravity by more than this value (m/s²), the message states the specific force
MIN_GRAVITY_ERROR_M_S2 = 0.3
# EKF2's tilt or heading is reported as not aligned only if this fraction of the flight and the next
# limit are both exceeded
MAX_UNALIGNED_ATTITUDE_FRACTION = 0.02
# Maximum time (s) from EKF2's tilt alignment to its heading alignment, without a finding
MAX_HEADING_ALIGNMENT_DELAY_S = 5.0
# Height resets of EKF2 up to this time (s) after take-off are normal
TAKE_OFF_DURATION_S = 10.0
# Maximum time (s) from the end of a position gap to the EKF2 reset that it causes
MAX_RESET_DELAY_S = 5.0
# A reset of EKF2 up to this time (s) after the start of fusion is normal: flags are logged at 1 Hz
MAX_FUSION_START_TO_RESET_S = 1.0


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on EKF2's state: resets, instance switches, IMU biases, alignment."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2):
        return
    yield from detect_resets(analysis, ekf2)
    yield from detect_instance_switches(ekf2, analysis.segment.whole_flight)
    median_imu_at_rest = measure_imu_at_rest(analysis.flight)
    if not isinstance(ekf2.record, Unavailable):
        bias_states = cut_to_segment(ekf2.record.delayed_state, analysis.segment)
        if len(bias_states):
            yield from _detect_bias_at_limit(analysis, ekf2, bias_states, median_imu_at_rest)
            yield from _detect_gyro_bias(bias_states, median_imu_at_rest)
    yield from detect_missing_alignment(analysis.flight, analysis.segment, analysis.source)


def measure_imu_at_rest(flight: Flight) -> pd.Series | None:
    """Return the median angular rate and specific force at rest before take-off, if known."""
    airborne_spans = find_airborne_spans(flight)
    if isinstance(flight.imu, Unavailable) or not airborne_spans:
        return None
    end_s = airborne_spans[0][0] - MOTOR_RUN_UP_DURATION_S
    imu = rows_between(flight.imu, -np.inf, end_s).astype(np.float64)
    windows = imu.groupby(np.floor(imu.index / REST_WINDOW_S))
    stds = windows.std()
    is_rate_constant = (
        np.linalg.norm(stds[Columns.ANGULAR_RATE], axis=1) < MAX_ANGULAR_RATE_STD_AT_REST_RAD_S
    )
    is_force_constant = (
        np.linalg.norm(stds[Columns.SPECIFIC_FORCE], axis=1) < MAX_SPECIFIC_FORCE_STD_AT_REST_M_S2
    )
    means: pd.DataFrame = windows.mean()[is_rate_constant & is_force_constant]
    rates_rad_s = means[Columns.ANGULAR_RATE]
    if means.empty or np.ptp(rates_rad_s, axis=0).max() > MAX_ANGULAR_RATE_CHANGE_AT_REST_RAD_S:
        return None
    return means.median()


def _detect_bias_at_limit(
    analysis: Analysis, ekf2: Ekf2, bias_states: pd.DataFrame, median_imu_at_rest: pd.Series | None
) -> Findings:
    """Detect an IMU bias estimate that is at EKF2's limit for at least half of the flight."""
    for parameter, unit, sensor, columns in BIAS_LIMIT_PARAMETERS:
        limit = ekf2.parameters.get(parameter, 0.0)
        # Fraction of the time with the bias at its limit, for each axis; then the largest of them
        fractions = (bias_states[columns].abs() >= MIN_BIAS_TO_LIMIT_RATIO * limit).mean()
        axis_index = int(np.argmax(fractions))
        time_at_limit_fraction = float(fractions.iloc[axis_index])
        if limit <= 0.0 or time_at_limit_fraction < MIN_TIME_AT_LIMIT_FRACTION:
            continue
        median_bias = float(bias_states[columns[axis_index]].median())
        is_vertical = BODY_AXES[axis_index] == "down"
        message = (
            f"EKF2's {sensor} bias is at its limit {parameter} {limit:.3g} {unit} for "
            f"{format_percent(time_at_limit_fraction)} of the flight. The bias estimate is "
            f"{median_bias:+.3g} {unit} {BODY_AXES[axis_index]}."
        )
        # Other data that show the bias or its effect: IMU at rest, ground truth, and barometer
        if sensor == "accelerometer" and median_imu_at_rest is not None:
            force_m_s2 = np.linalg.norm(median_imu_at_rest[Columns.SPECIFIC_FORCE])
            if abs(force_m_s2 - constants.g) > MIN_GRAVITY_ERROR_M_S2:
                message += (
                    f" At rest before take-off the accelerometer measures {force_m_s2:.2f} m/s² "
                    f"instead of {constants.g:.2f} (bias {constants.g - force_m_s2:+.2f} m/s² "
                    "down)."
                )
        if is_vertical and (down_comparison := analysis.axes.get("down")) is not None:
            truth = down_comparison.filters["ekf2"].truth
            if isinstance(truth, ErrorsAgainstTruth):
                message += (
                    " EKF2's height RMSE against ground truth is "
                    f"{format_metres(truth.position_rmse_m)} m."
                )
        if is_vertical and (barometer_log := ekf2.aids.get(BAROMETER.name)) is not None:
            innovations = cut_to_segment(barometer_log.samples, analysis.segment)[
                f"innovation_{barometer_log.axes[0]}"
            ]
            message += f" Barometer innovations have a mean of {abs(innovations.mean()):.1f} m."
        yield make_error(
            "ekf2_bias_at_limit",
            message,
            f"Calibrate the {sensor}s at the temperature of the flight.",
            {"bias": median_bias, "limit": limit, "limited_fraction": time_at_limit_fraction},
        )


def _detect_gyro_bias(bias_states: pd.DataFrame, median_imu_at_rest: pd.Series | None) -> Findings:
    if median_imu_at_rest is None:
        return
    biases_rad_s = zip(
        median_imu_at_rest[Columns.ANGULAR_RATE].tolist(),
        bias_states[Columns.GYRO_BIAS].median().tolist(),
        ("forward", "right", "down (vertical)"),
        strict=True,
    )
    measured, estimated, direction = max(biases_rad_s, key=lambda item: abs(item[0] - item[1]))
    if abs(measured - estimated) < MIN_GYRO_BIAS_RAD_S:
        return
    yield make_error(
        "gyroscope_bias",
        f"The gyroscope measures {measured:+.2f} rad/s about {direction} at rest. EKF2 estimates "
        f"only {estimated:+.3f} rad/s of this bias in flight (median), so EKF2's attitude drifts "
        f"by {math.degrees(abs(measured - estimated)):.0f}°/s.",
        "Calibrate the gyroscopes while the vehicle is at rest.",
        {"measured_rad_s": measured, "estimated_rad_s": estimated},
    )


def detect_missing_alignment(
    flight: Flight, segment: Segment, source: PositionTrack | None = None
) -> Findings:
    """Detect that EKF2 aligned its tilt or its heading late or never.

    Heading alignment is not tested if EKF2 takes its heading from the position source.
    """
    ekf2 = flight.ekf2
    if not isinstance(ekf2, Ekf2):
        return
    fusion_flags = ekf2.fusion_flags
    fuses_source_yaw = (source is not None and source.frame == "FRD") or (
        isinstance(fusion_flags, pd.DataFrame)
        and compute_flag_fraction(fusion_flags["yaw"], segment) > 0.0
    )
    tilt_action = "Keep the vehicle at rest after boot until EKF2 is ready."
    quantities = [("tilt_align", "tilt", tilt_action)]
    if not fuses_source_yaw:
        heading_action = _find_heading_action(flight, source)
        quantities.append(("yaw_align", "heading", heading_action))
    # EKF2 aligns the heading after the tilt, so the time until tilt alignment does not count as
    # delay of the heading alignment
    alignment_end_s = segment.start_s
    for flag, quantity, action in quantities:
        if flag not in ekf2.status_flags:
            continue
        spans = find_spans_with_value(0.0, ekf2.status_flags[flag], segment)
        unaligned_fraction = 1.0 - compute_flag_fraction(ekf2.status_flags[flag], segment)
        if (
            unaligned_fraction > MAX_UNALIGNED_ATTITUDE_FRACTION
            and spans[-1][1] > alignment_end_s + MAX_HEADING_ALIGNMENT_DELAY_S
        ):
            alignment_end_s = spans[-1][1]
            until_text = (
                f" until {alignment_end_s:.1f} s" if alignment_end_s < segment.end_s else ""
            )
            yield make_error(
                "ekf2_not_aligned",
                f"EKF2 has not aligned its {quantity}{until_text}. cs_{flag} is 0 for "
                f"{format_percent(unaligned_fraction)} of the flight. EKF2 fuses no position "
                "before this alignment.",
                action,
                {"unaligned_fraction": unaligned_fraction, "flag": flag},
                spans,
            )


def _find_heading_action(flight: Flight, source: PositionTrack | None) -> str:
    """Return the action for a missing heading alignment."""
    action = magnetometer_advice(flight) or f"Enable the magnetometer ({MAG.switch} 0)."
    if source is None or not source.origin.is_vision:
        return action
    sending_text = ""
    if source.orientation is None:
        sending_text = "send the orientation, which is missing or constant, and "
    return (
        f"{action} Alternatively, {sending_text}let EKF2 fuse the yaw of the source (EKF2_EV_CTRL "
        "bit 3)."
    )


def detect_resets(analysis: Analysis, ekf2: Ekf2) -> Findings:
    """Detect resets of EKF2's position and height, except normal ones at take-off."""
    segment = analysis.segment.whole_flight
    # Resets up to the start of fusion are normal. If the log shows that EKF2 never fused positions,
    # this time is NaN, and every reset counts
    fusion_start_s = -math.inf
    if isinstance(ekf2.fusion_flags, pd.DataFrame):
        is_fused = ekf2.fusion_flags["horizontal"] > 0.0
        fusion_start_s = is_fused.index[is_fused].min() + MAX_FUSION_START_TO_RESET_S
    position_resets = [
        reset
        for reset in ekf2.resets
        if segment.start_s < reset.time_s <= segment.end_s
        and reset.quantity == "position"
        and any(reset.delta)
        and not _is_take_off_height_reset(analysis, reset)
        and not reset.time_s <= fusion_start_s
    ]
    if position_resets:
        horizontal_resets = [reset for reset in position_resets if any(reset.delta[:2])]
        resets = horizontal_resets or position_resets
        # True if each reset follows a gap in the positions
        resets_follow_gaps = all(
            any(
                start <= reset.time_s <= end + MAX_RESET_DELAY_S
                for start, end in analysis.events.gaps
            )
            for reset in resets
        )
        largest_reset = max(resets, key=lambda reset: math.hypot(*reset.delta))
        largest_reset_m, time_s = math.hypot(*largest_reset.delta), largest_reset.time_s
        yield finding(
            "warning" if horizontal_resets else "note",
            "ekf2_resets",
            f"EKF2 reset its {'horizontal position' if horizontal_resets else 'height'} "
            f"{format_occurrences(len(resets))} (largest reset: {largest_reset_m:.2f} m at "
            f"{time_s:.1f} s).",
            f"Run px4fuse explore LOG and compare position and innovation at {time_s:.1f} s.",
            {
                "count": len(resets),
                "largest_m": largest_reset_m,
                "at_s": time_s,
                CAUSE_KEY: SOURCE_GAP_CAUSE if resets_follow_gaps else UNKNOWN_CAUSE,
            },
            make_zero_length_spans(reset.time_s for reset in resets),
        )


def detect_instance_switches(ekf2: Ekf2, segment: Segment) -> Findings:
    """Detect changes of the primary EKF2 instance in a segment."""
    switch_times_s = [
        time for time, _ in ekf2.primary_instances if segment.start_s < time <= segment.end_s
    ]
    if switch_times_s:
        yield make_warning(
            "ekf2_instance_switch",
            f"The primary EKF2 instance changed {format_occurrences(len(switch_times_s))}, first "
            f"at {switch_times_s[0]:.1f} s. The comparison uses the primary instance at each time.",
            "Compare vibration and clipping of the IMUs (vehicle_imu_status). For a lab flight set "
            "EKF2_MULTI_IMU to 1: EKF2 then uses one IMU.",
            {"count": len(switch_times_s), "at_s": switch_times_s[0]},
            make_zero_length_spans(switch_times_s),
        )


def _is_take_off_height_reset(analysis: Analysis, reset: Reset) -> bool:
    """Return True for a reset of the height only, shortly after take-off."""
    return not any(reset.delta[:2]) and any(
        start_s <= reset.time_s <= start_s + TAKE_OFF_DURATION_S
        for start_s, _ in find_airborne_spans(analysis.flight)
    )
