"""Systematic errors: timestamp jitter, noise that grows with speed, IMU oscillation, late attitude.

With ground truth also: periodic errors, a time offset that varies in flight, a scale factor error.
"""

import pandas as pd
from scipy import constants

from px4fuse.analysis import Analysis
from px4fuse.comparison.error_patterns import (
    ErrorFit,
    LocalResiduals,
    compute_local_residuals,
    find_attitude_delay,
    find_offset_variation,
    find_periodic_error,
    find_speed_dependent_noise,
    find_timestamp_jitter,
    fit_errors,
)
from px4fuse.core.text import format_metres, format_ratio
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.findings.model import (
    Findings,
    find_source_texts,
    format_percent,
    make_error,
    make_warning,
)
from px4fuse.findings.source_positions import (
    MIN_SCALE_ERROR_TO_SIGMA_RATIO,
    find_low_pass,
    make_scale_finding,
)
from px4fuse.findings.source_stamps import detect_bursts
from px4fuse.flight.model import positions_phrase, source_name

# Minimum scale factor error (ratio minus 1) against ground truth: 0.8 m in 10 m
MIN_SCALE_ERROR_AGAINST_TRUTH = 0.08
# Minimum jitter (s) for severity "error"; it causes a position error of 3 cm at 1 m/s
MIN_JITTER_FOR_ERROR_S = 0.03
# Minimum amplitude (m) of a periodic error for severity "error": twice the noise of a good UWB
# system
MIN_AMPLITUDE_FOR_ERROR_M = 0.2


def detect(analysis: Analysis) -> Findings:
    yield from detect_attitude_delay(analysis)
    yield from detect_imu_oscillation(analysis)
    burst_findings = [*detect_bursts(analysis)]
    yield from burst_findings
    if burst_findings or analysis.source.origin.reconstructed:
        return
    local_residuals = compute_local_residuals(analysis)
    if local_residuals is None:
        return
    yield from detect_jitter_and_speed_noise(analysis, local_residuals)
    error_fit = fit_errors(analysis, local_residuals)
    if error_fit is not None:
        yield from detect_periodic_errors_and_offset_changes(analysis, error_fit)
        if not analysis.source.origin.is_gnss:  # GNSS has no scale factor error
            yield from detect_scale_error(analysis, error_fit)


def detect_jitter_and_speed_noise(analysis: Analysis, local_residuals: LocalResiduals) -> Findings:
    jitter_s, clock_map = find_timestamp_jitter(local_residuals), analysis.source.clock_map
    if jitter_s is not None and (clock_map is None or clock_map.distinct_stamps is None):
        yield (make_error if jitter_s >= MIN_JITTER_FOR_ERROR_S else make_warning)(
            "source_timestamp_jitter",
            f"The timestamps of the {positions_phrase(analysis.source)} jitter by "
            f"{1e3 * jitter_s:.0f} ms (1 σ). The positions are measured at a constant interval. At "
            f"1 m/s the jitter causes a position error of {format_metres(jitter_s)} m.",
            "Send the time of measurement with each position, not the time of processing, sending "
            "or receiving.",
            {"jitter_s": jitter_s},
        )
    speed_noise = find_speed_dependent_noise(local_residuals)
    if speed_noise is not None:
        yield make_error(
            "source_noise_grows_with_speed",
            f"{source_name(analysis.source)} noise grows with speed: "
            f"{format_metres(speed_noise.slow_m)} m at {speed_noise.slow_m_s:.1f} m/s and "
            f"{format_metres(speed_noise.fast_m)} m at {speed_noise.fast_m_s:.1f} m/s (1 σ). The "
            "noise perpendicular to the motion also grows, so time offset and jitter are not the "
            "cause. No single measurement noise fits the whole flight.",
            "Send a variance that grows with speed (EKF2_EV_NOISE_MD 0). Shorten the exposure or "
            "ranging time.",
            speed_noise._asdict(),
        )


def detect_periodic_errors_and_offset_changes(analysis: Analysis, error_fit: ErrorFit) -> Findings:
    periodic_error = find_periodic_error(error_fit)
    positions_text = positions_phrase(analysis.source)
    if periodic_error is not None:
        yield (
            make_error if periodic_error.amplitude_m >= MIN_AMPLITUDE_FOR_ERROR_M else make_warning
        )(
            "source_error_periodic",
            f"The error of the {positions_text} is periodic: amplitude "
            f"{format_metres(periodic_error.amplitude_m)} m, period {periodic_error.period_s:.1f} "
            f"s. This sinusoid explains {format_percent(min(periodic_error.fraction, 1.0))} of the "
            "slow errors against ground truth. Innovations hardly show this error.",
            f"{find_source_texts(analysis.source).slow_error_check}. Look for a process with this "
            "period, such as a control loop.",
            periodic_error._asdict(),
        )
        return
    clock, offset_change = analysis.time_offset, find_offset_variation(error_fit)
    if isinstance(clock, SourceTimeOffset) and clock.has_changed():
        return  # source_clock.py reports a change of the time offset
    if offset_change is not None:
        yield make_error(
            "source_time_offset_changes",
            f"The time offset of the {positions_text} varies in flight by "
            f"{offset_change.most_s - offset_change.least_s:.2f} s. Its deviation from the "
            f"mean is {offset_change.least_s:+.2f} s at {offset_change.least_at_s:.0f} s and "
            f"{offset_change.most_s:+.2f} s at {offset_change.most_at_s:.0f} s (estimated with "
            "ground truth). No single --clock-offset corrects the whole flight.",
            "Synchronise the clocks during the whole flight. Send the time of measurement, not of "
            "sending or receiving.",
            offset_change._asdict(),
        )


def detect_scale_error(analysis: Analysis, error_fit: ErrorFit) -> Findings:
    if abs(error_fit.scale) >= max(
        MIN_SCALE_ERROR_AGAINST_TRUTH, MIN_SCALE_ERROR_TO_SIGMA_RATIO * error_fit.scale_sigma
    ):
        yield make_scale_finding(
            analysis.source,
            error_fit.scale,
            error_fit.scale_sigma,
            f"ground truth (± {format_percent(1.96 * error_fit.scale_sigma, 1)}, 95 %)",
            f"{find_source_texts(analysis.source).scale_check}.",
        )


def detect_imu_oscillation(analysis: Analysis) -> Findings:
    """Detect an oscillation of the accelerometer that the positions do not contain."""
    if find_low_pass(analysis) is not None:  # the filter may remove the motion from the positions
        return
    oscillation = analysis.imu_oscillation
    if oscillation is not None:
        yield make_warning(
            "accelerometer_oscillation",
            f"The accelerometer oscillates by {oscillation.amplitude_m_s2:.1f} m/s² at "
            f"{oscillation.frequency_hz:.2f} Hz, but the positions contain no such motion. KF and "
            "EKF2 integrate this acceleration, so their innovations oscillate.",
            "Check the mounting of the autopilot: screws, damping and cables.",
            oscillation._asdict(),
        )


def detect_attitude_delay(analysis: Analysis) -> Findings:
    imu, attitude = analysis.flight.imu, analysis.flight.attitude
    if not isinstance(imu, pd.DataFrame) or not isinstance(attitude, pd.DataFrame):
        return
    delay_s = find_attitude_delay(imu, attitude)
    if delay_s is not None:
        yield make_warning(
            "attitude_late",
            f"The logged attitude is {abs(delay_s):.2f} s {'late' if delay_s > 0.0 else 'early'} "
            "relative to the gyroscopes. KF's acceleration is therefore wrong by "
            f"{format_ratio(abs(delay_s) * constants.g)} m/s² for each rad/s of roll or pitch "
            "rate.",
            "Check the timestamps of the attitude: IMU and attitude must have the same clock.",
            {"delay_s": delay_s},
        )
