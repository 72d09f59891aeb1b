"""The source's stamps are late or early against the IMU, and EKF2_EV_DELAY is not that delay."""

from dataclasses import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.whatif import WhatIf, what_if
from px4fuse.ekf2_parameters import GNSS_POS, PARAMETERS, RECEIVER_DELAYS
from px4fuse.filter.clock import MAX_CHANGE_P, ClockOffset
from px4fuse.findings.model import Found, error, finding, warning
from px4fuse.findings.source_positions import low_pass
from px4fuse.findings.source_stamps import until_synchronised
from px4fuse.flight import Unavailable

OFFSET_S = 0.03  # at 1 m/s a third of a good UWB's noise
OFFSET_ERROR_S = 0.10  # at 1 m/s a good UWB's noise
AT_THE_SENDER = "Correct the stamps at the sender:"


def detect(analysis: Analysis) -> Found:
    """An offset that is known, of stamps that are the source's own and not EKF2's."""
    clock, is_reconstructed = analysis.clock, analysis.source.origin.reconstructed
    if isinstance(clock, ClockOffset) and clock.determinable and not is_reconstructed:
        yield from offset(analysis, clock)
        yield from delay(analysis, clock)


def offset(analysis: Analysis, clock: ClockOffset) -> Found:
    """The stamps contradict the IMU, or their error changed in flight."""
    source = analysis.source
    if low_pass(analysis) is not None:  # which lags behind the motion by itself
        return
    low, high = clock.interval_s
    evidence = {"offset_s": clock.offset_s, "interval_low_s": low, "interval_high_s": high}
    if clock.change_p is not None and clock.change_p < MAX_CHANGE_P:
        yield error(
            "source_clock_changes",
            {**evidence, "change_p": clock.change_p},
            source=source.name,
            first=clock.parts[0],
            last=clock.parts[-1],
        )
        return
    size = abs(clock.remaining_s)
    # one offset cannot hold for stamps that are of arrival in a part of the flight only
    if size <= max(OFFSET_S, clock.three_sigma_s) or until_synchronised(analysis) is not None:
        return
    typed = f"{remedy.COMMAND} --clock-offset {typed_offset_s(analysis, clock):.3f}"
    shifted = replace(analysis.settings, clock_offset_s=round(clock.offset_s, 3))
    if errors := remedy.filter_errors_m(analysis, shifted):
        if errors[1] > remedy.MAX_KF_ERROR_RATIO * errors[0]:
            return  # the truth knows better
        typed += f": position error {errors[0]:.3f} → {errors[1]:.3f} m (replayed)"
    ends, late = (low - clock.applied_s, high - clock.applied_s), clock.remaining_s < 0
    yield finding(
        "error" if size > OFFSET_ERROR_S else "warning",
        "source_clock_offset",
        evidence,
        source=source.name,
        late=late,
        size_s=size,
        ends=(-ends[1], -ends[0]) if late else ends,
        remedy=f"{typed}{_for_ekf2(analysis, clock)}.",
    )


def _for_ekf2(analysis: Analysis, clock: ClockOffset) -> str:
    """What putting EKF2's delay right would do, where a replay confirms it."""
    source, model = analysis.source, analysis.ekf2_model
    parameters = analysis.flight.log.parameters
    known = [name for name in (*RECEIVER_DELAYS, GNSS_POS.delay) if name in parameters]
    of_receiver = bool(known) and known[0] in RECEIVER_DELAYS  # which the model does not have
    if source.origin.fused_as_gnss and known and (of_receiver or isinstance(model, Unavailable)):
        ml_delay_ms = parameters[known[0]] - 1e3 * clock.remaining_s
        return (
            f"; for EKF2, which takes fixes to be {parameters[known[0]]:g} ms old ({known[0]}), "
            f"that would be {max(ml_delay_ms, 0.0):.0f} ms (not replayed)"
        )
    if isinstance(model, Unavailable) or source.name != model.inputs.received.source:
        return ""
    changes = remedy.delay_change(model.inputs, 1e3 * (source.age_s - clock.offset_s))
    found = what_if(model, [changes]) if changes else None
    if not isinstance(found, WhatIf) or not remedy.delay_helps(found.replayed, *found.whatif):
        return ""
    effect = remedy.format_whatif_effect(found.replayed, *found.whatif)
    return f"; for EKF2 set {remedy.format_settings(changes)}: {effect}"


def typed_offset_s(comparison: Comparison, clock: ClockOffset) -> float:
    """What to type as ``--clock-offset``: what was applied, with what is missing (s).

    That of a position file was spent on placing it, and is not in the settings.
    """
    placed = comparison.source.alignment
    return clock.offset_s if placed is None else placed.clock_offset_s + clock.remaining_s


def delay(analysis: Analysis, clock: ClockOffset) -> Found:
    """EKF2_EV_DELAY lies outside what the clock offset and EKF2's step leave open."""
    # of GNSS the offset itself is what EKF2's delay is wrong by
    delay_ms = remedy.delay_ms(analysis) if analysis.source.origin.is_vision else None
    ml_delay_ms = -1e3 * clock.offset_s
    known_ms = max(1e3 * clock.three_sigma_s + remedy.UPDATE_MS, 1e3 * OFFSET_S)
    if delay_ms is None or abs(delay_ms - ml_delay_ms) < known_ms:
        return
    low_ms, high_ms = (-1e3 * end for end in reversed(clock.interval_s))
    low, high = round(low_ms), round(high_ms)
    case = "none" if low_ms <= 0.0 <= high_ms else "early" if ml_delay_ms < 0.0 else "delay"
    if case == "early":
        low, high = -high, -low
    yield warning(
        "ekf2_ev_delay_wrong",
        {"ekf2_ev_delay_ms": delay_ms, "asked_ms": ml_delay_ms},
        case=case,
        size=round(abs(ml_delay_ms)),
        low=low,
        high=high,
        remedy=delay_remedy(analysis, 0.0 if low_ms <= 0.0 else ml_delay_ms, delay_ms),
    )


def delay_remedy(analysis: Analysis, delay_ms: float, flown_ms: float) -> str:
    """EKF2_EV_DELAY as the data ask for it, as far as PX4's range and a replay allow."""
    model, most_ms = analysis.ekf2_model, PARAMETERS["EKF2_EV_DELAY"].maximum
    if delay_ms > most_ms:
        return f"{AT_THE_SENDER} PX4 allows {most_ms:g} ms (EKF2_EV_DELAY)."
    if round(delay_ms) <= 0.0 and flown_ms == 0.0:
        return f"{AT_THE_SENDER} EKF2 has no parameter for stamps that are early."
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), 0.0)}
    if not isinstance(model, Unavailable):
        changes = remedy.delay_change(model.inputs, delay_ms) or changes
    return remedy.format_ekf2_remedy(
        model, changes, remedy.delay_helps, fallback_remedy=AT_THE_SENDER
    )
