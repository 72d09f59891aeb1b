"""EKF2 does not fuse the position source, or only for part of the flight."""

import numpy as np
import pandas as pd

from px4fuse.comparison.model import Comparison
from px4fuse.findings.model import (
    Findings,
    error,
    format_percent,
    fraction_on,
    note,
    spans_with_value,
    warning,
)
from px4fuse.flight import Ekf2, FusionRecord, Unavailable, positions_of
from px4fuse.text import capitalise_first

MIN_FUSING_SHARE_ERROR = 0.5  # fused fraction of the segment; below, other sensors dominate: error
MIN_FUSING_SHARE_WARNING = 0.98  # fused fraction of the segment; 2 % of a minute are about 1 s
EV_START_INTERVAL_S = 0.2  # s; EV_MAX_INTERVAL of PX4 v1.14 and later (ev_control.cpp)
EV_STOP_INTERVAL_S = 0.4  # s; two times EV_MAX_INTERVAL (ev_pos_control.cpp)
MAX_LATENESS_S = 0.1  # s after the fusion horizon; EKF2 drops older samples (RingBuffer.h)
MIN_LIMITING_INTERVAL_S = 0.18  # s; 10 % of jitter reaches EV_START_INTERVAL_S: fusion starts late
CHECK_SWITCH = "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."


def detect(analysis: Comparison) -> Findings:
    """Detect that EKF2 fuses the position source for too small a fraction of the segment."""
    ekf2, segment, source = analysis.flight.ekf2, analysis.segment, analysis.source
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusing, Unavailable):
        return
    fusing = ekf2.fusing["horizontal"]
    share = fraction_on(fusing, segment)
    if share >= MIN_FUSING_SHARE_ERROR:
        yield from _detect_slow_restart(analysis, ekf2, fusing)
    evidence = {"fused_fraction": share, "source_interval_s": 1.0 / source.rate_hz}
    if not source.origin.is_vision:
        if source.name == "vehicle_mocap_odometry" and share == 0.0:
            yield warning(
                "ekf2_not_fusing",
                "EKF2 never fused the MOCAP positions (ATT_POS_MOCAP). It received no other "
                "external vision, so its track does not come from this source.",
                "Send the position as VISION_POSITION_ESTIMATE.",
                {"fused_fraction": share},
            )
    elif share < MIN_FUSING_SHARE_ERROR:
        fault, reason, action = _reason_and_action(analysis, ekf2)
        title = f"EKF2 never fused the {positions_of(source)}"
        if share:
            title = (
                f"EKF2 fused the {positions_of(source)} only {format_percent(share)} of the time"
            )
        yield error(
            "ekf2_not_fusing",
            f"{title}{fault}. {reason}",
            action,
            evidence,
        )
    elif share < MIN_FUSING_SHARE_WARNING:
        yield warning(
            "ekf2_fusion_interrupted",
            f"EKF2 fused the {positions_of(source)} only {format_percent(share)} of the time. In "
            "the rest EKF2 relied on its other sensors, and its position error grew. EKF2 (v1.14 "
            f"and later) stops fusion {EV_STOP_INTERVAL_S:g} s after the last position.",
            "Check the gaps and rejections at these times.",
            evidence,
            spans_with_value(0.0, fusing, segment),
        )


def _detect_slow_restart(analysis: Comparison, ekf2: Ekf2, fusing: pd.Series) -> Findings:
    """Detect that EKF2 resumed fusion late after a gap: positions come too slowly."""
    source = analysis.source
    is_limited = "EKF2_EV_CTRL" in analysis.flight.log.parameters  # v1.14 and later
    is_known = source.origin.is_vision and source.origin.has_all_samples and not source.alignment
    if not (is_limited and is_known) or 1.0 / source.rate_hz < MIN_LIMITING_INTERVAL_S:
        return
    time_s = source.samples.index.to_numpy()
    resumed_s = time_s[1:][np.diff(time_s) > EV_STOP_INTERVAL_S]
    late_spans = []
    for start_s, end_s in spans_with_value(0.0, fusing, analysis.segment):
        after_gap_s = resumed_s[(resumed_s > start_s - EV_STOP_INTERVAL_S) & (resumed_s < end_s)]
        waiting_s = (
            time_s[(time_s >= after_gap_s[-1]) & (time_s < end_s)] if len(after_gap_s) else []
        )
        if len(waiting_s) > 2 and waiting_s[1] - waiting_s[0] >= EV_START_INTERVAL_S:
            late_spans.append((float(waiting_s[0]), end_s))
    if late_spans:
        longest_s = max(end - start for start, end in late_spans)
        yield note(
            "source_rate_at_limit",
            f"{capitalise_first(positions_of(source))} come at {source.rate_hz:.1f} Hz, so EKF2 "
            f"resumed fusion only {longest_s:.1f} s after a gap. EKF2 (v1.14 and later) starts "
            f"fusion only when two positions come within {EV_START_INTERVAL_S:g} s.",
            "Send the position at 10 Hz.",
            {"rate_hz": source.rate_hz, "longest_s": longest_s, "count": len(late_spans)},
            tuple(late_spans),
        )


def _reason_and_action(analysis: Comparison, ekf2: Ekf2) -> tuple[str, str, str]:
    """Return the end of the title, the reason why EKF2 does not fuse the source, and the action.

    The end of the title is empty if the log does not show the reason.
    """
    parameters, interval_s = analysis.flight.log.parameters, 1.0 / analysis.source.rate_hz
    ev_control = parameters.get("EKF2_EV_CTRL")
    switch, bit, quantity = "EKF2_EV_CTRL", 0, "horizontal position"
    if ev_control is None:  # before v1.14
        switch, bit, quantity = "EKF2_AID_MASK", 3, "vision position"
    value = parameters.get(switch)
    if value is not None and not int(value) >> bit & 1:
        return (
            f": {switch} is {value:.0f}",
            f"Bit {bit} ({quantity}) is not set.",
            f"Set {switch} to {int(value) | 1 << bit}.",
        )
    horizon_s, age_s = ekf2.horizon_s, _age_s(analysis, ekf2)
    if isinstance(horizon_s, float) and age_s > horizon_s + MAX_LATENESS_S:
        return (
            f": the positions are {age_s:.2f} s old at arrival",
            f"EKF2 buffers only {horizon_s:.2f} s. Timestamps that are too early have the same "
            "effect.",
            "Check the clock of the sender. Then increase EKF2_DELAY_MAX (v1.15 and later).",
        )
    # positions reconstructed from EKF2 output have the rate of the logger, not of the source
    has_source_rate = ev_control is not None and not analysis.source.origin.reconstructed
    if has_source_rate and interval_s > EV_START_INTERVAL_S:
        return (
            f": the positions come at {analysis.source.rate_hz:.2g} Hz",
            f"The interval between positions is {interval_s:.2f} s. EKF2 (v1.14 and later) starts "
            f"to fuse external vision only when two positions come within {EV_START_INTERVAL_S:g} "
            "s. No parameter changes this limit.",
            "Send the position at 10 Hz.",
        )
    return "", "The log does not contain the reason.", CHECK_SWITCH


def _age_s(analysis: Comparison, ekf2: Ekf2) -> float:
    """Return the median age (s) at arrival: arrival - timestamp + EKF2_EV_DELAY; NaN if unknown."""
    if not isinstance(ekf2.record, FusionRecord):
        return float("nan")
    age_s = ekf2.record.vision_age_s.loc[analysis.segment.start_s : analysis.segment.end_s]
    delay_ms = analysis.flight.log.parameters.get("EKF2_EV_DELAY", 0.0)
    return float(age_s.median() + delay_ms * 1e-3)
