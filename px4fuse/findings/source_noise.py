"""Position noise that is time-correlated, repeated, unequal between axes or varying in flight.

R describes white noise of constant size, so neither KF nor EKF2 can model these.
"""

from dataclasses import asdict
from itertools import pairwise

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.correlated_noise import TimeCorrelatedNoise
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.signals import cut_to_segment
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, tune
from px4fuse.findings.cause_grouping import WHITE_RATIO
from px4fuse.findings.model import Found, error, format_percent, note, warning
from px4fuse.findings.noises import NOISE_RATIO_TOLERANCE, ekf2_noise_m
from px4fuse.findings.source_positions import MIN_LAG_NATS, hardly_moved
from px4fuse.flight import Columns, Unavailable
from px4fuse.text import format_number

MIN_CORRELATION_GAIN_NATS = 5.0  # likelihood ratio 150 for two parameters; 1 of 400 clean flights
MIN_REPEAT_SHARE = 0.05  # of the positions
MIN_REPEAT_SHARE_ERROR = 0.3  # of the positions; the actual rate is then clearly lower
MIN_REPEATS = 10
MIN_AXIS_RATIO = 1.5  # ratio of σ between the axes
MIN_AXIS_NIS_RATIO = 1.7  # ratio of the mean NIS; below, the axes are not tuned separately
MIN_PART_RATIO = 2.0  # ratio of σ between the noisier part and the rest
MIN_PART_RATIO_WITHOUT_OUTLIERS = 1.5  # the same ratio, outliers not fused
MIN_PART_RATIO_ERROR = 4.0  # ratio of σ
MAX_PARTS, MIN_PART_COUNT = 12, 25  # parts of the flight, and measurements in each


def detect(analysis: Analysis) -> Found:
    """Detect all kinds; odometry and positions rebuilt from EKF2 output cannot be tested."""
    if analysis.source.orientation is not None or analysis.source.origin.reconstructed:
        return
    yield from repeats(analysis)
    yield from time_correlated_noise(analysis)
    yield from unequal_noise(analysis)
    yield from noise_variation(analysis)


def time_correlated_noise(analysis: Analysis) -> Found:
    """Detect errors that are correlated in time, but do not lag."""
    found = analysis.coloured
    if not isinstance(found, TimeCorrelatedNoise) or found.gain_nats < MIN_CORRELATION_GAIN_NATS:
        return
    if found.lag_nats >= MIN_LAG_NATS:
        return  # low-pass filtered: another finding
    low, high = (format_number(end, 1) for end in (found.low_s, found.high_s))
    over = f"{low} to {high} s" if np.isfinite(found.high_s) else f"at least {low} s"
    is_gnss = analysis.source.origin.is_gnss
    evidence = {name: value for name, value in asdict(found).items() if np.isfinite(value)}
    assumed_m = [analysis.settings.sigma_z_m, *map(ekf2_noise_m, analysis.axes.values())]
    if (ratio := found.white_m / float(np.nanmin(assumed_m))) > NOISE_RATIO_TOLERANCE:
        evidence[WHITE_RATIO] = ratio
    hint = "Set R to cover both parts; GNSS errors are usually time-correlated."
    if not is_gnss:
        hint = (
            "Check multipath, anchor geometry and filters in the sender, or use positions at "
            "intervals longer than the correlation time."
        )
    make_finding = note if is_gnss else warning
    yield make_finding(
        "source_noise_time_correlated",
        f"The errors of {analysis.source.name} are correlated over {over}. A time-correlated part "
        f"of {found.slow_m:.2g} m (1 σ) adds to white noise of {found.white_m:.2g} m. KF and EKF2 "
        "assume independent errors: they follow the correlated part and report a σ that is too "
        "small. Innovations do not show this part.",
        f"Do not lower SIGMA_Z or the EKF2 measurement noise to the white part. {hint}",
        evidence,
    )


def repeats(analysis: Analysis) -> Found:
    """Detect positions that repeat the previous one while the vehicle moves."""
    if hardly_moved(analysis):
        return
    sent = (
        cut_to_segment(analysis.source.samples, analysis.segment)[Columns.POSITION]
        .dropna()
        .to_numpy()
    )
    again = np.all(np.diff(sent, axis=0) == 0.0, axis=1)
    count, share = int(again.sum()), float(again.mean()) if len(again) else 0.0
    if count < MIN_REPEATS or share < MIN_REPEAT_SHARE:
        return
    make_finding = error if share >= MIN_REPEAT_SHARE_ERROR else warning
    yield make_finding(
        "source_samples_repeated",
        f"{count} of {len(again)} positions of {analysis.source.name} ({format_percent(share)}) "
        "repeat the previous one. The filters count each repetition as a new, independent "
        "measurement, at a time at which nothing was measured.",
        "Send each position once, with its time of measurement.",
        {"count": count, "share": share},
    )


def unequal_noise(analysis: Analysis) -> Found:
    """Detect different noises along north and east."""
    if analysis.source.origin.is_gnss:
        return  # the white part is a small part of the errors of GNSS
    pair = [analysis.axes[name] for name in ("north", "east") if name in analysis.axes]
    statements = [axis.filters["kf"] for axis in pair]
    nis = [one.nis_mean for one in statements if not isinstance(one, Unavailable)]
    if len(nis) < 2 or max(nis) < MIN_AXIS_NIS_RATIO * min(nis):
        return
    tuned = [
        found
        for axis in pair
        for found in tune((axis.axis,), analysis.settings, (axis.axis.name,)).values()
        if isinstance(found, AxisTuning)
    ]
    sizes = [(one.sigma_z.value, one.sigma_z.low, one.sigma_z.high, one.name) for one in tuned]
    known = sorted((s, low, high, name) for s, low, high, name in sizes if s and low and high)
    if len(known) < 2:
        return
    (small, _, small_high, less), (large, large_low, _, more) = known
    if large < MIN_AXIS_RATIO * small or large_low <= small_high:
        return
    yield warning(
        "source_noise_unequal_axes",
        f"The noise of {analysis.source.name} is {large:.2g} m along {more} and {small:.2g} m "
        f"along {less}. One SIGMA_Z, or one EKF2 measurement noise, does not fit both axes.",
        f"Analyse each axis separately (--axis {more} --sigma-z {large:.2g}). For EKF2 use the "
        "larger value. Place the anchors on all sides of the flight area.",
        {f"{less}_sigma_z_m": small, f"{more}_sigma_z_m": large},
    )


def noise_variation(analysis: Analysis) -> Found:
    """Detect a part of the flight in which most innovations are larger."""
    tuned, chosen = analysis.tuning.get(HORIZONTAL), analysis.settings
    if tuned is None:
        return
    # tuning is unavailable if a third of the measurements look like outliers
    sigma_a: float | None = chosen.sigma_a_m_s2
    sigma_z: float | None = chosen.sigma_z_m
    outlier_time_s = np.zeros(0)
    if isinstance(tuned, AxisTuning):
        sigma_a, sigma_z = tuned.sigma_a_two_state.value, tuned.sigma_z.value
        outlier_time_s = tuned.outlier_time_s
    lines = [analysis.axes[name].axis for name in ("north", "east") if name in analysis.axes]
    if sigma_a is None or sigma_z is None or len(lines) < 2:
        return
    legs = [preintegrate(line, chosen) for line in lines]
    time = lines[0].measurement_time_s[-len(legs[0].measurement_m) :]
    if len(time) < MAX_PARTS * MIN_PART_COUNT // 2:
        return
    count = min(MAX_PARTS, len(time) // MIN_PART_COUNT)
    edges = np.linspace(0, len(time), count + 1).astype(int)

    def sized(skip: BoolArray | None) -> Array:
        # with the maximum-likelihood noises: wrong ones change the innovations along the flight
        axis_innovations = [innovations(each, sigma_a, sigma_z, skip) for each in legs]
        normalised = np.abs([nu / np.sqrt(s) for nu, s in axis_innovations])
        # each axis relative to its median, so that unequal axes have no effect
        return np.asarray(normalised / np.median(normalised, axis=1, keepdims=True))

    sizes = sized(None)
    sigma = np.array([np.median(sizes[:, low:high]) for low, high in pairwise(edges)])
    loud = sigma > np.sqrt(sigma.min() * sigma.max())
    begins = int(np.argmax(loud))
    ends = begins + int(np.argmin(loud[begins:])) if not loud[begins:].all() else count
    if loud.sum() != ends - begins or loud.all():
        return  # not a single contiguous part
    quiet = np.ones(len(time), bool)
    quiet[edges[begins] : edges[ends]] = False
    # a fused outlier also makes the innovations after it large
    ratio, ratio_without_outliers = (
        float(np.median(each[:, ~quiet]) / np.median(each[:, quiet]))
        for each in (sizes, sized(np.isin(time, outlier_time_s)))
    )
    if ratio < MIN_PART_RATIO or ratio_without_outliers < MIN_PART_RATIO_WITHOUT_OUTLIERS:
        return
    start, end = float(time[edges[begins]]), float(time[edges[ends] - 1])
    check = "anchors in view, distance and obstacles"
    if analysis.source.origin.is_gnss:
        check = "satellites in view, walls, trees and radio interference"
    yield (error if ratio >= MIN_PART_RATIO_ERROR else warning)(
        "source_noise_varies",
        f"The noise of {analysis.source.name} is {ratio:.1f} times larger from {start:.0f} s to "
        f"{end:.0f} s than in the rest of the flight. Most samples are affected, not single "
        "outliers. No single SIGMA_Z fits the whole flight.",
        f"Check {check} in that time. Let the sender report a variance with each position, or "
        "analyse the parts separately (--start, --end).",
        {"ratio": ratio, "first_s": start, "until_s": end},
        ((start, end),),
    )
