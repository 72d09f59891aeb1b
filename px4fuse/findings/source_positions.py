"""What is wrong with the positions themselves: still, smoothed, stepping, scattered, scaled.

How well a log can show a scale: six passes at 5 Hz and 0.10 m give it to 3.5 % (one σ), so that
5 % is invisible, whatever is computed; 15 % is seen at 10 Hz and 0.05 m. Small errors need a tape
measure or the truth.
"""

from dataclasses import asdict

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.filter.causes import OUTLIER_BURST_S, OUTLIERS_AFTER_STEP_S, BiasScaleJumpFit
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.coloured import SourceLowPass, TimeCorrelatedNoise
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.imu import MIN_IMU_RATE_HZ, too_slow
from px4fuse.findings.model import Found, error, finding, format_count, moments, warning
from px4fuse.findings.source_stamps import arrivals
from px4fuse.flight import Columns, Unavailable
from px4fuse.plain import format_factor

MOTION_RANGE_M = 0.5  # 5 to 95 %; a hovering drone with 0.1 m UWB stays below
NOISE_RANGE = 1.25 * 3.29  # of white noise's σ from 5 to 95 %, with a quarter for chance
SECOND_DIFFERENCE = 6.0**0.5 / 1.4826  # their median size over σ
GAIN_NATS = 6.0  # a likelihood ratio of 400; clean flights have 0 to 2
LAG_NATS = 1.0  # a low pass e times as likely as a slow error, which has one number more
LAG_S = 0.05  # at 1 m/s half of a good UWB's noise
LAG_ERROR_S = 0.10  # at 1 m/s a good UWB's noise
JUMP_M = 0.2  # twice a good UWB's noise
WANDERS = 5.0  # of the slow error's σ; its difference over a time has √2
JUMP_ERROR_M = 0.5  # no longer the same place
SCALE = 0.12  # of the distance; flights of PX4's simulation are within 0.11
SCALE_ERROR = 0.15  # of the distance: a metre in seven
SCALE_SIGMAS = 3.0  # standard deviations; 0.3 % of clean flights lie beyond
OUTLIERS = 0.005  # of the measurements; a normal source has 0.02 % beyond 3.7 σ
OUTLIERS_ERROR = 0.02  # of the measurements: every tenth second at 5 Hz
MIN_OUTLIERS = 3
REPORTED = 2.0  # times in variance: EKF2's own NIS is off by about that
REPORTED_ERROR = 3.0  # times in variance: beyond what EKF2's NIS bears


def detect(analysis: Analysis) -> Found:
    """All of them; odometry, and what was made of EKF2's output, only where that says something."""
    yield from motion(analysis)
    yield from jumps(analysis)
    yield from outliers(analysis)
    if analysis.source.orientation is None and not analysis.source.origin.reconstructed:
        yield from smoothing(analysis)
        yield from scale(analysis)
        yield from stated_variance(analysis)


def low_pass(analysis: Analysis) -> SourceLowPass | None:
    """The low pass in the source, None where there is none or it cannot be told."""
    source, found = analysis.source, analysis.smoothing
    # the error of odometry drifts, which makes that of successive positions agree as well; what
    # was made of EKF2's own output has EKF2's filter in it
    if source.orientation is not None or source.origin.reconstructed:
        return None
    if not _is_clock_known(analysis):
        return None
    if not isinstance(found, SourceLowPass) or found.gain_nats < GAIN_NATS or found.lag_s < LAG_S:
        return None
    slow = analysis.coloured
    # errors that hang together without a lag are slow, not smoothed
    return None if isinstance(slow, TimeCorrelatedNoise) and slow.lag_nats < LAG_NATS else found


def _is_clock_known(analysis: Analysis) -> bool:
    """Whether the stamps can be judged: late ones look like a lag, or like longer distances."""
    return isinstance(analysis.clock, ClockOffset) and not any(arrivals(analysis))


def smoothing(analysis: Analysis) -> Found:
    """A low pass makes errors agree and positions late."""
    found = low_pass(analysis)
    if found is not None:
        make_finding = error if found.lag_s >= LAG_ERROR_S else warning
        yield make_finding(
            "source_smoothed", asdict(found), found=found, source=analysis.source.name
        )


def jumps(analysis: Analysis) -> Found:
    """Steps to another place that the IMU does not measure: a false match, a moved anchor."""
    found = analysis.bias_scale_jump_fit
    # a moving vehicle's positions jump where the stamps do
    if not isinstance(found, BiasScaleJumpFit) or any(arrivals(analysis)):
        return
    slow = analysis.coloured
    # a slow error wanders by some of its σ within seconds
    least = JUMP_M if isinstance(slow, Unavailable) else max(JUMP_M, WANDERS * slow.slow_m)
    large = [jump for jump in found.jumps if jump.size_m >= least]
    if large:
        largest = max(large, key=lambda jump: jump.size_m)
        size, at_s, sigma = largest.size_m, largest.time_s, max(s.sigma for s in largest.step_m)
        yield finding(
            "error" if size >= JUMP_ERROR_M else "warning",
            "source_jumps",
            {"count": len(large), "size_m": size, "at_s": at_s, "sigma_m": sigma},
            moments(jump.time_s for jump in large),
            source=analysis.source.name,
            often=format_count(len(large)),
            within_m=1.96 * sigma,
            case=analysis.source.origin.is_gnss,
        )


def scale(analysis: Analysis) -> Found:
    """Distances are too long or too short, by an IMU that misses no motion."""
    imu, found = analysis.flight.imu, analysis.bias_scale_jump_fit
    # GNSS measures in metres: what looks like a scale is something else
    if not isinstance(imu, pd.DataFrame) or too_slow(imu, MIN_IMU_RATE_HZ):
        return
    if analysis.source.origin.is_gnss:
        return
    # a low pass takes from the motion as well, and a slow error moves with it by chance
    if not isinstance(found, BiasScaleJumpFit) or low_pass(analysis) is not None:
        return
    if not isinstance(analysis.coloured, Unavailable) or not _is_clock_known(analysis):
        return
    off, sigma = found.scale.value, found.scale.sigma
    if abs(off) >= max(SCALE, SCALE_SIGMAS * sigma):
        yield finding(
            "error" if abs(off) >= SCALE_ERROR else "warning",
            "source_scale_wrong",
            {"scale": 1.0 + off, "sigma": sigma},
            source=analysis.source.name,
            off=abs(off),
            long=off > 0,
            within=1.96 * sigma,
        )


def outliers(analysis: Analysis) -> Found:
    """More than a normal source has, without what begins a step that stays."""
    tuned = analysis.tuning.get(HORIZONTAL) or next(iter(analysis.tuning.values()), None)
    if not isinstance(tuned, AxisTuning):
        return
    found = analysis.bias_scale_jump_fit
    steps = [jump.time_s for jump in found.jumps] if isinstance(found, BiasScaleJumpFit) else []
    times_s = [
        time
        for time in tuned.outlier_time_s.tolist()
        if not any(at - OUTLIER_BURST_S <= time < at + OUTLIERS_AFTER_STEP_S for at in steps)
    ]
    count, share = len(times_s), len(times_s) / tuned.count
    if share < OUTLIERS or count < MIN_OUTLIERS:
        return
    first, origin = ", ".join(f"{time:.1f}" for time in times_s[:3]), analysis.source.origin
    yield finding(
        "error" if share >= OUTLIERS_ERROR else "warning",
        "source_outliers",
        {"count": count, "share": share, "first_s": times_s[0]},
        moments(times_s),
        tuned=tuned,
        first=first,
        others=count > 3,
        case=origin.is_gnss,
        aid=origin.aid,
        or_noise=origin.aid is not None,
    )


def stated_variance(analysis: Analysis) -> Found:
    """The variance that the source reports is outside the interval of its noise."""
    source, tuned = analysis.source, analysis.tuning.get(HORIZONTAL)
    # where the source smooths, the noise from one position to the next is not all
    smooths = isinstance(analysis.smoothing, Unavailable) or low_pass(analysis) is not None
    if smooths or not isinstance(tuned, AxisTuning) or not source.origin.is_vision:
        return
    reported = within(source.samples, analysis.segment)[Columns.POSITION_VARIANCE[:2]].dropna()
    noise, low, high = tuned.sigma_z.value, tuned.sigma_z.low, tuned.sigma_z.high
    if reported.empty or noise is None or low is None or high is None:
        return
    sigma = float(np.sqrt(reported.to_numpy().mean(axis=1)).mean())
    factor = (sigma / noise) ** 2
    size = max(factor, 1.0 / factor)
    # slow errors, which R has to cover too, show in no innovation
    error_m = _error_m(analysis) if factor > 1.0 else None
    if error_m is not None and sigma**2 < REPORTED * error_m**2:
        return
    if size >= REPORTED and not low <= sigma <= high:
        yield finding(
            "error" if size >= REPORTED_ERROR else "warning",
            "source_variance_wrong",
            {"reported_sigma_m": sigma, "sigma_z_m": noise, "variance_factor": factor},
            source=source.name,
            low=low,
            high=high,
            times=format_factor(size),
            small=factor < 1.0,
            slow=factor > 1.0 and error_m is None,
            variance_m2=noise**2,
        )


def _error_m(analysis: Analysis) -> float | None:
    """Root mean square of the positions' own errors along an axis (m); None without a truth."""
    squares = []
    for result in (analysis.axes[name] for name in ("north", "east") if name in analysis.axes):
        if isinstance(result.truth, Unavailable):
            return None
        true, axis = result.truth["position_m"].dropna(), result.axis
        at = np.interp(axis.measurement_time_s, true.index, true, left=np.nan, right=np.nan)
        squares.append(np.nanmean((axis.measurement_m - at) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else None


def motion_range_m(comparison: Comparison) -> float:
    """Larger horizontal extent of the source in the segment, 5 to 95 %."""
    inside = within(comparison.source.samples, comparison.segment)
    low, high = inside[Columns.POSITION[:2]].quantile([0.05, 0.95]).to_numpy()
    return float(np.max(high - low))


def hardly_moved(comparison: Comparison) -> bool:
    """Whether the extent of the positions may as well be their noise.

    The noise is told by second differences, which know no steady motion.
    """
    inside = within(comparison.source.samples, comparison.segment)[Columns.POSITION[:2]].dropna()
    noise_m = np.median(np.abs(np.diff(inside.to_numpy(), 2, axis=0)), axis=0) / SECOND_DIFFERENCE
    return motion_range_m(comparison) < max(MOTION_RANGE_M, NOISE_RANGE * float(noise_m.max()))


def motion(analysis: Analysis) -> Found:
    """The vehicle hardly moved: nothing about dynamics can be identified."""
    extent = motion_range_m(analysis)
    if hardly_moved(analysis):
        yield warning("no_motion", {"range_m": extent})
