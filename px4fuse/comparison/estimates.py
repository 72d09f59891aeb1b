"""Estimates of noises, time offset, yaw misalignment and errors of the position source.

The noise estimates do not contain the drift of odometry.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from scipy.special import stdtr

from px4fuse.core.arrays import Array, compute_median_interval_s
from px4fuse.filter.correlated_noise import (
    SourceLowPass,
    TimeCorrelatedNoise,
    fit_time_correlation,
    fit_time_correlation_to_truth,
)
from px4fuse.filter.fitting import NoiseParameters
from px4fuse.filter.frame_rotation import HeadingError, estimate_heading_error
from px4fuse.filter.hypotheses import (
    OUTLIER_RETEST_DURATION_AFTER_JUMP_S,
    SystematicErrors,
    fit_systematic_errors,
)
from px4fuse.filter.imu_motion import MAX_IMU_INTERVAL_S, MotionCache
from px4fuse.filter.signals import AISLE_AXIS, Axis
from px4fuse.filter.time_offset import (
    MAX_OFFSET_INTERVAL_HALF_WIDTH_S,
    MIN_TIME_OFFSET_CHANGE_S,
    SourceTimeOffset,
    estimate_time_offset,
)
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, tune
from px4fuse.flight.model import DIAGNOSIS_WITHHELD, FULL_IMU_RATE_ACTION, Flight, Unavailable

from .imu_oscillation import ImuOscillation, find_imu_oscillation
from .model import Comparison, PreparedComparison
from .noise_differences import (
    NoisyFlightPart,
    find_noisy_flight_part,
    tune_perpendicular_axes,
)

# Minimum IMU rate (Hz) to estimate a time offset
MIN_TIME_OFFSET_IMU_HZ = 1.0 / MAX_IMU_INTERVAL_S
# PX4 publishes vehicle_imu at 200 Hz (IMU_INTEG_RATE): slower telemetry skips samples
MIN_TELEMETRY_IMU_HZ = 200.0
# Measured IMU rates are up to 2 % lower than the nominal rate
MIN_MEASURED_TO_NOMINAL_IMU_RATE_RATIO = 0.98
IMU_OSCILLATES = Unavailable(
    "low-pass filter of the position source",
    "the measured acceleration oscillates, so a low-pass filter cannot be recognised",
    "Check the mounting of the autopilot.",
)
TELEMETRY_IMU_MESSAGES = ("HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")

# Minimum number of time offset estimates before and after a change of the time offset
MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE = 2

# Axes with a noise estimate in the report; north and east have a common estimate
REPORTED_AXES = (HORIZONTAL, "down")

Progress = Callable[[str], None]
TuningByAxis = Mapping[str, AxisTuning | Unavailable]


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """Maximum-likelihood estimates of noises, time offset and errors of the position source.

    Attributes
    ----------
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
        Measurement noise and process noise.
    time_offset : SourceTimeOffset or Unavailable
        Time offset between position source and IMU.
    heading : HeadingError or Unavailable
        Yaw misalignment of the position frame.
    axis_tunings : tuple of AxisTuning
        Noises along two perpendicular axes, if they differ.
    noisy_flight_part : NoisyFlightPart or None
        Time span with larger innovations than in the rest of the flight.
    imu_oscillation : ImuOscillation or None
        Oscillation of the accelerometer that the positions do not contain.
    """

    tuning: TuningByAxis
    time_offset: SourceTimeOffset | Unavailable
    heading: HeadingError | Unavailable
    systematic_errors: SystematicErrors | Unavailable
    source_low_pass: SourceLowPass | Unavailable
    time_correlated_noise: TimeCorrelatedNoise | Unavailable
    axis_tunings: tuple[AxisTuning, ...] = ()
    noisy_flight_part: NoisyFlightPart | None = None
    imu_oscillation: ImuOscillation | None = None


def ignore_progress(_: str) -> None:
    """Ignore the progress text."""


def find_first_available_tuning(tuning: TuningByAxis, *axis_names: str) -> AxisTuning | None:
    """Return the noise estimate of the first axis in ``axis_names`` that has an estimate."""
    axis_tunings = map(tuning.get, axis_names)
    return next(
        (axis_tuning for axis_tuning in axis_tunings if isinstance(axis_tuning, AxisTuning)), None
    )


def estimate(comparison: Comparison, progress: Progress = ignore_progress) -> Estimates:
    """Estimate noises, time offset, yaw misalignment and systematic errors of a position source."""
    has_north_and_east = {"north", "east"} <= {axis.name for axis in comparison.input_axes}
    motion_cache: MotionCache = {}
    tuning, time_offset = estimate_noises_and_time_offset(
        comparison, progress, REPORTED_AXES if has_north_and_east else None, motion_cache
    )
    imu_oscillation = find_imu_oscillation(comparison)
    systematic_errors, source_low_pass, correlated_noise = _fit_source_errors(
        comparison, tuning, time_offset, imu_oscillation, motion_cache
    )
    progress("heading")
    heading_error = estimate_frame_rotation(comparison, tuning, time_offset)
    axis_tunings, noisy_flight_part = tuple[AxisTuning, ...](), None
    if comparison.source.orientation is None:  # no odometry
        if not comparison.source.origin.is_gnss:
            axis_tunings = tune_perpendicular_axes(comparison)
        noisy_flight_part = find_noisy_flight_part(comparison, tuning.get(HORIZONTAL))
    return Estimates(
        tuning=tuning,
        time_offset=time_offset,
        heading=heading_error,
        systematic_errors=systematic_errors,
        source_low_pass=source_low_pass,
        time_correlated_noise=correlated_noise,
        axis_tunings=axis_tunings,
        noisy_flight_part=noisy_flight_part,
        imu_oscillation=imu_oscillation,
    )


def estimate_noises(
    comparison: PreparedComparison,
    axis_names: tuple[str, ...] | None = None,
    progress: Progress = ignore_progress,
    motion_cache: MotionCache | None = None,
) -> dict[str, AxisTuning | Unavailable]:
    """Estimate measurement noise and process noise along the axes.

    Parameters
    ----------
    comparison : Comparison
    axis_names : tuple of str, optional
        Axis names, or "horizontal" for north and east together; default: all.
    progress : callable
        Called with the name of each estimate.
    motion_cache : dict, optional
        Cache of the motion from the IMU.
    """
    flight = comparison.flight
    if flight.log.is_assessed:
        return {HORIZONTAL: DIAGNOSIS_WITHHELD}
    low_imu_rate_reason = explain_low_imu_rate(flight)
    return tune(
        comparison.input_axes,
        comparison.settings,
        axis_names,
        lambda name: progress(f"tuning {name}"),
        flight if low_imu_rate_reason is None else replace(flight, imu=low_imu_rate_reason),
        comparison.source.origin.may_drift,
        motion_cache,
    )


def estimate_noises_and_time_offset(
    comparison: PreparedComparison,
    progress: Progress = ignore_progress,
    axis_names: tuple[str, ...] | None = (HORIZONTAL,),
    motion_cache: MotionCache | None = None,
) -> tuple[TuningByAxis, SourceTimeOffset | Unavailable]:
    """Estimate measurement noise, process noise, and the time offset between positions and IMU.

    Parameters are those of :func:`estimate_noises`.
    """
    motion_cache = {} if motion_cache is None else motion_cache
    tuning = estimate_noises(comparison, axis_names, progress, motion_cache)
    if comparison.flight.log.is_assessed:
        return tuning, DIAGNOSIS_WITHHELD
    if low_imu_rate_reason := explain_low_imu_rate(comparison.flight):
        return tuning, low_imu_rate_reason
    settings, outlier_time_s = comparison.settings, None
    noises = NoiseParameters(settings.sigma_a_m_s2, settings.sigma_z_m)
    if axis_tuning := find_first_available_tuning(tuning, HORIZONTAL, *tuning):
        noises, outlier_time_s = axis_tuning.noises, axis_tuning.outlier_time_s
    time_offset = estimate_time_offset(
        comparison.flight,
        comparison.source,
        comparison.segment,
        settings,
        noises,
        outlier_time_s,
        progress,
        motion_cache,
    )
    if not isinstance(time_offset, SourceTimeOffset):
        return tuning, time_offset
    if comparison.source.origin.may_drift:
        time_offset = widen_for_scatter(time_offset, "the positions drift")
    elif time_offset.has_changed() and find_imu_oscillation(comparison):
        time_offset = widen_for_scatter(time_offset, "the accelerometer oscillates")
    return tuning, time_offset


def estimate_frame_rotation(
    comparison: Comparison,
    tuning: TuningByAxis,
    time_offset: SourceTimeOffset | Unavailable,
) -> HeadingError | Unavailable:
    """Estimate the yaw misalignment of the position frame."""
    sigma_z_m = comparison.settings.sigma_z_m
    if axis_tuning := find_first_available_tuning(tuning, HORIZONTAL):
        sigma_z_m = axis_tuning.sigma_z.value_or_bound(sigma_z_m)
    offset_s = 0.0
    if isinstance(time_offset, SourceTimeOffset) and time_offset.is_determinable:
        offset_s = time_offset.remaining_s
    return estimate_heading_error(
        comparison.flight,
        comparison.source,
        comparison.segment,
        comparison.settings,
        sigma_z_m,
        offset_s,
    )


def _fit_source_errors(
    comparison: Comparison,
    tuning: TuningByAxis,
    time_offset: SourceTimeOffset | Unavailable,
    oscillation: ImuOscillation | None,
    motion_cache: MotionCache,
) -> tuple[
    SystematicErrors | Unavailable,
    SourceLowPass | Unavailable,
    TimeCorrelatedNoise | Unavailable,
]:
    """Fit biases, scale factor and jumps, then the time correlation of the remaining errors.

    Each fit uses the results of the fit before. The second and third returned values are two
    alternative models of the time correlation: low-pass filter, and time-correlated noise.
    """
    axes_and_tuning = _select_horizontal_axes(comparison, tuning)
    if isinstance(axes_and_tuning, Unavailable):
        return axes_and_tuning, axes_and_tuning, axes_and_tuning
    flight, settings, (axes, axis_tuning) = comparison.flight, comparison.settings, axes_and_tuning
    # If the estimated time offset differs significantly from the offset in the timestamps, all fits
    # correct the timestamps by the difference
    offset_s = 0.0
    if (
        isinstance(time_offset, SourceTimeOffset)
        and time_offset.is_determinable
        and abs(time_offset.remaining_s) > time_offset.significance_limit_s
    ):
        offset_s = time_offset.remaining_s
    # 1. Biases, scale factor and jumps
    systematic_errors = fit_systematic_errors(
        flight,
        axes,
        settings,
        sigma_a_m_s2=axis_tuning.sigma_a_two_state.value_or_bound(settings.sigma_a_m_s2),
        sigma_z_m=axis_tuning.sigma_z.value_or_bound(settings.sigma_z_m),
        outlier_time_s=axis_tuning.outlier_time_s,
        clock_offset_s=offset_s,
        source_reset_times_s=comparison.source.reset_times_s.tolist(),
    )
    jumps = systematic_errors.jumps if isinstance(systematic_errors, SystematicErrors) else ()
    # 2. Time correlation of the errors, without outliers. The exact time of a jump is unknown:
    # exclude the measurements directly after it, too
    time_s, excluded_times_s = axes[0].measurement_time_s, axis_tuning.outlier_time_s
    for jump in jumps:
        is_after_jump = (time_s >= jump.time_s) & (
            time_s < jump.time_s + OUTLIER_RETEST_DURATION_AFTER_JUMP_S
        )
        excluded_times_s = np.union1d(excluded_times_s, time_s[is_after_jump])
    time_correlation_fit = fit_time_correlation(
        flight,
        axes,
        settings,
        axis_tuning.noises,
        outlier_time_s=excluded_times_s,
        clock_offset_s=offset_s,
        jumps=jumps,
        motion_cache=motion_cache,
    )
    if isinstance(time_correlation_fit, Unavailable):
        return systematic_errors, time_correlation_fit, time_correlation_fit
    # 3. With ground truth on all axes, fit time-correlated noise to the errors of the positions
    source_low_pass, correlated_noise = time_correlation_fit
    truths = [comparison.axes[axis.name].truth for axis in axes]
    available_truths = [truth for truth in truths if not isinstance(truth, Unavailable)]
    if len(available_truths) == len(axes):
        correlated_noise = fit_time_correlation_to_truth(
            axes,
            available_truths,
            excluded_times_s,
            offset_s,
            jumps,
            correlated_noise,
            source_low_pass,
        )
    # 4. An oscillation of the IMU that the positions do not show can look like a low-pass filter of
    # the positions. A real filter would pass the oscillation if 2π · frequency · lag < 1, so the
    # estimated filter is then rejected
    if oscillation is not None and (
        2.0 * np.pi * oscillation.frequency_hz * source_low_pass.lag_s < 1.0
    ):
        return systematic_errors, IMU_OSCILLATES, correlated_noise
    return systematic_errors, source_low_pass, correlated_noise


def _select_horizontal_axes(
    comparison: Comparison, tuning: TuningByAxis
) -> tuple[tuple[Axis, ...], AxisTuning] | Unavailable:
    """Return the horizontal axes and their common noise estimate."""
    for name, axis_names in ((HORIZONTAL, ("north", "east")), (AISLE_AXIS, (AISLE_AXIS,))):
        axis_tuning = tuning.get(name)
        if isinstance(axis_tuning, AxisTuning) and comparison.axes.keys() >= set(axis_names):
            return tuple(comparison.axes[axis].axis for axis in axis_names), axis_tuning
    return Unavailable(
        "systematic and time-correlated errors of the position source",
        "the position and acceleration noise of the horizontal axes could not be estimated",
        "Analyse the axes north and east, or the axis of largest motion (--axis aisle).",
    )


def explain_low_imu_rate(flight: Flight) -> Unavailable | None:
    """Return a reason if the IMU rate is too low to estimate a time offset, otherwise None.

    Telemetry skips samples, so it needs a higher rate than a ULog (``HIGHRES_IMU.hpp``).
    """
    if isinstance(flight.imu, Unavailable) or len(flight.imu) < 2:
        return None
    stream = flight.streams.get("imu")
    is_telemetry = stream is not None and stream.topics[0] in TELEMETRY_IMU_MESSAGES
    required_hz = MIN_TELEMETRY_IMU_HZ if is_telemetry else MIN_TIME_OFFSET_IMU_HZ
    rate_hz = 1.0 / compute_median_interval_s(flight.imu.index)
    if rate_hz >= MIN_MEASURED_TO_NOMINAL_IMU_RATE_RATIO * required_hz:
        return None
    rate_note = f"the IMU was logged at {rate_hz:.3g} Hz"
    remedy = FULL_IMU_RATE_ACTION
    if is_telemetry:
        rate_note = f"telemetry contains only some of the IMU samples ({rate_hz:.3g} Hz)"
        remedy = f"Request the IMU message at {required_hz:g} Hz."
        if flight.log.writes_ulog:
            remedy = "Give the ULog of this flight as argument LOG."
    return Unavailable(
        "time offset",
        f"{rate_note}, but an estimate of the time offset needs {required_hz:g} Hz",
        remedy,
    )


def widen_for_scatter(time_offset: SourceTimeOffset, cause: str) -> SourceTimeOffset:
    """Widen the 95 % interval of the time offset, because its estimates scatter.

    The factor is the scatter of the time offsets of flight parts ÷ their reported σ.
    """
    offsets_s = np.array([part.offset_s for part in time_offset.parts])
    weights = np.array([part.sigma_s**-2.0 for part in time_offset.parts])
    # Scatter of the time offsets looks like clock drift: withdraw the drift. Test for a change of
    # the time offset with the scatter as σ
    time_offset = structs.replace(
        time_offset,
        drift_ppm=None,
        drift_sigma_ppm=None,
        change_p_value=_compute_change_p_value(offsets_s, weights),
    )
    # Too few time offsets to estimate their scatter
    if len(offsets_s) <= MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE:
        return time_offset
    # Mean square of the deviations from the weighted mean ÷ σ² (chi-square ÷ degrees of freedom)
    variance_factor = _compute_weighted_square_sum(offsets_s, weights) / (len(offsets_s) - 1)
    widening_factor = max(1.0, variance_factor) ** 0.5
    low_s, high_s = (
        time_offset.offset_s + widening_factor * (limit_s - time_offset.offset_s)
        for limit_s in time_offset.interval_s
    )
    reason = time_offset.reason
    if not reason and (high_s - low_s) / 2.0 > MAX_OFFSET_INTERVAL_HALF_WIDTH_S:
        reason = (
            f"the time offset differs between parts of the flight, probably because {cause} (95 % "
            f"interval of the offset: {low_s:+.2f} s to {high_s:+.2f} s)"
        )
    return structs.replace(
        time_offset,
        interval_s=(low_s, high_s),
        sigma_s=time_offset.sigma_s * widening_factor,
        is_determinable=not reason,
        reason=reason,
    )


def _compute_weighted_square_sum(offsets_s: Array, weights: Array) -> float:
    return float(np.sum(weights * (offsets_s - np.average(offsets_s, weights=weights)) ** 2))


def _compute_change_p_value(offsets_s: Array, weights: Array) -> float | None:
    """Return the p-value of the largest change of the time offset; None for a short flight.

    ``offsets_s`` are the time offsets of consecutive flight parts, ``weights`` their 1/σ². Each row
    is tested as the first row after a change (Student's t-test with Bonferroni correction). If the
    offsets scatter by more than their σ, the test uses the scatter instead of σ.
    """
    degrees_of_freedom = len(offsets_s) - 2
    split_rows = range(
        MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE,
        len(offsets_s) - MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE + 1,
    )
    smallest_p_value = 1.0
    for split_row in split_rows:
        means_s, square_sum, variance_sum = [], 0.0, 0.0
        for rows in (slice(None, split_row), slice(split_row, None)):
            means_s.append(np.average(offsets_s[rows], weights=weights[rows]))
            square_sum += _compute_weighted_square_sum(offsets_s[rows], weights[rows])
            variance_sum += 1.0 / np.sum(weights[rows])
        offset_change_s = float(np.ptp(means_s))
        if offset_change_s < MIN_TIME_OFFSET_CHANGE_S:
            continue
        offset_change_sigma_s = np.sqrt(max(1.0, square_sum / degrees_of_freedom) * variance_sum)
        p_value = 2.0 * float(stdtr(degrees_of_freedom, -offset_change_s / offset_change_sigma_s))
        smallest_p_value = min(smallest_p_value, p_value * len(split_rows))
    return smallest_p_value if split_rows else None
