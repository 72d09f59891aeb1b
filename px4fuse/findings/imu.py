"""Faults of the IMU data (bias, clipping, gaps, low rate), and excessive roll or pitch."""

import math

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.analysis import Analysis
from px4fuse.core.arrays import select_intervals
from px4fuse.core.record import Span
from px4fuse.ekf2.inputs import MAX_MISSING_IMU_FRACTION, compute_lost_imu_fraction
from px4fuse.filter.hypotheses import (
    MIN_REPORTED_ACCELEROMETER_BIAS_M_S2,
    SystematicErrors,
    estimate_mean_acceleration_error,
)
from px4fuse.filter.signals import Segment, cut_to_segment, find_imu_gaps
from px4fuse.finding import MIN_SPAN_S
from px4fuse.flight.model import Columns, Ekf2, Flight, Unavailable, compute_sample_rate_hz

from .model import (
    Findings,
    error_if,
    finding,
    format_percent,
    make_error,
    make_warning,
)
from .recording import DEFAULT_SDLOG_PROFILE, VISION_PROFILE_MASK

# Maximum specific force (m/s²) of real sensors: 35 g, because the largest range is 32 g
MAX_PLAUSIBLE_SPECIFIC_FORCE_M_S2 = 343.0
# Specific forces above MAX_PLAUSIBLE_SPECIFIC_FORCE_M_S2 are reported if they occur in at least
# this number of samples
MIN_IMPLAUSIBLE_FORCE_SAMPLES = 3
# Minimum accelerometer bias (m/s²) for severity "error"; it causes an error of 0.15 m in 1 s
MIN_SEVERE_BIAS_M_S2 = 0.3
# Tilt error (°) that has the same effect as an accelerometer bias of 1 m/s²
TILT_DEG_PER_M_S2 = float(np.degrees(1.0 / 9.80665))
# Minimum time (s) without IMU samples for a finding: two prediction steps of KF
MIN_REPORTED_IMU_GAP_S = 0.2
# Minimum IMU rate (Hz): 5 samples in each DT of 0.1 s, so that vibration is not aliased
MIN_IMU_RATE_HZ = 50.0
# Minimum attitude rate (Hz) for interpolation of the attitude
MIN_ATTITUDE_RATE_HZ = 10.0
# Maximum normal duration (s) of clipping: a touch-down clips one or two samples
MAX_CLIPPING_DURATION_S = 0.1
# Clipped samples with at most this time (s) between them are in one time span of the finding
MIN_TIME_BETWEEN_CLIPPINGS_S = 2.0
# Mask of SDLOG_PROFILE, bit 4: full IMU rate (logged_topics.cpp)
SDLOG_HIGH_RATE_MASK = 16
# Minimum ratio of measured to required sample rate: sensors are up to 2 % slower than nominal
MIN_MEASURED_TO_REQUIRED_RATE_RATIO = 0.98


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on IMU data, attitude rate and excessive tilt."""
    yield from detect_impossible_acceleration(analysis)
    yield from detect_tumbling(analysis)
    yield from detect_accelerometer_bias(analysis)
    yield from detect_clipping(analysis)
    yield from detect_missing_imu_samples(analysis)
    yield from detect_imu_gaps(analysis)
    yield from detect_low_rates(analysis.flight)


def detect_impossible_acceleration(analysis: Analysis) -> Findings:
    """Detect accelerations that no accelerometer of an autopilot can measure."""
    imu = analysis.flight.imu
    if isinstance(imu, Unavailable):
        return
    samples = cut_to_segment(imu, analysis.segment)[Columns.SPECIFIC_FORCE]
    force_m_s2 = np.linalg.norm(samples, axis=1)
    times_s = samples.index[force_m_s2 > MAX_PLAUSIBLE_SPECIFIC_FORCE_M_S2].tolist()
    if len(times_s) < MIN_IMPLAUSIBLE_FORCE_SAMPLES:
        return
    max_specific_force_m_s2, start_s = float(np.nanmax(force_m_s2)), times_s[0]
    yield make_error(
        "imu_values_impossible",
        f"The accelerometer values are impossible: up to {max_specific_force_m_s2:,.0f} m/s², "
        "first at "
        f"{start_s:.1f} s. Sensors of autopilots measure at most 32 g (314 m/s²). The simulator "
        "has diverged, or the log is damaged.",
        "Analyse only the time before the impossible accelerometer values "
        f"(--end {max(start_s - 1.0, 0.0):.1f}).",
        {"max_m_s2": max_specific_force_m_s2, "count": len(times_s), "at_s": start_s},
        ((start_s, times_s[-1]),),
    )


def detect_accelerometer_bias(analysis: Analysis) -> Findings:
    """Detect an accelerometer bias, estimated from the positions or by EKF2."""
    systematic_errors = analysis.systematic_errors
    ekf2_bias_m_s2 = _find_ekf2_accelerometer_bias(analysis)
    sensor_text, can_be_severe, evidence = "accelerometers", True, dict[str, float]()
    # Case 1: horizontal bias, estimated from the positions
    if isinstance(systematic_errors, SystematicErrors) and systematic_errors.has_significant_bias():
        horizontal_bias = systematic_errors.compute_horizontal_bias()
        forward_bias = systematic_errors.forward_bias_m_s2
        bias_m_s2, evidence = horizontal_bias.value, {"sigma_m_s2": horizontal_bias.sigma}
        message = (
            f"The accelerometer is biased by {forward_bias.value:+.2f} m/s² forward and "
            f"{systematic_errors.right_bias_m_s2.value:+.2f} m/s² right, estimated from the "
            f"positions (± {1.96 * forward_bias.sigma:.2f} m/s², 95 %). A tilt error of "
            f"{bias_m_s2 * TILT_DEG_PER_M_S2:.1f}° has the same effect."
        )
        if ekf2_bias_m_s2 is not None:
            forward, right, _ = ekf2_bias_m_s2
            message += (
                f" EKF2's bias estimate is {forward:+.2f} m/s² forward and {right:+.2f} m/s² right."
            )
        sensor_text = "accelerometers and the level horizon"
    # Case 2: bias estimated by EKF2. EKF2 corrects this bias, so the bias is no severe fault
    elif ekf2_bias_m_s2 is not None:
        can_be_severe = False
        forward, right, down = ekf2_bias_m_s2
        bias_m_s2 = math.hypot(*ekf2_bias_m_s2)
        # The positions show no significant horizontal bias: test only the vertical bias
        if isinstance(systematic_errors, SystematicErrors):
            bias_m_s2 = abs(down)
        message = (
            f"EKF2 estimates an accelerometer bias of {bias_m_s2:.2f} m/s²: {forward:+.2f} "
            f"forward, {right:+.2f} right and {down:+.2f} down."
        )
    # Case 3: vertical bias, estimated from the heights of the source
    else:
        error_m_s2 = 0.0
        if (result := analysis.axes.get("down")) is not None:
            error_m_s2 = estimate_mean_acceleration_error(result.axis) or 0.0
        bias_m_s2 = abs(error_m_s2)
        message = (
            f"The accelerometer is biased by {error_m_s2:+.2f} m/s² down, estimated from "
            "the heights of the position source. An accelerometer scale factor of "
            f"{1.0 - error_m_s2 / constants.g:.3f} has the same effect."
        )
    if bias_m_s2 >= MIN_REPORTED_ACCELEROMETER_BIAS_M_S2:
        yield finding(
            error_if(can_be_severe and bias_m_s2 >= MIN_SEVERE_BIAS_M_S2),
            "accelerometer_bias",
            f"{message} KF does not estimate biases.",
            f"Calibrate the {sensor_text} at the temperature of the flight.",
            {"bias_m_s2": bias_m_s2, **evidence},
        )


def _find_ekf2_accelerometer_bias(analysis: Analysis) -> list[float] | None:
    """Return EKF2's median accelerometer bias forward, right and down (m/s²), if logged."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2) or not isinstance(ekf2.accelerometer_bias, pd.DataFrame):
        return None
    samples = cut_to_segment(ekf2.accelerometer_bias, analysis.segment)[Columns.SPECIFIC_FORCE]
    return None if samples.empty else samples.median().tolist()


def detect_tumbling(analysis: Analysis) -> Findings:
    """Detect roll or pitch beyond the limits of PX4's failure detector."""
    if spans := analysis.segment.clip_spans(analysis.flight.excessive_tilt_spans_s):
        start_s = spans[0][0]
        yield make_error(
            "attitude_failure",
            f"Roll or pitch exceeded PX4's failure-detector limits (FD_FAIL_R, FD_FAIL_P) at "
            f"{start_s:.1f} s. Later data do not represent normal flight.",
            f"Analyse only the time before the large tilt (--end {max(start_s - 1.0, 0.0):.1f}).",
            {"total_s": sum(end - start for start, end in spans)},
            spans,
        )


def detect_clipping(analysis: Analysis) -> Findings:
    """Detect accelerometer samples at the limit of the measurement range."""
    imu = analysis.flight.imu
    if isinstance(imu, Unavailable) or "clipped" not in imu:
        return
    imu_samples = cut_to_segment(imu, analysis.segment)
    time_s = imu_samples.index[imu_samples["clipped"] > 0.0].to_numpy()
    clipped_duration_s = len(time_s) / compute_sample_rate_hz(imu)
    if clipped_duration_s > MAX_CLIPPING_DURATION_S:
        bursts_s = np.split(
            time_s, np.flatnonzero(np.diff(time_s) > MIN_TIME_BETWEEN_CLIPPINGS_S) + 1
        )
        yield make_warning(
            "accelerometer_clipping",
            f"The accelerometer was clipped for {clipped_duration_s:.2f} s ({len(time_s)} "
            "samples). The error resembles a bias and affects height and vertical velocity first.",
            "Check propellers, motors and mounting for vibration or impacts. Analyse a segment "
            "without clipping (--start, --end).",
            {"count": len(time_s), "total_s": clipped_duration_s},
            tuple((float(burst_s[0]), float(burst_s[-1])) for burst_s in bursts_s),
        )


def detect_imu_gaps(analysis: Analysis) -> Findings:
    """Detect a gap in the input of KF: missing IMU or attitude samples."""
    gap_s, imu, log = analysis.main.kf_run.input_gap_s, analysis.flight.imu, analysis.flight.log
    if isinstance(imu, Unavailable):
        return
    spans = _find_gap_spans(imu, analysis.segment)
    if gap_s > max(MIN_REPORTED_IMU_GAP_S, 2.0 / compute_sample_rate_hz(imu)):
        action = ""
        if log.format.startswith("MAVLink"):
            action = "Record on a link without message loss. "
        elif log.dropouts:
            action = "Use a faster SD card. "
        # KF's input has a gap if IMU or attitude samples are missing. Without a gap of the IMU,
        # attitude samples are missing
        yield make_warning(
            "imu_gap",
            f"{'IMU' if spans else 'Attitude'} samples are missing for {gap_s:.2f} s. In this gap "
            "KF increases SIGMA_A to the standard deviation of the measured acceleration.",
            f"{action}Analyse a segment without the gap (--start, --end).",
            {"total_s": gap_s},
            spans,
        )


def detect_missing_imu_samples(analysis: Analysis) -> Findings:
    """Detect single missing IMU samples during the whole flight."""
    imu, log = analysis.flight.imu, analysis.flight.log
    if isinstance(imu, Unavailable) or log.format.startswith("MAVLink"):
        return
    samples = cut_to_segment(imu, analysis.segment)
    lost_fraction = compute_lost_imu_fraction(samples.index.to_numpy()) if len(samples) > 1 else 0.0
    if lost_fraction <= MAX_MISSING_IMU_FRACTION:
        return
    sdlog_profile = int(log.parameters.get("SDLOG_PROFILE", DEFAULT_SDLOG_PROFILE))
    needed_profile = sdlog_profile & (DEFAULT_SDLOG_PROFILE | VISION_PROFILE_MASK)
    action = "Use a faster SD card"
    if sdlog_profile != needed_profile:
        action += f", or log fewer topics: set SDLOG_PROFILE to {needed_profile}"
    yield make_warning(
        "imu_samples_missing",
        f"{format_percent(lost_fraction)} of the IMU samples are missing from the log. KF "
        "increases Q in the IMU gaps. EKF2 cannot be replayed with changed parameters.",
        f"{action}.",
        {"lost_fraction": lost_fraction, "sdlog_profile": sdlog_profile},
    )


def _find_gap_spans(imu: pd.DataFrame, segment: Segment) -> tuple[Span, ...]:
    """Return start and end (s) of each IMU gap in a segment."""
    time_s = imu.index.to_numpy()
    gaps = select_intervals(time_s, find_imu_gaps(time_s))
    for start, end in ((segment.start_s, float(time_s[0])), (float(time_s[-1]), segment.end_s)):
        gaps += [(start, end)] if end - start > MIN_SPAN_S else []
    gaps_inside = (span for span in gaps if span[1] > segment.start_s and span[0] < segment.end_s)
    return tuple(sorted(gaps_inside))


def is_rate_too_low(samples: pd.DataFrame, required_rate_hz: float) -> bool:
    return compute_sample_rate_hz(samples) < MIN_MEASURED_TO_REQUIRED_RATE_RATIO * required_rate_hz


def detect_low_rates(flight: Flight) -> Findings:
    """Detect an IMU or attitude rate too low to compute the acceleration in NED."""
    log = flight.log
    for samples, name, label, default_topic, required_rate_hz in (
        (flight.imu, "imu", "IMU", "sensor_combined", MIN_IMU_RATE_HZ),
        (flight.attitude, "attitude", "attitude", "vehicle_attitude", MIN_ATTITUDE_RATE_HZ),
    ):
        topic = flight.streams[name].topics[0] if name in flight.streams else default_topic
        if isinstance(samples, pd.DataFrame) and is_rate_too_low(samples, required_rate_hz):
            rate_hz = compute_sample_rate_hz(samples)
            sdlog_profile = int(log.parameters.get("SDLOG_PROFILE", DEFAULT_SDLOG_PROFILE))
            action = (
                f"Set SDLOG_PROFILE to {sdlog_profile | SDLOG_HIGH_RATE_MASK} (bit 4 logs {topic} "
                "at full rate)."
            )
            if log.format.startswith("MAVLink"):
                action = (
                    f"Request {topic} at {2.0 * required_rate_hz:g} Hz "
                    "(MAV_CMD_SET_MESSAGE_INTERVAL)"
                    f"{', or give the ULog of the flight' if log.writes_ulog else ''}."
                )
            yield make_warning(
                "imu_rate_too_low",
                f"The {label} was logged at {rate_hz:.1f} Hz, but {required_rate_hz:g} Hz are "
                "needed. Motion between samples is lost, and vibration is aliased.",
                action,
                {"rate_hz": rate_hz, "needed_hz": required_rate_hz, "topic": topic},
            )
