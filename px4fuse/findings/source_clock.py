"""The source's stamps are late or early against the IMU, or their error changed in flight."""

from __future__ import annotations

from dataclasses import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.remedy import (
    COMMAND,
    WORSE_FILTER_ERROR,
    delay_change,
    delay_helps,
    filter_errors_m,
    replayed,
    settings_words,
)
from px4fuse.filter.clock import CHANGE_P, ClockOffset
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_smoothed import low_pass
from px4fuse.findings.source_stamps_of_arrival import stamps_of_arrival_end_s
from px4fuse.flight import Unavailable

CLOCK_OFFSET = Threshold(0.03, "s", "at 1 m/s a third of a good UWB's noise")
CLOCK_OFFSET_ERROR = Threshold(0.10, "s", "at 1 m/s a good UWB's noise")


def _for_ekf2(analysis: Analysis, clock: ClockOffset) -> str:
    """What putting EKF2's delay right would do, where a replay confirms it."""
    model, comparison = analysis.ekf2_model, analysis
    if isinstance(model, Unavailable) or comparison.source.name != model.inputs.vision.source:
        return ""
    late_ms = -1e3 * clock.offset_s
    changes = delay_change(model, late_ms)
    found = replayed(model, changes) if changes else None
    if found is None or isinstance(found, Unavailable):
        return ""
    (effect,) = found
    if not delay_helps(effect.before, effect.after):
        return ""
    return f"; for EKF2 set {settings_words(changes)}: {effect.words()}"


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    clock = analysis.clock
    # what was derived from EKF2's own output has EKF2's stamps, not the source's
    reconstructed = comparison.source.origin.reconstructed
    if not isinstance(clock, ClockOffset) or not clock.determinable or reconstructed:
        return
    if low_pass(analysis) is not None:  # which lags behind the motion by itself
        return
    low, high = clock.interval_s
    evidence: dict[str, float | str] = {
        "offset_s": clock.offset_s,
        "interval_low_s": low,
        "interval_high_s": high,
    }
    changes = clock.change_p is not None and clock.change_p < CHANGE_P
    if changes:
        first, last = clock.parts[0], clock.parts[-1]
        yield Finding(
            "source_clock_changes",
            "error",
            f"The clock offset of {comparison.source.name} is not the same throughout (p "
            f"{clock.change_p:.1g}): {first.offset_s:+.2f} s at the beginning, "
            f"{last.offset_s:+.2f} s at the end. PX4 takes the time of arrival until "
            "500 TIMESYNC answers have come.",
            "Let the clocks synchronise for a minute before take-off; analyse one side of the "
            "change with --start, --end.",
            {**evidence, "change_p": clock.change_p or 0.0},
        )
    # one offset cannot hold for stamps that are of arrival in a part of the flight only
    changes = changes or stamps_of_arrival_end_s(analysis) is not None
    if abs(clock.remaining_s) > max(CLOCK_OFFSET.value, clock.chance_s) and not changes:
        remedy = f"{COMMAND} --clock-offset {typed_offset_s(comparison, clock):.3f}"
        shifted = replace(comparison.settings, clock_offset_s=round(clock.offset_s, 3))
        errors = filter_errors_m(comparison, shifted)
        if errors is not None:
            if errors[1] > WORSE_FILTER_ERROR * errors[0]:
                return  # the truth knows better
            remedy += f": position error {errors[0]:.3f} → {errors[1]:.3f} m (replayed)"
        low, high = low - clock.applied_s, high - clock.applied_s
        ends = (-high, -low) if clock.remaining_s < 0 else (low, high)
        yield Finding(
            "source_clock_offset",
            "error" if abs(clock.remaining_s) > CLOCK_OFFSET_ERROR.value else "warning",
            f"The stamps of {comparison.source.name} are "
            f"{'late' if clock.remaining_s < 0 else 'early'} by {abs(clock.remaining_s):.3f} s "
            f"against the IMU (95 % {ends[0]:.3f} to {ends[1]:.3f} s): at 1 m/s that is an error "
            f"of {abs(clock.remaining_s):.2f} m, which neither filter's innovations show.",
            f"{remedy}{_for_ekf2(analysis, clock)}.",
            evidence,
        )


def typed_offset_s(comparison: Comparison, clock: ClockOffset) -> float:
    """What to type as ``--clock-offset``: what was applied, with what is missing (s).

    That of a position file was spent on placing it, and is not in the settings.
    """
    placed = comparison.source.alignment
    return clock.offset_s if placed is None else placed.clock_offset_s + clock.remaining_s


DETECTOR = Detector(
    _detect,
    {
        "source_clock_offset": tuple(
            f"--mistake clock-offset={ms}ms" for ms in (40, 80, 120, 150, 200, 250)
        ),
        "source_clock_changes": tuple(f"--mistake clock-jump={ms}ms" for ms in (150, 250, 400)),
    },
    names={
        "source_clock_offset": "position stamps that are early or late",
        "source_clock_changes": "position stamps whose offset changes in flight",
    },
)
