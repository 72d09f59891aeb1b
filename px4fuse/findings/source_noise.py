"""Position noise that is time-correlated, unequal between axes or varying; repeated positions.

R describes white noise of constant σ, so neither KF nor EKF2 can model such noise.
"""

from dataclasses import asdict
from itertools import pairwise

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array, BoolArray
from px4fuse.comparison.model import ErrorsAgainstTruth, north_and_east
from px4fuse.filter.consistency import CONSISTENT_RATIOS
from px4fuse.filter.correlated_noise import TimeCorrelatedNoise
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.signals import cut_to_segment
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, tune
from px4fuse.findings.cause_grouping import WHITE_RATIO
from px4fuse.findings.model import Findings, error, format_percent, note, warning
from px4fuse.findings.noises import NOISE_RATIO_TOLERANCE, ekf2_noise_m
from px4fuse.findings.source_positions import MIN_LAG_NATS, hardly_moved
from px4fuse.flight import Columns, Unavailable, positions_of, source_name
from px4fuse.text import capitalise_first, format_number

MIN_CORRELATION_GAIN_NATS = 5.0  # log-likelihood gain; 1 of 400 flights without mistake exceeds it
MIN_REPEAT_SHARE = 0.05  # of the positions, for a warning
MIN_REPEAT_SHARE_ERROR = 0.3  # of the positions, for an error: the true rate is clearly lower
MIN_REPEATS = 10
MIN_AXIS_RATIO = 1.5  # position noise (σ) along the noisier axis over that along the other axis
# Minimum ratio of the mean NIS of both axes for a noise estimate of each axis, which takes time
MIN_AXIS_NIS_RATIO = 1.7
# Minimum ratio of σ between a noisier part of the flight and the rest: for a warning, with outliers
# not fused, and for an error
MIN_PART_RATIO, MIN_PART_RATIO_WITHOUT_OUTLIERS, MIN_PART_RATIO_ERROR = 2.0, 1.5, 4.0
MAX_PARTS, MIN_PART_COUNT = 12, 25  # number of parts of the flight, and measurements in each part


def detect(analysis: Analysis) -> Findings:
    """Detect noise that R cannot describe; odometry and EKF2 output as source are not tested."""
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
    if (ratio := noise.white_m / float(np.nanmin(assumed_m))) > NOISE_RATIO_TOLERANCE:
        evidence[WHITE_RATIO] = ratio
    action = "Check multipath, anchor geometry and filters in the sender."
    if is_gnss:
        action = "Use RTK, or give the antenna a free view of the sky."
    # GNSS errors are usually time-correlated: a warning only if they exceed the reported σ
    make_finding = note if is_gnss and not _exceeds_sigma(analysis) else warning
    yield make_finding(
        "source_noise_time_correlated",
        f"Time-correlated {name} error of {noise.slow_m:.2g} m, correlation time "
        f"{correlation_time} ({interval}). It adds to white noise of {noise.white_m:.2g} m (1 σ). "
        "KF and EKF2 assume independent errors: they follow the correlated part and report a σ "
        "that is too small. Innovations do not show this part.",
        action,
        evidence,
    )


def _exceeds_sigma(analysis: Analysis) -> bool:
    """Return True if the mean NEES of a filter is above the consistent band."""
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
        f"{count} of {len(is_repeated)} {positions_of(analysis.source)} repeat the previous one. "
        f"KF and EKF2 use each repetition ({format_percent(share)}) as a new, independent "
        "measurement, although nothing was measured at that time.",
        "Send each position once, with its time of measurement.",
        {"count": count, "share": share},
    )


def detect_unequal_noise(analysis: Analysis) -> Findings:
    """Detect different position noise along north and east."""
    if analysis.source.origin.is_gnss:
        return  # GNSS errors are mostly time-correlated, and SIGMA_Z is their white part
    axes = north_and_east(analysis)
    summaries = [axis.filters["kf"] for axis in axes]
    nis = [summary.nis_mean for summary in summaries if not isinstance(summary, Unavailable)]
    if len(nis) < 2 or max(nis) < MIN_AXIS_NIS_RATIO * min(nis):
        return
    tunings = [
        axis_tuning
        for axis in axes
        for axis_tuning in tune((axis.axis,), analysis.settings, (axis.axis.name,)).values()
        if isinstance(axis_tuning, AxisTuning)
    ]
    known_intervals = sorted(
        (noise.value, noise.low, noise.high, axis_tuning.name)
        for axis_tuning in tunings
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
        "Place the anchors on all sides of the flight area. Analyse each axis separately "
        f"(--axis {noisier_axis} --sigma-z {large:.2g}).",
        {f"{quieter_axis}_sigma_z_m": small, f"{noisier_axis}_sigma_z_m": large},
    )


def detect_noise_variation(analysis: Analysis) -> Findings:
    """Detect a part of the flight in which most innovations are larger."""
    axis_tuning, settings = analysis.tuning.get(HORIZONTAL), analysis.settings
    if axis_tuning is None:
        return
    # noise estimates are unavailable if a third of the measurements resemble outliers
    sigma_a: float | None = settings.sigma_a_m_s2
    sigma_z: float | None = settings.sigma_z_m
    outlier_time_s = np.zeros(0)
    if isinstance(axis_tuning, AxisTuning):
        sigma_a, sigma_z = axis_tuning.sigma_a_two_state.value, axis_tuning.sigma_z.value
        outlier_time_s = axis_tuning.outlier_time_s
    lines = [result.axis for result in north_and_east(analysis)]
    if sigma_a is None or sigma_z is None or len(lines) < 2:
        return
    increments_by_axis = [preintegrate(line, settings) for line in lines]
    time = lines[0].measurement_time_s[-len(increments_by_axis[0].measurement_m) :]
    if len(time) < MAX_PARTS * MIN_PART_COUNT // 2:
        return
    count = min(MAX_PARTS, len(time) // MIN_PART_COUNT)
    edges = np.linspace(0, len(time), count + 1).astype(int)

    def relative_innovations(is_excluded: BoolArray | None) -> Array:
        # wrong noises change the size of innovations along the flight, so estimated noises are used
        axis_innovations = [
            innovations(increments, sigma_a, sigma_z, is_excluded)
            for increments in increments_by_axis
        ]
        normalised = np.abs([nu / np.sqrt(s) for nu, s in axis_innovations])
        # dividing by the median of each axis removes the effect of unequal axes
        return np.asarray(normalised / np.median(normalised, axis=1, keepdims=True))

    sizes = relative_innovations(None)
    part_sigma = np.array([np.median(sizes[:, low:high]) for low, high in pairwise(edges)])
    is_noisy = part_sigma > np.sqrt(part_sigma.min() * part_sigma.max())
    first_part = int(np.argmax(is_noisy))
    end_part = (
        first_part + int(np.argmin(is_noisy[first_part:]))
        if not is_noisy[first_part:].all()
        else count
    )
    if is_noisy.sum() != end_part - first_part or is_noisy.all():
        return  # the noisy parts are not one contiguous time
    is_quiet = np.ones(len(time), bool)
    is_quiet[edges[first_part] : edges[end_part]] = False
    # a fused outlier increases later innovations, so the ratio without outliers must be large, too
    ratio, ratio_without_outliers = (
        float(np.median(relative[:, ~is_quiet]) / np.median(relative[:, is_quiet]))
        for relative in (sizes, relative_innovations(np.isin(time, outlier_time_s)))
    )
    if ratio < MIN_PART_RATIO or ratio_without_outliers < MIN_PART_RATIO_WITHOUT_OUTLIERS:
        return
    start, end = float(time[edges[first_part]]), float(time[edges[end_part] - 1])
    check = "anchors in view, distance and obstacles"
    if analysis.source.origin.is_gnss:
        check = "satellites in view, walls, trees and radio interference"
    yield (error if ratio >= MIN_PART_RATIO_ERROR else warning)(
        "source_noise_varies",
        f"{capitalise_first(source_name(analysis.source))} noise is {ratio:.1f} times larger from "
        f"{start:.0f} to {end:.0f} s. Most samples of that time are affected, not single outliers. "
        "No single SIGMA_Z fits the whole flight.",
        f"Check {check} in that time. Let the sender report a variance with each position, or "
        "analyse the parts separately (--start, --end).",
        {"ratio": ratio, "first_s": start, "until_s": end},
        ((start, end),),
    )
