"""EKF2 does not use the source for horizontal position, or only for part of the flight."""

from px4fuse.comparison.model import Comparison
from px4fuse.findings.model import (
    Findings,
    error,
    format_percent,
    fraction_on,
    spans_with_value,
    warning,
)
from px4fuse.flight import Ekf2, FusionRecord, Unavailable

MIN_FUSING_SHARE_ERROR = 0.5  # of the segment; below, EKF2's track mostly uses other sensors
MIN_FUSING_SHARE_WARNING = 0.98  # of the segment; 2 % of a minute are about 1 s
EV_START_INTERVAL_S = 0.2  # EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp
EV_STOP_INTERVAL_S = 0.4  # two times EV_MAX_INTERVAL, ev_pos_control.cpp
MAX_LATENESS_S = 0.1  # s after the fusion horizon; EKF2 drops older samples (RingBuffer.h)
CHECK_SWITCH = "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."


def detect(analysis: Comparison) -> Findings:
    """Detect a small fraction of the segment in which EKF2 fuses the source."""
    ekf2, segment, source = analysis.flight.ekf2, analysis.segment, analysis.source
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusing, Unavailable):
        return
    fusing = ekf2.fusing["horizontal"]
    share = fraction_on(fusing, segment)
    evidence = {"fused_fraction": share, "source_interval_s": 1.0 / source.rate_hz}
    if not source.origin.is_vision:
        if source.name == "vehicle_mocap_odometry" and share == 0.0:
            yield warning(
                "ekf2_not_fusing",
                "EKF2 never fuses motion capture (ATT_POS_MOCAP), and received no other external "
                "vision. Its track does not come from this source.",
                "Send the position as VISION_POSITION_ESTIMATE, which EKF2 can fuse.",
                {"fused_fraction": share},
            )
    elif share < MIN_FUSING_SHARE_ERROR:
        reason, action = _reason_and_action(analysis, ekf2)
        extent = f"only in {format_percent(share)}" if share else "in no part"
        message = f"EKF2 fused the position source {extent} of the segment. {reason}"
        yield error("ekf2_not_fusing", message, action, evidence)
    elif share < MIN_FUSING_SHARE_WARNING:
        yield warning(
            "ekf2_fusion_interrupted",
            f"EKF2 fused the position source only in {format_percent(share)} of the segment. In "
            "the rest EKF2 relied on its other sensors, and its position error grew.",
            "Check the gaps and rejections below. EKF2 (v1.14 and later) stops fusion "
            f"{EV_STOP_INTERVAL_S:g} s after the last sample.",
            evidence,
            spans_with_value(0.0, fusing, segment),
        )


def _reason_and_action(analysis: Comparison, ekf2: Ekf2) -> tuple[str, str]:
    """Return the reason why EKF2 does not fuse the source, as a sentence, and the action."""
    parameters, interval_s = analysis.flight.log.parameters, 1.0 / analysis.source.rate_hz
    ev_control = parameters.get("EKF2_EV_CTRL")
    switch, bit, quantity = "EKF2_EV_CTRL", 0, "horizontal position"
    if ev_control is None:  # before v1.14
        switch, bit, quantity = "EKF2_AID_MASK", 3, "vision position"
    value = parameters.get(switch)
    if value is not None and not int(value) >> bit & 1:
        reason = f"{switch} is {value:.0f}: bit {bit} ({quantity}) is not set."
        return reason, f"Set {switch} to {int(value) | 1 << bit}."
    horizon_s, age_s = ekf2.horizon_s, _age_s(analysis, ekf2)
    if isinstance(horizon_s, float) and age_s > horizon_s + MAX_LATENESS_S:
        return (
            f"Samples arrive {age_s:.2f} s after their timestamps, but EKF2 buffers only "
            f"{horizon_s:.2f} s.",
            "Check the source's clock: timestamps that are too early have the same effect. Then "
            "increase EKF2_DELAY_MAX (v1.15 and later).",
        )
    # the rate of a reconstructed source is that of the logger
    has_source_rate = ev_control is not None and not analysis.source.origin.reconstructed
    if has_source_rate and interval_s > EV_START_INTERVAL_S:
        return (
            f"Samples arrive every {interval_s:.2f} s. EKF2 (v1.14 and later) starts fusion below "
            f"{EV_START_INTERVAL_S:g} s between samples, and stops above {EV_STOP_INTERVAL_S:g} s.",
            "Send the position at 10 Hz. At 5 Hz fusion starts only because of jitter.",
        )
    return "The log does not contain the reason.", CHECK_SWITCH


def _age_s(analysis: Comparison, ekf2: Ekf2) -> float:
    """Return the median age (s) at arrival: arrival - timestamp + EKF2_EV_DELAY; NaN if unknown."""
    if not isinstance(ekf2.record, FusionRecord):
        return float("nan")
    age_s = ekf2.record.vision_age_s.loc[analysis.segment.start_s : analysis.segment.end_s]
    delay_ms = analysis.flight.log.parameters.get("EKF2_EV_DELAY", 0.0)
    return float(age_s.median() + delay_ms * 1e-3)
