"""What the likelihood says: which of SIGMA_A and SIGMA_Z is off, and the clock."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.filter.clock import CHANGE_P, ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.model import Finding, Severity, motion_range_m
from px4fuse.findings.thresholds import (
    CLOCK_OFFSET,
    CLOCK_OFFSET_ERROR,
    CLOCK_SIGMAS,
    EKF2_UPDATE,
    HEADING_ERROR,
    HEADING_ERROR_LARGE,
    HEADING_SIGMAS,
    MIN_OUTLIERS,
    MOTION_RANGE,
    NOISE_OFF,
    NOISE_OFF_ERROR,
    OUTLIERS,
    OUTLIERS_ERROR,
)


def noises_off(analysis: Analysis) -> Iterator[Finding]:
    """SIGMA_Z or SIGMA_A is not what the innovations ask for, each told from the other.

    The mean NIS alone cannot tell them apart: both make S larger. The likelihood can, since
    SIGMA_A makes the innovations of a stretch agree with each other and SIGMA_Z does not.
    """
    comparison = analysis.comparison
    name = next(
        (
            n
            for n in (HORIZONTAL, "aisle", "down")
            if isinstance(analysis.tuning.get(n), AxisTuning)
        ),
        None,
    )
    if name is None:
        return
    tuned = analysis.tuning[name]
    assert isinstance(tuned, AxisTuning)
    settings = comparison.settings
    # without motion the acceleration's noise is hardly seen
    still = motion_range_m(comparison) < MOTION_RANGE.value
    for label, option, unit, chosen, found in (
        ("SIGMA_Z", "--sigma-z", "m", settings.sigma_z_m, tuned.sigma_z),
        ("SIGMA_A", "--sigma-a", "m/s²", settings.sigma_a_m_s2, tuned.sigma_a),
    ):
        factor, severity = _off(chosen, found)
        if severity is None or (label == "SIGMA_A" and still):
            continue
        small = factor < 1.0
        value = found.value if found.value is not None else found.high
        assert value is not None
        bound = "at most " if found.value is None else ""
        range_ = "" if found.value is None else f", 95 % {found.low or 0.0:.3g} to {found.high:.3g}"
        yield Finding(
            f"{label.lower()}_{'small' if small else 'large'}",
            severity,
            f"{label} {chosen:g} {unit} is {max(factor, 1.0 / factor):.2g} times too "
            f"{'small' if small else 'large'}: the innovations ({name}) ask for {bound}{value:.3g} "
            f"{unit}{range_}. {_reading(label, small)}",
            f"{option} {value:.3g}",
            {
                "chosen": chosen,
                "most_likely": value,
                "factor": factor,
                "lag1_autocorrelation": getattr(tuned.before, "lag1_autocorrelation", float("nan")),
            },
        )


def outliers(analysis: Analysis) -> Iterator[Finding]:
    """Measurements that no noise explains: reflections, no line of sight."""
    tuned = analysis.tuning.get(HORIZONTAL) or next(iter(analysis.tuning.values()), None)
    if not isinstance(tuned, AxisTuning):
        return
    count = len(tuned.outlier_time_s)
    share = count / tuned.count
    if share < OUTLIERS.value or count < MIN_OUTLIERS:
        return
    times = ", ".join(f"{time:.1f}" for time in tuned.outlier_time_s[:3])
    yield Finding(
        "source_outliers",
        "error" if share >= OUTLIERS_ERROR.value else "warning",
        f"{count} of {tuned.count} measurements ({share:.1%}) are outliers that no noise explains "
        f"({tuned.name}; at {times} s{' and more' if count > 3 else ''}): for UWB most likely "
        "reflections without line of sight. They pull both filters, and pass for noise where they "
        "are not left out.",
        "Give the tag line of sight to the anchors there, or reject them before they are sent; do "
        "not raise SIGMA_Z or EKF2_EVP_NOISE for them.",
        {"count": float(count), "share": share, "first_s": float(tuned.outlier_time_s[0])},
    )


def _off(chosen: float, found: Noise) -> tuple[float, Severity | None]:
    """By what factor a chosen noise is off, and how bad that is; None where it is not."""
    reference = found.value if found.value is not None else found.high
    if reference is None:
        return 1.0, None
    factor = chosen / reference
    above = found.high is not None and chosen > found.high
    below = found.value is not None and chosen < (found.low or 0.0)
    size = max(factor, 1.0 / factor)
    if not (above or below) or size < NOISE_OFF.value:
        return factor, None
    return factor, "error" if size >= NOISE_OFF_ERROR.value else "warning"


def _reading(label: str, small: bool) -> str:
    if label == "SIGMA_Z":
        return (
            "The filter takes the noise of the measurements for motion."
            if small
            else "The filter distrusts measurements that are better than it thinks."
        )
    return (
        "The variance grows too little between updates, the gain is too small, and the filter "
        "lags behind."
        if small
        else "The variance grows too much between updates, and the filter jumps to every "
        "measurement."
    )


def clock_off(analysis: Analysis) -> Iterator[Finding]:
    """The source's stamps are late or early against the IMU, or their error changed in flight."""
    comparison = analysis.comparison
    clock = analysis.clock
    # what was derived from EKF2's own output has EKF2's stamps, not the source's
    if not isinstance(clock, ClockOffset) or comparison.source.reconstructed:
        return
    if not clock.determinable:
        return
    applied = comparison.settings.clock_offset_s
    low, high = clock.interval_s
    evidence: dict[str, float | str] = {
        "offset_s": applied + clock.offset_s,
        "interval_low_s": applied + low,
        "interval_high_s": applied + high,
    }
    changes = clock.change_p is not None and clock.change_p < CHANGE_P
    if changes:
        first, last = clock.parts[0], clock.parts[-1]
        yield Finding(
            "source_clock_changes",
            "error",
            f"The clock offset of {comparison.source.name} is not the same throughout (p "
            f"{clock.change_p:.1g}): {applied + first.offset_s:+.2f} s at the beginning, "
            f"{applied + last.offset_s:+.2f} s at the end. PX4 takes the time of arrival until "
            "500 TIMESYNC answers have come.",
            "Let the clocks synchronise for a minute before take-off; analyse one side of the "
            "change with --start, --end.",
            {**evidence, "change_p": clock.change_p or 0.0},
        )
    sure = abs(clock.offset_s) > CLOCK_SIGMAS.value * clock.sigma_s
    if sure and abs(clock.offset_s) > CLOCK_OFFSET.value and not changes:
        yield Finding(
            "source_clock_offset",
            "error" if abs(clock.offset_s) > CLOCK_OFFSET_ERROR.value else "warning",
            f"The stamps of {comparison.source.name} are "
            f"{'late' if clock.offset_s < 0 else 'early'} by {abs(clock.offset_s):.3f} s against "
            f"the IMU (95 % {abs(high):.3f} to {abs(low):.3f} s): at 1 m/s that is an error of "
            f"{abs(clock.offset_s):.2f} m, which neither filter's innovations show.",
            f"--clock-offset {applied + clock.offset_s:.3f}",
            evidence,
        )


def frame_turned(analysis: Analysis) -> Iterator[Finding]:
    """The source's frame is turned against the vehicle's heading."""
    comparison = analysis.comparison
    clock = analysis.clock
    if not isinstance(clock, ClockOffset) or comparison.source.reconstructed:
        return
    turn, sigma = clock.heading_error_deg, clock.heading_sigma_deg
    if abs(turn) < max(HEADING_SIGMAS.value * sigma, HEADING_ERROR.value):
        return
    yield Finding(
        "source_frame_turned",
        "error" if abs(turn) >= HEADING_ERROR_LARGE.value else "warning",
        f"The frame of {comparison.source.name} is turned by {turn:+.0f}° ± {1.96 * sigma:.0f}° "
        "(clockwise seen from above) against the vehicle's heading: what the IMU feels as north "
        "the positions show elsewhere. Either the positioning frame is not aligned with north, or "
        "the heading is wrong (magnetometer).",
        f"Turn the positions by {-turn:+.0f}° before they are sent (a file: --position-yaw), or "
        "calibrate the magnetometer.",
        {"turn_deg": turn, "sigma_deg": sigma},
    )


def ekf2_delay_off(analysis: Analysis) -> Iterator[Finding]:
    """EKF2_EV_DELAY is not the delay that the data have."""
    comparison = analysis.comparison
    clock = analysis.clock
    delay = comparison.flight.log.parameters.get("EKF2_EV_DELAY")
    if not isinstance(clock, ClockOffset) or comparison.source.reconstructed:
        return
    if not clock.determinable or delay is None:
        return
    applied = comparison.settings.clock_offset_s
    asked = -applied - np.array([clock.interval_s[1], clock.interval_s[0]])
    best = -(applied + clock.offset_s)
    apart = abs(delay * 1e-3 - best)
    if apart < max(CLOCK_SIGMAS.value * clock.sigma_s + EKF2_UPDATE.value, CLOCK_OFFSET.value):
        return
    yield Finding(
        "ekf2_ev_delay_wrong",
        "warning",
        f"EKF2_EV_DELAY is {delay:g} ms, while the data ask for {best * 1e3:.0f} ms (95 % "
        f"{asked[0] * 1e3:.0f} to {asked[1] * 1e3:.0f}): EKF2 fuses each position at the wrong "
        "time, and its track lags or leads by the difference.",
        f"Set EKF2_EV_DELAY to {0.0 if asked[0] <= 0.0 else best * 1e3:.0f}.",
        {"ekf2_ev_delay_ms": delay, "asked_ms": best * 1e3},
    )
