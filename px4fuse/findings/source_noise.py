"""Detect position noise that R does not describe, and repeated positions.

R describes white noise with constant σ.
"""

from dataclasses import asdict

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.text import format_number
from px4fuse.filter.consistency import CONSISTENT_SIGMA_RATIOS
from px4fuse.filter.correlated_noise import TimeCorrelatedNoise
from px4fuse.findings.model import (
    WHITE_TO_ASSUMED_NOISE_RATIO_KEY,
    Findings,
    find_source_texts,
    format_percent,
    make_error,
    make_note,
    make_warning,
)
from px4fuse.findings.noises import MAX_RATIO_OF_EQUAL_NOISES, find_ekf2_noise_m
from px4fuse.findings.source_positions import (
    MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS,
    has_little_motion,
)
from px4fuse.flight.model import Columns, positions_phrase, source_name

# White noise is a separate fault if its σ ÷ σ of the time-correlated noise exceeds this ratio
MIN_WHITE_TO_CORRELATED_SIGMA_RATIO = 0.3
# Minimum log likelihood ratio (nats): 1 of 400 flights without a fault exceeds it
MIN_CORRELATED_NOISE_LOG_LIKELIHOOD_RATIO_NATS = 5.0
# Minimum time-correlated error (m, 1 σ): timestamp errors and motion alone cause a few mm
MIN_CORRELATED_NOISE_SIGMA_M = 0.005
# Minimum fraction of repeated positions for a warning
MIN_REPEATED_FRACTION = 0.05
MIN_REPEATED_FRACTION_FOR_ERROR = 0.3
MIN_REPEATED_POSITION_COUNT = 10
# Minimum ratio of the larger to the smaller position noise σ, north and east
MIN_AXIS_NOISE_RATIO = 1.5
# Minimum ratio of the noise in one flight part to the noise in the rest, for a warning
MIN_NOISY_PART_SIGMA_RATIO = 2.0
# Minimum ratio of the noise in one flight part to the noise in the rest, after removal of outliers
MIN_NOISY_PART_SIGMA_RATIO_WITHOUT_OUTLIERS = 1.5
MIN_NOISY_PART_SIGMA_RATIO_FOR_ERROR = 4.0


def detect(analysis: Analysis) -> Findings:
    if analysis.source.origin.reconstructed:
        return
    yield from detect_repeated_positions(analysis)
    if analysis.source.orientation is not None:
        return
    yield from detect_time_correlated_noise(analysis)
    yield from detect_unequal_noise(analysis)
    yield from detect_noise_variation(analysis)


def detect_time_correlated_noise(analysis: Analysis) -> Findings:
    noise = analysis.time_correlated_noise
    if (
        not isinstance(noise, TimeCorrelatedNoise)
        or noise.gain_nats < MIN_CORRELATED_NOISE_LOG_LIKELIHOOD_RATIO_NATS
        or noise.slow_m < MIN_CORRELATED_NOISE_SIGMA_M
        # source_positions.py reports a low-pass filter
        or noise.low_pass_gain_nats >= MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS
    ):
        return
    time_text = f"at least {format_number(noise.low_s, 1)} s (95 %)"
    if np.isfinite(noise.high_s):
        tau_text, low_text, high_text = (
            format_number(time_s, 1) for time_s in (noise.tau_s, noise.low_s, noise.high_s)
        )
        time_text = f"{tau_text} s (95 % {low_text} to {high_text} s)"
    evidence = {name: value for name, value in asdict(noise).items() if np.isfinite(value)}
    ekf2_noises_m = map(find_ekf2_noise_m, analysis.axes.values())
    assumed_noise_m = float(np.nanmin([analysis.settings.sigma_z_m, *ekf2_noises_m]))
    if (
        noise.white_m > MAX_RATIO_OF_EQUAL_NOISES * assumed_noise_m
        and noise.white_m > MIN_WHITE_TO_CORRELATED_SIGMA_RATIO * noise.slow_m
    ):
        evidence[WHITE_TO_ASSUMED_NOISE_RATIO_KEY] = noise.white_m / assumed_noise_m
    # Time-correlated errors of GNSS are normal: if σ contains them, they are only a note
    is_normal = analysis.source.origin.is_gnss and not _has_error_above_reported_sigma(analysis)
    yield (make_note if is_normal else make_warning)(
        "source_noise_time_correlated",
        f"Time-correlated {source_name(analysis.source)} error of {noise.slow_m:.2g} m, "
        f"correlation time {time_text}. The rest of the error is white noise of "
        f"{noise.white_m:.2g} m (1 σ). KF and EKF2 assume independent errors: both follow the "
        "correlated error, and their σ is too small. Innovations do not show this error.",
        f"{find_source_texts(analysis.source).slow_error_check}.",
        evidence,
    )


def _has_error_above_reported_sigma(analysis: Analysis) -> bool:
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
    if count < MIN_REPEATED_POSITION_COUNT or fraction < MIN_REPEATED_FRACTION:
        return
    yield (make_error if fraction >= MIN_REPEATED_FRACTION_FOR_ERROR else make_warning)(
        "source_samples_repeated",
        f"{count} of {len(is_repeated)} {positions_phrase(analysis.source)} repeat the previous "
        f"position ({format_percent(fraction)}). KF and EKF2 use each repetition as a measurement.",
        "Send each position once, with its time of measurement.",
        {"count": count, "share": fraction},
    )


def detect_unequal_noise(analysis: Analysis) -> Findings:
    """Detect that the position noise differs between two horizontal directions."""
    if analysis.source.origin.is_gnss:
        return  # the estimate lacks time-correlated noise, which dominates in GNSS
    axis_noises = sorted(
        (noise.value, noise.low, noise.high, axis_tuning.name)
        for axis_tuning in analysis.axis_tunings
        if (noise := axis_tuning.sigma_z).value and noise.low and noise.high
    )
    if len(axis_noises) < 2:
        return
    (small_m, _, small_high_m, small_axis), (large_m, large_low_m, _, large_axis) = axis_noises
    if large_m < MIN_AXIS_NOISE_RATIO * small_m or large_low_m <= small_high_m:
        return
    action = f"{find_source_texts(analysis.source).slow_error_check}."
    evidence = {"smaller_noise_sigma_z_m": small_m, "larger_noise_sigma_z_m": large_m}
    if large_axis in analysis.axes:
        action += f" Analyse each axis separately (--axis {large_axis} --sigma-z {large_m:.2g})."
        evidence = {f"{small_axis}_sigma_z_m": small_m, f"{large_axis}_sigma_z_m": large_m}
    yield make_warning(
        "source_noise_unequal_axes",
        f"{source_name(analysis.source)} noise is {large_m:.2g} m along {large_axis} and "
        f"{small_m:.2g} m along {small_axis}. One measurement noise (SIGMA_Z, EKF2) does not fit "
        "both axes.",
        action,
        evidence,
    )


def detect_noise_variation(analysis: Analysis) -> Findings:
    noisy_part = analysis.noisy_part
    if (
        noisy_part is None
        or noisy_part.sigma_ratio < MIN_NOISY_PART_SIGMA_RATIO
        # An outlier also increases the next innovations, so the noise is tested without outliers
        or noisy_part.sigma_ratio_without_outliers < MIN_NOISY_PART_SIGMA_RATIO_WITHOUT_OUTLIERS
    ):
        return
    noise_ratio, start_s, end_s = noisy_part.sigma_ratio, noisy_part.start_s, noisy_part.end_s
    yield (make_error if noise_ratio >= MIN_NOISY_PART_SIGMA_RATIO_FOR_ERROR else make_warning)(
        "source_noise_varies",
        f"{source_name(analysis.source)} noise is {noise_ratio:.1f} times larger from "
        f"{start_s:.0f} to {end_s:.0f} s. Single outliers are not the cause. No single SIGMA_Z "
        "fits the whole flight.",
        f"{find_source_texts(analysis.source).data_link_check} for the time from {start_s:.0f} to "
        f"{end_s:.0f} s. Send a variance with each position, or analyse the noisy part separately "
        "(--start, --end).",
        {"ratio": noise_ratio, "first_s": start_s, "until_s": end_s},
        ((start_s, end_s),),
    )
