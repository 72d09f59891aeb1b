"""EKF2 did not use the source for horizontal position, or not all the time."""

from px4fuse.comparison.model import Comparison
from px4fuse.findings.model import Found, error, share_on, spans_at, warning
from px4fuse.flight import Ekf2, FusionRecord, Unavailable

FUSING_SHARE_ERROR = 0.5  # of the segment: below, EKF2's track is mostly not the source's
FUSING_SHARE_WARNING = 0.98  # of the segment: one second in a flight of a minute
EV_START_INTERVAL_S = 0.2  # EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp
EV_STOP_INTERVAL_S = 0.4  # two times EV_MAX_INTERVAL, ev_pos_control.cpp
MAX_LATE_S = 0.1  # older than that by the horizon, no sample is fused: RingBuffer.h


def detect(analysis: Comparison) -> Found:
    """Fused in too small a share of the segment."""
    ekf2, segment, source = analysis.flight.ekf2, analysis.segment, analysis.source
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusing, Unavailable):
        return
    fusing = ekf2.fusing["horizontal"]
    share = share_on(fusing, segment)
    evidence = {"fusing_share": share, "source_interval_s": 1.0 / source.rate_hz}
    only = f"fused the source in only {share:.0%} of the segment"
    if not source.origin.is_vision:
        if source.name == "vehicle_mocap_odometry" and share == 0.0:
            yield warning(
                "ekf2_not_fusing",
                "EKF2 never fuses motion capture (ATT_POS_MOCAP), and nothing else of external "
                "vision reached it",
                ": its track does not come from this source.",
                "Send the position as VISION_POSITION_ESTIMATE if EKF2 is to fuse it.",
                {"fusing_share": share},
            )
    elif share < FUSING_SHARE_ERROR:
        why, remedy = _cause(analysis, ekf2)
        yield error(
            "ekf2_not_fusing",
            f"EKF2 {only if share else 'never fused the source in this segment'}",
            f": {why}.",
            remedy,
            evidence,
        )
    elif share < FUSING_SHARE_WARNING:
        yield warning(
            "ekf2_fusion_interrupted",
            f"EKF2 {only}",
            "; in between its track rests on its other sensors.",
            "Look at the gaps and rejections below; EKF2 (v1.14 and later) stops after "
            f"{EV_STOP_INTERVAL_S:g} s without a sample.",
            evidence,
            spans_at(0.0, fusing, segment),
        )


def _cause(analysis: Comparison, ekf2: Ekf2) -> tuple[str, str]:
    """Why EKF2 does not fuse the source, and the remedy."""
    parameters, interval_s = analysis.flight.log.parameters, 1.0 / analysis.source.rate_hz
    control = parameters.get("EKF2_EV_CTRL")
    switch, bit, what = "EKF2_EV_CTRL", 0, "horizontal position"
    if control is None:  # before v1.14
        switch, bit, what = "EKF2_AID_MASK", 3, "vision position"
    value = parameters.get(switch)
    if value is not None and not int(value) >> bit & 1:
        return (
            f"{switch} is {value:.0f}, bit {bit} ({what}) is not set",
            f"Set {switch} to {int(value) | 1 << bit}.",
        )
    horizon_s, age_s = ekf2.horizon_s, _age_s(analysis, ekf2)
    if isinstance(horizon_s, float) and age_s > horizon_s + MAX_LATE_S:
        return (
            f"its samples arrive {age_s:.2f} s after their stamps, and EKF2 keeps no more than "
            f"{horizon_s:.2f} s",
            "Check the source's clock (stamps that are too early look late), then raise "
            "EKF2_DELAY_MAX (v1.15 and later).",
        )
    # the rate of a reconstructed source is the logger's, not its own
    own_rate = control is not None and not analysis.source.origin.reconstructed
    if own_rate and interval_s > EV_START_INTERVAL_S:
        return (
            f"its samples come every {interval_s:.2f} s, and EKF2 (v1.14 and later) starts only "
            f"when they are less than {EV_START_INTERVAL_S:g} s apart and stops after "
            f"{EV_STOP_INTERVAL_S:g} s",
            "Send the UWB position at 10 Hz; 5 Hz starts only thanks to jitter.",
        )
    return "the log does not show why", "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."


def _age_s(analysis: Comparison, ekf2: Ekf2) -> float:
    """Time (s) from a sample's stamp to its arrival, less what EKF2 takes off; NaN if unknown."""
    if not isinstance(ekf2.record, FusionRecord):
        return float("nan")
    age_s = ekf2.record.vision_age_s.loc[analysis.segment.start_s : analysis.segment.end_s]
    delay_ms = analysis.flight.log.parameters.get("EKF2_EV_DELAY", 0.0)
    return float(age_s.median() + delay_ms * 1e-3)
