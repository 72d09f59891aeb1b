"""Positions that are not measurements: zeros, repeated, rounded, alternating or copied values."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline

from px4fuse.analysis import Analysis
from px4fuse.comparison.flight_events import compute_max_interval_s
from px4fuse.comparison.remedy import find_aid, format_changes, is_source_fused
from px4fuse.convention.correction import find_convention_faults
from px4fuse.convention.lever_arm import (
    IMU_POSITION_PARAMETERS,
    estimate_lever_arm,
    find_imu_position_m,
)
from px4fuse.core.arrays import rms
from px4fuse.core.text import format_metres
from px4fuse.ekf2.model import misalign_positions, replay_with_settings
from px4fuse.ekf2.replay import Ekf2Replay, rows_inside
from px4fuse.finding import format_spans
from px4fuse.flight.model import Columns, Ekf2, Truth, Unavailable
from px4fuse.readers.px4_positions import NO_FIX_ACTION

from .model import (
    NO_ESTIMATES_SENTENCE,
    Findings,
    find_source_texts,
    make_error,
    make_note,
    make_warning,
)
from .source_intervals import describe_errors_after_gap

# Rounding to smaller steps (m) is not reported: its errors are below the noise of UWB
MIN_QUANTISATION_STEP_M = 0.05
# Maximum ratio of EKF2's position RMSE with the estimated lever arm to the RMSE without it
MAX_RMSE_RATIO_WITH_TO_WITHOUT_LEVER_ARM = 0.7
# The finding on a wrong lever arm also states a rotation of the positions if the angle exceeds both
# limits: degrees, and multiples of its σ
MIN_ROTATION_DEG, MIN_ROTATION_SIGMAS = 5.0, 3.0
# Minimum distance (m) between the positions of two alternating senders: less may be noise
MIN_SENDER_DISTANCE_M = 0.1
# Minimum distance between the positions of two senders ÷ scatter (1 σ) of this distance. With a
# single sender, noise causes ratios of up to 2
MIN_SENDER_DISTANCE_SIGMAS = 4.0
# Length (samples) of the windows in which even samples are compared with odd samples, to detect two
# alternating senders: short, because a lost sample exchanges even and odd
WINDOW_SAMPLES = 16
# Minimum number of windows of WINDOW_SAMPLES samples in a flight, to detect two senders
MIN_SAMPLE_WINDOWS_TO_DETECT_TWO_SENDERS = 10
# Positions are copies of EKF2's estimate if their median distance (m) from the estimate is below
# this limit
MAX_DISTANCE_OF_COPY_M = 0.01
# Stricter limit (m) than MAX_DISTANCE_OF_COPY_M if EKF2 fuses the positions: the fusion alone pulls
# EKF2's estimate towards the positions
MAX_DISTANCE_OF_FUSED_COPY_M = 0.001
# To find positions that are copies of EKF2's position, both are compared only above this speed
# (m/s): at rest, a correct source agrees too
MIN_SPEED_TO_DETECT_COPIED_ESTIMATE_M_S = 0.2
# Tested delays (s) of positions that are copies of EKF2's position
TESTED_DELAYS_OF_COPIED_ESTIMATE_S = np.arange(0.0, 0.305, 0.005)
# Approximate number of positions with which px4fuse estimates the delay of positions that are
# copies of EKF2's position
POSITION_COUNT_TO_FIND_DELAY_OF_COPY = 300
# Finding id, fault and action for each reason of an invalid position
INVALID_POSITION_TEXTS: Mapping[str, tuple[str, str, str]] = {
    "zero": (
        "source_zero_positions",
        "are exactly 0, 0, 0: the source sends zeros when it has no position",
        "Send nothing, or NaN, while the position is unknown.",
    ),
    "held": (
        "source_position_held",
        "are repetitions of the last position: the source lost tracking",
        "Stop sending, or send NaN, while tracking is lost.",
    ),
    "far": (
        "source_without_position",
        "are more than 10 km from the other positions: wrong origin, or no fix",
        "",
    ),
    "no fix": ("source_without_position", "were measured without a 3D fix", NO_FIX_ACTION),
    "NaN": ("source_without_position", "are NaN: the source had no fix", ""),
}


def detect(analysis: Analysis) -> Findings:
    yield from detect_invalid_positions(analysis)
    yield from detect_rounding(analysis)
    yield from detect_lever_arm(analysis)
    yield from detect_two_senders(analysis)
    yield from detect_copied_estimate(analysis)


def detect_invalid_positions(analysis: Analysis) -> Findings:
    """Detect positions that are zero, repeated, far away, NaN or measured without a fix."""
    source, segment = analysis.source, analysis.segment
    invalid_reasons = source.invalid_reasons[segment.start_s : segment.end_s]
    for reason, (name, fault, action) in INVALID_POSITION_TEXTS.items():
        time_s = invalid_reasons.index[invalid_reasons == reason].to_series()
        if time_s.empty:
            continue
        # Invalid positions without a valid position between them form one time span: they have the
        # same number of earlier valid positions
        valid_counts = np.searchsorted(source.samples.index, time_s)
        times_by_span = time_s.groupby(valid_counts)
        spans = tuple(zip(times_by_span.min().tolist(), times_by_span.max().tolist(), strict=True))
        start_s, end_s = max(spans, key=lambda span: span[1] - span[0])
        total_s = sum(end - start for start, end in spans)
        # Single NaN are a usual way to send that a position is unknown
        is_long = end_s - start_s > compute_max_interval_s(1.0 / source.compute_rate_hz())
        make_finding = make_note if reason == "NaN" and not is_long else make_warning
        error_text = ""
        if is_long:
            # Gap in KF's positions: last position before the span, and first position after it. At
            # the start or end of the flight, use the first or last interval between positions
            valid_times_s = analysis.input_axes[0].measurement_time_s
            start_row, end_row = np.clip(
                np.searchsorted(valid_times_s, (start_s, end_s)), 1, len(valid_times_s) - 1
            )
            gap_span_s = float(valid_times_s[start_row - 1]), float(valid_times_s[end_row])
            error_text = f" {describe_errors_after_gap(analysis, gap_span_s)}"
        yield make_finding(
            name,
            f"{len(time_s)} {source.positions_text} {fault}. Times: {format_spans(spans)} "
            f"({total_s:.1f} s in total). KF does not use these positions.{error_text}",
            action or f"{find_source_texts(analysis).data_link_check} at {start_s:.1f} s.",
            {
                "count": len(time_s),
                "longest_s": end_s - start_s,
                "total_s": total_s,
                "at_s": start_s,
            },
            spans,
        )


def detect_rounding(analysis: Analysis) -> Findings:
    """Detect positions that are rounded to coarse steps."""
    source, step_m = analysis.source, analysis.source.quantisation_step_m
    if step_m < MIN_QUANTISATION_STEP_M:
        return
    cause_text, action = "", "Send the positions with more digits."
    if np.log2(step_m) % 1.0 == 0.0:
        cause_text = " Possible cause: large coordinates (UTM) in 32-bit floats."
        action += " Subtract a local origin before the conversion from 64-bit to 32-bit floats."
    yield make_warning(
        "source_positions_rounded",
        f"{source.positions_text} are rounded to steps of {step_m:.3g} m.{cause_text} The "
        f"rounding error is {step_m / 12.0**0.5:.2g} m (1 σ) and correlated in time. "
        f"{NO_ESTIMATES_SENTENCE}",
        action,
        {"step_m": step_m},
    )


def detect_lever_arm(analysis: Analysis) -> Findings:
    """Detect a wrong lever arm of the position sensor in EKF2's parameters."""
    source, convention = analysis.source, analysis.convention
    has_truth = isinstance(analysis.flight.truth, Truth)
    is_convention_determined = convention is not None and convention.verdict == "determined"
    if not source.origin.has_all_samples or not (has_truth or is_convention_determined):
        return
    lever_arm = estimate_lever_arm(analysis.flight, source)
    if lever_arm is None:
        return
    # Forward and right (m): error of the lever arm from IMU to sensor. Either the parameters of the
    # sensor position are wrong, or those of the IMU position
    imu_position_m, arm_m = find_imu_position_m(analysis.flight), np.array(lever_arm[:2])
    sensor_change, imu_change = (
        # + 0.0 replaces -0.0 by 0.0. The parameters for down are not changed
        dict(zip(names[:2], (position_m.round(2) + 0.0).tolist(), strict=True))
        for names, position_m in (
            (find_aid(analysis).lever_arm, source.lever_arm_m[:2] + arm_m),
            (IMU_POSITION_PARAMETERS, imu_position_m[:2] - arm_m),
        )
    )
    rotation_deg = (
        lever_arm.rotation_deg
        + find_convention_faults(convention, analysis.flight, source.frame).rotation_deg
    )
    if abs(rotation_deg) < max(
        MIN_ROTATION_DEG, MIN_ROTATION_SIGMAS * lever_arm.rotation_sigma_deg
    ):
        rotation_deg = 0.0
    # Either the sensor position or the IMU position is set wrongly. If replays are possible, choose
    # the change that reduces the position error
    effect_sentence = _describe_replayed_effect(analysis, sensor_change, rotation_deg)
    if effect_sentence is not None:
        sensor_text, error_text = f"{source.kind_name} sensor", "the position error"
        action = f"Set {format_changes(sensor_change)}."
        if any(imu_position_m) and not has_truth:
            action += (
                " If the sensor position parameters are right, the IMU position is wrong: set "
                f"{format_changes(imu_change)} instead."
            )
    else:
        effect_sentence = _describe_replayed_effect(analysis, imu_change, rotation_deg)
        if effect_sentence is None:
            return
        sensor_text, error_text = "IMU", "EKF2's position error"
        action = f"Set {format_changes(imu_change)}."
        arm_m = -arm_m
    forward_m, right_m = (arm_m.round(2) + 0.0).tolist()
    if source.alignment is not None:  # no EKF2 parameter corrects positions of a file
        sensor_text = "sensor"
        action = "Subtract this lever arm, rotated to NED by the attitude, from the positions."
    rotation_sentence = ""
    if rotation_deg:
        rotation_sentence = (
            f"{source.positions_text} are rotated by {rotation_deg:+.0f}° (clockwise from above). "
        )
        action = f"Rotate the positions by {-rotation_deg:+.0f}° before they are sent. {action}"
    yield make_warning(
        "source_lever_arm",
        f"{rotation_sentence}The {sensor_text} is mounted {np.hypot(forward_m, right_m):.2f} m "
        f"from the mounting point that EKF2 assumes: {forward_m:+.2f} m forward, {right_m:+.2f} m "
        f"right (± {1.96 * lever_arm.sigma_m:.2f} m, 95 %). When the vehicle turns, {error_text} "
        f"changes by up to twice this distance. {effect_sentence}{NO_ESTIMATES_SENTENCE}",
        f"{action} Measure the position of the sensor relative to the IMU.",
        {"forward_m": forward_m, "right_m": right_m, "sigma_m": lever_arm.sigma_m},
    )


def _describe_replayed_effect(
    analysis: Analysis, change: Mapping[str, float], rotation_deg: float = 0.0
) -> str | None:
    """Describe EKF2's position RMSE in replays without and with a change of a lever arm.

    ``rotation_deg`` is the detected rotation error of the positions (clockwise from above). Both
    replays use corrected positions, rotated by -``rotation_deg``. Return "" if no replay or ground
    truth is available, and None if the change reduces the RMSE too little.
    """
    ekf2_model, truth = analysis.ekf2_model, analysis.flight.truth
    if (
        isinstance(ekf2_model, Unavailable)
        or isinstance(truth, Unavailable)
        or not ekf2_model.agreement.good
        or not is_source_fused(analysis, ekf2_model.inputs)
    ):
        return ""
    # The baseline replay already exists for positions that are not rotated
    baseline_replay = ekf2_model.baseline_replay
    if rotation_deg:
        ekf2_model = misalign_positions(ekf2_model, -rotation_deg, 0.0)
        (baseline_replay,) = replay_with_settings(ekf2_model, [{}])
    # The EKF2 model does not read the position of the IMU from the parameters: change its inputs
    if change.keys() <= {*IMU_POSITION_PARAMETERS}:
        imu_offset_m = np.array([*change.values(), ekf2_model.inputs.imu_offset_m[2]])
        inputs = replace(ekf2_model.inputs, imu_offset_m=imu_offset_m)
        ekf2_model, change = replace(ekf2_model, inputs=inputs, runs=()), {}
    (changed_replay,) = replay_with_settings(ekf2_model, [change])
    before_m, after_m = (
        _compute_horizontal_rmse_m(replay, truth) for replay in (baseline_replay, changed_replay)
    )
    if after_m > MAX_RMSE_RATIO_WITH_TO_WITHOUT_LEVER_ARM * before_m:
        return None
    return (
        "Replay of EKF2 with this lever arm: horizontal position RMSE "
        f"{format_metres(before_m)} m → {format_metres(after_m)} m. "
    )


def _compute_horizontal_rmse_m(replay: Ekf2Replay, truth: Truth) -> float:
    """Return the horizontal position RMSE (m) of an EKF2 replay against ground truth."""
    track = rows_inside(replay.published_state, replay.find_evaluated_spans())
    errors_m = (
        track[name] - np.interp(track.index, truth.samples.index, truth.samples[name])
        for name in Columns.POSITION[:2]
    )
    return rms(np.hypot(*errors_m))


def detect_two_senders(analysis: Analysis) -> Findings:
    """Detect two senders whose positions alternate."""
    samples = analysis.source_samples[Columns.POSITION].dropna(axis=1, how="all").dropna()
    window_count, rate_hz = (len(samples) - 2) // WINDOW_SAMPLES, analysis.source.compute_rate_hz()
    if window_count < MIN_SAMPLE_WINDOWS_TO_DETECT_TWO_SENDERS:
        return
    time_s, position_m = samples.index.to_numpy(), samples.to_numpy()
    weight = ((time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2]))[:, None]
    # Deviation of each position from the line through the previous and the next position. With two
    # senders, it alternates between ± their distance: invert every other deviation
    deviations_m = position_m[1:-1] - (1.0 - weight) * position_m[:-2] - weight * position_m[2:]
    deviations_m[::2] *= -1.0
    deviation_windows_m = deviations_m[: window_count * WINDOW_SAMPLES].reshape(
        window_count, WINDOW_SAMPLES, -1
    )
    window_medians_m = np.median(deviation_windows_m, axis=1)
    # After a lost sample, even and odd samples change roles, so later medians change sign. Invert
    # the medians that point away from the largest median
    largest_median_deviation_m = window_medians_m[
        np.argmax(np.linalg.norm(window_medians_m, axis=1))
    ]
    window_medians_m[window_medians_m @ largest_median_deviation_m < 0.0] *= -1.0
    difference_between_senders_m = np.median(window_medians_m, axis=0)
    # σ from the median absolute deviation
    scatter_m = (
        1.4826 * np.median(np.abs(window_medians_m - difference_between_senders_m), axis=0).max()
    )
    distance_m = float(np.linalg.norm(difference_between_senders_m))
    if distance_m < max(MIN_SENDER_DISTANCE_M, MIN_SENDER_DISTANCE_SIGMAS * scatter_m):
        return
    distances_text = ", ".join(
        f"{abs(part):.2f} m {name.partition('_')[0]}"
        for part, name in zip(difference_between_senders_m, samples.columns, strict=True)
    )
    yield make_error(
        "source_two_senders",
        f"Two systems alternately send positions that differ by {distance_m:.2f} m. After "
        f"subtraction of the vehicle's motion, successive {analysis.source.positions_text} "
        f"({rate_hz:.3g} Hz in total) differ by {distances_text}. {NO_ESTIMATES_SENTENCE}",
        "Send the positions of one system only: stop the second node, bridge or MAVROS plugin.",
        {"distance_m": distance_m, "rate_hz": rate_hz},
    )


def detect_copied_estimate(analysis: Analysis) -> Findings:
    """Detect positions that are EKF2's own position, sent back to the autopilot."""
    source, ekf2, segment = analysis.source, analysis.flight.ekf2, analysis.segment
    if not isinstance(ekf2, Ekf2) or source.alignment is not None or source.origin.reconstructed:
        return
    samples, state = analysis.source_samples[Columns.POSITION].dropna(), ekf2.state.dropna()
    if len(samples) < WINDOW_SAMPLES or len(state) < WINDOW_SAMPLES:
        return
    ekf2_position_spline = CubicHermiteSpline(
        state.index, state[Columns.POSITION], state[Columns.VELOCITY]
    )

    def compute_median_distance_m(positions: pd.DataFrame, delay_s: float) -> float:
        """Return the median distance (m) of positions from EKF2's position at earlier times.

        The times are earlier by ``delay_s``.
        """
        time_s = positions.index.to_numpy() - delay_s
        is_moving = (
            np.linalg.norm(ekf2_position_spline(time_s, 1), axis=1)
            > MIN_SPEED_TO_DETECT_COPIED_ESTIMATE_M_S
        )
        is_inside = (time_s > state.index[0]) & (time_s < state.index[-1]) & is_moving
        if np.count_nonzero(is_inside) < WINDOW_SAMPLES:
            return np.inf
        distance_m = np.linalg.norm(positions - ekf2_position_spline(time_s), axis=1)
        return float(np.median(distance_m[is_inside]))

    # To find the delay of positions that are copies of EKF2's position, some positions are
    # sufficient
    some_samples = samples[:: max(1, len(samples) // POSITION_COUNT_TO_FIND_DELAY_OF_COPY)]
    delay_s = min(
        TESTED_DELAYS_OF_COPIED_ESTIMATE_S.tolist(),
        key=lambda delay_s: compute_median_distance_m(some_samples, delay_s),
    )
    distance_m = compute_median_distance_m(samples, delay_s)
    fusion_flags = ekf2.fusion_flags
    is_fused = isinstance(fusion_flags, Unavailable) or bool(
        (fusion_flags["horizontal"][segment.start_s : segment.end_s] > 0.0).any()
    )
    if distance_m >= (MAX_DISTANCE_OF_FUSED_COPY_M if is_fused else MAX_DISTANCE_OF_COPY_M):
        return
    orientation = analysis.convention.orientation if analysis.convention else None
    is_attitude_copied = orientation is not None and orientation.verdict == "copied"
    yield make_error(
        "source_is_ekf2_estimate",
        f"{source.kind_name} sends EKF2's own position"
        f"{' and attitude' if is_attitude_copied else ''} back. "
        f"The positions equal those that EKF2 estimated {1e3 * delay_s:.0f} ms before "
        f"(median difference {1e3 * distance_m:.1f} mm). These copies are not measurements.",
        "Send the position of the positioning system. Do not connect the autopilot's local "
        "position (MAVROS local_position) to its vision input.",
        {"delay_s": delay_s, "difference_m": distance_m},
    )
