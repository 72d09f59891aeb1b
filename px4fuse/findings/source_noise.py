"""Position noise that is time-correlated, unequal between axes or varying; repeated positions.

R describes white noise of constant σ, so neither KF nor EKF2 can model such noise.
"""

from dataclasses import asdict

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.text import capitalise_first, format_number
from px4fuse.filter.consistency import CONSISTENT_RATIOS
from px4fuse.filter.correlated_noise import TimeCorrelatedNoise
from px4fuse.filter.signals import cut_to_segment
from px4fuse.findings.cause_grouping import WHITE_RATIO
from px4fuse.findings.model import Findings, error, format_percent, note, source_words, warning
from px4fuse.findings.noises import NOISE_RATIO_TOLERANCE, ekf2_noise_m
from px4fuse.findings.source_positions import MIN_LAG_NATS, hardly_moved
from px4fuse.flight.model import Columns, positions_of, source_name

# Minimum ratio of the white noise to the time-correlated error for the white noise to be a fault
MIN_WHITE_SHARE = 0.3
# Minimum gain of the log likelihood for time-correlated noise: 1 of 400 flights without a fault
# exceeds it
MIN_CORRELATION_GAIN_NATS = 5.0
# Minimum fraction of repeated positions for a warning
MIN_REPEAT_SHARE = 0.05
# Minimum fraction of repeated positions for severity error
MIN_REPEAT_SHARE_ERROR = 0.3
# Minimum number of repeated positions for a finding
MIN_REPEATS = 10
# Minimum ratio of the position noises (σ) along north and east for a finding
MIN_AXIS_RATIO = 1.5
# Minimum ratio of the position noise (σ) in one time span to that in the rest of the flight, for a
# warning
MIN_PART_RATIO = 2.0
# Minimum ratio of the position noise (σ) in one time span to that in the rest of the flight,
# without outliers, for a warning
MIN_PART_RATIO_WITHOUT_OUTLIERS = 1.5
# Minimum ratio of the position noise (σ) in one time span to that in the rest of the flight, for
# severity error
MIN_PART_RATIO_ERROR = 4.0


def detect(analysis: Analysis) -> Findings:
    """Detect position noise that is not white noise with a constant σ."""
    if analysis.source.orientation is not None or analysis.source.origin.reconstructed:
        return
    yield from detect_repeated_positions(analysis)
    yield from detect_time_correlated_noise(analysis)
    yield from detect_unequal_noise(analysis)
    yield from detect_noise_variation(analysis)


def detect_time_correlated_noise(analysis: Analysis) -> Findings:
    """Detect time-correlated position errors of a source that does not lag."""
    noise = analysis.time_correlated_noise
    if not isinstance(noise, TimeCorrelatedNoise) or noise.gain_nats < MIN_CORRELATION_GAIN_NATS:
        return
    if noise.lag_nats >= MIN_LAG_NATS:
        return  # the source is low-pass filtered, which source_positions reports
    low, high = (format_number(end, 1) for end in (noise.low_s, noise.high_s))
    correlation_time, interval = f"{format_number(noise.tau_s, 1)} s", f"95 % {low} to {high} s"
    if not np.isfinite(noise.high_s):
        correlation_time, interval = f"at least {low} s", "95 %"
    is_gnss, name = analysis.source.origin.is_gnss, source_name(analysis.source)
    evidence = {name: value for name, value in asdict(noise).items() if np.isfinite(value)}
    assumed_m = [analysis.settings.sigma_z_m, *map(ekf2_noise_m, analysis.axes.values())]
    ratio = noise.white_m / float(np.nanmin(assumed_m))
    if ratio > NOISE_RATIO_TOLERANCE and noise.white_m > MIN_WHITE_SHARE * noise.slow_m:
        evidence[WHITE_RATIO] = ratio
    # GNSS errors are usually time-correlated: a warning only if they exceed the reported σ
    make_finding = note if is_gnss and not _exceeds_sigma(analysis) else warning
    yield make_finding(
        "source_noise_time_correlated",
        f"Time-correlated {name} error of {noise.slow_m:.2g} m, correlation time "
        f"{correlation_time} ({interval}). It adds to white noise of {noise.white_m:.2g} m (1 σ). "
        "KF and EKF2 assume independent errors: they follow the correlated error and report a σ "
        "that is too small. Innovations do not show this error.",
        f"Check {source_words(analysis.source).errors}.",
        evidence,
    )


def _exceeds_sigma(analysis: Analysis) -> bool:
    """Return True if a filter is overconfident against ground truth."""
    truths = [summary.truth for summary in analysis.main.filters.values()]
    return any(
        isinstance(truth, ErrorsAgainstTruth)
        and not truth.is_lag_only
        and truth.nees_position_mean is not None
        and truth.nees_position_mean > CONSISTENT_RATIOS["truth"][1] ** 2
        for truth in truths
    )


def detect_repeated_positions(analysis: Analysis) -> Findings:
    """Detect positions that are equal to the previous one while the vehicle moves."""
    if hardly_moved(analysis):
        return
    positions_m = (
        cut_to_segment(analysis.source.samples, analysis.segment)[Columns.POSITION]
        .dropna()
        .to_numpy()
    )
    is_repeated = np.all(np.diff(positions_m, axis=0) == 0.0, axis=1)
    count, share = int(is_repeated.sum()), float(is_repeated.mean()) if len(is_repeated) else 0.0
    if count < MIN_REPEATS or share < MIN_REPEAT_SHARE:
        return
    make_finding = error if share >= MIN_REPEAT_SHARE_ERROR else warning
    yield make_finding(
        "source_samples_repeated",
        f"{count} of {len(is_repeated)} {positions_of(analysis.source)} repeat the previous "
        f"position. KF and EKF2 use each repetition ({format_percent(share)}) as a new, "
        "independent measurement.",
        "Send each position once, with its time of measurement.",
        {"count": count, "share": share},
    )


def detect_unequal_noise(analysis: Analysis) -> Findings:
    """Detect different position noise along north and east."""
    if analysis.source.origin.is_gnss:
        return  # GNSS errors are mostly time-correlated; SIGMA_Z estimates only white noise
    known_intervals = sorted(
        (noise.value, noise.low, noise.high, axis_tuning.name)
        for axis_tuning in analysis.tuning_by_axis
        if (noise := axis_tuning.sigma_z).value and noise.low and noise.high
    )
    if len(known_intervals) < 2:
        return
    (small, _, small_high, quieter_axis), (large, large_low, _, noisier_axis) = known_intervals
    if large < MIN_AXIS_RATIO * small or large_low <= small_high:
        return
    yield warning(
        "source_noise_unequal_axes",
        f"{capitalise_first(source_name(analysis.source))} noise is {large:.2g} m along "
        f"{noisier_axis} and {small:.2g} m along {quieter_axis}. One SIGMA_Z, or one EKF2 "
        "measurement noise, does not fit both axes.",
        f"{source_words(analysis.source).unequal_axes_action} Analyse each axis separately "
        f"(--axis {noisier_axis} --sigma-z {large:.2g}).",
        {f"{quieter_axis}_sigma_z_m": small, f"{noisier_axis}_sigma_z_m": large},
    )


def detect_noise_variation(analysis: Analysis) -> Findings:
    """Detect a time span of the flight in which most innovations are larger."""
    part = analysis.noisy_part
    if part is None or part.ratio < MIN_PART_RATIO:
        return
    # a fused outlier increases later innovations: require a large ratio without outliers, too
    if part.ratio_without_outliers < MIN_PART_RATIO_WITHOUT_OUTLIERS:
        return
    ratio, start, end = part.ratio, part.start_s, part.end_s
    yield (error if ratio >= MIN_PART_RATIO_ERROR else warning)(
        "source_noise_varies",
        f"{capitalise_first(source_name(analysis.source))} noise is {ratio:.1f} times larger from "
        f"{start:.0f} to {end:.0f} s. Most samples of that time are affected, not single outliers. "
        "No single SIGMA_Z fits the whole flight.",
        f"Check {source_words(analysis.source).noise} in that time. Let the source send a variance "
        "with each position, or analyse this time separately (--start, --end).",
        {"ratio": ratio, "first_s": start, "until_s": end},
        ((start, end),),
    )
