"""Time offset between source and IMU, its change in flight, and a wrong EKF2_EV_DELAY."""

from dataclasses import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.whatif import WhatIf, what_if
from px4fuse.ekf2_parameters import GNSS_POS, PARAMETERS, RECEIVER_DELAYS
from px4fuse.filter.time_offset import MAX_CHANGE_P, ClockOffset
from px4fuse.findings.model import Findings, error, finding, warning
from px4fuse.findings.source_positions import find_low_pass
from px4fuse.findings.source_stamps import find_synchronisation
from px4fuse.flight import Unavailable

MIN_OFFSET_S = 0.03  # s; at 1 m/s a third of the noise of good UWB (0.1 m)
MIN_OFFSET_ERROR_S = 0.10  # s; at 1 m/s the noise of good UWB (0.1 m)
CORRECT_AT_SENDER = "Correct the timestamps at the sender."


def detect(analysis: Analysis) -> Findings:
    """Detect a wrong time offset or delay; positions rebuilt from EKF2 output are not tested."""
    clock, is_reconstructed = analysis.clock, analysis.source.origin.reconstructed
    if isinstance(clock, ClockOffset) and clock.is_determinable and not is_reconstructed:
        yield from detect_offset(analysis, clock)
        yield from detect_wrong_delay(analysis, clock)


def detect_offset(analysis: Analysis, clock: ClockOffset) -> Findings:
    """Detect a time offset relative to the IMU, or one that changes in flight."""
    source = analysis.source
    if find_low_pass(analysis) is not None:  # a low-pass filtered source lags without a time offset
        return
    low, high = clock.interval_s
    evidence = {"offset_s": clock.offset_s, "interval_low_s": low, "interval_high_s": high}
    if clock.change_p_value is not None and clock.change_p_value < MAX_CHANGE_P:
        first_part, last_part = clock.parts[0], clock.parts[-1]
        yield error(
            "source_time_offset_changes",
            f"The time offset of {source.name} changes from {first_part.offset_s:+.2f} s at the "
            f"beginning to {last_part.offset_s:+.2f} s at the end (p {clock.change_p_value:.1g}). "
            "No single --clock-offset corrects it. PX4 uses arrival times until 500 TIMESYNC "
            "answers have come.",
            "Let the clocks synchronise for one minute before take-off. Analyse one side of the "
            "change (--start, --end).",
            {**evidence, "change_p_value": clock.change_p_value},
        )
        return
    size_s = abs(clock.remaining_s)
    # one offset cannot correct timestamps that are arrival times in part of the flight
    if (
        size_s <= max(MIN_OFFSET_S, clock.three_sigma_s)
        or find_synchronisation(analysis) is not None
    ):
        return
    action = (
        f"Re-run with {remedy.COMMAND} --clock-offset {clock_offset_option_s(analysis, clock):.3f}"
    )
    shifted_settings = replace(analysis.settings, clock_offset_s=round(clock.offset_s, 3))
    if errors := remedy.filter_errors_m(analysis, shifted_settings):
        if errors[1] > remedy.MAX_KF_ERROR_RATIO * errors[0]:
            return  # ground truth contradicts the offset
        action += f": KF position RMSE {errors[0]:.3f} → {errors[1]:.3f} m (re-run)"
    interval_s, is_late = (low - clock.applied_s, high - clock.applied_s), clock.remaining_s < 0
    first_s, last_s = (-interval_s[1], -interval_s[0]) if is_late else interval_s
    yield finding(
        "error" if size_s > MIN_OFFSET_ERROR_S else "warning",
        "source_time_offset",
        f"The timestamps of {source.name} are {size_s:.3f} s {'late' if is_late else 'early'} "
        f"relative to the IMU (95 % {first_s:.3f} to {last_s:.3f} s). At 1 m/s this is a position "
        f"error of {size_s:.2f} m. Innovations hardly show it.",
        f"{action}.{_format_ekf2_action(analysis, clock)}",
        evidence,
    )


def _format_ekf2_action(analysis: Analysis, clock: ClockOffset) -> str:
    """Format the action for EKF2's delay parameter; empty if no replay confirms a change."""
    source, model = analysis.source, analysis.ekf2_model
    parameters = analysis.flight.log.parameters
    logged_delays = [name for name in (*RECEIVER_DELAYS, GNSS_POS.delay) if name in parameters]
    is_receiver_delay = (
        bool(logged_delays) and logged_delays[0] in RECEIVER_DELAYS
    )  # the model does not include these
    if (
        source.origin.fused_as_gnss
        and logged_delays
        and (is_receiver_delay or isinstance(model, Unavailable))
    ):
        ml_delay_ms = parameters[logged_delays[0]] - 1e3 * clock.remaining_s
        return (
            f" EKF2 assumes fixes {parameters[logged_delays[0]]:g} ms old ({logged_delays[0]}); "
            f"the estimate is {max(ml_delay_ms, 0.0):.0f} ms (not replayed)."
        )
    if isinstance(model, Unavailable) or source.name != model.inputs.received.source:
        return ""
    changes = remedy.delay_change(model.inputs, 1e3 * (source.age_s - clock.offset_s))
    replays = what_if(model, [changes]) if changes else None
    if not isinstance(replays, WhatIf) or not remedy.delay_helps(replays.replayed, *replays.whatif):
        return ""
    effect = remedy.format_whatif_effect(replays.replayed, *replays.whatif)
    return f" For EKF2 set {remedy.format_settings(changes)}: {effect}."


def clock_offset_option_s(comparison: Comparison, clock: ClockOffset) -> float:
    """Return the value (s) for ``--clock-offset``: offset in use plus the estimated remainder.

    For a position file the offset in use is part of the alignment, not of the settings.
    """
    alignment = comparison.source.alignment
    return clock.offset_s if alignment is None else alignment.clock_offset_s + clock.remaining_s


def detect_wrong_delay(analysis: Analysis, clock: ClockOffset) -> Findings:
    """Detect EKF2_EV_DELAY outside 3 σ of the time offset plus one EKF2 step."""
    # GNSS timestamps are corrected by EKF2_GPS_DELAY, so detect_offset already covers that delay
    delay_ms = remedy.delay_ms(analysis) if analysis.source.origin.is_vision else None
    ml_delay_ms = -1e3 * clock.offset_s
    tolerance_ms = max(1e3 * clock.three_sigma_s + remedy.PREDICTION_STEP_MS, 1e3 * MIN_OFFSET_S)
    if delay_ms is None or abs(delay_ms - ml_delay_ms) < tolerance_ms:
        return
    low_ms, high_ms = (-1e3 * end_s for end_s in reversed(clock.interval_s))
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
        format_delay_remedy(analysis, 0.0 if low_ms <= 0.0 else ml_delay_ms, delay_ms),
        {"ekf2_ev_delay_ms": delay_ms, "asked_ms": ml_delay_ms},
    )


def format_delay_remedy(analysis: Analysis, delay_ms: float, current_ms: float) -> str:
    """Format the action for EKF2_EV_DELAY, within PX4's range; a replay confirms it if possible."""
    model, max_ms = analysis.ekf2_model, PARAMETERS["EKF2_EV_DELAY"].maximum
    if delay_ms > max_ms:
        return f"{CORRECT_AT_SENDER} PX4 allows at most {max_ms:g} ms (EKF2_EV_DELAY)."
    if round(delay_ms) <= 0.0 and current_ms == 0.0:
        return (
            f"{CORRECT_AT_SENDER} EKF2_EV_DELAY cannot be negative, so it does not correct early "
            "timestamps."
        )
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), 0.0)}
    if not isinstance(model, Unavailable):
        changes = remedy.delay_change(model.inputs, delay_ms) or changes
    return remedy.format_ekf2_remedy(
        model, changes, remedy.delay_helps, fallback_remedy=CORRECT_AT_SENDER
    )
