"""Time offset between source and IMU, its change in flight, and a wrong EKF2_EV_DELAY."""

from dataclasses import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.whatif import WhatIf, what_if
from px4fuse.ekf2_parameters import GNSS_POS, PARAMETERS, RECEIVER_DELAYS
from px4fuse.filter.time_offset import MAX_CHANGE_P, ClockOffset
from px4fuse.findings.model import Found, error, finding, warning
from px4fuse.findings.source_positions import low_pass
from px4fuse.findings.source_stamps import until_synchronised
from px4fuse.flight import Unavailable

MIN_OFFSET_S = 0.03  # s; at 1 m/s a third of the noise of good UWB (0.1 m)
MIN_OFFSET_ERROR_S = 0.10  # s; at 1 m/s the noise of good UWB (0.1 m)
CORRECT_AT_SENDER = "Correct the timestamps at the sender."


def detect(analysis: Analysis) -> Found:
    """Detect a wrong time offset or delay, if the timestamps are those of the source."""
    clock, is_reconstructed = analysis.clock, analysis.source.origin.reconstructed
    if isinstance(clock, ClockOffset) and clock.is_determinable and not is_reconstructed:
        yield from offset(analysis, clock)
        yield from delay(analysis, clock)


def offset(analysis: Analysis, clock: ClockOffset) -> Found:
    """Detect a time offset relative to the IMU, or one that changes in flight."""
    source = analysis.source
    if low_pass(analysis) is not None:  # a low-pass filtered source lags without a time offset
        return
    low, high = clock.interval_s
    evidence = {"offset_s": clock.offset_s, "interval_low_s": low, "interval_high_s": high}
    if clock.change_p_value is not None and clock.change_p_value < MAX_CHANGE_P:
        first, last = clock.parts[0], clock.parts[-1]
        yield error(
            "source_time_offset_changes",
            f"The time offset of {source.name} changes from {first.offset_s:+.2f} s at the "
            f"beginning to {last.offset_s:+.2f} s at the end (p {clock.change_p_value:.1g}). No "
            "single --clock-offset corrects it. PX4 uses arrival times until 500 TIMESYNC answers "
            "have come.",
            "Let the clocks synchronise for one minute before take-off. Analyse one side of the "
            "change (--start, --end).",
            {**evidence, "change_p_value": clock.change_p_value},
        )
        return
    size = abs(clock.remaining_s)
    # one offset cannot correct timestamps that are arrival times in part of the flight
    if size <= max(MIN_OFFSET_S, clock.three_sigma_s) or until_synchronised(analysis) is not None:
        return
    action = f"Re-run with {remedy.COMMAND} --clock-offset {typed_offset_s(analysis, clock):.3f}"
    shifted = replace(analysis.settings, clock_offset_s=round(clock.offset_s, 3))
    if errors := remedy.filter_errors_m(analysis, shifted):
        if errors[1] > remedy.MAX_KF_ERROR_RATIO * errors[0]:
            return  # ground truth contradicts the offset
        action += f": KF position RMSE {errors[0]:.3f} → {errors[1]:.3f} m (re-run)"
    ends, late = (low - clock.applied_s, high - clock.applied_s), clock.remaining_s < 0
    first_s, last_s = (-ends[1], -ends[0]) if late else ends
    yield finding(
        "error" if size > MIN_OFFSET_ERROR_S else "warning",
        "source_time_offset",
        f"The timestamps of {source.name} are {size:.3f} s {'late' if late else 'early'} relative "
        f"to the IMU (95 % {first_s:.3f} to {last_s:.3f} s). At 1 m/s this is a position error of "
        f"{size:.2f} m. Innovations hardly show it.",
        f"{action}.{_for_ekf2(analysis, clock)}",
        evidence,
    )


def _for_ekf2(analysis: Analysis, clock: ClockOffset) -> str:
    """Action for EKF2's delay parameter, if a replay confirms it."""
    source, model = analysis.source, analysis.ekf2_model
    parameters = analysis.flight.log.parameters
    known = [name for name in (*RECEIVER_DELAYS, GNSS_POS.delay) if name in parameters]
    of_receiver = bool(known) and known[0] in RECEIVER_DELAYS  # the model does not include these
    if source.origin.fused_as_gnss and known and (of_receiver or isinstance(model, Unavailable)):
        ml_delay_ms = parameters[known[0]] - 1e3 * clock.remaining_s
        return (
            f" EKF2 assumes fixes {parameters[known[0]]:g} ms old ({known[0]}); the estimate is "
            f"{max(ml_delay_ms, 0.0):.0f} ms (not replayed)."
        )
    if isinstance(model, Unavailable) or source.name != model.inputs.received.source:
        return ""
    changes = remedy.delay_change(model.inputs, 1e3 * (source.age_s - clock.offset_s))
    found = what_if(model, [changes]) if changes else None
    if not isinstance(found, WhatIf) or not remedy.delay_helps(found.replayed, *found.whatif):
        return ""
    effect = remedy.format_whatif_effect(found.replayed, *found.whatif)
    return f" For EKF2 set {remedy.format_settings(changes)}: {effect}."


def typed_offset_s(comparison: Comparison, clock: ClockOffset) -> float:
    """Value (s) for ``--clock-offset``: the offset in use plus the estimated remainder.

    The offset of a position file is part of its alignment, not of the settings.
    """
    placed = comparison.source.alignment
    return clock.offset_s if placed is None else placed.clock_offset_s + clock.remaining_s


def delay(analysis: Analysis, clock: ClockOffset) -> Found:
    """Detect EKF2_EV_DELAY outside 3 σ of the time offset plus one EKF2 step."""
    # GNSS timestamps are already corrected by EKF2_GPS_DELAY, so the offset is the delay error
    delay_ms = remedy.delay_ms(analysis) if analysis.source.origin.is_vision else None
    ml_delay_ms = -1e3 * clock.offset_s
    known_ms = max(1e3 * clock.three_sigma_s + remedy.UPDATE_MS, 1e3 * MIN_OFFSET_S)
    if delay_ms is None or abs(delay_ms - ml_delay_ms) < known_ms:
        return
    low_ms, high_ms = (-1e3 * end for end in reversed(clock.interval_s))
    low, high, size = round(low_ms), round(high_ms), round(abs(ml_delay_ms))
    if low_ms <= 0.0 <= high_ms:
        estimate = "the estimated delay is not significant"
    elif ml_delay_ms < 0.0:
        estimate, low, high = f"the timestamps are {size} ms early", -high, -low
    else:
        estimate = f"the estimated delay is {size} ms"
    yield warning(
        "ekf2_ev_delay_wrong",
        f"EKF2_EV_DELAY is {delay_ms:g} ms, but {estimate} (95 % {low} to {high} ms). EKF2 fuses "
        "each position at the wrong time, so its track leads or lags.",
        delay_remedy(analysis, 0.0 if low_ms <= 0.0 else ml_delay_ms, delay_ms),
        {"ekf2_ev_delay_ms": delay_ms, "asked_ms": ml_delay_ms},
    )


def delay_remedy(analysis: Analysis, delay_ms: float, flown_ms: float) -> str:
    """Action for EKF2_EV_DELAY, within PX4's range and confirmed by a replay if possible."""
    model, most_ms = analysis.ekf2_model, PARAMETERS["EKF2_EV_DELAY"].maximum
    if delay_ms > most_ms:
        return f"{CORRECT_AT_SENDER} PX4 allows at most {most_ms:g} ms (EKF2_EV_DELAY)."
    if round(delay_ms) <= 0.0 and flown_ms == 0.0:
        return f"{CORRECT_AT_SENDER} EKF2 has no parameter for early timestamps."
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), 0.0)}
    if not isinstance(model, Unavailable):
        changes = remedy.delay_change(model.inputs, delay_ms) or changes
    return remedy.format_ekf2_remedy(
        model, changes, remedy.delay_helps, fallback_remedy=CORRECT_AT_SENDER
    )
