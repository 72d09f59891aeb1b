"""What the data say of noises, clock and heading, of a comparison or of what it begins with.

Innovations judge a filter against its source. An odometry is smooth over seconds and metres wrong
after minutes: a filter that follows it closely has small innovations and a large error, so that no
measurement noise follows from them, and the errors of scale and heading look like a clock that
wanders. Which sources those are says ``Origin.may_drift``; :func:`widen_for_drift` says what is left of
their clock estimate.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from msgspec import structs
from scipy.special import stdtr

from px4fuse.arrays import Array
from px4fuse.comparison import say
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import MAX_HALF_INTERVAL_S, ClockOffset, estimate_time_offset
from px4fuse.filter.fitting import Noises
from px4fuse.filter.heading import HeadingError, estimate_heading_error
from px4fuse.filter.motion import MAX_IMU_INTERVAL_S, SignalCache
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise, tune
from px4fuse.flight import Flight, Unavailable

MIN_CLOCK_IMU_HZ = 1.0 / MAX_IMU_INTERVAL_S
# vehicle_imu integrates at this rate (IMU_INTEG_RATE): slower telemetry leaves samples out
MIN_TELEMETRY_IMU_HZ = 200.0
CLOCK_RATE_MARGIN = 0.98
TELEMETRY_IMU = ("HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")

# A step of the clock that drift cannot imitate: at 1 m/s a good UWB's noise
MIN_CHANGE_S = 0.10
# On either side of a step, so that each shows its own scatter
MIN_PARTS = 2

Progress = Callable[[str], None]
Tuning = Mapping[str, AxisTuning | Unavailable]


def silent(_: str) -> None:
    """Progress that is shown to nobody."""


def first_axis_tuning(tuning: Tuning, *names: str) -> AxisTuning | None:
    """Of the first of these names of which noises are known."""
    candidates = map(tuning.get, names)
    return next(
        (tuning_of_axis for tuning_of_axis in candidates if isinstance(tuning_of_axis, AxisTuning)),
        None,
    )


def value_or_bound(noise: Noise, fallback: float) -> float:
    """Most likely value of a noise, or its bound, or what was set."""
    return noise.value or noise.high or fallback


def tuned(
    comparison: Comparison,
    names: tuple[str, ...] | None = None,
    progress: Progress = silent,
    cache: SignalCache | None = None,
) -> dict[str, AxisTuning | Unavailable]:
    """Most likely noises of a comparison's axes; an IMU too slow to tell biases is left out.

    Parameters
    ----------
    comparison : Comparison
    names : tuple of str, optional
        Axis names and "horizontal"; by default all that there are.
    progress : callable
        Is given what is being done.
    cache : dict, optional
        As :func:`px4fuse.filter.motion.motion` has it.
    """
    flight, slow_imu = comparison.flight, missing_imu_rate(comparison.flight)
    return tune(
        comparison.lines,
        comparison.settings,
        names,
        lambda name: progress(f"tuning {name}"),
        flight if slow_imu is None else replace(flight, imu=slow_imu),
        comparison.source.origin.may_drift,
        cache,
    )


def noises_and_clock(
    comparison: Comparison,
    progress: Progress = silent,
    names: tuple[str, ...] | None = (HORIZONTAL,),
) -> tuple[Tuning, ClockOffset | Unavailable]:
    """Most likely noises, and what must still be added to the stamps of the source.

    Beyond the offset that was set. Parameters are those of :func:`tuned`.
    """
    signal_cache: SignalCache = {}  # both need the same signals of the IMU
    tuning = tuned(comparison, names, progress, signal_cache)
    if slow_imu := missing_imu_rate(comparison.flight):
        return tuning, slow_imu
    settings, axis_tuning = comparison.settings, first_axis_tuning(tuning, HORIZONTAL, *tuning)
    clock = estimate_time_offset(
        comparison.flight,
        comparison.source,
        comparison.segment,
        settings,
        axis_tuning.noises if axis_tuning else Noises(settings.sigma_a_m_s2, settings.sigma_z_m),
        axis_tuning.outlier_time_s if axis_tuning else None,
        progress,
        signal_cache,
    )
    drifts = comparison.source.origin.may_drift
    return tuning, widen_for_drift(clock) if drifts and isinstance(clock, ClockOffset) else clock


def estimate_frame_rotation(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    progress: Progress = silent,
) -> HeadingError | Unavailable:
    """Turn of the source's frame, with the noise and the clock offset that were found."""
    progress("heading")
    axis_tuning, sigma_z_m = first_axis_tuning(tuning, HORIZONTAL), comparison.settings.sigma_z_m
    if axis_tuning is not None:
        sigma_z_m = value_or_bound(axis_tuning.sigma_z, sigma_z_m)
    offset_s = 0.0
    if isinstance(clock, ClockOffset) and clock.determinable:
        offset_s = clock.remaining_s
    return estimate_heading_error(
        comparison.flight,
        comparison.source,
        comparison.segment,
        comparison.settings,
        sigma_z_m,
        offset_s,
    )


def missing_imu_rate(flight: Flight) -> Unavailable | None:
    """Why the IMU of a flight cannot tell a clock offset; None where it can.

    A ULog's sample is the mean over its interval. A telemetry message is the newest of several
    samples, and PX4 has taken EKF2's own bias out of it (``HIGHRES_IMU.hpp``), which follows the
    very positions that are in question.
    """
    if isinstance(flight.imu, Unavailable) or len(flight.imu) < 2:
        return None
    stream = flight.streams.get("imu")
    is_telemetry = stream is not None and stream.topics[0] in TELEMETRY_IMU
    needed_hz = MIN_TELEMETRY_IMU_HZ if is_telemetry else MIN_CLOCK_IMU_HZ
    rate_hz = 1.0 / float(np.median(np.diff(flight.imu.index.to_numpy())))
    if rate_hz >= CLOCK_RATE_MARGIN * needed_hz:
        return None
    rate_text = f"{rate_hz:.{1 if rate_hz < 10 else 0}f} Hz"
    description = f"was logged at {rate_text}"
    remedy = 'Put the line "sensor_combined 0" into etc/logging/logger_topics.txt on the SD card.'
    if is_telemetry:
        description = f"came by telemetry at {rate_text}, each sample picked out of several"
        remedy = f"Have the IMU sent at {needed_hz:g} Hz."
        if flight.log.has_ulog:
            remedy = "Give the ULog of the same flight as LOG, and this recording with --mavlink."
    reason = f"the IMU {description}; at least {needed_hz:g} Hz are needed"
    return Unavailable("clock offset", reason, remedy)


def widen_for_drift(clock: ClockOffset) -> ClockOffset:
    """The clock estimate of a source that may drift: no surer than its parts agree.

    Errors of scale and heading, and the walk of an odometry, move the offset of each part by more
    than the noise does. The scatter of the parts about their steps is what they amount to: it
    widens the interval, and only a step beyond it, of 0.1 s or more, is a change of the clock.
    """
    offset = np.array([part.offset_s for part in clock.parts])
    weight = np.array([part.sigma_s**-2.0 for part in clock.parts])
    if len(offset) <= MIN_PARTS:
        return structs.replace(clock, change_p=None, drift_ppm=None, drift_sigma_ppm=None)
    scatter = np.sqrt(max(1.0, _weighted_square_sum(offset, weight) / (len(offset) - 1)))
    low, high = (clock.offset_s + scatter * (end - clock.offset_s) for end in clock.interval_s)
    reason = clock.reason
    if not reason and (high - low) / 2.0 > MAX_HALF_INTERVAL_S:
        reason = say("parts_differ", low=low, high=high)
    return structs.replace(
        clock,
        interval_s=(float(low), float(high)),
        sigma_s=float(clock.sigma_s * scatter),
        determinable=not reason,
        reason=reason,
        drift_ppm=None,
        drift_sigma_ppm=None,
        change_p=_largest_step_p_value(offset, weight),
    )


def _weighted_square_sum(offset: Array, weight: Array) -> float:
    """Σ w (x - weighted mean)²."""
    return float(np.sum(weight * (offset - np.average(offset, weights=weight)) ** 2))


def _largest_step_p_value(offset: Array, weight: Array) -> float | None:
    """p-value of the largest step between parts against their own scatter, both sides estimated.

    Student's t of two weighted means whose common scatter comes from within the sides, times the
    number of places looked at (Bonferroni); 1 where the step is below ``MIN_CHANGE_S``.
    """
    count = len(offset)
    split_rows = range(MIN_PARTS, count - MIN_PARTS + 1)
    smallest_p = 1.0
    for split in split_rows:
        sides = [(offset[rows], weight[rows]) for rows in (slice(None, split), slice(split, None))]
        step = float(np.diff([np.average(x, weights=w) for x, w in sides])[0])
        if abs(step) < MIN_CHANGE_S:
            continue
        scatter = max(1.0, sum(_weighted_square_sum(x, w) for x, w in sides) / (count - 2))
        sigma = np.sqrt(scatter * sum(1.0 / np.sum(w) for _, w in sides))
        p = 2.0 * float(stdtr(count - 2, -abs(step) / sigma))
        smallest_p = min(smallest_p, p * len(split_rows))
    return smallest_p if split_rows else None
