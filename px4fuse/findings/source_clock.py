"""The source's stamps are late or early against the IMU, or their error changed in flight."""

from __future__ import annotations

from dataclasses import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.model import Comparison
from px4fuse.filter.clock import CHANGE_P, ClockOffset
from px4fuse.findings.model import Found, error, finding
from px4fuse.findings.source_positions import low_pass
from px4fuse.findings.source_stamps import until_synchronised
from px4fuse.flight import Unavailable

OFFSET_S = 0.03  # at 1 m/s a third of a good UWB's noise
OFFSET_ERROR_S = 0.10  # at 1 m/s a good UWB's noise


def detect(analysis: Analysis) -> Found:
    """An offset that is known, of stamps that are the source's own."""
    clock, source = analysis.clock, analysis.source
    # what was derived from EKF2's own output has EKF2's stamps
    if not isinstance(clock, ClockOffset) or source.origin.reconstructed:
        return
    # a low pass lags behind the motion by itself
    if not clock.determinable or low_pass(analysis) is not None:
        return
    low, high = clock.interval_s
    evidence = {"offset_s": clock.offset_s, "interval_low_s": low, "interval_high_s": high}
    if clock.change_p is not None and clock.change_p < CHANGE_P:
        yield error(
            "source_clock_changes",
            f"The clock offset of {source.name} is not the same throughout",
            f" (p {clock.change_p:.1g}): {clock.parts[0].offset_s:+.2f} s at the beginning, "
            f"{clock.parts[-1].offset_s:+.2f} s at the end. PX4 takes the time of arrival until "
            "500 TIMESYNC answers have come.",
            "Let the clocks synchronise for a minute before take-off; analyse one side of the "
            "change with --start, --end.",
            {**evidence, "change_p": clock.change_p},
        )
        return
    size = abs(clock.remaining_s)
    # one offset cannot hold for stamps that are of arrival in a part of the flight only
    if size <= max(OFFSET_S, clock.chance_s) or until_synchronised(analysis) is not None:
        return
    typed = f"{remedy.COMMAND} --clock-offset {typed_offset_s(analysis, clock):.3f}"
    shifted = replace(analysis.settings, clock_offset_s=round(clock.offset_s, 3))
    if errors := remedy.filter_errors_m(analysis, shifted):
        if errors[1] > remedy.WORSE_FILTER_ERROR * errors[0]:
            return  # the truth knows better
        typed += f": position error {errors[0]:.3f} → {errors[1]:.3f} m (replayed)"
    side, ends = "early", (low - clock.applied_s, high - clock.applied_s)
    if clock.remaining_s < 0:
        side, ends = "late", (-ends[1], -ends[0])
    yield finding(
        "error" if size > OFFSET_ERROR_S else "warning",
        "source_clock_offset",
        f"The stamps of {source.name} are {side} by {size:.3f} s against the IMU",
        f" (95 % {ends[0]:.3f} to {ends[1]:.3f} s): at 1 m/s that is an error of {size:.2f} m, "
        "which neither filter's innovations show.",
        f"{typed}{_for_ekf2(analysis, clock)}.",
        evidence,
    )


def _for_ekf2(analysis: Analysis, clock: ClockOffset) -> str:
    """What putting EKF2's delay right would do, where a replay confirms it."""
    model = analysis.ekf2_model
    if isinstance(model, Unavailable) or analysis.source.name != model.inputs.vision.source:
        return ""
    changes = remedy.delay_change(model, -1e3 * clock.offset_s)
    found = remedy.replayed(model, changes) if changes else []
    for effect in [] if isinstance(found, Unavailable) else found:
        if remedy.delay_helps(effect.before, effect.after):
            return f"; for EKF2 set {remedy.settings_words(changes)}: {effect.words()}"
    return ""


def typed_offset_s(comparison: Comparison, clock: ClockOffset) -> float:
    """What to type as ``--clock-offset``: what was applied, with what is missing (s).

    That of a position file was spent on placing it, and is not in the settings.
    """
    placed = comparison.source.alignment
    return clock.offset_s if placed is None else placed.clock_offset_s + clock.remaining_s
