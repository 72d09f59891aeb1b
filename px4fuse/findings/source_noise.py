"""What the noise of positions is like where it is not white, equal and the same all the time.

Neither filter has a state for it: R describes white noise of one size.
"""

from dataclasses import asdict
from itertools import pairwise

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.coloured import TimeCorrelatedNoise
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, tune
from px4fuse.findings.causes import WHITE_BEYOND
from px4fuse.findings.model import Found, error, info, warning
from px4fuse.findings.noises import NOISE_FITS, ekf2_noise_m
from px4fuse.findings.source_positions import LAG_NATS, hardly_moved
from px4fuse.flight import Columns, Unavailable
from px4fuse.plain import format_number

COLOURED_NATS = 5.0  # a likelihood ratio of 150 for two more numbers; 1 of 400 clean flights
REPEATS = 0.05  # of the positions
REPEATS_ERROR = 0.3  # of the positions: no longer the rate that it seems
MIN_REPEATS = 10
UNEQUAL = 1.5  # times in σ, the larger axis over the smaller
UNEQUAL_NIS = 1.7  # times in NIS before the noises of each axis are sought
LEVELS = 2.0  # times in σ, the noisier part over the quieter
LEVELS_UNPULLED = 1.5  # times in σ, where no outlier is fused
LEVELS_ERROR = 4.0  # times in σ
WINDOWS, MIN_WINDOW = 12, 25  # of the flight, and measurements in each


def detect(analysis: Analysis) -> Found:
    """All of them; of odometry and of what was made of EKF2's output nothing can be said."""
    if analysis.source.orientation is not None or analysis.source.origin.reconstructed:
        return
    yield from repeats(analysis)
    yield from time_correlated_noise(analysis)
    yield from unequal_noise(analysis)
    yield from noise_variation(analysis)


def time_correlated_noise(analysis: Analysis) -> Found:
    """Errors that hang together without a lag."""
    found = analysis.coloured
    if not isinstance(found, TimeCorrelatedNoise) or found.gain_nats < COLOURED_NATS:
        return
    if found.lag_nats >= LAG_NATS:
        return  # smoothed
    low, high = (format_number(end, 1) for end in (found.low_s, found.high_s))
    over = f"{low} to {high} s" if np.isfinite(found.high_s) else f"at least {low} s"
    gnss, source = analysis.source.origin.is_gnss, analysis.source.name
    evidence = {name: value for name, value in asdict(found).items() if np.isfinite(value)}
    assumed_m = [analysis.settings.sigma_z_m, *map(ekf2_noise_m, analysis.axes.values())]
    if (beyond := found.white_m / float(np.nanmin(assumed_m))) > NOISE_FITS:
        evidence[WHITE_BEYOND] = beyond
    make_finding = info if gnss else warning
    yield make_finding(
        "source_coloured", evidence, found=found, source=source, over=over, gnss=gnss
    )


def repeats(analysis: Analysis) -> Found:
    """Positions that are the one before, sent again, while the vehicle moves."""
    if hardly_moved(analysis):
        return
    sent = within(analysis.source.samples, analysis.segment)[Columns.POSITION].dropna().to_numpy()
    again = np.all(np.diff(sent, axis=0) == 0.0, axis=1)
    count, share = int(again.sum()), float(again.mean()) if len(again) else 0.0
    if count < MIN_REPEATS or share < REPEATS:
        return
    make_finding, evidence = (
        error if share >= REPEATS_ERROR else warning,
        {"count": count, "share": share},
    )
    yield make_finding("source_repeats", evidence, source=analysis.source.name, of=len(again))


def unequal_noise(analysis: Analysis) -> Found:
    """North and east with noises of different size."""
    if analysis.source.origin.is_gnss:
        return  # its white part says nothing of its errors
    pair = [analysis.axes[name] for name in ("north", "east") if name in analysis.axes]
    statements = [axis.filters["kf"] for axis in pair]
    nis = [one.nis_mean for one in statements if not isinstance(one, Unavailable)]
    if len(nis) < 2 or max(nis) < UNEQUAL_NIS * min(nis):
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
    if large < UNEQUAL * small or large_low <= small_high:
        return
    yield warning(
        "source_axes_unequal",
        {f"{less}_sigma_z_m": small, f"{more}_sigma_z_m": large},
        source=analysis.source.name,
        large=large,
        noisier=more,
        small=small,
        less=less,
    )


def noise_variation(analysis: Analysis) -> Found:
    """A part of the flight in which the bulk of the innovations is larger."""
    tuned, chosen = analysis.tuning.get(HORIZONTAL), analysis.settings
    if tuned is None:
        return
    # not known where a third looks like outliers
    sigma_a: float | None = chosen.sigma_a_m_s2
    sigma_z: float | None = chosen.sigma_z_m
    outlier_time_s = np.zeros(0)
    if isinstance(tuned, AxisTuning):
        sigma_a, sigma_z = tuned.filter_sigma_a.value, tuned.sigma_z.value
        outlier_time_s = tuned.outlier_time_s
    lines = [analysis.axes[name].axis for name in ("north", "east") if name in analysis.axes]
    if sigma_a is None or sigma_z is None or len(lines) < 2:
        return
    legs = [preintegrate(line, chosen) for line in lines]
    time = lines[0].measurement_time_s[-len(legs[0].measurement_m) :]
    if len(time) < WINDOWS * MIN_WINDOW // 2:
        return
    count = min(WINDOWS, len(time) // MIN_WINDOW)
    edges = np.linspace(0, len(time), count + 1).astype(int)

    def sized(skip: BoolArray | None) -> Array:
        # with the noises that the data ask for: others would make the innovations grow and shrink
        axis_innovations = [innovations(each, sigma_a, sigma_z, skip) for each in legs]
        normalised = np.abs([nu / np.sqrt(s) for nu, s in axis_innovations])
        # each axis by its own size, so that unequal axes are no change
        return np.asarray(normalised / np.median(normalised, axis=1, keepdims=True))

    sizes = sized(None)
    sigma = np.array([np.median(sizes[:, low:high]) for low, high in pairwise(edges)])
    loud = sigma > np.sqrt(sigma.min() * sigma.max())
    begins = int(np.argmax(loud))
    ends = begins + int(np.argmin(loud[begins:])) if not loud[begins:].all() else count
    if loud.sum() != ends - begins or loud.all():
        return  # no single part
    quiet = np.ones(len(time), bool)
    quiet[edges[begins] : edges[ends]] = False
    # an outlier that is fused makes those after it large too
    ratio, unpulled = (
        float(np.median(each[:, ~quiet]) / np.median(each[:, quiet]))
        for each in (sizes, sized(np.isin(time, outlier_time_s)))
    )
    if ratio < LEVELS or unpulled < LEVELS_UNPULLED:
        return
    start, end = float(time[edges[begins]]), float(time[edges[ends] - 1])
    yield (error if ratio >= LEVELS_ERROR else warning)(
        "source_noise_changes",
        {"ratio": ratio, "first_s": start, "until_s": end},
        ((start, end),),
        source=analysis.source.name,
        gnss=analysis.source.origin.is_gnss,
    )
