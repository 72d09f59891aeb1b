"""What the data say of noises, clock and heading, of a comparison or of what it begins with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from px4fuse.comparison.drift import with_drift
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import ClockOffset, estimate_clock_offset
from px4fuse.filter.fitting import Noises
from px4fuse.filter.heading import HeadingError, heading_error
from px4fuse.filter.motion import MAX_IMU_INTERVAL_S, SignalCache
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise, tune
from px4fuse.flight import Flight, Unavailable

MIN_CLOCK_IMU_HZ = 1.0 / MAX_IMU_INTERVAL_S
# vehicle_imu integrates at this rate (IMU_INTEG_RATE): slower telemetry leaves samples out
MIN_TELEMETRY_IMU_HZ = 200.0
CLOCK_RATE_MARGIN = 0.98
TELEMETRY_IMU = ("HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")

Progress = Callable[[str], None]
Tuning = Mapping[str, AxisTuning | Unavailable]


def silent(_: str) -> None:
    """Progress that nobody watches."""


def size(noise: Noise, otherwise: float) -> float:
    """Most likely value of a noise, or its bound, or what was set."""
    return noise.value or noise.high or otherwise


def tuned_horizontally(comparison: Comparison, made: SignalCache | None = None) -> Tuning:
    """The horizontal noises alone, which is what the clock estimate needs; ``made`` as there."""
    return tuned(comparison, (HORIZONTAL,), made=made)


def tuned(
    comparison: Comparison,
    names: tuple[str, ...] | None = None,
    progress: Progress = silent,
    made: SignalCache | None = None,
) -> dict[str, AxisTuning | Unavailable]:
    """Most likely noises of a comparison's axes; an IMU too slow to tell biases is left out.

    Parameters
    ----------
    comparison : Comparison
    names : tuple of str, optional
        Axis names and "horizontal"; by default all that there are.
    progress : callable
        Told what is being done.
    made : dict, optional
        As :func:`px4fuse.filter.motion.motion` has it.
    """
    flight = comparison.flight
    slow = imu_too_slow_for_clocks(flight)
    return tune(
        comparison.lines,
        comparison.settings,
        names,
        lambda name: progress(f"tuning {name}"),
        flight if slow is None else replace(flight, imu=slow),
        comparison.source.origin.may_drift,
        made,
    )


def clock_offset(
    comparison: Comparison,
    tuning: Tuning,
    progress: Progress = silent,
    made: SignalCache | None = None,
) -> ClockOffset | Unavailable:
    """What must still be added to the stamps of the source, beyond the offset that was set.

    Parameters
    ----------
    comparison : Comparison
    tuning : mapping
        Its measurement noise and outliers are used where it has them.
    progress : callable
        Told what is being done.
    made : dict, optional
        As :func:`px4fuse.filter.motion.motion` has it.
    """
    if slow := imu_too_slow_for_clocks(comparison.flight):
        return slow
    tuned = next(
        (
            found
            for found in (tuning.get(HORIZONTAL), *tuning.values())
            if isinstance(found, AxisTuning)
        ),
        None,
    )
    settings = comparison.settings
    noises = Noises(settings.sigma_a_m_s2, settings.sigma_z_m)
    found = estimate_clock_offset(
        comparison.flight,
        comparison.source,
        comparison.segment,
        settings,
        noises if tuned is None else tuned.noises,
        None if tuned is None else tuned.outlier_time_s,
        progress,
        made,
    )
    if isinstance(found, ClockOffset) and comparison.source.origin.may_drift:
        return with_drift(found)
    return found


def turned_frame(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    progress: Progress = silent,
) -> HeadingError | Unavailable:
    """Turn of the source's frame, with the noise and the clock offset that were found."""
    progress("heading")
    tuned = tuning.get(HORIZONTAL)
    sigma_z_m = comparison.settings.sigma_z_m
    if isinstance(tuned, AxisTuning):
        sigma_z_m = size(tuned.sigma_z, sigma_z_m)
    return heading_error(
        comparison.flight,
        comparison.source,
        comparison.segment,
        comparison.settings,
        sigma_z_m,
        clock.remaining_s if isinstance(clock, ClockOffset) and clock.determinable else 0.0,
    )


def imu_too_slow_for_clocks(flight: Flight) -> Unavailable | None:
    """Why the IMU of a flight cannot tell a clock offset; None where it can.

    A ULog's sample is the mean over its interval. A telemetry message is the newest of several
    samples, and PX4 has taken EKF2's own bias out of it (``HIGHRES_IMU.hpp``), which follows the
    very positions that are in question.
    """
    if isinstance(flight.imu, Unavailable) or len(flight.imu) < 2:
        return None
    stream = flight.streams.get("imu")
    telemetry = stream is not None and stream.topics[0] in TELEMETRY_IMU
    needed = MIN_TELEMETRY_IMU_HZ if telemetry else MIN_CLOCK_IMU_HZ
    rate = 1.0 / float(np.median(np.diff(flight.imu.index.to_numpy())))
    if rate >= CLOCK_RATE_MARGIN * needed:
        return None
    told = f"{rate:.{1 if rate < 10 else 0}f} Hz"
    if not telemetry:
        return Unavailable(
            "clock offset",
            f"the IMU was logged at {told}, at least {needed:g} Hz are needed",
            'Put the line "sensor_combined 0" into etc/logging/logger_topics.txt on the SD card.',
        )
    remedy = "Give the ULog of the same flight as LOG, and this recording with --mavlink."
    return Unavailable(
        "clock offset",
        f"the IMU came by telemetry at {told}, each sample picked out of several; at least "
        f"{needed:g} Hz are needed",
        remedy if flight.log.has_ulog else f"Have the IMU sent at {needed:g} Hz.",
    )
