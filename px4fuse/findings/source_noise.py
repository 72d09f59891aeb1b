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
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.cause_grouping import WHITE_TO_ASSUMED_NOISE_RATIO_KEY
from px4fuse.findings.model import (
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

# Minimum ratio of white noise σ to time-correlated noise σ, for a separate fault
MIN_WHITE_TO_CORRELATED_SIGMA_RATIO = 0.3
# Minimum log likelihood ratio (nats): 1 of 400 flights without a fault exceeds it
MIN_CORRELATED_NOISE_LOG_LIKELIHOOD_RATIO_NATS = 5.0
# Minimum time-correlated error (m, 1 σ): errors of timestamps and motion cause some mm
MIN_CORRELATED_NOISE_SIGMA_M = 0.005
# Minimum fraction of repeated positions for a warning
MIN_REPEATED_FRACTION = 0.05
MIN_REPEATED_FRACTION_FOR_ERROR = 0.3
MIN_REPEATED_POSITION_COUNT = 10
# Minimum ratio of the larger to the smaller position noise σ, north and east
MIN_AXIS_NOISE_RATIO = 1.5
# Minimum ratio of the noise in one flight part to the noise in the rest, for a warning
MIN_NOISY_PART_SIGMA_RATIO = 2.0
# Minimum noise ratio of one flight part to the rest, without outliers, for a warning
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
    tau_low_text, tau_high_text = (format_number(end, 1) for end in (noise.low_s, noise.high_s))
    correlation_time_text, interval_text = (
        f"{format_number(noise.tau_s, 1)} s",
        f"95 % {tau_low_text} to {tau_high_text} s",
    )
    if not np.isfinite(noise.high_s):
        correlation_time_text, interval_text = f"at least {tau_low_text} s", "95 %"
    is_gnss, name = analysis.source.origin.is_gnss, source_name(analysis.source)
    evidence = {name: value for name, value in asdict(noise).items() if np.isfinite(value)}
    assumed_noises_m = [
        analysis.settings.sigma_z_m,
        *map(find_ekf2_noise_m, analysis.axes.values()),
    ]
    white_noise_to_setting_ratio = noise.white_m / float(np.nanmin(assumed_noises_m))
    if (
        white_noise_to_setting_ratio > MAX_RATIO_OF_EQUAL_NOISES
        and noise.white_m > MIN_WHITE_TO_CORRELATED_SIGMA_RATIO * noise.slow_m
    ):
        evidence[WHITE_TO_ASSUMED_NOISE_RATIO_KEY] = white_noise_to_setting_ratio
    # Time-correlated errors of GNSS are normal: if σ contains them, they are only a note
    make_finding = (
        make_note if is_gnss and not _has_error_above_reported_sigma(analysis) else make_warning
    )
    yield make_finding(
        "source_noise_time_correlated",
        f"Time-correlated {name} error of {noise.slow_m:.2g} m, correlation time "
        f"{correlation_time_text} ({interval_text}). The rest of the error is white noise of "
        f"{noise.white_m:.2g} m (1 σ). KF and EKF2 assume independent errors. Both follow the "
        "correlated error and report a σ that is too small. Innovations do not show this error.",
        f"{find_source_texts(analysis.source).slow_error_check}.",
        evidence,
    )


def _has_error_above_reported_sigma(analysis: Analysis) -> bool:
    errors_against_truth = [summary.truth for summary in analysis.main.filters.values()]
    return any(
        isinstance(errors, ErrorsAgainstTruth)
        and not errors.has_only_lag_errors
        and errors.nees_position_mean is not None
        and errors.nees_position_mean > CONSISTENT_SIGMA_RATIOS["truth"][1] ** 2
        for errors in errors_against_truth
    )


def detect_repeated_positions(analysis: Analysis) -> Findings:
    """Detect positions that are equal to the previous one while the vehicle moves."""
    if has_little_motion(analysis):
        return
    positions_m = (
        cut_to_segment(analysis.source.samples, analysis.segment)[Columns.POSITION]
        .dropna()
        .to_numpy()
    )
    is_repeated = np.all(np.diff(positions_m, axis=0) == 0.0, axis=1)
    repeated_count, repeated_fraction = (
        int(is_repeated.sum()),
        float(is_repeated.mean()) if len(is_repeated) else 0.0,
    )
    if repeated_count < MIN_REPEATED_POSITION_COUNT or repeated_fraction < MIN_REPEATED_FRACTION:
        return
    make_finding = (
        make_error if repeated_fraction >= MIN_REPEATED_FRACTION_FOR_ERROR else make_warning
    )
    yield make_finding(
        "source_samples_repeated",
        f"{repeated_count} of {len(is_repeated)} {positions_phrase(analysis.source)} repeat the "
        f"previous position ({format_percent(repeated_fraction)}). KF and EKF2 use each repetition "
        "as a new measurement.",
        "Send each position once, with its time of measurement.",
        {"count": repeated_count, "share": repeated_fraction},
    )


def detect_unequal_noise(analysis: Analysis) -> Findings:
    """Detect that the position noise differs between two horizontal directions."""
    if analysis.source.origin.is_gnss:
        return  # the estimate lacks time-correlated noise, which dominates in GNSS
    axis_noise_estimates = sorted(
        (noise.value, noise.low, noise.high, axis_tuning.name)
        for axis_tuning in analysis.axis_tunings
        if (noise := axis_tuning.sigma_z).value and noise.low and noise.high
    )
    if len(axis_noise_estimates) < 2:
        return
    (
        (smaller_noise_m, _, smaller_noise_upper_bound_m, smaller_noise_axis),
        (larger_noise_m, larger_noise_lower_bound_m, _, larger_noise_axis),
    ) = axis_noise_estimates
    if (
        larger_noise_m < MIN_AXIS_NOISE_RATIO * smaller_noise_m
        or larger_noise_lower_bound_m <= smaller_noise_upper_bound_m
    ):
        return
    action = f"{find_source_texts(analysis.source).slow_error_check}."
    keys = ("smaller_noise_sigma_z_m", "larger_noise_sigma_z_m")
    if larger_noise_axis in analysis.axes:
        action += (
            " Analyse each axis separately "
            f"(--axis {larger_noise_axis} --sigma-z {larger_noise_m:.2g})."
        )
        keys = (f"{smaller_noise_axis}_sigma_z_m", f"{larger_noise_axis}_sigma_z_m")
    yield make_warning(
        "source_noise_unequal_axes",
        f"{source_name(analysis.source)} noise is {larger_noise_m:.2g} m along "
        f"{larger_noise_axis} and {smaller_noise_m:.2g} m along {smaller_noise_axis}. One SIGMA_Z, "
        "or one EKF2 measurement noise, does not fit both axes.",
        action,
        dict(zip(keys, (smaller_noise_m, larger_noise_m), strict=True)),
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
        f"{start_s:.0f} to {end_s:.0f} s. Most samples in this time are noisier, so single "
        "outliers are not the cause. No single SIGMA_Z fits the whole flight.",
        f"{find_source_texts(analysis.source).data_link_check} in that time. Let the source send a "
        "variance with each position, or analyse this time separately (--start, --end).",
        {"ratio": noise_ratio, "first_s": start_s, "until_s": end_s},
        ((start_s, end_s),),
    )
