"""Faults of the positions: little motion, low pass, jumps, scale factor, outliers, variance.

Detectability of a scale factor error: six passes at 5 Hz with noise 0.10 m determine it to 3.5 %
(1 σ), so 5 % cannot be detected. At 10 Hz and 0.05 m 15 % can. Smaller errors need a measured
distance or ground truth.
"""

from dataclasses import asdict

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.filter.correlated_noise import SourceLowPass, TimeCorrelatedNoise
from px4fuse.filter.hypotheses import OUTLIER_BURST_S, OUTLIERS_AFTER_STEP_S, BiasScaleJumpFit
from px4fuse.filter.signals import cut_to_segment
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.imu import MIN_IMU_RATE_HZ, too_slow
from px4fuse.findings.model import (
    Found,
    error,
    finding,
    format_count,
    format_percent,
    moments,
    warning,
)
from px4fuse.findings.source_stamps import arrivals
from px4fuse.flight import Columns, Unavailable
from px4fuse.text import format_factor

MIN_MOTION_RANGE_M = 0.5  # m, 5 to 95 %; a hovering vehicle with UWB noise of 0.1 m stays below
NOISE_RANGE_FACTOR = 1.25 * 3.29  # 5 to 95 % range of white noise in σ, with a margin of 25 %
SECOND_DIFFERENCE_FACTOR = 6.0**0.5 / 1.4826  # median |second difference| over σ of white noise
MIN_LOW_PASS_GAIN_NATS = 6.0  # likelihood ratio 400; clean flights have 0 to 2
MIN_LAG_NATS = 1.0  # log-likelihood of a low pass minus that of time-correlated noise
MIN_LAG_S = 0.05  # s; at 1 m/s half of the noise of good UWB (0.1 m)
MIN_LAG_ERROR_S = 0.10  # s; at 1 m/s the noise of good UWB (0.1 m)
MIN_JUMP_M = 0.2  # m; twice the noise of good UWB (0.1 m)
MIN_JUMP_SIGMAS = 5.0  # σ of the time-correlated noise; its difference over a time has √2 σ
MIN_JUMP_ERROR_M = 0.5  # m; five times the noise of good UWB
MIN_SCALE = 0.12  # relative; PX4's simulated flights without a mistake reach 0.11
MIN_SCALE_ERROR = 0.15  # relative; 1 m in 7 m
MIN_SCALE_SIGMAS = 3.0  # standard deviations; 0.3 % of clean flights exceed it
MIN_OUTLIER_SHARE = 0.005  # of the measurements; normal noise has 0.02 % beyond 3.7 σ
MIN_OUTLIER_SHARE_ERROR = 0.02  # of the measurements; one each 10 s at 5 Hz
MIN_OUTLIERS = 3
MIN_VARIANCE_RATIO = 2.0  # reported over actual variance, or its inverse
MIN_VARIANCE_RATIO_ERROR = 3.0  # the same ratio


def detect(analysis: Analysis) -> Found:
    """Detect all faults; some cannot be tested for odometry and for positions rebuilt from EKF2."""
    yield from motion(analysis)
    yield from jumps(analysis)
    yield from outliers(analysis)
    if analysis.source.orientation is None and not analysis.source.origin.reconstructed:
        yield from smoothing(analysis)
        yield from scale(analysis)
        yield from stated_variance(analysis)


def low_pass(analysis: Analysis) -> SourceLowPass | None:
    """Low pass in the source; None if there is none or it cannot be identified."""
    source, found = analysis.source, analysis.smoothing
    # the drift of odometry correlates successive errors as well, and positions rebuilt from EKF2
    # output contain EKF2's filter
    if source.orientation is not None or source.origin.reconstructed:
        return None
    if not _is_clock_known(analysis):
        return None
    if (
        not isinstance(found, SourceLowPass)
        or found.gain_nats < MIN_LOW_PASS_GAIN_NATS
        or found.lag_s < MIN_LAG_S
    ):
        return None
    correlation = analysis.coloured
    # errors that are correlated without a lag are not from a low pass
    if isinstance(correlation, TimeCorrelatedNoise) and correlation.lag_nats < MIN_LAG_NATS:
        return None
    return found


def _is_clock_known(analysis: Analysis) -> bool:
    """Return True if the time offset is estimated: late timestamps look like a lag or a scale."""
    return isinstance(analysis.clock, ClockOffset) and not any(arrivals(analysis))


def smoothing(analysis: Analysis) -> Found:
    """Detect a low pass in the source, which correlates errors and delays positions."""
    found = low_pass(analysis)
    if found is not None:
        make_finding = error if found.lag_s >= MIN_LAG_ERROR_S else warning
        yield make_finding(
            "source_low_pass_filtered",
            f"{analysis.source.name} is low-pass filtered before it is sent. Successive errors "
            f"correlate by {found.correlation:.1f}, and positions lag the motion by "
            f"{found.lag_s:.2f} s. The noise before filtering is {found.sigma_z_m:.2g} m. KF and "
            "EKF2 assume independent errors, so both are overconfident and lag.",
            "Switch off smoothing in the positioning system and send raw positions. Leave the "
            "timestamps as they are: this is not a time offset.",
            asdict(found),
        )


def jumps(analysis: Analysis) -> Found:
    """Detect lasting position steps that the IMU does not measure."""
    found = analysis.bias_scale_jump_fit
    # a step of the time offset also shifts the positions of a moving vehicle
    if not isinstance(found, BiasScaleJumpFit) or any(arrivals(analysis)):
        return
    slow = analysis.coloured
    # time-correlated noise changes by about its σ within seconds
    least = MIN_JUMP_M
    if not isinstance(slow, Unavailable):
        least = max(least, MIN_JUMP_SIGMAS * slow.slow_m)
    large = [jump for jump in found.jumps if jump.size_m >= least]
    if large:
        largest = max(large, key=lambda jump: jump.size_m)
        size, at_s, sigma = largest.size_m, largest.time_s, max(s.sigma for s in largest.step_m)
        causes = "a false map match, another set of anchors, or a new origin"
        action = "Keep one origin and one set of anchors in flight."
        if analysis.source.origin.is_gnss:
            causes = "another set of satellites, multipath, or a change of the RTK status"
            action = "Wait for a steady fix (RTK) before take-off and keep the antenna uncovered."
        yield finding(
            "error" if size >= MIN_JUMP_ERROR_M else "warning",
            "source_position_jump",
            f"{analysis.source.name} jumps {format_count(len(large))} and stays there, by "
            f"{size:.2f} m (± {1.96 * sigma:.2f} m) at {at_s:.1f} s. The IMU measures no such "
            f"motion. Possible causes: {causes}. After the jump KF and EKF2 are wrong by its size, "
            "with consistent innovations.",
            f"Analyse one side of the jump (--start, --end). {action}",
            {"count": len(large), "size_m": size, "at_s": at_s, "sigma_m": sigma},
            moments(jump.time_s for jump in large),
        )


def scale(analysis: Analysis) -> Found:
    """Detect a scale factor error of the source, relative to an IMU with a sufficient rate."""
    imu, found = analysis.flight.imu, analysis.bias_scale_jump_fit
    if not isinstance(imu, pd.DataFrame) or too_slow(imu, MIN_IMU_RATE_HZ):
        return
    # GNSS has no scale factor error, so another fault would be mistaken for one
    if analysis.source.origin.is_gnss:
        return
    # a low pass also reduces the motion, and time-correlated noise agrees with it by coincidence
    if not isinstance(found, BiasScaleJumpFit) or low_pass(analysis) is not None:
        return
    if not isinstance(analysis.coloured, Unavailable) or not _is_clock_known(analysis):
        return
    excess, sigma = found.scale.value, found.scale.sigma
    if abs(excess) >= max(MIN_SCALE, MIN_SCALE_SIGMAS * sigma):
        yield finding(
            "error" if abs(excess) >= MIN_SCALE_ERROR else "warning",
            "source_scale_error",
            f"Distances of {analysis.source.name} are {format_percent(abs(excess))} too "
            f"{'long' if excess > 0 else 'short'} (± {format_percent(1.96 * sigma)}) compared with "
            "the IMU. Innovations do not show a scale factor error.",
            "Measure a known distance with the source. Survey the anchors again, and check unit "
            "and calibration.",
            {"scale": 1.0 + excess, "sigma": sigma},
        )


def outliers(analysis: Analysis) -> Found:
    """Detect more outliers than normal noise has, without those next to a lasting step."""
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
    if share < MIN_OUTLIER_SHARE or count < MIN_OUTLIERS:
        return
    first, origin = ", ".join(f"{time:.1f}" for time in times_s[:3]), analysis.source.origin
    noises = "SIGMA_Z" if origin.aid is None else f"SIGMA_Z or {origin.aid.noise}"
    likely = "no line of sight (NLOS)"
    action = "Restore line of sight to the anchors there, or reject these positions before sending."
    if origin.is_gnss:
        likely = "multipath, or a change of the solution"
        action = "Keep the antenna in free view of the sky, away from walls and interference."
    yield finding(
        "error" if share >= MIN_OUTLIER_SHARE_ERROR else "warning",
        "source_outliers",
        f"{count} of {tuned.count} positions ({format_percent(share, 1)}) are outliers "
        f"({tuned.name}; {'first ' if count > 3 else ''}at {first} s). Likely cause: {likely}. "
        "Outliers pull both filters and increase the estimated noise unless they are removed.",
        f"{action} Do not increase {noises} for outliers.",
        {"count": count, "share": share, "first_s": times_s[0]},
        moments(times_s),
    )


def stated_variance(analysis: Analysis) -> Found:
    """Detect a reported variance outside the 95 % interval of the position noise."""
    source, tuned = analysis.source, analysis.tuning.get(HORIZONTAL)
    # for a low-pass filtered source the noise between samples is only part of the error
    smooths = isinstance(analysis.smoothing, Unavailable) or low_pass(analysis) is not None
    if smooths or not isinstance(tuned, AxisTuning) or not source.origin.is_vision:
        return
    reported = cut_to_segment(source.samples, analysis.segment)[
        Columns.POSITION_VARIANCE[:2]
    ].dropna()
    noise, low, high = tuned.sigma_z.value, tuned.sigma_z.low, tuned.sigma_z.high
    if reported.empty or noise is None or low is None or high is None:
        return
    sigma = float(np.sqrt(reported.to_numpy().mean(axis=1)).mean())
    factor = (sigma / noise) ** 2
    size = max(factor, 1.0 / factor)
    # R has to cover time-correlated errors too, which innovations do not show
    error_m = _error_m(analysis) if factor > 1.0 else None
    if error_m is not None and sigma**2 < MIN_VARIANCE_RATIO * error_m**2:
        return
    if size >= MIN_VARIANCE_RATIO and not low <= sigma <= high:
        side = "small"
        if factor >= 1.0:
            side = "large"
            if error_m is None:
                side += ", unless it covers time-correlated errors"
        yield finding(
            "error" if size >= MIN_VARIANCE_RATIO_ERROR else "warning",
            "source_reported_variance_wrong",
            f"{source.name} reports σ {sigma:.3g} m, but its noise is {noise:.3g} m (95 % "
            f"{low:.3g} to {high:.3g} m). The reported variance is {format_factor(size)} times too "
            f"{side}. EKF2 takes R from it (EKF2_EV_NOISE_MD 0), but not less than EKF2_EVP_NOISE.",
            f"Report a variance of {noise**2:.2g} m² at the sender, or set EKF2_EV_NOISE_MD to 1 "
            f"and EKF2_EVP_NOISE to {noise:.2g} m.",
            {"reported_sigma_m": sigma, "sigma_z_m": noise, "variance_factor": factor},
        )


def _error_m(analysis: Analysis) -> float | None:
    """Horizontal RMSE per axis (m) of the positions; None without ground truth."""
    squares = []
    for result in (analysis.axes[name] for name in ("north", "east") if name in analysis.axes):
        if isinstance(result.truth, Unavailable):
            return None
        true, axis = result.truth["position_m"].dropna(), result.axis
        at = np.interp(axis.measurement_time_s, true.index, true, left=np.nan, right=np.nan)
        squares.append(np.nanmean((axis.measurement_m - at) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else None


def motion_range_m(comparison: Comparison) -> float:
    """Larger horizontal extent (m) of the source in the segment, 5 to 95 % of the positions."""
    inside = cut_to_segment(comparison.source.samples, comparison.segment)
    low, high = inside[Columns.POSITION[:2]].quantile([0.05, 0.95]).to_numpy()
    return float(np.max(high - low))


def hardly_moved(comparison: Comparison) -> bool:
    """Return True if the extent of the positions is below 0.5 m or explained by their noise.

    The noise is estimated from second differences, which a steady motion does not affect.
    """
    inside = cut_to_segment(comparison.source.samples, comparison.segment)[
        Columns.POSITION[:2]
    ].dropna()
    second_difference_m = np.median(np.abs(np.diff(inside.to_numpy(), 2, axis=0)), axis=0)
    noise_m = float(second_difference_m.max()) / SECOND_DIFFERENCE_FACTOR
    return motion_range_m(comparison) < max(MIN_MOTION_RANGE_M, NOISE_RANGE_FACTOR * noise_m)


def motion(analysis: Analysis) -> Found:
    """Detect too little motion to identify velocity, heading and time offset."""
    extent = motion_range_m(analysis)
    if hardly_moved(analysis):
        yield warning(
            "no_motion",
            f"The vehicle moved only {extent:.2f} m horizontally (5 to 95 % of the positions). "
            "Velocity, heading and time offset cannot be estimated from this flight.",
            "Fly several passes of 5 m or more, with clear starts and stops.",
            {"range_m": extent},
        )
