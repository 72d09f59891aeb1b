"""Errors of the positions that a constant white noise does not describe.

Repeated positions, time-correlated noise, noise that differs between axes or varies, and jitter.
With ground truth also periodic errors, a varying time offset and a scale factor error. An IMU
oscillation and a late attitude are detected too, because their effects resemble position errors.
"""

from dataclasses import asdict

import numpy as np
import pandas as pd
from scipy import constants

from px4fuse.analysis import Analysis
from px4fuse.comparison.error_patterns import (
    ErrorFit,
    LocalResiduals,
    compute_local_residuals,
    find_attitude_delay,
    find_periodic_error,
    find_speed_dependent_noise,
    find_time_offset_variation,
    find_timestamp_jitter,
    fit_errors_against_truth,
)
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.text import format_metres, format_number, format_ratio
from px4fuse.filter.consistency import CONSISTENT_SIGMA_RATIOS
from px4fuse.filter.correlated_noise import TimeCorrelatedNoise
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.model import Columns

from .model import (
    WHITE_TO_ASSUMED_NOISE_RATIO_KEY,
    Findings,
    error_if,
    find_source_texts,
    finding,
    format_percent,
    make_error,
    make_note,
    make_warning,
)
from .noises import MAX_RATIO_OF_EQUAL_NOISES, find_ekf2_noise_m
from .source_positions import (
    MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS,
    MIN_SCALE_ERROR_TO_SIGMA_RATIO,
    find_low_pass,
    has_little_motion,
    make_scale_finding,
)
from .source_stamps import detect_bursts

# White noise is a separate fault if its σ ÷ σ of the time-correlated noise exceeds this ratio
MIN_WHITE_TO_CORRELATED_SIGMA_RATIO = 0.3
# Minimum log likelihood ratio (nats) of time-correlated noise to white noise: 1 of 400 flights
# without a fault exceeds it
MIN_CORRELATED_NOISE_LOG_LIKELIHOOD_RATIO_NATS = 5.0
# Minimum time-correlated error (m, 1 σ): timestamp errors and motion alone cause a few mm
MIN_CORRELATED_NOISE_SIGMA_M = 0.005
# Minimum fraction of repeated positions for a warning
MIN_REPEATED_POSITION_FRACTION = 0.05
# Minimum fraction of repeated positions for severity "error"
MIN_REPEATED_FRACTION_FOR_SEVERITY_ERROR = 0.3
# Minimum number of repeated positions for a finding
MIN_REPEATED_POSITION_COUNT = 10
# Minimum ratio for a warning: larger ÷ smaller position noise (σ) of two horizontal axes
MIN_AXIS_NOISE_RATIO = 1.5
# Minimum ratio of the noise in one flight part to the noise in the rest, for a warning
MIN_NOISY_PART_SIGMA_RATIO = 2.0
# Minimum ratio of the noise in one flight part to the noise in the rest, after removal of outliers
MIN_NOISY_PART_SIGMA_RATIO_WITHOUT_OUTLIERS = 1.5
# Minimum ratio of the noise in one flight part to the noise in the rest, for severity "error"
MIN_NOISY_PART_SIGMA_RATIO_FOR_SEVERITY_ERROR = 4.0
# Minimum scale factor error (measured ÷ true distance, minus 1) against ground truth: 0.8 m in 10 m
MIN_SCALE_ERROR_AGAINST_TRUTH = 0.08
# Minimum jitter (s) for severity "error"; it causes a position error of 3 cm at 1 m/s
MIN_JITTER_FOR_SEVERITY_ERROR_S = 0.03
# Minimum amplitude (m) of a periodic error for severity "error": twice the noise of a good UWB
# system
MIN_SEVERE_PERIODIC_ERROR_M = 0.2


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on position errors that a constant white noise does not describe."""
    yield from detect_noise_faults(analysis)
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
    error_fit = fit_errors_against_truth(analysis, local_residuals)
    if error_fit is not None:
        yield from detect_periodic_errors_and_offset_changes(analysis, error_fit)
        if not analysis.source.origin.is_gnss:  # GNSS has no scale factor error
            yield from detect_scale_error(analysis, error_fit)


def detect_noise_faults(analysis: Analysis) -> Findings:
    """Yield the findings on repeated positions and noise, except for reconstructed positions."""
    if analysis.source.origin.reconstructed:
        return
    yield from detect_repeated_positions(analysis)
    if analysis.source.orientation is None:
        yield from detect_time_correlated_noise(analysis)
        yield from detect_unequal_noise(analysis)
        yield from detect_noise_variation(analysis)


def detect_time_correlated_noise(analysis: Analysis) -> Findings:
    """Detect position noise that is correlated in time, unless a low-pass filter explains it."""
    noise = analysis.time_correlated_noise
    if (
        not isinstance(noise, TimeCorrelatedNoise)
        or noise.gain_nats < MIN_CORRELATED_NOISE_LOG_LIKELIHOOD_RATIO_NATS
        or noise.slow_m < MIN_CORRELATED_NOISE_SIGMA_M
        # A low-pass filter explains the correlated position errors: source_positions.py reports it
        or noise.low_pass_gain_nats >= MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS
    ):
        return
    correlation_time_text = f"at least {format_number(noise.low_s, 1)} s (95 %)"
    if np.isfinite(noise.high_s):
        tau_text, low_text, high_text = (
            format_number(time_s, 1) for time_s in (noise.tau_s, noise.low_s, noise.high_s)
        )
        correlation_time_text = f"{tau_text} s (95 % {low_text} to {high_text} s)"
    evidence = {name: value for name, value in asdict(noise).items() if np.isfinite(value)}
    ekf2_noises_m = map(find_ekf2_noise_m, analysis.axes.values())
    assumed_noise_m = float(np.nanmin([analysis.settings.sigma_z_m, *ekf2_noises_m]))
    if (
        noise.white_m > MAX_RATIO_OF_EQUAL_NOISES * assumed_noise_m
        and noise.white_m > MIN_WHITE_TO_CORRELATED_SIGMA_RATIO * noise.slow_m
    ):
        evidence[WHITE_TO_ASSUMED_NOISE_RATIO_KEY] = noise.white_m / assumed_noise_m
    # Time-correlated errors are normal for GNSS: severity note, unless ground truth shows errors
    # above the σ that a filter reports
    is_normal = analysis.source.origin.is_gnss and not _has_error_above_reported_sigma(analysis)
    yield (make_note if is_normal else make_warning)(
        "source_noise_time_correlated",
        f"Time-correlated {analysis.source.kind_name} error of {noise.slow_m:.2g} m, "
        f"correlation time {correlation_time_text}. The remaining error is white noise of "
        f"{noise.white_m:.2g} m (1 σ). KF and EKF2 assume independent errors: both follow the "
        "correlated error, and their σ is too small.",
        f"{find_source_texts(analysis).slow_error_check}.",
        evidence,
    )


def _has_error_above_reported_sigma(analysis: Analysis) -> bool:
    """Return True if errors against ground truth exceed the σ of KF or EKF2 along the main axis."""
    return any(
        isinstance(errors := summary.truth, ErrorsAgainstTruth)
        and not errors.has_only_lag_errors
        and (errors.nees_position_mean or 0.0) > CONSISTENT_SIGMA_RATIOS["truth"][1] ** 2
        for summary in analysis.main.filters.values()
    )


def detect_repeated_positions(analysis: Analysis) -> Findings:
    """Detect positions that are equal to the previous one while the vehicle moves."""
    if has_little_motion(analysis):
        return
    positions_m = analysis.source_samples[Columns.POSITION].dropna()
    is_repeated = (positions_m.diff() == 0.0).all(axis=1)[1:]
    count, fraction = int(is_repeated.sum()), float(is_repeated.mean())
    if count < MIN_REPEATED_POSITION_COUNT or fraction < MIN_REPEATED_POSITION_FRACTION:
        return
    yield finding(
        error_if(fraction >= MIN_REPEATED_FRACTION_FOR_SEVERITY_ERROR),
        "source_samples_repeated",
        f"{count} of {len(is_repeated)} {analysis.source.positions_text} repeat the previous "
        f"position ({format_percent(fraction)}). KF and EKF2 use each repetition as a measurement.",
        "Send each position once, with its time of measurement.",
        {"count": count, "share": fraction},
    )


def detect_unequal_noise(analysis: Analysis) -> Findings:
    """Detect that the position noise differs between two horizontal directions."""
    if analysis.source.origin.is_gnss:
        # The noise estimate contains only white noise, but time-correlated noise dominates in GNSS
        return
    axis_noises = sorted(
        (noise.value, noise.low, noise.high, axis_tuning.name)
        for axis_tuning in analysis.axis_tunings
        if (noise := axis_tuning.sigma_z).value and noise.low and noise.high
    )
    if len(axis_noises) < 2:
        return
    (
        (quiet_sigma_m, _, quiet_sigma_high_m, quiet_axis),
        (noisy_sigma_m, noisy_sigma_low_m, _, noisy_axis),
    ) = axis_noises
    if (
        noisy_sigma_m < MIN_AXIS_NOISE_RATIO * quiet_sigma_m
        or noisy_sigma_low_m <= quiet_sigma_high_m
    ):
        return
    action = f"{find_source_texts(analysis).slow_error_check}."
    evidence = {"smaller_noise_sigma_z_m": quiet_sigma_m, "larger_noise_sigma_z_m": noisy_sigma_m}
    if noisy_axis in analysis.axes:
        action += (
            f" Analyse each axis separately (--axis {noisy_axis} --sigma-z {noisy_sigma_m:.2g})."
        )
        evidence = {
            f"{quiet_axis}_sigma_z_m": quiet_sigma_m,
            f"{noisy_axis}_sigma_z_m": noisy_sigma_m,
        }
    yield make_warning(
        "source_noise_unequal_axes",
        f"{analysis.source.kind_name} noise is {noisy_sigma_m:.2g} m along {noisy_axis} and "
        f"{quiet_sigma_m:.2g} m along {quiet_axis}. One measurement noise (SIGMA_Z of KF, R of "
        "EKF2) does not fit both axes.",
        action,
        evidence,
    )


def detect_noise_variation(analysis: Analysis) -> Findings:
    """Detect that the position noise is larger in one part of the flight than in the rest."""
    noisy_flight_part = analysis.noisy_flight_part
    if (
        noisy_flight_part is None
        or noisy_flight_part.sigma_ratio < MIN_NOISY_PART_SIGMA_RATIO
        # An outlier also increases the next innovations, so the ratio is tested without outliers
        # too
        or noisy_flight_part.sigma_ratio_without_outliers
        < MIN_NOISY_PART_SIGMA_RATIO_WITHOUT_OUTLIERS
    ):
        return
    start_s, end_s = noisy_flight_part.start_s, noisy_flight_part.end_s
    yield finding(
        error_if(noisy_flight_part.sigma_ratio >= MIN_NOISY_PART_SIGMA_RATIO_FOR_SEVERITY_ERROR),
        "source_noise_varies",
        f"{analysis.source.kind_name} noise is {noisy_flight_part.sigma_ratio:.1f} times larger "
        f"from {start_s:.0f} to {end_s:.0f} s. Single outliers are not the cause.",
        f"{find_source_texts(analysis).data_link_check} for the time from {start_s:.0f} to "
        f"{end_s:.0f} s. Send a variance with each position, or analyse the noisy part separately "
        "(--start, --end).",
        {"ratio": noisy_flight_part.sigma_ratio, "first_s": start_s, "until_s": end_s},
        ((start_s, end_s),),
    )


def detect_jitter_and_speed_noise(analysis: Analysis, local_residuals: LocalResiduals) -> Findings:
    """Detect timestamp jitter, and position noise that grows with speed."""
    jitter_s, clock_map = find_timestamp_jitter(local_residuals), analysis.source.clock_map
    if jitter_s is not None and (clock_map is None or clock_map.distinct_stamps is None):
        yield finding(
            error_if(jitter_s >= MIN_JITTER_FOR_SEVERITY_ERROR_S),
            "source_timestamp_jitter",
            f"The timestamps of the {analysis.source.positions_text} jitter by "
            f"{1e3 * jitter_s:.0f} ms (1 σ). At 1 m/s this is a position error of "
            f"{format_metres(jitter_s)} m.",
            "Send the time of measurement with each position, not the time of processing, sending "
            "or receiving.",
            {"jitter_s": jitter_s},
        )
    noise_by_speed = find_speed_dependent_noise(local_residuals)
    if noise_by_speed is not None:
        yield make_error(
            "source_noise_grows_with_speed",
            f"{analysis.source.kind_name} noise grows with speed: "
            f"{format_metres(noise_by_speed.slow_m)} m at {noise_by_speed.slow_m_s:.1f} m/s and "
            f"{format_metres(noise_by_speed.fast_m)} m at {noise_by_speed.fast_m_s:.1f} m/s (1 σ). "
            "The noise perpendicular to the motion also grows, so time offset and jitter are not "
            "the cause.",
            "Send a variance that grows with speed (EKF2_EV_NOISE_MD 0). Shorten the exposure or "
            "ranging time.",
            noise_by_speed._asdict(),
        )


def detect_periodic_errors_and_offset_changes(analysis: Analysis, error_fit: ErrorFit) -> Findings:
    """Detect a periodic position error or, without it, a time offset that varies in flight."""
    periodic_error = find_periodic_error(error_fit)
    positions_text = analysis.source.positions_text
    if periodic_error is not None:
        yield finding(
            error_if(periodic_error.amplitude_m >= MIN_SEVERE_PERIODIC_ERROR_M),
            "source_error_periodic",
            f"The error of the {positions_text} is periodic: amplitude "
            f"{format_metres(periodic_error.amplitude_m)} m, period {periodic_error.period_s:.1f} "
            f"s. This sinusoid explains {format_percent(min(periodic_error.fraction, 1.0))} of the "
            "slow errors against ground truth. Innovations hardly show this error.",
            f"{find_source_texts(analysis).slow_error_check}. Look for a process with the "
            "period of the error, such as a control loop.",
            periodic_error._asdict(),
        )
        return
    clock, offset_change = analysis.time_offset, find_time_offset_variation(error_fit)
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
    """Detect a significant scale factor error of the positions against ground truth."""
    if abs(error_fit.scale) >= max(
        MIN_SCALE_ERROR_AGAINST_TRUTH, MIN_SCALE_ERROR_TO_SIGMA_RATIO * error_fit.scale_error_sigma
    ):
        yield make_scale_finding(
            analysis.source,
            error_fit.scale,
            error_fit.scale_error_sigma,
            f"ground truth (± {format_percent(1.96 * error_fit.scale_error_sigma, 1)}, 95 %)",
            f"{find_source_texts(analysis).scale_check}.",
        )


def detect_imu_oscillation(analysis: Analysis) -> Findings:
    """Detect an oscillation of the measured acceleration that the positions do not show."""
    if find_low_pass(analysis) is not None:
        # the low-pass filter of the source may have removed the oscillation from the positions
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
    """Detect a time offset between the logged attitude and the gyroscopes."""
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
